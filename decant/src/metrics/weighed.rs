//! The pours that somebody weighed: how far each was from its goal.
//!
//! A thread of its own reads each episode once, and again when its file has changed; it allocates and waits for the disk. A file that cannot be
//! read is left out. Of a directory that cannot be read nothing is told.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, SystemTime};

use shared::episode::{Begun, Episode, beginning, by_age, episodes_so_far};

/// Pause between two looks at the episodes. Chosen by hand: weighing takes a person longer.
const LOOK: Duration = Duration::from_secs(10);
/// How long one sleep lasts, so that a request to end is seen. Chosen by hand; no measurement is recorded.
const BEAT: Duration = Duration::from_millis(100);
/// Number of newest episodes that are looked at. Chosen by hand: a lab's weeks, and some seconds to read.
pub const EPISODES: usize = 300;

/// When a file was written, and its length.
type Stamp = (Option<SystemTime>, u64);

/// What is known of one episode.
#[derive(Debug)]
struct Known {
    stamp: Stamp,
    /// Its number, and when it began.
    beginning: (Option<u64>, Option<SystemTime>),
    /// By how much it missed its goal, ml, if it is a weighed pour; `None` as long as it was not read, because it is none of the newest.
    error_ml: Option<Option<f64>>,
}

/// The weighed pours of the newest episodes; shared between threads.
#[derive(Debug, Default)]
pub struct Weighed {
    known: Mutex<BTreeMap<PathBuf, Known>>,
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
        Some(oldest_first(&known).into_iter().filter_map(|(_, known)| known.error_ml.flatten()).collect())
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
        let known = !locked().is_empty();
        let found = episodes_so_far(directory, known);
        self.unreadable.store(found.is_err(), Relaxed);
        let Ok(paths) = found else { return };
        let there: BTreeSet<&PathBuf> = paths.iter().collect();
        locked().retain(|path, _| there.contains(path));
        for path in paths {
            let Ok(meta) = path.metadata() else { continue };
            let stamp = (meta.modified().ok(), meta.len());
            if stop.load(Relaxed) || locked().get(&path).is_some_and(|known| known.stamp == stamp) {
                continue;
            }
            let beginning = beginning(&path);
            locked().insert(path, Known { stamp, beginning, error_ml: None });
        }
        let (older, newest): (Vec<PathBuf>, Vec<PathBuf>) = {
            let known = locked();
            let mut paths: Vec<PathBuf> = oldest_first(&known).into_iter().map(|(path, _)| path.clone()).collect();
            let newest = paths.split_off(paths.len().saturating_sub(EPISODES));
            (paths, newest)
        };
        for path in older {
            locked().entry(path).and_modify(|known| known.error_ml = None);
        }
        for path in newest {
            if stop.load(Relaxed) || locked().get(&path).is_none_or(|known| known.error_ml.is_some()) {
                continue;
            }
            let error_ml = Episode::read(&path).ok().filter(|e| e.complete).and_then(|e| e.error_ml());
            locked().entry(path).and_modify(|known| known.error_ml = Some(error_ml));
        }
    }
}

/// The episodes, the oldest first.
fn oldest_first(known: &BTreeMap<PathBuf, Known>) -> Vec<(&PathBuf, &Known)> {
    let all: Vec<_> = known.iter().collect();
    let begun: Vec<_> =
        all.iter().map(|(path, known)| Begun { path: path.as_path(), number: known.beginning.0, at: known.beginning.1 }).collect();
    by_age(&begun).into_iter().map(|i| all[i]).collect()
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
        let pour = |episode: u64, weight_g, wall_clock| {
            let kind = EpisodeKind::Pour { goal_ml: 50.0 };
            let start = EpisodeStart { episode, kind, started_at_ns: 1, wall_clock, config: &config, weights: "" };
            let mut writer = EpisodeWriter::create(dir.path(), &start).unwrap();
            let feature = Feature { captured_at_ns: 2, sequence: 1, ..Default::default() };
            writer.frame(&FrameRow { feature: &feature, alpha_commanded_deg: 0.0, alpha_measured_deg: 0.0, image: None }).unwrap();
            let path = writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 }).unwrap();
            set_weight(&path, weight_g).unwrap();
        };
        let now = SystemTime::now();
        pour(9999, 51.0, now);
        pour(10_000, 52.0, now);
        // A copy of an old one has a new number, and of a clock that goes back, the number still tells.
        pour(9998, 53.0, now - Duration::from_secs(1000));
        std::fs::rename(dir.path().join("episode-9998.mcap"), dir.path().join("episode-12000.mcap")).unwrap();
        pour(10_001, 54.0, now - Duration::from_secs(2000));
        for number in 0..EPISODES {
            std::fs::write(dir.path().join(format!("episode-{}.mcap", 9997 - number)), b"no episode").unwrap();
        }
        let weighed = Weighed::default();
        weighed.look(dir.path(), &AtomicBool::new(false));
        assert_eq!(weighed.errors_ml(), Some(vec![3.0, 1.0, 2.0, 4.0]));
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
