//! Pours in closed loop over a held-out grid and reports the errors.
//!
//! Ordinary threads, both cores, full speed; allocates. The same arguments give the same numbers on any number of threads.
//! Training sees only the episodes; the truth is used for nothing but the error.

use std::path::PathBuf;

use indicatif::{ParallelProgressIterator, ProgressBar, ProgressStyle};
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use serde::Serialize;
use shared::agent::Agent;
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::limits::Limits;
use shared::weights::Weights;
use trainer::calibration;
use trainer::data::TrainingEpisode;
use trainer::method::control_law::{self, ControlLaw};
use trainer::method::model_pour::PossiblePours;
use trainer::method::model_search;
use trainer::training::{Estimate, MethodName, Options, Silent, Trained};

use crate::bench::simulators::Bench;
use crate::bench::through_camera::BenchCamera;
use simulator::physics::RATE_HZ;
use simulator::physics::rig::Rig;

use crate::bench::baselines::{BangBang, ByLaw, HandPd, OpenLoop, Oracle, Sum};
use crate::bench::pour::{Baseline, Poured, Trace, by_controller, by_core, grid};

/// What pours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Pourer {
    /// Method best with the fused estimate.
    Best,
    /// Method best with the plain sum.
    BestSum,
    /// Eq. (8) repaired, with the fused estimate.
    Paper,
    /// Eq. (8) repaired, with the plain sum.
    PaperSum,
    /// Eq. (8) as printed.
    Literal,
    /// Eq. (8) as printed, with Keras' clip.
    LiteralClipped,
    /// Behaviour cloning.
    Cloning,
    /// A PD on the plain linear sum, first guess: what a lab would write.
    PdHand,
    /// A PD on the fused estimate, tuned by the same search as the policy.
    PdTuned,
    /// The law that the network was taught, without the network.
    Law,
    /// Forward, back, stop.
    BangBang,
    /// Eq. (1) without looking.
    OpenLoop,
    /// The true state: what control alone can reach.
    Oracle,
}

/// Something that is different from what the training saw.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Change {
    /// Nothing.
    None,
    /// Viscosity: flow x 0.6.
    FlowLow,
    /// Viscosity: flow x 1.5.
    FlowHigh,
    /// Frame noise x 2.
    Noise,
    /// Camera delay x 2.
    Delay,
    /// 10 % of the frames read 0.
    Dropouts,
    /// Camera gain - 5 %.
    GainLow,
    /// Camera gain + 5 %.
    GainHigh,
}

impl Change {
    /// All of them.
    pub const ALL: [Self; 8] =
        [Self::None, Self::FlowLow, Self::FlowHigh, Self::Noise, Self::Delay, Self::Dropouts, Self::GainLow, Self::GainHigh];

    fn apply(self, mut rig: Rig) -> Rig {
        match self {
            Self::None => {}
            Self::FlowLow => rig.fluidity *= 0.6,
            Self::FlowHigh => rig.fluidity *= 1.5,
            Self::Noise => rig.frame_noise *= 2.0,
            Self::Delay => rig.delay_frames *= 2,
            Self::Dropouts => rig.dropouts = 0.10,
            Self::GainLow => rig.gain *= 0.95,
            Self::GainHigh => rig.gain *= 1.05,
        }
        rig
    }
}

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  experiments evaluate --sim b --rigs 20 --seeds 2 --episodes 5
  experiments evaluate --method best,pd-tuned,pd-hand,oracle --json out/evaluation.json
  experiments evaluate --weights out/weights.bin --rigs 1
  experiments evaluate --weighed 5 --episodes 5
  experiments evaluate --container bottle --change noise
  experiments evaluate --through-camera --rigs 5 --repeats 1")]
