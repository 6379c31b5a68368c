//! The unknowns of the fit as numbers in a row, and the flow model that they stand for.
//!
//! Pure functions of the offline trainer, for any thread. Only [`Unknowns`] allocates, and nothing fails.

use shared::estimator::flow::{DELAY_MAX_FRAMES, FlowModel, FlowNoise};
use shared::estimator::vessel::{KNOTS, Vessel};

/// Number of unknowns that all episodes share. The first [`KNOTS`] of them are the vessel's log shape.
pub const SHARED: usize = KNOTS + 13;
/// Index of the logarithm of the radius in mm.
pub const LOG_RADIUS: usize = KNOTS;
/// Index of the logarithm of the height over the radius.
pub const LOG_SLENDERNESS: usize = KNOTS + 1;
/// Index of the taper.
pub const TAPER: usize = KNOTS + 2;
/// Index of the weir coefficient's logarithm.
pub const LOG_WEIR: usize = KNOTS + 3;
/// Index of the head's exponent.
pub const HEAD_EXPONENT: usize = KNOTS + 4;
/// Index of the weir coefficient's slope.
pub const WEIR_SLOPE: usize = KNOTS + 5;
/// Index of the weir coefficient's curvature.
pub const WEIR_CURVATURE: usize = KNOTS + 6;
/// Index of the lag.
pub const LAG: usize = KNOTS + 7;
/// Index of the delay.
pub const DELAY: usize = KNOTS + 8;
/// Index of the film's share.
pub const FILM_SHARE: usize = KNOTS + 9;
/// Index of log c, the logarithm of the calibration's factor.
pub const LOG_C: usize = KNOTS + 10;
/// Index of q, the calibration's exponent.
pub const AREA_EXPONENT: usize = KNOTS + 11;
/// Index of the calibration's change with the tilt.
pub const TILT_SLOPE: usize = KNOTS + 12;
/// Number of shared unknowns that make the vessel; they are the first ones.
pub const VESSEL: usize = KNOTS + 3;

/// Number of unknowns that each episode has of its own: the onset, the flow factor's logarithm (viscosity), the logarithm of the
/// camera's gain, and the delay above the model's.
pub const OWN: usize = 4;
/// Index of the angle at which flow starts, degrees.
pub const ONSET: usize = 0;
/// Index of the logarithm of the camera's gain.
pub const CAMERA_GAIN: usize = 2;
/// Index of the delay above the model's, frames.
pub const EXTRA_DELAY: usize = 3;

/// A point in the space of all unknowns.
#[derive(Clone)]
pub struct Unknowns {
    /// Those that all episodes share.
    pub shared: [f64; SHARED],
    /// Those of each episode.
    pub own: Vec<[f64; OWN]>,
}

impl Unknowns {
    /// One of the episodes' own unknowns, of all episodes.
    pub fn of_episodes(&self, index: usize) -> Vec<f64> {
        self.own.iter().map(|own| own[index]).collect()
    }
}

/// Largest deviation of a vessel's shape (log), so that no step of the fit gives an absurd one. Chosen by hand; no measurement is recorded.
const LOG_SHAPE_MAX: f64 = 4.0;

/// Uncertainties that stand in until the fit knows its own.
const NOISE_UNKNOWN: FlowNoise = FlowNoise { log_frame_volume_sd: 0.1, least_visible_ml: 0.0 };

/// The flow model that the shared unknowns stand for, within the bounds of what makes sense, with this share of the vessel's capacity spread
/// evenly over all tilts.
pub fn model_of(shared: &[f64], even_share: f64) -> FlowModel {
    let mut log_shape = [0.0; KNOTS];
    log_shape.copy_from_slice(&shared[..KNOTS]);
    let radius_mm = shared[LOG_RADIUS].clamp(1.0, 6.0).exp();
    FlowModel {
        vessel: Vessel {
            radius_mm,
            height_mm: radius_mm * shared[LOG_SLENDERNESS].clamp(-1.0, 3.0).exp(),
            taper: shared[TAPER].clamp(0.2, 3.0),
            even_share,
            log_shape: log_shape.map(|s: f64| s.clamp(-LOG_SHAPE_MAX, LOG_SHAPE_MAX)),
        },
        log_weir_coefficient: shared[LOG_WEIR],
        head_exponent: shared[HEAD_EXPONENT].clamp(0.3, 4.0),
        log_weir_slope: shared[WEIR_SLOPE],
        log_weir_curvature: shared[WEIR_CURVATURE],
        lag_frames: shared[LAG].clamp(0.0, 30.0),
        delay_frames: shared[DELAY].clamp(0.0, DELAY_MAX_FRAMES),
        measured: None,
        film_share: shared[FILM_SHARE].clamp(0.0, 0.6),
        noise: NOISE_UNKNOWN,
    }
}

/// `model` with its shared unknowns moved by `by`, in the order in which the fit's covariance counts them.
pub fn moved(model: &FlowModel, by: &[f64]) -> FlowModel {
    let mut shared = [0.0; SHARED];
    let vessel = &model.vessel;
    shared[..KNOTS].copy_from_slice(&vessel.log_shape);
    shared[LOG_RADIUS] = vessel.radius_mm.ln();
    shared[LOG_SLENDERNESS] = (vessel.height_mm / vessel.radius_mm).ln();
    shared[TAPER] = vessel.taper;
    shared[LOG_WEIR] = model.log_weir_coefficient;
    shared[HEAD_EXPONENT] = model.head_exponent;
    shared[WEIR_SLOPE] = model.log_weir_slope;
    shared[WEIR_CURVATURE] = model.log_weir_curvature;
    shared[LAG] = model.lag_frames;
    shared[DELAY] = model.delay_frames;
    shared[FILM_SHARE] = model.film_share;
    for (value, b) in shared.iter_mut().zip(by) {
        *value += b;
    }
    FlowModel { noise: model.noise, measured: model.measured, ..model_of(&shared, vessel.even_share) }
}
