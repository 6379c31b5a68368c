//! The client interfaces 30001 to 30003: programs in, state out.
//!
//! Pure; on the controller's thread. 30001 and 30002 send packages 10 times a second, 30003 one frame a control cycle; the
//! layouts are those of UR's client interface tables. A program is text: bare lines run as one-line programs, `def` and
//! `sec` reach up to the `end` in column 0.

use super::machine::{LogKind, LogLine, Machine, RobotMode, RuntimeState, SafetyMode};
use super::script::MAX_SOURCE_BYTES;
use super::variables::{Output, Series};

/// Cuts a client's text into programs.
#[derive(Debug, Default)]
pub struct Assembler {
    line: Vec<u8>,
    program: Vec<u8>,
    overlong: bool,
}

impl Assembler {
    /// Takes received bytes; gives the programs that are complete. Err: text without an end, thrown away.
    pub fn feed(&mut self, bytes: &[u8]) -> Vec<Result<String, &'static str>> {
        let mut done = Vec::new();
        for &byte in bytes {
            if byte != b'\n' {
                if self.line.len() + self.program.len() < MAX_SOURCE_BYTES {
                    self.line.push(byte);
                } else {
                    self.overlong = true;
                }
                continue;
            }
            done.extend(self.end_of_line());
        }
        done
    }

    /// The client closed its side: a last line needs no line end.
    pub fn finish(&mut self) -> Option<Result<String, &'static str>> {
        if self.line.is_empty() { None } else { self.end_of_line() }
    }

    fn end_of_line(&mut self) -> Option<Result<String, &'static str>> {
        let line = std::mem::take(&mut self.line);
        let text = String::from_utf8_lossy(&line);
        let text = text.trim_end();
        if self.overlong {
            // Too long to be a program: nothing of it can be run.
            self.overlong = false;
            self.program.clear();
            return Some(Err("program ignored: longer than 1 MiB"));
        }
        let inside = !self.program.is_empty();
        if !inside && (text.trim_start().is_empty() || text.trim_start().starts_with('#')) {
            return None;
        }
        self.program.extend(text.as_bytes());
        self.program.push(b'\n');
        let begins = !inside && (text.starts_with("def ") || text.starts_with("sec "));
        if begins || (inside && text != "end") {
            return None;
        }
        let program = std::mem::take(&mut self.program);
        Some(Ok(String::from_utf8_lossy(&program).into_owned()))
    }
}

fn doubles(to: &mut Vec<u8>, values: &[f64]) {
    values.iter().for_each(|v| to.extend(v.to_be_bytes()));
}

/// The frame of 30003: 1140 bytes on a CB3 3.15, 1220 on an e-Series of 5.10 or newer.
pub fn realtime(machine: &Machine) -> Vec<u8> {
    let mut frame = vec![0; 4];
    let to = &mut frame;
    let put = |to: &mut Vec<u8>, outputs: &[Output]| outputs.iter().for_each(|o| machine.read_output(*o, to));
    put(to, &[Output::Timestamp, Output::TargetQ, Output::TargetQd, Output::TargetQdd, Output::TargetCurrent, Output::TargetMoment]);
    put(to, &[Output::ActualQ, Output::ActualQd, Output::ActualCurrent, Output::JointControlOutput]);
    put(to, &[Output::ActualTcpPose, Output::ActualTcpSpeed, Output::ActualTcpForce, Output::TargetTcpPose, Output::TargetTcpSpeed]);
    doubles(to, &[0.0]); // digital inputs
    put(to, &[Output::JointTemperatures, Output::ActualExecutionTime]);
    doubles(to, &[0.0, f64::from(machine.robot_mode() as i32)]);
    doubles(to, &[if machine.robot_mode() == RobotMode::PowerOff { 239.0 } else { 253.0 }; 6]);
    doubles(to, &[f64::from(machine.safety_mode() as i32)]);
    doubles(to, &[0.0; 6]);
    put(to, &[Output::ActualToolAccelerometer]);
    doubles(to, &[0.0; 6]);
    put(to, &[Output::SpeedScaling, Output::ActualMomentum]);
    doubles(to, &[0.0; 2]);
    put(to, &[Output::ActualMainVoltage, Output::ActualRobotVoltage, Output::ActualRobotCurrent, Output::ActualJointVoltage]);
    doubles(to, &[machine.robot.digital_out as f64, f64::from(machine.runtime_state() as i32)]);
    doubles(to, &[0.0; 6]); // elbow
    doubles(to, &[f64::from(machine.safety_mode() as i32)]);
    doubles(to, &[0.0; 3]);
    if machine.series() == Series::ESeries {
        doubles(to, &[0.0; 10]); // payload
    }
    let size = frame.len() as u32;
    frame[..4].copy_from_slice(&size.to_be_bytes());
    frame
}

