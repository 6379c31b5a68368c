//! A lamp's reflection at the lip: it hides a small stream, until ground is seen there again.
//!
//! Called on the extraction thread. Nothing is allocated and nothing fails.

use super::pace::Pace;

/// A lamp's reflection hides the lip when this share of what is there is white light. Chosen by hand.
const BLIND_SHARE: f32 = 0.5;
/// Once it does, it still does while this share is white light, because a stream is darker. Chosen by hand.
const STILL_BLIND_SHARE: f32 = 0.08;
/// And so many pictures more with ground at the lip: a stream that covers the reflection is no ground. Chosen by hand: a third of a second.
const BLIND_PICTURES: u32 = 10;
/// What covers the lip for so many pictures without any white light is the ground. Chosen by hand: three seconds, after which a pour that
/// sees nothing has long ended.
const COVERED_PICTURES: u32 = 90;
/// The reflection is still there when this share of what is at the lip glows. Chosen by hand.
const GLOWS_SHARE: f32 = 0.15;

/// Remembers a reflection that hides the lip.
#[derive(Default)]
pub(super) struct Reflection {
    /// For how many pictures it still counts as hiding the lip.
    pictures: u32,
    /// Pictures in a row in which something else covers the lip.
    covered: u32,
}

impl Reflection {
    /// Takes note of the next picture without a stream. `blind` is the share of white light at the lip, `glows` that of its glow, and
    /// `foreign` says whether something lies there that is no ground. Returns whether the reflection hides the lip.
    pub(super) fn hides_lip(&mut self, blind: f32, glows: f32, foreign: bool, pace: Pace) -> bool {
        let still = self.pictures > 0 && blind > STILL_BLIND_SHARE;
        let covered = self.pictures > 0 && !still && (foreign || glows > GLOWS_SHARE);
        self.covered = if covered { self.covered + 1 } else { 0 };
        let held = still || (covered && self.covered < pace.pictures(COVERED_PICTURES));
        self.pictures = if blind > BLIND_SHARE || held { pace.pictures(BLIND_PICTURES) } else { self.pictures.saturating_sub(1) };
        self.pictures > 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects small streams under a reflection: dark liquid that covers it does not end the doubt, ground does, and so do some seconds.
    #[test]
    fn what_covers_a_reflection_does_not_end_it() {
        let mut reflection = Reflection::default();
        assert!(!reflection.hides_lip(0.1, 0.3, true, Pace::CHOSEN));
        assert!(reflection.hides_lip(0.9, 1.0, false, Pace::CHOSEN));
        assert!((0..40).all(|_| reflection.hides_lip(0.0, 0.0, true, Pace::CHOSEN)), "covered");
        assert!((0..40).all(|_| reflection.hides_lip(0.0, 0.3, false, Pace::CHOSEN)), "it glows");
        assert!((0..20).any(|_| !reflection.hides_lip(0.0, 0.0, false, Pace::CHOSEN)), "ground");
        assert!(reflection.hides_lip(0.9, 1.0, false, Pace::CHOSEN));
        assert!((0..120).any(|_| !reflection.hides_lip(0.0, 0.0, true, Pace::CHOSEN)), "some seconds");
    }
}
