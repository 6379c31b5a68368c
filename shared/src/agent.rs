//! The agent: the weights at work in one pour. It turns each observation, which is one frame's V_e and the tilt, into one relative angle.
//!
//! Training, evaluation and run time all use this file, so that they see the same. When a pour ends is not decided here, but in the
//! controller's core.
//!
//! It is pure and runs in the controller's loop: it reads no clock, does not allocate, and does not panic, also for input that is not a
//! number.

use crate::actions::{self, ACTIONS, STAY, Selection};
use crate::estimator::Hold;
use crate::estimator::fused::{FusedEstimator, FusedFrame};
use crate::estimator::verdict::Impossible;
use crate::framing::Framing;
use crate::mlp;
use crate::os;
use crate::weights::{Estimator, Weights};

/// What is known of one camera frame when the agent acts on it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Observation {
    /// V_e in px^2; `None` if the frame was lost or its measurement must not be used.
    pub area_px2: Option<f32>,
    /// Confidence of the area, 0 to 1, as in [`crate::messages::Feature`]; NaN, where no camera says it, weighs in full.
    pub confidence: f32,
    /// Commanded alpha in force when this frame was taken, degrees from upright.
    pub alpha_deg: f32,
    /// Measured alpha when this frame was taken, degrees; NaN if the robot gives none.
    pub alpha_measured_deg: f32,
    /// Commanded alpha in force now, degrees; it differs from `alpha_deg` if the picture is older than the newest command.
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
    /// Standard deviation of `poured_ml` as far as the estimator knows it, ml; 0 if it does not know it.
    pub poured_sd_ml: f32,
    /// Volume that would still leave the container if the way back began now, ml; 0 with [`Estimator::Sum`].
    pub stop_ml: f32,
    /// The part of `stop_ml` that has still to come over the lip, and does not already hang on the wall outside, ml.
    pub over_lip_ml: f64,
    /// Whether d, less what is still on its way, has reached 0, so that the agent tilts back.
    pub tilting_back: bool,
    /// Whether liquid is seen to leave the container in this frame.
    pub flowing: bool,
    /// What the camera sees cannot be, by what was learned of vessel and flow; always `None` with [`Estimator::Sum`].
    pub impossible: Option<Impossible>,
}

impl Decision {
    /// The decision to stay while nothing is known of the volume.
    pub const NOTHING: Self = Self {
        action: STAY as u8,
        dalpha_deg: 0.0,
        v_ml: 0.0,
        d_ml: 0.0,
        poured_ml: 0.0,
        poured_sd_ml: 0.0,
        stop_ml: 0.0,
        over_lip_ml: 0.0,
        tilting_back: false,
        flowing: false,
        impossible: None,
    };
}

/// What the frames so far tell about the volume, see the fields of [`Decision`].
struct VolumeEstimate {
    poured_ml: f32,
    poured_sd_ml: f32,
    stop_ml: f32,
    over_lip_ml: f64,
}

/// After the way back has begun, the agent pours on if more than this is missing, ml. Chosen by hand; no measurement is recorded.
const RESUME_ML: f32 = 0.5;
/// The flow model is only asked about tilts in this range, degrees. Chosen by hand: no cell tilts a container further.
const MODEL_TILT_DEG: (f64, f64) = (-30.0, 200.0);
/// The most that [`Selection::Expected`] carries from one frame to the next, degrees. Chosen by hand; no measurement is recorded.
const CARRY_MAX_DEG: f32 = 1.0;

/// In how many parts the network is prefetched. Measured on an AMD EPYC: all 119 cache lines at once leave the forward pass at 460 ns, four
/// parts at 190, none at 760 (`cargo bench -p shared --bench forward`).
pub const PREFETCH_PARTS: usize = 4;

/// The weights at work in one pour: observations, estimator and network.
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
    pour_is_over: bool,
    carry_deg: f32,
    random: u64,
}

impl Agent {
    /// An agent that follows `weights`, with d = 0.
    pub fn new(weights: &Weights) -> Self {
        let (fused, back_deg) = match &weights.estimator {
            Estimator::Sum => (None, -weights.actions_deg[weights.back_action()]),
            Estimator::Fused { model, back } => {
                (Some(FusedEstimator::new(model, &weights.calibration, *back, weights.rate_hz.into())), back.rate_deg as f32)
            }
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
            pour_is_over: false,
            carry_deg: 0.0,
            random: weights.seed,
        }
    }

