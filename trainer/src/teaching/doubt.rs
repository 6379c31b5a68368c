//! How wrong the camera's volume may still be, after what was weighed.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail.
//!
//! The camera's volume of a stream is taken as off by a share g of its area and tilt. Before any weight, g is a constant (c), a slope in
//! the logarithm of the area (q), a slope in the tilt, and a rough part that forgets itself over a factor of the area and some degrees. A
//! weight is the sum of an episode's volumes, each with its own g, and so it takes doubt from all streams that are alike (a Kalman update). What the
//! weights then still scatter by is taken for changes of the camera's gain from pour to pour ([`gain_sd`]).

use nalgebra::{DMatrix, DVector};

use super::span::{CELLS, Span, middle};

/// Doubt about c before any weight (log): nothing is known of how many px^2 a ml shows.
const FACTOR_SD: f64 = 1.0;
/// Doubt about q: as wide as the fit's own prior.
const EXPONENT_SD: f64 = 0.15;
/// Doubt about the change with the tilt, a log for 30 degrees: as wide as the fit's own prior.
const TILT_SLOPE_SD: f64 = 0.05;
/// Doubt about what no power law says. In the rendered camera, the area of one flow departs from it by up to 4 % between 25 and 105 degrees.
const ROUGH_SD: f64 = 0.04;
/// Over which logarithm of the area the rough part forgets itself: a factor of 2.7. Chosen by hand; no measurement is recorded.
const ROUGH_LOG_AREA: f64 = 1.0;
/// Over how many degrees the rough part forgets itself. Chosen by hand; no measurement is recorded.
const ROUGH_DEG: f64 = 15.0;
/// How much the camera's gain changes from pour to pour at least (log): as in the fit.
const GAIN_SD: f64 = 0.017;
/// How much it changes at most (log): weights that scatter by more are no measurement. Chosen by hand.
const GAIN_SD_MAX: f64 = 0.7;
/// So many weights that scatter as expected are taken to have been there before the first: few weights scatter by chance. Chosen by hand.
const EXPECTED_BEFORE: f64 = 2.0;
/// Error of a weight, g: from rounding and reading a kitchen scale.
const SCALE_SD_G: f64 = 0.6;

/// What is not known of the camera's volumes.
#[derive(Debug, Clone)]
pub struct Doubt {
    /// Covariance of the shares by which the cells' volumes are off.
    covariance: DMatrix<f64>,
    /// How much the camera's gain changes from pour to pour (log).
    gain_sd: f64,
}

impl Doubt {
    /// The doubt before any weight. `log_area` is where the doubts about c and q have nothing to do with each other, and `gain_sd` how much the gain
    /// changes from pour to pour (log).
    pub fn before(log_area: f64, gain_sd: f64) -> Self {
        let covariance = DMatrix::from_fn(CELLS, CELLS, |i, j| {
            let ((a, tilt_a), (b, tilt_b)) = (middle(i), middle(j));
            let z = |deg: f64| (deg - 60.0) / 30.0;
            let apart = ((a - b) / ROUGH_LOG_AREA).powi(2) + ((tilt_a - tilt_b) / ROUGH_DEG).powi(2);
            FACTOR_SD.powi(2)
                + EXPONENT_SD.powi(2) * (a - log_area) * (b - log_area)
                + TILT_SLOPE_SD.powi(2) * z(tilt_a) * z(tilt_b)
                + ROUGH_SD.powi(2) * (-0.5 * apart).exp()
        });
        Self { covariance, gain_sd }
    }

    /// The variance of a span's volume, and its covariance with each cell.
    fn of(&self, span: &Span) -> (f64, DVector<f64>) {
        let ml = DVector::from_column_slice(&span.ml);
        let with_cells = &self.covariance * &ml;
        (ml.dot(&with_cells), with_cells)
    }

    /// The doubt that is left when streams like these are weighed.
    #[must_use]
    pub fn weighed(&self, span: &Span) -> Self {
        let (_, with_cells) = self.of(span);
        let covariance = &self.covariance - &with_cells * with_cells.transpose() / self.weight_variance_ml2(span);
        Self { covariance, ..*self }
    }

    /// By how much the weight of these streams may be off from what is foreseen, a variance, ml^2.
    fn weight_variance_ml2(&self, span: &Span) -> f64 {
        self.of(span).0 + SCALE_SD_G.powi(2) + (self.gain_sd * span.volume_ml()).powi(2)
    }

