//! Clear water: told from the background by what does not move with it.
//!
//! Water has no colour, but it bends light: its outline shows a band of the room instead of what stands behind, and inside it the
//! background is displaced. The container turns, so the background moves in the picture as one rigid piece, while the stream's
//! outline stays. Hence, at 320 px for the whole width:
//!
//! 1. The dry background is **remembered** in colour as one picture that is fixed in the world. How the world lies in the camera's picture
//!    now (shift, turn, exposure) follows from a few hundred dry points of it (Gauss-Newton with robust weights, coarse then fine).
//! 2. The memory and the last picture, both moved, are compared with the picture along rays from the lip. What differs from the memory
//!    is wet. Where the ground was hidden until now, or is as bright as the water's rim, a step counts that the last picture, moved,
//!    does not explain.
//! 3. Of about 1,000 **lines** from axis to axis the best has most of this just inside and none outside. A line goes on near where it was,
//!    in the same shape and with the same band along it; one that moves with the background is none. Beginning a stream takes more than
//!    going on. The full picture's profiles across it must confirm it ([`Background::confirm`]).
//!
//! The first frame must be dry. Runs on the extraction thread; all pictures and tables are kept, nothing is allocated after the second
//! frame. No failures but OpenCV's.

use opencv::core::{self, Mat, Size};
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
/// Lines that are tried: distances on either axis in geometric steps, and the largest ratios of the two.
const LEGS: usize = 46;
const LEG_FIRST_PX: f32 = 6.5;
const LEG_FACTOR: f32 = 1.07;
const LEGS_FLAT: f32 = 4.0;
const LEGS_STEEP: f32 = 2.0;
/// Points for the motion: one, the one with the steepest slope, in each square of this many px.
const SQUARE: usize = 10;
/// Room in the memory around the region, squares.
const ROOM_SQUARES: usize = 4;
/// Of the memory every so many rows, and of its squares every so many rows, are looked at in a frame.
const REFRESH: usize = 4;
const MARK_EVERY: usize = 4;
/// Fewer points tell no motion.
const POINTS_LEAST: usize = 30;
/// The motion is looked for from rest too when it leaves this much more unexplained than the last one did.
const LEFT_GROWS: f32 = 1.2;
/// Least noise, grey levels (rounding), and as a share of the background's brightness (the exposure is not known better).
const NOISE_LEAST: f32 = 0.8;
const NOISE_SHARE: f32 = 0.012;
/// Noise in units of the median difference.
const NOISE_MEDIANS: f32 = 1.1;
/// Share of the background's slope that counts as error of its place: fresh, and more as the memory fades.
const SLOPE_FRESH: f32 = 0.2;
const SLOPE_FADED: f32 = 0.5;
/// Difference in units of the noise: from here on it is wet, and fully so this much further on; dry as much before.
const WET_FROM: f32 = 2.2;
const WET_SPAN: f32 = 2.0;
/// A difference up to this, in units of the noise, is still background.
const CALM: f32 = 5.0;
/// Sureness of the memory, 0 to 255: known from here on; left when a row's turn comes and the place is hidden.
const KNOWN: f32 = 50.0;
const FADE: f32 = 0.94;
/// Background that moves by more than this is told from what stands still, px a frame.
const MOVES_PX: f32 = 1.2;
/// A step in brightness counts from this share of the stream's usual one on, fully this much further on.
const STEP_FROM: f32 = 0.35;
const STEP_SPAN: f32 = 0.3;
/// Weight of a moved picture's evidence where the memory knows nothing, to begin a stream.
const UNKNOWN_WEIGHT: f32 = 0.5;
/// Least score, share of the line's length with an edge, and share of it on known ground to begin a stream.
const BEGIN: [f32; 3] = [0.7, 0.6, 0.45];
/// On known ground the least score to begin is less by this.
const BEGIN_KNOWN: f32 = 0.25;
/// Least score to go on: on unknown ground and on known ground; least share of the line's length.
const GO_ON: [f32; 3] = [0.45, 0.5, 0.6];
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
/// Weight of being like the last line: as Gaussians of the logarithms of its size (root of the legs' product; with a limit) and of its
/// shape (their ratio: wider for a stream that was seen once; the limit is 2.5 of it).
const STAY: f32 = 0.4;
const GROWS: f32 = 0.25;
const GROWS_MOST: f32 = 0.7;
const TURNS: f32 = 0.2;
const TURNS_YOUNG: f32 = 0.3;
/// Weight of an even band along the line, and of the same band as before.
const BAND: f32 = 0.5;
/// Far from the lip, no more of the background than this differs from the memory, or it is another picture.
const STRANGE: f32 = 0.3;
/// Frames of another picture after which it is the background.
const STRANGE_FRAMES: u32 = 15;
/// Weight of what is wet just inside a line, and just outside.
const WET_INSIDE: f32 = 1.3;
const WET_OUTSIDE: f32 = 0.5;
/// How fast the memory follows what is seen: where it fits and where it does not.
const FOLLOW: f32 = 0.35;
const FOLLOW_SLOWLY: f32 = 0.1;
/// The full picture's line is the same when ratio and product of its legs differ by no more than this (as logarithms), and its step
/// has at least this share of the usual height.
const SHAPE_MOST: f32 = 0.7;
const SIZE_MOST: f32 = 1.0;
const HEIGHT_LEAST: f32 = 0.3;
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

