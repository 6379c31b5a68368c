//! What a person and the safety configuration do to the arm: it is slowed, moved by hand or with the pendant, and never started.

use simulator::ur::{Machine, RobotMode, RuntimeState, Series};

use crate::{START_CYCLES, START_Q, machine, steps};

/// A program that turns wrist 3 at 90 degrees a second for ever, and counts its passes in output int register 24.
const TURN: &str = "def turn():\n  n = 0\n  q = get_target_joint_positions()\n  while True:\n    n = n + 1\n    \
                    write_output_integer_register(24, n)\n    q[5] = q[5] + 1.570796 * get_steptime()\n    \
                    servoj(q, t=get_steptime(), lookahead_time=0.05, gain=600)\n  end\nend\n";

/// A program that counts its passes and does nothing else.
const COUNT: &str =
    "def count():\n  n = 0\n  while True:\n    n = n + 1\n    write_output_integer_register(24, n)\n    sync()\n  end\nend\n";

fn turning(series: Series) -> Machine {
    let mut machine = machine(series);
    machine.upload(TURN);
    machine
}

fn seconds(machine: &mut Machine, time_s: f64) {
    steps(machine, machine.robot.cycles(time_s) as usize);
}

// Protects every test of a slowed arm: with a joint speed limit below what servoj asks for, the joint turns exactly that fast, the
// program's own time is stretched, speed_scaling tells, and the slider still stands at 100 %.
#[test]
fn a_speed_limit_slows_arm_and_program_while_the_slider_stays() {
    for series in [Series::Cb3, Series::ESeries] {
        for limit_deg_s in [20.0f64, 30.0, 45.0] {
            let mut machine = turning(series);
            machine.robot.servo.set_speed_limit(limit_deg_s.to_radians());
            let mut fastest = 0.0f64;
            for _ in 0..machine.robot.cycles(2.0) {
                machine.step();
                fastest = fastest.max(machine.robot.servo.target_qd[5].to_degrees());
            }
            let turned_deg = (machine.robot.servo.target_q[5] - START_Q[5]).to_degrees();
            assert!(fastest <= limit_deg_s * 1.001, "{series:?}: {fastest} deg/s, limit {limit_deg_s}");
            assert!((0.9..1.0).contains(&(turned_deg / (2.0 * limit_deg_s))), "{series:?}: {turned_deg} deg in 2 s, {limit_deg_s} deg/s");
            assert_eq!(machine.robot.speed_slider(), 1.0);
            let scaling = machine.speed_scaling();
            assert!(scaling < limit_deg_s / 60.0, "{series:?}: speed_scaling {scaling}");
            // servoj blocks for longer, so that the program's angle does not run away from the arm.
            let away_deg = (machine.robot.servo.commanded_q[5] - machine.robot.servo.target_q[5]).to_degrees();
            assert!((0.5..12.0).contains(&away_deg), "{series:?}: {away_deg} deg");
        }
    }
}

// Protects the same for a controller that slows the arm by a share of its own, and the slider at its lowest steps.
#[test]
fn own_scaling_and_slider_multiply() {
    for (slider, own) in [(1.0, 0.3), (0.5, 0.5), (0.05, 1.0), (0.01, 1.0)] {
        let mut machine = turning(Series::ESeries);
        machine.robot.set_speed_slider(slider);
        machine.robot.set_own_scaling(own);
        let share = slider * own;
        seconds(&mut machine, 1.0 / share);
        let before = (machine.robot.servo.target_q[5], machine.robot.outputs.int[24]);
        seconds(&mut machine, 1.0 / share);
        let deg_s = (machine.robot.servo.target_q[5] - before.0).to_degrees() * share;
        assert!((deg_s / 90.0 / share - 1.0).abs() < 0.2, "{slider} and {own}: {deg_s} deg/s");
        let passes = f64::from(machine.robot.outputs.int[24] - before.1);
        assert!((passes / 500.0 - 1.0).abs() < 0.2, "{slider} and {own}: {passes} passes");
        assert_eq!((machine.robot.speed_slider(), machine.speed_scaling()), (slider, own));
    }
}

