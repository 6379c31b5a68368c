//! The stack machine that runs a program, one control cycle at a time.
//!
//! A step runs every thread of the program, oldest first, until it waits: for the next cycle (`sync`), for time (`sleep`,
//! `servoj`), for the arm (`stopj`, `movej`) or for another thread (`join`). Runs on the controller's thread; allocates within
//! fixed bounds; a mistake ends the program with its line.

use std::sync::Arc;

use super::builtin::{self, Effect};
use super::compile::{Code, Op, compile};
use super::value::{Value, binary};
use super::{ScriptError, Unit};
use crate::ur::machine::Robot;

/// Most instructions in one control cycle. A robot stops a program that computes without ever letting time pass.
const MAX_OPS_PER_CYCLE: u32 = 50_000;
/// Most calls at once, in all threads together.
const MAX_CALLS: usize = 128;
/// Most threads at once, the program's own included.
const MAX_THREADS: usize = 32;
/// Most values on a thread's stack.
const MAX_STACK: usize = 512;

/// What a step came to.
#[derive(Debug, Clone, PartialEq)]
pub enum Outcome {
    /// The program goes on in the next cycle.
    Running,
    /// The program ran its last statement, or `halt`.
    Ended,
    /// The program asked to be paused.
    Paused,
    /// The program made a mistake.
    Failed(ScriptError),
}

#[derive(Debug, Clone, PartialEq)]
enum Wait {
    Nothing,
    Cycle,
    Sleep { left_s: f64 },
    Servo { left_s: f64 },
    Motion,
    Join(u32),
}

#[derive(Debug)]
struct Frame {
    routine: usize,
    at: usize,
    locals: Vec<Option<Value>>,
}

#[derive(Debug)]
struct Thread {
    id: u32,
    frames: Vec<Frame>,
    stack: Vec<Value>,
    wait: Wait,
}

/// A running program.
#[derive(Debug)]
pub struct Interpreter {
    code: Arc<Code>,
    globals: Vec<Option<Value>>,
    threads: Vec<Thread>,
    /// Frames of all threads.
    calls: usize,
    next_id: u32,
}

/// Why a thread's turn ended.
enum Turn {
    Waits,
    Finished,
    Halt,
    Pause,
}

impl Interpreter {
    /// Compiles a program and stands before its first statement.
    pub fn new(unit: &Unit) -> Result<Self, ScriptError> {
        let code = compile(unit)?;
        let globals = vec![None; code.globals.len()];
        let mut interpreter = Self { code: Arc::new(code), globals, threads: Vec::new(), calls: 0, next_id: 0 };
        interpreter.spawn(0);
        Ok(interpreter)
    }

    fn spawn(&mut self, routine: usize) -> u32 {
        let id = self.next_id;
        self.next_id += 1;
        self.calls += 1;
        let target = &self.code.routines[routine];
        let frame = Frame { routine, at: target.entry, locals: vec![None; target.locals.len()] };
        self.threads.push(Thread { id, frames: vec![frame], stack: Vec::new(), wait: Wait::Nothing });
        id
    }

    /// Runs one control cycle.
    pub fn step(&mut self, robot: &mut Robot) -> Outcome {
        let mut budget = MAX_OPS_PER_CYCLE;
        let mut i = 0;
        while i < self.threads.len() {
            if !self.ready(i, robot) {
                i += 1;
                continue;
            }
            match self.turn(i, robot, &mut budget) {
                Ok(Turn::Waits) => i += 1,
                Ok(Turn::Finished) if self.threads[i].id == 0 => return Outcome::Ended,
                Ok(Turn::Finished) => drop(self.threads.remove(i)),
                Ok(Turn::Halt) => return Outcome::Ended,
                Ok(Turn::Pause) => return Outcome::Paused,
                Err(error) => return Outcome::Failed(error),
            }
            // `kill` may have shortened the list.
            i = i.min(self.threads.len());
        }
        Outcome::Running
    }

    /// Line that the program's own thread stands at, from 1.
    pub fn line(&self) -> u32 {
        self.threads.first().and_then(|t| t.frames.last()).and_then(|f| self.code.lines.get(f.at)).copied().unwrap_or(0)
    }

