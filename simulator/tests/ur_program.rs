//! The simulated controller without sockets: programs, servo model, safety and power, stepped cycle by cycle.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use simulator::ur::Machine;
use simulator::ur::program::check_program;
use simulator::ur::rtde::{InputOwners, RtdeSession, SessionContext};
use simulator::ur::script::MAX_SOURCE_BYTES;
use simulator::ur::servo::MAX_SPEED_RAD_S;
use simulator::ur::variables::{Input, Output};
use simulator::ur::{LogKind, LogLine, RobotMode, RuntimeState, SafetyMode, Series};

const START_Q: [f64; 6] = [0.0, -1.5, 1.5, -1.5, -1.5, 0.25];
/// Cycles from upload to the first statement on a CB3 (48 ms).
const START_CYCLES: usize = 6;

fn machine(series: Series) -> Machine {
    Machine::new(series, series.default_version(), START_Q)
}

fn steps(machine: &mut Machine, cycles: usize) {
    (0..cycles).for_each(|_| machine.step());
}

/// A CB3 that has run `body` as a program for `cycles` cycles, and what it logged.
fn run(body: &str, cycles: usize) -> (Machine, Vec<LogLine>) {
    let mut machine = machine(Series::Cb3);
    machine.upload(&format!("def test():\n{body}\nend\n"));
    steps(&mut machine, START_CYCLES + cycles);
    let log = machine.take_log().collect();
    (machine, log)
}

fn lines(log: &[LogLine], kind: LogKind) -> Vec<&str> {
    log.iter().filter(|l| l.kind == kind).map(|l| l.text.as_str()).collect()
}

/// What `body` writes with textmsg.
fn said(body: &str) -> Vec<String> {
    let (_, log) = run(body, 20);
    assert_eq!(lines(&log, LogKind::ProgramError), Vec::<&str>::new(), "in {body}");
    lines(&log, LogKind::Text).into_iter().map(str::to_owned).collect()
}

/// The error that `body` ends with.
fn error_of(body: &str) -> String {
    let (machine, log) = run(body, 20);
    assert_ne!(machine.runtime_state(), RuntimeState::Playing, "still running: {body}");
    lines(&log, LogKind::ProgramError).first().map_or_else(|| panic!("no error: {body}"), |e| (*e).to_owned())
}

// Protects the interpreter's results: a robot program that is tested here must mean the same on a robot.
#[test]
fn expressions_have_urscript_values() {
    for (expression, value) in [
        ("1 + 2 * 3 - 4", "3"),
        ("(1 + 2) * 3", "9"),
        ("7 % 4", "3"),
        ("1 / 4", "0.25"),
        ("2.5e-1 + .5", "0.75"),
        ("-3 - -4", "1"),
        ("1 < 2 and not 2 < 1", "True"),
        ("False or 3 >= 3", "True"),
        ("True xor True", "False"),
        ("not False == True", "True"),
        ("[1, 2, 3][1]", "2"),
        ("[1, 2.5] + [1, 1]", "[2, 3.5]"),
        ("[1, 2] * 2", "[2, 4]"),
        ("[1, 2] == [1.0, 2.0]", "True"),
        ("norm(-5)", "5"),
        ("norm([3, 4])", "5"),
        ("floor(-1.5)", "-2"),
        ("ceil(1.2)", "2"),
        ("sqrt(16)", "4"),
        ("pow(2, 3)", "8"),
        ("log(10, 1000) > 2.999", "True"),
        ("r2d(d2r(90))", "90"),
        ("atan2(0, 1)", "0"),
        ("get_list_length([1, 2, 3])", "3"),
        ("str_cat(\"a\", 1)", "a1"),
        ("p[1, 2, 3, 4, 5, 6][5]", "6"),
        ("get_steptime()", "0.008"),
        ("get_actual_joint_positions()[5]", "0.25"),
        ("None == None", "True"),
    ] {
        assert_eq!(said(&format!("  textmsg({expression})")), [value], "{expression}");
    }
}

