//! What the worker tells the operator on standard error: a line when something changes, or one a second; or JSON on standard output.
//!
//! The thread "status" hands what the extraction thread left in a queue of one to the process's speaker ([`shared::speaker`]), so that
//! neither writes to a terminal itself. A line that cannot be printed is left out.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::thread::JoinHandle;
use std::time::Duration;

use crossbeam::queue::ArrayQueue;
use serde::Serialize;
use shared::level::Level;
use shared::os;
use shared::speaker::Speaker;
use shared::supervisor::Supervisor;

/// How often the thread looks for a new status. Chosen by hand; it also bounds how long the process takes to end.
const PAUSE: Duration = Duration::from_millis(100);
/// Time from one look at the status to the next, ns. Chosen by hand.
const LINE_NS: u64 = 1_000_000_000;
/// Least time between two lines about what changed, ns, so that a picture that is doubted every other second does not fill a log. Chosen by hand.
const CHANGE_NS: u64 = 10_000_000_000;

/// What is told while the worker runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Lines {
    /// A line when frames begin or stop to come, or a doubt comes or goes.
    #[default]
    Changes,
    /// A line each second.
    EachSecond,
    /// Only what keeps the worker from working.
    Quiet,
    /// A JSON object each second, on standard output.
    Json,
}

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
    /// No new frame has come for a second.
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
    lines: Lines,
) -> std::io::Result<JoinHandle<()>> {
    let (latest, looks, stop, speaker) = (Arc::clone(latest), Arc::clone(looks), Arc::clone(stop), Arc::clone(speaker));
    std::thread::Builder::new().name("status".into()).spawn(move || print_until_stopped(&latest, &looks, &stop, &speaker, lines))
}

fn print_until_stopped(latest: &ArrayQueue<Status>, looks: &AtomicU64, stop: &AtomicBool, speaker: &Speaker, lines: Lines) {
    let (mut frames_before, mut changes) = (0, Changes::default());
    let mut printed_at_ns = os::now_ns();
    let mut supervisor = Supervisor::ready();
    if lines != Lines::Quiet {
        speaker.say(Level::Info, "waiting for frames");
    }
    while !stop.load(Relaxed) {
        std::thread::sleep(PAUSE);
        supervisor.progress(looks.load(Relaxed));
        let now_ns = os::now_ns();
        if now_ns < printed_at_ns + LINE_NS {
            continue;
        }
        let Some(status) = latest.pop() else { continue };
        if lines == Lines::Json {
            match serde_json::to_string(&status) {
                Ok(line) => speaker.print(line),
                Err(e) => speaker.say(Level::Warning, &format!("status: {e}")),
            }
        } else if lines == Lines::EachSecond && !status.silent {
            let fps = (status.frames - frames_before) as f64 * 1e9 / (now_ns - printed_at_ns) as f64;
            speaker.say(
                Level::Info,
                &format!(
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
                ),
            );
        } else if lines != Lines::Quiet
            && let Some((level, line)) = changes.line(&status, now_ns)
        {
            speaker.say(level, &line);
        }
        (frames_before, printed_at_ns) = (status.frames, now_ns);
    }
}

/// What was said last of a state that lasts.
#[derive(Debug, Default)]
struct Changes {
    /// Whether frames were missing, and the doubt; `None` before the first line.
    said: Option<(bool, &'static str)>,
    at_ns: u64,
}

impl Changes {
    /// The line about `status`, if it differs from what was said last. A camera that falls silent or comes back is said at once, a doubt that comes and
    /// goes at most each [`CHANGE_NS`].
    fn line(&mut self, status: &Status, now_ns: u64) -> Option<(Level, String)> {
        let state = (status.silent, if status.silent { "" } else { status.doubt });
        let at_once = self.said.is_none_or(|said| said.0 != state.0);
        if self.said == Some(state) || (!at_once && now_ns < self.at_ns + CHANGE_NS) {
            return None;
        }
        (self.said, self.at_ns) = (Some(state), now_ns);
        Some(match state {
            (true, _) => (Level::Warning, "no new frames for a second; waiting for the camera driver".into()),
            (false, "none") => (Level::Info, format!("frames are measured, without a doubt; {} were lost so far", status.lost)),
            (false, doubt) => {
                (Level::Warning, format!("the pictures are doubted: {doubt}; {} of {} so far", status.doubtful, status.frames))
            }
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects a log from being filled: what lasts is said once, silence and its end at once, and a doubt that comes and goes every ten seconds at most.
    #[test]
    fn only_changes_are_said() {
        let mut changes = Changes::default();
        let good = Status { doubt: "none", ..Status::default() };
        let (dark, silent) = (Status { doubt: "too dark", ..good }, Status { silent: true, ..good });
        let mut said = |status: &Status, second: u64| changes.line(status, second * LINE_NS).is_some();
        assert!(said(&good, 1) && !said(&good, 2) && !said(&good, 3000));
        assert!(said(&silent, 3001) && !said(&silent, 3002) && said(&good, 3003));
        let lines = (3004..3064).filter(|s| said(if s % 2 == 0 { &dark } else { &good }, *s)).count();
        assert!((2..=6).contains(&lines), "{lines} lines in a minute");
    }
}
