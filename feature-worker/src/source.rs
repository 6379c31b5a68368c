//! Frames from a V4L2 device, a video file, an image sequence (all through OpenCV) or the cell's shared memory.
//!
//! Called from the extraction thread only; [`Source::next`] waits at most the given time (a device: until a frame, a signal or
//! OpenCV's 10 s). Shared memory is read where it lies; OpenCV's captures reuse one matrix. Every failure is a [`SourceError`] that
//! says what to do, also for a camera that is unplugged, a truncated file and frames that change their size. Only one process can stream
//! from a device, so who looks on beside the worker ([`Onlooker`]) takes the worker's frames.

use std::time::Duration;

use iceoryx2::port::listener::ListenerWaitError;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::sample::Sample;
use iceoryx2::service::port_factory::PortFactory as _;
use opencv::core::{CV_8UC1, CV_8UC3, Mat};
use opencv::prelude::*;
use opencv::videoio::{self, VideoCapture};
use shared::config::{CameraConfig, CameraSource};
use shared::ipc::{Cell, FrameListener, FrameTopic, IpcError};
use shared::messages::{FrameHeader, LAYOUT_VERSION, PixelFormat};
use shared::os;

/// Why there are no frames.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// The device, video or first image cannot be opened.
    #[error("camera.path = \"{path}\": {what}")]
    Open {
        /// `[camera] path`.
        path: String,
        /// What is wrong and what to do.
        what: String,
    },
    /// The device is there and cannot be used.
    #[error("camera.path = \"{0}\": cannot be opened; does another program use it, and may this user read it (group 'video')?")]
    Busy(String),
    /// The device does not have the size configured.
    #[error(
        "camera.width_px, camera.height_px = {} x {}: the camera gives {} x {} instead; write these and calibrate, or choose a size of \
         `v4l2-ctl --list-formats-ext`",
        configured.0, configured.1, device.0, device.1
    )]
    Size {
        /// `[camera] width_px` and `height_px`.
        configured: (u32, u32),
        /// What the device says.
        device: (u32, u32),
    },
    /// The device gives another rate than configured.
    #[error(
        "camera.fps = {configured}: the camera gives {device} frames a second at this size; write camera.fps = {device}, or choose a size \
         and rate of `v4l2-ctl --list-formats-ext`"
    )]
    Rate {
        /// `[camera] fps`.
        configured: f64,
        /// What the device says.
        device: f64,
    },
    /// The camera gave no picture any more.
    #[error("camera \"{0}\" gives no more frames; is it unplugged? Plug it in and start again")]
    Lost(String),
    /// The cell's shared memory.
    #[error(transparent)]
    Ipc(#[from] IpcError),
    /// The frame service works no longer.
    #[error("shared memory of service 'frame': {0}; restart the camera driver and the feature worker")]
    Broken(String),
    /// OpenCV refused.
    #[error("OpenCV: {0}")]
    OpenCv(#[from] opencv::Error),
}

/// One frame, as the source holds it until the next call.
#[derive(Debug, Clone, Copy)]
pub struct Frame<'a> {
    /// Its description.
    pub header: FrameHeader,
    /// Its pixels, row by row without padding.
    pub pixels: &'a [u8],
}

/// What [`Source::next`] found.
#[derive(Debug)]
pub enum Next<'a> {
    /// A frame.
    Frame(Frame<'a>),
    /// None came in time.
    Nothing,
    /// The video or the sequence is over.
    End,
}

type Ipc = iceoryx2::service::ipc::Service;

/// A stream of frames.
pub enum Source {
    /// Another process publishes them.
    Shared(Box<Shared>),
    /// OpenCV captures them.
    Capture(Box<Capture>),
}

/// Frames in shared memory.
pub struct Shared {
    sample: Option<Sample<Ipc, [u8], FrameHeader>>,
    subscriber: Subscriber<Ipc, [u8], FrameHeader>,
    listener: FrameListener,
    // Kept open, so that a driver that restarts finds the same service.
    _topic: FrameTopic,
}

/// Numbers and dates frames by the device's timestamps, so that a lost one leaves a gap and one that waited in the driver is old.
#[derive(Debug, Clone, Copy)]
pub struct Numbering {
    sequence: u64,
    /// When the last frame was due by the frames before it.
    due_ms: Option<f64>,
    last_ns: u64,
    period_ms: f64,
}

impl Numbering {
    /// For a camera with `fps` frames a second that was opened at `opened_ns`.
    pub fn new(fps: f64, opened_ns: u64) -> Self {
        Self { sequence: 0, due_ms: None, last_ns: opened_ns, period_ms: 1e3 / fps }
    }

