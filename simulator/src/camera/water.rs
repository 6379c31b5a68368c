//! How clear water looks: a body of water bends the light from behind it (Snell) and reflects the room (Fresnel).
//!
//! Each body of water is taken for a cylinder of its own thickness, with its axis along its outline. Called by the renderer, on its
//! thread. Allocates when it is set up and at the first frame; failures are OpenCV's.

use opencv::core::{self, Mat, Rect, Size, Vec3b};
use opencv::imgproc;
use opencv::prelude::*;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;

use super::stream_outline::Ripple;
use super::view::View;

/// Refractive index of water at room temperature in visible light.
const WATER_INDEX: f32 = 1.333;
/// Distance from the stream to what stands behind it, mm. Chosen by hand, as a bench on which a robot stands before a board.
const BEHIND_MM: f32 = 200.0;
/// Angle from straight ahead at which the board behind ends, degrees; beyond it is the room. Chosen by hand.
const BOARD_ENDS_DEG: f32 = 35.0;
/// Grey level of the room; each renderer draws its own from this range. Chosen by hand, from a dark to a light room.
const ROOM_LEVELS: std::ops::Range<f32> = 25.0..130.0;
/// Share by which the room is lighter above and darker below. Chosen by hand, for lamps at the ceiling.
const ROOM_SLOPE: f32 = 0.4;
/// Light is bent by at most this angle, rad: beyond it the tangent would leave every picture.
const MOST_BENT_RAD: f32 = 1.4;
/// Steps of the table of optics, from the axis of a body of water to its outline: finer than a pixel of every body that is drawn.
const OFF_AXIS: usize = 1024;
/// Largest radius of the cylinders that bodies of water are taken for, mm. Chosen by hand; a thicker body has a flatter face.
const BULGE_MM: f64 = 12.0;

/// Light from one direction.
#[derive(Debug, Clone, Copy)]
struct Way {
    /// Share of the light that takes this way.
    share: f32,
    /// Tangent of its angle from straight ahead, towards the body's axis.
    tangent: f32,
    /// Share of the board, rather than of the room beyond it, in what is seen there.
    board: f32,
}

/// What is seen at one place of a body of water.
#[derive(Debug, Clone, Copy)]
struct Lens {
    passed: Way,
    reflected: Way,
}

impl Lens {
    /// Light straight ahead through a cylinder of water, `off_axis` (0 to 1) radii from its axis. What passes is bent twice (Snell);
    /// what the outside reflects comes from its own side (Fresnel, unpolarised).
    fn through_cylinder(off_axis: f32) -> Self {
        let sine = off_axis.clamp(0.0, 0.999);
        let (incident, refracted) = (sine.asin(), (sine / WATER_INDEX).asin());
        let (cos_i, cos_r) = (incident.cos(), refracted.cos());
        let across = (cos_i - WATER_INDEX * cos_r) / (cos_i + WATER_INDEX * cos_r);
        let along = (WATER_INDEX * cos_i - cos_r) / (WATER_INDEX * cos_i + cos_r);
        let reflected = 0.5 * (across * across + along * along);
        let way = |share: f32, angle: f32| Way {
            share,
            tangent: angle.clamp(-MOST_BENT_RAD, MOST_BENT_RAD).tan(),
            board: ((BOARD_ENDS_DEG + 4.0 - angle.abs().to_degrees()) / 8.0).clamp(0.0, 1.0),
        };
        let bent = 2.0 * (incident - refracted);
        Self { passed: way((1.0 - reflected) * (1.0 - reflected), bent), reflected: way(reflected, -2.0 * off_axis.clamp(0.0, 1.0).acos()) }
    }
}

/// Continues the background beyond the picture by mirroring it.
struct Mirror {
    /// How far outside of the picture places may lie, px.
    reach: i32,
    /// Where the place `index - reach` is found.
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

    /// The wave along one row, with `b` in rad.
    fn row(&self, offset_rad: f64) -> WaveRow<'_> {
        let (sin, cos) = offset_rad.sin_cos();
        WaveRow { table: &self.0, sin: sin as f32, cos: cos as f32 }
    }
}

