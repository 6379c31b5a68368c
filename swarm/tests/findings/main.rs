//! What seeds have found, each as a test with a name: the plan that the seed drew then, so that it stays when seeds draw something else.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use rt_controller::core::{Robot, Settings};
use rt_controller::journal::{Tick, Times};
use shared::config::Joint;
use shared::control::EndReason;
use shared::messages::{Phase, Telemetry};
use simulator::ur::servo::LAG_S;
use simulator::ur::{Fault, Series};
use swarm::camera::Depth;
use swarm::check::Checks;
use swarm::faults::named;
use swarm::plan::{Item, Plan};
use swarm::run::{Shown, run};
use swarm::site::config;
use swarm::trained::train_for;
use swarm::what::{EyeFault, Weighed, What};

mod hands;

/// What happens: when, ms; what; and the kind of the fault that it is, if it is one.
type Happens = (u64, What, Option<&'static str>);

/// Runs the plan of a seed in the vessel of this number, whose content, ml, and network are given, and fails if anything is violated.
fn shown(seed: u64, series: Series, vessel: usize, drawn: (f64, (u64, u64)), happens: &[Happens]) -> Shown {
    lagging(seed, (series, LAG_S), vessel, drawn, happens)
}

/// The same on a robot that lags by a time constant of its own, s.
fn lagging(seed: u64, (series, lag_s): (Series, f64), vessel: usize, (fill_ml, delay_ns): (f64, (u64, u64)), happens: &[Happens]) -> Shown {
    let mut faults = Vec::new();
    let mut items = Vec::new();
    for (at_ms, what, kind) in happens {
        let fault = kind.map(|name| {
            faults.push(named(name).unwrap());
            faults.len() - 1
        });
        items.push(Item { at_ms: *at_ms, what: what.clone(), fault });
    }
    let until_ms = items.iter().map(|item| item.at_ms + item.what.takes_ms()).max().unwrap() + 12_000;
    let plan = Plan { seed, series, vessel, fill_ml, delay_ns, lag_s, depth: Depth::Area, picture: None, items, faults, until_ms };
    let config = config().unwrap();
    let shown = run(&plan, &train_for([&plan], &config, &|_| {}).unwrap(), &config, true);
    assert!(shown.violations.is_empty(), "{:?}\n{}", shown.violations, shown.story.join("\n"));
    shown
}

/// Whether the story has a line with these words between two times, s.
fn tells(shown: &Shown, words: &str, from_s: f64, to_s: f64) -> bool {
    let at = |line: &str| line.split(" s ").next().and_then(|s| s.trim().parse::<f64>().ok()).unwrap_or_default();
    shown.story.iter().any(|line| line.contains(words) && at(line) > from_s && at(line) < to_s)
}

/// Protects an operator who has recorded a light curve (seed 501465): the trainer's weights had a variance that no reader takes.
#[test]
fn a_light_curve_gives_weights_that_can_be_read() {
    let happens = [
        (3_474, What::Record(72.479485, 1.1387947), None),
        (18_474, What::Learn(Weighed::Right), None),
        (18_974, What::Refill(336.7162391796762), None),
        (20_474, What::Pour(150.0), None),
    ];
    let shown = shown(501_465, Series::ESeries, 8, (303.611631992684, (358_701, 916_726)), &happens);
    assert!(tells(&shown, "learning with", 18.0, 19.0) && shown.poured.len() == 2, "{}", shown.story.join("\n"));
}

/// Protects the cup from a pour of nothing that is called done (seed 501474): one frame showed a stream before anything flowed.
#[test]
fn one_false_frame_is_no_pour() {
    let happens = [(3_422, What::Pour(71.06821), None), (5_258, What::Eye(EyeFault::Spike(972.52405)), Some("eye-spike"))];
    let shown = shown(501_474, Series::ESeries, 4, (318.67673197472493, (105_411, 135_365)), &happens);
    let pour = &shown.poured[0];
    let is_poured = (pour.true_ml - 71.0).abs() < 15.0;
    assert!(is_poured || pour.reason != EndReason::Done, "{pour:?}");
}

/// Protects the check (seed 500163): a late tick that need not end a pour does not bound what the pour goes on to give, when the robot is lost
/// on its way upright.
#[test]
fn a_fault_on_the_way_upright_counts() {
    let happens = [
        (2_956, What::Pour(124.965775), None),
        (3_122, What::Overrun(63), Some("overrun")),
        (10_434, What::Robot(Fault::Offline(0.5854420915779351)), Some("offline")),
    ];
    shown(500_163, Series::Cb3, 8, (254.67, (32_946, 362_117)), &happens);
}

/// Protects the check (seed 501101): a curve that tilts a full vessel to 96 degrees gives 600 ml/s, and what leaves on the way back from there is
/// its operator's choice. The controller ended it in the tick after the second worker's first measurement.
#[test]
fn a_high_curve_gives_what_it_gives() {
    let happens = [(3_358, What::Record(100.436714, 1.0154158), None), (7_062, What::Eye(EyeFault::Two(2_433)), Some("second-worker"))];
    let shown = shown(501_101, Series::Cb3, 9, (361.67879862540906, (164_937, 1_426_207)), &happens);
    assert_eq!(shown.poured[0].reason, EndReason::WorkerRestarted);
}

/// Protects the check (seed 500925): a gain that has drifted by a quarter is seen by nobody, and excuses as much as it hides.
#[test]
fn a_gain_that_drifts_excuses_what_it_hides() {
    let happens = [
        (2_516, What::Eye(EyeFault::GainDrift(-0.2583486932077919)), Some("eye-gain-drift")),
        (16_800, What::Pour(78.36803), None),
        // The pour has time to end.
        (30_000, What::Resume, None),
    ];
    let shown = shown(500_925, Series::Cb3, 9, (193.9489163555821, (124_581, 13_250)), &happens);
    assert!(shown.poured[0].true_ml > 90.0, "the drift is not felt: {:?}", shown.poured[0]);
}

/// Protects the check (seeds 1001110, 1002651, 1004666): a person has moved the tilting joint by hand below its range while the program was paused,
/// and resumes it. It begins anew where the joint is, and brings it upright from there.
#[test]
fn a_joint_that_a_hand_moved_beyond_its_range_comes_back() {
    let happens = [
        (2_238, What::Robot(Fault::ProtectiveStop), Some("protective-stop")),
        (2_710, What::Pour(109.46197), None),
        (13_853, What::Robot(Fault::UnlockProtectiveStop), Some("protective-stop")),
        (15_505, What::Resume, None),
        (17_441, What::Robot(Fault::Freedrive), Some("hand-move")),
        (20_941, What::Robot(Fault::HandMove(Joint::Wrist3, -24.264159550400578)), Some("hand-move")),
        (21_072, What::Robot(Fault::ProgramPause), Some("jog")),
        (27_658, What::Robot(Fault::FreedriveEnd), Some("hand-move")),
        (28_458, What::Robot(Fault::ProgramResume), Some("jog")),
    ];
    let shown = lagging(1_001_110, (Series::Cb3, 0.041958293642146934), 0, (382.44290108493465, (192_447, 281_169)), &happens);
    assert!(
        tells(&shown, "decant_pour resumed", 28.0, 29.0) && tells(&shown, "container upright", 28.5, 30.0),
        "{}",
        shown.story.join("\n")
    );
}

/// Protects what a pour says of itself on a robot that lags by far more than was learned (seed 502537): the steep vessel gave 38 ml of 18, and the
/// pour said 20.6 +- 2.2 ml. It may be off, but by no more than it says.
#[test]
fn a_lag_that_was_not_learned_is_in_the_deviation() {
    let happens = [(3_245, What::Pour(17.78867), None), (9_290, What::LinkSplit(879), Some("link-split"))];
    let drawn = (43.93723994225984, (182_650, 790_783));
    let shown = lagging(502_537, (Series::Cb3, 0.06737018128167158), 3, drawn, &happens);
    let pour = &shown.poured[0];
    assert!(pour.reason != EndReason::Done || (pour.true_ml - f64::from(pour.believed_ml)).abs() < 2.5 * f64::from(pour.sd_ml), "{pour:?}");
}

/// Protects the check (seeds 14722986, 14751143): an arm that lags by ten times what was learned is slower than it is commanded, so that a pour may end
/// because it does not follow, without a fault.
#[test]
fn an_arm_that_lags_by_far_may_not_follow() {
    let happens = [(2_532, What::Pour(66.97989), None)];
    let shown = lagging(14_722_986, (Series::ESeries, 0.119), 9, (151.0, (266_117, 645_915)), &happens);
    println!("{}", shown.story.join("\n"));
    assert_eq!(shown.poured[0].reason, EndReason::NotFollowed);
}

/// Protects the check (seed 14770189): a shorter time without the robot does not end a longer one.
#[test]
fn a_shorter_time_offline_does_not_end_a_longer_one() {
    let happens = [
        (3_000, What::Robot(Fault::Offline(12.8)), Some("offline")),
        (5_000, What::Robot(Fault::Offline(0.4)), Some("offline")),
        (12_000, What::Pour(40.0), None),
    ];
    let shown = shown(14_770_189, Series::Cb3, 0, (300.0, (266_117, 645_915)), &happens);
    assert!(!tells(&shown, "robot connected", 3.0, 15.7), "{}", shown.story.join("\n"));
}

/// Protects the check (seed 3037645): a freeze of 44 ms within one of 333 ms ended that too, in the simulated robot, and nothing was left to notice.
#[test]
fn a_shorter_fault_does_not_end_a_longer_one_of_its_kind() {
    let happens = [
        (3_200, What::Pour(92.75543), None),
        (4_880, What::Robot(Fault::Freeze(0.333)), Some("freeze")),
        (4_963, What::Robot(Fault::Freeze(0.044)), Some("freeze")),
    ];
    let frozen = shown(3_037_645, Series::Cb3, 1, (300.0, (266_117, 645_915)), &happens);
    assert!(tells(&frozen, "ended: RobotStalled", 4.9, 5.4), "{}", frozen.story.join("\n"));
    // The same in the loop (seed 4029960): a tick that is late by 34 ms ended one that was late by 214.
    let happens =
        [(3_243, What::Pour(183.9416), None), (3_917, What::Overrun(214), Some("overrun")), (3_982, What::Overrun(34), Some("overrun"))];
    let late = shown(4_029_960, Series::Cb3, 1, (300.0, (266_117, 645_915)), &happens);
    assert!(tells(&late, "ended: ControllerOverrun", 3.9, 4.4), "{}", late.story.join("\n"));
}

/// Protects an operator who types 4 g for 36 (seed 4011582) where only two other curves of the vessel gave a weight: the trainer compared no fewer than
/// four, and what it learned called 341 ml a pour of 93 +- 39.
#[test]
fn a_mistyped_weight_among_few_is_doubted() {
    let happens = [
        (3_066, What::Record(98.32551, 0.90356445), None),
        (18_066, What::Learn(Weighed::Mistyped(0.1)), None),
        (18_566, What::Refill(429.14794813732874), None),
        (20_066, What::Pour(94.13351), None),
    ];
    let shown = shown(4_011_582, Series::Cb3, 2, (38.0, (266_117, 645_915)), &happens);
    assert!(tells(&shown, "doubted: [DoubtfulWeight { name: \"the new one\"", 18.0, 18.5), "{}", shown.story.join("\n"));
}

/// Protects the operator from a surge (seed 501342): with a law that was searched on level surfaces, a cone gave 100 ml within three frames for some of these
/// goals, so that more than 190 ml left. That such a surge is counted is held by the next test.
#[test]
fn a_cone_that_surged_is_poured_with_care() {
    for goal_ml in [130.0f32, 134.0, 138.0, 142.0, 155.0] {
        let happens = [(2_705, What::Pour(goal_ml), None)];
        let poured = shown(501_342, Series::Cb3, 3, (235.82367592759545, (176_091, 270_224)), &happens).poured[0].clone();
        assert!(poured.reason == EndReason::Done && (poured.true_ml - f64::from(goal_ml)).abs() < 25.0, "{poured:?}");
    }
}

/// Protects the operator from a surge that was not counted (seed 501342): "done, 169 +- 5 ml" was said where 210 had left. With weights of a cylinder the
/// cone still gives such a surge; it is counted, and is not done.
#[test]
fn a_surge_of_a_hundred_ml_counts() {
    let poured = |goal_ml| {
        let happens = [(2_500, What::Weights(0), Some("weights-of-another-vessel")), (2_705, What::Pour(goal_ml), None)];
        shown(501_342, Series::Cb3, 3, (235.82367592759545, (176_091, 270_224)), &happens).poured[0].clone()
    };
    let surged: Vec<_> = (130..=158).step_by(2).map(|goal_ml| poured(goal_ml as f32)).filter(|pour| pour.true_ml > 190.0).collect();
    assert!(!surged.is_empty(), "there was no surge");
    for pour in surged {
        assert!(f64::from(pour.believed_ml) > 190.0 && pour.reason != EndReason::Done, "{pour:?}");
    }
}

/// Protects the operator where either of two weights may be the wrong one (seed 6028782): half of the weight was typed for a curve in which a cone gave
/// its surge, and of all others one had a surge as well. The right one was accused, and 90 +- 7 ml were said where 164 had left. Both are accused.
#[test]
fn either_of_two_weights_may_be_wrong() {
    let happens = [
        (2_725, What::Record(85.14927, 1.2938993), None),
        (19_707, What::Learn(Weighed::Mistyped(0.5)), None),
        (20_207, What::Refill(159.82908323403691), None),
        (21_707, What::Pour(63.09991), None),
        (41_227, What::Refill(163.87558578315787), None),
        (41_327, What::Resume, None),
        (42_727, What::Pour(120.59294), None),
        (50_061, What::Abort, Some("abort")),
    ];
    let shown = shown(6_028_782, Series::Cb3, 3, (215.2106966547279, (404_471, 1_227_863)), &happens);
    let lesson = shown.story.iter().find(|line| line.contains("learning with")).unwrap();
    assert!(lesson.contains("240 ml in a cone-in") && lesson.contains("the new one"), "{lesson}");
    for pour in &shown.poured[1..] {
        let off_ml = (f64::from(pour.believed_ml) - pour.true_ml).abs();
        assert!(off_ml < 3.0 * f64::from(pour.sd_ml), "{pour:?}");
    }
}

/// Protects the check (seed 10027787): a speed limit that stood before the pour ended it, and three lost frames are not held against what it poured.
#[test]
fn what_stood_before_ends_a_pour() {
    let happens = [
        (2_963, What::Pour(36.701187), None),
        (2_972, What::Robot(Fault::JointSpeedLimit(38.59108149092471)), Some("joint-speed-limit")),
        (5_709, What::Eye(EyeFault::Loss(3)), Some("eye-loss")),
        (9_973, What::Robot(Fault::Clear), Some("joint-speed-limit")),
    ];
    let shown = shown(10_027_787, Series::Cb3, 2, (434.67740993211345, (189_353, 354_987)), &happens);
    assert_eq!(shown.poured[0].reason, EndReason::NotFollowed);
}

/// Protects the operator where a pour is cut on its way upright (seed 10110927): it was aborted, and a late tick lost the robot 0.2 s later. 6.6 +- 0.2 ml
/// were said where 12.9 had left. What still leaves is in the deviation.
#[test]
fn what_still_leaves_is_in_the_deviation() {
    let happens = [(2_771, What::Pour(81.754135), None), (4_535, What::Abort, Some("abort")), (4_701, What::Overrun(180), Some("overrun"))];
    let shown = shown(10_110_927, Series::Cb3, 1, (297.0, (200_000, 400_000)), &happens);
    let pour = &shown.poured[0];
    assert!(pour.reason == EndReason::Aborted && pour.true_ml > f64::from(pour.believed_ml) + 3.0, "it is not cut: {pour:?}");
    assert!(pour.sd_ml > 2.0, "{pour:?}");
}

/// Protects the check (seed 16234063): the stream ran only while the camera was blind, and the pour was aborted meanwhile. The controller says "at least
/// 0.0 ml", which is right.
#[test]
fn at_least_so_much_is_no_more() {
    let happens = [
        (3_383, What::Pour(38.349022), None),
        (4_567, What::Eye(EyeFault::Loss(14)), Some("eye-loss")),
        (4_622, What::Abort, Some("abort")),
    ];
    let drawn = (446.6330802883467, (397_973, 510_428));
    let shown = lagging(16_234_063, (Series::ESeries, 0.012), 9, drawn, &happens);
    let pour = &shown.poured[0];
    assert!(pour.reason == EndReason::Aborted && pour.true_ml > 5.0 && pour.believed_ml < 1.0, "it has seen it: {pour:?}");
}

/// Protects the check (seed 12703090): a pour had turned back by a degree before a camera's freeze could be noticed, and the joint, which lagged, still went
/// up to the target that was taken back, where the vessel gave its surge. The bound begins from the highest target that is still followed.
#[test]
fn a_joint_goes_up_to_a_target_that_was_taken_back() {
    let mut checks = Checks::new(Settings::new(&config().unwrap()), 0.008);
    let telemetry = Telemetry { phase: Phase::Pouring as u32, ..Telemetry::default() };
    let times = Times { deadline_ns: 0, decided_at_ns: 0, written_at_ns: 0, done_ns: 0, margin_ns: 0 };
    let robot = Robot::that_may_move(80.0, 1);
    for (k, target_deg) in [80.0, 82.0, 84.0, 83.0].into_iter().enumerate() {
        let features = Default::default();
        let tick = Tick { now_ns: 1, features, robot, order: None, agent: None, target_deg: Some(target_deg), d_ml: 50.0, times };
        checks.tick(&tick, &telemetry, 0, k as f64 / 30.0);
    }
    assert_eq!(checks.target(0.1).map(|(deg, _)| deg), Some(84.0));
    assert_eq!(checks.target(1.0).map(|(deg, _)| deg), Some(83.0), "what is no longer followed does not count");
}

/// Protects the table of docs/SWARM.md: what stays wrong after a fault is one of every later pour too, however long ago it began, so that "none" has only
/// pours without any. A controller that starts again has the vessel's own weights.
#[test]
fn what_stays_wrong_is_a_fault_of_later_pours() {
    let happens = [
        (3_000, What::Eye(EyeFault::GainDrift(0.05)), Some("eye-gain-drift")),
        (3_100, What::Weights(1), Some("weights-of-another-vessel")),
        (3_500, What::Robot(Fault::LateStart(0.1)), Some("late-start")),
        (20_000, What::Pour(60.0), None),
        (40_000, What::ControllerKilled(500), Some("controller-killed")),
        (41_000, What::Refill(300.0), None),
        (55_000, What::Pour(60.0), None),
    ];
    let shown = shown(9, Series::Cb3, 0, (300.0, (266_117, 645_915)), &happens);
    let faults: Vec<_> = shown.poured.iter().map(|pour| pour.faults.clone()).collect();
    assert_eq!(faults, [vec!["eye-gain-drift", "weights-of-another-vessel"], vec!["eye-gain-drift"]]);
    // The same of weights that were learned with a number that somebody mistyped.
    let happens = [
        (3_066, What::Record(80.0, 0.9), None),
        (18_066, What::Learn(Weighed::Mistyped(1.3)), None),
        (18_566, What::Refill(300.0), None),
        (40_066, What::Pour(60.0), None),
    ];
    let lesson = self::shown(9, Series::Cb3, 0, (300.0, (266_117, 645_915)), &happens);
    assert_eq!(lesson.poured[1].faults, ["doubtful-lesson"]);
}

/// Protects what a suspended controller is tried with: a process that stands still reads nothing and begins no program, whatever comes meanwhile; and how long
/// the robot's program needs to bring the container upright by itself is seen on the robot, and not when the controller wakes up.
#[test]
fn a_suspended_controller_does_nothing() {
    for at_ms in (40..500).step_by(60) {
        let at_s = at_ms as f64 / 1000.0;
        let happens = [(at_ms, What::Suspended(2_000), Some("suspended")), (3_500, What::Pour(60.0), None)];
        let frozen = shown(12, Series::Cb3, 0, (300.0, (266_117, 645_915)), &happens);
        assert!(!tells(&frozen, "robot connected", at_s, at_s + 2.0), "{}", frozen.story.join("\n"));
        assert!(tells(&frozen, "robot connected", at_s + 2.0, at_s + 3.5), "{}", frozen.story.join("\n"));
    }
    let happens = [(3_000, What::Pour(150.0), None), (6_000, What::Suspended(5_000), Some("suspended"))];
    let suspended = shown(12, Series::Cb3, 0, (300.0, (266_117, 645_915)), &happens);
    let cost = &suspended.costs[0];
    assert!((0.2..3.0).contains(&cost.upright_s), "{cost:?}");
}
