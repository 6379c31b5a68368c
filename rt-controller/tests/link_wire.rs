//! The pure parts of the robot link: packets, health, and the program's text. The tests open no socket.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use proptest::prelude::*;
use rt_controller::link::wire::{self, Inbox, OutputRecipe, Outputs};
use rt_controller::link::{LinkError, LinkOptions, ProgramState, RobotState, TiltJoint, health, program};
use shared::config::Joint;
use shared::control::EndReason;
use shared::limits::Limits;

fn bytes(hex: &str) -> Vec<u8> {
    let digits: Vec<u8> = hex.bytes().filter(|b| !b.is_ascii_whitespace()).collect();
    digits.chunks(2).map(|two| u8::from_str_radix(std::str::from_utf8(two).unwrap(), 16).unwrap()).collect()
}

fn all_packets(inbox: &mut Inbox) -> Vec<(u8, Vec<u8>)> {
    let mut packets = Vec::new();
    while let Some(packet) = inbox.next_packet().unwrap() {
        packets.push((packet.kind, packet.payload.to_vec()));
    }
    packets
}

fn give(inbox: &mut Inbox, bytes: &[u8]) {
    inbox.space()[..bytes.len()].copy_from_slice(bytes);
    inbox.filled(bytes.len());
}

/// Protects the reader from the way in which TCP cuts a stream: the same packets come out wherever it is cut, and uncut.
#[test]
fn packets_survive_every_cut() {
    // These answers were recorded from a CB3 3.15.8: version accepted, its version, an input recipe, start, and an empty text packet.
    let stream = bytes("00045601 001376000000030000000f0000000800019f63 000f4904494e5433322c494e543332 00045301 00064d000003");
    let mut whole = Inbox::new();
    give(&mut whole, &stream);
    let expected = all_packets(&mut whole);
    assert_eq!(expected.iter().map(|(kind, _)| *kind).collect::<Vec<_>>(), b"VvISM");
    assert_eq!(wire::controller_version(&expected[1].1), Some([3, 15, 8, 106339]));
    assert_eq!(wire::recipe(&expected[2].1), Some((4, "INT32,INT32")));
    for first in 0..=stream.len() {
        for second in first..=stream.len() {
            let mut inbox = Inbox::new();
            let mut packets = Vec::new();
            for piece in [&stream[..first], &stream[first..second], &stream[second..]] {
                give(&mut inbox, piece);
                packets.extend(all_packets(&mut inbox));
            }
            assert_eq!(packets, expected, "cut at {first} and {second}");
        }
    }
}

/// Protects the inbox from the largest packet: it fits, whatever waits before it, and there is always space.
#[test]
fn the_largest_packet_fits() {
    let mut inbox = Inbox::new();
    let mut largest = vec![0xff, 0xff, b'M'];
    largest.resize(65535, 7);
    let mut stream = bytes("00045601");
    stream.extend(&largest);
    stream.extend(bytes("00045300"));
    let mut packets = Vec::new();
    for piece in stream.chunks(50_000) {
        let mut rest = piece;
        while !rest.is_empty() {
            let n = inbox.space().len().min(rest.len());
            assert!(n > 0);
            give(&mut inbox, &rest[..n]);
            rest = &rest[n..];
            packets.extend(all_packets(&mut inbox));
        }
    }
    assert_eq!(packets.iter().map(|(_, payload)| payload.len()).collect::<Vec<_>>(), [1, 65532, 1]);
}

/// Protects the robot's input recipe: number, mode and angle lie where the recipe says.
#[test]
fn a_target_is_encoded_as_documented() {
    let packet = wire::encode_target(2, 258, 2, 1.5);
    assert_eq!(packet.to_vec(), bytes("0014 55 02 00000102 00000002 3ff8000000000000"));
    assert_eq!(wire::input_names(24).map(|(name, _)| name), ["input_int_register_24", "input_int_register_25", "input_double_register_24"]);
}

/// Protects the encoder's callers: what does not fit is refused, not cut.
#[test]
fn what_does_not_fit_is_not_encoded() {
    assert_eq!(wire::encode(b'V', &[&[0, 2]], &mut [0; 5]).unwrap(), bytes("0005560002"));
    assert_eq!(wire::encode(b'V', &[&[0, 2]], &mut [0; 4]), None);
    assert_eq!(wire::encode(b'V', &[&[0; 65533]], &mut vec![0; 70_000]), None);
}

fn tilt() -> TiltJoint {
    TiltJoint { joint: Joint::Wrist3, start_deg: 10.0, direction: -1.0 }
}

