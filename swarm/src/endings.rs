//! What must hold at the end of a pour or recording: its reason, and what it says of itself.
//!
//! Pure; allocates for what it finds; cannot fail.

use shared::control::{EndReason, Outcome};

use crate::check::Checks;
use crate::noticing::{is_ordinary, reasons};

/// How far what left may be from what a pour that is done says: so many of its own standard deviations, and ml. A normal distribution leaves
/// five in 2 million times; the ml are what no deviation of a small pour goes below.
const SAID: (f64, f64) = (5.0, 3.0);
/// How far what a pour that is done says may be from its goal, ml, and as a share of it: the last decision counts drops that still fell.
const MISSED: (f64, f64) = (8.0, 0.08);
/// The least goal that may be begun, ml: about two drops of water, as the controller's own bound, which a check must not share.
const LEAST_GOAL_ML: f64 = 0.1;
/// How long before a run a fault that is over may still be its end's reason, s: what it did to the robot, the link or the worker is over by then.
const LATELY_S: f64 = 6.0;

impl Checks {
    /// Looks at how a pour or recording ended. `true_ml` is what left since it began.
    pub fn ended(&mut self, outcome: &Outcome, true_ml: f64, at_s: f64) {
        self.outcomes.push((at_s, *outcome));
        self.says(outcome, true_ml, at_s);
        let since_s = at_s - f64::from(outcome.seconds) - LATELY_S;
        let reason = outcome.reason;
        let lately = || self.faults.iter().filter(|f| f.until_s >= since_s);
        let named = lately().any(|f| reasons(&f.what).contains(&reason)) || (self.is_slow && reason == EndReason::NotFollowed);
        if !is_ordinary(reason) && !named {
            let faults: Vec<_> = lately().map(|f| f.what.name()).collect();
            self.violated("reason", at_s, format!("it ended with {reason:?}, and what happened was {faults:?}"));
        }
        if let Some(why) = self.evidence.demands.filter(|_| is_ordinary(reason)) {
            self.violated("reason", at_s, format!("it ended with {reason:?}, although {why}"));
        }
    }

    /// Whether a run that ends so may be ended by a fault that stood before it began.
    pub fn stood_before(&self, reason: EndReason) -> bool {
        self.faults.iter().any(|f| f.at_s < self.run_since_s && f.until_s >= self.run_since_s && reasons(&f.what).contains(&reason))
    }

