//! The controller's log: what a robot would show as a popup or as a line of its log.
//!
//! Pure. Runs on the controller's thread and allocates within the two bounds below. When the log is full, the oldest line goes.

use std::collections::VecDeque;

/// Most lines that are kept until somebody takes them. Chosen by hand; no measurement is recorded.
pub const MAX_LINES: usize = 1000;
/// Longest line in bytes; the rest is cut off. Chosen by hand; no measurement is recorded.
const MAX_LINE_BYTES: usize = 1024;

/// What a log line is about.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum LogKind {
    /// The program wrote the line itself, with `textmsg`.
    Text,
    /// The program has a mistake, or it was refused.
    ProgramError,
    /// Something happened to the program or to the robot's safety.
    Event,
}

/// A line of the controller's log.
#[derive(Debug, Clone, PartialEq)]
pub struct LogLine {
    /// Controller time in s.
    pub timestamp_s: f64,
    /// What the line is about.
    pub kind: LogKind,
    /// The line's text, without a line end.
    pub text: String,
}

/// The lines that nobody has taken yet, oldest first.
#[derive(Debug, Default)]
pub struct Log {
    lines: VecDeque<LogLine>,
}

impl Log {
    /// Appends a line and cuts it to the longest length that is kept.
    pub fn note(&mut self, timestamp_s: f64, kind: LogKind, text: &str) {
        if self.lines.len() >= MAX_LINES {
            self.lines.pop_front();
        }
        let mut end = text.len().min(MAX_LINE_BYTES);
        while !text.is_char_boundary(end) {
            end -= 1;
        }
        self.lines.push_back(LogLine { timestamp_s, kind, text: text[..end].to_owned() });
    }

    /// Takes all lines.
    pub fn take(&mut self) -> impl Iterator<Item = LogLine> + '_ {
        self.lines.drain(..)
    }
}
