//! `experiments jitter`: latency and jitter of the real processes on this machine, beside cyclictest, at rest and under load.
//!
//! Ordinary process. Runs the simulated cell in rounds, and between them `cyclictest` with the same priority, core and interval; both
//! once on the machine as it is and once under `stress-ng`. What the controller measured is read from its journal, tick by tick, so
//! percentiles are exact. Ends with a page and its numbers as JSON. Fails with one line when a program is missing; what was measured
//! until then is lost. `scripts/jitter` installs what is needed.

use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use rt_controller::journal;
use serde_json::{Value, json};
use shared::exit::Failure;
use shared::os::now_ns;
use trainer::report::page;
use trainer::report::plot::{PlotSeries, plot};

use crate::own_cell::{OwnCell, OwnCellError};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  experiments jitter --weights out/demo/weights.bin
  experiments jitter --weights out/demo/weights.bin --hours 0.5      (a soak under load instead of the rounds)

Leaves jitter.json and jitter.html in the output directory. Needs cyclictest (package rt-tests) and stress-ng.")]
pub struct Args {
    /// The simulated cell's configuration: cores, priorities and rate are measured as they stand there.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Weights to pour with.
    #[arg(long)]
    weights: PathBuf,
    /// Rounds; in each, cell and cyclictest run at rest and under load.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Length of each run, s.
    #[arg(long, default_value_t = 20)]
    seconds: u64,
    /// Instead of the rounds: one run under load of this many hours, with cyclictest beside it.
    #[arg(long)]
    hours: Option<f64>,
    /// Directory of the results.
    #[arg(long, default_value = "out/jitter")]
    out: PathBuf,
    /// Print jitter.json to standard output instead of the tables.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    Ok(measure(args)?)
}

fn file_error(what: impl std::fmt::Display) -> impl FnOnce(std::io::Error) -> OwnCellError {
    move |error| OwnCellError::File { what: what.to_string(), error }
}

fn measure(args: &Args) -> Result<(), OwnCellError> {
    let mut cell = OwnCell::prepare("jitter", &args.config, &args.out, 1)?;
    std::fs::copy(&args.weights, args.out.join("weights.bin")).map_err(file_error(args.weights.display()))?;
    let machine = Machine::look(&cell);
    let result = match args.hours {
        Some(hours) => soak(&mut cell, hours)?,
        None => rounds(&mut cell, args)?,
    };
    let all = json!({ "machine": machine.json(), "result": result.numbers });
    let text = serde_json::to_string_pretty(&all).unwrap_or_default();
    let numbers = args.out.join("jitter.json");
    std::fs::write(&numbers, text.clone() + "\n").map_err(file_error(numbers.display()))?;
    let html = page::page("Decant: latency and jitter", &(machine.html() + &result.html));
    let page = args.out.join("jitter.html");
    std::fs::write(&page, html).map_err(file_error(page.display()))?;
    if args.json {
        println!("{text}");
    } else {
        print!("{}{}", machine.text(), result.text);
        println!("\npage and numbers: {}, {}", page.display(), numbers.display());
    }
    Ok(())
}

/// What is known of the machine, and what would make it better.
struct Machine(Vec<(&'static str, String, &'static str)>);

