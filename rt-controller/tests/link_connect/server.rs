//! A small scripted server that answers as a UR controller would, on real sockets; each test has its own loopback address, because the ports
//! of a UR controller are fixed. It runs in a thread of the test, allocates, and panics as tests do.

use std::io::{ErrorKind, Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::thread;
use std::time::Duration;

use rt_controller::link::hands::Before;
use rt_controller::link::network::{Network, System};
use rt_controller::link::{LinkError, LinkOptions, ProgramState, Session, TiltJoint, connect_over};
use shared::config::Joint;
use shared::limits::Limits;

pub const OUTPUT_TYPES: &str = "DOUBLE,VECTOR6D,VECTOR6D,VECTOR6D,INT32,INT32,UINT32,UINT32,INT32,INT32,INT32,DOUBLE,DOUBLE";

/// Names and types of what a robot may not know.
const EXTRAS: [(&str, &str); 5] = [
    ("robot_status_bits", "UINT32"),
    ("speed_scaling", "DOUBLE"),
    ("payload", "DOUBLE"),
    ("payload_cog", "VECTOR3D"),
    ("script_control_line", "UINT32"),
];

/// What the server says; the defaults are those of a robot that may be moved.
#[derive(Clone)]
pub struct Robot {
    pub version_accepted: u8,
    pub version: [u32; 4],
    pub outputs: (u8, String),
    pub inputs: (u8, String),
    pub start_accepted: u8,
    /// What is sent before each answer.
    pub chatter: Vec<u8>,
    /// Number of bytes that are sent at a time.
    pub piece: usize,
    /// The request at which the RTDE connection is closed instead of being answered.
    pub closes_at: Option<u8>,
    /// The request that is never answered.
    pub deaf_to: Option<u8>,
    pub robot_mode: i32,
    pub safety_mode: i32,
    pub runtime_state: u32,
    pub joint_rad: f64,
    pub speed_fraction: f64,
    /// Those of `EXTRAS` that this robot does not know.
    pub unknown: &'static [&'static str],
    pub status_bits: u32,
    pub control_line: u32,
    /// Rate of the base, rad/s, which moves accordingly.
    pub base_rad_s: f64,
    /// What stands in the program's registers before the upload: state, number of the target, run.
    pub registers: (ProgramState, i32, i32),
    /// The ports for programs that are open.
    pub script_ports: &'static [u16],
    /// Whether the first program only stops a robot that said "paused".
    pub stops_first: bool,
    /// What the program does once it has been uploaded.
    pub program: ProgramState,
    /// Whether an uploaded program starts.
    pub starts: bool,
    /// Length of a control cycle, ms, and how many of them it sends its state for while it waits for a program. Then it falls silent.
    pub cycle_ms: u64,
    pub cycles: u32,
    /// Whether another program has been started.
    pub other_plays: Arc<AtomicBool>,
}

impl Default for Robot {
    fn default() -> Self {
        Self {
            version_accepted: 1,
            version: [3, 15, 8, 106339],
            outputs: (1, OUTPUT_TYPES.into()),
            inputs: (2, "INT32,INT32,DOUBLE".into()),
            start_accepted: 1,
            chatter: Vec::new(),
            piece: usize::MAX,
            closes_at: None,
            deaf_to: None,
            robot_mode: 7,
            safety_mode: 1,
            runtime_state: 1,
            joint_rad: 0.01,
            speed_fraction: 1.0,
            unknown: &[],
            status_bits: 1,
            control_line: 0,
            base_rad_s: 0.0,
            registers: (ProgramState::TimedOut, 500, 1),
            script_ports: &[30003],
            stops_first: false,
            program: ProgramState::Ready,
            starts: true,
            cycle_ms: 8,
            cycles: u32::MAX,
            other_plays: Arc::default(),
        }
    }
}

/// For so many cycles a robot waits for a program: longer than any test needs.
const WAITS_CYCLES: u32 = 4000;

/// The server while a test runs.
pub struct Server {
    pub options: LinkOptions,
    pub robot: Robot,
    pub rtde: TcpListener,
    pub scripts: Vec<TcpListener>,
}

/// What the server saw, and its end of the RTDE connection.
pub struct Seen {
    pub requests: Vec<u8>,
    /// Payload of the output recipe's request.
    pub outputs: Vec<u8>,
    pub program: String,
    pub rtde: TcpStream,
}

pub fn packet(kind: u8, payload: &[u8]) -> Vec<u8> {
    let mut packet = ((payload.len() + 3) as u16).to_be_bytes().to_vec();
    packet.push(kind);
    packet.extend(payload);
    packet
}

