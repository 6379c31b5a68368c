//! One explanation of a pour: an extended Kalman filter on the flow model, in the camera's own ml.
//!
//! It is pure and runs in the controller's loop: its size is fixed, and it does not allocate or panic. If its numbers ever cease to be
//! finite, `Filter::is_finite` tells the caller. A frame costs about 5 kflop, because most rows of its matrices are sparse.
//!
//! | symbol | state of the filter |
//! |---|---|
//! | E | liquid above the lip, ml |
//! | F | film at the lip, ml |
//! | V | volume that has left the lip, ml |
//! | lambda | logarithm of this pour's flow factor (viscosity) |
//! | G | logarithm of the camera's gain in this pour |
//! | delta | delay of this pour above the model's, frames |
//! | s | correction of the vessel's log shape, at each knot |
//!
//! E, F, V and the capacity are in the camera's ml, so that its gain G does not enter the dynamics or the measurement: both would find it by
//! mistake, whenever the model is linearised anew. G only turns V into true ml, and is found by its covariance with s: what a camera reads
//! too large makes the vessel look too large.
//!
//! ```text
//! a_m = (a + a')/2 - delta (a - a');  D = change of a - delta (its change);  E += w(a_m) exp(s(a_m)) D
//! h   = (1 - eta) v + (F + eta v)/9;  v = min(E/2, weir(a, E) exp(lambda))
//! z   = ln((y + f)/(h + f)),  f = 0.3 of the least outflow that can be seen;  R = (sd h/(h + f))^2 + (0.012/(h + f))^2
//! E  -= v;  F += eta v - (F + eta v)/9;  V += h
//! ```

use super::flow::{DRIP_SHARE, FlowState, FlowTables};
use super::vessel::{KNOTS, TablePlace, knot_place};

/// Index of the explanation by a vessel of any shape.
pub const WIDE: usize = 0;
/// Index of the explanation by a vessel with straight walls.
pub const TIGHT: usize = 1;
/// Number of explanations.
pub const EXPLANATIONS: usize = 2;
/// Number of a pour's unknowns before it begins: lambda, G, delta and s.
pub const UNKNOWNS: usize = 3 + KNOTS;
/// Number of states of a filter.
const STATES: usize = FIRST_UNKNOWN + UNKNOWNS;
/// Index of E, the liquid above the lip.
const EXCESS: usize = 0;
/// Index of F, the film.
const FILM: usize = 1;
/// Index of V, the volume poured.
const POURED: usize = 2;
/// Index of the first unknown: lambda, the flow factor's logarithm.
const FIRST_UNKNOWN: usize = 3;
/// Index of lambda.
const FLOW_FACTOR: usize = FIRST_UNKNOWN;
/// Index of G, the logarithm of the camera's gain.
const CAMERA_GAIN: usize = FIRST_UNKNOWN + 1;
/// Index of delta, the delay above the model's.
const EXTRA_DELAY: usize = FIRST_UNKNOWN + 2;
/// Index of s at the first knot.
const SHAPE: usize = FIRST_UNKNOWN + 3;

/// Standard deviation of a measured outflow, ml a frame, that remains when the outflow is small. From the prototype's filter; no other
/// measurement is recorded.
const SD_FLOOR_ML: f64 = 0.012;
/// Share of the least visible outflow that is added to outflows before their logarithm is taken. From the prototype's filter; no other
/// measurement is recorded.
const FLOOR_SHARE: f64 = 0.3;
/// The least of that floor, ml a frame, for a camera that sees everything. Chosen by hand; no measurement is recorded.
const FLOOR_MIN_ML: f64 = 1e-3;
/// Slopes are taken at no less than this excess, ml, so that a measurement can correct a filter that believes the flow has ceased. Chosen
/// by hand; no measurement is recorded.
const EXCESS_MIN_ML: f64 = 0.05;
/// A measurement that is further off than this many standard deviations counts less. From the prototype's filter; no other
/// measurement is recorded.
const GATE_SDS: f64 = 4.0;
/// The part of the excess's variance that nothing else explains when flow is first seen, ml^2. From the prototype's filter; no other
/// measurement is recorded.
const FIRST_EXCESS_VARIANCE_ML2: f64 = 0.25;
/// A foreseen outflow above this many times the least visible one cannot be overlooked, so that a zero is a dropout. From the
/// prototype's filter; no other measurement is recorded.
const SURELY_VISIBLE: f64 = 3.0;
/// This many zeros in a row are believed, and no longer taken for a dropout. From the prototype's filter; no other measurement is recorded.
const ZEROS_BELIEVED: u32 = 3;
/// How much the excess drifts for each degree of tilt and each ml of outflow, as a share. From the prototype's filter; no other measurement
/// is recorded.
const DRIFT_SHARE: f64 = 0.03;
/// How much the excess drifts in a frame, as a variance, ml^2. From the prototype's filter; no other measurement is recorded.
const DRIFT_ML2: f64 = 1e-4;
/// How much lambda drifts in a frame. From the prototype's filter; no other measurement is recorded.
const FLOW_FACTOR_DRIFT: f64 = 0.007;
/// Largest size of a logarithm among the states: a filter that believes more is lost. Chosen by hand; no measurement is recorded.
const LOG_MAX: f64 = 3.0;

