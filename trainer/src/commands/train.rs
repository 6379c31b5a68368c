//! `trainer train`: episodes in, one weight file out.
//!
//! An offline command that allocates; it trains on ordinary threads. All options, the seed, the hash of the data and the learning curve are
//! kept beside the weight file (`W.json`). The same seed and data give the same bytes on any number of threads. What cannot be read,
//! trained on or written ends the command with one line.

use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use indicatif::{ProgressBar, ProgressStyle};
use shared::episode::{self, Episode};
use shared::estimator::flow::DELAY_MAX_FRAMES;
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::level::plain;
use shared::limits::Limits;
use shared::plural::counted;
use shared::weights::{Weights, check_way_back};
use shared::whole_file;

use super::check::doubtful_recordings;
use crate::consistency;
use crate::data::{self, EpisodeSource, UsableEpisodes};
use crate::method;
use crate::training::{Estimate, MethodName, Options, Progress, Trained};

/// How the file beside the weights begins: its keys are in the order of the alphabet. Another file of JSON is left as it is.
const JSON: &[u8] = b"{\n  \"calibration\"";

/// A delay this close to the longest one may be longer, frames: a tenth of what a pour's delay scatters.
const DELAY_NEAR_FRAMES: f64 = 0.1;

/// Command-line arguments of `trainer train`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  trainer train out/episodes --out out/weights.bin
  trainer train features.csv --scale scale.csv --out out/weights.bin
  trainer train out/episodes --estimate sum --seed 7 --out w.bin")]
pub struct Args {
    #[command(flatten)]
    source: EpisodeSource,
    /// Training method.
    #[arg(long, value_enum, default_value = "best")]
    method: MethodName,
    /// Number of actions: 2 (+-1 degree) or 21 (Fig. 5).
    #[arg(long, default_value_t = 21, value_parser = parse_actions)]
    actions: u8,
    /// How d is estimated. Without this, it is fused with methods best and paper, and sum with the others.
    #[arg(long, value_enum)]
    estimate: Option<Estimate>,
    #[command(flatten)]
    weight_file: WeightFileArgs,
}

/// The arguments that `trainer train` and `trainer refine` share.
#[derive(Debug, clap::Args)]
pub struct WeightFileArgs {
    /// Seed: the same seed and data give the same bytes.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Configuration of the cell, from which the limits and [container] holds_ml are taken; without it, the limits are the default ones.
    #[arg(long, env = shared::config::VARIABLE)]
    config: Option<PathBuf>,
    /// Where the weight file goes. A file that is there is replaced in one step.
    #[arg(long)]
    out: PathBuf,
    /// Print a report as JSON.
    #[arg(long)]
    pub json: bool,
    /// Say how far it has come in lines of JSON on standard error, for a program that shows it.
    #[arg(long)]
    progress: bool,
}

/// What a training is told of the cell.
#[derive(Debug, Default)]
pub struct KnownCell {
    /// The limits that the weights are made for.
    pub limits: Limits,
    /// What the vessel holds up to its lip, ml.
    pub holds_ml: Option<f64>,
}

fn parse_actions(text: &str) -> Result<u8, String> {
    match text {
        "2" => Ok(2),
        "21" => Ok(21),
        _ => Err("give 2 or 21".into()),
    }
}

/// Progress in lines of JSON: at most one a twentieth of a stage.
#[derive(Default)]
struct Lines(Mutex<(String, u64, u64)>);

impl Lines {
    fn say(name: &str, step: u64, steps: u64, note: &str) {
        eprintln!("{}", serde_json::json!({ "stage": name, "step": step, "steps": steps, "note": note }));
    }
}

impl Progress for Lines {
    fn stage(&self, name: &str, steps: u64) {
        *self.0.lock().unwrap_or_else(PoisonError::into_inner) = (name.to_owned(), steps, 0);
        Self::say(name, 0, steps, "");
    }
    fn at(&self, step: u64, note: &str) {
        let mut stage = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let (name, steps, said) = &mut *stage;
        if step >= *steps || step >= *said + *steps / 20 {
            *said = step;
            Self::say(name, step, *steps, note);
        }
    }
}

/// Progress on a terminal.
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

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    args.weight_file.check()?;
    let read = args.source.read().or_exit(exit::BAD_INPUT)?;
    let config = args.weight_file.config()?;
    let can_fuse = matches!(args.method, MethodName::Best | MethodName::Paper);
    let estimate = args.estimate.unwrap_or(if can_fuse { Estimate::Fused } else { Estimate::Sum });
    if estimate == Estimate::Fused && !can_fuse {
        let what = "--estimate fused goes with --method best or paper: the others learn on the paper's own sum";
        return Err(failure(exit::BAD_INPUT, what));
    }
    let usable = data::usable(&read);
    say_doubtful_recordings(&read, &usable);
    for doubt in consistency::doubtful(&usable.episodes) {
        eprintln!("doubtful: {}", plain(&doubt.to_string()));
    }
    let options = Options { method: args.method, actions: args.actions, estimate, seed: args.weight_file.seed, limits: config.limits };
    args.weight_file.train_and_write(&usable, &options, config.holds_ml, None, serde_json::Value::Null)
}

/// Says what is doubtful about how the episodes that are trained on were recorded.
pub fn say_doubtful_recordings(read: &[Episode], usable: &UsableEpisodes) {
    for (name, what) in doubtful_recordings(read, usable) {
        eprintln!("doubtful: {}", plain(&format!("{name}: {what}")));
    }
}

impl WeightFileArgs {
    /// The file beside the weights that says what they came from.
    fn beside(&self) -> PathBuf {
        let mut name = self.out.clone().into_os_string();
        name.push(".json");
        name.into()
    }

