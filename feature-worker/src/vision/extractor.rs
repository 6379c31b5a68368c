//! V_e from one image: the triangle of section 3.3.1 and Fig. 4.
//!
//! The liquid leaves the container at the lip `O`, where the glass's top edge (x-axis) meets its left side (y-axis). Between the two
//! axes, seen from `O`, liquid comes first and background after it, whatever the tilt. So in each image:
//!
//! 1. [`super::checks`] tell whether the light is good enough and the picture is a new one, and [`super::whole`] whether it is whole.
//! 2. The [`Liquid`] tells whether there is a stream, and roughly where its outer edge lies.
//! 3. [`super::stream_edge`] makes that edge a line, which cuts the axes at a and b.
//! 4. `V_e = a b sin(phi) / 2`, with phi between the axes. Without a stream it is exactly 0.
//! 5. A stream that is not seen any more is not absent until [`super::presence`] says so.
//!
//! Runs on the worker's extraction thread. All buffers are kept, so after the second frame nothing is allocated but OpenCV's matrix
//! headers. A frame that cannot be measured is no error: it gets a [`Doubt`].

use std::time::Instant;

use opencv::core::Rect;
use opencv::prelude::*;
use shared::config::{CameraConfig, ImageConfig, LiquidMethod};
use shared::messages::Doubt;

use super::checks::{LightCheck, LipCheck, RimCheck};
use super::clear_water::ClearWater;
use super::coloured_liquid::ColouredLiquid;
use super::confidence;
use super::geometry::{Axes, RayGrid};
use super::liquid::{Liquid, Sighting, Unsure};
use super::measurement::{Measurement, Stages};
use super::pace::{Between, PictureTime, Succession};
use super::picture::{Image, RegionPixels, RegionReader};
use super::presence::Presence;
use super::stream_edge::{BLURRED_PX, LineFinder};
use super::whole::WholeCheck;

/// No stream's triangle is longer along the container's side than so many times its length along the mouth. Chosen by hand: 7,400 rendered streams had 0.24
/// to 1.15, and what was measured with more than 4 was a wall in the liquid's colours beside the container.
const LEGS_STEEP: f32 = 4.0;

