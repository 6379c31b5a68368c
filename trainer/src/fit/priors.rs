//! What is known of vessels, flow and cameras before any episode, as residuals of the fit.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail. The vessels are those that a gripper holds. The
//! price of another shape grows ever more slowly the further it deviates (Cauchy), so that bottles and jugs are not bent into cups. The
//! flow follows a weir, whose coefficient hardly changes with the angle.

use shared::estimator::vessel::{KNOTS, KNOTS_DEG};

use super::servo::Servo;
use super::unknowns::{
    AREA_EXPONENT, DELAY, EVEN_SHARE, FILM_SHARE, HEAD_EXPONENT, LAG, LOG_C, LOG_RADIUS, LOG_SLENDERNESS, LOG_WEIR, SHARED, TAPER,
    TILT_SLOPE, WEIR_CURVATURE, WEIR_SLOPE,
};
use crate::calibration::EXPONENT_EXPECTED;

/// Standard deviation of a vessel's walls from straight ones, at each knot (log). Tuned on rigs 100 to 123, see docs/LEARNING.md.
const LOG_SHAPE_SD: [f64; KNOTS] = [0.06, 0.06, 0.06, 0.06, 0.06, 0.08, 0.18, 0.6, 0.6];
/// Standard deviation of the change of the log shape's slope from knot to knot, for 10 degrees. From the prototype; no other measurement is
/// recorded.
const LOG_SHAPE_BEND_SD: f64 = 0.15;
/// Radius of a vessel that a gripper holds, mm.
const RADIUS_MM: f64 = 37.0;
/// Height of such a vessel over its radius.
const SLENDERNESS: f64 = 3.0;

/// How an unknown is held near its expected value.
#[derive(Clone, Copy)]
enum Price {
    /// The price grows with the square of the distance.
    Square,
    /// The price grows little beyond a few standard deviations (Cauchy).
    Cauchy,
}

/// Standard deviation of the model's lag around the joint's own, which was measured, frames: what the liquid adds. Chosen by hand; no
/// measurement is recorded.
const SERVO_LAG_SD_FRAMES: f64 = 0.3;
/// From the joint's movement to the stream's area, frames: what falls past the region of the picture was over the lip a little earlier.
/// Chosen by hand; no measurement is recorded.
const PICTURE_FRAMES: f64 = 0.5;
/// Standard deviation of [`PICTURE_FRAMES`]. Chosen by hand; no measurement is recorded.
const PICTURE_SD_FRAMES: f64 = 0.5;

/// An unknown's expected value and standard deviation.
struct Prior {
    unknown: usize,
    expected: f64,
    sd: f64,
    price: Price,
}

/// The priors of all unknowns but the log shape and the calibration's exponent.
///
/// Radius, slenderness and taper are those of vessels that a gripper holds. The exponent is a weir's. The others began as those of
/// the prototype and were tuned on rigs 100 to 123, see docs/LEARNING.md. Lag and delay are the joint's own where they were measured.
fn priors(servo: Option<Servo>) -> [Prior; 12] {
    use Price::{Cauchy, Square};
    let (lag, lag_sd, delay, delay_sd) = match servo {
        Some(servo) => (servo.lag_frames, SERVO_LAG_SD_FRAMES, servo.delay_frames + PICTURE_FRAMES, PICTURE_SD_FRAMES),
        None => (2.0, 0.8, 2.0, 1.2),
    };
    [
        (LOG_RADIUS, RADIUS_MM.ln(), 0.25, Square),
        (LOG_SLENDERNESS, SLENDERNESS.ln(), 0.3, Square),
        (TAPER, 1.0, 0.15, Square),
        (EVEN_SHARE, 0.0, 0.05, Cauchy),
        (TILT_SLOPE, 0.0, 0.03, Square),
        (HEAD_EXPONENT, 1.5, 0.1, Cauchy),
        (LOG_WEIR, -3.2, 1.5, Square),
        (WEIR_SLOPE, 0.0, 0.15, Cauchy),
        (WEIR_CURVATURE, 0.0, 0.1, Cauchy),
        (LAG, lag, lag_sd, Square),
        (DELAY, delay, delay_sd, Square),
        (FILM_SHARE, 0.1, 0.1, Square),
    ]
    .map(|(unknown, expected, sd, price)| Prior { unknown, expected, sd, price })
}

/// Standard deviation of the exponent around what is expected of a camera. Tuned on rigs 100 to 123, see docs/LEARNING.md.
const AREA_EXPONENT_SD: f64 = 0.2;

/// A calibration that a stage of the fit holds on to.
#[derive(Debug, Clone, Copy)]
pub struct HeldCalibration {
    /// log c.
    pub log_c: f64,
    /// q.
    pub exponent: f64,
    /// Its change with the tilt.
    pub tilt_slope: f64,
}

/// Standard deviation of each value around a held calibration. From the prototype; no other measurement is recorded.
const HELD_SD: f64 = 0.002;

/// A residual whose price grows ever more slowly the larger it is (Cauchy).
fn cauchy(r: f64) -> f64 {
    r.signum() * 2.0 * (1.0 + r * r / 4.0).ln().sqrt()
}

/// The priors' residuals, in standard deviations.
pub fn residuals(shared: &[f64; SHARED], held: Option<HeldCalibration>, servo: Option<Servo>) -> Vec<f64> {
    let mut r = Vec::with_capacity(40);
    for k in 0..KNOTS {
        r.push(cauchy(shared[k] / LOG_SHAPE_SD[k]));
    }
    // The slope of the log shape, for 10 degrees, changes little from knot to knot.
    let slope = |k: usize| (shared[k + 1] - shared[k]) / (KNOTS_DEG[k + 1] - KNOTS_DEG[k]) * 10.0;
    for k in 1..KNOTS - 2 {
        r.push(cauchy((slope(k) - slope(k - 1)) / LOG_SHAPE_BEND_SD));
    }
    for Prior { unknown, expected, sd, price } in priors(servo) {
        let sds = (shared[unknown] - expected) / sd;
        r.push(match price {
            Price::Square => sds,
            Price::Cauchy => cauchy(sds),
        });
    }
    match held {
        None => r.push((shared[AREA_EXPONENT] - EXPONENT_EXPECTED) / AREA_EXPONENT_SD),
        Some(HeldCalibration { log_c, exponent, tilt_slope }) => {
            r.push((shared[LOG_C] - log_c) / HELD_SD);
            r.push((shared[AREA_EXPONENT] - exponent) / HELD_SD);
            r.push((shared[TILT_SLOPE] - tilt_slope) / HELD_SD);
        }
    }
    r
}
