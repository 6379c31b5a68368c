//! The dry background behind clear water: remembered as one picture that is fixed in the world, with how it lies in the camera's picture.
//!
//! The container turns, so the background moves in the picture as one rigid piece: a shift, a turn and a change of exposure, which
//! [`super::motion`] finds. What is dry is taken over into the memory, which is never resampled: it is a window on the world that wraps
//! around, and is moved on by whole squares as the camera moves.
//!
//! Called on the extraction thread. All pictures and tables are kept, so nothing is allocated after the second frame. The only failures
//! are OpenCV's.

use opencv::core::{self, CV_8UC4, Mat, Scalar, Size, Vec4b};
use opencv::imgproc;
use opencv::prelude::*;

use super::follow::{DrySpans, Following, RUN, SmallPicture, follow, packed};
use super::motion::{MotionFinder, MotionPoint, NEIGHBOURHOOD, NEIGHBOURHOOD_BEFORE, SQUARE};
use super::rigid::RigidMap;
use crate::vision::geometry::LinearField;
use crate::vision::pace::Pace;
use crate::vision::picture::bilinear_corner;

// "Tuned" below means that the value was tuned on seeds 101 to 104 of `evaluate-camera`; see docs/VISION.md.

/// Room in the memory around the region, squares. Chosen by hand; no measurement is recorded.
const ROOM_SQUARES: usize = 3;
/// In each frame, known ground is looked at in one of this many rows of the memory. Chosen by hand, for speed.
const REFRESH_ROWS: u32 = 4;
/// In each frame, points for the motion are chosen anew in one of this many rows of squares. Chosen by hand, for speed.
const POINT_ROWS: u32 = 4;
/// Points for the motion have been seen within this many of their row's turns. Tuned.
const POINT_AGE: u8 = 4;
/// Least change over 2 px at a point for the motion, in units of a calm difference. Tuned.
const STEEP_LEAST: f32 = 0.6;
/// Points for the motion lie at least this far above the rim, px. Tuned.
const POINT_ABOVE_PX: f32 = 2.0;

/// Remembered pixels that are looked at together. Chosen by hand, for speed.
const FEW: usize = 16;
/// A smaller step of the exposure is found with the motion, as a share. Chosen by hand.
const STEP_LEAST: f32 = 0.05;

/// Where water may be in the picture. A place is dry where both values are at least 1, and may be wet elsewhere.
#[derive(Debug, Clone, Copy)]
pub(super) struct WetPlaces {
    /// Share of the way from the lip to a line beyond which it is dry; 1 is on the line.
    pub(super) line_share: LinearField,
    /// Distance to the right of the container's left side, px.
    pub(super) right_px: LinearField,
}

/// Which places may be taken over into the memory.
#[derive(Debug, Clone, Copy)]
pub(super) struct DryPlaces {
    /// Height above the rim's light, px; from 0 on it is air.
    pub(super) height_px: LinearField,
    /// Whether a stream is seen now.
    pub(super) flows: bool,
    /// With a stream now or just before: what is surely wet, and the line within which it is close to that.
    pub(super) near: Option<(WetPlaces, LinearField)>,
    /// A difference up to this is still background, grey levels.
    pub(super) calm: f32,
}

/// How the memory lies in a picture.
#[derive(Debug, Clone, Copy)]
struct Pose {
    /// From the memory's window to the picture.
    map: RigidMap,
    /// Exposure against the memory.
    gain: f32,
}

