//! Command line of `feature-worker`.

use std::process::ExitCode;

use clap::Parser as _;
use feature_worker::cli::{Cli, Command};
use feature_worker::commands::{bench, calibrate, camera, episodes, inspect, run, view};

/// OpenCV's variable for how much it writes to the terminal; the library reads it before `main` begins.
const LOG_LEVEL: &str = "OPENCV_LOG_LEVEL";
/// The same for its FFmpeg, which is read when a video is opened.
const FFMPEG_LOG_LEVEL: &str = "OPENCV_FFMPEG_LOGLEVEL";

/// Keeps OpenCV's decoders from writing to the terminal by themselves: every fault that they report is an error of ours, with what to do. Whoever
/// sets the variables gets the messages. If it fails there is more to read, and nothing is wrong.
fn quiet_libraries() {
    if std::env::var_os(LOG_LEVEL).is_none() {
        let _ = opencv::core::set_log_level(opencv::core::LogLevel::LOG_LEVEL_SILENT);
    }
    if std::env::var_os(FFMPEG_LOG_LEVEL).is_none() {
        let _ = shared::os::set_variable(FFMPEG_LOG_LEVEL, "-8");
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
