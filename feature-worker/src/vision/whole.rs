//! Whether a picture is whole: decoded to its end, of one moment, and with the glass in its place.
//!
//! A picture that was not decoded to its end has rows of one colour. A torn one has rows that are those of a picture before, to the
//! byte, beside rows that are not: of the last one, or of an older one where the driver's buffer still held it. In one whose rows are shifted, the container's left side lies elsewhere, and it never moves in the
//! picture otherwise. Each of them is judged against the pictures before, so that a card without noise or a repeated picture is no reason
//! for a doubt.
//!
//! Called on the extraction thread; nothing is allocated after the start and nothing fails.

use super::geometry::Axes;
use super::pace::Pace;
use super::picture::RegionPixels;

/// Pixels of a row that are looked at. Chosen by hand, for speed.
const COLUMNS: usize = 16;
/// Most rows that are looked at. Chosen by hand, for speed.
const ROWS: usize = 300;
/// A row is of one colour when its levels differ by no more than this. Chosen by hand: a decoder's fill is exact, and a second
/// compression adds a level or two.
const ONE_COLOUR: u8 = 2;
/// A lossy compression moves the levels of an even card by no more than this. Chosen by hand, with the card of the test below. A row of one colour whose
/// pixels all lay so near to it before has lost its noise alone, and one whose pixels differ no more repeats by chance.
const COMPRESSED: u8 = 6;
/// This many rows that follow each other are a missing or foreign part: one row of the smallest JPEG blocks. Chosen by hand.
const PART_PX: usize = 8;
/// Rows of one colour that last longer than this many pictures belong to the scene. Chosen by hand: one second.
const SCENE_FRAMES: u32 = 30;
/// A picture reaches so far below the lip that its last rows show the glass, px. Chosen by hand.
const BELOW_LIP_PX: f32 = 20.0;
/// So many pictures are older than the last one, and may be what a buffer still held. Chosen by hand: drivers have four buffers, seldom more.
const OLDER: usize = 3;
/// Of the rows that do not repeat, this share has to be really new for the others to be old ones. Chosen by hand: all of them are where a
/// sensor's noise is left, and few in a compressed video of a still scene.
const NEW_ROWS: f32 = 0.8;

/// Lines along which the container's left side is read. Chosen by hand, for speed.
const SIDE_LINES: usize = 12;
/// The first of them lies this far from the lip, px: nearer, the bead covers the side. Chosen by hand.
const SIDE_FROM_PX: f32 = 12.0;
/// Distance of these lines, px. Chosen by hand.
const SIDE_STEP_PX: f32 = 3.5;
/// A side that is displaced is looked for up to this distance, px. Chosen by hand: blocks of compressed pictures are 8 to 32 px wide.
const SIDE_REACH: usize = 72;
/// The side's pattern reaches this far to either side of it, px. Chosen by hand.
const SIDE_HALF: usize = 8;
/// Samples of a line.
const SIDE_SAMPLES: usize = 2 * (SIDE_REACH + SIDE_HALF) + 2;
/// Samples of the pattern.
const PATTERN: usize = 2 * SIDE_HALF + 1;
/// The side is in its place when its pattern agrees with the remembered one by this much, -1 to 1. Chosen by hand.
const IN_PLACE: f32 = 0.3;
/// The side is elsewhere when it agrees there by this much. Chosen by hand.
const ELSEWHERE: f32 = 0.85;
/// The side is elsewhere when it agrees there by so much more than in its place. Chosen by hand.
const SURELY: f32 = 0.45;
/// A displacement by less than this may be a side that changed its look, px. Chosen by hand.
const DISPLACED_PX: usize = 5;
/// The side's pattern is known when it agreed with itself by this much on average. Chosen by hand: a pattern behind it moves.
const KNOWN_SIDE: f32 = 0.6;
/// And when it was seen in so many pictures. Chosen by hand.
const SIDE_PICTURES: u32 = 20;
/// How fast pattern and agreement follow, a picture. Chosen by hand.
const SIDE_FOLLOWS: f32 = 0.15;

/// The pixels of a row that are looked at, each part by itself: blue, green, red.
type RowPixels = [[u8; COLUMNS]; 3];

/// Least and largest level of a row, each part by itself.
#[derive(Clone, Copy)]
struct Levels {
    low: [u8; 3],
    high: [u8; 3],
}

