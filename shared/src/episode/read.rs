//! Reads MCAP episodes, see [`crate::episode`]. Allocates; ordinary threads only.
//!
//! The file is read once from start to end, record by record, and every checksum in it is compared: a damaged file is an
//! error, never a panic and never a wrong number. Memory is bounded by one chunk and the rows.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::Read;
use std::path::{Path, PathBuf};

use mcap::McapError;
use mcap::records::{Record, op};
use mcap::sans_io::linear_reader::{LinearReadEvent, LinearReader, LinearReaderOptions};
use prost::Message as _;

use super::format::{self, CompressedImage, EpisodeRowJson, TelemetryJson};
use super::{Episode, EpisodeInfo, EpisodeKind, EpisodeRow};
use crate::alpha_track::AlphaTrack;
use crate::gaussian_curve::Curve;
use crate::messages::Doubt;

/// Largest record or chunk that is believed, bytes.
const RECORD_LIMIT: usize = 256 << 20;
/// Bytes read at a time.
const READ_BYTES: usize = 1 << 20;
/// Most frames in a row that can be lost; more is a damaged number.
const GAP_LIMIT: u64 = 10_000;
/// The last frame may be this much older than the last tick in a complete episode, ns.
const SILENT_END_NS: u64 = 500_000_000;

/// Why an episode's file cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum EpisodeError {
    /// The file or directory cannot be opened or read.
    #[error("{file}: {what}; give an episode (.mcap) or a directory of episodes")]
    Read {
        /// The file.
        file: String,
        /// The system's words.
        what: String,
    },
    /// Not an episode of this program.
    #[error("{file}: not an episode: {what}")]
    NotAnEpisode {
        /// The file.
        file: String,
        /// What is missing.
        what: String,
    },
    /// A checksum, a record or a value in it is wrong.
    #[error("{file}: damaged: {what}; take it from a backup, or leave it out")]
    Damaged {
        /// The file.
        file: String,
        /// What is wrong.
        what: String,
    },
}

/// What came next in a file.
pub(super) enum NextRecord<T> {
    /// What the visitor took out of a record.
    Item(T),
    /// The file's regular end.
    End,
    /// The file stops in the middle: its recorder was killed.
    Cut,
}

/// The records of a file, those inside chunks too.
pub(super) struct Records {
    file: File,
    name: String,
    reader: LinearReader,
    data_ended: bool,
}

impl Records {
    pub(super) fn open(path: &Path) -> Result<Self, EpisodeError> {
        let name = path.display().to_string();
        let file = File::open(path).map_err(|e| EpisodeError::Read { file: name.clone(), what: e.to_string() })?;
        let options = LinearReaderOptions::default()
            .with_check_finishes_after_end_magic(true)
            .with_prevalidate_chunk_crcs(true)
            .with_validate_data_section_crc(true)
            .with_validate_summary_section_crc(true)
            .with_record_length_limit(RECORD_LIMIT);
        Ok(Self { file, name, reader: LinearReader::new_with_options(options), data_ended: false })
    }

    pub(super) fn damaged(&self, what: impl std::fmt::Display) -> EpisodeError {
        EpisodeError::Damaged { file: self.name.clone(), what: what.to_string() }
    }

    /// Shows the records of the data section to `visit`, one by one, until it takes something out of one.
    pub(super) fn next<T>(&mut self, mut visit: impl FnMut(Record) -> Result<Option<T>, String>) -> Result<NextRecord<T>, EpisodeError> {
        let damaged = |what: String| EpisodeError::Damaged { file: self.name.clone(), what };
        loop {
            match self.reader.next_event() {
                None => return Ok(NextRecord::End),
                Some(Err(McapError::UnexpectedEof)) => return Ok(NextRecord::Cut),
                Some(Err(McapError::BadMagic)) if !self.data_ended => {
                    return Err(EpisodeError::NotAnEpisode { file: self.name.clone(), what: "this is no MCAP file".into() });
                }
                Some(Err(e)) => return Err(damaged(e.to_string())),
                Some(Ok(LinearReadEvent::ReadRequest(want))) => {
                    // In pieces, so that a wrong length never asks for more memory than the file fills.
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
                    let record = mcap::parse_record(opcode, data).map_err(|e| damaged(e.to_string()))?;
                    if let Some(item) = visit(record).map_err(damaged)? {
                        return Ok(NextRecord::Item(item));
                    }
                }
            }
        }
    }
}

/// All that is in a file but the images.
#[derive(Default)]
struct Contents {
    topics: BTreeMap<u16, String>,
    samples: Vec<EpisodeRowJson>,
    ticks: Vec<TelemetryJson>,
    images: u64,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
}

impl Contents {
    fn take(&mut self, record: Record) -> Result<(), String> {
        match record {
            Record::Channel(channel) => {
                self.topics.insert(channel.id, channel.topic);
            }
            Record::Metadata(m) => {
                self.metadata.insert(m.name, m.metadata);
            }
            Record::Message { header, data } => match self.topics.get(&header.channel_id).map(String::as_str) {
                Some(format::IMAGE_TOPIC) => self.images += 1,
                Some(format::ROW_TOPIC) => self.samples.push(parse(format::ROW_TOPIC, &data)?),
                Some(format::TELEMETRY_TOPIC) => self.ticks.push(parse(format::TELEMETRY_TOPIC, &data)?),
                _ => {}
            },
            _ => {}
        }
        Ok(())
    }

