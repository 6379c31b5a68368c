//! The dry background before clear water, remembered as one picture that is fixed in the world, and how it lies in the camera's picture.
//!
//! The container turns, so the background moves in the picture as one rigid piece (shift, turn, exposure). The motion follows from a few
//! hundred dry points of the memory, the steepest of each square: Gauss-Newton with robust weights, at half the size and then at the
//! full one. What is dry is then taken over into the memory, which is never resampled: it is a window on the world that wraps around,
//! and is moved on by whole squares as the camera moves.
//!
//! Runs on the extraction thread; all pictures and tables are kept, nothing is allocated after the second frame. No failures but
//! OpenCV's.

use opencv::core::{self, CV_8UC4, Mat, Scalar, Size, Vec4b};
use opencv::imgproc;
use opencv::prelude::*;

use crate::extract::between;

/// Points for the motion: one, the one with the steepest slope, in each square of this many px.
const SQUARE: usize = 10;
/// Room in the memory around the region, squares.
const ROOM_SQUARES: usize = 3;
/// Of the memory every so many rows, and of its squares every so many rows, are looked at in a frame.
const REFRESH: usize = 4;
const MARK_EVERY: usize = 4;
/// Fewer points tell no motion.
const POINTS_LEAST: usize = 30;
/// The motion is looked for from rest too when it leaves this much more unexplained than the last one did.
const LEFT_GROWS: f32 = 1.2;
/// What is hidden is forgotten when its row's turn has come this often.
const FORGOTTEN: u8 = 26;
/// Points for the motion have been seen within so many turns.
const MARK_AGE: u8 = 4;
/// Least change over 2 px at such a point, in units of a calm difference.
const STEEP_LEAST: f32 = 0.6;
/// With fewer steep points the background is an even wall, and these are drops or the stream: they do not tell its motion.
const STEEP_MARKS: usize = 24;
/// How fast the memory follows what is seen, of 256: where it fits and where it does not.
const FOLLOW: i32 = 90;
const FOLLOW_SLOWLY: i32 = 26;

/// Blue, green, red, and how known it is: 255 or 0, and then the colours are 0 too.
pub type Pixel = [u8; 4];

/// The median, upper one of two; reorders.
pub fn median(values: &mut [f32]) -> f32 {
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f32::total_cmp).1 }
}

/// Between `a` and `b`, four bytes at once in the low halves of 16 bits; `w` of 256 is the share of `b`.
#[inline(always)]
fn mix(a: u64, b: u64, w: u64) -> u64 {
    let sum = a.wrapping_mul(256 - w).wrapping_add(b.wrapping_mul(w)).wrapping_add(0x0080_0080_0080_0080);
    (sum >> 8) & 0x00ff_00ff_00ff_00ff
}

/// A pixel's bytes in the low halves of 16 bits.
#[inline(always)]
fn spread(pixel: Pixel) -> u64 {
    let x = u64::from(u32::from_le_bytes(pixel));
    let x = (x | (x << 16)) & 0x0000_ffff_0000_ffff;
    (x | (x << 8)) & 0x00ff_00ff_00ff_00ff
}

/// Pixels of a row of the memory that are looked at together.
const RUN: usize = 32;

/// A small picture in colour.
struct Picture<'a> {
    pixels: &'a [Vec4b],
    width: usize,
}

impl Picture<'_> {
    /// Bilinear samples at the first `count` places from `place` on, a `step` apart; black outside.
    #[inline(always)]
    fn along(&self, place: [f32; 2], step: [f32; 2], count: usize) -> [u64; RUN] {
        let fixed = |v: f32| (65536.0 * v) as i32;
        let ([mut x, mut y], [dx, dy]) = (place.map(fixed), step.map(fixed));
        let mut samples = [0; RUN];
        for sample in &mut samples[..count] {
            let corner = (y >> 16) as usize * self.width + (x >> 16) as usize;
            let rows = (self.pixels.get(corner..corner + 2), self.pixels.get(corner + self.width..corner + self.width + 2));
            if let (Some(upper), Some(lower)) = rows {
                let (wx, wy) = (u64::from(x as u32 >> 8 & 255), u64::from(y as u32 >> 8 & 255));
                let top = mix(spread(upper[0].0), spread(upper[1].0), wx);
                *sample = mix(top, mix(spread(lower[0].0), spread(lower[1].0), wx), wy);
            }
            (x, y) = (x + dx, y + dy);
        }
        samples
    }
}

