//! The container's glass, drawn over everything that is inside it.
//!
//! The container never moves in the picture, so its glass is painted once. Called by the renderer, on its thread. Allocates when it is
//! painted; failures are OpenCV's.

use opencv::core::{CV_8UC3, Mat, Point, Scalar, Vector};
use opencv::imgproc;
use opencv::prelude::*;

use super::view::View;

/// What the glass does to each byte of the picture: a factor, for which 128 stands for 1, and a summand.
pub struct Glass {
    factor: Mat,
    light: Mat,
}

impl Glass {
    /// Paints the glass of `view`: its body, its side in profile, its rim, a streak of light, and its edges.
    pub fn new(view: &View) -> opencv::Result<Self> {
        let new = |value: f64| Mat::new_rows_cols_with_default(view.height_px as i32, view.width_px as i32, CV_8UC3, Scalar::all(value));
        let (mut factor, mut light) = (new(128.0)?, new(0.0)?);
        // In sixteenths of a pixel.
        let point = |at_mm: [f64; 2]| {
            let [x, y] = view.to_image(at_mm);
            Point::new((x * 16.0) as i32, (y * 16.0) as i32)
        };
        let (wall, far) = (1.6, 140.0);
        let shape = |corners: &[[f64; 2]]| -> Vector<Point> { corners.iter().map(|c| point(*c)).collect::<Vec<_>>().into() };
        let body = shape(&[[0.0, 0.0], [far, 0.0], [far, -far], [0.0, -far]]);
        let side = shape(&[[0.0, 0.0], [wall, 0.0], [wall, -far], [0.0, -far]]);
        let rim = shape(&[[0.0, 0.0], [far, 0.0], [far, -1.0], [0.0, -1.0]]);
        let streak = shape(&[[9.0, -6.0], [10.5, -6.0], [10.5, -far], [9.0, -far]]);
        for (polygon, passed, added) in [(&body, 116.0, 10.0), (&side, 84.0, 26.0), (&rim, 92.0, 48.0), (&streak, 116.0, 60.0)] {
            imgproc::fill_poly(&mut factor, polygon, Scalar::all(passed), imgproc::LINE_AA, 4, Point::default())?;
            imgproc::fill_poly(&mut light, polygon, Scalar::all(added), imgproc::LINE_AA, 4, Point::default())?;
        }
        for k in 0..view.glass_drops {
            // Spread evenly without a pattern: by the golden ratio and by its square.
            let spread = |by: f64| (f64::from(k + 1) * by).fract();
            let at_mm = [2.0 + 40.0 * spread(0.618_034), -2.0 - 45.0 * spread(0.754_878)];
            let radius = ((0.3 + 0.7 * spread(0.569_840)) * view.px_per_mm * 16.0) as i32;
            // A drop is a lens: dark at its border, and with a lamp's image near its top.
            imgproc::circle(&mut factor, point(at_mm), radius, Scalar::all(70.0), imgproc::FILLED, imgproc::LINE_AA, 4)?;
            imgproc::circle(&mut factor, point(at_mm), radius * 2 / 3, Scalar::all(124.0), imgproc::FILLED, imgproc::LINE_AA, 4)?;
            let lamp_mm = [at_mm[0], at_mm[1] + 0.02 * f64::from(radius) / view.px_per_mm];
            imgproc::circle(&mut light, point(lamp_mm), (radius / 4).max(8), Scalar::all(110.0), imgproc::FILLED, imgproc::LINE_AA, 4)?;
        }
        let edges = [([0.25, 0.0], [0.25, -far], 120.0), ([0.0, -0.3], [far, -0.3], 105.0), ([wall, -1.0], [wall, -far], 6.0)];
        for (from, to, added) in edges {
            imgproc::line(&mut light, point(from), point(to), Scalar::all(added), 1, imgproc::LINE_AA, 4)?;
        }
        Ok(Self { factor, light })
    }

    /// Lays the glass over `frame`.
    pub fn lay(&self, frame: &mut Mat) -> opencv::Result<()> {
        let (factors, lights) = (self.factor.data_bytes()?, self.light.data_bytes()?);
        // This touches every byte of every frame. The arithmetic cannot overflow here; it is allowed to wrap only so that it can be
        // vectorised although overflow checks are on.
        for ((pixel, factor), light) in frame.data_bytes_mut()?.iter_mut().zip(factors).zip(lights) {
            let through = u16::from(*pixel).wrapping_mul(u16::from(*factor)) >> 7;
            *pixel = through.wrapping_add(u16::from(*light)).min(255) as u8;
        }
        Ok(())
    }
}
