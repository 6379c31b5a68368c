//! The recorded episodes: a table that grows as files appear, and one episode's rows and pictures.
//!
//! A thread of its own looks at the directory and reads each new or changed file once; other threads read the table under a lock. Allocates;
//! the pictures of at most `OPEN` episodes are kept, and of each at most `PICTURES_MAX`. A file that cannot be read stays in the table
//! with the reason.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::hash::{DefaultHasher, Hash as _, Hasher as _};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant, SystemTime};

use feature_worker::episodes::summary::{remarks, summary};
use serde_json::{Value, json};
use shared::episode::{Begun, Episode, EpisodeImages, by_age, by_number, episodes_so_far};
use shared::regular_file;

use crate::ends::Ends;
use crate::lock::locked;

/// Pause between two looks at the directory. Chosen by hand: a person waits for a new episode no longer.
const BEAT: Duration = Duration::from_millis(500);
/// Longest wait for files that are still to be read, where all of them count. Chosen by hand: a new one takes some ms, and a person waits no longer.
const READING: Duration = Duration::from_secs(3);
/// Number of episodes whose pictures are kept. Chosen by hand: two browsers, one each.
const OPEN: usize = 2;
/// Largest sum of the pictures that are kept of an episode, bytes. Chosen by hand: 30 s at 640 x 480 px take a quarter.
const PICTURES_MAX: usize = 128 << 20;

/// A file's time and length: when they change, it is read again.
type Stamp = (Option<SystemTime>, u64);

/// One line of the table.
struct Line {
    stamp: Stamp,
    value: Value,
}

/// The pictures of one episode.
struct Pictures {
    name: String,
    stamp: Stamp,
    /// Frame numbers (their low 32 bits) and pictures.
    all: Vec<(u32, Vec<u8>)>,
}

/// The episodes of one directory.
pub struct History {
    directory: PathBuf,
    table: Mutex<BTreeMap<String, Line>>,
    unread: Mutex<Option<usize>>,
    /// Why the directory cannot be read; empty if it can.
    fault: Mutex<String>,
    open: Mutex<Vec<Arc<Pictures>>>,
    weighing: Mutex<()>,
}

fn stamp(path: &Path) -> Stamp {
    fs::metadata(path).map_or((None, 0), |m| (m.modified().ok(), m.len()))
}

/// The last part of a path.
fn name_of(path: &Path) -> String {
    path.file_name().unwrap_or_default().to_string_lossy().into_owned()
}

/// One line of the table, from its file.
fn line(path: &Path) -> Value {
    let name = name_of(path);
    match Episode::read(path) {
        Err(e) => json!({ "file": name, "error": e.to_string() }),
        Ok(episode) => {
            let mut all = summary(&episode);
            let about = remarks(&episode);
            let texts = |wrong| about.iter().filter(|r| r.is_wrong == wrong).map(|r| r.text.as_str()).collect::<Vec<_>>();
            all["file"] = json!(name);
            all["error_ml"] = json!(episode.error_ml());
            all["poured_ml"] = json!(episode.info.poured_ml);
            all["wrong"] = json!(texts(true));
            all["notes"] = json!(texts(false));
            all
        }
    }
}

impl History {
    /// The episodes of `directory`.
    pub fn new(directory: PathBuf) -> Self {
        Self {
            directory,
            table: Mutex::default(),
            unread: Mutex::default(),
            fault: Mutex::default(),
            open: Mutex::default(),
            weighing: Mutex::default(),
        }
    }

    /// Keeps the table until `stop` is set.
    pub fn keep(&self, stop: &AtomicBool) {
        while !stop.load(Relaxed) {
            let Some(files) = self.files() else {
                std::thread::sleep(BEAT);
                continue;
            };
            let known = |file: &PathBuf| locked(&self.table).get(&name_of(file)).is_some_and(|l| l.stamp == stamp(file));
            let new: Vec<&PathBuf> = files.iter().filter(|f| !known(f)).collect();
            for (done, file) in new.iter().enumerate() {
                *locked(&self.unread) = Some(new.len() - done);
                if stop.load(Relaxed) {
                    return;
                }
                let (stamp, value) = (stamp(file), line(file));
                locked(&self.table).insert(name_of(file), Line { stamp, value });
            }
            *locked(&self.unread) = Some(0);
            locked(&self.table).retain(|name, _| files.iter().any(|f| name_of(f) == *name));
            std::thread::sleep(BEAT);
        }
    }

