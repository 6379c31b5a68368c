//! Fits the [flow model](shared::estimate::flow) to weighed episodes: Levenberg-Marquardt on frames and weights.
//!
//! Offline, pure, allocates; deterministic on any number of threads (episodes are worked on in parallel, summed in order).
//!
//! Unknowns: the model's parameters and the calibration (c, q) for all episodes; for each episode the angle at which flow
//! starts, the flow coefficient lambda (viscosity) and the camera gain gamma. Residuals: frame by frame
//! `ln((c area^q + f)/(out e^gamma + f))/(rel q)`, once per episode `(sum out - w_E)/0.6 g`, and the priors. The logarithm
//! keeps c from gaining by being large; the division by q makes it the area that is noisy, or else q would gain by being
//! small. f is a small share of the strongest flow.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use shared::estimate::flow::{DELAY_MAX, DRIP, Flow, FlowModel, FlowNoise, HISTORY, KNOTS, KNOTS_DEG};
use shared::estimate::{Calibration, Hold, tilt_z};

use crate::calibrate;
use crate::data::TrainingEpisode;

/// Global unknowns: s (one a knot), log R, log H/R, taper, flat, lk, p, k1, k2, tau, delay, eta, log c, q, tilt.
const GLOBAL: usize = KNOTS + 14;
const LOG_R: usize = KNOTS;
const LOG_SLIM: usize = KNOTS + 1;
const TAPER: usize = KNOTS + 2;
const FLAT: usize = KNOTS + 3;
const LK: usize = KNOTS + 4;
const P: usize = KNOTS + 5;
const K1: usize = KNOTS + 6;
const K2: usize = KNOTS + 7;
const TAU: usize = KNOTS + 8;
const DELAY: usize = KNOTS + 9;
const ETA: usize = KNOTS + 10;
const LOG_C: usize = KNOTS + 11;
const Q: usize = KNOTS + 12;
const TILT: usize = KNOTS + 13;
/// Global unknowns that make the geometry.
const GEOMETRY: usize = KNOTS + 4;
/// Unknowns of an episode: onset angle, lambda, gamma, delay above the model's.
const LOCAL: usize = 4;
/// Which of them the delay is.
const LATE: usize = 3;
/// Weight of a scale that shows whole grams, and of the person reading it, g.
const WEIGHT_SD_G: f64 = 0.6;
/// A calibration v = c area that meets the weights this well (rms, g) is right: the scale cannot tell it from a perfect one.
const LINEAR_G: f64 = 1.0;
/// Noise of an episode's sum of areas over that of one frame, for some fifty frames of flow.
const SUM_NOISE: f64 = 0.15;
/// How much a camera's gain is expected to change from pour to pour (log), and a perfect one's.
const GAIN_EXPECTED: f64 = 0.017;
const GAIN_LINEAR: f64 = 0.002;
/// The same in the fit, in its wide and its narrow stage; and where the frames show no noise: a camera that does not waver within
/// a pour hardly does between two.
const GAIN_WIDE: f64 = 0.02;
const GAIN_NARROW: f64 = 0.03;
const GAIN_CLEAN: f64 = 0.004;
/// How much a camera's gain changes from pour to pour at least (log).
const GAIN_SD: f64 = 0.012;
/// Episodes before and after a change of gain or delay, for it to be noticed.
const CHANGE_NEEDS: usize = 3;
/// How far the delays of two episodes are apart (frames): as a rule; when a change is looked for; and after one was found.
const LATE_KNOWN: f64 = 0.02;
const LATE_FREE: f64 = 1.0;
const LATE_CHANGED: f64 = 0.3;
/// How much an episode's delay scatters at least when it is looked for, frames.
const LATE_SD: f64 = 0.2;
/// Below this many episodes the filter's sds are mostly those of the priors, and half of them pours best on other rigs.
const PRIORS_BELOW: usize = 4;
/// Noise of a frame's area below which a model can turn out to be exact.
const CLEAN: f64 = 0.03;
/// Residuals beyond this grow only with the root.
const HUBER: f64 = 3.0;

