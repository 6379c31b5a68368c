//! Where a cell keeps its runtime files: the socket that stops a motion, the controller's process number, and iceoryx2's files.
//!
//! They live where nobody ages them and only the cell's own user may enter (and, if its mode says so, the user's group). The first of these
//! that can be used is taken, with the cell's name as the last part:
//!
//! 1. `[cell] runtime_dir`, if it is set;
//! 2. `$RUNTIME_DIRECTORY`, which systemd sets;
//! 3. `/run/decant`, if it may be written; root makes it;
//! 4. `decant` in `$XDG_RUNTIME_DIR`, or in `/run/user/UID` if that variable is not set;
//! 5. `/dev/shm/decant-UID`. iceoryx2 needs `/dev/shm` anyway, systemd-tmpfiles does not age it, and a restart of the machine empties it.
//!
//! `/tmp` is never used, because files there are deleted after some days. Ordinary threads call this at their start; it allocates and waits
//! for the disk. Every failure is a [`RuntimeDirError`] of one line.

use std::fs::{DirBuilder, Metadata, Permissions};
use std::os::unix::fs::{DirBuilderExt, MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

use crate::config::{CELL_NAME_RULE, CellConfig, is_cell_name};
use crate::whole_file::may_make_in;

/// Longest path of the directory, bytes. A socket's address holds 107, and iceoryx2 needs 57 of them: a slash, 16 of the prefix, up to 34
/// digits and `.event`.
const PATH_MAX: usize = 50;
/// The bits of a directory's mode that must not be set: a group may look, and others may do nothing.
const TOO_OPEN: u32 = 0o027;

/// Why the runtime directory cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum RuntimeDirError {
    /// The cell's name cannot be used in file names.
    #[error("cell name '{0}': use {CELL_NAME_RULE}")]
    Name(String),
    /// The directory, or the one that it lies in, is not safe or cannot be made.
    #[error("runtime directory {}: {what}", directory.display())]
    Unusable {
        /// The directory.
        directory: PathBuf,
        /// What is wrong, and what to do.
        what: String,
    },
}

/// A cell and the directory that its configuration names for runtime files, if it names one.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Place {
    /// The cell's name.
    pub name: String,
    /// `[cell] runtime_dir`.
    pub base: Option<PathBuf>,
}

impl From<&str> for Place {
    fn from(name: &str) -> Self {
        Self { name: name.into(), base: None }
    }
}

impl From<&String> for Place {
    fn from(name: &String) -> Self {
        Self::from(name.as_str())
    }
}

impl From<&CellConfig> for Place {
    fn from(cell: &CellConfig) -> Self {
        Self { name: cell.name.clone(), base: cell.runtime_dir.clone() }
    }
}

impl From<&Place> for Place {
    fn from(place: &Place) -> Self {
        place.clone()
    }
}

/// User number of this process.
pub fn own_uid() -> u32 {
    rustix::process::geteuid().as_raw()
}

/// The directories that may hold the directories of cells without a `runtime_dir` of their own, the preferred one first.
pub fn bases() -> Vec<PathBuf> {
    let uid = own_uid();
    let mut found = vec![PathBuf::from("/run/decant")];
    let session = std::env::var_os("XDG_RUNTIME_DIR").map_or_else(|| PathBuf::from(format!("/run/user/{uid}")), PathBuf::from);
    let ours = |m: &Metadata| m.is_dir() && m.uid() == uid && m.mode() & 0o022 == 0;
    if session.is_absolute() && session.symlink_metadata().is_ok_and(|m| ours(&m)) {
        found.push(session.join("decant"));
    }
    found.push(PathBuf::from(format!("/dev/shm/decant-{uid}")));
    found
}

impl Place {
    /// Path of the cell's directory; nothing is made or checked.
    pub fn path(&self) -> PathBuf {
        if let Some(base) = &self.base {
            return base.join(&self.name);
        }
        let by_systemd = std::env::var("RUNTIME_DIRECTORY").ok().and_then(|list| list.split(':').next().map(PathBuf::from));
        if let Some(given) = by_systemd.filter(|p| p.is_absolute()) {
            return if given.ends_with(&self.name) { given } else { given.join(&self.name) };
        }
        let system = Path::new("/run/decant");
        let usable = |base: &Path| {
            base != system
                || may_make_in(&base.join(&self.name)).is_ok()
                || may_make_in(base).is_ok()
                || (own_uid() == 0 && !base.exists() && may_make_in(Path::new("/run")).is_ok())
        };
        let base = bases().into_iter().find(|b| usable(b)).unwrap_or_else(|| system.into());
        base.join(&self.name)
    }

