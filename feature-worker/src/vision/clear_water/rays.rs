//! The rays along which clear water is looked for, and arithmetic on all samples of a ray at once.
//!
//! The small functions are inlined into the evidence, which runs with the processor's widest registers; for that reason they have no
//! branches. Called on the extraction thread. Nothing is allocated after the start and nothing fails.

use opencv::core::{Size, Vec4b};

use crate::vision::geometry::Axes;

/// Rays between the axes. Tuned on seeds 101 to 104 of `evaluate-camera`, see docs/VISION.md.
pub(super) const RAYS: usize = 24;
/// Samples on each ray. Chosen by hand: they reach across the region.
pub(super) const SAMPLES: usize = 96;
/// Samples of all rays together.
pub(super) const CELLS: usize = RAYS * SAMPLES;
/// Distance of the first sample from the lip, px. Chosen by hand; no measurement is recorded.
const NEAR_PX: f32 = 1.0;
/// Samples lie 1 px apart up to this distance from the lip, px, and then in proportion to their distance. Chosen by hand; no measurement
/// is recorded.
const DENSE_PX: f32 = 48.0;
/// Air begins this far above the rim, px, because the rim's light spreads. Tuned on seeds 101 to 104 of `evaluate-camera`, see
/// docs/VISION.md.
pub(super) const RIM_PX: f32 = 1.5;

/// A colour's three parts in grey levels, and one more number: four for the processor's sake.
pub(super) type Colour = [f32; 4];
/// A value for each sample of a ray.
pub(super) type Row = [f32; SAMPLES];
/// The colours along a ray, each part by itself, and 0 at the end.
pub(super) type Colours = [[f32; SAMPLES + 1]; 3];
/// Sums along a ray up to before each sample, with what windows reach beyond its ends.
type Sums = [f32; LEAD + SAMPLES + 1 + TAIL];

/// How far windows reach before a ray's first sample, samples.
const LEAD: usize = 4;
/// How far windows reach beyond a ray's last sample, samples.
const TAIL: usize = 25;

/// The rays of a small picture.
pub(super) struct Rays {
    /// Unit vector of each ray, from the x-axis to the y-axis.
    pub(super) directions: Vec<[f32; 2]>,
    /// Distance of each of a ray's samples from the lip, px.
    pub(super) radii_px: Row,
    /// Each ray sample's place, px, and then the place 1 px beside each.
    pub(super) places: Vec<[f32; 2]>,
    /// 1 where a sample is in the air, 0 where it is glass or outside of the picture.
    pub(super) air: Vec<f32>,
}

impl Rays {
    /// The rays of `axes` in a picture of `size`.
    pub(super) fn new(axes: &Axes, size: Size) -> Self {
        let ([lip_x, lip_y], x) = (axes.lip_px, axes.x);
        let turn = axes.sine().signum();
        let directions: Vec<[f32; 2]> = axes.rays(RAYS).collect();
        let mut radii_px = [NEAR_PX; SAMPLES];
        for r in 1..SAMPLES {
            radii_px[r] = radii_px[r - 1] + step_px(radii_px[r - 1]);
        }
        let (mut places, mut air) = (Vec::with_capacity(2 * CELLS), Vec::with_capacity(CELLS));
        for along in &directions {
            for r in &radii_px {
                let above = (x[0] * along[1] - x[1] * along[0]) * turn * r;
                // Samples beyond the region repeat its border and belong to no line.
                let place = [
                    (lip_x + r * along[0]).clamp(1.0, size.width as f32 - 2.01),
                    (lip_y + r * along[1]).clamp(1.0, size.height as f32 - 2.01),
                ];
                places.push(place);
                air.push(if above >= RIM_PX && place == [lip_x + r * along[0], lip_y + r * along[1]] { 1.0 } else { 0.0 });
            }
        }
        for i in 0..CELLS {
            let ([x, y], along) = (places[i], directions[i / SAMPLES]);
            places.push([x - along[1], y + along[0]]);
        }
        Self { directions, radii_px, places, air }
    }

    /// The sample nearest to a distance from the lip, px.
    pub(super) fn nearest(&self, radius_px: f32) -> usize {
        self.radii_px.partition_point(|at| 0.5 * (at + (at + step_px(*at))) < radius_px)
    }

    /// The first sample at a distance from the lip or beyond it, px.
    #[inline(always)]
    pub(super) fn first_from(&self, radius_px: f32) -> usize {
        self.radii_px.partition_point(|r| *r < radius_px)
    }
}

/// Distance from a sample to the next, px.
fn step_px(radius_px: f32) -> f32 {
    (radius_px / DENSE_PX).max(1.0)
}

/// A colour from each of its four numbers.
#[inline(always)]
pub(super) fn each(f: impl Fn(usize) -> f32) -> Colour {
    [f(0), f(1), f(2), f(3)]
}

/// Size of a difference of colours, grey levels: that of an equal difference of all three parts.
#[inline(always)]
pub(super) fn size_of(c: &Colour) -> f32 {
    ((c[0] * c[0] + c[1] * c[1] + c[2] * c[2]) * (1.0 / 3.0)).sqrt()
}