/// What was found.
#[derive(Debug, Clone)]
pub struct Fit {
    /// The model, with the uncertainties that the filter needs.
    pub model: FlowModel,
    /// Calibration found together with it.
    pub calibration: Calibration,
    /// Of each episode: onset angle in degrees, lambda, gamma, delay above the model's in frames.
    pub episodes: Vec<[f64; LOCAL]>,
    /// Covariance of the global unknowns.
    pub covariance: DMatrix<f64>,
    /// Covariance of the calibration's log c and q.
    pub calibration_covariance: [[f64; 2]; 2],
    /// Share of zeros within the flow.
    pub dropouts: f64,
}

/// One episode made ready: areas, their largest mean over five frames, masks.
struct Prepared {
    alpha: Vec<f64>,
    tilt_z: Vec<f64>,
    area: Vec<f64>,
    /// Areas with the dropout hold, as they are summed: those above 0, with their z.
    held: Vec<(f64, f64)>,
    smooth_max: f64,
    used: Vec<bool>,
    weight_g: f64,
    first: usize,
    /// Delay above the others', as far as known, frames.
    late: f64,
}

#[derive(Clone, Copy)]
struct Stage {
    /// Noise of a frame's area, relative; and what is added to flows before their logarithm is taken, over the strongest.
    rel: f64,
    floor: f64,
    gamma_sd: f64,
    /// How far an episode's delay is from what is known of it, frames.
    late_sd: f64,
    /// Noise of an episode's sum of areas, relative.
    sum_sd: f64,
    /// Calibration held at (log c, q, tilt) with this sd.
    held: Option<([f64; 3], f64)>,
}

impl Prepared {
    fn new(e: &TrainingEpisode) -> Self {
        let n = e.len();
        let area = e.area_px2.clone();
        let seen = |k: usize| area[k] > 0.0;
        let mut used = vec![true; n];
        let mut filled = area.clone();
        for k in 0..n {
            let before = (k.saturating_sub(3)..k).any(seen);
            let after = (k + 1..(k + 4).min(n)).any(seen);
            if area[k].is_nan() || (area[k] == 0.0 && before && after) {
                used[k] = false;
                // For the profile only: the neighbours' mean.
                let near: Vec<f64> = (k.saturating_sub(3)..(k + 4).min(n)).filter(|j| seen(*j)).map(|j| area[j]).collect();
                filled[k] = if near.is_empty() { 0.0 } else { near.iter().sum::<f64>() / near.len() as f64 };
            }
        }
        let mean_of_five = |k: usize| {
            let (from, to) = (k.saturating_sub(2), (k + 3).min(n));
            filled[from..to].iter().sum::<f64>() / (to - from) as f64
        };
        let smooth_max = (0..n).map(mean_of_five).fold(1e-9, f64::max);
        let first = (0..n).find(|k| seen(*k)).unwrap_or(0);
        let tilt_z_of: Vec<f64> = e.alpha_deg.iter().map(|a| tilt_z(*a)).collect();
        let mut hold = Hold::default();
        let held = e
            .area_px2
            .iter()
            .zip(&e.alpha_deg)
            .map(|(a, alpha)| (f64::from(hold.step(Some(*a as f32), calibrate::HOLD_ABOVE_PX2)), tilt_z(*alpha)))
            .filter(|(a, _)| *a > 0.0)
            .collect();
        Self { alpha: e.alpha_deg.clone(), held, tilt_z: tilt_z_of, area, smooth_max, used, weight_g: e.weight_g, first, late: 0.0 }
    }

    /// What the model says left the lip in each frame, and the film after it, ml.
    fn outflow<'a>(&'a self, flow: &'a Flow, onset: f64, lambda: f64, late: f64) -> impl Iterator<Item = (f64, f64)> + 'a {
        let mut x = flow.capacity_ml(onset.clamp(0.0, 115.0));
        let mut film = 0.0;
        let mut history = [self.alpha[0]; HISTORY];
        let mut a = self.alpha[0];
        let eta = flow.model.eta;
        self.alpha.iter().map(move |alpha| {
            history.copy_within(1.., 0);
            history[HISTORY - 1] = *alpha;
            a = flow.tilt(a, flow.delayed(&history, 0, late));
            let v = flow.over(a, x, lambda).v_ml;
            x += v;
            film += eta * v;
            let drip = DRIP * film;
            film -= drip;
            ((1.0 - eta) * v + drip, film)
        })
    }