fn package(kind: u8, body: &[u8]) -> Vec<u8> {
    let mut all = ((body.len() + 5) as u32).to_be_bytes().to_vec();
    all.push(kind);
    all.extend(body);
    all
}

/// Type of the package that carries state.
const ROBOT_STATE: u8 = 16;
/// Type of the package that carries a message.
const ROBOT_MESSAGE: u8 = 20;

/// The state package of 30001 and 30002: robot mode, joints and Cartesian data.
pub fn state(machine: &Machine) -> Vec<u8> {
    let mut body = Vec::new();
    let mut mode = ((machine.robot.timestamp_s() * 1e6) as u64).to_be_bytes().to_vec();
    let powered = machine.robot_mode() != RobotMode::PowerOff;
    let emergency = machine.safety_mode() == SafetyMode::RobotEmergencyStop;
    let protective = machine.safety_mode() == SafetyMode::ProtectiveStop;
    let (playing, paused) = (machine.runtime_state() == RuntimeState::Playing, machine.runtime_state() == RuntimeState::Paused);
    mode.extend([true, true, powered, emergency, protective, playing, paused].map(u8::from));
    mode.extend([machine.robot_mode() as u8, 0]);
    doubles(&mut mode, &[machine.robot.speed_scaling(), machine.robot.speed_scaling(), 1.0]);
    mode.push(0);
    body.extend(package(0, &mode));
    let servo = &machine.robot.servo;
    let mut joints = Vec::new();
    for i in 0..6 {
        doubles(&mut joints, &[servo.actual_q[i], servo.target_q[i], servo.actual_qd[i]]);
        [0.0f32, 48.0, 27.0, 27.0].iter().for_each(|v| joints.extend(v.to_be_bytes()));
        joints.push(if powered { 253 } else { 239 });
    }
    body.extend(package(1, &joints));
    let mut cartesian = Vec::new();
    machine.read_output(Output::ActualTcpPose, &mut cartesian);
    doubles(&mut cartesian, &[0.0; 6]); // TCP offset
    body.extend(package(4, &cartesian));
    package(ROBOT_STATE, &body)
}

fn message(machine: &Machine, source: i8, kind: u8, rest: &[u8]) -> Vec<u8> {
    let mut body = ((machine.robot.timestamp_s() * 1e6) as u64).to_be_bytes().to_vec();
    body.extend([source as u8, kind]);
    body.extend(rest);
    package(ROBOT_MESSAGE, &body)
}

/// The version message that starts 30001 and 30002.
pub fn version(machine: &Machine) -> Vec<u8> {
    let v = machine.version();
    let name = b"URControl";
    let mut rest = vec![name.len() as u8];
    rest.extend(name);
    rest.extend([v.major as u8, v.minor as u8]);
    rest.extend(v.bugfix.to_be_bytes());
    rest.extend(v.build.to_be_bytes());
    rest.extend(b"01-01-2023, 00:00:00");
    message(machine, -2, 3, &rest)
}

/// A log line as 30001 sends it: textmsg as a text message, a mistake of the program as a runtime exception.
pub fn log_line(machine: &Machine, line: &LogLine) -> Option<Vec<u8>> {
    match line.kind {
        LogKind::Text => Some(message(machine, -3, 0, line.text.as_bytes())),
        LogKind::ProgramError => {
            let mut rest = 0u64.to_be_bytes().to_vec(); // line and column are in the text
            rest.extend(line.text.as_bytes());
            Some(message(machine, -3, 10, &rest))
        }
        LogKind::Event => None,
    }
}
