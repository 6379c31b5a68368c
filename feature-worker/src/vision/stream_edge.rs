//! The stream's outer edge as a line of sub-pixel accuracy.
//!
//! 1. A first line through the coarse edge points is found robustly. Of the lines through fixed pairs of them, the one with most edge
//!    length near it is taken, and then a least-squares line through what is near that one.
//! 2. Across that line the picture is read again along short profiles, and the liquid is asked where on each profile its edge lies. A
//!    line with Huber weights through these points cuts the axes at a and b.
//!
//! Called on the extraction thread. All lists are kept, so nothing is allocated after the start. Nothing fails: where there is no line,
//! none is returned.

use super::geometry::{Axes, Line, RAYS, distance};
use super::liquid::{FineLine, Liquid, PROFILE_SAMPLES, Profile, REACH};
use super::picture::{RegionPixels, median};

// "Tuned" below means that the value was tuned on seeds 1 and 5001 to 5003 of `evaluate-camera`; see docs/VISION.md.

/// Edge points that are tried in pairs for the first line. Chosen by hand: their 55 pairs are enough, and cost little.
const PICKS: usize = 13;
/// An edge point lies near a line within this share of the edge points' median distance from the lip. Tuned.
const NEAR_SHARE: f32 = 0.12;
/// Least distance within which an edge point counts as near a line, px. Tuned.
const NEAR_LEAST_PX: f32 = 1.5;
/// No edge point stands for more edge than this, px. Tuned.
const WEIGHT_MOST_PX: f32 = 20.0;
/// Least share of the edge's length that lies near the first line. Tuned.
const INLIERS_LEAST: f32 = 0.6;
/// Profiles across the line. Chosen by hand; no measurement is recorded.
const PROFILES: usize = 48;
/// The distance between a profile's samples is the line's distance from the lip divided by this, so that the inner ends of a small
/// triangle's profiles stay in the liquid. Tuned.
const SPACINGS: f32 = 18.0;
/// Distance of a profile's samples, px: the least and the largest. Tuned.
const SPACING_PX: [f32; 2] = [0.4, 1.0];
/// Points nearer to an axis than this share of the line's distance from the lip do not count, because the rim's light spreads. Tuned.
const MARGIN_SHARE: f32 = 0.04;
/// Points nearer to an axis than this do not count, px: the least and the largest of the margin. Tuned.
const MARGIN_PX: [f32; 2] = [1.0, 1.5];
/// Rounds of fitting the final line with new weights. Chosen by hand; no measurement is recorded.
const ROUNDS: usize = 4;
/// Residuals up to this many medians have full weight: the outline is a little curved, so a few per cent of its length are no outliers.
/// Tuned.
const HUBER_MEDIANS: f32 = 3.0;
/// Residuals up to this have full weight, px. Tuned.
const HUBER_LEAST_PX: f32 = 1.0;
/// Contrast with which a line is fully trusted, grey levels. Chosen by hand; no measurement is recorded.
const FULL_CONTRAST: f32 = 40.0;
/// An edge that takes longer than this from 80 % to 20 % is blurred, px. Tuned.
pub(crate) const BLURRED_PX: f32 = 4.5;
/// Width of an edge where no profile told it, px: sharp.
const SHARP_PX: f32 = 1.0;

/// The first line through the coarse edge points.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FirstLine {
    line: Line,
    /// Cuts with the x-axis and the y-axis, px from the lip.
    pub(crate) legs_px: [f32; 2],
    /// Share of the edge's length that lies near the line.
    inliers: f32,
}

/// Where the profiles across the first line lie.
struct Across {
    /// Where the line cuts the x-axis.
    from: [f32; 2],
    /// Unit vector from there to the cut with the y-axis.
    along: [f32; 2],
    /// Distance from one cut to the other, px.
    length: f32,
    /// Unit vector square to the line, away from the lip.
    outwards: [f32; 2],
    /// 1 if that is the line's own normal, and -1 if it is the opposite.
    side: f32,
}

impl Across {
    fn new(axes: &Axes, first: &FirstLine) -> Self {
        let [a, b] = first.legs_px;
        let (from, to) = (axes.at(a, axes.x), axes.at(b, axes.y));
        let length = (to[0] - from[0]).hypot(to[1] - from[1]);
        let side = if first.line.offset(axes.lip_px) < 0.0 { 1.0 } else { -1.0 };
        Self {
            from,
            along: [(to[0] - from[0]) / length, (to[1] - from[1]) / length],
            length,
            outwards: [first.line.normal[0] * side, first.line.normal[1] * side],
            side,
        }
    }

    /// How far along the line a point lies, px.
    fn place(&self, p: [f32; 2]) -> f32 {
        (p[0] - self.from[0]) * self.along[0] + (p[1] - self.from[1]) * self.along[1]
    }
}