    /// Refuses, before the work, places where no file can be made and names that other files have: a weight file replaces nothing but a weight file.
    pub fn check(&self) -> Result<(), Failure> {
        Weights::may_write(&self.out).or_exit(exit::BAD_INPUT)?;
        let beside = self.beside();
        whole_file::check(&beside, JSON).map_err(|e| format!("{}: {e}", beside.display())).or_exit(exit::BAD_INPUT)
    }

    /// What is known of the cell; without a configuration, the default limits. One that cannot be read is bad input.
    pub fn config(&self) -> Result<KnownCell, Failure> {
        let Some(file) = &self.config else { return Ok(KnownCell::default()) };
        let config = shared::config::Config::read(file).or_exit(exit::BAD_INPUT)?;
        Ok(KnownCell { limits: config.limits, holds_ml: config.container.holds_ml })
    }

    /// Trains with a progress bar, writes the weight file and, beside it, everything that it came from (`W.json`); `extra` goes
    /// into that file as it is. `holds_ml` is what the vessel holds, if somebody knows that. Weights that cannot be those of this vessel are said; where
    /// `accepted` names some, or nothing, the others are refused.
    pub fn train_and_write(
        &self,
        usable: &UsableEpisodes,
        options: &Options,
        holds_ml: Option<f64>,
        accepted: Option<&[String]>,
        extra: serde_json::Value,
    ) -> Result<(), Failure> {
        for (name, what) in &usable.left_out {
            eprintln!("left out: {}", plain(&format!("{name}: {what}")));
        }
        if let (Estimate::Fused, false) = (options.estimate, usable.episodes.is_empty()) {
            check_way_back(&options.limits, data::rate_hz(&usable.episodes)).or_exit(exit::BAD_INPUT)?;
        }
        let style = ProgressStyle::with_template("{prefix} [{wide_bar}] {pos}/{len} {msg} ({eta} left)");
        let bar = Bar(ProgressBar::new(1).with_style(style.unwrap_or_else(|_| ProgressStyle::default_bar())));
        let begin = std::time::Instant::now();
        let progress: &dyn Progress = if self.progress { &Lines::default() } else { &bar };
        let trained = method::train(&usable.episodes, options, progress).or_exit(exit::BAD_INPUT)?;
        bar.0.finish_and_clear();
        let seconds = begin.elapsed().as_secs_f64();
        for (name, what) in trained.fit.iter().flat_map(|fit| consistency::doubts_of_set(&usable.episodes, fit, holds_ml)) {
            eprintln!("doubtful: {}", plain(&format!("{name}: {what}")));
        }
        if let (Some(fit), Some(accepted)) = (&trained.fit, accepted) {
            refuse_open(&consistency::against_vessel(&usable.episodes, fit, holds_ml), accepted)?;
        }
        if trained.fit.as_ref().is_some_and(|fit| fit.model.delay_frames >= DELAY_MAX_FRAMES - DELAY_NEAR_FRAMES) {
            eprintln!(
                "doubtful: the pictures seem to be late by {DELAY_MAX_FRAMES} frames or more, and no longer delay is modelled: check the camera"
            );
        }
        let out = &self.out;
        trained.weights.write(out).or_exit(exit::FAILED)?;
        let summary = summary(out, usable, options, &trained, extra);
        let text = serde_json::to_string_pretty(&summary).unwrap_or_default();
        let beside = self.beside();
        whole_file::replace(&beside, format!("{text}\n").as_bytes(), JSON)
            .map_err(|e| format!("{}: {e}; the weights are written, but not what they came from", beside.display()))
            .or_exit(exit::FAILED)?;
        if self.json {
            println!("{text}");
        } else {
            let n = counted(usable.episodes.len(), "episode");
            println!("{}: trained on {n} in {seconds:.1} s, identity {}", out.display(), trained.weights.identity());
        }
        Ok(())
    }
}

/// Refuses weights that the vessel cannot have held, but for those that are `accepted`: one line has all of them, as whoever starts this from another
/// program sees no other line.
fn refuse_open(of_vessel: &[(String, String)], accepted: &[String]) -> Result<(), Failure> {
    let open: Vec<_> = of_vessel.iter().filter(|(name, _)| !accepted.contains(name)).collect();
    if open.is_empty() {
        return Ok(());
    }
    let all: Vec<String> = open.iter().map(|(name, what)| format!("{name}: {what}")).collect();
    let mut answers: Vec<String> = open.iter().map(|(name, _)| format!("--accept '{name}'")).collect();
    answers.dedup();
    let (all, answers) = (all.join(" "), answers.join(" "));
    let what = format!("no weights are written. {all} Correct that with `feature-worker episodes`, or give {answers}");
    Err(failure(exit::BAD_INPUT, plain(&what)))
}

/// Everything that a weight file came from, as JSON for people and for `trainer report`.
fn summary(out: &Path, usable: &UsableEpisodes, options: &Options, trained: &Trained, extra: serde_json::Value) -> serde_json::Value {
    let weights = &trained.weights;
    serde_json::json!({
        "kind": "training",
        "weights": out,
        "identity": weights.identity(),
        "options": options,
        "episodes": usable.episodes.iter().map(|e| serde_json::json!({"name": e.name, "weight_g": e.weight_g})).collect::<Vec<_>>(),
        "left_out": usable.left_out,
        "data_sha256": episode::hex(&weights.origin.data_sha256),
        "calibration": weights.calibration,
        "estimator": weights.estimator,
        "law": trained.law,
        "search_cost": trained.search_curve,
        "loss": trained.loss,
        "extra": extra,
    })
}
