//! The client interfaces on the ports 30001 to 30003: programs come in, the robot's state goes out.
//!
//! Pure; bytes in, bytes out. Runs on the controller's thread; allocates the packages, and for uploads up to the longest
//! program. Ports 30001 and 30002 send packages 10 times a second, port 30003 sends one package a control cycle; the layouts
//! are those of UR's client interface tables. A program is text: a bare line runs as a program of one line, `def` and `sec`
//! reach up to the `end` in column 0. Text that is too long to be a program is thrown away, and the caller is told.

use super::log::{LogKind, LogLine};
use super::machine::{Machine, SafetyMode};
use super::power::RobotMode;
use super::program::RuntimeState;
use super::script::MAX_SOURCE_BYTES;
use super::variables::{Output, Series};

/// Cuts a client's text into programs.
#[derive(Debug, Default)]
pub struct ProgramAssembler {
    line: Vec<u8>,
    program: Vec<u8>,
    overlong: bool,
}

impl ProgramAssembler {
    /// Takes received bytes and gives the programs that are now complete. An error stands for text that was thrown away.
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

    /// Gives what is left when the client closes its side, because a last line needs no line end.
    pub fn finish(&mut self) -> Option<Result<String, &'static str>> {
        if self.line.is_empty() { None } else { self.end_of_line() }
    }

    fn end_of_line(&mut self) -> Option<Result<String, &'static str>> {
        let line = std::mem::take(&mut self.line);
        let text = String::from_utf8_lossy(&line);
        let text = text.trim_end();
        if self.overlong {
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

/// Where the value of a field of the real-time package comes from.
#[derive(Debug, Clone, Copy)]
enum Field {
    /// An RTDE variable of one or more doubles.
    Variable(Output),
    /// This many doubles that are not simulated and read as zero.
    Zeros(usize),
    RobotMode,
    JointModes,
    SafetyMode,
    DigitalOutputs,
    ProgramState,
}

/// The fields of the real-time package after its size, all of them doubles, by the names of UR's client interface tables.
const REALTIME_FIELDS: &[(&str, Field)] = &[
    ("Time", Field::Variable(Output::Timestamp)),
    ("q target", Field::Variable(Output::TargetQ)),
    ("qd target", Field::Variable(Output::TargetQd)),
    ("qdd target", Field::Variable(Output::TargetQdd)),
    ("I target", Field::Zeros(6)),
    ("M target", Field::Zeros(6)),
    ("q actual", Field::Variable(Output::ActualQ)),
    ("qd actual", Field::Variable(Output::ActualQd)),
    ("I actual", Field::Zeros(6)),
    ("I control", Field::Zeros(6)),
    ("Tool vector actual", Field::Variable(Output::ActualTcpPose)),
    ("TCP speed actual", Field::Variable(Output::ActualTcpSpeed)),
    ("TCP force", Field::Zeros(6)),
    ("Tool vector target", Field::Variable(Output::TargetTcpPose)),
    ("TCP speed target", Field::Variable(Output::TargetTcpSpeed)),
    ("Digital input bits", Field::Zeros(1)),
    ("Motor temperatures", Field::Variable(Output::JointTemperatures)),
    ("Controller timer", Field::Zeros(1)),
    ("Test value", Field::Zeros(1)),
    ("Robot mode", Field::RobotMode),
    ("Joint modes", Field::JointModes),
    ("Safety mode", Field::SafetyMode),
    ("for UR's own use", Field::Zeros(6)),
    ("Tool accelerometer values", Field::Zeros(3)),
    ("for UR's own use", Field::Zeros(6)),
    ("Speed scaling", Field::Variable(Output::SpeedScaling)),
    ("Linear momentum norm", Field::Zeros(1)),
    ("for UR's own use", Field::Zeros(2)),
    ("V main", Field::Variable(Output::ActualMainVoltage)),
    ("V robot", Field::Variable(Output::ActualRobotVoltage)),
    ("I robot", Field::Zeros(1)),
    ("V actual", Field::Variable(Output::ActualJointVoltage)),
    ("Digital outputs", Field::DigitalOutputs),
    ("Program state", Field::ProgramState),
    ("Elbow position", Field::Zeros(3)),
    ("Elbow velocity", Field::Zeros(3)),
    ("Safety status", Field::SafetyMode),
    ("for UR's own use", Field::Zeros(3)),
];

/// The fields that an e-Series of 5.10 or newer appends, by the names of UR's client interface tables.
const REALTIME_FIELDS_E_SERIES: &[(&str, Field)] =
    &[("Payload mass", Field::Zeros(1)), ("Payload CoG", Field::Zeros(3)), ("Payload inertia", Field::Zeros(6))];

/// Length of the size that every package starts with (UR's client interface tables).
const SIZE_BYTES: usize = 4;

fn doubles(to: &mut Vec<u8>, values: &[f64]) {
    values.iter().for_each(|v| to.extend(v.to_be_bytes()));
}

/// The package of port 30003: 1140 bytes on a CB3 3.15, 1220 on an e-Series.
pub fn realtime_package(machine: &Machine) -> Vec<u8> {
    let mut package = vec![0; SIZE_BYTES];
    let to = &mut package;
    let more = if machine.series() == Series::ESeries { REALTIME_FIELDS_E_SERIES } else { &[] };
    for (_, field) in REALTIME_FIELDS.iter().chain(more) {
        match field {
            Field::Variable(output) => machine.read_output(*output, to),
            Field::Zeros(count) => to.extend(std::iter::repeat_n(0, count * size_of::<f64>())),
            Field::RobotMode => doubles(to, &[f64::from(machine.robot_mode() as i32)]),
            Field::JointModes => doubles(to, &[f64::from(machine.joint_mode()); 6]),
            Field::SafetyMode => doubles(to, &[f64::from(machine.safety_mode() as i32)]),
            Field::DigitalOutputs => doubles(to, &[machine.robot.digital_out as f64]),
            Field::ProgramState => doubles(to, &[f64::from(machine.runtime_state() as i32)]),
        }
    }
    let size = package.len() as u32;
    package[..SIZE_BYTES].copy_from_slice(&size.to_be_bytes());
    package
}

/// Puts the size and `package_type` before `body`.
fn package(package_type: u8, body: &[u8]) -> Vec<u8> {
    let mut all = ((SIZE_BYTES + 1 + body.len()) as u32).to_be_bytes().to_vec();
    all.push(package_type);
    all.extend(body);
    all
}

/// Type of the package that carries state (UR's client interface tables).
const ROBOT_STATE: u8 = 16;
/// Type of the package that carries a message (UR's client interface tables).
const ROBOT_MESSAGE: u8 = 20;
/// Type of the part of a state package with the robot's modes (UR's client interface tables).
const ROBOT_MODE_DATA: u8 = 0;
/// Type of the part of a state package with the joints (UR's client interface tables).
const JOINT_DATA: u8 = 1;
/// Type of the part of a state package with the tool's pose (UR's client interface tables).
const CARTESIAN_INFO: u8 = 4;
/// Source of a message: the robot's interface (UR's client interface tables).
const SOURCE_ROBOT_INTERFACE: i8 = -2;
/// Source of a message: the running program (UR's client interface tables).
const SOURCE_PROGRAM: i8 = -3;
/// Type of a message with a program's text (UR's client interface tables).
const TEXT_MESSAGE: u8 = 0;
/// Type of a message with the controller's version (UR's client interface tables).
const VERSION_MESSAGE: u8 = 3;
/// Type of a message about a program's mistake (UR's client interface tables).
const RUNTIME_EXCEPTION: u8 = 10;

fn timestamp_us(machine: &Machine) -> [u8; 8] {
    ((machine.robot.timestamp_s() * 1e6) as u64).to_be_bytes()
}

fn robot_mode_data(machine: &Machine) -> Vec<u8> {
    let mut data = timestamp_us(machine).to_vec();
    let flags = [
        true, // A real robot is connected.
        true, // A real robot is enabled.
        machine.robot_mode() != RobotMode::PowerOff,
        matches!(machine.safety_mode(), SafetyMode::RobotEmergencyStop | SafetyMode::SystemEmergencyStop),
        machine.safety_mode() == SafetyMode::ProtectiveStop,
        machine.runtime_state() == RuntimeState::Playing,
        machine.runtime_state() == RuntimeState::Paused,
    ];
    data.extend(flags.map(u8::from));
    data.extend([machine.robot_mode() as u8, 0]); // The control mode is "position".
    // Target fraction, scaling, and the limit of the fraction.
    doubles(&mut data, &[machine.robot.speed_slider(), machine.speed_scaling(), 1.0]);
    data.push(0); // For UR's own use.
    data
}

fn joint_data(machine: &Machine) -> Vec<u8> {
    let servo = &machine.robot.servo;
    let mut data = Vec::new();
    for joint in 0..6 {
        doubles(&mut data, &[servo.actual_q[joint], servo.target_q[joint], servo.actual_qd[joint]]);
        // Current in A, voltage in V, temperatures of motor and electronics in degrees Celsius.
        [0.0f32, 48.0, 27.0, 27.0].iter().for_each(|v| data.extend(v.to_be_bytes()));
        data.push(machine.joint_mode());
    }
    data
}

fn cartesian_info(machine: &Machine) -> Vec<u8> {
    let mut data = Vec::new();
    machine.read_output(Output::ActualTcpPose, &mut data);
    doubles(&mut data, &[0.0; 6]); // The offset of the TCP from the flange.
    data
}

/// The state package of the ports 30001 and 30002: robot mode, joints and the tool's pose.
pub fn state_package(machine: &Machine) -> Vec<u8> {
    let parts = [
        package(ROBOT_MODE_DATA, &robot_mode_data(machine)),
        package(JOINT_DATA, &joint_data(machine)),
        package(CARTESIAN_INFO, &cartesian_info(machine)),
    ];
    package(ROBOT_STATE, &parts.concat())
}

fn message_package(machine: &Machine, source: i8, message_type: u8, rest: &[u8]) -> Vec<u8> {
    let mut body = timestamp_us(machine).to_vec();
    body.extend([source as u8, message_type]);
    body.extend(rest);
    package(ROBOT_MESSAGE, &body)
}

/// The version message that the ports 30001 and 30002 send first.
pub fn version_package(machine: &Machine) -> Vec<u8> {
    let version = machine.version();
    let name = b"URControl";
    let mut rest = vec![name.len() as u8];
    rest.extend(name);
    rest.extend([version.major as u8, version.minor as u8]);
    rest.extend(version.bugfix.to_be_bytes());
    rest.extend(version.build.to_be_bytes());
    rest.extend(b"01-01-2023, 00:00:00");
    message_package(machine, SOURCE_ROBOT_INTERFACE, VERSION_MESSAGE, &rest)
}

/// A log line as port 30001 sends it: a program's text as a text message, a mistake as a runtime exception. Events are not
/// sent.
pub fn log_package(machine: &Machine, line: &LogLine) -> Option<Vec<u8>> {
    match line.kind {
        LogKind::Text => Some(message_package(machine, SOURCE_PROGRAM, TEXT_MESSAGE, line.text.as_bytes())),
        LogKind::ProgramError => {
            let mut rest = 0u64.to_be_bytes().to_vec(); // Line and column stand in the text.
            rest.extend(line.text.as_bytes());
            Some(message_package(machine, SOURCE_PROGRAM, RUNTIME_EXCEPTION, &rest))
        }
        LogKind::Event => None,
    }
}
