//! Reads MCAP episodes, see [`crate::episode`]. It allocates and is for ordinary threads only.
//!
//! The file is read once from start to end, record by record, and every checksum in it is compared. A damaged file is an error, never a
//! panic and never a wrong number. Memory is bounded by one chunk and the rows.

use std::collections::{BTreeMap, BTreeSet};
use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use mcap::records::Record;
use prost::Message as _;

use super::format::{self, CompressedImage, RowMessage, TelemetryMessage};
use super::format_1;
use super::number::by_number;
use super::records::{EpisodeError, NextRecord, Records};
use super::rows::{EpisodeRow, EpisodeTrack, LostFrames, alpha_between_deg};
use super::weight::check_kept;
use super::{Episode, EpisodeInfo, EpisodeKind, GAP, is_gap};
use crate::framing::Framing;
use crate::gaussian_curve::Curve;
use crate::messages::Doubt;

/// How much older the last frame of a complete episode may be than the last tick, ns. Chosen by hand: so long a newer frame may still have
/// been on its way to the recorder.
const SILENT_END_NS: u64 = 500_000_000;

/// The number that the recorder gave the episode in the file `path`, and when it began, by the file's own first records; no more of it is read. `None`
/// where they do not say.
pub fn beginning(path: &Path) -> (Option<u64>, Option<SystemTime>) {
    let said = |about: &BTreeMap<String, String>| {
        let of = |key: &str| about.get(key).and_then(|number| number.parse::<u64>().ok());
        (of("episode"), of(format::STARTED_AT_UNIX_NS).and_then(|ns| UNIX_EPOCH.checked_add(Duration::from_nanos(ns))))
    };
    let Ok(mut records) = Records::open(path) else { return (None, None) };
    let next = records.next(|record| {
        Ok(match record {
            Record::Metadata(m) if m.name == format::META_EPISODE => Some(said(&m.metadata)),
            Record::Message { .. } => Some((None, None)),
            _ => None,
        })
    });
    if let Ok(NextRecord::Item(found)) = next { found } else { (None, None) }
}

/// Everything in a file except the images themselves.
#[derive(Default)]
struct Contents {
    /// Topic of each channel, and whether its messages are JSON, as in format 1.
    topics: BTreeMap<u16, (String, bool)>,
    frames: Vec<RowMessage>,
    ticks: Vec<TelemetryMessage>,
    images: u64,
    metadata: BTreeMap<String, BTreeMap<String, String>>,
}

impl Contents {
    fn take(&mut self, record: Record) -> Result<(), String> {
        match record {
            Record::Channel(channel) => {
                self.topics.insert(channel.id, (channel.topic, channel.message_encoding == "json"));
            }
            Record::Metadata(m) => {
                self.metadata.insert(m.name, m.metadata);
            }
            Record::Message { header, data } => match self.topics.get(&header.channel_id).map(|(topic, json)| (topic.as_str(), *json)) {
                Some((format::IMAGE_TOPIC, _)) => self.images += 1,
                Some((topic @ format::ROW_TOPIC, json)) => {
                    let row = if json { format_1::row(&data) } else { decode(&data) };
                    self.frames.push(row.map_err(|e| format!("{topic}: {e}"))?);
                }
                Some((topic @ format::TELEMETRY_TOPIC, json)) => {
                    let tick = if json { format_1::tick(&data) } else { decode(&data) };
                    self.ticks.push(tick.map_err(|e| format!("{topic}: {e}"))?);
                }
                _ => {}
            },
            _ => {}
        }
        Ok(())
    }

