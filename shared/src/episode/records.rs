//! The records of an MCAP file, one after the other, with every checksum compared. It allocates and is for ordinary threads only.
//!
//! A file whose writer was killed is read up to its last whole chunk. A damaged file is an error.

use std::fs::File;
use std::io::Read as _;
use std::path::Path;

use mcap::McapError;
use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};

use crate::regular_file;

/// A record or chunk that claims to be larger than this counts as damaged, bytes. Chosen by hand: far above a chunk of the recorder, far
/// below a computer's memory.
const RECORD_LIMIT: usize = 256 << 20;
/// A record may be so large in any file, bytes: of one that was cut, the last chunk may say to be larger than what is left. Chosen by hand: far
/// above a chunk of the recorder.
const RECORD_ALWAYS: usize = 64 << 20;
/// A file's records are at most so many times larger than the file, and [`EXPANSION_BYTES`] more. Others count as damaged: a few bytes of a
/// compressed chunk would fill the memory. Chosen by hand; the recorder does not compress, and other programs reach a tenth of it.
const EXPANSION: u64 = 32;
/// See [`EXPANSION`]; so that small files may be compressed well, bytes. Chosen by hand.
const EXPANSION_BYTES: u64 = 4 << 20;
/// Records that may only stand behind the data (MCAP specification, section Summary).
const INDEXES: [u8; 5] = [op::CHUNK_INDEX, op::ATTACHMENT_INDEX, op::STATISTICS, op::METADATA_INDEX, op::SUMMARY_OFFSET];
/// Length of an attachment's data and its checksum, bytes (MCAP specification).
const ATTACHMENT_REST: usize = 12;
/// Number of bytes that are read at a time. Chosen by hand; no measurement is recorded.
const READ_BYTES: usize = 1 << 20;

/// Why an episode's file cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum EpisodeError {
    /// The file or directory cannot be opened or read.
    #[error("{file}: {what}; give an episode (.mcap) or a directory of episodes")]
    Read {
        /// The file.
        file: String,
        /// The operating system's message.
        what: String,
    },
    /// The file is not an episode that this program can read.
    #[error("{file}: not an episode: {what}")]
    NotAnEpisode {
        /// The file.
        file: String,
        /// What is missing or different.
        what: String,
    },
    /// A checksum, a record or a value in the file is wrong.
    #[error("{file}: damaged: {what}; take it from a backup, or leave it out")]
    Damaged {
        /// The file.
        file: String,
        /// What is wrong.
        what: String,
    },
}

/// What came next in a file.
pub enum NextRecord<T> {
    /// What the visitor took out of a record.
    Item(T),
    /// The file's regular end.
    End,
    /// The file stops in the middle: its recorder was killed.
    Cut,
}

/// The records of a file, including those inside chunks.
pub struct Records {
    file: File,
    name: String,
    reader: LinearReader,
    /// The records of the chunk that is read.
    chunk: Option<LinearReader>,
    /// A record may be so large, bytes.
    record_limit: usize,
    data_ended: bool,
    /// So many bytes of records may still come.
    bytes_left: u64,
}

