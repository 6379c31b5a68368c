//! What a camera does to a pour: its rate, its frames, and its loss on the way back. The toy cell is in main.rs.
//!
//! Tests only: any thread, may allocate, fails by panicking.

use super::*;

/// Protects the volume from a camera that is not as configured: a pour and a recording are refused with both rates, and a camera that becomes slow in
/// a pour ends it by name, before it flows.
#[test]
fn a_camera_with_another_rate_pours_nothing() {
    let mut cell = ToyCell::new();
    cell.settings.frame_ns *= 2;
    cell.core = Core::new(cell.settings);
    cell.core.exchange(always(13));
    (0..20).for_each(|_| _ = cell.tick(None));
    let Err(refusal @ Refusal::FrameRate(..)) = cell.pour(50.0) else { panic!("not refused") };
    assert!(refusal.to_string().contains("gives 30.0 frames a second, and camera.fps is 15.0"), "{refusal}");

    let mut cell = ToyCell::new();
    (0..20).for_each(|_| _ = cell.tick(None));
    cell.pour(50.0).expect("ready");
    let ticks = (0..200).find(|k| {
        cell.camera = k % 2 == 0;
        cell.tick(None);
        cell.core.phase() != Phase::Pouring
    });
    assert!(ticks.is_some_and(|t| t <= 20), "{ticks:?} ticks");
    cell.camera = true;
    let outcome = cell.finish();
    assert_eq!((outcome.reason, outcome.poured_words().starts_with("at least ")), (EndReason::FrameRate, true));
}

/// Protects what is said: what leaves on the way upright is a part of the pour, so a camera that dies then, or is another one, leaves no pour
/// that is done.
#[test]
fn a_pour_whose_way_back_is_not_seen_is_not_done() {
    type Trouble = fn(&mut ToyCell);
    let troubles: [(Trouble, EndReason); 3] =
        [(|_| (), EndReason::Done), (|w| w.camera = false, EndReason::StaleFeature), (|w| w.epoch_ns += 1, EndReason::WorkerRestarted)];
    for (trouble, reason) in troubles {
        let mut cell = ToyCell::new();
        cell.pour(20.0).expect("ready");
        while cell.core.phase() == Phase::Pouring {
            cell.tick(None);
        }
        trouble(&mut cell);
        let outcome = cell.finish();
        assert_eq!((outcome.reason, outcome.poured_words().starts_with("at least ")), (reason, reason != EndReason::Done));
    }
}

/// Protects what is said: a camera that gives half of its frames on the way upright hides half of what leaves there, and one that dies after the
/// command is upright hides what leaves while the joint is not.
#[test]
fn what_hides_the_end_of_the_way_back_is_named() {
    let returning = || {
        let mut cell = ToyCell::new();
        (0..20).for_each(|_| _ = cell.tick(None));
        cell.pour(20.0).expect("ready");
        while cell.core.phase() == Phase::Pouring {
            cell.tick(None);
        }
        cell
    };
    let mut slow = returning();
    for k in 0..20 {
        slow.camera = k % 2 == 0;
        slow.tick(None);
    }
    slow.camera = true;
    let mut late = returning();
    late.joint_deg_s = 50.0;
    while late.core.phase() == Phase::Returning {
        late.tick(None);
    }
    (late.joint_deg_s, late.camera) = (20.0, false);
    (0..8).for_each(|_| _ = late.tick(None));
    (late.joint_deg_s, late.camera) = (f32::INFINITY, true);
    assert_eq!([slow.finish().reason, late.finish().reason], [EndReason::FrameRate, EndReason::StaleFeature]);
}

/// Protects what is said: a controller that was held up on the way upright has not seen what left meanwhile, and the robot came upright by itself.
#[test]
fn a_controller_that_sleeps_on_the_way_back_is_not_done() {
    for sleeps in [false, true] {
        let mut cell = ToyCell::new();
        cell.pour(20.0).expect("ready");
        while cell.core.phase() == Phase::Pouring {
            cell.tick(None);
        }
        cell.tick(None);
        if sleeps {
            cell.now_ns += 5_000_000_000;
        }
        let outcome = cell.finish();
        let expected = if sleeps { EndReason::ControllerOverrun } else { EndReason::Done };
        assert_eq!((outcome.reason, outcome.poured_words().starts_with("at least ")), (expected, sleeps));
    }
}

/// Protects what is said: a controller that sleeps while the last drops are waited for has not seen them, and is done only if the joint was upright when
/// it fell asleep; where it is when it wakes up says nothing.
#[test]
fn a_controller_that_sleeps_while_it_settles_says_what_it_missed() {
    for (joint_deg, reason) in [(0.0, EndReason::Done), (10.0, EndReason::ControllerOverrun)] {
        let mut cell = ToyCell::new();
        cell.pour(20.0).expect("ready");
        while cell.core.phase() != Phase::Settling {
            cell.tick(None);
        }
        cell.tick_with_joint_at(joint_deg);
        cell.alpha_deg = 0.0;
        cell.now_ns += 1_000_000_000;
        let outcome = cell.finish();
        assert_eq!((outcome.reason, outcome.poured_words().starts_with("at least ")), (reason, true), "{joint_deg}");
    }
}