pub fn text(message: &str) -> Vec<u8> {
    let mut payload = vec![message.len() as u8];
    payload.extend(message.as_bytes());
    payload.extend([0, 2]);
    packet(b'M', &payload)
}

/// A DATA_PACKAGE: the clock, the joint, the program's registers.
pub fn data(robot: &Robot, timestamp_s: f64, program: ProgramState, echo: i32, run: i32) -> Vec<u8> {
    let mut payload = vec![robot.outputs.0];
    payload.extend(timestamp_s.to_be_bytes());
    let base_rad = robot.base_rad_s * timestamp_s;
    for (base, value) in [(base_rad, robot.joint_rad), (base_rad, robot.joint_rad), (robot.base_rad_s, 0.0)] {
        payload.extend([base, 0.0, 0.0, 0.0, 0.0, value].map(f64::to_be_bytes).concat());
    }
    payload.extend([robot.robot_mode, robot.safety_mode].map(i32::to_be_bytes).concat());
    let runtime_state = if robot.other_plays.load(Relaxed) { 2 } else { robot.runtime_state };
    payload.extend([1, runtime_state].map(u32::to_be_bytes).concat());
    payload.extend([program as i32, echo, run].map(i32::to_be_bytes).concat());
    payload.extend([robot.joint_rad, robot.speed_fraction].map(f64::to_be_bytes).concat());
    let values = [
        robot.status_bits.to_be_bytes().to_vec(),
        0.5f64.to_be_bytes().to_vec(),
        1.2f64.to_be_bytes().to_vec(),
        [0.0, 0.01, 0.1].map(f64::to_be_bytes).concat(),
        robot.control_line.to_be_bytes().to_vec(),
    ];
    for ((name, _), value) in EXTRAS.iter().zip(values) {
        if !robot.unknown.contains(name) {
            payload.extend(value);
        }
    }
    packet(b'U', &payload)
}

impl Server {
    pub fn new(last: u8, robot: Robot) -> Self {
        let address = Ipv4Addr::new(127, 41, 0, last);
        let options = LinkOptions {
            address: address.into(),
            tilt: TiltJoint { joint: Joint::Wrist3, start_deg: 0.0, direction: 1.0 },
            start_tolerance_deg: 2.0,
            register_base: 24,
            lookahead_s: 0.05,
            gain: 600.0,
            limits: Limits::default(),
            rate_hz: 30.0,
        };
        let rtde = TcpListener::bind((address, 30004)).unwrap();
        let scripts = robot.script_ports.iter().map(|port| TcpListener::bind((address, *port)).unwrap()).collect();
        Self { options, robot, rtde, scripts }
    }

    /// Connects to the server and gives both ends.
    pub fn meet(self) -> (Result<Session, LinkError>, Option<Seen>) {
        self.meet_after(&Before::default())
    }

    /// The same, for a controller that knows the robot from before.
    pub fn meet_after(self, before: &Before) -> (Result<Session, LinkError>, Option<Seen>) {
        self.meet_over(&System, before)
    }

    /// The same over another network.
    pub fn meet_over(self, network: &dyn Network, before: &Before) -> (Result<Session, LinkError>, Option<Seen>) {
        let (options, ports) = (self.options.clone(), self.robot.script_ports);
        let served = thread::spawn(move || self.serve().ok());
        let session = connect_over(network, &options, &mut before.clone());
        // This frees a server whose script port was never connected to.
        for port in ports {
            let _ = TcpStream::connect((options.address, *port));
        }
        (session, served.join().unwrap())
    }

    /// Waits for a connection to any of the open ports, and for a program on it. While it waits, the robot's state goes on.
    fn accept_program(&self, rtde: &mut TcpStream, timestamp_s: &mut f64) -> std::io::Result<TcpStream> {
        for listener in &self.scripts {
            listener.set_nonblocking(true)?;
        }
        let mut script: Option<TcpStream> = None;
        for cycle in 0..WAITS_CYCLES {
            script = script.or_else(|| self.scripts.iter().find_map(|listener| listener.accept().ok()).map(|(stream, _)| stream));
            if let Some(stream) = &script {
                stream.set_nonblocking(true)?;
                match stream.peek(&mut [0]) {
                    Ok(0) => return Err(ErrorKind::UnexpectedEof.into()),
                    Ok(_) => {
                        stream.set_nonblocking(false)?;
                        return stream.try_clone();
                    }
                    Err(_) => {}
                }
            }
            *timestamp_s += self.robot.cycle_ms as f64 / 1000.0;
            let (state, echo, run) = self.robot.registers;
            if cycle < self.robot.cycles {
                send_in_pieces(rtde, &data(&self.robot, *timestamp_s, state, echo, run), self.robot.piece)?;
            }
            thread::sleep(Duration::from_millis(self.robot.cycle_ms));
        }
        Err(ErrorKind::TimedOut.into())
    }

