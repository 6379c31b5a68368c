//! The programs that are run beside the cell: cyclictest, the yardstick, and stress-ng, the load.
//!
//! Ordinary thread; allocates and blocks. `scripts/jitter` installs both programs.

use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::time::Duration;

use crate::own_cell::{OwnCell, OwnCellError};

/// A program that is ended when it goes out of scope.
pub struct Running(pub Child);

impl Drop for Running {
    fn drop(&mut self) {
        // stress-ng ends its own workers on SIGTERM, not on SIGKILL.
        let _ = rustix::process::kill_process(rustix::process::Pid::from_child(&self.0), rustix::process::Signal::TERM);
        let _ = self.0.wait();
    }
}

/// Puts load on two cores, memory and disk until it is dropped.
///
/// # Errors
/// When stress-ng cannot be started.
pub fn load() -> Result<Running, OwnCellError> {
    stress("--cpu 2 --vm 1 --vm-bytes 128M --io 1 --hdd 1 --hdd-bytes 64M", &std::env::temp_dir())
}

/// Makes the disk of a directory slow, until it is dropped: each small write is on the disk before the next.
///
/// # Errors
/// When stress-ng cannot be started.
pub fn slow_disk(directory: &Path) -> Result<Running, OwnCellError> {
    stress("--hdd 1 --hdd-bytes 64M --hdd-write-size 4K --hdd-opts wr-seq,fsync", directory)
}

/// Runs stress-ng with these words, its files in `directory`.
fn stress(words: &str, directory: &Path) -> Result<Running, OwnCellError> {
    let child = Command::new("stress-ng")
        .args(words.split(' '))
        .args(["--quiet", "--temp-path"])
        .arg(directory)
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .map_err(missing("stress-ng (package stress-ng)"))?;
    Ok(Running(child))
}

/// Starts cyclictest like the loop, with one reading a line, for `time`; its priority is lower than the loop's by `below`.
///
/// # Errors
/// When cyclictest cannot be started.
pub fn cyclictest(cell: &OwnCell, time: Duration, below: u8) -> Result<Child, OwnCellError> {
    let c = &cell.config.controller;
    let interval_us = (1e6 / c.rate_hz) as u64;
    Command::new("cyclictest")
        .args(["--mlockall", "--nsecs", "--verbose", "--threads=1"])
        .arg(format!("--priority={}", c.priority.saturating_sub(below)))
        .arg(format!("--affinity={}", c.core))
        .arg(format!("--interval={interval_us}"))
        .arg(format!("--loops={}", time.as_micros() as u64 / interval_us))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .map_err(missing("cyclictest (package rt-tests)"))
}

/// The wake-up latencies in cyclictest's output, us.
pub fn latencies_us(output: &[u8]) -> Vec<f64> {
    let text = String::from_utf8_lossy(output);
    let reading = |line: &str| {
        let mut columns = line.split(':').map(str::trim);
        let (thread, _, latency_ns) = (columns.next()?, columns.next()?, columns.next()?);
        thread.parse::<u32>().ok()?;
        latency_ns.parse::<f64>().ok().map(|ns| ns / 1e3)
    };
    text.lines().filter_map(reading).collect()
}

/// The error for a program that cannot be started.
fn missing(what: &str) -> impl FnOnce(std::io::Error) -> OwnCellError {
    move |error| OwnCellError::File { what: what.into(), error }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the ratios: cyclictest's readings are read in its own layout, and its headings are not.
    #[test]
    fn readings_of_cyclictest_are_read() {
        let output = b"# /dev/cpu_dma_latency set to 0us\nMax CPUs = 1\n       0:       0:    8417\n       0:       1:   12050\n";
        assert_eq!(latencies_us(output), [8.417, 12.05]);
    }
}
