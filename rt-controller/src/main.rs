//! The command line of `rt-controller`: it reads the arguments, runs the command in the main thread, and turns a failure into one line and
//! an exit code. It allocates.

use std::process::ExitCode;

use clap::Parser as _;
use rt_controller::cli::{Cli, Command};
use rt_controller::commands::{abort, pour, record, replay, resume, run, status, step};

/// Counts allocations, so that the loop can show that it makes none.
#[global_allocator]
static ALLOCATOR: shared::os::CountingAllocator = shared::os::CountingAllocator;

fn main() -> ExitCode {
    shared::exit::explain_panics("rt-controller");
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
