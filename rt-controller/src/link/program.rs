//! The text of the program on the robot: `robot/pour.script` with this cell's values filled in.
//!
//! It runs on the connecting thread and allocates. Values that the program could not keep are refused with a [`LinkError`].

use shared::limits::Limits;

use super::{LinkError, LinkOptions};

/// The program as it stands in `robot/pour.script`, with example values.
pub const SOURCE: &str = include_str!("../../robot/pour.script");

/// Largest number of cycles that the program averages over, so that its list and its delay stay small. Chosen by hand; no measurement is
/// recorded.
const MOST_CYCLES: f64 = 100.0;

/// Slowest share of full speed at which the program must be upright before the watchdog stops it: 1 %, the lowest step of the pendant's
/// speed slider. By how much a UR slows itself beside that is not published.
const SLOWEST: f64 = 0.01;

/// Farthest tilt in rad from which the way upright must end before the watchdog: half a turn, because somebody may have jogged the joint
/// beyond the range of a pour. Chosen by hand; no measurement is recorded.
const FARTHEST_RAD: f64 = std::f64::consts::PI;

/// Time that the program waits upright before it ends, s (pour.script).
const SETTLING_S: f64 = 0.3;

/// The lag of a UR's arm behind servoj's path, s (Universal_Robots_Client_Library, issue 86: 34 ms).
const ARM_LAG_S: f64 = 0.035;

/// The program for `options` on a robot with a control cycle of `cycle_s` (0.008 on CB3, 0.002 on e-Series).
///
/// `run` comes back in `output_int_register_b+2`.
pub fn text(options: &LinkOptions, cycle_s: f64, run: i32) -> Result<String, LinkError> {
    let limits = &options.limits;
    let period_s = 1.0 / options.rate_hz;
    let braking_s = f64::from(limits.rate_deg_s) / f64::from(limits.acceleration_deg_s2);
    // The program averages over this many cycles: at least a target's period, to be smooth, and at least the braking time, to stop
    // before the target.
    let length = (period_s.max(braking_s) / cycle_s - 1e-6).ceil();
    if !(1.0..=MOST_CYCLES).contains(&length) {
        return Err(LinkError::Limits { smoothing_s: period_s.max(braking_s), most_s: MOST_CYCLES * cycle_s });
    }
    let rad = |deg: f32| f64::from(deg).to_radians();
    let return_rate = rad(limits.return_rate_deg_s.min(limits.rate_deg_s));
    let patience_s = patience_s(options.rate_hz);
    // The watchdog must wait until the program's own way upright is done, however slowly: patience, way, averaging and settling.
    let farthest_rad = FARTHEST_RAD.max(rad(limits.alpha_max_deg - limits.alpha_min_deg));
    let way_s = patience_s + farthest_rad / return_rate + length * cycle_s + SETTLING_S;
    let watchdog_hz = 1.0 / (1.0 + way_s / SLOWEST);

    let base = options.register_base;
    let joint = options.tilt.joint.index();
    let other = |place: usize| if place < joint { place } else { place + 1 }.to_string();
    let values: [(&str, String); 24] = [
        ("RUN", run.to_string()),
        ("FIRST", base.to_string()),
        ("WATCHED", format!("\"input_int_register_{base}\"")),
        ("JOINT", joint.to_string()),
        ("OTHER_1", other(0)),
        ("OTHER_2", other(1)),
        ("OTHER_3", other(2)),
        ("OTHER_4", other(3)),
        ("OTHER_5", other(4)),
        ("START", real(options.tilt.start_deg.to_radians())),
        ("DIRECTION", real(options.tilt.direction)),
        ("TOLERANCE", real(options.start_tolerance_deg.to_radians())),
        ("ALPHA_MIN", real(rad(limits.alpha_min_deg))),
        ("ALPHA_MAX", real(rad(limits.alpha_max_deg))),
        ("RATE", real(rad(limits.rate_deg_s))),
        ("RETURN_RATE", real(return_rate)),
        ("ACCELERATION", real(rad(limits.acceleration_deg_s2))),
        ("LOOKAHEAD", real(options.lookahead_s)),
        ("GAIN", real(options.gain)),
        ("TARGET_HZ", real(options.rate_hz)),
        ("PATIENCE", real(patience_s)),
        ("WATCHDOG_HZ", real(watchdog_hz)),
        ("LENGTH", (length as usize).to_string()),
        ("WINDOW", format!("[{}]", vec!["0.0"; length as usize].join(", "))),
    ];
    let mut text = String::with_capacity(SOURCE.len() + 1024);
    for line in SOURCE.lines() {
        // Only lines of the block of values are indented by two and begin with one of these names.
        let filled = values.iter().find(|(name, _)| line.strip_prefix("  ").is_some_and(|l| l.starts_with(&format!("{name} = "))));
        match filled {
            Some((name, value)) => text.push_str(&format!("  {name} = {value}")),
            None => text.push_str(line),
        }
        text.push('\n');
    }
    Ok(text)
}

/// How long the program waits for a new target before it comes upright, s: 100 ms, or three periods if that is more.
pub fn patience_s(rate_hz: f64) -> f64 {
    (3.0 / rate_hz).max(0.1)
}

/// The lag of the joint behind the targets, s: the program walks one period and 8 ms behind them and averages over a period or the braking
/// time, servoj looks ahead, and the arm takes its own time.
pub fn usual_lag_s(rate_hz: f64, lookahead_s: f64, limits: &Limits) -> f64 {
    let period_s = 1.0 / rate_hz;
    let braking_s = f64::from(limits.rate_deg_s) / f64::from(limits.acceleration_deg_s2);
    period_s + 0.008 + period_s.max(braking_s) / 2.0 + lookahead_s + ARM_LAG_S
}

/// A number as URScript reads it: always with a decimal point, never with an exponent.
fn real(value: f64) -> String {
    format!("{value:.9}")
}