    /// The text under a key of a metadata record; empty if it is missing.
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
        check_kept(grams).map(Some).map_err(|e| format!("metadata 'weight': grams = {grams}: {e}"))
    }

    /// The rows of the episode; those of lost frames are filled in.
    fn rows(&self, started_at_ns: u64) -> Result<Vec<EpisodeRow>, String> {
        // The ticks are taken as the recorder took them, so that a lost frame gets the angles that it would have written.
        let mut track = EpisodeTrack::new();
        let mut ticks = self.ticks.iter();
        let t_s = |at_ns: u64| (i128::from(at_ns) - i128::from(started_at_ns)) as f64 / 1e9;
        let mut lost = LostFrames::default();
        let mut rows: Vec<EpisodeRow> = Vec::with_capacity(self.frames.len());
        for frame in &self.frames {
            let doubt = Doubt::ALL.into_iter().find(|d| d.words() == frame.doubt);
            let doubt = doubt.ok_or_else(|| format!("frame {}: unknown doubt '{}'", frame.sequence, frame.doubt))?;
            if !frame.alpha_commanded_deg.is_finite() || frame.area_px2 < 0.0 {
                return Err(format!("frame {}: commanded alpha {}, area {}", frame.sequence, frame.alpha_commanded_deg, frame.area_px2));
            }
            if let Some(last) = rows.last().copied() {
                if frame.sequence <= last.sequence || frame.captured_at_ns <= last.captured_at_ns {
                    return Err(format!("frame {} comes after frame {} in the file", frame.sequence, last.sequence));
                }
                for (sequence, share) in lost.between(last.sequence, frame.sequence)? {
                    let captured_at_ns = last.captured_at_ns + ((frame.captured_at_ns - last.captured_at_ns) as f64 * share) as u64;
                    while !track.covers(captured_at_ns)
                        && let Some(t) = ticks.next()
                    {
                        track.push(t.at_ns, t.alpha_deg, t.robot_at_ns, t.alpha_measured_deg);
                    }
                    let commanded_deg = track.commanded_deg(captured_at_ns);
                    let between_deg = alpha_between_deg(last.alpha_commanded_deg, frame.alpha_commanded_deg, share);
                    rows.push(EpisodeRow {
                        sequence,
                        captured_at_ns,
                        t_s: t_s(captured_at_ns),
                        alpha_commanded_deg: if commanded_deg.is_nan() { between_deg } else { commanded_deg },
                        alpha_measured_deg: track.measured_deg(captured_at_ns),
                        area_px2: f32::NAN,
                        doubt: Doubt::None,
                        lost: true,
                        image: false,
                    });
                }
            }
            rows.push(EpisodeRow {
                sequence: frame.sequence,
                captured_at_ns: frame.captured_at_ns,
                t_s: t_s(frame.captured_at_ns),
                alpha_commanded_deg: frame.alpha_commanded_deg,
                alpha_measured_deg: frame.alpha_measured_deg,
                area_px2: if doubt.usable(frame.area_px2) { frame.area_px2 } else { f32::NAN },
                doubt,
                lost: false,
                image: frame.image,
            });
        }
        Ok(rows)
    }

    /// Makes the episode called `name`. `whole` tells whether the file has its regular end.
    fn episode(self, name: &str, whole: bool) -> Result<Episode, String> {
        let started_at_ns = self.number(format::META_EPISODE, "started_at_ns")?;
        self.metadata.get(format::META_EPISODE).map_or(Ok(0), clock_offset_ns)?;
        let rows = self.rows(started_at_ns)?;
        let text = |key: &str| self.text(format::META_EPISODE, key).to_string();
        let (first_tick, last_tick) = (self.ticks.first().map_or(0, |t| t.tick), self.ticks.last().map_or(0, |t| t.tick));
        let last_at_ns = self.ticks.last().map_or(0, |t| t.at_ns);
        let measured_to_the_end = rows.last().is_some_and(|r| r.captured_at_ns.saturating_add(SILENT_END_NS) >= last_at_ns);
        let all_ticks = !self.ticks.windows(2).any(|pair| is_gap((pair[0].tick, pair[0].at_ns), (pair[1].tick, pair[1].at_ns)));
        let closed_whole = self.text(format::META_END, "complete") == "true";
        let ended_whole = closed_whole && measured_to_the_end && all_ticks;
        let ended = match closed_whole {
            true if !all_ticks => GAP,
            true if !measured_to_the_end => "the camera fell silent before its end",
            _ => self.text(format::META_END, "reason"),
        };
        Ok(Episode {
            name: name.into(),
            kind: self.kind()?,
            weight_g: self.weight_g()?,
            complete: whole && ended_whole,
            info: EpisodeInfo {
                started_at_utc: text("started_at_utc"),
                started_at_ns,
                number: text("episode").parse().ok(),
                cell: text("cell"),
                config_sha256: text("config_sha256"),
                framing: Framing::of_toml(self.text(format::META_CONFIG, "toml")),
                weights: text("weights"),
                ended: ended.into(),
                recoverable: ended_whole && !whole,
                note: self.text(format::META_NOTE, "text").into(),
                poured_ml: self.ticks.last().map(|t| t.poured_ml).filter(|ml| ml.is_finite()),
                ticks: self.ticks.len() as u64,
                lost_ticks: last_tick.saturating_sub(first_tick).saturating_add(1).saturating_sub(self.ticks.len() as u64),
                images: self.images,
                dropped_images: self.frames.iter().filter(|f| !f.image).count() as u64,
                lost_frames: rows.iter().filter(|r| r.lost).count() as u64,
            },
            rows,
        })
    }
}

/// A protobuf message of format 2.
fn decode<T: prost::Message + Default>(data: &[u8]) -> Result<T, String> {
    T::decode(data).map_err(|e| e.to_string())
}

impl Episode {
    /// Reads an MCAP episode without its images.
    pub fn read(path: &Path) -> Result<Self, EpisodeError> {
        let mut records = Records::open(path)?;
        let mut contents = Contents::default();
        let next = records.next(|record| contents.take(record).map(|()| None::<()>))?;
        let format = contents.text(format::META_EPISODE, "format");
        if ![format::FORMAT_1, format::FORMAT].contains(&format) {
            let what = match (contents.metadata.contains_key(format::META_EPISODE), matches!(next, NextRecord::Cut)) {
                (true, _) => format!("it has format {format}, but this program reads formats {} and {}", format::FORMAT_1, format::FORMAT),
                (false, true) => "its recorder was killed before anything was written".into(),
                (false, false) => "the metadata 'episode' is missing".into(),
            };
            return Err(EpisodeError::NotAnEpisode { file: records.name().into(), what });
        }
        contents.episode(records.name(), matches!(next, NextRecord::End)).map_err(|what| records.damaged(what))
    }
}