// Protects tests of people who take the arm in hand: the teach button ends the program that runs, nothing starts while it is pressed, and a program
// that was paused stays so, and does not go on before the button is released.
#[test]
fn the_teach_button_ends_the_program() {
    let mut machine = machine(Series::Cb3);
    machine.upload(COUNT);
    steps(&mut machine, START_CYCLES + 1);
    assert_eq!(machine.runtime_state(), RuntimeState::Playing);
    machine.set_freedrive(true);
    steps(&mut machine, 2);
    assert_eq!((machine.runtime_state(), machine.robot_status_bits()), (RuntimeState::Stopped, 0b101));
    machine.upload(COUNT);
    steps(&mut machine, START_CYCLES + 10);
    assert_eq!(machine.runtime_state(), RuntimeState::Stopped);
    machine.set_freedrive(false);
    machine.upload(COUNT);
    steps(&mut machine, START_CYCLES + 1);
    machine.pause();
    steps(&mut machine, 2);
    machine.set_freedrive(true);
    steps(&mut machine, 10);
    assert_eq!(machine.runtime_state(), RuntimeState::Paused);
    machine.set_freedrive(false);
    assert!(machine.resume());
    steps(&mut machine, 2);
    assert_eq!(machine.runtime_state(), RuntimeState::Playing);
}

// Protects tests that move joints by hand: the teach button shows in the status bits, the joint moves while it is pressed and no
// program runs, and with the pendant also while one is paused.
#[test]
fn joints_move_by_hand_and_with_the_pendant() {
    let mut machine = machine(Series::Cb3);
    machine.move_joint(0, 0.5, true);
    assert!(machine.take_log().any(|l| l.text == "no joint is moved: the teach button is not pressed"));
    machine.set_freedrive(true);
    assert_eq!(machine.robot_status_bits(), 0b101);
    machine.move_joint(0, 0.5, true);
    steps(&mut machine, 40);
    assert!(machine.robot.servo.actual_qd[0] > 0.3, "moves: {}", machine.robot.servo.actual_qd[0]);
    seconds(&mut machine, 2.0);
    assert!((machine.robot.servo.actual_q[0] - START_Q[0] - 0.5).abs() < 1e-6);
    machine.move_joint(1, 1.0, true);
    steps(&mut machine, 40);
    machine.set_freedrive(false);
    seconds(&mut machine, 1.0);
    assert_eq!(machine.robot_status_bits(), 0b001);
    assert!((0.01..0.9).contains(&(machine.robot.servo.actual_q[1] - START_Q[1])), "released, the arm stands");

    machine.upload(COUNT);
    steps(&mut machine, START_CYCLES + 1);
    machine.move_joint(2, 0.1, false);
    assert!(machine.take_log().any(|l| l.text == "no joint is moved: a program runs"));
    machine.pause();
    steps(&mut machine, 2);
    machine.robot.set_speed_slider(0.01);
    machine.move_joint(2, -0.1, false);
    seconds(&mut machine, 2.0);
    assert!((machine.robot.servo.actual_q[2] - START_Q[2] + 0.1).abs() < 1e-6, "the slider has no part in it");
    assert!(machine.resume());
}

// Protects the first start after a boot: a robot that was never started counts as paused, also when its brakes are released. The first
// program only stops it, and the second one runs (Universal_Robots_Client_Library #123). The same holds for a paused program.
#[test]
fn a_booted_robot_looks_paused_and_swallows_one_program() {
    let mut machine = machine(Series::Cb3);
    machine.boot();
    steps(&mut machine, 5);
    assert_eq!((machine.robot_mode(), machine.runtime_state()), (RobotMode::PowerOff, RuntimeState::Paused));
    assert_eq!(machine.speed_scaling(), 0.0);
    machine.upload(COUNT);
    assert!(machine.take_log().any(|l| l.text.contains("robot mode POWER_OFF")));
    assert!(machine.start_arm());
    seconds(&mut machine, 3.0);
    assert_eq!((machine.robot_mode(), machine.runtime_state()), (RobotMode::Running, RuntimeState::Paused));
    assert!(!machine.resume(), "there is no program to resume");
    machine.upload(COUNT);
    seconds(&mut machine, 1.0);
    assert_eq!(machine.runtime_state(), RuntimeState::Stopped);
    for _ in 0..2 {
        machine.upload(COUNT);
        seconds(&mut machine, 0.2);
        assert_eq!(machine.runtime_state(), RuntimeState::Playing);
        machine.pause();
        seconds(&mut machine, 0.2);
        machine.upload(COUNT);
        seconds(&mut machine, 0.2);
        assert_eq!(machine.runtime_state(), RuntimeState::Stopped);
    }
}

// Protects the way out of an emergency stop: the pendant's start button goes all the way to released brakes, and no program runs.
#[test]
fn brakes_are_released_after_an_emergency_stop() {
    let mut machine = turning(Series::Cb3);
    seconds(&mut machine, 0.5);
    machine.emergency_stop();
    assert!(!machine.start_arm(), "the button is still pressed");
    seconds(&mut machine, 1.0);
    machine.release_emergency_stop();
    assert!(machine.start_arm());
    seconds(&mut machine, 3.0);
    assert_eq!((machine.robot_mode(), machine.runtime_state()), (RobotMode::Running, RuntimeState::Stopped));
}
