//! Makes a whole file of one that was cut: its recorder was killed, the power failed, or a copy was broken off. It allocates and is for
//! ordinary threads only.
//!
//! What stands before the cut in whole chunks, with their checksums, is copied; the rest is left out, because nothing says whether it is right.
//! The old file stays as it is. A file that is damaged in another way is refused, as everywhere.

use std::fs::File;
use std::path::Path;

use mcap::records::Metadata;

use super::records::NextRecord;
use super::rewrite::{ChangeError, at_rest, copy};
use super::write::mcap_words;
use super::{Episode, EpisodeInfo, format};
use crate::disk_space::error_words;
use crate::whole_file;

/// How a recovered episode is said to have ended, if its own end is missing.
const REASON: &str = "its end is missing: it was recovered from a file that was cut";

/// Writes what is whole in `old` to the new file `new`, and returns it. The episode is complete only if nothing but the file's index was
/// cut off.
pub fn recover(old: &Path, new: &Path) -> Result<Episode, ChangeError> {
    // The old file stays, so one whose recorder was killed just now can be recovered at once.
    let (original, ..) = at_rest(old, File::try_lock_shared)?;
    let fail = |what: String| ChangeError::Write { file: new.display().to_string(), what };
    let (file, temporary) = whole_file::new_beside(new).map_err(|e| fail(error_words(&e)))?;
    let result = copy(old, (file, &temporary), None, |writer, end| {
        if !matches!(end, NextRecord::Cut) {
            return Err(ChangeError::Whole { file: old.display().to_string() });
        }
        if !original.info.ended.is_empty() {
            return Ok(());
        }
        let metadata = [("complete".to_string(), "false".to_string()), ("reason".to_string(), REASON.to_string())].into();
        writer.write_metadata(&Metadata { name: format::META_END.into(), metadata }).map_err(|e| fail(mcap_words(&e)))
    })
    .and_then(|()| {
        let after = Episode::read(&temporary)?;
        let ended = if original.info.ended.is_empty() { REASON.to_string() } else { original.info.ended.clone() };
        let info = EpisodeInfo { ended, recoverable: false, ..original.info.clone() };
        let expected = Episode { name: after.name.clone(), complete: after.complete, info, ..original.clone() };
        if format!("{after:?}") != format!("{expected:?}") {
            return Err(fail("the copy differs from the original".into()));
        }
        whole_file::give_name(&temporary, new).map_err(|e| fail(error_words(&e)))?;
        Ok(Episode { name: new.display().to_string(), ..after })
    });
    // It is our own file: we have made it.
    let _ = std::fs::remove_file(&temporary);
    result
}
