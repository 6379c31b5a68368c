//! `rt-controller pour ML`: asks the running controller for a pour, shows its progress, and ends with its result. It is a short,
//! ordinary process, and every failure is one line.

use shared::config::{CellConfig, Config};
use shared::control::{EndReason, Outcome, Reply, Request};
use shared::exit::{self, Failure, OrExit as _, failure};

use super::resume;
use crate::client::{self, Client, Common, FollowError};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  rt-controller pour 75\n  rt-controller pour 120 --json\n\n\
Ctrl-C aborts the pour: the container comes upright.\n\
Exit codes: 0 poured, 3 no controller, 4 ended early (the reason is printed), 5 refused, 130 interrupted.")]
pub struct Args {
    /// Goal volume V_G in ml.
    goal_ml: f32,
    #[command(flatten)]
    common: Common,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.common.config).or_exit(exit::BAD_INPUT)?;
    let (outcome, recorded) = order(&config.cell, &Request::Pour { goal_ml: args.goal_ml })?;
    report(&outcome, recorded, args.common.json);
    ended(&outcome)
}

/// Fails unless the pour or recording ended with `Done`.
pub(crate) fn ended(outcome: &Outcome) -> Result<(), Failure> {
    match outcome.reason {
        EndReason::Done => Ok(()),
        reason => Err(failure(exit::ENDED_EARLY, format!("ended early: {}", reason.words()))),
    }
}

/// Gives an order that moves the container, follows it to its end, and waits for the recorder's report, if there is a recorder.
pub(crate) fn order(cell: &CellConfig, request: &Request) -> Result<(Outcome, Option<client::Recorded>), Failure> {
    let client = Client::connect_or_end(cell).or_exit(exit::UNREACHABLE)?;
    resume::take_back_if_it_waits(&client)?;
    let recorder = client::RecorderReports::open(cell).ok();
    let episode = match client.ask(request).or_exit(exit::UNREACHABLE)? {
        Reply::Started { episode } => episode,
        Reply::Refused { reason } => return Err(failure(exit::REFUSED, reason)),
        _ => return Err(failure(exit::UNREACHABLE, client::ClientError::Version)),
    };
    let outcome = client.follow(episode).map_err(|e| match e {
        FollowError::Interrupted(o) if matches!(o.reason, EndReason::Aborted | EndReason::Done) => {
            failure(exit::INTERRUPTED, format!("interrupted: {}, the container is upright", o.reason.words()))
        }
        e @ FollowError::Interrupted(_) => failure(exit::INTERRUPTED, format!("{e}; look at the robot")),
        FollowError::Client(e) => failure(exit::UNREACHABLE, e),
    })?;
    Ok((outcome, recorder.and_then(|r| r.wait(episode))))
}

/// Prints how the pour ended.
fn report(outcome: &Outcome, recorded: Option<client::Recorded>, json: bool) {
    if json {
        let file = recorded.as_ref().and_then(|r| r.file.as_ref().ok());
        println!("{}", serde_json::json!({ "outcome": outcome, "episode_file": file }));
    } else {
        println!(
            "{}: {} ml poured (estimate) for a goal of {:.1} ml in {:.1} s; {} frames ({} bridged), {} gaps between ticks, {} stale features",
            outcome.reason.words(),
            outcome.poured_words(),
            outcome.goal_ml.unwrap_or(f32::NAN),
            outcome.seconds,
            outcome.frames,
            outcome.bridged_frames,
            outcome.tick_gaps,
            outcome.stale_features
        );
        match recorded.map(|r| r.file) {
            Some(Ok(file)) => println!("recorded: {file}\nread the scale, then: feature-worker episodes weigh {file} --weight GRAMS"),
            Some(Err(e)) => println!("not recorded: {e}"),
            None => println!("not recorded: no recorder answered"),
        }
    }
}
