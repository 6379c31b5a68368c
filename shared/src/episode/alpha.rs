//! Alpha at any time, from the controller's ticks: a frame is captured between ticks, and `L_E` wants alpha at that time.
//! A bounded history; allocates once. Ordinary threads only.

use std::collections::VecDeque;

/// How long the last measured alpha still counts when no newer one has come, ns.
const HOLD_NS: u64 = 100_000_000;
/// Ticks after which a frame no longer waits for a newer robot state, ns.
const PATIENCE_NS: u64 = 50_000_000;

/// The newest commanded and measured angles.
#[derive(Debug, Clone)]
pub struct AlphaTrack {
    capacity: usize,
    commanded: VecDeque<(u64, f32)>,
    measured: VecDeque<(u64, f32)>,
}

impl AlphaTrack {
    /// Keeps the newest `capacity` ticks.
    pub fn new(capacity: usize) -> Self {
        Self { capacity, commanded: VecDeque::with_capacity(capacity), measured: VecDeque::with_capacity(capacity) }
    }

    /// Adds a tick at `at_ns` with its commanded alpha, and the alpha that the robot reported at `robot_at_ns` (0: never).
    pub fn push(&mut self, at_ns: u64, alpha_deg: f32, robot_at_ns: u64, alpha_measured_deg: f32) {
        let add = |track: &mut VecDeque<(u64, f32)>, at: u64, alpha: f32| {
            if alpha.is_finite() && track.back().is_none_or(|newest| newest.0 < at) {
                if track.len() == self.capacity {
                    track.pop_front();
                }
                track.push_back((at, alpha));
            }
        };
        add(&mut self.commanded, at_ns, alpha_deg);
        if robot_at_ns > 0 {
            add(&mut self.measured, robot_at_ns, alpha_measured_deg);
        }
    }

    /// Whether nothing that is still to come would change alpha at `t_ns`.
    pub fn covers(&self, t_ns: u64) -> bool {
        let newest = |track: &VecDeque<(u64, f32)>| track.back().map_or(0, |p| p.0);
        let tick = newest(&self.commanded);
        tick >= t_ns && (newest(&self.measured) >= t_ns || tick >= t_ns + PATIENCE_NS)
    }

    /// Commanded alpha at `t_ns`, degrees: linear between ticks, constant before the first and after the last; NaN without
    /// any tick.
    pub fn commanded_deg(&self, t_ns: u64) -> f32 {
        interpolate(&self.commanded, t_ns, u64::MAX)
    }

    /// Measured alpha at `t_ns`, degrees: linear between robot states; NaN more than 100 ms away from any.
    pub fn measured_deg(&self, t_ns: u64) -> f32 {
        interpolate(&self.measured, t_ns, HOLD_NS)
    }
}

fn interpolate(track: &VecDeque<(u64, f32)>, t_ns: u64, hold_ns: u64) -> f32 {
    let after = track.partition_point(|p| p.0 < t_ns);
    let near = |p: &(u64, f32)| if p.0.abs_diff(t_ns) <= hold_ns { p.1 } else { f32::NAN };
    match (after.checked_sub(1).and_then(|i| track.get(i)), track.get(after)) {
        (None, None) => f32::NAN,
        (Some(p), None) | (None, Some(p)) => near(p),
        (Some(a), Some(b)) => {
            if a.0.abs_diff(t_ns).min(b.0.abs_diff(t_ns)) > hold_ns {
                return f32::NAN;
            }
            let share = (t_ns - a.0) as f64 / (b.0 - a.0) as f64;
            (f64::from(a.1) + share * f64::from(b.1 - a.1)) as f32
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// Protects the pairing of image and angle: alpha belongs to the middle of the exposure, not to the nearest tick.
    #[test]
    fn alpha_is_interpolated_at_the_capture_time() {
        let mut track = AlphaTrack::new(8);
        track.push(100 * MS, 10.0, 95 * MS, 8.0);
        track.push(133 * MS, 13.0, 130 * MS, 11.5);
        assert_eq!(track.commanded_deg(111 * MS), 11.0);
        assert!((track.measured_deg(105 * MS) - 9.0).abs() < 1e-5);
        assert_eq!(track.commanded_deg(50 * MS), 10.0, "constant before the first tick");
        assert_eq!(track.commanded_deg(500 * MS), 13.0, "constant after the last tick");
        assert!(track.measured_deg(500 * MS).is_nan(), "a robot that went silent measures nothing");
    }

    /// Protects samples from being written before the tick that decides their angle has come.
    #[test]
    fn a_frame_waits_for_the_tick_and_the_robot_state_after_it() {
        let mut track = AlphaTrack::new(8);
        assert!(!track.covers(1));
        track.push(100 * MS, 10.0, 95 * MS, 8.0);
        assert!(track.covers(95 * MS));
        assert!(!track.covers(97 * MS), "no robot state after it yet");
        track.push(150 * MS, 10.0, 95 * MS, 8.0);
        assert!(track.covers(97 * MS), "the robot is silent: no use to wait longer");
    }

    /// Protects memory: the history is bounded, and the same robot state twice is one.
    #[test]
    fn the_history_is_bounded() {
        let mut track = AlphaTrack::new(4);
        for i in 1..100 {
            track.push(i * MS, i as f32, 5 * MS, 1.0);
        }
        assert_eq!(track.commanded.len(), 4);
        assert_eq!(track.measured.len(), 1);
    }
}