impl Machine {
    fn look(cell: &OwnCell) -> Self {
        let read = |path: &str| std::fs::read_to_string(path).map(|t| t.trim().to_owned()).unwrap_or_default();
        let cpuinfo = read("/proc/cpuinfo");
        let cpu = cpuinfo.lines().find_map(|l| l.strip_prefix("model name")).map_or("", |m| m.trim_matches([' ', '\t', ':']));
        let cores = cpuinfo.lines().filter(|l| l.starts_with("processor")).count();
        let mut rows = vec![("processor", format!("{cores} x {cpu}"), "")];
        let mut row = |name, value: String, good: bool, advice| rows.push((name, value, if good { "" } else { advice }));
        let virtualised = cpuinfo.contains(" hypervisor");
        row(
            "virtual machine",
            if virtualised { "yes" } else { "no" }.into(),
            !virtualised,
            "measure on the robot's own PC: the host's other guests show here",
        );
        let version = read("/proc/sys/kernel/version");
        let release = read("/proc/sys/kernel/osrelease");
        let realtime = version.contains("PREEMPT_RT") || read("/sys/kernel/realtime") == "1";
        row("kernel", format!("{release} {version}"), realtime, "a PREEMPT_RT kernel (Debian: linux-image-rt-amd64) bounds the wake-up");
        let governor = read("/sys/devices/system/cpu/cpu0/cpufreq/scaling_governor");
        let steady = governor == "performance";
        row("governor", or_unknown(governor), steady, "cpupower frequency-set -g performance, where the machine lets it");
        let isolated = read("/sys/devices/system/cpu/isolated");
        row(
            "isolated cores",
            if isolated.is_empty() { "none".into() } else { isolated.clone() },
            !isolated.is_empty(),
            "isolcpus=, nohz_full= and rcu_nocbs= for the loop's core",
        );
        let throttling = read("/proc/sys/kernel/sched_rt_runtime_us");
        row("RT throttling", format!("{throttling} of 1000000 us"), true, "");
        let latency = std::fs::OpenOptions::new().write(true).open("/dev/cpu_dma_latency").is_ok();
        row(
            "/dev/cpu_dma_latency",
            if latency { "may be held at 0" } else { "not permitted or not there" }.into(),
            latency,
            "rt-controller holds it at 0 where it may, so that its core does not sleep deeply",
        );
        let c = &cell.config;
        row("loop", format!("core {}, SCHED_FIFO {}, {} Hz", c.controller.core, c.controller.priority, c.controller.rate_hz), true, "");
        row("feature worker", format!("core {}, SCHED_FIFO {}", c.worker.core, c.worker.priority), true, "");
        row("load before", read("/proc/loadavg"), true, "");
        Self(rows)
    }

    fn json(&self) -> Value {
        self.0.iter().map(|(name, value, advice)| json!({ "what": name, "is": value, "advice": advice })).collect()
    }

    fn text(&self) -> String {
        let line = |(name, value, advice): &(&str, String, &str)| {
            format!("{name:<22} {value}\n{}", if advice.is_empty() { String::new() } else { format!("{:<22} better: {advice}\n", "") })
        };
        self.0.iter().map(line).collect()
    }

    fn html(&self) -> String {
        let mut rows = vec![["machine", "is", "better"].map(String::from).to_vec()];
        rows.extend(self.0.iter().map(|(name, value, advice)| vec![(*name).into(), value.clone(), (*advice).into()]));
        page::table(&rows)
    }
}

fn or_unknown(text: String) -> String {
    if text.is_empty() { "not shown by this machine".into() } else { text }
}

/// Numbers, terminal and page of a measurement.
struct Measured {
    numbers: Value,
    text: String,
    html: String,
}

/// A program that is killed when it goes out of scope.
struct Running(Child);

impl Drop for Running {
    fn drop(&mut self) {
        // stress-ng ends its own workers on SIGTERM, not on SIGKILL.
        let _ = rustix::process::kill_process(rustix::process::Pid::from_child(&self.0), rustix::process::Signal::TERM);
        let _ = self.0.wait();
    }
}

/// Load on both cores, memory and disk until it is dropped.
fn load() -> Result<Running, OwnCellError> {
    let words = "--cpu 2 --vm 1 --vm-bytes 128M --io 1 --hdd 1 --hdd-bytes 64M --quiet";
    let child = Command::new("stress-ng")
        .args(words.split(' '))
        .arg("--temp-path")
        .arg(std::env::temp_dir())
        .stdout(Stdio::null())
        .stderr(Stdio::null())
        .spawn()
        .map_err(file_error("stress-ng (package stress-ng)"))?;
    Ok(Running(child))
}

/// Starts cyclictest like the loop, one sample a line, for `seconds`; `below`: priorities below the loop's.
fn cyclictest(cell: &OwnCell, seconds: u64, below: u8) -> Result<Child, OwnCellError> {
    let c = &cell.config.controller;
    let interval_us = (1e6 / c.rate_hz) as u64;
    Command::new("cyclictest")
        .args(["--mlockall", "--nsecs", "--verbose", "--threads=1"])
        .arg(format!("--priority={}", c.priority.saturating_sub(below)))
        .arg(format!("--affinity={}", c.core))
        .arg(format!("--interval={interval_us}"))
        .arg(format!("--loops={}", seconds * 1_000_000 / interval_us))
        .stdin(Stdio::null())
        .stdout(Stdio::piped())
        .stderr(Stdio::null())
        .spawn()
        .map_err(file_error("cyclictest (package rt-tests)"))
}

