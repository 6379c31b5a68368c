//! The weights that the virtual cell pours with: trained by the real trainer on curves that were recorded in the virtual cell itself.
//!
//! Made once in a process; a pair of robot and vessel takes some seconds of one core. Allocates. A training that fails leaves that pair
//! without weights.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use shared::config::Config;
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
static MADE: Mutex<BTreeMap<Key, Option<Lesson>>> = Mutex::new(BTreeMap::new());

/// Trains what the plans need and was not trained yet. Must not be called from a rayon task, because it uses them under a lock.
pub fn train_for<'a>(plans: impl IntoIterator<Item = &'a Plan>, config: &Config, say: &dyn Fn(&str)) -> TrainedSet {
    let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
    let needed: BTreeSet<_> = plans
        .into_iter()
        .flat_map(|plan| plan.vessels().into_iter().map(|vessel| (plan.series == Series::ESeries, vessel, plan.depth)))
        .collect();
    let missing: Vec<_> = needed.into_iter().filter(|key| !made.contains_key(key)).collect();
    if !missing.is_empty() {
        say(&format!("training for {} pairs of robot and vessel", missing.len()));
    }
    let trained: Vec<_> = missing.into_par_iter().map(|key| (key, train(key, config))).collect();
    made.extend(trained);
    TrainedSet(Arc::new(made.iter().filter_map(|(key, lesson)| Some((*key, lesson.clone()?))).collect()))
}

/// Records five curves in the virtual cell and trains on those that are over when their run ends: two of them (docs/SWARM.md).
fn train((is_e_series, vessel, depth): Key, config: &Config) -> Option<Lesson> {
    let series = if is_e_series { Series::ESeries } else { Series::Cb3 };
    let episodes: Vec<TrainingEpisode> = RECORDINGS
        .iter()
        .filter_map(|&(fill_ml, over_deg, width_s)| {
            let lambda_deg = (spill_angle_deg(vessel, fill_ml) + over_deg).min(105.0) as f32;
            let shown =
                run::run(&Plan::recording((series, depth), vessel, fill_ml, lambda_deg, width_s), &TrainedSet::default(), config, true);
            let poured = shown.poured.first()?;
            let name = format!("{fill_ml} ml in a {}", VESSELS[vessel].name);
            let made = episode(&name, &shown.rows, (FROM_S, poured.at_s), START_NS as f64 / 1e9, poured.true_ml.round());
            Some(made).filter(|e| e.fault().is_none())
        })
        .collect();
    Lesson::learn(episodes, &config.limits)
}
