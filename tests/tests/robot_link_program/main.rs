//! The program on the robot (`rt-controller/robot/pour.script`) on the simulated controller, control cycle by control cycle.
//!
//! The tests use no sockets and no clock, so what they assert is exact and holds on every machine.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

mod interrupted;
mod limits;
mod precision;
mod watch;

use rand::{RngExt, SeedableRng};
use rt_controller::link::{LinkOptions, Mode, ProgramState, TiltJoint, program};
use shared::config::Joint;
use shared::limits::{Limiter, Limits};
use simulator::ur::variables::Input;
use simulator::ur::{Machine, RuntimeState, SafetyMode, Series};
use watch::Watch;

const RUN: i32 = 4711;
/// Where the other five joints stand, rad; wrist 3 is at its start angle.
const STANCE_RAD: [f64; 6] = [0.3, -1.2, 1.4, -0.5, 1.6, 0.0];

fn options() -> LinkOptions {
    tests::link_options([127, 0, 0, 1].into())
}

/// What one control cycle showed; angles as alpha in degrees.
#[derive(Debug, Clone, Copy)]
struct Cycle {
    command_deg: f64,
    target_deg: f64,
    actual_deg: f64,
}

struct Robot {
    machine: Machine,
    options: LinkOptions,
    cycle_s: f64,
    sequence: i32,
    /// The control cycles since the program started.
    cycles: Vec<Cycle>,
    /// Looks at everything that servoj is told.
    watch: Watch,
}

impl Robot {
    fn new(series: Series, options: LinkOptions, start_rad: f64) -> Self {
        Self::with_precision(series, options, start_rad, false)
    }

    /// `single` is true for a controller that computes with floats of 32 bits.
    fn with_precision(series: Series, options: LinkOptions, start_rad: f64, single: bool) -> Self {
        let mut stance = STANCE_RAD;
        stance[options.tilt.joint.index()] = start_rad;
        let mut machine = Machine::new(series, series.default_version(), stance);
        machine.set_single_precision(single);
        let cycle_s = machine.robot.steptime_s();
        let watch = Watch::new(&options, &machine, single);
        let mut robot = Self { machine, options, cycle_s, sequence: 500, cycles: Vec::new(), watch };
        // This is what an old session left behind.
        robot.send(Mode::Stream, 77.0);
        let text = program::text(&robot.options, cycle_s, RUN).unwrap();
        robot.machine.upload(&text);
        while robot.int(2) != RUN {
            robot.step();
            assert!(robot.cycles.len() < 1000, "{:?}", robot.machine.take_log().collect::<Vec<_>>());
        }
        robot.cycles.clear();
        robot
    }

    fn ready(series: Series) -> Self {
        let robot = Self::new(series, options(), 0.0);
        assert_eq!(robot.state(), ProgramState::Ready);
        robot
    }

    fn int(&self, offset: usize) -> i32 {
        self.machine.robot.outputs.int[usize::from(self.options.register_base) + offset]
    }

    fn state(&self) -> ProgramState {
        ProgramState::from_code(self.int(0))
    }

    fn step(&mut self) {
        self.watch.before(&self.machine);
        self.machine.step();
        self.watch.after(&self.machine);
        let servo = &self.machine.robot.servo;
        let tilt = self.options.tilt;
        let joint = tilt.joint.index();
        let deg = |q: f64| tilt.direction * (q.to_degrees() - tilt.start_deg);
        self.cycles.push(Cycle {
            command_deg: deg(servo.commanded_q[joint]),
            target_deg: deg(servo.target_q[joint]),
            actual_deg: deg(servo.actual_q[joint]),
        });
    }

    fn pass(&mut self, seconds: f64) {
        for _ in 0..(seconds / self.cycle_s).round() as usize {
            self.step();
        }
    }

    fn send(&mut self, mode: Mode, alpha_deg: f64) {
        self.sequence += 1;
        let joint_rad = (self.options.tilt.start_deg + self.options.tilt.direction * alpha_deg).to_radians();
        self.send_raw(self.sequence, mode as i32, joint_rad);
    }

    fn send_raw(&mut self, sequence: i32, mode: i32, joint_rad: f64) {
        let base = self.options.register_base;
        let mut write = |name: String, bytes: &[u8]| self.machine.robot.write_input(Input::parse(&name).unwrap(), bytes);
        write(format!("input_int_register_{base}"), &sequence.to_be_bytes());
        write(format!("input_int_register_{}", base + 1), &mode.to_be_bytes());
        write(format!("input_double_register_{base}"), &joint_rad.to_be_bytes());
    }

