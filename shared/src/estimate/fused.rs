//! The fused estimate: the stream's area and the container's geometry, combined frame by frame.
//!
//! How far the tilt must go to keep the flow alive tells how much has left, whatever the camera's gain. An extended Kalman
//! filter on the [flow model](super::flow) weighs the two. Pure and in the controller's loop: fixed size, no allocation, no
//! panic; about 5 kflop a frame.
//!
//! State: X (W used up, ml), lambda (flow coefficient of this pour), gamma (camera gain of this pour), beta (scale of the
//! geometry), F (film, ml), V (poured, ml), delta (delay of this pour, frames). It starts with the first frame that shows
//! flow; before that only the tilt is followed.
//!
//! What is off may be off by more than the episodes showed. So there are three such filters, each with its own explanation:
//! all as the episodes showed; camera or liquid changed; geometry or delay not to be trusted. Each frame's likelihood moves
//! weight to the explanations that foresaw it (a Gaussian sum), and the estimate is their mean.

use super::flow::{DRIP, Flow, FlowNoise, FlowState, HISTORY, Return};

const N: usize = 7;
const X: usize = 0;
const LAMBDA: usize = 1;
const GAMMA: usize = 2;
const BETA: usize = 3;
const FILM: usize = 4;
const POURED: usize = 5;
const DELTA: usize = 6;

/// Number of explanations.
const EXPLANATIONS: usize = 3;
/// How likely each is before anything was seen.
const PRIOR: [f64; EXPLANATIONS] = [0.6, 0.18, 0.22];
/// Share of a frame's log-likelihood that counts: frames are less independent than the filters believe.
const TEMPER: f64 = 0.5;

/// The estimate stays this near to the camera's own sum: standard deviations of its gain, and ml.
const CAMERA_SDS: f64 = 2.5;
const CAMERA_ML: f64 = 1.5;

/// Error of an area that does not shrink with it, ml a frame.
const SD_FLOOR_ML: f64 = 0.012;
/// Slopes are taken at no less than this excess, so that a filter that believes the flow has ceased can be told otherwise, ml.
const EXCESS_MIN_ML: f64 = 0.05;
/// More than any container gives in a frame: not a measurement, ml.
const Y_MAX_ML: f64 = 50.0;
/// A measurement further off than this many standard deviations counts less.
const GATE: f64 = 4.0;

/// The tilt that a picture shows, and its change in a frame, degrees.
#[derive(Debug, Clone, Copy)]
struct Tilt {
    a_deg: f64,
    slope_deg: f64,
}

/// One explanation: a filter with its own idea of how far what may be off.
#[derive(Debug, Clone)]
struct Filter {
    noise: FlowNoise,
    /// What the model does not know in a frame (standard deviations): X in ml, and per ml of outflow; lambda, log.
    sd_x_ml: f64,
    sd_lambda: f64,
    state: [f64; N],
    covariance: [[f64; N]; N],
    zeros: u32,
    weight: f64,
}

/// The filter in one pour.
#[derive(Debug, Clone)]
pub struct Fused {
    flow: Flow,
    back: Return,
    filters: [Filter; EXPLANATIONS],
    /// The camera's own sum, ml, with lone zeros bridged; the newest outflow in it; whether that bridges a zero.
    camera_ml: (f64, f64, bool),
    started: bool,
    frames: u64,
    a_deg: f64,
    a_before_deg: f64,
    history: [f64; HISTORY],
}

impl Fused {
    /// A filter for a pour to come.
    pub fn new(flow: Flow, back: Return) -> Self {
        let noise = flow.model.noise;
        let usual = Filter { noise, sd_x_ml: 0.05, sd_lambda: 0.007, state: [0.0; N], covariance: [[0.0; N]; N], zeros: 0, weight: 0.0 };
        let changed = FlowNoise { gamma: (3.0 * noise.gamma).max(0.1), lambda: 2.0 * noise.lambda, ..noise };
        let distrusted = FlowNoise { beta: (5.0 * noise.beta).max(0.1), delta: 1.5, ..noise };
        let filters = [
            usual.clone(),
            Filter { noise: changed, ..usual.clone() },
            Filter { noise: distrusted, sd_x_ml: 0.2, sd_lambda: 0.02, ..usual },
        ];
        let mut filter = Self {
            flow,
            back,
            filters,
            camera_ml: (0.0, 0.0, false),
            started: false,
            frames: 0,
            a_deg: 0.0,
            a_before_deg: 0.0,
            history: [0.0; HISTORY],
        };
        filter.restart();
        filter
    }

