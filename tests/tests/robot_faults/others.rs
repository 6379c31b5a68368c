//! Conditions that are nobody's fault in the cell: a robot that boots, local control, a foreign script, a safeguard, a cable that is pulled, and
//! a second controller. Like all of the matrix, with real processes; the tests wait and panic as tests do.
//!
//! A fieldbus (EtherNet/IP, PROFINET) acts on the link in two ways, and both stand in the matrix: it owns a register (`in_use`), and it stops
//! or pauses the program (`program_stop`, `program_pause`).

use std::net::Ipv4Addr;
use std::thread;
use std::time::Duration;

use shared::control::{EndReason, RobotLink};
use shared::messages::Phase;
use simulator::ur::{Fault, RobotMode, RuntimeState, Series};

use super::cell::{Cell, Moment};

fn address(last: u8) -> Ipv4Addr {
    Ipv4Addr::new(127, 44, 10, last)
}

/// Waits until the controller says `words` about its robot.
fn hindered(cell: &Cell, words: &str) {
    cell.until(words, |c| c.client.as_ref()?.status().ok()?.hindrance.contains(words).then_some(()));
}

/// Protects the morning's first start: a robot that is still off, then powered, is named and then taken by itself, without anybody asking.
#[test]
fn a_robot_that_boots_is_waited_for() {
    let mut cell = Cell::not_started("boots", address(1), Series::Cb3);
    cell.robot.inject(Fault::Boot);
    cell.robot.inject(Fault::Offline(3.0));
    cell.start_controller();
    hindered(&cell, "30004");
    hindered(&cell, EndReason::RobotNotRunning.words());
    cell.robot.inject(Fault::BrakeRelease);
    cell.until("running", |c| (c.robot.state()?.robot_mode == RobotMode::Running).then_some(()));
    cell.ready();
    let episode = cell.pour(8.0);
    assert_eq!(cell.outcome(episode).reason, EndReason::Done, "{}", cell.log());
}

/// Protects the operator of a robot in local control, which ignores programs without a word: the place on the pendant is named, and the robot is
/// taken when it is in remote control.
#[test]
fn local_control_is_named() {
    let mut cell = Cell::not_started("local", address(2), Series::ESeries);
    cell.robot.inject(Fault::LocalControl);
    cell.start_controller();
    hindered(&cell, "Remote Control");
    cell.robot.inject(Fault::RemoteControl);
    cell.ready();
}

/// Protects a foreign script that runs: it is not replaced, and when it has ended by itself, the robot is taken.
#[test]
fn a_foreign_script_is_waited_for() {
    let mut cell = Cell::not_started("foreign", address(3), Series::Cb3);
    cell.send_program("def other():\n  sleep(6.0)\nend\n");
    cell.until("playing", |c| (c.robot.state()?.runtime_state == RuntimeState::Playing).then_some(()));
    cell.start_controller();
    hindered(&cell, "a program is running");
    assert_eq!(cell.robot.state().unwrap().program, "other");
    cell.ready();
    assert_ne!(cell.robot.state().unwrap().program, "other");
}

/// Protects people at a door or light curtain: while it is open nothing moves and nothing is uploaded; when it is closed the program only comes
/// upright, and with the automatic reset the robot comes back by itself. The next pour waits for its order.
#[test]
fn a_safeguard_with_automatic_reset_comes_back_by_itself() {
    let mut cell = Cell::new("safeguard", address(4), Series::Cb3);
    for moment in [Moment::FullFlow, Moment::TiltingOut, Moment::Returning] {
        let episode = cell.reach(moment).unwrap();
        let connections = cell.status().robot_connections;
        cell.robot.inject(Fault::SafeguardOpen);
        let outcome = cell.outcome(episode);
        assert!(matches!(outcome.reason, EndReason::SafetyStop), "{outcome:?}\n{}", cell.log());
        cell.until("at rest", |c| (c.alpha().1.abs() < 0.1).then_some(()));
        let at_deg = cell.alpha().0;
        thread::sleep(Duration::from_millis(1500));
        assert!((cell.alpha().0 - at_deg).abs() < 0.1, "it moved while the safeguard was open\n{}", cell.log());
        assert_eq!((cell.status().robot, cell.status().robot_connections), (RobotLink::Connecting, connections), "{}", cell.log());
        cell.robot.inject(Fault::SafeguardClosed);
        cell.until("upright", |c| (c.alpha().0.abs() < 1.0 && c.alpha().1.abs() < 1.0).then_some(()));
        cell.ready();
    }
}

/// Protects the pour from a cable that is pulled and put back: half open, neither side hears the other. 0.05 s is nothing. After longer ones
/// the program has come upright by itself, and the robot comes back by itself.
#[test]
fn a_cable_that_is_pulled_ends_upright_and_comes_back() {
    let mut cell = Cell::new("cable", address(5), Series::Cb3);
    let episode = cell.reach(Moment::FullFlow).unwrap();
    cell.robot.inject(Fault::Stall(0.05));
    assert_eq!(cell.outcome(episode).reason, EndReason::Done, "{}", cell.log());
    for pulled_s in [0.5, 8.0] {
        let episode = cell.reach(Moment::FullFlow).unwrap();
        cell.robot.inject(Fault::Stall(pulled_s));
        assert_eq!(cell.outcome(episode).reason, EndReason::RobotLost, "{pulled_s} s\n{}", cell.log());
        cell.until("upright", |c| (c.alpha().0.abs() < 1.0 && c.alpha().1.abs() < 1.0).then_some(()));
        cell.ready();
    }
}

/// Protects a pour from a second cell that was given the same robot: it is told that the registers are in use, and the pour goes on.
#[test]
fn a_second_controller_at_the_same_robot_is_refused() {
    let cell = Cell::new("first", address(6), Series::Cb3);
    let episode = cell.reach(Moment::FullFlow).unwrap();
    let text = std::fs::read_to_string(cell.directory.path().join("cell.toml")).unwrap();
    let other = tempfile::tempdir().unwrap();
    let name = format!("fault-second-{}", std::process::id());
    let mut config: toml::Table = text.parse().unwrap();
    config["cell"]["name"] = name.clone().into();
    config["controller"]["weights"] = other.path().join("weights.bin").display().to_string().into();
    config["recording"]["directory"] = other.path().join("episodes").display().to_string().into();
    std::fs::write(other.path().join("cell.toml"), toml::to_string(&config).unwrap()).unwrap();
    let mut second = super::cell::start_controller(other.path());
    let said = cell.until("refused", |_| {
        std::fs::read_to_string(other.path().join("log")).ok().filter(|said| said.contains("in use by another RTDE client"))
    });
    assert_eq!(cell.outcome(episode).reason, EndReason::Done, "{said}\n{}", cell.log());
    assert_eq!(cell.status().phase, Phase::Idle);
    second.kill().unwrap();
    second.wait().unwrap();
    shared::ipc::remove_files(&name);
}
