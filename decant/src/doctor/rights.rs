//! What this user may do, and whether the cores of the configuration are there.
//!
//! Called once by an ordinary thread; allocates; nothing fails.

use rustix::process::{Resource, getrlimit};
use shared::config::Config;
use shared::machine::{Finding, read};

/// The bit of CAP_IPC_LOCK, which lifts the limit on locked memory (capabilities(7)).
const CAP_IPC_LOCK: u32 = 14;
/// The bit of CAP_SYS_NICE, which permits any priority (capabilities(7)).
const CAP_SYS_NICE: u32 = 23;
/// Memory that the controller locks, bytes: docs/REALTIME.md measures 18 MiB, and this leaves room.
const LOCKED_BYTES: u64 = 64 << 20;

/// Looks at priority, locked memory and cores.
pub fn look(config: &Config) -> Vec<Finding> {
    vec![priority(config), memory(), cores(config)]
}

/// Whether this process has a capability.
fn may(capability: u32) -> bool {
    let status = read("/proc/self/status");
    let mask = status.lines().find_map(|l| l.strip_prefix("CapEff:")).and_then(|m| u64::from_str_radix(m.trim(), 16).ok());
    mask.is_some_and(|m| m >> capability & 1 == 1)
}

fn priority(config: &Config) -> Finding {
    let wanted = config.controller.priority.max(config.worker.priority);
    // No limit is shown as none.
    let limit = getrlimit(Resource::Rtprio).current.unwrap_or(u64::MAX);
    let is = format!("SCHED_FIFO {wanted} is wanted, the limit is {limit}");
    let advice = "LimitRTPRIO= of the service, or a line 'decant - rtprio 95' in /etc/security/limits.d, and log in again";
    if wanted == 0 {
        let advice = "set controller.priority to 80, and worker.priority to 70";
        return Finding::yellow("real-time priority", "0 is configured", "anything that runs can delay the loop", advice);
    }
    if may(CAP_SYS_NICE) {
        Finding::green("real-time priority", format!("SCHED_FIFO {wanted} is wanted, and any is permitted (CAP_SYS_NICE)"))
    } else if limit >= u64::from(wanted) {
        Finding::green("real-time priority", is)
    } else {
        Finding::yellow("real-time priority", is, "the loop runs with ordinary priority and is late under load", advice)
    }
}

fn memory() -> Finding {
    let limit = getrlimit(Resource::Memlock).current;
    let free = may(CAP_IPC_LOCK);
    let is = limit.filter(|_| !free).map_or("without a limit".into(), |bytes| format!("up to {} MiB", bytes >> 20));
    let advice = "LimitMEMLOCK=infinity of the service, or a line 'decant - memlock unlimited' in /etc/security/limits.d";
    if free || limit.is_none_or(|bytes| bytes >= LOCKED_BYTES) {
        Finding::green("locked memory", is)
    } else {
        Finding::yellow("locked memory", is, "memory that was swapped out delays a tick", advice)
    }
}

fn cores(config: &Config) -> Finding {
    let (controller, worker) = (config.controller.core, config.worker.core);
    let is = format!("loop on {controller}, worker on {worker}");
    let there = std::thread::available_parallelism().map_or(1, usize::from);
    let online = |core: usize| core < there || !read(&format!("/sys/devices/system/cpu/cpu{core}/topology/core_id")).is_empty();
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
