//! The command line of `decant`, the operator's one program: `doctor` looks at everything that a pour needs, and every other command is
//! that of the program which does it.
//!
//! Ordinary process; allocates. Failures are one line and an exit code; a command of another program ends as that program does.

mod doctor;
mod programs;

use std::ffi::OsString;
use std::process::ExitCode;

use clap::{Parser, Subcommand};

/// Pours exact volumes by watching the stream: everything an operator needs, by one name.
#[derive(Parser)]
#[command(name = "decant", version, about, after_help = programs::help())]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Looks at machine, disk, camera, robot, configuration and weights, and says what is wrong and what to do.
    Doctor(doctor::Args),
    /// A command of another program; they are listed below.
    #[command(external_subcommand)]
    Other(Vec<OsString>),
}

fn main() -> ExitCode {
    shared::exit::end(match Cli::parse().command {
        Command::Doctor(args) => {
            shared::os::end_when_nobody_reads();
            doctor::run(&args)
        }
        Command::Other(words) => programs::run(&words),
    })
}
