//! The files of one cell in `/dev/shm`: their unguessable prefix, who uses them, whether there is space for them, and that they go again.
//!
//! Each start of a cell draws a token, which the cell's runtime directory keeps, and iceoryx2 names its files `decant-TOKEN_*`. Nobody can
//! put files of those names there before. Every process of the cell holds a shared lock on `decant-TOKEN.lock` until it ends, however it
//! ends. So files whose lock can be had alone belong to nobody any more, and whoever starts next removes them.
//!
//! Ordinary threads call this when they join a cell; it allocates and waits for the disk, at most two seconds for another process that is
//! joining too. Every failure is a [`SharedMemoryError`] of one line.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::{File, Metadata, OpenOptions};
use std::io::{Read, Write};
use std::os::unix::fs::{MetadataExt, OpenOptionsExt, PermissionsExt};
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use crate::disk_space::{Room, error_words};
use crate::regular_file::is_at;
use crate::runtime_dir::own_uid;
use crate::whole_file::may_make_in;

/// Where the system keeps shared memory.
const SHM: &str = "/dev/shm";
/// Space that must be free before a cell is joined, bytes: what iceoryx2 touches while it makes a client's ports is about 0.5 MB (measured
/// on a command that asks for the status).
const JOIN_BYTES: u64 = 1 << 20;
/// Files that must still fit before a cell is joined. Chosen by hand: more than one program makes.
const JOIN_FILES: u64 = 32;
/// Number of characters of a token: 32 bits in hexadecimal, which few cells do not draw twice.
const TOKEN_LEN: usize = 8;
/// The most files of cells that are looked at, for who asks whose they are. Chosen by hand: a cell has about a hundred.
const LOOKED_MOST: usize = 10_000;
/// The namespace of processes from which all are seen, as the kernel names it (PROC_PID_INIT_INO in include/linux/proc_ns.h).
const FIRST_PROCESSES: &str = "pid:[4026531836]";
/// Longest wait for another process that is joining the same cell. Chosen by hand: joining takes some milliseconds.
const JOIN_WAIT: Duration = Duration::from_secs(2);

/// Why shared memory cannot be used.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
pub enum SharedMemoryError {
    /// There is too little space.
    #[error(
        "/dev/shm has {free_kib} KiB free of {size_kib}, and {needed_kib} KiB are needed: delete what fills it, or make it larger (mount -o remount,size=256M /dev/shm; in a container --shm-size)"
    )]
    Space {
        /// Free space, KiB.
        free_kib: u64,
        /// Its size, KiB.
        size_kib: u64,
        /// Space that is needed, KiB.
        needed_kib: u64,
    },
    /// A file cannot be made, read or locked.
    #[error("{file}: {what}")]
    File {
        /// The file.
        file: String,
        /// What the system says, and what to do.
        what: String,
    },
}

/// The error of a file.
fn failed(file: &Path, what: impl std::fmt::Display) -> SharedMemoryError {
    SharedMemoryError::File { file: file.display().to_string(), what: what.to_string() }
}

/// Checks that files can be made in `/dev/shm`, and that `bytes` more fit into it.
pub fn check_space(bytes: u64) -> Result<(), SharedMemoryError> {
    let Ok(fs) = rustix::fs::statvfs(SHM) else {
        return Err(failed(Path::new(SHM), "is missing: mount a tmpfs there"));
    };
    let unmade =
        |e| format!("no file can be made there: {e}; it must be writable and have mode 1777 (mount -o remount,rw,mode=1777 /dev/shm)");
    may_make_in(Path::new(SHM)).map_err(|e| failed(Path::new(SHM), unmade(e)))?;
    let room = Room::of(&fs);
    if room.files < JOIN_FILES {
        return Err(failed(Path::new(SHM), "holds as many files as it may, whatever their size: delete those that fill it"));
    }
    // A file system without a limit shows a size of zero.
    if fs.f_blocks == 0 || room.bytes >= bytes {
        return Ok(());
    }
    let kib = |blocks: u64| blocks.saturating_mul(fs.f_frsize) / 1024;
    Err(SharedMemoryError::Space { free_kib: kib(fs.f_bavail), size_kib: kib(fs.f_blocks), needed_kib: bytes / 1024 })
}