    /// Streams at 30 Hz, each target through the controller's own limiter; `request` maps seconds to degrees.
    fn stream(&mut self, seconds: f64, limiter: &mut Limiter, request: impl Fn(f64) -> f64) {
        let start = self.cycles.len();
        let mut sent = 0;
        loop {
            let now = (self.cycles.len() - start) as f64 * self.cycle_s;
            if now >= seconds {
                return;
            }
            if now * 30.0 >= f64::from(sent) {
                let target = limiter.step(request(f64::from(sent) / 30.0) as f32);
                self.send(Mode::Stream, target.into());
                sent += 1;
            }
            self.step();
        }
    }

    /// Largest |speed| and |acceleration| of the angles that servoj was given, degrees/s and degrees/s^2.
    fn extremes(&self) -> (f64, f64) {
        let speeds: Vec<f64> = self.cycles.windows(2).map(|w| (w[1].command_deg - w[0].command_deg) / self.cycle_s).collect();
        let fastest = speeds.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let hardest = speeds.windows(2).fold(0.0f64, |m, w| m.max((w[1] - w[0]).abs() / self.cycle_s));
        (fastest, hardest)
    }

    fn assert_within_limits(&self) {
        let limits = self.options.limits;
        let (fastest, hardest) = self.extremes();
        assert!(fastest <= f64::from(limits.rate_deg_s) + 1e-6, "{fastest} deg/s");
        assert!(hardest <= f64::from(limits.acceleration_deg_s2) * 1.000_001, "{hardest} deg/s^2");
        let others = |q: &[f64; 6]| (0..6).filter(|i| *i != self.options.tilt.joint.index()).all(|i| q[i] == STANCE_RAD[i]);
        assert!(others(&self.machine.robot.servo.commanded_q), "the other joints stay");
    }
}

const BOTH: [Series; 2] = [Series::Cb3, Series::ESeries];

fn limiter() -> Limiter {
    Limiter::new(Limits::default(), 1.0 / 30.0, 0.0)
}

/// Protects the pour from jerks: a stream of constant speed becomes a motion of constant speed although 30 Hz and the control
/// cycle do not fit each other.
#[test]
fn a_steady_stream_is_a_steady_motion() {
    for series in BOTH {
        let mut robot = Robot::ready(series);
        robot.stream(3.0, &mut limiter(), |t| 30.0 * t);
        robot.assert_within_limits();
        let settled = &robot.cycles[(1.0 / robot.cycle_s) as usize..];
        for pair in settled.windows(2) {
            let speed = (pair[1].command_deg - pair[0].command_deg) / robot.cycle_s;
            assert!((speed - 30.0).abs() < 0.6, "{speed} deg/s in {series:?}");
        }
    }
}

/// Protects the cup: the arm stays between the targets. It comes to rest at the newest one, even out of full speed and when no
/// further target comes, and never beyond.
#[test]
fn it_never_goes_beyond_the_newest_target() {
    for series in BOTH {
        let mut robot = Robot::ready(series);
        let mut limiter = limiter();
        robot.stream(0.8, &mut limiter, |_| 110.0);
        let newest = f64::from(limiter.alpha_deg());
        assert!(limiter.rate_deg_s() > 89.0, "out of full speed");
        robot.pass(0.1);
        let farthest = robot.cycles.iter().fold(0.0f64, |m, c| m.max(c.command_deg));
        assert!(farthest <= newest + 1e-6 && farthest > newest - 0.01, "{farthest}, newest target {newest}");
        robot.assert_within_limits();
    }
}

/// Protects the operator's glass: 100 ms without a target, and the container comes upright at the return rate, the program
/// ends and says so; the watchdog, which would leave it tilted, does not act before.
#[test]
fn without_targets_it_comes_upright_and_ends() {
    for series in BOTH {
        let mut robot = Robot::ready(series);
        robot.stream(1.6, &mut limiter(), |_| 100.0);
        let silent_from = robot.cycles.len();
        while robot.state() == ProgramState::Following {
            robot.step();
        }
        let patience_s = (robot.cycles.len() - silent_from) as f64 * robot.cycle_s;
        assert!((0.06..=0.11).contains(&patience_s), "{patience_s} s");
        assert_eq!(robot.state(), ProgramState::Returning);
        robot.pass(100.0 / 60.0 + 0.6);
        assert_eq!((robot.state(), robot.machine.runtime_state()), (ProgramState::TimedOut, RuntimeState::Stopped));
        assert!(robot.cycles.last().unwrap().actual_deg.abs() < 0.2);
        robot.assert_within_limits();
        assert_eq!(robot.machine.safety_mode(), SafetyMode::Normal);
    }
}

