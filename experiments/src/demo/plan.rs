//! What the demo's operator pours at the end to show what was learned, and how much of the plan before it is followed. Pure, any thread;
//! allocates; cannot fail.
//!
//! What is weighed before that is proposed by `trainer plan`, from what was weighed so far. The operator tells it only what the vessel holds.

use serde::Deserialize;
use simulator::physics::rig::Rig;

/// Number of weighings before the pours that are judged: two curves and three pours teach more than five curves (docs/LEARNING.md).
pub const WEIGHINGS: usize = 5;
/// Pours that are judged, in the same way: a small, a middling and a large one. Chosen by hand, so that none of them was seen in training.
const POURS: [(f64, f64); 3] = [(0.45, 0.09), (0.7, 0.27), (0.95, 0.42)];
/// The largest goal, ml: below `controller.goal_max_ml` of the simulated cell, and less than a cup holds.
const GOAL_MAX_ML: f64 = 250.0;
/// What `trainer plan --json` proposes.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum Proposed {
    /// Record a curve of eq. (1).
    Curve {
        /// Volume to fill in, ml.
        fill_ml: f64,
        /// Height of the curve, degrees.
        lambda_deg: f64,
        /// Its width, 1/s^2.
        gamma_per_s2: f64,
    },
    /// Pour.
    Pour(PlannedPour),
}

/// One pour.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct PlannedPour {
    /// Volume to fill in, ml.
    pub fill_ml: f64,
    /// Goal, ml.
    pub goal_ml: f64,
}

/// What is known of the vessel, and what is poured at the end.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// What the vessel holds up to its lip, ml: a person measures it with the scale.
    pub holds_ml: f64,
    /// The largest goal, ml.
    pub goal_max_ml: f64,
    /// Pours that show what was learned.
    pub pours: Vec<PlannedPour>,
}

impl Plan {
    /// The plan for the vessel of a rig.
    pub fn for_rig(rig: &Rig) -> Self {
        let container = rig.container(0.0);
        let fill_max_ml = container.fill_max_ml();
        let fives = |ml: f64| (ml / 5.0).round() * 5.0;
        let fill = |share: f64| (share * fill_max_ml / 10.0).floor() * 10.0;
        let pour = |(fill_share, goal_share): (f64, f64)| PlannedPour {
            fill_ml: fill(fill_share),
            goal_ml: fives((goal_share * fill_max_ml).min(GOAL_MAX_ML)),
        };
        let pours: Vec<PlannedPour> = POURS.into_iter().map(pour).collect();
        let goal_max_ml = pours.iter().map(|pour| pour.goal_ml).fold(0.0, f64::max);
        Self { holds_ml: container.full_ml().floor(), goal_max_ml, pours }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects whoever runs the demo with another seed or vessel: every fill goes in, and every goal is there with something to spare and can
    /// be ordered.
    #[test]
    fn every_vessel_has_a_plan_that_fits() {
        for seed in 0..200 {
            for container in ["cylinder", "cone-in", "cone-out", "bottle", "jug"] {
                let rig = Rig::seeded(seed).with_container(container).unwrap();
                let plan = Plan::for_rig(&rig);
                for pour in &plan.pours {
                    assert!(pour.fill_ml <= 0.92 * plan.holds_ml && pour.goal_ml >= 15.0, "{container} {seed}: {pour:?}");
                    assert!(pour.goal_ml < 0.65 * pour.fill_ml && pour.goal_ml <= plan.goal_max_ml, "{container} {seed}: {pour:?}");
                }
                assert!(plan.goal_max_ml <= GOAL_MAX_ML);
            }
        }
    }

    /// Protects the border to the trainer: what `trainer plan --json` prints is what the demo does.
    #[test]
    fn proposals_are_read() {
        let read = |text: &str| serde_json::from_str::<Proposed>(text).unwrap();
        let curve = read(r#"{ "kind": "curve", "fill_ml": 440.0, "lambda_deg": 48.0, "gamma_per_s2": 0.25 }"#);
        assert_eq!(curve, Proposed::Curve { fill_ml: 440.0, lambda_deg: 48.0, gamma_per_s2: 0.25 });
        let pour = read(r#"{ "kind": "pour", "fill_ml": 300.0, "goal_ml": 80.0 }"#);
        assert_eq!(pour, Proposed::Pour(PlannedPour { fill_ml: 300.0, goal_ml: 80.0 }));
        let said = serde_json::to_value(trainer::teaching::plan::Proposal::Pour { fill_ml: 300.0, goal_ml: 80.0 }).unwrap();
        assert_eq!(serde_json::from_value::<Proposed>(said).unwrap(), pour);
    }
}
