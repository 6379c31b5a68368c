//! What the worker tells the operator: one line a second, on standard error, or as JSON on standard output.
//!
//! The thread "status" hands what the extraction thread left in a queue of one to the process's speaker ([`shared::speaker`]), so that
//! neither writes to a terminal itself. A line that cannot be printed is left out.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam::queue::ArrayQueue;
use serde::Serialize;
use shared::os;
use shared::speaker::Speaker;
use shared::supervisor::Supervisor;

/// How often the thread looks for a new status. Chosen by hand; it also bounds how long the process takes to end.
const PAUSE: Duration = Duration::from_millis(100);
/// Time from one line to the next, ns. Chosen by hand.
const LINE_NS: u64 = 1_000_000_000;

/// The state of the worker after its newest frame.
#[derive(Debug, Clone, Copy, Default, Serialize)]
pub struct Status {
    /// Frames measured since the start.
    pub frames: u64,
    /// Frames that the camera counted but that never came.
    pub lost: u64,
    /// Frames that came twice or late and were left out.
    pub repeated: u64,
    /// Frames with a doubt.
    pub doubtful: u64,
    /// Number of the newest frame.
    pub sequence: u64,
    /// V_e of the newest frame, px^2.
    pub area_px2: f32,
    /// Confidence of the newest frame, 0 to 1.
    pub confidence: f32,
    /// Why the newest frame is doubtful, in words.
    pub doubt: &'static str,
    /// Time from taking the newest frame to publishing its feature, us.
    pub took_us: f32,
    /// Time from the newest frame's capture time to publishing its feature, ms.
    pub latency_ms: f32,
    /// No frame has come for a second.
    pub silent: bool,
}

/// Starts the thread "status". It ends soon after `stop` is set.
///
/// `looks` grows whenever the extraction thread looks for a frame; systemd is told that it does.
pub fn start_printer(
    latest: &Arc<ArrayQueue<Status>>,
    looks: &Arc<AtomicU64>,
    stop: &Arc<AtomicBool>,
    speaker: &Arc<Speaker>,
    json: bool,
) -> std::io::Result<JoinHandle<()>> {
    let (latest, looks, stop, speaker) = (Arc::clone(latest), Arc::clone(looks), Arc::clone(stop), Arc::clone(speaker));
    std::thread::Builder::new().name("status".into()).spawn(move || print_until_stopped(&latest, &looks, &stop, &speaker, json))
}

fn print_until_stopped(latest: &ArrayQueue<Status>, looks: &AtomicU64, stop: &AtomicBool, speaker: &Speaker, json: bool) {
    let mut frames_before = 0;
    let mut printed_at_ns = os::now_ns();
    let mut supervisor = Supervisor::ready();
    speaker.say("waiting for frames");
    while !stop.load(Relaxed) {
        std::thread::sleep(PAUSE);
        supervisor.progress(looks.load(Relaxed));
        let now_ns = os::now_ns();
        if now_ns < printed_at_ns + LINE_NS {
            continue;
        }
        let Some(status) = latest.pop() else { continue };
        if json {
            match serde_json::to_string(&status) {
                Ok(line) => speaker.print(line),
                Err(e) => speaker.say(&format!("status: {e}")),
            }
        } else if status.silent {
            speaker.say("no frames for a second; waiting for the camera driver");
        } else {
            let fps = (status.frames - frames_before) as f64 * 1e9 / (now_ns - printed_at_ns) as f64;
            speaker.say(&format!(
                "frame {} ({fps:.0}/s), V_e {:.0} px^2, confidence {:.2}, doubt: {}, {:.2} ms + {:.1} ms old, lost {}, \
                 repeated {}, doubtful {}",
                status.sequence,
                status.area_px2,
                status.confidence,
                status.doubt,
                status.took_us / 1e3,
                status.latency_ms,
                status.lost,
                status.repeated,
                status.doubtful
            ));
        }
        (frames_before, printed_at_ns) = (status.frames, now_ns);
    }
}
