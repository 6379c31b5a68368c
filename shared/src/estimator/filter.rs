//! One explanation of a pour: an extended Kalman filter on the flow model.
//!
//! It is pure and runs in the controller's loop: its size is fixed, and it does not allocate or panic. If its numbers ever cease to be
//! finite, [`Filter::is_finite`] tells the caller.
//!
//! | symbol | state of the filter |
//! |---|---|
//! | X | headspace: capacity that is used up, ml |
//! | lambda | logarithm of this pour's flow factor (viscosity) |
//! | gamma | logarithm of the camera's gain in this pour |
//! | beta | logarithm of the scale of the vessel's capacity |
//! | F | film at the lip, ml |
//! | V | volume that has left the lip, ml |
//! | delta | delay of this pour above the model's, frames |

use super::flow::{DRIP_SHARE, FlowNoise, FlowState, FlowTables};

/// Number of states of a filter.
const STATES: usize = 7;
/// Index of X, the headspace.
pub(super) const HEADSPACE: usize = 0;
/// Index of lambda, the flow factor's logarithm.
pub(super) const FLOW_FACTOR: usize = 1;
/// Index of gamma, the logarithm of the camera's gain.
const CAMERA_GAIN: usize = 2;
/// Index of beta, the logarithm of the capacity's scale.
pub(super) const CAPACITY_SCALE: usize = 3;
/// Index of F, the film.
pub(super) const FILM: usize = 4;
/// Index of V, the volume poured.
pub(super) const POURED: usize = 5;
/// Index of delta, the delay above the model's.
pub(super) const EXTRA_DELAY: usize = 6;

/// One number for each state.
type States = [f64; STATES];

/// Standard deviation of a measured outflow, ml a frame, that remains when the outflow is small. From the prototype's filter; no other
/// measurement is recorded.
const SD_FLOOR_ML: f64 = 0.012;
/// Slopes are taken at no less than this excess, ml, so that a measurement can correct a filter that believes the flow has ceased. Chosen
/// by hand; no measurement is recorded.
const EXCESS_MIN_ML: f64 = 0.05;
/// A measurement that is further off than this many standard deviations counts less. From the prototype's filter; no other
/// measurement is recorded.
const GATE_SDS: f64 = 4.0;
/// The part of the headspace's variance that nothing else explains when flow is first seen, ml^2. From the prototype's filter; no other
/// measurement is recorded.
const FIRST_HEADSPACE_VARIANCE_ML2: f64 = 1.0;
/// A foreseen outflow above this many times the least visible one cannot be overlooked, so that a zero is a dropout. From the
/// prototype's filter; no other measurement is recorded.
const SURELY_VISIBLE: f64 = 3.0;
/// This many zeros in a row are believed, and no longer taken for a dropout. From the prototype's filter; no other measurement is recorded.
const ZEROS_BELIEVED: u32 = 3;

/// The tilt that a picture shows, and its change in a frame, degrees.
#[derive(Debug, Clone, Copy)]
pub(super) struct Tilt {
    pub tilt_deg: f64,
    pub change_deg: f64,
}

/// How far the states may drift in a frame in ways that the model does not foresee, as standard deviations.
#[derive(Debug, Clone, Copy)]
pub(super) struct Drift {
    /// Drift of the headspace, in ml, and again for each ml of outflow.
    pub headspace_sd_ml: f64,
    /// Drift of the flow factor's logarithm.
    pub log_flow_factor_sd: f64,
}

/// A filter with its own idea of what may be off, and by how much.
#[derive(Debug, Clone)]
pub(super) struct Filter {
    /// How far a pour can be off the model.
    pub noise: FlowNoise,
    drift: Drift,
    /// What the filter believes.
    pub state: States,
    /// How far that may be off, as a covariance.
    pub covariance: [States; STATES],
    /// Number of zeros seen in a row.
    zeros: u32,
}

/// Outflow over the lip in a frame, ml, and its slopes in the states that it depends on.
#[derive(Debug, Clone, Copy)]
struct Slopes {
    flow_ml: f64,
    per_headspace: f64,
    per_flow_factor: f64,
    per_extra_delay: f64,
}

impl Filter {
    /// A filter that has seen nothing.
    pub fn new(noise: FlowNoise, drift: Drift) -> Self {
        Self { noise, drift, state: [0.0; STATES], covariance: [[0.0; STATES]; STATES], zeros: 0 }
    }

    /// Forgets the pour.
    pub fn restart(&mut self) {
        *self = Self::new(self.noise, self.drift);
    }

    /// Whether all states and their covariance are finite numbers.
    pub fn is_finite(&self) -> bool {
        self.state.iter().chain(self.covariance.iter().flatten()).all(|s| s.is_finite())
    }