/// A [`Wave`] along one row.
struct WaveRow<'a> {
    table: &'a [(f32, f32)],
    sin: f32,
    cos: f32,
}

impl WaveRow<'_> {
    fn at(&self, x: usize) -> f32 {
        self.table[x].0 * self.cos + self.table[x].1 * self.sin
    }
}

/// The optics of clear water in front of one camera.
pub struct Water {
    width_px: usize,
    px_per_mm: f64,
    /// Distance to what stands behind, px.
    distance_px: f32,
    /// The picture behind, as one pixel of the water's strong lens gathers it.
    gathered: Mat,
    /// Depth of each pixel below the outline of its body, px.
    depth: Mat,
    /// Radius of the body that each pixel belongs to, px.
    radius: Mat,
    room_level: f32,
    /// [`Lens::through_cylinder`] at [`OFF_AXIS`] + 1 places from the axis to the outline.
    lenses: Vec<Lens>,
    /// Where a place outside of the picture is found in it: columns and rows.
    mirrored: [Mirror; 2],
    /// Waves along the picture's columns: of the water's surface, and the two whose product is its shimmer.
    waves: [Wave; 3],
}

impl Water {
    /// Clear water in front of the camera of `view`; `seed` draws the room.
    pub fn new(view: &View, seed: u64) -> Self {
        let (width, height) = (view.width_px as i32, view.height_px as i32);
        Self {
            width_px: view.width_px as usize,
            px_per_mm: view.px_per_mm,
            distance_px: BEHIND_MM * view.px_per_mm as f32,
            gathered: Mat::default(),
            depth: Mat::default(),
            radius: Mat::default(),
            // The room has a random generator of its own, so that it takes no numbers from the one that draws everything else.
            room_level: Pcg64Mcg::seed_from_u64(!seed).random_range(ROOM_LEVELS),
            lenses: (0..=OFF_AXIS).map(|i| Lens::through_cylinder(i as f32 / OFF_AXIS as f32)).collect(),
            mirrored: [width, height].map(|size| Mirror::new(size, BEHIND_MM * view.px_per_mm as f32 * MOST_BENT_RAD.tan())),
            waves: [0.11, 0.13, 0.06].map(|per_px| Wave::new(per_px, width)),
        }
    }

    /// Finds for the pixels of `area` how deep they lie below the outline of the cover, how thick the body there is, and what its
    /// strong lens gathers of `frame` into one pixel.
    pub fn measure_bodies(&mut self, cover: &Mat, frame: &Mat, area: Rect) -> opencv::Result<()> {
        let mut solid = Mat::default();
        imgproc::threshold(&Mat::roi(cover, area)?, &mut solid, 127.0, 255.0, imgproc::THRESH_BINARY)?;
        // The 5 x 5 mask is near enough for optics, and faster than the precise one.
        imgproc::distance_transform(&solid, &mut self.depth, imgproc::DIST_L2, imgproc::DIST_MASK_5, core::CV_32F)?;
        // The largest depth around changes slowly, so a quarter of the size does.
        let (mut small, mut largest) = (Mat::default(), Mat::default());
        let quarter = Size::new((area.width / 4).max(1), (area.height / 4).max(1));
        imgproc::resize(&self.depth, &mut small, quarter, 0.0, 0.0, imgproc::INTER_AREA)?;
        let reach = (BULGE_MM * self.px_per_mm / 4.0) as i32;
        let around = imgproc::get_structuring_element_def(imgproc::MORPH_RECT, Size::new(2 * reach + 1, 2 * reach + 1))?;
        imgproc::dilate_def(&small, &mut largest, &around)?;
        imgproc::blur_def(&largest, &mut small, Size::new(9, 9))?;
        imgproc::resize(&small, &mut self.radius, area.size(), 0.0, 0.0, imgproc::INTER_LINEAR)?;
        let gather = (2.0 * self.px_per_mm) as i32 | 1;
        imgproc::blur_def(frame, &mut self.gathered, Size::new(gather, gather))
    }