    /// The cell's directory, made if it is missing. Owner, kind and mode of it and of the one that it lies in are checked.
    pub fn directory(&self) -> Result<PathBuf, RuntimeDirError> {
        self.checked(make)
    }

    /// What [`Place::directory`] would give; nothing is made.
    pub fn check(&self) -> Result<PathBuf, RuntimeDirError> {
        self.checked(can_be_made)
    }

    /// The cell's directory. `make` says whether a directory is there, and of one that is missing whether it can be made.
    fn checked(&self, make: fn(&Path, u32) -> std::io::Result<bool>) -> Result<PathBuf, RuntimeDirError> {
        if !is_cell_name(&self.name) {
            return Err(RuntimeDirError::Name(self.name.clone()));
        }
        let path = self.path();
        let wrong = |directory: &Path, what: String| RuntimeDirError::Unusable { directory: directory.into(), what };
        if path.as_os_str().len() > PATH_MAX {
            let what = format!("its path is longer than {PATH_MAX} bytes: shorten cell.name, or set a shorter cell.runtime_dir");
            return Err(wrong(&path, what));
        }
        let is_there = |directory: &Path, mode| {
            let unmade = |e| wrong(directory, format!("cannot be made: {e}; set cell.runtime_dir to a directory of your own"));
            make(directory, mode).map_err(unmade)
        };
        if let Some(base) = path.parent() {
            if !is_there(base, if base == Path::new("/run/decant") { 0o755 } else { 0o700 })? {
                return Ok(path);
            }
            check_base(base).map_err(|e| wrong(base, e))?;
        }
        if is_there(&path, 0o700)? {
            check(&path).map_err(|e| wrong(&path, e))?;
        }
        Ok(path)
    }
}

/// Makes the directory `path`, unless something is there.
fn make(path: &Path, mode: u32) -> std::io::Result<bool> {
    match DirBuilder::new().mode(mode).create(path) {
        Err(e) if path.symlink_metadata().is_err() => Err(e),
        Err(_) => Ok(true),
        // Without what the caller's umask took away, others could not reach their cells in it.
        Ok(()) => std::fs::set_permissions(path, Permissions::from_mode(mode)).map(|()| true),
    }
}

/// Whether something is at `path`. It is an error if nothing is and [`make`] would fail.
fn can_be_made(path: &Path, _mode: u32) -> std::io::Result<bool> {
    let is_there = path.symlink_metadata().is_ok();
    if !is_there {
        may_make_in(path.parent().unwrap_or(path))?;
    }
    Ok(is_there)
}

/// Checks the directory that the cell's directory lies in: nobody else may put another in its place. The error is one line.
fn check_base(base: &Path) -> Result<(), String> {
    // A link leads where its owner wants, so its owner is judged before it is followed; some kernels do not follow one of a stranger.
    let owned = |meta: &Metadata| match meta.uid() {
        uid if [0, own_uid()].contains(&uid) => Ok(()),
        uid => Err(format!("belongs to user {uid}, not to root or this user: remove it, or set cell.runtime_dir")),
    };
    owned(&base.symlink_metadata().map_err(|e| e.to_string())?)?;
    let meta = std::fs::metadata(base).map_err(|e| e.to_string())?;
    if !meta.is_dir() {
        return Err("is no directory: remove it, or set cell.runtime_dir".into());
    }
    let sticky = meta.mode() & 0o1000 != 0;
    owned(&meta)?;
    if meta.mode() & 0o022 != 0 && !sticky {
        return Err(format!("others may write there (mode {:o}): chmod 0755, or set cell.runtime_dir", meta.mode() & 0o7777));
    }
    Ok(())
}

