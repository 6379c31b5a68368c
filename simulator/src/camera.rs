//! The rendered camera: what an in-hand camera beside the container's lip would see.
//!
//! The picture is drawn from the physics of the outflow, never from the triangle that the feature worker looks for, and it
//! shares no code and no constant with the feature worker. The camera looks along the tilt axis and is fixed to the
//! container, so glass and lip stay where they are while background and gravity turn in the image.
//!
//! The stream's side view follows from the flow in three steps:
//! 1. The lip is a V-notch weir in the rim's plane, `Q = 8/15 Cd(alpha) sqrt(2 g) tan(theta/2) H^2.5 / sin(alpha)`, solved
//!    for the head `H` over the lip. `Cd` falls as the wall turns from a sharp crest into a long flat one.
//! 2. Inside the glass the free surface falls from `H` to the critical depth `0.8 H` near the lip.
//! 3. From there it flies: a parabola with the speed that Bernoulli gives at that depth.
//!
//! Called from the cell's camera thread and from `evaluate-camera`; memory is allocated in [`Renderer::new`] and when the
//! stream first grows. Same view, seed and scenes give the same bytes. Failures are OpenCV's and come back as errors.

use opencv::core::{self, BORDER_REFLECT_101, CV_8UC1, CV_8UC3, Mat, Point, Point2f, Rect, Scalar, Size, Vector};
use opencv::imgproc;
use opencv::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};

use crate::physics::container::Container;

/// Gravity, mm/s^2.
const G_MM_S2: f64 = 9810.0;
/// Discharge coefficient of a sharp-crested V notch.
const CD_SHARP: f64 = 0.6;
/// Critical depth of a triangular channel in heads.
const CRITICAL_DEPTH: f64 = 0.8;
/// Where the flow becomes critical, heads upstream of the lip.
const CRITICAL_BEFORE_LIP: f64 = 0.15;
/// Below this flow a stream breaks up into drops, ml/s.
const DRIP_FLOW_ML_S: f64 = 0.15;
/// Volume of one drop, ml.
const DROP_ML: f64 = 0.05;
/// Refractive index of water.
const WATER_INDEX: f32 = 1.333;
/// From the stream to what stands behind it, mm.
const BEHIND_MM: f32 = 200.0;
/// What stands behind ends at this angle from straight ahead, degrees; beyond it is the room, lit to a grey level in this range, with
/// more light from above than from below by this share.
const BOARD_ENDS_DEG: f32 = 35.0;
const ROOM_LEVELS: std::ops::Range<f32> = 25.0..130.0;
const ROOM_SLOPE: f32 = 0.4;
/// Light is bent by at most this, rad.
const MOST_BENT: f32 = 1.4;
/// Places from the axis of a body of water to its outline at which its optics are tabulated.
const OFF_AXIS: usize = 1024;
/// Water bodies bulge as cylinders of their own thickness up to this radius, mm.
const BULGE_MM: f64 = 12.0;

/// OpenCV could not draw.
#[derive(Debug, thiserror::Error)]
#[error("rendering the camera's picture: {0}")]
pub struct RenderError(#[from] opencv::Error);

/// What stands behind the container.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Background {
    /// The chess board of Fig. 4.
    Chess,
    /// A workbench of wooden boards.
    Wood,
    /// An untidy laboratory: boxes and cables.
    Clutter,
    /// A plain wall.
    Plain,
}

impl Background {
    /// All backgrounds.
    pub const ALL: [Self; 4] = [Self::Chess, Self::Wood, Self::Clutter, Self::Plain];
}

/// One camera on one container with one liquid.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct View {
    /// Width in px.
    pub width_px: u32,
    /// Height in px.
    pub height_px: u32,
    /// Scale at the lip, px per mm.
    pub px_per_mm: f64,
    /// The lip (where the glass's top edge meets its left side) in the image, px.
    pub lip_px: [f64; 2],
    /// How far the camera is turned about its own axis, degrees clockwise in the image.
    pub roll_deg: f64,
    /// Opening angle theta of the spout, degrees.
    pub spout_deg: f64,
    /// Share of the discharge coefficient that is lost when the wall lies flat (alpha = 90 degrees).
    pub flat_wall_loss: f64,
    /// Colour of the liquid, blue green red; none (in a file, `[]`): clear water.
    #[serde(deserialize_with = "colour_or_clear")]
    pub liquid_bgr: Option<[u8; 3]>,
    /// How much of the background a thick layer of coloured liquid hides, 0 to 1.
    pub opacity: f64,
    /// What stands behind.
    pub background: Background,
    /// Light: 1 is well exposed.
    pub light: f64,
    /// Standard deviation of the exposure's slow drift, share of the light.
    pub exposure_drift: f64,
    /// Standard deviation of the pixel noise, grey levels.
    pub noise: f64,
    /// Standard deviation of the lens's and the vibration's blur at the lip, px.
    pub blur_px: f64,
    /// Exposure time, s.
    pub shutter_s: f64,
}

impl View {
    /// A camera as people mount it, before a lip as they differ: scale, place, roll and the lip's shape drawn by `random`.
    pub fn placed(random: &mut Pcg64Mcg) -> Self {
        Self {
            px_per_mm: random.random_range(5.5..8.5),
            lip_px: [random.random_range(150.0..240.0), random.random_range(236.0..290.0)],
            roll_deg: random.random_range(-8.0..8.0),
            spout_deg: random.random_range(45.0..90.0),
            flat_wall_loss: random.random_range(0.3..0.6),
            ..Self::default()
        }
    }
}

impl Default for View {
    fn default() -> Self {
        Self {
            width_px: 640,
            height_px: 480,
            px_per_mm: 7.0,
            lip_px: [215.0, 250.0],
            roll_deg: 0.0,
            spout_deg: 60.0,
            flat_wall_loss: 0.5,
            liquid_bgr: Some([150, 62, 20]),
            opacity: 0.93,
            background: Background::Chess,
            light: 1.0,
            exposure_drift: 0.05,
            noise: 3.0,
            blur_px: 0.0,
            shutter_s: 0.008,
        }
    }
}

/// TOML has no word for nothing.
fn colour_or_clear<'de, D: serde::Deserializer<'de>>(deserializer: D) -> Result<Option<[u8; 3]>, D::Error> {
    let levels = Vec::<u8>::deserialize(deserializer)?;
    match levels.len() {
        0 => Ok(None),
        _ => levels.try_into().map(Some).map_err(|_| serde::de::Error::custom("blue, green, red, or [] for clear water")),
    }
}