/// Protects people from a pour that resumes by itself: once the container is on its way upright, new targets change nothing.
#[test]
fn a_return_is_never_taken_back() {
    let mut robot = Robot::ready(Series::Cb3);
    let mut limiter = limiter();
    robot.stream(1.0, &mut limiter, |_| 60.0);
    robot.pass(0.2);
    assert_eq!(robot.state(), ProgramState::Returning);
    robot.stream(2.0, &mut limiter, |_| 60.0);
    assert_eq!(robot.state(), ProgramState::TimedOut);
    assert!(robot.cycles.last().unwrap().actual_deg.abs() < 0.2);
}

/// Protects the way upright from the watchdog: even with the speed slider at a third, the program's own way is finished first.
#[test]
fn a_slow_slider_does_not_bring_the_watchdog_first() {
    let mut robot = Robot::ready(Series::Cb3);
    robot.stream(1.6, &mut limiter(), |_| 100.0);
    let slider = |robot: &mut Robot, name: &str, bytes: &[u8]| robot.machine.robot.write_input(Input::parse(name).unwrap(), bytes);
    slider(&mut robot, "speed_slider_mask", &1u32.to_be_bytes());
    slider(&mut robot, "speed_slider_fraction", &0.34f64.to_be_bytes());
    robot.pass(3.0 * (100.0 / 60.0 + 0.7));
    assert_eq!(robot.state(), ProgramState::TimedOut);
    assert!(robot.cycles.last().unwrap().actual_deg.abs() < 0.2);
}

/// Protects the arm from whatever comes in: under any targets, sequence numbers and modes, NaN among them, every limit is kept.
#[test]
fn no_stream_leads_beyond_the_limits() {
    for seed in 0..20 {
        let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(seed);
        let series = BOTH[(seed % 2) as usize];
        let mut robot = Robot::ready(series);
        let mut sequence = 1000;
        while robot.cycles.len() < (20.0 / robot.cycle_s) as usize {
            let wild = [f64::NAN, f64::INFINITY, -1e300, 1e9, 0.0, 1.92, random.random_range(-3.0..3.0), random.random_range(0.0..1.9)];
            let mode = if random.random_range(0..40) == 0 { 1 } else { 2 };
            sequence += [1, 1, 1, 2, 3, 7, -5][random.random_range(0..7)];
            robot.send_raw(sequence, mode, wild[random.random_range(0..wild.len())]);
            robot.pass(random.random_range(0.001..0.07));
        }
        let log: Vec<_> = robot.machine.take_log().collect();
        assert_eq!(robot.machine.runtime_state(), RuntimeState::Playing, "seed {seed}: {log:?}");
        assert_eq!(robot.machine.safety_mode(), SafetyMode::Normal, "no demand that an arm could not follow");
        robot.assert_within_limits();
        for cycle in &robot.cycles {
            // A stream that reverses out of full speed may cost a hundredth of a degree.
            assert!((-0.02..=110.02).contains(&cycle.command_deg), "{} deg", cycle.command_deg);
        }
    }
}

/// Protects the modes: hold brakes and stays, stream goes on from there without a jump, stop comes upright and ends.
#[test]
fn it_obeys_hold_stream_and_stop() {
    let mut robot = Robot::ready(Series::Cb3);
    let mut limiter = limiter();
    robot.stream(1.0, &mut limiter, |_| 110.0);
    let hold = |robot: &mut Robot, seconds: f64| {
        for _ in 0..(seconds * 30.0) as usize {
            robot.send(Mode::Hold, 0.0);
            robot.pass(4.0 * 0.008);
        }
    };
    hold(&mut robot, 0.3);
    assert_eq!(robot.state(), ProgramState::Holding);
    let held = robot.cycles.last().unwrap().command_deg;
    hold(&mut robot, 0.5);
    assert_eq!(robot.cycles.last().unwrap().command_deg, held, "holds still");
    limiter.rest_at(held as f32);
    robot.stream(1.0, &mut limiter, |_| 20.0);
    assert_eq!(robot.state(), ProgramState::Following);
    assert!((robot.cycles.last().unwrap().command_deg - 20.0).abs() < 0.5);
    robot.send(Mode::Stop, 0.0);
    robot.pass(0.05);
    assert_eq!(robot.state(), ProgramState::Stopping);
    robot.pass(20.0 / 60.0 + 0.6);
    assert_eq!((robot.state(), robot.machine.runtime_state()), (ProgramState::Stopped, RuntimeState::Stopped));
    robot.assert_within_limits();
}

