//! The loop's promises over more than 10,000 ticks of the real processes, at 125 Hz instead of 30 so that it takes 90 s: no
//! allocation, no page fault, no system call that docs/REALTIME.md does not list, weights that are written 100 times a second without a
//! trace in the pour in progress, and the same inputs giving the same bits again. A second test shows violations to the checks.
//!
//! The tests need `strace` (scripts/test installs it) and permission to trace their own children.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::collections::BTreeSet;
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::{Duration, Instant};

use rt_controller::core::Order;
use rt_controller::journal;
use rustix::process::Signal;
use serde_json::Value;
use tests::{CellUnderTest, steady_weights};

const TILT_OUT: usize = 13;

/// The system calls that the loop makes in steady state, as docs/REALTIME.md lists them.
fn documented_calls() -> BTreeSet<String> {
    let text = include_str!("../../docs/REALTIME.md");
    let section = text.split("## System calls").nth(1).expect("the section is there").split("\n## ").next().expect("a part");
    section.lines().filter_map(|l| l.strip_prefix("| `")?.split('`').next().map(str::to_owned)).collect()
}

/// A running strace of one thread.
struct Trace(Child, tempfile::NamedTempFile);

impl Trace {
    fn of(thread: u32) -> Self {
        let file = tempfile::NamedTempFile::new().expect("a file");
        let mut strace = Command::new("strace");
        strace.args(["-q", "-p", &thread.to_string(), "-o"]).arg(file.path()).stdin(Stdio::null()).stderr(Stdio::null());
        let child = strace.spawn().expect("strace is installed (scripts/install strace)");
        std::thread::sleep(Duration::from_millis(500));
        Self(child, file)
    }

    /// Ends it and gives the names of the calls seen.
    fn calls(mut self) -> BTreeSet<String> {
        let _ = rustix::process::kill_process(rustix::process::Pid::from_child(&self.0), Signal::INT);
        self.0.wait().expect("it was ours");
        let text = std::fs::read_to_string(self.1.path()).expect("readable");
        // `<... clock_nanosleep resumed>` and `--- SIGSTOP ---` are not calls.
        let name = |l: &str| {
            l.split_once('(').map(|(name, _)| name.trim().to_owned()).filter(|n| n.chars().all(|c| c.is_alphanumeric() || c == '_'))
        };
        text.lines().filter_map(name).collect()
    }
}

/// Page faults of a thread (minor, major), as the kernel shows them to others.
fn page_faults(pid: u32, thread: u32) -> (u64, u64) {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/task/{thread}/stat")).expect("it runs");
    let fields: Vec<&str> = stat.rsplit(')').next().expect("a name").split_whitespace().collect();
    (fields[7].parse().expect("a number"), fields[9].parse().expect("a number"))
}

/// The system calls that a thread is found in, looked at `times` times, a millisecond apart.
fn found_in(pid: u32, thread: u32, times: u32) -> BTreeSet<i64> {
    let path = format!("/proc/{pid}/task/{thread}/syscall");
    let mut found = BTreeSet::new();
    for _ in 0..times {
        let now = std::fs::read_to_string(&path).expect("it runs");
        found.extend(now.split_whitespace().next().and_then(|n| n.parse::<i64>().ok()));
        std::thread::sleep(Duration::from_millis(1));
    }
    found
}

/// The thread `name` of a process.
fn thread(pid: u32, name: &str) -> u32 {
    let tasks = std::fs::read_dir(format!("/proc/{pid}/task")).expect("it runs");
    let named = |t: &std::fs::DirEntry| std::fs::read_to_string(t.path().join("comm")).is_ok_and(|c| c.trim() == name);
    let found = tasks.flatten().find(named).expect("the thread is there");
    found.file_name().to_string_lossy().parse().expect("a number")
}