    /// Residuals of this episode for a model; appends to `out`.
    fn residuals(&self, flow: &Flow, [log_c, q, tilt]: [f64; 3], local: &[f64; LOCAL], stage: &Stage, area_min: f64, out: &mut Vec<f64>) {
        let [onset, lambda, gamma, late] = *local;
        let (c, gain) = (log_c.exp(), gamma.exp());
        let v_min = c * area_min.powf(q);
        let floor = stage.floor * c * self.smooth_max.powf(q);
        let mut sum = 0.0;
        let mut film = 0.0;
        for (k, (leaves, left)) in self.outflow(flow, onset, lambda, late).enumerate() {
            sum += leaves;
            film = left;
            if !self.used[k] {
                continue;
            }
            let h = leaves * gain;
            let c_k = c * (tilt * self.tilt_z[k]).exp();
            // A zero says that no more than v_min flows.
            let y = if self.area[k] > 0.0 { c_k * self.area[k].powf(q) } else { h.min(v_min) };
            out.push(soft(((y + floor) / (h + floor)).ln() / (stage.rel * q)));
        }
        out.push((sum + film - self.weight_g) / WEIGHT_SD_G);
        let camera: f64 = self.held.iter().map(|(a, z)| c * (tilt * z).exp() * a.powf(q)).sum();
        out.push((camera / gain - self.weight_g) / WEIGHT_SD_G.hypot(stage.sum_sd * self.weight_g));
        out.push(lambda / 0.08);
        out.push(gamma / stage.gamma_sd);
        out.push((late - self.late) / stage.late_sd);
    }
}

/// A residual that counts with its root beyond [`HUBER`].
fn soft(r: f64) -> f64 {
    if r.abs() <= HUBER { r } else { r.signum() * (2.0 * HUBER * r.abs() - HUBER * HUBER).sqrt() }
}

fn model_of(g: &[f64]) -> FlowModel {
    let mut s = [0.0; KNOTS];
    s.copy_from_slice(&g[..KNOTS]);
    let radius_mm = g[LOG_R].clamp(1.0, 6.0).exp();
    FlowModel {
        radius_mm,
        height_mm: radius_mm * g[LOG_SLIM].clamp(-1.0, 3.0).exp(),
        taper: g[TAPER].clamp(0.2, 3.0),
        flat: g[FLAT].clamp(0.0, 1.0),
        s,
        lk: g[LK],
        p: g[P].clamp(0.3, 4.0),
        k1: g[K1],
        k2: g[K2],
        tau: g[TAU].clamp(0.0, 30.0),
        delay: g[DELAY].clamp(0.0, DELAY_MAX),
        eta: g[ETA].clamp(0.0, 0.6),
        noise: FlowNoise { lambda: 0.2, gamma: 0.02, beta: 0.01, delta: 0.5, frame: 0.1, v_min_ml: 0.0 },
    }
}

/// `model` with the global unknowns moved by `by` (as the covariance counts them).
pub fn moved(model: &FlowModel, by: &[f64]) -> FlowModel {
    let mut g = [0.0; GLOBAL];
    g[..KNOTS].copy_from_slice(&model.s);
    (g[LOG_R], g[LOG_SLIM], g[TAPER]) = (model.radius_mm.ln(), (model.height_mm / model.radius_mm).ln(), model.taper);
    g[FLAT] = model.flat;
    (g[LK], g[P], g[K1], g[K2]) = (model.lk, model.p, model.k1, model.k2);
    (g[TAU], g[DELAY], g[ETA]) = (model.tau, model.delay, model.eta);
    for (g, b) in g.iter_mut().zip(by) {
        *g += b;
    }
    FlowModel { noise: model.noise, ..model_of(&g) }
}

/// How far a vessel is from straight walls, at each knot (log).
const S_SD: [f64; KNOTS] = [0.06, 0.06, 0.06, 0.06, 0.06, 0.08, 0.18, 0.6, 0.6];

/// A residual that pays little more the further it goes (Cauchy).
fn far(r: f64) -> f64 {
    r.signum() * 2.0 * (1.0 + r * r / 4.0).ln().sqrt()
}

