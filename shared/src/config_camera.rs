//! The table `[camera]` of the cell's configuration: where frames come from, and how a device is set.
//!
//! Plain data that every process reads once at its start, in an ordinary thread; it allocates. Values out of range are refused by [`crate::config`].

use serde::{Deserialize, Serialize};

use crate::config::{Check, ConfigError};

/// The highest rate of a camera, frames a second. Chosen by hand: what industrial cameras give at these sizes.
const FPS_MAX: f64 = 240.0;
/// Most frames for each tick of the loop: half of what a tick takes (`MAX_FEATURES` of the controller's core), so that a late tick loses none.
const FRAMES_A_TICK: f64 = 4.0;

/// The keys of `[camera]` that set a device's control to a number, and the least and the largest one that is taken. Chosen by hand: wider than those of
/// cameras, and without what another unit would give.
pub const SETTINGS: [(&str, [f64; 2]); 4] =
    [("exposure_ms", [0.01, 1000.0]), ("gain", [0.0, 1e6]), ("white_balance_k", [1000.0, 20_000.0]), ("focus", [0.0, 1e6])];

/// Where frames come from.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum CameraSource {
    /// A V4L2 device through OpenCV.
    Device,
    /// A video file through OpenCV.
    Video,
    /// An image sequence through OpenCV (`frame_%04d.png`).
    Images,
    /// Frames that another process publishes in the cell's shared memory (service `frame`).
    SharedMemory,
}

/// The table `[camera]`.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraConfig {
    /// Where frames come from.
    pub source: CameraSource,
    /// Device (`/dev/v4l/by-id/...`), video file or image pattern; empty for shared memory.
    #[serde(default)]
    pub path: String,
    /// Width in px.
    pub width_px: u32,
    /// Height in px.
    pub height_px: u32,
    /// Frames a second, 1 to 240, and at most four for each tick of the loop.
    pub fps: f64,
    /// Exposure time of a device, ms. This and what follows is set at the start and read back; without it, it is left alone.
    #[serde(default)]
    pub exposure_ms: Option<Setting>,
    /// Gain of a device, in its own numbers.
    #[serde(default)]
    pub gain: Option<Setting>,
    /// White balance of a device, K.
    #[serde(default)]
    pub white_balance_k: Option<Setting>,
    /// Focus of a device, in its own numbers.
    #[serde(default)]
    pub focus: Option<Setting>,
    /// The mains' frequency, against which a device's exposure is timed, Hz: 50, 60, or 0 for light that does not flicker.
    #[serde(default)]
    pub mains_hz: Option<Setting>,
    /// What it means that the device refuses one of these.
    #[serde(default)]
    pub refused: Refused,
}

impl Default for CameraConfig {
    /// Frames of 640 x 480 px at 30 Hz from shared memory.
    fn default() -> Self {
        Self {
            source: CameraSource::SharedMemory,
            path: String::new(),
            width_px: 640,
            height_px: 480,
            fps: 30.0,
            exposure_ms: None,
            gain: None,
            white_balance_k: None,
            focus: None,
            mains_hz: None,
            refused: Refused::Error,
        }
    }
}

/// How a setting of a device is set.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum Setting {
    /// To this value; its automatic is switched off.
    Value(f64),
    /// To what it is at the start; its automatic is switched off.
    Locked(Locked),
}

/// The word "locked".
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
#[allow(missing_docs)]
pub enum Locked {
    Locked,
}

/// What it means that a device refuses a setting.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Refused {
    /// The worker does not start.
    #[default]
    Error,
    /// The worker says so and starts.
    Warning,
}

impl Check<'_> {
    /// Checks the table for a loop of `rate_hz`.
    pub(crate) fn camera(&self, camera: &CameraConfig, rate_hz: f64) -> Result<(), ConfigError> {
        self.range("camera.width_px", camera.width_px.into(), 64.0, 4096.0)?;
        self.range("camera.height_px", camera.height_px.into(), 64.0, 4096.0)?;
        let most_fps = FPS_MAX.min(FRAMES_A_TICK * rate_hz);
        let allowed = format!("1 to {FPS_MAX}, and at most {FRAMES_A_TICK} for each tick of controller.rate_hz");
        self.rule("camera.fps", &camera.fps.to_string(), (1.0..=most_fps).contains(&camera.fps), &allowed)?;
        let settings = [camera.exposure_ms, camera.gain, camera.white_balance_k, camera.focus];
        for ((name, [low, high]), setting) in SETTINGS.into_iter().zip(settings) {
            if let Some(Setting::Value(value)) = setting {
                self.range(&format!("camera.{name}"), value, low, high)?;
            }
        }
        if let Some(Setting::Value(value)) = camera.mains_hz {
            self.rule("camera.mains_hz", &value.to_string(), [0.0, 50.0, 60.0].contains(&value), "50, 60, 0 (off) or \"locked\"")?;
        }
        let needs_path = camera.source != CameraSource::SharedMemory;
        self.rule(
            "camera.path",
            &camera.path,
            !needs_path || !camera.path.is_empty(),
            "a device, file or pattern (only source = \"shared-memory\" has none)",
        )
    }
}
