//! Writes an episode's records into a new file: with another weight or note, or without the damaged end. It allocates and is for ordinary
//! threads only.
//!
//! Everything is copied into a new file beside the old one, which is read back, compared and put on the disk before it takes the old one's
//! name in one step. Whenever the machine stops, there is one whole file, the old or the new one.

use std::fs::{File, Metadata as FileMetadata, TryLockError};
use std::io::{BufWriter, ErrorKind};
use std::os::unix::fs::MetadataExt as _;
use std::path::Path;
use std::time::{Duration, SystemTime};

use mcap::records::{Metadata, Record};
use mcap::{McapError, WriteOptions, Writer};

use super::Episode;
use super::records::{EpisodeError, NextRecord, Records};
use super::weight::WeightError;
use super::write::mcap_words;
use crate::disk_space::error_words;
use crate::{regular_file, whole_file};

/// Number of bytes that are written at a time. Chosen by hand; no measurement is recorded.
const WRITE_BYTES: usize = 1 << 20;

/// A file without its end that changed more recently than this counts as under way where the file system has no locks, or where it is to be deleted or
/// copied. Chosen by hand: the recorder writes twice a second.
const UNDER_WAY: Duration = Duration::from_secs(60);
/// How often a file's lock is tried. Chosen by hand: a program that the recorder's process starts holds all its locks for a moment, until it runs.
const LOCK_TRIES: u32 = 20;
/// Pause between two tries. Chosen by hand: a fifth of a second in all, which nobody notices.
const LOCK_PAUSE: Duration = Duration::from_millis(10);

