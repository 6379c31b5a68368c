//! `trainer train`: episodes in, one weight file out.
//!
//! Offline, ordinary threads, allocates. The whole configuration, seed, data hash and learning curve are kept beside the
//! blob (`W.json`); the same seed and data give the same bytes on any number of threads.

use std::path::PathBuf;
use std::process::ExitCode;

use indicatif::{ProgressBar, ProgressStyle};
use shared::limits::Limits;
use shared::policy::{ACTIONS, action_table};
use shared::weights::Weights;

use crate::best;
use crate::data::{self, DataError, TrainingEpisode};
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

/// Trains on usable episodes.
pub fn train(episodes: &[TrainingEpisode], options: &Options, progress: &dyn Progress) -> Result<Trained, DataError> {
    if episodes.is_empty() {
        return Err(DataError::TooFew { found: 0, method: format!("{:?}", options.method).to_lowercase(), needed: 1 });
    }
    Ok(match options.method {
        MethodName::Best => best::train(episodes, options, progress),
    })
}

/// Command-line arguments of `trainer train`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  trainer train out/episodes --out out/weights.bin
  trainer train features.csv --scale scale.csv --out out/weights.bin
  trainer train out/episodes --estimate sum --seed 7 --out w.bin")]
pub struct Args {
    /// MCAP episodes, or directories of them; with --scale: the table of features.
    #[arg(required = true)]
    episodes: Vec<PathBuf>,
    /// Table of weights (`episode, weight_g`); the episodes are then read from a table too.
    #[arg(long)]
    scale: Option<PathBuf>,
    /// Training method.
    #[arg(long, value_enum, default_value = "best")]
    method: MethodName,
    /// Number of actions: 2 (+-1 degree) or 21 (Fig. 5).
    #[arg(long, default_value_t = 21, value_parser = parse_actions)]
    actions: u8,
    /// How d is estimated.
    #[arg(long, value_enum, default_value = "fused")]
    estimate: Estimate,
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

/// Runs the command; the exit codes are those of [`shared::exit`].
pub fn run(args: &Args) -> ExitCode {
    let read = match data::read(&args.episodes, args.scale.as_deref()) {
        Ok(read) => read,
        Err(e) => return shared::exit::fail(shared::exit::BAD_INPUT, e),
    };
    let limits = match &args.config {
        None => Limits::default(),
        Some(file) => match shared::config::Config::read(file) {
            Ok(config) => config.limits,
            Err(e) => return shared::exit::fail(shared::exit::BAD_INPUT, e),
        },
    };
    let usable = data::usable(&read);
    for (name, what) in &usable.left_out {
        eprintln!("left out: {name}: {what}");
    }
    let options = Options { method: args.method, actions: args.actions, estimate: args.estimate, seed: args.seed, limits };
    let style = ProgressStyle::with_template("{prefix} [{wide_bar}] {pos}/{len} {msg} ({eta} left)")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    let bar = Bar(ProgressBar::new(1).with_style(style));
    let begin = std::time::Instant::now();
    let trained = match train(&usable.episodes, &options, &bar) {
        Ok(trained) => trained,
        Err(e) => return shared::exit::fail(shared::exit::BAD_INPUT, e),
    };
    bar.0.finish_and_clear();
    let seconds = begin.elapsed().as_secs_f64();
    if let Err(e) = trained.weights.write(&args.out) {
        return shared::exit::fail(shared::exit::FAILED, e);
    }
    let summary = serde_json::json!({
        "weights": args.out,
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
    });
    let mut beside = args.out.clone().into_os_string();
    beside.push(".json");
    let text = serde_json::to_string_pretty(&summary).unwrap_or_default();
    if let Err(e) = std::fs::write(&beside, format!("{text}\n")) {
        return shared::exit::fail(shared::exit::FAILED, format!("{}: {e}", PathBuf::from(&beside).display()));
    }
    if args.json {
        println!("{text}");
    } else {
        println!(
            "{}: trained on {} episodes in {seconds:.1} s, identity {}",
            args.out.display(),
            usable.episodes.len(),
            trained.weights.identity()
        );
    }
    ExitCode::SUCCESS
}
