//! The simulated controller over real sockets: bytes as logged from real clients, ownership, program life, faults.
//!
//! Every test has a loopback address of its own. No test asserts how long something takes.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::net::{IpAddr, Ipv4Addr, Shutdown, SocketAddr, TcpStream};
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::{Duration, Instant};

use simulator::ur::{
    Controller, ControllerOptions, Fault, LogKind, RobotMode, RuntimeState, SafetyMode, Series, Version, fault, send_fault,
};

/// Gives up on something that should come.
const PATIENCE: Duration = Duration::from_secs(20);

/// An address that no other test, and most likely no other process, uses.
fn address() -> IpAddr {
    static NEXT: AtomicU8 = AtomicU8::new(1);
    let pid = std::process::id();
    let (a, b) = ((pid / 250 % 100) as u8, (pid % 250) as u8);
    IpAddr::V4(Ipv4Addr::new(127, 20 + a, 1 + b, NEXT.fetch_add(1, Ordering::Relaxed)))
}

fn start(series: Series) -> (Controller, IpAddr) {
    let address = address();
    let mut options = ControllerOptions::new(address);
    options.series = series;
    (Controller::start(options).unwrap(), address)
}

fn connect(address: IpAddr, port: u16) -> TcpStream {
    let stream = TcpStream::connect_timeout(&SocketAddr::new(address, port), PATIENCE).unwrap();
    stream.set_read_timeout(Some(PATIENCE)).unwrap();
    stream.set_nodelay(true).unwrap();
    stream
}

/// Waits until `condition` holds.
fn until(what: &str, mut condition: impl FnMut() -> bool) {
    let start = Instant::now();
    while !condition() {
        assert!(start.elapsed() < PATIENCE, "never: {what}");
        std::thread::sleep(Duration::from_millis(2));
    }
}

/// A client that speaks frames.
struct Rtde {
    stream: TcpStream,
    buffer: Vec<u8>,
    /// Sizes of the pieces that read gave.
    pieces: Vec<usize>,
}

impl Rtde {
    fn new(address: IpAddr) -> Self {
        Self { stream: connect(address, 30004), buffer: Vec::new(), pieces: Vec::new() }
    }

    fn send(&mut self, kind: u8, payload: &[u8]) {
        let mut frame = ((payload.len() + 3) as u16).to_be_bytes().to_vec();
        frame.push(kind);
        frame.extend(payload);
        self.stream.write_all(&frame).unwrap();
    }

    /// The next frame, header included; None: the controller closed. Err: it aborted.
    fn frame(&mut self) -> std::io::Result<Option<Vec<u8>>> {
        loop {
            if let Some(size) = self.buffer.first_chunk().map(|s| usize::from(u16::from_be_bytes(*s)))
                && self.buffer.len() >= size
            {
                return Ok(Some(self.buffer.drain(..size).collect()));
            }
            let mut piece = [0; 65536];
            let n = self.stream.read(&mut piece)?;
            if n == 0 {
                return Ok(None);
            }
            self.pieces.push(n);
            self.buffer.extend(&piece[..n]);
        }
    }

    /// The next frame of type `kind`; data and text before it are passed over.
    fn answer(&mut self, kind: u8) -> Vec<u8> {
        loop {
            let frame = self.frame().unwrap().expect("closed");
            if frame[2] == kind {
                return frame;
            }
        }
    }

    fn ask(&mut self, kind: u8, payload: &[u8]) -> Vec<u8> {
        self.send(kind, payload);
        self.answer(kind)
    }

    fn outputs(&mut self, frequency: f64, names: &str) -> String {
        let frame = self.ask(b'O', &[&frequency.to_be_bytes(), names.as_bytes()].concat());
        format!("{}:{}", frame[3], String::from_utf8_lossy(&frame[4..]))
    }

    fn inputs(&mut self, names: &str) -> String {
        let frame = self.ask(b'I', names.as_bytes());
        format!("{}:{}", frame[3], String::from_utf8_lossy(&frame[4..]))
    }

    /// The next data frame's values.
    fn data(&mut self) -> Vec<u8> {
        self.answer(b'U').split_off(4)
    }

    /// Negotiated, started, and reading `names` at full rate.
    fn started(address: IpAddr, names: &str) -> Self {
        let mut client = Self::new(address);
        assert_eq!(client.ask(b'V', &[0, 2]), hex("00045601"));
        let types = client.outputs(500.0, names);
        assert!(types.starts_with("1:"), "{types}");
        assert_eq!(client.ask(b'S', &[]), hex("00045301"));
        client
    }
}

