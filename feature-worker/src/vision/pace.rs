//! How pictures follow each other: how many of them stand for a time, and whether a pause lies between two of them.
//!
//! Pure; called on the extraction thread. Nothing is allocated and nothing fails.

/// The rate at which counts of pictures were chosen, pictures a second: that of the simulated camera.
const CHOSEN_HZ: f32 = 30.0;
/// A rate that differs from that by no more than this share is the same. Chosen by hand: a telephone's video at 30 Hz has 29.3 to 30.
const SAME_RATE: f32 = 0.1;
/// Intervals of which the median is the rate. Chosen by hand: lost and late pictures are fewer.
const INTERVALS: usize = 15;
/// After a pause of this many ns, what was seen before tells nothing of what is there now. Chosen by hand: the controller ends a pour whose eye said
/// nothing for as long (`controller.stale_feature_ms`).
const PAUSE_NS: u64 = 200_000_000;
/// But no pause is shorter than so many intervals. Chosen by hand: a slow camera that lost one picture has no pause.
const PAUSE_INTERVALS: f64 = 2.5;

/// Number and time of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PictureTime {
    /// The camera's frame number; it grows by one from picture to picture if none is lost.
    pub sequence: u64,
    /// When it was taken, CLOCK_MONOTONIC ns, or from the begin of a recording.
    pub captured_at_ns: u64,
}

/// How many pictures come in the time of one at 30 Hz.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) struct Pace(f32);

impl Pace {
    /// The pace for which counts of pictures were chosen.
    pub(crate) const CHOSEN: Self = Self(1.0);

    /// The pace of so many pictures a second.
    pub(crate) fn of(rate_hz: f32) -> Self {
        let pace = rate_hz / CHOSEN_HZ;
        if !pace.is_finite() || pace <= 0.0 || (pace - 1.0).abs() <= SAME_RATE { Self::CHOSEN } else { Self(pace) }
    }

    /// The number of pictures in the time of so many at 30 Hz, at least one.
    pub(crate) fn pictures(self, at_30_hz: u32) -> u32 {
        ((self.0 * at_30_hz as f32).round() as u32).max(1)
    }

    /// A number of pictures at 30 Hz that need not be whole.
    pub(crate) fn parts(self, at_30_hz: f32) -> f32 {
        self.0 * at_30_hz
    }

    /// The share by which something follows in a picture that follows by `share` at 30 Hz.
    pub(crate) fn follows(self, share: f32) -> f32 {
        if self == Self::CHOSEN { share } else { 1.0 - (1.0 - share).powf(1.0 / self.0) }
    }
}

/// What lies between a picture and the one before it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Between {
    /// The usual time, or that of a few pictures which were lost.
    Little,
    /// A pause of unknown length, or another camera.
    Pause,
}

/// Follows numbers and times of pictures.
pub(crate) struct Succession {
    last: Option<PictureTime>,
    /// The last intervals from picture to picture as a ring, ns, and how many there were.
    intervals_ns: [u64; INTERVALS],
    counted: usize,
    /// The usual interval, ns.
    interval_ns: u64,
    pace: Pace,
}

impl Succession {
    /// Before the first picture of a camera with so many pictures a second.
    pub(crate) fn new(rate_hz: f64) -> Self {
        let interval_ns = (1e9 / rate_hz.max(0.1)) as u64;
        Self { last: None, intervals_ns: [0; INTERVALS], counted: 0, interval_ns, pace: Pace::of(rate_hz as f32) }
    }

    /// The present pace.
    pub(crate) fn pace(&self) -> Pace {
        self.pace
    }

    /// Number and time of a picture that follows the last one without a gap.
    pub(crate) fn next(&self) -> PictureTime {
        let first = PictureTime { sequence: 0, captured_at_ns: 0 };
        self.last.map_or(first, |last| PictureTime {
            sequence: last.sequence + 1,
            captured_at_ns: last.captured_at_ns.saturating_add(self.interval_ns),
        })
    }