/// The dry background as far as it is remembered.
pub(super) struct Background {
    /// Size of the pictures, px.
    size: Size,
    /// Side of the memory, px.
    side: usize,
    /// Where the window's first column and row lie in the memory, which wraps around.
    origin: [usize; 2],
    /// Blue, green, red at the first picture's exposure, and 255 where they are known. Where they are not, all four are 0.
    memory: Mat,
    /// For how many of its row's turns each pixel has not been seen.
    ages: Vec<u8>,
    /// The point for the motion in each square, as the squares lie in the memory.
    points: Vec<Option<MotionPoint>>,
    motion: MotionFinder,
    /// How the memory lies in the last picture.
    now: Pose,
    /// How the memory lies in the picture with which pictures are compared.
    reference: Pose,
    /// Number of pictures that were remembered.
    frame: usize,
    /// See [`REFRESH_ROWS`] and [`POINT_ROWS`].
    refresh_rows: usize,
    point_rows: usize,
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

/// The grey level of a remembered pixel; negative where it is not known or not fresh.
#[inline(always)]
fn fresh_grey(pixel: &Vec4b, age: u8) -> i32 {
    let pixel = packed(pixel) as i32;
    // Rounded, as OpenCV does with the picture: what is half a level too dark here makes the exposure too large, and the memory darker and darker.
    let grey = (29 * (pixel & 255) + 150 * (pixel >> 8 & 255) + 77 * (pixel >> 16 & 255) + 128) >> 8;
    // What is known has its highest bit set.
    if (pixel < 0) & (age <= POINT_AGE) { grey } else { -1 }
}

/// How many remembered pixels from the first on are known.
#[inline(always)]
fn known_run(pixels: &[Vec4b]) -> usize {
    let all_known = |few: &&[Vec4b]| few.iter().fold(u32::MAX, |all, pixel| all & packed(pixel)) >> 24 > 0;
    let many = FEW * pixels.chunks_exact(FEW).take_while(all_known).count();
    many + pixels[many..].iter().take_while(|pixel| pixel[3] > 0).count()
}

impl Background {
    /// For small pictures of `size`, px.
    pub(super) fn new(size: Size) -> opencv::Result<Self> {
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
            points: vec![None; squares * squares],
            motion: MotionFinder::new(size, squares * squares),
            now: home,
            reference: home,
            frame: 0,
            refresh_rows: REFRESH_ROWS as usize,
            point_rows: POINT_ROWS as usize,
        })
    }

    /// Says how fast pictures follow each other: each row's turn comes as often in a second at any rate.
    pub(super) fn set_pace(&mut self, pace: Pace) {
        (self.refresh_rows, self.point_rows) = (pace.pictures(REFRESH_ROWS) as usize, pace.pictures(POINT_ROWS) as usize);
    }

    /// Says that a pause lies before the next picture: how the background moved tells nothing of how it moves.
    pub(super) fn rest(&mut self) {
        self.motion.rest();
    }

    /// The pose of a picture in the middle of the window.
    fn home(size: Size, side: usize) -> Pose {
        Pose { map: RigidMap::shift([size.width, size.height].map(|v| 0.5 * (v as f32 - side as f32))), gain: 1.0 }
    }

    /// Starts anew, as before a first picture.
    pub(super) fn forget(&mut self) -> opencv::Result<()> {
        self.memory.data_bytes_mut()?.fill(0);
        self.points.fill(None);
        self.motion.rest();
        (self.now, self.frame) = (Self::home(self.size, self.side), 0);
        Ok(())
    }

    /// Whether nothing is remembered yet.
    pub(super) fn is_new(&self) -> bool {
        self.frame == 0
    }

    /// Exposure against the memory: now, and in the picture with which pictures are compared.
    pub(super) fn gains(&self) -> [f32; 2] {
        [self.now.gain, self.reference.gain]
    }

    /// The picture that comes is brighter than the last one by this factor, as far as that is known.
    pub(super) fn expect_gain(&mut self, factor: f32) {
        if (factor - 1.0).abs() > STEP_LEAST {
            self.correct_gain(factor);
        }
    }

    /// The picture is brighter against the memory than was thought by this factor.
    pub(super) fn correct_gain(&mut self, factor: f32) {
        self.now.gain *= factor;
    }

    /// The background's motion since the picture with which pictures are compared.
    pub(super) fn moved(&self) -> RigidMap {
        self.now.map.after(&self.reference.map.inverse())
    }

    /// How far the background has moved since the picture with which pictures are compared, px: the shift in the picture's middle, and what
    /// the turn adds at its border.
    pub(super) fn travelled_px(&self) -> f32 {
        let (moved, middle) = (self.moved(), self.middle());
        let to = moved.apply(middle);
        (to[0] - middle[0]).hypot(to[1] - middle[1]) + 0.5 * moved.sin.abs() * middle[0].min(middle[1])
    }

    /// From now on pictures are compared with the one that was last remembered.
    pub(super) fn refer(&mut self) {
        self.reference = self.now;
    }

    fn middle(&self) -> [f32; 2] {
        [self.size.width, self.size.height].map(|v| v as f32 / 2.0)
    }

    /// The dry ground as it lies in the picture.
    pub(super) fn ground(&self) -> DryGround<'_> {
        let pixels = self.memory.data_typed().unwrap_or_default();
        DryGround { pixels, side: self.side, origin: self.origin, now: self.now }
    }

    /// Puts what is remembered of these places in the picture into `found`: colours and how known they are (0 to 255), all four mixed
    /// alike. `maps` are two matrices of the same shape that are overwritten.
    #[inline(always)]
    pub(super) fn recall(&self, places: &[[f32; 2]], maps: &mut [Mat; 2], found: &mut Mat) -> opencv::Result<()> {
        let back = self.now.map.inverse();
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

    /// Finds how the memory lies in the picture `now`, by the points for the motion that are in the air and not wet.
    #[inline(always)]
    pub(super) fn register(&mut self, now: &Mat, height_px: LinearField, wet: Option<WetPlaces>) -> opencv::Result<()> {
        let (width, height) = (self.size.width as f32 - 3.0, self.size.height as f32 - 3.0);
        let (map, side, origin) = (self.now.map, self.side as f32, self.origin);
        self.motion.set_points(self.points.iter().flatten().filter_map(|point| {
            let at = map.apply([0, 1].map(|k| {
                let at = point.at[k] - origin[k] as f32;
                if at < 0.0 { at + side } else { at }
            }));
            let water = wet.is_some_and(|w| w.line_share.at(at) <= 1.0 || w.right_px.at(at) < 1.0);
            let inside = at[0] >= 2.0 && at[1] >= 2.0 && at[0] < width && at[1] < height;
            let good = height_px.at(at) >= POINT_ABOVE_PX && !water && inside;
            good.then(|| MotionPoint { at, slopes: point.slopes.map(|s| map.turned(s)), ..*point })
        }));
        let (step, gain) = self.motion.find(now, self.now.gain)?;
        self.now = Pose { map: step.after(&self.now.map), gain };
        Ok(())
    }

    /// Takes what is dry in the picture `now` over into the memory: new ground at once, known ground by and by.
    #[inline(always)]
    pub(super) fn remember(&mut self, now: &Mat, dry: DryPlaces) -> opencv::Result<()> {
        self.keep_inside()?;
        let picture = SmallPicture { pixels: now.data_typed()?, width: self.size.width as usize };
        let (pose, side, size, origin) = (self.now, self.side, self.size, self.origin);
        let memory: &mut [Vec4b] = self.memory.data_typed_mut()?;
        // Rounded: cut off, the memory would grow darker and darker.
        let exposure = (256.0 / pose.gain).round() as i32;
        let calm = (3.0 * (dry.calm / pose.gain) * (dry.calm / pose.gain)) as i32;
        let everywhere = LinearField::constant(2.0);
        let (right, inner, outer) =
            dry.near.map_or((everywhere, everywhere, everywhere), |(wet, outer)| (wet.right_px, wet.line_share, outer));
        for y in 0..side {
            let fresh = self.frame == 0 || y % self.refresh_rows == self.frame % self.refresh_rows;
            let row = MemoryRow::new(y, pose.map, side);
            let Some((x0, x1)) = row.in_picture(dry.height_px, size) else { continue };
            let dry_spans = DrySpans { right: row.dry(right), inner: row.dry(inner), outer: row.dry(outer) };
            let start = wrapped(y + origin[1], side) * side;
            let (kept, ages) = (&mut memory[start..start + side], &mut self.ages[start..start + side]);
            // Known ground follows when its row's turn has come, and unknown ground always does. A run ends where the window wraps around.
            let mut x = x0;
            while x < x1 {
                let column = wrapped(x + origin[0], side);
                let most = RUN.min(x1 - x).min(side - column);
                let run = &kept[column..column + most];
                let length = if fresh {
                    most
                } else if run[0][3] > 0 {
                    x += known_run(run);
                    continue;
                } else {
                    run.iter().position(|p| p[3] > 0).unwrap_or(most)
                };
                let seen = picture.along(row.place(x), [pose.map.cos, pose.map.sin], length);
                let range = column..column + length;
                let following = Following { x: x as i32, dry: dry_spans, flows: dry.flows, exposure, calm };
                follow(&seen, &mut kept[range.clone()], &mut ages[range], following);
                x += length;
            }
        }
        let (first, every) = if self.frame == 0 { (0, 1) } else { (self.frame % self.point_rows, self.point_rows) };
        for row in (first..side / SQUARE).step_by(every) {
            self.choose_points(row, STEEP_LEAST * dry.calm)?;
        }
        self.frame += 1;
        Ok(())
    }

    /// Moves the window on by whole squares when the picture's middle is no longer in the window's middle. What comes in is not known.
    fn keep_inside(&mut self) -> opencv::Result<()> {
        let (side, squares) = (self.side, self.side / SQUARE);
        for k in 0..2 {
            loop {
                let off = self.now.map.apply_back(self.middle())[k] - 0.5 * side as f32;
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
                    self.points[if k == 0 { other * squares + i } else { i * squares + other }] = None;
                }
                let step = if forward { SQUARE as f32 } else { -(SQUARE as f32) };
                for map in [&mut self.now.map, &mut self.reference.map] {
                    let along = map.turned(if k == 0 { [step, 0.0] } else { [0.0, step] });
                    map.shift = [map.shift[0] + along[0], map.shift[1] + along[1]];
                }
            }
        }
        Ok(())
    }

    /// Chooses the points for the motion anew in one row of the memory's squares: one in each square that the picture shows. A change below
    /// `least` over 2 px may be noise.
    #[inline(always)]
    fn choose_points(&mut self, row: usize, least: f32) -> opencv::Result<()> {
        let (side, squares) = (self.side, self.side / SQUARE);
        let memory: &[Vec4b] = self.memory.data_typed()?;
        for column in 0..squares {
            // The window's border has no neighbours.
            let [left, top] = [(column, 0), (row, 1)].map(|(square, k)| wrapped(square * SQUARE + side - self.origin[k], side));
            let middle = self.now.map.apply([left as f32 + 0.5 * SQUARE as f32, top as f32 + 0.5 * SQUARE as f32]);
            let out = (0..2).any(|k| middle[k] < 0.0 || middle[k] > [self.size.width, self.size.height][k] as f32);
            if out || [left, top].iter().any(|v| *v == 0 || *v == side - SQUARE) {
                continue;
            }
            // The square with what is around it, in grey levels; negative where it is not known or not fresh.
            let mut near = [[0i32; NEIGHBOURHOOD]; NEIGHBOURHOOD];
            let [first_column, first_row] = [column, row].map(|square| wrapped(square * SQUARE + side - NEIGHBOURHOOD_BEFORE, side));
            for (j, near) in near.iter_mut().enumerate() {
                let start = wrapped(first_row + j, side) * side;
                let row = start + first_column..start + first_column + NEIGHBOURHOOD;
                if first_column + NEIGHBOURHOOD <= side {
                    let pixels = memory[row.clone()].iter().zip(&self.ages[row]);
                    near.iter_mut().zip(pixels).for_each(|(near, (pixel, age))| *near = fresh_grey(pixel, *age));
                    continue;
                }
                for (i, near) in near.iter_mut().enumerate() {
                    let at = start + wrapped(first_column + i, side);
                    *near = fresh_grey(&memory[at], self.ages[at]);
                }
            }
            self.points[row * squares + column] = MotionPoint::steepest(&near, [column * SQUARE, row * SQUARE], least);
        }
        Ok(())
    }
}

