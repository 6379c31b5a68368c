//! Measures the feature extraction against rendered truth.

use std::process::ExitCode;

use feature_worker::extract::{Extractor, Image};
use shared::config::{CameraConfig, CameraSource, ImageConfig, LiquidMethod};
use shared::messages::PixelFormat;

use crate::camera::{Renderer, Scene, View};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
pub struct Args {}

/// Runs the command; the exit codes are those of [`shared::exit`].
pub fn run(_args: &Args) -> ExitCode {
    let view = View::default();
    let camera = CameraConfig { source: CameraSource::SharedMemory, path: String::new(), width_px: 640, height_px: 480, fps: 30.0 };
    let image = ImageConfig {
        method: LiquidMethod::Colour,
        region_px: [190, 16, 420, 256],
        x_axis_px: [215.0, 250.0, 600.0, 250.0],
        y_axis_px: [215.0, 470.0, 215.0, 250.0],
        colour_hsv: [98, 90, 25, 124, 255, 255],
        area_min_px2: 30.0,
    };
    let mut renderer = Renderer::new(&view, 1).unwrap();
    let mut out = vec![0u8; 640 * 480 * 3];
    for alpha in [25.0, 45.0, 60.0, 75.0, 90.0, 105.0] {
        let mut extractor = Extractor::new(&camera, &image).unwrap();
        for flow in [0.0, 0.3, 1.0, 3.0, 10.0, 20.0, 40.0] {
            let (mut errors, mut stages, mut conf, mut draw) = (vec![], Default::default(), 0.0, std::time::Duration::default());
            for k in 0..20 {
                let t = std::time::Instant::now();
                let truth = renderer
                    .render(
                        &Scene { at_s: f64::from(k) / 30.0, alpha_deg: alpha, rate_deg_s: 3.0, flow_ml_s: flow, level_mm: -2.0 },
                        &mut out,
                    )
                    .unwrap();
                draw = t.elapsed();
                let m = extractor.measure(Image { width_px: 640, height_px: 480, format: PixelFormat::Bgr8, pixels: &out }).unwrap();
                stages = extractor.stages();
                conf = m.confidence;
                errors.push(if truth.area_px2 > 0.0 {
                    100.0 * (f64::from(m.area_px2) / truth.area_px2 - 1.0)
                } else {
                    f64::from(m.area_px2)
                });
            }
            errors.sort_by(f64::total_cmp);
            println!("{alpha} {flow}: median {:.2} {:.2}..{:.2} conf {conf:.2} {stages:?} {draw:?}", errors[10], errors[0], errors[19]);
        }
    }
    ExitCode::SUCCESS
}
