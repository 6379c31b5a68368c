//! Random input for a bounded time. The cargo-fuzz targets in fuzz/ run the same functions for longer.

use proptest::prelude::*;
use simulator::ur::Machine;
use simulator::ur::client_interface::ProgramAssembler;
use simulator::ur::program::check_program;
use simulator::ur::rtde::{InputOwners, RtdeSession, SessionContext};
use simulator::ur::{Series, dashboard};

/// A text of the language's own words, which reaches deeper than random bytes.
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

/// An expression that parses; most are wrong in type or value.
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

/// A program that parses and runs until its first mistake.
fn program() -> impl Strategy<Value = String> {
    let simple = prop_oneof![
        expression().prop_map(|e| format!("x = {e}")),
        expression().prop_map(|e| format!("textmsg({e})")),
        (expression(), expression()).prop_map(|(i, e)| format!("q[{i}] = {e}")),
        expression().prop_map(|e| format!("q = q + {e}")),
        expression().prop_map(|e| format!("write_output_integer_register(24, {e})")),
        expression().prop_map(|e| format!("stopj({e})")),
        expression().prop_map(|e| format!("sleep({e})")),
        prop::sample::select(vec!["sync()", "servoj(q)", "n = n + 1", "x = run t()", "join x", "kill x", "halt", "x = None", "x = [x, x]"])
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

/// RTDE packets with right sizes and mostly right types.
fn packets() -> impl Strategy<Value = Vec<u8>> {
    let payload = prop_oneof![
        prop::collection::vec(any::<u8>(), 0..40),
        Just(vec![0, 2]),
        Just(b"input_int_register_24,input_double_register_24,".to_vec()),
        Just([&125f64.to_be_bytes()[..], b"timestamp,actual_q,"].concat()),
    ];
    let packet = (prop::sample::select(b"VvOISPUM\0".to_vec()), payload).prop_map(|(kind, payload)| {
        let mut packet = ((payload.len() + 3) as u16).to_be_bytes().to_vec();
        packet.push(kind);
        packet.extend(payload);
        packet
    });
    prop::collection::vec(packet, 0..12).prop_map(|f| f.concat())
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 2000, failure_persistence: None, ..ProptestConfig::default() })]

    // Protects the controller's thread from any program: no panic, no endless step, and joints that stay numbers.
    #[test]
    fn programs_of_random_words_do_not_panic(source in words()) {
        run_program(&source);
        run_program(&format!("def a():\n{source}\nend\n"));
    }

    // Protects the controller's thread from programs that get past the parser.
    #[test]
    fn random_programs_do_not_panic(source in program()) {
        run_program(&source);
    }

    // Protects the controller's thread from random characters.
    #[test]
    fn programs_of_random_characters_do_not_panic(source in "\\PC{0,200}") {
        let _ = check_program(&source);
    }

    // Protects the reader of RTDE packets: no panic, and the same answers however the bytes are cut.
    #[test]
    fn rtde_answers_do_not_depend_on_how_bytes_are_cut(bytes in packets(), cut in 1usize..9) {
        prop_assert_eq!(session(&bytes, cut), session(&bytes, usize::MAX));
    }

    // Protects the reader of RTDE packets from bytes that are no packets at all.
    #[test]
    fn rtde_survives_random_bytes(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        session(&bytes, 7);
    }

    // Protects the interfaces that read lines from random bytes.
    #[test]
    fn line_interfaces_survive_random_bytes(bytes in prop::collection::vec(any::<u8>(), 0..300)) {
        let mut assembler = ProgramAssembler::default();
        let _ = assembler.feed(&bytes);
        let _ = assembler.finish();
        let mut machine = Machine::new(Series::ESeries, Series::ESeries.default_version(), [0.0; 6]);
        let _ = dashboard::answer(&String::from_utf8_lossy(&bytes), &mut machine);
    }
}

// Protects the stack: nesting and chains deeper than in any real program end in an error and not in an overflow.
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