    /// Number and time, CLOCK_MONOTONIC ns, of a frame that was read at `now_ns`, with the device's timestamp `at_ms`. Without a
    /// timestamp it is the one after the last, of now.
    pub fn next(&mut self, at_ms: Option<f64>, now_ns: u64) -> (u64, u64) {
        let mut periods = 1;
        self.due_ms = match (self.due_ms, at_ms) {
            (Some(last), Some(at)) => {
                // A busy kernel stamps a frame late, never early. So three quarters of a period count as late, not as a lost frame, and
                // when the next ones are due follows early ones at once, late ones slowly (the camera may be a little slow itself).
                periods = ((at - last) / self.period_ms - 0.25).round().clamp(1.0, 1e6) as u64;
                let due = last + periods as f64 * self.period_ms;
                Some(due + (at - due).min((at - due) * 0.05))
            }
            _ => at_ms,
        };
        self.sequence += periods;
        // Drivers stamp with CLOCK_MONOTONIC; one with another clock is after now, or before the last frame or the opening.
        let at_ns = at_ms.map(|ms| (ms * 1e6) as u64);
        self.last_ns = at_ns.filter(|at| (self.last_ns + 1..=now_ns).contains(at)).unwrap_or(now_ns);
        (self.sequence, self.last_ns)
    }
}

/// A device that gives another rate than configured would make every gap between frames look like loss. `device`: 0 or less when
/// it does not tell.
pub fn check_rate(configured: f64, device: f64) -> Result<(), SourceError> {
    if device > 0.0 && (device / configured - 1.0).abs() > 0.02 {
        return Err(SourceError::Rate { configured, device });
    }
    Ok(())
}

/// Sets a device's size and rate; refuses it if it took others.
fn set_mode(capture: &mut VideoCapture, camera: &CameraConfig) -> Result<(), SourceError> {
    for (property, value) in [
        (videoio::CAP_PROP_FRAME_WIDTH, f64::from(camera.width_px)),
        (videoio::CAP_PROP_FRAME_HEIGHT, f64::from(camera.height_px)),
        // The newest frame, not the oldest.
        (videoio::CAP_PROP_BUFFERSIZE, 2.0),
        // Last: with each of the others OpenCV starts the device anew and spoils a rate that is no whole number.
        (videoio::CAP_PROP_FPS, camera.fps),
    ] {
        // A driver may refuse a property; what counts is what it then gives.
        let _ = capture.set(property, value)?;
    }
    let configured = (camera.width_px, camera.height_px);
    let device = (capture.get(videoio::CAP_PROP_FRAME_WIDTH)? as u32, capture.get(videoio::CAP_PROP_FRAME_HEIGHT)? as u32);
    if device != configured {
        return Err(SourceError::Size { configured, device });
    }
    check_rate(camera.fps, capture.get(videoio::CAP_PROP_FPS)?)
}

/// Frames through OpenCV.
pub struct Capture {
    capture: VideoCapture,
    camera: CameraConfig,
    image: Mat,
    numbering: Numbering,
    /// Files: when the next frame is due, if they are played at their own speed.
    due_ns: Option<u64>,
    period_ns: u64,
}

impl Source {
    /// Opens the source of `camera`; shared memory is that of `cell`. A video or sequence is played at its own speed.
    pub fn open(camera: &CameraConfig, cell: &Cell) -> Result<Self, SourceError> {
        match camera.source {
            CameraSource::SharedMemory => Self::shared(cell),
            _ => Ok(Self::Capture(Box::new(Capture::open(camera, true)?))),
        }
    }

    fn shared(cell: &Cell) -> Result<Self, SourceError> {
        let topic = cell.frames()?;
        let subscriber = topic
            .subscriber_builder()
            .create()
            .map_err(|e| SourceError::Broken(format!("{e:?} (at most 4 readers: is a second feature worker or view running?)")))?;
        Ok(Self::Shared(Box::new(Shared { sample: None, subscriber, listener: cell.frame_listener()?, _topic: topic })))
    }

    /// The next frame; waits up to `timeout`.
    pub fn next(&mut self, timeout: Duration) -> Result<Next<'_>, SourceError> {
        match self {
            Self::Shared(shared) => shared.next(timeout),
            Self::Capture(capture) => capture.next(timeout),
        }
    }
}

/// The camera for who looks on: the frames of the cell's worker when one runs, or else the camera itself. A worker that starts gets the
/// camera, and its frames are taken from then on. One that ends is waited for: a worker that starts again never finds its camera taken.
pub struct Onlooker<'a> {
    source: Source,
    cell: &'a Cell,
    topic: FrameTopic,
}

impl<'a> Onlooker<'a> {
    /// Opens whichever there is.
    pub fn open(camera: &CameraConfig, cell: &'a Cell) -> Result<Self, SourceError> {
        let topic = cell.frames()?;
        let source = if published(&topic) { Source::shared(cell)? } else { Source::open(camera, cell)? };
        Ok(Self { source, cell, topic })
    }

