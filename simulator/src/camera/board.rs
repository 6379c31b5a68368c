//! What stands behind the container. It is painted once and then turned with the tilt for every frame.
//!
//! Called by the renderer, on its thread. It allocates when it is painted and at the first frame. Its failures are OpenCV's.

use opencv::core::{BORDER_REFLECT_101, CV_8UC3, Mat, Point, Point2f, Rect, Scalar, Size, Vec3b};
use opencv::imgproc;
use opencv::prelude::*;
use rand::RngExt;
use rand_pcg::Pcg64Mcg;

use super::view::{Background, Scene, View};

/// Share of a hand's speed that is left after a frame. Chosen by hand, so that it trembles at about 3 Hz.
const HAND_DAMPING: f64 = 0.8;
/// Share of a hand's way by which it is pulled back in a frame. Chosen as [`HAND_DAMPING`] was.
const HAND_SPRING: f64 = 0.3;
/// Grey level of a dark curtain. Chosen by hand, after photographs of pours before one.
const CURTAIN_LEVEL: f64 = 30.0;

/// The background, at half the picture's resolution.
pub struct Board {
    /// Square, and larger than the picture's diagonal.
    painted: Mat,
    turned: Mat,
    blurred: Mat,
    /// Where a hand has moved it, px of the half-size picture, and how fast, px a frame.
    hand_px: [f64; 2],
    hand_px_per_frame: [f64; 2],
}

impl Board {
    /// Paints the background of `view`; `random` draws its details.
    pub fn new(view: &View, random: &mut Pcg64Mcg) -> opencv::Result<Self> {
        let side = f64::from(view.width_px).hypot(f64::from(view.height_px)) as i32 + 2;
        Ok(Self {
            painted: paint(view.background, side, random)?,
            turned: Mat::default(),
            blurred: Mat::default(),
            hand_px: [0.0; 2],
            hand_px_per_frame: [0.0; 2],
        })
    }

    /// Lets the hand that holds camera and container move on by one frame. Nothing is drawn from `random` without a hand.
    pub fn shake(&mut self, view: &View, random: &mut Pcg64Mcg) {
        if view.hand_px <= 0.0 {
            return;
        }
        for (at, speed) in self.hand_px.iter_mut().zip(&mut self.hand_px_per_frame) {
            // A hand's tremor: a spring that is pushed at random. A uniform push of +-0.33 deviations makes about one deviation of way.
            *speed = HAND_DAMPING * *speed - HAND_SPRING * *at + random.random_range(-0.33..0.33) * 0.5 * view.hand_px;
            *at += *speed;
        }
    }

    /// Draws the board into `frame`, turned with the tilt about the wrist's axis and blurred by its motion during the exposure.
    pub fn draw(&mut self, view: &View, scene: &Scene, frame: &mut Mat) -> opencv::Result<()> {
        let (width, height) = (view.width_px as i32, view.height_px as i32);
        let half = Size::new(width / 2, height / 2);
        let centre = Point2f::new(half.width as f32 * 1.2, half.height as f32 * 1.05);
        let middle = self.painted.cols() as f64 / 2.0;
        let mut turn = imgproc::get_rotation_matrix_2d(centre, -(scene.alpha_deg + view.roll_deg), 1.0)?;
        // The board's middle lies at the wrist's axis.
        let shift = [f64::from(centre.x) - middle + self.hand_px[0], f64::from(centre.y) - middle + self.hand_px[1]];
        for row in 0..2 {
            let (a, b) = (*turn.at_2d::<f64>(row, 0)?, *turn.at_2d::<f64>(row, 1)?);
            *turn.at_2d_mut::<f64>(row, 2)? += a * shift[0] + b * shift[1];
        }
        imgproc::warp_affine(&self.painted, &mut self.turned, &turn, half, imgproc::INTER_LINEAR, BORDER_REFLECT_101, Scalar::default())?;
        let sweep_px = (scene.rate_deg_s.to_radians() * view.shutter_s * f64::from(half.width)).abs();
        if sweep_px > 1.5 {
            let size = (sweep_px as i32) | 1;
            imgproc::blur(&self.turned, &mut self.blurred, Size::new(size, size), Point::new(-1, -1), BORDER_REFLECT_101)?;
            std::mem::swap(&mut self.turned, &mut self.blurred);
        }
        imgproc::resize(&self.turned, frame, Size::new(width, height), 0.0, 0.0, imgproc::INTER_LINEAR)
    }
}

fn bgr(level: f64, tint: [f64; 3]) -> Scalar {
    Scalar::new(level * tint[0], level * tint[1], level * tint[2], 0.0)
}

