//! Clear water, which is told from the background by what does not move with it.
//!
//! Water has no colour, but it bends light: its outline shows a band of the room instead of what stands behind, and inside it the
//! background is displaced. The container turns, so the background moves in the picture as one rigid piece, while the stream's outline
//! stays. So the picture is made small (320 px for the whole width), and in each frame:
//!
//! 1. [`flicker`] tells whether the light flickers, and [`light`] divides out what bands and colours of the light differ from those on the
//!    remembered ground.
//! 2. [`background`] remembers the dry background as one picture that is fixed in the world, and finds how it lies in the camera's picture
//!    ([`motion`], [`rigid`]; [`follow`] is the inner loop of remembering).
//! 3. [`evidence`] compares the memory and an earlier picture, both moved, with the picture along [`rays`] from the lip. What differs from
//!    the memory is wet. Where the ground was hidden until now, or is as bright as the water's rim, a step in colour counts that the
//!    earlier picture, moved, does not explain.
//! 4. [`lines`] finds the line from axis to axis with the best evidence, and [`water`] decides whether it is a stream.
//! 5. The full picture's profiles across that line must confirm it ([`profile_edges`]).
//! 6. What cannot be told is said by name: a rim that is too faint for a line ([`faint`]), a lamp's reflection at the lip, ground that has changed there, and before a pattern light that
//!    flickers or wanders, pictures that are missing again and again ([`disturbed`]) and a memory that has slipped ([`ground`]).
//!
//! Until [`vouched`] has evidence that the remembered ground is dry, neither a stream before a pattern is told, nor anywhere that none flows. Called on the
//! extraction thread. All pictures and tables are kept, so nothing is allocated after the second frame. The only failures are OpenCV's.

mod background;
mod disturbed;
mod evidence;
mod faint;
mod flicker;
mod follow;
mod ground;
mod light;
mod lines;
mod motion;
mod profile_edges;
mod rays;
mod rigid;
mod vouched;
mod water;

use opencv::boxed_ref::BoxedRef;
use opencv::core::{Mat, Size};
use opencv::imgproc;
use shared::messages::{Doubt, PixelFormat};

use self::background::{Background, DryPlaces, WetPlaces};
use self::disturbed::Disturbed;
use self::evidence::{CALM, Evidence};
use self::faint::Faint;
use self::flicker::Flicker;
use self::ground::{DARK_CONFIDENCE, Ground};
use self::light::Light;
use self::lines::Lines;
use self::rays::{RIM_PX, Rays};
use self::vouched::Vouched;
use self::water::{Candidate, Verdict, Water};
use super::confidence::Basis;
use super::geometry::{Axes, LinearField};
use super::liquid::{FineLine, LineRules, Liquid, PROFILE_SAMPLES, Profile, ProfileEdge, Sighting, Unsure};
use super::pace::Pace;
use super::reflection::Reflection;

// "Tuned" below means that the value was tuned on seeds 101 to 104 of `evaluate-camera`; see docs/VISION.md.

/// Width of the whole small picture, px. All lengths of these files are px of the small picture where nothing else is said. Chosen by hand,
/// for speed.
const WIDTH_PX: f32 = 320.0;
/// Pictures are compared with an earlier one until the background has moved so far, px, because slow motion tells little from frame to
/// frame. Tuned.
const REFER_PX: f32 = 1.5;
/// Pictures are compared with the same earlier one for no more than this many frames. Tuned.
const REFER_FRAMES: u32 = 4;
/// There is no line when a smaller share of the profiles than this shows an edge. Tuned.
const PROFILES_LEAST: f32 = 0.2;
/// Points for the motion keep so far away from the stream's line, on either axis, px. Tuned.
const KEEP_AWAY_PX: f32 = 5.0;

