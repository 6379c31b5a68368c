//! Learns the liquid's colour from the pictures of one pour: what is often right over the lip and seldom far from it.
//!
//! The background turns behind the container, so what belongs to it is seen in both places; only the liquid stays at the lip. It is used by
//! calibration only, on the command's thread; it allocates and has no bound on its time. Where no colour stands out, the error says what to
//! do instead.

use opencv::core::{self, Mat};
use opencv::imgproc;
use opencv::prelude::*;

use super::geometry::Axes;
use super::hues::ranges;

// "Tuned" below means that the value was tuned on seeds 1 and 5001 to 5003 of `evaluate-camera`; see docs/VISION.md.
// Lengths are px of a picture 640 px wide.

/// Number of bins into which hue, saturation and value are divided. Chosen by hand; no measurement is recorded.
const BINS: [usize; 3] = [18, 8, 8];
/// Pixels with less saturation have no hue that means anything. Chosen by hand: one bin of saturation.
const NO_HUE: u8 = 32;
/// Pixels nearer to the lip than this are near. Tuned.
const NEAR_PX: f32 = 20.0;
/// Pixels further from the lip than this are far. Tuned.
const FAR_PX: f32 = 110.0;
/// Pixels further from the lip than this, to either side or up or down, are not looked at. Chosen by hand; no measurement is recorded.
const REACH_PX: f32 = 220.0;
/// Of this many far pixels, one is taken. Chosen by hand, for speed.
const FAR_EVERY: i32 = 5;
/// Pixels nearer to an axis than this are left out: the rim's own light is near the lip in every picture, and axes that are off by a few px
/// shall not make it liquid. Tuned.
const RIM_PX: f32 = 4.0;
/// A bin is the liquid's when it holds more than this share of the near pixels. Tuned.
const BIN_SHARE: f32 = 0.004;
/// A bin is the liquid's when its share of the near pixels is more than this many times that of the far ones. Tuned.
const BIN_RATIO: f32 = 4.0;
/// There is a liquid when its bins hold at least this share of the near pixels. Tuned.
const LIQUID_SHARE: f32 = 0.1;
/// Shares of the liquid's pixels between which the range is learned. Tuned.
const TAILS: [f32; 2] = [0.02, 0.98];
/// Pixels of a coloured liquid with less than this share of its median saturation are noise of the rim or of the board. By hand: a liquid's
/// thin edge has more.
const PALE: f32 = 0.35;
/// A picture is dry when less than this share of the pixels near the lip is liquid, beside what always is. By hand: a hanging drop covers
/// less.
const DRY_NEAR: f32 = 0.1;
/// The rim's own light is at most this share of the pixels near the lip. By hand.
const RIM_NEAR: f32 = 0.4;
/// Background that is this much darker, brighter or paler than the learned colours is close to them, grey levels. By hand: the exposure of
/// rendered cameras drifts by 5 % and more.
const CLOSE: u8 = 8;
/// Highlights are learned when they are at least this share of the near pixels. By hand.
const HIGHLIGHT_SHARE: f32 = 0.002;
/// What may be added to the share of dry background inside the colours for the sake of highlights. By hand.
const HIGHLIGHT_COST: f32 = 0.001;
/// Grey liquids (milk, or cola in shadow) have no hue: their median saturation is below this. Tuned.
const GREY_SATURATION: f32 = 45.0;
/// Grey liquids have no hue: their hues spread over more than this, in OpenCV's half degrees. Tuned.
const GREY_HUES: f32 = 80.0;
/// With this share of a saturated liquid's pixels near its mean hue the rest is background that only the lip shows, as a patch that passes it once. By hand:
/// among 600 drawn cells one had such a rest, 2.2 %, and was learned as grey.
const ONE_HUE_SHARE: f32 = 0.8;
/// Margin on saturation and value of a grey liquid, on either side. Tuned.
const GREY_MARGIN: f32 = 30.0;
/// Margin on the hue, in OpenCV's half degrees. Tuned; shadow and exposure hardly move the hue.
const HUE_MARGIN: f32 = 6.0;
/// Background within this of the liquid's hues is of like hue, in OpenCV's half degrees. Tuned.
const LIKE_HUE: f32 = 12.0;
/// Background further than this from the liquid's mean hue is another colour, in OpenCV's half degrees. Tuned.
const OTHER_HUE: f32 = 40.0;
/// Background of like colour counts when it is at least this share of the far pixels. Tuned.
const ALIKE_SHARE: f32 = 0.002;
/// Of this many background pixels of like colour, the most liquid-like one is noise. Tuned.
const ALIKE_NOISE: usize = 50;