/// The priors. Vessels that a gripper holds: R about 37 mm, H about 3 R, nearly straight walls; what deviates from that in
/// shape pays little more the further it goes (Cauchy), so that bottles and jugs are not bent into cups. The flow follows a
/// weir: exponent 1.5, and a coefficient that hardly changes with the angle.
fn priors(g: &[f64], stage: &Stage) -> Vec<f64> {
    let mut r = Vec::with_capacity(40);
    for k in 0..KNOTS {
        r.push(far(g[k] / S_SD[k]));
    }
    // The slope of s changes little from knot to knot.
    let slope = |k: usize| (g[k + 1] - g[k]) / (KNOTS_DEG[k + 1] - KNOTS_DEG[k]) * 10.0;
    for k in 1..KNOTS - 2 {
        r.push(far((slope(k) - slope(k - 1)) / 0.15));
    }
    r.push((g[LOG_R] - 37f64.ln()) / 0.25);
    r.push((g[LOG_SLIM] - 3f64.ln()) / 0.3);
    r.push((g[TAPER] - 1.0) / 0.15);
    r.push(far(g[FLAT] / 0.05));
    r.push(g[TILT] / 0.03);
    r.push(far((g[P] - 1.5) / 0.1));
    r.push((g[LK] + 3.2) / 1.5);
    r.push(far(g[K1] / 0.15));
    r.push(far(g[K2] / 0.1));
    r.push((g[TAU] - 2.0) / 0.8);
    r.push((g[DELAY] - 2.0) / 1.2);
    r.push((g[ETA] - 0.1) / 0.1);
    match stage.held {
        None => r.push((g[Q] - 1.15) / 0.2),
        Some(([log_c, q, tilt], sd)) => {
            r.push((g[LOG_C] - log_c) / sd);
            r.push((g[Q] - q) / sd);
            r.push((g[TILT] - tilt) / sd);
        }
    }
    r
}

struct Problem<'a> {
    episodes: &'a [Prepared],
    area_min: f64,
    stage: Stage,
}

#[derive(Clone)]
struct Unknowns {
    global: [f64; GLOBAL],
    local: Vec<[f64; LOCAL]>,
}

struct Linear {
    a: DMatrix<f64>,
    b: DVector<f64>,
}

