//! V_e from one image: the triangle of section 3.3.1 and Fig. 4.
//!
//! The liquid leaves the container at the lip `O`, where the glass's top edge (x-axis) meets its left side (y-axis). Between
//! the two axes, seen from `O`, liquid comes first and background after it, whatever the tilt. So the wedge between the
//! axes is resampled once into rays from `O` (`cv::remap`), one ray a row:
//!
//! 1. On each ray the outer edge is where the count of liquid minus background pixels is largest.
//! 2. A line through these edges is found robustly (most inliers of fixed pairs, then least squares).
//! 3. Across that line the image is read again along short normals; where each profile passes half way from liquid to
//!    background is an edge point of sub-pixel accuracy. A Huber line through them cuts the axes at a and b; too few, and there is none.
//! 4. `V_e = a b sin(phi) / 2`, phi between the axes.
//!
//! A stream fills nearly every ray from the lip on; drops and splashes do not, so they are no stream, and no stream is
//! exactly 0. Runs on the worker's extraction thread; all buffers are kept, so after the first frame nothing is allocated
//! but OpenCV's matrix headers. A frame that cannot be measured is no error:
//! it gets a [`Doubt`].

use std::time::Instant;

use opencv::core::{self, CV_16SC2, CV_32FC1, Mat, Rect, Scalar};
use opencv::imgproc;
use opencv::prelude::*;
use shared::config::{CameraConfig, ImageConfig, LiquidMethod};
use shared::messages::{Doubt, PixelFormat};

use crate::clear::{ClearWater, Seen};
use crate::ground::median;

/// Rays between the axes.
const RAYS: usize = 48;
/// Distance from the lip at which rays begin, px: bead, rim and corner mix before it.
const NEAR_PX: f32 = 3.0;
/// Samples along a ray are 1 px apart up to this distance from the lip, then further, up to [`STEP_MOST_PX`]: the rays only
/// have to find the edge to within a profile's reach.
const DENSE_PX: f32 = 36.0;
const STEP_MOST_PX: f32 = 5.0;
/// Edges that are tried in pairs for the first line.
const PICKS: usize = 13;
/// Profiles across the line.
const PROFILES: usize = 48;
/// With a smaller share of them that show an edge there is none.
const PROFILES_LEAST: f32 = 0.3;
/// The same for clear water, and its least confidence to begin a stream and to go on: fainter edges are none.
const PROFILES_FEW: f32 = 0.2;
const BEGIN_CONFIDENCE: f32 = 0.25;
const GO_ON_CONFIDENCE: f32 = 0.1;
/// Less, down to this share, where the mean grey level is below this: in dim light all contrast is (before a dark wall it need not be).
const LIT_LEAST: f32 = 0.4;
const LIT_LEVEL: f32 = 130.0;
/// Samples of a profile on either side of its centre; the outer [`FLANK`] of them tell liquid and background.
pub(crate) const REACH: usize = 7;
const FLANK: usize = 3;
/// Share of rays that a stream fills.
const STREAM_RAYS: f32 = 0.8;
/// More background than this before the first liquid ends a ray, px.
const GAP_MOST_PX: f32 = 24.0;
/// Least share of liquid between lip and edge on a ray that counts as filled.
const FILLED: f32 = 0.55;
/// Mean grey level below which the region counts as dark.
const DARK_LEVEL: f32 = 14.0;
/// Share of saturated pixels above which the region counts as blown out.
const BLOWN_SHARE: f32 = 0.5;
/// An edge that takes longer than this from 20 to 80 % is blurred, px.
const BLURRED_PX: f32 = 4.5;
/// Without a stream the glass's own edges tell about focus: bundles of profiles across each axis, lines in a bundle (their mean has
/// less noise), distance of the bundles and of the lines, and reach on either side, px.
const RIM_BUNDLES: usize = 12;
const RIM_LINES: usize = 8;
const RIM_BUNDLE_PX: f32 = 14.0;
const RIM_LINE_PX: f32 = 1.5;
const RIM_REACH: usize = 9;
/// Samples on either side of the steepest step (3 px) within which the change is taken.
const RIM_AROUND: usize = 3;
/// Least change of brightness across the rim that tells anything, grey levels, and least number of bundles that have it.
const RIM_CONTRAST: f32 = 14.0;
const RIM_SEEN: usize = 5;
/// The change across the rim over its steepest step is its width, px: from here on it is blurred.
const RIM_BLURRED_PX: f32 = 5.6;

/// Why an extractor cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum ExtractError {
    /// The axes do not cross in or near the region, or the region shows nothing between them.
    #[error("image.region_px = {region:?}: {what}; the region must hold the lip (the axes cross at {lip:?}) and the space over it")]
    Region {
        /// The region.
        region: [u32; 4],
        /// Where the axes cross, px.
        lip: [i32; 2],
        /// What is wrong.
        what: &'static str,
    },
    /// The colour method on a camera without colour.
    #[error("image.method = \"colour\" needs a colour camera, this one gives grey pictures; use method = \"clear\"")]
    NoColour,
    /// OpenCV refused.
    #[error("OpenCV: {0}")]
    OpenCv(#[from] opencv::Error),
}

/// One image: pixels row by row without padding.
#[derive(Debug, Clone, Copy)]
pub struct Image<'a> {
    /// Width in px.
    pub width_px: u32,
    /// Height in px.
    pub height_px: u32,
    /// Layout of the pixels.
    pub format: PixelFormat,
    /// `width_px * height_px * bytes_per_pixel` bytes.
    pub pixels: &'a [u8],
}

