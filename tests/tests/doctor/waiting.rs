//! What is not there yet is waited for, by name, and a cell that is asked to end ends and says so.

use std::io::{BufRead as _, BufReader};
use std::process::{Child, Stdio};
use std::time::Duration;

use serde_json::Value;
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

/// Protects who asks before a pour whether all is well: a running controller that would refuse it is no green line, and `status` names the same reason. That
/// no worker runs, or nobody publishes the frames, is a line of its own.
#[test]
fn a_controller_that_would_refuse_is_not_green() {
    let mut cell = CellUnderTest::start(|_| {});
    let patience = Duration::from_secs(20);
    cell.wait("the lack of weights", patience, |s| {
        s["may_record"] == true && s["hindrance"].as_str().is_some_and(|h| h.starts_with("no weights"))
    });
    assert_eq!(line(&examine(&cell).0, "robot", "state").0, "yellow");
    cell.take_weights(&steady_weights(13));
    cell.wait("nothing to hinder", patience, |s| s["phase"] == "idle" && s["hindrance"] == "");
    let said = examine(&cell).0;
    let (verdict, words) = line(&said, "robot", "state");
    assert!(verdict == "green" && words.contains("at work on the robot"), "{verdict}: {words}");
    let camera = |said: &Value| ["source", "worker"].map(|what| line(said, "camera", what).0);
    assert_eq!(camera(&said), ["green", "green"], "{said:#}");
    assert_eq!(cell.stop("feature-worker"), Some(0), "{}", cell.log("feature-worker"));
    let status = cell.wait("the lack of measurements", patience, |s| {
        s["hindrance"].as_str().is_some_and(|h| h.contains("no fresh, usable measurement"))
    });
    assert_eq!(status["may_record"], false, "{status}");
    let said = examine(&cell).0;
    let (verdict, words) = line(&said, "robot", "state");
    assert!(verdict == "red" && words.contains("no fresh, usable measurement"), "{verdict}: {words}");
    assert_eq!(camera(&said), ["green", "red"], "{said:#}");
    assert_eq!(cell.stop("simulator"), Some(0), "{}", cell.log("simulator"));
    let said = examine(&cell).0;
    assert_eq!(camera(&said), ["red", "red"], "{said:#}");
}

/// Protects who leaves `status --watch` open on a wall: it shows that the controller is gone, and the controller that is started next.
#[test]
fn a_watch_goes_on_with_the_next_controller() {
    let mut cell = CellUnderTest::prepare(|_| {});
    cell.spawn("rt-controller");
    cell.wait("the controller", Duration::from_secs(20), |_| true);
    let mut watch = cell.begin("rt-controller", &["status", "--watch", "--json"]);
    let mut lines = BufReader::new(watch.stdout.take().expect("piped")).lines().map_while(Result::ok);
    let mut shown = |words: &str| assert!(lines.by_ref().take(20).any(|line| line.contains(words)), "{words} is not shown");
    shown("\"phase\":");
    assert_eq!(cell.stop("rt-controller"), Some(0), "{}", cell.log("rt-controller"));
    shown("{\"error\":\"no answer from rt-controller");
    cell.spawn("rt-controller");
    shown("\"phase\":");
    watch.kill().expect("it runs");
    watch.wait().expect("it ends");
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

/// A process that ends with the test, however that ends.
pub(super) struct Ends(pub(super) Child);

impl Drop for Ends {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Protects a pour from a camera that is gone while the worker runs by hand: here a played sequence whose pictures vanish. The worker ends with one line
/// that says what is missing, the pour ends upright by name, and a worker that is started again finds nothing to play and says that.
#[test]
fn a_camera_that_vanishes_ends_the_worker_by_name() {
    let mut cell = CellUnderTest::start(|_| {});
    cell.json("rt-controller", &["record", "--json", "--lambda", "5", "--gamma", "2"]);
    let (episodes, pictures) = (cell.dir.path().join("episodes"), cell.dir.path().join("pictures"));
    let words = ["episodes", "export", episodes.to_str().expect("text"), "--as", "images", "--to", pictures.to_str().expect("text")];
    let exported = cell.program("feature-worker").args(words).output().expect("it runs");
    assert!(exported.status.success(), "{}", String::from_utf8_lossy(&exported.stderr));
    for name in ["feature-worker", "rt-controller", "simulator"] {
        assert_eq!(cell.stop(name), Some(0), "{name}");
    }
    // The robot alone, because a simulated camera would publish frames too.
    let mut robot = cell.program("simulator");
    robot.args(["ur", "--address", &cell.address.to_string()]).stdin(Stdio::piped()).stdout(Stdio::null()).stderr(Stdio::null());
    let _robot = Ends(robot.spawn().expect("it starts"));

    // The same dry pictures again and again, for half a minute.
    let mut once: Vec<_> = std::fs::read_dir(pictures.join("episode-0001")).expect("there").map(|e| e.expect("ours").path()).collect();
    once.sort();
    let ending = once[0].extension().expect("an ending").to_str().expect("text").to_owned();
    let played = cell.dir.path().join("played");
    std::fs::create_dir(&played).expect("ours");
    for (n, picture) in once.iter().cycle().take(900).enumerate() {
        std::fs::hard_link(picture, played.join(format!("{n:04}.{ending}"))).expect("ours");
    }
    let text = std::fs::read_to_string(cell.config()).expect("ours");
    let mut config: toml::Table = text.parse().expect("TOML");
    config["camera"]["source"] = "images".into();
    config["camera"]
        .as_table_mut()
        .expect("a table")
        .insert("path".into(), played.join(format!("%04d.{ending}")).display().to_string().into());
    std::fs::write(cell.config(), toml::to_string(&config).expect("TOML")).expect("ours");
    cell.spawn("feature-worker");
    cell.spawn("rt-controller");
    cell.wait_idle();
    cell.take_weights(&steady_weights(13));
    let before = cell.status().expect("running")["features"].as_u64();
    cell.wait("measurements", Duration::from_secs(20), |s| s["phase"] == "idle" && s["features"].as_u64() > before);
    let pour = cell.begin("rt-controller", &["pour", "200", "--json"]);
    cell.wait("tilt", Duration::from_secs(10), |s| s["alpha_measured_deg"].as_f64() > Some(30.0));
    std::fs::remove_dir_all(&played).expect("ours");
    let output = pour.wait_with_output().expect("it ran");
    let result: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_eq!((output.status.code(), &result["outcome"]["reason"]), (Some(4), &"stale-feature".into()), "{result}");
    cell.wait("upright", Duration::from_secs(5), |s| s["alpha_measured_deg"].as_f64().is_some_and(|a| a.abs() < 1.0));
    assert_eq!(cell.exit_code("feature-worker", Duration::from_secs(10)), Some(2), "{}", cell.log("feature-worker"));
    let log = cell.log("feature-worker");
    assert!(log.contains("no such file") && log.contains("give a whole recording"), "{log}");
    cell.spawn("feature-worker");
    assert_eq!(cell.exit_code("feature-worker", Duration::from_secs(10)), Some(2), "{}", cell.log("feature-worker"));
}