/// How a run of the memory follows what is seen.
struct Following {
    /// The run's first column, and from where to where it is dry: to the right of the left side, beyond the inner line, beyond the outer.
    x: i32,
    dry_spans: [[i32; 2]; 3],
    flows: bool,
    /// Of 256.
    exposure: i32,
    /// Three times the square of a calm difference.
    calm: i32,
}

/// New ground is taken over, known ground follows, and what is hidden grows older until it is forgotten. Without branches, for the
/// processor's vector registers.
#[inline(always)]
fn follow(seen: &[u64; RUN], kept: &mut [Vec4b], ages: &mut [u8], f: Following) {
    let [right, inner, outer] = f.dry_spans;
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
        let inside = outside(right, x) | outside(inner, x);
        let close = outside(right, x) | outside(outer, x);
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

/// A rigid map.
#[derive(Debug, Clone, Copy)]
pub struct Turn {
    cos: f32,
    sin: f32,
    shift: [f32; 2],
}

impl Turn {
    /// Turns about `middle`, then shifts.
    fn new(turn: f32, shift: [f32; 2], middle: [f32; 2]) -> Self {
        let (sin, cos) = turn.sin_cos();
        let [x, y] = middle;
        Self { cos, sin, shift: [x - cos * x + sin * y + shift[0], y - sin * x - cos * y + shift[1]] }
    }

    #[inline(always)]
    fn along(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        [self.cos * x - self.sin * y, self.sin * x + self.cos * y]
    }

    /// Where a place comes to lie.
    #[inline(always)]
    pub fn forth(&self, at: [f32; 2]) -> [f32; 2] {
        let [x, y] = self.along(at);
        [x + self.shift[0], y + self.shift[1]]
    }

    #[inline(always)]
    fn back(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let (x, y) = (x - self.shift[0], y - self.shift[1]);
        [self.cos * x + self.sin * y, -self.sin * x + self.cos * y]
    }

    /// The way back.
    pub fn inverse(&self) -> Self {
        let [x, y] = self.back([0.0, 0.0]);
        Self { cos: self.cos, sin: -self.sin, shift: [x, y] }
    }

    /// This one after `first`.
    fn after(&self, first: &Turn) -> Self {
        let (cos, sin) = (self.cos * first.cos - self.sin * first.sin, self.sin * first.cos + self.cos * first.sin);
        // Stays a turn over many frames.
        let length = cos.hypot(sin);
        Self { cos: cos / length, sin: sin / length, shift: self.forth(first.shift) }
    }
}

/// Motion of the background from frame to frame: shift in px, turn in radians about the picture's middle.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Motion {
    shift: [f32; 2],
    turn: f32,
}

/// A point of the memory for the motion: place, and level and slope (per px) at half the working size and at the working size.
#[derive(Debug, Clone, Copy)]
struct Mark {
    at: [f32; 2],
    levels: [f32; 2],
    slopes: [[f32; 2]; 2],
}

/// A linear function of a place in the picture: at the origin, per px to the right, per px down.
pub type Plane = [f32; 3];

/// Where water may be in the picture: each place is in the half-plane `value >= 1` of both (beyond the line, to the right of the left
/// side) or may be water.
#[derive(Debug, Clone, Copy)]
pub struct Wet {
    /// Share of the way from the lip to a line beyond which it is dry: 1 is on it.
    pub line: Plane,
    /// Distance to the right of the container's left side, px.
    pub right: Plane,
}

