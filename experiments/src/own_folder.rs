//! A folder of results that an experiment may write to: an empty or new one, or one that an experiment made.
//!
//! Ordinary process; allocates. Only what an experiment made, and nobody has changed since, is ever deleted; all else is moved aside. A folder of somebody
//! else is refused with one line.

use std::collections::{BTreeMap, HashSet};
use std::os::unix::fs::MetadataExt as _;
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
/// What the marker says to whoever finds it. Behind it is a line for each result: its size, when it was last changed, and its name.
const MARKER_TEXT: &str =
    "An experiment of Decant made this folder. The next run with the same --out replaces the results that are named here:\n";

/// Makes `out` if it is not there, and marks it. Of a folder that an experiment made, the `results` that it left are removed. What is among them and was made
/// or changed by somebody else, or by a run that was killed, is moved into a new folder of `out`, which is the answer.
///
/// # Errors
/// When the folder holds something and was not made by an experiment, or cannot be written.
pub fn claim(out: &Path, results: &[&str]) -> Result<Option<PathBuf>, FolderError> {
    let file = |path: &Path, error| FolderError::File { path: path.into(), error };
    std::fs::create_dir_all(out).map_err(|e| file(out, e))?;
    let marker = out.join(MARKER);
    let empty = std::fs::read_dir(out).map_err(|e| file(out, e))?.next().is_none();
    if !empty && !marker.is_file() {
        return Err(FolderError::NotOurs(out.into()));
    }
    let listed = if empty { String::new() } else { std::fs::read_to_string(&marker).map_err(|e| file(&marker, e))? };
    let listed: HashSet<&str> = listed.lines().collect();
    let aside = (1..).map(|n| out.join(format!("kept-{n}"))).find(|folder| !folder.exists()).unwrap_or_default();
    for path in results.iter().flat_map(|result| files_below(&out.join(result))) {
        let done = if listed.contains(line(out, &path).as_str()) {
            std::fs::remove_file(&path)
        } else {
            let kept = aside.join(path.strip_prefix(out).unwrap_or(&path));
            std::fs::create_dir_all(kept.parent().unwrap_or(&aside)).and_then(|()| std::fs::rename(&path, kept))
        };
        done.map_err(|e| file(&path, e))?;
    }
    results.iter().for_each(|result| remove_empty(&out.join(result)));
    std::fs::write(&marker, MARKER_TEXT).map_err(|e| file(&marker, e))?;
    Ok(aside.exists().then_some(aside))
}

/// The results that an experiment itself has made, as they were then.
#[derive(Debug, Default)]
pub struct Made(BTreeMap<PathBuf, String>);

impl Made {
    /// Adds the file `name` of `out`, which the experiment has just written, or written anew.
    pub fn add(&mut self, out: &Path, name: &Path) {
        self.0.insert(name.into(), line(out, &out.join(name)));
    }

    /// Writes them down, once the experiment has ended: the next one deletes these alone, as far as nobody has changed them.
    ///
    /// # Errors
    /// When the list cannot be written.
    pub fn remember(&self, out: &Path) -> Result<(), FolderError> {
        let lines = self.0.values().map(|line| format!("{line}\n"));
        let text = std::iter::once(MARKER_TEXT.to_string()).chain(lines).collect::<String>();
        let marker = out.join(MARKER);
        std::fs::write(&marker, text).map_err(|error| FolderError::File { path: marker, error })
    }
}

/// The line of a file in the list. A file that was written since has another one.
fn line(out: &Path, path: &Path) -> String {
    let (size, changed) = path.symlink_metadata().map_or((0, (0, 0)), |about| (about.len(), (about.mtime(), about.mtime_nsec())));
    format!("{size} {}.{:09} {}", changed.0, changed.1, path.strip_prefix(out).unwrap_or(path).display())
}

/// The file `path`, or all files below the directory `path`; links are files. What cannot be read is left where it is.
fn files_below(path: &Path) -> Vec<PathBuf> {
    match path.symlink_metadata() {
        Err(_) => Vec::new(),
        Ok(about) if !about.is_dir() => vec![path.into()],
        Ok(_) => std::fs::read_dir(path).into_iter().flatten().flatten().flat_map(|entry| files_below(&entry.path())).collect(),
    }
}

/// Removes the directory `path` with those in it, as far as nothing is in them.
fn remove_empty(path: &Path) {
    if path.symlink_metadata().is_ok_and(|about| about.is_dir()) {
        std::fs::read_dir(path).into_iter().flatten().flatten().for_each(|entry| remove_empty(&entry.path()));
        let _ = std::fs::remove_dir(path);
    }
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
        assert_eq!(claim(&own, &results).unwrap(), None);
        std::fs::create_dir_all(own.join("episodes")).unwrap();
        let mut made = Made::default();
        for name in ["episodes/1.mcap", "weights.bin"] {
            std::fs::write(own.join(name), "a result").unwrap();
            made.add(&own, Path::new(name));
        }
        made.remember(&own).unwrap();
        std::fs::write(own.join("notes.txt"), "kept").unwrap();
        assert_eq!(claim(&own, &results).unwrap(), None);
        assert!(!own.join("episodes").exists() && !own.join("weights.bin").exists(), "results of the run before are replaced");
        assert!(own.join("notes.txt").is_file(), "what has no result's name stays");
        std::fs::remove_dir_all(&folder).unwrap();
    }

    /// Protects what a person has put among a demo's results, or has changed there, while it ran or afterwards, and what a run left that was killed: it is
    /// moved aside and not deleted.
    #[test]
    fn what_no_experiment_left_is_moved_aside() {
        let out = std::env::temp_dir().join(format!("decant-own-folder-kept-{}", std::process::id()));
        let results = ["episodes", "weights.bin"];
        claim(&out, &results).unwrap();
        let write = |name: &str, text: &str| std::fs::write(out.join(name), text).unwrap();
        std::fs::create_dir_all(out.join("episodes/lab")).unwrap();
        let mut made = Made::default();
        for name in ["episodes/1.mcap", "episodes/2.mcap", "weights.bin"] {
            write(name, "result");
            made.add(&out, Path::new(name));
        }
        write("episodes/while-it-ran.mcap", "precious");
        write("weights.bin", "of a person, while it ran");
        made.remember(&out).unwrap();
        write("episodes/lab/own.mcap", "precious");
        write("episodes/2.mcap", "result with a note");
        let aside = claim(&out, &results).unwrap().unwrap();
        let read = |name: &str| std::fs::read_to_string(aside.join(name)).ok();
        assert_eq!(read("episodes/lab/own.mcap").as_deref(), Some("precious"));
        assert_eq!(read("episodes/while-it-ran.mcap").as_deref(), Some("precious"));
        assert_eq!(read("episodes/2.mcap").as_deref(), Some("result with a note"));
        assert_eq!(read("weights.bin").as_deref(), Some("of a person, while it ran"));
        assert_eq!((read("episodes/1.mcap"), out.join("episodes").exists()), (None, false));
        write("weights.bin", "of a run that was killed");
        let later = claim(&out, &results).unwrap().unwrap();
        assert!(later != aside && later.join("weights.bin").is_file());
        std::fs::remove_dir_all(&out).unwrap();
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
