//! The brightness across a straight edge, taken as the mean along it.
//!
//! Pure, but for OpenCV's errors; allocates. Used by calibration only, on the command's thread. A place outside of the picture is left out.

use opencv::core::Mat;
use opencv::prelude::*;

use super::picture::bilinear_corner;

/// Samples along the edge. Chosen by hand: every third pixel of a usual edge, so that noise is averaged away.
const ALONG: usize = 96;
/// Samples of a profile in each px of a picture 640 px wide. Chosen by hand: edges are found to a tenth of a pixel by their middles.
pub(super) const FINE: usize = 2;

/// A piece of a straight line, and which way is outside.
#[derive(Debug, Clone, Copy)]
pub(super) struct Piece {
    /// Where it begins, px.
    pub from: [f32; 2],
    /// Where it ends, px.
    pub to: [f32; 2],
    /// Unit vector square to it, to the outside.
    pub outside: [f32; 2],
}

impl Piece {
    /// The piece between the shares `part` of the way from `from` to `to`, whose outside lies away from `inner`.
    pub(super) fn new(from: [f32; 2], to: [f32; 2], part: [f32; 2], inner: [f32; 2]) -> Self {
        let (dx, dy) = (to[0] - from[0], to[1] - from[1]);
        let length = dx.hypot(dy).max(1.0);
        let at = |share: f32| [from[0] + share * dx, from[1] + share * dy];
        let normal = [-dy / length, dx / length];
        let inwards = normal[0] * (inner[0] - from[0]) + normal[1] * (inner[1] - from[1]) > 0.0;
        let outside = if inwards { normal.map(|v| -v) } else { normal };
        Self { from: at(part[0]), to: at(part[1]), outside }
    }

    /// The mean grey level at each distance from `reach` px inside to `reach` px outside of the piece; 640 px is the picture's width in
    /// these px. `None` where less than half of a line of samples lies in the picture.
    pub(super) fn profile(&self, grey: &Mat, reach: usize) -> opencv::Result<Vec<Option<f32>>> {
        let (width, height) = (grey.cols() as usize, grey.rows() as usize);
        let bytes = grey.data_bytes()?;
        let scale = width as f32 / 640.0;
        let level = |[x, y]: [f32; 2]| {
            let (column, row, fx, fy) = bilinear_corner(x, y, width, height)?;
            let at = |c: usize, r: usize| f32::from(bytes[r * width + c]);
            let upper = at(column, row) * (1.0 - fx) + at(column + 1, row) * fx;
            Some(upper * (1.0 - fy) + (at(column, row + 1) * (1.0 - fx) + at(column + 1, row + 1) * fx) * fy)
        };
        let samples = 2 * reach * FINE + 1;
        Ok((0..samples)
            .map(|i| {
                let distance = (i as f32 / FINE as f32 - reach as f32) * scale;
                let (mut sum, mut count) = (0.0, 0);
                for k in 0..ALONG {
                    let share = (k as f32 + 0.5) / ALONG as f32;
                    let at = |c: usize| self.from[c] + share * (self.to[c] - self.from[c]) + distance * self.outside[c];
                    if let Some(level) = level([at(0), at(1)]) {
                        sum += level;
                        count += 1;
                    }
                }
                (2 * count >= ALONG).then(|| sum / count as f32)
            })
            .collect())
    }
}

/// The change from each sample of a profile to the next but one; 0 beside a sample that is missing.
pub(super) fn slopes(profile: &[Option<f32>]) -> Vec<f32> {
    profile.windows(3).map(|w| w[0].zip(w[2]).map_or(0.0, |(a, b)| b - a)).collect()
}
