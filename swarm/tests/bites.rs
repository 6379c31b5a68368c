//! That the checks find what is wrong: limits that are too weak are given to the controller, and not to the checks.
//!
//! `scripts/check-swarm` does the same with mistakes in the code itself, for which everything is built once more.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use shared::config::Config;
use swarm::camera::Depth;
use swarm::plan::{Choice, Only, Plan};
use swarm::run::run_checked;
use swarm::site::config;
use swarm::trained::train_for;

/// A limit that is too weak, the fault that shows it (or what the seeds draw), and the invariant that must find it.
type Weak = (&'static str, Option<&'static str>, &'static [&'static str], fn(&mut Config));

const WEAK: [Weak; 7] = [
    ("rate of 140 degrees/s", Some("speed-slider"), &["target-rate", "robot-rate"], |c| c.limits.rate_deg_s = 140.0),
    ("acceleration of 4000 degrees/s^2", Some("eye-loss"), &["target-acceleration"], |c| c.limits.acceleration_deg_s2 = 4000.0),
    ("way upright at 10 degrees/s", Some("worker-killed"), &["upright"], |c| c.limits.return_rate_deg_s = 10.0),
    ("measurements that may be 4 s old", Some("worker-hung"), &["noticed"], |c| c.controller.stale_feature_ms = 4000),
    ("a robot that may be silent for 4 s", Some("stall"), &["noticed"], |c| c.controller.lost_robot_ms = 4000),
    ("goals of any size", None, &["goal-range"], |c| c.controller.goal_max_ml = 1e12),
    ("a tilt of 140 degrees", Some("eye-false-zero"), &["target-range", "robot-range"], |c| c.limits.alpha_max_deg = 140.0),
];

/// How many seeds are tried for each.
const SEEDS: u64 = 240;

/// Protects the checks themselves: each weak limit is found, and by the invariant that is about it.
#[test]
fn limits_that_are_too_weak_are_found() {
    let good = config().unwrap();
    for (what, fault, invariants, weaken) in WEAK {
        let mut weak = good.clone();
        weaken(&mut weak);
        let only = fault.map(|name| Only::named(name, Depth::Area).unwrap());
        // Two vessels do, so that little is trained.
        let plans: Vec<Plan> = (1..=SEEDS).map(|seed| Plan::draw_with(seed, Choice { only, vessels: 2, ..Choice::default() })).collect();
        let trained = train_for(&plans, &good, &|_| {}).unwrap();
        let found = plans
            .iter()
            .position(|plan| run_checked(plan, &trained, &weak, &good, false).violations.iter().any(|v| invariants.contains(&v.invariant)));
        println!("{what}: found by seed {found:?} of {}", plans.len());
        assert!(found.is_some(), "{what}: {SEEDS} seeds violate none of {invariants:?}");
    }
}

/// Protects `scripts/check-swarm` from mistakes that can no longer be planted: what each replaces stands exactly once where it is planted, and the
/// invariants that are to find it are named.
#[test]
fn planted_mistakes_have_their_places() {
    let root = concat!(env!("CARGO_MANIFEST_DIR"), "/..");
    let bugs: toml::Table = std::fs::read_to_string(format!("{root}/swarm/bugs.toml")).unwrap().parse().unwrap();
    let bugs = bugs["bug"].as_array().unwrap();
    assert!(bugs.len() >= 20, "{} mistakes", bugs.len());
    for bug in bugs {
        let name = bug["name"].as_str().unwrap();
        assert!(!bug["found_by"].as_array().unwrap().is_empty(), "{name}: no invariant is to find it");
        for edit in bug["edits"].as_array().unwrap() {
            let (file, old) = (edit["file"].as_str().unwrap(), edit["old"].as_str().unwrap());
            let text = std::fs::read_to_string(format!("{root}/{file}")).unwrap();
            assert_eq!(text.matches(old).count(), 1, "{name}: {old:?} in {file}; correct swarm/bugs.toml");
        }
    }
}
