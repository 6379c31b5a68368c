//! A control law with a few parameters, and its search by the cross-entropy method in pours of the fitted model.
//!
//! Pure functions of the offline trainer, which allocate and do not fail. The result is the same on any number of threads, because each
//! pour has its own seed and sums are taken in order.
//!
//! ```text
//! vbar   = (v0 + s (v1 + v2)) / (1 + 2 s)                     the last three outflows, v0 the newest
//! d'     = d - d0 - kf vbar
//! v*     = clip(c d', 0, vmax)                                wanted outflow
//! dalpha = clip(K (v* - vbar - kd (v0 - v2)/2), -3, um);  while nothing flows: clip(K v*, 0.2, u0);  d' <= 0: back
//! ```
//!
//! | symbol | name |
//! |---|---|
//! | c | [`ControlLaw::approach_per_frame`] |
//! | d0 | [`ControlLaw::early_ml`] |
//! | vmax | [`ControlLaw::max_flow_ml`] |
//! | kd | [`ControlLaw::damping_frames`] |
//! | K | [`ControlLaw::gain_deg_per_ml`] |
//! | um, u0 | [`ControlLaw::max_forward_deg`], [`ControlLaw::max_forward_dry_deg`] |
//! | s | [`ControlLaw::smoothing`] |
//! | kf | [`ControlLaw::in_flight_frames`] |

use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;

use super::model_pour::{MAX_FRAMES, PossiblePours};

/// Slowest forward tilt while nothing flows and volume is missing, degrees a frame: it must be an action that the network has.
const CREEP_DEG: f64 = 0.2;
/// Fastest tilt back while volume is missing, degrees a frame. From the prototype's law; no other measurement is recorded.
const MAX_BACKWARD_DEG: f64 = 3.0;
/// Largest outflow that a searched law may want, ml a frame. Chosen by hand; no measurement is recorded.
const MAX_FLOW_ML: f64 = 1.6;
/// A largest outflow of this or more means that the outflow has no bound, as in a PD, ml a frame.
const NO_MAX_FLOW_ML: f64 = 100.0;
/// Fastest forward tilt that a searched law may have, degrees a frame. Chosen by hand; no measurement is recorded.
const MAX_FORWARD_DEG: f64 = 3.0;

/// The law's parameters.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct ControlLaw {
    /// Wanted outflow for each ml that is missing, 1/frame.
    pub approach_per_frame: f64,
    /// The pour is stopped this much early, ml.
    pub early_ml: f64,
    /// Largest wanted outflow, ml a frame.
    pub max_flow_ml: f64,
    /// Damping, frames.
    pub damping_frames: f64,
    /// Gain, degrees for each ml a frame.
    pub gain_deg_per_ml: f64,
    /// Fastest forward tilt while liquid flows, degrees a frame.
    pub max_forward_deg: f64,
    /// Weight of the two older outflows in the smoothed one.
    pub smoothing: f64,
    /// Volume in flight, as frames of the smoothed outflow.
    pub in_flight_frames: f64,
    /// Fastest forward tilt while nothing flows, degrees a frame.
    pub max_forward_dry_deg: f64,
}

/// Number of parameters of a [`ControlLaw`].
const LAW_PARAMETERS: usize = 9;

impl ControlLaw {
    /// Where the search starts: the values of the prototype's recipe. With the fused estimate, the volume in flight is already taken off d.
    pub fn start(fused: bool) -> Self {
        let (early_ml, in_flight_frames) = if fused { (0.05, 0.02) } else { (0.5, 3.0) };
        Self {
            approach_per_frame: 0.03,
            early_ml,
            max_flow_ml: 1.0,
            damping_frames: 2.0,
            gain_deg_per_ml: 1.0,
            max_forward_deg: 0.5,
            smoothing: 0.5,
            in_flight_frames,
            max_forward_dry_deg: 0.7,
        }
    }

