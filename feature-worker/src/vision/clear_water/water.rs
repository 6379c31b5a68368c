//! Whether there is water: when a stream begins, goes on and ends.
//!
//! Beginning a stream takes a larger score than going on on unknown ground, and ground that is known; on known ground a new line is
//! easier to tell from what was dry than one that has run for long. A line that moves with the background, or is at rest with it, is no
//! stream; nor is a line of the small picture that the full picture does not confirm.
//!
//! Called on the extraction thread. Nothing is allocated and nothing fails.

use super::rays::{Colour, each};
use crate::vision::liquid::FineLine;
use crate::vision::pace::Pace;
use shared::messages::Doubt;

// "Tuned" below means that the value was tuned on seeds 101 to 104 of `evaluate-camera`; see docs/VISION.md.

/// Least score of a line to begin a stream on ground of which nothing is known. Tuned.
const BEGIN_SCORE: f32 = 0.6;
/// On known ground the least score is lower by this. Tuned.
const BEGIN_KNOWN: f32 = 0.25;
/// Least share of a line's length with an edge to begin a stream. Tuned.
const BEGIN_EDGE: f32 = 0.5;
/// Least share of a line's length on known ground to begin a stream. Tuned.
pub(super) const BEGIN_GROUND: f32 = 0.35;
/// Least score of a line to go on, on unknown ground. Tuned.
const GO_ON_UNKNOWN: f32 = 0.45;
/// Least score of a line to go on, on known ground. Tuned.
const GO_ON_KNOWN: f32 = 0.5;
/// Least share of a line's length with an edge to go on. Tuned.
const GO_ON_EDGE: f32 = 0.6;
/// Above this share of known ground a low score means that it is dry. Tuned.
const SURELY_KNOWN: f32 = 0.5;
/// A line is background when the moved earlier picture leaves less of it unexplained than this, from -1 (nothing) to 1 (all). Tuned.
const EXPLAINED: f32 = -0.4;
/// A line goes on as a stream when the moved earlier picture leaves more of it unexplained than this, from -1 (nothing) to 1 (all). Tuned.
const UNEXPLAINED: f32 = 0.3;
/// The earlier picture tells something of a line when the background has moved by more than this across it, px. Tuned.
const TELLS_PX: f32 = 0.6;
/// A line goes on for being unexplained only with more evidence than this, and on known ground a lower score is surely no stream. Tuned.
const HELD: f32 = 0.25;
/// Background that has moved by less since the earlier picture is at rest, px: then what changes is a stream. Tuned.
const REST_PX: f32 = 0.2;
/// A stream in which nothing changes for more than this many frames, in front of a background at rest, is no stream. Tuned; that a steady
/// stream changes from frame to frame was shown in the renderer only.
const STILL_FRAMES: u32 = 12;
/// The earlier picture tells something of a line when it shows more than this share of it. Chosen by hand; no measurement is recorded.
const SHOWN_LEAST: f32 = 0.5;
/// When more than this share of the background far from the lip differs from the memory, it is another picture. Tuned.
const STRANGE: f32 = 0.3;
/// After more than this many frames of another picture, that picture becomes the background. Tuned.
const STRANGE_FRAMES: u32 = 15;
/// After more than this many pictures that were not looked at a stream is another one. Chosen by hand: a second, in which a pour ends by itself.
const LOST_FRAMES: u32 = 30;
/// For this many frames after a stream, the place where it was is not taken for background at once. Tuned.
const AFTERWARDS: u32 = 3;
/// How fast the colour of the band along the outline follows, a frame. Tuned.
const BAND_FOLLOWS: f32 = 0.5;
/// How fast the usual step follows, a frame. Tuned.
const STEP_FOLLOWS: f32 = 0.4;
/// How fast the usual height of the step in the full picture follows, a frame. Tuned.
const HEIGHT_FOLLOWS: f32 = 0.3;
/// The full picture's line is the same when the ratio of its legs differs by no more than this, as a logarithm. Tuned.
const SHAPE_MOST: f32 = 0.7;
/// The full picture's line is the same when the product of its legs differs by no more than this, as a logarithm. Tuned.
const SIZE_MOST: f32 = 1.0;
/// The full picture's line is the same when its step has at least this share of the usual height. Tuned.
const HEIGHT_LEAST: f32 = 0.3;
/// A smaller triangle is a bead that hangs at the lip, px^2 of the small picture. Tuned; a stream of 0.15 ml/s has 29.
const BEAD_PX2: f32 = 24.0;
/// Least confidence of the full picture's line to begin a stream. Tuned.
const BEGIN_CONFIDENCE: f32 = 0.25;
/// Least confidence of the full picture's line to go on. Tuned.
const GO_ON_CONFIDENCE: f32 = 0.1;
/// Mean grey level below which the least confidence is smaller, in proportion: in dim light all contrast is smaller. Tuned; a
/// well-lit picture of a dark wall is mistaken for a dim one.
const LIT_LEVEL: f32 = 130.0;
/// The least confidence is never smaller than this share of its usual value. Tuned.
const LIT_LEAST: f32 = 0.4;

