//! The CSV pair: `features.csv` (`episode, frame, t_s, alpha_deg, area_px2`) and `scale.csv` (`episode, weight_g`), for people
//! who measure V_e with software of their own. It allocates and is for ordinary threads only. Each error is one line of text that names the
//! file and the line in it.
//!
//! Columns are found by their names, and other columns are ignored. The rows of an episode stand together in order of `frame`. A frame
//! number that is missing stands for a lost frame; so does an `area_px2` that is `nan` or empty. What the columns say that need not be there is not known
//! where they are missing or empty.

use std::collections::BTreeMap;
use std::fs::File;
use std::path::Path;

use super::rows::{EpisodeRow, LostFrames, alpha_between_deg};
use super::weight::{WeightError, check_reading};
use super::{Episode, EpisodeInfo, EpisodeKind};
use crate::framing::Framing;
use crate::messages::Doubt;
use crate::{regular_file, whole_file};

/// The columns of the table of features. Their names are part of the format.
const FEATURE_COLUMNS: [&str; 5] = ["episode", "frame", "t_s", "alpha_deg", "area_px2"];
/// The columns of it that need not be there: the joint's measured angle, degrees, which may be `nan`, and why the area is doubtful, in the words of
/// [`Doubt::words`].
const FEATURE_MORE: [&str; 2] = ["alpha_measured_deg", "doubt"];
/// The columns of the table of weights. Their names are part of the format.
const SCALE_COLUMNS: [&str; 2] = ["episode", "weight_g"];
/// The columns of it that need not be there: the cell's name, and how the lip lay in the pictures ([`Framing::text`]).
const SCALE_MORE: [&str; 2] = ["cell", "framing"];

/// Largest table that is read, bytes. Chosen by hand: ten hours of frames take 50 MB.
const FILE_MAX: u64 = 256 << 20;

/// Why a pair of tables is refused or cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// The file cannot be opened, read or written.
    #[error("{file}: {what}")]
    File {
        /// The file.
        file: String,
        /// The operating system's message.
        what: String,
    },
    /// A row or the heading is wrong.
    #[error("{file}:{line}: {what}")]
    Row {
        /// The file.
        file: String,
        /// The line in the file; the heading is line 1.
        line: u64,
        /// What is wrong and what is expected.
        what: String,
    },
}

/// A table being read.
struct CsvTable {
    name: String,
    reader: csv::Reader<File>,
    /// Where each wanted column stands in a row.
    columns: Vec<usize>,
    /// Where each column stands that need not be there.
    more: [Option<usize>; 2],
}

/// One row, reduced to the wanted columns.
struct CsvRow<'a> {
    file: &'a str,
    line: u64,
    fields: Vec<&'a str>,
    /// The columns that need not be there; empty where they are not.
    more: [&'a str; 2],
}

impl CsvRow<'_> {
    fn error(&self, what: String) -> TableError {
        TableError::Row { file: self.file.into(), line: self.line, what }
    }

    fn number<T: std::str::FromStr>(&self, index: usize, column: &str, wanted: &str) -> Result<T, TableError> {
        let text = self.fields[index];
        text.parse().map_err(|_| self.error(format!("{column} '{text}': {wanted} is wanted")))
    }
}

impl CsvTable {
    fn open(path: &Path, wanted: &[&str], more: [&str; 2]) -> Result<Self, TableError> {
        let name = path.display().to_string();
        let fail = |what: String| TableError::File { file: name.clone(), what };
        let (file, _) = regular_file::open_at_most(path, FILE_MAX).map_err(|e| fail(e.to_string()))?;
        let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(file);
        let heading = reader.headers().map_err(|e| fail(e.to_string()))?.clone();
        let mut columns = Vec::new();
        for column in wanted {
            // Some spreadsheets begin a file with a byte-order mark.
            let mut places = heading.iter().enumerate().filter(|(_, name)| name.trim_start_matches('\u{feff}') == *column);
            let what = match (places.next(), places.next()) {
                (Some((place, _)), None) => {
                    columns.push(place);
                    continue;
                }
                (None, _) => format!("column '{column}' is missing; the first line must name {}", wanted.join(",")),
                (Some(_), Some(_)) => format!("column '{column}' is there twice"),
            };
            return Err(TableError::Row { file: name, line: 1, what });
        }
        let more = more.map(|wanted| heading.iter().position(|column| column == wanted));
        Ok(Self { name, reader, columns, more })
    }

