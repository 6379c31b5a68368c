//! Frames through OpenCV: a V4L2 device, a video file or an image sequence.
//!
//! Called from the thread that measures. OpenCV decodes into one matrix that is reused. A device is read at the size and the rate that
//! are configured, or it is refused. A file is played at its own speed or as fast as it can be read.

use std::time::Duration;

use opencv::core::{CV_8UC1, CV_8UC3, Mat};
use opencv::prelude::*;
use opencv::videoio::{self, VideoCapture};
use shared::config::{CameraConfig, CameraSource};
use shared::messages::{FrameHeader, LAYOUT_VERSION, PixelFormat};
use shared::os;

use super::frame::{Frame, FrameSource, NextFrame, SourceError};

/// Buffers that a device may fill ahead: the least that V4L2 drivers take, so that the frame read is the newest one.
const DEVICE_BUFFERS: f64 = 2.0;
/// A device's rate may differ from the configured one by this share. Chosen by hand: real cameras are within 1 %.
const RATE_TOLERANCE: f64 = 0.02;
/// A frame may be late by a half plus this share of a period before it counts as the one after a lost frame. A busy kernel stamps a
/// frame late and never early, so three quarters of a period are still lateness. Chosen by hand; no measurement is recorded.
const LATENESS_SHARE: f64 = 0.25;
/// Share of a frame's lateness by which the next frame is expected later, since the camera itself may be a little slow. Chosen by hand;
/// no measurement is recorded.
const LATENESS_FOLLOWED: f64 = 0.05;
/// The most frame numbers that one step may skip. It bounds the number that a nonsense timestamp can give.
const MOST_PERIODS: f64 = 1e6;

/// Numbers and dates frames by the device's timestamps. A lost frame then leaves a gap in the numbers, and a frame that waited in the
/// driver keeps its age.
#[derive(Debug, Clone, Copy)]
pub struct Numbering {
    sequence: u64,
    /// When the last frame was due, judged by the frames before it; ms of the device's clock.
    due_ms: Option<f64>,
    last_ns: u64,
    period_ms: f64,
}

impl Numbering {
    /// The numbering for a camera with `fps` frames a second that was opened at `opened_ns`.
    pub fn new(fps: f64, opened_ns: u64) -> Self {
        Self { sequence: 0, due_ms: None, last_ns: opened_ns, period_ms: 1e3 / fps }
    }

    /// Number and time (CLOCK_MONOTONIC ns) of a frame that was read at `now_ns` and that the device stamped with `at_ms`. A frame
    /// without a timestamp is the one after the last, taken now.
    pub fn next(&mut self, at_ms: Option<f64>, now_ns: u64) -> (u64, u64) {
        let mut periods = 1;
        self.due_ms = match (self.due_ms, at_ms) {
            (Some(last), Some(at)) => {
                periods = ((at - last) / self.period_ms - LATENESS_SHARE).round().clamp(1.0, MOST_PERIODS) as u64;
                let due = last + periods as f64 * self.period_ms;
                // The expectation follows an early frame at once and a late one slowly.
                Some(due + (at - due).min((at - due) * LATENESS_FOLLOWED))
            }
            _ => at_ms,
        };
        self.sequence += periods;
        // Drivers stamp with CLOCK_MONOTONIC. A time from another clock lies in the future, or before the last frame or the opening.
        let at_ns = at_ms.map(|ms| (ms * 1e6) as u64);
        self.last_ns = at_ns.filter(|at| (self.last_ns + 1..=now_ns).contains(at)).unwrap_or(now_ns);
        (self.sequence, self.last_ns)
    }
}

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

/// A device, a video or an image sequence that OpenCV reads.
pub struct Capture {
    capture: VideoCapture,
    camera: CameraConfig,
    picture: Mat,
    numbering: Numbering,
    /// When the next frame of a file is due, ns; `None` for a device and for a file that is read as fast as possible.
    due_ns: Option<u64>,
    period_ns: u64,
}