/// Paints a square background with sides of `side` px.
fn paint(kind: Background, side: i32, random: &mut Pcg64Mcg) -> opencv::Result<Mat> {
    let mut board = Mat::new_rows_cols_with_default(side, side, CV_8UC3, bgr(168.0, [0.93, 0.99, 1.0]))?;
    match kind {
        Background::Chess => paint_chess(&mut board, side, random)?,
        Background::Wood => paint_wood(&mut board, side, random)?,
        Background::Clutter => paint_clutter(&mut board, side, random)?,
        Background::Plain => {}
        Background::Curtain => paint_curtain(&mut board, random)?,
    }
    // The board is behind the plane of focus.
    let mut soft = Mat::default();
    let sigma = 1.0;
    imgproc::gaussian_blur_def(&board, &mut soft, Size::new(0, 0), sigma)?;
    Ok(soft)
}

fn fill(board: &mut Mat, rect: Rect, colour: Scalar) -> opencv::Result<()> {
    imgproc::rectangle(board, rect, colour, imgproc::FILLED, imgproc::LINE_8, 0)
}

/// A dark cloth, whose folds are a little brighter where they turn to the lamp.
fn paint_curtain(board: &mut Mat, random: &mut Pcg64Mcg) -> opencv::Result<()> {
    let waves: [(f64, f64, f64); 3] =
        std::array::from_fn(|_| (random.random_range(25.0..90.0), random.random_range(0.0..6.3), random.random_range(1.0..5.0)));
    let (rows, columns) = (board.rows(), board.cols());
    for y in 0..rows {
        for (x, pixel) in board.at_row_mut::<Vec3b>(y)?.iter_mut().enumerate().take(columns as usize) {
            // Folds hang a little askew.
            let along = x as f64 + 0.08 * f64::from(y);
            let fold: f64 =
                waves.iter().map(|(period, phase, height)| height * (along * std::f64::consts::TAU / period + phase).sin()).sum();
            *pixel = Vec3b::from([1.02, 0.98, 1.0].map(|tint: f64| ((CURTAIN_LEVEL + fold) * tint).clamp(0.0, 255.0) as u8));
        }
    }
    Ok(())
}

fn paint_chess(board: &mut Mat, side: i32, random: &mut Pcg64Mcg) -> opencv::Result<()> {
    let square = 34;
    for row in 0..side / square + 1 {
        for column in 0..side / square + 1 {
            let level = if (row + column) % 2 == 0 { 205.0 } else { 48.0 } + random.random_range(-5.0..5.0);
            fill(board, Rect::new(column * square, row * square, square, square), bgr(level, [0.95, 0.98, 1.0]))?;
        }
    }
    Ok(())
}

fn paint_wood(board: &mut Mat, side: i32, random: &mut Pcg64Mcg) -> opencv::Result<()> {
    let mut y = 0;
    while y < side {
        let height = random.random_range(36..70);
        let level = random.random_range(120.0..170.0);
        fill(board, Rect::new(0, y, side, height), bgr(level, [0.55, 0.78, 1.0]))?;
        for _ in 0..14 {
            let at = y + random.random_range(0..height);
            let shade = bgr(level * random.random_range(0.75..1.1), [0.53, 0.77, 1.0]);
            let slope = random.random_range(-3..4);
            imgproc::line(board, Point::new(0, at), Point::new(side, at + slope), shade, 1, imgproc::LINE_AA, 0)?;
        }
        imgproc::line(board, Point::new(0, y), Point::new(side, y), bgr(60.0, [0.5, 0.8, 1.0]), 2, imgproc::LINE_AA, 0)?;
        y += height;
    }
    Ok(())
}

fn paint_clutter(board: &mut Mat, side: i32, random: &mut Pcg64Mcg) -> opencv::Result<()> {
    for _ in 0..90 {
        let size = Size::new(random.random_range(20..150), random.random_range(20..110));
        let corner = Point::new(random.random_range(-40..side), random.random_range(-40..side));
        let tint = [random.random_range(0.6..1.0), random.random_range(0.6..1.0), random.random_range(0.6..1.0)];
        fill(board, Rect::from_point_size(corner, size), bgr(random.random_range(30.0..225.0), tint))?;
    }
    for _ in 0..25 {
        let mut end = || Point::new(random.random_range(0..side), random.random_range(0..side));
        let (from, to) = (end(), end());
        let colour = bgr(random.random_range(10.0..230.0), [1.0, 1.0, 1.0]);
        imgproc::line(board, from, to, colour, random.random_range(1..4), imgproc::LINE_AA, 0)?;
    }
    Ok(())
}