/// While lamps flicker, a stream has to be seen in so many pictures, and after it so many may not show none. Tuned on seed 101 of
/// `evaluate-camera --faults`.
const FLICKER_PICTURES: u32 = 5;
/// Legs of a stream that is as small as any that is measured, px. Chosen by hand: 200 px^2 of a picture 640 px wide.
const LIP_PX: f32 = 10.0;
/// Before a pattern, it is not known whether something flows where this share of such a stream's place is known ground that has changed.
/// Tuned on seed 101 of `evaluate-camera --faults`.
const LIP_CHANGED: f32 = 0.4;
/// Nor is it where this share has, if that is the greater part of what is known of the place. Tuned on seeds 1002 to 1011 of `evaluate-camera --faults`.
const LIP_CHANGED_LEAST: f32 = 0.1;
/// Before a pattern, the lip is known where this share of such a stream's place was seen dry. Tuned on the same seeds.
const LIP_KNOWN: f32 = 0.5;
/// Where it is not, a line with a score above this may be a stream that begins. Tuned on the same seeds: 0.25 doubts 13 % of the dry pictures before a
/// chess board, this 10 % and 0.45 1 %, which is too late for most streams.
const MAY_BEGIN_SCORE: f32 = 0.35;
/// And with an edge on a share of its length above this. Tuned on the same seeds.
const MAY_BEGIN_EDGE: f32 = 0.55;
/// Before an even ground, it is not known where this share has. Chosen by hand: a bead that hangs at the lip, which is no stream, covers half of it.
const EVEN_LIP_CHANGED: f32 = 0.7;
/// Legs of the largest bead that hangs at the lip, with its blur, px. Chosen by hand: [`Water`] takes less than 24 px^2 for a bead.
const BEAD_PX: f32 = 8.0;
/// Legs of a bead's surroundings, px. Chosen by hand: as many samples as the bead itself.
const BEAD_ROUND_PX: f32 = 13.0;

/// Finds the stream of clear water in the pictures of one camera.
pub(crate) struct ClearWater {
    /// Pixels of the full picture per pixel of the small one.
    scale: f32,
    /// Size of the small region, px.
    size: Size,
    /// The axes in the small region.
    axes: Axes,
    rays: Rays,
    lines: Lines,
    background: Background,
    light: Light,
    flicker: Flicker,
    reflection: Reflection,
    pace: Pace,
    /// Whether a lamp's reflection hides the lip.
    hidden: bool,
    disturbed: Disturbed,
    vouched: Vouched,
    evidence: Evidence,
    water: Water,
    // Pictures, kept from frame to frame.
    /// The small region, with three bytes a pixel.
    small: Mat,
    /// The same, with four bytes a pixel.
    now: Mat,
    /// The earlier picture, of the same kind, with which new ones are compared: the last one, or an older one since which the background
    /// has not moved far.
    earlier: Mat,
    /// Number of frames that were compared with the same earlier picture.
    compared: u32,
    /// A picture was compared with the ground.
    looked: bool,
    /// The present picture was.
    judged: bool,
    /// Legs of a stream that may still be where it was last seen, px.
    held: Option<[f32; 2]>,
    /// What is known of the ground as a whole.
    ground: Ground,
    /// Pictures since a stream was seen.
    unseen: u32,
    /// Pictures in a row in which the full picture confirmed a stream.
    confirmed: u32,
    /// Share of the last stream's line on ground that was seen dry.
    known_share: f32,
    faint: Faint,
}

impl ClearWater {
    /// For a region of `region_px` (width, height) of a picture `width_px` wide; `axes` are relative to the region. `None` if no outline that
    /// is tried lies in the region, so that no stream would ever be seen.
    pub(crate) fn new(axes: &Axes, region_px: [i32; 2], width_px: u32) -> opencv::Result<Option<Self>> {
        let scale = (width_px as f32 / WIDTH_PX).round().max(1.0);
        let size = Size::new((region_px[0] / scale as i32).max(8), (region_px[1] / scale as i32).max(8));
        let axes = Axes { lip_px: axes.lip_px.map(|v| small(v, scale)), ..*axes };
        let rays = Rays::new(&axes, size);
        let lines = Lines::new(axes, &rays, size);
        if lines.is_empty() {
            return Ok(None);
        }
        Ok(Some(Self {
            scale,
            size,
            axes,
            lines,
            background: Background::new(size)?,
            light: Light::new(size),
            flicker: Flicker::new(size),
            reflection: Reflection::default(),
            pace: Pace::CHOSEN,
            hidden: false,
            disturbed: Disturbed::new(),
            vouched: Vouched::new(),
            evidence: Evidence::new(&rays, size)?,
            rays,
            water: Water::new(),
            small: Mat::default(),
            now: Mat::default(),
            earlier: Mat::default(),
            compared: 0,
            looked: false,
            judged: false,
            held: None,
            ground: Ground::new(),
            unseen: u32::MAX,
            confirmed: 0,
            known_share: 0.0,
            faint: Faint::new(),
        }))
    }