/// What one row shows.
#[derive(Clone, Copy)]
struct RowLook {
    levels: Levels,
    one_colour: bool,
    /// Whether all its pixels are those of the same row in a picture before, to the byte.
    old: bool,
    /// Whether most of its pixels are not those of the last picture.
    new: bool,
}

/// Checks whether pictures of one camera are whole.
pub(crate) struct WholeCheck {
    /// The columns that are looked at.
    columns: [usize; COLUMNS],
    /// Rows from one that is looked at to the next.
    row_step: usize,
    /// The last row shows the glass.
    reaches_glass: bool,
    /// The pixels of the picture before.
    before: Vec<RowPixels>,
    /// Hashes of the same rows in the pictures before that one, the newest first.
    older: Vec<[u64; OLDER]>,
    /// The rows' levels in the picture that was looked at last.
    levels: Vec<Levels>,
    /// The rows' levels in the last whole picture.
    levels_before: Vec<Levels>,
    /// Pictures in a row that were not whole.
    broken: u32,
    /// Pictures that were seen.
    seen: u32,
    side: SideCheck,
}

impl WholeCheck {
    /// For a region of `size_px`; `axes` are relative to it.
    pub(crate) fn new(axes: Axes, size_px: [i32; 2]) -> Self {
        let (width, height) = (size_px[0].max(1) as usize, size_px[1].max(1) as usize);
        let row_step = height.div_ceil(ROWS);
        Self {
            // Not evenly, so that no pattern falls between them.
            columns: std::array::from_fn(|i| ((i * 2 + 1) * width / (2 * COLUMNS) + (i * 7) % 5).min(width - 1)),
            row_step,
            reaches_glass: height as f32 - 1.0 >= axes.lip_px[1] + BELOW_LIP_PX,
            before: vec![[[0; COLUMNS]; 3]; height / row_step],
            older: vec![[0; OLDER]; height / row_step],
            levels: vec![Levels::ANY; height / row_step],
            levels_before: vec![Levels::ANY; height / row_step],
            broken: 0,
            seen: 0,
            side: SideCheck::new(axes),
        }
    }

    /// Takes note of the next picture. Returns whether it is whole.
    pub(crate) fn is_whole(&mut self, pixels: RegionPixels, pace: Pace) -> bool {
        let scene_frames = pace.pictures(SCENE_FRAMES);
        let first = self.seen == 0;
        self.seen = self.seen.saturating_add(1);
        let (mut plain_run, mut new_plain_run, mut old_run) = (0usize, 0usize, 0usize);
        let (mut most_new_plain, mut most_old) = (0usize, 0usize);
        let (mut rows_new, mut rows_other) = (0usize, 0usize);
        for i in 0..self.before.len() {
            let look = look_at(pixels.row(i * self.row_step), &self.columns, &mut self.before[i], &mut self.older[i]);
            self.levels[i] = look.levels;
            plain_run = if look.one_colour { plain_run + 1 } else { 0 };
            let newly = look.one_colour && !self.levels_before[i].could_become(look.levels);
            new_plain_run = if newly { new_plain_run + 1 } else { 0 };
            most_new_plain = most_new_plain.max(new_plain_run);
            let tells = look.levels.span() > COMPRESSED;
            old_run = if look.old && tells { old_run + 1 } else { 0 };
            most_old = most_old.max(old_run);
            if !look.old && tells {
                rows_other += 1;
                rows_new += usize::from(look.new);
            }
        }
        let part = PART_PX.div_ceil(self.row_step);
        let ends_early = self.reaches_glass && plain_run >= part;
        let missing = ends_early || (!first && most_new_plain >= part && self.broken <= scene_frames);
        let torn = !first && most_old >= part && rows_new > 0 && rows_new as f32 >= NEW_ROWS * rows_other as f32;
        let whole = !missing && !torn && !self.side.is_displaced(pixels);
        if whole || first || self.broken > scene_frames {
            self.levels_before.copy_from_slice(&self.levels);
        }
        self.broken = if whole { 0 } else { self.broken.saturating_add(1) };
        whole
    }
}

/// A number that tells rows from each other; never 0, which stands for none.
#[inline(always)]
fn hash_of(row: &RowPixels) -> u64 {
    let mix = |hash: u64, word: u64| (hash ^ word).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29);
    let words = row.as_flattened().as_chunks::<8>().0.iter().map(|bytes| u64::from_le_bytes(*bytes));
    words.fold(0xcbf2_9ce4_8422_2325, mix) | 1
}

