//! Coloured liquid, which is told from the background by a range of hue, saturation and value.
//!
//! The wedge between the axes is resampled once into rays from the lip (`cv::remap`), one ray a row. Seen from the lip, liquid comes
//! first and background after it, whatever the tilt. So on each ray the outer edge is where the number of liquid pixels minus that of
//! background pixels is largest. A stream fills nearly every ray from the lip on; drops and splashes do not, so they are no stream.
//!
//! Called on the extraction thread. All pictures are kept, so after the first frame nothing is allocated but OpenCV's matrix headers.
//! The only failures are OpenCV's.

use opencv::boxed_ref::BoxedRef;
use opencv::core::{self, CV_16SC2, CV_32FC1, Mat, Scalar};
use opencv::imgproc;
use opencv::prelude::*;
use shared::config::ImageConfig;
use shared::messages::{Doubt, PixelFormat};

use super::geometry::{Axes, NEAR_PX, RAYS, RayGrid};
use super::liquid::{FineLine, LineRules, Liquid, PROFILE_SAMPLES, Profile, ProfileEdge, REACH, Sighting};

// "Tuned" below means that the value was tuned on seeds 1 and 5001 to 5003 of `evaluate-camera`; see docs/VISION.md.

/// Share of rays that a stream fills at least. Tuned.
const STREAM_RAYS: f32 = 0.8;
/// With more than this share of rays full, far out, and no stream, something hides the stream. Tuned.
const HIDDEN_RAYS: f32 = 0.5;
/// Mean length of liquid on the full rays above which they are full far out, px. Tuned.
const HIDDEN_PX: f32 = 14.0;
/// More background than this before the first liquid ends a ray, px. Tuned.
const GAP_MOST_PX: f32 = 24.0;
/// Least share of liquid between lip and edge on a ray that counts as filled. Tuned.
const FILLED: f32 = 0.55;
/// With more than this share of rays full of liquid to the region's border, the colour tells nothing in this light. Chosen by hand; no
/// measurement is recorded.
const ALL_LIQUID: f32 = 0.9;
/// With more than this share of rays full of liquid to the region's border, the area is a lower bound. Chosen by hand; no measurement
/// is recorded.
const LEAVES_SHARE: f32 = 0.06;
/// Side of the square of samples that are smoothed together: a fifth of the noise, for a tenth of what smoothing the region would cost.
/// Tuned; it costs about 25 us more than 3, see docs/VISION.md.
const SMOOTH: i32 = 5;
/// There is no line when a smaller share of the profiles than this shows an edge. Tuned.
const PROFILES_LEAST: f32 = 0.3;
/// Samples at either end of a profile that tell liquid and background. Chosen by hand; no measurement is recorded.
const FLANK: usize = 3;
/// Least difference of liquid and background at the ends of a profile: the root of the sum of the squares of the three parts, grey
/// levels. Tuned.
const DIFFERENCE_LEAST: f32 = 12.0;

/// Finds the stream of a coloured liquid in the pictures of one camera.
pub(crate) struct ColouredLiquid {
    /// The axes relative to the region.
    axes: Axes,
    /// The rays along which the region is sampled.
    grid: RayGrid,
    /// The first of the two fixed-point maps from rays to the region, as `cv::convertMaps` makes them.
    map_a: Mat,
    /// The second of these maps.
    map_b: Mat,
    /// Least hue, saturation and value.
    low: Scalar,
    /// Largest hue, saturation and value.
    high: Scalar,
    /// A smaller triangle is no stream, px^2.
    area_min_px2: f32,
    // Pictures along the rays, one ray a row, kept from frame to frame.
    /// The region in BGR.
    sampled: Mat,
    /// The same, smoothed.
    smooth: Mat,
    /// The same in hue, saturation and value.
    hsv: Mat,
    /// Not 0 where there is liquid.
    mask: Mat,
    /// The mask of one of the two ranges of a colour around hue 0.
    half_mask: Mat,
}

impl ColouredLiquid {
    /// For the colours of `image`. `axes` and `grid` are relative to the region.
    pub(crate) fn new(image: &ImageConfig, axes: Axes, grid: RayGrid) -> opencv::Result<Self> {
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
        let [h0, s0, v0, h1, s1, v1] = image.colour_hsv.map(f64::from);
        Ok(Self {
            axes,
            grid,
            map_a,
            map_b,
            low: Scalar::new(h0, s0, v0, 0.0),
            high: Scalar::new(h1, s1, v1, 0.0),
            area_min_px2: image.area_min_px2,
            sampled: Mat::default(),
            smooth: Mat::default(),
            hsv: Mat::default(),
            mask: Mat::default(),
            half_mask: Mat::default(),
        })
    }

    /// Tells liquid from background into `self.mask`. A dark liquid in dim light is only noise and a little colour, so neighbouring
    /// samples are taken together.
    fn segment(&mut self) -> opencv::Result<()> {
        let size = core::Size::new(SMOOTH, SMOOTH);
        imgproc::blur(&self.sampled, &mut self.smooth, size, core::Point::new(-1, -1), core::BORDER_REPLICATE)?;
        imgproc::cvt_color_def(&self.smooth, &mut self.hsv, imgproc::COLOR_BGR2HSV)?;
        if self.low[0] <= self.high[0] {
            return core::in_range(&self.hsv, &self.low, &self.high, &mut self.mask);
        }
        // Red lies on both sides of hue 0.
        let (mut low, mut high) = (self.low, self.high);
        high[0] = 179.0;
        core::in_range(&self.hsv, &low, &high, &mut self.half_mask)?;
        (low[0], high[0]) = (0.0, self.high[0]);
        core::in_range(&self.hsv, &low, &high, &mut self.mask)?;
        let one = std::mem::take(&mut self.mask);
        core::bitwise_or(&one, &self.half_mask, &mut self.mask, &core::no_array())
    }

