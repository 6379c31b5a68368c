//! The functions built into URScript that this controller knows, with UR's parameter names.
//!
//! Runs on the controller's thread; allocates for lists and texts, within the limits of [`super::value`]. A wrong argument is an
//! error of the program. A function that a robot does not have is not here: `abs`, `min` and `max` do not exist in URScript
//! (script manual, "Module urmath").

use super::value::Value;
use crate::ur::kinematics;
use crate::ur::registers::{BITS, NUMBERS};
use crate::ur::robot::Robot;
use crate::ur::variables::Input;
use crate::ur::watchdog::WatchdogAction;

/// What a call leaves behind.
pub enum Effect {
    /// The call has a result, and the thread goes on.
    Value(Value),
    /// The thread waits for the next control cycle.
    Cycle,
    /// The thread waits for `time_s` (in s), whatever the speed slider says.
    Sleep { time_s: f64 },
    /// The thread waits for `time_s` (in s) of a servoj, which a lower speed slider stretches.
    Servo { time_s: f64 },
    /// The thread waits until the arm stands still.
    Motion,
}

type CallResult = Result<Effect, String>;

/// A built-in function.
#[derive(Debug)]
pub struct BuiltinFunction {
    /// The function's name.
    pub name: &'static str,
    /// Names of its parameters.
    pub parameters: &'static [&'static str],
    /// How many of the parameters must be given.
    pub required: usize,
    /// Carries the call out. The slice has one value for each parameter, [`Value::None`] for those left out.
    pub call: fn(&[Value], &mut Robot) -> CallResult,
}

const fn function(
    name: &'static str,
    parameters: &'static [&'static str],
    required: usize,
    call: fn(&[Value], &mut Robot) -> CallResult,
) -> BuiltinFunction {
    BuiltinFunction { name, parameters, required, call }
}

/// The built-in function of this name.
pub fn find(name: &str) -> Option<&'static BuiltinFunction> {
    FUNCTIONS.iter().find(|f| f.name == name)
}

