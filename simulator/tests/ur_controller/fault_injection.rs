//! Every fault that can be injected, as a client sees it.

use std::io::{ErrorKind, Write};
use std::net::{SocketAddr, TcpStream};

use simulator::ur::{Fault, RobotMode, RuntimeState, SafetyMode, Series, fault, send_fault};

use crate::client::{DashboardClient, RtdeClient, double, hex, int};
use crate::{COUNT, playing, start, state, until, upload};

// Protects the operator's way into another process: each fault has a text that names it, and arrives there.
#[test]
fn faults_have_names_and_arrive_over_the_operator_port() {
    let examples = ["2", "40", "input_int_register_24", "hello"];
    let mut seen = 0;
    for line in fault::HELP.lines() {
        let name = line.split_whitespace().next().unwrap();
        let text = match name.split_once('=') {
            None => name.to_owned(),
            Some((name, "SECONDS")) => format!("{name}={}", examples[0]),
            Some((name, "SHARE")) => format!("{name}=0.5"),
            Some((name, "DEG_S")) => format!("{name}=30"),
            Some((name, "JOINT:DEG")) => format!("{name}=wrist_1:-12.5"),
            Some((name, "PORT")) => format!("{name}=30003"),
            Some((name, "KG")) => format!("{name}=1.5"),
            Some((name, "X:Y:Z")) => format!("{name}=0:-0.01:0.08"),
            Some((name, "MODE")) => format!("{name}=system-emergency-stop"),
            Some((name, "CYCLES")) => format!("{name}={}", examples[1]),
            Some((name, "INPUT" | "VARIABLE")) => format!("{name}={}", examples[2]),
            Some((name, _)) => format!("{name}={}", examples[3]),
        };
        let fault: Fault = text.parse().unwrap();
        assert_eq!(fault.to_string(), text);
        seen += 1;
    }
    assert_eq!(seen, 42);
    for (text, error) in [
        ("explode", "no such fault"),
        ("stall", "needs a value"),
        ("stall=-1", "needs seconds"),
        ("fin=1", "takes no value"),
        ("speed-slider=0", "needs a share"),
        ("in-use=target_q", "needs the name of an RTDE input"),
        ("time-scaling=1.5", "needs a share"),
        ("joint-speed-limit=0", "needs degrees a second"),
        ("jog=elbow", "needs a joint"),
        ("safety-mode=protective-stop", "needs normal, reduced"),
        ("hand-move=hip:3", "needs a joint"),
        ("close-port=29995", "needs a port of a robot"),
        ("payload-cog=1:2", "needs three numbers"),
    ] {
        assert!(text.parse::<Fault>().unwrap_err().to_string().contains(error), "{text}");
    }
    let (handle, address) = start(Series::Cb3);
    send_fault(address, &Fault::EmergencyStop).unwrap();
    until("emergency stop", || state(&handle).1 == SafetyMode::RobotEmergencyStop);
    // This fault ends clients that came before the operator.
    let mut clients = [RtdeClient::started(address, "timestamp"), RtdeClient::started(address, "timestamp")];
    send_fault(address, &Fault::Fin).unwrap();
    for client in &mut clients {
        while client.packet().unwrap().is_some() {}
    }
    send_fault(address, &Fault::EmergencyRelease).unwrap();
    drop(handle);
    assert!(send_fault(address, &Fault::Fin).unwrap_err().to_string().contains("no simulated controller answers"));
}

