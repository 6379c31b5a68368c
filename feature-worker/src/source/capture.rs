//! Frames of a V4L2 device through OpenCV.
//!
//! Called from the thread that measures. OpenCV decodes into one matrix that is reused. A device is read at the size and the rate that
//! are configured, or it is refused. Where OpenCV fails, which does not tell why, the kernel is asked.

use std::fs::File;
use std::path::Path;
use std::time::{Duration, Instant};

use opencv::core::{CV_8UC1, CV_8UC3, Mat};
use opencv::prelude::*;
use opencv::videoio::{self, VideoCapture};
use shared::config::{CameraConfig, Refused};
use shared::level::Level;
use shared::messages::{FrameHeader, LAYOUT_VERSION, PixelFormat};
use shared::os;

use super::controls::{self, Found, SETTLE_MOST};
use super::devices;
use super::frame::{Frame, FrameSource, NextFrame, SourceError};
use super::numbering::Numbering;

/// Buffers that a device may fill ahead: the least that V4L2 drivers take, so that the frame read is the newest one.
const DEVICE_BUFFERS: f64 = 2.0;
/// A device's rate may differ from the configured one by this share. Chosen by hand: real cameras are within 1 %.
const RATE_TOLERANCE: f64 = 0.02;
/// Refuses a device that gives another rate than configured, because every gap between its frames would look like a lost frame.
/// `device` is 0 or less when the device does not report its rate.
pub fn check_rate(configured: f64, device: f64) -> Result<(), SourceError> {
    if device > 0.0 && (device / configured - 1.0).abs() > RATE_TOLERANCE {
        return Err(SourceError::Rate { configured, device });
    }
    Ok(())
}

/// Sets a device's size and rate, and refuses the device if it took others.
fn set_mode(capture: &mut VideoCapture, camera: &CameraConfig) -> Result<(), SourceError> {
    for (property, value) in [
        (videoio::CAP_PROP_FRAME_WIDTH, f64::from(camera.width_px)),
        (videoio::CAP_PROP_FRAME_HEIGHT, f64::from(camera.height_px)),
        (videoio::CAP_PROP_BUFFERSIZE, DEVICE_BUFFERS),
        // The rate comes last: with each of the others OpenCV starts the device anew and spoils a rate that is not a whole number.
        (videoio::CAP_PROP_FPS, camera.fps),
    ] {
        // A driver may refuse a property. What counts is the mode that it reports afterwards.
        let _ = capture.set(property, value)?;
    }
    let configured = (camera.width_px, camera.height_px);
    let device = (capture.get(videoio::CAP_PROP_FRAME_WIDTH)? as u32, capture.get(videoio::CAP_PROP_FRAME_HEIGHT)? as u32);
    if device != configured {
        return Err(SourceError::Size { configured, device });
    }
    check_rate(camera.fps, capture.get(videoio::CAP_PROP_FPS)?)
}

/// A device that OpenCV reads.
pub struct Capture {
    capture: VideoCapture,
    path: String,
    picture: Mat,
    numbering: Numbering,
}

impl Capture {
    /// Opens the device that `[camera]` names, at its size and rate, and its controls.
    fn start(camera: &CameraConfig) -> Result<(File, VideoCapture), SourceError> {
        let fail = |what: &str| SourceError::Open { path: camera.path.clone(), what: what.into() };
        // Before OpenCV, which does not tell why it cannot open a device.
        let device = devices::open(Path::new(&camera.path))?;
        let open = || {
            let opened = VideoCapture::from_file(&camera.path, videoio::CAP_V4L2);
            opened.map_err(|e| fail(&format!("cannot be opened: {}", e.message)))
        };
        let mut capture = open()?;
        if !capture.is_opened()? {
            devices::free(&device, Path::new("/"), Path::new(&camera.path))?;
            // Whoever had it may have let go of it since.
            capture = open()?;
        }
        if !capture.is_opened()? {
            return Err(fail("OpenCV cannot open it, and no other program streams from it; `feature-worker camera` shows its formats"));
        }
        // OpenCV takes raw pictures where it can. Many cameras give a large size at the full rate only as MJPEG.
        if let Err(raw) = set_mode(&mut capture, camera) {
            let mjpeg = videoio::VideoWriter::fourcc('M', 'J', 'P', 'G')?;
            let _ = capture.set(videoio::CAP_PROP_FOURCC, f64::from(mjpeg))?;
            set_mode(&mut capture, camera).map_err(|_| raw)?;
        }
        Ok((device, capture))
    }

