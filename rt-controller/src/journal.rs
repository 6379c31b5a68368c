//! The journal: every tick's inputs and answer, so that a run can be replayed bit for bit.
//!
//! The loop hands each [`Tick`] to an ordinary thread through a queue, and that thread writes it ([`Writer`]). Commands and tests read
//! and replay. Both allocate. A file that was cut off is read up to its last whole entry, and ticks that could not be told are counted; every other
//! fault is a [`JournalError`].
//!
//! The file begins with the 8 bytes `decantj9`. Then come the entries: a little-endian u32 with the length, and that many bytes of
//! postcard.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::{BufReader, BufWriter, ErrorKind, Read, Write};
use std::path::Path;

use serde::{Deserialize, Serialize};
use shared::agent::Agent;
use shared::messages::{Feature, Telemetry};
use shared::regular_file;
use shared::weights::Weights;

use crate::core::{Core, Input, MAX_FEATURES, Order, Robot, Settings};
pub use crate::journal_files::MAGIC;
use crate::journal_files::make_room;
use crate::pacing::Pacer;

/// Longest entry, bytes: more than ten weight files, which are the largest entries.
const ENTRY_MAX: usize = 128 * 1024;
/// Size at which a journal ends and the next part begins, bytes: about 20 h of ticks. Chosen by hand: it is copied and read in a minute.
const FILE_MAX: u64 = 256 << 20;
/// Time of ticks after which it does so too, ns: a day. Chosen by hand: whoever looks for yesterday opens one file, whatever the rate.
const FILE_MAX_NS: u64 = 24 * 3600 * 1_000_000_000;
/// Number of ticks at the beginning of a later part, and behind a gap, that are not compared: as many as the core remembers ([`crate::core`]).
const UNKNOWN_TICKS: u64 = 64;

/// Latest time that a tick may have, ns: 146 years after the machine's start. A later one is damage, and sums with it would overflow.
const LATEST_NS: u64 = 1 << 62;

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
    /// The file begins in the middle of a run, outside of pours and recordings; it stands behind the settings.
    Continued,
    /// So many ticks are missing here: the loop could not tell them, because the ordinary side fell behind.
    Lost(u64),
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
    /// When the first tick woke up, and the newest one; `None` before the first.
    span_ns: Option<[u64; 2]>,
    /// Weights that the loop has, or may take next, by their identity; the next part begins with them.
    weights: BTreeMap<u64, Vec<u8>>,
    /// Identity of the weights that the loop has.
    taken: Option<u64>,
    /// Whether the next tick must say which weights the loop has, because it is the first of a later part or behind a gap.
    names_weights: bool,
    /// Number of the newest tick, 0 before a run's first; `None` if a later part begins with an unknown one.
    newest: Option<u64>,
    /// Where an entry is put together.
    buffer: Vec<u8>,
}

impl Writer {
    /// Starts a journal. Those of the runs before are kept beside it, the newest with the ending `before.bin` instead of its own, older ones with
    /// `before-2.bin` and so on, as many as fit into the budget. A file in their places that is no journal, or one that another controller
    /// writes, is an error, and everything stays as it is.
    pub fn create(path: &Path, settings: &Settings) -> std::io::Result<Self> {
        Self::begin(BufWriter::new(make_room(path)?), settings)
    }

    /// Begins a later part of a run at `path`, as [`Writer::continued`] says; the journals that are there are kept as by [`Writer::create`].
    pub fn continue_at(path: &Path, settings: &Settings, weights: BTreeMap<u64, Vec<u8>>, taken: Option<u64>) -> std::io::Result<Self> {
        Self::continued(BufWriter::new(make_room(path)?), settings, weights, taken)
    }

    /// Number of bytes written.
    pub fn len(&self) -> u64 {
        self.written
    }

    /// Whether the file that is written is still the one at `path`.
    pub fn is_at(&self, path: &Path) -> bool {
        regular_file::is_at(self.to.get_ref(), path)
    }

    /// Whether nothing was written yet.
    pub fn is_empty(&self) -> bool {
        self.written == 0
    }

    /// Ends this file, or what is left of it, and begins the next part of the run at `path`. Call it only outside of pours and recordings.
    pub fn next_part(mut self, path: &Path, settings: &Settings) -> std::io::Result<Self> {
        // What cannot be written any more is lost with a disk that is full.
        let _ = self.flush();
        let (weights, taken) = (std::mem::take(&mut self.weights), self.taken);
        drop(self);
        Self::continue_at(path, settings, weights, taken)
    }
}

impl<W: Write> Writer<W> {
    /// Starts a journal that goes to `to`.
    pub fn begin(to: W, settings: &Settings) -> std::io::Result<Self> {
        let (weights, buffer) = (BTreeMap::new(), vec![0; ENTRY_MAX]);
        let mut this = Self { to, written: 0, span_ns: None, weights, taken: None, names_weights: false, newest: Some(0), buffer };
        this.to.write_all(MAGIC)?;
        this.entry(&Entry::Settings(*settings))?;
        Ok(this)
    }

