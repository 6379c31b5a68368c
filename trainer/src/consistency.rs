//! Finds weights that do not fit the others: a typo, or a cup that was not tared.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail. Each weight is compared with what the camera's
//! areas say when they are calibrated on all other episodes. The worst one is taken out, and the rest are compared again, so that one wrong
//! weight does not accuse the others.

use serde::Serialize;

use crate::calibration;
use crate::data::TrainingEpisode;

/// Fewer episodes than this cannot contradict each other. Chosen by hand; no measurement is recorded.
const NEEDS: usize = 4;
/// Standard deviations at which a weight is doubted. Chosen by hand; no measurement is recorded.
const DOUBTED_SDS: f64 = 4.0;
/// Standard deviation of reading the scale, g. Chosen by hand; no measurement is recorded.
const READING_SD_G: f64 = 0.7;
/// Standard deviation of a normal distribution over the median of its absolute values.
const SD_PER_MEDIAN: f64 = 1.4826;

/// A weight that does not fit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DoubtfulWeight {
    /// The episode.
    pub name: String,
    /// What was entered, g.
    pub weight_g: f64,
    /// What the other episodes say, g.
    pub expected_g: f64,
    /// Standard deviation of that, g.
    pub sd_g: f64,
}

impl std::fmt::Display for DoubtfulWeight {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { name, weight_g, expected_g, sd_g } = self;
        write!(
            f,
            "{name}: weight {weight_g:.0} g, but the other episodes say {expected_g:.0} +- {sd_g:.0} g: a typo, or a cup that was not tared?"
        )
    }
}

/// Weights that do not fit the others, worst first.
pub fn doubtful(episodes: &[TrainingEpisode]) -> Vec<DoubtfulWeight> {
    let mut left: Vec<TrainingEpisode> = episodes.to_vec();
    let mut found = Vec::new();
    while left.len() >= NEEDS {
        let expected_g: Vec<f64> = (0..left.len())
            .map(|k| {
                let others: Vec<TrainingEpisode> = left.iter().enumerate().filter(|(j, _)| *j != k).map(|(_, e)| e.clone()).collect();
                let calibration = calibration::calibrate(&others, None);
                f64::from(calibration.volume_at_1_px2_ml) * calibration::area_sum(&left[k], f64::from(calibration.area_exponent))
            })
            .collect();
        let logs: Vec<f64> = left.iter().zip(&expected_g).map(|(e, x)| (e.weight_g / x.max(1e-3)).ln()).collect();
        let mut sizes: Vec<f64> = logs.iter().map(|l| l.abs()).collect();
        sizes.sort_by(f64::total_cmp);
        // The usual deviation is robust against the wrong ones; few episodes tell it badly, so it has bounds.
        let spread = (SD_PER_MEDIAN * sizes[sizes.len() / 2]).clamp(0.03 + 0.1 / left.len() as f64, 0.15);
        let sd_g = |k: usize| READING_SD_G.hypot(spread * expected_g[k]);
        let sds = |k: usize| (left[k].weight_g - expected_g[k]).abs() / sd_g(k);
        let Some(worst) = (0..left.len()).max_by(|a, b| sds(*a).total_cmp(&sds(*b))) else { break };
        if sds(worst) < DOUBTED_SDS {
            break;
        }
        let e = &left[worst];
        found.push(DoubtfulWeight { name: e.name.clone(), weight_g: e.weight_g, expected_g: expected_g[worst], sd_g: sd_g(worst) });
        left.remove(worst);
    }
    found
}