/// Wake-up latencies of cyclictest's output, us.
fn latencies_us(output: &[u8]) -> Vec<f64> {
    let text = String::from_utf8_lossy(output);
    let sample = |line: &str| {
        let mut columns = line.split(':').map(str::trim);
        let (thread, _, latency_ns) = (columns.next()?, columns.next()?, columns.next()?);
        thread.parse::<u32>().ok()?;
        latency_ns.parse::<f64>().ok().map(|ns| ns / 1e3)
    };
    text.lines().filter_map(sample).collect()
}

/// What is measured of every tick (lateness, execution), or of those that used a new V_e.
#[derive(Debug, Clone, Copy)]
enum Column {
    Lateness,
    Execution,
    PouringExecution,
    CaptureToReceived,
    ReceivedToPublished,
    PublishedToWake,
    WakeToDecided,
    DecidedToWritten,
    CaptureToWritten,
}

/// Their names, in the same order.
const COLUMNS: [&str; 9] = [
    "wake-up lateness",
    "tick execution",
    "tick execution in pours",
    "capture to worker",
    "worker to V_e published",
    "V_e published to wake-up",
    "wake-up to target decided",
    "decided to bytes on the socket",
    "capture to bytes on the socket",
];

/// Everything measured of the ticks of a run, us.
#[derive(Debug, Default, Clone)]
struct Ticks {
    /// In the order of [`Column`].
    columns: [Vec<f64>; COLUMNS.len()],
    /// Periods without a tick, and ticks later than half a period.
    lost: u64,
    late: u64,
}

impl Ticks {
    /// Reads the journal's ticks between two times.
    fn read(cell: &OwnCell, from_ns: u64, to_ns: u64) -> Result<Self, OwnCellError> {
        let mut ticks = Self::default();
        let period_ns = 1e9 / cell.config.controller.rate_hz;
        let mut before_ns = None;
        let us = |from: u64, to: u64| to.saturating_sub(from) as f64 / 1e3;
        let path = cell.out.join("journal.bin");
        let replay = journal::replay(&path, |tick, output| {
            let (woke_ns, times) = (tick.now_ns, tick.times);
            if woke_ns < from_ns || woke_ns > to_ns {
                return;
            }
            if let Some(before_ns) = before_ns.replace(times.deadline_ns) {
                ticks.lost += ((times.deadline_ns - before_ns) as f64 / period_ns).round() as u64 - 1;
            }
            let lateness = us(times.deadline_ns, woke_ns);
            ticks.late += u64::from(lateness > period_ns / 2e3);
            let mut push = |column: Column, us: f64| ticks.columns[column as usize].push(us);
            push(Column::Lateness, lateness);
            push(Column::Execution, us(woke_ns, times.done_ns));
            if output.telemetry.goal_ml.is_finite() && output.telemetry.episode != 0 {
                push(Column::PouringExecution, us(woke_ns, times.done_ns));
            }
            if let Some(feature) = tick.features.last().filter(|_| times.written_at_ns != 0) {
                push(Column::CaptureToReceived, us(feature.captured_at_ns, feature.received_at_ns));
                push(Column::ReceivedToPublished, us(feature.received_at_ns, feature.published_at_ns));
                push(Column::PublishedToWake, us(feature.published_at_ns, woke_ns));
                push(Column::WakeToDecided, us(woke_ns, times.decided_at_ns));
                push(Column::DecidedToWritten, us(times.decided_at_ns, times.written_at_ns));
                push(Column::CaptureToWritten, us(feature.captured_at_ns, times.written_at_ns));
            }
        });
        let replay = replay.map_err(|e| OwnCellError::Other(e.to_string()))?;
        if replay.different != 0 {
            return Err(OwnCellError::Other(format!("{} ticks of {} replay differently", replay.different, path.display())));
        }
        Ok(ticks)
    }

    fn of(&self, column: Column) -> &Vec<f64> {
        &self.columns[column as usize]
    }
}

