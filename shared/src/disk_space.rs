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

/// An error of the disk in words: a full one is called so. One that has words of its own, such as these, stays as it is.
pub fn error_words(e: &std::io::Error) -> String {
    let said = e.to_string();
    match e.kind() {
        _ if e.get_ref().is_some() => said,
        std::io::ErrorKind::StorageFull => format!("the disk is full ({said}): delete what is not needed"),
        std::io::ErrorKind::QuotaExceeded => format!("the quota of this user is used up ({said}): delete what is not needed"),
        _ => said,
    }
}

#[cfg(test)]
mod tests {
    use std::io::{Error, ErrorKind};

    use super::*;

    /// Protects the one line of a full disk, which passes several hands on its way to a person: it is said once.
    #[test]
    fn a_full_disk_is_said_once() {
        for (kind, words) in [(ErrorKind::StorageFull, "the disk is full"), (ErrorKind::QuotaExceeded, "the quota of this user")] {
            let once = error_words(&Error::from(kind));
            assert!(once.starts_with(words) && once.ends_with("delete what is not needed"), "{once}");
            assert_eq!(error_words(&Error::new(kind, once.clone())), once);
        }
        assert_eq!(error_words(&Error::new(ErrorKind::NotFound, "gone")), "gone");
    }
}
