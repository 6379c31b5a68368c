//! How the joint follows its commands, from episodes whose measured tilt was recorded.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail. A Gaussian curve looks the same after a delay and
//! after a lag, so the areas alone cannot tell one from the other, nor from the onset of the flow. The joint's own record can.

use shared::estimator::flow::DELAY_MAX_FRAMES;

use crate::data::TrainingEpisode;

/// Resolution of the delay and the lag, frames: a tenth of what a pour's delay scatters.
const STEP_FRAMES: f64 = 0.1;
/// The longest lag that is looked for, frames at 30 frames a second. Chosen by hand: the joint of a robot that can stop a stream follows within 0.3 s.
const LAG_MAX_FRAMES: f64 = 9.0;
/// Fewer measured angles than this, in frames whose command moves, say nothing: half a second.
const MOVING_MIN: usize = 15;
/// A command that changes by less than this in a frame does not move, degrees.
const MOVES_DEG: f64 = 0.05;

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
    pub fn of(episodes: &[TrainingEpisode]) -> Option<Self> {
        let moving = |e: &TrainingEpisode| {
            let known = e.alpha_measured_deg.iter().skip(1).zip(e.alpha_deg.windows(2));
            known.filter(|(measured, w)| measured.is_finite() && (w[1] - w[0]).abs() > MOVES_DEG).count()
        };
        if episodes.iter().map(moving).sum::<usize>() < MOVING_MIN {
            return None;
        }
        let steps = |most: f64| (0..=(most / STEP_FRAMES) as usize).map(|k| k as f64 * STEP_FRAMES);
        let squares = |servo: &Self| episodes.iter().map(|e| servo.squares(e)).sum::<f64>();
        let all = steps(DELAY_MAX_FRAMES).flat_map(|delay_frames| {
            steps(LAG_MAX_FRAMES * crate::data::rate_hz(episodes) / 30.0).map(move |lag_frames| Self { delay_frames, lag_frames })
        });
        all.map(|servo| (squares(&servo), servo)).min_by(|a, b| a.0.total_cmp(&b.0)).map(|(_, servo)| servo)
    }

    /// Sum of the squared errors of an episode's measured tilts, degrees^2.
    fn squares(&self, e: &TrainingEpisode) -> f64 {
        let (whole, part) = (self.delay_frames as usize, self.delay_frames.fract());
        let at = |k: usize| e.alpha_deg[k.min(e.len() - 1)];
        let mut tilt_deg = e.alpha_deg.first().copied().unwrap_or(0.0);
        let mut sum = 0.0;
        for (k, measured_deg) in e.alpha_measured_deg.iter().enumerate() {
            let (newer, older) = (at(k.saturating_sub(whole)), at(k.saturating_sub(whole + 1)));
            tilt_deg += (newer + part * (older - newer) - tilt_deg) / (1.0 + self.lag_frames);
            if measured_deg.is_finite() {
                sum += (measured_deg - tilt_deg).powi(2);
            }
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An episode along a Gaussian curve whose joint follows after a pure delay, in frames, and then a lag.
    fn episode(delay: u32, lag: f64, measured: bool) -> TrainingEpisode {
        let mut e = TrainingEpisode::empty("x", 30.0);
        let command = |k: f64| 70.0 * f64::exp(-0.4 * (k / 30.0 - 3.0).powi(2));
        let mut tilt = command(0.0);
        for k in 0..180 {
            tilt += (command((f64::from(k) - f64::from(delay)).max(0.0)) - tilt) / (1.0 + lag);
            e.push(f64::from(k) / 30.0, command(f64::from(k)), if measured { tilt } else { f64::NAN }, 0.0);
        }
        e
    }

    /// Protects the geometry: a pure delay and a lag of the joint are told apart, which the areas alone cannot do.
    #[test]
    fn delay_and_lag_are_told_apart() {
        for (delay, lag) in [(4, 0.0), (1, 2.5), (0, 0.0)] {
            let found = Servo::of(&[episode(delay, lag, true)]).unwrap();
            assert!(
                (found.delay_frames - f64::from(delay)).abs() < 0.15 && (found.lag_frames - lag).abs() < 0.15,
                "{delay} {lag}: {found:?}"
            );
        }
    }

    /// Protects data without a measured tilt, as from a table: nothing is invented.
    #[test]
    fn without_a_measured_tilt_nothing_is_known() {
        assert_eq!(Servo::of(&[episode(3, 1.0, false)]), None);
        assert_eq!(Servo::of(&[]), None);
    }
}
