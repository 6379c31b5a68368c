//! Fixed-layout messages that cross shared memory.
//!
//! Every struct is `repr(C)` without padding, carries [`LAYOUT_VERSION`], and is plain data that another process may read at any time.
//! The byte tables are in `ARCHITECTURE.md` and are held by tests below. All times are CLOCK_MONOTONIC in nanoseconds. The messages are used
//! in the controller's loop. Nothing here allocates, except [`Telemetry::weights`], and nothing fails: an unknown code is read as the most careful
//! meaning.

use iceoryx2::prelude::ZeroCopySend;

use crate::framing::Framing;

/// Version of all layouts in this file. It is part of every service's name, so that programs of other versions never connect.
pub const LAYOUT_VERSION: u32 = 5;

/// How the pixels of a camera frame are stored.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum PixelFormat {
    /// 3 bytes a pixel: blue, green, red (OpenCV's order).
    Bgr8 = 0,
    /// 1 byte a pixel.
    Mono8 = 1,
    /// 2 bytes a pixel, 4:2:2, in the order Y0 U Y1 V.
    Yuyv = 2,
}

impl PixelFormat {
    /// The format with this code, if there is one.
    pub fn from_code(code: u32) -> Option<Self> {
        [Self::Bgr8, Self::Mono8, Self::Yuyv].into_iter().find(|f| *f as u32 == code)
    }

    /// Bytes of one pixel.
    pub fn bytes_per_pixel(self) -> usize {
        match self {
            Self::Bgr8 => 3,
            Self::Mono8 => 1,
            Self::Yuyv => 2,
        }
    }
}

/// Header of one camera frame: the user header of the service `frame`, whose payload is the pixels, row by row without padding.
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[repr(C)]
pub struct FrameHeader {
    /// [`LAYOUT_VERSION`].
    pub version: u32,
    /// A [`PixelFormat`] code.
    pub format: u32,
    /// Width in pixels.
    pub width_px: u32,
    /// Height in pixels.
    pub height_px: u32,
    /// Number of the frame. Every frame that the camera exposed counts, also a dropped one; the first is 1.
    pub sequence: u64,
    /// Middle of the exposure, CLOCK_MONOTONIC ns.
    pub captured_at_ns: u64,
    /// When the frame was published, CLOCK_MONOTONIC ns.
    pub published_at_ns: u64,
}

/// Why a feature is doubtful.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(u32)]
pub enum Doubt {
    /// It is not doubtful.
    #[default]
    None = 0,
    /// The region is too dark to see anything.
    TooDark = 1,
    /// The region is overexposed.
    BlownOut = 2,
    /// The picture is blurred by motion or out of focus.
    Blurred = 3,
    /// The camera repeats the same picture.
    Frozen = 4,
    /// There is liquid, but no line fits its outer edge; or a stream is gone, and dry ground is not seen where it was.
    EdgeNotFound = 5,
    /// The stream leaves the region, so the area is a lower bound.
    LeavesRegion = 6,
    /// The frame has another size or format than configured.
    WrongFormat = 7,
    /// A part of the picture is missing, shifted, or of another picture.
    PictureIncomplete = 8,
    /// At the lip is something with the colours of neither the ground nor the liquid, or the picture has no colour; or the camera's colours
    /// wander so far that the liquid may look like the ground.
    ColoursChanged = 9,
    /// The light changes faster than the picture is read, so that it has bands; or it wanders from picture to picture.
    LightFlickers = 10,
}

impl Doubt {
    /// All reasons, in the order of their codes.
    pub const ALL: [Self; 11] = [
        Self::None,
        Self::TooDark,
        Self::BlownOut,
        Self::Blurred,
        Self::Frozen,
        Self::EdgeNotFound,
        Self::LeavesRegion,
        Self::WrongFormat,
        Self::PictureIncomplete,
        Self::ColoursChanged,
        Self::LightFlickers,
    ];

    /// The reason with this code; an unknown code counts as a frame that cannot be used.
    pub fn from_code(code: u32) -> Self {
        Self::ALL.into_iter().find(|d| *d as u32 == code).unwrap_or(Self::WrongFormat)
    }

    /// Whether an area of `area_px2` with this doubt may still be used as a measurement. Nothing seen in a doubtful picture is no
    /// measurement: it does not say that nothing flows.
    pub fn usable(self, area_px2: f32) -> bool {
        match self {
            Self::None => area_px2 >= 0.0,
            Self::Blurred | Self::LeavesRegion => area_px2 > 0.0,
            _ => false,
        }
    }

