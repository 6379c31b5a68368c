//! The fused estimate: the stream's area and the container's geometry, combined frame by frame.
//!
//! How far the tilt must go to keep the flow alive tells how much has left, whatever the camera's gain is. An extended Kalman
//! filter on the [flow model](super::flow) weighs the two. It runs in the controller's loop and is pure: its size is fixed, it
//! does not allocate, and it does not panic. It takes about 5 kflop a frame. A measurement that cannot be one counts as a lost
//! frame.
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
//!
//! The filter starts with the first frame that shows flow. Before that, only the tilt is followed.
//!
//! Something may be off by more than the episodes showed. So there are three such filters, and each has its own explanation: all
//! is as the episodes showed; the camera or the liquid has changed; the geometry or the delay is not to be trusted. Each frame's
//! likelihood moves weight to the explanations that foresaw it (a Gaussian sum), and the estimate is their weighted mean.

use super::flow::{CommandHistory, DRIP_SHARE, FlowNoise, FlowState, FlowTables, WayBack};

/// Number of states of a filter.
const STATES: usize = 7;
/// Index of X, the headspace.
const HEADSPACE: usize = 0;
/// Index of lambda, the flow factor's logarithm.
const FLOW_FACTOR: usize = 1;
/// Index of gamma, the logarithm of the camera's gain.
const CAMERA_GAIN: usize = 2;
/// Index of beta, the logarithm of the capacity's scale.
const CAPACITY_SCALE: usize = 3;
/// Index of F, the film.
const FILM: usize = 4;
/// Index of V, the volume poured.
const POURED: usize = 5;
/// Index of delta, the delay above the model's.
const EXTRA_DELAY: usize = 6;

/// One number for each state.
type States = [f64; STATES];

/// Number of explanations.
const EXPLANATIONS: usize = 3;
/// How likely each explanation is before anything was seen. Tuned on rigs 100 to 123, see docs/LEARNING.md.
const PRIOR: [f64; EXPLANATIONS] = [0.6, 0.18, 0.22];
/// The least weight of an explanation, so that it can come back. Chosen by hand; no measurement is recorded.
const WEIGHT_MIN: f64 = 1e-6;
/// Share of a frame's log-likelihood that counts, because frames are less independent than the filters believe. Tuned on rigs 100
/// to 123, see docs/LEARNING.md.
const TEMPER: f64 = 0.5;

/// The estimate stays within this many standard deviations of the camera's gain from the camera's own sum. Tuned on rigs 100 to
/// 123, see docs/LEARNING.md.
const CAMERA_SDS: f64 = 2.5;
/// This much further the estimate may be from the camera's own sum in any case, ml. Tuned on rigs 100 to 123, see docs/LEARNING.md.
const CAMERA_ML: f64 = 1.5;

/// Error of an area that does not shrink with it, ml a frame. From the prototype's filter; no other measurement is recorded.
const SD_FLOOR_ML: f64 = 0.012;
/// Slopes are taken at no less than this excess, so that a filter that believes the flow has ceased can be told otherwise, ml.
/// Chosen by hand; no measurement is recorded.
const EXCESS_MIN_ML: f64 = 0.05;
/// More than any container gives in a frame, so that it is not a measurement, ml. Chosen by hand; no measurement is recorded.
const MEASURED_MAX_ML: f64 = 50.0;
/// A measurement that is further off than this many standard deviations counts less. From the prototype's filter; no other
/// measurement is recorded.
const GATE_SDS: f64 = 4.0;
/// Angles outside of this range are cut to it, degrees: no cell tilts that far.
const COMMAND_RANGE_DEG: (f64, f64) = (-30.0, 200.0);

/// The tilt that a picture shows, and its change in a frame, degrees.
#[derive(Debug, Clone, Copy)]
struct Tilt {
    tilt_deg: f64,
    change_deg: f64,
}

/// One explanation: a filter with its own idea of what may be off, and by how much.
#[derive(Debug, Clone)]
struct Filter {
    noise: FlowNoise,
    /// What the model does not know of the headspace in a frame: a standard deviation in ml, and again for each ml of outflow.
    headspace_sd_ml: f64,
    /// What the model does not know of the flow factor's logarithm in a frame: a standard deviation.
    log_flow_factor_sd: f64,
    state: States,
    covariance: [States; STATES],
    /// Zeros seen in a row.
    zeros: u32,
    /// How likely this explanation is; the weights of all add up to 1.
    weight: f64,
}

