//! Checks of a picture before and beside the measurement: light, repetition, and focus.
//!
//! Called on the extraction thread; nothing is allocated after the start and nothing fails. A picture that cannot be used gets a
//! [`Doubt`].

use shared::messages::Doubt;

use super::geometry::Axes;
use super::pace::Pace;
use super::picture::RegionPixels;

/// Mean grey level below which a picture counts as dark. Chosen by hand; `evaluate-camera` raises the doubt on purpose.
const DARK_LEVEL: f32 = 14.0;
/// Share of saturated pixels above which a picture counts as blown out. Chosen by hand; `evaluate-camera` raises the doubt on purpose.
const BLOWN_SHARE: f32 = 0.5;
/// And so it has to be over the whole region, because what is read of it may lie close around the lip, in front of one white square of a
/// board. Chosen by hand: more than the half of a chess board that is white.
const BLOWN_REGION_SHARE: f32 = 0.6;
/// Rows and columns from one pixel of the region that is looked at for this to the next. Chosen by hand, for speed.
const BLOWN_EVERY: usize = 12;
/// A pixel whose three parts reach this is saturated, grey levels. Chosen by hand: a little below 255, because of noise.
const SATURATED_LEVEL: u8 = 250;
/// Of this many pixels, one is looked at to judge the light. Chosen by hand, for speed.
const LIGHT_EVERY: usize = 4;

/// Bundles of profiles across each axis. Chosen by hand; no measurement is recorded.
const RIM_BUNDLES: usize = 12;
/// Lines in a bundle; their mean has less noise than one line. Chosen by hand; no measurement is recorded.
const RIM_LINES: usize = 8;
/// Distance of the bundles along the axis, px. Chosen by hand; no measurement is recorded.
const RIM_BUNDLE_PX: f32 = 14.0;
/// Distance of a bundle's lines, px. Chosen by hand; no measurement is recorded.
const RIM_LINE_PX: f32 = 1.5;
/// Samples of a line on either side of the axis, 1 px apart. Chosen by hand; no measurement is recorded.
const RIM_REACH: usize = 9;
/// Length over which the steepness of a step is taken, px. Chosen by hand; no measurement is recorded.
const RIM_STEP: usize = 3;
/// Samples on either side of the steepest step within which the change of brightness is taken. Chosen by hand, so that a soft edge of
/// the background beside the rim does not count.
const RIM_AROUND: usize = 3;
/// Least change of brightness across the rim that tells anything, grey levels. Tuned on seeds 1 and 5001 to 5003 of `evaluate-camera`,
/// see docs/VISION.md.
const RIM_CONTRAST: f32 = 14.0;
/// Least number of bundles with that change. Tuned as [`RIM_CONTRAST`] was.
const RIM_SEEN: usize = 5;
/// Where a quarter of the bundles is more than this, so many are sharper than the one that decides. Chosen by hand: edges of a board that lie along the rim
/// by chance are soft, and some places of the rim are between them.
const RIM_SHARPER: usize = 2;
/// A rim of this width is blurred, px; the width is the change of brightness over its steepest step. Tuned as [`RIM_CONTRAST`] was; a
/// blurred edge of deviation s is 2.5 s wide.
const RIM_BLURRED_PX: f32 = 5.6;
/// A rim of this width is blurred at the first sight, px; a narrower one has to be blurred in two pictures in a row, because noise and a
/// background in motion make single pictures look soft. Chosen by hand; tried on the same seeds.
const RIM_SURELY_BLURRED_PX: f32 = 6.4;

/// So many pictures are remembered to tell one that comes again. Chosen by hand: a driver whose camera has stopped hands out its buffers in turn, and has
/// no more of them.
const REMEMBERED: usize = 8;
/// So many pictures in a row that came before, though not just before, are a camera that has stopped. Chosen by hand: one may be so by chance, where a drawn
/// scene has no noise.
const RETURNED: u32 = 3;

