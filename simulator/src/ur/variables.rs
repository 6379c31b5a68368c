//! RTDE's variables: their names, their types on the wire, and the controller versions that have them.
//!
//! Pure. Runs on the controller's thread and does not allocate. The source of all names, types and versions is the section
//! "Field names and associated types" of UR's RTDE guide. A name that a controller does not have gives None.

use super::registers::{BITS, NUMBERS};

/// Controller generation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Series {
    /// CB3, with 125 control cycles a second.
    Cb3,
    /// e-Series, with 500 control cycles a second.
    ESeries,
}

/// Controller version.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Version {
    /// First number: 3 for CB3, 5 for the e-Series.
    pub major: u32,
    /// Second number.
    pub minor: u32,
    /// Third number.
    pub bugfix: u32,
    /// Fourth number.
    pub build: u32,
}

impl Series {
    /// Control cycles a second.
    pub fn rate_hz(self) -> f64 {
        match self {
            Series::Cb3 => 125.0,
            Series::ESeries => 500.0,
        }
    }

    /// The version that a controller of this generation has unless it is told otherwise.
    pub fn default_version(self) -> Version {
        match self {
            Series::Cb3 => Version { major: 3, minor: 15, bugfix: 8, build: 106_339 },
            Series::ESeries => Version { major: 5, minor: 11, bugfix: 6, build: 1_010_551 },
        }
    }
}

/// The first version, as (major, minor), of each generation that has a variable; None for a generation that never had it.
#[derive(Debug, Clone, Copy)]
struct Since {
    cb3: Option<(u32, u32)>,
    e_series: Option<(u32, u32)>,
}

impl Since {
    fn includes(self, version: &Version) -> bool {
        let first = if version.major < 5 { self.cb3 } else { self.e_series };
        first.is_some_and(|first| (version.major, version.minor) >= first)
    }
}

const fn since(cb3: (u32, u32), e_series: (u32, u32)) -> Since {
    Since { cb3: Some(cb3), e_series: Some(e_series) }
}

const fn e_series_since(major: u32, minor: u32) -> Since {
    Since { cb3: None, e_series: Some((major, minor)) }
}

/// Every version has the variable (UR's RTDE guide).
const ALWAYS: Since = since((0, 0), (0, 0));
/// The registers above number 23 and the single bit registers exist since these versions (UR's RTDE guide).
const UPPER_REGISTERS: Since = since((3, 9), (5, 3));
/// Number of int and of double registers before there were upper ones (UR's RTDE guide).
const LOWER_NUMBERS: u8 = 24;
/// First bit register that is a variable of its own; the lower ones are read and written 32 at a time (UR's RTDE guide).
const FIRST_SINGLE_BIT: u8 = 64;

/// Type of a variable on the wire; numbers are big-endian.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WireType {
    /// One byte, which is 0 for false.
    Bool,
    /// One byte.
    Uint8,
    /// Four bytes.
    Int32,
    /// Four bytes.
    Uint32,
    /// Eight bytes.
    Uint64,
    /// An IEEE 754 number of eight bytes.
    Double,
    /// Three doubles.
    Vector3d,
    /// Six doubles.
    Vector6d,
    /// Six signed numbers of four bytes.
    Vector6Int32,
}

impl WireType {
    /// The type's name in the answer to a recipe.
    pub fn name(self) -> &'static str {
        match self {
            WireType::Bool => "BOOL",
            WireType::Uint8 => "UINT8",
            WireType::Int32 => "INT32",
            WireType::Uint32 => "UINT32",
            WireType::Uint64 => "UINT64",
            WireType::Double => "DOUBLE",
            WireType::Vector3d => "VECTOR3D",
            WireType::Vector6d => "VECTOR6D",
            WireType::Vector6Int32 => "VECTOR6INT32",
        }
    }

    /// Length of a value in bytes.
    pub fn bytes(self) -> usize {
        match self {
            WireType::Bool | WireType::Uint8 => 1,
            WireType::Int32 | WireType::Uint32 => 4,
            WireType::Uint64 | WireType::Double => 8,
            WireType::Vector3d | WireType::Vector6Int32 => 24,
            WireType::Vector6d => 48,
        }
    }
}