/// n, p50, p99, p99.9 and maximum.
fn summary(values: &[f64]) -> [f64; 5] {
    let mut sorted = values.to_vec();
    sorted.sort_by(f64::total_cmp);
    let at = |share: f64| sorted.get(((sorted.len() as f64 * share).ceil() as usize).saturating_sub(1)).copied().unwrap_or(f64::NAN);
    [sorted.len() as f64, at(0.5), at(0.99), at(0.999), at(1.0)]
}

fn median(values: impl Iterator<Item = f64>) -> f64 {
    let mut sorted: Vec<f64> = values.collect();
    sorted.sort_by(f64::total_cmp);
    match sorted.len() {
        0 => f64::NAN,
        n if n % 2 == 1 => sorted[n / 2],
        n => (sorted[n / 2 - 1] + sorted[n / 2]) / 2.0,
    }
}

/// Shares of the values in steps up to their largest 99.9th percentile.
fn histograms(title: &str, caption: &str, columns: &[(&str, &Vec<f64>)]) -> String {
    let end = columns.iter().map(|(_, v)| summary(v)[3]).filter(|x| x.is_finite()).fold(1e-3, f64::max) * 1.05;
    let width = end / 60.0;
    let series: Vec<PlotSeries> = columns
        .iter()
        .map(|(name, values)| {
            let mut counts = [0.0; 61];
            for v in values.iter() {
                counts[((v / width) as usize).min(60)] += 100.0 / values.len() as f64;
            }
            let steps = counts.iter().enumerate().flat_map(|(k, c)| [(k as f64 * width, *c), ((k + 1) as f64 * width, *c)]);
            PlotSeries::line(name, steps.collect())
        })
        .collect();
    page::figure(&plot(title, "% of n", &series, true), caption)
}

/// Processor time of a process so far, ns.
fn processor_ns(pid: Option<u32>) -> u64 {
    let threads = pid.and_then(|pid| std::fs::read_dir(format!("/proc/{pid}/task")).ok());
    let spent = |task: std::fs::DirEntry| -> Option<u64> {
        std::fs::read_to_string(task.path().join("schedstat")).ok()?.split(' ').next()?.parse().ok()
    };
    threads.into_iter().flatten().flatten().filter_map(spent).sum()
}

/// What a process holds.
#[derive(Debug, Clone, Copy)]
struct Holding {
    resident_mib: f64,
    locked_mib: f64,
    files: usize,
}

