//! Writes one episode's MCAP file, see [`crate::episode`]. It allocates and is for ordinary threads only. Every error is a [`WriteError`].
//!
//! A chunk is built in memory and written whole at least every half second, always between two frames. A recorder that is killed
//! therefore leaves a file that can be read up to then. The messages of a file are in the order of their times, although a frame is written
//! after the tick that follows it. A new file never takes the name of one that is there. While it is written it is locked, so that nothing
//! that deletes episodes takes it away.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{BufWriter, ErrorKind};
use std::path::{Path, PathBuf};
use std::time::{SystemTime, UNIX_EPOCH};

use mcap::records::MessageHeader;
use mcap::{McapError, WriteOptions, Writer};
use sha2::{Digest, Sha256};

use super::format::{self, CompressedImage, FeatureMessage, ImageAnnotations, RowMessage, TelemetryMessage};
use super::number::{LARGEST, take_number};
use super::{EpisodeKind, hex, schema};
use crate::config::Config;
use crate::disk_space::error_words;
use crate::messages::{Doubt, Feature, Telemetry};
use crate::regular_file::{ASTRAY, is_at};

/// A chunk is closed when it is this old, ns. Chosen by hand: a killed recorder loses at most half a second.
const CHUNK_NS: u64 = 500_000_000;
/// A chunk is closed when it is this large, bytes. Chosen by hand; no measurement is recorded.
const CHUNK_BYTES: usize = 1 << 20;
/// A frame is written at most so much later than a tick of its time, ns. Chosen by hand: twice as long as the recorder waits for a frame.
const LATE_NS: u64 = 1_000_000_000;
/// Number of bytes that are handed to the operating system at a time. Chosen by hand; no measurement is recorded.
const WRITE_BYTES: usize = 1 << 16;

/// Why an episode cannot be written. What was written before is in the file.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The directory cannot be read or made.
    #[error("{directory}: {what}; make the directory of [recording] directory writable")]
    Directory {
        /// The directory.
        directory: String,
        /// The operating system's message.
        what: String,
    },
    /// Creating or writing the file failed.
    #[error("{file}: {what}; check free space and permissions")]
    File {
        /// The file.
        file: String,
        /// The operating system's message.
        what: String,
    },
    /// The file is not at its path any more, so that nobody finds the episode.
    #[error("{file} {ASTRAY}")]
    Astray {
        /// The path.
        file: String,
    },
}

/// What is known when an episode starts.
#[derive(Debug, Clone)]
pub struct EpisodeStart<'a> {
    /// Number of the pour or recording, as in [`Telemetry::episode`].
    pub episode: u64,
    /// What the controller runs.
    pub kind: EpisodeKind,
    /// First tick of the episode, CLOCK_MONOTONIC ns.
    pub started_at_ns: u64,
    /// The wall-clock time of that tick.
    pub wall_clock: SystemTime,
    /// The cell's configuration, all of which goes into the file.
    pub config: &'a Config,
    /// Identity of the weights that the controller runs; empty if it has none.
    pub weights: &'a str,
}

/// One frame as it is written: its feature, its angles and its image.
#[derive(Debug, Clone, Copy)]
pub struct FrameRow<'a> {
    /// What was measured in the frame.
    pub feature: &'a Feature,
    /// Commanded alpha at the capture time, degrees.
    pub alpha_commanded_deg: f32,
    /// Measured alpha at the capture time, degrees; NaN if unknown.
    pub alpha_measured_deg: f32,
    /// Format (`jpeg` or `png`) and bytes of the image; `None` if it was dropped.
    pub image: Option<(&'a str, &'a [u8])>,
}

/// How an episode ended.
#[derive(Debug, Clone, Copy)]
pub struct EpisodeEnd<'a> {
    /// Whether nothing is missing at the end.
    pub complete: bool,
    /// Why it ended: one line for people.
    pub reason: &'a str,
    /// Number of frames that came twice or out of order and were left out.
    pub disordered_frames: u64,
}