    /// The files in the directory. None if it cannot be read: then the table stays as it was, and the reason is kept. A directory that is not there
    /// yet, because nothing has been recorded, is empty.
    fn files(&self) -> Option<Vec<PathBuf>> {
        let known = !locked(&self.table).is_empty();
        let found = episodes_so_far(&self.directory, known);
        let fault = |e| format!("the episodes in {} cannot be read ({e}): look at the disk", self.directory.display());
        *locked(&self.fault) = found.as_ref().err().map(fault).unwrap_or_default();
        found.ok().map(|files| files.into_iter().filter(|f| f.symlink_metadata().is_ok()).collect())
    }

    /// Why nothing can be said of the episodes, if that is so. Files that are still to be read are waited for, for a moment.
    fn readable(&self) -> Result<(), String> {
        let asked = Instant::now();
        loop {
            let fault = locked(&self.fault).clone();
            if !fault.is_empty() {
                return Err(fault);
            }
            let unread = *locked(&self.unread);
            if unread == Some(0) {
                return Ok(());
            }
            if asked.elapsed() > READING {
                let files = unread.map_or("all episodes".into(), |n| format!("{n} episodes"));
                return Err(format!("there are {files} still to be read: try again in a moment"));
            }
            std::thread::sleep(BEAT / 10);
        }
    }

    /// The table in the order of the files' numbers, and how many files are still to be read. `ends` says how episodes ended.
    pub fn table(&self, ends: &Ends) -> Value {
        let with_end = |(name, line): (&String, &Line)| {
            let mut value = line.value.clone();
            if let Some(end) = ends.of(name) {
                value["reason"] = json!(end.reason);
                value["estimate"] = json!(end.poured.as_ref().map(|poured| format!("{poured} ml")));
            }
            value
        };
        let table = locked(&self.table);
        let mut lines: Vec<(&String, &Line)> = table.iter().collect();
        lines.sort_by(|(a, _), (b, _)| by_number(a.as_ref(), b.as_ref()));
        let lines: Vec<Value> = lines.into_iter().map(with_end).collect();
        json!({ "episodes": lines, "unread": locked(&self.unread).unwrap_or(0), "directory": self.directory.display().to_string(), "fault": *locked(&self.fault) })
    }

    /// A word that changes when the table does: from all names and stamps, how much is unread, and why the directory cannot be read.
    pub fn version(&self) -> String {
        let mut hash = DefaultHasher::new();
        for (name, line) in &*locked(&self.table) {
            (name, line.stamp).hash(&mut hash);
        }
        (*locked(&self.unread), &*locked(&self.fault)).hash(&mut hash);
        format!("{:016x}", hash.finish())
    }

    /// The path of the episode that the page calls `name`; an error if there is none.
    pub fn path(&self, name: &str) -> Result<PathBuf, String> {
        let known = locked(&self.table).contains_key(name);
        let path = self.directory.join(name);
        if known || (name_of(&path) == name && name.ends_with(".mcap") && path.is_file()) {
            Ok(path)
        } else {
            Err("there is no such episode any more: load the page again".into())
        }
    }