/// All built-in functions that are simulated, with the parameters that UR's script manual names.
static FUNCTIONS: &[BuiltinFunction] = &[
    function("acos", &["f"], 1, |a, _| float(number_in(&a[0], "f", -1.0, 1.0)?.acos())),
    function("asin", &["f"], 1, |a, _| float(number_in(&a[0], "f", -1.0, 1.0)?.asin())),
    function("atan", &["f"], 1, |a, _| float(a[0].number()?.atan())),
    function("atan2", &["x", "y"], 2, |a, _| float(a[0].number()?.atan2(a[1].number()?))),
    function("ceil", &["f"], 1, |a, _| whole(a[0].number()?.ceil())),
    function("cos", &["f"], 1, |a, _| float(a[0].number()?.cos())),
    function("d2r", &["d"], 1, |a, _| float(a[0].number()?.to_radians())),
    function("floor", &["f"], 1, |a, _| whole(a[0].number()?.floor())),
    function("get_list_length", &["v"], 1, |a, _| length(&a[0])),
    function("length", &["v"], 1, |a, _| length(&a[0])),
    function("log", &["b", "f"], 2, |a, _| float(a[1].number()?.log(a[0].number()?))),
    function("norm", &["a"], 1, |a, _| norm(&a[0])),
    function("pow", &["base", "exponent"], 2, |a, _| float(a[0].number()?.powf(a[1].number()?))),
    function("r2d", &["r"], 1, |a, _| float(a[0].number()?.to_degrees())),
    function("sin", &["f"], 1, |a, _| float(a[0].number()?.sin())),
    function("sqrt", &["f"], 1, |a, _| float(a[0].number()?.sqrt())),
    function("tan", &["f"], 1, |a, _| float(a[0].number()?.tan())),
    function("str_cat", &["op1", "op2"], 2, |a, _| value(Value::text(&format!("{}{}", a[0], a[1]))?)),
    function("str_len", &["str"], 1, |a, _| value(Value::Int(a[0].str()?.len() as i32))),
    function("to_str", &["val"], 1, |a, _| value(Value::text(&a[0].to_string())?)),
    function("get_steptime", &[], 0, |_, robot| value(Value::Float(robot.steptime_s()))),
    function("get_actual_joint_positions", &[], 0, |_, robot| value(Value::floats(&robot.servo.actual_q))),
    function("get_actual_joint_speeds", &[], 0, |_, robot| value(Value::floats(&robot.servo.actual_qd))),
    function("get_target_joint_positions", &[], 0, |_, robot| value(Value::floats(&robot.servo.target_q))),
    function("get_target_joint_speeds", &[], 0, |_, robot| value(Value::floats(&robot.servo.target_qd))),
    function("get_actual_tcp_pose", &[], 0, |_, robot| value(Value::Pose(Box::new(kinematics::pose(&robot.servo.actual_q))))),
    function("get_target_tcp_pose", &[], 0, |_, robot| value(Value::Pose(Box::new(kinematics::pose(&robot.servo.target_q))))),
    function("is_steady", &[], 0, |_, robot| value(Value::Bool(robot.servo.is_still()))),
    function("read_input_integer_register", &["address"], 1, |a, robot| value(Value::Int(robot.inputs.int[number(&a[0])?]))),
    function("read_input_float_register", &["address"], 1, |a, robot| value(Value::Float(robot.inputs.double[number(&a[0])?]))),
    function("read_input_boolean_register", &["address"], 1, |a, robot| value(Value::Bool(robot.inputs.bit(bit(&a[0])?)))),
    function("read_output_integer_register", &["address"], 1, |a, robot| value(Value::Int(robot.outputs.int[number(&a[0])?]))),
    function("read_output_float_register", &["address"], 1, |a, robot| value(Value::Float(robot.outputs.double[number(&a[0])?]))),
    function("read_output_boolean_register", &["address"], 1, |a, robot| value(Value::Bool(robot.outputs.bit(bit(&a[0])?)))),
    function("write_output_integer_register", &["address", "value"], 2, |a, robot| {
        robot.outputs.int[number(&a[0])?] = a[1].int()?;
        nothing()
    }),
    function("write_output_float_register", &["address", "value"], 2, |a, robot| {
        robot.outputs.double[number(&a[0])?] = a[1].number()?;
        nothing()
    }),
    function("write_output_boolean_register", &["address", "value"], 2, |a, robot| {
        robot.outputs.set_bit(bit(&a[0])?, a[1].bool()?);
        nothing()
    }),
    function("set_standard_digital_out", &["n", "b"], 2, |a, robot| {
        let mask = 1u64 << standard_digital(&a[0])?;
        robot.digital_out = if a[1].bool()? { robot.digital_out | mask } else { robot.digital_out & !mask };
        nothing()
    }),
    // Nothing is wired to the digital inputs.
    function("get_standard_digital_in", &["n"], 1, |a, _| standard_digital(&a[0]).and_then(|_| value(Value::Bool(false)))),
    function("rtde_set_watchdog", &["variable_name", "min_frequency", "action"], 2, rtde_set_watchdog),
    function("textmsg", &["s1", "s2"], 1, |a, robot| {
        let second = if a[1] == Value::None { String::new() } else { a[1].to_string() };
        robot.textmsg(&format!("{}{second}", a[0]));
        nothing()
    }),
    function("sync", &[], 0, |_, _| Ok(Effect::Cycle)),
    function("sleep", &["t"], 1, |a, _| Ok(Effect::Sleep { time_s: number_in(&a[0], "sleep: t", 0.0, 1e6)? })),
    function("servoj", &["q", "a", "v", "t", "lookahead_time", "gain"], 1, servoj),
    function("stopj", &["a"], 1, stop),
    function("stopl", &["a", "aRot"], 1, stop),
    function("movej", &["q", "a", "v", "t", "r"], 1, movej),
];

/// What to write instead of a function that other languages have and URScript does not have.
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

fn value(value: Value) -> CallResult {
    Ok(Effect::Value(value))
}

fn nothing() -> CallResult {
    value(Value::None)
}

fn float(number: f64) -> CallResult {
    if number.is_finite() { value(Value::Float(number)) } else { Err("result is not a finite number".to_owned()) }
}

fn whole(number: f64) -> CallResult {
    if (f64::from(i32::MIN)..=f64::from(i32::MAX)).contains(&number) {
        value(Value::Int(number as i32))
    } else {
        Err("result does not fit an int (32 bits)".to_owned())
    }
}