/// Why no colour is learned.
#[derive(Debug, thiserror::Error)]
pub enum ColourError {
    /// No colour stands out at the lip.
    #[error("no liquid's colour stands out at the lip: show one whole pour, check the axes, or use --method clear for water")]
    NoColour,
    /// OpenCV refused a call.
    #[error("OpenCV: {0}")]
    OpenCv(#[from] opencv::Error),
}

/// Hue, saturation and value of a pixel, as OpenCV has them: 0 to 179, 0 to 255, 0 to 255.
type Hsv = [u8; 3];

/// Pixels of one place, and how many of them fall into each bin.
struct Pixels {
    /// The pixels, in the order in which they were seen.
    pixels: Vec<Hsv>,
    /// Their number in each bin, for bins at two places: the second lie half a bin lower, so that no limit between bins tells two like
    /// pixels apart.
    bins: [Vec<u32>; 2],
}

impl Pixels {
    fn new() -> Self {
        Self { pixels: Vec::new(), bins: std::array::from_fn(|_| vec![0; BINS.iter().map(|b| b + 1).product()]) }
    }

    fn add(&mut self, hsv: Hsv) {
        for (place, bins) in self.bins.iter_mut().enumerate() {
            bins[bin(hsv, place)] += 1;
        }
        self.pixels.push(hsv);
    }

    /// Number of pixels, at least 1.
    fn count(&self) -> f32 {
        self.pixels.len().max(1) as f32
    }

    /// Share of the pixels that fall into the same bin, for the bins at this place.
    fn share(&self, hsv: Hsv, place: usize) -> f32 {
        self.bins[place][bin(hsv, place)] as f32 / self.count()
    }
}

/// The bin of a pixel, for bins at one of two places.
fn bin([h, s, v]: Hsv, place: usize) -> usize {
    let bin = |value: u8, most: usize, bins: usize| (2 * usize::from(value) * bins / most + place) / 2;
    let hue = if s < NO_HUE { 0 } else { bin(h, 180, BINS[0]) % BINS[0] };
    (hue * (BINS[1] + 1) + bin(s, 256, BINS[1])) * (BINS[2] + 1) + bin(v, 256, BINS[2])
}

/// Learns the liquid's colour from the pictures of one pour.
pub struct ColourLearner {
    /// The axes in the whole picture.
    axes: Axes,
    /// Pixels right over the lip.
    near: Pixels,
    /// Pixels far from the lip.
    far: Pixels,
    /// Where the pixels of each picture end in `near` and in `far`.
    ends: Vec<[usize; 2]>,
    /// The last picture in hue, saturation and value.
    hsv: Mat,
}

/// The range of a colour: h_min, s_min, v_min, h_max, s_max, v_max.
type Range = [u8; 6];

/// What of the dry background lies inside a range of colours.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DryBackground {
    /// Share of the background's pixels that lie inside, 0 to 1; of all pictures if none is dry.
    pub inside: f32,
    /// Share of the pictures in which nothing of these colours is at the lip.
    pub dry_pictures: f32,
}

fn contains([h0, s0, v0, h1, s1, v1]: Range, [h, s, v]: Hsv) -> bool {
    let hue = if h0 <= h1 { (h0..=h1).contains(&h) } else { h >= h0 || h <= h1 };
    hue && (s0..=s1).contains(&s) && (v0..=v1).contains(&v)
}

/// The range of one number over the liquid's pixels.
#[derive(Debug, Clone, Copy)]
struct Quantiles {
    /// Nearly the least.
    low: f32,
    /// The median.
    middle: f32,
    /// Nearly the largest.
    high: f32,
}

impl Quantiles {
    /// The quantiles of at least one pixel.
    fn new(pixels: &[Hsv], value: impl Fn(&Hsv) -> f32) -> Self {
        let mut values: Vec<f32> = pixels.iter().map(value).collect();
        values.sort_by(f32::total_cmp);
        let at = |share: f32| values[((values.len() - 1) as f32 * share) as usize];
        Self { low: at(TAILS[0]), middle: at(0.5), high: at(TAILS[1]) }
    }
}

impl ColourLearner {
    /// A learner for a container with these axes in the whole picture.
    pub fn new(axes: Axes) -> Self {
        Self { axes, near: Pixels::new(), far: Pixels::new(), ends: Vec::new(), hsv: Mat::default() }
    }

