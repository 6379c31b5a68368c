//! Policy search inside the fitted model: a control law with a few parameters, found by the cross-entropy method.
//!
//! Offline, pure, allocates; deterministic on any number of threads (each pour has its own seed, sums are taken in order).
//!
//! ```text
//! vbar   = (v0 + s (v1 + v2)) / (1 + 2 s)                     the last three outflows
//! d'     = d - d0 - kf vbar
//! v*     = clip(c d', 0, vmax)                                wanted outflow
//! dalpha = clip(K (v* - vbar - kd (v0 - v2)/2), -3, um);  while nothing flows: clip(K v*, 0.2, u0);  d' <= 0: back
//! ```

use nalgebra::DMatrix;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use shared::actions::BACK_DEG_PER_FRAME;
use shared::estimate::flow::{DRIP, Flow, FlowModel, FlowState, HISTORY, Return};
use shared::estimate::{Calibration, Hold};
use shared::limits::{Limiter, Limits};

use crate::fit::{self, Fit};

/// Frames after which a pour counts as never ending.
pub const MAX_FRAMES: usize = 900;

/// Slowest forward while nothing flows and volume is missing, degrees a frame: it must be an action that the network has.
const CREEP_DEG: f64 = 0.2;

/// The law's parameters.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Law {
    /// Wanted outflow for each ml that is missing, 1/frame.
    pub c: f64,
    /// Stop this much early, ml.
    pub d0: f64,
    /// Largest wanted outflow, ml a frame.
    pub vmax: f64,
    /// Damping, frames.
    pub kd: f64,
    /// Gain, degrees for each ml a frame.
    pub k: f64,
    /// Fastest forward while liquid flows, degrees a frame.
    pub um: f64,
    /// Smoothing of the outflow.
    pub s: f64,
    /// Volume in flight, frames.
    pub kf: f64,
    /// Fastest forward while nothing flows, degrees a frame.
    pub u0: f64,
}

const PARAMETERS: usize = 9;

impl Law {
    /// Where the search starts. With the fused estimate the volume in flight is already in d.
    pub fn start(fused: bool) -> Self {
        let (d0, kf) = if fused { (0.05, 0.02) } else { (0.5, 3.0) };
        Self { c: 0.03, d0, vmax: 1.0, kd: 2.0, k: 1.0, um: 0.5, s: 0.5, kf, u0: 0.7 }
    }

    /// A PD on d is the law without damping, smoothing and volume in flight: dalpha = K c d - K v.
    pub fn start_pd(fused: bool) -> Self {
        Self { vmax: 1e3, kd: 1e-6, s: 1e-6, kf: 1e-6, ..Self::start(fused) }
    }

    fn logs(&self) -> [f64; PARAMETERS] {
        [self.c, self.d0, self.vmax, self.kd, self.k, self.um, self.s, self.kf, self.u0].map(f64::ln)
    }

    fn from_logs(l: &[f64; PARAMETERS]) -> Self {
        let [c, d0, vmax, kd, k, um, s, kf, u0] = l.map(f64::exp);
        Self { c, d0, vmax: if vmax < 100.0 { vmax.min(1.6) } else { vmax }, kd, k, um: um.min(3.0), s, kf, u0: u0.min(3.0) }
    }

    /// The angle that the law asks for, degrees; `None`: back.
    pub fn decide(&self, v_ml: [f64; 3], d_ml: f64) -> Option<f64> {
        let [v0, v1, v2] = v_ml;
        let vbar = (v0 + self.s * (v1 + v2)) / (1.0 + 2.0 * self.s);
        let left = d_ml - self.d0 - self.kf * vbar;
        if left <= 0.0 {
            return None;
        }
        let wanted = (self.c * left).clamp(0.0, self.vmax);
        Some(if v0 == 0.0 && v1 == 0.0 && v2 == 0.0 {
            (self.k * wanted).clamp(CREEP_DEG.min(self.u0), self.u0)
        } else {
            (self.k * (wanted - vbar - self.kd * (v0 - v2) / 2.0)).clamp(-3.0, self.um)
        })
    }
}

/// What pours are drawn from: the fit with its doubts, and how the controller moves.
#[derive(Debug, Clone)]
pub struct Worlds {
    nominal: FlowModel,
    root: DMatrix<f64>,
    onset_deg: (f64, f64),
    calibration: Calibration,
    /// Lower root of the covariance of its log c and q: (1,1), (2,1), (2,2).
    calibration_root: [f64; 3],
    dropouts: f64,
    /// The controller's limits.
    pub limits: Limits,
    /// How it comes back.
    pub back: Return,
    /// Frames a second.
    pub rate_hz: f64,
    /// Whether the policy gets the fused d (volume in flight taken off) or the plain sum.
    pub fused: bool,
}

