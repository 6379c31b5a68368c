//! What a source of frames gives, why it cannot, and how a thread waits for it.
//!
//! Nothing here allocates but the error texts. A [`FrameStream`] runs in the thread that measures. Its waits last at most [`WAIT`], so
//! that a request to stop is seen soon. On a device a wait lasts until a frame or a signal comes, or until OpenCV's own limit.

use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration;

use shared::exit;
use shared::ipc::IpcError;
use shared::messages::FrameHeader;
use shared::os;

/// How long one wait for a frame lasts. Chosen by hand: a request to stop or a silent camera is noticed within a tenth of a second.
pub const WAIT: Duration = Duration::from_millis(100);
/// A source without a frame for this long is reported as silent, ns. Chosen by hand: thirty frames of a 30 Hz camera.
pub const SILENT_NS: u64 = 1_000_000_000;

/// Why there are no frames.
#[derive(Debug, thiserror::Error)]
pub enum SourceError {
    /// The device cannot be opened.
    #[error("camera.path = \"{path}\": {what}")]
    Open {
        /// `[camera] path`.
        path: String,
        /// What is wrong and what to do.
        what: String,
    },
    /// A recording cannot be read.
    #[error("{path}: {what}")]
    File {
        /// The recording.
        path: String,
        /// What is wrong and what to do.
        what: String,
    },
    /// There is no such device.
    #[error(
        "camera.path = \"{0}\": no such device; is it unplugged? `feature-worker camera` lists what there is, and /dev/v4l/by-id lasts"
    )]
    Missing(String),
    /// This user may not open the device.
    #[error(
        "camera.path = \"{path}\": permission denied; it belongs to group '{group}': run `sudo usermod -aG {group} $USER`, then log in again"
    )]
    Permission {
        /// `[camera] path`.
        path: String,
        /// The group that may open it.
        group: String,
    },
    /// Another program uses the device.
    #[error("camera.path = \"{path}\": another program streams from it; end that program first. {users}")]
    Busy {
        /// `[camera] path`.
        path: String,
        /// The programs that have it open, as far as this user sees them.
        users: String,
    },
    /// The node gives a camera's metadata and no pictures.
    #[error("camera.path = \"{0}\": this is the camera's metadata node and has no pictures; `feature-worker camera` shows the other one")]
    Metadata(String),
    /// The file is no device that gives pictures.
    #[error("camera.path = \"{0}\": this is no camera; `feature-worker camera` lists what there is")]
    NotACamera(String),
    /// The device's driver fails when it is opened.
    #[error("camera.path = \"{0}\": its driver cannot open it, and the kernel's log may say why; plug it in anew")]
    Failing(String),
    /// The device refuses settings.
    #[error("{0}; correct it, leave the key out, or write camera.refused = \"warning\"")]
    Refused(String),
    /// The device does not have the configured size.
    #[error(
        "camera.width_px, camera.height_px = {} x {}: the camera gives {} x {} instead; write these and calibrate, or choose a size of \
         `v4l2-ctl --list-formats-ext`",
        configured.0, configured.1, device.0, device.1
    )]
    Size {
        /// `[camera] width_px` and `height_px`.
        configured: (u32, u32),
        /// The size that the device reports, px.
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
        /// The rate that the device reports, frames a second.
        device: f64,
    },
    /// A recording that is played has another rate than configured.
    #[error("{path}: it has {own:.2} frames a second, but camera.fps = {configured}; write camera.fps = {own:.2}")]
    FileRate {
        /// The recording.
        path: String,
        /// `[camera] fps`.
        configured: f64,
        /// The recording's mean rate, frames a second.
        own: f64,
    },
    /// Something is missing in a recording.
    #[error("{path}: {what}; give a whole recording (inspect, calibrate and bench take what is there with --partial)")]
    Incomplete {
        /// The recording.
        path: String,
        /// What is missing, and where.
        what: String,
    },
    /// The camera has stopped giving pictures.
    #[error("camera \"{0}\" gives no more frames; is it unplugged? Plug it in and start again")]
    Lost(String),
    /// The camera has stopped giving pictures and is there.
    #[error(
        "camera \"{0}\" gives no more frames, and is not unplugged: its driver has failed, and the kernel's log may say why; start again"
    )]
    Failed(String),
    /// The cell's shared memory cannot be used.
    #[error(transparent)]
    Ipc(#[from] IpcError),
    /// The frame service has stopped working.
    #[error("shared memory of service 'frame': {0}; restart the camera driver and the feature worker")]
    Broken(String),
    /// OpenCV refused a call.
    #[error("OpenCV: {0}")]
    OpenCv(#[from] opencv::Error),
}

impl SourceError {
    /// The exit code that fits: bad input where a person must change something, else unreachable.
    pub fn exit_code(&self) -> u8 {
        match self {
            Self::Missing(_) | Self::Busy { .. } | Self::Failing(_) | Self::Lost(_) | Self::Failed(_) => exit::UNREACHABLE,
            Self::Ipc(_) | Self::Broken(_) | Self::OpenCv(_) => exit::UNREACHABLE,
            _ => exit::BAD_INPUT,
        }
    }
}

/// One camera picture with its header. The source owns the pixels until its next call.
#[derive(Debug, Clone, Copy)]
pub struct Frame<'a> {
    /// Size, format, number and times of the picture.
    pub header: FrameHeader,
    /// The pixels, row by row without padding.
    pub pixels: &'a [u8],
}

