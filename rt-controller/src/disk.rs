//! The controller's work with files: it writes the journal, watches the weight file, and takes numbers for the next episodes.
//!
//! It runs in a thread of its own with ordinary scheduling, allocates, and blocks for as long as the disk does. Clients, and an abort among
//! their requests, are answered by another thread ([`crate::service`]). Nothing here ends the controller: a journal that cannot be written
//! ends, weights that cannot be read are refused while the old ones stay, and without a number no pour begins.

use std::io::ErrorKind;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering::Relaxed, Ordering::SeqCst};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender, TrySendError, bounded};
use shared::agent::Agent;
use shared::config::Config;
use shared::disk_space::{error_words, room};
use shared::episode::take_number_above;
use shared::estimator::flow::WayBack;
use shared::level::Level;
use shared::limits::Limits;
use shared::messages::{Phase, Telemetry};
use shared::os;
use shared::regular_file::ASTRAY;
use shared::weights::{Estimator, Weights};

use crate::core::Settings;
use crate::disk_note::{DiskNote, space_words};
use crate::exchange::Exchange;
use crate::journal::{Tick, Writer};

/// Pause between two looks at the queue and the weight file. Chosen by hand; no measurement is recorded.
const BEAT: Duration = Duration::from_millis(40);
/// Number of ticks that may wait for a slow disk: half a minute at 30 Hz. Those that find no room are missing in the journal, which counts them.
const WAITING_TICKS: usize = 1024;

/// Pause before a journal that could not be written is tried again; it doubles with each failure, up to [`RETRY_MAX`], because each new file moves
/// the older ones on. Chosen by hand: a full disk is cleaned by a person.
const RETRY: Duration = Duration::from_secs(60);
/// Longest such pause. Chosen by hand; no measurement is recorded.
const RETRY_MAX: Duration = Duration::from_secs(6 * 3600);
/// Free space with which a journal is begun anew, bytes: an hour of ticks.
const RETRY_SPACE: u64 = 16 << 20;
/// Pause between two looks at the free space. Chosen by hand; no measurement is recorded.
const SPACE_BEAT: Duration = Duration::from_secs(5);

/// Largest relative difference of the camera's frame rate, and of the way back's, from those that weights are trained for. Chosen by hand; no
/// measurement is recorded.
const TOLERANCE: f64 = 0.02;

/// A tick on its way to the journal, with its telemetry.
pub type Told = Box<(Tick, Telemetry)>;

/// The state of the disk's thread.
pub struct Disk<'a> {
    exchange: &'a Exchange,
    say: &'a (dyn Fn(Level, &str) + Sync),
    /// What `status` shows of it.
    note: &'a DiskNote,
    path: PathBuf,
    /// User number of the configuration's owner, whose weight files are read too.
    trusted: Option<u32>,
    /// Frames a second of the camera; weights are trained for one rate only.
    fps: f64,
    /// Limits of this cell; weights are trained for one way back only.
    limits: Limits,
    /// Time of change, inode and length of the weight file that was read last.
    seen: Option<(i64, i64, u64, u64)>,
    /// The journal; `None` if none is kept, or while nothing can be written.
    journal: Option<Writer>,
    /// Where the journal is, and the settings that it begins with; `None` if none is kept.
    journal_at: Option<(PathBuf, Settings)>,
    /// Whether the journal's file was deleted or moved away; what is written is kept nowhere then, or where nobody looks.
    astray: bool,
    /// When a journal that could not be written is tried again, and when free space is looked at again.
    retry: Option<Instant>,
    pause: Duration,
    /// Since when no pour or recording is under way, and when the newest tick that was taken from the queue woke up, CLOCK_MONOTONIC ns.
    at_rest_since_ns: Option<u64>,
    newest_tick_ns: u64,
    space_at: Option<Instant>,
    ticks: Receiver<Told>,
    /// The weights that were read last, for a journal that begins anew.
    loaded: Option<(u64, Vec<u8>)>,
    /// Directory of the episodes, and the queue of one that the service takes numbers from.
    episodes: PathBuf,
    numbers: Sender<u64>,
    /// A number that the queue had no room for.
    spare_number: Option<u64>,
    /// The newest number that was taken. One that came again, from a directory that was moved away and made anew, would have an older episode's outcome.
    newest_number: u64,
    /// Why no number could be taken; empty if one could.
    no_number: String,
}

