//! `trainer train`: episodes in, one weight file out.
//!
//! Offline, ordinary threads, allocates. The whole configuration, seed, data hash and learning curve are kept beside the
//! blob (`W.json`); the same seed and data give the same bytes on any number of threads.

use std::path::{Path, PathBuf};

use indicatif::{ProgressBar, ProgressStyle};
use shared::actions::{ACTIONS, action_table, nearest_action};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::limits::Limits;
use shared::weights::Weights;

use crate::best;
use crate::consistency;
use crate::data::{self, DataError, Source, TrainingEpisode, Usable};
use crate::eq8;
use crate::fit::Fit;
use crate::law::Law;

/// How d is estimated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Estimate {
    /// The paper's plain sum of the frames' volumes.
    Sum,
    /// Camera and container geometry, fused.
    Fused,
}

/// Training method.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum MethodName {
    /// The paper's section 3.3 as printed: eq. (5)-(8), rewards of either sign.
    Literal,
    /// The same, with the cross-entropy clipping probabilities to [1e-7, 1 - 1e-7], as Keras does silently.
    LiteralClipped,
    /// Eq. (8) repaired: positive weights only, kappa = 1, next-frame action, expected action at run time.
    Paper,
    /// Behaviour cloning, the largest output: eq. (8) with kappa = 1 and the same weight for every frame.
    Cloning,
    /// Flow model fitted to the episodes, policy search in it, distilled into the network.
    Best,
}

/// What a training is told.
#[derive(Debug, Clone, serde::Serialize)]
pub struct Options {
    /// Method.
    pub method: MethodName,
    /// 2 or 21.
    pub actions: u8,
    /// How d is estimated.
    pub estimate: Estimate,
    /// Seed.
    pub seed: u64,
    /// The controller's limits.
    pub limits: Limits,
}

impl Default for Options {
    fn default() -> Self {
        Self { method: MethodName::Best, actions: 21, estimate: Estimate::Fused, seed: 1, limits: Limits::default() }
    }
}

/// Hears how far a training is.
pub trait Progress: Sync {
    /// A new stage of `steps` steps.
    fn stage(&self, _name: &str, _steps: u64) {}
    /// Step `step` is done; `note` says how well it goes.
    fn at(&self, _step: u64, _note: &str) {}
}

/// Nobody listens.
pub struct Silent;
impl Progress for Silent {}

/// What came out.
#[derive(Debug, Clone)]
pub struct Trained {
    /// The weights.
    pub weights: Weights,
    /// The fit (method best).
    pub fit: Option<Fit>,
    /// The law found (method best).
    pub law: Option<Law>,
    /// Cost of the elites over the iterations of the search.
    pub search_curve: Vec<f64>,
    /// Loss of the network over its training.
    pub loss: Vec<f32>,
}

/// The action table for 21 actions (Fig. 5), or for two: output 0 is -1 degree, output 20 is +1 degree.
pub fn actions_table(actions: u8) -> [f32; ACTIONS] {
    if actions == 2 {
        let mut table = [0.0; ACTIONS];
        (table[0], table[ACTIONS - 1]) = (-1.0, 1.0);
        table
    } else {
        action_table()
    }
}

/// The action of `table` that stands for `dalpha_deg`; of two actions the one with its sign (standing still counts as back).
pub fn discretise(table: &[f32; ACTIONS], actions: u8, dalpha_deg: f64) -> u8 {
    match (actions, dalpha_deg > 0.0) {
        (2, true) => (ACTIONS - 1) as u8,
        (2, false) => 0,
        _ => nearest_action(table, dalpha_deg as f32) as u8,
    }
}

/// Trains on usable episodes.
pub fn train(episodes: &[TrainingEpisode], options: &Options, progress: &dyn Progress) -> Result<Trained, DataError> {
    if episodes.is_empty() {
        return Err(DataError::TooFew { found: 0, method: format!("{:?}", options.method).to_lowercase(), needed: 1 });
    }
    Ok(match options.method {
        MethodName::Best => best::train(episodes, options, progress),
        _ => eq8::train(episodes, options, progress),
    })
}

/// Command-line arguments of `trainer train`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  trainer train out/episodes --out out/weights.bin
  trainer train features.csv --scale scale.csv --out out/weights.bin
  trainer train out/episodes --estimate sum --seed 7 --out w.bin")]
