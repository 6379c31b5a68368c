//! `experiments evaluate`: pours in closed loop over a held-out grid and reports the errors.
//!
//! Ordinary threads, all cores, full speed; allocates. The same arguments give the same numbers on any number of threads. A bad argument
//! or weight file is an error of one line.

use std::path::PathBuf;

use indicatif::{ParallelProgressIterator, ProgressBar, ProgressStyle};
use rayon::prelude::*;
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::weights::Weights;
use trainer::training::{Estimate, MethodName};

use crate::bench::pour::PourResult;
use crate::pour_evaluation::change::Change;
use crate::pour_evaluation::pourer::Pourer;
use crate::pour_evaluation::summary::{Summary, mean_ci};
use crate::pour_evaluation::trial::{Protocol, Trial};

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
    /// The methods and baselines that pour, comma-separated.
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
    /// Writes the whole report, every pour included, to this file as JSON.
    #[arg(long)]
    json: Option<PathBuf>,
}

impl Args {
    fn protocol(&self) -> Protocol {
        Protocol { episodes: self.episodes, weighed: self.weighed, actions: self.actions, repeats: self.repeats }
    }

    /// Refuses arguments that do not go together.
    fn check(&self) -> Result<(), Failure> {
        if self.through_camera && self.sim == "a" {
            return Err(failure(exit::BAD_INPUT, "--through-camera goes with --sim b: simulator a has nothing to look at"));
        }
        if self.actions != 2 && self.actions != 21 {
            return Err(failure(exit::BAD_INPUT, "--actions must be 2 or 21"));
        }
        Ok(())
    }

    /// One trial for each rig and data seed.
    fn trials(&self) -> Result<Vec<Trial>, String> {
        let rigs = if self.sim == "a" { 0..1 } else { self.first_rig..self.first_rig + self.rigs };
        rigs.flat_map(|rig| (0..self.seeds).map(move |seed| (rig, seed)))
            .map(|(rig, seed)| {
                let trial = Trial::new(&self.sim, rig, seed, &self.container, self.change);
                if self.through_camera { trial.through_camera(rig, &self.container) } else { Ok(trial) }
            })
            .collect()
    }
}

/// The pours of one method, in groups: one for each trial.
struct Judged {
    name: String,
    groups: Vec<Vec<PourResult>>,
}

impl Judged {
    /// Pours all trials with `pour`, in parallel.
    fn new(name: &str, trials: &[Trial], pour: impl Fn(&Trial) -> Vec<PourResult> + Sync + Send) -> Self {
        let style = ProgressStyle::with_template("{prefix} [{wide_bar}] {pos}/{len} rigs x seeds ({eta} left)");
        let bar = ProgressBar::new(trials.len() as u64).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar()));
        bar.set_prefix(name.to_owned());
        let groups: Vec<Vec<PourResult>> = trials.par_iter().progress_with(bar.clone()).map(pour).collect();
        bar.finish_and_clear();
        Self { name: name.to_owned(), groups }
    }
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    args.check()?;
    let mut files = Vec::new();
    for file in &args.weights {
        files.push((file.display().to_string(), Weights::read(file).or_exit(exit::BAD_INPUT)?));
    }
    let (trials, protocol) = (args.trials().or_exit(exit::FAILED)?, args.protocol());
    let begin = std::time::Instant::now();
    let judged: Vec<Judged> = if files.is_empty() {
        args.method.iter().map(|pourer| Judged::new(&pourer.name(), &trials, |trial| trial.run(*pourer, &protocol))).collect()
    } else {
        files.iter().map(|(name, weights)| Judged::new(name, &trials, |trial| trial.judge(weights, args.repeats))).collect()
    };
    let seconds = begin.elapsed().as_secs_f64();
    let summaries: Vec<Summary> = judged.iter().map(|j| Summary::new(&j.name, &j.groups)).collect();
    print(args, &summaries);
    let frames: u64 = judged.iter().flat_map(|j| j.groups.iter().flatten()).map(|p| u64::from(p.frames)).sum();
    eprintln!("{frames} frames, {seconds:.1} s with training");
    if let Some(file) = &args.json {
        let traces = examples(args, &protocol, trials.first(), files.first().map(|(_, weights)| weights));
        let text = serde_json::to_string(&report(args, &summaries, &traces, &judged)).unwrap_or_default();
        std::fs::write(file, text).map_err(|e| format!("{}: {e}", file.display())).or_exit(exit::FAILED)?;
    }
    Ok(())
}

/// Prints the table of the methods, and how they differ from the first one.
fn print(args: &Args, summaries: &[Summary]) {
    println!(
        "sim {}, container {}, change {:?}, {} rigs from {} x {} data seeds, {} episodes + {} weighed pours, errors in ml",
        args.sim, args.container, args.change, args.rigs, args.first_rig, args.seeds, args.episodes, args.weighed
    );
    println!("{}", Summary::heading());
    for s in summaries {
        println!("{}", s.line());
    }
    for s in summaries.iter().skip(1) {
        let paired: Vec<f64> = s.groups_ml.iter().zip(&summaries[0].groups_ml).map(|(b, a)| b - a).collect();
        let (mean, half) = mean_ci(&paired);
        println!("{} minus {}: {mean:+.2} +- {half:.2} ml MAE, paired over rigs and seeds", s.name, summaries[0].name);
    }
}

/// Example pours of the weights that are judged, or of method best trained once more.
fn examples(args: &Args, protocol: &Protocol, trial: Option<&Trial>, weights: Option<&Weights>) -> Vec<serde_json::Value> {
    match (weights, trial) {
        (Some(weights), Some(trial)) => trial.examples(weights),
        (None, Some(trial)) if args.method.contains(&Pourer::Best) => {
            let options = trial.options(MethodName::Best, Estimate::Fused, args.actions);
            trial.train(&options, protocol.episodes, protocol.weighed).map(|(t, _)| trial.examples(&t.weights)).unwrap_or_default()
        }
        _ => Vec::new(),
    }
}

/// Everything, every pour included, for `trainer report`.
fn report(args: &Args, summaries: &[Summary], traces: &[serde_json::Value], judged: &[Judged]) -> serde_json::Value {
    serde_json::json!({
        "kind": "evaluation", "sim": args.sim, "container": args.container, "change": args.change, "first_rig": args.first_rig,
        "rigs": args.rigs, "seeds": args.seeds, "episodes": args.episodes, "weighed": args.weighed, "actions": args.actions,
        "summaries": summaries, "traces": traces,
        "pours": judged.iter().map(|j| serde_json::json!({"name": j.name, "groups": j.groups})).collect::<Vec<_>>(),
    })
}
