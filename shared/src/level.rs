//! How much a line on standard error matters, as systemd's journal keeps it.
//!
//! systemd gives a service a stream to its journal as standard error, and names that stream in `JOURNAL_STREAM` (systemd.exec(5)). Lines there begin
//! with a priority in angle brackets (sd-daemon(3)), so that `journalctl -p warning` finds what matters; anywhere else they would only be in the
//! way. Any ordinary thread may ask; it allocates. Nothing here fails: a stream that cannot be looked at is no journal.

use std::borrow::Cow;
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
    /// The line as standard error takes it: with its priority before it if that is systemd's journal. It is one line whatever it quotes.
    pub fn marked(self, line: &str) -> String {
        let line = plain(line);
        if !to_journal() {
            return line.into_owned();
        }
        let priority = match self {
            Self::Error => 3,
            Self::Warning => 4,
            Self::Info => 6,
        };
        format!("<{priority}>{line}")
    }
}

/// `text` with every control character as Rust writes it, such as `\n`: a file's name, or what another program wrote into a file, must neither begin a
/// line of its own nor command a terminal.
pub fn plain(text: &str) -> Cow<'_, str> {
    if !text.contains(char::is_control) {
        return text.into();
    }
    text.chars().flat_map(|c| if c.is_control() { c.escape_default().collect::<Vec<_>>() } else { vec![c] }).collect()
}

/// Whether standard error is systemd's journal: `JOURNAL_STREAM` is inherited, so only the stream that it names counts. It is looked at once.
pub fn to_journal() -> bool {
    static ANSWER: OnceLock<bool> = OnceLock::new();
    *ANSWER.get_or_init(|| {
        let named = std::env::var("JOURNAL_STREAM").unwrap_or_default();
        rustix::fs::fstat(std::io::stderr()).is_ok_and(|is| named == format!("{}:{}", is.st_dev, is.st_ino))
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects whoever reads a terminal or a log: a name with a line's end or a terminal's command in it stays a part of the line that quotes it.
    #[test]
    fn what_is_quoted_begins_no_line_and_commands_no_terminal() {
        assert_eq!(plain("two words, \u{e4} and 100 %"), "two words, \u{e4} and 100 %");
        assert_eq!(plain("a\nerror: b\x1b[2J\u{9b}2J"), "a\\nerror: b\\u{1b}[2J\\u{9b}2J");
        assert_eq!(Level::Error.marked("x: a\n<3>b").lines().count(), 1);
    }
}
