//! The weights that the virtual cell pours with: trained by the real trainer on curves that were recorded in the virtual cell itself.
//!
//! Made once in a process, one after the other; a pair of robot and vessel takes some seconds of one core. Allocates. A training that
//! fails leaves that pair without weights.

use std::collections::BTreeMap;
use std::sync::{Arc, Mutex, PoisonError};

use shared::config::Config;
use shared::limits::Limits;
use shared::weights::Weights;
use simulator::ur::Series;
use trainer::data::TrainingEpisode;
use trainer::training::{Options, Silent};

use crate::plan::{Plan, VESSELS};
use crate::records::Row;
use crate::run;
use crate::site::{START_NS, spill_angle_deg};
use crate::weight_set::TrainedSet;

/// What each of the five recordings is filled with, ml; how far beyond the spill angle it tilts, degrees; and its width, s. They span what
/// the reference protocol draws (140 to 460 ml, 6 to 30 degrees, 0.7 to 2.2 s).
const RECORDINGS: [(f64, f64, f32); 5] =
    [(170.0, 12.0, 1.0), (240.0, 22.0, 1.9), (300.0, 9.0, 1.3), (370.0, 27.0, 0.9), (430.0, 16.0, 1.6)];
/// Frames a second of the camera.
const RATE_HZ: f64 = 30.0;

/// What was trained in this process.
static MADE: Mutex<BTreeMap<(bool, usize), Option<Weights>>> = Mutex::new(BTreeMap::new());

/// Trains what the plans need and was not trained yet. Must not be called from a rayon task that others wait for, because the training uses
/// them.
pub fn train_for<'a>(plans: impl IntoIterator<Item = &'a Plan>, config: &Config, say: &dyn Fn(&str)) -> TrainedSet {
    let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
    for plan in plans {
        for vessel in plan.vessels() {
            made.entry((plan.series == Series::ESeries, vessel)).or_insert_with(|| {
                say(&format!("training for a {} on a {:?}", VESSELS[vessel], plan.series));
                train(plan.series, vessel, config)
            });
        }
    }
    TrainedSet(Arc::new(made.iter().filter_map(|(key, weights)| Some((*key, weights.clone()?))).collect()))
}

/// Records five curves in the virtual cell and trains on them.
fn train(series: Series, vessel: usize, config: &Config) -> Option<Weights> {
    let episodes: Vec<TrainingEpisode> = RECORDINGS
        .iter()
        .filter_map(|&(fill_ml, over_deg, width_s)| {
            let lambda_deg = (spill_angle_deg(series, vessel, fill_ml) + over_deg).min(105.0) as f32;
            let shown = run::run(&Plan::recording(series, vessel, fill_ml, lambda_deg, width_s), &TrainedSet::default(), config, true);
            let poured = shown.poured.first()?;
            let end_s = poured.at_s;
            Some(episode(&format!("{fill_ml}"), &shown.rows, end_s)).filter(|e| e.fault().is_none())
        })
        .collect();
    let options = Options { limits: Limits { ..config.limits }, ..Options::default() };
    trainer::method::train(&episodes, &options, &Silent).ok().map(|trained| trained.weights)
}

/// The rows as an episode: one line for each picture, with the command and the measured tilt at its time.
fn episode(name: &str, rows: &[Row], end_s: f64) -> TrainingEpisode {
    let mut episode = TrainingEpisode::empty(name, RATE_HZ);
    let start_s = START_NS as f64 / 1e9;
    let at = |captured_s: f64| rows.iter().rev().find(|row| row.at_s + start_s <= captured_s);
    let (mut poured_ml, mut last_s) = (0.0, f64::NAN);
    for row in rows.iter().filter(|row| row.at_s > 2.9 && row.at_s <= end_s && row.captured_s.is_finite()) {
        if row.captured_s <= last_s {
            continue;
        }
        last_s = row.captured_s;
        if let Some(then) = at(row.captured_s).filter(|then| then.alpha_deg.is_finite()) {
            // Outside of recordings the telemetry has no area; nothing flows then.
            let area_px2 = if row.area_px2.is_finite() { row.area_px2 } else { f64::NAN };
            episode.push(row.captured_s - start_s, then.alpha_deg, then.measured_deg, area_px2);
            poured_ml = row.poured_ml;
        }
    }
    episode.weight_g = poured_ml.round();
    episode
}
