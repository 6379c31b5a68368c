//! The agent: one frame's V_e in, one relative angle out. The one observation pipeline of the project, used to the letter
//! by training, evaluation and run time.
//!
//! Pure and in the controller's loop: no clock, no allocation, no panic, also for input that is not a number.

use crate::actions::{self, ACTIONS, STAY, Selection};
use crate::estimator::Hold;
use crate::estimator::flow::FlowTables;
use crate::estimator::fused::FusedEstimator;
use crate::mlp;
use crate::weights::{Estimator, Weights};

/// What is known of one camera frame when the agent acts on it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// V_e in px^2; `None`: the frame was lost or its measurement is doubtful.
    pub area_px2: Option<f32>,
    /// Commanded alpha in force when this frame was taken, degrees from upright.
    pub alpha_deg: f32,
    /// Commanded alpha in force now, degrees; the same, unless the picture is older than the newest command.
    pub alpha_now_deg: f32,
}

/// What the agent makes of one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decision {
    /// Index of the action, 0..21 for i = -10..10.
    pub action: u8,
    /// Relative angle to request, degrees.
    pub dalpha_deg: f32,
    /// Outflow that this frame shows, ml.
    pub v_ml: f32,
    /// d after this frame, ml; negative when too much was poured.
    pub d_ml: f32,
    /// Estimated volume poured since the goal was set, ml.
    pub poured_ml: f32,
    /// Standard deviation of `poured_ml` as far as the estimator knows, ml; 0: it does not.
    pub poured_sd_ml: f32,
    /// Volume that would still leave if the way back began now, ml; 0 with [`Estimator::Sum`](crate::weights::Estimator).
    pub stop_ml: f32,
    /// d has reached 0, what is still on its way counted, and nothing more comes over the lip: bring the container upright.
    /// Stays true until the next [`Agent::start`].
    pub finished: bool,
    /// Liquid is seen leaving the container in this frame.
    pub flowing: bool,
}

impl Decision {
    /// Stay, and nothing known.
    pub const NOTHING: Self = Self {
        action: STAY as u8,
        dalpha_deg: 0.0,
        v_ml: 0.0,
        d_ml: 0.0,
        poured_ml: 0.0,
        poured_sd_ml: 0.0,
        stop_ml: 0.0,
        finished: false,
        flowing: false,
    };
}

/// What one frame says about the volume.
struct View {
    poured_ml: f32,
    poured_sd_ml: f32,
    stop_ml: f32,
}

/// After the way back has begun, this much missing volume makes the agent pour on, ml.
const RESUME_ML: f32 = 0.5;
/// After flow was seen, this much of a way back without flow ends the pour, degrees.
const BROUGHT_BACK_DEG: f32 = 10.0;
/// After flow was seen, this many frames without getting on by [`PROGRESS_DEG`] or [`PROGRESS_ML`] end the pour: the policy stands
/// still short of its goal, while what trickles is too little to be seen, or flickers about what can be seen.
const STALLED_FRAMES: u32 = 90;
/// Forward tilt that counts as getting on, degrees.
const PROGRESS_DEG: f32 = 1.0;
/// Poured volume that counts as getting on, ml.
const PROGRESS_ML: f32 = 0.5;
/// Less than this still to come over the lip counts as nothing, ml.
const NOTHING_ML: f64 = 0.05;

/// Observation pipeline, estimator and policy of one pour.
#[derive(Debug, Clone)]
pub struct Agent {
    weights: Weights,
    fused: Option<FusedEstimator>,
    back_deg: f32,
    goal_ml: Option<f32>,
    hold: Hold,
    v_ml: [f32; 3],
    summed_ml: f32,
    returning: bool,
    finished: bool,
    seen_flow: bool,
    brought_back_deg: f32,
    stalled_frames: u32,
    advanced_deg: f32,
    advanced_from_ml: f32,
    carry_deg: f32,
    random: u64,
}

