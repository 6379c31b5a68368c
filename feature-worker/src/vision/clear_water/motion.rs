//! The motion of the dry background from one picture to the next: a shift, a turn and a change of exposure.
//!
//! It follows from a few hundred points of the remembered background, the one with the steepest slope in each square, by Gauss-Newton
//! with robust weights: at half the working size first, then at the working size.
//!
//! Called on the extraction thread. All pictures and lists are kept, so nothing is allocated after the second frame. The only failures
//! are OpenCV's; where the points do not tell the motion, the last one fades.

use opencv::core::{Mat, Size};
use opencv::imgproc;
use opencv::prelude::*;

use super::rigid::RigidMap;
use crate::vision::picture::{bilinear_corner, median};

// "Tuned" below means that the value was tuned on seeds 101 to 104 of `evaluate-camera`; see docs/VISION.md.

/// Side of the squares of which each gives one point, px. Tuned.
pub(super) const SQUARE: usize = 10;
/// Pixels around a square that are needed for the slopes within it, px.
const ROOM: usize = 2;
/// Side of a square with what is around it, px.
pub(super) const NEIGHBOURHOOD: usize = SQUARE + 2 * ROOM;
/// First pixel of a square's neighbourhood, before the square, px.
pub(super) const NEIGHBOURHOOD_BEFORE: usize = ROOM;
/// Fewer points than this tell no motion. Chosen by hand; no measurement is recorded.
const POINTS_LEAST: usize = 30;
/// With fewer steep points the background is an even wall, and these are drops or the stream: they do not tell its motion. Tuned.
const STEEP_POINTS_LEAST: usize = 24;
/// The motion is looked for from rest too when it leaves more than this many times as much unexplained as the last one did. Tuned.
const LEFT_GROWS: f32 = 1.2;
/// A motion found from rest is taken when it leaves less unexplained than this share of what the other one leaves. Tuned.
const REST_BETTER: f32 = 0.97;
/// Largest number of Gauss-Newton steps. Chosen by hand; no measurement is recorded.
const STEPS_MOST: usize = 8;
/// Weight with which the last motion is held, per point and square of the noise. Tuned.
const HOLD: f32 = 0.0075;
/// Share of that weight with which the motion is drawn to rest. Tuned.
const FADE: f32 = 0.15;
/// The weight of holding the turn, in units of that of holding the shift: px^2. Tuned.
const HOLD_TURN: f32 = 2500.0;

/// A point of the background by which its motion is found.
#[derive(Debug, Clone, Copy)]
pub(super) struct MotionPoint {
    /// Place, px.
    pub(super) at: [f32; 2],
    /// Grey level at half the working size and at the working size.
    pub(super) levels: [f32; 2],
    /// Slope at half the working size and at the working size, grey levels a px. Zeros: the point tells the exposure only.
    pub(super) slopes: [[f32; 2]; 2],
}

impl MotionPoint {
    /// The point with the steepest slope in a square whose corner is at `corner`. `near` is the square with [`NEIGHBOURHOOD_BEFORE`] px
    /// around it in grey levels, negative where it is not known well. A change below `least` over 2 px may be noise, so it tells the
    /// exposure only.
    #[inline(always)]
    pub(super) fn steepest(near: &[[i32; NEIGHBOURHOOD]; NEIGHBOURHOOD], corner: [usize; 2], least: f32) -> Option<Self> {
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
        best.map(|(steep, [x, y])| {
            let grey = |x: usize, y: usize| near[y][x] as f32;
            // Three in a row or column about a place, the middle one twice.
            let row_of = |x: usize, y: usize| 0.25 * (grey(x - 1, y) + 2.0 * grey(x, y) + grey(x + 1, y));
            let column_of = |x: usize, y: usize| 0.25 * (grey(x, y - 1) + 2.0 * grey(x, y) + grey(x, y + 1));
            let level = 0.25 * (row_of(x, y - 1) + 2.0 * row_of(x, y) + row_of(x, y + 1));
            let fine = [0.5 * (column_of(x + 1, y) - column_of(x - 1, y)), 0.5 * (row_of(x, y + 1) - row_of(x, y - 1))];
            let coarse = [0.25 * (column_of(x + 2, y) - column_of(x - 2, y)), 0.25 * (row_of(x, y + 2) - row_of(x, y - 2))];
            let at = [corner[0] + x - ROOM, corner[1] + y - ROOM].map(|v| v as f32);
            let slopes = if steep as f32 > least * least { [coarse, fine] } else { [[0.0; 2]; 2] };
            Self { at, levels: [level, grey(x, y)], slopes }
        })
    }
}