fn hex(text: &str) -> Vec<u8> {
    let digits: Vec<u32> = text.chars().filter_map(|c| c.to_digit(16)).collect();
    digits.chunks(2).map(|d| (d[0] * 16 + d[1]) as u8).collect()
}

fn double(data: &[u8], at: usize) -> f64 {
    f64::from_be_bytes(*data[at..].first_chunk().unwrap())
}

fn int(data: &[u8], at: usize) -> i32 {
    i32::from_be_bytes(*data[at..].first_chunk().unwrap())
}

fn upload(address: IpAddr, program: &str) {
    let mut stream = connect(address, 30003);
    let mut some = [0; 79];
    stream.read_exact(&mut some).unwrap();
    stream.write_all(program.as_bytes()).unwrap();
}

/// A program that counts cycles in output int register 24 until it is stopped.
const COUNT: &str =
    "def count():\n  n = 0\n  while True:\n    n = n + 1\n    write_output_integer_register(24, n)\n    sync()\n  end\nend\n";

fn state(handle: &Controller) -> (RobotMode, SafetyMode, RuntimeState) {
    let state = handle.state().unwrap();
    (state.robot_mode, state.safety_mode, state.runtime_state)
}

fn playing(handle: &Controller) {
    until("playing", || state(handle).2 == RuntimeState::Playing);
}

/// What ur_rtde 1.6.5's receive interface asks a CB3 3.15 for.
const RECEIVE: &str = "timestamp,target_q,target_qd,target_qdd,target_current,target_moment,actual_q,actual_qd,actual_current,\
joint_control_output,actual_TCP_pose,actual_TCP_speed,actual_TCP_force,target_TCP_pose,target_TCP_speed,actual_digital_input_bits,\
joint_temperatures,actual_execution_time,robot_mode,joint_mode,safety_mode,actual_tool_accelerometer,speed_scaling,\
target_speed_fraction,actual_momentum,actual_main_voltage,actual_robot_voltage,actual_robot_current,actual_joint_voltage,\
actual_digital_output_bits,runtime_state,standard_analog_input0,standard_analog_input1,standard_analog_output0,\
standard_analog_output1,robot_status_bits,safety_status_bits,payload,payload_cog,payload_inertia,output_int_register_2,\
output_int_register_12,output_int_register_13,output_int_register_14,output_int_register_15,output_int_register_16,\
output_int_register_17,output_int_register_18,output_int_register_19,output_double_register_12,output_double_register_13,\
output_double_register_14,output_double_register_15,output_double_register_16,output_double_register_17,output_double_register_18,\
output_double_register_19,";

// Protects the wire format: the bytes logged from ur_rtde 1.6.5 get the answers that a CB3 3.15.8 gave it.
#[test]
fn ur_rtde_receive_interface_byte_for_byte() {
    let (_handle, address) = start(Series::Cb3);
    let mut client = Rtde::new(address);
    client.stream.write_all(&hex("0005560002 000376 000376")).unwrap();
    assert_eq!(client.frame().unwrap().unwrap(), hex("00045601"));
    for _ in 0..2 {
        assert_eq!(client.frame().unwrap().unwrap(), hex("00137600000003 0000000f 00000008 00019f63"));
    }
    let mut setup = hex("044e4f405f400000000000");
    setup.extend(RECEIVE.as_bytes());
    assert_eq!(setup.len(), 1102, "the request as logged");
    client.stream.write_all(&setup).unwrap();
    let answer = client.frame().unwrap().unwrap();
    assert_eq!((answer[2], answer[3]), (b'O', 1));
    assert!(answer[4..].starts_with(b"DOUBLE,VECTOR6D,"), "no comma after the last type, none before the first");
    assert_eq!(answer.iter().filter(|b| **b == b',').count(), 56);
    client.stream.write_all(&hex("000353")).unwrap();
    assert_eq!(client.frame().unwrap().unwrap(), hex("00045301"));
    let first = client.frame().unwrap().unwrap();
    assert_eq!((first.len(), &first[2..4]), (1132, &b"U\x01"[..]), "1132 bytes a frame, as logged");
    let second = client.frame().unwrap().unwrap();
    assert!((double(&second, 4) - double(&first, 4) - 0.008).abs() < 1e-9, "timestamps of neighbours are a cycle apart");
}