impl Holding {
    /// Of a running process; not a number for none.
    fn of(pid: Option<u32>) -> Self {
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

/// A look at both processes during a soak.
struct Sample {
    minutes: f64,
    controller: Holding,
    worker: Holding,
}

/// Pours until `until`, one after the other, each into an empty cup.
fn pour_until(cell: &OwnCell, until: Instant) -> Result<u32, OwnCellError> {
    let mut pours = 0;
    while Instant::now() + Duration::from_secs(12) < until || pours == 0 {
        cell.command("simulator", &["operator", "fill", "300"])?;
        // A pour that ends early, after a pause of the machine for instance, is a result: the ticks around it are what is looked for.
        match cell.command("rt-controller", &["pour", "--json", "60"]) {
            Ok(_) => {}
            Err(e @ OwnCellError::Step { .. }) => cell.note(&format!("a pour ended early: {e}")),
            Err(e) => return Err(e),
        }
        pours += 1;
    }
    sleep_until(cell, until)?;
    Ok(pours)
}

fn sleep_until(cell: &OwnCell, until: Instant) -> Result<(), OwnCellError> {
    while Instant::now() < until {
        cell.interrupted()?;
        std::thread::sleep(Duration::from_millis(50));
    }
    Ok(())
}

/// One run of the cell: first at rest, then pouring. Also the share of a core that the controller took at rest, %, and memory.
struct CellRun {
    ticks: Ticks,
    idle_percent: f64,
    controller: Holding,
    worker: Holding,
    allocations: u64,
    page_faults: u64,
}

fn run_cell(cell: &mut OwnCell, seconds: u64) -> Result<CellRun, OwnCellError> {
    let client = cell.start()?;
    let weighed = |e: rt_controller::client::ClientError| OwnCellError::Other(e.to_string());
    let before = client.status().map_err(weighed)?;
    drop(client);
    // The machine settles; what starting costs is not of interest.
    sleep_until(cell, Instant::now() + Duration::from_secs(1))?;
    let (from_ns, from) = (now_ns(), Instant::now());
    let pid = cell.pid("rt-controller");
    let spent_ns = processor_ns(pid);
    let rest = Duration::from_secs(seconds) / 3;
    sleep_until(cell, from + rest)?;
    let idle_percent = 100.0 * (processor_ns(pid) - spent_ns) as f64 / from.elapsed().as_nanos() as f64;
    pour_until(cell, from + Duration::from_secs(seconds))?;
    let to_ns = now_ns();
    let (controller, worker) = (Holding::of(pid), Holding::of(cell.pid("feature-worker")));
    let client = rt_controller::client::Client::connect(&cell.config.cell.name).map_err(weighed)?;
    let after = client.status().map_err(weighed)?;
    drop(client);
    cell.stop();
    Ok(CellRun {
        ticks: Ticks::read(cell, from_ns, to_ns)?,
        idle_percent,
        controller,
        worker,
        allocations: after.loop_allocations - before.loop_allocations,
        page_faults: after.loop_page_faults - before.loop_page_faults,
    })
}

/// Cell and cyclictest, at rest and under load, in turns; their order changes from round to round.
fn rounds(cell: &mut OwnCell, args: &Args) -> Result<Measured, OwnCellError> {
    const CONDITIONS: [&str; 2] = ["at rest", "under load"];
    let mut cells: [Vec<CellRun>; 2] = Default::default();
    let mut yardsticks: [Vec<Vec<f64>>; 2] = Default::default();
    for round in 0..args.rounds {
        for (condition, name) in CONDITIONS.iter().enumerate() {
            let _load = if condition == 1 { Some(load()?) } else { None };
            for turn in 0..2 {
                if (turn + round) % 2 == 0 {
                    cell.note(&format!("round {} of {}: the cell {name}", round + 1, args.rounds));
                    cells[condition].push(run_cell(cell, args.seconds)?);
                } else {
                    cell.note(&format!("round {} of {}: cyclictest {name}", round + 1, args.rounds));
                    let child = cyclictest(cell, args.seconds, 0)?;
                    let output = child.wait_with_output().map_err(file_error("cyclictest"))?;
                    cell.interrupted()?;
                    let latencies = latencies_us(&output.stdout);
                    if latencies.is_empty() {
                        return Err(OwnCellError::Other("cyclictest printed no sample: may it use SCHED_FIFO and lock memory?".into()));
                    }
                    yardsticks[condition].push(latencies);
                }
            }
        }
    }

    let (mut text, mut html, mut numbers) = (String::new(), String::new(), serde_json::Map::new());
    for (condition, name) in CONDITIONS.iter().enumerate() {
        let (runs, yard) = (&cells[condition], &yardsticks[condition]);
        let mut all = Ticks::default();
        for run in runs {
            let t = &run.ticks;
            for (sum, part) in all.columns.iter_mut().zip(&t.columns) {
                sum.extend_from_slice(part);
            }
            all.lost += t.lost;
            all.late += t.late;
        }
        let yard_all: Vec<f64> = yard.concat();
        let ratio =
            |k: usize| median(runs.iter().map(|r| summary(r.ticks.of(Column::Lateness))[k])) / median(yard.iter().map(|y| summary(y)[k]));
        let (p50, p99) = (ratio(1), ratio(2));

        let mut rows = vec![["us", "n", "p50", "p99", "p99.9", "max"].map(String::from).to_vec()];
        let mut table = serde_json::Map::new();
        let mut row = |label: &str, values: &[f64]| {
            let s = summary(values);
            rows.push(
                std::iter::once(label.to_owned()).chain([format!("{:.0}", s[0])]).chain(s[1..].iter().map(|x| format!("{x:.1}"))).collect(),
            );
            table.insert(label.into(), json!({ "n": s[0], "p50_us": s[1], "p99_us": s[2], "p999_us": s[3], "max_us": s[4] }));
        };
        for (label, values) in COLUMNS.iter().zip(&all.columns) {
            row(label, values);
        }
        row("cyclictest: wake-up lateness", &yard_all);

        let idle = median(runs.iter().map(|r| r.idle_percent));
        let (controller, worker) = (runs[runs.len() - 1].controller, runs[runs.len() - 1].worker);
        let allocations: u64 = runs.iter().map(|r| r.allocations).sum();
        let faults: u64 = runs.iter().map(|r| r.page_faults).sum();
        let facts = [
            format!("wake-up lateness, rt-controller / cyclictest, median of {} rounds: p50 {p50:.2}, p99 {p99:.2}", runs.len()),
            format!(
                "ticks lost {}, later than half a period {}; loop: {allocations} allocations, {faults} page faults",
                all.lost, all.late
            ),
            format!(
                "rt-controller without a pour: {idle:.2} % of a core; resident {:.1} MiB, locked {:.1} MiB",
                controller.resident_mib, controller.locked_mib
            ),
            format!("feature-worker: resident {:.1} MiB, locked {:.1} MiB", worker.resident_mib, worker.locked_mib),
        ];
        text += &format!("\n{name}\n");
        for row in &rows {
            text += &format!("{:<32} {:>7} {:>9} {:>9} {:>9} {:>9}\n", row[0], row[1], row[2], row[3], row[4], row[5]);
        }
        for fact in &facts {
            text += &format!("{fact}\n");
        }
        html += &format!("<h2>{name}</h2>{}<ul>", page::table(&rows));
        for fact in &facts {
            html += &format!("<li>{}</li>", page::escape(fact));
        }
        html += "</ul><div class=plots>";
        html += &histograms(
            "us",
            "Wake-up lateness; the last step holds what is beyond.",
            &[("rt-controller", all.of(Column::Lateness)), ("cyclictest", &yard_all)],
        );
        html += &histograms(
            "us",
            "Tick execution.",
            &[("all ticks", all.of(Column::Execution)), ("in pours", all.of(Column::PouringExecution))],
        );
        html +=
            &histograms("us", "From the worker's receipt of a frame to its V_e.", &[("extraction", all.of(Column::ReceivedToPublished))]);
        html += &histograms(
            "us",
            "From the wake-up to the target's bytes on the socket.",
            &[("deciding", all.of(Column::WakeToDecided)), ("the kernel's send", all.of(Column::DecidedToWritten))],
        );
        html += &histograms(
            "us",
            "The way of a frame: exposure to its V_e's use.",
            &[
                ("V_e waits for its tick", all.of(Column::PublishedToWake)),
                ("exposure to bytes on the socket", all.of(Column::CaptureToWritten)),
            ],
        );
        html += "</div>";
        let rounds: Vec<Value> = runs
            .iter()
            .zip(yard)
            .map(|(r, y)| json!({ "rt_controller": summary(r.ticks.of(Column::Lateness)), "cyclictest": summary(y) }))
            .collect();
        numbers.insert(
            (*name).into(),
            json!({
                "table": table, "lateness_ratio_p50": p50, "lateness_ratio_p99": p99, "lost_ticks": all.lost, "late_ticks": all.late,
                "idle_percent": idle, "controller_mib": controller.resident_mib, "controller_locked_mib": controller.locked_mib, "worker_mib": worker.resident_mib,
                "loop_allocations": allocations, "loop_page_faults": faults, "rounds": rounds,
            }),
        );
    }
    Ok(Measured { numbers: Value::Object(numbers), text, html })
}

/// One long run under load, pouring all the time, cyclictest beside it one priority below: where it loses nothing, nor may the loop.
fn soak(cell: &mut OwnCell, hours: f64) -> Result<Measured, OwnCellError> {
    let _load = load()?;
    let seconds = (hours * 3600.0) as u64;
    let client = cell.start()?;
    drop(client);
    let mut yardstick = Some(cyclictest(cell, seconds, 1)?);
    let output = yardstick.as_mut().and_then(|c| c.stdout.take());
    let reader = std::thread::spawn(move || {
        let mut bytes = Vec::new();
        if let Some(mut output) = output {
            let _ = std::io::Read::read_to_end(&mut output, &mut bytes);
        }
        latencies_us(&bytes)
    });
    let mut yardstick = yardstick.map(Running);
    let (from_ns, from) = (now_ns(), Instant::now());
    let mut samples = Vec::new();
    let end = from + Duration::from_secs(seconds);
    while Instant::now() < end {
        pour_until(cell, (Instant::now() + Duration::from_secs(60)).min(end))?;
        let sample = Sample {
            minutes: from.elapsed().as_secs_f64() / 60.0,
            controller: Holding::of(cell.pid("rt-controller")),
            worker: Holding::of(cell.pid("feature-worker")),
        };
        let (c, w) = (sample.controller, sample.worker);
        cell.note(&format!(
            "{:.0} min: rt-controller {:.1} MiB, {} files; feature-worker {:.1} MiB, {} files",
            sample.minutes, c.resident_mib, c.files, w.resident_mib, w.files
        ));
        samples.push(sample);
    }
    let to_ns = now_ns();
    drop(yardstick.take());
    let latencies = reader.join().unwrap_or_default();
    cell.stop();
    let ticks = Ticks::read(cell, from_ns, to_ns)?;
    let period_us = 1e6 / cell.config.controller.rate_hz;
    let lost_by_cyclictest = latencies.iter().filter(|l| **l > period_us).count();
    let (late, yard) = (summary(ticks.of(Column::Lateness)), summary(&latencies));
    let facts = [
        format!(
            "{:.0} s under load, {} ticks, {} lost, {} later than half a period",
            from.elapsed().as_secs_f64(),
            ticks.of(Column::Lateness).len(),
            ticks.lost,
            ticks.late
        ),
        format!("cyclictest beside it: {} samples, {lost_by_cyclictest} later than a period", latencies.len()),
        format!("wake-up lateness in us: rt-controller p50 {:.1}, p99 {:.1}, p99.9 {:.1}, max {:.1}", late[1], late[2], late[3], late[4]),
        format!("                        cyclictest    p50 {:.1}, p99 {:.1}, p99.9 {:.1}, max {:.1}", yard[1], yard[2], yard[3], yard[4]),
    ];
    let line = |name: &str, pick: fn(&Sample) -> f64| PlotSeries::line(name, samples.iter().map(|s| (s.minutes, pick(s))).collect());
    let mut html = String::from("<h2>Soak</h2><ul>");
    for fact in &facts {
        html += &format!("<li>{}</li>", page::escape(fact));
    }
    html += "</ul><div class=plots>";
    html += &page::figure(
        &plot(
            "minutes",
            "resident MiB",
            &[line("rt-controller", |s| s.controller.resident_mib), line("feature-worker", |s| s.worker.resident_mib)],
            true,
        ),
        "Memory.",
    );
    html += &page::figure(
        &plot(
            "minutes",
            "open files",
            &[line("rt-controller", |s| s.controller.files as f64), line("feature-worker", |s| s.worker.files as f64)],
            true,
        ),
        "Open files.",
    );
    html += &histograms("us", "Wake-up lateness.", &[("rt-controller", ticks.of(Column::Lateness)), ("cyclictest", &latencies)]);
    html += "</div>";
    let sample = |s: &Sample| {
        json!({
            "minutes": s.minutes, "controller_mib": s.controller.resident_mib, "controller_files": s.controller.files,
            "worker_mib": s.worker.resident_mib, "worker_files": s.worker.files,
        })
    };
    let numbers = json!({
        "seconds": seconds, "ticks": ticks.of(Column::Lateness).len(), "lost_ticks": ticks.lost, "late_ticks": ticks.late,
        "lost_by_cyclictest": lost_by_cyclictest, "lateness_us": late, "cyclictest_us": yard,
        "samples": samples.iter().map(sample).collect::<Vec<_>>(),
    });
    Ok(Measured { numbers, text: format!("\n{}\n", facts.join("\n")), html })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the ratios: cyclictest's samples are read in its own layout, its headings are not.
    #[test]
    fn samples_of_cyclictest_are_read() {
        let output = b"# /dev/cpu_dma_latency set to 0us\nMax CPUs = 1\n       0:       0:    8417\n       0:       1:   12050\n";
        assert_eq!(latencies_us(output), [8.417, 12.05]);
    }

    /// Protects every figure: ranks, not interpolations.
    #[test]
    fn percentiles_are_ranks() {
        let values: Vec<f64> = (1..=1000).rev().map(f64::from).collect();
        assert_eq!(summary(&values), [1000.0, 500.0, 990.0, 999.0, 1000.0]);
        assert_eq!(median([3.0, 1.0, 2.0].into_iter()), 2.0);
    }
}
