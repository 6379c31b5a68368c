//! The robot link against a small scripted server on real sockets: connecting, every refusal, and the loop's side.
//!
//! Each test has its own loopback address, because the ports of a UR controller are fixed.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

mod handover;
mod server;

use std::io::{Read, Write};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::thread;
use std::time::Duration;

use rt_controller::link::{LinkError, Lost, Mode, ProgramState, Session, connect};
use shared::control::EndReason;
use shared::os::now_ns;

use server::{OUTPUT_TYPES, Robot, Seen, Server, data, packet, text};

/// Protects the connection: the requests come in the protocol's order, the program is this cell's, and the session starts with
/// the state of the program that was uploaded, not with what an old one left.
#[test]
fn connects_and_uploads_the_program() {
    let (session, seen) = Server::new(1, Robot::default()).meet();
    let (session, seen) = (session.unwrap(), seen.unwrap());
    assert_eq!(seen.requests, b"VvOIS");
    assert!(
        seen.outputs.starts_with(&125f64.to_be_bytes())
            && seen.outputs.ends_with(b",target_speed_fraction,robot_status_bits,speed_scaling,payload,payload_cog,script_control_line")
    );
    assert!(seen.program.starts_with("def decant_pour():\n"));
    assert_eq!(session.version(), [3, 15, 8, 106339]);
    let state = session.state();
    assert_eq!((state.program_state, state.runtime_state, state.timestamp_s), (ProgramState::Ready, 2, 100.04));
    assert!((state.alpha_deg - 0.01f32.to_degrees()).abs() < 1e-4);
}

/// Protects the dispatch by type: text and unknown packets before every answer, in pieces of a byte or in one, change nothing.
#[test]
fn connects_through_chatter_and_pieces() {
    for (last, piece) in [(2, 1), (3, 7), (4, usize::MAX)] {
        let chatter = [text("SafetySetup has not been confirmed yet"), packet(b'Z', &[1, 2]), text("")].concat();
        let (session, _seen) = Server::new(last, Robot { chatter, piece, ..Robot::default() }).meet();
        assert_eq!(session.unwrap().state().program_state, ProgramState::Ready);
    }
}

/// Protects the frequency: an e-Series is asked for 500 Hz, and gets a program for its cycle.
#[test]
fn an_e_series_gets_its_own_cycle() {
    // Its states follow each other faster than many a kernel can wait.
    let (session, seen) = Server::new(5, Robot { version: [5, 11, 0, 1], cycle_ms: 2, ..Robot::default() }).meet();
    let (_session, seen) = (session.unwrap(), seen.unwrap());
    assert!(seen.program.contains("\n  LENGTH = 30\n"));
    assert!(seen.outputs.starts_with(&500f64.to_be_bytes()));
}