/// Protects every field of the state: each value in the package comes out in its own place.
#[test]
fn the_state_is_read_from_the_recipe() {
    let mut payload = vec![3u8];
    payload.extend(12.5f64.to_be_bytes());
    for vector in 0..3 {
        for joint in 0..6 {
            payload.extend((f64::from(vector) + f64::from(joint) / 10.0).to_be_bytes());
        }
    }
    payload.extend([7, 1].map(i32::to_be_bytes).concat());
    payload.extend([5, 2].map(u32::to_be_bytes).concat());
    payload.extend([2, 41, 99].map(i32::to_be_bytes).concat());
    payload.extend([0.25, 0.75].map(f64::to_be_bytes).concat());
    let needed_len = payload.len();
    payload.extend(4u32.to_be_bytes());
    payload.extend([0.5, 1.5, 0.01, 0.02, 0.03].map(f64::to_be_bytes).concat());
    payload.extend(77u32.to_be_bytes());
    let mut state = RobotState::default();
    let recipe = OutputRecipe::new(3, [true; 5]);
    Outputs::new_checked(&payload, recipe).unwrap().fill(&tilt(), &mut state);
    let alpha = |rad: f64| (10.0 - rad.to_degrees()) as f32;
    let expected = RobotState {
        timestamp_s: 12.5,
        alpha_deg: alpha(0.5),
        alpha_target_deg: alpha(1.5),
        alpha_rate_deg_s: -(2.5f64.to_degrees()) as f32,
        alpha_command_deg: alpha(0.25),
        robot_mode: 7,
        safety_mode: 1,
        safety_bits: 5,
        runtime_state: 2,
        program_state: ProgramState::Following,
        program_run: 99,
        sequence_echo: 41,
        speed_fraction: 0.75,
        joints_rad: [0.0, 0.1, 0.2, 0.3, 0.4, 0.5],
        joint_rates_rad_s: [2.0, 2.1, 2.2, 2.3, 2.4, 2.5],
        status_bits: Some(4),
        speed_scaling: Some(0.5),
        payload_kg: Some(1.5),
        payload_cog_m: Some([0.01, 0.02, 0.03]),
        control_line: Some(77),
        ..RobotState::default()
    };
    assert_eq!(state, expected);
    assert!(Outputs::new_checked(&payload, OutputRecipe::new(4, [true; 5])).is_none(), "another recipe");
    assert!(Outputs::new_checked(&payload[..payload.len() - 1], recipe).is_none(), "too short");
    // A robot that knows only the payload and the line: they follow the needed values at once.
    let fewer = [&payload[..needed_len], &2.5f64.to_be_bytes(), &5u32.to_be_bytes()].concat();
    let mut less = RobotState::default();
    Outputs::new_checked(&fewer, OutputRecipe::new(3, [false, false, true, false, true])).unwrap().fill(&tilt(), &mut less);
    let unknown = RobotState { status_bits: None, speed_scaling: None, payload_cog_m: None, ..expected };
    assert_eq!(less, RobotState { payload_kg: Some(2.5), control_line: Some(5), ..unknown });
    payload.push(0);
    assert!(Outputs::new_checked(&payload, recipe).is_none(), "too long");
}

/// Protects the geometry: start and direction of the tilting joint are applied once, both ways.
#[test]
fn alpha_and_joint_angle_are_inverse() {
    assert_eq!(tilt().joint_rad(30.0), (-20.0f64).to_radians());
    assert!((tilt().alpha_deg(tilt().joint_rad(73.5)) - 73.5).abs() < 1e-5);
}

const NOW: u64 = 10_000_000_000;
const LOST: u64 = 100_000_000;

fn well() -> RobotState {
    RobotState {
        robot_mode: 7,
        safety_mode: 1,
        safety_bits: 1,
        runtime_state: 2,
        speed_fraction: 1.0,
        program_state: ProgramState::Following,
        received_at_ns: NOW,
        advanced_at_ns: NOW,
        answered_at_ns: NOW,
        ..RobotState::default()
    }
}

