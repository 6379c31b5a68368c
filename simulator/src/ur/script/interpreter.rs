//! The stack machine that runs a program, one control cycle at a time.
//!
//! A step runs every thread of the program, oldest first, until it waits: for the next cycle (`sync`), for time (`sleep`,
//! `servoj`), for the arm (`stopj`, `movej`) or for another thread (`join`). Runs on the controller's thread; allocates within
//! fixed bounds. A mistake ends the program, with its line.

use std::sync::Arc;

use super::ScriptError;
use super::builtin::{BuiltinFunction, Effect};
use super::compile::{Code, Op, compile};
use super::syntax::ProgramTree;
use super::thread::{CallFrame, Effort, MAX_OPS_PER_CYCLE, Pace, ScriptThread, Wait, pop, take};
use super::value::Value;
use crate::ur::robot::Robot;

/// Most calls at once, in all threads together. Chosen by hand; no measurement is recorded.
const MAX_CALLS: usize = 128;
/// Most threads at once, the program's own included. Chosen by hand; no measurement is recorded.
const MAX_THREADS: usize = 32;

/// How a control cycle of a program ended.
#[derive(Debug, Clone, PartialEq)]
pub enum StepOutcome {
    /// The program goes on in the next cycle.
    Running,
    /// The program ran its last statement, or `halt`.
    Ended,
    /// The program asked to be paused.
    Paused,
    /// The program made a mistake.
    Failed(ScriptError),
}

/// Why a thread's turn ended.
enum TurnEnd {
    Waits,
    Finished,
    Halt,
    Pause,
}

/// What an instruction came to: the end of the thread's turn, or None when the turn goes on. The error has no line yet.
type InstructionResult = Result<Option<TurnEnd>, String>;

/// A running program.
#[derive(Debug)]
pub struct Interpreter {
    code: Arc<Code>,
    globals: Vec<Option<Value>>,
    /// The threads, oldest first.
    threads: Vec<ScriptThread>,
    /// Number of calls in all threads.
    calls: usize,
    next_id: u32,
    /// True when each float is rounded to 32 bits.
    single_precision: bool,
    effort: Effort,
}

impl Interpreter {
    /// Compiles a program and stands before its first statement.
    ///
    /// # Errors
    /// The first mistake that the compiler finds, with its line.
    pub fn new(tree: &ProgramTree) -> Result<Self, ScriptError> {
        let code = compile(tree)?;
        let globals = vec![None; code.globals.len()];
        let mut interpreter = Self {
            code: Arc::new(code),
            globals,
            threads: Vec::new(),
            calls: 0,
            next_id: 0,
            single_precision: false,
            effort: Effort::default(),
        };
        interpreter.spawn(0);
        Ok(interpreter)
    }

    /// Lets the program compute with floats of 32 bits instead of 64.
    pub fn set_single_precision(&mut self, single: bool) {
        self.single_precision = single;
    }

    /// What the program did in the last control cycle.
    pub fn effort(&self) -> Effort {
        self.effort
    }

    fn spawn(&mut self, routine: usize) -> u32 {
        let id = self.next_id;
        self.next_id += 1;
        self.calls += 1;
        let call = CallFrame::new(routine, &self.code.routines[routine], Vec::new());
        self.threads.push(ScriptThread { id, calls: vec![call], stack: Vec::new(), wait: Wait::Nothing });
        id
    }

    fn lives(&self, id: u32) -> bool {
        self.threads.iter().any(|t| t.id == id)
    }

    /// Runs one control cycle.
    pub fn step(&mut self, robot: &mut Robot) -> StepOutcome {
        let effort = Effort::default();
        let mut pace = Pace { budget: MAX_OPS_PER_CYCLE, effort, counted: (0, 0), single_precision: self.single_precision };
        let outcome = self.turns(robot, &mut pace);
        self.effort = pace.effort;
        outcome
    }

    /// Lets every thread have its turn.
    fn turns(&mut self, robot: &mut Robot, pace: &mut Pace) -> StepOutcome {
        let mut i = 0;
        while i < self.threads.len() {
            if !self.may_go_on(i, robot) {
                i += 1;
                continue;
            }
            match self.turn(i, robot, pace) {
                Ok(TurnEnd::Waits) => i += 1,
                Ok(TurnEnd::Finished) if self.threads[i].id == 0 => return StepOutcome::Ended,
                Ok(TurnEnd::Finished) => drop(self.threads.remove(i)),
                Ok(TurnEnd::Halt) => return StepOutcome::Ended,
                Ok(TurnEnd::Pause) => return StepOutcome::Paused,
                Err(error) => return StepOutcome::Failed(error),
            }
            // `kill` may have shortened the list.
            i = i.min(self.threads.len());
        }
        StepOutcome::Running
    }

    /// Line at which the program's own thread stands, from 1; 0 when there is none.
    pub fn line(&self) -> u32 {
        self.threads.first().and_then(|t| t.calls.last()).and_then(|c| self.code.lines.get(c.at)).copied().unwrap_or(0)
    }

    /// Lets a cycle pass for a waiting thread; true if it may go on.
    fn may_go_on(&mut self, i: usize, robot: &Robot) -> bool {
        let done = match self.threads[i].wait {
            Wait::Join(id) => !self.lives(id),
            _ => self.threads[i].wait_a_cycle(robot),
        };
        if done {
            self.threads[i].wait = Wait::Nothing;
        }
        done
    }