/// Why an episode is not changed. The file is as it was.
#[derive(Debug, thiserror::Error)]
pub enum ChangeError {
    /// The number cannot be a weight.
    #[error("weight {0} g: {1}")]
    Weight(f64, WeightError),
    /// The text cannot be a note.
    #[error("this note has {0} bytes; at most {1} are kept")]
    Note(usize, usize),
    /// The episode cannot be read.
    #[error(transparent)]
    Episode(#[from] EpisodeError),
    /// The recorder was killed, so the frames do not add up to any weight.
    #[error("{file}: its recorder was killed before the end, so its frames do not add up to a weight; record the episode again")]
    Incomplete {
        /// The file.
        file: String,
    },
    /// The file has no end.
    #[error("{file}: its end is missing; `feature-worker episodes recover {file}` makes a whole file of it first")]
    Cut {
        /// The file.
        file: String,
    },
    /// The recorder still writes the file.
    #[error("{file}: it is being written; wait for its end")]
    UnderWay {
        /// The file.
        file: String,
    },
    /// Somebody may still write the file, without a lock.
    #[error("{file}: its end is missing and it changed within the last minute: it may be under way")]
    MayBeUnderWay {
        /// The file.
        file: String,
    },
    /// The file is not cut, so there is nothing to recover.
    #[error("{file}: the file is whole; there is nothing to recover")]
    Whole {
        /// The file.
        file: String,
    },
    /// The new file cannot be written or differs from the old one.
    #[error("{file}: {what}; the episode is as it was")]
    Write {
        /// The new file.
        file: String,
        /// What went wrong.
        what: String,
    },
}

/// Reads the episode `path`, which nobody writes any more: the recorder holds its file's lock, and whoever copies one here without a lock changes
/// its time. Gives it with what the file system says of the file.
pub fn read_at_rest(path: &Path) -> Result<(Episode, FileMetadata), ChangeError> {
    // Shared, so that two who look do not take each other for the recorder.
    let (episode, meta, _) = at_rest(path, File::try_lock_shared)?;
    if may_be_under_way(&episode, &meta) {
        return Err(ChangeError::MayBeUnderWay { file: path.display().to_string() });
    }
    Ok((episode, meta))
}

/// Whether an episode lacks its end, and has just been changed. A time in the future tells of a clock that went wrong, and not of somebody at work.
fn may_be_under_way(episode: &Episode, meta: &FileMetadata) -> bool {
    let is_recent = || meta.modified().is_ok_and(|at| SystemTime::now().duration_since(at).is_ok_and(|age| age < UNDER_WAY));
    episode.info.ended.is_empty() && is_recent()
}

/// Reads an episode on which the recorder holds no lock. Gives it with the file, which is held by `lock` as long as it is open.
pub(super) fn at_rest(path: &Path, lock: impl Fn(&File) -> Result<(), TryLockError>) -> Result<(Episode, FileMetadata, File), ChangeError> {
    let file = || path.display().to_string();
    let unread = |e: std::io::Error| EpisodeError::Read { file: file(), what: e.to_string() };
    let mut tries = LOCK_TRIES;
    let (opened, meta, locked) = loop {
        let (opened, meta) = regular_file::open(path).map_err(unread)?;
        // Before the lock was had, somebody may have put another file in its place, with what they changed.
        let is_it = || std::fs::metadata(path).is_ok_and(|now| (now.dev(), now.ino()) == (meta.dev(), meta.ino()));
        let locked = lock(&opened).and_then(|()| if is_it() { Ok(()) } else { Err(TryLockError::WouldBlock) });
        if tries == 0 || !matches!(locked, Err(TryLockError::WouldBlock)) {
            break (opened, meta, locked);
        }
        std::thread::sleep(LOCK_PAUSE);
        tries -= 1;
    };
    let has_locks = match locked {
        Ok(()) => true,
        Err(TryLockError::WouldBlock) => return Err(ChangeError::UnderWay { file: file() }),
        Err(TryLockError::Error(e)) if e.kind() == ErrorKind::Unsupported => false,
        Err(TryLockError::Error(e)) => return Err(unread(e).into()),
    };
    let episode = Episode::read(path)?;
    if !has_locks && may_be_under_way(&episode, &meta) {
        return Err(ChangeError::MayBeUnderWay { file: file() });
    }
    Ok((episode, meta, opened))
}

/// Sets the metadata record `name` of the episode `path` to one pair, in place of any that was there. `expected` says what the episode then
/// reads as. Returns the episode as it was.
pub(super) fn set_metadata(
    path: &Path,
    name: &str,
    (key, value): (&str, String),
    expected: impl FnOnce(Episode) -> Episode,
) -> Result<Episode, ChangeError> {
    let shown = path.display().to_string();
    // If the path is a link, the file that it leads to is replaced, and not the link.
    let path = path.canonicalize().map_err(|e| EpisodeError::Read { file: shown.clone(), what: e.to_string() })?;
    // The file is held until the new one is in its place, so that of two changes at once none is lost.
    let (before, _, _held) = at_rest(&path, File::try_lock)?;
    let (file, temporary) = whole_file::new_beside(&path).map_err(|e| ChangeError::Write { file: shown, what: error_words(&e) })?;
    let fail = |what: String| ChangeError::Write { file: temporary.display().to_string(), what };
    let result = copy(&path, (file, &temporary), Some(name), |writer, end| {
        if !matches!(end, NextRecord::End) {
            return Err(ChangeError::Cut { file: path.display().to_string() });
        }
        let metadata = [(key.to_string(), value)].into();
        writer.write_metadata(&Metadata { name: name.into(), metadata }).map_err(|e| fail(mcap_words(&e)))
    })
    .and_then(|()| {
        let after = Episode::read(&temporary)?;
        let expected = Episode { name: after.name.clone(), ..expected(before.clone()) };
        // They are compared as text, because NaN is not equal to itself.
        if format!("{after:?}") != format!("{expected:?}") {
            return Err(fail("the copy differs from the original".into()));
        }
        std::fs::rename(&temporary, &path).map_err(|e| fail(error_words(&e)))?;
        whole_file::sync_directory(&path);
        Ok(())
    });
    match result {
        Ok(()) => Ok(before),
        Err(e) => {
            // It is our own file: we have made it. After the rename it is no longer there.
            let _ = std::fs::remove_file(&temporary);
            Err(e)
        }
    }
}

/// Copies the records of `old` to the new file `new`, without the metadata record `without`, up to the end or the cut. Then `last` may write
/// more; it is told how the records ended. Waits until everything is on the disk.
pub(super) fn copy(
    old: &Path,
    (file, new): (File, &Path),
    without: Option<&str>,
    last: impl FnOnce(&mut Writer<BufWriter<File>>, NextRecord<()>) -> Result<(), ChangeError>,
) -> Result<(), ChangeError> {
    let shown = new.display().to_string();
    let fail = |what: String| ChangeError::Write { file: shown.clone(), what };
    let disk = |e: &std::io::Error| fail(error_words(e));
    let before = std::fs::metadata(old).map_err(|e| disk(&e))?;
    whole_file::give_owner(&file, &before);
    file.set_permissions(before.permissions()).map_err(|e| disk(&e))?;
    let mut records = Records::open(old)?;
    let mut target: Option<BufWriter<File>> = Some(BufWriter::with_capacity(WRITE_BYTES, file));
    let mut writer: Option<Writer<BufWriter<File>>> = None;
    // What cannot be written is no fault of the old file.
    let mut unwritten: Option<String> = None;
    let next = records.next(|record| {
        let mut not_written = |e: McapError| {
            let what = mcap_words(&e);
            unwritten = Some(what.clone());
            what
        };
        if let (Record::Header(header), Some(file)) = (&record, target.take()) {
            let options = WriteOptions::new().compression(None).profile(&header.profile).library(&header.library);
            writer = Some(Writer::with_options(file, options.disable_seeking(true)).map_err(not_written)?);
            return Ok(None::<()>);
        }
        let Some(writer) = &mut writer else { return Err("it does not begin with a header".into()) };
        copy_record(record, writer, without)?.map_err(&mut not_written).map(|()| None)
    });
    if let Some(what) = unwritten {
        return Err(fail(what));
    }
    let next = next?;
    let Some(mut writer) = writer else { return Err(ChangeError::Cut { file: old.display().to_string() }) };
    last(&mut writer, next)?;
    writer.finish().map_err(|e| fail(mcap_words(&e)))?;
    let file = writer.into_inner().into_inner().map_err(|e| disk(e.error()))?;
    file.sync_all().map_err(|e| disk(&e))
}

/// Writes a record into the new file, if it belongs there. The outer error says what is wrong with the record.
fn copy_record(record: Record, to: &mut Writer<BufWriter<File>>, without: Option<&str>) -> Result<Result<(), McapError>, String> {
    let written = match record {
        Record::Schema { header, data } => to.add_schema_with_id(header.id, &header.name, &header.encoding, &data).map(drop),
        Record::Channel(c) => to.add_channel_with_id(c.id, c.schema_id, &c.topic, &c.message_encoding, &c.metadata).map(drop),
        Record::Message { header, data } => to.write_to_known_channel(&header, &data),
        Record::Metadata(m) if Some(m.name.as_str()) == without => Ok(()),
        Record::Metadata(m) => to.write_metadata(&m),
        Record::Attachment { header, data, .. } => to.attach(&mcap::Attachment {
            log_time: header.log_time,
            create_time: header.create_time,
            name: header.name,
            media_type: header.media_type,
            data,
        }),
        // The writer makes its own indexes.
        Record::MessageIndex(_) => Ok(()),
        Record::Unknown { opcode, data } => to.write_private_record(opcode, &data, Default::default()),
        other => return Err(format!("unexpected record with opcode {:#04x}", other.opcode())),
    };
    Ok(written)
}

#[cfg(test)]
mod tests {
    use std::time::UNIX_EPOCH;

