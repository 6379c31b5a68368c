//! `simulator run`: the simulated cell in real time, until Ctrl-C or SIGTERM.
//!
//! An ordinary process; the threads of the cell are those of [`crate::cell`]. A bad configuration is an error of one line.

use std::path::PathBuf;

use shared::config::Config;
use shared::exit::{self, Failure, OrExit as _, failure};

use crate::cell::{self, SimulatorConfig};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  simulator run --config config/sim.toml\n\nThen start `feature-worker run` and `rt-controller run` with the same \
configuration, and act as the operator with `simulator operator`."
)]
pub struct Args {
    /// The simulated cell's configuration.
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    let simulated = SimulatorConfig::new(&config).map_err(|e| format!("{}: {e}", args.config.display())).or_exit(exit::BAD_INPUT)?;
    if cell::runs(&config.cell) {
        let name = &config.cell.name;
        let what = format!("cell '{name}' is already being simulated; stop that simulator first, or choose another cell.name");
        return Err(failure(exit::REFUSED, what));
    }
    cell::simulate(config, simulated).or_exit(exit::FAILED)
}
