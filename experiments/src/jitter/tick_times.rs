//! What the controller measured of every tick, read from its journal, so that percentiles are exact.
//!
//! Ordinary thread; allocates.

use rt_controller::journal;

use super::machine_log::Activity;
use crate::own_cell::{OwnCell, OwnCellError};

/// What is measured of every tick, or of those that used a new V_e.
#[derive(Debug, Clone, Copy)]
pub enum Span {
    /// From the deadline to the wake-up, of every tick.
    Lateness,
    /// From the wake-up to the end of the tick, of every tick.
    Execution,
    /// The same, of the ticks of pours.
    PouringExecution,
    /// From the middle of the exposure until the worker has the frame.
    CaptureToReceived,
    /// From there until V_e is published: the extraction.
    ReceivedToPublished,
    /// From there until the tick that uses it wakes up.
    PublishedToWake,
    /// From there until the target is decided.
    WakeToDecided,
    /// From there until the target's bytes are on the socket.
    DecidedToWritten,
    /// From the middle of the exposure until the target's bytes are on the socket.
    CaptureToWritten,
    /// From the worker's receipt of a frame until then: the time that is our own.
    ReceivedToWritten,
}

/// The names of the spans, in the order of [`Span`].
pub const SPANS: [&str; 10] = [
    "wake-up lateness",
    "tick execution",
    "tick execution in pours",
    "capture to worker",
    "worker to V_e published",
    "V_e published to wake-up",
    "wake-up to target decided",
    "decided to bytes on the socket",
    "capture to bytes on the socket",
    "of it our own, from the worker on",
];

/// How many of the worst ticks are kept: as many as a person reads.
const WORST: usize = 10;

/// One of the worst ticks.
#[derive(Debug, Clone, Copy)]
pub struct WorstTick {
    /// When it woke up, ns.
    pub woke_at_ns: u64,
    /// Its lateness, us.
    pub lateness_us: f64,
    /// Its execution, us.
    pub execution_us: f64,
    /// Number of frames that it took.
    pub frames: usize,
    /// Whether a pour was under way.
    pub pouring: bool,
    /// What the machine did then, if it is known.
    pub activity: Option<Activity>,
}

impl WorstTick {
    /// From its deadline to its end, us; the worst ticks are those that took the longest.
    fn took_us(&self) -> f64 {
        self.lateness_us + self.execution_us
    }
}

/// Everything that was measured of the ticks of a run.
#[derive(Debug, Default, Clone)]
pub struct TickTimes {
    /// The worst ticks, worst first.
    pub worst: Vec<WorstTick>,
    /// Durations in us, in the order of [`Span`].
    pub spans_us: [Vec<f64>; SPANS.len()],
    /// Number of ticks with no frame, with one, and with more.
    pub with_frames: [u64; 3],
    /// Number of periods without a tick.
    pub lost: u64,
    /// Number of ticks later than half a period.
    pub late: u64,
}

impl TickTimes {
    /// Reads the ticks between two times (ns) from the cell's journal.
    ///
    /// # Errors
    /// When the journal cannot be read, or does not replay to the same ticks.
    pub fn read(cell: &OwnCell, from_ns: u64, to_ns: u64) -> Result<Self, OwnCellError> {
        let mut ticks = Self::default();
        let period_ns = 1e9 / cell.config.controller.rate_hz;
        let mut before_ns = None;
        let us = |from: u64, to: u64| to.saturating_sub(from) as f64 / 1e3;
        let path = cell.out.join("journal.bin");
        let replay = journal::replay(&path, |tick, output| {
            let (woke_ns, times) = (tick.now_ns, tick.times);
            if woke_ns < from_ns || woke_ns > to_ns {
                return;
            }
            if let Some(before_ns) = before_ns.replace(times.deadline_ns) {
                ticks.lost += ((times.deadline_ns - before_ns) as f64 / period_ns).round() as u64 - 1;
            }
            let lateness = us(times.deadline_ns, woke_ns);
            ticks.late += u64::from(lateness > period_ns / 2e3);
            let mut push = |span: Span, us: f64| ticks.spans_us[span as usize].push(us);
            push(Span::Lateness, lateness);
            push(Span::Execution, us(woke_ns, times.done_ns));
            let pouring = output.telemetry.goal_ml.is_finite() && output.telemetry.episode != 0;
            if pouring {
                push(Span::PouringExecution, us(woke_ns, times.done_ns));
            }
            if let Some(feature) = tick.features.last().filter(|_| times.written_at_ns != 0) {
                push(Span::CaptureToReceived, us(feature.captured_at_ns, feature.received_at_ns));
                push(Span::ReceivedToPublished, us(feature.received_at_ns, feature.published_at_ns));
                push(Span::PublishedToWake, us(feature.published_at_ns, woke_ns));
                push(Span::WakeToDecided, us(woke_ns, times.decided_at_ns));
                push(Span::DecidedToWritten, us(times.decided_at_ns, times.written_at_ns));
                push(Span::CaptureToWritten, us(feature.captured_at_ns, times.written_at_ns));
                push(Span::ReceivedToWritten, us(feature.received_at_ns, times.written_at_ns));
            }
            ticks.with_frames[tick.features.len().min(2)] += 1;
            let (execution_us, frames) = (us(woke_ns, times.done_ns), tick.features.len());
            ticks.keep_worst([WorstTick { woke_at_ns: woke_ns, lateness_us: lateness, execution_us, frames, pouring, activity: None }]);
        });
        let replay = replay.map_err(|e| OwnCellError::Other(e.to_string()))?;
        if replay.different != 0 {
            return Err(OwnCellError::Other(format!("{} ticks of {} replay differently", replay.different, path.display())));
        }
        Ok(ticks)
    }

    /// The durations of one span, us.
    pub fn of(&self, span: Span) -> &Vec<f64> {
        &self.spans_us[span as usize]
    }

    /// Keeps the worst of the ticks that it has and of `more`.
    fn keep_worst(&mut self, more: impl IntoIterator<Item = WorstTick>) {
        self.worst.extend(more);
        self.worst.sort_by(|a, b| b.took_us().total_cmp(&a.took_us()));
        self.worst.truncate(WORST);
    }

    /// Adds the ticks of another run.
    pub fn add(&mut self, other: &Self) {
        for (sum, part) in self.spans_us.iter_mut().zip(&other.spans_us) {
            sum.extend_from_slice(part);
        }
        self.keep_worst(other.worst.iter().copied());
        self.with_frames.iter_mut().zip(other.with_frames).for_each(|(sum, part)| *sum += part);
        self.lost += other.lost;
        self.late += other.late;
    }
}