/// Motion from one picture to the next.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Motion {
    /// Shift, px.
    shift: [f32; 2],
    /// Turn about the picture's middle, radians.
    turn: f32,
}

/// A motion, and what it leaves unexplained.
#[derive(Debug, Clone, Copy)]
struct Fit {
    /// The motion itself.
    motion: Motion,
    /// Exposure against the memory.
    gain: f32,
    /// Mean size of what is left unexplained, grey levels; the largest number if there are too few points.
    left: f32,
}

/// At which size of the picture the motion is looked for.
#[derive(Debug, Clone, Copy)]
enum Level {
    /// At half the working size.
    Half,
    /// At the working size.
    Full,
}

/// Finds the background's motion in small pictures of one size.
pub(super) struct MotionFinder {
    /// Middle of the picture, px.
    middle: [f32; 2],
    half_size: Size,
    /// The points as they lay in the last picture. Kept from frame to frame.
    points: Vec<MotionPoint>,
    /// The last motion.
    motion: Motion,
    /// How much of the points the last motion left unexplained at half the size, grey levels.
    left: f32,
    /// The picture in grey at the working size. Kept from frame to frame.
    grey: Mat,
    /// The grey picture at half the working size.
    half: Mat,
    /// The points' errors, then their sizes; grey levels.
    scratch: Vec<f32>,
}

impl MotionFinder {
    /// For pictures of `size`, px, and at most `points_most` points.
    pub(super) fn new(size: Size, points_most: usize) -> Self {
        Self {
            middle: [size.width, size.height].map(|v| v as f32 / 2.0),
            half_size: Size::new(size.width / 2, size.height / 2),
            points: Vec::with_capacity(points_most),
            motion: Motion::default(),
            left: 0.0,
            grey: Mat::default(),
            half: Mat::default(),
            scratch: Vec::with_capacity(2 * points_most),
        }
    }

    /// Starts anew from rest.
    pub(super) fn rest(&mut self) {
        self.motion = Motion::default();
    }

    /// Takes the points as they lay in the last picture.
    #[inline(always)]
    pub(super) fn set_points(&mut self, points: impl Iterator<Item = MotionPoint>) {
        self.points.clear();
        self.points.extend(points);
        if self.points.iter().filter(|p| p.slopes != [[0.0; 2]; 2]).count() < STEEP_POINTS_LEAST {
            self.points.iter_mut().for_each(|p| p.slopes = [[0.0; 2]; 2]);
        }
    }

    /// The motion of the points from the last picture to the BGRA picture `now`, and the exposure against the memory, which was `gain` in
    /// the last picture.
    #[inline(always)]
    pub(super) fn find(&mut self, now: &Mat, gain: f32) -> opencv::Result<(RigidMap, f32)> {
        imgproc::cvt_color_def(now, &mut self.grey, imgproc::COLOR_BGRA2GRAY)?;
        imgproc::resize(&self.grey, &mut self.half, self.half_size, 0.0, 0.0, imgproc::INTER_AREA)?;
        let before = self.motion;
        // From the last motion and from rest, because a joint starts and stops within a frame.
        let mut fit = self.improve(Level::Half, before, before, gain)?;
        if before.shift != [0.0; 2] && fit.left > LEFT_GROWS * self.left {
            let other = self.improve(Level::Half, Motion::default(), before, gain)?;
            if other.left < REST_BETTER * fit.left {
                fit = other;
            }
        }
        self.left = fit.left;
        let told = fit.left < f32::MAX;
        if told {
            fit = self.improve(Level::Full, fit.motion, before, gain)?;
        }
        self.motion = if told { fit.motion } else { Motion::default() };
        let gain = if told { fit.gain } else { gain };
        Ok((RigidMap::about(self.middle, self.motion.turn, self.motion.shift), gain))
    }

