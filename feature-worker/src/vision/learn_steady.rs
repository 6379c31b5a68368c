//! Whether axes stay where they are while the background moves: what calibration must know of a clip before it believes in them.
//!
//! In each picture the brightness across an axis is compared with that of the mean picture. An edge of the container gives the same step
//! at the same place; an edge of the background, or of a container that is not fixed to the camera, wanders. It is used by calibration only,
//! on the command's thread; it allocates. The only failures are OpenCV's.

use opencv::core::{Mat, Point, Size};
use opencv::imgproc;
use opencv::prelude::*;

use super::learn_axes::Corner;
use super::learn_profile::{FINE, Piece, slopes};

/// How far an edge is looked for to either side of an axis, px of a picture 640 px wide. By hand: a hand that holds a camera moves more.
const REACH_PX: usize = 14;
/// Largest shift at which an edge still stays, px of a picture 640 px wide. By hand: a wrist that turns shakes a camera by less.
const STAYS_PX: f32 = 1.6;
/// Least correlation of an edge with its mean. By hand; liquid behind the glass changes a rim's brightness, not its place.
const ALIKE: f32 = 0.55;
/// Least step across an axis in the mean picture, grey levels a px. By hand: half of what Canny needs for an edge.
const STEP_LEAST: f32 = 4.0;
/// Parts of an axis that are judged, as shares of its length: nearer to the lip, the stream crosses it.
const PARTS: [[f32; 2]; 2] = [[0.25, 0.62], [0.62, 1.0]];
/// Gradients for edges of the background (Canny's two thresholds), grey levels. By hand.
const CANNY: [f64; 2] = [40.0, 100.0];
/// In this share of the pictures an edge of the background must be at the same place to stand still. By hand.
const STILL_SHARE: f32 = 0.8;

/// What a clip shows of its axes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Steadiness {
    /// Share of the pictures in which the top edge is where it is in the mean; `None` where it is too faint to tell.
    pub top_edge: Option<f32>,
    /// The same for the left side.
    pub left_side: Option<f32>,
    /// Edges outside of the container that stand still, px of length a picture 640 px wide.
    pub still_px: f32,
    /// All edges outside of the container, in the same unit.
    pub edges_px: f32,
    /// Of two pictures, which share of the edges outside of the container lie on one another, beyond what lies there by chance: the median over all
    /// pairs. Something large that passes by hides the background in a few pictures of each place only.
    pub pairs: f32,
}

impl Steadiness {
    /// Judges `corner` in `pictures` of different poses, whose mean is `mean`; all in BGR.
    pub fn judge(corner: &Corner, pictures: &[&Mat], mean: &Mat) -> opencv::Result<Self> {
        let mean = grey(mean)?;
        let pictures: Vec<Mat> = pictures.iter().map(|p| grey(p)).collect::<opencv::Result<_>>()?;
        let stays = |end: [f32; 2], inner: [f32; 2]| -> opencv::Result<Option<f32>> {
            let mut least: Option<f32> = None;
            for part in PARTS {
                let share = share_that_stays(&Piece::new(corner.lip, end, part, inner), &pictures, &mean)?;
                least = match (least, share) {
                    (Some(least), Some(share)) => Some(least.min(share)),
                    (one, other) => one.or(other),
                };
            }
            Ok(least)
        };
        let (top_edge, left_side) = (stays(corner.rim, corner.foot)?, stays(corner.foot, corner.rim)?);
        let (still_px, edges_px, pairs) = still_edges(corner, &pictures)?;
        Ok(Self { top_edge, left_side, still_px, edges_px, pairs })
    }
}

fn grey(picture: &Mat) -> opencv::Result<Mat> {
    let mut grey = Mat::default();
    imgproc::cvt_color_def(picture, &mut grey, imgproc::COLOR_BGR2GRAY)?;
    Ok(grey)
}

/// The share of `pictures` in which the step across a piece of an axis is where it is in the mean.
fn share_that_stays(piece: &Piece, pictures: &[Mat], mean: &Mat) -> opencv::Result<Option<f32>> {
    let reference = slopes(&piece.profile(mean, REACH_PX)?);
    let middle = reference.len() / 2;
    let inner = REACH_PX * FINE / 2;
    let most = middle - inner;
    let window = &reference[most..most + 2 * inner];
    let step = window.iter().fold(0.0f32, |most, v| most.max(v.abs()));
    if step < STEP_LEAST {
        return Ok(None);
    }
    let mut stays = 0;
    for picture in pictures {
        let seen = slopes(&piece.profile(picture, REACH_PX)?);
        let best = (-(most as i32)..(reference.len() - most - 2 * inner) as i32)
            .map(|shift| {
                let from = (most as i32 + shift) as usize;
                (correlation(window, &seen[from..from + window.len()]), shift)
            })
            .max_by(|a, b| a.0.total_cmp(&b.0));
        if let Some((alike, shift)) = best {
            stays += usize::from(alike > ALIKE && (shift as f32 / FINE as f32).abs() <= STAYS_PX);
        }
    }
    Ok(Some(stays as f32 / pictures.len().max(1) as f32))
}

