//! The example `write_weights`, run as a test.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

#[path = "../examples/write_weights.rs"]
#[allow(dead_code)]
mod write_weights;

use shared::actions::STAY;
use shared::agent::{Agent, Observation};

/// Protects people who write weights by hand: the file reads back the same, and an agent tilts by the action that was written.
#[test]
fn written_weights_tilt_by_their_action() {
    let directory = tempfile::tempdir().unwrap();
    let weights = write_weights::constant_action(3);
    assert_eq!(write_weights::write_and_read(&directory.path().join("w.bin"), &weights).unwrap(), weights);
    let mut agent = Agent::new(&weights);
    agent.start(50.0);
    let decision =
        agent.step(Observation { area_px2: Some(0.0), confidence: 1.0, alpha_deg: 0.0, alpha_measured_deg: f32::NAN, alpha_now_deg: 0.0 });
    assert_eq!(usize::from(decision.action), STAY + 3);
    assert_eq!(decision.dalpha_deg, weights.actions_deg[STAY + 3]);
}
