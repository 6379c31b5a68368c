//! `trainer refine`: every pour teaches. It refits calibration, model and network from all weighed episodes so far, pours
//! included, and writes a new weight file, which a running controller takes between two pours.
//!
//! An offline command that allocates; it trains on ordinary threads. A weight that does not fit the others is asked about. Without a
//! terminal, the command stops and says how to answer.

use std::io::{BufRead, IsTerminal, Write};

use serde::Serialize;
use shared::episode::{Episode, EpisodeKind};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::level::plain;

use super::train::{WeightFileArgs, say_doubtful_recordings};
use crate::consistency;
use crate::data::{self, EpisodeSource, TrainingEpisode};
use crate::training::Options;

/// Command-line arguments of `trainer refine`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  trainer refine out/episodes --out out/weights.bin
  trainer refine out/episodes --leave-out out/episodes/0007.mcap --out out/weights.bin
  trainer refine out/episodes --accept out/episodes/0007.mcap --out out/weights.bin")]
pub struct Args {
    #[command(flatten)]
    source: EpisodeSource,
    /// Episodes whose weight is right although it does not fit the others or the vessel; 'data set' for all of them together.
    #[arg(long)]
    accept: Vec<String>,
    /// Episodes to leave out.
    #[arg(long)]
    leave_out: Vec<String>,
    #[command(flatten)]
    weight_file: WeightFileArgs,
}

/// What one weighed pour shows.
#[derive(Debug, Clone, Copy, Serialize)]
struct WeighedPour {
    /// Counted from 1, in the order in which they were poured.
    number: usize,
    goal_ml: f64,
    /// What the scale showed, g (1 g = 1 ml).
    weight_g: f64,
    /// Mean absolute error of this pour and all before it, ml.
    mae_so_far_ml: f64,
}

/// The weighed pours among the episodes that were read, in the order in which they were poured: those that are trained on and came to their goal, each
/// once. One that ended early tells nothing of how well a goal is met, and is named.
fn weighed_pours(read: &[Episode], trained_on: &[TrainingEpisode]) -> Vec<WeighedPour> {
    let counts = |e: &&Episode| trained_on.iter().any(|own| own.name == e.name);
    let weighed = read.iter().filter(counts).filter_map(|e| match (e.kind, e.weight_g) {
        (EpisodeKind::Pour { goal_ml }, Some(weight_g)) if e.error_ml().is_some() => Some((f64::from(goal_ml), weight_g)),
        (EpisodeKind::Pour { goal_ml }, Some(_)) => {
            let (name, poured_ml) = (&e.name, e.ended_early_ml().unwrap_or_default());
            eprintln!("{}", plain(&format!("{name}: ended early, at {poured_ml:.0} of {goal_ml:.0} ml, so its error does not count")));
            None
        }
        _ => None,
    });
    let mut sum_ml = 0.0;
    weighed
        .zip(1..)
        .map(|((goal_ml, weight_g), number)| {
            sum_ml += (weight_g - goal_ml).abs();
            WeighedPour { number, goal_ml, weight_g, mae_so_far_ml: sum_ml / number as f64 }
        })
        .collect()
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    args.weight_file.check()?;
    let mut read = args.source.read().or_exit(exit::BAD_INPUT)?;
    let of_episodes = args.accept.iter().filter(|name| *name != consistency::DATA_SET);
    if let Some(name) = args.leave_out.iter().chain(of_episodes).find(|name| !read.iter().any(|e| e.name == **name)) {
        let what = format!("no episode of these is called {name}: give the name that `trainer check` shows");
        return Err(failure(exit::BAD_INPUT, what));
    }
    let config = args.weight_file.config()?;
    // What is left out has no say in which frame rate or pictures the others must have.
    read.retain(|e| !args.leave_out.contains(&e.name));
    let mut usable = data::usable(&read);
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
    say_doubtful_recordings(&read, &usable);
    let history = weighed_pours(&read, &usable.episodes);
    let options = Options { seed: args.weight_file.seed, limits: config.limits, ..Options::default() };
    args.weight_file.train_and_write(&usable, &options, config.holds_ml, Some(&args.accept), serde_json::json!({ "pours": history }))?;
    if !args.weight_file.json && !history.is_empty() {
        println!("pour   goal ml  scale g  error ml  mean |error| so far");
        for WeighedPour { number, goal_ml, weight_g, mae_so_far_ml } in history {
            println!("{number:>4} {goal_ml:>9.1} {weight_g:>8.0} {:>9.1} {mae_so_far_ml:>10.2}", weight_g - goal_ml);
        }
    }
    Ok(())
}

/// Asks whether to use a doubtful weight; `None` if there is no terminal to ask at.
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