    /// Where the search of a PD on d starts: the law without damping, smoothing and volume in flight, dalpha = K c d - K v.
    pub fn start_pd(fused: bool) -> Self {
        Self { max_flow_ml: 1e3, damping_frames: 1e-6, smoothing: 1e-6, in_flight_frames: 1e-6, ..Self::start(fused) }
    }

    /// The law that wants `pace` times the outflow of this one, everywhere.
    #[must_use]
    pub fn at_pace(self, pace: f64) -> Self {
        Self { approach_per_frame: pace * self.approach_per_frame, max_flow_ml: pace * self.max_flow_ml, ..self }
    }

    /// The parameters' logarithms, in the order of the fields.
    fn logs(&self) -> [f64; LAW_PARAMETERS] {
        [
            self.approach_per_frame,
            self.early_ml,
            self.max_flow_ml,
            self.damping_frames,
            self.gain_deg_per_ml,
            self.max_forward_deg,
            self.smoothing,
            self.in_flight_frames,
            self.max_forward_dry_deg,
        ]
        .map(f64::ln)
    }

    /// The law with these logarithms, its bounds kept.
    fn from_logs(logs: &[f64; LAW_PARAMETERS]) -> Self {
        let [
            approach_per_frame,
            early_ml,
            max_flow_ml,
            damping_frames,
            gain_deg_per_ml,
            max_forward_deg,
            smoothing,
            in_flight_frames,
            max_forward_dry_deg,
        ] = logs.map(f64::exp);
        Self {
            approach_per_frame,
            early_ml,
            max_flow_ml: if max_flow_ml < NO_MAX_FLOW_ML { max_flow_ml.min(MAX_FLOW_ML) } else { max_flow_ml },
            damping_frames,
            gain_deg_per_ml,
            max_forward_deg: max_forward_deg.min(MAX_FORWARD_DEG),
            smoothing,
            in_flight_frames,
            max_forward_dry_deg: max_forward_dry_deg.min(MAX_FORWARD_DEG),
        }
    }

    /// The relative angle that the law asks for, degrees; `None` means back. `v_ml` are the last three outflows in ml a frame, the newest
    /// first.
    pub fn decide(&self, v_ml: [f64; 3], d_ml: f64) -> Option<f64> {
        let [v0, v1, v2] = v_ml;
        let vbar = (v0 + self.smoothing * (v1 + v2)) / (1.0 + 2.0 * self.smoothing);
        let left = d_ml - self.early_ml - self.in_flight_frames * vbar;
        if left <= 0.0 {
            return None;
        }
        let wanted = (self.approach_per_frame * left).clamp(0.0, self.max_flow_ml);
        Some(if v0 == 0.0 && v1 == 0.0 && v2 == 0.0 {
            let most = self.max_forward_dry_deg;
            (self.gain_deg_per_ml * wanted).clamp(CREEP_DEG.min(most), most)
        } else {
            let damping = self.damping_frames * (v0 - v2) / 2.0;
            (self.gain_deg_per_ml * (wanted - vbar - damping)).clamp(-MAX_BACKWARD_DEG, self.max_forward_deg)
        })
    }
}

/// Cost of a squared error, 1/ml. From the prototype's recipe; no other measurement is recorded.
const SQUARE_COST_PER_ML: f64 = 0.02;
/// Largest error whose square counts, ml. From the prototype's recipe; no other measurement is recorded.
const SQUARED_MAX_ML: f64 = 30.0;
/// Cost of each frame that a pour takes, ml. From the prototype's recipe; no other measurement is recorded.
const FRAME_COST_ML: f64 = 0.005;
/// Cost of a pour that never ends, ml. Chosen by hand; no measurement is recorded.
const ENDLESS_COST_ML: f64 = 5.0;

/// Cost of one pour under a law: its error and its time.
fn cost(pours: &PossiblePours, law: &ControlLaw, seed: u64) -> f64 {
    let mut pour = pours.draw(seed);
    let mut back = false;
    let mut d_ml = pour.goal_ml;
    let of_error = |error_ml: f64| error_ml.abs() + SQUARE_COST_PER_ML * error_ml.abs().min(SQUARED_MAX_ML).powi(2);
    for frame in 0..MAX_FRAMES {
        let asked = if back { None } else { law.decide(pour.v_ml, d_ml) };
        back |= asked.is_none();
        d_ml = pour.frame(asked);
        if back && pour.over() {
            return of_error(pour.error_ml()) + FRAME_COST_ML * frame as f64;
        }
    }
    of_error(pour.error_ml()) + FRAME_COST_ML * MAX_FRAMES as f64 + ENDLESS_COST_ML
}

