//! The examples of this crate, run as tests.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

#[path = "../examples/drive_core.rs"]
#[allow(dead_code)]
mod drive_core;

use shared::control::EndReason;

/// Protects whoever drives the core from a simulator: the example pours its goal, and counts what has really left.
#[test]
fn drive_core_pours_its_goal() {
    let (outcome, poured_ml) = drive_core::pour(30.0);
    assert_eq!((outcome.reason, outcome.goal_ml), (EndReason::Done, Some(30.0)));
    assert!(outcome.poured_ml >= 30.0 && (outcome.poured_ml - poured_ml).abs() < 0.05, "{} and {poured_ml}", outcome.poured_ml);
}
