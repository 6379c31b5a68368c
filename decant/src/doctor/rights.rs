//! What the controller may do, or a process of this user if none runs, whether the cores of the configuration are there, and whether a logout takes the
//! cell's shared memory away.
//!
//! Called once by an ordinary thread; allocates; nothing fails.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rt_controller::claim;
use shared::config::Config;
use shared::machine::{Finding, in_list, read};
use shared::runtime_dir::{Place, own_uid};

/// The bit of CAP_IPC_LOCK, which lifts the limit on locked memory (capabilities(7)).
const CAP_IPC_LOCK: u32 = 14;
/// The bit of CAP_SYS_NICE, which permits any priority (capabilities(7)).
const CAP_SYS_NICE: u32 = 23;
/// Memory that the controller locks, bytes: docs/REALTIME.md measures 18 MiB, and this leaves room.
const LOCKED_BYTES: u64 = 64 << 20;

/// The largest number of a system's user where /etc/login.defs has no SYS_UID_MAX (its own default).
const SYS_UID_MAX: u32 = 999;
/// Where logind's configuration lies, what comes first wins (logind.conf(5)).
const LOGIND: [&str; 4] = ["/etc/systemd", "/run/systemd", "/usr/local/lib/systemd", "/usr/lib/systemd"];

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
    vec![priority(config, &process), memory(&process), cores(config), logout(Path::new("/"), own_uid())]
}

/// Whether logind deletes the files in /dev/shm of the user `uid` at the last logout (RemoveIPC). `root` is the directory that holds /etc, /run and
/// /var.
fn logout(root: &Path, uid: u32) -> Finding {
    let under = |path: &str| root.join(path.trim_start_matches('/'));
    let text = |path: &str| read(&under(path).to_string_lossy());
    let defs = text("/etc/login.defs");
    let value = |line: &str| line.trim().strip_prefix("SYS_UID_MAX").and_then(|n| n.trim().parse().ok());
    if uid <= defs.lines().find_map(value).unwrap_or(SYS_UID_MAX) {
        return Finding::green("logout", "this user is a system's user, whose shared memory stays");
    }
    if !under("/run/systemd/users").is_dir() {
        return Finding::green("logout", "logind does not run, so shared memory stays");
    }
    if remove_ipc(root).last().is_some_and(|word| ["no", "n", "false", "f", "off", "0"].contains(&word.as_str())) {
        return Finding::green("logout", "RemoveIPC=no: shared memory stays");
    }
    let passwd = text("/etc/passwd");
    let user = passwd.lines().map(|line| line.split(':').collect::<Vec<_>>()).find(|f| f.get(2).is_some_and(|n| n.parse() == Ok(uid)));
    let user = user.map_or_else(|| uid.to_string(), |fields| fields[0].to_owned());
    if under("/var/lib/systemd/linger").join(&user).exists() {
        return Finding::green("logout", format!("user {user} lingers, so shared memory stays"));
    }
    let advice =
        format!("run the cell by the package's units, or `loginctl enable-linger {user}`, or set RemoveIPC=no in /etc/systemd/logind.conf");
    let means =
        "logind then deletes the files in /dev/shm of a cell that this user runs by hand, and no command reaches it any more but `abort`";
    Finding::yellow("logout", format!("user {user} does not linger, and RemoveIPC is on"), means, advice)
}

/// The values of RemoveIPC in logind's configuration, the one that counts last.
fn remove_ipc(root: &Path) -> Vec<String> {
    let places = LOGIND.map(|place| root.join(place.trim_start_matches('/')));
    let main = places.iter().map(|place| place.join("logind.conf")).find(|file| file.exists());
    // Of drop-ins with one name the first place's counts; they are read in the order of their names.
    let mut more: BTreeMap<_, PathBuf> = BTreeMap::new();
    for place in places.iter().rev() {
        for entry in std::fs::read_dir(place.join("logind.conf.d")).into_iter().flatten().flatten() {
            more.insert(entry.file_name(), entry.path());
        }
    }
    let more = more.into_values().filter(|file| file.extension().is_some_and(|x| x == "conf"));
    let texts = main.into_iter().chain(more).map(|file| read(&file.to_string_lossy()));
    let values = |text: String| {
        let lines = text.lines().filter_map(|l| Some(l.trim().strip_prefix("RemoveIPC")?.trim().strip_prefix('=')?.trim().to_lowercase()));
        lines.collect::<Vec<_>>()
    };
    texts.flat_map(values).collect()
}

