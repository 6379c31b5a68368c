//! `simulator operator`: what a person does at the simulated cell: fill the container, read the scale, cause a fault.
//!
//! An ordinary process that writes one line to the cell's operator socket and prints the answer.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;
use std::process::ExitCode;

use clap::Subcommand;
use serde_json::Value;
use shared::config::Config;
use shared::exit;

use crate::{cell, ur};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  simulator operator fill 300\n  simulator operator scale\n  simulator operator fault protective-stop")]
pub struct Args {
    #[command(subcommand)]
    act: Act,
}

#[derive(Debug, Subcommand)]
enum Act {
    /// Puts a filled container into the gripper and an empty, tared cup on the scale.
    Fill {
        /// Volume in ml.
        volume_ml: f64,
        #[command(flatten)]
        common: Common,
    },
    /// Reads the kitchen scale, in g (1 g steps); wait until the pour is over.
    Scale {
        #[command(flatten)]
        common: Common,
    },
    /// Causes a fault at the simulated robot.
    #[command(after_help = ur::fault::HELP)]
    Fault {
        /// The fault.
        fault: String,
        #[command(flatten)]
        common: Common,
    },
}

#[derive(Debug, clap::Args)]
struct Common {
    /// The simulated cell's configuration.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Print the answer as JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command; the exit codes are those of [`shared::exit`].
pub fn run(args: &Args) -> ExitCode {
    let (Act::Fill { common, .. } | Act::Scale { common } | Act::Fault { common, .. }) = &args.act;
    let config = match Config::read(&common.config) {
        Ok(config) => config,
        Err(e) => return exit::fail(exit::BAD_INPUT, e),
    };
    let line = match &args.act {
        Act::Fill { volume_ml, .. } => format!("fill {volume_ml}"),
        Act::Scale { .. } => "scale".into(),
        Act::Fault { fault, .. } => return cause(&config, fault),
    };
    let answer = match ask(&config.cell.name, &line) {
        Ok(answer) => answer,
        Err(e) => {
            let what = format!("no simulated cell '{}' ({e}): is `simulator run` running with the same --config?", config.cell.name);
            return exit::fail(exit::UNREACHABLE, what);
        }
    };
    if let Some(error) = answer["error"].as_str() {
        return exit::fail(exit::REFUSED, error);
    }
    match &args.act {
        _ if common.json => println!("{answer}"),
        Act::Fill { volume_ml, .. } => println!("{volume_ml} ml in the container, the scale reads 0 g"),
        Act::Scale { .. } => println!("{} g", answer["weight_g"]),
        Act::Fault { .. } => {}
    }
    ExitCode::SUCCESS
}

fn cause(config: &Config, fault: &str) -> ExitCode {
    let parsed: ur::Fault = match fault.parse() {
        Ok(fault) => fault,
        Err(e) => return exit::fail(exit::BAD_INPUT, e),
    };
    match ur::send_fault(config.robot.address, &parsed) {
        Ok(()) => ExitCode::SUCCESS,
        Err(e) => exit::fail(exit::UNREACHABLE, e),
    }
}

/// One line to the cell's operator socket, one answer back.
pub fn ask(cell: &str, line: &str) -> std::io::Result<Value> {
    let mut stream = UnixStream::connect(cell::operator_socket(cell))?;
    writeln!(stream, "{line}")?;
    let mut answer = String::new();
    BufReader::new(&stream).read_line(&mut answer)?;
    serde_json::from_str(&answer).map_err(std::io::Error::other)
}