    /// The next frame; waits as [`Source::next`] does.
    pub fn next(&mut self, timeout: Duration) -> Result<Next<'_>, SourceError> {
        if matches!(self.source, Source::Capture(_)) && published(&self.topic) {
            eprintln!("feature-worker: a worker starts in this cell; it gets the camera, and its frames are taken from now on");
            self.source = Source::shared(self.cell)?;
        }
        self.source.next(timeout)
    }
}

/// Whether a process publishes frames. One that was killed counts until the next process joins the cell.
fn published(topic: &FrameTopic) -> bool {
    topic.dynamic_config().number_of_publishers() > 0
}

impl Shared {
    fn next(&mut self, timeout: Duration) -> Result<Next<'_>, SourceError> {
        let broken = |e: &dyn std::fmt::Debug| SourceError::Broken(format!("{e:?}"));
        self.sample = None;
        self.sample = self.subscriber.receive().map_err(|e| broken(&e))?;
        if self.sample.is_none() {
            match self.listener.timed_wait(|_| {}, timeout) {
                // A signal cuts the wait short, also one that only continues a stopped process: the caller looks whether to end.
                Ok(_) | Err(ListenerWaitError::InterruptSignal) => {}
                Err(e) => return Err(broken(&e)),
            }
            self.sample = self.subscriber.receive().map_err(|e| broken(&e))?;
        }
        Ok(match &self.sample {
            Some(sample) => Next::Frame(Frame { header: *sample.user_header(), pixels: sample.payload() }),
            None => Next::Nothing,
        })
    }
}

impl Capture {
    /// Opens a device, video or image sequence. A video or sequence is played at its own speed when `real_time`, else as fast as it
    /// is read.
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
        // OpenCV takes raw pictures where it can. Many cameras give a large size at full rate only as MJPEG.
        if device && let Err(raw) = set_mode(&mut capture, camera) {
            let mjpeg = videoio::VideoWriter::fourcc('M', 'J', 'P', 'G')?;
            let _ = capture.set(videoio::CAP_PROP_FOURCC, f64::from(mjpeg))?;
            set_mode(&mut capture, camera).map_err(|_| raw)?;
        }
        let own_fps = capture.get(videoio::CAP_PROP_FPS)?;
        let fps = if camera.source == CameraSource::Video && own_fps > 0.0 { own_fps } else { camera.fps };
        let numbering = Numbering::new(fps, os::now_ns());
        let due_ns = (!device && real_time).then(os::now_ns);
        Ok(Self { capture, camera: camera.clone(), image: Mat::default(), numbering, due_ns, period_ns: (1e9 / fps) as u64 })
    }

    /// The next frame; waits up to `timeout` (a device: until a frame, a signal or OpenCV's 10 s).
    pub fn next(&mut self, timeout: Duration) -> Result<Next<'_>, SourceError> {
        if let Some(due_ns) = self.due_ns {
            let now_ns = os::now_ns();
            let latest_ns = now_ns + timeout.as_nanos() as u64;
            if due_ns > latest_ns {
                os::sleep_until_ns(latest_ns);
                return Ok(Next::Nothing);
            }
            os::sleep_until_ns(due_ns);
            // A file that is read too slowly plays slower; it never bursts.
            self.due_ns = Some(due_ns.max(now_ns.saturating_sub(self.period_ns)) + self.period_ns);
        }
        // A damaged picture in the middle is an error of the decoder; the end of a file is not.
        let grabbed = self.capture.grab().unwrap_or(false);
        let read = grabbed && self.capture.retrieve_def(&mut self.image).unwrap_or(false);
        let now_ns = os::now_ns();
        if !read || self.image.empty() {
            return match self.camera.source {
                // A damaged MJPEG picture: the next one's number shows the gap. (OpenCV 4.6 repeats the last picture instead.)
                CameraSource::Device if grabbed => Ok(Next::Nothing),
                CameraSource::Device => Err(SourceError::Lost(self.camera.path.clone())),
                _ if self.numbering.sequence == 0 => Err(SourceError::Open {
                    path: self.camera.path.clone(),
                    what: "holds no frame that can be decoded; is it truncated?".into(),
                }),
                _ => Ok(Next::End),
            };
        }
        // The driver stamps each buffer when it is filled, so also one that is read late, or decoded slowly, has its own time.
        let stamp_ms = match self.camera.source {
            CameraSource::Device => Some(self.capture.get(videoio::CAP_PROP_POS_MSEC)?).filter(|ms| *ms > 0.0),
            _ => None,
        };
        let (sequence, captured_at_ns) = self.numbering.next(stamp_ms, now_ns);
        let format = match self.image.typ() {
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
            width_px: self.image.cols() as u32,
            height_px: self.image.rows() as u32,
            sequence,
            captured_at_ns,
            published_at_ns: now_ns,
        };
        Ok(Next::Frame(Frame { header, pixels: self.image.data_bytes()? }))
    }
}
