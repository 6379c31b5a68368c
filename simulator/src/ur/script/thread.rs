//! One thread of a running program: its calls, its stack, what it waits for, and the instructions that touch nothing else. They are most of
//! what a program does, so they run in a loop of their own.
//!
//! Pure. Runs on the controller's thread; allocates within the limits that [`super::interpreter`] holds. A mistake of the
//! program is an error without a line, which the caller adds.

use super::compile::{Code, Op, Routine};
use super::syntax::Operator;
use super::value::{Value, binary, binary_of_floats};
use crate::ur::robot::Robot;

/// Most instructions in one control cycle. A robot stops a program that computes without ever letting time pass; this number is
/// chosen by hand, and no measurement is recorded.
pub const MAX_OPS_PER_CYCLE: u32 = 50_000;
/// Most values on a thread's stack. Chosen by hand; no measurement is recorded.
const MAX_STACK: usize = 512;

/// What a program did in one control cycle. A condition counts as a statement, and so does each statement of a function that it calls.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Effort {
    /// Statements that were carried out.
    pub statements: u32,
    /// Calls of functions, the program's own and the built-in ones.
    pub calls: u32,
    /// Instructions of the stack machine.
    pub instructions: u32,
}

/// What a thread waits for.
#[derive(Debug, Clone, PartialEq)]
pub enum Wait {
    Nothing,
    Cycle,
    Sleep {
        left_s: f64,
    },
    Servo {
        left_s: f64,
    },
    Motion,
    /// The thread of this id must end.
    Join(u32),
}

impl Wait {
    /// True while the thread moves the robot.
    pub fn moves_robot(&self) -> bool {
        matches!(self, Wait::Servo { .. } | Wait::Motion)
    }
}

/// A call that has not returned yet.
#[derive(Debug)]
pub struct CallFrame {
    routine: usize,
    /// Place of the next instruction.
    pub at: usize,
    locals: Vec<Option<Value>>,
}

impl CallFrame {
    /// A call of `target`, which is the routine of the number `routine`. The first locals are the arguments.
    pub fn new(routine: usize, target: &Routine, arguments: Vec<Value>) -> Self {
        let mut locals: Vec<Option<Value>> = arguments.into_iter().map(Some).collect();
        locals.resize(target.locals.len(), None);
        Self { routine, at: target.entry, locals }
    }
}

/// A thread of the program; the program's own has the id 0.
#[derive(Debug)]
pub struct ScriptThread {
    /// A number that no other thread of the program ever has.
    pub id: u32,
    /// The calls, the innermost last.
    pub calls: Vec<CallFrame>,
    /// The values that instructions work on.
    pub stack: Vec<Value>,
    /// What the thread waits for.
    pub wait: Wait,
}

impl ScriptThread {
    /// Lets a cycle pass for a wait that needs no other thread; true if the thread may go on.
    pub fn wait_a_cycle(&mut self, robot: &Robot) -> bool {
        match &mut self.wait {
            Wait::Nothing | Wait::Cycle => true,
            Wait::Sleep { left_s } => {
                *left_s -= robot.steptime_s();
                *left_s <= 1e-9
            }
            Wait::Servo { left_s } => {
                *left_s -= robot.steptime_s() * robot.speed_share();
                *left_s <= 1e-9
            }
            Wait::Motion => robot.servo.is_still(),
            Wait::Join(_) => false,
        }
    }

    /// Carries out instructions as long as they need nothing but this thread and the program's variables. Gives the instruction that needs
    /// more, which is counted and not carried out; `None` if the thread has no call left. An error belongs to the line of the instruction
    /// before the place where the thread then stands.
    pub fn compute<'a>(&mut self, code: &'a Code, globals: &mut [Option<Value>], pace: &mut Pace) -> Result<Option<&'a Op>, String> {
        let Some(call) = self.calls.last_mut() else { return Ok(None) };
        let stack = &mut self.stack;
        loop {
            let here = call.at;
            let (op, line) = (&code.ops[here], code.lines[here]);
            call.at = here + 1;
            pace.count(op, here, line)?;
            if stack.len() > MAX_STACK {
                return Err("expression too large".to_owned());
            }
            match op {
                Op::LoadGlobal(slot) => stack.push(load(&globals[*slot], &code.globals[*slot])?),
                Op::Push(value) => {
                    stack.push(value.clone());
                    pace.round(stack);
                }
                Op::Binary(operator) => {
                    binary_at_top(*operator, stack)?;
                    pace.round(stack);
                }
                Op::StoreGlobal(slot) => store(&mut globals[*slot], pop(stack), &code.globals[*slot])?,
                Op::JumpIfFalse(to) => {
                    if !pop(stack).bool().map_err(|e| format!("condition: {e}"))? {
                        call.at = *to;
                    }
                }
                Op::Index => {
                    let index = pop(stack);
                    if let Some(top) = stack.last_mut() {
                        *top = top.element(&index)?;
                    }
                }
                Op::Jump(to) => call.at = *to,
                Op::And(to) | Op::Or(to) => {
                    let decides = matches!(op, Op::Or(_));
                    let value = pop(stack).bool()?;
                    if value == decides {
                        stack.push(Value::Bool(value));
                        call.at = *to;
                    }
                }
                op if op.needs_more() => return Ok(Some(op)),
                op => rarer(op, call, stack, code, globals)?,
            }
        }
    }
}