    /// Height above the rim's light, px.
    fn height_px(&self) -> LinearField {
        let (x, turn) = (self.axes.x, self.axes.sine().signum());
        let above_edge = LinearField::from_zero(self.axes.lip_px, -x[1] * turn, x[0] * turn);
        LinearField { at_origin: above_edge.at_origin - RIM_PX, ..above_edge }
    }

    /// Distance to the right of the container's left side, px.
    fn right_px(&self) -> LinearField {
        let (y, turn) = (self.axes.y, self.axes.sine().signum());
        LinearField::from_zero(self.axes.lip_px, y[1] * turn, -y[0] * turn)
    }

    /// The share `u / a + v / b` of the way from the lip to the line with the legs `a` and `b`, px.
    fn line_share(&self, [a, b]: [f32; 2]) -> LinearField {
        let (x, y, sine) = (self.axes.x, self.axes.y, self.axes.sine());
        LinearField::from_zero(self.axes.lip_px, (y[1] / a - x[1] / b) / sine, (x[0] / b - y[0] / a) / sine)
    }

    /// Finds the light of the present picture, and how the memory lies in it; `exposure` is how its light differs from that of the last one. Returns whether
    /// the light was told.
    #[inline(always)]
    fn follow_ground(&mut self, exposure: f32, height_px: LinearField) -> opencv::Result<bool> {
        self.background.expect_gain(exposure);
        let wet = self.water.stream().map(|s| {
            let line_share = self.line_share(s.legs_px.map(|v| v + KEEP_AWAY_PX));
            WetPlaces { line_share, right_px: self.right_px() }
        });
        // An even ground tells the light wherever it lies. A pattern tells it where it was found.
        let told = self.light.divide_out(&mut self.now, &self.background, height_px, wet)?;
        self.background.correct_gain(self.light.exposure());
        self.background.register(&self.now, height_px, wet)?;
        if !told {
            self.light.divide_out(&mut self.now, &self.background, height_px, wet)?;
            self.background.correct_gain(self.light.exposure());
        }
        Ok(told)
    }

