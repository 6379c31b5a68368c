//! Streams before an even ground whose rim is too faint, or has too many gaps, for a line: they are too much for dry ground.
//!
//! Pure; called on the extraction thread. Nothing is allocated and nothing fails.

use crate::vision::pace::Pace;

/// Before an even ground, a faint band of this height may be a stream's rim, in units of the noise, and after one a lower one. Chosen by hand: dry pictures before a wall show at most 1.3
/// on seed 101 of `evaluate-camera`, with and without `--faults`, and a rim that is 10 of 165 levels darker than the wall shows 1.7.
const FAINT_NOISES: [f32; 2] = [1.6, 1.3];
/// For so many pictures what may be a faint stream is not learned as ground. Chosen by hand: three seconds, after which no pour goes on.
const FAINT_PICTURES: u32 = 90;

/// Whether such a stream may flow.
pub(super) struct Faint {
    /// Pictures in a row that show a band.
    pictures: u32,
    may_flow: bool,
}

impl Faint {
    /// Nothing was seen yet.
    pub(super) fn new() -> Self {
        Self { pictures: 0, may_flow: false }
    }

    /// Says that the next picture is looked at.
    pub(super) fn next_picture(&mut self) {
        self.may_flow = false;
    }

    /// Whether a band of this height, in units of the noise, is too much for dry ground in a picture without a stream.
    pub(super) fn sees(&mut self, band: f32, pace: Pace) -> bool {
        let shows = band >= FAINT_NOISES[usize::from(self.pictures > 0)];
        self.pictures = if shows { self.pictures + 1 } else { 0 };
        self.may_flow = shows && self.pictures <= pace.pictures(FAINT_PICTURES);
        shows
    }

    /// Whether no ground is to be learned from the present picture where a stream may be. After a while it is, because a shadow looks the same.
    pub(super) fn may_flow(&self) -> bool {
        self.may_flow
    }
}
