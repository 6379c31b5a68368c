//! The table `[camera]` of the cell's configuration: where frames come from, and how a device is set.
//!
//! Plain data that every process reads once at its start, in an ordinary thread; it allocates. Values out of range are refused by [`crate::config`].

use serde::{Deserialize, Serialize};

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
    /// Frames a second.
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
