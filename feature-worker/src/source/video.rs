//! A video file, picture after picture, with the file's own times.
//!
//! For commands that read files and for the worker when it plays one; on their own thread. OpenCV's FFmpeg decodes into one matrix that is
//! reused. The pictures are turned as the file's metadata say, by our own code, because OpenCV 4.6 turns them the wrong way round. Pictures
//! that the file promises and that do not come, and gaps in a file of one rate, are an error that names the first of them, or they are counted; a gap that the
//! file's own index says was never recorded, and is said. Where the
//! container does not say how its pictures follow each other, it is decoded once for their times alone. What a decoder patches up
//! by itself (a damaged block in the middle of a picture) cannot be seen here.

use opencv::core::Mat;
use opencv::prelude::*;
use opencv::videoio::{self, VideoCapture};

use super::container::{Container, Turn};
use super::frame::SourceError;
use super::pictures::unreadable;
use super::rhythm::{GAP_PERIODS, Rhythm};

/// Periods that the end of the last picture may lie before the end of the video. Chosen by hand: rounding, and a sound track's padding.
const END_PERIODS: f64 = 2.5;
/// Pictures in a row that cannot be decoded and after which a file is over. Chosen by hand: half a minute, and a thousand looks beyond the end take a
/// moment.
const UNDECODED_MOST: u64 = 1000;

/// Takes the next picture that can be decoded, and returns how many tries failed before it; `None` at the end. OpenCV reports damage in the middle of a file
/// as it does the end, and goes on when it is asked again.
fn advance(capture: &mut VideoCapture) -> Option<u64> {
    (0..UNDECODED_MOST).find(|_| capture.grab().unwrap_or(false))
}

/// The times of a video's pictures.
#[derive(Debug, Clone, Copy)]
struct Times {
    /// The same time from picture to picture, ms; `None` where it varies or is not known.
    period_ms: Option<f64>,
    /// What it may be as long as no step was seen, ms.
    guess_ms: f64,
    /// OpenCV's time of the first picture, ms.
    base_ms: f64,
    /// Time of the last picture from the first, ms.
    last_ms: f64,
    /// Time from the last picture but one to the last, ms.
    step_ms: f64,
    /// Pictures so far, those that are missing too.
    count: u64,
}

impl Times {
    fn new(period_ms: Option<f64>, guess_ms: f64) -> Self {
        Self { period_ms, guess_ms, base_ms: 0.0, last_ms: 0.0, step_ms: 0.0, count: 0 }
    }

    /// Takes OpenCV's time of the next picture, `None` where it is made up, and how many could not be decoded before it. Returns how many pictures are
    /// missing before it.
    fn add(&mut self, stamp_ms: Option<f64>, undecoded: u64) -> u64 {
        if self.count == 0 {
            self.last_ms = undecoded as f64 * self.mean_ms();
            (self.base_ms, self.count) = (stamp_ms.unwrap_or(0.0) - self.last_ms, 1 + undecoded);
            return undecoded;
        }
        // OpenCV has no times for the last pictures of a stream that are decoded late.
        let usual_ms = if self.step_ms > 0.0 && self.step_ms < GAP_PERIODS * self.mean_ms() { self.step_ms } else { self.mean_ms() };
        let told_ms = stamp_ms.map(|stamp| stamp - self.base_ms).filter(|at| *at > self.last_ms && at.is_finite());
        let at_ms = told_ms.unwrap_or(self.last_ms + (1 + undecoded) as f64 * usual_ms);
        let periods = self.period_ms.map_or(1.0, |period| (at_ms - self.last_ms) / period);
        let by_time = if periods > GAP_PERIODS { periods.round() as u64 - 1 } else { 0 };
        // Not every try that fails is a picture, and where the times tell how many are missing, they are right.
        let missing = if self.period_ms.is_some() { by_time } else { undecoded };
        (self.step_ms, self.last_ms) = (at_ms - self.last_ms, at_ms);
        self.count += 1 + missing;
        missing
    }