    /// Forgets the pour.
    pub fn restart(&mut self) {
        for (filter, prior) in self.filters.iter_mut().zip(PRIOR) {
            filter.state = [0.0; N];
            filter.covariance = [[0.0; N]; N];
            filter.zeros = 0;
            filter.weight = prior;
        }
        self.camera_ml = (0.0, 0.0, false);
        self.started = false;
        self.frames = 0;
    }

    /// Mean of one of the states over the explanations.
    fn mean(&self, of: usize) -> f64 {
        self.filters.iter().map(|f| f.weight * f.state[of]).sum()
    }

    /// Volume that has left the lip as far as the pictures show, ml.
    pub fn poured_ml(&self) -> f64 {
        // However sure the filters are: the camera cannot be that far off.
        let (sum, ..) = self.camera_ml;
        let most = CAMERA_SDS * self.flow.model.noise.gamma * sum + CAMERA_ML;
        self.mean(POURED).clamp(sum - most, sum + most)
    }

    /// Standard deviation of [`Fused::poured_ml`], ml.
    pub fn poured_sd_ml(&self) -> f64 {
        let mean = self.poured_ml();
        self.filters
            .iter()
            .map(|f| f.weight * (f.covariance[POURED][POURED] + (f.state[POURED] - mean).powi(2)))
            .sum::<f64>()
            .max(0.0)
            .sqrt()
    }

    /// Weights of the explanations: as the episodes showed, camera or liquid changed, geometry or delay not to be trusted.
    pub fn explanations(&self) -> [f64; EXPLANATIONS] {
        [0, 1, 2].map(|k| self.filters[k].weight)
    }

    /// Whether flow has been seen.
    pub fn started(&self) -> bool {
        self.started
    }

    fn tilt(&self) -> Tilt {
        Tilt { a_deg: self.a_deg, slope_deg: self.a_deg - self.a_before_deg }
    }

    /// What the filter believes of the liquid.
    pub fn flow_state(&self) -> FlowState {
        FlowState {
            a_deg: self.a_deg - self.mean(DELTA) * self.tilt().slope_deg,
            x_ml: self.mean(X),
            film_ml: self.mean(FILM),
            lambda: self.mean(LAMBDA),
            beta: self.mean(BETA),
            late: self.mean(DELTA),
        }
    }

    /// Volume that still leaves if the way back starts now, `now_deg` being the command in force, ml; 0 before any flow.
    pub fn stop_volume_ml(&self, now_deg: f64) -> f64 {
        if !self.started {
            return 0.0;
        }
        self.flow.stop_volume_ml(&self.flow_state(), &self.history, now_deg, self.back)
    }

    /// Takes one frame: the measured outflow `y_ml` (`None`: lost), and the command in force when it was taken, degrees.
    pub fn step(&mut self, y_ml: Option<f64>, alpha_deg: f64) {
        self.follow_tilt(alpha_deg);
        let tilt = self.tilt();
        let y_ml = y_ml.filter(|y| (0.0..=Y_MAX_ML).contains(y));
        self.add_up(y_ml);
        if !self.started {
            match y_ml {
                Some(y) if y > 0.0 => {
                    self.started = true;
                    for filter in &mut self.filters {
                        filter.start(&self.flow, tilt, y);
                    }
                }
                _ => return,
            }
        } else if let Some(y) = y_ml {
            // A zero may be a dropout: it tells the filters what to believe, but not which of them to believe.
            let said = self.filters.each_mut().map(|f| f.update(&self.flow, tilt, y));
            let said = if y > 0.0 { said } else { [0.0; EXPLANATIONS] };
            let most = said.iter().copied().fold(f64::NEG_INFINITY, f64::max);
            let mut total = 0.0;
            for (filter, said) in self.filters.iter_mut().zip(said) {
                filter.weight = (filter.weight * (TEMPER * (said - most)).exp()).max(1e-6);
                total += filter.weight;
            }
            for filter in &mut self.filters {
                filter.weight /= total;
            }
        }
        for filter in &mut self.filters {
            filter.propagate(&self.flow, tilt);
        }
        if !self.filters.iter().all(Filter::is_finite) {
            // Cannot happen with checked weights; if it does, the pour goes on as one that has not been seen yet.
            self.restart();
        }
    }

