//! Which robots get the program: those with few services or few variables, those that were never started, and those that a person has, or had,
//! in hand. The tests run against the scripted server and panic as tests do.

use std::io::ErrorKind;
use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering::Relaxed};
use std::time::Duration;

use rt_controller::link::hands::{Before, Handover, after_session};
use rt_controller::link::network::{Network, System, Transport};
use rt_controller::link::{LinkError, ProgramState, RobotState};

use shared::control::EndReason;

use super::server::{Robot, Server};

/// Protects robots on which services are switched off: any one of the three ports for programs is enough.
#[test]
fn any_script_port_is_enough() {
    for (last, script_ports) in [(60, &[30001][..]), (61, &[30002]), (62, &[30003]), (63, &[30003, 30002])] {
        let (session, seen) = Server::new(last, Robot { script_ports, ..Robot::default() }).meet();
        assert_eq!(session.unwrap().state().program_state, ProgramState::Ready, "{script_ports:?}");
        assert!(seen.unwrap().program.starts_with("def decant_pour():\n"), "{script_ports:?}");
    }
}

/// A network on which one port does not answer for a while, in which somebody starts a program on the robot.
struct SlowPort {
    port: u16,
    other_plays: Arc<AtomicBool>,
}

impl Network for SlowPort {
    fn now_ns(&self) -> u64 {
        System.now_ns()
    }

    fn sleep(&self, time: Duration) {
        System.sleep(time);
    }

    fn open(&self, at: SocketAddr, within: Duration) -> std::io::Result<Box<dyn Transport>> {
        if at.port() != self.port {
            return System.open(at, within);
        }
        self.other_plays.store(true, Relaxed);
        System.sleep(Duration::from_millis(100));
        Err(ErrorKind::TimedOut.into())
    }

    fn read(&self, from: &mut dyn Transport, buffer: &mut [u8], within: Duration) -> std::io::Result<usize> {
        System.read(from, buffer, within)
    }
}

/// Protects another's program that is started while a port for programs does not answer: the robot is looked at after that, and nothing is uploaded.
#[test]
fn a_program_that_starts_while_a_port_is_tried_is_not_replaced() {
    let robot = Robot { script_ports: &[30001], ..Robot::default() };
    let network = SlowPort { port: 30002, other_plays: robot.other_plays.clone() };
    let (session, seen) = Server::new(140, robot).meet_over(&network, &Before::default());
    assert!(matches!(session, Err(LinkError::ProgramRunning { .. })), "{session:?}");
    assert!(seen.is_none(), "something was uploaded");
}

/// A network on which this process stands still for five seconds while it looks whether the robot moves, and somebody starts a program on the robot meanwhile.
struct Paused {
    other_plays: Arc<AtomicBool>,
    reads: AtomicU32,
    stood_ns: AtomicU64,
}

/// The read before which it stands still: among those of the robot's state.
const PAUSED_AT: u32 = 30;

impl Network for Paused {
    fn now_ns(&self) -> u64 {
        System.now_ns() + self.stood_ns.load(Relaxed)
    }

    fn sleep(&self, time: Duration) {
        System.sleep(time);
    }

    fn open(&self, at: SocketAddr, within: Duration) -> std::io::Result<Box<dyn Transport>> {
        System.open(at, within)
    }

    fn read(&self, from: &mut dyn Transport, buffer: &mut [u8], within: Duration) -> std::io::Result<usize> {
        if self.reads.fetch_add(1, Relaxed) == PAUSED_AT {
            // States from before that program wait first, and then those of it.
            System.sleep(Duration::from_millis(100));
            self.other_plays.store(true, Relaxed);
            System.sleep(Duration::from_millis(100));
            self.stood_ns.store(5_000_000_000, Relaxed);
        }
        System.read(from, buffer, within)
    }
}

