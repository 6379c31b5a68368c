//! RTDE's variables: names, types, since which controller version, and where inputs are kept.
//!
//! Pure; source: section "Field names and associated types" of UR's RTDE guide. Used on the controller's thread.

/// Controller generation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Series {
    /// CB3: 125 cycles a second.
    Cb3,
    /// e-Series: 500 cycles a second.
    ESeries,
}

/// Controller version.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct Version {
    /// 3 for CB3, 5 for the e-Series.
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

    /// The version a controller of this generation has unless told otherwise.
    pub fn default_version(self) -> Version {
        match self {
            Series::Cb3 => Version { major: 3, minor: 15, bugfix: 8, build: 106_339 },
            Series::ESeries => Version { major: 5, minor: 11, bugfix: 6, build: 1_010_551 },
        }
    }
}

impl Version {
    /// True if the version is not older than the one named for its generation; None: never had it.
    fn has(&self, cb3: Option<(u32, u32)>, e_series: Option<(u32, u32)>) -> bool {
        let since = if self.major < 5 { cb3 } else { e_series };
        since.is_some_and(|s| (self.major, self.minor) >= s)
    }
}

/// Type of a variable on the wire.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Type {
    /// 1 byte, 0 or not.
    Bool,
    /// 1 byte.
    Uint8,
    /// 4 bytes.
    Int32,
    /// 4 bytes.
    Uint32,
    /// 8 bytes.
    Uint64,
    /// IEEE 754, 8 bytes.
    Double,
    /// Three doubles.
    Vector3d,
    /// Six doubles.
    Vector6d,
    /// Six INT32.
    Vector6Int32,
}

impl Type {
    /// Its name in recipe answers.
    pub fn name(self) -> &'static str {
        match self {
            Type::Bool => "BOOL",
            Type::Uint8 => "UINT8",
            Type::Int32 => "INT32",
            Type::Uint32 => "UINT32",
            Type::Uint64 => "UINT64",
            Type::Double => "DOUBLE",
            Type::Vector3d => "VECTOR3D",
            Type::Vector6d => "VECTOR6D",
            Type::Vector6Int32 => "VECTOR6INT32",
        }
    }

    /// Bytes of a value.
    pub fn bytes(self) -> usize {
        match self {
            Type::Bool | Type::Uint8 => 1,
            Type::Int32 | Type::Uint32 => 4,
            Type::Uint64 | Type::Double => 8,
            Type::Vector3d | Type::Vector6Int32 => 24,
            Type::Vector6d => 48,
        }
    }
}

/// A variable that clients read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)] // the names are the protocol's
pub enum Output {
    Timestamp,
    TargetQ,
    TargetQd,
    TargetQdd,
    TargetCurrent,
    TargetMoment,
    ActualQ,
    ActualQd,
    ActualCurrent,
    ActualCurrentAsTorque,
    JointControlOutput,
    ActualTcpPose,
    ActualTcpSpeed,
    ActualTcpForce,
    TargetTcpPose,
    TargetTcpSpeed,
    JointTemperatures,
    ActualJointVoltage,
    JointMode,
    ActualToolAccelerometer,
    ActualDigitalInputBits,
    ActualDigitalOutputBits,
    RobotMode,
    SafetyMode,
    SafetyStatus,
    RuntimeState,
    RobotStatusBits,
    SafetyStatusBits,
    SpeedScaling,
    TargetSpeedFraction,
    ActualMomentum,
    ActualMainVoltage,
    ActualRobotVoltage,
    ActualRobotCurrent,
    ActualExecutionTime,
    StandardAnalogInput,
    StandardAnalogOutput(u8),
    Payload,
    PayloadCog,
    PayloadInertia,
    ScriptControlLine,
    FtRawWrench,
    IntRegister(u8),
    DoubleRegister(u8),
    BitRegister(u8),
    /// 32 bits from this one on.
    BitRegisters(u8),
    /// An input read back.
    Input(Input),
    /// Something that this arm has not (a tool, an elbow to watch): always 0.
    Zero(Type),
}