/// The other ends of the disk's queues.
pub struct Queues {
    /// Takes the ticks for the journal; `None` if none is kept.
    pub journal: Option<Sender<Told>>,
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
        note: &'a DiskNote,
        say: &'a (dyn Fn(Level, &str) + Sync),
    ) -> Result<(Self, Queues), String> {
        let journal = match config.controller.journal.as_ref().map(|path| (path, Writer::create(path, &Settings::new(config)))) {
            None => None,
            Some((_, Ok(writer))) => Some(writer),
            Some((_, Err(e))) if e.kind() == ErrorKind::InvalidInput => return Err(format!("controller.journal: {e}")),
            Some((path, Err(e))) => {
                say(Level::Warning, &format!("{}: no journal: {}; tried again later", path.display(), error_words(&e)));
                note.set(|n| n.journal = format!("not written since the start: {}", error_words(&e)));
                None
            }
        };
        let journal_at = config.controller.journal.clone().map(|path| (path, Settings::new(config)));
        let retry = (journal.is_none() && journal_at.is_some()).then(|| Instant::now() + RETRY);
        let (sender, ticks) = bounded(WAITING_TICKS);
        let sender = journal_at.is_some().then_some(sender);
        let (number_sender, numbers) = bounded(1);
        let disk = Self {
            exchange,
            say,
            note,
            path: config.controller.weights.clone(),
            trusted,
            fps: config.camera.fps,
            limits: config.limits,
            seen: None,
            journal,
            journal_at,
            astray: false,
            retry,
            pause: RETRY,
            at_rest_since_ns: None,
            newest_tick_ns: 0,
            space_at: None,
            ticks,
            loaded: None,
            episodes: config.recording.directory.clone(),
            numbers: number_sender,
            spare_number: None,
            newest_number: 0,
            no_number: String::new(),
        };
        Ok((disk, Queues { journal: sender, numbers }))
    }

    /// Works until `end` is true, and then writes what is left.
    pub fn run(mut self, end: &AtomicBool) {
        while !end.load(Relaxed) {
            self.write_ticks();
            // What a crash is looked up for must not be in this process's memory.
            self.write(Writer::flush);
            self.keep_journal();
            self.look_at_weights();
            self.look_at_space();
            self.offer_number();
            std::thread::sleep(BEAT);
        }
        self.write_ticks();
        self.write(Writer::flush);
    }

    /// Writes the ticks that wait.
    fn write_ticks(&mut self) {
        while let Ok(told) = self.ticks.try_recv() {
            let (tick, telemetry) = *told;
            self.newest_tick_ns = tick.now_ns;
            self.write(|journal| journal.tick(Box::new(tick), &telemetry));
        }
    }

    /// Writes to the journal. An error ends this file, not the controller; a new one is begun when the disk takes it.
    fn write(&mut self, what: impl FnOnce(&mut Writer) -> std::io::Result<()>) {
        if let Some(Err(e)) = self.journal.as_mut().map(what) {
            let why = error_words(&e);
            (self.say)(Level::Warning, &format!("journal: {why}; it is begun anew when it can be written, and the controller goes on"));
            self.note.set(|n| n.journal = format!("not written: {why}"));
            self.journal = None;
            self.try_later();
        }
    }

    /// Has the journal tried again after a pause.
    fn try_later(&mut self) {
        self.retry = Some(Instant::now() + self.pause);
        self.pause = (self.pause * 2).min(RETRY_MAX);
    }

    /// Whether every tick of the last pour or recording has been written: a tick has come that woke up after it was over. That the phase says so is
    /// not enough, because the last ticks may still be on their way through the other thread.
    fn is_at_rest(&mut self) -> bool {
        if !matches!(Phase::from_code(self.exchange.phase.load(SeqCst)), Phase::Idle | Phase::NoRobot) {
            self.at_rest_since_ns = None;
            return false;
        }
        let since_ns = *self.at_rest_since_ns.get_or_insert_with(os::now_ns);
        self.newest_tick_ns > since_ns
    }

    /// Begins the journal's next part when the file is large or old, or not at its place any more, or a new one when the last could not be written; never in
    /// a pour or recording.
    fn keep_journal(&mut self) {
        let at_rest = self.is_at_rest();
        let Some((path, settings)) = &self.journal_at else { return };
        let due = self.retry.is_some_and(|at| Instant::now() >= at);
        let part = match self.journal.take() {
            Some(full) if (full.is_full() || self.astray) && at_rest => full.next_part(path, settings),
            None if due && at_rest && room(path).is_none_or(|room| room.bytes >= RETRY_SPACE && !room.lacks_files()) => {
                let weights = self.loaded.iter().cloned().collect();
                Writer::continue_at(path, settings, weights, self.loaded.as_ref().map(|(identity, _)| *identity))
            }
            other => {
                self.journal = other;
                return;
            }
        };
        self.astray = false;
        match part {
            Ok(journal) => {
                (self.say)(Level::Info, &format!("journal: {} begins a new part", path.display()));
                (self.journal, self.retry, self.pause) = (Some(journal), None, RETRY);
            }
            Err(e) => {
                (self.say)(Level::Warning, &format!("{}: no journal: {}; tried again later", path.display(), error_words(&e)));
                self.note.set(|n| n.journal = format!("not written: {}", error_words(&e)));
                self.try_later();
            }
        }
    }

    /// Looks at the journal's place and size and the free space, now and then.
    fn look_at_space(&mut self) {
        if self.space_at.is_some_and(|at| at.elapsed() < SPACE_BEAT) {
            return;
        }
        self.space_at = Some(Instant::now());
        let journal = self.journal_at.as_ref().map(|(path, _)| path.as_path());
        let paths: Vec<&Path> = journal.and_then(Path::parent).into_iter().chain([self.episodes.as_path()]).collect();
        let space = space_words(&paths);
        let line = match (&self.journal, journal) {
            (_, None) => Some("none (controller.journal is not set)".to_owned()),
            (Some(writer), Some(path)) if !writer.is_at(path) => {
                let why = format!("{} {ASTRAY}", path.display());
                if !std::mem::replace(&mut self.astray, true) {
                    (self.say)(Level::Warning, &format!("journal: {why}: a new part begins when nothing is poured or recorded"));
                }
                Some(format!("not written: {why}"))
            }
            (Some(writer), Some(path)) => Some(format!("{}, {:.1} MB", path.display(), writer.len() as f64 / 1e6)),
            (None, Some(_)) => None,
        };
        self.note.set(|n| {
            n.space = space;
            n.journal = match line {
                Some(line) => line,
                None => std::mem::take(&mut n.journal),
            };
        });
    }

    /// Keeps a number ready for the next episode. What is wrong with the directory is said once.
    fn offer_number(&mut self) {
        if self.numbers.is_full() {
            return;
        }
        let taken = self.spare_number.take().map_or_else(|| take_number_above(&self.episodes, self.newest_number), Ok);
        match taken {
            Ok(number) => {
                self.newest_number = number;
                self.no_number.clear();
                if let Err(TrySendError::Full(number)) = self.numbers.try_send(number) {
                    self.spare_number = Some(number);
                }
            }
            Err(e) => {
                let what = format!(
                    "recording.directory = {}: {}: no number for an episode, so no pour begins",
                    self.episodes.display(),
                    error_words(&e)
                );
                if what != self.no_number {
                    (self.say)(Level::Error, &what);
                    self.no_number = what;
                }
            }
        }
    }

    /// Notices a new weight file, reads and checks it, and hands it to the loop.
    fn look_at_weights(&mut self) {
        use std::os::unix::fs::MetadataExt;
        let note = self.note;
        let refuse = |why: String| note.set(|n| n.refused = why);
        let Ok(meta) = std::fs::metadata(&self.path) else {
            if self.seen.is_none() {
                refuse(format!("{}: not there yet", self.path.display()));
            }
            return;
        };
        // The time of the inode's last change, which another mode or owner moves too: those are what a refusal may have asked for.
        let stamp = Some((meta.ctime(), meta.ctime_nsec(), meta.ino(), meta.len()));
        if stamp == self.seen {
            return;
        }
        self.seen = stamp;
        match read_weights(&self.path, self.fps, &self.limits, self.trusted) {
            Ok(weights) => {
                refuse(String::new());
                note.set(|n| n.weights_written = meta.modified().ok());
                (self.say)(
                    Level::Info,
                    &format!("weights {} read from {}; the next pour uses them", weights.identity(), self.path.display()),
                );
                let identity = weights.id();
                self.write(|journal| journal.weights(identity, &weights));
                self.loaded = weights.to_bytes().ok().map(|bytes| (identity, bytes));
                // An agent that still waits is replaced, and dropped here, in an ordinary thread.
                drop(self.exchange.agents.force_push((identity, Box::new(Agent::new(&weights)))));
            }
            Err(e) => {
                (self.say)(Level::Warning, &format!("weights refused, the old ones stay: {e}"));
                refuse(e);
            }
        }
    }
}

