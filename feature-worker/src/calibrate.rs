//! Finds the container's axes and the liquid's colour; writes the [image] section.

use std::process::ExitCode;

use opencv::core::{self, Mat};
use opencv::imgproc;
use opencv::prelude::*;

use crate::extract::Axes;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
pub struct Args {}

/// Runs the command; the exit codes are those of [`shared::exit`].
pub fn run(_args: &Args) -> ExitCode {
    shared::exit::fail(shared::exit::FAILED, "not built yet")
}

/// Why a calibration fails.
#[derive(Debug, thiserror::Error)]
pub enum CalibrateError {
    /// No colour stands out at the lip.
    #[error("no liquid's colour stands out at the lip: show one whole pour, check the axes, or use method = \"clear\" for water")]
    NoColour,
    /// OpenCV refused.
    #[error("OpenCV: {0}")]
    OpenCv(#[from] opencv::Error),
}

/// Hue, saturation and value bins of the first look.
const BINS: [usize; 3] = [18, 8, 8];

/// Learns the liquid's colour from the frames of one pour: what is often right over the lip and seldom far from it.
///
/// The background turns behind the container, so what belongs to it is seen in both places; only the liquid stays at the lip.
pub struct ColourLearner {
    axes: Axes,
    near: Vec<[u8; 3]>,
    near_bins: Vec<u32>,
    far_bins: Vec<u32>,
    far: Vec<[u8; 3]>,
    hsv: Mat,
}

impl ColourLearner {
    /// Most pixels that are kept.
    const KEEP: usize = 400_000;

    /// A learner for a container with these axes.
    pub fn new(axes: Axes) -> Self {
        let bins = BINS.iter().product();
        Self { axes, near: Vec::new(), near_bins: vec![0; bins], far_bins: vec![0; bins], far: Vec::new(), hsv: Mat::default() }
    }

    fn bin([h, s, v]: [u8; 3]) -> usize {
        let bin = |value: u8, most: usize, bins: usize| usize::from(value) * bins / most;
        (bin(h, 180, BINS[0]) * BINS[1] + bin(s, 256, BINS[1])) * BINS[2] + bin(v, 256, BINS[2])
    }

    /// Adds one BGR frame of the pour, dry ones included.
    pub fn add(&mut self, bgr: &impl core::ToInputArray) -> Result<(), CalibrateError> {
        imgproc::cvt_color_def(bgr, &mut self.hsv, imgproc::COLOR_BGR2HSV)?;
        let (rows, columns) = (self.hsv.rows(), self.hsv.cols());
        let pixels = self.hsv.data_typed::<core::Vec3b>()?;
        let scale = columns as f32 / 640.0;
        let [lip_x, lip_y] = self.axes.lip_px;
        let reach = 220.0 * scale;
        for y in ((lip_y - reach).max(0.0) as i32)..((lip_y + reach) as i32).min(rows) {
            for x in ((lip_x - reach).max(0.0) as i32)..((lip_x + reach) as i32).min(columns) {
                let at = [x as f32, y as f32];
                let distance = (at[0] - lip_x).hypot(at[1] - lip_y);
                let (near, far) = (distance < 16.0 * scale, distance > 110.0 * scale && (x + y) % 5 == 0);
                if !(near || far) || self.axes.between(at) < 1.5 {
                    continue;
                }
                let hsv = pixels[(y * columns + x) as usize].0;
                if far {
                    if self.far.len() < Self::KEEP {
                        self.far_bins[Self::bin(hsv)] += 1;
                        self.far.push(hsv);
                    }
                } else if self.near.len() < Self::KEEP {
                    self.near_bins[Self::bin(hsv)] += 1;
                    self.near.push(hsv);
                }
            }
        }
        Ok(())
    }

