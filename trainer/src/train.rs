//! Trains a policy from episodes and writes a weight file.

use std::process::ExitCode;

/// Command-line arguments of `trainer`.
#[derive(Debug, clap::Args)]
pub struct Args {}

/// Runs the command; the exit codes are those of [`shared::exit`].
pub fn run(_args: &Args) -> ExitCode {
    shared::exit::fail(shared::exit::FAILED, "not built yet")
}
