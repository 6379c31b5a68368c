//! `decant`, the operator's one program: what its doctor says of a cell that works and of cells that do not, and that its commands are the
//! other programs' own.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

#[path = "doctor/json.rs"]
mod json;
#[path = "doctor/logs.rs"]
mod logs;
#[path = "doctor/metrics.rs"]
mod metrics;
#[path = "doctor/paths.rs"]
mod paths;
#[path = "doctor/room.rs"]
mod room;
#[path = "doctor/waiting.rs"]
mod waiting;

use serde_json::Value;
use tests::{CellUnderTest, program, steady_weights};

/// What the doctor says of the cell, and its exit code.
fn examine(cell: &CellUnderTest) -> (Value, Option<i32>) {
    let output = cell.command("decant", &["doctor", "--json"]);
    let said = serde_json::from_slice(&output.stdout).unwrap_or_else(|e| panic!("{e}: {}", String::from_utf8_lossy(&output.stderr)));
    (said, output.status.code())
}

/// The verdict and the words of one line.
fn line(said: &Value, section: &str, what: &str) -> (String, String) {
    let lines = said["sections"].as_array().expect("sections").iter().filter(|s| s["section"] == section);
    let found = lines.flat_map(|s| s["lines"].as_array().expect("lines").clone()).find(|l| l["what"] == what);
    let found = found.unwrap_or_else(|| panic!("no line {section}, {what} in {said:#}"));
    (found["verdict"].as_str().expect("a verdict").into(), format!("{} {} {}", found["is"], found["means"], found["advice"]))
}

/// Protects the operator's first question, why does it not pour: a cell that works is green, each thing that is wrong is named by its own line
/// with what to do, and the exit code says which kind it is. Nothing that the doctor does disturbs the cell.
#[test]
fn the_doctor_names_what_is_wrong() {
    let mut cell = CellUnderTest::prepare(|c| c["controller"]["core"] = 0.into());
    let (said, code) = examine(&cell);
    assert_eq!(code, Some(3), "no robot is there");
    let (verdict, words) = line(&said, "robot", "robot");
    assert!(verdict == "red" && words.contains("switch the robot on"), "{words}");
    let (verdict, words) = line(&said, "files", "weights");
    assert!(verdict == "yellow" && words.contains("is not there"), "{words}");
    assert_eq!(line(&said, "rights", "cores").0, "yellow", "loop and worker share a core");

    cell.spawn("simulator");
    steady_weights(10).write(&cell.weights()).expect("writable");
    let started = std::time::Instant::now();
    let (mut said, mut code) = examine(&cell);
    while code != Some(0) && started.elapsed() < std::time::Duration::from_secs(20) {
        (said, code) = examine(&cell);
    }
    assert_eq!(code, Some(0), "{said:#}");
    for what in ["program's port", "RTDE", "dashboard", "version", "registers", "state", "speed"] {
        assert_eq!(line(&said, "robot", what).0, "green", "{what}");
    }
    assert!(line(&said, "files", "weights").1.contains("by method handmade"));
    let mut few = steady_weights(10);
    few.origin.episodes = 1;
    let config = shared::config::Config::read(&cell.config()).expect("valid");
    few.origin.framing = shared::framing::Framing::new(&config.camera, &config.image);
    few.write(&cell.weights()).expect("writable");
    let (verdict, words) = line(&examine(&cell).0, "files", "weights");
    assert!(verdict == "yellow" && words.contains("from 1 episode by method handmade") && words.contains("weigh five episodes"), "{words}");

    for (fault, what, verdict, words) in [
        ("speed-slider=0.4", "speed", "red", "slider"),
        ("speed-slider=1", "speed", "green", "100 %"),
        ("time-scaling=0.5", "speed", "red", "speed scaling 50 %"),
        ("time-scaling=1", "speed", "green", "100 %"),
        ("protective-stop", "state", "red", "protective"),
        ("protective-stop", "dashboard", "red", "release it on the pendant"),
        ("unlock-protective-stop", "state", "green", "upright"),
        ("in-use=input_int_register_24", "registers", "red", "in use"),
        ("clear", "registers", "green", "free"),
        ("payload=0.02", "payload", "yellow", "cannot hold a vessel"),
        ("close-port=29999", "dashboard", "yellow", "29999"),
        ("close-port=30004", "RTDE", "red", "Real-Time Data Exchange"),
    ] {
        let output = cell.command("simulator", &["operator", "fault", fault]);
        assert!(output.status.success(), "{fault}: {}", String::from_utf8_lossy(&output.stderr));
        // The robot shows a stop within a moment, and lets a protective one be unlocked after five seconds.
        let started = std::time::Instant::now();
        let (mut said, mut code) = examine(&cell);
        while line(&said, "robot", what).0 != verdict && started.elapsed() < std::time::Duration::from_secs(10) {
            cell.command("simulator", &["operator", "fault", fault]);
            (said, code) = examine(&cell);
        }
        let (is, said) = line(&said, "robot", what);
        assert!(is == verdict && said.contains(words), "after {fault}: {is}: {said}");
        assert_eq!(code, Some(if verdict == "red" { 3 } else { 0 }), "{fault}");
    }

    std::fs::write(cell.weights(), b"no weights").expect("writable");
    let (said, code) = examine(&cell);
    assert_eq!((line(&said, "files", "weights").0.as_str(), code), ("red", Some(2)));
    std::fs::write(cell.config(), "[cell]").expect("writable");
    let (said, code) = examine(&cell);
    assert_eq!((line(&said, "files", "configuration").0.as_str(), code), ("red", Some(2)));
}

/// Protects the operator's one name: the commands are the other programs' own, with their exit codes, and a word that is none is one line.
#[test]
fn commands_are_those_of_the_programs() {
    let cell = CellUnderTest::prepare(|_| {});
    for (ours, name, theirs) in
        [("status", "rt-controller", "status"), ("weights", "trainer", "inspect"), ("camera", "feature-worker", "camera")]
    {
        let own = cell.program("decant").args([ours, "--help"]).output().expect("runs");
        let other = cell.program(name).args([theirs, "--help"]).output().expect("runs");
        assert_eq!(own.stdout, other.stdout, "{ours}");
        let help = cell.program("decant").args(["help", ours]).output().expect("runs");
        assert_eq!((help.status.code(), help.stdout), (Some(0), other.stdout), "help {ours}");
    }
    let [help, own] = [["help", "doctor"], ["doctor", "--help"]].map(|words| cell.program("decant").args(words).output().expect("runs"));
    assert!(help.status.success() && help.stdout == own.stdout, "decant's own commands too");
    let status = cell.command("decant", &["status"]);
    assert_eq!(status.status.code(), Some(i32::from(shared::exit::UNREACHABLE)));
    for words in [&["poor"][..], &["help", "poor"]] {
        let unknown = std::process::Command::new(program("decant")).args(words).output().expect("runs");
        let said = String::from_utf8_lossy(&unknown.stderr);
        assert_eq!((unknown.status.code(), said.lines().count()), (Some(2), 1), "{said}");
        assert!(said.contains("'poor'"), "{said}");
    }
}
