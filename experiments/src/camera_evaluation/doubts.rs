//! Frames that should not be trusted, and whether a doubt about them is raised. Any thread; allocates.

use std::collections::BTreeMap;

use feature_worker::vision::{Extractor, Image};
use shared::config::ImageConfig;
use shared::messages::{Doubt, PixelFormat};
use simulator::camera::{Background, Renderer, Scene, View};

use super::measure::measure;
use crate::camera_setup::{CameraError, camera_config, image_config, learn_colour};

/// Frames for each doubt: one second.
const FRAMES: u32 = 30;

/// What should raise a doubt.
struct Bad {
    doubt: Doubt,
    view: View,
    flow_ml_s: f64,
    /// Whether the region is so small that the stream leaves it.
    cut_short: bool,
}

/// For each doubt, by its text, the share of the frames deserving it on which it was raised, per cent.
///
/// # Errors
/// When a frame cannot be drawn or measured.
pub fn raised_percent(seed: u64) -> Result<BTreeMap<&'static str, f64>, CameraError> {
    let base = View::default();
    let pale = View { light: 1.98, background: Background::Plain, liquid_bgr: Some([250, 240, 180]), ..base.clone() };
    let bad = [
        Bad { doubt: Doubt::TooDark, view: View { light: 0.06, ..base.clone() }, flow_ml_s: 8.0, cut_short: false },
        Bad { doubt: Doubt::BlownOut, view: pale, flow_ml_s: 8.0, cut_short: false },
        Bad { doubt: Doubt::Blurred, view: View { blur_px: 4.5, ..base.clone() }, flow_ml_s: 12.0, cut_short: false },
        Bad { doubt: Doubt::LeavesRegion, view: base.clone(), flow_ml_s: 12.0, cut_short: true },
    ];
    let image = ImageConfig { colour_hsv: learn_colour(&base, &image_config(&base), seed)?, ..image_config(&base) };
    let mut raised = BTreeMap::new();
    for case in &bad {
        raised.insert(case.doubt.words(), percent(raised_by(case, &image, seed)?));
    }
    raised.insert(Doubt::Frozen.words(), percent(raised_by_repetition(&base, &image, seed)?));
    Ok(raised)
}

fn percent(frames: u32) -> f64 {
    f64::from(frames) / (f64::from(FRAMES) / 100.0)
}

/// The number of frames on which the doubt was raised.
fn raised_by(bad: &Bad, image: &ImageConfig, seed: u64) -> Result<u32, CameraError> {
    let mut image = image.clone();
    if bad.cut_short {
        let [x, y] = bad.view.lip_px.map(|v| v as u32);
        image.region_px = [x - 20, y - 50, 120, 60];
    }
    let scenes: Vec<Scene> = (0..FRAMES)
        .map(f64::from)
        .map(|i| Scene { at_s: i / 30.0, alpha_deg: 40.0 + i, rate_deg_s: 30.0, flow_ml_s: bad.flow_ml_s, level_mm: 0.0 })
        .collect();
    let mut hits = 0;
    measure(&bad.view, &image, seed, &scenes, |frame| {
        hits += u32::from(frame.measured.doubt == bad.doubt);
        Ok(())
    })?;
    Ok(hits)
}

/// The number of frames on which `frozen` was raised at the second look at the same picture.
fn raised_by_repetition(view: &View, image: &ImageConfig, seed: u64) -> Result<u32, CameraError> {
    let mut renderer = Renderer::new(view, seed)?;
    let mut extractor = Extractor::new(&camera_config(view), image)?;
    let mut pixels = vec![0; (view.width_px * view.height_px * 3) as usize];
    let mut hits = 0;
    for i in 0..FRAMES {
        let scene = Scene { at_s: f64::from(i) / 30.0, alpha_deg: 60.0, flow_ml_s: f64::from(i % 10), ..Scene::default() };
        renderer.render(&scene, &mut pixels)?;
        let picture = Image { width_px: view.width_px, height_px: view.height_px, format: PixelFormat::Bgr8, pixels: &pixels };
        extractor.measure(picture)?;
        hits += u32::from(extractor.measure(picture)?.doubt == Doubt::Frozen);
    }
    Ok(hits)
}