/// Looks at a row, and takes it over into `before`, and what was there into `older`. All of its pixels are read before one is judged, so that the processor waits for the
/// picture's memory once and not for each pixel.
#[inline(always)]
fn look_at(row: &[u8], columns: &[usize; COLUMNS], before: &mut RowPixels, older: &mut [u64; OLDER]) -> RowLook {
    let mut now = *before;
    for (i, column) in columns.iter().enumerate() {
        if let Some(pixel) = row.get(3 * column..3 * column + 3) {
            (0..3).for_each(|k| now[k][i] = pixel[k]);
        }
    }
    let (mut equal, mut count) = (0u8, 0u8);
    for i in 0..COLUMNS {
        // Where the sensor is full or empty, every picture is the same.
        let tells = u8::from((now[0][i].wrapping_sub(3) < 250) | (now[1][i].wrapping_sub(3) < 250) | (now[2][i].wrapping_sub(3) < 250));
        count += tells;
        equal += tells & u8::from((now[0][i] == before[0][i]) & (now[1][i] == before[1][i]) & (now[2][i] == before[2][i]));
    }
    let held = older.contains(&hash_of(&now));
    older.rotate_right(1);
    older[0] = hash_of(before);
    *before = now;
    let (equal, count) = (usize::from(equal), usize::from(count));
    let old = count >= COLUMNS / 4 && (equal == count || held);
    let levels = Levels::of(before);
    RowLook { levels, one_colour: levels.are_one_colour(), old, new: !old && 2 * (count - equal) > count }
}

impl Levels {
    /// Those of a row that may show anything.
    const ANY: Self = Self { low: [0; 3], high: [255; 3] };

    #[inline(always)]
    fn of(pixels: &RowPixels) -> Self {
        Self {
            low: pixels.map(|part| part.iter().fold(255, |low: u8, v| low.min(*v))),
            high: pixels.map(|part| part.iter().fold(0, |high: u8, v| high.max(*v))),
        }
    }

    /// Whether the pixels have one colour.
    #[inline(always)]
    fn are_one_colour(self) -> bool {
        let Self { low, high } = self;
        // White may be a wall in bright light, and black the night.
        let saturated = low.iter().all(|v| *v >= 253) || high.iter().all(|v| *v <= 2);
        !saturated && self.span() <= ONE_COLOUR
    }

    /// How far the levels of one part lie apart, in that part in which it is most.
    #[inline(always)]
    fn span(self) -> u8 {
        (0..3).fold(0, |most, k| most.max(self.high[k].saturating_sub(self.low[k])))
    }

    /// Whether a row of these levels may come to have the one colour of `now` by itself: it had one colour, or lost its noise.
    #[inline(always)]
    fn could_become(self, now: Self) -> bool {
        self.are_one_colour()
            || (0..3)
                .all(|k| self.low[k].saturating_add(COMPRESSED) >= now.low[k] && now.high[k].saturating_add(COMPRESSED) >= self.high[k])
    }
}

/// Checks that the container's left side, below the lip, is where it was.
struct SideCheck {
    axes: Axes,
    /// The remembered pattern of steps across the side.
    pattern: [f32; PATTERN],
    /// How well it agreed with itself from picture to picture.
    agrees: f32,
    /// Pictures in which it was seen.
    seen: u32,
}

impl SideCheck {
    fn new(axes: Axes) -> Self {
        Self { axes, pattern: [0.0; PATTERN], agrees: 0.0, seen: 0 }
    }

    /// Whether the side is seen elsewhere, and not in its place.
    fn is_displaced(&mut self, pixels: RegionPixels) -> bool {
        let steps = self.steps(pixels);
        let at = |shift: usize| -> &[f32] { &steps[shift..shift + PATTERN] };
        let here = agreement(&self.pattern, at(SIDE_REACH));
        if self.seen >= SIDE_PICTURES && self.agrees >= KNOWN_SIDE && here < IN_PLACE {
            let elsewhere = (here + SURELY).max(ELSEWHERE);
            let far = |shift: &usize| shift.abs_diff(SIDE_REACH) >= DISPLACED_PX;
            if (0..=2 * SIDE_REACH).filter(far).any(|shift| agreement(&self.pattern, at(shift)) >= elsewhere) {
                return true;
            }
        }
        self.seen = self.seen.saturating_add(1);
        self.agrees += SIDE_FOLLOWS * (here - self.agrees);
        for (kept, now) in self.pattern.iter_mut().zip(&steps[SIDE_REACH..]) {
            *kept += SIDE_FOLLOWS * (now - *kept);
        }
        false
    }

