//! Finds weights that do not fit the others: a typo, a cup that was not tared.
//!
//! Offline, pure, allocates. Each weight is compared with what the camera's areas say when calibrated on all other
//! episodes; the worst one is taken out, and the rest are compared again, so that one wrong weight does not accuse the others.

use serde::Serialize;

use crate::calibrate;
use crate::data::TrainingEpisode;

/// Fewer episodes than this cannot contradict each other.
pub const NEEDS: usize = 4;
/// Standard deviations at which a weight is doubted.
const LIMIT: f64 = 4.0;

/// A weight that does not fit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Doubtful {
    /// The episode.
    pub name: String,
    /// What was entered, g.
    pub weight_g: f64,
    /// What the other episodes say, g.
    pub expected_g: f64,
    /// Standard deviation of that, g.
    pub sd_g: f64,
}

impl std::fmt::Display for Doubtful {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { name, weight_g, expected_g, sd_g } = self;
        write!(
            f,
            "{name}: weight {weight_g:.0} g, but the other episodes say {expected_g:.0} +- {sd_g:.0} g: a typo, or a cup that was not tared?"
        )
    }
}

/// Weights that do not fit the others, worst first.
pub fn doubtful(episodes: &[TrainingEpisode]) -> Vec<Doubtful> {
    let mut left: Vec<TrainingEpisode> = episodes.to_vec();
    let mut found = Vec::new();
    while left.len() >= NEEDS {
        let expected: Vec<f64> = (0..left.len())
            .map(|k| {
                let others: Vec<TrainingEpisode> = left.iter().enumerate().filter(|(j, _)| *j != k).map(|(_, e)| e.clone()).collect();
                let cal = calibrate::fit(&others, None);
                f64::from(cal.c) * calibrate::area_sum(&left[k], f64::from(cal.q))
            })
            .collect();
        let logs: Vec<f64> = left.iter().zip(&expected).map(|(e, x)| (e.weight_g / x.max(1e-3)).ln()).collect();
        let mut sizes: Vec<f64> = logs.iter().map(|l| l.abs()).collect();
        sizes.sort_by(f64::total_cmp);
        let spread = (1.4826 * sizes[sizes.len() / 2]).clamp(0.03 + 0.1 / left.len() as f64, 0.15);
        let sd = |k: usize| 0.7f64.hypot(spread * expected[k]);
        let z = |k: usize| (left[k].weight_g - expected[k]).abs() / sd(k);
        let Some(worst) = (0..left.len()).max_by(|a, b| z(*a).total_cmp(&z(*b))) else { break };
        if z(worst) < LIMIT {
            break;
        }
        let e = &left[worst];
        found.push(Doubtful { name: e.name.clone(), weight_g: e.weight_g, expected_g: expected[worst], sd_g: sd(worst) });
        left.remove(worst);
    }
    found
}
