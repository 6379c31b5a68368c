//! `feature-worker run`: measures V_e in every frame, publishes it and records episodes. See [`crate::worker`].

use std::path::PathBuf;

use shared::config::Config;
use shared::exit::{self, Failure, OrExit as _};

use crate::worker::{self, Lines};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Examples:\n  feature-worker run --config config/cell.toml\n  feature-worker run --config config/sim.toml --json\n\n\
Runs until Ctrl-C or SIGTERM (exit 0), or until its video or image sequence is over."
)]
pub struct Args {
    /// The cell's configuration.
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Print the status as one JSON object a second, to standard output.
    #[arg(long)]
    json: bool,
    /// Print a line each second, instead of only what changes.
    #[arg(long, short, conflicts_with = "json")]
    verbose: bool,
    /// Print only what keeps the worker from working.
    #[arg(long, short, conflicts_with_all = ["json", "verbose"])]
    quiet: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    let lines = match (args.json, args.verbose, args.quiet) {
        (true, ..) => Lines::Json,
        (_, true, _) => Lines::EachSecond,
        (.., true) => Lines::Quiet,
        _ => Lines::Changes,
    };
    worker::run(&config, lines)
}
