//! Finds the container's axes in the mean of many pictures of one pour.
//!
//! The container stands still in the picture while the background turns and the liquid moves, so in the mean its edges stay sharp and all
//! else fades. The longest nearly horizontal and nearly vertical line there that meet at a corner are the glass's top edge and its left
//! side. It is used by calibration only, on the command's thread; it allocates and has no bound on its time.
//! Where there is no such corner, the error says what to do instead.

use opencv::core::{Mat, Vec4i, Vector};
use opencv::imgproc;
use opencv::prelude::*;
use serde::Deserialize;

use super::learn_profile::{FINE, Piece, slopes};

// "By hand" below means that the value was chosen by hand and that no measurement is recorded.

/// Gradients above which an edge goes on, and above which one begins (Canny's two thresholds), grey levels. By hand.
const CANNY: [f64; 2] = [14.0, 42.0];
/// Steps of direction in the Hough transform, half a circle. By hand: a quarter of a degree.
const HOUGH_STEPS: f64 = 720.0;
/// Least votes for a line, as a share of the width. By hand.
const VOTES: f32 = 0.08;
/// Least length of a line, as a share of the height. By hand.
const LINE_LEAST: f32 = 0.15;
/// Largest gap within a line, as a share of the height. By hand.
const LINE_GAP: f32 = 0.04;
/// Steepest slope of a line that counts as level, or as upright. By hand.
const SLOPE_MOST: f32 = 0.4;
/// What a gap between a line's end and the corner costs, in units of the lines' lengths. By hand.
const GAP_COST: f32 = 2.5;
/// Largest sum of the two gaps at a corner, as a share of the height. By hand.
const CORNER_GAP: f32 = 0.15;
/// The edges of one rim or wall lie no further apart than this, px of a picture 640 px wide. By hand: a millimetre of glass.
const RIM_PX: usize = 9;
/// Least step of an edge of a rim or wall, as a share of its largest one. By hand.
const RIM_STEP: f32 = 0.35;
/// A bright or dark line is at most so thick, px of a picture 640 px wide. By hand.
const LINE_PX: usize = 5;
/// Least share that the inner step of a line has of its outer one. By hand.
const LINE_ALIKE: f32 = 0.4;
/// The part of an axis along which its edge is looked at, as shares of its length. By hand: at the lip, the other axis begins.
const ALONG: [f32; 2] = [0.1, 1.0];

