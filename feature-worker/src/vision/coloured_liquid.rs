//! Coloured liquid, which is told from the background by a range of hue, saturation and value.
//!
//! The wedge between the axes is resampled once into rays from the lip (`cv::remap`), one ray a row. Seen from the lip, liquid comes
//! first and background after it, whatever the tilt. So on each ray the outer edge is where the number of liquid pixels minus that of
//! background pixels is largest. A stream fills nearly every ray from the lip on; drops and splashes do not, so they are no stream.
//!
//! A liquid whose colour has left its range would look like no stream. So the ground's own colours are remembered
//! ([`super::ground_colours`]), and what lies at the lip like a stream, but has the colours of neither, is a reason for a doubt.
//!
//! Called on the extraction thread. All pictures are kept, so after the first frame nothing is allocated but OpenCV's matrix headers.
//! The only failures are OpenCV's.

use opencv::boxed_ref::BoxedRef;
use opencv::core::{self, Mat, Scalar, Vec3b};
use opencv::imgproc;
use opencv::prelude::*;
use shared::config::ImageConfig;
use shared::messages::{Doubt, PixelFormat};

use super::coloured_edge;
use super::confidence::Basis;
use super::foreign::{self, FILLED, LEARN_FROM_PX, LEAVES_SHARE, Otherwise, Outline, Seen};
use super::geometry::{Axes, Line, NEAR_PX, RAYS, RayGrid, distance};
use super::grey::{is_grey, is_unseen_in_grey};
use super::ground_beside::{InGlass, Place, Square};
use super::ground_colours::{Ground, GroundColours};
use super::hues::ranges;
use super::liquid::{FineLine, LineRules, Liquid, Profile, ProfileEdge, Sighting, Unsure};
use super::liquid_mask::{LimitedMask, LiquidMask};
use super::pace::Pace;
use super::ray_maps::ray_maps;
use super::reflection::Reflection;
use super::wandering::Wandering;

// "Tuned" below means that the value was tuned on seeds 1 and 5001 to 5003 of `evaluate-camera`; see docs/VISION.md.

