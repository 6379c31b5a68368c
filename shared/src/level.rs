//! How much a line on standard error matters, as systemd's journal keeps it.
//!
//! systemd gives a service a stream to its journal as standard error, and names that stream in `JOURNAL_STREAM` (systemd.exec(5)). Lines there begin
//! with a priority in angle brackets (sd-daemon(3)), so that `journalctl -p warning` finds what matters; anywhere else they would only be in the
//! way. Any ordinary thread may ask; it allocates. Nothing here fails: a stream that cannot be looked at is no journal.

use std::sync::OnceLock;

/// How much a line matters.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Level {
    /// The program, or a part of it, cannot do its work.
    Error,
    /// Something keeps it from its work for now, or somebody should look.
    Warning,
    /// What a person may want to know.
    Info,
}

impl Level {
    /// The line as standard error takes it: with its priority before each of its lines if that is systemd's journal, else as it is.
    pub fn marked(self, line: &str) -> String {
        if !to_journal() {
            return line.to_owned();
        }
        let priority = match self {
            Self::Error => 3,
            Self::Warning => 4,
            Self::Info => 6,
        };
        let marked: Vec<String> = line.lines().map(|one| format!("<{priority}>{one}")).collect();
        marked.join("\n")
    }
}

/// Whether standard error is systemd's journal: `JOURNAL_STREAM` is inherited, so only the stream that it names counts. It is looked at once.
pub fn to_journal() -> bool {
    static ANSWER: OnceLock<bool> = OnceLock::new();
    *ANSWER.get_or_init(|| {
        let named = std::env::var("JOURNAL_STREAM").unwrap_or_default();
        rustix::fs::fstat(std::io::stderr()).is_ok_and(|is| named == format!("{}:{}", is.st_dev, is.st_ino))
    })
}
