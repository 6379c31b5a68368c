//! The robot link: it sends targets for the tilting joint to a UR controller, and gets its state back, over RTDE (TCP 30004).
//!
//! | part | thread | allocates |
//! |---|---|---|
//! | [`connect()`] | an ordinary thread | yes |
//! | [`Session::poll`], [`Session::send`] | the controller's loop | no |
//! | [`health::check`] | the controller's loop (pure) | no |
//! | [`hands`] | an ordinary thread (pure) | no |
//! | dropping a [`Session`] | an ordinary thread | frees |
//!
//! An ordinary thread hands a [`Session`] over to the loop. The loop owns it until [`health::check`] names a reason, or `poll` or `send`
//! fails; then it stops sending and hands the session back. Dropping the session sends a last [`Mode::Stop`] or [`Mode::Abandon`].
//! Silence always stops the robot: the program on it (`robot/pour.script`) brings the container upright by itself 100 ms after the last
//! target. Each failure is a [`LinkError`] or a [`Lost`], one line for the operator.
//!
//! Registers, counted from `robot.register_base` (b); all are RTDE general purpose registers:
//!
//! | register | holds |
//! |---|---|
//! | `input_int_register_b` | number of the target, 1, 2, 3, ... within a session |
//! | `input_int_register_b+1` | what to do with it, a [`Mode`] code |
//! | `input_double_register_b` | target angle of the tilting joint, rad |
//! | `output_int_register_b` | what the program is doing, a [`ProgramState`] code |
//! | `output_int_register_b+1` | number of the newest target that the program has read |
//! | `output_int_register_b+2` | the run number of this upload; it tells a new program's registers from what an old one left |
//! | `output_double_register_b` | angle that the program commands to servoj, rad |

pub mod connect;
mod dialogue;
mod error;
pub mod hands;
pub mod health;
pub mod network;
pub mod payload;
pub mod program;
pub mod session;
mod upload;
pub mod wire;

pub use connect::{Seen, connect, connect_after, connect_over, look};
pub use error::LinkError;
pub use session::{Lost, Session};

use std::net::IpAddr;

use shared::config::{Config, Joint, RobotConfig};
use shared::limits::Limits;

/// What the program on the robot is to do; it is the code in `input_int_register_b+1`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(i32)]
pub enum Mode {
    /// Brakes to rest and stays there; the target is ignored.
    Hold = 1,
    /// Follows the targets.
    Stream = 2,
    /// Comes upright at the return rate, and then ends the program.
    Stop = 3,
    /// Like [`Mode::Stop`], for a robot that stopped by itself in mid-motion: when its program is resumed, it begins at rest from where
    /// the joint then is.
    Abandon = 4,
}

/// What the program on the robot says it is doing; it is the code in `output_int_register_b`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[repr(i32)]
pub enum ProgramState {
    /// The program has written nothing yet, or a code that this version does not know.
    #[default]
    Unknown = 0,
    /// The program has started and waits for the first target.
    Ready = 1,
    /// It follows the targets.
    Following = 2,
    /// It holds still on command.
    Holding = 3,
    /// No new target came for 100 ms; the container is on its way upright.
    Returning = 4,
    /// The program has ended, upright, after [`ProgramState::Returning`].
    TimedOut = 5,
    /// The container is on its way upright on command.
    Stopping = 6,
    /// The program has ended, upright, after [`ProgramState::Stopping`].
    Stopped = 7,
    /// The program has ended without moving, because the joint was too far from the start angle.
    TooFar = 8,
    /// The joint was not where it was commanded to be; it is on its way upright from where it is.
    OffTrack = 9,
    /// The program has ended, upright, after [`ProgramState::OffTrack`].
    OffTrackEnded = 10,
    /// The program has ended without moving, because no first target came within two seconds.
    Unused = 11,
}

impl ProgramState {
    /// The state with this code; codes of other versions read as [`ProgramState::Unknown`].
    pub fn from_code(code: i32) -> Self {
        use ProgramState::*;
        [Ready, Following, Holding, Returning, TimedOut, Stopping, Stopped, TooFar, OffTrack, OffTrackEnded, Unused]
            .into_iter()
            .find(|s| *s as i32 == code)
            .unwrap_or(Unknown)
    }

    /// Whether targets are taken in this state.
    pub fn takes_targets(self) -> bool {
        matches!(self, Self::Ready | Self::Following | Self::Holding)
    }
}

