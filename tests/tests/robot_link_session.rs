//! The robot link over real sockets against the simulated controller: both generations, reconnecting, and latency.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::net::{IpAddr, Ipv4Addr};
use std::thread;
use std::time::Duration;

use rt_controller::link::{LinkError, LinkOptions, Mode, ProgramState, Session, connect, health};
use shared::limits::{Limiter, Limits};
use shared::os::now_ns;
use simulator::ur::{Controller, ControllerOptions, Fault, Series};

fn cell(last: u8, series: Series) -> (Controller, LinkOptions) {
    let address = IpAddr::V4(Ipv4Addr::new(127, 43, 0, last));
    let robot = Controller::start(ControllerOptions { series, ..ControllerOptions::new(address) }).unwrap();
    let options = tests::link_options(address);
    (robot, options)
}

/// Sends targets at 30 Hz, as the loop does, until the joint is at `alpha_deg`.
fn tilt_to(session: &mut Session, limiter: &mut Limiter, alpha_deg: f32) {
    for _ in 0..300 {
        let now = now_ns();
        session.poll(now).unwrap();
        session.send(Mode::Stream, limiter.step(alpha_deg)).unwrap();
        if (session.state().alpha_deg - alpha_deg).abs() < 0.1 {
            return;
        }
        thread::sleep(Duration::from_millis(33));
    }
    panic!("never there: {:?}", session.state());
}

fn limiter() -> Limiter {
    Limiter::new(Limits::default(), 1.0 / 30.0, 0.0)
}

/// Protects both generations: connect, tilt out, stop on command, upright, and connect again.
#[test]
fn both_generations_are_driven() {
    for (last, series) in [(1, Series::Cb3), (2, Series::ESeries)] {
        let (robot, options) = cell(last, series);
        for _ in 0..2 {
            let mut session = connect(&options).unwrap();
            assert_eq!(session.version()[0], if series == Series::Cb3 { 3 } else { 5 });
            tilt_to(&mut session, &mut limiter(), 25.0);
            assert!((robot.joints().actual_q[5].to_degrees() - 25.0).abs() < 1.0);
            assert_eq!(session.state().program_state, ProgramState::Following);
            session.send(Mode::Stop, 0.0).unwrap();
            while session.poll(now_ns()).unwrap().program_state != ProgramState::Stopped {
                thread::sleep(Duration::from_millis(5));
            }
            assert!(health::check(session.state(), now_ns(), 1_000_000_000).is_err());
            assert!(robot.joints().actual_q[5].to_degrees().abs() < 0.5);
        }
        let errors: Vec<_> = robot.take_log().into_iter().filter(|l| l.kind == simulator::ur::LogKind::ProgramError).collect();
        assert!(errors.is_empty(), "{errors:?}");
    }
}

/// Protects the way upright: a lost controller's program is not replaced while it still moves; then connecting works again.
#[test]
fn a_program_on_its_way_upright_is_left_alone() {
    let (robot, options) = cell(3, Series::Cb3);
    let mut session = connect(&options).unwrap();
    tilt_to(&mut session, &mut limiter(), 50.0);
    // This is how a killed process leaves it: nothing more is sent, and the socket is closed.
    robot.inject(Fault::Fin);
    assert_eq!(connect(&options).unwrap_err(), LinkError::ProgramRunning { address: options.address });
    let session = loop {
        match connect(&options) {
            Ok(session) => break session,
            Err(LinkError::ProgramRunning { .. }) => {}
            Err(e) => panic!("{e}"),
        }
        thread::sleep(Duration::from_millis(50));
    };
    assert!(robot.joints().actual_q[5].to_degrees().abs() < 0.5);
    assert_eq!(session.state().program_state, ProgramState::Ready);
}

/// Protects the operator of an e-Series: in local control the program is ignored, and the error says what to do.
#[test]
fn local_control_is_explained() {
    let (robot, options) = cell(4, Series::ESeries);
    robot.inject(Fault::LocalControl);
    let error = connect(&options).unwrap_err();
    assert_eq!(error, LinkError::NotStarted { address: options.address });
    assert!(error.to_string().contains("choose Remote Control"));
    robot.inject(Fault::RemoteControl);
    connect(&options).unwrap();
}

/// Protects a robot from two controllers: the second is told that the registers are in use.
#[test]
fn a_second_controller_is_refused() {
    let (_robot, options) = cell(5, Series::Cb3);
    let _first = connect(&options).unwrap();
    let second = connect(&options).unwrap_err();
    assert_eq!(second, LinkError::InUse { address: options.address, variable: "input_int_register_24".into() });
}

/// Protects the link from being slow unnoticed. It prints the times from a target's bytes being written until its number is read back, and
/// until the joint first moves.
#[test]
fn latency_is_measured() {
    for (last, series) in [(6, Series::Cb3), (7, Series::ESeries)] {
        let (_robot, options) = cell(last, series);
        let mut session = connect(&options).unwrap();
        let (mut echoes, mut motions) = (Vec::new(), Vec::new());
        let mut alpha = 0.0;
        for round in 0..60 {
            // The joint is at rest before each step of one degree, which is one tick's target.
            for _ in 0..12 {
                session.send(Mode::Stream, alpha).unwrap();
                thread::sleep(Duration::from_millis(33));
                session.poll(now_ns()).unwrap();
            }
            // The step must not keep pace with the control cycle.
            thread::sleep(Duration::from_micros(137 * (round % 60)));
            session.poll(now_ns()).unwrap();
            let before = session.state().alpha_deg;
            alpha = if alpha > 0.5 { 0.0 } else { 1.0 };
            let sent_at = now_ns();
            let number = session.send(Mode::Stream, alpha).unwrap();
            let (mut echo, mut motion) = (None, None);
            while echo.is_none() || motion.is_none() {
                let now = now_ns();
                let state = session.poll(now).unwrap();
                if state.sequence_echo == number {
                    echo.get_or_insert(now - sent_at);
                }
                if (state.alpha_deg - before).abs() > 0.02 {
                    motion.get_or_insert(now - sent_at);
                }
                // The program's patience is 100 ms.
                if now - sent_at > 80_000_000 {
                    break;
                }
                thread::sleep(Duration::from_micros(200));
            }
            echoes.extend(echo);
            motions.extend(motion);
        }
        let percentiles = |values: &mut Vec<u64>| {
            values.sort_unstable();
            let at =
                |p: usize| values.get((values.len() * p / 100).min(values.len().saturating_sub(1))).map_or(f64::NAN, |v| *v as f64 / 1e6);
            format!("p50 {:.1} ms, p90 {:.1} ms, largest {:.1} ms, n {}", at(50), at(90), at(100), values.len())
        };
        println!("{series:?}: target written -> its number read back: {}", percentiles(&mut echoes));
        println!("{series:?}: target written -> joint moved by 0.02 degrees: {}", percentiles(&mut motions));
        println!("{series:?}: published for a real UR: 35 ms to the first motion");
        // A step that takes longer than 80 ms is missing from the lists: a busy machine may lose a few, but a slow link would lose most.
        assert!(
            echoes.len() >= 50 && motions.len() >= 50,
            "of 60 steps {} were echoed and {} moved the joint",
            echoes.len(),
            motions.len()
        );
    }
}
