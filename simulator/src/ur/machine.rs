//! The controller itself, without sockets: power, safety, the running program, registers, watchdogs and the arm.
//!
//! A pure step per control cycle: given the same inputs at the same cycles it does the same. Runs on the controller's thread;
//! allocates for programs and log lines only, within bounds. What a robot answers with a popup or a line in its log is a
//! [`LogLine`] here.

use std::collections::VecDeque;
use std::str::FromStr;

use super::kinematics;
use super::script::{Interpreter, Outcome, ScriptError, parse};
use super::servo::{self, Servo};
use super::ur_rtde::UrRtde;
use super::variables::{Input, Output, Registers, Series, Version};

/// Controller time at start, s: a robot has been up for a while before anyone connects.
const START_S: f64 = 60.0;
/// From the last byte of a program to its first statement, s.
const PROGRAM_START_S: f64 = 0.048;
/// A protective stop can be unlocked after this time, s (dashboard manual).
const UNLOCK_S: f64 = 5.0;
/// Powering on and releasing the brakes take this long here, s; a UR5 needs several.
const POWER_STEP_S: f64 = 0.5;
/// Log lines kept until somebody takes them.
pub(super) const LOG_LINES: usize = 1000;
/// Longest log line, bytes.
const LOG_LINE_BYTES: usize = 1024;

/// robot_mode of RTDE.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RobotMode {
    /// No power on the arm.
    PowerOff = 3,
    /// Power is coming.
    PowerOn = 4,
    /// Powered, brakes on.
    Idle = 5,
    /// Brakes off, ready to move.
    Running = 7,
}

impl RobotMode {
    /// As the dashboard says it.
    pub fn name(self) -> &'static str {
        match self {
            RobotMode::PowerOff => "POWER_OFF",
            RobotMode::PowerOn => "POWER_ON",
            RobotMode::Idle => "IDLE",
            RobotMode::Running => "RUNNING",
        }
    }
}

/// safety_mode of RTDE.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SafetyMode {
    /// Nothing stops the arm.
    Normal = 1,
    /// Stopped because of a demand or collision; to be unlocked.
    ProtectiveStop = 3,
    /// The pendant's emergency stop button is pressed.
    RobotEmergencyStop = 7,
}

impl SafetyMode {
    /// As the dashboard says it.
    pub fn name(self) -> &'static str {
        match self {
            SafetyMode::Normal => "NORMAL",
            SafetyMode::ProtectiveStop => "PROTECTIVE_STOP",
            SafetyMode::RobotEmergencyStop => "ROBOT_EMERGENCY_STOP",
        }
    }
}

/// runtime_state of RTDE.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)] // the names are the protocol's
pub enum RuntimeState {
    Stopping = 0,
    Stopped = 1,
    Playing = 2,
    Pausing = 3,
    Paused = 4,
    Resuming = 5,
}

/// What a lapsed watchdog does.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[allow(missing_docs)]
pub enum WatchdogAction {
    Ignore,
    Pause,
    Stop,
}

impl FromStr for WatchdogAction {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "ignore" => Ok(Self::Ignore),
            "pause" => Ok(Self::Pause),
            "stop" => Ok(Self::Stop),
            other => Err(format!("watchdog action \"{other}\" is none of ignore, pause, stop")),
        }
    }
}

#[derive(Debug, Clone, Copy)]
struct Watchdog {
    input: Input,
    /// Cycles without an update after which it lapses.
    cycles: f64,
    action: WatchdogAction,
    set_at: u64,
}

/// What a log line is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogKind {
    /// The program's own textmsg.
    Text,
    /// The program is wrong, or was refused.
    ProgramError,
    /// A safety or program event of the controller.
    Event,
}

/// A line of the controller's log.
#[derive(Debug, Clone, PartialEq)]
pub struct LogLine {
    /// Controller time, s.
    pub timestamp_s: f64,
    /// What it is about.
    pub kind: LogKind,
    /// The line.
    pub text: String,
}