    /// The last sample of liquid on a ray and the score there: px of liquid minus px of background, at its largest.
    #[inline(always)]
    fn last_liquid(&self, mask: &[u8]) -> Option<(usize, f32)> {
        let (mut score, mut best, mut last) = (0.0f32, 0.0f32, None);
        for (r, (value, step)) in mask.iter().zip(&self.grid.steps_px).enumerate() {
            score += if *value != 0 { *step } else { -step };
            if score > best {
                (best, last) = (score, Some(r));
            } else if score < -GAP_MOST_PX {
                break;
            }
        }
        last.map(|r| (r, best))
    }
}

impl Liquid for ColouredLiquid {
    fn reads(&self, format: PixelFormat) -> bool {
        format != PixelFormat::Mono8
    }

    fn rules(&self) -> LineRules {
        LineRules { profiles_least: PROFILES_LEAST, first_area_least_px2: self.area_min_px2, edge_tells_focus: true }
    }

    fn take(&mut self, region: &BoxedRef<Mat>) -> opencv::Result<()> {
        let (nearest, border) = (imgproc::INTER_NEAREST, core::BORDER_REPLICATE);
        imgproc::remap(region, &mut self.sampled, &self.map_a, &self.map_b, nearest, border, Scalar::default())
    }

    fn sampled(&self) -> &Mat {
        &self.sampled
    }

    fn look(&mut self, edges_px: &mut Vec<[f32; 2]>) -> opencv::Result<Sighting> {
        self.segment()?;
        edges_px.clear();
        let (mut filled, mut cut_off, mut liquid_px) = (0usize, 0usize, 0.0f32);
        for (i, ray) in self.grid.rays.iter().enumerate() {
            let Some((r, score)) = self.last_liquid(&self.mask.at_row::<u8>(i as i32)?[..ray.samples]) else { continue };
            // Between the last sample of liquid and the first of background.
            let r_px = self.grid.radii_px[r] + 0.5 * self.grid.steps_px[r];
            if r_px >= NEAR_PX + 1.0 && score >= (2.0 * FILLED - 1.0) * (r_px - NEAR_PX) {
                filled += 1;
                liquid_px += r_px;
                cut_off += usize::from(r + 1 >= ray.samples);
                edges_px.push(self.axes.at(r_px, ray.along));
            }
        }
        let share = filled as f32 / RAYS as f32;
        if cut_off as f32 > ALL_LIQUID * RAYS as f32 {
            return Ok(Sighting::Unsure);
        }
        if share < STREAM_RAYS {
            // A good half of the wedge full of liquid is no drop: something hides the stream.
            let mean_px = liquid_px / filled.max(1) as f32;
            let hidden = share > HIDDEN_RAYS && mean_px > HIDDEN_PX;
            return Ok(if hidden { Sighting::Unsure } else { Sighting::Dry { confidence: (1.0 - share).clamp(0.0, 1.0) } });
        }
        Ok(Sighting::Stream { seen_share: share, leaves_region: cut_off as f32 > LEAVES_SHARE * RAYS as f32 })
    }

    /// The edge is where the profile, projected on the difference between its two ends, passes one half.
    fn edge_on(&self, profile: &Profile) -> Option<ProfileEdge> {
        let mean =
            |range: &[[f32; 3]]| -> [f32; 3] { std::array::from_fn(|c| range.iter().map(|v| v[c]).sum::<f32>() / range.len() as f32) };
        let inside = mean(&profile.colours[..FLANK]);
        let outside = mean(&profile.colours[PROFILE_SAMPLES - FLANK..]);
        let difference: [f32; 3] = std::array::from_fn(|c| inside[c] - outside[c]);
        let square: f32 = difference.iter().map(|v| v * v).sum();
        if square < DIFFERENCE_LEAST * DIFFERENCE_LEAST {
            return None;
        }
        // 1 in the liquid, 0 in the background.
        let scale: [f32; 3] = difference.map(|v| v / square);
        let levels = profile.colours.map(|p| (0..3).map(|c| (p[c] - outside[c]) * scale[c]).sum::<f32>());
        // The falling crossing nearest to the profile's centre.
        let crossing = |height: f32| {
            levels
                .windows(2)
                .enumerate()
                .filter(|(_, w)| w[0] >= height && w[1] < height)
                .map(|(j, w)| j as f32 + (w[0] - height) / (w[0] - w[1]))
                .min_by(|p, q| (p - REACH as f32).abs().total_cmp(&(q - REACH as f32).abs()))
        };
        let sample = crossing(0.5)?;
        let width_samples = crossing(0.8).zip(crossing(0.2)).map(|(high, low)| (low - high).abs());
        Some(ProfileEdge { sample, contrast: square.sqrt(), trust: 1.0, width_samples })
    }

    fn confirm(&mut self, line: Option<FineLine>, _mean_level: f32) -> Result<FineLine, Doubt> {
        line.ok_or(Doubt::EdgeNotFound)
    }
}