/// A variable that clients read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)] // The names are those of the protocol.
pub enum Output {
    Timestamp,
    TargetQ,
    TargetQd,
    TargetQdd,
    ActualQ,
    ActualQd,
    ActualTcpPose,
    ActualTcpSpeed,
    TargetTcpPose,
    TargetTcpSpeed,
    JointTemperatures,
    ActualJointVoltage,
    JointMode,
    ActualDigitalOutputBits,
    RobotMode,
    SafetyMode,
    RuntimeState,
    RobotStatusBits,
    SafetyStatusBits,
    SpeedScaling,
    TargetSpeedFraction,
    Payload,
    PayloadCog,
    ActualMainVoltage,
    ActualRobotVoltage,
    StandardAnalogOutput(u8),
    ScriptControlLine,
    IntRegister(u8),
    DoubleRegister(u8),
    BitRegister(u8),
    /// 32 bit registers from this number on.
    BitRegisters(u8),
    /// An input variable, which clients may read back.
    Input(Input),
    /// A variable that is not simulated and always reads as zero.
    Zero(WireType),
}

/// The outputs that are not numbered registers, with the versions that have them (UR's RTDE guide).
const OUTPUTS: &[(&str, Output, Since)] = {
    use Output::*;
    use WireType::{Double, Int32, Uint8, Uint32, Uint64, Vector3d, Vector6d};
    &[
        ("timestamp", Timestamp, ALWAYS),
        ("target_q", TargetQ, ALWAYS),
        ("target_qd", TargetQd, ALWAYS),
        ("target_qdd", TargetQdd, ALWAYS),
        ("target_current", Zero(Vector6d), ALWAYS),
        ("target_moment", Zero(Vector6d), ALWAYS),
        ("actual_q", ActualQ, ALWAYS),
        ("actual_qd", ActualQd, ALWAYS),
        ("actual_current", Zero(Vector6d), ALWAYS),
        ("actual_current_as_torque", Zero(Vector6d), e_series_since(5, 23)),
        ("actual_current_window", Zero(Vector6d), ALWAYS),
        ("joint_control_output", Zero(Vector6d), ALWAYS),
        ("actual_TCP_pose", ActualTcpPose, ALWAYS),
        ("actual_TCP_speed", ActualTcpSpeed, ALWAYS),
        ("actual_TCP_force", Zero(Vector6d), ALWAYS),
        ("target_TCP_pose", TargetTcpPose, ALWAYS),
        ("target_TCP_speed", TargetTcpSpeed, ALWAYS),
        ("joint_temperatures", JointTemperatures, ALWAYS),
        ("actual_joint_voltage", ActualJointVoltage, ALWAYS),
        ("joint_mode", JointMode, ALWAYS),
        ("joint_position_deviation_ratio", Zero(Double), ALWAYS),
        ("actual_tool_accelerometer", Zero(Vector3d), ALWAYS),
        ("actual_digital_input_bits", Zero(Uint64), ALWAYS),
        ("actual_digital_output_bits", ActualDigitalOutputBits, ALWAYS),
        ("actual_configurable_digital_input_bits", Zero(Uint64), ALWAYS),
        ("actual_configurable_digital_output_bits", Zero(Uint64), ALWAYS),
        ("robot_mode", RobotMode, ALWAYS),
        ("safety_mode", SafetyMode, ALWAYS),
        ("safety_status", SafetyMode, since((3, 10), (5, 4))),
        ("runtime_state", RuntimeState, ALWAYS),
        ("robot_status_bits", RobotStatusBits, ALWAYS),
        ("safety_status_bits", SafetyStatusBits, ALWAYS),
        ("speed_scaling", SpeedScaling, ALWAYS),
        ("target_speed_fraction", TargetSpeedFraction, ALWAYS),
        ("actual_momentum", Zero(Double), ALWAYS),
        ("actual_main_voltage", ActualMainVoltage, ALWAYS),
        ("actual_robot_voltage", ActualRobotVoltage, ALWAYS),
        ("actual_robot_current", Zero(Double), ALWAYS),
        ("actual_execution_time", Zero(Double), ALWAYS),
        ("io_current", Zero(Double), ALWAYS),
        ("analog_io_types", Zero(Uint32), ALWAYS),
        ("standard_analog_input0", Zero(Double), ALWAYS),
        ("standard_analog_input1", Zero(Double), ALWAYS),
        ("standard_analog_output0", StandardAnalogOutput(0), ALWAYS),
        ("standard_analog_output1", StandardAnalogOutput(1), ALWAYS),
        ("payload", Payload, since((3, 11), (5, 5))),
        ("payload_cog", PayloadCog, since((3, 11), (5, 5))),
        ("payload_inertia", Zero(Vector6d), since((3, 15), (5, 11))),
        ("tcp_offset", Zero(Vector6d), ALWAYS),
        ("tcp_force_scalar", Zero(Double), ALWAYS),
        ("elbow_position", Zero(Vector3d), ALWAYS),
        ("elbow_velocity", Zero(Vector3d), ALWAYS),
        ("script_control_line", ScriptControlLine, since((3, 14), (5, 9))),
        ("ft_raw_wrench", Zero(Vector6d), e_series_since(5, 9)),
        ("tool_mode", Zero(Uint32), ALWAYS),
        ("tool_analog_input_types", Zero(Uint32), ALWAYS),
        ("tool_analog_input0", Zero(Double), ALWAYS),
        ("tool_analog_input1", Zero(Double), ALWAYS),
        ("tool_output_voltage", Zero(Int32), ALWAYS),
        ("tool_output_current", Zero(Double), ALWAYS),
        ("tool_temperature", Zero(Double), ALWAYS),
        ("tool_output_mode", Zero(Uint8), e_series_since(5, 2)),
        ("tool_digital_output0_mode", Zero(Uint8), e_series_since(5, 2)),
        ("tool_digital_output1_mode", Zero(Uint8), e_series_since(5, 2)),
        ("encoder0_raw", Zero(Int32), ALWAYS),
        ("encoder1_raw", Zero(Int32), ALWAYS),
        ("euromap67_input_bits", Zero(Uint32), ALWAYS),
        ("euromap67_output_bits", Zero(Uint32), ALWAYS),
        ("euromap67_24V_voltage", Zero(Double), ALWAYS),
        ("euromap67_24V_current", Zero(Double), ALWAYS),
        ("output_bit_registers0_to_31", BitRegisters(0), ALWAYS),
        ("output_bit_registers32_to_63", BitRegisters(32), ALWAYS),
    ]
};

