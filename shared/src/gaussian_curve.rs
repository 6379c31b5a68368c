//! Eq. (1), the pre-programmed movement of an experimental episode: alpha(t) = lambda exp(-gamma (t - beta)^2), 0 <= t <= 2 beta.
//!
//! It is pure and used in the controller's loop, so it does not allocate, panic or fail. The letters are the paper's.

use serde::{Deserialize, Serialize};

use crate::limits::Limits;

/// Smallest beta, s, that [`Curve::fits`] accepts. Chosen by hand; no measurement is recorded.
const BETA_MIN_S: f32 = 0.5;
/// Largest beta, s, that [`Curve::fits`] accepts. Chosen by hand; no measurement is recorded.
const BETA_MAX_S: f32 = 60.0;
/// Largest alpha, degrees, that a curve may ask for in its first moment, because it starts from upright. Chosen by hand; no
/// measurement is recorded.
const FIRST_ALPHA_MAX_DEG: f32 = 1.0;

/// The parameters of eq. (1).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Curve {
    /// lambda: the largest angle, degrees.
    pub lambda_deg: f32,
    /// gamma: how narrow the curve is, 1/s^2.
    pub gamma_per_s2: f32,
    /// beta: the time of the largest angle, s.
    pub beta_s: f32,
}

/// Alpha at the first and last moment of a curve whose beta nobody gives, degrees. Chosen by hand: small enough for a start without a jump.
const END_DEG: f32 = 0.05;

impl Curve {
    /// The curve with the beta at which it starts and ends nearly upright.
    pub fn from_upright(lambda_deg: f32, gamma_per_s2: f32) -> Self {
        Self { lambda_deg, gamma_per_s2, beta_s: ((lambda_deg / END_DEG).ln() / gamma_per_s2).sqrt() }
    }

    /// alpha(t), degrees, `t_s` seconds after the start.
    pub fn alpha_deg(&self, t_s: f32) -> f32 {
        self.lambda_deg * (-self.gamma_per_s2 * (t_s - self.beta_s).powi(2)).exp()
    }

    /// How long the movement takes: 2 beta, s.
    pub fn duration_s(&self) -> f32 {
        2.0 * self.beta_s
    }

    /// Whether the curve's largest angle, rate and acceleration keep `limits` when it is commanded once every `period_ns`, so
    /// that it is run exactly as given.
    pub fn fits(&self, limits: &Limits, period_ns: u64) -> bool {
        let Self { lambda_deg, gamma_per_s2, beta_s } = *self;
        let finite = lambda_deg.is_finite() && gamma_per_s2.is_finite() && beta_s.is_finite();
        // alpha' is largest at t - beta = 1/sqrt(2 gamma), alpha'' at t = beta.
        finite
            && lambda_deg > 0.0
            && lambda_deg <= limits.alpha_max_deg
            && gamma_per_s2 > 0.0
            && (BETA_MIN_S..=BETA_MAX_S).contains(&beta_s)
            && lambda_deg * (2.0 * gamma_per_s2).sqrt() * (-0.5f32).exp() <= limits.rate_deg_s.min(limits.step_deg * 1e9 / period_ns as f32)
            && 2.0 * lambda_deg * gamma_per_s2 <= limits.acceleration_deg_s2
            && self.alpha_deg(0.0) <= FIRST_ALPHA_MAX_DEG
    }
}
