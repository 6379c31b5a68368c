//! The processes together in the simulated cell: orders, endings, weight swaps, and faults of processes.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::time::{Duration, Instant};

use rustix::process::Signal;
use tests::{CellUnderTest, steady_weights};

const TILT_OUT: usize = 13;

/// Protects the operator: a pour tilts, pours, comes back upright, reports, and is recorded; a second goal meanwhile is refused.
#[test]
fn a_pour_is_followed_to_its_end_and_recorded() {
    let cell = CellUnderTest::start(|_| {});
    let refused = cell.command("rt-controller", &["pour", "20"]);
    assert_eq!(refused.status.code(), Some(5), "without weights a pour is refused");
    assert!(String::from_utf8_lossy(&refused.stderr).contains("no valid weight file"));

    cell.take_weights(&steady_weights(TILT_OUT));
    let before = cell.wait_idle();
    let pour = cell.pour_tilted();
    let second = cell.command("rt-controller", &["pour", "30"]);
    assert_eq!(second.status.code(), Some(5));
    assert!(String::from_utf8_lossy(&second.stderr).contains("under way"));
    assert_eq!(cell.command("rt-controller", &["abort"]).status.code(), Some(0));
    assert_eq!(pour.wait_with_output().expect("it ran").status.code(), Some(4));
    let result = cell.order(&["pour", "20", "--json"]);
    assert_eq!(result["outcome"]["reason"], "done");
    let file = result["episode_file"].as_str().expect("the pour was recorded");
    let episode = shared::episode::Episode::read(std::path::Path::new(file)).expect("readable");
    assert!(episode.complete && episode.rows.len() > 60, "{} frames", episode.rows.len());
    assert!(episode.rows.iter().any(|f| f.area_px2 > 0.0), "the stream was seen");
    let scale = cell.json("simulator", &["operator", "scale", "--json"]);
    assert!(scale["weight_g"].as_f64() > Some(5.0), "liquid really flowed: {scale}");
    let status = cell.wait_idle();
    // iceoryx2 allocates once when the loop first meets a feature worker; a pour makes none.
    assert_eq!(status["loop_allocations"], before["loop_allocations"]);
}

/// Protects what the robot is told to do: a recording follows eq. (1) at the robot, and its file holds curve, angles and images.
#[test]
fn a_recording_becomes_an_episode() {
    let cell = CellUnderTest::start(|_| {});
    let result = cell.order(&["record", "--lambda", "60", "--gamma", "0.8", "--weight", "33", "--json"]);
    let file = result["episode_file"].as_str().expect("recorded");
    let episode = shared::episode::Episode::read(std::path::Path::new(file)).expect("readable");
    assert!(matches!(episode.kind, shared::episode::EpisodeKind::Recording(c) if c.lambda_deg == 60.0 && c.gamma_per_s2 == 0.8));
    assert_eq!((episode.weight_g, episode.complete), (Some(33.0), true));
    let top = episode.rows.iter().map(|f| f.alpha_measured_deg).filter(|a| a.is_finite()).fold(0.0, f32::max);
    assert!((55.0..61.0).contains(&top), "the joint reached {top} degrees");
    assert!(episode.info.images as usize >= episode.rows.len() * 9 / 10, "{} images", episode.info.images);
}

/// Protects a running lab: a new weight file is taken without restart, a bad one is refused and the old one stays; and an episode
/// names the weights that poured it, not those on the disk.
#[test]
fn weights_are_swapped_while_running() {
    let cell = CellUnderTest::start(|_| {});
    cell.take_weights(&steady_weights(TILT_OUT));
    let first = cell.status().expect("running")["weights"].clone();
    std::fs::write(cell.weights(), b"decant-w but not really").expect("writable");
    let status = cell.wait("the refusal", Duration::from_secs(5), |s| s["weights_refused"] != "");
    assert_eq!(status["weights"], first);
    let pour = cell.order(&["pour", "20", "--json"]);
    let file = pour["episode_file"].as_str().expect("the pour was recorded");
    let episode = shared::episode::Episode::read(std::path::Path::new(file)).expect("readable");
    assert_eq!(episode.info.weights.as_str(), first);
    assert_eq!(episode.info.weights, steady_weights(TILT_OUT).identity());
    cell.take_weights(&steady_weights(TILT_OUT + 1));
    let status = cell.wait("the new identity", Duration::from_secs(5), |s| s["weights"] != first);
    assert_eq!(status["weights_refused"], "");
}