/// The camera's own sum of the outflow.
#[derive(Debug, Clone, Copy, Default)]
struct CameraSum {
    sum_ml: f64,
    newest_ml: f64,
    /// Whether the newest outflow stands in for a lone zero.
    bridges_a_zero: bool,
}

impl CameraSum {
    /// Adds a frame: a lost one, or a single zero after a frame with flow, repeats the newest outflow.
    fn add(&mut self, measured_ml: Option<f64>) {
        if let Some(measured_ml) = measured_ml {
            self.bridges_a_zero = measured_ml == 0.0 && self.newest_ml > 0.0 && !self.bridges_a_zero;
            if !self.bridges_a_zero {
                self.newest_ml = measured_ml;
            }
        }
        self.sum_ml += self.newest_ml;
    }
}

/// The fused estimate of one pour.
#[derive(Debug, Clone)]
pub struct FusedEstimator {
    flow: FlowTables,
    way_back: WayBack,
    filters: [Filter; EXPLANATIONS],
    camera: CameraSum,
    /// Whether flow has been seen.
    started: bool,
    /// Whether this pour has had a frame.
    followed: bool,
    history: CommandHistory,
    tilt: Tilt,
}

impl FusedEstimator {
    /// An estimator for a pour to come.
    pub fn new(flow: FlowTables, way_back: WayBack) -> Self {
        let noise = flow.model.noise;
        let usual = Filter {
            noise,
            headspace_sd_ml: 0.05,
            log_flow_factor_sd: 0.007,
            state: [0.0; STATES],
            covariance: [[0.0; STATES]; STATES],
            zeros: 0,
            weight: 0.0,
        };
        let changed = FlowNoise {
            log_camera_gain_sd: (3.0 * noise.log_camera_gain_sd).max(0.1),
            log_flow_factor_sd: 2.0 * noise.log_flow_factor_sd,
            ..noise
        };
        let distrusted =
            FlowNoise { log_capacity_scale_sd: (5.0 * noise.log_capacity_scale_sd).max(0.1), extra_delay_sd_frames: 1.5, ..noise };
        let filters = [
            usual.clone(),
            Filter { noise: changed, ..usual.clone() },
            Filter { noise: distrusted, headspace_sd_ml: 0.2, log_flow_factor_sd: 0.02, ..usual },
        ];
        let mut estimator = Self {
            flow,
            way_back,
            filters,
            camera: CameraSum::default(),
            started: false,
            followed: false,
            history: CommandHistory::standing_at(0.0),
            tilt: Tilt { tilt_deg: 0.0, change_deg: 0.0 },
        };
        estimator.restart();
        estimator
    }

    /// Forgets the pour.
    pub fn restart(&mut self) {
        for (filter, prior) in self.filters.iter_mut().zip(PRIOR) {
            filter.state = [0.0; STATES];
            filter.covariance = [[0.0; STATES]; STATES];
            filter.zeros = 0;
            filter.weight = prior;
        }
        self.camera = CameraSum::default();
        self.started = false;
        self.followed = false;
    }

    /// Weighted mean of one of the states over the explanations.
    fn mean(&self, state: usize) -> f64 {
        self.filters.iter().map(|f| f.weight * f.state[state]).sum()
    }

    /// Volume that has left the lip as far as the pictures show, ml.
    pub fn poured_ml(&self) -> f64 {
        // However sure the filters are, the camera cannot be that far off.
        let sum_ml = self.camera.sum_ml;
        let most_ml = CAMERA_SDS * self.flow.model.noise.log_camera_gain_sd * sum_ml + CAMERA_ML;
        self.mean(POURED).clamp(sum_ml - most_ml, sum_ml + most_ml)
    }

    /// Standard deviation of [`FusedEstimator::poured_ml`], ml.
    pub fn poured_sd_ml(&self) -> f64 {
        let mean = self.poured_ml();
        self.filters
            .iter()
            .map(|f| f.weight * (f.covariance[POURED][POURED] + (f.state[POURED] - mean).powi(2)))
            .sum::<f64>()
            .max(0.0)
            .sqrt()
    }

    /// What the filters believe of the liquid.
    pub fn flow_state(&self) -> FlowState {
        FlowState {
            tilt_deg: self.tilt.tilt_deg - self.mean(EXTRA_DELAY) * self.tilt.change_deg,
            headspace_ml: self.mean(HEADSPACE),
            film_ml: self.mean(FILM),
            log_flow_factor: self.mean(FLOW_FACTOR),
            capacity_scale: self.mean(CAPACITY_SCALE).exp(),
            extra_delay_frames: self.mean(EXTRA_DELAY),
        }
    }