    /// The mean time from picture to picture, ms.
    fn mean_ms(&self) -> f64 {
        let mean_ms = if self.count > 1 { self.last_ms / (self.count - 1) as f64 } else { 0.0 };
        self.period_ms.unwrap_or(if mean_ms > 0.0 { mean_ms } else { self.guess_ms })
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
    /// Frames a second by the file's own word; 0 if it has none.
    rate_hz: f64,
    /// How the pictures follow each other, where that was looked at.
    rhythm: Option<Rhythm>,
    times: Times,
    decoded: u64,
    /// Pictures that the file promises, up to the last one that came, and that did not.
    lost: u64,
    /// Pictures that the file's own index leaves out.
    unrecorded: u64,
    partial: bool,
    remark: Option<String>,
    picture: Mat,
    spare: Mat,
}

impl Video {
    /// Opens the video at `path`. A stream without times has `rate_hz` pictures a second. With `partial`, what is missing is counted and is no
    /// error.
    pub(super) fn open(path: &str, rate_hz: f64, partial: bool) -> Result<Self, SourceError> {
        let fail = |what: String| SourceError::File { path: path.into(), what };
        let container = Container::read(path.as_ref()).map_err(|e| fail(unreadable(&e)))?;
        let mut capture = opened(path, &container)?;
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
        let told_hz = Some(capture.get(videoio::CAP_PROP_FPS)?).filter(|hz| !container.raw && hz.is_finite() && *hz > 0.0);
        let count = capture.get(videoio::CAP_PROP_FRAME_COUNT)?;
        let promised = (container.counts_frames && count >= 1.0).then_some(count as u64);
        let guess_ms = 1e3 / told_hz.unwrap_or(rate_hz);
        let fixed_ms = (container.raw || container.fixed_rate).then_some(guess_ms);
        let rhythm = match container.rhythm {
            None if fixed_ms.is_none() => {
                let steps = steps(&mut capture, guess_ms)?;
                capture = opened(path, &container)?;
                Rhythm::of(&steps)
            }
            rhythm => rhythm,
        };
        let period_ms = fixed_ms.or(rhythm.and_then(|rhythm| rhythm.period_ms()));
        // FFmpeg guesses the rate of some containers, and their pictures' own times are no guess.
        let told_hz = period_ms.filter(|_| !container.raw).map(|ms| 1e3 / ms).or(told_hz);
        Ok(Self {
            path: path.into(),
            capture,
            container,
            turn,
            promised,
            rate_hz: told_hz.unwrap_or(0.0),
            rhythm,
            times: Times::new(period_ms, guess_ms),
            decoded: 0,
            lost: 0,
            unrecorded: 0,
            partial,
            remark: None,
            picture: Mat::default(),
            spare: Mat::default(),
        })
    }

    /// Frames a second by the file's own word; 0 or less if it does not say.
    pub(super) fn rate_hz(&self) -> f64 {
        self.rate_hz
    }

    /// The next picture, its number counted from 0, and its time from the first, ns; `None` after the last.
    pub(super) fn next(&mut self) -> Result<Option<(&Mat, u64, u64)>, SourceError> {
        loop {
            let Some(undecoded) = advance(&mut self.capture) else { return self.end().map(|()| None) };
            let read = self.capture.retrieve_def(&mut self.picture).unwrap_or(false) && !self.picture.empty();
            let stamp_ms = self.capture.get(videoio::CAP_PROP_POS_MSEC)?;
            let before = self.times;
            let missing = self.times.add((!self.container.raw).then_some(stamp_ms), undecoded);
            let number = self.times.count;
            let lost = self.promised_between(before).map_or(missing, |promised| missing.min(promised));
            self.lost += lost + u64::from(!read);
            self.unrecorded += missing - lost;
            if (lost > 0 || !read) && !self.partial {
                let first = if missing > 0 { number - missing } else { number };
                let seconds = first.saturating_sub(1) as f64 * self.times.mean_ms() / 1e3;
                return Err(self.incomplete(format!("frame {first} (at {seconds:.2} s) is missing, or cannot be decoded")));
            }
            if read {
                self.decoded += 1;
                self.turn.apply(&mut self.picture, &mut self.spare)?;
                return Ok(Some((&self.picture, number - 1, (self.times.last_ms * 1e6) as u64)));
            }
        }
    }