/// Which places may be taken over into the memory.
#[derive(Debug, Clone, Copy)]
pub struct Dry {
    /// Distance above the glass, px; from 0 on it is air.
    pub air: Plane,
    /// Whether a stream is seen now.
    pub flows: bool,
    /// With a stream now or just before: surely wet, and what is close to it.
    pub near: Option<(Wet, Plane)>,
    /// A difference up to this is still background, grey levels.
    pub calm: f32,
}

/// Remembers the dry background.
pub struct Ground {
    size: Size,
    /// The memory: a window on the world whose first row and column lie at `origin`, and which wraps around; at the
    /// first picture's exposure.
    side: usize,
    origin: [usize; 2],
    memory: Mat,
    /// For how many of its row's turns each pixel has not been seen.
    ages: Vec<u8>,
    /// Its points for the motion, by squares as they lie in the memory; and as they lay in the last picture.
    corners: Vec<Option<Mark>>,
    marks: Vec<Mark>,
    /// From the window to the picture, and exposure against the memory: now, and of the picture that is compared with; the last motion.
    pose: Turn,
    gain: f32,
    reference: Turn,
    reference_gain: f32,
    motion: Motion,
    frame: usize,
    /// Mean size of what the last motion left unexplained, grey levels.
    left: f32,
    grey: Mat,
    half: Mat,
    scratch: Vec<f32>,
}

/// Solves `matrix x = right` by elimination with pivots; zeros where it is singular.
fn solve(mut matrix: [[f32; 4]; 4], mut right: [f32; 4]) -> [f32; 4] {
    for k in 0..4 {
        let pivot = (k..4).max_by(|a, b| matrix[*a][k].abs().total_cmp(&matrix[*b][k].abs())).unwrap_or(k);
        matrix.swap(k, pivot);
        right.swap(k, pivot);
        if matrix[k][k].abs() < 1e-6 {
            return [0.0; 4];
        }
        for i in k + 1..4 {
            let factor = matrix[i][k] / matrix[k][k];
            let row = matrix[k];
            for (value, above) in matrix[i].iter_mut().zip(row).skip(k) {
                *value -= factor * above;
            }
            right[i] -= factor * right[k];
        }
    }
    let mut x = [0.0; 4];
    for k in (0..4).rev() {
        x[k] = (right[k] - (k + 1..4).map(|j| matrix[k][j] * x[j]).sum::<f32>()) / matrix[k][k];
    }
    x
}

/// Where a linear function that is `value` at 0 and changes by `slope` a step is at least `least`, cut out of `from..to`.
#[inline(always)]
fn at_least(value: f32, slope: f32, least: f32, [from, to]: [f32; 2]) -> [f32; 2] {
    if slope.abs() < 1e-6 {
        return if value >= least { [from, to] } else { [0.0, 0.0] };
    }
    let cut = (least - value) / slope;
    if slope > 0.0 { [from.max(cut), to] } else { [from, to.min(cut)] }
}

/// `at` within `0..side`, which wraps around; `at < 2 * side`.
#[inline(always)]
fn wrapped(at: usize, side: usize) -> usize {
    if at >= side { at - side } else { at }
}

impl Ground {
    /// For small pictures of `size`, px.
    pub fn new(size: Size) -> opencv::Result<Self> {
        // Room for the region turned by any angle, and moved a little.
        let squares = ((size.width as f32).hypot(size.height as f32) / SQUARE as f32).ceil() as usize + 2 * ROOM_SQUARES;
        let side = squares * SQUARE;
        let home = Self::home(size, side);
        Ok(Self {
            size,
            side,
            origin: [0, 0],
            memory: Mat::new_rows_cols_with_default(side as i32, side as i32, CV_8UC4, Scalar::default())?,
            ages: vec![0; side * side],
            corners: vec![None; squares * squares],
            marks: Vec::with_capacity(squares * squares),
            pose: home,
            gain: 1.0,
            reference: home,
            reference_gain: 1.0,
            motion: Motion::default(),
            frame: 0,
            left: 0.0,
            grey: Mat::default(),
            half: Mat::default(),
            scratch: Vec::with_capacity(2 * squares * squares),
        })
    }