    /// Starts a later part of a run, which goes to `to`: the loop has the weights `taken` of `weights`.
    pub fn continued(to: W, settings: &Settings, weights: BTreeMap<u64, Vec<u8>>, taken: Option<u64>) -> std::io::Result<Self> {
        let mut this = Self::begin(to, settings)?;
        this.entry(&Entry::Continued)?;
        for (identity, bytes) in &weights {
            this.entry(&Entry::Weights(*identity, bytes.clone()))?;
        }
        (this.weights, this.taken, this.names_weights, this.newest) = (weights, taken, taken.is_some(), None);
        Ok(this)
    }

    /// Adds weights that the loop may take from now on.
    pub fn weights(&mut self, identity: u64, weights: &Weights) -> std::io::Result<()> {
        let bytes = weights.to_bytes().map_err(std::io::Error::other)?;
        // Only those that the loop has and the newest ones can still be taken.
        self.weights.retain(|k, _| Some(*k) == self.taken);
        self.weights.insert(identity, bytes.clone());
        self.entry(&Entry::Weights(identity, bytes))
    }

    /// Adds a tick, and before it how many are missing since the one before, if any are: without that a replay would run on as if they had never been.
    /// `telemetry` is the tick's own, which has its number and the identity of the loop's weights.
    pub fn tick(&mut self, mut tick: Box<Tick>, telemetry: &Telemetry) -> std::io::Result<()> {
        let lost = self.newest.map_or(0, |newest| telemetry.tick.saturating_sub(newest + 1));
        self.newest = Some(telemetry.tick);
        if lost > 0 {
            self.entry(&Entry::Lost(lost))?;
            // They may have been exchanged meanwhile.
            self.taken = Some(telemetry.weights_id).filter(|id| *id != 0);
            self.names_weights = true;
        }
        let [first, _] = self.span_ns.unwrap_or([tick.now_ns; 2]);
        self.span_ns = Some([first, tick.now_ns]);
        self.taken = tick.agent.or(self.taken);
        if std::mem::take(&mut self.names_weights) {
            tick.agent = self.taken;
        }
        self.entry(&Entry::Tick(tick))
    }

    /// Whether the file has become so large, or so old, that the next part should begin.
    pub fn is_full(&self) -> bool {
        self.written > FILE_MAX || self.span_ns.is_some_and(|[first, newest]| newest.saturating_sub(first) > FILE_MAX_NS)
    }

    /// Passes everything that was added on to the operating system.
    pub fn flush(&mut self) -> std::io::Result<()> {
        self.to.flush()
    }

    fn entry(&mut self, entry: &Entry) -> std::io::Result<()> {
        let bytes = postcard::to_slice(entry, &mut self.buffer).map_err(std::io::Error::other)?;
        self.written += 4 + bytes.len() as u64;
        self.to.write_all(&(bytes.len() as u32).to_le_bytes())?;
        self.to.write_all(bytes)
    }
}

/// What a replay found.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Replay {
    /// Number of ticks replayed.
    pub ticks: u64,
    /// Results of the pours and recordings that ended in them.
    pub ended: Vec<shared::control::Outcome>,
    /// Number of ticks that were compared.
    pub compared: u64,
    /// Number of ticks whose target or d differs in any bit.
    pub different: u64,
    /// Number of the first of those ticks, counted from 0.
    pub first_different: Option<u64>,
    /// Number of ticks whose deadline or margin is not the one that follows from the ticks before.
    pub different_deadlines: u64,
    /// Whether the file begins in the middle of a run. Its answers are then compared from its first pour or recording on, because what the core knew before
    /// stands in the part before.
    pub continued: bool,
    /// Number of ticks that are missing, because the controller's ordinary side fell behind. Behind a gap answers are compared from the next pour or
    /// recording on, and what was under way when it began has no result.
    pub lost: u64,
    /// Whether the file ends in the middle of an entry.
    pub cut_off: bool,
}

/// Replays the journal in a file. See [`replay_from`].
pub fn replay(path: &Path, seen: impl FnMut(&Tick, &crate::core::Output)) -> Result<Replay, JournalError> {
    let file = path.display().to_string();
    let (reader, _) = regular_file::open(path).map_err(|e| JournalError::Read { file: file.clone(), what: e.to_string() })?;
    replay_from(BufReader::new(reader), &file, seen)
}

/// Whether all bytes were there; an error of the disk is none of a file that ends.
fn is_whole(read: std::io::Result<()>) -> std::io::Result<bool> {
    match read {
        Err(e) if e.kind() == ErrorKind::UnexpectedEof => Ok(false),
        read => read.map(|()| true),
    }
}