/// All that a running program can see and touch.
#[derive(Debug)]
pub struct Robot {
    /// The arm.
    pub servo: Servo,
    /// What clients wrote.
    pub inputs: Registers,
    /// What the program wrote.
    pub outputs: Registers,
    /// Digital outputs, bits as in actual_digital_output_bits.
    pub digital_out: u64,
    analog_out: [f64; 2],
    speed_slider: f64,
    slider_mask: u32,
    slider_fraction: f64,
    digital_mask: [u8; 3],
    analog_mask: u8,
    steptime_s: f64,
    cycle: u64,
    watchdogs: Vec<Watchdog>,
    updated: [u64; Input::SLOTS],
    /// Set by a demand that the arm cannot follow; the machine turns it into a protective stop.
    protective_stop: Option<String>,
    log: VecDeque<LogLine>,
}

impl Robot {
    /// Seconds of a control cycle.
    pub fn steptime_s(&self) -> f64 {
        self.steptime_s
    }

    /// Controller time, s.
    pub fn timestamp_s(&self) -> f64 {
        START_S + self.cycle as f64 * self.steptime_s
    }

    /// Share of full speed that the speed slider leaves, 0 to 1.
    pub fn speed_scaling(&self) -> f64 {
        self.speed_slider
    }

    /// Moves the speed slider to `share` of full speed, 0 to 1.
    pub fn set_speed_slider(&mut self, share: f64) {
        self.speed_slider = share;
    }

    /// servoj; a demand that cannot be followed becomes a protective stop.
    pub fn servoj(&mut self, q: [f64; 6], lookahead_s: f64, gain: f64) {
        let result = self.servo.servoj(q, lookahead_s, gain);
        self.absurd(result);
    }

    /// movej
    pub fn movej(&mut self, q: [f64; 6], acceleration_rad_s2: f64, speed_rad_s: f64) {
        let result = self.servo.movej(q, acceleration_rad_s2, speed_rad_s);
        self.absurd(result);
    }

    /// speedj
    pub fn speedj(&mut self, qd: [f64; 6], acceleration_rad_s2: f64) {
        let result = self.servo.speedj(qd, acceleration_rad_s2);
        self.absurd(result);
    }

    fn absurd(&mut self, result: Result<(), String>) {
        if let Err(reason) = result {
            self.protective_stop.get_or_insert(reason);
        }
    }

    /// rtde_set_watchdog: replaces an earlier one for the same input. A frequency of 0 lapses at once, as on a robot.
    pub fn set_watchdog(&mut self, input: Input, min_frequency_hz: f64, action: WatchdogAction) {
        self.watchdogs.retain(|w| w.input != input);
        let cycles = if min_frequency_hz > 0.0 { 1.0 / (min_frequency_hz * self.steptime_s) } else { 0.0 };
        self.watchdogs.push(Watchdog { input, cycles, action, set_at: self.cycle });
    }

    /// A line of the program's own.
    pub fn textmsg(&mut self, text: &str) {
        self.note(LogKind::Text, text);
    }

    fn note(&mut self, kind: LogKind, text: &str) {
        if self.log.len() >= LOG_LINES {
            self.log.pop_front();
        }
        let mut end = text.len().min(LOG_LINE_BYTES);
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        self.log.push_back(LogLine { timestamp_s: self.timestamp_s(), kind, text: text[..end].to_owned() });
    }
}

#[derive(Debug)]
enum Program {
    Script(Interpreter),
    UrRtde(UrRtde),
}

impl Program {
    fn step(&mut self, robot: &mut Robot) -> Outcome {
        match self {
            Program::Script(interpreter) => interpreter.step(robot),
            Program::UrRtde(emulation) => emulation.step(robot),
        }
    }
}

/// A UR5 controller without its sockets.
#[derive(Debug)]
pub struct Machine {
    /// What programs see.
    pub robot: Robot,
    series: Series,
    version: Version,
    mode: RobotMode,
    safety: SafetyMode,
    runtime: RuntimeState,
    /// Cycle at which the present power step is over, and what comes then.
    power_step: Option<(u64, RobotMode)>,
    stopped_at: u64,
    program: Option<Program>,
    program_name: String,
    starting: Option<(u64, String, Program)>,
    secondary: Vec<Interpreter>,
    late_start_s: f64,
    /// e-Series only: scripts and dashboard motion commands are taken.
    remote_control: bool,
}

