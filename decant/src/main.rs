//! The command line of `decant`, the operator's one program: `doctor` looks at everything that a pour needs, `metrics` serves the cell's figures,
//! and every other command is that of the program which does it.
//!
//! Ordinary process; allocates. Failures are one line and an exit code; a command of another program ends as that program does.

use std::ffi::OsString;
use std::process::ExitCode;

use clap::Parser as _;
use decant::cli::{Cli, Command};
use decant::{doctor, metrics, programs};

/// The words of the command line. `decant help COMMAND` is `decant COMMAND --help`, because only the program that has a command knows its help.
fn words() -> Vec<OsString> {
    let mut words: Vec<OsString> = std::env::args_os().collect();
    if words.get(1).is_some_and(|word| word == "help") {
        words.remove(1);
        words.push("--help".into());
    }
    words
}

fn main() -> ExitCode {
    shared::exit::explain_panics("decant");
    shared::exit::end(match Cli::parse_from(words()).command {
        Command::Doctor(args) => {
            shared::os::end_when_nobody_reads();
            doctor::run(&args)
        }
        Command::Metrics(args) => metrics::run(&args),
        Command::Other(words) => programs::run(&words),
    })
}
