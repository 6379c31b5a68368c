//! What seeds have found about who has the robot: when it is taken back, and when it waits for its operator.

use simulator::ur::{Fault, Series};
use swarm::what::What;

use super::{Happens, shown, tells};

/// A link that goes between the program's upload and its session, after which the operator asks; then what else happens (seed 13828907).
fn lost_at_upload(then: impl IntoIterator<Item = Happens>) -> Vec<Happens> {
    let before = [
        (3_129, What::Robot(Fault::Boot), Some("boot")),
        (12_009, What::Robot(Fault::BrakeRelease), Some("boot")),
        (21_468, What::Resume, None),
        (22_730, What::LinkCut, Some("link-cut")),
        (22_868, What::Pour(197.48412), None),
    ];
    before.into_iter().chain(then).collect()
}

/// Protects people from a controller that was killed, and started again after they had pressed stop (seed 502373): it took the robot unasked,
/// although the program's registers say that it was still at work when it went away.
#[test]
fn a_stop_is_seen_by_a_controller_that_was_not_there() {
    let happens = [
        (2_557, What::Pour(178.88078), None),
        (3_474, What::ControllerKilled(1_248), Some("controller-killed")),
        (4_442, What::Robot(Fault::ProgramStop), Some("program-stop")),
        (16_073, What::Resume, None),
    ];
    let shown = shown(502_373, Series::Cb3, 7, (298.3105164319111, (266_117, 645_915)), &happens);
    assert!(!tells(&shown, "decant_pour started", 4.5, 16.0), "{}", shown.story.join("\n"));
    assert!(tells(&shown, "was stopped", 4.5, 16.0) && tells(&shown, "decant_pour started", 16.0, 20.0), "{}", shown.story.join("\n"));
}

/// Protects the check from a false alarm (seed 500263): a stop that finds no program at work stops nothing and leaves no sign, so the robot is
/// taken back as after any suspension.
#[test]
fn a_stop_that_finds_no_program_stops_nothing() {
    let happens = [
        (3_328, What::Record(66.8854, 1.7564628), None),
        (6_068, What::Suspended(2_158), Some("suspended")),
        (7_447, What::Robot(Fault::ProgramStop), Some("program-stop")),
    ];
    let shown = shown(500_263, Series::ESeries, 7, (432.0929373244378, (106_787, 1_383_887)), &happens);
    assert!(tells(&shown, "decant_pour started", 8.0, 12.0), "{}", shown.story.join("\n"));
}

/// Protects a person who stops our program on the pendant after the operator has asked for the robot (seed 2017372): the program was seen to run then,
/// and comes upright after a pause. Whenever the stop comes, nothing starts before the operator asks again; what ended by itself is taken back.
#[test]
fn a_stop_after_the_operator_asked_has_the_last_word() {
    let mut stopped = 0;
    for stop_ms in (14_200..16_000).step_by(60) {
        let happens = [
            (3_000, What::Pour(120.0), None),
            (7_000, What::Robot(Fault::ProgramPause), Some("program-pause")),
            (13_500, What::Robot(Fault::ProgramResume), Some("program-pause")),
            (13_700, What::Pour(80.0), None),
            (stop_ms, What::Robot(Fault::ProgramStop), Some("program-stop")),
        ];
        let shown = shown(2_017_372, Series::Cb3, 1, (300.0, (266_117, 645_915)), &happens);
        stopped += usize::from(tells(&shown, "stopped on the pendant", 14.0, 17.0));
    }
    assert!(stopped > 10, "only {stopped} stops found the program at work");
}

/// Protects a person who stops a program that stood paused when the operator asked (seed 15386720): a register that was in use kept the controller from
/// looking at the robot after it was asked, the program was stopped then, and it was taken back. Nothing starts before the operator asks again.
#[test]
fn a_stop_of_a_paused_program_behind_a_used_register_has_the_last_word() {
    let happens = [
        (3_000, What::Pour(120.0), None),
        (7_000, What::Robot(Fault::ProtectiveStop), Some("protective-stop")),
        (13_500, What::Robot(Fault::UnlockProtectiveStop), Some("protective-stop")),
        (14_000, What::Resume, None),
        (15_000, What::Robot(Fault::InUse("input_int_register_24".into())), Some("in-use")),
        (15_300, What::Resume, None),
        (17_000, What::Robot(Fault::ProgramStop), Some("program-stop")),
        (19_000, What::Robot(Fault::Clear), Some("in-use")),
    ];
    let shown = shown(2_017_372, Series::Cb3, 1, (300.0, (266_117, 645_915)), &happens);
    assert!(tells(&shown, "a program is paused", 13.9, 14.5) && tells(&shown, "is in use", 15.2, 17.0), "{}", shown.story.join("\n"));
    assert!(tells(&shown, "stopped on the pendant", 16.9, 17.1), "{}", shown.story.join("\n"));
    assert!(tells(&shown, "was stopped", 19.0, 23.0), "{}", shown.story.join("\n"));
    assert!(!tells(&shown, "decant_pour started", 15.0, 99.0), "{}", shown.story.join("\n"));
}

