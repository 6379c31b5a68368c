//! Turns areas into ml, and estimates the volume poured so far.
//!
//! All of it is pure and runs in the controller's loop: its size is fixed, and it does not allocate or panic. An area that is not a finite
//! number >= 0 counts as a lost frame.
//!
//! | file | what it holds |
//! |---|---|
//! | [`vessel`] | the shape of a container |
//! | [`flow`] | the flow model: from commanded angles to outflow |
//! | `tilt` | the tilt that a picture shows |
//! | `trust` | how far a measurement with a confidence may be off |
//! | [`verdict`] | whether what is seen can be |
//! | [`filter`] | an extended Kalman filter on the flow model |
//! | `camera_sum` | the camera's own sum, and how far it may be off |
//! | [`whiteness`] | whether a filter's innovations are independent, as those of a right model are |
//! | [`fused`] | two filters, and the estimate that they make together with the camera |

use serde::{Deserialize, Serialize};

mod camera_sum;
pub mod filter;
pub mod flow;
pub mod fused;
mod tilt;
mod trust;
pub mod verdict;
pub mod vessel;
pub mod whiteness;

/// Turns V_e in px^2 into ml a frame: `v = c area^q exp(tilt z)`, with z of [`tilt_z`]; and says when the dropout hold bridges a zero.
///
/// The picture of the same flow changes a little with the tilt, because the wall at the lip rotates into the stream.
///
/// Section 3.3.1's normalised contribution volumes are the case q = 1, tilt = 0; then c is `w_E / sum V_e`, and all episodes share
/// it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// c: the outflow that an area of 1 px^2 shows, ml a frame, > 0.
    pub volume_at_1_px2_ml: f32,
    /// q: the exponent of the area, 0.1 to 10.
    pub area_exponent: f32,
    /// tilt: the change of log v for 30 degrees more tilt, -1 to 1.
    pub log_tilt_slope: f32,
    /// A single area of 0 right after an area above this is replaced by that area, px^2; if this is infinite, none is replaced.
    pub hold_above_px2: f32,
}

impl Calibration {
    /// Outflow that a frame with `area_px2` shows, taken at the commanded tilt `alpha_deg`, ml.
    pub fn volume_ml(&self, area_px2: f32, alpha_deg: f32) -> f32 {
        if area_px2 > 0.0 {
            self.volume_at_1_px2_ml * area_px2.powf(self.area_exponent) * (self.log_tilt_slope * tilt_z(f64::from(alpha_deg)) as f32).exp()
        } else {
            0.0
        }
    }

    /// Area that shows an outflow at the commanded tilt `alpha_deg`, px^2: the inverse of [`Calibration::volume_ml`]; 0 for no outflow.
    pub fn area_px2(&self, volume_ml: f64, alpha_deg: f32) -> f64 {
        let at_1_px2_ml = f64::from(self.volume_ml(1.0, alpha_deg)).max(1e-12);
        (volume_ml.max(0.0) / at_1_px2_ml).powf(1.0 / f64::from(self.area_exponent).max(0.2))
    }
}

/// z of [`Calibration`] at a tilt: (alpha - 60 degrees)/30 degrees cut to +-1.5; 0 for what is not a number.
pub fn tilt_z(alpha_deg: f64) -> f64 {
    let z = (alpha_deg - 60.0) / 30.0;
    if z.is_nan() { 0.0 } else { z.clamp(-1.5, 1.5) }
}

/// The dropout hold: it turns the frames' areas, one after the other, into areas that can be summed.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Hold {
    newest_px2: f32,
    /// Whether the newest area stands in for a lone zero.
    holds_a_zero: bool,
}

impl Hold {
    /// The area that was used for the newest frame, px^2.
    pub fn newest_px2(&self) -> f32 {
        self.newest_px2
    }

    /// The area to use for this frame, px^2. A lost frame repeats the newest area. A lone zero right after a strong stream is a
    /// dropout of the extraction, and repeats the area once.
    pub fn step(&mut self, area_px2: Option<f32>, hold_above_px2: f32) -> f32 {
        let Some(area) = area_px2.filter(|a| a.is_finite() && *a >= 0.0) else {
            return self.newest_px2;
        };
        self.holds_a_zero = area == 0.0 && self.newest_px2 > hold_above_px2 && !self.holds_a_zero;
        if !self.holds_a_zero {
            self.newest_px2 = area;
        }
        self.newest_px2
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the sum from a dropout: one zero after a strong stream is bridged, a second one is believed.
    #[test]
    fn a_lone_zero_after_a_strong_stream_is_bridged_once() {
        let mut hold = Hold::default();
        let seen: Vec<f32> = [0.0, 50.0, 0.0, 100.0, 0.0, 0.0, 0.0].into_iter().map(|a| hold.step(Some(a), 60.0)).collect();
        assert_eq!(seen, [0.0, 50.0, 0.0, 100.0, 100.0, 0.0, 0.0]);
    }

    /// Protects d from lost and impossible measurements: they repeat the newest area.
    #[test]
    fn lost_frames_repeat_the_newest_area() {
        let mut hold = Hold::default();
        hold.step(Some(40.0), 60.0);
        for area in [None, Some(f32::NAN), Some(f32::INFINITY), Some(-3.0)] {
            assert_eq!(hold.step(area, 60.0), 40.0);
        }
    }

    /// Protects the calibration's formula, and that no stream gives 0, whatever the exponent.
    #[test]
    fn volume_is_a_power_of_the_area() {
        let cal = Calibration { volume_at_1_px2_ml: 0.002, area_exponent: 1.2, log_tilt_slope: 0.1, hold_above_px2: 60.0 };
        let at_60 = 0.002 * 300f32.powf(1.2);
        assert!((cal.volume_ml(300.0, 60.0) - at_60).abs() < 1e-6);
        assert!((cal.volume_ml(300.0, 90.0) / at_60 - 0.1f32.exp()).abs() < 1e-5);
        assert_eq!(cal.volume_ml(300.0, 105.0), cal.volume_ml(300.0, f32::INFINITY));
        assert_eq!(cal.volume_ml(300.0, 60.0), cal.volume_ml(300.0, f32::NAN));
        assert_eq!(cal.volume_ml(0.0, 60.0), 0.0);
        assert_eq!(Calibration { area_exponent: 0.0, ..cal }.volume_ml(0.0, 60.0), 0.0);
    }
}
