//! Deletes, prunes, splits and merges episodes, without ever touching anything else.
//!
//! Used by `feature-worker episodes`, on the command's thread; no cell needs to run. Allocates. What is deleted is an episode that can be read,
//! a regular file of its own name, and not under way: the recorder holds a lock on the file that it writes. Copies are compared with the
//! original before they get their name, and never take the place of a file. A failure names its file, and leaves the rest as it is.

use std::collections::BTreeMap;
use std::fs;
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};
use shared::episode::{Begun, Episode, by_age, find_episodes, hex, oldest_first_of, read_at_rest, take_number};
use shared::{regular_file, whole_file};

use super::folder::{Budget, Folder};
use super::output::{ExportError, LeftOut, all_free, disk_error, write_error};

/// An episode that may be deleted.
#[derive(Debug)]
pub struct Found {
    /// Its file.
    pub path: PathBuf,
    /// Its size, bytes.
    pub bytes: u64,
    /// What is in it.
    pub episode: Episode,
    /// Inode and time of change when it was looked at.
    stamp: (u64, i64, i64),
}

/// Looks whether `path` is an episode that may be deleted; if not, says why.
pub fn look(path: &Path) -> Result<Found, LeftOut> {
    let meta = fs::symlink_metadata(path).map_err(|e| left_out(path, e))?;
    if !meta.is_file() {
        return Err(left_out(path, "it is a link or no regular file"));
    }
    let (episode, meta) = at_rest(path)?;
    Ok(Found { path: path.to_path_buf(), bytes: meta.len(), episode, stamp: (meta.ino(), meta.mtime(), meta.mtime_nsec()) })
}

/// Reads an episode that nobody writes any more; if it cannot be read or is under way, says so.
fn at_rest(path: &Path) -> Result<(Episode, fs::Metadata), LeftOut> {
    read_at_rest(path).map_err(|e| LeftOut { file: path.to_path_buf(), why: e.to_string() })
}

fn left_out(path: &Path, why: impl std::fmt::Display) -> LeftOut {
    LeftOut { file: path.to_path_buf(), why: format!("{}: {why}", path.display()) }
}

/// Deletes an episode, if it is still the one that was looked at.
pub fn delete(found: &Found) -> Result<(), ExportError> {
    let fail = |what: &dyn std::fmt::Display| write_error(&found.path, what);
    let meta = fs::symlink_metadata(&found.path).map_err(|e| fail(&e))?;
    if (meta.ino(), meta.mtime(), meta.mtime_nsec()) != found.stamp {
        return Err(fail(&"it changed meanwhile, and is kept; look again"));
    }
    fs::remove_file(&found.path).map_err(|e| fail(&e))
}

/// Places in `found`, the oldest first.
fn oldest_first(found: &[Found]) -> Vec<usize> {
    let begun = found.iter().map(|Found { path, episode, .. }| Begun {
        path,
        number: episode.info.number,
        at: episode.info.started_at_utc.as_str(),
    });
    by_age(&begun.collect::<Vec<_>>())
}

/// Whether what is `beside` and cannot go breaks `budget` although of `found` only the newest stayed. No deletion helps there.
pub fn is_out_of_reach(found: &[Found], beside: Folder, budget: Budget) -> bool {
    let (episodes, bytes) = oldest_first(found).last().map_or((0, 0), |newest| (1, found[*newest].bytes));
    beside.episodes > 0 && !budget.holds(beside.episodes + episodes, beside.bytes + bytes)
}

/// What is to go so that the rest, and what is `beside` it and cannot go, are within `budget`: places in `found`, in the order of deletion. First
/// go those that cannot be trained on for want of their end, then those without a weight, then, only if `weighed`, those with one; the oldest
/// first. The newest of all stays. Nothing goes where the budget is out of reach ([`is_out_of_reach`]): recordings would be lost for nothing.
pub fn to_prune(found: &[Found], beside: Folder, budget: Budget, weighed: bool) -> Vec<usize> {
    if is_out_of_reach(found, beside, budget) {
        return Vec::new();
    }
    let mut order = oldest_first(found);
    order.pop();
    let rank = |i: &usize| match (&found[*i].episode.weight_g, found[*i].episode.complete) {
        (Some(_), _) => 2,
        (None, true) => 1,
        (None, false) => 0,
    };
    order.retain(|i| weighed || rank(i) < 2);
    order.sort_by_key(rank);
    let mut episodes = found.len() + beside.episodes;
    let mut bytes = found.iter().map(|f| f.bytes).sum::<u64>() + beside.bytes;
    order
        .into_iter()
        .take_while(|i| {
            let over = !budget.holds(episodes, bytes);
            episodes -= usize::from(over);
            bytes -= if over { found[*i].bytes } else { 0 };
            over
        })
        .collect()
}

/// What a copy of episodes made.
#[derive(Debug, Default)]
pub struct Copied {
    /// The original of each new file, and the new file.
    pub files: Vec<(PathBuf, PathBuf)>,
    /// What was left out.
    pub left_out: Vec<LeftOut>,
    /// How many of `left_out` cannot be read or are under way; the others are copied under another name, or were not asked for.
    pub missing: usize,
}