/// Protects a person who stops our program after it stood paused behind an open safeguard (seed 6092687): the operator had asked for the robot, the
/// safeguard was closed, the program went on, and was stopped before the controller looked again. Nothing starts before the operator asks again.
#[test]
fn a_stop_after_a_safeguard_was_closed_has_the_last_word() {
    let mut stopped = 0;
    for stop_ms in (26_800..27_300).step_by(60) {
        let happens = [
            (2_843, What::Pour(168.0855), None),
            (3_257, What::Robot(Fault::ProtectiveStop), Some("protective-stop")),
            (17_061, What::Robot(Fault::UnlockProtectiveStop), Some("protective-stop")),
            (19_821, What::Robot(Fault::SafeguardOpen), Some("safeguard-stop")),
            (20_264, What::Record(60.716774, 1.4004247), None),
            (26_775, What::Robot(Fault::SafeguardClosed), Some("safeguard-stop")),
            (stop_ms, What::Robot(Fault::ProgramStop), Some("program-stop")),
        ];
        let shown = shown(6_092_687, Series::ESeries, 10, (374.1365076353606, (111_488, 111_033)), &happens);
        stopped += usize::from(tells(&shown, "stopped on the pendant", 26.7, 27.4));
    }
    assert!(stopped > 4, "only {stopped} stops found the program at work");
}

/// Protects a person who stops our program while the link is cut (seed 13828907): the link went between the program's upload and its session, the
/// operator asked, and the program was stopped. The controller saw none of it, and took the robot back.
#[test]
fn a_stop_that_no_session_saw_has_the_last_word() {
    let mut stopped = 0;
    for stop_ms in (22_900..24_600).step_by(100) {
        let happens = lost_at_upload([(stop_ms, What::Robot(Fault::ProgramStop), Some("program-stop"))]);
        let shown = shown(13_828_907, Series::Cb3, 1, (348.0, (266_117, 645_915)), &happens);
        stopped += usize::from(tells(&shown, "stopped on the pendant", 22.8, 24.7));
        assert!(!tells(&shown, "robot connected", 22.7, 24.6), "{}", shown.story.join("\n"));
    }
    assert!(stopped > 10, "only {stopped} stops found the program at work");
}

/// Protects a person who stops our program before the controller has seen what became of it, where a hindrance stands at its first look: that look does not
/// ask for the program, so the operator's wish from before it does not answer for the stop.
#[test]
fn a_stop_behind_a_hindrance_has_the_last_word() {
    let mut stopped = 0;
    for stop_ms in (22_900..23_700).step_by(100) {
        let happens = lost_at_upload([
            (22_880, What::Robot(Fault::SpeedSlider(0.5)), Some("speed-slider")),
            (stop_ms, What::Robot(Fault::ProgramStop), Some("program-stop")),
            (25_000, What::Robot(Fault::SpeedSlider(1.0)), Some("speed-slider")),
        ]);
        let shown = shown(13_828_907, Series::Cb3, 1, (348.0, (266_117, 645_915)), &happens);
        stopped += usize::from(tells(&shown, "stopped on the pendant", 22.8, 23.8));
        assert!(!tells(&shown, "robot connected", 22.7, 37.0), "{}", shown.story.join("\n"));
    }
    assert!(stopped > 5, "only {stopped} stops found the program at work");
}

/// Protects a person who stops our program on its way upright while the controller still tries to reach the robot, just after the operator has asked: the attempt
/// that is under way sees the stop, but not the wish, which came before it.
#[test]
fn a_stop_during_an_attempt_has_the_last_word() {
    let mut stopped = 0;
    for stop_ms in (8_450..8_640).step_by(30) {
        let happens = [
            (3_000, What::Pour(120.0), None),
            (7_000, What::Robot(Fault::Offline(0.3)), Some("offline")),
            (8_150, What::LinkStall(500), Some("link-stall")),
            (stop_ms - 250, What::Resume, None),
            (stop_ms, What::Robot(Fault::ProgramStop), Some("program-stop")),
        ];
        let shown = shown(13_828_907, Series::Cb3, 1, (348.0, (266_117, 645_915)), &happens);
        stopped += usize::from(tells(&shown, "stopped on the pendant", 8.0, 10.1));
    }
    assert!(stopped > 3, "only {stopped} stops found the program at work");
}