/// What was measured in one image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// V_e, px^2; exactly 0 without a stream.
    pub area_px2: f32,
    /// 0 (none) to 1 (full).
    pub confidence: f32,
    /// Why it is doubtful.
    pub doubt: Doubt,
    /// Corners x0 y0 x1 y1 x2 y2 in the image, px: lip, on the x-axis, on the y-axis; zeros without a stream.
    pub triangle_px: [f32; 6],
}

impl Measurement {
    fn nothing(confidence: f32, doubt: Doubt) -> Self {
        Self { area_px2: 0.0, confidence, doubt, triangle_px: [0.0; 6] }
    }
}

/// Time spent in each stage of the last [`Extractor::measure`], ns.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Stages {
    /// Crop, conversion and resampling into rays.
    pub rays_ns: u64,
    /// Light, saturation and repetition checks.
    pub checks_ns: u64,
    /// Telling liquid from background.
    pub segment_ns: u64,
    /// Edge on each ray, first line, profiles, final line.
    pub line_ns: u64,
}

/// A straight line `normal . p = distance`.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Line {
    normal: [f32; 2],
    distance: f32,
}

impl Line {
    fn offset(&self, p: [f32; 2]) -> f32 {
        self.normal[0] * p[0] + self.normal[1] * p[1] - self.distance
    }

    /// Weighted total least squares through `(point, weight)`.
    fn fit(points: impl Iterator<Item = ([f32; 2], f32)> + Clone) -> Option<Self> {
        let (mut total, mut x, mut y) = (0.0f64, 0.0f64, 0.0f64);
        for (p, w) in points.clone() {
            total += f64::from(w);
            x += f64::from(w * p[0]);
            y += f64::from(w * p[1]);
        }
        if total <= 0.0 {
            return None;
        }
        let (x, y) = (x / total, y / total);
        let (mut xx, mut xy, mut yy) = (0.0f64, 0.0f64, 0.0f64);
        for (p, w) in points {
            let (dx, dy) = (f64::from(p[0]) - x, f64::from(p[1]) - y);
            xx += f64::from(w) * dx * dx;
            xy += f64::from(w) * dx * dy;
            yy += f64::from(w) * dy * dy;
        }
        let along = 0.5 * (2.0 * xy).atan2(xx - yy);
        let normal = [-along.sin(), along.cos()];
        Some(Self { normal: normal.map(|v| v as f32), distance: (normal[0] * x + normal[1] * y) as f32 })
    }

    /// Where it cuts the ray from `from` along the unit vector `along`.
    fn cut(&self, from: [f32; 2], along: [f32; 2]) -> f32 {
        -self.offset(from) / (self.normal[0] * along[0] + self.normal[1] * along[1])
    }
}

/// The two axes of Fig. 4 in the image, px.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Axes {
    /// Where they cross: the lip.
    pub lip_px: [f32; 2],
    /// Unit vector along the glass's top edge, into the mouth.
    pub x: [f32; 2],
    /// Unit vector along the container's left side, beyond the rim.
    pub y: [f32; 2],
}

impl Axes {
    /// The axes of a checked configuration (not parallel).
    pub fn new(image: &ImageConfig) -> Self {
        let unit = |a: [f32; 4]| {
            let (dx, dy) = (a[2] - a[0], a[3] - a[1]);
            let length = dx.hypot(dy);
            [dx / length, dy / length]
        };
        let (x, y) = (unit(image.x_axis_px), unit(image.y_axis_px));
        let ([x0, y0, ..], [x1, y1, ..]) = (image.x_axis_px, image.y_axis_px);
        let along = ((x1 - x0) * y[1] - (y1 - y0) * y[0]) / (x[0] * y[1] - x[1] * y[0]);
        Self { lip_px: [x0 + along * x[0], y0 + along * x[1]], x, y }
    }

    /// Sine of the angle from x to y; its sign is the sense of turning.
    pub(crate) fn sine(&self) -> f32 {
        self.x[0] * self.y[1] - self.x[1] * self.y[0]
    }

    /// How far `point_px` lies between the axes: the smaller distance to either, px; negative outside.
    pub fn between(&self, point_px: [f32; 2]) -> f32 {
        let p = [point_px[0] - self.lip_px[0], point_px[1] - self.lip_px[1]];
        let turn = self.sine().signum();
        let from_x = (self.x[0] * p[1] - self.x[1] * p[0]) * turn;
        let from_y = (p[0] * self.y[1] - p[1] * self.y[0]) * turn;
        from_x.min(from_y)
    }

    /// The point at `distance_px` from the lip in the direction `along`.
    fn at(&self, distance_px: f32, along: [f32; 2]) -> [f32; 2] {
        [self.lip_px[0] + distance_px * along[0], self.lip_px[1] + distance_px * along[1]]
    }
}

#[derive(Debug, Clone, Copy)]
struct Ray {
    /// Unit vector.
    along: [f32; 2],
    /// Samples inside the region.
    samples: usize,
}

