//! The faults that people report of their cameras, laid over pictures of any source.
//!
//! A fault is pure: the same kind, strength, seed and frame number make the same picture of the same picture. It knows nothing of who
//! measures, and shares no code and no constant with the feature worker. [`FaultyCamera`] keeps the picture before, which torn and
//! repeated pictures need.
//!
//! For any thread. Allocates when a camera is made; nothing fails, and a buffer of another size than the camera's is left as it is.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};

/// Frames a second for which the faults' times are meant.
const RATE_HZ: f64 = 30.0;
/// Time in which a rolling shutter reads a picture, s: a common value of USB cameras, which takes in two to three bands.
const READOUT_S: f64 = 0.025;
/// Period of a white balance that hunts, s, as reported of USB cameras.
const BALANCE_PERIOD_S: f64 = 2.0;
/// Period of an exposure that hunts, s. Chosen by hand, as of an automatic that overshoots.
const EXPOSURE_PERIOD_S: f64 = 1.5;
/// An exposure that steps does so after this many frames. Chosen by hand: 0.7 s, so that a pour meets some steps.
const STEP_FRAMES: u64 = 20;
/// Of this many frames, one is not whole, shifted or torn.
const BROKEN_EVERY: u64 = 3;
/// A picture breaks between these shares of its height. Chosen by hand, so that above and below a part is left.
const BREAKS_AT: (f64, f64) = (0.15, 0.7);
/// Blocks of a compressed picture have this height, px: a picture breaks between blocks (JPEG with halved chroma).
const BLOCK_PX: usize = 16;
/// Blue, green and red where nothing was decoded: the grey of a decoder that starts from a zero picture.
const GREY_BGR: [u8; 3] = [128; 3];
/// Blue, green and red of a zero picture in YUV.
const GREEN_BGR: [u8; 3] = [0, 135, 0];
/// Deviations of a highlight, px to the right and down.
const HIGHLIGHT_PX: [f64; 2] = [18.0, 12.0];

/// What is wrong with a camera.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum FaultKind {
    /// Lamps at 50 or 60 Hz mains, as the seed draws, flicker, and a rolling shutter makes bands of it, which at 60 Hz stand still in the picture;
    /// the strength is their share of the light.
    Banding,
    /// The gains of red and blue wander; the strength is how far, as a share.
    WhiteBalance,
    /// The exposure wander between this factor and its inverse.
    ExposureHunting,
    /// The exposure jumps to this factor and back.
    ExposureStep,
    /// Every third picture ends in one grey; the strength scales how much of it is lost.
    GreyBelow,
    /// Every third picture ends in one green; the strength scales how much of it is lost.
    GreenBelow,
    /// In every third picture, what lies below a row is shifted; the strength is the shift, px.
    ShiftedBelow,
    /// In every third picture, what lies below a row is of the picture before; the strength scales how much that is.
    Torn,
    /// Of so many pictures, the last is the one before it again.
    Repeated,
    /// A lamp's reflection at the lip; a strength of 1 is white.
    Highlight,
    /// Warm light: red is brighter by this share and blue darker, until they saturate.
    WarmLight,
    /// Red and blue are swapped.
    SwappedColours,
    /// The pictures have no colour.
    Grey,
    /// Levels go from 16 to 235.
    LimitedRange,
}

impl FaultKind {
    /// All kinds.
    pub const ALL: [Self; 14] = [
        Self::Banding,
        Self::WhiteBalance,
        Self::ExposureHunting,
        Self::ExposureStep,
        Self::GreyBelow,
        Self::GreenBelow,
        Self::ShiftedBelow,
        Self::Torn,
        Self::Repeated,
        Self::Highlight,
        Self::WarmLight,
        Self::SwappedColours,
        Self::Grey,
        Self::LimitedRange,
    ];

    /// A strength that is common.
    pub fn usual_strength(self) -> f64 {
        match self {
            Self::Banding => 0.15,
            Self::WhiteBalance => 0.1,
            Self::ExposureHunting => 1.6,
            Self::ExposureStep => 1.35,
            Self::ShiftedBelow => 32.0,
            Self::Repeated => 4.0,
            Self::WarmLight => 0.3,
            _ => 1.0,
        }
    }
}

/// One fault of a camera.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraFault {
    /// What is wrong.
    pub kind: FaultKind,
    /// How much; what it means is said at the kind.
    pub strength: f64,
    /// Draws phases and rows.
    pub seed: u64,
}