/// Checks the light, and that the picture is none that came before.
#[derive(Default)]
pub(crate) struct LightCheck {
    /// Hashes of the last pictures' bytes, the newest first; `None` before the first pictures.
    hashes: [Option<u64>; REMEMBERED],
    /// Number of pictures in a row that came before.
    returned: u32,
    /// Mean levels of blue, green and red in the last picture.
    mean_bgr: [f32; 3],
    /// Whether half of what was read of it is saturated.
    half_white: bool,
}

impl LightCheck {
    /// Why a picture of these BGR pixels cannot be used: it is too dark, blown out, or one that came before. This is one
    /// pass, because three OpenCV reductions over the same bytes took longer. `region` is all of the picture that may be read.
    pub(crate) fn doubt(&mut self, bytes: &[u8], region: RegionPixels) -> Option<Doubt> {
        let repeated = self.repeats(hash_of(bytes));
        let (mut sums, mut saturated, mut count) = ([0u32; 3], 0u32, 0u32);
        let mut look = |pixel: &[u8]| {
            let [blue, green, red] = [pixel[0], pixel[1], pixel[2]];
            [blue, green, red].into_iter().zip(&mut sums).for_each(|(level, sum)| *sum += u32::from(level));
            saturated += u32::from(blue.min(green).min(red) >= SATURATED_LEVEL);
            count += 1;
        };
        let groups = bytes.chunks_exact(3 * LIGHT_EVERY);
        let rest = groups.remainder();
        groups.for_each(&mut look);
        rest.chunks_exact(3).take(1).for_each(look);
        self.mean_bgr = sums.map(|sum| sum as f32 / count.max(1) as f32);
        self.half_white = saturated as f32 > BLOWN_SHARE * count as f32;
        if self.mean_level() < DARK_LEVEL {
            Some(Doubt::TooDark)
        } else if self.half_white && saturated_share(region) > BLOWN_REGION_SHARE {
            Some(Doubt::BlownOut)
        } else if repeated {
            Some(Doubt::Frozen)
        } else {
            None
        }
    }

    /// Takes note of a pause, as between two recordings: what comes after it may be the same scene again, but for the last picture.
    pub(crate) fn interrupt(&mut self) {
        self.hashes[1..].fill(None);
        self.returned = 0;
    }

    /// Takes note of a picture with this hash. Returns whether it is the last one again, or one of several in a row that came before.
    fn repeats(&mut self, hash: u64) -> bool {
        let came_before = self.hashes.contains(&Some(hash));
        let just_before = self.hashes[0] == Some(hash);
        self.returned = if came_before { self.returned + 1 } else { 0 };
        self.hashes.rotate_right(1);
        self.hashes[0] = Some(hash);
        just_before || self.returned >= RETURNED
    }

    /// Whether half of what was read of the picture that was checked last is saturated.
    pub(crate) fn is_half_white(&self) -> bool {
        self.half_white
    }

    /// Mean grey level of the picture that was checked last.
    pub(crate) fn mean_level(&self) -> f32 {
        self.mean_bgr.iter().sum::<f32>() / 3.0
    }

    /// Mean levels of blue, green and red in the picture that was checked last.
    pub(crate) fn mean_bgr(&self) -> [f32; 3] {
        self.mean_bgr
    }
}

/// A number that tells pictures of these bytes from each other. Four sums that do not wait for each other make it four times as fast.
#[inline(always)]
fn hash_of(bytes: &[u8]) -> u64 {
    let mix = |hash: u64, word: u64| (hash ^ word).wrapping_mul(0x9e37_79b9_7f4a_7c15).rotate_left(29);
    let word = |chunk: &[u8]| u64::from_le_bytes([chunk[0], chunk[1], chunk[2], chunk[3], chunk[4], chunk[5], chunk[6], chunk[7]]);
    let mut hashes = [0xcbf2_9ce4_8422_2325u64; 4];
    let groups = bytes.chunks_exact(32);
    let rest = groups.remainder();
    for group in groups {
        for (k, hash) in hashes.iter_mut().enumerate() {
            *hash = mix(*hash, word(&group[8 * k..8 * k + 8]));
        }
    }
    let hash = hashes.into_iter().fold(0, mix);
    rest.chunks_exact(8).fold(hash, |hash, chunk| mix(hash, word(chunk)))
}