/// Fields of ur_rtde's 23 input recipes: ints, doubles, last int after the doubles; sizes of I frame, answer and U frame.
const CONTROL: [(usize, usize, bool, usize, usize, usize); 22] = [
    (1, 8, true, 237, 71, 76),
    (1, 11, false, 289, 86, 96),
    (8, 18, false, 611, 177, 180),
    (1, 0, false, 24, 9, 8),
    (1, 9, false, 240, 72, 80),
    (1, 6, false, 168, 51, 56),
    (1, 4, false, 120, 37, 40),
    (1, 1, false, 48, 16, 16),
    (2, 0, false, 45, 15, 12),
    (1, 14, false, 364, 107, 120),
    (1, 0, false, 24, 9, 8),
    (1, 12, false, 314, 93, 104),
    (1, 8, false, 216, 65, 72),
    (1, 14, false, 364, 107, 120),
    (2, 0, false, 45, 15, 12),
    (1, 13, false, 339, 100, 112),
    (7, 6, false, 294, 87, 80),
    (2, 7, false, 213, 64, 68),
    (1, 1, true, 69, 22, 20),
    (1, 10, false, 264, 79, 88),
    (1, 6, true, 189, 57, 60),
    (1, 18, false, 464, 135, 152),
];

// Protects the control interface: 23 input recipes with ids in order and one variable in many of them, sizes as logged, and
// the logged servoJ, watchdog and clear frames arrive in the registers.
#[test]
fn ur_rtde_control_interface_byte_for_byte() {
    let (_handle, address) = start(Series::Cb3);
    let mut client = Rtde::new(address);
    client.ask(b'V', &[0, 2]);
    let mut names: Vec<String> = ["timestamp", "robot_status_bits", "safety_status_bits", "runtime_state"].map(str::to_owned).to_vec();
    names.extend((0..3).map(|i| format!("output_int_register_{i}")));
    names.extend((0..6).map(|i| format!("output_double_register_{i}")));
    client.outputs(125.0, &format!("{},", names.join(",")));
    for (i, (ints, doubles, last_int, setup_bytes, answer_bytes, _)) in CONTROL.into_iter().enumerate() {
        let mut names: Vec<String> = (0..ints).map(|n| format!("input_int_register_{n}")).collect();
        names.extend((0..doubles).map(|n| format!("input_double_register_{n}")));
        names.extend(last_int.then(|| "input_int_register_1".to_owned()));
        let list = format!("{},", names.join(","));
        assert_eq!(list.len() + 3, setup_bytes, "recipe {}", i + 1);
        let answer = client.ask(b'I', list.as_bytes());
        assert_eq!((answer.len(), usize::from(answer[3])), (answer_bytes, i + 1));
    }
    assert_eq!(client.inputs("input_int_register_0,external_force_torque,"), "23:INT32,VECTOR6D");
    assert_eq!(client.ask(b'S', &[]), hex("00045301"));
    assert_eq!(client.answer(b'U').len(), 84, "84 bytes a frame, as logged");
    // The same connection may read its inputs back.
    let mut reader = Rtde::started(
        address,
        "input_int_register_0,input_double_register_0,input_double_register_1,input_double_register_5,input_double_register_8,\
         input_double_register_9,input_double_register_10",
    );
    let servoj = "0060 55 02 0000000b 0000000000000000 bff921ff2e48e8a7 3ff921ff2e48e8a7 bff921ff2e48e8a7 bff921ff2e48e8a7 \
                  3f81111111111111 0000000000000000 0000000000000000 3fa1111111111111 3fb999999999999a 4072c00000000000";
    client.stream.write_all(&hex(servoj)).unwrap();
    let wanted = hex("0000000b 0000000000000000 bff921ff2e48e8a7 3f81111111111111 3fa1111111111111 3fb999999999999a 4072c00000000000");
    until("servoJ's registers", || reader.data() == wanted);
    client.stream.write_all(&hex("0010550800000023 4024000000000000")).unwrap();
    until("setWatchdog's registers", || reader.data()[..12] == hex("00000023 4024000000000000"));
    client.stream.write_all(&hex("0008550400000000")).unwrap();
    until("the command cleared", || int(&reader.data(), 0) == 0);
}