    /// Begins with the first frame that shows flow. It gives the headspace, because the stream shows how high the liquid stands above the
    /// lip.
    pub fn start(&mut self, flow: &FlowTables, tilt: Tilt, measured_ml: f64) {
        let noise = self.noise;
        let Tilt { tilt_deg, change_deg } = tilt;
        let lost_ml_per_deg = flow.over_lip(tilt_deg, 0.0, 0.0).lost_ml_per_deg;
        let excess_ml = flow.excess_ml_for(tilt_deg, measured_ml);
        let excess_per_log = excess_ml / flow.model.head_exponent;
        self.state = [0.0; STATES];
        self.state[HEADSPACE] = flow.capacity.lost_ml(tilt_deg) - excess_ml;
        let variance = |sd: f64| sd * sd;
        let factor = variance(noise.log_flow_factor_sd);
        let gain = variance(noise.log_camera_gain_sd);
        let delay = variance(noise.extra_delay_sd_frames);
        let mut c = [[0.0; STATES]; STATES];
        let tilt_sd_ml = lost_ml_per_deg * change_deg * noise.extra_delay_sd_frames;
        c[HEADSPACE][HEADSPACE] = variance(excess_per_log) * (factor + gain + variance(noise.log_frame_volume_sd))
            + variance(tilt_sd_ml)
            + FIRST_HEADSPACE_VARIANCE_ML2;
        c[FLOW_FACTOR][FLOW_FACTOR] = factor;
        c[CAMERA_GAIN][CAMERA_GAIN] = gain;
        c[CAPACITY_SCALE][CAPACITY_SCALE] = variance(noise.log_capacity_scale_sd);
        c[EXTRA_DELAY][EXTRA_DELAY] = delay;
        for (other, covariance) in [
            (FLOW_FACTOR, excess_per_log * factor),
            (CAMERA_GAIN, excess_per_log * gain),
            (EXTRA_DELAY, -lost_ml_per_deg * change_deg * delay),
        ] {
            c[HEADSPACE][other] = covariance;
            c[other][HEADSPACE] = covariance;
        }
        self.covariance = c;
    }

    /// Takes a measurement, and returns its log-likelihood.
    ///
    /// The filter is linearised twice: at what it foresaw, and at what the measurement makes of that.
    pub fn update(&mut self, flow: &FlowTables, tilt: Tilt, measured_ml: f64) -> f64 {
        let noise = self.noise;
        let least_ml = noise.least_visible_ml;
        let prior = self.state;
        let mut posterior = prior;
        let mut gained = ([0.0; STATES], 1.0);
        let mut log_likelihood = 0.0;
        self.zeros = if measured_ml == 0.0 { self.zeros + 1 } else { 0 };
        for pass in 0..2 {
            let (foreseen_ml, slopes) = foresee(flow, tilt, &posterior);
            let mut seen_ml = measured_ml;
            if measured_ml == 0.0 {
                if foreseen_ml <= least_ml || (foreseen_ml > SURELY_VISIBLE * least_ml && self.zeros < ZEROS_BELIEVED) {
                    // There is too little to be seen, or the extraction dropped the stream.
                    return 0.0;
                }
                seen_ml = least_ml;
            }
            let projected = self.covariance.map(|row| dot(&row, &slopes));
            let mut noise_variance = (noise.log_frame_volume_sd * foreseen_ml).powi(2) + SD_FLOOR_ML * SD_FLOOR_ML;
            let spread = dot(&slopes, &projected).max(0.0);
            let mut innovation_ml = seen_ml - foreseen_ml;
            for k in 0..STATES {
                innovation_ml -= slopes[k] * (prior[k] - posterior[k]);
            }
            if pass == 0 {
                let square = innovation_ml * innovation_ml / (spread + noise_variance);
                log_likelihood = -0.5 * (square.min(GATE_SDS * GATE_SDS) + (spread + noise_variance).ln());
            }
            let limit = GATE_SDS * GATE_SDS * (spread + noise_variance);
            if innovation_ml * innovation_ml > limit {
                noise_variance = innovation_ml * innovation_ml / (GATE_SDS * GATE_SDS) - spread;
            }
            let total = spread + noise_variance;
            for k in 0..STATES {
                posterior[k] = prior[k] + projected[k] / total * innovation_ml;
            }
            gained = (projected, total);
        }
        self.state = posterior;
        let (projected, total) = gained;
        for i in 0..STATES {
            for j in 0..STATES {
                self.covariance[i][j] -= projected[i] * projected[j] / total;
            }
        }
        log_likelihood
    }

