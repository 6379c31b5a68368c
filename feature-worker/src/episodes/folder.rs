//! How much the episodes of a directory take, against their budget and the disk. Nothing is changed.
//!
//! The recorder's thread looks at the directory whenever an episode's file is closed or given up; `decant doctor` also reads the first records of
//! what changed today. Both allocate. Nothing here fails: a file that cannot be looked at counts for nothing.

use std::fs::Metadata;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};

use shared::config::RecordingConfig;
use shared::episode::beginning;
use shared::plural::counted;

/// A megabyte, as in `recording.budget_mb`, bytes (SI).
pub const MEGABYTE: u64 = 1_000_000;
/// The time over which the present rate of recording is measured.
pub const DAY: Duration = Duration::from_secs(86_400);

/// The episodes of a directory, by their names alone.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Folder {
    /// Number of files.
    pub episodes: usize,
    /// Their size, bytes.
    pub bytes: u64,
}

/// The episodes of `directory` with their paths.
fn episodes(directory: &Path) -> impl Iterator<Item = (PathBuf, Metadata)> {
    let found = std::fs::read_dir(directory).into_iter().flatten().flatten();
    let found = found.filter_map(|entry| Some((entry.path(), entry.metadata().ok()?)));
    found.filter(|(path, meta)| meta.is_file() && path.extension().is_some_and(|x| x == "mcap"))
}

/// Size of the episodes of `directory` that were recorded within the last [`DAY`], bytes. A weight, a note or a copy gives an old episode's file a new
/// time, so what is in the file counts; only one that does not say it counts by the file's time. A time in the future, from a clock that went wrong, is
/// none of today.
pub fn recorded_today(directory: &Path) -> u64 {
    let is_today = |at: SystemTime| SystemTime::now().duration_since(at).is_ok_and(|age| age < DAY);
    let new = |(path, meta): &(PathBuf, Metadata)| meta.modified().is_ok_and(is_today) && beginning(path).1.is_none_or(is_today);
    episodes(directory).filter(new).map(|(_, meta)| meta.len()).sum()
}

impl Folder {
    /// Looks at `directory`. One that is not there holds no episode.
    pub fn look(directory: &Path) -> Self {
        Self::sum(episodes(directory).map(|(_, meta)| meta))
    }

    /// Looks at `files`. What is no regular file, or not there, is no episode.
    pub fn of<'a>(files: impl Iterator<Item = &'a Path>) -> Self {
        Self::sum(files.filter_map(|file| file.symlink_metadata().ok()).filter(Metadata::is_file))
    }

    fn sum(files: impl Iterator<Item = Metadata>) -> Self {
        files.fold(Self::default(), |sum, meta| Self { episodes: sum.episodes + 1, bytes: sum.bytes + meta.len() })
    }
}

/// What episodes may take together; 0 is no bound.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Budget {
    /// Bytes.
    pub bytes: u64,
    /// Number.
    pub episodes: usize,
}

impl Budget {
    /// That of a configuration.
    pub fn of(recording: &RecordingConfig) -> Self {
        Self { bytes: recording.budget_mb.saturating_mul(MEGABYTE), episodes: recording.budget_episodes }
    }

    /// Whether there is none.
    pub fn is_none(self) -> bool {
        self.bytes == 0 && self.episodes == 0
    }

    /// Whether so many episodes of so many bytes are within it.
    pub fn holds(self, episodes: usize, bytes: u64) -> bool {
        self.share(episodes, bytes) <= 1.0
    }

    /// How much of it so many episodes of so many bytes take; 1 is all of it.
    pub fn share(self, episodes: usize, bytes: u64) -> f64 {
        let of = |is: f64, may: f64| if may > 0.0 { is / may } else { 0.0 };
        of(bytes as f64, self.bytes as f64).max(of(episodes as f64, self.episodes as f64))
    }

    /// It in words, such as "500 episodes and 20000 MB".
    pub fn words(self) -> String {
        let number = (self.episodes > 0).then(|| counted(self.episodes, "episode"));
        let size = (self.bytes > 0).then(|| format!("{} MB", self.bytes / MEGABYTE));
        number.into_iter().chain(size).collect::<Vec<_>>().join(" and ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the figures that people clean up by: only episodes count, and a bound of 0 is none.
    #[test]
    fn a_folder_is_held_against_its_budget() {
        let dir = tempfile::tempdir().unwrap();
        let write = |name: &str, days: u64| {
            std::fs::write(dir.path().join(name), vec![0; 1_000_000]).unwrap();
            let file = std::fs::File::options().write(true).open(dir.path().join(name)).unwrap();
            file.set_modified(SystemTime::now() - DAY * days as u32).unwrap();
        };
        write("tomorrow.mcap", 0);
        let tomorrow = std::fs::File::options().append(true).open(dir.path().join("tomorrow.mcap")).unwrap();
        tomorrow.set_modified(SystemTime::now() + DAY).unwrap();
        assert_eq!(recorded_today(dir.path()), 0, "a clock that went wrong");
        std::fs::remove_file(dir.path().join("tomorrow.mcap")).unwrap();
        for (name, days) in [("a.mcap", 0), ("b.mcap", 3), ("c.mcap", 0), ("notes.txt", 0)] {
            write(name, days);
        }
        std::fs::create_dir(dir.path().join("d.mcap")).unwrap();
        let folder = Folder::look(dir.path());
        assert_eq!(folder, Folder { episodes: 3, bytes: 3_000_000 });
        assert_eq!(recorded_today(dir.path()), 2_000_000);
        assert_eq!(Folder::look(&dir.path().join("none")), Folder::default());
        let budget = |megabytes, episodes| Budget { bytes: megabytes * MEGABYTE, episodes };
        for (budget, holds) in
            [(budget(0, 0), true), (budget(3, 3), true), (budget(2, 0), false), (budget(0, 2), false), (budget(9, 2), false)]
        {
            assert_eq!(budget.holds(folder.episodes, folder.bytes), holds, "{budget:?}");
        }
        assert_eq!(budget(20, 7).words(), "7 episodes and 20 MB");
    }

    /// Protects who reads how long the disk lasts from work on old episodes: one that was recorded last week and weighed today is none of today.
    #[test]
    fn an_old_episode_that_is_weighed_is_not_new() {
        use shared::config::Config;
        use shared::episode::{EpisodeEnd, EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow, set_weight};
        use shared::messages::Feature;
        let config = Config::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let recorded = |episode, days| {
            let wall_clock = SystemTime::now() - DAY * days;
            let kind = EpisodeKind::Pour { goal_ml: 50.0 };
            let start = EpisodeStart { episode, kind, started_at_ns: 1, wall_clock, config: &config, weights: "" };
            let mut writer = EpisodeWriter::create(dir.path(), &start).unwrap();
            let feature = Feature { captured_at_ns: 2, sequence: 1, ..Default::default() };
            let row = FrameRow { feature: &feature, alpha_commanded_deg: 0.0, alpha_measured_deg: 0.0, image: None };
            writer.frame(&row).unwrap();
            let path = writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 }).unwrap();
            set_weight(&path, 40.0).unwrap();
            std::fs::metadata(path).unwrap().len()
        };
        recorded(1, 7);
        assert_eq!(recorded_today(dir.path()), 0);
        let new = recorded(2, 0);
        assert_eq!(recorded_today(dir.path()), new);
    }
}
