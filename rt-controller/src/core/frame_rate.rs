//! Whether the camera's frames come at the rate that the configuration says: by their own times and numbers, and not by when they arrive.
//!
//! A frame stands for the volume of one frame time, and the agent acts once a frame. A camera that gives 60 frames a second instead of 30, or 15
//! because the light is low, makes every volume wrong, and nothing in the pictures shows it. It is pure and runs in the controller's loop; it
//! does not allocate or fail.

use shared::messages::Feature;

/// Number of frame times that are compared: half a second at 30 Hz. Chosen by hand: less than the way to the first drop.
const WINDOW: usize = 15;
/// Largest relative difference of their median from the configured frame time. Chosen by hand: the clocks of cameras differ by far less, and
/// the next slower rate that cameras offer below 30 is 25.
const TOLERANCE: f64 = 0.1;
/// Number of frames over which a small difference is told: 1.6 s at 30 Hz. Chosen by hand: no more ticks than a replay leaves uncompared.
const LONG_WINDOW: usize = 48;
/// Frames in a half of that window.
const HALF: usize = LONG_WINDOW / 2;
/// Frames at either end of a half whose median stands for that end: late frames and pauses of single ones do not move it. Chosen by hand.
const END: usize = 9;
/// Largest relative difference over each half of the long window, which is the error of the volume that remains. Times that scatter by 5 ms
/// move a half's rate by 0.6 %, and 28 frames a second instead of 30 by 7 %.
const LONG_TOLERANCE: f64 = 0.025;

/// The newest frame times of one feature worker.
#[derive(Debug, Clone, Copy)]
pub struct FrameRate {
    /// The configured frame time, ns; 0 if it is not known, and then nothing is compared.
    frame_ns: u64,
    /// Epoch of the worker, number and time of the newest frame, ns.
    newest: Option<(u64, u64, u64)>,
    times_ns: [u64; WINDOW],
    seen: usize,
    /// Number of frames in a row before each of which another one was missing, and the time from the last but one of them to the last, ns.
    sparse: (usize, u64),
    /// How much later than by their numbers the newest frames came, ns, as places in a ring, and the number of frames that were taken.
    late_ns: [i64; LONG_WINDOW],
    taken: usize,
    /// Number and time of the frame from which that is counted, ns.
    first: (u64, u64),
}

impl FrameRate {
    /// The watch over frames that should come every `frame_ns`; 0 watches nothing.
    pub fn new(frame_ns: u64) -> Self {
        Self { frame_ns, newest: None, times_ns: [0; WINDOW], seen: 0, sparse: (0, 0), late_ns: [0; LONG_WINDOW], taken: 0, first: (0, 0) }
    }

    /// Takes the next frame of those that count. A frame that was lost has a number too, so that it makes no other time longer. Where frames
    /// have their numbers from their times, as those of a device, a camera of half the rate seems to lose every second one.
    pub fn saw(&mut self, feature: &Feature) {
        let Feature { worker_epoch_ns, sequence, captured_at_ns, .. } = *feature;
        match self.newest {
            Some((epoch_ns, number, at_ns)) if epoch_ns == worker_epoch_ns => {
                let frames = sequence.saturating_sub(number).max(1);
                self.times_ns[self.seen % WINDOW] = captured_at_ns.saturating_sub(at_ns) / frames;
                self.seen = if self.seen + 1 == 2 * WINDOW { WINDOW } else { self.seen + 1 };
                self.sparse = if frames > 1 { (self.sparse.0 + 1, captured_at_ns.saturating_sub(at_ns)) } else { (0, 0) };
            }
            _ => (self.seen, self.sparse, self.taken, self.first) = (0, (0, 0), 0, (sequence, captured_at_ns)),
        }
        let due_ns = u128::from(sequence.saturating_sub(self.first.0)) * u128::from(self.frame_ns);
        let late_ns = i128::from(captured_at_ns) - i128::from(self.first.1) - due_ns.min(u128::from(u64::MAX)) as i128;
        self.late_ns[self.taken % LONG_WINDOW] = late_ns.clamp(i128::from(i64::MIN), i128::from(i64::MAX)) as i64;
        self.taken = if self.taken + 1 == 2 * LONG_WINDOW { LONG_WINDOW } else { self.taken + 1 };
        self.newest = Some((worker_epoch_ns, sequence, captured_at_ns));
    }

    /// The rate at which frames really come, frames/s, if it is another than the configured one. Neither measure sees a single pause: the
    /// median of the frame times tells a rate of another kind within half a second, and both halves of the long window together a small
    /// difference. A device whose frames have their numbers from their times has no small difference: its missing numbers are bridged.
    pub fn wrong_hz(&self) -> Option<f32> {
        if self.frame_ns == 0 || self.seen < WINDOW {
            return None;
        }
        if self.sparse.0 >= WINDOW {
            return Some((1e9 / self.sparse.1.max(1) as f64) as f32);
        }
        let mut times_ns = self.times_ns;
        times_ns.sort_unstable();
        let median_ns = times_ns[WINDOW / 2];
        let off = (median_ns as f64 / self.frame_ns as f64 - 1.0).abs();
        if off > TOLERANCE {
            return Some((1e9 / median_ns.max(1) as f64) as f32);
        }
        let later = [self.later(0), self.later(HALF)];
        let both = later.iter().all(|l| *l > LONG_TOLERANCE) || later.iter().all(|l| *l < -LONG_TOLERANCE);
        both.then(|| (1e9 / (self.frame_ns as f64 * (1.0 + 0.5 * (later[0] + later[1])))) as f32)
    }