fn priority(config: &Config, process: &Process) -> Finding {
    let wanted = config.controller.priority.max(config.worker.priority);
    let ordinary = match (config.controller.priority, config.worker.priority) {
        (0, _) => Some(("controller.priority is 0", "anything that runs can delay the loop")),
        (_, 0) => {
            Some(("worker.priority is 0", "anything that runs can delay a measurement, and the loop then acts later or ends the pour"))
        }
        _ => None,
    };
    if let Some((is, means)) = ordinary {
        return Finding::yellow("real-time priority", is, means, "set controller.priority to 80, and worker.priority to 70");
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

#[cfg(test)]
mod tests {
    use shared::machine::Verdict;

    use super::*;

    /// Protects a pour from ordinary scheduling that somebody left in the configuration: each of the two processes without a priority is named.
    #[test]
    fn each_process_without_priority_is_named() {
        let text = include_str!("../../../config/cell.toml");
        let judge = |from, to| {
            let config = Config::parse(&text.replace(from, to), "cell.toml").unwrap();
            priority(&config, &Process { directory: "/proc/self".into(), who: String::new() })
        };
        for (from, name) in [("priority = 80", "controller.priority"), ("priority = 70", "worker.priority")] {
            let found = judge(from, "priority = 0");
            assert!(found.verdict == Verdict::Yellow && found.is.contains(name), "{found:?}");
        }
        assert!(!judge("priority = 80", "priority = 81").is.contains("is 0"));
    }

    /// Protects a cell that somebody runs by hand over a logout: it is yellow only where logind would delete its shared memory, and says how to keep it.
    #[test]
    fn a_logout_that_takes_shared_memory_is_named() {
        let root = tempfile::tempdir().unwrap();
        let write = |path: &str, text: &str| {
            let path = root.path().join(path);
            std::fs::create_dir_all(path.parent().unwrap()).unwrap();
            std::fs::write(path, text).unwrap();
        };
        let judge = |uid| logout(root.path(), uid);
        assert_eq!(judge(1000).verdict, Verdict::Green, "no logind runs");
        std::fs::create_dir_all(root.path().join("run/systemd/users")).unwrap();
        write("etc/passwd", "root:x:0:0::/:/bin/sh\nada:x:1000:1000::/:/bin/sh\n");
        write("usr/lib/systemd/logind.conf", "[Login]\n#RemoveIPC=no\n");
        let found = judge(1000);
        assert!(found.verdict == Verdict::Yellow && found.advice.contains("enable-linger ada"), "{found:?}");
        assert_eq!([0, 998].map(|uid| judge(uid).verdict), [Verdict::Green; 2], "a system's users");
        write("usr/lib/systemd/logind.conf.d/50-lab.conf", "[Login]\nRemoveIPC = no\n");
        assert_eq!(judge(1000).verdict, Verdict::Green);
        write("etc/systemd/logind.conf.d/50-lab.conf", "[Login]\nRemoveIPC=yes\n");
        assert_eq!(judge(1000).verdict, Verdict::Yellow, "the administrator's file counts");
        write("var/lib/systemd/linger/ada", "");
        assert_eq!(judge(1000).verdict, Verdict::Green, "who lingers is never logged out");
        write("etc/login.defs", "# SYS_UID_MAX 5\nSYS_UID_MAX\t\t 500\n");
        assert_eq!(judge(998).verdict, Verdict::Yellow, "by this machine's own bound, and not lingering");
    }
}
