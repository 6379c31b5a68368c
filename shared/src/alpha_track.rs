//! The one track of alpha over time: which angle belonged to a picture that was taken between two ticks of the controller.
//!
//! The controller's loop, the recorder and, through the recorded episodes, the training all use it, so that they pair pictures and
//! angles in the same way. Its size is fixed; nothing here allocates, locks, panics or fails. An angle that is not known is NaN.

/// How long a measured alpha still counts when no newer one has come, ns: as long as a robot may be silent before it counts as lost.
const HOLD_NS: u64 = 100_000_000;
/// A frame no longer waits for a newer state of the robot once a tick has come this long after it, ns. Chosen by hand; no measurement is
/// recorded.
const PATIENCE_NS: u64 = 50_000_000;

/// One angle over time: the newest `N` values, each with its time, ascending in time.
#[derive(Debug, Clone, Default)]
pub struct AngleHistory<const N: usize>(heapless::Vec<(u64, f32), N>);

impl<const N: usize> AngleHistory<N> {
    /// A history without any value.
    pub const fn new() -> Self {
        Self(heapless::Vec::new())
    }

    /// Adds the angle `alpha_deg` at `at_ns`. An angle that is not finite, or not newer than the newest, is left out.
    pub fn push(&mut self, at_ns: u64, alpha_deg: f32) {
        if !alpha_deg.is_finite() || self.0.last().is_some_and(|newest| newest.0 >= at_ns) {
            return;
        }
        if self.0.is_full() {
            self.0.remove(0);
        }
        // There is room: the oldest value has just left.
        let _ = self.0.push((at_ns, alpha_deg));
    }

    /// The angle at `t_ns`, degrees: linear between two values, constant before the first and after the last; NaN without any.
    pub fn at_deg(&self, t_ns: u64) -> f32 {
        self.at_within_deg(t_ns, u64::MAX)
    }

    /// The same as [`AngleHistory::at_deg`], but NaN if no value lies within `hold_ns` of `t_ns`.
    pub fn at_within_deg(&self, t_ns: u64, hold_ns: u64) -> f32 {
        let later = self.0.partition_point(|(at_ns, _)| *at_ns <= t_ns);
        let near = |at_ns: u64| at_ns.abs_diff(t_ns) <= hold_ns;
        match (later.checked_sub(1).and_then(|k| self.0.get(k)), self.0.get(later)) {
            (Some(&(t0, a0)), Some(&(t1, a1))) if near(t0) || near(t1) => a0 + (a1 - a0) * ((t_ns - t0) as f32 / (t1 - t0) as f32),
            (Some(&(at_ns, alpha_deg)), None) | (None, Some(&(at_ns, alpha_deg))) if near(at_ns) => alpha_deg,
            _ => f32::NAN,
        }
    }

    /// The least and the largest angle in force from `from_ns` to `to_ns`, degrees: those between the two times, and the ones in force at
    /// them; NaN without any value.
    pub fn range_deg(&self, from_ns: u64, to_ns: u64) -> (f32, f32) {
        let ends = [self.at_deg(from_ns), self.at_deg(to_ns)];
        let between = self.0.iter().filter(|(at_ns, _)| (from_ns..=to_ns).contains(at_ns)).map(|(_, alpha_deg)| *alpha_deg);
        let all = between.chain(ends);
        all.fold((f32::NAN, f32::NAN), |(least, largest), alpha_deg| (least.min(alpha_deg), largest.max(alpha_deg)))
    }

    /// The time of the newest value, ns; 0 without any.
    fn newest_ns(&self) -> u64 {
        self.0.last().map_or(0, |newest| newest.0)
    }
}

/// The commanded and the measured angle over time, each with its newest `N` values.
#[derive(Debug, Clone, Default)]
pub struct AlphaTrack<const N: usize> {
    commanded: AngleHistory<N>,
    measured: AngleHistory<N>,
}

impl<const N: usize> AlphaTrack<N> {
    /// A track without any value.
    pub const fn new() -> Self {
        Self { commanded: AngleHistory::new(), measured: AngleHistory::new() }
    }

    /// Adds a tick at `at_ns` with its commanded alpha, and the alpha that the robot reported at `robot_at_ns` (0 if it has never reported
    /// any).
    pub fn push(&mut self, at_ns: u64, alpha_deg: f32, robot_at_ns: u64, alpha_measured_deg: f32) {
        self.commanded.push(at_ns, alpha_deg);
        if robot_at_ns > 0 {
            self.measured.push(robot_at_ns, alpha_measured_deg);
        }
    }

    /// Whether the values that are still to come cannot change alpha at `t_ns`.
    pub fn covers(&self, t_ns: u64) -> bool {
        let tick_ns = self.commanded.newest_ns();
        tick_ns >= t_ns && (self.measured.newest_ns() >= t_ns || tick_ns >= t_ns + PATIENCE_NS)
    }

    /// Commanded alpha at `t_ns`, degrees, as [`AngleHistory::at_deg`] gives it.
    pub fn commanded_deg(&self, t_ns: u64) -> f32 {
        self.commanded.at_deg(t_ns)
    }

    /// Measured alpha at `t_ns`, degrees: linear between robot states; NaN more than 100 ms away from any.
    pub fn measured_deg(&self, t_ns: u64) -> f32 {
        self.measured.at_within_deg(t_ns, HOLD_NS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// Protects the pairing of image and angle: alpha belongs to the middle of the exposure, not to the nearest tick.
    #[test]
    fn alpha_is_interpolated_at_the_capture_time() {
        let mut track = AlphaTrack::<8>::new();
        track.push(100 * MS, 10.0, 95 * MS, 8.0);
        track.push(133 * MS, 13.0, 130 * MS, 11.5);
        assert_eq!(track.commanded_deg(111 * MS), 11.0);
        assert!((track.measured_deg(105 * MS) - 9.0).abs() < 1e-5);
        assert_eq!(track.commanded_deg(50 * MS), 10.0, "constant before the first tick");
        assert_eq!(track.commanded_deg(500 * MS), 13.0, "constant after the last tick");
        assert!(track.measured_deg(500 * MS).is_nan(), "a robot that went silent measures nothing");
    }

    /// Protects rows from being written before the tick that decides their angle has come.
    #[test]
    fn a_frame_waits_for_the_tick_and_the_robot_state_after_it() {
        let mut track = AlphaTrack::<8>::new();
        assert!(!track.covers(1));
        track.push(100 * MS, 10.0, 95 * MS, 8.0);
        assert!(track.covers(95 * MS));
        assert!(!track.covers(97 * MS), "no robot state after it yet");
        track.push(150 * MS, 10.0, 95 * MS, 8.0);
        assert!(track.covers(97 * MS), "the robot is silent: no use to wait longer");
    }

    /// Protects memory: the history is bounded, and a state of the robot that comes twice is kept once.
    #[test]
    fn the_history_is_bounded() {
        let mut track = AlphaTrack::<4>::new();
        for i in 1..100 {
            track.push(i * MS, i as f32, 5 * MS, 1.0);
        }
        assert_eq!(track.commanded.0.len(), 4);
        assert_eq!(track.measured.0.len(), 1);
    }
}
