//! The ground beside the container, on the far side of its left wall: what the background brings to the lip from there is known before it
//! comes.
//!
//! Called on the extraction thread. The pictures are kept, so nothing is allocated after the first frame but OpenCV's matrix headers. The
//! only failures are OpenCV's.

use opencv::boxed_ref::BoxedRef;
use opencv::core::{self, CV_16SC2, CV_32FC1, Mat, Scalar, Vec3b};
use opencv::imgproc;
use opencv::prelude::*;
use shared::config::ImageConfig;

use super::geometry::Axes;
use super::ground_colours::GroundColours;

/// Width of a region for which distances in it were chosen, px.
const REGION_PX: f32 = 420.0;
/// Samples of a side of the square beside the container in which the ground is learned. Chosen by hand, for speed.
const STRIP_SAMPLES: i32 = 16;
/// Where that square lies in a picture 640 px wide: from and to, px along the x-axis and along the y-axis. What the background brings to
/// the lip comes from there, or along the rays.
const STRIP_PX: [[f32; 2]; 2] = [[-34.0, -7.0], [-48.0, 10.0]];
/// Of this many samples of the square, the ground is learned from one a frame. Chosen by hand.
const STRIP_EVERY: usize = 4;
/// Side of the square of samples that are smoothed together, as along the rays. Chosen by hand.
const SMOOTH: i32 = 5;

/// Samples a square beside the container.
pub(super) struct GroundBeside {
    /// The two maps of the square; empty if it is not within the region.
    maps: [Mat; 2],
    /// The square in BGR.
    pixels: Mat,
    /// The same, smoothed.
    smooth: Mat,
}

impl GroundBeside {
    /// For the region and axes of a camera; `axes` are relative to the region.
    pub(super) fn new(axes: &Axes, image: &ImageConfig) -> opencv::Result<Self> {
        Ok(Self { maps: maps(axes, image)?, pixels: Mat::default(), smooth: Mat::default() })
    }

    /// Takes the next picture's square.
    pub(super) fn take(&mut self, region: &BoxedRef<Mat>) -> opencv::Result<()> {
        let [map_a, map_b] = &self.maps;
        if map_a.empty() {
            return Ok(());
        }
        imgproc::remap(region, &mut self.pixels, map_a, map_b, imgproc::INTER_NEAREST, core::BORDER_REPLICATE, Scalar::default())
    }

    /// Learns the ground's colours from beside the container: what comes to the lip from there is known before.
    pub(super) fn teach(&mut self, ground: &mut GroundColours, frame: usize) -> opencv::Result<()> {
        if self.pixels.empty() {
            return Ok(());
        }
        let size = core::Size::new(SMOOTH, SMOOTH);
        imgproc::blur(&self.pixels, &mut self.smooth, size, core::Point::new(-1, -1), core::BORDER_REPLICATE)?;
        let colours: &[Vec3b] = self.smooth.data_typed()?;
        for colour in colours.iter().skip(frame % STRIP_EVERY).step_by(STRIP_EVERY) {
            ground.learn(colour.0, false);
        }
        Ok(())
    }
}

/// The fixed-point maps from the square beside the container to the region, as `cv::convertMaps` makes them; empty if the region does not
/// hold it.
fn maps(axes: &Axes, image: &ImageConfig) -> opencv::Result<[Mat; 2]> {
    let (mut map_a, mut map_b) = (Mat::default(), Mat::default());
    let [width, height] = [image.region_px[2], image.region_px[3]].map(|v| v as f32);
    let scale = width / REGION_PX;
    let mut map_x = Mat::new_rows_cols_with_default(STRIP_SAMPLES, STRIP_SAMPLES, CV_32FC1, Scalar::all(0.0))?;
    let mut map_y = map_x.try_clone()?;
    let mut inside = true;
    for i in 0..STRIP_SAMPLES {
        for j in 0..STRIP_SAMPLES {
            let share = |k: i32| (k as f32 + 0.5) / STRIP_SAMPLES as f32;
            let at = |[from, to]: [f32; 2], k: i32| scale * (from + share(k) * (to - from));
            let (u, w) = (at(STRIP_PX[0], j), at(STRIP_PX[1], i));
            let [x, y] = [0, 1].map(|k| axes.lip_px[k] + u * axes.x[k] + w * axes.y[k]);
            inside &= x >= 0.0 && y >= 0.0 && x <= width - 1.0 && y <= height - 1.0;
            (*map_x.at_2d_mut::<f32>(i, j)?, *map_y.at_2d_mut::<f32>(i, j)?) = (x, y);
        }
    }
    if inside {
        imgproc::convert_maps(&map_x, &map_y, &mut map_a, &mut map_b, CV_16SC2, true)?;
    }
    Ok([map_a, map_b])
}
