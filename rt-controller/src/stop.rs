//! The way to stop a motion that depends on nothing else: no shared memory, no disk, no terminal, and no other thread of the controller but
//! the loop.
//!
//! Two sockets take one line from a client, `abort` or `state`, and answer with one line of JSON ([`StopAnswer`]): the file `stop` in the
//! cell's runtime directory, and the abstract socket `decant/UID/NAME`, which no deletion of files reaches. The kernel says who asks: the
//! controller's own user and root, and at the file also whom the directory's mode lets in. The thread "stop" serves them, and passes signals
//! on to the loop. It allocates, and waits for nobody: a client that says nothing is dropped when others need its place.
//!
//! A socket that cannot be made fails the start; a client that cannot be served is dropped. When the loop has ended, upright, or is to end before it has begun,
//! the other threads get a moment to end too, and then the process ends without them.

use std::io::{Read, Write};
use std::os::fd::AsFd;
use std::os::linux::net::SocketAddrExt;
use std::os::unix::fs::{FileTypeExt, MetadataExt, PermissionsExt};
use std::os::unix::net::{SocketAddr, UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicBool, Ordering::SeqCst};
use std::time::{Duration, Instant};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use rustix::net::{AddressFamily, SocketAddrUnix, SocketFlags, SocketType, connect, socket_with};
use serde::{Deserialize, Serialize};
use shared::exit::{self, Failure, failure};
use shared::level::Level;
use shared::messages::Phase;
use shared::os::peer_uid;
use shared::runtime_dir::own_uid;

use crate::exchange::Exchange;
use crate::robot_thread::RobotNote;

/// How long the thread waits before it looks at the signals' flag. Chosen by hand: below a tick.
const BEAT: Timespec = Timespec { tv_sec: 0, tv_nsec: 20_000_000 };
/// Number of clients that may be connected at once. Chosen by hand; one more replaces the oldest, so that an abort always gets in.
const CLIENTS: usize = 16;
/// Rounds in which a socket without a free place is tried again. Chosen by hand: a controller frees a place within 1 ms.
pub(crate) const ROUNDS: u32 = 5;
/// Pause between these rounds. Chosen by hand: all of them take 20 ms.
pub(crate) const ROUND: Duration = Duration::from_millis(4);
/// Longest line from a client, bytes.
const LINE_MAX: usize = 64;
/// How long the other threads may take to end once the loop has ended. Chosen by hand: a disk that works is done much sooner.
const GRACE: Duration = Duration::from_secs(2);

/// What the controller answers at its stop socket. An abort works across versions: what an answer lacks, or has too much, is no reason not to understand it.
#[derive(Debug, Clone, PartialEq, Default, Serialize, Deserialize)]
#[serde(default)]
pub struct StopAnswer {
    /// Process number of the controller, as it sees it itself.
    pub pid: u32,
    /// What the controller is doing.
    #[serde(default = "moving", deserialize_with = "known_phase")]
    pub phase: Phase,
    /// Measured alpha, degrees; `None` without a robot.
    pub alpha_deg: Option<f32>,
    /// Whether the robot is there, the container is upright, and no motion is under way.
    pub upright: bool,
    /// Why the robot cannot be moved, one line; empty if it can.
    pub hindrance: String,
    /// Why the request was not obeyed, one line; empty if it was.
    pub refused: String,
}

/// The phase of an answer that does not say it.
fn moving() -> Phase {
    Phase::Pouring
}

/// A phase by its name. A controller of another version may be in one that is not known here, and may move in it.
fn known_phase<'de, D: serde::Deserializer<'de>>(from: D) -> Result<Phase, D::Error> {
    let name = serde_json::Value::deserialize(from)?;
    Ok(Phase::deserialize(name).unwrap_or_else(|_| moving()))
}

/// Name of the abstract socket of user `uid`'s cell `name`.
pub fn abstract_name(uid: u32, name: &str) -> String {
    format!("decant/{uid}/{name}")
}

/// The two sockets of a running controller. The file is removed at the end.
#[derive(Debug)]
pub struct StopSockets {
    file: UnixListener,
    path: PathBuf,
    /// `None` if somebody else has the name.
    nameless: Option<UnixListener>,
}

/// The user who listens at the abstract socket of user `uid`'s cell `name`; otherwise as [`listener`].
pub(crate) fn named_listener(uid: u32, name: &str) -> Result<u32, bool> {
    listener(&SocketAddrUnix::new_abstract_name(abstract_name(uid, name).as_bytes()).map_err(|_| false)?)
}

