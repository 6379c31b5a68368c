//! Whether a person has the robot in hand, or had it since the controller last did: what decides that the robot is not taken back unasked.
//!
//! It is pure and runs on the connecting thread; only showing a [`Handover`] as text writes into the caller's buffer. Nothing here fails. What cannot be
//! known counts as a person's doing: the robot is then left alone until the operator asks for it.

use shared::config::Joint;
use shared::control::EndReason;

use super::health::{self, RUNTIME_PAUSED, RUNTIME_PAUSING, RUNTIME_PLAYING, RUNTIME_STOPPED, RUNTIME_STOPPING};
use super::{ProgramState, RobotState};

/// Rate of a joint above which it moves, rad/s: 1.1 degrees/s, several times the noise of a UR's joint at rest. Chosen by hand; no
/// measurement on a robot is recorded.
const MOVING_RAD_S: f64 = 0.02;
/// Way of a joint during a look at the robot above which it moves, rad: 0.1 degrees, far above the noise of an encoder. Chosen by hand; no
/// measurement on a robot is recorded.
const MOVED_RAD: f64 = 0.002;
/// Way of a joint since the controller lost the robot above which somebody has moved it, rad: half a degree, so that a brake that settles does
/// not count. Chosen by hand; no measurement on a robot is recorded.
const DISPLACED_RAD: f64 = 0.0087;
/// The bit of `robot_status_bits` for a running program (RTDE guide).
const PROGRAM_RUNNING_BIT: u32 = 1 << 1;
/// `safety_mode` while a safeguard is open (RTDE guide).
pub(super) const SAFETY_MODE_SAFEGUARD_STOP: i32 = 5;
/// Names of the joints, base to wrist 3.
const NAMES: [&str; 6] = ["base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3"];

/// Why the robot waits for its operator.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Handover {
    /// It was stopped, for this reason.
    Stopped(EndReason),
    /// A program is paused.
    Paused,
    /// This joint moves, and no program moves it.
    Moving(&'static str),
    /// This joint is not where it was when the controller last knew.
    Displaced(&'static str),
    /// The program ended in another way than by itself while there was no connection.
    Interrupted,
}

impl std::fmt::Display for Handover {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Stopped(reason) => write!(f, "{}", reason.words()),
            Self::Paused => write!(f, "a program is paused on the pendant"),
            Self::Moving(joint) => write!(f, "the {joint} joint moves, and no program moves it"),
            Self::Displaced(joint) => write!(f, "the {joint} joint was moved while there was no connection"),
            Self::Interrupted => write!(f, "the program was stopped, or the robot restarted, while there was no connection"),
        }
    }
}

impl Handover {
    /// What the operator must do before the robot can be taken back.
    pub fn remedy(&self) -> &'static str {
        match self {
            Self::Stopped(reason) => remedy(*reason),
            Self::Paused => "resume it (ours then brings the container upright) or stop it on the pendant",
            Self::Moving(_) | Self::Displaced(_) | Self::Interrupted => "wait until nobody works at it",
        }
    }
}

/// What the operator must do about a robot that may not be moved, for `reason`.
pub fn remedy(reason: EndReason) -> &'static str {
    match reason {
        EndReason::ProtectiveStop => "find the cause, then release it on the pendant",
        EndReason::EmergencyStop => "release the emergency stop, then switch the robot on and release its brakes",
        EndReason::SafetyStop => "clear it on the pendant",
        EndReason::InHand => "let go of it",
        EndReason::ProgramStopped => "see why it was stopped",
        EndReason::NotFollowed => {
            "look for speed limits of the safety configuration, reduced mode, a wrong payload, or something that holds the arm"
        }
        EndReason::SpeedReduced => "set it to 100 % on the pendant: it also stretches the times after which the robot acts by itself",
        _ => "switch it on and release its brakes",
    }
}

/// What the controller knows of the robot from before, when it connects.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Before {
    /// The last session's newest state; `None` before the first session.
    pub last: Option<RobotState>,
    /// Whether the operator asks for the robot now, so that it does not matter what happened before.
    pub asked: bool,
    /// Whether a program was seen since the operator last asked, running or paused, so that what happens to it afterwards matters after all.
    pub ran: bool,
    /// Whether it was seen, before the operator last asked, what had become of the newest program of ours.
    pub looked: bool,
    /// Whether the arm was seen without power or with its brakes on since a program was last seen to run: no program can then be paused.
    pub unpowered: bool,
    /// The run number of the newest program that was uploaded, whether or not a session came of it.
    pub uploaded: Option<i32>,
}

