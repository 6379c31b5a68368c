//! Where journals lie: the one being written, and beside it those of the runs before. What may be moved or deleted there, and what is left as it is.
//!
//! Ordinary threads use it; it allocates and waits for the disk. What is in the way is an error of the kind `InvalidInput`, and everything then
//! stays as it is; others are those of the system.

use std::fs::{File, OpenOptions, TryLockError};
use std::io::{Error, ErrorKind, Read as _, Result, Seek as _, SeekFrom};
use std::os::unix::fs::OpenOptionsExt as _;
use std::path::{Path, PathBuf};

use shared::regular_file;

/// The first bytes of a journal, which include its version.
pub const MAGIC: &[u8; 8] = b"decantj9";
/// Size of all journals that are kept beside the one being written, bytes. Chosen by hand: about three days of ticks.
const KEPT_BYTES: u64 = 1 << 30;
/// Number of journals that are kept beside the one being written. Chosen by hand: so many starts do not lose a crash.
const KEPT: u32 = 20;
/// The first byte of an entry that is a tick: postcard numbers the kinds of entries in their order.
const TICK: u8 = 2;

/// Moves the journals at `path` and beside it one place on, deletes what is beyond the budget, and makes the new file, locked.
pub(crate) fn make_room(path: &Path) -> Result<File> {
    if let Some(parent) = path.parent() {
        std::fs::create_dir_all(parent)?;
    }
    let mut held = if path.symlink_metadata().is_ok() { Some(check_is_journal(path, File::try_lock)?) } else { None };
    if let Some(empty) = held.take_if(|file| !has_ticks(file)) {
        // Nothing happened in it, as in one that could not be written for want of space: it takes no other's place.
        std::fs::remove_file(path)?;
        drop(empty);
    }
    if let Some(held) = held {
        let there = beside(path);
        let length = |old: &PathBuf| Ok(check_is_journal(old, File::try_lock)?.metadata()?.len());
        let lengths = there.iter().map(length).collect::<Result<Vec<u64>>>()?;
        // The newest come first; the one that has just ended counts too.
        let mut sum = held.metadata()?.len();
        let fits = lengths.iter().take_while(|len| {
            sum += **len;
            sum <= KEPT_BYTES
        });
        let kept = fits.count().min(KEPT as usize - 1);
        for old in &there[kept..] {
            std::fs::remove_file(old)?;
        }
        for n in (0..kept).rev() {
            std::fs::rename(&there[n], before(path, n as u32 + 2))?;
        }
        // The journal of the run before is wanted most after that run has crashed.
        std::fs::rename(path, before(path, 1))?;
        drop(held);
    }
    // Who may read it could hold its lock, and keep the next controller from starting.
    let file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)?;
    // Whoever looks meets the lock; a file system without locks has none to give.
    let _ = file.try_lock();
    Ok(file)
}

/// Where the `n`th journal before the one at `path` is kept, from 1.
pub fn before(path: &Path, n: u32) -> PathBuf {
    path.with_extension(if n == 1 { "before.bin".into() } else { format!("before-{n}.bin") })
}

/// The journals before the one at `path` that are there, the newest first.
fn beside(path: &Path) -> Vec<PathBuf> {
    (1..=KEPT).map(|n| before(path, n)).take_while(|p| p.symlink_metadata().is_ok()).collect()
}

/// Checks what the controller would meet at `path` and beside it when it starts: journals only, and `free` ones, which nobody writes. Nothing is changed;
/// for `free` locks are shared for a moment, so ask for that only while no controller of the cell runs.
pub fn check(path: &Path, free: bool) -> Result<()> {
    for journal in [path.into()].into_iter().filter(|p: &PathBuf| p.symlink_metadata().is_ok()).chain(beside(path)) {
        if free {
            check_is_journal(&journal, File::try_lock_shared)?
        } else {
            check_place(&journal)?
        };
    }
    Ok(())
}

/// Checks that the file at `path` is a journal of any version, or empty, so that a new one may take its place. Gives it.
fn check_place(path: &Path) -> Result<File> {
    let (mut file, meta) = regular_file::open(path).map_err(|e| taken(path, &e.to_string()))?;
    let mut magic = [0; MAGIC.len()];
    let whole = file.read_exact(&mut magic).is_ok();
    // A full disk may have cut the first bytes.
    let there = if whole { MAGIC.len() - 1 } else { usize::try_from(meta.len()).unwrap_or(MAGIC.len()).min(MAGIC.len() - 1) };
    if magic[..there] != MAGIC[..there] {
        return Err(taken(path, "is no journal and is left as it is: choose another controller.journal"));
    }
    Ok(file)
}

/// The error of a `path` at which no journal can be begun.
fn taken(path: &Path, what: &str) -> Error {
    Error::new(ErrorKind::InvalidInput, format!("{} {what}", path.display()))
}

/// The same, and that nobody writes it, so that `lock` can be had. Gives it, locked.
fn check_is_journal(path: &Path, lock: fn(&File) -> std::result::Result<(), TryLockError>) -> Result<File> {
    let file = check_place(path)?;
    if let Err(TryLockError::WouldBlock) = lock(&file) {
        return Err(taken(path, "is being written by another controller: choose another controller.journal"));
    }
    Ok(file)
}

/// Whether a journal has a tick. One of another version, or one that cannot be read, counts as if it had.
fn has_ticks(file: &mut File) -> bool {
    let mut look = || -> Result<bool> {
        let mut start = [0; MAGIC.len()];
        file.rewind()?;
        match file.read_exact(&mut start) {
            Ok(()) if &start == MAGIC => {}
            Ok(()) => return Ok(true),
            // Not even its first bytes were written.
            Err(_) => return Ok(false),
        }
        let mut head = [0; 5];
        // Each entry has its length, and begins with its kind; settings and some weights come before the first tick.
        while file.read_exact(&mut head).is_ok() {
            if head[4] == TICK {
                return Ok(true);
            }
            let length = u32::from_le_bytes([head[0], head[1], head[2], head[3]]);
            file.seek(SeekFrom::Current(i64::from(length) - 1))?;
        }
        Ok(false)
    };
    look().unwrap_or(true)
}
