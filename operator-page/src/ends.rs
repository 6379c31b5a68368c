//! How pours and recordings ended, by the names of their files: what the controller said, kept in a file, so that a page that is started
//! again still knows it.
//!
//! Behind its user's lock, on ordinary threads; it allocates, writes a small file when something new has ended, and remembers the newest
//! `ENDS_MAX`. A file that cannot be read or written costs nothing but the reasons from before: then the table says what the recorder wrote.

use std::collections::BTreeMap;
use std::path::PathBuf;

use serde::{Deserialize, Serialize};
use shared::control::Outcome;
use shared::episode::by_number;
use shared::{regular_file, whole_file};

/// Number of episodes whose ends are remembered. Chosen by hand: some days of a lab.
const ENDS_MAX: usize = 2000;
/// Version of the file; one of another version is not read, and written anew.
const VERSION: u32 = 1;
/// Largest file that is read, bytes: twice what `ENDS_MAX` long lines take.
const FILE_MAX: u64 = 1 << 20;

/// How one episode ended.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
pub struct End {
    /// Why, in the controller's words.
    pub reason: String,
    /// The volume poured by the estimate, ml with its deviation; none of a recorded curve.
    pub poured: Option<String>,
}

/// The file.
#[derive(Default, Serialize, Deserialize)]
struct Kept {
    version: u32,
    ends: BTreeMap<String, End>,
}

/// The ends of one cell's episodes.
#[derive(Debug, Default, Clone)]
pub struct Ends {
    file: Option<PathBuf>,
    by_name: BTreeMap<String, End>,
}

impl Ends {
    /// The ends that `file` keeps.
    pub fn of_file(file: PathBuf) -> Self {
        let text = regular_file::read(&file, FILE_MAX).unwrap_or_default();
        let kept = serde_json::from_slice::<Kept>(&text).ok().filter(|k| k.version == VERSION);
        Self { file: Some(file), by_name: kept.unwrap_or_default().ends }
    }

    /// Remembers what has ended, where the recorder has said which file it is in. A file's own number may be another one than the controller
    /// gave, so it is not gone by.
    pub fn remember(&mut self, outcomes: &[Outcome], files: &BTreeMap<u64, Result<String, String>>) {
        let mut changed = false;
        for o in outcomes {
            let file = files.get(&o.episode).and_then(|f| f.as_ref().ok()).and_then(|path| path.rsplit('/').next());
            let Some(name) = file else { continue };
            let end = End { reason: o.words().into(), poured: o.goal_ml.is_some().then(|| o.poured_words()) };
            if self.by_name.get(name) != Some(&end) {
                self.by_name.insert(name.into(), end);
                changed = true;
            }
        }
        while self.by_name.len() > ENDS_MAX {
            let oldest = self.by_name.keys().min_by(|a, b| by_number(a.as_ref(), b.as_ref())).cloned();
            self.by_name.remove(&oldest.unwrap_or_default());
        }
        if changed {
            self.write();
        }
    }

    /// How the episode in the file `name` ended, if that is known.
    pub fn of(&self, name: &str) -> Option<&End> {
        self.by_name.get(name)
    }

    fn write(&self) {
        let Some(file) = &self.file else { return };
        let kept = Kept { version: VERSION, ends: self.by_name.clone() };
        // What cannot be kept is still known until this program ends.
        let _ = serde_json::to_vec(&kept).map(|text| whole_file::replace(file, &text, b""));
    }
}

#[cfg(test)]
mod tests {
    use shared::control::EndReason;
    use shared::limits::Clipped;

    use super::*;

    fn outcome(episode: u64, goal_ml: Option<f32>) -> Outcome {
        Outcome {
            episode,
            reason: EndReason::Aborted,
            unseen: false,
            unwatched: false,
            goal_ml,
            poured_ml: 41.0,
            poured_sd_ml: 1.5,
            seconds: 4.0,
            frames: 120,
            bridged_frames: 0,
            stale_features: 0,
            tick_gaps: 0,
            clipped: Clipped::default(),
        }
    }

    /// Protects whoever asks next week why a pour ended: a page that is started again says the same, of this episode and no other; a file
    /// that is none is written anew, and no more than so many are kept.
    #[test]
    fn a_page_that_is_started_again_knows_why() {
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("ends.json");
        let files: BTreeMap<u64, Result<String, String>> =
            [(7, Ok("/data/episode-0009.mcap".into())), (8, Ok("episode-0010.mcap".into())), (9, Err("no space".into()))].into();
        for garbage in ["", "no JSON", "{\"version\":9,\"ends\":{\"episode-0009.mcap\":{\"reason\":\"x\",\"poured\":null}}}"] {
            std::fs::write(&file, garbage).unwrap();
            let mut ends = Ends::of_file(file.clone());
            assert_eq!(ends.of("episode-0009.mcap"), None);
            ends.remember(&[outcome(7, Some(90.0)), outcome(8, None), outcome(9, Some(90.0))], &files);
        }
        let again = Ends::of_file(file.clone());
        let end = again.of("episode-0009.mcap").unwrap();
        let poured = outcome(7, Some(90.0)).poured_words();
        assert_eq!((end.reason.as_str(), end.poured.as_ref()), (EndReason::Aborted.words(), Some(&poured)));
        assert_eq!(again.of("episode-0010.mcap").unwrap().poured, None);
        assert!(again.of("episode-0007.mcap").is_none(), "a number is not gone by");
        let mut many = Ends::of_file(file);
        // They end beyond the ten thousandth, which as text is older than the second.
        let numbers = 10_009 - ENDS_MAX as u64 - 9..10_009;
        let files = numbers.clone().map(|n| (n, Ok(format!("episode-{n:04}.mcap")))).collect();
        many.remember(&numbers.map(|n| outcome(n, Some(90.0))).collect::<Vec<_>>(), &files);
        let kept =
            ["episode-0009.mcap", "episode-8000.mcap", "episode-9999.mcap", "episode-10008.mcap"].map(|name| many.of(name).is_some());
        assert_eq!(kept, [false, false, true, true]);
    }
}
