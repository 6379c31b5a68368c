//! Evidence of water on the rays from the lip: what differs from the remembered background, steps in colour, and what an earlier
//! picture, moved with the background, does not explain.
//!
//! Called on the extraction thread, within a `pulp` dispatch: what is marked `inline(always)` runs with the processor's widest registers.
//! All pictures and tables are kept, so nothing is allocated after the second frame. The only failures are OpenCV's.

mod known_ground;

use opencv::core::{self, CV_16SC2, CV_32FC1, Mat, Scalar, Size, Vec4b};
use opencv::imgproc;
use opencv::prelude::*;

use super::background::Background;
use super::rays::{CELLS, Colours, RAYS, Rays, Row, SAMPLES, Window, apart, around, colours, cut_off, row, sizes, sums, whole};
use super::rigid::RigidMap;
use super::water::Stream;
use crate::vision::geometry::LinearField;
use crate::vision::picture::median;

// "Tuned" below means that the value was tuned on seeds 101 to 104 of `evaluate-camera`; see docs/VISION.md.

/// Distance from the lip, px: nearer, the ground tells whether the background is even; further away, it tells whether this is another
/// picture. Tuned.
const MIDDLE_PX: f32 = 60.0;
/// Least noise, grey levels: that of rounding to whole levels.
const NOISE_LEAST: f32 = 0.8;
/// Least noise as a share of the background's brightness, because the exposure is not known better. Tuned.
const NOISE_SHARE: f32 = 0.012;
/// The noise in units of the median difference where the background is even. Tuned.
const NOISE_MEDIANS: f32 = 1.1;
/// The noise when too little of the background is known to tell, grey levels. Chosen by hand; no measurement is recorded.
const NOISE_UNKNOWN: f32 = 2.0;
/// More than this is no noise, grey levels: something else stands there, and it must not look calm. Chosen by hand: on the tuning seeds 99 % of the
/// pictures have less than 5.
const NOISE_MOST: f32 = 6.0;
/// Background is even where nine in ten of its samples near the lip have a slope below this many times the noise, grey levels a px. Tuned.
const EVEN_NOISES: f32 = 1.2;
/// The same beside the noise: the slope that rounding alone makes, grey levels a px. Tuned.
const EVEN_ROUNDING: f32 = 0.6;
/// One in so many samples may be steeper than the bound for an even background, wherever it lies: a dark joint between boards that comes near the lip
/// covers more, and was taken for a stream before a background that only seemed even. Seen on seed 160291.
const STEEP_ONE_IN: usize = 100;
/// How much steeper that one sample may be than the bound near the lip. Chosen by hand: walls show at most 1.3, with bands of 20 %, and dim wood in warm
/// light, at rest, 6.
const STEEP_MOST: f32 = 2.0;
/// Fewer samples of even background than this tell no noise. Chosen by hand; no measurement is recorded.
const NOISE_SAMPLES: usize = 25;
/// Share of the background's slope that counts as error of its place, px. Tuned.
const SLOPE_SHARE: f32 = 0.25;
/// A difference from the memory of this size, in units of the noise, is neither dry nor wet. Tuned.
const WET_FROM: f32 = 2.2;
/// A difference that is larger by this is fully wet, and one that is smaller by this fully dry, in units of the noise. Tuned.
const WET_SPAN: f32 = 2.0;
/// A difference up to this, in units of the noise, is still background. Tuned.
pub(super) const CALM: f32 = 5.0;
/// A difference from the moved earlier picture of this size, in units of the noise, is neither explained nor unexplained.
/// Twice this is fully unexplained, and no difference is fully explained. Tuned.
const UNEXPLAINED_FROM: f32 = 2.0;
/// Background that has moved by more than this since the earlier picture is told from what stands still, px. Tuned.
const MOVES_PX: f32 = 1.2;
/// A step in colour counts from this share of the stream's usual one on. Tuned.
const STEP_FROM: f32 = 0.35;
/// A step counts fully when it is larger than that by this share of the usual one. Tuned.
const STEP_SPAN: f32 = 0.3;
/// The usual step of a stream that is not known yet, in units of the noise. Tuned.
const STEP_NOISES: f32 = 6.0;
/// Weight of a moved picture's evidence where the memory knows nothing, to begin a stream. Tuned.
const UNKNOWN_WEIGHT: f32 = 0.5;
/// Weight of what is wet just inside a line. Tuned.
const WET_INSIDE: f32 = 1.3;
/// Weight of what is wet just outside a line. Tuned.
const WET_OUTSIDE: f32 = 0.5;
/// Weight of what the moved earlier picture does not explain on a line. Tuned.
const ACROSS_WEIGHT: f32 = 0.65;
/// Weight of what the moved earlier picture does not explain further out. Tuned.
const BEYOND: f32 = 0.4;
/// Weight of a step where the background rests, and only the earlier picture is known. Tuned.
const STEP_WEIGHT: f32 = 0.9;