/// Protects the operator: every refusal gives its own error, whose line says what to do.
#[test]
fn every_refusal_says_what_to_do() {
    let with = |name: &str, at: usize| {
        let mut types: Vec<_> = OUTPUT_TYPES.split(',').collect();
        types[at] = name;
        types.join(",")
    };
    let well = Robot::default;
    let cases: Vec<(Robot, &str)> = vec![
        (Robot { version_accepted: 0, ..well() }, "refuses RTDE protocol 2; update"),
        (Robot { version: [3, 8, 0, 0], ..well() }, "PolyScope 3.8, which has no registers 24 to 47; update"),
        (Robot { version: [5, 2, 0, 0], ..well() }, "PolyScope 5.2"),
        (Robot { outputs: (0, with("NOT_FOUND", 6)), ..well() }, "does not know the RTDE variable safety_status_bits; update"),
        (Robot { outputs: (1, with("INT32", 0)), ..well() }, "timestamp has type INT32 instead of DOUBLE"),
        (Robot { outputs: (1, "DOUBLE".into()), ..well() }, "unexpected bytes during the request for the output recipe"),
        (
            Robot { inputs: (0, "INT32,INT32,IN_USE".into()), ..well() },
            "input_double_register_24 is in use by another RTDE client or a fieldbus",
        ),
        (Robot { inputs: (0, "INT32,INT32,DOUBLE".into()), ..well() }, "unexpected bytes during the request for the input recipe"),
        (
            Robot { start_accepted: 0, chatter: text("no recipe"), ..well() },
            "refuses to start sending its state; the robot said: no recipe",
        ),
        (Robot { closes_at: Some(b'O'), ..well() }, "connection lost during the request for the output recipe"),
        (Robot { deaf_to: Some(b'v'), ..well() }, "no answer to the request for the controller's version within 2 s"),
        (Robot { chatter: vec![0, 2, 0], ..well() }, "is this the RTDE port of a UR controller?"),
        (Robot { safety_mode: 3, runtime_state: 4, ..well() }, "protective stop; find the cause, then release it"),
        (Robot { safety_mode: 7, robot_mode: 3, ..well() }, "emergency stop; release"),
        (Robot { robot_mode: 5, ..well() }, "not powered and released; switch it on"),
        (Robot { speed_fraction: 0.5, ..well() }, "the speed slider is below 100 %; set it to 100 %"),
        (Robot { runtime_state: 2, ..well() }, "a program is running; wait"),
        (Robot { runtime_state: 4, ..well() }, "a program is paused; resume it"),
        (Robot { status_bits: 5, ..well() }, "somebody has the robot in hand (the teach button is pressed); let go of it"),
        (Robot { base_rad_s: 0.05, ..well() }, "the base joint moves, and no program moves it"),
        (Robot { base_rad_s: -0.015, ..well() }, "the base joint moves, and no program moves it"),
        (Robot { runtime_state: 4, registers: (ProgramState::Unknown, 0, 0), control_line: 7, ..well() }, "a program is paused; resume it"),
        (Robot { runtime_state: 4, registers: (ProgramState::Unknown, 0, 0), status_bits: 3, ..well() }, "a program is paused; resume it"),
        (
            Robot { script_ports: &[], ..well() },
            "answers on its RTDE port, but none of its ports for programs does (30002: connection refused, 30001: connection refused, \
             30003: connection refused); switch on Secondary Client Interface under Settings > Security > Services",
        ),
        (Robot { joint_rad: 0.5, ..well() }, "28.6 degrees from its start angle, at most 2 are allowed; bring the container upright"),
        (
            Robot { joint_rad: -360f64.to_radians(), ..well() },
            "-360.0 degrees from its start angle, at most 2 are allowed; turn it back by a full turn",
        ),
        (Robot { joint_rad: f64::NAN, ..well() }, "degrees from its start angle"),
        (Robot { program: ProgramState::TooFar, ..well() }, "bring the container upright"),
        (Robot { starts: false, ..well() }, "the program did not start within 5 s; on an e-Series choose Remote Control"),
    ];
    // They run side by side, because some of them wait for what never comes.
    let tests = cases.into_iter().zip(20..).map(|((robot, words), last)| {
        thread::spawn(move || {
            let (session, _seen) = Server::new(last, robot).meet();
            let error = session.expect_err(words).to_string();
            assert!(error.contains(words), "{error:?} lacks {words:?}");
            assert!(!error.contains('\n'), "{error:?}");
        })
    });
    for test in tests.collect::<Vec<_>>() {
        test.join().unwrap();
    }
}

/// Protects the operator from a wrong address: if nobody is there, the error names address and port.
#[test]
fn nobody_there_is_named() {
    let options = Server::new(6, Robot::default()).options;
    let error = connect(&options).unwrap_err().to_string();
    assert!(error.contains("127.41.0.6:30004: connection refused; check robot.address"), "{error}");
}

fn connected(last: u8) -> (Session, Seen, Robot) {
    let robot = Robot { runtime_state: 1, ..Robot::default() };
    let (session, seen) = Server::new(last, robot.clone()).meet();
    (session.unwrap(), seen.unwrap(), Robot { runtime_state: 2, ..robot })
}