/// A variable that clients write.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)] // the names are the protocol's
pub enum Input {
    IntRegister(u8),
    DoubleRegister(u8),
    BitRegister(u8),
    /// 32 bits from this one on.
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

/// `prefix` followed by a number of `low` to `high`.
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
        use Output::*;
        let found = match name {
            "timestamp" => Timestamp,
            "target_q" => TargetQ,
            "target_qd" => TargetQd,
            "target_qdd" => TargetQdd,
            "target_current" => TargetCurrent,
            "target_moment" => TargetMoment,
            "actual_q" => ActualQ,
            "actual_qd" => ActualQd,
            "actual_current" => ActualCurrent,
            "actual_current_as_torque" if version.has(None, Some((5, 23))) => ActualCurrentAsTorque,
            "joint_control_output" => JointControlOutput,
            "actual_TCP_pose" => ActualTcpPose,
            "actual_TCP_speed" => ActualTcpSpeed,
            "actual_TCP_force" => ActualTcpForce,
            "target_TCP_pose" => TargetTcpPose,
            "target_TCP_speed" => TargetTcpSpeed,
            "joint_temperatures" => JointTemperatures,
            "actual_joint_voltage" => ActualJointVoltage,
            "joint_mode" => JointMode,
            "actual_tool_accelerometer" => ActualToolAccelerometer,
            "actual_digital_input_bits" => ActualDigitalInputBits,
            "actual_digital_output_bits" => ActualDigitalOutputBits,
            "robot_mode" => RobotMode,
            "safety_mode" => SafetyMode,
            "safety_status" if version.has(Some((3, 10)), Some((5, 4))) => SafetyStatus,
            "runtime_state" => RuntimeState,
            "robot_status_bits" => RobotStatusBits,
            "safety_status_bits" => SafetyStatusBits,
            "speed_scaling" => SpeedScaling,
            "target_speed_fraction" => TargetSpeedFraction,
            "actual_momentum" => ActualMomentum,
            "actual_main_voltage" => ActualMainVoltage,
            "actual_robot_voltage" => ActualRobotVoltage,
            "actual_robot_current" => ActualRobotCurrent,
            "actual_execution_time" => ActualExecutionTime,
            "standard_analog_input0" | "standard_analog_input1" => StandardAnalogInput,
            "standard_analog_output0" => StandardAnalogOutput(0),
            "standard_analog_output1" => StandardAnalogOutput(1),
            "payload" if version.has(Some((3, 11)), Some((5, 5))) => Payload,
            "payload_cog" if version.has(Some((3, 11)), Some((5, 5))) => PayloadCog,
            "payload_inertia" if version.has(Some((3, 15)), Some((5, 11))) => PayloadInertia,
            "script_control_line" if version.has(Some((3, 14)), Some((5, 9))) => ScriptControlLine,
            "ft_raw_wrench" if version.has(None, Some((5, 9))) => FtRawWrench,
            "analog_io_types" | "tool_mode" | "tool_analog_input_types" | "euromap67_input_bits" | "euromap67_output_bits" => {
                Zero(Type::Uint32)
            }
            "tool_analog_input0"
            | "tool_analog_input1"
            | "tool_output_current"
            | "tool_temperature"
            | "io_current"
            | "tcp_force_scalar"
            | "joint_position_deviation_ratio"
            | "euromap67_24V_voltage"
            | "euromap67_24V_current" => Zero(Type::Double),
            "tool_output_voltage" | "encoder0_raw" | "encoder1_raw" => Zero(Type::Int32),
            "tool_output_mode" | "tool_digital_output0_mode" | "tool_digital_output1_mode" if version.has(None, Some((5, 2))) => {
                Zero(Type::Uint8)
            }
            "actual_configurable_digital_input_bits" | "actual_configurable_digital_output_bits" => Zero(Type::Uint64),
            "tcp_offset" | "actual_current_window" => Zero(Type::Vector6d),
            "elbow_position" | "elbow_velocity" => Zero(Type::Vector3d),
            "output_bit_registers0_to_31" => BitRegisters(0),
            "output_bit_registers32_to_63" => BitRegisters(32),
            _ => {
                let upper = version.has(Some((3, 9)), Some((5, 3)));
                let last = if upper { 47 } else { 23 };
                numbered(name, "output_int_register_", 0, last)
                    .map(IntRegister)
                    .or_else(|| numbered(name, "output_double_register_", 0, last).map(DoubleRegister))
                    .or_else(|| numbered(name, "output_bit_register_", 64, 127).filter(|_| upper).map(BitRegister))
                    .or_else(|| name.starts_with("input_").then(|| self::Input::parse_for(name, version)).flatten().map(Input))?
            }
        };
        Some(found)
    }

    /// Its type.
    pub fn kind(self) -> Type {
        use Output::*;
        match self {
            JointMode => Type::Vector6Int32,
            ActualToolAccelerometer | PayloadCog => Type::Vector3d,
            ActualDigitalInputBits | ActualDigitalOutputBits => Type::Uint64,
            RobotMode | SafetyMode | SafetyStatus | IntRegister(_) => Type::Int32,
            RuntimeState | RobotStatusBits | SafetyStatusBits | ScriptControlLine | BitRegisters(_) => Type::Uint32,
            Timestamp
            | SpeedScaling
            | TargetSpeedFraction
            | ActualMomentum
            | ActualMainVoltage
            | ActualRobotVoltage
            | ActualRobotCurrent
            | ActualExecutionTime
            | StandardAnalogInput
            | StandardAnalogOutput(_)
            | Payload
            | DoubleRegister(_) => Type::Double,
            BitRegister(_) => Type::Bool,
            Input(input) => input.kind(),
            Zero(kind) => kind,
            TargetQ
            | TargetQd
            | TargetQdd
            | TargetCurrent
            | TargetMoment
            | ActualQ
            | ActualQd
            | ActualCurrent
            | ActualCurrentAsTorque
            | JointControlOutput
            | ActualTcpPose
            | ActualTcpSpeed
            | ActualTcpForce
            | TargetTcpPose
            | TargetTcpSpeed
            | JointTemperatures
            | ActualJointVoltage
            | PayloadInertia
            | FtRawWrench => Type::Vector6d,
        }
    }
}