/// Just inside a line.
static INSIDE: Window = Window::new(-4, 0);
/// Just outside a line.
static OUTSIDE: Window = Window::new(1, 7);
/// On either side of a line.
static ACROSS: Window = Window::new(-3, 3);
/// Further out than a line, as far as the moved earlier picture tells.
static FURTHER: Window = Window::new(3, 12);
/// Further out than a line, as far as the memory tells.
static FAR: Window = Window::new(2, 25);

/// The evidence of one picture on all samples of all rays, one ray after the other.
pub(super) struct Evidence {
    /// Size of the small picture.
    size: Size,
    /// Fixed-point maps from the rays to the picture, as `cv::convertMaps` makes them.
    fixed_maps: [Mat; 2],
    /// Maps in x and y from the rays, and from the places beside them, to the memory.
    memory_maps: [Mat; 2],
    /// Maps in x and y from the rays to the earlier picture.
    earlier_maps: [Mat; 2],
    /// The picture along the rays, one ray a row.
    ray_now: Mat,
    /// The memory along the rays, and then along the places beside them, one ray a row.
    ray_memory: Mat,
    /// The earlier picture along the rays, one ray a row.
    ray_earlier: Mat,
    /// Difference from the memory, in units of the noise.
    away: Vec<f32>,
    /// Difference from the moved earlier picture, in units of the noise.
    away_earlier: Vec<f32>,
    /// Slope of the memory, grey levels a px.
    slopes: Vec<f32>,
    /// 1 where the memory is known, or 0.
    remembered: Vec<f32>,
    /// 1 where the moved earlier picture shows the place, or 0.
    shown: Vec<f32>,
    /// What each sample adds to a line through it.
    value: Vec<f32>,
    /// The share of that which rests on known ground.
    known: Vec<f32>,
    /// How little the moved earlier picture explains, -1 (all) to 1 (nothing).
    unexplained: Vec<f32>,
    /// The share of a sample's surroundings that the moved earlier picture shows.
    shown_around: Vec<f32>,
    /// The step in colour at each sample, grey levels.
    steps: Vec<f32>,
    /// Noise of the picture and of what is remembered, grey levels.
    noise: f32,
    /// Mean brightness of the known background in the picture's light, grey levels.
    level: f32,
    /// Share of the known background far from the lip that differs from the memory.
    strange_share: f32,
    /// The slope of the memory that one in a hundred of its samples exceeds, grey levels a px; 0 where none is known and while lamps flicker.
    steepest: f32,
    /// Whether the ground of this picture has no pattern near the lip, and no steep edge that could come there.
    seems_even: bool,
    /// And is not known to have one.
    even: bool,
    /// Slopes or differences whose median is taken. Kept from frame to frame.
    scratch: Vec<f32>,
}

/// What the step, the memory and the earlier picture say along one ray.
struct RayEvidence {
    /// The step in colour, grey levels.
    steps: Row,
    /// What the step says, from -1 (no edge) to 1.
    step_says: Row,
    /// What the memory says, from -1 (no edge) to 1.5.
    memory_says: Row,
    /// How sure the memory is, 0 to 1.
    sure: Row,
    /// What the moved earlier picture says, from about -1 (no edge) to 0.65.
    earlier_says: Row,
    /// How much the background moves, 0 to 1.
    moving: Row,
    /// How little the moved earlier picture explains, -1 (all) to 1 (nothing).
    unexplained: Row,
    /// The share of the surroundings that the moved earlier picture shows.
    shown_around: Row,
}

fn map(times: usize) -> opencv::Result<Mat> {
    Mat::new_rows_cols_with_default((times * RAYS) as i32, SAMPLES as i32, CV_32FC1, Scalar::default())
}