    /// Shows each row to `take`.
    fn for_each_row(mut self, mut take: impl FnMut(&CsvRow) -> Result<(), TableError>) -> Result<(), TableError> {
        let mut record = csv::StringRecord::new();
        loop {
            match self.reader.read_record(&mut record) {
                Ok(false) => return Ok(()),
                Ok(true) => {
                    let line = record.position().map_or(0, csv::Position::line);
                    // The reader refuses rows of another length than the heading's, so every column is there.
                    let fields = self.columns.iter().map(|c| record.get(*c).unwrap_or("")).collect();
                    let more = self.more.map(|column| column.and_then(|c| record.get(c)).unwrap_or(""));
                    take(&CsvRow { file: &self.name, line, fields, more })?;
                }
                Err(e) => {
                    let line = e.position().map_or(0, csv::Position::line);
                    let what = match e.kind() {
                        csv::ErrorKind::UnequalLengths { expected_len, len, .. } => {
                            format!("{len} fields where the heading has {expected_len}")
                        }
                        csv::ErrorKind::Utf8 { .. } => "not UTF-8 text".into(),
                        _ => e.to_string(),
                    };
                    return Err(TableError::Row { file: self.name, line, what });
                }
            }
        }
    }
}

/// Reads the pair. The episodes come in the order of their first row in `features`; all of them are complete. One that `scale` does not name has no weight.
pub fn read_table(features: &Path, scale: &Path) -> Result<Vec<Episode>, TableError> {
    let mut episodes = read_features(features)?;
    read_weights(scale, features, &mut episodes)?;
    Ok(episodes)
}

/// The episodes without their weights.
fn read_features(features: &Path) -> Result<Vec<Episode>, TableError> {
    let mut episodes: Vec<Episode> = Vec::new();
    let mut first_line: BTreeMap<String, u64> = BTreeMap::new();
    let mut lost = LostFrames::default();
    CsvTable::open(features, &FEATURE_COLUMNS, FEATURE_MORE)?.for_each_row(|row| {
        let name = row.fields[0];
        if name.is_empty() {
            return Err(row.error("episode is empty: a name or number is wanted".into()));
        }
        if episodes.last().is_none_or(|e| e.name != name) {
            if let Some(line) = first_line.insert(name.into(), row.line) {
                return Err(row.error(format!("episode {name} began in line {line} already; keep the rows of an episode together")));
            }
            episodes.push(Episode {
                name: name.into(),
                kind: EpisodeKind::Table,
                rows: Vec::new(),
                weight_g: None,
                complete: true,
                info: EpisodeInfo::default(),
            });
        }
        match episodes.last_mut() {
            Some(episode) => add_row(&mut episode.rows, &mut lost, row),
            None => Ok(()),
        }
    })?;
    if episodes.is_empty() {
        return Err(TableError::File { file: features.display().to_string(), what: "no rows below the heading".into() });
    }
    for episode in &mut episodes {
        episode.info.lost_frames = episode.rows.iter().filter(|r| r.lost).count() as u64;
    }
    Ok(episodes)
}

/// Enters the weights into the episodes that were read from `features`.
fn read_weights(scale: &Path, features: &Path, episodes: &mut [Episode]) -> Result<(), TableError> {
    let mut weighed: BTreeMap<String, u64> = BTreeMap::new();
    CsvTable::open(scale, &SCALE_COLUMNS, SCALE_MORE)?.for_each_row(|row| {
        let (name, weight) = (row.fields[0], row.fields[1]);
        if let Some(line) = weighed.insert(name.into(), row.line) {
            return Err(row.error(format!("episode {name} has a weight in line {line} already")));
        }
        let weight_g = weight.parse().map_err(|_| WeightError::NotAReading).and_then(check_reading);
        let weight_g = weight_g.map_err(|e| row.error(format!("weight_g '{weight}': {e}")))?;
        let Some(episode) = episodes.iter_mut().find(|e| e.name == name) else {
            return Err(row.error(format!("episode {name} is not in {}", features.display())));
        };
        let [cell, framing] = row.more;
        if !framing.is_empty() {
            episode.info.framing = Framing::of_text(framing).ok_or_else(|| {
                row.error(format!(
                    "framing '{framing}': width, height and the lip's place, px, the axes' directions, degrees, and colour or clear are wanted"
                ))
            })?;
        }
        (episode.weight_g, episode.info.cell) = (Some(weight_g), cell.into());
        Ok(())
    })
}

