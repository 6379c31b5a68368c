//! The life of programs: an upload is loaded, starts, runs a control cycle at a time, is paused and resumed, and ends.
//!
//! Pure, one step a control cycle, on the controller's thread; allocates when a program is loaded. A program with a mistake is
//! not started, or ends, and the log says why. Whether the robot may move at all is checked by [`super::machine`].

use super::robot::Robot;
use super::script::{Effort, Interpreter, ScriptError, StepOutcome, parse};
use super::servo;
use super::ur_rtde::UrRtde;
use super::watchdog::WatchdogAction;

/// Time from the last byte of a program to its first statement, in s. Chosen by hand; no measurement is recorded.
const START_DELAY_S: f64 = 0.048;

/// RTDE's runtime_state: the state of the program.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RuntimeState {
    /// The program ends in this cycle.
    Stopping = 0,
    /// No program runs.
    Stopped = 1,
    /// The program runs.
    Playing = 2,
    /// The program stops for a pause in this cycle.
    Pausing = 3,
    /// The program waits to be resumed.
    Paused = 4,
    /// The program goes on with the next cycle.
    Resuming = 5,
}

#[derive(Debug)]
enum Program {
    Script(Interpreter),
    UrRtde(UrRtde),
}

impl Program {
    fn step(&mut self, robot: &mut Robot) -> StepOutcome {
        match self {
            Program::Script(interpreter) => interpreter.step(robot),
            Program::UrRtde(emulation) => emulation.step(robot),
        }
    }
}

/// A program that was read and may be run.
enum Loaded {
    Main { name: String, program: Program },
    Secondary(Interpreter),
}

fn load(source: &str) -> Result<Loaded, ScriptError> {
    if let Some(emulation) = UrRtde::recognise(source) {
        return Ok(Loaded::Main { name: "rtde_control".to_owned(), program: Program::UrRtde(emulation?) });
    }
    let tree = parse(source)?;
    let interpreter = Interpreter::new(&tree)?;
    Ok(if tree.secondary {
        Loaded::Secondary(interpreter)
    } else {
        Loaded::Main { name: tree.name, program: Program::Script(interpreter) }
    })
}

/// Checks a program as an upload would, without running it.
///
/// # Errors
/// The program's first mistake, with its line.
pub fn check_program(source: &str) -> Result<(), ScriptError> {
    load(source).map(drop)
}

/// A program that was uploaded and begins to run at the cycle `at`.
#[derive(Debug)]
struct Starting {
    at: u64,
    name: String,
    program: Program,
}

/// The program that runs, the one that is about to start, and the secondary programs beside them.
#[derive(Debug)]
pub struct Programs {
    runtime: RuntimeState,
    running: Option<Program>,
    name: String,
    starting: Option<Starting>,
    secondary: Vec<Interpreter>,
    late_start_s: f64,
    single_precision: bool,
}

impl Default for Programs {
    fn default() -> Self {
        Self {
            runtime: RuntimeState::Stopped,
            running: None,
            name: String::new(),
            starting: None,
            secondary: Vec::new(),
            late_start_s: 0.0,
            single_precision: false,
        }
    }
}

impl Programs {
    /// The state of the program.
    pub fn runtime_state(&self) -> RuntimeState {
        self.runtime
    }

    /// Name of the running, paused or last program; empty before the first.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Lets the next programs start `late_s` later than usual.
    pub fn set_late_start(&mut self, late_s: f64) {
        self.late_start_s = late_s;
    }

    /// Lets the programs that are uploaded from now on compute with floats of 32 bits instead of 64.
    pub fn set_single_precision(&mut self, single: bool) {
        self.single_precision = single;
    }

    /// What an interpreted program did in the last control cycle; nothing when none is loaded.
    pub fn effort(&self) -> Effort {
        match &self.running {
            Some(Program::Script(interpreter)) => interpreter.effort(),
            _ => Effort::default(),
        }
    }

    /// Line at which an interpreted program stands; 0 when none is loaded.
    pub fn script_line(&self) -> u32 {
        match &self.running {
            Some(Program::Script(interpreter)) => interpreter.line(),
            _ => 0,
        }
    }

    /// Lets one control cycle pass for all programs.
    pub fn step(&mut self, robot: &mut Robot) {
        match self.runtime {
            RuntimeState::Stopping => self.runtime = RuntimeState::Stopped,
            RuntimeState::Pausing => self.runtime = RuntimeState::Paused,
            RuntimeState::Resuming => self.runtime = RuntimeState::Playing,
            _ => {}
        }
        if let Some(Starting { name, program, .. }) = self.starting.take_if(|s| s.at <= robot.cycle) {
            self.running = Some(program);
            robot.watchdogs.clear();
            self.runtime = RuntimeState::Playing;
            robot.event(&format!("program {name} started"));
            self.name = name;
        }
        for mut secondary in std::mem::take(&mut self.secondary) {
            match secondary.step(robot) {
                StepOutcome::Ended => {}
                StepOutcome::Failed(error) => robot.program_error(&format!("secondary program: {error}")),
                _ => robot.program_error("secondary program: it must not let time pass"),
            }
        }
        if self.runtime == RuntimeState::Playing {
            self.step_running(robot);
        }
    }