// Protects control flow: loops, branches, functions with defaults and names, recursion, scopes.
#[test]
fn statements_run_in_order() {
    let body = r#"
  global total = 0
  names = [10, 20, 30]
  def add(a, b=5):
    total = total + a
    local hidden = b
    return a + hidden
  end
  def factorial(n):
    if n <= 1:
      return 1
    end
    return n * factorial(n - 1)
  end
  i = 0
  while True:
    i = i + 1
    if i == 2:
      continue
    elif i > 4:
      break
    else:
      names[0] = names[0] + i
    end
  end
  textmsg("names ", names)
  textmsg(add(1))
  textmsg(add(1, b=2))
  textmsg(add(b=1, a=1))
  textmsg("total ", total)
  textmsg(factorial(6))
"#;
    assert_eq!(said(body), ["names [18, 20, 30]", "6", "3", "2", "total 3", "720"]);
}

// Protects against silent misreading: each mistake is an error that names its line and cause, never ignored.
#[test]
fn mistakes_name_line_and_cause() {
    for (body, error) in [
        ("  a = 1\n  b = a +", "program not started: line 3: expected a value, found the end of the line"),
        ("  for i in range(3):\n  end", "line 2: a statement is an assignment or a call"),
        ("  a += 1", "line 2: expected a value, found '='"),
        ("  frobnicate(1)", "line 2: no function 'frobnicate' is defined above or built in"),
        ("  a = abs(-1)", "URScript has no abs, norm(a) gives the absolute value"),
        ("  a = max(1, 2)", "URScript has no min and max, use if"),
        ("  textmsg(b)", "line 2: unknown name 'b'"),
        ("  if False:\n    b = 1\n  end\n  textmsg(b)", "line 5: 'b' has no value yet"),
        ("  if 1:\n  end", "line 2: condition: expected a bool (True or False), found int"),
        ("  a = [1, 2]\n  a[2] = 1", "line 3: a: index 2 is outside 0 to 1"),
        ("  a = [1, 2]\n  b = a[0.0]", "line 3: index: expected an int, found float"),
        ("  a = 1 / 0", "line 2: division by zero"),
        ("  a = 2147483647 + 1", "line 2: result does not fit an int"),
        ("  a = True\n  a = 2", "line 3: 'a' is a bool and cannot become a int"),
        ("  a = sqrt(-1)", "line 2: result is not a finite number"),
        ("  servoj([0, 0, 0])", "line 2: servoj: expected a list of 6 numbers, found one of 3"),
        (
            "  q = get_actual_joint_positions()\n  servoj(q, lookahead_time=0.5)",
            "line 3: servoj: lookahead_time is 0.5, must be 0.03 to 0.2",
        ),
        ("  q = get_actual_joint_positions()\n  servoj(q, gain=50)", "line 3: servoj: gain is 50, must be 100 to 2000"),
        ("  q = get_actual_joint_positions()\n  servoj(q, look=0.1)", "line 3: servoj has no parameter 'look'; it takes (q, a, v, t"),
        ("  servoj()", "line 2: servoj: parameter 'q' is missing"),
        ("  sync(1)", "line 2: sync takes 0 parameters, 1 given"),
        ("  a = read_input_float_register(48)", "line 2: register address 48 is outside 0 to 47"),
        ("  write_output_integer_register(24, 1.5)", "line 2: expected an int, found float"),
        ("  rtde_set_watchdog(\"nonsense\", 5)", "line 2: rtde_set_watchdog: no input variable 'nonsense'"),
        ("  rtde_set_watchdog(\"input_int_register_24\", 5, \"explode\")", "is none of ignore, pause, stop"),
        ("  while True:\n    a = 1\n  end", "an endless loop without sync(), sleep() or servoj()"),
        ("  def f(n):\n    return f(n)\n  end\n  f(1)", "more than 128 calls within calls"),
        ("  return 1", "line 2: 'return' outside a function"),
        ("  def f():\n    return\n  end\n  f()", "line 3: 'return' needs a value"),
        ("  break", "line 2: 'break' outside a loop"),
        ("  a = 1 < 2 < 3", "line 2: comparisons cannot be chained"),
        ("  a = \"text", "line 2: text without its closing quote"),
        ("  a = 3 $ 4", "line 2: character '$' has no meaning in URScript"),
        ("  a = 99999999999", "line 2: number 99999999999 is out of range"),
        ("  def sync():\n  end", "line 2: there is already a function 'sync'"),
        ("  while True:\n  sync()", "the program ends before its 'end'"),
        ("  enter_critical", "line 2: 'enter_critical' is a word of URScript that this simulated controller does not run"),
        ("  movej(p[1, 2, 3, 4, 5, 6])", "line 2: movej: only joint positions are simulated"),
    ] {
        let found = error_of(body);
        assert!(found.contains(error), "{body}\nfound: {found}\nwanted: {error}");
    }
}