    /// The lag from a commanded tilt to what a picture shows of it, s, as it was learned from the episodes; `None` if the weights carry none.
    pub fn learned_lag_s(&self) -> Option<f64> {
        match &self.weights.estimator {
            Estimator::Sum => None,
            Estimator::Fused { model, .. } => {
                let model = model.likelier().model;
                Some((model.delay_frames + model.lag_frames) / f64::from(self.weights.rate_hz))
            }
        }
    }

    /// How the lip lay in the pictures that the weights were trained on.
    pub fn framing(&self) -> &Framing {
        &self.weights.origin.framing
    }

    /// Starts a pour: d <- V_G (eq. 4), and everything else is forgotten. A goal that is not a positive number leaves d = 0.
    pub fn start(&mut self, goal_ml: f32) {
        self.goal_ml = Some(goal_ml).filter(|g| g.is_finite() && *g > 0.0);
        self.hold = Hold::default();
        self.v_ml = [0.0; 3];
        self.summed_ml = 0.0;
        self.returning = false;
        self.pour_is_over = false;
        self.carry_deg = 0.0;
        if let Some(fused) = &mut self.fused {
            fused.restart();
        }
    }

    /// Brings a part of the network into the processor's caches, from which a sleep of 33 ms has often driven it. Call it for the parts 0
    /// to [`PREFETCH_PARTS`] - 1 with some work between, before [`Agent::step`]; it changes no result.
    pub fn prefetch(&self, part: usize) {
        os::prefetch(&self.weights.network, part, PREFETCH_PARTS);
    }

    /// Tells the agent that the pour is over. Until the next [`Agent::start`] it does not ask the network any more, but tilts back and
    /// counts.
    pub fn tilt_back(&mut self) {
        self.pour_is_over = true;
    }

    /// Takes one frame: d <- d - V_e (eq. 2), then the network's action. Call it once for every frame, the lost ones included, and after
    /// [`Agent::tilt_back`] until the last drop was seen, so that the whole volume is counted.
    pub fn step(&mut self, observation: Observation) -> Decision {
        let Some(goal_ml) = self.goal_ml else {
            return Decision::NOTHING;
        };
        let VolumeEstimate { poured_ml, poured_sd_ml, stop_ml, over_lip_ml } = self.observe(observation);
        let d_ml = goal_ml - poured_ml;
        // What is on its way counts as poured: the network is to stop in time.
        let d_net_ml = d_ml - stop_ml;
        if d_net_ml <= 0.0 {
            self.returning = true;
        } else if d_net_ml > RESUME_ML && self.fused.is_some() {
            self.returning = false;
        }
        let (action, dalpha_deg) = if self.returning || self.pour_is_over {
            (self.weights.back_action(), -self.back_deg)
        } else {
            let logits = self.weights.network.forward(&self.weights.scale.apply(self.v_ml, d_net_ml));
            let action = self.select(&logits);
            (action, self.weights.actions_deg[action])
        };
        Decision {
            action: action as u8,
            dalpha_deg,
            v_ml: self.v_ml[0],
            d_ml,
            poured_ml,
            poured_sd_ml,
            stop_ml,
            over_lip_ml,
            tilting_back: self.returning,
            flowing: self.v_ml[0] > 0.0,
            impossible: self.fused.as_ref().and_then(FusedEstimator::impossible),
        }
    }

