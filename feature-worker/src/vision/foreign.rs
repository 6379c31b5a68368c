//! What lies at the lip, or beside a coloured stream, and has the colours of neither the ground nor the liquid: it may be a liquid whose
//! colours have left their range, or ground that was never seen.
//!
//! Called on the extraction thread. Nothing is allocated; the only failures are OpenCV's.

use opencv::core::{Mat, Vec3b};
use opencv::prelude::*;

use super::geometry::{Axes, NEAR_PX, RAYS, RayGrid};
use super::ground_colours::{Ground, GroundColours, Mean};
use super::stream_edge::LineFinder;

// "Tuned" below means that the value was tuned on seeds 1 and 5001 to 5003 of `evaluate-camera`; see docs/VISION.md.

/// This close to the lip a stream begins, px. Chosen by hand.
const AT_LIP_PX: f32 = 12.0;
/// So far from the lip white light may be a lamp's reflection before ground that is white too, px. Chosen by hand: where its glow is cut off.
const REFLECTION_PX: f32 = 16.0;
/// A liquid in front of a lamp's reflection is brighter than this in all parts, close to the reflection's middle. Chosen by hand.
const GLOW_LEVEL: u8 = 180;
/// The ground is learned from samples at least this far from the lip, px, once it is known: nearer, a stream
/// begins. Chosen by hand.
pub(super) const LEARN_FROM_PX: f32 = 48.0;
/// More background than this before the first liquid, or the first of a body, ends a ray, px. Tuned.
const GAP_MOST_PX: f32 = 24.0;
/// Least share of liquid, or of a body, between lip and edge on a ray that counts as filled. Tuned.
pub(super) const FILLED: f32 = 0.55;
/// With more than this share of rays full of liquid to the region's border, the area is a lower bound. Chosen by hand.
pub(super) const LEAVES_SHARE: f32 = 0.06;
/// Least share of the rays that a body at the lip fills. Tuned.
const BODY_RAYS: f32 = 0.7;
/// Least mean length of a body at the lip, px: a bead is shorter. Tuned.
const BODY_PX: f32 = 9.0;
/// Least share of a body that has foreign colours. Tuned.
const BODY_FOREIGN: f32 = 0.3;
/// A body's colour is known when this share of the rays that it fills show it close to the lip. Chosen by hand: on fewer it may be that of an edge.
const COLOUR_RAYS: f32 = 0.5;
/// This far beyond the stream's edge there is ground, px. Chosen by hand: further than a strong blur reaches.
const BEYOND_PX: f32 = 8.0;
/// And so many samples beyond it: the squares of samples that are smoothed together reach two. Chosen by hand.
const BEYOND_SAMPLES: usize = 4;
/// With this share of foreign colours beside the stream, its edge is not where the liquid ends. Tuned.
const BEYOND_FOREIGN: f32 = 0.5;
/// With more than this much liquid beyond a stream's edge, px, ... Chosen by hand: more than specks.
const CUT_PX: f32 = 6.0;
/// ... no further from the edge than this, px, ... Chosen by hand: a streak of 40 px, and a part beyond it.
const CUT_WITHIN_PX: f32 = 48.0;
/// ... on more than this share of the rays, something cuts the stream in two. Chosen by hand: more than a drop beside it.
const CUT_RAYS: f32 = 0.4;
/// What is foreign may be the liquid when it is no further from its colour than this share of the distance from there to the ground's mean
/// colour: a thin stream shows the ground through itself. Chosen by hand.
const LIKE_LIQUID: f32 = 0.5;
/// What is foreign may be the liquid in a lamp's reflection when it is brighter than it in all parts by more than this, grey levels. Chosen by
/// hand: more than an exposure's drift.
const LIT_LEVELS: f32 = 8.0;
/// And when the part that is brighter by least is so by this share of the one that is by most. Chosen by hand: where the most is cut off, it is
/// less.
const LIT_SHARE: f32 = 0.4;
/// What is foreign may be the liquid, with the ground seen through it, when its shares of blue, green and red differ from the ground's in the same
/// direction as the liquid's do: the cosine of the angle between. Chosen by hand: ground of several colours has no one mean.
const MIXED_COSINE: f32 = 0.8;
/// And no further than this share of the way to the liquid's. Chosen by hand: a little beyond it.
const MIXED_MOST: f32 = 1.15;
/// Just beyond a stream's edge no more than this share of the way is the edge's blur, and no stream that goes on in other colours. Chosen by hand: before an
/// even wall 0.13 was seen, and of a stream that is no more of one there is nothing to measure.
const BLUR_SHARE: f32 = 0.25;
/// Shares that differ by less than this tell no direction. Chosen by hand: two steps of the ground's table.
const MIXED_LEAST: f32 = 0.03;
/// Two mean colours are one when they differ by no more than these levels, and [`ALIKE_SHARE`] of their mean level. Chosen by hand.
const ALIKE_LEVELS: f32 = 5.0;
/// See [`ALIKE_LEVELS`]. Chosen by hand: what a vignette and a lamp's fall-off make over 40 px.
const ALIKE_SHARE: f32 = 0.08;
/// What is foreign goes on beside the container when this share of both halves of the square there has its colour. Chosen by hand: a thick jet
/// covers more than this of the whole square.
const GOES_ON: f32 = 0.6;