/// Polls until `done`, as ticks would.
fn poll_until(session: &mut Session, mut done: impl FnMut(&Result<(), Lost>, &Session) -> bool) -> Result<(), Lost> {
    for _ in 0..2000 {
        let polled = session.poll(now_ns()).map(|_| ());
        if done(&polled, session) || polled.is_err() {
            return polled;
        }
        thread::sleep(Duration::from_millis(1));
    }
    panic!("nothing came");
}

/// Protects the tick: of everything that arrived, in whatever pieces, the newest state counts; if nothing arrived, it stays.
#[test]
fn the_newest_state_counts() {
    let (mut session, mut seen, robot) = connected(7);
    assert_eq!(session.poll(now_ns()).unwrap().timestamp_s, 100.04);
    let mut bytes = Vec::new();
    for cycle in 0..50 {
        bytes.extend(data(&robot, 2.0 + 0.008 * f64::from(cycle), ProgramState::Following, cycle, 9));
        bytes.extend(text("a notice"));
    }
    let (most, rest) = bytes.split_at(bytes.len() - 30);
    seen.rtde.write_all(most).unwrap();
    poll_until(&mut session, |_, s| s.texts() == 49).unwrap();
    let before = *session.state();
    // The stream is cut 30 bytes before its end, which is within the last data packet.
    assert_eq!(before.sequence_echo, 48);
    assert_eq!(session.poll(now_ns()).unwrap(), &before, "nothing new");
    seen.rtde.write_all(rest).unwrap();
    poll_until(&mut session, |_, s| s.texts() == 50).unwrap();
    assert_eq!(session.state().sequence_echo, 49);
    assert!(session.state().received_at_ns > before.received_at_ns);
}

/// Protects the stalled-clock check: only an advancing clock moves `advanced_at_ns`, only a program that keeps up `answered_at_ns`.
#[test]
fn standing_clocks_and_unread_targets_are_noticed() {
    let (mut session, mut seen, robot) = connected(8);
    session.send(Mode::Stream, 0.0).unwrap();
    let mut echo_at = |session: &mut Session, timestamp_s: f64, echo: i32| {
        seen.rtde.write_all(&data(&robot, timestamp_s, ProgramState::Following, echo, 9)).unwrap();
        let before = session.state().received_at_ns;
        poll_until(session, |_, s| s.state().received_at_ns > before).unwrap();
        let state = *session.state();
        (state.advanced_at_ns == state.received_at_ns, state.answered_at_ns == state.received_at_ns)
    };
    assert_eq!(echo_at(&mut session, 200.0, 0), (true, true), "advanced; 0 is new");
    assert_eq!(echo_at(&mut session, 200.0, 0), (false, false), "stands still; target 1 unread");
    assert_eq!(echo_at(&mut session, 200.008, 1), (true, true), "target 1 read");
    assert_eq!(echo_at(&mut session, 200.008, 1), (false, true), "nothing unread");
    assert_eq!(echo_at(&mut session, 1.0, 1), (false, true), "a clock that jumps back does not advance");
}

/// Protects the operator from the wrong culprit: only if this controller was silent for the larger part of the program's patience is it its
/// fault that the program has given up; a period and a late tick are not, and after a second it is forgotten.
#[test]
fn only_our_own_silence_counts_as_ours() {
    let (mut session, _seen, _) = connected(40);
    let mut now = session.state().received_at_ns;
    let mut after = |ms: u64, send: bool| {
        now += ms * 1_000_000;
        let was_silent = session.poll(now).unwrap().was_silent;
        if send {
            session.send(Mode::Stream, 0.0).unwrap();
        }
        was_silent
    };
    assert!(!after(1500, true), "before the first target the program waits longer");
    assert!([33, 33, 60, 33].iter().all(|ms| !after(*ms, true)), "usual ticks and one that is late");
    assert!(after(90, true), "the tick after a silence");
    assert!((0..24).all(|_| after(33, true)), "it is remembered for as long as the program's answer takes");
    assert!(!(0..8).all(|_| after(33, true)), "forgotten after a second");
}