/// Protects the arm: each hindrance is noticed, and is named rightly even when several hold at once.
#[test]
fn every_hindrance_has_its_reason() {
    use EndReason::*;
    type Change = fn(&mut RobotState, u64);
    let long_ago = NOW - LOST - 1;
    let cases: [(&str, EndReason, Change); 24] = [
        ("silence", RobotLost, |s, ago| s.received_at_ns = ago),
        ("silence, whatever it last said", RobotLost, |s, ago| (s.received_at_ns, s.safety_mode) = (ago, 3)),
        ("clock stands still", RobotStalled, |s, ago| s.advanced_at_ns = ago),
        ("protective stop pauses the program", ProtectiveStop, |s, _| (s.safety_mode, s.runtime_state) = (3, 4)),
        ("protective stop in the bits only", ProtectiveStop, |s, _| s.safety_bits = 1 << 2),
        ("emergency stop switches off", EmergencyStop, |s, _| (s.safety_mode, s.robot_mode, s.runtime_state) = (7, 3, 1)),
        ("system emergency stop", EmergencyStop, |s, _| s.safety_mode = 6),
        ("emergency stop in the bits only", EmergencyStop, |s, _| s.safety_bits = 1 << 7),
        ("safeguard stop", SafetyStop, |s, _| s.safety_mode = 5),
        ("unknown safety mode", SafetyStop, |s, _| s.safety_mode = 0),
        ("teach button", InHand, |s, _| s.status_bits = Some(1 | 2 | 4)),
        ("joint elsewhere", NotFollowed, |s, _| s.program_state = ProgramState::OffTrack),
        ("joint was elsewhere", NotFollowed, |s, _| (s.program_state, s.runtime_state) = (ProgramState::OffTrackEnded, 1)),
        ("brakes on", RobotNotRunning, |s, _| (s.robot_mode, s.runtime_state) = (5, 1)),
        ("speed slider", SpeedReduced, |s, _| s.speed_fraction = 0.99),
        ("speed slider unknown", SpeedReduced, |s, _| s.speed_fraction = f64::NAN),
        ("program paused", ProgramStopped, |s, _| s.runtime_state = 4),
        ("program ended on command", ProgramStopped, |s, _| s.program_state = ProgramState::Stopped),
        ("program hangs", ProgramStopped, |s, ago| s.answered_at_ns = ago),
        ("program reads on, but what passes over the link is old", RobotLost, |s, ago| s.unread_since_ns = ago),
        ("program returns because we were silent", ControllerOverrun, |s, _| {
            (s.program_state, s.was_silent) = (ProgramState::Returning, true);
        }),
        ("program ended because we were silent", ControllerOverrun, |s, _| {
            (s.program_state, s.runtime_state, s.was_silent) = (ProgramState::TimedOut, 1, true);
        }),
        ("program returns, and has read late all that we sent in time", RobotLost, |s, _| s.program_state = ProgramState::Returning),
        ("program returns because targets do not arrive", RobotLost, |s, _| {
            (s.program_state, s.sequence_sent) = (ProgramState::Returning, s.sequence_echo + 3);
        }),
    ];
    assert_eq!(health::check(&well(), NOW, LOST), Ok(()));
    assert_eq!(health::check(&RobotState { safety_mode: 2, ..well() }, NOW, LOST), Ok(()), "reduced mode is a mode to work in");
    for (what, reason, change) in cases {
        let mut state = well();
        change(&mut state, long_ago);
        assert_eq!(health::check(&state, NOW, LOST), Err(reason), "{what}");
    }
    let at_the_limit: [fn(&mut RobotState); 5] = [
        |s| s.unread_since_ns = NOW - LOST,
        |s| s.received_at_ns = NOW - LOST,
        |s| s.advanced_at_ns = NOW - LOST,
        |s| s.answered_at_ns = NOW + 5,
        // The clock stood still between a target and its answer. That is not the program's fault, and soon has a reason of its own.
        |s| (s.advanced_at_ns, s.answered_at_ns) = (NOW - LOST / 2, NOW - LOST - 1),
    ];
    for change in at_the_limit {
        let mut state = well();
        change(&mut state);
        assert_eq!(health::check(&state, NOW, LOST), Ok(()));
    }
}

fn options() -> LinkOptions {
    LinkOptions {
        address: [127, 0, 0, 1].into(),
        tilt: TiltJoint { joint: Joint::Wrist2, start_deg: -90.0, direction: -1.0 },
        start_tolerance_deg: 2.0,
        register_base: 30,
        lookahead_s: 0.05,
        gain: 600.0,
        limits: Limits::default(),
        rate_hz: 30.0,
    }
}

fn value(text: &str, name: &str) -> String {
    let mut lines = text.lines().filter_map(|line| line.strip_prefix(&format!("  {name} = ")));
    let value = lines.next().unwrap_or_else(|| panic!("no {name}")).to_owned();
    assert_eq!(lines.next(), None, "{name} stands there twice");
    value
}

