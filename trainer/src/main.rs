//! Command line of `trainer`.

use std::process::ExitCode;

use clap::Parser as _;
use trainer::cli::{Cli, Command};
use trainer::commands::{check, inspect, plan, refine, report, train};

fn main() -> ExitCode {
    shared::exit::explain_panics("trainer");
    let command = Cli::parse().command;
    if matches!(command, Command::Inspect(_) | Command::Check(_) | Command::Plan(_)) {
        shared::os::end_when_nobody_reads();
    }
    shared::exit::end(match command {
        Command::Train(args) => train::run(&args),
        Command::Refine(args) => refine::run(&args),
        Command::Inspect(args) => inspect::run(&args),
        Command::Check(args) => check::run(&args),
        Command::Plan(args) => plan::run(&args),
        Command::Report(args) => report::run(&args),
    })
}