    /// Lets a cycle pass for a waiting thread; true if it may go on.
    fn ready(&mut self, i: usize, robot: &Robot) -> bool {
        let steptime_s = robot.steptime_s();
        let done = match &mut self.threads[i].wait {
            Wait::Nothing | Wait::Cycle => true,
            Wait::Sleep { left_s } => {
                *left_s -= steptime_s;
                *left_s <= 1e-9
            }
            Wait::Servo { left_s } => {
                *left_s -= steptime_s * robot.speed_scaling();
                *left_s <= 1e-9
            }
            Wait::Motion => robot.servo.is_still(),
            Wait::Join(id) => {
                let id = *id;
                !self.threads.iter().any(|t| t.id == id)
            }
        };
        if done {
            self.threads[i].wait = Wait::Nothing;
        }
        done
    }

    fn turn(&mut self, i: usize, robot: &mut Robot, budget: &mut u32) -> Result<Turn, ScriptError> {
        let code = self.code.clone();
        loop {
            let thread = &mut self.threads[i];
            let Some(frame) = thread.frames.last_mut() else { return Ok(Turn::Finished) };
            let line = code.lines[frame.at];
            let fail = |what: String| ScriptError::new(line, what);
            if *budget == 0 {
                return Err(fail(format!(
                    "{MAX_OPS_PER_CYCLE} instructions without letting time pass: an endless loop without sync(), sleep() or servoj()"
                )));
            }
            *budget -= 1;
            let op = &code.ops[frame.at];
            frame.at += 1;
            let stack = &mut thread.stack;
            if stack.len() > MAX_STACK {
                return Err(fail("expression too large".to_owned()));
            }
            match op {
                Op::Push(value) => stack.push(value.clone()),
                Op::Pop => drop(stack.pop()),
                Op::LoadGlobal(slot) => {
                    let value = self.globals[*slot].clone();
                    stack.push(value.ok_or_else(|| fail(format!("'{}' has no value yet", code.globals[*slot])))?);
                }
                Op::LoadLocal(slot) => {
                    let value = frame.locals[*slot].clone();
                    stack.push(value.ok_or_else(|| fail(format!("'{}' has no value yet", code.routines[frame.routine].locals[*slot])))?);
                }
                Op::StoreGlobal(slot) => store(&mut self.globals[*slot], pop(stack), &code.globals[*slot]).map_err(fail)?,
                Op::StoreLocal(slot) => {
                    store(&mut frame.locals[*slot], pop(stack), &code.routines[frame.routine].locals[*slot]).map_err(fail)?;
                }
                Op::StoreGlobalElement(slot) => {
                    store_element(&mut self.globals[*slot], stack, &code.globals[*slot]).map_err(fail)?;
                }
                Op::StoreLocalElement(slot) => {
                    store_element(&mut frame.locals[*slot], stack, &code.routines[frame.routine].locals[*slot]).map_err(fail)?;
                }
                Op::List(length) => {
                    let items = stack.split_off(stack.len().saturating_sub(*length));
                    stack.push(Value::list(items).map_err(fail)?);
                }
                Op::Pose => {
                    let items = stack.split_off(stack.len().saturating_sub(6));
                    stack.push(Value::Pose(Value::list(items).and_then(|l| l.six()).map_err(fail)?));
                }
                Op::Index => {
                    let index = pop(stack);
                    let list = pop(stack);
                    stack.push(list.element(&index).map_err(fail)?);
                }
                Op::Not => {
                    let value = pop(stack).bool().map_err(fail)?;
                    stack.push(Value::Bool(!value));
                }
                Op::Negative => {
                    let value = pop(stack).negative().map_err(fail)?;
                    stack.push(value);
                }
                Op::Binary(operator) => {
                    let b = pop(stack);
                    let a = pop(stack);
                    stack.push(binary(*operator, &a, &b).map_err(fail)?);
                }
                Op::Jump(to) => frame.at = *to,
                Op::JumpIfFalse(to) => {
                    if !pop(stack).bool().map_err(|e| fail(format!("condition: {e}")))? {
                        frame.at = *to;
                    }
                }
                Op::And(to) | Op::Or(to) => {
                    let stops_at = matches!(op, Op::Or(_));
                    let value = pop(stack).bool().map_err(fail)?;
                    if value == stops_at {
                        stack.push(Value::Bool(value));
                        frame.at = *to;
                    }
                }
                Op::CheckBool => {
                    let value = pop(stack).bool().map_err(fail)?;
                    stack.push(Value::Bool(value));
                }
                Op::Call(routine) => {
                    let target = &code.routines[*routine];
                    if self.calls >= MAX_CALLS {
                        return Err(fail(format!("more than {MAX_CALLS} calls within calls")));
                    }
                    self.calls += 1;
                    let given = stack.split_off(stack.len().saturating_sub(target.parameters));
                    let mut locals: Vec<Option<Value>> = given.into_iter().map(Some).collect();
                    locals.resize(target.locals.len(), None);
                    thread.frames.push(Frame { routine: *routine, at: target.entry, locals });
                }
                Op::Builtin(function, arguments) => {
                    let given = stack.split_off(stack.len().saturating_sub(*arguments));
                    let effect = builtin::call(*function, &given, robot).map_err(fail)?;
                    let wait = match effect {
                        Effect::Value(value) => {
                            stack.push(value);
                            continue;
                        }
                        Effect::Cycle => Wait::Cycle,
                        Effect::Sleep { time_s } => Wait::Sleep { left_s: time_s },
                        Effect::Servo { time_s } => Wait::Servo { left_s: time_s },
                        Effect::Motion => Wait::Motion,
                    };
                    stack.push(Value::None);
                    thread.wait = wait.clone();
                    let moves = |w: &Wait| matches!(w, Wait::Servo { .. } | Wait::Motion);
                    let id = thread.id;
                    if moves(&wait) && self.threads.iter().any(|t| t.id != id && moves(&t.wait)) {
                        return Err(fail("another thread is already moving the robot".to_owned()));
                    }
                    return Ok(Turn::Waits);
                }
                Op::Run(routine) => {
                    if self.threads.len() >= MAX_THREADS || self.calls >= MAX_CALLS {
                        return Err(fail(format!("more than {MAX_THREADS} threads or {MAX_CALLS} calls within calls")));
                    }
                    let id = self.spawn(*routine);
                    self.threads[i].stack.push(Value::Thread(id));
                }
                Op::Join => {
                    let Value::Thread(id) = pop(stack) else { return Err(fail("'join' needs a thread".to_owned())) };
                    if id == thread.id {
                        return Err(fail("a thread cannot wait for itself".to_owned()));
                    }
                    if self.threads.iter().any(|t| t.id == id) {
                        self.threads[i].wait = Wait::Join(id);
                        return Ok(Turn::Waits);
                    }
                }
                Op::Kill => {
                    let Value::Thread(id) = pop(stack) else { return Err(fail("'kill' needs a thread".to_owned())) };
                    if id == thread.id || id == 0 {
                        return Err(fail("'kill' ends another thread; 'return' or 'halt' ends this one".to_owned()));
                    }
                    let own = thread.id;
                    self.calls -= self.threads.iter().filter(|t| t.id == id).map(|t| t.frames.len()).sum::<usize>();
                    self.threads.retain(|t| t.id != id);
                    if self.threads.get(i).is_none_or(|t| t.id != own) {
                        // An older thread went: this one moved up by one place, and its turn goes on in the next cycle.
                        if let Some(moved) = self.threads.iter_mut().find(|t| t.id == own) {
                            moved.wait = Wait::Cycle;
                        }
                        return Ok(Turn::Waits);
                    }
                }
                Op::Return => {
                    // The value stays on the stack for the caller.
                    thread.frames.pop();
                    self.calls -= 1;
                    if thread.frames.is_empty() {
                        return Ok(Turn::Finished);
                    }
                }
                Op::Halt => return Ok(Turn::Halt),
                Op::Pause => return Ok(Turn::Pause),
            }
        }
    }
}

/// The compiler leaves no instruction without its operands; None would show as a type error of the program.
fn pop(stack: &mut Vec<Value>) -> Value {
    stack.pop().unwrap_or(Value::None)
}

fn store(slot: &mut Option<Value>, value: Value, name: &str) -> Result<(), String> {
    if let Some(old) = slot.as_ref().filter(|old| !old.may_become(&value)) {
        return Err(format!("'{name}' is a {} and cannot become a {}", old.kind(), value.kind()));
    }
    *slot = Some(value);
    Ok(())
}

fn store_element(slot: &mut Option<Value>, stack: &mut Vec<Value>, name: &str) -> Result<(), String> {
    let value = pop(stack);
    let index = pop(stack);
    let list = slot.as_mut().ok_or_else(|| format!("'{name}' has no value yet"))?;
    list.set_element(&index, value).map_err(|e| format!("{name}: {e}"))
}