/// Why an extractor cannot be made, or why an image cannot be measured.
#[derive(Debug, thiserror::Error)]
pub enum ExtractError {
    /// The axes do not cross in the region, or the region has no room between them.
    #[error("image.region_px = {region:?}: {what}; the region must hold the lip (the axes cross at {lip:?}) and the space over it")]
    Region {
        /// The region: x, y, width, height in px.
        region: [u32; 4],
        /// Where the axes cross, px.
        lip: [i32; 2],
        /// What is wrong.
        what: &'static str,
    },
    /// The colour method is configured for a camera without colour.
    #[error("image.method = \"colour\" needs a colour camera, this one gives grey pictures; use method = \"clear\"")]
    NoColour,
    /// OpenCV refused a call.
    #[error("OpenCV: {0}")]
    OpenCv(#[from] opencv::Error),
}

/// Measures V_e in the images of one camera.
pub struct Extractor {
    /// Width and height that images must have, px.
    size_px: [u32; 2],
    /// The region in the image, px.
    region: Rect,
    /// A smaller triangle is no stream, px^2.
    area_min_px2: f32,
    /// The axes relative to the region.
    axes: Axes,
    reader: RegionReader,
    light: LightCheck,
    whole: WholeCheck,
    rim: RimCheck,
    lip: LipCheck,
    presence: Presence,
    succession: Succession,
    liquid: Box<dyn Liquid>,
    line: LineFinder,
    /// The coarse outer edge on the rays, px in the region, from the x-axis to the y-axis. Kept from frame to frame.
    edges: Vec<[f32; 2]>,
    /// Time spent in the stages of the last measurement.
    stages: Stages,
}

impl Extractor {
    /// An extractor for images of `camera`'s size with the axes, region and liquid of `image`. A region in which nothing can be measured
    /// is refused.
    pub fn new(camera: &CameraConfig, image: &ImageConfig) -> Result<Self, ExtractError> {
        let [x, y, width, height] = image.region_px;
        let region = Rect::new(x as i32, y as i32, width as i32, height as i32);
        let axes = Axes::new(image);
        let fail = |what| ExtractError::Region { region: image.region_px, lip: axes.lip_px.map(|v| v.round() as i32), what };
        // From here on everything is relative to the region.
        let lip = [axes.lip_px[0] - x as f32, axes.lip_px[1] - y as f32];
        let axes = Axes { lip_px: lip, ..axes };
        let size = [width as f32, height as f32];
        if !(0..2).all(|k| lip[k].is_finite() && lip[k] >= 1.0 && lip[k] <= size[k] - 2.0) {
            return Err(fail("the axes cross outside it"));
        }
        let grid = RayGrid::new(&axes, size).ok_or_else(|| fail("there is no room between the axes"))?;
        let region_px = [region.width, region.height];
        let edges = Vec::with_capacity(grid.rays.len());
        let succession = Succession::new(camera.fps);
        let mut liquid: Box<dyn Liquid> = match image.method {
            LiquidMethod::Colour => Box::new(ColouredLiquid::new(image, camera.width_px, axes, grid)?),
            LiquidMethod::Clear => {
                let water = ClearWater::new(&axes, region_px, camera.width_px)?;
                Box::new(water.ok_or_else(|| fail("there is no room for the outline of a stream"))?)
            }
        };
        liquid.set_pace(succession.pace());
        let mut presence = Presence::new(camera.width_px, 1.0);
        presence.set_pace(succession.pace());
        Ok(Self {
            size_px: [camera.width_px, camera.height_px],
            region,
            area_min_px2: image.area_min_px2,
            axes,
            reader: RegionReader::new(region),
            light: LightCheck::default(),
            whole: WholeCheck::new(axes, region_px),
            rim: RimCheck::new(axes),
            lip: LipCheck::new(axes, camera.width_px),
            presence,
            succession,
            liquid,
            line: LineFinder::new(axes, region_px),
            edges,
            stages: Stages::default(),
        })
    }

    /// The same extractor, which asks for `patience` times as many dry pictures before a stream that is not seen any more counts as gone. It is
    /// for measuring what that costs and gains; 1 is what the worker uses.
    #[must_use]
    pub fn with_patience(mut self, patience: f32) -> Self {
        self.presence = Presence::new(self.size_px[0], patience);
        self.presence.set_pace(self.succession.pace());
        self
    }

    /// The axes in the image, px.
    pub fn axes(&self) -> Axes {
        Axes { lip_px: self.in_image(self.axes.lip_px), ..self.axes }
    }

    /// The region in the image, px.
    pub fn region(&self) -> Rect {
        self.region
    }

    /// The coarse outer edge of the last measurement on each ray with liquid, px in the image: with the lip, the liquid's outline.
    pub fn outline_px(&self) -> impl Iterator<Item = [f32; 2]> + '_ {
        self.edges.iter().map(|p| self.in_image(*p))
    }

