//! How the light on the picture differs from that on the remembered ground: in bands of rows, as lamps that flicker make with a rolling
//! shutter, and in each colour, as a white balance that hunts does. Both are divided out before anything else looks at the picture.
//!
//! Called on the extraction thread. Nothing is allocated after the start. The only failures are OpenCV's.

use opencv::core::{Mat, Size, Vec4b};
use opencv::prelude::*;

use super::background::{Background, WetPlaces};
use crate::vision::geometry::LinearField;
use crate::vision::picture::median;

// "Tuned" below means that the value was tuned on seeds 101 to 104 of `evaluate-camera`; see docs/VISION.md.

/// Height of a band, px. Chosen by hand: bands of lamps are ten times as high.
const BAND_PX: usize = 8;
/// Beyond the known bands the light goes on as between them for so many rows. Chosen by hand: the rim cuts a band off.
const BEYOND_PX: f32 = 6.0;
/// Rows of a band that are looked at, from the first of them on. Chosen by hand, for speed.
const BAND_ROWS: [usize; 3] = [1, 4, 6];
/// Places of a row that are looked at. Chosen by hand, for speed.
const PLACES: usize = 28;
/// A band with fewer known places takes its light from its neighbours. Chosen by hand.
const PLACES_LEAST: usize = 12;
/// Ground darker than this tells nothing of the light, grey levels. Chosen by hand.
const DARK_LEVEL: f32 = 16.0;
/// Ground and picture brighter than this may be cut off, grey levels. Chosen by hand.
const BRIGHT_LEVEL: f32 = 248.0;
/// Light is divided out when a band differs from the others by more than this, as a share. Chosen by hand: noise alone makes 1 %.
const BAND_LEAST: f32 = 0.03;
/// Light is divided out when a colour differs from the others by more than this, as a share. Chosen by hand: noise alone makes 0.5 %.
const COLOUR_LEAST: f32 = 0.02;
/// The light is told when nine tenths of the places are this close to the median of their band, as a share: otherwise the ground has a
/// pattern that does not lie where it is remembered. Tuned.
const CLOSE: f32 = 0.08;
/// Before a pattern, bands with this ratio of the brightest to the darkest are those of the light. Tuned.
const UNEVEN: f32 = 1.6;
/// With this ratio of the brightest band to the darkest, what is not seen may be there. Chosen by hand: at 30 % it is 1.86.
const FLICKERS: f32 = 1.9;

/// The light on the present picture against that on the remembered ground.
pub(super) struct Light {
    size: Size,
    /// Middle row and gain of each band whose ground is known, from the top.
    bands: Vec<(f32, f32)>,
    /// Gains of blue, green and red.
    colours: [f32; 3],
    /// The exposure against the remembered ground. It is not divided out.
    exposure: f32,
    /// Whether the gains are not those of an undisturbed picture.
    differs: bool,
    /// Whether there are bands in front of a pattern, so that the light is not told.
    uneven: bool,
    // Ratios whose medians are taken.
    ratios: Vec<f32>,
    /// The places that are known.
    places: Vec<Place>,
}

/// A place whose ground is known.
struct Place {
    y: f32,
    /// Blue, green and red in the picture and of the ground, grey levels.
    seen: [f32; 3],
    dry: [f32; 3],
    /// The light there: the picture's brightness against the ground's.
    ratio: f32,
}

impl Place {
    /// A place in row `y` with this colour before this ground, unless it tells nothing of the light.
    #[inline(always)]
    fn new(y: f32, pixel: Vec4b, dry: [f32; 3]) -> Option<Self> {
        let seen = [0, 1, 2].map(|k| f32::from(pixel[k]));
        let (dry_sum, seen_sum) = (dry.iter().sum::<f32>(), seen.iter().sum::<f32>());
        let brightest = seen.iter().chain(&dry).copied().fold(0.0, f32::max);
        let tells = dry_sum >= 3.0 * DARK_LEVEL && brightest <= BRIGHT_LEVEL && seen_sum > 0.0;
        tells.then(|| Self { y, seen, dry, ratio: seen_sum / dry_sum })
    }

    /// The light of one colour against that of all, where the ground has enough of it.
    #[inline(always)]
    fn colour_ratio(&self, k: usize) -> Option<f32> {
        (self.dry[k] >= DARK_LEVEL).then(|| self.seen[k] / self.dry[k] / self.ratio)
    }
}

impl Light {
    /// For small pictures of `size`, px.
    pub(super) fn new(size: Size) -> Self {
        let bands = (size.height as usize).div_ceil(BAND_PX);
        let places = BAND_ROWS.len() * PLACES;
        Self {
            size,
            bands: Vec::with_capacity(bands),
            colours: [1.0; 3],
            exposure: 1.0,
            differs: false,
            uneven: false,
            ratios: Vec::with_capacity(places * bands),
            places: Vec::with_capacity(places * bands),
        }
    }

