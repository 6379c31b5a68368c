//! The tilt that a picture shows: the measured one where the robot gives it and the episodes had it, and the commanded one otherwise, each with
//! its own delay and lag.
//!
//! It is pure and runs in the controller's loop: its size is fixed, and it does not allocate, panic or fail.

use super::filter::Tilt;
use super::flow::{CommandHistory, FlowTables, Lateness, delayed_deg, followed_deg};

/// Angles outside of this range are cut to it, degrees. Chosen by hand: no cell tilts that far.
const RANGE_DEG: (f64, f64) = (-30.0, 200.0);

/// The newest angles of a pour, one a frame.
#[derive(Debug, Clone)]
pub(super) struct Angles {
    /// The commanded ones.
    pub commanded: CommandHistory,
    measured: CommandHistory,
    /// Whether there was a frame yet.
    begun: bool,
    /// Whether the measured ones are known.
    has_measured: bool,
}

impl Default for Angles {
    /// No angles.
    fn default() -> Self {
        let none = CommandHistory::standing_at(0.0);
        Self { commanded: none, measured: none, begun: false, has_measured: false }
    }
}

impl Angles {
    /// Adds a frame's angles, degrees. A command that is not a number repeats the one before it. A measured angle that is not a number moves as
    /// the command does, if there was one before.
    pub fn push(&mut self, command_deg: f64, measured_deg: f64) {
        let (low, high) = RANGE_DEG;
        let before_deg = self.commanded.newest_deg();
        let command_deg = if command_deg.is_finite() { command_deg.clamp(low, high) } else { before_deg };
        let known = measured_deg.is_finite();
        let moved_deg = if self.begun { command_deg - before_deg } else { 0.0 };
        let measured_deg = if known { measured_deg } else { self.measured.newest_deg() + moved_deg }.clamp(low, high);
        // What was before is not known, so the container stood at this angle.
        if !self.begun {
            self.commanded = CommandHistory::standing_at(command_deg);
        }
        if known && !self.has_measured {
            self.measured = CommandHistory::standing_at(measured_deg);
        }
        self.begun = true;
        self.has_measured |= known;
        self.commanded.push(command_deg);
        self.measured.push(measured_deg);
    }
}

/// Follows the tilt that the pictures show, by a flow model.
#[derive(Debug, Clone)]
pub(super) struct ShownTilt {
    /// The tilt in the newest picture.
    pub tilt: Tilt,
    begun: bool,
}

impl Default for ShownTilt {
    /// A container that has not been seen.
    fn default() -> Self {
        Self { tilt: Tilt { tilt_deg: 0.0, change_deg: 0.0, change_before_deg: 0.0 }, begun: false }
    }
}

impl ShownTilt {
    /// Takes the angles of a new frame.
    pub fn follow(&mut self, flow: &FlowTables, angles: &Angles) {
        let model = &flow.model;
        let commanded = Lateness { lag_frames: model.lag_frames, delay_frames: model.delay_frames };
        let (history, late) = match model.measured {
            Some(late) if angles.has_measured => (&angles.measured, late),
            _ => (&angles.commanded, commanded),
        };
        let delayed = delayed_deg(history.commands(), 0, late.delay_frames);
        let before = self.tilt;
        let before_deg = if self.begun { before.tilt_deg } else { delayed };
        self.begun = true;
        let tilt_deg = followed_deg(before_deg, delayed, late.lag_frames, flow.tilt_step_deg);
        self.tilt = Tilt { tilt_deg, change_deg: tilt_deg - before_deg, change_before_deg: before.change_deg };
    }
}