/// Fits the line of one camera's stream.
pub(crate) struct LineFinder {
    /// The axes relative to the region.
    axes: Axes,
    /// A triangle's legs are shorter than this, px.
    leg_most_px: f32,
    // Lists that are kept from frame to frame.
    /// Length of edge for which each coarse edge point stands, px.
    edge_weights: Vec<f32>,
    /// Edge points on the profiles, px in the region.
    points: Vec<[f32; 2]>,
    /// How much each of them is trusted, 0 to 1.
    trusts: Vec<f32>,
    /// Weight of each of them in the fit.
    weights: Vec<f32>,
    /// Contrast at each of them, grey levels.
    contrasts: Vec<f32>,
    /// Widths of the edge on the profiles that tell it, px.
    widths_px: Vec<f32>,
    /// Distances whose median is taken.
    scratch: Vec<f32>,
}

impl LineFinder {
    /// For a region of `size_px`; `axes` are relative to it.
    pub(crate) fn new(axes: Axes, size_px: [i32; 2]) -> Self {
        Self {
            axes,
            leg_most_px: 2.0 * (size_px[0] + size_px[1]) as f32,
            edge_weights: Vec::with_capacity(RAYS),
            points: Vec::with_capacity(PROFILES),
            trusts: Vec::with_capacity(PROFILES),
            weights: Vec::with_capacity(PROFILES),
            contrasts: Vec::with_capacity(PROFILES),
            widths_px: Vec::with_capacity(PROFILES),
            scratch: Vec::with_capacity(RAYS.max(PROFILES)),
        }
    }

    /// Forgets the points of the last picture.
    pub(crate) fn clear(&mut self) {
        self.points.clear();
    }

    /// The points to which the last line was fitted, px in the region.
    pub(crate) fn points_px(&self) -> &[[f32; 2]] {
        &self.points
    }

    /// A first line through the coarse edge points, which are ordered from the x-axis to the y-axis.
    pub(crate) fn first_line(&mut self, edges: &[[f32; 2]]) -> Option<FirstLine> {
        let near_px = self.weigh(edges);
        let (support, line) = self.best_pair(edges, near_px)?;
        let inliers = support / self.edge_weights.iter().sum::<f32>();
        let points = edges.iter().copied().zip(self.edge_weights.iter().copied());
        let line = Line::fit(points.filter(|(p, _)| line.offset(*p).abs() < near_px))?;
        let legs_px = self.axes.legs_px(&line);
        let sane = legs_px.iter().all(|leg| *leg > 1.0 && *leg < self.leg_most_px);
        (sane && inliers >= INLIERS_LEAST).then_some(FirstLine { line, legs_px, inliers })
    }

    /// Weighs the coarse edge points by their distance from their nearer neighbour, so that every part of the edge counts by its length,
    /// and one that is far from both neighbours is alone. Returns the distance within which a point lies near a line, px.
    fn weigh(&mut self, edges: &[[f32; 2]]) -> f32 {
        let count = edges.len();
        self.edge_weights.clear();
        self.scratch.clear();
        for i in 0..count {
            let here = edges[i];
            let before = if i > 0 { distance(here, edges[i - 1]) } else { f32::MAX };
            let after = if i + 1 < count { distance(here, edges[i + 1]) } else { f32::MAX };
            self.edge_weights.push(before.min(after).min(WEIGHT_MOST_PX) + 0.05);
            self.scratch.push(distance(here, self.axes.lip_px));
        }
        (NEAR_SHARE * median(&mut self.scratch)).max(NEAR_LEAST_PX)
    }

    /// Of the lines through pairs of edge points the one with most edge near it, and how much that is.
    fn best_pair(&self, edges: &[[f32; 2]], near_px: f32) -> Option<(f32, Line)> {
        let pick = |i: usize| edges[i * (edges.len() - 1) / (PICKS - 1)];
        let mut best: Option<(f32, Line)> = None;
        for i in 0..PICKS {
            for j in i + PICKS / 4..PICKS {
                let (a, b) = (pick(i), pick(j));
                let length = distance(a, b);
                if length < 1.0 {
                    continue;
                }
                let line = Line::through(a, b, length);
                let near = edges.iter().zip(&self.edge_weights).filter(|(p, _)| line.offset(**p).abs() < near_px);
                let support: f32 = near.map(|(_, w)| w).sum();
                if best.is_none_or(|(s, ..)| support > s) {
                    best = Some((support, line));
                }
            }
        }
        best
    }

