//! Why there is no session with the robot: one line for the operator that says what to do.
//!
//! The connecting thread makes these errors, which allocates.

use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use shared::control::EndReason;

use super::hands::{Handover, SAFETY_MODE_SAFEGUARD_STOP, remedy};

/// How long a TCP connection, and each answer, may take. Chosen by hand; no measurement is recorded.
pub(super) const ANSWER: Duration = Duration::from_secs(2);
/// How long the program may take from its upload to its first sign of life. Chosen by hand; no measurement is recorded.
pub(super) const PROGRAM_START: Duration = Duration::from_secs(5);

/// Where PolyScope's menu has the services that can be switched off (Universal_Robots_ROS2_Driver, robot setup).
const SERVICES: &str = "Settings > Security > Services in PolyScope's menu";

/// Why there is no session with the robot.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LinkError {
    /// The robot's name is not known.
    #[error(
        "robot {name}: its address cannot be looked up: {what}; check robot.address, the network and its name server, or give the address itself"
    )]
    UnknownName {
        /// The name.
        name: String,
        /// The resolver's message.
        what: String,
    },
    /// There is no TCP connection.
    #[error("robot {at}: cannot connect: {what}; check robot.address, the cable, and that the robot is switched on")]
    Unreachable {
        /// Address and port.
        at: SocketAddr,
        /// The operating system's message.
        what: String,
    },
    /// The port for RTDE refuses connections on a robot that is there.
    #[error(
        "robot {at}: connection refused; check robot.address, and that PolyScope has started; from PolyScope 5.17 on, and on PolyScope X, \
         also switch on Real-Time Data Exchange (RTDE) under {SERVICES}"
    )]
    RtdeRefused {
        /// Address and port.
        at: SocketAddr,
    },
    /// None of the ports that take programs can be connected to, although the robot's RTDE port answers.
    #[error(
        "robot {address} answers on its RTDE port, but none of its ports for programs does ({closed}); switch on Secondary Client Interface \
         under {SERVICES}; Primary or Real-Time Client Interface do too"
    )]
    ScriptPortsClosed {
        /// The robot's address.
        address: IpAddr,
        /// The ports, each with the operating system's message.
        closed: String,
    },
    /// The robot closed the connection, or it broke.
    #[error("robot {at}: connection lost during {doing}: {what}; too many RTDE clients on the robot are one cause")]
    Lost {
        /// Address and port.
        at: SocketAddr,
        /// What was being done, as a noun.
        doing: &'static str,
        /// The operating system's message.
        what: String,
    },
    /// An answer did not come in time.
    #[error("robot {at}: no answer to {doing} within {} s; restart the robot's controller if this persists", ANSWER.as_secs())]
    NoAnswer {
        /// Address and port.
        at: SocketAddr,
        /// What was being done, as a noun.
        doing: &'static str,
    },
    /// The robot's bytes do not follow the protocol.
    #[error("robot {at}: unexpected bytes during {doing}; is this the RTDE port of a UR controller?{said}")]
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
    #[error("robot {address} refuses to start sending its state{said}; restart the robot's controller if this persists")]
    StartRefused {
        /// The robot's address.
        address: IpAddr,
        /// The robot's newest text message, if there was one.
        said: String,
    },
    /// The robot is in a state in which it must not be moved.
    #[error("robot {address}: {}; {}", reason.words(), remedy(*reason))]
    MayNotMove {
        /// The robot's address.
        address: IpAddr,
        /// Why it may not move.
        reason: EndReason,
        /// The mode of its safety system (RTDE guide).
        safety_mode: i32,
        /// Whether its arm has no power or its brakes on.
        unpowered: bool,
        /// Whether a program is there nevertheless: it runs, or is paused and can be resumed.
        program_there: bool,
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
    /// Somebody has, or had, the robot in hand; it is not taken unasked.
    #[error("robot {address}: {why}")]
    Handover {
        /// The robot's address.
        address: IpAddr,
        /// What shows it.
        why: Handover,
    },
    /// The container is not upright.
    #[error(
        "robot {address}: the tilting joint is {alpha_deg:.1} degrees from its start angle, at most {tolerance_deg} are allowed; \
         {remedy}"
    )]
    TooFar {
        /// The robot's address.
        address: IpAddr,
        /// The measured alpha, degrees.
        alpha_deg: f32,
        /// The largest alpha that is allowed, degrees.
        tolerance_deg: f64,
        /// What to do.
        remedy: &'static str,
    },
    /// The uploaded program gave no sign of life.
    #[error(
        "robot {address}: the program did not start within {} s; on an e-Series choose Remote Control, otherwise see the pendant's log",
        PROGRAM_START.as_secs()
    )]
    NotStarted {
        /// The robot's address.
        address: IpAddr,
    },
    /// The program cannot keep the limits of the configuration.
    #[error(
        "limits: braking from rate_deg_s with acceleration_deg_s2, and a target's period, may each take {most_s} s at most on this robot, \
         but one takes {smoothing_s:.3} s; raise acceleration_deg_s2 or lower rate_deg_s"
    )]
    Limits {
        /// The longer of braking time and target period, s.
        smoothing_s: f64,
        /// The longest that the program averages over, s.
        most_s: f64,
    },
}

impl LinkError {
    /// Whether a program was there, running or paused, in the state that the attempt saw; `None` if it saw none.
    pub fn program_there(&self) -> Option<bool> {
        match self {
            Self::ProgramRunning { .. } | Self::ProgramPaused { .. } => Some(true),
            Self::MayNotMove { program_there, .. } => Some(*program_there),
            Self::Handover { .. } | Self::TooFar { .. } => Some(false),
            _ => None,
        }
    }

    /// What shows that a person has, or had, the robot in hand, so that it must not be tried again until the operator asks; `None` if it may.
    pub fn handover(&self) -> Option<Handover> {
        match self {
            Self::Handover { why, .. } => Some(*why),
            Self::ProgramPaused { .. } => Some(Handover::Paused),
            Self::MayNotMove { reason: reason @ (EndReason::ProtectiveStop | EndReason::EmergencyStop | EndReason::InHand), .. } => {
                Some(Handover::Stopped(*reason))
            }
            // A violation, a fault or a recovery is cleared by a person, as in a session; only a safeguard that is closed is the word that work goes on.
            Self::MayNotMove { reason: EndReason::SafetyStop, safety_mode, .. } => {
                (*safety_mode != SAFETY_MODE_SAFEGUARD_STOP).then_some(Handover::Stopped(EndReason::SafetyStop))
            }
            _ => None,
        }
    }
}
