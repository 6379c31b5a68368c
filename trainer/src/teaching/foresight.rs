//! Which streams a curve or a pour to come will show, by the fitted flow model.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail. How the joint follows does not matter here: the
//! streams are what counts, and a late joint shows the same ones later.

use shared::estimator::Calibration;
use shared::estimator::flow::{FlowModel, FlowState, FlowTables};
use shared::gaussian_curve::Curve;

use super::span::Span;

/// Outflow at which a pour is held, ml a frame at [`RATE_HZ`]: that of controlled pours (docs/LEARNING.md).
const HELD_ML: f64 = 0.7;
/// Largest step forward of a foreseen pour, degrees a frame at [`RATE_HZ`]. Chosen by hand: the trained policies rarely move faster.
const FORWARD_DEG: f64 = 1.0;
/// Step back of a foreseen pour, degrees a frame at [`RATE_HZ`]: the way back of the shipped configurations.
const BACK_DEG: f64 = 2.0;
/// Resolution of a foreseen pour's step, degrees.
const STEP_DEG: f64 = 0.05;
/// Longest foreseen pour, frames at [`RATE_HZ`]: the controller's own default (`controller.max_frames`).
const MAX_FRAMES: usize = 900;
/// Frames a second at which the constants above hold, and at which a vessel that was never seen is foreseen: those of the shipped configurations.
const RATE_HZ: f64 = 30.0;
/// A curve begins and ends at this tilt, degrees: as `rt-controller record` does.
const END_DEG: f64 = 0.05;
/// A tilt beyond this is not foreseen, degrees: the flow model's tables end there.
pub const LAST_DEG: f64 = 118.0;

/// A vessel as it was learned, and the camera before it.
#[derive(Debug, Clone)]
pub struct Foresight {
    flow: FlowTables,
    calibration: Calibration,
    /// What the vessel holds up to its lip, ml.
    holds_ml: f64,
    /// The largest tilt that may be commanded, degrees.
    alpha_max_deg: f64,
    /// Frames a second of the episodes that the model was fitted to: its flow is in ml a frame.
    rate_hz: f64,
}

impl Foresight {
    /// The vessel of a model that was fitted to episodes of `rate_hz` frames a second. `holds_ml` is what it holds, if somebody knows that; the model's own volume rests on tilts at which
    /// nothing was ever seen.
    pub fn new(model: &FlowModel, calibration: Calibration, holds_ml: Option<f64>, alpha_max_deg: f64, rate_hz: f64) -> Self {
        let flow = FlowTables::new(model, rate_hz);
        let holds_ml = holds_ml.unwrap_or_else(|| flow.capacity.lost_ml(LAST_DEG));
        Self { flow, calibration, holds_ml, alpha_max_deg, rate_hz }
    }

    /// A vessel of which only the volume is known: a beaker with the usual proportions.
    pub fn unknown(holds_ml: f64, alpha_max_deg: f64) -> Self {
        let mut model = FlowModel::default();
        let factor = (holds_ml / FlowTables::new(&model, RATE_HZ).capacity.lost_ml(LAST_DEG)).cbrt();
        model.vessel.radius_mm *= factor;
        model.vessel.height_mm *= factor;
        let calibration = Calibration { volume_at_1_px2_ml: 0.0025, area_exponent: 1.0, log_tilt_slope: 0.0, hold_above_px2: 60.0 };
        Self::new(&model, calibration, Some(holds_ml), alpha_max_deg, RATE_HZ)
    }

    /// What the vessel holds, ml.
    pub fn holds_ml(&self) -> f64 {
        self.holds_ml
    }

    /// The tilt at which a fill begins to flow, degrees.
    pub fn onset_deg(&self, fill_ml: f64) -> f64 {
        let empty = (1.0 - fill_ml / self.holds_ml).clamp(0.0, 1.0) * self.flow.capacity.lost_ml(LAST_DEG);
        let (mut low, mut high) = (0.0, LAST_DEG);
        for _ in 0..40 {
            let middle = 0.5 * (low + high);
            if self.flow.capacity.lost_ml(middle) < empty { low = middle } else { high = middle }
        }
        0.5 * (low + high)
    }

    /// The fill that begins to flow at a tilt, ml.
    pub fn fill_ml(&self, onset_deg: f64) -> f64 {
        self.holds_ml * (1.0 - self.flow.capacity.lost_ml(onset_deg) / self.flow.capacity.lost_ml(LAST_DEG)).clamp(0.0, 1.0)
    }

    /// What a frame at [`RATE_HZ`] lasts, in frames of the episodes' rate.
    fn slower(&self) -> f64 {
        self.rate_hz / RATE_HZ
    }

    /// The longest foreseen pour, frames of the episodes' rate.
    fn frames_max(&self) -> usize {
        (MAX_FRAMES as f64 * self.slower()) as usize
    }

    fn start(&self, fill_ml: f64) -> FlowState {
        FlowState { headspace_ml: self.flow.capacity.lost_ml(self.onset_deg(fill_ml)), ..FlowState::default() }
    }

