//! `trainer check`: says what is wrong with a data set before any training, in words.
//!
//! Offline, ordinary thread, allocates.

use serde::Serialize;
use shared::episode::Episode;
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::messages::Doubt;

use crate::consistency;
use crate::data::{self, Source, TrainingEpisode};

/// Tilt at the end below which an episode counts as returned, degrees.
const RETURNED_DEG: f64 = 5.0;
/// More than this share of lost frames is worth a line.
const GAPS: f64 = 0.05;

/// Command-line arguments of `trainer check`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  trainer check out/episodes
  trainer check features.csv --scale scale.csv --json")]
pub struct Args {
    #[command(flatten)]
    source: Source,
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
}

/// Looks at a data set.
pub fn check(episodes: &[Episode]) -> Findings {
    let usable = data::usable(episodes);
    let mut doubts = Vec::new();
    for e in episodes {
        if usable.left_out.iter().any(|(name, _)| *name == e.name) {
            continue;
        }
        let n = e.rows.len().max(1) as f64;
        let share = |f: &dyn Fn(&shared::episode::EpisodeRow) -> bool| e.rows.iter().filter(|x| f(x)).count() as f64 / n;
        let mut doubt = |what: String| doubts.push((e.name.clone(), what));
        let lost = share(&|f| f.lost);
        if lost > GAPS {
            doubt(format!("{:.0} % of the frames were lost: check the camera's connection and the load of the machine", 100.0 * lost));
        }
        let clipped = share(&|f| matches!(f.doubt, Doubt::LeavesRegion | Doubt::BlownOut | Doubt::TooDark));
        if clipped > GAPS {
            doubt(format!(
                "{:.0} % of the images are clipped, too dark or blown out: check exposure and [image] region_px",
                100.0 * clipped
            ));
        }
        let last = e.rows.last().map_or(0.0, |f| f64::from(f.alpha_commanded_deg));
        if last > RETURNED_DEG {
            doubt(format!("the angle never returns ({last:.0} degrees at the end): the last volume is not seen; record until upright"));
        }
        let rising = e.rows.first().map_or(0.0, |f| f64::from(f.alpha_commanded_deg));
        if rising > RETURNED_DEG {
            doubt(format!("starts at {rising:.0} degrees, not upright: what flowed before is on the scale but not in the images"));
        }
        let flowing_at_end = e.rows.iter().rev().take(3).all(|f| f.area_px2 > 0.0);
        if flowing_at_end && e.rows.len() > 3 {
            doubt("still flowing in the last frames: record until the stream has ended".into());
        }
    }
    doubts.extend(consistency::doubtful(&usable.episodes).into_iter().map(|d| (d.name.clone(), d.to_string())));
    doubts.extend(set_doubts(&usable.episodes));
    Findings { episodes: episodes.len(), usable: usable.episodes.len(), left_out: usable.left_out, doubts }
}

fn set_doubts(episodes: &[TrainingEpisode]) -> Vec<(String, String)> {
    let mut doubts = Vec::new();
    let mut doubt = |what: String| doubts.push(("data set".to_owned(), what));
    let n = episodes.len();
    if n == 0 {
        doubt("no episode can be trained on".into());
    } else if n < 4 {
        doubt(format!("{n} episodes: below 4 the camera's exponent cannot be told; method best works, 5 are much better"));
    }
    if n < 10 {
        doubt(format!("{n} episodes: enough for method best, too few for method paper, which needs 10"));
    }
    if let Some(first) = episodes.first()
        && episodes.iter().any(|e| (e.rate_hz - first.rate_hz).abs() > 0.5)
    {
        doubt("the episodes have different frame rates: train on one rate only".into());
    }
    doubts
}

/// Runs the command: fails when something was found (exit code 1), or nothing can be read (2).
pub fn run(args: &Args) -> Result<(), Failure> {
    let episodes = args.source.read().or_exit(exit::BAD_INPUT)?;
    let findings = check(&episodes);
    if args.json {
        println!("{}", serde_json::to_string_pretty(&findings).unwrap_or_default());
    } else {
        println!("{} episodes, {} usable", findings.episodes, findings.usable);
        for (name, what) in &findings.left_out {
            println!("cannot be used: {name}: {what}");
        }
        for (name, what) in &findings.doubts {
            println!("doubtful: {}", if what.starts_with(name.as_str()) { what.clone() } else { format!("{name}: {what}") });
        }
    }
    let wrong = !findings.left_out.is_empty() || findings.doubts.iter().any(|(name, _)| name != "data set") || findings.usable == 0;
    if wrong { Err(failure(exit::FAILED, "the data set is not as it should be")) } else { Ok(()) }
}
