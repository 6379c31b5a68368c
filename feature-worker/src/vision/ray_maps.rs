//! Where the samples along the rays lie in the region, as OpenCV resamples it.
//!
//! Called when the extraction starts. Allocates; the only failures are OpenCV's.

use opencv::core::{CV_16SC2, CV_32FC1, Mat, Scalar};
use opencv::imgproc;
use opencv::prelude::*;

use super::geometry::{Axes, RAYS, RayGrid};

/// The two fixed-point maps from the rays, one a row, to the region, as `cv::convertMaps` makes them.
pub(super) fn ray_maps(grid: &RayGrid, axes: &Axes) -> opencv::Result<[Mat; 2]> {
    let shape = (RAYS as i32, grid.radii_px.len() as i32);
    let mut map_x = Mat::new_rows_cols_with_default(shape.0, shape.1, CV_32FC1, Scalar::all(-1.0))?;
    let mut map_y = map_x.try_clone()?;
    for (i, ray) in grid.rays.iter().enumerate() {
        let row_x = map_x.at_row_mut::<f32>(i as i32)?;
        let row_y = map_y.at_row_mut::<f32>(i as i32)?;
        for r in 0..grid.radii_px.len() {
            // Beyond the region the last sample is repeated and never looked at.
            [row_x[r], row_y[r]] = axes.at(grid.radii_px[r.min(ray.samples - 1)], ray.along);
        }
    }
    let (mut map_a, mut map_b) = (Mat::default(), Mat::default());
    imgproc::convert_maps(&map_x, &map_y, &mut map_a, &mut map_b, CV_16SC2, true)?;
    Ok([map_a, map_b])
}
