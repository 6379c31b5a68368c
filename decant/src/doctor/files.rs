//! Configuration, runtime directory, shared memory, weights, and room on the disk.
//!
//! Called once by an ordinary thread; allocates and reads the disk; nothing fails. Nothing is made or changed.

use std::io::ErrorKind;
use std::os::unix::fs::MetadataExt as _;
use std::path::{Path, PathBuf};

use feature_worker::episodes::folder::{Budget, Folder, MEGABYTE, recorded_today};
use rt_controller::foreseen::few_episodes;
use rt_controller::{claim, disk, journal_files, stop_client};
use shared::config::Config;
use shared::config_paths::is_same;
use shared::disk_space::{LEAST_FREE, Room, room};
use shared::episode::check_number;
use shared::framing::Framing;
use shared::machine::{Finding, Verdict};
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
/// What a disk without room for files means, in words; `df -i` shows it, and `df` free space.
const NO_FILES: &str = "the disk holds as many files as it may, whatever their size: nothing more is recorded";

/// Looks at the cell's files.
pub fn look(file: &Path, config: &Config) -> Vec<Finding> {
    let mut findings = vec![configuration(file, &config.cell.name)];
    findings.extend(shared_files(file, config));
    findings.push(controller(config));
    findings.push(shared_memory());
    findings.push(kept());
    findings.push(weights(file, config));
    let runs = matches!(stop_client::running_at(&Place::from(&config.cell)), Ok(Some(_)));
    findings.extend(config.controller.journal.as_deref().map(|file| journal(file, runs)));
    let folder = Folder::look(&config.recording.directory);
    findings.push(match (writable("episodes", &config.recording.directory), check_number(&config.recording.directory)) {
        (Err(finding), _) => finding,
        (Ok((there, _)), Err(e)) => {
            let advice = "look at .last-number there: give it to this user, or move it away if it is no file of Decant";
            Finding::red("episodes", format!("{}: {e}", there.display()), "no episode gets a number, so no pour begins", advice)
        }
        (Ok((there, room)), Ok(())) => episodes(&there, room, folder, recorded_today(&config.recording.directory)),
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

/// Another cell's configuration beside this one that uses a file of this one. Nobody notices it while only one of the two runs.
fn shared_files(file: &Path, config: &Config) -> Option<Finding> {
    let directory = file.parent().filter(|d| !d.as_os_str().is_empty()).unwrap_or(Path::new("."));
    let mut beside: Vec<PathBuf> = std::fs::read_dir(directory).ok()?.flatten().map(|e| e.path()).collect();
    beside.retain(|other| other.extension().is_some_and(|e| e == "toml"));
    beside.sort();
    let others = beside.iter().filter_map(|other| Some((other, Config::read(other).ok()?)));
    for (other, theirs) in others.filter(|(_, theirs)| theirs.cell.name != config.cell.name) {
        for (key, path) in claim::files(config) {
            if let Some((its, _)) = claim::files(&theirs).iter().find(|(_, p)| is_same(p, &path)) {
                let is = format!("{key} = {}, which {} has as {its}", path.display(), other.display());
                let means = "each cell exchanges the other's weights, or moves and deletes the other's files";
                return Some(Finding::red("configuration", is, means, "give each cell files of its own"));
            }
        }
    }
    None
}

/// Whether a controller of the cell runs, and if not, whether its runtime files have a place.
fn controller(config: &Config) -> Finding {
    let place = Place::from(&config.cell);
    let running = stop_client::running_at(&place);
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

/// What cells have in `/dev/shm`, whose it is, and whether it is in use.
fn kept() -> Finding {
    let (all, is_whole) = shared_memory::kept();
    let words = |k: &shared_memory::Kept| {
        let use_of_it = match k.in_use {
            Some(true) => "in use",
            Some(false) => "left by dead processes",
            None => "of which it cannot be seen from here whether it is in use",
        };
        format!("user {}: {} KiB {use_of_it}", k.uid, k.bytes / 1024)
    };
    let more = (!is_whole).then(|| "and more files than were looked at".to_owned());
    let list: Vec<String> = all.iter().map(words).chain(more).collect();
    let list = if list.is_empty() { "none".into() } else { list.join(", ") };
    if is_whole && all.iter().all(|k| k.uid == own_uid()) {
        // What this user's dead processes left goes by itself at the next start.
        return Finding::green("cells' shared memory", list);
    }
    let advice = "where no cell of theirs runs, that user or root may delete /dev/shm/decant-*";
    Finding::yellow("cells' shared memory", list, "others' takes room, and a cell of one name is another user's", advice)
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
            let method = serde_json::to_value(origin.method).ok().and_then(|name| Some(name.as_str()?.to_owned())).unwrap_or_default();
            let how = format!("trained from {} by method {method}", counted(origin.episodes, "episode"));
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
            if few_episodes(&weights).is_some() {
                let means = "a pour may be off by far more than the weights say";
                return Finding::yellow("weights", is, means, "weigh five episodes or more, and refine");
            }
            Finding::green("weights", is)
        }
        Err(e) => Finding::red("weights", e, "the controller refuses them, and nothing can be poured", train),
    }
}

/// How long the disk lasts: at the rate of the last day, or for how many episodes if there was none.
fn episodes(there: &Path, room: Room, folder: Folder, today: u64) -> Finding {
    let left = room.bytes.saturating_sub(LEAST_FREE);
    let one = folder.bytes.checked_div(folder.episodes as u64).map_or(EPISODE_BYTES, |mean| mean.max(1));
    let days = left as f64 / today as f64;
    let lasts = match today {
        0 => format!("room for {} more", (left / one).min(room.files)),
        new => format!("{days:.1} days at today's {} MB a day", new.div_ceil(MEGABYTE)),
    };
    let is = format!(
        "{}: {}, {} MB together; {} MB free, {lasts}",
        there.display(),
        counted(folder.episodes, "episode"),
        folder.bytes / MEGABYTE,
        room.bytes / MEGABYTE
    );
    let advice = "delete or move what is no longer needed (`decant episodes prune`)";
    let soon = "the disk will be full soon, and then nothing is recorded";
    match left {
        _ if room.lacks_files() => Finding::red("episodes", is, NO_FILES, advice),
        0 => Finding::red("episodes", is, "the disk is full: nothing more is recorded", advice),
        _ if today > 0 && days < LASTS_DAYS[1] => Finding::red("episodes", is, soon, advice),
        _ if today > 0 && days < LASTS_DAYS[0] => Finding::yellow("episodes", is, soon, advice),
        _ if left < EPISODES * one || room.files < EPISODES => Finding::yellow("episodes", is, soon, advice),
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

/// `directory`, or the first above it that is there, and what its disk still takes, if it may be written.
fn writable(what: &str, directory: &Path) -> Result<(PathBuf, Room), Finding> {
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
    room(&there).ok_or_else(unknown).map(|room| (there, room))
}

/// Whether the controller can begin the journal at `file`, and how long the disk lasts for it. One that `runs` writes there already.
fn journal(file: &Path, runs: bool) -> Finding {
    if let Err(e) = journal_files::check(file, !runs) {
        let advice = "give it to this user, remove it, end what writes it, or choose another controller.journal";
        return Finding::red("journal", e.to_string(), "the controller does not start", advice);
    }
    let directory = file.parent().unwrap_or(file);
    let (there, room) = match writable("journal", directory) {
        Ok(found) => found,
        Err(finding) => return finding,
    };
    let finding = journal_lasts(&there, room);
    // A controller makes it at its start; one that is deleted is made anew within seconds of rest.
    if runs && finding.verdict != Verdict::Red && file.symlink_metadata().is_err_and(|e| e.kind() == ErrorKind::NotFound) {
        let advice = "look at its line in `decant status`, and do not delete it while a controller runs";
        return Finding::yellow("journal", format!("{} is not there", file.display()), "a controller runs, and writes none", advice);
    }
    finding
}

/// How long a disk with so much `room` lasts for the journal `there`.
fn journal_lasts(there: &Path, room: Room) -> Finding {
    let free = room.bytes;
    let is = format!("{}: {} MB free, room for {}", there.display(), free / MEGABYTE, counted(free / (JOURNAL_HOUR_BYTES * 24), "day"));
    let advice = "delete or move what is no longer needed";
    match free {
        _ if room.lacks_files() => Finding::red("journal", is, NO_FILES, advice),
        0..JOURNAL_HOUR_BYTES => Finding::red("journal", is, "the disk is full: nothing more is recorded", advice),
        free if free < JOURNAL_HOUR_BYTES * 24 * DAYS => Finding::yellow("journal", is, "the disk will be full soon", advice),
        _ => Finding::green("journal", is),
    }
}

#[cfg(test)]
mod tests {
    use shared::disk_space::LEAST_FILES;

    use super::*;

    /// Protects who trusts a green line before a day of pours: a disk on which no file can be made is red however many bytes are free, and one that counts no
    /// files is judged by its bytes alone.
    #[test]
    fn a_disk_without_room_for_files_is_red() {
        let verdicts = |files| {
            let room = Room { bytes: 1 << 40, files };
            [episodes(Path::new("/"), room, Folder::default(), 0).verdict, journal_lasts(Path::new("/"), room).verdict]
        };
        assert_eq!(verdicts(LEAST_FILES - 1), [Verdict::Red; 2]);
        assert_eq!(verdicts(LEAST_FILES), [Verdict::Yellow, Verdict::Green], "each episode takes one");
        assert_eq!(verdicts(u64::MAX), [Verdict::Green; 2]);
    }

    /// Protects who looks for a crash in the journal: one that was deleted under a controller that runs is not green.
    #[test]
    fn a_journal_that_was_deleted_is_not_green() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("journal.bin");
        let judge = |runs| journal(&file, runs).is.contains("is not there");
        assert!(judge(true) && !judge(false));
        std::fs::write(&file, journal_files::MAGIC).unwrap();
        assert!(!judge(true));
    }

    /// Protects an installed cell whose file was copied and whose name was not changed: its units would run where no command looks.
    #[test]
    fn an_installed_cell_has_the_name_of_its_file() {
        let judge = |file: &str, name| configuration(Path::new(file), name).verdict;
        assert_eq!(judge("/etc/decant/lab.toml", "lab"), Verdict::Green);
        assert_eq!(judge("/etc/decant/lab2.toml", "lab"), Verdict::Red);
        assert_eq!(judge("config/cell.toml", "lab"), Verdict::Green, "no unit reads it");
    }

    /// Protects two cells' weights where only one runs at a time: a configuration that was copied for a second cell, and has the first one's files, is
    /// found.
    #[test]
    fn two_configurations_with_one_file_are_found() {
        let dir = tempfile::tempdir().unwrap();
        let text = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
        let [first, second] = ["first", "second"].map(|name| dir.path().join(format!("{name}.toml")));
        let write = |file: &Path, name: &str, weights: &str| {
            let mut config: toml::Table = text.parse().unwrap();
            config["cell"]["name"] = toml::Value::from(name);
            config["controller"]["weights"] = toml::Value::from(weights);
            config["controller"]["journal"] = toml::Value::from(format!("{name}-journal.bin"));
            config["recording"]["directory"] = toml::Value::from(format!("{name}-episodes"));
            std::fs::write(file, config.to_string()).unwrap();
        };
        let found = || shared_files(&second, &Config::read(&second).unwrap());
        write(&first, "first", "a.bin");
        write(&second, "second", "b.bin");
        assert_eq!(found().map(|f| f.is), None);
        write(&second, "first", "a.bin");
        assert_eq!(found().map(|f| f.is), None, "two configurations of one cell");
        write(&second, "second", "./x/../a.bin");
        let red = found().unwrap();
        assert!(red.verdict == Verdict::Red && red.is.starts_with("controller.weights = "), "{}", red.is);
    }
}
