//! The command line of `rt-controller`: it reads the arguments, runs the command in the main thread, and turns a failure into one line and
//! an exit code.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use rt_controller::commands::{abort, pour, record, replay, resume, run, status, step};

/// Counts allocations, so that the loop can show that it makes none.
#[global_allocator]
static ALLOCATOR: shared::os::CountingAllocator = shared::os::CountingAllocator;

/// The fixed-rate controller: V_e in, servo targets out.
#[derive(Parser)]
#[command(version, about, after_help = shared::exit::HELP)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
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

fn main() -> ExitCode {
    let command = Cli::parse().command;
    if matches!(command, Command::Status(_) | Command::Replay(_)) {
        shared::os::end_when_nobody_reads();
    }
    if matches!(command, Command::Pour(_) | Command::Record(_) | Command::Resume(_) | Command::Status(_)) {
        let lost = "error: shared memory vanished: /dev/shm is full, or a file there was cut; `rt-controller abort` needs none";
        shared::os::explain_bus_errors(lost, shared::exit::UNREACHABLE, std::sync::Arc::default());
    }
    shared::exit::end(match command {
        Command::Run(args) => return shared::exit::end_resident(run::run(&args)),
        Command::Pour(args) => pour::run(&args),
        Command::Record(args) => record::run(&args),
        Command::Abort(args) => abort::run(&args),
        Command::Resume(args) => resume::run(&args),
        Command::Status(args) => status::run(&args),
        Command::Step(args) => step::run(&args),
        Command::Replay(args) => replay::run(&args),
    })
}
