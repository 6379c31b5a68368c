//! Clear water: told from the background by what does not move with it.
//!
//! Water has no colour, but it bends light: its outline shows a band of the room instead of what stands behind, and inside it the
//! background is displaced. The container turns, so the background moves in the picture as one rigid piece, while the stream's
//! outline stays. Hence, at 320 px for the whole width:
//!
//! 1. The background's **motion** since the last frame (shift, turn, exposure) from a few hundred points that are dry
//!    (Gauss-Newton with robust weights).
//! 2. The **remembered** dry background and the last picture, both moved by it, are compared with the picture along rays from the lip.
//!    What differs from the memory is wet. Where the background was hidden until now, a step in brightness counts that the last picture,
//!    moved, does not explain.
//! 3. Of about 1,500 **lines** from axis to axis the best has most of this just inside and none outside. A line goes on where it was,
//!    with the same band along it; one that moves with the background is none. Beginning a stream takes more than going on.
//!
//! The first frame must be dry. Runs on the extraction thread; all pictures and tables are kept, nothing is allocated after the second
//! frame. No failures but OpenCV's.

use opencv::core::{self, CV_8UC2, Mat, Scalar, Size, Vec2b};
use opencv::imgproc;
use opencv::prelude::*;

use crate::extract::{Axes, between};

/// Width of the whole picture at which this works, px; all lengths below are px at that size.
const WIDTH_PX: f32 = 320.0;
/// Air begins this far above the top edge: the rim's light spreads.
const RIM_PX: f32 = 1.5;
/// Rays between the axes, and samples 1 px apart on each, from [`NEAR_PX`] on.
const RAYS: usize = 32;
const SAMPLES: usize = 130;
const CELLS: usize = RAYS * SAMPLES;
const NEAR_PX: f32 = 1.0;
/// Lines that are tried: distances on either axis in geometric steps, and the largest ratio of the two.
const LEGS: usize = 46;
const LEG_FIRST_PX: f32 = 6.5;
const LEG_FACTOR: f32 = 1.07;
const LEG_RATIO: f32 = 4.5;
/// Points for the motion: one, the one with the steepest slope, in each square of this many px at half the working size.
const POINT_EVERY: usize = 5;
const POINTS_LEAST: usize = 30;
/// The motion is looked for from rest too when it leaves this much more unexplained than the last one did.
const LEFT_GROWS: f32 = 1.2;
/// Least noise, grey levels (rounding), and as a share of the background's brightness (the exposure is not known better).
const NOISE_LEAST: f32 = 0.8;
const NOISE_SHARE: f32 = 0.012;
/// Share of the background's slope that counts as error of its place: fresh, and more as the memory fades.
const SLOPE_FRESH: f32 = 0.2;
const SLOPE_FADED: f32 = 0.5;
/// Difference in units of the noise: from here on it is wet, and fully so this much further on; dry as much before.
const WET_FROM: f32 = 3.0;
const WET_SPAN: f32 = 3.0;
/// A difference up to this, in units of the noise, is still background.
const CALM: f32 = 5.0;
/// Sureness of the memory, 0 to 255: known from here on; left after each frame that does not show it.
const KNOWN: u8 = 50;
const FADE: f32 = 0.95;
/// Background that moves by more than this is told from what stands still, px a frame.
const MOVES_PX: f32 = 1.2;
/// A step in brightness counts from this share of the stream's usual one on, fully this much further on.
const STEP_FROM: f32 = 0.35;
const STEP_SPAN: f32 = 0.3;
/// Weight of a moved picture's evidence where the memory knows nothing, to begin a stream.
const UNKNOWN_WEIGHT: f32 = 0.5;
/// Least score, share of the line's length with an edge, and share of it on known ground to begin a stream.
const BEGIN: [f32; 3] = [0.6, 0.7, 0.45];
/// Least score to go on: on unknown ground and on known ground; least share of the line's length.
const GO_ON: [f32; 3] = [0.45, 0.75, 0.6];
/// What the moved last picture says of a line, -1 (it explains it) to 1: below, it is background; above, a stream goes on.
const EXPLAINED: f32 = -0.4;
const UNEXPLAINED: f32 = 0.3;
/// From this motion across the line on, px a frame; and with at least this score.
const TELLS_PX: f32 = 0.6;
const HELD: f32 = 0.25;
/// Least score of a piece of the line that counts as edge.
const PIECE: f32 = 0.35;
/// Weight of lying further out (as a logarithm): within the water there are edges too.
const OUTERMOST: f32 = 0.3;
/// Weight of what the moved last picture does not explain further out.
const BEYOND: f32 = 0.4;
/// Weight of the last line's neighbourhood (as a Gaussian of this width in the logarithm of its legs), and how far it may jump.
const STAY: f32 = 0.4;
const STAY_WIDTH: f32 = 0.3;
const JUMP_MOST: f32 = 0.9;
/// Weight of an even band along the line, and of the same band as before.
const BAND: f32 = 0.5;
/// Far from the lip, no more of the background than this differs from the memory, or it is another picture.
const STRANGE: f32 = 0.3;
/// How fast the memory follows what is seen: where it fits and where it does not.
const FOLLOW: f32 = 0.5;
const FOLLOW_SLOWLY: f32 = 0.3;
/// Frames after a stream during which the place where it was is not taken for background at once.
const AFTERWARDS: u32 = 3;

