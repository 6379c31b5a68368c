//! Configuration, runtime directory, shared memory, weights, and room on the disk.
//!
//! Called once by an ordinary thread; allocates and reads the disk; nothing fails. Nothing is made or changed.

use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use feature_worker::episodes::folder::{Budget, Folder, LEAST_FREE, MEGABYTE, recorded_today};
use rt_controller::{claim, disk, journal_files};
use shared::config::Config;
use shared::disk_space::free_bytes;
use shared::episode::check_number;
use shared::framing::Framing;
use shared::machine::Finding;
use shared::plural::counted;
use shared::runtime_dir::{Place, own_uid};
use shared::shared_memory::{self, SharedMemoryError};
use shared::whole_file::may_make_in;

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
/// Days that the disk must last at today's rate of recording. Chosen by hand: below a week somebody should look, below two days at once.
const LASTS_DAYS: [f64; 2] = [7.0, 2.0];
/// Share of the budget from which on nobody seems to prune. Chosen by hand.
const FAR_OVER: f64 = 1.5;

/// Looks at the cell's files.
pub fn look(file: &Path, config: &Config) -> Vec<Finding> {
    let mut findings = vec![configuration(file, &config.cell.name)];
    findings.push(controller(config));
    findings.push(shared_memory());
    findings.push(strangers());
    findings.push(weights(file, config));
    let runs = matches!(claim::running_at(&Place::from(&config.cell)), Ok(Some(_)));
    findings.extend(config.controller.journal.as_deref().map(|file| journal(file, runs)));
    let folder = Folder::look(&config.recording.directory);
    findings.push(match (writable("episodes", &config.recording.directory), check_number(&config.recording.directory)) {
        (Err(finding), _) => finding,
        (Ok((there, _)), Err(e)) => {
            let advice = "look at .last-number there: give it to this user, or move it away if it is no file of Decant";
            Finding::red("episodes", format!("{}: {e}", there.display()), "no episode gets a number, so no pour begins", advice)
        }
        (Ok((there, free)), Ok(())) => episodes(&there, free, folder, recorded_today(&config.recording.directory)),
    });
    findings.push(budget(Budget::of(&config.recording), folder));
    findings
}

/// Whether the cell that systemd's units know by the name of the configuration's `file` has that name.
fn configuration(file: &Path, name: &str) -> Finding {
    let is = format!("{}, cell '{name}'", file.display());
    let unit = file.file_stem().unwrap_or_default().to_string_lossy();
    let installed = std::path::absolute(file).is_ok_and(|path| path.parent() == Some(Path::new("/etc/decant")));
    if !installed || unit == name {
        return Finding::green("configuration", is);
    }
    let means = format!("decant-controller@{unit} keeps its runtime files in /run/decant/{unit}/{name}, where no command finds them");
    Finding::red("configuration", is, &means, format!("set cell.name to \"{unit}\", or call the file {name}.toml"))
}

