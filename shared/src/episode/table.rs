//! The CSV pair: `features.csv` (`episode, frame, t_s, alpha_deg, area_px2`) and `scale.csv` (`episode, weight_g`), for people
//! who have their own vision. Allocates; ordinary threads only.
//!
//! Columns are found by their names; others are ignored. The rows of an episode stand together in order of `frame`; a
//! missing frame number is a lost frame, an `area_px2` of `nan` or nothing is a frame that gave no measurement.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::path::Path;

use super::{Episode, EpisodeInfo, EpisodeKind, EpisodeRow};
use crate::messages::Doubt;

/// Most frames in a row that can be lost; more is a wrong number.
const GAP_LIMIT: u64 = 10_000;

/// Why a pair of tables is refused or cannot be written.
#[derive(Debug, thiserror::Error)]
pub enum TableError {
    /// The file cannot be opened, read or written.
    #[error("{file}: {what}")]
    File {
        /// The file.
        file: String,
        /// The system's words.
        what: String,
    },
    /// A row or the heading is wrong.
    #[error("{file}:{line}: {what}")]
    Row {
        /// The file.
        file: String,
        /// Line in it; the heading is 1.
        line: u64,
        /// What is wrong and what is wanted.
        what: String,
    },
}

/// A table being read.
struct CsvTable {
    name: String,
    reader: csv::Reader<File>,
    columns: Vec<usize>,
}