impl Problem<'_> {
    fn episode_residuals(&self, k: usize, flow: &Flow, global: &[f64], local: &[f64; LOCAL]) -> Vec<f64> {
        let mut out = Vec::with_capacity(self.episodes[k].area.len() + 4);
        self.episodes[k].residuals(flow, [global[LOG_C], global[Q], global[TILT]], local, &self.stage, self.area_min, &mut out);
        out
    }

    fn cost(&self, u: &Unknowns) -> f64 {
        let flow = Flow::new(&model_of(&u.global));
        let square = |r: Vec<f64>| r.iter().map(|v| v * v).sum::<f64>();
        let parts: Vec<f64> =
            (0..self.episodes.len()).into_par_iter().map(|k| square(self.episode_residuals(k, &flow, &u.global, &u.local[k]))).collect();
        let total = square(priors(&u.global, &self.stage)) + parts.iter().sum::<f64>();
        if total.is_finite() { total } else { f64::INFINITY }
    }

    fn linearise(&self, u: &Unknowns) -> Linear {
        let n = GLOBAL + LOCAL * self.episodes.len();
        let step = |k: usize| if k == Q || k == LOG_C { 1e-5 } else { 1e-4 };
        let nudged: Vec<([f64; GLOBAL], Flow)> = (0..GLOBAL)
            .map(|k| {
                let mut g = u.global;
                g[k] += step(k);
                (g, Flow::new(&model_of(&g)))
            })
            .collect();
        let flow = Flow::new(&model_of(&u.global));
        let blocks: Vec<(DMatrix<f64>, DVector<f64>)> = (0..self.episodes.len())
            .into_par_iter()
            .map(|e| {
                let base = self.episode_residuals(e, &flow, &u.global, &u.local[e]);
                let mut j = DMatrix::zeros(base.len(), GLOBAL + LOCAL);
                let mut set = |column: usize, moved: Vec<f64>, h: f64| {
                    for (row, (m, b)) in moved.iter().zip(&base).enumerate() {
                        j[(row, column)] = (m - b) / h;
                    }
                };
                for (k, (g, f)) in nudged.iter().enumerate() {
                    set(k, self.episode_residuals(e, f, g, &u.local[e]), step(k));
                }
                for k in 0..LOCAL {
                    let mut local = u.local[e];
                    local[k] += 1e-4;
                    set(GLOBAL + k, self.episode_residuals(e, &flow, &u.global, &local), 1e-4);
                }
                (j.tr_mul(&j), j.tr_mul(&DVector::from_vec(base)))
            })
            .collect();
        let mut a = DMatrix::zeros(n, n);
        let mut b = DVector::zeros(n);
        for (e, (jj, jr)) in blocks.iter().enumerate() {
            let index = |k: usize| if k < GLOBAL { k } else { GLOBAL + LOCAL * e + k - GLOBAL };
            for r in 0..GLOBAL + LOCAL {
                b[index(r)] += jr[r];
                for c in 0..GLOBAL + LOCAL {
                    a[(index(r), index(c))] += jj[(r, c)];
                }
            }
        }
        let base = priors(&u.global, &self.stage);
        let mut j = DMatrix::zeros(base.len(), GLOBAL);
        for k in 0..GLOBAL {
            let mut g = u.global;
            g[k] += 1e-4;
            for (row, (m, r)) in priors(&g, &self.stage).iter().zip(&base).enumerate() {
                j[(row, k)] = (m - r) / 1e-4;
            }
        }
        let (jj, jr) = (j.tr_mul(&j), j.tr_mul(&DVector::from_vec(base)));
        for r in 0..GLOBAL {
            b[r] += jr[r];
            for c in 0..GLOBAL {
                a[(r, c)] += jj[(r, c)];
            }
        }
        Linear { a, b }
    }

    /// Levenberg-Marquardt from `u`, until a step gains less than `tolerance` of the cost; the cost reached.
    fn solve(&self, u: &mut Unknowns, iterations: usize, tolerance: f64) -> f64 {
        let mut cost = self.cost(u);
        let mut damping = 1e-2;
        for _ in 0..iterations {
            let Linear { a, b } = self.linearise(u);
            let before = cost;
            for _ in 0..8 {
                let mut damped = a.clone();
                for k in 0..damped.nrows() {
                    damped[(k, k)] += damping * a[(k, k)].max(1e-9);
                }
                let Some(cholesky) = damped.cholesky() else {
                    damping *= 10.0;
                    continue;
                };
                let step = cholesky.solve(&b);
                let mut next = u.clone();
                for (k, g) in next.global.iter_mut().enumerate() {
                    *g -= step[k];
                }
                for (e, local) in next.local.iter_mut().enumerate() {
                    for (k, l) in local.iter_mut().enumerate() {
                        *l -= step[GLOBAL + LOCAL * e + k].clamp(-8.0, 8.0);
                    }
                }
                let model = model_of(&next.global);
                next.global[FLAT] = model.flat;
                (next.global[P], next.global[TAU], next.global[DELAY], next.global[ETA]) = (model.p, model.tau, model.delay, model.eta);
                let new = self.cost(&next);
                if new < cost {
                    *u = next;
                    cost = new;
                    damping = (damping * 0.3).max(1e-7);
                    break;
                }
                damping *= 5.0;
            }
            if before - cost < tolerance * before.max(1.0) {
                break;
            }
        }
        cost
    }
}

