//! Finds two weights that were entered for each other.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail. Each of two exchanged weights may be off by little, and both are
//! then within what the others leave in doubt. Together they are not: where `w_E = c sum area^q` is met far better once the two are exchanged back, with no
//! unknown more, they were exchanged.

use crate::calibration::{self, EXPONENT_EXPECTED, EXPONENT_SD, EXPONENTS, READING_SD_G, WEIGHT_SPREAD};
use crate::data::TrainingEpisode;

/// Fewer weights are met by c and q, however they are exchanged.
const NEEDS: usize = 4;
/// How much better the weights must be met once two are exchanged back, as a difference of squares in variances of a weight. Chosen by hand, above the 9.1
/// that the largest of 216 right sets of tuning rigs showed (4, 5, 8 and 10 curves; cylinders 100 to 123, other vessels 200 to 202).
const BETTER: f64 = 12.0;

/// An episode's weight, g, and its variance.
type Weight = (f64, f64);

/// How badly weights meet the sums of areas at the best c, as a sum of squares in variances of a weight.
fn misfit(weights: &[Weight], sums: &[f64]) -> f64 {
    let (mut weight_weight, mut area_weight, mut area_area) = (0.0, 0.0, 0.0);
    for ((weight_g, variance_g2), area) in weights.iter().zip(sums) {
        weight_weight += weight_g * weight_g / variance_g2;
        area_weight += area * weight_g / variance_g2;
        area_area += area * area / variance_g2;
    }
    weight_weight - area_weight * area_weight / area_area
}

/// The two episodes whose weights were entered for each other, the earlier one first; `None` where the weights do not say so.
pub fn pair(episodes: &[TrainingEpisode]) -> Option<(usize, usize)> {
    if episodes.len() < NEEDS {
        return None;
    }
    let mut weights: Vec<Weight> =
        episodes.iter().map(|e| (e.weight_g, READING_SD_G.powi(2) + (WEIGHT_SPREAD * e.weight_g).powi(2))).collect();
    let exponents = EXPONENTS.step_by(5).map(|hundredths| f64::from(hundredths) / 100.0);
    let at: Vec<(f64, Vec<f64>)> = exponents
        .map(|exponent| {
            let expected = ((exponent - EXPONENT_EXPECTED) / EXPONENT_SD).powi(2);
            (expected, episodes.iter().map(|e| calibration::area_sum(e, exponent)).collect())
        })
        .collect();
    let least = |weights: &[Weight]| at.iter().map(|(expected, sums)| expected + misfit(weights, sums)).fold(f64::INFINITY, f64::min);
    let as_entered = least(&weights);
    let mut best = (as_entered, None);
    for second in 1..weights.len() {
        for first in 0..second {
            weights.swap(first, second);
            let exchanged = least(&weights);
            weights.swap(first, second);
            if exchanged < best.0 {
                best = (exchanged, Some((first, second)));
            }
        }
    }
    // Where an exchange does not explain the weights either, its advantage counts for less.
    let unexplained = (best.0 / (episodes.len() - 2) as f64).max(1.0);
    best.1.filter(|_| as_entered - best.0 > BETTER * unexplained)
}