impl Machine {
    /// A controller that stands ready with its brakes off at `start_q_rad`.
    pub fn new(series: Series, version: Version, start_q_rad: [f64; 6]) -> Self {
        let robot = Robot {
            servo: Servo::new(start_q_rad),
            inputs: Registers::default(),
            outputs: Registers::default(),
            digital_out: 0,
            analog_out: [0.0; 2],
            speed_slider: 1.0,
            slider_mask: 0,
            slider_fraction: 0.0,
            digital_mask: [0; 3],
            analog_mask: 0,
            steptime_s: 1.0 / series.rate_hz(),
            cycle: 0,
            watchdogs: Vec::new(),
            updated: [0; Input::SLOTS],
            protective_stop: None,
            log: VecDeque::new(),
        };
        Self {
            robot,
            series,
            version,
            mode: RobotMode::Running,
            safety: SafetyMode::Normal,
            runtime: RuntimeState::Stopped,
            power_step: None,
            stopped_at: 0,
            program: None,
            program_name: String::new(),
            starting: None,
            secondary: Vec::new(),
            late_start_s: 0.0,
            remote_control: true,
        }
    }

    /// Its generation.
    pub fn series(&self) -> Series {
        self.series
    }

    /// Its version.
    pub fn version(&self) -> Version {
        self.version
    }

    /// robot_mode
    pub fn robot_mode(&self) -> RobotMode {
        self.mode
    }

    /// safety_mode
    pub fn safety_mode(&self) -> SafetyMode {
        self.safety
    }

    /// runtime_state
    pub fn runtime_state(&self) -> RuntimeState {
        self.runtime
    }

    /// Name of the running, paused or last program; empty before the first.
    pub fn program_name(&self) -> &str {
        &self.program_name
    }

    /// Control cycles since the start.
    pub fn cycle(&self) -> u64 {
        self.robot.cycle
    }

    /// False for an e-Series in local control.
    pub fn remote_control(&self) -> bool {
        self.remote_control
    }

    /// Switches an e-Series between local and remote control; a CB3 has no such mode.
    pub fn set_remote_control(&mut self, remote: bool) {
        self.remote_control = remote || self.series == Series::Cb3;
    }

    /// The next programs start this much later than usual.
    pub fn set_late_start(&mut self, late_s: f64) {
        self.late_start_s = late_s;
    }