impl Evidence {
    /// For small pictures of `size` with these rays.
    pub(super) fn new(rays: &Rays, size: Size) -> opencv::Result<Self> {
        let cells = || vec![0.0; CELLS];
        let (mut map_x, mut map_y) = (map(1)?, map(1)?);
        for (k, at) in [&mut map_x, &mut map_y].into_iter().enumerate() {
            at.data_typed_mut::<f32>()?.iter_mut().zip(&rays.places).for_each(|(v, place)| *v = place[k]);
        }
        let mut fixed_maps = [Mat::default(), Mat::default()];
        let [first, second] = &mut fixed_maps;
        imgproc::convert_maps(&map_x, &map_y, first, second, CV_16SC2, false)?;
        Ok(Self {
            size,
            fixed_maps,
            memory_maps: [map(2)?, map(2)?],
            earlier_maps: [map(1)?, map(1)?],
            ray_now: Mat::default(),
            ray_memory: Mat::default(),
            ray_earlier: Mat::default(),
            away: cells(),
            away_earlier: cells(),
            slopes: cells(),
            remembered: cells(),
            shown: cells(),
            value: cells(),
            known: cells(),
            unexplained: cells(),
            shown_around: cells(),
            steps: cells(),
            noise: NOISE_LEAST,
            level: 0.0,
            strange_share: 0.0,
            steepest: 0.0,
            seems_even: false,
            even: false,
            scratch: Vec::with_capacity(CELLS),
        })
    }

    /// What each sample adds to a line through it.
    pub(super) fn value(&self) -> &[f32] {
        &self.value
    }

    /// The share of that which rests on known ground.
    pub(super) fn known(&self) -> &[f32] {
        &self.known
    }

    /// How little the moved earlier picture explains, -1 (all) to 1 (nothing).
    pub(super) fn unexplained(&self) -> &[f32] {
        &self.unexplained
    }

    /// The share of a sample's surroundings that the moved earlier picture shows.
    pub(super) fn shown_around(&self) -> &[f32] {
        &self.shown_around
    }

    /// The step in colour at each sample, grey levels.
    pub(super) fn steps(&self) -> &[f32] {
        &self.steps
    }

    /// The picture along the rays.
    pub(super) fn seen(&self) -> opencv::Result<&[Vec4b]> {
        self.ray_now.data_typed()
    }

    /// Noise of the picture and of what is remembered, grey levels.
    pub(super) fn noise(&self) -> f32 {
        self.noise
    }

    /// Mean brightness of the known background in the picture's light, grey levels; 0 where none is known.
    pub(super) fn level(&self) -> f32 {
        self.level
    }

    /// Share of the known background far from the lip that differs from the memory.
    pub(super) fn strange_share(&self) -> f32 {
        self.strange_share
    }

    /// Whether the ground of this picture has no pattern near the lip, and no steep edge that could come there.
    pub(super) fn seems_even(&self) -> bool {
        self.seems_even
    }

    /// Whether it has none, and is not known to have one.
    pub(super) fn even(&self) -> bool {
        self.even
    }

    /// Compares the memory and the picture `earlier`, both moved, with the picture `now` along the rays. `height_px` is the height above
    /// the rim's light. While lamps flicker, what their bands leave over is noise.
    #[inline(always)]
    pub(super) fn compare(
        &mut self,
        rays: &Rays,
        [now, earlier]: [&Mat; 2],
        background: &Background,
        height_px: LinearField,
        flickers: bool,
    ) -> opencv::Result<()> {
        self.read_rays(rays, now, earlier, background, height_px)?;
        let (level_sum, level_count) = self.compare_rays(rays, background.gains())?;
        self.estimate_noise(level_sum, level_count, flickers);
        self.measure_strangeness(rays.first_from(MIDDLE_PX));
        Ok(())
    }

    /// Reads the picture, the memory and the earlier picture along the rays.
    #[inline(always)]
    fn read_rays(&mut self, rays: &Rays, now: &Mat, earlier: &Mat, background: &Background, height_px: LinearField) -> opencv::Result<()> {
        let (linear, replicate) = (imgproc::INTER_LINEAR, core::BORDER_REPLICATE);
        let [first, second] = &self.fixed_maps;
        imgproc::remap(now, &mut self.ray_now, first, second, linear, replicate, Scalar::default())?;
        background.recall(&rays.places, &mut self.memory_maps, &mut self.ray_memory)?;
        let [map_x, map_y] = &mut self.earlier_maps;
        let back = background.moved().inverse();
        let most = [self.size.width as f32 - 1.0, self.size.height as f32 - 1.0];
        let (columns, rows) = (map_x.data_typed_mut::<f32>()?, map_y.data_typed_mut::<f32>()?);
        for (i, (at_x, at_y)) in columns.iter_mut().zip(rows).enumerate() {
            let [x, y] = back.apply(rays.places[i]);
            let inside = x >= 0.0 && y >= 0.0 && x < most[0] && y < most[1] && height_px.at([x, y]) >= 0.0;
            self.shown[i] = if inside { rays.air[i] } else { 0.0 };
            (*at_x, *at_y) = (x, y);
        }
        imgproc::remap(earlier, &mut self.ray_earlier, map_x, map_y, linear, replicate, Scalar::default())
    }

