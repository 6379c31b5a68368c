//! The life of programs: when they start, what makes them wait, and what stops, pauses and replaces them.

use simulator::ur::variables::Input;
use simulator::ur::{RuntimeState, Series};

use crate::{START_CYCLES, START_Q, machine, run, steps};

// Protects timing: one pass of a loop with servoj, sync or sleep takes one control cycle, on both generations.
#[test]
fn one_pass_of_a_loop_is_one_cycle() {
    for series in [Series::Cb3, Series::ESeries] {
        for wait in ["sync()", "servoj(q, t=get_steptime())", "servoj(q)", "sleep(get_steptime())"] {
            let mut machine = machine(series);
            let body =
                "  n = 0\n  q = get_actual_joint_positions()\n  while True:\n    n = n + 1\n    write_output_integer_register(24, n)";
            machine.upload(&format!("def test():\n{body}\n    {wait}\n  end\nend\n"));
            let start = (0.048 * series.rate_hz()).round() as usize;
            steps(&mut machine, start);
            assert_eq!(machine.robot.outputs.int[24], 1, "{series:?} {wait}");
            steps(&mut machine, 10);
            assert_eq!(machine.robot.outputs.int[24], 11, "{series:?} {wait}");
        }
    }
}

// Protects the time for which servoj blocks: 33 ms are five cycles of a CB3, and the speed slider stretches them.
#[test]
fn servoj_blocks_for_its_time_and_the_speed_slider_stretches_it() {
    let body = "  n = 0\n  q = get_actual_joint_positions()\n  while True:\n    n = n + 1\n    write_output_integer_register(0, n)\n    \
                servoj(q, t=0.033)\n  end";
    let (mut machine, _) = run(body, 10);
    assert_eq!(machine.robot.outputs.int[0], 3);
    machine.robot.write_input(Input::SpeedSliderMask, &1u32.to_be_bytes());
    machine.robot.write_input(Input::SpeedSliderFraction, &0.5f64.to_be_bytes());
    steps(&mut machine, 4); // the servoj that was begun at full speed has 4 of its 5 cycles left
    let before = machine.robot.outputs.int[0];
    steps(&mut machine, 9 * 10);
    assert_eq!(machine.robot.outputs.int[0] - before, 10);
}

// Protects the watchdog: it lapses after 1/f without an update, and not while updates come, even when the value stays the same.
#[test]
fn a_watchdog_without_updates_stops_or_pauses_the_program() {
    for (action, state) in [("stop", RuntimeState::Stopped), ("pause", RuntimeState::Paused), ("ignore", RuntimeState::Playing)] {
        let body = format!("  rtde_set_watchdog(\"input_int_register_24\", 10, \"{action}\")\n  while True:\n    sync()\n  end");
        let (mut machine, _) = run(&body, 1);
        for _ in 0..50 {
            machine.robot.write_input(Input::IntRegister(24), &7i32.to_be_bytes());
            steps(&mut machine, 8);
            assert_eq!(machine.runtime_state(), RuntimeState::Playing, "{action}");
        }
        // The last update was 8 cycles ago; 1 / 10 Hz are 12.5 cycles.
        steps(&mut machine, 4);
        assert_eq!(machine.runtime_state(), RuntimeState::Playing, "{action}");
        steps(&mut machine, 3);
        assert_eq!(machine.runtime_state(), state, "{action}");
    }
    let (machine, _) = run("  rtde_set_watchdog(\"input_int_register_24\", 0, \"stop\")\n  while True:\n    sync()\n  end", 3);
    assert_eq!(machine.runtime_state(), RuntimeState::Stopped, "a frequency of 0 stops at once");
}