/// An episode being written. If it is dropped without [`EpisodeWriter::finish`], its file is incomplete.
pub struct EpisodeWriter {
    writer: Writer<BufWriter<File>>,
    path: PathBuf,
    /// Channels of the images, what is drawn over them, the features, the ticks and the rows.
    channels: [u16; 5],
    /// Unix time less CLOCK_MONOTONIC, ns.
    offset_ns: i128,
    chunk_since_ns: u64,
    /// What is not in a chunk yet.
    pending: Vec<Pending>,
    pending_bytes: usize,
}

/// A message that waits for those before it.
struct Pending {
    at_ns: u64,
    channel: u16,
    sequence: u32,
    data: Vec<u8>,
}

impl EpisodeWriter {
    /// Creates `episode-NNNN.mcap` in `directory` (made if missing) and writes what is known at the start. NNNN is the episode's number,
    /// or the next free one if that has a file already.
    pub fn create(directory: &Path, start: &EpisodeStart) -> Result<Self, WriteError> {
        let (file, path) = create_file(directory, start.episode)?;
        // A file in which not even this stands, because the disk or a quota is full, is no episode, and would count as one.
        Self::begin(file, path.clone(), start).inspect_err(|_| drop(std::fs::remove_file(&path)))
    }

    fn begin(file: File, path: PathBuf, start: &EpisodeStart) -> Result<Self, WriteError> {
        let fail = |e: McapError| WriteError::File { file: path.display().to_string(), what: mcap_words(&e) };
        let options = WriteOptions::new()
            .compression(None)
            .chunk_size(None)
            .disable_seeking(true)
            .library(concat!("decant ", env!("CARGO_PKG_VERSION")));
        let mut writer = Writer::with_options(BufWriter::with_capacity(WRITE_BYTES, file), options).map_err(fail)?;
        let none = BTreeMap::new();
        let mut channels = [0; 5];
        for (channel, (topic, name, schema)) in channels.iter_mut().zip(schema::channels()) {
            let schema = writer.add_schema(name, "protobuf", &schema).map_err(fail)?;
            *channel = writer.add_channel(schema, topic, "protobuf", &none).map_err(fail)?;
        }
        let unix_ns = start.wall_clock.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos());
        let mut this = Self {
            writer,
            path,
            channels,
            offset_ns: unix_ns as i128 - i128::from(start.started_at_ns),
            chunk_since_ns: start.started_at_ns,
            pending: Vec::new(),
            pending_bytes: 0,
        };
        this.describe(start)?;
        Ok(this)
    }

    /// The path of the file.
    pub fn path(&self) -> &Path {
        &self.path
    }

    fn describe(&mut self, start: &EpisodeStart) -> Result<(), WriteError> {
        let config = toml::to_string(start.config).unwrap_or_default();
        let config_sha256 = hex(&Sha256::digest(config.as_bytes()));
        let unix_ns = start.wall_clock.duration_since(UNIX_EPOCH).map_or(0, |d| d.as_nanos());
        let mut about = vec![
            ("format", format::FORMAT.to_string()),
            ("episode", start.episode.to_string()),
            ("cell", start.config.cell.name.clone()),
            ("started_at_ns", start.started_at_ns.to_string()),
            (format::STARTED_AT_UNIX_NS, unix_ns.to_string()),
            (format::CLOCK_OFFSET, self.offset_ns.to_string()),
            ("started_at_utc", rfc3339((unix_ns / 1_000_000_000) as u64)),
            ("config_sha256", config_sha256.clone()),
            ("weights", start.weights.to_string()),
        ];
        match start.kind {
            EpisodeKind::Recording(curve) => about.extend([
                ("kind", "recording".to_string()),
                ("lambda_deg", curve.lambda_deg.to_string()),
                ("gamma_per_s2", curve.gamma_per_s2.to_string()),
                ("beta_s", curve.beta_s.to_string()),
            ]),
            EpisodeKind::Pour { goal_ml } => about.extend([("kind", "pour".to_string()), ("goal_ml", goal_ml.to_string())]),
            EpisodeKind::Table => about.push(("kind", "table".to_string())),
        }
        self.metadata(format::META_EPISODE, &about)?;
        self.metadata(format::META_CONFIG, &[("sha256", config_sha256), ("toml", config)])?;
        self.flush()
    }

    fn metadata(&mut self, name: &str, pairs: &[(&str, String)]) -> Result<(), WriteError> {
        let metadata = pairs.iter().map(|(k, v)| ((*k).to_string(), v.clone())).collect();
        let record = mcap::records::Metadata { name: name.into(), metadata };
        self.writer.write_metadata(&record).map_err(|e| WriteError::File { file: self.path.display().to_string(), what: mcap_words(&e) })
    }

    /// Writes one frame: its row of `L_E`, its feature, its image and what is drawn over it.
    pub fn frame(&mut self, frame: &FrameRow) -> Result<(), WriteError> {
        let feature = frame.feature;
        let at_ns = feature.captured_at_ns;
        let unix_ns = format::unix_ns(at_ns, self.offset_ns);
        let [images, annotations, features, _, rows] = self.channels;
        if let Some((format, data)) = frame.image {
            let timestamp = Some(format::timestamp(unix_ns));
            let image = CompressedImage { timestamp, data: data.to_vec(), format: format.into(), frame_id: "camera".into() };
            self.message(images, feature.sequence, at_ns, &image);
        }
        self.message(annotations, feature.sequence, at_ns, &ImageAnnotations::new(feature, unix_ns));
        self.message(features, feature.sequence, at_ns, &FeatureMessage::new(feature));
        let row = RowMessage {
            sequence: feature.sequence,
            captured_at_ns: at_ns,
            alpha_commanded_deg: frame.alpha_commanded_deg,
            alpha_measured_deg: frame.alpha_measured_deg,
            area_px2: feature.area_px2,
            doubt: Doubt::from_code(feature.doubt).words().into(),
            image: frame.image.is_some(),
        };
        self.message(rows, feature.sequence, at_ns, &row);
        if at_ns.saturating_sub(self.chunk_since_ns) >= CHUNK_NS || self.pending_bytes >= CHUNK_BYTES {
            self.chunk_since_ns = at_ns;
            self.flush_until(at_ns)?;
        }
        Ok(())
    }

    /// Writes one tick of the controller.
    pub fn telemetry(&mut self, telemetry: &Telemetry) -> Result<(), WriteError> {
        let at_ns = telemetry.at_ns;
        self.message(self.channels[3], telemetry.tick, at_ns, &TelemetryMessage::new(telemetry));
        // The frames have stopped: their ticks are kept all the same.
        if at_ns.saturating_sub(self.chunk_since_ns) >= 2 * LATE_NS {
            self.chunk_since_ns = at_ns - LATE_NS;
            self.flush_until(at_ns - LATE_NS)?;
        }
        Ok(())
    }

    fn message(&mut self, channel: u16, sequence: u64, at_ns: u64, message: &impl prost::Message) {
        let data = message.encode_to_vec();
        self.pending_bytes += data.len();
        // MCAP's own sequence field has 32 bits. It gets the low ones, for readers that look for gaps.
        self.pending.push(Pending { at_ns, channel, sequence: sequence as u32, data });
    }

    /// Closes the chunk under way and hands it to the operating system.
    pub fn flush(&mut self) -> Result<(), WriteError> {
        self.flush_until(u64::MAX)
    }

    /// Writes all messages up to `until_ns` in the order of their times, as one chunk.
    fn flush_until(&mut self, until_ns: u64) -> Result<(), WriteError> {
        let fail = |e: McapError| WriteError::File { file: self.path.display().to_string(), what: mcap_words(&e) };
        self.pending.sort_by_key(|m| m.at_ns);
        let due = self.pending.partition_point(|m| m.at_ns <= until_ns);
        for message in self.pending.drain(..due) {
            self.pending_bytes -= message.data.len();
            let log_time = format::unix_ns(message.at_ns, self.offset_ns);
            let header = MessageHeader { channel_id: message.channel, sequence: message.sequence, log_time, publish_time: log_time };
            self.writer.write_to_known_channel(&header, &message.data).map_err(fail)?;
        }
        self.writer.flush().map_err(fail)
    }

    /// Writes how the episode ended and the index, waits until everything is on the disk, and returns the file's path.
    pub fn finish(mut self, end: &EpisodeEnd) -> Result<PathBuf, WriteError> {
        self.flush()?;
        let about = [
            ("complete", end.complete.to_string()),
            ("reason", end.reason.to_string()),
            ("disordered_frames", end.disordered_frames.to_string()),
        ];
        self.metadata(format::META_END, &about)?;
        let Self { mut writer, path, .. } = self;
        writer.finish().map_err(|e| WriteError::File { file: path.display().to_string(), what: mcap_words(&e) })?;
        let buffered = writer.into_inner();
        let file = buffered.into_inner().map_err(|e| file_error(&path, e.error()))?;
        file.sync_all().map_err(|e| file_error(&path, &e))?;
        if !is_at(&file, &path) {
            return Err(WriteError::Astray { file: path.display().to_string() });
        }
        Ok(path)
    }
}

