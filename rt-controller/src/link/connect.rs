//! Connecting to a robot: protocol, versions, recipes, the program's upload, until a [`Session`] is ready for the loop.
//!
//! Runs on an ordinary thread; blocks for a few seconds at most, allocates. Every way to fail is a [`LinkError`] whose one
//! line says what to do; the caller shows it and tries again later. A running program is never replaced: our own old one may
//! be bringing the container upright at this moment.

use std::io::{ErrorKind, Read, Write};
use std::net::{IpAddr, SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use shared::config::Config;
use shared::control::EndReason;
use shared::limits::Limits;
use shared::os::now_ns;

use super::health::{self, RUNTIME_PLAYING};
use super::wire::{self, Inbox, Outputs};
use super::{ProgramState, RobotState, Session, TiltJoint, program};

/// RTDE.
const RTDE_PORT: u16 = 30004;
/// The real-time client interface: takes programs, and streams state that is read and thrown away here.
const SCRIPT_PORT: u16 = 30003;
/// For a TCP connection, and for each answer.
const ANSWER: Duration = Duration::from_secs(2);
/// From the upload to the program's first sign of life.
const PROGRAM_START: Duration = Duration::from_secs(5);
/// What must be read from [`SCRIPT_PORT`] before it is closed, or the program may be dropped (script manual).
const LEAST_READ: usize = 79;
/// The first registers for external clients came with these versions.
const UPPER_REGISTERS: [(u32, u32); 2] = [(3, 9), (5, 3)];

/// Where the robot is and how its program shall move.
#[derive(Debug, Clone, PartialEq)]
pub struct LinkOptions {
    /// The UR controller's address.
    pub address: IpAddr,
    /// The joint that tilts the container.
    pub tilt: TiltJoint,
    /// Largest distance from the start angle at which the program starts, degrees.
    pub start_tolerance_deg: f64,
    /// First RTDE register used.
    pub register_base: u8,
    /// servoj lookahead time, s.
    pub lookahead_s: f64,
    /// servoj gain.
    pub gain: f64,
    /// Limits on alpha, kept by the program too.
    pub limits: Limits,
    /// Targets a second.
    pub rate_hz: f64,
}

impl LinkOptions {
    /// The link's part of the cell's configuration.
    pub fn new(config: &Config) -> Self {
        let robot = &config.robot;
        Self {
            address: robot.address,
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

/// Why there is no session with the robot.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum LinkError {
    /// No TCP connection.
    #[error("robot {at}: cannot connect: {what}; check robot.address, the cable, and that the robot is switched on")]
    Unreachable {
        /// Address and port.
        at: SocketAddr,
        /// The system's words.
        what: String,
    },
    /// The robot closed the connection or it broke.
    #[error("robot {at}: connection lost while {doing}: {what}; too many RTDE clients on the robot are one cause")]
    Lost {
        /// Address and port.
        at: SocketAddr,
        /// What was being done.
        doing: &'static str,
        /// The system's words.
        what: String,
    },
    /// An answer did not come in time.
    #[error("robot {at}: no answer to {doing} within {} s; restart the robot's controller if this stays", ANSWER.as_secs())]
    NoAnswer {
        /// Address and port.
        at: SocketAddr,
        /// What was being done.
        doing: &'static str,
    },
    /// What came is not what the protocol says.
    #[error("robot {at}: unexpected bytes in the answer to {doing}; is this the RTDE port of a UR controller?{said}")]
    Unexpected {
        /// Address and port.
        at: SocketAddr,
        /// What was being done.
        doing: &'static str,
        /// The robot's newest text message, if there was one.
        said: String,
    },
    /// RTDE protocol 2 refused.
    #[error("robot {address} refuses RTDE protocol 2; update PolyScope to 3.9 (CB3) or 5.3 (e-Series) or newer")]
    VersionRefused {
        /// The robot.
        address: IpAddr,
    },
    /// PolyScope without registers 24 to 47.
    #[error(
        "robot {address} runs PolyScope {major}.{minor}, which has no registers 24 to 47; update to 3.9 (CB3), 5.3 (e-Series) or newer"
    )]
    TooOld {
        /// The robot.
        address: IpAddr,
        /// Its version.
        major: u32,
        /// Its version.
        minor: u32,
    },
    /// A variable that this robot does not have.
    #[error("robot {address} does not know the RTDE variable {variable}; update PolyScope, or change robot.register_base")]
    NotFound {
        /// The robot.
        address: IpAddr,
        /// The variable.
        variable: String,
    },
    /// A variable that another client writes.
    #[error(
        "robot {address}: {variable} is in use by another RTDE client or a fieldbus (EtherNet/IP, PROFINET, MODBUS); \
         close it there, or change robot.register_base"
    )]
    InUse {
        /// The robot.
        address: IpAddr,
        /// The variable.
        variable: String,
    },
    /// A variable of another type than documented.
    #[error("robot {address}: {variable} has type {given} instead of {expected}; this version of PolyScope is not supported")]
    WrongType {
        /// The robot.
        address: IpAddr,
        /// The variable.
        variable: String,
        /// What the robot says.
        given: String,
        /// What the RTDE guide says.
        expected: &'static str,
    },
    /// The robot would not start its data.
    #[error("robot {address} refuses to start sending its state{said}; restart the robot's controller if this stays")]
    StartRefused {
        /// The robot.
        address: IpAddr,
        /// The robot's newest text message, if there was one.
        said: String,
    },
    /// The robot is not in a state to be moved.
    #[error("robot {address}: {}; {}", reason.words(), remedy(*reason))]
    NotWell {
        /// The robot.
        address: IpAddr,
        /// What is in the way.
        reason: EndReason,
    },
    /// A program is running.
    #[error("robot {address}: a program is running; wait until it has brought the container upright, or stop it on the pendant")]
    ProgramRunning {
        /// The robot.
        address: IpAddr,
    },
    /// A program is paused.
    #[error("robot {address}: a program is paused; resume it (ours then brings the container upright) or stop it on the pendant")]
    ProgramPaused {
        /// The robot.
        address: IpAddr,
    },
    /// The container is not upright.
    #[error(
        "robot {address}: the tilting joint is {alpha_deg:.1} degrees from its start angle, allowed are {tolerance_deg}; \
         bring the container upright with the pendant, or correct robot.start_joint_deg"
    )]
    TooFar {
        /// The robot.
        address: IpAddr,
        /// Where the joint is.
        alpha_deg: f32,
        /// Where it may be.
        tolerance_deg: f64,
    },
    /// The uploaded program did not come to life.
    #[error(
        "robot {address}: the program did not start within {} s; on an e-Series choose Remote Control, else see the pendant's log",
        PROGRAM_START.as_secs()
    )]
    NotStarted {
        /// The robot.
        address: IpAddr,
    },
    /// Limits that the program cannot keep.
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

