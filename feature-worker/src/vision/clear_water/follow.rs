//! How a run of remembered pixels follows what is seen of them, in whole numbers and without branches, for the processor's vector
//! registers.
//!
//! Called on the extraction thread; nothing is allocated and nothing fails.

use opencv::core::Vec4b;

/// Number of pixels that are looked at together. Chosen by hand, for speed.
pub(super) const RUN: usize = 32;
/// What is hidden is forgotten when its row's turn has come this many times. Tuned on seeds 101 to 104 of `evaluate-camera`, see
/// docs/VISION.md.
const FORGOTTEN: u8 = 26;
/// How fast the memory follows where it fits what is seen, of 256. Tuned as [`FORGOTTEN`] was.
const FOLLOW: i32 = 90;
/// How fast the memory follows where it does not fit what is seen, of 256. Tuned as [`FORGOTTEN`] was.
const FOLLOW_SLOWLY: i32 = 26;

/// A pixel between `a` and `b`, four bytes at once in the low halves of 16 bits; `w` of 256 is the share of `b`. What is halfway between two levels is rounded
/// up in even rows and down in `odd` ones: always up, a background at rest between two pixels would grow brighter and brighter.
#[inline(always)]
fn mix(a: u64, b: u64, w: u64, odd: u64) -> u64 {
    let half = 0x0080_0080_0080_0080 - odd * 0x0001_0001_0001_0001;
    let sum = a.wrapping_mul(256 - w).wrapping_add(b.wrapping_mul(w)).wrapping_add(half);
    (sum >> 8) & 0x00ff_00ff_00ff_00ff
}

/// A pixel's bytes in the low halves of 16 bits.
#[inline(always)]
fn spread(pixel: [u8; 4]) -> u64 {
    let x = u64::from(u32::from_le_bytes(pixel));
    let x = (x | (x << 16)) & 0x0000_ffff_0000_ffff;
    (x | (x << 8)) & 0x00ff_00ff_00ff_00ff
}

/// A small picture, four bytes a pixel.
pub(super) struct SmallPicture<'a> {
    /// Row by row without padding.
    pub(super) pixels: &'a [Vec4b],
    /// Pixels in a row.
    pub(super) width: usize,
}

impl SmallPicture<'_> {
    /// Bilinear samples at the first `count` places from `place` on, a `step` apart, each as four bytes in the low halves of 16 bits.
    /// Black outside.
    #[inline(always)]
    pub(super) fn along(&self, place: [f32; 2], step: [f32; 2], count: usize) -> [u64; RUN] {
        let fixed = |v: f32| (65536.0 * v) as i32;
        let ([mut x, mut y], [dx, dy]) = (place.map(fixed), step.map(fixed));
        let mut samples = [0; RUN];
        for sample in &mut samples[..count] {
            let corner = (y >> 16) as usize * self.width + (x >> 16) as usize;
            let rows = (self.pixels.get(corner..corner + 2), self.pixels.get(corner + self.width..corner + self.width + 2));
            if let (Some(upper), Some(lower)) = rows {
                let (wx, wy, odd) = (u64::from(x as u32 >> 8 & 255), u64::from(y as u32 >> 8 & 255), u64::from(y as u32 >> 16 & 1));
                let top = mix(spread(upper[0].0), spread(upper[1].0), wx, odd);
                *sample = mix(top, mix(spread(lower[0].0), spread(lower[1].0), wx, odd), wy, odd);
            }
            (x, y) = (x + dx, y + dy);
        }
        samples
    }
}

/// The columns of a row of the memory, from the first to before the second, in which it is surely dry. All three hold every column when no
/// stream is seen, now or just before.
#[derive(Debug, Clone, Copy)]
pub(super) struct DrySpans {
    /// To the right of the container's left side.
    pub(super) right: [i32; 2],
    /// Beyond the inner line around the stream.
    pub(super) inner: [i32; 2],
    /// Beyond the outer line around the stream.
    pub(super) outer: [i32; 2],
}

/// How a run of the memory follows what is seen.
pub(super) struct Following {
    /// The run's first column.
    pub(super) x: i32,
    /// The columns of its row that are surely dry.
    pub(super) dry: DrySpans,
    /// Whether a stream is seen now.
    pub(super) flows: bool,
    /// What makes the picture as bright as the memory, of 256.
    pub(super) exposure: i32,
    /// Three times the square of a calm difference, grey levels squared.
    pub(super) calm: i32,
}

/// Takes new ground over, lets known ground follow, and lets what is hidden grow older until it is forgotten.
#[inline(always)]
pub(super) fn follow(seen: &[u64; RUN], kept: &mut [Vec4b], ages: &mut [u8], f: Following) {
    let outside = |[from, to]: [i32; 2], x: i32| i32::from(x < from) | i32::from(x >= to);
    let flows = i32::from(f.flows);
    for (i, ((sample, kept), age)) in seen.iter().zip(kept).zip(ages).enumerate() {
        let x = f.x + i as i32;
        let kept = &mut kept.0;
        let level = |k: u32| ((((sample >> (16 * k)) & 255) as i32 * f.exposure + 128) >> 8).min(255);
        let was = [0, 1, 2].map(|k| i32::from(kept[k]));
        let away = [level(0) - was[0], level(1) - was[1], level(2) - was[2]];
        let fits = i32::from(away[0] * away[0] + away[1] * away[1] + away[2] * away[2] < f.calm);
        let known = i32::from(kept[3] > 0);
        let inside = outside(f.dry.right, x) | outside(f.dry.inner, x);
        let close = outside(f.dry.right, x) | outside(f.dry.outer, x);
        let hidden = close & ((1 - fits) | (flows & inside));
        let of_known = (1 - hidden) * (fits * FOLLOW + (1 - fits) * FOLLOW_SLOWLY);
        let of_new = (1 - (flows & close)) * 256;
        let share = known * of_known + (1 - known) * of_new;
        let older = if share > 0 { 0 } else { i32::from(*age) + 1 };
        let stays = i32::from(share > 0) | (known & i32::from(older < i32::from(FORGOTTEN)));
        let new = |k: usize| (stays * (was[k] + ((share * away[k] + 128) >> 8))) as u8;
        *kept = [new(0), new(1), new(2), (255 * stays) as u8];
        *age = (stays * older) as u8;
    }
}