    /// The files that can be learned from, oldest first: weighed, readable, and with nothing wrong about them, which the table says of the others; with
    /// `last`, only that many of them.
    pub fn weighed(&self, last: Option<usize>) -> Vec<PathBuf> {
        let table = locked(&self.table);
        let wrong = |l: &Line| l.value["wrong"].as_array().is_some_and(|wrong| !wrong.is_empty());
        let lines = table.iter().filter(|(_, l)| l.value["weight_g"].is_number() && l.value["error"].is_null() && !wrong(l));
        let (mut paths, lines): (Vec<_>, Vec<_>) = lines.map(|(name, line)| (self.directory.join(name), &line.value)).unzip();
        let begun = paths.iter().zip(&lines).map(|(path, line)| Begun {
            path,
            number: line["number"].as_u64(),
            at: line["started_at_utc"].as_str().unwrap_or(""),
        });
        let order = by_age(&begun.collect::<Vec<_>>());
        let skipped = last.map_or(0, |n| order.len().saturating_sub(n));
        order.into_iter().skip(skipped).map(|i| std::mem::take(&mut paths[i])).collect()
    }

    /// What a training learns from; an error if the directory cannot be read.
    pub fn to_learn(&self, last: Option<usize>) -> Result<Vec<PathBuf>, String> {
        self.readable()?;
        Ok(self.weighed(last))
    }

    /// The weight of the episode `name`, g, as it was when it was read last.
    pub fn weight_g(&self, name: &str) -> Option<f64> {
        locked(&self.table).get(name).and_then(|l| l.value["weight_g"].as_f64())
    }

    /// Whoever holds it is the only one who weighs.
    pub fn turn(&self) -> MutexGuard<'_, ()> {
        locked(&self.weighing)
    }

    /// By how much the weighed pours with the weights `identity` missed their goals, ml; those that ended early do not count.
    pub fn errors_ml(&self, identity: &str) -> Vec<f64> {
        let table = locked(&self.table);
        table.values().filter(|l| l.value["weights"] == identity).filter_map(|l| l.value["error_ml"].as_f64()).collect()
    }

    /// Reads the episode `name` again at once, so that what is asked next knows what was just written into it.
    pub fn refresh(&self, name: &str) {
        let path = self.directory.join(name);
        let (stamp, value) = (stamp(&path), line(&path));
        locked(&self.table).insert(name.into(), Line { stamp, value });
    }

    /// What a plan is made from: the weighed files, or else a directory in which no episode is.
    pub fn for_plan(&self) -> Result<Vec<PathBuf>, String> {
        self.readable()?;
        let weighed = self.weighed(None);
        if !weighed.is_empty() {
            return Ok(weighed);
        }
        let none = self.exports();
        fs::create_dir_all(&none).map_err(|e| format!("{}: {e}", none.display()))?;
        Ok(vec![none])
    }

    /// Where exports are written.
    pub fn exports(&self) -> PathBuf {
        self.directory.join("exports")
    }

    /// The file for a reader's disk.
    pub fn open_file(&self, name: &str) -> Result<File, String> {
        let path = self.path(name)?;
        regular_file::open(&path).map(|(file, _)| file).map_err(|e| format!("{}: {e}", path.display()))
    }

    /// One episode's rows for a plot, column by column.
    pub fn rows(&self, name: &str) -> Result<Value, String> {
        let episode = Episode::read(&self.path(name)?).map_err(|e| e.to_string())?;
        let column = |of: fn(&shared::episode::EpisodeRow) -> Value| episode.rows.iter().map(of).collect::<Vec<_>>();
        Ok(json!({
            "file": name,
            "t_s": column(|r| json!(r.t_s)),
            "sequence": column(|r| json!(r.sequence)),
            "alpha_deg": column(|r| json!(r.alpha_commanded_deg)),
            "alpha_measured_deg": column(|r| json!(r.alpha_measured_deg)),
            "area_px2": column(|r| json!(r.area_px2)),
            "doubt": column(|r| json!(if r.lost { "frame lost" } else { r.doubt.words() })),
        }))
    }

    /// One episode as a table of commas, one row a frame.
    pub fn csv(&self, name: &str) -> Result<String, String> {
        let episode = Episode::read(&self.path(name)?).map_err(|e| e.to_string())?;
        let mut text = String::from("sequence,captured_at_ns,t_s,alpha_commanded_deg,alpha_measured_deg,area_px2,doubt,lost\n");
        let number = |v: f32| if v.is_finite() { v.to_string() } else { String::new() };
        for r in &episode.rows {
            let (alpha, measured, area) = (number(r.alpha_commanded_deg), number(r.alpha_measured_deg), number(r.area_px2));
            let line = format!("{},{},{},{alpha},{measured},{area},{},{}\n", r.sequence, r.captured_at_ns, r.t_s, r.doubt.words(), r.lost);
            text.push_str(&line);
        }
        Ok(text)
    }

    /// The picture of the frame `sequence`; if it has none, the nearest one before it, or else the first. The number, its low 32 bits, says which
    /// it is.
    pub fn picture(&self, name: &str, sequence: u64) -> Result<(u32, Vec<u8>), String> {
        let path = self.path(name)?;
        let now = stamp(&path);
        let found = locked(&self.open).iter().find(|p| p.name == name && p.stamp == now).cloned();
        let pictures = match found {
            Some(pictures) => pictures,
            None => {
                let pictures = Arc::new(read_pictures(&path, name, now)?);
                let mut open = locked(&self.open);
                if open.len() >= OPEN {
                    open.remove(0);
                }
                open.push(Arc::clone(&pictures));
                pictures
            }
        };
        let sequence = sequence as u32;
        let before = pictures.all.partition_point(|(number, _)| *number <= sequence);
        pictures.all.get(before.saturating_sub(1)).cloned().ok_or_else(|| "this episode has no pictures".into())
    }
}

