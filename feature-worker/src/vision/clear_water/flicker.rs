//! Whether lamps flicker: bands of light that lie elsewhere in each picture. It is told from picture to picture while the background is at
//! rest or even, because what moves differs across the rows and light does not.
//!
//! Called on the extraction thread. Nothing is allocated after the start. The only failures are OpenCV's.

use opencv::core::{Mat, Size, Vec4b};
use opencv::prelude::*;

use crate::vision::pace::Pace;
use crate::vision::picture::median;

/// Height of a band, px. Chosen by hand: bands of lamps are ten times as high, and half of it has too much noise (tried on seed 101 of
/// `evaluate-camera --faults`).
const BAND_PX: usize = 8;
/// Blocks of a band. Chosen by hand: a stream covers a few of them.
const BLOCKS: usize = 10;
/// Of this many rows of a band, one is read. Chosen by hand, for speed.
const ROW_EVERY: usize = 2;
/// Blocks darker than this tell nothing of the light, grey levels. Chosen by hand.
const DARK_LEVEL: f32 = 12.0;
/// Blocks brighter than this may be cut off, grey levels. Chosen by hand.
const BRIGHT_LEVEL: f32 = 240.0;
/// A block agrees with its band when its light changed by the same factor up to this share. Chosen by hand: noise alone makes 0.6 %.
const AGREES: f32 = 0.025;
/// The light of a band is told when this share of its blocks agrees. Chosen by hand.
const BLOCKS_AGREE: f32 = 0.7;
/// The light of a picture is told when it is in this share of the bands. Chosen by hand.
const BANDS_TOLD: f32 = 0.6;
/// The light flickers when bands changed by factors that differ by this share. Chosen by hand: bands of 5 % make 17 % at 50 Hz mains, and
/// pictures without bands 2 %.
const DIFFER: f32 = 0.06;
/// So many pictures with that, with quiet ones between, tell it. Chosen by hand.
const PICTURES: u32 = 3;
/// After so many pictures of told light without bands, it flickers no more. Chosen by hand: two seconds.
const QUIET_PICTURES: u32 = 60;

/// The background is at rest when the light is told in this share of the bands. Chosen by hand.
const BANDS_AT_REST: f32 = 0.9;
/// Light that is brighter or darker than in the last picture by more than this factor jumps. Chosen by hand: an automatic exposure that
/// hunts does so, and a drift of minutes does not.
const JUMP: f32 = 1.05;

/// Looks for light that flickers.
pub(super) struct Flicker {
    size: Size,
    /// Mean levels of the blocks in the last picture, band after band; empty before the first.
    before: Vec<[f32; BLOCKS]>,
    // Kept from picture to picture.
    now: Vec<[f32; BLOCKS]>,
    ratios: Vec<f32>,
    band_ratios: Vec<f32>,
    bands: Vec<f32>,
    /// Pictures with bands, and for how many quiet ones they still count.
    pictures: u32,
    counts_for: u32,
    jumps: bool,
    pace: Pace,
}

impl Flicker {
    /// For small pictures of `size`, px.
    pub(super) fn new(size: Size) -> Self {
        let bands = size.height as usize / BAND_PX;
        let room = || Vec::with_capacity(bands);
        Self {
            size,
            before: room(),
            now: room(),
            ratios: Vec::with_capacity(bands * BLOCKS),
            band_ratios: Vec::with_capacity(BLOCKS),
            bands: Vec::with_capacity(bands),
            pictures: 0,
            counts_for: 0,
            jumps: false,
            pace: Pace::CHOSEN,
        }
    }

    /// Says how fast pictures follow each other.
    pub(super) fn set_pace(&mut self, pace: Pace) {
        self.pace = pace;
    }

    /// Takes note of the next picture. Returns by which factor it is brighter than the last one; 1 where what moves hides it.
    #[inline(always)]
    pub(super) fn look(&mut self, picture: &Mat) -> opencv::Result<f32> {
        self.read(picture)?;
        let known = self.before.len() == self.now.len();
        let exposure = if known { self.compare() } else { 1.0 };
        std::mem::swap(&mut self.before, &mut self.now);
        Ok(exposure)
    }

    /// Whether the light flickers.
    pub(super) fn flickers(&self) -> bool {
        self.pictures >= PICTURES
    }

    /// Whether the picture before an unmoved background is brighter or darker than the last one as a whole.
    pub(super) fn jumps(&self) -> bool {
        self.jumps
    }

    /// Reads the blocks' mean levels.
    #[inline(always)]
    fn read(&mut self, picture: &Mat) -> opencv::Result<()> {
        let (width, pixels) = (self.size.width as usize, picture.data_typed::<Vec4b>()?);
        let block = width / BLOCKS;
        self.now.clear();
        for band in pixels.chunks_exact(width * BAND_PX) {
            let mut sums = [0u32; BLOCKS];
            for row in band.chunks_exact(width).step_by(ROW_EVERY) {
                for (sum, pixels) in sums.iter_mut().zip(row.chunks_exact(block.max(1))) {
                    *sum += pixels.iter().map(|p| u32::from(p[0]) + u32::from(p[1]) + u32::from(p[2])).sum::<u32>();
                }
            }
            let count = (3 * block.max(1) * BAND_PX.div_ceil(ROW_EVERY)) as f32;
            self.now.push(sums.map(|sum| sum as f32 / count));
        }
        Ok(())
    }

    /// Compares the blocks with those of the last picture.
    fn compare(&mut self) -> f32 {
        let told = |level: &f32| *level > DARK_LEVEL && *level < BRIGHT_LEVEL;
        self.bands.clear();
        self.ratios.clear();
        let mut judged = 0usize;
        for (now, before) in self.now.iter().zip(&self.before) {
            self.band_ratios.clear();
            self.band_ratios.extend(now.iter().zip(before).filter(|(a, b)| told(a) && told(b)).map(|(a, b)| a / b));
            self.ratios.extend_from_slice(&self.band_ratios);
            if self.band_ratios.len() < BLOCKS / 2 {
                continue;
            }
            judged += 1;
            let middle = median(&mut self.band_ratios);
            let agree = self.band_ratios.iter().filter(|ratio| (*ratio / middle - 1.0).abs() <= AGREES).count();
            if agree as f32 >= BLOCKS_AGREE * self.band_ratios.len() as f32 {
                self.bands.push(middle);
            }
        }
        let exposure = if self.ratios.is_empty() { 1.0 } else { median(&mut self.ratios) };
        let at_rest = judged >= 4 && self.bands.len() as f32 >= BANDS_AT_REST * judged as f32;
        self.jumps = at_rest && exposure.max(1.0 / exposure.max(0.01)) > JUMP;
        let told = judged >= 4 && self.bands.len() as f32 >= BANDS_TOLD * judged as f32;
        if told {
            let (least, most) = self.bands.iter().fold((f32::MAX, 0.0f32), |(low, high), v| (low.min(*v), high.max(*v)));
            if most / least.max(0.01) > 1.0 + DIFFER {
                (self.pictures, self.counts_for) = ((self.pictures + 1).min(PICTURES), self.pace.pictures(QUIET_PICTURES));
            } else if self.counts_for > 0 {
                self.counts_for -= 1;
            } else {
                self.pictures = 0;
            }
        }
        if told { exposure } else { 1.0 }
    }
}
