//! What ends a pour, and by which name. Tests only: any thread, may allocate, fails by panicking.

use super::*;
use shared::actions::{Selection, action_table};
use shared::agent::{Agent, Observation};
use shared::estimator::Calibration;
use shared::framing::Framing;
use shared::mlp::{InputScale, Mlp};
use shared::weights::{Estimator, Method, Origin, Weights};

/// The settings of the simulated cell, whose camera gives 30 frames a second.
fn settings() -> Settings {
    Settings::new(&shared::config::Config::parse(include_str!("../../../../config/sim.toml"), "sim.toml").unwrap())
}

/// Valid weights whose network has arbitrary parameters, made by hand.
fn example() -> Weights {
    let mut network = Mlp::ZERO;
    for (k, p) in network.parameters_mut().enumerate() {
        *p = (k as f32 * 0.7).sin() * 0.1;
    }
    Weights {
        network,
        actions_deg: action_table(),
        selection: Selection::Argmax,
        scale: InputScale::default(),
        calibration: Calibration { volume_at_1_px2_ml: 0.002, area_exponent: 1.15, log_tilt_slope: 0.05, hold_above_px2: 60.0 },
        estimator: Estimator::Sum,
        rate_hz: 30.0,
        origin: Origin { method: Method::Handmade, actions: 21, episodes: 0, data_sha256: [7; 32], framing: Framing::default() },
        seed: 1,
    }
}

fn observation(area: f32) -> Observation {
    Observation { area_px2: Some(area), confidence: 1.0, alpha_deg: 50.0, alpha_measured_deg: f32::NAN, alpha_now_deg: 50.0 }
}

/// Protects the idle robot: without a goal nothing ends, whatever is seen.
#[test]
fn without_a_goal_nothing_ends() {
    let mut agent = Agent::new(&example());
    for goal in [f32::NAN, -5.0, 0.0, f32::INFINITY] {
        agent.start(goal);
        let mut ending = Ending::of_pour();
        for area in [0.0, 300.0, f32::NAN] {
            let decision = agent.step(observation(area));
            assert_eq!((decision.dalpha_deg, decision.d_ml, ending.decided(&decision, &settings())), (0.0, 0.0, false));
        }
    }
}

/// Protects eq. (2) and (4): d starts at the goal, falls by each frame's volume, goes below 0, and ends the pour.
#[test]
fn d_counts_down_and_ends_the_pour() {
    let weights = example();
    let (mut agent, mut ending) = (Agent::new(&weights), Ending::of_pour());
    let v = weights.calibration.volume_ml(200.0, 50.0);
    agent.start(3.5 * v);
    for k in 0..5 {
        let decision = agent.step(observation(200.0));
        assert_eq!(ending.decided(&decision, &settings()), k >= 3);
    }
    agent.start(10.0);
    assert!(!Ending::of_pour().decided(&agent.step(observation(0.0)), &settings()), "a new goal starts anew");
}

/// Protects the end of every pour: an agent that stands still short of its goal has come to its end, also while a trickle
/// flickers in and out of sight; one that creeps on, still waits for its first flow, or pours has not.
#[test]
fn an_agent_that_stands_still_comes_to_its_end() {
    let mut weights = example();
    weights.network = Mlp::ZERO;
    for (action, flow_at_first, flow_later, ends) in
        [(10, 100.0, 0.0, true), (10, 100.0, 0.1, true), (12, 100.0, 0.0, false), (10, 0.0, 0.0, false), (10, 100.0, 90.0, false)]
    {
        weights.network.b3 = [0.0; shared::actions::ACTIONS];
        weights.network.b3[action] = 1.0;
        let (mut agent, mut ending) = (Agent::new(&weights), Ending::of_pour());
        agent.start(5000.0);
        let first = ending.decided(&agent.step(observation(flow_at_first)), &settings());
        let ended = (0..200).filter(|_| ending.decided(&agent.step(observation(flow_later)), &settings())).count();
        assert_eq!((first, ended > 0), (false, ends), "action {action}, then {flow_later} px^2");
    }
}