fn length(of: &Value) -> CallResult {
    match of {
        Value::List(items) => value(Value::Int(items.len() as i32)),
        Value::Str(text) => value(Value::Int(text.len() as i32)),
        other => Err(format!("expected a list or a text, found {}", other.kind())),
    }
}

fn norm(of: &Value) -> CallResult {
    match of {
        Value::Int(v) => value(Value::Int(v.checked_abs().ok_or("result does not fit an int (32 bits)")?)),
        Value::Float(v) => value(Value::Float(v.abs())),
        other => float(other.numbers()?.iter().map(|v| v * v).sum::<f64>().sqrt()),
    }
}

/// A number from `low` to `high`; `name` is what a message calls it.
fn number_in(given: &Value, name: &str, low: f64, high: f64) -> Result<f64, String> {
    let number = given.number().map_err(|e| format!("{name}: {e}"))?;
    if (low..=high).contains(&number) { Ok(number) } else { Err(format!("{name} is {number}, must be {low} to {high}")) }
}

fn or_default(given: &Value, default: f64) -> Value {
    if *given == Value::None { Value::Float(default) } else { given.clone() }
}

/// The number of a register or of a digital input or output, from 0 to `count` - 1.
fn address(given: &Value, count: usize) -> Result<usize, String> {
    let at = given.int().map_err(|e| format!("register address: {e}"))?;
    usize::try_from(at).ok().filter(|a| *a < count).ok_or_else(|| format!("register address {at} is outside 0 to {}", count - 1))
}

/// The number of an int or double register.
fn number(given: &Value) -> Result<usize, String> {
    address(given, NUMBERS)
}

/// The number of a bit register.
fn bit(given: &Value) -> Result<usize, String> {
    address(given, BITS)
}

/// The number of one of the eight standard digital inputs or outputs.
fn standard_digital(given: &Value) -> Result<usize, String> {
    address(given, 8)
}

fn rtde_set_watchdog(a: &[Value], robot: &mut Robot) -> CallResult {
    let name = a[0].str()?;
    let input = Input::parse(name).ok_or_else(|| format!("rtde_set_watchdog: no input variable '{name}'"))?;
    let action = match &a[2] {
        Value::None => WatchdogAction::Pause,
        given => given.str()?.parse()?,
    };
    robot.set_watchdog(input, a[1].number()?, action);
    nothing()
}

/// Defaults and ranges are those of UR's script manual.
fn servoj(a: &[Value], robot: &mut Robot) -> CallResult {
    let q = a[0].six().map_err(|e| format!("servoj: {e}"))?;
    let time_s = number_in(&or_default(&a[3], robot.steptime_s()), "servoj: t", 0.0, 10.0)?;
    let lookahead_s = number_in(&or_default(&a[4], 0.1), "servoj: lookahead_time", 0.03, 0.2)?;
    let gain = number_in(&or_default(&a[5], 300.0), "servoj: gain", 100.0, 2000.0)?;
    robot.servoj(q, lookahead_s, gain);
    Ok(Effect::Servo { time_s })
}

fn stop(a: &[Value], robot: &mut Robot) -> CallResult {
    robot.servo.stop(number_in(&a[0], "deceleration", 1e-3, 1e3)?);
    Ok(Effect::Motion)
}

/// Defaults are those of UR's script manual.
fn movej(a: &[Value], robot: &mut Robot) -> CallResult {
    if matches!(&a[0], Value::Pose(_)) {
        return Err("movej: only joint positions are simulated, not a pose".to_owned());
    }
    for (given, name) in [(&a[3], "t"), (&a[4], "r")] {
        if *given != Value::None && given.number()? != 0.0 {
            return Err(format!("movej: {name} other than 0 is not simulated"));
        }
    }
    let q = a[0].six().map_err(|e| format!("movej: {e}"))?;
    let acceleration = number_in(&or_default(&a[1], 1.4), "movej: a", 1e-3, 1e3)?;
    let speed = number_in(&or_default(&a[2], 1.05), "movej: v", 1e-3, 1e3)?;
    robot.movej(q, acceleration, speed);
    Ok(Effect::Motion)
}
