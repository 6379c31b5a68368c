//! The weights that the virtual cell pours with: trained by the real trainer on curves that were recorded in the virtual cell itself.
//!
//! Made once in a process; a pair of robot and vessel takes some seconds of one core. Allocates. A recording that is lost, or a training that
//! fails, is an error: weights of fewer recordings would show something else.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use shared::config::Config;
use shared::control::EndReason;
use simulator::ur::Series;
use trainer::data::TrainingEpisode;

use crate::plan::Plan;
use crate::run;
use crate::site::START_NS;
use crate::vessels::{VESSELS, spill_angle_deg};
use crate::weight_set::{Key, Lesson, TrainedSet, episode};

/// What each of the five recordings is filled with, ml; how far beyond the spill angle it tilts, degrees; and its width, s. They span what
/// the reference protocol draws (140 to 460 ml, 6 to 30 degrees, 0.7 to 2.2 s).
const RECORDINGS: [(f64, f64, f32); 5] =
    [(170.0, 12.0, 1.0), (240.0, 22.0, 1.9), (300.0, 9.0, 1.3), (370.0, 27.0, 0.9), (430.0, 16.0, 1.6)];
/// When a recording's rows begin, s: just before its curve.
const FROM_S: f64 = 2.9;

/// What was trained in this process.
static MADE: Mutex<BTreeMap<Key, Lesson>> = Mutex::new(BTreeMap::new());

/// Trains what the plans need and was not trained yet. Must not be called from a rayon task, because it uses them under a lock.
///
/// # Errors
/// One line that names the vessel, and the recording that was lost or what the trainer said.
pub fn train_for<'a>(plans: impl IntoIterator<Item = &'a Plan>, config: &Config, say: &dyn Fn(&str)) -> Result<TrainedSet, String> {
    let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
    let needed: BTreeSet<_> = plans
        .into_iter()
        .flat_map(|plan| plan.vessels().into_iter().map(|vessel| (plan.series == Series::ESeries, vessel, plan.depth)))
        .collect();
    let missing: Vec<_> = needed.into_iter().filter(|key| !made.contains_key(key)).collect();
    if !missing.is_empty() {
        say(&format!("training for {} pairs of robot and vessel", missing.len()));
    }
    let trained: Result<Vec<_>, String> = missing.into_par_iter().map(|key| Ok((key, train(key, config)?))).collect();
    made.extend(trained?);
    Ok(TrainedSet(Arc::new(made.clone())))
}

/// Records five curves in the virtual cell and trains on them.
fn train((is_e_series, vessel, depth): Key, config: &Config) -> Result<Lesson, String> {
    let series = if is_e_series { Series::ESeries } else { Series::Cb3 };
    let named = VESSELS[vessel].name;
    let episodes: Result<Vec<TrainingEpisode>, String> = RECORDINGS
        .iter()
        .map(|&(fill_ml, over_deg, width_s)| {
            let lambda_deg = (spill_angle_deg(vessel, fill_ml) + over_deg).min(105.0) as f32;
            let plan = Plan::recording((series, depth), vessel, fill_ml, lambda_deg, width_s);
            let shown = run::run(&plan, &TrainedSet::default(), config, true);
            let name = format!("{fill_ml} ml in a {named}");
            let poured = shown.poured.first().filter(|poured| poured.reason == EndReason::Done);
            let poured = poured.ok_or_else(|| format!("the recording of {name} did not end as done"))?;
            let made = episode(&name, &shown.rows, (FROM_S, poured.at_s), START_NS as f64 / 1e9, poured.true_ml.round());
            made.fault().map_or(Ok(made), |fault| Err(format!("the recording of {name}: {fault}")))
        })
        .collect();
    Lesson::learn(episodes?, &config.limits).ok_or_else(|| format!("no weights come of the recordings in a {named}"))
}
