//! Every limit of what servoj is told, at both control rates and through everything that may happen to the arm on its way.
//!
//! The limits themselves are asserted by [`crate::watch`] in each control cycle; these tests say what happens, and how it must end.

use rt_controller::link::{Mode, ProgramState};
use simulator::ur::{RuntimeState, SafetyMode, Series};

use crate::{BOTH, Robot, STANCE_RAD, limiter};

/// Where in a pour something happens.
#[derive(Debug, Clone, Copy, PartialEq)]
enum Moment {
    /// Before the first target.
    Ready,
    /// 0.1 s after the joint began to move.
    Starting,
    /// In full motion.
    Moving,
    /// At rest, tilted.
    Tilted,
    /// At rest, tilted, on the command to hold.
    Holding,
    /// In full motion back towards upright.
    Reversing,
    /// The controller is gone, and the program brings the container upright.
    Returning,
    /// The same, a moment before the program ends.
    AlmostUpright,
}

const MOMENTS: [Moment; 8] = [
    Moment::Ready,
    Moment::Starting,
    Moment::Moving,
    Moment::Tilted,
    Moment::Holding,
    Moment::Reversing,
    Moment::Returning,
    Moment::AlmostUpright,
];

/// A program that has come to `moment` of a pour to 80 degrees.
fn at(moment: Moment, series: Series) -> Robot {
    let mut robot = Robot::ready(series);
    let mut limiter = limiter();
    let out_s = match moment {
        Moment::Ready => return robot,
        Moment::Starting => 0.1,
        Moment::Moving => 0.5,
        _ => 1.6,
    };
    robot.stream(out_s, &mut limiter, |_| 80.0);
    match moment {
        Moment::Holding => {
            for _ in 0..5 {
                robot.send(Mode::Hold, 0.0);
                robot.pass(0.032);
            }
        }
        Moment::Reversing => robot.stream(0.4, &mut limiter, |_| 0.0),
        Moment::Returning => robot.pass(0.7),
        Moment::AlmostUpright => robot.pass(0.12 + 80.0 / 60.0 + 0.2),
        _ => {}
    }
    robot
}

/// Lets the program go on, at `share` of full speed, until it has ended; then the container is upright and stays so. Gives after how many
/// seconds it was upright.
fn assert_ends_upright(robot: &mut Robot, share: f64, what: &str) -> f64 {
    let begun = robot.cycles.len();
    let most_s = (2.2 + 200.0 / 60.0 + 1.0) / share;
    for _ in 0..(most_s / robot.cycle_s) as usize {
        if robot.machine.runtime_state() == RuntimeState::Stopped {
            break;
        }
        robot.step();
    }
    let state = robot.state();
    assert_eq!(robot.machine.runtime_state(), RuntimeState::Stopped, "{what}: {state:?}");
    assert!(!state.takes_targets(), "{what}: {state:?}");
    robot.pass(1.0);
    let alpha_deg = robot.cycles.last().unwrap().actual_deg;
    assert!(alpha_deg.abs() < 0.2, "{what}: {state:?} at {alpha_deg} deg");
    let log: Vec<_> = robot.machine.take_log().map(|l| l.text).collect();
    assert_eq!(robot.machine.safety_mode(), SafetyMode::Normal, "{what}: {log:?}");
    let tilted = robot.cycles[begun..].iter().rposition(|c| c.actual_deg.abs() > 0.5).map_or(0, |at| at + 1);
    tilted as f64 * robot.cycle_s
}

/// Pauses at `moment`, jogs `joints`, resumes, and sees how it ends. The controller is alive when `abandon` is set, and writes that.
fn pause_jog_resume(series: Series, moment: Moment, joints: &[(usize, f64)], abandon: bool, slider: f64) {
    let what = format!("{series:?}, paused at {moment:?}, jogged {joints:?}, abandon {abandon}, slider {slider}");
    let mut robot = at(moment, series);
    assert!(robot.machine.pause(), "{what}");
    robot.machine.robot.set_speed_slider(slider);
    robot.pass(0.5);
    for (joint, by_rad) in joints {
        robot.machine.move_joint(*joint, *by_rad, false);
        robot.pass(6.0);
    }
    if abandon {
        robot.send(Mode::Abandon, 0.0);
    }
    let stands = robot.machine.robot.servo.target_q;
    let ready_and_untouched = moment == Moment::Ready && joints.is_empty() && !abandon;
    assert!(robot.machine.resume(), "{what}");
    assert_ends_upright(&mut robot, slider, &what);
    if ready_and_untouched {
        assert_eq!(robot.state(), ProgramState::Unused, "{what}");
    }
    let now = robot.machine.robot.servo.target_q;
    assert!((0..5).all(|i| (now[i] - stands[i]).abs() < 1e-9), "{what}: the other joints went from {stands:?} to {now:?}");
}

