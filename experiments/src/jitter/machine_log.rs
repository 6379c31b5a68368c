//! What the machine did while the cell ran, so that its worst ticks can be explained.
//!
//! A thread of its own reads `/proc/stat` and the loop thread's counters ten times a second; it allocates and sleeps. What cannot be read
//! is 0.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use serde_json::{Value, json};
use shared::os::now_ns;

/// Time between two readings: far finer than a person can act, and 1,000 times cheaper than what it watches.
const EVERY: Duration = Duration::from_millis(100);

/// Counters of the machine, and of the loop's thread, at one moment.
#[derive(Debug, Clone, Copy, Default)]
struct Counters {
    at_ns: u64,
    interrupts: u64,
    switches: u64,
    /// Time that the host took from this virtual machine, in the kernel's ticks of 10 ms.
    steal: u64,
    /// How often another thread took the processor from the loop's thread.
    preempted: u64,
}

/// What the machine did in the time between two readings.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct Activity {
    /// Length of the time, ms.
    pub ms: f64,
    /// Interrupts, 1/s, all cores.
    pub interrupts_per_s: f64,
    /// Context switches, 1/s, all cores.
    pub switches_per_s: f64,
    /// Time that the host took, ms.
    pub steal_ms: f64,
    /// How often another thread took the processor from the loop's thread.
    pub preempted: u64,
}

impl Activity {
    /// For `jitter.json`.
    pub fn json(&self) -> Value {
        json!({
            "ms": self.ms, "interrupts_per_s": self.interrupts_per_s, "context_switches_per_s": self.switches_per_s,
            "steal_ms": self.steal_ms, "loop_preempted": self.preempted,
        })
    }
}

impl Counters {
    /// Reads the counters; `loop_status` is the path of the loop thread's status.
    fn read(loop_status: Option<&str>) -> Self {
        let stat = std::fs::read_to_string("/proc/stat").unwrap_or_default();
        let field = |key: &str, n: usize| -> u64 {
            let line = stat.lines().find(|l| l.split_whitespace().next() == Some(key));
            line.and_then(|l| l.split_whitespace().nth(n)).and_then(|w| w.parse().ok()).unwrap_or(0)
        };
        let status = loop_status.and_then(|p| std::fs::read_to_string(p).ok()).unwrap_or_default();
        let preempted = status.lines().find_map(|l| l.strip_prefix("nonvoluntary_ctxt_switches:")).and_then(|n| n.trim().parse().ok());
        Self {
            at_ns: now_ns(),
            interrupts: field("intr", 1),
            switches: field("ctxt", 1),
            steal: field("cpu", 8),
            preempted: preempted.unwrap_or(0),
        }
    }
}

/// The readings of a run, made by a thread until it is stopped.
pub struct MachineLog {
    stop: Arc<AtomicBool>,
    thread: JoinHandle<Vec<Counters>>,
}

impl MachineLog {
    /// Begins to read. `pid` is the controller's; its loop is the thread with real-time scheduling.
    pub fn start(pid: Option<u32>) -> Self {
        let stop = Arc::new(AtomicBool::new(false));
        let told = Arc::clone(&stop);
        let thread = std::thread::spawn(move || {
            let status = pid.and_then(loop_thread).map(|task| format!("{task}/status"));
            let mut readings = Vec::new();
            while !told.load(Ordering::Relaxed) {
                readings.push(Counters::read(status.as_deref()));
                std::thread::sleep(EVERY);
            }
            readings.push(Counters::read(status.as_deref()));
            readings
        });
        Self { stop, thread }
    }

    /// Ends the thread and gives what the machine did around each of `times_ns`; `None` for a time outside of the log.
    pub fn around(self, times_ns: &[u64]) -> Vec<Option<Activity>> {
        self.stop.store(true, Ordering::Relaxed);
        let readings = self.thread.join().unwrap_or_default();
        times_ns.iter().map(|at_ns| readings.windows(2).find(|w| (w[0].at_ns..w[1].at_ns).contains(at_ns)).map(between)).collect()
    }
}

fn between(readings: &[Counters]) -> Activity {
    let (a, b) = (readings[0], readings[readings.len() - 1]);
    let s = (b.at_ns - a.at_ns).max(1) as f64 / 1e9;
    Activity {
        ms: s * 1e3,
        interrupts_per_s: b.interrupts.saturating_sub(a.interrupts) as f64 / s,
        switches_per_s: b.switches.saturating_sub(a.switches) as f64 / s,
        steal_ms: b.steal.saturating_sub(a.steal) as f64 * 10.0,
        preempted: b.preempted.saturating_sub(a.preempted),
    }
}

/// The directory in `/proc` of the loop's thread: the process's thread with the highest real-time priority; `None` if it has none.
fn loop_thread(pid: u32) -> Option<String> {
    let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).ok()?;
    let priority = |task: &str| -> Option<u64> {
        let stat = std::fs::read_to_string(format!("{task}/stat")).ok()?;
        // The name in parentheses may hold spaces; rt_priority is field 40, and the first behind the name is field 3.
        stat.rsplit_once(')')?.1.split_whitespace().nth(40 - 3)?.parse().ok()
    };
    let found = tasks.flatten().map(|task| task.path().display().to_string()).filter_map(|task| Some((priority(&task)?, task)));
    found.max().filter(|(priority, _)| *priority > 0).map(|(_, task)| task)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the explanation of a worst tick: what happened between two readings is their difference, by its time.
    #[test]
    fn activity_is_the_difference_of_two_readings() {
        let a = Counters { at_ns: 1_000_000_000, interrupts: 100, switches: 50, steal: 3, preempted: 7 };
        let b = Counters { at_ns: 1_500_000_000, interrupts: 600, switches: 150, steal: 5, preempted: 8 };
        let want = Activity { ms: 500.0, interrupts_per_s: 1000.0, switches_per_s: 200.0, steal_ms: 20.0, preempted: 1 };
        assert_eq!(between(&[a, b]), want);
    }

    /// Protects the log itself, on this kernel: interrupts and context switches of a running machine are seen.
    #[test]
    fn the_kernel_counts() {
        let log = MachineLog::start(Some(std::process::id()));
        std::thread::sleep(3 * EVERY);
        let activity = log.around(&[now_ns() - 50_000_000, 1]);
        assert!(activity[0].is_some_and(|a| a.switches_per_s > 0.0 && a.interrupts_per_s > 0.0), "{activity:?}");
        assert_eq!(activity[1], None);
    }
}
