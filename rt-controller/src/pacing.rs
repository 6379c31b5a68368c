//! When the next tick is due: a fixed period, its phase held just after the camera's measurements.
//!
//! Camera and loop both run at 30 Hz, but by different clocks. Left alone, one would slowly overtake the other: V_e would wait for its
//! tick for anything between nothing and a whole period, and now and then a tick would have two frames or none. So each tick moves the
//! phase, by at most [`PULL_MAX_NS`] (0.6 % of the period), until V_e has waited [`WAIT_NS`] when it is used. A camera whose rate
//! differs by more is not followed; the loop's rate then wanders within that 0.6 %.
//!
//! It is pure and runs in the real-time thread; it does not allocate or fail.

/// How long V_e is to have waited when its tick wakes up, ns: more than the worker's jitter, so that a tick seldom comes too early.
/// See docs/REALTIME.md for the measured jitter.
pub const WAIT_NS: i64 = 3_000_000;
/// Largest change of a period, ns: 0.6 % of the period at 30 Hz. Chosen by hand; no measurement is recorded.
pub const PULL_MAX_NS: i64 = 200_000;
/// One tick corrects this part of the phase's error, 1 / 8, because the measurement of a single frame is noise. Chosen by hand; no
/// measurement is recorded.
const GAIN: i64 = 8;

/// Computes the deadlines.
#[derive(Debug, Clone, Copy)]
pub struct Pacer {
    period_ns: u64,
    pull_ns: i64,
}

impl Pacer {
    /// The pacer of a loop with this period, ns.
    pub fn new(period_ns: u64) -> Self {
        Self { period_ns, pull_ns: 0 }
    }

    /// Takes note that a tick that woke up at `woke_ns` used a measurement that was published at `published_at_ns`.
    pub fn used(&mut self, woke_ns: u64, published_at_ns: u64) {
        let period_ns = self.period_ns as i64;
        let waited_ns = woke_ns.saturating_sub(published_at_ns).min(self.period_ns) as i64;
        // A measurement that waited almost a whole period came just after the tick before, so the error is taken the nearer way round.
        let late_ns = (waited_ns - WAIT_NS + period_ns / 2).rem_euclid(period_ns) - period_ns / 2;
        self.pull_ns = (late_ns / GAIN).clamp(-PULL_MAX_NS, PULL_MAX_NS);
    }

    /// The deadline after `deadline_ns`, and how many periods were missed because it is `now_ns` already. Missed periods are skipped,
    /// never made up for.
    pub fn next_deadline_ns(&mut self, deadline_ns: u64, now_ns: u64) -> (u64, u64) {
        let pull_ns = std::mem::take(&mut self.pull_ns);
        let next_ns = (deadline_ns + self.period_ns).saturating_add_signed(-pull_ns);
        if next_ns > now_ns {
            return (next_ns, 0);
        }
        let skipped = (now_ns - next_ns) / self.period_ns + 1;
        (next_ns + skipped * self.period_ns, skipped)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_NS: u64 = 33_333_333;

    /// Runs the loop, and a camera whose period is `camera_ns`, for ten minutes. Gives how long each V_e waited in the last five minutes,
    /// and how many ticks had none.
    fn run(camera_ns: u64, first_ns: u64) -> (Vec<u64>, u32) {
        let (mut pacer, mut deadline_ns, mut published_ns) = (Pacer::new(PERIOD_NS), 1_000_000_000, 900_000_000 + first_ns);
        let (mut waits, mut without) = (Vec::new(), 0);
        for tick in 0..18_000 {
            let mut newest = None;
            while published_ns <= deadline_ns {
                newest = Some(published_ns);
                published_ns += camera_ns;
            }
            if let Some(newest) = newest {
                pacer.used(deadline_ns, newest);
            }
            if tick >= 9_000 {
                waits.extend(newest.map(|n| deadline_ns - n));
                without += u32::from(newest.is_none());
            }
            let (next_ns, skipped) = pacer.next_deadline_ns(deadline_ns, deadline_ns + 1000);
            assert_eq!(skipped, 0);
            assert!(next_ns.abs_diff(deadline_ns + PERIOD_NS) <= PULL_MAX_NS as u64, "the period is nearly fixed");
            deadline_ns = next_ns;
        }
        (waits, without)
    }

    /// Protects the age of V_e: from any start, and with a camera 0.3 % fast or slow, it waits about 3 ms and no tick goes without.
    #[test]
    fn the_loop_falls_in_behind_the_camera() {
        for camera_ns in [PERIOD_NS, PERIOD_NS - 100_000, PERIOD_NS + 100_000] {
            for first_ns in (0..PERIOD_NS).step_by(1_700_000) {
                let (waits, without) = run(camera_ns, first_ns);
                let worst = waits.iter().map(|w| w.abs_diff(WAIT_NS as u64)).max();
                assert!(worst < Some(1_000_000) && without == 0, "camera {camera_ns}, start {first_ns}: {worst:?}, {without}");
            }
        }
    }

    /// Protects the robot from bursts: what was missed is skipped, and counted.
    #[test]
    fn missed_periods_are_skipped() {
        let mut pacer = Pacer::new(100);
        assert_eq!(pacer.next_deadline_ns(1000, 1050), (1100, 0));
        assert_eq!(pacer.next_deadline_ns(1000, 1100), (1200, 1));
        assert_eq!(pacer.next_deadline_ns(1000, 1350), (1400, 3));
    }

    /// Protects the fixed rate: a camera of another rate is not followed.
    #[test]
    fn a_camera_of_another_rate_changes_little() {
        let (waits, without) = run(40_000_000, 0);
        // 9,000 ticks of 33.3 ms see 7,500 frames of 40 ms, each of them once.
        assert!(waits.len().abs_diff(7_500) < 10 && without as usize + waits.len() == 9_000, "{} {without}", waits.len());
    }
}