    /// The picture in the window's middle.
    fn home(size: Size, side: usize) -> Turn {
        Turn { cos: 1.0, sin: 0.0, shift: [size.width, size.height].map(|v| 0.5 * (v as f32 - side as f32)) }
    }

    /// Starts anew, as from a first picture.
    pub fn forget(&mut self) -> opencv::Result<()> {
        self.memory.data_bytes_mut()?.fill(0);
        self.corners.fill(None);
        (self.pose, self.gain, self.motion, self.frame) = (Self::home(self.size, self.side), 1.0, Motion::default(), 0);
        Ok(())
    }

    /// Whether nothing is remembered yet.
    pub fn is_new(&self) -> bool {
        self.frame == 0
    }

    /// Exposure against the memory, now and in the picture that is compared with.
    pub fn gains(&self) -> [f32; 2] {
        [self.gain, self.reference_gain]
    }

    /// The background's motion since the picture that pictures are compared with.
    pub fn moved(&self) -> Turn {
        self.pose.after(&self.reference.inverse())
    }

    /// How far the picture's middle has moved since then, and its border against that by turning; px.
    pub fn travelled(&self) -> f32 {
        let (moved, middle) = (self.moved(), self.middle());
        let to = moved.forth(middle);
        (to[0] - middle[0]).hypot(to[1] - middle[1]) + 0.5 * moved.sin.abs() * middle[0].min(middle[1])
    }

    /// The next pictures are compared with the one that was last remembered.
    pub fn refer(&mut self) {
        (self.reference, self.reference_gain) = (self.pose, self.gain);
    }

    fn middle(&self) -> [f32; 2] {
        [self.size.width, self.size.height].map(|v| v as f32 / 2.0)
    }

    /// The colour of the dry background at a place in the picture, where it is known.
    pub fn dry_at(&self, place: [f32; 2]) -> Option<[f32; 3]> {
        let [x, y] = self.pose.back(place);
        let (column, row, fx, fy) = between(x, y, self.side, self.side)?;
        let (column, row) = (wrapped(column + self.origin[0], self.side), wrapped(row + self.origin[1], self.side));
        let (right, below) = (wrapped(column + 1, self.side), wrapped(row + 1, self.side));
        let pixels: &[Vec4b] = self.memory.data_typed().ok()?;
        let at = |row: usize, column: usize| pixels.get(row * self.side + column).map(|p| p.0);
        let four = [at(row, column)?, at(row, right)?, at(below, column)?, at(below, right)?];
        let mix = |k: usize| {
            let [a, b, c, d] = four.map(|p| f32::from(p[k]));
            let (top, bottom) = (a + (b - a) * fx, c + (d - c) * fx);
            self.gain * (top + (bottom - top) * fy)
        };
        four.iter().all(|p| p[3] > 0).then(|| [mix(0), mix(1), mix(2)])
    }

    /// What is remembered of these places in the picture, into `found`, as colours and how known they are (0 to 255), both mixed alike. `maps`
    /// are two matrices of the same shape that are overwritten.
    #[inline(always)]
    pub fn recall(&self, places: &[[f32; 2]], maps: &mut [Mat; 2], found: &mut Mat) -> opencv::Result<()> {
        let back = self.pose.inverse();
        let side = self.side as f32;
        for (k, map) in maps.iter_mut().enumerate() {
            let [per_x, per_y] = [[back.cos, -back.sin], [back.sin, back.cos]][k];
            let first = back.shift[k] + self.origin[k] as f32;
            for (at, [x, y]) in map.data_typed_mut::<f32>()?.iter_mut().zip(places) {
                let v = first + per_x * x + per_y * y;
                *at = if v >= side { v - side } else { v };
            }
        }
        let [map_x, map_y] = maps;
        imgproc::remap(&self.memory, found, map_x, map_y, imgproc::INTER_LINEAR, core::BORDER_WRAP, Scalar::default())
    }

