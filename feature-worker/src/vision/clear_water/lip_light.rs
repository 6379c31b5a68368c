//! Whether a lamp's reflection hides the lip: white light there that the ground further out does not have. It stands still in the picture
//! as a stream does, so it would be taken for one.
//!
//! Called on the extraction thread. Nothing is allocated after the start. The only failures are OpenCV's.

use opencv::core::{Mat, Size, Vec4b};
use opencv::prelude::*;

use super::rays::{CELLS, Rays, SAMPLES};
use crate::vision::reflection::Reflection;

/// So near to the lip a stream begins, px. Chosen by hand: 12 px of a picture 640 px wide, as for coloured liquids.
const AT_LIP_PX: f32 = 6.0;
/// From here on there is ground, px. Chosen by hand: three deviations of a usual reflection.
const FAR_FROM_PX: f32 = 28.0;
/// Of this many places far out, one is looked at. Chosen by hand, for speed.
const FAR_EVERY: usize = 9;
/// A pixel all of whose parts reach this is white light, grey levels. Chosen by hand: a little below 255, because pixels are means.
const WHITE_LEVEL: u8 = 247;
/// Where more than this share of the ground is white, white light at the lip is the ground's. Chosen by hand.
const WHITE_GROUND: f32 = 0.15;

/// Looks for white light at the lip.
pub(super) struct LipLight {
    /// Pixels of the small picture at the lip, and far from it.
    at_lip: Vec<usize>,
    far: Vec<usize>,
    reflection: Reflection,
}

impl LipLight {
    /// For small pictures of `size`, px.
    pub(super) fn new(rays: &Rays, size: Size) -> Self {
        let inside = |[x, y]: [f32; 2]| x >= 0.0 && y >= 0.0 && x < size.width as f32 && y < size.height as f32;
        let pixels = |from_px: f32, to_px: f32, every: usize| -> Vec<usize> {
            let chosen = (0..CELLS).filter(|i| (from_px..to_px).contains(&rays.radii_px[i % SAMPLES]) && inside(rays.places[*i]));
            chosen.step_by(every).map(|i| rays.places[i][1] as usize * size.width as usize + rays.places[i][0] as usize).collect()
        };
        Self { at_lip: pixels(0.0, AT_LIP_PX, 1), far: pixels(FAR_FROM_PX, f32::MAX, FAR_EVERY), reflection: Reflection::default() }
    }

    /// Takes note of the next picture. Returns whether a reflection hides the lip.
    pub(super) fn is_hidden(&mut self, now: &Mat) -> opencv::Result<bool> {
        let pixels: &[Vec4b] = now.data_typed()?;
        let white = |places: &[usize]| {
            let found = places.iter().filter_map(|i| pixels.get(*i)).filter(|p| p[0].min(p[1]).min(p[2]) >= WHITE_LEVEL).count();
            found as f32 / places.len().max(1) as f32
        };
        let blind = if white(&self.far) > WHITE_GROUND { 0.0 } else { white(&self.at_lip) };
        Ok(self.reflection.hides_lip(blind, 0.0, false))
    }
}
