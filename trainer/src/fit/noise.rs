//! How sure the fit is: the noise of frames and of pours, what has changed between pours, and the doubt about the vessel.
//!
//! Pure functions of the offline trainer, for any thread. They allocate and do not fail.

use nalgebra::DMatrix;
use shared::estimator::flow::FlowTables;

use super::prepared::PreparedEpisode;
use super::unknowns::{ONSET, Unknowns, VESSEL, model_of};

/// Episodes before and after a change of gain or delay, for it to be noticed. Chosen by hand; see docs/LEARNING.md.
pub const CHANGE_NEEDS: usize = 3;
/// Standard errors beyond which the newest episodes' values count as changed. Chosen by hand; see docs/LEARNING.md.
const CHANGE_ERRORS: f64 = 3.5;
/// How much a camera's gain changes from pour to pour at least (log). Tuned on rigs 100 to 123, see docs/LEARNING.md.
const CAMERA_GAIN_SD_MIN: f64 = 0.012;
/// How much an episode's delay scatters at least when it is looked for, frames. Tuned on rigs 100 to 123, see docs/LEARNING.md.
const EXTRA_DELAY_SD_MIN_FRAMES: f64 = 0.2;
/// Number of episodes for which the expected change of the camera's gain counts, beside those that were fitted. Chosen by hand; no
/// measurement is recorded.
const EXPECTED_GAIN_EPISODES: f64 = 3.0;
/// Share of the posterior's standard deviation that the filter gets for the vessel's scale. Tuned on rigs 100 to 123, see
/// docs/LEARNING.md.
const VESSEL_SD_SHARE: f64 = 0.34;
/// Above this standard deviation the priors decide on the vessel (log), and nothing is taken off. Tuned on rigs 100 to 123, see
/// docs/LEARNING.md.
const VESSEL_SD_OF_PRIORS: f64 = 0.05;
/// Windows of tilt over which the doubt about the vessel is averaged. From the prototype; no other measurement is recorded.
const WINDOWS: usize = 5;
/// How far beyond the highest onset these windows reach, degrees. From the prototype; no other measurement is recorded.
const BEYOND_ONSET_DEG: f64 = 12.0;
/// Step of the difference quotients.
const NUDGE: f64 = 1e-4;
/// The median of the square of a normal variable over its variance.
const MEDIAN_OF_SQUARE: f64 = 0.455;

/// The noise of single frames.
#[derive(Debug, Clone, Copy)]
pub struct FrameNoise {
    /// Relative noise of a frame's area.
    pub area_sd: f64,
    /// Share of zeros within the flow.
    pub dropouts: f64,
}

impl FrameNoise {
    /// From second differences of the areas' logarithms.
    pub fn of(episodes: &[PreparedEpisode]) -> Self {
        let mut squares = Vec::new();
        let (mut zeros, mut within) = (0.0, 0.0);
        for e in episodes {
            for three in e.area_px2.windows(3) {
                if three[0] > 0.0 && three[2] > 0.0 {
                    within += 1.0;
                    zeros += f64::from(three[1] == 0.0);
                }
                if three.iter().all(|a| *a > 0.2 * e.smooth_max_px2) {
                    squares.push((three[0].ln() - 2.0 * three[1].ln() + three[2].ln()).powi(2) / 6.0);
                }
            }
        }
        // The median is robust against what is not noise.
        squares.sort_by(f64::total_cmp);
        let variance = squares.get(squares.len() / 2).copied().unwrap_or(0.01) / MEDIAN_OF_SQUARE;
        Self { area_sd: variance.sqrt(), dropouts: if within > 0.0 { zeros / within } else { 0.0 } }
    }
}

/// The camera's gain in the newest episodes (log), if it has changed since the ones before, else 0.
pub fn newest_gain(log_camera_gains: &[f64]) -> f64 {
    newest(log_camera_gains, CAMERA_GAIN_SD_MIN)
}

/// The delay in the newest episodes above the model's, if it has changed since the ones before, else 0, frames.
pub fn newest_delay_frames(extra_delays: &[f64]) -> f64 {
    newest(extra_delays, EXTRA_DELAY_SD_MIN_FRAMES)
}

