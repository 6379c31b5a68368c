//! The lines from axis to axis that are tried for the stream's outline, and the best of them.
//!
//! Of about 800 lines the best has most of the evidence just inside and none outside. The line of a stream that goes on lies near the
//! stream's last line, with nearly the same shape and the same band along it.
//!
//! Called on the extraction thread, within a `pulp` dispatch: what is marked `inline(always)` runs with the processor's widest registers.
//! Nothing is allocated after the start. The only failures are OpenCV's.

use opencv::core::{Size, Vec4b};

use super::evidence::Evidence;
use super::rays::{Colour, RAYS, Rays, SAMPLES, each, size_of};
use super::rigid::RigidMap;
use super::water::{BEGIN_GROUND, Candidate, EarlierPicture, Stream};
use crate::vision::geometry::{Axes, distance};

// "Tuned" below means that the value was tuned on seeds 101 to 104 of `evaluate-camera`; see docs/VISION.md.

/// Number of distances from the lip that are tried on each axis. Chosen by hand: they reach across the region.
const LEGS: usize = 41;
/// The shortest distance on an axis that is tried, px. Tuned.
const LEG_FIRST_PX: f32 = 6.5;
/// Each distance on an axis in units of the one before. Tuned.
const LEG_FACTOR: f32 = 1.08;
/// Largest ratio of the leg on the x-axis to that on the y-axis. Tuned.
const LEGS_FLAT: f32 = 4.0;
/// Largest ratio of the leg on the y-axis to that on the x-axis. Tuned.
const LEGS_STEEP: f32 = 2.0;
/// Least evidence of a sample of the line that counts as edge. Tuned.
const EDGE_LEAST: f32 = 0.35;
/// Weight of the share of the line that has an edge. Tuned.
const EDGE_WEIGHT: f32 = 0.7;
/// Weight of lying further out, per unit of the logarithm of the distance, because there are edges within the water too. Tuned.
const OUTERMOST: f32 = 0.3;
/// Weight of being like the last line, a product of Gaussians of how much it has grown and turned. Tuned.
const STAY: f32 = 0.4;
/// A stream grows or shrinks by about this from frame to frame: the logarithm of the root of the legs' product. Tuned.
const GROWS: f32 = 0.25;
/// A stream grows or shrinks by no more than this from frame to frame, as a logarithm. Tuned.
const GROWS_MOST: f32 = 0.7;
/// A stream that is not far from leaving the region may have done so in the next picture if its legs grow by this factor. Chosen by hand: one that begins
/// grows faster, and is small.
const OUTGROWS: f32 = 1.55;
/// What a stream may change grows with the pictures in which it was not seen, up to so many. Chosen by hand: then it may have grown ten times as long.
const LOST_MOST: u32 = 10;
/// A stream changes its shape by about this from frame to frame: the logarithm of the legs' ratio. Tuned; in the renderer the ratio changes
/// by no more than 15 % a frame.
const TURNS: f32 = 0.2;
/// A stream that was seen once changes its shape by this much more, and one that was seen n times by an n-th of this. Tuned.
const TURNS_YOUNG: f32 = 0.3;
/// A stream changes its shape by no more than this many times its usual change. Tuned.
const TURNS_MOST: f32 = 2.5;
/// Weight of an even band along the line, and of the same band as before. Tuned.
const BAND: f32 = 0.5;
/// The edge on a ray is looked for within this many samples of the line. Tuned.
const EDGE_REACH: usize = 2;

/// The lines that are tried, and where each lies on the rays.
pub(super) struct Lines {
    /// The axes in the small region.
    axes: Axes,
    /// Each line's cuts with the x-axis and the y-axis, px.
    legs_px: Vec<[f32; 2]>,
    /// The largest of them on either axis.
    most_px: [f32; 2],
    /// The logarithms of `legs_px`.
    log_legs: Vec<[f32; 2]>,
    /// Each line's sample on each ray, counted over all rays.
    cells: Vec<[u16; RAYS]>,
    /// Each line's weight on each ray: the share of its length there.
    weights: Vec<[f32; RAYS]>,
}

