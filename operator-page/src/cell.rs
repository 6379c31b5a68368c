//! What the page knows of the cell, and how it asks the controller: through the link, a child process that is started again whenever it ends.
//!
//! A thread of its own starts the link and takes its messages; other threads read what is known under a lock that nobody holds for long.
//! Allocates; what is kept is bounded. What the link or the controller does not tell is said in words.

use std::collections::{BTreeMap, VecDeque};
use std::path::PathBuf;
use std::process::{Child, ChildStdin, Command, Stdio};
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::mpsc::{Sender, channel};
use std::sync::{Arc, Mutex, MutexGuard};
use std::time::{Duration, Instant};

use shared::control::{Reply, Request, Status};
use shared::messages::Phase;

use crate::ends::Ends;
use crate::lock::locked;
use crate::wire::{self, FromLink, Picture, Point, ToLink};

/// Number of ticks that are kept for plots: a minute at 30 Hz.
const POINTS: usize = 1800;
/// Number of closed files that are remembered. Chosen by hand: more than the controller's results.
const FILES: usize = 64;
/// Longest wait for an answer through the link: the client's own limits, and a little more.
const ANSWER: Duration = Duration::from_secs(8);
/// A link that has said nothing for this long hangs and is ended: it asks for the state twice a second, and waits 2 s for an answer.
const LINK_SILENT: Duration = Duration::from_secs(8);
/// Pause before a link that ended is started again. Chosen by hand; no measurement is recorded.
const AGAIN: Duration = Duration::from_millis(500);
/// Without a tick for this long the controller is not there: thirty of its ticks.
pub const SILENT: Duration = Duration::from_secs(1);
/// Without a look at pictures for this long nobody looks. Chosen by hand: a page asks more than ten times a second.
const LOOKED: Duration = Duration::from_secs(3);

/// What is known of the cell.
#[derive(Debug, Default)]
pub struct Live {
    /// The newest ticks, the newest last.
    pub points: VecDeque<Point>,
    /// When the newest tick came.
    pub points_at: Option<Instant>,
    /// The controller's newest state.
    pub status: Option<Box<Status>>,
    /// Why there is no newer state; empty if there is.
    pub no_status: String,
    /// The newest picture.
    pub picture: Option<Arc<Picture>>,
    /// When it came.
    pub picture_at: Option<Instant>,
    /// Why there is no newer picture; empty if there is.
    pub no_picture: String,
    /// What became of each episode's file.
    pub files: BTreeMap<u64, Result<String, String>>,
    /// How pours and recordings ended.
    pub ends: Ends,
    looked_at: Option<Instant>,
    heard_at: Option<Instant>,
}

impl Live {
    /// Whether the controller ticks.
    pub fn ticks(&self) -> bool {
        self.points_at.is_some_and(|at| at.elapsed() < SILENT)
    }

    /// What the controller is doing, if it ticks.
    pub fn phase(&self) -> Option<Phase> {
        self.points.back().filter(|_| self.ticks()).map(|p| Phase::from_code(p.phase))
    }
}

/// The page's side of the link.
pub struct Cell {
    config: PathBuf,
    live: Mutex<Live>,
    link: Mutex<Option<ChildStdin>>,
    waiting: Mutex<BTreeMap<u64, Sender<Result<Reply, String>>>>,
    next: AtomicU64,
    /// Whether a pour is held; a link that is started again is told.
    held: AtomicBool,
}

impl Cell {
    /// A cell of which nothing is known yet but how earlier episodes ended.
    pub fn new(config: PathBuf, ends: Ends) -> Self {
        let (live, link, waiting) = (Mutex::new(Live { ends, ..Live::default() }), Mutex::default(), Mutex::default());
        Self { config, live, link, waiting, next: AtomicU64::new(1), held: AtomicBool::new(false) }
    }

