//! Pictures and their pixels: the image that is measured, its region in colour, and samples between pixels.
//!
//! Called on the extraction thread. The converted region is kept from frame to frame, so after the first frame nothing is allocated but
//! OpenCV's matrix headers. The only failures are OpenCV's.

use opencv::boxed_ref::BoxedRef;
use opencv::core::{Mat, Rect, Vec2b, Vec3b};
use opencv::imgproc;
use opencv::prelude::*;
use shared::messages::PixelFormat;

/// One image: its pixels lie row by row without padding.
#[derive(Debug, Clone, Copy)]
pub struct Image<'a> {
    /// Width in px.
    pub width_px: u32,
    /// Height in px.
    pub height_px: u32,
    /// Layout of the pixels.
    pub format: PixelFormat,
    /// `width_px * height_px * bytes_per_pixel` bytes.
    pub pixels: &'a [u8],
}

/// The pixels of a region in colour, 3 bytes a pixel (blue, green, red). The origin is the region's corner.
#[derive(Clone, Copy)]
pub(crate) struct RegionPixels<'a> {
    bytes: &'a [u8],
    /// Bytes from one row to the next.
    stride: usize,
    width: usize,
    height: usize,
}

impl<'a> RegionPixels<'a> {
    /// Number of rows.
    pub(crate) fn height(&self) -> usize {
        self.height
    }

    /// The bytes of a row, three a pixel; none if there is no such row.
    pub(crate) fn row(&self, y: usize) -> &'a [u8] {
        let start = y * self.stride;
        self.bytes.get(start..start + 3 * self.width).unwrap_or_default()
    }

    /// The colour at a place between pixels, mixed from the four around it: blue, green, red in grey levels. There is none outside of the
    /// region.
    pub(crate) fn at(&self, x: f32, y: f32) -> Option<[f32; 3]> {
        let (column, row, fx, fy) = bilinear_corner(x, y, self.width, self.height)?;
        let start = row * self.stride + column * 3;
        let upper = self.bytes.get(start..start + 6)?;
        let lower = self.bytes.get(start + self.stride..start + self.stride + 6)?;
        Some(std::array::from_fn(|c| {
            let top = f32::from(upper[c]) * (1.0 - fx) + f32::from(upper[c + 3]) * fx;
            let bottom = f32::from(lower[c]) * (1.0 - fx) + f32::from(lower[c + 3]) * fx;
            top * (1.0 - fy) + bottom * fy
        }))
    }
}

/// Reads one region of images in colour, whatever their format.
pub(crate) struct RegionReader {
    region: Rect,
    /// The region of the last image that had to be converted.
    converted: Mat,
}

impl RegionReader {
    /// Reads `region`, px of the whole image.
    pub(crate) fn new(region: Rect) -> Self {
        Self { region, converted: Mat::default() }
    }

    /// Gives the image's region to `take` as a BGR matrix, and returns its pixels. A BGR image is read where it is.
    pub(crate) fn read<'a>(
        &'a mut self,
        image: Image<'a>,
        take: impl FnOnce(&BoxedRef<Mat>) -> opencv::Result<()>,
    ) -> opencv::Result<RegionPixels<'a>> {
        let (rows, columns, region) = (image.height_px as i32, image.width_px as i32, self.region);
        let (width, height) = (region.width as usize, region.height as usize);
        let (bytes, stride) = match image.format {
            PixelFormat::Bgr8 => {
                let frame = Mat::new_rows_cols_with_bytes::<Vec3b>(rows, columns, image.pixels)?;
                take(&Mat::roi(&frame, region)?)?;
                let start = region.y as usize * columns as usize * 3 + region.x as usize * 3;
                (&image.pixels[start..], columns as usize * 3)
            }
            PixelFormat::Yuyv => {
                // Pairs of pixels share their colour, so the crop starts at an even column and is then cut exactly.
                let frame = Mat::new_rows_cols_with_bytes::<Vec2b>(rows, columns, image.pixels)?;
                let even = Rect::new(region.x & !1, region.y, (region.width + (region.x & 1) + 1) & !1, region.height);
                let even = Rect { width: even.width.min(columns - even.x), ..even };
                imgproc::cvt_color_def(&Mat::roi(&frame, even)?, &mut self.converted, imgproc::COLOR_YUV2BGR_YUYV)?;
                let shift = region.x & 1;
                take(&Mat::roi(&self.converted, Rect::new(shift, 0, region.width, region.height))?)?;
                (&self.converted.data_bytes()?[shift as usize * 3..], even.width as usize * 3)
            }
            PixelFormat::Mono8 => {
                let frame = Mat::new_rows_cols_with_bytes::<u8>(rows, columns, image.pixels)?;
                imgproc::cvt_color_def(&Mat::roi(&frame, region)?, &mut self.converted, imgproc::COLOR_GRAY2BGR)?;
                take(&Mat::roi(&self.converted, Rect::new(0, 0, region.width, region.height))?)?;
                (self.converted.data_bytes()?, width * 3)
            }
        };
        Ok(RegionPixels { bytes, stride, width, height })
    }
}

/// The pixel above and to the left of a place, and how far the place lies to the right of that pixel and below it (0 to 1). There is
/// none if one of the four pixels around the place is outside.
#[inline]
pub(crate) fn bilinear_corner(x: f32, y: f32, width: usize, height: usize) -> Option<(usize, usize, f32, f32)> {
    if !(x >= 0.0 && y >= 0.0) {
        return None;
    }
    let (column, row) = (x as usize, y as usize);
    if column + 1 >= width || row + 1 >= height {
        return None;
    }
    Some((column, row, x - column as f32, y - row as f32))
}

/// The median of samples; of two middle ones it is the upper. It is 0 without samples. Reorders them.
pub(crate) fn median(values: &mut [f32]) -> f32 {
    let middle = values.len() / 2;
    if values.is_empty() { 0.0 } else { *values.select_nth_unstable_by(middle, f32::total_cmp).1 }
}