    /// The line through the edge points on profiles across the first line; `seen_share` is the share of the edge that the liquid saw. There
    /// is none where too few profiles show an edge.
    pub(crate) fn fine_line(
        &mut self,
        first: &FirstLine,
        seen_share: f32,
        edges: &[[f32; 2]],
        pixels: RegionPixels,
        liquid: &dyn Liquid,
    ) -> Option<FineLine> {
        self.read_profiles(first, edges, pixels, liquid);
        let used = self.points.len() as f32 / PROFILES as f32;
        if used < liquid.rules().profiles_least {
            return None;
        }
        let contrast = median(&mut self.contrasts);
        let width_px = if self.widths_px.is_empty() { SHARP_PX } else { median(&mut self.widths_px) };
        let line = self.fit(first.line);
        let legs_px = self.axes.legs_px(&line);
        let sharp = (BLURRED_PX / width_px.max(0.5)).min(1.0);
        let confidence = first.inliers.min(1.0) * seen_share.min(1.0) * used * (contrast / FULL_CONTRAST).min(1.0) * sharp;
        let sane = legs_px.iter().all(|leg| *leg > 0.0 && *leg < self.leg_most_px);
        sane.then_some(FineLine { legs_px, contrast, width_px, confidence })
    }

    /// Reads profiles across the first line and collects the edge point on each.
    fn read_profiles(&mut self, first: &FirstLine, edges: &[[f32; 2]], pixels: RegionPixels, liquid: &dyn Liquid) {
        let across = Across::new(&self.axes, first);
        let lip_px = first.line.offset(self.axes.lip_px).abs();
        let spacing_px = (lip_px / SPACINGS).clamp(SPACING_PX[0], SPACING_PX[1]);
        let margin_px = (MARGIN_SHARE * lip_px).clamp(MARGIN_PX[0], MARGIN_PX[1]);
        self.points.clear();
        self.trusts.clear();
        self.contrasts.clear();
        self.widths_px.clear();
        let mut next = 0;
        for k in 0..PROFILES {
            let s = across.length * (k as f32 + 0.5) / PROFILES as f32;
            while next < edges.len() && across.place(edges[next]) < s {
                next += 1;
            }
            let Some(coarse) = coarse_offset(&across, &first.line, edges, next, s) else { continue };
            let centre_px = [0, 1].map(|k| across.from[k] + s * across.along[k] + coarse * across.outwards[k]);
            let Some(profile) = read_profile(pixels, centre_px, across.outwards, spacing_px) else { continue };
            let Some(edge) = liquid.edge_on(&profile) else { continue };
            self.widths_px.extend(edge.width_samples.map(|width| width * spacing_px));
            // Beyond the axes the outline bends inwards, so only what lies between them counts.
            let point = profile.place_px(edge.sample);
            if self.axes.between(point) >= margin_px {
                self.points.push(point);
                self.contrasts.push(edge.contrast);
                self.trusts.push(edge.trust);
            }
        }
    }

    /// A line with Huber weights through the edge points, from the first line on.
    fn fit(&mut self, first: Line) -> Line {
        self.weights.clear();
        self.weights.extend_from_slice(&self.trusts);
        let mut fitted = first;
        for _ in 0..ROUNDS {
            let Some(next) = Line::fit(self.points.iter().copied().zip(self.weights.iter().copied())) else { break };
            fitted = next;
            self.scratch.clear();
            self.scratch.extend(self.points.iter().map(|p| fitted.offset(*p).abs()));
            let limit = (HUBER_MEDIANS * median(&mut self.scratch)).max(HUBER_LEAST_PX);
            for ((weight, p), trust) in self.weights.iter_mut().zip(&self.points).zip(&self.trusts) {
                *weight = trust * (limit / fitted.offset(*p).abs().max(1e-6)).min(1.0);
            }
        }
        fitted
    }
}

/// The coarse edge's distance from the line at `s` along it, px outwards, from the two edge points around; `next` is the first of them
/// that lies beyond.
fn coarse_offset(across: &Across, line: &Line, edges: &[[f32; 2]], next: usize, s: f32) -> Option<f32> {
    let offset = |i: usize| line.offset(edges[i]) * across.side;
    match (next.checked_sub(1), edges.get(next)) {
        (Some(i), Some(_)) => {
            let (s0, s1) = (across.place(edges[i]), across.place(edges[next]));
            let t = if s1 > s0 { ((s - s0) / (s1 - s0)).clamp(0.0, 1.0) } else { 0.5 };
            Some(offset(i) * (1.0 - t) + offset(next) * t)
        }
        (None, Some(_)) => Some(offset(next)),
        (Some(i), None) => Some(offset(i)),
        (None, None) => None,
    }
}

/// Reads one profile. There is none if it leaves the region.
#[inline(always)]
fn read_profile(pixels: RegionPixels, centre_px: [f32; 2], outwards: [f32; 2], spacing_px: f32) -> Option<Profile> {
    let mut profile = Profile { colours: [[0.0; 3]; PROFILE_SAMPLES], centre_px, outwards, spacing_px };
    for j in 0..PROFILE_SAMPLES {
        let d = (j as f32 - REACH as f32) * spacing_px;
        profile.colours[j] = pixels.at(centre_px[0] + d * outwards[0], centre_px[1] + d * outwards[1])?;
    }
    Some(profile)
}
