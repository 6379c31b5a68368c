//! A recording of any kind: a video, a numbered sequence, one picture, or an episode. It gives frame after frame with numbers and times.
//!
//! For commands that read files and for the worker when it plays one; on their own thread. Allocates. Numbers count from 1 and have a gap
//! where a frame is missing; times count from the first frame. A file without times of its own has those of the configured rate.

use std::path::Path;

use opencv::core::{CV_8UC1, CV_8UC3, Mat};
use opencv::prelude::*;
use shared::messages::{FrameHeader, LAYOUT_VERSION, PixelFormat};

use super::frame::{Frame, SourceError};
use super::pictures::{self, Pattern, Sequence};
use super::recorded::Recorded;
use super::video::Video;

/// The kinds of recordings.
enum Kind {
    Video(Box<Video>),
    Sequence(Sequence),
    Recorded(Box<Recorded>),
}

/// A recording that was opened.
pub struct Recording {
    path: String,
    kind: Kind,
    /// Frames a second where the file has no times of its own.
    rate_hz: f64,
}

impl Recording {
    /// Opens what `path` names: an episode (`.mcap`), one picture, a pattern such as `frame_%04d.png`, or a video. `rate_hz` is that of
    /// pictures and of streams without a container, which have no times of their own. Without `partial`, whatever is missing is an error, here or at its place.
    pub fn open(path: &Path, rate_hz: f64, partial: bool) -> Result<Self, SourceError> {
        let kind = if let Some(pattern) = Pattern::of(path) {
            Kind::Sequence(Sequence::open(path, &pattern, partial)?)
        } else if path.extension().is_some_and(|e| e.eq_ignore_ascii_case("mcap")) {
            Kind::Recorded(Box::new(Recorded::open(path, partial)?))
        } else if pictures::is_picture(path) {
            Kind::Sequence(Sequence::single(path, partial))
        } else {
            let name = path.to_str().ok_or_else(|| SourceError::File {
                path: path.display().to_string(),
                what: "its name is no text in UTF-8, so OpenCV cannot open it: give it another name".into(),
            })?;
            Kind::Video(Box::new(Video::open(name, rate_hz, partial)?))
        };
        Ok(Self { path: path.display().to_string(), kind, rate_hz })
    }

    /// The next frame, or `None` after the last.
    pub fn next_frame(&mut self) -> Result<Option<Frame<'_>>, SourceError> {
        let period_ns = 1e9 / self.rate_hz;
        let next = match &mut self.kind {
            Kind::Video(video) => video.next()?,
            Kind::Recorded(recorded) => recorded.next()?,
            Kind::Sequence(sequence) => sequence.next()?.map(|(picture, number)| (picture, number, (number as f64 * period_ns) as u64)),
        };
        next.map(|(picture, number, at_ns)| frame(&self.path, picture, number + 1, at_ns)).transpose()
    }

    /// Frames a second by the file's own word, if it has one.
    pub fn own_rate_hz(&self) -> Option<f64> {
        let rate_hz = match &self.kind {
            Kind::Video(video) => video.rate_hz(),
            Kind::Recorded(recorded) => recorded.rate_hz(),
            Kind::Sequence(_) => 0.0,
        };
        (rate_hz.is_finite() && rate_hz > 0.0).then_some(rate_hz)
    }

    /// What is missing in one line, if something is; complete after the last frame.
    pub fn remark(&self) -> Option<String> {
        match &self.kind {
            Kind::Video(video) => video.remark(),
            Kind::Recorded(recorded) => recorded.remark(),
            Kind::Sequence(sequence) => sequence.remark(),
        }
    }
}

/// A picture as a frame.
fn frame<'a>(path: &str, picture: &'a Mat, sequence: u64, captured_at_ns: u64) -> Result<Frame<'a>, SourceError> {
    let format = match picture.typ() {
        CV_8UC3 => PixelFormat::Bgr8,
        CV_8UC1 => PixelFormat::Mono8,
        other => {
            let what = format!("gives pixels of OpenCV type {other}; only grey and colour are read");
            return Err(SourceError::File { path: path.into(), what });
        }
    };
    let header = FrameHeader {
        version: LAYOUT_VERSION,
        format: format as u32,
        width_px: picture.cols() as u32,
        height_px: picture.rows() as u32,
        sequence,
        captured_at_ns,
        published_at_ns: captured_at_ns,
    };
    Ok(Frame { header, pixels: picture.data_bytes()? })
}
