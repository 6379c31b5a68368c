//! The CSV pair: `features.csv` (`episode, frame, t_s, alpha_deg, area_px2`) and `scale.csv` (`episode, weight_g`).
//! Allocates; ordinary threads only.

use std::path::Path;

use super::Episode;

/// Why a pair of tables is refused or cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// The file cannot be opened, read or written.
    #[error("{file}: {what}")]
    File {
        /// The file.
        file: String,
        /// The system's words.
        what: String,
    },
    /// A row or the heading is wrong.
    #[error("{file}:{line}: {what}")]
    Row {
        /// The file.
        file: String,
        /// Line in it; the heading is 1.
        line: u64,
        /// What is wrong and what is wanted.
        what: String,
    },
}

/// Reads the pair; episodes in the order of their first row in `features`. All of them have a weight.
pub fn read_table(features: &Path, _scale: &Path) -> Result<Vec<Episode>, TableError> {
    Err(TableError::File { file: features.display().to_string(), what: "reading is not built yet".into() })
}

/// Writes the pair; the alpha in it is the commanded one. Neither file may exist.
pub fn write_table(_episodes: &[Episode], features: &Path, _scale: &Path) -> Result<(), TableError> {
    Err(TableError::File { file: features.display().to_string(), what: "writing is not built yet".into() })
}
