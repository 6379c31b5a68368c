//! Area to ml from weights alone: `w_E = c sum area^q`, the paper's normalised contribution volumes with an exponent.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail. c is found by weighted least squares, and q on a
//! grid with a prior. Too few episodes leave q = 1, because the exponent cannot be told from them.

use shared::estimator::{Calibration, Hold};

use crate::data::TrainingEpisode;

/// A single zero right after an area above this is a dropout, px^2. From the prototype (its camera's error fell from 2.8 to 1.95 ml).
pub const HOLD_ABOVE_PX2: f32 = 60.0;
/// Fewer episodes than this leave q = 1. From the prototype, in which only a linear calibration was any good below this.
pub const EXPONENT_NEEDS: usize = 4;
/// The exponent that is expected of a camera, as the prototype's cameras had it.
pub const EXPONENT_EXPECTED: f64 = 1.15;
/// Standard deviation of the exponent's prior here. From the prototype; no other measurement is recorded.
pub const EXPONENT_SD: f64 = 0.4;
/// Exponents that are tried, in hundredths: those of the prototype's cameras, and more. Chosen by hand.
pub const EXPONENTS: std::ops::RangeInclusive<u32> = 80..=170;

/// Standard deviation of a weight as the camera's sum of areas predicts it, g: a constant part and a share of the weight. From the
/// prototype; no other measurement is recorded.
fn weight_sd_g(weight_g: f64) -> f64 {
    0.7 + 0.03 * weight_g
}

/// Sum of area^q over an episode with the dropout hold, as at run time.
pub fn area_sum(episode: &TrainingEpisode, exponent: f64) -> f64 {
    let mut hold = Hold::default();
    let mut sum = 0.0;
    for area in &episode.area_px2 {
        let held = hold.step(Some(*area as f32).filter(|a| !a.is_nan()), HOLD_ABOVE_PX2);
        if held > 0.0 {
            sum += f64::from(held).powf(exponent);
        }
    }
    sum
}

/// c for an exponent, and how badly the two together meet the weights and the prior.
fn factor(episodes: &[TrainingEpisode], exponent: f64) -> (f64, f64) {
    let (mut numerator, mut denominator) = (0.0, 0.0);
    let sums: Vec<f64> = episodes.iter().map(|e| area_sum(e, exponent)).collect();
    for (e, sum) in episodes.iter().zip(&sums) {
        let weight = 1.0 / weight_sd_g(e.weight_g).powi(2);
        numerator += weight * sum * e.weight_g;
        denominator += weight * sum * sum;
    }
    let c = if denominator > 0.0 { numerator / denominator } else { 1e-6 };
    let misfit: f64 = episodes.iter().zip(&sums).map(|(e, s)| ((c * s - e.weight_g) / weight_sd_g(e.weight_g)).powi(2)).sum();
    (c, misfit + ((exponent - EXPONENT_EXPECTED) / EXPONENT_SD).powi(2))
}

/// Finds c and q, or c alone if the exponent is given. If it is not given and there are fewer than [`EXPONENT_NEEDS`] episodes, q
/// is 1.
pub fn calibrate(episodes: &[TrainingEpisode], exponent: Option<f64>) -> Calibration {
    let exponent = exponent.unwrap_or_else(|| {
        if episodes.len() < EXPONENT_NEEDS {
            return 1.0;
        }
        let grid = EXPONENTS.map(|hundredths| f64::from(hundredths) / 100.0);
        grid.min_by(|a, b| factor(episodes, *a).1.total_cmp(&factor(episodes, *b).1)).unwrap_or(1.0)
    });
    Calibration {
        volume_at_1_px2_ml: factor(episodes, exponent).0.max(f64::from(f32::MIN_POSITIVE)) as f32,
        area_exponent: exponent as f32,
        log_tilt_slope: 0.0,
        hold_above_px2: HOLD_ABOVE_PX2,
    }
}