/// The weights in `path` if they are for this cell's camera and limits, and of an owner who may give some, or why they are refused. `trusted`
/// is the user number of the configuration's owner.
pub fn read_weights(path: &Path, fps: f64, limits: &Limits, trusted: Option<u32>) -> Result<Weights, String> {
    let weights = Weights::read_of_owner(path, trusted).map_err(|e| e.to_string())?;
    check_weights(&weights, fps, limits).map(|()| weights)
}

/// Whether `weights` are for a camera of `fps` frames a second and for these limits, or why they are refused.
pub fn check_weights(weights: &Weights, fps: f64, limits: &Limits) -> Result<(), String> {
    let trained_hz = f64::from(weights.rate_hz);
    let is_near = |a: f64, b: f64| (a / b - 1.0).abs() < TOLERANCE;
    if !is_near(trained_hz, fps) {
        return Err(format!("trained at {trained_hz} frames/s, camera.fps is {fps}: train with episodes of this camera"));
    }
    if let Estimator::Fused { back, .. } = weights.estimator {
        let ours = WayBack::new(limits, trained_hz);
        if !(is_near(back.rate_deg, ours.rate_deg) && is_near(back.change_deg, ours.change_deg)) {
            let words = |back: WayBack| {
                let (rate, acceleration) = (back.rate_deg * trained_hz, back.change_deg * trained_hz * trained_hz);
                format!("{rate:.0} degrees/s and {acceleration:.0} degrees/s^2")
            };
            return Err(format!(
                "trained for a way back with {}, and [limits] give {}: what still flows on the way back would be foreseen wrongly; train again with \
                 --config of this cell",
                words(back),
                words(ours)
            ));
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::core::Robot;
    use crate::foreseen;
    use crate::journal::Times;

    /// Protects the end of a pour from the border between two parts of a journal: the loop has said that the pour is over before its last ticks have come
    /// through the other thread, so the next part waits for a tick from after it.
    #[test]
    fn a_part_ends_only_behind_the_last_tick_of_a_pour() {
        let directory = tempfile::tempdir().unwrap();
        let mut config = Config::parse(include_str!("../../config/sim.toml"), "config/sim.toml").unwrap();
        config.controller.weights = directory.path().join("weights.bin");
        config.controller.journal = Some(directory.path().join("journal.bin"));
        config.recording.directory = directory.path().join("episodes");
        let (exchange, note) = (Exchange::default(), DiskNote::default());
        let say = |_: Level, _: &str| {};
        let (mut disk, queues) = Disk::open(&config, None, &exchange, &note, &say).unwrap();
        let sender = queues.journal.unwrap();
        let tick_at = |disk: &mut Disk, now_ns: u64| {
            let (robot, features) = (Robot::that_may_move(0.0, now_ns), heapless::Vec::new());
            let times = Times::default();
            let tick = Tick { now_ns, features, robot, order: None, agent: None, target_deg: None, d_ml: 0.0, times };
            sender.send(Box::new((tick, Telemetry::default()))).unwrap();
            disk.write_ticks();
        };
        let rests = |disk: &mut Disk, phase: Phase| {
            exchange.phase.store(phase as u32, SeqCst);
            disk.is_at_rest()
        };
        let pouring_ns = os::now_ns();
        tick_at(&mut disk, pouring_ns);
        assert!(!rests(&mut disk, Phase::Pouring) && !rests(&mut disk, Phase::Settling));
        assert!(!rests(&mut disk, Phase::Idle), "its last ticks may still come");
        tick_at(&mut disk, pouring_ns + 1);
        assert!(!rests(&mut disk, Phase::Idle), "this was one of them");
        tick_at(&mut disk, os::now_ns());
        assert!(rests(&mut disk, Phase::Idle));
        assert!(!rests(&mut disk, Phase::Recording) && !rests(&mut disk, Phase::Idle), "the next one");
    }

    /// Protects a pour from a model that has become wrong: weights that were trained for another way back foresee wrongly what still flows on it, and are
    /// refused with both; a difference that is nothing is none.
    #[test]
    fn weights_for_another_way_back_are_refused() {
        let (ours, directory) = (Limits::default(), tempfile::tempdir().unwrap());
        let path = directory.path().join("weights.bin");
        let read = |limits: Limits| {
            let mut weights = foreseen::tests::weights();
            if let Estimator::Fused { back, .. } = &mut weights.estimator {
                *back = WayBack::new(&limits, 30.0);
            }
            weights.write(&path).unwrap();
            read_weights(&path, 30.0, &ours, None).map(|_| ())
        };
        assert_eq!(read(ours), Ok(()));
        assert_eq!(read(Limits { return_rate_deg_s: 60.2, ..ours }), Ok(()));
        assert_eq!(read(Limits { rate_deg_s: 80.0, ..ours }), Ok(()), "the way back is as before");
        for limits in
            [Limits { return_rate_deg_s: 30.0, ..ours }, Limits { acceleration_deg_s2: 300.0, ..ours }, Limits { rate_deg_s: 40.0, ..ours }]
        {
            let refused = read(limits).unwrap_err();
            assert!(refused.contains("way back with ") && refused.contains("give 60 degrees/s and 1500 degrees/s^2"), "{refused}");
        }
    }

    /// Protects the robot from a file that is exchanged while it is looked at: the bytes that are used are those whose owner and mode were checked. The
    /// name changes all the time between a file of ours and one that everybody may write.
    #[test]
    fn what_is_read_is_what_was_checked() {
        use std::os::unix::fs::PermissionsExt;
        let directory = tempfile::tempdir().unwrap();
        let at = |name: &str| directory.path().join(name);
        let write = |name: &str, seed: u64, mode: u32| {
            Weights { seed, ..foreseen::tests::weights() }.write(&at(name)).unwrap();
            std::fs::set_permissions(at(name), std::fs::Permissions::from_mode(mode)).unwrap();
        };
        write("ours", 1, 0o600);
        write("anybody's", 2, 0o666);
        let (path, done) = (at("weights.bin"), AtomicBool::new(false));
        std::thread::scope(|scope| {
            scope.spawn(|| {
                while !done.load(Relaxed) {
                    for name in ["ours", "anybody's"] {
                        let (new, path) = (at("new"), &path);
                        std::fs::hard_link(at(name), &new).and_then(|()| std::fs::rename(&new, path)).unwrap();
                        // Two names of one file are not renamed, and the new one stays.
                        let _ = std::fs::remove_file(&new);
                    }
                }
            });
            let (mut ours, mut refused) = (0, 0);
            let until = Instant::now() + Duration::from_secs(2);
            while Instant::now() < until {
                match read_weights(&path, 30.0, &Limits::default(), None) {
                    Ok(weights) => {
                        ours += 1;
                        done.store(weights.seed != 1, Relaxed);
                        assert_eq!(weights.seed, 1, "read after another one was checked");
                    }
                    Err(_) => refused += 1,
                }
            }
            done.store(true, Relaxed);
            assert!(ours > 0 && refused > 0, "{ours} {refused}");
        });
    }
}