impl Agent {
    /// An agent that follows `weights`, with d = 0.
    pub fn new(weights: &Weights) -> Self {
        let (fused, back_deg) = match &weights.estimator {
            Estimator::Sum => (None, -weights.actions_deg[weights.back_action()]),
            Estimator::Fused { model, back } => (Some(FusedEstimator::new(FlowTables::new(model), *back)), back.rate_deg as f32),
        };
        Self {
            weights: weights.clone(),
            fused,
            back_deg,
            goal_ml: None,
            hold: Hold::default(),
            v_ml: [0.0; 3],
            summed_ml: 0.0,
            returning: false,
            finished: false,
            seen_flow: false,
            brought_back_deg: 0.0,
            stalled_frames: 0,
            advanced_deg: 0.0,
            advanced_from_ml: 0.0,
            carry_deg: 0.0,
            random: weights.seed,
        }
    }

    /// Starts a pour: d <- V_G (eq. 4), everything else forgotten. A goal that is not a positive number leaves d = 0.
    pub fn start(&mut self, goal_ml: f32) {
        self.goal_ml = Some(goal_ml).filter(|g| g.is_finite() && *g > 0.0);
        self.hold = Hold::default();
        self.v_ml = [0.0; 3];
        self.summed_ml = 0.0;
        self.returning = false;
        self.finished = false;
        self.seen_flow = false;
        self.brought_back_deg = 0.0;
        self.stalled_frames = 0;
        self.advanced_deg = 0.0;
        self.advanced_from_ml = 0.0;
        self.carry_deg = 0.0;
        if let Some(fused) = &mut self.fused {
            fused.restart();
        }
    }

    /// One frame: d <- d - V_e (eq. 2), then the policy's action. Call it once for every frame, lost ones included, and
    /// after `finished` until the last drop was seen, so that the whole volume is counted.
    pub fn step(&mut self, observation: Observation) -> Decision {
        let Some(goal_ml) = self.goal_ml else {
            return Decision::NOTHING;
        };
        let view = self.observe(observation);
        let d_ml = goal_ml - view.poured_ml;
        // What is on its way counts as poured: the network is to stop in time.
        let d_net_ml = d_ml - view.stop_ml;
        if d_net_ml <= 0.0 {
            self.returning = true;
        } else if d_net_ml > RESUME_ML && self.fused.is_some() {
            self.returning = false;
        }
        let over = match &self.fused {
            Some(fused) => f64::from(view.stop_ml) - fused.flow_state().film_ml < NOTHING_ML,
            None => true,
        };
        self.finished |= self.returning && over;

        let (action, dalpha_deg) = if self.returning || self.finished {
            (self.weights.back_action(), -self.back_deg)
        } else {
            let logits = self.weights.network.forward(&self.weights.scale.apply(self.v_ml, d_net_ml));
            let action = self.select(&logits);
            (action, self.weights.actions_deg[action])
        };
        // A policy that stops a little early has come to its end too, although d is still above 0.
        self.seen_flow |= self.v_ml[0] > 0.0;
        self.brought_back_deg = if self.v_ml[0] > 0.0 || dalpha_deg > 0.0 { 0.0 } else { self.brought_back_deg - dalpha_deg };
        self.finished |= self.seen_flow && self.brought_back_deg > BROUGHT_BACK_DEG;
        // And so has one that stands still, or it would stand there for ever.
        self.advanced_deg += dalpha_deg;
        if self.advanced_deg >= PROGRESS_DEG || view.poured_ml - self.advanced_from_ml >= PROGRESS_ML {
            (self.stalled_frames, self.advanced_deg, self.advanced_from_ml) = (0, 0.0, view.poured_ml);
        } else {
            self.stalled_frames = self.stalled_frames.saturating_add(1);
        }
        self.finished |= self.seen_flow && self.stalled_frames >= STALLED_FRAMES;
        Decision {
            action: action as u8,
            dalpha_deg,
            v_ml: self.v_ml[0],
            d_ml,
            poured_ml: view.poured_ml,
            poured_sd_ml: view.poured_sd_ml,
            stop_ml: view.stop_ml,
            finished: self.finished,
            flowing: self.v_ml[0] > 0.0,
        }
    }