/// Carries out one of the instructions that programs need more seldom.
fn rarer(op: &Op, call: &mut CallFrame, stack: &mut Vec<Value>, code: &Code, globals: &mut [Option<Value>]) -> Result<(), String> {
    let local_name = |slot: usize| &code.routines[call.routine].locals[slot];
    match op {
        Op::Pop => drop(stack.pop()),
        Op::LoadLocal(slot) => stack.push(load(&call.locals[*slot], local_name(*slot))?),
        Op::StoreLocal(slot) => store(&mut call.locals[*slot], pop(stack), local_name(*slot))?,
        Op::StoreGlobalElement(slot) => store_element(&mut globals[*slot], stack, &code.globals[*slot])?,
        Op::StoreLocalElement(slot) => store_element(&mut call.locals[*slot], stack, local_name(*slot))?,
        Op::List(length) => {
            let items = take(stack, *length);
            stack.push(Value::list(items)?);
        }
        Op::Pose => {
            let items = take(stack, 6);
            stack.push(Value::Pose(Box::new(Value::list(items).and_then(|l| l.six())?)));
        }
        Op::Not => {
            let value = pop(stack).bool()?;
            stack.push(Value::Bool(!value));
        }
        Op::Negative => {
            let value = pop(stack).negative()?;
            stack.push(value);
        }
        Op::CheckBool => {
            let value = pop(stack).bool()?;
            stack.push(Value::Bool(value));
        }
        _ => {}
    }
    Ok(())
}

/// What a turn may still do, and what it has done.
#[derive(Debug)]
pub struct Pace {
    /// Number of instructions that are left of this cycle.
    pub budget: u32,
    /// What was done in this cycle.
    pub effort: Effort,
    /// Line and place of the instruction that was counted last.
    pub counted: (u32, usize),
    /// True when each float is rounded to 32 bits.
    pub single_precision: bool,
}

impl Pace {
    /// Counts an instruction.
    #[inline]
    fn count(&mut self, op: &Op, at: usize, line: u32) -> Result<(), String> {
        if self.budget == 0 {
            return Err(format!(
                "{MAX_OPS_PER_CYCLE} instructions without letting time pass: an endless loop without sync(), sleep() or servoj()"
            ));
        }
        self.budget -= 1;
        self.effort.instructions += 1;
        // A statement is a line's instructions in a row; a jump back to the same line begins it anew. The jumps that end a branch or
        // a pass of a loop belong to no statement.
        if !matches!(op, Op::Jump(_)) {
            self.effort.statements += u32::from(line != self.counted.0 || at < self.counted.1);
            self.counted = (line, at);
        }
        Ok(())
    }

    /// Rounds the newest value, if the program computes with floats of 32 bits.
    #[inline]
    pub fn round(&self, stack: &mut [Value]) {
        if self.single_precision
            && let Some(value) = stack.last_mut()
        {
            value.round_to_single();
        }
    }
}

/// Replaces the two newest values by what an operator makes of them.
#[inline]
fn binary_at_top(operator: Operator, stack: &mut Vec<Value>) -> Result<(), String> {
    if let [.., Value::Float(x), Value::Float(y)] = stack.as_slice()
        && let Some(value) = binary_of_floats(operator, *x, *y)
    {
        stack.pop();
        if let Some(top) = stack.last_mut() {
            *top = value;
        }
        return Ok(());
    }
    let b = pop(stack);
    let a = pop(stack);
    stack.push(binary(operator, &a, &b)?);
    Ok(())
}

/// Takes the last `count` values from the stack.
pub fn take(stack: &mut Vec<Value>, count: usize) -> Vec<Value> {
    stack.split_off(stack.len().saturating_sub(count))
}

/// Takes a value from the stack. The compiler leaves no instruction without its operands; a None would show as a type error of
/// the program.
pub fn pop(stack: &mut Vec<Value>) -> Value {
    stack.pop().unwrap_or(Value::None)
}

#[inline]
fn load(slot: &Option<Value>, name: &str) -> Result<Value, String> {
    match slot {
        // Numbers are what programs compute with most.
        Some(Value::Float(value)) => Ok(Value::Float(*value)),
        Some(value) => Ok(value.clone()),
        None => Err(format!("'{name}' has no value yet")),
    }
}

#[inline]
fn store(slot: &mut Option<Value>, value: Value, name: &str) -> Result<(), String> {
    // Most variables are numbers and stay such.
    if let (Some(Value::Float(old)), Value::Float(new)) = (slot.as_mut(), &value) {
        *old = *new;
        return Ok(());
    }
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
