//! `experiments evaluate`: pours in closed loop over a held-out grid and reports the errors.
//!
//! Ordinary threads, all cores, full speed; allocates. The same arguments give the same numbers on any number of threads. A bad argument
//! or weight file is an error of one line.

use std::path::PathBuf;

use indicatif::{ParallelProgressIterator, ProgressBar, ProgressStyle};
use rayon::prelude::*;
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::plural::counted;
use shared::weights::Weights;
use simulator::physics::vessel::VesselKind;
use trainer::report::json_out::JsonOut;
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
  experiments evaluate --vessel bottle,steep --first-rig 200 --rigs 20 --teach 5,2+3,5+5 --method best,best-sum,paper
  experiments evaluate --through-camera --rigs 5 --repeats 1")]
pub struct Args {
    /// Simulator: a (the paper's) or b (physical).
    #[arg(long, default_value = "b", value_parser = ["a", "b"])]
    sim: String,
    /// Number of rigs (simulator b).
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u64).range(1..=1000))]
    rigs: u64,
    /// Seed of the first rig.
    #[arg(long, default_value_t = 0, value_parser = clap::value_parser!(u64).range(..=1_000_000_000))]
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
    /// Lets method `law` pour so many times faster, its trickle at the end included, as in --method law --pace 0.5.
    #[arg(long, default_value_t = 1.0, value_parser = pace)]
    pace: f64,
    /// Actions of the trained policies: 2 or 21.
    #[arg(long, default_value_t = 21)]
    actions: u8,
    /// Judges these weight files instead of training.
    #[arg(long, conflicts_with_all = ["method", "weighed"])]
    weights: Vec<PathBuf>,
    /// Container, for training and test: cylinder, cone-in, cone-out, bottle, jug.
    #[arg(long, default_value = "cylinder", value_parser = ["cylinder", "cone-in", "cone-out", "bottle", "jug"])]
    container: String,
    /// Vessels, liquids or robots that are not straight, water and prompt, drawn from each rig's seed, comma-separated: rough, cone-in,
    /// cone-out, bottle, jug, carton, steep, slosh, lag, wild, or all. There is a table for each.
    #[arg(long, value_delimiter = ',', conflicts_with_all = ["container", "through_camera", "sim"])]
    vessel: Vec<String>,
    /// What a training is taught, comma-separated: N curves (5), or N curves and K weighed pours with a training after each (2+3). There is a
    /// table for each.
    #[arg(long, value_delimiter = ',', conflicts_with_all = ["episodes", "weighed", "weights"])]
    teach: Vec<String>,
    /// The demo without its processes: `trainer plan` proposes each of the --episodes weighings, and the demo's three pours are judged.
    #[arg(long, conflicts_with_all = ["sim", "teach"])]
    demo: bool,
    /// What is different at the test from what the training saw.
    #[arg(long, value_enum, default_value = "none")]
    change: Change,
    /// Renders each frame and runs the feature worker's extraction, instead of the area formula (simulator b).
    #[arg(long, conflicts_with = "change")]
    through_camera: bool,
    /// With --through-camera: clear water instead of a coloured liquid.
    #[arg(long, requires = "through_camera")]
    clear: bool,
    /// Keeps trained weights in this folder and takes them from there the next time, so that the same weights can be judged with another
    /// change. Use another folder after any change of the trainer.
    #[arg(long, value_name = "DIR")]
    keep: Option<PathBuf>,
    /// Prints the whole report, every pour included, as JSON in place of the tables, or writes it to FILE beside them.
    #[arg(long, value_name = "FILE", num_args = 0..=1, default_missing_value = "-")]
    json: Option<PathBuf>,
}

impl Args {
    /// What is taught, in the order of the tables.
    fn protocols(&self) -> Result<Vec<Protocol>, Failure> {
        let one = |episodes, weighed, refit_after_each| Protocol {
            episodes,
            weighed,
            by_plan: self.demo,
            refit_after_each,
            actions: self.actions,
            repeats: self.repeats,
            pace: self.pace,
        };
        if self.teach.is_empty() {
            return Ok(vec![one(self.episodes, self.weighed, false)]);
        }
        let read = |text: &String| {
            let (curves, pours) = text.split_once('+').unwrap_or((text, "0"));
            match (curves.parse::<u64>(), pours.parse::<u64>()) {
                (Ok(curves @ 1..=200), Ok(pours @ 0..=200)) => Ok(one(curves, pours, true)),
                _ => Err(failure(exit::BAD_INPUT, format!("--teach {text}: give N or N+K with N from 1 to 200 and K from 0 to 200"))),
            }
        };
        self.teach.iter().map(read).collect()
    }