/// Why the operator must ask before the robot is taken again, after a session that ended for `reason` with the state `last`; `None` if the
/// controller may come back by itself.
pub fn after_session(reason: EndReason, last: &RobotState) -> Option<Handover> {
    let comes_back = match reason {
        // The connection or the controller was at fault. What happened meanwhile is seen when they meet again.
        EndReason::RobotLost | EndReason::RobotStalled | EndReason::ControllerOverrun => true,
        // Nobody has stopped anything; a full slider, or a closed safeguard, is the operator's own word that work goes on.
        EndReason::SpeedReduced => true,
        EndReason::SafetyStop => last.safety_mode == SAFETY_MODE_SAFEGUARD_STOP,
        // The program has ended by itself, because this process was late with its first target. Or it was last seen at work and answered no target: the
        // link may show it as it was, and nobody was seen to stop it.
        EndReason::ProgramStopped => last.program_state == ProgramState::Unused || last.runtime_state == RUNTIME_PLAYING,
        _ => false,
    };
    (!comes_back).then_some(Handover::Stopped(reason))
}

/// The first joint that moves between two states, or in the later one.
pub fn moving(earlier: &RobotState, later: &RobotState) -> Option<&'static str> {
    let fast = |k: usize| later.joint_rates_rad_s[k].abs() > MOVING_RAD_S;
    joint_where(|k| fast(k) || (later.joints_rad[k] - earlier.joints_rad[k]).abs() > MOVED_RAD)
}

/// Why a robot without a running program must not be taken unasked, as `before` and its present `state` tell; `None` if it may.
///
/// After a lost connection it may be taken if the program that we left there says that it has ended by itself, and if the joints that it does not
/// move stand where they stood. A controller that has just been started knows nothing from before; it leaves a robot alone on which a program of
/// ours was stopped in the middle of its work. An operator's wish answers for what was before it, and not for a program that ran after it and was
/// then stopped: whoever stopped that has the last word. Of a program that nobody has watched since it was at work, it
/// is not known whether the stop or the wish came first.
pub fn since(before: &Before, state: &RobotState, tilt: Joint) -> Option<Handover> {
    if before.asked {
        let unwatched = !before.looked && before.uploaded.is_none_or(|run| run == state.program_run);
        return left_behind(state).filter(|why| before.ran || (unwatched && *why == Handover::Interrupted));
    }
    let Some(last) = &before.last else { return left_behind(state) };
    let own_end = matches!(state.program_state, ProgramState::TimedOut | ProgramState::Stopped | ProgramState::Unused);
    // A program that was uploaded and started too late for a session has ended by itself, and has moved nothing.
    let is_late = state.program_state == ProgramState::Unused && before.uploaded == Some(state.program_run);
    if !own_end || (state.program_run != last.program_run && !is_late) {
        return Some(Handover::Interrupted);
    }
    let displaced = |k: usize| k != tilt.index() && (state.joints_rad[k] - last.joints_rad[k]).abs() > DISPLACED_RAD;
    joint_where(displaced).map(Handover::Displaced)
}

/// What our program's registers say of how it went away, also when no controller watched: that it was still at work, so somebody stopped it, or
/// that it ended because the joint was not where it was commanded. What a robot's boot clears, or a later program overwrites, cannot be known.
fn left_behind(state: &RobotState) -> Option<Handover> {
    use ProgramState::*;
    match state.program_state {
        _ if state.program_run == 0 => None,
        Ready | Following | Holding | Returning | Stopping | OffTrack => Some(Handover::Interrupted),
        OffTrackEnded => Some(Handover::Stopped(EndReason::NotFollowed)),
        _ => None,
    }
}

/// Whether a robot that says "paused" was only never started since its boot, so that there is no program which somebody has paused.
///
/// A booted robot says "paused" until its first program (Universal_Robots_Client_Library, issue 123). A program that is paused stands at a line,
/// or has left its traces in our registers. Of an arm that had no power meanwhile the registers are old; a line is of a program since.
pub fn never_started(before: &Before, state: &RobotState) -> bool {
    let paused = matches!(state.runtime_state, RUNTIME_PAUSING | RUNTIME_PAUSED);
    let untouched = state.program_run == 0 && state.program_state == ProgramState::Unknown && state.sequence_echo == 0;
    let nothing_stands =
        state.control_line.is_none_or(|line| line == 0) && state.status_bits.is_none_or(|bits| bits & PROGRAM_RUNNING_BIT == 0);
    paused && nothing_stands && (before.unpowered || untouched)
}

/// Whether the arm has no power or its brakes on, so that no program can run on it, also none that is paused.
pub fn without_power(state: &RobotState) -> bool {
    state.robot_mode != health::ROBOT_MODE_RUNNING && state.runtime_state != RUNTIME_PLAYING
}

/// Whether a program is there, running or paused. A paused one counts: it goes on when somebody resumes it, and may then be stopped before the next look
/// at the robot.
pub fn program_there(before: &Before, state: &RobotState) -> bool {
    let stopped = matches!(state.runtime_state, RUNTIME_STOPPING | RUNTIME_STOPPED);
    !(stopped || without_power(state) || never_started(before, state))
}

/// The name of the first joint for which `is` holds.
fn joint_where(is: impl Fn(usize) -> bool) -> Option<&'static str> {
    (0..NAMES.len()).find(|k| is(*k)).and_then(|k| NAMES.get(k).copied())
}