/// A variable that clients write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)] // The names are those of the protocol.
pub enum Input {
    IntRegister(u8),
    DoubleRegister(u8),
    BitRegister(u8),
    /// 32 bit registers from this number on.
    BitRegisters(u8),
    SpeedSliderMask,
    SpeedSliderFraction,
    StandardDigitalOutputMask,
    ConfigurableDigitalOutputMask,
    ToolDigitalOutputMask,
    StandardDigitalOutput,
    ConfigurableDigitalOutput,
    ToolDigitalOutput,
    StandardAnalogOutputMask,
    StandardAnalogOutputType,
    StandardAnalogOutput(u8),
    ExternalForceTorque,
}

/// The inputs that are not numbered registers, with their types (UR's RTDE guide).
const INPUTS: &[(&str, Input, WireType)] = {
    use Input::*;
    use WireType::{Double, Uint8, Uint32, Vector6d};
    &[
        ("input_bit_registers0_to_31", BitRegisters(0), Uint32),
        ("input_bit_registers32_to_63", BitRegisters(32), Uint32),
        ("speed_slider_mask", SpeedSliderMask, Uint32),
        ("speed_slider_fraction", SpeedSliderFraction, Double),
        ("standard_digital_output_mask", StandardDigitalOutputMask, Uint8),
        ("configurable_digital_output_mask", ConfigurableDigitalOutputMask, Uint8),
        ("tool_digital_output_mask", ToolDigitalOutputMask, Uint8),
        ("standard_digital_output", StandardDigitalOutput, Uint8),
        ("configurable_digital_output", ConfigurableDigitalOutput, Uint8),
        ("tool_digital_output", ToolDigitalOutput, Uint8),
        ("standard_analog_output_mask", StandardAnalogOutputMask, Uint8),
        ("standard_analog_output_type", StandardAnalogOutputType, Uint8),
        ("standard_analog_output_0", StandardAnalogOutput(0), Double),
        ("standard_analog_output_1", StandardAnalogOutput(1), Double),
        ("external_force_torque", ExternalForceTorque, Vector6d),
    ]
};

/// The number from `low` to `high` that follows `prefix` in `name`.
fn numbered(name: &str, prefix: &str, low: u8, high: u8) -> Option<u8> {
    let digits = name.strip_prefix(prefix)?;
    if digits.len() > 1 && digits.starts_with('0') || !digits.bytes().all(|b| b.is_ascii_digit()) {
        return None;
    }
    digits.parse().ok().filter(|n| (low..=high).contains(n))
}