fn file_error(path: &Path, e: &std::io::Error) -> WriteError {
    WriteError::File { file: path.display().to_string(), what: error_words(e) }
}

/// An error of the mcap crate in words. What the disk said is inside of it.
pub(super) fn mcap_words(e: &McapError) -> String {
    match e {
        McapError::Io(e) => error_words(e),
        e => e.to_string(),
    }
}

/// Creates the file of episode `number`, or of the next free number if that one has a file or is none of a directory's numbers.
fn create_file(directory: &Path, number: u64) -> Result<(File, PathBuf), WriteError> {
    let fail = |e: std::io::Error| WriteError::Directory { directory: directory.display().to_string(), what: error_words(&e) };
    std::fs::create_dir_all(directory).map_err(fail)?;
    let directory = directory.canonicalize().map_err(fail)?;
    let mut number = if (1..=LARGEST).contains(&number) { number } else { take_number(&directory).map_err(fail)? };
    loop {
        let path = directory.join(format!("episode-{number:04}.mcap"));
        // Only a file that was not there is ours.
        match OpenOptions::new().write(true).create_new(true).open(&path) {
            Ok(file) => {
                // Nobody else has the file yet, so the lock is free. A file system without locks is no reason not to record.
                let _ = file.try_lock();
                return Ok((file, path));
            }
            Err(e) if e.kind() == ErrorKind::AlreadyExists => number = take_number(&directory).map_err(fail)?,
            Err(e) => return Err(file_error(&path, &e)),
        }
    }
}

