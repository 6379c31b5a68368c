//! The messages inside an episode's file, in format 2: protobuf, so that Foxglove and Rerun plot the numbers and show the pictures with the
//! triangle. Their schemas are in [`schema`](super::schema).
//!
//! The names of topics, fields and metadata, and the fields' numbers, are part of the format. What is unknown is NaN. All of it allocates
//! and is for ordinary threads only. Nothing here fails; a message that does not fit is found by [`read`](super::read).

use prost_types::Timestamp;

use crate::messages::{Doubt, Feature, Phase, Telemetry};

/// Topic of the images, named as ROS 2 does by custom.
pub(super) const IMAGE_TOPIC: &str = "/camera/image/compressed";
/// Topic of [`ImageAnnotations`]: what is drawn over the images.
pub(super) const ANNOTATION_TOPIC: &str = "/camera/annotations";
/// Topic of [`FeatureMessage`].
pub(super) const FEATURE_TOPIC: &str = "/feature";
/// Topic of [`TelemetryMessage`].
pub(super) const TELEMETRY_TOPIC: &str = "/telemetry";
/// Topic of [`RowMessage`].
pub(super) const ROW_TOPIC: &str = "/sample";

/// Name of the metadata record about the start.
pub(super) const META_EPISODE: &str = "episode";
/// Name of the metadata record with the whole configuration.
pub(super) const META_CONFIG: &str = "config";
/// Name of the metadata record about the end.
pub(super) const META_END: &str = "end";
/// Name of the metadata record with the weight.
pub(super) const META_WEIGHT: &str = "weight";
/// Name of the metadata record with what a person wrote about the episode.
pub(super) const META_NOTE: &str = "note";
/// Version of the format: the value of `format` in the metadata record about the start. Format 1 had JSON messages, and log times that were
/// CLOCK_MONOTONIC.
pub(super) const FORMAT: &str = "2";
/// The older format, which is still read.
pub(super) const FORMAT_1: &str = "1";
/// Key in the metadata record about the start: its Unix time, ns.
pub(super) const STARTED_AT_UNIX_NS: &str = "started_at_unix_ns";
/// Key in the metadata record about the start: Unix time less CLOCK_MONOTONIC when the episode started, ns.
pub(super) const CLOCK_OFFSET: &str = "clock_offset_ns";

/// Thickness of the triangle's lines, px. Chosen by hand: seen at 1280 x 720, and hides little at 640 x 480.
const LINE_PX: f64 = 2.0;
/// Height of the text beside the triangle, px. Chosen by hand: legible at 640 x 480.
const FONT_PX: f64 = 14.0;
/// Colour of what is measured: green, as in `inspect`'s pictures.
const MEASURED: Color = Color { r: 0.1, g: 0.9, b: 0.2, a: 1.0 };
/// Colour of what is doubtful: red.
const DOUBTFUL: Color = Color { r: 1.0, g: 0.2, b: 0.1, a: 1.0 };
/// `LINE_LOOP` of `foxglove.PointsAnnotation.Type`.
const LINE_LOOP: i32 = 2;

/// CLOCK_MONOTONIC in Unix time, ns; 0 before 1970.
pub(super) fn unix_ns(at_ns: u64, offset_ns: i128) -> u64 {
    u64::try_from((i128::from(at_ns) + offset_ns).max(0)).unwrap_or(u64::MAX)
}

/// Unix time in CLOCK_MONOTONIC, ns; 0 before the machine started.
pub(super) fn monotonic_ns(unix_ns: u64, offset_ns: i128) -> u64 {
    u64::try_from((i128::from(unix_ns) - offset_ns).max(0)).unwrap_or(u64::MAX)
}

/// Unix time as protobuf has it.
pub(super) fn timestamp(unix_ns: u64) -> Timestamp {
    Timestamp { seconds: (unix_ns / 1_000_000_000) as i64, nanos: (unix_ns % 1_000_000_000) as i32 }
}

