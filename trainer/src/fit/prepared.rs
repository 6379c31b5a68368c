//! One episode made ready for the fit, and its residuals.
//!
//! Pure functions of the offline trainer, for any thread. They allocate and do not fail.

use shared::estimator::flow::{CommandHistory, FlowState, FlowTables, FrameOutflow};
use shared::estimator::{Hold, tilt_z};

use super::unknowns::{AREA_EXPONENT, LOG_C, OWN, SHARED, TILT_SLOPE};
use crate::calibration;
use crate::data::TrainingEpisode;

/// Standard deviation of a weight from a scale that shows whole grams, and of the person who reads it, g.
const WEIGHT_SD_G: f64 = 0.6;
/// How much the flow factor differs from pour to pour (log). From the prototype's rigs, whose viscosity changes by this.
const FLOW_FACTOR_SD: f64 = 0.08;
/// Share of the strongest flow that is added to flows before their logarithm is taken. Tuned on rigs 100 to 123, see
/// docs/LEARNING.md.
const FLOOR_SHARE: f64 = 0.036;
/// A residual beyond this counts only with its square root, standard deviations. Chosen by hand; no measurement is recorded.
const HUBER_SDS: f64 = 3.0;
/// Frames before and after a zero in which flow must be seen for the zero to be a dropout. Chosen by hand; no measurement is
/// recorded.
const DROPOUT_FRAMES: usize = 3;

/// How much a stage of the fit lets the episodes differ.
#[derive(Clone, Copy)]
pub struct Stage {
    /// Noise of a frame's area, relative.
    pub area_sd: f64,
    /// How far the camera's gain in a pour is from what is known of it (log).
    pub camera_gain_sd: f64,
    /// How far an episode's delay is from what is known of it, frames.
    pub extra_delay_sd_frames: f64,
    /// Noise of an episode's sum of areas, relative.
    pub area_sum_sd: f64,
}

/// One episode made ready.
pub struct PreparedEpisode {
    /// Tilt of each frame as the model takes it: measured or commanded, degrees.
    alpha_deg: Vec<f64>,
    /// The largest of them, degrees.
    pub top_deg: f64,
    /// Each frame's z, see [`tilt_z`].
    tilt_z: Vec<f64>,
    /// V_e of each frame, px^2; NaN where it is not known.
    pub area_px2: Vec<f64>,
    /// Areas with the dropout hold, as they are summed: those above 0, with their z.
    held: Vec<(f64, f64)>,
    /// Largest mean area of five frames, px^2.
    pub smooth_max_px2: f64,
    /// Whether a frame is compared with the model: lost ones and dropouts are not.
    used: Vec<bool>,
    weight_g: f64,
    /// The first frame that shows flow.
    first: usize,
    /// Delay above the others', as far as it is known, frames.
    pub extra_delay_frames: f64,
    /// Logarithm of the camera's gain, as far as it is known.
    pub log_camera_gain: f64,
}

impl PreparedEpisode {
    /// Makes a usable episode ready; `alpha_deg` is its tilt, measured or commanded.
    pub fn new(e: &TrainingEpisode, alpha_deg: Vec<f64>) -> Self {
        let n = e.len();
        let area = &e.area_px2;
        let seen = |k: usize| area[k] > 0.0;
        let mut used = vec![true; n];
        let mut filled = area.clone();
        for k in 0..n {
            let (from, to) = (k.saturating_sub(DROPOUT_FRAMES), (k + 1 + DROPOUT_FRAMES).min(n));
            if area[k].is_nan() || (area[k] == 0.0 && (from..k).any(seen) && (k + 1..to).any(seen)) {
                used[k] = false;
                // The mean of the neighbours stands in, for the largest mean only.
                let near: Vec<f64> = (from..to).filter(|j| seen(*j)).map(|j| area[j]).collect();
                filled[k] = if near.is_empty() { 0.0 } else { near.iter().sum::<f64>() / near.len() as f64 };
            }
        }
        let mean_of_five = |k: usize| {
            let (from, to) = (k.saturating_sub(2), (k + 3).min(n));
            filled[from..to].iter().sum::<f64>() / (to - from) as f64
        };
        let smooth_max_px2 = (0..n).map(mean_of_five).fold(1e-9, f64::max);
        let mut hold = Hold::default();
        let held = area
            .iter()
            .zip(&e.alpha_deg)
            .map(|(a, alpha)| (f64::from(hold.step(Some(*a as f32), calibration::HOLD_ABOVE_PX2)), tilt_z(*alpha)))
            .filter(|(a, _)| *a > 0.0)
            .collect();
        Self {
            top_deg: alpha_deg.iter().copied().fold(0.0, f64::max),
            alpha_deg,
            tilt_z: e.alpha_deg.iter().map(|a| tilt_z(*a)).collect(),
            area_px2: area.clone(),
            held,
            smooth_max_px2,
            used,
            weight_g: e.weight_g,
            first: e.first_flow().unwrap_or(0),
            extra_delay_frames: 0.0,
            log_camera_gain: 0.0,
        }
    }

