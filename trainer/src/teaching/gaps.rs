//! What areas, weights and fills a data set does not span, in words that say what to record.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail.

use serde::Serialize;
use shared::estimator::Calibration;

use super::span::Span;
use crate::data::{self, TrainingEpisode};

/// Outflow of controlled pours, ml a frame at 30 frames a second: between the first and the last tenth of the volume in the demo's pours.
const POURED_AT_ML: (f64, f64) = (0.2, 0.9);
/// Least volume that has to be seen at such flows, ml: below it, the scale's rounding hides what it says.
const SEEN_AT_LEAST_ML: f64 = 30.0;
/// Weights closer together than this factor say little about how the volume grows with the area. Chosen by hand.
const WEIGHTS_APART: f64 = 2.0;
/// A weight below this is mostly the scale's rounding, g: 0.6 g are 4 % of it.
const LIGHT_G: f64 = 15.0;
/// Onsets closer together than this are one fill, degrees: some 60 ml in a beaker of half a litre.
const FILLS_APART_DEG: f64 = 8.0;
/// A tilt counts as shown if this much flowed beyond it, ml.
const SHOWN_ML: f64 = 5.0;

/// What a data set spans.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Spanned {
    /// Smallest and largest weight, g.
    pub weights_g: (f64, f64),
    /// The areas at which controlled pours flow, by this data's calibration, px^2.
    pub poured_at_px2: (f64, f64),
    /// Volume that the data set shows at these areas, ml.
    pub seen_there_ml: f64,
    /// Tilts at which the fullest and the emptiest vessel began to flow, degrees.
    pub onsets_deg: (f64, f64),
    /// The tilt beyond which nearly nothing flowed, degrees.
    pub last_tilt_deg: f64,
}

/// The tilt at which an episode begins to flow, degrees.
fn onset_deg(episode: &TrainingEpisode) -> Option<f64> {
    episode.first_flow().map(|frame| episode.tilt_deg(frame))
}

/// The tilt beyond which an episode pours less than [`SHOWN_ML`], degrees.
fn last_tilt_deg(episode: &TrainingEpisode, calibration: &Calibration) -> f64 {
    let mut frames: Vec<(f64, f64)> = (0..episode.len())
        .filter(|k| episode.area_px2[*k] > 0.0)
        .map(|k| (episode.tilt_deg(k), f64::from(calibration.volume_ml(episode.area_px2[k] as f32, episode.tilt_deg(k) as f32))))
        .collect();
    frames.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut beyond_ml = 0.0;
    frames
        .iter()
        .find_map(|(deg, ml)| {
            beyond_ml += ml;
            (beyond_ml >= SHOWN_ML).then_some(*deg)
        })
        .unwrap_or(0.0)
}

/// What the episodes span, by a calibration of them; `None` for no episode.
pub fn spanned(episodes: &[TrainingEpisode], calibration: &Calibration) -> Option<Spanned> {
    let range = |values: &mut dyn Iterator<Item = f64>| values.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), v| (l.min(v), h.max(v)));
    let (c, q) =
        (f64::from(calibration.volume_at_1_px2_ml).max(f64::from(f32::MIN_POSITIVE)), f64::from(calibration.area_exponent).max(0.2));
    let area_px2 = |ml: f64| (ml / c).powf(1.0 / q);
    let slower = data::rate_hz(episodes) / 30.0;
    let poured_at_px2 = (area_px2(POURED_AT_ML.0 / slower), area_px2(POURED_AT_ML.1 / slower));
    let spans: Vec<Span> = episodes.iter().map(|e| Span::of_episode(e, calibration)).collect();
    episodes.first()?;
    Some(Spanned {
        weights_g: range(&mut episodes.iter().map(|e| e.weight_g)),
        poured_at_px2,
        seen_there_ml: spans.iter().map(|s| s.between_px2_ml(poured_at_px2)).sum(),
        onsets_deg: range(&mut episodes.iter().filter_map(onset_deg)),
        last_tilt_deg: episodes.iter().map(|e| last_tilt_deg(e, calibration)).fold(0.0, f64::max),
    })
}

