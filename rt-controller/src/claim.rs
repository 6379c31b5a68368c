//! That one controller runs a cell, and that no two cells that run share a file.
//!
//! A controller takes the lock `controller.lock` in the cell's runtime directory before it touches anything else, and writes into `controller`
//! who it is and which files it uses. The kernel gives the lock back however the process ends. Commands read the file to find the process.
//! Ordinary threads use it at the start; it allocates and looks at the disk. Errors are one line each.

use std::fs::{File, OpenOptions};
use std::io::ErrorKind;
use std::os::unix::fs::{MetadataExt, OpenOptionsExt};
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};
use shared::config::Config;
use shared::config_paths::is_same;
use shared::disk_space::error_words;
use shared::regular_file;
use shared::runtime_dir::{Place, own_uid};

use crate::journal_files::before;

/// Largest file `controller`, bytes: five paths of the longest length, and room for what JSON writes longer.
const FILE_MAX: u64 = 32 * 1024;

/// Name of the file that a controller holds locked.
const LOCK: &str = "controller.lock";

/// A controller that runs, as its file says.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct Running {
    /// Its process number.
    pub pid: u32,
    /// When the process started, in the kernel's ticks since the machine did: with it a number that was given again is not mistaken.
    pub started: u64,
    /// The configuration that it read.
    pub config: PathBuf,
    /// The files that it uses: the configuration's key, and the path.
    pub files: Vec<(String, PathBuf)>,
}

/// The right to run a cell, until it is dropped or the process ends.
#[derive(Debug)]
pub struct Claim {
    path: PathBuf,
    _lock: File,
}

impl Claim {
    /// Takes the cell whose runtime directory is `directory`. The error says who has it, or which file another cell uses.
    pub fn take(directory: &Path, file: &Path, config: &Config) -> Result<Self, String> {
        let lock_path = directory.join(LOCK);
        let fail = |path: &Path, e: &std::io::Error| format!("{}: {}", path.display(), error_words(e));
        let flags = (rustix::fs::OFlags::NOFOLLOW | rustix::fs::OFlags::NONBLOCK).bits() as i32;
        let lock = OpenOptions::new().write(true).create(true).truncate(false).mode(0o600).custom_flags(flags).open(&lock_path);
        let lock = lock.map_err(|e| fail(&lock_path, &e))?;
        let name = &config.cell.name;
        if lock.try_lock().is_err() {
            let who = running(directory).map_or(String::new(), |r| format!(" (process {}, {})", r.pid, r.config.display()));
            return Err(format!(
                "another rt-controller of cell '{name}' is running{who}: stop it first, or give this cell another cell.name"
            ));
        }
        let this = Running {
            pid: std::process::id(),
            started: started(std::process::id()).unwrap_or(0),
            config: std::path::absolute(file).unwrap_or_else(|_| file.into()),
            files: files(config),
        };
        let path = directory.join("controller");
        let new = directory.join("controller.new");
        let text = serde_json::to_string(&this).map_err(|e| e.to_string())?;
        std::fs::write(&new, text).and_then(|()| std::fs::rename(&new, &path)).map_err(|e| fail(&new, &e))?;
        let claim = Self { path, _lock: lock };
        // Whoever looks first has been written: of two that start at once, none goes on with the other's file.
        check_others(directory, &this)?;
        Ok(claim)
    }
}

/// The files that only one cell may use: the configuration's key, and the path.
pub fn files(config: &Config) -> Vec<(String, PathBuf)> {
    let mut files = vec![
        ("controller.weights".to_string(), config.controller.weights.clone()),
        ("recording.directory".to_string(), config.recording.directory.clone()),
    ];
    if let Some(journal) = &config.controller.journal {
        files.push(("controller.journal".to_string(), journal.clone()));
        files.push(("the journal before, controller.journal".to_string(), before(journal, 1)));
    }
    files
}

impl Drop for Claim {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.path);
    }
}

/// Refuses files that the controller of another cell uses: of one whose runtime directory lies beside `directory`, and of any that runs as this user.
fn check_others(directory: &Path, this: &Running) -> Result<(), String> {
    let beside = directory.parent().and_then(|base| std::fs::read_dir(base).ok()).into_iter().flatten().flatten();
    let beside = beside.map(|entry| entry.path()).filter_map(|found| running(&found).map(|other| (found, other)));
    // A process of this user is believed, wherever its directory lies.
    let elsewhere = claimed().into_iter().filter_map(|found| running_in(&found).map(|other| (found, other)));
    for (found, other) in beside.chain(elsewhere).filter(|(_, other)| other.pid != this.pid) {
        for (key, path) in &this.files {
            if let Some((its, _)) = other.files.iter().find(|(_, p)| is_same(p, path)) {
                let cell = found.file_name().unwrap_or_default().to_string_lossy();
                return Err(format!(
                    "{key} = {}: cell '{cell}' uses it as {its} ({}); give each cell files of its own",
                    path.display(),
                    other.config.display()
                ));
            }
        }
    }
    Ok(())
}

