//! Command line of `trainer`.

use std::process::ExitCode;

use clap::Parser as _;
use trainer::cli::{Cli, Command};
use trainer::commands::{check, inspect, plan, refine, report, train};

fn main() -> ExitCode {
    shared::exit::end(match Cli::parse().command {
        Command::Train(args) => train::run(&args),
        Command::Refine(args) => refine::run(&args),
        Command::Inspect(args) => inspect::run(&args),
        Command::Check(args) => check::run(&args),
        Command::Plan(args) => plan::run(&args),
        Command::Report(args) => report::run(&args),
    })
}
