//! Reading files that somebody else may have put there: regular files only, no more bytes than expected, and of owners that are trusted.
//!
//! A pipe or a device would hold its reader, and a file of gigabytes would fill its memory. Ordinary threads use it; it allocates up to the
//! bound. Errors are those of the system, or say what is wrong with the file.

use std::fs::{File, Metadata, OpenOptions};
use std::io::{Error, ErrorKind, Read, Result};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::Path;

/// Reads the file at `path`, which has at most `bytes_max` bytes.
pub fn read(path: &Path, bytes_max: u64) -> Result<Vec<u8>> {
    let (file, meta) = open_at_most(path, bytes_max)?;
    read_open(file, &meta, bytes_max)
}

/// The same, if [`check_owner`] has nothing against the file. It is opened once, so that what is read is what was checked, whatever is put at
/// `path` meanwhile.
pub fn read_of_owner(path: &Path, bytes_max: u64, trusted: Option<u32>) -> Result<Vec<u8>> {
    let (file, meta) = open_at_most(path, bytes_max)?;
    check_owner(&meta, trusted).map_err(Error::other)?;
    read_open(file, &meta, bytes_max)
}

fn read_open(file: File, meta: &Metadata, bytes_max: u64) -> Result<Vec<u8>> {
    let mut bytes = Vec::with_capacity(meta.len() as usize);
    file.take(bytes_max + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > bytes_max {
        return Err(Error::other(format!("it grew over {bytes_max} bytes while it was read")));
    }
    Ok(bytes)
}

/// Reads the text in the file at `path`, which has at most `bytes_max` bytes.
pub fn read_text(path: &Path, bytes_max: u64) -> Result<String> {
    String::from_utf8(read(path, bytes_max)?).map_err(|_| Error::other("is no text in UTF-8"))
}

/// Opens a regular file of at most `bytes_max` bytes for reading.
pub fn open_at_most(path: &Path, bytes_max: u64) -> Result<(File, Metadata)> {
    let (file, meta) = open(path)?;
    if meta.len() > bytes_max {
        return Err(Error::other(format!("{} bytes are too many: at most {bytes_max} belong into such a file", meta.len())));
    }
    Ok((file, meta))
}

/// Opens a regular file for reading, without waiting for anything else that may be at `path`.
pub fn open(path: &Path) -> Result<(File, Metadata)> {
    let file = OpenOptions::new().read(true).custom_flags(rustix::fs::OFlags::NONBLOCK.bits() as i32).open(path)?;
    let meta = file.metadata()?;
    if meta.is_file() { Ok((file, meta)) } else { Err(Error::other("is not a regular file")) }
}

/// What is said of a file for which [`is_at`] no longer holds. Chosen by hand: from here nobody can tell which of the two it was.
pub const ASTRAY: &str = "was deleted or moved while it was written";

/// Whether `path` still leads to the open `file`: whoever deletes or moves a file does not end what writes it, and nobody finds what is written then. A
/// disk that does not say it is believed to have it.
pub fn is_at(file: &File, path: &Path) -> bool {
    let identity = |meta: Metadata| (meta.dev(), meta.ino());
    match (file.metadata().map(identity), path.symlink_metadata().map(identity)) {
        (Ok(ours), Ok(there)) => ours == there,
        (_, Err(e)) => !matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory),
        (Err(_), _) => true,
    }
}

/// Checks that nobody but this user, root and `trusted` (a user number) may have written the file that `meta` describes.
pub fn check_owner(meta: &Metadata, trusted: Option<u32>) -> std::result::Result<(), String> {
    if ![Some(0), Some(rustix::process::geteuid().as_raw()), trusted].contains(&Some(meta.uid())) {
        return Err(format!("belongs to user {}: only files of this user, of root and of the configuration's owner are read", meta.uid()));
    }
    if meta.mode() & 0o002 != 0 {
        return Err(format!("everybody may write it (mode {:o}): chmod o-w", meta.mode() & 0o7777));
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt;

    use super::*;

    /// Protects who looks for what was recorded: a file that was deleted, moved, or exchanged while it is open is known as such.
    #[test]
    fn a_file_that_is_no_longer_at_its_path_is_noticed() {
        let dir = tempfile::tempdir().expect("a directory");
        let (path, other) = (dir.path().join("in/file"), dir.path().join("other"));
        std::fs::create_dir(dir.path().join("in")).expect("ours");
        std::fs::write(&path, "1").expect("writable");
        let (file, _) = open(&path).expect("there");
        assert!(is_at(&file, &path));
        std::fs::rename(&path, &other).expect("ours");
        assert!(!is_at(&file, &path) && is_at(&file, &other));
        std::fs::write(&path, "2").expect("writable");
        assert!(!is_at(&file, &path), "another one");
        std::fs::remove_dir_all(dir.path().join("in")).expect("ours");
        assert!(!is_at(&file, &path), "not even its directory is there");
    }

    /// Protects the controller's memory and its end: a huge file, a pipe and a directory are refused at once; so are files of strangers.
    #[test]
    fn only_small_regular_files_of_trusted_owners_are_read() {
        let dir = tempfile::tempdir().expect("a directory");
        let file = dir.path().join("w");
        std::fs::write(&file, b"12345").expect("writable");
        assert_eq!(read(&file, 5).expect("fits"), b"12345");
        assert!(read(&file, 4).expect_err("too long").to_string().contains("too many"));
        File::options().write(true).open(&file).and_then(|f| f.set_len(3 << 30)).expect("sparse");
        assert!(read(&file, 1 << 20).is_err());
        assert!(read(dir.path(), 5).is_err());
        let pipe = dir.path().join("pipe");
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().expect("coreutils").success());
        assert!(read(&pipe, 5).expect_err("a pipe").to_string().contains("regular"));
        assert!(read(Path::new("/dev/zero"), 5).is_err());

        let meta = || file.metadata().expect("there");
        assert_eq!(check_owner(&meta(), None), Ok(()));
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o666)).expect("ours");
        assert!(check_owner(&meta(), None).expect_err("open").contains("everybody"));
        std::fs::set_permissions(&file, std::fs::Permissions::from_mode(0o644)).expect("ours");
        if rustix::process::geteuid().is_root() {
            std::os::unix::fs::chown(&file, Some(65534), None).expect("root may");
            assert!(check_owner(&meta(), None).expect_err("a stranger's").contains("65534"));
            assert_eq!(check_owner(&meta(), Some(65534)), Ok(()));
        }
    }
}