/// A value for each sample of a ray. `std::array::from_fn` is not used, because it calls `f` out of line for so many values.
#[inline(always)]
pub(super) fn row(f: impl Fn(usize) -> f32) -> Row {
    let mut row = [0.0; SAMPLES];
    for (r, value) in row.iter_mut().enumerate() {
        *value = f(r);
    }
    row
}

/// The colours of a row of pixels, times `factors`.
#[inline(always)]
pub(super) fn colours(row: &[Vec4b], factors: &Row) -> Colours {
    let mut colours = [[0.0; SAMPLES + 1]; 3];
    for (r, (pixel, factor)) in row.iter().zip(factors).enumerate() {
        for k in 0..3 {
            colours[k][r] = factor * f32::from(pixel[k]);
        }
    }
    colours
}

/// The colours as a sensor gives them, which is full at 255.
#[inline(always)]
pub(super) fn cut_off(mut colours: Colours) -> Colours {
    for part in &mut colours {
        part.iter_mut().for_each(|level| *level = level.min(255.0));
    }
    colours
}

/// Size of the colours at each place, grey levels.
#[inline(always)]
pub(super) fn sizes(c: &Colours) -> Row {
    row(|r| ((c[0][r] * c[0][r] + c[1][r] * c[1][r] + c[2][r] * c[2][r]) * (1.0 / 3.0)).sqrt())
}

/// For colours that were mixed with unknown ones: the factors that make them whole again, times `gain`, and whether they are known (1 or
/// 0). Colours of which less than half is known count as unknown.
#[inline(always)]
pub(super) fn whole(row: &[Vec4b], gain: f32) -> (Row, [f32; SAMPLES + 1]) {
    let (mut factors, mut known) = ([0.0; SAMPLES], [0.0; SAMPLES + 1]);
    for (r, pixel) in row.iter().take(SAMPLES).enumerate() {
        let share = f32::from(pixel[3]) * (1.0 / 255.0);
        known[r] = if share >= 0.5 { 1.0 } else { 0.0 };
        factors[r] = known[r] * gain / share.max(0.5);
    }
    (factors, known)
}

/// How far the colours of two rows lie from each other where they are `shown`, grey levels. The difference at each sample is averaged with
/// that at the next one, if that is shown too.
#[inline(always)]
pub(super) fn apart(a: &Colours, b: &Colours, shown: &[f32; SAMPLES + 1]) -> Row {
    let mut away = [[0.0; SAMPLES + 1]; 3];
    for k in 0..3 {
        for r in 0..SAMPLES {
            away[k][r] = shown[r] * (a[k][r] - b[k][r]);
        }
    }
    let mut pairs = [[0.0; SAMPLES + 1]; 3];
    for k in 0..3 {
        for r in 0..SAMPLES {
            pairs[k][r] = (away[k][r] + away[k][r + 1]) / (shown[r] + shown[r + 1]).max(1.0);
        }
    }
    let size = sizes(&pairs);
    row(|r| shown[r] * size[r])
}

/// The larger of each value and its neighbours, because the outline is a little curved.
#[inline(always)]
pub(super) fn around(row: &Row) -> Row {
    let mut largest = *row;
    for r in 1..SAMPLES {
        largest[r] = largest[r].max(row[r - 1]);
        largest[r - 1] = largest[r - 1].max(row[r]);
    }
    largest
}

/// Sums of a row, from which windows take their means.
#[inline(always)]
pub(super) fn sums(row: &Row) -> Sums {
    let mut sums = [0.0; LEAD + SAMPLES + 1 + TAIL];
    let mut sum = 0.0;
    for (total, value) in sums[LEAD + 1..].iter_mut().zip(row) {
        sum += value;
        *total = sum;
    }
    sums[LEAD + SAMPLES + 1..].fill(sum);
    sums
}

/// The samples from `from` to before `to` of each sample of a ray, as far as they lie on it.
pub(super) struct Window {
    from: isize,
    to: isize,
    per_length: Row,
}

impl Window {
    /// The window from `from` to before `to`, samples.
    pub(super) const fn new(from: isize, to: isize) -> Self {
        assert!(from >= -(LEAD as isize) && to <= TAIL as isize);
        let mut per_length = [1.0; SAMPLES];
        let mut at = 0;
        while at < SAMPLES {
            let (mut first, mut last) = (at as isize + from, at as isize + to);
            if first < 0 {
                first = 0;
            }
            if last > SAMPLES as isize {
                last = SAMPLES as isize;
            }
            if last > first + 1 {
                per_length[at] = 1.0 / (last - first) as f32;
            }
            at += 1;
        }
        Self { from, to, per_length }
    }

    /// Mean over the window at each sample.
    #[inline(always)]
    pub(super) fn mean(&self, sums: &Sums) -> Row {
        let (from, to) = (LEAD.wrapping_add_signed(self.from), LEAD.wrapping_add_signed(self.to));
        let (first, last) = (&sums[from..from + SAMPLES], &sums[to..to + SAMPLES]);
        row(|r| (last[r] - first[r]) * self.per_length[r])
    }
}