    /// Volume that still leaves if the way back starts now, ml; 0 before any flow. `now_deg` is the command in force.
    pub fn stop_volume_ml(&self, now_deg: f64) -> f64 {
        if !self.started {
            return 0.0;
        }
        self.flow.stop_volume_ml(&self.flow_state(), &self.history, now_deg, self.way_back)
    }

    /// Takes one frame: the outflow that it shows, in ml (`None`: the frame was lost), and the command that was in force when it
    /// was taken, in degrees.
    pub fn step(&mut self, measured_ml: Option<f64>, command_deg: f64) {
        self.follow_tilt(command_deg);
        let measured_ml = measured_ml.filter(|y| (0.0..=MEASURED_MAX_ML).contains(y));
        self.camera.add(measured_ml);
        if self.started {
            if let Some(measured_ml) = measured_ml {
                self.update(measured_ml);
            }
        } else {
            let Some(first_ml) = measured_ml.filter(|y| *y > 0.0) else { return };
            self.started = true;
            for filter in &mut self.filters {
                filter.start(&self.flow, self.tilt, first_ml);
            }
        }
        for filter in &mut self.filters {
            filter.propagate(&self.flow, self.tilt);
        }
        if !self.filters.iter().all(Filter::is_finite) {
            // This cannot happen with checked weights. If it does, the pour goes on as one that has not been seen yet.
            self.restart();
        }
    }

    /// Gives a measurement to all filters, and weight to those that foresaw it.
    fn update(&mut self, measured_ml: f64) {
        let log_likelihoods = self.filters.each_mut().map(|f| f.update(&self.flow, self.tilt, measured_ml));
        // A zero may be a dropout: it tells the filters what to believe, but not which of them to believe.
        let log_likelihoods = if measured_ml > 0.0 { log_likelihoods } else { [0.0; EXPLANATIONS] };
        let most = log_likelihoods.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut total = 0.0;
        for (filter, log_likelihood) in self.filters.iter_mut().zip(log_likelihoods) {
            filter.weight = (filter.weight * (TEMPER * (log_likelihood - most)).exp()).max(WEIGHT_MIN);
            total += filter.weight;
        }
        for filter in &mut self.filters {
            filter.weight /= total;
        }
    }

    /// The tilt that the newest picture shows; a command that is not a number repeats the one before it.
    fn follow_tilt(&mut self, command_deg: f64) {
        let (low_deg, high_deg) = COMMAND_RANGE_DEG;
        let command_deg = if command_deg.is_finite() { command_deg.clamp(low_deg, high_deg) } else { self.history.newest_deg() };
        if !self.followed {
            // What was before is not known, so the container stood at this angle.
            self.followed = true;
            self.history = CommandHistory::standing_at(command_deg);
            self.tilt.tilt_deg = command_deg;
        }
        self.history.push(command_deg);
        let before_deg = self.tilt.tilt_deg;
        let tilt_deg = self.flow.next_tilt_deg(before_deg, self.flow.delayed_deg(self.history.commands(), 0, 0.0));
        self.tilt = Tilt { tilt_deg, change_deg: tilt_deg - before_deg };
    }
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
    fn is_finite(&self) -> bool {
        self.weight.is_finite() && self.state.iter().chain(self.covariance.iter().flatten()).all(|s| s.is_finite())
    }