    /// Takes the frame into the sum and, if there is one, the filter.
    fn observe(&mut self, observation: Observation) -> View {
        let calibration = self.weights.calibration;
        let area_px2 = self.hold.step(observation.area_px2, calibration.hold_above_px2);
        let v_ml = calibration.volume_ml(area_px2, observation.alpha_deg);
        self.v_ml = [v_ml, self.v_ml[0], self.v_ml[1]];
        self.summed_ml += v_ml;
        let Some(fused) = &mut self.fused else {
            return View { poured_ml: self.summed_ml, poured_sd_ml: 0.0, stop_ml: 0.0 };
        };
        // The filter judges dropouts itself.
        let y_ml = observation.area_px2.map(|a| f64::from(calibration.volume_ml(a, observation.alpha_deg)));
        fused.step(y_ml, f64::from(observation.alpha_deg));
        View {
            poured_ml: fused.poured_ml() as f32,
            poured_sd_ml: fused.poured_sd_ml() as f32,
            stop_ml: fused.stop_volume_ml(f64::from(observation.alpha_now_deg).clamp(-30.0, 200.0)) as f32,
        }
    }

    fn select(&mut self, logits: &[f32; ACTIONS]) -> usize {
        match self.weights.selection {
            Selection::Argmax => mlp::argmax(logits),
            Selection::Expected => {
                let p = mlp::softmax(logits);
                let mean: f32 = p.iter().zip(&self.weights.actions_deg).map(|(p, a)| p * a).sum();
                let wanted = mean + self.carry_deg;
                let action = actions::nearest_action(&self.weights.actions_deg, wanted);
                self.carry_deg = (wanted - self.weights.actions_deg[action]).clamp(-1.0, 1.0);
                action
            }
            Selection::Sampled => {
                let mut left = self.uniform();
                for (k, p) in mlp::softmax(logits).iter().enumerate() {
                    left -= p;
                    if left < 0.0 {
                        return k;
                    }
                }
                STAY
            }
        }
    }