/// The lock files of this process by their tokens, and how many [`Membership`]s use each. A process holds one lock for each token, because
/// it may join a cell several times.
static HELD: Mutex<BTreeMap<String, (File, usize)>> = Mutex::new(BTreeMap::new());

/// This process's membership in a cell's shared memory. When the last one of all processes goes, the files go too.
#[derive(Debug)]
pub struct Membership {
    token: String,
    /// The files that were there before.
    before: BTreeSet<PathBuf>,
}

impl Membership {
    /// Joins the shared memory of the cell whose runtime directory is `directory`; clears what dead processes of this user left.
    pub fn join(directory: &Path) -> Result<Self, SharedMemoryError> {
        check_space(JOIN_BYTES)?;
        let path = directory.join("lock");
        let joining = open(&path, true).map_err(|e| failed(&path, e))?;
        let until = Instant::now() + JOIN_WAIT;
        while joining.try_lock().is_err() {
            if Instant::now() > until {
                return Err(failed(&path, "another process has been joining the cell for two seconds: is it stopped?"));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        clear_dead();
        let mut held = HELD.lock().unwrap_or_else(PoisonError::into_inner);
        let file = directory.join("token");
        if let Some(token) = read_token(&file) {
            if let Some((_, uses)) = held.get_mut(&token) {
                *uses += 1;
                return Ok(Self::new(token));
            }
            // Whoever still uses the token holds its lock, so that it was not cleared.
            let path = lock_path(&token);
            if let Ok(lock) = open(&path, false)
                && share(&lock, &path)
            {
                held.insert(token.clone(), (lock, 1));
                return Ok(Self::new(token));
            }
        }
        // Only a directory with a token is one in which iceoryx2's files are ours to remove.
        let has_token = file.symlink_metadata().is_ok();
        let left = left_by_iceoryx2(directory);
        if let (false, Some(foreign)) = (has_token, left.first()) {
            let what = "is there, and no cell left it: remove it, or set cell.runtime_dir to a directory of its own";
            return Err(failed(foreign, what));
        }
        let (token, lock) = new_token(directory)?;
        remove_all(&left);
        let new = directory.join("token.new");
        std::fs::write(&new, &token).and_then(|()| std::fs::rename(&new, &file)).map_err(|e| failed(&new, error_words(&e)))?;
        held.insert(token.clone(), (lock, 1));
        Ok(Self::new(token))
    }

    fn new(token: String) -> Self {
        let before = files(&prefix(&token)).into_iter().collect();
        Self { token, before }
    }

    /// The first part of the names of the cell's files in `/dev/shm`.
    pub fn prefix(&self) -> String {
        prefix(&self.token)
    }

    /// Closes the cell's files to other users. iceoryx2 makes one of them, `*.global_mgmt`, for everybody to write, and has no setting for
    /// that.
    pub fn close_to_others(&self) {
        for file in files(&self.prefix()) {
            if file.metadata().is_ok_and(|m| m.mode() & 0o077 != 0) {
                let _ = std::fs::set_permissions(&file, PermissionsExt::from_mode(0o600));
            }
        }
    }

    /// Has the system set memory aside for the cell's files that were made since this process joined. iceoryx2 only states their size;
    /// without this the process that first writes a page of a full `/dev/shm` is killed.
    pub fn reserve(&self) -> Result<(), SharedMemoryError> {
        for path in files(&self.prefix()).into_iter().filter(|f| !self.before.contains(f)) {
            let Ok(file) = open(&path, false) else { continue };
            let Ok(bytes) = file.metadata().map(|m| m.len()) else { continue };
            if bytes > 0 && rustix::fs::fallocate(&file, rustix::fs::FallocateFlags::empty(), 0, bytes).is_err() {
                check_space(bytes)?;
                return Err(failed(&path, "no memory could be set aside for it: is /dev/shm full, or the process's memory limited?"));
            }
        }
        Ok(())
    }
}

impl Drop for Membership {
    fn drop(&mut self) {
        let mut held = HELD.lock().unwrap_or_else(PoisonError::into_inner);
        let Some((lock, uses)) = held.get_mut(&self.token) else { return };
        *uses = uses.saturating_sub(1);
        if *uses > 0 {
            return;
        }
        // iceoryx2 keeps one file for good. It goes with the last process; everything else shows that a port is still in use.
        let left = files(&self.prefix());
        let unused = left.iter().all(|f| f.extension().is_some_and(|e| e == "global_mgmt"));
        if unused && lock.try_lock().is_ok() {
            remove(&self.token);
            held.remove(&self.token);
        } else {
            let _ = lock.lock_shared();
        }
    }
}

/// Removes the shared memory of the cell whose runtime directory is `directory`, whoever uses it.
pub fn remove_of(directory: &Path) {
    if let Some(token) = read_token(&directory.join("token")) {
        remove(&token);
    }
}

/// Removes what dead processes of this user left in `/dev/shm`, of any cell.
fn clear_dead() {
    for (token, lock) in of_cells().filter_map(|(token, file, is_lock)| is_lock.then_some((token, file))) {
        if lock.symlink_metadata().is_ok_and(|m| m.uid() == own_uid())
            && let Ok(file) = open(&lock, false)
            && file.try_lock().is_ok()
        {
            remove(&token);
        }
    }
}

/// The files of all cells of all users: each with its token, and whether it is the token's lock.
fn of_cells() -> impl Iterator<Item = (String, PathBuf, bool)> {
    std::fs::read_dir(SHM).into_iter().flatten().flatten().filter_map(|entry| {
        let name = entry.file_name().into_string().ok()?;
        let (token, rest) = name.strip_prefix("decant-")?.split_at_checked(TOKEN_LEN)?;
        let is_lock = rest == ".lock";
        (is_token(token) && (is_lock || rest.starts_with('_'))).then(|| (token.to_owned(), entry.path(), is_lock))
    })
}

/// The files that somebody has locked.
struct Locked {
    /// Those that this process sees: device and inode.
    seen: BTreeSet<(u64, u64)>,
    /// Whether there are no others.
    is_all: bool,
}

impl Locked {
    /// Looks for them.
    fn look() -> Self {
        // Everybody may read which files are locked; the file stands in it as MAJOR:MINOR:INODE, the first two in hexadecimal (proc_locks(5)).
        let locks = std::fs::read_to_string("/proc/locks");
        // Locks of processes that are out of sight are left out there.
        let sees_all = std::fs::read_link("/proc/self/ns/pid").is_ok_and(|name| name.as_os_str() == FIRST_PROCESSES);
        let is_all = locks.is_ok() && sees_all;
        let file = |word: &str| {
            let mut parts = word.split(':');
            let [major, minor] = [parts.next()?, parts.next()?].map(|number| u32::from_str_radix(number, 16));
            Some((rustix::fs::makedev(major.ok()?, minor.ok()?), parts.next()?.parse().ok()?))
        };
        Self { seen: locks.unwrap_or_default().split_whitespace().filter_map(file).collect(), is_all }
    }

    /// Whether the file is locked; `None` if this process cannot see that.
    fn has(&self, meta: &Metadata) -> Option<bool> {
        let seen = self.seen.contains(&(meta.dev(), meta.ino()));
        (seen || self.is_all).then_some(seen)
    }
}

/// Whether a process of the cell runs whose runtime directory is `directory`. Nothing is made or changed.
pub fn is_in_use(directory: &Path) -> bool {
    let lock = read_token(&directory.join("token")).map(|token| lock_path(&token));
    let Some((lock, meta)) = lock.and_then(|path| path.symlink_metadata().ok().map(|meta| (path, meta))) else { return false };
    Locked::look().has(&meta).unwrap_or_else(|| !can_be_had_alone(directory, &lock))
}

/// Whether nobody holds the lock of the cell whose runtime directory is `directory`. It is taken for a moment, in which nobody joins the cell: who joined
/// would not get a share, and would take the cell for a dead one.
fn can_be_had_alone(directory: &Path, lock: &Path) -> bool {
    let Ok(joining) = open(&directory.join("lock"), false) else { return false };
    joining.try_lock().is_ok() && open(lock, false).is_ok_and(|lock| lock.try_lock().is_ok())
}

/// What cells have in `/dev/shm`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Kept {
    /// The user whose it is.
    pub uid: u32,
    /// Whether a process of the cell runs; `None` if this process cannot see that.
    pub in_use: Option<bool>,
    /// Its size, bytes.
    pub bytes: u64,
}

/// What all users' cells have in `/dev/shm`: for each user at most what is in use, what dead processes left, and what may be either. The second value tells whether all files
/// were looked at: any user may make as many as there is room for.
pub fn kept() -> (Vec<Kept>, bool) {
    let locked = Locked::look();
    let mut files = of_cells();
    let looked: Vec<(String, Metadata, bool)> = files
        .by_ref()
        .take(LOOKED_MOST)
        .filter_map(|(token, file, is_lock)| Some((token, file.symlink_metadata().ok()?, is_lock)))
        .collect();
    let locks = looked.iter().filter(|(_, _, is_lock)| *is_lock);
    let in_use: BTreeMap<&str, Option<bool>> = locks.map(|(token, meta, _)| (token.as_str(), locked.has(meta))).collect();
    let mut all: BTreeMap<(u32, Option<bool>), u64> = BTreeMap::new();
    for (token, meta, _) in &looked {
        if let Some(in_use) = in_use.get(token.as_str()) {
            *all.entry((meta.uid(), *in_use)).or_default() += meta.len();
        }
    }
    (all.into_iter().map(|((uid, in_use), bytes)| Kept { uid, in_use, bytes }).collect(), files.next().is_none())
}

/// Removes the files of a token, the lock last.
fn remove(token: &str) {
    for file in files(&prefix(token)) {
        let _ = std::fs::remove_file(file);
    }
    let _ = std::fs::remove_file(lock_path(token));
}

/// What has the name of something that iceoryx2 leaves in a cell's directory.
fn left_by_iceoryx2(directory: &Path) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(directory).into_iter().flatten().flatten().map(|e| e.path());
    let is_its = |path: &PathBuf| path.ends_with("services") || path.ends_with("nodes") || path.extension().is_some_and(|e| e == "event");
    entries.filter(is_its).collect()
}

