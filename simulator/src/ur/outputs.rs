//! The value of every RTDE output variable, read from the machine.
//!
//! Pure. Runs on the controller's thread; appends to the caller's buffer and cannot fail. Loads are not simulated: the arm
//! needs no current, and the payload is what the robot was told.

use super::kinematics;
use super::machine::{Machine, SafetyMode};
use super::power::RobotMode;
use super::program::RuntimeState;
use super::registers::Registers;
use super::variables::{Input, Output};

/// A joint's mode while the arm has power: running (UR's client interface tables).
const JOINT_RUNNING: u8 = 253;
/// A joint's mode while the arm has no power (UR's client interface tables).
const JOINT_POWER_OFF: u8 = 239;
/// Voltage of the supply in V. Chosen by hand: the nominal voltage of a UR5.
const SUPPLY_V: f64 = 48.0;
/// Temperature of every joint, in degrees Celsius. Chosen by hand: a robot at rest in a room.
const JOINT_TEMPERATURE_C: f64 = 27.0;

/// Appends `values`, big-endian.
fn doubles(to: &mut Vec<u8>, values: &[f64]) {
    values.iter().for_each(|v| to.extend(v.to_be_bytes()));
}

/// Appends `count` zero bytes.
fn zeros(to: &mut Vec<u8>, count: usize) {
    to.extend(std::iter::repeat_n(0, count));
}

impl Machine {
    /// RTDE's robot_status_bits: bit 0 is power, bit 1 a running program, bit 2 the teach button.
    pub fn robot_status_bits(&self) -> u32 {
        let playing = self.runtime_state() == RuntimeState::Playing;
        u32::from(self.robot_mode() != RobotMode::PowerOff) | u32::from(playing) << 1 | u32::from(self.freedrive()) << 2
    }

    /// RTDE's speed_scaling, which is 0 while the arm's brakes are on.
    pub fn speed_scaling(&self) -> f64 {
        if self.robot_mode() == RobotMode::Running { self.robot.own_scaling() } else { 0.0 }
    }

    /// RTDE's safety_status_bits: bit 0 is normal, 1 reduced, 2 a protective stop, 3 recovery, 4 an open safeguard, 5 the system's emergency stop, 6 the
    /// robot's, 7 any emergency stop, 8 a violation, 9 a fault, and 10 any stop for safety.
    pub fn safety_status_bits(&self) -> u32 {
        match self.safety_mode() {
            SafetyMode::Normal => 1,
            SafetyMode::Reduced => 1 << 1,
            SafetyMode::ProtectiveStop => 1 << 2 | 1 << 10,
            SafetyMode::Recovery => 1 << 3,
            SafetyMode::SafeguardStop => 1 << 4 | 1 << 10,
            SafetyMode::SystemEmergencyStop => 1 << 5 | 1 << 7 | 1 << 10,
            SafetyMode::RobotEmergencyStop => 1 << 6 | 1 << 7 | 1 << 10,
            SafetyMode::Violation => 1 << 8 | 1 << 10,
            SafetyMode::Fault => 1 << 9 | 1 << 10,
        }
    }

    /// The mode of all joints, in the numbers of UR's client interface tables.
    pub fn joint_mode(&self) -> u8 {
        if self.robot_mode() == RobotMode::PowerOff { JOINT_POWER_OFF } else { JOINT_RUNNING }
    }

    /// Voltage at the joints in V.
    fn robot_voltage(&self) -> f64 {
        if self.robot_mode() == RobotMode::PowerOff { 0.0 } else { SUPPLY_V }
    }

    /// Appends the value of `output`, big-endian.
    pub fn read_output(&self, output: Output, to: &mut Vec<u8>) {
        let robot = &self.robot;
        let servo = &robot.servo;
        match output {
            Output::Timestamp => doubles(to, &[robot.timestamp_s()]),
            Output::TargetQ => doubles(to, &servo.target_q),
            Output::TargetQd => doubles(to, &servo.target_qd),
            Output::TargetQdd => doubles(to, &servo.target_qdd),
            Output::ActualQ => doubles(to, &servo.actual_q),
            Output::ActualQd => doubles(to, &servo.actual_qd),
            Output::ActualTcpPose => doubles(to, &kinematics::pose(&servo.actual_q)),
            Output::TargetTcpPose => doubles(to, &kinematics::pose(&servo.target_q)),
            Output::ActualTcpSpeed => doubles(to, &kinematics::speed(&servo.actual_q, &servo.actual_qd)),
            Output::TargetTcpSpeed => doubles(to, &kinematics::speed(&servo.target_q, &servo.target_qd)),
            Output::JointTemperatures => doubles(to, &[JOINT_TEMPERATURE_C; 6]),
            Output::ActualJointVoltage => doubles(to, &[self.robot_voltage(); 6]),
            Output::ActualMainVoltage => doubles(to, &[SUPPLY_V]),
            Output::ActualRobotVoltage => doubles(to, &[self.robot_voltage()]),
            Output::StandardAnalogOutput(n) => doubles(to, &[robot.analog_out[usize::from(n)]]),
            Output::SpeedScaling => doubles(to, &[self.speed_scaling()]),
            Output::TargetSpeedFraction => doubles(to, &[robot.speed_slider()]),
            Output::Payload => doubles(to, &[robot.payload.0]),
            Output::PayloadCog => doubles(to, &robot.payload.1),
            Output::JointMode => (0..6).for_each(|_| to.extend(i32::from(self.joint_mode()).to_be_bytes())),
            Output::ActualDigitalOutputBits => to.extend(robot.digital_out.to_be_bytes()),
            Output::RobotMode => to.extend((self.robot_mode() as i32).to_be_bytes()),
            Output::SafetyMode => to.extend((self.safety_mode() as i32).to_be_bytes()),
            Output::RuntimeState => to.extend((self.runtime_state() as u32).to_be_bytes()),
            Output::RobotStatusBits => to.extend(self.robot_status_bits().to_be_bytes()),
            Output::SafetyStatusBits => to.extend(self.safety_status_bits().to_be_bytes()),
            Output::ScriptControlLine => to.extend(self.programs.script_line().to_be_bytes()),
            Output::IntRegister(n) => int(&robot.outputs, n, to),
            Output::DoubleRegister(n) => double(&robot.outputs, n, to),
            Output::BitRegister(n) => bit(&robot.outputs, n, to),
            Output::BitRegisters(first) => to.extend(robot.outputs.word(first).to_be_bytes()),
            Output::Input(input) => match input {
                Input::IntRegister(n) => int(&robot.inputs, n, to),
                Input::DoubleRegister(n) => double(&robot.inputs, n, to),
                Input::BitRegister(n) => bit(&robot.inputs, n, to),
                Input::BitRegisters(first) => to.extend(robot.inputs.word(first).to_be_bytes()),
                other => zeros(to, other.wire_type().bytes()),
            },
            Output::Zero(wire_type) => zeros(to, wire_type.bytes()),
        }
    }
}

fn int(registers: &Registers, n: u8, to: &mut Vec<u8>) {
    to.extend(registers.int[usize::from(n)].to_be_bytes());
}

fn double(registers: &Registers, n: u8, to: &mut Vec<u8>) {
    doubles(to, &[registers.double[usize::from(n)]]);
}

fn bit(registers: &Registers, n: u8, to: &mut Vec<u8>) {
    to.push(u8::from(registers.bit(usize::from(n))));
}
