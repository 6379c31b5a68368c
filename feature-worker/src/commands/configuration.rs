//! Changes one table of a configuration's file.
//!
//! Runs on the calling thread and allocates. A configuration that would be refused is not written; every failure names the file.

use std::path::Path;

use shared::config::{Config, FILE_MAX};
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::{regular_file, whole_file};

/// Puts what `change` makes of the file's text, in its `table`, into the file in one step, if that is a configuration which `check` takes.
/// `change` gives none if the file has no such table.
pub fn change(
    path: &Path,
    table: &str,
    change: impl Fn(&str) -> Option<String>,
    check: impl Fn(&Config) -> Result<(), String>,
) -> Result<(), Failure> {
    let fail = |e: String| failure(exit::FAILED, format!("{}: {e}", path.display()));
    // If the path is a link, the file that it leads to is replaced, and not the link.
    let file = path.canonicalize().map_err(|e| fail(e.to_string()))?;
    let before = regular_file::read_text(&file, FILE_MAX).map_err(|e| fail(e.to_string()))?;
    let after = change(&before).ok_or_else(|| fail(format!("has no line [{table}] of its own; write the table there")))?;
    let checked = Config::parse(&after, &path.display().to_string()).or_exit(exit::FAILED)?;
    check(&checked).map_err(fail)?;
    whole_file::replace(&file, after.as_bytes(), b"").map_err(|e| fail(e.to_string()))
}

/// Whether [`change`] may put a file at `path`, so that it is known before long work.
pub fn may_change(path: &Path) -> Result<(), Failure> {
    let may = path.canonicalize().and_then(|file| whole_file::check(&file, b""));
    may.map_err(|e| format!("{}: {e}", path.display())).or_exit(exit::BAD_INPUT)
}