pub struct Args {
    #[command(flatten)]
    source: Source,
    /// Training method.
    #[arg(long, value_enum, default_value = "best")]
    method: MethodName,
    /// Number of actions: 2 (+-1 degree) or 21 (Fig. 5).
    #[arg(long, default_value_t = 21, value_parser = parse_actions)]
    actions: u8,
    /// How d is estimated; fused with methods best and paper, sum with the others, if not given.
    #[arg(long, value_enum)]
    estimate: Option<Estimate>,
    /// Seed: the same seed and data give the same bytes.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Configuration of the cell, for the limits; without it the default limits.
    #[arg(long)]
    config: Option<PathBuf>,
    /// Where the weight file goes; replaced atomically.
    #[arg(long)]
    out: PathBuf,
    /// Print a report as JSON.
    #[arg(long)]
    json: bool,
}

fn parse_actions(text: &str) -> Result<u8, String> {
    match text {
        "2" => Ok(2),
        "21" => Ok(21),
        _ => Err("2 or 21".into()),
    }
}

struct Bar(ProgressBar);

impl Progress for Bar {
    fn stage(&self, name: &str, steps: u64) {
        self.0.reset();
        self.0.set_length(steps);
        self.0.set_prefix(name.to_owned());
        self.0.set_message("");
    }
    fn at(&self, step: u64, note: &str) {
        self.0.set_position(step);
        self.0.set_message(note.to_owned());
    }
}

/// The limits of a configuration, or the default ones.
pub fn limits(config: Option<&Path>) -> Result<Limits, shared::config::ConfigError> {
    config.map_or_else(|| Ok(Limits::default()), |file| shared::config::Config::read(file).map(|c| c.limits))
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let read = args.source.read().or_exit(exit::BAD_INPUT)?;
    let limits = limits(args.config.as_deref()).or_exit(exit::BAD_INPUT)?;
    let can_fuse = matches!(args.method, MethodName::Best | MethodName::Paper);
    let estimate = args.estimate.unwrap_or(if can_fuse { Estimate::Fused } else { Estimate::Sum });
    if estimate == Estimate::Fused && !can_fuse {
        let what = "--estimate fused goes with --method best or paper: the others learn on the paper's own sum";
        return Err(failure(exit::BAD_INPUT, what));
    }
    let usable = data::usable(&read);
    for doubt in consistency::doubtful(&usable.episodes) {
        eprintln!("doubtful: {doubt}");
    }
    let options = Options { method: args.method, actions: args.actions, estimate, seed: args.seed, limits };
    train_and_write(&usable, &options, &args.out, args.json, serde_json::Value::Null)
}

/// Trains with a progress bar, writes the weight file and, beside it, everything that it came from (`W.json`).
pub fn train_and_write(usable: &Usable, options: &Options, out: &Path, json: bool, extra: serde_json::Value) -> Result<(), Failure> {
    for (name, what) in &usable.left_out {
        eprintln!("left out: {name}: {what}");
    }
    let style = ProgressStyle::with_template("{prefix} [{wide_bar}] {pos}/{len} {msg} ({eta} left)");
    let bar = Bar(ProgressBar::new(1).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar())));
    let begin = std::time::Instant::now();
    let trained = train(&usable.episodes, options, &bar).or_exit(exit::BAD_INPUT)?;
    bar.0.finish_and_clear();
    let seconds = begin.elapsed().as_secs_f64();
    trained.weights.write(out).or_exit(exit::FAILED)?;
    let summary = serde_json::json!({
        "kind": "training",
        "weights": out,
        "identity": trained.weights.identity(),
        "options": options,
        "episodes": usable.episodes.iter().map(|e| serde_json::json!({"name": e.name, "weight_g": e.weight_g})).collect::<Vec<_>>(),
        "left_out": usable.left_out,
        "data_sha256": trained.weights.origin.data_sha256.iter().map(|b| format!("{b:02x}")).collect::<String>(),
        "calibration": trained.weights.calibration,
        "estimator": trained.weights.estimator,
        "law": trained.law,
        "search_cost": trained.search_curve,
        "loss": trained.loss,
        "extra": extra,
    });
    let mut beside = out.to_path_buf().into_os_string();
    beside.push(".json");
    let text = serde_json::to_string_pretty(&summary).unwrap_or_default();
    let beside = PathBuf::from(beside);
    std::fs::write(&beside, format!("{text}\n")).map_err(|e| format!("{}: {e}", beside.display())).or_exit(exit::FAILED)?;
    if json {
        println!("{text}");
    } else {
        let n = usable.episodes.len();
        println!("{}: trained on {n} episodes in {seconds:.1} s, identity {}", out.display(), trained.weights.identity());
    }
    Ok(())
}