impl Worlds {
    /// From a fit.
    pub fn new(fit: &Fit, limits: Limits, rate_hz: f64, fused: bool) -> Self {
        let n = fit.covariance.nrows();
        let mut covariance = fit.covariance.clone();
        for k in 0..n {
            covariance[(k, k)] += 1e-10;
        }
        let root = covariance.cholesky().map_or_else(|| DMatrix::zeros(n, n), |c| c.l());
        let [[cc, cq], [_, qq]] = fit.calibration_covariance;
        let c_sd = cc.max(1e-12).sqrt();
        let calibration_root = [c_sd, cq / c_sd, (qq - cq * cq / (c_sd * c_sd)).max(0.0).sqrt()];
        let onsets = fit.episodes.iter().map(|e| e[0]);
        let low = onsets.clone().fold(f64::INFINITY, f64::min).clamp(5.0, 85.0);
        let high = onsets.fold(f64::NEG_INFINITY, f64::max).clamp(5.0, 85.0);
        Self {
            nominal: fit.model,
            root,
            onset_deg: ((low - 8.0).max(3.0), (high + 5.0).min(88.0)),
            calibration: fit.calibration,
            calibration_root,
            dropouts: fit.dropouts.min(0.2),
            limits,
            back: Return::new(&limits, rate_hz),
            rate_hz,
            fused,
        }
    }

    /// A pour drawn from `seed`.
    pub fn pour(&self, seed: u64) -> ModelPour<'_> {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let z: Vec<f64> = (0..self.root.nrows()).map(|_| normal()).collect();
        let moved: Vec<f64> =
            (0..self.root.nrows()).map(|r| (0..=r).map(|c| self.root[(r, c)] * z[c]).sum::<f64>().clamp(-0.6, 0.6)).collect();
        let mut model = fit::moved(&self.nominal, &moved);
        model.lk += 0.12 * normal();
        model.p = (model.p + 0.03 * normal()).clamp(0.5, 3.5);
        model.tau = (model.tau + 0.3 * normal()).max(0.0);
        model.delay = (model.delay + 0.3 * normal()).clamp(0.0, 12.0);
        model.eta = (model.eta + 0.02 * normal()).clamp(0.0, 0.4);
        let gain = 1.0 + 0.015 * normal();
        let [l11, l21, l22] = self.calibration_root;
        let (z_c, z_q) = (normal(), normal());
        let miscalibrated = (l11 * z_c, l21 * z_c + l22 * z_q);
        let flow = Flow::new(&model);
        let onset = rng.random_range(self.onset_deg.0..self.onset_deg.1);
        let x_ml = flow.capacity_ml(onset);
        let most = 0.85 * (flow.capacity_ml(95.0) - x_ml);
        let goal_ml = rng.random_range(8.0..220.0f64).min(most.max(8.0));
        ModelPour {
            worlds: self,
            flow,
            gain,
            miscalibrated,
            goal_ml,
            state: FlowState { x_ml, ..FlowState::default() },
            poured_ml: 0.0,
            believed_ml: 0.0,
            summed_ml: 0.0,
            history: [0.0; HISTORY],
            limiter: Limiter::new(self.limits, (1.0 / self.rate_hz) as f32, 0.0),
            hold: Hold::default(),
            v_ml: [0.0; 3],
            rng,
        }
    }
}

/// A pour in the model.
#[derive(Debug, Clone)]
pub struct ModelPour<'a> {
    worlds: &'a Worlds,
    flow: Flow,
    gain: f64,
    /// How far the calibration's log c and q are off.
    miscalibrated: (f64, f64),
    /// V_G, ml.
    pub goal_ml: f64,
    state: FlowState,
    poured_ml: f64,
    /// What a fused estimate takes `poured_ml` for.
    believed_ml: f64,
    summed_ml: f64,
    history: [f64; HISTORY],
    limiter: Limiter,
    hold: Hold,
    /// The last three measured outflows, newest first, ml a frame.
    pub v_ml: [f64; 3],
    rng: Pcg64Mcg,
}