/// The user who listens at `address`, or whether its places are all taken, so that nobody can tell. Nobody is waited for.
pub(crate) fn listener(address: &SocketAddrUnix) -> Result<u32, bool> {
    let flags = SocketFlags::NONBLOCK | SocketFlags::CLOEXEC;
    let socket = socket_with(AddressFamily::UNIX, SocketType::STREAM, flags, None).map_err(|_| false)?;
    connect(&socket, address).map_err(|e| e == rustix::io::Errno::AGAIN)?;
    peer_uid(&socket).ok_or(false)
}

/// Whether a controller of this user listens at the abstract socket of its cell `name`. One frees a place within 1 ms, so a socket whose places stay taken
/// is no controller's that works.
fn is_ours(name: &str) -> bool {
    for _ in 0..ROUNDS {
        match named_listener(own_uid(), name) {
            Err(true) => std::thread::sleep(ROUND),
            other => return other == Ok(own_uid()),
        }
    }
    false
}

impl StopSockets {
    /// Opens the sockets of the cell `name` in `directory`. Fails if there is no way to stop a motion, or if another controller of the cell is there.
    /// `say` gets a line if only the file could be had.
    ///
    /// Call it with the controller's lock held, because it takes the place of a socket that a dead controller left.
    pub fn open(directory: &Path, name: &str, say: &dyn Fn(Level, &str)) -> Result<Self, Failure> {
        let path = directory.join("stop");
        let fail = |e: std::io::Error| failure(exit::FAILED, format!("{}: {e}: no way to stop a motion, so none is begun", path.display()));
        // Of two that start at once, one gets the name.
        let nameless = SocketAddr::from_abstract_name(abstract_name(own_uid(), name)).and_then(|a| UnixListener::bind_addr(&a));
        if nameless.is_err() && is_ours(name) {
            let what = format!("another rt-controller of cell '{name}' is running: stop it first (its runtime directory was deleted)");
            return Err(failure(exit::REFUSED, what));
        }
        // What a dead controller has left; anything else is somebody's file, and is left as it is.
        if path.symlink_metadata().is_ok_and(|m| m.file_type().is_socket()) {
            let _ = std::fs::remove_file(&path);
        }
        let file = UnixListener::bind(&path).map_err(fail)?;
        // A group that may enter the directory may also stop the robot.
        std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o660)).map_err(fail)?;
        file.set_nonblocking(true).map_err(fail)?;
        let nameless = nameless.and_then(|l| l.set_nonblocking(true).map(|()| l));
        if let Err(e) = &nameless {
            say(
                Level::Warning,
                &format!("the second way to stop, socket @{}: {e}: another user has its name", abstract_name(own_uid(), name)),
            );
        }
        Ok(Self { file, path, nameless: nameless.ok() })
    }
}

impl Drop for StopSockets {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.path);
    }
}

/// A client that has not said its whole line yet.
struct Waiting {
    stream: UnixStream,
    line: Vec<u8>,
}

/// What the thread "stop" works with.
pub struct StopThread<'a> {
    /// The sockets.
    pub sockets: StopSockets,
    /// The way to the loop.
    pub exchange: &'a Exchange,
    /// What the robot's thread has to say.
    pub robot_note: &'a RobotNote,
    /// Largest alpha that counts as upright, degrees.
    pub tolerance_deg: f32,
    /// Becomes true at a signal, or when a thread cannot go on.
    pub stop: &'a AtomicBool,
    /// Asks the robot's and the disk's threads to end, should the thread that does so be held up.
    pub end: &'a AtomicBool,
    /// Becomes true when the process's other threads have ended.
    pub done: &'a AtomicBool,
    /// Ends the process although a thread is held up.
    pub give_up: &'a (dyn Fn() + Sync),
}