/// The answer of a source to one wait.
#[derive(Debug)]
pub enum NextFrame<'a> {
    /// A frame came.
    Frame(Frame<'a>),
    /// No frame came in time.
    Nothing,
    /// The video or the image sequence is over.
    End,
}

/// Anything that gives one frame after the other.
pub trait FrameSource {
    /// The next frame. Waits up to `timeout`; a device waits until a frame, a signal or OpenCV's own limit of 10 s.
    fn next_frame(&mut self, timeout: Duration) -> Result<NextFrame<'_>, SourceError>;
}

/// What a [`FrameStream`] reports after one wait.
#[derive(Debug)]
pub enum StreamEvent<'a> {
    /// A frame came.
    Frame(Frame<'a>),
    /// No frame came in time.
    Nothing,
    /// No frame has come for a second. This is said once each time that the frames stop.
    FellSilent,
    /// The video is over, or the process was asked to stop.
    End,
}

/// Frames from `source` until it ends or until somebody sets `stop`. Notices when the frames stay away.
pub struct FrameStream<'a, S> {
    source: S,
    stop: &'a AtomicBool,
    last_frame_ns: u64,
    silent: bool,
}

impl<'a, S: FrameSource> FrameStream<'a, S> {
    /// Starts to wait now.
    pub fn new(source: S, stop: &'a AtomicBool) -> Self {
        Self { source, stop, last_frame_ns: os::now_ns(), silent: false }
    }

    /// Waits for the next frame, at most for [`WAIT`].
    pub fn wait(&mut self) -> Result<StreamEvent<'_>, SourceError> {
        if self.stop.load(Relaxed) {
            return Ok(StreamEvent::End);
        }
        match self.source.next_frame(WAIT) {
            Ok(NextFrame::Frame(frame)) => {
                self.last_frame_ns = os::now_ns();
                self.silent = false;
                Ok(StreamEvent::Frame(frame))
            }
            Ok(NextFrame::Nothing) if !self.silent && os::now_ns() > self.last_frame_ns + SILENT_NS => {
                self.silent = true;
                Ok(StreamEvent::FellSilent)
            }
            Ok(NextFrame::Nothing) => Ok(StreamEvent::Nothing),
            Ok(NextFrame::End) => Ok(StreamEvent::End),
            // A signal to stop also cuts short the wait for a device, which then looks lost.
            Err(_) if self.stop.load(Relaxed) => Ok(StreamEvent::End),
            Err(e) => Err(e),
        }
    }
}
