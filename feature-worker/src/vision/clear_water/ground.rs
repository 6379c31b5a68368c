//! What is known of the remembered ground as a whole: whether it has a pattern, is too dark, and whether the memory lies where it belongs.
//!
//! A dim or worn pattern looks even in some pictures, so the last ones count together. And along boards the picture does not tell how far the ground has
//! moved: a memory that has slipped differs from the picture everywhere, which looks like noise, and then joints of boards pass for a stream's edge.
//!
//! Pure; called on the extraction thread. Nothing is allocated and nothing fails.

use crate::vision::pace::Pace;

/// How fast the share of pictures with an even ground grows and shrinks, a picture. Chosen by hand: dim boards look even in some pictures.
const EVEN_FOLLOWS: [f32; 2] = [0.02, 0.1];
/// The ground has a pattern below this share. Tuned on seed 101 of `evaluate-camera --faults`.
const EVEN_LEAST: f32 = 0.5;
/// And it is known to have one below this share, whatever the present picture looks like. Chosen by hand: boards that look even in some pictures while they
/// move had a share of 0 at rest, and grey pictures of walls one of 0.3.
const EVEN_NEVER: f32 = 0.1;
/// In the first pictures share and noise are their means. Chosen by hand: a third of a second.
const FIRST_PICTURES: f32 = 10.0;
/// How fast the usual noise shrinks and grows, a picture. Chosen by hand: a memory that slips for seconds must not become usual.
const NOISE_FOLLOWS: [f32; 2] = [0.1, 0.005];
/// So many times the usual noise is no noise: the memory does not lie where it belongs. Chosen by hand, on seeds 160281, 160283, 1001 and 1002: of the
/// pictures before a chess board with more than 1.8 times 26 of 41 areas were wrong, and before dim wood in warm light (160291) all.
const SLIPPED: f32 = 2.0;
/// After so many such pictures in a row the memory begins anew. Chosen by hand: a second.
const SLIPPED_PICTURES: u32 = 30;
/// Where the ground is darker than so many of the least differences that are water, none is told to be there. Chosen by hand: a rim that is black then
/// differs by twice of it.
const DARK_LEAST: f32 = 2.0;
/// And so it is for so many pictures more. Chosen by hand: a second, because a curtain has brighter and darker folds.
const DARK_PICTURES: u32 = 30;
/// A line before such a ground needs this confidence, because a fold of a dark curtain or a glint in the water has less. Chosen by hand: as much as a stream
/// needs to begin in good light.
pub(super) const DARK_CONFIDENCE: f32 = 0.25;

/// Remembers what the pictures told of the ground.
pub(super) struct Ground {
    /// In which share of the pictures that were compared with the ground, and in which no stream may still be, it was even, the last ones above all.
    even_share: f32,
    /// Pictures of which that is the share, the first ones.
    even_pictures: f32,
    /// The usual noise, grey levels.
    noise: f32,
    /// Pictures of which that is the noise, the first ones.
    noise_pictures: f32,
    /// Pictures in a row with far more than it.
    slipped: u32,
    /// For how many pictures more the ground is too dark.
    dark_for: u32,
    pace: Pace,
}

impl Ground {
    /// Nothing was seen yet.
    pub(super) fn new() -> Self {
        Self { even_share: 0.0, even_pictures: 0.0, noise: 0.0, noise_pictures: 0.0, slipped: 0, dark_for: 0, pace: Pace::CHOSEN }
    }

    /// Says how fast pictures follow each other.
    pub(super) fn set_pace(&mut self, pace: Pace) {
        self.pace = pace;
    }

    /// By how much a figure follows in the picture after so many. In the first ones it is their mean.
    fn follows(&self, usual: f32, pictures: f32) -> f32 {
        let usual = self.pace.follows(usual);
        if pictures <= self.pace.parts(FIRST_PICTURES) { usual.max(1.0 / pictures) } else { usual }
    }

    /// A picture in which no stream may be was compared with the ground, and looked even or not.
    pub(super) fn see(&mut self, even: bool) {
        self.even_pictures += 1.0;
        let follows = self.follows(EVEN_FOLLOWS[usize::from(!even)], self.even_pictures);
        self.even_share += follows * (f32::from(u8::from(even)) - self.even_share);
    }

