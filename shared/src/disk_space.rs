//! How much room a disk has, and what its errors are in words. Any ordinary thread may ask; it may wait for the disk, and allocates
//! texts. Nothing here fails: what is not known is `None`.

use std::path::Path;

use rustix::fs::{StatVfs, statvfs};

/// With less free on the episodes' disk than this, bytes, none is begun; one that was begun may take of it. Chosen by hand: some episodes, hours of the
/// journal, and weights many times.
pub const LEAST_FREE: u64 = 64_000_000;
/// Number of files that must still fit before one is begun. Chosen by hand: some episodes, a part of the journal, and what is written beside a file
/// before it takes its place.
pub const LEAST_FILES: u64 = 16;

/// What a disk still takes. Many file systems are made for a number of files; when it is reached they take no more, however many bytes are free.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Room {
    /// Free space, bytes.
    pub bytes: u64,
    /// Number of files that may still be made; `u64::MAX` where the file system has no such bound.
    pub files: u64,
}

impl Room {
    /// What `fs` still takes for an ordinary user.
    pub fn of(fs: &StatVfs) -> Self {
        // Those that make room for files as they come, such as btrfs, show a number of 0 in all.
        let files = if fs.f_files == 0 { u64::MAX } else { fs.f_favail };
        Self { bytes: fs.f_bavail.saturating_mul(fs.f_frsize), files }
    }

    /// Whether so few files may still be made that none is begun.
    pub fn lacks_files(self) -> bool {
        self.files < LEAST_FILES
    }
}

/// The room where `path` is or will be; `None` if it is not known.
pub fn room(path: &Path) -> Option<Room> {
    room_at(path).map(|(_, room)| room)
}

/// The same with the part of `path` that is there: a directory that is not made yet lies on the disk of the one above it.
pub fn room_at(path: &Path) -> Option<(&Path, Room)> {
    let (there, fs) = path.ancestors().find_map(|p| statvfs(p).ok().map(|fs| (p, fs)))?;
    // One without a size, such as a tmpfs without a bound, does not say what it takes.
    (fs.f_blocks > 0).then(|| (there, Room::of(&fs)))
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

    /// Protects an episode from a disk on which no file can be made although gigabytes are free, and every cell on a file system that counts no files, such as
    /// btrfs: there 0 files of 0 are not "none left".
    #[test]
    fn files_are_counted_where_they_are_bounded() {
        let shown = statvfs("/").unwrap();
        let of = |f_files, f_favail| Room::of(&StatVfs { f_bavail: 1 << 20, f_frsize: 4096, f_files, f_favail, ..shown });
        assert_eq!(of(1000, 0), Room { bytes: 4 << 30, files: 0 });
        assert!(of(1000, 0).lacks_files() && of(1000, LEAST_FILES - 1).lacks_files() && !of(1000, LEAST_FILES).lacks_files());
        assert_eq!(of(0, 0), Room { bytes: 4 << 30, files: u64::MAX });
        assert!(!of(0, 0).lacks_files());
    }

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
