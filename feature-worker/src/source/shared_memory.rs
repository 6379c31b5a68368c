//! Frames that another process of the cell publishes in shared memory.
//!
//! Used by the thread that measures. The pixels are read where they lie, so nothing is copied or allocated for a frame. A driver that
//! stops is waited for: it finds the same service when it starts again.

use std::time::Duration;

use iceoryx2::port::listener::ListenerWaitError;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::sample::Sample;
use shared::ipc::{Cell, FrameListener, FrameTopic};
use shared::messages::FrameHeader;

use super::frame::{Frame, FrameSource, NextFrame, SourceError};

type Ipc = iceoryx2::service::ipc::Service;

/// A reader of the cell's frame service.
pub struct SharedMemory {
    /// The frame that was given out last; it holds its memory until the next one is taken.
    held: Option<Sample<Ipc, [u8], FrameHeader>>,
    subscriber: Subscriber<Ipc, [u8], FrameHeader>,
    listener: FrameListener,
    // Kept open, so that a driver that restarts finds the same service.
    _topic: FrameTopic,
}

impl SharedMemory {
    /// Subscribes to the frames of `cell`.
    pub fn open(cell: &Cell) -> Result<Self, SourceError> {
        let topic = cell.frames()?;
        let subscriber = topic
            .subscriber_builder()
            .create()
            .map_err(|e| SourceError::Broken(format!("{e:?} (at most 4 readers: is a second feature worker or view running?)")))?;
        Ok(Self { held: None, subscriber, listener: cell.frame_listener()?, _topic: topic })
    }
}

impl FrameSource for SharedMemory {
    fn next_frame(&mut self, timeout: Duration) -> Result<NextFrame<'_>, SourceError> {
        let broken = |e: &dyn std::fmt::Debug| SourceError::Broken(format!("{e:?}"));
        self.held = None;
        self.held = self.subscriber.receive().map_err(|e| broken(&e))?;
        if self.held.is_none() {
            match self.listener.timed_wait(|_| {}, timeout) {
                // A signal cuts the wait short, even one that only continues a stopped process. The caller sees whether to end.
                Ok(_) | Err(ListenerWaitError::InterruptSignal) => {}
                Err(e) => return Err(broken(&e)),
            }
            self.held = self.subscriber.receive().map_err(|e| broken(&e))?;
        }
        Ok(match &self.held {
            Some(frame) => NextFrame::Frame(Frame { header: *frame.user_header(), pixels: frame.payload() }),
            None => NextFrame::Nothing,
        })
    }
}
