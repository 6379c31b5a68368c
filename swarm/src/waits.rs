//! What a controller must leave by itself: a run that has ended, and a robot that may be taken.
//!
//! Pure; allocates for what it finds; cannot fail.

use shared::messages::Phase;

/// The longest time from the end of a pour until the next may begin on a robot that nothing hinders, s: the way upright (2.9 s in check.rs), and 3 s for the
/// last drops or a joint that comes no nearer (`SETTLE_MAX_S` of the controller's endings).
const ENDS_S: f64 = 2.9 + 3.0;
/// After this a robot that nothing hinders has been taken, s, once its operator asked: two dialogues that fail, and one that does not.
const TAKEN_S: f64 = 10.0;
/// An order that comes so soon after a fault, s, is refused before the controller has seen that a person took the robot, and does not ask for it: two beats
/// of 0.1 s of the robot's thread.
const SEEN_S: f64 = 0.2;

/// What is kept from cycle to cycle.
#[derive(Debug, Clone, Copy, Default)]
pub struct Waits {
    /// Since when a run has been ending on a robot that nothing hinders, s.
    ending_since_s: Option<f64>,
    /// Since when the robot could have been taken, s.
    takable_since_s: Option<f64>,
}

impl Waits {
    /// Takes a control cycle in which the controller is in `phase`, and the arm may move or not, and be taken or not; `no_program` says
    /// that none runs on the robot. Somebody asked for the robot at `asked_s`, if a person has
    /// not taken it since; the last fault that can keep it from being taken was over at `over_s`. Gives what has lasted for too long.
    pub fn cycle(
        &mut self,
        phase: Phase,
        (may_move, may_be_taken, no_program): (bool, bool, bool),
        (asked_s, over_s): (Option<f64>, f64),
        at_s: f64,
    ) -> Option<String> {
        let is_ending = matches!(phase, Phase::Settling | Phase::Returning);
        if !is_ending || !may_move || at_s <= over_s {
            self.ending_since_s = None;
        } else if at_s - *self.ending_since_s.get_or_insert(at_s) > ENDS_S {
            return Some(format!("a run has been {phase:?} for {ENDS_S} s, and nothing hinders the robot"));
        }
        // Brakes take their time, and so does a program that still brings the container upright; whoever asks before that is told to ask again.
        let since_s = self.takable_since_s.or(no_program.then_some(at_s));
        self.takable_since_s = since_s.filter(|_| may_be_taken);
        let seen_s = self.takable_since_s?.max(over_s) + SEEN_S;
        let asked_s = asked_s.filter(|asked_s| phase == Phase::NoRobot && *asked_s > seen_s && at_s - asked_s > TAKEN_S)?;
        Some(format!("nothing hinders the robot, and it has not been taken since somebody asked at {asked_s:.1} s"))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is found in 12 s of a phase, when it was asked at a time and the last fault was over at another, s.
    fn found(phase: Phase, may_move: bool, asked_s: Option<f64>, over_s: f64) -> bool {
        let mut waits = Waits::default();
        (0..1500).any(|k| waits.cycle(phase, (may_move, may_move, may_move), (asked_s, over_s), 0.008 * f64::from(k)).is_some())
    }

    /// Protects the operator from a cell that stands still: a run that does not end, and a robot that is not taken, are found where nothing hinders it, and only
    /// there.
    #[test]
    fn a_cell_does_not_stand_still() {
        for phase in [Phase::Settling, Phase::Returning] {
            assert!(found(phase, true, None, -1.0), "{phase:?}");
            assert!(!found(phase, false, None, -1.0) && !found(phase, true, None, 9.0), "{phase:?}");
        }
        assert!(found(Phase::NoRobot, true, Some(0.5), 0.0));
        assert!(!found(Phase::NoRobot, true, None, 0.0), "a person has it");
        assert!(!found(Phase::NoRobot, true, Some(0.5), 3.0), "it was asked for while a fault stood");
        assert!(!found(Phase::NoRobot, true, Some(0.5), 0.4), "nobody had seen the fault yet");
        assert!(!found(Phase::Idle, true, Some(0.5), 0.0));
    }
}