    /// Looks at what a pour says of itself.
    fn says(&mut self, outcome: &Outcome, true_ml: f64, at_s: f64) {
        if u64::from(outcome.bridged_frames) > self.lost {
            let (bridged, lost) = (outcome.bridged_frames, self.lost);
            self.violated("frames-once", at_s, format!("{bridged} lost frames were bridged, and {lost} were lost"));
        }
        let Some(goal_ml) = outcome.goal_ml else { return };
        let most_ml = f64::from(self.settings.goal_max_ml);
        let (goal_ml, said_ml) = (f64::from(goal_ml), f64::from(outcome.poured_ml));
        if !(LEAST_GOAL_ML..=most_ml).contains(&goal_ml) {
            self.violated("goal-range", at_s, format!("a pour of {goal_ml} ml was begun"));
        }
        // A run whose outcome says that liquid may have left unseen says only what was seen. These ends have seen all but what is in their deviation.
        let seen_to_the_end = [EndReason::Done, EndReason::Aborted, EndReason::ContainerEmpty, EndReason::GoalExceeded];
        if outcome.unseen && !seen_to_the_end.contains(&outcome.reason) {
            return;
        }
        let sd_ml = f64::from(outcome.poured_sd_ml);
        // Nothing in the world tells one camera that its own gain has drifted, so the truth may then be off by what that hides, and no more. A pour
        // that is done has looked on, and doubts what single frames did not show, but for a surge that nothing let expect; another may end in the middle of
        // them.
        let (low_ml, high_ml) = self.unshown.by_gain_ml(said_ml);
        let frames_ml = if outcome.reason == EndReason::Done { (0.0, self.unshown.by_surges_ml()) } else { self.unshown.by_frames_ml() };
        // "At least" so much is right whatever left while the camera was blind, and of no more.
        let blind_ml = if outcome.unseen { self.unshown.by_blindness_ml() } else { 0.0 };
        let most_ml = SAID.0 * sd_ml + SAID.1;
        let off_ml = true_ml - said_ml;
        // What is not a number is near to nothing.
        let is_near = (-(most_ml + low_ml + frames_ml.0)..=most_ml + high_ml + frames_ml.1 + blind_ml).contains(&off_ml);
        if !is_near {
            let reason = outcome.reason.words();
            self.violated("said", at_s, format!("{reason}, and it says {said_ml:.1} +- {sd_ml:.1} ml where {true_ml:.1} left"));
        }
        let missed_ml = MISSED.0 + MISSED.1 * said_ml.abs().max(goal_ml);
        let is_goal = (goal_ml - missed_ml..=goal_ml + missed_ml).contains(&said_ml);
        if outcome.reason == EndReason::Done && !is_goal {
            self.violated("done", at_s, format!("done, and it says {said_ml:.1} ml of {goal_ml:.1}"));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rt_controller::core::{Robot, Settings};
    use rt_controller::journal::{Tick, Times};
    use shared::config::Config;
    use shared::limits::Clipped;
    use shared::messages::{Feature, Phase, Telemetry};

    fn checks() -> Checks {
        let config = Config::parse(include_str!("../../config/sim.toml"), "sim.toml").unwrap();
        Checks::new(Settings::new(&config), 0.008)
    }

    fn outcome(reason: EndReason) -> Outcome {
        Outcome {
            episode: 1,
            reason,
            unseen: reason.leaves_unseen(),
            unwatched: reason.leaves_unseen(),
            goal_ml: Some(80.0),
            poured_ml: 80.0,
            poured_sd_ml: 2.0,
            seconds: 8.0,
            frames: 240,
            bridged_frames: 0,
            stale_features: 0,
            tick_gaps: 0,
            clipped: Clipped::default(),
        }
    }

    /// Protects the check of what a pour says: a gain that drifted excuses as much as it hides, in its own direction, and no more; without it nothing is
    /// excused.
    #[test]
    fn a_drift_excuses_what_it_hides() {
        let found = |gain: f64, true_ml: f64| {
            let mut checks = checks();
            checks.unshown.frame(gain, 0.0, 0.0);
            checks.ended(&outcome(EndReason::Done), true_ml, 20.0);
            checks.violations.first().map(|v| v.invariant)
        };
        assert_eq!(found(1.0, 92.0), None, "within five deviations and 3 ml");
        assert_eq!(found(1.0, 94.0), Some("said"));
        assert_eq!(found(0.75, 120.0), None);
        assert_eq!(found(0.75, 135.0), Some("said"), "more than a gain of 0.75 hides");
        assert_eq!(found(0.75, 60.0), Some("said"), "what fell shows too little, and not too much");
        assert_eq!(found(1.25, 60.0), None);
        assert_eq!(found(1.25, 94.0), Some("said"));
    }

    /// Protects the check of what other ends say: hidden frames excuse what left in them, an outcome that says that something was not seen is not held to
    /// its number, and one that does not say so is.
    #[test]
    fn hidden_frames_excuse_what_left_in_them() {
        let found_after = |shown_ml: f64, reason, hidden_ml: f64, true_ml: f64| {
            let mut checks = checks();
            checks.unshown.frame(1.0, shown_ml, 0.0);
            checks.unshown.frame(1.0, hidden_ml, hidden_ml);
            checks.ended(&outcome(reason), true_ml, 20.0);
            checks.violations.iter().any(|v| v.invariant == "said")
        };
        let found = |reason, hidden_ml, true_ml| found_after(0.1, reason, hidden_ml, true_ml);
        assert!(found_after(0.0, EndReason::Done, 20.0, 110.0), "a stream that is there at once tells by itself");
        assert!(!found(EndReason::Done, 20.0, 110.0) && found(EndReason::Done, 20.0, 116.0), "a surge that nothing let expect");
        assert!(found_after(20.0, EndReason::Done, 20.0, 110.0), "as much had been shown before");
        assert!(!found(EndReason::Aborted, 20.0, 110.0) && found(EndReason::Aborted, 20.0, 116.0));
        assert!(found(EndReason::Aborted, 0.1, 96.0), "one hidden frame excuses what left in it only");
        assert!(found(EndReason::Aborted, 20.0, 60.0), "what was not shown cannot be too much");
        assert!(found(EndReason::MaxFrames, 0.0, 96.0), "all was seen");
        assert!(!found(EndReason::RobotLost, 0.0, 96.0), "it says that not all was seen");
    }

    /// Protects the check of a lower bound: "at least" is no excuse but for what left while the camera was blind.
    #[test]
    fn a_lower_bound_excuses_what_a_blind_camera_missed() {
        let found = |unseen, true_ml| {
            let mut checks = checks();
            (0..10).for_each(|_| checks.unshown.frame_without_measurement(1.0, 2.0));
            checks.ended(&Outcome { unseen, ..outcome(EndReason::Aborted) }, true_ml, 20.0);
            checks.violations.iter().any(|v| v.invariant == "said")
        };
        assert!(!found(true, 110.0) && found(true, 114.0), "20 ml left unseen");
        assert!(found(false, 110.0), "it does not say that anything was not seen");
    }

    /// Protects the cup from a goal that is none: what is smaller than the least goal is not begun.
    #[test]
    fn a_goal_that_is_too_small_is_found() {
        let found = |goal_ml: f32| {
            let mut checks = checks();
            checks.ended(&Outcome { goal_ml: Some(goal_ml), ..outcome(EndReason::RobotLost) }, 0.0, 20.0);
            checks.violations.iter().any(|v| v.invariant == "goal-range")
        };
        assert!(found(0.05) && found(0.0) && !found(0.1));
    }

    /// Protects the check of reasons: an end that by itself would be one without a fault is none where the robot was lost in its tick, whatever else happened.
    #[test]
    fn a_lost_robot_is_no_ordinary_end() {
        let found = |reason, hindrance: Option<EndReason>, phase: Phase| {
            let mut checks = checks();
            for (k, (hindrance, phase)) in [(None, Phase::Pouring), (hindrance, phase)].into_iter().enumerate() {
                let robot = Robot { hindrance, ..Robot::that_may_move(80.0, 1) };
                let now_ns = 33_000_000 * (k as u64 + 1);
                let feature =
                    Feature { captured_at_ns: now_ns - 20_000_000, sequence: k as u64 + 1, worker_epoch_ns: 1, ..Feature::default() };
                let times = Times { deadline_ns: 0, decided_at_ns: 0, written_at_ns: 0, done_ns: 0, margin_ns: 0 };
                let features = [feature].into_iter().collect();
                let tick = Tick { now_ns, features, robot, order: None, agent: None, target_deg: None, d_ml: 50.0, times };
                checks.tick(&tick, &Telemetry { phase: phase as u32, ..Telemetry::default() }, k as u64 + 1, k as f64 / 30.0);
            }
            checks.ended(&outcome(reason), 80.0, 1.0);
            checks.violations.iter().any(|v| v.invariant == "reason")
        };
        assert!(found(EndReason::StreamLost, Some(EndReason::RobotLost), Phase::NoRobot));
        assert!(!found(EndReason::StreamLost, None, Phase::Returning));
        assert!(found(EndReason::RobotLost, Some(EndReason::RobotLost), Phase::NoRobot), "nothing happened to the robot");
    }
}
