//! The fault matrix of the robot link: each fault comes at rest, while tilting out, at full flow and while returning.
//!
//! The built `rt-controller run` runs as a process, with real shared memory, and the uploaded program runs on the simulated UR5 controller.
//! Only the liquid is a formula here: its flow grows with the tilt that the joint really has. Every test prints its rows of the table
//! (`cargo test -p tests --test robot_faults -- --show-output`); times are those of the robot's own clock.
//!
//! Each fault and moment is tried on a CB3 and on an e-Series. No command to servoj may exceed the limits. The container must be upright
//! and at rest within the bound, or at rest where the robot's own safety stops it. The result must name the reason, and after recovery the
//! next pour must work.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

mod cell;
mod motion;
mod others;
mod people;
mod slow;

use std::net::Ipv4Addr;
use std::thread;
use std::time::Duration;

use shared::control::EndReason;
use simulator::ur::{Fault, RobotMode, Series};

use cell::{Cell, Expected, Moment, start_controller};

/// Runs a cell for each robot and moment, all side by side, because a pour is mostly waiting.
fn matrix(name: &str, last: u8, expected: Expected, strike: impl Fn(&mut Cell) + Sync, recover: impl Fn(&mut Cell) + Sync) {
    let (strike, recover) = (&strike, &recover);
    let moments = [Moment::AtRest, Moment::TiltingOut, Moment::FullFlow, Moment::Returning];
    let cells = [Series::Cb3, Series::ESeries].into_iter().flat_map(|series| moments.map(|moment| (series, moment)));
    thread::scope(|scope| {
        for (k, (series, moment)) in (0..).zip(cells) {
            scope.spawn(move || {
                Cell::new(name, Ipv4Addr::new(127, 44, k, last), series).check(name, moment, expected, strike, recover);
            });
        }
    });
}

/// Checks a fault that passes, or from which the cell recovers without a person.
fn by_itself(name: &str, last: u8, expected: Expected, fault: Fault) {
    matrix(name, last, expected, |c| c.robot.inject(fault.clone()), |_| {});
}

/// Checks a fault that shows when the controller connects: the connection is closed along with it, and it lasts until `status` names it.
fn at_connecting(name: &str, last: u8, fault: Fault, words: &str) {
    let strike = |c: &mut Cell| {
        c.robot.inject(fault.clone());
        c.robot.inject(Fault::Fin);
    };
    let recover = |c: &mut Cell| {
        c.until(words, |c| c.client.as_ref()?.status().ok()?.hindrance.contains(words).then_some(()));
        c.robot.inject(Fault::Clear);
    };
    matrix(name, last, Expected::Upright(EndReason::RobotLost), strike, recover);
}

/// Protects the pour from a robot that closes the connection.
#[test]
fn fin() {
    by_itself("fin", 1, Expected::Upright(EndReason::RobotLost), Fault::Fin);
}

/// Protects the pour from a connection that is reset.
#[test]
fn reset() {
    by_itself("reset", 2, Expected::Upright(EndReason::RobotLost), Fault::Reset);
}

/// Protects the pour from a UR controller that is gone for a while.
#[test]
fn offline() {
    by_itself("offline", 3, Expected::Upright(EndReason::RobotLost), Fault::Offline(1.5));
}

/// Protects the pour from a half-open connection.
#[test]
fn stall() {
    by_itself("stall", 4, Expected::Upright(EndReason::RobotLost), Fault::Stall(1.5));
}

/// Protects the pour from a robot whose clock stands still while frames keep coming.
#[test]
fn freeze() {
    by_itself("freeze", 5, Expected::Upright(EndReason::RobotStalled), Fault::Freeze(1.5));
}

/// Protects the pour from a robot that talks but does not listen.
#[test]
fn slow_reader() {
    by_itself("slow-reader", 6, Expected::Upright(EndReason::RobotLost), Fault::SlowReader(1.5));
}

/// Protects the pour from a longer gap in the robot's state.
#[test]
fn skipped_outputs() {
    let strike = |c: &mut Cell| c.robot.inject(Fault::SkipOutputs((0.32 * c.series.rate_hz()) as u32));
    matrix("skip-outputs", 7, Expected::Upright(EndReason::RobotLost), strike, |_| {});
}

/// Protects the pour from being ended by what is harmless: a short gap.
#[test]
fn few_skipped_outputs() {
    by_itself("skip-few-outputs", 8, Expected::Nothing, Fault::SkipOutputs(4));
}

/// Protects the pour from being ended by what is harmless: a text message.
#[test]
fn text() {
    by_itself("text", 9, Expected::Nothing, Fault::Text("SafetySetup has not been confirmed yet".into()));
}

/// Protects the pour from being ended by what is harmless: frames in pieces.
#[test]
fn split() {
    by_itself("split", 10, Expected::Nothing, Fault::Split(1.5));
}

/// Protects the pour from being ended by what is harmless: frames four at a time.
#[test]
fn coalesced() {
    by_itself("coalesce", 11, Expected::Nothing, Fault::Coalesce(1.5));
}

/// Protects the pour from being ended by what is harmless: every state twice.
#[test]
fn twice() {
    by_itself("twice", 55, Expected::Nothing, Fault::Twice(1.5));
}

