//! The arm under a program that streams targets: how it follows and stops, and what safety and power do to it.

use simulator::ur::servo::MAX_SPEED_RAD_S;
use simulator::ur::variables::{Input, Output};
use simulator::ur::watchdog::WatchdogAction;
use simulator::ur::{LogKind, Machine, RobotMode, RuntimeState, SafetyMode, Series};

use crate::{START_CYCLES, START_Q, lines, machine, run, steps};

/// A program that servos wrist 3 to input double register 24 in every cycle.
const FOLLOW: &str = "  q = get_actual_joint_positions()\n  while True:\n    q[5] = read_input_float_register(24)\n    \
                      servoj(q, t=get_steptime(), lookahead_time=0.05, gain=600)\n  end";

fn follow(machine: &mut Machine, target: f64) {
    machine.robot.write_input(Input::DoubleRegister(24), &target.to_be_bytes());
    machine.step();
}

/// A machine that runs [`FOLLOW`] at rest.
fn following() -> Machine {
    let mut machine = machine(Series::Cb3);
    machine.robot.write_input(Input::DoubleRegister(24), &START_Q[5].to_be_bytes());
    machine.upload(&format!("def follow():\n{FOLLOW}\nend\n"));
    steps(&mut machine, START_CYCLES + 2);
    assert_eq!(machine.runtime_state(), RuntimeState::Playing);
    machine
}

// Protects the servo model: a ramp is followed at its own speed and one lookahead late, and actual_q lags behind target_q.
#[test]
fn a_ramp_is_followed_one_lookahead_late() {
    let mut machine = following();
    let rate = 1.0; // rad/s
    let mut target = START_Q[5];
    for _ in 0..125 {
        target += rate * 0.008;
        follow(&mut machine, target);
    }
    let servo = &machine.robot.servo;
    assert!((servo.target_qd[5] - rate).abs() < 0.01, "{}", servo.target_qd[5]);
    assert!((target - servo.target_q[5] - 0.05 * rate).abs() < 0.008, "lag {}", target - servo.target_q[5]);
    let joint_lag = servo.target_q[5] - servo.actual_q[5];
    assert!((0.004..0.016).contains(&joint_lag), "actual_q lags target_q by {joint_lag}");
    assert!((servo.actual_qd[5] - rate).abs() < 0.01);
    assert_eq!(servo.target_q[..5], START_Q[..5], "the other joints stay");
}

// Protects the limits: no demand makes a joint faster than 180 deg/s, and the arm still arrives.
#[test]
fn no_joint_is_faster_than_180_deg_s() {
    let mut machine = following();
    let mut target = START_Q[5];
    let mut fastest = 0.0f64;
    for _ in 0..40 {
        target += 5.0 * 0.008;
        follow(&mut machine, target);
        fastest = fastest.max(machine.robot.servo.target_qd[5]).max(machine.robot.servo.actual_qd[5]);
    }
    assert!(fastest <= MAX_SPEED_RAD_S + 1e-9, "{fastest}");
    assert!(fastest > MAX_SPEED_RAD_S - 0.1, "{fastest}");
    steps(&mut machine, 250);
    assert_eq!(machine.safety_mode(), SafetyMode::Normal);
    assert!((machine.robot.servo.actual_q[5] - target).abs() < 1e-3);
}

// Protects against a client that jumps: an absurd demand is a protective stop that says why, and the program is paused.
#[test]
fn absurd_demands_are_a_protective_stop() {
    for demand in [START_Q[5] + 0.3, 7.0, f64::NAN] {
        let mut machine = following();
        follow(&mut machine, demand);
        assert_eq!(machine.safety_mode(), SafetyMode::ProtectiveStop, "{demand}");
        assert_eq!(machine.runtime_state(), RuntimeState::Paused);
        assert_eq!((machine.safety_status_bits(), machine.robot_status_bits()), (1 << 2 | 1 << 10, 1));
        assert!(machine.take_log().any(|l| l.text.contains("protective stop: servoj target of wrist 3")));
        steps(&mut machine, 50);
        assert!(machine.robot.servo.is_still());
        assert!(machine.robot.servo.actual_q[5].is_finite());
    }
}

