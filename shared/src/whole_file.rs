//! Writing files in one step: whoever looks sees the old file or the new one, whole, and a disk that is full leaves the old one and nothing else.
//!
//! Only files are replaced that are of the kind that is written: a slip of the finger in `--out` costs no episode, no configuration and no device.
//! Ordinary threads use it; it allocates and waits for the disk. Errors are those of the system, or say what is in the way.

use std::ffi::OsStr;
use std::fs::{File, Metadata, OpenOptions, Permissions};
use std::io::{Error, ErrorKind, Read as _, Result, Write as _};
use std::os::unix::fs::{MetadataExt as _, OpenOptionsExt as _, PermissionsExt as _, fchown};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};
use std::time::Duration;

use crate::disk_space::error_words;
use crate::regular_file;

/// Mode of a new file before the user's umask takes of it. Source: POSIX, what `creat` of the standard tools gives.
const USUAL_MODE: u32 = 0o666;
/// How a temporary name begins and ends; the numbers of the process and of the file stand between, with a hyphen.
const TEMPORARY: (&str, &str) = (".decant-", ".new");
/// Nothing was written into a temporary file for so long where its process has been killed. Chosen by hand: no file is written for as long.
const LEFT_AFTER: Duration = Duration::from_secs(24 * 3600);

/// Puts `bytes` into the file at `path`, which keeps its mode and owner if it is there. `begins` is how every file of this kind begins: a file
/// that begins otherwise is left as it is. If `path` is a link, the new file takes the link's place.
pub fn replace(path: &Path, bytes: &[u8], begins: &[u8]) -> Result<()> {
    put_in_place(path, bytes, begins, File::sync_all)?;
    sync_directory(path);
    Ok(())
}

/// As [`replace`], without a wait for the disk: for what is made again in no time, such as hundreds of pictures. After a power failure the file may be
/// empty.
pub fn replace_soon(path: &Path, bytes: &[u8], begins: &[u8]) -> Result<()> {
    put_in_place(path, bytes, begins, |_| Ok(()))
}

fn put_in_place(path: &Path, bytes: &[u8], begins: &[u8], sync: fn(&File) -> Result<()>) -> Result<()> {
    check(path, begins)?;
    let before = path.metadata().ok();
    let mode = before.as_ref().map(|before| before.mode() & 0o777);
    let (mut file, new) = open_beside(path, mode.unwrap_or(USUAL_MODE)).map_err(|e| in_words(&e))?;
    let mut put = || {
        if let (Some(before), Some(mode)) = (&before, mode) {
            give_owner(&file, before);
            file.set_permissions(Permissions::from_mode(mode))?;
        }
        file.write_all(bytes)?;
        sync(&file)?;
        std::fs::rename(&new, path)
    };
    put().map_err(|e| gone(&new, &e))
}

/// Gives `file` the owner and the group of another. Only root may give a file away; for everybody else it is their own file, in the other's group if they
/// are in it.
pub fn give_owner(file: &File, of: &Metadata) {
    let _ = fchown(file, Some(of.uid()), Some(of.gid())).or_else(|_| fchown(file, None, Some(of.gid())));
}

/// Puts `bytes` into the new file `path`. It is an error if something is there.
pub fn create(path: &Path, bytes: &[u8]) -> Result<()> {
    create_of_mode(path, bytes, USUAL_MODE)
}

/// As [`create`], in a file that nobody but this user may read, also while it is made.
pub fn create_secret(path: &Path, bytes: &[u8]) -> Result<()> {
    create_of_mode(path, bytes, 0o600)
}

fn create_of_mode(path: &Path, bytes: &[u8], mode: u32) -> Result<()> {
    let (mut file, new) = open_beside(path, mode).map_err(|e| in_words(&e))?;
    let mut put = || {
        file.write_all(bytes)?;
        file.sync_all()?;
        give_name(&new, path)
    };
    put().map_err(|e| gone(&new, &e))
}

/// The error `e` in words, after what it left at `new` is taken away.
fn gone(new: &Path, e: &Error) -> Error {
    remove(new);
    in_words(e)
}

/// The error `e`, in which a full disk is called so.
fn in_words(e: &Error) -> Error {
    Error::new(e.kind(), error_words(e))
}

/// Whether [`replace`] may put a file at `path`, so that it is known before long work: files can be made in its directory, and what is there is a regular
/// file, and empty or of the kind that begins with `begins`.
pub fn check(path: &Path, begins: &[u8]) -> Result<()> {
    let directory = directory_of(path);
    may_make_in(directory).map_err(|e| Error::new(e.kind(), format!("no file can be made in {}: {e}", directory.display())))?;
    let file = match regular_file::open(path) {
        Ok((file, _)) => file,
        Err(e) if e.kind() == ErrorKind::NotFound => return Ok(()),
        Err(e) => return Err(e),
    };
    let mut start = Vec::new();
    file.take(begins.len() as u64).read_to_end(&mut start)?;
    // Of one that was cut there may be less than its beginning.
    let same = begins.get(..start.len()).is_some_and(|begins| start.eq_ignore_ascii_case(begins));
    if same {
        Ok(())
    } else {
        Err(Error::new(ErrorKind::AlreadyExists, "is a file of another kind and is left as it is: give another name"))
    }
}