/// One row of the wanted columns.
struct CsvRow<'a> {
    file: &'a str,
    line: u64,
    fields: Vec<&'a str>,
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
    fn open(path: &Path, wanted: &[&str]) -> Result<Self, TableError> {
        let name = path.display().to_string();
        let fail = |what: String| TableError::File { file: name.clone(), what };
        let file = File::open(path).map_err(|e| fail(e.to_string()))?;
        let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_reader(file);
        let heading = reader.headers().map_err(|e| fail(e.to_string()))?.clone();
        let mut columns = Vec::new();
        for column in wanted {
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
        Ok(Self { name, reader, columns })
    }

    /// Shows each row to `take`.
    fn rows(mut self, mut take: impl FnMut(&CsvRow) -> Result<(), TableError>) -> Result<(), TableError> {
        let mut record = csv::StringRecord::new();
        loop {
            match self.reader.read_record(&mut record) {
                Ok(false) => return Ok(()),
                Ok(true) => {
                    let line = record.position().map_or(0, csv::Position::line);
                    // The reader refuses rows of another length than the heading's, so every column is there.
                    let fields = self.columns.iter().map(|c| record.get(*c).unwrap_or("")).collect();
                    take(&CsvRow { file: &self.name, line, fields })?;
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

/// Reads the pair; episodes in the order of their first row in `features`. All of them are complete and have a weight.
pub fn read_table(features: &Path, scale: &Path) -> Result<Vec<Episode>, TableError> {
    let mut episodes: Vec<Episode> = Vec::new();
    let mut first_line: BTreeMap<String, u64> = BTreeMap::new();
    CsvTable::open(features, &["episode", "frame", "t_s", "alpha_deg", "area_px2"])?.rows(|row| {
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
            Some(episode) => add_row(&mut episode.rows, row),
            None => Ok(()),
        }
    })?;
    if episodes.is_empty() {
        return Err(TableError::File { file: features.display().to_string(), what: "no rows below the heading".into() });
    }
    for episode in &mut episodes {
        episode.info.lost_frames = episode.rows.iter().filter(|f| f.lost).count() as u64;
    }

    let mut weighed: BTreeMap<String, u64> = BTreeMap::new();
    CsvTable::open(scale, &["episode", "weight_g"])?.rows(|row| {
        let name = row.fields[0];
        if let Some(line) = weighed.insert(name.into(), row.line) {
            return Err(row.error(format!("episode {name} has a weight in line {line} already")));
        }
        let weight_g: f64 = row.number(1, "weight_g", "the scale's reading in g")?;
        if !weight_g.is_finite() || weight_g < 0.0 {
            return Err(row.error(format!("weight_g '{}': a finite number above 0 is wanted", row.fields[1])));
        }
        if weight_g == 0.0 {
            return Err(row.error(format!("weight_g 0: nothing was poured in episode {name}; leave it out of both tables")));
        }
        match episodes.iter_mut().find(|e| e.name == name) {
            Some(episode) => episode.weight_g = Some(weight_g),
            None => return Err(row.error(format!("episode {name} is not in {}", features.display()))),
        }
        Ok(())
    })?;
    if let Some(episode) = episodes.iter().find(|e| e.weight_g.is_none()) {
        let line = first_line.get(&episode.name).copied().unwrap_or(0);
        let what = format!("episode {} has no weight in {}", episode.name, scale.display());
        return Err(TableError::Row { file: features.display().to_string(), line, what });
    }
    Ok(episodes)
}

fn add_row(rows: &mut Vec<EpisodeRow>, row: &CsvRow) -> Result<(), TableError> {
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
        let steps = sequence - last.sequence;
        if steps > GAP_LIMIT {
            return Err(row.error(format!("frame jumps from {} to {sequence}", last.sequence)));
        }
        for step in 1..steps {
            let share = step as f64 / steps as f64;
            let alpha = f64::from(last.alpha_commanded_deg) + share * (f64::from(alpha_deg) - f64::from(last.alpha_commanded_deg));
            rows.push(frame(last.sequence + step, last.t_s + share * (t_s - last.t_s), alpha as f32, f32::NAN));
        }
    }
    rows.push(frame(sequence, t_s, alpha_deg, area_px2));
    Ok(())
}

fn frame(sequence: u64, t_s: f64, alpha_deg: f32, area_px2: f32) -> EpisodeRow {
    EpisodeRow {
        sequence,
        captured_at_ns: 0,
        t_s,
        alpha_commanded_deg: alpha_deg,
        alpha_measured_deg: alpha_deg,
        area_px2,
        doubt: Doubt::None,
        lost: area_px2.is_nan(),
    }
}

/// Writes the pair; the alpha in it is the commanded one, lost frames are rows without area. Neither file may exist.
/// Episodes are numbered from 1 in their order; those without a weight are in `features` only.
pub fn write_table(episodes: &[Episode], features: &Path, scale: &Path) -> Result<(), TableError> {
    let create = |path: &Path| {
        let fail = |e: std::io::Error| TableError::File { file: path.display().to_string(), what: e.to_string() };
        OpenOptions::new().write(true).create_new(true).open(path).map(csv::Writer::from_writer).map_err(fail)
    };
    let fail = |path: &Path, e: &dyn std::fmt::Display| TableError::File { file: path.display().to_string(), what: e.to_string() };
    let mut rows = create(features)?;
    let mut weights = create(scale)?;
    rows.write_record(["episode", "frame", "t_s", "alpha_deg", "area_px2"]).map_err(|e| fail(features, &e))?;
    weights.write_record(["episode", "weight_g"]).map_err(|e| fail(scale, &e))?;
    for (index, episode) in episodes.iter().enumerate() {
        let number = (index + 1).to_string();
        for f in &episode.rows {
            let area = if f.area_px2.is_nan() { "nan".into() } else { f.area_px2.to_string() };
            rows.write_record([&number, &f.sequence.to_string(), &f.t_s.to_string(), &f.alpha_commanded_deg.to_string(), &area])
                .map_err(|e| fail(features, &e))?;
        }
        if let Some(weight_g) = episode.weight_g {
            weights.write_record([number, weight_g.to_string()]).map_err(|e| fail(scale, &e))?;
        }
    }
    rows.flush().map_err(|e| fail(features, &e))?;
    weights.flush().map_err(|e| fail(scale, &e))
}
