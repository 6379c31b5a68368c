//! The command line of `trainer`: its commands, their arguments, and the text of `--help`, from which the manual pages are made too.
//!
//! Plain data for the main thread; nothing here fails.

use clap::{Parser, Subcommand};

use crate::commands::{check, inspect, plan, refine, report, train};

/// The offline trainer: weighed episodes in, one weight file out.
#[derive(Parser)]
#[command(version, about, after_help = shared::exit::HELP)]
pub struct Cli {
    /// What is to be done.
    #[command(subcommand)]
    pub command: Command,
}

/// The commands.
#[derive(Subcommand)]
pub enum Command {
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
