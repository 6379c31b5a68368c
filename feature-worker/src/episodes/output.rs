//! Why an export fails, and the directories that it makes. Runs on the command's thread and allocates. What was written before a failure
//! stays, but for a data set of LeRobot, which is whole or not there.

use std::collections::BTreeSet;
use std::fs;
use std::path::{Path, PathBuf};

use shared::disk_space::error_words;
use shared::episode::{EpisodeError, TableError};

/// Why an export failed.
#[derive(Debug, thiserror::Error)]
pub enum ExportError {
    /// An episode cannot be read.
    #[error(transparent)]
    Episode(#[from] EpisodeError),
    /// A table cannot be written.
    #[error(transparent)]
    Table(#[from] TableError),
    /// A file or directory cannot be written.
    #[error("{path}: {what}")]
    Write {
        /// The file or directory.
        path: String,
        /// What went wrong.
        what: String,
    },
    /// An episode cannot be exported for what is in it, although others can.
    #[error("{file}: {what}")]
    Unfit {
        /// The episode's file.
        file: String,
        /// What is wrong.
        what: String,
    },
    /// There is nothing to export.
    #[error("{0}")]
    Nothing(String),
}

impl ExportError {
    /// Whether it is about one episode alone, so that the others can be exported all the same.
    pub fn spares_others(&self) -> bool {
        matches!(self, Self::Episode(_) | Self::Unfit { .. })
    }
}

/// A file that an export leaves out.
#[derive(Debug)]
pub struct LeftOut {
    /// The file.
    pub file: PathBuf,
    /// Why, in one line that names it.
    pub why: String,
}

/// The error of the episode `file`, in which something does not fit.
pub fn unfit(file: &Path, what: impl std::fmt::Display) -> ExportError {
    ExportError::Unfit { file: file.display().to_string(), what: what.to_string() }
}

/// The error of writing `path`.
pub fn write_error(path: &Path, what: impl std::fmt::Display) -> ExportError {
    ExportError::Write { path: path.display().to_string(), what: what.to_string() }
}

/// The error of the disk in writing `path`: a full one is called so.
pub fn disk_error(path: &Path, e: &std::io::Error) -> ExportError {
    write_error(path, error_words(e))
}

/// Makes the directory in which `path` will lie.
pub fn make_parent(path: &Path) -> Result<(), ExportError> {
    let parent = path.parent().unwrap_or(path);
    fs::create_dir_all(parent).map_err(|e| disk_error(parent, &e))
}

/// Whether no name of `new`, files below `to`, is taken: by anything that lies there, or by another one of them. All that are taken are in the error.
pub fn all_free<'a>(to: &Path, new: impl Iterator<Item = &'a PathBuf>) -> Result<(), ExportError> {
    let mut once = BTreeSet::new();
    let taken: BTreeSet<&Path> =
        new.filter(|path| !once.insert(*path) || fs::symlink_metadata(path).is_ok()).map(PathBuf::as_path).collect();
    if taken.is_empty() {
        return Ok(());
    }
    let names: Vec<String> = taken.iter().map(|path| path.strip_prefix(to).unwrap_or(path).display().to_string()).collect();
    Err(write_error(to, format!("nothing is written, because these names are taken or come twice: {}", names.join(", "))))
}