/// Protects people from news of the past: a link that holds back shows each target read, one after the other, but ever later. The time since
/// the oldest unread target was sent tells; a number of an old session does not count as read.
#[test]
fn old_news_are_noticed() {
    let (mut session, mut seen, robot) = connected(41);
    let start = session.state().received_at_ns;
    let ms = |ms: u64| start + ms * 1_000_000;
    for k in 1..=30 {
        session.poll(ms(33 * k)).unwrap();
        session.send(Mode::Stream, 0.0).unwrap();
    }
    let mut unread_since = |echo: i32, timestamp_s: f64| {
        seen.rtde.write_all(&data(&robot, timestamp_s, ProgramState::Following, echo, 9)).unwrap();
        for _ in 0..2000 {
            if session.poll(ms(1000)).unwrap().timestamp_s == timestamp_s {
                return session.state().unread_since_ns;
            }
            thread::sleep(Duration::from_millis(1));
        }
        panic!("nothing came");
    };
    assert_eq!(unread_since(30, 200.0), 0, "all is read");
    assert_eq!(unread_since(29, 200.008), ms(33 * 30));
    assert_eq!(unread_since(10, 200.016), ms(33 * 11), "a second old, though the program reads on");
    assert_eq!(unread_since(0, 200.024), ms(33));
    assert_eq!(unread_since(4711, 200.032), ms(33), "what an old session left there");
}

/// Protects the robot from half a target: only whole packets arrive, numbered from 1 and in the agreed recipe.
#[test]
fn targets_arrive_whole_and_numbered() {
    let (mut session, mut seen, _) = connected(9);
    assert_eq!(session.send(Mode::Stream, 90.0), Ok(1));
    assert_eq!(session.send(Mode::Stop, 0.0), Ok(2));
    assert_eq!(session.send(Mode::Stream, f32::NAN), Ok(3));
    let mut received = [0; 60];
    seen.rtde.read_exact(&mut received).unwrap();
    let parts = |packet: &[u8]| {
        let int = |at: usize| i32::from_be_bytes(packet[at..at + 4].try_into().unwrap());
        (packet[..4].to_vec(), int(4), int(8), f64::from_be_bytes(packet[12..20].try_into().unwrap()))
    };
    let head = vec![0, 20, b'U', 2];
    assert_eq!(parts(&received[..20]), (head.clone(), 1, 2, 90f64.to_radians()));
    assert_eq!(parts(&received[20..40]), (head.clone(), 2, 3, 0.0));
    let (_, number, mode, angle) = parts(&received[40..]);
    assert!((number, mode) == (3, 1) && (angle - 0.01).abs() < 1e-6, "not a number: hold where it is, not {angle} in mode {mode}");
}

/// Protects the cup when a session ends for any reason: the program is asked to come upright, even with states unread.
#[test]
fn a_dropped_session_asks_the_program_to_stop() {
    let (mut session, mut seen, robot) = connected(18);
    session.send(Mode::Stream, 30.0).unwrap();
    seen.rtde.write_all(&data(&robot, 2.0, ProgramState::Following, 1, 9)).unwrap();
    thread::sleep(Duration::from_millis(20));
    drop(session);
    let mut received = Vec::new();
    seen.rtde.read_to_end(&mut received).unwrap();
    assert_eq!(received.len(), 40);
    assert_eq!(received[20..32], [0, 20, b'U', 2, 0, 0, 0, 2, 0, 0, 0, 3]);
}

