//! Sets up the feature worker for a rendered camera, as a careful person would.
//!
//! Any thread; allocates. The same arguments give the same settings.

use feature_worker::vision::{Axes, ColourLearner};
use opencv::core::{Mat, Vec3b};
use shared::config::{CameraConfig, ImageConfig, LiquidMethod};
use simulator::camera::{Renderer, Scene, View};

/// Why a liquid's colour could not be learned, or a picture could not be drawn or measured.
pub type CameraError = Box<dyn std::error::Error>;

/// Pictures from which a liquid's colour is learned: one pour, two seconds long.
const COLOUR_PICTURES: u32 = 16;

/// The `[camera]` table for a view.
pub fn camera_config(view: &View) -> CameraConfig {
    CameraConfig { width_px: view.width_px, height_px: view.height_px, ..CameraConfig::default() }
}

/// The `[image]` table that a careful person would write for a view: the axes as they are, and the region over the mouth.
pub fn image_config(view: &View) -> ImageConfig {
    let (width, height) = (f64::from(view.width_px), f64::from(view.height_px));
    let [x, y] = view.lip_px;
    let (sin, cos) = view.roll_deg.to_radians().sin_cos();
    let at = |u: f64, w: f64| [(x + u * cos + w * sin) as f32, (y + u * sin - w * cos) as f32];
    let ([x0, y0], [x1, y1], [x2, y2]) = (at(0.0, 0.0), at(200.0, 0.0), at(0.0, -150.0));
    let (left, top) = ((x - 45.0).max(0.0), (y - 236.0).max(0.0));
    let (right, bottom) = ((x + 375.0).min(width), (y + 60.0).min(height));
    ImageConfig {
        method: if view.liquid_bgr.is_some() { LiquidMethod::Colour } else { LiquidMethod::Clear },
        region_px: [left as u32, top as u32, (right - left) as u32, (bottom - top) as u32],
        x_axis_px: [x0, y0, x1, y1],
        y_axis_px: [x2, y2, x0, y0],
        colour_hsv: [0, 0, 0, 179, 255, 255],
        area_min_px2: 30.0,
    }
}

/// Learns the liquid's colour from one rendered pour, as `feature-worker calibrate` does. Returns the range for `colour_hsv`.
///
/// # Errors
/// When a picture cannot be drawn, or no colour can be told from it.
pub fn learn_colour(view: &View, image: &ImageConfig, seed: u64) -> Result<[u8; 6], CameraError> {
    let mut renderer = Renderer::new(view, seed)?;
    let mut learner = ColourLearner::new(Axes::new(image));
    let mut pixels = vec![0; (view.width_px * view.height_px * 3) as usize];
    for i in 0..COLOUR_PICTURES {
        let t = f64::from(i) / f64::from(COLOUR_PICTURES);
        let flow_ml_s = 14.0 * (std::f64::consts::PI * t).sin() - 2.0;
        renderer.render(&Scene { at_s: 2.0 * t, alpha_deg: 35.0 + 50.0 * t, rate_deg_s: 20.0, flow_ml_s, level_mm: -4.0 }, &mut pixels)?;
        learner.add(&Mat::new_rows_cols_with_bytes::<Vec3b>(view.height_px as i32, view.width_px as i32, &pixels)?)?;
    }
    Ok(learner.range()?)
}