    /// The kinds of drawn vessels, in the order of the tables; none for the straight ones.
    fn kinds(&self) -> Result<Vec<Option<VesselKind>>, Failure> {
        let mut kinds = Vec::new();
        for name in &self.vessel {
            match VesselKind::named(name) {
                Some(kind) => kinds.push(Some(kind)),
                None if name == "all" => kinds.extend(VesselKind::ALL.map(Some)),
                None => {
                    let names = VesselKind::ALL.map(VesselKind::name).join(", ");
                    return Err(failure(exit::BAD_INPUT, format!("--vessel {name}: there are {names} and all")));
                }
            }
        }
        Ok(if kinds.is_empty() { vec![None] } else { kinds })
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
    fn trials(&self, kind: Option<VesselKind>) -> Result<Vec<Trial>, String> {
        let rigs = if self.sim == "a" { 0..1 } else { self.first_rig..self.first_rig + self.rigs };
        rigs.flat_map(|rig| (0..self.seeds).map(move |seed| (rig, seed)))
            .map(|(rig, seed)| {
                let trial = match kind {
                    Some(kind) => Trial::drawn(kind, rig, seed, self.change),
                    None => Trial::new(&self.sim, rig, seed, &self.container, self.change),
                };
                let name = kind.map_or(self.container.as_str(), |kind| kind.name());
                let eye = if self.clear {
                    "-clear"
                } else if self.through_camera {
                    "-seen"
                } else {
                    ""
                };
                let keep = self.keep.as_ref().map(|dir| dir.join(format!("{}-{name}{eye}-{rig}-{seed}", self.sim)));
                let trial = Trial { keep, ..trial };
                if self.through_camera { trial.through_camera(rig, &self.container, self.clear) } else { Ok(trial) }
            })
            .collect()
    }
}

/// Reads a pace.
fn pace(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|pace| (0.1..=10.0).contains(pace)).ok_or_else(|| "give a number from 0.1 to 10".to_owned())
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
    let json = JsonOut::open(args.json.as_deref())?;
    if let Some(dir) = &args.keep {
        std::fs::create_dir_all(dir).map_err(|e| format!("{}: {e}", dir.display())).or_exit(exit::FAILED)?;
    }
    let mut files = Vec::new();
    for file in &args.weights {
        files.push((file.display().to_string(), Weights::read(file).or_exit(exit::BAD_INPUT)?));
    }
    let (kinds, protocols) = (args.kinds()?, args.protocols()?);
    let begin = std::time::Instant::now();
    let mut reports = Vec::new();
    let mut frames = 0;
    for kind in &kinds {
        let trials = args.trials(*kind).or_exit(exit::FAILED)?;
        for protocol in &protocols {
            let table = Table { vessel: kind.map_or(args.container.as_str(), |kind| kind.name()), protocol };
            let judged: Vec<Judged> = if files.is_empty() {
                args.method.iter().map(|pourer| Judged::new(&pourer.name(), &trials, |trial| trial.run(*pourer, protocol))).collect()
            } else {
                files
                    .iter()
                    .map(|(name, weights)| Judged::new(name, &trials, |trial| trial.judge(weights, args.repeats, args.demo)))
                    .collect()
            };
            let summaries: Vec<Summary> = judged.iter().map(|j| Summary::new(&j.name, &j.groups)).collect();
            if json.tables() {
                print(args, &table, &summaries);
            }
            frames += judged.iter().flat_map(|j| j.groups.iter().flatten()).map(|p| u64::from(p.frames)).sum::<u64>();
            if json.wanted() {
                let traces = examples(args, protocol, trials.first(), files.first().map(|(_, weights)| weights));
                reports.push(report(args, &table, &summaries, &traces, &judged));
            }
        }
    }
    eprintln!("{}, {:.1} s with training", counted(frames, "frame"), begin.elapsed().as_secs_f64());
    // One table is the report that `trainer report` reads; several are a list of them.
    json.write(&if reports.len() == 1 { reports.remove(0) } else { serde_json::Value::Array(reports) })
}

/// Which table it is.
struct Table<'a> {
    vessel: &'a str,
    protocol: &'a Protocol,
}

/// Prints the table of the methods, and how they differ from the first one.
fn print(args: &Args, table: &Table<'_>, summaries: &[Summary]) {
    println!(
        "sim {}, container {}, change {:?}, {} rigs from {} x {} data seeds, {} episodes + {} weighed pours, errors in ml",
        args.sim, table.vessel, args.change, args.rigs, args.first_rig, args.seeds, table.protocol.episodes, table.protocol.weighed
    );
    println!("{}", Summary::heading());
    for s in summaries {
        println!("{}", s.line());
    }
    for s in summaries.iter().filter(|s| !s.endings.is_empty()) {
        println!("{}", s.endings_line());
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
            if let Some(weights) = trial.kept(Pourer::Best, protocol).and_then(|file| Weights::read(&file).ok()) {
                return trial.examples(&weights);
            }
            let options = trial.options(MethodName::Best, Estimate::Fused, args.actions);
            trial.train(&options, protocol).map(|(t, _)| trial.examples(&t.weights)).unwrap_or_default()
        }
        _ => Vec::new(),
    }
}

/// Everything, every pour included, for `trainer report`.
fn report(args: &Args, table: &Table<'_>, summaries: &[Summary], traces: &[serde_json::Value], judged: &[Judged]) -> serde_json::Value {
    serde_json::json!({
        "kind": "evaluation", "sim": args.sim, "container": table.vessel, "change": args.change, "first_rig": args.first_rig,
        "rigs": args.rigs, "seeds": args.seeds, "episodes": table.protocol.episodes, "weighed": table.protocol.weighed, "actions": args.actions,
        "summaries": summaries, "traces": traces,
        "pours": judged.iter().map(|j| serde_json::json!({"name": j.name, "groups": j.groups})).collect::<Vec<_>>(),
    })
}