    #[inline(always)]
    fn look_for_stream(&mut self, edges_px: &mut Vec<[f32; 2]>) -> opencv::Result<Sighting> {
        edges_px.clear();
        let height_px = self.height_px();
        // The first picture is compared with nothing.
        let mut sighting = Sighting::Unsure(Doubt::EdgeNotFound);
        self.faint.next_picture();
        let exposure = self.flicker.look(&self.now)?;
        if !self.background.is_new() {
            let told = self.follow_ground(exposure, height_px)?;
            self.evidence.compare(&self.rays, [&self.now, &self.earlier], &self.background, height_px, self.flicker.flickers())?;
            (self.looked, self.judged) = (true, true);
            self.ground.see_light(self.evidence.level(), profile_edges::least_difference(self.evidence.noise()));
            let worthless = !self.flicker.flickers() && self.ground.differs_by(self.evidence.noise());
            let moved = self.background.moved();
            self.evidence.weigh(&self.rays, &moved, self.water.stream(), self.ground.is_known_pattern())?;
            let best = self.lines.best(&self.evidence, &self.rays, &moved, self.water.stream())?.map(|found| {
                (found, self.lines.legs_px(found.line), self.lines.earlier_picture(found.line, &self.evidence, &self.rays, &moved))
            });
            let verdict = self.water.decide(best, self.evidence.strange_share(), self.held.is_some());
            sighting = match (verdict, best) {
                // Where bands cannot be divided out, or only now and then, neither a line nor its absence means anything.
                // So it is where they left a pattern in the memory of an even ground.
                _ if (!told || self.ground.is_pattern() || !self.evidence.even()) && self.flicker.flickers() => {
                    Sighting::Unsure(Doubt::LightFlickers)
                }
                // Before an even ground nothing can slip, and a line needs no memory.
                _ if self.ground.is_pattern() && self.ground.has_slipped() => Sighting::Unsure(Doubt::EdgeNotFound),
                (Verdict::Stream, Some((found, ..))) => {
                    self.known_share = found.known;
                    let scale = self.scale;
                    self.lines.edges(found.line, &self.evidence, &self.rays, |v| (v + 0.5) * scale - 0.5, edges_px);
                    // Before a pattern that was not seen dry, the line may be the pattern's own. It is followed all the same.
                    let doubt = if self.ground.is_pattern() && !self.vouched.is_dry() { Doubt::EdgeNotFound } else { Doubt::None };
                    Sighting::Stream { seen_share: found.edge_share.min(1.0), doubt }
                }
                _ if self.light.flickers() => Sighting::Unsure(Doubt::LightFlickers),
                (Verdict::Unsure, _) => Sighting::Unsure(Doubt::EdgeNotFound),
                _ if self.flicker.flickers() && self.unseen < self.pace.pictures(FLICKER_PICTURES) => {
                    Sighting::Unsure(Doubt::LightFlickers)
                }
                _ if self.lip_has_changed() => Sighting::Unsure(Doubt::EdgeNotFound),
                (_, Some((found, ..))) if self.may_begin(&found) => Sighting::Unsure(Doubt::EdgeNotFound),
                _ if self.ground.is_too_dark() => Sighting::Unsure(Doubt::TooDark),
                _ if !self.ground.is_pattern() && self.faint.sees(self.evidence.faint_band(&self.rays), self.pace) => {
                    Sighting::Unsure(Doubt::EdgeNotFound)
                }
                _ if self.vouched.see_none(&self.evidence, &self.rays) => Sighting::Dry { confidence: 1.0 },
                _ => sighting,
            };
            if verdict != Verdict::Dry {
                self.vouched.see_other();
            }
            if matches!(sighting, Sighting::Stream { .. }) {
                self.unseen = 0;
            } else {
                (self.unseen, self.confirmed) = (self.unseen.saturating_add(1), 0);
            }
            if self.water.is_elsewhere(self.evidence.strange_share(), self.held.is_some()) || (worthless && self.ground.is_pattern()) {
                self.background.forget()?;
                self.ground.forget();
                self.vouched.doubt();
            }
        }
        self.remember(height_px)?;
        self.disturbed.look(self.flicker.jumps());
        let hidden = self.hidden.then_some(Doubt::BlownOut);
        let disturbed = self.disturbed.doubt().filter(|_| self.ground.is_pattern());
        Ok(hidden.or(disturbed).map_or(sighting, Sighting::Unsure))
    }

    /// As [`Evidence::shares`], of the triangle with the legs `to`, px, but for what is within that with the legs `from`, if there is one.
    fn shares(&self, from: Option<[f32; 2]>, to: [f32; 2]) -> [f32; 2] {
        let [gain, _] = self.background.gains();
        let from = from.map_or(LinearField::constant(1.0), |legs_px| self.line_share(legs_px));
        self.evidence.shares(&self.rays, [from, self.line_share(to)], !self.ground.is_pattern(), gain)
    }

    /// Whether ground that is known has changed where a small stream would be. Before a pattern little of it may be known: then most of that counts.
    fn lip_has_changed(&self) -> bool {
        let [dry, wet] = self.shares(None, [LIP_PX; 2]);
        if self.ground.is_pattern() { wet >= LIP_CHANGED || (wet >= LIP_CHANGED_LEAST && wet > dry) } else { wet >= EVEN_LIP_CHANGED }
    }

