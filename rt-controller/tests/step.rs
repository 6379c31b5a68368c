//! `rt-controller step` as another simulator uses it: a process that gets areas and gives angles.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

#[path = "../../shared/examples/write_weights.rs"]
#[allow(dead_code)]
mod write_weights;

use std::io::Write as _;
use std::process::{Command, Output, Stdio};

use shared::framing::Framing;
use shared::weights::Weights;

/// Runs the filter with weights that always tilt forward, on `areas`.
fn step(areas: &str) -> Output {
    step_at("fps = 30.0", areas)
}

/// The same in a cell whose configuration has the line `fps`.
fn step_at(fps: &str, areas: &str) -> Output {
    step_with(&write_weights::constant_action(3), fps, areas)
}

/// The same with other weights.
fn step_with(weights_of: &Weights, fps: &str, areas: &str) -> Output {
    let directory = tempfile::tempdir().unwrap();
    let weights = directory.path().join("w.bin");
    weights_of.write(&weights).unwrap();
    let config = directory.path().join("cell.toml");
    std::fs::write(&config, include_str!("../../config/sim.toml").replace("fps = 30.0", fps)).unwrap();
    let mut child = Command::new(env!("CARGO_BIN_EXE_rt-controller"))
        .args(["step", "--goal", "20", "--config"])
        .arg(&config)
        .arg("--weights")
        .arg(&weights)
        .stdin(Stdio::piped())
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .unwrap();
    // It may refuse a line before all are written.
    let _ = child.stdin.take().unwrap().write_all(areas.as_bytes());
    child.wait_with_output().unwrap()
}

/// Protects a simulator that adds up the changes: from upright, every printed angle is the sum of all printed changes, the tick that takes
/// the goal included, also while the container comes back.
#[test]
fn every_angle_is_the_sum_of_the_changes() {
    let areas = "0\n".repeat(60) + "nan\n" + &"900\n".repeat(60) + &"0\n".repeat(120);
    let output = step(&areas);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let text = String::from_utf8(output.stdout).unwrap();
    let lines: Vec<Vec<f64>> = text.lines().map(|l| l.split(' ').map(|word| word.parse().unwrap()).collect()).collect();
    assert_eq!(lines.len(), 1 + areas.lines().count());
    let mut sum_deg = 0.0;
    for (number, line) in lines.iter().enumerate() {
        assert_eq!(line.len(), 3);
        sum_deg += line[0];
        assert!((sum_deg - line[1]).abs() < 1e-6, "line {number}: {sum_deg} and {}", line[1]);
    }
    let top_deg = lines.iter().map(|l| l[1]).fold(0.0, f64::max);
    assert!(lines[0][1] > 0.0 && top_deg > 20.0, "the first line moves ({}), and so does the pour ({top_deg})", lines[0][1]);
}

/// Protects a pour from areas that cannot be: each is refused in one line that names it, with the exit code of bad input.
#[test]
fn an_impossible_area_gets_one_line() {
    let endless = "1".repeat(1 << 20);
    for area in ["-1", "1e999", "much", &endless] {
        let output = step(&format!("0\n{area}\n"));
        let said = String::from_utf8_lossy(&output.stderr).trim().to_owned();
        assert_eq!(output.status.code(), Some(i32::from(shared::exit::BAD_INPUT)), "{area:.9}: {said}");
        assert!(said.lines().count() == 1 && said.len() < 200 && said.contains("line 2"), "{area:.9}: {said}");
    }
}

/// Protects who couples a simulator from weights that `run` refuses: those of another camera would give angles that look right.
#[test]
fn weights_of_another_camera_are_refused() {
    let output = step_at("fps = 60.0", "0\n");
    let said = String::from_utf8_lossy(&output.stderr).trim().to_owned();
    assert_eq!(output.status.code(), Some(i32::from(shared::exit::BAD_INPUT)), "{said}");
    assert!(output.stdout.is_empty() && said.contains("trained at 30 frames/s, camera.fps is 60"), "{said}");
}

/// Protects who couples a simulator from weights of other pictures than the configuration names, in which an area may be another volume; and from taking
/// weights that do not know their pictures for weights of these.
#[test]
fn weights_of_other_pictures_are_refused() {
    let mut weights = write_weights::constant_action(3);
    let step = |weights: &Weights| {
        let output = step_with(weights, "fps = 30.0", "0\n");
        (output.status.code(), String::from_utf8_lossy(&output.stderr).trim().to_owned(), output.stdout.is_empty())
    };
    assert_eq!(step(&weights), (Some(0), String::new(), false), "weights by hand are of no pictures");
    weights.origin.episodes = 5;
    let (code, said, _) = step(&weights);
    assert!(code == Some(0) && said.starts_with("note: the weights do not say on which pictures they were trained"), "{said}");
    let ours = Framing::of_toml(include_str!("../../config/sim.toml"));
    weights.origin.framing = ours;
    assert_eq!(step(&weights), (Some(0), String::new(), false));
    weights.origin.framing.size_px = [960, 720];
    let (code, said, silent) = step(&weights);
    assert!(code == Some(i32::from(shared::exit::REFUSED)) && silent, "{said}");
    assert!(said.contains("the weights were trained on pictures of 960 x 720 px and not of 640 x 480, as the cell has it"), "{said}");
}

/// Protects the estimate of who drives the controller with a simulator of their own: a joint that is not where it was sent is believed where the
/// simulator says so, one that stands still is found out, and without a word nobody takes the commanded alpha for a measured one.
#[test]
fn the_measured_alpha_is_what_the_simulator_says() {
    let output = step(&"0 0\n".repeat(40));
    let said = String::from_utf8_lossy(&output.stderr).trim().to_owned();
    assert_eq!(output.status.code(), Some(i32::from(shared::exit::ENDED_EARLY)), "{said}");
    assert!(said.contains("does not follow"), "{said}");
    let output = step(&"0\n".repeat(40));
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
}

/// Protects who couples a simulator from a pour that ended early and looks done: the reason is said, and the exit code is that of a pour that ended early.
#[test]
fn an_early_end_is_said() {
    let output = step(&("0\n".repeat(20) + &"nan\n".repeat(120)));
    let said = String::from_utf8_lossy(&output.stderr).trim().to_owned();
    assert_eq!(output.status.code(), Some(i32::from(shared::exit::ENDED_EARLY)), "{said}");
    assert!(said.contains("ended early: ") && said.contains("ml poured (estimate)"), "{said}");
    assert_eq!(output.stdout.iter().filter(|b| **b == b'\n').count(), 1 + 140);
}
