//! What is known of the machine that is measured on, and what would make it better.
//!
//! Ordinary thread; allocates; cannot fail.

use serde_json::{Value, json};
use trainer::report::page;

use crate::own_cell::OwnCell;

/// What is known of the machine, and what would make it better.
pub struct ThisMachine(Vec<Property>);

/// One property of the machine.
struct Property {
    name: &'static str,
    value: String,
    /// What would be better; empty when nothing would.
    advice: &'static str,
}

impl ThisMachine {
    /// Reads what Linux tells about the machine; a property that it does not tell stays empty.
    pub fn look(cell: &OwnCell) -> Self {
        let mut properties = processor();
        properties.extend(power());
        let fact = |name, value| Property { name, value, advice: "" };
        let c = &cell.config;
        let controller = format!("core {}, SCHED_FIFO {}, {} Hz", c.controller.core, c.controller.priority, c.controller.rate_hz);
        properties.extend(beside(c.controller.core));
        properties.push(fact("loop", controller));
        properties.push(fact("feature worker", format!("core {}, SCHED_FIFO {}", c.worker.core, c.worker.priority)));
        properties.push(fact("load before", read("/proc/loadavg")));
        Self(properties)
    }

    /// What makes two runs comparable, in one line: processor, kernel, and how loop and worker are scheduled.
    pub fn key(&self) -> String {
        let of = |name: &str| self.0.iter().find(|p| p.name == name).map_or("", |p| p.value.as_str());
        ["processor", "kernel", "loop", "feature worker"].map(of).join("; ")
    }

    /// For `jitter.json`.
    pub fn json(&self) -> Value {
        self.0.iter().map(|p| json!({ "what": p.name, "is": p.value, "advice": p.advice })).collect()
    }

    /// For the terminal.
    pub fn text(&self) -> String {
        let better = |advice: &str| if advice.is_empty() { String::new() } else { format!("{:<22} better: {advice}\n", "") };
        self.0.iter().map(|p| format!("{:<22} {}\n{}", p.name, p.value, better(p.advice))).collect()
    }

    /// For the page.
    pub fn html(&self) -> String {
        let mut rows = vec![["machine", "is", "better"].map(String::from).to_vec()];
        rows.extend(self.0.iter().map(|p| vec![p.name.into(), p.value.clone(), p.advice.into()]));
        page::table(&rows)
    }
}

/// A file of `/proc` or `/sys`; empty when it is not there.
fn read(path: &str) -> String {
    std::fs::read_to_string(path).map(|t| t.trim().to_owned()).unwrap_or_default()
}

/// A property that is good as it is, or for which there is advice.
fn judged(name: &'static str, value: String, good: bool, advice: &'static str) -> Property {
    Property { name, value, advice: if good { "" } else { advice } }
}

/// Processor, virtual machine and kernel.
fn processor() -> Vec<Property> {
    let cpuinfo = read("/proc/cpuinfo");
    let cpu = cpuinfo.lines().find_map(|l| l.strip_prefix("model name")).map_or("", |m| m.trim_matches([' ', '\t', ':']));
    let cores = cpuinfo.lines().filter(|l| l.starts_with("processor")).count();
    let virtualised = cpuinfo.contains(" hypervisor");
    let advice = "measure on the robot's own PC: the host's other guests show here";
    let version = read("/proc/sys/kernel/version");
    let release = read("/proc/sys/kernel/osrelease");
    let realtime = version.contains("PREEMPT_RT") || read("/sys/kernel/realtime") == "1";
    let kernel = format!("{release} {version}");
    vec![
        judged("processor", format!("{cores} x {cpu}"), true, ""),
        judged("virtual machine", if virtualised { "yes" } else { "no" }.into(), !virtualised, advice),
        judged("kernel", kernel, realtime, "a PREEMPT_RT kernel (Debian: linux-image-rt-amd64) bounds the wake-up"),
    ]
}

/// Who shares the loop's core with it, and by which clock it sleeps.
fn beside(core: usize) -> Vec<Property> {
    let siblings = read(&format!("/sys/devices/system/cpu/cpu{core}/topology/thread_siblings_list"));
    let alone = !siblings.contains([',', '-']);
    let clock = read("/sys/devices/system/clocksource/clocksource0/current_clocksource");
    let virtual_call = clock == "tsc" || clock == "kvm-clock";
    let clock = if clock.is_empty() { "not shown by this machine".into() } else { clock };
    let interrupts = read("/proc/irq/default_smp_affinity");
    // The mask is hexadecimal, in groups of 32 cores; the last group has the lowest ones.
    let mask = interrupts.rsplit(',').next().and_then(|m| u32::from_str_radix(m, 16).ok());
    let elsewhere = mask.is_some_and(|m| core < 32 && m >> core & 1 == 0);
    let interrupts = if interrupts.is_empty() { "not shown by this machine".into() } else { format!("cores of the mask {interrupts}") };
    vec![
        judged("on the loop's core", format!("processors {siblings}"), alone, "leave the loop's second hyperthread idle, or switch it off"),
        judged("clock", clock, virtual_call, "clocksource=tsc: other clocks cost a system call or a slow read for each time stamp"),
        judged("interrupts go to", interrupts, elsewhere, "irqaffinity= without the loop's core, and no irqbalance"),
    ]
}

/// What decides how fast a core wakes up, and who else may run on it.
fn power() -> Vec<Property> {
    let governor = read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor");
    let steady = governor == "performance";
    let governor = if governor.is_empty() { "not shown by this machine".into() } else { governor };
    let isolated = read("/sys/devices/system/cpu/isolated");
    let alone = !isolated.is_empty();
    let isolated = if alone { isolated } else { "none".into() };
    let throttling = format!("{} of 1000000 us", read("/proc/sys/kernel/sched_rt_runtime_us"));
    let latency = std::fs::OpenOptions::new().write(true).open("/dev/cpu_dma_latency").is_ok();
    let held = if latency { "may be held at 0" } else { "not permitted or not there" };
    let hold = "rt-controller holds it at 0 where it may, so that its core does not sleep deeply";
    vec![
        judged("governor", governor, steady, "cpupower frequency-set -g performance, where the machine lets it"),
        judged("isolated cores", isolated, alone, "isolcpus=, nohz_full= and rcu_nocbs= for the loop's core"),
        judged("RT throttling", throttling, true, ""),
        judged("/dev/cpu_dma_latency", held.into(), latency, hold),
    ]
}
