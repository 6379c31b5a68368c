//! The pours that somebody weighed: how far each was from its goal.
//!
//! A thread of its own reads each episode once, and again when its file has changed; it allocates and waits for the disk. A file that cannot be
//! read is left out. Of a directory that cannot be read nothing is told.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use shared::episode::{Episode, by_number, find_episodes};

/// Pause between two looks at the episodes. Chosen by hand: weighing takes a person longer.
const LOOK: Duration = Duration::from_secs(10);
/// How long one sleep lasts, so that a request to end is seen. Chosen by hand; no measurement is recorded.
const BEAT: Duration = Duration::from_millis(100);
/// Number of newest episodes that are looked at. Chosen by hand: a lab's weeks, and some seconds to read.
pub const EPISODES: usize = 300;

/// When a file was written, and its length.
type Stamp = (Option<SystemTime>, u64);

/// The weighed pours of the newest episodes; shared between threads.
#[derive(Debug, Default)]
pub struct Weighed {
    /// By how much each missed its goal, ml.
    known: Mutex<BTreeMap<PathBuf, (Stamp, Option<f64>)>>,
    /// Whether the directory cannot be read.
    unreadable: AtomicBool,
}

impl Weighed {
    /// By how much the weighed pours missed their goals, ml, the oldest first; those that ended early do not count. `None` if the episodes cannot be read.
    pub fn errors_ml(&self) -> Option<Vec<f64>> {
        if self.unreadable.load(Relaxed) {
            return None;
        }
        let known = self.known.lock().unwrap_or_else(PoisonError::into_inner);
        let mut errors_ml: Vec<(&PathBuf, f64)> = known.iter().filter_map(|(path, (_, error_ml))| Some((path, (*error_ml)?))).collect();
        errors_ml.sort_by(|(a, _), (b, _)| by_number(a, b));
        Some(errors_ml.into_iter().map(|(_, error_ml)| error_ml).collect())
    }

    /// Looks at the episodes in `directory` again and again, until `stop` is set.
    pub fn keep(&self, directory: &Path, stop: &AtomicBool) {
        while !stop.load(Relaxed) {
            self.look(directory, stop);
            for _ in 0..LOOK.as_millis() / BEAT.as_millis() {
                if stop.load(Relaxed) {
                    return;
                }
                std::thread::sleep(BEAT);
            }
        }
    }

    /// Reads what is new in `directory`.
    pub fn look(&self, directory: &Path, stop: &AtomicBool) {
        let locked = || self.known.lock().unwrap_or_else(PoisonError::into_inner);
        let found = match directory.read_dir() {
            // Nothing has been recorded yet.
            Err(e) if e.kind() == ErrorKind::NotFound && locked().is_empty() => Some(Vec::new()),
            Err(_) => None,
            Ok(_) => find_episodes(&[directory.to_path_buf()]).ok(),
        };
        self.unreadable.store(found.is_none(), Relaxed);
        let Some(mut paths) = found else { return };
        // They are in the order of their numbers, which only grow.
        let newest = paths.split_off(paths.len().saturating_sub(EPISODES));
        locked().retain(|path, _| newest.contains(path));
        for path in newest {
            let Ok(meta) = path.metadata() else { continue };
            let stamp = (meta.modified().ok(), meta.len());
            if stop.load(Relaxed) || locked().get(&path).is_some_and(|(seen, _)| *seen == stamp) {
                continue;
            }
            let error_ml = Episode::read(&path).ok().filter(|e| e.complete).and_then(|e| e.error_ml());
            locked().insert(path, (stamp, error_ml));
        }
    }
}

#[cfg(test)]
mod tests {
    use shared::config::Config;
    use shared::episode::{EpisodeEnd, EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow, set_weight};
    use shared::messages::Feature;

    use super::*;

    /// Protects who watches the errors of a cell that has poured for years: as text, the ten thousandth episode is older than the second, and it must
    /// neither fall out of the newest ones nor stand before others.
    #[test]
    fn the_ten_thousandth_pour_is_the_newest() {
        let config = Config::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let pour = |episode: u64, weight_g| {
            let kind = EpisodeKind::Pour { goal_ml: 50.0 };
            let wall_clock = SystemTime::now();
            let start = EpisodeStart { episode, kind, started_at_ns: 1, wall_clock, config: &config, weights: "" };
            let mut writer = EpisodeWriter::create(dir.path(), &start).unwrap();
            let feature = Feature { captured_at_ns: 2, sequence: 1, ..Default::default() };
            writer.frame(&FrameRow { feature: &feature, alpha_commanded_deg: 0.0, alpha_measured_deg: 0.0, image: None }).unwrap();
            let path = writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 }).unwrap();
            set_weight(&path, weight_g).unwrap();
        };
        pour(9999, 51.0);
        pour(10_000, 52.0);
        for number in 0..EPISODES {
            std::fs::write(dir.path().join(format!("episode-{}.mcap", 9998 - number)), b"no episode").unwrap();
        }
        let weighed = Weighed::default();
        weighed.look(dir.path(), &AtomicBool::new(false));
        assert_eq!(weighed.errors_ml(), Some(vec![1.0, 2.0]));
    }

    /// Protects who watches a cell whose disk went away: that nothing can be read is not that nothing was weighed.
    #[test]
    fn a_directory_that_is_gone_is_not_empty() {
        let dir = tempfile::tempdir().unwrap();
        let (weighed, stop, directory) = (Weighed::default(), AtomicBool::new(false), dir.path().join("episodes"));
        weighed.look(&directory, &stop);
        assert_eq!(weighed.errors_ml(), Some(Vec::new()), "nothing has been recorded yet");
        std::fs::create_dir(&directory).unwrap();
        std::fs::write(directory.join("episode-0001.mcap"), b"no episode").unwrap();
        weighed.look(&directory, &stop);
        std::fs::remove_dir_all(&directory).unwrap();
        weighed.look(&directory, &stop);
        assert_eq!(weighed.errors_ml(), None);
    }
}
