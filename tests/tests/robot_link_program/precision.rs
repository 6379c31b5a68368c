//! What the program on the robot asks of the robot's computer: floats of 32 bits must do, and a control cycle is short.

use rt_controller::link::{Mode, ProgramState};
use simulator::ur::{RuntimeState, Series};

use crate::{BOTH, RUN, Robot, limiter, options};

/// Most statements of the program in one control cycle of a steady stream, on average, on a CB3 and on an e-Series. This is half of what
/// the program took when they were first counted: 77.1 and 71.4, by this test.
const STATEMENTS_ON_AVERAGE: [f64; 2] = [38.5, 35.7];
/// Most statements in the longest control cycle of such a stream, one that takes a new target; there were 101, and some 50 are counted now.
const STATEMENTS_AT_MOST: u32 = 55;
/// Calls of functions in one control cycle of a steady stream, on average; there were 18.0 and 17.3.
const CALLS_ON_AVERAGE: f64 = 6.0;

/// A program that computes in single precision, at rest before its first target.
fn single(series: Series) -> Robot {
    let robot = Robot::with_precision(series, options(), 0.0, true);
    assert_eq!((robot.int(2), robot.state()), (RUN, ProgramState::Ready));
    robot
}

/// Protects the thousandth pour from the sum of rounding errors: in single precision the joint is as exactly upright after 10,000
/// motions as after the first, and the program sees it and ends by itself.
#[test]
fn ten_thousand_motions_in_single_precision_end_upright() {
    let mut robot = single(Series::Cb3);
    let mut limiter = limiter();
    for motion in 0..10_000u32 {
        let farthest_deg = 5.0 + f64::from(motion % 97);
        let out_s = 0.1 + f64::from(motion % 13) * 0.02;
        robot.stream(0.6, &mut limiter, |t| if t < out_s { farthest_deg } else { 0.0 });
        robot.cycles.clear();
    }
    robot.stream(3.0, &mut limiter, |_| 0.0);
    let rest_deg = robot.cycles.last().unwrap().command_deg;
    println!("at rest at {rest_deg} deg");
    assert!(rest_deg.abs() < 0.0001, "after 10,000 motions the joint rests at {rest_deg} deg");
    robot.send(Mode::Stop, 0.0);
    robot.pass(1.0);
    assert_eq!((robot.state(), robot.machine.runtime_state()), (ProgramState::Stopped, RuntimeState::Stopped));
}

/// Protects the limits in single precision: a pour on both generations keeps them and comes upright.
#[test]
fn a_pour_in_single_precision_keeps_the_limits() {
    for series in BOTH {
        let mut robot = single(series);
        let mut limiter = limiter();
        robot.stream(1.5, &mut limiter, |_| 100.0);
        robot.stream(1.5, &mut limiter, |_| 30.0);
        let (fastest, hardest) = robot.extremes();
        // Rounding to 32 bits moves an angle of 2 rad by up to 1.2e-7 rad, which is 1.7 deg/s^2 on an e-Series and less on a CB3.
        assert!(fastest < 90.1 && hardest < 1510.0, "{series:?}: {fastest} deg/s, {hardest} deg/s^2");
        robot.pass(2.0);
        assert_eq!(robot.state(), ProgramState::TimedOut, "{series:?}");
        assert!(robot.cycles.last().unwrap().actual_deg.abs() < 0.2);
    }
}

/// Protects the robot's computer: the program stays short in each control cycle, so that a real controller has time for it.
#[test]
fn a_control_cycle_is_short() {
    for (series, budget) in BOTH.into_iter().zip(STATEMENTS_ON_AVERAGE) {
        let mut robot = Robot::ready(series);
        let mut limiter = limiter();
        let (mut statements, mut calls, mut instructions, mut most, mut cycles) = (0, 0, 0, 0, 0);
        for tick in 0..90 {
            robot.send(Mode::Stream, limiter.step(tick as f32).into());
            for _ in 0..(1.0 / 30.0 / robot.cycle_s) as usize {
                robot.step();
                let effort = robot.machine.program_effort();
                statements += effort.statements;
                calls += effort.calls;
                instructions += effort.instructions;
                most = most.max(effort.statements);
                cycles += 1;
            }
        }
        let [statements, calls, instructions] = [statements, calls, instructions].map(|n| f64::from(n) / f64::from(cycles));
        println!("{series:?}: {statements:.1} statements a cycle (most {most}), {calls:.1} calls, {instructions:.0} instructions");
        assert!(statements <= budget && most <= STATEMENTS_AT_MOST, "{series:?}: {statements} statements, most {most}");
        assert!(calls <= CALLS_ON_AVERAGE, "{series:?}: {calls} calls");
    }
}