    /// Adds one BGR picture of the pour, dry ones included. Of a large picture as many pixels are taken as of one 640 px wide, so that every
    /// picture counts alike, and none takes more than 120 kB.
    pub fn add(&mut self, bgr: &impl core::ToInputArray) -> Result<(), ColourError> {
        imgproc::cvt_color_def(bgr, &mut self.hsv, imgproc::COLOR_BGR2HSV)?;
        let (rows, columns) = (self.hsv.rows(), self.hsv.cols());
        let pixels = self.hsv.data_typed::<core::Vec3b>()?;
        let scale = columns as f32 / 640.0;
        let [lip_x, lip_y] = self.axes.lip_px;
        let reach = REACH_PX * scale;
        let step = scale.max(1.0);
        // Where the pixels are, counted in steps, and in px.
        let places = |lip: f32, most: i32| {
            let (from, to) = (((lip - reach).max(0.0) / step) as i32, ((lip + reach) / step) as i32);
            (from..to).map(move |i| (i, (i as f32 * step) as i32)).take_while(move |(_, px)| *px < most)
        };
        for (j, y) in places(lip_y, rows) {
            for (i, x) in places(lip_x, columns) {
                let at = [x as f32, y as f32];
                let distance = (at[0] - lip_x).hypot(at[1] - lip_y);
                let (near, far) = (distance < NEAR_PX * scale, distance > FAR_PX * scale && (i + j) % FAR_EVERY == 0);
                if !(near || far) || self.axes.between(at) < RIM_PX * scale {
                    continue;
                }
                let hsv = pixels[(y * columns + x) as usize].0;
                if far { self.far.add(hsv) } else { self.near.add(hsv) }
            }
        }
        self.ends.push([self.near.pixels.len(), self.far.pixels.len()]);
        Ok(())
    }

    /// The range h_min, s_min, v_min, h_max, s_max, v_max for `[image] colour_hsv`. It is an error if no colour stands out at the lip.
    pub fn range(&self) -> Result<Range, ColourError> {
        let liquid = |hsv: &&Hsv| {
            (0..2).all(|place| {
                let (near, far) = (self.near.share(**hsv, place), self.far.share(**hsv, place));
                near > BIN_SHARE && near > BIN_RATIO * far
            })
        };
        let mut seen: Vec<Hsv> = self.near.pixels.iter().filter(liquid).copied().collect();
        if (seen.len() as f32) < LIQUID_SHARE * self.near.count() {
            return Err(ColourError::NoColour);
        }
        let middle = Quantiles::new(&seen, |p| p[1].into()).middle;
        if middle >= GREY_SATURATION {
            seen.retain(|p| f32::from(p[1]) >= PALE * middle);
        }
        // Hue is an angle, so it is taken relative to its mean direction.
        let from_mean = |mean: f32| move |p: &Hsv| (f32::from(p[0]) - mean + 270.0).rem_euclid(180.0) - 90.0;
        let relative_hue = from_mean(mean_hue(&seen));
        let like_most = |p: &Hsv| relative_hue(p).abs() <= OTHER_HUE;
        let of_one_hue = seen.iter().filter(|p| like_most(p)).count() as f32;
        if middle >= GREY_SATURATION && of_one_hue >= ONE_HUE_SHARE * seen.len() as f32 {
            seen.retain(like_most);
        }
        let mean = mean_hue(&seen);
        let relative_hue = from_mean(mean);
        let hue = Quantiles::new(&seen, relative_hue);
        let saturation = Quantiles::new(&seen, |p| p[1].into());
        let value = Quantiles::new(&seen, |p| p[2].into());
        let byte = |v: f32| v.round().clamp(0.0, 255.0) as u8;
        if saturation.middle < GREY_SATURATION || hue.high - hue.low > GREY_HUES {
            return Ok(self.grey_range(saturation, value));
        }
        // Shadow and exposure move value most, and saturation more than hue.
        let v_min = value.low * 0.3 - 5.0;
        let v_max = if value.high > 150.0 { 255.0 } else { value.high * 1.7 + 10.0 };
        let like_hue = |p: &Hsv| (hue.low - LIKE_HUE..=hue.high + LIKE_HUE).contains(&relative_hue(p));
        let s_min = self.limit(saturation.low * 0.75 - 10.0, saturation.low, &|p| like_hue(p).then_some(f32::from(p[1])));
        let alike = |p: &Hsv| (f32::from(p[1]) >= s_min).then(|| relative_hue(p)).filter(|h| h.abs() < OTHER_HUE);
        let h_min = self.limit(hue.low - HUE_MARGIN, hue.low, &|p| alike(p).filter(|h| *h < 0.0));
        let h_max = self.limit(hue.high + HUE_MARGIN, hue.high, &|p| alike(p).filter(|h| *h > 0.0));
        let hue_byte = |v: f32| (mean + v).rem_euclid(180.0).round().min(179.0) as u8;
        Ok(self.with_highlights([hue_byte(h_min), byte(s_min), byte(v_min), hue_byte(h_max), 255, byte(v_max)]))
    }

