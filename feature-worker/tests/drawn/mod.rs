//! Pictures for the tests, drawn by a few OpenCV calls: a turning chess board, a glass whose lip is at (215, 250), and a stream whose outer
//! edge cuts the axes at known distances. Nothing here knows how the extraction works.
#![allow(dead_code)]

use std::cell::RefCell;

use opencv::core::{self, CV_8UC3, Mat, Point, Point2f, Rect, Scalar, Size, Vector};
use opencv::imgproc;
use opencv::prelude::*;
use shared::config::{CameraConfig, Config, ImageConfig, LiquidMethod};

pub const WIDTH: i32 = 640;
pub const HEIGHT: i32 = 480;
const BLUE: Scalar = Scalar::new(150.0, 62.0, 20.0, 0.0);
/// The glass's lip, px.
const LIP: [f32; 2] = [215.0, 250.0];
/// How many times larger the shapes are drawn, for smooth edges.
const FINE: i32 = 4;

pub type Outcome = Result<(), Box<dyn std::error::Error>>;

pub fn sim_config() -> &'static str {
    concat!(env!("CARGO_MANIFEST_DIR"), "/../config/sim.toml")
}

pub fn camera() -> CameraConfig {
    CameraConfig { width_px: WIDTH as u32, height_px: HEIGHT as u32, ..CameraConfig::default() }
}

pub fn image_config(method: LiquidMethod) -> ImageConfig {
    ImageConfig {
        method,
        region_px: [191, 16, 420, 270],
        x_axis_px: [215.0, 250.0, 600.0, 250.0],
        y_axis_px: [215.0, 470.0, 215.0, 250.0],
        colour_hsv: [98, 90, 25, 124, 255, 255],
        area_min_px2: 30.0,
    }
}

/// The simulated cell's configuration for another cell's name, written to `directory`.
pub fn write_config(
    directory: &std::path::Path,
    cell: &str,
    change: impl Fn(&mut Config),
) -> std::io::Result<(std::path::PathBuf, Config)> {
    let text = std::fs::read_to_string(sim_config())?;
    let mut config = Config::parse(&text, "sim.toml").map_err(std::io::Error::other)?;
    config.cell.name = format!("{cell}-{}", std::process::id());
    config.image = image_config(LiquidMethod::Colour);
    config.recording.directory = directory.join("episodes");
    config.worker.priority = 0;
    change(&mut config);
    let path = directory.join("cell.toml");
    std::fs::write(&path, toml::to_string(&config).map_err(std::io::Error::other)?)?;
    Ok((path, config))
}

fn polygon(shape: &[[f32; 2]], scale: f32) -> Vector<Point> {
    // Whole numbers are the middles of pixels.
    let at = |v: f32| (v * scale + (scale - 1.0) / 2.0).round() as i32;
    shape.iter().map(|p| Point::new(at(p[0]), at(p[1]))).collect()
}

/// Liquid in the glass and over the lip whose outer edge cuts the axes at `a` and `b` px from the lip.
pub fn stream(a: f32, b: f32) -> Shape {
    let [x, y] = LIP;
    let beyond = y - b - 95.0 * b / a;
    let right = x + 1.5 * a;
    vec![[x, 479.0], [x, y], [x - 95.0, y], [x - 95.0, beyond], [x + a, y], [right, y + 0.5 * b], [right, 479.0]]
}

/// A round shape.
pub fn disc(x: f32, y: f32, radius: f32) -> Shape {
    (0..24).map(|k| (k as f32 * std::f32::consts::TAU / 24.0).sin_cos()).map(|(s, c)| [x + radius * c, y + radius * s]).collect()
}

thread_local! {
    /// The last board and the last cover, which most tests draw many times in a row: the tests would take twice as long without.
    static BOARD: RefCell<Option<(f32, Mat)>> = const { RefCell::new(None) };
    static COVER: RefCell<Option<(Vec<Shape>, Mat)>> = const { RefCell::new(None) };
}