/// The share of a region's pixels that are saturated.
fn saturated_share(region: RegionPixels) -> f32 {
    let (mut saturated, mut count) = (0u32, 0u32);
    for row in (0..region.height()).step_by(BLOWN_EVERY).map(|y| region.row(y)) {
        for pixel in row.chunks_exact(3).step_by(BLOWN_EVERY) {
            saturated += u32::from(pixel.iter().all(|v| *v >= SATURATED_LEVEL));
            count += 1;
        }
    }
    saturated as f32 / count.max(1) as f32
}

/// Side of the squares at the lip that are looked at, px of a picture 640 px wide. Chosen by hand: so near a reflection is white in front
/// of a dark liquid too.
const LIP_SIDE: u32 = 6;
/// Glass in a lamp's reflection reaches this in all parts, grey levels. Chosen by hand: glass before a white wall is darker.
const LIP_GLASS: u8 = 240;
/// Air in a lamp's reflection reaches this in all parts, grey levels. As in the check of light, a little below 255.
const LIP_WHITE: u8 = 250;
/// So far along both axes there is no reflection, px of a picture 640 px wide. Chosen by hand.
const LIP_FAR_PX: f32 = 36.0;
/// There every so many px are looked at. Chosen by hand: 60 px of ground in both directions.
const LIP_FAR_STEP: f32 = 10.0;
/// Ground that reaches this in all parts may itself be white at the lip, grey levels. Chosen by hand: a vignette makes 10 %.
const LIP_GROUND: u8 = 242;
/// No more than this share of the ground does so where a reflection is told. Chosen by hand.
const LIP_GROUND_SHARE: f32 = 0.15;

/// With this share of white light at the lip it may be a reflection. Chosen by hand.
const LIP_SURE: f32 = 0.5;
/// White light is a reflection when it is seen in so many pictures. Tuned on seed 3 of `evaluate-camera --faults`: white squares of a chess
/// board pass in eleven.
const LIP_PICTURES: u32 = 12;

/// Checks the focus by the glass's own top edge and left side, which are always in the same place.
pub(crate) struct RimCheck {
    /// The axes relative to the region.
    axes: Axes,
    /// Width of the rim in each bundle that shows it, px. Kept from frame to frame.
    widths_px: Vec<f32>,
    /// Which bundles showed the rim in the last picture without a stream, all before that. A stream's own edge across the rim tells nothing of the focus.
    shown: [bool; 2 * RIM_BUNDLES],
    /// Whether the last picture that was judged looked blurred; true before the first.
    looked_blurred: bool,
}

impl RimCheck {
    /// A check for these axes, relative to the region.
    pub(crate) fn new(axes: Axes) -> Self {
        Self { axes, widths_px: Vec::with_capacity(2 * RIM_BUNDLES), shown: [true; 2 * RIM_BUNDLES], looked_blurred: true }
    }

    /// Whether the rim has lost its sharp edges in a picture in which a stream `flows` or not. False when it is not seen well enough to tell: the glass
    /// is as bright as what is behind it, or the axes lie beside the rim.
    pub(crate) fn is_blurred(&mut self, pixels: RegionPixels, flows: bool) -> bool {
        self.widths_px.clear();
        let axes = self.axes;
        for (side, (along, across)) in [(axes.x, axes.y), ([-axes.y[0], -axes.y[1]], axes.x)].into_iter().enumerate() {
            // Square to the axis, so that an oblique container does not look soft.
            let skew = across[0] * along[0] + across[1] * along[1];
            let across = [across[0] - skew * along[0], across[1] - skew * along[1]];
            let length = across[0].hypot(across[1]);
            for bundle in 0..RIM_BUNDLES {
                let mut profile = [0.0f32; 2 * RIM_REACH + 1];
                let inside = profile.iter_mut().enumerate().all(|(j, level)| {
                    let d = (j as f32 - RIM_REACH as f32) / length;
                    (0..RIM_LINES).all(|line| {
                        let s = RIM_BUNDLE_PX * (1 + bundle) as f32 + RIM_LINE_PX * line as f32;
                        let [x, y] = axes.at(s, along);
                        let colour = pixels.at(x + d * across[0], y + d * across[1]);
                        *level += colour.map_or(0.0, |c| c.iter().sum::<f32>()) / (3 * RIM_LINES) as f32;
                        colour.is_some()
                    })
                });
                let (change, steepness) = steepest_change(&profile);
                let shown = &mut self.shown[side * RIM_BUNDLES + bundle];
                let shows = inside && change >= RIM_CONTRAST;
                if shows && (*shown || !flows) {
                    self.widths_px.push(change / steepness);
                }
                if !flows {
                    *shown = shows;
                }
            }
        }
        // What stands behind the rim is out of focus too, so the sharper bundles decide.
        let sharper = (self.widths_px.len() / 4).min(RIM_SHARPER);
        let seen = self.widths_px.len() >= RIM_SEEN;
        let width_px = if seen { *self.widths_px.select_nth_unstable_by(sharper, f32::total_cmp).1 } else { 0.0 };
        let looked_blurred = std::mem::replace(&mut self.looked_blurred, width_px > RIM_BLURRED_PX);
        width_px > RIM_SURELY_BLURRED_PX || (looked_blurred && width_px > RIM_BLURRED_PX)
    }
}

