//! Finds weights that do not fit the others: a typo, or a cup that was not tared.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail. Each weight is compared with what the camera's
//! areas say when they are calibrated on all other episodes. The worst one is taken out, and the rest are compared again, so that one wrong
//! weight does not accuse the others. Where either of two may be the wrong one, as the rest agree without the one or without the other, both are
//! accused.
//!
//! Two or three weights leave the exponent of the area open, so each pair of them is compared at the exponent that suits it best. Of three, the
//! two that are least apart accuse the third. Two that contradict each other accuse both, as nobody knows which one is wrong.

use serde::Serialize;

use crate::calibration::{self, Doubted};
use crate::data::TrainingEpisode;

/// So many episodes calibrate each other, the exponent included. Chosen by hand; no measurement is recorded.
const NEEDS: usize = 4;
/// Exponents of the area at which two weights may agree: those of the prototype's cameras, and more. Chosen by hand.
const EXPONENTS: std::ops::RangeInclusive<u32> = 80..=170;
/// By how much two weights may be apart at the best of them (log), as a standard deviation. Chosen by hand: none of 80 right sets of simulated rigs was accused.
const PAIR_SPREAD: f64 = 0.08;
/// Standard deviations at which a weight is doubted. Chosen by hand; no measurement is recorded.
const DOUBTED_SDS: f64 = 4.0;
/// Standard deviation of reading the scale, g. Chosen by hand; no measurement is recorded.
const READING_SD_G: f64 = 0.7;
/// By how much a right weight may be off what the others say beyond the doubt of their calibration (log), as a standard deviation. Chosen by hand.
const SPREAD_LEAST: f64 = 0.03;
/// The same of few episodes, times their number. Chosen by hand; no measurement is recorded.
const SPREAD_FEW: f64 = 0.1;
/// Step of the exponent for a difference quotient.
const STEP: f64 = 1e-3;

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

/// What an episode's weight and areas say about the weight of another one, g, with its standard deviation, at the exponent that suits the other one
/// best; and by how many standard deviations it is off all the same.
fn told_by(one: &TrainingEpisode, other: &TrainingEpisode) -> (f64, f64, f64) {
    let at = |exponent: u32| {
        let exponent = f64::from(exponent) / 100.0;
        let expected_g = one.weight_g * calibration::area_sum(other, exponent) / calibration::area_sum(one, exponent).max(1e-9);
        let sd_g = READING_SD_G.hypot(expected_g * PAIR_SPREAD.hypot(READING_SD_G / one.weight_g));
        (expected_g, sd_g, (other.weight_g - expected_g).abs() / sd_g)
    };
    let first = at(*EXPONENTS.start());
    EXPONENTS.step_by(10).map(at).fold(first, |best, next| if next.2 < best.2 { next } else { best })
}

/// Weights of two or three episodes that contradict each other.
fn doubtful_of_few(episodes: &[TrainingEpisode]) -> Vec<DoubtfulWeight> {
    let apart_sds = |j: usize, k: usize| told_by(&episodes[j], &episodes[k]).2.min(told_by(&episodes[k], &episodes[j]).2);
    let pairs = (0..episodes.len()).flat_map(|k| (0..k).map(move |j| (j, k)));
    let Some((least_sds, (j, k))) = pairs.map(|(j, k)| (apart_sds(j, k), (j, k))).min_by(|a, b| a.0.total_cmp(&b.0)) else {
        return Vec::new();
    };
    let trusted: &[usize] = if least_sds < DOUBTED_SDS { &[j, k] } else { &[] };
    let accused = (0..episodes.len()).filter(|i| !trusted.contains(i)).filter_map(|i| {
        let others = (0..episodes.len()).filter(|o| *o != i && (trusted.is_empty() || trusted.contains(o)));
        let (expected_g, sd_g, sds) = others.map(|o| told_by(&episodes[o], &episodes[i])).max_by(|a, b| a.2.total_cmp(&b.2))?;
        let e = &episodes[i];
        (sds >= DOUBTED_SDS).then(|| DoubtfulWeight { name: e.name.clone(), weight_g: e.weight_g, expected_g, sd_g })
    });
    accused.collect()
}

/// What the other episodes say about the weight of the one with this index, g, with its standard deviation.
fn told_by_others(episodes: &[TrainingEpisode], k: usize) -> (f64, f64) {
    let others: Vec<TrainingEpisode> = episodes.iter().enumerate().filter(|(j, _)| *j != k).map(|(_, e)| e.clone()).collect();
    // Others that contradict each other raise the doubt of their calibration, and so accuse nobody.
    let Doubted { calibration, covariance, .. } = calibration::with_doubt(&others, false);
    let (c, q) = (f64::from(calibration.volume_at_1_px2_ml), f64::from(calibration.area_exponent));
    let expected_g = c * calibration::area_sum(&episodes[k], q);
    let slope =
        (calibration::area_sum(&episodes[k], q + STEP) / calibration::area_sum(&episodes[k], q - STEP).max(1e-9)).ln() / (2.0 * STEP);
    let [[of_c, both], [_, of_q]] = covariance;
    let log_variance = of_c + 2.0 * both * slope + of_q * slope * slope;
    let spread = SPREAD_LEAST + SPREAD_FEW / episodes.len() as f64;
    (expected_g, READING_SD_G.hypot(expected_g * spread.hypot(log_variance.max(0.0).sqrt())))
}

/// By how many standard deviations each weight is off what the others say, with what they say, g, and its standard deviation.
fn apart(episodes: &[TrainingEpisode]) -> Vec<(f64, f64, f64)> {
    let told = |k: usize| {
        let (expected_g, sd_g) = told_by_others(episodes, k);
        ((episodes[k].weight_g - expected_g).abs() / sd_g, expected_g, sd_g)
    };
    (0..episodes.len()).map(told).collect()
}

/// Whether the weights without the one with this index agree.
fn agree_without(episodes: &[TrainingEpisode], k: usize) -> bool {
    let others: Vec<TrainingEpisode> = episodes.iter().enumerate().filter(|(j, _)| *j != k).map(|(_, e)| e.clone()).collect();
    if others.len() < NEEDS { doubtful_of_few(&others).is_empty() } else { apart(&others).iter().all(|(sds, ..)| *sds < DOUBTED_SDS) }
}

/// Weights that do not fit the others, worst first.
pub fn doubtful(episodes: &[TrainingEpisode]) -> Vec<DoubtfulWeight> {
    let mut left: Vec<TrainingEpisode> = episodes.to_vec();
    let mut found = Vec::new();
    while left.len() >= NEEDS {
        let told = apart(&left);
        let Some(worst) = (0..left.len()).max_by(|a, b| told[*a].0.total_cmp(&told[*b].0)).filter(|k| told[*k].0 >= DOUBTED_SDS) else {
            break;
        };
        let mut accused = vec![worst];
        if agree_without(&left, worst) {
            // Those that may be the wrong one in its place: they are off, too, and without them the rest agree.
            accused.extend((0..left.len()).filter(|k| *k != worst && told[*k].0 >= DOUBTED_SDS && agree_without(&left, *k)));
        }
        found.extend(accused.iter().map(|k| {
            let (e, (_, expected_g, sd_g)) = (&left[*k], told[*k]);
            DoubtfulWeight { name: e.name.clone(), weight_g: e.weight_g, expected_g, sd_g }
        }));
        left = left.into_iter().enumerate().filter(|(k, _)| !accused.contains(k)).map(|(_, e)| e).collect();
    }
    if left.len() < NEEDS {
        found.extend(doubtful_of_few(&left));
    }
    found
}
