//! Clear water: what differs from the dry background, which turns behind the container.
//!
//! Water has no colour, but it bends light: seen through a stream, the background is darker, displaced and glittering. So the
//! dry background is remembered as a picture and compared. The container turns, therefore the memory is moved first: the
//! motion since the last frame (shift, turn, exposure) is estimated from all that is dry (Gauss-Newton on three scales, robust
//! weights). What then still differs is liquid. Its outer edge is the line from axis to axis that has most difference just
//! inside and none outside.
//!
//! Where the background was hidden behind liquid or glass until now, nothing is known of it, and nothing is guessed: while most of
//! the edge lies on such ground the answer is [`Seen::Unsure`]. That happens when a patterned background moves out from behind the
//! stream; an even one looks the same everywhere. The first frame must be dry.
//!
//! Works on the region at a width of about 320 px for the whole picture. Runs on the extraction thread; some of its pictures are
//! allocated anew in each frame. No failures but OpenCV's.

use opencv::core::{self, CV_8UC1, CV_16SC2, CV_32F, CV_32FC1, Mat, Point, Scalar, Size, Vector};
use opencv::imgproc;
use opencv::prelude::*;

use crate::extract::Axes;

/// Width of the whole picture at which this works, px; all lengths below are px at that size.
const WIDTH_PX: f32 = 320.0;
/// Air begins this far above the top edge: the rim's light spreads.
const RIM_PX: f32 = 2.0;
/// Rays between the axes, and samples 1 px apart on each, from [`NEAR_PX`] on.
const RAYS: usize = 48;
const SAMPLES: usize = 200;
const NEAR_PX: f32 = 2.0;
/// Lines that are tried: distances on either axis in geometric steps, and the largest ratio of the two.
const LEGS: usize = 64;
const LEG_FIRST_PX: f32 = 7.0;
const LEG_FACTOR: f32 = 1.055;
const LEG_RATIO: f32 = 5.0;
/// Difference in units of the noise: from here on it is liquid, and fully so this much further on; below, it is dry, and fully so
/// this much before.
const WET_FROM: f32 = 2.2;
const WET_SPAN: f32 = 4.0;
const DRY_SPAN: f32 = 1.2;
/// A difference up to this, in units of the noise, is still background.
const CALM: f32 = 4.0;
/// Least noise, grey levels: rounding.
const NOISE_LEAST: f32 = 0.5;
/// Share of the background's slope that counts as error of its place; grows with each frame since it was last seen.
const SLOPE_FRESH: f32 = 0.15;
const SLOPE_AGE: f32 = 0.06;
const SLOPE_MOST: f32 = 0.6;
/// A pixel of the remembered background counts as unknown from this share of unknown sources on.
const UNKNOWN: f32 = 0.3;
/// Least score and least share of the line's length with an edge: to begin a stream, and to continue one.
const BEGIN: [f32; 2] = [0.75, 0.7];
const CONTINUE: [f32; 2] = [0.6, 0.6];
/// Least score of a piece of the line that counts as edge.
const PIECE: f32 = 0.35;
/// Least share of the edge's inner side where the background is known.
const KNOWN: f32 = 0.65;
/// Largest share of the air beyond the line that may differ from the background.
const ELSEWHERE: f32 = 0.06;
/// Frames after a stream during which the place where it was is not taken for background.
const AFTERWARDS: u32 = 3;
/// Weight of the previous line's neighbourhood (as a Gaussian of this width in the logarithm of its legs).
const STAY: f32 = 0.25;
const STAY_WIDTH: f32 = 0.4;
/// How fast the memory follows what is seen: where it fits and where it does not.
const FOLLOW: f32 = 0.5;
const FOLLOW_SLOWLY: f32 = 0.3;

/// What was seen.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Seen {
    /// No stream.
    Dry,
    /// The background is not known well enough to tell.
    Unsure,
    /// A stream; the share of its edge that is seen.
    Stream(f32),
}

/// Motion of the background from frame to frame: shift in px and turn in radians about the region's middle.
type Motion = [f64; 3];

