//! The tilt of each episode as the fit takes it: the measured one where the robot gave it, and the commanded one otherwise.
//!
//! Pure functions of the offline trainer, which allocate and do not fail. An episode without measured tilt among others that have it gets the
//! one that its commands would have led to, by the others' delay and lag.

use shared::estimator::flow::{CommandHistory, Lateness, delayed_deg, followed_deg, tilt_step_deg};

use crate::data::{self, TrainingEpisode};
use crate::servo::Servo;

/// Share of the frames whose measured tilt must be known. Chosen by hand: the first and last frames may come before or after the robot's states.
const KNOWN_SHARE: f64 = 0.9;
/// The tilts of all episodes.
pub struct Tilts {
    /// Tilt of each frame of each episode, degrees.
    pub alpha_deg: Vec<Vec<f64>>,
    /// How the measured tilt follows the commanded one, if any episode has a measured one; else the tilts are commanded ones.
    pub robot: Option<Lateness>,
}

impl Tilts {
    /// The tilts of usable episodes.
    pub fn of(episodes: &[TrainingEpisode]) -> Self {
        let records: Vec<_> = episodes.iter().map(|e| (&e.alpha_deg[..], &e.alpha_measured_deg[..])).collect();
        let Some(Servo { delay_frames, lag_frames }) = Servo::of(&records, data::rate_hz(episodes)) else {
            return Self { alpha_deg: episodes.iter().map(|e| e.alpha_deg.clone()).collect(), robot: None };
        };
        let robot = Lateness { lag_frames, delay_frames };
        let tilts = |e: &TrainingEpisode| {
            if has_measured(e) { without_gaps(e) } else { followed(&e.alpha_deg, robot, tilt_step_deg(e.rate_hz)).collect() }
        };
        Self { alpha_deg: episodes.iter().map(tilts).collect(), robot: Some(robot) }
    }
}

/// Whether nearly all frames have a measured tilt.
fn has_measured(e: &TrainingEpisode) -> bool {
    let known = e.alpha_measured_deg.iter().filter(|a| a.is_finite()).count();
    known as f64 >= KNOWN_SHARE * e.len() as f64
}

/// The measured tilts, whose gaps move as the command does, as at run time.
fn without_gaps(e: &TrainingEpisode) -> Vec<f64> {
    let first = e.alpha_measured_deg.iter().copied().find(|a| a.is_finite()).unwrap_or(0.0);
    let (mut newest, mut was_known) = (first, false);
    (0..e.len())
        .map(|k| {
            let known = e.alpha_measured_deg[k].is_finite();
            let moved = if was_known { e.alpha_deg[k] - e.alpha_deg[k - 1] } else { 0.0 };
            newest = if known { e.alpha_measured_deg[k] } else { newest + moved };
            was_known |= known;
            newest
        })
        .collect()
}

/// Where a joint is that follows the commands with a delay and a lag, by no more than `step_deg` a frame, degrees.
fn followed(commands: &[f64], late: Lateness, step_deg: f64) -> impl Iterator<Item = f64> + '_ {
    let start = commands.first().copied().unwrap_or(0.0);
    let (mut history, mut tilt_deg) = (CommandHistory::standing_at(start), start);
    commands.iter().map(move |command| {
        history.push(*command);
        tilt_deg = followed_deg(tilt_deg, delayed_deg(history.commands(), 0, late.delay_frames), late.lag_frames, step_deg);
        tilt_deg
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the likeness of training and pouring: a gap of the measured tilt moves with the command from the first measurement on, also while
    /// the tilt is still the first one; before it, nothing moves.
    #[test]
    fn a_gap_moves_as_the_command_does() {
        let mut e = TrainingEpisode::empty("x", 30.0);
        let none = f64::NAN;
        for (k, (command, measured)) in [(0.0, none), (0.0, 1.0), (2.0, none), (5.0, none), (6.0, 6.5), (7.0, none)].into_iter().enumerate()
        {
            e.push(k as f64 / 30.0, command, measured, 0.0);
        }
        assert_eq!(without_gaps(&e), [1.0, 1.0, 3.0, 6.0, 6.5, 7.5]);
    }
}
