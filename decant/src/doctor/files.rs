//! Configuration, runtime directory, shared memory, weights, and room on the disk.
//!
//! Called once by an ordinary thread; allocates and reads the disk; nothing fails. Nothing is made or changed.

use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use rt_controller::{claim, disk, disk_note};
use shared::config::Config;
use shared::machine::Finding;
use shared::runtime_dir::{Place, own_uid};
use shared::shared_memory::{self, SharedMemoryError};

/// Room in `/dev/shm` for a cell with its frames, bytes. Chosen by hand: the cell of config/sim.toml uses about 9 MB, and a reader of
/// frames 4 more.
const SHM_BYTES: u64 = 32 << 20;
/// Size of an hour of the journal, bytes (measured on a running cell).
const JOURNAL_HOUR_BYTES: u64 = 13 << 20;
/// Size of an episode that stands for those that will come, bytes, where there is none yet: eight seconds of frames as JPEG.
const EPISODE_BYTES: u64 = 8 << 20;
/// Days of the journal below which room is short. Chosen by hand: a week is until somebody looks again.
const DAYS: u64 = 7;
/// Number of episodes below which room is short. Chosen by hand: some days of a lab's pours.
const EPISODES: u64 = 200;

/// Looks at the cell's files.
pub fn look(file: &Path, config: &Config) -> Vec<Finding> {
    let mut findings = vec![Finding::green("configuration", format!("{}, cell '{}'", file.display(), config.cell.name))];
    findings.push(controller(config));
    findings.push(shared_memory());
    findings.push(strangers());
    findings.push(weights(file, config));
    if let Some(journal) = &config.controller.journal {
        findings.push(room("journal", journal.parent().unwrap_or(journal), JOURNAL_HOUR_BYTES * 24 * DAYS, |free| {
            format!("room for {} days", free / (JOURNAL_HOUR_BYTES * 24))
        }));
    }
    let episode = episode_bytes(&config.recording.directory);
    findings.push(room("episodes", &config.recording.directory, EPISODES * episode, |free| format!("room for {} more", free / episode)));
    findings
}

/// Whether a controller of the cell runs.
fn controller(config: &Config) -> Finding {
    let directory = Place::from(&config.cell).path();
    match claim::running(&directory) {
        Some(running) => Finding::green("controller", format!("process {} runs ({})", running.pid, running.config.display())),
        None => Finding::green("controller", format!("none runs; its runtime files would be in {}", directory.display())),
    }
}

fn shared_memory() -> Finding {
    match shared_memory::check_space(SHM_BYTES) {
        Ok(()) => Finding::green("/dev/shm", format!("{} MiB or more are free", SHM_BYTES >> 20)),
        Err(e @ SharedMemoryError::Space { free_kib, .. }) if free_kib >= 4096 => {
            Finding::yellow("/dev/shm", e.to_string(), "view, calibrate or a second cell may find no room", "")
        }
        Err(e) => Finding::red("/dev/shm", e.to_string(), "no process of the cell can start", ""),
    }
}

/// Files in `/dev/shm` that other users' cells have there. Those of this user's dead processes go by themselves at the next start.
fn strangers() -> Finding {
    let mut owners: Vec<(u32, u64)> = Vec::new();
    for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
        let Ok(meta) = entry.metadata() else { continue };
        if !entry.file_name().to_string_lossy().starts_with("decant-") || meta.uid() == own_uid() {
            continue;
        }
        match owners.iter_mut().find(|(uid, _)| *uid == meta.uid()) {
            Some((_, bytes)) => *bytes += meta.len(),
            None => owners.push((meta.uid(), meta.len())),
        }
    }
    if owners.is_empty() {
        return Finding::green("others' shared memory", "none");
    }
    let list: Vec<String> = owners.iter().map(|(uid, bytes)| format!("user {uid}: {} KiB", bytes / 1024)).collect();
    let advice = "if no cell of theirs runs, that user or root may delete /dev/shm/decant-*";
    Finding::yellow("others' shared memory", list.join(", "), "it takes room, and a cell of one name is another user's", advice)
}

fn weights(file: &Path, config: &Config) -> Finding {
    let path = &config.controller.weights;
    let trusted = std::fs::metadata(file).ok().map(|m| m.uid());
    let train = "record and weigh episodes, and train: README.md, \"Use it on a robot\"";
    if !path.exists() {
        return Finding::yellow(
            "weights",
            format!("{} is not there", path.display()),
            "curves can be recorded, and nothing can be poured",
            train,
        );
    }
    match disk::read_weights(path, config.camera.fps, trusted) {
        Ok(weights) => {
            let origin = &weights.origin;
            let how = format!("trained from {} episodes by {:?}", origin.episodes, origin.method);
            let age = path.metadata().ok().and_then(|m| m.modified().ok()).and_then(|t| t.elapsed().ok());
            let age = age.map_or(String::new(), |age| format!(", {:.1} days old", age.as_secs_f64() / 86_400.0));
            Finding::green("weights", format!("{} {how}{age}", weights.identity()))
        }
        Err(e) => Finding::red("weights", e, "the controller refuses them, and nothing can be poured", train),
    }
}

/// Mean size of the episodes in `directory`, bytes.
fn episode_bytes(directory: &Path) -> u64 {
    let entries = std::fs::read_dir(directory).into_iter().flatten().flatten();
    let sizes: Vec<u64> =
        entries.filter(|e| e.path().extension().is_some_and(|x| x == "mcap")).filter_map(|e| e.metadata().ok().map(|m| m.len())).collect();
    if sizes.is_empty() { EPISODE_BYTES } else { (sizes.iter().sum::<u64>() / sizes.len() as u64).max(1) }
}

/// Whether `directory`, or the first above it that is there, may be written and has `wanted_bytes` free.
fn room(what: &str, directory: &Path, wanted_bytes: u64, lasts: impl Fn(u64) -> String) -> Finding {
    let there: PathBuf = directory.ancestors().find(|d| d.is_dir()).unwrap_or(Path::new("/")).into();
    let access = rustix::fs::Access::WRITE_OK | rustix::fs::Access::EXEC_OK;
    if let Err(e) = rustix::fs::accessat(rustix::fs::CWD, &there, access, rustix::fs::AtFlags::EACCESS) {
        let advice = format!("give it to this user (user {}), or configure another place", own_uid());
        return Finding::red(what, format!("{}: {e}", there.display()), "nothing can be written there", advice);
    }
    let Some(free) = disk_note::free_bytes(&there) else {
        return Finding::yellow(what, format!("{}: its free space is not shown", there.display()), "it may be full", "look at it with df");
    };
    let is = format!("{}: {} MiB free, {}", there.display(), free >> 20, lasts(free));
    let advice = "delete or move what is no longer needed";
    match free {
        // One episode, or an hour of the journal, must fit.
        0..JOURNAL_HOUR_BYTES => Finding::red(what, is, "the disk is full: nothing more is recorded", advice),
        free if free < wanted_bytes => Finding::yellow(what, is, "the disk will be full soon", advice),
        _ => Finding::green(what, is),
    }
}