/// Why the axes are not found.
#[derive(Debug, thiserror::Error)]
pub enum AxesError {
    /// No lines meet like a top edge and a left side.
    #[error("the container's top edge and left side were not found: give --lip, --x-axis and --y-axis, or click them with --page")]
    NoCorner,
    /// OpenCV refused a call.
    #[error("OpenCV: {0}")]
    OpenCv(#[from] opencv::Error),
}

/// The three points that make the axes.
#[derive(Debug, Clone, Copy, PartialEq, Deserialize)]
pub struct Corner {
    /// Where top edge and left side meet, px.
    pub lip: [f32; 2],
    /// On the top edge, further into the mouth, px.
    pub rim: [f32; 2],
    /// On the left side, nearer to the foot, px.
    pub foot: [f32; 2],
}

/// A piece of a straight edge.
#[derive(Debug, Clone, Copy)]
struct Edge {
    /// Its left or upper end, px.
    from: [f32; 2],
    /// Its right or lower end, px.
    to: [f32; 2],
    /// Its length, px.
    length: f32,
}

/// Finds the corner in the mean of many pictures of one pour, in BGR.
pub fn find_corner(mean: &Mat) -> Result<Corner, AxesError> {
    let (width, height) = (mean.cols() as f32, mean.rows() as f32);
    let (level, upright) = find_edges(mean)?;
    let mut best: Option<(f32, Corner)> = None;
    for edge in &level {
        for side in &upright {
            let ([left, right], [upper, lower]) = ([edge.from, edge.to], [side.from, side.to]);
            let (a, b) = ([right[0] - left[0], right[1] - left[1]], [lower[0] - upper[0], lower[1] - upper[1]]);
            let cross = a[0] * b[1] - a[1] * b[0];
            let t = ((upper[0] - left[0]) * b[1] - (upper[1] - left[1]) * b[0]) / cross;
            let lip = [left[0] + t * a[0], left[1] + t * a[1]];
            // Both edges must begin near the corner, and leave it to the right and downwards.
            let gap = (left[0] - lip[0]).hypot(left[1] - lip[1]) + (upper[0] - lip[0]).hypot(upper[1] - lip[1]);
            let inside = lip[0] > 0.03 * width && lip[0] < 0.8 * width && lip[1] > 0.1 * height && lip[1] < 0.9 * height;
            let score = edge.length + side.length - GAP_COST * gap;
            if inside && gap < CORNER_GAP * height && best.is_none_or(|(s, _)| score > s) {
                best = Some((score, Corner { lip, rim: right, foot: lower }));
            }
        }
    }
    let (_, Corner { lip, rim, foot }) = best.ok_or(AxesError::NoCorner)?;
    let mut grey = Mat::default();
    imgproc::cvt_color_def(mean, &mut grey, imgproc::COLOR_BGR2GRAY)?;
    // A rim or a wall has several edges. The axes go along the outermost one.
    let rim_shift = shift_outwards(&Piece::new(lip, rim, ALONG, foot), &grey)?;
    let side_shift = shift_outwards(&Piece::new(lip, foot, ALONG, rim), &grey)?;
    let moved = |p: [f32; 2], shifts: &[[f32; 2]]| shifts.iter().fold(p, |p, s| [p[0] + s[0], p[1] + s[1]]);
    Ok(Corner { lip: moved(lip, &[rim_shift, side_shift]), rim: moved(rim, &[rim_shift]), foot: moved(foot, &[side_shift]) })
}

/// The nearly level and the nearly upright edges of a picture.
fn find_edges(mean: &Mat) -> Result<(Vec<Edge>, Vec<Edge>), AxesError> {
    let (width, height) = (mean.cols() as f32, mean.rows() as f32);
    let (mut grey, mut edges) = (Mat::default(), Mat::default());
    imgproc::cvt_color_def(mean, &mut grey, imgproc::COLOR_BGR2GRAY)?;
    imgproc::canny(&grey, &mut edges, CANNY[0], CANNY[1], 3, true)?;
    let mut lines = Vector::<Vec4i>::new();
    let (step, votes) = (std::f64::consts::PI / HOUGH_STEPS, (VOTES * width) as i32);
    imgproc::hough_lines_p(&edges, &mut lines, 1.0, step, votes, f64::from(LINE_LEAST * height), f64::from(LINE_GAP * height))?;
    let (mut level, mut upright) = (Vec::new(), Vec::new());
    for line in &lines {
        let [x0, y0, x1, y1] = line.0.map(|v| v as f32);
        let (dx, dy) = (x1 - x0, y1 - y0);
        let length = dx.hypot(dy);
        let edge = |forward: bool| {
            let (from, to) = if forward { ([x0, y0], [x1, y1]) } else { ([x1, y1], [x0, y0]) };
            Edge { from, to, length }
        };
        if dy.abs() < SLOPE_MOST * dx.abs() {
            level.push(edge(dx > 0.0));
        } else if dx.abs() < SLOPE_MOST * dy.abs() {
            upright.push(edge(dy > 0.0));
        }
    }
    Ok((level, upright))
}

/// The shift that brings a piece of an edge to the outermost edge of its rim or wall: to the middle of a bright or dark line, or to a step.
fn shift_outwards(piece: &Piece, grey: &Mat) -> opencv::Result<[f32; 2]> {
    let slopes = slopes(&piece.profile(grey, RIM_PX)?);
    let most = slopes.iter().fold(0.0f32, |most, v| most.max(v.abs()));
    // The place of the peak that is outermost of those that are steep enough, and the next one further in.
    let peaks: Vec<usize> = (1..slopes.len().saturating_sub(1))
        .rev()
        .filter(|i| {
            let [before, here, after] = [slopes[i - 1], slopes[*i], slopes[i + 1]].map(f32::abs);
            here >= RIM_STEP * most && here > 0.0 && here >= before && here > after
        })
        .collect();
    let Some(outer) = peaks.first().copied() else { return Ok([0.0; 2]) };
    let line = peaks.get(1).filter(|inner| {
        let opposite = slopes[outer] * slopes[**inner] < 0.0;
        opposite && outer - **inner <= LINE_PX * FINE && slopes[**inner].abs() > LINE_ALIKE * slopes[outer].abs()
    });
    let place = line.map_or(outer as f32, |inner| (outer + inner) as f32 / 2.0);
    // The slopes begin one sample after the profile.
    let distance = ((place + 1.0) / FINE as f32 - RIM_PX as f32) * grey.cols() as f32 / 640.0;
    Ok(piece.outside.map(|n| n * distance))
}