    /// By which share a frame comes later after the one before it than configured, in the half of the long window that begins with this frame;
    /// 0 while the window is not full.
    fn later(&self, from: usize) -> f64 {
        if self.taken < LONG_WINDOW {
            return 0.0;
        }
        let median_of = |first: usize| {
            let mut late_ns: [i64; END] = std::array::from_fn(|k| self.late_ns[(self.taken + from + first + k) % LONG_WINDOW]);
            late_ns.sort_unstable();
            late_ns[END / 2]
        };
        let (begin, end) = (median_of(0), median_of(HALF - END));
        (end as f64 - begin as f64) / (self.frame_ns as f64 * (HALF - END) as f64)
    }

    /// The configured rate, frames/s.
    pub fn configured_hz(&self) -> f32 {
        (1e9 / self.frame_ns.max(1) as f64) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is found after `frames` frames that come every `frame_ms`; every `lose`th is lost, and every `pause`th comes 0.3 s late.
    fn wrong_hz(frame_ms: f64, frames: u64, lose: u64, pause: u64) -> Option<f32> {
        let mut rate = FrameRate::new(1_000_000_000 / 30);
        for sequence in (0..frames).filter(|k| k % lose != 1) {
            let late_ns = if sequence % pause == 5 { 300_000_000 } else { 0 };
            let captured_at_ns = 5_000_000_000 + (sequence as f64 * frame_ms * 1e6) as u64 + late_ns;
            rate.saw(&Feature { worker_epoch_ns: 7, sequence, captured_at_ns, ..Feature::default() });
        }
        rate.wrong_hz()
    }

    /// Protects the volume from a camera with another rate than the configured one, and ordinary cameras, lost frames and pauses from a false
    /// alarm.
    #[test]
    fn another_rate_is_noticed_within_half_a_second() {
        for hz in [60.0, 50.0, 25.0, 15.0, 7.5] {
            let found = wrong_hz(1e3 / hz, 18, 100, 100);
            assert!(found.is_some_and(|f| (f64::from(f) / hz - 1.0).abs() < 0.01), "{hz}: {found:?}");
        }
        for (frame_ms, lose, pause) in [(33.333, 1000, 1000), (33.367, 3, 40), (33.0, 4, 9), (34.0, 1000, 12)] {
            assert_eq!(wrong_hz(frame_ms, 600, lose, pause), None, "{frame_ms} {lose} {pause}");
        }
        assert_eq!(wrong_hz(66.0, 10, 100, 100), None, "too few to say");
        let half = wrong_hz(33.333, 60, 2, 100);
        assert!(half.is_some_and(|hz| (hz / 15.0 - 1.0).abs() < 0.01), "numbered by its times: {half:?}");
    }

    /// Protects the volume from a camera that is a little slower or faster than configured, as 28 frames a second for 30 are, and a camera
    /// whose times scatter, or that pauses once, from a false alarm.
    #[test]
    fn a_small_difference_is_noticed_within_two_seconds() {
        for hz in [28.0, 29.0, 31.0, 32.0] {
            assert_eq!(wrong_hz(1e3 / hz, 40, 1000, 1000), None, "{hz}: too few to say");
            let found = wrong_hz(1e3 / hz, 52, 1000, 1000);
            assert!(found.is_some_and(|f| (f64::from(f) / hz - 1.0).abs() < 0.01), "{hz}: {found:?}");
        }
        for (frame_ms, lose, pause) in [(33.367, 1000, 1000), (33.0, 7, 23), (33.8, 5, 1000), (33.333, 1000, 9)] {
            assert_eq!(wrong_hz(frame_ms, 600, lose, pause), None, "{frame_ms} {lose} {pause}");
        }
        for step_after in [40u64, 70, 100] {
            let mut rate = FrameRate::new(1_000_000_000 / 30);
            for k in 0..200u64 {
                // Up to 6 ms of scatter, and one pause of 0.3 s that no number counts.
                let mixed = (k + 1).wrapping_mul(0xbf58_476d_1ce4_e5b9);
                let scatter_ns = ((mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb) >> 33) % 6_000_000;
                let pause_ns = if k > step_after { 300_000_000 } else { 0 };
                let captured_at_ns = 1_000_000_000 + k * 33_333_333 + scatter_ns + pause_ns;
                rate.saw(&Feature { worker_epoch_ns: 1, sequence: k, captured_at_ns, ..Feature::default() });
                assert_eq!(rate.wrong_hz(), None, "frame {k}, pause after {step_after}");
            }
        }
    }

    /// Protects the next worker: with it, everything is learned anew.
    #[test]
    fn another_worker_begins_anew() {
        let mut rate = FrameRate::new(1_000_000_000 / 30);
        for k in 0..40 {
            rate.saw(&Feature { worker_epoch_ns: 1, sequence: k, captured_at_ns: k * 66_000_000, ..Feature::default() });
        }
        assert!(rate.wrong_hz().is_some());
        rate.saw(&Feature { worker_epoch_ns: 2, sequence: 0, captured_at_ns: 40 * 66_000_000, ..Feature::default() });
        assert_eq!(rate.wrong_hz(), None);
        assert_eq!(FrameRate::new(0).wrong_hz(), None);
    }
}