/// Protects the operator from nothing, or a cup that ran over unseen, that is called done. A little off is done, and another reason stays.
#[test]
fn far_off_the_goal_is_not_done() {
    use EndReason::{Aborted, Done, GoalExceeded, StreamLost};
    let settings = settings();
    let after = |d_ml: f32, poured_ml: f32, poured_sd_ml: f32, before| {
        let mut ending = Ending::of_pour();
        ending.decided(&Decision { d_ml, poured_ml, poured_sd_ml, tilting_back: true, ..Decision::NOTHING }, &settings);
        ending.end_with(before);
        ending.settled(0.0, 4.0, false, &settings).unwrap()
    };
    assert_eq!([after(65.0, 6.0, 0.0, Done), after(65.0, 6.0, 20.0, Done)], [StreamLost; 2]);
    assert_eq!(after(65.0, 6.0, 0.0, Aborted), Aborted);
    assert_eq!([after(7.0, 64.0, 0.0, Done), after(15.0, 185.0, 0.0, Done), after(-7.0, 46.0, 20.0, Done)], [Done; 3]);
    assert_eq!([after(-85.0, 124.0, 20.0, Done), after(-46.0, 210.0, 25.0, Done)], [GoalExceeded; 2], "its deviation is no excuse");
    assert_eq!([after(-4.5, 12.5, 3.0, Done), after(-3.5, 11.5, 3.0, Done)], [GoalExceeded, Done], "half of a small goal");
    assert_eq!(after(-85.0, 124.0, 0.0, Done), Done, "a plain sum foresees nothing");
}

/// Protects the operator from a false stream: a pour that seemed done is not, if it goes on at an upright container. Another reason stays.
#[test]
fn what_cannot_be_on_the_way_back_is_named() {
    let impossible = Decision { impossible: Some(Impossible::Flow), ..Decision::NOTHING };
    for (before, after) in [(EndReason::Done, EndReason::ImpossibleFlow), (EndReason::Aborted, EndReason::Aborted)] {
        let mut ending = Ending::of_pour();
        ending.end_with(before);
        ending.returns(true, None);
        assert_eq!(ending.reason(), before);
        ending.decided(&impossible, &settings());
        ending.returns(true, None);
        assert_eq!(ending.reason(), after);
    }
}

/// Protects the operator: the reason that came first is the one that is reported.
#[test]
fn the_first_reason_stays() {
    let mut ending = Ending::of_pour();
    ending.end_with(EndReason::StreamLost);
    ending.end_instead_of_done(EndReason::ProtectiveStop);
    assert_eq!(ending.reason(), EndReason::StreamLost);
    let mut done = Ending::of_pour();
    done.end_instead_of_done(EndReason::ProtectiveStop);
    assert_eq!(done.reason(), EndReason::ProtectiveStop);
}

/// Protects a pour whose camera shows nothing: if it is known how much is in the vessel, the pour ends by name soon after the tilt at which
/// that would flow, and not at the largest one. Flow that was seen, or an unknown fill, never ends so; a lone flash is no flow.
#[test]
fn nothing_flows_where_it_must() {
    let settings = settings();
    let dry_frames = settings.frames(DRY_S);
    let moment = Moment { running_s: 2.0, frames: 60, measurement_age_ns: 0, alpha_deg: 70.0, poured_ml: 0.0, follows: true };
    let after = |flows_by_deg: Option<f32>, flowed: bool, frames: u32| {
        let mut ending = Ending::of_pour_that_flows_by(flows_by_deg);
        ending.seen_stream = flowed;
        for _ in 0..frames {
            let frame = SeenFrame { lost: 0, area_px2: Some(0.0), cut_off: false, flowing: false, alpha_deg: 62.0, alpha_now_deg: 63.0 };
            ending.saw(&frame, &settings);
        }
        ending.due(&moment, &settings)
    };
    assert_eq!(after(Some(60.0), false, dry_frames), Some(EndReason::NothingFlows));
    assert_eq!(after(Some(60.0), false, dry_frames - 1), None);
    assert_eq!(after(Some(65.0), false, dry_frames), None);
    assert_eq!(after(Some(60.0), true, dry_frames), None);
    assert_eq!(after(None, false, dry_frames), None);
    let mut flashed = Ending::of_pour_that_flows_by(Some(60.0));
    for area_px2 in std::iter::once(100.0).chain([0.0; 10]).map(Some) {
        flashed.saw(
            &SeenFrame { lost: 0, area_px2, cut_off: false, flowing: area_px2 > Some(0.0), alpha_deg: 62.0, alpha_now_deg: 63.0 },
            &settings,
        );
    }
    assert_eq!(flashed.due(&moment, &settings), Some(EndReason::NothingFlows));
}

