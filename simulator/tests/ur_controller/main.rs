//! The simulated controller over real sockets: bytes as logged from real clients, ownership, the life of programs, and faults.
//!
//! Every test has a loopback address of its own. No test asserts how long something takes.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

mod client;
mod fault_injection;
mod interfaces;
mod rtde_protocol;
mod ur_rtde_bytes;

use std::io::{Read, Write};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpStream};
use std::sync::atomic::{AtomicU8, Ordering};
use std::time::{Duration, Instant};

use simulator::ur::{Controller, ControllerOptions, RobotMode, RuntimeState, SafetyMode, Series};

/// How long to wait for something that should come. Chosen by hand, far above what any test needs.
const PATIENCE: Duration = Duration::from_secs(20);

/// An address that no other test uses, and most likely no other process.
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

/// The variables that the receive interface of ur_rtde 1.6.5 asks a CB3 3.15 for.
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