/// What was seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Seen {
    /// No stream.
    Dry,
    /// There was a stream, and it is not known whether it goes on.
    Unsure,
    /// A stream; the share of its edge that is seen.
    Stream(f32),
}

/// Motion of the background from frame to frame: shift in px, turn in radians about the region's middle, change of exposure.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
struct Motion {
    shift: [f32; 2],
    turn: f32,
    exposure: f32,
}

/// A point of the background for the motion: place and grey level at half the working size, and the slope there.
#[derive(Debug, Clone, Copy)]
struct Mark {
    x: f32,
    y: f32,
    level: f32,
    slope: [f32; 2],
}

/// The stream as it was last seen.
#[derive(Debug, Clone, Copy)]
struct Stream {
    legs: [f32; 2],
    /// Mean brightness of the band along its outline, and mean step there, grey levels.
    band: f32,
    step: f32,
}

/// A candidate line with what was found along it.
#[derive(Debug, Clone, Copy, Default)]
struct Found {
    line: usize,
    total: f32,
    /// What its samples say, and that with the band along it.
    evidence: f32,
    score: f32,
    share: f32,
    known: f32,
    band: f32,
    step: f32,
}

/// What is known of one sample of one ray.
#[derive(Debug, Clone, Copy, Default)]
struct Cell {
    /// What it adds to a line through it, and the share of that which rests on known ground.
    value: f32,
    known: f32,
    /// Brightness just inside, and the step to just outside.
    band: f32,
    step: f32,
    /// What the moved last picture says, -1 to 1, and the share of the surroundings that it shows.
    unexplained: f32,
    shown: f32,
}

/// Sums along a ray, one more than its samples.
type Sums = [f32; SAMPLES + 1];

/// Remembers the dry background of one camera and the stream before it.
pub struct Background {
    scale: f32,
    size: Size,
    axes: Axes,
    directions: Vec<[f32; 2]>,
    /// Each ray sample's place, px, and whether it is air.
    places: Vec<[f32; 2]>,
    air: Vec<bool>,
    /// Each line's legs on the x- and y-axis, px, and their logarithms; its sample and its weight on each ray.
    legs: Vec<[f32; 2]>,
    log_legs: Vec<[f32; 2]>,
    cells: Vec<u16>,
    weights: Vec<f32>,
    // Pictures: small in colour, now, the last one, and at half the size.
    small: Mat,
    now: Mat,
    last: Mat,
    now_half: Mat,
    memory_half: Mat,
    /// Grey level and sureness of the dry background; as it was left, and the one being made.
    memory: Mat,
    moved: Mat,
    started: bool,
    motion: Motion,
    /// Mean size of what the last motion left unexplained, grey levels.
    left: f32,
    marks: Vec<Mark>,
    table: Vec<Cell>,
    // Along all rays: brightness; difference from the memory and from the last picture in units of the noise; slope; sureness.
    levels: Vec<f32>,
    away: Vec<f32>,
    away_last: Vec<f32>,
    slopes: Vec<f32>,
    sureness: Vec<f32>,
    shown: Vec<f32>,
    noise: f32,
    /// Share of the known background far from the lip that differs from the memory.
    strange: f32,
    stream: Option<Stream>,
    /// Where it last was, and for how many frames it has not been seen.
    last_legs: [f32; 2],
    dry_frames: u32,
    edges: Vec<[f32; 2]>,
    scratch: Vec<f32>,
}

/// The median, upper one of two; reorders.
fn median(values: &mut [f32]) -> f32 {
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f32::total_cmp).1 }
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

/// Grey levels with their width.
#[derive(Clone, Copy)]
struct Grey<'a> {
    bytes: &'a [u8],
    width: usize,
    height: usize,
}

impl<'a> Grey<'a> {
    fn new(picture: &'a Mat) -> opencv::Result<Self> {
        Ok(Self { bytes: picture.data_bytes()?, width: picture.cols() as usize, height: picture.rows() as usize })
    }

    /// Bilinear sample; none outside.
    #[inline]
    fn at(&self, x: f32, y: f32) -> Option<f32> {
        let (column, row, fx, fy) = between(x, y, self.width, self.height)?;
        let upper = self.bytes.get(row * self.width + column..)?;
        let lower = upper.get(self.width..self.width + 2)?;
        let mix = |a: u8, b: u8| f32::from(a) + (f32::from(b) - f32::from(a)) * fx;
        let (top, bottom) = (mix(upper[0], upper[1]), mix(lower[0], lower[1]));
        Some(top + (bottom - top) * fy)
    }
}

/// The rigid map of a motion at `factor` of the working size: a point's new place.
#[derive(Clone, Copy)]
struct Turn {
    cos: f32,
    sin: f32,
    shift: [f32; 2],
    middle: [f32; 2],
}

impl Turn {
    fn new(motion: &Motion, size: Size, factor: f32) -> Self {
        let (sin, cos) = motion.turn.sin_cos();
        Self { cos, sin, shift: motion.shift.map(|v| v * factor), middle: [size.width, size.height].map(|v| v as f32 / 2.0 * factor) }
    }

    #[inline]
    fn forth(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let (x, y) = (x - self.middle[0], y - self.middle[1]);
        [self.cos * x - self.sin * y + self.middle[0] + self.shift[0], self.sin * x + self.cos * y + self.middle[1] + self.shift[1]]
    }

