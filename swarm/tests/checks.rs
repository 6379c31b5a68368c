//! The checks themselves, on ticks and cycles that are made up.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use rt_controller::core::{Robot, Settings};
use rt_controller::journal::{Tick, Times};
use shared::messages::{Phase, Telemetry};
use simulator::ur::{Fault, Machine, Series};
use swarm::check::{Checks, Injected};
use swarm::noticing::must_end;
use swarm::site::config;
use swarm::what::{EyeFault, What};

/// Index of the tilting joint of config/sim.toml.
const TILTING: usize = 5;

fn checks() -> Checks {
    Checks::new(Settings::new(&config().unwrap()), 0.008)
}

/// A machine whose tilting joint is at 0, as the swarm's robots begin.
fn machine() -> Machine {
    let right = std::f64::consts::FRAC_PI_2;
    Machine::new(Series::Cb3, Series::Cb3.default_version(), [0.0, -right, right, -right, -right, 0.0])
}

/// Pours on a machine that nothing hinders.
fn poured(checks: Checks, target_deg: f32, alpha_deg: f64) -> Vec<&'static str> {
    poured_on(&machine(), checks, target_deg, alpha_deg)
}

/// Pours from 10 s on for 2 s at one target, with the joint at `alpha_deg`. Gives what is violated.
fn poured_on(machine: &Machine, mut checks: Checks, target_deg: f32, alpha_deg: f64) -> Vec<&'static str> {
    for k in 0..60 {
        let at_s = 10.0 + f64::from(k) / 30.0;
        let phase = if k == 0 { Phase::Idle } else { Phase::Pouring };
        checks.cycle(machine, TILTING, alpha_deg, at_s);
        let times = Times { deadline_ns: 0, decided_at_ns: 0, written_at_ns: 0, done_ns: 0, margin_ns: 0 };
        let (robot, features) = (Robot::that_may_move(target_deg, 1), Default::default());
        let tick = Tick { now_ns: 1, features, robot, order: None, agent: None, target_deg: Some(target_deg), d_ml: 50.0, times };
        checks.tick(&tick, &Telemetry { phase: phase as u32, ..Telemetry::default() }, 0, at_s);
    }
    checks.violations.iter().map(|v| v.invariant).collect()
}

fn injected(what: What, (at_s, until_s): (f64, f64)) -> Checks {
    let mut checks = checks();
    checks.faults.push(Injected { what, at_s, until_s, phase: Phase::Idle });
    checks
}

/// Protects pours from what stood before them: a slider below 100 % ends one that begins under it, and none that begins after it was set right. What passes in
/// a moment, as a cut link, is over.
#[test]
fn what_stands_ends_a_pour_that_begins_under_it() {
    let slider = What::Robot(Fault::SpeedSlider(0.97));
    assert_eq!(poured(injected(slider.clone(), (5.0, 20.0)), 0.0, 0.0), ["noticed"]);
    assert!(poured(injected(slider, (5.0, 8.0)), 0.0, 0.0).is_empty());
    assert!(poured(injected(What::LinkCut, (5.0, 5.0)), 0.0, 0.0).is_empty());
}

/// Protects pours from a joint that is elsewhere, whatever keeps it there: half a second after it was last where it was commanded, they have ended.
#[test]
fn a_joint_that_is_elsewhere_ends_a_pour() {
    assert_eq!(poured(checks(), 30.0, 10.0), ["noticed"]);
    assert!(poured(checks(), 30.0, 27.0).is_empty());
}

/// Protects the promises of docs/ROBOT.md: any slider below 100 %, and measurements that are too old when they come.
#[test]
fn the_least_that_must_end_a_pour() {
    let slider = |share| must_end(&What::Robot(Fault::SpeedSlider(share))).is_some();
    assert!(slider(0.99) && slider(0.9) && !slider(0.998));
    let late = |ms| must_end(&What::Eye(EyeFault::Late(ms))).is_some();
    assert!(late(290) && !late(200));
}

/// Protects a container that a program leaves tilted: a stop of the program before it, long ago, is no excuse; one that came since is.
#[test]
fn an_old_stop_does_not_excuse_a_container_that_is_left_tilted() {
    let left = |stopped_s: f64| {
        let mut checks = injected(What::Robot(Fault::ProgramStop), (stopped_s, stopped_s));
        checks.program_started(6.0);
        (0..500).for_each(|k| checks.cycle(&machine(), TILTING, 40.0, 10.0 + 0.008 * f64::from(k)));
        checks.violations.iter().any(|v| v.invariant == "left-tilted")
    };
    assert!(left(5.0) && !left(9.0));
}

/// Protects pours from a robot that may not move: whatever keeps it from that, and however long ago it began, no pour goes on.
#[test]
fn an_arm_that_may_not_move_ends_a_pour() {
    let mut stopped = machine();
    stopped.set_safety_mode(simulator::ur::SafetyMode::Recovery);
    assert_eq!(poured_on(&stopped, checks(), 0.0, 0.0), ["noticed"]);
}