/// One recorded image.
#[derive(Debug, Clone, PartialEq)]
pub struct EpisodeImage {
    /// Low 32 bits of the camera's frame number.
    pub sequence: u32,
    /// Middle of the exposure, CLOCK_MONOTONIC ns: [`EpisodeRow::captured_at_ns`] of its row.
    pub captured_at_ns: u64,
    /// `jpeg` or `png`.
    pub format: String,
    /// The compressed image.
    pub data: Vec<u8>,
}

/// The images of one episode, read one by one. The iterator ends after the first error.
pub struct EpisodeImages {
    records: Records,
    channels: Vec<u16>,
    /// Unix time less CLOCK_MONOTONIC, ns; 0 in format 1, whose log times are CLOCK_MONOTONIC; `None` before the file has said it.
    offset_ns: Option<i128>,
    ended: bool,
}

impl EpisodeImages {
    /// Opens an episode for its images.
    pub fn open(path: &Path) -> Result<Self, EpisodeError> {
        Ok(Self { records: Records::open(path)?, channels: Vec::new(), offset_ns: None, ended: false })
    }
}

impl Iterator for EpisodeImages {
    type Item = Result<EpisodeImage, EpisodeError>;

    fn next(&mut self) -> Option<Self::Item> {
        if self.ended {
            return None;
        }
        let (channels, offset_ns) = (&mut self.channels, &mut self.offset_ns);
        let next = self.records.next(|record| match record {
            Record::Channel(channel) if channel.topic == format::IMAGE_TOPIC => {
                channels.push(channel.id);
                Ok(None)
            }
            Record::Metadata(m) if m.name == format::META_EPISODE => {
                *offset_ns = Some(clock_offset_ns(&m.metadata)?);
                Ok(None)
            }
            Record::Message { header, data } if channels.contains(&header.channel_id) => {
                let offset_ns = offset_ns.ok_or("an image comes before the metadata 'episode'")?;
                let image = CompressedImage::decode(&*data).map_err(|e| format!("{}: {e}", format::IMAGE_TOPIC))?;
                let captured_at_ns = format::monotonic_ns(header.log_time, offset_ns);
                Ok(Some(EpisodeImage { sequence: header.sequence, captured_at_ns, format: image.format, data: image.data }))
            }
            _ => Ok(None),
        });
        let item = match next {
            Ok(NextRecord::Item(image)) => return Some(Ok(image)),
            Ok(NextRecord::End | NextRecord::Cut) => None,
            Err(e) => Some(Err(e)),
        };
        self.ended = true;
        item
    }
}

/// Unix time less CLOCK_MONOTONIC by the metadata about the start, ns; 0 in format 1.
fn clock_offset_ns(about: &BTreeMap<String, String>) -> Result<i128, String> {
    let text = |key: &str| about.get(key).map_or("", String::as_str);
    if text("format") == format::FORMAT_1 {
        return Ok(0);
    }
    let offset = text(format::CLOCK_OFFSET);
    offset.parse::<i64>().map(i128::from).map_err(|_| format!("metadata 'episode': {} = '{offset}' is not a number", format::CLOCK_OFFSET))
}

/// The episode files that `paths` name: files as they are, directories as the `*.mcap` in them in the order of [`by_number`]. What is named twice, also by
/// another way to the same directory, is there once.
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
            // A link that leads nowhere is an episode that cannot be read, and whoever opens it says so.
            if file.extension().is_some_and(|e| e == "mcap") && !file.is_dir() {
                inside.push(file);
            }
        }
        inside.sort_by(|a, b| by_number(a, b));
        files.append(&mut inside);
    }
    Ok(each_once(files))
}

/// The episode files of a directory that is looked at again and again. One that is not there yet is empty, as long as no episode is `known`: nothing has
/// been recorded. One that cannot be read, or is gone, fails.
pub fn episodes_so_far(directory: &Path, known: bool) -> Result<Vec<PathBuf>, EpisodeError> {
    match std::fs::read_dir(directory) {
        Err(e) if e.kind() == std::io::ErrorKind::NotFound && !known => Ok(Vec::new()),
        Err(e) => Err(EpisodeError::Read { file: directory.display().to_string(), what: e.to_string() }),
        Ok(_) => find_episodes(&[directory.to_path_buf()]),
    }
}

/// `files` without those that are named twice: by the same name in the same directory, whichever way leads there.
pub fn each_once(mut files: Vec<PathBuf>) -> Vec<PathBuf> {
    let mut seen = BTreeSet::new();
    files.retain(|file| {
        let directory = file.parent().filter(|p| !p.as_os_str().is_empty()).unwrap_or(Path::new("."));
        // What is not there is said by whoever opens it.
        let (Ok(place), Some(name)) = (directory.metadata(), file.file_name()) else { return true };
        seen.insert((place.dev(), place.ino(), name.to_os_string()))
    });
    files
}