/// The physical state at the middle of an exposure.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Scene {
    /// Time, s; grows from frame to frame.
    pub at_s: f64,
    /// Tilt alpha, degrees from upright.
    pub alpha_deg: f64,
    /// Its speed, degrees/s.
    pub rate_deg_s: f64,
    /// Outflow over the lip, ml/s.
    pub flow_ml_s: f64,
    /// Height of the liquid's surface over the lip when nothing flows, mm; negative: below the lip.
    pub level_mm: f64,
}

impl Scene {
    /// `container` at this tilt.
    pub fn of(container: &Container, at_s: f64, alpha_deg: f64, rate_deg_s: f64) -> Self {
        let shape = container.shape();
        let excess_ml = container.volume_ml() - shape.retained_ml(alpha_deg);
        let level_mm = 1000.0 * excess_ml / shape.surface_mm2(alpha_deg);
        Self { at_s, alpha_deg, rate_deg_s, flow_ml_s: container.lip().flow_ml_s, level_mm }
    }
}

/// What was really drawn.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Truth {
    /// Area of the triangle between the container's axes and the least-squares line along the stream's outer outline,
    /// px^2; 0 without a stream.
    pub area_px2: f64,
    /// Its corners: lip, on the x-axis, on the y-axis; px.
    pub triangle_px: [[f64; 2]; 3],
}

/// A drop in flight; position and velocity in the container's frame.
#[derive(Debug, Clone, Copy)]
struct Drop {
    at_mm: [f64; 2],
    velocity_mm_s: [f64; 2],
    radius_mm: f64,
}

/// Draws frames of one [`View`].
pub struct Renderer {
    view: View,
    random: Pcg64Mcg,
    /// Background at half resolution, square, larger than the image's diagonal.
    board: Mat,
    turned: Mat,
    frame: Mat,
    /// A copy of the frame behind the liquid, for refraction.
    behind: Mat,
    blurred: Mat,
    /// Glass, drawn over everything inside: factor (128 = 1) and summand.
    glass_factor: Mat,
    glass_light: Mat,
    /// Share of each pixel that is covered by liquid, 0 to 255, and the same softened (a stand-in for thickness).
    cover: Mat,
    thickness: Mat,
    /// Clear water: the picture behind as a pixel of the water gathers it, each pixel's depth below the outline, and the radius of
    /// the body that it belongs to, px.
    gathered: Mat,
    depth: Mat,
    radius: Mat,
    room_level: f32,
    /// What [`through_cylinder`] says at [`OFF_AXIS`] + 1 places from the axis to the outline.
    lens: Vec<Lens>,
    /// Where a place left of, right of, above or below the picture is found in it: columns and rows.
    mirrored: [Mirror; 2],
    /// Waves along the picture's columns: of the water's surface, and the two whose product is its shimmer.
    waves: [Wave; 3],
    crossings: Vec<f64>,
    sides: Vec<([f64; 2], [f64; 2])>,
    polygon: Vec<[f64; 2]>,
    noise: Vec<i8>,
    vignette: Vec<u16>,
    drops: Vec<Drop>,
    wet: f64,
    exposure: f64,
    drip_ml: f64,
    last_s: Option<f64>,
    ripple: [f64; 4],
}

/// A rotation of the container by alpha: from the world (x towards the pour, z up, lip at the origin) to the container's
/// frame (u along the top edge into the mouth, w along the left side out of the mouth), all in mm.
fn to_container([x, z]: [f64; 2], angle_rad: f64) -> [f64; 2] {
    let (sin, cos) = angle_rad.sin_cos();
    [-x * cos + z * sin, x * sin + z * cos]
}

fn bgr(level: f64, tint: [f64; 3]) -> Scalar {
    Scalar::new(level * tint[0], level * tint[1], level * tint[2], 0.0)
}

/// Paints the background at half resolution.
fn paint_board(kind: Background, side: i32, random: &mut Pcg64Mcg) -> Result<Mat, RenderError> {
    let mut board = Mat::new_rows_cols_with_default(side, side, CV_8UC3, bgr(168.0, [0.93, 0.99, 1.0]))?;
    let fill = |board: &mut Mat, rect: Rect, colour: Scalar| imgproc::rectangle(board, rect, colour, imgproc::FILLED, imgproc::LINE_8, 0);
    match kind {
        Background::Chess => {
            let square = 34;
            for row in 0..side / square + 1 {
                for column in 0..side / square + 1 {
                    let level = if (row + column) % 2 == 0 { 205.0 } else { 48.0 } + random.random_range(-5.0..5.0);
                    fill(&mut board, Rect::new(column * square, row * square, square, square), bgr(level, [0.95, 0.98, 1.0]))?;
                }
            }
        }
        Background::Wood => {
            let mut y = 0;
            while y < side {
                let height = random.random_range(36..70);
                let level = random.random_range(120.0..170.0);
                fill(&mut board, Rect::new(0, y, side, height), bgr(level, [0.55, 0.78, 1.0]))?;
                for _ in 0..14 {
                    let at = y + random.random_range(0..height);
                    let shade = bgr(level * random.random_range(0.75..1.1), [0.53, 0.77, 1.0]);
                    let slope = random.random_range(-3..4);
                    imgproc::line(&mut board, Point::new(0, at), Point::new(side, at + slope), shade, 1, imgproc::LINE_AA, 0)?;
                }
                imgproc::line(&mut board, Point::new(0, y), Point::new(side, y), bgr(60.0, [0.5, 0.8, 1.0]), 2, imgproc::LINE_AA, 0)?;
                y += height;
            }
        }
        Background::Clutter => {
            for _ in 0..90 {
                let size = Size::new(random.random_range(20..150), random.random_range(20..110));
                let corner = Point::new(random.random_range(-40..side), random.random_range(-40..side));
                let tint = [random.random_range(0.6..1.0), random.random_range(0.6..1.0), random.random_range(0.6..1.0)];
                fill(&mut board, Rect::from_point_size(corner, size), bgr(random.random_range(30.0..225.0), tint))?;
            }
            for _ in 0..25 {
                let mut end = || Point::new(random.random_range(0..side), random.random_range(0..side));
                let (from, to) = (end(), end());
                let colour = bgr(random.random_range(10.0..230.0), [1.0, 1.0, 1.0]);
                imgproc::line(&mut board, from, to, colour, random.random_range(1..4), imgproc::LINE_AA, 0)?;
            }
        }
        Background::Plain => {}
    }
    // The board is behind the plane of focus, and paper and wood are never evenly lit.
    let mut soft = Mat::default();
    let sigma = 1.0;
    imgproc::gaussian_blur(&board, &mut soft, Size::new(0, 0), sigma, sigma, BORDER_REFLECT_101)?;
    Ok(soft)
}

