//! Why there is no session with the robot: one line for the operator that says what to do.
//!
//! The errors are made on the connecting thread, and allocate.

use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use shared::control::EndReason;

/// How long a TCP connection, and each answer, may take. Chosen by hand; no measurement is recorded.
pub(super) const ANSWER: Duration = Duration::from_secs(2);
/// How long the program may take from its upload to its first sign of life. Chosen by hand; no measurement is recorded.
pub(super) const PROGRAM_START: Duration = Duration::from_secs(5);

/// Why there is no session with the robot.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LinkError {
    /// There is no TCP connection.
    #[error("robot {at}: cannot connect: {what}; check robot.address, the cable, and that the robot is switched on")]
    Unreachable {
        /// Address and port.
        at: SocketAddr,
        /// The operating system's message.
        what: String,
    },
    /// The robot closed the connection, or it broke.
    #[error("robot {at}: connection lost while {doing}: {what}; too many RTDE clients on the robot are one cause")]
    Lost {
        /// Address and port.
        at: SocketAddr,
        /// What was being done, as a noun.
        doing: &'static str,
        /// The operating system's message.
        what: String,
    },
    /// An answer did not come in time.
    #[error("robot {at}: no answer to {doing} within {} s; restart the robot's controller if this stays", ANSWER.as_secs())]
    NoAnswer {
        /// Address and port.
        at: SocketAddr,
        /// What was being done, as a noun.
        doing: &'static str,
    },
    /// The robot's bytes do not follow the protocol.
    #[error("robot {at}: unexpected bytes in the answer to {doing}; is this the RTDE port of a UR controller?{said}")]
    Unexpected {
        /// Address and port.
        at: SocketAddr,
        /// What was being done, as a noun.
        doing: &'static str,
        /// The robot's newest text message, if there was one.
        said: String,
    },
    /// The robot refuses RTDE protocol 2.
    #[error("robot {address} refuses RTDE protocol 2; update PolyScope to 3.9 (CB3) or 5.3 (e-Series) or newer")]
    VersionRefused {
        /// The robot's address.
        address: IpAddr,
    },
    /// The robot's PolyScope has no registers 24 to 47.
    #[error(
        "robot {address} runs PolyScope {major}.{minor}, which has no registers 24 to 47; update to 3.9 (CB3), 5.3 (e-Series) or newer"
    )]
    TooOld {
        /// The robot's address.
        address: IpAddr,
        /// Its major version.
        major: u32,
        /// Its minor version.
        minor: u32,
    },
    /// The robot does not have a variable.
    #[error("robot {address} does not know the RTDE variable {variable}; update PolyScope, or change robot.register_base")]
    NotFound {
        /// The robot's address.
        address: IpAddr,
        /// The variable's name.
        variable: String,
    },
    /// Another client writes a variable.
    #[error(
        "robot {address}: {variable} is in use by another RTDE client or a fieldbus (EtherNet/IP, PROFINET, MODBUS); \
         close it there, or change robot.register_base"
    )]
    InUse {
        /// The robot's address.
        address: IpAddr,
        /// The variable's name.
        variable: String,
    },
    /// A variable has another type than documented.
    #[error("robot {address}: {variable} has type {given} instead of {expected}; this version of PolyScope is not supported")]
    WrongType {
        /// The robot's address.
        address: IpAddr,
        /// The variable's name.
        variable: String,
        /// The type that the robot names.
        given: String,
        /// The type that the RTDE guide names.
        expected: &'static str,
    },
    /// The robot does not start to send its state.
    #[error("robot {address} refuses to start sending its state{said}; restart the robot's controller if this stays")]
    StartRefused {
        /// The robot's address.
        address: IpAddr,
        /// The robot's newest text message, if there was one.
        said: String,
    },
    /// The robot is not in a state to be moved.
    #[error("robot {address}: {}; {}", reason.words(), remedy(*reason))]
    NotWell {
        /// The robot's address.
        address: IpAddr,
        /// Why it may not move.
        reason: EndReason,
    },
    /// A program is running.
    #[error("robot {address}: a program is running; wait until it has brought the container upright, or stop it on the pendant")]
    ProgramRunning {
        /// The robot's address.
        address: IpAddr,
    },
    /// A program is paused.
    #[error("robot {address}: a program is paused; resume it (ours then brings the container upright) or stop it on the pendant")]
    ProgramPaused {
        /// The robot's address.
        address: IpAddr,
    },
    /// The container is not upright.
    #[error(
        "robot {address}: the tilting joint is {alpha_deg:.1} degrees from its start angle, allowed are {tolerance_deg}; \
         bring the container upright with the pendant, or correct robot.start_joint_deg"
    )]
    TooFar {
        /// The robot's address.
        address: IpAddr,
        /// The measured alpha, degrees.
        alpha_deg: f32,
        /// The largest alpha that is allowed, degrees.
        tolerance_deg: f64,
    },
    /// The uploaded program gave no sign of life.
    #[error(
        "robot {address}: the program did not start within {} s; on an e-Series choose Remote Control, else see the pendant's log",
        PROGRAM_START.as_secs()
    )]
    NotStarted {
        /// The robot's address.
        address: IpAddr,
    },
    /// The program cannot keep the limits of the configuration.
    #[error(
        "limits: braking from rate_deg_s with acceleration_deg_s2, and a target's period, may take {most_s} s on this robot, not \
         {smoothing_s:.3} s; raise acceleration_deg_s2 or lower rate_deg_s"
    )]
    Limits {
        /// The longer of braking time and target period, s.
        smoothing_s: f64,
        /// The longest that the program averages over, s.
        most_s: f64,
    },
}

/// What the operator must do about a robot that may not be moved, for `reason`.
fn remedy(reason: EndReason) -> &'static str {
    match reason {
        EndReason::ProtectiveStop => "find the cause, then release it on the pendant",
        EndReason::EmergencyStop => "release the emergency stop, then switch the robot on and release its brakes",
        EndReason::SafetyStop => "clear it on the pendant",
        EndReason::SpeedReduced => "set it to 100 % on the pendant: it also stretches the times after which the robot acts by itself",
        _ => "switch it on and release its brakes",
    }
}