// Protects the IO interface: inputs work on a connection that was never started and never asked for outputs; START is refused
// there, as on a robot.
#[test]
fn inputs_work_without_outputs_and_start() {
    let (_handle, address) = start(Series::Cb3);
    let mut client = Rtde::new(address);
    client.ask(b'V', &[0, 2]);
    for id in 1..=3 {
        assert_eq!(client.inputs(&format!("input_int_register_2{id}")), format!("{id}:INT32"));
    }
    assert_eq!(client.inputs("speed_slider_mask,speed_slider_fraction,"), "4:UINT32,DOUBLE");
    assert_eq!(client.inputs("standard_digital_output_mask,standard_digital_output"), "5:UINT8,UINT8");
    client.stream.write_all(&hex("0010 55 04 00000001 3fe0000000000000")).unwrap();
    client.stream.write_all(&hex("0006 55 05 04 04")).unwrap();
    let mut reader = Rtde::started(address, "speed_scaling,target_speed_fraction,actual_digital_output_bits");
    until("slider at a half and output 2 on", || reader.data() == hex("3fe0000000000000 3fe0000000000000 0000000000000004"));
    assert_eq!(client.ask(b'S', &[]), hex("00045300"));
    assert_eq!(client.ask(b'P', &[]), hex("00045001"));
}

// Protects protocol version 1 (what a session has before negotiation): no frequency, no recipe id in answers and data.
#[test]
fn version_1_has_no_recipe_id_for_outputs() {
    let (_handle, address) = start(Series::Cb3);
    let mut client = Rtde::new(address);
    let answer = client.ask(b'O', b"timestamp,robot_mode");
    assert_eq!(&answer[3..], b"DOUBLE,INT32");
    client.ask(b'S', &[]);
    let frame = client.answer(b'U');
    assert_eq!((frame.len(), int(&frame, 11)), (3 + 12, 7));
    assert_eq!(client.ask(b'V', &[0, 7]), hex("00045600"), "no version 7; the session goes on");
    assert_eq!(client.ask(b'V', &[0, 1]), hex("00045601"));
}

// Protects recipes: a second O replaces the first and stops the stream, P stops it and always says 1, S goes on.
#[test]
fn outputs_are_replaced_paused_and_resumed() {
    let (_handle, address) = start(Series::Cb3);
    let mut client = Rtde::started(address, "timestamp");
    assert_eq!(client.data().len(), 8);
    assert_eq!(client.outputs(125.0, "robot_mode,safety_mode,"), "2:INT32,INT32");
    client.ask(b'S', &[]);
    let frame = client.answer(b'U');
    assert_eq!((frame[3], int(&frame, 4), int(&frame, 8)), (2, 7, 1));
    assert_eq!(client.ask(b'P', &[]), hex("00045001"));
    client.send(b'v', &[]);
    assert_eq!(client.frame().unwrap().unwrap()[2], b'v', "no data after the answer to PAUSE");
    client.ask(b'S', &[]);
    client.data();
}

// Protects refusals: unknown variables are NOT_FOUND with recipe id 0, and nothing can be started with such a recipe.
#[test]
fn unknown_variables_make_a_recipe_invalid() {
    let (_handle, address) = start(Series::Cb3);
    let mut client = Rtde::new(address);
    client.ask(b'V', &[0, 2]);
    assert_eq!(client.outputs(125.0, "timestamp,no_such_thing"), "0:DOUBLE,NOT_FOUND");
    assert_eq!(client.ask(b'S', &[]), hex("00045300"));
    assert_eq!(client.inputs("input_int_register_24,input_int_register_48"), "0:INT32,NOT_FOUND");
    assert_eq!(client.inputs("input_int_register_24"), "1:INT32", "an invalid recipe takes no id");
    assert_eq!(client.outputs(0.0, "timestamp"), "0:DOUBLE", "a frequency below 1 Hz");
    // Data for a recipe that does not exist, or of a wrong length, is answered by a text message and changes nothing.
    client.stream.write_all(&hex("000855090000000b")).unwrap();
    assert_eq!(client.frame().unwrap().unwrap()[2], b'M');
    client.stream.write_all(&hex("00055501ff")).unwrap();
    assert_eq!(client.frame().unwrap().unwrap()[2], b'M');
    let mut reader = Rtde::started(address, "input_int_register_24");
    assert_eq!(int(&reader.data(), 0), 0);
}

