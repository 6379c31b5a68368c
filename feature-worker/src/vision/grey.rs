//! Whether a picture has no colour, or one and the same everywhere: then a coloured liquid is not seen in it.
//!
//! Pure; called on the extraction thread. Nothing is allocated; the only failures are OpenCV's.

use opencv::core::{Mat, Vec3b};
use opencv::prelude::*;

/// A picture in which this share of the samples has no colour at all is a grey one. Chosen by hand: a sensor's noise alone makes colour.
const GREY_SHARE: f32 = 0.99;
/// A sample has no colour when its parts differ from each other by no more than this, grey levels, and it has the picture's tint when they do once that tint
/// is taken off. Chosen by hand: a level or two of rounding.
const GREY_LEVELS: i16 = 2;
/// So many grey levels lie between the darkest and the brightest twentieth of a picture that has one tint everywhere because its camera gives no colour, and
/// not because there is nothing but a card in the light of one lamp. Chosen by hand.
const TINT_LEVELS: i16 = 30;
/// This share of the samples may be darker, and as many brighter, than the levels that are compared. Chosen by hand.
const TINT_SHARE: f32 = 0.05;
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

/// Whether these samples in BGR have no colour, or, bright and dark ones, all the same tint: a camera whose two parts of colour stand still, as one by
/// night, adds the same to all of them, and the light of a lamp adds less to dark ones.
pub(super) fn is_grey(sampled: &Mat) -> opencv::Result<bool> {
    let pixels: &[Vec3b] = sampled.data_typed()?;
    let looked = pixels.len().div_ceil(GREY_EVERY);
    let parts = || pixels.iter().step_by(GREY_EVERY).map(|p| [0, 1, 2].map(|n| i16::from(p[n])));
    let have = |[blue, red]: [i16; 2]| {
        let has = |[b, g, r]: &[i16; 3]| {
            let (b, r) = (b - g - blue, r - g - red);
            b.abs().max(r.abs()).max((b - r).abs()) <= GREY_LEVELS
        };
        parts().filter(has).count() as f32 >= GREY_SHARE * looked as f32
    };
    if have([0, 0]) {
        return Ok(true);
    }
    let (mut blue, mut red, mut level) = (Counts::new(), Counts::new(), Counts::new());
    for [b, g, r] in parts() {
        blue.add(b - g);
        red.add(r - g);
        level.add(g);
    }
    Ok(level.at(1.0 - TINT_SHARE) - level.at(TINT_SHARE) >= TINT_LEVELS && have([blue.at(0.5), red.at(0.5)]))
}

/// How many samples have each level or difference of levels.
struct Counts([u32; 511], u32);

impl Counts {
    fn new() -> Self {
        Self([0; 511], 0)
    }

    /// Counts `value`, from -255 to 255.
    fn add(&mut self, value: i16) {
        self.0[(value + 255).clamp(0, 510) as usize] += 1;
        self.1 += 1;
    }

    /// The value that the share `share` of what was counted does not reach.
    fn at(&self, share: f32) -> i16 {
        let mut left = (share * self.1 as f32) as i64;
        let found = self.0.iter().position(|&count| {
            left -= i64::from(count);
            left < 0
        });
        found.unwrap_or(510) as i16 - 255
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects a coloured stream from a camera that gives no colour: also where it tints all by the same, as by night. A card in warm light, bright and dark
    /// squares in it, and what has any colour are none such.
    #[test]
    fn one_tint_is_no_colour() {
        let grey = |samples: &[[i16; 3]]| {
            let bytes: Vec<Vec3b> = samples.iter().cycle().take(5000).map(|p| Vec3b::from(p.map(|part| part as u8))).collect();
            is_grey(&Mat::from_slice(&bytes).unwrap().clone_pointee()).unwrap()
        };
        let levels: Vec<i16> = (40..200).collect();
        let tinted = |[b, r]: [i16; 2]| levels.iter().map(|&v| [v + b, v, v + r]).collect::<Vec<_>>();
        assert!(grey(&tinted([0, 0])) && grey(&tinted([4, 0])) && grey(&tinted([-6, 6])) && grey(&tinted([1, -2])));
        let lit: Vec<_> = levels.iter().map(|&v| [v * 9 / 10, v, v * 11 / 10]).collect();
        assert!(!grey(&lit), "a lamp's light adds less to what is dark");
        let card: Vec<_> = (180..205).map(|v| [v - 12, v, v + 9]).collect();
        assert!(!grey(&card), "a card");
        let mut stream = tinted([4, 0]);
        stream.extend((0..20).map(|v| [40 + v, 60, 140]));
        assert!(!grey(&stream), "what has a colour");
    }

    /// Protects milk, and cream whose range was written by hand, before a camera without colour: they are seen there, and pale juice is not.
    #[test]
    fn what_has_no_colour_is_seen_in_grey() {
        let unseen = |h0, s0, h1| is_unseen_in_grey([h0, s0, 60.0, h1, 255.0, 255.0]);
        assert!(!unseen(0.0, 0.0, 179.0) && !unseen(0.0, 12.0, 179.0) && !unseen(0.0, 0.0, 30.0) && !unseen(170.0, 0.0, 10.0));
        assert!(unseen(5.0, 15.0, 25.0) && unseen(5.0, 0.0, 25.0) && unseen(0.0, 15.0, 30.0) && unseen(0.0, 20.0, 179.0));
    }
}
