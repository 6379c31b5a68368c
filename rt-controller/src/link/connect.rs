//! Connects the robot: it settles protocol, versions and recipes, and uploads the program, until a [`Session`] is ready for the loop.
//!
//! It runs on an ordinary thread, allocates, and blocks for seconds: for some 20 s with a robot that answers late each time. Every failure
//! is a [`LinkError`] whose one line says what to do; the caller shows it and tries again later. A running program is never replaced,
//! because it may be ours and bringing the container upright at this moment.

use std::io::{Read, Write};
use std::net::{IpAddr, SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use shared::os::now_ns;

use super::dialogue::{Dialogue, open};
use super::error::{ANSWER, LinkError, PROGRAM_START};
use super::health::{self, RUNTIME_PAUSED, RUNTIME_PAUSING, RUNTIME_PLAYING, RUNTIME_STOPPED, RUNTIME_STOPPING};
use super::{LinkOptions, ProgramState, RobotState, Session, program, wire};

/// The version of RTDE that is spoken (RTDE guide).
const PROTOCOL: u16 = 2;
/// The robot's real-time client interface. It takes programs, and streams state that is read and thrown away here.
const SCRIPT_PORT: u16 = 30003;
/// Number of bytes that must be read from [`SCRIPT_PORT`] before it is closed, or the program may be dropped (URScript manual).
const LEAST_READ: usize = 79;
/// PolyScope versions, major and minor, since which there are registers 24 to 47 for external clients (RTDE guide).
const UPPER_REGISTERS: [(u32, u32); 2] = [(3, 9), (5, 3)];
/// Number of control cycles a second of a CB3 (RTDE guide).
const CB3_HZ: f64 = 125.0;
/// Number of control cycles a second of an e-Series robot (RTDE guide).
const E_SERIES_HZ: f64 = 500.0;
/// How long one socket is read while the other one waits. Chosen by hand; no measurement is recorded.
const GLANCE: Duration = Duration::from_millis(20);

/// Connects, checks everything that can be checked, starts the program, and gives a session whose program waits for targets.
///
/// The first target is due within two seconds after this returns.
pub fn connect(options: &LinkOptions) -> Result<Session, LinkError> {
    let address = options.address;
    let mut dialogue = Dialogue::open(address)?;

    if !dialogue.ask(wire::PROTOCOL_VERSION, &[&PROTOCOL.to_be_bytes()], "the request for the protocol version", wire::accepted)? {
        return Err(LinkError::VersionRefused { address });
    }
    let version = dialogue.ask(wire::CONTROLLER_VERSION, &[], "the request for the controller's version", wire::controller_version)?;
    let [major, minor, ..] = version;
    // A generation later than those known here is taken to have what these have.
    if UPPER_REGISTERS.iter().any(|&(m, n)| major == m && minor < n) || major < 3 {
        return Err(LinkError::TooOld { address, major, minor });
    }
    let rate_hz = if major >= 5 { E_SERIES_HZ } else { CB3_HZ };
    let run = (now_ns() as i32 & i32::MAX).max(1);
    let program = program::text(options, 1.0 / rate_hz, run)?;

    let outputs = wire::output_names(options.register_base);
    let inputs = wire::input_names(options.register_base);
    let output_recipe = dialogue.agree(wire::SETUP_OUTPUTS, &rate_hz.to_be_bytes(), &outputs, "the request for the output recipe")?;
    let input_recipe = dialogue.agree(wire::SETUP_INPUTS, &[], &inputs, "the request for the input recipe")?;
    if !dialogue.ask(wire::START, &[], "the request to start", wire::accepted)? {
        return Err(LinkError::StartRefused { address, said: dialogue.said });
    }

    let mut state = RobotState::default();
    dialogue.next_state(output_recipe, &options.tilt, &mut state, ANSWER)?.ok_or_else(|| dialogue.no_answer("the request to start"))?;
    ready_for_program(options, &state)?;

    let mut upload = Upload::send(address, &program)?;
    let deadline = Instant::now() + PROGRAM_START;
    while state.program_run != run || state.runtime_state != RUNTIME_PLAYING || upload.read < LEAST_READ {
        upload.discard();
        let left = deadline.saturating_duration_since(Instant::now());
        // The wait is short, so that the other socket is read too.
        dialogue.next_state(output_recipe, &options.tilt, &mut state, left.min(GLANCE))?;
        if let Some(reason) = health::hindrance(&state) {
            return Err(LinkError::MayNotMove { address, reason });
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
    let at = dialogue.at;
    Session::new(dialogue.stream, dialogue.inbox, options.tilt, (output_recipe, input_recipe), version, state)
        .map_err(|e| LinkError::Lost { at, doing: "the hand-over to the loop", what: e.to_string() })
}

/// Whether the robot may move, runs no program and holds the container upright, so that the program may be uploaded.
fn ready_for_program(options: &LinkOptions, state: &RobotState) -> Result<(), LinkError> {
    let address = options.address;
    if let Some(reason) = health::hindrance(state) {
        return Err(LinkError::MayNotMove { address, reason });
    }
    match state.runtime_state {
        RUNTIME_STOPPING | RUNTIME_STOPPED => {}
        RUNTIME_PAUSING | RUNTIME_PAUSED => return Err(LinkError::ProgramPaused { address }),
        _ => return Err(LinkError::ProgramRunning { address }),
    }
    // The comparison is written so that an angle that is not a number counts as too far.
    if f64::from(state.alpha_deg.abs()) <= options.start_tolerance_deg { Ok(()) } else { Err(too_far(options, state)) }
}

/// The error of a joint that is too far from its start angle.
fn too_far(options: &LinkOptions, state: &RobotState) -> LinkError {
    LinkError::TooFar { address: options.address, alpha_deg: state.alpha_deg, tolerance_deg: options.start_tolerance_deg }
}

/// The connection that carries the program; closed when dropped.
struct Upload {
    stream: TcpStream,
    /// Number of bytes of the robot's state stream that were read and thrown away.
    read: usize,
}

impl Upload {
    /// Connects and sends `program`.
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
