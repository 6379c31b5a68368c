//! `experiments bare-loop`: the yardstick of the controller's tick, for `experiments jitter`, which runs it as a process of its own.
//!
//! Ordinary process with one real-time thread; allocates before its first tick. It prints one line for each tick, its execution in us, or
//! ends with one line that says what failed.

use shared::exit::{FAILED, Failure, failure};

use crate::jitter::bare_loop::{self, BareLoop};

/// Runs the command.
pub fn run(settings: &BareLoop) -> Result<(), Failure> {
    let times_us = bare_loop::measure(settings).map_err(|e| failure(FAILED, format!("the bare loop's sockets: {e}")))?;
    let lines: String = times_us.iter().map(|t| format!("{t:.3}\n")).collect();
    print!("{lines}");
    Ok(())
}
