//! Whether the robot may be moved now, and if not, why: a pure function of the newest state and the clock.
//!
//! It runs in the controller's loop in each tick, after [`Session::poll`](super::Session::poll); it does not allocate or fail. The RTDE
//! guide explains robot_mode, safety_mode, runtime_state and the status bits.

use shared::control::EndReason;

use super::{ProgramState, RobotState};

/// `Ok` if targets may be sent, otherwise the reason that matters most to the operator.
///
/// `lost_ns` (`controller.lost_robot_ms`) is how long the robot may be silent, how long its clock may stand still, how long its program may
/// leave targets unread, and how long a target and the news of it may take on their way.
pub fn check(state: &RobotState, now_ns: u64, lost_ns: u64) -> Result<(), EndReason> {
    let older = |at_ns: u64| now_ns.saturating_sub(at_ns) > lost_ns;
    // A state this old says nothing about the present.
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
        // The program heard nothing for too long. That it has read everything by now does not tell why: a link that was held up, or a robot
        // that did not read, brings all of it at once. The controller knows how long it was silent itself.
        ProgramState::Returning | ProgramState::TimedOut if state.was_silent => return Err(EndReason::ControllerOverrun),
        ProgramState::Returning | ProgramState::TimedOut => return Err(EndReason::RobotLost),
        // The program found the joint elsewhere than it commanded: a robot that is slower than the program, or is held or moved by hand.
        ProgramState::OffTrack | ProgramState::OffTrackEnded => return Err(EndReason::NotFollowed),
        state if !state.takes_targets() => return Err(EndReason::ProgramStopped),
        _ => {}
    }
    // This is measured up to the last advance of the robot's clock: while that stands still no program can answer, and it is not the
    // program that has stopped.
    let unread = state.advanced_at_ns.saturating_sub(state.answered_at_ns) > lost_ns;
    if state.runtime_state != RUNTIME_PLAYING || unread {
        return Err(EndReason::ProgramStopped);
    }
    // The program reads on, but late: the link holds back what passes over it, so that all that is known of the robot is old too.
    if state.unread_since_ns != 0 && state.received_at_ns.saturating_sub(state.unread_since_ns) > lost_ns {
        return Err(EndReason::RobotLost);
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
    if in_hand(state) {
        return Some(EndReason::InHand);
    }
    // A slower robot stretches the time of servoj, and with it the program's patience and each target's period. The comparison is
    // written so that a fraction that is not a number is too small.
    if state.speed_fraction >= FULL_SPEED { None } else { Some(EndReason::SpeedReduced) }
}

/// Whether somebody presses the teach button, so that the arm can be moved by hand.
pub(crate) fn in_hand(state: &RobotState) -> bool {
    state.status_bits.is_some_and(|bits| bits & TEACH_BUTTON_BIT != 0)
}

/// Why the robot's safety system keeps it from moving, if it does.
pub(crate) fn stopped_for_safety(state: &RobotState) -> Option<EndReason> {
    let any_bit = |bits: u32| state.safety_bits & bits != 0;
    match state.safety_mode {
        SAFETY_MODE_SYSTEM_EMERGENCY_STOP | SAFETY_MODE_ROBOT_EMERGENCY_STOP => Some(EndReason::EmergencyStop),
        _ if any_bit(EMERGENCY_STOP_BITS) => Some(EndReason::EmergencyStop),
        SAFETY_MODE_PROTECTIVE_STOP => Some(EndReason::ProtectiveStop),
        _ if any_bit(PROTECTIVE_STOP_BIT) => Some(EndReason::ProtectiveStop),
        SAFETY_MODE_NORMAL | SAFETY_MODE_REDUCED => None,
        _ => Some(EndReason::SafetyStop),
    }
}

/// Least `target_speed_fraction` that counts as full speed; the pendant's slider has steps of 0.01.
const FULL_SPEED: f64 = 0.995;
/// The bit of `robot_status_bits` for a pressed teach button: freedrive (RTDE guide).
const TEACH_BUTTON_BIT: u32 = 1 << 2;
/// `robot_mode` while the robot is powered and its brakes are released (RTDE guide).
pub const ROBOT_MODE_RUNNING: i32 = 7;
/// `runtime_state` while a program is being stopped (RTDE guide).
pub(crate) const RUNTIME_STOPPING: u32 = 0;
/// `runtime_state` while no program runs (RTDE guide).
pub(crate) const RUNTIME_STOPPED: u32 = 1;
/// `runtime_state` while a program plays (RTDE guide).
pub(crate) const RUNTIME_PLAYING: u32 = 2;
/// `runtime_state` while a program is being paused (RTDE guide).
pub(crate) const RUNTIME_PAUSING: u32 = 3;
/// `runtime_state` while a program is paused (RTDE guide).
pub(crate) const RUNTIME_PAUSED: u32 = 4;
/// `safety_mode` of a robot that is not restricted (RTDE guide).
const SAFETY_MODE_NORMAL: i32 = 1;
/// `safety_mode` of a robot under its reduced limits (RTDE guide).
const SAFETY_MODE_REDUCED: i32 = 2;
/// `safety_mode` after a protective stop (RTDE guide).
const SAFETY_MODE_PROTECTIVE_STOP: i32 = 3;
/// `safety_mode` after an emergency stop by the system (RTDE guide).
const SAFETY_MODE_SYSTEM_EMERGENCY_STOP: i32 = 6;
/// `safety_mode` after an emergency stop at the robot (RTDE guide).
const SAFETY_MODE_ROBOT_EMERGENCY_STOP: i32 = 7;
/// The bit of `safety_status_bits` for a protective stop (RTDE guide).
const PROTECTIVE_STOP_BIT: u32 = 1 << 2;
/// The bits of `safety_status_bits` for emergency stops: system, robot, any (RTDE guide).
const EMERGENCY_STOP_BITS: u32 = 1 << 5 | 1 << 6 | 1 << 7;