/// Fits model and calibration to `episodes`, all of which are usable.
pub fn fit(episodes: &[TrainingEpisode]) -> Fit {
    let mut prepared: Vec<Prepared> = episodes.iter().map(Prepared::new).collect();
    let area_min = prepared.iter().flat_map(|p| &p.area).copied().filter(|a| *a > 0.0).fold(f64::INFINITY, f64::min);
    let area_min = if area_min.is_finite() { area_min } else { 1.0 };
    let q0 = 1.15;

    // A cup or something else, a thin or a thick stream: the best of these beginnings is followed.
    let start = |lk: f64, q: f64, flat: f64| {
        let mut global = [0.0; GLOBAL];
        (global[LOG_R], global[LOG_SLIM], global[TAPER], global[FLAT]) = (37f64.ln(), 3f64.ln(), 1.0, flat);
        (global[LK], global[P], global[TAU], global[DELAY], global[ETA]) = (lk, 1.5, 2.0, 2.0, 0.05);
        (global[LOG_C], global[Q]) = (f64::from(calibrate::fit(episodes, Some(q)).c).ln(), q);
        let flow = Flow::new(&model_of(&global));
        let local = prepared.iter().map(|p| [onset_guess(&flow, p), 0.0, 0.0, 0.0]).collect();
        Unknowns { global, local }
    };
    let (frame_sd, dropouts) = frame_noise(&prepared);
    let temper = |times: f64, most: f64| (times * frame_sd).clamp(0.02 * times, most);
    // Without noise the valleys are narrow: more beginnings, and a longer way.
    let clean = frame_sd < CLEAN;
    let longer = if clean { 3 } else { 1 };
    let gain = |usual: f64| if clean { GAIN_CLEAN } else { usual };
    let linear = linear(episodes).filter(|_| clean).map(|log_c| ([log_c, 1.0, 0.0], 0.002));
    let sum_sd = SUM_NOISE * frame_sd.max(if clean { 0.0 } else { 0.015 });
    let mut wide = Stage { rel: temper(3.0, 1.0), floor: 0.036, gamma_sd: gain(GAIN_WIDE), late_sd: LATE_KNOWN, sum_sd, held: linear };
    let problem = Problem { episodes: &prepared, area_min, stage: wide };
    let mut best: Option<(f64, Unknowns)> = None;
    let beginnings = [(1.15, 0.0), (1.15, 0.7), (1.0, 0.7), (1.0, 0.0), (1.3, 0.0), (1.3, 0.7)];
    for (q, flat) in beginnings.into_iter().take(3 * longer) {
        for lk in [-3.2, -2.2] {
            let mut u = start(lk, q, flat);
            let cost = problem.solve(&mut u, 12, 1e-3);
            if best.as_ref().is_none_or(|(c, _)| cost < *c) {
                best = Some((cost, u));
            }
        }
    }
    let mut u = best.map_or_else(|| start(-3.2, q0, 0.0), |(_, u)| u);
    if let Some(late) = changed_delay(&problem, &u) {
        prepared.iter_mut().zip(&late).for_each(|(p, late)| p.late = *late);
        u.local.iter_mut().zip(&late).for_each(|(l, late)| l[LATE] = *late);
        wide.late_sd = LATE_CHANGED;
    }
    let problem = Problem { episodes: &prepared, area_min, stage: wide };
    problem.solve(&mut u, 25 * longer, 1e-4);
    let wide_covariance = invert(&problem.linearise(&u).a);

    let held = Some(([u.global[LOG_C], u.global[Q], u.global[TILT]], 0.002));
    let narrow = Problem { stage: Stage { rel: temper(1.5, 0.15), floor: 0.036, gamma_sd: gain(GAIN_NARROW), held, ..wide }, ..problem };
    narrow.solve(&mut u, 30 * longer, 1e-4);
    let covariance = invert(&narrow.linearise(&u).a);

    let gammas: Vec<f64> = u.local.iter().map(|l| l[2]).collect();
    let (log_c, q) = (u.global[LOG_C] - newest(&gammas, GAIN_SD), u.global[Q]);
    let mut model = model_of(&u.global);
    let late: Vec<f64> = u.local.iter().map(|l| l[LATE]).collect();
    model.delay = (model.delay + newest(&late, LATE_SD)).clamp(0.0, DELAY_MAX);
    // sd of log v at 300 px^2 from the wide stage: log v = log c + q log 300.
    let l = 300f64.ln();
    let log_v_var = wide_covariance[(LOG_C, LOG_C)] + 2.0 * l * wide_covariance[(LOG_C, Q)] + l * l * wide_covariance[(Q, Q)];
    let share = if episodes.len() < PRIORS_BELOW { 0.5 } else { 1.0 };
    model.noise = FlowNoise {
        lambda: 0.15,
        gamma: (1.6
            * (gain_sd(&gammas, if linear.is_some() { GAIN_LINEAR } else { GAIN_EXPECTED }) * q / 1.15)
                .hypot(0.5 * share * log_v_var.max(0.0).sqrt()))
        .min(0.5),
        beta: share * trusted(0.007f64.hypot(geometry_variance(&u, &covariance).sqrt())),
        delta: 0.3,
        frame: (frame_sd * q).clamp(0.02, 1.0),
        v_min_ml: log_c.exp() * area_min.powf(q),
    };
    Fit {
        model,
        calibration: Calibration {
            c: log_c.exp() as f32,
            q: q as f32,
            tilt: u.global[TILT] as f32,
            hold_above_px2: calibrate::HOLD_ABOVE_PX2,
        },
        episodes: u.local,
        covariance: covariance.view((0, 0), (GLOBAL, GLOBAL)).into_owned(),
        calibration_covariance: [LOG_C, Q].map(|i| [LOG_C, Q].map(|j| wide_covariance[(i, j)])),
        dropouts,
    }
}