    /// Whether a stream may begin along the line that was `found`, of too little evidence for one, on a pattern that has just come out from behind the glass.
    fn may_begin(&self, found: &Candidate) -> bool {
        let [dry, _] = self.shares(None, [LIP_PX; 2]);
        self.ground.is_pattern() && dry < LIP_KNOWN && found.score > MAY_BEGIN_SCORE && found.edge_share > MAY_BEGIN_EDGE
    }

    /// Takes what is dry over into the memory of the background, and chooses the picture with which the next ones are compared.
    #[inline(always)]
    fn remember(&mut self, height_px: LinearField) -> opencv::Result<()> {
        let recent = self.water.recent_legs_px();
        let spared = recent
            .into_iter()
            .chain(self.held)
            .chain(self.faint.may_flow().then(|| self.lines.most_px()))
            .reduce(|one, other| [0, 1].map(|k| one[k].max(other[k])));
        let near = spared.map(|legs_px| {
            let [a, b] = legs_px.map(|v| v.max(1.0));
            // The outline bulges, and a stream grows from frame to frame.
            let bulge = 2.0 + 0.1 * (a * b).sqrt();
            let inner = self.line_share([a + 1.4 * bulge, b + 1.4 * bulge]);
            let outer = self.line_share([1.35 * a + 8.0, 1.35 * b + 8.0]);
            (WetPlaces { line_share: inner, right_px: self.right_px() }, outer)
        });
        let dry = DryPlaces {
            height_px,
            flows: self.water.flows() || self.held.is_some() || self.faint.may_flow(),
            near,
            calm: CALM * self.evidence.noise(),
        };
        let is_new = self.background.is_new();
        self.background.remember(&self.now, dry)?;
        self.compared += 1;
        if is_new || self.compared >= self.pace.pictures(REFER_FRAMES) || self.background.travelled_px() >= REFER_PX {
            std::mem::swap(&mut self.now, &mut self.earlier);
            if !is_new {
                self.vouched.moved(self.background.travelled_px());
            }
            self.background.refer();
            self.compared = 0;
        }
        Ok(())
    }
}

/// A coordinate of the full region in the small one, px.
fn small(v: f32, scale: f32) -> f32 {
    (v + 0.5) / scale - 0.5
}

/// [`ClearWater::look_for_stream`] with the processor's widest registers. A closure would be compiled apart, without them.
struct Search<'a> {
    water: &'a mut ClearWater,
    edges_px: &'a mut Vec<[f32; 2]>,
}

impl pulp::NullaryFnOnce for Search<'_> {
    type Output = opencv::Result<Sighting>;

    #[inline(always)]
    fn call(self) -> Self::Output {
        self.water.look_for_stream(self.edges_px)
    }
}

impl Liquid for ClearWater {
    fn reads(&self, _format: PixelFormat) -> bool {
        true
    }

    fn rules(&self) -> LineRules {
        // How small a stream may be is decided when its line is confirmed, and water's own edge tells nothing of focus. Before a pattern single pictures
        // of water that was not told for long look dry.
        let unsure = if self.ground.is_pattern() { Unsure::LastsOnceDry } else { Unsure::Passes };
        LineRules { profiles_least: PROFILES_LEAST, first_area_least_px2: 0.0, edge_tells_focus: false, unsure }
    }

    /// The middle four of each block's pixels are averaged, so half of the memory of a large picture is never read.
    fn take(&mut self, region: &BoxedRef<Mat>) -> opencv::Result<()> {
        imgproc::resize(region, &mut self.small, self.size, 0.0, 0.0, imgproc::INTER_LINEAR)?;
        imgproc::cvt_color_def(&self.small, &mut self.now, imgproc::COLOR_BGR2BGRA)
    }

    fn sampled(&self) -> &Mat {
        &self.small
    }

