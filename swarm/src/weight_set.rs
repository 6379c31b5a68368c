//! What a virtual cell learns from: its rows as episodes, and the weights that the real trainer makes of them.
//!
//! Plain data, shared by all threads, and pure functions; allocates; a training that fails gives no weights. A training takes seconds and
//! uses rayon: a thread that waits for it may meanwhile run another seed, which no lock here forbids.

use std::collections::BTreeMap;
use std::sync::Arc;

use shared::agent::Agent;
use shared::limits::Limits;
use shared::weights::Weights;
use simulator::ur::Series;
use trainer::data::TrainingEpisode;
use trainer::training::{Options, Silent};

use crate::camera::Depth;
use crate::records::Row;

/// Frames a second of the camera.
pub const RATE_HZ: f64 = 30.0;

/// What was learned for a robot and a vessel, and from what.
#[derive(Debug, Clone)]
pub struct Lesson {
    /// The weights.
    pub weights: Weights,
    /// An agent that follows them. Its tables take a while to make, so it is copied.
    pub agent: Agent,
    /// The episodes.
    pub episodes: Arc<Vec<TrainingEpisode>>,
}

impl Lesson {
    /// Learns from `episodes`; `None` if that fails.
    pub fn learn(episodes: Vec<TrainingEpisode>, limits: &Limits) -> Option<Self> {
        let options = Options { limits: *limits, ..Options::default() };
        let trained = trainer::method::train(&episodes, &options, &Silent).ok()?;
        let agent = Agent::new(&trained.weights);
        Some(Self { weights: trained.weights, agent, episodes: Arc::new(episodes) })
    }
}

/// For what a lesson is: whether the robot is an e-Series, the vessel, and how deep the eye is.
pub type Key = (bool, usize, Depth);

/// The lessons for each robot, vessel and eye.
#[derive(Debug, Clone, Default)]
pub struct TrainedSet(pub Arc<BTreeMap<Key, Lesson>>);

impl TrainedSet {
    /// What was learned for a robot, an eye and a vessel.
    pub fn get(&self, (series, depth): (Series, Depth), vessel: usize) -> Option<&Lesson> {
        self.0.get(&(series == Series::ESeries, vessel, depth))
    }
}

/// The rows between two times, s, as an episode: one line for each picture, with the command and the measured tilt at its time. Its weight is
/// `weight_g`. The clock of the pictures began `start_s` before that of the rows.
pub fn episode(name: &str, rows: &[Row], (from_s, to_s): (f64, f64), start_s: f64, weight_g: f64) -> TrainingEpisode {
    let mut episode = TrainingEpisode::empty(name, RATE_HZ);
    let at = |captured_s: f64| rows.iter().rev().find(|row| row.at_s + start_s <= captured_s);
    let mut last_s = f64::NAN;
    for row in rows.iter().filter(|row| row.at_s > from_s && row.at_s <= to_s && row.captured_s.is_finite()) {
        if row.captured_s <= last_s {
            continue;
        }
        last_s = row.captured_s;
        if let Some(then) = at(row.captured_s).filter(|then| then.alpha_deg.is_finite()) {
            // Outside of recordings the telemetry has no area; nothing flows then.
            let area_px2 = if row.area_px2.is_finite() { row.area_px2 } else { f64::NAN };
            episode.push(row.captured_s - start_s, then.alpha_deg, then.measured_deg, area_px2);
        }
    }
    episode.weight_g = weight_g;
    episode
}
