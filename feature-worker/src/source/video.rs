//! A video file, picture after picture, with the file's own times.
//!
//! For commands that read files and for the worker when it plays one; on their own thread. OpenCV's FFmpeg decodes into one matrix that is
//! reused. The pictures are turned as the file's metadata say, by our own code, because OpenCV 4.6 turns them the wrong way round. Pictures
//! that the file promises and that do not come are an error that names the first of them, or they are counted. What a decoder patches up
//! by itself (a damaged block in the middle of a picture) cannot be seen here.

use opencv::core::Mat;
use opencv::prelude::*;
use opencv::videoio::{self, VideoCapture};

use super::container::{Container, Turn};
use super::frame::SourceError;
use super::pictures::unreadable;

/// Periods that the end of the last picture may lie before the end of the video. Chosen by hand: rounding, and a sound track's padding.
const END_PERIODS: f64 = 2.5;
/// Periods between two pictures from which on one is missing where all periods are the same. Half way to the second.
const GAP_PERIODS: f64 = 1.5;

/// Steps from picture to picture of so many usual ones count as usual: a file's times are whole ms. Chosen by hand.
const USUAL: (f64, f64) = (0.85, 1.15);
/// Share of usual steps from which on a longer one is a gap, and not one of a rate that varies. Chosen by hand.
const MOST_USUAL: f64 = 0.8;

/// The times of a video's pictures.
#[derive(Debug, Clone, Copy)]
struct Times {
    /// The same time from picture to picture, ms; `None` where it varies.
    period_ms: Option<f64>,
    /// OpenCV's time of the first picture, ms.
    base_ms: f64,
    /// Time of the last picture from the first, ms.
    last_ms: f64,
    /// Time from the last picture but one to the last, ms.
    step_ms: f64,
    /// Pictures so far, those that are missing too.
    count: u64,
    /// What the file calls the usual time from picture to picture, ms; it may be a mean.
    usual_ms: Option<f64>,
    /// Number of steps of that time, and of those, for each that lasted longer, that would have fitted in between.
    usual_steps: u64,
    left_out: u64,
}

impl Times {
    /// Takes the time of the next picture. Returns how many pictures are missing before it.
    fn add(&mut self, stamp_ms: f64) -> u64 {
        if self.count == 0 {
            (self.base_ms, self.count) = (stamp_ms, 1);
            return 0;
        }
        let at_ms = stamp_ms - self.base_ms;
        // OpenCV has no times for the last pictures of a stream that are decoded late.
        let usual_ms = if self.step_ms > 0.0 && self.step_ms < GAP_PERIODS * self.mean_ms() { self.step_ms } else { self.mean_ms() };
        let at_ms = if at_ms > self.last_ms && at_ms.is_finite() { at_ms } else { self.last_ms + usual_ms };
        let periods = self.period_ms.map_or(1.0, |period| (at_ms - self.last_ms) / period);
        let missing = if periods > GAP_PERIODS { periods.round() as u64 - 1 } else { 0 };
        if let Some(periods) = self.usual_ms.map(|usual_ms| (at_ms - self.last_ms) / usual_ms) {
            self.usual_steps += u64::from((USUAL.0..USUAL.1).contains(&periods));
            self.left_out += if periods > GAP_PERIODS { periods.round() as u64 - 1 } else { 0 };
        }
        (self.step_ms, self.last_ms) = (at_ms - self.last_ms, at_ms);
        self.count += 1 + missing;
        missing
    }

    /// Number of pictures that are missing between others, as far as the steps tell it: most are of the usual time, and some of several times that.
    fn left_out(&self) -> u64 {
        let steps = self.count.saturating_sub(1);
        if self.usual_steps as f64 >= MOST_USUAL * steps as f64 { self.left_out } else { 0 }
    }

    /// The mean time from picture to picture, ms.
    fn mean_ms(&self) -> f64 {
        self.period_ms.unwrap_or(if self.count > 1 { self.last_ms / (self.count - 1) as f64 } else { 0.0 })
    }
}

/// A video file.
pub(super) struct Video {
    path: String,
    capture: VideoCapture,
    container: Container,
    turn: Turn,
    /// Number of pictures that the file has by its own word.
    promised: Option<u64>,
    /// Frames a second by the file's own word.
    rate_hz: f64,
    times: Times,
    decoded: u64,
    partial: bool,
    remark: Option<String>,
    picture: Mat,
    spare: Mat,
}