// Protects the reading of "else if" chains and code after the last end: nothing after the program may be dropped silently.
#[test]
fn nothing_after_the_program_is_ignored() {
    let error = check_program("def a():\n  sync()\nend\nb = 1\n").unwrap_err();
    assert_eq!(error.to_string(), "line 4: 'b' after the program's last 'end'");
    assert!(check_program("").is_err());
    assert!(check_program(&"#".repeat(MAX_SOURCE_BYTES + 1)).is_err());
}

// Protects timing: one pass of a servoj or sync loop per control cycle, on both generations.
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

// Protects servoj's blocking time: 33 ms are five cycles of a CB3, and the speed slider stretches them.
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

// Protects threads: they share globals, run in the same cycle, can be joined and killed, and only one may move the arm.
#[test]
fn threads_run_beside_the_program() {
    let body = r#"
  global count = 0
  thread counter():
    while count < 3:
      count = count + 1
      sync()
    end
    return None
  end
  thread forever():
    while True:
      sync()
    end
    return None
  end
  other = run forever()
  handle = run counter()
  join handle
  kill other
  textmsg("count ", count)
"#;
    assert_eq!(said(body), ["count 3"]);
    let error = error_of(
        "  global q = get_actual_joint_positions()\n  thread mover():\n    while True:\n      servoj(q)\n    end\n    return None\n  end\n  \
         h = run mover()\n  while True:\n    servoj(q)\n  end",
    );
    assert!(error.contains("another thread is already moving the robot"), "{error}");
}

// Protects the watchdog: it lapses after 1/f without an update, whatever the value, and not while updates come.
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

/// The program that servos wrist 3 to input double register 24, every cycle.
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

// Protects the servo model: a ramp is followed one lookahead late at its own speed, and target_q, actual_q differ.
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

// Protects the limits: no demand makes a joint faster than 180 deg/s, and the arm arrives all the same.
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

// Protects against a client that jumps: an absurd demand is a protective stop that says why, with the program paused.
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

// Protects recovery from a protective stop: locked for 5 s, then unlocked, and only "play" lets the program go on.
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

// Protects recovery from an emergency stop: release, power on, brake release; the program is gone.
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

// Protects the way a moving arm stops with its program: at a bounded deceleration, not at once.
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
            "watchdog" => machine.robot.set_watchdog(Input::IntRegister(0), 0.0, simulator::ur::watchdog::WatchdogAction::Stop),
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

// Protects "stopj": the program waits until the arm stands.
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

// Protects program life: upload, 48 ms, playing; a second def replaces the first; sec runs beside; e-Series in local control
// refuses.
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

// Protects "given the same inputs, the same motion": two runs write the same bytes.
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

/// ur_rtde's program as this controller recognises it, with its two numbers.
fn ur_rtde_program(offset: usize) -> String {
    format!(
        "def rtde_control():\n    global reg_offset_float = # float register offset\n{offset}    global reg_offset_int = # int register \
         offset\n{offset}    global x = 1\nend\n"
    )
}

