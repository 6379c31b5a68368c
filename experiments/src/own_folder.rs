//! A folder of results that an experiment may write to: an empty or new one, or one that an experiment made.
//!
//! Ordinary process; allocates. What it did not make is never deleted; a folder of somebody else is refused with one line.

use std::path::{Path, PathBuf};

/// Why a folder cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum FolderError {
    /// It holds something and was not made by an experiment.
    #[error("{0}: this folder is not empty and was not made by an experiment: name an empty or a new one with --out")]
    NotOurs(PathBuf),
    /// It cannot be read or written.
    #[error("{path}: {error}")]
    File {
        /// The file or folder.
        path: PathBuf,
        /// What the system says.
        error: std::io::Error,
    },
}

/// The file that says that an experiment made the folder.
const MARKER: &str = ".decant-experiment";
/// What the marker says to whoever finds it.
const MARKER_TEXT: &str = "An experiment of Decant made this folder. The next run with the same --out replaces its results.\n";

/// Makes `out` if it is not there, and marks it. Of a folder that an experiment made, `results` are removed.
///
/// # Errors
/// When the folder holds something and was not made by an experiment, or cannot be written.
pub fn claim(out: &Path, results: &[&str]) -> Result<(), FolderError> {
    let file = |path: &Path, error| FolderError::File { path: path.into(), error };
    std::fs::create_dir_all(out).map_err(|e| file(out, e))?;
    let marker = out.join(MARKER);
    let empty = std::fs::read_dir(out).map_err(|e| file(out, e))?.next().is_none();
    if !empty && !marker.is_file() {
        return Err(FolderError::NotOurs(out.into()));
    }
    std::fs::write(&marker, MARKER_TEXT).map_err(|e| file(&marker, e))?;
    for result in results {
        let old = out.join(result);
        let removed = if old.is_dir() { std::fs::remove_dir_all(&old) } else { std::fs::remove_file(&old) };
        match removed {
            Err(e) if e.kind() != std::io::ErrorKind::NotFound => return Err(file(&old, e)),
            _ => {}
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use shared::exit::{self, Failure};

    use super::*;
    use crate::own_cell::OwnCellError;

    /// Protects people's files: a folder that holds something else is refused and stays as it is, also with the names of results in it.
    #[test]
    fn a_folder_of_somebody_else_is_refused() {
        let folder = std::env::temp_dir().join(format!("decant-own-folder-{}", std::process::id()));
        let out = folder.join("mine");
        std::fs::create_dir_all(out.join("episodes")).unwrap();
        std::fs::write(out.join("weights.bin"), "precious").unwrap();
        let results = ["episodes", "weights.bin"];
        assert!(matches!(claim(&out, &results), Err(FolderError::NotOurs(_))));
        assert!(out.join("episodes").is_dir() && std::fs::read_to_string(out.join("weights.bin")).unwrap() == "precious");

        let own = folder.join("new");
        claim(&own, &results).unwrap();
        std::fs::create_dir_all(own.join("episodes")).unwrap();
        std::fs::write(own.join("notes.txt"), "kept").unwrap();
        claim(&own, &results).unwrap();
        assert!(!own.join("episodes").exists(), "results of the run before are replaced");
        assert!(own.join("notes.txt").is_file(), "what no experiment made stays");
        std::fs::remove_dir_all(&folder).unwrap();
    }

    /// Protects scripts: a folder that cannot be written is no bad command line, and a folder of somebody else is one.
    #[test]
    fn a_disk_that_fails_is_told_apart() {
        let code = |error| Failure::from(OwnCellError::from(error)).code;
        let file = std::env::temp_dir().join(format!("decant-own-folder-file-{}", std::process::id()));
        std::fs::write(&file, "no folder").unwrap();
        let error = claim(&file.join("inside"), &[]).unwrap_err();
        assert!(matches!(error, FolderError::File { .. }), "{error}");
        assert_eq!(code(error), exit::FAILED);
        assert_eq!(code(FolderError::NotOurs(file.clone())), exit::BAD_INPUT);
        std::fs::remove_file(&file).unwrap();
    }
}
