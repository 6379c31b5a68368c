//! How sure the fit is: the noise of frames and of pours, and what has changed between pours.
//!
//! Pure functions of the offline trainer, for any thread. They allocate and do not fail.

use super::prepared::PreparedEpisode;

/// Episodes before and after a change of gain or delay, for it to be noticed. Chosen by hand; see docs/LEARNING.md.
pub const CHANGE_NEEDS: usize = 3;
/// Standard errors beyond which the newest episodes' values count as changed. Chosen by hand; see docs/LEARNING.md.
const CHANGE_ERRORS: f64 = 3.5;
/// Standard errors beyond which one or two newest episodes are suspected of another gain. Of 75 right sets of tuning rigs (4 to 10 episodes, all kinds of
/// vessels) the largest was 4.5.
const SUSPECT_ERRORS: f64 = 5.0;
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

/// A change of the camera's gain (log) with one of the newest episodes that has too few after it to count: so few may also be off by a weight or a light
/// of their own, and the gain of the older ones still counts.
pub fn suspected_gain(log_camera_gains: &[f64]) -> Option<Changed> {
    let n = log_camera_gains.len();
    largest(log_camera_gains, CAMERA_GAIN_SD_MIN, n.saturating_sub(CHANGE_NEEDS - 1).max(CHANGE_NEEDS)..n, SUSPECT_ERRORS)
}

/// The change between the episodes, if there is one. [`CHANGE_NEEDS`] of them at least are on either side of it, and their values scatter by
/// `sd_min` at least.
fn changed(values: &[f64], sd_min: f64) -> Option<Changed> {
    largest(values, sd_min, CHANGE_NEEDS..(values.len() + 1).saturating_sub(CHANGE_NEEDS), CHANGE_ERRORS)
}

/// The change by the most standard errors among those before which `places` episodes are, if it is one by more than `most_errors`.
fn largest(values: &[f64], sd_min: f64, places: std::ops::Range<usize>, mut most_errors: f64) -> Option<Changed> {
    let n = values.len();
    let mut found = None;
    for k in places {
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
        // What says nothing alone is suspected, and nothing else is.
        let places = |gains: &[f64]| suspected_gain(gains).map(|c| c.episodes_before);
        assert_eq!((places(&changed(5, 0.12)), places(&changed(6, -0.12))), (Some(5), Some(6)));
        assert_eq!((places(&scatter), places(&changed(5, 0.02)), places(&[0.2, 0.0, 0.0]), places(&[])), (None, None, None, None));
    }
}