    fn text(&self, record: &str, key: &str) -> &str {
        self.metadata.get(record).and_then(|m| m.get(key)).map_or("", String::as_str)
    }

    fn number<T: std::str::FromStr>(&self, record: &str, key: &str) -> Result<T, String> {
        let text = self.text(record, key);
        text.parse().map_err(|_| format!("metadata '{record}': {key} = '{text}' is not a number"))
    }

    fn kind(&self) -> Result<EpisodeKind, String> {
        match self.text(format::META_EPISODE, "kind") {
            "recording" => Ok(EpisodeKind::Recording(Curve {
                lambda_deg: self.number(format::META_EPISODE, "lambda_deg")?,
                gamma_per_s2: self.number(format::META_EPISODE, "gamma_per_s2")?,
                beta_s: self.number(format::META_EPISODE, "beta_s")?,
            })),
            "pour" => Ok(EpisodeKind::Pour { goal_ml: self.number(format::META_EPISODE, "goal_ml")? }),
            "table" => Ok(EpisodeKind::Table),
            other => Err(format!("metadata 'episode': kind = '{other}' is none of recording, pour, table")),
        }
    }

    fn weight_g(&self) -> Result<Option<f64>, String> {
        if !self.metadata.contains_key(format::META_WEIGHT) {
            return Ok(None);
        }
        let grams: f64 = self.number(format::META_WEIGHT, "grams")?;
        if grams.is_finite() && grams >= 0.0 { Ok(Some(grams)) } else { Err(format!("metadata 'weight': grams = {grams}")) }
    }

    /// The rows of the episode, the lost ones filled in.
    fn rows(&self, started_at_ns: u64) -> Result<Vec<EpisodeRow>, String> {
        // The ticks are taken as the recorder took them, so that a lost frame gets the angles that it would have written.
        let mut track = AlphaTrack::<256>::new();
        let mut ticks = self.ticks.iter();
        let t_s = |at_ns: u64| (i128::from(at_ns) - i128::from(started_at_ns)) as f64 / 1e9;
        let mut rows: Vec<EpisodeRow> = Vec::with_capacity(self.samples.len());
        for row in &self.samples {
            let doubt = Doubt::ALL.into_iter().find(|d| d.words() == row.doubt);
            let doubt = doubt.ok_or_else(|| format!("frame {}: unknown doubt '{}'", row.sequence, row.doubt))?;
            if !row.alpha_commanded_deg.is_finite() || row.area_px2 < 0.0 {
                return Err(format!("frame {}: commanded alpha {}, area {}", row.sequence, row.alpha_commanded_deg, row.area_px2));
            }
            if let Some(last) = rows.last().copied() {
                if row.sequence <= last.sequence || row.captured_at_ns <= last.captured_at_ns {
                    return Err(format!("frame {} comes after frame {} in the file", row.sequence, last.sequence));
                }
                let steps = row.sequence - last.sequence;
                if steps > GAP_LIMIT {
                    return Err(format!("frame numbers jump from {} to {}", last.sequence, row.sequence));
                }
                for step in 1..steps {
                    let share = step as f64 / steps as f64;
                    let captured_at_ns = last.captured_at_ns + ((row.captured_at_ns - last.captured_at_ns) as f64 * share) as u64;
                    let between = f64::from(last.alpha_commanded_deg)
                        + share * (f64::from(row.alpha_commanded_deg) - f64::from(last.alpha_commanded_deg));
                    while !track.covers(captured_at_ns)
                        && let Some(t) = ticks.next()
                    {
                        track.push(t.at_ns, t.alpha_deg, t.robot_at_ns, t.alpha_measured_deg);
                    }
                    let commanded = track.commanded_deg(captured_at_ns);
                    rows.push(EpisodeRow {
                        sequence: last.sequence + step,
                        captured_at_ns,
                        t_s: t_s(captured_at_ns),
                        alpha_commanded_deg: if commanded.is_nan() { between as f32 } else { commanded },
                        alpha_measured_deg: track.measured_deg(captured_at_ns),
                        area_px2: f32::NAN,
                        doubt: Doubt::None,
                        lost: true,
                    });
                }
            }
            rows.push(EpisodeRow {
                sequence: row.sequence,
                captured_at_ns: row.captured_at_ns,
                t_s: t_s(row.captured_at_ns),
                alpha_commanded_deg: row.alpha_commanded_deg,
                alpha_measured_deg: row.alpha_measured_deg,
                area_px2: if doubt.usable() { row.area_px2 } else { f32::NAN },
                doubt,
                lost: false,
            });
        }
        Ok(rows)
    }

