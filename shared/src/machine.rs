//! What Linux tells about the machine: how well it can run the loop, and what would make it better. `decant doctor` and the page of
//! `experiments jitter` say it in these words; docs/REALTIME.md explains each step.
//!
//! Ordinary threads call it; it allocates and reads `/proc` and `/sys`. Nothing here fails: what the machine does not show is said to be
//! not shown.

use serde::Serialize;

/// The share of a core that Linux leaves to real-time threads by default (sched-rt-group in the kernel's documentation). The loop and the worker need less.
const USUAL_RT_SHARE: f64 = 0.95;

/// How good something is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// As it should be, or only a fact.
    Green,
    /// It works, and would work better otherwise.
    Yellow,
    /// It does not work.
    Red,
}

/// One thing that was looked at.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What was looked at.
    pub what: String,
    /// How good it is.
    pub verdict: Verdict,
    /// What was found.
    pub is: String,
    /// What it means for a pour; empty for a fact.
    pub means: String,
    /// What to do; empty if nothing is to be done.
    pub advice: String,
}

impl Finding {
    /// A fact, or what is as it should be.
    pub fn green(what: &str, is: impl Into<String>) -> Self {
        Self { what: what.into(), verdict: Verdict::Green, is: is.into(), means: String::new(), advice: String::new() }
    }

    /// What works and would work better otherwise.
    pub fn yellow(what: &str, is: impl Into<String>, means: &str, advice: impl Into<String>) -> Self {
        Self { verdict: Verdict::Yellow, means: means.into(), advice: advice.into(), ..Self::green(what, is) }
    }

    /// What does not work.
    pub fn red(what: &str, is: impl Into<String>, means: &str, advice: impl Into<String>) -> Self {
        Self { verdict: Verdict::Red, ..Self::yellow(what, is, means, advice) }
    }

    /// Green if `good`, else yellow.
    fn judged(good: bool, what: &str, is: impl Into<String>, means: &str, advice: &str) -> Self {
        if good { Self::green(what, is) } else { Self::yellow(what, is, means, advice) }
    }
}

/// Looks at the machine, for a loop that is pinned to `core`.
pub fn look(core: usize) -> Vec<Finding> {
    let mut findings = processor();
    findings.extend(power(core));
    findings.extend(beside(core));
    findings
}

/// A file of `/proc` or `/sys`; empty when it is not there.
pub fn read(path: &str) -> String {
    std::fs::read_to_string(path).map(|t| t.trim().to_owned()).unwrap_or_default()
}

/// A value, or that the machine does not show it.
fn shown(value: String) -> String {
    if value.is_empty() { "not shown by this machine".into() } else { value }
}

/// Processor, virtual machine and kernel.
fn processor() -> Vec<Finding> {
    let cpuinfo = read("/proc/cpuinfo");
    let cpu = cpuinfo.lines().find_map(|l| l.strip_prefix("model name")).map_or("", |m| m.trim_matches([' ', '\t', ':']));
    let cores = cpuinfo.lines().filter(|l| l.starts_with("processor")).count();
    let version = read("/proc/sys/kernel/version");
    let realtime = version.contains("PREEMPT_RT") || read("/sys/kernel/realtime") == "1";
    let kernel = format!("{} {version}", read("/proc/sys/kernel/osrelease"));
    let rt = "a PREEMPT_RT kernel bounds the wake-up (Debian: apt install linux-image-rt-amd64)";
    vec![
        Finding::green("processor", format!("{cores} x {cpu}")),
        guest(&cpuinfo),
        Finding::judged(realtime, "kernel", kernel, "drivers can delay the loop by milliseconds", rt),
    ]
}

/// Whether this is a virtual machine, by the text of `/proc/cpuinfo`. A processor whose list of what it can do has no word for it, as of arm64, does not say.
fn guest(cpuinfo: &str) -> Finding {
    let what = "virtual machine";
    let Some(flags) = cpuinfo.lines().find(|line| line.starts_with("flags")) else { return Finding::green(what, shown(String::new())) };
    let virtualised = flags.split_whitespace().any(|flag| flag == "hypervisor");
    let is = if virtualised { "yes" } else { "no" };
    Finding::judged(!virtualised, what, is, "the host's other guests can hold the loop", "run on the robot's own PC")
}

/// Who shares the loop's core with it, and by which clock it sleeps.
fn beside(core: usize) -> Vec<Finding> {
    let siblings = read(&format!("/sys/devices/system/cpu/cpu{core}/topology/thread_siblings_list"));
    let alone = !siblings.contains([',', '-']);
    let clock = read("/sys/devices/system/clocksource/clocksource0/current_clocksource");
    // Those that the kernel lets a program read without a system call; the last one is that of arm64.
    let fast = ["tsc", "kvm-clock", "arch_sys_counter"].contains(&clock.as_str());
    let interrupts = read("/proc/irq/default_smp_affinity");
    // The mask is hexadecimal, in groups of 32 cores; the last group has the lowest ones.
    let mask = interrupts.rsplit(',').next().and_then(|m| u32::from_str_radix(m, 16).ok());
    let elsewhere = mask.is_some_and(|m| core < 32 && m >> core & 1 == 0);
    let interrupts = if interrupts.is_empty() { shown(interrupts) } else { format!("cores of the mask {interrupts}") };
    let idle = "leave the loop's second hyperthread idle, or switch it off";
    let tsc = "clocksource=tsc on the kernel's command line, where the processor allows it";
    let affinity = "irqaffinity= without the loop's core, and no irqbalance";
    vec![
        Finding::judged(
            alone,
            "on the loop's core",
            format!("processors {}", shown(siblings)),
            "a sibling takes up to half of its speed",
            idle,
        ),
        Finding::judged(fast, "clock", shown(clock), "each time stamp costs a system call or a slow read", tsc),
        Finding::judged(elsewhere, "interrupts go to", interrupts, "an interrupt can fall into a tick", affinity),
    ]
}