/// Protects another's program from old news: where this process stood still while it looked at the robot, it looks at what the robot does now, and not at the
/// states that have waited for it.
#[test]
fn a_program_that_starts_while_we_stand_still_is_not_replaced() {
    let robot = Robot::default();
    let network = Paused { other_plays: robot.other_plays.clone(), reads: AtomicU32::new(0), stood_ns: AtomicU64::new(0) };
    let (session, seen) = Server::new(144, robot).meet_over(&network, &Before::default());
    assert!(network.reads.load(Relaxed) > PAUSED_AT, "it did stand still");
    assert!(matches!(session, Err(LinkError::ProgramRunning { .. })), "{session:?}");
    assert!(seen.is_none(), "something was uploaded");
}

/// Protects what the robot does now from a link that stands still while it is looked at: silence is no rest, and nothing is uploaded.
#[test]
fn a_robot_that_falls_silent_does_not_stand_still() {
    let (session, seen) = Server::new(145, Robot { cycles: 10, ..Robot::default() }).meet();
    assert!(matches!(session, Err(LinkError::NoAnswer { .. })), "{session:?}");
    assert!(seen.is_none(), "something was uploaded");
}

/// Protects a robot whose program started too late for its session, and ended by itself without having moved anything: it is taken again by itself,
/// but for one that somebody else uploaded.
#[test]
fn a_program_of_ours_that_was_late_is_no_handover() {
    let last = RobotState { program_run: 9, joints_rad: [0.0, 0.0, 0.0, 0.0, 0.0, 1.2], ..RobotState::default() };
    for (number, uploaded, why) in
        [(141, Some(10), None), (142, Some(11), Some(Handover::Interrupted)), (143, None, Some(Handover::Interrupted))]
    {
        let before = Before { last: Some(last), uploaded, ..Before::default() };
        let late = Robot { registers: (ProgramState::Unused, 7, 10), ..Robot::default() };
        let (session, _) = Server::new(number, late).meet_after(&before);
        assert_eq!(session.err().as_ref().and_then(LinkError::handover), why, "{uploaded:?}");
    }
}

/// Protects old controllers: a robot that does not know what is only good to have is driven without it, and what it knows is read.
#[test]
fn a_robot_that_knows_less_is_driven() {
    let all: &[&str] = &["robot_status_bits", "speed_scaling", "payload", "payload_cog", "script_control_line"];
    for (last, unknown) in [(64, all), (65, &["payload", "script_control_line"][..]), (66, &["speed_scaling"])] {
        let (session, seen) = Server::new(last, Robot { unknown, ..Robot::default() }).meet();
        let (session, seen) = (session.unwrap(), seen.unwrap());
        assert_eq!(seen.requests, b"VvOOIS");
        let state = session.state();
        let knows = |name: &str| !unknown.contains(&name);
        assert_eq!(state.status_bits, knows("robot_status_bits").then_some(1));
        assert_eq!(state.speed_scaling, knows("speed_scaling").then_some(0.5));
        assert_eq!(state.payload_kg, knows("payload").then_some(1.2));
        assert_eq!(state.payload_cog_m, knows("payload_cog").then_some([0.0, 0.01, 0.1]));
        assert_eq!(state.control_line, knows("script_control_line").then_some(0));
    }
}

/// Protects a booted robot from never getting a program: it says "paused" although nobody has paused anything. It gets the program, and once
/// more when the first one has only stopped it.
#[test]
fn a_robot_that_was_never_started_gets_the_program() {
    let booted = Robot { runtime_state: 4, registers: (ProgramState::Unknown, 0, 0), ..Robot::default() };
    let (session, _) = Server::new(67, booted.clone()).meet();
    assert_eq!(session.unwrap().state().program_state, ProgramState::Ready);
    let (session, _) = Server::new(68, Robot { stops_first: true, ..booted.clone() }).meet();
    assert_eq!(session.unwrap().state().program_state, ProgramState::Ready);
    // An arm that had no power in between has no paused program, whatever old registers say.
    let used = Robot { registers: (ProgramState::Following, 7, 9), ..booted };
    assert!(Server::new(69, used.clone()).meet().0.is_err());
    let unpowered = Before { unpowered: true, asked: true, looked: true, ..Before::default() };
    assert!(Server::new(70, used.clone()).meet_after(&unpowered).0.is_ok());
    // One that stands at a line came after that.
    let error = Server::new(77, Robot { control_line: 5, ..used }).meet_after(&unpowered).0.err();
    assert!(matches!(error, Some(LinkError::ProgramPaused { .. })), "{error:?}");
}