/// Share of rays that a stream fills at least. Tuned.
const STREAM_RAYS: f32 = 0.8;
/// With more than this share of rays full, far out, and no stream, something hides the stream. Tuned.
const HIDDEN_RAYS: f32 = 0.5;
/// Mean length of liquid on the full rays above which they are full far out, px. Tuned.
const HIDDEN_PX: f32 = 14.0;
/// With more than this share of rays with that much liquid, wherever it lies on them up to [`BEHIND_PX`], and no stream, something hides the
/// stream's begin or a part of it. Chosen by hand: more than a splash.
const BEHIND_RAYS: f32 = 0.4;
/// So far from the lip that liquid is looked for, px. Chosen by hand: as far as most streams reach.
const BEHIND_PX: f32 = 100.0;
/// With more than this share of rays full of liquid to the region's border, the colour tells nothing in this light. Chosen by hand.
const ALL_LIQUID: f32 = 0.9;
/// Side of the square of samples that are smoothed together: a fifth of the noise. Tuned; it costs about 25 us more than 3, see CHANGELOG.md.
const SMOOTH: i32 = 5;
/// There is no line when a smaller share of the profiles than this shows an edge. Tuned.
const PROFILES_LEAST: f32 = 0.3;
/// Frames without a stream after which the surroundings of the lip are known. Chosen by hand: a third of a second.
const DRY_FRAMES: u32 = 10;
/// In the first pictures, what lies beyond this share of a ray is ground. Chosen by hand: few streams reach further.
const DISTANT_SHARE: f32 = 0.7;
/// After so many pictures what lies at the lip since the first one counts as ground. Chosen by hand: half a minute, which is longer than a pour.
const STREAM_MOST: u32 = 900;
/// Of this many samples, the ground is learned from one a frame, a different one each time. Chosen by hand, for speed.
const LEARN_EVERY: usize = 7;
/// Of this many samples far from the lip, one is looked at for the picture's brightness. Chosen by hand, for speed.
const EXPOSURE_EVERY: usize = 12;
/// The ground is learned this many samples beyond the liquid: between, both mix. Chosen by hand.
const LEARN_BEYOND: usize = 6;
/// After a picture in which it was not told what is liquid, the ground is not learned for so many told ones: what lies there may be a liquid
/// in other colours. Chosen by hand: half a second.
const LEARN_AFTER: u32 = 15;
/// The ground is learned beside the container while no more than this share of what is at the lip is foreign or liquid. Chosen by hand.
const QUIET_SHARE: f32 = 0.3;
/// Before ground that is brighter than this in the mean, the sum of three levels, what is black at the lip may be the liquid. Chosen by hand: three times what
/// counts as black, so that in a dark room it is ground.
const BRIGHT_SUM: f32 = 90.0;

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
    /// Whether the liquid is not to be seen in a picture without colour.
    needs_colour: bool,
    /// A smaller triangle is no stream, px^2.
    area_min_px2: f32,
    ground: GroundColours,
    /// Its mean levels of blue, green and red, far from the lip in the last picture.
    ground_bgr: Option<[f32; 3]>,
    /// Frames that were learned from, and those without a stream that are left until the surroundings of the lip are known.
    frames: usize,
    unknown_for: u32,
    /// Pictures in which something foreign was at the lip while its surroundings were not known.
    unsure_at_first: u32,
    pace: Pace,
    reflection: Reflection,
    wandering: Wandering,
    /// For how many told pictures more the ground is not learned, see [`LEARN_AFTER`].
    learn_after: u32,
    /// Whether a stream may be where the last one was seen.
    held: bool,
    /// Which share of the glass at the lip is white light.
    white_lip: f32,
    /// Whether half of what was read is saturated.
    half_white: bool,
    /// Number of samples on each ray up to the end of the liquid, or of a body at the lip, in the last picture.
    ends: [usize; RAYS],
    outline: Outline,
    // Pictures along the rays, one ray a row, kept from frame to frame.
    /// The region in BGR.
    sampled: Mat,
    /// The same, smoothed.
    smooth: Mat,
    /// Where these have the liquid's colours, and where they have them in a limited range.
    liquid: LiquidMask,
    limited: LimitedMask,
    /// The ground beside the container.
    beside: Square,
    /// More of it, to tell what goes on there from what is at the lip.
    beside_wide: Square,
    /// The glass below the lip.
    glass: InGlass,
}

impl ColouredLiquid {
    /// For the colours of `image` in pictures `width_px` wide. `axes` and `grid` are relative to the region.
    pub(crate) fn new(image: &ImageConfig, width_px: u32, axes: Axes, grid: RayGrid) -> opencv::Result<Self> {
        let [map_a, map_b] = ray_maps(&grid, &axes)?;
        let place = Place::new(axes, image, width_px);
        let (beside, beside_wide) = (Square::beside(&place)?, Square::beside_wide(&place)?);
        let colour = image.colour_hsv.map(f64::from);
        let ranges = ranges(colour);
        let glass = InGlass::new(&place, &ranges)?;
        Ok(Self {
            axes,
            grid,
            map_a,
            map_b,
            needs_colour: is_unseen_in_grey(colour),
            area_min_px2: image.area_min_px2,
            ground: GroundColours::new(),
            ground_bgr: None,
            frames: 0,
            unknown_for: DRY_FRAMES,
            unsure_at_first: 0,
            pace: Pace::CHOSEN,
            reflection: Reflection::default(),
            wandering: Wandering::new(),
            learn_after: 0,
            held: false,
            white_lip: 0.0,
            half_white: false,
            ends: [0; RAYS],
            outline: Outline::new(axes, image.region_px),
            sampled: Mat::default(),
            smooth: Mat::default(),
            liquid: LiquidMask::new(ranges.clone()),
            limited: LimitedMask::new(ranges)?,
            beside,
            beside_wide,
            glass,
        })
    }

    /// Tells liquid from background. A dark liquid in dim light is only noise and a little colour, so neighbouring samples are taken together.
    fn segment(&mut self) -> opencv::Result<()> {
        let size = core::Size::new(SMOOTH, SMOOTH);
        imgproc::blur(&self.sampled, &mut self.smooth, size, core::Point::new(-1, -1), core::BORDER_REPLICATE)?;
        self.liquid.take(&self.smooth)
    }