// Protects the life of programs: one starts 48 ms after its upload, a second def replaces the first, a sec runs beside it, and an
// e-Series in local control refuses programs.
#[test]
fn programs_start_are_replaced_and_refused() {
    let mut machine = machine(Series::ESeries);
    machine.upload("def first():\n  while True:\n    sync()\n  end\nend\n");
    steps(&mut machine, 23);
    assert_eq!(machine.runtime_state(), RuntimeState::Stopped);
    steps(&mut machine, 1);
    assert_eq!((machine.runtime_state(), machine.program_name()), (RuntimeState::Playing, "first"));
    machine.upload("sec aside():\n  write_output_integer_register(3, 9)\nend\n");
    machine.upload("sec bad():\n  sync()\nend\n");
    steps(&mut machine, 1);
    assert_eq!((machine.runtime_state(), machine.robot.outputs.int[3]), (RuntimeState::Playing, 9));
    assert!(machine.take_log().any(|l| l.text == "secondary program: it must not let time pass"));
    machine.upload("def second():\n  sleep(1)\nend\n");
    steps(&mut machine, 2);
    assert_eq!(machine.runtime_state(), RuntimeState::Stopped);
    steps(&mut machine, 23);
    assert_eq!((machine.runtime_state(), machine.program_name()), (RuntimeState::Playing, "second"));
    steps(&mut machine, 510);
    assert_eq!(machine.runtime_state(), RuntimeState::Stopped);
    machine.set_remote_control(false);
    machine.upload("def third():\n  sleep(1)\nend\n");
    steps(&mut machine, 30);
    assert_eq!(machine.runtime_state(), RuntimeState::Stopped);
    assert!(machine.take_log().any(|l| l.text.contains("local control")));
    // A line without def is a program of its own.
    machine.set_remote_control(true);
    machine.upload("set_standard_digital_out(2, True)\n");
    steps(&mut machine, 30);
    assert_eq!(machine.robot.digital_out, 4);
}

/// As much of ur_rtde's program as this controller recognises, with its two register offsets.
fn ur_rtde_program(offset: usize) -> String {
    format!(
        "def rtde_control():\n    global reg_offset_float = # float register offset\n{offset}    global reg_offset_int = # int register \
         offset\n{offset}    global x = 1\nend\n"
    )
}

// Protects ur_rtde's register protocol in both register ranges: the answers "ready" and "done", each command carried out once, servo
// targets, stop and end.
#[test]
fn ur_rtde_register_protocol_is_kept() {
    for offset in [0, 24] {
        let mut machine = machine(Series::Cb3);
        let int = |n: usize| Input::IntRegister((offset + n) as u8);
        let double = |n: usize| Input::DoubleRegister((offset + n) as u8);
        machine.upload(&ur_rtde_program(offset));
        steps(&mut machine, START_CYCLES);
        assert_eq!(machine.runtime_state(), RuntimeState::Playing);
        assert_eq!(machine.robot.outputs.int[offset], 1, "ready");
        // This is servoJ, whose parameters are those of recipe 2 of ur_rtde.
        let mut q = START_Q;
        q[5] += 0.05;
        for (i, v) in q.iter().chain(&[0.0, 0.0, 1.0 / 30.0, 0.1, 300.0]).enumerate() {
            machine.robot.write_input(double(i), &v.to_be_bytes());
        }
        machine.robot.write_input(int(0), &11i32.to_be_bytes());
        steps(&mut machine, 100);
        assert_eq!(machine.robot.outputs.int[offset], 1, "streaming commands stay ready");
        assert!((machine.robot.servo.actual_q[5] - q[5]).abs() < 1e-3, "{}", machine.robot.servo.actual_q[5]);
        // servoStop(10) is done when the arm stands, and the program is ready again when the command is cleared.
        machine.robot.write_input(double(0), &10f64.to_be_bytes());
        machine.robot.write_input(int(0), &16i32.to_be_bytes());
        steps(&mut machine, 3);
        assert_eq!(machine.robot.outputs.int[offset], 2, "done");
        machine.robot.write_input(int(0), &0i32.to_be_bytes());
        steps(&mut machine, 1);
        assert_eq!(machine.robot.outputs.int[offset], 1, "ready again");
        // After setWatchdog(10) the client falls silent.
        machine.robot.write_input(int(0), &35i32.to_be_bytes());
        steps(&mut machine, 2);
        assert_eq!(machine.robot.outputs.int[offset], 2);
        steps(&mut machine, 20);
        assert_eq!(machine.runtime_state(), RuntimeState::Stopped, "watchdog");
        // The command 255 ends the program.
        machine.robot.write_input(int(0), &0i32.to_be_bytes());
        machine.upload(&ur_rtde_program(offset));
        steps(&mut machine, START_CYCLES + 2);
        assert_eq!(machine.runtime_state(), RuntimeState::Playing);
        machine.robot.write_input(int(0), &255i32.to_be_bytes());
        steps(&mut machine, 2);
        assert_eq!(machine.runtime_state(), RuntimeState::Stopped);
        // A command that is not simulated is named in the log.
        machine.robot.write_input(int(0), &4i32.to_be_bytes());
        machine.upload(&ur_rtde_program(offset));
        steps(&mut machine, START_CYCLES + 2);
        assert!(machine.take_log().any(|l| l.text.contains("command 4 is not simulated")));
    }
}
