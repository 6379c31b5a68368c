//! Command line of `trainer`.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use trainer::commands::{check, inspect, plan, refine, report, train};

/// The offline trainer: weighed episodes in, one weight file out.
#[derive(Parser)]
#[command(version, about, after_help = shared::exit::HELP)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Trains a policy from episodes and writes a weight file.
    Train(train::Args),
    /// Refits calibration, model and policy from all weighed episodes.
    Refine(refine::Args),
    /// Prints everything in a weight file.
    Inspect(inspect::Args),
    /// Says what is wrong with a data set before any training.
    Check(check::Args),
    /// Says which curve or pour to weigh next, because it teaches most.
    Plan(plan::Args),
    /// Writes the HTML page of a training or evaluation.
    Report(report::Args),
}

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