impl CameraFault {
    /// Makes of `pixels`, the picture with this number (`[width, height]` px, blue, green, red, row by row), what the faulty camera gives.
    /// `before` is the camera's picture before it, and `lip_px` is where the lip is.
    pub fn apply(&self, number: u64, [width, height]: [usize; 2], lip_px: [f64; 2], before: &[u8], pixels: &mut [u8]) {
        if width == 0 || pixels.len() != width * height * 3 {
            return;
        }
        let t_s = number as f64 / RATE_HZ;
        let strength = self.strength;
        let phase = |k: u64| std::f64::consts::TAU * Pcg64Mcg::seed_from_u64(self.seed ^ (k << 40)).random::<f64>();
        let wave = |period_s: f64, k: u64| (std::f64::consts::TAU * t_s / period_s + phase(k)).sin();
        let broken_from = || self.broken_from(number, height).map(|row| row * width * 3);
        match self.kind {
            FaultKind::Banding => {
                // Not a bit of the seed itself: seeds of one run are alike in those.
                let light_hz = if phase(3) < std::f64::consts::PI { 100.0 } else { 120.0 };
                self.band(t_s, light_hz, phase(1), [width, height], pixels);
            }
            FaultKind::WhiteBalance => {
                let gains = [1.0 + strength * wave(BALANCE_PERIOD_S, 1), 1.0, 1.0 + strength * wave(BALANCE_PERIOD_S, 2)];
                scale(pixels, gains);
            }
            FaultKind::ExposureHunting => scale(pixels, [strength.max(1e-3).powf(wave(EXPOSURE_PERIOD_S, 1)); 3]),
            FaultKind::ExposureStep => {
                if (number / STEP_FRAMES + self.seed) % 2 == 1 {
                    scale(pixels, [strength; 3]);
                }
            }
            FaultKind::GreyBelow | FaultKind::GreenBelow => {
                let colour = if self.kind == FaultKind::GreyBelow { GREY_BGR } else { GREEN_BGR };
                if let Some(from) = broken_from() {
                    pixels[from..].chunks_exact_mut(3).for_each(|pixel| pixel.copy_from_slice(&colour));
                }
            }
            FaultKind::ShiftedBelow => {
                if let Some(from) = broken_from() {
                    let by = (strength.abs() as usize % width) * 3;
                    pixels[from..].chunks_exact_mut(width * 3).for_each(|row| row.rotate_right(by));
                }
            }
            FaultKind::Torn => {
                if let Some(from) = broken_from().filter(|_| before.len() == pixels.len()) {
                    pixels[from..].copy_from_slice(&before[from..]);
                }
            }
            FaultKind::Repeated => {
                let every = (strength as u64).max(2);
                if number % every == every - 1 && before.len() == pixels.len() {
                    pixels.copy_from_slice(before);
                }
            }
            FaultKind::Highlight => highlight(pixels, width, lip_px, 255.0 * strength),
            FaultKind::WarmLight => scale(pixels, [1.0 / (1.0 + strength), 1.0, 1.0 + strength]),
            FaultKind::SwappedColours => pixels.chunks_exact_mut(3).for_each(|pixel| pixel.swap(0, 2)),
            FaultKind::Grey => pixels.chunks_exact_mut(3).for_each(|pixel| {
                // The weights of ITU-R BT.601.
                let luma = 0.114 * f32::from(pixel[0]) + 0.587 * f32::from(pixel[1]) + 0.299 * f32::from(pixel[2]);
                pixel.fill(luma.round() as u8);
            }),
            FaultKind::LimitedRange => pixels.iter_mut().for_each(|v| *v = (16 + u16::from(*v) * 219 / 255) as u8),
        }
    }