    /// The camera's own sum: a lost frame, or a single zero after a frame with flow, repeats the newest outflow.
    fn add_up(&mut self, y_ml: Option<f64>) {
        let (sum, newest, bridged) = &mut self.camera_ml;
        if let Some(y) = y_ml {
            *bridged = y == 0.0 && *newest > 0.0 && !*bridged;
            if !*bridged {
                *newest = y;
            }
        }
        *sum += *newest;
    }

    fn follow_tilt(&mut self, alpha_deg: f64) {
        let alpha = if alpha_deg.is_finite() { alpha_deg.clamp(-30.0, 200.0) } else { self.history[HISTORY - 1] };
        if self.frames == 0 {
            // Whatever was before is not known: the container stood at this angle.
            self.history = [alpha; HISTORY];
            self.a_deg = alpha;
        }
        self.frames += 1;
        self.history.copy_within(1.., 0);
        self.history[HISTORY - 1] = alpha;
        self.a_before_deg = self.a_deg;
        self.a_deg = self.flow.tilt(self.a_deg, self.flow.delayed(&self.history, 0, 0.0));
    }
}

impl Filter {
    fn is_finite(&self) -> bool {
        self.weight.is_finite() && self.state.iter().chain(self.covariance.iter().flatten()).all(|s| s.is_finite())
    }

    /// The first sight of flow gives X: what must have left for the lip to be covered as high as the stream says.
    fn start(&mut self, flow: &Flow, tilt: Tilt, y_ml: f64) {
        let noise = self.noise;
        let slope = tilt.slope_deg;
        let w = flow.over(tilt.a_deg, 0.0, 0.0).w;
        let excess = flow.excess_for(tilt.a_deg, y_ml, 0.0);
        let per_log = excess / flow.model.p;
        self.state = [0.0; N];
        self.state[X] = flow.capacity_ml(tilt.a_deg) - excess;
        let variance = |sd: f64| sd * sd;
        let mut c = [[0.0; N]; N];
        let tilt_sd = w * slope * noise.delta;
        c[X][X] = variance(per_log) * (variance(noise.lambda) + variance(noise.gamma) + variance(noise.frame)) + variance(tilt_sd) + 1.0;
        c[LAMBDA][LAMBDA] = variance(noise.lambda);
        c[GAMMA][GAMMA] = variance(noise.gamma);
        c[BETA][BETA] = variance(noise.beta);
        c[DELTA][DELTA] = variance(noise.delta);
        for (other, cov) in [
            (LAMBDA, per_log * variance(noise.lambda)),
            (GAMMA, per_log * variance(noise.gamma)),
            (DELTA, -w * slope * variance(noise.delta)),
        ] {
            c[X][other] = cov;
            c[other][X] = cov;
        }
        self.covariance = c;
    }

    /// Outflow over the lip in this frame at `state`, and its slopes in X, lambda and delta.
    fn outflow(&self, flow: &Flow, tilt: Tilt, state: &[f64; N]) -> (f64, f64, f64, f64) {
        let a = tilt.a_deg - state[DELTA] * tilt.slope_deg;
        let over = flow.over(a, state[X], state[LAMBDA]);
        let dv_de = if over.excess_ml < EXCESS_MIN_ML {
            flow.over(a, flow.capacity_ml(a) - EXCESS_MIN_ML, state[LAMBDA]).dv_de
        } else {
            over.dv_de
        };
        (over.v_ml, -dv_de, over.dv_dlambda, -dv_de * over.w * tilt.slope_deg)
    }

