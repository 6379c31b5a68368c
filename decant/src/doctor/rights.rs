//! What the controller may do, or a process of this user if none runs, and whether the cores of the configuration are there.
//!
//! Called once by an ordinary thread; allocates; nothing fails.

use rt_controller::claim;
use shared::config::Config;
use shared::machine::{Finding, in_list, read};
use shared::runtime_dir::Place;

/// The bit of CAP_IPC_LOCK, which lifts the limit on locked memory (capabilities(7)).
const CAP_IPC_LOCK: u32 = 14;
/// The bit of CAP_SYS_NICE, which permits any priority (capabilities(7)).
const CAP_SYS_NICE: u32 = 23;
/// Memory that the controller locks, bytes: docs/REALTIME.md measures 18 MiB, and this leaves room.
const LOCKED_BYTES: u64 = 64 << 20;

/// A process whose rights are looked at.
struct Process {
    /// Its directory in `/proc`.
    directory: String,
    /// Who it is, in words.
    who: String,
}

impl Process {
    /// The cell's controller if it runs, else this process.
    fn of(config: &Config) -> Self {
        match claim::running_at(&Place::from(&config.cell)).ok().flatten() {
            Some(running) => Self { directory: format!("/proc/{}", running.pid), who: format!("the controller (process {})", running.pid) },
            None => Self { directory: "/proc/self".into(), who: "a process started here".into() },
        }
    }

    /// Whether it has a capability.
    fn may(&self, capability: u32) -> bool {
        let status = read(&format!("{}/status", self.directory));
        let mask = status.lines().find_map(|l| l.strip_prefix("CapEff:")).and_then(|m| u64::from_str_radix(m.trim(), 16).ok());
        mask.is_some_and(|m| m >> capability & 1 == 1)
    }

    /// Its soft limit of this name in proc(5); `None` if it is unlimited or not shown.
    fn limit(&self, name: &str) -> Option<u64> {
        let limits = read(&format!("{}/limits", self.directory));
        limits.lines().find_map(|l| l.strip_prefix(name)).and_then(|l| l.split_whitespace().next()?.parse().ok())
    }
}

/// Looks at priority, locked memory and cores.
pub fn look(config: &Config) -> Vec<Finding> {
    let process = Process::of(config);
    vec![priority(config, &process), memory(&process), cores(config)]
}

fn priority(config: &Config, process: &Process) -> Finding {
    let wanted = config.controller.priority.max(config.worker.priority);
    if config.controller.priority == 0 {
        let advice = "set controller.priority to 80, and worker.priority to 70";
        return Finding::yellow("real-time priority", "0 is configured", "anything that runs can delay the loop", advice);
    }
    let who = &process.who;
    if process.may(CAP_SYS_NICE) {
        return Finding::green("real-time priority", format!("SCHED_FIFO {wanted} is wanted; {who} may have any (CAP_SYS_NICE)"));
    }
    let limit = process.limit("Max realtime priority");
    let is = format!("SCHED_FIFO {wanted} is wanted; {who} may have {}", limit.map_or("any".into(), |l| l.to_string()));
    if limit.is_none_or(|l| l >= u64::from(wanted)) {
        return Finding::green("real-time priority", is);
    }
    let advice = "LimitRTPRIO= of the service, or a line 'decant - rtprio 95' in /etc/security/limits.d, and log in again";
    Finding::yellow("real-time priority", is, "the loop runs with ordinary priority and is late under load", advice)
}

fn memory(process: &Process) -> Finding {
    let limit = process.limit("Max locked memory").filter(|_| !process.may(CAP_IPC_LOCK));
    let is = format!("{} may lock {}", process.who, limit.map_or("all of it".into(), |bytes| format!("{} MiB", bytes >> 20)));
    if limit.is_none_or(|bytes| bytes >= LOCKED_BYTES) {
        return Finding::green("locked memory", is);
    }
    let advice = "LimitMEMLOCK=infinity of the service, or a line 'decant - memlock unlimited' in /etc/security/limits.d";
    Finding::yellow("locked memory", is, "memory that was swapped out delays a tick", advice)
}

fn cores(config: &Config) -> Finding {
    let (controller, worker) = (config.controller.core, config.worker.core);
    let is = format!("loop on {controller}, worker on {worker}");
    let there = std::thread::available_parallelism().map_or(1, usize::from);
    let list = read("/sys/devices/system/cpu/online");
    let online = |core: usize| if list.trim().is_empty() { core < there } else { in_list(&list, core) };
    if !online(controller) || !online(worker) {
        let advice = "set controller.core and worker.core to cores that there are";
        return Finding::yellow(
            "cores",
            format!("{is}, of {there}"),
            "a process is not pinned, and may share a core with the other",
            advice,
        );
    }
    if controller == worker {
        let advice = "give controller.core and worker.core a core each";
        return Finding::yellow("cores", is, "the extraction delays the loop", advice);
    }
    Finding::green("cores", is)
}
