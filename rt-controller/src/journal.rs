//! The journal: every tick's inputs and answer, so that a run can be replayed bit for bit.
//!
//! The loop hands each [`Tick`] to an ordinary thread through a queue, and that thread writes it ([`Writer`]). Commands and tests read
//! and replay. Both allocate. A file that was cut off is read up to its last whole entry; every other fault is a [`JournalError`].
//!
//! The file begins with the 8 bytes `decantj5`. Then come the entries: a little-endian u32 with the length, and that many bytes of
//! postcard.

use std::collections::BTreeMap;
use std::fs::{File, OpenOptions};
use std::io::{BufReader, BufWriter, ErrorKind, Read, Write};
use std::path::Path;

use serde::{Deserialize, Serialize};
use shared::agent::Agent;
use shared::messages::Feature;
use shared::regular_file;
use shared::weights::Weights;

use crate::core::{Core, Input, MAX_FEATURES, Order, Robot, Settings};
use crate::pacing::Pacer;

/// The first bytes of a journal, which include its version.
const MAGIC: &[u8; 8] = b"decantj5";
/// Longest entry, bytes: more than ten weight files, which are the largest entries.
const ENTRY_MAX: usize = 128 * 1024;
/// Size at which a journal stops growing, bytes: about three days of ticks.
const FILE_MAX: u64 = 2 << 30;

/// One tick: everything that [`Core::step`] saw, and the target that it answered with.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Tick {
    /// When it woke up, ns.
    pub now_ns: u64,
    /// The features that the tick took.
    pub features: heapless::Vec<Feature, MAX_FEATURES>,
    /// The robot's newest state.
    pub robot: Robot,
    /// The operator's order, if there was one.
    pub order: Option<Order>,
    /// Identity of the weights whose agent was taken in this tick.
    pub agent: Option<u64>,
    /// The answer, degrees; `None` if nothing was commanded.
    pub target_deg: Option<f32>,
    /// d after the tick, ml.
    pub d_ml: f32,
    /// When the parts of the tick happened; measured, and therefore not replayed.
    pub times: Times,
}

/// The times of a tick besides its wake-up, CLOCK_MONOTONIC ns.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Times {
    /// When the tick was to wake up.
    pub deadline_ns: u64,
    /// When the target was decided.
    pub decided_at_ns: u64,
    /// When the kernel had taken the target's bytes; 0 if no target was written.
    pub written_at_ns: u64,
    /// When everything was done except queueing this entry. The next deadline is reckoned with it.
    pub done_ns: u64,
    /// How long V_e was to have waited for this tick, ns ([`crate::pacing`]).
    pub margin_ns: u64,
}

/// One entry of the file.
#[derive(Debug, Serialize, Deserialize)]
enum Entry {
    /// The settings of the run; the first entry.
    Settings(Settings),
    /// Weights with their identity, as the bytes of a weight file. They stand before the tick that takes them.
    Weights(u64, Vec<u8>),
    /// A tick.
    Tick(Box<Tick>),
}

/// Why a journal cannot be read.
#[derive(Debug, thiserror::Error)]
pub enum JournalError {
    /// The file cannot be read.
    #[error("{file}: {what}")]
    Read {
        /// The file.
        file: String,
        /// The operating system's message.
        what: String,
    },
    /// The file is not a journal of this version.
    #[error("{file}: not a journal of this version; it is written by `rt-controller run` where controller.journal is set")]
    Foreign {
        /// The file.
        file: String,
    },
    /// An entry cannot be decoded.
    #[error("{file}: damaged at byte {at}; what comes before can be replayed from a copy cut there")]
    Damaged {
        /// The file.
        file: String,
        /// Where the entry begins, bytes.
        at: u64,
    },
}

/// Writes a journal, from an ordinary thread, to a file or to anything else that takes bytes.
pub struct Writer<W: Write = BufWriter<File>> {
    to: W,
    written: u64,
    /// Where an entry is put together.
    buffer: Vec<u8>,
}