    /// The reason in words.
    pub fn words(self) -> &'static str {
        match self {
            Self::None => "none",
            Self::TooDark => "too dark",
            Self::BlownOut => "blown out",
            Self::Blurred => "blurred",
            Self::Frozen => "frozen frame",
            Self::EdgeNotFound => "edge not found",
            Self::LeavesRegion => "stream leaves the region",
            Self::WrongFormat => "wrong frame format",
            Self::PictureIncomplete => "picture incomplete",
            Self::ColoursChanged => "colours changed",
            Self::LightFlickers => "light flickers",
        }
    }
}

/// What the feature worker measured in one frame, V_e of section 3.3.1 (service `feature`).
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend, serde::Serialize, serde::Deserialize)]
#[repr(C)]
pub struct Feature {
    /// [`LAYOUT_VERSION`].
    pub version: u32,
    /// A [`Doubt`] code.
    pub doubt: u32,
    /// The camera's frame number ([`FrameHeader::sequence`]); a gap means that frames were lost.
    pub sequence: u64,
    /// When the worker process started, CLOCK_MONOTONIC ns; a change means that the worker was restarted.
    pub worker_epoch_ns: u64,
    /// Middle of the frame's exposure, CLOCK_MONOTONIC ns.
    pub captured_at_ns: u64,
    /// When the worker received the frame, CLOCK_MONOTONIC ns.
    pub received_at_ns: u64,
    /// When the worker published this, CLOCK_MONOTONIC ns.
    pub published_at_ns: u64,
    /// V_e: the area of the triangle, px^2; finite and >= 0, exactly 0 without a stream, and where nothing could be measured.
    pub area_px2: f32,
    /// Confidence, 0 (none) to 1 (full): the share of such frames whose area is within 20 % of the truth.
    pub confidence: f32,
    /// Corners of the triangle in the image, px, as x0 y0 x1 y1 x2 y2: where the axes cross, on the x-axis, on the y-axis.
    pub triangle_px: [f32; 6],
    /// How the lip lies in the worker's pictures.
    pub framing: Framing,
}

/// What the controller was doing in a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
#[repr(u32)]
pub enum Phase {
    /// There is no usable robot: it is not connected, or not allowed to move.
    #[default]
    NoRobot = 0,
    /// The container is upright at the start angle, and no goal is set (d = 0).
    Idle = 1,
    /// A goal is set, and the agent decides.
    Pouring = 2,
    /// The pour or recording is over or aborted; the container is on the way back to the start angle.
    Returning = 3,
    /// The curve of eq. (1) is run.
    Recording = 4,
    /// The container has been commanded upright, and the last drops are counted before the result is given.
    Settling = 5,
}

impl Phase {
    /// The phase with this code; unknown codes read as [`Phase::NoRobot`].
    pub fn from_code(code: u32) -> Self {
        [Self::NoRobot, Self::Idle, Self::Pouring, Self::Returning, Self::Recording, Self::Settling]
            .into_iter()
            .find(|p| *p as u32 == code)
            .unwrap_or_default()
    }
}

/// What one tick of the controller saw, decided and sent (service `telemetry`). It holds everything that an
/// episode records of a tick.
#[derive(Debug, Clone, Copy, PartialEq, Default, ZeroCopySend)]
#[repr(C)]
pub struct Telemetry {
    /// [`LAYOUT_VERSION`].
    pub version: u32,
    /// A [`Phase`] code.
    pub phase: u32,
    /// Number of the tick since the controller started.
    pub tick: u64,
    /// When the tick woke up, CLOCK_MONOTONIC ns.
    pub at_ns: u64,
    /// When the newest robot state in it arrived, CLOCK_MONOTONIC ns; 0 before the first.
    pub robot_at_ns: u64,
    /// Number of the pour or recording that this tick belongs to, unique for a controller process; 0 if there is none.
    pub episode: u64,
    /// [`Feature::sequence`] of the newest feature used; 0 before the first.
    pub feature_sequence: u64,
    /// Identity of the weights in use ([`Telemetry::weights`]); 0 if there are none.
    pub weights_id: u64,
    /// Commanded alpha after all limits, degrees from upright.
    pub alpha_deg: f32,
    /// Measured alpha, degrees from upright; NaN before the first robot state.
    pub alpha_measured_deg: f32,
    /// Relative angle that the agent asked for in this tick, degrees; NaN if it was not asked.
    pub dalpha_deg: f32,
    /// V_e of the newest feature, px^2; NaN if there was none in this tick.
    pub area_px2: f32,
    /// Outflow attributed to the newest frame, ml.
    pub v_ml: f32,
    /// d: volume still to pour, ml; may be negative.
    pub d_ml: f32,
    /// Goal volume V_G, ml; NaN in a recording.
    pub goal_ml: f32,
    /// Estimated volume poured so far, ml.
    pub poured_ml: f32,
    /// lambda of eq. (1), degrees; NaN unless a curve is recorded.
    pub lambda_deg: f32,
    /// gamma of eq. (1), 1/s^2; NaN unless a curve is recorded.
    pub gamma_per_s2: f32,
    /// beta of eq. (1), s; NaN unless a curve is recorded.
    pub beta_s: f32,
    /// Standard deviation of the estimated volume, ml; 0 if it is not known.
    pub poured_sd_ml: f32,
}