/// Looks for a lamp's reflection on the glass at the lip: there, in the glass and in the air, all is white light, and the ground further
/// out is darker.
pub(crate) struct LipCheck {
    axes: Axes,
    /// Pixels of this picture for each of one 640 px wide.
    scale: f32,
    /// Pictures with white light at the lip, less those that do not tell.
    pictures: u32,
}

impl LipCheck {
    /// For axes relative to the region, and pictures of this width, px.
    pub(crate) fn new(axes: Axes, width_px: u32) -> Self {
        Self { axes, scale: width_px as f32 / 640.0, pictures: 0 }
    }

    /// Which share of the glass just inside the lip, and of the air just outside, is white light; 0 if the ground further out is as bright,
    /// or while the light is new: a white thing that passes is no reflection.
    pub(crate) fn white_share(&mut self, pixels: RegionPixels, pace: Pace) -> f32 {
        // The share of a square with this corner, px along the axes, that reaches a level in all parts.
        let share = |corner: [f32; 2], step: f32, down: f32, level: u8| {
            let (mut bright, mut looked) = (0u32, 0u32);
            for i in 0..LIP_SIDE * LIP_SIDE {
                let along = corner[0] + step * (1 + i % LIP_SIDE) as f32;
                let up = corner[1] + step * down * (1 + i / LIP_SIDE) as f32;
                let [x, y] = [0, 1].map(|k| self.axes.lip_px[k] + self.scale * (along * self.axes.x[k] + up * self.axes.y[k]));
                let row = if x >= 0.0 && y >= 0.0 { pixels.row(y as usize) } else { &[] };
                let Some(pixel) = row.chunks_exact(3).nth(x.max(0.0) as usize) else { continue };
                looked += 1;
                bright += u32::from(pixel.iter().all(|v| *v >= level));
            }
            bright as f32 / looked.max(1) as f32
        };
        let at_lip = share([0.0; 2], 1.0, -1.0, LIP_GLASS).min(share([0.0; 2], 1.0, 1.0, LIP_WHITE));
        let ground = || share([LIP_FAR_PX; 2], LIP_FAR_STEP, 1.0, LIP_GROUND);
        if at_lip < LIP_SURE {
            self.pictures = self.pictures.saturating_sub(2);
        } else if ground() > LIP_GROUND_SHARE {
            return 0.0;
        } else {
            self.pictures = (self.pictures + 1).min(2 * pace.pictures(LIP_PICTURES));
        }
        if self.pictures < pace.pictures(LIP_PICTURES) { 0.0 } else { at_lip }
    }
}

/// The change of brightness close around a profile's steepest step, grey levels, and the steepness of that step, grey levels a px.
fn steepest_change(profile: &[f32; 2 * RIM_REACH + 1]) -> (f32, f32) {
    let steepness = |i: usize| (profile[i + RIM_STEP] - profile[i]).abs() / RIM_STEP as f32;
    let at =
        (RIM_AROUND..2 * RIM_REACH + 1 - RIM_STEP - RIM_AROUND).max_by(|i, j| steepness(*i).total_cmp(&steepness(*j))).unwrap_or(RIM_REACH);
    let around = &profile[at - RIM_AROUND..at + RIM_STEP + 1 + RIM_AROUND];
    let (low, high) = around.iter().fold((f32::MAX, f32::MIN), |(l, h), v| (l.min(*v), h.max(*v)));
    (high - low, steepness(at))
}