/// A picture along the rays.
pub(super) struct Seen<'a> {
    pub(super) grid: &'a RayGrid,
    /// Not 0 where there is liquid.
    pub(super) mask: &'a Mat,
    /// Smoothed colours.
    pub(super) smooth: &'a Mat,
    pub(super) ground: &'a GroundColours,
}

/// What a liquid in other colours may look like although the ground has these colours too.
#[derive(Default)]
pub(super) struct Otherwise<'a> {
    /// Not 0 where the picture has the liquid's colours in a limited range of levels.
    pub(super) limited: Option<&'a Mat>,
    /// Whether it may be black.
    pub(super) black: bool,
}

/// Something foreign that lies at the lip like a stream.
pub(super) struct Body {
    /// Its mean colour close to the lip, if it shows it there.
    pub(super) colour: Option<[f32; 3]>,
}

impl Seen<'_> {
    /// The last sample of liquid on a ray and the score there: px of liquid minus px of background, at its largest. A lamp's reflection
    /// near the lip counts as neither, and so does white ground that it may be.
    #[inline(always)]
    pub(super) fn last_liquid(&self, ray: usize) -> opencv::Result<Option<(usize, f32)>> {
        let mask = &self.mask.at_row::<u8>(ray as i32)?[..self.grid.rays[ray].samples];
        let colours = self.smooth.at_row::<Vec3b>(ray as i32)?;
        let (mut score, mut best, mut last) = (0.0f32, 0.0f32, None);
        for (r, (value, step)) in mask.iter().zip(&self.grid.steps_px).enumerate() {
            if *value != 0 {
                score += *step;
            } else if self.grid.radii_px[r] > LEARN_FROM_PX || !(self.ground.is_blind(colours[r].0) || self.is_hidden(r, colours[r].0)) {
                score -= *step;
            }
            if score > best {
                (best, last) = (score, Some(r));
            } else if score < -GAP_MOST_PX {
                break;
            }
        }
        Ok(last.map(|r| (r, best)))
    }

    /// What lies at the lip like a stream and is foreign, if something does. Writes its ends into `ends`.
    pub(super) fn body(&self, ends: &mut [usize; RAYS], otherwise: &Otherwise) -> opencv::Result<Option<Body>> {
        let (mut filled, mut foreign, mut samples, mut length_px) = (0usize, 0usize, 0usize, 0.0f32);
        let (mut shown, mut mean) = (0usize, Mean::default());
        for (i, ray) in self.grid.rays.iter().enumerate() {
            let mask = self.mask.at_row::<u8>(i as i32)?;
            let colours = self.smooth.at_row::<Vec3b>(i as i32)?;
            let limited = otherwise.limited.map(|limited| limited.at_row::<u8>(i as i32)).transpose()?;
            let tell = |r: usize| match self.ground.tell(colours[r].0) {
                // Only white light may be a lamp's reflection.
                Ground::Blind if !GroundColours::is_white(colours[r].0) => Ground::Foreign,
                _ if limited.is_some_and(|limited| limited[r] != 0) => Ground::Foreign,
                _ if otherwise.black && GroundColours::is_dark(colours[r].0) => Ground::Foreign,
                ground => ground,
            };
            let (mut score, mut best, mut end, mut strange, mut strange_at_end) = (0.0f32, 0.0f32, 0usize, 0usize, 0usize);
            let (mut own, mut own_at_end) = (Mean::default(), Mean::default());
            for r in 0..ray.samples {
                let step = self.grid.steps_px[r];
                match if mask[r] != 0 { None } else { Some(tell(r)) } {
                    None => score += step,
                    Some(Ground::Foreign) => {
                        (score, strange) = (score + step, strange + 1);
                        if self.grid.radii_px[r] <= AT_LIP_PX {
                            own.add(colours[r].0);
                        }
                    }
                    Some(Ground::Blind) => {}
                    Some(Ground::Known) if self.is_hidden(r, colours[r].0) => {}
                    Some(Ground::Known) => score -= step,
                }
                if score > best {
                    (best, end, strange_at_end, own_at_end) = (score, r + 1, strange, own);
                } else if score < -GAP_MOST_PX {
                    break;
                }
            }
            if end > 0 && best >= (2.0 * FILLED - 1.0) * (self.grid.radii_px[end - 1] - NEAR_PX).max(1.0) {
                filled += 1;
                samples += end;
                foreign += strange_at_end;
                shown += usize::from(own_at_end.count > 0);
                mean.join(own_at_end);
                length_px += self.grid.radii_px[end - 1];
                ends[i] = ends[i].max(end);
            }
        }
        let mean_px = length_px / filled.max(1) as f32;
        let is = filled as f32 >= BODY_RAYS * RAYS as f32 && mean_px >= BODY_PX && foreign as f32 >= BODY_FOREIGN * samples as f32;
        let told = shown as f32 >= COLOUR_RAYS * filled as f32;
        Ok(is.then(|| Body { colour: told.then(|| mean.levels()) }))
    }

    /// Whether white light hides what is in this sample of a ray: ground that is white too, or a stream in a lamp's reflection.
    #[inline(always)]
    pub(super) fn is_hidden(&self, sample: usize, colour: [u8; 3]) -> bool {
        self.grid.radii_px[sample] <= REFLECTION_PX && GroundColours::is_white(colour)
    }

    /// The colour just beyond the stream's end on a ray, if the region shows it.
    pub(super) fn beyond_end(&self, ray: usize, end: usize) -> opencv::Result<Option<[u8; 3]>> {
        let Some(last) = end.checked_sub(1) else { return Ok(None) };
        let beyond_px = self.grid.radii_px[last] + BEYOND_PX;
        let r = (last + BEYOND_SAMPLES..self.grid.rays[ray].samples).find(|r| self.grid.radii_px[*r] >= beyond_px);
        r.map(|r| self.smooth.at_row::<Vec3b>(ray as i32).map(|colours| colours[r].0)).transpose()
    }

    /// The mean colour of what is foreign beside a stream with these ends, if it goes on beyond its edge.
    pub(super) fn beyond(&self, ends: &[usize; RAYS]) -> opencv::Result<Option<[f32; 3]>> {
        let (mut foreign, mut looked, mut mean) = (0usize, 0usize, Mean::default());
        for (i, end) in ends.iter().enumerate() {
            let Some(colour) = self.beyond_end(i, *end)? else { continue };
            looked += 1;
            if self.ground.tell(colour) == Ground::Foreign {
                foreign += 1;
                mean.add(colour);
            }
        }
        Ok((foreign as f32 > BEYOND_FOREIGN * looked.max(RAYS / 4) as f32).then(|| mean.levels()))
    }

    /// Whether more of the liquid lies beyond the ends of a stream: something in other colours, as a lamp's or a wall's reflection along the stream, cuts it
    /// in two, and only the part at the lip would be measured.
    pub(super) fn is_cut(&self, ends: &[usize; RAYS]) -> opencv::Result<bool> {
        let (mut more, mut filled) = (0usize, 0usize);
        for (i, end) in ends.iter().enumerate() {
            let Some(last) = end.checked_sub(1) else { continue };
            filled += 1;
            let within =
                self.grid.radii_px.partition_point(|r| *r <= self.grid.radii_px[last] + CUT_WITHIN_PX).min(self.grid.rays[i].samples);
            let beyond = &self.mask.at_row::<u8>(i as i32)?[*end..within.max(*end)];
            let liquid_px: f32 =
                beyond.iter().zip(&self.grid.steps_px[*end..]).map(|(value, step)| if *value != 0 { *step } else { 0.0 }).sum();
            more += usize::from(liquid_px > CUT_PX);
        }
        Ok(more as f32 > CUT_RAYS * filled as f32)
    }

    /// How many rays have more than so much liquid on them, wherever it lies up to this distance from the lip, px.
    pub(super) fn rays_with_liquid(&self, least_px: f32, within_px: f32) -> opencv::Result<usize> {
        let near = self.grid.radii_px.iter().take_while(|r| **r <= within_px).count();
        let mut rays = 0;
        for (i, ray) in self.grid.rays.iter().enumerate() {
            let mask = &self.mask.at_row::<u8>(i as i32)?[..near.min(ray.samples)];
            let liquid_px: f32 = mask.iter().zip(&self.grid.steps_px).map(|(value, step)| if *value != 0 { *step } else { 0.0 }).sum();
            rays += usize::from(liquid_px > least_px);
        }
        Ok(rays)
    }

    /// Which shares of what is close to the lip are white light that the ground is not, glow of it, and foreign colours or liquid.
    pub(super) fn at_lip(&self) -> opencv::Result<[f32; 3]> {
        let near = self.grid.radii_px.iter().take_while(|r| **r <= AT_LIP_PX).count();
        let (mut blind, mut glows, mut foreign, mut looked) = (0usize, 0usize, 0usize, 0usize);
        for (i, ray) in self.grid.rays.iter().enumerate() {
            let (mask, colours) = (self.mask.at_row::<u8>(i as i32)?, self.smooth.at_row::<Vec3b>(i as i32)?);
            for r in 0..near.min(ray.samples) {
                let ground = self.ground.tell(colours[r].0);
                looked += 1;
                blind += usize::from(self.ground.is_blind(colours[r].0));
                glows += usize::from(colours[r].0.iter().all(|v| *v >= GLOW_LEVEL));
                foreign += usize::from(mask[r] != 0 || ground != Ground::Known);
            }
        }
        let share = |part: usize| part as f32 / looked.max(1) as f32;
        Ok([share(blind), share(glows), share(foreign)])
    }
}