/// Each episode's delay above the model's, if it has changed on the way (as [`newest`] judges).
fn changed_delay(problem: &Problem<'_>, u: &Unknowns) -> Option<Vec<f64>> {
    if u.local.len() < 2 * CHANGE_NEEDS {
        return None;
    }
    let mut free = u.clone();
    let stage = Stage { late_sd: LATE_FREE, ..problem.stage };
    Problem { stage, ..*problem }.solve(&mut free, 12, 1e-3);
    let late: Vec<f64> = free.local.iter().map(|l| l[LATE]).collect();
    (newest(&late, LATE_SD) != 0.0).then_some(late)
}

/// log c of the paper's own calibration, if it meets the weights as well as they can be read.
fn linear(episodes: &[TrainingEpisode]) -> Option<f64> {
    let sums: Vec<(f64, f64)> = episodes.iter().map(|e| (e.weight_g, calibrate::area_sum(e, 1.0))).collect();
    let c = sums.iter().map(|(w, sum)| w * sum).sum::<f64>() / sums.iter().map(|(_, sum)| sum * sum).sum::<f64>();
    let squares: f64 = sums.iter().map(|(w, sum)| (w - c * sum).powi(2)).sum();
    let met = squares < LINEAR_G * LINEAR_G * episodes.len() as f64;
    (met && episodes.len() >= calibrate::EXPONENT_NEEDS).then(|| c.ln())
}

/// The sd of the geometry's scale that the filter gets. The narrow stage tempers the frames' residuals, so its covariance is
/// too wide where the frames decide, and a third of it pours best on other rigs; where little was poured the priors decide,
/// and nothing may be taken off.
fn trusted(sd: f64) -> f64 {
    (0.34 * sd * (sd / 0.05).max(1.0)).min(0.5)
}

/// How much the camera's gain changes from pour to pour: what is expected counts as three episodes beside those fitted.
fn gain_sd(gammas: &[f64], expected: f64) -> f64 {
    let sum: f64 = gammas.iter().map(|g| g * g).sum();
    ((3.0 * expected * expected + sum) / (3.0 + gammas.len() as f64)).sqrt()
}

/// Mean of the newest episodes' values if they have changed since the ones before (beyond 3.5 standard errors,
/// [`CHANGE_NEEDS`] episodes at least on either side, scatter `sd_min` at least), else 0. Episodes are in the order in which
/// they were poured.
fn newest(values: &[f64], sd_min: f64) -> f64 {
    let n = values.len();
    let mut found = (3.5, 0.0);
    for k in CHANGE_NEEDS..(n + 1).saturating_sub(CHANGE_NEEDS) {
        let (before, after) = values.split_at(k);
        let mean = |g: &[f64]| g.iter().sum::<f64>() / g.len() as f64;
        let spread = |g: &[f64]| g.iter().map(|x| (x - mean(g)).powi(2)).sum::<f64>();
        let sd = ((spread(before) + spread(after)) / (n - 2) as f64).sqrt().max(sd_min);
        let z = (mean(after) - mean(before)).abs() / (sd * (1.0 / before.len() as f64 + 1.0 / after.len() as f64).sqrt());
        if z > found.0 {
            found = (z, mean(after));
        }
    }
    found.1
}

/// The tilt at the first sight of flow, a little back.
fn onset_guess(flow: &Flow, p: &Prepared) -> f64 {
    let mut history = [p.alpha[0]; HISTORY];
    let mut a = p.alpha[0];
    for alpha in &p.alpha[..=p.first] {
        history.copy_within(1.., 0);
        history[HISTORY - 1] = *alpha;
        a = flow.tilt(a, flow.delayed(&history, 0, 0.0));
    }
    a - 1.0
}

fn invert(a: &DMatrix<f64>) -> DMatrix<f64> {
    let mut damped = a.clone();
    for k in 0..damped.nrows() {
        damped[(k, k)] += 1e-9;
    }
    damped.cholesky().map_or_else(|| DMatrix::identity(a.nrows(), a.ncols()) * 0.01, |c| c.inverse())
}