/// Writes weights 100 times a second, two kinds in turn, until told to stop. Gives how many it wrote, and the identity of the last.
fn hammer(file: &Path, stop: &AtomicBool) -> (u64, String) {
    let variants = [steady_weights(TILT_OUT), steady_weights(TILT_OUT + 1)];
    let bytes = variants.each_ref().map(|w| w.to_bytes().expect("valid"));
    let mut written = 0;
    let mut next = Instant::now();
    while !stop.load(Relaxed) {
        let temporary = file.with_extension("new");
        std::fs::write(&temporary, &bytes[written as usize % 2]).expect("writable");
        std::fs::rename(&temporary, file).expect("writable");
        written += 1;
        next += Duration::from_millis(10);
        std::thread::sleep(next.saturating_duration_since(Instant::now()));
    }
    (written, variants[(written as usize + 1) % 2].identity())
}

/// Pours 40 ml to the end.
fn pour(cell: &CellUnderTest) {
    assert_eq!(cell.order(&["pour", "40", "--json"])["outcome"]["reason"], "done");
}

/// Protects the loop's deadline, and people who replay a journal.
#[test]
fn ten_thousand_ticks_keep_the_promises() {
    let mut cell = CellUnderTest::start(|config| {
        config["controller"].as_table_mut().expect("a table").insert("rate_hz".into(), 125.0.into());
    });
    cell.take_weights(&steady_weights(TILT_OUT));
    let pid = cell.pid("rt-controller");
    let loop_thread = thread(pid, "loop");
    let faults_before = page_faults(pid, loop_thread);
    let trace = Trace::of(loop_thread);

    let stop = Arc::new(AtomicBool::new(false));
    let hammering = std::thread::spawn({
        let (file, stop) = (cell.weights(), Arc::clone(&stop));
        move || hammer(&file, &stop)
    });
    let hammered_from = Instant::now();
    let ready = |cell: &CellUnderTest| cell.wait("readiness", Duration::from_secs(20), |s| s["phase"] == "idle" && s["hindrance"] == "");
    pour(&cell);

    // Frames are late: the worker hangs, is not restarted, and goes on.
    let hung = {
        cell.json("simulator", &["operator", "fill", "400", "--json"]);
        let pour = cell.begin("rt-controller", &["pour", "200", "--json"]);
        cell.wait("tilt", Duration::from_secs(10), |s| s["alpha_measured_deg"].as_f64() > Some(30.0));
        cell.signal("feature-worker", Signal::STOP);
        pour.wait_with_output().expect("it ran")
    };
    assert!(String::from_utf8_lossy(&hung.stdout).contains("stale-feature"));
    cell.signal("feature-worker", Signal::CONT);
    ready(&cell);

    // The robot is lost at full tilt and comes back.
    let connections = cell.status().expect("running")["robot_connections"].as_u64();
    let lost = {
        cell.json("simulator", &["operator", "fill", "400", "--json"]);
        let pour = cell.begin("rt-controller", &["pour", "200", "--json"]);
        cell.wait("tilt", Duration::from_secs(10), |s| s["alpha_measured_deg"].as_f64() > Some(30.0));
        assert!(cell.command("simulator", &["operator", "fault", "reset"]).status.success());
        pour.wait_with_output().expect("it ran")
    };
    assert!(String::from_utf8_lossy(&lost.stdout).contains("robot-lost"), "{}", String::from_utf8_lossy(&lost.stdout));
    cell.wait("reconnection", Duration::from_secs(20), |s| s["robot_connections"].as_u64() > connections && s["phase"] == "idle");

    while hammered_from.elapsed() < Duration::from_secs(60) {
        pour(&cell);
    }
    stop.store(true, Relaxed);
    let (written, last) = hammering.join().expect("it ran");
    let calls = trace.calls();
    // A second proof, from the kernel's own records: what it shows about the thread to other processes.
    let faults = page_faults(pid, loop_thread);
    let found = found_in(pid, loop_thread, 2000);

    // The worker dies and is replaced. The loop opens new shared memory outside of pours, and that is counted apart.
    cell.signal("feature-worker", Signal::KILL);
    cell.spawn("feature-worker");
    let before = cell.status().expect("running")["features"].as_u64();
    cell.wait("the new worker", Duration::from_secs(10), |s| s["features"].as_u64() > before);
    ready(&cell);
    pour(&cell);
    let status = cell.wait("10,000 ticks", Duration::from_secs(60), |s| s["ticks"].as_u64() > Some(10_000));

    assert_eq!(calls, documented_calls(), "the loop's system calls, and those that docs/REALTIME.md lists");
    #[cfg(target_arch = "x86_64")]
    {
        // These are the numbers of clock_nanosleep, recvfrom, sendto and getrusage; -1 stands for a thread between calls.
        let numbers = BTreeSet::from([230, 45, 44, 98, -1]);
        assert!(found.is_subset(&numbers) && found.contains(&230), "{found:?}");
    }
    assert_eq!(status["loop_allocations"], 0);
    if !cell.log("rt-controller").contains("mlockall is not permitted") {
        assert_eq!(status["loop_page_faults"], 0);
        assert_eq!(faults, faults_before, "page faults in the kernel's books");
    }
    assert_eq!(status["events_lost"], 0);
    assert!(written > 3000, "{written} weight files in a minute");
    assert_eq!((&status["weights"], &status["weights_refused"]), (&Value::from(last), &Value::from("")));
    let taken = status["weights_taken"].as_u64().expect("a number");
    assert!(taken > 20, "{taken} policies taken");

    assert_eq!(cell.stop("rt-controller"), Some(0));
    let (mut under_way, mut swapped_in_pour, mut agents) = (false, 0, 0);
    let mut execution_ns = [const { Vec::new() }; 2];
    let replay = journal::replay(&cell.dir.path().join("journal.bin"), |tick, output| {
        swapped_in_pour += u64::from(under_way && tick.agent.is_some());
        agents += u64::from(tick.agent.is_some());
        execution_ns[usize::from(tick.agent.is_some())].push(tick.times.done_ns - tick.now_ns);
        under_way |= matches!((tick.order, output.ordered), (Some(Order::Pour { .. }), Some(Ok(()))));
        under_way &= output.ended.is_none();
    });
    let replay = replay.expect("a journal");
    for (of, times) in ["without a weight swap", "with one"].iter().zip(&mut execution_ns) {
        times.sort_unstable();
        let at_us = |share: f64| times[((times.len() - 1) as f64 * share) as usize] as f64 / 1e3;
        println!("tick execution {of}, traced: p50 {:.0} us, p90 {:.0} us, n {}", at_us(0.5), at_us(0.9), times.len());
    }
    assert!(replay.ticks > 10_000 && replay.ended.len() >= 6, "{} ticks, {} pours", replay.ticks, replay.ended.len());
    assert_eq!((replay.different, replay.cut_off), (0, false), "the same inputs give the same bits");
    assert_eq!((agents, swapped_in_pour), (taken, 0), "policies are taken between pours");
}

