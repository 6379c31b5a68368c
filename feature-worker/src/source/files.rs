//! Frames of files that people name on the command line: pictures, videos, patterns of image sequences, and episodes.
//!
//! For commands that end when the files do. Allocates; a file that cannot be read, or of which something is missing, is an error that names
//! it.

use std::path::PathBuf;

use super::frame::{Frame, SourceError};
use super::pictures::is_single;
use super::recording::Recording;

/// Time between two recordings, ns. Chosen by hand: long enough for the eye to take the second one for a new beginning.
const BETWEEN_NS: u64 = 1_000_000_000;

/// What the files of a command line held.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Contents {
    /// Number of frames that came.
    pub frames: u64,
    /// What is missing in which file, a line each.
    pub missing: Vec<String>,
}

/// Calls `each` with every frame of pictures, videos, sequences or episodes. Numbers count from 1 over all files, and times from the first
/// frame, ns; `rate_hz` is that of pictures, which have no times. Single pictures that are named one after the other follow each other without a gap;
/// another recording begins a second later, because what one shows is no evidence of what is in the next. Ends at the first file that cannot be read, or the first error of
/// `each`, with its text. Without `partial`, something missing is such an error.
pub fn for_each_frame(
    input: &[PathBuf],
    rate_hz: f64,
    partial: bool,
    mut each: impl FnMut(Frame) -> Result<(), String>,
) -> Result<Contents, String> {
    let mut contents = Contents::default();
    let words = |e: SourceError| e.to_string();
    // Number and time that the next file starts after.
    let (mut number, mut begin_ns) = (0, 0);
    for (i, path) in input.iter().enumerate() {
        if i > 0 && !(is_single(path) && is_single(&input[i - 1])) {
            begin_ns += BETWEEN_NS;
        }
        let mut recording = Recording::open(path, rate_hz, partial).map_err(words)?;
        let mut last = (0, 0);
        while let Some(mut frame) = recording.next_frame().map_err(words)? {
            last = (frame.header.sequence, frame.header.captured_at_ns);
            frame.header.sequence += number;
            frame.header.captured_at_ns += begin_ns;
            contents.frames += 1;
            each(frame)?;
        }
        contents.missing.extend(recording.remark());
        number += last.0;
        begin_ns += last.1 + (1e9 / rate_hz) as u64;
    }
    Ok(contents)
}