/// Protects the upload: each value of the cell is in the program, once, and nothing else of the program is changed.
#[test]
fn the_program_is_filled_in() {
    let text = program::text(&options(), 0.008, 77).unwrap();
    let expected = [
        ("RUN", "77"),
        ("FIRST", "30"),
        ("WATCHED", "\"input_int_register_30\""),
        ("JOINT", "4"),
        ("START", "-1.570796327"),
        ("DIRECTION", "-1.000000000"),
        ("TOLERANCE", "0.034906585"),
        ("ALPHA_MIN", "0.000000000"),
        ("ALPHA_MAX", "1.919862177"),
        ("RATE", "1.570796327"),
        ("RETURN_RATE", "1.047197551"),
        ("ACCELERATION", "26.179938780"),
        ("LOOKAHEAD", "0.050000000"),
        ("GAIN", "600.000000000"),
        ("TARGET_HZ", "30.000000000"),
        ("PATIENCE", "0.100000000"),
        ("LENGTH", "8"),
        ("WINDOW", "[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]"),
    ];
    for (name, filled) in expected {
        assert_eq!(value(&text, name), filled, "{name}");
    }
    let changed: Vec<_> = program::SOURCE.lines().zip(text.lines()).filter(|(a, b)| a != b).collect();
    assert!(changed.iter().all(|(line, _)| line.contains(" = ")), "{changed:?}");
    assert_eq!(program::SOURCE.lines().count(), text.lines().count());
    assert!(text.starts_with("def ") && text.ends_with("\nend\n") && text.is_ascii(), "a program for the script port");
}

/// Protects the way upright: the watchdog on the robot acts only long after the program's own way has ended.
#[test]
fn the_watchdog_leaves_time_for_the_way_upright() {
    let limits = Limits { return_rate_deg_s: 10.0, ..Limits::default() };
    let text = program::text(&LinkOptions { limits, ..options() }, 0.008, 1).unwrap();
    let hz: f64 = value(&text, "WATCHDOG_HZ").parse().unwrap();
    assert!(1.0 / hz > 2.0 * 110.0 / 10.0, "{hz}");
}

/// Protects the braking distance: the program averages over the braking time, and over a target period at least.
#[test]
fn the_average_covers_the_braking_time() {
    let length = |options: &LinkOptions, cycle_s| value(&program::text(options, cycle_s, 1).unwrap(), "LENGTH");
    assert_eq!(length(&options(), 0.002), "30", "90 deg/s at 1500 deg/s^2 take 60 ms");
    let quick = LinkOptions { limits: Limits { rate_deg_s: 20.0, ..Limits::default() }, ..options() };
    assert_eq!(length(&quick, 0.002), "17", "one period of 30 Hz");
    let slow = LinkOptions { limits: Limits { acceleration_deg_s2: 100.0, ..Limits::default() }, ..options() };
    let refused = program::text(&slow, 0.002, 1).unwrap_err();
    assert!(matches!(refused, LinkError::Limits { .. }), "{refused}");
}

/// Any bytes; more often than not they are packets of the types that a client reads.
fn anything() -> impl Strategy<Value = Vec<u8>> {
    let payload = prop_oneof![
        prop::collection::vec(any::<u8>(), 0..40),
        prop::collection::vec(0u8..8, 0..12),
        prop::collection::vec(any::<u8>(), 189)
    ];
    let packet = (prop::sample::select(b"VvOISMU".to_vec()), payload).prop_map(|(kind, payload)| {
        let mut packet = (payload.len() as u16 + 3).to_be_bytes().to_vec();
        packet.push(kind);
        packet.extend(payload);
        packet
    });
    let noise = prop::collection::vec(any::<u8>(), 0..20);
    prop::collection::vec(prop_oneof![9 => packet, 1 => noise], 0..20).prop_map(|pieces| pieces.concat())
}

proptest! {
    /// Protects the loop from a robot, or something else on that port, that sends anything at all.
    #[test]
    fn no_bytes_make_the_parsers_panic(stream in anything(), cut in 1usize..300) {
        let mut inbox = Inbox::new();
        'pieces: for piece in stream.chunks(cut) {
            give(&mut inbox, piece);
            loop {
                match inbox.next_packet() {
                    Err(_) => break 'pieces,
                    Ok(None) => break,
                    Ok(Some(packet)) => wire::read_anything(packet, &tilt()),
                }
            }
        }
    }
}
