//! The control program of the ur_rtde client library: recognised by its first line and not interpreted; this keeps its
//! register protocol instead (1.6.5: command in int register 0, parameters in double registers from 0, answer in output int
//! register 0: 1 ready, 2 done; every number shifted by 24 when the client uses the upper range).
//!
//! Pure, one step per control cycle, on the controller's thread. A command that is not simulated ends the program and says so.

use super::machine::{Robot, WatchdogAction};
use super::script::{Outcome, ScriptError};
use super::variables::Input;

/// Answer: ready for a command.
const READY: i32 = 1;
/// Answer: done with the command.
const DONE: i32 = 2;
/// Its first line.
const FIRST_LINE: &str = "def rtde_control():";

/// What a command still waits for before it is done.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Busy {
    Idle,
    /// The arm must come to rest.
    Motion,
    /// The client must clear the command.
    Clear,
}

/// A running ur_rtde control program.
#[derive(Debug, Clone, PartialEq)]
pub struct UrRtde {
    int_offset: usize,
    double_offset: usize,
    started: bool,
    busy: Busy,
    /// What the program's servo thread repeats: target, lookahead, gain, and the time left of the present servoj.
    servo: Option<([f64; 6], f64, f64, f64)>,
}

fn fail(what: impl Into<String>) -> ScriptError {
    ScriptError { line: 1, what: what.into() }
}

impl UrRtde {
    /// None: another program. Err: ur_rtde's, but not as this controller knows it.
    pub fn recognise(source: &str) -> Option<Result<Self, ScriptError>> {
        if source.lines().next()?.trim_end() != FIRST_LINE {
            return None;
        }
        let offset = |name: &str| {
            let at = source.find(name).ok_or_else(|| fail(format!("ur_rtde's program without {name}")))?;
            // The number is on the line after the assignment's comment.
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
            Ok(Self { int_offset, double_offset, started: false, busy: Busy::Idle, servo: None })
        }))
    }

    fn doubles<const N: usize>(&self, robot: &Robot, from: usize) -> [f64; N] {
        std::array::from_fn(|i| robot.inputs.double[self.double_offset + from + i])
    }

    fn answer(&self, robot: &mut Robot, value: i32) {
        robot.outputs.int[self.int_offset] = value;
    }

    /// Runs one control cycle.
    pub fn step(&mut self, robot: &mut Robot) -> Outcome {
        if !self.started {
            self.started = true;
            // "No asynchronous operation is running", as the program's first write says it.
            robot.outputs.int[self.int_offset + 2] = 1 << 16;
            self.answer(robot, READY);
        }
        let command = robot.inputs.int[self.int_offset];
        match self.busy {
            Busy::Motion if robot.servo.is_still() => {
                self.answer(robot, DONE);
                self.busy = Busy::Clear;
            }
            Busy::Clear if command == 0 => self.busy = Busy::Idle,
            _ => {}
        }
        if self.busy == Busy::Idle {
            match command {
                0 => self.answer(robot, READY),
                9 => {
                    let [acceleration] = self.doubles(robot, 6);
                    self.servo = None;
                    robot.speedj(self.doubles(robot, 0), acceleration);
                    self.answer(robot, READY);
                }
                11 => {
                    let [time_s, lookahead_s, gain] = self.doubles(robot, 8);
                    let target = self.doubles(robot, 0);
                    let steptime_s = robot.steptime_s();
                    match &mut self.servo {
                        // The servo thread takes a new target when its present servoj is over.
                        Some((.., left_s)) if *left_s > steptime_s * 1.001 => *left_s -= steptime_s,
                        _ => {
                            self.servo = Some((target, lookahead_s, gain, time_s));
                            robot.servoj(target, lookahead_s, gain);
                        }
                    }
                    self.answer(robot, READY);
                }
                255 => return Outcome::Ended,
                other => return self.once(other, robot),
            }
        }
        Outcome::Running
    }

    /// A command that is carried out once and then answered with "done".
    fn once(&mut self, command: i32, robot: &mut Robot) -> Outcome {
        let mut after = Busy::Motion;
        match command {
            // moveJ; asynchronous ones are done at once.
            1 => {
                let [speed, acceleration] = self.doubles(robot, 6);
                self.servo = None;
                robot.movej(self.doubles(robot, 0), acceleration, speed);
                if robot.inputs.int[self.int_offset + 1] != 0 {
                    after = Busy::Clear;
                }
            }
            // speedStop, servoStop, stopL, stopJ
            15 | 16 | 33 | 34 => {
                let [deceleration] = self.doubles(robot, 0);
                if !(1e-3..=1e3).contains(&deceleration) {
                    return Outcome::Failed(fail(format!("deceleration {deceleration} is outside 0.001 to 1000")));
                }
                self.servo = None;
                robot.servo.stop(deceleration);
            }
            // setWatchdog
            35 => {
                let [frequency] = self.doubles(robot, 0);
                robot.set_watchdog(Input::IntRegister(self.int_offset as u8), frequency, WatchdogAction::Stop);
                after = Busy::Clear;
            }
            // isPoseWithinSafetyLimits, isJointsWithinSafetyLimits: no limits are simulated.
            36 | 37 => {
                robot.outputs.int[self.int_offset + 1] = 1;
                after = Busy::Clear;
            }
            other => return Outcome::Failed(fail(format!("ur_rtde's command {other} is not simulated"))),
        }
        if after == Busy::Clear {
            self.answer(robot, DONE);
        }
        self.busy = after;
        Outcome::Running
    }
}