/// The thread `name` of a process.
fn thread(pid: u32, name: &str) -> u32 {
    let named = |t: &std::fs::DirEntry| std::fs::read_to_string(t.path().join("comm")).is_ok_and(|c| c.trim() == name);
    let found = std::fs::read_dir(format!("/proc/{pid}/task")).expect("it runs").flatten().find(named).expect("the thread is there");
    found.file_name().to_string_lossy().parse().expect("a number")
}

/// Protects people from a slow disk: while the weight file cannot be read to its end, an abort is obeyed and status answers; and a disk that
/// does not come back does not keep the controller alive.
#[test]
fn a_stalled_disk_does_not_delay_an_abort() {
    let mut cell = CellUnderTest::start(|_| {});
    cell.take_weights(&steady_weights(TILT_OUT));
    let pour = cell.pour_tilted();
    // A disk that does not answer: every look at a file takes the disk's thread two minutes.
    let disk = thread(cell.pid("rt-controller"), "disk");
    let mut strace = std::process::Command::new("strace");
    strace.args(["-q", "-p", &disk.to_string(), "-e", "trace=statx", "-e", "inject=statx:delay_enter=120s", "-o", "/dev/null"]);
    let mut strace = strace.spawn().expect("strace is installed (scripts/install strace)");
    std::thread::sleep(Duration::from_millis(500));
    let ticks = |s: &serde_json::Value| s["ticks"].as_u64();
    let before = cell.status();
    cell.wait("ten more ticks", Duration::from_secs(5), |s| ticks(s) > before.as_ref().and_then(ticks).map(|t| t + 10));
    let abort = cell.command("rt-controller", &["abort"]);
    assert_eq!(abort.status.code(), Some(0), "{}", String::from_utf8_lossy(&abort.stderr));
    let output = pour.wait_with_output().expect("it ran");
    let result: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!((output.status.code(), &result["outcome"]["reason"]), (Some(4), &"aborted".into()));
    steady_weights(TILT_OUT + 1).write(&cell.weights()).expect("writable");
    std::thread::sleep(Duration::from_millis(500));
    assert_eq!(cell.status().expect("it answers")["weights_taken"], before.expect("it answered")["weights_taken"], "the disk answers");
    cell.signal("rt-controller", Signal::TERM);
    let begin = Instant::now();
    while !cell.log("rt-controller").contains("the disk does not answer") {
        assert!(begin.elapsed() < Duration::from_secs(20), "{}", cell.log("rt-controller"));
        std::thread::sleep(Duration::from_millis(50));
    }
    // A thread that strace holds is let go before the kernel ends the process.
    strace.kill().and_then(|()| strace.wait()).expect("ours");
    assert_eq!(cell.exit_code("rt-controller", Duration::from_secs(10)), Some(1), "{}", cell.log("rt-controller"));
}