    /// The differences and the memory's slopes on all rays, still in grey levels. Returns the sum of the known background's levels and
    /// the number of samples in it.
    #[inline(always)]
    fn compare_rays(&mut self, rays: &Rays, [gain, earlier_gain]: [f32; 2]) -> opencv::Result<(f32, f32)> {
        let (mut level_sum, mut level_count) = (0.0, 0.0f32);
        let (ones, factor) = ([1.0; SAMPLES], [gain / earlier_gain; SAMPLES]);
        for ray in 0..RAYS {
            let range = ray * SAMPLES..(ray + 1) * SAMPLES;
            let now = colours(self.ray_now.at_row(ray as i32)?, &ones);
            let (memory, beside) = (self.ray_memory.at_row::<Vec4b>(ray as i32)?, self.ray_memory.at_row::<Vec4b>((RAYS + ray) as i32)?);
            let ((factors, mut known), (factors_beside, known_beside)) = (whole(memory, gain), whole(beside, gain));
            known.iter_mut().zip(&rays.air[range.clone()]).for_each(|(known, air)| *known *= air);
            let (memory, beside) = (cut_off(colours(memory, &factors)), cut_off(colours(beside, &factors_beside)));
            let mut shown = [0.0; SAMPLES + 1];
            shown[..SAMPLES].copy_from_slice(&self.shown[range.clone()]);
            self.away[range.clone()].copy_from_slice(&apart(&now, &memory, &known));
            let earlier = cut_off(colours(self.ray_earlier.at_row(ray as i32)?, &factor));
            self.away_earlier[range.clone()].copy_from_slice(&apart(&now, &earlier, &shown));
            let (mut across, mut along) = ([[0.0; SAMPLES + 1]; 3], [[0.0; SAMPLES + 1]; 3]);
            for k in 0..3 {
                for r in 0..SAMPLES {
                    across[k][r] = known_beside[r] * (beside[k][r] - memory[k][r]);
                    along[k][r] = known[r + 1] * (memory[k][r + 1] - memory[k][r]);
                }
            }
            let (across, along) = (sizes(&across), sizes(&along));
            for (r, (slope, remembered)) in self.slopes[range.clone()].iter_mut().zip(&mut self.remembered[range]).enumerate() {
                (*slope, *remembered) = (known[r] * across[r].max(along[r]), known[r]);
                level_sum += known[r] * (memory[0][r] + memory[1][r] + memory[2][r]) / 3.0;
                level_count += known[r];
            }
        }
        Ok((level_sum, level_count))
    }

    /// The noise, from where the known background is even, and the differences in units of it. The brightness of the background is
    /// `level_sum` over `level_count`.
    #[inline(always)]
    fn estimate_noise(&mut self, level_sum: f32, level_count: f32, flickers: bool) {
        self.scratch.clear();
        self.scratch.extend((0..CELLS).step_by(3).filter(|i| self.remembered[*i] > 0.0).map(|i| self.slopes[i]));
        let even = median(&mut self.scratch);
        let count = self.scratch.len();
        // Bands of lamps are steep too, and are told by themselves.
        let steep = self.scratch.get_mut(count / 2..).filter(|upper| !upper.is_empty() && !flickers);
        self.steepest = steep.map_or(0.0, |upper| *upper.select_nth_unstable_by(upper.len() - 1 - count / STEEP_ONE_IN, f32::total_cmp).1);
        self.scratch.clear();
        let known = (0..CELLS).step_by(3).filter(|i| self.remembered[*i] > 0.0 && self.slopes[*i] <= even);
        self.scratch.extend(known.map(|i| self.away[i]));
        let noise = if self.scratch.len() > NOISE_SAMPLES { NOISE_MEDIANS * median(&mut self.scratch) } else { NOISE_UNKNOWN };
        let noise = if noise > NOISE_MOST && !flickers { NOISE_UNKNOWN } else { noise };
        self.level = level_sum / level_count.max(1.0);
        self.noise = noise.max(NOISE_LEAST).max(NOISE_SHARE * self.level);
        let per_noise = 1.0 / self.noise;
        for ((away, away_earlier), slope) in self.away.iter_mut().zip(&mut self.away_earlier).zip(&self.slopes) {
            *away = (*away - SLOPE_SHARE * slope).max(0.0) * per_noise;
            *away_earlier = (*away_earlier - SLOPE_SHARE * slope).max(0.0) * per_noise;
        }
    }

