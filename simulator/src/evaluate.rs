//! Pours in closed loop over a held-out grid and reports the errors.

use std::process::ExitCode;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
pub struct Args {}

/// Runs the command; the exit codes are those of [`shared::exit`].
pub fn run(_args: &Args) -> ExitCode {
    shared::exit::fail(shared::exit::FAILED, "not built yet")
}
