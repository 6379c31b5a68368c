//! The functions built into URScript that this controller knows, with UR's parameter names.
//!
//! Pure but for the robot they act on. A function that a robot does not have is not here: `abs`, `min` and `max` do not
//! exist in URScript (script manual, "Module urmath").

use super::value::Value;
use crate::ur::machine::{Robot, WatchdogAction};
use crate::ur::variables::Input;

/// What a call leaves behind.
pub enum Effect {
    /// A result; the thread goes on.
    Value(Value),
    /// The thread waits for the next control cycle.
    Cycle,
    /// The thread waits for `time_s`, independent of speed scaling.
    Sleep {
        /// s
        time_s: f64,
    },
    /// A servoj: the thread waits for `time_s`, stretched by speed scaling.
    Servo {
        /// s
        time_s: f64,
    },
    /// A motion that the thread waits out.
    Motion,
}

/// A built-in function.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Builtin {
    Acos,
    Asin,
    Atan,
    Atan2,
    Ceil,
    Cos,
    D2r,
    Floor,
    Length,
    Log,
    Norm,
    Pow,
    R2d,
    Sin,
    Sqrt,
    Tan,
    StrCat,
    StrLen,
    ToStr,
    GetSteptime,
    GetActualJointPositions,
    GetActualJointSpeeds,
    GetTargetJointPositions,
    GetTargetJointSpeeds,
    GetActualTcpPose,
    GetTargetTcpPose,
    IsSteady,
    ReadInputInteger,
    ReadInputFloat,
    ReadInputBoolean,
    ReadOutputInteger,
    ReadOutputFloat,
    ReadOutputBoolean,
    WriteOutputInteger,
    WriteOutputFloat,
    WriteOutputBoolean,
    SetStandardDigitalOut,
    GetStandardDigitalIn,
    RtdeSetWatchdog,
    Textmsg,
    Sync,
    Sleep,
    Servoj,
    Stopj,
    Stopl,
    Movej,
}

