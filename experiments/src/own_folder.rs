//! A folder of results that an experiment may write to: an empty or new one, or one that an experiment made.
//!
//! Ordinary process; allocates. What it did not make is never deleted; a folder of somebody else is refused with one line.

use std::path::Path;

use crate::own_cell::OwnCellError;

/// The file that says that an experiment made the folder.
const MARKER: &str = ".decant-experiment";
/// What the marker says to whoever finds it.
const MARKER_TEXT: &str = "An experiment of Decant made this folder. The next run with the same --out replaces its results.\n";

/// Makes `out` if it is not there, and marks it. Of a folder that an experiment made, `results` are removed.
///
/// # Errors
/// When the folder holds something and was not made by an experiment, or cannot be written.
pub fn claim(out: &Path, results: &[&str]) -> Result<(), OwnCellError> {
    let file = |what: &Path, error| OwnCellError::File { what: what.display().to_string(), error };
    std::fs::create_dir_all(out).map_err(|e| file(out, e))?;
    let marker = out.join(MARKER);
    let empty = std::fs::read_dir(out).map_err(|e| file(out, e))?.next().is_none();
    if !empty && !marker.is_file() {
        return Err(OwnCellError::Config(format!(
            "{}: this folder is not empty and was not made by an experiment: name an empty or a new one with --out",
            out.display()
        )));
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
