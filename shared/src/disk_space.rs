//! How much room a disk has, and what its errors are in words. Any ordinary thread may ask; it may wait for the disk, and allocates
//! texts. Nothing here fails: what is not known is `None`.

use std::path::Path;

/// The free space where `path` is or will be, bytes; `None` if it is not known.
pub fn free_bytes(path: &Path) -> Option<u64> {
    let (_, fs) = file_system(path)?;
    Some(fs.f_bavail.saturating_mul(fs.f_frsize))
}

/// The file system where `path` is or will be: a directory that is not made yet lies on that of the one above it.
pub fn file_system(path: &Path) -> Option<(&Path, rustix::fs::StatVfs)> {
    path.ancestors().find_map(|p| rustix::fs::statvfs(p).ok().map(|fs| (p, fs)))
}

/// An error of the disk in words: a full one is called so.
pub fn error_words(e: &std::io::Error) -> String {
    match e.kind() {
        std::io::ErrorKind::StorageFull => format!("the disk is full ({e}): delete what is not needed"),
        std::io::ErrorKind::QuotaExceeded => format!("the quota of this user is used up ({e}): delete what is not needed"),
        _ => e.to_string(),
    }
}