/// Protects the checks themselves: an ordinary thread makes calls that the list does not have, and a journal whose answer was
/// changed in one bit is noticed.
#[test]
fn the_checks_see_violations() {
    let mut cell = CellUnderTest::start(|_| {});
    let trace = Trace::of(cell.pid("rt-controller"));
    cell.take_weights(&steady_weights(TILT_OUT));
    let calls = trace.calls();
    assert!(calls.difference(&documented_calls()).next().is_some(), "the ordinary thread reads files: {calls:?}");

    assert_eq!(cell.stop("rt-controller"), Some(0));
    let path = cell.dir.path().join("journal.bin");
    let mut bytes = std::fs::read(&path).expect("readable");
    let last = bytes.len() - 1;
    let untouched = journal::replay(&path, |_, _| {}).expect("a journal");
    assert_eq!(untouched.different, 0);
    // This looks for d_ml of the last tick, which stands before its four times of up to ten bytes each. A changed bit of it must be
    // noticed.
    let tick = (last - 80..last - 44).rev().find(|k| {
        let mut changed = bytes.clone();
        changed[*k] ^= 1;
        std::fs::write(&path, &changed).expect("writable");
        journal::replay(&path, |_, _| {}).is_ok_and(|r| r.different == 1)
    });
    assert!(tick.is_some(), "no changed bit was found out");
    bytes.truncate(last);
    std::fs::write(&path, &bytes).expect("writable");
    assert!(journal::replay(&path, |_, _| {}).expect("a journal").cut_off);
}
