//! Clear water: told from the background by what does not move with it.
//!
//! Water has no colour, but it bends light: its outline shows a band of the room instead of what stands behind, and inside it the
//! background is displaced. The container turns, so the background moves in the picture as one rigid piece, while the stream's
//! outline stays. Hence, at 320 px for the whole width:
//!
//! 1. The dry background is **remembered** in colour as one picture that is fixed in the world (`ground.rs`).
//! 2. The memory and an earlier picture, both moved, are compared with the picture along rays from the lip. What differs from the memory
//!    is wet. Where the ground was hidden until now, or is as bright as the water's rim, a step counts that the earlier picture, moved,
//!    does not explain.
//! 3. Of about 800 **lines** from axis to axis the best has most of this just inside and none outside. A line goes on near where it was,
//!    in the same shape and with the same band along it; one that moves with the background, or is at rest with it, is none. Beginning
//!    a stream takes more than going on. The full picture's profiles across it must confirm it ([`ClearWater::confirm`]).
//!
//! The first frame must be dry. Runs on the extraction thread; all pictures and tables are kept, nothing is allocated after the second
//! frame. No failures but OpenCV's.

use opencv::core::{self, CV_16SC2, CV_32FC1, Mat, Scalar, Size, Vec4b};
use opencv::imgproc;
use opencv::prelude::*;

use crate::extract::{Axes, REACH};
use crate::ground::{Dry, Ground, Plane, Wet, median};

/// Width of the whole picture at which this works, px; all lengths below are px at that size.
const WIDTH_PX: f32 = 320.0;
/// Air begins this far above the top edge: the rim's light spreads.
const RIM_PX: f32 = 1.5;
/// Rays between the axes, and samples on each, from [`NEAR_PX`] on: 1 px apart up to [`DENSE_PX`], then in proportion to their distance.
const RAYS: usize = 24;
const SAMPLES: usize = 96;
const CELLS: usize = RAYS * SAMPLES;
const NEAR_PX: f32 = 1.0;
const DENSE_PX: f32 = 48.0;
/// Within this distance from the lip the ground tells whether it is even; beyond it, whether it is another picture.
const MIDDLE_PX: f32 = 60.0;
/// Lines that are tried: distances on either axis in geometric steps, and the largest ratios of the two.
const LEGS: usize = 41;
const LEG_FIRST_PX: f32 = 6.5;
const LEG_FACTOR: f32 = 1.08;
const LEGS_FLAT: f32 = 4.0;
const LEGS_STEEP: f32 = 2.0;
/// Least noise, grey levels (rounding), and as a share of the background's brightness (the exposure is not known better).
const NOISE_LEAST: f32 = 0.8;
const NOISE_SHARE: f32 = 0.012;
/// Noise in units of the median difference.
const NOISE_MEDIANS: f32 = 1.1;
/// Share of the background's slope that counts as error of its place.
const SLOPE_SHARE: f32 = 0.25;
/// Difference in units of the noise: from here on it is wet, and fully so this much further on; dry as much before.
const WET_FROM: f32 = 2.2;
const WET_SPAN: f32 = 2.0;
/// A difference up to this, in units of the noise, is still background.
const CALM: f32 = 5.0;
/// Background that has moved by more than this since the earlier picture is told from what stands still, px.
const MOVES_PX: f32 = 1.2;
/// A step in brightness counts from this share of the stream's usual one on, fully this much further on.
const STEP_FROM: f32 = 0.35;
const STEP_SPAN: f32 = 0.3;
/// Weight of a moved picture's evidence where the memory knows nothing, to begin a stream.
const UNKNOWN_WEIGHT: f32 = 0.5;
/// Least score, share of the line's length with an edge, and share of it on known ground to begin a stream.
const BEGIN: [f32; 3] = [0.6, 0.5, 0.35];
/// On known ground the least score to begin is less by this.
const BEGIN_KNOWN: f32 = 0.25;
/// Least score to go on: on unknown ground and on known ground; least share of the line's length.
const GO_ON: [f32; 3] = [0.45, 0.5, 0.6];
/// What the moved earlier picture says of a line, -1 (it explains it) to 1: below, it is background; above, a stream goes on.
const EXPLAINED: f32 = -0.4;
const UNEXPLAINED: f32 = 0.3;
/// From this motion across the line since the earlier picture on, px; and with at least this score.
const TELLS_PX: f32 = 0.6;
const HELD: f32 = 0.25;
/// Background that has moved by less since then is at rest, px: then what changes is a stream, and a stream in which nothing changes for
/// so many frames is none.
const REST_PX: f32 = 0.2;
const STILL_FRAMES: u32 = 12;
/// Pictures are compared with an earlier one until the background has moved so far, px, or for so many frames: slow motion tells little
/// from frame to frame.
const REFER_PX: f32 = 1.5;
const REFER_FRAMES: u32 = 4;
/// Least score of a piece of the line that counts as edge.
const PIECE: f32 = 0.35;
/// Weight of lying further out (as a logarithm): within the water there are edges too.
const OUTERMOST: f32 = 0.3;
/// Weight of what the moved earlier picture does not explain further out.
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
/// The full picture's line is the same when ratio and product of its legs differ by no more than this (as logarithms), and its step
/// has at least this share of the usual height.
const SHAPE_MOST: f32 = 0.7;
const SIZE_MOST: f32 = 1.0;
const HEIGHT_LEAST: f32 = 0.3;
/// A smaller triangle is a bead that hangs at the lip, px^2.
const BEAD_PX2: f32 = 24.0;
/// Weight of an edge point before ground as bright as the water's rim.
const HIDDEN_TRUST: f32 = 0.3;
/// Water differs from the dry background by at least this much: in units of the small picture's noise, and grey levels.
const WET_NOISES: f32 = 5.0;
const WET_LEAST: f32 = 6.0;
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

