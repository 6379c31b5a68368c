//! How far a pour may be off the fit: the covariance of a pour's unknowns.
//!
//! Pure functions of the offline trainer, for any thread. They allocate and do not fail.

use nalgebra::DMatrix;
use shared::estimator::filter::{UNKNOWNS, UnknownsCovariance};
use shared::estimator::flow::FlowModel;
use shared::estimator::vessel::{CapacityCurve, KNOTS, Vessel, knot_deg};
use shared::weights::MOST_VARIANCE;

use super::fitted::Fitted;
use super::unknowns::{AREA_EXPONENT, DELAY, LOG_C, LOG_WEIR, SHARED, VESSEL, model_of};

/// Outflow at which the camera's gain is judged, ml a frame: that of controlled pours. From the prototype's simulations; the demos pour as fast.
const JUDGED_AT_ML: f64 = 0.7;
/// How much a pour's flow factor, gain and delay change from pour to pour. From the prototype; no other measurement is recorded.
const POUR_SDS: [f64; 3] = [0.1, 0.02, 0.3];
/// Index of the flow factor among a pour's unknowns; gain, delay and shape follow.
const FLOW_FACTOR: usize = 0;
/// Index of the gain.
const GAIN: usize = 1;
/// Index of the delay.
const EXTRA_DELAY: usize = 2;
/// Index of the shape at the first knot.
const SHAPE: usize = 3;
/// The largest variance that is written, as a share of what a reader takes: rounding must not lead beyond it.
const LARGEST: f64 = 0.999;
/// Step of the difference quotients.
const NUDGE: f64 = 1e-4;

/// The logarithm of the area that shows [`JUDGED_AT_ML`].
fn log_area_judged(fitted: &Fitted) -> f64 {
    (JUDGED_AT_ML.ln() - fitted.found.shared[LOG_C]) / fitted.found.shared[AREA_EXPONENT].max(0.2)
}

/// The same covariance with its most uncertain unknowns made a little more certain, so that a reader of weights takes it: what no episode has shown,
/// such as the shape of a vessel at tilts that were never reached, is known to no more than this anyway. The correlations stay.
fn within_bounds(covariance: DMatrix<f64>) -> DMatrix<f64> {
    let most = LARGEST * MOST_VARIANCE;
    let shrunk: Vec<f64> = covariance.diagonal().iter().map(|variance| (most / variance.max(most)).sqrt()).collect();
    DMatrix::from_fn(covariance.nrows(), covariance.ncols(), |i, j| covariance[(i, j)] * (shrunk[i] * shrunk[j]))
}

/// The covariance of a pour's unknowns, in the camera's ml. `doubt` is how many times larger than the fit's its covariance is.
pub fn unknowns(fitted: &Fitted, doubt: f64) -> UnknownsCovariance {
    let mut slopes = DMatrix::zeros(UNKNOWNS, SHARED);
    slopes[(FLOW_FACTOR, LOG_WEIR)] = 1.0;
    slopes[(GAIN, LOG_C)] = -1.0;
    slopes[(GAIN, AREA_EXPONENT)] = -log_area_judged(fitted);
    slopes[(EXTRA_DELAY, DELAY)] = 1.0;
    let log_lost = |model: &FlowModel| -> [f64; KNOTS] {
        let curve = CapacityCurve::new(&Vessel { log_shape: [0.0; KNOTS], ..model.vessel });
        std::array::from_fn(|k| curve.lost_ml_per_deg(knot_deg(k)).max(1e-9).ln())
    };
    let base = log_lost(&fitted.model);
    for k in 0..KNOTS {
        slopes[(SHAPE + k, k)] = 1.0;
    }
    for unknown in KNOTS..VESSEL {
        let mut shared = fitted.found.shared;
        shared[unknown] += NUDGE;
        for (k, moved) in log_lost(&model_of(&shared, fitted.model.vessel.even_share)).iter().enumerate() {
            slopes[(SHAPE + k, unknown)] = (moved - base[k]) / NUDGE;
        }
    }
    let shared = fitted.covariance.view((0, 0), (SHARED, SHARED));
    let mut covariance = &slopes * (shared * doubt) * slopes.transpose();
    for (k, sd) in POUR_SDS.into_iter().enumerate() {
        covariance[(k, k)] += sd * sd;
    }
    // In the camera's ml, capacity and flow carry its gain.
    let mut to_camera = DMatrix::identity(UNKNOWNS, UNKNOWNS);
    to_camera[(FLOW_FACTOR, GAIN)] = 1.0 - fitted.model.head_exponent;
    for k in 0..KNOTS {
        to_camera[(SHAPE + k, GAIN)] = 1.0;
    }
    let seen = within_bounds(&to_camera * covariance * to_camera.transpose());
    let mut unknowns = [[0.0; UNKNOWNS]; UNKNOWNS];
    for (i, row) in unknowns.iter_mut().enumerate() {
        for (j, value) in row.iter_mut().enumerate() {
            let more = if i == j { 1e-8 } else { 0.0 };
            *value = 0.5 * (seen[(i, j)] + seen[(j, i)]) + more;
        }
    }
    unknowns
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects an operator whose only light episode would give weights that no reader takes: variances that are too large are lowered to the
    /// bound with their correlations kept, and others stay as they are, to the bit.
    #[test]
    fn a_covariance_is_brought_within_bounds() {
        let usual = DMatrix::from_row_slice(2, 2, &[4.0, 1.5, 1.5, 9.0]);
        assert_eq!(within_bounds(usual.clone()), usual);
        let lowered = within_bounds(DMatrix::from_row_slice(2, 2, &[1756.0, 30.0, 30.0, 1.0]));
        assert!(lowered[(0, 0)] < MOST_VARIANCE && lowered[(0, 0)] > 0.99 * MOST_VARIANCE && lowered[(1, 1)] == 1.0, "{lowered}");
        let correlation = |m: &DMatrix<f64>| m[(0, 1)] / (m[(0, 0)] * m[(1, 1)]).sqrt();
        assert!((correlation(&lowered) - 30.0 / 1756.0f64.sqrt()).abs() < 1e-12);
    }
}