/// Protects people and glass through a pause at any moment of a pour, whatever was jogged in it, and whether or not the controller is
/// still there when it is resumed.
#[test]
fn a_pause_at_any_moment_ends_upright_within_the_limits() {
    let jogs: [&[(usize, f64)]; 9] = [
        &[],
        &[(0, 0.15)],
        &[(1, -0.4)],
        &[(2, 0.002)],
        &[(3, 0.3), (4, -0.5)],
        &[(0, 0.7), (1, 0.2), (2, -0.3), (3, 0.1), (4, 1.0), (5, -0.3)],
        &[(5, 0.02)],
        &[(5, -0.2)],
        &[(5, 0.5)],
    ];
    for series in BOTH {
        for moment in MOMENTS {
            for joints in jogs {
                for abandon in [false, true] {
                    pause_jog_resume(series, moment, joints, abandon, 1.0);
                }
            }
        }
    }
}

/// Protects the same with the slider at a half, at 5 % and at 1 %.
#[test]
fn a_pause_with_a_low_slider_ends_upright_within_the_limits() {
    for (series, slider) in [(Series::Cb3, 0.5), (Series::ESeries, 0.5), (Series::Cb3, 0.05), (Series::ESeries, 0.05), (Series::Cb3, 0.01)]
    {
        for moment in [Moment::Moving, Moment::Tilted, Moment::Returning] {
            for joints in [&[][..], &[(1, 0.3)][..], &[(5, -0.4)][..]] {
                pause_jog_resume(series, moment, joints, true, slider);
            }
        }
    }
}

/// Protects the glass when the controller is gone (its connection was closed): from any moment the program comes upright, and stays so,
/// whatever the slider says and however the robot slows itself.
#[test]
fn without_the_controller_it_comes_upright_at_any_speed() {
    for series in BOTH {
        for moment in [Moment::Starting, Moment::Moving, Moment::Tilted, Moment::Holding, Moment::Reversing] {
            for (slider, own) in [(1.0, 1.0), (0.5, 1.0), (1.0, 0.4), (0.05, 1.0), (0.01, 1.0)] {
                if slider < 0.05 && (series == Series::ESeries || moment == Moment::Starting) {
                    continue; // these take minutes, and say no more than the others
                }
                let mut robot = at(moment, series);
                robot.machine.robot.set_speed_slider(slider);
                robot.machine.robot.set_own_scaling(own);
                let what = format!("{series:?}, {moment:?}, slider {slider}, own scaling {own}");
                let upright_s = assert_ends_upright(&mut robot, slider * own, &what);
                println!("{what}: upright after {upright_s:.1} s");
            }
        }
    }
}

/// Protects the glass from an arm that the safety configuration slows to 20, 30 or 45 degrees/s during a pour: the limits hold, nothing
/// runs away, and the program comes upright when it is told to.
#[test]
fn an_arm_with_a_speed_limit_comes_upright_within_the_limits() {
    for series in BOTH {
        for limit_deg_s in [20.0f64, 30.0, 45.0] {
            for told in [false, true] {
                let mut robot = Robot::ready(series);
                robot.machine.robot.servo.set_speed_limit(limit_deg_s.to_radians());
                robot.stream(1.2, &mut limiter(), |_| 90.0);
                let away_deg = robot.cycles.iter().fold(0.0f64, |m, c| m.max((c.command_deg - c.target_deg).abs()));
                assert!(away_deg < 16.0, "{series:?}, {limit_deg_s} deg/s: the command is {away_deg} deg from the arm");
                if told {
                    robot.send(Mode::Stop, 0.0);
                }
                let what = format!("{series:?}, {limit_deg_s} deg/s, told {told}");
                assert_ends_upright(&mut robot, limit_deg_s / 180.0, &what);
            }
        }
    }
}