    /// The first sight of flow gives the headspace: what must have left for the lip to be covered as high as the stream says.
    fn start(&mut self, flow: &FlowTables, tilt: Tilt, measured_ml: f64) {
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
        c[HEADSPACE][HEADSPACE] =
            variance(excess_per_log) * (factor + gain + variance(noise.log_frame_volume_sd)) + variance(tilt_sd_ml) + 1.0;
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

    /// Takes a measurement; answers with its log-likelihood.
    ///
    /// The filter is linearised twice: at what it foresaw, and at what the measurement makes of that.
    fn update(&mut self, flow: &FlowTables, tilt: Tilt, measured_ml: f64) -> f64 {
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
                if foreseen_ml <= least_ml || (foreseen_ml > 3.0 * least_ml && self.zeros < 3) {
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

    /// One frame of the flow model, for the states and their covariance.
    fn propagate(&mut self, flow: &FlowTables, tilt: Tilt) {
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
        self.covariance[HEADSPACE][HEADSPACE] += self.headspace_sd_ml * self.headspace_sd_ml * (1.0 + flow_ml * flow_ml);
        self.covariance[FLOW_FACTOR][FLOW_FACTOR] += self.log_flow_factor_sd * self.log_flow_factor_sd;

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

/// The measurement that is to be expected at `state`, ml, and its slopes in all states.
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimator::flow::FlowModel;
    use crate::estimator::vessel::Vessel;
    use proptest::prelude::*;

    const BACK: WayBack = WayBack { rate_deg: 2.0, change_deg: 1.67 };

    /// The model itself, poured: commands in, outflow a frame out.
    struct ModelVessel {
        flow: FlowTables,
        state: FlowState,
        poured_ml: f64,
        history: CommandHistory,
    }

    impl ModelVessel {
        fn new(onset_deg: f64) -> Self {
            let flow = FlowTables::new(&FlowModel::default());
            let state = FlowState { headspace_ml: flow.capacity.lost_ml(onset_deg), ..FlowState::default() };
            Self { flow, state, poured_ml: 0.0, history: CommandHistory::standing_at(0.0) }
        }

        fn frame(&mut self, alpha_deg: f64) -> f64 {
            self.history.push(alpha_deg);
            let leaves_ml = self.state.step(&self.flow, self.history.commands(), 0).leaves_ml;
            self.poured_ml += leaves_ml;
            leaves_ml
        }
    }

    /// A pour that rises, holds, and returns; the camera's gain is off by `gain`, the picture `late` frames later than the model
    /// knows. (true, camera's sum, filter), ml.
    fn pour_into(mut filter: FusedEstimator, gain: f64, late: usize) -> (f64, f64, FusedEstimator) {
        let mut vessel = ModelVessel::new(50.0);
        let mut seen = std::collections::VecDeque::from(vec![0.0; late]);
        let mut alpha: f64 = 0.0;
        let mut summed = 0.0;
        for k in 0..400 {
            alpha = if k < 220 { (alpha + if vessel.poured_ml < 1.0 { 0.6 } else { 0.12 }).min(72.0) } else { (alpha - 2.0).max(0.0) };
            seen.push_back(gain * vessel.frame(alpha));
            let y = seen.pop_front().unwrap();
            summed += y;
            filter.step(Some(if y < 0.01 { 0.0 } else { y }), alpha);
        }
        (vessel.poured_ml, summed, filter)
    }

    fn pour(gain: f64) -> (f64, f64, f64) {
        let (truth, summed, filter) = pour_into(FusedEstimator::new(FlowTables::new(&FlowModel::default()), BACK), gain, 0);
        (truth, summed, filter.poured_ml())
    }

    /// Protects the three explanations: each pour makes the one that fits it more likely than the pour before did: nothing changed,
    /// the camera's gain changed, the picture comes late.
    #[test]
    fn a_pour_moves_weight_to_what_explains_it() {
        let of = |gain: f64, late: usize| {
            pour_into(FusedEstimator::new(FlowTables::new(&FlowModel::default()), BACK), gain, late).2.filters.map(|f| f.weight)
        };
        let (usual, gain, late) = (of(1.0, 0), of(1.25, 0), of(1.0, 3));
        assert!(usual[0] > PRIOR[0] && usual[0] > gain[0] && usual[0] > late[0], "{usual:?}");
        assert!(gain[1] > 2.0 * usual[1] && gain[1] > late[1], "{usual:?} {gain:?} {late:?}");
        assert!(late[2] > 2.0 * usual[2] && late[2] > gain[2], "{usual:?} {gain:?} {late:?}");
        for weights in [usual, gain, late] {
            assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-9);
        }
    }

    /// Protects the volume from a geometry that is wrong and sure of itself: the estimate stays near the camera's own sum.
    #[test]
    fn the_estimate_stays_near_the_cameras_sum() {
        let mut wrong = FlowModel { vessel: Vessel { radius_mm: 24.0, ..Vessel::default() }, ..FlowModel::default() };
        wrong.noise.log_capacity_scale_sd = 1e-3;
        let mut filter = FusedEstimator::new(FlowTables::new(&wrong), BACK);
        (filter.filters[1].noise.log_camera_gain_sd, filter.filters[2].noise.log_capacity_scale_sd) =
            (wrong.noise.log_camera_gain_sd, wrong.noise.log_capacity_scale_sd);
        let (_, summed, filter) = pour_into(filter, 1.0, 0);
        let most = CAMERA_SDS * wrong.noise.log_camera_gain_sd * summed + CAMERA_ML;
        assert!((filter.mean(POURED) - summed).abs() > 1.2 * most, "not wrong enough: {} {summed}", filter.mean(POURED));
        assert!((filter.poured_ml() - summed).abs() < most + 0.1, "{} {summed} {most}", filter.poured_ml());
    }

    /// Protects the point of fusing: geometry corrects a camera whose gain is off, which the sum cannot.
    #[test]
    fn geometry_corrects_the_cameras_gain() {
        for gain in [0.95, 1.0, 1.05] {
            let (truth, summed, fused) = pour(gain);
            assert!(truth > 60.0, "{truth}");
            // Two standard deviations of gain, one slow pour: a fifth of the camera's error is taken away, and none is added.
            assert!((fused - truth).abs() < 0.9 * (summed - truth).abs() + 0.005 * truth, "gain {gain}: {truth} {summed} {fused}");
        }
    }

    /// Protects control: what the filter says still flows on the way back is what then flows.
    #[test]
    fn the_stop_volume_is_what_still_flows() {
        let mut vessel = ModelVessel::new(50.0);
        let mut filter = FusedEstimator::new(FlowTables::new(&FlowModel::default()), BACK);
        let mut alpha = 0.0;
        for _ in 0..118 {
            alpha += 0.5;
            let y = vessel.frame(alpha);
            filter.step(Some(if y < 0.01 { 0.0 } else { y }), alpha);
        }
        let (before, said) = (vessel.poured_ml, filter.stop_volume_ml(alpha));
        let mut rate: f64 = 0.5;
        for _ in 0..150 {
            rate = (rate - BACK.change_deg).max(-BACK.rate_deg);
            alpha = (alpha + rate).max(0.0);
            vessel.frame(alpha);
        }
        let flowed = vessel.poured_ml - before;
        assert!(flowed > 3.0 && (said - flowed).abs() < 0.05 * flowed + 0.1, "{said} {flowed}");
    }

    /// Protects control with a picture that comes later than the model knows: what flows until then is counted too.
    #[test]
    fn a_late_picture_means_more_is_on_its_way() {
        let flow = FlowTables::new(&FlowModel::default());
        let later = FlowTables::new(&FlowModel { delay_frames: flow.model.delay_frames + 2.0, ..flow.model });
        let mut history = CommandHistory::standing_at(50.0);
        (0..16).for_each(|k| history.push(50.0 + 0.5 * f64::from(k)));
        let state = FlowState { tilt_deg: 54.0, headspace_ml: flow.capacity.lost_ml(52.0), ..FlowState::default() };
        let volume =
            |flow: &FlowTables, late: f64| flow.stop_volume_ml(&FlowState { extra_delay_frames: late, ..state }, &history, 57.5, BACK);
        let (usual, late) = (volume(&flow, 0.0), volume(&flow, 2.0));
        assert!(late > 1.1 * usual, "{usual} {late}");
        assert!((late - volume(&later, 0.0)).abs() < 1e-9);
    }

    /// Protects the volume from lost frames: the model bridges them.
    #[test]
    fn lost_frames_are_bridged() {
        let run = |lose: bool| {
            let mut vessel = ModelVessel::new(50.0);
            let mut filter = FusedEstimator::new(FlowTables::new(&FlowModel::default()), BACK);
            for k in 0..170 {
                let alpha = (0.6 * f64::from(k)).min(60.0);
                let y = vessel.frame(alpha);
                let lost = lose && (110..116).contains(&k);
                filter.step(Some(if y < 0.01 { 0.0 } else { y }).filter(|_| !lost), alpha);
            }
            (vessel.poured_ml, filter.poured_ml())
        };
        let ((truth, all), (_, some)) = (run(false), run(true));
        assert!((all - truth).abs() < 0.02 * truth && (some - truth).abs() < 0.03 * truth, "{truth} {all} {some}");
    }

    proptest! {
        /// Protects the loop: no measurement or angle, however wild, makes the filter panic or lose its numbers.
        #[test]
        fn any_input_leaves_finite_numbers(frames in prop::collection::vec((prop::option::of(prop_oneof![any::<f64>(), 0.0f64..3.0]), prop_oneof![any::<f64>(), 0.0f64..110.0]), 1..200)) {
            let mut filter = FusedEstimator::new(FlowTables::new(&FlowModel::default()), BACK);
            for (y, alpha) in frames {
                filter.step(y, alpha);
                prop_assert!(filter.poured_ml().is_finite() && filter.poured_sd_ml().is_finite());
                prop_assert!(filter.stop_volume_ml(alpha.clamp(-1e6, 1e6)).is_finite());
            }
        }
    }
}