/// Tells a stream's outline from that of other bodies at the lip.
pub(super) struct Outline {
    axes: Axes,
    /// The ends of the body on the rays, px in the region. Kept from frame to frame.
    edges_px: Vec<[f32; 2]>,
    line: LineFinder,
}

impl Outline {
    /// For a region of an image (x, y, width and height, px); `axes` are relative to it.
    pub(super) fn new(axes: Axes, [_, _, width, height]: [u32; 4]) -> Self {
        Self { axes, edges_px: Vec::with_capacity(RAYS), line: LineFinder::new(axes, [width, height].map(|v| v as i32)) }
    }

    /// Whether a body that ends so on the rays may be a stream: it ends along a line from axis to axis, or the region cuts it off.
    pub(super) fn is_streams(&mut self, grid: &RayGrid, ends: &[usize; RAYS]) -> bool {
        self.edges_px.clear();
        let mut cut_off = 0usize;
        for (end, ray) in ends.iter().zip(&grid.rays) {
            let Some(last) = end.checked_sub(1) else { continue };
            cut_off += usize::from(*end >= ray.samples);
            self.edges_px.push(self.axes.at(grid.radii_px[last] + 0.5 * grid.steps_px[last], ray.along));
        }
        cut_off as f32 > LEAVES_SHARE * RAYS as f32 || self.line.first_line(&self.edges_px).is_some()
    }
}