/// Protects people who have the robot: after a lost connection it is taken again only if our program there says that it has ended by itself
/// and no joint was moved; the operator's wish goes before.
#[test]
fn a_robot_that_was_handled_meanwhile_waits_for_its_operator() {
    let last = |base_rad: f64| RobotState { program_run: 9, joints_rad: [base_rad, 0.0, 0.0, 0.0, 0.0, 1.2], ..RobotState::default() };
    let cases = [
        (71, (ProgramState::TimedOut, 7, 9), 0.0, None),
        (72, (ProgramState::Stopped, 7, 9), 0.0, None),
        (73, (ProgramState::Returning, 7, 9), 0.0, Some(Handover::Interrupted)),
        (74, (ProgramState::TimedOut, 7, 8), 0.0, Some(Handover::Interrupted)),
        (75, (ProgramState::Unknown, 0, 0), 0.0, Some(Handover::Interrupted)),
        (76, (ProgramState::TimedOut, 7, 9), 0.02, Some(Handover::Displaced("base"))),
    ];
    for (number, registers, base_rad, why) in cases {
        let before = Before { last: Some(last(base_rad)), ..Before::default() };
        let (session, _) = Server::new(number, Robot { registers, ..Robot::default() }).meet_after(&before);
        assert_eq!(session.as_ref().err().and_then(LinkError::handover), why, "{registers:?}");
        assert_eq!(session.is_ok(), why.is_none(), "{registers:?}");
        let (session, _) =
            Server::new(number + 20, Robot { registers, ..Robot::default() }).meet_after(&Before { asked: true, looked: true, ..before });
        assert!(session.is_ok(), "{registers:?}");
    }
}

/// Protects people who stop our program after the operator has asked for the robot: a wish does not answer for a program that was seen to run since.
/// One that has ended by itself, or another's that left nothing in our registers, is no reason.
#[test]
fn a_stop_after_the_operator_asked_counts() {
    let cases = [
        (131, (ProgramState::Returning, 7, 9), Some(Handover::Interrupted)),
        (132, (ProgramState::Stopped, 7, 9), None),
        (133, (ProgramState::Unknown, 0, 0), None),
    ];
    for (number, registers, why) in cases {
        let before = Before { asked: true, ran: true, looked: true, ..Before::default() };
        let (session, _) = Server::new(number, Robot { registers, ..Robot::default() }).meet_after(&before);
        assert_eq!(session.as_ref().err().and_then(LinkError::handover), why, "{registers:?}");
        assert_eq!(session.is_ok(), why.is_none(), "{registers:?}");
    }
}

/// Protects people who stop our program while nobody watches it, because its session was lost or never came, or its controller had ended: a wish of
/// the same time may have come before, so it does not answer for that program. It answers for an older one, and for one that has ended by itself.
#[test]
fn a_stop_that_nobody_watched_counts() {
    let cases = [
        (181, (ProgramState::Ready, 7, 9), Some(9), Some(Handover::Interrupted)),
        (182, (ProgramState::Returning, 7, 9), None, Some(Handover::Interrupted)),
        (183, (ProgramState::Returning, 7, 9), Some(10), None),
        (184, (ProgramState::TimedOut, 7, 9), Some(9), None),
    ];
    for (number, registers, uploaded, why) in cases {
        let before = Before { asked: true, uploaded, ..Before::default() };
        let (session, _) = Server::new(number, Robot { registers, ..Robot::default() }).meet_after(&before);
        assert_eq!(session.as_ref().err().and_then(LinkError::handover), why, "{registers:?}");
        assert_eq!(session.is_ok(), why.is_none(), "{registers:?}");
    }
}