    /// Finds how the memory lies in the picture `now`, by the points that are above `air` and not `wet`.
    #[inline(always)]
    pub fn register(&mut self, now: &Mat, air: Plane, wet: Option<Wet>) -> opencv::Result<()> {
        let half = Size::new(self.size.width / 2, self.size.height / 2);
        imgproc::cvt_color_def(now, &mut self.grey, imgproc::COLOR_BGRA2GRAY)?;
        imgproc::resize(&self.grey, &mut self.half, half, 0.0, 0.0, imgproc::INTER_AREA)?;
        let (width, height) = (self.size.width as f32 - 3.0, self.size.height as f32 - 3.0);
        self.marks.clear();
        for mark in self.corners.iter().flatten() {
            let [x, y] = self.pose.forth([0, 1].map(|k| {
                let at = mark.at[k] - self.origin[k] as f32;
                if at < 0.0 { at + self.side as f32 } else { at }
            }));
            let value = |plane: Plane| plane[0] + plane[1] * x + plane[2] * y;
            let water = wet.is_some_and(|w| value(w.line) <= 1.0 || value(w.right) < 1.0);
            if value(air) >= 2.0 && !water && x >= 2.0 && y >= 2.0 && x < width && y < height {
                self.marks.push(Mark { at: [x, y], slopes: mark.slopes.map(|s| self.pose.along(s)), ..*mark });
            }
        }
        if self.marks.iter().filter(|m| m.slopes != [[0.0; 2]; 2]).count() < STEEP_MARKS {
            self.marks.iter_mut().for_each(|m| m.slopes = [[0.0; 2]; 2]);
        }
        let before = self.motion;
        // From the last motion and from rest: a joint starts and stops within a frame.
        let (mut motion, mut gain, mut left) = self.improve(0, before, before)?;
        if before.shift != [0.0; 2] && left > LEFT_GROWS * self.left {
            let (other, its_gain, its_left) = self.improve(0, Motion::default(), before)?;
            if its_left < 0.97 * left {
                (motion, gain, left) = (other, its_gain, its_left);
            }
        }
        if left < f32::MAX {
            (motion, gain, _) = self.improve(1, motion, before)?;
        }
        self.left = left;
        self.motion = if left < f32::MAX { motion } else { Motion::default() };
        self.gain = if left < f32::MAX { gain } else { self.gain };
        self.pose = Turn::new(self.motion.turn, self.motion.shift, self.middle()).after(&self.pose);
        Ok(())
    }