// Protects the variable table: every variable of the reference has its type and as many bytes, and newer ones are unknown to
// older controllers.
#[test]
fn every_variable_has_its_type_and_size() {
    let sizes = BTreeMap::from([
        ("BOOL", 1),
        ("UINT8", 1),
        ("INT32", 4),
        ("UINT32", 4),
        ("UINT64", 8),
        ("DOUBLE", 8),
        ("VECTOR3D", 24),
        ("VECTOR6D", 48),
        ("VECTOR6INT32", 24),
    ]);
    let table = [
        (
            "DOUBLE",
            "timestamp,speed_scaling,target_speed_fraction,actual_momentum,actual_main_voltage,actual_robot_voltage,\
          actual_robot_current,actual_execution_time,standard_analog_input0,standard_analog_input1,standard_analog_output0,\
          standard_analog_output1,payload,output_double_register_0,output_double_register_47,input_double_register_0,\
          input_double_register_47",
        ),
        (
            "VECTOR6D",
            "target_q,target_qd,target_qdd,target_current,target_moment,actual_q,actual_qd,actual_current,\
          joint_control_output,actual_TCP_pose,actual_TCP_speed,actual_TCP_force,target_TCP_pose,target_TCP_speed,joint_temperatures,\
          actual_joint_voltage,payload_inertia",
        ),
        ("VECTOR6INT32", "joint_mode"),
        ("VECTOR3D", "actual_tool_accelerometer,payload_cog,elbow_position,elbow_velocity"),
        ("UINT64", "actual_digital_input_bits,actual_digital_output_bits"),
        (
            "INT32",
            "robot_mode,safety_mode,safety_status,output_int_register_0,output_int_register_47,input_int_register_0,\
          input_int_register_47",
        ),
        (
            "UINT32",
            "runtime_state,robot_status_bits,safety_status_bits,script_control_line,output_bit_registers0_to_31,\
          output_bit_registers32_to_63,input_bit_registers0_to_31,input_bit_registers32_to_63",
        ),
        ("BOOL", "output_bit_register_64,output_bit_register_127,input_bit_register_64,input_bit_register_127"),
    ];
    let inputs = [
        ("INT32", "input_int_register_0,input_int_register_47"),
        (
            "DOUBLE",
            "input_double_register_0,input_double_register_47,speed_slider_fraction,standard_analog_output_0,\
          standard_analog_output_1",
        ),
        ("BOOL", "input_bit_register_64,input_bit_register_127"),
        ("UINT32", "input_bit_registers0_to_31,input_bit_registers32_to_63,speed_slider_mask"),
        (
            "UINT8",
            "standard_digital_output_mask,standard_digital_output,configurable_digital_output_mask,\
          configurable_digital_output,tool_digital_output_mask,tool_digital_output,standard_analog_output_mask,\
          standard_analog_output_type",
        ),
        ("VECTOR6D", "external_force_torque"),
    ];
    let (_handle, address) = start(Series::Cb3);
    for (kind, names) in table {
        let mut client = Rtde::new(address);
        client.ask(b'V', &[0, 2]);
        let count = names.split(',').count();
        assert_eq!(client.outputs(125.0, names), format!("1:{}", vec![kind; count].join(",")));
        client.ask(b'S', &[]);
        assert_eq!(client.data().len(), count * sizes[kind], "{names}");
    }
    for (kind, names) in inputs {
        let mut client = Rtde::new(address);
        client.ask(b'V', &[0, 2]);
        assert_eq!(client.inputs(names), format!("1:{}", vec![kind; names.split(',').count()].join(",")));
    }
    let types_on = |series, version, names: &str| {
        let mut options = ControllerOptions::new(crate::address());
        options.series = series;
        options.version = version;
        let at = options.address;
        let _handle = Controller::start(options).unwrap();
        let mut client = Rtde::new(at);
        client.ask(b'V', &[0, 2]);
        client.outputs(125.0, names)
    };
    let newer = "safety_status,payload,payload_inertia,script_control_line,ft_raw_wrench,output_int_register_24";
    assert_eq!(types_on(Series::Cb3, None, newer), "0:INT32,DOUBLE,VECTOR6D,UINT32,NOT_FOUND,INT32");
    assert_eq!(types_on(Series::ESeries, None, newer), "1:INT32,DOUBLE,VECTOR6D,UINT32,VECTOR6D,INT32");
    let old = Some(Version { major: 3, minor: 8, bugfix: 0, build: 1 });
    assert_eq!(types_on(Series::Cb3, old, newer), format!("0:{}", ["NOT_FOUND"; 6].join(",")));
}

