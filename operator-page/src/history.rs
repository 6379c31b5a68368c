//! The recorded episodes: a table that grows as files appear, and one episode's rows and pictures.
//!
//! A thread of its own looks at the directory and reads each new or changed file once; other threads read the table under a lock. Allocates;
//! the pictures of at most `OPEN` episodes are kept, and of each at most `PICTURES_MAX`. A file that cannot be read stays in the table
//! with the reason.

use std::collections::BTreeMap;
use std::fs::{self, File};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Arc, Mutex};
use std::time::{Duration, SystemTime};

use feature_worker::episodes::summary::{remarks, summary};
use serde_json::{Value, json};
use shared::episode::{Episode, EpisodeImages, by_number, find_episodes};
use shared::regular_file;

use crate::ends::Ends;
use crate::lock::locked;

/// Pause between two looks at the directory. Chosen by hand: a person waits for a new episode no longer.
const BEAT: Duration = Duration::from_millis(500);
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
    unread: Mutex<usize>,
    open: Mutex<Vec<Arc<Pictures>>>,
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
            let error_ml = all["run"]["goal_ml"].as_f64().zip(episode.weight_g).map(|(goal, weight)| weight - goal);
            all["file"] = json!(name);
            all["error_ml"] = json!(error_ml);
            all["wrong"] = json!(texts(true));
            all["notes"] = json!(texts(false));
            all
        }
    }
}

impl History {
    /// The episodes of `directory`.
    pub fn new(directory: PathBuf) -> Self {
        Self { directory, table: Mutex::default(), unread: Mutex::default(), open: Mutex::default() }
    }

    /// Keeps the table until `stop` is set.
    pub fn keep(&self, stop: &AtomicBool) {
        while !stop.load(Relaxed) {
            let files = find_episodes(std::slice::from_ref(&self.directory)).unwrap_or_default();
            let files: Vec<PathBuf> = files.into_iter().filter(|f| f.symlink_metadata().is_ok()).collect();
            let known = |file: &PathBuf| locked(&self.table).get(&name_of(file)).is_some_and(|l| l.stamp == stamp(file));
            let new: Vec<&PathBuf> = files.iter().filter(|f| !known(f)).collect();
            for (done, file) in new.iter().enumerate() {
                *locked(&self.unread) = new.len() - done;
                if stop.load(Relaxed) {
                    return;
                }
                let (stamp, value) = (stamp(file), line(file));
                locked(&self.table).insert(name_of(file), Line { stamp, value });
            }
            *locked(&self.unread) = 0;
            locked(&self.table).retain(|name, _| files.iter().any(|f| name_of(f) == *name));
            std::thread::sleep(BEAT);
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
        json!({ "episodes": lines, "unread": *locked(&self.unread), "directory": self.directory.display().to_string() })
    }

    /// A word that changes when the table does: number of lines and the newest stamp.
    pub fn version(&self) -> String {
        let table = locked(&self.table);
        let newest = table.values().filter_map(|l| l.stamp.0).max().and_then(|at| at.duration_since(SystemTime::UNIX_EPOCH).ok());
        format!("{}-{}", table.len(), newest.map_or(0, |d| d.as_millis()))
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

    /// The files that can be learned from, oldest first: weighed and readable; with `last`, only that many of them.
    pub fn weighed(&self, last: Option<usize>) -> Vec<PathBuf> {
        let table = locked(&self.table);
        let mut lines: Vec<(&str, &str)> = table
            .iter()
            .filter(|(_, l)| l.value["weight_g"].is_number() && l.value["error"].is_null())
            .map(|(name, l)| (l.value["started_at_utc"].as_str().unwrap_or(""), name.as_str()))
            .collect();
        lines.sort_unstable_by(|(at, a), (bt, b)| at.cmp(bt).then_with(|| by_number(a.as_ref(), b.as_ref())));
        let skipped = last.map_or(0, |n| lines.len().saturating_sub(n));
        lines.into_iter().skip(skipped).map(|(_, name)| self.directory.join(name)).collect()
    }

    /// By how much the weighed pours with the weights `identity` missed their goals, ml.
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

    /// The picture of the frame `sequence`, or the nearest one before it.
    pub fn picture(&self, name: &str, sequence: u64) -> Result<Vec<u8>, String> {
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
        let picture = pictures.all.get(before.saturating_sub(1)).ok_or("this episode has no pictures")?;
        Ok(picture.1.clone())
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
}