    /// The share of the known background that differs from the memory, from the sample `far_from` of each ray on.
    #[inline(always)]
    fn measure_strangeness(&mut self, far_from: usize) {
        let (mut strange, mut far) = (0usize, 0usize);
        for (away, remembered) in self.away.chunks_exact(SAMPLES).zip(self.remembered.chunks_exact(SAMPLES)) {
            for (away, remembered) in away.iter().zip(remembered).skip(far_from) {
                far += usize::from(*remembered > 0.0);
                strange += usize::from(*remembered > 0.0 && *away > CALM);
            }
        }
        self.strange_share = strange as f32 / far.max(1) as f32;
    }

    /// Whether what is known near the lip has no pattern, and nothing that is known has a steep edge: then what is not known has none either.
    #[inline(always)]
    fn looks_even(&mut self, rays: &Rays) -> bool {
        let near = rays.first_from(MIDDLE_PX);
        self.scratch.clear();
        let mut air = 0;
        for ray in 0..RAYS {
            for i in (ray * SAMPLES..ray * SAMPLES + near).step_by(2) {
                air += usize::from(rays.air[i] > 0.0);
                if self.remembered[i] > 0.0 {
                    self.scratch.push(self.slopes[i]);
                }
            }
        }
        let count = self.scratch.len();
        let bound = EVEN_NOISES * self.noise + EVEN_ROUNDING;
        count > air * 3 / 5
            && self.steepest < STEEP_MOST * bound
            && *self.scratch.select_nth_unstable_by(count * 9 / 10, f32::total_cmp).1 < bound
    }

    /// Weighs what each sample of each ray adds to a line through it. `moved` is the background's motion since the earlier picture;
    /// `stream` is the stream as it was last seen, and `patterned` says that the ground is known not to be even.
    #[inline(always)]
    pub(super) fn weigh(&mut self, rays: &Rays, moved: &RigidMap, stream: Option<&Stream>, patterned: bool) -> opencv::Result<()> {
        self.seems_even = self.looks_even(rays);
        let even = self.seems_even && !patterned;
        self.even = even;
        let flows = stream.is_some();
        for ray in 0..RAYS {
            let range = ray * SAMPLES..(ray + 1) * SAMPLES;
            let levels = colours(self.ray_now.at_row(ray as i32)?, &[1.0; SAMPLES]);
            let of = self.weigh_ray(ray, &levels, &rays.places[range.clone()], moved, stream);
            let (value, known) = (&mut self.value[range.clone()], &mut self.known[range.clone()]);
            for r in 0..SAMPLES {
                let by_memory = match (even, of.sure[r] < 0.5, flows) {
                    (true, true, _) => of.step_says[r],
                    // The exposure is not known better than a weak difference, and the stream's rim is a strong one.
                    (true, false, true) => 0.5 * (of.step_says[r] + of.memory_says[r]),
                    _ => of.memory_says[r],
                };
                let sure = if even { 1.0 } else { of.sure[r] };
                let moving = of.moving[r];
                let by_earlier = (1.0 - 0.5 * moving) * STEP_WEIGHT * of.step_says[r] + moving * of.earlier_says[r];
                // To begin, only what the moved earlier picture shows counts beside the memory.
                let weight = (1.0 - sure) * if flows { 1.0 } else { moving * UNKNOWN_WEIGHT };
                value[r] = sure * by_memory + weight * by_earlier;
                known[r] = if flows { sure } else { sure + weight };
            }
            self.steps[range.clone()].copy_from_slice(&of.steps);
            self.unexplained[range.clone()].copy_from_slice(&of.unexplained);
            self.shown_around[range].copy_from_slice(&of.shown_around);
        }
        Ok(())
    }

