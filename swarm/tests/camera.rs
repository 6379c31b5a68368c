//! The second depth of the eye: drawn frames, measured by the worker's own extraction.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use shared::control::EndReason;
use simulator::camera::faults::FaultKind;
use simulator::ur::Series;
use swarm::camera::{Depth, spent_s};
use swarm::many::{Seeds, run_many};
use swarm::plan::{Choice, Only, Plan};
use swarm::site::config;

/// Protects the whole way from the liquid over the picture to the cup, with the weights that were learned from pictures: a handful of seeds keeps
/// every invariant, the same twice, and some of them pour what they say.
#[test]
fn seeds_before_a_camera_keep_every_invariant() {
    let config = config().unwrap();
    let choice = Choice { vessels: 1, series: Some(Series::Cb3), depth: Depth::Camera, ..Choice::default() };
    let seeds = Seeds { from: 600_100, count: 6, choice };
    let (shown, summary) = run_many(seeds, &config, false).unwrap();
    let bad: Vec<_> = shown.iter().flat_map(|one| one.violations.iter().map(|v| (one.seed, v))).collect();
    assert!(bad.is_empty(), "{bad:?}");
    let done = shown.iter().flat_map(|one| &one.poured).filter(|p| p.reason == EndReason::Done && p.goal_ml.is_some()).count();
    assert!(done > 0, "no pour was done: {:?}", summary.reasons);
    assert!(spent_s().iter().all(|s| *s > 0.0), "no picture was drawn or measured");
    let again = run_many(Seeds { count: 2, ..seeds }, &config, false).unwrap().0;
    assert_eq!(format!("{again:?}"), format!("{:?}", &shown[..2]));
}

/// Protects the tables of single faults: an event that is asked for alone has no fault of the pictures beside it, which half of the seeds drew, and with a
/// fault of the pictures nothing else happens.
#[test]
fn a_fault_that_is_asked_for_alone_is_alone() {
    let plan = |seed: u64, only: Only| Plan::draw_with(seed, Choice { only: Some(only), depth: Depth::Camera, ..Choice::default() });
    for seed in 0..40 {
        let event = plan(seed, Only::named("link-cut", Depth::Camera).unwrap());
        assert!(event.picture.is_none() && !event.faults.is_empty(), "{event:?}");
        let picture = plan(seed, Only::named("picture-torn", Depth::Camera).unwrap());
        assert!(picture.picture.is_some_and(|fault| fault.kind == FaultKind::Torn) && picture.faults.is_empty(), "{picture:?}");
    }
}
