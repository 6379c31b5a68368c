//! How much the episodes of a directory take, against their budget and the disk. Nothing is opened or changed.
//!
//! Used by the recorder's thread after each episode, and by `decant doctor`. Allocates and reads the directory. Nothing here fails: a file that
//! cannot be looked at counts for nothing.

use std::path::Path;
use std::time::{Duration, SystemTime};

use shared::config::RecordingConfig;
use shared::plural::counted;

/// A megabyte, as in `recording.budget_mb`, bytes (SI).
pub const MEGABYTE: u64 = 1_000_000;
/// What the recorder leaves free on the disk of the episodes, bytes. Chosen by hand: hours of the journal, and weights many times.
pub const LEFT_FREE: u64 = 64 * MEGABYTE;
/// The time over which the present rate of recording is measured.
pub const DAY: Duration = Duration::from_secs(86_400);

/// The episodes of a directory, by their names alone.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Folder {
    /// Number of files.
    pub episodes: usize,
    /// Their size, bytes.
    pub bytes: u64,
    /// Size of those that were written within the last [`DAY`], bytes.
    pub new_bytes: u64,
}

impl Folder {
    /// Looks at `directory`. One that is not there holds no episode.
    pub fn look(directory: &Path) -> Self {
        let mut folder = Self::default();
        for entry in std::fs::read_dir(directory).into_iter().flatten().flatten() {
            let Ok(meta) = entry.metadata() else { continue };
            if !meta.is_file() || entry.path().extension().is_none_or(|x| x != "mcap") {
                continue;
            }
            folder.episodes += 1;
            folder.bytes += meta.len();
            let age = meta.modified().ok().and_then(|at| SystemTime::now().duration_since(at).ok()).unwrap_or_default();
            folder.new_bytes += if age < DAY { meta.len() } else { 0 };
        }
        folder
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

    /// It in words, such as "500 episodes or 20000 MB".
    pub fn words(self) -> String {
        let number = (self.episodes > 0).then(|| counted(self.episodes, "episode"));
        let size = (self.bytes > 0).then(|| format!("{} MB", self.bytes / MEGABYTE));
        number.into_iter().chain(size).collect::<Vec<_>>().join(" or ")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the figures that people clean up by: only episodes count, those of today by themselves, and a bound of 0 is none.
    #[test]
    fn a_folder_is_held_against_its_budget() {
        let dir = tempfile::tempdir().unwrap();
        let write = |name: &str, days: u64| {
            std::fs::write(dir.path().join(name), vec![0; 1_000_000]).unwrap();
            let file = std::fs::File::options().write(true).open(dir.path().join(name)).unwrap();
            file.set_modified(SystemTime::now() - DAY * days as u32).unwrap();
        };
        for (name, days) in [("a.mcap", 0), ("b.mcap", 3), ("c.mcap", 0), ("notes.txt", 0)] {
            write(name, days);
        }
        std::fs::create_dir(dir.path().join("d.mcap")).unwrap();
        let folder = Folder::look(dir.path());
        assert_eq!(folder, Folder { episodes: 3, bytes: 3_000_000, new_bytes: 2_000_000 });
        assert_eq!(Folder::look(&dir.path().join("none")), Folder::default());
        let budget = |megabytes, episodes| Budget { bytes: megabytes * MEGABYTE, episodes };
        for (budget, holds) in
            [(budget(0, 0), true), (budget(3, 3), true), (budget(2, 0), false), (budget(0, 2), false), (budget(9, 2), false)]
        {
            assert_eq!(budget.holds(folder.episodes, folder.bytes), holds, "{budget:?}");
        }
        assert_eq!(budget(20, 7).words(), "7 episodes or 20 MB");
    }
}
