//! Reads MCAP episodes, see [`crate::episode`]. Allocates; ordinary threads only; never panics on a damaged file.

use std::path::{Path, PathBuf};

use super::Episode;

/// Why an episode's file cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum EpisodeError {
    /// The file or directory cannot be opened or read.
    #[error("{file}: {what}; give an episode (.mcap) or a directory of episodes")]
    Read {
        /// The file.
        file: String,
        /// The system's words.
        what: String,
    },
    /// An MCAP file, but not an episode of this program.
    #[error("{file}: not an episode: {what}")]
    NotAnEpisode {
        /// The file.
        file: String,
        /// What is missing.
        what: String,
    },
    /// A checksum, a record or a value in it is wrong.
    #[error("{file}: damaged: {what}; take it from a backup, or leave it out")]
    Damaged {
        /// The file.
        file: String,
        /// What is wrong.
        what: String,
    },
}

impl Episode {
    /// Reads an MCAP episode without its images.
    pub fn read(path: &Path) -> Result<Self, EpisodeError> {
        Err(EpisodeError::Read { file: path.display().to_string(), what: "reading is not built yet".into() })
    }
}

/// One recorded image.
#[derive(Debug, Clone, PartialEq)]
pub struct Image {
    /// The camera's frame number.
    pub sequence: u64,
    /// Middle of the exposure, CLOCK_MONOTONIC ns.
    pub captured_at_ns: u64,
    /// `jpeg` or `png`.
    pub format: String,
    /// The compressed image.
    pub data: Vec<u8>,
}

/// The images of one episode, read one by one.
pub struct Images {}

impl Images {
    /// Opens an episode for its images.
    pub fn open(path: &Path) -> Result<Self, EpisodeError> {
        Err(EpisodeError::Read { file: path.display().to_string(), what: "reading is not built yet".into() })
    }
}

impl Iterator for Images {
    type Item = Result<Image, EpisodeError>;

    fn next(&mut self) -> Option<Self::Item> {
        None
    }
}

/// The episode files named by `paths`: files as they are, directories as their `*.mcap` in order of name.
pub fn find(paths: &[PathBuf]) -> Result<Vec<PathBuf>, EpisodeError> {
    let mut files = Vec::new();
    for path in paths {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        let fail = |e: std::io::Error| EpisodeError::Read { file: path.display().to_string(), what: e.to_string() };
        let mut inside = Vec::new();
        for entry in std::fs::read_dir(path).map_err(fail)? {
            let file = entry.map_err(fail)?.path();
            if file.extension().is_some_and(|e| e == "mcap") && file.is_file() {
                inside.push(file);
            }
        }
        inside.sort();
        files.append(&mut inside);
    }
    Ok(files)
}