/// What the operator does about a robot that is not well.
fn remedy(reason: EndReason) -> &'static str {
    match reason {
        EndReason::ProtectiveStop => "find the cause, then release it on the pendant",
        EndReason::EmergencyStop => "release the emergency stop, then switch the robot on and release its brakes",
        EndReason::SafetyStop => "clear it on the pendant",
        EndReason::SpeedReduced => "set it to 100 % on the pendant: it also stretches the times after which the robot acts by itself",
        _ => "switch it on and release its brakes",
    }
}

/// Connects, checks everything that can be checked, starts the program, and gives a session whose program waits for targets.
///
/// The first target is due within two seconds after this returns.
pub fn connect(options: &LinkOptions) -> Result<Session, LinkError> {
    let address = options.address;
    let mut setup = Setup::open(address)?;

    let payload = setup.ask(wire::PROTOCOL_VERSION, &[&2u16.to_be_bytes()], "the protocol version", wire::accepted)?;
    if !payload {
        return Err(LinkError::VersionRefused { address });
    }
    let version = setup.ask(wire::CONTROLLER_VERSION, &[], "the controller's version", wire::controller_version)?;
    let [major, minor, ..] = version;
    // Versions of later generations than known here have what these had.
    if UPPER_REGISTERS.iter().any(|&(m, n)| major == m && minor < n) || major < 3 {
        return Err(LinkError::TooOld { address, major, minor });
    }
    let (rate_hz, cycle_s): (f64, f64) = if major >= 5 { (500.0, 0.002) } else { (125.0, 0.008) };
    let run = (now_ns() as i32 & i32::MAX).max(1);
    let program = program::text(options, cycle_s, run)?;

    let outputs = wire::output_names(options.register_base);
    let inputs = wire::input_names(options.register_base);
    let output_recipe = setup.agree(wire::SETUP_OUTPUTS, &rate_hz.to_be_bytes(), &outputs, "the output recipe")?;
    let input_recipe = setup.agree(wire::SETUP_INPUTS, &[], &inputs, "the input recipe")?;
    if !setup.ask(wire::START, &[], "start", wire::accepted)? {
        return Err(LinkError::StartRefused { address, said: setup.said });
    }

    let mut state = RobotState::default();
    setup.next_state(output_recipe, &options.tilt, &mut state, ANSWER)?.ok_or_else(|| setup.no_answer("start"))?;
    ready_for_program(options, &state)?;

    let mut upload = Upload::send(address, &program)?;
    let deadline = Instant::now() + PROGRAM_START;
    while state.program_run != run || state.runtime_state != RUNTIME_PLAYING || upload.read < LEAST_READ {
        upload.discard();
        let left = deadline.saturating_duration_since(Instant::now());
        // Short waits, so that the other socket is read too.
        setup.next_state(output_recipe, &options.tilt, &mut state, left.min(Duration::from_millis(20)))?;
        if let Some(reason) = health::hindrance(&state) {
            return Err(LinkError::NotWell { address, reason });
        }
        if state.program_run == run && state.program_state == ProgramState::TooFar {
            return Err(too_far(options, &state));
        }
        if left.is_zero() {
            return Err(LinkError::NotStarted { address });
        }
    }
    let now = now_ns();
    (state.received_at_ns, state.advanced_at_ns, state.answered_at_ns) = (now, now, now);
    let at = setup.at;
    Session::new(setup.stream, setup.inbox, options.tilt, (output_recipe, input_recipe), version, state).map_err(|e| LinkError::Lost {
        at,
        doing: "handing over",
        what: e.to_string(),
    })
}

