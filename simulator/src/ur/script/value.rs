//! URScript's values and what its operators do with them.
//!
//! Pure. Runs on the controller's thread; allocates for lists and texts, within [`MAX_CELLS`] and [`MAX_TEXT_BYTES`]. A value of
//! the wrong type is an error of the program.

use std::fmt;
use std::sync::Arc;

use super::syntax::Operator;

/// Most numbers, bools and texts in one list, those of nested lists included; a long text counts more than once. Chosen by hand;
/// no measurement is recorded.
pub const MAX_CELLS: usize = 256;
/// Longest text in bytes. Chosen by hand; no measurement is recorded.
pub const MAX_TEXT_BYTES: usize = 1024;

/// A value of a running program.
#[derive(Debug, Clone, PartialEq)]
pub enum Value {
    /// The result of a function that has none, and the value of an argument that was left out.
    None,
    /// A bool, True or False.
    Bool(bool),
    /// A whole number of 32 bits, as on the robot.
    Int(i32),
    /// A floating-point number of 64 bits.
    Float(f64),
    /// A text.
    Str(Arc<str>),
    /// A list.
    List(Arc<Vec<Value>>),
    /// A pose: x, y, z in m and a rotation vector in rad. It is boxed, so that the other values are small.
    Pose(Box<[f64; 6]>),
    /// A thread started with `run`.
    Thread(u32),
}

impl fmt::Display for Value {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Value::None => f.write_str("None"),
            Value::Bool(value) => f.write_str(if *value { "True" } else { "False" }),
            Value::Int(value) => write!(f, "{value}"),
            Value::Float(value) => write!(f, "{value}"),
            Value::Str(text) => f.write_str(text),
            Value::List(items) => {
                f.write_str("[")?;
                for (i, item) in items.iter().enumerate() {
                    write!(f, "{}{item}", if i == 0 { "" } else { ", " })?;
                }
                f.write_str("]")
            }
            Value::Pose(p) => write!(f, "p[{}, {}, {}, {}, {}, {}]", p[0], p[1], p[2], p[3], p[4], p[5]),
            Value::Thread(id) => write!(f, "thread {id}"),
        }
    }
}