// Protects ur_rtde's register protocol in both register ranges: ready, done, once per command, servo target, stop, end.
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
        // servoJ: recipe 2 of the reference.
        let mut q = START_Q;
        q[5] += 0.05;
        for (i, v) in q.iter().chain(&[0.0, 0.0, 1.0 / 30.0, 0.1, 300.0]).enumerate() {
            machine.robot.write_input(double(i), &v.to_be_bytes());
        }
        machine.robot.write_input(int(0), &11i32.to_be_bytes());
        steps(&mut machine, 100);
        assert_eq!(machine.robot.outputs.int[offset], 1, "streaming commands stay ready");
        assert!((machine.robot.servo.actual_q[5] - q[5]).abs() < 1e-3, "{}", machine.robot.servo.actual_q[5]);
        // servoStop(10): done when the arm stands, ready again when cleared.
        machine.robot.write_input(double(0), &10f64.to_be_bytes());
        machine.robot.write_input(int(0), &16i32.to_be_bytes());
        steps(&mut machine, 3);
        assert_eq!(machine.robot.outputs.int[offset], 2, "done");
        machine.robot.write_input(int(0), &0i32.to_be_bytes());
        steps(&mut machine, 1);
        assert_eq!(machine.robot.outputs.int[offset], 1, "ready again");
        // setWatchdog(10), then silence.
        machine.robot.write_input(int(0), &35i32.to_be_bytes());
        steps(&mut machine, 2);
        assert_eq!(machine.robot.outputs.int[offset], 2);
        steps(&mut machine, 20);
        assert_eq!(machine.runtime_state(), RuntimeState::Stopped, "watchdog");
        // 255 ends the program.
        machine.robot.write_input(int(0), &0i32.to_be_bytes());
        machine.upload(&ur_rtde_program(offset));
        steps(&mut machine, START_CYCLES + 2);
        assert_eq!(machine.runtime_state(), RuntimeState::Playing);
        machine.robot.write_input(int(0), &255i32.to_be_bytes());
        steps(&mut machine, 2);
        assert_eq!(machine.runtime_state(), RuntimeState::Stopped);
        // What is not simulated says so.
        machine.robot.write_input(int(0), &4i32.to_be_bytes());
        machine.upload(&ur_rtde_program(offset));
        steps(&mut machine, START_CYCLES + 2);
        assert!(machine.take_log().any(|l| l.text.contains("command 4 is not simulated")));
    }
}

// Protects the frequency rule: 30 Hz of a CB3 are every fourth cycle (31.25 Hz), of an e-Series every sixteenth; a frame whose
// cycle was missed is sent late and once, and the next one on time.
#[test]
fn the_divider_is_rounded_down() {
    for (series, frequency, divider) in
        [(Series::Cb3, 30.0f64, 4), (Series::ESeries, 30.0, 16), (Series::Cb3, 125.0, 1), (Series::Cb3, 500.0, 1)]
    {
        let mut machine = machine(series);
        let mut owners = InputOwners::default();
        let mut session = RtdeSession::new(1);
        let setup = [&[0, 20, b'O'][..], &frequency.to_be_bytes(), b"timestamp"].concat();
        for request in [&[0, 5, b'V', 0, 2][..], &setup, &[0, 3, b'S']] {
            let mut context = SessionContext { machine: &mut machine, owners: &mut owners, hidden: &[], refuse_version_2: false };
            session.feed(request, &mut context, &mut Vec::new()).unwrap();
        }
        let mut sent = Vec::new();
        for cycle in 1..=10 * divider {
            machine.step();
            // The controller is short of time in one cycle that a frame is due in.
            if cycle != 5 * divider + 1 && session.output(&machine).is_some() {
                sent.push(cycle);
            }
        }
        let on_time: Vec<usize> = (0..10).map(|i| i * divider + 1).collect();
        if divider == 1 {
            assert_eq!(sent.len(), 9);
        } else {
            assert_eq!(sent.iter().filter(|c| !on_time.contains(c)).collect::<Vec<_>>(), [&(5 * divider + 2)], "{series:?} {frequency}");
            assert_eq!(sent.len(), 10);
        }
    }
}

mod fuzz {
    //! Bounded random input; the cargo-fuzz targets in fuzz/ run the same functions for longer.

    use proptest::prelude::*;
    use simulator::ur::Machine;
    use simulator::ur::client_interface::ProgramAssembler;
    use simulator::ur::program::check_program;
    use simulator::ur::rtde::{InputOwners, RtdeSession, SessionContext};
    use simulator::ur::{Series, dashboard};

