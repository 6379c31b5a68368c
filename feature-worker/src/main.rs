//! Command line of `feature-worker`.

use std::process::ExitCode;

use clap::Parser as _;
use feature_worker::cli::{Cli, Command};
use feature_worker::commands::{bench, calibrate, camera, episodes, inspect, run, view};

/// Keeps OpenCV's decoders from writing to the terminal by themselves: every fault that they report is an error of ours, with what to do. Whoever
/// sets the variables differently gets the messages.
fn quiet_libraries() {
    let variables = [("OPENCV_LOG_LEVEL", "SILENT"), ("OPENCV_FFMPEG_LOGLEVEL", "-8"), ("OPENCV_VIDEOIO_DEBUG", "0")];
    for (name, value) in variables {
        if std::env::var_os(name).is_none() {
            // If it cannot be set there is more to read, and nothing is wrong.
            let _ = shared::os::set_variable(name, value);
        }
    }
}

fn main() -> ExitCode {
    quiet_libraries();
    shared::exit::explain_panics("feature-worker");
    let command = Cli::parse().command;
    if matches!(command, Command::Camera(_)) {
        shared::os::end_when_nobody_reads();
    }
    if matches!(command, Command::Calibrate(_) | Command::View(_)) {
        let lost = "error: shared memory vanished: /dev/shm is full, or a file there was cut";
        shared::os::explain_bus_errors(lost, shared::exit::UNREACHABLE, std::sync::Arc::default());
    }
    shared::exit::end(match command {
        Command::Run(args) => return shared::exit::end_resident(run::run(&args)),
        Command::Calibrate(args) => calibrate::run(&args),
        Command::Camera(args) => camera::run(&args),
        Command::View(args) => view::run(&args),
        Command::Inspect(args) => inspect::run(&args),
        Command::Episodes(args) => episodes::run(&args),
        Command::Bench(args) => bench::run(&args),
    })
}