/// Whether what is foreign is surely not the liquid, which is seen in the glass in its own colours; `ground` is the ground's mean colour.
pub(super) fn is_not_the_liquid(foreign: [f32; 3], liquid: [f32; 3], ground: [f32; 3]) -> bool {
    // Light that is cut off has lost its colour.
    let glows = foreign.iter().all(|v| *v >= f32::from(GLOW_LEVEL));
    // Liquid in a lamp's reflection is brighter by much the same in all parts.
    let brighter: [f32; 3] = std::array::from_fn(|k| foreign[k] - liquid[k]);
    let (least, most) = brighter.iter().fold((f32::MAX, f32::MIN), |(l, m), v| (l.min(*v), m.max(*v)));
    let lit = least > LIT_LEVELS && least >= LIT_SHARE * most;
    !glows && !lit && mixed_share(foreign, liquid, ground).is_none() && distance(foreign, liquid) > LIKE_LIQUID * distance(ground, liquid)
}

/// Whether what is foreign just beyond a stream's edge is the blur of that edge: ground with a little of the liquid's colour.
pub(super) fn is_blur(foreign: [f32; 3], liquid: [f32; 3], ground: [f32; 3]) -> bool {
    mixed_share(foreign, liquid, ground).is_some_and(|share| share <= BLUR_SHARE)
}