/// The stream as it was last seen.
#[derive(Debug, Clone, Copy)]
pub(super) struct Stream {
    /// Cuts of its line with the x-axis and the y-axis, px of the small picture.
    pub(super) legs_px: [f32; 2],
    /// Frames for which it has been seen.
    pub(super) age: f32,
    /// Pictures in a row, up to now, in which it was not seen, or that were not looked at.
    pub(super) lost: u32,
    /// Height of the step along it in the full picture, grey levels.
    height: f32,
    /// Mean colour of the band along its outline, and last the mean step there, grey levels.
    pub(super) band: Colour,
}

/// A line with what was found along it.
#[derive(Debug, Clone, Copy, Default)]
pub(super) struct Candidate {
    /// Its number among the lines that are tried.
    pub(super) line: usize,
    /// The number by which lines are compared.
    pub(super) total: f32,
    /// What its samples say.
    pub(super) evidence: f32,
    /// The evidence, less what an uneven or changed band along the line costs.
    pub(super) score: f32,
    /// Share of its length with an edge.
    pub(super) edge_share: f32,
    /// Share of its length on known ground.
    pub(super) known: f32,
    /// Mean colour of the band along it, and last the mean step there, grey levels.
    pub(super) band: Colour,
}

/// What the moved earlier picture says of a line.
#[derive(Debug, Clone, Copy)]
pub(super) struct EarlierPicture {
    /// How far the background has moved there, px.
    pub(super) travels_px: f32,
    /// How far it has moved across the line, px.
    pub(super) crosses_px: f32,
    /// Share of the line that the earlier picture shows.
    pub(super) shown: f32,
    /// How little it explains, -1 (all) to 1 (nothing).
    pub(super) unexplained: f32,
}

impl EarlierPicture {
    /// Whether it can tell the line from background that moves.
    fn tells(&self) -> bool {
        self.crosses_px > TELLS_PX && self.shown > SHOWN_LEAST
    }

    /// Whether the background is at rest.
    fn rests(&self) -> bool {
        self.travels_px < REST_PX && self.shown > SHOWN_LEAST
    }

    /// Whether the earlier picture, moved, shows the line too.
    pub(super) fn shows_line(&self) -> bool {
        self.tells() && self.unexplained < EXPLAINED
    }

    /// Whether neither the background nor the line has changed.
    fn is_still(&self) -> bool {
        self.rests() && self.unexplained < EXPLAINED
    }

    /// Whether the line changes or stands still against the background, as only a stream does.
    fn shows_stream(&self) -> bool {
        (self.tells() || self.rests()) && self.unexplained > UNEXPLAINED
    }
}

/// Whether there is a stream in the small picture.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Verdict {
    /// There is none.
    Dry,
    /// It is not known.
    Unsure,
    /// There is one, along the best line.
    Stream,
}

