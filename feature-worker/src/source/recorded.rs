//! The images of a recorded episode, as frames with their own numbers and times.
//!
//! For commands that read files and for the worker when it plays one; on their own thread. Allocates. Lost frames and dropped images leave
//! gaps in the numbers. An episode whose end is missing, or whose images were dropped, is an error, or it is counted.

use std::collections::HashMap;
use std::path::Path;

use opencv::core::Mat;
use shared::episode::{Episode, EpisodeError, EpisodeImages};
use shared::plural::counted;

use super::frame::SourceError;
use super::pictures;

/// An episode's images.
pub(super) struct Recorded {
    path: String,
    images: EpisodeImages,
    /// Number of each row, counted from 0, by its capture time.
    numbers: HashMap<u64, u64>,
    /// Capture time of the first row, ns.
    first_ns: u64,
    /// Number and time of the last image.
    last: Option<(u64, u64)>,
    rate_hz: f64,
    partial: bool,
    remark: Option<String>,
    picture: Mat,
}

impl Recorded {
    /// Opens the episode at `path`. With `partial`, what is missing is counted and is no error.
    pub(super) fn open(path: &Path, partial: bool) -> Result<Self, SourceError> {
        let name = path.display().to_string();
        let fail = |what: String| SourceError::File { path: name.clone(), what };
        // The error names the file, and so does the source's.
        let unread = |e: EpisodeError| fail(e.to_string().trim_start_matches(&format!("{name}: ")).to_owned());
        let episode = Episode::read(path).map_err(unread)?;
        let images = EpisodeImages::open(path).map_err(unread)?;
        let Some(first) = episode.rows.first() else { return Err(fail("the episode has no frames".into())) };
        let mut missing = Vec::new();
        if let Some(what) = episode.lacks() {
            missing.push(format!("{what}; it has {}", counted(episode.rows.len(), "frame")));
        }
        if episode.info.dropped_images > 0 {
            missing.push(format!("{} of its images were dropped while it was recorded", episode.info.dropped_images));
        }
        let what = missing.join(", and ");
        if !missing.is_empty() && !partial {
            return Err(SourceError::Incomplete { path: name, what });
        }
        let remark = (!missing.is_empty()).then(|| format!("{name}: {what}"));
        let rate_hz = (episode.rows.len() - 1) as f64 / episode.seconds();
        let numbers = episode.rows.iter().enumerate().map(|(i, row)| (row.captured_at_ns, i as u64)).collect();
        let first_ns = first.captured_at_ns;
        Ok(Self { path: name, images, numbers, first_ns, last: None, rate_hz, partial, remark, picture: Mat::default() })
    }

    /// Mean frames a second; not a number for a single frame.
    pub(super) fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    /// The next image, its number counted from 0, and its time from the first row, ns; `None` after the last.
    pub(super) fn next(&mut self) -> Result<Option<(&Mat, u64, u64)>, SourceError> {
        for image in self.images.by_ref() {
            let image = image.map_err(|e| SourceError::File { path: self.path.clone(), what: e.to_string() })?;
            let at_ns = image.captured_at_ns.saturating_sub(self.first_ns);
            let number = self.numbers.get(&image.captured_at_ns).copied();
            let number = number.or_else(|| self.last.map(|(number, _)| number + 1)).unwrap_or(0);
            if self.last.is_some_and(|(last, before_ns)| number <= last || at_ns <= before_ns) {
                continue;
            }
            self.last = Some((number, at_ns));
            match pictures::decode(&image.data, &mut self.picture) {
                Ok(()) => return Ok(Some((&self.picture, number, at_ns))),
                Err(_) if self.partial => {}
                Err(what) => {
                    return Err(SourceError::Incomplete {
                        path: self.path.clone(),
                        what: format!("image of frame {}: {what}", number + 1),
                    });
                }
            }
        }
        if self.last.is_none() {
            return Err(SourceError::File { path: self.path.clone(), what: "the episode has no images".into() });
        }
        Ok(None)
    }

    /// What is missing, if something is.
    pub(super) fn remark(&self) -> Option<String> {
        self.remark.clone()
    }
}
