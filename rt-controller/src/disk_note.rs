//! What the disk's thread has to say to operators: the journal's state, free space, and the weight file. Ordinary threads share it; it
//! allocates and never fails.

use std::os::unix::fs::MetadataExt as _;
use std::path::Path;
use std::sync::{Mutex, PoisonError};
use std::time::SystemTime;

use shared::disk_space::room_at;
use shared::plural::counted;

/// The newest state of what lies on disks.
#[derive(Debug, Default, Clone)]
pub struct DiskState {
    /// Why the newest weight file is not used, one line; empty if it is used.
    pub refused: String,
    /// When the weight file that was read last was written.
    pub weights_written: Option<SystemTime>,
    /// The journal, one line: its file and size, or why nothing is written.
    pub journal: String,
    /// Number of ticks that the journal misses because the disk did not keep up.
    pub lost: u64,
    /// Free space where journal and episodes lie, one line.
    pub space: String,
}

impl DiskState {
    /// The journal with what it misses, one line.
    pub fn journal_words(&self) -> String {
        let missing = if self.lost > 0 { format!("{} missing", counted(self.lost, "tick")) } else { String::new() };
        [self.journal.clone(), missing].into_iter().filter(|part| !part.is_empty()).collect::<Vec<_>>().join(", ")
    }
}

/// [`DiskState`], shared.
#[derive(Debug, Default)]
pub struct DiskNote(Mutex<DiskState>);

impl DiskNote {
    /// The newest state.
    pub fn get(&self) -> DiskState {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Changes the state.
    pub fn set(&self, change: impl FnOnce(&mut DiskState)) {
        change(&mut self.0.lock().unwrap_or_else(PoisonError::into_inner));
    }
}

/// The free space of the file systems of `paths`, in words; each file system once.
pub fn space_words(paths: &[&Path]) -> String {
    let mut seen = Vec::new();
    let mut words = Vec::new();
    for path in paths {
        let Some((there, room)) = room_at(path) else { continue };
        let Ok(device) = there.metadata().map(|meta| meta.dev()) else { continue };
        if !seen.contains(&device) {
            seen.push(device);
            let but = if room.lacks_files() { ", but no room for more files," } else { "" };
            words.push(format!("{:.1} GB free{but} in {}", room.bytes as f64 / 1e9, there.display()));
        }
    }
    words.join(", ")
}
