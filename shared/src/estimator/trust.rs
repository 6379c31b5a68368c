//! How far a measurement with a confidence may be off.
//!
//! It is pure and runs in the controller's loop: it does not allocate, panic or fail, also for what is not a number.

/// Confidence is the share of measurements that are within this share of the truth.
const WITHIN: f64 = 0.2;
/// From this confidence on, a measurement has no more noise than the fit of the episodes found. Chosen by hand: most frames of the episodes
/// have more.
const SURE: f32 = 0.95;
/// A lower confidence counts as this one. Chosen by hand: such a measurement is off by a factor of 25.
const LEAST: f64 = 0.05;
/// The constant of Winitzki's approximation of the error function, "A handy approximation for the error function and its inverse" (2008);
/// its error is below 0.4 %.
const WINITZKI: f64 = 0.147;

/// Standard deviation of the logarithm of an area with this confidence, beyond what every measurement has: that of the normal distribution
/// which lies within 20 % of the truth with this probability. What is not a number is sure: it comes from no camera.
pub(super) fn extra_log_sd(confidence: f32) -> f64 {
    if confidence.is_nan() || confidence >= SURE {
        return 0.0;
    }
    (log_sd(f64::from(confidence).max(LEAST)).powi(2) - log_sd(f64::from(SURE)).powi(2)).max(0.0).sqrt()
}

/// Standard deviation of a normal distribution that lies within [`WITHIN`] of its mean with this probability, between 0 and 1.
fn log_sd(probability: f64) -> f64 {
    let log = (1.0 - probability * probability).ln();
    let half = 2.0 / (std::f64::consts::PI * WINITZKI) + 0.5 * log;
    let inverse_erf = ((half * half - log / WINITZKI).sqrt() - half).sqrt();
    WITHIN / (std::f64::consts::SQRT_2 * inverse_erf)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the weight of a frame: it follows the normal distribution's quantiles, and what comes from no camera weighs in full.
    #[test]
    fn less_confidence_is_more_noise() {
        // Quantiles of the normal distribution: 0.6745 for a half, 1.2816 for 0.8.
        for (probability, quantile) in [(0.5, 0.6745), (0.8, 1.2816), (0.95, 1.96)] {
            assert!((log_sd(probability) * quantile / WITHIN - 1.0).abs() < 0.01, "{probability}");
        }
        assert_eq!([0.95, 1.0, f32::NAN, 7.0].map(extra_log_sd), [0.0; 4]);
        let falling = [-1.0, 0.2, 0.5, 0.8, 0.94].map(extra_log_sd);
        assert!(falling.windows(2).all(|w| w[0] > w[1]) && falling.iter().all(|v| v.is_finite()), "{falling:?}");
    }
}