impl Output {
    /// The variable of this name, if a controller of this version has it.
    pub fn parse(name: &str, version: &Version) -> Option<Self> {
        if let Some((_, output, since)) = OUTPUTS.iter().find(|(n, ..)| *n == name) {
            return Some(*output).filter(|_| since.includes(version));
        }
        let upper = UPPER_REGISTERS.includes(version);
        let last = if upper { NUMBERS as u8 - 1 } else { LOWER_NUMBERS - 1 };
        numbered(name, "output_int_register_", 0, last)
            .map(Output::IntRegister)
            .or_else(|| numbered(name, "output_double_register_", 0, last).map(Output::DoubleRegister))
            .or_else(|| numbered(name, "output_bit_register_", FIRST_SINGLE_BIT, BITS as u8 - 1).filter(|_| upper).map(Output::BitRegister))
            .or_else(|| name.starts_with("input_").then(|| Input::parse_for(name, version)).flatten().map(Output::Input))
    }

    /// The variable's type on the wire.
    pub fn wire_type(self) -> WireType {
        use Output::*;
        match self {
            JointMode => WireType::Vector6Int32,
            ActualDigitalOutputBits => WireType::Uint64,
            RobotMode | SafetyMode | IntRegister(_) => WireType::Int32,
            RuntimeState | RobotStatusBits | SafetyStatusBits | ScriptControlLine | BitRegisters(_) => WireType::Uint32,
            Timestamp
            | SpeedScaling
            | TargetSpeedFraction
            | Payload
            | ActualMainVoltage
            | ActualRobotVoltage
            | StandardAnalogOutput(_)
            | DoubleRegister(_) => WireType::Double,
            PayloadCog => WireType::Vector3d,
            BitRegister(_) => WireType::Bool,
            Input(input) => input.wire_type(),
            Zero(wire_type) => wire_type,
            TargetQ | TargetQd | TargetQdd | ActualQ | ActualQd | ActualTcpPose | ActualTcpSpeed | TargetTcpPose | TargetTcpSpeed
            | JointTemperatures | ActualJointVoltage => WireType::Vector6d,
        }
    }
}

/// First slot after those of the int registers, the double registers, and the single bit registers (follows from their numbers).
const FIRST_OTHER_SLOT: usize = 2 * NUMBERS + BITS - FIRST_SINGLE_BIT as usize;

impl Input {
    /// Number of distinct slots of inputs; see [`Input::slot`].
    pub const SLOTS: usize = FIRST_OTHER_SLOT + INPUTS.len();

    /// The input of this name on the newest controller.
    pub fn parse(name: &str) -> Option<Self> {
        if let Some((_, input, _)) = INPUTS.iter().find(|(n, ..)| *n == name) {
            return Some(*input);
        }
        numbered(name, "input_int_register_", 0, NUMBERS as u8 - 1)
            .map(Input::IntRegister)
            .or_else(|| numbered(name, "input_double_register_", 0, NUMBERS as u8 - 1).map(Input::DoubleRegister))
            .or_else(|| numbered(name, "input_bit_register_", FIRST_SINGLE_BIT, BITS as u8 - 1).map(Input::BitRegister))
    }

    /// The input of this name, if a controller of this version has it.
    pub fn parse_for(name: &str, version: &Version) -> Option<Self> {
        Self::parse(name).filter(|input| match input {
            Input::IntRegister(n) | Input::DoubleRegister(n) if *n >= LOWER_NUMBERS => UPPER_REGISTERS.includes(version),
            Input::BitRegister(_) => UPPER_REGISTERS.includes(version),
            _ => true,
        })
    }

    /// Place of this input in [`INPUTS`]; 0 for a numbered register, which has none.
    fn place(self) -> usize {
        INPUTS.iter().position(|(_, input, _)| *input == self).unwrap_or(0)
    }

    /// The input's type on the wire.
    pub fn wire_type(self) -> WireType {
        match self {
            Input::IntRegister(_) => WireType::Int32,
            Input::DoubleRegister(_) => WireType::Double,
            Input::BitRegister(_) => WireType::Bool,
            other => INPUTS[other.place()].2,
        }
    }

    /// A number below [`Input::SLOTS`] that no other input has. Who owns an input and when it was last written are kept under
    /// this number.
    pub fn slot(self) -> usize {
        match self {
            Input::IntRegister(n) => usize::from(n),
            Input::DoubleRegister(n) => NUMBERS + usize::from(n),
            Input::BitRegister(n) => 2 * NUMBERS + usize::from(n - FIRST_SINGLE_BIT),
            other => FIRST_OTHER_SLOT + other.place(),
        }
    }
}
