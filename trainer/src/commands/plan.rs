//! `trainer plan`: says which curve or pour to weigh next, because it teaches most.
//!
//! An offline command on an ordinary thread; it allocates. It changes nothing. Without any weighed episode it needs to know what the vessel
//! holds. Episodes that cannot be used are named, and left out.

use std::path::PathBuf;

use shared::exit::{self, Failure, OrExit as _, failure};
use shared::level::plain;
use shared::limits::Limits;

use crate::consistency;
use crate::data::{self, DataError, EpisodeSource, UsableEpisodes};
use crate::fit;
use crate::teaching::foresight::Foresight;
use crate::teaching::plan::{Candidate, Plan, Proposal, Wish, least_goal_max_ml, least_holds_ml, plan};
use crate::teaching::span::Span;

/// Curves stay this far below the largest tilt that may be commanded, degrees: the limiter must not cut them off.
const BELOW_LIMIT_DEG: f64 = 5.0;
/// Range of what a vessel may hold, ml. Chosen by hand: a robot that pours holds no less and carries no more.
const HOLDS_ML: (f64, f64) = (50.0, 10_000.0);
/// Largest goal of the pours that are proposed for, where nobody names one, ml. Chosen by hand: a large cup.
const GOAL_ML: f64 = 250.0;
/// Largest goal that a plan may have, ml: as controller.goal_max_ml.
const GOAL_MAX_ML: f64 = 5000.0;

/// Period of the loop where no configuration is named, ns: 30 Hz.
pub const PERIOD_NS: u64 = 33_333_333;

/// Command-line arguments of `trainer plan`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  trainer plan out/episodes --holds 500
  trainer plan out/episodes --holds 500 --goal-max 120 --json
  trainer plan features.csv --scale scale.csv --holds 500

Says what to record next: two curves first, then what takes most of the doubt about the pours to come, which are small and large goals up to
--goal-max from every fill. Fill, record or pour, weigh, train, and ask again.
Exit codes: 0 proposed, 1 nothing can be proposed, 2 the data cannot be read.")]
pub struct Args {
    #[command(flatten)]
    source: EpisodeSource,
    /// What the vessel holds up to its lip, ml. It is needed before the first weighed episode. Later, fills are reckoned from it.
    #[arg(long)]
    holds: Option<f64>,
    /// Largest goal of the pours to come, ml; without it, 250 ml, and no more than the configuration allows. Below 25 ml only curves are proposed,
    /// because a scale rounds what a smaller pour would teach.
    #[arg(long)]
    goal_max: Option<f64>,
    /// Configuration of the cell, from which the limits, [container] holds_ml and the largest goal are taken; without it, the limits are the default
    /// ones.
    #[arg(long, env = shared::config::VARIABLE)]
    config: Option<PathBuf>,
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = args.config.as_deref().map(shared::config::Config::read).transpose().or_exit(exit::BAD_INPUT)?;
    let limits = config.as_ref().map_or_else(Limits::default, |c| c.limits);
    let goal_max_ml =
        args.goal_max.unwrap_or_else(|| config.as_ref().map_or(GOAL_ML, |c| f64::from(c.controller.goal_max_ml).min(GOAL_ML)));
    if let (Some(goal_ml), Some(most_ml)) = (args.goal_max, config.as_ref().map(|c| f64::from(c.controller.goal_max_ml)))
        && goal_ml > most_ml
    {
        let what = format!("--goal-max {goal_ml} is above controller.goal_max_ml, {most_ml}: no such pour would be taken");
        return Err(failure(exit::BAD_INPUT, what));
    }
    let period_ns = config.as_ref().map_or(PERIOD_NS, |c| (1e9 / c.controller.rate_hz) as u64);
    let holds_ml = args.holds.or(config.and_then(|c| c.container.holds_ml));
    if args.holds.is_some_and(|ml| !(HOLDS_ML.0..=HOLDS_ML.1).contains(&ml)) || !(1.0..=GOAL_MAX_ML).contains(&goal_max_ml) {
        let what = format!("--holds is {} to {} ml, and --goal-max 1 to {GOAL_MAX_ML} ml", HOLDS_ML.0, HOLDS_ML.1);
        return Err(failure(exit::BAD_INPUT, what));
    }
    let usable = match args.source.read() {
        Ok(episodes) => data::usable(&episodes),
        // There is nothing yet: that is where a plan begins.
        Err(DataError::None { .. }) => UsableEpisodes::default(),
        Err(e) => return Err(failure(exit::BAD_INPUT, e)),
    };
    let doubts = doubts(&usable, holds_ml)?;
    if !args.json {
        usable.left_out.iter().for_each(|(name, what)| println!("left out: {}", plain(&format!("{name}: {what}"))));
        doubts.iter().for_each(|what| println!("doubtful: {}", plain(what)));
    }
    let wish = wish(&limits, period_ns, goal_max_ml);
    let found = propose(&usable, holds_ml, &wish)?;
    // There is at least one, or `propose` would have said why not.
    let [first, others @ ..] = &found.candidates[..] else { return Ok(()) };
    if args.json {
        let all = serde_json::json!({ "episodes": usable.episodes.len(), "left_out": usable.left_out, "doubts": doubts, "plan": found });
        println!("{}", serde_json::to_string_pretty(&all).unwrap_or_default());
        return Ok(());
    }
    println!("{}", words(first));
    if usable.episodes.is_empty() {
        println!("nothing has been weighed yet; the height is that of a beaker: if nothing flows, take 10 degrees more");
    } else {
        println!(
            "the camera's volume of the pours to come is off by {:.1} ml (standard deviation) now, and by {:.1} ml after it",
            found.sd_now_ml, first.sd_after_ml
        );
    }
    for other in others {
        println!("or: {} ({:.1} ml after it)", words(other), other.sd_after_ml);
    }
    Ok(())
}

