//! Whether the robot may be moved now, and if not, why: a pure function of the newest state and the clock.
//!
//! Runs in the controller's loop each tick, after [`Session::poll`](super::Session::poll); allocates nothing. Protocol
//! background: robot_mode, safety_mode, runtime_state and the status bits of the RTDE guide.

use shared::control::EndReason;

use super::{ProgramState, RobotState};

/// `Ok` if targets may be sent, otherwise the one reason that comes first for the operator.
///
/// `lost_ns` (`controller.lost_robot_ms`) is how long the robot may be silent, its clock may stand still, and its program may
/// leave targets unread.
pub fn check(state: &RobotState, now_ns: u64, lost_ns: u64) -> Result<(), EndReason> {
    let older = |at_ns: u64| now_ns.saturating_sub(at_ns) > lost_ns;
    // A state that old says nothing about now.
    if older(state.received_at_ns) {
        return Err(EndReason::RobotLost);
    }
    if let Some(reason) = hindrance(state) {
        return Err(reason);
    }
    if older(state.advanced_at_ns) {
        return Err(EndReason::RobotStalled);
    }
    match state.program_state {
        // The program ran out of patience. If it has read all that was sent, we were silent; if not, it did not get through.
        ProgramState::Returning | ProgramState::TimedOut if state.sequence_echo == state.sequence_sent => {
            return Err(EndReason::ControllerOverrun);
        }
        ProgramState::Returning | ProgramState::TimedOut => return Err(EndReason::RobotLost),
        state if !state.takes_targets() => return Err(EndReason::ProgramStopped),
        _ => {}
    }
    // By the robot's clock: while that stands still, no program can answer, and it is not the program that has stopped.
    let unread = state.advanced_at_ns.saturating_sub(state.answered_at_ns) > lost_ns;
    if state.runtime_state != RUNTIME_PLAYING || unread {
        return Err(EndReason::ProgramStopped);
    }
    Ok(())
}

/// Why the robot must not be moved, whatever runs on it.
pub(crate) fn hindrance(state: &RobotState) -> Option<EndReason> {
    if let Some(reason) = stopped_for_safety(state) {
        return Some(reason);
    }
    if state.robot_mode != ROBOT_MODE_RUNNING {
        return Some(EndReason::RobotNotRunning);
    }
    // A slower robot stretches the time of servoj: the program's patience, and each target's period with it.
    // Written so that a share that is not a number is too small.
    if state.speed_fraction >= FULL_SPEED { None } else { Some(EndReason::SpeedReduced) }
}

/// Why the robot's safety system keeps it from moving, if it does.
pub(crate) fn stopped_for_safety(state: &RobotState) -> Option<EndReason> {
    // safety_status_bits: 2 protective stop, 5 to 7 emergency stops.
    let bit = |n: u32| state.safety_bits >> n & 1 == 1;
    match state.safety_mode {
        6 | 7 => Some(EndReason::EmergencyStop),
        _ if bit(5) || bit(6) || bit(7) => Some(EndReason::EmergencyStop),
        3 => Some(EndReason::ProtectiveStop),
        _ if bit(2) => Some(EndReason::ProtectiveStop),
        1 | 2 => None,
        _ => Some(EndReason::SafetyStop),
    }
}

/// Least `target_speed_fraction` that counts as full speed; the pendant's slider has steps of 0.01.
const FULL_SPEED: f64 = 0.995;
/// robot_mode while the robot is powered and its brakes are released.
pub(crate) const ROBOT_MODE_RUNNING: i32 = 7;
/// runtime_state while a program plays.
pub(crate) const RUNTIME_PLAYING: u32 = 2;