/// Whether this process may make files in `directory`. A mode that permits it does not help where the file system is read-only.
pub fn may_make_in(directory: &Path) -> Result<()> {
    use rustix::fs::{Access, AtFlags, CWD, accessat};
    Ok(accessat(CWD, directory, Access::WRITE_OK | Access::EXEC_OK, AtFlags::EACCESS)?)
}

/// Gives the file `new` the name `path`, unless something has that name already.
pub fn give_name(new: &Path, path: &Path) -> Result<()> {
    use rustix::fs::{CWD, RenameFlags, renameat_with};
    match renameat_with(CWD, new, CWD, path, RenameFlags::NOREPLACE) {
        // Some file systems know only links for it, and some others no links.
        Err(rustix::io::Errno::INVAL | rustix::io::Errno::NOSYS) => {
            std::fs::hard_link(new, path)?;
            remove(new);
        }
        renamed => renamed?,
    }
    sync_directory(path);
    Ok(())
}

/// A new file in the directory of `path`, with its path: its name is one that no program takes for anything of its own, and that was free.
pub fn new_beside(path: &Path) -> Result<(File, PathBuf)> {
    open_beside(path, USUAL_MODE)
}

/// The same with a mode. Whoever may not read the file at the end could else open it before, and read what is written.
fn open_beside(path: &Path, mode: u32) -> Result<(File, PathBuf)> {
    static NEXT: AtomicU32 = AtomicU32::new(0);
    if path.file_name().is_none() {
        return Err(Error::new(ErrorKind::InvalidInput, "is no file name"));
    }
    loop {
        let (begins, ends) = TEMPORARY;
        let new = path.with_file_name(format!("{begins}{}-{}{ends}", std::process::id(), NEXT.fetch_add(1, Relaxed)));
        match OpenOptions::new().write(true).create_new(true).mode(mode).open(&new) {
            // That of a process with the same number, in another container or before it was killed.
            Err(e) if e.kind() == ErrorKind::AlreadyExists => {}
            opened => return Ok((opened?, new)),
        }
    }
}

/// The temporary files of `directory` that nobody gives a name any more: their processes were killed over them, a day ago or more. What cannot be looked at
/// is none.
pub fn left_over(directory: &Path) -> Vec<PathBuf> {
    let is_temporary = |name: &OsStr| {
        let numbers = name.to_str().and_then(|name| name.strip_prefix(TEMPORARY.0)?.strip_suffix(TEMPORARY.1)?.split_once('-'));
        let is_number = |text: &str| !text.is_empty() && text.bytes().all(|b| b.is_ascii_digit());
        numbers.is_some_and(|(process, file)| is_number(process) && is_number(file))
    };
    let is_old = |meta: &Metadata| meta.modified().is_ok_and(|at| at.elapsed().is_ok_and(|age| age > LEFT_AFTER));
    let found = std::fs::read_dir(directory).into_iter().flatten().flatten().filter(|entry| is_temporary(&entry.file_name()));
    let found = found.filter_map(|entry| Some((entry.path(), entry.metadata().ok()?)));
    found.filter(|(_, meta)| meta.is_file() && is_old(meta)).map(|(path, _)| path).collect()
}

/// Nobody needs what is not whole, and it does no harm if it cannot be removed.
fn remove(new: &Path) {
    let _ = std::fs::remove_file(new);
}

/// The directory in which a file at `path` lies.
fn directory_of(path: &Path) -> &Path {
    path.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."))
}

