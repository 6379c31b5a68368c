//! When the next tick is due: a fixed period, its phase held just after the camera's measurements.
//!
//! Camera and loop both run at 30 Hz, but by different clocks. Left alone, one would slowly overtake the other: V_e would wait for its
//! tick for anything between nothing and a whole period, and now and then a tick would have two frames or none. So each tick moves the
//! phase, by at most [`PULL_MAX_NS`] (0.6 % of the period), until V_e has waited for the margin when it is used. A camera whose rate
//! differs by more is not followed; the loop's rate then wanders within that 0.6 %.
//!
//! The margin follows what this machine does. It is twice what V_e came late, relative to its usual time, in all but one of the frames of
//! the last 10 to 12 s (their 99.7th percentile), and [`MARGIN_FLOOR_NS`] more; the largest there is, until V_e was watched for 4 s. A
//! pause of the machine that comes once in that time costs its own frame, and no other frame waits for it. A tick that wakes up late
//! needs no margin, because V_e is then there all the more.
//!
//! It is pure and runs in the real-time thread; it does not allocate or fail. What it sees stands in the journal, so that every deadline
//! can be computed again.

/// The least margin, ns: what a V_e that comes at its usual time to the microsecond would be given. Chosen by hand: nearly
/// all wake-ups of a quiet machine are nearer (docs/REALTIME.md).
pub const MARGIN_FLOOR_NS: i64 = 300_000;
/// The largest margin, ns, and the one before anything is known: more than the jitter of a loaded machine. See docs/REALTIME.md.
pub const MARGIN_MAX_NS: i64 = 3_000_000;
/// Number of measurements in a window: 2 s at 30 Hz.
const WINDOW: u32 = 60;
/// Number of windows whose latest V_e decide, this one included: 10 to 12 s. Chosen by hand: a machine whose pauses are further apart loses
/// one tick in hundreds to each.
const WINDOWS: usize = 6;
/// How many of the latest V_e of each window are kept: one that is forgiven and the one that decides.
const KEPT: usize = 2;
/// Largest change of a period, ns: 0.6 % of the period at 30 Hz. Chosen by hand; no measurement is recorded.
pub const PULL_MAX_NS: i64 = 200_000;
/// One tick corrects this part of the phase's error, 1 / 8, because the measurement of a single frame is noise. Chosen by hand; no
/// measurement is recorded.
const GAIN: i64 = 8;
/// A measurement moves the belief of the difference of the two clocks by this part of its error, 1 / 128. With [`GAIN`] this damps the belief by
/// 0.7, the usual choice.
const DRIFT_GAIN: i64 = 128;
/// A known phase is moved by no more than this part of a measurement's error, ns, so that a pause of the machine does not make the frames
/// after it look early or late. Chosen by hand: half of the jitter up to which the margin is tested.
const OUTLIER_NS: i64 = 500_000;
/// Number of measurements in a row that are off by more than [`OUTLIER_NS`] to the same side, after which the phase is learned anew: half
/// a second, after which it is the camera that has changed. Chosen by hand.
const OUTLIERS: i32 = 15;
/// Number of measurements after which the phase is known, so that a late V_e is told from a wrong belief: five times the belief's own time.
const KNOWN: u32 = 64;

/// Computes the deadlines.
#[derive(Debug, Clone, Copy)]
pub struct Pacer {
    period_ns: u64,
    /// How long a V_e that comes at its usual time has waited at the next deadline, ns; `None` before the first.
    wait_ns: Option<i64>,
    /// By how much the camera's period is longer than the loop's, ns; it is taken off the wait in each period.
    drift_ns: i64,
    margin_ns: i64,
    /// The latest that V_e came, relative to its usual time, latest first, in this window and in those before, newest first, ns.
    latest_ns: [[i64; KEPT]; WINDOWS],
    /// Number of measurements in this window.
    seen: u32,
    /// Number of measurements, up to [`KNOWN`].
    known: u32,
    /// Number of measurements in a row that were off by more than [`OUTLIER_NS`]: positive if they had waited longer, negative if less.
    outliers: i32,
    /// Whether a whole window was seen; before, the margin is the largest.
    watched: bool,
}

impl Pacer {
    /// The pacer of a loop with this period, ns.
    pub fn new(period_ns: u64) -> Self {
        Self {
            period_ns,
            wait_ns: None,
            drift_ns: 0,
            margin_ns: MARGIN_MAX_NS,
            latest_ns: [[0; KEPT]; WINDOWS],
            seen: 0,
            known: 0,
            outliers: 0,
            watched: false,
        }
    }

    /// How long V_e is to have waited when its tick wakes up, ns.
    pub fn margin_ns(&self) -> u64 {
        self.margin_ns.unsigned_abs()
    }

