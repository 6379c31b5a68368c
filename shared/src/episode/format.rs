//! The messages inside an episode's file, and the schemas that let any MCAP reader understand them.
//!
//! Images are protobuf `foxglove.CompressedImage`, which viewers show without plug-ins. All else is JSON, which people and every language
//! can read; NaN is written as `null`. The names of topics, fields and metadata are part of the format. All of it allocates and is for
//! ordinary threads only. Nothing here fails; a message that does not fit is found by [`read`](super::read).

use prost::Message as _;
use prost_types::field_descriptor_proto::{Label, Type};
use prost_types::{DescriptorProto, FieldDescriptorProto, FileDescriptorProto, FileDescriptorSet};
use serde::{Deserialize, Deserializer, Serialize};

use crate::messages::{Doubt, Feature, Phase, Telemetry};

/// Topic of the images, named as ROS 2 does by custom.
pub(super) const IMAGE_TOPIC: &str = "/camera/image/compressed";
/// Topic of [`FeatureJson`].
pub(super) const FEATURE_TOPIC: &str = "/feature";
/// Topic of [`TelemetryJson`].
pub(super) const TELEMETRY_TOPIC: &str = "/telemetry";
/// Topic of [`EpisodeRowJson`].
pub(super) const ROW_TOPIC: &str = "/sample";

/// Name of the metadata record about the start.
pub(super) const META_EPISODE: &str = "episode";
/// Name of the metadata record with the whole configuration.
pub(super) const META_CONFIG: &str = "config";
/// Name of the metadata record about the end.
pub(super) const META_END: &str = "end";
/// Name of the metadata record with the weight.
pub(super) const META_WEIGHT: &str = "weight";
/// Version of the format: the value of `format` in the metadata record about the start.
pub(super) const FORMAT: &str = "1";

/// A message of `/camera/image/compressed`, `foxglove.CompressedImage`.
#[derive(Clone, PartialEq, prost::Message)]
pub(super) struct CompressedImage {
    /// Capture time, CLOCK_MONOTONIC like the log times.
    #[prost(message, optional, tag = "1")]
    pub timestamp: Option<prost_types::Timestamp>,
    #[prost(bytes = "vec", tag = "2")]
    pub data: Vec<u8>,
    #[prost(string, tag = "3")]
    pub format: String,
    #[prost(string, tag = "4")]
    pub frame_id: String,
}

/// The FileDescriptorSet of [`CompressedImage`], which MCAP requires as the schema of a protobuf message.
pub(super) fn compressed_image_schema() -> Vec<u8> {
    let field = |name: &str, number: i32, kind: Type, type_name: Option<&str>| FieldDescriptorProto {
        name: Some(name.into()),
        number: Some(number),
        label: Some(Label::Optional.into()),
        r#type: Some(kind.into()),
        type_name: type_name.map(Into::into),
        ..Default::default()
    };
    let file = |name: &str, package: &str, dependency: &[&str], message: &str, field: Vec<FieldDescriptorProto>| FileDescriptorProto {
        name: Some(name.into()),
        package: Some(package.into()),
        dependency: dependency.iter().map(|d| (*d).into()).collect(),
        message_type: vec![DescriptorProto { name: Some(message.into()), field, ..Default::default() }],
        syntax: Some("proto3".into()),
        ..Default::default()
    };
    let timestamp = vec![field("seconds", 1, Type::Int64, None), field("nanos", 2, Type::Int32, None)];
    let image = vec![
        field("timestamp", 1, Type::Message, Some(".google.protobuf.Timestamp")),
        field("frame_id", 4, Type::String, None),
        field("data", 2, Type::Bytes, None),
        field("format", 3, Type::String, None),
    ];
    let set = FileDescriptorSet {
        file: vec![
            file("google/protobuf/timestamp.proto", "google.protobuf", &[], "Timestamp", timestamp),
            file("foxglove/CompressedImage.proto", "foxglove", &["google/protobuf/timestamp.proto"], "CompressedImage", image),
        ],
    };
    set.encode_to_vec()
}