/// Measures V_e in images of one camera.
pub struct Extractor {
    method: LiquidMethod,
    area_min_px2: f32,
    size_px: [u32; 2],
    region: Rect,
    /// Relative to the region.
    axes: Axes,
    rays: Vec<Ray>,
    /// Distance of each sample from the lip, px, and the length that it stands for.
    radii_px: Vec<f32>,
    steps_px: Vec<f32>,
    map_a: Mat,
    map_b: Mat,
    low: Scalar,
    high: Scalar,
    wraps: bool,
    // Reused from frame to frame.
    converted: Mat,
    polar: Mat,
    smooth: Mat,
    hsv: Mat,
    mask: Mat,
    mask_b: Mat,
    water: ClearWater,
    edges: Vec<[f32; 2]>,
    edge_weights: Vec<f32>,
    fine: Vec<[f32; 2]>,
    fine_weights: Vec<f32>,
    /// How much each edge point is trusted, 0 to 1.
    trusts: Vec<f32>,
    widths: Vec<f32>,
    scratch: Vec<f32>,
    last_hash: Option<u64>,
    /// Mean grey level of what was last looked at.
    level: f32,
    stages: Stages,
}

/// Pixels of the region for the profiles: 3 bytes a pixel, origin at the region's corner.
#[derive(Clone, Copy)]
struct Colours<'a> {
    bytes: &'a [u8],
    stride: usize,
    width: usize,
    height: usize,
}

/// The pixel above and to the left of a place, and how far the place lies to the right of it and below it (0 to 1); none if one of
/// the four pixels around the place is outside.
#[inline]
pub(crate) fn between(x: f32, y: f32, width: usize, height: usize) -> Option<(usize, usize, f32, f32)> {
    if !(x >= 0.0 && y >= 0.0) {
        return None;
    }
    let (column, row) = (x as usize, y as usize);
    if column + 1 >= width || row + 1 >= height {
        return None;
    }
    Some((column, row, x - column as f32, y - row as f32))
}

impl Colours<'_> {
    /// Bilinear sample; none outside.
    fn at(&self, x: f32, y: f32) -> Option<[f32; 3]> {
        let (column, row, fx, fy) = between(x, y, self.width, self.height)?;
        let start = row * self.stride + column * 3;
        let upper = self.bytes.get(start..start + 6)?;
        let lower = self.bytes.get(start + self.stride..start + self.stride + 6)?;
        Some(std::array::from_fn(|c| {
            let top = f32::from(upper[c]) * (1.0 - fx) + f32::from(upper[c + 3]) * fx;
            let bottom = f32::from(lower[c]) * (1.0 - fx) + f32::from(lower[c + 3]) * fx;
            top * (1.0 - fy) + bottom * fy
        }))
    }
}

impl Extractor {
    /// An extractor for images of `camera`'s size with the axes, region and liquid of `image`.
    pub fn new(camera: &CameraConfig, image: &ImageConfig) -> Result<Self, ExtractError> {
        let [x, y, width, height] = image.region_px;
        let region = Rect::new(x as i32, y as i32, width as i32, height as i32);
        let axes = Axes::new(image);
        let fail = |what| ExtractError::Region { region: image.region_px, lip: axes.lip_px.map(|v| v.round() as i32), what };
        // From here on everything is relative to the region.
        let lip = [axes.lip_px[0] - x as f32, axes.lip_px[1] - y as f32];
        let axes = Axes { lip_px: lip, ..axes };
        let sine = axes.sine();
        let size = [width as f32, height as f32];
        if !(0..2).all(|k| lip[k].is_finite() && lip[k] >= 1.0 && lip[k] <= size[k] - 2.0) {
            return Err(fail("the axes cross outside it"));
        }

        let cosine = axes.x[0] * axes.y[0] + axes.x[1] * axes.y[1];
        let between = sine.abs().atan2(cosine);
        // Distance from the lip to the region's border in a direction.
        let room = |along: [f32; 2]| {
            let to = |k: usize| match along[k] {
                v if v > 1e-6 => (size[k] - 2.0 - lip[k]) / v,
                v if v < -1e-6 => (1.0 - lip[k]) / v,
                _ => f32::MAX,
            };
            to(0).min(to(1)).max(0.0)
        };
        let directions = (0..RAYS).map(|i| {
            let (sin, cos) = ((i as f32 + 0.5) / RAYS as f32 * between * sine.signum()).sin_cos();
            [axes.x[0] * cos - axes.x[1] * sin, axes.x[0] * sin + axes.x[1] * cos]
        });
        let longest = directions.clone().map(room).fold(0.0, f32::max);
        let (mut radii_px, mut steps_px) = (Vec::new(), Vec::new());
        let mut radius = NEAR_PX;
        while radius <= longest {
            let step = (radius / DENSE_PX).clamp(1.0, STEP_MOST_PX);
            radii_px.push(radius);
            steps_px.push(step);
            radius += step;
        }
        let rays: Vec<Ray> =
            directions.map(|along| Ray { along, samples: radii_px.iter().take_while(|r| **r <= room(along)).count() }).collect();
        if rays.iter().any(|r| r.samples < 8) {
            return Err(fail("there is no room between the axes"));
        }
        let shape = (RAYS as i32, radii_px.len() as i32);
        let mut map_x = Mat::new_rows_cols_with_default(shape.0, shape.1, CV_32FC1, Scalar::all(-1.0))?;
        let mut map_y = map_x.try_clone()?;
        for (i, ray) in rays.iter().enumerate() {
            let row_x = map_x.at_row_mut::<f32>(i as i32)?;
            let row_y = map_y.at_row_mut::<f32>(i as i32)?;
            for r in 0..radii_px.len() {
                // Beyond the region the last sample is repeated and never looked at.
                let r_px = radii_px[r.min(ray.samples - 1)];
                row_x[r] = lip[0] + r_px * ray.along[0];
                row_y[r] = lip[1] + r_px * ray.along[1];
            }
        }
        let (mut map_a, mut map_b) = (Mat::default(), Mat::default());
        imgproc::convert_maps(&map_x, &map_y, &mut map_a, &mut map_b, CV_16SC2, true)?;

        let [h0, s0, v0, h1, s1, v1] = image.colour_hsv.map(f64::from);
        Ok(Self {
            method: image.method,
            area_min_px2: image.area_min_px2,
            size_px: [camera.width_px, camera.height_px],
            region,
            axes,
            rays,
            radii_px,
            steps_px,
            map_a,
            map_b,
            low: Scalar::new(h0, s0, v0, 0.0),
            high: Scalar::new(h1, s1, v1, 0.0),
            wraps: h0 > h1,
            converted: Mat::default(),
            polar: Mat::default(),
            smooth: Mat::default(),
            hsv: Mat::default(),
            mask: Mat::default(),
            mask_b: Mat::default(),
            water: ClearWater::new(&axes, [region.width, region.height], camera.width_px)?,
            edges: Vec::with_capacity(RAYS),
            edge_weights: Vec::with_capacity(RAYS),
            fine: Vec::with_capacity(PROFILES),
            fine_weights: Vec::with_capacity(PROFILES),
            trusts: Vec::with_capacity(PROFILES),
            widths: Vec::with_capacity(PROFILES),
            scratch: Vec::with_capacity(RAYS.max(PROFILES)),
            last_hash: None,
            level: 0.0,
            stages: Stages::default(),
        })
    }

