//! The controller's work with files: it writes the journal, watches the weight file, and takes numbers for the next episodes.
//!
//! It runs in a thread of its own with ordinary scheduling, allocates, and blocks for as long as the disk does. Clients, and an abort among
//! their requests, are answered by another thread ([`crate::service`]). Nothing here ends the controller: a journal that cannot be written
//! ends, weights that cannot be read are refused while the old ones stay, and without a number no pour begins.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use crossbeam::channel::{Receiver, Sender, TrySendError, bounded};
use shared::agent::Agent;
use shared::config::Config;
use shared::episode::take_number;
use shared::regular_file;
use shared::weights::Weights;

use crate::core::Settings;
use crate::exchange::Exchange;
use crate::journal::{Tick, Writer};

/// Pause between two looks at the queue and the weight file. Chosen by hand; no measurement is recorded.
const BEAT: Duration = Duration::from_millis(40);
/// Number of ticks that may wait for a slow disk: half a minute at 30 Hz. A journal with a gap cannot be replayed, so a longer wait ends
/// it.
const WAITING_TICKS: usize = 1024;

/// Largest relative difference between the camera's frame rate and the one that weights are trained for. Chosen by hand; no measurement
/// is recorded.
const RATE_TOLERANCE: f64 = 0.02;

/// The state of the disk's thread.
pub struct Disk<'a> {
    exchange: &'a Exchange,
    say: &'a (dyn Fn(&str) + Sync),
    /// Why the newest weight file is not used, for `status`; empty if it is used.
    refused: &'a Mutex<String>,
    path: PathBuf,
    /// User number of the configuration's owner, whose weight files are read too.
    trusted: Option<u32>,
    /// Frames a second of the camera; weights are trained for one rate only.
    fps: f64,
    /// Time of change, inode and length of the weight file that was read last.
    seen: Option<(std::time::SystemTime, u64, u64)>,
    /// The journal; `None` if none is kept, or if it has ended.
    journal: Option<Writer>,
    ticks: Receiver<Box<Tick>>,
    /// Directory of the episodes, and the queue of one that the service takes numbers from.
    episodes: PathBuf,
    numbers: Sender<u64>,
    /// A number that the queue had no room for.
    spare_number: Option<u64>,
    /// Why no number could be taken; empty if one could.
    no_number: String,
}

/// The other ends of the disk's queues.
pub struct Queues {
    /// Takes the ticks for the journal; `None` if none is kept.
    pub journal: Option<Sender<Box<Tick>>>,
    /// Gives numbers for the next episodes.
    pub numbers: Receiver<u64>,
}

impl<'a> Disk<'a> {
    /// Begins the journal, if one is configured, and gives the queues. `trusted` is the user number of the configuration's owner. Fails with
    /// one line if the journal's place is taken by another file; a disk that cannot be written only costs the journal.
    pub fn open(
        config: &Config,
        trusted: Option<u32>,
        exchange: &'a Exchange,
        refused: &'a Mutex<String>,
        say: &'a (dyn Fn(&str) + Sync),
    ) -> Result<(Self, Queues), String> {
        let journal = match config.controller.journal.as_ref().map(|path| (path, Writer::create(path, &Settings::new(config)))) {
            None => None,
            Some((_, Ok(writer))) => Some(writer),
            Some((_, Err(e))) if e.kind() == ErrorKind::InvalidInput => return Err(format!("controller.journal: {e}")),
            Some((path, Err(e))) => {
                say(&format!("{}: no journal: {e}", path.display()));
                None
            }
        };
        let (sender, ticks) = bounded(WAITING_TICKS);
        let sender = journal.is_some().then_some(sender);
        let (number_sender, numbers) = bounded(1);
        let disk = Self {
            exchange,
            say,
            refused,
            path: config.controller.weights.clone(),
            trusted,
            fps: config.camera.fps,
            seen: None,
            journal,
            ticks,
            episodes: config.recording.directory.clone(),
            numbers: number_sender,
            spare_number: None,
            no_number: String::new(),
        };
        Ok((disk, Queues { journal: sender, numbers }))
    }