/// How far what is foreign is on the way from the ground's colour to the liquid's, if it may be the ground seen through a little of the liquid.
/// Brightness tells nothing, because the ground has brighter and darker places.
fn mixed_share(foreign: [f32; 3], liquid: [f32; 3], ground: [f32; 3]) -> Option<f32> {
    let shares = |c: [f32; 3]| c.map(|level| level / c.iter().sum::<f32>().max(1.0));
    let ground = shares(ground);
    let from_ground = |c: [f32; 3]| -> [f32; 3] { std::array::from_fn(|k| shares(c)[k] - ground[k]) };
    let (seen, whole) = (from_ground(foreign), from_ground(liquid));
    let dot = |a: [f32; 3], b: [f32; 3]| (0..3).map(|k| a[k] * b[k]).sum::<f32>();
    let (seen_length, length) = (dot(seen, seen).sqrt(), dot(whole, whole).sqrt());
    if length < MIXED_LEAST {
        // A liquid without a colour of its own, before ground without one.
        return (seen_length < MIXED_LEAST).then_some(1.0);
    }
    let along = dot(seen, whole) / length;
    (along >= MIXED_COSINE * seen_length && along <= MIXED_MOST * length).then_some(along / length)
}

/// Whether what is foreign at the lip goes on outside the container, in the square beside it, as only ground does.
pub(super) fn goes_on_beside(foreign: [f32; 3], beside: &[Vec3b]) -> bool {
    let most = ALIKE_LEVELS + ALIKE_SHARE * foreign.iter().sum::<f32>() / 3.0;
    let alike = |c: &&Vec3b| (0..3).all(|k| (f32::from(c[k]) - foreign[k]).abs() <= most);
    let goes_on = |half: &[Vec3b]| half.iter().filter(alike).count() as f32 >= GOES_ON * half.len() as f32;
    let (lower, upper) = beside.split_at(beside.len() / 2);
    !beside.is_empty() && goes_on(lower) && goes_on(upper)
}

/// Distance between two colours, grey levels.
fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    (0..3).map(|k| (a[k] - b[k]) * (a[k] - b[k])).sum::<f32>().sqrt()
}

#[cfg(test)]
#[allow(clippy::unwrap_used)]
mod tests {
    use opencv::core::{CV_8UC1, CV_8UC3, Scalar};
    use shared::config::{ImageConfig, LiquidMethod};

    use super::super::geometry::Axes;
    use super::*;

