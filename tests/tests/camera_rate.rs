//! A camera in shared memory that gives another rate than the configured one.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::time::Duration;

use tests::{CellUnderTest, steady_weights};

const TILT_OUT: usize = 13;

/// Protects the cup from a volume that is wrong by the ratio of two rates, which nothing in the pictures shows: with a camera of 60 or 15 frames a
/// second where 30 are configured, a pour and a recording are refused, and both rates are named.
#[test]
fn a_camera_of_another_rate_pours_nothing() {
    for hz in [60.0, 15.0] {
        let mut cell = CellUnderTest::prepare(|_| {});
        let ours = std::fs::read_to_string(cell.config()).expect("there");
        let mut its: toml::Table = ours.parse().expect("still TOML");
        its["camera"].as_table_mut().expect("a table").insert("fps".into(), hz.into());
        std::fs::write(cell.config(), toml::to_string(&its).expect("still TOML")).expect("writable");
        cell.spawn("simulator");
        // The camera is up as soon as an operator's command is answered; then the others read what they should.
        let begin = std::time::Instant::now();
        while !cell.command("simulator", &["operator", "scale"]).status.success() {
            assert!(begin.elapsed() < Duration::from_secs(20), "{}", cell.log("simulator"));
            std::thread::sleep(Duration::from_millis(50));
        }
        std::fs::write(cell.config(), ours).expect("writable");
        for name in ["feature-worker", "rt-controller"] {
            cell.spawn(name);
        }
        cell.wait_idle();
        cell.take_weights(&steady_weights(TILT_OUT));
        cell.wait("some frames", Duration::from_secs(10), |s| s["feature_sequence"].as_u64() > Some(60));
        for order in [&["pour", "60"][..], &["record", "--lambda", "60", "--gamma", "0.8"]] {
            let output = cell.command("rt-controller", order);
            let said = String::from_utf8_lossy(&output.stderr).into_owned();
            assert_eq!(output.status.code(), Some(5), "{hz}: {said}");
            assert!(said.contains(&format!("gives {hz:.1} frames a second, and camera.fps is 30.0")), "{hz}: {said}");
        }
    }
}