impl Renderer {
    /// A renderer of `view`; `seed` decides background, noise, drops and drift.
    pub fn new(view: &View, seed: u64) -> Result<Self, RenderError> {
        // One thread: what is drawn does not depend on the machine, and the other core is left to the controller.
        core::set_num_threads(1)?;
        let mut random = Pcg64Mcg::seed_from_u64(seed);
        let (width, height) = (view.width_px as i32, view.height_px as i32);
        let side = f64::from(width).hypot(f64::from(height)) as i32 + 2;
        let board = paint_board(view.background, side, &mut random)?;
        let new = |kind, value: f64| Mat::new_rows_cols_with_default(height, width, kind, Scalar::all(value));
        let (glass_factor, glass_light) = (new(CV_8UC3, 128.0)?, new(CV_8UC3, 0.0)?);
        let pixels = (width * height) as usize;
        // A sum of four bytes is near enough to a normal distribution (and has no outliers beyond 3.5 sigma).
        let noise = (0..pixels * 3 + 65_536)
            .map(|_| {
                let sum: f64 = random.random::<[u8; 4]>().into_iter().map(|b| f64::from(b) - 127.5).sum();
                (sum / 147.8 * view.noise).round().clamp(-127.0, 127.0) as i8
            })
            .collect();
        let vignette = (0..pixels)
            .map(|i| {
                let (x, y) = ((i % width as usize) as f64 / f64::from(width) - 0.5, (i / width as usize) as f64 / f64::from(height) - 0.5);
                (256.0 * (1.0 - 0.45 * (x * x + y * y))) as u16
            })
            .flat_map(|v| [v; 3])
            .collect();
        let mut renderer = Self {
            view: view.clone(),
            random,
            board,
            turned: Mat::default(),
            frame: new(CV_8UC3, 0.0)?,
            behind: Mat::default(),
            blurred: Mat::default(),
            glass_factor,
            glass_light,
            cover: new(CV_8UC1, 0.0)?,
            thickness: new(CV_8UC1, 0.0)?,
            gathered: Mat::default(),
            depth: Mat::default(),
            radius: Mat::default(),
            // Its own dice: coloured liquid does not need them.
            room_level: Pcg64Mcg::seed_from_u64(!seed).random_range(ROOM_LEVELS),
            lens: (0..=OFF_AXIS).map(|i| through_cylinder(i as f32 / OFF_AXIS as f32)).collect(),
            mirrored: [width, height].map(|size| Mirror::new(size, BEHIND_MM * view.px_per_mm as f32 * MOST_BENT.tan())),
            waves: [0.11, 0.13, 0.06].map(|per_px| Wave::new(per_px, width)),
            crossings: Vec::with_capacity(16),
            sides: Vec::with_capacity(64),
            polygon: Vec::with_capacity(512),
            noise,
            vignette,
            drops: Vec::with_capacity(64),
            wet: 0.0,
            exposure: 0.0,
            drip_ml: 0.0,
            last_s: None,
            ripple: [0.0; 4],
        };
        renderer.paint_glass()?;
        Ok(renderer)
    }

    /// The view that is drawn.
    pub fn view(&self) -> &View {
        &self.view
    }

    /// From the container's frame (mm) to the image (px).
    fn to_image(&self, [u, w]: [f64; 2]) -> [f64; 2] {
        let (sin, cos) = self.view.roll_deg.to_radians().sin_cos();
        let s = self.view.px_per_mm;
        [self.view.lip_px[0] + s * (u * cos + w * sin), self.view.lip_px[1] + s * (u * sin - w * cos)]
    }

    fn image_point(&self, at_mm: [f64; 2]) -> Point {
        let [x, y] = self.to_image(at_mm);
        Point::new((x * 16.0) as i32, (y * 16.0) as i32)
    }

    /// The container never moves in the image, so its glass is painted once.
    fn paint_glass(&mut self) -> Result<(), RenderError> {
        let (wall, far) = (1.6, 140.0);
        let shape =
            |r: &Self, corners: &[[f64; 2]]| -> Vector<Point> { corners.iter().map(|c| r.image_point(*c)).collect::<Vec<_>>().into() };
        let body = shape(self, &[[0.0, 0.0], [far, 0.0], [far, -far], [0.0, -far]]);
        let side = shape(self, &[[0.0, 0.0], [wall, 0.0], [wall, -far], [0.0, -far]]);
        let rim = shape(self, &[[0.0, 0.0], [far, 0.0], [far, -1.0], [0.0, -1.0]]);
        let streak = shape(self, &[[9.0, -6.0], [10.5, -6.0], [10.5, -far], [9.0, -far]]);
        for (polygon, factor, light) in [(&body, 116.0, 10.0), (&side, 84.0, 26.0), (&rim, 92.0, 48.0), (&streak, 116.0, 60.0)] {
            imgproc::fill_poly(&mut self.glass_factor, polygon, Scalar::all(factor), imgproc::LINE_AA, 4, Point::default())?;
            imgproc::fill_poly(&mut self.glass_light, polygon, Scalar::all(light), imgproc::LINE_AA, 4, Point::default())?;
        }
        for (from, to, light) in [([0.25, 0.0], [0.25, -far], 120.0), ([0.0, -0.3], [far, -0.3], 105.0), ([wall, -1.0], [wall, -far], 6.0)]
        {
            let (a, b) = (self.image_point(from), self.image_point(to));
            imgproc::line(&mut self.glass_light, a, b, Scalar::all(light), 1, imgproc::LINE_AA, 4)?;
        }
        Ok(())
    }

    /// Head over the lip in mm that drives `flow_ml_s` (step 1 of the module's text). `steep_rad`: alpha, 15 to 90 degrees.
    fn head_mm(&self, flow_ml_s: f64, steep_rad: f64) -> f64 {
        let sin = steep_rad.sin();
        let cd = CD_SHARP * (1.0 - self.view.flat_wall_loss * sin * sin);
        let k = 8.0 / 15.0 * cd * (2.0 * G_MM_S2).sqrt() * (self.view.spout_deg.to_radians() / 2.0).tan();
        (flow_ml_s * 1000.0 * sin / k).powf(0.4)
    }

