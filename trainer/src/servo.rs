//! How the joint follows its commands, from episodes whose measured tilt was recorded, and whether it follows them at all.
//!
//! Pure functions of the offline trainer, for any thread; they do not fail. A Gaussian curve looks the same after a delay and
//! after a lag, so the areas alone cannot tell one from the other, nor from the onset of the flow. The joint's own record can.

use shared::estimator::flow::DELAY_MAX_FRAMES;

/// Resolution of the delay and the lag, frames: a tenth of what a pour's delay scatters.
const STEP_FRAMES: f64 = 0.1;
/// The longest lag that is looked for, frames at 30 frames a second. Chosen by hand: the joint of a robot that can stop a stream follows within 0.3 s.
const LAG_MAX_FRAMES: f64 = 9.0;
/// Fewer measured angles than this, in frames whose command moves, say nothing: half a second.
const MOVING_MIN: usize = 15;
/// A command that changes by less than this in a frame does not move, degrees.
const MOVES_DEG: f64 = 0.05;

/// Resolution with which is looked whether a joint follows at all, frames: half a frame is 1 degree at the 60 degrees/s of the shipped limits.
const COARSE_FRAMES: f64 = 1.0;

/// An episode's record of the joint: the commanded tilt of each frame, degrees, and the measured one, NaN where it is not known.
pub type Record<'a> = (&'a [f64], &'a [f64]);

/// How a joint follows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Servo {
    /// From a command until the joint begins to obey it, frames.
    pub delay_frames: f64,
    /// Lag behind the delayed command, frames, as in the flow model.
    pub lag_frames: f64,
}

impl Servo {
    /// The servo that fits the measured tilts best, least squares over all episodes; `None` where too little was measured.
    pub fn of(records: &[Record], rate_hz: f64) -> Option<Self> {
        let moving = |(commanded, measured): &Record| {
            let known = measured.iter().skip(1).zip(commanded.windows(2));
            known.filter(|(measured, w)| measured.is_finite() && (w[1] - w[0]).abs() > MOVES_DEG).count()
        };
        if records.iter().map(moving).sum::<usize>() < MOVING_MIN {
            return None;
        }
        let squares = |servo: &Self| records.iter().map(|record| servo.squares(*record)).sum::<f64>();
        Self::all(STEP_FRAMES, rate_hz).map(|servo| (squares(&servo), servo)).min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, servo)| servo)
    }

    /// The servos that are looked for, so many frames apart.
    fn all(step_frames: f64, rate_hz: f64) -> impl Iterator<Item = Self> {
        let steps = move |most: f64| (0..=(most / step_frames) as usize).map(move |k| k as f64 * step_frames);
        steps(DELAY_MAX_FRAMES)
            .flat_map(move |delay_frames| steps(LAG_MAX_FRAMES * rate_hz / 30.0).map(move |lag_frames| Self { delay_frames, lag_frames }))
    }

    /// Sum of the squared errors of an episode's measured tilts, degrees^2.
    fn squares(&self, (commanded, measured): Record) -> f64 {
        let (whole, part) = (self.delay_frames as usize, self.delay_frames.fract());
        let at = |k: usize| commanded[k.min(commanded.len() - 1)];
        let mut tilt_deg = commanded.first().copied().unwrap_or(0.0);
        let mut sum = 0.0;
        for (k, measured_deg) in measured.iter().enumerate() {
            let (newer, older) = (at(k.saturating_sub(whole)), at(k.saturating_sub(whole + 1)));
            tilt_deg += (newer + part * (older - newer) - tilt_deg) / (1.0 + self.lag_frames);
            if measured_deg.is_finite() {
                sum += (measured_deg - tilt_deg).powi(2);
            }
        }
        sum
    }
}

/// By how much the measured tilts are off those of the servo that fits them best, root mean square, degrees; 0 where nothing was measured.
pub fn off_deg(record: Record, rate_hz: f64) -> f64 {
    let known = record.1.iter().filter(|deg| deg.is_finite()).count();
    let least = Servo::all(COARSE_FRAMES, rate_hz).map(|servo| servo.squares(record)).fold(f64::INFINITY, f64::min);
    (least / known.max(1) as f64).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Commands along a Gaussian curve, and where a joint is that follows after a pure delay, in frames, and then a lag.
    fn record(delay: u32, lag: f64) -> (Vec<f64>, Vec<f64>) {
        let command = |k: f64| 70.0 * f64::exp(-0.4 * (k / 30.0 - 3.0).powi(2));
        let mut tilt = command(0.0);
        let one = |k: u32| {
            tilt += (command((f64::from(k) - f64::from(delay)).max(0.0)) - tilt) / (1.0 + lag);
            (command(f64::from(k)), tilt)
        };
        (0..180).map(one).unzip()
    }

    /// Protects the geometry: a pure delay and a lag of the joint are told apart, which the areas alone cannot do.
    #[test]
    fn delay_and_lag_are_told_apart() {
        for (delay, lag) in [(4, 0.0), (1, 2.5), (0, 0.0)] {
            let (commanded, measured) = record(delay, lag);
            let found = Servo::of(&[(&commanded, &measured)], 30.0).unwrap();
            assert!(
                (found.delay_frames - f64::from(delay)).abs() < 0.15 && (found.lag_frames - lag).abs() < 0.15,
                "{delay} {lag}: {found:?}"
            );
        }
    }

    /// Protects data without a measured tilt, as from a table: nothing is invented, and nothing is off.
    #[test]
    fn without_a_measured_tilt_nothing_is_known() {
        let (commanded, none) = (record(3, 1.0).0, [f64::NAN; 180]);
        assert_eq!((Servo::of(&[(&commanded, &none)], 30.0), Servo::of(&[], 30.0)), (None, None));
        assert_eq!((off_deg((&commanded, &none), 30.0), off_deg((&[], &[]), 30.0)), (0.0, 0.0));
    }

    /// Protects good recordings: a joint with any delay and lag that is modelled follows, also between two of the servos that are tried.
    #[test]
    fn a_late_joint_follows() {
        for (delay, lag) in [(0, 0.0), (13, 0.0), (4, 4.5), (13, 9.0)] {
            let (commanded, measured) = record(delay, lag);
            assert!(off_deg((&commanded, &measured), 30.0) < 0.5, "{delay} {lag}");
        }
        assert!(off_deg((&record(0, 0.0).0, &record(40, 0.0).1), 30.0) > 5.0);
    }
}
