//! Whether a picture has no colour at all: then a coloured liquid is not seen in it.
//!
//! Pure; called on the extraction thread. Nothing is allocated; the only failures are OpenCV's.

use opencv::core::{Mat, Vec3b};
use opencv::prelude::*;

/// A picture in which this share of the samples has no colour at all is a grey one. Chosen by hand: a sensor's noise alone makes colour.
const GREY_SHARE: f32 = 0.99;
/// A sample has no colour when its parts differ by no more than this, grey levels. Chosen by hand: a level or two of rounding.
const GREY_LEVELS: u8 = 2;
/// The largest hue, OpenCV's: a liquid of any hue has those from 0 to this one.
const ALL_HUES: f64 = 179.0;
/// A liquid of any hue with at least this saturation is not seen in grey pictures. Chosen by hand.
const COLOURED_FROM: f64 = 20.0;
/// Of this many samples, one is looked at to find out whether a picture is grey. Chosen by hand, for speed.
const GREY_EVERY: usize = 5;

/// Whether a liquid of this range of hue, saturation and value shows nothing in grey pictures: what has no colour has hue 0 and saturation 0 (OpenCV), so
/// one that has a hue is not seen there, however pale it is, unless its range holds these two.
pub(super) fn is_unseen_in_grey([h0, s0, _, h1, ..]: [f64; 6]) -> bool {
    let (any_hue, has_red) = (h0 == 0.0 && h1 == ALL_HUES, h0 == 0.0 || h0 > h1);
    s0 >= COLOURED_FROM || !(any_hue || has_red && s0 == 0.0)
}

/// Whether these samples in BGR have no colour.
pub(super) fn is_grey(sampled: &Mat) -> opencv::Result<bool> {
    let pixels: &[Vec3b] = sampled.data_typed()?;
    let grey = |p: &&Vec3b| p[0].abs_diff(p[1]).max(p[1].abs_diff(p[2])).max(p[0].abs_diff(p[2])) <= GREY_LEVELS;
    let (looked, found) = (pixels.len().div_ceil(GREY_EVERY), pixels.iter().step_by(GREY_EVERY).filter(grey).count());
    Ok(found as f32 >= GREY_SHARE * looked as f32)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects milk, and cream whose range was written by hand, before a camera without colour: they are seen there, and pale juice is not.
    #[test]
    fn what_has_no_colour_is_seen_in_grey() {
        let unseen = |h0, s0, h1| is_unseen_in_grey([h0, s0, 60.0, h1, 255.0, 255.0]);
        assert!(!unseen(0.0, 0.0, 179.0) && !unseen(0.0, 12.0, 179.0) && !unseen(0.0, 0.0, 30.0) && !unseen(170.0, 0.0, 10.0));
        assert!(unseen(5.0, 15.0, 25.0) && unseen(5.0, 0.0, 25.0) && unseen(0.0, 15.0, 30.0) && unseen(0.0, 20.0, 179.0));
    }
}