pub struct Args {
    /// Simulator: a (the paper's) or b (physical).
    #[arg(long, default_value = "b", value_parser = ["a", "b"])]
    sim: String,
    /// Number of rigs (simulator b).
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=1000))]
    rigs: u64,
    /// Seed of the first rig.
    #[arg(long, default_value_t = 0)]
    first_rig: u64,
    /// Data seeds: sets of episodes recorded and trained on for each rig.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Episodes recorded for a training.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=200))]
    episodes: u64,
    /// Weighed pours that are added to them before the training that is judged.
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(0..=200))]
    weighed: u64,
    /// How often the grid of 45 pours is poured for each training.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..=100))]
    repeats: u64,
    /// What pours, comma-separated.
    #[arg(long, value_enum, value_delimiter = ',', default_value = "best")]
    method: Vec<Pourer>,
    /// Actions of the trained policies: 2 or 21.
    #[arg(long, default_value_t = 21)]
    actions: u8,
    /// Judges these weight files instead of training.
    #[arg(long, conflicts_with_all = ["method", "weighed"])]
    weights: Vec<PathBuf>,
    /// Container, for training and test: cylinder, cone-in, cone-out, bottle, jug.
    #[arg(long, default_value = "cylinder", value_parser = ["cylinder", "cone-in", "cone-out", "bottle", "jug"])]
    container: String,
    /// What is different at the test from what the training saw.
    #[arg(long, value_enum, default_value = "none")]
    change: Change,
    /// Renders each frame and runs the feature worker's extraction, instead of the area formula (simulator b).
    #[arg(long, conflicts_with = "change")]
    through_camera: bool,
    /// Writes everything, every pour included, to this file.
    #[arg(long)]
    json: Option<PathBuf>,
}

/// The errors of one method, ml.
#[derive(Debug, Clone, Serialize)]
pub struct Summary {
    /// The method, or the weight file.
    pub name: String,
    /// Pours.
    pub n: usize,
    /// Mean absolute error.
    pub mae_ml: f64,
    /// Half width of its 95 % interval over rigs and seeds.
    pub mae_ci_ml: f64,
    /// Median absolute error.
    pub median_ml: f64,
    /// 95th percentile of the absolute error.
    pub p95_ml: f64,
    /// Largest absolute error.
    pub max_ml: f64,
    /// Mean error: above 0 too much was poured.
    pub bias_ml: f64,
    /// Share within 5 ml.
    pub within_5_ml: f64,
    /// Share within 5 % of the goal.
    pub within_5_percent: f64,
    /// Pours that never poured.
    pub never_poured: usize,
    /// Pours that never stopped by themselves.
    pub never_stopped: usize,
    /// Mean absolute measurement error.
    pub measurement_ml: f64,
    /// Mean absolute control error.
    pub control_ml: f64,
    /// Mean duration of a pour, s.
    pub seconds: f64,
    /// Mean absolute error of each rig and seed, in order.
    pub groups_ml: Vec<f64>,
}

/// Mean and half width of the 95 % interval of group means.
pub fn mean_ci(groups: &[f64]) -> (f64, f64) {
    let n = groups.len().max(1) as f64;
    let mean = groups.iter().sum::<f64>() / n;
    if groups.len() < 2 {
        return (mean, f64::NAN);
    }
    let variance = groups.iter().map(|g| (g - mean).powi(2)).sum::<f64>() / (n - 1.0);
    (mean, 1.96 * (variance / n).sqrt())
}

impl Summary {
    /// Over groups (rig and seed) of pours.
    pub fn new(name: &str, groups: &[Vec<Poured>]) -> Self {
        let pours: Vec<&Poured> = groups.iter().flatten().collect();
        let n = pours.len().max(1) as f64;
        let mean = |f: &dyn Fn(&Poured) -> f64| pours.iter().map(|p| f(p)).sum::<f64>() / n;
        let mut errors: Vec<f64> = pours.iter().map(|p| p.error_ml().abs()).collect();
        errors.sort_by(f64::total_cmp);
        let quantile = |q: f64| errors.get(((q * n).ceil() as usize).clamp(1, errors.len().max(1)) - 1).copied().unwrap_or(f64::NAN);
        let groups_ml: Vec<f64> =
            groups.iter().map(|g| g.iter().map(|p| p.error_ml().abs()).sum::<f64>() / g.len().max(1) as f64).collect();
        Self {
            name: name.into(),
            n: pours.len(),
            mae_ml: mean(&|p| p.error_ml().abs()),
            mae_ci_ml: mean_ci(&groups_ml).1,
            median_ml: quantile(0.5),
            p95_ml: quantile(0.95),
            max_ml: errors.last().copied().unwrap_or(f64::NAN),
            bias_ml: mean(&Poured::error_ml),
            within_5_ml: mean(&|p| f64::from(p.error_ml().abs() <= 5.0)),
            within_5_percent: mean(&|p| f64::from(p.error_ml().abs() <= 0.05 * p.goal_ml)),
            never_poured: pours.iter().filter(|p| p.never_poured()).count(),
            never_stopped: pours.iter().filter(|p| p.never_stopped()).count(),
            measurement_ml: mean(&|p| p.measurement_ml().abs()),
            control_ml: mean(&|p| p.control_ml().abs()),
            seconds: mean(&|p| p.seconds),
            groups_ml,
        }
    }

