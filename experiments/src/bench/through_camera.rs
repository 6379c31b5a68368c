//! Simulator b through a rendered camera: each frame of a pour is drawn, and V_e is what the feature worker's own extraction finds in the
//! picture, its doubts included.
//!
//! Any thread; the same seeds give the same pour. Allocates when a pour begins. A frame that cannot be drawn or measured counts as lost
//! (NaN).

use std::sync::{Arc, Mutex, PoisonError};

use feature_worker::vision::{Extractor, Image};
use rand::seq::IndexedRandom;
use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use shared::config::ImageConfig;
use shared::messages::PixelFormat;

use simulator::camera::{Background, Renderer, Scene, View};
use simulator::physics::RATE_HZ;
use simulator::physics::rig::RigPour;

use crate::camera_setup::{camera_config, image_config, learn_colour};

/// Frames for which the camera has watched the upright vessel before a pour: a worker runs long before it, and has learned the ground. Chosen by
/// hand: a second and a half.
const WATCHED_FRAMES: usize = 45;
/// Colours of the liquids, as blue, green, red: such as food dyes give.
const LIQUIDS_BGR: [[u8; 3]; 4] = [[150, 62, 20], [40, 36, 180], [60, 150, 40], [140, 40, 110]];

/// A camera before a rig, set up by a careful person: its view, and the feature worker's configuration for it.
#[derive(Debug, Clone)]
pub struct BenchCamera {
    view: View,
    image: ImageConfig,
}

impl BenchCamera {
    /// A camera whose scale, lip, spout, background, light, noise and blur are drawn from `seed`; the liquid's colour is learned from one
    /// pour. With `clear` it is clear water instead.
    ///
    /// # Errors
    /// One line, when the liquid's colour cannot be learned.
    pub fn seeded(seed: u64, clear: bool) -> Result<Self, String> {
        let mut random = Pcg64Mcg::seed_from_u64(seed ^ 0xe7e);
        let colour = *LIQUIDS_BGR.choose(&mut random).unwrap_or(&LIQUIDS_BGR[0]);
        let placed = View::placed(&mut random);
        let view = View {
            liquid_bgr: (!clear).then_some(colour),
            background: *Background::ALL.choose(&mut random).unwrap_or(&Background::Chess),
            light: random.random_range(0.7..1.2),
            noise: random.random_range(1.5..5.0),
            blur_px: random.random_range(0.0..1.0),
            ..placed
        };
        let mut image = image_config(&view);
        if !clear {
            image.colour_hsv = learn_colour(&View { light: 1.0, ..view.clone() }, &image, seed).map_err(|e| e.to_string())?;
        }
        Ok(Self { view, image })
    }
}

/// The renderer, the extraction, and the picture that goes from one to the other.
struct Camera {
    renderer: Renderer,
    extractor: Extractor,
    pixels: Vec<u8>,
}

/// A pour on a rig whose V_e is measured in rendered pictures.
#[derive(Clone)]
pub struct CameraPour {
    /// The physics of the pour.
    pub pour: RigPour,
    /// None when OpenCV refused; then every frame is lost.
    camera: Option<Arc<Mutex<Camera>>>,
    size_px: (u32, u32),
    /// The newest scenes, as a ring; the camera is late.
    scenes: Vec<Scene>,
    delay_frames: usize,
    frame: usize,
    /// Confidence of the newest area.
    confidence: f32,
}

impl std::fmt::Debug for CameraPour {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("CameraPour").field("pour", &self.pour).field("frame", &self.frame).finish_non_exhaustive()
    }
}

impl CameraPour {
    /// Looks at `pour` with `camera`; a picture shows what was `delay_frames` ago.
    pub fn new(pour: RigPour, camera: &BenchCamera, delay_frames: usize, seed: u64) -> Self {
        let size_px = (camera.view.width_px, camera.view.height_px);
        let camera = Renderer::new(&camera.view, seed).ok().zip(Extractor::new(&camera_config(&camera.view), &camera.image).ok()).map(
            |(renderer, extractor)| {
                Arc::new(Mutex::new(Camera { renderer, extractor, pixels: vec![0; (size_px.0 * size_px.1 * 3) as usize] }))
            },
        );
        let upright = Scene::of(pour.container(), 0.0, pour.tilt_deg(), 0.0);
        for (k, camera) in (0..WATCHED_FRAMES).filter_map(|k| camera.as_ref().map(|camera| (k, camera))) {
            look(camera, &Scene { at_s: k as f64 / RATE_HZ, ..upright }, size_px);
        }
        Self { pour, camera, size_px, scenes: vec![upright; delay_frames + 1], delay_frames, frame: WATCHED_FRAMES, confidence: 1.0 }
    }

    /// Lets one frame pass with `alpha_deg` commanded. Returns V_e of its picture in px^2, or NaN.
    pub fn frame(&mut self, alpha_deg: f64) -> f32 {
        let before_deg = self.pour.tilt_deg();
        self.pour.advance(alpha_deg);
        let (tilt_deg, slots) = (self.pour.tilt_deg(), self.scenes.len());
        self.scenes[self.frame % slots] = Scene::of(self.pour.container(), 0.0, tilt_deg, (tilt_deg - before_deg) * RATE_HZ);
        let shown = Scene { at_s: self.frame as f64 / RATE_HZ, ..self.scenes[self.frame.saturating_sub(self.delay_frames) % slots] };
        self.frame += 1;
        let seen = self.camera.as_ref().and_then(|camera| look(camera, &shown, self.size_px));
        let (area_px2, confidence) = seen.unwrap_or((f32::NAN, 0.0));
        self.confidence = confidence;
        area_px2
    }

    /// The confidence of the newest area, 0 to 1.
    pub fn confidence(&self) -> f32 {
        self.confidence
    }
}

/// V_e of the picture of `scene` with its confidence, if it can be used.
fn look(camera: &Mutex<Camera>, scene: &Scene, (width_px, height_px): (u32, u32)) -> Option<(f32, f32)> {
    let mut camera = camera.lock().unwrap_or_else(PoisonError::into_inner);
    let Camera { renderer, extractor, pixels } = &mut *camera;
    renderer.render(scene, pixels).ok()?;
    let measured = extractor.measure(Image { width_px, height_px, format: PixelFormat::Bgr8, pixels }).ok()?;
    measured.is_usable().then_some((measured.area_px2, measured.confidence))
}