    /// The row `y` of `area`, as [`Water::measure_bodies`] has found it.
    pub fn row(&self, area: Rect, y: usize, ripple: Ripple) -> opencv::Result<WaterRow<'_>> {
        let (rows, columns) = (area.height as usize, area.width as usize);
        let depth = self.depth.data_typed::<f32>()?;
        let deep = |y: usize| &depth[y * columns..(y + 1) * columns];
        let row_y = f64::from(y as u32);
        let wander = (row_y * 0.05 + ripple.shimmer_rad).sin() * 2.0;
        let [surface, down, up] = &self.waves;
        Ok(WaterRow {
            water: self,
            gathered: self.gathered.data_typed::<Vec3b>()?,
            depth_over: deep(y.saturating_sub(2)),
            depth: deep(y),
            depth_under: deep((y + 2).min(rows - 1)),
            radius: &self.radius.data_typed::<f32>()?[y * columns..(y + 1) * columns],
            left: area.x as usize,
            y: area.y as usize + y,
            surface: surface.row(row_y * 0.07 - ripple.phase_rad),
            shimmer: [down.row(wander + ripple.shimmer_rad - row_y * 0.11), up.row(row_y * 0.09 + wander - ripple.phase_rad)],
        })
    }
}

/// One row of the water.
pub struct WaterRow<'a> {
    water: &'a Water,
    gathered: &'a [Vec3b],
    depth_over: &'a [f32],
    depth: &'a [f32],
    depth_under: &'a [f32],
    radius: &'a [f32],
    /// Column of the picture at which the row begins.
    left: usize,
    /// Row of the picture.
    y: usize,
    surface: WaveRow<'a>,
    shimmer: [WaveRow<'a>; 2],
}

impl WaterRow<'_> {
    /// Blue, green and red of the water at the column `x`, when a lamp lights its surface by `lamp`.
    pub fn colour(&self, x: usize, lamp: f32) -> [f32; 3] {
        let depth = self.depth;
        // Towards the body's axis, away from its outline.
        let inwards_x = depth[(x + 2).min(depth.len() - 1)] - depth[x.saturating_sub(2)];
        let inwards_y = self.depth_under[x] - self.depth_over[x];
        let per_length = 1.0 / (inwards_x * inwards_x + inwards_y * inwards_y).sqrt().max(0.5);
        let wave = 1.0 + 0.06 * self.surface.at(x);
        let off_axis = 1.0 - depth[x] * wave / self.radius[x].max(1.0);
        let lens = self.water.lenses[(off_axis.clamp(0.0, 1.0) * OFF_AXIS as f32) as usize];
        // What is seen along one way: what stands behind, or the room beyond it.
        let seen = |way: Way| -> [f32; 3] {
            let shift = self.water.distance_px * way.tangent * per_length;
            let beyond = self.room(shift.signum() * inwards_y * per_length) * (1.0 - way.board);
            if way.board == 0.0 {
                return [beyond * way.share; 3];
            }
            let [mirrored_x, mirrored_y] = &self.water.mirrored;
            let from_x = mirrored_x.at((self.left + x) as f32 + shift * inwards_x);
            let from_y = mirrored_y.at(self.y as f32 + shift * inwards_y);
            let behind = &self.gathered[from_y * self.water.width_px + from_x];
            std::array::from_fn(|c| (f32::from(behind[c]) * way.board + beyond) * way.share)
        };
        let (passed, reflected) = (seen(lens.passed), seen(lens.reflected));
        let shimmer = self.shimmer[0].at(x) * self.shimmer[1].at(x);
        let glint = if lamp > 0.35 { 190.0 * (lamp - 0.35) } else { 0.0 } + (shimmer - 0.82).max(0.0) * 260.0;
        std::array::from_fn(|c| passed[c] + reflected[c] + glint)
    }

    /// Grey level of the room in a direction that is -1 for up, 0 for level and 1 for down. Up is up in the picture; the real direction
    /// turns with the wrist, which matters little.
    fn room(&self, down: f32) -> f32 {
        self.water.room_level * (1.0 - ROOM_SLOPE * down.clamp(-1.0, 1.0))
    }
}
