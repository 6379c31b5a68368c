//! The simulated controller without sockets: URScript, programs, the arm, safety and power, stepped cycle by cycle.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

mod arm_and_safety;
mod language;
mod program_life;
mod random_input;
mod rtde_session;
mod slowed_and_by_hand;

use simulator::ur::{LogKind, LogLine, Machine, Series};

/// Where the joints stand at the start, in rad, base to wrist 3.
const START_Q: [f64; 6] = [0.0, -1.5, 1.5, -1.5, -1.5, 0.25];

/// Cycles from upload to the first statement on a CB3 (48 ms).
const START_CYCLES: usize = 6;

fn machine(series: Series) -> Machine {
    Machine::new(series, series.default_version(), START_Q)
}

fn steps(machine: &mut Machine, cycles: usize) {
    (0..cycles).for_each(|_| machine.step());
}

/// A CB3 after it has run `body` as a program for `cycles` cycles, and what it logged.
fn run(body: &str, cycles: usize) -> (Machine, Vec<LogLine>) {
    let mut machine = machine(Series::Cb3);
    machine.upload(&format!("def test():\n{body}\nend\n"));
    steps(&mut machine, START_CYCLES + cycles);
    let log = machine.take_log().collect();
    (machine, log)
}

fn lines(log: &[LogLine], kind: LogKind) -> Vec<&str> {
    log.iter().filter(|l| l.kind == kind).map(|l| l.text.as_str()).collect()
}