/// Protects bystanders at the start: far from the start angle nothing moves; near it the joint goes to upright smoothly.
#[test]
fn it_refuses_to_start_far_from_upright() {
    let far = 2.1f64.to_radians();
    let mut robot = Robot::new(Series::Cb3, options(), far);
    assert_eq!(robot.state(), ProgramState::TooFar);
    robot.pass(0.1);
    assert_eq!((robot.state(), robot.machine.runtime_state()), (ProgramState::TooFar, RuntimeState::Stopped));
    assert_eq!(robot.machine.robot.servo.actual_q[5], far);

    let mut robot = Robot::new(Series::Cb3, options(), 1.9f64.to_radians());
    assert_eq!(robot.state(), ProgramState::Ready);
    robot.stream(1.0, &mut limiter(), |_| 0.0);
    assert!(robot.cycles.last().unwrap().actual_deg.abs() < 0.05);
    robot.assert_within_limits();
}

/// Protects the joint's geometry: another joint, start angle and direction tilt the container just the same.
#[test]
fn start_angle_and_direction_are_kept() {
    let tilt = TiltJoint { joint: Joint::Wrist2, start_deg: 91.673_247, direction: -1.0 };
    let mut robot = Robot::new(Series::Cb3, LinkOptions { tilt, register_base: 40, ..options() }, 1.6);
    assert_eq!(robot.state(), ProgramState::Ready);
    robot.stream(2.0, &mut limiter(), |_| 45.0);
    let wrist_2 = robot.machine.robot.servo.actual_q[4].to_degrees();
    assert!((wrist_2 - (91.673 - 45.0)).abs() < 0.1, "{wrist_2}");
    assert!((robot.machine.robot.outputs.double[40].to_degrees() - (91.673 - 45.0)).abs() < 0.1);
}

/// Protects the first motion: a joint that starts beside its start angle, inside the tolerance, is taken from where it is.
#[test]
fn the_first_command_is_where_the_joint_is() {
    for direction in [1.0, -1.0] {
        let tilt = TiltJoint { joint: Joint::Wrist3, start_deg: 30.0, direction };
        let mut robot = Robot::new(Series::Cb3, LinkOptions { tilt, ..options() }, (30.0 + direction * 0.5f64).to_radians());
        robot.stream(0.05, &mut limiter(), |_| 0.0);
        let commands: Vec<f64> = robot.cycles.iter().map(|c| c.command_deg).collect();
        assert!(commands.iter().all(|c| (-0.01..=0.51).contains(c)), "{commands:?}");
        assert_eq!(robot.state(), ProgramState::Following);
    }
}

/// Protects the way back: a target beyond the range counts as the range's end, so that the next one is followed at once.
#[test]
fn a_target_beyond_the_range_is_its_end() {
    let mut robot = Robot::ready(Series::Cb3);
    for (target_deg, seconds) in [(170.0, 3.0), (60.0, 0.3)] {
        for _ in 0..(seconds * 30.0) as usize {
            robot.send(Mode::Stream, target_deg);
            robot.pass(1.0 / 30.0);
        }
        if target_deg > 110.0 {
            let command_deg = robot.cycles.last().unwrap().command_deg;
            assert!((command_deg - 110.0).abs() < 0.01, "{command_deg}");
        }
    }
    let command_deg = robot.cycles.last().unwrap().command_deg;
    assert!(command_deg < 100.0, "{command_deg}: on its way to 60");
    robot.assert_within_limits();
}

/// Protects the next controller: a program that nobody uses ends by itself, without moving.
#[test]
fn an_unused_program_ends() {
    let mut robot = Robot::ready(Series::Cb3);
    robot.pass(1.9);
    assert_eq!(robot.state(), ProgramState::Ready);
    robot.pass(0.2);
    assert_eq!((robot.state(), robot.machine.runtime_state()), (ProgramState::Unused, RuntimeState::Stopped));
    assert_eq!(robot.machine.robot.servo.actual_q, STANCE_RAD);
}