    #[inline]
    fn back(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let (x, y) = (x - self.middle[0] - self.shift[0], y - self.middle[1] - self.shift[1]);
        [self.cos * x + self.sin * y + self.middle[0], -self.sin * x + self.cos * y + self.middle[1]]
    }
}

impl Background {
    /// For a region of `region_px` (width, height) of a picture `width_px` wide; `axes` relative to the region, px.
    pub fn new(axes: &Axes, region_px: [i32; 2], width_px: u32) -> opencv::Result<Self> {
        let scale = (width_px as f32 / WIDTH_PX).round().max(1.0);
        let size = Size::new((region_px[0] / scale as i32).max(8), (region_px[1] / scale as i32).max(8));
        let small = |v: f32| (v + 0.5) / scale - 0.5;
        let axes = Axes { lip_px: axes.lip_px.map(small), ..*axes };
        let ([lip_x, lip_y], x, y) = (axes.lip_px, axes.x, axes.y);
        let sine = x[0] * y[1] - x[1] * y[0];
        let turn = sine.signum();
        let between = sine.abs().atan2(x[0] * y[0] + x[1] * y[1]);
        let directions: Vec<[f32; 2]> = (0..RAYS)
            .map(|i| {
                let (sin, cos) = ((i as f32 + 0.5) / RAYS as f32 * between * turn).sin_cos();
                [x[0] * cos - x[1] * sin, x[0] * sin + x[1] * cos]
            })
            .collect();
        let (mut places, mut air) = (Vec::with_capacity(CELLS), Vec::with_capacity(CELLS));
        for along in &directions {
            for r in 0..SAMPLES {
                let r = NEAR_PX + r as f32;
                let above = (x[0] * along[1] - x[1] * along[0]) * turn * r;
                // Samples beyond the region repeat its border and belong to no line.
                let place = [
                    (lip_x + r * along[0]).clamp(1.0, size.width as f32 - 2.01),
                    (lip_y + r * along[1]).clamp(1.0, size.height as f32 - 2.01),
                ];
                places.push(place);
                air.push(above >= RIM_PX && place == [lip_x + r * along[0], lip_y + r * along[1]]);
            }
        }
        let (mut legs, mut cells, mut weights) = (Vec::new(), Vec::new(), Vec::new());
        for i in 0..LEGS * LEGS {
            let leg = |k: usize| LEG_FIRST_PX * LEG_FACTOR.powi(k as i32);
            let (a, b) = (leg(i / LEGS), leg(i % LEGS));
            if a / b > LEG_RATIO || b / a > LEG_RATIO {
                continue;
            }
            // Where each ray meets the line: along = u x + v y, and u / a + v / b = 1 on it.
            let radii: Vec<f32> = directions
                .iter()
                .map(|d| {
                    let (u, v) = ((d[0] * y[1] - d[1] * y[0]) / sine, (x[0] * d[1] - x[1] * d[0]) / sine);
                    1.0 / (u / a + v / b)
                })
                .collect();
            let point = |k: usize| [lip_x + radii[k] * directions[k][0], lip_y + radii[k] * directions[k][1]];
            let fits = (0..RAYS).all(|k| {
                let [px, py] = point(k);
                radii[k] < NEAR_PX + SAMPLES as f32 - 10.0
                    && px >= 1.0
                    && py >= 1.0
                    && px < size.width as f32 - 2.0
                    && py < size.height as f32 - 2.0
            });
            if !fits {
                continue;
            }
            let apart = |k: usize| (point(k)[0] - point(k + 1)[0]).hypot(point(k)[1] - point(k + 1)[1]);
            // By length; the rays beside the axes are left out.
            let weight = |k: usize| if k == 0 || k == RAYS - 1 { 0.0 } else { apart(k - 1) + apart(k) };
            let total: f32 = (0..RAYS).map(weight).sum();
            legs.push([a, b]);
            cells.extend(radii.iter().enumerate().map(|(k, r)| (k * SAMPLES) as u16 + (r - NEAR_PX).round().max(0.0) as u16));
            weights.extend((0..RAYS).map(|k| weight(k) / total));
        }
        let rows = || vec![0.0; CELLS];
        Ok(Self {
            scale,
            size,
            axes,
            directions,
            places,
            air,
            log_legs: legs.iter().map(|l: &[f32; 2]| l.map(f32::ln)).collect(),
            legs,
            cells,
            weights,
            small: Mat::default(),
            now: Mat::default(),
            last: Mat::default(),
            now_half: Mat::default(),
            memory_half: Mat::default(),
            memory: Mat::new_size_with_default(size, CV_8UC2, Scalar::all(0.0))?,
            moved: Mat::new_size_with_default(size, CV_8UC2, Scalar::all(0.0))?,
            started: false,
            motion: Motion::default(),
            left: 0.0,
            marks: Vec::with_capacity(size.area() as usize / (4 * POINT_EVERY * POINT_EVERY) + 1),
            table: vec![Cell::default(); CELLS],
            levels: rows(),
            away: rows(),
            away_last: rows(),
            slopes: rows(),
            sureness: rows(),
            shown: rows(),
            noise: NOISE_LEAST,
            strange: 0.0,
            stream: None,
            last_legs: [0.0; 2],
            dry_frames: AFTERWARDS + 1,
            edges: Vec::with_capacity(RAYS),
            scratch: Vec::with_capacity(CELLS),
        })
    }

    /// Edge points of the stream in the last picture, in the region's px, from the x-axis to the y-axis.
    pub fn edges_px(&self) -> &[[f32; 2]] {
        &self.edges
    }