/// Removes files, and directories with what is in them.
fn remove_all(paths: &[PathBuf]) {
    for path in paths {
        let _ = std::fs::remove_file(path).or_else(|_| std::fs::remove_dir_all(path));
    }
}

/// The files in `/dev/shm` whose names begin with `prefix`.
fn files(prefix: &str) -> Vec<PathBuf> {
    let entries = std::fs::read_dir(SHM).into_iter().flatten().flatten();
    entries.filter(|e| e.file_name().to_string_lossy().starts_with(prefix)).map(|e| e.path()).collect()
}

/// The first part of the names of a token's files.
fn prefix(token: &str) -> String {
    format!("decant-{token}_")
}

/// The lock of a token. It lies beside the files that it speaks for, so that processes with other mounts meet it too.
fn lock_path(token: &str) -> PathBuf {
    Path::new(SHM).join(format!("decant-{token}.lock"))
}

/// Opens a file of ours, never through a link.
fn open(path: &Path, create: bool) -> std::io::Result<File> {
    let flags = (rustix::fs::OFlags::NOFOLLOW | rustix::fs::OFlags::NONBLOCK).bits() as i32;
    let file = OpenOptions::new().read(true).write(true).create(create).mode(0o600).custom_flags(flags).open(path)?;
    let meta = file.metadata()?;
    if meta.is_file() && meta.uid() == own_uid() { Ok(file) } else { Err(std::io::Error::other("is not a file of this user: remove it")) }
}