/// Noise of a weight that a calibration without doubt would leave, g: what the scale rounds, and who reads it. Chosen by hand; no measurement is recorded.
pub const READING_SD_G: f64 = 0.7;
/// By how much a right weight is off the sum of its areas beyond that (log), as a standard deviation. Chosen by hand; no measurement is recorded.
pub const WEIGHT_SPREAD: f64 = 0.03;
/// The least that the misfit of the weights lowers the doubt by, as a variance: few weights may meet each other by chance. Chosen by hand;
/// docs/LEARNING.md has the coverage.
const MISFIT_MIN: f64 = 0.25;
/// Number of weights as which the expected misfit counts.
const MISFIT_EXPECTED: f64 = 2.0;

/// The largest entry of the covariance of log c and q: a weight file holds 25.
const COVARIANCE_MAX: f64 = 24.0;

/// By how much a pour misses its weight as a rule (log): a camera's gain of 1.5 % on the rigs, and what is left of a power law.
const POUR_SD: f64 = 0.017;
/// Number of episodes as which that counts. Chosen by hand, as in the fit.
const POURS_EXPECTED: f64 = 3.0;

/// A calibration, and what the weights leave open of it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Doubted {
    /// The calibration.
    pub calibration: Calibration,
    /// Covariance of log c and q.
    pub covariance: [[f64; 2]; 2],
    /// By how much it misses the weight of an episode (log), beyond what the scale makes: a mean of what is expected and of what was seen.
    pub pour_sd: f64,
}