// Protects ownership: one writer per variable across connections, several recipes within one, released when it leaves.
#[test]
fn one_client_owns_a_variable_until_it_leaves() {
    let (_handle, address) = start(Series::Cb3);
    let mut first = Rtde::new(address);
    assert_eq!(first.inputs("input_int_register_24"), "1:INT32");
    assert_eq!(first.inputs("input_int_register_24,input_int_register_25"), "2:INT32,INT32");
    let mut second = Rtde::new(address);
    assert_eq!(second.inputs("input_int_register_26,input_int_register_25"), "0:INT32,IN_USE");
    let mut third = Rtde::new(address);
    assert_eq!(third.inputs("input_int_register_26"), "1:INT32", "a refused recipe claims nothing");
    drop(first);
    until("ownership released", || second.inputs("input_int_register_24,input_int_register_25") != "0:IN_USE,IN_USE");
}

// Protects the others from a client that does not read: it is closed, they are served without a gap in their recipes. On
// 30003, which ur_rtde never reads, frames are left out instead and the connection stays.
#[test]
fn a_client_that_does_not_read_is_closed_and_others_are_not() {
    let (handle, address) = start(Series::ESeries);
    let lazy = Rtde::started(address, RECEIVE);
    let mut lazy_script = connect(address, 30003);
    let mut reader = Rtde::started(address, "timestamp,actual_q");
    until("both connected", || handle.state().unwrap().rtde_clients == 2);
    until("the lazy one gone", || {
        reader.data();
        handle.state().unwrap().rtde_clients == 1
    });
    reader.data();
    let mut rest = lazy.stream.try_clone().unwrap();
    let mut sink = Vec::new();
    // What the kernel had taken is still readable, then the connection ends.
    match rest.read_to_end(&mut sink) {
        Ok(_) => {}
        Err(e) => assert_eq!(e.kind(), ErrorKind::ConnectionReset),
    }
    lazy_script.write_all(COUNT.as_bytes()).unwrap();
    playing(&handle);
}

// Protects program life over sockets: upload on each script port, runtime_state, status bits, registers, stop, and the line
// of a mistake in the log.
#[test]
fn programs_run_from_every_script_port() {
    let (handle, address) = start(Series::Cb3);
    let mut client = Rtde::started(address, "runtime_state,robot_status_bits,output_int_register_24,script_control_line");
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

// Protects the state streams: sizes of the real-time frame, and packages of the primary interface that add up.
#[test]
fn state_streams_have_the_real_layout() {
    for (series, bytes) in [(Series::Cb3, 1140), (Series::ESeries, 1220)] {
        let (handle, address) = start(series);
        let mut realtime = connect(address, 30003);
        let mut frame = vec![0; bytes];
        for _ in 0..3 {
            realtime.read_exact(&mut frame).unwrap();
            assert_eq!(int(&frame, 0) as usize, bytes);
            let q = handle.joints().actual_q;
            assert_eq!(double(&frame, 252 + 8), q[1], "actual q of the shoulder");
            assert_eq!((double(&frame, 756), double(&frame, 812)), (7.0, 1.0), "robot mode, safety mode");
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

/// A dashboard client that has read the greeting.
struct Dashboard(BufReader<TcpStream>);

impl Dashboard {
    fn new(address: IpAddr) -> Self {
        let mut dashboard = Self(BufReader::new(connect(address, 29999)));
        assert_eq!(dashboard.line(), "Connected: Universal Robots Dashboard Server");
        dashboard
    }

    fn line(&mut self) -> String {
        let mut line = String::new();
        self.0.read_line(&mut line).unwrap();
        line.trim_end().to_owned()
    }

    fn ask(&mut self, command: &str) -> String {
        self.0.get_mut().write_all(format!("{command}\n").as_bytes()).unwrap();
        self.line()
    }
}

// Protects the dashboard's words, which clients compare letter by letter, and its part in power, programs and safety.
#[test]
fn the_dashboard_answers_in_urs_words() {
    let (handle, address) = start(Series::Cb3);
    let mut dashboard = Dashboard::new(address);
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
    let mut dashboard = Dashboard::new(address);
    assert_eq!(dashboard.ask("is in remote control"), "true");
    assert!(dashboard.ask("get serial number").bytes().all(|b| b.is_ascii_digit()));
    handle.inject(Fault::LocalControl);
    assert_eq!(dashboard.ask("is in remote control"), "false");
    assert_eq!(dashboard.ask("power off"), "Failed to execute: power off");
}

// Protects the operator's way into another process, and that each fault's text names that fault.
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
            Some((name, "CYCLES")) => format!("{name}={}", examples[1]),
            Some((name, "INPUT" | "VARIABLE")) => format!("{name}={}", examples[2]),
            Some((name, _)) => format!("{name}={}", examples[3]),
        };
        let fault: Fault = text.parse().unwrap();
        assert_eq!(fault.to_string(), text);
        seen += 1;
    }
    assert_eq!(seen, 24);
    for (text, error) in [
        ("explode", "no such fault"),
        ("stall", "needs a value"),
        ("stall=-1", "needs seconds"),
        ("fin=1", "takes no value"),
        ("speed-slider=0", "needs a share"),
        ("in-use=target_q", "needs the name of an RTDE input"),
    ] {
        assert!(text.parse::<Fault>().unwrap_err().to_string().contains(error), "{text}");
    }
    let (handle, address) = start(Series::Cb3);
    send_fault(address, &Fault::EmergencyStop).unwrap();
    until("emergency stop", || state(&handle).1 == SafetyMode::RobotEmergencyStop);
    // A fault that ends clients which came before the operator.
    let mut clients = [Rtde::started(address, "timestamp"), Rtde::started(address, "timestamp")];
    send_fault(address, &Fault::Fin).unwrap();
    for client in &mut clients {
        while client.frame().unwrap().is_some() {}
    }
    send_fault(address, &Fault::EmergencyRelease).unwrap();
    drop(handle);
    assert!(send_fault(address, &Fault::Fin).unwrap_err().to_string().contains("no simulated controller answers"));
}

// Protects clean shutdown and isolation: several controllers at once, each address free again when its handle is dropped.
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
        let mut client = Rtde::started(addresses[2], "timestamp");
        client.data();
        drop(handles);
        while let Ok(Some(_)) = client.frame() {}
        assert!(TcpStream::connect(SocketAddr::new(addresses[2], 30004)).is_err());
    }
}