/// Covariance of a pour's unknowns before it begins, in the order of the states.
pub type UnknownsCovariance = [[f64; UNKNOWNS]; UNKNOWNS];

/// The tilt that a picture shows, and its changes in this frame and in the one before, degrees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Tilt {
    pub tilt_deg: f64,
    pub change_deg: f64,
    pub change_before_deg: f64,
}

/// What is foreseen of a frame, and how far off it was.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) struct Innovation {
    /// Outflow that was foreseen, ml.
    pub foreseen_ml: f64,
    /// How far the measurement is from it, standard deviations.
    pub sds: f64,
}

/// A filter on a flow model.
#[derive(Debug, Clone)]
pub(super) struct Filter {
    state: [f64; STATES],
    covariance: [[f64; STATES]; STATES],
    /// Capacity that the tilt has taken on its way out, by knot, ml.
    taken_ml: [f64; KNOTS],
    /// Number of zeros seen in a row.
    zeros: u32,
}

/// Outflow over the lip in a frame, ml, and its slopes.
#[derive(Debug, Clone, Copy)]
struct Slopes {
    flow_ml: f64,
    per_excess: f64,
    per_flow_factor: f64,
}

impl Default for Filter {
    fn default() -> Self {
        Self::new()
    }
}

impl Filter {
    /// A filter that has seen nothing.
    pub fn new() -> Self {
        Self { state: [0.0; STATES], covariance: [[0.0; STATES]; STATES], taken_ml: [0.0; KNOTS], zeros: 0 }
    }

    /// Whether all states and their covariance are finite numbers.
    pub fn is_finite(&self) -> bool {
        self.state.iter().chain(self.covariance.iter().flatten()).all(|s| s.is_finite())
    }

    /// Begins with a frame that shows flow: the stream shows how high the liquid stands above the lip. `before` is what has left before it by the
    /// camera, ml, and its variance, ml^2.
    pub fn start(&mut self, flow: &FlowTables, prior: &UnknownsCovariance, tilt: Tilt, measured_ml: f64, before: (f64, f64)) {
        let excess_ml = flow.excess_ml_for(tilt.tilt_deg, measured_ml);
        let excess_per_log = excess_ml / flow.model.head_exponent;
        *self = Self::new();
        self.state[EXCESS] = excess_ml;
        self.state[POURED] = before.0;
        let p = &mut self.covariance;
        p[POURED][POURED] = before.1;
        for (i, row) in prior.iter().enumerate() {
            p[FIRST_UNKNOWN + i][FIRST_UNKNOWN..].copy_from_slice(row);
            let covariance = -excess_per_log * prior[0][i];
            p[EXCESS][FIRST_UNKNOWN + i] = covariance;
            p[FIRST_UNKNOWN + i][EXCESS] = covariance;
        }
        let noise = flow.model.noise.log_frame_volume_sd;
        p[EXCESS][EXCESS] = excess_per_log * excess_per_log * (prior[0][0] + noise * noise) + FIRST_EXCESS_VARIANCE_ML2;
    }

    /// Moves the liquid with the container's tilt.
    pub fn tilt(&mut self, flow: &FlowTables, tilt: Tilt) {
        let delay = self.state[EXTRA_DELAY];
        let middle_deg = tilt.tilt_deg - (0.5 + delay) * tilt.change_deg;
        let change_deg = tilt.change_deg - delay * (tilt.change_deg - tilt.change_before_deg);
        let (knot, share) = knot_place(middle_deg);
        let shape = (1.0 - share) * self.state[SHAPE + knot] + share * self.state[SHAPE + knot + 1];
        let lost_ml_per_deg = flow.capacity.lost_ml_per_deg_at(TablePlace::of(middle_deg)) * shape.exp();
        let gained_ml = lost_ml_per_deg * change_deg;
        self.taken_ml[knot] += (1.0 - share) * gained_ml.max(0.0);
        self.taken_ml[knot + 1] += share * gained_ml.max(0.0);
        self.state[EXCESS] += gained_ml;
        let row = [
            (EXCESS, 1.0),
            (EXTRA_DELAY, -lost_ml_per_deg * (tilt.change_deg - tilt.change_before_deg)),
            (SHAPE + knot, (1.0 - share) * gained_ml),
            (SHAPE + knot + 1, share * gained_ml),
        ];
        self.replace(EXCESS, &row);
        self.covariance[EXCESS][EXCESS] += (DRIFT_SHARE * lost_ml_per_deg).powi(2) * change_deg.abs();
    }