    /// Heading of [`Summary::line`].
    pub fn heading() -> String {
        format!(
            "{:<16} {:>6} {:>14} {:>7} {:>7} {:>7} {:>7} {:>7} {:>7} {:>6} {:>8} {:>8} {:>6}",
            "method", "n", "MAE +- 95 %", "median", "p95", "max", "bias", "<=5 ml", "<=5 %", "fails", "measure", "control", "s"
        )
    }

    /// One row of the table.
    pub fn line(&self) -> String {
        format!(
            "{:<16} {:>6} {:>7.2} +- {:>3.2} {:>7.2} {:>7.2} {:>7.2} {:>7.2} {:>6.1}% {:>6.1}% {:>6} {:>8.2} {:>8.2} {:>6.1}",
            self.name,
            self.n,
            self.mae_ml,
            self.mae_ci_ml,
            self.median_ml,
            self.p95_ml,
            self.max_ml,
            self.bias_ml,
            100.0 * self.within_5_ml,
            100.0 * self.within_5_percent,
            self.never_poured + self.never_stopped,
            self.measurement_ml,
            self.control_ml,
            self.seconds
        )
    }
}

/// A rig and a data seed: what is recorded, trained and tested together.
#[derive(Debug, Clone)]
pub struct Setup {
    /// Bench of the training.
    pub bench: Bench,
    /// Bench of the test.
    pub test: Bench,
    /// Seed of the episodes.
    pub data_seed: u64,
    /// Seed of the test's pours.
    pub pour_seed: u64,
    /// Controller's limits.
    pub limits: Limits,
}

impl Setup {
    /// Simulator a or a rig of b, with a container and a change at the test.
    pub fn new(sim: &str, rig: u64, seed: u64, container: &str, change: Change) -> Self {
        let data_seed = rig.wrapping_mul(1000).wrapping_add(seed);
        let pour_seed = 77_000_000 + data_seed * 100_000;
        let benches = match Rig::seeded(rig).with_container(container) {
            Some(rig) if sim != "a" => (Bench::on(&rig), Bench::on(&change.apply(rig))),
            _ => (Bench::Paper, Bench::Paper),
        };
        Self { bench: benches.0, test: benches.1, data_seed, pour_seed, limits: Limits::default() }
    }

    /// The same rig with a rendered camera over it.
    pub fn through_camera(mut self, rig: u64, container: &str) -> Result<Self, String> {
        let Some(physics) = Rig::seeded(rig).with_container(container) else { return Ok(self) };
        self.bench = Bench::through_camera(&physics, BenchCamera::seeded(rig)?);
        self.test = self.bench.clone();
        Ok(self)
    }

    /// Goals of the grid that the container can pour at all within the tilt range.
    fn cells(&self, repeats: u64) -> Vec<(f64, f64, u64)> {
        let cells: Vec<(f64, f64)> = grid().into_iter().filter(|(init, goal)| *goal <= 0.95 * self.test.reach_ml(*init)).collect();
        (0..repeats)
            .flat_map(|r| {
                let cells = cells.clone();
                cells.into_iter().enumerate().map(move |(k, (init, goal))| (init, goal, r * 1000 + k as u64))
            })
            .collect()
    }

    /// Pours the grid with weights through the controller's core.
    pub fn judge(&self, weights: &Weights, repeats: u64) -> Vec<Poured> {
        let agent = Agent::new(weights);
        let pour = |(init, goal, k): (f64, f64, u64)| {
            by_core(&agent, &mut self.test.pour(init, self.pour_seed + k), self.limits, init, goal, None)
        };
        self.cells(repeats).into_iter().map(pour).collect()
    }

    /// A small, a middle and a large pour frame by frame, for the report.
    pub fn examples(&self, weights: &Weights) -> Vec<serde_json::Value> {
        let agent = Agent::new(weights);
        let example = |(init, goal): (f64, f64)| {
            let mut trace = Trace::default();
            by_core(&agent, &mut self.test.pour(init, self.pour_seed), self.limits, init, goal, Some(&mut trace));
            let area_4_px2: Vec<f64> = trace.area_px2.iter().map(|a| a / 4.0).collect();
            serde_json::json!({ "init_ml": init, "goal_ml": goal, "name": "policy", "t_s": trace.t_s, "alpha_deg": trace.alpha_deg,
                "true_ml": trace.true_ml, "area_4_px2": area_4_px2 })
        };
        [(225.0, 40.0), (300.0, 100.0), (375.0, 200.0)].map(example).into()
    }

