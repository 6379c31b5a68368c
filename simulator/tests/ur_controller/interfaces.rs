//! The other ports, and the controller in this process: programs in, state out, the dashboard's words, isolation, and the trace.

use std::io::{Read, Write};
use std::net::{Shutdown, SocketAddr, TcpStream};

use simulator::ur::{Controller, ControllerOptions, Fault, LogKind, RuntimeState, Series};

use crate::client::{DashboardClient, RtdeClient, double, int};
use crate::{COUNT, address, connect, playing, start, state, until, upload};

// Protects the life of a program over sockets. It can be uploaded on each script port, shows in runtime_state, status bits and
// registers, and can be stopped; the log names the line of a mistake.
#[test]
fn programs_run_from_every_script_port() {
    let (handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::started(address, "runtime_state,robot_status_bits,output_int_register_24,script_control_line");
    for port in [30001, 30002, 30003] {
        let mut stream = connect(address, port);
        let mut some = [0; 79];
        stream.read_exact(&mut some).unwrap();
        stream.write_all(COUNT.as_bytes()).unwrap();
        until("playing and counting", || {
            let data = client.data();
            int(&data, 0) == 2 && int(&data, 4) == 3 && int(&data, 8) > 5 && int(&data, 12) >= 3
        });
        handle.inject(Fault::ProgramStop);
        until("stopped", || {
            let data = client.data();
            int(&data, 0) == 1 && int(&data, 4) == 1
        });
    }
    upload(address, "def wrong():\n  sync()\n  a = abs(1)\nend\n");
    let mut log = Vec::new();
    until("the mistake in the log", || {
        log.extend(handle.take_log());
        log.iter().any(|l| l.kind == LogKind::ProgramError && l.text.starts_with("program not started: line 3: no function 'abs'"))
    });
    // The last line needs no line end when the client closes its side in order.
    let mut stream = connect(address, 30002);
    stream.write_all(COUNT.trim_end().as_bytes()).unwrap();
    stream.shutdown(Shutdown::Write).unwrap();
    stream.read_to_end(&mut Vec::new()).unwrap();
    playing(&handle);
}

// Protects the state streams: the size of the real-time package, and that the parts of a primary package add up to it.
#[test]
fn state_streams_have_the_real_layout() {
    for (series, bytes) in [(Series::Cb3, 1140), (Series::ESeries, 1220)] {
        let (handle, address) = start(series);
        let mut realtime = connect(address, 30003);
        let mut package = vec![0; bytes];
        for _ in 0..3 {
            realtime.read_exact(&mut package).unwrap();
            assert_eq!(int(&package, 0) as usize, bytes);
            let q = handle.joints().actual_q;
            assert_eq!(double(&package, 252 + 8), q[1], "actual q of the shoulder");
            assert_eq!((double(&package, 756), double(&package, 812)), (7.0, 1.0), "robot mode, safety mode");
        }
        let mut primary = connect(address, 30001);
        let mut kinds = Vec::new();
        upload(address, "def hello():\n  textmsg(\"hello \", 3)\nend\n");
        while !kinds.contains(&(20, 0)) || !kinds.contains(&(16, 0)) {
            let mut header = [0; 5];
            primary.read_exact(&mut header).unwrap();
            let mut body = vec![0; int(&header, 0) as usize - 5];
            primary.read_exact(&mut body).unwrap();
            if header[4] == 20 {
                kinds.push((20, body[9]));
                if body[9] == 0 {
                    assert_eq!(&body[10..], b"hello 3");
                }
            } else {
                kinds.push((16, 0));
                let mut at = 0;
                let mut inner = Vec::new();
                while at < body.len() {
                    inner.push((int(&body, at), body[at + 4]));
                    at += int(&body, at) as usize;
                }
                assert_eq!(inner, [(47, 0), (251, 1), (101, 4)]);
            }
        }
        assert_eq!(kinds[0], (20, 3), "the version message comes first");
    }
}

// Protects the dashboard's words, which clients compare letter by letter, and what it does to power, programs and safety.
#[test]
fn the_dashboard_answers_in_urs_words() {
    let (handle, address) = start(Series::Cb3);
    let mut dashboard = DashboardClient::new(address);
    for (command, answer) in [
        ("robotmode", "Robotmode: RUNNING"),
        ("safetymode", "Safetymode: NORMAL"),
        ("running", "Program running: false"),
        ("programState", "STOPPED <unnamed>"),
        ("PolyscopeVersion", "URSoftware 3.15.8.106339 (Jan 01 2023)"),
        ("play", "Failed to execute: play"),
        ("stop", "Stopped"),
        ("popup hello", "showing popup"),
        ("close popup", "closing popup"),
        ("close safety popup", "closing safety popup"),
        ("addToLog hello", "Added log message"),
        ("load x.urp", "File not found: x.urp"),
        ("is in remote control", "could not understand: 'is in remote control'"),
        ("nonsense", "could not understand: 'nonsense'"),
    ] {
        assert_eq!(dashboard.ask(command), answer);
    }
    upload(address, COUNT);
    playing(&handle);
    assert_eq!(dashboard.ask("programState"), "PLAYING count");
    assert_eq!(dashboard.ask("pause"), "Pausing program");
    until("paused", || dashboard.ask("programState") == "PAUSED count");
    assert_eq!(dashboard.ask("play"), "Starting program");
    until("running", || dashboard.ask("running") == "Program running: true");
    assert_eq!(dashboard.ask("stop"), "Stopped");
    assert_eq!(dashboard.ask("power off"), "Powering off");
    assert_eq!(dashboard.ask("robotmode"), "Robotmode: POWER_OFF");
    assert_eq!(dashboard.ask("power on"), "Powering on");
    until("idle", || dashboard.ask("robotmode") == "Robotmode: IDLE");
    assert_eq!(dashboard.ask("brake release"), "Brake releasing");
    until("running", || dashboard.ask("robotmode") == "Robotmode: RUNNING");
    handle.inject(Fault::ProtectiveStop);
    assert_eq!(dashboard.ask("safetymode"), "Safetymode: PROTECTIVE_STOP");
    assert!(dashboard.ask("unlock protective stop").starts_with("Cannot unlock protective stop until 5s"));
    until("unlocked", || dashboard.ask("unlock protective stop") == "Protective stop releasing");
    assert_eq!(dashboard.ask("safetymode"), "Safetymode: NORMAL");
    assert_eq!(dashboard.ask("quit"), "Disconnected");
    assert_eq!(dashboard.line(), "");
    let (handle, address) = start(Series::ESeries);
    let mut dashboard = DashboardClient::new(address);
    assert_eq!(dashboard.ask("is in remote control"), "true");
    assert!(dashboard.ask("get serial number").bytes().all(|b| b.is_ascii_digit()));
    handle.inject(Fault::LocalControl);
    assert_eq!(dashboard.ask("is in remote control"), "false");
    assert_eq!(dashboard.ask("power off"), "Failed to execute: power off");
}

// Protects isolation and a clean end: several controllers run at once, and each address is free again when its controller is dropped.
#[test]
fn several_run_at_once_and_leave_nothing_behind() {
    let addresses = [address(), address(), address()];
    for _ in 0..2 {
        let handles = addresses.map(|a| Controller::start(ControllerOptions::new(a)).unwrap());
        let error = Controller::start(ControllerOptions::new(addresses[0])).unwrap_err().to_string();
        assert!(error.contains("29999") && error.contains("is another simulated controller running there?"), "{error}");
        upload(addresses[1], COUNT);
        playing(&handles[1]);
        assert_eq!([0, 2].map(|i| state(&handles[i]).2), [RuntimeState::Stopped; 2]);
        let mut client = RtdeClient::started(addresses[2], "timestamp");
        client.data();
        drop(handles);
        while let Ok(Some(_)) = client.packet() {}
        assert!(TcpStream::connect(SocketAddr::new(addresses[2], 30004)).is_err());
    }
}

// Protects what the cell's physics reads: joints and trace follow the program, and the watched register stands beside them.
#[test]
fn joints_and_trace_follow_the_program() {
    let (handle, address) = start(Series::Cb3);
    let mut client = RtdeClient::new(address);
    assert_eq!(client.inputs("input_double_register_30"), "1:DOUBLE");
    handle.start_trace(30);
    upload(
        address,
        "def follow():\n  q = get_actual_joint_positions()\n  while True:\n    q[5] = read_input_float_register(30)\n    servoj(q, \
         lookahead_time=0.05, gain=600)\n  end\nend\n",
    );
    playing(&handle);
    let first_ns = handle.joints().at_ns;
    client.send(b'U', &[&[1][..], &0.1f64.to_be_bytes()].concat());
    until("arrived", || (handle.joints().actual_q[5] - 0.1).abs() < 1e-3);
    assert!(handle.joints().at_ns > first_ns);
    let rows = handle.take_trace();
    assert!(rows.windows(2).all(|w| (w[1].timestamp_s - w[0].timestamp_s - 0.008).abs() < 1e-9), "every cycle, once");
    let arrived = rows.iter().position(|r| r.register == 0.1).unwrap();
    assert_eq!(rows[arrived].commanded_q[5], 0.1);
    assert!(rows[arrived].actual_q[5] < rows[arrived].target_q[5] && rows[arrived].target_q[5] < 0.1, "command, target, actual in order");
    assert!(handle.take_trace().is_empty());
}