    /// The range h_min, s_min, v_min, h_max, s_max, v_max for `[image] colour_hsv`.
    pub fn range(&self) -> Result<[u8; 6], CalibrateError> {
        let (near, far) = (self.near.len().max(1) as f32, self.far.len().max(1) as f32);
        let liquid = |hsv: &[u8; 3]| {
            let bin = Self::bin(*hsv);
            let (n, f) = (self.near_bins[bin] as f32 / near, self.far_bins[bin] as f32 / far);
            n > 0.004 && n > 4.0 * f
        };
        let seen: Vec<[u8; 3]> = self.near.iter().filter(|p| liquid(p)).copied().collect();
        if (seen.len() as f32) < 0.1 * near {
            return Err(CalibrateError::NoColour);
        }
        // Hue is an angle: everything about it relative to its mean direction.
        let (mut sin, mut cos) = (0.0f32, 0.0f32);
        for [h, s, _] in &seen {
            let (a, b) = (f32::from(*h) * std::f32::consts::TAU / 180.0).sin_cos();
            (sin, cos) = (sin + a * f32::from(*s), cos + b * f32::from(*s));
        }
        let mean = sin.atan2(cos) * 180.0 / std::f32::consts::TAU;
        let quantiles = |value: &dyn Fn(&[u8; 3]) -> f32| {
            let mut values: Vec<f32> = seen.iter().map(value).collect();
            values.sort_by(f32::total_cmp);
            let at = |share: f32| values[((values.len() - 1) as f32 * share) as usize];
            (at(0.02), at(0.5), at(0.98))
        };
        let (h_low, _, h_high) = quantiles(&|p| (f32::from(p[0]) - mean + 270.0).rem_euclid(180.0) - 90.0);
        let (s_low, s_mid, s_high) = quantiles(&|p| p[1].into());
        let (v_low, _, v_high) = quantiles(&|p| p[2].into());
        let byte = |v: f32| v.round().clamp(0.0, 255.0) as u8;
        if s_mid < 45.0 || h_high - h_low > 80.0 {
            // Grey liquids (milk, cola in shadow) have no hue.
            return Ok([0, byte(s_low - 30.0), byte(v_low - 30.0), 179, byte(s_high + 30.0), byte(v_high + 30.0)]);
        }
        // Shadow and exposure move value most and saturation more than hue. Where background of like colour comes nearer than
        // these margins, the limit is half way between the two.
        let relative_hue = |p: &[u8; 3]| (f32::from(p[0]) - mean + 270.0).rem_euclid(180.0) - 90.0;
        let between = |loose: f32, liquid: f32, alike: &dyn Fn(&[u8; 3]) -> Option<f32>| {
            let mut values: Vec<f32> =
                self.far.iter().filter_map(alike).filter(|v| (v - loose).signum() != (v - liquid).signum()).collect();
            values.extend(self.far.iter().filter_map(alike).filter(|v| (loose < liquid) == (*v < loose)).map(|_| loose));
            if (values.len() as f32) < 0.002 * far {
                return loose;
            }
            // The most liquid-like 2 % of it are noise.
            values.sort_by(|a, b| if loose < liquid { b.total_cmp(a) } else { a.total_cmp(b) });
            let nearest = values[values.len() / 50];
            if (nearest - loose).signum() == (nearest - liquid).signum() { loose } else { (nearest + liquid) / 2.0 }
        };
        let v_min = v_low * 0.3 - 5.0;
        let v_max = if v_high > 150.0 { 255.0 } else { v_high * 1.7 + 10.0 };
        let near_hue = |p: &[u8; 3]| (h_low - 12.0..=h_high + 12.0).contains(&relative_hue(p));
        let s_min = between(s_low * 0.75 - 10.0, s_low, &|p| near_hue(p).then_some(f32::from(p[1])));
        let alike = |p: &[u8; 3]| (f32::from(p[1]) >= s_min).then(|| relative_hue(p)).filter(|h| h.abs() < 40.0);
        let h_min = between(h_low - 6.0, h_low, &|p| alike(p).filter(|h| *h < 0.0));
        let h_max = between(h_high + 6.0, h_high, &|p| alike(p).filter(|h| *h > 0.0));
        let hue = |v: f32| (mean + v).rem_euclid(180.0).round().min(179.0) as u8;
        Ok([hue(h_min), byte(s_min), byte(v_min), hue(h_max), 255, byte(v_max)])
    }
}