// Protects recovery from a protective stop: it is locked for 5 s, and once it is unlocked only "play" lets the program go on.
#[test]
fn a_protective_stop_is_unlocked_and_the_program_played_on() {
    let mut machine = following();
    machine.protective_stop("test");
    assert!(!machine.resume(), "stopped: cannot play");
    assert!(machine.unlock_protective_stop().is_err(), "5 s have not passed");
    machine.upload("def other():\n  sync()\nend\n");
    assert!(machine.take_log().any(|l| l.text.contains("program not started: robot mode RUNNING, safety mode PROTECTIVE_STOP")));
    steps(&mut machine, 625);
    assert_eq!(machine.unlock_protective_stop(), Ok(()));
    steps(&mut machine, 100);
    assert_eq!((machine.safety_mode(), machine.runtime_state()), (SafetyMode::Normal, RuntimeState::Paused));
    assert!(machine.resume());
    steps(&mut machine, 10);
    assert_eq!(machine.runtime_state(), RuntimeState::Playing);
}

// Protects tests of the rarer safety modes: reduced lets programs run; recovery ends the program and keeps the power; a violation, a fault and the
// system's emergency stop take it, and no button but the safety system's restart gives it back.
#[test]
fn safety_modes_stop_what_they_stop() {
    use SafetyMode::{Fault, Normal, Recovery, Reduced, SystemEmergencyStop, Violation};
    let mut reduced = following();
    reduced.set_safety_mode(Reduced);
    steps(&mut reduced, 10);
    assert_eq!((reduced.runtime_state(), reduced.safety_mode() as i32, reduced.safety_status_bits()), (RuntimeState::Playing, 2, 1 << 1));
    for (mode, code, bits) in [
        (Recovery, 4, 1 << 3),
        (SystemEmergencyStop, 6, 1 << 5 | 1 << 7 | 1 << 10),
        (Violation, 8, 1 << 8 | 1 << 10),
        (Fault, 9, 1 << 9 | 1 << 10),
    ] {
        let mut machine = following();
        machine.set_safety_mode(mode);
        steps(&mut machine, 2);
        assert_eq!((machine.safety_mode() as i32, machine.safety_status_bits()), (code, bits));
        assert_eq!(
            (machine.runtime_state(), machine.robot_mode() == RobotMode::Running),
            (RuntimeState::Stopped, mode == Recovery),
            "{code}"
        );
        machine.upload("def other():\n  sync()\nend\n");
        assert!(machine.take_log().any(|l| l.text.contains("program not started: robot mode")), "{code}");
        machine.emergency_stop();
        machine.release_emergency_stop();
        let presses = if mode == Recovery { Normal } else { mode };
        assert_eq!((machine.safety_mode(), machine.start_arm()), (presses, mode == Recovery), "{code}");
        machine.set_safety_mode(Normal);
        assert!(machine.start_arm());
        steps(&mut machine, 400);
        assert_eq!(
            (machine.robot_mode(), machine.safety_mode(), machine.runtime_state()),
            (RobotMode::Running, Normal, RuntimeState::Stopped)
        );
    }
}

// Protects recovery from an emergency stop: it takes release, power and brakes, and the program is gone.
#[test]
fn an_emergency_stop_ends_the_program_and_takes_the_power() {
    let mut machine = following();
    machine.emergency_stop();
    steps(&mut machine, 2);
    assert_eq!(
        (machine.robot_mode(), machine.safety_mode(), machine.runtime_state()),
        (RobotMode::PowerOff, SafetyMode::RobotEmergencyStop, RuntimeState::Stopped)
    );
    assert_eq!((machine.safety_status_bits(), machine.robot_status_bits()), (1 << 6 | 1 << 7 | 1 << 10, 0));
    assert!(!machine.power_on() && !machine.brake_release(), "still pressed");
    machine.release_emergency_stop();
    steps(&mut machine, 100);
    assert_eq!(machine.robot_mode(), RobotMode::PowerOff, "releasing the button does not bring the power back");
    assert!(machine.power_on());
    steps(&mut machine, 200);
    assert_eq!(machine.robot_mode(), RobotMode::Idle);
    assert!(machine.brake_release());
    steps(&mut machine, 100);
    assert_eq!((machine.robot_mode(), machine.safety_mode()), (RobotMode::Running, SafetyMode::Normal));
    assert_eq!(machine.runtime_state(), RuntimeState::Stopped);
    machine.upload("def next():\n  while True:\n    sync()\n  end\nend\n");
    steps(&mut machine, START_CYCLES);
    assert_eq!(machine.runtime_state(), RuntimeState::Playing);
}

