//! How liquid looks: a coloured liquid hides what is behind it, and clear water bends its light (see [`super::water`]).
//!
//! Called by the renderer, on its thread. Allocates at the first frames; failures are OpenCV's.

use opencv::core::{BORDER_REFLECT_101, Mat, Point, Rect, Size, Vec3b};
use opencv::imgproc;
use opencv::prelude::*;

use super::stream_outline::Ripple;
use super::view::View;
use super::water::{Water, WaterRow};

/// Draws the liquid of one view.
pub struct Liquid {
    /// The cover, softened: it stands for the liquid's thickness, and its slope for the surface's.
    thickness: Mat,
    /// The picture behind the liquid.
    behind: Mat,
    /// Width of the softening, px; odd.
    around: i32,
    look: Look,
    /// Share of its surface that is foam, 0 to 1.
    foam: f64,
    /// Side of a patch of foam, px.
    bubble_px: usize,
    /// How often liquid was laid: foam changes from frame to frame.
    laid: u64,
}

/// The two kinds of liquid.
enum Look {
    /// Blue, green, red; and the share of the background that a thick layer hides.
    Coloured([u8; 3], f32),
    Clear(Box<Water>),
}

/// One row of the softened cover with the rows around it.
struct ThicknessRow<'a> {
    above: &'a [u8],
    here: &'a [u8],
    below: &'a [u8],
    /// Distance to the neighbours that the slope is taken from, px.
    step: usize,
}

impl ThicknessRow<'_> {
    /// How a lamp over the operator's left shoulder lights the surface at the column `x`. The softened cover falls towards the outline,
    /// so its slope is the surface's slope there.
    fn lamp(&self, x: usize) -> f32 {
        let right = (x + self.step).min(self.here.len() - 1);
        let slope_x = (f32::from(self.here[right]) - f32::from(self.here[x.saturating_sub(self.step)])) / 255.0;
        let slope_y = (f32::from(self.below[x]) - f32::from(self.above[x])) / 255.0;
        0.75 * slope_y + 0.35 * slope_x
    }
}

impl Liquid {
    /// The liquid of `view`; `seed` draws the room that clear water reflects.
    pub fn new(view: &View, seed: u64) -> Self {
        let look = match view.liquid_bgr {
            Some(bgr) => Look::Coloured(bgr, view.opacity as f32),
            None => Look::Clear(Box::new(Water::new(view, seed))),
        };
        Self {
            thickness: Mat::default(),
            behind: Mat::default(),
            around: (1.3 * view.px_per_mm) as i32 | 1,
            look,
            foam: view.foam,
            bubble_px: ((0.6 * view.px_per_mm) as usize).max(1),
            laid: 0,
        }
    }

    /// Lays the liquid in `cover` over `frame` inside of `area`, then clears the cover.
    pub fn lay(&mut self, cover: &mut Mat, frame: &mut Mat, area: Rect, ripple: Ripple) -> opencv::Result<()> {
        if area.width <= 0 || area.height <= 0 {
            return Ok(());
        }
        let size = Size::new(self.around, self.around);
        imgproc::blur(&Mat::roi(cover, area)?, &mut self.thickness, size, Point::new(-1, -1), BORDER_REFLECT_101)?;
        Mat::roi(frame, area)?.copy_to(&mut self.behind)?;
        if let Look::Clear(water) = &mut self.look {
            water.measure_bodies(cover, frame, area)?;
        }
        let (rows, columns) = (area.height as usize, area.width as usize);
        // Continuous copies, indexed directly: this loop reads around each pixel, which no OpenCV call does.
        let behind = self.behind.data_typed::<Vec3b>()?;
        let thickness = self.thickness.data_bytes()?;
        let step = (self.around / 2).max(1) as usize;
        let inside = area.x as usize..area.x as usize + columns;
        for y in 0..rows {
            let cover = &mut cover.at_row_mut::<u8>(area.y + y as i32)?[inside.clone()];
            let frame = &mut frame.at_row_mut::<Vec3b>(area.y + y as i32)?[inside.clone()];
            let row = |y: usize| &thickness[y * columns..(y + 1) * columns];
            let thickness = ThicknessRow { above: row(y.saturating_sub(step)), here: row(y), below: row((y + step).min(rows - 1)), step };
            match &self.look {
                Look::Coloured(bgr, opacity) => {
                    lay_coloured(cover, frame, &behind[y * columns..(y + 1) * columns], &thickness, *bgr, *opacity);
                }
                Look::Clear(water) => lay_clear(cover, frame, &water.row(area, y, ripple)?, &thickness),
            }
            if self.foam > 0.0 {
                lay_foam(
                    cover,
                    frame,
                    self.foam,
                    [(area.x as usize) / self.bubble_px, (area.y as usize + y) / self.bubble_px],
                    self.bubble_px,
                    self.laid,
                );
            }
            cover.fill(0);
        }
        self.laid += 1;
        Ok(())
    }
}

fn lay_coloured(cover: &[u8], frame: &mut [Vec3b], behind: &[Vec3b], thickness: &ThicknessRow, bgr: [u8; 3], opacity: f32) {
    for x in (0..cover.len()).filter(|x| cover[*x] != 0) {
        let lamp = thickness.lamp(x);
        let thick = f32::from(thickness.here[x]) / 255.0;
        let hidden = opacity * (0.8 + 0.2 * thick);
        let light = 0.82 + 0.22 * thick + 0.45 * lamp;
        let glint = if lamp > 0.62 { 90.0 * (lamp - 0.62) / 0.38 } else { 0.0 };
        let colour = std::array::from_fn(|c| f32::from(behind[x][c]) * (1.0 - hidden) + f32::from(bgr[c]) * hidden * light + glint);
        blend(&mut frame[x], colour, cover[x]);
    }
}

fn lay_clear(cover: &[u8], frame: &mut [Vec3b], water: &WaterRow, thickness: &ThicknessRow) {
    for x in (0..cover.len()).filter(|x| cover[*x] != 0) {
        blend(&mut frame[x], water.colour(x, thickness.lamp(x)), cover[x]);
    }
}

/// Lays patches of foam over one row of liquid: `first` is the patch of its first pixel, and the row's patch.
fn lay_foam(cover: &[u8], frame: &mut [Vec3b], share: f64, first: [usize; 2], bubble_px: usize, laid: u64) {
    for x in (0..cover.len()).filter(|x| cover[*x] != 0) {
        // A hash of the place, which changes every few frames as bubbles drift and burst.
        let place = ((first[0] + x / bubble_px) as u64) << 32 | (first[1] as u64) << 16 | (laid / 3) & 0xffff;
        let hash = (place ^ (place >> 15)).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        if ((hash >> 40) as f64) < share * f64::from(1 << 24) {
            let level = 205.0 + (hash >> 34 & 31) as f32;
            blend(&mut frame[x], [level; 3], (u16::from(cover[x]) * 4 / 5) as u8);
        }
    }
}

/// Lays a colour over a pixel; `cover` is the share of the pixel that it covers, of which 255 is 1.
fn blend(pixel: &mut Vec3b, colour: [f32; 3], cover: u8) {
    let share = f32::from(cover) / 255.0;
    for c in 0..3 {
        pixel[c] = (f32::from(pixel[c]) * (1.0 - share) + colour[c].min(255.0) * share) as u8;
    }
}
