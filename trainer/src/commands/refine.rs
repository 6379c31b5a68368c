//! `trainer refine`: every pour teaches. Refits calibration, model and policy from all weighed episodes so far, pours
//! included, and writes a new weight file that the running controller takes live.
//!
//! Offline, ordinary threads, allocates. A weight that does not fit the others is asked about; without a terminal the
//! command stops and says how to answer.

use std::io::{BufRead, IsTerminal, Write};

use shared::episode::{Episode, EpisodeKind};
use shared::exit::{self, Failure, OrExit as _, failure};

use super::train::Target;
use crate::consistency;
use crate::data::{self, Source};
use crate::training::{Estimate, MethodName, Options};

/// Command-line arguments of `trainer refine`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  trainer refine out/episodes --out out/weights.bin
  trainer refine out/episodes --leave-out out/episodes/0007.mcap --out out/weights.bin
  trainer refine out/episodes --accept out/episodes/0007.mcap --out out/weights.bin")]
pub struct Args {
    #[command(flatten)]
    source: Source,
    /// Episodes whose weight is right although it does not fit the others.
    #[arg(long)]
    accept: Vec<String>,
    /// Episodes to leave out.
    #[arg(long)]
    leave_out: Vec<String>,
    #[command(flatten)]
    target: Target,
}

/// What the weighed pours among `episodes` show, in order: number, goal, weight (both ml), running mean absolute error.
pub fn pours(episodes: &[Episode]) -> Vec<(usize, f64, f64, f64)> {
    let mut sum = 0.0;
    let mut ordered: Vec<&Episode> = episodes.iter().collect();
    ordered.sort_by(|a, b| (a.info.started_at_utc.as_str(), a.name.as_str()).cmp(&(b.info.started_at_utc.as_str(), b.name.as_str())));
    let weighed = ordered.into_iter().filter_map(|e| match (e.kind, e.weight_g) {
        (EpisodeKind::Pour { goal_ml }, Some(weight)) => Some((f64::from(goal_ml), weight)),
        _ => None,
    });
    weighed
        .enumerate()
        .map(|(k, (goal, weight))| {
            sum += (weight - goal).abs();
            (k + 1, goal, weight, sum / (k + 1) as f64)
        })
        .collect()
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let read = args.source.read().or_exit(exit::BAD_INPUT)?;
    let limits = args.target.limits()?;
    let mut usable = data::usable(&read);
    usable.episodes.retain(|e| !args.leave_out.contains(&e.name));
    for doubt in consistency::doubtful(&usable.episodes) {
        if args.accept.contains(&doubt.name) {
            continue;
        }
        match ask(&doubt) {
            Some(true) => {}
            Some(false) => {
                usable.episodes.retain(|e| e.name != doubt.name);
                usable.left_out.push((doubt.name.clone(), "its weight does not fit the others".into()));
            }
            None => {
                let name = &doubt.name;
                let what = format!("{doubt} Correct it with `feature-worker episodes`, or give --leave-out {name} or --accept {name}");
                return Err(failure(exit::BAD_INPUT, what));
            }
        }
    }
    let history = pours(&read);
    let options = Options { method: MethodName::Best, actions: 21, estimate: Estimate::Fused, seed: args.target.seed, limits };
    let extra = serde_json::json!({ "pours": history.iter().map(|(n, goal, weight, mean)| serde_json::json!({"number": n, "goal_ml": goal, "weight_g": weight, "mae_so_far_ml": mean})).collect::<Vec<_>>() });
    args.target.train_and_write(&usable, &options, extra)?;
    if !args.target.json && !history.is_empty() {
        println!("pour   goal ml  scale g  error ml  mean |error| so far");
        for (n, goal, weight, mean) in history {
            println!("{n:>4} {goal:>9.1} {weight:>8.0} {:>9.1} {mean:>10.2}", weight - goal);
        }
    }
    Ok(())
}

/// Whether to use a doubtful weight; `None`: there is nobody to ask.
fn ask(doubt: &consistency::DoubtfulWeight) -> Option<bool> {
    if !std::io::stdin().is_terminal() {
        return None;
    }
    eprint!("{doubt}\nUse it all the same? [y/N] ");
    std::io::stderr().flush().ok()?;
    let mut answer = String::new();
    std::io::stdin().lock().read_line(&mut answer).ok()?;
    Some(answer.trim().eq_ignore_ascii_case("y"))
}