// Protects what is tested of who has the robot: a safeguard that closes lets that program go on which ran when it opened, and none that a person had paused.
#[test]
fn a_safeguard_resumes_no_program_that_a_person_paused() {
    for (paused, after) in [(false, RuntimeState::Playing), (true, RuntimeState::Paused)] {
        let mut machine = following();
        assert!(!paused || machine.pause());
        steps(&mut machine, 50);
        machine.open_safeguard();
        steps(&mut machine, 50);
        assert_eq!(machine.runtime_state(), RuntimeState::Paused, "{paused}");
        machine.close_safeguard();
        steps(&mut machine, 50);
        assert_eq!(machine.runtime_state(), after, "{paused}");
    }
}

// Protects the way in which a moving arm stops with its program: at a bounded deceleration and not at once.
#[test]
fn a_moving_arm_slows_down_when_its_program_ends() {
    for end in ["stop", "pause", "watchdog", "replaced", "error"] {
        let mut machine = following();
        let mut target = START_Q[5];
        for _ in 0..50 {
            target += 1.0 * 0.008;
            follow(&mut machine, target);
        }
        match end {
            "stop" => assert!(machine.stop_program()),
            "pause" => assert!(machine.pause()),
            "watchdog" => machine.robot.set_watchdog(Input::IntRegister(0), 0.0, WatchdogAction::Stop),
            "replaced" => machine.upload("def other():\n  sleep(10)\nend\n"),
            _ => machine.upload("def broken(:\nend\n"),
        }
        let mut before = machine.robot.servo.target_qd[5];
        let mut last = f64::NAN;
        for _ in 0..40 {
            machine.step();
            let now = machine.robot.servo.target_qd[5];
            assert!((before - now).abs() <= 0.5 + 1e-9, "{end}: from {before} to {now} rad/s in one cycle");
            before = now;
            last = now;
        }
        assert_eq!(last, 0.0, "{end}");
    }
}

// Protects stopj and movej: the program waits until the arm stands.
#[test]
fn stopj_and_movej_wait_for_the_arm() {
    let body = "  q = get_actual_joint_positions()\n  q[5] = q[5] + 0.5\n  q[0] = q[0] - 0.25\n  movej(q, a=5, v=1)\n  \
                textmsg(norm(get_target_joint_positions() - q) < 0.000001)\n  textmsg(norm(get_target_joint_speeds()) == 0)\n  \
                i = 0\n  while i < 20:\n    q[5] = q[5] - 0.01\n    servoj(q)\n    i = i + 1\n  end\n  stopj(3)\n  textmsg(is_steady())";
    let (machine, log) = run(body, 400);
    assert_eq!(lines(&log, LogKind::ProgramError), Vec::<&str>::new());
    assert_eq!(lines(&log, LogKind::Text), ["True", "True", "True"]);
    assert_eq!(machine.runtime_state(), RuntimeState::Stopped);
}

// Protects determinism: two runs with the same inputs write the same bytes.
#[test]
fn two_runs_write_the_same_bytes() {
    let bytes = || {
        let mut machine = following();
        let mut all = Vec::new();
        for i in 0..200 {
            follow(&mut machine, START_Q[5] + 0.3 * (f64::from(i) / 20.0).sin());
            for output in [Output::Timestamp, Output::TargetQ, Output::ActualQ, Output::ActualTcpPose, Output::RuntimeState] {
                machine.read_output(output, &mut all);
            }
        }
        all
    };
    assert_eq!(bytes(), bytes());
}