impl Writer {
    /// Starts a journal. One that is there already is kept beside it, with the ending `before.bin` instead of its own. A file that is no
    /// journal, or one that another controller writes, is an error and stays as it is.
    pub fn create(path: &Path, settings: &Settings) -> std::io::Result<Self> {
        if let Some(parent) = path.parent() {
            std::fs::create_dir_all(parent)?;
        }
        if path.symlink_metadata().is_ok() {
            let before = path.with_extension("before.bin");
            let held = check_is_journal(path)?;
            if before.symlink_metadata().is_ok() {
                check_is_journal(&before)?;
            }
            // The journal of the run before is wanted most after that run has crashed.
            std::fs::rename(path, before)?;
            drop(held);
        }
        let file = OpenOptions::new().write(true).create_new(true).open(path)?;
        // Whoever looks meets the lock; a file system without locks has none to give.
        let _ = file.try_lock();
        Self::begin(BufWriter::new(file), settings)
    }
}

impl<W: Write> Writer<W> {
    /// Starts a journal that goes to `to`.
    pub fn begin(to: W, settings: &Settings) -> std::io::Result<Self> {
        let mut this = Self { to, written: 0, buffer: vec![0; ENTRY_MAX] };
        this.to.write_all(MAGIC)?;
        this.entry(&Entry::Settings(*settings))?;
        Ok(this)
    }

    /// Adds weights that the loop may take from now on.
    pub fn weights(&mut self, identity: u64, weights: &Weights) -> std::io::Result<()> {
        let bytes = weights.to_bytes().map_err(std::io::Error::other)?;
        self.entry(&Entry::Weights(identity, bytes))
    }

    /// Adds a tick.
    pub fn tick(&mut self, tick: Box<Tick>) -> std::io::Result<()> {
        self.entry(&Entry::Tick(tick))
    }

    /// Passes everything that was added on to the operating system.
    pub fn flush(&mut self) -> std::io::Result<()> {
        self.to.flush()
    }

    fn entry(&mut self, entry: &Entry) -> std::io::Result<()> {
        if self.written > FILE_MAX {
            return Err(std::io::Error::other("the journal is full (2 GiB)"));
        }
        let bytes = postcard::to_slice(entry, &mut self.buffer).map_err(std::io::Error::other)?;
        self.written += 4 + bytes.len() as u64;
        self.to.write_all(&(bytes.len() as u32).to_le_bytes())?;
        self.to.write_all(bytes)
    }
}

/// Checks that the file at `path` is a journal of any version, or empty, and that nobody writes it. Gives it, locked.
fn check_is_journal(path: &Path) -> std::io::Result<File> {
    let named = |what: &str| std::io::Error::new(ErrorKind::InvalidInput, format!("{} {what}", path.display()));
    let (mut file, meta) = regular_file::open(path).map_err(|e| named(&e.to_string()))?;
    let mut magic = [0; MAGIC.len()];
    let whole = file.read_exact(&mut magic).is_ok();
    if meta.len() > 0 && !(whole && magic.starts_with(&MAGIC[..7])) {
        return Err(named("is no journal and is left as it is: choose another controller.journal"));
    }
    if let Err(std::fs::TryLockError::WouldBlock) = file.try_lock() {
        return Err(named("is being written by another controller: choose another controller.journal"));
    }
    Ok(file)
}

/// What a replay found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Replay {
    /// Number of ticks replayed.
    pub ticks: u64,
    /// Results of the pours and recordings that ended in them.
    pub ended: Vec<shared::control::Outcome>,
    /// Number of ticks whose target or d differs in any bit.
    pub different: u64,
    /// Number of the first of those ticks, counted from 0.
    pub first_different: Option<u64>,
    /// Number of ticks whose deadline or margin is not the one that follows from the ticks before.
    pub different_deadlines: u64,
    /// Whether the file ends in the middle of an entry.
    pub cut_off: bool,
}

