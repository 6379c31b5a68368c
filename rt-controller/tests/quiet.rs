//! `rt-controller run --quiet`: the resident process, by itself, without a robot and without a worker.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::io::{BufRead as _, BufReader};
use std::os::unix::fs::DirBuilderExt as _;
use std::process::{Command, Stdio};

use rustix::process::{Pid, Signal, kill_process};

/// What a controller says on standard error until it is stopped, which is when it has found no robot.
fn said(arguments: &[&str], name: &str) -> Vec<String> {
    let dir = tempfile::tempdir().unwrap();
    let runtime = dir.path().join("run");
    std::fs::DirBuilder::new().mode(0o700).create(&runtime).unwrap();
    let text = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../config/sim.toml")).unwrap();
    let text = text
        .replace("name = \"sim\"", &format!("name = \"{name}\"\nruntime_dir = \"{}\"", runtime.display()))
        .replace("address = \"127.0.0.1\"", "address = \"127.91.7.1\"")
        .replace("\"../out/", "\"");
    let config = dir.path().join("cell.toml");
    std::fs::write(&config, text).unwrap();
    let mut controller = Command::new(env!("CARGO_BIN_EXE_rt-controller"))
        .arg("run")
        .args(arguments)
        .arg("--config")
        .arg(&config)
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    let mut lines = Vec::new();
    for line in BufReader::new(controller.stderr.take().unwrap()).lines() {
        lines.push(line.unwrap());
        if lines.last().is_some_and(|line| line.contains("127.91.7.1")) {
            kill_process(Pid::from_child(&controller), Signal::TERM).unwrap();
        }
    }
    assert!(controller.wait().unwrap().success(), "{lines:?}");
    lines
}

/// Protects a log that is to have only what somebody should look at: that there is no robot is said, and that all is well is not.
#[test]
fn a_quiet_controller_says_only_what_keeps_it_from_working() {
    let all = ["running in cell", "stopped"];
    let has = |lines: &[String], words: &str| lines.iter().any(|line| line.contains(words));
    let usual = said(&[], "usual");
    assert!(all.iter().all(|words| has(&usual, words)), "{usual:?}");
    let quiet = said(&["--quiet"], "quiet");
    assert!(!all.iter().any(|words| has(&quiet, words)), "{quiet:?}");
}