/// Checks the cell's own directory.
fn check(path: &Path) -> Result<(), String> {
    let meta = path.symlink_metadata().map_err(|e| e.to_string())?;
    if meta.is_symlink() || !meta.is_dir() {
        return Err("is a link or no directory: remove it, or set cell.runtime_dir".into());
    }
    if meta.uid() != own_uid() {
        let what =
            "belongs to user {}, and this process runs as user {}: run all programs of a cell as one user, or choose another cell.name";
        return Err(what.replacen("{}", &meta.uid().to_string(), 1).replacen("{}", &own_uid().to_string(), 1));
    }
    if meta.mode() & TOO_OPEN != 0 {
        return Err(format!("is open to others (mode {:o}): chmod 0700, or 0750 for a group that may abort", meta.mode() & 0o7777));
    }
    if may_make_in(path).is_err() {
        return Err("cannot be written by this user: set cell.runtime_dir to a directory that can".into());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Why a directory below `base` is refused. A look from outside says the same.
    fn refusal(base: &Path) -> String {
        let place = Place { name: "x".into(), base: Some(base.into()) };
        let looked = place.check().expect_err("must be refused");
        assert_eq!(looked, place.directory().expect_err("must be refused"));
        looked.to_string()
    }

    /// Protects the cell from others on the machine: a directory that somebody else prepared is refused, and the line says why.
    #[test]
    fn a_directory_that_is_not_safe_is_refused() {
        let dir = tempfile::Builder::new().prefix("r").tempdir_in("/tmp").expect("a directory");
        let (base, own) = (dir.path(), dir.path().join("x"));
        let mode = |path: &Path, mode| std::fs::set_permissions(path, std::fs::Permissions::from_mode(mode)).expect("ours");
        let place = Place { name: "x".into(), base: Some(base.into()) };
        assert!(place.check().expect("can be made") == own && !own.exists(), "a look makes nothing");
        let below = base.join("new");
        let deeper = Place { name: "x".into(), base: Some(below.clone()) };
        assert!(deeper.check().is_ok() && !below.exists(), "base and directory can be made");
        assert!(refusal(&below.join("newer")).contains("cannot be made: No such file"));
        assert_eq!(place.directory().expect("usable"), own);
        assert_eq!(own.metadata().expect("made").mode() & 0o7777, 0o700);
        for (open, word) in [(0o755, "755"), (0o777, "777"), (0o720, "720")] {
            mode(&own, open);
            assert!(refusal(base).contains(word));
        }
        mode(&own, 0o750);
        assert!(place.directory().is_ok(), "a group may look");
        std::fs::remove_dir(&own).expect("empty");
        std::os::unix::fs::symlink("/run", &own).expect("a link");
        assert!(refusal(base).contains("is a link"));
        std::fs::remove_file(&own).expect("ours");
        std::fs::write(&own, b"").expect("a file");
        assert!(refusal(base).contains("no directory"));
        std::fs::remove_file(&own).expect("ours");
        mode(base, 0o777);
        assert!(refusal(base).contains("others may write"));
        mode(base, 0o1777);
        assert!(place.directory().is_ok(), "nobody can take away what is ours from a sticky directory");
        if own_uid() == 0 {
            std::os::unix::fs::chown(&own, Some(65534), None).expect("root may");
            assert!(refusal(base).contains("belongs to user 65534"));
            std::os::unix::fs::chown(base, Some(65534), None).expect("root may");
            assert!(refusal(base).contains("not to root or this user"));
            std::os::unix::fs::chown(base, Some(0), None).expect("root may");
            std::os::unix::fs::chown(&own, Some(0), None).expect("root may");
            assert!(place.directory().is_ok());
            let link = base.with_extension("link");
            std::os::unix::fs::symlink(base, &link).expect("a link");
            assert!(Place { base: Some(link.clone()), ..place.clone() }.directory().is_ok(), "a link of ours");
            std::os::unix::fs::lchown(&link, Some(65534), None).expect("root may");
            let said = refusal(&link);
            std::fs::remove_file(&link).expect("root may");
            assert!(said.contains("belongs to user 65534, not to root or this user"), "{said}");
        }
        // The umask is the whole process's, so it is another one for a moment only.
        let umask = rustix::process::umask(rustix::fs::Mode::from_raw_mode(0o077));
        let made = make(&base.join("open"), 0o755);
        rustix::process::umask(umask);
        assert!(made.expect("writable") && base.join("open").metadata().expect("made").mode() & 0o7777 == 0o755);
        let long = Place { name: "a-name-of-thirty-two-characters-x".chars().take(32).collect(), base: Some(base.join("somewhere/deep")) };
        assert!(long.directory().expect_err("too long").to_string().contains("longer than"));
        assert!(matches!(Place::from("../x").directory(), Err(RuntimeDirError::Name(_))));
    }
}