impl Telemetry {
    /// Identity of the weights in use as `Weights::identity` gives it: 16 hexadecimal digits; empty if there are none.
    pub fn weights(&self) -> String {
        if self.weights_id == 0 { String::new() } else { format!("{:016x}", self.weights_id) }
    }
}

/// What the recorder did with an episode (service `recorder`). The newest reports are kept for late readers.
#[derive(Debug, Clone, Copy, PartialEq, ZeroCopySend)]
#[repr(C)]
pub struct RecorderReport {
    /// [`LAYOUT_VERSION`].
    pub version: u32,
    /// A [`RecorderState`] code.
    pub state: u32,
    /// [`Telemetry::episode`].
    pub episode: u64,
    /// Number of images written.
    pub images: u64,
    /// Number of images that the recorder had to drop.
    pub dropped: u64,
    /// Length of `path` in bytes.
    pub path_len: u64,
    /// The file's absolute path, or the error's text in state [`RecorderState::Failed`]; UTF-8, at most 512 bytes of it.
    pub path: [u8; 512],
}

/// State of an episode's file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum RecorderState {
    /// The file is being written.
    Writing = 0,
    /// The file is closed and whole.
    Complete = 1,
    /// The file could not be written; the path holds the reason.
    Failed = 2,
}

impl RecorderState {
    /// The state with this code; unknown codes read as [`RecorderState::Failed`].
    pub fn from_code(code: u32) -> Self {
        match code {
            0 => Self::Writing,
            1 => Self::Complete,
            _ => Self::Failed,
        }
    }
}

impl RecorderReport {
    /// A report with `text`, which is a path or an error's line, cut to fit.
    pub fn new(state: RecorderState, episode: u64, images: u64, dropped: u64, text: &str) -> Self {
        let mut end = text.len().min(512);
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        let mut path = [0; 512];
        path[..end].copy_from_slice(&text.as_bytes()[..end]);
        Self { version: LAYOUT_VERSION, state: state as u32, episode, images, dropped, path_len: end as u64, path }
    }

    /// The path, or the error's text.
    pub fn text(&self) -> &str {
        let len = usize::try_from(self.path_len).unwrap_or(0).min(self.path.len());
        std::str::from_utf8(&self.path[..len]).unwrap_or("")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects readers built from ARCHITECTURE.md's byte tables: layouts change only together with LAYOUT_VERSION.
    #[test]
    fn layouts_have_the_documented_sizes_and_offsets() {
        assert_eq!(size_of::<FrameHeader>(), 40);
        assert_eq!(std::mem::offset_of!(FrameHeader, sequence), 16);
        assert_eq!(size_of::<Feature>(), 104);
        assert_eq!(std::mem::offset_of!(Feature, area_px2), 48);
        assert_eq!(std::mem::offset_of!(Feature, triangle_px), 56);
        assert_eq!(std::mem::offset_of!(Feature, framing), 80);
        assert_eq!(size_of::<Telemetry>(), 104);
        assert_eq!(std::mem::offset_of!(Telemetry, weights_id), 48);
        assert_eq!(std::mem::offset_of!(Telemetry, alpha_deg), 56);
        assert_eq!(size_of::<RecorderReport>(), 552);
    }

    /// Protects the controller from reading "nothing flows" out of a picture in which nothing could be seen: an area of 0 counts only
    /// without any doubt.
    #[test]
    fn nothing_seen_in_doubt_is_no_measurement() {
        for doubt in Doubt::ALL {
            assert_eq!(Doubt::from_code(doubt as u32), doubt);
            assert_eq!(doubt.usable(0.0), doubt == Doubt::None, "{doubt:?}");
            assert!(!doubt.usable(f32::NAN), "{doubt:?}");
            assert_eq!(doubt.usable(300.0), matches!(doubt, Doubt::None | Doubt::Blurred | Doubt::LeavesRegion), "{doubt:?}");
        }
    }

    /// Protects operators from a path that is cut within a character and so is no text any more.
    #[test]
    fn a_long_path_is_cut_at_a_character() {
        let long = "ä".repeat(400);
        let report = RecorderReport::new(RecorderState::Complete, 1, 2, 3, &long);
        assert_eq!(report.text(), "ä".repeat(256));
    }
}