/// Motion of the background from frame to frame: shift in px, turn in radians about the region's middle.
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

/// The stream as it was last seen.
#[derive(Debug, Clone, Copy)]
struct Stream {
    legs: [f32; 2],
    /// Frames for which it has been seen.
    age: f32,
    /// Height of the step along it in the full picture, grey levels.
    height: f32,
    /// Mean colour of the band along its outline, and last the mean step there, grey levels.
    band: Colour,
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
    band: Colour,
}

/// What is known of one sample of one ray.
#[derive(Debug, Clone, Copy, Default)]
struct Cell {
    /// What it adds to a line through it, and the share of that which rests on known ground.
    value: f32,
    known: f32,
    /// Colour just inside, and last the size of the step to just outside.
    band: Colour,
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
    now: Vec<Colour>,
    last: Vec<Colour>,
    grey: Mat,
    now_half: Mat,
    /// The dry background, a square fixed in the world: colour at the first picture's exposure, and last its sureness, 0 to 255.
    side: usize,
    memory: Vec<Colour>,
    /// Where it is built anew when the picture comes near its border.
    spare: Vec<Colour>,
    /// Its points for the motion by squares, and as they lay in the last picture.
    corners: Vec<Option<Mark>>,
    marks: Vec<Mark>,
    /// From the memory to the picture, now and before; exposure against the memory; the last motion.
    pose: Turn,
    last_pose: Turn,
    /// The picture in the memory's middle.
    home: Turn,
    gain: f32,
    last_gain: f32,
    motion: Motion,
    frame: usize,
    /// Mean size of what the last motion left unexplained, grey levels.
    left: f32,
    table: Vec<Cell>,
    // Along all rays: brightness; difference from the memory and from the last picture in units of the noise; slope; sureness.
    levels: Vec<Colour>,
    differs: Vec<Colour>,
    differs_last: Vec<Colour>,
    away: Vec<f32>,
    away_last: Vec<f32>,
    slopes: Vec<f32>,
    sureness: Vec<f32>,
    shown: Vec<f32>,
    noise: f32,
    /// Share of the known background far from the lip that differs from the memory.
    strange: f32,
    /// Frames in a row with too much of that.
    strange_frames: u32,
    stream: Option<Stream>,
    /// Where it last was, and for how many frames it has not been seen.
    last_legs: [f32; 2],
    dry_frames: u32,
    /// Lines in a row that the full picture did not confirm.
    refuted: u32,
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

/// Blue, green, red, and one more: four for the processor's sake.
type Colour = [f32; 4];

#[inline(always)]
fn each(f: impl Fn(usize) -> f32) -> Colour {
    [f(0), f(1), f(2), f(3)]
}

/// Size of a difference of colours, grey levels: that of an equal difference of all three.
#[inline(always)]
fn size_of(c: &Colour) -> f32 {
    ((c[0] * c[0] + c[1] * c[1] + c[2] * c[2]) / 3.0).sqrt()
}

/// Between four neighbours.
#[inline(always)]
fn mix([a, b, c, d]: [Colour; 4], fx: f32, fy: f32) -> Colour {
    let top = each(|k| a[k] + (b[k] - a[k]) * fx);
    let bottom = each(|k| c[k] + (d[k] - c[k]) * fx);
    each(|k| top[k] + (bottom[k] - top[k]) * fy)
}

/// A picture with its size.
#[derive(Clone, Copy)]
struct Picture<'a> {
    pixels: &'a [Colour],
    width: usize,
    height: usize,
}

