//! `rt-controller resume`: takes the robot back after a person had it in hand, and waits until it is connected. It is a short, ordinary
//! process, and every failure is one line.

use std::time::{Duration, Instant};

use shared::config::Config;
use shared::control::{Reply, Request, RobotLink, Status};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::messages::Phase;

use crate::client::{Client, ClientError};

/// How long the command waits for the robot. Chosen by hand: connecting takes below 2 s, and the controller itself tries for 10 s.
const CONNECTED: Duration = Duration::from_secs(15);
/// Pause between two looks at the controller's state. Chosen by hand; no measurement is recorded.
const BEAT: Duration = Duration::from_millis(50);

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  rt-controller resume\n\n\
After a stop on the pendant, a pause, a protective or emergency stop, freedrive, or a joint moved by hand, the controller leaves the robot\n\
alone until you ask for it: with this command, or with the next pour or recording. Nothing moves; the robot only gets its program.\n\
Exit codes: 0 connected, 3 no controller, 5 the robot cannot be taken now (the reason is printed).")]
pub struct Args {
    /// The cell's configuration.
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    config: std::path::PathBuf,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    let client = Client::connect_or_end(&config.cell)?;
    let status = client.status()?;
    if status.phase == Phase::NoRobot {
        take_back(&client)?;
    }
    println!("the robot is connected");
    Ok(())
}

/// Takes the robot back if it waits for its operator: whoever gives an order has asked for it. Gives whether it waited.
pub(super) fn take_back_if_it_waits(client: &Client) -> Result<bool, Failure> {
    let status = client.status()?;
    if status.robot != RobotLink::WaitsForOperator || status.phase != Phase::NoRobot {
        return Ok(false);
    }
    eprintln!("taking the robot back, because you ask for it; it waited: {}", status.hindrance);
    take_back(client).map(|()| true)
}

/// Asks for the robot, and waits until it is connected and stands upright.
fn take_back(client: &Client) -> Result<(), Failure> {
    match client.ask(&Request::Resume)? {
        Reply::Resuming => {}
        Reply::Refused { reason } => return Err(failure(exit::REFUSED, reason)),
        _ => return Err(failure(exit::UNREACHABLE, ClientError::Version)),
    }
    let until = Instant::now() + CONNECTED;
    loop {
        std::thread::sleep(BEAT);
        let Status { phase, robot, hindrance, .. } = *client.status()?;
        match (phase, robot) {
            (Phase::NoRobot, RobotLink::WaitsForOperator) => return Err(failure(exit::REFUSED, hindrance)),
            (Phase::NoRobot, _) if Instant::now() < until => {}
            (Phase::NoRobot, _) => return Err(failure(exit::REFUSED, hindrance)),
            _ => return Ok(()),
        }
    }
}