/// What is known of the water from the frames so far.
pub(super) struct Water {
    /// The stream as it was last seen, if there is one.
    stream: Option<Stream>,
    /// Where the stream last was: cuts with the axes, px of the small picture.
    last_legs_px: [f32; 2],
    /// Frames in a row in which no stream was seen.
    dry_frames: u32,
    /// Frames in a row in which neither the background nor the best line moved.
    still_frames: u32,
    /// Frames in a row of another picture.
    strange_frames: u32,
    /// Lines in a row that the full picture did not confirm.
    refuted: u32,
    pace: Pace,
}

impl Water {
    /// Before the first frame.
    pub(super) fn new() -> Self {
        let (dry_frames, pace) = (u32::MAX, Pace::CHOSEN);
        Self { stream: None, last_legs_px: [0.0; 2], dry_frames, still_frames: 0, strange_frames: 0, refuted: 0, pace }
    }

    /// Says how fast pictures follow each other.
    pub(super) fn set_pace(&mut self, pace: Pace) {
        self.pace = pace;
    }

    /// Says that the next picture is not looked at. After too many of them a stream has to begin anew.
    pub(super) fn lose_picture(&mut self) {
        if let Some(stream) = &mut self.stream {
            stream.lost += 1;
            if stream.lost > self.pace.pictures(LOST_FRAMES) {
                self.interrupt();
            }
        }
    }

    /// Says that a pause lies before the next picture: a stream has to begin anew.
    pub(super) fn interrupt(&mut self) {
        (self.stream, self.still_frames, self.strange_frames) = (None, 0, 0);
    }

    /// The stream as it was last seen, if there is one.
    pub(super) fn stream(&self) -> Option<&Stream> {
        self.stream.as_ref()
    }

    /// Whether a stream flows or did so a frame ago.
    pub(super) fn flows(&self) -> bool {
        self.stream.is_some() || self.dry_frames <= 1
    }

    /// Where the stream was, while the place is not taken for background at once: cuts with the axes, px of the
    /// small picture.
    pub(super) fn recent_legs_px(&self) -> Option<[f32; 2]> {
        (self.dry_frames <= self.pace.pictures(AFTERWARDS)).then_some(self.last_legs_px)
    }

    /// Decides whether there is a stream. `best` is the best line, with its legs in px and what the earlier picture says of it;
    /// `strange_share` is the share of the background far from the lip that differs from the memory. While a stream is `held`, because its end was not
    /// seen, a line that stands still may be a stream as smooth as glass.
    #[inline(always)]
    pub(super) fn decide(&mut self, best: Option<(Candidate, [f32; 2], EarlierPicture)>, strange_share: f32, held: bool) -> Verdict {
        let mut verdict = Verdict::Dry;
        let mut surely_none = false;
        if let Some((found, legs_px, earlier)) = best {
            self.still_frames = if earlier.is_still() { self.still_frames + 1 } else { 0 };
            let background = match self.stream {
                // While a stream is seen, lines that move with the background were left out when the best one was chosen.
                Some(_) => self.still_frames > self.pace.pictures(STILL_FRAMES),
                // In front of a background at rest, no stream begins without a change.
                None => earlier.shows_line() || self.still_frames > 0,
            };
            surely_none = background || (found.known > SURELY_KNOWN && found.score < HELD);
            if self.stream.is_none() && strange_share > STRANGE {
                verdict = Verdict::Unsure;
            } else if self.is_enough(&found, &earlier) {
                if !background {
                    self.see(&found, legs_px);
                    verdict = Verdict::Stream;
                } else if held && self.stream.is_some() {
                    verdict = Verdict::Unsure;
                }
            }
        }
        if verdict == Verdict::Stream {
            self.dry_frames = 0;
            return verdict;
        }
        self.dry_frames = self.dry_frames.saturating_add(1);
        if let Some(stream) = &mut self.stream {
            stream.lost += 1;
        }
        if verdict == Verdict::Unsure {
            return verdict;
        }
        // One frame of grace: a stream that is lost once may be there again, and is not taken for background.
        if self.stream.is_some() && self.dry_frames == 1 && !surely_none {
            return Verdict::Unsure;
        }
        self.stream = None;
        verdict
    }