/// Protects what is said: of a robot that is lost while the last drops are waited for nobody knows how many fell.
#[test]
fn a_robot_that_is_lost_among_the_last_drops_leaves_the_volume_open() {
    for hindrance in [EndReason::RobotLost, EndReason::ProtectiveStop] {
        let mut cell = ToyCell::new();
        cell.pour(90.0).expect("ready");
        cell.run_to_flow();
        cell.tick(Some(Order::Abort));
        while cell.core.phase() != Phase::Settling {
            cell.tick(None);
        }
        cell.tick(None);
        cell.hindrance = Some(hindrance);
        let outcome = cell.tick(None).ended.expect("ended");
        assert_eq!((outcome.reason, outcome.poured_words().starts_with("at least ")), (EndReason::Aborted, true));
    }
}

/// Protects what is said after an abort: a camera that dies on the way upright hides what leaves there, whatever the pour ended for.
#[test]
fn an_abort_does_not_hide_that_the_camera_was_lost() {
    for dies in [false, true] {
        let mut cell = ToyCell::new();
        cell.pour(90.0).expect("ready");
        cell.run_to_flow();
        cell.tick(Some(Order::Abort));
        cell.camera = !dies;
        let outcome = cell.finish();
        assert_eq!((outcome.reason, outcome.poured_words().starts_with("at least ")), (EndReason::Aborted, dies));
    }
}

/// Protects the volume of a fast camera: what flows in a gap of half a second is counted, however many frames that is, and a longer gap than a second
/// counts as one.
#[test]
fn a_gap_is_bridged_by_its_time() {
    for (hz, gap_frames, bridged) in [(30u64, 15, 15), (30, 90, 30), (120, 60, 60), (120, 500, 120)] {
        let mut cell = ToyCell::new();
        cell.settings.frame_ns = 1_000_000_000 / hz;
        cell.core = Core::new(cell.settings);
        cell.core.exchange(always(13));
        cell.tick(None);
        cell.pour(90.0).expect("ready");
        let before = cell.core.counters().bridged_frames;
        cell.sequence += gap_frames;
        cell.tick(None);
        assert_eq!(cell.core.counters().bridged_frames - before, bridged, "{gap_frames} frames at {hz} Hz");
    }
}

/// Protects d from being counted twice: repeated, older and foreign features are ignored and counted.
#[test]
fn repeated_features_count_once() {
    let mut cell = ToyCell::new();
    cell.pour(30.0).expect("ready");
    cell.run_to_flow();
    cell.now_ns += cell.settings.period_ns;
    let feature = cell.feature();
    let once_ml = cell.step(&[feature], None).telemetry.d_ml;
    cell.now_ns += cell.settings.period_ns;
    let older = Feature { sequence: 1, ..feature };
    let foreign = Feature { version: LAYOUT_VERSION + 1, sequence: 1_000_000, ..feature };
    assert_eq!(cell.step(&[feature, older, foreign], None).telemetry.d_ml, once_ml);
    assert_eq!(cell.core.counters().ignored_features, 3);
}

/// Protects the operator from 59 ml that are called 150: an area of a larger picture is larger, so weights of other pictures pour nothing, and say what
/// differs. Where either side does not say its pictures, as weights from tables, the pour begins.
#[test]
fn weights_of_another_picture_pour_nothing() {
    let small = Framing { size_px: [640, 480], method_code: 1, lip_px: [300.0, 180.0], axes_deg: [0.0, -80.0] };
    let large = Framing { size_px: [960, 720], lip_px: [450.0, 270.0], ..small };
    let poured = |trained: Framing, seen: Framing| {
        let mut cell = ToyCell::new();
        cell.framing = seen;
        cell.core.exchange(always_in(13, trained));
        cell.tick(None);
        cell.pour(50.0).map_err(|refusal| refusal.to_string())
    };
    let refused = poured(small, large).unwrap_err();
    assert!(
        refused.starts_with("the weights were trained on pictures of 640 x 480 px and not of 960 x 720, as the cell has it"),
        "{refused}"
    );
    let (clear, either) = (Framing { method_code: 2, ..small }, Framing { method_code: 0, ..small });
    let refused = poured(small, clear).unwrap_err();
    assert!(
        refused.starts_with("the weights were trained on areas by the method 'colour' and not by 'clear', as the cell has it"),
        "{refused}"
    );
    for (trained, seen) in [(small, small), (small, Framing::default()), (Framing::default(), large), (either, clear)] {
        assert_eq!(poured(trained, seen), Ok(()));
    }
}

/// Protects the operator from "ready": what would refuse an order is known in each tick before one is given, and whether it hinders a recording too.
#[test]
fn what_would_refuse_an_order_is_known_before() {
    let known = |cell: &mut ToyCell| {
        (0..10).for_each(|_| _ = cell.tick(None));
        let refuses = cell.core.counters().refuses;
        assert_eq!(cell.pour(50.0).err(), refuses);
        (refuses, refuses.is_some_and(|refusal| refusal.hinders_recording()))
    };
    assert_eq!(known(&mut ToyCell::new()), (None, false));
    let mut busy = ToyCell::new();
    busy.pour(50.0).expect("ready");
    assert_eq!(known(&mut busy), (Some(Refusal::Busy), true));
    let mut blank = ToyCell::new();
    blank.core = Core::new(blank.settings);
    assert_eq!(known(&mut blank), (Some(Refusal::NoWeights), false));
    let mut dark = ToyCell::new();
    dark.doubt = Doubt::TooDark;
    assert_eq!(known(&mut dark), (Some(Refusal::NoFeature), true));
    let mut slow = ToyCell::new();
    slow.speed_scaling = Some(0.4);
    assert_eq!(known(&mut slow), (Some(Refusal::Slowed(0.4)), true));
}
