//! The house's other programs, as children: at a low priority, one line of progress after the other, and their answer at the end.
//!
//! An ordinary thread waits for each; it allocates, and what a child says is bounded. A child that fails gives its last line.

use std::io::{BufRead as _, BufReader, Read as _};
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::mpsc::channel;
use std::time::Duration;

use serde::Deserialize;
use serde_json::Value;

/// Longest answer of a program, bytes. Chosen by hand: a training's report takes a tenth.
const ANSWER_MAX: u64 = 16 << 20;
/// Pause between two looks at a child. Chosen by hand; no measurement is recorded.
const BEAT: Duration = Duration::from_millis(50);

/// How far a program has come.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
pub struct Step {
    /// The stage's name.
    pub stage: String,
    /// Steps done.
    pub step: u64,
    /// Steps of the stage.
    pub steps: u64,
    /// How well it goes.
    #[serde(default)]
    pub note: String,
}

/// The program `name`: beside this one, or where the system looks.
pub fn program(name: &str) -> PathBuf {
    let beside = std::env::current_exe().ok().and_then(|own| own.parent().map(|directory| directory.join(name)));
    beside.filter(|path| path.exists()).unwrap_or_else(|| name.into())
}

/// Runs a program with `arguments` to its end, or until `stop` is set. Gives its JSON and whether it succeeded; `step` gets its progress. A
/// program without an answer gives its last line as error.
pub fn run(name: &str, arguments: &[String], stop: &AtomicBool, mut step: impl FnMut(Step)) -> Result<(Value, bool), String> {
    let path = program(name);
    let mut command = Command::new("nice");
    command.args(["-n", "19"]).arg(&path).args(arguments);
    command.stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
    let mut child = command.spawn().map_err(|e| format!("{}: {e}", path.display()))?;
    let (Some(output), Some(errors)) = (child.stdout.take(), child.stderr.take()) else { return Err(format!("{name}: no pipes")) };
    let answer = std::thread::spawn(move || {
        let mut bytes = Vec::new();
        // What was read until an error is what there is.
        let _ = output.take(ANSWER_MAX).read_to_end(&mut bytes);
        bytes
    });
    let (lines, said) = channel();
    std::thread::spawn(move || {
        for line in BufReader::new(errors.take(ANSWER_MAX)).lines().map_while(Result::ok) {
            if lines.send(line).is_err() {
                break;
            }
        }
    });
    let mut last = String::new();
    let mut take = |line: String| match serde_json::from_str::<Step>(&line) {
        Ok(at) => step(at),
        Err(_) if line.trim().is_empty() => {}
        Err(_) => last = line,
    };
    let succeeded = loop {
        said.try_iter().for_each(&mut take);
        match child.try_wait() {
            Ok(Some(status)) => break status.success(),
            Err(_) => break false,
            Ok(None) if stop.load(Relaxed) => {
                end(&mut child);
                return Err("it was cancelled".into());
            }
            Ok(None) => std::thread::sleep(BEAT),
        }
    };
    said.iter().for_each(&mut take);
    let bytes = answer.join().unwrap_or_default();
    match serde_json::from_slice(&bytes) {
        Ok(value) => Ok((value, succeeded)),
        Err(_) => Err(if last.is_empty() { format!("{name} gave no answer") } else { last.trim_start_matches("error: ").into() }),
    }
}

fn end(child: &mut Child) {
    // It may have ended by itself.
    let _ = child.kill();
    let _ = child.wait();
}
