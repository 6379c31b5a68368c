//! Adds the weight `w_E`, or what a person wrote, to an episode afterwards. It allocates and is for ordinary threads only.
//!
//! The file is replaced in one step, see `rewrite`: whenever the machine stops, there is one whole file, with or without the
//! weight.

use std::path::Path;

use super::rewrite::{ChangeError, set_metadata};
use super::weight::check_reading;
use super::{Episode, EpisodeInfo, format};

/// Longest note, bytes. Chosen by hand: a page of text.
const NOTE_BYTES: usize = 4096;

/// Sets the weight of the episode `path` to `grams`, and returns the weight that it had before.
pub fn set_weight(path: &Path, grams: f64) -> Result<Option<f64>, ChangeError> {
    let grams = check_reading(grams).map_err(|e| ChangeError::Weight(grams, e))?;
    let expected = |before| Episode { weight_g: Some(grams), ..before };
    match set_metadata(path, format::META_WEIGHT, ("grams", grams.to_string()), expected) {
        Ok(before) => Ok(before.weight_g),
        // Where the episode itself is whole, the file's end is made anew first.
        Err(ChangeError::Cut { file }) if !Episode::read(path).is_ok_and(|e| e.info.recoverable) => Err(ChangeError::Incomplete { file }),
        Err(e) => Err(e),
    }
}

/// Sets the note of the episode `path` to `text`, and returns the note that it had before. An empty text takes the note away.
pub fn set_note(path: &Path, text: &str) -> Result<String, ChangeError> {
    if text.len() > NOTE_BYTES {
        return Err(ChangeError::Note(text.len(), NOTE_BYTES));
    }
    let expected = |before: Episode| Episode { info: EpisodeInfo { note: text.into(), ..before.info.clone() }, ..before };
    Ok(set_metadata(path, format::META_NOTE, ("text", text.into()), expected)?.info.note)
}