impl Records {
    /// Opens a file.
    pub fn open(path: &Path) -> Result<Self, EpisodeError> {
        let name = path.display().to_string();
        let read_error = |e: std::io::Error| EpisodeError::Read { file: name.clone(), what: e.to_string() };
        let (file, meta) = regular_file::open(path).map_err(read_error)?;
        let bytes_left = meta.len().saturating_mul(EXPANSION).saturating_add(EXPANSION_BYTES);
        let record_limit = usize::try_from(bytes_left).unwrap_or(usize::MAX).clamp(RECORD_ALWAYS, RECORD_LIMIT);
        let options = LinearReaderOptions::default()
            .with_emit_chunks(true)
            .with_check_finishes_after_end_magic(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_record_length_limit(record_limit);
        let reader = LinearReader::new_with_options(options);
        Ok(Self { file, name, reader, chunk: None, record_limit, data_ended: false, bytes_left })
    }

    /// The file's name.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The error of a file with something wrong in it.
    pub fn damaged(&self, what: impl std::fmt::Display) -> EpisodeError {
        EpisodeError::Damaged { file: self.name.clone(), what: what.to_string() }
    }

    /// Shows the records of the data section to `visit`, one by one, until `visit` takes something out of one.
    pub fn next<T>(&mut self, mut visit: impl FnMut(Record) -> Result<Option<T>, String>) -> Result<NextRecord<T>, EpisodeError> {
        let damaged = |what: String| EpisodeError::Damaged { file: self.name.clone(), what };
        loop {
            let in_chunk = self.chunk.is_some();
            let event = match &mut self.chunk {
                Some(chunk) => chunk.next_event(),
                None => self.reader.next_event(),
            };
            match event {
                None if in_chunk => self.chunk = None,
                None => return Ok(NextRecord::End),
                Some(Err(McapError::UnexpectedEof)) if in_chunk => return Err(damaged("a chunk ends within a record".into())),
                Some(Err(McapError::UnexpectedEof)) => return Ok(NextRecord::Cut),
                Some(Err(McapError::BadMagic)) if !self.data_ended => {
                    return Err(EpisodeError::NotAnEpisode { file: self.name.clone(), what: "this is no MCAP file".into() });
                }
                Some(Err(e)) => return Err(damaged(e.to_string())),
                Some(Ok(LinearReadEvent::ReadRequest(want))) => {
                    if let Some(chunk) = &mut self.chunk {
                        // It has all that there is of the chunk.
                        chunk.notify_read(0);
                        continue;
                    }
                    // The file is read in pieces, so that a wrong length never asks for more memory than the file fills.
                    let buffer = self.reader.insert(want.min(READ_BYTES));
                    let got = self.file.read(buffer).map_err(|e| EpisodeError::Read { file: self.name.clone(), what: e.to_string() })?;
                    self.reader.notify_read(got);
                }
                // After a power failure the end of a file can be zeros.
                Some(Ok(LinearReadEvent::Record { opcode: 0, .. })) => return Ok(NextRecord::Cut),
                Some(Ok(LinearReadEvent::Record { opcode, data })) => {
                    if opcode == op::DATA_END {
                        self.data_ended = true;
                    }
                    if self.data_ended {
                        continue;
                    }
                    if opcode == op::CHUNK && !in_chunk {
                        self.chunk =
                            Some(chunk_reader(data, self.record_limit).ok_or_else(|| damaged("its records do not fill a chunk".into()))?);
                        continue;
                    }
                    self.bytes_left = self
                        .bytes_left
                        .checked_sub(data.len() as u64)
                        .ok_or_else(|| damaged(format!("its records are more than {EXPANSION} times larger than the file")))?;
                    if opcode == op::CHUNK {
                        return Err(damaged("a chunk lies within another one".into()));
                    }
                    if INDEXES.contains(&opcode) {
                        return Err(damaged(format!("a record of its index (opcode {opcode:#04x}) stands among the measurements")));
                    }
                    if !lengths_fit(opcode, data) {
                        return Err(damaged("a text in it is longer than its record".into()));
                    }
                    let record = mcap::parse_record(opcode, data).map_err(|e| damaged(e.to_string()))?;
                    if let Some(item) = visit(record).map_err(damaged)? {
                        return Ok(NextRecord::Item(item));
                    }
                }
            }
        }
    }
}

/// A reader of the records in a chunk with this content; `None` if they do not fill it, which the library would take for granted and panic.
fn chunk_reader(chunk: &[u8], record_limit: usize) -> Option<LinearReader> {
    // Its times, its size, and its checksum stand before its compression (MCAP specification, section Chunk).
    let (length, rest) = chunk.get(28..)?.split_first_chunk::<4>()?;
    let (compression, rest) = rest.split_at_checked(u32::from_le_bytes(*length) as usize)?;
    let (length, mut rest) = rest.split_first_chunk::<8>()?;
    if u64::from_le_bytes(*length) != rest.len() as u64 {
        return None;
    }
    while compression.is_empty() && !rest.is_empty() {
        let (length, behind) = rest.get(1..)?.split_first_chunk::<8>()?;
        rest = behind.get(usize::try_from(u64::from_le_bytes(*length)).ok()?..)?;
    }
    let options = LinearReaderOptions::default()
        .with_skip_start_magic(true)
        .with_skip_end_magic(true)
        .with_prevalidate_chunk_crcs(true)
        .with_record_length_limit(record_limit);
    let mut reader = LinearReader::new_with_options(options);
    let record = [&[op::CHUNK][..], &(chunk.len() as u64).to_le_bytes(), chunk].concat();
    reader.insert(record.len()).copy_from_slice(&record);
    reader.notify_read(record.len());
    Some(reader)
}

/// Whether the texts and maps in a record are no longer than the record: the library sets memory aside for what their lengths say, up to 4 GiB, before it
/// looks whether they are there. The layouts are those of the MCAP specification, section Records.
fn lengths_fit(opcode: u8, data: &[u8]) -> bool {
    // Bytes before the texts, number of texts, and whether a map of texts follows.
    let (fixed, texts, map) = match opcode {
        op::HEADER => (0, 2, false),
        op::SCHEMA => (2, 3, false),
        op::CHANNEL => (4, 2, true),
        op::MESSAGE_INDEX => (2, 1, false),
        op::ATTACHMENT => (16, 2, false),
        op::METADATA => (0, 1, true),
        _ => return true,
    };
    let after_text = |rest: &mut &[u8]| -> Option<()> {
        let (length, text) = rest.split_first_chunk::<4>()?;
        *rest = text.get(u32::from_le_bytes(*length) as usize..)?;
        Some(())
    };
    let look = || -> Option<()> {
        let mut rest = data.get(fixed..)?;
        for _ in 0..texts {
            after_text(&mut rest)?;
        }
        if map {
            let (length, mut pairs) = rest.split_first_chunk::<4>()?;
            // As the library reads them: pair by pair, also when the last one goes beyond the map's own length.
            let behind = pairs.len().checked_sub(u32::from_le_bytes(*length) as usize)?;
            while pairs.len() > behind {
                after_text(&mut pairs)?;
                after_text(&mut pairs)?;
            }
        }
        (opcode != op::ATTACHMENT || rest.len() >= ATTACHMENT_REST).then_some(())
    };
    look().is_some()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A file whose data section holds one record, which is cut behind it.
    fn file(opcode: u8, record: &[u8]) -> Vec<u8> {
        let header = [0; 8];
        let mut bytes = mcap::MAGIC.to_vec();
        for (opcode, data) in [(op::HEADER, &header[..]), (opcode, record)] {
            bytes.push(opcode);
            bytes.extend((data.len() as u64).to_le_bytes());
            bytes.extend(data);
        }
        bytes
    }

    /// Protects whoever opens a file of others: records that go beyond their chunk, or leave something of it over, are damage, before the library panics. It
    /// is so without a checksum too, which other programs may leave out.
    #[test]
    fn records_fill_their_chunk() {
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("e.mcap");
        let metadata = [&[op::METADATA][..], &9_u64.to_le_bytes(), &1_u32.to_le_bytes(), b"n", &0_u32.to_le_bytes()].concat();
        let read = |records: &[u8], length: usize| {
            let chunk = [&[0; 32][..], &(length as u64).to_le_bytes(), records].concat();
            std::fs::write(&path, file(op::CHUNK, &chunk)).unwrap();
            let mut found = 0;
            let end = Records::open(&path).and_then(|mut r| {
                r.next(|record| {
                    found += usize::from(matches!(record, Record::Metadata(_)));
                    Ok(None::<()>)
                })
            });
            (found, matches!(end, Ok(NextRecord::Cut)), matches!(end, Err(EpisodeError::Damaged { .. })))
        };
        let two = metadata.repeat(2);
        assert_eq!(read(&two, two.len()), (2, true, false), "they are read, and the file ends behind the chunk");
        assert_eq!(read(&[], 0), (0, true, false));
        for (records, length) in
            [(&two[..two.len() - 1], two.len() - 1), (&two[..20], 20), (&two[..], two.len() + 1), (&two[..], two.len() - 1)]
        {
            assert_eq!(read(records, length), (0, false, true), "{} of {length} bytes", records.len());
        }
    }

    /// Protects whoever opens a file of others: a text that says to be longer than its record is damage, before gigabytes are set aside for it or the
    /// library panics, in every kind of record.
    #[test]
    fn lengths_beyond_a_record_are_damage() {
        let huge = 2_000_000_000_u32.to_le_bytes();
        let text = |t: &str| [&(t.len() as u32).to_le_bytes()[..], t.as_bytes()].concat();
        let dir = tempfile::tempdir().unwrap();
        for (name, opcode, record) in [
            ("metadata's name", op::METADATA, huge.to_vec()),
            ("a value behind its map", op::METADATA, [text("n"), 5_u32.to_le_bytes().to_vec(), text("k"), huge.to_vec()].concat()),
            ("index of metadata", op::METADATA_INDEX, [&[0; 16][..], &huge].concat()),
            ("index of attachments", op::ATTACHMENT_INDEX, [&[0; 38][..], &huge].concat()),
            ("index of chunks", op::CHUNK_INDEX, [&[0; 44][..], &huge].concat()),
            ("attachment without its end", op::ATTACHMENT, [&[0; 16][..], &text("n"), &text("m"), &[0; 9]].concat()),
        ] {
            let path = dir.path().join("e.mcap");
            std::fs::write(&path, file(opcode, &record)).unwrap();
            let end = Records::open(&path).and_then(|mut r| r.next(|_| Ok(None::<()>)).map(|_| ()));
            // By our words: the library would set the memory aside before it finds out.
            let ours = |what: &str| what.contains("longer than its record") || what.contains("a record of its index");
            assert!(matches!(&end, Err(EpisodeError::Damaged { what, .. }) if ours(what)), "{name}: {end:?}");
        }
        std::fs::write(
            dir.path().join("e.mcap"),
            file(op::METADATA, &[text("n"), 10_u32.to_le_bytes().to_vec(), text("k"), text("v")].concat()),
        )
        .unwrap();
        let end = Records::open(&dir.path().join("e.mcap")).and_then(|mut r| r.next(|_| Ok(None::<()>)));
        assert!(matches!(end, Ok(NextRecord::Cut)), "what fits is read");
    }
}
