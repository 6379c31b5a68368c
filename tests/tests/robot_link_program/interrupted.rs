//! The program on the robot when it is paused, jogged, slowed and hung: what the arm does then, control cycle by control cycle.

use rt_controller::link::{Mode, ProgramState, program};
use simulator::ur::{RuntimeState, SafetyMode, Series};

use crate::{BOTH, RUN, Robot, STANCE_RAD, limiter, options};

/// Moves joint `joint` by `by_rad` with the pendant while the program is paused, and waits until the arm stands.
fn jog(robot: &mut Robot, joint: usize, by_rad: f64) {
    robot.machine.move_joint(joint, by_rad, false);
    robot.pass(8.0);
}

/// Largest speed that any joint but the tilting one has until the program ends, rad/s, and that of the tilting one, degrees/s.
fn speeds_to_the_end(robot: &mut Robot, seconds: f64) -> (f64, f64) {
    let (mut others, mut tilt) = (0.0f64, 0.0f64);
    for _ in 0..(seconds / robot.cycle_s) as usize {
        if robot.machine.runtime_state() == RuntimeState::Stopped {
            break;
        }
        robot.step();
        let qd = robot.machine.robot.servo.target_qd;
        others = qd[..5].iter().fold(others, |m, v| m.max(v.abs()));
        tilt = tilt.max(qd[5].abs().to_degrees());
    }
    (others, tilt)
}

fn assert_upright_and_ended(robot: &Robot, what: &str) {
    let alpha_deg = robot.cycles.last().unwrap().actual_deg;
    assert_eq!((robot.machine.safety_mode(), robot.state()), (SafetyMode::Normal, ProgramState::OffTrackEnded), "{what}: {alpha_deg} deg");
    assert!(alpha_deg.abs() < 0.2, "{what}: {alpha_deg} deg");
}

/// Protects bystanders against a resumed program that throws the arm back: base, shoulder or any other joint was jogged during a
/// pause, a little or a lot. It stays where it is, and the container comes upright slowly.
#[test]
fn a_resumed_program_leaves_the_five_other_joints_where_they_were_jogged() {
    for series in BOTH {
        for (joint, by_rad) in [(0, 0.15), (0, 1.5), (1, 0.30), (1, -0.9), (2, 0.02), (3, -0.19), (4, 2.0)] {
            let mut robot = Robot::ready(series);
            robot.stream(1.5, &mut limiter(), |_| 60.0);
            assert!(robot.machine.pause());
            robot.pass(0.5);
            jog(&mut robot, joint, by_rad);
            let jogged = robot.machine.robot.servo.target_q;
            assert!((jogged[joint] - STANCE_RAD[joint] - by_rad).abs() < 1e-3);
            assert!(robot.machine.resume());
            let (others, tilt) = speeds_to_the_end(&mut robot, 4.0);
            let what = format!("{series:?}, joint {joint} jogged by {by_rad} rad");
            assert!(others < 1e-9, "{what}: another joint moves at {others} rad/s");
            assert!(tilt < 66.0, "{what}: {tilt} deg/s is faster than the way upright");
            assert_upright_and_ended(&robot, &what);
            let now = robot.machine.robot.servo.target_q;
            assert!((0..5).all(|i| now[i] == jogged[i]), "{what}: {now:?}");
        }
    }
}

/// Protects bystanders in the same way after a protective stop at full flow, with the tilting joint jogged too.
#[test]
fn a_program_resumed_after_a_protective_stop_leaves_the_jogged_joints() {
    for series in BOTH {
        for tilt_by_rad in [0.0, 0.4, -1.4, -2.5] {
            let mut robot = Robot::ready(series);
            robot.stream(0.9, &mut limiter(), |_| 90.0);
            robot.machine.protective_stop("test");
            robot.pass(6.0);
            robot.machine.unlock_protective_stop().unwrap();
            jog(&mut robot, 1, 0.6);
            jog(&mut robot, 5, tilt_by_rad);
            let jogged = robot.machine.robot.servo.target_q;
            assert!(robot.machine.resume());
            let (others, tilt) = speeds_to_the_end(&mut robot, 5.0);
            let what = format!("{series:?}, tilt jogged by {tilt_by_rad} rad");
            assert!(others < 1e-9, "{what}: another joint moves at {others} rad/s");
            assert!(tilt < 66.0, "{what}: {tilt} deg/s is faster than the way upright");
            assert_upright_and_ended(&robot, &what);
            assert!((0..5).all(|i| robot.machine.robot.servo.target_q[i] == jogged[i]), "{what}");
        }
    }
}

/// Protects the glass from a watchdog that leaves the container tilted: with the slider at 5 % and at 1 %, and with the arm slowed
/// below the slider, the program still comes all the way upright before the watchdog stops it.
#[test]
fn the_watchdog_outlasts_the_slowest_way_upright() {
    for (slider, own) in [(0.05, 1.0), (0.01, 1.0), (1.0, 0.05), (0.1, 0.1)] {
        let mut robot = Robot::ready(Series::Cb3);
        robot.stream(1.6, &mut limiter(), |_| 100.0);
        robot.machine.robot.set_speed_slider(slider);
        robot.machine.robot.set_own_scaling(own);
        let share = slider * own;
        robot.pass((0.2 + 100.0 / 60.0 + 0.5) / share);
        let alpha_deg = robot.cycles.last().unwrap().actual_deg;
        assert_eq!(robot.state(), ProgramState::TimedOut, "{slider} * {own}: left tilted by {alpha_deg} deg");
        assert!(alpha_deg.abs() < 0.2, "{slider} * {own}: {alpha_deg} deg");
    }
}

/// Protects the next pour: a program that hangs in the middle of its motion is still stopped by the watchdog.
#[test]
fn a_program_that_hangs_is_stopped() {
    let mut robot = Robot::ready(Series::Cb3);
    let text = program::text(&options(), robot.cycle_s, RUN + 1).unwrap();
    let hangs = text.replace("    servoj(q,", "    while alpha > 0.5:\n      sync()\n    end\n    servoj(q,");
    assert_ne!(hangs, text);
    robot.machine.upload(&hangs);
    robot.pass(0.2);
    robot.stream(1.0, &mut limiter(), |_| 60.0);
    robot.pass(60.0);
    assert_eq!(robot.machine.runtime_state(), RuntimeState::Playing, "the program's own way upright has to come first");
    robot.pass(340.0);
    assert_eq!(robot.machine.runtime_state(), RuntimeState::Stopped);
}

/// Protects the judgement of a pour from an arm that is slowed: with the arm at a tenth of its speed, servoj takes ten times as long
/// and the joint is that much slower, while the slider still says 100 %.
#[test]
fn a_slowed_arm_is_slow_although_the_slider_is_not() {
    let mut robot = Robot::ready(Series::Cb3);
    robot.machine.robot.set_own_scaling(0.1);
    robot.stream(1.0, &mut limiter(), |t| 60.0 * t);
    let alpha_deg = robot.cycles.last().unwrap().actual_deg;
    assert!((0.5..7.0).contains(&alpha_deg), "{alpha_deg} deg");
    assert_eq!((robot.machine.robot.speed_slider(), robot.machine.robot.own_scaling()), (1.0, 0.1));
    robot.send(Mode::Stop, 0.0);
    robot.pass(20.0);
    assert_eq!(robot.state(), ProgramState::Stopped);
}