/// Replays a journal through a new [`Core`] and compares every answer bit by bit. `name` is what errors call the journal; `seen` is called with
/// each tick and the answer that the replay gave.
pub fn replay_from(mut reader: impl Read, name: &str, mut seen: impl FnMut(&Tick, &crate::core::Output)) -> Result<Replay, JournalError> {
    let file = name.to_owned();
    let read = |e: std::io::Error| JournalError::Read { file: file.clone(), what: e.to_string() };
    let mut magic = [0; 8];
    if !is_whole(reader.read_exact(&mut magic)).map_err(read)? || &magic != MAGIC {
        return Err(JournalError::Foreign { file });
    }
    let mut rerun = Rerun::new();
    let mut at = MAGIC.len() as u64;
    let mut buffer = Vec::new();
    loop {
        let mut length = [0; 4];
        match reader.read(&mut length[..1]).map_err(read)? {
            0 => return Ok(rerun.result),
            _ if !is_whole(reader.read_exact(&mut length[1..])).map_err(read)? => break,
            _ => {}
        }
        let length = u32::from_le_bytes(length) as usize;
        let damaged = || JournalError::Damaged { file: file.clone(), at };
        if length > ENTRY_MAX {
            return Err(damaged());
        }
        buffer.resize(length, 0);
        if !is_whole(reader.read_exact(&mut buffer)).map_err(read)? {
            break;
        }
        let entry = postcard::from_bytes(&buffer).map_err(|_| damaged())?;
        rerun.take(entry, &mut seen).ok_or_else(damaged)?;
        at += 4 + length as u64;
    }
    rerun.result.cut_off = true;
    Ok(rerun.result)
}

/// A replay under way.
struct Rerun {
    result: Replay,
    /// Whether answers are compared already.
    compared: bool,
    /// The pacer and the deadline that it gave; `None` where it cannot be known.
    pacing: Option<(Pacer, Option<u64>)>,
    core: Option<Core>,
    settings: Option<Settings>,
    /// Number of ticks since the beginning of the file, or since the newest gap.
    connected: u64,
    weights: BTreeMap<u64, Weights>,
    /// When the newest tick woke up, ns.
    before_ns: u64,
}

impl Rerun {
    fn new() -> Self {
        let result = Replay {
            ticks: 0,
            ended: Vec::new(),
            compared: 0,
            different: 0,
            first_different: None,
            different_deadlines: 0,
            continued: false,
            lost: 0,
            cut_off: false,
        };
        let weights = BTreeMap::new();
        Self { result, compared: true, pacing: None, core: None, settings: None, connected: 0, weights, before_ns: 0 }
    }

    /// Takes the next entry; `None` if it cannot be right.
    fn take(&mut self, entry: Entry, seen: &mut impl FnMut(&Tick, &crate::core::Output)) -> Option<()> {
        match entry {
            Entry::Settings(settings) => {
                settings.are_plausible().then_some(())?;
                self.pacing = Some((Pacer::new(settings.period_ns), None));
                (self.core, self.settings) = (Some(Core::new(settings)), Some(settings));
            }
            Entry::Continued => (self.result.continued, self.compared, self.pacing) = (true, false, None),
            Entry::Lost(ticks) => {
                // What the core knew is not known any more.
                self.core = Some(Core::new(self.settings?));
                (self.compared, self.pacing, self.connected) = (false, None, 0);
                self.result.lost = self.result.lost.saturating_add(ticks);
            }
            Entry::Weights(identity, bytes) => {
                self.weights.insert(identity, Weights::from_bytes(&bytes, "").ok()?);
            }
            Entry::Tick(tick) => {
                let output = self.tick(&tick)?;
                self.result.ticks += 1;
                self.connected += 1;
                self.result.ended.extend(output.ended);
                seen(&tick, &output);
            }
        }
        Some(())
    }

    /// Runs a tick again and compares; `None` if it cannot be right.
    fn tick(&mut self, tick: &Tick) -> Option<crate::core::Output> {
        let core = self.core.as_mut()?;
        if let Some(identity) = tick.agent {
            core.exchange(Box::new(Agent::new(self.weights.get(&identity)?)));
        }
        let Tick { now_ns, ref features, robot, order, times, .. } = *tick;
        let in_order = now_ns >= self.before_ns && [now_ns, times.deadline_ns, times.done_ns].iter().all(|ns| *ns <= LATEST_NS);
        in_order.then_some(())?;
        self.before_ns = now_ns;
        let output = core.step(&Input { now_ns, features, robot, order });
        let same = output.target_deg.map(f32::to_bits) == tick.target_deg.map(f32::to_bits)
            && output.telemetry.d_ml.to_bits() == tick.d_ml.to_bits();
        let begins = matches!(order, Some(Order::Pour { .. } | Order::Record { .. })) && output.ordered == Some(Ok(()));
        self.compared |= self.connected >= UNKNOWN_TICKS && begins;
        if let Some(target_deg) = tick.target_deg.filter(|_| !self.compared) {
            core.rest_at(target_deg);
        }
        self.result.compared += u64::from(self.compared);
        if self.compared && !same {
            self.result.different += 1;
            self.result.first_different.get_or_insert(self.result.ticks);
        }
        if let Some((pacer, deadline_ns)) = &mut self.pacing {
            let same = deadline_ns.is_none_or(|ns| ns == times.deadline_ns) && pacer.margin_ns() == times.margin_ns;
            self.result.different_deadlines += u64::from(!same);
            features.iter().for_each(|f| pacer.used(now_ns, f.published_at_ns));
            *deadline_ns = Some(pacer.next_deadline_ns(times.deadline_ns, times.done_ns).0);
        }
        Some(output)
    }
}
