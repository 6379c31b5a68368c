//! One rig and one set of episodes: they are recorded, a method is trained on them, and it pours the goals of the grid.
//!
//! Any thread; allocates. The same arguments give the same numbers on any number of threads. A training that fails pours nothing.

use std::path::PathBuf;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rt_controller::foreseen;
use shared::agent::Agent;
use shared::estimator::Calibration;
use shared::limits::Limits;
use shared::weights::{Estimator, Weights};
use simulator::physics::RATE_HZ;
use simulator::physics::rig::Rig;
use simulator::physics::vessel::VesselKind;
use trainer::calibration;
use trainer::data::TrainingEpisode;
use trainer::method::control_law::{self, ControlLaw};
use trainer::method::model_pour::PossiblePours;
use trainer::method::model_search;
use trainer::training::{Estimate, MethodName, Options, Silent, Trained};

use super::change::Change;
use super::pourer::Pourer;
use crate::bench::baselines::{BangBang, ByLaw, HandPd, OpenLoop, Oracle, Sum};
use crate::bench::eye_fault::EyeFault;
use crate::bench::pour::{Asked, Baseline, PourResult, Trace, by_baseline, by_core, grid};
use crate::bench::simulators::{Bench, BenchPour};
use crate::bench::through_camera::BenchCamera;

/// How each trial is carried out.
#[derive(Debug, Clone, Copy)]
pub struct Protocol {
    /// Episodes that are recorded for a training.
    pub episodes: u64,
    /// Weighed pours that are added to them before the training that is judged.
    pub weighed: u64,
    /// Whether `trainer plan` proposes what is weighed, so often as `episodes` and `weighed` say together, and the demo's pours are judged.
    pub by_plan: bool,
    /// Whether a training follows each weighed pour, and not only the last one.
    pub refit_after_each: bool,
    /// Actions of the trained networks: 2 or 21.
    pub actions: u8,
    /// How often the grid is poured.
    pub repeats: u64,
    /// How many times faster than searched [`Pourer::Law`] lets the liquid flow, and so how much shorter its trickle at the end is.
    pub pace: f64,
}

/// A rig and a data seed: what is recorded, trained and tested together.
#[derive(Debug, Clone)]
pub struct Trial {
    /// The bench on which the training's episodes are recorded.
    pub bench: Bench,
    /// The bench of the test; its rig may have changed.
    pub test: Bench,
    /// The fault of the eye in the test's pours, if there is one.
    pub eye: Option<EyeFault>,
    /// How many times what is in the vessel somebody tells the controller, if anybody does.
    pub told_fill: Option<f64>,
    /// Where trained weights are kept, and taken from the next time: the beginning of their files' names.
    pub keep: Option<PathBuf>,
    /// Seed of the episodes.
    pub data_seed: u64,
    /// Seed of the test's pours.
    pub pour_seed: u64,
    /// Limits of the controller.
    pub limits: Limits,
}

impl Trial {
    /// A trial on simulator `a`, or on a rig of simulator b with a container and a change at the test.
    pub fn new(sim: &str, rig: u64, seed: u64, container: &str, change: Change) -> Self {
        let data_seed = rig.wrapping_mul(1000).wrapping_add(seed);
        let pour_seed = 77_000_000 + data_seed * 100_000;
        let benches = match Rig::seeded(rig).with_container(container) {
            Some(rig) if sim != "a" => (Bench::on(&rig), Bench::on(&change.apply(rig))),
            _ => (Bench::Paper, Bench::Paper),
        };
        Self {
            bench: benches.0,
            test: benches.1,
            eye: change.eye(),
            told_fill: change.told_fill(),
            keep: None,
            data_seed,
            pour_seed,
            limits: Limits::default(),
        }
    }

    /// A trial on a rig whose vessel, liquid or robot is drawn as one of this kind.
    pub fn drawn(kind: VesselKind, rig: u64, seed: u64, change: Change) -> Self {
        let physics = Rig::drawn(kind, rig);
        let benches = (Bench::on(&physics), Bench::on(&change.apply(physics)));
        Self {
            bench: benches.0,
            test: benches.1,
            eye: change.eye(),
            told_fill: change.told_fill(),
            ..Self::new("a", rig, seed, "cylinder", Change::None)
        }
    }

