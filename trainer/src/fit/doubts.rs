//! How far a pour may be off the fit: the covariance of a pour's unknowns.
//!
//! Pure functions of the offline trainer, for any thread. They allocate and do not fail.

use nalgebra::DMatrix;
use shared::estimator::filter::{UNKNOWNS, UnknownsCovariance};
use shared::estimator::flow::FlowModel;
use shared::estimator::vessel::{CapacityCurve, KNOTS, Vessel, knot_deg};

use super::fitted::Fitted;
use super::unknowns::{AREA_EXPONENT, DELAY, LOG_C, LOG_WEIR, SHARED, VESSEL, model_of};

/// Outflow at which the camera's gain is judged, ml a frame at 30 frames a second: that of controlled pours. From the prototype's simulations; the demos pour as fast.
const JUDGED_AT_ML: f64 = 0.7;
/// How much the flow factor changes from pour to pour (log). From the prototype; no other measurement is recorded.
const FLOW_FACTOR_SD: f64 = 0.1;
/// How much the delay changes from pour to pour, frames at 30 a second. From the prototype; no other measurement is recorded.
const DELAY_SD_FRAMES: f64 = 0.3;
/// How much the gain may change from pour to pour (log). From the prototype; no other measurement is recorded.
const GAIN_SD: f64 = 0.02;
/// The same for a straight vessel that ten episodes tell well, and what is then left of its covariance, which the fit's tempered noise makes too large.
/// Tuned on rigs 100 to 107; docs/LEARNING.md has what they gain. Of five episodes only, a vessel is told so badly that its error passes for a gain.
const WELL_TOLD: (f64, f64) = (0.03, 0.7);
/// Up to so many episodes tell a straight vessel badly, and twice as many tell it well. Tuned with [`WELL_TOLD`].
const FEW: f64 = 5.0;
/// Index of the flow factor among a pour's unknowns; gain, delay and shape follow.
const FLOW_FACTOR: usize = 0;
/// Index of the gain.
const GAIN: usize = 1;
/// Index of the delay.
const EXTRA_DELAY: usize = 2;
/// Index of the shape at the first knot.
const SHAPE: usize = 3;
/// Largest standard deviation of an unknown: the filter believes no logarithm that is larger.
const SD_MAX: f64 = 3.0;
/// Step of the difference quotients.
const NUDGE: f64 = 1e-4;

/// The logarithm of the area that shows [`JUDGED_AT_ML`].
fn log_area_judged(fitted: &Fitted) -> f64 {
    ((JUDGED_AT_ML / fitted.slower).ln() - fitted.found.shared[LOG_C]) / fitted.found.shared[AREA_EXPONENT].max(0.2)
}

/// How far an explanation is doubted.
#[derive(Debug, Clone, Copy)]
pub struct Doubt {
    /// How many times larger than the fit's its covariance is.
    scale: f64,
    /// How much the gain may change from pour to pour (log).
    gain_sd: f64,
}

impl Doubt {
    /// That of the vessel of any shape.
    pub fn wide() -> Self {
        Self { scale: 1.0, gain_sd: GAIN_SD }
    }

    /// That of the straight vessel, whose frames are met `misfit` times as badly as their noise explains, after so many episodes whose weights show that
    /// the gain changes by `seen_gain_sd` (log).
    pub fn tight(misfit: f64, episodes: usize, seen_gain_sd: f64) -> Self {
        let told = (episodes as f64 / FEW - 1.0).clamp(0.0, 1.0);
        let (gain_sd, scale) = WELL_TOLD;
        let expected_sd = GAIN_SD + told * (gain_sd - GAIN_SD);
        Self { scale: misfit * (1.0 + told * (scale - 1.0)), gain_sd: expected_sd.max(seen_gain_sd) }
    }
}

/// The covariance of a pour's unknowns, in the camera's ml.
pub fn unknowns(fitted: &Fitted, doubt: Doubt) -> UnknownsCovariance {
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
    let mut covariance = &slopes * (shared * doubt.scale) * slopes.transpose();
    for (k, sd) in [(FLOW_FACTOR, FLOW_FACTOR_SD), (GAIN, doubt.gain_sd), (EXTRA_DELAY, DELAY_SD_FRAMES * fitted.slower)] {
        covariance[(k, k)] += sd * sd;
    }
    // In the camera's ml, capacity and flow carry its gain.
    let mut to_camera = DMatrix::identity(UNKNOWNS, UNKNOWNS);
    to_camera[(FLOW_FACTOR, GAIN)] = 1.0 - fitted.model.head_exponent;
    for k in 0..KNOTS {
        to_camera[(SHAPE + k, GAIN)] = 1.0;
    }
    let seen = &to_camera * covariance * to_camera.transpose();
    // What the episodes say nothing about at all is cut to what a filter can use, and a weight file holds.
    let cut: Vec<f64> = (0..UNKNOWNS).map(|k| (SD_MAX / seen[(k, k)].max(1e-12).sqrt()).min(1.0)).collect();
    let mut unknowns = [[0.0; UNKNOWNS]; UNKNOWNS];
    for (i, row) in unknowns.iter_mut().enumerate() {
        for (j, value) in row.iter_mut().enumerate() {
            let more = if i == j { 1e-8 } else { 0.0 };
            // The brackets keep the matrix symmetric to the last bit, as a weight file must be.
            *value = 0.5 * (seen[(i, j)] + seen[(j, i)]) * (cut[i] * cut[j]) + more;
        }
    }
    unknowns
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects first lessons from a gain that is their vessel's error, and many episodes from less freedom than they bear.
    #[test]
    fn many_episodes_leave_the_gain_more_freedom() {
        let (few, many, more) = (Doubt::tight(2.0, 5, 0.01), Doubt::tight(2.0, 10, 0.01), Doubt::tight(2.0, 40, 0.01));
        assert_eq!((few.scale, few.gain_sd), (2.0, Doubt::wide().gain_sd));
        assert_eq!(Doubt::tight(2.0, 5, 0.06).gain_sd, 0.06, "what the weights show counts where it is more");
        assert!(many.scale < few.scale && many.gain_sd > few.gain_sd);
        assert_eq!((many.scale, many.gain_sd), (more.scale, more.gain_sd));
    }
}