impl Value {
    /// The name of its type.
    pub fn kind(&self) -> &'static str {
        match self {
            Value::None => "None",
            Value::Bool(_) => "bool",
            Value::Int(_) => "int",
            Value::Float(_) => "float",
            Value::Str(_) => "string",
            Value::List(_) => "list",
            Value::Pose(_) => "pose",
            Value::Thread(_) => "thread",
        }
    }

    /// True when a variable that holds `self` may be assigned `new`. A variable keeps its type, but ints, floats and threads may
    /// replace each other, because programs write 0 for "no thread".
    pub fn may_become(&self, new: &Value) -> bool {
        let number = |v: &Value| matches!(v, Value::Int(_) | Value::Float(_) | Value::Thread(_));
        matches!(self, Value::None) || matches!(new, Value::None) || (number(self) && number(new)) || self.kind() == new.kind()
    }

    /// How much the value counts towards [`MAX_CELLS`].
    pub fn cells(&self) -> usize {
        match self {
            Value::List(items) => items.iter().map(Value::cells).sum::<usize>() + 1,
            Value::Str(text) => 1 + text.len() / 32,
            _ => 1,
        }
    }

    /// A list. It is an error when it would be too large.
    pub fn list(items: Vec<Value>) -> Result<Value, String> {
        let list = Value::List(Arc::new(items));
        if list.cells() > MAX_CELLS { Err(format!("a list of more than {MAX_CELLS} values")) } else { Ok(list) }
    }

    /// A list of floats.
    pub fn floats(values: &[f64]) -> Value {
        Value::List(Arc::new(values.iter().map(|v| Value::Float(*v)).collect()))
    }

    /// A text. It is an error when it would be too long.
    pub fn text(text: &str) -> Result<Value, String> {
        if text.len() > MAX_TEXT_BYTES { Err(format!("a text of more than {MAX_TEXT_BYTES} bytes")) } else { Ok(Value::Str(text.into())) }
    }

    /// The value as a number.
    pub fn number(&self) -> Result<f64, String> {
        match self {
            Value::Int(value) => Ok(f64::from(*value)),
            Value::Float(value) => Ok(*value),
            other => Err(format!("expected a number, found {}", other.kind())),
        }
    }

    /// The value as a whole number. A float is not one, even 1.0.
    pub fn int(&self) -> Result<i32, String> {
        match self {
            Value::Int(value) => Ok(*value),
            other => Err(format!("expected an int, found {}", other.kind())),
        }
    }

    /// The value as a bool. A number is not one.
    pub fn bool(&self) -> Result<bool, String> {
        match self {
            Value::Bool(value) => Ok(*value),
            other => Err(format!("expected a bool (True or False), found {}", other.kind())),
        }
    }

    /// The value as a text.
    pub fn str(&self) -> Result<&str, String> {
        match self {
            Value::Str(text) => Ok(text),
            other => Err(format!("expected a text, found {}", other.kind())),
        }
    }

    /// The value as a list of numbers. A pose is a list of six.
    pub fn numbers(&self) -> Result<Vec<f64>, String> {
        match self {
            Value::Pose(pose) => Ok(pose.to_vec()),
            Value::List(items) => items.iter().map(Value::number).collect(),
            other => Err(format!("expected a list of numbers, found {}", other.kind())),
        }
    }

    /// The value as a list of six numbers, such as joint angles.
    pub fn six(&self) -> Result<[f64; 6], String> {
        let Value::List(items) = self else { return Err(format!("expected a list of 6 numbers, found {}", self.kind())) };
        let numbers = items.iter().map(Value::number).collect::<Result<Vec<_>, _>>()?;
        numbers.try_into().map_err(|n: Vec<f64>| format!("expected a list of 6 numbers, found one of {}", n.len()))
    }

    /// The element at `index`, from 0.
    pub fn element(&self, index: &Value) -> Result<Value, String> {
        let at = index.int().map_err(|e| format!("index: {e}"))?;
        let outside = |length: usize| format!("index {at} is outside 0 to {}", length as i64 - 1);
        match self {
            Value::List(items) => usize::try_from(at).ok().and_then(|i| items.get(i)).cloned().ok_or_else(|| outside(items.len())),
            Value::Pose(pose) => usize::try_from(at).ok().and_then(|i| pose.get(i)).map(|v| Value::Float(*v)).ok_or_else(|| outside(6)),
            other => Err(format!("only a list or a pose has elements, not a value of type {}", other.kind())),
        }
    }

    /// Replaces the element at `index`. Lists have a fixed length, as on the robot.
    pub fn set_element(&mut self, index: &Value, new: Value) -> Result<(), String> {
        let old = self.element(index)?;
        if !old.may_become(&new) {
            return Err(format!("an element of type {} cannot become {}", old.kind(), new.kind()));
        }
        let at = index.int()? as usize;
        let as_large = old.cells() == new.cells();
        match self {
            Value::List(items) => {
                Arc::make_mut(items)[at] = new;
                if !as_large && self.cells() > MAX_CELLS { Err(format!("a list of more than {MAX_CELLS} values")) } else { Ok(()) }
            }
            Value::Pose(pose) => {
                pose[at] = new.number()?;
                Ok(())
            }
            _ => Ok(()),
        }
    }

    /// Rounds every float to 32 bits.
    pub fn round_to_single(&mut self) {
        match self {
            Value::Float(value) => *value = f64::from(*value as f32),
            Value::List(items) => Arc::make_mut(items).iter_mut().for_each(Value::round_to_single),
            Value::Pose(pose) => pose.iter_mut().for_each(|v| *v = f64::from(*v as f32)),
            _ => {}
        }
    }

    /// The value of `-self`.
    pub fn negative(&self) -> Result<Value, String> {
        match self {
            Value::Int(value) => value.checked_neg().map(Value::Int).ok_or_else(overflow),
            Value::Float(value) => Ok(Value::Float(-value)),
            Value::List(items) => Value::list(items.iter().map(Value::negative).collect::<Result<_, _>>()?),
            other => Err(format!("'-' needs a number, found {}", other.kind())),
        }
    }
}

fn overflow() -> String {
    "result does not fit an int (32 bits)".to_owned()
}