/// The corners of a shape, px.
pub type Shape = Vec<[f32; 2]>;

/// What is kept for `key`, or else what `draw` draws, which is kept then.
fn kept<K: PartialEq>(
    last: &'static std::thread::LocalKey<RefCell<Option<(K, Mat)>>>,
    key: K,
    draw: impl FnOnce(&K) -> Result<Mat, opencv::Error>,
) -> Result<Mat, opencv::Error> {
    last.with_borrow_mut(|last| match last {
        Some((of, picture)) if *of == key => Ok(picture.clone()),
        _ => {
            let picture = draw(&key)?;
            *last = Some((key, picture.clone()));
            Ok(picture)
        }
    })
}

/// A chess board that is turned by `turn_deg` about a point outside of the picture, and is out of focus.
pub fn board(turn_deg: f32) -> Result<Mat, opencv::Error> {
    kept(&BOARD, turn_deg, |turn_deg| draw_board(*turn_deg))
}

fn draw_board(turn_deg: f32) -> Result<Mat, opencv::Error> {
    let side = 1600;
    let mut large = Mat::new_rows_cols_with_default(side, side, CV_8UC3, Scalar::all(185.0))?;
    for row in 0..20 {
        for column in (row % 2..20).step_by(2) {
            imgproc::rectangle(&mut large, Rect::new(column * 80, row * 80, 80, 80), Scalar::all(75.0), imgproc::FILLED, 8, 0)?;
        }
    }
    let turn = imgproc::get_rotation_matrix_2d(Point2f::new(700.0, 520.0), f64::from(turn_deg), 1.0)?;
    let (mut turned, mut soft) = (Mat::default(), Mat::default());
    imgproc::warp_affine(&large, &mut turned, &turn, Size::new(WIDTH, HEIGHT), imgproc::INTER_LINEAR, 0, Scalar::default())?;
    imgproc::gaussian_blur_def(&turned, &mut soft, Size::new(0, 0), 1.8)?;
    Ok(soft)
}

/// `picture` with light noise, which differs for each `seed`.
pub fn noisy(picture: &Mat, seed: i32) -> Result<Mat, opencv::Error> {
    core::set_rng_seed(seed)?;
    let mut noise = picture.clone();
    core::randn(&mut noise, &Scalar::all(4.0), &Scalar::all(2.0))?;
    let mut sum = Mat::default();
    core::add(picture, &noise, &mut sum, &core::no_array(), -1)?;
    Ok(sum)
}

/// The share of each pixel that `shapes` cover, 0 to 255.
fn cover(shapes: &[Shape]) -> Result<Mat, opencv::Error> {
    kept(&COVER, shapes.to_vec(), |shapes| draw_cover(shapes))
}

fn draw_cover(shapes: &[Shape]) -> Result<Mat, opencv::Error> {
    let mut large = Mat::new_rows_cols_with_default(HEIGHT * FINE, WIDTH * FINE, core::CV_8UC1, Scalar::all(0.0))?;
    for shape in shapes {
        imgproc::fill_poly(&mut large, &polygon(shape, FINE as f32), Scalar::all(255.0), imgproc::LINE_8, 0, Point::default())?;
    }
    let mut small = Mat::default();
    imgproc::resize(&large, &mut small, Size::new(WIDTH, HEIGHT), 0.0, 0.0, imgproc::INTER_AREA)?;
    Ok(small)
}

/// `picture` with `shapes` of blue liquid over it.
fn pour_over(picture: &mut Mat, shapes: &[Shape]) -> Result<(), opencv::Error> {
    lay_over(picture, shapes, BLUE)
}

/// `picture` with `shapes` of a liquid of this colour (blue, green, red) over it.
pub fn lay_over(picture: &mut Mat, shapes: &[Shape], colour: Scalar) -> Result<(), opencv::Error> {
    let cover = cover(shapes)?;
    let cover = cover.data_bytes()?;
    for (pixel, share) in picture.data_typed_mut::<core::Vec3b>()?.iter_mut().zip(cover).filter(|(_, share)| **share > 0) {
        for c in 0..3 {
            let share = f64::from(*share) / 255.0;
            pixel[c] = (f64::from(pixel[c]) * (1.0 - share) + colour[c] * share).round() as u8;
        }
    }
    Ok(())
}

