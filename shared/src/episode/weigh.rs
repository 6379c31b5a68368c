//! Adds the weight `w_E` to an episode afterwards. It allocates and is for ordinary threads only.
//!
//! Everything is copied into a new file beside the old one, which is read back, compared and put on the disk before it takes the old one's
//! name in one step. Whenever the machine stops, there is one whole file, with or without the weight.

use std::fs::{File, OpenOptions};
use std::io::BufWriter;
use std::path::Path;

use mcap::records::{Metadata, Record};
use mcap::{WriteOptions, Writer};

use super::records::{EpisodeError, NextRecord, Records};
use super::weight::{WeightError, check_reading};
use super::{Episode, format};

/// Number of bytes that are written at a time. Chosen by hand; no measurement is recorded.
const WRITE_BYTES: usize = 1 << 20;

/// Why a weight is refused or cannot be written. The file is as it was.
#[derive(Debug, thiserror::Error)]
pub enum WeighError {
    /// The number cannot be a weight.
    #[error("weight {0} g: {1}")]
    Weight(f64, WeightError),
    /// The episode cannot be read.
    #[error(transparent)]
    Episode(#[from] EpisodeError),
    /// The recorder was killed, so the frames do not add up to any weight.
    #[error("{file}: its recorder was killed before the end, so its frames do not add up to a weight; record the episode again")]
    Incomplete {
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

/// Sets the weight of the episode `path` to `grams`, and returns the weight that it had before.
pub fn set_weight(path: &Path, grams: f64) -> Result<Option<f64>, WeighError> {
    check_reading(grams).map_err(|e| WeighError::Weight(grams, e))?;
    let shown = path.display().to_string();
    // If the path is a link, the file that it leads to is replaced, and not the link.
    let path = path.canonicalize().map_err(|e| EpisodeError::Read { file: shown.clone(), what: e.to_string() })?;
    let before = Episode::read(&path)?;
    let name = path.file_name().and_then(|n| n.to_str()).unwrap_or("episode");
    let temporary = path.with_file_name(format!(".{name}.{}.new", std::process::id()));
    let result = copy_with_weight(&path, &temporary, grams).and_then(|()| {
        let fail = |what: String| WeighError::Write { file: temporary.display().to_string(), what };
        let after = Episode::read(&temporary)?;
        let expected = Episode { name: after.name.clone(), weight_g: Some(grams), ..before.clone() };
        // They are compared as text, because NaN is not equal to itself.
        if format!("{after:?}") != format!("{expected:?}") {
            return Err(fail("the copy differs from the original".into()));
        }
        std::fs::rename(&temporary, &path).map_err(|e| fail(e.to_string()))?;
        let directory = path.parent().unwrap_or(Path::new("/"));
        File::open(directory).and_then(|d| d.sync_all()).map_err(|e| fail(e.to_string()))
    });
    match result {
        Ok(()) => Ok(before.weight_g),
        Err(e) => {
            // This is only ever our own file. After the rename it is no longer there.
            let _ = std::fs::remove_file(&temporary);
            Err(e)
        }
    }
}

/// Copies all records of `old` to the new file `new`, with the weight in place of any that was there.
fn copy_with_weight(old: &Path, new: &Path, grams: f64) -> Result<(), WeighError> {
    let shown = new.display().to_string();
    let fail = |what: &dyn std::fmt::Display| WeighError::Write { file: shown.clone(), what: what.to_string() };
    let file = OpenOptions::new().write(true).create_new(true).open(new).map_err(|e| fail(&e))?;
    let permissions = std::fs::metadata(old).map_err(|e| fail(&e))?.permissions();
    file.set_permissions(permissions).map_err(|e| fail(&e))?;
    let mut records = Records::open(old)?;
    let mut target: Option<BufWriter<File>> = Some(BufWriter::with_capacity(WRITE_BYTES, file));
    let mut writer: Option<Writer<BufWriter<File>>> = None;
    let next = records.next(|record| {
        if let (Record::Header(header), Some(file)) = (&record, target.take()) {
            let options = WriteOptions::new().compression(None).profile(&header.profile).library(&header.library);
            writer = Some(Writer::with_options(file, options.disable_seeking(true)).map_err(|e| e.to_string())?);
            return Ok(None::<()>);
        }
        let Some(writer) = &mut writer else { return Err("it does not begin with a header".into()) };
        copy(record, writer).map(|()| None)
    })?;
    let Some(mut writer) = writer.filter(|_| matches!(next, NextRecord::End)) else {
        return Err(WeighError::Incomplete { file: old.display().to_string() });
    };
    let metadata = [("grams".to_string(), grams.to_string())].into();
    writer.write_metadata(&Metadata { name: format::META_WEIGHT.into(), metadata }).map_err(|e| fail(&e))?;
    writer.finish().map_err(|e| fail(&e))?;
    let file = writer.into_inner().into_inner().map_err(|e| fail(e.error()))?;
    file.sync_all().map_err(|e| fail(&e))
}

fn copy(record: Record, to: &mut Writer<BufWriter<File>>) -> Result<(), String> {
    let result = match record {
        Record::Schema { header, data } => to.add_schema_with_id(header.id, &header.name, &header.encoding, &data).map(drop),
        Record::Channel(c) => to.add_channel_with_id(c.id, c.schema_id, &c.topic, &c.message_encoding, &c.metadata).map(drop),
        Record::Message { header, data } => to.write_to_known_channel(&header, &data),
        Record::Metadata(m) if m.name == format::META_WEIGHT => Ok(()),
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
    result.map_err(|e| e.to_string())
}