    /// Tells the ground's colours how bright the picture is far from the lip.
    fn expose(&mut self) -> opencv::Result<()> {
        let far = self.grid.radii_px.iter().take_while(|r| **r < LEARN_FROM_PX).count();
        let (mut sums, mut count) = ([0u32; 3], 0u32);
        let mut rays = [([0.0f32; 3], 0u32); RAYS];
        for (i, ray) in self.grid.rays.iter().enumerate() {
            let (mask, colours) = (self.liquid.mask().at_row::<u8>(i as i32)?, self.smooth.at_row::<Vec3b>(i as i32)?);
            let (mut own, mut looked) = ([0u32; 3], 0u32);
            for r in (far + i % EXPOSURE_EVERY..ray.samples).step_by(EXPOSURE_EVERY).filter(|r| mask[*r] == 0) {
                (0..3).for_each(|k| own[k] += u32::from(colours[r][k]));
                looked += 1;
            }
            (0..3).for_each(|k| sums[k] += own[k]);
            count += looked;
            rays[i] = (own.map(|sum| sum as f32 / looked.max(1) as f32), looked);
        }
        self.wandering.look(&rays);
        if let Some(mean_sum) = sums.iter().sum::<u32>().checked_div(count) {
            self.ground.expose(mean_sum);
            let bgr = sums.map(|sum| sum as f32 / count as f32);
            self.ground.see_mean(bgr);
            self.ground_bgr = Some(bgr);
        }
        Ok(())
    }

    /// Learns the ground's colours from what lies beyond the liquid and far from the lip, or, while the surroundings of the lip are new and
    /// `dry`, from everything.
    fn learn(&mut self, dry: bool) -> opencv::Result<()> {
        let new = dry && !self.is_known();
        self.unknown_for -= u32::from(new);
        self.ground.forget();
        let far = self.grid.radii_px.iter().take_while(|r| **r < LEARN_FROM_PX).count();
        let every = if new { 1 } else { LEARN_EVERY };
        for (i, ray) in self.grid.rays.iter().enumerate() {
            let from = match self.ends[i] {
                0 if new => 0,
                // A ray without an edge may have a stream on it all the same.
                0 if !dry => continue,
                end => {
                    // What goes on from the liquid in a foreign colour may be more of it.
                    let beyond = self.seen().beyond_end(i, end)?.filter(|_| self.is_known());
                    if beyond.is_some_and(|colour| self.ground.tell(colour) == Ground::Foreign) {
                        continue;
                    }
                    (end + LEARN_BEYOND).max(far)
                }
            };
            let (mask, colours) = (self.liquid.mask().at_row::<u8>(i as i32)?, self.smooth.at_row::<Vec3b>(i as i32)?);
            let first = from + (self.frames + 3 * i) % every;
            for r in (first..ray.samples).step_by(every) {
                let beside = [r.saturating_sub(3), r, (r + 3).min(ray.samples - 1)];
                if beside.iter().all(|r| mask[*r] == 0) {
                    self.ground.learn(colours[r].0, r >= far);
                }
            }
        }
        self.frames = self.frames.wrapping_add(1);
        Ok(())
    }

    /// Learns the ground in a picture in which this was seen, or does not. It is forgotten only while it is learned: what hides it for long must not
    /// make all of it foreign. A `drop` at the lip is no stream.
    fn follow_ground(&mut self, sighting: Sighting, drop: bool) -> opencv::Result<()> {
        let dry = drop || matches!(sighting, Sighting::Dry { .. });
        let told = dry || matches!(sighting, Sighting::Stream { doubt: Doubt::None, .. });
        match sighting {
            // A lamp's reflection before white squares is no ground. The pictures after it are learned from as ever.
            _ if self.half_white && (told || sighting == Sighting::Unsure(Doubt::BlownOut)) => {}
            // What may be liquid must not be taken for ground.
            _ if !told => self.learn_after = self.pace.pictures(LEARN_AFTER),
            _ if self.learn_after > 0 => self.learn_after -= 1,
            // A stream that was there before the surroundings of the lip were known may be there still, in other colours.
            _ if dry && self.held && !self.is_known() => {}
            _ => self.learn(dry)?,
        }
        Ok(())
    }