    /// At half the working size (`fine` 0) or at the working size (1): improves `motion` so that the memory, moved, becomes what is
    /// seen now. Returns it, the exposure and the mean size of what is left, grey levels.
    #[inline(always)]
    fn improve(&mut self, fine: usize, mut motion: Motion, before: Motion) -> opencv::Result<(Motion, f32, f32)> {
        let picture = [&self.half, &self.grey][fine];
        let (now, width, height) = (picture.data_bytes()?, picture.cols() as usize, picture.rows() as usize);
        let (scale, corner, close) = [(0.5, -0.25, 0.2), (1.0, 0.0, 0.05)][fine];
        let now_at = |x: f32, y: f32| {
            let (column, row, fx, fy) = between(x, y, width, height)?;
            let (upper, lower) = (now.get(row * width + column..)?, now.get((row + 1) * width + column..)?);
            let mix = |a: u8, b: u8| f32::from(a) + (f32::from(b) - f32::from(a)) * fx;
            let (top, bottom) = (mix(*upper.first()?, *upper.get(1)?), mix(*lower.first()?, *lower.get(1)?));
            Some(top + (bottom - top) * fy)
        };
        let middle = self.middle();
        let mut left = f32::MAX;
        let mut gain = self.gain;
        for _ in 0..8 {
            let turn = Turn::new(motion.turn, motion.shift, middle);
            self.scratch.clear();
            self.scratch.extend(self.marks.iter().map(|m| {
                let [x, y] = turn.forth(m.at);
                now_at(scale * x + corner, scale * y + corner).map_or(f32::NAN, |v| v - gain * m.levels[fine])
            }));
            let errors = self.scratch.len();
            self.scratch.extend_from_within(..);
            let sizes = &mut self.scratch[errors..];
            let mut count = 0;
            for i in 0..errors {
                if !sizes[i].is_nan() {
                    sizes[count] = sizes[i].abs();
                    count += 1;
                }
            }
            if count < POINTS_LEAST {
                return Ok((motion, gain, f32::MAX));
            }
            let noise = median(&mut sizes[..count]) * 1.5 + 0.7;
            left = sizes[..count].iter().map(|v| v.min(3.0 * noise)).sum::<f32>() / count as f32;
            let (mut normal, mut right) = ([[0.0f32; 4]; 4], [0.0f32; 4]);
            for (mark, error) in self.marks.iter().zip(&self.scratch[..errors]).filter(|(_, e)| !e.is_nan()) {
                let weight = (2.0 * noise / error.abs().max(1e-6)).min(1.0);
                let [gx, gy] = mark.slopes[fine].map(|v| v * gain);
                let lever = -gx * (mark.at[1] - middle[1]) + gy * (mark.at[0] - middle[0]);
                let row = [gx, gy, lever, -mark.levels[fine]];
                for k in 0..4 {
                    right[k] += weight * row[k] * error;
                    for j in 0..4 {
                        normal[k][j] += weight * row[k] * row[j];
                    }
                }
            }
            // Along boards, or before an even wall, the picture does not tell the motion: then it stays what it was, and fades.
            let hold = 0.0075 * count as f32 * noise * noise;
            let is_at = [motion.shift[0], motion.shift[1], motion.turn];
            let was_at = [before.shift[0], before.shift[1], before.turn];
            for (k, size) in [1.0, 1.0, 2500.0].into_iter().enumerate() {
                normal[k][k] += 1.15 * hold * size;
                right[k] += hold * size * (is_at[k] - was_at[k]) + 0.15 * hold * size * is_at[k];
            }
            normal[3][3] += 1.0;
            let change = solve(normal, right);
            motion.shift = [motion.shift[0] - change[0], motion.shift[1] - change[1]];
            motion.turn -= change[2];
            gain -= change[3];
            if change[0].abs() + change[1].abs() < close && change[2].abs() < 0.01 * close {
                break;
            }
        }
        Ok((motion, gain, left))
    }