    /// The edge points of the last measurement, px in the image: the final line was fitted to these.
    pub fn edge_points_px(&self) -> impl Iterator<Item = [f32; 2]> + '_ {
        self.line.points_px().iter().map(|p| self.in_image(*p))
    }

    /// Time spent in the stages of the last measurement.
    pub fn stages(&self) -> Stages {
        self.stages
    }

    /// Whether the ground at the lip has no pattern, where clear water needs that; `None` for coloured liquids and before the second frame.
    pub fn ground_is_even(&self) -> Option<bool> {
        self.liquid.ground_is_even()
    }

    fn in_image(&self, p: [f32; 2]) -> [f32; 2] {
        [p[0] + self.region.x as f32, p[1] + self.region.y as f32]
    }

    /// Measures one image that follows the last one without a gap, as [`Self::measure_at`] does.
    pub fn measure(&mut self, image: Image) -> Result<Measurement, ExtractError> {
        self.measure_at(image, self.succession.next())
    }

    /// Measures one image with this number and time. An image of another size than configured, or with missing bytes, gets a doubt and no area. A
    /// grey image is an error where the liquid is told by its colour; the only other errors are OpenCV's.
    pub fn measure_at(&mut self, image: Image, time: PictureTime) -> Result<Measurement, ExtractError> {
        self.follow_on(time)?;
        // What was seen before is not shown on a picture that is not looked at.
        self.line.clear();
        self.edges.clear();
        let expected = image.width_px as usize * image.height_px as usize * image.format.bytes_per_pixel();
        if [image.width_px, image.height_px] != self.size_px || image.pixels.len() != expected {
            return Ok(Measurement::nothing(0.0, Doubt::WrongFormat));
        }
        if !self.liquid.reads(image.format) {
            return Err(ExtractError::NoColour);
        }
        // The reader lends the region's pixels, so it is taken out of the extractor until the end.
        let mut reader = std::mem::replace(&mut self.reader, RegionReader::new(self.region));
        let measured = self.measure_region(image, &mut reader);
        self.reader = reader;
        measured
    }

    /// Takes note of when a picture was taken: counts of pictures stand for times, and what was seen before a pause is no evidence of what is there after
    /// it. A few lost pictures are no pause: clear water before a pattern is measured as well when every third one is lost.
    fn follow_on(&mut self, time: PictureTime) -> Result<(), ExtractError> {
        let pace = self.succession.pace();
        if self.succession.take(time) == Between::Pause {
            self.light.interrupt();
            self.presence.interrupt();
            self.liquid.interrupt()?;
        }
        if self.succession.pace() != pace {
            self.presence.set_pace(self.succession.pace());
            self.liquid.set_pace(self.succession.pace());
        }
        Ok(())
    }

    fn measure_region(&mut self, image: Image, reader: &mut RegionReader) -> Result<Measurement, ExtractError> {
        let start = Instant::now();
        let pixels = reader.read(image, |region| self.liquid.take(region))?;
        let sampled = Instant::now();
        let whole = self.whole.is_whole(pixels, self.succession.pace());
        let unlit = self.light.doubt(self.liquid.sampled().data_bytes()?, pixels);
        let unlit = unlit.or((!self.liquid.bears_white(self.light.is_half_white())).then_some(Doubt::BlownOut));
        let unusable = unlit.or((!whole).then_some(Doubt::PictureIncomplete));
        let checked = Instant::now();
        let (measured, segmented) = match unusable {
            Some(doubt) => {
                self.liquid.lose_picture(doubt);
                (Measurement::nothing(0.0, doubt), checked)
            }
            None => {
                self.liquid.see_lip(self.lip.white_share(pixels, self.succession.pace()));
                let sighting = self.liquid.look(&mut self.edges)?;
                let segmented = Instant::now();
                (self.follow(sighting, pixels), segmented)
            }
        };
        let edge_tells_focus = measured.area_px2 > 0.0 && self.liquid.rules().edge_tells_focus;
        let untold = measured.doubt == Doubt::None && !edge_tells_focus;
        let measured = if untold && self.rim.is_blurred(pixels, measured.area_px2 > 0.0) {
            Measurement::nothing(0.0, Doubt::Blurred)
        } else {
            measured
        };
        let not_told = matches!(measured.doubt, Doubt::EdgeNotFound | Doubt::ColoursChanged | Doubt::BlownOut | Doubt::LightFlickers);
        if not_told && measured.area_px2 == 0.0 {
            let unsure = if measured.doubt == Doubt::ColoursChanged { Unsure::Lasts } else { self.liquid.rules().unsure };
            self.presence.saw_unsure(unsure);
        }
        let seen_dry = measured.doubt == Doubt::None && measured.area_px2 == 0.0;
        let measured = if seen_dry && !self.presence.is_gone(self.light_bgr(), |legs_px| self.liquid.dry_share(legs_px)) {
            Measurement::nothing(0.0, Doubt::EdgeNotFound)
        } else {
            measured
        };
        self.liquid.hold_ground(self.presence.holds(measured.area_px2 > 0.0));
        let confidence = match measured.doubt {
            _ if measured.area_px2 > 0.0 => confidence::of_stream(self.liquid.basis(), measured.confidence),
            Doubt::None => confidence::of_nothing(measured.confidence),
            _ => 0.0,
        };
        // A line that is followed without being told is no measurement.
        let told = measured.doubt != Doubt::EdgeNotFound;
        let measured = if told { Measurement { confidence, ..measured } } else { Measurement::nothing(0.0, measured.doubt) };
        let done = Instant::now();
        let ns = |from: Instant, to: Instant| to.duration_since(from).as_nanos() as u64;
        self.stages = Stages {
            rays_ns: ns(start, sampled),
            checks_ns: ns(sampled, checked),
            segment_ns: ns(checked, segmented),
            line_ns: ns(segmented, done),
        };
        Ok(measured)
    }

    /// Mean levels of blue, green and red of the ground, or, where they are not known, of the picture.
    fn light_bgr(&self) -> [f32; 3] {
        self.liquid.ground_bgr().unwrap_or_else(|| self.light.mean_bgr())
    }

    /// The measurement of what the liquid saw.
    fn follow(&mut self, sighting: Sighting, pixels: RegionPixels) -> Measurement {
        match sighting {
            Sighting::Dry { confidence } => Measurement::nothing(confidence, Doubt::None),
            Sighting::Unsure(doubt) => Measurement::nothing(0.0, doubt),
            Sighting::Stream { seen_share, doubt } => self.measure_stream(seen_share, doubt, pixels),
        }
    }

    /// The triangle of a stream whose coarse edge is in `self.edges`.
    fn measure_stream(&mut self, seen_share: f32, doubt: Doubt, pixels: RegionPixels) -> Measurement {
        let Some(first) = self.line.first_line(&self.edges) else { return Measurement::nothing(0.0, Doubt::EdgeNotFound) };
        // What is too small to be a stream may be the root of one that is doubted.
        let too_small = Measurement::nothing(if doubt == Doubt::None { seen_share } else { 0.0 }, doubt);
        if self.axes.area_px2(first.legs_px) < self.liquid.rules().first_area_least_px2 {
            return too_small;
        }
        let fine = self.line.fine_line(&first, seen_share, &self.edges, pixels, self.liquid.as_ref());
        let fine = match self.liquid.confirm(fine, self.light.mean_level()) {
            Ok(fine) => fine,
            Err(doubt) => return Measurement::nothing(0.0, doubt),
        };
        let area_px2 = self.axes.area_px2(fine.legs_px);
        if area_px2 < self.area_min_px2 {
            return too_small;
        }
        let [a, b] = fine.legs_px;
        if b > LEGS_STEEP * a {
            return Measurement::nothing(0.0, Doubt::EdgeNotFound);
        }
        let corner = |r: f32, axis: [f32; 2]| self.in_image(self.axes.at(r, axis));
        let ([x0, y0], [x1, y1], [x2, y2]) = (corner(0.0, self.axes.x), corner(a, self.axes.x), corner(b, self.axes.y));
        let doubt = if doubt == Doubt::None && fine.width_px > BLURRED_PX { Doubt::Blurred } else { doubt };
        match doubt {
            Doubt::ColoursChanged => self.presence.saw_part(area_px2, fine.legs_px, self.light_bgr()),
            _ => self.presence.saw(area_px2, fine.legs_px, self.light_bgr()),
        }
        Measurement { area_px2, confidence: fine.confidence, doubt, triangle_px: [x0, y0, x1, y1, x2, y2] }
    }
}
