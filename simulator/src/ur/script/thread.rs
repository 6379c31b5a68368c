//! One thread of a running program: its calls, its stack, what it waits for, and the instructions that touch nothing else.
//!
//! Pure. Runs on the controller's thread; allocates within the limits that [`super::interpreter`] holds. A mistake of the
//! program is an error without a line, which the caller adds.

use super::compile::{Code, Op, Routine};
use super::value::{Value, binary, binary_of_floats};
use crate::ur::robot::Robot;

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
    /// Takes the last `count` values from the stack.
    pub fn take(&mut self, count: usize) -> Vec<Value> {
        self.stack.split_off(self.stack.len().saturating_sub(count))
    }

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

    /// Carries out an instruction that needs nothing but this thread and the program's variables. The others do nothing here.
    pub fn compute(&mut self, op: &Op, code: &Code, globals: &mut [Option<Value>]) -> Result<(), String> {
        let Some(call) = self.calls.last_mut() else { return Ok(()) };
        let stack = &mut self.stack;
        let local_name = |slot: usize| &code.routines[call.routine].locals[slot];
        match op {
            Op::Push(value) => stack.push(value.clone()),
            Op::Pop => drop(stack.pop()),
            Op::LoadGlobal(slot) => stack.push(load(&globals[*slot], &code.globals[*slot])?),
            Op::LoadLocal(slot) => stack.push(load(&call.locals[*slot], local_name(*slot))?),
            Op::StoreGlobal(slot) => store(&mut globals[*slot], pop(stack), &code.globals[*slot])?,
            Op::StoreLocal(slot) => store(&mut call.locals[*slot], pop(stack), local_name(*slot))?,
            Op::StoreGlobalElement(slot) => store_element(&mut globals[*slot], stack, &code.globals[*slot])?,
            Op::StoreLocalElement(slot) => store_element(&mut call.locals[*slot], stack, local_name(*slot))?,
            Op::List(length) => {
                let items = self.take(*length);
                self.stack.push(Value::list(items)?);
            }
            Op::Pose => {
                let items = self.take(6);
                self.stack.push(Value::Pose(Box::new(Value::list(items).and_then(|l| l.six())?)));
            }
            Op::Index => {
                let index = pop(stack);
                let list = pop(stack);
                stack.push(list.element(&index)?);
            }
            Op::Not => {
                let value = pop(stack).bool()?;
                stack.push(Value::Bool(!value));
            }
            Op::Negative => {
                let value = pop(stack).negative()?;
                stack.push(value);
            }
            Op::Binary(operator) => {
                if let [.., a, Value::Float(y)] = stack.as_mut_slice()
                    && let Value::Float(x) = a
                    && let Some(value) = binary_of_floats(*operator, *x, *y)
                {
                    *a = value;
                    stack.pop();
                    return Ok(());
                }
                let b = pop(stack);
                let a = pop(stack);
                stack.push(binary(*operator, &a, &b)?);
            }
            Op::Jump(to) => call.at = *to,
            Op::JumpIfFalse(to) => {
                if !pop(stack).bool().map_err(|e| format!("condition: {e}"))? {
                    call.at = *to;
                }
            }
            Op::And(to) | Op::Or(to) => {
                let decides = matches!(op, Op::Or(_));
                let value = pop(stack).bool()?;
                if value == decides {
                    stack.push(Value::Bool(value));
                    call.at = *to;
                }
            }
            Op::CheckBool => {
                let value = pop(stack).bool()?;
                stack.push(Value::Bool(value));
            }
            Op::Call(_) | Op::Builtin(_) | Op::Run(_) | Op::Join | Op::Kill | Op::Return | Op::Halt | Op::Pause => {}
        }
        Ok(())
    }
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