    /// Takes note that a tick that woke up at `woke_ns` used a measurement that was published at `published_at_ns`. Call it for each
    /// measurement: one that came after its own tick is met by the next one, perhaps together with another.
    pub fn used(&mut self, woke_ns: u64, published_at_ns: u64) {
        let waited_ns = woke_ns.saturating_sub(published_at_ns).min(4 * self.period_ns) as i64;
        let Some(wait_ns) = self.wait_ns else {
            self.wait_ns = Some(self.nearest(waited_ns));
            return;
        };
        // A measurement that waited almost a whole period came just after the tick before, so the error is taken the nearer way round.
        let error_ns = self.nearest(waited_ns - wait_ns);
        let outlier = self.known == KNOWN && error_ns.abs() > OUTLIER_NS;
        let learned_ns = if outlier { OUTLIER_NS * error_ns.signum() } else { error_ns };
        self.wait_ns = Some(self.nearest(wait_ns + learned_ns / GAIN));
        if !outlier {
            self.drift_ns = (self.drift_ns - error_ns / DRIFT_GAIN).clamp(-PULL_MAX_NS, PULL_MAX_NS);
        }
        if self.known < KNOWN {
            self.known += 1;
            return;
        }
        let side = error_ns.signum() as i32;
        self.outliers = if !outlier {
            0
        } else if self.outliers.signum() == side {
            self.outliers + side
        } else {
            side
        };
        if self.outliers.abs() >= OUTLIERS {
            (self.outliers, self.known) = (0, 0);
        }
        self.latest_ns[0] = later_two(self.latest_ns[0], -error_ns);
        self.seen += 1;
        if self.seen >= WINDOW {
            self.seen = 0;
            self.latest_ns.rotate_right(1);
            self.latest_ns[0] = [0; KEPT];
            self.watched = true;
        }
        if self.watched {
            let [_, second_ns] = self.latest_ns.iter().flatten().fold([0; KEPT], |two, late_ns| later_two(two, *late_ns));
            self.margin_ns = (MARGIN_FLOOR_NS + 2 * second_ns).clamp(MARGIN_FLOOR_NS, MARGIN_MAX_NS);
        }
    }

    /// A duration less as many periods as bring it nearest to 0, ns.
    fn nearest(&self, ns: i64) -> i64 {
        let period_ns = (self.period_ns as i64).max(1);
        (ns + period_ns / 2).rem_euclid(period_ns) - period_ns / 2
    }

    /// The deadline after `deadline_ns`, and how many periods were missed because it is `now_ns` already. Missed periods are skipped,
    /// never made up for.
    pub fn next_deadline_ns(&mut self, deadline_ns: u64, now_ns: u64) -> (u64, u64) {
        // A deadline that comes later by some time finds a V_e that has waited longer by it.
        let wait_ns = self.wait_ns.unwrap_or(self.margin_ns);
        let later_ns = (self.nearest(self.margin_ns - wait_ns) / GAIN + self.drift_ns).clamp(-PULL_MAX_NS, PULL_MAX_NS);
        let next_ns = (deadline_ns + self.period_ns).saturating_add_signed(later_ns);
        let skipped = if next_ns > now_ns { 0 } else { (now_ns - next_ns) / self.period_ns.max(1) + 1 };
        let periods = i64::try_from(skipped).unwrap_or(0).saturating_add(1);
        self.wait_ns = self.wait_ns.map(|wait_ns| self.nearest(wait_ns + later_ns - self.drift_ns.saturating_mul(periods)));
        (next_ns + skipped * self.period_ns, skipped)
    }
}