impl ModelPour<'_> {
    /// One frame after the angle asked for (`None`: back); answers with the d that the policy sees, ml.
    pub fn frame(&mut self, dalpha_deg: Option<f64>) -> f64 {
        let alpha = f64::from(match dalpha_deg {
            Some(d) => self.limiter.step(self.limiter.alpha_deg() + d as f32),
            None if self.worlds.fused => self.limiter.step_upright(),
            None => self.limiter.step(self.limiter.alpha_deg() + BACK_DEG_PER_FRAME),
        });
        self.history.copy_within(1.., 0);
        self.history[HISTORY - 1] = alpha;
        self.state.a_deg = self.flow.tilt(self.state.a_deg, self.flow.delayed(&self.history, 0, 0.0));
        let v = self.flow.over(self.state.a_deg, self.state.x_ml, 0.0).v_ml;
        self.state.x_ml += v;
        let eta = self.flow.model.eta;
        let drip = DRIP * (self.state.film_ml + eta * v);
        self.state.film_ml += eta * v - drip;
        let out = (1.0 - eta) * v + drip;
        self.poured_ml += out;

        let noise: f64 = StandardNormal.sample(&mut self.rng);
        let dropped = self.rng.random_bool(self.worlds.dropouts);
        let noise_sd = self.worlds.nominal.noise.frame;
        let seen = out * self.gain * (noise_sd * noise).exp();
        let seen = if dropped || seen < self.worlds.nominal.noise.v_min_ml { 0.0 } else { seen };
        // Through the area and the hold, as at run time.
        let cal = &self.worlds.calibration;
        let at_1_px2 = f64::from(cal.volume_ml(1.0, alpha as f32));
        // The calibration is surest at the flows that the episodes showed; a law that pours at those meets its goal better.
        let log_area = (out.max(1e-6) / at_1_px2).ln() / f64::from(cal.q);
        self.believed_ml += out * (self.miscalibrated.0 + self.miscalibrated.1 * log_area).clamp(-0.7, 0.7).exp();
        let area = if seen > 0.0 { (seen / at_1_px2).powf(1.0 / f64::from(cal.q)) as f32 } else { 0.0 };
        let v = f64::from(cal.volume_ml(self.hold.step(Some(area), cal.hold_above_px2), alpha as f32));
        self.v_ml = [v, self.v_ml[0], self.v_ml[1]];
        self.summed_ml += v;
        if self.worlds.fused {
            let stop =
                if self.poured_ml > 0.0 { self.flow.stop_volume_ml(&self.state, &self.history, alpha, self.worlds.back) } else { 0.0 };
            self.goal_ml - self.believed_ml - stop
        } else {
            self.goal_ml - self.summed_ml
        }
    }

    /// Whether nothing flows and the container is on its way back.
    pub fn over(&self) -> bool {
        self.state.x_ml >= self.flow.capacity_ml(self.state.a_deg) && self.limiter.rate_deg_s() < 0.0
    }

    /// What will be on the scale minus what is to be there, ml.
    pub fn error_ml(&self) -> f64 {
        self.poured_ml + self.state.film_ml - self.goal_ml
    }
}

/// Cost of one pour under a law: error and time.
fn cost(worlds: &Worlds, law: &Law, seed: u64) -> f64 {
    let mut pour = worlds.pour(seed);
    let mut back = false;
    let mut d_ml = pour.goal_ml;
    for frame in 0..MAX_FRAMES {
        let asked = if back { None } else { law.decide(pour.v_ml, d_ml) };
        back |= asked.is_none();
        d_ml = pour.frame(asked);
        if back && pour.over() {
            let e = pour.error_ml().abs();
            return e + 0.02 * e.min(30.0).powi(2) + 0.005 * frame as f64;
        }
    }
    let e = pour.error_ml().abs();
    e + 0.02 * e.min(30.0).powi(2) + 0.005 * MAX_FRAMES as f64 + 5.0
}

/// Size of the search.
#[derive(Debug, Clone, Copy)]
pub struct Search {
    /// Laws tried in an iteration.
    pub population: usize,
    /// Pours of each.
    pub pours: usize,
    /// Iterations.
    pub iterations: usize,
    /// Laws that the next iteration is drawn around.
    pub elites: usize,
}

/// The cross-entropy method over the law's log-parameters, around `start`; the best mean found, and the elites' cost after each iteration.
pub fn search(worlds: &Worlds, start: Law, size: Search, seed: u64, mut progress: impl FnMut(usize, f64)) -> (Law, Vec<f64>) {
    let mut rng = Pcg64Mcg::seed_from_u64(seed ^ 0x1a77);
    let mut mean = start.logs();
    // What a PD does not have stays where it is.
    let free = mean.map(|l| l > -10.0 && l < 4.0);
    let mut sd = free.map(|f| if f { 0.4f64 } else { 0.0 });
    let mut curve = Vec::new();
    for iteration in 0..size.iterations {
        let mut laws: Vec<[f64; PARAMETERS]> = vec![mean];
        while laws.len() < size.population {
            let mut l = mean;
            for (l, sd) in l.iter_mut().zip(&sd) {
                let z: f64 = StandardNormal.sample(&mut rng);
                *l += sd * z;
            }
            laws.push(l);
        }
        let base = seed.wrapping_mul(1_000_003).wrapping_add((iteration * size.pours) as u64);
        let costs: Vec<f64> = laws
            .par_iter()
            .map(|l| {
                let law = Law::from_logs(l);
                (0..size.pours).map(|k| cost(worlds, &law, base.wrapping_add(k as u64))).sum::<f64>() / size.pours as f64
            })
            .collect();
        let mut order: Vec<usize> = (0..laws.len()).collect();
        order.sort_by(|a, b| costs[*a].total_cmp(&costs[*b]));
        let elites = &order[..size.elites.min(order.len())];
        for k in 0..PARAMETERS {
            let values: Vec<f64> = elites.iter().map(|e| laws[*e][k]).collect();
            let new_mean = values.iter().sum::<f64>() / values.len() as f64;
            let var = values.iter().map(|v| (v - new_mean).powi(2)).sum::<f64>() / values.len() as f64;
            mean[k] = new_mean;
            sd[k] = if free[k] { (0.3 * sd[k] + 0.7 * var.sqrt()).max(0.03) } else { 0.0 };
        }
        let best = elites.iter().map(|e| costs[*e]).sum::<f64>() / elites.len() as f64;
        curve.push(best);
        progress(iteration, best);
    }
    (Law::from_logs(&mean), curve)
}