    /// Takes a measurement; answers with its log-likelihood.
    fn update(&mut self, flow: &Flow, tilt: Tilt, y_ml: f64) -> f64 {
        let noise = self.noise;
        let eta = flow.model.eta;
        let prior = self.state;
        let mut posterior = prior;
        let mut gained = ([0.0; N], 1.0);
        let mut likelihood = 0.0;
        self.zeros = if y_ml == 0.0 { self.zeros + 1 } else { 0 };
        for pass in 0..2 {
            let (v, v_x, v_lambda, v_delta) = self.outflow(flow, tilt, &posterior);
            let gain = posterior[GAMMA].exp();
            let out = (1.0 - eta) * v + DRIP * (posterior[FILM] + eta * v);
            let h_ml = gain * out;
            let mut y = y_ml;
            if y_ml == 0.0 {
                if h_ml <= noise.v_min_ml || (h_ml > 3.0 * noise.v_min_ml && self.zeros < 3) {
                    // Too little to be seen, or a dropout of the extraction.
                    return 0.0;
                }
                y = noise.v_min_ml;
            }
            let per_v = gain * (1.0 - eta + DRIP * eta);
            let mut h = [0.0; N];
            h[X] = per_v * v_x;
            h[LAMBDA] = per_v * v_lambda;
            h[GAMMA] = h_ml;
            h[FILM] = gain * DRIP;
            h[DELTA] = per_v * v_delta;
            let ph = self.covariance.map(|row| dot(&row, &h));
            let mut r = (noise.frame * h_ml).powi(2) + SD_FLOOR_ML * SD_FLOOR_ML;
            let spread = dot(&h, &ph).max(0.0);
            let mut innovation = y - h_ml;
            for k in 0..N {
                innovation -= h[k] * (prior[k] - posterior[k]);
            }
            if pass == 0 {
                let square = innovation * innovation / (spread + r);
                likelihood = -0.5 * (square.min(GATE * GATE) + (spread + r).ln());
            }
            let limit = GATE * GATE * (spread + r);
            if innovation * innovation > limit {
                r = innovation * innovation / (GATE * GATE) - spread;
            }
            let total = spread + r;
            for k in 0..N {
                posterior[k] = prior[k] + ph[k] / total * innovation;
            }
            gained = (ph, total);
        }
        self.state = posterior;
        let (ph, total) = gained;
        for i in 0..N {
            for j in 0..N {
                self.covariance[i][j] -= ph[i] * ph[j] / total;
            }
        }
        likelihood
    }

    fn propagate(&mut self, flow: &Flow, tilt: Tilt) {
        let eta = flow.model.eta;
        let (v, v_x, v_lambda, v_delta) = self.outflow(flow, tilt, &self.state);
        let scale = self.state[BETA].exp();
        // Rows of the transition that differ from the identity: X, F, V.
        let mut dv = [0.0; N];
        dv[X] = v_x;
        dv[LAMBDA] = v_lambda;
        dv[DELTA] = v_delta;
        let (mut to_x, mut to_film, mut to_poured) = ([0.0; N], [0.0; N], [0.0; N]);
        for k in 0..N {
            to_x[k] = scale * dv[k];
            to_film[k] = (1.0 - DRIP) * eta * dv[k];
            to_poured[k] = (1.0 - eta + DRIP * eta) * dv[k];
        }
        to_x[X] += 1.0;
        to_x[BETA] += scale * v;
        to_film[FILM] += 1.0 - DRIP;
        to_poured[POURED] += 1.0;
        to_poured[FILM] += DRIP;

        let drip = DRIP * (self.state[FILM] + eta * v);
        self.state[X] += scale * v;
        self.state[FILM] += eta * v - drip;
        self.state[POURED] += (1.0 - eta) * v + drip;

        // P <- A P A': A differs from the identity in three rows.
        let c = &self.covariance;
        let rows = [to_x, to_film, to_poured].map(|row| {
            let mut ap = [0.0; N];
            for (factor, c_row) in row.iter().zip(c) {
                for (sum, c_kj) in ap.iter_mut().zip(c_row) {
                    *sum += factor * c_kj;
                }
            }
            ap
        });
        let mut next = *c;
        for (index, ap) in [X, FILM, POURED].into_iter().zip(&rows) {
            for k in [LAMBDA, GAMMA, BETA, DELTA] {
                next[index][k] = ap[k];
                next[k][index] = ap[k];
            }
        }
        let columns = [(X, &to_x), (FILM, &to_film), (POURED, &to_poured)];
        for (i, ap) in [X, FILM, POURED].into_iter().zip(&rows) {
            for (j, row) in columns {
                next[i][j] = dot(ap, row);
            }
        }
        next[X][X] += self.sd_x_ml * self.sd_x_ml * (1.0 + v * v);
        next[LAMBDA][LAMBDA] += self.sd_lambda * self.sd_lambda;
        self.covariance = next;
    }
}