impl Spanned {
    /// What is missing, a line each.
    pub fn missing(&self) -> Vec<String> {
        let mut missing = Vec::new();
        let (lightest, heaviest) = self.weights_g;
        let (low_px2, high_px2) = self.poured_at_px2;
        if heaviest < LIGHT_G {
            missing.push(format!("no weight is above {heaviest:.0} g, and a scale rounds: weigh curves or pours of 60 g and more"));
        } else if heaviest < WEIGHTS_APART * lightest.max(1.0) {
            missing.push(format!(
                "all weights lie between {lightest:.0} and {heaviest:.0} g, so that small and large pours cannot be told apart: weigh one \
                 half or twice as heavy"
            ));
        }
        if self.seen_there_ml < SEEN_AT_LEAST_ML {
            missing.push(format!(
                "only {:.0} ml are seen at {low_px2:.0} to {high_px2:.0} px^2, where controlled pours flow: weigh a pour",
                self.seen_there_ml
            ));
        }
        let (first_deg, last_deg) = self.onsets_deg;
        if last_deg - first_deg < FILLS_APART_DEG {
            missing.push(format!(
                "all flow begins between {first_deg:.0} and {last_deg:.0} degrees, so only one fill was shown: record from a fuller and an \
                 emptier vessel"
            ));
        }
        missing
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use shared::estimator::Hold;

    const CALIBRATION: Calibration =
        Calibration { volume_at_1_px2_ml: 0.001, area_exponent: 1.0, log_tilt_slope: 0.0, hold_above_px2: 60.0 };

    /// An episode with 60 frames of an area, from a tilt on.
    fn episode(area_px2: f64, onset_deg: f64) -> TrainingEpisode {
        let mut e = TrainingEpisode::empty("x", 30.0);
        for k in 0..90 {
            let flows = (20..80).contains(&k);
            e.push(f64::from(k) / 30.0, if flows { onset_deg } else { 0.0 }, f64::NAN, if flows { area_px2 } else { 0.0 });
        }
        let mut hold = Hold::default();
        let held: f64 = e.area_px2.iter().map(|a| f64::from(hold.step(Some(*a as f32), 60.0))).sum();
        e.weight_g = (0.001 * held).round();
        e
    }

    /// Protects whoever records: each gap is named by its figure and goes away when it is closed, and a set that spans everything is left alone.
    #[test]
    fn each_gap_is_named() {
        let missing = |all: &[TrainingEpisode]| spanned(all, &CALIBRATION).unwrap().missing();
        let good = [episode(3000.0, 40.0), episode(600.0, 60.0), episode(500.0, 50.0)];
        assert_eq!(missing(&good), Vec::<String>::new());
        assert_eq!(spanned(&[], &CALIBRATION), None);

        // A speck before an upright vessel is no flow, and hides no gap.
        let mut specks = good.clone();
        specks[0].area_px2[5] = 20.0;
        assert_eq!(spanned(&specks, &CALIBRATION).unwrap().onsets_deg, spanned(&good, &CALIBRATION).unwrap().onsets_deg);

        let fast = [episode(3000.0, 40.0), episode(1400.0, 60.0)];
        let said = missing(&fast);
        assert!(said.len() == 1 && said[0].contains("200 to 900 px^2"), "{said:?}");
        let alike = [episode(600.0, 40.0), episode(500.0, 60.0)];
        let said = missing(&alike);
        assert!(said.len() == 1 && said[0].contains("between 31 and 37 g"), "{said:?}");
        let one_fill = [episode(3000.0, 40.0), episode(600.0, 43.0)];
        let said = missing(&one_fill);
        assert!(said.len() == 1 && said[0].contains("between 40 and 43 degrees"), "{said:?}");
        // Areas that are smaller than any cell's.
        let small = Calibration { volume_at_1_px2_ml: 0.1, ..CALIBRATION };
        let said = spanned(&good, &small).unwrap().missing();
        assert!(said.iter().any(|what| what.starts_with("only 0 ml")), "{said:?}");
        let light = [episode(100.0, 40.0), episode(150.0, 60.0)];
        assert!(missing(&light)[0].contains("no weight is above 9 g"), "{:?}", missing(&light));
    }
}
