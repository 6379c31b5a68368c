//! People at the robot: freedrive, joints moved by hand or with the pendant, and what happens while there is no connection. In each case the
//! robot is left alone until its operator asks for it. Like all of the matrix, with real processes; the tests wait and panic as tests do.

use std::net::Ipv4Addr;
use std::thread;
use std::time::Duration;

use shared::config::Joint;
use shared::control::{EndReason, Reply, Request, RobotLink};
use shared::messages::Phase;
use simulator::ur::{Fault, SafetyMode, Series};

use super::cell::{Cell, Expected, Moment};
use super::matrix;

/// How long nothing may be taken: the controller tries a lost robot again after 1 s.
const PATIENCE: Duration = Duration::from_millis(2500);

/// A cell of its own, idle.
fn cell(name: &str, last: u8) -> Cell {
    Cell::new(name, Ipv4Addr::new(127, 44, 9, last), Series::Cb3)
}

/// Protects people who hold the arm: the teach button ends the program, so the pour ends where the joint then stands, as after Stop, and the robot
/// waits for its operator after the button was released and the container brought upright.
#[test]
fn freedrive() {
    let strike = |c: &mut Cell| c.robot.inject(Fault::Freedrive);
    let recover = |c: &mut Cell| {
        // As long as somebody holds it, asking does not help.
        let why = c.resume_in_vain();
        assert!(why.contains(EndReason::InHand.words()) && why.contains("let go of it"), "{why}");
        c.robot.inject(Fault::FreedriveEnd);
        c.jog_upright_if_tilted();
    };
    matrix("freedrive", 30, Expected::Stopped(EndReason::InHand), strike, recover);
}

/// Protects the operator from "aborted" of a container that runs out: an aborted pour that the teach button catches on its way upright stands
/// tilted, and says so; the volume is "at least".
#[test]
fn an_aborted_pour_that_a_hand_catches_says_so() {
    let mut cell = cell("caught", 38);
    let episode = cell.reach(Moment::FullFlow).unwrap();
    assert_eq!(cell.client.as_ref().unwrap().ask(&Request::Abort).unwrap(), Reply::Aborting);
    cell.until("on its way", |c| (c.alpha().1 < -20.0).then_some(()));
    cell.robot.inject(Fault::Freedrive);
    let outcome = cell.outcome(episode);
    assert!(cell.alpha().0 > 20.0, "it stands at {:.1} degrees", cell.alpha().0);
    assert_eq!((outcome.reason, outcome.unseen), (EndReason::InHand, true), "{}", cell.log());
    cell.robot.inject(Fault::FreedriveEnd);
    cell.jog_upright_if_tilted();
    cell.is_left_alone(PATIENCE);
    cell.resume();
    cell.ready();
}

/// Protects people after Stop at the pendant: while the base is moved by hand, and afterwards, the program is not uploaded. Asking while it
/// moves does not help; the next pour on the command line takes the robot back.
#[test]
fn a_robot_moved_by_hand_after_a_stop_is_left_alone() {
    let cell = cell("by-hand", 31);
    cell.robot.inject(Fault::ProgramStop);
    cell.until("waiting", |c| (c.status().robot == RobotLink::WaitsForOperator).then_some(()));
    cell.robot.inject(Fault::Freedrive);
    cell.robot.inject(Fault::HandMove(Joint::Base, 40.0));
    cell.is_left_alone(Duration::from_millis(500));
    assert!(cell.status().hindrance.contains(EndReason::ProgramStopped.words()), "{}", cell.log());
    cell.robot.inject(Fault::FreedriveEnd);
    cell.robot.inject(Fault::Jog(Joint::Shoulder, 30.0));
    let why = cell.resume_in_vain();
    assert!(why.contains("joint moves, and no program moves it"), "{why}");
    cell.until("at rest", |c| c.robot.joints().actual_qd.iter().all(|v| v.abs() < 1e-3).then_some(()));
    cell.is_left_alone(PATIENCE);
    let (code, said) = cell.command(&["pour", "8"]);
    assert_eq!(code, 0, "{said}\n{}", cell.log());
    assert!(said.contains("taking the robot back, because you ask for it") && said.contains("done"), "{said}");
    let (code, said) = cell.command(&["resume"]);
    assert_eq!((code, said.trim()), (0, "the robot is connected"));
}