/// The runtime directories of the controllers that run as this user: a controller keeps the lock in its own open.
fn claimed() -> Vec<PathBuf> {
    let entries = |directory: &str| std::fs::read_dir(directory).into_iter().flatten().flatten().map(|entry| entry.path());
    let controllers = entries("/proc").filter(|process| {
        let pid = process.file_name().and_then(|name| name.to_str()?.parse().ok());
        pid.and_then(started).is_some() && std::fs::metadata(process).is_ok_and(|m| m.uid() == own_uid())
    });
    let open = controllers.flat_map(|process| entries(&process.join("fd").to_string_lossy()).filter_map(|fd| fd.read_link().ok()));
    open.filter(|file| file.ends_with(LOCK)).filter_map(|file| file.parent().map(Path::to_path_buf)).collect()
}

/// The controller whose runtime directory is `directory`, if it runs and the directory has an [`owner`].
pub fn running(directory: &Path) -> Option<Running> {
    owner(directory, false).ok().flatten().and_then(|_| running_in(directory))
}

/// The controller of the cell `place`, if its process is seen to run. Fails, with a line, where its runtime directory is there and is not believed.
pub fn running_at(place: &Place) -> Result<Option<Running>, String> {
    let directory = place.path();
    Ok(owner(&directory, place.base.is_some())?.and_then(|_| running_in(&directory)))
}

/// The controller that runs by what the runtime directory says, whose owner was looked at.
pub(crate) fn running_in(directory: &Path) -> Option<Running> {
    said_in(directory).filter(|found| started(found.pid) == Some(found.started))
}

/// What the runtime directory, whose owner was looked at, says of a controller, which may have ended since without a word.
pub(crate) fn said_in(directory: &Path) -> Option<Running> {
    let bytes = regular_file::read(&directory.join("controller"), FILE_MAX).ok()?;
    serde_json::from_slice(&bytes).ok()
}

/// When the process `pid` started, in the kernel's ticks; `None` if there is none, or if it is no rt-controller.
pub fn started(pid: u32) -> Option<u64> {
    stat(pid).map(|(_, started)| started)
}

/// Whether the process `pid` is an rt-controller that a signal has stopped, as SIGSTOP, so that none of its threads goes on. A debugger may stop one alone.
pub fn is_stopped(pid: u32) -> bool {
    stat(pid).is_some_and(|(state, _)| state == 'T')
}

/// The state of the process `pid`, and when it started, in the kernel's ticks; `None` if there is none, or if it is no rt-controller.
fn stat(pid: u32) -> Option<(char, u64)> {
    let stat = std::fs::read_to_string(format!("/proc/{pid}/stat")).ok()?;
    let (before, after) = stat.rsplit_once(')')?;
    // The fields are those of proc(5); the 22nd is the start. What ended and was not waited for does not run.
    let mut fields = after.split_whitespace();
    let state = fields.next()?.chars().next()?;
    let is_ours = before.ends_with("(rt-controller") && !matches!(state, 'Z' | 'X');
    is_ours.then(|| Some((state, fields.nth(18)?.parse().ok()?))).flatten()
}

/// The user as whom the controller of a cell runs, who owns its runtime directory; `None` where there is none. Fails, with a line, where one is there and
/// neither root nor this user has chosen whose: another user could have made it to answer in the cell's place. A directory in one of the cell's own user is
/// believed only if it is `named` by the caller's configuration.
pub fn owner(directory: &Path, named: bool) -> Result<Option<u32>, String> {
    let doubted = |why: String| format!("{} is not believed: {why}", directory.display());
    let owner = match directory.symlink_metadata() {
        Ok(meta) => meta.uid(),
        Err(e) if matches!(e.kind(), ErrorKind::NotFound | ErrorKind::NotADirectory) => return Ok(None),
        Err(e) => return Err(doubted(e.to_string())),
    };
    let Some(base) = directory.parent() else { return Ok(None) };
    let [meta, link] = [base.metadata(), base.symlink_metadata()];
    let (meta, link) = (meta.map_err(|e| doubted(e.to_string()))?, link.map_err(|e| doubted(e.to_string()))?);
    let ours = |uid: u32| [0, own_uid()].contains(&uid);
    // A link leads where its owner wants.
    for uid in [meta.uid(), link.uid()] {
        if !(ours(uid) || named && uid == owner) {
            return Err(doubted(format!("it belongs to user {owner}, and lies in a directory or behind a link of user {uid}")));
        }
    }
    // Where all may write anybody may have made the directory, and put it in another's place unless the sticky bit forbids that.
    let sticky = meta.mode() & 0o1000 != 0;
    if meta.mode() & 0o022 != 0 && !(sticky && ours(meta.uid()) && ours(owner)) {
        return Err(doubted(format!("it belongs to user {owner}, and others may write where it lies (mode {:o})", meta.mode() & 0o7777)));
    }
    Ok(Some(owner))
}
