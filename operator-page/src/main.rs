//! Command line of `operator-page`.

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use operator_page::{link, run};

/// The operator's page: pour, stop, weigh and learn, from a browser beside the robot.
#[derive(Parser)]
#[command(version, about, after_help = shared::exit::HELP)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
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

fn main() -> ExitCode {
    shared::exit::end(match Cli::parse().command {
        Command::Run(args) => run::run(&args),
        Command::Link { config } => link::run(&config),
    })
}
