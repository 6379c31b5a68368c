//! `rt-controller abort`: brings the container upright at once, and waits until it is. It is a short,
//! ordinary process, and every failure is one line.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use shared::config::Config;
use shared::control::{Reply, Request};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::messages::Phase;

use crate::client::Client;

/// How long the command waits for the container to be upright. Chosen by hand: the way back from the largest tilt takes about 2 s.
const UPRIGHT: Duration = Duration::from_secs(20);
/// Pause between two looks at the controller's state. Chosen by hand; no measurement is recorded.
const BEAT: Duration = Duration::from_millis(50);

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  rt-controller abort")]
pub struct Args {
    /// The cell's configuration.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    let client = Client::connect(&config.cell.name).or_exit(exit::UNREACHABLE)?;
    match client.ask(&Request::Abort).or_exit(exit::UNREACHABLE)? {
        Reply::Aborting => {}
        Reply::Refused { reason } => return Err(failure(exit::REFUSED, reason)),
        _ => return Err(failure(exit::UNREACHABLE, crate::client::ClientError::Version)),
    }
    let tolerance_deg = config.robot.start_tolerance_deg;
    let until = Instant::now() + UPRIGHT;
    while Instant::now() < until {
        let status = client.status().or_exit(exit::UNREACHABLE)?;
        match status.phase {
            Phase::Idle | Phase::Settling if f64::from(status.alpha_measured_deg.abs()) <= tolerance_deg => {
                println!("upright");
                return Ok(());
            }
            Phase::NoRobot => return Err(failure(exit::FAILED, status.hindrance)),
            _ => std::thread::sleep(BEAT),
        }
    }
    Err(failure(exit::FAILED, "not upright after 20 s: look at the robot"))
}