    /// Works until `end` is true, and then writes what is left.
    pub fn run(mut self, end: &AtomicBool) {
        while !end.load(Relaxed) {
            self.write_ticks();
            self.look_at_weights();
            self.offer_number();
            std::thread::sleep(BEAT);
        }
        self.write_ticks();
        self.write(Writer::flush);
    }

    /// Writes the ticks that wait.
    fn write_ticks(&mut self) {
        while let Ok(tick) = self.ticks.try_recv() {
            self.write(|journal| journal.tick(tick));
        }
    }

    /// Writes to the journal. The first error ends the journal, not the controller.
    fn write(&mut self, what: impl FnOnce(&mut Writer) -> std::io::Result<()>) {
        if let Some(Err(e)) = self.journal.as_mut().map(what) {
            (self.say)(&format!("journal: {e}; nothing more is written to it, and the controller goes on"));
            self.journal = None;
        }
    }

    /// Keeps a number ready for the next episode. What is wrong with the directory is said once.
    fn offer_number(&mut self) {
        if self.numbers.is_full() {
            return;
        }
        let taken = self.spare_number.take().map_or_else(|| take_number(&self.episodes), Ok);
        match taken {
            Ok(number) => {
                self.no_number.clear();
                if let Err(TrySendError::Full(number)) = self.numbers.try_send(number) {
                    self.spare_number = Some(number);
                }
            }
            Err(e) => {
                let what = format!("recording.directory = {}: {e}: no number for an episode, so no pour begins", self.episodes.display());
                if what != self.no_number {
                    (self.say)(&what);
                    self.no_number = what;
                }
            }
        }
    }

    /// Notices a new weight file, reads and checks it, and hands it to the loop.
    fn look_at_weights(&mut self) {
        use std::os::unix::fs::MetadataExt;
        let refused = self.refused;
        let refuse = |why: String| *refused.lock().unwrap_or_else(PoisonError::into_inner) = why;
        let Ok(meta) = std::fs::metadata(&self.path) else {
            if self.seen.is_none() {
                refuse(format!("{}: not there yet", self.path.display()));
            }
            return;
        };
        let stamp = meta.modified().ok().map(|m| (m, meta.ino(), meta.len()));
        if stamp == self.seen {
            return;
        }
        self.seen = stamp;
        match read_weights(&self.path, self.fps, self.trusted) {
            Ok(weights) => {
                refuse(String::new());
                (self.say)(&format!("weights {} read from {}; the next pour uses them", weights.identity(), self.path.display()));
                let identity = weights.id();
                self.write(|journal| journal.weights(identity, &weights));
                // An agent that still waits is replaced, and dropped here, in an ordinary thread.
                drop(self.exchange.agents.force_push((identity, Box::new(Agent::new(&weights)))));
            }
            Err(e) => {
                (self.say)(&format!("weights refused, the old ones stay: {e}"));
                refuse(e);
            }
        }
    }
}

/// The weights in `path` if they are for a camera of `fps` frames a second and of an owner who may give some, or why they are refused.
pub fn read_weights(path: &Path, fps: f64, trusted: Option<u32>) -> Result<Weights, String> {
    let owned = regular_file::open(path).map_err(|e| e.to_string()).and_then(|(_, meta)| regular_file::check_owner(&meta, trusted));
    owned.map_err(|e| format!("{}: {e}", path.display()))?;
    let weights = Weights::read(path).map_err(|e| e.to_string())?;
    let trained = weights.rate_hz;
    if (f64::from(trained) / fps - 1.0).abs() < RATE_TOLERANCE {
        Ok(weights)
    } else {
        Err(format!("trained at {trained} frames/s, camera.fps is {fps}: train with episodes of this camera"))
    }
}