    /// What is known now. Give it back soon.
    pub fn live(&self) -> MutexGuard<'_, Live> {
        locked(&self.live)
    }

    /// Asks the controller, and waits for its answer.
    pub fn ask(&self, request: Request) -> Result<Reply, String> {
        let number = self.next.fetch_add(1, Relaxed);
        let (sender, answer) = channel();
        locked(&self.waiting).insert(number, sender);
        let asked = self.tell(&ToLink::Ask(number, request));
        let result = if asked { answer.recv_timeout(ANSWER).ok() } else { None };
        locked(&self.waiting).remove(&number);
        result.unwrap_or_else(|| Err("the cell's shared memory does not answer: is the cell running, as the same user?".into()))
    }

    /// The newest picture, for somebody who looks.
    pub fn look(&self) -> Result<Arc<Picture>, String> {
        let mut live = self.live();
        let began = live.looked_at.replace(Instant::now()).is_none();
        let recent = live.picture_at.is_some_and(|at| at.elapsed() < SILENT);
        let answer = match (&live.picture, recent) {
            (Some(picture), true) => Ok(Arc::clone(picture)),
            _ if live.no_picture.is_empty() => Err("waiting for the first picture".into()),
            _ => Err(live.no_picture.clone()),
        };
        drop(live);
        if began {
            self.tell(&ToLink::Look(true));
        }
        answer
    }

    /// Tells the link whether a pour is held.
    pub fn hold(&self, held: bool) {
        self.held.store(held, Relaxed);
        self.tell(&ToLink::Hold(held));
    }

    /// Sends a message to the link; false if there is none.
    fn tell(&self, message: &ToLink) -> bool {
        let mut link = locked(&self.link);
        link.as_mut().is_some_and(|pipe| wire::write(pipe, message, 0).is_ok())
    }

    /// Keeps a link running until `stop` is set.
    pub fn keep(self: &Arc<Self>, stop: &AtomicBool) {
        while !stop.load(Relaxed) {
            match self.start() {
                Ok(mut child) => {
                    self.watch(&mut child, stop);
                    *locked(&self.link) = None;
                    // It may have ended by itself.
                    let _ = child.kill();
                    let _ = child.wait();
                }
                Err(e) => self.live().no_status = format!("the link to the cell cannot be started: {e}"),
            }
            std::thread::sleep(AGAIN);
        }
    }

    fn start(self: &Arc<Self>) -> std::io::Result<Child> {
        let program = std::env::current_exe()?;
        let mut command = Command::new(program);
        command.arg("link").arg("--config").arg(&self.config).stdin(Stdio::piped()).stdout(Stdio::piped());
        let mut child = command.spawn()?;
        *locked(&self.link) = child.stdin.take();
        if self.held.load(Relaxed) {
            self.tell(&ToLink::Hold(true));
        }
        let Some(mut output) = child.stdout.take() else { return Err(std::io::ErrorKind::BrokenPipe.into()) };
        let mut live = self.live();
        (live.heard_at, live.looked_at) = (Some(Instant::now()), None);
        drop(live);
        let this = Arc::clone(self);
        std::thread::Builder::new().name("link".into()).spawn(move || {
            while let Ok(message) = wire::read(&mut output) {
                this.take(message);
            }
        })?;
        Ok(child)
    }

    /// Waits until the link ends, hangs, or is no longer wanted.
    fn watch(&self, child: &mut Child, stop: &AtomicBool) {
        while !stop.load(Relaxed) && matches!(child.try_wait(), Ok(None)) {
            std::thread::sleep(SILENT / 10);
            let mut live = self.live();
            if live.heard_at.is_none_or(|at| at.elapsed() > LINK_SILENT) {
                live.no_status = "the cell's shared memory hangs: end all programs of the cell and start them again".into();
                return;
            }
            if live.looked_at.is_some_and(|at| at.elapsed() > LOOKED) {
                live.looked_at = None;
                drop(live);
                self.tell(&ToLink::Look(false));
            }
        }
    }

    fn take(&self, message: FromLink) {
        let mut live = self.live();
        live.heard_at = Some(Instant::now());
        match message {
            FromLink::Points(points) => {
                // A controller that was started again counts its ticks anew.
                if points.first().zip(live.points.back()).is_some_and(|(new, last)| new.tick <= last.tick) {
                    live.points.clear();
                }
                live.points.extend(points);
                let surplus = live.points.len().saturating_sub(POINTS);
                live.points.drain(..surplus);
                live.points_at = Some(Instant::now());
            }
            FromLink::Status(status) => {
                let live = &mut *live;
                live.ends.remember(&status.outcomes, &live.files);
                live.status = Some(status);
                live.no_status.clear();
            }
            FromLink::NoStatus(what) | FromLink::Broken(what) => {
                live.status = None;
                live.no_status = what;
            }
            FromLink::Recorded(recorded) => {
                live.files.insert(recorded.episode, recorded.file);
                if live.files.len() > FILES {
                    live.files.pop_first();
                }
            }
            FromLink::Picture(picture) => {
                live.picture = Some(Arc::new(picture));
                live.picture_at = Some(Instant::now());
                live.no_picture.clear();
            }
            FromLink::NoPicture(what) => live.no_picture = what,
            FromLink::Answer(number, answer) => {
                drop(live);
                if let Some(waiting) = locked(&self.waiting).remove(&number) {
                    // Whoever asked may have given up.
                    let _ = waiting.send(answer);
                }
            }
        }
    }
}