/// Protects what is said: a stream that goes on without a pause out of a container that has long been upright is none, so what was seen before is not
/// believed either. Drops that go on are dripping, and what falls later is said to be missing. Quiet is quiet; another reason stays.
#[test]
fn a_stream_out_of_an_upright_container_is_named() {
    use EndReason::{Aborted, Done, ImpossibleFlow};
    let settings = settings();
    let after = |before: EndReason, pause: u32| {
        let mut ending = Ending::of_pour();
        ending.end_with(before);
        ending.begin_settling();
        for frame in 1..=200 {
            let flowing = frame % pause != 0;
            let area_px2 = Some(if flowing { 90.0 } else { 0.0 });
            ending.saw(&SeenFrame { lost: 0, area_px2, cut_off: false, flowing, alpha_deg: 0.0, alpha_now_deg: 0.0 }, &settings);
            if let Some(reason) = ending.settled(0.0, f64::from(frame) / 30.0, false, &settings) {
                return (reason, ending.leaves_unseen(reason));
            }
        }
        panic!("it never ended");
    };
    assert_eq!([after(Done, 1000), after(Aborted, 1000)], [(ImpossibleFlow, true), (Aborted, true)]);
    assert_eq!([after(Done, 10), after(Done, 1)], [(Done, true), (Done, false)]);
}

/// Protects what is said of a pour that was ending already: an abort does not bring back what a lost camera or robot hid.
#[test]
fn what_was_not_seen_is_said_whatever_the_reason() {
    for before in [EndReason::Aborted, EndReason::MaxFrames, EndReason::ContainerEmpty] {
        let ending = || {
            let mut ending = Ending { seen_stream: true, ..Ending::of_pour() };
            ending.end_with(before);
            ending
        };
        assert!(!ending().leaves_unseen(before));
        for blind in [EndReason::StaleFeature, EndReason::FrameRate] {
            let mut ending = ending();
            ending.returns(true, Some(blind));
            assert_eq!((ending.reason(), ending.leaves_unseen(before)), (before, true));
        }
        let mut ending = ending();
        assert_eq!(ending.without_robot(EndReason::RobotLost, false, &settings()), before);
        assert!(ending.leaves_unseen(before));
    }
}

/// Protects what is said of a stream that leaves the region: its areas are lower bounds, so the volume is one, as soon as they are as large a share as
/// a file may have that is trained.
#[test]
fn what_leaves_the_region_is_a_lower_bound() {
    let unseen = |cut_off_frames: u32| {
        let mut ending = Ending::of_pour();
        for frame in 0..100 {
            let cut_off = frame < cut_off_frames;
            let frame = SeenFrame { lost: 0, area_px2: Some(900.0), cut_off, flowing: true, alpha_deg: 50.0, alpha_now_deg: 50.0 };
            ending.saw(&frame, &settings());
        }
        ending.leaves_unseen(EndReason::Done)
    };
    assert_eq!([0, 5, 6, 100].map(unseen), [false, false, true, true]);
}