    /// Whether the surroundings of the lip are known.
    fn is_known(&self) -> bool {
        self.unknown_for == 0
    }

    /// Ground that is known stays so. What was not learned to the end is learned anew.
    fn learn_anew(&mut self) {
        if !self.is_known() {
            self.unknown_for = self.pace.pictures(DRY_FRAMES);
        }
    }

    /// The picture along the rays.
    fn seen(&self) -> Seen<'_> {
        Seen { grid: &self.grid, mask: self.liquid.mask(), smooth: &self.smooth, ground: &self.ground }
    }

    /// Whether the liquid is seen in the glass in its own colours, and these and the ground's mean excuse what is foreign.
    fn is_excused(&mut self, excuse: impl Fn([f32; 3], [f32; 3]) -> bool) -> opencv::Result<bool> {
        Ok(self.glass.liquid()?.zip(self.ground_bgr).is_some_and(|(liquid, ground)| excuse(liquid, ground)))
    }

    /// Whether something lies at the lip like a stream and may be the liquid in other colours. Writes its ends into `self.ends`.
    fn has_foreign_body(&mut self) -> opencv::Result<bool> {
        let own_ends = self.ends;
        let mut ends = own_ends;
        let mut body = self.seen().body(&mut ends, &Otherwise::default())?;
        // Liquid in the glass that has its own colours shows that the camera's levels are as ever.
        if body.is_none() && self.glass.liquid()?.is_none() {
            let limited = self.limited.take(&self.smooth)?.then(|| self.limited.mask());
            let black = self.ground_bgr.is_some_and(|ground| ground.iter().sum::<f32>() > BRIGHT_SUM);
            let mut other_ends = own_ends;
            body = self.seen().body(&mut other_ends, &Otherwise { limited, black })?;
            // Ground in such colours is no stream if it does not end like one.
            body = body.filter(|_| self.outline.is_streams(&self.grid, &other_ends));
            ends = if body.is_some() { other_ends } else { ends };
        }
        self.ends = ends;
        let Some(body) = body else { return Ok(false) };
        let Some(colour) = body.colour else { return Ok(true) };
        Ok(!self.is_excused(|liquid, ground| foreign::is_not_the_liquid(colour, liquid, ground))?
            && !foreign::goes_on_beside(colour, self.beside_wide.colours()?))
    }

    /// Learns the ground's colours from the outer part of each ray, where hardly any stream reaches.
    fn learn_distant(&mut self) -> opencv::Result<()> {
        for (i, ray) in self.grid.rays.iter().enumerate() {
            let (mask, colours) = (self.liquid.mask().at_row::<u8>(i as i32)?, self.smooth.at_row::<Vec3b>(i as i32)?);
            let last_px = self.grid.radii_px[ray.samples.saturating_sub(1)];
            let from = self.grid.radii_px[..ray.samples].partition_point(|r| *r < DISTANT_SHARE * last_px);
            (from..ray.samples).filter(|r| mask[*r] == 0).for_each(|r| self.ground.learn(colours[r].0, true));
        }
        Ok(())
    }

    /// What is at the lip where no stream is seen.
    fn look_again(&mut self, confidence: f32) -> opencv::Result<Sighting> {
        let dry = Sighting::Dry { confidence };
        let known = self.is_known();
        // A lamp's reflection before white squares hides a stream, but not the liquid below the lip, and not what is foreign where the ground is
        // known. It is not learned in such pictures, so there is no end to wait for.
        if self.half_white && (!known || !self.glass.is_empty()?) {
            return Ok(Sighting::Unsure(Doubt::BlownOut));
        }
        if known {
            self.glass.see_dry()?;
        } else {
            // What lies at the lip may be a stream that flowed before the first picture, so it is judged by ground that lies far from it.
            self.learn_distant()?;
        }
        let [blind, glows, foreign] = self.seen().at_lip()?;
        let ends = self.ends;
        let mut body = self.has_foreign_body()?;
        if body && !known && !self.outline.is_streams(&self.grid, &self.ends) {
            // It is ground, and learned as such.
            (body, self.ends) = (false, ends);
        }
        // Ground that is white at the lip alone may be new, so it is no reflection yet.
        let hidden = (known || body) && self.reflection.hides_lip(blind.max(self.white_lip), glows, foreign > QUIET_SHARE, self.pace);
        self.unsure_at_first += u32::from(body && !known);
        // An untidy place that only the lip shows would be a stream for ever.
        if (known && (body || hidden)) || (body && self.unsure_at_first <= self.pace.pictures(STREAM_MOST)) {
            return Ok(Sighting::Unsure(if hidden { Doubt::BlownOut } else { Doubt::ColoursChanged }));
        }
        if known && foreign < QUIET_SHARE && self.learn_after == 0 && !self.half_white {
            self.beside.teach(&mut self.ground, self.frames)?;
        } else {
            self.beside.forget_kept();
        }
        Ok(dry)
    }

    /// Finds the stream, and writes into `self.ends` where the liquid ends on each ray.
    fn find_stream(&mut self, edges_px: &mut Vec<[f32; 2]>) -> opencv::Result<Sighting> {
        edges_px.clear();
        self.ends = [0; RAYS];
        let (mut filled, mut cut_off, mut liquid_px) = (0usize, 0usize, 0.0f32);
        for (i, ray) in self.grid.rays.iter().enumerate() {
            let Some((r, score)) = self.seen().last_liquid(i)? else { continue };
            // Between the last sample of liquid and the first of background.
            let r_px = self.grid.radii_px[r] + 0.5 * self.grid.steps_px[r];
            if r_px >= NEAR_PX + 1.0 && score >= (2.0 * FILLED - 1.0) * (r_px - NEAR_PX) {
                filled += 1;
                liquid_px += r_px;
                cut_off += usize::from(r + 1 >= ray.samples);
                edges_px.push(self.axes.at(r_px, ray.along));
                self.ends[i] = r + 1;
            }
        }
        let share = filled as f32 / RAYS as f32;
        if cut_off as f32 > ALL_LIQUID * RAYS as f32 || (share >= STREAM_RAYS && self.seen().is_cut(&self.ends)?) {
            return Ok(Sighting::Unsure(Doubt::EdgeNotFound));
        }
        if share < STREAM_RAYS {
            // A good half of the wedge full of liquid is no drop: something hides the stream.
            let mean_px = liquid_px / filled.max(1) as f32;
            let hidden = (share > HIDDEN_RAYS && mean_px > HIDDEN_PX)
                || self.seen().rays_with_liquid(HIDDEN_PX, BEHIND_PX)? as f32 > BEHIND_RAYS * RAYS as f32;
            let confidence = (1.0 - share).clamp(0.0, 1.0);
            return Ok(if hidden { Sighting::Unsure(Doubt::EdgeNotFound) } else { Sighting::Dry { confidence } });
        }
        let leaves_region = cut_off as f32 > LEAVES_SHARE * RAYS as f32;
        Ok(Sighting::Stream { seen_share: share, doubt: if leaves_region { Doubt::LeavesRegion } else { Doubt::None } })
    }
}