/// Protects the loop from a robot that is gone: FIN, RST and a broken protocol end the session, each with its own reason.
#[test]
fn a_lost_robot_ends_the_session() {
    let (mut session, seen, _) = connected(10);
    drop(seen);
    assert_eq!(poll_until(&mut session, |_, _| false), Err(Lost::Closed));

    let (mut session, seen, _) = connected(11);
    // Unread bytes at the close make the kernel send RST.
    session.send(Mode::Hold, 0.0).unwrap();
    thread::sleep(Duration::from_millis(20));
    drop(seen);
    assert_eq!(poll_until(&mut session, |_, _| false), Err(Lost::Broken));

    let (mut session, mut seen, robot) = connected(12);
    let mut short = data(&robot, 2.0, ProgramState::Following, 0, 9);
    short.truncate(100);
    short[1] = 100;
    seen.rtde.write_all(&short).unwrap();
    assert_eq!(poll_until(&mut session, |_, _| false), Err(Lost::Protocol));

    let (mut session, mut seen, _) = connected(13);
    seen.rtde.write_all(&[0, 1, b'U']).unwrap();
    assert_eq!(poll_until(&mut session, |_, _| false), Err(Lost::Protocol));
}

/// Protects the loop from a robot that does not read: a target that would have to wait ends the session, and `send` never blocks.
#[test]
fn a_robot_that_does_not_read_ends_the_session() {
    let (mut session, _seen, _) = connected(14);
    let lost = (0..10_000_000).find_map(|_| session.send(Mode::Hold, 0.0).err());
    assert_eq!(lost, Some(Lost::WouldBlock));
}

/// Protects the tick from a flood: one poll takes a bounded share of what waits, and later ones the rest.
#[test]
fn a_flood_does_not_keep_the_loop() {
    let (mut session, seen, robot) = connected(15);
    let sent = Arc::new(AtomicUsize::new(0));
    let flood = thread::spawn({
        let (sent, mut stream) = (sent.clone(), seen.rtde.try_clone().unwrap());
        move || {
            for echo in 1..=50_000 {
                stream.write_all(&data(&robot, 2.0, ProgramState::Following, echo, 9)).unwrap();
                sent.fetch_add(1, Ordering::Relaxed);
            }
        }
    });
    // This waits until the sockets' buffers are full.
    let mut before = usize::MAX;
    while sent.load(Ordering::Relaxed) != before {
        before = sent.load(Ordering::Relaxed);
        thread::sleep(Duration::from_millis(200));
    }
    let most = (16 << 16) / 192 + 1;
    assert!(before > 2 * most, "{before} packets wait, too few for this test");
    let taken = session.poll(now_ns()).unwrap().sequence_echo as usize;
    assert!((1..=most).contains(&taken), "{taken} of {before}");
    poll_until(&mut session, |_, s| s.state().sequence_echo == 50_000).unwrap();
    flood.join().unwrap();
}

/// Protects the loop from waiting: while nothing comes, polls come back at once.
#[test]
fn polling_does_not_wait() {
    let (mut session, seen, robot) = connected(17);
    let later = thread::spawn({
        let mut stream = seen.rtde.try_clone().unwrap();
        move || {
            thread::sleep(Duration::from_millis(500));
            stream.write_all(&data(&robot, 2.0, ProgramState::Following, 77, 9)).unwrap();
        }
    });
    let mut polls = 0;
    while session.poll(now_ns()).unwrap().sequence_echo != 77 {
        polls += 1;
    }
    assert!(polls > 1000, "{polls} polls in half a second: each one waited");
    later.join().unwrap();
}

/// Protects the operator: a safety stop during the upload is reported as that stop, and not as a program that did not start.
#[test]
fn a_stop_during_the_upload_is_named() {
    let server = Server::new(16, Robot::default());
    let options = server.options.clone();
    let served = thread::spawn(move || {
        let mut seen = Server { robot: Robot { starts: false, ..server.robot.clone() }, ..server }.serve().unwrap();
        let stopped = Robot { safety_mode: 6, robot_mode: 3, ..Robot::default() };
        seen.rtde.write_all(&data(&stopped, 3.0, ProgramState::Unknown, 0, 1)).unwrap();
        seen
    });
    let error = connect(&options).unwrap_err();
    assert_eq!(
        error,
        LinkError::MayNotMove {
            address: options.address,
            reason: EndReason::EmergencyStop,
            safety_mode: 6,
            unpowered: true,
            program_there: false
        }
    );
    drop(served.join());
}
