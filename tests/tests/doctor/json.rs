//! `--json` of every command of every program.

use std::process::Command;

use serde_json::Value;
use tests::program;

/// The help of a command.
fn help(name: &str, words: &[String]) -> String {
    let output = Command::new(program(name)).args(words).arg("--help").output().expect("it runs");
    String::from_utf8_lossy(&output.stdout).into_owned()
}

/// Collects the line of `--json` in the help of a command and of all below it.
fn collect(name: &str, words: &[String], found: &mut Vec<String>) {
    let text = help(name, words);
    let own = text.lines().map(str::trim).filter(|l| l.starts_with("--json"));
    found.extend(own.map(|line| format!("{name} {}: {line}", words.join(" "))));
    let below = text.lines().skip_while(|l| *l != "Commands:").skip(1).take_while(|l| l.starts_with("  "));
    for command in below.filter_map(|l| l.strip_prefix("  ")?.split_whitespace().next().filter(|_| !l.starts_with("   "))) {
        if command != "help" {
            collect(name, &[words, &[command.to_owned()]].concat(), found);
        }
    }
}

/// Protects scripts from commands that differ: `--json` alone prints JSON to standard output in place of the text, in every command that has it; those
/// that measure take a file too.
#[test]
fn json_is_the_same_everywhere() {
    let mut found = Vec::new();
    for name in ["decant", "rt-controller", "feature-worker", "operator-page", "trainer", "simulator", "experiments", "swarm"] {
        collect(name, &[], &mut found);
    }
    assert!(found.len() > 25, "{found:#?}");
    for line in &found {
        let after = line.split("--json").nth(1).expect("it was looked for").trim();
        assert!(!after.starts_with('<'), "{line}: it asks for a file");
    }
    for words in [
        &["reproduce", "--seeds", "1", "--json"][..],
        &["evaluate", "--rigs", "1", "--method", "oracle", "--json"],
        &["evaluate-camera", "--frames", "1", "--runs", "0", "--json"],
    ] {
        let dir = tempfile::tempdir().expect("a directory");
        let run = |more: &[&str]| Command::new(program("experiments")).args(words).args(more).current_dir(&dir).output().expect("it runs");
        let output = run(&[]);
        let said = String::from_utf8_lossy(&output.stdout).into_owned();
        let value: Value = serde_json::from_str(&said).unwrap_or_else(|e| panic!("{words:?}: {e}: {}", said.lines().next().unwrap_or("")));
        assert!(output.status.success() && value.is_object(), "{words:?}: {:?}", output.status);
        let refused = run(&["no-directory/out.json"]);
        let error = String::from_utf8_lossy(&refused.stderr).into_owned();
        assert!(refused.status.code() == Some(1) && error.contains("cannot be written"), "{words:?}: {error}");
    }
}