    /// Number of frames that show flow.
    pub fn frames_with_flow(&self) -> usize {
        self.held.len()
    }

    /// What the model says left the lip in each frame, and the film after it, ml.
    fn outflow<'a>(&'a self, flow: &'a FlowTables, own: &[f64; OWN]) -> impl Iterator<Item = (f64, f64)> + 'a {
        let [onset_deg, log_flow_factor, _, extra_delay_frames] = *own;
        let mut history = CommandHistory::standing_at(self.alpha_deg[0]);
        let mut state = FlowState {
            tilt_deg: self.alpha_deg[0],
            headspace_ml: flow.capacity.lost_ml(onset_deg.clamp(0.0, 115.0)),
            log_flow_factor,
            extra_delay_frames,
            ..FlowState::default()
        };
        self.alpha_deg.iter().map(move |alpha_deg| {
            history.push(*alpha_deg);
            let FrameOutflow { leaves_ml, .. } = state.step(flow, history.commands(), 0);
            (leaves_ml, state.film_ml)
        })
    }

    /// The residuals of this episode, in standard deviations: one a frame, two for its weight, three for its own unknowns.
    ///
    /// `flow` is the model of the `shared` unknowns; `area_min_px2` is the smallest area that the camera shows.
    pub fn residuals(&self, flow: &FlowTables, shared: &[f64; SHARED], own: &[f64; OWN], stage: &Stage, area_min_px2: f64) -> Vec<f64> {
        let mut residuals = Vec::with_capacity(self.area_px2.len() + 5);
        let [_, log_flow_factor, log_camera_gain, extra_delay_frames] = *own;
        let (log_c, q, tilt) = (shared[LOG_C], shared[AREA_EXPONENT], shared[TILT_SLOPE]);
        let (c, gain) = (log_c.exp(), log_camera_gain.exp());
        let least_ml = c * area_min_px2.powf(q);
        let floor_ml = FLOOR_SHARE * c * self.smooth_max_px2.powf(q);
        let (mut sum_ml, mut film_ml) = (0.0, 0.0);
        for (k, (leaves_ml, left_ml)) in self.outflow(flow, own).enumerate() {
            sum_ml += leaves_ml;
            film_ml = left_ml;
            if !self.used[k] {
                continue;
            }
            let model_ml = leaves_ml * gain;
            let c_k = c * (tilt * self.tilt_z[k]).exp();
            // A zero says that no more flows than the camera shows.
            let seen_ml = if self.area_px2[k] > 0.0 { c_k * self.area_px2[k].powf(q) } else { model_ml.min(least_ml) };
            residuals.push(huber(((seen_ml + floor_ml) / (model_ml + floor_ml)).ln() / (stage.area_sd * q)));
        }
        residuals.push((sum_ml + film_ml - self.weight_g) / WEIGHT_SD_G);
        let camera_ml: f64 = self.held.iter().map(|(a, z)| c * (tilt * z).exp() * a.powf(q)).sum();
        residuals.push((camera_ml / gain - self.weight_g) / WEIGHT_SD_G.hypot(stage.area_sum_sd * self.weight_g));
        residuals.push(log_flow_factor / FLOW_FACTOR_SD);
        residuals.push((log_camera_gain - self.log_camera_gain) / stage.camera_gain_sd);
        residuals.push((extra_delay_frames - self.extra_delay_frames) / stage.extra_delay_sd_frames);
        residuals
    }

    /// Where flow probably starts, degrees: the model's tilt at the first sight of flow, a little back.
    pub fn onset_guess_deg(&self, flow: &FlowTables) -> f64 {
        let mut history = CommandHistory::standing_at(self.alpha_deg[0]);
        let mut tilt_deg = self.alpha_deg[0];
        for alpha_deg in &self.alpha_deg[..=self.first] {
            history.push(*alpha_deg);
            tilt_deg = flow.next_tilt_deg(tilt_deg, flow.delayed_deg(history.commands(), 0, 0.0));
        }
        tilt_deg - 1.0
    }
}

/// A residual that counts with its square root beyond [`HUBER_SDS`].
fn huber(r: f64) -> f64 {
    if r.abs() <= HUBER_SDS { r } else { r.signum() * (2.0 * HUBER_SDS * r.abs() - HUBER_SDS * HUBER_SDS).sqrt() }
}
