//! Whether a picture has no colour at all: then a coloured liquid is not seen in it.
//!
//! Pure; called on the extraction thread. Nothing is allocated; the only failures are OpenCV's.

use opencv::core::{Mat, Vec3b};
use opencv::prelude::*;

/// A picture in which this share of the samples has no colour at all is a grey one. Chosen by hand: a sensor's noise alone makes colour.
const GREY_SHARE: f32 = 0.99;
/// A sample has no colour when its parts differ by no more than this, grey levels. Chosen by hand: a level or two of rounding.
const GREY_LEVELS: u8 = 2;
/// The largest hue, OpenCV's: a liquid of any hue has those from 0 to this one. One that has a hue is not seen in grey pictures, however pale it is.
pub(super) const ALL_HUES: f64 = 179.0;
/// A liquid of any hue with at least this saturation is not seen there either. Chosen by hand.
pub(super) const COLOURED_FROM: f64 = 20.0;
/// Of this many samples, one is looked at to find out whether a picture is grey. Chosen by hand, for speed.
const GREY_EVERY: usize = 5;

/// Whether these samples in BGR have no colour.
pub(super) fn is_grey(sampled: &Mat) -> opencv::Result<bool> {
    let pixels: &[Vec3b] = sampled.data_typed()?;
    let grey = |p: &&Vec3b| p[0].abs_diff(p[1]).max(p[1].abs_diff(p[2])).max(p[0].abs_diff(p[2])) <= GREY_LEVELS;
    let (looked, found) = (pixels.len().div_ceil(GREY_EVERY), pixels.iter().step_by(GREY_EVERY).filter(grey).count());
    Ok(found as f32 >= GREY_SHARE * looked as f32)
}