impl Capture {
    /// Opens a device, a video or an image sequence. With `real_time` a file is played at its own speed, otherwise as fast as it can be
    /// read.
    pub fn open(camera: &CameraConfig, real_time: bool) -> Result<Self, SourceError> {
        let fail = |what: &str| SourceError::Open { path: camera.path.clone(), what: what.into() };
        let device = camera.source == CameraSource::Device;
        if camera.source != CameraSource::Images && !std::path::Path::new(&camera.path).exists() {
            return Err(fail(if device { "no such device; see `ls /dev/v4l/by-id`" } else { "no such file" }));
        }
        let backend = match camera.source {
            CameraSource::Device => videoio::CAP_V4L2,
            CameraSource::Images => videoio::CAP_IMAGES,
            _ => videoio::CAP_ANY,
        };
        let mut capture = VideoCapture::from_file(&camera.path, backend).map_err(|e| fail(&format!("cannot be opened: {}", e.message)))?;
        if !capture.is_opened()? {
            return Err(match camera.source {
                CameraSource::Device => SourceError::Busy(camera.path.clone()),
                CameraSource::Images => fail("no first image; give a pattern such as frames/frame_%04d.png that starts at 0 or 1"),
                _ => fail("is no video that OpenCV can read, or it is truncated"),
            });
        }
        // OpenCV takes raw pictures where it can. Many cameras give a large size at the full rate only as MJPEG.
        if device && let Err(raw) = set_mode(&mut capture, camera) {
            let mjpeg = videoio::VideoWriter::fourcc('M', 'J', 'P', 'G')?;
            let _ = capture.set(videoio::CAP_PROP_FOURCC, f64::from(mjpeg))?;
            set_mode(&mut capture, camera).map_err(|_| raw)?;
        }
        let own_fps = capture.get(videoio::CAP_PROP_FPS)?;
        let fps = if camera.source == CameraSource::Video && own_fps > 0.0 { own_fps } else { camera.fps };
        let numbering = Numbering::new(fps, os::now_ns());
        let due_ns = (!device && real_time).then(os::now_ns);
        Ok(Self { capture, camera: camera.clone(), picture: Mat::default(), numbering, due_ns, period_ns: (1e9 / fps) as u64 })
    }

    /// Waits until the next frame of a file is due, at most for `timeout`. Returns whether it is due.
    fn wait_until_due(&mut self, timeout: Duration) -> bool {
        let Some(due_ns) = self.due_ns else { return true };
        let now_ns = os::now_ns();
        let latest_ns = now_ns + timeout.as_nanos() as u64;
        if due_ns > latest_ns {
            os::sleep_until_ns(latest_ns);
            return false;
        }
        os::sleep_until_ns(due_ns);
        // A file that is read too slowly plays slower. It never catches up in a burst.
        self.due_ns = Some(due_ns.max(now_ns.saturating_sub(self.period_ns)) + self.period_ns);
        true
    }

    /// What it means that no picture could be read. `grabbed` tells whether the source gave something, which then could not be decoded.
    fn without_picture(&self, grabbed: bool) -> Result<NextFrame<'static>, SourceError> {
        match self.camera.source {
            // A damaged MJPEG picture is left out, and the next frame's number shows the gap. (OpenCV 4.6 repeats the last picture
            // instead.)
            CameraSource::Device if grabbed => Ok(NextFrame::Nothing),
            CameraSource::Device => Err(SourceError::Lost(self.camera.path.clone())),
            _ if self.numbering.sequence == 0 => Err(SourceError::Open {
                path: self.camera.path.clone(),
                what: "holds no frame that can be decoded; is it truncated?".into(),
            }),
            _ => Ok(NextFrame::End),
        }
    }
}

impl FrameSource for Capture {
    fn next_frame(&mut self, timeout: Duration) -> Result<NextFrame<'_>, SourceError> {
        if !self.wait_until_due(timeout) {
            return Ok(NextFrame::Nothing);
        }
        // OpenCV's decoder reports a damaged picture in the middle of a file as an error, but the end of a file is not an error.
        let grabbed = self.capture.grab().unwrap_or(false);
        let read = grabbed && self.capture.retrieve_def(&mut self.picture).unwrap_or(false);
        let now_ns = os::now_ns();
        if !read || self.picture.empty() {
            return self.without_picture(grabbed);
        }
        // The driver stamps each buffer when it is filled, so a frame that is read late or decoded slowly still has its own time.
        let stamp_ms = match self.camera.source {
            CameraSource::Device => Some(self.capture.get(videoio::CAP_PROP_POS_MSEC)?).filter(|ms| *ms > 0.0),
            _ => None,
        };
        let (sequence, captured_at_ns) = self.numbering.next(stamp_ms, now_ns);
        let format = match self.picture.typ() {
            CV_8UC3 => PixelFormat::Bgr8,
            CV_8UC1 => PixelFormat::Mono8,
            other => {
                let what = format!("gives pixels of OpenCV type {other}; only 8-bit grey and colour are read");
                return Err(SourceError::Open { path: self.camera.path.clone(), what });
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