/// The two latest of these and one more, latest first, ns.
fn later_two([first_ns, second_ns]: [i64; KEPT], late_ns: i64) -> [i64; KEPT] {
    if late_ns > first_ns { [late_ns, first_ns] } else { [first_ns, second_ns.max(late_ns)] }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD_NS: u64 = 33_333_333;

    /// Runs the loop, and a camera whose period is `camera_ns` and whose V_e is late by `late_ns(frame)`, for ten minutes. Gives how long
    /// each V_e waited in the last five minutes, and how many ticks had none.
    fn run(camera_ns: u64, first_ns: u64, late_ns: impl Fn(u64) -> u64) -> (Vec<u64>, u32) {
        let (mut pacer, mut deadline_ns, mut frame) = (Pacer::new(PERIOD_NS), 1_000_000_000, 0u64);
        let published_ns = |frame: u64| 900_000_000 + first_ns + frame * camera_ns + late_ns(frame);
        let (mut waits, mut without) = (Vec::new(), 0);
        for tick in 0..18_000 {
            let mut newest = None;
            while published_ns(frame) <= deadline_ns {
                newest = Some(published_ns(frame));
                pacer.used(deadline_ns, published_ns(frame));
                frame += 1;
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

    /// A number between 0 and 999 that looks random, from a frame's number.
    fn noise(frame: u64) -> u64 {
        (frame.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407) >> 33) % 1000
    }

    /// Protects the age of V_e: from any start, and with a camera 0.3 % fast or slow, it waits only for the least margin where it comes at its
    /// usual time, and no tick goes without.
    #[test]
    fn the_loop_falls_in_behind_the_camera() {
        for camera_ns in [PERIOD_NS, PERIOD_NS - 100_000, PERIOD_NS + 100_000] {
            for first_ns in (0..PERIOD_NS).step_by(1_700_000) {
                let (waits, without) = run(camera_ns, first_ns, |_| 0);
                let worst = waits.iter().map(|w| w.abs_diff(MARGIN_FLOOR_NS as u64)).max();
                assert!(worst < Some(250_000) && without == 0, "camera {camera_ns}, start {first_ns}: {worst:?}, {without}");
            }
        }
    }

    /// Protects every frame's action: where V_e comes up to a millisecond late, the margin grows until no tick meets two frames or none, and
    /// V_e still waits for less than the largest margin.
    #[test]
    fn the_margin_follows_the_jitter() {
        let (waits, without) = run(PERIOD_NS + 20_000, 5_000_000, |frame| 1_000 * (noise(frame) % 1000));
        let mean = waits.iter().sum::<u64>() / waits.len() as u64;
        assert_eq!((without, waits.len()), (0, 9_000));
        assert!((500_000..2_000_000).contains(&mean), "{mean}");
    }

    /// Protects a loaded machine: however late V_e comes, it is never made to wait for more than the largest margin, and once the machine is
    /// quiet again for a minute, it waits no longer than before.
    #[test]
    fn the_margin_has_a_limit_and_comes_down_again() {
        let mut pacer = Pacer::new(PERIOD_NS);
        let (mut deadline_ns, mut usual_ns) = (1_000_000_000, 999_000_000);
        let mut see = |late_ns: u64, times: u32| {
            for _ in 0..times {
                let published_ns = usual_ns + late_ns;
                let woke_ns = if published_ns <= deadline_ns { deadline_ns } else { deadline_ns + PERIOD_NS };
                pacer.used(woke_ns, published_ns);
                deadline_ns = pacer.next_deadline_ns(deadline_ns, 0).0;
                usual_ns += PERIOD_NS;
            }
            pacer.margin_ns()
        };
        assert_eq!(see(0, 1), 3_000_000, "nothing is known yet");
        assert!(see(0, 4 * WINDOW) < 400_000, "watched for 8 s");
        assert_eq!(see(8_000_000, 3), 3_000_000, "V_e came 8 ms late");
        assert!(see(0, 20 * WINDOW) < 400_000);
        assert!(see(8_000_000, 1) < 400_000, "a lone pause is not waited for by others");
        assert!(see(0, WINDOW) < 400_000);
        assert_eq!(see(8_000_000, 1), 3_000_000, "a second one within seconds is");
    }

    /// Protects the phase: one V_e that comes 8 ms late leaves the waits of those after it as they were, and a camera that starts again at
    /// another moment is followed within four seconds.
    #[test]
    fn a_pause_is_forgotten_and_a_new_phase_is_learned() {
        let (waits, _) = run(PERIOD_NS, 5_000_000, |frame| if frame % 600 == 0 { 8_000_000 } else { 0 });
        let mut waits = waits.into_iter().filter(|w| *w < 2 * PERIOD_NS / 3).collect::<Vec<_>>();
        waits.sort_unstable();
        assert!(waits[waits.len() * 98 / 100] < 400_000, "{:?}", waits[waits.len() * 98 / 100]);
        let moved_at = 9_300;
        let (waits, without) = run(PERIOD_NS, 5_000_000, |frame| if frame < moved_at { 0 } else { 14_000_000 });
        assert!(without <= 1, "{without}");
        let settled = &waits[420..];
        assert!(settled.iter().all(|w| *w <= 2 * MARGIN_MAX_NS as u64), "{:?}", settled.iter().max());
        assert!(waits[waits.len() - 1] < 400_000);
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
        let (waits, without) = run(40_000_000, 0, |_| 0);
        // 9,000 ticks of 33.3 ms see 7,500 frames of 40 ms, each of them once. The clock's difference is corrected by at most 0.6 %.
        assert!(waits.len().abs_diff(7_500) < 60 && without as usize + waits.len() == 9_000, "{} {without}", waits.len());
    }
}