/// Whether a controller of the cell runs, and if not, whether its runtime files have a place.
fn controller(config: &Config) -> Finding {
    let place = Place::from(&config.cell);
    let running = claim::running_at(&place);
    if let Ok(Some(running)) = running {
        return Finding::green("controller", format!("process {} runs ({})", running.pid, running.config.display()));
    }
    match (place.check(), running) {
        (Err(e), _) => Finding::red("controller", e.to_string(), "no program of the cell starts as this user", ""),
        (Ok(directory), Ok(_)) => Finding::green("controller", format!("none runs; its runtime files would be in {}", directory.display())),
        (Ok(_), Err(why)) => {
            let advice = "run this as the cell's own user or as root, and see docs/DEPLOYMENT.md for the mode of runtime directories";
            Finding::yellow("controller", why, "whether one runs is not known, and `abort` does not reach it from here", advice)
        }
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
    if path.metadata().is_err_and(|e| e.kind() == ErrorKind::NotFound) {
        return Finding::yellow(
            "weights",
            format!("{} is not there", path.display()),
            "curves can be recorded, and nothing can be poured",
            train,
        );
    }
    match disk::read_weights(path, config.camera.fps, &config.limits, trusted) {
        Ok(weights) => {
            let origin = &weights.origin;
            if let Some(difference) = origin.framing.difference(&Framing::new(&config.camera, &config.image)) {
                return Finding::red(
                    "weights",
                    format!("{} trained on {difference}, as [camera] and [image] have it", weights.identity()),
                    "an area may be another volume in these pictures, and every pour is refused",
                    train,
                );
            }
            let how = format!("trained from {} by {:?}", counted(origin.episodes, "episode"), origin.method);
            let age = path.metadata().ok().and_then(|m| m.modified().ok()).and_then(|t| t.elapsed().ok());
            let age = age.map_or(String::new(), |age| format!(", {:.1} days old", age.as_secs_f64() / 86_400.0));
            let is = format!("{} {how}{age}", weights.identity());
            if origin.pictures_unknown() {
                let means = "they come from tables, so whether they are for these pictures is not known";
                return Finding::yellow(
                    "weights",
                    is,
                    means,
                    "train with recordings of this cell, or make sure that the areas are of such pictures",
                );
            }
            Finding::green("weights", is)
        }
        Err(e) => Finding::red("weights", e, "the controller refuses them, and nothing can be poured", train),
    }
}

/// How long the disk lasts: at the rate of the last day, or for how many episodes if there was none.
fn episodes(there: &Path, free: u64, folder: Folder, today: u64) -> Finding {
    let left = free.saturating_sub(LEAST_FREE);
    let one = folder.bytes.checked_div(folder.episodes as u64).map_or(EPISODE_BYTES, |mean| mean.max(1));
    let days = left as f64 / today as f64;
    let lasts = match today {
        0 => format!("room for {} more", left / one),
        new => format!("{days:.1} days at today's {} MB a day", new.div_ceil(MEGABYTE)),
    };
    let is = format!(
        "{}: {}, {} MB together; {} MB free, {lasts}",
        there.display(),
        counted(folder.episodes, "episode"),
        folder.bytes / MEGABYTE,
        free / MEGABYTE
    );
    let advice = "delete or move what is no longer needed (`decant episodes prune`)";
    let soon = "the disk will be full soon, and then nothing is recorded";
    match left {
        0 => Finding::red("episodes", is, "the disk is full: nothing more is recorded", advice),
        _ if today > 0 && days < LASTS_DAYS[1] => Finding::red("episodes", is, soon, advice),
        _ if today > 0 && days < LASTS_DAYS[0] => Finding::yellow("episodes", is, soon, advice),
        _ if left < EPISODES * one => Finding::yellow("episodes", is, soon, advice),
        _ => Finding::green("episodes", is),
    }
}

/// Whether the episodes are within their budget.
fn budget(budget: Budget, folder: Folder) -> Finding {
    let what = "episodes' budget";
    if budget.is_none() {
        return Finding::green(what, "none is set (recording.budget_mb, recording.budget_episodes)");
    }
    let is = format!("{}, {} MB together; the budget is {}", counted(folder.episodes, "episode"), folder.bytes / MEGABYTE, budget.words());
    let means = "nothing is deleted by itself, so the disk fills";
    let advice =
        "`decant episodes prune` says what it would delete, and spares what is weighed; docs/DATA.md says how it is run each night";
    match budget.share(folder.episodes, folder.bytes) {
        share if share > FAR_OVER => Finding::red(what, is, means, advice),
        share if share > 1.0 => Finding::yellow(what, is, means, advice),
        _ => Finding::green(what, is),
    }
}

/// `directory`, or the first above it that is there, and its free space, bytes, if it may be written.
fn writable(what: &str, directory: &Path) -> Result<(PathBuf, u64), Finding> {
    let there: PathBuf = directory.ancestors().find(|d| d.symlink_metadata().is_ok()).unwrap_or(Path::new("/")).into();
    if !there.is_dir() {
        let is = format!("{} is no directory", there.display());
        return Err(Finding::red(what, is, "nothing can be written there", "remove it, or configure another place"));
    }
    if let Err(e) = may_make_in(&there) {
        let advice = format!("give it to this user (user {}), or configure another place", own_uid());
        return Err(Finding::red(what, format!("{}: {e}", there.display()), "nothing can be written there", advice));
    }
    let unknown =
        || Finding::yellow(what, format!("{}: its free space is not shown", there.display()), "it may be full", "look at it with df");
    free_bytes(&there).ok_or_else(unknown).map(|free| (there, free))
}

/// Whether the controller can begin the journal at `file`, and how long the disk lasts for it. One that `runs` writes there already.
fn journal(file: &Path, runs: bool) -> Finding {
    if let Err(e) = journal_files::check(file, !runs) {
        let advice = "give it to this user, remove it, end what writes it, or choose another controller.journal";
        return Finding::red("journal", e.to_string(), "the controller does not start", advice);
    }
    let directory = file.parent().unwrap_or(file);
    let (there, free) = match writable("journal", directory) {
        Ok(found) => found,
        Err(finding) => return finding,
    };
    let is = format!("{}: {} MB free, room for {}", there.display(), free / MEGABYTE, counted(free / (JOURNAL_HOUR_BYTES * 24), "day"));
    let advice = "delete or move what is no longer needed";
    match free {
        0..JOURNAL_HOUR_BYTES => Finding::red("journal", is, "the disk is full: nothing more is recorded", advice),
        free if free < JOURNAL_HOUR_BYTES * 24 * DAYS => Finding::yellow("journal", is, "the disk will be full soon", advice),
        _ => Finding::green("journal", is),
    }
}

#[cfg(test)]
mod tests {
    use shared::machine::Verdict;

    use super::*;

    /// Protects an installed cell whose file was copied and whose name was not changed: its units would run where no command looks.
    #[test]
    fn an_installed_cell_has_the_name_of_its_file() {
        let judge = |file: &str, name| configuration(Path::new(file), name).verdict;
        assert_eq!(judge("/etc/decant/lab.toml", "lab"), Verdict::Green);
        assert_eq!(judge("/etc/decant/lab2.toml", "lab"), Verdict::Red);
        assert_eq!(judge("config/cell.toml", "lab"), Verdict::Green, "no unit reads it");
    }
}