#[cfg(test)]
mod tests {
    use opencv::core::Rect;
    use shared::messages::PixelFormat;

    use super::super::picture::{Image, RegionReader};
    use super::*;

    const SIDE: usize = 240;

    /// Whether the check calls a picture blurred in which the rim is brighter than what is behind it by so many levels, and is so wide, px.
    fn is_blurred(check: &mut RimCheck, rim: (f32, f32), flows: bool) -> opencv::Result<bool> {
        is_blurred_with(check, |_| rim, flows)
    }

    /// The same where the rim is another one in each column.
    fn is_blurred_with(check: &mut RimCheck, rim: impl Fn(usize) -> (f32, f32), flows: bool) -> opencv::Result<bool> {
        let level = |i: usize| {
            let (levels, wide_px) = rim(i % SIDE);
            let above_px = 120.0 - (i / SIDE) as f32;
            (100.0 + levels * (0.5 - above_px / wide_px).clamp(0.0, 1.0)) as u8
        };
        let pixels: Vec<u8> = (0..SIDE * SIDE).flat_map(|i| [level(i); 3]).collect();
        let (format, [width_px, height_px]) = (PixelFormat::Bgr8, [SIDE as u32; 2]);
        let mut reader = RegionReader::new(Rect::new(0, 0, SIDE as i32, SIDE as i32));
        let image = Image { width_px, height_px, format, pixels: &pixels };
        Ok(check.is_blurred(reader.read(image, |_| Ok(()))?, flows))
    }

    /// Protects streams of clear water before a rim that hardly shows: their own soft edge across it tells nothing of the focus. Where the rim was seen
    /// without a stream, it does.
    #[test]
    fn a_streams_own_edge_tells_no_focus() -> opencv::Result<()> {
        let axes = Axes { lip_px: [40.0, 120.0], x: [1.0, 0.0], y: [0.0, -1.0] };
        let mut check = RimCheck::new(axes);
        assert!(!is_blurred(&mut check, (8.0, 1.0), false)?, "the rim hardly shows");
        assert!(!(0..5).any(|_| is_blurred(&mut check, (60.0, 20.0), true).unwrap_or(true)), "a stream's edge");
        assert!(!is_blurred(&mut check, (60.0, 1.0), false)?, "the rim shows");
        assert!(is_blurred(&mut check, (60.0, 20.0), true)?, "its edge is wide now");
        assert!(is_blurred(&mut RimCheck::new(axes), (60.0, 20.0), true)?, "nothing was seen without a stream");
        Ok(())
    }

    /// Protects dry pictures before a board whose soft edges lie along the rim by chance: where the rim is seen between them, it is sharp.
    #[test]
    fn a_soft_edge_along_the_rim_is_no_blur() -> opencv::Result<()> {
        let axes = Axes { lip_px: [40.0, 120.0], x: [1.0, 0.0], y: [0.0, -1.0] };
        let mut check = RimCheck::new(axes);
        for _ in 0..3 {
            assert!(!is_blurred_with(&mut check, |column| if column < 95 { (30.0, 3.0) } else { (100.0, 20.0) }, false)?);
        }
        assert!(is_blurred_with(&mut check, |column| if column < 95 { (40.0, 20.0) } else { (100.0, 20.0) }, false)?);
        Ok(())
    }

    /// Protects the check of repeated pictures: a picture that differs in one whole word, wherever it lies, is a new one.
    #[test]
    fn a_change_anywhere_makes_another_hash() {
        let picture: Vec<u8> = (0..200u32).map(|i| (i * 37 % 251) as u8).collect();
        for at in 0..picture.len() {
            let mut other = picture.clone();
            other[at] ^= 1;
            assert_ne!(hash_of(&picture), hash_of(&other), "byte {at}");
        }
    }
}