/// Replays the journal in a file. See [`replay_from`].
pub fn replay(path: &Path, seen: impl FnMut(&Tick, &crate::core::Output)) -> Result<Replay, JournalError> {
    let file = path.display().to_string();
    let reader = File::open(path).map_err(|e| JournalError::Read { file: file.clone(), what: e.to_string() })?;
    replay_from(BufReader::new(reader), &file, seen)
}

/// Replays a journal through a new [`Core`] and compares every answer bit by bit. `name` is what errors call the journal; `seen` is called with each tick and the answer that the
/// replay gave.
pub fn replay_from(mut reader: impl Read, name: &str, mut seen: impl FnMut(&Tick, &crate::core::Output)) -> Result<Replay, JournalError> {
    let file = name.to_owned();
    let read = |e: std::io::Error| JournalError::Read { file: file.clone(), what: e.to_string() };
    let mut magic = [0; 8];
    if reader.read_exact(&mut magic).is_err() || &magic != MAGIC {
        return Err(JournalError::Foreign { file });
    }
    let mut result = Replay { ticks: 0, ended: Vec::new(), different: 0, first_different: None, different_deadlines: 0, cut_off: false };
    let mut pacing: Option<(Pacer, Option<u64>)> = None;
    let mut core: Option<Core> = None;
    let mut weights = BTreeMap::new();
    let mut at = MAGIC.len() as u64;
    let mut buffer = Vec::new();
    loop {
        let mut length = [0; 4];
        match reader.read(&mut length[..1]).map_err(read)? {
            0 => return Ok(result),
            _ if reader.read_exact(&mut length[1..]).is_err() => break,
            _ => {}
        }
        let length = u32::from_le_bytes(length) as usize;
        let damaged = || JournalError::Damaged { file: file.clone(), at };
        if length > ENTRY_MAX {
            return Err(damaged());
        }
        buffer.resize(length, 0);
        if reader.read_exact(&mut buffer).is_err() {
            break;
        }
        match (postcard::from_bytes(&buffer).map_err(|_| damaged())?, &mut core) {
            (Entry::Settings(settings), _) => {
                pacing = Some((Pacer::new(settings.period_ns), None));
                core = Some(Core::new(settings));
            }
            (Entry::Weights(identity, bytes), _) => {
                weights.insert(identity, Weights::from_bytes(&bytes, &file).map_err(|_| damaged())?);
            }
            (Entry::Tick(tick), Some(core)) => {
                if let Some(identity) = tick.agent {
                    core.exchange(Box::new(Agent::new(weights.get(&identity).ok_or_else(damaged)?)));
                }
                let Tick { now_ns, ref features, robot, order, .. } = *tick;
                let output = core.step(&Input { now_ns, features, robot, order });
                let same = output.target_deg.map(f32::to_bits) == tick.target_deg.map(f32::to_bits)
                    && output.telemetry.d_ml.to_bits() == tick.d_ml.to_bits();
                if !same {
                    result.different += 1;
                    result.first_different.get_or_insert(result.ticks);
                }
                if let Some((pacer, deadline_ns)) = &mut pacing {
                    let same = deadline_ns.is_none_or(|ns| ns == tick.times.deadline_ns) && pacer.margin_ns() == tick.times.margin_ns;
                    result.different_deadlines += u64::from(!same);
                    tick.features.iter().for_each(|f| pacer.used(now_ns, f.published_at_ns));
                    *deadline_ns = Some(pacer.next_deadline_ns(tick.times.deadline_ns, tick.times.done_ns).0);
                }
                result.ticks += 1;
                result.ended.extend(output.ended);
                seen(&tick, &output);
            }
            (Entry::Tick(_), None) => return Err(damaged()),
        }
        at += 4 + length as u64;
    }
    result.cut_off = true;
    Ok(result)
}