    /// Linear functions of a place: distance above the top edge, distance to the right of the left side, and the share
    /// `u / a + v / b` of the way to the line with these legs; as `[at origin, per x, per y]`.
    fn planes(&self, [a, b]: [f32; 2]) -> [[f32; 3]; 3] {
        let (x, y, [lip_x, lip_y]) = (self.axes.x, self.axes.y, self.axes.lip_px);
        let sine = x[0] * y[1] - x[1] * y[0];
        let turn = sine.signum();
        let plane = |px: f32, py: f32| [-px * lip_x - py * lip_y, px, py];
        [
            plane(-x[1] * turn, x[0] * turn),
            plane(y[1] * turn, -y[0] * turn),
            plane((y[1] / a - x[1] / b) / sine, (x[0] / b - y[0] / a) / sine),
        ]
    }

    /// Takes the next picture: the region in colour, at full size.
    pub fn take(&mut self, region: &impl core::ToInputArray) -> opencv::Result<()> {
        std::mem::swap(&mut self.now, &mut self.last);
        // The middle four of each block's pixels: half of the memory of a large picture is never read.
        imgproc::resize(region, &mut self.small, self.size, 0.0, 0.0, imgproc::INTER_LINEAR)?;
        imgproc::cvt_color_def(&self.small, &mut self.now, imgproc::COLOR_BGR2GRAY)
    }

    /// The picture that was taken, small, in colour.
    pub fn small(&self) -> &Mat {
        &self.small
    }

    /// Looks at the picture that was taken.
    pub fn look(&mut self) -> opencv::Result<Seen> {
        self.edges.clear();
        if !self.started {
            self.started = true;
            let [above, ..] = self.planes([1.0, 1.0]);
            let width = self.size.width as usize;
            let now = self.now.data_bytes()?;
            for (i, pixel) in self.memory.data_typed_mut::<Vec2b>()?.iter_mut().enumerate() {
                let air = above[0] + above[1] * (i % width) as f32 + above[2] * (i / width) as f32 >= RIM_PX;
                *pixel = Vec2b::from([now[i], if air { 255 } else { 0 }]);
            }
            return Ok(Seen::Dry);
        }
        self.register()?;
        self.compare()?;
        let seen = self.decide();
        self.remember()?;
        Ok(seen)
    }

    /// The background's motion from the memory to now, into `self.motion`.
    fn register(&mut self) -> opencv::Result<()> {
        let half = Size::new(self.size.width / 2, self.size.height / 2);
        imgproc::resize(&self.now, &mut self.now_half, half, 0.0, 0.0, imgproc::INTER_AREA)?;
        imgproc::resize(&self.memory, &mut self.memory_half, half, 0.0, 0.0, imgproc::INTER_AREA)?;
        let [_, right, inside] = self.planes(self.stream.map_or([1.0, 1.0], |s| s.legs.map(|v| v + 5.0)));
        let flows = self.stream.is_some();
        let memory = self.memory_half.data_typed::<Vec2b>()?;
        let (width, height) = (half.width as usize, half.height as usize);
        self.marks.clear();
        for top in (1..height.saturating_sub(POINT_EVERY)).step_by(POINT_EVERY) {
            for left in (1..width.saturating_sub(POINT_EVERY)).step_by(POINT_EVERY) {
                let mut best: Option<(f32, Mark)> = None;
                for y in top..top + POINT_EVERY {
                    for x in left..left + POINT_EVERY {
                        let i = y * width + x;
                        if memory[i][1] < 250 && (flows || memory[i][1] < KNOWN) {
                            continue;
                        }
                        let level = |i: usize| f32::from(memory[i][0]);
                        let slope = [0.5 * (level(i + 1) - level(i - 1)), 0.5 * (level(i + width) - level(i - width))];
                        let steep = slope[0] * slope[0] + slope[1] * slope[1];
                        if best.as_ref().is_none_or(|(most, _)| steep > *most) {
                            best = Some((steep, Mark { x: x as f32, y: y as f32, level: level(i), slope }));
                        }
                    }
                }
                let Some((_, mark)) = best else { continue };
                let (x, y) = (2.0 * mark.x + 0.5, 2.0 * mark.y + 0.5);
                let value = |plane: [f32; 3]| plane[0] + plane[1] * x + plane[2] * y;
                if !flows || (value(inside) > 1.0 && value(right) >= 1.0) {
                    self.marks.push(mark);
                }
            }
        }
        let before = self.motion;
        // From the last motion and from rest: a joint starts and stops within a frame.
        let (mut motion, mut left) = self.improve(Motion { exposure: 0.0, ..before }, before)?;
        if before.shift != [0.0; 2] && left > LEFT_GROWS * self.left {
            let (other, its_left) = self.improve(Motion::default(), before)?;
            if its_left < 0.97 * left {
                (motion, left) = (other, its_left);
            }
        }
        self.left = left;
        self.motion = if left < f32::MAX { motion } else { Motion::default() };
        Ok(())
    }