/// A message of `/sample`: one row of `L_E`, with V_e beside it.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct EpisodeRowJson {
    pub sequence: u64,
    pub captured_at_ns: u64,
    #[serde(deserialize_with = "null_is_nan")]
    pub alpha_commanded_deg: f32,
    #[serde(deserialize_with = "null_is_nan")]
    pub alpha_measured_deg: f32,
    #[serde(deserialize_with = "null_is_nan")]
    pub area_px2: f32,
    pub doubt: String,
    pub image: bool,
}

/// A message of `/feature`: a [`Feature`] with its codes in words.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub(super) struct FeatureJson {
    sequence: u64,
    captured_at_ns: u64,
    received_at_ns: u64,
    published_at_ns: u64,
    worker_epoch_ns: u64,
    area_px2: f32,
    confidence: f32,
    doubt: &'static str,
    triangle_px: [f32; 6],
}

impl FeatureJson {
    pub(super) fn new(f: &Feature) -> Self {
        Self {
            sequence: f.sequence,
            captured_at_ns: f.captured_at_ns,
            received_at_ns: f.received_at_ns,
            published_at_ns: f.published_at_ns,
            worker_epoch_ns: f.worker_epoch_ns,
            area_px2: f.area_px2,
            confidence: f.confidence,
            doubt: Doubt::from_code(f.doubt).words(),
            triangle_px: f.triangle_px,
        }
    }
}

/// A message of `/telemetry`: a [`Telemetry`] with its codes in words.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct TelemetryJson {
    pub tick: u64,
    pub at_ns: u64,
    pub robot_at_ns: u64,
    pub feature_sequence: u64,
    pub phase: Phase,
    #[serde(deserialize_with = "null_is_nan")]
    pub alpha_deg: f32,
    #[serde(deserialize_with = "null_is_nan")]
    pub alpha_measured_deg: f32,
    #[serde(deserialize_with = "null_is_nan")]
    pub dalpha_deg: f32,
    #[serde(deserialize_with = "null_is_nan")]
    pub area_px2: f32,
    #[serde(deserialize_with = "null_is_nan")]
    pub v_ml: f32,
    #[serde(deserialize_with = "null_is_nan")]
    pub d_ml: f32,
    #[serde(deserialize_with = "null_is_nan")]
    pub poured_ml: f32,
}

impl TelemetryJson {
    pub(super) fn new(t: &Telemetry) -> Self {
        Self {
            tick: t.tick,
            at_ns: t.at_ns,
            robot_at_ns: t.robot_at_ns,
            feature_sequence: t.feature_sequence,
            phase: Phase::from_code(t.phase),
            alpha_deg: t.alpha_deg,
            alpha_measured_deg: t.alpha_measured_deg,
            dalpha_deg: t.dalpha_deg,
            area_px2: t.area_px2,
            v_ml: t.v_ml,
            d_ml: t.d_ml,
            poured_ml: t.poured_ml,
        }
    }
}

/// A number in which `null` stands for NaN, which JSON does not have.
fn null_is_nan<'de, D: Deserializer<'de>>(deserializer: D) -> Result<f32, D::Error> {
    Ok(Option::<f32>::deserialize(deserializer)?.unwrap_or(f32::NAN))
}

