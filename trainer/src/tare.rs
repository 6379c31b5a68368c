//! Finds grams that stand in every weight and did not come through the stream: a cup that was never tared.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail. Weights that are all too heavy by the same do not contradict each
//! other enough to accuse one of them: another exponent of the area takes most of it. But a stream of no area weighs nothing. So the weights are met once by
//! `w_E = c sum area^q`, and once by `w_E = c sum area^q + tare`, and the second must not be the better one.

use crate::calibration::{self, EXPONENT_EXPECTED, EXPONENT_SD, EXPONENTS, READING_SD_G, WEIGHT_SPREAD};
use crate::data::TrainingEpisode;

/// Three unknowns are met by three weights, however wrong they are.
const NEEDS: usize = 4;
/// How much better the weights must be met with a tare than without, as a difference of squares in variances of a weight. Chosen by hand, above the 6.9 that
/// the largest of 76 right sets of tuning rigs showed.
const BETTER: f64 = 12.0;
/// No cup is lighter, g. Chosen by hand: one of paper has 5 g. A camera that misses the last drops of each pour leaves 1 to 3 g.
const CUP_LEAST_G: f64 = 5.0;

/// What the weights say at one exponent, as sums over the episodes in variances of a weight.
#[derive(Debug, Default)]
struct Sums {
    one: f64,
    area: f64,
    area_area: f64,
    weight: f64,
    area_weight: f64,
    weight_weight: f64,
}

impl Sums {
    fn of(episodes: &[TrainingEpisode], exponent: f64) -> Self {
        let mut sums = Self::default();
        for e in episodes {
            let precision = READING_SD_G.hypot(WEIGHT_SPREAD * e.weight_g).powi(-2);
            let area = calibration::area_sum(e, exponent);
            sums.one += precision;
            sums.area += precision * area;
            sums.area_area += precision * area * area;
            sums.weight += precision * e.weight_g;
            sums.area_weight += precision * area * e.weight_g;
            sums.weight_weight += precision * e.weight_g * e.weight_g;
        }
        sums
    }

    /// What remains of the weights without a tare.
    fn without(&self) -> f64 {
        self.weight_weight - self.area_weight.powi(2) / self.area_area
    }

    /// The tare, g, and what remains with it; `None` where the areas are too alike to tell, or more area would weigh less.
    fn with(&self) -> Option<(f64, f64)> {
        let determinant = self.area_area * self.one - self.area * self.area;
        let c = (self.area_weight * self.one - self.area * self.weight) / determinant;
        let tare_g = (self.area_area * self.weight - self.area * self.area_weight) / determinant;
        let remains = self.weight_weight - c * self.area_weight - tare_g * self.weight;
        let is_told = determinant > 1e-9 * self.area_area * self.one && c > 0.0;
        is_told.then_some((tare_g, remains))
    }
}

/// The grams that every weight has too many, or too few where they are negative; `None` where the weights do not say so.
pub fn common_g(episodes: &[TrainingEpisode]) -> Option<f64> {
    if episodes.len() < NEEDS {
        return None;
    }
    let (mut without, mut with) = (f64::INFINITY, (f64::INFINITY, 0.0, 0.0));
    for exponent in EXPONENTS.step_by(5).map(|hundredths| f64::from(hundredths) / 100.0) {
        let sums = Sums::of(episodes, exponent);
        let expected = ((exponent - EXPONENT_EXPECTED) / EXPONENT_SD).powi(2);
        without = (sums.without() + expected).min(without);
        if let Some((tare_g, remains)) = sums.with().filter(|(_, remains)| remains + expected < with.0) {
            with = (remains + expected, tare_g, remains);
        }
    }
    let (least, tare_g, remains) = with;
    // Where a tare does not explain the weights either, its advantage counts for less.
    let unexplained = (remains / (episodes.len() - 3) as f64).max(1.0);
    let is_better = without - least > BETTER * unexplained;
    (is_better && tare_g.abs() >= CUP_LEAST_G).then_some(tare_g)
}
