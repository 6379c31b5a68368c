//! Command line of `operator-page`: it reads the arguments, runs one command, and ends with that command's exit code.
//!
//! The main thread; it allocates. What fails is one line on standard error and a documented exit code.

use std::process::ExitCode;

use clap::Parser as _;
use operator_page::cli::{Cli, Command};
use operator_page::{link, run};

fn main() -> ExitCode {
    shared::exit::explain_panics("operator-page");
    shared::exit::end(match Cli::parse().command {
        Command::Run(args) => run::run(&args),
        Command::Link { config } => link::run(&config),
    })
}