    /// What step, memory and earlier picture say along one ray with the colours `levels` at `places`.
    #[inline(always)]
    fn weigh_ray(&self, ray: usize, levels: &Colours, places: &[[f32; 2]], moved: &RigidMap, stream: Option<&Stream>) -> RayEvidence {
        let range = ray * SAMPLES..(ray + 1) * SAMPLES;
        let (away, away_earlier) = (&self.away[range.clone()], &self.away_earlier[range.clone()]);
        let (remembered, shown) = (&self.remembered[range.clone()], &self.shown[range]);
        let differs_from_rim = self.differs_from_rim(levels, stream);
        let [mut wet, mut far, mut sure, mut last, mut beyond, mut seen]: [Row; 6] = [[0.0; SAMPLES]; 6];
        for r in 0..SAMPLES {
            let how_wet = remembered[r] * ((away[r] - WET_FROM) / WET_SPAN).clamp(-1.0, 1.0);
            let tells = if how_wet < 0.0 { differs_from_rim[r] } else { remembered[r] };
            let how_wet = how_wet * tells;
            (wet[r], far[r], sure[r]) = (how_wet, how_wet.max(0.0), tells);
            let unexplained = shown[r] * ((away_earlier[r] - UNEXPLAINED_FROM) / UNEXPLAINED_FROM).clamp(-1.0, 1.0);
            (last[r], beyond[r], seen[r]) = (unexplained, unexplained.max(0.0), shown[r]);
        }
        let (wet, sure, last) = (sums(&wet), sums(&sure), sums(&last));
        let (wet_inside, wet_outside, wet_far) = (INSIDE.mean(&wet), OUTSIDE.mean(&wet), FAR.mean(&sums(&far)));
        let (sure_inside, sure_outside) = (INSIDE.mean(&sure), OUTSIDE.mean(&sure));
        let (unexplained, shown_around) = (ACROSS.mean(&last), ACROSS.mean(&sums(&seen)));
        let beyond = FURTHER.mean(&sums(&beyond));
        let (steps, step_says) = self.steps_of(levels, stream);
        let [mut memory_says, mut earlier_says, mut moving]: [Row; 3] = [[0.0; SAMPLES]; 3];
        for r in 0..SAMPLES {
            memory_says[r] = (WET_INSIDE * wet_inside[r] - WET_OUTSIDE * wet_outside[r] - wet_far[r]).clamp(-1.0, 1.5);
            earlier_says[r] = ACROSS_WEIGHT * unexplained[r] - BEYOND * beyond[r];
            let to = moved.apply(places[r]);
            let (dx, dy) = (to[0] - places[r][0], to[1] - places[r][1]);
            moving[r] = (((dx * dx + dy * dy).sqrt() - MOVES_PX) / MOVES_PX).clamp(0.0, 1.0) * shown_around[r];
        }
        RayEvidence {
            steps,
            step_says: around(&step_says),
            memory_says: around(&memory_says),
            sure: row(|r| 0.5 * (sure_inside[r] + sure_outside[r])),
            earlier_says,
            moving,
            unexplained,
            shown_around,
        }
    }

    /// How much the colours of a ray differ from those of the stream's rim, 0 to 1. Where the ground is as bright as the rim, not to
    /// differ from the ground means nothing.
    #[inline(always)]
    fn differs_from_rim(&self, levels: &Colours, stream: Option<&Stream>) -> Row {
        let Some(stream) = stream else { return [1.0; SAMPLES] };
        let per_noise = 1.0 / self.noise;
        let mut from_rim = *levels;
        for (levels, rim) in from_rim.iter_mut().zip(stream.band) {
            levels.iter_mut().for_each(|level| *level -= rim);
        }
        let apart = sizes(&from_rim);
        row(|r| ((apart[r] * per_noise - WET_FROM) / WET_SPAN).clamp(0.0, 1.0))
    }

    /// The steps in colour along a ray, grey levels, and what they say against the stream's usual step, -1 to 1.
    #[inline(always)]
    fn steps_of(&self, levels: &Colours, stream: Option<&Stream>) -> (Row, Row) {
        let usual = stream.map_or(STEP_NOISES * self.noise, |s| s.band[3]);
        let mut across = [[0.0; SAMPLES + 1]; 3];
        for k in 0..3 {
            for r in 2..SAMPLES - 2 {
                across[k][r] = 0.5 * (levels[k][r + 1] + levels[k][r + 2] - levels[k][r - 2] - levels[k][r - 1]);
            }
        }
        let steps = sizes(&across);
        (steps, row(|r| ((steps[r] - STEP_FROM * usual) / (STEP_SPAN * usual)).clamp(-1.0, 1.0)))
    }
}