    /// Whether a line has enough evidence to begin a stream, or to go on with it.
    #[inline(always)]
    fn is_enough(&self, found: &Candidate, earlier: &EarlierPicture) -> bool {
        if self.stream.is_none() {
            return found.score > BEGIN_SCORE - BEGIN_KNOWN * found.known && found.edge_share > BEGIN_EDGE;
        }
        let least = GO_ON_UNKNOWN * (1.0 - found.known) + GO_ON_KNOWN * found.known;
        (earlier.shows_stream() && found.evidence > HELD) || (found.score > least && found.edge_share > GO_ON_EDGE)
    }

    /// Takes a line as the stream's.
    #[inline(always)]
    fn see(&mut self, found: &Candidate, legs_px: [f32; 2]) {
        let mix = |before: f32, now: f32, share: f32| before + share * (now - before);
        let follow = |k: usize| if k < 3 { BAND_FOLLOWS } else { STEP_FOLLOWS };
        let stream = match self.stream {
            Some(s) => Stream { legs_px, lost: 0, age: s.age + 1.0, band: each(|k| mix(s.band[k], found.band[k], follow(k))), ..s },
            None => Stream { legs_px, lost: 0, age: 1.0, band: found.band, height: 0.0 },
        };
        self.stream = Some(stream);
        self.last_legs_px = legs_px;
    }

    /// Counts frames of another picture. After too many of them true is returned: what stands there now is the background. A stream that is seen,
    /// or is `held` because its end was not seen, makes another picture itself and must not become the background, so nothing is counted then.
    #[inline(always)]
    pub(super) fn is_elsewhere(&mut self, strange_share: f32, held: bool) -> bool {
        let strange = strange_share > STRANGE && self.stream.is_none() && !held;
        self.strange_frames = if strange { self.strange_frames + 1 } else { 0 };
        let elsewhere = self.strange_frames > self.pace.pictures(STRANGE_FRAMES);
        if elsewhere {
            (self.strange_frames, self.dry_frames) = (0, u32::MAX);
        }
        elsewhere
    }

    /// Takes note of the full picture's line, whose legs are `scale` times as long as in the small picture; `sine` is that of the angle
    /// between the axes. What the memory of the background took for water must have its edge in the picture itself; where it has none, nobody knows.
    pub(super) fn confirm(&mut self, line: Option<FineLine>, mean_level: f32, scale: f32, sine: f32) -> Result<FineLine, Doubt> {
        let begins = self.stream.is_some_and(|s| s.age <= 1.0);
        let lit = (mean_level / LIT_LEVEL).clamp(LIT_LEAST, 1.0);
        let least = lit * if begins { BEGIN_CONFIDENCE } else { GO_ON_CONFIDENCE };
        let line = line.filter(|line| line.confidence >= least);
        let confirmed = self.is_same(line.as_ref(), scale, sine);
        line.filter(|_| confirmed).ok_or(Doubt::EdgeNotFound)
    }

    /// Whether the full picture's line is that of the stream that was seen: a stream does not lose its contrast, nor change its shape.
    fn is_same(&mut self, line: Option<&FineLine>, scale: f32, sine: f32) -> bool {
        let Some(stream) = &mut self.stream else { return false };
        let young = stream.age <= 1.0;
        let same = line.filter(|line| {
            let legs = line.legs_px.map(|v| v / scale);
            let [a, b] = [0, 1].map(|k| (legs[k] / stream.legs_px[k]).ln());
            0.5 * legs[0] * legs[1] * sine > BEAD_PX2
                && (a - b).abs() < SHAPE_MOST
                && (a + b).abs() < SIZE_MOST
                && (young || line.contrast > HEIGHT_LEAST * stream.height)
        });
        match same {
            Some(line) => {
                stream.legs_px = line.legs_px.map(|v| v / scale);
                stream.height = if young { line.contrast } else { stream.height + HEIGHT_FOLLOWS * (line.contrast - stream.height) };
                self.refuted = 0;
            }
            None => {
                self.refuted += 1;
                if young || self.refuted > 1 {
                    self.stream = None;
                    self.dry_frames = 1;
                }
            }
        }
        same.is_some()
    }
}