    /// The range of a liquid without a hue. Background that comes close limits it, as it does that of a coloured one.
    fn grey_range(&self, saturation: Quantiles, value: Quantiles) -> Range {
        let loose = |q: Quantiles| (q.low - GREY_MARGIN)..=(q.high + GREY_MARGIN);
        let (saturations, values) = (loose(saturation), loose(value));
        let of_value = |p: &Hsv| saturations.contains(&f32::from(p[1])).then_some(f32::from(p[2]));
        let v_min = self.limit(value.low - GREY_MARGIN, value.low, &of_value);
        let v_max = self.limit(value.high + GREY_MARGIN, value.high, &of_value);
        let of_saturation = |p: &Hsv| values.contains(&f32::from(p[2])).then_some(f32::from(p[1]));
        let s_min = self.limit(saturation.low - GREY_MARGIN, saturation.low, &of_saturation);
        let s_max = self.limit(saturation.high + GREY_MARGIN, saturation.high, &of_saturation);
        let byte = |v: f32| v.round().clamp(0.0, 255.0) as u8;
        [0, byte(s_min), byte(v_min), 179, byte(s_max), byte(v_max)]
    }

    /// `range`, wider by the highlights on the liquid: pixels near the lip that are brighter or paler than it, and seldom far from it. Where
    /// dry background would come in, it stays as it is.
    fn with_highlights(&self, range: Range) -> Range {
        let cost = self.dry_background(range).inside + HIGHLIGHT_COST;
        let light: Vec<u8> = {
            let bright = |p: &&Hsv| p[2] > range[5].min(200) && self.near.share(**p, 0) > BIN_RATIO * self.far.share(**p, 0);
            let hue = |p: &&Hsv| contains([range[0], 0, 0, range[3], 255, 255], **p);
            self.near.pixels.iter().filter(hue).filter(bright).map(|p| p[1]).collect()
        };
        let mut wider = range;
        for try_wider in [[range[0], range[1], range[2], range[3], 255, 255], {
            let mut light = light.clone();
            light.sort_unstable();
            let palest = light.get(light.len() / 20).copied().unwrap_or(range[1]);
            [range[0], range[1].min(palest), range[2], range[3], 255, 255]
        }] {
            let many = light.len() as f32 >= HIGHLIGHT_SHARE * self.near.count();
            if many && self.dry_background(try_wider).inside <= cost {
                wider = try_wider;
            }
        }
        wider
    }

    /// What of the background lies inside `range`, or so close to it that a little more or less light brings it there. See
    /// [`Self::dry_background`].
    pub fn near_background(&self, [h0, s0, v0, h1, s1, v1]: Range) -> DryBackground {
        let grey = h0 == 0 && h1 == 179;
        let hue = |h: u8, by: i16| if grey { h } else { (i16::from(h) + by).rem_euclid(180) as u8 };
        let (low, high) = (|v: u8| v.saturating_sub(CLOSE), |v: u8| v.saturating_add(CLOSE));
        self.dry_background([hue(h0, -1), low(s0), low(v0), hue(h1, 1), high(s1), high(v1)])
    }

    /// What of the background lies inside `range` in the pictures in which nothing of these colours is at the lip but the rim's own light.
    pub fn dry_background(&self, range: Range) -> DryBackground {
        // As the extractor judges it, which takes a liquid's colours to go on where light cuts them off.
        let ranges = ranges(range.map(f64::from));
        let is_liquid = |p: &Hsv| ranges.iter().any(|(low, high)| (0..3).all(|k| (low[k]..=high[k]).contains(&f64::from(p[k]))));
        // Of each picture: the share of the near pixels that is inside, and of how many far pixels how many are.
        let mut seen = Vec::new();
        let mut begins = [0, 0];
        for ends in &self.ends {
            let inside = |pixels: &[Hsv]| pixels.iter().filter(|p| is_liquid(p)).count();
            let (near, far) = (&self.near.pixels[begins[0]..ends[0]], &self.far.pixels[begins[1]..ends[1]]);
            seen.push((inside(near) as f32 / near.len().max(1) as f32, inside(far), far.len()));
            begins = *ends;
        }
        let rim = seen.iter().map(|(near, ..)| *near).fold(1.0f32, f32::min);
        let is_dry = |(near, ..): &&(f32, usize, usize)| rim < RIM_NEAR && *near < rim + DRY_NEAR;
        let dry = seen.iter().filter(is_dry).count();
        let sum = |all: bool| {
            let taken = seen.iter().filter(|one| all || is_dry(one));
            taken.fold((0, 0), |sum, (_, inside, count)| (sum.0 + inside, sum.1 + count))
        };
        let (inside, count) = sum(dry == 0);
        DryBackground { inside: inside as f32 / count.max(1) as f32, dry_pictures: dry as f32 / seen.len().max(1) as f32 }
    }