/// Takes a share of the lock at `path`, if it is still there: somebody who took it for a dead one may just have removed it.
fn share(lock: &File, path: &Path) -> bool {
    lock.try_lock_shared().is_ok() && is_at(lock, path)
}

/// The token in `file`, if there is a whole one.
fn read_token(file: &Path) -> Option<String> {
    let mut text = String::new();
    open(file, false).ok()?.take(64).read_to_string(&mut text).ok()?;
    is_token(&text).then_some(text)
}

/// Whether a cell may have drawn `text` as its token.
fn is_token(text: &str) -> bool {
    text.len() == TOKEN_LEN && text.bytes().all(|c| c.is_ascii_hexdigit())
}

/// Draws a token that nobody uses and takes its lock.
fn new_token(directory: &Path) -> Result<(String, File), SharedMemoryError> {
    let random = Path::new("/dev/urandom");
    let mut source = File::open(random).map_err(|e| failed(random, e))?;
    loop {
        let mut bytes = [0; 4];
        source.read_exact(&mut bytes).map_err(|e| failed(random, e))?;
        let token = format!("{:08x}", u32::from_le_bytes(bytes));
        let path = lock_path(&token);
        match OpenOptions::new().read(true).write(true).create_new(true).mode(0o600).open(&path) {
            Ok(mut file) => {
                if !share(&file, &path) {
                    continue;
                }
                // This line is for people who wonder whose files these are. Without space it is left out.
                let _ = writeln!(file, "{}", directory.display());
                return Ok((token, file));
            }
            Err(e) if e.kind() == std::io::ErrorKind::AlreadyExists => {}
            Err(e) => return Err(failed(&path, format!("{e}: is /dev/shm full?"))),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects who is told what dead processes left: a lock counts by its device and its inode, because files of two disks may have one number.
    #[test]
    fn a_lock_counts_on_its_own_device() {
        let file = tempfile::tempfile_in(SHM).unwrap();
        let meta = file.metadata().unwrap();
        let is_locked = |device: u64| Locked::look().seen.contains(&(device, meta.ino()));
        assert!(!is_locked(meta.dev()));
        file.lock_shared().unwrap();
        assert!(is_locked(meta.dev()) && !is_locked(meta.dev() + 1));
    }

    /// Protects who asks from within a container whether a cell runs: a lock of a process that is out of sight is no lock that nobody has, and what cannot
    /// be seen is asked of the lock itself, which is free again at once.
    #[test]
    fn a_lock_out_of_sight_is_not_taken_for_a_free_one() {
        let dir = tempfile::tempdir().unwrap();
        let lock = dir.path().join("x.lock");
        let held = File::options().read(true).write(true).create(true).truncate(false).open(&lock).unwrap();
        let meta = held.metadata().unwrap();
        let seen = BTreeSet::from([(meta.dev(), meta.ino())]);
        let other = dir.path().metadata().unwrap();
        for (is_all, of_other) in [(true, Some(false)), (false, None)] {
            let locked = Locked { seen: seen.clone(), is_all };
            assert_eq!((locked.has(&meta), locked.has(&other)), (Some(true), of_other));
        }
        assert!(!can_be_had_alone(dir.path(), &lock), "nobody knows, without the lock of those that join");
        let joining = File::create(dir.path().join("lock")).unwrap();
        assert!(can_be_had_alone(dir.path(), &lock) && can_be_had_alone(dir.path(), &lock));
        joining.lock().unwrap();
        assert!(!can_be_had_alone(dir.path(), &lock), "somebody joins");
        joining.unlock().unwrap();
        held.lock_shared().unwrap();
        assert!(!can_be_had_alone(dir.path(), &lock));
    }
}
