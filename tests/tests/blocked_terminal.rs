//! Resident processes whose terminal was stopped, or whose standard error is a full pipe: nothing waits for it.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::io::{Read, Write};
use std::os::fd::OwnedFd;
use std::process::Command;
use std::time::Duration;

use rustix::termios::{Action, tcflow};
use tests::{CellUnderTest, program, steady_weights, terminal};

const TILT_OUT: usize = 13;

/// A pipe that is full, and its reading end.
fn full_pipe() -> (std::io::PipeReader, std::io::PipeWriter) {
    let (reader, mut writer) = std::io::pipe().expect("a pipe");
    rustix::io::ioctl_fionbio(&writer, true).expect("a flag");
    while writer.write(&[b'x'; 4096]).is_ok() {}
    while writer.write(b"x").is_ok() {}
    rustix::io::ioctl_fionbio(&writer, false).expect("a flag");
    (reader, writer)
}

/// A terminal whose output was stopped, as Ctrl-S does, and its other side.
fn stopped_terminal() -> (OwnedFd, std::fs::File) {
    let (master, slave) = terminal();
    tcflow(&slave, Action::OOff).expect("it stops");
    (master, slave)
}

/// Protects people at a robot whose terminal was stopped, or whose log is not read: status, a pour and an abort work all the same, and SIGTERM
/// ends both processes.
#[test]
fn a_terminal_that_takes_nothing_holds_nobody() {
    for kind in ["pipe", "terminal"] {
        let mut cell = CellUnderTest::prepare(|_| {});
        cell.spawn("simulator");
        let (reader, writer) = full_pipe();
        let (master, slave) = stopped_terminal();
        for name in ["feature-worker", "rt-controller"] {
            let stderr =
                if kind == "pipe" { writer.try_clone().expect("a copy").into() } else { slave.try_clone().expect("a copy").into() };
            cell.spawn_with(name, Command::new(program(name)), stderr);
        }
        cell.wait_idle();
        cell.take_weights(&steady_weights(TILT_OUT));
        let pour = cell.pour_tilted();
        let abort = cell.command("rt-controller", &["abort"]);
        assert_eq!(abort.status.code(), Some(0), "{kind}: {}", String::from_utf8_lossy(&abort.stderr));
        let output = pour.wait_with_output().expect("it ran");
        assert_eq!(output.status.code(), Some(4), "{kind}: {}", String::from_utf8_lossy(&output.stderr));
        assert!(String::from_utf8_lossy(&output.stdout).contains("aborted"));
        // More lines than the queue holds: each weight file is named.
        for i in 0..300 {
            let before = cell.status().expect("it answers")["weights_taken"].as_u64();
            steady_weights(TILT_OUT + i % 2).write(&cell.weights()).expect("writable");
            if i % 50 == 0 {
                cell.wait("the weights", Duration::from_secs(5), |s| s["weights_taken"].as_u64() > before);
            }
        }
        let pour = cell.pour_tilted();
        assert_eq!(cell.stop("rt-controller"), Some(0), "{kind}: the controller ends");
        let output = pour.wait_with_output().expect("it ran");
        assert_eq!(output.status.code(), Some(4), "{kind}: the pour's command learns that");
        assert!(String::from_utf8_lossy(&output.stdout).contains("shutdown"));
        assert_eq!(cell.stop("feature-worker"), Some(0), "{kind}: the worker ends");
        drop((reader, master));
    }
}

/// Protects readers of a log from gaps that they cannot see: when the pipe is read again, the count of the missing lines stands in it, and
/// each line has its time.
#[test]
fn dropped_lines_are_counted() {
    let mut cell = CellUnderTest::prepare(|_| {});
    cell.spawn("simulator");
    let (mut reader, writer) = full_pipe();
    cell.spawn_with("rt-controller", Command::new(program("rt-controller")), writer.into());
    cell.wait("the robot", Duration::from_secs(20), |s| s["phase"] == "idle");
    for i in 0..400 {
        let before = cell.status().expect("it answers");
        steady_weights(TILT_OUT + i % 2).write(&cell.weights()).expect("writable");
        let taken = |s: &serde_json::Value| s["weights_taken"].as_u64();
        cell.wait("the weights", Duration::from_secs(5), |s| taken(s) > taken(&before));
    }
    let reading = std::thread::spawn(move || {
        let mut text = String::new();
        reader.read_to_string(&mut text).map(|_| text)
    });
    std::thread::sleep(Duration::from_millis(300));
    assert_eq!(cell.stop("rt-controller"), Some(0));
    let text = reading.join().expect("it ran").expect("text");
    let lines: Vec<&str> = text.trim_start_matches('x').lines().collect();
    let gap = lines.iter().find(|l| l.contains("lines missing here")).expect("the gap is named");
    let words: Vec<&str> = gap.split_whitespace().collect();
    assert!(words[2].parse::<u32>().is_ok_and(|n| n > 100), "{gap}");
    assert!(lines.iter().all(|l| l.as_bytes().get(10) == Some(&b'T') && l.contains("Z rt-controller: ")), "{lines:?}");
    assert!(lines.last().is_some_and(|l| l.ends_with("stopped")), "{lines:?}");
}