    /// Takes a frame off the camera, which is not looked at.
    fn grab(capture: &mut VideoCapture, camera: &CameraConfig) -> Result<(), SourceError> {
        if capture.grab().unwrap_or(false) { Ok(()) } else { Err(Self::gone(&camera.path)) }
    }

    /// Why the device at `path` gives no more frames.
    fn gone(path: &str) -> SourceError {
        match devices::open(Path::new(path)) {
            Err(SourceError::Missing(_)) => SourceError::Lost(path.into()),
            _ => SourceError::Failed(path.into()),
        }
    }

    /// What the camera's automatics find in the light of now. It is set, with the automatics off. It takes [`SETTLE_MOST`].
    pub fn find(camera: &CameraConfig) -> Result<Found, SourceError> {
        let (mut device, mut capture) = Self::start(camera)?;
        let mains = controls::start_automatics(&mut device, camera);
        let begin = Instant::now();
        while begin.elapsed() < SETTLE_MOST {
            Self::grab(&mut capture, camera)?;
        }
        let mut found = controls::keep_found(&mut device);
        // Nothing is written of what was configured already, and so only a refusal is told.
        found.outcome.refused.extend(mains.refused);
        Ok(found)
    }

    /// Opens the device that `[camera]` names.
    pub fn open(camera: &CameraConfig) -> Result<Self, SourceError> {
        // Controls come after the mode: some drivers start anew with it.
        let (mut device, mut capture) = Self::start(camera)?;
        controls::start_locked(&mut device, camera);
        if !controls::settle(&device, camera, SETTLE_MOST, || Self::grab(&mut capture, camera))? {
            let line = "camera: its automatics have not come to rest, and what they have now is locked";
            eprintln!("{}", Level::Warning.marked(line));
        }
        let outcome = controls::apply(&mut device, camera);
        outcome.said.iter().for_each(|line| eprintln!("{}", Level::Info.marked(&format!("camera: {line}"))));
        if !outcome.refused.is_empty() {
            match camera.refused {
                Refused::Error => return Err(SourceError::Refused(outcome.refused.join("; "))),
                Refused::Warning => {
                    outcome.refused.iter().for_each(|line| eprintln!("{}", Level::Warning.marked(&format!("camera: warning: {line}"))))
                }
            }
        }
        let numbering = Numbering::new(camera.fps, os::now_ns());
        Ok(Self { capture, path: camera.path.clone(), picture: Mat::default(), numbering })
    }
}

impl FrameSource for Capture {
    fn next_frame(&mut self, _timeout: Duration) -> Result<NextFrame<'_>, SourceError> {
        let grabbed = self.capture.grab().unwrap_or(false);
        let read = grabbed && self.capture.retrieve_def(&mut self.picture).unwrap_or(false);
        let now_ns = os::now_ns();
        if !grabbed {
            return Err(Self::gone(&self.path));
        }
        // A damaged MJPEG picture is left out, and the next frame's number shows the gap. (OpenCV 4.6 repeats the last picture instead.)
        if !read || self.picture.empty() {
            return Ok(NextFrame::Nothing);
        }
        // The driver stamps each buffer when it is filled, so a frame that is read late or decoded slowly still has its own time.
        let stamp_ms = Some(self.capture.get(videoio::CAP_PROP_POS_MSEC)?).filter(|ms| *ms > 0.0);
        let (sequence, captured_at_ns) = self.numbering.next(stamp_ms, now_ns);
        let format = match self.picture.typ() {
            CV_8UC3 => PixelFormat::Bgr8,
            CV_8UC1 => PixelFormat::Mono8,
            other => {
                let what = format!("gives pixels of OpenCV type {other}; only 8-bit grey and colour are read");
                return Err(SourceError::Open { path: self.path.clone(), what });
            }
        };
        let header = FrameHeader {
            version: LAYOUT_VERSION,
            format: format as u32,
            width_px: self.picture.cols() as u32,
            height_px: self.picture.rows() as u32,
            sequence,
            captured_at_ns,
            published_at_ns: now_ns,
        };
        Ok(NextFrame::Frame(Frame { header, pixels: self.picture.data_bytes()? }))
    }
}
