//! What the learned network is compared with.
//!
//! Pure, any thread; allocates when it is set up; cannot fail. Each baseline sees what a lab would give it; only the oracle sees the
//! truth.

use shared::estimator::fused::{FusedEstimator, FusedFrame};
use shared::estimator::{Calibration, Hold};
use shared::gaussian_curve::Curve;
use shared::limits::{Limiter, Limits};
use shared::weights::Estimator;
use trainer::data::TrainingEpisode;
use trainer::method::control_law::ControlLaw;

use super::pour::Baseline;
use super::simulators::BenchPour;
use simulator::physics::RATE_HZ;

/// The plain linear sum that a lab would write first: `v = c area`, without bridging lost frames.
#[derive(Debug, Clone, Copy)]
pub struct Sum {
    c: f64,
    goal_ml: f64,
    v_ml: [f64; 3],
    poured_ml: f64,
}

impl Sum {
    /// A sum with a linear calibration, for a goal in ml.
    pub fn new(linear: &Calibration, goal_ml: f64) -> Self {
        Self { c: f64::from(linear.volume_at_1_px2_ml), goal_ml, v_ml: [0.0; 3], poured_ml: 0.0 }
    }

    /// Takes one frame's V_e; returns d, ml.
    fn see(&mut self, area_px2: f32) -> f64 {
        let v = if area_px2.is_nan() { self.v_ml[0] } else { self.c * f64::from(area_px2) };
        self.v_ml = [v, self.v_ml[0], self.v_ml[1]];
        self.poured_ml += v;
        self.goal_ml - self.poured_ml
    }
}

/// A PD controller on d with the first guess of its gains: dalpha = 0.02 d - 1.0 v, at most 0.5 degrees forward. It goes back when less
/// than 1 ml is missing.
pub struct HandPd(pub Sum);

impl Baseline for HandPd {
    fn decide(&mut self, area_px2: f32, _: f32, _: &BenchPour) -> Option<f32> {
        let d = self.0.see(area_px2);
        (d > 1.0).then(|| (0.02 * d - self.0.v_ml[0]).clamp(-3.0, 0.5) as f32)
    }
    fn believed_ml(&self) -> f64 {
        self.0.poured_ml
    }
}

/// Two points: forward below an outflow of 0.6 ml a frame, back above it. The pour is over when less than 3 ml is missing.
pub struct BangBang(pub Sum);

impl Baseline for BangBang {
    fn decide(&mut self, area_px2: f32, _: f32, _: &BenchPour) -> Option<f32> {
        let d = self.0.see(area_px2);
        (d > 3.0).then_some(if self.0.v_ml[0] < 0.6 { 0.5 } else { -0.5 })
    }
    fn believed_ml(&self) -> f64 {
        self.0.poured_ml
    }
}

/// Eq. (1) without the camera: the height of the curve is read from a straight line through the episodes' weights and heights.
pub struct OpenLoop {
    curve: Curve,
    frame: u32,
    goal_ml: f64,
}

impl OpenLoop {
    /// Fits the height of the curves against the weight, and takes the height that belongs to a goal in ml.
    pub fn new(episodes: &[TrainingEpisode], goal_ml: f64) -> Self {
        let top = |e: &TrainingEpisode| e.alpha_deg.iter().copied().fold(0.0, f64::max);
        let n = episodes.len().max(1) as f64;
        let mw = episodes.iter().map(|e| e.weight_g).sum::<f64>() / n;
        let mt = episodes.iter().map(top).sum::<f64>() / n;
        let cov: f64 = episodes.iter().map(|e| (e.weight_g - mw) * (top(e) - mt)).sum();
        let var: f64 = episodes.iter().map(|e| (e.weight_g - mw).powi(2)).sum::<f64>().max(1.0);
        let lambda = (mt + cov / var * (goal_ml - mw)).clamp(20.0, 110.0) as f32;
        let gamma = 1.0 / (2.0 * 1.3f32 * 1.3);
        let curve = Curve { lambda_deg: lambda, gamma_per_s2: gamma, beta_s: ((lambda / 0.05).ln() / gamma).sqrt() };
        Self { curve, frame: 0, goal_ml }
    }
}