/// How a line differs from the stream's line in the last frame.
#[derive(Debug, Clone, Copy)]
struct Change {
    /// Growth: the logarithm of the root of the legs' product.
    grown: f32,
    /// Change of shape: the logarithm of the legs' ratio.
    turned: f32,
    /// How much the stream usually changes its shape, in the same unit.
    turns: f32,
}

impl Change {
    /// `since` is for how many pictures nothing was seen of the stream, as a factor on what it may change.
    #[inline(always)]
    fn new([p, q]: [f32; 2], [a, b]: [f32; 2], turns: f32, since: f32) -> Self {
        Self { grown: 0.5 * (p + q - a - b) / since, turned: (p - q - a + b) / since, turns }
    }

    #[inline(always)]
    fn is_too_large(&self) -> bool {
        self.grown.abs() > GROWS_MOST || self.turned.abs() > TURNS_MOST * self.turns
    }

    /// What a line gains by being like the last one.
    #[inline(always)]
    fn bonus(&self) -> f32 {
        STAY * (-0.5 * (square(self.grown / GROWS) + square(self.turned / self.turns))).exp()
    }
}

#[inline(always)]
fn square(v: f32) -> f32 {
    v * v
}

impl Lines {
    /// The lines between `axes` in a small picture of `size`.
    pub(super) fn new(axes: Axes, rays: &Rays, size: Size) -> Self {
        let Axes { x, y, .. } = axes;
        let (directions, sine) = (&rays.directions, axes.sine());
        let (mut legs_px, mut cells, mut weights) = (Vec::new(), Vec::new(), Vec::new());
        for i in 0..LEGS * LEGS {
            let leg = |k: usize| LEG_FIRST_PX * LEG_FACTOR.powi(k as i32);
            let (a, b) = (leg(i / LEGS), leg(i % LEGS));
            if a / b > LEGS_FLAT || b / a > LEGS_STEEP {
                continue;
            }
            // Where each ray meets the line. A ray's direction is u x + v y, and u / a + v / b = 1 on the line.
            let crossings: Vec<f32> = directions
                .iter()
                .map(|d| {
                    let (u, v) = ((d[0] * y[1] - d[1] * y[0]) / sine, (x[0] * d[1] - x[1] * d[0]) / sine);
                    1.0 / (u / a + v / b)
                })
                .collect();
            let point = |k: usize| axes.at(crossings[k], directions[k]);
            let fits = (0..RAYS).all(|k| {
                let [px, py] = point(k);
                let inside = px >= 1.0 && py >= 1.0 && px < size.width as f32 - 2.0 && py < size.height as f32 - 2.0;
                crossings[k] < rays.radii_px[SAMPLES - 3] && inside
            });
            if !fits {
                continue;
            }
            let apart = |k: usize| distance(point(k), point(k + 1));
            // A ray's weight is the length of line around it. The rays beside the axes are left out.
            let weight = |k: usize| if k == 0 || k == RAYS - 1 { 0.0 } else { apart(k - 1) + apart(k) };
            let total: f32 = (0..RAYS).map(weight).sum();
            legs_px.push([a, b]);
            cells.push(std::array::from_fn(|k| (k * SAMPLES + rays.nearest(crossings[k])) as u16));
            weights.push(std::array::from_fn(|k| weight(k) / total));
        }
        let most_px = legs_px.iter().fold([0.0f32; 2], |most, legs: &[f32; 2]| [most[0].max(legs[0]), most[1].max(legs[1])]);
        Self { axes, most_px, log_legs: legs_px.iter().map(|l: &[f32; 2]| l.map(f32::ln)).collect(), legs_px, cells, weights }
    }

    /// Whether no line lies in the region.
    pub(super) fn is_empty(&self) -> bool {
        self.legs_px.is_empty()
    }

    /// Whether a stream with these legs, px, is so large that it may leave the region from one picture to the next.
    pub(super) fn may_leave(&self, legs_px: [f32; 2]) -> bool {
        (0..2).any(|k| legs_px[k] * OUTGROWS >= self.most_px[k])
    }

    /// The largest cuts with the x-axis and the y-axis of any line, px.
    pub(super) fn most_px(&self) -> [f32; 2] {
        self.most_px
    }

