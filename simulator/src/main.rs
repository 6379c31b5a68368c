//! Command line of `simulator`.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use simulator::commands::{operator, run, ur};

/// The simulated cell, in place of a real robot, container, camera and scale.
#[derive(Parser)]
#[command(version, about, after_help = shared::exit::HELP)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Runs the simulated cell: UR5 controller, container, camera, scale.
    Run(run::Args),
    /// Does what an operator does at the cell: fills the container, reads the scale, causes a fault.
    Operator(operator::Args),
    /// Runs only the simulated UR5 controller.
    Ur(ur::Args),
}

fn main() -> ExitCode {
    shared::exit::explain_panics("simulator");
    shared::exit::end(match Cli::parse().command {
        Command::Run(args) => run::run(&args),
        Command::Operator(args) => operator::run(&args),
        Command::Ur(args) => ur::run(&args),
    })
}