fn read_pictures(path: &Path, name: &str, stamp: Stamp) -> Result<Pictures, String> {
    let mut all = Vec::new();
    let mut bytes = 0;
    for image in EpisodeImages::open(path).map_err(|e| e.to_string())? {
        let image = image.map_err(|e| e.to_string())?;
        bytes += image.data.len();
        if bytes > PICTURES_MAX {
            break;
        }
        all.push((image.sequence, image.data));
    }
    all.sort_unstable_by_key(|(sequence, _)| *sequence);
    Ok(Pictures { name: name.into(), stamp, all })
}

#[cfg(test)]
mod tests {
    use shared::episode::{EpisodeEnd, EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow, PART_UNSEEN, set_weight};
    use shared::messages::{Doubt, Feature, LAYOUT_VERSION, Telemetry};

    use super::*;

    /// Protects who weighs what was poured last: the page lists the newest first, also beyond the ten thousandth.
    #[test]
    fn the_table_is_in_the_order_of_numbers() {
        let dir = tempfile::tempdir().unwrap();
        let history = History::new(dir.path().to_path_buf());
        let names = ["episode-0001.mcap", "episode-9999.mcap", "episode-10000.mcap"];
        for name in names {
            fs::write(dir.path().join(name), "no episode").unwrap();
            history.refresh(name);
        }
        let table = history.table(&Ends::default());
        let listed: Vec<&str> = table["episodes"].as_array().unwrap().iter().map(|e| e["file"].as_str().unwrap()).collect();
        assert_eq!(listed, names);
    }

    /// Protects who learns from the newest episodes on a machine whose clock was put right: the numbers tell which they are.
    #[test]
    fn the_newest_are_those_with_the_largest_numbers() {
        let dir = tempfile::tempdir().unwrap();
        let history = History::new(dir.path().to_path_buf());
        for (number, started_at_utc) in [(1, "2026-11-26T10:00:00Z"), (2, "2031-01-01T00:00:00Z"), (3, "2026-11-26T11:00:00Z")] {
            let value = json!({ "number": number, "started_at_utc": started_at_utc, "weight_g": 50.0, "wrong": [] });
            locked(&history.table).insert(format!("episode-{number:04}.mcap"), Line { stamp: (None, 0), value });
        }
        let newest: Vec<_> = ["episode-0002.mcap", "episode-0003.mcap"].map(|name| dir.path().join(name)).into();
        assert_eq!(history.weighed(Some(2)), newest);
    }

