//! `--json [FILE]` of the commands that measure: without a file JSON takes the tables' place on standard output, with one it is written beside them.
//!
//! Called by commands, before and after their work; allocates. A file that cannot be written is one line, and is known before the work.

use std::path::{Path, PathBuf};

use serde_json::Value;
use shared::disk_space::error_words;
use shared::exit::{self, Failure, OrExit as _};
use shared::whole_file;

/// How such a file begins (RFC 8259): only one that begins so is replaced.
const JSON: &[u8] = b"{";

/// Where the JSON goes.
#[derive(Debug)]
pub enum JsonOut {
    /// Nobody wants it.
    Nowhere,
    /// In place of the tables.
    Stdout,
    /// Beside them.
    File(PathBuf),
}

impl JsonOut {
    /// From the argument: `None` if it was not given, `-` if it was given without a file. A file is made if it is not there, and keeps what is in it
    /// until there is something new.
    pub fn open(json: Option<&Path>) -> Result<Self, Failure> {
        match json {
            None => Ok(Self::Nowhere),
            Some(path) if path == Path::new("-") => Ok(Self::Stdout),
            Some(path) => {
                let opened = whole_file::check(path, JSON).and_then(|()| std::fs::File::options().append(true).create(true).open(path));
                opened.map(|_| Self::File(path.into())).map_err(|e| words(path, &e)).or_exit(exit::FAILED)
            }
        }
    }

    /// Whether tables are printed.
    pub fn tables(&self) -> bool {
        !matches!(self, Self::Stdout)
    }

    /// Whether JSON is wanted at all.
    pub fn wanted(&self) -> bool {
        !matches!(self, Self::Nowhere)
    }

    /// Writes it, in one line.
    pub fn write(&self, value: &Value) -> Result<(), Failure> {
        match self {
            Self::Nowhere => Ok(()),
            Self::Stdout => {
                println!("{value}");
                Ok(())
            }
            Self::File(path) => {
                whole_file::replace(path, value.to_string().as_bytes(), JSON).map_err(|e| words(path, &e)).or_exit(exit::FAILED)
            }
        }
    }
}

fn words(path: &Path, e: &std::io::Error) -> String {
    format!("{}: cannot be written: {}; or give another file", path.display(), error_words(e))
}
