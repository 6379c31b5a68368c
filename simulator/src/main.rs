//! Command line of `simulator`.

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use simulator::{cell, demo, evaluate, evaluate_camera, jitter, motion, operator, reproduce, ur_command};

/// The simulated cell, and everything that needs it.
#[derive(Parser)]
#[command(version, about, after_help = shared::exit::HELP)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Runs the simulated cell: UR5 controller, container, camera, scale.
    Run(cell::Args),
    /// What an operator does at the cell: fill the container, read the scale.
    Operator(operator::Args),
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
    /// What the robot makes of a recorded pour's targets, with its program and without.
    Motion(motion::Args),
    /// Runs only the simulated UR5 controller.
    Ur(ur_command::Args),
}

fn main() -> ExitCode {
    shared::exit::end(match Cli::parse().command {
        Command::Run(args) => cell::run(&args),
        Command::Operator(args) => operator::run(&args),
        Command::Demo(args) => demo::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Reproduce(args) => reproduce::run(&args),
        Command::EvaluateCamera(args) => evaluate_camera::run(&args),
        Command::Jitter(args) => jitter::run(&args),
        Command::Motion(args) => motion::run(&args),
        Command::Ur(args) => ur_command::run(&args),
    })
}