/// The dry ground as it lies in the picture.
pub(super) struct DryGround<'a> {
    /// The memory.
    pixels: &'a [Vec4b],
    side: usize,
    origin: [usize; 2],
    now: Pose,
}

impl DryGround<'_> {
    /// Its colour at a place in the picture, grey levels, where it is known.
    #[inline(always)]
    pub(super) fn at(&self, place: [f32; 2]) -> Option<[f32; 3]> {
        let [x, y] = self.now.map.apply_back(place);
        let (column, row, fx, fy) = bilinear_corner(x, y, self.side, self.side)?;
        let (column, row) = (wrapped(column + self.origin[0], self.side), wrapped(row + self.origin[1], self.side));
        let (right, below) = (wrapped(column + 1, self.side), wrapped(row + 1, self.side));
        let at = |row: usize, column: usize| self.pixels.get(row * self.side + column).map(|p| p.0);
        let four = [at(row, column)?, at(row, right)?, at(below, column)?, at(below, right)?];
        let known = four.iter().all(|p| p[3] > 0);
        let [a, b, c, d] = four.map(|p| p.map(f32::from));
        let mix = |k: usize| {
            let (top, bottom) = (a[k] + (b[k] - a[k]) * fx, c[k] + (d[k] - c[k]) * fx);
            self.now.gain * (top + (bottom - top) * fy)
        };
        known.then(|| [mix(0), mix(1), mix(2)])
    }
}