/// Name, function, parameters, and how many of them must be given.
pub type Entry = (&'static str, Builtin, &'static [&'static str], usize);

use Builtin::*;

/// All built-in functions.
pub const TABLE: &[Entry] = &[
    ("acos", Acos, &["f"], 1),
    ("asin", Asin, &["f"], 1),
    ("atan", Atan, &["f"], 1),
    ("atan2", Atan2, &["x", "y"], 2),
    ("ceil", Ceil, &["f"], 1),
    ("cos", Cos, &["f"], 1),
    ("d2r", D2r, &["d"], 1),
    ("floor", Floor, &["f"], 1),
    ("get_list_length", Length, &["v"], 1),
    ("length", Length, &["v"], 1),
    ("log", Log, &["b", "f"], 2),
    ("norm", Norm, &["a"], 1),
    ("pow", Pow, &["base", "exponent"], 2),
    ("r2d", R2d, &["r"], 1),
    ("sin", Sin, &["f"], 1),
    ("sqrt", Sqrt, &["f"], 1),
    ("tan", Tan, &["f"], 1),
    ("str_cat", StrCat, &["op1", "op2"], 2),
    ("str_len", StrLen, &["str"], 1),
    ("to_str", ToStr, &["val"], 1),
    ("get_steptime", GetSteptime, &[], 0),
    ("get_actual_joint_positions", GetActualJointPositions, &[], 0),
    ("get_actual_joint_speeds", GetActualJointSpeeds, &[], 0),
    ("get_target_joint_positions", GetTargetJointPositions, &[], 0),
    ("get_target_joint_speeds", GetTargetJointSpeeds, &[], 0),
    ("get_actual_tcp_pose", GetActualTcpPose, &[], 0),
    ("get_target_tcp_pose", GetTargetTcpPose, &[], 0),
    ("is_steady", IsSteady, &[], 0),
    ("read_input_integer_register", ReadInputInteger, &["address"], 1),
    ("read_input_float_register", ReadInputFloat, &["address"], 1),
    ("read_input_boolean_register", ReadInputBoolean, &["address"], 1),
    ("read_output_integer_register", ReadOutputInteger, &["address"], 1),
    ("read_output_float_register", ReadOutputFloat, &["address"], 1),
    ("read_output_boolean_register", ReadOutputBoolean, &["address"], 1),
    ("write_output_integer_register", WriteOutputInteger, &["address", "value"], 2),
    ("write_output_float_register", WriteOutputFloat, &["address", "value"], 2),
    ("write_output_boolean_register", WriteOutputBoolean, &["address", "value"], 2),
    ("set_standard_digital_out", SetStandardDigitalOut, &["n", "b"], 2),
    ("get_standard_digital_in", GetStandardDigitalIn, &["n"], 1),
    ("rtde_set_watchdog", RtdeSetWatchdog, &["variable_name", "min_frequency", "action"], 2),
    ("textmsg", Textmsg, &["s1", "s2"], 1),
    ("sync", Sync, &[], 0),
    ("sleep", Sleep, &["t"], 1),
    ("servoj", Servoj, &["q", "a", "v", "t", "lookahead_time", "gain"], 1),
    ("stopj", Stopj, &["a"], 1),
    ("stopl", Stopl, &["a", "aRot"], 1),
    ("movej", Movej, &["q", "a", "v", "t", "r"], 1),
];

/// What to write instead of a function that other languages have and URScript has not.
pub fn hint(name: &str) -> &'static str {
    match name {
        "abs" | "fabs" => "; URScript has no abs, norm(a) gives the absolute value of a number",
        "min" | "max" => "; URScript has no min and max, use if",
        "int" | "float" | "round" => "; URScript has floor and ceil",
        "len" => "; URScript calls it get_list_length",
        "print" => "; URScript calls it textmsg",
        _ => "",
    }
}

fn number_in(value: &Value, name: &str, low: f64, high: f64) -> Result<f64, String> {
    let number = value.number().map_err(|e| format!("{name}: {e}"))?;
    if (low..=high).contains(&number) { Ok(number) } else { Err(format!("{name} is {number}, must be {low} to {high}")) }
}

fn or_default(value: &Value, default: f64) -> Value {
    if *value == Value::None { Value::Float(default) } else { value.clone() }
}

fn finite(value: f64) -> Result<Value, String> {
    if value.is_finite() { Ok(Value::Float(value)) } else { Err("result is not a finite number".to_owned()) }
}

fn whole(value: f64) -> Result<Value, String> {
    if (f64::from(i32::MIN)..=f64::from(i32::MAX)).contains(&value) {
        Ok(Value::Int(value as i32))
    } else {
        Err("result does not fit an int (32 bits)".to_owned())
    }
}

fn address(value: &Value, low: usize, high: usize) -> Result<usize, String> {
    let at = value.int().map_err(|e| format!("register address: {e}"))?;
    usize::try_from(at).ok().filter(|a| (low..=high).contains(a)).ok_or_else(|| format!("register address {at} is outside {low} to {high}"))
}

/// Calls a built-in function. `a` has one value for each of its parameters, [`Value::None`] for those left out.
pub fn call(builtin: Builtin, a: &[Value], robot: &mut Robot) -> Result<Effect, String> {
    let value = match builtin {
        Acos => finite(number_in(&a[0], "f", -1.0, 1.0)?.acos())?,
        Asin => finite(number_in(&a[0], "f", -1.0, 1.0)?.asin())?,
        Atan => finite(a[0].number()?.atan())?,
        Atan2 => finite(a[0].number()?.atan2(a[1].number()?))?,
        Ceil => whole(a[0].number()?.ceil())?,
        Cos => finite(a[0].number()?.cos())?,
        D2r => finite(a[0].number()?.to_radians())?,
        Floor => whole(a[0].number()?.floor())?,
        Length => match &a[0] {
            Value::List(items) => Value::Int(items.len() as i32),
            Value::Str(text) => Value::Int(text.len() as i32),
            other => return Err(format!("expected a list or a text, found {}", other.kind())),
        },
        Log => finite(a[1].number()?.log(a[0].number()?))?,
        Norm => match &a[0] {
            Value::Int(v) => Value::Int(v.checked_abs().ok_or("result does not fit an int (32 bits)")?),
            Value::Float(v) => Value::Float(v.abs()),
            other => finite(other.numbers()?.iter().map(|v| v * v).sum::<f64>().sqrt())?,
        },
        Pow => finite(a[0].number()?.powf(a[1].number()?))?,
        R2d => finite(a[0].number()?.to_degrees())?,
        Sin => finite(a[0].number()?.sin())?,
        Sqrt => finite(a[0].number()?.sqrt())?,
        Tan => finite(a[0].number()?.tan())?,
        StrCat => Value::text(&format!("{}{}", a[0], a[1]))?,
        StrLen => Value::Int(a[0].str()?.len() as i32),
        ToStr => Value::text(&a[0].to_string())?,
        GetSteptime => Value::Float(robot.steptime_s()),
        GetActualJointPositions => Value::floats(&robot.servo.actual_q),
        GetActualJointSpeeds => Value::floats(&robot.servo.actual_qd),
        GetTargetJointPositions => Value::floats(&robot.servo.target_q),
        GetTargetJointSpeeds => Value::floats(&robot.servo.target_qd),
        GetActualTcpPose => Value::Pose(crate::ur::kinematics::pose(&robot.servo.actual_q)),
        GetTargetTcpPose => Value::Pose(crate::ur::kinematics::pose(&robot.servo.target_q)),
        IsSteady => Value::Bool(robot.servo.is_still()),
        ReadInputInteger => Value::Int(robot.inputs.int[address(&a[0], 0, 47)?]),
        ReadInputFloat => Value::Float(robot.inputs.double[address(&a[0], 0, 47)?]),
        ReadInputBoolean => Value::Bool(robot.inputs.bits >> address(&a[0], 0, 127)? & 1 == 1),
        ReadOutputInteger => Value::Int(robot.outputs.int[address(&a[0], 0, 47)?]),
        ReadOutputFloat => Value::Float(robot.outputs.double[address(&a[0], 0, 47)?]),
        ReadOutputBoolean => Value::Bool(robot.outputs.bits >> address(&a[0], 0, 127)? & 1 == 1),
        WriteOutputInteger => {
            robot.outputs.int[address(&a[0], 0, 47)?] = a[1].int()?;
            Value::None
        }
        WriteOutputFloat => {
            robot.outputs.double[address(&a[0], 0, 47)?] = a[1].number()?;
            Value::None
        }
        WriteOutputBoolean => {
            let bit = 1u128 << address(&a[0], 0, 127)?;
            if a[1].bool()? {
                robot.outputs.bits |= bit;
            } else {
                robot.outputs.bits &= !bit;
            }
            Value::None
        }
        SetStandardDigitalOut => {
            let bit = 1u64 << address(&a[0], 0, 7)?;
            if a[1].bool()? {
                robot.digital_out |= bit;
            } else {
                robot.digital_out &= !bit;
            }
            Value::None
        }
        GetStandardDigitalIn => {
            address(&a[0], 0, 7)?;
            Value::Bool(false)
        }
        RtdeSetWatchdog => {
            let name = a[0].str()?;
            let input = Input::parse(name).ok_or_else(|| format!("rtde_set_watchdog: no input variable '{name}'"))?;
            let action = match &a[2] {
                Value::None => WatchdogAction::Pause,
                given => given.str()?.parse()?,
            };
            robot.set_watchdog(input, a[1].number()?, action);
            Value::None
        }
        Textmsg => {
            let second = if a[1] == Value::None { String::new() } else { a[1].to_string() };
            robot.textmsg(&format!("{}{second}", a[0]));
            Value::None
        }
        Sync => return Ok(Effect::Cycle),
        Sleep => return Ok(Effect::Sleep { time_s: number_in(&a[0], "sleep: t", 0.0, 1e6)? }),
        Servoj => {
            let q = a[0].six().map_err(|e| format!("servoj: {e}"))?;
            let time_s = number_in(&or_default(&a[3], robot.steptime_s()), "servoj: t", 0.0, 10.0)?;
            let lookahead_s = number_in(&or_default(&a[4], 0.1), "servoj: lookahead_time", 0.03, 0.2)?;
            let gain = number_in(&or_default(&a[5], 300.0), "servoj: gain", 100.0, 2000.0)?;
            robot.servoj(q, lookahead_s, gain);
            return Ok(Effect::Servo { time_s });
        }
        Stopj | Stopl => {
            robot.servo.stop(number_in(&a[0], "deceleration", 1e-3, 1e3)?);
            return Ok(Effect::Motion);
        }
        Movej => {
            if matches!(&a[0], Value::Pose(_)) {
                return Err("movej: only joint positions are simulated, not a pose".to_owned());
            }
            for (value, name) in [(&a[3], "t"), (&a[4], "r")] {
                if *value != Value::None && value.number()? != 0.0 {
                    return Err(format!("movej: {name} other than 0 is not simulated"));
                }
            }
            let q = a[0].six().map_err(|e| format!("movej: {e}"))?;
            let acceleration = number_in(&or_default(&a[1], 1.4), "movej: a", 1e-3, 1e3)?;
            let speed = number_in(&or_default(&a[2], 1.05), "movej: v", 1e-3, 1e3)?;
            robot.movej(q, acceleration, speed);
            return Ok(Effect::Motion);
        }
    };
    Ok(Effect::Value(value))
}
