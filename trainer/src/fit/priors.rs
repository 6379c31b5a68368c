//! What is known of vessels, flow and cameras before any episode, as residuals of the fit.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail. There are two ideas of a vessel ([`VesselPrior`]): one
//! of any shape, whose capacity changes smoothly over some ten degrees and by a factor of three, and a straight-walled one. The flow follows a
//! weir, whose coefficient hardly changes with the angle.

use nalgebra::{DMatrix, DVector};
use shared::estimator::vessel::{KNOTS, knot_deg};

use super::unknowns::{
    AREA_EXPONENT, DELAY, FILM_SHARE, HEAD_EXPONENT, LAG, LOG_C, LOG_RADIUS, LOG_SLENDERNESS, LOG_WEIR, SHARED, TAPER, TILT_SLOPE,
    WEIR_CURVATURE, WEIR_SLOPE,
};

/// Radius of a vessel that a gripper holds, mm.
const RADIUS_MM: f64 = 37.0;
/// Height of such a vessel over its radius.
const SLENDERNESS: f64 = 3.0;
/// Share of the capacity that a vessel of any shape spreads evenly over all tilts before its shape is known. From the prototype; no other
/// measurement is recorded.
const WIDE_EVEN_SHARE: f64 = 0.3;

/// What is known of a vessel's shape before any episode.
#[derive(Debug, Clone)]
pub struct VesselPrior {
    /// Share of the capacity that is spread evenly over all tilts.
    pub even_share: f64,
    /// What turns the log shape into independent residuals: the inverse of its covariance's lower Cholesky factor.
    whitening: DMatrix<f64>,
    /// Half of the logarithm of the determinant of the inverse covariance.
    pub half_log_precision: f64,
}

impl VesselPrior {
    fn new(even_share: f64, covariance: impl Fn(f64, f64) -> f64) -> Self {
        let matrix = DMatrix::from_fn(KNOTS, KNOTS, |i, j| covariance(knot_deg(i), knot_deg(j)) + if i == j { 1e-4 } else { 0.0 });
        let root = matrix.cholesky().map_or_else(|| DMatrix::identity(KNOTS, KNOTS), |c| c.l());
        let half_log_precision = -root.diagonal().iter().map(|d| d.ln()).sum::<f64>();
        let whitening = root.solve_lower_triangular(&DMatrix::identity(KNOTS, KNOTS)).unwrap_or_else(|| DMatrix::identity(KNOTS, KNOTS));
        Self { even_share, whitening, half_log_precision }
    }

    /// A vessel of any shape. From the prototype, which took it from no vessel of the evaluation; no other measurement is recorded.
    pub fn wide() -> Self {
        Self::new(WIDE_EVEN_SHARE, |a, b| 1.3 * 1.3 * (-((a - b) / 8.0).powi(2) / 2.0).exp() + 0.7 * 0.7)
    }

    /// A vessel with straight walls; what it loses beyond the horizontal is hardly known. From the prototype; no other measurement is recorded.
    pub fn tight() -> Self {
        let sd = |a: f64| 0.06 + 0.6 / (1.0 + (-(a - 90.0) / 3.0).exp());
        Self::new(0.0, |a, b| sd(a) * sd(b) * (-((a - b) / 15.0).powi(2) / 2.0).exp())
    }
}

/// How an unknown is held near its expected value.
#[derive(Clone, Copy)]
enum Price {
    /// The price grows with the square of the distance.
    Square,
    /// The price grows little beyond a few standard deviations (Cauchy).
    Cauchy,
}

/// An unknown's expected value and standard deviation.
struct Prior {
    unknown: usize,
    expected: f64,
    sd: f64,
    price: Price,
}

/// What is known of the unknowns but the vessel's shape.
#[derive(Debug, Clone)]
pub struct Priors {
    /// The vessel.
    pub vessel: VesselPrior,
    /// Whether the episodes show the measured tilt, so that only the picture's own delay is left.
    pub measured: bool,
    /// Whether the frames have next to no noise, so that a flow that is no weir's can be told.
    pub clean: bool,
    /// Frames a second of the episodes.
    pub rate_hz: f64,
}

impl Priors {
    /// Frames of the episodes for one at 30 frames a second: what is known in seconds is so many times as many frames, and a flow a frame so many
    /// times less.
    pub fn slower(&self) -> f64 {
        self.rate_hz / 30.0
    }

    /// Radius, slenderness and taper are those of vessels that a gripper holds. The head's exponent is a weir's. The others began as those of
    /// the prototype. Where the frames have no noise, a flow of another kind is found, and its price must not grow without bound.
    fn table(&self) -> [Prior; 11] {
        use Price::{Cauchy, Square};
        let flow = if self.clean { Cauchy } else { Square };
        let (lag, delay) = if self.measured { ((0.3, 0.3), (1.0, 1.0)) } else { ((2.0, 0.8), (2.0, 1.2)) };
        let [lag, delay] = [lag, delay].map(|(expected, sd)| (expected * self.slower(), sd * self.slower()));
        [
            (LOG_RADIUS, RADIUS_MM.ln(), 0.25, Square),
            (LOG_SLENDERNESS, SLENDERNESS.ln(), 0.3, Square),
            (TAPER, 1.0, 0.15, Square),
            (TILT_SLOPE, 0.0, 0.03, Square),
            (HEAD_EXPONENT, 1.5, 0.07, flow),
            (LOG_WEIR, -3.2 - self.slower().ln(), 1.5, Square),
            (WEIR_SLOPE, 0.0, 0.12, flow),
            (WEIR_CURVATURE, 0.0, 0.1, flow),
            (LAG, lag.0, lag.1, Square),
            (DELAY, delay.0, delay.1, Square),
            (FILM_SHARE, 0.1, 0.1, Square),
        ]
        .map(|(unknown, expected, sd, price)| Prior { unknown, expected, sd, price })
    }

    /// The priors' residuals, in standard deviations.
    pub fn residuals(&self, shared: &[f64; SHARED], held: Option<HeldCalibration>) -> Vec<f64> {
        let shape = DVector::from_column_slice(&shared[..KNOTS]);
        let mut r: Vec<f64> = (&self.vessel.whitening * shape).iter().copied().collect();
        for Prior { unknown, expected, sd, price } in self.table() {
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
}

/// The exponent that is expected of a camera. From the prototype; no other measurement is recorded.
const EXPONENT_EXPECTED: f64 = 1.18;
/// Standard deviation of the exponent around it. From the prototype; no other measurement is recorded.
const AREA_EXPONENT_SD: f64 = 0.15;

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