    use super::*;
    use crate::config::Config;
    use crate::episode::{EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow};
    use crate::messages::Feature;

    /// Protects episodes under way where the file system has no locks: one without its end that has just changed is left alone, and later it is nobody's.
    /// A time from tomorrow, by a clock that went wrong, does not keep it from people until then.
    #[test]
    fn without_locks_the_time_of_the_last_change_decides() {
        let config = Config::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let kind = EpisodeKind::Pour { goal_ml: 50.0 };
        let start = EpisodeStart { episode: 1, kind, started_at_ns: 1, wall_clock: UNIX_EPOCH, config: &config, weights: "" };
        let mut writer = EpisodeWriter::create(dir.path(), &start).unwrap();
        let feature = Feature { captured_at_ns: 2, sequence: 1, ..Default::default() };
        writer.frame(&FrameRow { feature: &feature, alpha_commanded_deg: 0.0, alpha_measured_deg: 0.0, image: None }).unwrap();
        writer.flush().unwrap();
        let path = writer.path().to_path_buf();
        drop(writer);
        let look = || at_rest(&path, |_| Err(TryLockError::Error(ErrorKind::Unsupported.into())));
        assert!(matches!(look(), Err(ChangeError::MayBeUnderWay { .. })));
        let file = File::options().append(true).open(&path).unwrap();
        for changed in [SystemTime::now() - 2 * UNDER_WAY, SystemTime::now() + 1000 * UNDER_WAY] {
            file.set_modified(changed).unwrap();
            assert!(look().is_ok(), "{changed:?}");
        }
    }
}