    /// Next number in [0, 1): splitmix64.
    fn uniform(&mut self) -> f32 {
        self.random = self.random.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let z = (self.random ^ (self.random >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        let z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((z ^ (z >> 31)) >> 40) as f32 / (1u64 << 24) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::weights::tests::example;
    use proptest::prelude::*;

    fn frame(area: f32) -> Observation {
        Observation { area_px2: Some(area), alpha_deg: 50.0, alpha_now_deg: 50.0 }
    }

    /// Protects the idle robot: with d = 0 the agent does nothing, whatever it sees.
    #[test]
    fn without_a_goal_it_does_nothing() {
        let mut agent = Agent::new(&example());
        for goal in [f32::NAN, -5.0, 0.0, f32::INFINITY] {
            agent.start(goal);
            for area in [0.0, 300.0, f32::NAN] {
                let decision = agent.step(frame(area));
                assert_eq!((decision.dalpha_deg, decision.d_ml, decision.finished), (0.0, 0.0, false));
            }
        }
    }

    /// Protects eq. (2) and (4): d starts at the goal, falls by each frame's volume, goes below 0, and ends the pour.
    #[test]
    fn d_counts_down_and_ends_the_pour() {
        let weights = example();
        let mut agent = Agent::new(&weights);
        let v = weights.calibration.volume_ml(200.0, 50.0);
        agent.start(3.5 * v);
        let seen: Vec<Decision> = (0..5).map(|_| agent.step(frame(200.0))).collect();
        for (k, decision) in seen.iter().enumerate() {
            assert!((decision.d_ml - (3.5 - (k + 1) as f32) * v).abs() < 1e-4);
            assert_eq!(decision.finished, k >= 3);
        }
        assert!(seen[4].d_ml < 0.0);
        assert!((seen[4].dalpha_deg + 3.2).abs() < 1e-6, "tilts back");
        agent.start(10.0);
        assert!(!agent.step(frame(0.0)).finished, "a new goal starts anew");
    }

    /// Protects the shape of the observation: the three newest volumes, newest first, and d.
    #[test]
    fn the_network_sees_the_last_three_volumes_and_d() {
        let weights = example();
        let mut agent = Agent::new(&weights);
        agent.start(50.0);
        let areas = [100.0, 200.0, 150.0];
        let decision = areas.map(|a| agent.step(frame(a)))[2];
        let v = areas.map(|a| weights.calibration.volume_ml(a, 50.0));
        let x = weights.scale.apply([v[2], v[1], v[0]], 50.0 - v.iter().sum::<f32>());
        assert_eq!(usize::from(decision.action), mlp::argmax(&weights.network.forward(&x)));
    }

    /// Protects the mean of the played angles: what the table cannot express in one frame is carried into the next.
    #[test]
    fn expected_actions_carry_their_remainder() {
        let mut weights = example();
        weights.selection = Selection::Expected;
        weights.network = crate::mlp::Mlp::ZERO;
        for b in &mut weights.network.b3 {
            *b = -100.0;
        }
        // Half "stay", half the finest action: 0.025 degrees a frame on average, which no action is.
        (weights.network.b3[10], weights.network.b3[11]) = (0.0, 0.0);
        let mut agent = Agent::new(&weights);
        agent.start(50.0);
        let sum: f32 = (0..100).map(|_| agent.step(frame(0.0)).dalpha_deg).sum();
        assert!((sum - 2.5).abs() < 0.06, "{sum}");
    }

    /// Protects the end of every pour: a policy that stands still short of its goal has come to its end, also while a trickle
    /// flickers in and out of sight; one that creeps on, still waits for its first flow, or pours has not.
    #[test]
    fn a_policy_that_stands_still_comes_to_its_end() {
        let mut weights = example();
        weights.network = crate::mlp::Mlp::ZERO;
        for (action, flow_at_first, flow_later, ends) in
            [(10, 100.0, 0.0, true), (10, 100.0, 0.1, true), (12, 100.0, 0.0, false), (10, 0.0, 0.0, false), (10, 100.0, 90.0, false)]
        {
            weights.network.b3 = [0.0; ACTIONS];
            weights.network.b3[action] = 1.0;
            let mut agent = Agent::new(&weights);
            agent.start(5000.0);
            let first = agent.step(frame(flow_at_first));
            let ended = (0..200).map(|_| agent.step(frame(flow_later))).filter(|d| d.finished).count();
            assert_eq!((first.finished, ended > 0), (false, ends), "action {action}, then {flow_later} px^2");
        }
    }

    /// Protects reproducibility of the sampling policy.
    #[test]
    fn sampling_is_seeded() {
        let mut weights = example();
        weights.selection = Selection::Sampled;
        let run = |weights: &Weights| {
            let mut agent = Agent::new(weights);
            agent.start(50.0);
            (0..50).map(|_| agent.step(frame(0.0)).action).collect::<Vec<_>>()
        };
        let first = run(&weights);
        assert_eq!(first, run(&weights));
        assert!(first.iter().any(|a| *a != first[0]), "draws differ");
        weights.seed = 2;
        assert_ne!(first, run(&weights));
    }

    proptest! {
        /// Protects the robot and the loop: any input gives a finite action of the table, and never a panic.
        #[test]
        fn any_input_gives_a_finite_action(
            goal in any::<f32>(),
            frames in prop::collection::vec((prop::option::of(prop_oneof![any::<f32>(), 0f32..500.0]), prop_oneof![any::<f32>(), 0f32..110.0]), 0..60),
            fused in any::<bool>(),
            selection in prop::sample::select(vec![Selection::Argmax, Selection::Expected, Selection::Sampled]),
        ) {
            let mut weights = if fused { crate::weights::tests::fused_example() } else { example() };
            weights.selection = selection;
            let mut agent = Agent::new(&weights);
            agent.start(goal);
            for (area_px2, alpha_deg) in frames {
                let decision = agent.step(Observation { area_px2, alpha_deg, alpha_now_deg: alpha_deg });
                prop_assert!(decision.dalpha_deg.is_finite() && decision.dalpha_deg.abs() <= 5.0);
                prop_assert!(usize::from(decision.action) < ACTIONS);
            }
        }
    }
}
