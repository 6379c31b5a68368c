//! Command line of `operator-page`.

use std::process::ExitCode;

use clap::Parser as _;
use operator_page::cli::{Cli, Command};
use operator_page::{link, run};

fn main() -> ExitCode {
    shared::exit::end(match Cli::parse().command {
        Command::Run(args) => run::run(&args),
        Command::Link { config } => link::run(&config),
    })
}
