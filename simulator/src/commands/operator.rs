//! `simulator operator`: does what a person does at the simulated cell: fills the container, reads the scale, causes a fault.
//!
//! An ordinary process that allocates. It writes one line to the cell's operator socket and prints the answer. Without a cell that answers
//! it ends with an error of one line.

use std::io::{BufRead, BufReader, Write};
use std::os::unix::net::UnixStream;
use std::path::PathBuf;

use clap::Subcommand;
use serde_json::Value;
use shared::config::Config;
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::runtime_dir::Place;

use crate::{cell, ur};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  simulator operator fill 300\n  simulator operator scale\n  simulator operator fault protective-stop")]
pub struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Debug, Subcommand)]
enum Action {
    /// Puts a filled container into the gripper and an empty, tared cup on the scale.
    Fill {
        /// Volume in ml.
        volume_ml: f64,
        #[command(flatten)]
        common: Common,
    },
    /// Reads the kitchen scale, in whole grams. Wait until the pour is over.
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
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Print the answer as JSON.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let (Action::Fill { common, .. } | Action::Scale { common } | Action::Fault { common, .. }) = &args.action;
    let config = Config::read(&common.config).or_exit(exit::BAD_INPUT)?;
    let line = match &args.action {
        Action::Fill { volume_ml, .. } => format!("fill {volume_ml}"),
        Action::Scale { .. } => "scale".into(),
        Action::Fault { fault, .. } => return cause(&config, fault),
    };
    let name = &config.cell.name;
    let absent = |e| format!("no simulated cell '{name}' ({e}): is `simulator run` running with the same --config?");
    let answer = ask(&config.cell, &line).map_err(absent).or_exit(exit::UNREACHABLE)?;
    if let Some(error) = answer["error"].as_str() {
        return Err(failure(exit::REFUSED, error));
    }
    match &args.action {
        _ if common.json => println!("{answer}"),
        Action::Fill { volume_ml, .. } => println!("{volume_ml} ml in the container, the scale reads 0 g"),
        Action::Scale { .. } => println!("{} g", answer["weight_g"]),
        Action::Fault { .. } => {}
    }
    Ok(())
}

fn cause(config: &Config, fault: &str) -> Result<(), Failure> {
    let fault: ur::Fault = fault.parse().or_exit(exit::BAD_INPUT)?;
    let address = config.robot.address.resolve().or_exit(exit::BAD_INPUT)?;
    ur::send_fault(address, &fault).or_exit(exit::UNREACHABLE)
}

/// Writes one line to the operator socket of the cell `place`, and returns its answer.
///
/// # Errors
/// When nothing listens at the socket, or the answer is not JSON.
pub fn ask(place: impl Into<Place>, line: &str) -> std::io::Result<Value> {
    let mut stream = UnixStream::connect(cell::operator_socket(place))?;
    writeln!(stream, "{line}")?;
    let mut answer = String::new();
    BufReader::new(&stream).read_line(&mut answer)?;
    serde_json::from_str(&answer).map_err(std::io::Error::other)
}