    /// Takes what is `dry` in the picture `now` over into the memory: new ground at once, known ground by and by.
    #[inline(always)]
    pub fn remember(&mut self, now: &Mat, dry: Dry) -> opencv::Result<()> {
        self.keep_inside()?;
        let (pose, side) = (self.pose, self.side);
        let (width, height) = (self.size.width as f32, self.size.height as f32);
        let picture = Picture { pixels: now.data_typed()?, width: self.size.width as usize };
        let memory: &mut [Vec4b] = self.memory.data_typed_mut()?;
        // Of 256; and three times the square of a calm difference.
        let exposure = (256.0 / self.gain) as i32;
        let calm = (3.0 * (dry.calm / self.gain) * (dry.calm / self.gain)) as i32;
        let everywhere = [2.0, 0.0, 0.0];
        let (right, inner, outer) = dry.near.map_or((everywhere, everywhere, everywhere), |(wet, outer)| (wet.right, wet.line, outer));
        for y in 0..side {
            let fresh = self.frame == 0 || y % REFRESH == self.frame % REFRESH;
            let from = pose.forth([0.0, y as f32]);
            let value = |plane: Plane| plane[0] + plane[1] * from[0] + plane[2] * from[1];
            let slope = |plane: Plane| plane[1] * pose.cos + plane[2] * pose.sin;
            let span = at_least(value(dry.air), slope(dry.air), 0.0, [0.0, side as f32]);
            let span = at_least(from[0], pose.cos, 0.01, span);
            let span = at_least(-from[0], -pose.cos, 1.01 - width, span);
            let span = at_least(from[1], pose.sin, 0.01, span);
            let [x0, x1] = at_least(-from[1], -pose.sin, 1.01 - height, span);
            let (x0, x1) = (x0.ceil().max(0.0), x1.floor().min(side as f32));
            if x1 <= x0 {
                continue;
            }
            let (x0, x1) = (x0 as usize, x1 as usize);
            // Where water is not far: to the left of the left side, or within the lines.
            let dry_from = |plane: Plane| at_least(value(plane), slope(plane), 1.0, [0.0, side as f32]).map(|x| x as i32);
            let dry_spans = [dry_from(right), dry_from(inner), dry_from(outer)];
            let start = wrapped(y + self.origin[1], side) * side;
            let (row, ages) = (&mut memory[start..start + side], &mut self.ages[start..start + side]);
            // Known ground when its row's turn has come, unknown ground always; up to where the window wraps around.
            let mut x = x0;
            while x < x1 {
                let column = wrapped(x + self.origin[0], side);
                let most = RUN.min(x1 - x).min(side - column);
                let run = &row[column..column + most];
                let length = if fresh {
                    most
                } else if run[0][3] > 0 {
                    x += run.iter().position(|p| p[3] == 0).unwrap_or(most);
                    continue;
                } else {
                    run.iter().position(|p| p[3] > 0).unwrap_or(most)
                };
                let place = [from[0] + x as f32 * pose.cos, from[1] + x as f32 * pose.sin];
                let seen = picture.along(place, [pose.cos, pose.sin], length);
                let range = column..column + length;
                follow(
                    &seen,
                    &mut row[range.clone()],
                    &mut ages[range],
                    Following { x: x as i32, dry_spans, flows: dry.flows, exposure, calm },
                );
                x += length;
            }
        }
        let (first, every) = if self.frame == 0 { (0, 1) } else { (self.frame % MARK_EVERY, MARK_EVERY) };
        for row in (first..side / SQUARE).step_by(every) {
            self.mark_corners(row, STEEP_LEAST * dry.calm)?;
        }
        self.frame += 1;
        Ok(())
    }

    /// Moves the window on by whole squares when the picture's middle is no longer in its middle; what comes in is not known.
    fn keep_inside(&mut self) -> opencv::Result<()> {
        let (side, squares) = (self.side, self.side / SQUARE);
        for k in 0..2 {
            loop {
                let off = self.pose.back(self.middle())[k] - 0.5 * side as f32;
                if off.abs() <= SQUARE as f32 {
                    break;
                }
                let forward = off > 0.0;
                // The window's first square leaves and becomes its last, or the other way round.
                let first = if forward { self.origin[k] } else { wrapped(self.origin[k] + side - SQUARE, side) };
                self.origin[k] = if forward { wrapped(first + SQUARE, side) } else { first };
                let memory: &mut [Vec4b] = self.memory.data_typed_mut()?;
                for other in 0..side {
                    for i in first..first + SQUARE {
                        let at = if k == 0 { other * side + i } else { i * side + other };
                        (memory[at], self.ages[at]) = (Vec4b::default(), 0);
                    }
                }
                for other in 0..squares {
                    let i = first / SQUARE;
                    self.corners[if k == 0 { other * squares + i } else { i * squares + other }] = None;
                }
                let step = if forward { SQUARE as f32 } else { -(SQUARE as f32) };
                for pose in [&mut self.pose, &mut self.reference] {
                    let along = pose.along(if k == 0 { [step, 0.0] } else { [0.0, step] });
                    pose.shift = [pose.shift[0] + along[0], pose.shift[1] + along[1]];
                }
            }
        }
        Ok(())
    }

