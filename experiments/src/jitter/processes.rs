//! Processor time, memory and files of a process, from `/proc`. Ordinary thread; allocates; what cannot be read is NaN or 0.

/// Processor time that a process has taken so far, ns; 0 without a process.
pub fn processor_ns(pid: Option<u32>) -> u64 {
    let threads = pid.and_then(|pid| std::fs::read_dir(format!("/proc/{pid}/task")).ok());
    let spent = |task: std::fs::DirEntry| -> Option<u64> {
        std::fs::read_to_string(task.path().join("schedstat")).ok()?.split(' ').next()?.parse().ok()
    };
    threads.into_iter().flatten().flatten().filter_map(spent).sum()
}

/// What a process holds.
#[derive(Debug, Clone, Copy)]
pub struct Holding {
    /// Resident memory, MiB.
    pub resident_mib: f64,
    /// Locked memory, MiB.
    pub locked_mib: f64,
    /// Number of open files.
    pub files: usize,
}

impl Holding {
    /// What a running process holds; NaN for none.
    pub fn of(pid: Option<u32>) -> Self {
        let Some(pid) = pid else { return Self { resident_mib: f64::NAN, locked_mib: f64::NAN, files: 0 } };
        let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
        let mib = |key: &str| {
            let line = status.lines().find_map(|l| l.strip_prefix(key)).unwrap_or_default();
            line.trim().trim_end_matches(" kB").parse::<f64>().map_or(f64::NAN, |kb| kb / 1024.0)
        };
        let files = std::fs::read_dir(format!("/proc/{pid}/fd")).map_or(0, |d| d.count());
        Self { resident_mib: mib("VmRSS:"), locked_mib: mib("VmLck:"), files }
    }
}