    const GROUND: [u8; 3] = [90, 90, 90];
    const GREEN: [u8; 3] = [60, 180, 60];

    /// The colour of the body in a picture that has the colour `at` of a ray and a distance from the lip, px; `None` if there is no body. The first
    /// so many px are seen as liquid.
    fn body(at: impl Fn(usize, f32) -> [u8; 3], liquid_px: f32) -> opencv::Result<Option<Option<[f32; 3]>>> {
        let image = ImageConfig {
            region_px: [191, 16, 420, 270],
            x_axis_px: [215.0, 250.0, 600.0, 250.0],
            y_axis_px: [215.0, 470.0, 215.0, 250.0],
            method: LiquidMethod::Colour,
            colour_hsv: [98, 90, 25, 124, 255, 255],
            area_min_px2: 30.0,
        };
        let axes = Axes { lip_px: [24.0, 234.0], ..Axes::new(&image) };
        let grid = RayGrid::new(&axes, [420.0, 270.0]).unwrap();
        let mut ground = GroundColours::new();
        ground.expose(270);
        (0..200).for_each(|_| ground.learn(GROUND, true));
        let (rows, columns) = (RAYS as i32, grid.radii_px.len() as i32);
        let mut mask = Mat::new_rows_cols_with_default(rows, columns, CV_8UC1, Scalar::all(0.0))?;
        let mut smooth = Mat::new_rows_cols_with_default(rows, columns, CV_8UC3, Scalar::all(0.0))?;
        for i in 0..RAYS {
            for (r, radius) in grid.radii_px.iter().enumerate() {
                smooth.at_row_mut::<Vec3b>(i as i32)?[r] = at(i, *radius).into();
                mask.at_row_mut::<u8>(i as i32)?[r] = if *radius <= liquid_px { 255 } else { 0 };
            }
        }
        let seen = Seen { grid: &grid, mask: &mask, smooth: &smooth, ground: &ground };
        Ok(seen.body(&mut [0; RAYS], &Otherwise::default())?.map(|body| body.colour))
    }

    /// Protects pours from a body at the lip that is excused by a colour that it does not have: where its first px are white light or look like
    /// the liquid, or show it on a few rays only, its colour is not known; rays without the body and what lies beyond its end do not enter.
    #[test]
    fn a_body_has_its_own_colour_or_none() -> opencv::Result<()> {
        let green = Some([60.0, 180.0, 60.0]);
        let after = |first: [u8; 3]| {
            move |_: usize, r: f32| {
                if r <= 13.0 {
                    first
                } else if r <= 40.0 {
                    GREEN
                } else {
                    GROUND
                }
            }
        };
        assert_eq!(body(|_, r| if r <= 40.0 { GREEN } else { GROUND }, 0.0)?, Some(green));
        assert_eq!(body(after([255; 3]), 0.0)?, Some(None), "white light first");
        assert_eq!(body(after(GREEN), 13.0)?, Some(None), "liquid first");
        let few = |i: usize, r: f32| {
            if r > 40.0 {
                GROUND
            } else if r > 13.0 || i < 10 {
                GREEN
            } else {
                [255; 3]
            }
        };
        assert_eq!(body(few, 0.0)?, Some(None), "on a few rays");
        let specks = |i: usize, r: f32| match (i.is_multiple_of(4), r) {
            (true, 10.0..=12.0) => [30, 30, 250],
            (true, _) | (_, 40.0..) => GROUND,
            _ => GREEN,
        };
        assert_eq!(body(specks, 0.0)?, Some(green), "specks of another colour");
        // Half of the rays end at 9 px, before other specks.
        let beyond = |i: usize, r: f32| match r {
            ..9.5 => GREEN,
            _ if i.is_multiple_of(2) => {
                if r < 40.0 {
                    GREEN
                } else {
                    GROUND
                }
            }
            12.0 => [30, 30, 250],
            _ => GROUND,
        };
        assert_eq!(body(beyond, 0.0)?, Some(green), "specks beyond its end");
        Ok(())
    }
}