    /// How many pictures the index has between the last one and that of `before`; `None` where no index says it.
    fn promised_between(&self, before: Times) -> Option<u64> {
        let half_ms = self.times.period_ms? / 2.0;
        let index_ms = Some(&self.container.index_ms).filter(|index| !index.is_empty() && before.count > 0)?;
        let [from, to] = [before.last_ms + half_ms, self.times.last_ms - half_ms].map(|end| index_ms.partition_point(|at| *at < end));
        Some(to.saturating_sub(from) as u64)
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
        let (came, missing) = (self.times.count, self.lost);
        // An index counts no pictures that it leaves out.
        let found = came - self.unrecorded;
        let short = self.promised.is_none_or(|promised| found < promised);
        let end_s = self.container.end_s.or_else(|| {
            let promised = self.promised.filter(|_| self.container.fixed_rate)?;
            Some(promised as f64 * self.times.mean_ms() / 1e3)
        });
        let seconds = (self.times.last_ms + self.times.mean_ms()) / 1e3;
        let early = end_s.is_some_and(|end| seconds + END_PERIODS * self.times.mean_ms() / 1e3 < end);
        // The count in an AVI's header may be one off. An MP4 may show fewer than it counts, by its edit list.
        let fewer = self.container.fixed_rate && self.promised.is_some_and(|promised| found + 1 < promised);
        let cut = self.container.missing_bytes.is_some();
        let mut said = Vec::new();
        if missing > 0 {
            said.push(format!("{missing} of {came} frames are missing, or cannot be decoded, and are left out"));
        }
        if self.unrecorded > 0 {
            said.push(format!(
                "{} of {came} frames were never recorded, by the file's own index, and are gaps in the numbers",
                self.unrecorded
            ));
        }
        if cut || (short && (early || fewer)) {
            let of = self.promised.map_or(String::new(), |promised| format!(" of {}", promised + self.unrecorded));
            let why = if cut { "the file is truncated" } else { "what follows cannot be decoded, or is missing" };
            let what = format!("ends after frame {came}{of} ({seconds:.2} s): {why}");
            if short && !self.partial {
                return Err(self.incomplete(what));
            }
            said.push(what);
        } else if let Some(promised) = self.promised.filter(|promised| found < *promised) {
            said.push(format!("{found} of its {promised} frames are shown; the others are cut out by its edit list, or damaged"));
        }
        if let Some(Rhythm { steps, long, usual_ms, .. }) = self.rhythm.filter(|rhythm| !rhythm.fixed && rhythm.long > 0) {
            // A camera may have dropped them; the times of the others are right.
            said.push(format!(
                "its rate varies, and {long} of {steps} steps are longer than usual ({usual_ms:.0} ms), so whether frames are missing cannot be told"
            ));
        }
        if self.container.raw {
            let rate_hz = (1e7 / self.times.guess_ms).round() / 1e4;
            said.push(format!(
                "a stream without times of its own, taken at camera.fps = {rate_hz}; whether frames are missing cannot be told"
            ));
        } else if self.container.open_end && !cut {
            said.push("the file does not say its length, so whether its end is missing cannot be told".into());
        }
        self.remark = (!said.is_empty()).then(|| format!("{}: {}", self.path, said.join("; ")));
        Ok(())
    }

    /// What is missing, if something is; complete after the last picture.
    pub(super) fn remark(&self) -> Option<String> {
        self.remark.clone()
    }
}

/// OpenCV's reader of the video at `path`, which does not turn the pictures.
fn opened(path: &str, container: &Container) -> Result<VideoCapture, SourceError> {
    let fail = |what: String| SourceError::File { path: path.into(), what };
    let opened = VideoCapture::from_file(path, videoio::CAP_FFMPEG);
    let mut capture = opened.map_err(|e| fail(format!("cannot be opened: {}", e.message)))?;
    if !capture.is_opened()? {
        return Err(fail(match container.missing_bytes {
            Some(_) => "is truncated: its index is missing, so that nothing of it can be read; copy it again".into(),
            None => "is no video that OpenCV's FFmpeg can read, or it is truncated".into(),
        }));
    }
    let _ = capture.set(videoio::CAP_PROP_ORIENTATION_AUTO, 0.0)?;
    Ok(capture)
}

/// The steps from picture to picture of the whole file, one after the other, each as one step of so many ms.
fn steps(capture: &mut VideoCapture, guess_ms: f64) -> Result<Vec<(u64, f64)>, SourceError> {
    let mut times = Times::new(None, guess_ms);
    let mut steps = Vec::new();
    while let Some(undecoded) = advance(capture) {
        times.add(Some(capture.get(videoio::CAP_PROP_POS_MSEC)?), undecoded);
        steps.push((1, times.step_ms));
    }
    Ok(steps)
}
