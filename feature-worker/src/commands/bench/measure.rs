//! Measures the time of each stage of the extraction.
//!
//! Runs on the calling thread. It allocates before it measures and not while it does. Its failures are the extraction's.

use std::time::Instant;

use opencv::core::Mat;
use opencv::prelude::*;
use serde::Serialize;
use shared::config::{CameraConfig, ImageConfig};
use shared::messages::PixelFormat;

use crate::vision::{Extractor, Image};

/// Percentiles of many measurements, us.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct Percentiles {
    /// The median.
    pub p50: f64,
    /// The 99th percentile.
    pub p99: f64,
    /// The longest.
    pub max: f64,
}

fn percentiles(mut ns: Vec<u64>) -> Percentiles {
    ns.sort_unstable();
    let at = |share: f64| ns.get((ns.len().saturating_sub(1) as f64 * share) as usize).map_or(0.0, |v| *v as f64 / 1e3);
    Percentiles { p50: at(0.5), p99: at(0.99), max: at(1.0) }
}

/// Times of one frame: of each of its four stages, and of all four together.
#[derive(Debug, Clone, Copy, Serialize)]
pub struct StageTimes {
    /// Reading the rays.
    pub rays: Percentiles,
    /// The checks of light, focus and motion.
    pub checks: Percentiles,
    /// Finding the liquid.
    pub segment: Percentiles,
    /// Finding the line of its edge.
    pub line: Percentiles,
    /// The whole measurement.
    pub total: Percentiles,
}

/// Measures `frames` again and again, `rounds` frames in all. They are BGR pictures of the camera's size.
pub fn measure(camera: &CameraConfig, image: &ImageConfig, frames: &[Mat], rounds: usize) -> Result<StageTimes, String> {
    let mut extractor = Extractor::new(camera, image).map_err(|e| e.to_string())?;
    let mut ns: [Vec<u64>; 5] = std::array::from_fn(|_| Vec::with_capacity(rounds));
    for i in 0..rounds + frames.len() {
        let Some(frame) = frames.get(i % frames.len().max(1)) else {
            return Err("there are no frames to measure; give another --input".into());
        };
        let pixels = frame.data_bytes().map_err(|e| e.message)?;
        let image = Image { width_px: camera.width_px, height_px: camera.height_px, format: PixelFormat::Bgr8, pixels };
        let start = Instant::now();
        extractor.measure(image).map_err(|e| e.to_string())?;
        let total = start.elapsed().as_nanos() as u64;
        // The first round only fills caches and buffers.
        if i >= frames.len() {
            let s = extractor.stages();
            for (list, value) in ns.iter_mut().zip([s.rays_ns, s.checks_ns, s.segment_ns, s.line_ns, total]) {
                list.push(value);
            }
        }
    }
    let [rays, checks, segment, line, total] = ns.map(percentiles);
    Ok(StageTimes { rays, checks, segment, line, total })
}