/// Protects whoever stops a controller whose start a disk holds up: it ends all the same, and says why. Nothing has moved by then.
#[test]
fn a_start_that_a_disk_holds_up_can_be_ended() {
    let mut cell = CellUnderTest::start(|_| {});
    assert_eq!(cell.stop("rt-controller"), Some(0));
    let journal = shared::config::Config::read(&cell.config()).expect("valid").controller.journal.expect("it has one");
    let mut held = std::process::Command::new("strace");
    held.args(["-D", "-f", "-qq", "-o", "/dev/null", "-e", "trace=openat", "-e", "inject=openat:delay_enter=120s", "-P"]);
    held.arg(journal).arg(tests::program("rt-controller"));
    let log = std::fs::File::create(cell.dir.path().join("rt-controller.log")).expect("writable");
    cell.spawn_with("rt-controller", held, log.into());
    let until = |what: &str, is: &dyn Fn() -> bool| {
        let begin = Instant::now();
        while !is() {
            assert!(begin.elapsed() < Duration::from_secs(20), "{what}: {}", cell.log("rt-controller"));
            std::thread::sleep(Duration::from_millis(50));
        }
    };
    until("its stop socket", &|| cell.runtime_dir().join("stop").exists());
    let pid = cell.pid("rt-controller");
    let tracer = || {
        let status = std::fs::read_to_string(format!("/proc/{pid}/status")).unwrap_or_default();
        status.lines().find_map(|l| l.strip_prefix("TracerPid:")?.trim().parse::<i32>().ok()).unwrap_or(0)
    };
    let strace = tracer();
    rustix::process::kill_process(rustix::process::Pid::from_raw(pid as i32).expect("a number"), Signal::TERM).expect("ours");
    until("why it ends", &|| cell.log("rt-controller").contains("the start is held up"));
    // A thread that strace holds is let go before the kernel ends the process.
    rustix::process::kill_process(rustix::process::Pid::from_raw(strace).expect("it traces"), Signal::KILL).expect("ours");
    assert_eq!(cell.exit_code("rt-controller", Duration::from_secs(10)), Some(1), "{}", cell.log("rt-controller"));
}

/// Protects people: when a process dies or hangs at full tilt, the container comes upright, and the result names the reason.
#[test]
fn a_dead_or_hanging_process_ends_upright() {
    let mut cell = CellUnderTest::start(|_| {});
    cell.take_weights(&steady_weights(TILT_OUT));
    let tilted = |s: &serde_json::Value| s["alpha_measured_deg"].as_f64() > Some(30.0);

    for (signal, reason) in [(Signal::KILL, "stale-feature"), (Signal::STOP, "stale-feature")] {
        cell.json("simulator", &["operator", "fill", "300", "--json"]);
        let pour = cell.begin("rt-controller", &["pour", "200", "--json"]);
        cell.wait("tilt", Duration::from_secs(10), tilted);
        cell.signal("feature-worker", signal);
        let output = pour.wait_with_output().expect("it ran");
        assert_eq!(output.status.code(), Some(4), "{}", String::from_utf8_lossy(&output.stderr));
        let result: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
        assert_eq!(result["outcome"]["reason"], reason);
        cell.wait("upright", Duration::from_secs(5), |s| s["alpha_measured_deg"].as_f64().is_some_and(|a| a.abs() < 1.0));
        if signal == Signal::KILL {
            cell.spawn("feature-worker");
        } else {
            cell.signal("feature-worker", Signal::CONT);
        }
        let before = cell.status().expect("running")["features"].as_u64();
        cell.wait("features again", Duration::from_secs(10), |s| s["features"].as_u64() > before && s["phase"] == "idle");
    }

    // The controller dies and is started again at once: the command that waits for the pour reports it.
    cell.json("simulator", &["operator", "fill", "300", "--json"]);
    let mut pour = cell.begin("rt-controller", &["pour", "200", "--json"]);
    cell.wait("tilt", Duration::from_secs(10), tilted);
    cell.signal("rt-controller", Signal::KILL);
    cell.spawn("rt-controller");
    let until = Instant::now() + Duration::from_secs(20);
    while Instant::now() < until && matches!(pour.try_wait(), Ok(None)) {
        std::thread::sleep(Duration::from_millis(50));
    }
    let _ = pour.kill();
    let output = pour.wait_with_output().expect("it ran");
    assert_eq!(output.status.code(), Some(3), "{}", String::from_utf8_lossy(&output.stderr));
    cell.wait("weights and robot again", Duration::from_secs(20), |s| s["phase"] == "idle" && s["weights"] != "");

    // The controller itself hangs: the robot's program goes upright by itself; afterwards the controller says why, and recovers.
    cell.json("simulator", &["operator", "fill", "300", "--json"]);
    let pour = cell.begin("rt-controller", &["pour", "200", "--json"]);
    cell.wait("tilt", Duration::from_secs(10), tilted);
    cell.signal("rt-controller", Signal::STOP);
    std::thread::sleep(Duration::from_millis(3000));
    cell.signal("rt-controller", Signal::CONT);
    // The command asks again, and says how it ended.
    let output = pour.wait_with_output().expect("it ran");
    assert_eq!(output.status.code(), Some(4), "{}", String::from_utf8_lossy(&output.stderr));
    let status = cell.wait("recovery", Duration::from_secs(15), |s| s["phase"] == "idle");
    assert!(status["alpha_measured_deg"].as_f64().is_some_and(|a| a.abs() < 1.0));
    let outcomes = status["outcomes"].as_array().expect("a list");
    let last = &outcomes[outcomes.len() - 1]["reason"];
    assert!(["controller-overrun", "robot-lost", "program-stopped"].iter().any(|r| last == r), "{last}");
}