    /// A picture differed from the memory by this noise, grey levels. Returns whether the memory has slipped for so long that it is worth nothing.
    pub(super) fn differs_by(&mut self, noise: f32) -> bool {
        if self.noise_pictures > 0.0 && noise > SLIPPED * self.noise {
            self.slipped += 1;
        } else {
            self.noise_pictures += 1.0;
            self.noise += self.follows(NOISE_FOLLOWS[usize::from(noise > self.noise)], self.noise_pictures) * (noise - self.noise);
            self.slipped = 0;
        }
        self.slipped > self.pace.pictures(SLIPPED_PICTURES)
    }

    /// The known ground has this mean level in a picture, 0 where none is known, and what differs from it by less than this is no water, grey levels.
    pub(super) fn see_light(&mut self, level: f32, least_difference: f32) {
        let dark = level > 0.0 && level < DARK_LEAST * least_difference;
        self.dark_for = if dark { self.pace.pictures(DARK_PICTURES) } else { self.dark_for.saturating_sub(1) };
    }

    /// Whether the ground is so dark that a rim without any light would hardly differ from it as much as water does.
    pub(super) fn is_too_dark(&self) -> bool {
        self.dark_for > 0
    }

    /// The memory is a new one.
    pub(super) fn forget(&mut self) {
        (self.noise, self.noise_pictures, self.slipped) = (0.0, 0.0, 0);
    }

    /// Whether the ground is not even, or not known to be.
    pub(super) fn is_pattern(&self) -> bool {
        self.even_share < EVEN_LEAST
    }

    /// Whether the ground is known not to be even, whatever a picture looks like.
    pub(super) fn is_known_pattern(&self) -> bool {
        self.even_share < EVEN_NEVER && self.even_pictures > self.pace.parts(FIRST_PICTURES)
    }

    /// Whether the memory does not lie where it belongs.
    pub(super) fn has_slipped(&self) -> bool {
        self.slipped > 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects pours before boards along which the memory slips: it is noticed, and after a second the memory begins anew.
    #[test]
    fn a_memory_that_slips_is_noticed() {
        let mut ground = Ground::new();
        for i in 0..40 {
            assert!(!ground.differs_by(if i % 2 == 0 { 1.1 } else { 1.6 }) && !ground.has_slipped(), "picture {i}");
        }
        let pictures = (0..100).take_while(|_| !ground.differs_by(3.0) && ground.has_slipped()).count();
        assert_eq!(pictures, SLIPPED_PICTURES as usize);
        ground.forget();
        assert!(!ground.has_slipped() && !ground.differs_by(3.0) && !ground.has_slipped());
    }

    /// Protects pours before a dark curtain: between two of its darkest folds it is too dark as well, where lines of folds were areas a tenth as large as
    /// the stream. Once it is lit, that ends within a second.
    #[test]
    fn a_curtain_is_dark_between_its_folds_too() {
        let mut ground = Ground::new();
        ground.see_light(0.0, 6.0);
        assert!(!ground.is_too_dark(), "none is known");
        for i in 0..60 {
            ground.see_light(if i % 20 == 0 { 11.0 } else { 14.0 }, 6.0);
            assert!(ground.is_too_dark(), "picture {i}");
        }
        (0..DARK_PICTURES).for_each(|_| ground.see_light(20.0, 6.0));
        assert!(!ground.is_too_dark());
    }

    /// Protects pours before dim boards: that they look even in some pictures while they move makes no wall of them.
    #[test]
    fn boards_that_look_even_at_times_are_a_pattern() {
        let mut ground = Ground::new();
        assert!(ground.is_pattern() && !ground.is_known_pattern());
        (0..30).for_each(|_| ground.see(false));
        for i in 0..40 {
            ground.see(i % 4 == 0);
            assert!(ground.is_known_pattern(), "picture {i}");
        }
        (0..60).for_each(|_| ground.see(true));
        assert!(!ground.is_pattern() && !ground.is_known_pattern());
    }
}