/// A message of `/camera/image/compressed`, `foxglove.CompressedImage`.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct CompressedImage {
    /// Capture time, Unix time like the log times.
    #[prost(message, optional, tag = "1")]
    pub timestamp: Option<Timestamp>,
    #[prost(bytes = "vec", tag = "2")]
    pub data: Vec<u8>,
    #[prost(string, tag = "3")]
    pub format: String,
    #[prost(string, tag = "4")]
    pub frame_id: String,
}

/// A message of `/camera/annotations`, `foxglove.ImageAnnotations`.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct ImageAnnotations {
    #[prost(message, repeated, tag = "2")]
    pub points: Vec<PointsAnnotation>,
    #[prost(message, repeated, tag = "3")]
    pub texts: Vec<TextAnnotation>,
    #[prost(message, optional, tag = "5")]
    pub timestamp: Option<Timestamp>,
}

/// `foxglove.PointsAnnotation`: the triangle.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct PointsAnnotation {
    #[prost(message, optional, tag = "1")]
    pub timestamp: Option<Timestamp>,
    #[prost(int32, tag = "2")]
    pub kind: i32,
    #[prost(message, repeated, tag = "3")]
    pub points: Vec<Point2>,
    #[prost(message, optional, tag = "4")]
    pub outline_color: Option<Color>,
    #[prost(double, tag = "7")]
    pub thickness: f64,
}

/// `foxglove.TextAnnotation`: V_e, or why there is none.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct TextAnnotation {
    #[prost(message, optional, tag = "1")]
    pub timestamp: Option<Timestamp>,
    #[prost(message, optional, tag = "2")]
    pub position: Option<Point2>,
    #[prost(string, tag = "3")]
    pub text: String,
    #[prost(double, tag = "4")]
    pub font_size: f64,
    #[prost(message, optional, tag = "5")]
    pub text_color: Option<Color>,
}

/// `foxglove.Point2`, px.
#[derive(Clone, Copy, PartialEq, prost::Message)]
pub(super) struct Point2 {
    #[prost(double, tag = "1")]
    pub x: f64,
    #[prost(double, tag = "2")]
    pub y: f64,
}

/// `foxglove.Color`, each from 0 to 1.
#[derive(Clone, Copy, PartialEq, prost::Message)]
pub(super) struct Color {
    #[prost(double, tag = "1")]
    pub r: f64,
    #[prost(double, tag = "2")]
    pub g: f64,
    #[prost(double, tag = "3")]
    pub b: f64,
    #[prost(double, tag = "4")]
    pub a: f64,
}

impl ImageAnnotations {
    /// What is drawn over the frame of `feature`: the triangle and its area, or the doubt. Empty where nothing flows, so that the one before
    /// goes away.
    pub(super) fn new(feature: &Feature, unix_ns: u64) -> Self {
        let doubt = Doubt::from_code(feature.doubt);
        let (timestamp, colour) = (Some(timestamp(unix_ns)), if doubt == Doubt::None { MEASURED } else { DOUBTFUL });
        let corners: Vec<Point2> = feature.triangle_px.chunks_exact(2).map(|p| Point2 { x: f64::from(p[0]), y: f64::from(p[1]) }).collect();
        let drawn = feature.area_px2 > 0.0 && feature.triangle_px.iter().all(|v| v.is_finite());
        let position = if drawn { corners.first().copied() } else { Some(Point2 { x: FONT_PX, y: 2.0 * FONT_PX }) };
        let text = match (doubt, drawn) {
            (Doubt::None, false) => None,
            (Doubt::None, true) => Some(format!("V_e {:.0} px^2", feature.area_px2)),
            (doubt, _) => Some(doubt.words().into()),
        };
        Self {
            timestamp,
            points: if drawn {
                vec![PointsAnnotation { timestamp, kind: LINE_LOOP, points: corners, outline_color: Some(colour), thickness: LINE_PX }]
            } else {
                Vec::new()
            },
            texts: text
                .map(|text| TextAnnotation { timestamp, position, text, font_size: FONT_PX, text_color: Some(colour) })
                .into_iter()
                .collect(),
        }
    }
}