    /// The same rig with a rendered camera before it, and clear water in it if `clear`.
    ///
    /// # Errors
    /// One line, when the camera cannot learn the liquid's colour.
    pub fn through_camera(mut self, rig: u64, container: &str, clear: bool) -> Result<Self, String> {
        let Some(physics) = Rig::seeded(rig).with_container(container) else { return Ok(self) };
        self.bench = Bench::through_camera(&physics, BenchCamera::seeded(rig, clear)?);
        self.test = self.bench.clone();
        Ok(self)
    }

    /// The pours of the grid, or of the demo, that the container can make within the tilt range: volume, goal and a number for each.
    fn cells(&self, repeats: u64, by_plan: bool) -> Vec<(f64, f64, u64)> {
        let all = match self.demo_plan() {
            Some(plan) if by_plan => plan.pours.iter().map(|pour| (pour.fill_ml, pour.goal_ml)).collect(),
            _ => grid(),
        };
        let cells: Vec<(f64, f64)> = all.into_iter().filter(|(init, goal)| *goal <= 0.95 * self.test.reach_ml(*init)).collect();
        (0..repeats)
            .flat_map(|r| {
                let cells = cells.clone();
                cells.into_iter().enumerate().map(move |(k, (init, goal))| (init, goal, r * 1000 + k as u64))
            })
            .collect()
    }

    /// A pour of the test from `init_ml`, as its eye sees it.
    fn test_pour(&self, init_ml: f64, number: u64) -> BenchPour {
        let seed = self.pour_seed + number;
        self.test.pour(init_ml, seed).seen_with(self.eye, seed)
    }

    /// Pours the grid with `weights` through the controller's core.
    pub fn judge(&self, weights: &Weights, repeats: u64, by_plan: bool) -> Vec<PourResult> {
        let agent = Agent::new(weights);
        let pour = |(init, goal, k): (f64, f64, u64)| {
            let flows_by_deg = self.told_fill.and_then(|times| foreseen::flows_by_deg(weights, times * init, self.test.full_ml()));
            let asked = Asked { flows_by_deg, calibration: Some(weights.calibration), ..Asked::new(init, goal) };
            by_core(&agent, &mut self.test_pour(init, k), self.limits, asked, None)
        };
        self.cells(repeats, by_plan).into_iter().map(pour).collect()
    }

    /// A small, a middle and a large pour, frame by frame, for the report.
    pub fn examples(&self, weights: &Weights) -> Vec<serde_json::Value> {
        let agent = Agent::new(weights);
        let example = |(init, goal): (f64, f64)| {
            let mut trace = Trace::default();
            by_core(&agent, &mut self.test.pour(init, self.pour_seed), self.limits, Asked::new(init, goal), Some(&mut trace));
            let area_4_px2: Vec<f64> = trace.area_px2.iter().map(|a| a / 4.0).collect();
            serde_json::json!({ "init_ml": init, "goal_ml": goal, "name": "policy", "t_s": trace.t_s, "alpha_deg": trace.alpha_deg,
                "true_ml": trace.true_ml, "area_4_px2": area_4_px2 })
        };
        [(225.0, 40.0), (300.0, 100.0), (375.0, 200.0)].map(example).into()
    }

    /// Makes `k` pours with `weights` on the test's bench, recorded and weighed, so that what has changed is learned too.
    pub fn weighed_pours(&self, weights: &Weights, k: u64) -> Vec<TrainingEpisode> {
        let agent = Agent::new(weights);
        let mut random = Pcg64Mcg::seed_from_u64(self.data_seed ^ 0x9_0000_0000);
        (0..k).map(|n| self.weighed_pour(&agent, n, &mut random)).filter(|e| e.fault().is_none()).collect()
    }

    /// Makes one pour from a drawn fill to a drawn goal, and weighs it.
    fn weighed_pour(&self, agent: &Agent, number: u64, random: &mut Pcg64Mcg) -> TrainingEpisode {
        let init = random.random_range(150.0..450.0f64);
        let goal = random.random_range(20.0..200.0f64).min(0.85 * init).min(0.9 * self.test.reach_ml(init));
        self.weigh_pour(agent, number, (init, goal), random)
    }