    /// The mean steps of brightness across the side, from the outside to the inside, along rows of the picture.
    fn steps(&self, pixels: RegionPixels) -> [f32; SIDE_SAMPLES - 1] {
        let mut sums = [0u32; SIDE_SAMPLES];
        for line in 0..SIDE_LINES {
            let [x, y] = self.axes.at(-(SIDE_FROM_PX + SIDE_STEP_PX * line as f32), self.axes.y);
            let row = if y >= 0.0 { pixels.row(y as usize) } else { &[] };
            let (left, last) = (x as isize - (SIDE_REACH + SIDE_HALF) as isize, (row.len() / 3) as isize - 1);
            for (j, sum) in sums.iter_mut().enumerate() {
                // Beyond the region the last pixel is repeated, so that its border is no step.
                let at = 3 * (left + j as isize).clamp(0, last.max(0)) as usize;
                *sum += row.get(at..at + 3).map_or(0, |p| u32::from(p[0]) + u32::from(p[1]) + u32::from(p[2]));
            }
        }
        std::array::from_fn(|j| sums[j + 1] as f32 - sums[j] as f32)
    }
}

/// How well two patterns agree, -1 to 1.
#[inline(always)]
fn agreement(a: &[f32], b: &[f32]) -> f32 {
    let (mut ab, mut aa, mut bb) = (0.0f32, 0.0f32, 0.0f32);
    for (a, b) in a.iter().zip(b) {
        ab += a * b;
        aa += a * a;
        bb += b * b;
    }
    ab / (aa * bb).sqrt().max(1.0)
}

#[cfg(test)]
mod tests {
    use opencv::core::{self, CV_8UC3, Mat, Rect, Scalar, Vector};
    use opencv::imgcodecs;
    use opencv::prelude::*;
    use shared::messages::PixelFormat;

    use super::super::picture::{Image, RegionReader};
    use super::*;

    const SIZE_PX: [i32; 2] = [416, 272];

    /// An even card with light noise, as a lossy camera sends it.
    fn card(seed: i32) -> opencv::Result<Mat> {
        core::set_rng_seed(seed)?;
        let mut noise = Mat::new_rows_cols_with_default(SIZE_PX[1], SIZE_PX[0], CV_8UC3, Scalar::all(0.0))?;
        core::randn(&mut noise, &Scalar::new(140.0, 150.0, 163.0, 0.0), &Scalar::all(2.0))?;
        // The glass, which is always there.
        let mut inside = Mat::roi_mut(&mut noise, Rect::new(60, 236, SIZE_PX[0] - 60, SIZE_PX[1] - 236))?;
        let mut darker = Mat::default();
        inside.convert_to(&mut darker, -1, 0.8, 0.0)?;
        darker.copy_to(&mut inside)?;
        let mut bytes = Vector::new();
        imgcodecs::imencode(".jpg", &noise, &mut bytes, &Vector::from_slice(&[imgcodecs::IMWRITE_JPEG_QUALITY, 75]))?;
        imgcodecs::imdecode(&bytes, imgcodecs::IMREAD_COLOR)
    }

    /// Protects pictures of an even card from a camera that compresses: its rows lose and regain their noise, which is no missing part.
    /// A part that was not decoded is one still, in the first picture that has it and in the next.
    #[test]
    fn an_even_card_may_lose_its_noise() -> opencv::Result<()> {
        let axes = Axes { lip_px: [60.0, 236.0], x: [1.0, 0.0], y: [0.0, -1.0] };
        let mut check = WholeCheck::new(axes, SIZE_PX);
        let mut reader = RegionReader::new(Rect::new(0, 0, SIZE_PX[0], SIZE_PX[1]));
        for i in 0..90 {
            let mut picture = card(i)?;
            let is_cut = i >= 88;
            if is_cut {
                let row = 3 * SIZE_PX[0] as usize;
                picture.data_bytes_mut()?[100 * row..180 * row].fill(110);
            }
            let image = Image {
                width_px: SIZE_PX[0] as u32,
                height_px: SIZE_PX[1] as u32,
                format: PixelFormat::Bgr8,
                pixels: picture.data_bytes()?,
            };
            let pixels = reader.read(image, |_| Ok(()))?;
            assert_eq!(check.is_whole(pixels, Pace::CHOSEN), !is_cut, "picture {i}");
        }
        Ok(())
    }
}