/// Protects the glass from an arm that is slower than its controller says: the program notices by itself, turns back within the limits,
/// and does not run away from the joint on its way upright.
#[test]
fn an_arm_that_is_held_back_is_turned_back() {
    for series in BOTH {
        for held_deg_s in [5.0f64, 20.0, 30.0] {
            let mut robot = Robot::ready(series);
            robot.machine.robot.servo.hold_back(held_deg_s.to_radians());
            robot.stream(1.5, &mut limiter(), |_| 100.0);
            let what = format!("{series:?}, held back to {held_deg_s} deg/s");
            assert!(matches!(robot.state(), ProgramState::OffTrack | ProgramState::OffTrackEnded), "{what}: {:?}", robot.state());
            assert_ends_upright(&mut robot, 0.1, &what);
            let away_deg = robot.cycles.iter().fold(0.0f64, |m, c| m.max((c.command_deg - c.target_deg).abs()));
            assert!(away_deg < 16.0, "{what}: the command is {away_deg} deg from the arm");
            let farthest_deg = robot.cycles.iter().fold(0.0f64, |m, c| m.max(c.target_deg));
            assert!(farthest_deg < 20.0, "{what}: the joint went to {farthest_deg} deg");
        }
    }
}

/// Protects the glass from an arm that becomes slow when it is tilted: on the way upright the command waits for the joint, and the program
/// ends only when the joint is upright too.
#[test]
fn the_way_upright_waits_for_a_slow_arm() {
    for series in BOTH {
        for held_deg_s in [5.0f64, 15.0, 40.0] {
            for moment in [Moment::Tilted, Moment::Reversing] {
                let mut robot = at(moment, series);
                robot.machine.robot.servo.hold_back(held_deg_s.to_radians());
                let what = format!("{series:?}, {moment:?}, held back to {held_deg_s} deg/s");
                assert_ends_upright(&mut robot, 0.1, &what);
                let away_deg = robot.cycles.iter().fold(0.0f64, |m, c| m.max((c.command_deg - c.target_deg).abs()));
                assert!(away_deg < 20.0, "{what}: the command is {away_deg} deg from the arm");
            }
        }
    }
}

/// Protects the arm from a servo that is faster than the limit when the program begins anew: one that catches up after a hard start overshoots
/// the rate that it was told. In each cycle of such a motion the program is told to begin anew.
#[test]
fn a_program_that_begins_anew_is_never_faster_than_the_limit() {
    for series in BOTH {
        let mut fastest_deg_s = 0.0f64;
        for cycles in 0..(0.4 / 0.008) as usize {
            let mut robot = Robot::ready(series);
            robot.stream(0.25, &mut limiter(), |_| 110.0);
            robot.pass(cycles as f64 * 0.002);
            fastest_deg_s = fastest_deg_s.max(robot.machine.robot.servo.target_qd[5].to_degrees());
            robot.send(Mode::Abandon, 0.0);
            assert_ends_upright(&mut robot, 1.0, &format!("{series:?}, begun anew after {cycles} cycles"));
        }
        assert!(fastest_deg_s > 92.0, "{series:?}: the servo was never faster than a command: {fastest_deg_s}");
    }
}

/// Protects ordinary pours from a false alarm: the hardest motions within the limits, targets that come early, late or in pairs, and a
/// servo that lags by twice its lookahead are no reason to turn back.
#[test]
fn no_ordinary_motion_is_off_track() {
    for series in BOTH {
        for lookahead_s in [0.03, 0.05, 0.1, 0.2] {
            let mut robot = Robot::new(series, rt_controller::link::LinkOptions { lookahead_s, ..crate::options() }, 0.0);
            let mut limiter = limiter();
            for round in 0..40 {
                let to_deg = f64::from(round * 37 % 111);
                robot.stream(0.1 + f64::from(round % 9) * 0.1, &mut limiter, |_| to_deg);
                assert_eq!(robot.state(), ProgramState::Following, "{series:?}, lookahead {lookahead_s} s, round {round}");
                robot.pass(f64::from(round % 4) * 0.015);
            }
            assert!(STANCE_RAD[..5] == robot.machine.robot.servo.commanded_q[..5]);
        }
    }
}
