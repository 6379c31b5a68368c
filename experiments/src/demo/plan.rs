//! What the demo's operator does with a vessel: which curves, which weighed pours, and which goals. Pure, any thread; allocates; cannot fail.
//!
//! An operator chooses fills that the vessel holds, curves that spill a good part of them, and goals that leave something behind. Two
//! curves and three weighed pours teach more than five curves, because a pour flows as slowly as the pours that are to come.

use simulator::physics::rig::Rig;

/// Curves: the fill as a share of what is filled in at most, how far beyond the angle of the first drop, degrees, and the width, 1/s^2. Both spill
/// some 40 to 80 ml. Chosen by hand.
const CURVES: [(f64, f64, f64); 2] = [(0.85, 15.0, 0.25), (0.5, 13.0, 0.25)];
/// Weighed pours: fill and goal as shares of what is filled in at most. From different fills, and of 60 ml and more in most vessels, because
/// the scale rounds to whole grams. Chosen by hand.
const WEIGHED_POURS: [(f64, f64); 3] = [(0.7, 0.2), (0.9, 0.25), (0.5, 0.16)];
/// Pours that are judged, in the same way: a small, a middling and a large one. Chosen by hand, so that none of them was seen in training.
const POURS: [(f64, f64); 3] = [(0.45, 0.09), (0.7, 0.27), (0.95, 0.42)];
/// The largest goal, ml: below `controller.goal_max_ml` of the simulated cell, and less than a cup holds.
const GOAL_MAX_ML: f64 = 250.0;
/// The largest height of a curve, degrees: what the simulated robot may be commanded is 110.
const LAMBDA_MAX_DEG: f64 = 105.0;

/// One curve of eq. (1) to record.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlannedCurve {
    /// Volume to fill in, ml.
    pub fill_ml: f64,
    /// Height of the curve, degrees.
    pub lambda_deg: f64,
    /// Its width, 1/s^2.
    pub gamma_per_s2: f64,
}

/// One pour.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlannedPour {
    /// Volume to fill in, ml.
    pub fill_ml: f64,
    /// Goal, ml.
    pub goal_ml: f64,
}

/// Everything that the operator does.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// Curves to record first.
    pub curves: Vec<PlannedCurve>,
    /// Pours to weigh, with a training after each.
    pub weighed_pours: Vec<PlannedPour>,
    /// Pours that show what was learned.
    pub pours: Vec<PlannedPour>,
}

impl Plan {
    /// The plan for the vessel of a rig.
    pub fn for_rig(rig: &Rig) -> Self {
        let holds_ml = rig.container(0.0).fill_max_ml();
        let fives = |ml: f64| (ml / 5.0).round() * 5.0;
        let fill = |share: f64| (share * holds_ml / 10.0).floor() * 10.0;
        let pour = |(fill_share, goal_share): (f64, f64)| PlannedPour {
            fill_ml: fill(fill_share),
            goal_ml: fives((goal_share * holds_ml).min(GOAL_MAX_ML)),
        };
        let curve = |(share, beyond_deg, gamma_per_s2): (f64, f64, f64)| {
            let fill_ml = fill(share);
            let lambda_deg = (rig.container(fill_ml).spill_angle_deg() + beyond_deg).min(LAMBDA_MAX_DEG).round();
            PlannedCurve { fill_ml, lambda_deg, gamma_per_s2 }
        };
        Self {
            curves: CURVES.into_iter().map(curve).collect(),
            weighed_pours: WEIGHED_POURS.into_iter().map(pour).collect(),
            pours: POURS.into_iter().map(pour).collect(),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects whoever runs the demo with another seed or vessel: every fill goes in, every goal is there with something to spare and can be
    /// ordered, and every curve can be recorded.
    #[test]
    fn every_vessel_has_a_plan_that_fits() {
        for seed in 0..200 {
            for container in ["cylinder", "cone-in", "cone-out", "bottle", "jug"] {
                let rig = Rig::seeded(seed).with_container(container).unwrap();
                let plan = Plan::for_rig(&rig);
                let holds_ml = rig.container(0.0).fill_max_ml();
                for pour in plan.weighed_pours.iter().chain(&plan.pours) {
                    assert!(pour.fill_ml <= holds_ml && pour.goal_ml >= 15.0, "{container} {seed}: {pour:?} of {holds_ml}");
                    assert!(pour.goal_ml < 0.65 * pour.fill_ml && pour.goal_ml <= 300.0, "{container} {seed}: {pour:?}");
                }
                for curve in &plan.curves {
                    assert!(curve.fill_ml <= holds_ml && curve.lambda_deg > 15.0, "{container} {seed}: {curve:?}");
                    let spill_deg = rig.container(curve.fill_ml).spill_angle_deg();
                    assert!(
                        curve.lambda_deg > spill_deg + 2.0 && curve.lambda_deg <= LAMBDA_MAX_DEG,
                        "{container} {seed}: {curve:?} {spill_deg}"
                    );
                }
            }
        }
    }
}