    /// Text out of the language's own words, which reaches deeper than random bytes.
    fn words() -> impl Strategy<Value = String> {
        let word = prop::sample::select(vec![
            "def ",
            "f",
            "x",
            "p",
            "(",
            ")",
            "[",
            "]",
            ":",
            "\n",
            "\n  ",
            ",",
            "=",
            "==",
            "<",
            "+",
            "-",
            "*",
            "/",
            "%",
            "if ",
            "elif ",
            "else",
            "end\n",
            "while ",
            "return ",
            "break",
            "continue",
            "halt",
            "pause",
            "global ",
            "local ",
            "and ",
            "or ",
            "xor ",
            "not ",
            "True",
            "False",
            "None",
            "run ",
            "join ",
            "kill ",
            "thread ",
            "1",
            "0",
            "2.5",
            "1e300",
            "2147483647",
            "\"t\"",
            "#",
            "servoj",
            "sync()",
            "textmsg",
            "get_actual_joint_positions()",
            "sleep",
            "read_input_integer_register",
            "str_cat",
        ]);
        prop::collection::vec(word, 0..120).prop_map(|w| w.concat())
    }

    /// Expressions that parse; most are wrong in type or value.
    fn expression() -> impl Strategy<Value = String> {
        let leaf = prop::sample::select(vec![
            "x",
            "q",
            "n",
            "True",
            "None",
            "0",
            "1",
            "-1",
            "7",
            "2147483647",
            "-2147483647",
            "0.5",
            "1e300",
            "\"t\"",
            "[1, 2, 3]",
            "[]",
            "p[1, 2, 3, 4, 5, 6]",
            "get_steptime()",
            "f(1)",
            "read_input_integer_register(24)",
            "get_actual_joint_positions()",
        ]);
        leaf.prop_map(str::to_owned).prop_recursive(4, 24, 3, |inner| {
            let operator = prop::sample::select(vec!["+", "-", "*", "/", "%", "==", "!=", "<", "<=", ">", ">=", "and", "or", "xor"]);
            let function = prop::sample::select(vec![
                "norm",
                "floor",
                "ceil",
                "sqrt",
                "length",
                "to_str",
                "d2r",
                "f",
                "str_len",
                "read_output_float_register",
                "sin",
                "acos",
            ]);
            prop_oneof![
                (inner.clone(), operator, inner.clone()).prop_map(|(a, o, b)| format!("({a} {o} {b})")),
                (inner.clone(), inner.clone()).prop_map(|(a, b)| format!("{a}[{b}]")),
                (function, inner.clone()).prop_map(|(f, a)| format!("{f}({a})")),
                (inner.clone(), inner.clone()).prop_map(|(a, b)| format!("[{a}, {b}, 0]")),
                (inner.clone(), inner.clone()).prop_map(|(a, b)| format!("str_cat({a}, {b})")),
                inner.clone().prop_map(|a| format!("(not {a})")),
                inner.prop_map(|a| format!("-{a}")),
            ]
        })
    }

    /// Programs that parse and run until their first mistake.
    fn program() -> impl Strategy<Value = String> {
        let simple = prop_oneof![
            expression().prop_map(|e| format!("x = {e}")),
            expression().prop_map(|e| format!("textmsg({e})")),
            (expression(), expression()).prop_map(|(i, e)| format!("q[{i}] = {e}")),
            expression().prop_map(|e| format!("q = q + {e}")),
            expression().prop_map(|e| format!("write_output_integer_register(24, {e})")),
            expression().prop_map(|e| format!("stopj({e})")),
            expression().prop_map(|e| format!("sleep({e})")),
            prop::sample::select(vec![
                "sync()",
                "servoj(q)",
                "n = n + 1",
                "x = run t()",
                "join x",
                "kill x",
                "halt",
                "x = None",
                "x = [x, x]"
            ])
            .prop_map(str::to_owned),
        ];
        let statement = simple.prop_recursive(3, 24, 5, |inner| {
            let block = prop::collection::vec(inner, 0..5).prop_map(|lines| lines.join("\n"));
            prop_oneof![
                (expression(), block.clone(), block.clone()).prop_map(|(c, a, b)| format!("if {c}:\n{a}\nelse:\n{b}\nend")),
                (prop_oneof![expression(), Just("n < 100".to_owned()), Just("True".to_owned())], block)
                    .prop_map(|(c, a)| format!("while {c}:\n{a}\nend")),
            ]
        });
        prop::collection::vec(statement, 1..12).prop_map(|lines| {
            let head = "def a():\nx = None\nn = 0\nq = get_actual_joint_positions()\ndef f(v):\nn = n + 1\nif n < 9:\nreturn f(v)\nend\n\
                        return v\nend\nthread t():\nwhile True:\nsync()\nend\nreturn None\nend\n";
            format!("{head}{}\nend\n", lines.join("\n"))
        })
    }

