//! What the robot makes of a stream of targets: the simulated controller is stepped with a program, and its motion is judged.
//!
//! Pure stepping, without a clock and without sockets: the same targets give the same motion. Ordinary thread; allocates.

use rt_controller::link::{LinkOptions, Mode};
use serde::Serialize;
use shared::episode::Episode;
use simulator::ur::variables::{Input, Series};
use simulator::ur::{Machine, RuntimeState};

/// Cycles within which an uploaded program must have started: 20 s on an e-Series, against 48 ms that it takes.
const START_CYCLES: u64 = 10_000;
/// Largest delay that is looked for, cycles: 0.5 s on an e-Series.
const LARGEST_DELAY_CYCLES: usize = 250;

/// The targets of an episode, as time from the first one (s) and angle (degrees). An episode has one row a camera frame; where the loop is
/// faster it had targets in between, which are put back on a straight line.
pub fn targets(episode: &Episode, rate_hz: f64) -> Vec<(f64, f32)> {
    let mut targets: Vec<(f64, f32)> =
        episode.rows.iter().filter(|f| f.alpha_commanded_deg.is_finite()).map(|f| (f.t_s, f.alpha_commanded_deg)).collect();
    let period_s = 1.0 / rate_hz;
    let mut i = 1;
    while i < targets.len() {
        let (before, after) = (targets[i - 1], targets[i]);
        if after.0 - before.0 > 1.5 * period_s {
            let part = (period_s / (after.0 - before.0)) as f32;
            targets.insert(i, (before.0 + period_s, before.1 + part * (after.1 - before.1)));
        }
        i += 1;
    }
    let start_s = targets.first().map_or(0.0, |t| t.0);
    targets.iter().map(|(t_s, alpha)| (t_s - start_s, *alpha)).collect()
}

/// One control cycle of the robot.
#[derive(Debug, Clone, Copy)]
pub struct Cycle {
    /// Time since the program started, s.
    pub t_s: f64,
    /// Alpha of the newest target, degrees.
    pub target_deg: f64,
    /// Alpha that is given to servoj, degrees.
    pub command_deg: f64,
    /// Alpha of the joint, degrees.
    pub actual_deg: f64,
}

/// Figures of one motion.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct MotionFigures {
    /// Largest size of the rate that is given to servoj, degrees/s.
    pub command_rate_deg_s: f64,
    /// Largest size of the acceleration that is given to servoj, degrees/s^2.
    pub command_acceleration_deg_s2: f64,
    /// Largest size of the joint's acceleration, degrees/s^2.
    pub joint_acceleration_deg_s2: f64,
    /// Root mean square of the joint's acceleration, degrees/s^2.
    pub joint_acceleration_rms_deg_s2: f64,
    /// Root mean square of the joint's jerk, degrees/s^3.
    pub joint_jerk_rms_deg_s3: f64,
    /// Time by which the joint is behind the targets, ms: the shift at which the two differ least.
    pub delay_ms: f64,
}

/// The program of a client without one of its own: each target goes straight to servoj until the next one comes.
pub fn raw_program(options: &LinkOptions, cycle_s: f64) -> String {
    let (joint, base) = (options.tilt.joint.index(), options.register_base);
    format!(
        "def raw_stream():\n  q = get_target_joint_positions()\n  while True:\n    q[{joint}] = read_input_float_register({base})\n    \
         servoj(q, 0, 0, {cycle_s}, {}, {})\n  end\nend\n",
        options.lookahead_s, options.gain
    )
}

/// Writes a target to the registers that the program reads.
fn send(options: &LinkOptions, machine: &mut Machine, sequence: i32, alpha_deg: f32) {
    let mut write = |name: String, bytes: &[u8]| {
        if let Some(input) = Input::parse(&name) {
            machine.robot.write_input(input, bytes);
        }
    };
    let base = options.register_base;
    write(format!("input_int_register_{base}"), &sequence.to_be_bytes());
    write(format!("input_int_register_{}", base + 1), &(Mode::Stream as i32).to_be_bytes());
    write(format!("input_double_register_{base}"), &options.tilt.joint_rad(alpha_deg).to_be_bytes());
}

