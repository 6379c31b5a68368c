//! What the controller's thread publishes for the owner of the controller: the joints, the state, the log, and a motion trace.
//!
//! The controller's thread writes once a control cycle; any thread reads. Each part has a lock that is held for a copy only.
//! Allocates within bounds, and cannot fail.

use std::sync::{Mutex, MutexGuard, PoisonError};

use super::log::{self, LogLine};
use super::machine::{Machine, SafetyMode};
use super::power::RobotMode;
use super::program::RuntimeState;
use super::registers::NUMBERS;

/// Most rows of a motion trace: ten minutes of an e-Series, which is longer than any test here.
const MAX_TRACE_ROWS: usize = 300_000;

/// The six joints at the end of a control cycle, base to wrist 3.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Joints {
    /// Where the trajectory is, in rad.
    pub target_q: [f64; 6],
    /// The trajectory's speed in rad/s.
    pub target_qd: [f64; 6],
    /// Where the joints are, in rad.
    pub actual_q: [f64; 6],
    /// The joints' speed in rad/s.
    pub actual_qd: [f64; 6],
    /// Time of that cycle in ns, on CLOCK_MONOTONIC.
    pub at_ns: u64,
}

/// What the controller is doing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ControllerState {
    /// State of power and brakes.
    pub robot_mode: RobotMode,
    /// What keeps the arm from moving.
    pub safety_mode: SafetyMode,
    /// State of the program.
    pub runtime_state: RuntimeState,
    /// Name of the running or last program; empty before the first.
    pub program: String,
    /// Number of connections on port 30004.
    pub rtde_clients: usize,
}

/// One control cycle of a motion trace. Angles are in rad, speeds in rad/s, base to wrist 3.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TraceRow {
    /// Controller time in s.
    pub timestamp_s: f64,
    /// Value of the watched input register: the client's target, as it arrived.
    pub register: f64,
    /// The joint angles that the last servoj or movej asked for.
    pub commanded_q: [f64; 6],
    /// Number of calls of servoj so far.
    pub servoj_calls: u64,
    /// True while servoj moves the joints; false while they stand or something else moves them.
    pub servoing: bool,
    /// Where the trajectory is.
    pub target_q: [f64; 6],
    /// The trajectory's speed.
    pub target_qd: [f64; 6],
    /// Where the joints are.
    pub actual_q: [f64; 6],
    /// The joints' speed.
    pub actual_qd: [f64; 6],
}

#[derive(Debug)]
struct MotionTrace {
    double_register: usize,
    rows: Vec<TraceRow>,
}

/// What the controller's thread and the owner of the controller share.
#[derive(Debug, Default)]
pub struct Published {
    joints: Mutex<Joints>,
    state: Mutex<Option<ControllerState>>,
    log: Mutex<Vec<LogLine>>,
    trace: Mutex<Option<MotionTrace>>,
}

/// Locks `mutex`. Nothing is left half-written under these locks, so a holder that panicked is no reason to stop.
fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

impl Published {
    /// Publishes the joints and the state at the cycle of time `at_ns`.
    pub fn publish(&self, machine: &Machine, rtde_clients: usize, at_ns: u64) {
        let servo = &machine.robot.servo;
        *lock(&self.joints) =
            Joints { target_q: servo.target_q, target_qd: servo.target_qd, actual_q: servo.actual_q, actual_qd: servo.actual_qd, at_ns };
        *lock(&self.state) = Some(ControllerState {
            robot_mode: machine.robot_mode(),
            safety_mode: machine.safety_mode(),
            runtime_state: machine.runtime_state(),
            program: machine.program_name().to_owned(),
            rtde_clients,
        });
    }

    /// Adds the present cycle to the motion trace, if one is running and not full.
    pub fn trace(&self, machine: &Machine) {
        let mut trace = lock(&self.trace);
        let Some(trace) = trace.as_mut().filter(|t| t.rows.len() < MAX_TRACE_ROWS) else { return };
        let servo = &machine.robot.servo;
        trace.rows.push(TraceRow {
            timestamp_s: machine.robot.timestamp_s(),
            register: machine.robot.inputs.double[trace.double_register],
            commanded_q: servo.commanded_q,
            servoj_calls: servo.servoj_calls,
            servoing: servo.is_servoing(),
            target_q: servo.target_q,
            target_qd: servo.target_qd,
            actual_q: servo.actual_q,
            actual_qd: servo.actual_qd,
        });
    }

    /// Appends log lines. Not every owner takes them, so the oldest ones go when there are too many.
    pub fn log(&self, lines: Vec<LogLine>) {
        let mut log = lock(&self.log);
        log.extend(lines);
        let over = log.len().saturating_sub(log::MAX_LINES);
        log.drain(..over);
    }

    /// The newest joints.
    pub fn joints(&self) -> Joints {
        *lock(&self.joints)
    }

    /// The newest state; None before the first.
    pub fn state(&self) -> Option<ControllerState> {
        lock(&self.state).clone()
    }

    /// Takes the log lines.
    pub fn take_log(&self) -> Vec<LogLine> {
        std::mem::take(&mut *lock(&self.log))
    }

    /// Starts a motion trace that watches input double register `double_register` (0 to 47).
    pub fn start_trace(&self, double_register: usize) {
        *lock(&self.trace) = Some(MotionTrace { double_register: double_register.min(NUMBERS - 1), rows: Vec::new() });
    }

    /// Ends the motion trace and gives its rows; none if no trace was started.
    pub fn take_trace(&self) -> Vec<TraceRow> {
        lock(&self.trace).take().map_or_else(Vec::new, |t| t.rows)
    }
}