impl Baseline for OpenLoop {
    fn decide(&mut self, _: f32, alpha_deg: f32, _: &BenchPour) -> Option<f32> {
        self.frame += 1;
        let t_s = self.frame as f32 / RATE_HZ as f32;
        (t_s < self.curve.duration_s()).then(|| self.curve.alpha_deg(t_s) - alpha_deg)
    }
    fn believed_ml(&self) -> f64 {
        self.goal_ml
    }
}

/// A control law (or a PD, which is a law without damping, smoothing and volume in flight) on the network's own estimate.
pub struct ByLaw {
    law: ControlLaw,
    calibration: Calibration,
    hold: Hold,
    fused: Option<FusedEstimator>,
    v_ml: [f64; 3],
    summed_ml: f64,
    goal_ml: f64,
}

impl ByLaw {
    /// A law with the calibration and the estimator of some weights, for a goal in ml.
    pub fn new(law: ControlLaw, calibration: Calibration, estimator: &Estimator, goal_ml: f64) -> Self {
        let fused = match estimator {
            Estimator::Sum => None,
            Estimator::Fused { model, back } => Some(FusedEstimator::new(model, &calibration, *back, RATE_HZ)),
        };
        Self { law, calibration, hold: Hold::default(), fused, v_ml: [0.0; 3], summed_ml: 0.0, goal_ml }
    }
}

impl Baseline for ByLaw {
    fn decide(&mut self, area_px2: f32, alpha_deg: f32, _: &BenchPour) -> Option<f32> {
        let v = f64::from(self.calibration.volume_ml(self.hold.step(Some(area_px2), self.calibration.hold_above_px2), alpha_deg));
        self.v_ml = [v, self.v_ml[0], self.v_ml[1]];
        self.summed_ml += v;
        let d = match &mut self.fused {
            None => self.goal_ml - self.summed_ml,
            Some(fused) => {
                let area_px2 = Some(area_px2).filter(|a| !a.is_nan());
                fused.step(FusedFrame { area_px2, confidence: 1.0, command_deg: f64::from(alpha_deg), measured_deg: f64::NAN });
                self.goal_ml - fused.poured_ml() - fused.stop_volume_ml(f64::from(alpha_deg))
            }
        };
        self.law.decide(self.v_ml, d).map(|a| a as f32)
    }
    fn believed_ml(&self) -> f64 {
        self.fused.as_ref().map_or(self.summed_ml, FusedEstimator::poured_ml)
    }
}

/// Sees the true state and tries out the way back in a copy of the pour: this is what control alone can reach.
pub struct Oracle {
    goal_ml: f64,
    limits: Limits,
    poured_ml: f64,
}

impl Oracle {
    /// An oracle for a goal in ml.
    pub fn new(goal_ml: f64, limits: Limits) -> Self {
        Self { goal_ml, limits, poured_ml: 0.0 }
    }
}

impl Baseline for Oracle {
    fn decide(&mut self, _: f32, alpha_deg: f32, pour: &BenchPour) -> Option<f32> {
        let mut copy = pour.clone();
        let mut limiter = Limiter::new(self.limits, (1.0 / RATE_HZ) as f32, alpha_deg);
        for _ in 0..60 {
            copy.frame(f64::from(limiter.step_upright()));
        }
        let flow_ml = pour.poured_ml() - self.poured_ml;
        self.poured_ml = pour.poured_ml();
        let d = self.goal_ml - copy.poured_ml();
        (d > 0.02).then(|| (1.2 * ((0.05 * d).clamp(0.01, 0.8) - flow_ml)).clamp(-1.0, 0.5) as f32)
    }
    fn believed_ml(&self) -> f64 {
        self.goal_ml
    }
}