/// Protects the connection from a text message before the first answer.
#[test]
fn text_on_connect() {
    let strike = |c: &mut Cell| {
        c.robot.inject(Fault::TextOnConnect("SafetySetup has not been confirmed yet".into()));
        c.robot.inject(Fault::Fin);
    };
    matrix("text-on-connect", 12, Expected::Upright(EndReason::RobotLost), strike, |_| {});
}

/// Protects the connection from a robot that takes its time to start a program.
#[test]
fn late_start() {
    let strike = |c: &mut Cell| {
        c.robot.inject(Fault::LateStart(2.0));
        c.robot.inject(Fault::Fin);
    };
    matrix("late-start", 13, Expected::Upright(EndReason::RobotLost), strike, |_| {});
}

/// Protects the operator: a register that a fieldbus has taken is named, and when it is free again the controller is back.
#[test]
fn in_use() {
    let words = "input_int_register_24 is in use by another RTDE client or a fieldbus";
    at_connecting("in-use", 14, Fault::InUse("input_int_register_24".into()), words);
}

/// Protects the operator: an unknown variable is named.
#[test]
fn not_found() {
    at_connecting("not-found", 15, Fault::NotFound("safety_status_bits".into()), "does not know the RTDE variable safety_status_bits");
}

/// Protects the operator: a refused protocol version is named.
#[test]
fn version_refused() {
    at_connecting("refuse-version-2", 16, Fault::RefuseVersion2, "refuses RTDE protocol 2");
}

/// Protects people: a protective stop ends the pour; nothing moves until the operator lets the program go on, which then only
/// comes upright; and the robot is not taken back before the operator asks.
#[test]
fn protective_stop() {
    let recover = |c: &mut Cell| {
        c.until("unlocked", |c| {
            c.dashboard("unlock protective stop");
            thread::sleep(Duration::from_millis(100));
            (c.robot.state()?.safety_mode == simulator::ur::SafetyMode::Normal).then_some(())
        });
        c.dashboard("play");
    };
    let strike = |c: &mut Cell| c.robot.inject(Fault::ProtectiveStop);
    matrix("protective-stop", 17, Expected::Stopped(EndReason::ProtectiveStop), strike, recover);
}

/// Protects people: an emergency stop ends the pour; nothing moves until the operator has powered and moved the robot, and asks for it.
#[test]
fn emergency_stop() {
    let recover = |c: &mut Cell| {
        c.robot.inject(Fault::EmergencyRelease);
        c.dashboard("power on");
        c.until("its brakes released", |c| {
            c.dashboard("brake release");
            thread::sleep(Duration::from_millis(100));
            (c.robot.state()?.robot_mode == RobotMode::Running).then_some(())
        });
        c.jog_upright_if_tilted();
    };
    let strike = |c: &mut Cell| c.robot.inject(Fault::EmergencyStop);
    matrix("emergency-stop", 18, Expected::Stopped(EndReason::EmergencyStop), strike, recover);
}

/// Protects the operator's decision: a program stopped on the pendant stays stopped until the container is upright again and the operator
/// asks for the robot.
#[test]
fn program_stop() {
    let strike = |c: &mut Cell| c.robot.inject(Fault::ProgramStop);
    matrix("program-stop", 19, Expected::Stopped(EndReason::ProgramStopped), strike, Cell::jog_upright_if_tilted);
}

/// Protects the operator's decision: a paused program ends the pour; resumed, it only comes upright.
#[test]
fn program_pause() {
    let strike = |c: &mut Cell| c.robot.inject(Fault::ProgramPause);
    matrix("program-pause", 20, Expected::Stopped(EndReason::ProgramStopped), strike, |c| c.dashboard("play"));
}

/// Protects the dose and the program's patience: a robot that is slowed down at the pendant does not pour.
#[test]
fn speed_slider() {
    let strike = |c: &mut Cell| c.robot.inject(Fault::SpeedSlider(0.5));
    let recover = |c: &mut Cell| {
        let words = EndReason::SpeedReduced.words();
        c.until(words, |c| c.client.as_ref()?.status().ok()?.hindrance.contains(words).then_some(()));
        c.robot.inject(Fault::SpeedSlider(1.0));
    };
    matrix("speed-slider", 23, Expected::Slowed(EndReason::SpeedReduced, 0.5), strike, recover);
}

/// Protects people: a controller that dies in mid-pour leaves a robot that comes upright, and a new one takes over.
#[test]
fn controller_killed() {
    let strike = |c: &mut Cell| {
        c.process.kill().unwrap();
        c.process.wait().unwrap();
        c.client = None;
    };
    let recover = |c: &mut Cell| c.process = start_controller(c.directory.path());
    matrix("sigkill", 22, Expected::Orphaned, strike, recover);
}

/// Protects the pour from a controller that was stopped: the program comes upright, and the controller knows why.
#[test]
fn controller_stopped_for_a_while() {
    let strike = |c: &mut Cell| {
        c.signal(rustix::process::Signal::STOP);
        thread::sleep(Duration::from_millis(400));
        c.signal(rustix::process::Signal::CONT);
    };
    matrix("sigstop", 21, Expected::Upright(EndReason::ControllerOverrun), strike, |_| {});
}