/// Whether the kernel's list of cores, such as `2-3,6`, has this one.
pub fn in_list(list: &str, core: usize) -> bool {
    list.split(',').any(|part| {
        let (first, last) = part.split_once('-').unwrap_or((part, part));
        matches!((first.trim().parse::<usize>(), last.trim().parse::<usize>()), (Ok(first), Ok(last)) if (first..=last).contains(&core))
    })
}

/// What decides how fast a core wakes up, and who else may run on it.
fn power(core: usize) -> Vec<Finding> {
    let governor = read(&format!("/sys/devices/system/cpu/cpu{core}/cpufreq/scaling_governor"));
    let isolated = read("/sys/devices/system/cpu/isolated");
    let (steady, alone) = (governor == "performance", in_list(&isolated, core));
    let isolated = if isolated.is_empty() { "none".into() } else { format!("{isolated}; the loop's core is {core}") };
    let held = std::fs::OpenOptions::new().write(true).open("/dev/cpu_dma_latency").is_ok();
    let latency = if held { "may be held at 0" } else { "not permitted or not there" };
    let hold = "let this user write /dev/cpu_dma_latency; rt-controller holds it at 0 then";
    let full = "cpupower frequency-set -g performance, where the machine lets it";
    let isolate = "isolcpus=, nohz_full= and rcu_nocbs= for the loop's core";
    vec![
        Finding::judged(steady, "governor", shown(governor), "a tick may start at a low clock", full),
        Finding::judged(alone, "isolated cores", isolated, "other tasks share the loop's core", isolate),
        throttling(&read("/proc/sys/kernel/sched_rt_runtime_us"), &read("/proc/sys/kernel/sched_rt_period_us")),
        time_slices(&read("/proc/sys/kernel/sched_rr_timeslice_ms")),
        Finding::judged(held, "/dev/cpu_dma_latency", latency, "a core that sleeps deeply wakes up 100 us later", hold),
    ]
}

/// Whether the kernel takes real-time threads off a core before they use what it leaves them by default: `runtime` of each `period`, us, -1 for all.
fn throttling(runtime: &str, period: &str) -> Finding {
    let is = format!("{} of {} us", shown(runtime.into()), shown(period.into()));
    let (Ok(runtime), Ok(period)) = (runtime.parse::<f64>(), period.parse::<f64>()) else { return Finding::green("RT throttling", is) };
    let good = runtime < 0.0 || runtime >= USUAL_RT_SHARE * period;
    let means = "where real-time threads use so much of a core, the loop stands still for the rest of the period";
    Finding::judged(good, "RT throttling", is, means, "sysctl kernel.sched_rt_runtime_us=950000, with a period of 1000000")
}

/// How long a thread under SCHED_RR runs before its equals do. A fact: loop and worker run under SCHED_FIFO, which has no time slices.
fn time_slices(timeslice_ms: &str) -> Finding {
    let slice = if timeslice_ms.is_empty() { shown(String::new()) } else { format!("{timeslice_ms} ms") };
    Finding::green("time slices", format!("{slice} under SCHED_RR; loop and worker run under SCHED_FIFO, which has none"))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the loop from a green line about somebody else's core: of the kernel's list only the loop's own core counts.
    #[test]
    fn the_loops_own_core_is_looked_up() {
        assert!(in_list("2-3,6", 3) && in_list("2-3,6", 6) && in_list("0", 0) && in_list(" 1 ", 1));
        assert!(!in_list("2-3,6", 1) && !in_list("2-3,6", 4) && !in_list("", 0) && !in_list("12", 1));
    }

    /// Protects who reads a plain "no" on a machine that does not say it: only a list of flags without the word means that this is no virtual machine.
    #[test]
    fn a_virtual_machine_is_denied_only_where_it_is_known() {
        let x86 = "processor : 0\nmodel name : X\nflags : fpu tsc";
        for (cpuinfo, verdict, is) in [
            (format!("{x86} hypervisor lahf_lm\n"), Verdict::Yellow, "yes"),
            (format!("{x86} lahf_lm\n"), Verdict::Green, "no"),
            ("processor : 0\nFeatures : fp asimd\n".into(), Verdict::Green, "not shown by this machine"),
            (String::new(), Verdict::Green, "not shown by this machine"),
        ] {
            let found = guest(&cpuinfo);
            assert_eq!((found.verdict, found.is.as_str()), (verdict, is), "{cpuinfo}");
        }
    }

    /// Protects the loop from a kernel that was told to throttle real-time threads early: that is yellow, with what to do. The default, and none at
    /// all, are no reason to worry.
    #[test]
    fn early_throttling_is_named() {
        let judge = |runtime: &str, period: &str| throttling(runtime, period).verdict;
        for (runtime, period) in [("950000", "1000000"), ("-1", "1000000"), ("1000000", "1000000"), ("", "")] {
            assert_eq!(judge(runtime, period), Verdict::Green, "{runtime} of {period}");
        }
        for (runtime, period) in [("500000", "1000000"), ("0", "1000000"), ("950000", "2000000")] {
            assert_eq!(judge(runtime, period), Verdict::Yellow, "{runtime} of {period}");
        }
        assert!(throttling("0", "1000000").advice.contains("sched_rt_runtime_us"));
    }
}
