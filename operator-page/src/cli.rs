//! The command line of `operator-page`: its commands, their arguments, and the text of `--help`, from which the manual pages are made too.
//!
//! Plain data for the main thread; nothing here fails.

use std::path::PathBuf;

use clap::{Parser, Subcommand};

use crate::run;

/// The operator's page: pour, stop, weigh and learn, from a browser beside the robot.
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
    /// Serves the page of a cell.
    Run(run::Args),
    /// The page's own link to the cell, which `run` starts.
    #[command(hide = true)]
    Link {
        /// The cell's configuration.
        #[arg(long)]
        config: PathBuf,
    },
}