// Protects fault "fin": the stream ends in order and the robot goes on; a new connection works.
#[test]
fn fault_fin_ends_rtde_connections_in_order() {
    let (handle, address) = start(Series::Cb3);
    let mut client = Rtde::started(address, "timestamp");
    upload(address, COUNT);
    playing(&handle);
    handle.inject(Fault::Fin);
    while client.frame().unwrap().is_some() {}
    assert_eq!(state(&handle).2, RuntimeState::Playing);
    Rtde::started(address, "timestamp").data();
}

// Protects fault "reset": the stream is aborted, not closed in order.
#[test]
fn fault_reset_aborts_rtde_connections() {
    let (handle, address) = start(Series::Cb3);
    let mut client = Rtde::started(address, "timestamp");
    client.data();
    handle.inject(Fault::Reset);
    let error = loop {
        match client.frame() {
            Ok(Some(_)) => {}
            Ok(None) => panic!("closed in order"),
            Err(error) => break error,
        }
    };
    assert_eq!(error.kind(), ErrorKind::ConnectionReset);
    Rtde::started(address, "timestamp").data();
}

// Protects fault "offline": everything closes and nobody answers, then everything is back.
#[test]
fn fault_offline_closes_all_ports_for_a_while() {
    let (handle, address) = start(Series::Cb3);
    let mut client = Rtde::started(address, "timestamp");
    handle.inject(Fault::Offline(600.0));
    while let Ok(Some(_)) = client.frame() {}
    for port in [29999, 30001, 30002, 30003, 30004] {
        assert_eq!(TcpStream::connect(SocketAddr::new(address, port)).unwrap_err().kind(), ErrorKind::ConnectionRefused);
    }
    send_fault(address, &Fault::Clear).unwrap();
    until("back", || TcpStream::connect(SocketAddr::new(address, 30004)).is_ok());
    Rtde::started(address, "timestamp").data();
    Dashboard::new(address);
}

// Protects fault "stall": the socket stays open, nothing comes and nothing is taken; afterwards the stream goes on with a gap
// in the timestamps.
#[test]
fn fault_stall_is_silent_and_deaf() {
    let (handle, address) = start(Series::Cb3);
    let mut client = Rtde::started(address, "timestamp,input_int_register_24");
    assert_eq!(client.inputs("input_int_register_24"), "1:INT32");
    let before = double(&client.data(), 0);
    handle.inject(Fault::Stall(0.4));
    client.stream.write_all(&hex("0008550100000007")).unwrap();
    let mut stamps = vec![before];
    let mut data = client.data();
    while stamps.windows(2).all(|w| w[1] - w[0] < 0.3) {
        // No frame before the gap may know the write.
        assert_eq!(int(&data, 8), 0);
        stamps.push(double(&data, 0));
        data = client.data();
    }
    until("the write arrives in the end", || int(&client.data(), 8) == 7);
}

