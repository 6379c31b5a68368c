//! Area to ml from weights alone: `w_E = c sum area^q`, the paper's normalised contribution volumes with an exponent.
//!
//! Offline, pure, allocates. c by weighted least squares with sigma = 0.7 + 0.03 w; q on a grid with a prior of 1.15 +- 0.4;
//! below four episodes the exponent cannot be told and stays 1.

use shared::estimate::{Calibration, Hold};

use crate::data::TrainingEpisode;

/// A single zero right after an area above this is a dropout, px^2.
pub const HOLD_ABOVE_PX2: f32 = 60.0;
/// Fewer episodes than this leave q = 1.
pub const EXPONENT_NEEDS: usize = 4;

/// Sum of area^q over an episode with the dropout hold, as at run time.
pub fn area_sum(episode: &TrainingEpisode, q: f64) -> f64 {
    let mut hold = Hold::default();
    let mut sum = 0.0;
    for area in &episode.area_px2 {
        let held = hold.step(Some(*area as f32).filter(|a| !a.is_nan()), HOLD_ABOVE_PX2);
        if held > 0.0 {
            sum += f64::from(held).powf(q);
        }
    }
    sum
}

/// Fits c and q, or c alone if `exponent` is given.
pub fn fit(episodes: &[TrainingEpisode], exponent: Option<f64>) -> Calibration {
    let fit_c = |q: f64| -> (f64, f64) {
        let (mut num, mut den) = (0.0, 0.0);
        let sums: Vec<f64> = episodes.iter().map(|e| area_sum(e, q)).collect();
        for (e, sum) in episodes.iter().zip(&sums) {
            let weight = 1.0 / (0.7 + 0.03 * e.weight_g).powi(2);
            num += weight * sum * e.weight_g;
            den += weight * sum * sum;
        }
        let c = if den > 0.0 { num / den } else { 1e-6 };
        let misfit: f64 = episodes.iter().zip(&sums).map(|(e, s)| ((c * s - e.weight_g) / (0.7 + 0.03 * e.weight_g)).powi(2)).sum();
        (c, misfit + ((q - 1.15) / 0.4).powi(2))
    };
    let q = exponent.unwrap_or_else(|| {
        if episodes.len() < EXPONENT_NEEDS {
            return 1.0;
        }
        let grid = (0..=90).map(|k| 0.8 + 0.01 * f64::from(k));
        grid.min_by(|a, b| fit_c(*a).1.total_cmp(&fit_c(*b).1)).unwrap_or(1.0)
    });
    Calibration { c: fit_c(q).0.max(1e-12) as f32, q: q as f32, tilt: 0.0, hold_above_px2: HOLD_ABOVE_PX2 }
}