    /// Takes a frame's outflow, ml, that is off by `extra_log_sd` beyond the model's noise, and says how well it was foreseen; `None` where a zero
    /// says nothing.
    pub fn update(&mut self, flow: &FlowTables, tilt: Tilt, measured_ml: f64, extra_log_sd: f64) -> Option<Innovation> {
        let noise = flow.model.noise;
        let floor_ml = (FLOOR_SHARE * noise.least_visible_ml).max(FLOOR_MIN_ML);
        let prior = self.state;
        let mut posterior = prior;
        let mut gained = ([0.0; STATES], 1.0);
        let mut first = Innovation { foreseen_ml: 0.0, sds: 0.0 };
        for pass in 0..2 {
            let (foreseen_ml, slopes) = foresee(flow, tilt, &posterior);
            let mut seen_ml = measured_ml;
            if measured_ml > 0.0 {
                self.zeros = 0;
            } else {
                if pass == 0 {
                    self.zeros = self.zeros.saturating_add(1);
                }
                let least_ml = noise.least_visible_ml;
                let overlooked = foreseen_ml > SURELY_VISIBLE * least_ml && self.zeros < ZEROS_BELIEVED;
                if foreseen_ml <= least_ml || overlooked {
                    // There is too little to be seen, or the extraction dropped the stream.
                    return None;
                }
                seen_ml = least_ml;
            }
            let scale = 1.0 / (foreseen_ml + floor_ml);
            let slopes = slopes.map(|(k, slope)| (k, slope * scale));
            let mut projected = [0.0; STATES];
            for (k, slope) in slopes {
                for (sum, covariance) in projected.iter_mut().zip(&self.covariance[k]) {
                    *sum += slope * covariance;
                }
            }
            let mut noise_variance = (noise.log_frame_volume_sd * foreseen_ml * scale).powi(2) + (SD_FLOOR_ML * scale).powi(2);
            noise_variance += (extra_log_sd * foreseen_ml * scale).powi(2);
            let spread = slopes.iter().map(|(k, slope)| slope * projected[*k]).sum::<f64>().max(0.0);
            let mut innovation = ((seen_ml + floor_ml) * scale).ln();
            for (k, slope) in slopes {
                innovation -= slope * (prior[k] - posterior[k]);
            }
            if pass == 0 {
                first = Innovation { foreseen_ml, sds: innovation / (spread + noise_variance).sqrt() };
            }
            if innovation * innovation > GATE_SDS * GATE_SDS * (spread + noise_variance) {
                noise_variance = innovation * innovation / (GATE_SDS * GATE_SDS) - spread;
            }
            let total = spread + noise_variance;
            for k in 0..STATES {
                posterior[k] = prior[k] + projected[k] / total * innovation;
            }
            gained = (projected, total);
        }
        self.state = posterior;
        for log in &mut self.state[FIRST_UNKNOWN..] {
            *log = log.clamp(-LOG_MAX, LOG_MAX);
        }
        let (projected, total) = gained;
        for (row, p) in self.covariance.iter_mut().zip(&projected) {
            let share = p / total;
            for (covariance, other) in row.iter_mut().zip(&projected) {
                *covariance -= share * other;
            }
        }
        Some(first)
    }

    /// Lets the liquid of one frame out.
    pub fn release(&mut self, flow: &FlowTables, tilt: Tilt) {
        let film_share = flow.model.film_share;
        let Slopes { flow_ml, per_excess, per_flow_factor } = outflow(flow, tilt, &self.state);
        let leaves = 1.0 - film_share + DRIP_SHARE * film_share;
        let kept = 1.0 - DRIP_SHARE;
        // Each row reads the states as they were, so the excess, which the others read, comes last.
        self.replace(POURED, &[(POURED, 1.0), (FILM, DRIP_SHARE), (EXCESS, leaves * per_excess), (FLOW_FACTOR, leaves * per_flow_factor)]);
        let film = kept * film_share;
        self.replace(FILM, &[(FILM, kept), (EXCESS, film * per_excess), (FLOW_FACTOR, film * per_flow_factor)]);
        self.replace(EXCESS, &[(EXCESS, 1.0 - per_excess), (FLOW_FACTOR, -per_flow_factor)]);
        let mut liquid = FlowState { film_ml: self.state[FILM], ..FlowState::default() };
        self.state[POURED] += liquid.release(flow_ml, film_share);
        self.state[FILM] = liquid.film_ml;
        self.state[EXCESS] -= flow_ml;
        self.covariance[EXCESS][EXCESS] += (DRIFT_SHARE * flow_ml).powi(2) + DRIFT_ML2;
        self.covariance[FLOW_FACTOR][FLOW_FACTOR] += FLOW_FACTOR_DRIFT * FLOW_FACTOR_DRIFT;
    }

