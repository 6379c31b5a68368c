//! Where a picture along the rays has a coloured liquid's colours: as they are, or as a camera of a limited range shows them.
//!
//! Video has levels from 16 to 235 where pictures have 0 to 255. A camera or a decoder that mixes them up makes a dark liquid brighter and
//! paler, so that it leaves its range of colours and may look like dark ground. The mix-up can be undone, so that liquid is known again.
//!
//! Called on the extraction thread. All pictures are kept, so after the first frame nothing is allocated but OpenCV's matrix headers. The
//! only failures are OpenCV's.

use opencv::core::{self, CV_8UC1, Mat, Scalar, Vec3b};
use opencv::imgproc;
use opencv::prelude::*;

/// The least level of a limited range, by ITU-R BT.601.
const LIMITED_LEAST: f64 = 16.0;
/// How many levels there are above it, by ITU-R BT.601.
const LIMITED_LEVELS: f64 = 219.0;
/// A picture in which more than this share of samples have a part beyond a limited range has none. Chosen by hand: noise makes fewer.
const BEYOND_SHARE: f32 = 0.002;
/// So far beyond it, levels. Chosen by hand: rounding and what noise is left in smoothed samples.
const BEYOND_LEAST: f64 = 1.0;

/// Marks where a liquid's colours are.
pub(super) struct LiquidMask {
    /// Least and largest hue, saturation and value of what is the liquid.
    ranges: Vec<(Scalar, Scalar)>,
    hsv: Mat,
    /// Not 0 where there is liquid.
    mask: Mat,
    /// The mask of one range of hues.
    half: Mat,
}

impl LiquidMask {
    /// For these ranges of hue, saturation and value.
    pub(super) fn new(ranges: Vec<(Scalar, Scalar)>) -> Self {
        Self { ranges, hsv: Mat::default(), mask: Mat::default(), half: Mat::default() }
    }

    /// Looks at a picture in BGR.
    pub(super) fn take(&mut self, colours: &Mat) -> opencv::Result<()> {
        imgproc::cvt_color_def(colours, &mut self.hsv, imgproc::COLOR_BGR2HSV)?;
        for (i, (low, high)) in self.ranges.iter().enumerate() {
            if i == 0 {
                core::in_range(&self.hsv, low, high, &mut self.mask)?;
                continue;
            }
            core::in_range(&self.hsv, low, high, &mut self.half)?;
            let others = self.half.data_bytes()?;
            self.mask.data_bytes_mut()?.iter_mut().zip(others).for_each(|(mask, other)| *mask |= other);
        }
        Ok(())
    }

    /// Not 0 where the last picture has the liquid's colours.
    pub(super) fn mask(&self) -> &Mat {
        &self.mask
    }
}

/// Marks where a liquid's colours would be, if the picture had a limited range.
pub(super) struct LimitedMask {
    /// The level of the full range for each one of the limited range.
    full: Mat,
    colours: Mat,
    liquid: LiquidMask,
}

impl LimitedMask {
    /// For these ranges of hue, saturation and value.
    pub(super) fn new(ranges: Vec<(Scalar, Scalar)>) -> opencv::Result<Self> {
        let mut full = Mat::new_rows_cols_with_default(1, 256, CV_8UC1, Scalar::all(0.0))?;
        for (level, kept) in full.data_bytes_mut()?.iter_mut().enumerate() {
            // A cast ends at 0 and at 255.
            *kept = ((level as f64 - LIMITED_LEAST) * 255.0 / LIMITED_LEVELS).round() as u8;
        }
        Ok(Self { full, colours: Mat::default(), liquid: LiquidMask::new(ranges) })
    }

    /// Looks at a picture in BGR. Whether it may have a limited range: none of its levels lies beyond.
    pub(super) fn take(&mut self, colours: &Mat) -> opencv::Result<bool> {
        let levels = (LIMITED_LEAST - BEYOND_LEAST) as u8..=(LIMITED_LEAST + LIMITED_LEVELS + BEYOND_LEAST) as u8;
        let pixels: &[Vec3b] = colours.data_typed()?;
        let beyond = pixels.iter().filter(|c| !c.iter().all(|v| levels.contains(v))).count();
        if beyond as f32 > BEYOND_SHARE * pixels.len() as f32 {
            return Ok(false);
        }
        core::lut(colours, &self.full, &mut self.colours)?;
        self.liquid.take(&self.colours)?;
        Ok(true)
    }

    /// Not 0 where the last picture that may have a limited range has the liquid's colours in it.
    pub(super) fn mask(&self) -> &Mat {
        self.liquid.mask()
    }
}
