//! URScript: what expressions and statements come to, and which mistakes are found where.

use simulator::ur::program::check_program;
use simulator::ur::script::MAX_SOURCE_BYTES;
use simulator::ur::{LogKind, RuntimeState};

use crate::{lines, run};

/// The lines that `body` writes with textmsg.
fn said(body: &str) -> Vec<String> {
    let (_, log) = run(body, 20);
    assert_eq!(lines(&log, LogKind::ProgramError), Vec::<&str>::new(), "in {body}");
    lines(&log, LogKind::Text).into_iter().map(str::to_owned).collect()
}

/// The error with which `body` ends.
fn error_of(body: &str) -> String {
    let (machine, log) = run(body, 20);
    assert_ne!(machine.runtime_state(), RuntimeState::Playing, "still running: {body}");
    lines(&log, LogKind::ProgramError).first().map_or_else(|| panic!("no error: {body}"), |e| (*e).to_owned())
}

// Protects the results of expressions: a program that is tested here must mean the same on a robot.
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

// Protects control flow: loops, branches, functions with defaults and named arguments, recursion, and scopes.
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

// Protects against silent misreading: each mistake is an error that names its line and cause.
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

// Protects code after the last end, an empty program and one that is too long: nothing may be dropped silently.
#[test]
fn nothing_after_the_program_is_ignored() {
    let error = check_program("def a():\n  sync()\nend\nb = 1\n").unwrap_err();
    assert_eq!(error.to_string(), "line 4: 'b' after the program's last 'end'");
    assert!(check_program("").is_err());
    assert!(check_program(&"#".repeat(MAX_SOURCE_BYTES + 1)).is_err());
}

// Protects threads: they share globals, run in the same cycle and can be joined and killed, and only one may move the arm.
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