impl Liquid for ColouredLiquid {
    fn reads(&self, format: PixelFormat) -> bool {
        format != PixelFormat::Mono8
    }

    fn rules(&self) -> LineRules {
        LineRules { profiles_least: PROFILES_LEAST, first_area_least_px2: self.area_min_px2, edge_tells_focus: true, unsure: Unsure::Lasts }
    }

    fn take(&mut self, region: &BoxedRef<Mat>) -> opencv::Result<()> {
        let (nearest, border) = (imgproc::INTER_NEAREST, core::BORDER_REPLICATE);
        self.beside.take(region)?;
        self.beside_wide.take(region)?;
        self.glass.take(region)?;
        imgproc::remap(region, &mut self.sampled, &self.map_a, &self.map_b, nearest, border, Scalar::default())
    }

    fn sampled(&self) -> &Mat {
        &self.sampled
    }

    fn look(&mut self, edges_px: &mut Vec<[f32; 2]>) -> opencv::Result<Sighting> {
        if self.needs_colour && is_grey(&self.sampled)? {
            return Ok(Sighting::Unsure(Doubt::ColoursChanged));
        }
        self.segment()?;
        self.expose()?;
        let sighting = match self.find_stream(edges_px)? {
            Sighting::Dry { confidence } => self.look_again(confidence)?,
            Sighting::Stream { seen_share, doubt: Doubt::None } if self.is_known() => {
                let beyond = self.seen().beyond(&self.ends)?;
                let excuse = |b| move |l, g| foreign::is_not_the_liquid(b, l, g) || foreign::is_blur(b, l, g);
                let untold = beyond.map(|beyond| self.is_excused(excuse(beyond))).transpose()? == Some(false);
                Sighting::Stream { seen_share, doubt: if untold { Doubt::ColoursChanged } else { Doubt::None } }
            }
            other => other,
        };
        if !matches!(sighting, Sighting::Dry { .. }) {
            self.beside.forget_kept();
        }
        // While the ground is not known, only pictures that it is learned from are dry, and those where a stream was just held (`Presence::is_gone` tells).
        let unknown = (!self.is_known() && self.learn_after > 0).then_some(Doubt::EdgeNotFound);
        let drop = matches!(sighting, Sighting::Stream { doubt: Doubt::None, .. }) && self.axes.fan_px2(edges_px) < self.area_min_px2;
        self.follow_ground(sighting, drop)?;
        // A liquid in the ground's colours is not seen.
        let untold = self.wandering.doubt().or(unknown).filter(|_| drop || matches!(sighting, Sighting::Dry { .. }));
        Ok(untold.map_or(sighting, Sighting::Unsure))
    }

