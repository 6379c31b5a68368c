//! The command line of `feature-worker`: its commands, their arguments, and the text of `--help`, from which the manual pages are made too.
//!
//! Plain data for the main thread; nothing here fails.

use clap::{Parser, Subcommand};

use crate::commands::{bench, calibrate, camera, episodes, inspect, run, view};

/// The vision process: camera frames in, V_e and episodes out.
#[derive(Parser)]
#[command(version, about, after_help = shared::exit::HELP)]
pub struct Cli {
    /// What is to be done.
    #[command(subcommand)]
    pub command: Command,
}

/// The commands.
#[derive(Subcommand)]
pub enum Command {
    /// Measures V_e in every frame, publishes it and records episodes.
    Run(run::Args),
    /// Finds the container's axes and the liquid's colour; writes the section `image`.
    Calibrate(calibrate::Args),
    /// Lists this machine's cameras: names, formats, rates, controls, and who uses them.
    Camera(camera::Args),
    /// Shows the live stream with what is measured, in a local web page.
    View(view::Args),
    /// Writes pictures and a CSV of what is measured in images or a video.
    Inspect(inspect::Args),
    /// Lists, shows, checks, weighs and exports episodes.
    Episodes(episodes::Args),
    /// Measures the time of each stage of the extraction.
    Bench(bench::Args),
}