/// Adds a row of the table to an episode, after the rows of the frames that are missing before it.
fn add_row(rows: &mut Vec<EpisodeRow>, lost: &mut LostFrames, row: &CsvRow) -> Result<(), TableError> {
    let sequence: u64 = row.number(1, "frame", "a whole number")?;
    let t_s: f64 = row.number(2, "t_s", "seconds")?;
    let alpha_deg: f32 = row.number(3, "alpha_deg", "degrees")?;
    let area_px2: f32 = if row.fields[4].is_empty() { f32::NAN } else { row.number(4, "area_px2", "px^2, or nan")? };
    if !t_s.is_finite() || !alpha_deg.is_finite() {
        return Err(row.error(format!("t_s '{}', alpha_deg '{}': both must be finite", row.fields[2], row.fields[3])));
    }
    if area_px2.is_infinite() || area_px2 < 0.0 {
        return Err(row.error(format!("area_px2 '{}': at least 0 and finite is wanted, or nan for no measurement", row.fields[4])));
    }
    let [measured, doubt] = row.more;
    let alpha_measured_deg =
        if measured.is_empty() { Some(f32::NAN) } else { measured.parse::<f32>().ok().filter(|deg| !deg.is_infinite()) };
    let alpha_measured_deg =
        alpha_measured_deg.ok_or_else(|| row.error(format!("{} '{measured}': degrees, or nan, are wanted", FEATURE_MORE[0])))?;
    let doubt = Doubt::ALL.into_iter().find(|d| d.words() == doubt || (doubt.is_empty() && *d == Doubt::None));
    let doubt = doubt.ok_or_else(|| row.error(format!("doubt '{}': none, or the words for a doubt, are wanted", row.more[1])))?;
    if let Some(last) = rows.last().copied() {
        if sequence == last.sequence {
            return Err(row.error(format!("frame {sequence} is there twice")));
        }
        if sequence < last.sequence {
            return Err(row.error(format!("frame {sequence} comes after frame {}; sort the table by episode and frame", last.sequence)));
        }
        if t_s <= last.t_s {
            return Err(row.error(format!("t_s {t_s} is not after {} of the frame before", last.t_s)));
        }
        for (between, share) in lost.between(last.sequence, sequence).map_err(|e| row.error(e))? {
            let alpha_between_deg = alpha_between_deg(last.alpha_commanded_deg, alpha_deg, share);
            // As the joint stood between two frames, it is taken to have moved evenly.
            let measured_between_deg = last.alpha_measured_deg + share as f32 * (alpha_measured_deg - last.alpha_measured_deg);
            let between_s = last.t_s + share * (t_s - last.t_s);
            rows.push(episode_row(between, between_s, [alpha_between_deg, measured_between_deg], f32::NAN, Doubt::None));
        }
    }
    rows.push(episode_row(sequence, t_s, [alpha_deg, alpha_measured_deg], area_px2, doubt));
    Ok(())
}

fn episode_row(sequence: u64, t_s: f64, [alpha_commanded_deg, alpha_measured_deg]: [f32; 2], area_px2: f32, doubt: Doubt) -> EpisodeRow {
    EpisodeRow {
        sequence,
        captured_at_ns: 0,
        t_s,
        alpha_commanded_deg,
        alpha_measured_deg,
        area_px2: if doubt.usable(area_px2) { area_px2 } else { f32::NAN },
        doubt,
        lost: area_px2.is_nan() && doubt == Doubt::None,
        image: false,
    }
}

/// A number as the table has it.
fn number_or_nan(value: f32) -> String {
    if value.is_nan() { "nan".into() } else { value.to_string() }
}

/// Writes the pair; neither file may exist. The `alpha_deg` in it is the commanded one, and lost frames are rows without area. Episodes are
/// numbered from 1 in their order; those without a weight are in `features` only. What cannot be written whole is not written at all.
pub fn write_table(episodes: &[Episode], features: &Path, scale: &Path) -> Result<(), TableError> {
    let fail = |path: &Path, e: &dyn std::fmt::Display| TableError::File { file: path.display().to_string(), what: e.to_string() };
    let mut rows = csv::Writer::from_writer(Vec::new());
    let mut weights = csv::Writer::from_writer(Vec::new());
    rows.write_record(FEATURE_COLUMNS.iter().chain(&FEATURE_MORE)).map_err(|e| fail(features, &e))?;
    weights.write_record(SCALE_COLUMNS.iter().chain(&SCALE_MORE)).map_err(|e| fail(scale, &e))?;
    for (index, episode) in episodes.iter().enumerate() {
        let number = (index + 1).to_string();
        for r in &episode.rows {
            let [alpha, measured, area] = [r.alpha_commanded_deg, r.alpha_measured_deg, r.area_px2].map(number_or_nan);
            let row = [number.as_str(), &r.sequence.to_string(), &r.t_s.to_string(), &alpha, &area, &measured, r.doubt.words()];
            rows.write_record(row).map_err(|e| fail(features, &e))?;
        }
        if let Some(weight_g) = episode.weight_g {
            let info = &episode.info;
            weights
                .write_record([number.as_str(), &weight_g.to_string(), &info.cell, &info.framing.text()])
                .map_err(|e| fail(scale, &e))?;
        }
    }
    let (rows, weights) = (rows.into_inner().map_err(|e| fail(features, &e))?, weights.into_inner().map_err(|e| fail(scale, &e))?);
    whole_file::create(features, &rows).map_err(|e| fail(features, &e))?;
    whole_file::create(scale, &weights).map_err(|e| {
        // It was not there before, so it is ours, and the pair is useless without the other.
        let _ = std::fs::remove_file(features);
        fail(scale, &e)
    })
}