    /// Cuts of a line with the x-axis and the y-axis, px.
    pub(super) fn legs_px(&self, line: usize) -> [f32; 2] {
        self.legs_px[line]
    }

    /// A line's samples, counted over all rays, and its weight on each.
    #[inline(always)]
    fn along(&self, line: usize) -> impl Iterator<Item = (usize, f32)> + '_ {
        self.cells[line].iter().map(|at| usize::from(*at)).zip(self.weights[line])
    }

    /// The best line and what was found along it. `moved` is the background's motion since the earlier picture.
    #[inline(always)]
    pub(super) fn best(
        &self,
        evidence: &Evidence,
        rays: &Rays,
        moved: &RigidMap,
        stream: Option<&Stream>,
    ) -> opencv::Result<Option<Candidate>> {
        let seen = evidence.seen()?;
        let Some(stream) = stream else { return Ok(self.best_begin(evidence, seen)) };
        let before = stream.legs_px.map(f32::ln);
        let turns = TURNS + TURNS_YOUNG / stream.age;
        // Independent changes add up as their squares do.
        let since = (1.0 + stream.lost.min(LOST_MOST) as f32).sqrt();
        let mut best: Option<Candidate> = None;
        for line in 0..self.legs_px.len() {
            // A stream grows and shrinks fast, but hardly changes its shape from frame to frame.
            let change = Change::new(self.log_legs[line], before, turns, since);
            if change.is_too_large() {
                continue;
            }
            let mut found = Candidate { line, ..Candidate::default() };
            for (at, weight) in self.along(line) {
                let (value, known) = (evidence.value()[at], evidence.known()[at]);
                found.score += weight * value;
                found.known += weight * known;
                found.edge_share += if value > EDGE_LEAST { weight } else { 0.0 };
            }
            let outer = self.outer(line);
            found.evidence = found.score;
            let beats = |total: f32| best.is_none_or(|b| total > b.total);
            // The bonus is no larger than this, so without a chance it is not reckoned.
            if !beats(outer + found.score + EDGE_WEIGHT * found.edge_share + STAY) {
                continue;
            }
            let stay = change.bonus();
            // The band along the line can only cost, so without a chance it is not read.
            if !beats(outer + found.score + EDGE_WEIGHT * found.edge_share + stay) {
                continue;
            }
            let mean_square = self.read_band(&mut found, evidence, seen);
            found.score += (1.0 - found.known) * band_cost(&found, mean_square, stream, evidence.noise());
            found.total = outer + found.score + EDGE_WEIGHT * found.edge_share + stay;
            if beats(found.total) && !self.earlier_picture(line, evidence, rays, moved).shows_line() {
                best = Some(found);
            }
        }
        Ok(best)
    }

    /// The best line to begin a stream with.
    #[inline(always)]
    fn best_begin(&self, evidence: &Evidence, seen: &[Vec4b]) -> Option<Candidate> {
        let mut best: Option<Candidate> = None;
        for line in 0..self.legs_px.len() {
            let mut found = Candidate { line, ..Candidate::default() };
            for (at, weight) in self.along(line) {
                let (value, known) = (evidence.value()[at], evidence.known()[at]);
                found.score += weight * value;
                found.known += weight * known;
                found.edge_share += if value > EDGE_LEAST * known { weight * known } else { 0.0 };
            }
            if found.known < BEGIN_GROUND {
                continue;
            }
            found.score /= found.known;
            found.edge_share /= found.known;
            found.total = self.outer(line) + found.score + EDGE_WEIGHT * found.edge_share;
            if best.is_none_or(|b| found.total > b.total) {
                best = Some(found);
            }
        }
        if let Some(found) = &mut best {
            self.read_band(found, evidence, seen);
        }
        best
    }

    /// What a line gains by lying further out.
    #[inline(always)]
    fn outer(&self, line: usize) -> f32 {
        let [p, q] = self.log_legs[line];
        OUTERMOST * 0.5 * (p + q)
    }

    /// Reads the band along a line into `found`. Returns the mean square of its colours.
    #[inline(always)]
    fn read_band(&self, found: &mut Candidate, evidence: &Evidence, seen: &[Vec4b]) -> f32 {
        let mut mean_square = 0.0;
        for (at, weight) in self.along(found.line) {
            let band = band_at(seen, evidence.steps(), at);
            found.band = each(|k| found.band[k] + weight * band[k]);
            mean_square += weight * square(size_of(&band));
        }
        mean_square
    }

    /// What the moved earlier picture says of a line.
    pub(super) fn earlier_picture(&self, line: usize, evidence: &Evidence, rays: &Rays, moved: &RigidMap) -> EarlierPicture {
        let [a, b] = self.legs_px[line];
        let along = [0, 1].map(|k| b * self.axes.y[k] - a * self.axes.x[k]);
        let length = along[0].hypot(along[1]);
        let [mut travels_px, mut crosses_px, mut shown, mut unexplained] = [0.0; 4];
        for (at, weight) in self.along(line) {
            let place = rays.places[at];
            let to = moved.apply(place);
            let [dx, dy] = [to[0] - place[0], to[1] - place[1]];
            travels_px += weight * dx.hypot(dy);
            crosses_px += weight * (dy * along[0] - dx * along[1]).abs() / length;
            shown += weight * evidence.shown_around()[at];
            unexplained += weight * evidence.unexplained()[at];
        }
        EarlierPicture { travels_px, crosses_px, shown, unexplained: unexplained / shown.max(0.05) }
    }

    /// The edge on each ray near `line`, px of the small picture, added to `edges` as `full` makes it.
    #[inline(always)]
    pub(super) fn edges(&self, line: usize, evidence: &Evidence, rays: &Rays, full: impl Fn(f32) -> f32, edges: &mut Vec<[f32; 2]>) {
        for ray in 1..RAYS - 1 {
            let middle = usize::from(self.cells[line][ray]) - ray * SAMPLES;
            let row = &evidence.value()[ray * SAMPLES..][..SAMPLES];
            let range = middle.saturating_sub(EDGE_REACH)..(middle + EDGE_REACH + 1).min(SAMPLES);
            let best = range.clone().map(|i| row[i]).fold(f32::MIN, f32::max);
            // Of equal neighbours the middle is taken; without an edge here, the line itself is.
            let (mut sum, mut count) = (0usize, 0usize);
            for i in range.filter(|i| best > EDGE_LEAST && row[*i] >= best - 1e-6) {
                (sum, count) = (sum + i, count + 1);
            }
            let sample = if count == 0 { middle as f32 } else { sum as f32 / count as f32 };
            // The edge lies half a step further out.
            let (at, part) = ((sample + 0.5) as usize, (sample + 0.5).fract());
            let [before, after] = [at, at + 1].map(|r| rays.radii_px[r.min(SAMPLES - 1)]);
            let radius = before + part * (after - before);
            edges.push(self.axes.at(radius, rays.directions[ray]).map(&full));
        }
    }
}

/// The colour just inside a sample, and last the step there.
#[inline(always)]
fn band_at(seen: &[Vec4b], steps: &[f32], at: usize) -> Colour {
    let (Some(a), Some(b)) = (seen.get(at.wrapping_sub(2)), seen.get(at.wrapping_sub(1))) else { return [0.0; 4] };
    let mean = |k: usize| 0.5 * (f32::from(a[k]) + f32::from(b[k]));
    [mean(0), mean(1), mean(2), steps[at]]
}

/// What the band along a line costs, 0 or less: along a stream's outline the same room is seen, whatever stands behind, and the same as in
/// the last frame. `mean_square` is the mean square of its colours.
#[inline(always)]
fn band_cost(found: &Candidate, mean_square: f32, stream: &Stream, noise: f32) -> f32 {
    let spread = (mean_square - square(size_of(&found.band))).max(0.0);
    let unit = 0.5 * found.band[3] + 2.0 * noise;
    let change = size_of(&each(|k| found.band[k] - stream.band[k])) / unit;
    BAND * ((-spread / (unit * unit)).exp() - 1.0) + BAND * ((-change * change).exp() - 1.0)
}