/// Posterior variance of log dW, averaged over five windows from the lowest onset to the highest + 12 degrees.
fn geometry_variance(u: &Unknowns, covariance: &DMatrix<f64>) -> f64 {
    let low = u.local.iter().map(|l| l[0]).fold(f64::INFINITY, f64::min).clamp(0.0, 110.0);
    let high = u.local.iter().map(|l| l[0]).fold(f64::NEG_INFINITY, f64::max).clamp(0.0, 110.0) + 12.0;
    let edges: Vec<f64> = (0..=5).map(|k| low + (high - low) * f64::from(k) / 5.0).collect();
    let log_windows = |g: &[f64]| -> Vec<f64> {
        let flow = Flow::new(&model_of(g));
        edges.windows(2).map(|e| (flow.capacity_ml(e[1]) - flow.capacity_ml(e[0])).max(1e-6).ln()).collect()
    };
    let base = log_windows(&u.global);
    let gradients: Vec<Vec<f64>> = (0..GEOMETRY)
        .map(|k| {
            let mut g = u.global;
            g[k] += 1e-4;
            log_windows(&g).iter().zip(&base).map(|(a, b)| (a - b) / 1e-4).collect()
        })
        .collect();
    let variance = |w: usize| -> f64 {
        (0..GEOMETRY).map(|i| (0..GEOMETRY).map(|j| gradients[i][w] * covariance[(i, j)] * gradients[j][w]).sum::<f64>()).sum()
    };
    (0..5).map(variance).sum::<f64>() / 5.0
}

/// Relative noise of a frame's area from second differences of its logarithm, and the share of zeros within the flow.
fn frame_noise(prepared: &[Prepared]) -> (f64, f64) {
    let mut squares = Vec::new();
    let (mut zeros, mut within) = (0.0, 0.0);
    for p in prepared {
        for k in 1..p.area.len() - 1 {
            let three = &p.area[k - 1..=k + 1];
            if three[0] > 0.0 && three[2] > 0.0 {
                within += 1.0;
                zeros += f64::from(three[1] == 0.0);
            }
            if three.iter().all(|a| *a > 0.2 * p.smooth_max) {
                squares.push((three[0].ln() - 2.0 * three[1].ln() + three[2].ln()).powi(2) / 6.0);
            }
        }
    }
    // Robust: the median of a squared normal is 0.455 of its variance.
    squares.sort_by(f64::total_cmp);
    let variance = squares.get(squares.len() / 2).copied().unwrap_or(0.01) / 0.455;
    (variance.sqrt(), if within > 0.0 { zeros / within } else { 0.0 })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects learning after somebody touched the camera: a changed gain is noticed, scatter and too few episodes are not.
    #[test]
    fn a_changed_gain_is_noticed() {
        let scatter = [0.01, -0.012, 0.004, -0.008, 0.011, -0.003, 0.006];
        let changed =
            |from: usize, by: f64| -> Vec<f64> { scatter.iter().enumerate().map(|(k, g)| g + if k >= from { by } else { 0.0 }).collect() };
        assert_eq!(newest(&scatter, GAIN_SD), 0.0);
        assert!((newest(&changed(4, 0.06), GAIN_SD) - 0.06).abs() < 0.01);
        assert!((newest(&changed(3, -0.06), GAIN_SD) + 0.06).abs() < 0.01);
        assert_eq!(newest(&changed(5, 0.06), GAIN_SD), 0.0, "two episodes say nothing");
        assert_eq!(newest(&changed(4, 0.02), GAIN_SD), 0.0, "within the scatter");
    }

    /// Protects the paper's own calibration where it is right: areas in proportion to the weights give its c, others none.
    #[test]
    fn a_linear_camera_is_recognised() {
        let weighed = |weights: &[(f64, f64)]| -> Vec<TrainingEpisode> {
            let one = |(area, weight_g): &(f64, f64)| {
                let mut e = TrainingEpisode::empty("x", 30.0);
                (0..40).for_each(|k| e.push(f64::from(k) / 30.0, 50.0, f64::NAN, if k > 5 { *area } else { 0.0 }));
                e.weight_g = *weight_g;
                e
            };
            weights.iter().map(one).collect()
        };
        // 34 frames of flow at 400 px^2 a ml.
        let found = linear(&weighed(&[(400.0, 34.0), (800.0, 68.4), (1200.0, 101.7), (1600.0, 136.0)]));
        assert!((found.unwrap() - (1.0f64 / 400.0).ln()).abs() < 5e-3);
        assert_eq!(linear(&weighed(&[(400.0, 34.0), (800.0, 74.0), (1200.0, 101.7), (1600.0, 136.0)])), None);
        assert_eq!(linear(&weighed(&[(400.0, 34.0), (800.0, 68.0), (1200.0, 102.0)])), None, "too few");
    }
}
