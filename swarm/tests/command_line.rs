//! The command line: what is wrong is said in one line, and a violation can be shown again.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::io::{BufRead, BufReader};
use std::process::{Command, Output, Stdio};

fn swarm(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_swarm")).args(args).output().unwrap()
}

/// Protects an operator who mistypes: one line that names the mistake, on the error stream, and exit code 2.
#[test]
fn bad_input_is_one_line() {
    let cases: [(&[&str], &str); 10] = [
        (&["--seed", "seven"], "seven"),
        (&["--seed", "-1"], "-1"),
        (&["--seeds", "0"], "--seeds"),
        (&[], "--seed"),
        (&["--seed", "1", "--only", "earthquake"], "no fault is called earthquake; there are protective-stop, "),
        (
            &["--seed", "1", "--only", "picture-banding"],
            "--only picture-banding is a fault of pictures, and none are drawn: add --eye camera",
        ),
        (&["--seed", "1", "--keep", "99"], "--keep 99: seed 1 has "),
        (&["--seeds", "10", "--from", "18446744073709551615"], "--from 18446744073709551615 leaves fewer than 10 seeds"),
        (&["--seeds", "1", "--json", "/nowhere/at/all.json"], "/nowhere/at/all.json: cannot be written"),
        (&["--seeds", "1", "--json", "/dev/full"], "/dev/full: cannot be written"),
    ];
    for (args, part) in cases {
        let output = swarm(args);
        let text = String::from_utf8(output.stderr).unwrap();
        assert_eq!((output.status.code(), text.lines().count()), (Some(2), 1), "{args:?}: {text}");
        assert!(text.starts_with("error: ") && text.contains(part), "{args:?}: {text}");
    }
}

/// Protects an hour of work on a full disk: the results that could not be written are an error, with the file's name. It takes root, for a small file
/// system of its own.
#[test]
fn a_full_disk_is_told() {
    let small = std::env::temp_dir().join(format!("swarm-full-{}", std::process::id()));
    std::fs::create_dir(&small).unwrap();
    // Its file is there, and no space is left.
    let script = r#"mount -t tmpfs -o size=64k tmpfs "$0" && cd "$0" && : > out.json && dd if=/dev/zero of=fill bs=4k status=none 2>/dev/null; "$@""#;
    let mut command = Command::new("unshare");
    command.args(["-m", "--propagation", "private", "sh", "-c", script]).arg(&small).arg(env!("CARGO_BIN_EXE_swarm"));
    let args = ["--seeds", "1", "--from", "1", "--vessels", "1", "--json", "out.json"];
    let output = command.args(args).output().unwrap();
    std::fs::remove_dir(&small).unwrap();
    let text = String::from_utf8(output.stderr).unwrap();
    if text.contains("Operation not permitted") {
        println!("not run: it takes root");
        return;
    }
    let last = text.lines().last().unwrap();
    assert_eq!(output.status.code(), Some(2), "{text}");
    assert!(last.starts_with("error: out.json: cannot be written: the disk is full"), "{text}");
}

/// Protects an hour of work from Ctrl-C: what the seeds so far have shown is printed, and the rest is left out.
#[test]
fn a_signal_ends_it_with_its_results() {
    let args = ["--seeds", "100000", "--from", "1", "--vessels", "1", "--robot", "cb3"];
    let mut child = Command::new(env!("CARGO_BIN_EXE_swarm")).args(args).stdout(Stdio::piped()).stderr(Stdio::piped()).spawn().unwrap();
    let mut lines = BufReader::new(child.stderr.take().unwrap()).lines();
    assert!(lines.next().unwrap().unwrap().contains("training"));
    assert!(Command::new("kill").arg(child.id().to_string()).status().unwrap().success());
    let said: Vec<String> = lines.map(Result::unwrap).collect();
    let output = child.wait_with_output().unwrap();
    let text = String::from_utf8(output.stdout).unwrap();
    assert_eq!(output.status.code(), Some(130), "{said:?}");
    assert!(said.iter().any(|line| line.contains("stopped: ") && line.contains(" of 100000 seeds were run")), "{said:?}");
    assert!(text.starts_with("seeds 1 to 256: "), "{text}");
}

/// Protects the replay: a seed is told in words, the same twice, and drawn to a file; a plot that cannot be written is one line.
#[test]
fn a_seed_is_told_and_drawn() {
    let plot = std::env::temp_dir().join(format!("swarm-{}.svg", std::process::id()));
    let args = ["--seed", "3", "--only", "worker-hung", "--plot", plot.to_str().unwrap()];
    let (one, two) = (swarm(&args), swarm(&args));
    let drawn = std::fs::read_to_string(&plot).unwrap();
    std::fs::remove_file(&plot).unwrap();
    assert_eq!(one.stdout, two.stdout);
    assert!(String::from_utf8(one.stdout).unwrap().contains("worker-hung"));
    assert!(["<svg", "degrees", "measured alpha", "poured", "worker-hung"].iter().all(|word| drawn.contains(word)));
    let nowhere = swarm(&["--seed", "3", "--plot", "/nowhere/at/all.svg"]);
    let text = String::from_utf8(nowhere.stderr).unwrap();
    assert_eq!(nowhere.status.code(), Some(2));
    assert!(text.lines().last().unwrap().starts_with("error: /nowhere/at/all.svg: "), "{text}");
}
