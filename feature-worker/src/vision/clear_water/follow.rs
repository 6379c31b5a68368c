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

/// Two of a pixel's bytes, the blue and the red one or the other two, in the halves of 32 bits.
const HALVES: u32 = 0x00ff_00ff;

/// Two bytes at once between those of `a` and `b`, all in the halves of 32 bits; `w` of 256 is the share of `b`. What is halfway between two levels is rounded
/// up in even rows and down in `odd` ones: always up, a background at rest between two pixels would grow brighter and brighter.
#[inline(always)]
fn mix_two(a: u32, b: u32, w: u32, odd: u32) -> u32 {
    let half = 0x0080_0080 - odd * 0x0001_0001;
    let sum = (a & HALVES) * (256 - w) + (b & HALVES) * w + half;
    (sum >> 8) & HALVES
}

/// A pixel between `a` and `b`, as [`mix_two`] does.
#[inline(always)]
fn mix(a: u32, b: u32, w: u32, odd: u32) -> u32 {
    mix_two(a, b, w, odd) | (mix_two(a >> 8, b >> 8, w, odd) << 8)
}

/// A pixel's bytes, the first one lowest.
#[inline(always)]
pub(super) fn packed(pixel: &Vec4b) -> u32 {
    u32::from_le_bytes(pixel.0)
}

/// A small picture, four bytes a pixel.
pub(super) struct SmallPicture<'a> {
    /// Row by row without padding.
    pub(super) pixels: &'a [Vec4b],
    /// Pixels in a row.
    pub(super) width: usize,
}

impl SmallPicture<'_> {
    /// Bilinear samples at the first `count` places from `place` on, a `step` apart, four bytes each. Black outside.
    #[inline(always)]
    pub(super) fn along(&self, place: [f32; 2], step: [f32; 2], count: usize) -> [u32; RUN] {
        let fixed = |v: f32| (65536.0 * v) as i32;
        let ([x, y], [dx, dy]) = (place.map(fixed), step.map(fixed));
        let at = |i: usize| (x.wrapping_add(dx.wrapping_mul(i as i32)), y.wrapping_add(dy.wrapping_mul(i as i32)));
        // Loading is apart from mixing, for the vector registers.
        let [mut above, mut right, mut below, mut below_right] = [[0; RUN]; 4];
        let corners = above.iter_mut().zip(&mut right).zip(&mut below).zip(&mut below_right);
        for (i, (((above, right), below), below_right)) in corners.take(count).enumerate() {
            let (x, y) = at(i);
            let corner = (y >> 16) as usize * self.width + (x >> 16) as usize;
            let rows = (self.pixels.get(corner..corner + 2), self.pixels.get(corner + self.width..corner + self.width + 2));
            if let (Some([a, b]), Some([c, d])) = rows {
                (*above, *right, *below, *below_right) = (packed(a), packed(b), packed(c), packed(d));
            }
        }
        let mut samples = [0; RUN];
        for (i, sample) in samples.iter_mut().enumerate() {
            let (x, y) = at(i);
            let (wx, wy, odd) = (x as u32 >> 8 & 255, y as u32 >> 8 & 255, y as u32 >> 16 & 1);
            *sample = mix(mix(above[i], right[i], wx, odd), mix(below[i], below_right[i], wx, odd), wy, odd);
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
pub(super) fn follow(seen: &[u32; RUN], kept: &mut [Vec4b], ages: &mut [u8], f: Following) {
    // Whole runs of numbers of one kind are reckoned with, also where the run is shorter, for the vector registers.
    let (mut pixels, mut older) = ([0; RUN], [0; RUN]);
    pixels.iter_mut().zip(kept.iter()).for_each(|(pixel, kept)| *pixel = packed(kept));
    older.iter_mut().zip(ages.iter()).for_each(|(older, age)| *older = i32::from(*age) + 1);
    let outside = |[from, to]: [i32; 2], x: i32| i32::from(x < from) | i32::from(x >= to);
    let byte = |pixel: u32, k: u32| (pixel >> (8 * k) & 255) as i32;
    let flows = i32::from(f.flows);
    for (i, ((seen, pixel), older)) in seen.iter().zip(&mut pixels).zip(&mut older).enumerate() {
        let x = f.x + i as i32;
        let level = |k: u32| ((byte(*seen, k) * f.exposure + 128) >> 8).min(255);
        let was = [byte(*pixel, 0), byte(*pixel, 1), byte(*pixel, 2)];
        let away = [level(0) - was[0], level(1) - was[1], level(2) - was[2]];
        let fits = i32::from(away[0] * away[0] + away[1] * away[1] + away[2] * away[2] < f.calm);
        let known = i32::from(byte(*pixel, 3) > 0);
        let inside = outside(f.dry.right, x) | outside(f.dry.inner, x);
        let close = outside(f.dry.right, x) | outside(f.dry.outer, x);
        let hidden = close & ((1 - fits) | (flows & inside));
        let of_known = (1 - hidden) * (fits * FOLLOW + (1 - fits) * FOLLOW_SLOWLY);
        let of_new = (1 - (flows & close)) * 256;
        let share = known * of_known + (1 - known) * of_new;
        *older *= i32::from(share == 0);
        let stays = i32::from(share > 0) | (known & i32::from(*older < i32::from(FORGOTTEN)));
        let new = |k: usize| (stays * (was[k] + ((share * away[k] + 128) >> 8))) as u32 & 255;
        *pixel = new(0) | new(1) << 8 | new(2) << 16 | (255 * stays as u32) << 24;
        *older *= stays;
    }
    kept.iter_mut().zip(&pixels).for_each(|(kept, pixel)| kept.0 = pixel.to_le_bytes());
    ages.iter_mut().zip(&older).for_each(|(age, older)| *age = *older as u8);
}
