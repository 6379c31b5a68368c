//! What is not there yet is waited for, by name, and a cell that is asked to end ends and says so.

use std::time::Duration;

use tests::{CellUnderTest, Namespaces, steady_weights};

use super::{examine, line};

/// Protects a cell whose robot has a name instead of an address: the name is looked up when the robot is connected, by the controller and by the doctor,
/// and one that is not known is waited for with one line that says so. Who watches a pour when the controller is stopped is told that it is.
#[test]
fn a_robot_is_found_by_its_name() {
    let mut lost = CellUnderTest::prepare(|c| c["robot"]["address"] = "no-such-robot.invalid".into());
    let (said, code) = examine(&lost);
    let (verdict, words) = line(&said, "robot", "robot");
    assert!(code == Some(3) && verdict == "red" && words.contains("its address cannot be looked up"), "{words}");
    lost.spawn("rt-controller");
    let status = lost.wait("the name", Duration::from_secs(20), |s| s["hindrance"].as_str().is_some_and(|h| h.contains("no-such-robot")));
    assert!(status["hindrance"].as_str().expect("text").contains("check robot.address"), "{status}");
    std::thread::sleep(Duration::from_secs(2));
    assert_eq!(lost.stop("rt-controller"), Some(0), "{}", lost.log("rt-controller"));
    assert_eq!(lost.log("rt-controller").matches("cannot be looked up").count(), 1, "{}", lost.log("rt-controller"));

    // `localhost` is the one name that every machine knows; in a network of its own nobody else listens there.
    let mut cell = CellUnderTest::prepare(|c| c["robot"]["address"] = "localhost".into());
    let Some(inside) = Namespaces::new(None) else { return };
    cell.inside = Some(inside);
    cell.spawn_all();
    cell.take_weights(&steady_weights(13));
    let pour = cell.pour_tilted();
    assert_eq!(cell.stop("rt-controller"), Some(0), "{}", cell.log("rt-controller"));
    let output = pour.wait_with_output().expect("it ran");
    let said = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.code() == Some(4) && said.contains("shutting down"), "{:?}: {said}", output.status);
}

/// Protects a person who starts the worker before the camera is plugged in: it waits, says so once, and ends at once when it is asked to.
#[test]
fn a_missing_camera_is_waited_for() {
    let mut cell = CellUnderTest::prepare(|c| {
        c["camera"]["source"] = "device".into();
        c["camera"].as_table_mut().expect("a table").insert("path".into(), "/dev/no-such-camera".into());
    });
    cell.spawn("feature-worker");
    std::thread::sleep(Duration::from_secs(2));
    assert_eq!(cell.stop("feature-worker"), Some(0), "{}", cell.log("feature-worker"));
    let log = cell.log("feature-worker");
    assert_eq!(log.matches("no such device").count(), 1, "{log}");
    assert!(log.contains("it is waited for"), "{log}");
}
