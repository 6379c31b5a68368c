//! The command line of `decant`: its commands, their arguments, and the text of `--help`, from which the manual page is made too.
//!
//! Plain data for the main thread; nothing here fails.

use std::ffi::OsString;

use clap::{Parser, Subcommand};

use crate::{doctor, metrics, programs};

/// Everything an operator needs, by one name.
#[derive(Parser)]
#[command(name = "decant", version, about, after_help = programs::help())]
pub struct Cli {
    /// What is to be done.
    #[command(subcommand)]
    pub command: Command,
}

/// The commands.
#[derive(Subcommand)]
pub enum Command {
    /// Looks at machine, disk, camera, robot, configuration and weights, and says what is wrong and what to do.
    Doctor(doctor::Args),
    /// Serves the cell's counters, histograms, ages and errors as OpenMetrics, for Prometheus.
    Metrics(metrics::Args),
    /// A command of another program; they are listed below.
    #[command(external_subcommand)]
    Other(Vec<OsString>),
}