/// One row of the window, as it lies in the picture.
struct MemoryRow {
    /// Place of its first pixel in the picture, px.
    from: [f32; 2],
    /// From the window to the picture.
    map: RigidMap,
    /// Side of the window, px.
    side: f32,
}

impl MemoryRow {
    #[inline(always)]
    fn new(y: usize, map: RigidMap, side: usize) -> Self {
        Self { from: map.apply([0.0, y as f32]), map, side: side as f32 }
    }

    /// Place of a column in the picture, px.
    #[inline(always)]
    fn place(&self, x: usize) -> [f32; 2] {
        [self.from[0] + x as f32 * self.map.cos, self.from[1] + x as f32 * self.map.sin]
    }

    /// The columns where `field` is at least `least`, cut out of `span`.
    #[inline(always)]
    fn at_least(&self, field: LinearField, least: f32, span: [f32; 2]) -> [f32; 2] {
        at_least(field.at(self.from), field.per_x * self.map.cos + field.per_y * self.map.sin, least, span)
    }

    /// The columns, from the first to before the second, that a picture of `size` shows in the air.
    #[inline(always)]
    fn in_picture(&self, height_px: LinearField, size: Size) -> Option<(usize, usize)> {
        let ([x, y], RigidMap { cos, sin, .. }) = (self.from, self.map);
        let span = self.at_least(height_px, 0.0, [0.0, self.side]);
        let span = at_least(x, cos, 0.01, span);
        let span = at_least(-x, -cos, 1.01 - size.width as f32, span);
        let span = at_least(y, sin, 0.01, span);
        let [x0, x1] = at_least(-y, -sin, 1.01 - size.height as f32, span);
        let (x0, x1) = (x0.ceil().max(0.0), x1.floor().min(self.side));
        (x1 > x0).then_some((x0 as usize, x1 as usize))
    }

    /// The columns, from the first to before the second, where `field` is at least 1.
    #[inline(always)]
    fn dry(&self, field: LinearField) -> [i32; 2] {
        self.at_least(field, 1.0, [0.0, self.side]).map(|x| x as i32)
    }
}