    fn step_running(&mut self, robot: &mut Robot) {
        let Some(program) = &mut self.running else { return };
        match program.step(robot) {
            StepOutcome::Running => self.obey_watchdogs(robot),
            StepOutcome::Ended => {
                robot.event(&format!("program {} ended", self.name));
                self.end(robot);
            }
            StepOutcome::Paused => drop(self.pause(robot)),
            StepOutcome::Failed(error) => {
                robot.program_error(&format!("program {}: {error}", self.name));
                self.end(robot);
            }
        }
    }

    fn obey_watchdogs(&mut self, robot: &mut Robot) {
        let Some(watchdog) = robot.watchdogs.lapsed(robot.cycle) else { return };
        robot.event(&format!("watchdog of {:?} lapsed: {:?}", watchdog.input, watchdog.action));
        match watchdog.action {
            WatchdogAction::Stop => self.end(robot),
            _ => drop(self.pause(robot)),
        }
    }

    fn end(&mut self, robot: &mut Robot) {
        self.running = None;
        robot.watchdogs.clear();
        self.runtime = RuntimeState::Stopping;
        robot.servo.stop(servo::STOP_RAD_S2);
    }

    /// Loads a program and lets it start after the usual delay. It replaces the program that runs; a secondary program runs
    /// beside it in the next cycle.
    pub fn upload(&mut self, source: &str, robot: &mut Robot) {
        let loaded = match load(source) {
            Ok(Loaded::Secondary(interpreter)) => return self.secondary.push(interpreter),
            Ok(Loaded::Main { name, mut program }) => {
                if let Program::Script(interpreter) = &mut program {
                    interpreter.set_single_precision(self.single_precision);
                }
                Ok((name, program))
            }
            Err(error) => Err(error),
        };
        self.starting = None;
        if matches!(self.runtime, RuntimeState::Pausing | RuntimeState::Paused) {
            // A robot that is paused, or was never started since its boot, only stops when it gets a program; the next one runs
            // (Universal_Robots_Client_Library #123).
            robot.event("the robot was paused: it is stopped, and the new program is not started");
            return self.end(robot);
        }
        if self.running.is_some() {
            robot.event(&format!("program {} replaced", self.name));
            self.end(robot);
        }
        match loaded {
            Ok((name, program)) => {
                let at = robot.cycle + robot.cycles(START_DELAY_S + self.late_start_s);
                self.starting = Some(Starting { at, name, program });
            }
            Err(error) => robot.program_error(&format!("program not started: {error}")),
        }
    }

    /// Stops the program, as the pendant's stop button does. False when there is none.
    pub fn stop(&mut self, robot: &mut Robot) -> bool {
        let paused = matches!(self.runtime, RuntimeState::Pausing | RuntimeState::Paused);
        if self.running.is_none() && self.starting.is_none() && !paused {
            return false;
        }
        self.starting = None;
        if self.running.is_some() || paused {
            robot.event(&format!("program {} stopped on the pendant", self.name));
            self.end(robot);
        }
        true
    }

    /// Ends the program because the arm loses its power.
    pub fn end_without_power(&mut self, robot: &mut Robot) {
        self.starting = None;
        if self.running.is_some() {
            self.end(robot);
        }
    }

    /// Pauses the running program. False when none is running.
    pub fn pause(&mut self, robot: &mut Robot) -> bool {
        if self.runtime != RuntimeState::Playing {
            return false;
        }
        robot.event(&format!("program {} paused", self.name));
        self.runtime = RuntimeState::Pausing;
        robot.servo.stop(servo::STOP_RAD_S2);
        true
    }

    /// Makes the controller look as after its boot: no program was ever there, and it counts as paused (Universal_Robots_Client_Library
    /// #123).
    pub fn boot(&mut self) {
        *self = Self { runtime: RuntimeState::Paused, ..Self::default() };
    }

    /// Pauses the running program at once because of a protective stop, and forgets one that is about to start.
    pub fn pause_for_protective_stop(&mut self) {
        if self.running.is_some() {
            self.runtime = RuntimeState::Paused;
        }
        self.starting = None;
    }

    /// Lets a paused program go on. False when none is paused.
    pub fn resume(&mut self, robot: &mut Robot) -> bool {
        let paused = matches!(self.runtime, RuntimeState::Pausing | RuntimeState::Paused);
        if !paused || self.running.is_none() {
            return false;
        }
        robot.event(&format!("program {} resumed", self.name));
        // The time of the pause does not count.
        robot.watchdogs.restart(robot.cycle);
        self.runtime = RuntimeState::Resuming;
        true
    }
}
