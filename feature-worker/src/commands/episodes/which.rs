//! Which episodes a command of `feature-worker episodes` is about, and how it says what came of it. On the command's thread; allocates.

use std::path::{Path, PathBuf};

use serde_json::Value;
use shared::config::Config;
use shared::episode::{ChangeError, find_episodes};
use shared::exit::{self, Failure, OrExit as _, failure};

/// Which episodes.
#[derive(Debug, clap::Args)]
pub(super) struct WhichArgs {
    /// Episodes (.mcap) or directories of them; without any, the directory of `[recording]` in the configuration.
    pub paths: Vec<PathBuf>,
    /// The cell's configuration.
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    pub config: PathBuf,
    /// Print JSON.
    #[arg(long)]
    pub json: bool,
}

impl WhichArgs {
    /// Whether nobody named a configuration, and none lies at the usual place.
    pub fn is_unconfigured(&self) -> bool {
        self.config == Path::new(shared::config::DEFAULT_FILE) && self.config.symlink_metadata().is_err()
    }
}

/// The files and directories that the arguments name.
pub(super) fn places(which: &WhichArgs) -> Result<Vec<PathBuf>, Failure> {
    match which.paths.as_slice() {
        [] => Ok(vec![Config::read(&which.config).or_exit(exit::BAD_INPUT)?.recording.directory]),
        given => Ok(given.to_vec()),
    }
}

/// The files that the arguments name.
pub(super) fn files(which: &WhichArgs) -> Result<Vec<PathBuf>, Failure> {
    find_episodes(&places(which)?).or_exit(exit::BAD_INPUT)
}

pub(super) fn print_json(value: &Value) {
    println!("{value:#}");
}

/// The failure of changing an episode.
pub(super) fn change_failure(e: &ChangeError) -> Failure {
    failure(if matches!(e, ChangeError::Write { .. }) { exit::FAILED } else { exit::BAD_INPUT }, e)
}