    /// Runs a thread until it waits or ends.
    fn turn(&mut self, i: usize, robot: &mut Robot, pace: &mut Pace) -> Result<TurnEnd, ScriptError> {
        let code = self.code.clone();
        pace.counted = (0, 0);
        loop {
            let thread = &mut self.threads[i];
            let computed = thread.compute(&code, &mut self.globals, pace);
            // The place of the instruction that needs more than its thread, or that failed.
            let line = thread.calls.last().map_or(0, |call| code.lines[call.at - 1]);
            let op = computed.map_err(|what| ScriptError::new(line, what))?;
            let Some(op) = op else { return Ok(TurnEnd::Finished) };
            pace.effort.calls += u32::from(matches!(op, Op::Call(_) | Op::Builtin(_)));
            let next = match op {
                Op::Call(routine) => self.call(i, *routine),
                Op::Builtin(function) => self.call_builtin(i, function, robot),
                Op::Run(routine) => self.run(i, *routine),
                Op::Join => self.join(i),
                Op::Kill => self.kill(i),
                Op::Return => {
                    let end = self.return_to_caller(i);
                    // The caller's statement goes on and does not begin again.
                    if let Some(caller) = self.threads[i].calls.last() {
                        pace.counted = (code.lines[caller.at], caller.at);
                    }
                    Ok(end)
                }
                Op::Pause => Ok(Some(TurnEnd::Pause)),
                _ => Ok(Some(TurnEnd::Halt)),
            };
            if matches!(op, Op::Builtin(_))
                && let Some(thread) = self.threads.get_mut(i)
            {
                pace.round(&mut thread.stack);
            }
            if let Some(end) = next.map_err(|what| ScriptError::new(line, what))? {
                return Ok(end);
            }
        }
    }

    fn call(&mut self, i: usize, routine: usize) -> InstructionResult {
        let target = &self.code.routines[routine];
        if self.calls >= MAX_CALLS {
            return Err(format!("more than {MAX_CALLS} calls within calls"));
        }
        self.calls += 1;
        let arguments = take(&mut self.threads[i].stack, target.parameters);
        self.threads[i].calls.push(CallFrame::new(routine, target, arguments));
        Ok(None)
    }

    fn call_builtin(&mut self, i: usize, function: &BuiltinFunction, robot: &mut Robot) -> InstructionResult {
        let thread = &mut self.threads[i];
        let at = thread.stack.len().saturating_sub(function.parameters.len());
        let effect = (function.call)(&thread.stack[at..], robot)?;
        thread.stack.truncate(at);
        let wait = match effect {
            Effect::Value(value) => {
                thread.stack.push(value);
                return Ok(None);
            }
            Effect::Cycle => Wait::Cycle,
            Effect::Sleep { time_s } => Wait::Sleep { left_s: time_s },
            Effect::Servo { time_s } => Wait::Servo { left_s: time_s },
            Effect::Motion => Wait::Motion,
        };
        thread.stack.push(Value::None);
        let (id, moves) = (thread.id, wait.moves_robot());
        thread.wait = wait;
        if moves && self.threads.iter().any(|t| t.id != id && t.wait.moves_robot()) {
            return Err("another thread is already moving the robot".to_owned());
        }
        Ok(Some(TurnEnd::Waits))
    }

    fn run(&mut self, i: usize, routine: usize) -> InstructionResult {
        if self.threads.len() >= MAX_THREADS || self.calls >= MAX_CALLS {
            return Err(format!("more than {MAX_THREADS} threads or {MAX_CALLS} calls within calls"));
        }
        let id = self.spawn(routine);
        self.threads[i].stack.push(Value::Thread(id));
        Ok(None)
    }

    fn join(&mut self, i: usize) -> InstructionResult {
        let thread = &mut self.threads[i];
        let Value::Thread(id) = pop(&mut thread.stack) else { return Err("'join' needs a thread".to_owned()) };
        if id == thread.id {
            return Err("a thread cannot wait for itself".to_owned());
        }
        if !self.lives(id) {
            return Ok(None);
        }
        self.threads[i].wait = Wait::Join(id);
        Ok(Some(TurnEnd::Waits))
    }

    fn kill(&mut self, i: usize) -> InstructionResult {
        let thread = &mut self.threads[i];
        let Value::Thread(id) = pop(&mut thread.stack) else { return Err("'kill' needs a thread".to_owned()) };
        if id == thread.id || id == 0 {
            return Err("'kill' ends another thread; 'return' or 'halt' ends this one".to_owned());
        }
        let own = thread.id;
        self.calls -= self.threads.iter().filter(|t| t.id == id).map(|t| t.calls.len()).sum::<usize>();
        self.threads.retain(|t| t.id != id);
        if self.threads.get(i).is_some_and(|t| t.id == own) {
            return Ok(None);
        }
        // An older thread went, so this one moved up by one place. Its turn goes on in the next cycle.
        if let Some(moved) = self.threads.iter_mut().find(|t| t.id == own) {
            moved.wait = Wait::Cycle;
        }
        Ok(Some(TurnEnd::Waits))
    }

    /// Ends the innermost call; its value stays on the stack for the caller.
    fn return_to_caller(&mut self, i: usize) -> Option<TurnEnd> {
        self.threads[i].calls.pop();
        self.calls -= 1;
        self.threads[i].calls.is_empty().then_some(TurnEnd::Finished)
    }
}