/// The same calibration as [`calibrate`] finds, with its doubt; weights that it meets badly raise the doubt. `exact` takes q = 1 as right.
///
/// Where there are too few episodes for q, it is the expected one.
pub fn with_doubt(episodes: &[TrainingEpisode], exact: bool) -> Doubted {
    let few = episodes.len() < EXPONENT_NEEDS;
    let calibration = calibrate(episodes, if exact { Some(1.0) } else { few.then_some(EXPONENT_EXPECTED) });
    let q = f64::from(calibration.area_exponent);
    let mut data = [[0.0; 2]; 2];
    let mut misfit = MISFIT_EXPECTED;
    let (mut misses, mut told) = (0.0, 0.0);
    for e in episodes {
        let sum_ml = f64::from(calibration.volume_at_1_px2_ml) * area_sum(e, q);
        let step = 1e-3;
        let slope_ml = f64::from(calibration.volume_at_1_px2_ml) * (area_sum(e, q + step) - area_sum(e, q - step)) / (2.0 * step);
        let sd_g = if exact { READING_SD_G } else { weight_sd_g(e.weight_g) };
        let slopes = [sum_ml / sd_g, slope_ml / sd_g];
        misfit += ((sum_ml - e.weight_g) / sd_g).powi(2);
        let read = (READING_SD_G / e.weight_g).powi(2);
        // What the scale rounds of a light weight hides how far it is missed, and would count for more than all that the others show.
        let tells = POUR_SD * POUR_SD / (POUR_SD * POUR_SD + read);
        misses += tells * (((sum_ml - e.weight_g) / e.weight_g).powi(2) - read);
        told += tells;
        for (row, a) in data.iter_mut().zip(slopes) {
            for (value, b) in row.iter_mut().zip(slopes) {
                *value += a * b;
            }
        }
    }
    let misfit = (misfit / episodes.len().max(1) as f64).max(MISFIT_MIN);
    // The weights' misfit says how much they are worth, and nothing about what was known before them.
    let [[cc, cq], [_, of_weights]] = data.map(|row| row.map(|v| v / misfit));
    let qq = of_weights + 1.0 / (EXPONENT_SD * EXPONENT_SD);
    let determinant = (cc * qq - cq * cq).max(1e-12);
    let covariance = if exact {
        [[1.0 / cc.max(1e-12), 0.0], [0.0, 0.0]]
    } else {
        [[qq / determinant, -cq / determinant], [-cq / determinant, cc / determinant]]
    };
    let n = episodes.len() as f64;
    // Two unknowns have met two of the weights.
    let seen = if few { 0.0 } else { misses.max(0.0) * n / (n - 2.0).max(1.0) };
    let pour_sd = ((POURS_EXPECTED * POUR_SD * POUR_SD + seen) / (POURS_EXPECTED + if few { 0.0 } else { told })).sqrt();
    // Cut as a whole: entries that are cut one by one are no covariance, and leave no doubt at all at the areas of the episodes.
    let largest = covariance.iter().flatten().fold(0.0f64, |most, v| most.max(v.abs()));
    let share = (COVARIANCE_MAX / largest.max(1e-12)).min(1.0);
    Doubted { calibration, covariance: covariance.map(|row| row.map(|v| share * v)), pour_sd }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects what is said of a pour after one or two weighings before a camera that shows large areas: the doubt of q is there at other areas
    /// than theirs, and that of the weights at theirs.
    #[test]
    fn few_weights_leave_doubt_at_any_area() {
        for area in [100.0, 1000.0, 10_000.0, 30_000.0f64] {
            for weights_g in [&[40.0][..], &[40.0, 44.0]] {
                let one = |weight_g: &f64| {
                    let mut e = TrainingEpisode::empty("x", 30.0);
                    (0..60).for_each(|k| e.push(f64::from(k) / 30.0, 50.0, f64::NAN, area));
                    e.weight_g = *weight_g;
                    e
                };
                let episodes: Vec<TrainingEpisode> = weights_g.iter().map(one).collect();
                let [[cc, cq], [_, qq]] = with_doubt(&episodes, false).covariance;
                let sd = |area: f64| (cc + 2.0 * area.ln() * cq + area.ln().powi(2) * qq).sqrt();
                assert!(sd(area) > 0.02 && sd(area) < 0.1, "{area} px^2: {}", sd(area));
                assert!(sd(0.5 * area) > 0.5 * EXPONENT_SD * 2f64.ln(), "{area} px^2: {}", sd(0.5 * area));
                assert!(cc <= 25.0 && qq <= 25.0 && cq.abs() <= 25.0, "a weight file holds no more");
            }
        }
    }

    /// Sixty frames of an area, weighed.
    fn weighed(area: f64, weight_g: f64) -> TrainingEpisode {
        let mut e = TrainingEpisode::empty("x", 30.0);
        (0..60).for_each(|k| e.push(f64::from(k) / 30.0, 50.0, f64::NAN, area));
        e.weight_g = weight_g;
        e
    }

    /// Protects the doubt of q from weights that say nothing about it: those of streams that are alike leave it as it was known before them, however
    /// many they are and however well they meet each other.
    #[test]
    fn weights_of_like_streams_do_not_tell_the_exponent() {
        for n in [4, 8, 20] {
            let [_, [_, qq]] = with_doubt(&vec![weighed(1000.0, 60.0); n], false).covariance;
            assert!((qq.sqrt() / EXPONENT_SD - 1.0).abs() < 0.01, "{n} weights: {}", qq.sqrt());
        }
    }

    /// Protects cameras with a unit of their own, such as square micrometres: c has no floor that their areas reach.
    #[test]
    fn the_calibration_has_no_unit_of_its_own() {
        let episodes = [40.0, 60.0, 80.0, 100.0].map(|weight_g| weighed(1e11 * weight_g, weight_g));
        let Calibration { volume_at_1_px2_ml, area_exponent, .. } = calibrate(&episodes, None);
        let ml = f64::from(volume_at_1_px2_ml) * area_sum(&episodes[2], f64::from(area_exponent));
        assert!((ml - 80.0).abs() < 3.0, "{ml}");
    }

    /// Protects the scatter that the weights show from a light one, which the scale's rounding hides: a gram more or less changes next to nothing.
    #[test]
    fn a_light_weight_hides_no_scatter() {
        let off = [1.06, 0.95, 1.05, 0.94, 1.07, 0.93, 1.06, 0.95, 1.04, 0.96];
        let mut episodes: Vec<TrainingEpisode> =
            off.iter().enumerate().map(|(k, off)| weighed(500.0 * (1 + k) as f64, (30.0 * (1 + k) as f64 * off).round())).collect();
        let without = with_doubt(&episodes, false).pour_sd;
        assert!(without > 0.04, "{without}");
        for weight_g in [1.0, 2.0] {
            episodes.push(weighed(17.0, weight_g));
            let with = with_doubt(&episodes, false).pour_sd;
            assert!((with / without - 1.0).abs() < 0.05, "{weight_g} g: {without} without it, {with} with it");
        }
    }
}