/// Protects a person who stops our program just after the operator has asked for a robot that the controller has (seed 14810214): the thread that connects took
/// the wish, which came before the stop, for one that came after it.
#[test]
fn a_stop_after_a_needless_wish_has_the_last_word() {
    for stop_ms in (5_000..5_200).step_by(10) {
        let happens = [(4_990, What::Resume, None), (stop_ms, What::Robot(Fault::ProgramStop), Some("program-stop"))];
        let shown = shown(14_810_214, Series::Cb3, 0, (300.0, (266_117, 645_915)), &happens);
        assert!(
            tells(&shown, "stopped on the pendant", 4.9, 5.3) && !tells(&shown, "robot connected", 5.0, 20.0),
            "{}",
            shown.story.join("\n")
        );
    }
}

/// Protects a person and the operator (seed 14447400): the program was stopped while nobody watched it, and the operator asked half a second later, before the
/// controller had looked. It cannot know which came first, and asks again; then it takes the robot.
#[test]
fn an_ask_that_cannot_be_placed_is_asked_for_again() {
    let happens = [
        (2_792, What::Robot(Fault::Stall(0.094)), Some("stall")),
        (2_938, What::Robot(Fault::ProgramStop), Some("program-stop")),
        (3_382, What::Pour(50.903122), None),
        (6_000, What::Resume, None),
    ];
    let shown = shown(14_447_400, Series::Cb3, 0, (224.0, (266_117, 645_915)), &happens);
    let text = shown.story.join("\n");
    assert!(tells(&shown, "connection to the robot lost", 2.8, 2.938), "{text}");
    assert!(!tells(&shown, "robot connected", 2.8, 6.0) && tells(&shown, "robot connected", 6.0, 8.0), "{text}");
}

/// Protects the operator (seed 16015290): an order that is refused while the controller tries to connect by itself asks for nothing, so when the last wish is
/// over, it says that it waits. Then an ask takes the robot.
#[test]
fn an_order_while_the_robot_is_tried_asks_for_nothing() {
    let mut waited = 0;
    for order_ms in (16_140..16_740).step_by(60) {
        let happens = [
            (3_421, What::Pour(32.083717), None),
            (6_269, What::Robot(Fault::SkipOutputs(22)), Some("skip-outputs")),
            (6_570, What::Resume, None),
            (7_768, What::Robot(Fault::Offline(7.6025399160745835)), Some("offline")),
            (order_ms, What::Record(70.0, 1.0), None),
            (28_000, What::Resume, None),
        ];
        let shown = shown(16_015_290, Series::Cb3, 0, (350.0, (266_117, 645_915)), &happens);
        if tells(&shown, "then `rt-controller resume`", 16.0, 18.0) {
            waited += 1;
            assert!(tells(&shown, "robot connected", 28.0, 30.0), "{}", shown.story.join("\n"));
        }
    }
    assert!(waited > 3, "only {waited} orders came before the wish was over");
}

/// Protects a cell whose link held back what the robot sent while it was connected (seed 14111571): the controller saw a program at work that answered no
/// target, because it had ended unused. Nobody had stopped it, so the robot is taken back without its operator.
#[test]
fn a_program_that_ended_behind_a_slow_link_is_taken_back() {
    let happens = [
        (17_420, What::LinkSplit(2_837), Some("link-split")),
        (19_398, What::Resume, None),
        (20_122, What::Robot(Fault::Stall(0.21559452526566691)), Some("stall")),
        (20_798, What::Pour(40.712276), None),
    ];
    let shown = shown(14_111_571, Series::ESeries, 0, (416.0, (266_117, 645_915)), &happens);
    assert!(tells(&shown, "no target came", 19.5, 23.0), "{}", shown.story.join("\n"));
}

/// Protects the check (seed 16338853): a person resumes a program that a protective stop had held, it brings the container upright and ends by itself. A new
/// controller sees no sign of the stop, and takes the robot.
#[test]
fn a_resumed_program_that_ended_leaves_no_sign() {
    let happens = [
        (3_470, What::Record(78.25531, 1.5956125), None),
        (10_251, What::Robot(Fault::ProtectiveStop), Some("protective-stop")),
        (10_992, What::Robot(Fault::ProgramPause), Some("jog")),
        (18_073, What::Robot(Fault::UnlockProtectiveStop), Some("protective-stop")),
        (19_416, What::ControllerKilled(3_237), Some("controller-killed")),
        (19_938, What::Robot(Fault::ProgramResume), Some("jog")),
    ];
    let shown = shown(16_338_853, Series::Cb3, 4, (253.0, (266_117, 645_915)), &happens);
    let text = shown.story.join("\n");
    assert!(tells(&shown, "container upright", 19.9, 22.6) && tells(&shown, "decant_pour started", 22.6, 24.0), "{text}");
}
