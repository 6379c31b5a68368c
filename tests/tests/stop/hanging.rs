//! An abort of a controller that hangs or was stopped, so that nobody can ask it: it is ended by its process.

use std::os::unix::net::UnixListener;
use std::process::Command;
use std::time::{Duration, Instant};

use rustix::process::Signal;
use tests::CellUnderTest;

use super::{abort_of, cell, timed};

/// Protects the robot from a controller that nobody can ask any more: SIGTERM to its process is the last way, and `abort` takes it by itself
/// when neither socket answers, also of one that was stopped, which does not take the signal before it goes on. The pid is checked, so that a number that another process got is left alone.
#[test]
fn an_abort_falls_back_to_the_process() {
    let mut cell = cell();
    let pour = cell.pour_tilted();
    // Another program of this user sits at both sockets and says nothing.
    let stop = cell.runtime_dir().join("stop");
    std::fs::remove_file(&stop).expect("there");
    let silent = UnixListener::bind(&stop).expect("free");
    cell.signal("rt-controller", Signal::STOP);
    // Nobody lets it go on but the abort itself.
    let (output, took) = timed(abort_of(&cell));
    println!("abort of a stopped controller: {took:?}");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(1), "nobody knows where the container is: {said}{}", String::from_utf8_lossy(&output.stdout));
    assert!(said.contains("SIGTERM"), "{said}");
    assert_eq!(cell.exit_code("rt-controller", Duration::from_secs(10)), Some(0), "{}", cell.log("rt-controller"));
    assert_ne!(pour.wait_with_output().expect("it ran").status.code(), Some(0));
    drop(silent);

    // The file of a dead controller names a process that is somebody else's now.
    let mut other = Command::new("sleep").arg("60").spawn().expect("coreutils");
    let text = serde_json::json!({ "pid": other.id(), "started": 1, "config": "x", "files": [] });
    std::fs::write(cell.runtime_dir().join("controller"), text.to_string()).expect("ours");
    let (output, _) = timed(abort_of(&cell));
    assert_eq!(output.status.code(), Some(3));
    assert!(matches!(other.try_wait(), Ok(None)), "a stranger's process was ended");
    other.kill().and_then(|()| other.wait()).expect("ours");
}

/// Protects who aborts a controller that is stopped just after it took the abort: it is ended as one that was stopped before, and not waited for.
#[test]
fn a_controller_that_is_stopped_while_it_aborts_is_ended() {
    let mut cell = cell();
    let pour = cell.pour_tilted();
    let begin = Instant::now();
    let abort = cell.begin("rt-controller", &["abort"]);
    cell.wait("the way back", Duration::from_secs(5), |s| s["phase"] == "returning");
    cell.signal("rt-controller", Signal::STOP);
    let output = abort.wait_with_output().expect("it ran");
    println!("abort of a controller that was stopped meanwhile: {:?}", begin.elapsed());
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && said.contains("SIGTERM"), "{:?} {said}", output.status.code());
    assert!(cell.exit_code("rt-controller", Duration::from_secs(10)).is_some(), "{}", cell.log("rt-controller"));
    assert_ne!(pour.wait_with_output().expect("it ran").status.code(), Some(0));
}

/// Protects who aborts as root in a cell whose configuration names a runtime directory of its own: a controller that hangs there is found and ended. A
/// "nothing runs" would leave it pouring.
#[test]
fn root_ends_a_controller_that_hangs_in_a_named_directory() {
    if !rustix::process::geteuid().is_root() {
        println!("not run: it takes root");
        return;
    }
    let base = tempfile::tempdir().expect("a directory");
    let mut cell = CellUnderTest::prepare(|c| {
        c["cell"].as_table_mut().expect("a table").insert("runtime_dir".into(), base.path().display().to_string().into());
    });
    cell.spawn("rt-controller");
    cell.wait("the controller", Duration::from_secs(30), |_| true);
    cell.signal("rt-controller", Signal::STOP);
    let (output, _) = timed(abort_of(&cell));
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && said.contains("SIGTERM"), "{:?} {said}", output.status.code());
    assert!(cell.exit_code("rt-controller", Duration::from_secs(10)).is_some(), "it has ended");
}