    /// Takes the log lines written since the last call.
    pub fn take_log(&mut self) -> impl Iterator<Item = LogLine> + '_ {
        self.robot.log.drain(..)
    }

    fn cycles(&self, time_s: f64) -> u64 {
        (time_s / self.robot.steptime_s).round() as u64
    }

    /// Lets one control cycle pass.
    pub fn step(&mut self) {
        self.robot.cycle += 1;
        if let Some((_, next)) = self.power_step.take_if(|(at, _)| *at <= self.robot.cycle) {
            self.mode = next;
            if next == RobotMode::PowerOn {
                self.power_step = Some((self.robot.cycle + self.cycles(POWER_STEP_S), RobotMode::Idle));
            }
        }
        match self.runtime {
            RuntimeState::Stopping => self.runtime = RuntimeState::Stopped,
            RuntimeState::Pausing => self.runtime = RuntimeState::Paused,
            RuntimeState::Resuming => self.runtime = RuntimeState::Playing,
            _ => {}
        }
        if let Some((_, name, program)) = self.starting.take_if(|(at, _, _)| *at <= self.robot.cycle) {
            self.program = Some(program);
            self.robot.watchdogs.clear();
            self.runtime = RuntimeState::Playing;
            self.event(format!("program {name} started"));
            self.program_name = name;
        }
        for mut secondary in std::mem::take(&mut self.secondary) {
            match secondary.step(&mut self.robot) {
                Outcome::Ended => {}
                Outcome::Failed(error) => self.program_error(&format!("secondary program: {error}")),
                _ => self.program_error("secondary program: it must not let time pass"),
            }
        }
        if self.runtime == RuntimeState::Playing {
            self.step_program();
        }
        if let Some(reason) = self.robot.protective_stop.take() {
            self.protective_stop(&reason);
        }
        self.robot.servo.step(self.robot.steptime_s);
    }

    fn step_program(&mut self) {
        let Some(program) = &mut self.program else { return };
        match program.step(&mut self.robot) {
            Outcome::Running => {}
            Outcome::Ended => {
                self.event(format!("program {} ended", self.program_name));
                self.end_program();
                return;
            }
            Outcome::Paused => {
                self.pause();
                return;
            }
            Outcome::Failed(error) => {
                self.program_error(&format!("program {}: {error}", self.program_name));
                self.end_program();
                return;
            }
        }
        let cycle = self.robot.cycle;
        let updated = &self.robot.updated;
        let lapsed = |w: &&Watchdog| (cycle - updated[w.input.slot()].max(w.set_at)) as f64 > w.cycles;
        let Some(watchdog) = self.robot.watchdogs.iter().filter(|w| w.action != WatchdogAction::Ignore).find(lapsed).copied() else {
            return;
        };
        self.event(format!("watchdog of {:?} lapsed: {:?}", watchdog.input, watchdog.action));
        match watchdog.action {
            WatchdogAction::Stop => self.end_program(),
            _ => drop(self.pause()),
        }
    }

    fn event(&mut self, text: String) {
        self.robot.note(LogKind::Event, &text);
    }

    /// Notes that a program is wrong or was refused.
    pub fn program_error(&mut self, text: &str) {
        self.robot.note(LogKind::ProgramError, text);
    }

    fn end_program(&mut self) {
        self.program = None;
        self.robot.watchdogs.clear();
        self.runtime = RuntimeState::Stopping;
        self.robot.servo.stop(servo::STOP_RAD_S2);
    }

    /// A program arrived on 30001, 30002 or 30003.
    pub fn upload(&mut self, source: &str) {
        if !self.remote_control {
            return self.program_error("program ignored: the robot is in local control; switch it to remote control on the pendant");
        }
        if self.mode != RobotMode::Running || self.safety != SafetyMode::Normal {
            let (mode, safety) = (self.mode.name(), self.safety.name());
            return self.program_error(&format!("program not started: robot mode {mode}, safety mode {safety}"));
        }
        let loaded = match UrRtde::recognise(source) {
            Some(emulation) => emulation.map(|e| ("rtde_control".to_owned(), Program::UrRtde(e))),
            None => match parse(source).and_then(|unit| Interpreter::new(&unit).map(|i| (unit, i))) {
                Ok((unit, interpreter)) if unit.secondary => return self.secondary.push(interpreter),
                Ok((unit, interpreter)) => Ok((unit.name, Program::Script(interpreter))),
                Err(error) => Err(error),
            },
        };
        if self.program.is_some() {
            self.event(format!("program {} replaced", self.program_name));
            self.end_program();
        }
        self.starting = None;
        match loaded {
            Ok((name, program)) => {
                let start = self.robot.cycle + self.cycles(PROGRAM_START_S + self.late_start_s);
                self.starting = Some((start, name, program));
            }
            Err(error) => self.program_error(&format!("program not started: {error}")),
        }
    }

    /// Stops the program, as the pendant's stop button does. False: there is none.
    pub fn stop_program(&mut self) -> bool {
        if self.program.is_none() && self.starting.is_none() {
            return false;
        }
        self.starting = None;
        if self.program.is_some() {
            self.event(format!("program {} stopped on the pendant", self.program_name));
            self.end_program();
        }
        true
    }

    /// Pauses the running program. False: none is running.
    pub fn pause(&mut self) -> bool {
        if self.runtime != RuntimeState::Playing {
            return false;
        }
        self.event(format!("program {} paused", self.program_name));
        self.runtime = RuntimeState::Pausing;
        self.robot.servo.stop(servo::STOP_RAD_S2);
        true
    }

    /// Lets a paused program go on. False: none is paused, or the robot may not move.
    pub fn resume(&mut self) -> bool {
        let may = self.mode == RobotMode::Running && self.safety == SafetyMode::Normal;
        let paused = matches!(self.runtime, RuntimeState::Pausing | RuntimeState::Paused);
        if !may || !paused || self.program.is_none() {
            return false;
        }
        self.event(format!("program {} resumed", self.program_name));
        // Time in the pause does not count.
        self.robot.watchdogs.iter_mut().for_each(|w| w.set_at = self.robot.cycle);
        self.runtime = RuntimeState::Resuming;
        true
    }

    /// Stops the arm as fast as it can and pauses the program, for `reason`.
    pub fn protective_stop(&mut self, reason: &str) {
        if self.safety != SafetyMode::Normal || self.mode != RobotMode::Running {
            return;
        }
        self.event(format!("protective stop: {reason}"));
        self.safety = SafetyMode::ProtectiveStop;
        self.stopped_at = self.robot.cycle;
        self.robot.servo.stop(servo::FAST_STOP_RAD_S2);
        if self.program.is_some() {
            self.runtime = RuntimeState::Paused;
        }
        self.starting = None;
    }

    /// Unlocks a protective stop. Err: the dashboard's answer.
    pub fn unlock_protective_stop(&mut self) -> Result<(), &'static str> {
        if self.safety != SafetyMode::ProtectiveStop {
            // A robot answers the same whether or not it was stopped.
            return Ok(());
        }
        if self.robot.cycle - self.stopped_at < self.cycles(UNLOCK_S) {
            return Err(
                "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop before unlocking",
            );
        }
        self.safety = SafetyMode::Normal;
        self.event("protective stop unlocked".to_owned());
        Ok(())
    }

    /// The emergency stop button is pressed: the program ends, the arm stops and loses power.
    pub fn emergency_stop(&mut self) {
        if self.safety == SafetyMode::RobotEmergencyStop {
            return;
        }
        self.event("emergency stop pressed".to_owned());
        self.safety = SafetyMode::RobotEmergencyStop;
        self.starting = None;
        if self.program.is_some() {
            self.end_program();
        }
        self.robot.servo.stop(servo::FAST_STOP_RAD_S2);
        self.mode = RobotMode::PowerOff;
        self.power_step = None;
    }

    /// The emergency stop button is released; power must still be switched on and the brakes released.
    pub fn release_emergency_stop(&mut self) {
        if self.safety == SafetyMode::RobotEmergencyStop {
            self.safety = SafetyMode::Normal;
            self.event("emergency stop released".to_owned());
        }
    }

    /// Switches the arm's power on. False: the emergency stop is pressed.
    pub fn power_on(&mut self) -> bool {
        if self.safety == SafetyMode::RobotEmergencyStop {
            return false;
        }
        if self.mode == RobotMode::PowerOff && self.power_step.is_none() {
            self.power_step = Some((self.robot.cycle + self.cycles(POWER_STEP_S), RobotMode::PowerOn));
        }
        true
    }

    /// Switches the arm's power off.
    pub fn power_off(&mut self) {
        self.starting = None;
        if self.program.is_some() {
            self.end_program();
        }
        self.robot.servo.stop(servo::FAST_STOP_RAD_S2);
        self.mode = RobotMode::PowerOff;
        self.power_step = None;
    }

    /// Releases the brakes, switching the power on first if need be. False: the emergency stop is pressed.
    pub fn brake_release(&mut self) -> bool {
        if !self.power_on() {
            return false;
        }
        if self.mode == RobotMode::Idle && self.power_step.is_none() {
            self.power_step = Some((self.robot.cycle + self.cycles(POWER_STEP_S), RobotMode::Running));
        }
        true
    }

    /// A client wrote `input`; `value` has the type's bytes, big-endian.
    pub fn write_input(&mut self, input: Input, value: &[u8]) {
        let robot = &mut self.robot;
        robot.updated[input.slot()] = robot.cycle;
        let byte = value.first().copied().unwrap_or(0);
        let word = value.first_chunk().map_or(0, |b| u32::from_be_bytes(*b));
        let double = value.first_chunk().map_or(0.0, |b| f64::from_be_bytes(*b));
        let bits = |of: &mut u64, shift: u32, mask: u8| *of = *of & !(u64::from(mask) << shift) | (u64::from(byte & mask) << shift);
        match input {
            Input::IntRegister(n) => robot.inputs.int[usize::from(n)] = word as i32,
            Input::DoubleRegister(n) => robot.inputs.double[usize::from(n)] = double,
            Input::BitRegister(n) => {
                robot.inputs.bits = robot.inputs.bits & !(1 << n) | (u128::from(byte != 0) << n);
            }
            Input::BitRegisters(n) => robot.inputs.bits = robot.inputs.bits & !(0xFFFF_FFFF << n) | (u128::from(word) << n),
            Input::SpeedSliderMask => robot.slider_mask = word,
            Input::SpeedSliderFraction => robot.slider_fraction = double,
            Input::StandardDigitalOutputMask => robot.digital_mask[0] = byte,
            Input::ConfigurableDigitalOutputMask => robot.digital_mask[1] = byte,
            Input::ToolDigitalOutputMask => robot.digital_mask[2] = byte,
            Input::StandardDigitalOutput => bits(&mut robot.digital_out, 0, robot.digital_mask[0]),
            Input::ConfigurableDigitalOutput => bits(&mut robot.digital_out, 8, robot.digital_mask[1]),
            Input::ToolDigitalOutput => bits(&mut robot.digital_out, 16, robot.digital_mask[2] & 3),
            Input::StandardAnalogOutputMask => robot.analog_mask = byte,
            Input::StandardAnalogOutput(n) => {
                if robot.analog_mask >> n & 1 == 1 && (0.0..=1.0).contains(&double) {
                    robot.analog_out[usize::from(n)] = double;
                }
            }
            Input::StandardAnalogOutputType | Input::ExternalForceTorque => {}
        }
        if robot.slider_mask & 1 == 1 && (0.0..=1.0).contains(&robot.slider_fraction) {
            robot.speed_slider = robot.slider_fraction;
        }
    }

    /// robot_status_bits
    pub fn robot_status_bits(&self) -> u32 {
        u32::from(self.mode != RobotMode::PowerOff) | u32::from(self.runtime == RuntimeState::Playing) << 1
    }

    /// safety_status_bits
    pub fn safety_status_bits(&self) -> u32 {
        match self.safety {
            SafetyMode::Normal => 1,
            SafetyMode::ProtectiveStop => 1 << 2 | 1 << 10,
            SafetyMode::RobotEmergencyStop => 1 << 6 | 1 << 7 | 1 << 10,
        }
    }

    /// Line that an interpreted program stands at; 0: none is running.
    pub fn script_line(&self) -> u32 {
        match &self.program {
            Some(Program::Script(interpreter)) => interpreter.line(),
            _ => 0,
        }
    }

    /// Appends the value of `output`, big-endian.
    pub fn read_output(&self, output: Output, to: &mut Vec<u8>) {
        let robot = &self.robot;
        let servo = &robot.servo;
        let powered = self.mode != RobotMode::PowerOff;
        fn vector(to: &mut Vec<u8>, values: &[f64]) {
            values.iter().for_each(|v| to.extend(v.to_be_bytes()));
        }
        let volts = if powered { 48.0 } else { 0.0 };
        match output {
            Output::Timestamp => vector(to, &[robot.timestamp_s()]),
            Output::TargetQ => vector(to, &servo.target_q),
            Output::TargetQd => vector(to, &servo.target_qd),
            Output::TargetQdd => vector(to, &servo.target_qdd),
            Output::ActualQ => vector(to, &servo.actual_q),
            Output::ActualQd => vector(to, &servo.actual_qd),
            Output::ActualTcpPose => vector(to, &kinematics::pose(&servo.actual_q)),
            Output::TargetTcpPose => vector(to, &kinematics::pose(&servo.target_q)),
            Output::ActualTcpSpeed => vector(to, &kinematics::speed(&servo.actual_q, &servo.actual_qd)),
            Output::TargetTcpSpeed => vector(to, &kinematics::speed(&servo.target_q, &servo.target_qd)),
            // Loads are not simulated: an arm that carries nothing and needs no current.
            Output::TargetCurrent
            | Output::TargetMoment
            | Output::ActualCurrent
            | Output::ActualCurrentAsTorque
            | Output::JointControlOutput
            | Output::ActualTcpForce
            | Output::PayloadInertia
            | Output::FtRawWrench => vector(to, &[0.0; 6]),
            Output::ActualToolAccelerometer | Output::PayloadCog => vector(to, &[0.0; 3]),
            Output::JointTemperatures => vector(to, &[27.0; 6]),
            Output::ActualJointVoltage => vector(to, &[volts; 6]),
            Output::ActualMainVoltage => vector(to, &[48.0]),
            Output::ActualRobotVoltage => vector(to, &[volts]),
            Output::ActualMomentum | Output::ActualRobotCurrent | Output::ActualExecutionTime | Output::Payload => vector(to, &[0.0]),
            Output::StandardAnalogInput => vector(to, &[0.0]),
            Output::StandardAnalogOutput(n) => vector(to, &[robot.analog_out[usize::from(n)]]),
            Output::SpeedScaling | Output::TargetSpeedFraction => vector(to, &[robot.speed_slider]),
            Output::JointMode => (0..6).for_each(|_| to.extend(if powered { 253i32 } else { 239 }.to_be_bytes())),
            Output::ActualDigitalInputBits => to.extend(0u64.to_be_bytes()),
            Output::ActualDigitalOutputBits => to.extend(robot.digital_out.to_be_bytes()),
            Output::RobotMode => to.extend((self.mode as i32).to_be_bytes()),
            Output::SafetyMode | Output::SafetyStatus => to.extend((self.safety as i32).to_be_bytes()),
            Output::RuntimeState => to.extend((self.runtime as u32).to_be_bytes()),
            Output::RobotStatusBits => to.extend(self.robot_status_bits().to_be_bytes()),
            Output::SafetyStatusBits => to.extend(self.safety_status_bits().to_be_bytes()),
            Output::ScriptControlLine => to.extend(self.script_line().to_be_bytes()),
            Output::IntRegister(n) => to.extend(robot.outputs.int[usize::from(n)].to_be_bytes()),
            Output::DoubleRegister(n) => vector(to, &[robot.outputs.double[usize::from(n)]]),
            Output::BitRegister(n) => to.push((robot.outputs.bits >> n & 1) as u8),
            Output::BitRegisters(n) => to.extend(((robot.outputs.bits >> n) as u32).to_be_bytes()),
            Output::Zero(kind) => to.extend(std::iter::repeat_n(0, kind.bytes())),
            Output::Input(input) => match input {
                Input::IntRegister(n) => to.extend(robot.inputs.int[usize::from(n)].to_be_bytes()),
                Input::DoubleRegister(n) => vector(to, &[robot.inputs.double[usize::from(n)]]),
                Input::BitRegister(n) => to.push((robot.inputs.bits >> n & 1) as u8),
                Input::BitRegisters(n) => to.extend(((robot.inputs.bits >> n) as u32).to_be_bytes()),
                other => to.extend(std::iter::repeat_n(0, other.kind().bytes())),
            },
        }
    }
}

/// Checks a program as an upload would, without running it.
pub fn check_program(source: &str) -> Result<(), ScriptError> {
    match UrRtde::recognise(source) {
        Some(result) => result.map(drop),
        None => parse(source).and_then(|unit| Interpreter::new(&unit)).map(drop),
    }
}