    /// `k` pours with weights on the test's bench, recorded and weighed: what has changed is learned too.
    pub fn weighed_pours(&self, weights: &Weights, k: u64) -> Vec<TrainingEpisode> {
        let agent = Agent::new(weights);
        let mut rng = Pcg64Mcg::seed_from_u64(self.data_seed ^ 0x9_0000_0000);
        (0..k)
            .map(|n| {
                let init = rng.random_range(150.0..450.0f64);
                let goal = rng.random_range(20.0..200.0f64).min(0.85 * init).min(0.9 * self.test.reach_ml(init));
                let mut trace = Trace::default();
                let mut world = self.test.pour(init, rng.random());
                by_core(&agent, &mut world, self.limits, init, goal, Some(&mut trace));
                let misread: f64 = rand_distr::Distribution::sample(&rand_distr::StandardNormal, &mut rng);
                trace.weighed(&format!("pour {}", n + 1), (world.poured_ml() + 0.5 * misread).round())
            })
            .filter(|e| e.fault().is_none())
            .collect()
    }

    fn options(&self, method: MethodName, estimate: Estimate, actions: u8) -> Options {
        Options { method, estimate, actions, seed: self.data_seed + 1, limits: self.limits }
    }

    /// Trains on recorded episodes and, after `weighed` pours, again on all of them.
    pub fn train(&self, options: &Options, episodes: u64, weighed: u64) -> Option<(Trained, Vec<TrainingEpisode>)> {
        let mut data = self.bench.record(episodes as usize, self.data_seed);
        data.retain(|e| e.fault().is_none());
        let mut trained = trainer::method::train(&data, options, &Silent).ok()?;
        if weighed > 0 {
            data.extend(self.weighed_pours(&trained.weights, weighed));
            trained = trainer::method::train(&data, options, &Silent).ok()?;
        }
        Some((trained, data))
    }

    /// Pours the grid with a method, trained if it needs to be.
    pub fn run(&self, pourer: Pourer, args: &Args) -> Vec<Poured> {
        let options = match pourer {
            Pourer::Best | Pourer::PdTuned | Pourer::Law => self.options(MethodName::Best, Estimate::Fused, args.actions),
            Pourer::BestSum => self.options(MethodName::Best, Estimate::Sum, args.actions),
            Pourer::Paper => self.options(MethodName::Paper, Estimate::Fused, args.actions),
            Pourer::PaperSum => self.options(MethodName::Paper, Estimate::Sum, args.actions),
            Pourer::Literal => self.options(MethodName::Literal, Estimate::Sum, args.actions),
            Pourer::LiteralClipped => self.options(MethodName::LiteralClipped, Estimate::Sum, args.actions),
            Pourer::Cloning => self.options(MethodName::Cloning, Estimate::Sum, args.actions),
            Pourer::PdHand | Pourer::BangBang | Pourer::OpenLoop | Pourer::Oracle => return self.run_plain(pourer, args),
        };
        let tuned = |data: &[TrainingEpisode]| {
            let (fit, estimator) = model_search::estimator(data, Estimate::Fused, &self.limits);
            let possible = PossiblePours::new(&fit, self.limits, RATE_HZ, true);
            let (law, _) = control_law::search(&possible, ControlLaw::start_pd(true), model_search::SEARCH, options.seed, |_, _| {});
            (law, fit.calibration, estimator)
        };
        if pourer == Pourer::PdTuned {
            let mut data = self.bench.record(args.episodes as usize, self.data_seed);
            data.retain(|e| e.fault().is_none());
            let (law, calibration, estimator) = tuned(&data);
            return self.controllers(args, |goal| Box::new(ByLaw::new(law, calibration, &estimator, goal)));
        }
        let Some((trained, _)) = self.train(&options, args.episodes, args.weighed) else { return Vec::new() };
        match (pourer, trained.law) {
            (Pourer::Law, Some(law)) => {
                let weights = &trained.weights;
                self.controllers(args, |goal| Box::new(ByLaw::new(law, weights.calibration, &weights.estimator, goal)))
            }
            _ => self.judge(&trained.weights, args.repeats),
        }
    }

