//! Counts how the pours and recordings of a cell ended, from what its controller tells again and again.
//!
//! Pure functions of the program that serves the metrics, on its main thread; they allocate and do not fail.

use std::collections::{BTreeMap, BTreeSet};

use shared::control::{EndReason, Outcome};

/// How many pours and recordings ended for which reason.
pub struct Ended {
    /// By the reason's words.
    pub counts: BTreeMap<&'static str, u64>,
    /// The numbers of the outcomes that the controller told last; `None` before it told any.
    told: Option<BTreeSet<u64>>,
}

impl Ended {
    /// Nothing was counted yet. Prometheus sees growth only of what it has seen before, so each reason is there from the start.
    pub fn new() -> Self {
        Self { counts: EndReason::all().map(|reason| (reason.words(), 0)).collect(), told: None }
    }

    /// Counts those of the controller's newest outcomes that it did not tell last time. Their numbers may fall: a controller that starts anew may begin at 1
    /// again, and the number of an order that was refused is given to a later one. The first that are told at all count only if `is_younger`, so that the
    /// controller has none from before this program began.
    pub fn count(&mut self, outcomes: &[Outcome], is_younger: bool) {
        if let Some(told) = self.told.take().or_else(|| is_younger.then(BTreeSet::new)) {
            for outcome in outcomes.iter().filter(|outcome| !told.contains(&outcome.episode)) {
                *self.counts.entry(outcome.reason.words()).or_default() += 1;
            }
        }
        self.told = Some(outcomes.iter().map(|outcome| outcome.episode).collect());
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The outcome of the pour with this number, which was done.
    fn done(episode: u64) -> Outcome {
        serde_json::from_value(serde_json::json!({
            "episode": episode, "reason": "done", "unseen": false, "unwatched": false, "goal_ml": 60.0, "poured_ml": 60.0, "poured_sd_ml": 1.0,
            "seconds": 5.0, "frames": 150, "bridged_frames": 0, "stale_features": 0, "tick_gaps": 0, "clipped": { "angle": 0, "rate": 0, "acceleration": 0, "not_finite": 0 },
        }))
        .unwrap()
    }

    /// Protects whoever watches a cell from a distance: each outcome counts once, those from before do not, and a number that is smaller than the last one
    /// does, after a refused order and after a new start of the controller.
    #[test]
    fn each_outcome_counts_once_whatever_its_number() {
        let counted = |told: &[(&[u64], bool)]| {
            let mut ended = Ended::new();
            for (numbers, is_younger) in told {
                ended.count(&numbers.iter().map(|n| done(*n)).collect::<Vec<_>>(), *is_younger);
            }
            ended.counts.values().sum::<u64>()
        };
        assert_eq!(counted(&[(&[1, 2], false), (&[1, 2], false), (&[1, 2, 3], false)]), 1);
        assert_eq!(counted(&[(&[1], true), (&[1], true)]), 1);
        assert_eq!(counted(&[(&[], false), (&[6], false), (&[6, 5], false)]), 2, "the number of a refused order");
        assert_eq!(counted(&[(&[7, 8], false), (&[], true), (&[1], true)]), 1, "a controller that was started again");
    }
}