/// Name, topic and JSON schema of each of the three JSON topics.
pub(super) fn json_schemas() -> [(&'static str, &'static str, String); 3] {
    [
        (
            "decant.Feature",
            FEATURE_TOPIC,
            schema(
                "What the feature worker measured in one frame (V_e, section 3.3.1)",
                &[
                    ("sequence", "integer", "the camera's frame number"),
                    ("captured_at_ns", "integer", "middle of the exposure, CLOCK_MONOTONIC ns"),
                    ("received_at_ns", "integer", "when the worker took the frame, CLOCK_MONOTONIC ns"),
                    ("published_at_ns", "integer", "when the worker published V_e, CLOCK_MONOTONIC ns"),
                    ("worker_epoch_ns", "integer", "start of the worker process, CLOCK_MONOTONIC ns"),
                    ("area_px2", "number", "V_e, px^2"),
                    ("confidence", "number", "0 to 1"),
                    ("doubt", "string", "why the area is doubtful"),
                    ("triangle_px", "array", "x0 y0 x1 y1 x2 y2, px"),
                ],
            ),
        ),
        (
            "decant.Telemetry",
            TELEMETRY_TOPIC,
            schema(
                "What one tick of the controller saw and decided",
                &[
                    ("tick", "integer", "ticks since the controller started"),
                    ("at_ns", "integer", "when the tick woke up, CLOCK_MONOTONIC ns"),
                    ("robot_at_ns", "integer", "when the newest robot state arrived, CLOCK_MONOTONIC ns"),
                    ("feature_sequence", "integer", "newest feature used"),
                    ("phase", "string", "pouring, recording, returning or settling"),
                    ("alpha_deg", "number", "commanded alpha, degrees"),
                    ("alpha_measured_deg", "number", "measured alpha, degrees"),
                    ("dalpha_deg", "number", "the policy's action, degrees; null if it was not asked"),
                    ("area_px2", "number", "V_e of the newest feature, px^2; null without one"),
                    ("v_ml", "number", "outflow attributed to the newest frame, ml"),
                    ("d_ml", "number", "volume still to pour, ml"),
                    ("poured_ml", "number", "estimated volume poured so far, ml"),
                ],
            ),
        ),
        (
            "decant.Sample",
            ROW_TOPIC,
            schema(
                "One frame of the episode: alpha at its capture time, and V_e",
                &[
                    ("sequence", "integer", "the camera's frame number"),
                    ("captured_at_ns", "integer", "middle of the exposure, CLOCK_MONOTONIC ns"),
                    ("alpha_commanded_deg", "number", "commanded alpha, interpolated, degrees"),
                    ("alpha_measured_deg", "number", "measured alpha, interpolated, degrees; null if unknown"),
                    ("area_px2", "number", "V_e, px^2"),
                    ("doubt", "string", "why the area is doubtful"),
                    ("image", "boolean", "whether the image is in this file"),
                ],
            ),
        ),
    ]
}

/// A JSON schema of an object with `fields`: name, type and description of each.
fn schema(title: &str, fields: &[(&str, &str, &str)]) -> String {
    let properties: serde_json::Map<String, serde_json::Value> = fields
        .iter()
        .map(|(name, kind, what)| {
            let mut field = serde_json::json!({ "type": kind, "description": what });
            if *kind == "array" {
                field["items"] = serde_json::json!({ "type": "number" });
            }
            ((*name).into(), field)
        })
        .collect();
    serde_json::json!({ "title": title, "type": "object", "properties": properties }).to_string()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects viewers and other readers: the schemas list each field that is written, and no other.
    #[test]
    fn schemas_list_exactly_the_fields_that_are_written() {
        let row = EpisodeRowJson {
            sequence: 1,
            captured_at_ns: 2,
            alpha_commanded_deg: 3.0,
            alpha_measured_deg: 4.0,
            area_px2: 5.0,
            doubt: String::new(),
            image: true,
        };
        let rows = [
            serde_json::to_value(FeatureJson::new(&Feature::default())).unwrap(),
            serde_json::to_value(TelemetryJson::new(&Telemetry::default())).unwrap(),
            serde_json::to_value(row).unwrap(),
        ];
        for ((name, _, text), row) in json_schemas().into_iter().zip(rows) {
            let schema: serde_json::Value = serde_json::from_str(&text).unwrap();
            let documented: Vec<&String> = schema["properties"].as_object().unwrap().keys().collect();
            let written: Vec<&String> = row.as_object().unwrap().keys().collect();
            assert_eq!(documented, written, "{name}");
        }
    }
}