/// Protects people after an emergency stop: releasing the brakes is not asking for the robot; `rt-controller resume` is.
#[test]
fn a_robot_whose_brakes_were_released_is_left_alone() {
    let cell = cell("brakes", 32);
    cell.robot.inject(Fault::EmergencyStop);
    cell.robot.inject(Fault::EmergencyRelease);
    cell.until("stopped", |c| (c.status().phase == Phase::NoRobot).then_some(()));
    let (code, said) = cell.command(&["resume"]);
    assert!(code == 5 && said.contains("the robot is not powered and released"), "{code} {said}");
    cell.robot.inject(Fault::BrakeRelease);
    cell.until("running", |c| (c.robot.state()?.robot_mode == simulator::ur::RobotMode::Running).then_some(()));
    cell.is_left_alone(PATIENCE);
    assert_eq!(cell.command(&["resume"]), (0, "the robot is connected\n".into()), "{}", cell.log());
}

/// Protects whoever releases the brakes: a robot that had its emergency stop pressed, or whose safety system stopped it, while the link was lost is
/// not taken when its brakes are released or the stop is cleared, but when its operator asks. A closed safeguard is taken by itself.
#[test]
fn after_a_lost_link_a_robot_that_was_stopped_is_left_alone() {
    let mut cell = cell("unpowered", 39);
    let running = |c: &Cell| (c.robot.state()?.robot_mode == simulator::ur::RobotMode::Running).then_some(());
    let lose = |cell: &Cell, meanwhile: &[Fault]| {
        cell.robot.inject(Fault::Offline(3.0));
        cell.until("lost", |c| (c.status().phase == Phase::NoRobot).then_some(()));
        cell.until("ended", |c| (c.robot.state()?.runtime_state == simulator::ur::RuntimeState::Stopped).then_some(()));
        meanwhile.iter().for_each(|fault| cell.robot.inject(fault.clone()));
    };
    let named = |cell: &Cell, words: &str| {
        cell.until(words, |c| c.status().hindrance.contains(words).then_some(()));
    };
    lose(&cell, &[Fault::EmergencyStop, Fault::EmergencyRelease]);
    named(&cell, EndReason::RobotNotRunning.words());
    cell.robot.inject(Fault::BrakeRelease);
    cell.until("running", running);
    cell.is_left_alone(PATIENCE);
    cell.resume();
    cell.ready();
    for mode in [SafetyMode::Recovery, SafetyMode::Violation, SafetyMode::Fault] {
        lose(&cell, &[Fault::SafetyMode(mode)]);
        named(&cell, EndReason::SafetyStop.words());
        cell.robot.inject(Fault::SafetyMode(SafetyMode::Normal));
        cell.robot.inject(Fault::BrakeRelease);
        cell.until("running", running);
        cell.is_left_alone(PATIENCE);
        cell.resume();
        cell.ready();
    }
    lose(&cell, &[Fault::SafeguardOpen]);
    named(&cell, EndReason::SafetyStop.words());
    cell.robot.inject(Fault::SafeguardClosed);
    cell.ready();
    // Reduced limits stop nothing.
    cell.robot.inject(Fault::SafetyMode(SafetyMode::Reduced));
    assert_eq!(cell.outcome(cell.pour(8.0)).reason, EndReason::Done, "{}", cell.log());
}

/// Protects people while nobody sees them: after a lost link the robot is taken back by itself if the program came upright and ended by
/// itself, but not if somebody moved the base meanwhile, or stopped or paused the program on its way.
#[test]
fn after_a_lost_link_only_an_untouched_robot_is_taken_back() {
    let mut cell = cell("unseen", 33);
    let lose = |cell: &Cell, moment, meanwhile: &dyn Fn(&Cell)| {
        cell.reach(moment);
        cell.robot.inject(Fault::Offline(2.5));
        cell.until("lost", |c| (c.status().phase == Phase::NoRobot).then_some(()));
        meanwhile(cell);
    };
    lose(&cell, Moment::FullFlow, &|_| {});
    cell.ready();

    lose(&cell, Moment::FullFlow, &|c| {
        c.until("ended", |c| (c.robot.state()?.runtime_state == simulator::ur::RuntimeState::Stopped).then_some(()));
        c.robot.inject(Fault::Jog(Joint::Base, 5.0));
    });
    cell.is_left_alone(PATIENCE);
    assert!(cell.status().hindrance.contains("the base joint"), "{}", cell.log());
    cell.resume();
    cell.ready();

    for fault in [Fault::ProgramStop, Fault::ProgramPause] {
        lose(&cell, Moment::FullFlow, &|c| {
            c.until("on its way", |c| (c.alpha().1 < -20.0).then_some(()));
            c.robot.inject(fault.clone());
        });
        cell.is_left_alone(PATIENCE);
        if fault == Fault::ProgramPause {
            let why = cell.resume_in_vain();
            assert!(why.contains("a program is paused"), "{why}");
            cell.robot.inject(Fault::ProgramResume);
            cell.until("upright", |c| (c.alpha().0.abs() < 1.0).then_some(()));
            cell.is_left_alone(PATIENCE);
        }
        cell.jog_upright_if_tilted();
        cell.resume();
        cell.ready();
    }
}