    /// Adds the frame to the sum and gives it to the fused estimate, if there is one.
    fn observe(&mut self, observation: Observation) -> VolumeEstimate {
        let calibration = self.weights.calibration;
        // The filter judges dropouts itself, and says what is no measurement.
        let believed = self.fused.as_mut().is_none_or(|fused| {
            fused.step(FusedFrame {
                area_px2: observation.area_px2,
                confidence: observation.confidence,
                command_deg: f64::from(observation.alpha_deg),
                measured_deg: f64::from(observation.alpha_measured_deg),
            })
        });
        let area_px2 = self.hold.step(observation.area_px2.filter(|_| believed), calibration.hold_above_px2);
        let v_ml = calibration.volume_ml(area_px2, observation.alpha_deg);
        self.v_ml = [v_ml, self.v_ml[0], self.v_ml[1]];
        self.summed_ml += v_ml;
        let Some(fused) = &self.fused else {
            return VolumeEstimate { poured_ml: self.summed_ml, poured_sd_ml: 0.0, stop_ml: 0.0, over_lip_ml: 0.0 };
        };
        let (low, high) = MODEL_TILT_DEG;
        let stop_ml = fused.stop_volume_ml(f64::from(observation.alpha_now_deg).clamp(low, high)) as f32;
        VolumeEstimate {
            poured_ml: fused.poured_ml() as f32,
            poured_sd_ml: fused.poured_sd_ml() as f32,
            stop_ml,
            over_lip_ml: f64::from(stop_ml) - fused.flow_state().film_ml,
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
                self.carry_deg = (wanted - self.weights.actions_deg[action]).clamp(-CARRY_MAX_DEG, CARRY_MAX_DEG);
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

    /// The next random number in [0, 1), drawn by splitmix64.
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

    fn observation(area: f32) -> Observation {
        Observation { area_px2: Some(area), confidence: 1.0, alpha_deg: 50.0, alpha_measured_deg: f32::NAN, alpha_now_deg: 50.0 }
    }

    /// Protects the idle robot: with d = 0 the agent does nothing, whatever it sees.
    #[test]
    fn without_a_goal_it_does_nothing() {
        let mut agent = Agent::new(&example());
        for goal in [f32::NAN, -5.0, 0.0, f32::INFINITY] {
            agent.start(goal);
            for area in [0.0, 300.0, f32::NAN] {
                let decision = agent.step(observation(area));
                assert_eq!((decision.dalpha_deg, decision.d_ml, decision.tilting_back), (0.0, 0.0, false));
            }
        }
    }

    /// Protects eq. (2) and (4): d starts at the goal, falls by each frame's volume, goes below 0, and makes the agent tilt
    /// back.
    #[test]
    fn d_counts_down_and_turns_the_agent_back() {
        let weights = example();
        let mut agent = Agent::new(&weights);
        let v = weights.calibration.volume_ml(200.0, 50.0);
        agent.start(3.5 * v);
        let seen: Vec<Decision> = (0..5).map(|_| agent.step(observation(200.0))).collect();
        for (k, decision) in seen.iter().enumerate() {
            assert!((decision.d_ml - (3.5 - (k + 1) as f32) * v).abs() < 1e-4);
            assert_eq!(decision.tilting_back, k >= 3);
        }
        assert!(seen[4].d_ml < 0.0);
        assert!((seen[4].dalpha_deg + 3.2).abs() < 1e-6, "tilts back");
        agent.start(10.0);
        assert!(!agent.step(observation(0.0)).tilting_back, "a new goal starts anew");
    }

    /// Protects the shape of the observation: the three newest volumes, newest first, and d.
    #[test]
    fn the_network_sees_the_last_three_volumes_and_d() {
        let weights = example();
        let mut agent = Agent::new(&weights);
        agent.start(50.0);
        let areas = [100.0, 200.0, 150.0];
        let decision = areas.map(|a| agent.step(observation(a)))[2];
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
        // Half "stay", half the finest action: 0.025 degrees a frame on average, which no single action gives.
        (weights.network.b3[10], weights.network.b3[11]) = (0.0, 0.0);
        let mut agent = Agent::new(&weights);
        agent.start(50.0);
        let sum: f32 = (0..100).map(|_| agent.step(observation(0.0)).dalpha_deg).sum();
        assert!((sum - 2.5).abs() < 0.06, "{sum}");
    }

    /// Protects reproducibility: the same seed draws the same actions, another one draws others.
    #[test]
    fn sampling_is_seeded() {
        let mut weights = example();
        weights.selection = Selection::Sampled;
        let run = |weights: &Weights| {
            let mut agent = Agent::new(weights);
            agent.start(50.0);
            (0..50).map(|_| agent.step(observation(0.0)).action).collect::<Vec<_>>()
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
                let decision = agent.step(Observation { area_px2, confidence: 1.0, alpha_deg, alpha_measured_deg: f32::NAN, alpha_now_deg: alpha_deg });
                prop_assert!(decision.dalpha_deg.is_finite() && decision.dalpha_deg.abs() <= 5.0);
                prop_assert!(usize::from(decision.action) < ACTIONS);
            }
        }
    }
}