impl StopThread<'_> {
    /// Serves until the loop and the other threads have ended, or ends the process when they do not.
    pub fn run(&self) {
        let mut clients: Vec<Waiting> = Vec::new();
        let mut ended: Option<Instant> = None;
        while !self.done.load(SeqCst) {
            self.exchange.shutdown.fetch_or(self.stop.load(SeqCst), SeqCst);
            // A start that a disk or shared memory holds up never comes to a loop that could end.
            let never_begins = self.stop.load(SeqCst) && !self.exchange.begun.load(SeqCst);
            if never_begins || self.exchange.ended.load(SeqCst) {
                let since = ended.get_or_insert_with(Instant::now).elapsed();
                self.end.fetch_or(since > GRACE / 2, SeqCst);
                if since > GRACE {
                    return (self.give_up)();
                }
            } else {
                ended = None;
            }
            self.wait(&clients);
            // The file comes first: strangers reach only the other one. One of each a turn, so that neither shuts the other out.
            for listener in std::iter::once(&self.sockets.file).chain(&self.sockets.nameless) {
                if let Some(stream) = self.accept(listener) {
                    if clients.len() == CLIENTS {
                        clients.remove(0);
                    }
                    clients.push(Waiting { stream, line: Vec::new() });
                }
            }
            clients.retain_mut(|client| self.serve(client));
        }
    }

    /// Waits until there is something to do, a moment at most.
    fn wait(&self, clients: &[Waiting]) {
        let listeners = std::iter::once(&self.sockets.file).chain(&self.sockets.nameless).map(AsFd::as_fd);
        let all = listeners.chain(clients.iter().map(|c| c.stream.as_fd()));
        let mut waits: Vec<PollFd> = all.map(|fd| PollFd::from_borrowed_fd(fd, PollFlags::IN)).collect();
        // A failure is a look too many.
        let _ = poll(&mut waits, Some(&BEAT));
    }

    /// Takes a client that may ask.
    fn accept(&self, listener: &UnixListener) -> Option<UnixStream> {
        let (stream, _) = listener.accept().ok()?;
        stream.set_nonblocking(true).ok()?;
        let uid = peer_uid(&stream)?;
        // At the file, the directory's mode has let in only whom its owner wants.
        let by_group = std::ptr::eq(listener, &raw const self.sockets.file) && self.group_may_stop();
        if uid == own_uid() || uid == 0 || by_group {
            return Some(stream);
        }
        let answer = StopAnswer { refused: "only the controller's own user and root may stop it here".into(), ..self.state() };
        send(&stream, &answer);
        None
    }

    /// Whether the directory's mode lets its group in.
    fn group_may_stop(&self) -> bool {
        self.sockets.path.parent().and_then(|d| d.symlink_metadata().ok()).is_some_and(|m| m.mode() & 0o010 != 0)
    }

    /// Reads what a client says and answers a whole line. Gives whether the client is still to be heard.
    fn serve(&self, client: &mut Waiting) -> bool {
        let mut bytes = [0; LINE_MAX];
        match client.stream.read(&mut bytes) {
            Ok(0) => return false,
            Ok(n) => client.line.extend_from_slice(&bytes[..n]),
            Err(e) if e.kind() == std::io::ErrorKind::WouldBlock => return true,
            Err(_) => return false,
        }
        let Some(end) = client.line.iter().position(|c| *c == b'\n') else { return client.line.len() < LINE_MAX };
        let mut answer = self.state();
        match &client.line[..end] {
            b"abort" => {
                self.exchange.abort();
                if !answer.hindrance.is_empty() {
                    answer.refused.clone_from(&answer.hindrance);
                }
            }
            b"state" => {}
            _ => answer.refused = "the request comes from another version of Decant: run the same build on both sides".into(),
        }
        send(&client.stream, &answer);
        false
    }

    /// The controller's state, from what the loop left after its newest tick.
    fn state(&self) -> StopAnswer {
        // An abort that the loop has not obeyed yet is still to move the container. It is looked at before the phase, which then shows what came of it.
        let obeyed = self.exchange.aborts_obeyed.load(SeqCst) == self.exchange.aborts.load(SeqCst);
        let phase = Phase::from_code(self.exchange.phase.load(SeqCst));
        let alpha_deg = f32::from_bits(self.exchange.alpha_measured.load(SeqCst));
        let note = self.robot_note.get().text;
        let hindrance = match phase {
            Phase::NoRobot if !note.is_empty() => note,
            Phase::NoRobot if alpha_deg.is_finite() => crate::core::Refusal::NotUpright(alpha_deg).to_string(),
            Phase::NoRobot => "waiting for the robot".into(),
            _ => String::new(),
        };
        let at_rest = matches!(phase, Phase::Idle | Phase::Settling);
        let upright = obeyed && at_rest && alpha_deg.abs() <= self.tolerance_deg;
        let alpha_deg = alpha_deg.is_finite().then_some(alpha_deg);
        StopAnswer { pid: std::process::id(), phase, alpha_deg, upright, hindrance, refused: String::new() }
    }
}

/// Sends an answer; a client that does not take it is no error. It fits into any socket's buffer.
fn send(mut stream: &UnixStream, answer: &StopAnswer) {
    if let Ok(text) = serde_json::to_string(answer) {
        let _ = stream.write_all(format!("{text}\n").as_bytes());
    }
}