fn dot(a: &[f64; N], b: &[f64; N]) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::flow::FlowModel;
    use proptest::prelude::*;

    const BACK: Return = Return { rate_deg: 2.0, change_deg: 1.67 };

    /// The model itself, poured: commands in, outflow a frame out.
    struct Vessel {
        flow: Flow,
        a: f64,
        x: f64,
        film: f64,
        poured: f64,
        history: [f64; HISTORY],
    }

    impl Vessel {
        fn new(onset_deg: f64) -> Self {
            let flow = Flow::new(&FlowModel::default());
            let x = flow.capacity_ml(onset_deg);
            Self { flow, a: 0.0, x, film: 0.0, poured: 0.0, history: [0.0; HISTORY] }
        }

        fn frame(&mut self, alpha_deg: f64) -> f64 {
            self.history.copy_within(1.., 0);
            self.history[HISTORY - 1] = alpha_deg;
            self.a = self.flow.tilt(self.a, self.flow.delayed(&self.history, 0, 0.0));
            let v = self.flow.over(self.a, self.x, 0.0).v_ml;
            self.x += v;
            self.film += 0.1 * v;
            let drip = DRIP * self.film;
            self.film -= drip;
            self.poured += 0.9 * v + drip;
            0.9 * v + drip
        }
    }

    /// A pour that rises, holds, and returns; the camera's gain is off by `gain`, the picture `late` frames later than the model
    /// knows. (true, camera's sum, filter), ml.
    fn pour_into(mut filter: Fused, gain: f64, late: usize) -> (f64, f64, Fused) {
        let mut vessel = Vessel::new(50.0);
        let mut seen = std::collections::VecDeque::from(vec![0.0; late]);
        let mut alpha: f64 = 0.0;
        let mut summed = 0.0;
        for k in 0..400 {
            alpha = if k < 220 { (alpha + if vessel.poured < 1.0 { 0.6 } else { 0.12 }).min(72.0) } else { (alpha - 2.0).max(0.0) };
            seen.push_back(gain * vessel.frame(alpha));
            let y = seen.pop_front().unwrap();
            summed += y;
            filter.step(Some(if y < 0.01 { 0.0 } else { y }), alpha);
        }
        (vessel.poured, summed, filter)
    }

    fn pour(gain: f64) -> (f64, f64, f64) {
        let (truth, summed, filter) = pour_into(Fused::new(Flow::new(&FlowModel::default()), BACK), gain, 0);
        (truth, summed, filter.poured_ml())
    }

    /// Protects the three explanations: each pour makes the one that fits it more likely than the pour before did: nothing changed,
    /// the camera's gain changed, the picture comes late.
    #[test]
    fn a_pour_moves_weight_to_what_explains_it() {
        let of = |gain: f64, late: usize| pour_into(Fused::new(Flow::new(&FlowModel::default()), BACK), gain, late).2.explanations();
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
        let mut wrong = FlowModel { radius_mm: 24.0, ..FlowModel::default() };
        wrong.noise.beta = 1e-3;
        let mut filter = Fused::new(Flow::new(&wrong), BACK);
        (filter.filters[1].noise.gamma, filter.filters[2].noise.beta) = (wrong.noise.gamma, wrong.noise.beta);
        let (_, summed, filter) = pour_into(filter, 1.0, 0);
        let most = CAMERA_SDS * wrong.noise.gamma * summed + CAMERA_ML;
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
        let mut vessel = Vessel::new(50.0);
        let mut filter = Fused::new(Flow::new(&FlowModel::default()), BACK);
        let mut alpha = 0.0;
        for _ in 0..118 {
            alpha += 0.5;
            let y = vessel.frame(alpha);
            filter.step(Some(if y < 0.01 { 0.0 } else { y }), alpha);
        }
        let (before, said) = (vessel.poured, filter.stop_volume_ml(alpha));
        let mut rate: f64 = 0.5;
        for _ in 0..150 {
            rate = (rate - BACK.change_deg).max(-BACK.rate_deg);
            alpha = (alpha + rate).max(0.0);
            vessel.frame(alpha);
        }
        let flowed = vessel.poured - before;
        assert!(flowed > 3.0 && (said - flowed).abs() < 0.05 * flowed + 0.1, "{said} {flowed}");
    }

    /// Protects control with a picture that comes later than the model knows: what flows until then is counted too.
    #[test]
    fn a_late_picture_means_more_is_on_its_way() {
        let flow = Flow::new(&FlowModel::default());
        let later = Flow::new(&FlowModel { delay: flow.model.delay + 2.0, ..flow.model });
        let history: [f64; HISTORY] = std::array::from_fn(|k| 50.0 + 0.5 * k as f64);
        let state = FlowState { a_deg: 54.0, x_ml: flow.capacity_ml(52.0), ..FlowState::default() };
        let volume = |flow: &Flow, late: f64| flow.stop_volume_ml(&FlowState { late, ..state }, &history, 57.5, BACK);
        let (usual, late) = (volume(&flow, 0.0), volume(&flow, 2.0));
        assert!(late > 1.1 * usual, "{usual} {late}");
        assert!((late - volume(&later, 0.0)).abs() < 1e-9);
    }

    /// Protects the volume from lost frames: the model bridges them.
    #[test]
    fn lost_frames_are_bridged() {
        let run = |lose: bool| {
            let mut vessel = Vessel::new(50.0);
            let mut filter = Fused::new(Flow::new(&FlowModel::default()), BACK);
            for k in 0..170 {
                let alpha = (0.6 * f64::from(k)).min(60.0);
                let y = vessel.frame(alpha);
                let lost = lose && (110..116).contains(&k);
                filter.step(Some(if y < 0.01 { 0.0 } else { y }).filter(|_| !lost), alpha);
            }
            (vessel.poured, filter.poured_ml())
        };
        let ((truth, all), (_, some)) = (run(false), run(true));
        assert!((all - truth).abs() < 0.02 * truth && (some - truth).abs() < 0.03 * truth, "{truth} {all} {some}");
    }

    proptest! {
        /// Protects the loop: no measurement or angle, however wild, makes the filter panic or lose its numbers.
        #[test]
        fn any_input_leaves_finite_numbers(frames in prop::collection::vec((prop::option::of(prop_oneof![any::<f64>(), 0.0f64..3.0]), prop_oneof![any::<f64>(), 0.0f64..110.0]), 1..200)) {
            let mut filter = Fused::new(Flow::new(&FlowModel::default()), BACK);
            for (y, alpha) in frames {
                filter.step(y, alpha);
                prop_assert!(filter.poured_ml().is_finite() && filter.poured_sd_ml().is_finite());
                prop_assert!(filter.stop_volume_ml(alpha.clamp(-1e6, 1e6)).is_finite());
            }
        }
    }
}