    /// Finds the light on the picture `now` by the ground that is known, in the air and not wet, and divides it out. Returns whether the
    /// ground tells the light.
    #[inline(always)]
    pub(super) fn divide_out(
        &mut self,
        now: &mut Mat,
        background: &Background,
        height_px: LinearField,
        wet: Option<WetPlaces>,
    ) -> opencv::Result<bool> {
        (self.differs, self.uneven) = (false, false);
        if background.is_new() {
            return Ok(false);
        }
        self.places.clear();
        let (width, pixels, ground) = (self.size.width as usize, now.data_typed::<Vec4b>()?, background.ground());
        self.bands.clear();
        for band in 0..(self.size.height as usize).div_ceil(BAND_PX) {
            let before = self.places.len();
            for row in BAND_ROWS {
                let y = band * BAND_PX + row;
                for k in 0..PLACES {
                    // Not below each other, so that no upright edge is met in every row.
                    let x = (k * width + (row * width) / BAND_PX) / PLACES;
                    let Some(pixel) = pixels.get(y * width + x).filter(|_| x < width) else { continue };
                    let at = [x as f32, y as f32];
                    let wet = wet.is_some_and(|w| w.line_share.at(at) <= 1.0 || w.right_px.at(at) < 1.0);
                    if !wet && height_px.at(at) >= 0.0 {
                        self.places.extend(ground.at(at).and_then(|dry| Place::new(at[1], *pixel, dry)));
                    }
                }
            }
            let places = &self.places[before..];
            if places.len() >= PLACES_LEAST {
                self.ratios.clear();
                self.ratios.extend(places.iter().map(|p| p.ratio));
                let middle = places.iter().map(|p| p.y).sum::<f32>() / places.len() as f32;
                self.bands.push((middle, median(&mut self.ratios).max(0.05)));
            }
        }
        if self.bands.is_empty() {
            return Ok(false);
        }
        (self.differs, self.colours) = (true, [1.0; 3]);
        // The places lie row by row.
        let (mut row, mut gain, mut close) = (f32::NAN, 1.0, 0usize);
        for place in &self.places {
            if place.y != row {
                (row, gain) = (place.y, self.gains(place.y)[0]);
            }
            close += usize::from((place.ratio / gain - 1.0).abs() <= CLOSE);
        }
        self.differs = false;
        let told = close > self.places.len() * 9 / 10;
        self.uneven = !told && self.spread() > UNEVEN;
        if !told {
            return Ok(false);
        }
        for (k, colour) in self.colours.iter_mut().enumerate() {
            self.ratios.clear();
            self.ratios.extend(self.places.iter().filter_map(|place| place.colour_ratio(k)));
            // Ground that hardly has a colour does not tell its change.
            *colour = if self.ratios.len() < PLACES_LEAST { 1.0 } else { median(&mut self.ratios).max(0.05) };
        }
        self.ratios.clear();
        self.ratios.extend(self.bands.iter().map(|(_, gain)| *gain));
        self.exposure = median(&mut self.ratios);
        self.bands.iter_mut().for_each(|(_, gain)| *gain /= self.exposure);
        let uneven = self.bands.iter().any(|(_, gain)| (gain - 1.0).abs() > BAND_LEAST);
        let tinted = self.colours.iter().any(|colour| (colour - 1.0).abs() > COLOUR_LEAST);
        self.differs = uneven || tinted;
        if self.differs {
            self.divide(now)?;
        }
        Ok(true)
    }

    /// By what the picture's exposure differs from that which was expected against the remembered ground, where light was divided out. The exposure stays in
    /// the picture: were it divided out too, nothing would tell the exposure against the memory any more, and it would wander.
    pub(super) fn exposure(&self) -> f32 {
        if self.differs { self.exposure } else { 1.0 }
    }

    /// Gains of blue, green and red in a row of the small picture.
    pub(super) fn gains(&self, y: f32) -> [f32; 3] {
        if !self.differs {
            return [1.0; 3];
        }
        // Between the bands around the row; beyond the last of them, a little further in the same way.
        let next = self.bands.iter().position(|(middle, _)| *middle > y).unwrap_or(self.bands.len());
        let next = next.clamp(1, (self.bands.len() - 1).max(1));
        let band = match (self.bands.get(next - 1), self.bands.get(next)) {
            (Some((from, one)), Some((to, other))) => {
                let y = y.clamp(from - BEYOND_PX, to + BEYOND_PX);
                one + (other - one) * (y - from) / (to - from)
            }
            (Some((_, one)), None) => *one,
            _ => 1.0,
        };
        let band = band.max(0.05);
        self.colours.map(|colour| colour * band)
    }

    /// The ratio of the brightest band to the darkest.
    fn spread(&self) -> f32 {
        let gains = || self.bands.iter().map(|(_, gain)| *gain);
        let (most, least) = (gains().fold(0.0, f32::max), gains().fold(f32::MAX, f32::min));
        most / least.max(0.01)
    }

    /// Whether bands are so dark or so bright against each other that little is left to see, or bands are seen that cannot be divided out.
    pub(super) fn flickers(&self) -> bool {
        self.uneven || (self.differs && self.spread() > FLICKERS)
    }

    fn divide(&self, now: &mut Mat) -> opencv::Result<()> {
        let width = self.size.width as usize;
        for (y, row) in now.data_typed_mut::<Vec4b>()?.chunks_exact_mut(width).enumerate() {
            // 256 is 1.
            let factors = self.gains(y as f32).map(|gain| (256.0 / gain).round() as u32);
            for pixel in row {
                for k in 0..3 {
                    pixel[k] = ((u32::from(pixel[k]) * factors[k] + 128) >> 8).min(255) as u8;
                }
            }
        }
        Ok(())
    }
}