    /// Takes the next picture's number and time. A number or a time that is not later is another camera's, or that of one that was started again.
    pub(crate) fn take(&mut self, now: PictureTime) -> Between {
        let Some(last) = self.last.replace(now) else { return Between::Little };
        if now.sequence <= last.sequence || now.captured_at_ns <= last.captured_at_ns {
            return Between::Pause;
        }
        let (pictures, passed_ns) = (now.sequence - last.sequence, now.captured_at_ns - last.captured_at_ns);
        let pause_ns = PAUSE_NS.max((PAUSE_INTERVALS * self.interval_ns as f64) as u64);
        self.count(passed_ns / pictures);
        if passed_ns > pause_ns { Between::Pause } else { Between::Little }
    }

    /// Takes note of an interval. The rate is another one when the median of the last ones says so.
    fn count(&mut self, interval_ns: u64) {
        self.intervals_ns[self.counted % INTERVALS] = interval_ns;
        self.counted += 1;
        if !self.counted.is_multiple_of(INTERVALS) {
            return;
        }
        let mut sorted = self.intervals_ns;
        sorted.sort_unstable();
        let median_ns = sorted[INTERVALS / 2].max(1);
        if (median_ns as f32 / self.interval_ns as f32 - 1.0).abs() > SAME_RATE {
            self.interval_ns = median_ns;
            self.pace = Pace::of((1e9 / median_ns as f64) as f32);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Takes pictures at these times, ms, and returns what lay before the last of them.
    fn take(succession: &mut Succession, pictures: impl IntoIterator<Item = (u64, f64)>) -> Between {
        let time = |(sequence, at_ms): (u64, f64)| PictureTime { sequence, captured_at_ns: (at_ms * 1e6) as u64 };
        pictures.into_iter().map(|picture| succession.take(time(picture))).last().unwrap_or(Between::Little)
    }

    /// Protects measurements at 30 Hz from a change of any count by late and lost pictures, and counts at another rate from standing for another
    /// time: they follow the intervals, whatever is configured.
    #[test]
    fn counts_follow_the_rate() {
        for (rate_hz, ninety) in [(15.0, 45), (25.0, 75), (29.97, 90), (30.0, 90), (60.0, 180)] {
            for configured_hz in [rate_hz, 30.0] {
                let mut succession = Succession::new(configured_hz);
                let late_ms = |i: u64| if i.is_multiple_of(5) { 9.0 } else { 0.0 };
                let kept = (1..60u64).filter(|i| i % 11 != 0);
                take(&mut succession, kept.map(|i| (i, 1000.0 + i as f64 * 1000.0 / rate_hz + late_ms(i))));
                assert_eq!(succession.pace().pictures(90), ninety, "{rate_hz} Hz, configured {configured_hz}");
            }
        }
        assert_eq!((Pace::CHOSEN.pictures(9), Pace::CHOSEN.parts(1.5), Pace::CHOSEN.follows(0.02)), (9, 1.5, 0.02));
        assert_eq!(Pace::of(1.0).pictures(5), 1);
    }

    /// Protects the eye's memories from vouching across a pause, and pours from a few lost pictures: only a pause, a camera that starts again and one
    /// that was opened anew are named.
    #[test]
    fn pauses_are_named() {
        let start = || {
            let mut succession = Succession::new(30.0);
            take(&mut succession, (1..10u64).map(|i| (i, i as f64 * 33.3)));
            succession
        };
        assert_eq!(take(&mut start(), [(10, 333.0)]), Between::Little);
        assert_eq!(take(&mut start(), [(12, 400.0)]), Between::Little);
        assert_eq!(take(&mut start(), [(10, 600.0)]), Between::Pause);
        assert_eq!(take(&mut start(), [(1, 333.0)]), Between::Pause);
        assert_eq!(take(&mut start(), [(10, 200.0)]), Between::Pause);
        let mut slow = Succession::new(5.0);
        assert_eq!(take(&mut slow, [(1, 200.0), (2, 400.0), (3, 690.0)]), Between::Little);
        assert_eq!(slow.next(), PictureTime { sequence: 4, captured_at_ns: 890_000_000 });
    }
}