    /// The liquid's outline in the container's frame, mm, into `self.polygon`. Returns where the upper surface (from far
    /// outside to far inside) lies in it.
    fn outline(&mut self, scene: &Scene) -> std::ops::Range<usize> {
        let alpha = scene.alpha_deg.to_radians();
        let steep = scene.alpha_deg.clamp(15.0, 90.0).to_radians();
        let deep = -150.0;
        self.polygon.clear();
        if scene.flow_ml_s < DRIP_FLOW_ML_S {
            // At rest: a level surface from the left wall to the right, if it is over the wall at all.
            let level = scene.level_mm.min(0.0);
            if scene.alpha_deg < 85.0 {
                let right = 90.0;
                let left_w = level / alpha.cos();
                let right_w = (level - right * alpha.sin()) / alpha.cos();
                self.polygon.extend([[0.6, deep], [0.6, left_w - 0.6 * alpha.tan()], [right, right_w.max(deep)], [right, deep]]);
            }
            return 0..0;
        }
        let head = self.head_mm(scene.flow_ml_s, steep);
        let depth = CRITICAL_DEPTH * head;
        // Slope at the critical section, shared by both sides of it.
        let slope = 1.0 - CRITICAL_DEPTH;
        // Bernoulli at the free surface: speed^2 = 2 g (head - depth), of which this is the level part.
        let speed = (2.0 * G_MM_S2 * (head - depth) / (1.0 + slope * slope)).sqrt();
        let gravity = to_container([0.0, -G_MM_S2], alpha);
        let fly = |start: [f64; 2], velocity: [f64; 2], t: f64| {
            [start[0] + velocity[0] * t + 0.5 * gravity[0] * t * t, start[1] + velocity[1] * t + 0.5 * gravity[1] * t * t]
        };
        let upper_start = to_container([-CRITICAL_BEFORE_LIP * head, depth], steep);
        let upper_velocity = to_container([speed, -slope * speed], steep);
        let lower_velocity = to_container([speed, 0.0], steep);
        // Waves travel down the stream: a few per cent of the head.
        let [phase, amplitude, ..] = self.ripple;
        let wave = |along: f64| 1.0 + amplitude * (along * 2.1 - phase).sin();
        let (steps, flight_s) = (90, 0.19);
        let time = |i: usize| flight_s * (i as f64 / steps as f64).powi(2);

        // Both faces at the same time of flight. A falling jet is pulled round and never thinner than a round one of its flow.
        let faces = |i: usize| {
            let t = time(i);
            let (low, high) = (fly([0.0, 0.0], lower_velocity, t), fly(upper_start, upper_velocity, t));
            let along = [lower_velocity[0] + gravity[0] * t, lower_velocity[1] + gravity[1] * t];
            let fast = along[0].hypot(along[1]);
            let out = [along[1] / fast, -along[0] / fast];
            let out = if to_container([0.0, 1.0], steep)[0] * out[0] + to_container([0.0, 1.0], steep)[1] * out[1] >= 0.0 {
                out
            } else {
                out.map(|v| -v)
            };
            let across = (high[0] - low[0]) * out[0] + (high[1] - low[1]) * out[1];
            let round = (4.0 * scene.flow_ml_s * 1000.0 / (std::f64::consts::PI * fast)).sqrt();
            let thick = across.max(round) * wave(-t * speed / head);
            if t > 0.0 && across < round {
                let middle = [(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0];
                let half = thick / 2.0;
                ([middle[0] - half * out[0], middle[1] - half * out[1]], [middle[0] + half * out[0], middle[1] + half * out[1]])
            } else {
                let more = thick - across;
                (low, [high[0] + more * out[0], high[1] + more * out[1]])
            }
        };
        self.polygon.push([0.6, deep]);
        self.polygon.push([0.0, -0.4]);
        self.polygon.extend((0..=steps).map(|i| faces(i).0));
        let upper_from = self.polygon.len();
        self.polygon.extend((1..=steps).rev().map(|i| faces(i).1));
        let inside = 40;
        for i in 0..=inside {
            // Denser near the lip, 130 mm in all.
            let x = -130.0 * (i as f64 / f64::from(inside)).powi(2);
            let surface = head - (head - depth) * (x / head).exp();
            let x = x - CRITICAL_BEFORE_LIP * head;
            let z = surface * (1.0 + (wave(-x / head) - 1.0) * (x / (2.0 * head)).exp());
            let z = if i == 0 { depth * wave(0.0) } else { z };
            self.polygon.push(to_container([x, z], steep));
        }
        let upper = upper_from..self.polygon.len();
        let last = self.polygon[upper.end - 1];
        self.polygon.push([last[0], deep.min(last[1])]);
        upper
    }

    /// The triangle of what [`Renderer::outline`] has put into `self.polygon`.
    fn truth(&self, upper: std::ops::Range<usize>) -> Truth {
        let surface = &self.polygon[upper];
        // From outside to inside: the last crossing of the left side's line, then the first one of the top edge's.
        let cut = |a: [f64; 2], b: [f64; 2], k: usize| {
            let t = a[k] / (a[k] - b[k]);
            [a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t]
        };
        let Some(rim) = (0..surface.len() - 1).find(|&i| surface[i][1] > 0.0 && surface[i + 1][1] <= 0.0 && surface[i + 1][0] > 0.0) else {
            return Truth::default();
        };
        let Some(side) = (0..=rim).rev().find(|&i| surface[i][0] <= 0.0 && surface[i + 1][0] > 0.0) else { return Truth::default() };
        let mut edge = vec![cut(surface[side], surface[side + 1], 0)];
        edge.extend(&surface[side + 1..=rim]);
        edge.push(cut(surface[rim], surface[rim + 1], 1));
        // Moments of the outline by length: each piece counts as a uniform rod.
        let (mut total, mut sum, mut square) = (0.0, [0.0; 2], [0.0; 3]);
        for pair in edge.windows(2) {
            let ([a, b], [c, d]) = (pair[0], pair[1]);
            let length = (c - a).hypot(d - b);
            total += length;
            sum = [sum[0] + length * (a + c) / 2.0, sum[1] + length * (b + d) / 2.0];
            square[0] += length * (a * a + a * c + c * c) / 3.0;
            square[1] += length * (2.0 * a * b + a * d + c * b + 2.0 * c * d) / 6.0;
            square[2] += length * (b * b + b * d + d * d) / 3.0;
        }
        let mean = [sum[0] / total, sum[1] / total];
        let (xx, xy, yy) =
            (square[0] / total - mean[0] * mean[0], square[1] / total - mean[0] * mean[1], square[2] / total - mean[1] * mean[1]);
        let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
        let normal = [-angle.sin(), angle.cos()];
        let distance = normal[0] * mean[0] + normal[1] * mean[1];
        let (on_x, on_y) = (distance / normal[0], distance / normal[1]);
        let s = self.view.px_per_mm;
        Truth { area_px2: 0.5 * on_x * on_y * s * s, triangle_px: [[0.0, 0.0], [on_x, 0.0], [0.0, on_y]].map(|p| self.to_image(p)) }
    }

    /// Adds a closed outline (image px; as everywhere, whole numbers are the pixels' middles) to `self.cover`, with exact
    /// coverage along rows and four lines a row.
    fn fill(&mut self, outline: &[[f64; 2]]) -> Result<Rect, RenderError> {
        let (width, height) = (self.view.width_px as usize, self.view.height_px as usize);
        let low = |k: usize| outline.iter().fold(f64::MAX, |m, p| m.min(p[k]));
        let high = |k: usize| outline.iter().fold(f64::MIN, |m, p| m.max(p[k]));
        let clamp = |v: f64, most: usize| v.clamp(0.0, most as f64) as usize;
        let (x0, x1) = (clamp(low(0).floor(), width), clamp(high(0).ceil() + 1.0, width));
        let (y0, y1) = (clamp(low(1).floor(), height), clamp(high(1).ceil() + 1.0, height));
        let mut row = [0f32; 4097];
        for y in y0..y1 {
            let (top, bottom) = (y as f64 - 0.5, y as f64 + 0.5);
            self.sides.clear();
            let next = outline.iter().cycle().skip(1);
            self.sides
                .extend(outline.iter().zip(next).filter(|(a, b)| a[1].min(b[1]) <= bottom && a[1].max(b[1]) >= top).map(|(a, b)| (*a, *b)));
            let (mut first_used, mut last_used) = (width, 0);
            for quarter in 0..4 {
                let line = top + (f64::from(quarter) + 0.5) / 4.0;
                self.crossings.clear();
                for (a, b) in &self.sides {
                    if (a[1] <= line) != (b[1] <= line) {
                        self.crossings.push(a[0] + (b[0] - a[0]) * (line - a[1]) / (b[1] - a[1]));
                    }
                }
                self.crossings.sort_by(f64::total_cmp);
                for span in self.crossings.chunks_exact(2) {
                    let (from, to) = ((span[0] + 0.5).clamp(0.0, width as f64), (span[1] + 0.5).clamp(0.0, width as f64));
                    let (first, last) = (from as usize, to as usize);
                    (first_used, last_used) = (first_used.min(first), last_used.max(last + 1));
                    if first == last {
                        row[first] += (to - from) as f32;
                        continue;
                    }
                    row[first] += (first as f64 + 1.0 - from) as f32;
                    row[first + 1..last].iter_mut().for_each(|v| *v += 1.0);
                    row[last] += (to - last as f64) as f32;
                }
            }
            if first_used < last_used {
                let pixels = &mut self.cover.at_row_mut::<u8>(y as i32)?[first_used..last_used.min(width)];
                for (pixel, share) in pixels.iter_mut().zip(&row[first_used..]) {
                    *pixel = (*pixel).max((share * (255.0 / 4.0)).min(255.0) as u8);
                }
                row[first_used..last_used].fill(0.0);
            }
        }
        Ok(Rect::new(x0 as i32, y0 as i32, x1.saturating_sub(x0) as i32, y1.saturating_sub(y0) as i32))
    }

    /// Lays the liquid in `self.cover` over the frame inside `area`, then clears the cover.
    fn lay_liquid(&mut self, area: Rect) -> Result<(), RenderError> {
        if area.width <= 0 || area.height <= 0 {
            return Ok(());
        }
        let around = (1.3 * self.view.px_per_mm) as i32 | 1;
        imgproc::blur(
            &Mat::roi(&self.cover, area)?,
            &mut self.thickness,
            Size::new(around, around),
            Point::new(-1, -1),
            BORDER_REFLECT_101,
        )?;
        Mat::roi(&self.frame, area)?.copy_to(&mut self.behind)?;
        let clear = self.view.liquid_bgr.is_none();
        if clear {
            self.measure_bodies(area)?;
        }
        let (rows, columns) = (area.height as usize, area.width as usize);
        // Continuous copies, indexed directly: this loop reads around each pixel, which no OpenCV call does.
        let behind = self.behind.data_typed::<core::Vec3b>()?;
        let thickness = self.thickness.data_bytes()?;
        let step = (around / 2).max(1) as usize;
        let [phase, _, glitter, _] = self.ripple;
        let water = if clear {
            Some((self.gathered.data_typed::<core::Vec3b>()?, self.depth.data_typed::<f32>()?, self.radius.data_typed::<f32>()?))
        } else {
            None
        };
        let full_width = self.view.width_px as usize;
        let distance_px = BEHIND_MM * self.view.px_per_mm as f32;
        // Upright in the picture; the real direction turns with the wrist, which matters little.
        let room = |down: f32| self.room_level * (1.0 - ROOM_SLOPE * down.clamp(-1.0, 1.0));
        let [mirrored_x, mirrored_y] = &self.mirrored;
        let [surface, shimmer_down, shimmer_up] = &self.waves;
        for y in 0..rows {
            let cover = &mut self.cover.at_row_mut::<u8>(area.y + y as i32)?[area.x as usize..area.x as usize + columns];
            let frame = &mut self.frame.at_row_mut::<core::Vec3b>(area.y + y as i32)?[area.x as usize..area.x as usize + columns];
            let row = |y: usize| &thickness[y * columns..(y + 1) * columns];
            let (above, here, below) = (row(y.saturating_sub(step)), row(y), row((y + step).min(rows - 1)));
            let deep = |y: usize| water.map_or(&[][..], |(_, depth, _)| &depth[y * columns..(y + 1) * columns]);
            let (depth_over, depth, depth_under) = (deep(y.saturating_sub(2)), deep(y), deep((y + 2).min(rows - 1)));
            let row_y = f64::from(y as u32);
            let surface = surface.row(row_y * 0.07 - phase);
            let wander = (row_y * 0.05 + glitter).sin() * 2.0;
            let (shimmer_down, shimmer_up) =
                (shimmer_down.row(wander + glitter - row_y * 0.11), shimmer_up.row(row_y * 0.09 + wander - phase));
            for x in 0..columns {
                if cover[x] == 0 {
                    continue;
                }
                let share = f32::from(cover[x]) / 255.0;
                let thick = f32::from(here[x]) / 255.0;
                // The softened cover falls towards the outline: its slope is the surface's slope there.
                let slope_x = (f32::from(here[(x + step).min(columns - 1)]) - f32::from(here[x.saturating_sub(step)])) / 255.0;
                let slope_y = (f32::from(below[x]) - f32::from(above[x])) / 255.0;
                // A lamp over the operator's left shoulder.
                let lamp = 0.75 * slope_y + 0.35 * slope_x;
                let liquid: [f32; 3] = match self.view.liquid_bgr {
                    Some(colour) => {
                        let hidden = self.view.opacity as f32 * (0.8 + 0.2 * thick);
                        let light = 0.82 + 0.22 * thick + 0.45 * lamp;
                        let glint = if lamp > 0.62 { 90.0 * (lamp - 0.62) / 0.38 } else { 0.0 };
                        let behind = &behind[y * columns + x];
                        std::array::from_fn(|c| f32::from(behind[c]) * (1.0 - hidden) + f32::from(colour[c]) * hidden * light + glint)
                    }
                    None => {
                        let Some((gathered, _, radius)) = water else { continue };
                        // Towards the body's axis, away from its outline.
                        let inwards_x = depth[(x + 2).min(columns - 1)] - depth[x.saturating_sub(2)];
                        let inwards_y = depth_under[x] - depth_over[x];
                        let per_length = 1.0 / (inwards_x * inwards_x + inwards_y * inwards_y).sqrt().max(0.5);
                        let wave = 1.0 + 0.06 * surface(x);
                        let off_axis = 1.0 - depth[x] * wave / radius[y * columns + x].max(1.0);
                        let lens = self.lens[(off_axis.clamp(0.0, 1.0) * OFF_AXIS as f32) as usize];
                        // Where the light comes from, by its angle from straight ahead: what stands behind, or the room beyond it.
                        let seen = |way: Way| -> [f32; 3] {
                            let shift = distance_px * way.tangent * per_length;
                            let beyond = room(shift.signum() * inwards_y * per_length) * (1.0 - way.board);
                            if way.board == 0.0 {
                                return [beyond * way.share; 3];
                            }
                            let from_x = mirrored_x.at((area.x as usize + x) as f32 + shift * inwards_x);
                            let from_y = mirrored_y.at((area.y as usize + y) as f32 + shift * inwards_y);
                            let behind = &gathered[from_y * full_width + from_x];
                            std::array::from_fn(|c| (f32::from(behind[c]) * way.board + beyond) * way.share)
                        };
                        let (passed, reflected) = (seen(lens.passed), seen(lens.reflected));
                        let shimmer = shimmer_down(x) * shimmer_up(x);
                        let glint = if lamp > 0.35 { 190.0 * (lamp - 0.35) } else { 0.0 } + (shimmer - 0.82).max(0.0) * 260.0;
                        std::array::from_fn(|c| passed[c] + reflected[c] + glint)
                    }
                };
                for c in 0..3 {
                    frame[x][c] = (f32::from(frame[x][c]) * (1.0 - share) + liquid[c].min(255.0) * share) as u8;
                }
            }
            cover.fill(0);
        }
        Ok(())
    }

    /// For clear water: how deep each pixel of the cover lies below its outline, how thick the body there is, and what its strong
    /// lens gathers into one pixel.
    fn measure_bodies(&mut self, area: Rect) -> Result<(), RenderError> {
        let mut solid = Mat::default();
        imgproc::threshold(&Mat::roi(&self.cover, area)?, &mut solid, 127.0, 255.0, imgproc::THRESH_BINARY)?;
        // 5 x 5: near enough for optics, and faster than the precise one.
        imgproc::distance_transform(&solid, &mut self.depth, imgproc::DIST_L2, imgproc::DIST_MASK_5, core::CV_32F)?;
        // The largest depth around, at a quarter of the size: it changes slowly.
        let (mut small, mut largest) = (Mat::default(), Mat::default());
        let quarter = Size::new((area.width / 4).max(1), (area.height / 4).max(1));
        imgproc::resize(&self.depth, &mut small, quarter, 0.0, 0.0, imgproc::INTER_AREA)?;
        let reach = (BULGE_MM * self.view.px_per_mm / 4.0) as i32;
        let around = imgproc::get_structuring_element_def(imgproc::MORPH_RECT, Size::new(2 * reach + 1, 2 * reach + 1))?;
        imgproc::dilate_def(&small, &mut largest, &around)?;
        imgproc::blur_def(&largest, &mut small, Size::new(9, 9))?;
        imgproc::resize(&small, &mut self.radius, area.size(), 0.0, 0.0, imgproc::INTER_LINEAR)?;
        let gather = (2.0 * self.view.px_per_mm) as i32 | 1;
        imgproc::blur_def(&self.frame, &mut self.gathered, Size::new(gather, gather))?;
        Ok(())
    }

    /// Drops fall, are born at the lip and splash up from the receiving container.
    fn move_drops(&mut self, scene: &Scene, dt_s: f64) {
        let alpha = scene.alpha_deg.to_radians();
        let gravity = to_container([0.0, -G_MM_S2], alpha);
        for drop in &mut self.drops {
            for ((at, velocity), g) in drop.at_mm.iter_mut().zip(&mut drop.velocity_mm_s).zip(gravity) {
                *at += *velocity * dt_s + 0.5 * g * dt_s * dt_s;
                *velocity += g * dt_s;
            }
        }
        let reach = 120.0;
        self.drops.retain(|d| d.at_mm.iter().all(|v| v.abs() < reach));
        let flowing = scene.flow_ml_s >= DRIP_FLOW_ML_S;
        self.wet = if flowing { 1.0 } else { self.wet * (-dt_s / 0.8).exp() };
        // Too little for a stream leaves as drops; so does the film on the lip for a while.
        if !flowing {
            self.drip_ml += (scene.flow_ml_s.max(0.0) + 0.12 * self.wet * self.wet) * dt_s;
            if self.drip_ml > DROP_ML && self.drops.len() < 60 {
                self.drip_ml -= DROP_ML;
                let out = to_container([self.random.random_range(20.0..90.0), 0.0], alpha);
                let radius_mm = self.random.random_range(0.9..2.0);
                let start = to_container([0.6 + radius_mm, -radius_mm], alpha);
                self.drops.push(Drop { at_mm: start, velocity_mm_s: out, radius_mm });
            }
        }
        if scene.flow_ml_s > 3.0 && self.drops.len() < 55 && self.random.random::<f64>() < 0.05 {
            for _ in 0..self.random.random_range(1..4) {
                let below = to_container([self.random.random_range(-10.0..50.0), -55.0], alpha);
                let up = to_container([self.random.random_range(-250.0..150.0), self.random.random_range(900.0..1400.0)], alpha);
                self.drops.push(Drop { at_mm: below, velocity_mm_s: up, radius_mm: self.random.random_range(0.4..1.3) });
            }
        }
    }

    /// Draws the drops' polygons (stretched by their motion during the exposure) into the cover.
    fn fill_drops(&mut self, scene: &Scene) -> Result<Rect, RenderError> {
        let mut all = Rect::default();
        for i in 0..self.drops.len() {
            let drop = self.drops[i];
            let speed = drop.velocity_mm_s[0].hypot(drop.velocity_mm_s[1]);
            let along = drop.velocity_mm_s.map(|v| if speed > 1.0 { v / speed } else { 0.0 });
            let stretch = 0.5 * speed * self.view.shutter_s;
            let shape: Vec<[f64; 2]> = (0..16)
                .map(|k| {
                    let (sin, cos) = (f64::from(k) * std::f64::consts::TAU / 16.0).sin_cos();
                    let offset = [drop.radius_mm * cos, drop.radius_mm * sin];
                    let ahead = (offset[0] * along[0] + offset[1] * along[1]).signum() * stretch;
                    self.to_image([drop.at_mm[0] + offset[0] + ahead * along[0], drop.at_mm[1] + offset[1] + ahead * along[1]])
                })
                .collect();
            all = join(all, self.fill(&shape)?);
        }
        // A bead hangs at the wet lip.
        if scene.flow_ml_s < DRIP_FLOW_ML_S && self.wet > 0.05 {
            let radius = 1.3 * self.wet.sqrt();
            let centre = to_container([0.5 * radius, -0.6 * radius], scene.alpha_deg.to_radians());
            let shape: Vec<[f64; 2]> = (0..16)
                .map(|k| {
                    let (sin, cos) = (f64::from(k) * std::f64::consts::TAU / 16.0).sin_cos();
                    self.to_image([centre[0] + radius * cos, centre[1] + radius * sin])
                })
                .collect();
            all = join(all, self.fill(&shape)?);
        }
        Ok(all)
    }

    /// Draws one frame of `scene` into `out` (width * height * 3 bytes, BGR) and tells what was drawn.
    pub fn render(&mut self, scene: &Scene, out: &mut [u8]) -> Result<Truth, RenderError> {
        let dt_s = self.last_s.map_or(0.0, |last| (scene.at_s - last).clamp(0.0, 0.2));
        self.last_s = Some(scene.at_s);
        self.move_drops(scene, dt_s);
        let wander = self.random.random_range(-1.7..1.7);
        self.exposure = self.exposure * 0.97 + 0.24 * wander * self.view.exposure_drift;
        self.ripple[0] += dt_s * 95.0;
        self.ripple[1] = 0.025 * (1.0 + (scene.at_s * 3.1).sin()) * self.random.random_range(0.5..1.0);
        self.ripple[2] = self.random.random_range(0.0..std::f64::consts::TAU);

        self.draw_background(scene)?;
        let upper = self.outline(scene);
        let truth = if upper.is_empty() { Truth::default() } else { self.truth(upper) };
        let outline: Vec<[f64; 2]> = self.polygon.iter().map(|p| self.to_image(*p)).collect();
        let body = if outline.is_empty() { Rect::default() } else { self.fill(&outline)? };
        let area = join(body, self.fill_drops(scene)?);
        self.lay_liquid(area)?;
        self.lay_glass()?;
        if self.view.blur_px > 0.0 {
            imgproc::gaussian_blur(
                &self.frame,
                &mut self.blurred,
                Size::new(0, 0),
                self.view.blur_px,
                self.view.blur_px,
                BORDER_REFLECT_101,
            )?;
            std::mem::swap(&mut self.frame, &mut self.blurred);
        }
        self.expose(out)?;
        Ok(truth)
    }

    /// The board, turned with the tilt about the wrist's axis; blurred by the motion during the exposure.
    fn draw_background(&mut self, scene: &Scene) -> Result<(), RenderError> {
        let (width, height) = (self.view.width_px as i32, self.view.height_px as i32);
        let half = Size::new(width / 2, height / 2);
        let centre = Point2f::new(half.width as f32 * 1.2, half.height as f32 * 1.05);
        let middle = self.board.cols() as f64 / 2.0;
        let mut turn = imgproc::get_rotation_matrix_2d(centre, -(scene.alpha_deg + self.view.roll_deg), 1.0)?;
        // The board's middle lies at the wrist's axis.
        let shift = [f64::from(centre.x) - middle, f64::from(centre.y) - middle];
        for row in 0..2 {
            let (a, b) = (*turn.at_2d::<f64>(row, 0)?, *turn.at_2d::<f64>(row, 1)?);
            *turn.at_2d_mut::<f64>(row, 2)? += a * shift[0] + b * shift[1];
        }
        imgproc::warp_affine(&self.board, &mut self.turned, &turn, half, imgproc::INTER_LINEAR, BORDER_REFLECT_101, Scalar::default())?;
        let sweep_px = (scene.rate_deg_s.to_radians() * self.view.shutter_s * f64::from(half.width)).abs();
        if sweep_px > 1.5 {
            let size = (sweep_px as i32) | 1;
            imgproc::blur(&self.turned, &mut self.blurred, Size::new(size, size), Point::new(-1, -1), BORDER_REFLECT_101)?;
            std::mem::swap(&mut self.turned, &mut self.blurred);
        }
        imgproc::resize(&self.turned, &mut self.frame, Size::new(width, height), 0.0, 0.0, imgproc::INTER_LINEAR)?;
        Ok(())
    }

    // The two loops below touch every byte of every frame; wrapping arithmetic (which cannot wrap here) lets them vectorise
    // although overflow checks are on.

    fn lay_glass(&mut self) -> Result<(), RenderError> {
        let (factors, lights) = (self.glass_factor.data_bytes()?, self.glass_light.data_bytes()?);
        for ((pixel, factor), light) in self.frame.data_bytes_mut()?.iter_mut().zip(factors).zip(lights) {
            let through = u16::from(*pixel).wrapping_mul(u16::from(*factor)) >> 7;
            *pixel = through.wrapping_add(u16::from(*light)).min(255) as u8;
        }
        Ok(())
    }

    /// Light, vignette and noise of the sensor.
    fn expose(&mut self, out: &mut [u8]) -> Result<(), RenderError> {
        let offset: usize = self.random.random_range(0..65_536);
        let gain = (self.view.light * (1.0 + self.exposure) * 64.0).clamp(0.0, 127.0) as u16;
        let (pixels, noise) = (self.frame.data_bytes()?, &self.noise[offset..]);
        for (((out, pixel), noise), vignette) in out.iter_mut().zip(pixels).zip(noise).zip(&self.vignette) {
            // 128 is a factor of 1; at most 255, so that the product fits 16 bits.
            let factor = (gain.wrapping_mul(*vignette) >> 7).min(255);
            let level = u16::from(*pixel).wrapping_mul(factor) >> 7;
            *out = (level as i16).wrapping_add(i16::from(*noise)).clamp(0, 255) as u8;
        }
        Ok(())
    }
}

/// Light from one direction: its share, the tangent of its angle from straight ahead (towards the body's axis), and the share of what
/// stands behind (rather than the room beyond it) that is seen there.
#[derive(Debug, Clone, Copy)]
struct Way {
    share: f32,
    tangent: f32,
    board: f32,
}

/// What is seen at one place of a body of water.
#[derive(Debug, Clone, Copy)]
struct Lens {
    passed: Way,
    reflected: Way,
}

/// Light straight ahead through a cylinder of water, `off_axis` (0 to 1) radii from its axis: what passes is bent twice (Snell), what the
/// outside reflects comes from its own side (Fresnel, unpolarised).
fn through_cylinder(off_axis: f32) -> Lens {
    let sine = off_axis.clamp(0.0, 0.999);
    let (incident, refracted) = (sine.asin(), (sine / WATER_INDEX).asin());
    let (cos_i, cos_r) = (incident.cos(), refracted.cos());
    let across = (cos_i - WATER_INDEX * cos_r) / (cos_i + WATER_INDEX * cos_r);
    let along = (WATER_INDEX * cos_i - cos_r) / (WATER_INDEX * cos_i + cos_r);
    let reflected = 0.5 * (across * across + along * along);
    let way = |share: f32, angle: f32| Way {
        share,
        tangent: angle.clamp(-MOST_BENT, MOST_BENT).tan(),
        board: ((BOARD_ENDS_DEG + 4.0 - angle.abs().to_degrees()) / 8.0).clamp(0.0, 1.0),
    };
    let bent = 2.0 * (incident - refracted);
    Lens { passed: way((1.0 - reflected) * (1.0 - reflected), bent), reflected: way(reflected, -2.0 * off_axis.clamp(0.0, 1.0).acos()) }
}

/// The background goes on beyond the picture, mirrored.
struct Mirror {
    /// How far outside places may lie, px.
    reach: i32,
    /// Of the place `index - reach`.
    places: Vec<u16>,
}

impl Mirror {
    /// For a picture of `size` px and places up to `reach_px` outside of it.
    fn new(size: i32, reach_px: f32) -> Self {
        let (reach, period) = (reach_px.ceil() as i32 + 1, 2 * (size - 1));
        let folded = (-reach..size + reach).map(|at| at.rem_euclid(period));
        Self { reach, places: folded.map(|at| at.min(period - at) as u16).collect() }
    }