    /// Makes one pour from a fill to a goal, ml, and weighs it.
    pub(super) fn weigh_pour(&self, agent: &Agent, number: u64, (init, goal): (f64, f64), random: &mut Pcg64Mcg) -> TrainingEpisode {
        let mut trace = Trace::default();
        let mut pour = self.test.pour(init, random.random());
        by_core(agent, &mut pour, self.limits, Asked::new(init, goal), Some(&mut trace));
        let misread: f64 = rand_distr::Distribution::sample(&rand_distr::StandardNormal, random);
        trace.weighed(&format!("pour {}", number + 1), (pour.poured_ml() + 0.5 * misread).round())
    }

    /// Options of a training.
    pub fn options(&self, method: MethodName, estimate: Estimate, actions: u8) -> Options {
        Options { method, estimate, actions, seed: self.data_seed + 1, limits: self.limits }
    }

    /// Records episodes, and leaves out those that cannot be trained on.
    fn record(&self, episodes: u64) -> Vec<TrainingEpisode> {
        let mut data = self.bench.record(episodes as usize, self.data_seed);
        data.retain(|e| e.fault().is_none());
        data
    }

    /// Trains on recorded episodes and again on all of them after the weighed pours, or after each of them. None when a training fails.
    pub fn train(&self, options: &Options, protocol: &Protocol) -> Option<(Trained, Vec<TrainingEpisode>)> {
        let Protocol { episodes, weighed, .. } = *protocol;
        if protocol.by_plan {
            return self.first_hour(options, episodes + weighed);
        }
        let mut data = self.record(episodes);
        let mut trained = trainer::method::train(&data, options, &Silent).ok()?;
        if protocol.refit_after_each {
            let mut random = Pcg64Mcg::seed_from_u64(self.data_seed ^ 0x9_0000_0000);
            for n in 0..weighed {
                let episode = self.weighed_pour(&Agent::new(&trained.weights), n, &mut random);
                if episode.fault().is_none() {
                    data.push(episode);
                    trained = trainer::method::train(&data, options, &Silent).ok()?;
                }
            }
        } else if weighed > 0 {
            data.extend(self.weighed_pours(&trained.weights, weighed));
            trained = trainer::method::train(&data, options, &Silent).ok()?;
        }
        Some((trained, data))
    }

    /// The file in which the weights of a method are kept, if they are.
    pub fn kept(&self, pourer: Pourer, protocol: &Protocol) -> Option<PathBuf> {
        let beginning = self.keep.as_ref().filter(|_| pourer != Pourer::Law)?;
        let Protocol { episodes, weighed, actions, .. } = *protocol;
        let each = match protocol {
            Protocol { by_plan: true, .. } => "plan",
            Protocol { refit_after_each: true, .. } => "each",
            _ => "last",
        };
        Some(PathBuf::from(format!("{}-{episodes}+{weighed}-{each}-{actions}-{}.bin", beginning.display(), pourer.name())))
    }

    /// Pours the grid with a method, trained if it needs to be.
    pub fn run(&self, pourer: Pourer, protocol: &Protocol) -> Vec<PourResult> {
        let Some((method, estimate)) = pourer.training() else { return self.run_untrained(pourer, protocol) };
        let options = self.options(method, estimate, protocol.actions);
        if pourer == Pourer::PdTuned {
            let (law, calibration, estimator) = self.tuned_pd(&self.record(protocol.episodes), options.seed);
            return self.pour_grid(protocol, |goal| Box::new(ByLaw::new(law, calibration, &estimator, goal)));
        }
        let file = self.kept(pourer, protocol);
        if let Some(weights) = file.as_ref().and_then(|file| Weights::read(file).ok()) {
            return self.judge(&weights, protocol.repeats, protocol.by_plan);
        }
        let Some((trained, _)) = self.train(&options, protocol) else { return Vec::new() };
        // A file that cannot be written is one that the next run trains again.
        file.map(|file| trained.weights.write(&file));
        match (pourer, trained.law) {
            (Pourer::Law, Some(law)) => {
                let weights = &trained.weights;
                let law = law.at_pace(protocol.pace);
                self.pour_grid(protocol, |goal| Box::new(ByLaw::new(law, weights.calibration, &weights.estimator, goal)))
            }
            _ => self.judge(&trained.weights, protocol.repeats, protocol.by_plan),
        }
    }

