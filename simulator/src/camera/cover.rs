//! Which share of each pixel is covered by liquid: outlines become coverage here.
//!
//! Called by the renderer, on its thread. Allocates when it is set up and when an outline first crosses a row more often than any before;
//! failures are OpenCV's.

use opencv::core::{CV_8UC1, Mat, Rect, Scalar};
use opencv::prelude::*;

/// Widest picture that can be covered, px, with one column more for the last pixel's neighbour.
const COLUMNS: usize = 4097;

/// The cover of one picture: 0 to 255 for each pixel.
pub struct Cover {
    /// The covered share of each pixel, of which 255 is 1.
    pub(super) shares: Mat,
    width: usize,
    height: usize,
    /// Where the present line of samples crosses the outline, px.
    crossings: Vec<f64>,
    /// The outline's sides that touch the present row.
    sides: Vec<([f64; 2], [f64; 2])>,
}

impl Cover {
    /// An empty cover.
    pub fn new(width_px: u32, height_px: u32) -> opencv::Result<Self> {
        let shares = Mat::new_rows_cols_with_default(height_px as i32, width_px as i32, CV_8UC1, Scalar::all(0.0))?;
        let (crossings, sides) = (Vec::with_capacity(16), Vec::with_capacity(64));
        Ok(Self { shares, width: width_px as usize, height: height_px as usize, crossings, sides })
    }

    /// Adds a closed outline (picture px; as everywhere, whole numbers are the middles of pixels), with exact coverage along rows and
    /// four lines a row. Returns the rectangle that holds it.
    pub fn fill(&mut self, outline: &[[f64; 2]]) -> opencv::Result<Rect> {
        let (width, height) = (self.width, self.height);
        let low = |k: usize| outline.iter().fold(f64::MAX, |m, p| m.min(p[k]));
        let high = |k: usize| outline.iter().fold(f64::MIN, |m, p| m.max(p[k]));
        let clamp = |v: f64, most: usize| v.clamp(0.0, most as f64) as usize;
        let (x0, x1) = (clamp(low(0).floor(), width), clamp(high(0).ceil() + 1.0, width));
        let (y0, y1) = (clamp(low(1).floor(), height), clamp(high(1).ceil() + 1.0, height));
        let mut row = [0f32; COLUMNS];
        for y in y0..y1 {
            let (top, bottom) = (y as f64 - 0.5, y as f64 + 0.5);
            self.sides.clear();
            let next = outline.iter().cycle().skip(1);
            self.sides
                .extend(outline.iter().zip(next).filter(|(a, b)| a[1].min(b[1]) <= bottom && a[1].max(b[1]) >= top).map(|(a, b)| (*a, *b)));
            let (mut first_used, mut last_used) = (width, 0);
            for quarter in 0..4 {
                let line = top + (f64::from(quarter) + 0.5) / 4.0;
                self.cross(line);
                for span in self.crossings.chunks_exact(2) {
                    let (from, to) = ((span[0] + 0.5).clamp(0.0, width as f64), (span[1] + 0.5).clamp(0.0, width as f64));
                    let (first, last) = (from as usize, to as usize);
                    (first_used, last_used) = (first_used.min(first), last_used.max(last + 1));
                    if first == last {
                        row[first] += (to - from) as f32;
                        continue;
                    }
                    row[first] += (first as f64 + 1.0 - from) as f32;
                    row[first + 1..last].iter_mut().for_each(|v| *v += 1.0);
                    row[last] += (to - last as f64) as f32;
                }
            }
            if first_used < last_used {
                let pixels = &mut self.shares.at_row_mut::<u8>(y as i32)?[first_used..last_used.min(width)];
                for (pixel, share) in pixels.iter_mut().zip(&row[first_used..]) {
                    *pixel = (*pixel).max((share * (255.0 / 4.0)).min(255.0) as u8);
                }
                row[first_used..last_used].fill(0.0);
            }
        }
        Ok(Rect::new(x0 as i32, y0 as i32, x1.saturating_sub(x0) as i32, y1.saturating_sub(y0) as i32))
    }

    /// Finds, in order, where the horizontal `line` crosses the sides of the row.
    fn cross(&mut self, line: f64) {
        self.crossings.clear();
        for (a, b) in &self.sides {
            if (a[1] <= line) != (b[1] <= line) {
                self.crossings.push(a[0] + (b[0] - a[0]) * (line - a[1]) / (b[1] - a[1]));
            }
        }
        self.crossings.sort_by(f64::total_cmp);
    }
}

/// The smallest rectangle that holds both; an empty one holds nothing.
pub fn join(a: Rect, b: Rect) -> Rect {
    if a.width <= 0 || a.height <= 0 {
        return b;
    }
    if b.width <= 0 || b.height <= 0 {
        return a;
    }
    a | b
}