/// The value of `a operator b` for two floats, which is what programs compute with most; `None` where that needs more thought.
pub fn binary_of_floats(operator: Operator, a: f64, b: f64) -> Option<Value> {
    use Operator::*;
    Some(match operator {
        Equal => Value::Bool(a == b),
        NotEqual => Value::Bool(a != b),
        Less => Value::Bool(a < b),
        LessEqual => Value::Bool(a <= b),
        Greater => Value::Bool(a > b),
        GreaterEqual => Value::Bool(a >= b),
        Add => Value::Float(a + b),
        Subtract => Value::Float(a - b),
        Multiply => Value::Float(a * b),
        Divide if b != 0.0 => Value::Float(a / b),
        _ => return None,
    })
}

/// The value of `a operator b`.
pub fn binary(operator: Operator, a: &Value, b: &Value) -> Result<Value, String> {
    use Operator::*;
    match operator {
        Equal => equal(a, b).map(Value::Bool),
        NotEqual => equal(a, b).map(|e| Value::Bool(!e)),
        Xor => Ok(Value::Bool(a.bool()? != b.bool()?)),
        Less => Ok(Value::Bool(a.number()? < b.number()?)),
        LessEqual => Ok(Value::Bool(a.number()? <= b.number()?)),
        Greater => Ok(Value::Bool(a.number()? > b.number()?)),
        GreaterEqual => Ok(Value::Bool(a.number()? >= b.number()?)),
        Add | Subtract | Multiply | Divide | Modulo => arithmetic(operator, a, b),
    }
}

fn equal(a: &Value, b: &Value) -> Result<bool, String> {
    match (a, b) {
        (Value::Int(_) | Value::Float(_), Value::Int(_) | Value::Float(_)) => Ok(a.number()? == b.number()?),
        (Value::List(x), Value::List(y)) => {
            Ok(x.len() == y.len() && x.iter().zip(y.iter()).map(|(x, y)| equal(x, y)).collect::<Result<Vec<_>, _>>()?.iter().all(|e| *e))
        }
        _ if matches!(a, Value::None) || matches!(b, Value::None) || a.may_become(b) => Ok(a == b),
        _ => Err(format!("{} and {} cannot be compared", a.kind(), b.kind())),
    }
}

fn arithmetic(operator: Operator, a: &Value, b: &Value) -> Result<Value, String> {
    use Operator::*;
    match (a, b) {
        (Value::List(x), Value::List(y)) if matches!(operator, Add | Subtract) => {
            if x.len() != y.len() {
                return Err(format!("lists of {} and {} elements", x.len(), y.len()));
            }
            Value::list(x.iter().zip(y.iter()).map(|(x, y)| arithmetic(operator, x, y)).collect::<Result<_, _>>()?)
        }
        (Value::List(x), Value::Int(_) | Value::Float(_)) if matches!(operator, Multiply | Divide) => {
            Value::list(x.iter().map(|x| arithmetic(operator, x, b)).collect::<Result<_, _>>()?)
        }
        (Value::Int(_) | Value::Float(_), Value::List(y)) if operator == Multiply => {
            Value::list(y.iter().map(|y| arithmetic(operator, a, y)).collect::<Result<_, _>>()?)
        }
        // Dividing two ints gives a float, because UR's own driver script divides two ints and expects radians.
        (Value::Int(x), Value::Int(y)) if operator != Divide => match operator {
            Add => x.checked_add(*y),
            Subtract => x.checked_sub(*y),
            Multiply => x.checked_mul(*y),
            _ if *y == 0 => return Err("division by zero".to_owned()),
            _ => x.checked_rem(*y),
        }
        .map(Value::Int)
        .ok_or_else(overflow),
        (Value::Int(_) | Value::Float(_), Value::Int(_) | Value::Float(_)) => {
            let (x, y) = (a.number()?, b.number()?);
            // A NaN stays a NaN, as in any IEEE 754 arithmetic, because a client may well send one.
            Ok(Value::Float(match operator {
                Add => x + y,
                Subtract => x - y,
                Multiply => x * y,
                _ if y == 0.0 => return Err("division by zero".to_owned()),
                Divide => x / y,
                _ => x % y,
            }))
        }
        _ => Err(format!("{} and {} cannot be combined by {operator:?}", a.kind(), b.kind())),
    }
}