impl Picture<'_> {
    /// Bilinear sample; none outside.
    #[inline(always)]
    fn at(&self, x: f32, y: f32) -> Option<Colour> {
        let (column, row, fx, fy) = between(x, y, self.width, self.height)?;
        let upper = self.pixels.get(row * self.width + column..)?;
        let lower = upper.get(self.width..self.width + 2)?;
        Some(mix([upper[0], upper[1], lower[0], lower[1]], fx, fy))
    }
}

/// A rigid map.
#[derive(Debug, Clone, Copy)]
struct Turn {
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

    #[inline]
    fn along(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        [self.cos * x - self.sin * y, self.sin * x + self.cos * y]
    }

    #[inline]
    fn forth(&self, at: [f32; 2]) -> [f32; 2] {
        let [x, y] = self.along(at);
        [x + self.shift[0], y + self.shift[1]]
    }

    #[inline]
    fn back(&self, [x, y]: [f32; 2]) -> [f32; 2] {
        let (x, y) = (x - self.shift[0], y - self.shift[1]);
        [self.cos * x + self.sin * y, -self.sin * x + self.cos * y]
    }

    fn inverse(&self) -> Self {
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

/// Where a linear function that is `value` at 0 and changes by `slope` a step is at least `least`, cut out of `from..to`.
fn at_least(value: f32, slope: f32, least: f32, [from, to]: [f32; 2]) -> [f32; 2] {
    if slope.abs() < 1e-6 {
        return if value >= least { [from, to] } else { [0.0, 0.0] };
    }
    let cut = (least - value) / slope;
    if slope > 0.0 { [from.max(cut), to] } else { [from, to.min(cut)] }
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
            if a / b > LEGS_FLAT || b / a > LEGS_STEEP {
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
        // Room for the region turned by any angle, and moved a little.
        let squares = ((size.width as f32).hypot(size.height as f32) / SQUARE as f32).ceil() as usize + 2 * ROOM_SQUARES;
        let side = squares * SQUARE;
        let home = Turn { cos: 1.0, sin: 0.0, shift: [size.width, size.height].map(|v| 0.5 * (v as f32 - side as f32)) };
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
            now: vec![[0.0; 4]; size.area() as usize],
            last: vec![[0.0; 4]; size.area() as usize],
            grey: Mat::default(),
            now_half: Mat::default(),
            side,
            memory: vec![[0.0; 4]; side * side],
            spare: vec![[0.0; 4]; side * side],
            corners: vec![None; squares * squares],
            marks: Vec::with_capacity(squares * squares),
            pose: home,
            last_pose: home,
            home,
            gain: 1.0,
            last_gain: 1.0,
            motion: Motion::default(),
            frame: 0,
            left: 0.0,
            table: vec![Cell::default(); CELLS],
            levels: vec![[0.0; 4]; CELLS],
            differs: vec![[0.0; 4]; CELLS],
            differs_last: vec![[0.0; 4]; CELLS],
            away: rows(),
            away_last: rows(),
            slopes: rows(),
            sureness: rows(),
            shown: rows(),
            noise: NOISE_LEAST,
            strange: 0.0,
            strange_frames: 0,
            stream: None,
            last_legs: [0.0; 2],
            dry_frames: AFTERWARDS + 1,
            refuted: 0,
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

    /// The colour of the dry background at a place of the region, px, where it is known; and the noise, grey levels.
    pub fn dry_at(&self, [x, y]: [f32; 2]) -> Option<[f32; 3]> {
        let small = |v: f32| (v + 0.5) / self.scale - 0.5;
        let [x, y] = self.pose.back([small(x), small(y)]);
        let (column, row, fx, fy) = between(x, y, self.side, self.side)?;
        let corner = row * self.side + column;
        let four = [corner, corner + 1, corner + self.side, corner + self.side + 1].map(|i| self.memory[i]);
        let [b, g, r, _] = mix(four, fx, fy);
        four.iter().all(|c| c[3] >= KNOWN).then(|| [b, g, r].map(|v| v * self.gain))
    }

    /// The colour of the stream's rim as it was last seen.
    pub fn rim(&self) -> Option<[f32; 3]> {
        self.stream.map(|s| [s.band[0], s.band[1], s.band[2]])
    }

    /// The noise of small pixels, grey levels.
    pub fn noise(&self) -> f32 {
        self.noise
    }

    /// Whether the stream was not there before the last picture.
    pub fn begins(&self) -> bool {
        self.stream.is_some_and(|s| s.age <= 1.0)
    }

    /// What the full picture says of the line: its legs, px, and the height of the step along it, grey levels; none without a step.
    /// Whether it is the stream that was seen: one does not lose its contrast, nor change its shape.
    pub fn confirm(&mut self, fine: Option<([f32; 2], f32)>) -> bool {
        let Some(stream) = &mut self.stream else { return false };
        let young = stream.age <= 1.0;
        let good = fine.is_some_and(|(legs_px, height)| {
            let [a, b] = [0, 1].map(|k| (legs_px[k] / self.scale / stream.legs[k]).ln());
            (a - b).abs() < SHAPE_MOST && (a + b).abs() < SIZE_MOST && (young || height > HEIGHT_LEAST * stream.height)
        });
        match fine {
            Some((legs_px, height)) if good => {
                stream.legs = legs_px.map(|v| v / self.scale);
                stream.height = if young { height } else { stream.height + 0.3 * (height - stream.height) };
                self.refuted = 0;
            }
            _ => {
                self.refuted += 1;
                if young || self.refuted > 1 {
                    self.stream = None;
                    self.dry_frames = 1;
                }
            }
        }
        good
    }

    /// Takes the next picture: the region in colour, at full size.
    pub fn take(&mut self, region: &impl core::ToInputArray) -> opencv::Result<()> {
        std::mem::swap(&mut self.now, &mut self.last);
        // The middle four of each block's pixels: half of the memory of a large picture is never read.
        imgproc::resize(region, &mut self.small, self.size, 0.0, 0.0, imgproc::INTER_LINEAR)?;
        for (pixel, bytes) in self.now.iter_mut().zip(self.small.data_bytes()?.chunks_exact(3)) {
            *pixel = [f32::from(bytes[0]), f32::from(bytes[1]), f32::from(bytes[2]), 0.0];
        }
        Ok(())
    }

    /// The picture that was taken, small, in colour.
    pub fn small(&self) -> &Mat {
        &self.small
    }

    /// Looks at the picture that was taken.
    pub fn look(&mut self) -> opencv::Result<Seen> {
        self.edges.clear();
        let mut seen = Seen::Dry;
        if self.frame > 0 {
            self.register()?;
            self.compare();
            self.fill_table();
            seen = self.decide();
            self.strange_frames = if self.strange > STRANGE { self.strange_frames + 1 } else { 0 };
            if self.strange_frames > STRANGE_FRAMES {
                // It stays another picture: what stands there now is the background.
                self.forget();
            }
            self.keep_inside();
        }
        self.remember();
        self.frame += 1;
        Ok(seen)
    }

    /// Starts anew, as from a first picture.
    fn forget(&mut self) {
        self.memory.fill([0.0; 4]);
        self.corners.fill(None);
        (self.pose, self.gain, self.motion) = (self.home, 1.0, Motion::default());
        (self.frame, self.strange_frames, self.stream, self.dry_frames) = (0, 0, None, AFTERWARDS + 1);
    }

    /// Copies the memory to its own middle when the picture comes near its border.
    fn keep_inside(&mut self) {
        let [x, y] = self.pose.back(self.middle());
        let middle = 0.5 * self.side as f32;
        let most = ((ROOM_SQUARES - 1) * SQUARE) as f32;
        if (x - middle).abs().max((y - middle).abs()) < most {
            return;
        }
        let old = Picture { pixels: &self.memory, width: self.side, height: self.side };
        for (i, pixel) in self.spare.iter_mut().enumerate() {
            let from = self.pose.back(self.home.forth([(i % self.side) as f32, (i / self.side) as f32]));
            *pixel = old.at(from[0], from[1]).unwrap_or_default();
        }
        std::mem::swap(&mut self.memory, &mut self.spare);
        // What the last picture saw there is found with the same change.
        let change = self.pose.inverse().after(&self.home);
        (self.last_pose, self.pose) = (self.last_pose.after(&change), self.home);
        self.corners.fill(None);
        for row in 0..MARK_EVERY {
            self.mark_corners(row);
        }
    }

    fn middle(&self) -> [f32; 2] {
        [self.size.width, self.size.height].map(|v| v as f32 / 2.0)
    }

    /// The background's motion since the last picture, into `self.motion`, `self.pose` and `self.gain`.
    fn register(&mut self) -> opencv::Result<()> {
        let half = Size::new(self.size.width / 2, self.size.height / 2);
        imgproc::cvt_color_def(&self.small, &mut self.grey, imgproc::COLOR_BGR2GRAY)?;
        imgproc::resize(&self.grey, &mut self.now_half, half, 0.0, 0.0, imgproc::INTER_AREA)?;
        let flows = self.stream.is_some();
        let [above, right, inside] = self.planes(self.stream.map_or([1.0, 1.0], |s| s.legs.map(|v| v + 5.0)));
        (self.last_pose, self.last_gain) = (self.pose, self.gain);
        self.marks.clear();
        for mark in self.corners.iter().flatten() {
            let [x, y] = self.pose.forth(mark.at);
            let value = |plane: [f32; 3]| plane[0] + plane[1] * x + plane[2] * y;
            let water = flows && (value(inside) <= 1.0 || value(right) < 1.0);
            if value(above) >= RIM_PX + 2.0
                && !water
                && x >= 2.0
                && y >= 2.0
                && x < self.size.width as f32 - 3.0
                && y < self.size.height as f32 - 3.0
            {
                self.marks.push(Mark { at: [x, y], slopes: mark.slopes.map(|s| self.pose.along(s)), ..*mark });
            }
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
        self.pose = Turn::new(self.motion.turn, self.motion.shift, self.middle()).after(&self.last_pose);
        Ok(())
    }

    /// At half the working size (`fine` 0) or at the working size (1): improves `motion` so that the memory, moved, becomes what is
    /// seen now. Returns it, the exposure and the mean size of what is left, grey levels.
    fn improve(&mut self, fine: usize, mut motion: Motion, before: Motion) -> opencv::Result<(Motion, f32, f32)> {
        let picture = [&self.now_half, &self.grey][fine];
        let (now, width, height) = (picture.data_bytes()?, picture.cols() as usize, picture.rows() as usize);
        let (scale, corner) = [(0.5, -0.25), (1.0, 0.0)][fine];
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
            if change[0].abs() + change[1].abs() < 0.05 && change[2].abs() < 0.0005 {
                break;
            }
        }
        Ok((motion, gain, left))
    }

    /// Compares the memory and the last picture, both moved, with what is seen now, along the rays.
    fn compare(&mut self) {
        let (width, height) = (self.size.width as usize, self.size.height as usize);
        let (now, last) = (Picture { pixels: &self.now, width, height }, Picture { pixels: &self.last, width, height });
        let [above, ..] = self.planes([1.0, 1.0]);
        let (pose, gain, side) = (self.pose, self.gain, self.side);
        let (mut level_sum, mut level_count) = (0.0, 0.0f32);
        let most = side as f32 - 2.5;
        for i in 0..CELLS {
            let [x, y] = self.places[i];
            let seen = now.at(x, y).unwrap_or_default();
            self.levels[i] = seen;
            (self.sureness[i], self.shown[i], self.slopes[i], self.differs[i], self.differs_last[i]) = (0.0, 0.0, 0.0, [0.0; 4], [0.0; 4]);
            let from = pose.back([x, y]);
            if !(self.air[i] && from[0] >= 1.0 && from[1] >= 1.0 && from[0] < most && from[1] < most) {
                continue;
            }
            let (column, row) = (from[0] as usize, from[1] as usize);
            let corner = row * side + column;
            // The memory between its pixels, and its slope.
            let (fx, fy) = (from[0] - column as f32, from[1] - row as f32);
            let (upper, lower) = (&self.memory[corner..corner + 2], &self.memory[corner + side..corner + side + 2]);
            let remembered = mix([upper[0], upper[1], lower[0], lower[1]], fx, fy);
            self.differs[i] = each(|k| seen[k] - gain * remembered[k]);
            let (across, down) = (
                each(|k| upper[1][k] - upper[0][k] + lower[1][k] - lower[0][k]),
                each(|k| lower[0][k] - upper[0][k] + lower[1][k] - upper[1][k]),
            );
            self.slopes[i] = 0.5 * gain * size_of(&across).max(size_of(&down));
            let sure = upper[0][3].min(upper[1][3]).min(lower[0][3]).min(lower[1][3]);
            self.sureness[i] = if sure >= KNOWN { sure / 255.0 } else { 0.0 };
            let [x, y] = self.last_pose.forth(from);
            let was_air = above[0] + above[1] * x + above[2] * y >= RIM_PX;
            if let Some(before) = if was_air { last.at(x, y) } else { None } {
                self.shown[i] = 1.0;
                let factor = gain / self.last_gain;
                self.differs_last[i] = each(|k| seen[k] - factor * before[k]);
            }
            if self.sureness[i] > 0.0 {
                level_sum += gain * (remembered[0] + remembered[1] + remembered[2]) / 3.0;
                level_count += 1.0;
            }
        }
        // Neighbours along a ray together.
        for (values, sizes) in [(&self.differs, &mut self.away), (&self.differs_last, &mut self.away_last)] {
            for (pair, size) in values.windows(2).zip(sizes) {
                *size = size_of(&each(|k| 0.5 * (pair[0][k] + pair[1][k])));
            }
        }
        // Noise: where the known background is even.
        self.scratch.clear();
        self.scratch.extend((0..CELLS).step_by(3).filter(|i| self.sureness[*i] > 0.0).map(|i| self.slopes[i]));
        let even = median(&mut self.scratch);
        self.scratch.clear();
        let known = (0..CELLS).step_by(3).filter(|i| self.sureness[*i] > 0.0 && self.slopes[*i] <= even);
        self.scratch.extend(known.map(|i| self.away[i]));
        let noise = if self.scratch.len() > 25 { NOISE_MEDIANS * median(&mut self.scratch) } else { 2.0 };
        self.noise = noise.max(NOISE_LEAST).max(NOISE_SHARE * level_sum / level_count.max(1.0));
        for i in 0..CELLS {
            let slope = self.slopes[i];
            let place = (SLOPE_FRESH + SLOPE_FADED * (1.0 - self.sureness[i])) * slope;
            self.away[i] = (self.away[i] - place).max(0.0) / self.noise;
            self.away_last[i] = (self.away_last[i] - 0.25 * slope).max(0.0) / self.noise;
        }
        let far = || (0..CELLS).filter(|i| i % SAMPLES >= SAMPLES / 2 && self.sureness[*i] > 0.0);
        self.strange = far().filter(|i| self.away[*i] > CALM).count() as f32 / far().count().max(1) as f32;
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
    fn fill_table(&mut self) {
        let turn = Turn::new(self.motion.turn, self.motion.shift, self.middle());
        let even = self.is_even();
        let stream = self.stream;
        let step_size = stream.map_or(6.0 * self.noise, |s| s.band[3]);
        let [mut wet, mut far, mut sure, mut last, mut beyond, mut shown]: [Sums; 6] = [[0.0; SAMPLES + 1]; 6];
        let mut level = [[0.0f32; 4]; SAMPLES + 1];
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
                let mut how_wet = if known { ((self.away[i] - WET_FROM) / WET_SPAN).clamp(-1.0, 1.0) } else { 0.0 };
                let mut tells = if known { 1.0 } else { 0.0 };
                if let Some(stream) = stream.filter(|_| known && how_wet < 0.0) {
                    // Where the ground is as bright as the water's rim, not to differ from it means nothing.
                    let apart = size_of(&each(|k| self.levels[i][k] - stream.band[k])) / self.noise;
                    tells = ((apart - WET_FROM) / WET_SPAN).clamp(0.0, 1.0);
                    how_wet *= tells;
                }
                wet[r + 1] = wet[r] + how_wet;
                far[r + 1] = far[r] + how_wet.max(0.0);
                sure[r + 1] = sure[r] + tells;
                level[r + 1] = each(|k| level[r][k] + self.levels[i][k]);
                let unexplained = self.shown[i] * ((self.away_last[i] - 2.0) / 2.0).clamp(-1.0, 1.0);
                last[r + 1] = last[r] + unexplained;
                beyond[r + 1] = beyond[r] + unexplained.max(0.0);
                shown[r + 1] = shown[r] + self.shown[i];
            }
            for r in 0..SAMPLES {
                let (i, at) = (start + r, r as i32);
                let cell = &mut self.table[i];
                let colour = |from: i32, to: i32| {
                    let (from, to) = (from.clamp(0, SAMPLES as i32) as usize, to.clamp(0, SAMPLES as i32) as usize);
                    let share = 1.0 / (to - from).max(1) as f32;
                    each(|k| share * (level[to][k] - level[from][k]))
                };
                let (inner, outer) = (colour(at - 2, at), colour(at + 1, at + 3));
                let step = size_of(&each(|k| outer[k] - inner[k]));
                cell.band = [inner[0], inner[1], inner[2], step];
                cell.unexplained = mean(&last, at - 3, at + 3);
                cell.shown = mean(&shown, at - 3, at + 3);
                cell.known = (mean(&sure, at - 4, at) + mean(&sure, at + 1, at + 7)) / 2.0;
                step_says[r] = ((step - STEP_FROM * step_size) / (STEP_SPAN * step_size)).clamp(-1.0, 1.0);
                known_says[r] =
                    (WET_INSIDE * mean(&wet, at - 4, at) - WET_OUTSIDE * mean(&wet, at + 1, at + 7) - mean(&far, at + 2, at + 25))
                        .clamp(-1.0, 1.5);
                let place = self.places[i];
                let to = turn.forth(place);
                let (dx, dy) = (to[0] - place[0], to[1] - place[1]);
                let speed = (dx * dx + dy * dy).sqrt();
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
        let turns = self.stream.map_or(0.0, |s| TURNS + TURNS_YOUNG / s.age);
        let mut best: Option<Found> = None;
        for line in 0..self.legs.len() {
            let [p, q] = self.log_legs[line];
            // A stream grows and shrinks fast, but hardly changes its shape from frame to frame.
            let (grown, turned) = before.map_or((0.0, 0.0), |[a, b]| (0.5 * (p + q - a - b), p - q - a + b));
            if grown.abs() > GROWS_MOST || turned.abs() > 2.5 * turns {
                continue;
            }
            let range = line * RAYS..(line + 1) * RAYS;
            let mut found = Found { line, ..Found::default() };
            let (mut band_square, mut shares) = (0.0, 0.0);
            for (at, weight) in self.cells[range.clone()].iter().zip(&self.weights[range]) {
                let cell = &self.table[usize::from(*at)];
                found.score += weight * cell.value;
                found.known += weight * cell.known;
                found.band = each(|k| found.band[k] + weight * cell.band[k]);
                let size = size_of(&cell.band);
                band_square += weight * size * size;
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
                    let size = size_of(&found.band);
                    let spread = (band_square - size * size).max(0.0);
                    let unit = 0.5 * found.band[3] + 2.0 * self.noise;
                    let change = size_of(&each(|k| found.band[k] - stream.band[k])) / unit;
                    let alike = BAND * ((-spread / (unit * unit)).exp() - 1.0) + BAND * ((-change * change).exp() - 1.0);
                    found.evidence = found.score;
                    found.score += (1.0 - found.known) * alike;
                    found.share = shares;
                    let square = |v: f32| v * v;
                    let stay = STAY * (-0.5 * (square(grown / GROWS) + square(turned / turns))).exp();
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
        let turn = Turn::new(self.motion.turn, self.motion.shift, self.middle());
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
                None => found.score > BEGIN[0] - BEGIN_KNOWN * found.known && found.share > BEGIN[1],
            };
            if self.stream.is_none() && self.strange > STRANGE {
                seen = Seen::Unsure;
            } else if enough && !background {
                let mix = |before: f32, now: f32, share: f32| before + share * (now - before);
                let band = self.stream.map_or(found.band, |s| each(|k| mix(s.band[k], found.band[k], if k < 3 { 0.5 } else { 0.4 })));
                let height = self.stream.map_or(0.0, |s| s.height);
                let age = self.stream.map_or(1.0, |s| s.age + 1.0);
                self.stream = Some(Stream { legs: self.legs[found.line], age, band, height });
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
    fn remember(&mut self) {
        let flows = self.stream.is_some();
        let near = self.dry_frames <= AFTERWARDS;
        let [a, b] = self.last_legs.map(|v| v.max(1.0));
        let bulge = 2.0 + 0.1 * (a * b).sqrt();
        let [above, right, inner] = self.planes([a + 1.4 * bulge, b + 1.4 * bulge]);
        let [.., outer] = self.planes([1.35 * a + 8.0, 1.35 * b + 8.0]);
        let (pose, gain, side) = (self.pose, self.gain, self.side);
        let (width, height, calm) = (self.size.width as usize, self.size.height as usize, CALM * self.noise / gain);
        let now = Picture { pixels: &self.now, width, height };
        for y in 0..side {
            let fresh = self.frame == 0 || y % REFRESH == self.frame % REFRESH;
            let from = pose.forth([0.0, y as f32]);
            let (value, slope) = (
                |plane: [f32; 3]| plane[0] + plane[1] * from[0] + plane[2] * from[1],
                |plane: [f32; 3]| plane[1] * pose.cos + plane[2] * pose.sin,
            );
            let span = at_least(value(above), slope(above), RIM_PX, [0.0, side as f32]);
            let span = at_least(from[0], pose.cos, 0.0, span);
            let span = at_least(-from[0], -pose.cos, 1.01 - width as f32, span);
            let span = at_least(from[1], pose.sin, 0.0, span);
            let [x0, x1] = at_least(-from[1], -pose.sin, 1.01 - height as f32, span);
            let (x0, x1) = (x0.ceil().max(0.0), x1.floor().min(side as f32));
            if x1 <= x0 {
                continue;
            }
            let at = |v: f32, slope: f32| v + slope * x0;
            let (mut right_at, mut inner_at, mut outer_at) =
                (at(value(right), slope(right)), at(value(inner), slope(inner)), at(value(outer), slope(outer)));
            let mut from = [at(from[0], pose.cos), at(from[1], pose.sin)];
            let cells = y * side + x0 as usize..y * side + x1 as usize;
            for kept in &mut self.memory[cells] {
                let left = right_at < 1.0;
                let (inside, close) = (near && (left || inner_at < 1.0), near && (left || outer_at < 1.0));
                let [x, y] = from;
                from = [x + pose.cos, y + pose.sin];
                (right_at, inner_at, outer_at) = (right_at + slope(right), inner_at + slope(inner), outer_at + slope(outer));
                if !fresh && kept[3] >= KNOWN {
                    continue;
                }
                let Some(seen) = now.at(x, y) else { continue };
                let known = kept[3] >= KNOWN;
                let away = each(|k| seen[k] / gain - kept[k]);
                let fits = size_of(&away) < calm;
                if known && ((fits && !(inside && flows)) || !close) {
                    let share = if fits { FOLLOW } else { FOLLOW_SLOWLY };
                    *kept = each(|k| kept[k] + share * away[k]);
                    kept[3] = 255.0;
                } else if !(known || flows && close) {
                    *kept = each(|k| kept[k] + away[k]);
                    kept[3] = 255.0;
                } else {
                    kept[3] *= FADE;
                }
            }
        }
        if self.frame == 0 {
            for row in 0..MARK_EVERY {
                self.mark_corners(row);
            }
        } else {
            self.mark_corners(self.frame % MARK_EVERY);
        }
    }

    /// Chooses the points for the motion anew in a part of the memory's squares: in each the one with the steepest slope.
    fn mark_corners(&mut self, part: usize) {
        let (side, squares) = (self.side, self.side / SQUARE);
        for row in (1..squares - 1).filter(|r| r % MARK_EVERY == part) {
            for column in 1..squares - 1 {
                let mut best: Option<(f32, [usize; 2])> = None;
                let grey = |x: usize, y: usize| {
                    let [b, g, r, _] = self.memory[y * side + x];
                    0.114 * b + 0.587 * g + 0.299 * r
                };
                for y in (row * SQUARE..(row + 1) * SQUARE).step_by(2) {
                    for x in (column * SQUARE..(column + 1) * SQUARE).step_by(2) {
                        let i = y * side + x;
                        if [i - 2 * side, i - 2, i + 2 * side, i + 2].iter().any(|i| self.memory[*i][3] < 200.0) {
                            continue;
                        }
                        let (across, down) = (grey(x + 1, y) - grey(x - 1, y), grey(x, y + 1) - grey(x, y - 1));
                        let steep = across * across + down * down;
                        if best.is_none_or(|(most, _)| steep > most) {
                            best = Some((steep, [x, y]));
                        }
                    }
                }
                let best = best.map(|(_, [x, y])| {
                    // Around it: rows of three.
                    let sum = |x: usize, y: usize, across: usize, down: usize| {
                        0.25 * grey(x - across, y - down) + 0.5 * grey(x, y) + 0.25 * grey(x + across, y + down)
                    };
                    let level = |x: usize, y: usize| 0.25 * sum(x, y - 1, 1, 0) + 0.5 * sum(x, y, 1, 0) + 0.25 * sum(x, y + 1, 1, 0);
                    let fine = [0.5 * (sum(x + 1, y, 0, 1) - sum(x - 1, y, 0, 1)), 0.5 * (sum(x, y + 1, 1, 0) - sum(x, y - 1, 1, 0))];
                    let coarse = [0.25 * (sum(x + 2, y, 0, 1) - sum(x - 2, y, 0, 1)), 0.25 * (sum(x, y + 2, 1, 0) - sum(x, y - 2, 1, 0))];
                    Mark { at: [x as f32, y as f32], levels: [level(x, y), grey(x, y)], slopes: [coarse, fine] }
                });
                self.corners[row * squares + column] = best;
            }
        }
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