    fn run_program(source: &str) {
        let mut machine = Machine::new(Series::Cb3, Series::Cb3.default_version(), [0.0; 6]);
        machine.upload(source);
        (0..20).for_each(|_| machine.step());
        assert!(machine.robot.servo.actual_q.iter().all(|q| q.is_finite()));
    }

    fn session(bytes: &[u8], cut: usize) -> Vec<u8> {
        let mut machine = Machine::new(Series::Cb3, Series::Cb3.default_version(), [0.0; 6]);
        let mut owners = InputOwners::default();
        let mut session = RtdeSession::new(1);
        let mut answers = Vec::new();
        for piece in bytes.chunks(cut.max(1)) {
            let mut context = SessionContext { machine: &mut machine, owners: &mut owners, hidden: &[], refuse_version_2: false };
            if session.feed(piece, &mut context, &mut answers).is_err() {
                break;
            }
        }
        machine.step();
        answers.extend(session.output(&machine).unwrap_or_default());
        answers
    }

    /// RTDE frames with right sizes and mostly right types.
    fn frames() -> impl Strategy<Value = Vec<u8>> {
        let payload = prop_oneof![
            prop::collection::vec(any::<u8>(), 0..40),
            Just(vec![0, 2]),
            Just(b"input_int_register_24,input_double_register_24,".to_vec()),
            Just([&125f64.to_be_bytes()[..], b"timestamp,actual_q,"].concat()),
        ];
        let frame = (prop::sample::select(b"VvOISPUM\0".to_vec()), payload).prop_map(|(kind, payload)| {
            let mut frame = ((payload.len() + 3) as u16).to_be_bytes().to_vec();
            frame.push(kind);
            frame.extend(payload);
            frame
        });
        prop::collection::vec(frame, 0..12).prop_map(|f| f.concat())
    }

    proptest! {
        #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

        // Protects the controller's thread from any program: no panic, no endless step, joints stay numbers.
        #[test]
        fn programs_of_random_words_do_not_panic(source in words()) {
            run_program(&source);
            run_program(&format!("def a():\n{source}\nend\n"));
        }

        // Protects the same from programs that get past the parser.
        #[test]
        fn random_programs_do_not_panic(source in program()) {
            run_program(&source);
        }

        // Protects the same from random characters.
        #[test]
        fn programs_of_random_characters_do_not_panic(source in "\\PC{0,200}") {
            let _ = check_program(&source);
        }

        // Protects the RTDE parser: no panic, and the same answers however the bytes are cut.
        #[test]
        fn rtde_answers_do_not_depend_on_how_bytes_are_cut(bytes in frames(), cut in 1usize..9) {
            prop_assert_eq!(session(&bytes, cut), session(&bytes, usize::MAX));
        }

        // Protects the RTDE parser from bytes that are no frames at all.
        #[test]
        fn rtde_survives_random_bytes(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            session(&bytes, 7);
        }

        // Protects the line interfaces.
        #[test]
        fn line_interfaces_survive_random_bytes(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
            let mut assembler = ProgramAssembler::default();
            let _ = assembler.feed(&bytes);
            let _ = assembler.finish();
            let mut machine = Machine::new(Series::ESeries, Series::ESeries.default_version(), [0.0; 6]);
            let _ = dashboard::answer(&String::from_utf8_lossy(&bytes), &mut machine);
        }
    }

    // Protects the stack: nesting and chains deeper than any real program end in an error, not in an overflow.
    #[test]
    fn deep_sources_are_errors() {
        for source in [
            "(".repeat(100_000),
            format!("a = {}1", "-".repeat(100_000)),
            format!("a = {}True", "not ".repeat(100_000)),
            format!("a = 1{}", " + 1".repeat(100_000)),
            format!("a = x{}", "[0]".repeat(100_000)),
            "if True:\n".repeat(100_000),
            "def f():\n".repeat(100_000),
            format!("a = {}", "p[1,".repeat(100_000)),
            format!("a = {}{}", "[".repeat(60), "]".repeat(60)),
        ] {
            let _ = check_program(&source);
            run_program(&source);
        }
    }
}