    fn controllers<'a>(&self, args: &Args, make: impl Fn(f64) -> Box<dyn Baseline + 'a>) -> Vec<Poured> {
        let pour = |(init, goal, k): (f64, f64, u64)| {
            by_controller(make(goal).as_mut(), &mut self.test.pour(init, self.pour_seed + k), self.limits, init, goal)
        };
        self.cells(args.repeats).into_iter().map(pour).collect()
    }

    fn run_plain(&self, pourer: Pourer, args: &Args) -> Vec<Poured> {
        let data = self.bench.record(args.episodes as usize, self.data_seed);
        let linear = calibration::calibrate(&data, Some(1.0));
        self.controllers(args, |goal| match pourer {
            Pourer::PdHand => Box::new(HandPd(Sum::new(&linear, goal))),
            Pourer::BangBang => Box::new(BangBang(Sum::new(&linear, goal))),
            Pourer::OpenLoop => Box::new(OpenLoop::new(&data, goal)),
            _ => Box::new(Oracle::new(goal, self.limits)),
        })
    }
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    if args.through_camera && args.sim == "a" {
        return Err(failure(exit::BAD_INPUT, "--through-camera goes with --sim b: simulator a has nothing to look at"));
    }
    if args.actions != 2 && args.actions != 21 {
        return Err(failure(exit::BAD_INPUT, "--actions is 2 or 21"));
    }
    let mut files = Vec::new();
    for file in &args.weights {
        files.push((file.display().to_string(), Weights::read(file).or_exit(exit::BAD_INPUT)?));
    }
    let rigs = if args.sim == "a" { 0..1 } else { args.first_rig..args.first_rig + args.rigs };
    let setups: Result<Vec<Setup>, String> = rigs
        .flat_map(|rig| (0..args.seeds).map(move |seed| (rig, seed)))
        .map(|(rig, seed)| {
            let setup = Setup::new(&args.sim, rig, seed, &args.container, args.change);
            if args.through_camera { setup.through_camera(rig, &args.container) } else { Ok(setup) }
        })
        .collect();
    let setups = setups.or_exit(exit::FAILED)?;
    let begin = std::time::Instant::now();
    let mut summaries = Vec::new();
    let mut all = Vec::new();
    let mut judge = |name: &str, pour: &(dyn Fn(&Setup) -> Vec<Poured> + Sync)| {
        let style = ProgressStyle::with_template("{prefix} [{wide_bar}] {pos}/{len} rigs x seeds ({eta} left)");
        let bar = ProgressBar::new(setups.len() as u64).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
        bar.set_prefix(name.to_owned());
        let groups: Vec<Vec<Poured>> = setups.par_iter().progress_with(bar.clone()).map(pour).collect();
        bar.finish_and_clear();
        summaries.push(Summary::new(name, &groups));
        all.push((name.to_owned(), groups));
    };
    for (name, weights) in &files {
        judge(name, &|setup| setup.judge(weights, args.repeats));
    }
    if files.is_empty() {
        for pourer in &args.method {
            let name = serde_json::to_value(pourer).ok().and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default();
            judge(&name, &|setup| setup.run(*pourer, args));
        }
    }
    let seconds = begin.elapsed().as_secs_f64();
    println!(
        "sim {}, container {}, change {:?}, {} rigs from {} x {} data seeds, {} episodes + {} weighed pours, errors in ml",
        args.sim, args.container, args.change, args.rigs, args.first_rig, args.seeds, args.episodes, args.weighed
    );
    println!("{}", Summary::heading());
    for s in &summaries {
        println!("{}", s.line());
    }
    for s in summaries.iter().skip(1) {
        let paired: Vec<f64> = s.groups_ml.iter().zip(&summaries[0].groups_ml).map(|(b, a)| b - a).collect();
        let (mean, half) = mean_ci(&paired);
        println!("{} minus {}: {mean:+.2} +- {half:.2} ml MAE, paired over rigs and seeds", s.name, summaries[0].name);
    }
    let traces = match (&args.json, files.first(), setups.first()) {
        (Some(_), Some((_, weights)), Some(setup)) => setup.examples(weights),
        (Some(_), None, Some(setup)) if args.method.contains(&Pourer::Best) => {
            let options = setup.options(MethodName::Best, Estimate::Fused, args.actions);
            setup.train(&options, args.episodes, args.weighed).map(|(t, _)| setup.examples(&t.weights)).unwrap_or_default()
        }
        _ => Vec::new(),
    };
    let frames: u64 = all.iter().flat_map(|(_, g)| g.iter().flatten()).map(|p| u64::from(p.frames)).sum();
    eprintln!("{frames} frames, {seconds:.1} s with training");
    if let Some(file) = &args.json {
        let report = serde_json::json!({
            "kind": "evaluation", "sim": args.sim, "container": args.container, "change": args.change, "first_rig": args.first_rig,
            "rigs": args.rigs, "seeds": args.seeds, "episodes": args.episodes, "weighed": args.weighed, "actions": args.actions,
            "summaries": summaries, "traces": traces,
            "pours": all.iter().map(|(name, groups)| serde_json::json!({"name": name, "groups": groups})).collect::<Vec<_>>(),
        });
        let text = serde_json::to_string(&report).unwrap_or_default();
        std::fs::write(file, text).map_err(|e| format!("{}: {e}", file.display())).or_exit(exit::FAILED)?;
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn args(rigs: u64) -> Args {
        #[derive(clap::Parser)]
        struct Line {
            #[command(flatten)]
            args: Args,
        }
        let line = ["evaluate".to_owned(), "--rigs".into(), rigs.to_string(), "--repeats".into(), "1".into()];
        <Line as clap::Parser>::parse_from(line).args
    }

    /// Protects the whole chain on the physical simulator: recorded, trained, poured through the controller's core, the policy
    /// meets goals that it never saw; and the same seeds give the same pours.
    #[test]
    fn a_trained_policy_meets_its_goals() {
        let setup = Setup::new("b", 1, 0, "cylinder", Change::None);
        let pours = setup.run(Pourer::Best, &args(1));
        let summary = Summary::new("best", std::slice::from_ref(&pours));
        assert_eq!((summary.n, summary.never_poured, summary.never_stopped), (45, 0, 0));
        assert!(summary.mae_ml < 3.5 && summary.control_ml < 0.5, "{}", summary.line());
        assert_eq!(pours, setup.run(Pourer::Best, &args(1)));
    }

    /// Protects `--through-camera`: what is recorded and poured is seen in rendered pictures, by the feature worker's extraction,
    /// and the policy trained on that meets its goal.
    #[test]
    fn a_pour_is_seen_through_the_rendered_camera() {
        let plain = Setup::new("b", 101, 0, "cylinder", Change::None);
        let seen = plain.clone().through_camera(101, "cylinder").unwrap();
        let options = seen.options(MethodName::Best, Estimate::Fused, 21);
        let (trained, data) = seen.train(&options, 3, 0).unwrap();
        for (by_picture, by_formula) in data.iter().zip(plain.bench.record(3, plain.data_seed)) {
            assert_eq!(by_picture.alpha_deg, by_formula.alpha_deg);
            assert_ne!(by_picture.area_px2, by_formula.area_px2);
        }
        let agent = Agent::new(&trained.weights);
        let poured = by_core(&agent, &mut seen.test.pour(300.0, seen.pour_seed), seen.limits, 300.0, 60.0, None);
        assert!(poured.ended && poured.error_ml().abs() < 8.0, "{poured:?}");
    }

    /// Protects the comparison: the oracle meets every goal, so what the others miss is theirs and not the bench's.
    #[test]
    fn the_oracle_meets_every_goal() {
        for sim in ["a", "b"] {
            let pours = Setup::new(sim, 2, 0, "cylinder", Change::None).run(Pourer::Oracle, &args(1));
            let summary = Summary::new("oracle", &[pours]);
            assert!(summary.max_ml < 0.7, "{sim}: {}", summary.line());
        }
    }

    /// Protects the report's numbers: mean, percentile, bias, failures and interval of known pours.
    #[test]
    fn summaries_count_right() {
        let one = |error: f64, ended: bool| Poured {
            init_ml: 300.0,
            goal_ml: 100.0,
            true_ml: 100.0 + error,
            believed_ml: 100.0,
            seconds: 5.0,
            frames: 150,
            ended,
        };
        let s = Summary::new("x", &[vec![one(1.0, true), one(-3.0, true)], vec![one(6.0, false), one(-100.0, true)]]);
        assert_eq!((s.mae_ml, s.bias_ml, s.max_ml, s.median_ml), (27.5, -24.0, 100.0, 3.0));
        assert_eq!((s.never_poured, s.never_stopped, s.within_5_ml, s.within_5_percent), (1, 1, 0.5, 0.5));
        assert_eq!(s.groups_ml, [2.0, 53.0]);
        assert!((s.mae_ci_ml - 1.96 * 25.5).abs() < 1e-9);
    }
}