    /// The axes in the image, px.
    pub fn axes(&self) -> Axes {
        Axes { lip_px: [self.axes.lip_px[0] + self.region.x as f32, self.axes.lip_px[1] + self.region.y as f32], ..self.axes }
    }

    /// The region in the image, px.
    pub fn region(&self) -> Rect {
        self.region
    }

    /// The coarse outer edge of the last measurement on each ray with liquid, in image coordinates, px: with the lip, the
    /// outline of the mask.
    pub fn outline_px(&self) -> impl Iterator<Item = [f32; 2]> + '_ {
        self.edges.iter().map(|p| [p[0] + self.region.x as f32, p[1] + self.region.y as f32])
    }

    /// Time spent in the stages of the last measurement.
    pub fn stages(&self) -> Stages {
        self.stages
    }

    /// The edge points of the last measurement in image coordinates, px: what the line was fitted to.
    pub fn edge_points_px(&self) -> impl Iterator<Item = [f32; 2]> + '_ {
        self.fine.iter().map(|p| [p[0] + self.region.x as f32, p[1] + self.region.y as f32])
    }

    /// Measures one image.
    pub fn measure(&mut self, image: Image) -> Result<Measurement, ExtractError> {
        let expected = image.width_px as usize * image.height_px as usize * image.format.bytes_per_pixel();
        if [image.width_px, image.height_px] != self.size_px || image.pixels.len() != expected {
            return Ok(Measurement::nothing(0.0, Doubt::WrongFormat));
        }
        if image.format == PixelFormat::Mono8 && self.method == LiquidMethod::Colour {
            return Err(ExtractError::NoColour);
        }
        self.fine.clear();
        let start = Instant::now();
        // Rays. The converted region lives in the extractor, a BGR frame is read where it is.
        let (rows, columns) = (image.height_px as i32, image.width_px as i32);
        let region = self.region;
        let bgr_start = region.y as usize * columns as usize * 3 + region.x as usize * 3;
        let converted = std::mem::take(&mut self.converted);
        let mut converted = converted;
        let colours = match image.format {
            PixelFormat::Bgr8 => {
                let frame = Mat::new_rows_cols_with_bytes::<core::Vec3b>(rows, columns, image.pixels)?;
                self.resample(&Mat::roi(&frame, region)?)?;
                Colours {
                    bytes: &image.pixels[bgr_start..],
                    stride: columns as usize * 3,
                    width: region.width as usize,
                    height: region.height as usize,
                }
            }
            PixelFormat::Yuyv => {
                // Pairs of pixels share their colour, so the crop starts at an even column and is then cut exactly.
                let frame = Mat::new_rows_cols_with_bytes::<core::Vec2b>(rows, columns, image.pixels)?;
                let even = Rect::new(region.x & !1, region.y, (region.width + (region.x & 1) + 1) & !1, region.height);
                let even = Rect { width: even.width.min(columns - even.x), ..even };
                imgproc::cvt_color_def(&Mat::roi(&frame, even)?, &mut converted, imgproc::COLOR_YUV2BGR_YUYV)?;
                let shift = region.x & 1;
                let inner = Rect::new(shift, 0, region.width, region.height);
                self.resample(&Mat::roi(&converted, inner)?)?;
                let bytes = &converted.data_bytes()?[shift as usize * 3..];
                Colours { bytes, stride: even.width as usize * 3, width: region.width as usize, height: region.height as usize }
            }
            PixelFormat::Mono8 => {
                let frame = Mat::new_rows_cols_with_bytes::<u8>(rows, columns, image.pixels)?;
                imgproc::cvt_color_def(&Mat::roi(&frame, region)?, &mut converted, imgproc::COLOR_GRAY2BGR)?;
                self.resample(&converted)?;
                let stride = region.width as usize * 3;
                Colours { bytes: converted.data_bytes()?, stride, width: region.width as usize, height: region.height as usize }
            }
        };
        let sampled = Instant::now();
        let unusable = self.check_light()?;
        let checked = Instant::now();
        let (result, segmented) = match unusable {
            Some(doubt) => (Measurement::nothing(0.0, doubt), checked),
            None => match self.method {
                LiquidMethod::Colour => {
                    self.segment_colour()?;
                    let segmented = Instant::now();
                    (self.find_triangle(colours)?, segmented)
                }
                LiquidMethod::Clear => {
                    let seen = self.water.look()?;
                    let segmented = Instant::now();
                    (self.follow_water(seen, colours)?, segmented)
                }
            },
        };
        // Clear water's own edge tells nothing of focus.
        let untold = (result.area_px2 == 0.0 || self.method == LiquidMethod::Clear) && result.doubt == Doubt::None;
        let result = if untold && self.rim_is_blurred(colours) { Measurement::nothing(0.0, Doubt::Blurred) } else { result };
        let done = Instant::now();
        self.converted = converted;
        let ns = |from: Instant, to: Instant| to.duration_since(from).as_nanos() as u64;
        self.stages = Stages {
            rays_ns: ns(start, sampled),
            checks_ns: ns(sampled, checked),
            segment_ns: ns(checked, segmented),
            line_ns: ns(segmented, done),
        };
        Ok(result)
    }

    fn resample(&mut self, region: &impl core::ToInputArray) -> Result<(), ExtractError> {
        if self.method == LiquidMethod::Clear {
            return Ok(self.water.take(region)?);
        }
        let (nearest, border) = (imgproc::INTER_NEAREST, core::BORDER_REPLICATE);
        imgproc::remap(region, &mut self.polar, &self.map_a, &self.map_b, nearest, border, Scalar::default())?;
        Ok(())
    }

    /// Too dark, blown out or the same picture as before. One pass over the rays (every fourth pixel for light), because
    /// three OpenCV reductions over the same bytes took longer than this.
    fn check_light(&mut self) -> Result<Option<Doubt>, ExtractError> {
        let picture = if self.method == LiquidMethod::Clear { self.water.small() } else { &self.polar };
        let bytes = picture.data_bytes()?;
        let mut hash = 0xcbf2_9ce4_8422_2325u64;
        for chunk in bytes.chunks_exact(8) {
            let word = u64::from_le_bytes([chunk[0], chunk[1], chunk[2], chunk[3], chunk[4], chunk[5], chunk[6], chunk[7]]);
            hash = (hash ^ word).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29);
        }
        let repeated = self.last_hash.replace(hash) == Some(hash);
        let (mut sum, mut saturated, mut count) = (0u64, 0u32, 0u32);
        for pixel in bytes.chunks_exact(3).step_by(4) {
            sum += u64::from(pixel[0]) + u64::from(pixel[1]) + u64::from(pixel[2]);
            saturated += u32::from(pixel.iter().all(|v| *v >= 250));
            count += 1;
        }
        let level = sum as f32 / (3.0 * count.max(1) as f32);
        self.level = level;
        Ok(if level < DARK_LEVEL {
            Some(Doubt::TooDark)
        } else if saturated as f32 > BLOWN_SHARE * count as f32 {
            Some(Doubt::BlownOut)
        } else if repeated {
            Some(Doubt::Frozen)
        } else {
            None
        })
    }

    /// Whether the glass's top edge and left side, which are always in the same place, have lost their sharp edges. False when
    /// they are not seen well enough to tell: glass that is as bright as what is behind, or axes that lie beside them.
    fn rim_is_blurred(&mut self, colours: Colours) -> bool {
        self.widths.clear();
        let axes = self.axes;
        for (along, across) in [(axes.x, axes.y), ([-axes.y[0], -axes.y[1]], axes.x)] {
            // Square to the axis, so that an oblique container does not look soft.
            let skew = across[0] * along[0] + across[1] * along[1];
            let across = [across[0] - skew * along[0], across[1] - skew * along[1]];
            let length = across[0].hypot(across[1]);
            for bundle in 0..RIM_BUNDLES {
                let mut profile = [0.0f32; 2 * RIM_REACH + 1];
                let inside = profile.iter_mut().enumerate().all(|(j, level)| {
                    let d = (j as f32 - RIM_REACH as f32) / length;
                    (0..RIM_LINES).all(|line| {
                        let s = RIM_BUNDLE_PX * (1 + bundle) as f32 + RIM_LINE_PX * line as f32;
                        let [x, y] = axes.at(s, along);
                        let colour = colours.at(x + d * across[0], y + d * across[1]);
                        *level += colour.map_or(0.0, |c| c.iter().sum::<f32>()) / (3 * RIM_LINES) as f32;
                        colour.is_some()
                    })
                });
                // The steepest step, and the whole change close around it: a soft edge of the background beside the rim does not count.
                let steepness = |i: usize| (profile[i + 3] - profile[i]).abs() / 3.0;
                let at = (RIM_AROUND..2 * RIM_REACH - 2 - RIM_AROUND)
                    .max_by(|i, j| steepness(*i).total_cmp(&steepness(*j)))
                    .unwrap_or(RIM_REACH);
                let around = &profile[at - RIM_AROUND..at + 4 + RIM_AROUND];
                let (low, high) = around.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
                if inside && high - low >= RIM_CONTRAST {
                    self.widths.push((high - low) / steepness(at));
                }
            }
        }
        // What stands behind is out of focus too, so the sharper bundles decide.
        let sharper = self.widths.len() / 4;
        self.widths.len() >= RIM_SEEN && *self.widths.select_nth_unstable_by(sharper, f32::total_cmp).1 > RIM_BLURRED_PX
    }

    /// Liquid by its colour range, into `self.mask`.
    fn segment_colour(&mut self) -> Result<(), ExtractError> {
        // Neighbouring samples together: a fifth of the noise, for a tenth of what smoothing the region would cost. A dark liquid in dim
        // light is only noise and a little colour.
        let size = core::Size::new(5, 5);
        imgproc::blur(&self.polar, &mut self.smooth, size, core::Point::new(-1, -1), core::BORDER_REPLICATE)?;
        imgproc::cvt_color_def(&self.smooth, &mut self.hsv, imgproc::COLOR_BGR2HSV)?;
        if self.wraps {
            // Red lies on both sides of hue 0.
            let (mut low, mut high) = (self.low, self.high);
            high[0] = 179.0;
            core::in_range(&self.hsv, &low, &high, &mut self.mask_b)?;
            (low[0], high[0]) = (0.0, self.high[0]);
            core::in_range(&self.hsv, &low, &high, &mut self.mask)?;
            let one = std::mem::take(&mut self.mask);
            core::bitwise_or(&one, &self.mask_b, &mut self.mask, &core::no_array())?;
        } else {
            core::in_range(&self.hsv, &self.low, &self.high, &mut self.mask)?;
        }
        Ok(())
    }

    /// The triangle of what [`ClearWater`] saw.
    fn follow_water(&mut self, seen: Seen, colours: Colours) -> Result<Measurement, ExtractError> {
        self.edges.clear();
        match seen {
            Seen::Dry => Ok(Measurement::nothing(1.0, Doubt::None)),
            Seen::Unsure => Ok(Measurement::nothing(0.0, Doubt::EdgeNotFound)),
            Seen::Stream(share) => {
                self.edges.extend_from_slice(self.water.edges_px());
                self.line_through_edges(share, 0, colours)
            }
        }
    }

    fn find_triangle(&mut self, colours: Colours) -> Result<Measurement, ExtractError> {
        // 1. The edge on each ray: the best split into liquid before and background after it.
        self.edges.clear();
        let (mut filled, mut cut_off, mut liquid_px) = (0usize, 0usize, 0.0f32);
        for (i, ray) in self.rays.iter().enumerate() {
            let row = self.mask.at_row::<u8>(i as i32)?;
            // The score counts px of liquid less px of background; its largest value is at the edge.
            let (mut score, mut best, mut edge) = (0.0f32, 0.0f32, None);
            for (r, (value, step)) in row[..ray.samples].iter().zip(&self.steps_px).enumerate() {
                score += if *value != 0 { *step } else { -step };
                if score > best {
                    (best, edge) = (score, Some(r));
                } else if score < -GAP_MOST_PX {
                    break;
                }
            }
            let Some(r) = edge else { continue };
            // Between the last sample of liquid and the first of background.
            let r_px = self.radii_px[r] + 0.5 * self.steps_px[r];
            if r_px >= NEAR_PX + 1.0 && best >= (2.0 * FILLED - 1.0) * (r_px - NEAR_PX) {
                filled += 1;
                liquid_px += r_px;
                cut_off += usize::from(r + 1 >= ray.samples);
                self.edges.push(self.axes.at(r_px, ray.along));
            }
        }
        let share = filled as f32 / RAYS as f32;
        if cut_off as f32 > 0.9 * RAYS as f32 {
            // Everything looks like liquid: the colour does not tell them apart in this light.
            return Ok(Measurement::nothing(0.0, Doubt::EdgeNotFound));
        }
        if share < STREAM_RAYS {
            // A good half of the wedge full of liquid is no drop: something hides the stream.
            let mean_px = liquid_px / filled.max(1) as f32;
            if share > 0.5 && mean_px > 14.0 {
                return Ok(Measurement::nothing(0.0, Doubt::EdgeNotFound));
            }
            return Ok(Measurement::nothing((1.0 - share).clamp(0.0, 1.0), Doubt::None));
        }

        self.line_through_edges(share, cut_off, colours)
    }

    /// Steps 2 to 4 of the module's text, from `self.edges`. `share`: of rays with an edge; `cut_off`: rays whose liquid
    /// reaches the region's border.
    fn line_through_edges(&mut self, share: f32, cut_off: usize, colours: Colours) -> Result<Measurement, ExtractError> {
        // 2. A first line: the pair of edges with most others near its line, then least squares over those. Weights are
        // distances between neighbours, so that every part of the edge counts by its length; one that is far from both
        // neighbours is alone.
        let count = self.edges.len();
        let apart = |a: [f32; 2], b: [f32; 2]| (a[0] - b[0]).hypot(a[1] - b[1]);
        self.edge_weights.clear();
        self.scratch.clear();
        for i in 0..count {
            let here = self.edges[i];
            let before = if i > 0 { apart(here, self.edges[i - 1]) } else { f32::MAX };
            let after = if i + 1 < count { apart(here, self.edges[i + 1]) } else { f32::MAX };
            self.edge_weights.push(before.min(after).min(20.0) + 0.05);
            self.scratch.push(apart(here, self.axes.lip_px));
        }
        let near = (0.12 * median(&mut self.scratch)).max(1.5);
        let mut best: Option<(f32, Line)> = None;
        for i in 0..PICKS {
            for j in i + PICKS / 4..PICKS {
                let (a, b) = (self.edges[i * (count - 1) / (PICKS - 1)], self.edges[j * (count - 1) / (PICKS - 1)]);
                let length = apart(a, b);
                if length < 1.0 {
                    continue;
                }
                let normal = [-(b[1] - a[1]) / length, (b[0] - a[0]) / length];
                let line = Line { normal, distance: normal[0] * a[0] + normal[1] * a[1] };
                let support: f32 =
                    self.edges.iter().zip(&self.edge_weights).filter(|(p, _)| line.offset(**p).abs() < near).map(|(_, w)| w).sum();
                if best.is_none_or(|(s, ..)| support > s) {
                    best = Some((support, line));
                }
            }
        }
        let Some((support, line)) = best else { return Ok(Measurement::nothing(0.0, Doubt::EdgeNotFound)) };
        let inliers = support / self.edge_weights.iter().sum::<f32>();
        let points = self.edges.iter().copied().zip(self.edge_weights.iter().copied());
        let Some(line) = Line::fit(points.filter(|(p, _)| line.offset(*p).abs() < near)) else {
            return Ok(Measurement::nothing(0.0, Doubt::EdgeNotFound));
        };
        let (a, b) = (line.cut(self.axes.lip_px, self.axes.x), line.cut(self.axes.lip_px, self.axes.y));
        let longest = 2.0 * (self.region.width + self.region.height) as f32;
        if !(a > 1.0 && b > 1.0 && a < longest && b < longest) || inliers < 0.6 {
            return Ok(Measurement::nothing(0.0, Doubt::EdgeNotFound));
        }

        if self.method == LiquidMethod::Colour && 0.5 * a * b * self.axes.sine().abs() < self.area_min_px2 {
            return Ok(Measurement::nothing(share, Doubt::None));
        }

        // 3. Profiles across it.
        let found = self.refine(line, a, b, colours).and_then(|(line, contrast, width, used)| {
            let (a, b) = (line.cut(self.axes.lip_px, self.axes.x), line.cut(self.axes.lip_px, self.axes.y));
            let sharp = (BLURRED_PX / width.max(0.5)).min(1.0);
            let confidence = inliers.min(1.0) * share.min(1.0) * used * (contrast / 40.0).min(1.0) * sharp;
            (a > 0.0 && b > 0.0 && a < longest && b < longest).then_some(([a, b], contrast, width, confidence))
        });
        let mut doubt = Doubt::EdgeNotFound;
        let confirmed = self.method == LiquidMethod::Colour || {
            // What the memory of the background took for water must have its edge in the picture itself.
            let begins = self.water.begins();
            let lit = (self.level / LIT_LEVEL).clamp(LIT_LEAST, 1.0);
            let least = lit * if begins { BEGIN_CONFIDENCE } else { GO_ON_CONFIDENCE };
            doubt = if begins { Doubt::None } else { doubt };
            self.water.confirm(found.filter(|(.., confidence)| *confidence >= least).map(|(legs, contrast, ..)| (legs, contrast)))
        };
        let Some(([a, b], _, width, confidence)) = found.filter(|_| confirmed) else {
            return Ok(Measurement::nothing(0.0, doubt));
        };
        let area_px2 = 0.5 * a * b * self.axes.sine().abs();
        if area_px2 < self.area_min_px2 {
            return Ok(Measurement::nothing(share, Doubt::None));
        }
        let corner = |r: f32, axis: [f32; 2]| {
            let p = self.axes.at(r, axis);
            [p[0] + self.region.x as f32, p[1] + self.region.y as f32]
        };
        let ([x0, y0], [x1, y1], [x2, y2]) = (corner(0.0, self.axes.x), corner(a, self.axes.x), corner(b, self.axes.y));
        let doubt = if cut_off as f32 > 0.06 * RAYS as f32 {
            Doubt::LeavesRegion
        } else if width > BLURRED_PX {
            Doubt::Blurred
        } else {
            Doubt::None
        };
        Ok(Measurement { area_px2, confidence, doubt, triangle_px: [x0, y0, x1, y1, x2, y2] })
    }

    /// Sub-pixel edge points on normals of `line` between the axes, and a Huber line through them. Returns the line, the
    /// median contrast in grey levels, the median edge width in px and the share of profiles that showed an edge; none if too few did.
    fn refine(&mut self, line: Line, a: f32, b: f32, colours: Colours) -> Option<(Line, f32, f32, f32)> {
        let (from, to) = (self.axes.at(a, self.axes.x), self.axes.at(b, self.axes.y));
        let length = (to[0] - from[0]).hypot(to[1] - from[1]);
        let along = [(to[0] - from[0]) / length, (to[1] - from[1]) / length];
        // Outwards: away from the lip.
        let outwards = if line.offset(self.axes.lip_px) < 0.0 { 1.0 } else { -1.0 };
        let normal = [line.normal[0] * outwards, line.normal[1] * outwards];
        // A small triangle has short profiles, so that their inner ends stay in the liquid.
        let spacing = (line.offset(self.axes.lip_px).abs() / 18.0).clamp(0.4, 1.0);
        let margin = (0.04 * line.offset(self.axes.lip_px).abs()).clamp(1.0, 1.5);
        self.fine.clear();
        self.fine_weights.clear();
        self.trusts.clear();
        self.widths.clear();
        self.scratch.clear();
        let mut next = 0;
        for k in 0..PROFILES {
            let s = length * (k as f32 + 0.5) / PROFILES as f32;
            // The coarse edge's distance from the line here, from the two rays around it.
            let place = |p: [f32; 2]| (p[0] - from[0]) * along[0] + (p[1] - from[1]) * along[1];
            while next < self.edges.len() && place(self.edges[next]) < s {
                next += 1;
            }
            let offset = |i: usize| line.offset(self.edges[i]) * outwards;
            let coarse = match (next.checked_sub(1), self.edges.get(next)) {
                (Some(i), Some(_)) => {
                    let (s0, s1) = (place(self.edges[i]), place(self.edges[next]));
                    let t = if s1 > s0 { ((s - s0) / (s1 - s0)).clamp(0.0, 1.0) } else { 0.5 };
                    offset(i) * (1.0 - t) + offset(next) * t
                }
                (None, Some(_)) => offset(next),
                (Some(i), None) => offset(i),
                (None, None) => continue,
            };
            let centre = [from[0] + s * along[0] + coarse * normal[0], from[1] + s * along[1] + coarse * normal[1]];
            let mut profile = [[0.0f32; 3]; 2 * REACH + 1];
            let complete = profile.iter_mut().enumerate().all(|(j, value)| {
                let d = (j as f32 - REACH as f32) * spacing;
                match colours.at(centre[0] + d * normal[0], centre[1] + d * normal[1]) {
                    Some(colour) => {
                        *value = colour;
                        true
                    }
                    None => false,
                }
            });
            if !complete {
                continue;
            }
            if self.method == LiquidMethod::Clear {
                let found = self.water.begins_at(&profile, |j| {
                    let d = (j as f32 - REACH as f32) * spacing;
                    [centre[0] + d * normal[0], centre[1] + d * normal[1]]
                });
                let Some((j, height, trust)) = found else { continue };
                let d = (j - REACH as f32) * spacing;
                let point = [centre[0] + d * normal[0], centre[1] + d * normal[1]];
                if self.axes.between(point) >= margin {
                    self.fine.push(point);
                    self.scratch.push(height);
                    self.trusts.push(trust);
                }
                continue;
            }
            let mean =
                |range: &[[f32; 3]]| -> [f32; 3] { std::array::from_fn(|c| range.iter().map(|v| v[c]).sum::<f32>() / range.len() as f32) };
            let inside = mean(&profile[..FLANK]);
            let outside = mean(&profile[2 * REACH + 1 - FLANK..]);
            let difference: [f32; 3] = std::array::from_fn(|c| inside[c] - outside[c]);
            let square: f32 = difference.iter().map(|v| v * v).sum();
            if square < 12.0 * 12.0 {
                continue;
            }
            // 1 in the liquid, 0 in the background.
            let scale: [f32; 3] = difference.map(|v| v / square);
            let levels = profile.map(|p| (0..3).map(|c| (p[c] - outside[c]) * scale[c]).sum::<f32>());
            // The falling crossing nearest to the coarse edge.
            let crossing = |height: f32| {
                levels
                    .windows(2)
                    .enumerate()
                    .filter(|(_, w)| w[0] >= height && w[1] < height)
                    .map(|(j, w)| j as f32 + (w[0] - height) / (w[0] - w[1]))
                    .min_by(|p, q| (p - REACH as f32).abs().total_cmp(&(q - REACH as f32).abs()))
            };
            let Some(half) = crossing(0.5) else { continue };
            if let (Some(high), Some(low)) = (crossing(0.8), crossing(0.2)) {
                self.widths.push((low - high).abs() * spacing);
            }
            let d = (half - REACH as f32) * spacing;
            let point = [centre[0] + d * normal[0], centre[1] + d * normal[1]];
            // The outline bends inwards beyond the axes, so only what lies between them counts; the rim's light spreads a little.
            if self.axes.between(point) < margin {
                continue;
            }
            self.fine.push(point);
            self.trusts.push(1.0);
            self.scratch.push(square.sqrt());
        }
        let used = self.fine.len() as f32 / PROFILES as f32;
        let least = if self.method == LiquidMethod::Clear { PROFILES_FEW } else { PROFILES_LEAST };
        if used < least {
            return None;
        }
        let contrast = median(&mut self.scratch);
        let width = if self.widths.is_empty() { 1.0 } else { median(&mut self.widths) };
        self.fine_weights.extend_from_slice(&self.trusts);
        let mut fitted = line;
        for _ in 0..4 {
            let Some(next) = Line::fit(self.fine.iter().copied().zip(self.fine_weights.iter().copied())) else { break };
            fitted = next;
            self.scratch.clear();
            self.scratch.extend(self.fine.iter().map(|p| fitted.offset(*p).abs()));
            // The outline is a little curved: residuals up to a few per cent of its length are no outliers.
            let limit = (3.0 * median(&mut self.scratch)).max(1.0);
            for ((weight, p), trust) in self.fine_weights.iter_mut().zip(&self.fine).zip(&self.trusts) {
                *weight = trust * (limit / fitted.offset(*p).abs().max(1e-6)).min(1.0);
            }
        }
        Some((fitted, contrast, width, used))
    }
}