/// Remembers the dry background of one camera.
pub struct Background {
    scale: f32,
    size: Size,
    axes: Axes,
    directions: Vec<[f32; 2]>,
    /// Distance above the top edge's line and to the right of the left side's, px.
    above: Vec<f32>,
    right: Vec<f32>,
    map_a: Mat,
    map_b: Mat,
    /// Each line's legs on the x- and y-axis, px, and their logarithms; its sample and its weight on each ray.
    legs: Vec<[f32; 2]>,
    log_legs: Vec<[f32; 2]>,
    cells: Vec<u16>,
    weights: Vec<f32>,
    // The memory: grey levels, share of unknown sources (0 to 1), frames since last seen.
    dry: Option<Mat>,
    unknown: Mat,
    age: Mat,
    motion: Motion,
    line: Option<[f32; 2]>,
    last_line: [f32; 2],
    dry_frames: u32,
    edges: Vec<[f32; 2]>,
    scores: Vec<f32>,
    known_inside: Vec<f32>,
    scratch: Vec<f32>,
}

/// The rows of a continuous picture of 32-bit numbers.
fn values(picture: &Mat) -> opencv::Result<&[f32]> {
    picture.data_typed::<f32>()
}

fn blur(picture: &Mat, side: i32) -> opencv::Result<Mat> {
    let mut out = Mat::default();
    imgproc::blur(picture, &mut out, Size::new(side, side), Point::new(-1, -1), core::BORDER_REFLECT_101)?;
    Ok(out)
}

fn half(picture: &Mat) -> opencv::Result<Mat> {
    let mut out = Mat::default();
    imgproc::resize(picture, &mut out, Size::new(picture.cols() / 2, picture.rows() / 2), 0.0, 0.0, imgproc::INTER_AREA)?;
    Ok(out)
}

/// Slopes along x and y, grey levels a px.
fn slopes(picture: &Mat) -> opencv::Result<[Mat; 2]> {
    let (mut x, mut y) = (Mat::default(), Mat::default());
    imgproc::scharr(picture, &mut x, CV_32F, 1, 0, 1.0 / 32.0, 0.0, core::BORDER_REPLICATE)?;
    imgproc::scharr(picture, &mut y, CV_32F, 0, 1, 1.0 / 32.0, 0.0, core::BORDER_REPLICATE)?;
    Ok([x, y])
}

/// The median, upper one of two; reorders.
fn median(values: &mut [f32]) -> f32 {
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f32::total_cmp).1 }
}