/// Protects people after a pause: resumed after a protective stop in mid-motion, with nobody streaming, it comes upright from where it
/// stopped and ends.
#[test]
fn resumed_after_a_protective_stop_it_comes_upright() {
    let mut robot = Robot::ready(Series::Cb3);
    robot.stream(0.9, &mut limiter(), |_| 90.0);
    robot.machine.protective_stop("test");
    robot.pass(6.0);
    let stopped_at = robot.cycles.last().unwrap().actual_deg;
    assert!(stopped_at > 40.0);
    robot.machine.unlock_protective_stop().unwrap();
    assert!(robot.machine.resume());
    robot.pass(0.12);
    assert_eq!(robot.state(), ProgramState::OffTrack, "it is not where it was told to be");
    robot.pass(3.0);
    assert_eq!((robot.state(), robot.machine.safety_mode()), (ProgramState::OffTrackEnded, SafetyMode::Normal));
    assert!(robot.cycles.last().unwrap().actual_deg.abs() < 0.2);
}

/// Protects the limit on acceleration: resumed after a pause in mid-motion, and told of it, it begins from rest.
#[test]
fn resumed_in_mid_motion_it_begins_from_rest() {
    for series in BOTH {
        let mut robot = Robot::ready(series);
        robot.stream(0.4, &mut limiter(), |_| 90.0);
        let moving = robot.cycles[robot.cycles.len() - 2..].iter().map(|c| c.command_deg).collect::<Vec<_>>();
        assert!((moving[1] - moving[0]) / robot.cycle_s > 60.0, "in motion: {moving:?}");
        robot.machine.pause();
        robot.pass(1.0);
        robot.send(Mode::Abandon, 0.0);
        robot.cycles.clear();
        assert!(robot.machine.resume());
        let mut at_deg = robot.machine.robot.servo.target_q[5].to_degrees();
        let (mut rate, calls) = (0.0, robot.machine.robot.servo.servoj_calls);
        while robot.state() != ProgramState::Stopped {
            robot.step();
            assert!(robot.cycles.len() < 2000, "{:?}", robot.state());
            if robot.machine.robot.servo.servoj_calls > calls {
                let command_deg = robot.cycles.last().unwrap().command_deg;
                let next = (command_deg - at_deg) / robot.cycle_s;
                assert!((next - rate).abs() / robot.cycle_s <= 1500.1, "{rate} to {next} deg/s in a cycle");
                (at_deg, rate) = (command_deg, next);
            }
        }
        assert!(robot.cycles.last().unwrap().actual_deg.abs() < 0.2);
    }
}

/// Protects people from a jump: a joint that was moved by somebody else during a pause is brought upright from where it is.
#[test]
fn a_joint_that_was_moved_is_not_jerked_back() {
    let mut robot = Robot::ready(Series::Cb3);
    robot.stream(1.5, &mut limiter(), |_| 40.0);
    robot.machine.pause();
    robot.pass(1.0);
    let mut elsewhere = robot.machine.robot.servo.actual_q;
    elsewhere[5] = 60f64.to_radians();
    robot.machine.robot.servo.movej(elsewhere, 2.0, 1.0).unwrap();
    robot.pass(2.0);
    assert!((robot.cycles.last().unwrap().actual_deg - 60.0).abs() < 0.1);
    robot.cycles.clear();
    assert!(robot.machine.resume());
    robot.pass(0.1);
    assert_eq!(robot.state(), ProgramState::OffTrack);
    robot.pass(2.0);
    assert_eq!((robot.state(), robot.machine.safety_mode()), (ProgramState::OffTrackEnded, SafetyMode::Normal));
    assert!(robot.cycles.last().unwrap().actual_deg.abs() < 0.2);
    let fastest = robot.cycles.windows(2).fold(0.0f64, |m, w| m.max((w[1].target_deg - w[0].target_deg).abs() / 0.008));
    assert!(fastest < 66.0, "{fastest} deg/s: not faster than the way upright");
}

/// Protects the echo: the newest number is read back in the cycle in which it was read.
#[test]
fn the_sequence_is_echoed() {
    let mut robot = Robot::ready(Series::Cb3);
    for _ in 0..5 {
        robot.send(Mode::Stream, 0.0);
        robot.pass(0.016);
        assert_eq!(robot.int(1), robot.sequence);
    }
}
