//! The command line of `rt-controller`: its commands, their arguments, and the text of `--help`, from which the manual pages are made too.
//!
//! Plain data for the main thread, which allocates; nothing here fails.

use clap::{Parser, Subcommand};

use crate::commands::{abort, pour, record, replay, resume, run, status, step};

/// The fixed-rate controller: V_e in, servo targets out.
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
    /// Runs the resident controller process.
    Run(run::Args),
    /// Pours an exact volume with the running controller.
    Pour(pour::Args),
    /// Records one experimental episode along the Gaussian curve of eq. (1).
    Record(record::Args),
    /// Brings the container upright at once.
    Abort(abort::Args),
    /// Takes the robot back after a person had it in hand.
    Resume(resume::Args),
    /// Shows state, rates, lateness histograms and counters.
    Status(status::Args),
    /// Runs the controller's core as a filter, V_e in and angles out, for any other simulator.
    Step(step::Args),
    /// Runs a journal through the same core again and compares every answer.
    Replay(replay::Args),
}