/// What the moved earlier picture says of a line.
struct Against {
    /// How far the background has moved there, and across the line, px.
    travels: f32,
    moves: f32,
    /// Share of it that the picture shows, and how little it explains, -1 to 1.
    shown: f32,
    unexplained: f32,
}

impl Against {
    fn tells(&self) -> bool {
        self.moves > TELLS_PX && self.shown > 0.5
    }

    fn rests(&self) -> bool {
        self.travels < REST_PX && self.shown > 0.5
    }

    /// Whether the earlier picture, moved, shows the line too.
    fn is_background(&self) -> bool {
        self.tells() && self.unexplained < EXPLAINED
    }
}

/// A colour's three parts, and one more: four for the processor's sake.
type Colour = [f32; 4];

#[inline(always)]
fn each(f: impl Fn(usize) -> f32) -> Colour {
    [f(0), f(1), f(2), f(3)]
}

/// Size of a difference of colours, grey levels: that of an equal difference of all three.
#[inline(always)]
fn size_of(c: &Colour) -> f32 {
    ((c[0] * c[0] + c[1] * c[1] + c[2] * c[2]) * (1.0 / 3.0)).sqrt()
}

/// The colours along a ray, each part by itself, and 0 at the end.
type Colours = [[f32; SAMPLES + 1]; 3];

/// The colours of a row of samples, times `factors`.
#[inline(always)]
fn colours(row: &[Vec4b], factors: &Row) -> Colours {
    let mut colours = [[0.0; SAMPLES + 1]; 3];
    for (r, (pixel, factor)) in row.iter().zip(factors).enumerate() {
        for k in 0..3 {
            colours[k][r] = factor * f32::from(pixel[k]);
        }
    }
    colours
}

/// Size of the colours at each place.
#[inline(always)]
fn sizes(c: &Colours) -> Row {
    row(|r| ((c[0][r] * c[0][r] + c[1][r] * c[1][r] + c[2][r] * c[2][r]) * (1.0 / 3.0)).sqrt())
}

/// What makes colours mixed with nothing whole again: `gain` over how known they are, 0 where that is less than a half; and where it is more.
#[inline(always)]
fn whole(row: &[Vec4b], gain: f32) -> (Row, [f32; SAMPLES + 1]) {
    let (mut factors, mut known) = ([0.0; SAMPLES], [0.0; SAMPLES + 1]);
    for (r, pixel) in row.iter().take(SAMPLES).enumerate() {
        let share = f32::from(pixel[3]) * (1.0 / 255.0);
        known[r] = if share >= 0.5 { 1.0 } else { 0.0 };
        factors[r] = known[r] * gain / share.max(0.5);
    }
    (factors, known)
}

/// How far colours lie from each other, each with its neighbour along the ray, where both are `shown`.
#[inline(always)]
fn apart(a: &Colours, b: &Colours, shown: &[f32; SAMPLES + 1]) -> Row {
    let mut away = [[0.0; SAMPLES + 1]; 3];
    for k in 0..3 {
        for r in 0..SAMPLES {
            away[k][r] = shown[r] * (a[k][r] - b[k][r]);
        }
    }
    let mut pairs = [[0.0; SAMPLES + 1]; 3];
    for k in 0..3 {
        for r in 0..SAMPLES {
            pairs[k][r] = (away[k][r] + away[k][r + 1]) / (shown[r] + shown[r + 1]).max(1.0);
        }
    }
    let size = sizes(&pairs);
    row(|r| shown[r] * size[r])
}

/// A value for each sample of a ray. (`std::array::from_fn` calls `f` out of line for as many.)
#[inline(always)]
fn row(f: impl Fn(usize) -> f32) -> Row {
    let mut row = [0.0; SAMPLES];
    for (r, value) in row.iter_mut().enumerate() {
        *value = f(r);
    }
    row
}

/// Sums along a ray, with what windows reach beyond its ends.
const LEAD: usize = 4;
const TAIL: usize = 25;
type Sums = [f32; LEAD + SAMPLES + 1 + TAIL];
type Row = [f32; SAMPLES];

/// The samples from `from` to before `to` of each sample of a ray, as far as they lie on it.
struct Window {
    from: isize,
    to: isize,
    per_length: Row,
}

const fn window(from: isize, to: isize) -> Window {
    let mut per_length = [1.0; SAMPLES];
    let mut at = 0;
    while at < SAMPLES {
        let (mut first, mut last) = (at as isize + from, at as isize + to);
        if first < 0 {
            first = 0;
        }
        if last > SAMPLES as isize {
            last = SAMPLES as isize;
        }
        if last > first + 1 {
            per_length[at] = 1.0 / (last - first) as f32;
        }
        at += 1;
    }
    Window { from, to, per_length }
}

static INSIDE: Window = window(-4, 0);
static OUTSIDE: Window = window(1, 7);
static ACROSS: Window = window(-3, 3);
static FURTHER: Window = window(3, 12);
static FAR: Window = window(2, 25);

impl Window {
    /// Mean over it at each sample.
    #[inline(always)]
    fn mean(&self, sums: &Sums) -> Row {
        let (from, to) = (LEAD.wrapping_add_signed(self.from), LEAD.wrapping_add_signed(self.to));
        let (first, last) = (&sums[from..from + SAMPLES], &sums[to..to + SAMPLES]);
        row(|r| (last[r] - first[r]) * self.per_length[r])
    }
}