    /// Improves `motion` so that the memory, moved, becomes what is seen now. Returns it and the mean size of what is left,
    /// grey levels.
    fn improve(&mut self, mut motion: Motion, before: Motion) -> opencv::Result<(Motion, f32)> {
        let now = Grey::new(&self.now_half)?;
        let mut left = f32::MAX;
        for _ in 0..8 {
            let turn = Turn::new(&motion, self.size, 0.5);
            let gain = 1.0 + motion.exposure;
            self.scratch.clear();
            self.scratch.extend(self.marks.iter().map(|m| {
                let [x, y] = turn.forth([m.x, m.y]);
                now.at(x, y).map_or(f32::NAN, |v| v - gain * m.level)
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
                return Ok((motion, f32::MAX));
            }
            let noise = median(&mut sizes[..count]) * 1.5 + 0.7;
            left = sizes[..count].iter().map(|v| v.min(3.0 * noise)).sum::<f32>() / count as f32;
            let (mut normal, mut right) = ([[0.0f32; 4]; 4], [0.0f32; 4]);
            for (mark, error) in self.marks.iter().zip(&self.scratch[..errors]).filter(|(_, e)| !e.is_nan()) {
                let weight = (2.0 * noise / error.abs().max(1e-6)).min(1.0);
                let [gx, gy] = mark.slope;
                let lever = -gx * (mark.y - turn.middle[1]) + gy * (mark.x - turn.middle[0]);
                let row = [0.5 * gx, 0.5 * gy, lever, -mark.level];
                for k in 0..4 {
                    right[k] += weight * row[k] * error;
                    for j in 0..4 {
                        normal[k][j] += weight * row[k] * row[j];
                    }
                }
            }
            // Along boards, or before an even wall, the picture does not tell the motion: then it stays what it was, and fades.
            let hold = 0.0075 * count as f32 * noise * noise;
            let now_at = [motion.shift[0], motion.shift[1], motion.turn];
            let was_at = [before.shift[0], before.shift[1], before.turn];
            for (k, size) in [1.0, 1.0, 2500.0].into_iter().enumerate() {
                normal[k][k] += 1.15 * hold * size;
                right[k] += hold * size * (now_at[k] - was_at[k]) + 0.15 * hold * size * now_at[k];
            }
            normal[3][3] += 1.0;
            let change = solve(normal, right);
            motion.shift = [motion.shift[0] - change[0], motion.shift[1] - change[1]];
            motion.turn -= change[2];
            motion.exposure -= change[3];
            if change[0].abs() + change[1].abs() < 0.05 && change[2].abs() < 0.0005 {
                break;
            }
        }
        Ok((motion, left))
    }

    /// Compares the memory and the last picture, both moved, with what is seen now, along the rays.
    fn compare(&mut self) -> opencv::Result<()> {
        let turn = Turn::new(&self.motion, self.size, 1.0);
        let gain = 1.0 + self.motion.exposure;
        let (now, last) = (Grey::new(&self.now)?, Grey::new(&self.last)?);
        let memory = self.memory.data_typed::<Vec2b>()?;
        let (width, height) = (self.size.width as usize, self.size.height as usize);
        let [above, ..] = self.planes([1.0, 1.0]);
        let (mut level_sum, mut level_count) = (0.0, 0.0f32);
        for i in 0..CELLS {
            let [x, y] = self.places[i];
            let seen = now.at(x, y).unwrap_or(0.0);
            self.levels[i] = seen;
            let from = turn.back([x, y]);
            let inside = from[0] >= 1.0 && from[1] >= 1.0 && from[0] < width as f32 - 2.5 && from[1] < height as f32 - 2.5;
            if !(inside && self.air[i]) {
                (self.sureness[i], self.shown[i], self.slopes[i], self.away[i], self.away_last[i]) = (0.0, 0.0, 0.0, 0.0, 0.0);
                continue;
            }
            let (column, row) = (from[0] as usize, from[1] as usize);
            let corner = row * width + column;
            let level = |at: usize| f32::from(memory[at][0]) * gain;
            // The memory between its pixels, and its slope.
            let (fx, fy) = (from[0] - column as f32, from[1] - row as f32);
            let nearest = corner + usize::from(fx >= 0.5) + if fy >= 0.5 { width } else { 0 };
            let top = level(corner) + (level(corner + 1) - level(corner)) * fx;
            let bottom = level(corner + width) + (level(corner + width + 1) - level(corner + width)) * fx;
            let remembered = top + (bottom - top) * fy;
            self.away[i] = seen - remembered;
            self.slopes[i] =
                0.5 * (level(nearest + 1) - level(nearest - 1)).abs().max((level(nearest + width) - level(nearest - width)).abs());
            let sure = memory[nearest][1];
            self.sureness[i] = if sure >= KNOWN { f32::from(sure) / 255.0 } else { 0.0 };
            let was_air = above[0] + above[1] * from[0] + above[2] * from[1] >= RIM_PX;
            let before = if was_air { last.at(from[0], from[1]) } else { None };
            self.shown[i] = if before.is_some() { 1.0 } else { 0.0 };
            self.away_last[i] = before.map_or(0.0, |b| seen - gain * b);
            if self.sureness[i] > 0.0 {
                level_sum += remembered;
                level_count += 1.0;
            }
        }
        // Neighbours along a ray together.
        for values in [&mut self.away, &mut self.away_last] {
            for i in 0..CELLS - 1 {
                values[i] = 0.5 * (values[i] + values[i + 1]).abs();
            }
        }
        // Noise: where the known background is even.
        self.scratch.clear();
        self.scratch.extend((0..CELLS).step_by(3).filter(|i| self.sureness[*i] > 0.0).map(|i| self.slopes[i]));
        let even = median(&mut self.scratch);
        self.scratch.clear();
        let known = (0..CELLS).step_by(3).filter(|i| self.sureness[*i] > 0.0 && self.slopes[*i] <= even);
        self.scratch.extend(known.map(|i| self.away[i]));
        let noise = if self.scratch.len() > 25 { 1.5 * median(&mut self.scratch) } else { 2.0 };
        self.noise = noise.max(NOISE_LEAST).max(NOISE_SHARE * level_sum / level_count.max(1.0));
        for i in 0..CELLS {
            let slope = self.slopes[i];
            let place = (SLOPE_FRESH + SLOPE_FADED * (1.0 - self.sureness[i])) * slope;
            self.away[i] = (self.away[i] - place).max(0.0) / self.noise;
            self.away_last[i] = (self.away_last[i] - 0.25 * slope).max(0.0) / self.noise;
        }
        let far = || (0..CELLS).filter(|i| i % SAMPLES >= SAMPLES / 2 && self.sureness[*i] > 0.0);
        self.strange = far().filter(|i| self.away[*i] > CALM).count() as f32 / far().count().max(1) as f32;
        self.fill_table(&turn);
        Ok(())
    }

    /// Whether what is known near the lip has no pattern: then what is not known has none either.
    fn is_even(&mut self) -> bool {
        let near = 60usize;
        self.scratch.clear();
        let mut air = 0;
        for ray in 0..RAYS {
            for i in (ray * SAMPLES..ray * SAMPLES + near).step_by(2) {
                air += usize::from(self.air[i]);
                if self.sureness[i] > 0.0 {
                    self.scratch.push(self.slopes[i]);
                }
            }
        }
        let count = self.scratch.len();
        count > air * 3 / 5 && *self.scratch.select_nth_unstable_by(count * 9 / 10, f32::total_cmp).1 < 1.2 * self.noise + 0.6
    }

    /// What each sample of each ray would add to a line through it, into `self.table`.
    fn fill_table(&mut self, turn: &Turn) {
        let even = self.is_even();
        let stream = self.stream;
        let step_size = stream.map_or(6.0 * self.noise, |s| s.step);
        let [mut wet, mut far, mut sure, mut level, mut last, mut beyond, mut shown]: [Sums; 7] = [[0.0; SAMPLES + 1]; 7];
        let mean = |sums: &Sums, from: i32, to: i32| {
            let (from, to) = (from.clamp(0, SAMPLES as i32) as usize, to.clamp(0, SAMPLES as i32) as usize);
            (sums[to] - sums[from]) / (to - from).max(1) as f32
        };
        // Evidence of the memory, of the step, of the moved last picture; how much each counts.
        let mut known_says = [0.0f32; SAMPLES];
        let mut step_says = [0.0f32; SAMPLES];
        let mut last_says = [0.0f32; SAMPLES];
        let mut moving = [0.0f32; SAMPLES];
        for ray in 0..RAYS {
            let start = ray * SAMPLES;
            for r in 0..SAMPLES {
                let i = start + r;
                let known = self.sureness[i] > 0.0;
                let how_wet = if known { ((self.away[i] - WET_FROM) / WET_SPAN).clamp(-1.0, 1.0) } else { 0.0 };
                wet[r + 1] = wet[r] + how_wet;
                far[r + 1] = far[r] + how_wet.max(0.0);
                sure[r + 1] = sure[r] + if known { 1.0 } else { 0.0 };
                level[r + 1] = level[r] + self.levels[i];
                let unexplained = self.shown[i] * ((self.away_last[i] - 2.0) / 2.0).clamp(-1.0, 1.0);
                last[r + 1] = last[r] + unexplained;
                beyond[r + 1] = beyond[r] + unexplained.max(0.0);
                shown[r + 1] = shown[r] + self.shown[i];
            }
            for r in 0..SAMPLES {
                let (i, at) = (start + r, r as i32);
                let cell = &mut self.table[i];
                cell.band = mean(&level, at - 2, at);
                cell.step = mean(&level, at + 1, at + 3) - cell.band;
                cell.unexplained = mean(&last, at - 3, at + 3);
                cell.shown = mean(&shown, at - 3, at + 3);
                cell.known = (mean(&sure, at - 4, at) + mean(&sure, at + 1, at + 7)) / 2.0;
                step_says[r] = ((cell.step.abs() - STEP_FROM * step_size) / (STEP_SPAN * step_size)).clamp(-1.0, 1.0);
                known_says[r] =
                    (1.3 * mean(&wet, at - 4, at) - 0.5 * mean(&wet, at + 1, at + 7) - mean(&far, at + 2, at + 25)).clamp(-1.0, 1.5);
                let place = self.places[i];
                let to = turn.forth(place);
                let speed = (to[0] - place[0]).hypot(to[1] - place[1]);
                last_says[r] = 0.65 * cell.unexplained - BEYOND * mean(&beyond, at + 3, at + 12);
                moving[r] = ((speed - MOVES_PX) / MOVES_PX).clamp(0.0, 1.0) * cell.shown;
            }
            // The outline is a little curved: a neighbour counts too.
            let around =
                |values: &[f32; SAMPLES], r: usize| values[r.saturating_sub(1)].max(values[r]).max(values[(r + 1).min(SAMPLES - 1)]);
            for r in 0..SAMPLES {
                let step = around(&step_says, r);
                let cell = &mut self.table[start + r];
                let by_memory = if even && cell.known < 0.5 { step } else { around(&known_says, r) };
                if even {
                    cell.known = 1.0;
                }
                let by_last = (1.0 - 0.5 * moving[r]) * 0.9 * step + moving[r] * last_says[r];
                cell.value = if stream.is_some() {
                    cell.known * by_memory + (1.0 - cell.known) * by_last
                } else {
                    // To begin, only what the moved last picture shows counts beside the memory.
                    let weight = (1.0 - cell.known) * moving[r] * UNKNOWN_WEIGHT;
                    let value = cell.known * by_memory + weight * by_last;
                    cell.known += weight;
                    value
                };
            }
        }
    }

    /// The best line and its figures.
    fn best_line(&self) -> Option<Found> {
        let before = self.stream.map(|s| s.legs.map(f32::ln));
        let mut best: Option<Found> = None;
        for line in 0..self.legs.len() {
            let [p, q] = self.log_legs[line];
            let apart = before.map_or(0.0, |[a, b]| (p - a) * (p - a) + (q - b) * (q - b));
            if apart > JUMP_MOST * JUMP_MOST {
                continue;
            }
            let range = line * RAYS..(line + 1) * RAYS;
            let mut found = Found { line, ..Found::default() };
            let (mut band_square, mut shares) = (0.0, 0.0);
            for (at, weight) in self.cells[range.clone()].iter().zip(&self.weights[range]) {
                let cell = &self.table[usize::from(*at)];
                found.score += weight * cell.value;
                found.known += weight * cell.known;
                found.band += weight * cell.band;
                found.step += weight * cell.step.abs();
                band_square += weight * cell.band * cell.band;
                shares += match self.stream {
                    Some(_) if cell.value > PIECE => *weight,
                    None if cell.value > PIECE * cell.known => weight * cell.known,
                    _ => 0.0,
                };
            }
            let outer = OUTERMOST * 0.5 * (p + q);
            match self.stream {
                None => {
                    if found.known < BEGIN[2] {
                        continue;
                    }
                    found.score /= found.known;
                    found.share = shares / found.known;
                    found.total = outer + found.score + 0.7 * found.share;
                }
                Some(stream) => {
                    // Along the outline the same room is seen, whatever stands behind.
                    let spread = (band_square - found.band * found.band).max(0.0);
                    let unit = 0.5 * found.step + 2.0 * self.noise;
                    let change = (found.band - stream.band) / unit;
                    let alike = BAND * ((-spread / (unit * unit)).exp() - 1.0) + BAND * ((-change * change).exp() - 1.0);
                    found.evidence = found.score;
                    found.score += (1.0 - found.known) * alike;
                    found.share = shares;
                    let stay = STAY * (-0.5 * apart / (STAY_WIDTH * STAY_WIDTH)).exp();
                    found.total = outer + found.score + 0.7 * found.share + stay;
                }
            }
            if best.is_none_or(|b| found.total > b.total) {
                best = Some(found);
            }
        }
        best
    }

    /// What the moved last picture says of a line: how far the background moves across it, px a frame, the share of it that the
    /// picture shows, and how little it explains, -1 to 1.
    fn across(&self, line: usize) -> [f32; 3] {
        let turn = Turn::new(&self.motion, self.size, 1.0);
        let [a, b] = self.legs[line];
        let along = [0, 1].map(|k| b * self.axes.y[k] - a * self.axes.x[k]);
        let length = along[0].hypot(along[1]);
        let range = line * RAYS..(line + 1) * RAYS;
        let (mut moves, mut shown, mut unexplained) = (0.0, 0.0, 0.0);
        for (at, weight) in self.cells[range.clone()].iter().zip(&self.weights[range]) {
            let (place, cell) = (self.places[usize::from(*at)], &self.table[usize::from(*at)]);
            let to = turn.forth(place);
            moves += weight * ((to[1] - place[1]) * along[0] - (to[0] - place[0]) * along[1]).abs() / length;
            shown += weight * cell.shown;
            unexplained += weight * cell.unexplained;
        }
        [moves, shown, unexplained / shown.max(0.05)]
    }

    /// Whether a stream is seen, and where.
    fn decide(&mut self) -> Seen {
        let mut seen = Seen::Dry;
        let (mut background, mut surely_dry) = (false, false);
        if let Some(found) = self.best_line() {
            let [moves, shown, unexplained] = self.across(found.line);
            let tells = moves > TELLS_PX && shown > 0.5;
            background = tells && unexplained < EXPLAINED;
            surely_dry = found.known > GO_ON[1] && found.score < HELD;
            let enough = match self.stream {
                Some(_) => {
                    let least = GO_ON[0] * (1.0 - found.known) + GO_ON[1] * found.known;
                    (tells && unexplained > UNEXPLAINED && found.evidence > HELD) || (found.score > least && found.share > GO_ON[2])
                }
                None => found.score > BEGIN[0] && found.share > BEGIN[1],
            };
            if self.stream.is_none() && self.strange > STRANGE {
                seen = Seen::Unsure;
            } else if enough && !background {
                let mix = |before: f32, now: f32, share: f32| before + share * (now - before);
                let (band, step) =
                    self.stream.map_or((found.band, found.step), |s| (mix(s.band, found.band, 0.5), mix(s.step, found.step, 0.4)));
                self.stream = Some(Stream { legs: self.legs[found.line], band, step });
                self.last_legs = self.legs[found.line];
                self.find_edges(found.line);
                seen = Seen::Stream(found.share.min(1.0));
            }
        }
        match seen {
            Seen::Stream(_) => self.dry_frames = 0,
            _ => {
                self.dry_frames = self.dry_frames.saturating_add(1);
                if seen == Seen::Unsure {
                    return seen;
                }
                // One frame of grace: a stream that is lost once may be there again, and is not taken for background.
                if self.stream.is_some() && self.dry_frames == 1 && !(background || surely_dry) {
                    seen = Seen::Unsure;
                } else {
                    self.stream = None;
                }
            }
        }
        seen
    }

    /// Takes what is dry now over into the memory.
    fn remember(&mut self) -> opencv::Result<()> {
        let flows = self.stream.is_some();
        let near = self.dry_frames <= AFTERWARDS;
        let [a, b] = self.last_legs.map(|v| v.max(1.0));
        let bulge = 2.0 + 0.1 * (a * b).sqrt();
        let [above, right, inner] = self.planes([a + 1.4 * bulge, b + 1.4 * bulge]);
        let [.., outer] = self.planes([1.35 * a + 8.0, 1.35 * b + 8.0]);
        let gain = 1.0 + self.motion.exposure;
        let turn = Turn::new(&self.motion, self.size, 1.0);
        let now = self.now.data_bytes()?;
        let (width, height, calm) = (self.size.width as usize, self.size.height as usize, CALM * self.noise);
        let memory = self.memory.data_bytes()?;
        let (x_most, y_most) = (width as f32 - 1.01, height as f32 - 1.01);
        // One pass that moves and updates: OpenCV's warp of two channels alone takes longer.
        for (y, row) in self.moved.data_bytes_mut()?.chunks_exact_mut(2 * width).enumerate() {
            let value = |plane: [f32; 3]| plane[0] + plane[2] * y as f32;
            let (mut above_at, mut right_at, mut inner_at, mut outer_at) = (value(above), value(right), value(inner), value(outer));
            let mut from = turn.back([0.0, y as f32]);
            for (pixel, seen) in row.chunks_exact_mut(2).zip(&now[y * width..(y + 1) * width]) {
                let ([x, y], is_air) = (from, above_at >= RIM_PX);
                let left = right_at < 1.0;
                let (inside, close) = (near && (left || inner_at < 1.0), near && (left || outer_at < 1.0));
                from = [from[0] + turn.cos, from[1] - turn.sin];
                (above_at, right_at) = (above_at + above[1], right_at + right[1]);
                (inner_at, outer_at) = (inner_at + inner[1], outer_at + outer[1]);
                if !is_air {
                    pixel.copy_from_slice(&[*seen, 0]);
                    continue;
                }
                let (mut level, mut sure) = (0.0, 0.0);
                if x >= 0.0 && y >= 0.0 && x < x_most && y < y_most {
                    let (column, row) = (x as u32, y as u32);
                    let (fx, fy) = (x - column as f32, y - row as f32);
                    let corner = 2 * (row as usize).wrapping_mul(width).wrapping_add(column as usize);
                    let (upper, lower) = (&memory[corner..][..4], &memory[corner.wrapping_add(2 * width)..][..4]);
                    let mix = |k: usize| {
                        let (a, b, c, d) = (f32::from(upper[k]), f32::from(upper[k + 2]), f32::from(lower[k]), f32::from(lower[k + 2]));
                        let (top, bottom) = (a + (b - a) * fx, c + (d - c) * fx);
                        top + (bottom - top) * fy
                    };
                    (level, sure) = (mix(0) * gain, mix(1));
                }
                let known = sure >= f32::from(KNOWN);
                let away = f32::from(*seen) - level;
                let fits = away.abs() < calm;
                let kept = if known && ((fits && !(inside && flows)) || !close) {
                    [level + if fits { FOLLOW } else { FOLLOW_SLOWLY } * away + 0.5, 255.0]
                } else if !(known || flows && close) {
                    [f32::from(*seen), 255.0]
                } else {
                    [level + 0.5, FADE * sure]
                };
                pixel.copy_from_slice(&kept.map(|v| v as u8));
            }
        }
        std::mem::swap(&mut self.memory, &mut self.moved);
        Ok(())
    }

    /// The edge on each ray near `line`, into `self.edges`.
    fn find_edges(&mut self, line: usize) {
        for ray in 1..RAYS - 1 {
            let middle = usize::from(self.cells[line * RAYS + ray]) - ray * SAMPLES;
            let reach = 2.max((0.08 * middle as f32) as usize);
            let row = &self.table[ray * SAMPLES..][..SAMPLES];
            let range = middle.saturating_sub(reach)..(middle + reach + 1).min(SAMPLES);
            let best = range.clone().map(|i| row[i].value).fold(f32::MIN, f32::max);
            // Equal neighbours: the middle of them. Without an edge here, the line itself.
            let (mut sum, mut count) = (0usize, 0usize);
            for i in range.filter(|i| best > PIECE && row[*i].value >= best - 1e-6) {
                (sum, count) = (sum + i, count + 1);
            }
            let sample = if count == 0 { middle as f32 } else { sum as f32 / count as f32 };
            let radius = NEAR_PX + sample + 0.5;
            let full = |k: usize| (self.axes.lip_px[k] + radius * self.directions[ray][k] + 0.5) * self.scale - 0.5;
            self.edges.push([full(0), full(1)]);
        }
    }
}
