//! How much room a disk has. Any ordinary thread may ask; it may wait for the disk. Nothing here fails: what is not known is `None`.

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