fn ready_for_program(options: &LinkOptions, state: &RobotState) -> Result<(), LinkError> {
    let address = options.address;
    if let Some(reason) = health::hindrance(state) {
        return Err(LinkError::NotWell { address, reason });
    }
    match state.runtime_state {
        // Stopping, stopped.
        0 | 1 => {}
        3 | 4 => return Err(LinkError::ProgramPaused { address }),
        _ => return Err(LinkError::ProgramRunning { address }),
    }
    // Written so that an angle that is not a number is too far.
    if f64::from(state.alpha_deg.abs()) <= options.start_tolerance_deg { Ok(()) } else { Err(too_far(options, state)) }
}

fn too_far(options: &LinkOptions, state: &RobotState) -> LinkError {
    LinkError::TooFar { address: options.address, alpha_deg: state.alpha_deg, tolerance_deg: options.start_tolerance_deg }
}

/// The RTDE connection while it is being set up, with blocking reads.
struct Setup {
    at: SocketAddr,
    stream: TcpStream,
    inbox: Inbox,
    /// The robot's newest text message, ready to be put behind an error.
    said: String,
}

impl Setup {
    fn open(address: IpAddr) -> Result<Self, LinkError> {
        let at = SocketAddr::new(address, RTDE_PORT);
        let stream = open(at)?;
        Ok(Self { at, stream, inbox: Inbox::new(), said: String::new() })
    }

    /// Sends a request and gives its answer, read by `read`.
    fn ask<T>(&mut self, kind: u8, payload: &[&[u8]], doing: &'static str, read: impl Fn(&[u8]) -> Option<T>) -> Result<T, LinkError> {
        let mut buffer = [0; 1024];
        let request = wire::encode(kind, payload, &mut buffer).unwrap_or_default();
        self.stream.write_all(request).map_err(|e| self.lost(doing, &e))?;
        let answer = self.wait(doing, ANSWER, |frame| (frame.kind == kind).then(|| read(frame.payload)))?;
        answer.ok_or_else(|| self.no_answer(doing))?.ok_or_else(|| self.unexpected(doing))
    }

