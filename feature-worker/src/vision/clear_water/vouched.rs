//! Whether the remembered ground was seen to be dry. What the first picture shows at the lip is remembered as ground, a stream that flows already
//! with it, so nothing is called dry before there is evidence: an even picture has no edge across the rays, a background that moves takes its
//! own edges along and leaves the stream's behind, and a stream before a background at rest ripples.
//!
//! Pure; called on the extraction thread. Nothing is allocated and nothing fails.

use super::evidence::Evidence;
use super::rays::{RAYS, Rays, SAMPLES};
use crate::vision::pace::Pace;

/// With an edge on this share of the rays, there may be a stream before an even ground. Chosen by hand: a line has to lie on as much of its length
/// to begin a stream.
const EDGES_MOST: f32 = 0.5;
/// A step of this size is an edge, in units of the noise. Chosen by hand: noise alone makes 1.
const EDGE_NOISES: f32 = 3.0;
/// Nearer to the lip than this, the rim's own light makes edges, px. Chosen by hand: no stream that is measured is smaller.
const EDGE_FROM_PX: f32 = 8.0;
/// So far the background has to move while nothing is seen, px: further than the dark rim of water is wide. Chosen by hand.
const MOVES_PX: f32 = 4.0;
/// But one picture tells of no more than this, px: a background that is lost jumps. Chosen by hand.
const MOVES_MOST_PX: f32 = 1.6;
/// Or so many pictures in a row have to show nothing new at the lip. Chosen by hand: half a second, in which a stream that ripples shows itself.
const PICTURES: u32 = 15;
/// An even picture counts for so many of them. Chosen by hand: three of them tell.
const EVEN_PICTURE: u32 = 5;

/// Remembers what was seen since the ground is new.
pub(super) struct Vouched {
    /// Whether the ground is known to be dry.
    dry: bool,
    /// Pictures in a row in which no stream was seen.
    pictures: u32,
    /// How far the background has moved in them, px.
    moved_px: f32,
    pace: Pace,
}

impl Vouched {
    /// Nothing was seen yet.
    pub(super) fn new() -> Self {
        Self { dry: false, pictures: 0, moved_px: 0.0, pace: Pace::CHOSEN }
    }

    /// Says how fast pictures follow each other.
    pub(super) fn set_pace(&mut self, pace: Pace) {
        self.pace = pace;
    }

    /// Says that what was seen before tells nothing of what is at the lip now.
    pub(super) fn doubt(&mut self) {
        *self = Self { pace: self.pace, ..Self::new() };
    }

    /// No stream was seen in a picture with this `evidence`. Returns whether there is none.
    pub(super) fn see_none(&mut self, evidence: &Evidence, rays: &Rays) -> bool {
        if !self.dry {
            self.pictures += if edges_share(evidence, rays) < EDGES_MOST { EVEN_PICTURE } else { 1 };
            self.dry = self.pictures >= self.pace.pictures(PICTURES) || self.moved_px >= MOVES_PX;
        }
        self.dry
    }

    /// Whether the ground is known to be dry.
    pub(super) fn is_dry(&self) -> bool {
        self.dry
    }

    /// A stream was seen in a picture, or it was not told whether there is one.
    pub(super) fn see_other(&mut self) {
        (self.pictures, self.moved_px) = (0, 0.0);
    }

    /// The background has moved by so much, px.
    pub(super) fn moved(&mut self, by_px: f32) {
        self.moved_px += by_px.min(MOVES_MOST_PX);
    }
}

/// On which share of the rays the picture itself has an edge, whatever is remembered: a stream before an even ground has one on most of them.
fn edges_share(evidence: &Evidence, rays: &Rays) -> f32 {
    let (steps, least) = (evidence.steps(), EDGE_NOISES * evidence.noise());
    let near = rays.first_from(EDGE_FROM_PX);
    let has_edge = |ray: usize| (ray * SAMPLES + near..(ray + 1) * SAMPLES).any(|i| rays.air[i] > 0.0 && steps[i] > least);
    (0..RAYS).filter(|ray| has_edge(*ray)).count() as f32 / RAYS as f32
}