/// What is asked for by a cell with these limits and this period of its loop, whose largest goal is known, ml.
pub fn wish(limits: &Limits, period_ns: u64, goal_max_ml: f64) -> Wish {
    Wish { goal_max_ml, alpha_max_deg: f64::from(limits.alpha_max_deg) - BELOW_LIMIT_DEG, limits: *limits, period_ns }
}

/// Weights that do not fit each other, or not the vessel: what is proposed rests on them. A vessel that holds less than was weighed is refused.
fn doubts(usable: &UsableEpisodes, holds_ml: Option<f64>) -> Result<Vec<String>, Failure> {
    if usable.episodes.is_empty() {
        return Ok(Vec::new());
    }
    let of_weights = consistency::doubtful(&usable.episodes).into_iter().map(|d| (d.name.clone(), d.to_string()));
    let of_set = consistency::doubts_of_set(&usable.episodes, &fit::fit(&usable.episodes), holds_ml);
    if let Some((name, what)) = of_set.iter().find(|(name, _)| name != consistency::DATA_SET) {
        return Err(failure(exit::BAD_INPUT, format!("{name}: {what} Correct the weight, or what the vessel holds")));
    }
    let words = |(name, what): (String, String)| if what.starts_with(&name) { what } else { format!("{name}: {what}") };
    let unheld = holds_ml.is_none().then(|| {
        let what = "nobody says what the vessel holds, and what the episodes tell of it may be wrong several times over: fill in no more than goes in, and \
                    give --holds or [container] holds_ml";
        (consistency::DATA_SET.to_owned(), what.to_owned())
    });
    Ok(of_weights.chain(of_set).chain(unheld).map(words).collect())
}

/// What to weigh next after the usable episodes.
///
/// # Errors
/// One line, where nothing was weighed yet and nobody says what the vessel holds, or where nothing can be proposed.
pub fn propose(usable: &UsableEpisodes, holds_ml: Option<f64>, wish: &Wish) -> Result<Plan, Failure> {
    let (vessel, weighed, weights_g) = if usable.episodes.is_empty() {
        let what = "no episode was weighed yet: say what the vessel holds with --holds ML or [container] holds_ml";
        let holds_ml = holds_ml.ok_or_else(|| failure(exit::BAD_INPUT, what))?;
        (Foresight::unknown(holds_ml, wish.alpha_max_deg), Vec::new(), Vec::new())
    } else {
        let fit = fit::fit(&usable.episodes);
        let spans = usable.episodes.iter().map(|e| Span::of_episode(e, &fit.calibration)).collect();
        // A gain that has changed is known, and no scatter: the spans are in the newest one's ml.
        let gained = |k: usize| fit.changed_gain.map_or(0.0, |changed| changed.at(k) - changed.after).exp();
        let weights_g = usable.episodes.iter().enumerate().map(|(k, e)| e.weight_g * gained(k)).collect();
        let vessel = Foresight::new(&fit.model, fit.calibration, holds_ml, wish.alpha_max_deg, data::rate_hz(&usable.episodes));
        (vessel, spans, weights_g)
    };
    let found = plan(&vessel, &weighed, &weights_g, wish);
    if !found.candidates.is_empty() {
        return Ok(found);
    }
    let least_goal_ml = least_goal_max_ml(&vessel, wish).filter(|least_ml| wish.goal_max_ml < *least_ml);
    let least_vessel_ml = least_holds_ml(wish).filter(|least_ml| usable.episodes.is_empty() && vessel.holds_ml() < *least_ml);
    let what = match (least_goal_ml, least_vessel_ml) {
        (Some(least_ml), _) => {
            format!("no stream is foreseen of pours of up to {} ml: give --goal-max {least_ml} or more", wish.goal_max_ml)
        }
        (None, Some(least_ml)) => format!(
            "nothing can be proposed for a vessel of {} ml, because a scale rounds what its curves would teach: take one that holds {least_ml} ml or \
             more",
            vessel.holds_ml()
        ),
        (None, None) => "nothing can be proposed for this vessel: give what it really holds with --holds".into(),
    };
    Err(failure(exit::FAILED, what))
}

/// A candidate as a person does it.
fn words(candidate: &Candidate) -> String {
    match candidate.next {
        Proposal::Curve { fill_ml, lambda_deg, gamma_per_s2 } => format!(
            "fill in {fill_ml:.0} ml and record a curve: rt-controller record --lambda {lambda_deg:.0} --gamma {gamma_per_s2}; \
             some {:.0} g should be on the scale",
            candidate.weight_ml
        ),
        Proposal::Pour { fill_ml, goal_ml } => format!("fill in {fill_ml:.0} ml and pour: rt-controller pour {goal_ml:.0}; weigh it"),
    }
}