/// A message of `/sample`: one row of `L_E`, with V_e beside it.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct RowMessage {
    #[prost(uint64, tag = "1")]
    pub sequence: u64,
    #[prost(uint64, tag = "2")]
    pub captured_at_ns: u64,
    #[prost(float, tag = "3")]
    pub alpha_commanded_deg: f32,
    #[prost(float, tag = "4")]
    pub alpha_measured_deg: f32,
    #[prost(float, tag = "5")]
    pub area_px2: f32,
    #[prost(string, tag = "6")]
    pub doubt: String,
    #[prost(bool, tag = "7")]
    pub image: bool,
}

/// A message of `/feature`: a [`Feature`] with its codes in words.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct FeatureMessage {
    #[prost(uint64, tag = "1")]
    pub sequence: u64,
    #[prost(uint64, tag = "2")]
    pub captured_at_ns: u64,
    #[prost(uint64, tag = "3")]
    pub received_at_ns: u64,
    #[prost(uint64, tag = "4")]
    pub published_at_ns: u64,
    #[prost(uint64, tag = "5")]
    pub worker_epoch_ns: u64,
    #[prost(float, tag = "6")]
    pub area_px2: f32,
    #[prost(float, tag = "7")]
    pub confidence: f32,
    #[prost(string, tag = "8")]
    pub doubt: String,
    #[prost(float, repeated, tag = "9")]
    pub triangle_px: Vec<f32>,
}

impl FeatureMessage {
    pub(super) fn new(f: &Feature) -> Self {
        Self {
            sequence: f.sequence,
            captured_at_ns: f.captured_at_ns,
            received_at_ns: f.received_at_ns,
            published_at_ns: f.published_at_ns,
            worker_epoch_ns: f.worker_epoch_ns,
            area_px2: f.area_px2,
            confidence: f.confidence,
            doubt: Doubt::from_code(f.doubt).words().into(),
            triangle_px: f.triangle_px.to_vec(),
        }
    }
}

/// A message of `/telemetry`: a [`Telemetry`] with its codes in words.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct TelemetryMessage {
    #[prost(uint64, tag = "1")]
    pub tick: u64,
    #[prost(uint64, tag = "2")]
    pub at_ns: u64,
    #[prost(uint64, tag = "3")]
    pub robot_at_ns: u64,
    #[prost(uint64, tag = "4")]
    pub feature_sequence: u64,
    #[prost(string, tag = "5")]
    pub phase: String,
    #[prost(float, tag = "6")]
    pub alpha_deg: f32,
    #[prost(float, tag = "7")]
    pub alpha_measured_deg: f32,
    #[prost(float, tag = "8")]
    pub dalpha_deg: f32,
    #[prost(float, tag = "9")]
    pub area_px2: f32,
    #[prost(float, tag = "10")]
    pub v_ml: f32,
    #[prost(float, tag = "11")]
    pub d_ml: f32,
    #[prost(float, tag = "12")]
    pub poured_ml: f32,
    #[prost(float, tag = "13")]
    pub goal_ml: f32,
    #[prost(float, tag = "14")]
    pub poured_sd_ml: f32,
}

impl TelemetryMessage {
    pub(super) fn new(t: &Telemetry) -> Self {
        Self {
            tick: t.tick,
            at_ns: t.at_ns,
            robot_at_ns: t.robot_at_ns,
            feature_sequence: t.feature_sequence,
            phase: phase_words(Phase::from_code(t.phase)).into(),
            alpha_deg: t.alpha_deg,
            alpha_measured_deg: t.alpha_measured_deg,
            dalpha_deg: t.dalpha_deg,
            area_px2: t.area_px2,
            v_ml: t.v_ml,
            d_ml: t.d_ml,
            poured_ml: t.poured_ml,
            goal_ml: t.goal_ml,
            poured_sd_ml: t.poured_sd_ml,
        }
    }
}

/// The phase's name, as everywhere else.
fn phase_words(phase: Phase) -> &'static str {
    match phase {
        Phase::NoRobot => "no-robot",
        Phase::Idle => "idle",
        Phase::Pouring => "pouring",
        Phase::Returning => "returning",
        Phase::Recording => "recording",
        Phase::Settling => "settling",
    }
}