    /// Standard deviation of the camera's volume of a pour that shows these streams, ml.
    pub fn sd_ml(&self, span: &Span) -> f64 {
        (self.of(span).0.max(0.0) + (self.gain_sd * span.volume_ml()).powi(2)).sqrt()
    }
}

/// How much the camera's gain changes from pour to pour (log), by how far `weights_g` are from the volumes of their streams once the camera is known: at
/// least what is usual, and more where they scatter by more than that explains. `log_area` is as in [`Doubt::before`].
pub fn gain_sd(log_area: f64, weighed: &[Span], weights_g: &[f64]) -> f64 {
    // The scatter falls with the deviation that is expected.
    let scatters = |gain_sd: f64| scatter(Doubt::before(log_area, gain_sd), weighed, weights_g) > 1.0;
    if !scatters(GAIN_SD) {
        return GAIN_SD;
    }
    let (mut low, mut high) = (GAIN_SD, GAIN_SD_MAX);
    for _ in 0..12 {
        let middle = (low * high).sqrt();
        if scatters(middle) { low = middle } else { high = middle }
    }
    high
}

/// The mean square by which each weight is off from what the ones before it foresee, in the variances that are expected.
fn scatter(mut doubt: Doubt, weighed: &[Span], weights_g: &[f64]) -> f64 {
    let mut share = DVector::zeros(CELLS);
    let mut squares = EXPECTED_BEFORE;
    for (span, weight_g) in weighed.iter().zip(weights_g) {
        let ml = DVector::from_column_slice(&span.ml);
        let (off_ml, variance_ml2) = (weight_g - span.volume_ml() - ml.dot(&share), doubt.weight_variance_ml2(span));
        squares += off_ml * off_ml / variance_ml2;
        share += doubt.of(span).1 * (off_ml / variance_ml2);
        doubt = doubt.weighed(span);
    }
    squares / (EXPECTED_BEFORE + weighed.len() as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stream(area_px2: f64, tilt_deg: f64, ml: f64) -> Span {
        let mut span = Span::empty();
        span.add(area_px2, tilt_deg, ml);
        span
    }

    /// Protects the reasoning: a weight takes most doubt from streams like its own, less from others, and never adds any; a heavy one takes
    /// more than a light one, because the scale rounds.
    #[test]
    fn a_weight_teaches_about_streams_like_its_own() {
        let before = Doubt::before(7.0, GAIN_SD);
        let (same, other_area, other_tilt) = (stream(1000.0, 55.0, 100.0), stream(9000.0, 55.0, 100.0), stream(1000.0, 95.0, 100.0));
        let after = before.weighed(&same);
        let sds = [&same, &other_area, &other_tilt].map(|span| (before.sd_ml(span), after.sd_ml(span)));
        assert!(sds.iter().all(|(b, a)| a < b), "{sds:?}");
        assert!(sds[0].1 < 3.0 && sds[1].1 > 5.0 * sds[0].1 && sds[2].1 > 1.5 * sds[0].1, "{sds:?}");
        let light = before.weighed(&stream(1000.0, 55.0, 10.0)).sd_ml(&same);
        assert!(light > 1.5 * sds[0].1, "{light} {sds:?}");
    }

    /// Protects who plans from weights that do not fit each other: what they scatter by counts for the pours to come, a camera that reads everything too
    /// large by one factor is no scatter, and neither is what a scale rounds.
    #[test]
    fn weights_that_scatter_leave_doubt() {
        let spans: Vec<Span> = (0..6).map(|k| stream(1000.0, 55.0, 60.0 + 20.0 * f64::from(k))).collect();
        let found = |off: &dyn Fn(usize) -> f64| {
            let weights_g: Vec<f64> = spans.iter().enumerate().map(|(k, span)| (span.volume_ml() * (1.0 + off(k))).round()).collect();
            gain_sd(7.0, &spans, &weights_g)
        };
        assert_eq!(found(&|_| 0.0), GAIN_SD);
        assert_eq!(found(&|_| 0.3), GAIN_SD);
        let by_turns = |share: f64| move |k: usize| if k.is_multiple_of(2) { share } else { -share };
        let sds = [0.01, 0.06, 0.12].map(|share| found(&by_turns(share)));
        assert!(sds[0] == GAIN_SD && (0.04..0.09).contains(&sds[1]) && (0.09..0.17).contains(&sds[2]), "{sds:?}");
        assert_eq!(gain_sd(7.0, &[], &[]), GAIN_SD);
    }
}
