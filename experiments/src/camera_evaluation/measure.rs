//! Renders scenes and measures them, frame by frame. Any thread; allocates for each run of scenes.

use feature_worker::vision::{Extractor, Image, Measurement};
use rand::SeedableRng;
use rand_pcg::Pcg64Mcg;
use shared::config::ImageConfig;
use shared::messages::PixelFormat;
use simulator::camera::{Renderer, Scene, Truth, View};

use super::figures::{CameraFigures, Comparison, figures};
use super::scenes::whole_pours;
use crate::camera_setup::{CameraError, camera_config, image_config};

/// A rendered frame, what was measured in it, and the truth.
pub struct MeasuredFrame<'a> {
    /// Its number in the run.
    pub number: usize,
    /// Its pixels, BGR.
    pub pixels: &'a [u8],
    /// The extraction that measured it.
    pub extractor: &'a Extractor,
    /// What it measured.
    pub measured: &'a Measurement,
    /// What was drawn.
    pub truth: &'a Truth,
}

impl MeasuredFrame<'_> {
    /// Measurement beside truth.
    pub fn comparison(&self) -> Comparison {
        Comparison::new(self.number, self.truth.area_px2, self.measured)
    }
}

/// Renders and measures `scenes` one after the other, and calls `done` for each.
///
/// # Errors
/// When a frame cannot be drawn or measured, or `done` fails.
pub fn measure(
    view: &View,
    image: &ImageConfig,
    seed: u64,
    scenes: &[Scene],
    mut done: impl FnMut(&MeasuredFrame) -> Result<(), CameraError>,
) -> Result<(), CameraError> {
    let mut renderer = Renderer::new(view, seed)?;
    let mut extractor = Extractor::new(&camera_config(view), image)?;
    let mut pixels = vec![0; (view.width_px * view.height_px * 3) as usize];
    for (number, scene) in scenes.iter().enumerate() {
        let truth = renderer.render(scene, &mut pixels)?;
        let picture = Image { width_px: view.width_px, height_px: view.height_px, format: PixelFormat::Bgr8, pixels: &pixels };
        let measured = extractor.measure(picture)?;
        done(&MeasuredFrame { number, pixels: &pixels, extractor: &extractor, measured: &measured, truth: &truth })?;
    }
    Ok(())
}

/// Figures of `pours` whole pours in a row before one camera; `seed` draws the pours.
///
/// # Errors
/// When a frame cannot be drawn or measured.
pub fn measure_pours(view: &View, seed: u64, pours: usize) -> Result<CameraFigures, CameraError> {
    let mut frames = Vec::new();
    let scenes = whole_pours(&mut Pcg64Mcg::seed_from_u64(seed), seed, pours);
    measure(view, &image_config(view), seed, &scenes, |frame| {
        frames.push(frame.comparison());
        Ok(())
    })?;
    Ok(figures(&frames))
}