/// Reads `files`. The same measurement twice is taken once, from the file that says most. It is an error if there is none.
fn distinct(files: &[PathBuf], copied: &mut Copied) -> Result<Vec<(PathBuf, Episode)>, ExportError> {
    let mut all: Vec<(PathBuf, Episode)> = Vec::new();
    for file in files {
        let mut other = match at_rest(file) {
            Ok((episode, _)) => (file.clone(), episode),
            Err(why) => {
                copied.left_out.push(why);
                copied.missing += 1;
                continue;
            }
        };
        let sha256 = other.1.content_sha256();
        let Some(kept) = all.iter_mut().find(|(_, e)| e.content_sha256() == sha256) else {
            all.push(other);
            continue;
        };
        // A copy that was weighed or noted later would else be lost to the one that it was made of.
        let says = |(_, e): &(PathBuf, Episode)| (e.weight_g.is_some(), e.complete, !e.info.note.is_empty());
        if says(&other) > says(kept) {
            std::mem::swap(kept, &mut other);
        }
        let weights = other_weight(other.1.weight_g, kept.1.weight_g);
        copied.left_out.push(left_out(&other.0, format!("the same measurement as {}{weights}", kept.0.display())));
    }
    if all.is_empty() && copied.left_out.is_empty() {
        return Err(ExportError::Nothing("no episodes to copy; name .mcap files or a directory of them".into()));
    }
    Ok(all)
}

/// What is to be said where of one measurement the weight `left_g` stays behind, and `taken_g` is the other file's.
fn other_weight(left_g: Option<f64>, taken_g: Option<f64>) -> String {
    match (left_g, taken_g) {
        (Some(left), Some(taken)) if left != taken => format!(", whose weight is {taken} g and not {left} g"),
        (Some(left), None) => format!(", which is not weighed: here it is {left} g"),
        _ => String::new(),
    }
}

/// Copies all episodes of `files` into the directory `to`, in the order of their start, each with the next number that is free there. A measurement that
/// lies there already, under whatever name, is left out.
pub fn merge(files: &[PathBuf], to: &Path) -> Result<Copied, ExportError> {
    let mut copied = Copied::default();
    let all = oldest_first_of(distinct(files, &mut copied)?, |(path, episode)| (path, episode));
    let there = if to.is_dir() { find_episodes(&[to.to_path_buf()])? } else { Vec::new() };
    // What cannot be read there is nobody's measurement.
    let there = there.into_iter().filter_map(|file| Some((Episode::read(&file).ok()?, file)));
    let there: BTreeMap<_, _> = there.map(|(episode, file)| (episode.content_sha256(), (file, episode.weight_g))).collect();
    for (file, episode) in all {
        if let Some((other, weight_g)) = there.get(&episode.content_sha256()) {
            let weights = other_weight(episode.weight_g, *weight_g);
            copied.left_out.push(left_out(&file, format!("it lies there already, as {}{weights}", other.display())));
            continue;
        }
        let number = take_number(to).map_err(|e| disk_error(to, &e))?;
        let new = to.join(format!("episode-{number:04}.mcap"));
        copy(&file, &episode, &new)?;
        copied.files.push((file, new));
    }
    Ok(copied)
}

/// Copies the episodes of `files` into directories below `to`, one for each of `shares` by name, each episode into one. Which goes where depends
/// on the measurements and on `seed` alone. What the shares leave is left out. If a new name is taken, nothing is written, and all are said.
pub fn split(files: &[PathBuf], to: &Path, shares: &[(String, f64)], seed: u64) -> Result<Copied, ExportError> {
    let mut copied = Copied::default();
    let mut all = distinct(files, &mut copied)?;
    all.sort_by_cached_key(|(_, episode)| {
        let mut hash = Sha256::new();
        hash.update(seed.to_le_bytes());
        hash.update(episode.content_sha256());
        hex(&hash.finalize())
    });
    let (n, mut share, mut all) = (all.len() as f64, 0.0, all.into_iter());
    let mut planned = Vec::new();
    for (name, part) in shares {
        share += part;
        let until = (share * n).round() as usize;
        while planned.len() < until
            && let Some((file, episode)) = all.next()
        {
            let new = to.join(name).join(file.file_name().unwrap_or(file.as_os_str()));
            planned.push((file, episode, new));
        }
    }
    all_free(to, planned.iter().map(|(_, _, new)| new))?;
    for (name, _) in shares {
        let directory = to.join(name);
        fs::create_dir_all(&directory).map_err(|e| disk_error(&directory, &e))?;
    }
    for (file, episode, new) in planned {
        copy(&file, &episode, &new)?;
        copied.files.push((file, new));
    }
    copied.left_out.extend(all.map(|(file, _)| left_out(&file, "the shares leave it out")));
    Ok(copied)
}

/// Copies an episode to the new file `new`, under a name that no program takes for an episode until it is whole and on the disk.
fn copy(file: &Path, episode: &Episode, new: &Path) -> Result<(), ExportError> {
    let fail = |e: &dyn std::fmt::Display| write_error(new, e);
    let (mut made, part) = whole_file::new_beside(new).map_err(|e| disk_error(new, &e))?;
    let copied = regular_file::open(file).and_then(|(mut from, meta)| {
        made.set_permissions(meta.permissions())?;
        std::io::copy(&mut from, &mut made)?;
        made.sync_all()
    });
    let result = copied.map_err(|e| disk_error(new, &e)).and_then(|()| {
        let after = Episode { name: episode.name.clone(), ..Episode::read(&part)? };
        // They are compared as text, because NaN is not equal to itself.
        if format!("{after:?}") != format!("{episode:?}") {
            return Err(fail(&"the copy differs from the original"));
        }
        whole_file::give_name(&part, new).map_err(|e| disk_error(new, &e))
    });
    // It is our own file: we have made it.
    let _ = fs::remove_file(&part);
    result
}