/// Protects the operator of a pour in which no stream was ever seen: an empty container and a camera that sees nothing look alike, so the volume is
/// a lower bound, at the largest tilt, when the frames run out, and where somebody stops it. Where a stream was seen, it is not. The container is upright all
/// the same.
#[test]
fn a_pour_without_a_stream_may_be_an_unseen_one() {
    let settings = settings();
    let alpha_deg = settings.limits.alpha_max_deg;
    let after = |streamed: bool, frames: u32, alpha_deg: f32| {
        let mut ending = Ending::of_pour();
        for frame in 0..frames {
            let flowing = streamed && frame < 2;
            let area_px2 = Some(if flowing { 90.0 } else { 0.0 });
            ending.saw(&SeenFrame { lost: 0, area_px2, cut_off: false, flowing, alpha_deg, alpha_now_deg: alpha_deg }, &settings);
        }
        let moment = Moment { running_s: 9.0, frames, measurement_age_ns: 0, alpha_deg, poured_ml: 0.0, follows: true };
        let stopped = [EndReason::Aborted, EndReason::Shutdown, EndReason::NotFollowed];
        assert!(stopped.iter().all(|reason| ending.leaves_unseen(*reason) != streamed && !ending.leaves_unwatched(*reason)));
        ending.due(&moment, &settings).map(|reason| (reason, ending.leaves_unseen(reason)))
    };
    let empty = settings.empty_frames + 2;
    assert_eq!(after(false, empty, alpha_deg), Some((EndReason::NothingFlows, true)));
    assert_eq!(after(true, empty, alpha_deg), Some((EndReason::ContainerEmpty, false)));
    assert_eq!(after(false, settings.max_frames, 30.0), Some((EndReason::MaxFrames, true)));
    assert_eq!(after(true, settings.max_frames, 30.0), Some((EndReason::MaxFrames, false)));
}

/// Protects the last drops of a fast camera's pour: half a second is so many of its frames, and not those of half a second at 30 Hz.
#[test]
fn a_fast_camera_waits_as_long_as_a_slow_one() {
    for hz in [15.0, 30.0, 120.0, 240.0] {
        let settings = Settings { frame_ns: (1e9 / hz) as u64, ..settings() };
        let mut ending = Ending::of_pour();
        ending.begin_settling();
        let quiet = SeenFrame { lost: 0, area_px2: Some(0.0), cut_off: false, flowing: false, alpha_deg: 0.0, alpha_now_deg: 0.0 };
        let frames = (1..1000).find(|_| {
            ending.saw(&quiet, &settings);
            ending.settled(0.0, 0.1, false, &settings).is_some()
        });
        assert!(frames.is_some_and(|n| (f64::from(n) / hz - 0.5).abs() < 0.04), "{hz}: {frames:?}");
    }
}

/// Protects what is said of the last drops from a camera that does not see them: frames that could not be measured are no quiet ones. They are waited
/// for, and where too few come, it is said that something may have left unseen.
#[test]
fn frames_without_a_measurement_are_not_quiet() {
    let settings = settings();
    let after = |measured: fn(u32) -> bool| {
        let mut ending = Ending::of_pour();
        ending.begin_settling();
        (1..=200).find_map(|frame| {
            let area_px2 = measured(frame).then_some(0.0);
            ending.saw(&SeenFrame { lost: 0, area_px2, cut_off: false, flowing: false, alpha_deg: 0.0, alpha_now_deg: 0.0 }, &settings);
            let reason = ending.settled(0.0, f64::from(frame) / 30.0, false, &settings)?;
            Some((frame, reason, ending.leaves_unseen(reason)))
        })
    };
    assert_eq!(after(|_| true), Some((15, EndReason::Done, false)));
    assert_eq!(after(|frame| frame % 3 == 0), Some((45, EndReason::Done, false)));
    assert_eq!(after(|frame| frame < 10), Some((90, EndReason::Done, true)));
}