// Protects the fault "fin": the stream ends in order, the robot goes on, and a new connection works.
#[test]
fn fault_fin_ends_rtde_connections_in_order() {
    let (handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::started(address, "timestamp");
    upload(address, COUNT);
    playing(&handle);
    handle.inject(Fault::Fin);
    while client.packet().unwrap().is_some() {}
    assert_eq!(state(&handle).2, RuntimeState::Playing);
    RtdeClient::started(address, "timestamp").data();
}

// Protects the fault "reset": the stream is aborted and not closed in order.
#[test]
fn fault_reset_aborts_rtde_connections() {
    let (handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::started(address, "timestamp");
    client.data();
    handle.inject(Fault::Reset);
    let error = loop {
        match client.packet() {
            Ok(Some(_)) => {}
            Ok(None) => panic!("closed in order"),
            Err(error) => break error,
        }
    };
    assert_eq!(error.kind(), ErrorKind::ConnectionReset);
    RtdeClient::started(address, "timestamp").data();
}

// Protects the fault "offline": everything closes and no port answers, and later everything is back.
#[test]
fn fault_offline_closes_all_ports_for_a_while() {
    let (handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::started(address, "timestamp");
    handle.inject(Fault::Offline(600.0));
    while let Ok(Some(_)) = client.packet() {}
    for port in [29999, 30001, 30002, 30003, 30004] {
        assert_eq!(TcpStream::connect(SocketAddr::new(address, port)).unwrap_err().kind(), ErrorKind::ConnectionRefused);
    }
    send_fault(address, &Fault::Clear).unwrap();
    until("back", || TcpStream::connect(SocketAddr::new(address, 30004)).is_ok());
    RtdeClient::started(address, "timestamp").data();
    DashboardClient::new(address);
}

// Protects the fault "stall": the socket stays open, but nothing comes and nothing is taken. Afterwards the stream goes on with a
// gap in the timestamps.
#[test]
fn fault_stall_is_silent_and_deaf() {
    let (handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::started(address, "timestamp,input_int_register_24");
    assert_eq!(client.inputs("input_int_register_24"), "1:INT32");
    let before = double(&client.data(), 0);
    handle.inject(Fault::Stall(0.4));
    client.stream.write_all(&hex("0008550100000007")).unwrap();
    let mut stamps = vec![before];
    let mut data = client.data();
    while stamps.windows(2).all(|w| w[1] - w[0] < 0.3) {
        // No packet before the gap may know the write.
        assert_eq!(int(&data, 8), 0);
        stamps.push(double(&data, 0));
        data = client.data();
    }
    until("the write arrives in the end", || int(&client.data(), 8) == 7);
}

// Protects the fault "freeze": packets keep coming, but it is always the same one, while the robot itself goes on.
#[test]
fn fault_freeze_repeats_one_packet() {
    let (handle, address) = start(Series::Cb3);
    upload(address, COUNT);
    playing(&handle);
    let mut client = RtdeClient::started(address, "timestamp,output_int_register_24");
    client.data();
    handle.inject(Fault::Freeze(0.4));
    let mut same = 0;
    let mut last = client.data();
    loop {
        let data = client.data();
        if data == last {
            same += 1;
        } else if same > 5 {
            assert!(double(&data, 0) - double(&last, 0) > 0.3, "the robot's own time went on");
            assert!(int(&data, 8) - int(&last, 8) > 37);
            break;
        }
        last = data;
    }
}

// Protects the fault "slow-reader": inputs are taken late and then all at once, while outputs keep coming.
#[test]
fn fault_slow_reader_takes_inputs_late() {
    let (handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::started(address, "timestamp,input_int_register_24");
    client.inputs("input_int_register_24");
    handle.inject(Fault::SlowReader(0.4));
    client.stream.write_all(&hex("0008550100000007")).unwrap();
    let start = double(&client.data(), 0);
    loop {
        let data = client.data();
        if int(&data, 8) == 7 {
            assert!(double(&data, 0) - start > 0.3);
            break;
        }
    }
}

// Protects the fault "skip-outputs": the timestamps have a gap of that many cycles, and nothing is sent twice or late.
#[test]
fn fault_skip_outputs_leaves_a_gap() {
    let (handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::started(address, "timestamp");
    let mut last = double(&client.data(), 0);
    handle.inject(Fault::SkipOutputs(40));
    until("a gap of 40 cycles", || {
        let now = double(&client.data(), 0);
        let gap = ((now - last) / 0.008).round();
        assert!(gap >= 1.0, "nothing twice, nothing late");
        last = now;
        gap >= 41.0
    });
}

// Protects the faults "split" and "coalesce": a client that reassembles gets the packets whole and in order, although the pieces
// on the wire are not packets.
#[test]
fn faults_split_and_coalesce_keep_the_bytes() {
    let (handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::started(address, "timestamp,actual_q,robot_mode");
    let packet = 4 + 8 + 48 + 4;
    let mut last = double(&client.data(), 0);
    for fault in [Fault::Split(600.0), Fault::Coalesce(600.0), Fault::Clear] {
        handle.inject(Fault::Clear);
        handle.inject(fault.clone());
        client.pieces.clear();
        let mut seen = 0;
        while seen < 40 {
            let data = client.data();
            assert!(double(&data, 0) > last, "{fault}");
            last = double(&data, 0);
            assert_eq!((data.len(), int(&data, 56)), (packet - 4, 7), "{fault}");
            seen += 1;
        }
        match fault {
            Fault::Split(_) => assert!(client.pieces.iter().filter(|p| *p % packet != 0).count() > 20, "{:?}", client.pieces),
            Fault::Coalesce(_) => assert!(client.pieces.iter().filter(|p| **p == 4 * packet).count() >= 8, "{:?}", client.pieces),
            _ => {}
        }
    }
}

// Protects the faults "in-use", "not-found" and "refuse-version-2", and that "clear" ends them.
#[test]
fn faults_that_refuse_a_setup() {
    let (handle, address) = start(Series::Cb3);
    for fault in ["in-use=input_int_register_24", "not-found=actual_q", "not-found=input_double_register_24", "refuse-version-2"] {
        handle.inject(fault.parse().unwrap());
    }
    let mut client = RtdeClient::new(address);
    assert_eq!(client.ask(b'V', &[0, 2]), hex("00045600"));
    assert_eq!(client.ask(b'V', &[0, 1]), hex("00045601"));
    assert_eq!(client.inputs("input_int_register_24,input_int_register_25"), "0:IN_USE,INT32");
    assert_eq!(client.inputs("input_double_register_24"), "0:NOT_FOUND");
    assert_eq!(&client.ask(b'O', b"timestamp,actual_q")[3..], b"DOUBLE,NOT_FOUND");
    handle.inject(Fault::Clear);
    let mut client = RtdeClient::started(address, "timestamp,actual_q");
    assert_eq!(client.inputs("input_int_register_24,input_double_register_24"), "1:INT32,DOUBLE");
}

// Protects the faults "text" and "text-on-connect": a message comes at any moment between data packets, in the layout of the
// session's version, or before the first answer.
#[test]
fn faults_text_comes_at_any_moment() {
    let (handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::started(address, "timestamp");
    handle.inject(Fault::Text("careful".to_owned()));
    assert_eq!(&client.answer(b'M')[3..], b"\x07careful\x04RTDE\x02");
    client.data();
    handle.inject(Fault::TextOnConnect("SafetySetup has not been confirmed yet".to_owned()));
    let mut client = RtdeClient::new(address);
    client.send(b'V', &[0, 2]);
    assert_eq!(client.packet().unwrap().unwrap()[2], b'M');
    assert_eq!(client.packet().unwrap().unwrap(), hex("00045601"));
}

// Protects the faults of the robot itself as a client sees them: a protective stop, an emergency stop and its release, a pause and
// a stop on the pendant, and a late start.
#[test]
fn faults_of_the_robot_show_in_its_state() {
    let (handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::started(address, "robot_mode,safety_mode,runtime_state,safety_status_bits,timestamp");
    let mut shows = |what: &str, robot: i32, safety: i32, runtime: i32, bits: i32| {
        until(what, || {
            let data = client.data();
            [0, 4, 8, 12].map(|at| int(&data, at)) == [robot, safety, runtime, bits]
        });
    };
    shows("at rest", 7, 1, 1, 1);
    upload(address, COUNT);
    shows("playing", 7, 1, 2, 1);
    handle.inject(Fault::ProgramPause);
    shows("paused", 7, 1, 4, 1);
    handle.inject(Fault::ProgramStop);
    shows("stopped", 7, 1, 1, 1);
    upload(address, COUNT);
    shows("playing", 7, 1, 2, 1);
    handle.inject(Fault::ProtectiveStop);
    shows("protective stop", 7, 3, 4, 1 << 2 | 1 << 10);
    handle.inject(Fault::EmergencyStop);
    shows("emergency stop", 3, 7, 1, 1 << 6 | 1 << 7 | 1 << 10);
    handle.inject(Fault::EmergencyRelease);
    shows("released", 3, 1, 1, 1);
    let mut dashboard = DashboardClient::new(address);
    dashboard.ask("power on");
    shows("idle", 5, 1, 1, 1);
    dashboard.ask("brake release");
    shows("ready", 7, 1, 1, 1);
    handle.inject(Fault::LateStart(0.5));
    upload(address, COUNT);
    let before = double(&client.data(), 16);
    let mut data = client.data();
    while int(&data, 8) != 2 {
        data = client.data();
    }
    assert!(double(&data, 16) - before > 0.4, "started {} s after the upload", double(&data, 16) - before);
}

// Protects the faults "close-port", "payload" and "payload-cog": a disabled service refuses while the others answer, until "clear"; and
// the payload that the robot was told is what RTDE says.
#[test]
fn fault_close_port_and_payload() {
    let (handle, address) = start(Series::ESeries);
    let refused = |port| TcpStream::connect(SocketAddr::new(address, port)).is_err();
    for closed in [30001, 30002, 30003] {
        handle.inject(Fault::ClosePort(closed));
        handle.inject(Fault::ClosePort(closed));
        for port in [29999, 30001, 30002, 30003, 30004] {
            assert_eq!(refused(port), port == closed, "{port} while {closed} is closed");
        }
        handle.inject(Fault::Clear);
        until("the port is open again", || !refused(closed));
    }
    handle.inject(Fault::Payload(1.5));
    handle.inject(Fault::PayloadCog([0.0, -0.01, 0.08]));
    let mut client = RtdeClient::started(address, "payload,payload_cog");
    let data = client.data();
    let data = &data[data.len() - 32..];
    assert_eq!([0, 8, 16, 24].map(|at| double(data, at)), [1.5, 0.0, -0.01, 0.08]);
}

// Protects the faults that a person at the pendant causes, over the operator port: the words do what the pendant does.
#[test]
fn fault_words_do_what_the_pendant_does() {
    let (handle, address) = start(Series::Cb3);
    let cause = |text: &str| send_fault(address, &text.parse().unwrap()).unwrap();
    upload(address, COUNT);
    playing(&handle);
    cause("program-pause");
    until("paused", || state(&handle).2 == RuntimeState::Paused);
    cause("jog=base:5");
    until("jogged", || handle.joints().actual_q[0].to_degrees() > 4.99);
    cause("program-resume");
    playing(&handle);
    cause("program-stop");
    cause("freedrive");
    cause("hand-move=base:-5");
    until("moved by hand", || handle.joints().actual_q[0].to_degrees() < 0.01);
    cause("freedrive-end");
    cause("emergency-stop");
    cause("emergency-release");
    cause("brake-release");
    until("running", || state(&handle).0 == RobotMode::Running);
    cause("boot");
    until("booted", || state(&handle).0 == RobotMode::PowerOff && state(&handle).2 == RuntimeState::Paused);
    cause("joint-speed-limit=30");
    cause("time-scaling=0.5");
}
