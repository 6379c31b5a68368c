//! A robot that is slower than the program, with the slider at 100 %: the pour is refused or ends upright with its reason, what was poured
//! stays within a bound, and it is never "done". With real processes; the tests wait and panic as tests do.

use std::net::Ipv4Addr;

use shared::control::{EndReason, Reply, Request};
use shared::gaussian_curve::Curve;
use simulator::ur::{Fault, Series};

use super::cell::{Cell, flow_ml_s};

/// The most that may be poured beyond the goal, ml: the flow of the fastest stream (25 ml/s) in the time in which a slow joint is found out and
/// the command is back where the joint is (0.5 s), and on its slower way upright from 75 degrees to 50, where the stream ends (2.5 s at 10
/// degrees/s, on average at half the flow).
const MOST_BEYOND_ML: f64 = 25.0 * (0.5 + 2.5 / 2.0);

/// Pours `goal_ml` after `before`, causes `then` at full flow, and gives the reason, what was poured (estimated and really), and the exit
/// code's meaning.
fn pour(cell: &mut Cell, goal_ml: f32, before: Option<Fault>, then: Option<Fault>) -> (EndReason, f64) {
    if let Some(fault) = before {
        cell.robot.inject(fault);
    }
    let poured_before = cell.poured_ml();
    let episode = cell.pour(goal_ml);
    if let Some(fault) = then {
        cell.until("at full flow", |c| (flow_ml_s(c.alpha().0) > 5.0).then_some(()));
        cell.robot.inject(fault);
    }
    let outcome = cell.outcome(episode);
    assert!(cell.alpha().0.abs() < 2.0, "upright when the result is given: {:?}\n{}", cell.alpha(), cell.log());
    let poured_ml = cell.poured_ml() - poured_before;
    println!("{outcome:?}, really {poured_ml:.1} ml");
    (outcome.reason, poured_ml)
}

/// Protects the cup from a robot whose safety configuration limits its speed, from the start or in the middle of a pour: no wrong amount is
/// "done".
#[test]
fn a_robot_slower_than_the_program_ends_the_pour() {
    let mut cell = Cell::new("slow", Ipv4Addr::new(127, 44, 8, 1), Series::Cb3);
    for limit_deg_s in [30.0, 20.0, 10.0] {
        let (reason, poured_ml) = pour(&mut cell, 75.0, Some(Fault::JointSpeedLimit(limit_deg_s)), None);
        assert_eq!(reason, EndReason::NotFollowed, "{limit_deg_s}\n{}", cell.log());
        assert!(poured_ml < 10.0, "found out before it flows: {poured_ml}");
        cell.robot.inject(Fault::JointSpeedLimit(180.0));
        cell.ready();
        let (reason, poured_ml) = pour(&mut cell, 75.0, None, Some(Fault::JointSpeedLimit(limit_deg_s)));
        assert_eq!(reason, EndReason::NotFollowed, "{limit_deg_s} at full flow\n{}", cell.log());
        assert!(poured_ml < 75.0 + MOST_BEYOND_ML, "{limit_deg_s}: {poured_ml}");
        cell.robot.inject(Fault::JointSpeedLimit(180.0));
        cell.ready();
    }
    let (reason, _) = pour(&mut cell, 30.0, None, None);
    assert_eq!(reason, EndReason::Done, "the next pour\n{}", cell.log());
}

/// Protects the dose: a robot that says that it slows itself is refused before anything moves, and ends a pour under way.
#[test]
fn a_robot_that_slows_itself_is_refused_by_name() {
    let mut cell = Cell::new("scaled", Ipv4Addr::new(127, 44, 8, 2), Series::ESeries);
    let (reason, poured_ml) = pour(&mut cell, 75.0, None, Some(Fault::TimeScaling(0.33)));
    assert_eq!(reason, EndReason::NotFollowed, "{}", cell.log());
    assert!(poured_ml < 75.0 + MOST_BEYOND_ML, "{poured_ml}");
    cell.robot.inject(Fault::TimeScaling(0.33));
    cell.until("slowed", |c| {
        (!matches!(c.client.as_ref()?.ask(&Request::Pour { goal_ml: 8.0, flows_by_deg: None }), Ok(Reply::Started { .. }))).then_some(())
    });
    cell.until("upright", |c| (c.alpha().0.abs() < 0.1).then_some(()));
    let (code, said) = cell.command(&["pour", "75"]);
    assert!(code == 5 && said.contains("slows itself to 33 % of its speed (speed_scaling)"), "{code} {said}");
    assert!(cell.alpha().0.abs() < 0.1, "nothing moved");
}

/// Protects the training: a curve that the robot did not follow does not end as done, so that nobody weighs it.
#[test]
fn a_curve_that_was_not_followed_is_no_episode() {
    let mut cell = Cell::new("slow-curve", Ipv4Addr::new(127, 44, 8, 3), Series::Cb3);
    cell.robot.inject(Fault::JointSpeedLimit(20.0));
    let curve = Curve { lambda_deg: 70.0, gamma_per_s2: 0.8, beta_s: 3.0 };
    let Ok(Reply::Started { episode }) = cell.client.as_ref().unwrap().ask(&Request::Record(curve)) else { panic!("{}", cell.log()) };
    assert_eq!(cell.outcome(episode).reason, EndReason::NotFollowed, "{}", cell.log());
    cell.robot.inject(Fault::JointSpeedLimit(180.0));
    cell.ready();
    let (code, said) = cell.command(&["record", "--lambda", "40", "--gamma", "0.8"]);
    assert!(code != 4, "followed: {code} {said}");
}