    /// The first row that is not of this picture, if the picture with this number is broken.
    fn broken_from(&self, number: u64, height: usize) -> Option<usize> {
        let mut random = Pcg64Mcg::seed_from_u64(self.seed ^ number.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        let share = random.random_range(BREAKS_AT.0..BREAKS_AT.1);
        let lost = (1.0 - share) * if self.kind == FaultKind::ShiftedBelow { 1.0 } else { self.strength.clamp(0.0, 1.0) };
        let row = ((1.0 - lost) * height as f64) as usize / BLOCK_PX * BLOCK_PX;
        (number.wrapping_add(self.seed) % BROKEN_EVERY == BROKEN_EVERY - 1).then_some(row.min(height))
    }

    /// Bands of light that flickers `light_hz` times a second.
    fn band(&self, t_s: f64, light_hz: f64, phase: f64, [width, height]: [usize; 2], pixels: &mut [u8]) {
        for (y, row) in pixels.chunks_exact_mut(width * 3).enumerate() {
            let at_s = t_s + READOUT_S * y as f64 / height as f64;
            let gain = 1.0 + self.strength * (std::f64::consts::TAU * light_hz * at_s + phase).sin();
            scale(row, [gain; 3]);
        }
    }
}

/// Multiplies blue, green and red; levels end at 255.
fn scale(pixels: &mut [u8], gains: [f64; 3]) {
    let tables = gains.map(|gain| -> [u8; 256] { std::array::from_fn(|level| (level as f64 * gain).round().clamp(0.0, 255.0) as u8) });
    for pixel in pixels.chunks_exact_mut(3) {
        for (level, table) in pixel.iter_mut().zip(&tables) {
            *level = table[usize::from(*level)];
        }
    }
}

/// Adds a bright spot of this height at `lip_px`.
fn highlight(pixels: &mut [u8], width: usize, lip_px: [f64; 2], height_levels: f64) {
    for (y, row) in pixels.chunks_exact_mut(width * 3).enumerate() {
        let down = (y as f64 - lip_px[1]) / HIGHLIGHT_PX[1];
        if down.abs() > 3.5 {
            continue;
        }
        for (x, pixel) in row.chunks_exact_mut(3).enumerate() {
            let right = (x as f64 - lip_px[0]) / HIGHLIGHT_PX[0];
            let light = (height_levels * (-0.5 * (right * right + down * down)).exp()) as u8;
            pixel.iter_mut().for_each(|level| *level = level.saturating_add(light));
        }
    }
}

/// A camera with a fault.
#[derive(Debug, Clone)]
pub struct FaultyCamera {
    fault: CameraFault,
    size_px: [usize; 2],
    lip_px: [f64; 2],
    /// The picture before, as it was without the fault; empty before the first.
    before: Vec<u8>,
    /// The picture now, as it was.
    now: Vec<u8>,
}

impl FaultyCamera {
    /// A camera with pictures of `size_px` (width, height) in which the lip is at `lip_px`.
    pub fn new(fault: CameraFault, size_px: [usize; 2], lip_px: [f64; 2]) -> Self {
        let bytes = size_px[0] * size_px[1] * 3;
        Self { fault, size_px, lip_px, before: Vec::with_capacity(bytes), now: Vec::with_capacity(bytes) }
    }

    /// Makes of the picture with this number what the faulty camera gives. Frames come in order.
    pub fn pass(&mut self, number: u64, pixels: &mut [u8]) {
        self.now.clear();
        self.now.extend_from_slice(pixels);
        self.fault.apply(number, self.size_px, self.lip_px, &self.before, pixels);
        std::mem::swap(&mut self.before, &mut self.now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects figures of flickering lamps from those of one mains frequency alone: cells whose seeds are all even, or all odd, have both, so
    /// that bands wander in some and stand still in others.
    #[test]
    fn both_mains_frequencies_are_drawn() {
        for parity in [0, 1] {
            let still = (0..16).filter(|i| {
                let fault = CameraFault { kind: FaultKind::Banding, strength: 0.3, seed: 500_000 + 2 * i + parity };
                let picture = |number| {
                    let mut pixels = [128; 4 * 48 * 3];
                    fault.apply(number, [4, 48], [2.0, 20.0], &[], &mut pixels);
                    pixels
                };
                picture(7) == picture(8)
            });
            assert!((3..=13).contains(&still.count()), "seeds of parity {parity}");
        }
    }

    /// Protects reproducible trials: each kind changes the pictures that it is meant to change, the same seed and number in the same way,
    /// and a buffer of another size is left alone.
    #[test]
    fn each_kind_changes_pictures_and_repeats_itself() {
        for kind in FaultKind::ALL {
            let fault = CameraFault { kind, strength: kind.usual_strength(), seed: 5 };
            let run = || {
                let mut camera = FaultyCamera::new(fault, [64, 48], [30.0, 20.0]);
                let mut changed = 0;
                let mut all = Vec::new();
                for number in 0..60u64 {
                    let clean: Vec<u8> = (0..64 * 48 * 3).map(|i| ((i * 7 + i / 192 * 31 + number as usize * 13) % 251) as u8).collect();
                    let mut pixels = clean.clone();
                    camera.pass(number, &mut pixels);
                    changed += usize::from(pixels != clean);
                    all.extend(pixels);
                }
                (changed, all)
            };
            let (changed, all) = run();
            assert!(changed >= 15, "{kind:?} changed {changed} of 60 pictures");
            assert!(run().1 == all, "{kind:?} does not repeat itself");
            let mut other = [7; 30];
            fault.apply(2, [64, 48], [30.0, 20.0], &[], &mut other);
            assert_eq!(other, [7; 30]);
        }
    }
}