    /// Moves the states and their covariance on by one frame of the flow model.
    pub fn propagate(&mut self, flow: &FlowTables, tilt: Tilt) {
        let film_share = flow.model.film_share;
        let Slopes { flow_ml, per_headspace, per_flow_factor, per_extra_delay } = outflow(flow, tilt, &self.state);
        let capacity_scale = self.state[CAPACITY_SCALE].exp();
        let mut flow_slopes = [0.0; STATES];
        flow_slopes[HEADSPACE] = per_headspace;
        flow_slopes[FLOW_FACTOR] = per_flow_factor;
        flow_slopes[EXTRA_DELAY] = per_extra_delay;
        // The rows of the transition that differ from the identity.
        let mut to_headspace = flow_slopes.map(|slope| capacity_scale * slope);
        let mut to_film = flow_slopes.map(|slope| (1.0 - DRIP_SHARE) * film_share * slope);
        let mut to_poured = flow_slopes.map(|slope| (1.0 - film_share + DRIP_SHARE * film_share) * slope);
        to_headspace[HEADSPACE] += 1.0;
        to_headspace[CAPACITY_SCALE] += capacity_scale * flow_ml;
        to_film[FILM] += 1.0 - DRIP_SHARE;
        to_poured[POURED] += 1.0;
        to_poured[FILM] += DRIP_SHARE;
        self.covariance = transform(&self.covariance, &[(HEADSPACE, to_headspace), (FILM, to_film), (POURED, to_poured)]);
        self.covariance[HEADSPACE][HEADSPACE] += self.drift.headspace_sd_ml * self.drift.headspace_sd_ml * (1.0 + flow_ml * flow_ml);
        self.covariance[FLOW_FACTOR][FLOW_FACTOR] += self.drift.log_flow_factor_sd * self.drift.log_flow_factor_sd;

        let mut liquid =
            FlowState { headspace_ml: self.state[HEADSPACE], film_ml: self.state[FILM], capacity_scale, ..FlowState::default() };
        self.state[POURED] += liquid.release(flow_ml, film_share);
        self.state[HEADSPACE] = liquid.headspace_ml;
        self.state[FILM] = liquid.film_ml;
    }
}

/// Outflow over the lip in this frame at `state`.
fn outflow(flow: &FlowTables, tilt: Tilt, state: &States) -> Slopes {
    let tilt_deg = tilt.tilt_deg - state[EXTRA_DELAY] * tilt.change_deg;
    let over = flow.over_lip(tilt_deg, state[HEADSPACE], state[FLOW_FACTOR]);
    let flow_per_excess = if over.excess_ml < EXCESS_MIN_ML {
        let headspace_ml = flow.capacity.lost_ml(tilt_deg) - EXCESS_MIN_ML;
        flow.over_lip(tilt_deg, headspace_ml, state[FLOW_FACTOR]).flow_per_excess
    } else {
        over.flow_per_excess
    };
    Slopes {
        flow_ml: over.flow_ml,
        per_headspace: -flow_per_excess,
        per_flow_factor: over.flow_per_log_factor_ml,
        per_extra_delay: -flow_per_excess * over.lost_ml_per_deg * tilt.change_deg,
    }
}

/// The measurement to expect at `state`, ml, and its slopes in all states.
fn foresee(flow: &FlowTables, tilt: Tilt, state: &States) -> (f64, States) {
    let film_share = flow.model.film_share;
    let Slopes { flow_ml, per_headspace, per_flow_factor, per_extra_delay } = outflow(flow, tilt, state);
    let gain = state[CAMERA_GAIN].exp();
    let foreseen_ml = gain * FlowState { film_ml: state[FILM], ..FlowState::default() }.release(flow_ml, film_share);
    let per_flow = gain * (1.0 - film_share + DRIP_SHARE * film_share);
    let mut slopes = [0.0; STATES];
    slopes[HEADSPACE] = per_flow * per_headspace;
    slopes[FLOW_FACTOR] = per_flow * per_flow_factor;
    slopes[CAMERA_GAIN] = foreseen_ml;
    slopes[FILM] = gain * DRIP_SHARE;
    slopes[EXTRA_DELAY] = per_flow * per_extra_delay;
    (foreseen_ml, slopes)
}

/// A P A' for a transition A that differs from the identity in the given rows.
fn transform(covariance: &[States; STATES], rows: &[(usize, States); 3]) -> [States; STATES] {
    let products = rows.map(|(_, row)| {
        let mut product = [0.0; STATES];
        for (factor, covariance_row) in row.iter().zip(covariance) {
            for (sum, c) in product.iter_mut().zip(covariance_row) {
                *sum += factor * c;
            }
        }
        product
    });
    let mut next = *covariance;
    for ((index, _), product) in rows.iter().zip(&products) {
        for k in [FLOW_FACTOR, CAMERA_GAIN, CAPACITY_SCALE, EXTRA_DELAY] {
            next[*index][k] = product[k];
            next[k][*index] = product[k];
        }
        for (other, row) in rows {
            next[*index][*other] = dot(product, row);
        }
    }
    next
}

fn dot(a: &States, b: &States) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}
