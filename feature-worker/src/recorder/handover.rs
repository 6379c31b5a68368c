//! How a frame passes from the extraction thread to the recorder's thread without either waiting for the other.
//!
//! The pixels are copied into buffers that were allocated at the start and that come back when the frame is written. The extraction
//! thread calls [`Handover::offer`], which neither waits nor allocates. When no buffer is free the image is dropped and counted, and its
//! V_e is kept.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};

use crossbeam::queue::ArrayQueue;
use shared::config::Config;
use shared::messages::{Feature, FrameHeader, PixelFormat};

/// Frames that the recorder keeps from before an episode, because telemetry and frames arrive with different delays. Chosen by hand: a
/// quarter of a second at 30 Hz.
pub const KEPT_FRAMES: usize = 8;
/// Features without an image that may wait beside the images while the disk is slow. Chosen by hand: half a minute at 30 Hz.
const SPARE_FEATURES: usize = 1024;

/// The two queues between the threads: frames go to the recorder, and empty buffers come back.
pub struct Handover {
    free: ArrayQueue<Vec<u8>>,
    queue: ArrayQueue<OfferedFrame>,
    dropped: AtomicU64,
    stop: AtomicBool,
}

/// One frame on its way to the recorder.
pub struct OfferedFrame {
    /// Size and format of the picture.
    pub header: FrameHeader,
    /// What was measured in it.
    pub feature: Feature,
    /// The picture; `None` if no buffer was free.
    pub pixels: Option<Vec<u8>>,
}

impl Handover {
    /// Allocates all buffers, large enough for every pixel format at the configured size.
    pub fn new(config: &Config) -> Self {
        let buffers = config.recording.queue_frames + KEPT_FRAMES;
        let bytes = config.camera.width_px as usize * config.camera.height_px as usize * PixelFormat::Bgr8.bytes_per_pixel();
        let this = Self {
            free: ArrayQueue::new(buffers),
            queue: ArrayQueue::new(buffers + SPARE_FEATURES),
            dropped: AtomicU64::new(0),
            stop: AtomicBool::new(false),
        };
        for _ in 0..buffers {
            let _ = this.free.push(Vec::with_capacity(bytes));
        }
        this
    }

    /// Extraction thread: hands a frame over, at the cost of one copy of its pixels.
    pub fn offer(&self, header: &FrameHeader, pixels: &[u8], feature: &Feature) {
        let mut buffer = self.free.pop();
        match &mut buffer {
            Some(copy) if pixels.len() <= copy.capacity() => {
                copy.clear();
                copy.extend_from_slice(pixels);
            }
            // No buffer is free, or the frame is larger than configured, so that the buffer would have to grow.
            _ => {
                self.give_back(buffer.take());
                self.dropped.fetch_add(1, Ordering::Relaxed);
            }
        }
        if let Err(frame) = self.queue.push(OfferedFrame { header: *header, feature: *feature, pixels: buffer }) {
            if frame.pixels.is_some() {
                self.dropped.fetch_add(1, Ordering::Relaxed);
            }
            self.give_back(frame.pixels);
        }
    }

    /// Images dropped since the start, whether or not an episode was running.
    pub fn dropped(&self) -> u64 {
        self.dropped.load(Ordering::Relaxed)
    }

    /// Asks the recorder's thread to end.
    pub fn stop(&self) {
        self.stop.store(true, Ordering::Release);
    }

    /// Recorder's thread: whether it is asked to end.
    pub fn is_stopped(&self) -> bool {
        self.stop.load(Ordering::Acquire)
    }

    /// Recorder's thread: the oldest frame that waits.
    pub fn take(&self) -> Option<OfferedFrame> {
        self.queue.pop()
    }

    /// Recorder's thread: whether no frame waits.
    pub fn is_empty(&self) -> bool {
        self.queue.is_empty()
    }

    /// Makes a buffer free again.
    pub fn give_back(&self, buffer: Option<Vec<u8>>) {
        if let Some(buffer) = buffer {
            // The queue has room for every buffer, so this cannot fail.
            let _ = self.free.push(buffer);
        }
    }
}