    pub fn serve(self) -> std::io::Result<Seen> {
        let robot = self.robot.clone();
        let (mut rtde, _) = self.rtde.accept()?;
        rtde.set_nodelay(true)?;
        let (mut requests, mut outputs) = (Vec::new(), Vec::new());
        while requests.last() != Some(&b'S') {
            let mut head = [0; 3];
            rtde.read_exact(&mut head)?;
            let mut payload = vec![0; usize::from(u16::from_be_bytes([head[0], head[1]])) - 3];
            rtde.read_exact(&mut payload)?;
            requests.push(head[2]);
            if head[2] == b'O' {
                outputs.clone_from(&payload);
            }
            if robot.closes_at == Some(head[2]) {
                return Err(ErrorKind::ConnectionAborted.into());
            }
            let recipe = |(id, types): &(u8, String)| [&[*id], types.as_bytes()].concat();
            let asked = String::from_utf8_lossy(&payload).into_owned();
            let extras: String = EXTRAS
                .iter()
                .filter(|(name, _)| asked.split(',').any(|n| n == *name))
                .map(|(name, kind)| format!(",{}", if robot.unknown.contains(name) { "NOT_FOUND" } else { kind }))
                .collect();
            let answer = match head[2] {
                b'V' => vec![robot.version_accepted],
                b'v' => robot.version.map(u32::to_be_bytes).concat(),
                b'O' => recipe(&(if extras.contains("NOT_FOUND") { 0 } else { robot.outputs.0 }, robot.outputs.1.clone() + &extras)),
                b'I' => recipe(&robot.inputs),
                _ => vec![robot.start_accepted],
            };
            let mut bytes = robot.chatter.clone();
            if robot.deaf_to != Some(head[2]) {
                bytes.extend(packet(head[2], &answer));
            }
            send_in_pieces(&mut rtde, &bytes, robot.piece)?;
        }
        let (state, echo, run_before) = robot.registers;
        let mut now_s = 1.0;
        send_in_pieces(&mut rtde, &data(&robot, now_s, state, echo, run_before), robot.piece)?;
        let mut script = self.accept_program(&mut rtde, &mut now_s)?;
        let mut program = read_program(&mut script)?;
        if robot.stops_first {
            let stopped = Robot { runtime_state: 1, ..robot.clone() };
            send_in_pieces(&mut rtde, &data(&stopped, now_s + 0.008, state, echo, run_before), robot.piece)?;
            let listening = Self { robot: stopped, options: self.options.clone(), rtde: self.rtde.try_clone()?, scripts: self.scripts };
            script = listening.accept_program(&mut rtde, &mut now_s)?;
            program = read_program(&mut script)?;
        }
        let run = program.lines().find_map(|l| l.strip_prefix("  RUN = ")).map_or(0, |v| v.parse().unwrap());
        // A few cycles in which the program plays but has written nothing: what old programs left stands in the registers.
        let playing = Robot { runtime_state: if robot.starts { 2 } else { 1 }, ..robot.clone() };
        for cycle in 1..4 {
            send_in_pieces(&mut rtde, &data(&playing, 100.0 + 0.008 * f64::from(cycle), ProgramState::Ready, 500, 1), robot.piece)?;
        }
        if robot.starts {
            send_in_pieces(&mut rtde, &data(&playing, 100.04, robot.program, 500, run), robot.piece)?;
        }
        Ok(Seen { requests, outputs, program, rtde })
    }
}

/// Sends some state, as each script port does, and reads a program.
fn read_program(script: &mut TcpStream) -> std::io::Result<String> {
    script.write_all(&[0; 1108])?;
    let mut program = Vec::new();
    let mut buffer = [0; 4096];
    while !program.ends_with(b"\nend\n") {
        match script.read(&mut buffer)? {
            0 => break,
            n => program.extend(&buffer[..n]),
        }
    }
    Ok(String::from_utf8(program).unwrap())
}

fn send_in_pieces(stream: &mut TcpStream, bytes: &[u8], piece: usize) -> std::io::Result<()> {
    bytes.chunks(piece.min(bytes.len().max(1))).try_for_each(|piece| stream.write_all(piece))
}