    /// Improves `motion` so that the points, moved, become what the picture shows. `before` is the last motion.
    #[inline(always)]
    fn improve(&mut self, level: Level, mut motion: Motion, before: Motion, mut gain: f32) -> opencv::Result<Fit> {
        // The picture's scale, where the middle of the first pixel comes to lie, and the change at which the search ends, px.
        let (picture, scale, corner, close) = match level {
            Level::Half => (&self.half, 0.5, -0.25, 0.2),
            Level::Full => (&self.grey, 1.0, 0.0, 0.05),
        };
        let (now, width, height) = (picture.data_bytes()?, picture.cols() as usize, picture.rows() as usize);
        let mut left = f32::MAX;
        for _ in 0..STEPS_MOST {
            let map = RigidMap::about(self.middle, motion.turn, motion.shift);
            self.scratch.clear();
            self.scratch.extend(self.points.iter().map(|p| {
                let [x, y] = map.apply(p.at);
                let seen = grey_at(now, width, height, scale * x + corner, scale * y + corner);
                seen.map_or(f32::NAN, |v| v - gain * p.levels[level as usize])
            }));
            let errors = self.scratch.len();
            self.scratch.extend_from_within(..);
            let (errors, sizes) = self.scratch.split_at_mut(errors);
            let mut count = 0;
            for error in errors.iter().filter(|e| !e.is_nan()) {
                sizes[count] = error.abs();
                count += 1;
            }
            if count < POINTS_LEAST {
                return Ok(Fit { motion, gain, left: f32::MAX });
            }
            let noise = median(&mut sizes[..count]) * 1.5 + 0.7;
            left = sizes[..count].iter().map(|v| v.min(3.0 * noise)).sum::<f32>() / count as f32;
            let (mut normal, mut right) = normal_equations(&self.points, errors, level, self.middle, gain, noise);
            hold(&mut normal, &mut right, motion, before, HOLD * count as f32 * noise * noise);
            let change = solve(normal, right);
            motion.shift = [motion.shift[0] - change[0], motion.shift[1] - change[1]];
            motion.turn -= change[2];
            gain -= change[3];
            if change[0].abs() + change[1].abs() < close && change[2].abs() < 0.01 * close {
                break;
            }
        }
        Ok(Fit { motion, gain, left })
    }
}

/// The grey level at a place between pixels; `None` outside of the picture.
#[inline(always)]
fn grey_at(picture: &[u8], width: usize, height: usize, x: f32, y: f32) -> Option<f32> {
    let (column, row, fx, fy) = bilinear_corner(x, y, width, height)?;
    let (upper, lower) = (picture.get(row * width + column..)?, picture.get((row + 1) * width + column..)?);
    let mix = |a: u8, b: u8| f32::from(a) + (f32::from(b) - f32::from(a)) * fx;
    let (top, bottom) = (mix(*upper.first()?, *upper.get(1)?), mix(*lower.first()?, *lower.get(1)?));
    Some(top + (bottom - top) * fy)
}

/// The weighted normal equations of one step for shift, turn and exposure. An error that is not a number does not count.
#[inline(always)]
fn normal_equations(
    points: &[MotionPoint],
    errors: &[f32],
    level: Level,
    middle: [f32; 2],
    gain: f32,
    noise: f32,
) -> ([[f32; 4]; 4], [f32; 4]) {
    let (mut normal, mut right) = ([[0.0f32; 4]; 4], [0.0f32; 4]);
    for (point, error) in points.iter().zip(errors).filter(|(_, e)| !e.is_nan()) {
        let weight = (2.0 * noise / error.abs().max(1e-6)).min(1.0);
        let [gx, gy] = point.slopes[level as usize].map(|v| v * gain);
        let lever = -gx * (point.at[1] - middle[1]) + gy * (point.at[0] - middle[0]);
        let row = [gx, gy, lever, -point.levels[level as usize]];
        for k in 0..4 {
            right[k] += weight * row[k] * error;
            for j in 0..4 {
                normal[k][j] += weight * row[k] * row[j];
            }
        }
    }
    (normal, right)
}

/// Holds the last motion with weight `hold`: along boards, or before an even wall, the picture does not tell the motion. Then it stays
/// what it was, and fades.
#[inline(always)]
fn hold(normal: &mut [[f32; 4]; 4], right: &mut [f32; 4], motion: Motion, before: Motion, hold: f32) {
    let is_at = [motion.shift[0], motion.shift[1], motion.turn];
    let was_at = [before.shift[0], before.shift[1], before.turn];
    for (k, size) in [1.0, 1.0, HOLD_TURN].into_iter().enumerate() {
        normal[k][k] += (1.0 + FADE) * hold * size;
        right[k] += hold * size * (is_at[k] - was_at[k]) + FADE * hold * size * is_at[k];
    }
    normal[3][3] += 1.0;
}

/// Solves `matrix x = right` by elimination with pivots. Returns zeros where the matrix is singular.
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
