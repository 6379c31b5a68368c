//! The ranges in which the numbers of a weight file's estimate must be, so that none of them can lead the loop astray.
//!
//! Pure functions for ordinary threads; they allocate only the line that names a wrong value, which is their error.

use crate::estimator::Calibration;
use crate::estimator::flow::{DELAY_MAX_FRAMES, FlowModel, Lateness, WayBack};
use crate::estimator::fused::{Explanation, FusedModel};
use crate::estimator::vessel::Vessel;
use crate::weights::way_back::{BACK_CHANGE_DEG, BACK_RATE_DEG};

/// Refuses a fused estimate with a value outside its range, and names it.
pub fn check_fused(model: &FusedModel, back: WayBack) -> Result<(), String> {
    within(&[
        ("weight of the straight vessel", model.tight_share, 0.0, 1.0),
        ("variance of log c", model.camera[0][0], 0.0, 25.0),
        ("variance of q", model.camera[1][1], 0.0, 25.0),
        ("sd of a pour's gain", model.gain_sd, 0.0, 5.0),
        ("largest area", model.bounds.most_px2, 1.0, 1e12),
        ("tilt by which flow must be seen", model.bounds.dry_deg, 1.0, 200.0),
        ("rate of the way back", back.rate_deg, BACK_RATE_DEG.0, BACK_RATE_DEG.1),
        ("change of that rate in a frame", back.change_deg, BACK_CHANGE_DEG.0, BACK_CHANGE_DEG.1),
    ])?;
    check_covariance("log c and q", &model.camera)?;
    model.explanations.iter().try_for_each(check_explanation)
}

/// Refuses the first of the named values that is outside its range.
fn within(ranges: &[(&str, f64, f64, f64)]) -> Result<(), String> {
    match ranges.iter().find(|(_, value, low, high)| !(low..=high).contains(&value)) {
        Some((name, value, low, high)) => Err(format!("estimator: {name} is {value}, but must be {low} to {high}")),
        None => Ok(()),
    }
}

/// Refuses a calibration that gives no volumes.
pub fn check_calibration(calibration: &Calibration) -> Result<(), String> {
    let Calibration { volume_at_1_px2_ml, area_exponent, log_tilt_slope, hold_above_px2 } = *calibration;
    if !(volume_at_1_px2_ml.is_finite() && volume_at_1_px2_ml > 0.0) {
        return Err(format!("calibration c is {volume_at_1_px2_ml}, not a positive number"));
    }
    if !(0.1..=10.0).contains(&area_exponent) {
        return Err(format!("calibration exponent {area_exponent} is outside 0.1 to 10"));
    }
    if !(-1.0..=1.0).contains(&log_tilt_slope) {
        return Err(format!("calibration's change with the tilt {log_tilt_slope} is outside -1 to 1"));
    }
    if hold_above_px2.is_nan() || hold_above_px2 < 0.0 {
        return Err(format!("dropout hold above {hold_above_px2} px^2 is not a number >= 0"));
    }
    Ok(())
}

/// Refuses an explanation with a value outside its range.
fn check_explanation(explanation: &Explanation) -> Result<(), String> {
    check_calibration(&explanation.calibration)?;
    let FlowModel {
        vessel: Vessel { radius_mm, height_mm, taper, even_share, log_shape },
        log_weir_coefficient,
        head_exponent,
        log_weir_slope,
        log_weir_curvature,
        lag_frames,
        delay_frames,
        measured,
        film_share,
        noise,
    } = explanation.model;
    let measured = measured.unwrap_or(Lateness { lag_frames, delay_frames });
    within(&[
        ("radius", radius_mm, 1.0, 1000.0),
        ("height", height_mm, 1.0, 5000.0),
        ("taper", taper, 0.05, 20.0),
        ("even share", even_share, 0.0, 1.0),
        ("weir coefficient (log)", log_weir_coefficient, -20.0, 20.0),
        ("head exponent", head_exponent, 0.2, 5.0),
        ("slope of the weir coefficient (log)", log_weir_slope, -20.0, 20.0),
        ("curvature of the weir coefficient (log)", log_weir_curvature, -20.0, 20.0),
        ("lag", lag_frames, 0.0, 60.0),
        ("delay", delay_frames, 0.0, DELAY_MAX_FRAMES),
        ("lag behind the measured tilt", measured.lag_frames, 0.0, 60.0),
        ("delay behind the measured tilt", measured.delay_frames, 0.0, DELAY_MAX_FRAMES),
        ("film share", film_share, 0.0, 0.95),
        ("sd of a frame's volume (log)", noise.log_frame_volume_sd, 1e-4, 5.0),
        ("smallest outflow", noise.least_visible_ml, 0.0, 10.0),
    ])?;
    for shape in log_shape {
        within(&[("shape of the vessel (log)", shape, -10.0, 10.0)])?;
    }
    for (k, row) in explanation.unknowns.iter().enumerate() {
        within(&[("variance of an unknown", row[k], 1e-12, 100.0)])?;
    }
    check_covariance("the unknowns", &explanation.unknowns)
}

/// How much less than nothing a mixture of correlated values may vary by, as a share: the rounding of f64 makes far less. Chosen by hand.
const ROUNDING: f64 = 1e-6;

/// Refuses what is no covariance of `what`: one that is not symmetric, or by which some mixture of them would vary by less than nothing. A
/// deviation that follows from it would be 0 or not a number, and a doubtful volume would look certain.
fn check_covariance<const N: usize>(what: &str, covariance: &[[f64; N]; N]) -> Result<(), String> {
    let none = || Err(format!("estimator: the covariance of {what} is none: some mixture of them would vary by less than nothing"));
    // Cholesky's factor of the correlations exists if all is well.
    let mut factor = [[0.0; N]; N];
    for k in 0..N {
        for j in 0..=k {
            let value = covariance[k][j];
            let correlation = match value {
                // What does not vary at all is sure, and goes with nothing.
                0.0 => f64::from(u8::from(j == k)),
                _ => value / (covariance[k][k].sqrt() * covariance[j][j].sqrt()),
            };
            let rest = correlation - (0..j).map(|i| factor[k][i] * factor[j][i]).sum::<f64>();
            if value != covariance[j][k] || !rest.is_finite() || (j == k && rest + ROUNDING <= 0.0) {
                return none();
            }
            factor[k][j] = if j == k { (rest + ROUNDING).sqrt() } else { rest / factor[j][j] };
        }
    }
    Ok(())
}