/// Seconds since 1970 as RFC 3339 in UTC. The date follows Howard Hinnant, "chrono-compatible low-level date algorithms".
pub(crate) fn rfc3339(unix_s: u64) -> String {
    let (days, second) = (unix_s / 86_400, unix_s % 86_400);
    let z = days + 719_468;
    let (era, doe) = (z / 146_097, z % 146_097);
    let yoe = (doe - doe / 1460 + doe / 36_524 - doe / 146_096) / 365;
    let doy = doe - (365 * yoe + yoe / 4 - yoe / 100);
    let mp = (5 * doy + 2) / 153;
    let day = doy - (153 * mp + 2) / 5 + 1;
    let month = if mp < 10 { mp + 3 } else { mp - 9 };
    let year = yoe + era * 400 + u64::from(month <= 2);
    format!("{year:04}-{month:02}-{day:02}T{:02}:{:02}:{:02}Z", second / 3600, second / 60 % 60, second % 60)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the wall-clock stamp in every file (leap day, year's end, the epoch).
    #[test]
    fn dates_are_right() {
        assert_eq!(rfc3339(0), "1970-01-01T00:00:00Z");
        assert_eq!(rfc3339(951_782_400), "2000-02-29T00:00:00Z");
        assert_eq!(rfc3339(1_735_689_599), "2024-12-31T23:59:59Z");
        assert_eq!(rfc3339(1_795_311_559), "2026-11-22T01:39:19Z");
    }

    /// Not a test, but a process in which no file may hold anything: it begins an episode, and its exit code says whether nothing is left.
    #[test]
    #[ignore = "run by the test below in a process of its own"]
    fn begins_without_room() {
        let Some(directory) = std::env::var_os("EPISODE_DIRECTORY").map(PathBuf::from) else { return };
        let config = Config::parse(include_str!("../../../config/sim.toml"), "sim.toml").unwrap();
        let (kind, wall_clock) = (EpisodeKind::Pour { goal_ml: 50.0 }, UNIX_EPOCH);
        let start = EpisodeStart { episode: 1, kind, started_at_ns: 1, wall_clock, config: &config, weights: "" };
        let begun = EpisodeWriter::create(&directory, &start).is_ok();
        std::process::exit(i32::from(begun || std::fs::read_dir(&directory).unwrap().next().is_some()));
    }

    /// Protects the directory from files that are no episodes, and count as some, where a disk or a quota is full.
    #[test]
    fn an_episode_that_finds_no_room_leaves_nothing() {
        let dir = tempfile::tempdir().unwrap();
        let mut child = std::process::Command::new("sh");
        child.args(["-c", "trap '' XFSZ; ulimit -f 1; exec \"$0\" --exact episode::write::tests::begins_without_room --ignored"]);
        child.arg(std::env::current_exe().unwrap()).env("EPISODE_DIRECTORY", dir.path()).stdout(std::process::Stdio::null());
        assert_eq!(child.status().unwrap().code(), Some(0));
    }

    /// Protects who is told where a pour lies: an episode whose file was deleted while it was recorded is not reported as there.
    #[test]
    fn an_episode_that_was_deleted_is_not_whole() {
        let dir = tempfile::tempdir().unwrap();
        let config = Config::parse(include_str!("../../../config/sim.toml"), "sim.toml").unwrap();
        let finish = |number, after: fn(&Path)| {
            let kind = EpisodeKind::Pour { goal_ml: 50.0 };
            let start = EpisodeStart { episode: number, kind, started_at_ns: 1, wall_clock: UNIX_EPOCH, config: &config, weights: "" };
            let writer = EpisodeWriter::create(dir.path(), &start).unwrap();
            after(writer.path());
            writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 }).map_err(|e| e.to_string())
        };
        assert!(finish(1, |_| ()).unwrap().ends_with("episode-0001.mcap"));
        let deleted = finish(2, |path| std::fs::remove_file(path).unwrap()).unwrap_err();
        assert!(deleted.contains("was deleted or moved"), "{deleted}");
    }

    /// Protects earlier episodes: a file is never overwritten, and one whose number is taken gets the next free one.
    #[test]
    fn a_file_that_is_there_is_left_alone() {
        let dir = tempfile::tempdir().unwrap();
        std::fs::write(dir.path().join("episode-0007.mcap"), b"mine").unwrap();
        for (number, name) in
            [(7, "episode-0008.mcap"), (12, "episode-0012.mcap"), (12, "episode-0013.mcap"), (1 << 52, "episode-0014.mcap")]
        {
            let (_, path) = create_file(dir.path(), number).unwrap();
            assert!(path.ends_with(name), "{number}: {}", path.display());
        }
        assert_eq!(std::fs::read(dir.path().join("episode-0007.mcap")).unwrap(), b"mine");

        let names: Vec<PathBuf> = std::thread::scope(|scope| {
            let take = || (0..50).map(|_| create_file(dir.path(), 7).unwrap().1).collect::<Vec<_>>();
            let threads: Vec<_> = (0..4).map(|_| scope.spawn(take)).collect();
            threads.into_iter().flat_map(|t| t.join().unwrap()).collect()
        });
        let distinct: std::collections::BTreeSet<&PathBuf> = names.iter().collect();
        assert_eq!(distinct.len(), 200, "two recorders at once never get the same file");
    }
}
