//! The eye at the depth `camera`: a frame of the simulated cell is drawn, and the worker's own extraction measures it.
//!
//! Any thread, one camera for each cell; allocates when it is made. A picture that cannot be drawn or measured is a frame without a measurement.
//! The processor time of both halves is counted for the whole process.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed};

use feature_worker::vision::{Extractor, Image};
use rustix::time::{ClockId, clock_gettime};
use shared::config::Config;
use shared::messages::{Doubt, PixelFormat};
use simulator::camera::faults::{CameraFault, FaultKind, FaultyCamera};
use simulator::camera::{Renderer, Scene, View};

/// How deep the eye is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Default, clap::ValueEnum)]
pub enum Depth {
    /// From the flow to the area, with the errors that vision makes.
    #[default]
    Area,
    /// Drawn frames, measured by the worker's own extraction.
    Camera,
}

/// Processor time that was spent in drawing and in measuring, ns.
static SPENT_NS: [AtomicU64; 2] = [AtomicU64::new(0), AtomicU64::new(0)];

/// What tables call a fault of the pictures.
pub fn picture_name(kind: FaultKind) -> &'static str {
    match kind {
        FaultKind::Banding => "picture-banding",
        FaultKind::WhiteBalance => "picture-white-balance",
        FaultKind::ExposureHunting => "picture-exposure-hunting",
        FaultKind::ExposureStep => "picture-exposure-step",
        FaultKind::GreyBelow => "picture-grey-below",
        FaultKind::GreenBelow => "picture-green-below",
        FaultKind::ShiftedBelow => "picture-shifted-below",
        FaultKind::Torn => "picture-torn",
        FaultKind::Repeated => "picture-repeated",
        FaultKind::Highlight => "picture-highlight",
        FaultKind::WarmLight => "picture-warm-light",
        FaultKind::SwappedColours => "picture-swapped-colours",
        FaultKind::Grey => "picture-grey",
        FaultKind::LimitedRange => "picture-limited-range",
    }
}

/// A camera and its worker's extraction.
pub struct Camera {
    renderer: Renderer,
    /// What is wrong with its pictures, and the number of the next one.
    faulty: Option<(FaultyCamera, u64)>,
    extractor: Extractor,
    size_px: [u32; 2],
    /// The newest picture.
    pixels: Vec<u8>,
    is_drawn: bool,
}

impl Camera {
    /// The camera of config/sim.toml before the usual view, with a fault of its pictures or without one.
    ///
    /// # Errors
    /// One line, when the view cannot be drawn or the region cannot be measured in.
    pub fn new(config: &Config, seed: u64, fault: Option<CameraFault>) -> Result<Self, String> {
        let view = View::default();
        let renderer = Renderer::new(&view, seed).map_err(|e| e.to_string())?;
        let extractor = Extractor::new(&config.camera, &config.image).map_err(|e| e.to_string())?;
        let pixels = vec![0; view.width_px as usize * view.height_px as usize * PixelFormat::Bgr8.bytes_per_pixel()];
        let size_px = [view.width_px, view.height_px];
        let faulty = fault.map(|fault| (FaultyCamera::new(fault, size_px.map(|px| px as usize), view.lip_px), 0));
        Ok(Self { renderer, faulty, extractor, size_px, pixels, is_drawn: false })
    }

    /// Draws `scene`, unless the picture stands still, and measures the picture: area, px^2, confidence and doubt. `None` if that cannot be done.
    pub fn look(&mut self, scene: &Scene, stands_still: bool) -> Option<(f32, f32, Doubt)> {
        let before_ns = processor_ns();
        if !(stands_still && self.is_drawn) {
            self.renderer.render(scene, &mut self.pixels).ok()?;
            if let Some((camera, number)) = &mut self.faulty {
                camera.pass(*number, &mut self.pixels);
                *number += 1;
            }
            self.is_drawn = true;
        }
        let drawn_ns = processor_ns();
        let [width_px, height_px] = self.size_px;
        let picture = Image { width_px, height_px, format: PixelFormat::Bgr8, pixels: &self.pixels };
        let measured = self.extractor.measure(picture).ok()?;
        SPENT_NS[0].fetch_add(drawn_ns - before_ns, Relaxed);
        SPENT_NS[1].fetch_add(processor_ns() - drawn_ns, Relaxed);
        Some((measured.area_px2, measured.confidence, measured.doubt))
    }
}

/// Processor time of this thread, ns.
fn processor_ns() -> u64 {
    let time = clock_gettime(ClockId::ThreadCPUTime);
    time.tv_sec as u64 * 1_000_000_000 + time.tv_nsec as u64
}

/// Processor time that this process has spent in drawing and in measuring, s.
pub fn spent_s() -> [f64; 2] {
    SPENT_NS.each_ref().map(|ns| ns.load(Relaxed) as f64 / 1e9)
}
