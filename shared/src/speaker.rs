//! What a resident process says: lines go through a bounded queue to a thread that may wait for the terminal.
//!
//! A terminal that was stopped with Ctrl-S, or a pipe that nobody reads, holds whoever writes to it. Only the thread "speaker" may be held.
//! Everybody else puts lines into the queue, which never waits; what does not fit is dropped and counted, and the count is said as soon as
//! the terminal takes lines again. Each line begins with the time in UTC, or, if systemd's journal takes it, with its priority: the journal keeps the time
//! itself.
//!
//! Any ordinary thread may speak; it allocates. Nothing here fails: what cannot be written is lost.

use std::os::fd::AsFd;
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering::SeqCst};
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use crate::episode::rfc3339;
use crate::level::{Level, plain, to_journal};
use crate::os;
use crate::plural::counted;

/// Number of lines that may wait. Chosen by hand: more than a process says in a pour.
const WAITING: usize = 256;
/// Stack of the thread, bytes; it may be locked in memory. Chosen by hand: its deepest call is a write.
const STACK: usize = 128 * 1024;
/// How long a process that ends waits for its last lines to be taken. Chosen by hand: a terminal that works takes them at once.
const LAST_LINES: Duration = Duration::from_millis(300);

/// One line and where it goes.
enum Line {
    /// To standard error, with time or priority, and name.
    Said(Level, String),
    /// To standard output, as it is.
    Printed(String),
}

/// Lets a process speak without waiting.
pub struct Speaker {
    lines: SyncSender<Line>,
    counts: Arc<Counts>,
}

/// What the speaker's thread and the others count together.
#[derive(Default)]
struct Counts {
    queued: AtomicU64,
    written: AtomicU64,
    dropped: AtomicU64,
}

impl Speaker {
    /// Starts the thread "speaker" of the program `name`. If no thread can be started, nothing is said.
    pub fn start(name: &'static str) -> Self {
        let (lines, queue) = sync_channel(WAITING);
        let counts = Arc::new(Counts::default());
        let its = Arc::clone(&counts);
        let spawned = std::thread::Builder::new().name("speaker".into()).stack_size(STACK).spawn(move || write_lines(name, &queue, &its));
        if let Err(e) = spawned {
            os::tell(Level::Error, &format!("{name}: no thread could be started, so nothing more is said: {e}"));
        }
        Self { lines, counts }
    }

    /// Says `text` on standard error.
    pub fn say(&self, level: Level, text: &str) {
        self.queue(Line::Said(level, text.into()));
    }

    /// Writes `line` to standard output.
    pub fn print(&self, line: String) {
        self.queue(Line::Printed(line));
    }

    /// Number of lines that did not fit since the start.
    pub fn dropped(&self) -> u64 {
        self.counts.dropped.load(SeqCst)
    }

    /// Waits until everything is written, at most a moment: a stopped terminal must not keep a process alive.
    pub fn finish(&self) {
        let until = Instant::now() + LAST_LINES;
        while self.counts.written.load(SeqCst) < self.counts.queued.load(SeqCst) && Instant::now() < until {
            std::thread::sleep(Duration::from_millis(2));
        }
    }

    fn queue(&self, line: Line) {
        self.counts.queued.fetch_add(1, SeqCst);
        if self.lines.try_send(line).is_err() {
            self.counts.queued.fetch_sub(1, SeqCst);
            self.counts.dropped.fetch_add(1, SeqCst);
        }
    }
}

/// The thread "speaker".
fn write_lines(name: &str, queue: &Receiver<Line>, counts: &Counts) {
    let mut told = 0;
    while let Ok(line) = queue.recv() {
        match line {
            Line::Said(level, text) => write(std::io::stderr().as_fd(), &said(level, &format!("{name}: {text}"))),
            Line::Printed(text) => write(std::io::stdout().as_fd(), &format!("{text}\n")),
        }
        let dropped = counts.dropped.load(SeqCst);
        if dropped > told {
            let lost = dropped - told;
            let what = format!("{name}: {} missing here, because what reads them had stopped", counted(lost, "line"));
            write(std::io::stderr().as_fd(), &said(Level::Warning, &what));
            told = dropped;
        }
        counts.written.fetch_add(1, SeqCst);
    }
}

/// A line as it is written: after its priority if systemd's journal reads it, else after the time.
fn said(level: Level, line: &str) -> String {
    if to_journal() {
        return level.marked(line) + "\n";
    }
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    let whole = rfc3339(since.as_secs());
    format!("{}.{:03}Z {}\n", whole.trim_end_matches('Z'), since.subsec_millis(), plain(line))
}

/// Writes all of `text`, for as long as it takes. It goes past the standard library's lock, so that nobody waits for this thread.
fn write(to: impl AsFd, text: &str) {
    let mut left = text.as_bytes();
    while !left.is_empty() {
        match rustix::io::write(&to, left) {
            Ok(n) => left = &left[n..],
            Err(rustix::io::Errno::INTR) => {}
            // Somebody else made the file non-blocking.
            Err(rustix::io::Errno::AGAIN) => std::thread::sleep(Duration::from_millis(10)),
            Err(_) => return,
        }
    }
}
