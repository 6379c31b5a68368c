//! Which streams an episode shows: its volume by area and tilt, in cells.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail. What lies outside of the cells counts for the
//! nearest one.

use shared::estimator::{Calibration, Hold};

use crate::data::TrainingEpisode;

/// Number of cells over the area.
pub const AREAS: usize = 17;
/// Number of cells over the tilt.
pub const TILTS: usize = 12;
/// Number of all cells.
pub const CELLS: usize = AREAS * TILTS;
/// Logarithm of the smallest area of the cells: 20 px^2, below which no stream is seen.
const LOG_AREA_FROM: f64 = 3.0;
/// Width of a cell in the logarithm of the area: a factor of 1.65.
const LOG_AREA_STEP: f64 = 0.5;
/// Width of a cell in the tilt, degrees.
const TILT_STEP_DEG: f64 = 10.0;

/// Volume by area and tilt, ml.
#[derive(Debug, Clone, PartialEq)]
pub struct Span {
    /// Volume of each cell, ml.
    pub ml: Vec<f64>,
}

/// The cell of an area and a tilt.
fn cell(area_px2: f64, tilt_deg: f64) -> usize {
    let at = |value: f64, cells: usize| if value.is_finite() { (value.max(0.0) as usize).min(cells - 1) } else { 0 };
    let area = at((area_px2.max(1.0).ln() - LOG_AREA_FROM) / LOG_AREA_STEP, AREAS);
    let tilt = at(tilt_deg / TILT_STEP_DEG, TILTS);
    tilt * AREAS + area
}

/// The middle of a cell: the logarithm of the area in px^2, and the tilt in degrees.
pub fn middle(cell: usize) -> (f64, f64) {
    let (tilt, area) = (cell / AREAS, cell % AREAS);
    (LOG_AREA_FROM + (area as f64 + 0.5) * LOG_AREA_STEP, (tilt as f64 + 0.5) * TILT_STEP_DEG)
}

impl Span {
    /// Nothing.
    pub fn empty() -> Self {
        Self { ml: vec![0.0; CELLS] }
    }

    /// Adds a frame of `ml`.
    pub fn add(&mut self, area_px2: f64, tilt_deg: f64, ml: f64) {
        self.ml[cell(area_px2, tilt_deg)] += ml;
    }

    /// What an episode shows, as the calibration has it. The tilt is the measured one where there is one.
    pub fn of_episode(episode: &TrainingEpisode, calibration: &Calibration) -> Self {
        let mut span = Self::empty();
        let mut hold = Hold::default();
        for (k, area) in episode.area_px2.iter().enumerate() {
            let held = hold.step(Some(*area as f32).filter(|a| !a.is_nan()), calibration.hold_above_px2);
            let tilt_deg = episode.tilt_deg(k);
            if held > 0.0 {
                span.add(f64::from(held), tilt_deg, f64::from(calibration.volume_ml(held, tilt_deg as f32)));
            }
        }
        span
    }

    /// All volume, ml.
    pub fn volume_ml(&self) -> f64 {
        self.ml.iter().sum()
    }

    /// Volume of the streams with areas in a range, ml; a cell counts if its middle lies there.
    pub fn between_px2_ml(&self, (low_px2, high_px2): (f64, f64)) -> f64 {
        let inside = |k: usize| (low_px2.ln()..high_px2.ln()).contains(&middle(k).0);
        self.ml.iter().enumerate().filter(|(k, _)| inside(*k)).fold(0.0, |sum, (_, ml)| sum + ml)
    }

    /// The area below which half of the volume flows, px^2; `None` for no volume.
    pub fn median_area_px2(&self) -> Option<f64> {
        let half = 0.5 * self.volume_ml();
        let mut below = 0.0;
        (0..AREAS).filter(|_| half > 0.0).find_map(|area| {
            let here: f64 = (0..TILTS).map(|tilt| self.ml[tilt * AREAS + area]).sum();
            below += here;
            // Within the cell the volume is taken as even.
            let into = 1.0 - (below - half) / here.max(1e-9);
            (below >= half).then(|| (LOG_AREA_FROM + (area as f64 + into) * LOG_AREA_STEP).exp())
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects what everything here rests on: volume is kept, lies in its cell, and nothing wild is lost or panics.
    #[test]
    fn volume_lies_where_it_flowed() {
        let mut span = Span::empty();
        span.add(1000.0, 55.0, 3.0);
        span.add(1000.0, 55.0, 2.0);
        span.add(f64::NAN, -5.0, 1.0);
        span.add(1e12, 500.0, 1.0);
        assert_eq!(span.volume_ml(), 7.0);
        let (at, most) = span.ml.iter().copied().enumerate().fold((0, 0.0), |best, (k, ml)| if ml > best.1 { (k, ml) } else { best });
        let (log_area, tilt_deg) = middle(at);
        assert_eq!(most, 5.0);
        assert!((log_area - 1000f64.ln()).abs() <= 0.5 * LOG_AREA_STEP && (tilt_deg - 55.0).abs() <= 0.5 * TILT_STEP_DEG);
        let median_px2 = span.median_area_px2().unwrap();
        assert!((600.0..1700.0).contains(&median_px2), "{median_px2}");
        assert_eq!(Span::empty().median_area_px2(), None);
    }
}