/// Protects the foreign program: whoever replaces ours has taken the robot, and keeps it.
#[test]
fn a_replaced_program_is_not_replaced_in_turn() {
    let cell = cell("replaced", 34);
    cell.send_program("def other():\n  sleep(1.0)\nend\n");
    cell.is_left_alone(PATIENCE);
    assert_eq!(cell.command(&["resume"]).0, 0, "{}", cell.log());
}

/// Protects a robot that was just booted: it says "paused", and gets the program all the same. A program that a person has paused stays.
#[test]
fn a_booted_robot_gets_the_program_and_a_paused_program_stays() {
    let mut cell = cell("booted", 35);
    cell.stop_controller();
    cell.robot.inject(Fault::Boot);
    cell.robot.inject(Fault::BrakeRelease);
    cell.until("running", |c| (c.robot.state()?.robot_mode == simulator::ur::RobotMode::Running).then_some(()));
    assert_eq!(cell.robot.state().unwrap().runtime_state, simulator::ur::RuntimeState::Paused);
    cell.start_controller();
    cell.ready();

    cell.stop_controller();
    cell.until("ended", |c| (c.robot.state()?.runtime_state == simulator::ur::RuntimeState::Stopped).then_some(()));
    cell.send_program("def other():\n  while True:\n    sync()\n  end\nend\n");
    cell.until("playing", |c| (c.robot.state()?.runtime_state == simulator::ur::RuntimeState::Playing).then_some(()));
    cell.robot.inject(Fault::ProgramPause);
    cell.start_controller();
    cell.is_left_alone(PATIENCE);
    assert!(cell.status().hindrance.contains("a program is paused"), "{}", cell.log());
    assert_eq!(cell.robot.state().unwrap().program, "other");
    thread::sleep(Duration::from_millis(100));
    cell.robot.inject(Fault::ProgramStop);
    assert_eq!(cell.command(&["resume"]).0, 0, "{}", cell.log());
}

/// Protects the operator of a robot with services switched off: any of the three ports for programs will do, and if none is open the line names
/// the service and the place in the menu; also for RTDE itself.
#[test]
fn a_service_that_is_switched_off_is_named() {
    let mut cell = cell("services", 36);
    let menu = "Settings > Security > Services";
    for closed in [&[30_002, 30_001][..], &[30_003, 30_001], &[30_003, 30_002]] {
        closed.iter().for_each(|port| cell.robot.inject(Fault::ClosePort(*port)));
        cell.robot.inject(Fault::Fin);
        cell.until("lost", |c| (c.status().phase == Phase::NoRobot).then_some(()));
        cell.ready();
        cell.robot.inject(Fault::Clear);
    }
    let cases = [(&[30_001, 30_002, 30_003][..], "switch on Secondary Client Interface"), (&[30_004], "Real-Time Data Exchange (RTDE)")];
    for (closed, words) in cases {
        closed.iter().for_each(|port| cell.robot.inject(Fault::ClosePort(*port)));
        cell.robot.inject(Fault::Fin);
        let seen = |c: &Cell| Some(c.status().hindrance).filter(|h| h.contains(words) && h.contains(menu));
        cell.until(words, seen);
        assert_eq!(cell.status().robot, RobotLink::Connecting);
        cell.robot.inject(Fault::Clear);
        cell.ready();
    }
}

/// Protects the operator from a robot that was told another load: it is said on the terminal and in `status`.
#[test]
fn a_payload_that_holds_no_vessel_is_said() {
    let mut cell = cell("payload", 37);
    assert_eq!(cell.status().robot_warning, "");
    let words = "the robot's payload is set to 0.00 kg, which cannot hold a vessel";
    let told = |cell: &mut Cell, kg: f64| {
        cell.robot.inject(Fault::Payload(kg));
        cell.robot.inject(Fault::Fin);
        cell.until("lost", |c| (c.status().phase == Phase::NoRobot).then_some(()));
        cell.ready();
    };
    told(&mut cell, 0.0);
    assert!(cell.status().robot_warning.contains(words) && cell.said().contains(words), "{}", cell.log());
    assert!(cell.command(&["status"]).1.contains(words));
    told(&mut cell, 0.9);
    assert_eq!(cell.status().robot_warning, "");
}