    /// Chooses the points for the motion anew in one row of the memory's squares: in each that the picture shows, the one with the steepest
    /// slope. A change below `least` over 2 px may be noise, and then tells the exposure only.
    #[inline(always)]
    fn mark_corners(&mut self, row: usize, least: f32) -> opencv::Result<()> {
        const ROOM: usize = 2;
        const NEAR: usize = SQUARE + 2 * ROOM;
        let (side, squares) = (self.side, self.side / SQUARE);
        let memory: &[Vec4b] = self.memory.data_typed()?;
        for column in 0..squares {
            // The window's border has no neighbours.
            let [left, top] = [(column, 0), (row, 1)].map(|(square, k)| wrapped(square * SQUARE + side - self.origin[k], side));
            let middle = self.pose.forth([left as f32 + 0.5 * SQUARE as f32, top as f32 + 0.5 * SQUARE as f32]);
            let out = (0..2).any(|k| middle[k] < 0.0 || middle[k] > [self.size.width, self.size.height][k] as f32);
            if out || [left, top].iter().any(|v| *v == 0 || *v == side - SQUARE) {
                continue;
            }
            // The square and what is around it, grey; negative where it is not known or not fresh.
            let mut near = [[0i32; NEAR]; NEAR];
            let [first_column, first_row] = [column, row].map(|square| wrapped(square * SQUARE + side - ROOM, side));
            for (j, near) in near.iter_mut().enumerate() {
                let start = wrapped(first_row + j, side) * side;
                for (i, near) in near.iter_mut().enumerate() {
                    let at = start + wrapped(first_column + i, side);
                    let [b, g, r, known] = memory[at].0;
                    let grey = (29 * i32::from(b) + 150 * i32::from(g) + 77 * i32::from(r)) >> 8;
                    *near = if known > 0 && self.ages[at] <= MARK_AGE { grey } else { -1 };
                }
            }
            let mut best: Option<(i32, [usize; 2])> = None;
            for y in (ROOM..ROOM + SQUARE).step_by(2) {
                for x in (ROOM..ROOM + SQUARE).step_by(2) {
                    let (across, down) = (near[y][x + 1] - near[y][x - 1], near[y + 1][x] - near[y - 1][x]);
                    let steep = across * across + down * down;
                    let known = near[y - 2][x] >= 0 && near[y][x - 2] >= 0 && near[y + 2][x] >= 0 && near[y][x + 2] >= 0;
                    if known && best.is_none_or(|(most, _)| steep > most) {
                        best = Some((steep, [x, y]));
                    }
                }
            }
            self.corners[row * squares + column] = best.map(|(steep, [x, y])| {
                let grey = |x: usize, y: usize| near[y][x] as f32;
                // Three in a row or column about a place, the middle one twice.
                let row_of = |x: usize, y: usize| 0.25 * (grey(x - 1, y) + 2.0 * grey(x, y) + grey(x + 1, y));
                let column_of = |x: usize, y: usize| 0.25 * (grey(x, y - 1) + 2.0 * grey(x, y) + grey(x, y + 1));
                let level = 0.25 * (row_of(x, y - 1) + 2.0 * row_of(x, y) + row_of(x, y + 1));
                let fine = [0.5 * (column_of(x + 1, y) - column_of(x - 1, y)), 0.5 * (row_of(x, y + 1) - row_of(x, y - 1))];
                let coarse = [0.25 * (column_of(x + 2, y) - column_of(x - 2, y)), 0.25 * (row_of(x, y + 2) - row_of(x, y - 2))];
                let at = [column * SQUARE + x - ROOM, row * SQUARE + y - ROOM].map(|v| v as f32);
                let slopes = if steep as f32 > least * least { [coarse, fine] } else { [[0.0; 2]; 2] };
                Mark { at, levels: [level, grey(x, y)], slopes }
            });
        }
        Ok(())
    }
}