#[inline(always)]
fn sums(row: &Row) -> Sums {
    let mut sums = [0.0; LEAD + SAMPLES + 1 + TAIL];
    let mut sum = 0.0;
    for (total, value) in sums[LEAD + 1..].iter_mut().zip(row) {
        sum += value;
        *total = sum;
    }
    sums[LEAD + SAMPLES + 1..].fill(sum);
    sums
}

/// The outline is a little curved: a neighbour counts too.
#[inline(always)]
fn around(row: &Row) -> Row {
    let mut largest = *row;
    for r in 1..SAMPLES {
        largest[r] = largest[r].max(row[r - 1]);
        largest[r - 1] = largest[r - 1].max(row[r]);
    }
    largest
}

/// Finds the stream of clear water in the pictures of one camera.
pub struct ClearWater {
    scale: f32,
    size: Size,
    axes: Axes,
    directions: Vec<[f32; 2]>,
    /// Distance of each of a ray's samples from the lip, px.
    radii: Row,
    /// Each ray sample's place, px, then 1 px beside each; whether it is air, 1 or 0.
    places: Vec<[f32; 2]>,
    air: Vec<f32>,
    /// Each line's legs on the x- and y-axis, px, and their logarithms; its sample and its weight on each ray.
    legs: Vec<[f32; 2]>,
    log_legs: Vec<[f32; 2]>,
    cells: Vec<[u16; RAYS]>,
    weights: Vec<[f32; RAYS]>,
    // Pictures: small; the same with four bytes a pixel; the one of these that is compared with: of the last frame, or one from which the
    // background has not moved far.
    small: Mat,
    now: Mat,
    last: Mat,
    ground: Ground,
    // Along all rays: maps from now, to the memory, to the earlier picture; what these show there.
    fixed_maps: [Mat; 2],
    maps: [Mat; 2],
    last_maps: [Mat; 2],
    ray_now: Mat,
    ray_ground: Mat,
    ray_last: Mat,
    // Along all rays: difference from the memory and from the earlier picture, in units of the noise; the memory's slope; whether
    // it is known; whether the earlier picture shows the place.
    away: Vec<f32>,
    away_last: Vec<f32>,
    slopes: Vec<f32>,
    remembered: Vec<f32>,
    shown: Vec<f32>,
    // Of each sample: what it adds to a line through it, and the share of that which rests on known ground; what the moved earlier picture
    // says, -1 to 1, and the share of the surroundings that it shows; the step in colour there.
    value: Vec<f32>,
    known: Vec<f32>,
    unexplained: Vec<f32>,
    shown_around: Vec<f32>,
    steps: Vec<f32>,
    noise: f32,
    /// Share of the known background far from the lip that differs from the memory, and frames in a row with too much of that.
    strange: f32,
    strange_frames: u32,
    stream: Option<Stream>,
    /// Where it last was, and for how many frames it has not been seen.
    last_legs: [f32; 2],
    dry_frames: u32,
    /// Frames that were compared with the same picture.
    compared: u32,
    /// Frames in a row in which neither the background nor the best line moved.
    still_frames: u32,
    /// Lines in a row that the full picture did not confirm.
    refuted: u32,
    edges: Vec<[f32; 2]>,
    scratch: Vec<f32>,
}