    fn look(&mut self, edges_px: &mut Vec<[f32; 2]>) -> opencv::Result<Sighting> {
        pulp::Arch::new().dispatch(Search { water: self, edges_px })
    }

    fn basis(&self) -> Basis {
        if self.evidence.even() { Basis::EvenGround } else { Basis::Pattern(self.known_share) }
    }

    fn ground_is_even(&self) -> Option<bool> {
        // The first picture is compared with nothing.
        self.looked.then(|| self.evidence.even())
    }

    fn see_lip(&mut self, white_share: f32) {
        self.hidden = self.reflection.hides_lip(white_share, 0.0, false, self.pace);
    }

    fn bears_white(&mut self, half_white: bool) -> bool {
        !half_white
    }

    fn lose_picture(&mut self, doubt: Doubt) {
        self.disturbed.lose(doubt);
        self.water.lose_picture();
    }

    fn set_pace(&mut self, pace: Pace) {
        self.pace = pace;
        self.background.set_pace(pace);
        self.disturbed.set_pace(pace);
        self.flicker.set_pace(pace);
        self.ground.set_pace(pace);
        self.vouched.set_pace(pace);
        self.water.set_pace(pace);
    }

    /// An even ground is still known. How a pattern lies in the picture is not: what is remembered of it would be compared with other places.
    fn interrupt(&mut self) -> opencv::Result<()> {
        if self.ground.is_pattern() {
            self.background.forget()?;
            self.ground.forget();
        }
        self.background.rest();
        self.vouched.doubt();
        self.water.interrupt();
        Ok(())
    }

    fn ground_bgr(&self) -> Option<[f32; 3]> {
        None
    }

    fn dry_share(&self, legs_px: [f32; 2]) -> f32 {
        let legs_px = legs_px.map(|v| v / self.scale);
        // Inside a stream that is wider than the region there is no edge, and its water takes as little light as a lamp that has dimmed.
        if self.lines.may_leave(legs_px) {
            return 0.0;
        }
        // A bead that stays at the lip is no stream, and before an even ground it is told from one.
        let (from, to) =
            if self.ground.is_pattern() { (None, legs_px) } else { (Some([BEAD_PX; 2]), legs_px.map(|v| v.max(BEAD_ROUND_PX))) };
        let [dry, _] = self.shares(from, to);
        dry
    }

    fn hold_ground(&mut self, legs_px: Option<[f32; 2]>) {
        // Of a picture that could not be looked at, nothing is known.
        if std::mem::take(&mut self.judged) && legs_px.is_none() {
            self.ground.see(self.evidence.seems_even());
        }
        self.held = legs_px.map(|legs| legs.map(|v| v / self.scale));
    }

    fn edge_on(&self, profile: &Profile) -> Option<ProfileEdge> {
        let ground = self.background.ground();
        let mut differs = [[0.0f32; 3]; PROFILE_SAMPLES];
        for (j, (differs, seen)) in differs.iter_mut().zip(&profile.colours).enumerate() {
            let place = profile.place_px(j as f32).map(|v| small(v, self.scale));
            let Some(dry) = ground.at(place) else { return profile_edges::on_unknown_ground(profile) };
            let gains = self.light.gains(place[1]);
            *differs = std::array::from_fn(|c| seen[c] / gains[c] - dry[c]);
        }
        profile_edges::on_known_ground(profile, &differs, self.evidence.noise(), self.water.stream().map(|s| s.band))
    }

    fn confirm(&mut self, line: Option<FineLine>, mean_level: f32) -> Result<FineLine, Doubt> {
        let sine = self.axes.sine().abs();
        let line = self.water.confirm(line, mean_level, self.scale, sine)?;
        if self.ground.is_too_dark() && line.confidence < DARK_CONFIDENCE {
            return Err(Doubt::TooDark);
        }
        // What bands left over is elsewhere in the next picture.
        self.confirmed += 1;
        if self.confirmed < self.pace.pictures(FLICKER_PICTURES) && self.flicker.flickers() { Err(Doubt::LightFlickers) } else { Ok(line) }
    }
}
