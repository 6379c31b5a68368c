//! How sure the fit is: the noise of frames and of pours, and what has changed between pours.
//!
//! Pure functions of the offline trainer, for any thread. They allocate and do not fail.

use super::prepared::PreparedEpisode;

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

/// What has changed between the episodes, in the order in which they were poured.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Changed {
    /// Number of episodes before the change.
    pub episodes_before: usize,
    /// Mean of their values.
    pub before: f64,
    /// Mean of the values of those after it.
    pub after: f64,
    /// Standard error of the difference.
    pub error: f64,
}

impl Changed {
    /// The mean value of the episodes on this episode's side of the change.
    pub fn at(&self, episode: usize) -> f64 {
        if episode < self.episodes_before { self.before } else { self.after }
    }
}

/// How the camera's gain (log) has changed between the episodes, if it has.
pub fn changed_gain(log_camera_gains: &[f64]) -> Option<Changed> {
    changed(log_camera_gains, CAMERA_GAIN_SD_MIN)
}

/// The camera's gain in the newest episodes (log), if it has changed since the ones before, else 0.
pub fn newest_gain(log_camera_gains: &[f64]) -> f64 {
    changed_gain(log_camera_gains).map_or(0.0, |c| c.after)
}

/// The delay in the newest episodes above the model's, if it has changed since the ones before, else 0, frames.
pub fn newest_delay_frames(extra_delays: &[f64]) -> f64 {
    changed(extra_delays, EXTRA_DELAY_SD_MIN_FRAMES).map_or(0.0, |c| c.after)
}

/// The change between the episodes, if there is one. [`CHANGE_NEEDS`] of them at least are on either side of it, and their values scatter by
/// `sd_min` at least.
fn changed(values: &[f64], sd_min: f64) -> Option<Changed> {
    let n = values.len();
    let (mut most_errors, mut found) = (CHANGE_ERRORS, None);
    for k in CHANGE_NEEDS..(n + 1).saturating_sub(CHANGE_NEEDS) {
        let (before, after) = values.split_at(k);
        let mean = |g: &[f64]| g.iter().sum::<f64>() / g.len() as f64;
        let spread = |g: &[f64]| g.iter().map(|x| (x - mean(g)).powi(2)).sum::<f64>();
        let sd = ((spread(before) + spread(after)) / (n - 2) as f64).sqrt().max(sd_min);
        let error = sd * (1.0 / before.len() as f64 + 1.0 / after.len() as f64).sqrt();
        let errors = (mean(after) - mean(before)).abs() / error;
        if errors > most_errors {
            (most_errors, found) = (errors, Some(Changed { episodes_before: k, before: mean(before), after: mean(after), error }));
        }
    }
    found
}

/// How much the camera's gain changes from pour to pour (log): a mean of what is expected and of what was fitted.
pub fn camera_gain_sd(log_camera_gains: &[f64], expected: f64) -> f64 {
    let sum: f64 = log_camera_gains.iter().map(|g| g * g).sum();
    ((EXPECTED_GAIN_EPISODES * expected * expected + sum) / (EXPECTED_GAIN_EPISODES + log_camera_gains.len() as f64)).sqrt()
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
        assert_eq!(newest_gain(&scatter), 0.0);
        assert!((newest_gain(&changed(4, 0.06)) - 0.06).abs() < 0.01);
        assert!((newest_gain(&changed(3, -0.06)) + 0.06).abs() < 0.01);
        assert_eq!(newest_gain(&changed(5, 0.06)), 0.0, "two episodes say nothing");
        assert_eq!(newest_gain(&changed(4, 0.02)), 0.0, "within the scatter");
    }
}