impl Input {
    /// Number of distinct places an input can have; see [`Input::slot`].
    pub const SLOTS: usize = 256;

    /// The input of this name on the newest controller.
    pub fn parse(name: &str) -> Option<Self> {
        use Input::*;
        let found = match name {
            "speed_slider_mask" => SpeedSliderMask,
            "speed_slider_fraction" => SpeedSliderFraction,
            "standard_digital_output_mask" => StandardDigitalOutputMask,
            "configurable_digital_output_mask" => ConfigurableDigitalOutputMask,
            "tool_digital_output_mask" => ToolDigitalOutputMask,
            "standard_digital_output" => StandardDigitalOutput,
            "configurable_digital_output" => ConfigurableDigitalOutput,
            "tool_digital_output" => ToolDigitalOutput,
            "standard_analog_output_mask" => StandardAnalogOutputMask,
            "standard_analog_output_type" => StandardAnalogOutputType,
            "standard_analog_output_0" => StandardAnalogOutput(0),
            "standard_analog_output_1" => StandardAnalogOutput(1),
            "external_force_torque" => ExternalForceTorque,
            "input_bit_registers0_to_31" => BitRegisters(0),
            "input_bit_registers32_to_63" => BitRegisters(32),
            _ => numbered(name, "input_int_register_", 0, 47)
                .map(IntRegister)
                .or_else(|| numbered(name, "input_double_register_", 0, 47).map(DoubleRegister))
                .or_else(|| numbered(name, "input_bit_register_", 64, 127).map(BitRegister))?,
        };
        Some(found)
    }

    /// The input of this name, if a controller of this version has it.
    pub fn parse_for(name: &str, version: &Version) -> Option<Self> {
        Self::parse(name).filter(|input| match input {
            Input::IntRegister(n) | Input::DoubleRegister(n) if *n >= 24 => version.has(Some((3, 9)), Some((5, 3))),
            Input::BitRegister(_) => version.has(Some((3, 9)), Some((5, 3))),
            _ => true,
        })
    }

    /// Its type.
    pub fn kind(self) -> Type {
        use Input::*;
        match self {
            IntRegister(_) => Type::Int32,
            DoubleRegister(_) | SpeedSliderFraction | StandardAnalogOutput(_) => Type::Double,
            BitRegister(_) => Type::Bool,
            BitRegisters(_) | SpeedSliderMask => Type::Uint32,
            ExternalForceTorque => Type::Vector6d,
            StandardDigitalOutputMask
            | ConfigurableDigitalOutputMask
            | ToolDigitalOutputMask
            | StandardDigitalOutput
            | ConfigurableDigitalOutput
            | ToolDigitalOutput
            | StandardAnalogOutputMask
            | StandardAnalogOutputType => Type::Uint8,
        }
    }

    /// A number of its own, below [`Input::SLOTS`]: who owns it and when it was last written are kept under it.
    pub fn slot(self) -> usize {
        use Input::*;
        match self {
            IntRegister(n) => usize::from(n),
            DoubleRegister(n) => 48 + usize::from(n),
            BitRegister(n) => 96 + usize::from(n - 64),
            BitRegisters(n) => 160 + usize::from(n / 32),
            SpeedSliderMask => 170,
            SpeedSliderFraction => 171,
            StandardDigitalOutputMask => 172,
            ConfigurableDigitalOutputMask => 173,
            ToolDigitalOutputMask => 174,
            StandardDigitalOutput => 175,
            ConfigurableDigitalOutput => 176,
            ToolDigitalOutput => 177,
            StandardAnalogOutputMask => 178,
            StandardAnalogOutputType => 179,
            StandardAnalogOutput(n) => 180 + usize::from(n),
            ExternalForceTorque => 182,
        }
    }
}

/// Values of all registers of one direction.
#[derive(Debug, Clone, PartialEq)]
pub struct Registers {
    /// int registers 0 to 47.
    pub int: [i32; 48],
    /// double registers 0 to 47.
    pub double: [f64; 48],
    /// bit registers 0 to 127, bit n is register n.
    pub bits: u128,
}

impl Default for Registers {
    fn default() -> Self {
        Self { int: [0; 48], double: [0.0; 48], bits: 0 }
    }
}
