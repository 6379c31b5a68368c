//! The solution of a stage of the fit: what was found, how sure that is, and how well it explains the episodes.
//!
//! Pure functions of the offline trainer, which allocate and do not fail.

use nalgebra::DMatrix;
use shared::estimator::Calibration;
use shared::estimator::flow::FlowModel;

use super::noise;
use super::problem::Problem;
use super::unknowns::{AREA_EXPONENT, LOG_C, TILT_SLOPE, Unknowns};
use crate::calibration;

/// One explanation, fitted.
pub struct Fitted {
    /// The unknowns.
    pub found: Unknowns,
    /// Covariance of all unknowns.
    pub covariance: DMatrix<f64>,
    /// The model of the unknowns that all episodes share.
    pub model: FlowModel,
    /// Logarithm of the evidence, up to a constant that both explanations share; minus infinity for a solution whose doubt cannot be told.
    pub log_evidence: f64,
    /// Sum of the squared residuals.
    pub cost: f64,
    /// Frames of the episodes for one at 30 frames a second.
    pub slower: f64,
}

impl Fitted {
    /// Takes what a problem's solution says.
    pub fn of(problem: &Problem<'_>, found: &Unknowns, cost: f64) -> Self {
        let matrix = problem.linearise(found).matrix;
        let half_log_det = half_log_determinant(&matrix);
        Self {
            found: found.clone(),
            covariance: inverse(&matrix),
            model: problem.model_of(&found.shared),
            log_evidence: -0.5 * cost + problem.priors.vessel.half_log_precision - half_log_det,
            cost,
            slower: problem.priors.slower(),
        }
    }

    /// The calibration; the newest gain counts where `gains`, those of the episodes, have changed.
    pub fn calibration(&self, gains: &[f64]) -> Calibration {
        let gain = noise::newest_gain(gains);
        let [log_c, exponent, tilt_slope] = [LOG_C, AREA_EXPONENT, TILT_SLOPE].map(|k| self.found.shared[k]);
        Calibration {
            volume_at_1_px2_ml: (log_c - gain).exp() as f32,
            area_exponent: exponent.clamp(0.2, 5.0) as f32,
            log_tilt_slope: tilt_slope.clamp(-1.0, 1.0) as f32,
            hold_above_px2: calibration::HOLD_ABOVE_PX2,
        }
    }
}

/// Half of the logarithm of a positive definite matrix's determinant; infinite for any other.
fn half_log_determinant(matrix: &DMatrix<f64>) -> f64 {
    let mut damped = matrix.clone();
    for k in 0..damped.nrows() {
        damped[(k, k)] += 1e-9;
    }
    damped.cholesky().map_or(f64::INFINITY, |c| c.l_dirty().diagonal().iter().map(|d| d.ln()).sum())
}

/// The inverse of a matrix J'J. Where it has none nothing is known: each logarithm may be off by a factor of e.
fn inverse(matrix: &DMatrix<f64>) -> DMatrix<f64> {
    let mut damped = matrix.clone();
    for k in 0..damped.nrows() {
        damped[(k, k)] += 1e-9;
    }
    damped.cholesky().map_or_else(|| DMatrix::identity(matrix.nrows(), matrix.ncols()), |c| c.inverse())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the choice between two vessels: a solution whose matrix is none of a sum of squares has no evidence and is in doubt, instead of the most
    /// evidence and next to no doubt.
    #[test]
    fn a_solution_that_cannot_be_doubted_has_no_evidence() {
        let good = DMatrix::from_diagonal_element(3, 3, 100.0);
        let failed = DMatrix::from_diagonal_element(3, 3, -1.0);
        assert!(half_log_determinant(&good).is_finite() && half_log_determinant(&failed) == f64::INFINITY);
        assert!(inverse(&failed)[(0, 0)] > 50.0 * inverse(&good)[(0, 0)]);
    }
}