    fn episode(self, name: &str, whole: bool) -> Result<Episode, String> {
        let started_at_ns = self.number(format::META_EPISODE, "started_at_ns")?;
        let rows = self.rows(started_at_ns)?;
        let text = |key: &str| self.text(format::META_EPISODE, key).to_string();
        let (first_tick, last_tick) = (self.ticks.first().map_or(0, |t| t.tick), self.ticks.last().map_or(0, |t| t.tick));
        let last_at_ns = self.ticks.last().map_or(0, |t| t.at_ns);
        let seen_to_the_end = rows.last().is_some_and(|f| f.captured_at_ns.saturating_add(SILENT_END_NS) >= last_at_ns);
        Ok(Episode {
            name: name.into(),
            kind: self.kind()?,
            weight_g: self.weight_g()?,
            complete: whole && self.text(format::META_END, "complete") == "true" && seen_to_the_end,
            info: EpisodeInfo {
                started_at_utc: text("started_at_utc"),
                started_at_ns,
                cell: text("cell"),
                config_sha256: text("config_sha256"),
                weights: text("weights"),
                ended: self.text(format::META_END, "reason").into(),
                ticks: self.ticks.len() as u64,
                lost_ticks: last_tick.saturating_sub(first_tick).saturating_add(1).saturating_sub(self.ticks.len() as u64),
                images: self.images,
                dropped_images: self.samples.iter().filter(|s| !s.image).count() as u64,
                lost_frames: rows.iter().filter(|f| f.lost).count() as u64,
            },
            rows,
        })
    }
}

fn parse<T: serde::de::DeserializeOwned>(topic: &str, data: &[u8]) -> Result<T, String> {
    serde_json::from_slice(data).map_err(|e| format!("{topic}: {e}"))
}

impl Episode {
    /// Reads an MCAP episode without its images.
    pub fn read(path: &Path) -> Result<Self, EpisodeError> {
        let mut records = Records::open(path)?;
        let mut contents = Contents::default();
        let next = records.next(|record| contents.take(record).map(|()| None::<()>))?;
        let format = contents.text(format::META_EPISODE, "format");
        if format != format::FORMAT {
            let what = match (contents.metadata.contains_key(format::META_EPISODE), matches!(next, NextRecord::Cut)) {
                (true, _) => format!("format {format}, this program reads format {}", format::FORMAT),
                (false, true) => "its recorder was killed before anything was written".into(),
                (false, false) => "the metadata 'episode' is missing".into(),
            };
            return Err(EpisodeError::NotAnEpisode { file: records.name, what });
        }
        contents.episode(&records.name, matches!(next, NextRecord::End)).map_err(|what| records.damaged(what))
    }
}

/// One recorded image.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeImage {
    /// Low 32 bits of the camera's frame number.
    pub sequence: u32,
    /// Middle of the exposure, CLOCK_MONOTONIC ns: [`EpisodeRow::captured_at_ns`] of its frame.
    pub captured_at_ns: u64,
    /// `jpeg` or `png`.
    pub format: String,
    /// The compressed image.
    pub data: Vec<u8>,
}

/// The images of one episode, read one by one; ends after the first error.
pub struct EpisodeImages {
    records: Records,
    channels: Vec<u16>,
    ended: bool,
}

impl EpisodeImages {
    /// Opens an episode for its images.
    pub fn open(path: &Path) -> Result<Self, EpisodeError> {
        Ok(Self { records: Records::open(path)?, channels: Vec::new(), ended: false })
    }
}

impl Iterator for EpisodeImages {
    type Item = Result<EpisodeImage, EpisodeError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.ended {
            return None;
        }
        let channels = &mut self.channels;
        let next = self.records.next(|record| match record {
            Record::Channel(channel) if channel.topic == format::IMAGE_TOPIC => {
                channels.push(channel.id);
                Ok(None)
            }
            Record::Message { header, data } if channels.contains(&header.channel_id) => {
                let image = CompressedImage::decode(&*data).map_err(|e| format!("{}: {e}", format::IMAGE_TOPIC))?;
                let captured_at_ns = header.log_time;
                Ok(Some(EpisodeImage { sequence: header.sequence, captured_at_ns, format: image.format, data: image.data }))
            }
            _ => Ok(None),
        });
        match next {
            Ok(NextRecord::Item(image)) => Some(Ok(image)),
            Ok(NextRecord::End | NextRecord::Cut) => {
                self.ended = true;
                None
            }
            Err(e) => {
                self.ended = true;
                Some(Err(e))
            }
        }
    }
}

/// The episode files named by `paths`: files as they are, directories as their `*.mcap` in order of name.
pub fn find_episodes(paths: &[PathBuf]) -> Result<Vec<PathBuf>, EpisodeError> {
    let mut files = Vec::new();
    for path in paths {
        if !path.is_dir() {
            files.push(path.clone());
            continue;
        }
        let fail = |e: std::io::Error| EpisodeError::Read { file: path.display().to_string(), what: e.to_string() };
        let mut inside = Vec::new();
        for entry in std::fs::read_dir(path).map_err(fail)? {
            let file = entry.map_err(fail)?.path();
            if file.extension().is_some_and(|e| e == "mcap") && file.is_file() {
                inside.push(file);
            }
        }
        inside.sort();
        files.append(&mut inside);
    }
    Ok(files)
}
