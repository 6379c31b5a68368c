//! Which ways back a weight file may hold, and which limits lead to none of them at a frame rate.
//!
//! Pure functions for ordinary threads; they allocate only the line that names what is wrong, which is their error.

use crate::estimator::flow::WayBack;
use crate::limits::Limits;

/// Rate of the way back, degrees a frame. Chosen by hand: a twentieth and five times that of the shipped configurations.
pub const BACK_RATE_DEG: (f64, f64) = (0.1, 10.0);
/// Change of that rate in a frame, degrees a frame. Chosen by hand: far from those of the shipped configurations.
pub const BACK_CHANGE_DEG: (f64, f64) = (0.01, 100.0);

/// Refuses limits whose way back no weight file can hold at `rate_hz` frames a second, and names the two keys.
pub fn check_way_back(limits: &Limits, rate_hz: f64) -> Result<(), String> {
    let back = WayBack::new(limits, rate_hz);
    let of = |key: &str, value: f32, in_a_frame: f64, (low, high): (f64, f64)| {
        if (low..=high).contains(&in_a_frame) {
            return Ok(());
        }
        Err(format!(
            "limits.{key} {value} is {in_a_frame:.3} degrees a frame at {rate_hz} frames a second, but must be {low} to {high}: change it or camera.fps"
        ))
    };
    let (rate_key, rate) = if limits.rate_deg_s < limits.return_rate_deg_s {
        ("rate_deg_s", limits.rate_deg_s)
    } else {
        ("return_rate_deg_s", limits.return_rate_deg_s)
    };
    of(rate_key, rate, back.rate_deg, BACK_RATE_DEG)?;
    of("acceleration_deg_s2", limits.acceleration_deg_s2, back.change_deg, BACK_CHANGE_DEG)
}