/// Protects people where the controller hangs for longer: the command that waits for the pour says that the robot has to be looked at.
#[test]
fn an_order_that_nobody_answers_is_no_quiet_end() {
    let mut cell = CellUnderTest::start(|_| {});
    cell.take_weights(&steady_weights(TILT_OUT));
    let pour = cell.pour_tilted();
    cell.signal("rt-controller", Signal::STOP);
    let output = pour.wait_with_output().expect("it ran");
    cell.signal("rt-controller", Signal::CONT);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.code() == Some(3) && said.contains("look at the robot"), "{said}");
}

/// Protects whoever presses Ctrl-C, or has given the weight before: what is known of the pour and of its file is said all the same, and that the weight is
/// not in it. A fill that is less than the goal begins nothing.
#[test]
fn what_is_known_of_an_interrupted_order_is_said() {
    let cell = CellUnderTest::start(|_| {});
    cell.take_weights(&steady_weights(TILT_OUT));
    let interrupt = |order: &std::process::Child| {
        let pid = rustix::process::Pid::from_child(order);
        rustix::process::kill_process(pid, Signal::INT).expect("it runs");
    };
    let less = cell.command("rt-controller", &["pour", "20", "--fill", "10"]);
    let said = String::from_utf8_lossy(&less.stderr);
    assert!(less.status.code() == Some(2) && said.contains("there is less in the vessel"), "{said}");
    let none = cell.command("rt-controller", &["pour", "20", "--fill", "nan"]);
    let said = String::from_utf8_lossy(&none.stderr);
    assert!(none.status.code() == Some(2) && said.contains("this is no volume"), "{said}");

    let pour = cell.pour_tilted();
    interrupt(&pour);
    let output = pour.wait_with_output().expect("it ran");
    let result: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!((output.status.code(), &result["outcome"]["reason"]), (Some(130), &"aborted".into()));
    assert!(result["episode_file"].is_string(), "{result}");

    let curve = cell.begin("rt-controller", &["record", "--lambda", "60", "--gamma", "0.3", "--weight", "83"]);
    cell.wait("the curve", Duration::from_secs(10), |s| s["phase"] == "recording" && s["alpha_deg"].as_f64() > Some(10.0));
    interrupt(&curve);
    let output = curve.wait_with_output().expect("it ran");
    let [told, said] = [&output.stdout, &output.stderr].map(|text| String::from_utf8_lossy(text).into_owned());
    assert!(
        output.status.code() == Some(130) && told.contains("recorded: ") && said.contains("the weight is not written"),
        "{told} {said}"
    );
}
