//! A pour or recording under way, what is counted meanwhile, and what is told of it at its end.
//!
//! It is plain data in the controller's loop; nothing here allocates or fails.

use shared::agent::Decision;
use shared::control::{EndReason, Outcome};
use shared::gaussian_curve::Curve;
use shared::limits::Clipped;

use super::ending::Ending;
use super::following::Following;
use super::order::Refusal;

/// Counters since the start.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Counters {
    /// Number of ticks done.
    pub ticks: u64,
    /// Number of features used.
    pub features: u64,
    /// Number of ticks during pours and recordings whose newest measurement was stale.
    pub stale_features: u64,
    /// Number of lost frames bridged.
    pub bridged_frames: u64,
    /// Number of features ignored because they came twice, out of order, or from another layout or clock.
    pub ignored_features: u64,
    /// How often each limit changed a request.
    pub clipped: Clipped,
    /// Why a pour would be refused now, whatever its goal; `None` if it would not.
    pub refuses: Option<Refusal>,
}

/// A pour or recording under way.
#[derive(Debug, Clone, Copy)]
pub struct Run {
    /// Its number.
    pub episode: u64,
    /// When it began, ns.
    pub started_at_ns: u64,
    /// Number of frames since then, the lost ones included.
    pub frames: u32,
    /// Goal volume of a pour, ml.
    pub goal_ml: Option<f32>,
    /// Curve of a recording.
    pub curve: Option<Curve>,
    /// When and why it ends.
    pub ending: Ending,
    /// Whether the joint follows.
    pub following: Following,
    /// When the container was commanded upright, ns; 0 before.
    pub settling_since_ns: u64,
    /// Start time of the feature worker that measured when it began, ns.
    pub worker_epoch_ns: u64,
    /// The counters when it began.
    pub counters_before: Counters,
    /// Number of ticks that came late after the one before.
    pub tick_gaps: u32,
}

/// The share of what is beyond the goal that a pour which exceeds it is uncertain by. Chosen by hand: the vessel gave it, or the eye made it up.
const SURPRISE: f32 = 0.5;

/// The deviation that a pour's volume is told with, ml.
fn said_sd_ml(reason: EndReason, decision: &Decision) -> f32 {
    // What would still leave on the way upright is not seen of a run that ends before.
    let sd_ml = decision.poured_sd_ml.hypot(decision.stop_ml);
    // What is far beyond the goal surprised the very estimate that aimed at it.
    if reason == EndReason::GoalExceeded { sd_ml.max(-SURPRISE * decision.d_ml) } else { sd_ml }
}

impl Run {
    /// What is told of it when it ends at `now_ns` for `reason`; `decision` is the agent's newest, and `now` the present counters.
    pub fn outcome(&self, reason: EndReason, now_ns: u64, decision: &Decision, now: Counters) -> Outcome {
        let before = self.counters_before;
        Outcome {
            episode: self.episode,
            reason,
            unseen: self.ending.leaves_unseen(reason),
            unwatched: self.ending.leaves_unwatched(reason),
            goal_ml: self.goal_ml,
            poured_ml: if self.goal_ml.is_some() { decision.poured_ml } else { f32::NAN },
            poured_sd_ml: if self.goal_ml.is_some() { said_sd_ml(reason, decision) } else { 0.0 },
            seconds: now_ns.saturating_sub(self.started_at_ns) as f32 / 1e9,
            frames: self.frames,
            bridged_frames: (now.bridged_frames - before.bridged_frames) as u32,
            stale_features: (now.stale_features - before.stale_features) as u32,
            tick_gaps: self.tick_gaps,
            clipped: Clipped {
                angle: now.clipped.angle - before.clipped.angle,
                rate: now.clipped.rate - before.clipped.rate,
                acceleration: now.clipped.acceleration - before.clipped.acceleration,
                not_finite: now.clipped.not_finite - before.clipped.not_finite,
            },
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects whoever reads what was poured of a pour that went far beyond its goal: the estimate that aimed at the goal was wrong once, and does not call
    /// itself right to 6 ml after that. Of all other pours it says what it knows.
    #[test]
    fn a_surprise_is_in_the_deviation() {
        let decision = Decision { d_ml: -55.6, poured_ml: 201.7, poured_sd_ml: 6.0, stop_ml: 0.8, ..Decision::NOTHING };
        let said = |reason, d_ml| said_sd_ml(reason, &Decision { d_ml, ..decision });
        assert!((said(EndReason::GoalExceeded, -55.6) - 27.8).abs() < 0.1);
        let known = 6.0f32.hypot(0.8);
        for (reason, d_ml) in [(EndReason::GoalExceeded, -9.0), (EndReason::Done, -55.6), (EndReason::StreamLost, 55.6)] {
            assert_eq!(said(reason, d_ml), known, "{reason:?}");
        }
    }
}