/// Puts the directory of `path` on the disk, so that the file's name stays after a power failure. A file system that cannot do it does without.
pub fn sync_directory(path: &Path) {
    let _ = File::open(directory_of(path)).and_then(|d| d.sync_all());
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(directory: &Path) -> Vec<String> {
        let mut names: Vec<String> = directory.read_dir().unwrap().map(|e| e.unwrap().file_name().to_string_lossy().into_owned()).collect();
        names.sort();
        names
    }

    /// Protects whatever a person names by mistake: only an empty file, or one of the same kind, is replaced; mode and owner stay, and nothing is left
    /// beside it.
    #[test]
    fn only_files_of_the_same_kind_are_replaced() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("w.bin");
        replace(&path, b"kind 1", b"kind").unwrap();
        std::fs::set_permissions(&path, Permissions::from_mode(0o640)).unwrap();
        replace(&path, b"kind 2", b"kind").unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"kind 2");
        assert_eq!(path.metadata().unwrap().mode() & 0o777, 0o640);
        std::fs::write(&path, "an episode").unwrap();
        assert!(replace(&path, b"kind 3", b"kind").unwrap_err().to_string().contains("another kind"));
        assert_eq!(std::fs::read(&path).unwrap(), b"an episode");
        for cut in ["", "ki"] {
            std::fs::write(&path, cut).unwrap();
            replace(&path, b"kind 4", b"kind").unwrap();
        }

        let (pipe, device, place) = (dir.path().join("pipe"), dir.path().join("device"), dir.path().join("place"));
        assert!(std::process::Command::new("mkfifo").arg(&pipe).status().unwrap().success());
        std::os::unix::fs::symlink("/dev/null", &device).unwrap();
        std::fs::create_dir(&place).unwrap();
        for other in [&pipe, &device, &place] {
            assert!(replace(other, b"kind 5", b"kind").unwrap_err().to_string().contains("regular"), "{}", other.display());
        }
        assert!(replace(Path::new("/"), b"", b"").is_err());
        for check in [check, |path: &Path, begins: &[u8]| replace(path, b"", begins)] {
            let refused = check(&dir.path().join("no/w.bin"), b"kind").unwrap_err().to_string();
            assert!(refused.contains("no file can be made in") && refused.contains("/no: No such file"), "{refused}");
        }
        assert_eq!(names(dir.path()), ["device", "pipe", "place", "w.bin"]);
    }

    /// Protects a file that is there from a new one that is to get its name.
    #[test]
    fn a_name_is_given_only_once() {
        let dir = tempfile::tempdir().unwrap();
        let (new, path) = (dir.path().join("new"), dir.path().join("path"));
        std::fs::write(&new, "1").unwrap();
        give_name(&new, &path).unwrap();
        std::fs::write(&new, "2").unwrap();
        assert_eq!(give_name(&new, &path).unwrap_err().kind(), ErrorKind::AlreadyExists);
        assert_eq!(create(&path, b"3").unwrap_err().kind(), ErrorKind::AlreadyExists);
        create(&dir.path().join("other"), b"3").unwrap();
        create_secret(&dir.path().join("secret"), b"4").unwrap();
        assert_eq!(dir.path().join("secret").metadata().unwrap().mode() & 0o777, 0o600);
        assert_eq!(names(dir.path()), ["new", "other", "path", "secret"]);
        assert_eq!(std::fs::read(&path).unwrap(), b"1");
    }

    /// Protects a file of a process with the same number, in another container or before it was killed, whose temporary name would be ours.
    #[test]
    fn a_temporary_name_that_is_taken_is_passed_over() {
        let dir = tempfile::tempdir().unwrap();
        let taken = |k: u32| dir.path().join(format!(".decant-{}-{k}.new", std::process::id()));
        (0..500).for_each(|k| std::fs::write(taken(k), "theirs").unwrap());
        let (_, ours) = new_beside(&dir.path().join("w.bin")).unwrap();
        assert!((0..500).all(|k| taken(k) != ours && std::fs::read(taken(k)).unwrap() == b"theirs"), "{}", ours.display());
    }

    /// Protects files that are being written, and those of others: only what nothing was written into for a day, and has a temporary name, is left over.
    #[test]
    fn what_a_killed_process_left_is_told_from_what_is_written() {
        let dir = tempfile::tempdir().unwrap();
        let days_ago = |days: u32| std::time::SystemTime::now() - LEFT_AFTER * days;
        let make = |name: &str, days: u32| {
            let file = File::create(dir.path().join(name)).unwrap();
            file.set_modified(days_ago(days)).unwrap();
        };
        let (_, under_way) = new_beside(&dir.path().join("w.bin")).unwrap();
        for name in [".decant-12.new", ".decant-a-1.new", ".decant-1-.new", "decant-1-1.new", ".decant-1-1.newer", "w.bin"] {
            make(name, 2);
        }
        make(".decant-12-345.new", 2);
        make(".decant-12-346.new", 0);
        std::fs::create_dir(dir.path().join(".decant-1-1.new")).unwrap();
        std::os::unix::fs::symlink(".decant-12-345.new", dir.path().join(".decant-1-2.new")).unwrap();
        assert_eq!(left_over(dir.path()), [dir.path().join(".decant-12-345.new")]);
        std::fs::rename(dir.path().join(".decant-12-345.new"), &under_way).unwrap();
        assert_eq!(left_over(dir.path()), [under_way], "the names are those of new_beside");
        assert!(left_over(&dir.path().join("no")).is_empty());
    }
}