/// Runs `program` on a fresh controller and streams `targets` (s, degrees) to it. Returns all control cycles until the last target.
///
/// # Errors
/// One line with the controller's log, when the program does not start or does not run to the end.
pub fn follow(options: &LinkOptions, series: Series, program: &str, targets: &[(f64, f32)]) -> Result<Vec<Cycle>, String> {
    let tilt = options.tilt;
    let joint = tilt.joint.index();
    let start_deg = targets.first().map_or(0.0, |t| t.1);
    let mut stance = [0.0, -1.571, 1.571, -1.571, -1.571, 0.0];
    stance[joint] = tilt.joint_rad(start_deg);
    let mut machine = Machine::new(series, series.default_version(), stance);
    send(options, &mut machine, 0, start_deg);
    machine.upload(program);
    let end_s = targets.last().map_or(0.0, |t| t.0);
    let mut cycles: Vec<Cycle> = Vec::new();
    let (mut started_s, mut sent, mut target_deg) = (None, 0, start_deg);
    loop {
        machine.step();
        let now_s = machine.robot.timestamp_s();
        if machine.runtime_state() != RuntimeState::Playing {
            if started_s.is_some() || machine.cycle() > START_CYCLES {
                let log: Vec<String> = machine.take_log().map(|l| l.text).collect();
                return Err(format!("the program did not run to the end: {}", log.join("; ")));
            }
            continue;
        }
        let t_s = now_s - *started_s.get_or_insert(now_s);
        if t_s > end_s {
            return Ok(cycles);
        }
        while let Some((_, alpha_deg)) = targets.get(sent).filter(|(at_s, _)| *at_s <= t_s) {
            sent += 1;
            target_deg = *alpha_deg;
            send(options, &mut machine, sent as i32, target_deg);
        }
        let servo = &machine.robot.servo;
        let alpha = |q: f64| tilt.direction * (q.to_degrees() - tilt.start_deg);
        cycles.push(Cycle {
            t_s,
            target_deg: target_deg.into(),
            command_deg: alpha(servo.commanded_q[joint]),
            actual_deg: alpha(servo.actual_q[joint]),
        });
    }
}

/// Differences of neighbouring points, over time.
pub fn slope(points: &[(f64, f64)]) -> Vec<(f64, f64)> {
    points.windows(2).map(|w| (w[1].0, (w[1].1 - w[0].1) / (w[1].0 - w[0].0))).collect()
}

/// The largest size of a value.
fn largest(points: &[(f64, f64)]) -> f64 {
    points.iter().fold(0.0, |m, p| m.max(p.1.abs()))
}

/// Root mean square of the values.
fn rms(points: &[(f64, f64)]) -> f64 {
    (points.iter().map(|p| p.1 * p.1).sum::<f64>() / points.len().max(1) as f64).sqrt()
}

/// The figures of a motion.
pub fn figures(cycles: &[Cycle]) -> MotionFigures {
    let command: Vec<_> = cycles.iter().map(|c| (c.t_s, c.command_deg)).collect();
    let actual: Vec<_> = cycles.iter().map(|c| (c.t_s, c.actual_deg)).collect();
    let (rate, acceleration) = (slope(&command), slope(&slope(&actual)));
    // Mean square of the joint's difference from the targets that were sent so many cycles earlier.
    let off = |shift: usize| {
        cycles.iter().zip(&cycles[shift..]).map(|(t, a)| (a.actual_deg - t.target_deg).powi(2)).sum::<f64>() / (cycles.len() - shift) as f64
    };
    let best = (0..cycles.len().min(LARGEST_DELAY_CYCLES)).min_by(|a, b| off(*a).total_cmp(&off(*b))).unwrap_or(0);
    let cycle_s = cycles.get(1).map_or(0.0, |c| c.t_s - cycles[0].t_s);
    MotionFigures {
        command_rate_deg_s: largest(&rate),
        command_acceleration_deg_s2: largest(&slope(&rate)),
        joint_acceleration_deg_s2: largest(&acceleration),
        joint_acceleration_rms_deg_s2: rms(&acceleration),
        joint_jerk_rms_deg_s3: rms(&slope(&acceleration)),
        delay_ms: 1000.0 * best as f64 * cycle_s,
    }
}