/// Draws the glass over everything: it is a little darker inside, with bright lines along its top edge and its left side.
pub fn glass(picture: &mut Mat) -> Result<(), opencv::Error> {
    let [x, y] = LIP.map(|v| v as i32);
    let mut inside = Mat::roi_mut(picture, Rect::new(x, y, WIDTH - x, HEIGHT - y))?;
    let mut dark = Mat::default();
    inside.convert_to(&mut dark, -1, 0.85, 8.0)?;
    dark.copy_to(&mut inside)?;
    for (to, width) in [(Point::new(WIDTH, y), 2), (Point::new(x, HEIGHT), 2)] {
        imgproc::line(picture, Point::new(x, y), to, Scalar::all(250.0), width, imgproc::LINE_AA, 0)?;
    }
    Ok(())
}

/// Blue liquid over a board, without a glass. `seed` gives each picture its own noise.
pub fn blue(shapes: &[Shape], seed: i32) -> Result<Mat, opencv::Error> {
    let mut picture = board(seed as f32)?;
    pour_over(&mut picture, shapes)?;
    noisy(&picture, seed)
}

/// Frame `i` of a pour of blue liquid from a glass that turns by one degree a frame. It is dry up to frame 7 and from frame 33 on; the
/// largest triangle (90 x 80 px) is at frame 20.
pub fn pour(i: i32) -> Result<Mat, opencv::Error> {
    pour_before(i, board(i as f32)?, BLUE)
}

/// Frame `i` of such a pour of a liquid of another colour, before another background.
pub fn pour_before(i: i32, mut picture: Mat, colour: Scalar) -> Result<Mat, opencv::Error> {
    let share = (1.0 - (i - 20) as f32 / 13.0 * if i < 20 { -1.0 } else { 1.0 }).max(0.0);
    if share > 0.08 {
        lay_over(&mut picture, &[stream(90.0 * share, 80.0 * share)], colour)?;
    }
    glass(&mut picture)?;
    noisy(&picture, i)
}

/// A dry glass in front of the board.
pub fn dry(turn_deg: f32, seed: i32) -> Result<Mat, opencv::Error> {
    let mut picture = board(turn_deg)?;
    glass(&mut picture)?;
    noisy(&picture, seed)
}

/// A frame of clear water in front of a board that turns, or in front of an even wall. Water takes a little light, and much along its edge.
/// The legs of its triangle are `share` of 90 x 80 px; with 0 it is dry.
pub fn water(share: f32, turn_deg: Option<f32>, seed: i32) -> Result<Mat, opencv::Error> {
    let mut picture = match turn_deg {
        Some(turn_deg) => board(turn_deg)?,
        None => Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_8UC3, Scalar::all(165.0))?,
    };
    if share > 0.0 {
        let cover = cover(&[stream(90.0 * share, 80.0 * share)])?;
        let mut deep = Mat::default();
        imgproc::blur(&cover, &mut deep, Size::new(7, 7), Point::new(-1, -1), core::BORDER_REFLECT_101)?;
        let (cover, deep) = (cover.data_bytes()?, deep.data_bytes()?);
        for (pixel, (cover, deep)) in picture.data_typed_mut::<core::Vec3b>()?.iter_mut().zip(cover.iter().zip(deep)) {
            let through = 0.93 - 0.9 * (255.0 - f64::from(*deep)) / 255.0;
            for c in 0..3 {
                pixel[c] = (f64::from(pixel[c]) * (1.0 - f64::from(*cover) / 255.0 * (1.0 - through))) as u8;
            }
        }
    }
    glass(&mut picture)?;
    noisy(&picture, seed)
}