impl Video {
    /// Opens the video at `path`. With `partial`, what is missing is counted and is no error.
    pub(super) fn open(path: &str, partial: bool) -> Result<Self, SourceError> {
        let fail = |what: String| SourceError::File { path: path.into(), what };
        let container = Container::read(path.as_ref()).map_err(|e| fail(unreadable(&e)))?;
        let opened = VideoCapture::from_file(path, videoio::CAP_FFMPEG).map_err(|e| fail(format!("cannot be opened: {}", e.message)))?;
        let mut capture = opened;
        if !capture.is_opened()? {
            return Err(fail(match container.missing_bytes {
                Some(_) => "is truncated: its index is missing, so that nothing of it can be read; copy it again".into(),
                None => "is no video that OpenCV's FFmpeg can read, or it is truncated".into(),
            }));
        }
        let _ = capture.set(videoio::CAP_PROP_ORIENTATION_AUTO, 0.0)?;
        let degrees = capture.get(videoio::CAP_PROP_ORIENTATION_META)?;
        let turn = match container.turn {
            Some(turn) => turn,
            // OpenCV's versions differ in the direction, so that only a half turn is certain.
            None => Turn::of_degrees(degrees).filter(|_| degrees.rem_euclid(180.0) == 0.0),
        };
        let turn = turn.ok_or_else(|| {
            fail(
                "its metadata turn the pictures in a way that is not certain; turn them for good first, for example ffmpeg -i IN OUT"
                    .into(),
            )
        })?;
        let rate_hz = capture.get(videoio::CAP_PROP_FPS)?;
        let count = capture.get(videoio::CAP_PROP_FRAME_COUNT)?;
        let promised = (container.counts_frames && count >= 1.0).then_some(count as u64);
        let own_period = (rate_hz > 0.0).then(|| 1.0 / rate_hz).filter(|_| container.fixed_rate);
        let period_ms = container.period_s.or(own_period).map(|s| 1e3 * s);
        let usual_ms = container.usual_period_s.map(|s| 1e3 * s);
        let times = Times { period_ms, base_ms: 0.0, last_ms: 0.0, step_ms: 0.0, count: 0, usual_ms, usual_steps: 0, left_out: 0 };
        let (picture, spare) = (Mat::default(), Mat::default());
        let path = path.into();
        Ok(Self { path, capture, container, turn, promised, rate_hz, times, decoded: 0, partial, remark: None, picture, spare })
    }

    /// Frames a second by the file's own word; 0 or less if it does not say.
    pub(super) fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    /// The next picture, its number counted from 0, and its time from the first, ns; `None` after the last.
    pub(super) fn next(&mut self) -> Result<Option<(&Mat, u64, u64)>, SourceError> {
        loop {
            // OpenCV's decoder reports some damage in the middle of a file as an error, but the end of a file is not an error.
            if !self.capture.grab().unwrap_or(false) {
                return self.end().map(|()| None);
            }
            let read = self.capture.retrieve_def(&mut self.picture).unwrap_or(false) && !self.picture.empty();
            let missing = self.times.add(self.capture.get(videoio::CAP_PROP_POS_MSEC)?);
            let number = self.times.count;
            if (missing > 0 || !read) && !self.partial {
                let first = if missing > 0 { number - missing } else { number };
                let seconds = first.saturating_sub(1) as f64 * self.times.mean_ms() / 1e3;
                return Err(self.incomplete(format!("frame {first} (at {seconds:.2} s) cannot be decoded")));
            }
            if read {
                self.decoded += 1;
                self.turn.apply(&mut self.picture, &mut self.spare)?;
                return Ok(Some((&self.picture, number - 1, (self.times.last_ms * 1e6) as u64)));
            }
        }
    }

    fn incomplete(&self, what: String) -> SourceError {
        SourceError::Incomplete { path: self.path.clone(), what }
    }

    /// Judges the file after its last picture.
    fn end(&mut self) -> Result<(), SourceError> {
        if self.decoded == 0 {
            let what = "holds no frame that can be decoded; is it truncated?".into();
            return Err(SourceError::File { path: self.path.clone(), what });
        }
        let came = self.times.count;
        let short = self.promised.is_none_or(|promised| came < promised);
        let end_s = self.container.end_s.or_else(|| {
            let promised = self.promised.filter(|_| self.container.fixed_rate)?;
            Some(promised as f64 * self.times.mean_ms() / 1e3)
        });
        let seconds = (self.times.last_ms + self.times.mean_ms()) / 1e3;
        let early = end_s.is_some_and(|end| seconds + END_PERIODS * self.times.mean_ms() / 1e3 < end);
        let missing = came - self.decoded;
        // The count in an AVI's header may be one off. An MP4 may show fewer than it counts, by its edit list.
        let fewer = self.container.fixed_rate && self.promised.is_some_and(|promised| came + 1 < promised);
        let cut = self.container.missing_bytes.is_some();
        if short && (early || fewer || cut) {
            let of = self.promised.map_or(String::new(), |promised| format!(" of {promised}"));
            let why = if cut { "the file is truncated" } else { "what follows cannot be decoded, or is missing" };
            let what = format!("ends after frame {came}{of} ({seconds:.2} s): {why}");
            if !self.partial {
                return Err(self.incomplete(what));
            }
            self.remark = Some(format!("{}: {what}", self.path));
        } else if missing > 0 {
            self.remark = Some(format!("{}: {missing} of {came} frames cannot be decoded and are left out", self.path));
        } else if let Some(promised) = self.promised.filter(|promised| came < *promised) {
            self.remark = Some(format!(
                "{}: {came} of its {promised} frames are shown; the others are cut out by its edit list, or damaged",
                self.path
            ));
        } else if self.times.left_out() > 0 {
            // A camera may have dropped them; the times of the others are right.
            let left_out = self.times.left_out();
            self.remark = Some(format!("{}: {left_out} frames are missing between its {came}: never recorded, or damaged", self.path));
        } else if self.container.open_end {
            self.remark = Some(format!("{}: the file does not say its length, so whether its end is missing cannot be told", self.path));
        }
        Ok(())
    }

    /// What is missing, if something is; complete after the last picture.
    pub(super) fn remark(&self) -> Option<String> {
        self.remark.clone()
    }
}