/// The newest known state of the robot.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct RobotState {
    /// The robot's clock, s since its controller started.
    pub timestamp_s: f64,
    /// Measured alpha, degrees from upright.
    pub alpha_deg: f32,
    /// Measured rate of alpha, degrees/s.
    pub alpha_rate_deg_s: f32,
    /// Alpha that the robot's servo steers to at this moment (`target_q`), degrees.
    pub alpha_target_deg: f32,
    /// Alpha that the program last gave to servoj, degrees.
    pub alpha_command_deg: f32,
    /// RTDE's `robot_mode`; 7 is running.
    pub robot_mode: i32,
    /// RTDE's `safety_mode`; 1 is normal, 2 is reduced.
    pub safety_mode: i32,
    /// RTDE's `safety_status_bits`.
    pub safety_bits: u32,
    /// RTDE's `runtime_state`; 2 is playing.
    pub runtime_state: u32,
    /// RTDE's `target_speed_fraction`: the pendant's speed slider, 0 to 1.
    pub speed_fraction: f64,
    /// Measured angles of all joints, base to wrist 3, rad.
    pub joints_rad: [f64; 6],
    /// Measured rates of all joints, rad/s.
    pub joint_rates_rad_s: [f64; 6],
    /// RTDE's `robot_status_bits`; `None` if the robot does not know the variable, as with all that follow.
    pub status_bits: Option<u32>,
    /// RTDE's `speed_scaling`: the share of its speed that the robot leaves by itself, 0 to 1; the slider is not in it.
    pub speed_scaling: Option<f64>,
    /// RTDE's `payload`: the mass that the robot was told that its tool carries, kg.
    pub payload_kg: Option<f64>,
    /// RTDE's `payload_cog`: that mass's centre of gravity, m from the flange.
    pub payload_cog_m: Option<[f64; 3]>,
    /// RTDE's `script_control_line`: the line that a program stands at; 0 without one.
    pub control_line: Option<u32>,
    /// What the program says it is doing.
    pub program_state: ProgramState,
    /// Run number of the program that wrote the registers.
    pub program_run: i32,
    /// Number of the newest target that the program has read.
    pub sequence_echo: i32,
    /// Number of the newest target that was sent; 0 before the first.
    pub sequence_sent: i32,
    /// Whether this controller itself was silent so long, within the last second, that the larger part of the program's patience was used up
    /// before the network came into it.
    pub was_silent: bool,
    /// When the oldest target was sent that the program has not read, CLOCK_MONOTONIC ns; 0 if it has read all of them.
    pub unread_since_ns: u64,
    /// When this state was taken from the socket, CLOCK_MONOTONIC ns.
    pub received_at_ns: u64,
    /// When the robot's clock was last seen to advance, CLOCK_MONOTONIC ns.
    pub advanced_at_ns: u64,
    /// When the program was last seen to keep up with the targets sent, CLOCK_MONOTONIC ns.
    pub answered_at_ns: u64,
}

/// Which joint tilts the container, and where it is at a given alpha: q = start + direction * alpha.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TiltJoint {
    /// Which joint.
    pub joint: Joint,
    /// Its angle at alpha = 0, degrees.
    pub start_deg: f64,
    /// +1 or -1.
    pub direction: f64,
}

impl TiltJoint {
    /// The joint named in `[robot]`.
    pub fn new(robot: &RobotConfig) -> Self {
        Self { joint: robot.joint, start_deg: robot.start_joint_deg, direction: robot.direction }
    }

    /// Joint angle in rad at `alpha_deg`.
    pub fn joint_rad(&self, alpha_deg: f32) -> f64 {
        (self.start_deg + self.direction * f64::from(alpha_deg)).to_radians()
    }

    /// Alpha in degrees at a joint angle in rad.
    pub fn alpha_deg(&self, joint_rad: f64) -> f32 {
        (self.direction * (joint_rad.to_degrees() - self.start_deg)) as f32
    }
}

/// Where the robot is, and how the program on it is to move.
#[derive(Debug, Clone, PartialEq)]
pub struct LinkOptions {
    /// The UR controller's address.
    pub address: IpAddr,
    /// The joint that tilts the container.
    pub tilt: TiltJoint,
    /// Largest distance of the joint from its start angle at which the program starts, degrees.
    pub start_tolerance_deg: f64,
    /// First RTDE register that is used.
    pub register_base: u8,
    /// Lookahead time of the robot's servoj command, s.
    pub lookahead_s: f64,
    /// Gain of the robot's servoj command.
    pub gain: f64,
    /// Limits on alpha, which the program keeps too.
    pub limits: Limits,
    /// Targets a second.
    pub rate_hz: f64,
}

impl LinkOptions {
    /// The link's part of the cell's configuration, with the robot at `address`.
    pub fn new(config: &Config, address: IpAddr) -> Self {
        let robot = &config.robot;
        Self {
            address,
            tilt: TiltJoint::new(robot),
            start_tolerance_deg: robot.start_tolerance_deg,
            register_base: robot.register_base,
            lookahead_s: robot.lookahead_s,
            gain: robot.gain,
            limits: config.limits,
            rate_hz: config.controller.rate_hz,
        }
    }
}