/// Standard deviation of the parameters' logarithms in the first iteration. Chosen by hand; no measurement is recorded.
const FIRST_SD: f64 = 0.4;
/// Least standard deviation of the parameters' logarithms. Chosen by hand; no measurement is recorded.
const SD_MIN: f64 = 0.03;
/// Share of the standard deviation before an iteration that is kept after it. Chosen by hand; no measurement is recorded.
const SD_KEPT: f64 = 0.3;
/// Share of the elites' standard deviation in that of the next iteration: the rest.
const SD_NEW: f64 = 0.7;
/// Parameters whose logarithm is outside of this range mean "none" and "no bound": they stay where they are.
const SEARCHED_LOGS: std::ops::Range<f64> = -10.0..4.0;

/// Size of the search.
#[derive(Debug, Clone, Copy)]
pub struct SearchSize {
    /// Laws tried in an iteration.
    pub population: usize,
    /// Pours of each.
    pub pours: usize,
    /// Iterations.
    pub iterations: usize,
    /// Laws that the next iteration is drawn around.
    pub elites: usize,
}

/// The cross-entropy method over the law's log-parameters, around `start`. Returns the law at the last mean, and the elites'
/// mean cost after each iteration. `progress` is told the iteration and that cost.
pub fn search(
    pours: &PossiblePours,
    start: ControlLaw,
    size: SearchSize,
    seed: u64,
    mut progress: impl FnMut(usize, f64),
) -> (ControlLaw, Vec<f64>) {
    let mut rng = Pcg64Mcg::seed_from_u64(seed ^ 0x1a77);
    let mut mean = start.logs();
    // What a PD does not have stays where it is.
    let free = mean.map(|l| SEARCHED_LOGS.contains(&l));
    let mut sd = free.map(|f| if f { FIRST_SD } else { 0.0 });
    let mut curve = Vec::new();
    for iteration in 0..size.iterations {
        let mut laws: Vec<[f64; LAW_PARAMETERS]> = vec![mean];
        while laws.len() < size.population {
            let mut law = mean;
            for (log, sd) in law.iter_mut().zip(&sd) {
                let z: f64 = StandardNormal.sample(&mut rng);
                *log += sd * z;
            }
            laws.push(law);
        }
        let base = seed.wrapping_mul(1_000_003).wrapping_add((iteration * size.pours) as u64);
        let costs: Vec<f64> = laws
            .par_iter()
            .map(|logs| {
                let law = ControlLaw::from_logs(logs);
                (0..size.pours).map(|k| cost(pours, &law, base.wrapping_add(k as u64))).sum::<f64>() / size.pours as f64
            })
            .collect();
        let mut order: Vec<usize> = (0..laws.len()).collect();
        order.sort_by(|a, b| costs[*a].total_cmp(&costs[*b]));
        let elites = &order[..size.elites.min(order.len())];
        for k in 0..LAW_PARAMETERS {
            let values: Vec<f64> = elites.iter().map(|e| laws[*e][k]).collect();
            let new_mean = values.iter().sum::<f64>() / values.len() as f64;
            let variance = values.iter().map(|v| (v - new_mean).powi(2)).sum::<f64>() / values.len() as f64;
            mean[k] = new_mean;
            sd[k] = if free[k] { (SD_KEPT * sd[k] + SD_NEW * variance.sqrt()).max(SD_MIN) } else { 0.0 };
        }
        let best = elites.iter().map(|e| costs[*e]).sum::<f64>() / elites.len() as f64;
        curve.push(best);
        progress(iteration, best);
    }
    (ControlLaw::from_logs(&mean), curve)
}
