//! The control program of the ur_rtde client library, which is recognised by its first line and not interpreted.
//!
//! This file keeps the program's register protocol of version 1.6.5 instead. The client puts a command into int register 0 and
//! its parameters into the double registers from 0 on; the program answers in output int register 0. All register numbers are
//! larger by 24 when the client uses the upper range. Pure, one step a control cycle, on the controller's thread; does not
//! allocate. A command that is not simulated ends the program, and the log says so.

use super::robot::Robot;
use super::script::{ScriptError, StepOutcome};
use super::variables::Input;
use super::watchdog::WatchdogAction;

/// First line of the program (ur_rtde 1.6.5).
const FIRST_LINE: &str = "def rtde_control():";
/// Answer: the program is ready for a command (ur_rtde 1.6.5).
const READY: i32 = 1;
/// Answer: the command is carried out (ur_rtde 1.6.5).
const DONE: i32 = 2;
/// Value of output int register 2 that says "no asynchronous operation is running" (ur_rtde 1.6.5).
const ASYNC_FINISHED: i32 = 1 << 16;

/// The numbers of the commands in ur_rtde 1.6.5.
mod command {
    pub const NONE: i32 = 0;
    pub const MOVE_J: i32 = 1;
    pub const SPEED_J: i32 = 9;
    pub const SERVO_J: i32 = 11;
    pub const SPEED_STOP: i32 = 15;
    pub const SERVO_STOP: i32 = 16;
    pub const STOP_L: i32 = 33;
    pub const STOP_J: i32 = 34;
    pub const SET_WATCHDOG: i32 = 35;
    pub const IS_POSE_WITHIN_SAFETY_LIMITS: i32 = 36;
    pub const IS_JOINTS_WITHIN_SAFETY_LIMITS: i32 = 37;
    pub const END_PROGRAM: i32 = 255;
}

/// What the program waits for before it takes the next command.
#[derive(Debug, Clone, Copy, PartialEq)]
enum WaitFor {
    Command,
    /// The arm must come to rest.
    Motion,
    /// The client must clear the command.
    Clear,
}

/// A running control program of ur_rtde.
#[derive(Debug, Clone, PartialEq)]
pub struct UrRtde {
    int_offset: usize,
    double_offset: usize,
    started: bool,
    wait_for: WaitFor,
    /// Time left of the servoj that the program's servo thread repeats at present, in s. None while it does not servo.
    servoj_left_s: Option<f64>,
}

fn fail(what: impl Into<String>) -> ScriptError {
    ScriptError { line: 1, what: what.into() }
}

impl UrRtde {
    /// Recognises the program. None when the source is another program.
    ///
    /// # Errors
    /// The source is ur_rtde's program, but its register offsets are not those that this controller knows.
    pub fn recognise(source: &str) -> Option<Result<Self, ScriptError>> {
        if source.lines().next()?.trim_end() != FIRST_LINE {
            return None;
        }
        let offset = |name: &str| {
            let at = source.find(name).ok_or_else(|| fail(format!("ur_rtde's program without {name}")))?;
            // The number stands on the line after the assignment's comment.
            let line = source[at..].lines().nth(1).unwrap_or("");
            let digits: String = line.chars().take_while(char::is_ascii_digit).collect();
            match digits.as_str() {
                "0" => Ok(0),
                "24" => Ok(24),
                other => Err(fail(format!("ur_rtde's {name} is '{other}', neither 0 nor 24"))),
            }
        };
        Some(offset("reg_offset_int =").and_then(|int_offset| {
            let double_offset = offset("reg_offset_float =")?;
            Ok(Self { int_offset, double_offset, started: false, wait_for: WaitFor::Command, servoj_left_s: None })
        }))
    }

    /// The command's parameters in the double registers from `first` on.
    fn parameters<const N: usize>(&self, robot: &Robot, first: usize) -> [f64; N] {
        std::array::from_fn(|i| robot.inputs.double[self.double_offset + first + i])
    }

    fn answer(&self, robot: &mut Robot, value: i32) {
        robot.outputs.int[self.int_offset] = value;
    }

    /// Runs one control cycle.
    pub fn step(&mut self, robot: &mut Robot) -> StepOutcome {
        if !self.started {
            self.started = true;
            robot.outputs.int[self.int_offset + 2] = ASYNC_FINISHED;
            self.answer(robot, READY);
        }
        let command = robot.inputs.int[self.int_offset];
        match self.wait_for {
            WaitFor::Motion if robot.servo.is_still() => {
                self.answer(robot, DONE);
                self.wait_for = WaitFor::Clear;
            }
            WaitFor::Clear if command == command::NONE => self.wait_for = WaitFor::Command,
            _ => {}
        }
        if self.wait_for != WaitFor::Command {
            return StepOutcome::Running;
        }
        match command {
            command::NONE => {}
            command::SPEED_J => {
                let [acceleration] = self.parameters(robot, 6);
                self.servoj_left_s = None;
                robot.speedj(self.parameters(robot, 0), acceleration);
            }
            command::SERVO_J => self.repeat_servoj(robot),
            command::END_PROGRAM => return StepOutcome::Ended,
            other => return self.carry_out_once(other, robot),
        }
        self.answer(robot, READY);
        StepOutcome::Running
    }

    /// Lets the servo thread take a new target when its present servoj is over.
    fn repeat_servoj(&mut self, robot: &mut Robot) {
        let [time_s, lookahead_s, gain] = self.parameters(robot, 8);
        let steptime_s = robot.steptime_s();
        match &mut self.servoj_left_s {
            Some(left_s) if *left_s > steptime_s * 1.001 => *left_s -= steptime_s * robot.speed_share(),
            _ => {
                self.servoj_left_s = Some(time_s);
                robot.servoj(self.parameters(robot, 0), lookahead_s, gain);
            }
        }
    }

    /// Carries out a command that is answered with "done".
    fn carry_out_once(&mut self, command: i32, robot: &mut Robot) -> StepOutcome {
        let mut wait_for = WaitFor::Motion;
        match command {
            command::MOVE_J => {
                let [speed, acceleration] = self.parameters(robot, 6);
                self.servoj_left_s = None;
                robot.movej(self.parameters(robot, 0), acceleration, speed);
                let asynchronous = robot.inputs.int[self.int_offset + 1] != 0;
                if asynchronous {
                    wait_for = WaitFor::Clear;
                }
            }
            command::SPEED_STOP | command::SERVO_STOP | command::STOP_L | command::STOP_J => {
                let [deceleration] = self.parameters(robot, 0);
                if !(1e-3..=1e3).contains(&deceleration) {
                    return StepOutcome::Failed(fail(format!("deceleration {deceleration} is outside 0.001 to 1000")));
                }
                self.servoj_left_s = None;
                robot.servo.stop(deceleration);
            }
            command::SET_WATCHDOG => {
                let [frequency_hz] = self.parameters(robot, 0);
                robot.set_watchdog(Input::IntRegister(self.int_offset as u8), frequency_hz, WatchdogAction::Stop);
                wait_for = WaitFor::Clear;
            }
            // No limits are simulated, so everything is within them.
            command::IS_POSE_WITHIN_SAFETY_LIMITS | command::IS_JOINTS_WITHIN_SAFETY_LIMITS => {
                robot.outputs.int[self.int_offset + 1] = 1;
                wait_for = WaitFor::Clear;
            }
            other => return StepOutcome::Failed(fail(format!("ur_rtde's command {other} is not simulated"))),
        }
        if wait_for == WaitFor::Clear {
            self.answer(robot, DONE);
        }
        self.wait_for = wait_for;
        StepOutcome::Running
    }
}
