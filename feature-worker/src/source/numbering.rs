//! The numbers and the times of a device's frames, from its timestamps.
//!
//! Pure; called for each frame by the thread that measures. Never fails: a timestamp that cannot be right is not believed.

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
