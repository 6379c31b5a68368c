//! The camera's sensor: exposure, vignette and noise.
//!
//! Called by the renderer, on its thread. Allocates when it is set up; failures are OpenCV's.

use opencv::core::Mat;
use opencv::prelude::*;
use rand::RngExt;
use rand_pcg::Pcg64Mcg;

use super::view::View;

/// Places in the table of noise at which a frame may begin: so many that frames do not repeat visibly.
const NOISE_OFFSETS: usize = 65_536;

/// The sensor of one camera.
pub struct Sensor {
    /// Noise in grey levels: for every byte of a frame, and [`NOISE_OFFSETS`] more.
    noise: Vec<i8>,
    /// Factor of each byte of the picture; 256 is 1.
    vignette: Vec<u16>,
    /// Present deviation of the exposure, as a share of the light.
    exposure: f64,
}

impl Sensor {
    /// The sensor of `view`; `random` draws its noise.
    pub fn new(view: &View, random: &mut Pcg64Mcg) -> Self {
        let (width, height) = (view.width_px as usize, view.height_px as usize);
        let pixels = width * height;
        // The sum of four bytes is near enough to a normal distribution, and has no outliers beyond 3.5 sigma.
        let noise = (0..pixels * 3 + NOISE_OFFSETS)
            .map(|_| {
                let sum: f64 = random.random::<[u8; 4]>().into_iter().map(|b| f64::from(b) - 127.5).sum();
                (sum / 147.8 * view.noise).round().clamp(-127.0, 127.0) as i8
            })
            .collect();
        let vignette = (0..pixels)
            .map(|i| {
                let (x, y) = ((i % width) as f64 / f64::from(view.width_px) - 0.5, (i / width) as f64 / f64::from(view.height_px) - 0.5);
                (256.0 * (1.0 - 0.45 * (x * x + y * y))) as u16
            })
            .flat_map(|v| [v; 3])
            .collect();
        Self { noise, vignette, exposure: 0.0 }
    }

    /// Lets the exposure wander on by one frame.
    pub fn drift(&mut self, view: &View, random: &mut Pcg64Mcg) {
        let wander = random.random_range(-1.7..1.7);
        self.exposure = self.exposure * 0.97 + 0.24 * wander * view.exposure_drift;
    }

    /// Writes to `out` what the sensor makes of `frame`.
    pub fn expose(&self, view: &View, frame: &Mat, random: &mut Pcg64Mcg, out: &mut [u8]) -> opencv::Result<()> {
        let offset: usize = random.random_range(0..NOISE_OFFSETS);
        let gain = (view.light * (1.0 + self.exposure) * 64.0).clamp(0.0, 127.0) as u16;
        let (pixels, noise) = (frame.data_bytes()?, &self.noise[offset..]);
        // This touches every byte of every frame. The arithmetic cannot overflow here; it is allowed to wrap only so that it can be
        // vectorised although overflow checks are on.
        for (((out, pixel), noise), vignette) in out.iter_mut().zip(pixels).zip(noise).zip(&self.vignette) {
            // A factor of 128 stands for 1. It is at most 255, so that the product fits 16 bits.
            let factor = (gain.wrapping_mul(*vignette) >> 7).min(255);
            let level = u16::from(*pixel).wrapping_mul(factor) >> 7;
            *out = (level as i16).wrapping_add(i16::from(*noise)).clamp(0, 255) as u8;
        }
        Ok(())
    }
}