/// Protects a cell behind a slow link: a program that was last seen at work and answers no target was not seen to be stopped, so the controller may look
/// again; one that was seen to be stopped waits for its operator.
#[test]
fn a_program_that_only_does_not_answer_was_stopped_by_nobody() {
    let last = |runtime_state| RobotState { runtime_state, program_state: ProgramState::Ready, ..RobotState::default() };
    assert_eq!(after_session(EndReason::ProgramStopped, &last(2)), None);
    assert_eq!(after_session(EndReason::ProgramStopped, &last(1)), Some(Handover::Stopped(EndReason::ProgramStopped)));
}

/// Protects people from a controller that was not there when they pressed stop: a program that was at work when it went away was stopped by
/// somebody, and one that ended because the joint was held or moved shows a hand, so a controller that has just been started waits for its operator
/// too. One that ended because its controller did, or never ran, is no reason.
#[test]
fn a_new_controller_sees_that_a_program_was_stopped() {
    let cases = [
        (101, (ProgramState::Following, 7, 9), Some(Handover::Interrupted)),
        (102, (ProgramState::Returning, 7, 9), Some(Handover::Interrupted)),
        (103, (ProgramState::TimedOut, 7, 9), None),
        (104, (ProgramState::OffTrackEnded, 7, 9), Some(Handover::Stopped(EndReason::NotFollowed))),
        (105, (ProgramState::Unknown, 0, 0), None),
    ];
    for (number, registers, why) in cases {
        let (session, _) = Server::new(number, Robot { registers, ..Robot::default() }).meet();
        assert_eq!(session.as_ref().err().and_then(LinkError::handover), why, "{registers:?}");
        assert_eq!(session.is_ok(), why.is_none(), "{registers:?}");
        let before = Before { asked: true, looked: true, ..Before::default() };
        assert!(Server::new(number + 20, Robot { registers, ..Robot::default() }).meet_after(&before).0.is_ok(), "{registers:?}");
    }
}

/// Protects people who clear what the safety system has stopped (recovery, violation, fault): a robot that is found so waits for its operator, as one
/// that is stopped so in a session does. A safeguard that is open is waited for, and one whose arm has no power is, at the first start.
#[test]
fn a_robot_that_its_safety_system_stopped_waits_for_its_operator() {
    for (number, safety_mode) in [(140, 4), (141, 8), (142, 9)] {
        let error = Server::new(number, Robot { safety_mode, ..Robot::default() }).meet().0.unwrap_err();
        assert_eq!(error.handover(), Some(Handover::Stopped(EndReason::SafetyStop)), "{safety_mode}: {error}");
    }
    for (number, robot_mode, safety_mode) in [(143, 7, 5), (144, 3, 1)] {
        let error = Server::new(number, Robot { robot_mode, safety_mode, ..Robot::default() }).meet().0.unwrap_err();
        assert_eq!(error.handover(), None, "{safety_mode}: {error}");
    }
}

/// Protects people who stop our program after it stood paused behind an open safeguard: the look at the robot says that a program is there, so that
/// its stop counts even if it went on and was stopped between two looks. A booted robot, and an arm without power, have none.
#[test]
fn a_paused_program_behind_a_safeguard_is_there() {
    let paused = Robot { safety_mode: 5, runtime_state: 4, registers: (ProgramState::Following, 7, 9), ..Robot::default() };
    let booted = Robot { registers: (ProgramState::Unknown, 0, 0), ..paused.clone() };
    let unpowered = Robot { robot_mode: 3, ..paused.clone() };
    for (number, robot, there) in [(134, paused, true), (135, booted, false), (136, unpowered, false)] {
        let (session, _) = Server::new(number, robot).meet_after(&Before { asked: true, ..Before::default() });
        let error = session.err();
        assert!(matches!(error, Some(LinkError::MayNotMove { program_there, .. }) if program_there == there), "{number}: {error:?}");
    }
}
