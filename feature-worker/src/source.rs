//! Where frames come from: a V4L2 device, the cell's shared memory, or a recording (a video, an image sequence, an episode).
//!
//! Called from the thread that measures. Shared memory is read where it lies, and OpenCV reuses one matrix, so a frame allocates
//! nothing. Every failure is a [`SourceError`] that says what to do, also for a camera that is unplugged, a truncated file and frames
//! that change their size. Only one process can stream from a device, so a program that runs beside the worker reads the worker's
//! frames instead: that is the [`ObserverSource`].

use std::time::Duration;

use iceoryx2::service::port_factory::PortFactory as _;
use shared::config::{CameraConfig, CameraSource};
use shared::ipc::{Cell, FrameTopic};

mod about_picture;
mod capture;
mod container;
pub mod controls;
pub mod devices;
mod files;
mod frame;
mod jpeg;
mod jpeg_codes;
mod numbering;
mod pictures;
mod playback;
mod recorded;
mod recording;
mod rhythm;
mod shared_memory;
mod video;

pub use capture::{Capture, check_rate};
pub use files::{Contents, for_each_frame};
pub use frame::{Frame, FrameSource, FrameStream, NextFrame, SILENT_NS, SourceError, StreamEvent, WAIT};
pub use numbering::Numbering;
pub(crate) use pictures::check_size;
pub use playback::Playback;
pub use recording::Recording;
pub use shared_memory::SharedMemory;

/// The source that `[camera]` configures.
pub enum Source {
    /// Another process publishes the frames.
    SharedMemory(Box<SharedMemory>),
    /// OpenCV captures the frames of a device.
    Capture(Box<Capture>),
    /// A recording is played.
    Playback(Box<Playback>),
}

impl Source {
    /// Opens the source of `camera`; shared memory is that of `cell`. A video or a sequence is played at its own speed.
    pub fn open(camera: &CameraConfig, cell: &Cell) -> Result<Self, SourceError> {
        match camera.source {
            CameraSource::SharedMemory => Self::shared_memory(cell),
            CameraSource::Device => Ok(Self::Capture(Box::new(Capture::open(camera)?))),
            CameraSource::Video | CameraSource::Images => Ok(Self::Playback(Box::new(Playback::open(camera)?))),
        }
    }

    fn shared_memory(cell: &Cell) -> Result<Self, SourceError> {
        Ok(Self::SharedMemory(Box::new(SharedMemory::open(cell)?)))
    }
}

impl FrameSource for Source {
    fn next_frame(&mut self, timeout: Duration) -> Result<NextFrame<'_>, SourceError> {
        match self {
            Self::SharedMemory(shared) => shared.next_frame(timeout),
            Self::Capture(capture) => capture.next_frame(timeout),
            Self::Playback(playback) => playback.next_frame(timeout),
        }
    }
}

/// The camera for a program that only watches (`view`, `calibrate`).
///
/// It reads the frames of the cell's worker when one runs, and opens the camera itself when none does. As soon as a worker starts it
/// leaves the camera to the worker and reads the worker's frames. When that worker ends it waits for the next one, so a worker that
/// starts again never finds its camera taken.
pub struct ObserverSource<'a> {
    source: Source,
    cell: &'a Cell,
    topic: FrameTopic,
}

impl<'a> ObserverSource<'a> {
    /// Opens the worker's frames or the camera of `camera`.
    pub fn open(camera: &CameraConfig, cell: &'a Cell) -> Result<Self, SourceError> {
        let topic = cell.frames()?;
        let source = if has_publisher(&topic) { Source::shared_memory(cell)? } else { Source::open(camera, cell)? };
        Ok(Self { source, cell, topic })
    }
}

impl FrameSource for ObserverSource<'_> {
    fn next_frame(&mut self, timeout: Duration) -> Result<NextFrame<'_>, SourceError> {
        if !matches!(self.source, Source::SharedMemory(_)) && has_publisher(&self.topic) {
            eprintln!("feature-worker: a worker starts in this cell; it gets the camera, and its frames are taken from now on");
            self.source = Source::shared_memory(self.cell)?;
        }
        self.source.next_frame(timeout)
    }
}

/// Whether a process publishes frames. A process that was killed counts until the next process joins the cell.
fn has_publisher(topic: &FrameTopic) -> bool {
    topic.dynamic_config().number_of_publishers() > 0
}