    fn see_lip(&mut self, white_share: f32) {
        self.white_lip = white_share;
    }

    /// A white square of a board behind the lip hides no stream.
    fn bears_white(&mut self, half_white: bool) -> bool {
        self.half_white = half_white;
        true
    }

    /// Each picture is judged by itself.
    fn lose_picture(&mut self, _doubt: Doubt) {}

    fn set_pace(&mut self, pace: Pace) {
        self.pace = pace;
        self.learn_anew();
        self.wandering.set_pace(pace);
        self.beside.set_pace(pace);
    }

    fn interrupt(&mut self) -> opencv::Result<()> {
        self.learn_anew();
        self.wandering.interrupt();
        self.beside.forget_kept();
        Ok(())
    }

    fn basis(&self) -> Basis {
        Basis::Colour
    }

    fn ground_is_even(&self) -> Option<bool> {
        None
    }

    fn ground_bgr(&self) -> Option<[f32; 3]> {
        self.ground_bgr
    }

    fn dry_share(&self, legs_px: [f32; 2]) -> f32 {
        let (from, to) = (self.axes.at(legs_px[0], self.axes.x), self.axes.at(legs_px[1], self.axes.y));
        let line = Line::through(from, to, distance(from, to));
        let (mut dry, mut looked) = (0usize, 0usize);
        for (i, ray) in self.grid.rays.iter().enumerate() {
            let edge_px = line.cut(self.axes.lip_px, ray.along);
            let (Ok(mask), Ok(colours)) = (self.liquid.mask().at_row::<u8>(i as i32), self.smooth.at_row::<Vec3b>(i as i32)) else {
                continue;
            };
            for r in (0..ray.samples).take_while(|r| self.grid.radii_px[*r] < edge_px) {
                looked += 1;
                dry += usize::from(mask[r] == 0 && self.ground.tell(colours[r].0) == Ground::Known);
            }
        }
        dry as f32 / looked.max(1) as f32
    }

    /// Once the surroundings of the lip are known, ground is learned far from it only; until then it is not where a stream is held.
    fn hold_ground(&mut self, legs_px: Option<[f32; 2]>) {
        self.held = legs_px.is_some();
    }

    fn edge_on(&self, profile: &Profile) -> Option<ProfileEdge> {
        coloured_edge::edge_on(profile)
    }

    fn confirm(&mut self, line: Option<FineLine>, _mean_level: f32) -> Result<FineLine, Doubt> {
        if line.is_none() {
            self.learn_after = self.pace.pictures(LEARN_AFTER);
        }
        line.ok_or(Doubt::EdgeNotFound)
    }
}
