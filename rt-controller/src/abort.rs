//! `rt-controller abort`: upright at once. Ordinary process.

use std::path::PathBuf;
use std::process::ExitCode;
use std::time::{Duration, Instant};

use shared::config::Config;
use shared::control::{Reply, Request};
use shared::exit;
use shared::messages::Phase;

use crate::client::Client;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  rt-controller abort")]
pub struct Args {
    /// The cell's configuration.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
}

/// Runs the command; the exit codes are those of [`shared::exit`].
pub fn run(args: &Args) -> ExitCode {
    let config = match Config::read(&args.config) {
        Ok(config) => config,
        Err(e) => return exit::fail(exit::BAD_INPUT, e),
    };
    let client = match Client::connect(&config.cell.name) {
        Ok(client) => client,
        Err(e) => return exit::fail(exit::UNREACHABLE, e),
    };
    match client.ask(&Request::Abort) {
        Ok(Reply::Aborting) => {}
        Ok(Reply::Refused { reason }) => return exit::fail(exit::REFUSED, reason),
        Ok(_) => return exit::fail(exit::UNREACHABLE, crate::client::ClientError::Version),
        Err(e) => return exit::fail(exit::UNREACHABLE, e),
    }
    let tolerance_deg = config.robot.start_tolerance_deg;
    let until = Instant::now() + Duration::from_secs(20);
    while Instant::now() < until {
        match client.status() {
            Ok(s) if matches!(s.phase, Phase::Idle | Phase::Settling) && f64::from(s.alpha_measured_deg.abs()) <= tolerance_deg => {
                println!("upright");
                return ExitCode::SUCCESS;
            }
            Ok(s) if s.phase == Phase::NoRobot => return exit::fail(exit::FAILED, s.hindrance),
            Ok(_) => std::thread::sleep(Duration::from_millis(50)),
            Err(e) => return exit::fail(exit::UNREACHABLE, e),
        }
    }
    exit::fail(exit::FAILED, "not upright after 20 s: look at the robot")
}
