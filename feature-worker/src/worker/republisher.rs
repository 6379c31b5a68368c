//! Publishes the frames of a device or a file in shared memory, for programs that watch beside the worker.
//!
//! A device can be opened only once, so `view` and `calibrate` read the worker's frames. Called from the extraction thread: it never
//! waits, and it allocates only when a reader comes or goes. A frame that cannot be published is left out, because no reader is worth
//! the end of a pour.

use iceoryx2::port::publisher::{Publisher, PublisherCreateError};
use iceoryx2::service::port_factory::PortFactory as _;
use shared::config::Config;
use shared::exit::{self, Failure, failure};
use shared::ipc::{Cell, FrameNotifier, FrameTopic};
use shared::messages::{FrameHeader, PixelFormat};
use shared::os;
use shared::shared_memory;

use crate::source::Frame;

/// The publisher of the service `frame`.
pub struct FrameRepublisher {
    publisher: Publisher<iceoryx2::service::ipc::Service, [u8], FrameHeader>,
    notifier: FrameNotifier,
    topic: FrameTopic,
}

impl FrameRepublisher {
    /// Takes the place of the camera driver in `cell`.
    pub fn new(cell: &Cell, config: &Config) -> Result<Self, Failure> {
        let topic = cell.frames()?;
        let bytes = config.camera.width_px as usize * config.camera.height_px as usize * PixelFormat::Bgr8.bytes_per_pixel();
        let name = &config.cell.name;
        let publisher = topic.publisher_builder().initial_max_slice_len(bytes).create().map_err(|e| match e {
            PublisherCreateError::ExceedsMaxSupportedPublishers => failure(
                exit::REFUSED,
                format!("a camera driver of cell '{name}' is running: stop it first, or let the worker take its frames"),
            ),
            e => failure(
                exit::UNREACHABLE,
                format!("cell '{name}': service 'frame': {e:?}; end all programs of the cell and start them again"),
            ),
        })?;
        Ok(Self { publisher, notifier: cell.frame_notifier()?, topic })
    }

    /// Publishes a frame if somebody subscribes. The cost is one copy into shared memory that was made at the start. A reader that is
    /// too slow loses the oldest frame.
    pub fn offer(&self, frame: &Frame) {
        if self.topic.dynamic_config().number_of_subscribers() == 0 {
            return;
        }
        // A page of a full `/dev/shm` cannot be written, and whoever tries is killed.
        if shared_memory::check_space(2 * frame.pixels.len() as u64).is_err() {
            return;
        }
        // There is no room for a frame that is larger than configured.
        let Ok(mut loan) = self.publisher.loan_slice_uninit(frame.pixels.len()) else { return };
        *loan.user_header_mut() = FrameHeader { published_at_ns: os::now_ns(), ..frame.header };
        let _ = loan.write_from_slice(frame.pixels).send();
        let _ = self.notifier.notify();
    }
}
