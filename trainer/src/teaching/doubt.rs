//! How wrong the camera's volume may still be, after what was weighed.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail.
//!
//! The camera's volume of a stream is taken as off by a share g of its area and tilt. Before any weight, g is a constant (c), a slope in
//! the logarithm of the area (q), a slope in the tilt, and a rough part that forgets itself over a factor of the area and some degrees. A
//! weight is the sum of an episode's volumes, each with its own g, and so it takes doubt from all streams that are alike (a Kalman update).

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
/// How much the camera's gain changes from pour to pour (log): as in the fit.
const GAIN_SD: f64 = 0.017;
/// Error of a weight, g: from rounding and reading a kitchen scale.
const SCALE_SD_G: f64 = 0.6;

/// What is not known of the camera's volumes.
#[derive(Debug, Clone)]
pub struct Doubt {
    /// Covariance of the shares by which the cells' volumes are off.
    covariance: DMatrix<f64>,
}

impl Doubt {
    /// The doubt before any weight. `log_area` is where the doubts about c and q have nothing to do with each other.
    pub fn before(log_area: f64) -> Self {
        let covariance = DMatrix::from_fn(CELLS, CELLS, |i, j| {
            let ((a, tilt_a), (b, tilt_b)) = (middle(i), middle(j));
            let z = |deg: f64| (deg - 60.0) / 30.0;
            let apart = ((a - b) / ROUGH_LOG_AREA).powi(2) + ((tilt_a - tilt_b) / ROUGH_DEG).powi(2);
            FACTOR_SD.powi(2)
                + EXPONENT_SD.powi(2) * (a - log_area) * (b - log_area)
                + TILT_SLOPE_SD.powi(2) * z(tilt_a) * z(tilt_b)
                + ROUGH_SD.powi(2) * (-0.5 * apart).exp()
        });
        Self { covariance }
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
        let (variance, with_cells) = self.of(span);
        let noise = SCALE_SD_G.powi(2) + (GAIN_SD * span.volume_ml()).powi(2);
        Self { covariance: &self.covariance - &with_cells * with_cells.transpose() / (variance + noise) }
    }

    /// Standard deviation of the camera's volume of a pour that shows these streams, ml.
    pub fn sd_ml(&self, span: &Span) -> f64 {
        (self.of(span).0.max(0.0) + (GAIN_SD * span.volume_ml()).powi(2)).sqrt()
    }
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
        let before = Doubt::before(7.0);
        let (same, other_area, other_tilt) = (stream(1000.0, 55.0, 100.0), stream(9000.0, 55.0, 100.0), stream(1000.0, 95.0, 100.0));
        let after = before.weighed(&same);
        let sds = [&same, &other_area, &other_tilt].map(|span| (before.sd_ml(span), after.sd_ml(span)));
        assert!(sds.iter().all(|(b, a)| a < b), "{sds:?}");
        assert!(sds[0].1 < 3.0 && sds[1].1 > 5.0 * sds[0].1 && sds[2].1 > 1.5 * sds[0].1, "{sds:?}");
        let light = before.weighed(&stream(1000.0, 55.0, 10.0)).sd_ml(&same);
        assert!(light > 1.5 * sds[0].1, "{light} {sds:?}");
    }
}
