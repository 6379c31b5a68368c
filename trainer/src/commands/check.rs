//! `trainer check`: says in words what is wrong with a data set, before any training.
//!
//! An offline command on an ordinary thread; it allocates. The command fails if something is wrong with an episode or no episode can be
//! used, so that scripts can rely on it. What is doubtful about the set as a whole, and what it does not span, is only said.

use std::path::PathBuf;

use serde::Serialize;
use shared::episode::{Episode, EpisodeRow};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::level::plain;
use shared::messages::Doubt;
use shared::plural::counted;

use crate::calibration::{self, EXPONENT_NEEDS};
use crate::consistency;
use crate::data::{self, EpisodeSource, TrainingEpisode, UsableEpisodes};
use crate::fit;
use crate::teaching::gaps::{self, Spanned};

/// An episode that begins or ends below this tilt counts as upright there, degrees. Chosen by hand; no measurement is recorded.
const UPRIGHT_DEG: f32 = 5.0;
/// No container flows below this tilt, degrees. Chosen by hand: a beaker that is full to its lip spills on the way to the robot.
const FLOWS_FROM_DEG: f32 = 2.0;
/// More than this share of lost or unseen frames is worth a line. Chosen by hand; no measurement is recorded.
const SHARE_MAX: f64 = 0.05;

/// Method `paper` needs at least this many episodes. From the prototype's figures for 5 and 10 episodes.
const PAPER_NEEDS: usize = 10;

/// Command-line arguments of `trainer check`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  trainer check out/episodes
  trainer check out/episodes --holds 520
  trainer check features.csv --scale scale.csv --json")]