    /// A PD on the fused estimate, tuned by the same search as the control law.
    fn tuned_pd(&self, data: &[TrainingEpisode], seed: u64) -> (ControlLaw, Calibration, Estimator) {
        let (fit, estimator) = model_search::estimator(data, Estimate::Fused, &self.limits);
        let possible = PossiblePours::new(&fit, self.limits, RATE_HZ, true);
        let (law, _) = control_law::search(&possible, ControlLaw::start_pd(true), model_search::SEARCH, seed, |_, _| {});
        (law, fit.calibration, estimator)
    }

    /// Pours the grid with the baselines that `make` makes for each goal.
    fn pour_grid<'a>(&self, protocol: &Protocol, make: impl Fn(f64) -> Box<dyn Baseline + 'a>) -> Vec<PourResult> {
        let pour =
            |(init, goal, k): (f64, f64, u64)| by_baseline(make(goal).as_mut(), &mut self.test_pour(init, k), self.limits, init, goal);
        self.cells(protocol.repeats, protocol.by_plan).into_iter().map(pour).collect()
    }

    /// Pours the grid with a baseline that is not trained.
    fn run_untrained(&self, pourer: Pourer, protocol: &Protocol) -> Vec<PourResult> {
        let data = self.bench.record(protocol.episodes as usize, self.data_seed);
        let linear = calibration::calibrate(&data, Some(1.0));
        self.pour_grid(protocol, |goal| match pourer {
            Pourer::PdHand => Box::new(HandPd(Sum::new(&linear, goal))),
            Pourer::BangBang => Box::new(BangBang(Sum::new(&linear, goal))),
            Pourer::OpenLoop => Box::new(OpenLoop::new(&data, goal)),
            _ => Box::new(Oracle::new(goal, self.limits)),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pour_evaluation::summary::Summary;

    const PROTOCOL: Protocol =
        Protocol { episodes: 5, weighed: 0, by_plan: false, refit_after_each: false, actions: 21, repeats: 1, pace: 1.0 };

    /// Protects the whole chain on the physical simulator: recorded, trained and poured through the controller's core, a network meets
    /// goals that it never saw, and the same seeds give the same pours.
    #[test]
    fn a_trained_policy_meets_its_goals() {
        let trial = Trial::new("b", 1, 0, "cylinder", Change::None);
        let pours = trial.run(Pourer::Best, &PROTOCOL);
        let summary = Summary::new("best", std::slice::from_ref(&pours));
        assert_eq!((summary.n, summary.never_poured, summary.never_stopped), (45, 0, 0));
        assert!(summary.mae_ml < 3.5 && summary.control_ml < 0.5, "{}", summary.line());
        assert_eq!(pours, trial.run(Pourer::Best, &PROTOCOL));
    }

    /// Protects the cup from a surface that swings: a law that was searched on level ones poured 46 ml more than these goals in the mean on rig 205.
    #[test]
    fn a_swinging_surface_is_poured_with_care() {
        for (rig, most_ml) in [(205, 20.0), (206, 12.0)] {
            let trial = Trial::drawn(VesselKind::Slosh, rig, 0, Change::None);
            let pours = trial.run(Pourer::Best, &Protocol { episodes: 2, weighed: 3, refit_after_each: true, ..PROTOCOL });
            let summary = Summary::new("best", &[pours]);
            assert!(summary.n == 45 && summary.control_ml < 1.0 && summary.max_ml < most_ml, "{rig}: {}", summary.line());
        }
    }

    /// Protects `--through-camera`: what is recorded and poured is seen in rendered pictures, by the feature worker's extraction, and a
    /// network that is trained on that meets its goal.
    #[test]
    fn a_pour_is_seen_through_the_rendered_camera() {
        let plain = Trial::new("b", 101, 0, "cylinder", Change::None);
        let seen = plain.clone().through_camera(101, "cylinder", false).unwrap();
        let options = seen.options(MethodName::Best, Estimate::Fused, 21);
        let (trained, data) = seen.train(&options, &Protocol { episodes: 3, ..PROTOCOL }).unwrap();
        for (by_picture, by_formula) in data.iter().zip(plain.bench.record(3, plain.data_seed)) {
            assert_eq!(by_picture.alpha_deg, by_formula.alpha_deg);
            assert_ne!(by_picture.area_px2, by_formula.area_px2);
        }
        let agent = Agent::new(&trained.weights);
        let poured = by_core(&agent, &mut seen.test.pour(300.0, seen.pour_seed), seen.limits, Asked::new(300.0, 60.0), None);
        assert!(poured.ended && poured.error_ml().abs() < 8.0, "{poured:?}");
    }

    /// Protects recordings of large streams before an even wall: the edge of a coloured stream is no foreign colour, so next to no frame is lost.
    #[test]
    fn a_large_stream_before_a_wall_is_measured() {
        let seen = Trial::new("b", 4, 0, "cylinder", Change::None).through_camera(4, "cylinder", false).unwrap();
        for episode in seen.bench.record(5, seen.data_seed) {
            let lost = episode.area_px2.iter().filter(|area| area.is_nan()).count();
            let flows = episode.area_px2.iter().filter(|area| **area > 0.0).count();
            assert!(flows > 30 && 20 * lost < flows, "{lost} of {flows} frames with a stream were lost");
        }
    }

    /// Protects an operator whose camera shows something else than the stream: little more than the goal leaves, and of the pours that end as
    /// done, what is said is near the truth. A camera that sees nothing at all ends by name. docs/LEARNING.md has the bounds over many rigs.
    #[test]
    fn a_faulty_eye_ends_by_name() {
        let right = Trial::new("b", 101, 0, "cylinder", Change::None);
        let (trained, _) = right.train(&right.options(MethodName::Best, Estimate::Fused, 21), &PROTOCOL).unwrap();
        assert!(Weights::from_bytes(&trained.weights.to_bytes().unwrap(), "kept").is_ok());
        for (change, most_ml) in [
            (Change::EyeBlindFill, 60.0),
            (Change::EyeStuck, 10.0),
            (Change::EyeWaverThin, 60.0),
            (Change::EyeWaver, 60.0),
            (Change::EyeWaverThick, 10.0),
            (Change::EyeWaverEarly, 10.0),
            (Change::EyeSpike, 12.0),
        ] {
            let pours = Trial::new("b", 101, 0, "cylinder", change).judge(&trained.weights, 1, false);
            let summary = Summary::new("best", &[pours]);
            assert!(summary.beyond_goal_ml < most_ml, "{change:?}: {}", summary.endings_line());
            // A false stream that begins before the real one and ends with the way back looks like a fuller vessel.
            let most_off_ml = if change == Change::EyeWaverEarly { f64::INFINITY } else { most_ml };
            assert!(summary.done_off_ml < most_off_ml, "{change:?}: {}", summary.endings_line());
            assert_eq!(summary.falsely_ended == 0, change == Change::EyeSpike, "{change:?}: {}", summary.endings_line());
        }
    }

    /// Protects the weight file: what the episodes say nothing about is cut to what a file holds. Of this vessel, the fit of five curves leaves a
    /// capacity open by many times itself.
    #[test]
    fn what_is_not_known_fits_into_a_file() {
        let trial = Trial::drawn(VesselKind::Steep, 202, 0, Change::None);
        let (trained, _) = trial.train(&trial.options(MethodName::Best, Estimate::Fused, 21), &PROTOCOL).unwrap();
        Weights::from_bytes(&trained.weights.to_bytes().unwrap(), "steep").unwrap();
    }

    /// Protects the comparison: the oracle meets every goal, so what the others miss is their fault and not the bench's.
    #[test]
    fn the_oracle_meets_every_goal() {
        for sim in ["a", "b"] {
            let pours = Trial::new(sim, 2, 0, "cylinder", Change::None).run(Pourer::Oracle, &PROTOCOL);
            let summary = Summary::new("oracle", &[pours]);
            assert!(summary.max_ml < 0.7, "{sim}: {}", summary.line());
        }
    }
}