    /// Protects who learns just after the start: the newest of the episodes that were read so far are not the newest ones.
    #[test]
    fn what_is_half_read_is_not_learned_from() {
        let dir = tempfile::tempdir().unwrap();
        let history = History::new(dir.path().to_path_buf());
        for (unread, says) in [(None, Some("all episodes")), (Some(3), Some("3 episodes")), (Some(0), None)] {
            *locked(&history.unread) = unread;
            match says {
                Some(says) => assert!(history.to_learn(Some(5)).unwrap_err().contains(says)),
                None => assert!(history.to_learn(Some(5)).is_ok() && history.for_plan().is_ok()),
            }
        }
    }

    /// Protects who judges weights by the scale: a pour that was stopped at 10 of 100 ml is no error of 90 ml, in the table and before the next pour; one that
    /// gave more than its goal although its stream was lost is an error.
    #[test]
    fn a_pour_that_was_stopped_is_no_error() {
        let config = shared::config::Config::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let history = History::new(dir.path().to_path_buf());
        for (episode, (poured_ml, weight_g)) in (1..).zip([(99.0, 101.0), (10.0, 12.0), (91.0, 130.0), (130.0, 140.0)]) {
            let (kind, wall_clock) = (EpisodeKind::Pour { goal_ml: 100.0 }, SystemTime::UNIX_EPOCH);
            let start = EpisodeStart { episode, kind, started_at_ns: 1, wall_clock, config: &config, weights: "them" };
            let mut writer = EpisodeWriter::create(dir.path(), &start).unwrap();
            let version = LAYOUT_VERSION;
            writer.telemetry(&Telemetry { version, tick: 1, at_ns: 2, poured_ml, ..Default::default() }).unwrap();
            let feature = Feature { version, captured_at_ns: 2, sequence: 1, ..Default::default() };
            writer.frame(&FrameRow { feature: &feature, alpha_commanded_deg: 0.0, alpha_measured_deg: 0.0, image: None }).unwrap();
            let path = writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 }).unwrap();
            set_weight(&path, weight_g).unwrap();
            history.refresh(&name_of(&path));
        }
        assert_eq!(history.errors_ml("them"), [1.0, 30.0, 40.0]);
        let table = history.table(&Ends::default());
        let shown: Vec<Option<f64>> = table["episodes"].as_array().unwrap().iter().map(|e| e["error_ml"].as_f64()).collect();
        assert_eq!(shown, [Some(1.0), None, Some(30.0), Some(40.0)]);
    }

    /// Protects browsers from a table of yesterday: a file that changes is seen although another one has a time in the future, and so is one that takes
    /// the place of another.
    #[test]
    fn each_change_of_a_file_is_seen() {
        let dir = tempfile::tempdir().unwrap();
        let history = History::new(dir.path().to_path_buf());
        let write = |name: &str, text: &str| {
            fs::write(dir.path().join(name), text).unwrap();
            history.refresh(name);
            history.version()
        };
        write("episode-0001.mcap", "from tomorrow");
        let tomorrow = SystemTime::now() + Duration::from_secs(86400);
        File::options().append(true).open(dir.path().join("episode-0001.mcap")).unwrap().set_modified(tomorrow).unwrap();
        history.refresh("episode-0001.mcap");
        let before = write("episode-0002.mcap", "not weighed");
        assert_ne!(write("episode-0002.mcap", "weighed now"), before);
    }

    /// Protects who learns from a disk that has gone: a directory that cannot be read is no empty one, what was known of it stays, and nothing is
    /// planned or learned. One that is not there yet is empty.
    #[test]
    fn a_directory_that_cannot_be_read_is_not_empty() {
        let dir = tempfile::tempdir().unwrap();
        let episodes = dir.path().join("episodes");
        let history = History::new(episodes.clone());
        let look = || history.files();
        assert_eq!((look(), history.table(&Ends::default())["fault"].clone()), (Some(Vec::new()), json!("")));
        fs::create_dir(&episodes).unwrap();
        fs::write(episodes.join("episode-0001.mcap"), "no episode").unwrap();
        history.refresh("episode-0001.mcap");
        assert_eq!(look().map(|files| files.len()), Some(1));
        let version = history.version();
        fs::rename(&episodes, dir.path().join("away")).unwrap();
        assert_eq!(look(), None);
        assert_ne!(history.version(), version, "browsers hear of it");
        let table = history.table(&Ends::default());
        assert_eq!(table["episodes"].as_array().unwrap().len(), 1);
        assert!(table["fault"].as_str().unwrap().contains("cannot be read"), "{table}");
        assert!(history.for_plan().unwrap_err().contains("cannot be read") && history.to_learn(None).is_err());
        assert!(!episodes.exists(), "nobody makes it anew");
        // A file in its place is no directory either.
        fs::write(&episodes, "a file").unwrap();
        assert_eq!(look(), None);
    }

    /// Protects what is learned on the page from a weighed pour of which the camera missed a part: the table says what is wrong about it, and it is not
    /// learned from, nor does it count among the last ones. What it misses of an upright container are drops.
    #[test]
    fn a_pour_that_was_not_seen_whole_is_not_learned_from() {
        const FRAME_NS: u64 = 33_333_333;
        let dir = tempfile::tempdir().unwrap();
        let history = History::new(dir.path().to_path_buf());
        let config = shared::config::Config::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
        for (k, (blind, alpha_commanded_deg)) in [(0..0, 40.0), (40..46, 40.0), (40..47, 40.0), (40..47, 0.5)].into_iter().enumerate() {
            let kind = EpisodeKind::Pour { goal_ml: 50.0 };
            let wall_clock = SystemTime::UNIX_EPOCH + Duration::from_secs(k as u64);
            let start = EpisodeStart { episode: 1, kind, started_at_ns: FRAME_NS, wall_clock, config: &config, weights: "" };
            let mut writer = EpisodeWriter::create(dir.path(), &start).unwrap();
            for frame in 1..90 {
                let at_ns = frame * FRAME_NS;
                let doubt = if blind.contains(&frame) { Doubt::EdgeNotFound } else { Doubt::None };
                let area_px2 = if (20..80).contains(&frame) { 500.0 + k as f32 } else { 0.0 };
                let version = LAYOUT_VERSION;
                let feature =
                    Feature { version, sequence: frame, captured_at_ns: at_ns, area_px2, doubt: doubt as u32, ..Default::default() };
                writer.telemetry(&Telemetry { version, tick: frame, at_ns, ..Default::default() }).unwrap();
                let row = FrameRow { feature: &feature, alpha_commanded_deg, alpha_measured_deg: f32::NAN, image: None };
                writer.frame(&row).unwrap();
            }
            let path = writer.path().to_path_buf();
            writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 }).unwrap();
            set_weight(&path, 50.0).unwrap();
            history.refresh(&name_of(&path));
        }
        let names = |last| history.weighed(last).iter().map(|path| name_of(path)).collect::<Vec<_>>();
        assert_eq!(names(None), ["episode-0001.mcap", "episode-0002.mcap", "episode-0004.mcap"]);
        assert_eq!(names(Some(2)), ["episode-0002.mcap", "episode-0004.mcap"]);
        let table = history.table(&Ends::default());
        let wrong: Vec<&Value> = table["episodes"].as_array().unwrap().iter().map(|e| &e["wrong"]).collect();
        assert_eq!(wrong, [&json!([]), &json!([]), &json!([PART_UNSEEN]), &json!([])]);
    }

    /// Protects who looks back from another moment's picture: each picture says of which frame it is.
    #[test]
    fn a_picture_says_which_frame_it_is() {
        let dir = tempfile::tempdir().unwrap();
        let history = History::new(dir.path().to_path_buf());
        fs::write(dir.path().join("episode-0001.mcap"), "as if read").unwrap();
        let stamp = stamp(&dir.path().join("episode-0001.mcap"));
        let all = vec![(5, vec![5]), (9, vec![9])];
        locked(&history.open).push(Arc::new(Pictures { name: "episode-0001.mcap".into(), stamp, all }));
        for (wanted, got) in [(5, 5), (8, 5), (9, 9), (2, 5)] {
            assert_eq!(history.picture("episode-0001.mcap", wanted), Ok((got, vec![got as u8])), "frame {wanted}");
        }
    }
}