/// Mean of the newest episodes' values if they have changed since the ones before, else 0. The episodes are in the order in which
/// they were poured; [`CHANGE_NEEDS`] of them at least are on either side of a change, and they scatter by `sd_min` at least.
fn newest(values: &[f64], sd_min: f64) -> f64 {
    let n = values.len();
    let mut found = (CHANGE_ERRORS, 0.0);
    for k in CHANGE_NEEDS..(n + 1).saturating_sub(CHANGE_NEEDS) {
        let (before, after) = values.split_at(k);
        let mean = |g: &[f64]| g.iter().sum::<f64>() / g.len() as f64;
        let spread = |g: &[f64]| g.iter().map(|x| (x - mean(g)).powi(2)).sum::<f64>();
        let sd = ((spread(before) + spread(after)) / (n - 2) as f64).sqrt().max(sd_min);
        let errors = (mean(after) - mean(before)).abs() / (sd * (1.0 / before.len() as f64 + 1.0 / after.len() as f64).sqrt());
        if errors > found.0 {
            found = (errors, mean(after));
        }
    }
    found.1
}

/// How much the camera's gain changes from pour to pour (log): a mean of what is expected and of what was fitted.
pub fn camera_gain_sd(log_camera_gains: &[f64], expected: f64) -> f64 {
    let sum: f64 = log_camera_gains.iter().map(|g| g * g).sum();
    ((EXPECTED_GAIN_EPISODES * expected * expected + sum) / (EXPECTED_GAIN_EPISODES + log_camera_gains.len() as f64)).sqrt()
}

/// The standard deviation of the vessel's scale that the filter gets, from the posterior's.
///
/// The narrow stage tempers the frames' residuals, so its covariance is too wide where the frames decide, and a share of it pours
/// best on other rigs. Where little was poured the priors decide, and nothing may be taken off.
pub fn trusted_vessel_sd(posterior_sd: f64) -> f64 {
    (VESSEL_SD_SHARE * posterior_sd * (posterior_sd / VESSEL_SD_OF_PRIORS).max(1.0)).min(0.5)
}

/// Posterior variance of the logarithm of the capacity lost in a window of tilt, averaged over windows from the lowest onset to a
/// little beyond the highest.
pub fn vessel_variance(at: &Unknowns, covariance: &DMatrix<f64>) -> f64 {
    let onsets = at.of_episodes(ONSET);
    let low = onsets.iter().copied().fold(f64::INFINITY, f64::min).clamp(0.0, 110.0);
    let high = onsets.iter().copied().fold(f64::NEG_INFINITY, f64::max).clamp(0.0, 110.0) + BEYOND_ONSET_DEG;
    let edges: Vec<f64> = (0..=WINDOWS).map(|k| low + (high - low) * k as f64 / WINDOWS as f64).collect();
    let log_windows = |shared: &[f64]| -> Vec<f64> {
        let capacity = FlowTables::new(&model_of(shared)).capacity;
        edges.windows(2).map(|e| (capacity.lost_ml(e[1]) - capacity.lost_ml(e[0])).max(1e-6).ln()).collect()
    };
    let base = log_windows(&at.shared);
    let slopes: Vec<Vec<f64>> = (0..VESSEL)
        .map(|k| {
            let mut shared = at.shared;
            shared[k] += NUDGE;
            log_windows(&shared).iter().zip(&base).map(|(a, b)| (a - b) / NUDGE).collect()
        })
        .collect();
    let variance =
        |w: usize| -> f64 { (0..VESSEL).map(|i| (0..VESSEL).map(|j| slopes[i][w] * covariance[(i, j)] * slopes[j][w]).sum::<f64>()).sum() };
    (0..WINDOWS).map(variance).sum::<f64>() / WINDOWS as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects learning after somebody touched the camera: a changed gain is noticed, scatter and too few episodes are not.
    #[test]
    fn a_changed_gain_is_noticed() {
        let scatter = [0.01, -0.012, 0.004, -0.008, 0.011, -0.003, 0.006];
        let changed =
            |from: usize, by: f64| -> Vec<f64> { scatter.iter().enumerate().map(|(k, g)| g + if k >= from { by } else { 0.0 }).collect() };
        assert_eq!(newest(&scatter, CAMERA_GAIN_SD_MIN), 0.0);
        assert!((newest(&changed(4, 0.06), CAMERA_GAIN_SD_MIN) - 0.06).abs() < 0.01);
        assert!((newest(&changed(3, -0.06), CAMERA_GAIN_SD_MIN) + 0.06).abs() < 0.01);
        assert_eq!(newest(&changed(5, 0.06), CAMERA_GAIN_SD_MIN), 0.0, "two episodes say nothing");
        assert_eq!(newest(&changed(4, 0.02), CAMERA_GAIN_SD_MIN), 0.0, "within the scatter");
    }
}