pub struct Args {
    #[command(flatten)]
    source: EpisodeSource,
    /// What the vessel holds up to its lip, ml: the weights are compared with it.
    #[arg(long)]
    holds: Option<f64>,
    /// Configuration of the cell, from which [container] holds_ml is taken.
    #[arg(long, env = shared::config::VARIABLE)]
    config: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// What was found.
#[derive(Debug, Clone, Serialize)]
pub struct Findings {
    /// Episodes looked at.
    pub episodes: usize,
    /// Episodes that can be trained on.
    pub usable: usize,
    /// Episodes that a training would leave out, and why.
    pub left_out: Vec<(String, String)>,
    /// What is doubtful about episodes that can be used, or about the set.
    pub doubts: Vec<(String, String)>,
    /// Those of them with which `trainer refine` writes no weights until a person has judged them.
    pub refused: Vec<(String, String)>,
    /// What the episodes span; none without a usable episode.
    pub spanned: Option<Spanned>,
    /// Which areas, weights and fills they do not span, and what to record.
    pub missing: Vec<String>,
}

/// Looks for faults and doubts in a data set, of a vessel that holds `holds_ml`, if somebody knows that.
pub fn check(episodes: &[Episode], holds_ml: Option<f64>) -> Findings {
    let usable = data::usable(episodes);
    let fit = (!usable.episodes.is_empty()).then(|| fit::fit(&usable.episodes));
    let mut refused: Vec<_> = consistency::doubtful(&usable.episodes).into_iter().map(|d| (d.name.clone(), d.to_string())).collect();
    let mut doubts = doubtful_recordings(episodes, &usable);
    doubts.extend(refused.iter().cloned());
    doubts.extend(fit.iter().flat_map(|fit| consistency::doubts_of_set(&usable.episodes, fit, holds_ml)));
    refused.extend(fit.iter().flat_map(|fit| consistency::against_vessel(&usable.episodes, fit, holds_ml)));
    doubts.extend(set_doubts(&usable.episodes));
    let spanned = gaps::spanned(&usable.episodes, &calibration::calibrate(&usable.episodes, None));
    let missing = spanned.as_ref().map(Spanned::missing).unwrap_or_default();
    Findings { episodes: episodes.len(), usable: usable.episodes.len(), left_out: usable.left_out, doubts, refused, spanned, missing }
}

/// What is doubtful about how the usable episodes were recorded: the name of each, and what.
pub fn doubtful_recordings(episodes: &[Episode], usable: &UsableEpisodes) -> Vec<(String, String)> {
    let used = episodes.iter().filter(|e| usable.episodes.iter().any(|own| own.name == e.name));
    let of_one = used.flat_map(|e| recording_doubts(e).into_iter().map(|what| (e.name.clone(), what)));
    // The weights keep the pictures of those that say them: to pour in any pictures would be wrong for these episodes, too.
    let known = data::framing(&usable.episodes).is_known();
    let unknown = usable.episodes.iter().filter(|own| known && !own.framing.is_known());
    let what = "it does not say its pictures, and is taken to be of those of the others: make sure that it is, or leave it out";
    of_one.chain(unknown.map(|own| (own.name.clone(), what.into()))).collect()
}

/// What is doubtful about one recording.
fn recording_doubts(e: &Episode) -> Vec<String> {
    let mut doubts = Vec::new();
    let mut doubt = |what: String| doubts.push(what);
    let n = e.rows.len().max(1) as f64;
    let share = |of: fn(&EpisodeRow) -> bool| e.rows.iter().filter(|row| of(row)).count() as f64 / n;
    let lost = share(|row| row.lost);
    if lost > SHARE_MAX {
        doubt(format!("{:.0} % of the frames were lost: check the camera's connection and the load of the machine", 100.0 * lost));
    }
    let badly_lit = share(|row| matches!(row.doubt, Doubt::BlownOut | Doubt::TooDark));
    if badly_lit > SHARE_MAX {
        doubt(format!("{:.0} % of the images are too dark or blown out: check the exposure", 100.0 * badly_lit));
    }
    let unseen = share(|row| !row.lost && !row.area_px2.is_finite());
    if unseen > SHARE_MAX && badly_lit <= SHARE_MAX {
        doubt(format!(
            "{:.0} % of the images were not measured: `feature-worker episodes list` says why, and docs/FAQ.md what to do",
            100.0 * unseen
        ));
    }
    doubts.extend(angle_doubt(e));
    let mut doubt = |what: String| doubts.push(what);
    // A joint may stay where its command has left it.
    let tilt_deg = |row: Option<&EpisodeRow>| row.map_or(0.0, |row| row.alpha_commanded_deg.max(row.alpha_measured_deg));
    let last_deg = tilt_deg(e.rows.last());
    if last_deg > UPRIGHT_DEG {
        doubt(format!("the angle never returns ({last_deg:.0} degrees at the end): the last volume is not seen; record until upright"));
    }
    let first_deg = tilt_deg(e.rows.first());
    if first_deg > UPRIGHT_DEG {
        doubt(format!("starts at {first_deg:.0} degrees, not upright: what flowed before is on the scale but not in the images"));
    }
    if e.rows.len() > 3 && e.rows.iter().rev().filter(|row| row.area_px2.is_finite()).take(3).all(|row| row.area_px2 > 0.0) {
        doubt("still flowing in the last frames: record until the stream has ended".into());
    }
    doubts
}

/// What is doubtful about the angles: radians, another sign, or angles of nothing at all.
fn angle_doubt(e: &Episode) -> Option<String> {
    let highest_deg = e.rows.iter().map(|row| row.alpha_commanded_deg).fold(f32::NEG_INFINITY, f32::max);
    if highest_deg <= UPRIGHT_DEG {
        return Some(format!(
            "the angle never exceeds {highest_deg:.1} degrees, but a stream is seen: angles are in degrees, and pouring raises them"
        ));
    }
    // A lone area is a speck.
    let first = e.rows.windows(2).find(|two| two.iter().all(|row| row.area_px2 > 0.0)).map(|two| two[0].alpha_commanded_deg);
    first.filter(|deg| *deg < FLOWS_FROM_DEG).map(|deg| {
        format!("a stream is seen from {deg:.1} degrees on, where no container pours: check the angles, their times and the vision")
    })
}

/// What is doubtful about the data set as a whole.
fn set_doubts(episodes: &[TrainingEpisode]) -> Vec<(String, String)> {
    let mut doubts = Vec::new();
    let mut doubt = |what: String| doubts.push((consistency::DATA_SET.to_owned(), what));
    let n = episodes.len();
    if n == 0 {
        doubt("no episode can be trained on".into());
    } else if n < EXPONENT_NEEDS {
        doubt(format!(
            "{}: below {EXPONENT_NEEDS} the camera's exponent cannot be told; method best works, 5 are much better",
            counted(n, "episode")
        ));
    }
    if (1..PAPER_NEEDS).contains(&n) {
        doubt(format!("{}: enough for method best, too few for method paper, which needs {PAPER_NEEDS}", counted(n, "episode")));
    }
    doubts
}

/// Runs the command. It fails with exit code 1 if something is wrong with an episode or none can be used, and with 2 if the data cannot be
/// read.
pub fn run(args: &Args) -> Result<(), Failure> {
    let episodes = args.source.read().or_exit(exit::BAD_INPUT)?;
    let config = args.config.as_deref().map(shared::config::Config::read).transpose().or_exit(exit::BAD_INPUT)?;
    let findings = check(&episodes, args.holds.or(config.and_then(|c| c.container.holds_ml)));
    if args.json {
        println!("{}", serde_json::to_string_pretty(&findings).unwrap_or_default());
    } else {
        println!("{}, {} usable", counted(findings.episodes, "episode"), findings.usable);
        for (name, what) in &findings.left_out {
            println!("cannot be used: {}", plain(&format!("{name}: {what}")));
        }
        for (name, what) in &findings.doubts {
            println!("doubtful: {}", plain(&if what.starts_with(name.as_str()) { what.clone() } else { format!("{name}: {what}") }));
        }
        for what in &findings.missing {
            println!("not spanned: {what}");
        }
    }
    let wrong =
        !findings.left_out.is_empty() || findings.doubts.iter().any(|(name, _)| name != consistency::DATA_SET) || findings.usable == 0;
    if wrong { Err(failure(exit::FAILED, "the data set is not as it should be; what was found says what to do")) } else { Ok(()) }
}