    /// The covariance after the state `index` has become the sum of the given states times their factors.
    fn replace(&mut self, index: usize, row: &[(usize, f64)]) {
        let mut product = [0.0; STATES];
        for (k, factor) in row {
            for (sum, covariance) in product.iter_mut().zip(&self.covariance[*k]) {
                *sum += factor * covariance;
            }
        }
        let own = row.iter().map(|(k, factor)| factor * product[*k]).sum();
        for (k, covariance) in product.iter().enumerate() {
            self.covariance[index][k] = *covariance;
            self.covariance[k][index] = *covariance;
        }
        self.covariance[index][index] = own;
    }

    /// Volume that has left the lip, true ml.
    pub fn poured_ml(&self) -> f64 {
        self.state[POURED] * self.true_per_seen()
    }

    /// Variance of [`Filter::poured_ml`], ml^2.
    pub fn poured_variance_ml2(&self) -> f64 {
        let (volume, p) = (self.state[POURED], &self.covariance);
        let seen = p[POURED][POURED] - 2.0 * volume * p[POURED][CAMERA_GAIN] + volume * volume * p[CAMERA_GAIN][CAMERA_GAIN];
        self.true_per_seen().powi(2) * seen.max(0.0)
    }

    /// By how many of its standard deviations the vessel looks larger or smaller to the camera than was learned, where the tilt has been; 0 before any.
    pub fn other_vessel_sds(&self, prior: &UnknownsCovariance) -> f64 {
        let first = SHAPE - FIRST_UNKNOWN;
        let sum = |of: &[f64]| of.iter().zip(&self.taken_ml).map(|(value, ml)| value * ml).sum::<f64>();
        let variance: f64 = prior[first..].iter().zip(&self.taken_ml).map(|(row, ml)| ml * sum(&row[first..])).sum();
        if variance > 0.0 { sum(&self.state[SHAPE..]).abs() / variance.sqrt() } else { 0.0 }
    }

    /// True ml for each ml that the camera sees.
    pub fn true_per_seen(&self) -> f64 {
        (-self.state[CAMERA_GAIN]).exp()
    }

    /// What the filter believes about the liquid, in the camera's ml.
    pub fn flow_state(&self, flow: &FlowTables, tilt: Tilt) -> FlowState {
        let tilt_deg = shown_deg(tilt, &self.state);
        let (knot, share) = knot_place(tilt_deg);
        let capacity_scale = ((1.0 - share) * self.state[SHAPE + knot] + share * self.state[SHAPE + knot + 1]).exp();
        FlowState {
            tilt_deg,
            headspace_ml: capacity_scale * flow.capacity.lost_ml(tilt_deg) - self.state[EXCESS],
            film_ml: self.state[FILM],
            log_flow_factor: self.state[FLOW_FACTOR],
            capacity_scale,
            extra_delay_frames: self.state[EXTRA_DELAY],
        }
    }
}

/// The tilt that a picture shows, with this pour's delay.
fn shown_deg(tilt: Tilt, state: &[f64; STATES]) -> f64 {
    tilt.tilt_deg - state[EXTRA_DELAY] * tilt.change_deg
}

/// Outflow over the lip in this frame at `state`.
fn outflow(flow: &FlowTables, tilt: Tilt, state: &[f64; STATES]) -> Slopes {
    let place = TablePlace::of(shown_deg(tilt, state));
    let over = flow.with_excess(place, state[EXCESS], state[FLOW_FACTOR]);
    let per_excess = if state[EXCESS] < EXCESS_MIN_ML {
        flow.with_excess(place, EXCESS_MIN_ML, state[FLOW_FACTOR]).flow_per_excess
    } else {
        over.flow_per_excess
    };
    Slopes { flow_ml: over.flow_ml, per_excess, per_flow_factor: over.flow_per_log_factor_ml }
}

/// The outflow to expect at `state`, ml, and its slopes in the states that it depends on.
fn foresee(flow: &FlowTables, tilt: Tilt, state: &[f64; STATES]) -> (f64, [(usize, f64); 3]) {
    let film_share = flow.model.film_share;
    let Slopes { flow_ml, per_excess, per_flow_factor } = outflow(flow, tilt, state);
    let foreseen_ml = FlowState { film_ml: state[FILM].max(0.0), ..FlowState::default() }.release(flow_ml, film_share);
    let leaves = 1.0 - film_share + DRIP_SHARE * film_share;
    (foreseen_ml, [(EXCESS, leaves * per_excess), (FLOW_FACTOR, leaves * per_flow_factor), (FILM, DRIP_SHARE)])
}