    /// A limit of the range: `loose`, which is the liquid's own limit `liquid` with its margin; or, where background of like colour comes
    /// nearer than that, half way between that and the liquid. `alike` gives the number of a background pixel of like colour.
    fn limit(&self, loose: f32, liquid: f32, alike: &dyn Fn(&Hsv) -> Option<f32>) -> f32 {
        let far = &self.far.pixels;
        let mut values: Vec<f32> = far.iter().filter_map(alike).filter(|v| (v - loose).signum() != (v - liquid).signum()).collect();
        values.extend(far.iter().filter_map(alike).filter(|v| (loose < liquid) == (*v < loose)).map(|_| loose));
        if (values.len() as f32) < ALIKE_SHARE * self.far.count() {
            return loose;
        }
        // The most liquid-like of these pixels are noise.
        values.sort_by(|a, b| if loose < liquid { b.total_cmp(a) } else { a.total_cmp(b) });
        let nearest = values[values.len() / ALIKE_NOISE];
        if (nearest - loose).signum() == (nearest - liquid).signum() { loose } else { (nearest + liquid) / 2.0 }
    }
}

/// The mean direction of the hues, weighted by saturation, in OpenCV's half degrees.
fn mean_hue(pixels: &[Hsv]) -> f32 {
    let (mut sin, mut cos) = (0.0f32, 0.0f32);
    for [h, s, _] in pixels {
        let (a, b) = (f32::from(*h) * std::f32::consts::TAU / 180.0).sin_cos();
        (sin, cos) = (sin + a * f32::from(*s), cos + b * f32::from(*s));
    }
    sin.atan2(cos) * 180.0 / std::f32::consts::TAU
}

#[cfg(test)]
mod tests {
    use shared::config::Config;

    use super::*;

    /// Protects the hue of a coloured liquid from a patch of the background that passes the lip and is seen nowhere else: with three pixels in a hundred of
    /// it all hues were liquid.
    #[test]
    fn a_patch_at_the_lip_takes_no_hue_away() -> Result<(), ColourError> {
        let config = Config::parse(include_str!("../../../config/sim.toml"), "config/sim.toml").expect("the shipped one");
        let mut learner = ColourLearner::new(Axes::new(&config.image));
        for picture in 0..20 {
            (0..100).for_each(|k| learner.near.add(if k < 97 { [109, 210, 150] } else { [25, 150, 180] }));
            (0..100).for_each(|k| learner.far.add(if k < 50 { [135, 90, 190] } else { [60, 40, 90 + picture] }));
            learner.ends.push([learner.near.pixels.len(), learner.far.pixels.len()]);
        }
        let range = learner.range()?;
        assert!(contains(range, [109, 210, 150]), "{range:?}");
        assert!(!contains(range, [25, 150, 180]) && !contains(range, [135, 90, 190]), "{range:?}");
        Ok(())
    }

    /// Protects who calibrates before a bright background: what the extractor takes for the liquid where light cuts its colour off, as bright yellow for
    /// orange, is told as background in the liquid's colours.
    #[test]
    fn background_in_the_colours_of_bright_liquid_counts() {
        let config = Config::parse(include_str!("../../../config/sim.toml"), "config/sim.toml").expect("the shipped one");
        let inside = |background: Hsv| {
            let mut learner = ColourLearner::new(Axes::new(&config.image));
            for _ in 0..10 {
                (0..100).for_each(|_| learner.near.add([0, 0, 120]));
                (0..100).for_each(|_| learner.far.add(background));
                learner.ends.push([learner.near.pixels.len(), learner.far.pixels.len()]);
            }
            learner.near_background([8, 194, 54, 22, 255, 255]).inside
        };
        assert_eq!([inside([27, 239, 253]), inside([15, 239, 180])], [1.0, 1.0], "as bright orange, and as orange");
        assert_eq!([inside([27, 239, 180]), inside([60, 239, 253])], [0.0, 0.0], "too dark for it, and green");
    }
}
