//! Plays a recording at its own speed, as if it were a camera.
//!
//! For the worker; on the thread that measures. Decoding allocates. A recording whose rate is not `camera.fps` is refused, because the
//! controller counts time in frames. One that is read too slowly plays slower and never catches up in a burst.

use std::path::Path;
use std::time::Duration;

use shared::config::CameraConfig;
use shared::level::Level;
use shared::messages::FrameHeader;
use shared::os;

use super::frame::{Frame, FrameSource, NextFrame, SourceError};
use super::numbering::Numbering;
use super::recording::Recording;

/// A recording's mean rate may differ from the configured one by this share. Chosen by hand: a telephone's video at 30 Hz has 29.3 to 30.
const RATE_TOLERANCE: f64 = 0.05;
/// A frame later than this is shown late, and all after it too, ns. Chosen by hand: a period of a slow camera.
const LATE_NS: u64 = 50_000_000;

/// A recording that is played.
pub struct Playback {
    recording: Recording,
    numbering: Numbering,
    /// When the recording's first frame was due, CLOCK_MONOTONIC ns.
    begin_ns: u64,
    /// The frame that waits until it is due: its header and its pixels.
    waiting: Option<FrameHeader>,
    pixels: Vec<u8>,
}

impl Playback {
    /// Opens the recording that `[camera]` names.
    pub fn open(camera: &CameraConfig) -> Result<Self, SourceError> {
        let recording = Recording::open(Path::new(&camera.path), camera.fps, false)?;
        if let Some(own) = recording.own_rate_hz().filter(|own| (own / camera.fps - 1.0).abs() > RATE_TOLERANCE) {
            return Err(SourceError::FileRate { path: camera.path.clone(), configured: camera.fps, own });
        }
        let now_ns = os::now_ns();
        Ok(Self { recording, numbering: Numbering::new(camera.fps, now_ns), begin_ns: now_ns, waiting: None, pixels: Vec::new() })
    }
}

impl FrameSource for Playback {
    fn next_frame(&mut self, timeout: Duration) -> Result<NextFrame<'_>, SourceError> {
        let header = match self.waiting {
            Some(header) => header,
            None => match self.recording.next_frame()? {
                Some(frame) => {
                    self.pixels.clear();
                    self.pixels.extend_from_slice(frame.pixels);
                    *self.waiting.insert(frame.header)
                }
                None => {
                    if let Some(remark) = self.recording.remark() {
                        eprintln!("{}", Level::Warning.marked(&format!("feature-worker: {remark}")));
                    }
                    return Ok(NextFrame::End);
                }
            },
        };
        let latest_ns = os::now_ns() + timeout.as_nanos() as u64;
        let due_ns = self.begin_ns + header.captured_at_ns;
        if due_ns > latest_ns {
            os::sleep_until_ns(latest_ns);
            return Ok(NextFrame::Nothing);
        }
        os::sleep_until_ns(due_ns);
        self.waiting = None;
        let now_ns = os::now_ns();
        if now_ns > due_ns + LATE_NS {
            self.begin_ns += now_ns - due_ns;
        }
        // Frames that are missing in the file, and pauses of a variable rate, are gaps in the numbers.
        let (sequence, _) = self.numbering.next(Some(1.0 + header.captured_at_ns as f64 / 1e6), now_ns);
        let header = FrameHeader { sequence, captured_at_ns: now_ns, published_at_ns: now_ns, ..header };
        Ok(NextFrame::Frame(Frame { header, pixels: &self.pixels }))
    }
}