    /// Sets a recipe up and gives its id.
    fn agree(&mut self, kind: u8, head: &[u8], variables: &[(String, &'static str)], doing: &'static str) -> Result<u8, LinkError> {
        let names: Vec<&str> = variables.iter().map(|(name, _)| name.as_str()).collect();
        let names = names.join(",");
        let (id, types) =
            self.ask(kind, &[head, names.as_bytes()], doing, |payload| wire::recipe(payload).map(|(id, types)| (id, types.to_owned())))?;
        // A trailing comma is common among RTDE programs.
        let types: Vec<&str> = types.strip_suffix(',').unwrap_or(&types).split(',').collect();
        let address = self.at.ip();
        if types.len() != variables.len() {
            return Err(self.unexpected(doing));
        }
        for ((variable, expected), given) in variables.iter().zip(types) {
            let variable = variable.clone();
            match given.trim() {
                "NOT_FOUND" => return Err(LinkError::NotFound { address, variable }),
                "IN_USE" => return Err(LinkError::InUse { address, variable }),
                given if given != *expected => return Err(LinkError::WrongType { address, variable, given: given.into(), expected }),
                _ => {}
            }
        }
        // Id 0 stands for a recipe that is not valid.
        if id == 0 { Err(self.unexpected(doing)) } else { Ok(id) }
    }

    /// Waits for the next DATA_PACKAGE and fills `state` from it; `None` if none came in time.
    fn next_state(&mut self, recipe: u8, tilt: &TiltJoint, state: &mut RobotState, within: Duration) -> Result<Option<()>, LinkError> {
        let doing = "its state";
        let filled = self.wait(doing, within, |frame| {
            (frame.kind == wire::DATA).then(|| Outputs::new_checked(frame.payload, recipe).map(|outputs| outputs.fill(tilt, state)))
        })?;
        match filled {
            None => Ok(None),
            Some(Some(())) => Ok(Some(())),
            Some(None) => Err(self.unexpected(doing)),
        }
    }

    /// Reads frames until `pick` picks one; `None` after `within`. Text frames are remembered, others passed over: data and
    /// text may come before an answer.
    fn wait<T>(
        &mut self,
        doing: &'static str,
        within: Duration,
        mut pick: impl FnMut(&wire::Frame<'_>) -> Option<T>,
    ) -> Result<Option<T>, LinkError> {
        let deadline = Instant::now() + within;
        loop {
            loop {
                match self.inbox.next_frame() {
                    Ok(None) => break,
                    Ok(Some(frame)) => {
                        if let Some(found) = pick(&frame) {
                            return Ok(Some(found));
                        }
                        if let (wire::TEXT, Some((_, message))) = (frame.kind, wire::text(frame.payload)) {
                            self.said = format!("; the robot said: {}", printable(message));
                        }
                    }
                    Err(_) => return Err(self.unexpected(doing)),
                }
            }
            let left = deadline.saturating_duration_since(Instant::now());
            if left.is_zero() {
                return Ok(None);
            }
            // A timeout of zero would mean none.
            let timeout = left.max(Duration::from_millis(1));
            self.stream.set_read_timeout(Some(timeout)).map_err(|e| self.lost(doing, &e))?;
            match self.stream.read(self.inbox.space()) {
                Ok(0) => return Err(self.lost(doing, &ErrorKind::ConnectionAborted.into())),
                Ok(n) => self.inbox.filled(n),
                Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted) => {}
                Err(e) => return Err(self.lost(doing, &e)),
            }
        }
    }

    fn lost(&self, doing: &'static str, e: &std::io::Error) -> LinkError {
        LinkError::Lost { at: self.at, doing, what: e.kind().to_string() }
    }

    fn no_answer(&self, doing: &'static str) -> LinkError {
        LinkError::NoAnswer { at: self.at, doing }
    }

    fn unexpected(&self, doing: &'static str) -> LinkError {
        LinkError::Unexpected { at: self.at, doing, said: self.said.clone() }
    }
}

/// The connection that carries the program; closed when dropped.
struct Upload {
    stream: TcpStream,
    /// Bytes of the robot's state stream read and thrown away.
    read: usize,
}

impl Upload {
    fn send(address: IpAddr, program: &str) -> Result<Self, LinkError> {
        let at = SocketAddr::new(address, SCRIPT_PORT);
        let mut stream = open(at)?;
        let lost = |e: std::io::Error| LinkError::Lost { at, doing: "the program's upload", what: e.kind().to_string() };
        stream.write_all(program.as_bytes()).map_err(lost)?;
        stream.set_nonblocking(true).map_err(lost)?;
        Ok(Self { stream, read: 0 })
    }

    /// Reads what has arrived. Errors do not matter: the program's sign of life is what counts.
    fn discard(&mut self) {
        let mut buffer = [0; 4096];
        while let Ok(n @ 1..) = self.stream.read(&mut buffer) {
            self.read += n;
        }
    }
}

fn open(at: SocketAddr) -> Result<TcpStream, LinkError> {
    let open = || {
        let stream = TcpStream::connect_timeout(&at, ANSWER)?;
        stream.set_nodelay(true)?;
        stream.set_write_timeout(Some(ANSWER))?;
        Ok(stream)
    };
    open().map_err(|e: std::io::Error| LinkError::Unreachable { at, what: e.kind().to_string() })
}

/// Text of a robot, for one line of ours.
fn printable(message: &[u8]) -> String {
    String::from_utf8_lossy(message).chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}