    fn at(&self, place: f32) -> usize {
        usize::from(self.places[(place as i32 + self.reach) as usize])
    }
}

/// `sin(a x + b)` for whole x, by the sum of angles: two multiplications a pixel.
struct Wave(Vec<(f32, f32)>);

impl Wave {
    fn new(rad_per_px: f64, width: i32) -> Self {
        Self((0..width).map(|x| (f64::from(x) * rad_per_px).sin_cos()).map(|(sin, cos)| (sin as f32, cos as f32)).collect())
    }

    fn row(&self, offset_rad: f64) -> impl Fn(usize) -> f32 {
        let (sin, cos) = offset_rad.sin_cos();
        let (sin, cos) = (sin as f32, cos as f32);
        move |x| self.0[x].0 * cos + self.0[x].1 * sin
    }
}

fn join(a: Rect, b: Rect) -> Rect {
    if a.width <= 0 || a.height <= 0 {
        return b;
    }
    if b.width <= 0 || b.height <= 0 {
        return a;
    }
    a | b
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scene(alpha_deg: f64, flow_ml_s: f64) -> Scene {
        Scene { at_s: 1.0, alpha_deg, flow_ml_s, level_mm: -3.0, ..Scene::default() }
    }

    /// Protects the link between flow and feature: more flow is always a larger triangle, no flow is none.
    #[test]
    fn area_grows_with_flow() -> Result<(), RenderError> {
        let view = View::default();
        let mut out = vec![0; 640 * 480 * 3];
        for alpha in [25.0, 45.0, 60.0, 75.0, 90.0, 105.0] {
            let mut renderer = Renderer::new(&view, 1)?;
            assert_eq!(renderer.render(&scene(alpha, 0.0), &mut out)?.area_px2, 0.0);
            let mut last = 0.0;
            print!("{alpha:5}:");
            for flow in [0.3, 1.0, 3.0, 5.0, 10.0, 20.0, 40.0] {
                let area = renderer.render(&scene(alpha, flow), &mut out)?.area_px2;
                print!(" {area:6.0}");
                assert!(area > 1.3 * last, "alpha {alpha} flow {flow}: {area} after {last}");
                last = area;
            }
            println!();
        }
        Ok(())
    }

    /// Protects reproducible evaluation: the same view, seed and scenes give the same bytes.
    #[test]
    fn same_seed_same_bytes() -> Result<(), RenderError> {
        let draw = || -> Result<Vec<u8>, RenderError> {
            let mut renderer = Renderer::new(&View::default(), 7)?;
            let mut out = vec![0; 640 * 480 * 3];
            for i in 0..12 {
                let at_s = f64::from(i) / 30.0;
                let flow = if i < 6 { 8.0 } else { 0.05 };
                renderer.render(&Scene { at_s, alpha_deg: 70.0, rate_deg_s: 5.0, flow_ml_s: flow, level_mm: -1.0 }, &mut out)?;
            }
            Ok(out)
        };
        assert!(draw()? == draw()?);
        Ok(())
    }
}
