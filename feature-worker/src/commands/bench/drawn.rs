//! Pictures for `bench` when the user gives none: a turning chess board or a grey card, a blue or a clear stream of changing size over the lip, and noise.
//! Runs on the calling thread, allocates, and draws the same pictures at each call. The only failures are OpenCV's.

use opencv::core::{self, CV_8UC3, Mat, Point, Point2f, Scalar, Size, Vector};
use opencv::imgproc;
use shared::config::{CameraConfig, ImageConfig, LiquidMethod};

/// Number of different pictures, which are measured again and again. Chosen by hand; no measurement is recorded.
pub const PICTURES: usize = 40;
/// So many of them show no stream where the water is clear. Chosen by hand: a third of a second.
const DRY_PICTURES: usize = 10;

/// The camera and the image section that belong to the drawn pictures, at `scale` times 640 pixels of width.
pub fn config(scale: f32, method: LiquidMethod) -> (CameraConfig, ImageConfig) {
    let px = |v: f32| (v * scale).round() as u32;
    let height = if scale > 1.0 { 720 } else { 480 };
    let camera = CameraConfig { width_px: px(640.0), height_px: height, ..CameraConfig::default() };
    let axis = |a: [f32; 4]| a.map(|v| v * scale);
    let image = ImageConfig {
        method,
        region_px: [px(175.0), px(14.0), px(420.0), px(286.0)],
        x_axis_px: axis([215.0, 250.0, 600.0, 250.0]),
        y_axis_px: axis([215.0, 350.0, 215.0, 250.0]),
        colour_hsv: [98, 90, 25, 124, 255, 255],
        area_min_px2: 30.0,
    };
    (camera, image)
}

/// What stands behind the lip.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Ground {
    /// A grey card.
    Card,
    /// A chess board, which turns.
    Board,
}

/// The pictures, BGR, of the camera's size. The first ones of clear water show it at rest, because what it flows before has to be seen first.
pub fn pictures(camera: &CameraConfig, image: &ImageConfig, ground: Ground) -> Result<Vec<Mat>, opencv::Error> {
    let (width, height) = (camera.width_px as i32, camera.height_px as i32);
    let mut behind = Mat::new_rows_cols_with_default(2 * height, 2 * width, CV_8UC3, Scalar::all(200.0))?;
    if ground == Ground::Board {
        for row in 0..40 {
            for column in (row % 2..40).step_by(2) {
                let square = core::Rect::new(column * 60, row * 60, 60, 60);
                imgproc::rectangle(&mut behind, square, Scalar::all(50.0), imgproc::FILLED, imgproc::LINE_8, 0)?;
            }
        }
    }
    let clear = image.method == LiquidMethod::Clear;
    let [x, y] = [image.x_axis_px[0], image.x_axis_px[1]];
    let scale = camera.width_px as f32 / 640.0;
    core::set_rng_seed(1)?;
    let mut frames = Vec::new();
    for i in 0..PICTURES {
        let turn = imgproc::get_rotation_matrix_2d(Point2f::new(width as f32, height as f32), f64::from(i as u32), 1.0)?;
        let mut frame = Mat::default();
        imgproc::warp_affine(&behind, &mut frame, &turn, Size::new(width, height), imgproc::INTER_LINEAR, 0, Scalar::default())?;
        let size = scale * (20.0 + 2.5 * i as f32);
        let corners = [(-0.1, 2.0), (-0.1, 0.2), (-3.0, -0.6), (-3.0, -0.9), (0.0, -0.9), (0.6, -0.5), (1.2, 0.0), (2.0, 2.0)];
        let stream: Vector<Point> = corners.iter().map(|(dx, dy)| Point::new((x + dx * size) as i32, (y + dy * size) as i32)).collect();
        if !clear {
            imgproc::fill_poly(&mut frame, &stream, Scalar::new(150.0, 62.0, 20.0, 0.0), imgproc::LINE_AA, 0, Point::default())?;
        } else if i >= DRY_PICTURES {
            // Water's outline is dark, because it shows another part of the room there.
            let wide = (4.0 * scale) as i32;
            imgproc::polylines(&mut frame, &stream, true, Scalar::all(90.0), wide, imgproc::LINE_AA, 0)?;
        }
        let mut noise = Mat::new_rows_cols_with_default(height, width, CV_8UC3, Scalar::all(0.0))?;
        core::randn(&mut noise, &Scalar::all(8.0), &Scalar::all(3.0))?;
        let mut noisy = Mat::default();
        core::add(&frame, &noise, &mut noisy, &core::no_array(), -1)?;
        frames.push(noisy);
    }
    Ok(frames)
}
