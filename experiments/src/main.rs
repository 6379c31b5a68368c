//! Command line of `experiments`.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use experiments::commands::{bare_loop, demo, evaluate, evaluate_camera, jitter, motion, reproduce};
use experiments::jitter::bare_loop::BareLoop;

/// Experiments on the simulated cell: the demo, evaluations against the truth, latency on this machine.
#[derive(Parser)]
#[command(version, about, after_help = shared::exit::HELP)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// The main job, end to end, with the real processes: record, train, pour, report.
    Demo(demo::Args),
    /// Pours in closed loop over a held-out grid and reports the errors.
    Evaluate(evaluate::Args),
    /// Repeats section 4 of the paper.
    Reproduce(reproduce::Args),
    /// Measures the feature extraction against rendered truth.
    EvaluateCamera(evaluate_camera::Args),
    /// Measures latency and jitter of the real processes on this machine, beside cyclictest.
    Jitter(jitter::Args),
    /// The yardstick that `jitter` runs beside the controller: the loop's system calls and nothing else.
    #[command(hide = true)]
    BareLoop(BareLoop),
    /// What the robot makes of a recorded pour's targets, with its program and without.
    Motion(motion::Args),
}

fn main() -> ExitCode {
    shared::exit::explain_panics("experiments");
    shared::exit::end(match Cli::parse().command {
        Command::Demo(args) => demo::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Reproduce(args) => reproduce::run(&args),
        Command::EvaluateCamera(args) => evaluate_camera::run(&args),
        Command::Jitter(args) => jitter::run(&args),
        Command::BareLoop(settings) => bare_loop::run(&settings),
        Command::Motion(args) => motion::run(&args),
    })
}