/// Solves `matrix x = right` by elimination with pivots; zeros where it is singular.
fn solve(mut matrix: [[f64; 4]; 4], mut right: [f64; 4]) -> [f64; 4] {
    for k in 0..4 {
        let pivot = (k..4).max_by(|a, b| matrix[*a][k].abs().total_cmp(&matrix[*b][k].abs())).unwrap_or(k);
        matrix.swap(k, pivot);
        right.swap(k, pivot);
        if matrix[k][k].abs() < 1e-9 {
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
        x[k] = (right[k] - (k + 1..4).map(|j| matrix[k][j] * x[j]).sum::<f64>()) / matrix[k][k];
    }
    x
}

impl Background {
    /// For a region of `region_px` (width, height) of a picture `width_px` wide; `axes` relative to the region, px.
    pub fn new(axes: &Axes, region_px: [i32; 2], width_px: u32) -> opencv::Result<Self> {
        let scale = (width_px as f32 / WIDTH_PX).round().max(1.0);
        let size = Size::new(region_px[0] / scale as i32, region_px[1] / scale as i32);
        let small = |v: f32| (v + 0.5) / scale - 0.5;
        let axes = Axes { lip_px: axes.lip_px.map(small), ..*axes };
        let ([lip_x, lip_y], x, y) = (axes.lip_px, axes.x, axes.y);
        let sine = x[0] * y[1] - x[1] * y[0];
        let turn = sine.signum();
        let (mut above, mut right) = (Vec::new(), Vec::new());
        for row in 0..size.height {
            for column in 0..size.width {
                let p = [column as f32 - lip_x, row as f32 - lip_y];
                above.push((x[0] * p[1] - x[1] * p[0]) * turn);
                right.push((p[0] * y[1] - p[1] * y[0]) * turn);
            }
        }
        let between = sine.abs().atan2(x[0] * y[0] + x[1] * y[1]);
        let directions: Vec<[f32; 2]> = (0..RAYS)
            .map(|i| {
                let (sin, cos) = ((i as f32 + 0.5) / RAYS as f32 * between * turn).sin_cos();
                [x[0] * cos - x[1] * sin, x[0] * sin + x[1] * cos]
            })
            .collect();
        let mut map_x = Mat::new_rows_cols_with_default(RAYS as i32, SAMPLES as i32, CV_32FC1, Scalar::all(0.0))?;
        let mut map_y = map_x.try_clone()?;
        for (i, along) in directions.iter().enumerate() {
            let (row_x, row_y) = (map_x.at_row_mut::<f32>(i as i32)?, map_y.at_row_mut::<f32>(i as i32)?);
            for r in 0..SAMPLES {
                row_x[r] = lip_x + (NEAR_PX + r as f32) * along[0];
                row_y[r] = lip_y + (NEAR_PX + r as f32) * along[1];
            }
        }
        let (mut map_a, mut map_b) = (Mat::default(), Mat::default());
        imgproc::convert_maps(&map_x, &map_y, &mut map_a, &mut map_b, CV_16SC2, false)?;

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
                radii[k] < NEAR_PX + SAMPLES as f32 - 12.0
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
            cells.extend(radii.iter().map(|r| (r - NEAR_PX).round().max(0.0) as u16));
            weights.extend((0..RAYS).map(|k| weight(k) / total));
        }
        Ok(Self {
            scale,
            size,
            axes,
            directions,
            above,
            right,
            map_a,
            map_b,
            log_legs: legs.iter().map(|l: &[f32; 2]| l.map(f32::ln)).collect(),
            legs,
            cells,
            weights,
            dry: None,
            unknown: Mat::default(),
            age: Mat::default(),
            motion: [0.0; 3],
            line: None,
            last_line: [0.0; 2],
            dry_frames: 0,
            edges: Vec::with_capacity(RAYS),
            scores: vec![0.0; RAYS * SAMPLES],
            known_inside: vec![0.0; RAYS * SAMPLES],
            scratch: Vec::new(),
        })
    }

    /// Edge points of the stream in the last picture, in the region's px, from the x-axis to the y-axis.
    pub fn edges_px(&self) -> &[[f32; 2]] {
        &self.edges
    }

    fn air(&self) -> impl Iterator<Item = bool> + '_ {
        self.above.iter().map(|v| *v >= RIM_PX)
    }

    /// The triangle of a line with `grow` px around it, 255 inside; with `beside`, all left of the left side's line too, where
    /// the stream falls.
    fn liquid(&self, [a, b]: [f32; 2], grow: i32, beside: bool) -> opencv::Result<Mat> {
        let mut mask = Mat::new_size_with_default(self.size, CV_8UC1, Scalar::all(0.0))?;
        let at = |r: f32, along: [f32; 2]| {
            let p = |k: usize| ((self.axes.lip_px[k] + r * along[k]) * 16.0).round() as i32;
            Point::new(p(0), p(1))
        };
        let corners = Vector::from_slice(&[at(0.0, self.axes.x), at(a, self.axes.x), at(b, self.axes.y)]);
        imgproc::fill_convex_poly(&mut mask, &corners, Scalar::all(255.0), imgproc::LINE_8, 4)?;
        let brush = imgproc::get_structuring_element_def(imgproc::MORPH_RECT, Size::new(2 * grow + 1, 2 * grow + 1))?;
        let mut grown = Mat::default();
        imgproc::dilate(&mask, &mut grown, &brush, Point::new(-1, -1), 1, core::BORDER_CONSTANT, Scalar::all(0.0))?;
        if beside {
            for (pixel, right) in grown.data_bytes_mut()?.iter_mut().zip(&self.right) {
                if *right < 1.0 {
                    *pixel = 255;
                }
            }
        }
        Ok(grown)
    }

    /// The affine map of `motion` at `factor` of the size.
    fn map(&self, motion: &Motion, factor: f64) -> opencv::Result<Mat> {
        let (sin, cos) = motion[2].sin_cos();
        let (x, y) = (f64::from(self.size.width) / 2.0 * factor, f64::from(self.size.height) / 2.0 * factor);
        let (tx, ty) = (x - cos * x + sin * y + motion[0] * factor, y - sin * x - cos * y + motion[1] * factor);
        Mat::from_slice_2d(&[[cos, -sin, tx], [sin, cos, ty]])
    }

    /// Improves `motion` and `exposure` so that `memory`, moved, becomes `now` where `mask` is 255; all three at `factor` of the
    /// size. Every `step`-th pixel of every `step`-th row is used. Returns the mean size of what is left, grey levels.
    #[allow(clippy::too_many_arguments)]
    fn improve(
        &mut self,
        memory: &Mat,
        mask: &Mat,
        now: &Mat,
        motion: &mut Motion,
        exposure: &mut f64,
        factor: f64,
        rounds: usize,
        step: usize,
    ) -> opencv::Result<f64> {
        let [slope_x, slope_y] = slopes(memory)?;
        let (columns, rows) = (memory.cols() as usize, memory.rows() as usize);
        let (middle_x, middle_y) = (f64::from(self.size.width) / 2.0 * factor, f64::from(self.size.height) / 2.0 * factor);
        let mask = mask.data_bytes()?;
        let before = self.motion;
        let mut moved = Mat::default();
        let mut left = f64::MAX;
        for _ in 0..rounds {
            let map = self.map(motion, factor)?;
            let how = imgproc::INTER_LINEAR | imgproc::WARP_INVERSE_MAP;
            imgproc::warp_affine(now, &mut moved, &map, memory.size()?, how, core::BORDER_CONSTANT, Scalar::all(-1000.0))?;
            let (moved, memory) = (values(&moved)?, values(memory)?);
            let (slope_x, slope_y) = (values(&slope_x)?, values(&slope_y)?);
            let used = || {
                (0..rows)
                    .step_by(step)
                    .flat_map(move |y| (0..columns).step_by(step).map(move |x| (x, y)))
                    .filter(|(x, y)| mask[y * columns + x] == 255 && moved[y * columns + x] > -0.5)
            };
            let gain = (1.0 + *exposure) as f32;
            self.scratch.clear();
            self.scratch.extend(used().map(|(x, y)| (moved[y * columns + x] - gain * memory[y * columns + x]).abs()));
            let count = self.scratch.len();
            if count < 60 {
                return Ok(f64::MAX);
            }
            left = self.scratch.iter().map(|v| f64::from(*v)).sum::<f64>() / count as f64;
            let noise = f64::from(median(&mut self.scratch)) * 1.5 + 0.7;
            let (mut normal, mut right) = ([[0.0f64; 4]; 4], [0.0f64; 4]);
            for (x, y) in used() {
                let i = y * columns + x;
                let error = f64::from(moved[i] - gain * memory[i]);
                let weight = (2.0 * noise / error.abs().max(1e-6)).min(1.0);
                let (gx, gy) = (f64::from(slope_x[i]), f64::from(slope_y[i]));
                let lever = -gx * (y as f64 - middle_y) + gy * (x as f64 - middle_x);
                let row = [gx * factor, gy * factor, lever, f64::from(memory[i])];
                for k in 0..4 {
                    right[k] += weight * row[k] * error;
                    for j in 0..=k {
                        normal[k][j] += weight * row[k] * row[j];
                    }
                }
            }
            let mut normal: [[f64; 4]; 4] =
                std::array::from_fn(|k| std::array::from_fn(|j| if j <= k { normal[k][j] } else { normal[j][k] }));
            // Along a line, or before an even wall, the picture does not tell the motion: then it stays what it was, and fades.
            let hold = 0.03 * count as f64 * noise * noise;
            for (k, size) in [1.0, 1.0, 2500.0].into_iter().enumerate() {
                normal[k][k] += 1.15 * hold * size;
                right[k] += hold * size * (motion[k] - before[k]) + 0.15 * hold * size * motion[k];
            }
            normal[3][3] += 1.0;
            let change = solve(normal, right);
            for k in 0..3 {
                motion[k] -= change[k];
            }
            *exposure += change[3];
            if change[0].abs() + change[1].abs() < 0.02 {
                break;
            }
        }
        Ok(left)
    }

    /// Motion and change of exposure from the memory to `now`.
    fn register(&mut self, dry: &Mat, now: &Mat) -> opencv::Result<(Motion, f64)> {
        let liquid = match self.line {
            Some(line) => Some(self.liquid(line, 3, true)?),
            None => None,
        };
        let mut mask = Mat::new_size_with_default(self.size, CV_8UC1, Scalar::all(0.0))?;
        {
            let unknown = values(&self.unknown)?;
            let liquid = liquid.as_ref().map(|m| m.data_bytes()).transpose()?;
            for (i, (pixel, air)) in mask.data_bytes_mut()?.iter_mut().zip(self.air()).enumerate() {
                if air && unknown[i] < UNKNOWN && liquid.is_none_or(|l| l[i] == 0) {
                    *pixel = 255;
                }
            }
        }
        let (dry_2, now_2, mask_2) = (half(dry)?, half(now)?, half(&mask)?);
        let (dry_4, now_4, mask_4) = (half(&dry_2)?, half(&now_2)?, half(&mask_2)?);
        // From the last motion and from rest: a joint starts and stops within a frame.
        let (mut motion, mut exposure) = (self.motion, 0.0);
        let mut left = self.improve(&dry_4, &mask_4, &now_4, &mut motion, &mut exposure, 0.25, 10, 1)?;
        if self.motion != [0.0; 3] {
            let (mut other, mut its_exposure) = ([0.0; 3], 0.0);
            let its_left = self.improve(&dry_4, &mask_4, &now_4, &mut other, &mut its_exposure, 0.25, 10, 1)?;
            if its_left < 0.98 * left {
                (motion, exposure, left) = (other, its_exposure, its_left);
            }
        }
        if left < f64::MAX {
            // From coarse to fine.
            self.improve(&dry_2, &mask_2, &now_2, &mut motion, &mut exposure, 0.5, 5, 1)?;
            self.improve(dry, &mask, now, &mut motion, &mut exposure, 1.0, 3, 2)?;
        }
        Ok((motion, exposure))
    }

    /// Looks at the next picture: the region in grey, at full size.
    pub fn look(&mut self, region: &Mat) -> opencv::Result<Seen> {
        self.edges.clear();
        let (mut small, mut now) = (Mat::default(), Mat::default());
        imgproc::resize(region, &mut small, self.size, 0.0, 0.0, imgproc::INTER_AREA)?;
        small.convert_to(&mut now, CV_32F, 1.0, 0.0)?;
        let Some(dry) = self.dry.take() else {
            self.unknown = Mat::new_size_with_default(self.size, CV_32FC1, Scalar::all(0.0))?;
            self.age = self.unknown.try_clone()?;
            self.dry = Some(now);
            self.dry_frames = AFTERWARDS + 1;
            return Ok(Seen::Dry);
        };

        // The memory, moved to where it should be seen now.
        let (motion, exposure) = self.register(&dry, &now)?;
        self.motion = motion;
        let map = self.map(&motion, 1.0)?;
        let (mut moved, mut unknown, mut age) = (Mat::default(), Mat::default(), Mat::default());
        imgproc::warp_affine(&dry, &mut moved, &map, self.size, imgproc::INTER_LINEAR, core::BORDER_REPLICATE, Scalar::default())?;
        let mut dry = Mat::default();
        moved.convert_to(&mut dry, -1, 1.0 + exposure, 0.0)?;
        let mut source = self.unknown.try_clone()?;
        for (value, air) in source.data_typed_mut::<f32>()?.iter_mut().zip(self.air()) {
            if !air {
                *value = 1.0;
            }
        }
        imgproc::warp_affine(&source, &mut unknown, &map, self.size, imgproc::INTER_LINEAR, core::BORDER_CONSTANT, Scalar::all(1.0))?;
        imgproc::warp_affine(&self.age, &mut age, &map, self.size, imgproc::INTER_NEAREST, core::BORDER_CONSTANT, Scalar::all(150.0))?;
        let known: Vec<bool> = values(&unknown)?.iter().zip(self.air()).map(|(u, air)| air && *u < UNKNOWN).collect();

        // What differs, less what a small error of place explains, in units of the noise.
        let mut difference = Mat::default();
        core::subtract(&now, &dry, &mut difference, &core::no_array(), -1)?;
        for (value, air) in difference.data_typed_mut::<f32>()?.iter_mut().zip(self.air()) {
            if !air {
                *value = 0.0;
            }
        }
        let mut difference = blur(&difference, 2)?;
        difference.data_typed_mut::<f32>()?.iter_mut().for_each(|v| *v = v.abs());
        let mut difference = blur(&difference, 3)?;
        let [slope_x, slope_y] = slopes(&dry)?;
        let mut slope = Mat::default();
        core::magnitude(&slope_x, &slope_y, &mut slope)?;
        let slope = blur(&slope, 3)?;
        let (ages, slope) = (values(&age)?, values(&slope)?);
        self.scratch.clear();
        for (i, value) in difference.data_typed_mut::<f32>()?.iter_mut().enumerate() {
            let error = (SLOPE_FRESH + SLOPE_AGE * ages[i]).min(SLOPE_MOST) * slope[i];
            *value = (*value - error).max(0.0);
            if known[i] && i % 3 == 0 {
                self.scratch.push(*value);
            }
        }
        let noise = median(&mut self.scratch).max(NOISE_LEAST);
        difference.data_typed_mut::<f32>()?.iter_mut().for_each(|v| *v /= noise);
        let away = values(&difference)?;

        // 1 is liquid, -1 dry, 0 not known.
        let mut wetness = Mat::new_size_with_default(self.size, CV_32FC1, Scalar::all(0.0))?;
        let mut sureness = wetness.try_clone()?;
        {
            let (wet, sure) = (wetness.data_typed_mut::<f32>()?, sureness.data_typed_mut::<f32>()?);
            for (i, z) in away.iter().enumerate() {
                if known[i] && self.right[i] >= 0.0 {
                    wet[i] = if *z > WET_FROM { (z - WET_FROM) / WET_SPAN } else { (z - WET_FROM) / DRY_SPAN }.clamp(-1.0, 1.0);
                }
                sure[i] = f32::from(u8::from(known[i]));
            }
        }
        self.score(&wetness, &sureness)?;
        let best = self.best_line();
        let mut seen = Seen::Dry;
        if let Some((index, score, share, known_share)) = best {
            let found = self.legs[index];
            let near = self.liquid(found, 6, false)?;
            let near = near.data_bytes()?;
            let (mut other, mut count) = (0usize, 0usize);
            for (i, z) in away.iter().enumerate() {
                if known[i] && near[i] == 0 && self.right[i] > 0.0 {
                    count += 1;
                    other += usize::from(*z > CALM);
                }
            }
            let least = if self.line.is_some() { CONTINUE } else { BEGIN };
            let strange = other as f32 >= ELSEWHERE * count.max(1) as f32;
            if strange {
                seen = Seen::Unsure;
            } else if score > least[0] && share > least[1] && known_share >= KNOWN {
                seen = Seen::Stream(share);
                self.last_line = found;
                self.find_edges(index);
            } else if self.dry_frames <= AFTERWARDS && self.known_share(self.nearest(self.last_line)) < KNOWN {
                seen = Seen::Unsure;
            }
        }
        match seen {
            Seen::Stream(_) => (self.line, self.dry_frames) = (Some(self.last_line), 0),
            Seen::Dry => (self.line, self.dry_frames) = (None, self.dry_frames.saturating_add(1)),
            Seen::Unsure => self.line = None,
        }
        self.remember(dry, unknown, age, &now, &known, away, matches!(seen, Seen::Stream(_)))?;
        Ok(seen)
    }

    /// Takes what is dry in `now` over into the memory.
    #[allow(clippy::too_many_arguments)]
    fn remember(
        &mut self,
        mut dry: Mat,
        mut unknown: Mat,
        mut age: Mat,
        now: &Mat,
        known: &[bool],
        away: &[f32],
        stream: bool,
    ) -> opencv::Result<()> {
        // Near a stream, or where one was a moment ago, what was hidden is not taken for background.
        let [a, b] = self.last_line;
        let masks = if self.dry_frames <= AFTERWARDS {
            let bulge = 2.0 + 0.1 * (a * b).sqrt();
            Some((self.liquid([a, b], bulge as i32, true)?, self.liquid([1.35 * a, 1.35 * b], 8, true)?))
        } else {
            None
        };
        let masks = match &masks {
            Some((inner, outer)) => Some((inner.data_bytes()?, outer.data_bytes()?)),
            None => None,
        };
        let now = values(now)?;
        let (dry_levels, hidden, ages) = (dry.data_typed_mut::<f32>()?, unknown.data_typed_mut::<f32>()?, age.data_typed_mut::<f32>()?);
        for i in 0..now.len() {
            let (inner, outer) = masks.map_or((false, false), |(inner, outer)| (inner[i] != 0, outer[i] != 0));
            let calm = away[i] < CALM;
            if self.above[i] < RIM_PX {
                dry_levels[i] = now[i];
            } else if known[i] && ((calm && !(inner && stream)) || !outer) {
                dry_levels[i] += (now[i] - dry_levels[i]) * if calm { FOLLOW } else { FOLLOW_SLOWLY };
                (hidden[i], ages[i]) = (0.5 * hidden[i], 0.0);
            } else if !known[i] && !outer {
                (dry_levels[i], hidden[i], ages[i]) = (now[i], 0.0, 0.0);
            } else {
                ages[i] = (ages[i] + 1.0).min(150.0);
            }
        }
        (self.dry, self.unknown, self.age) = (Some(dry), unknown, age);
        Ok(())
    }

    /// How well the stream's edge would lie at each sample of each ray (`self.scores`: liquid in the 5 px inside it, none in the
    /// 7 px outside), and the share of that inside where the background is known (`self.known_inside`).
    fn score(&mut self, wetness: &Mat, sureness: &Mat) -> opencv::Result<()> {
        let (mut wet, mut sure) = (Mat::default(), Mat::default());
        for (from, to, how) in [(wetness, &mut wet, imgproc::INTER_LINEAR), (sureness, &mut sure, imgproc::INTER_NEAREST)] {
            imgproc::remap(from, to, &self.map_a, &self.map_b, how, core::BORDER_CONSTANT, Scalar::default())?;
        }
        let mut sums = [[0.0f32; SAMPLES + 1]; 2];
        for ray in 0..RAYS {
            for (sums, row) in sums.iter_mut().zip([wet.at_row::<f32>(ray as i32)?, sure.at_row::<f32>(ray as i32)?]) {
                for (i, value) in row.iter().enumerate() {
                    sums[i + 1] = sums[i] + value;
                }
            }
            let mean = |k: usize, from: usize, to: usize| {
                let (from, to) = (from.min(SAMPLES), to.min(SAMPLES));
                (sums[k][to] - sums[k][from]) / (to - from).max(1) as f32
            };
            let score = |i: usize| (1.3 * mean(0, i.saturating_sub(4), i + 1) - 0.4 * mean(0, i + 2, i + 9)).clamp(-1.0, 1.6);
            let (scores, known) = (&mut self.scores[ray * SAMPLES..][..SAMPLES], &mut self.known_inside[ray * SAMPLES..][..SAMPLES]);
            // The outline is a little curved: a neighbour counts too.
            let mut around = [score(0), score(0), score(1)];
            for i in 0..SAMPLES {
                scores[i] = around[0].max(around[1]).max(around[2]);
                known[i] = mean(1, i.saturating_sub(4), i + 1);
                around = [around[1], around[2], score((i + 2).min(SAMPLES - 1))];
            }
        }
        Ok(())
    }

    fn known_share(&self, line: usize) -> f32 {
        let range = line * RAYS..(line + 1) * RAYS;
        let at = |(ray, cell): (usize, &u16)| self.known_inside[ray * SAMPLES + usize::from(*cell)];
        self.cells[range.clone()].iter().enumerate().map(at).zip(&self.weights[range]).map(|(k, w)| k * w).sum()
    }

    /// Square of the distance of a line's legs from others, all as logarithms.
    fn distance(&self, line: usize, [a, b]: [f32; 2]) -> f32 {
        let ([p, q], square) = (self.log_legs[line], |v: f32| v * v);
        square(p - a) + square(q - b)
    }

    fn nearest(&self, legs: [f32; 2]) -> usize {
        let logs = legs.map(f32::ln);
        (0..self.legs.len()).min_by(|i, j| self.distance(*i, logs).total_cmp(&self.distance(*j, logs))).unwrap_or(0)
    }

    /// The best line: its number, score, share of its length with an edge, share of known background inside it.
    fn best_line(&self) -> Option<(usize, f32, f32, f32)> {
        let before = self.line.map(|legs| legs.map(f32::ln));
        let mut best: Option<(usize, f32, f32, f32)> = None;
        for line in 0..self.legs.len() {
            let range = line * RAYS..(line + 1) * RAYS;
            let (mut score, mut share) = (0.0, 0.0);
            for (ray, (cell, weight)) in self.cells[range.clone()].iter().zip(&self.weights[range]).enumerate() {
                let value = self.scores[ray * SAMPLES + usize::from(*cell)];
                score += weight * value;
                share += if value > PIECE { *weight } else { 0.0 };
            }
            let stay = match before {
                Some(logs) => STAY * (-0.5 * self.distance(line, logs) / (STAY_WIDTH * STAY_WIDTH)).exp(),
                None => 0.0,
            };
            let total = score + 0.7 * share + stay;
            if best.is_none_or(|(_, _, _, most)| total > most) {
                best = Some((line, score, share, total));
            }
        }
        best.map(|(line, score, share, _)| (line, score, share, self.known_share(line)))
    }

    /// The edge on each ray near `line`, into `self.edges`.
    fn find_edges(&mut self, line: usize) {
        for ray in 1..RAYS - 1 {
            let middle = usize::from(self.cells[line * RAYS + ray]);
            let reach = 2.max((0.08 * middle as f32) as usize);
            let row = &self.scores[ray * SAMPLES..][..SAMPLES];
            let range = middle.saturating_sub(reach)..(middle + reach + 1).min(SAMPLES);
            let best = range.clone().map(|i| row[i]).fold(f32::MIN, f32::max);
            if best <= PIECE {
                continue;
            }
            // Equal neighbours: the middle of them.
            let (mut sum, mut count) = (0usize, 0usize);
            for i in range.filter(|i| row[*i] >= best - 1e-6) {
                (sum, count) = (sum + i, count + 1);
            }
            let radius = NEAR_PX + sum as f32 / count as f32 + 0.5;
            let full = |k: usize| (self.axes.lip_px[k] + radius * self.directions[ray][k] + 0.5) * self.scale - 0.5;
            self.edges.push([full(0), full(1)]);
        }
    }
}