    /// Lets a frame pass at a tilt, and adds what is seen.
    fn frame(&self, state: &mut FlowState, tilt_deg: f64, span: &mut Span) -> f64 {
        state.tilt_deg = tilt_deg;
        let over_lip_ml = self.flow.over_lip(tilt_deg, state.headspace_ml, 0.0).flow_ml;
        let leaves_ml = state.release(over_lip_ml, self.flow.model.film_share);
        if leaves_ml > 0.0 {
            span.add(self.calibration.area_px2(leaves_ml, tilt_deg as f32), tilt_deg, leaves_ml);
        }
        leaves_ml
    }

    /// The streams of a curve of eq. (1) from a fill.
    pub fn curve(&self, fill_ml: f64, lambda_deg: f64, gamma_per_s2: f64) -> Span {
        let beta_s = ((lambda_deg / END_DEG).ln() / gamma_per_s2).sqrt();
        let curve = Curve { lambda_deg: lambda_deg as f32, gamma_per_s2: gamma_per_s2 as f32, beta_s: beta_s as f32 };
        let (mut span, mut state) = (Span::empty(), self.start(fill_ml));
        let frames = ((2.0 * beta_s * self.rate_hz) as usize).min(self.frames_max());
        for k in 0..frames {
            self.frame(&mut state, f64::from(curve.alpha_deg((k as f64 / self.rate_hz) as f32)), &mut span);
        }
        span
    }

    /// The streams of a controlled pour; `None` if the goal is not reached within the tilts that may be commanded.
    pub fn pour(&self, fill_ml: f64, goal_ml: f64) -> Option<Span> {
        let (mut span, mut state) = (Span::empty(), self.start(fill_ml));
        let (mut tilt_deg, mut poured_ml): (f64, f64) = (0.0, 0.0);
        let mut back = false;
        let (held_ml, forward_deg, back_deg) = (HELD_ML / self.slower(), FORWARD_DEG / self.slower(), BACK_DEG / self.slower());
        for _ in 0..self.frames_max() {
            if back {
                tilt_deg = (tilt_deg - back_deg).max(0.0);
            } else {
                let before_deg = tilt_deg;
                while tilt_deg < before_deg + forward_deg && self.flow.over_lip(tilt_deg, state.headspace_ml, 0.0).flow_ml < held_ml {
                    tilt_deg += STEP_DEG;
                }
            }
            if tilt_deg > self.alpha_max_deg.min(LAST_DEG) {
                return None;
            }
            poured_ml += self.frame(&mut state, tilt_deg, &mut span);
            // Some two frames' flow at 30 frames a second comes on the way back.
            back |= poured_ml + state.film_ml + 2.0 * HELD_ML >= goal_ml;
            if back && tilt_deg <= 0.0 {
                return Some(span);
            }
        }
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the fills that are proposed: a fuller vessel flows earlier, fill and tilt are each other's inverse, and what is foreseen of a
    /// pour is its goal.
    #[test]
    fn pours_are_foreseen() {
        let vessel = Foresight::unknown(500.0, 105.0);
        let onsets: Vec<f64> = [450.0, 300.0, 150.0].into_iter().map(|fill| vessel.onset_deg(fill)).collect();
        assert!(onsets[0] > 5.0 && onsets[0] + 5.0 < onsets[1] && onsets[1] + 5.0 < onsets[2], "{onsets:?}");
        assert!((vessel.fill_ml(onsets[1]) - 300.0).abs() < 0.5);
        for goal_ml in [30.0, 100.0, 200.0] {
            let span = vessel.pour(350.0, goal_ml).unwrap();
            assert!((span.volume_ml() - goal_ml).abs() < 4.0, "{goal_ml}: {}", span.volume_ml());
        }
        assert!(vessel.pour(100.0, 150.0).is_none(), "more than is in it");
        let (low, high) = (vessel.curve(350.0, onsets[1] + 2.0, 0.25), vessel.curve(350.0, onsets[1] + 15.0, 0.25));
        assert!(high.volume_ml() > low.volume_ml() + 10.0);
    }

    /// Protects whoever fills what is proposed, at any frame rate: the same vessel, whose flow in a frame is half as much at twice the rate, shows the
    /// same volume.
    #[test]
    fn what_is_foreseen_does_not_depend_on_the_frame_rate() {
        let volumes = [30.0, 60.0, 120.0].map(|rate_hz| {
            let mut model = FlowModel::default();
            model.log_weir_coefficient -= (rate_hz / RATE_HZ).ln();
            let calibration = Calibration { volume_at_1_px2_ml: 0.0025, area_exponent: 1.0, log_tilt_slope: 0.0, hold_above_px2: 60.0 };
            let vessel = Foresight::new(&model, calibration, Some(500.0), 105.0, rate_hz);
            let lambda_deg = vessel.onset_deg(300.0) + 12.0;
            [vessel.curve(300.0, lambda_deg, 0.25), vessel.pour(350.0, 100.0).unwrap()].map(|span| span.volume_ml())
        });
        for [curve, pour] in volumes {
            assert!((curve / volumes[0][0] - 1.0).abs() < 0.05 && (pour - 100.0).abs() < 4.0, "{volumes:?}");
        }
    }
}