// Protects fault "freeze": frames keep coming, but it is always the same one; the robot itself goes on.
#[test]
fn fault_freeze_repeats_one_frame() {
    let (handle, address) = start(Series::Cb3);
    upload(address, COUNT);
    playing(&handle);
    let mut client = Rtde::started(address, "timestamp,output_int_register_24");
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

// Protects fault "slow-reader": inputs are taken late and then all, outputs keep coming.
#[test]
fn fault_slow_reader_takes_inputs_late() {
    let (handle, address) = start(Series::Cb3);
    let mut client = Rtde::started(address, "timestamp,input_int_register_24");
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

// Protects fault "skip-outputs": a gap of that many cycles in the timestamps, nothing sent twice or late.
#[test]
fn fault_skip_outputs_leaves_a_gap() {
    let (handle, address) = start(Series::Cb3);
    let mut client = Rtde::started(address, "timestamp");
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

// Protects faults "split" and "coalesce": the frames are whole and in order for a client that reassembles, and the pieces on
// the wire are not frames.
#[test]
fn faults_split_and_coalesce_keep_the_bytes() {
    let (handle, address) = start(Series::Cb3);
    let mut client = Rtde::started(address, "timestamp,actual_q,robot_mode");
    let frame = 4 + 8 + 48 + 4;
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
            assert_eq!((data.len(), int(&data, 56)), (frame - 4, 7), "{fault}");
            seen += 1;
        }
        match fault {
            Fault::Split(_) => assert!(client.pieces.iter().filter(|p| *p % frame != 0).count() > 20, "{:?}", client.pieces),
            Fault::Coalesce(_) => assert!(client.pieces.iter().filter(|p| **p == 4 * frame).count() >= 8, "{:?}", client.pieces),
            _ => {}
        }
    }
}

// Protects faults "in-use", "not-found", "refuse-version-2" and their end by "clear".
#[test]
fn faults_that_refuse_a_setup() {
    let (handle, address) = start(Series::Cb3);
    for fault in ["in-use=input_int_register_24", "not-found=actual_q", "not-found=input_double_register_24", "refuse-version-2"] {
        handle.inject(fault.parse().unwrap());
    }
    let mut client = Rtde::new(address);
    assert_eq!(client.ask(b'V', &[0, 2]), hex("00045600"));
    assert_eq!(client.ask(b'V', &[0, 1]), hex("00045601"));
    assert_eq!(client.inputs("input_int_register_24,input_int_register_25"), "0:IN_USE,INT32");
    assert_eq!(client.inputs("input_double_register_24"), "0:NOT_FOUND");
    assert_eq!(&client.ask(b'O', b"timestamp,actual_q")[3..], b"DOUBLE,NOT_FOUND");
    handle.inject(Fault::Clear);
    let mut client = Rtde::started(address, "timestamp,actual_q");
    assert_eq!(client.inputs("input_int_register_24,input_double_register_24"), "1:INT32,DOUBLE");
}

// Protects fault "text": at any moment, between data frames, in the layout of the session's version; and on connecting, before
// the first answer.
#[test]
fn faults_text_comes_at_any_moment() {
    let (handle, address) = start(Series::Cb3);
    let mut client = Rtde::started(address, "timestamp");
    handle.inject(Fault::Text("careful".to_owned()));
    assert_eq!(&client.answer(b'M')[3..], b"\x07careful\x04RTDE\x02");
    client.data();
    handle.inject(Fault::TextOnConnect("SafetySetup has not been confirmed yet".to_owned()));
    let mut client = Rtde::new(address);
    client.send(b'V', &[0, 2]);
    assert_eq!(client.frame().unwrap().unwrap()[2], b'M');
    assert_eq!(client.frame().unwrap().unwrap(), hex("00045601"));
}

// Protects faults of the robot itself as a client sees them: protective stop, emergency stop and release, pause and stop on
// the pendant, late start.
#[test]
fn faults_of_the_robot_show_in_its_state() {
    let (handle, address) = start(Series::Cb3);
    let mut client = Rtde::started(address, "robot_mode,safety_mode,runtime_state,safety_status_bits,timestamp");
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
    let mut dashboard = Dashboard::new(address);
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

// Protects what the cell's physics reads: joints and trace follow the program, with the watched register beside them.
#[test]
fn joints_and_trace_follow_the_program() {
    let (handle, address) = start(Series::Cb3);
    let mut client = Rtde::new(address);
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