/// The correlation of two rows of slopes, -1 to 1.
fn correlation(a: &[f32], b: &[f32]) -> f32 {
    let dot = |a: &[f32], b: &[f32]| a.iter().zip(b).map(|(a, b)| a * b).sum::<f32>();
    let norm = (dot(a, a) * dot(b, b)).sqrt();
    if norm > 0.0 { dot(a, b) / norm } else { 0.0 }
}

/// The length of the edges outside of the container that are at the same place in nearly all pictures, and of all edges there, in the mean of
/// the pictures, px of a picture 640 px wide; and [`Steadiness::pairs`].
fn still_edges(corner: &Corner, pictures: &[Mat]) -> opencv::Result<(f32, f32, f32)> {
    let Some(first) = pictures.first() else { return Ok((0.0, 0.0, 0.0)) };
    let (width, height) = (first.cols() as usize, first.rows() as usize);
    // A band around the container belongs to its rim and wall.
    let band = 0.03 * width as f32;
    let outside = |i: usize| {
        let (x, y) = ((i % width) as f32, (i / width) as f32);
        let beyond = |end: [f32; 2], inner: [f32; 2]| {
            let piece = Piece::new(corner.lip, end, [0.0, 1.0], inner);
            piece.outside[0] * (x - corner.lip[0]) + piece.outside[1] * (y - corner.lip[1])
        };
        beyond(corner.rim, corner.foot).max(beyond(corner.foot, corner.rim)) > band
    };
    let outside: Vec<usize> = (0..width * height).filter(|i| outside(*i)).collect();
    let mut counts = vec![0u16; outside.len()];
    let (mut edges, mut wides) = (Vec::new(), Vec::new());
    let kernel = imgproc::get_structuring_element(imgproc::MORPH_RECT, Size::new(3, 3), Point::new(-1, -1))?;
    for picture in pictures {
        let (mut edge, mut wide) = (Mat::default(), Mat::default());
        imgproc::canny(picture, &mut edge, CANNY[0], CANNY[1], 3, true)?;
        imgproc::dilate_def(&edge, &mut wide, &kernel)?;
        let (edge, wide) = (edge.data_bytes()?, wide.data_bytes()?);
        let near: Vec<bool> = outside.iter().map(|i| wide[*i] > 0).collect();
        near.iter().zip(&mut counts).for_each(|(near, count)| *count += u16::from(*near));
        wides.push(near);
        edges.push(outside.iter().enumerate().filter(|(_, i)| edge[**i] > 0).map(|(k, _)| k).collect::<Vec<usize>>());
    }
    let needed = (STILL_SHARE * pictures.len() as f32).ceil() as u16;
    let still: usize = edges.iter().map(|edge| edge.iter().filter(|k| counts[**k] >= needed).count()).sum();
    let all: usize = edges.iter().map(Vec::len).sum();
    let each = |count: usize| count as f32 / pictures.len() as f32 * 640.0 / width as f32;
    Ok((each(still), each(all), median_of_pairs(&edges, &wides)))
}

/// See [`Steadiness::pairs`]; `edges` are the places of each picture's edges, and `wides` says which places are on or beside them.
fn median_of_pairs(edges: &[Vec<usize>], wides: &[Vec<bool>]) -> f32 {
    let chance: Vec<f32> = wides.iter().map(|wide| wide.iter().filter(|near| **near).count() as f32 / wide.len().max(1) as f32).collect();
    let mut shares = Vec::new();
    for (k, edge) in edges.iter().enumerate() {
        for (wide, chance) in wides.iter().zip(&chance).take(k) {
            let on = edge.iter().filter(|at| wide[**at]).count() as f32 / edge.len().max(1) as f32;
            shares.push((on - chance) / (1.0 - chance).max(f32::EPSILON));
        }
    }
    shares.sort_by(f32::total_cmp);
    shares.get(shares.len() / 2).copied().unwrap_or(0.0)
}
