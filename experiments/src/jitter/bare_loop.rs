//! The yardstick of a tick's execution: a loop that does nothing but the system calls of the controller's loop.
//!
//! It runs as a process of its own (`experiments bare-loop`), like the controller: one real-time thread with the same core, priority and
//! rate, and locked memory. A peer sends it states as a robot does, over TCP on the loopback interface, as many as the cell's robot, and reads its targets. A tick
//! receives what has arrived, sends one target and counts page faults; what else the controller's tick takes is the controller's own.
//!
//! The loop's thread allocates nothing between its first tick and its last. A socket that breaks ends it with one line.

use std::io::{ErrorKind, Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::process::{Command, Stdio};
use std::time::Duration;

use rt_controller::link::wire;
use shared::config::Config;
use shared::os;

use crate::own_cell::{OwnCell, OwnCellError, off_core};

/// Largest number of bytes that one tick receives: as in the controller's inbox.
const RECEIVE_MAX: usize = 1 << 16;

/// How a bare loop is to run; its command line.
#[derive(Debug, Clone, clap::Args)]
pub struct BareLoop {
    /// Core of the loop.
    #[arg(long)]
    core: usize,
    /// SCHED_FIFO priority of the loop; 0 is ordinary scheduling.
    #[arg(long)]
    priority: u8,
    /// Rate of the loop, Hz.
    #[arg(long)]
    rate_hz: f64,
    /// Number of ticks.
    #[arg(long)]
    ticks: usize,
    /// Rate at which the peer sends states, Hz.
    #[arg(long)]
    states_hz: u64,
}

/// Execution of each tick of a bare loop that runs like the cell's loop for `time` and gets `states_hz` states a second, us.
///
/// # Errors
/// When the process cannot be started or ends early, or Ctrl-C is pressed.
pub fn run(cell: &OwnCell, time: Duration, states_hz: u64) -> Result<Vec<f64>, OwnCellError> {
    let c: &Config = &cell.config;
    let ticks = (time.as_secs_f64() * c.controller.rate_hz) as u64;
    let words = [
        ("--core", c.controller.core.to_string()),
        ("--priority", c.controller.priority.to_string()),
        ("--rate-hz", c.controller.rate_hz.to_string()),
        ("--ticks", ticks.to_string()),
        ("--states-hz", states_hz.to_string()),
    ];
    let mut command = Command::new(cell.bin.join("experiments"));
    command.arg("bare-loop").stdin(Stdio::null());
    for (flag, value) in words {
        command.arg(flag).arg(value);
    }
    let output = command.output().map_err(|error| OwnCellError::File { what: "experiments bare-loop".into(), error })?;
    cell.succeeded("experiments bare-loop", output.status, &String::from_utf8_lossy(&output.stderr))?;
    Ok(String::from_utf8_lossy(&output.stdout).lines().filter_map(|line| line.parse().ok()).collect())
}

/// Runs the loop in this process; gives the execution of each tick, us.
///
/// # Errors
/// When a socket cannot be opened or breaks.
pub fn measure(settings: &BareLoop) -> std::io::Result<Vec<f64>> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, 0))?;
    let mut socket = TcpStream::connect(listener.local_addr()?)?;
    let (robot, _) = listener.accept()?;
    socket.set_nodelay(true)?;
    robot.set_nodelay(true)?;
    socket.set_nonblocking(true)?;
    let reader = robot.try_clone()?;
    // Both end when the loop closes its socket. Which core they run on decides what a send costs the loop, so it is the same in each run.
    let states_hz = settings.states_hz;
    off_core(settings.core, move || {
        std::thread::spawn(move || send_states(robot, states_hz));
        std::thread::spawn(move || read_targets(reader));
    });
    let mut buffer = vec![0; RECEIVE_MAX];
    let mut times_us = vec![0.0; settings.ticks];
    // What is refused here is refused to the controller too, which says so.
    let _ = os::lock_memory();
    let _ = os::become_realtime(settings.core, settings.priority);
    let period_ns = (1e9 / settings.rate_hz) as u64;
    let mut deadline_ns = os::now_ns() + period_ns;
    for (k, time_us) in times_us.iter_mut().enumerate() {
        os::sleep_until_ns(deadline_ns);
        let woke_ns = os::now_ns();
        tick(&mut socket, &mut buffer, k as i32)?;
        *time_us = os::now_ns().saturating_sub(woke_ns) as f64 / 1e3;
        deadline_ns += period_ns;
    }
    Ok(times_us)
}

/// The system calls of one tick.
fn tick(socket: &mut TcpStream, buffer: &mut [u8], sequence: i32) -> std::io::Result<()> {
    match socket.read(buffer) {
        Ok(0) => return Err(ErrorKind::UnexpectedEof.into()),
        Err(e) if e.kind() != ErrorKind::WouldBlock => return Err(e),
        _ => {}
    }
    socket.write_all(&wire::encode_target(1, sequence, 2, 0.0))?;
    let _ = os::page_faults();
    Ok(())
}

/// Sends states of a robot's size until nobody reads them.
fn send_states(mut robot: TcpStream, states_hz: u64) {
    let state = vec![0; wire::STATE_LEN];
    let mut next_ns = os::now_ns();
    while robot.write_all(&state).is_ok() {
        next_ns += 1_000_000_000 / states_hz.max(1);
        std::thread::sleep(Duration::from_nanos(next_ns.saturating_sub(os::now_ns())));
    }
}

/// Reads targets, one at a time as a robot does, until none come any more.
fn read_targets(mut robot: TcpStream) {
    let mut target = [0; wire::TARGET_LEN];
    while robot.read_exact(&mut target).is_ok() {}
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the yardstick: it ticks as often as it is asked to, and each tick takes time and less than a period.
    #[test]
    fn a_bare_loop_measures_each_tick() {
        let settings = BareLoop { core: 0, priority: 0, rate_hz: 200.0, ticks: 40, states_hz: 500 };
        let times_us = measure(&settings).unwrap();
        assert_eq!(times_us.len(), 40);
        assert!(times_us.iter().all(|t| *t > 0.0));
    }
}