impl ClearWater {
    /// For a region of `region_px` (width, height) of a picture `width_px` wide; `axes` relative to the region, px.
    pub fn new(axes: &Axes, region_px: [i32; 2], width_px: u32) -> opencv::Result<Self> {
        let scale = (width_px as f32 / WIDTH_PX).round().max(1.0);
        let size = Size::new((region_px[0] / scale as i32).max(8), (region_px[1] / scale as i32).max(8));
        let small = |v: f32| (v + 0.5) / scale - 0.5;
        let axes = Axes { lip_px: axes.lip_px.map(small), ..*axes };
        let ([lip_x, lip_y], x, y) = (axes.lip_px, axes.x, axes.y);
        let sine = axes.sine();
        let turn = sine.signum();
        let between = sine.abs().atan2(x[0] * y[0] + x[1] * y[1]);
        let directions: Vec<[f32; 2]> = (0..RAYS)
            .map(|i| {
                let (sin, cos) = ((i as f32 + 0.5) / RAYS as f32 * between * turn).sin_cos();
                [x[0] * cos - x[1] * sin, x[0] * sin + x[1] * cos]
            })
            .collect();
        let mut radii = [NEAR_PX; SAMPLES];
        for r in 1..SAMPLES {
            radii[r] = radii[r - 1] + (radii[r - 1] / DENSE_PX).max(1.0);
        }
        let (mut places, mut air) = (Vec::with_capacity(2 * CELLS), Vec::with_capacity(CELLS));
        for along in &directions {
            for r in &radii {
                let above = (x[0] * along[1] - x[1] * along[0]) * turn * r;
                // Samples beyond the region repeat its border and belong to no line.
                let place = [
                    (lip_x + r * along[0]).clamp(1.0, size.width as f32 - 2.01),
                    (lip_y + r * along[1]).clamp(1.0, size.height as f32 - 2.01),
                ];
                places.push(place);
                air.push(if above >= RIM_PX && place == [lip_x + r * along[0], lip_y + r * along[1]] { 1.0 } else { 0.0 });
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
            let crossings: Vec<f32> = directions
                .iter()
                .map(|d| {
                    let (u, v) = ((d[0] * y[1] - d[1] * y[0]) / sine, (x[0] * d[1] - x[1] * d[0]) / sine);
                    1.0 / (u / a + v / b)
                })
                .collect();
            let point = |k: usize| [lip_x + crossings[k] * directions[k][0], lip_y + crossings[k] * directions[k][1]];
            let fits = (0..RAYS).all(|k| {
                let [px, py] = point(k);
                crossings[k] < radii[SAMPLES - 3] && px >= 1.0 && py >= 1.0 && px < size.width as f32 - 2.0 && py < size.height as f32 - 2.0
            });
            if !fits {
                continue;
            }
            let apart = |k: usize| (point(k)[0] - point(k + 1)[0]).hypot(point(k)[1] - point(k + 1)[1]);
            // By length; the rays beside the axes are left out.
            let weight = |k: usize| if k == 0 || k == RAYS - 1 { 0.0 } else { apart(k - 1) + apart(k) };
            let total: f32 = (0..RAYS).map(weight).sum();
            legs.push([a, b]);
            let nearest = |r: f32| radii.partition_point(|at| 0.5 * (at + (at + (at / DENSE_PX).max(1.0))) < r);
            cells.push(std::array::from_fn(|k| (k * SAMPLES + nearest(crossings[k])) as u16));
            weights.push(std::array::from_fn(|k| weight(k) / total));
        }
        let rows = || vec![0.0; CELLS];
        let map = |times: usize| Mat::new_rows_cols_with_default((times * RAYS) as i32, SAMPLES as i32, CV_32FC1, Scalar::default());
        let (mut map_x, mut map_y) = (map(1)?, map(1)?);
        for (k, at) in [&mut map_x, &mut map_y].into_iter().enumerate() {
            at.data_typed_mut::<f32>()?.iter_mut().zip(&places).for_each(|(v, place)| *v = place[k]);
        }
        let mut fixed_maps = [Mat::default(), Mat::default()];
        let [first, second] = &mut fixed_maps;
        imgproc::convert_maps(&map_x, &map_y, first, second, CV_16SC2, false)?;
        for i in 0..CELLS {
            let ([x, y], along) = (places[i], directions[i / SAMPLES]);
            places.push([x - along[1], y + along[0]]);
        }
        Ok(Self {
            scale,
            size,
            axes,
            directions,
            radii,
            places,
            air,
            log_legs: legs.iter().map(|l: &[f32; 2]| l.map(f32::ln)).collect(),
            legs,
            cells,
            weights,
            small: Mat::default(),
            now: Mat::default(),
            last: Mat::default(),
            ground: Ground::new(size)?,
            fixed_maps,
            maps: [map(2)?, map(2)?],
            last_maps: [map(1)?, map(1)?],
            ray_now: Mat::default(),
            ray_ground: Mat::default(),
            ray_last: Mat::default(),
            away: rows(),
            away_last: rows(),
            slopes: rows(),
            remembered: rows(),
            shown: rows(),
            value: rows(),
            known: rows(),
            unexplained: rows(),
            shown_around: rows(),
            steps: rows(),
            noise: NOISE_LEAST,
            strange: 0.0,
            strange_frames: 0,
            stream: None,
            last_legs: [0.0; 2],
            dry_frames: AFTERWARDS + 1,
            compared: 0,
            still_frames: 0,
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
        let sine = self.axes.sine();
        let turn = sine.signum();
        let plane = |px: f32, py: f32| [-px * lip_x - py * lip_y, px, py];
        [
            plane(-x[1] * turn, x[0] * turn),
            plane(y[1] * turn, -y[0] * turn),
            plane((y[1] / a - x[1] / b) / sine, (x[0] / b - y[0] / a) / sine),
        ]
    }

    /// The colour of the dry background at a place of the region, px, where it is known.
    fn dry_at(&self, [x, y]: [f32; 2]) -> Option<[f32; 3]> {
        let small = |v: f32| (v + 0.5) / self.scale - 0.5;
        self.ground.dry_at([small(x), small(y)])
    }

    /// Where on a profile from within the water outwards it begins, samples; the height of the step there, grey levels; and how much
    /// it is to be trusted, 0 to 1.
    pub fn begins_at(&self, profile: &[[f32; 3]; 2 * REACH + 1], place: impl Fn(usize) -> [f32; 2]) -> Option<(f32, f32, f32)> {
        let mut differs = [[0.0f32; 3]; 2 * REACH + 1];
        let known = differs.iter_mut().zip(profile).enumerate().all(|(j, (differs, seen))| match self.dry_at(place(j)) {
            Some(dry) => {
                *differs = std::array::from_fn(|c| seen[c] - dry[c]);
                true
            }
            None => false,
        });
        if known {
            // The outermost place that differs from the dry background, where half of the difference is reached.
            let size = |d: &[f32; 3]| (d.iter().map(|v| v * v).sum::<f32>() / 3.0).sqrt();
            let least = (WET_NOISES * self.noise).max(WET_LEAST);
            let j = (1..2 * REACH).rev().find(|&j| size(&differs[j]) >= least && size(&differs[j - 1]) >= least)?;
            let full = (j.saturating_sub(4)..=j).max_by(|a, b| size(&differs[*a]).total_cmp(&size(&differs[*b])))?;
            let (full, height) = (differs[full], size(&differs[full]));
            let share = |d: &[f32; 3]| d.iter().zip(full).map(|(a, b)| a * b).sum::<f32>() / (3.0 * height * height);
            let i = (0..2 * REACH).rev().find(|&i| share(&differs[i]) >= 0.5)?;
            let (inner, outer) = (share(&differs[i]), share(&differs[i + 1]));
            // Ground as bright as the water's rim hides where it begins.
            let dry: [f32; 3] = std::array::from_fn(|c| profile[i + 1][c] - differs[i + 1][c]);
            let hidden = self.stream.is_some_and(|s| size(&std::array::from_fn(|c| dry[c] - s.band[c])) < 2.0 * least);
            return (outer < 0.5).then(|| (i as f32 + (inner - 0.5) / (inner - outer), height, if hidden { HIDDEN_TRUST } else { 1.0 }));
        }
        // The outermost of the steep steps of brightness.
        let grey = |j: usize| profile[j].iter().sum::<f32>() / 3.0;
        let step = |j: usize| (grey(j + 1) - grey(j)).abs();
        let steepest = (0..2 * REACH).map(step).fold(0.0, f32::max);
        let j = (1..2 * REACH - 1).rev().find(|&j| step(j) >= 0.6 * steepest && step(j) >= step(j - 1) && step(j) >= step(j + 1))?;
        if steepest < 4.0 {
            return None;
        }
        // The top of the parabola through the three steps.
        let (left, middle, right) = (step(j - 1), step(j), step(j + 1));
        let curvature = left - 2.0 * middle + right;
        let shift = if curvature < -1e-3 { (0.5 * (left - right) / curvature).clamp(-0.5, 0.5) } else { 0.0 };
        let height = (grey((j + 3).min(2 * REACH)) - grey(j.saturating_sub(2))).abs().max(steepest);
        Some((j as f32 + 0.5 + shift, height, 1.0))
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
        let sine = self.axes.sine().abs();
        let good = fine.is_some_and(|(legs_px, height)| {
            let legs = legs_px.map(|v| v / self.scale);
            let [a, b] = [0, 1].map(|k| (legs[k] / stream.legs[k]).ln());
            0.5 * legs[0] * legs[1] * sine > BEAD_PX2
                && (a - b).abs() < SHAPE_MOST
                && (a + b).abs() < SIZE_MOST
                && (young || height > HEIGHT_LEAST * stream.height)
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
        // The middle four of each block's pixels: half of the memory of a large picture is never read.
        imgproc::resize(region, &mut self.small, self.size, 0.0, 0.0, imgproc::INTER_LINEAR)?;
        imgproc::cvt_color_def(&self.small, &mut self.now, imgproc::COLOR_BGR2BGRA)
    }

    /// The picture that was taken, small, in colour.
    pub fn small(&self) -> &Mat {
        &self.small
    }

    /// Looks at the picture that was taken.
    pub fn look(&mut self) -> opencv::Result<Seen> {
        // With the processor's widest registers.
        pulp::Arch::new().dispatch(|| self.look_at_it())
    }

    #[inline(always)]
    fn look_at_it(&mut self) -> opencv::Result<Seen> {
        self.edges.clear();
        let mut seen = Seen::Dry;
        let [air, right, _] = self.planes([1.0, 1.0]);
        let air = [air[0] - RIM_PX, air[1], air[2]];
        if !self.ground.is_new() {
            let wet = self.stream.map(|s| Wet { line: self.planes(s.legs.map(|v| v + 5.0))[2], right });
            self.ground.register(&self.now, air, wet)?;
            self.compare(air)?;
            self.fill_table()?;
            seen = self.decide()?;
            self.strange_frames = if self.strange > STRANGE { self.strange_frames + 1 } else { 0 };
            if self.strange_frames > STRANGE_FRAMES {
                // It stays another picture: what stands there now is the background.
                self.ground.forget()?;
                (self.strange_frames, self.stream, self.dry_frames) = (0, None, AFTERWARDS + 1);
            }
        }
        let [a, b] = self.last_legs.map(|v| v.max(1.0));
        let bulge = 2.0 + 0.1 * (a * b).sqrt();
        let [inner, outer] = [[a + 1.4 * bulge, b + 1.4 * bulge], [1.35 * a + 8.0, 1.35 * b + 8.0]].map(|legs| self.planes(legs)[2]);
        let near = (self.dry_frames <= AFTERWARDS).then_some((Wet { line: inner, right }, outer));
        let dry = Dry { air, flows: self.stream.is_some() || self.dry_frames <= 1, near, calm: CALM * self.noise };
        let is_new = self.ground.is_new();
        self.ground.remember(&self.now, dry)?;
        self.compared += 1;
        if is_new || self.compared >= REFER_FRAMES || self.ground.travelled() >= REFER_PX {
            std::mem::swap(&mut self.now, &mut self.last);
            self.ground.refer();
            self.compared = 0;
        }
        Ok(seen)
    }

    /// Compares the memory and the earlier picture, both moved, with what is seen now, along the rays.
    #[inline(always)]
    fn compare(&mut self, air: Plane) -> opencv::Result<()> {
        let (linear, replicate) = (imgproc::INTER_LINEAR, core::BORDER_REPLICATE);
        let [first, second] = &self.fixed_maps;
        imgproc::remap(&self.now, &mut self.ray_now, first, second, linear, replicate, Scalar::default())?;
        self.ground.recall(&self.places, &mut self.maps, &mut self.ray_ground)?;
        let [map_x, map_y] = &mut self.last_maps;
        let back = self.ground.moved().inverse();
        let most = [self.size.width as f32 - 1.0, self.size.height as f32 - 1.0];
        let (columns, rows) = (map_x.data_typed_mut::<f32>()?, map_y.data_typed_mut::<f32>()?);
        for (i, (at_x, at_y)) in columns.iter_mut().zip(rows).enumerate() {
            let [x, y] = back.forth(self.places[i]);
            let inside = x >= 0.0 && y >= 0.0 && x < most[0] && y < most[1] && air[0] + air[1] * x + air[2] * y >= 0.0;
            self.shown[i] = if inside { self.air[i] } else { 0.0 };
            (*at_x, *at_y) = (x, y);
        }
        imgproc::remap(&self.last, &mut self.ray_last, map_x, map_y, linear, replicate, Scalar::default())?;
        let [gain, last_gain] = self.ground.gains();
        let (mut level_sum, mut level_count) = (0.0, 0.0f32);
        let (ones, factor) = ([1.0; SAMPLES], [gain / last_gain; SAMPLES]);
        for ray in 0..RAYS {
            let range = ray * SAMPLES..(ray + 1) * SAMPLES;
            let now = colours(self.ray_now.at_row(ray as i32)?, &ones);
            let (ground, beside) = (self.ray_ground.at_row::<Vec4b>(ray as i32)?, self.ray_ground.at_row::<Vec4b>((RAYS + ray) as i32)?);
            let ((factors, mut known), (factors_beside, known_beside)) = (whole(ground, gain), whole(beside, gain));
            known.iter_mut().zip(&self.air[range.clone()]).for_each(|(known, air)| *known *= air);
            let (ground, beside) = (colours(ground, &factors), colours(beside, &factors_beside));
            let mut shown = [0.0; SAMPLES + 1];
            shown[..SAMPLES].copy_from_slice(&self.shown[range.clone()]);
            self.away[range.clone()].copy_from_slice(&apart(&now, &ground, &known));
            self.away_last[range.clone()].copy_from_slice(&apart(&now, &colours(self.ray_last.at_row(ray as i32)?, &factor), &shown));
            let (mut across, mut along) = ([[0.0; SAMPLES + 1]; 3], [[0.0; SAMPLES + 1]; 3]);
            for k in 0..3 {
                for r in 0..SAMPLES {
                    across[k][r] = known_beside[r] * (beside[k][r] - ground[k][r]);
                    along[k][r] = known[r + 1] * (ground[k][r + 1] - ground[k][r]);
                }
            }
            let (across, along) = (sizes(&across), sizes(&along));
            for (r, (slope, remembered)) in self.slopes[range.clone()].iter_mut().zip(&mut self.remembered[range]).enumerate() {
                (*slope, *remembered) = (known[r] * across[r].max(along[r]), known[r]);
                level_sum += known[r] * (ground[0][r] + ground[1][r] + ground[2][r]) / 3.0;
                level_count += known[r];
            }
        }
        // Noise: where the known background is even.
        self.scratch.clear();
        self.scratch.extend((0..CELLS).step_by(3).filter(|i| self.remembered[*i] > 0.0).map(|i| self.slopes[i]));
        let even = median(&mut self.scratch);
        self.scratch.clear();
        let known = (0..CELLS).step_by(3).filter(|i| self.remembered[*i] > 0.0 && self.slopes[*i] <= even);
        self.scratch.extend(known.map(|i| self.away[i]));
        let noise = if self.scratch.len() > 25 { NOISE_MEDIANS * median(&mut self.scratch) } else { 2.0 };
        self.noise = noise.max(NOISE_LEAST).max(NOISE_SHARE * level_sum / level_count.max(1.0));
        let per_noise = 1.0 / self.noise;
        for ((away, away_last), slope) in self.away.iter_mut().zip(&mut self.away_last).zip(&self.slopes) {
            *away = (*away - SLOPE_SHARE * slope).max(0.0) * per_noise;
            *away_last = (*away_last - SLOPE_SHARE * slope).max(0.0) * per_noise;
        }
        let (mut strange, mut far) = (0usize, 0usize);
        let far_from = self.radii.partition_point(|r| *r < MIDDLE_PX);
        for (away, remembered) in self.away.chunks_exact(SAMPLES).zip(self.remembered.chunks_exact(SAMPLES)) {
            for (away, remembered) in away.iter().zip(remembered).skip(far_from) {
                far += usize::from(*remembered > 0.0);
                strange += usize::from(*remembered > 0.0 && *away > CALM);
            }
        }
        self.strange = strange as f32 / far.max(1) as f32;
        Ok(())
    }

    /// Whether what is known near the lip has no pattern: then what is not known has none either.
    #[inline(always)]
    fn is_even(&mut self) -> bool {
        let near = self.radii.partition_point(|r| *r < MIDDLE_PX);
        self.scratch.clear();
        let mut air = 0;
        for ray in 0..RAYS {
            for i in (ray * SAMPLES..ray * SAMPLES + near).step_by(2) {
                air += usize::from(self.air[i] > 0.0);
                if self.remembered[i] > 0.0 {
                    self.scratch.push(self.slopes[i]);
                }
            }
        }
        let count = self.scratch.len();
        count > air * 3 / 5 && *self.scratch.select_nth_unstable_by(count * 9 / 10, f32::total_cmp).1 < 1.2 * self.noise + 0.6
    }

    /// What each sample of each ray would add to a line through it.
    #[inline(always)]
    fn fill_table(&mut self) -> opencv::Result<()> {
        let turn = self.ground.moved();
        let even = self.is_even();
        let stream = self.stream;
        let step_size = stream.map_or(6.0 * self.noise, |s| s.band[3]);
        let per_noise = 1.0 / self.noise;
        let empty = [0.0; SAMPLES];
        for ray in 0..RAYS {
            let start = ray * SAMPLES;
            let range = start..start + SAMPLES;
            let (away, away_last) = (&self.away[range.clone()], &self.away_last[range.clone()]);
            let (remembered, shown) = (&self.remembered[range.clone()], &self.shown[range.clone()]);
            let (levels, places) = (colours(self.ray_now.at_row(ray as i32)?, &[1.0; SAMPLES]), &self.places[range.clone()]);
            let [mut wet, mut far, mut sure, mut last, mut beyond, mut seen]: [Row; 6] = [empty; 6];
            // Where the ground is as bright as the water's rim, not to differ from it means nothing.
            let mut differs_from_rim = [1.0; SAMPLES];
            if let Some(stream) = stream {
                let mut from_rim = levels;
                for (levels, rim) in from_rim.iter_mut().zip(stream.band) {
                    levels.iter_mut().for_each(|level| *level -= rim);
                }
                let apart = sizes(&from_rim);
                differs_from_rim = row(|r| ((apart[r] * per_noise - WET_FROM) / WET_SPAN).clamp(0.0, 1.0));
            }
            for r in 0..SAMPLES {
                let how_wet = remembered[r] * ((away[r] - WET_FROM) / WET_SPAN).clamp(-1.0, 1.0);
                let tells = if how_wet < 0.0 { differs_from_rim[r] } else { remembered[r] };
                let how_wet = how_wet * tells;
                (wet[r], far[r], sure[r]) = (how_wet, how_wet.max(0.0), tells);
                let unexplained = shown[r] * ((away_last[r] - 2.0) / 2.0).clamp(-1.0, 1.0);
                (last[r], beyond[r], seen[r]) = (unexplained, unexplained.max(0.0), shown[r]);
            }
            let (wet, sure, last) = (sums(&wet), sums(&sure), sums(&last));
            let (wet_inside, wet_outside, wet_far) = (INSIDE.mean(&wet), OUTSIDE.mean(&wet), FAR.mean(&sums(&far)));
            let (sure_inside, sure_outside) = (INSIDE.mean(&sure), OUTSIDE.mean(&sure));
            let (unexplained, shown_around) = (ACROSS.mean(&last), ACROSS.mean(&sums(&seen)));
            let beyond = FURTHER.mean(&sums(&beyond));
            // Evidence of the memory, of the step, of the moved earlier picture; how much that counts.
            let [mut known_says, mut step_says, mut last_says, mut moving]: [Row; 4] = [empty; 4];
            let mut across = [[0.0; SAMPLES + 1]; 3];
            for k in 0..3 {
                for r in 2..SAMPLES - 2 {
                    across[k][r] = 0.5 * (levels[k][r + 1] + levels[k][r + 2] - levels[k][r - 2] - levels[k][r - 1]);
                }
            }
            let steps = sizes(&across);
            for r in 0..SAMPLES {
                step_says[r] = ((steps[r] - STEP_FROM * step_size) / (STEP_SPAN * step_size)).clamp(-1.0, 1.0);
            }
            self.steps[range.clone()].copy_from_slice(&steps);
            for r in 0..SAMPLES {
                known_says[r] = (WET_INSIDE * wet_inside[r] - WET_OUTSIDE * wet_outside[r] - wet_far[r]).clamp(-1.0, 1.5);
                last_says[r] = 0.65 * unexplained[r] - BEYOND * beyond[r];
                let to = turn.forth(places[r]);
                let (dx, dy) = (to[0] - places[r][0], to[1] - places[r][1]);
                moving[r] = (((dx * dx + dy * dy).sqrt() - MOVES_PX) / MOVES_PX).clamp(0.0, 1.0) * shown_around[r];
            }
            let (step_says, known_says) = (around(&step_says), around(&known_says));
            let (value, known) = (&mut self.value[range.clone()], &mut self.known[range.clone()]);
            for r in 0..SAMPLES {
                let sure = 0.5 * (sure_inside[r] + sure_outside[r]);
                let by_memory = match (even, sure < 0.5, stream.is_some()) {
                    (true, true, _) => step_says[r],
                    // The exposure is not known better than a weak difference, and the stream's rim is a strong one.
                    (true, false, true) => 0.5 * (step_says[r] + known_says[r]),
                    _ => known_says[r],
                };
                let sure = if even { 1.0 } else { sure };
                let by_last = (1.0 - 0.5 * moving[r]) * 0.9 * step_says[r] + moving[r] * last_says[r];
                // To begin, only what the moved earlier picture shows counts beside the memory.
                let weight = (1.0 - sure) * if stream.is_some() { 1.0 } else { moving[r] * UNKNOWN_WEIGHT };
                value[r] = sure * by_memory + weight * by_last;
                known[r] = if stream.is_some() { sure } else { sure + weight };
            }
            self.unexplained[range.clone()].copy_from_slice(&unexplained);
            self.shown_around[range].copy_from_slice(&shown_around);
        }
        Ok(())
    }

    /// The colour just inside a sample, and last the step there.
    #[inline(always)]
    fn band(&self, inside: &[Vec4b], at: usize) -> Colour {
        let (Some(a), Some(b)) = (inside.get(at.wrapping_sub(2)), inside.get(at.wrapping_sub(1))) else { return [0.0; 4] };
        let mean = |k: usize| 0.5 * (f32::from(a[k]) + f32::from(b[k]));
        [mean(0), mean(1), mean(2), self.steps[at]]
    }

    /// The best line and its figures.
    #[inline(always)]
    fn best_line(&self) -> opencv::Result<Option<Found>> {
        let inside: &[Vec4b] = self.ray_now.data_typed()?;
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
            let mut found = Found { line, ..Found::default() };
            let along = || self.cells[line].iter().map(|at| usize::from(*at)).zip(self.weights[line]);
            let flows = self.stream.is_some();
            for (at, weight) in along() {
                let (value, known) = (self.value[at], self.known[at]);
                found.score += weight * value;
                found.known += weight * known;
                let (least, share) = if flows { (PIECE, 1.0) } else { (PIECE * known, known) };
                found.share += if value > least { weight * share } else { 0.0 };
            }
            let outer = OUTERMOST * 0.5 * (p + q);
            let beats = |total: f32| best.is_none_or(|b| total > b.total);
            if !flows {
                if found.known < BEGIN[2] {
                    continue;
                }
                found.score /= found.known;
                found.share /= found.known;
                found.total = outer + found.score + 0.7 * found.share;
                if beats(found.total) {
                    best = Some(found);
                }
                continue;
            }
            let square = |v: f32| v * v;
            let stay = STAY * (-0.5 * (square(grown / GROWS) + square(turned / turns))).exp();
            found.evidence = found.score;
            // The band along it can only cost.
            if !beats(outer + found.score + 0.7 * found.share + stay) {
                continue;
            }
            let mut spread = 0.0;
            for (at, weight) in along() {
                let band = self.band(inside, at);
                found.band = each(|k| found.band[k] + weight * band[k]);
                spread += weight * square(size_of(&band));
            }
            if let Some(stream) = self.stream {
                // Along the outline the same room is seen, whatever stands behind.
                let spread = (spread - square(size_of(&found.band))).max(0.0);
                let unit = 0.5 * found.band[3] + 2.0 * self.noise;
                let change = size_of(&each(|k| found.band[k] - stream.band[k])) / unit;
                let alike = BAND * ((-spread / (unit * unit)).exp() - 1.0) + BAND * ((-change * change).exp() - 1.0);
                found.score += (1.0 - found.known) * alike;
            }
            found.total = outer + found.score + 0.7 * found.share + stay;
            if beats(found.total) && !self.against(line).is_background() {
                best = Some(found);
            }
        }
        if self.stream.is_none()
            && let Some(found) = &mut best
        {
            for (at, weight) in self.cells[found.line].iter().zip(self.weights[found.line]) {
                let band = self.band(inside, usize::from(*at));
                found.band = each(|k| found.band[k] + weight * band[k]);
            }
        }
        Ok(best)
    }

    /// What the moved earlier picture says of a line.
    fn against(&self, line: usize) -> Against {
        let turn = self.ground.moved();
        let [a, b] = self.legs[line];
        let along = [0, 1].map(|k| b * self.axes.y[k] - a * self.axes.x[k]);
        let length = along[0].hypot(along[1]);
        let [mut travels, mut moves, mut shown, mut unexplained] = [0.0; 4];
        for (at, weight) in self.cells[line].iter().map(|at| usize::from(*at)).zip(self.weights[line]) {
            let place = self.places[at];
            let to = turn.forth(place);
            let [dx, dy] = [to[0] - place[0], to[1] - place[1]];
            travels += weight * dx.hypot(dy);
            moves += weight * (dy * along[0] - dx * along[1]).abs() / length;
            shown += weight * self.shown_around[at];
            unexplained += weight * self.unexplained[at];
        }
        Against { travels, moves, shown, unexplained: unexplained / shown.max(0.05) }
    }

    /// Whether a stream is seen, and where.
    #[inline(always)]
    fn decide(&mut self) -> opencv::Result<Seen> {
        let mut seen = Seen::Dry;
        let (mut background, mut surely_dry) = (false, false);
        if let Some(found) = self.best_line()? {
            let against = self.against(found.line);
            self.still_frames = if against.rests() && against.unexplained < EXPLAINED { self.still_frames + 1 } else { 0 };
            background = match self.stream {
                // The best line is not one of the background.
                Some(_) => self.still_frames > STILL_FRAMES,
                // At rest nothing begins without a change.
                None => against.is_background() || self.still_frames > 0,
            };
            surely_dry = found.known > GO_ON[1] && found.score < HELD;
            let enough = match self.stream {
                Some(_) => {
                    let least = GO_ON[0] * (1.0 - found.known) + GO_ON[1] * found.known;
                    ((against.tells() || against.rests()) && against.unexplained > UNEXPLAINED && found.evidence > HELD)
                        || (found.score > least && found.share > GO_ON[2])
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
                    return Ok(seen);
                }
                // One frame of grace: a stream that is lost once may be there again, and is not taken for background.
                if self.stream.is_some() && self.dry_frames == 1 && !(background || surely_dry) {
                    seen = Seen::Unsure;
                } else {
                    self.stream = None;
                }
            }
        }
        Ok(seen)
    }

    /// The edge on each ray near `line`, into `self.edges`.
    #[inline(always)]
    fn find_edges(&mut self, line: usize) {
        for ray in 1..RAYS - 1 {
            let middle = usize::from(self.cells[line][ray]) - ray * SAMPLES;
            let reach = 2;
            let row = &self.value[ray * SAMPLES..][..SAMPLES];
            let range = middle.saturating_sub(reach)..(middle + reach + 1).min(SAMPLES);
            let best = range.clone().map(|i| row[i]).fold(f32::MIN, f32::max);
            // Equal neighbours: the middle of them. Without an edge here, the line itself.
            let (mut sum, mut count) = (0usize, 0usize);
            for i in range.filter(|i| best > PIECE && row[*i] >= best - 1e-6) {
                (sum, count) = (sum + i, count + 1);
            }
            let sample = if count == 0 { middle as f32 } else { sum as f32 / count as f32 };
            // Half a step further out is the edge.
            let (at, part) = ((sample + 0.5) as usize, (sample + 0.5).fract());
            let [before, after] = [at, at + 1].map(|r| self.radii[r.min(SAMPLES - 1)]);
            let radius = before + part * (after - before);
            let full = |k: usize| (self.axes.lip_px[k] + radius * self.directions[ray][k] + 0.5) * self.scale - 0.5;
            self.edges.push([full(0), full(1)]);
        }
    }
}
