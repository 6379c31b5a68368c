//! The fused estimate: the stream's area and the container's geometry, combined frame by frame.
//!
//! How far the tilt must go to keep the flow alive tells how much has left, whatever the camera's gain is. An extended Kalman
//! filter on the [flow model](super::flow) weighs the two (`filter.rs`). It runs in the controller's loop and is pure: its size is
//! fixed, it does not allocate, and it does not panic. It takes about 5 kflop a frame. An impossible measurement counts as a lost frame.
//!
//! The filter starts with the first frame that shows flow. Before that, only the tilt is followed.
//!
//! Something may be off by more than the episodes showed. So there are three such filters, and each has its own explanation: all
//! is as the episodes showed; the camera or the liquid has changed; the geometry or the delay is not to be trusted. Each frame's
//! likelihood moves weight to the explanations that foresaw it (a Gaussian sum), and the estimate is their weighted mean.

use super::filter::{CAPACITY_SCALE, Drift, EXTRA_DELAY, FILM, FLOW_FACTOR, Filter, HEADSPACE, POURED, Tilt};
use super::flow::{CommandHistory, FlowNoise, FlowState, FlowTables, WayBack};

/// Number of explanations.
const EXPLANATIONS: usize = 3;
/// How likely each explanation is before anything has been seen. Tuned on rigs 100 to 123, see docs/LEARNING.md.
const PRIOR: [f64; EXPLANATIONS] = [0.6, 0.18, 0.22];
/// The least weight of an explanation, so that it can come back. Chosen by hand; no measurement is recorded.
const WEIGHT_MIN: f64 = 1e-6;
/// Share of a frame's log-likelihood that counts, because frames are less independent than the filters believe. Tuned on rigs 100
/// to 123, see docs/LEARNING.md.
const TEMPER: f64 = 0.5;

/// The estimate stays within this many standard deviations of the camera's gain from the camera's own sum. Tuned on rigs 100 to
/// 123, see docs/LEARNING.md.
const CAMERA_SDS: f64 = 2.5;
/// The estimate may be this much further from the camera's own sum in any case, ml. Tuned on rigs 100 to 123, see docs/LEARNING.md.
const CAMERA_ML: f64 = 1.5;

/// A larger outflow in a frame, ml, than any container gives, so that it is no measurement. Chosen by hand; no measurement is recorded.
const MEASURED_MAX_ML: f64 = 50.0;
/// Commanded angles outside of this range are cut to it, degrees. Chosen by hand: no cell tilts that far.
const COMMAND_RANGE_DEG: (f64, f64) = (-30.0, 200.0);

/// How much a frame may change what the model does not describe, where all is as the episodes showed. From the prototype's filter,
/// tuned on rigs 100 to 123, see docs/LEARNING.md.
const USUAL_DRIFT: Drift = Drift { headspace_sd_ml: 0.05, log_flow_factor_sd: 0.007 };
/// The same as [`USUAL_DRIFT`] where the geometry or the delay is not to be trusted. Tuned on rigs 100 to 123, see docs/LEARNING.md.
const DISTRUSTED_DRIFT: Drift = Drift { headspace_sd_ml: 0.2, log_flow_factor_sd: 0.02 };

/// The noise to allow for where the camera or the liquid has changed, from the usual noise. Tuned on rigs 100 to 123, see docs/LEARNING.md.
fn noise_if_changed(usual: FlowNoise) -> FlowNoise {
    FlowNoise { log_camera_gain_sd: (3.0 * usual.log_camera_gain_sd).max(0.1), log_flow_factor_sd: 2.0 * usual.log_flow_factor_sd, ..usual }
}

/// The noise to allow for where the geometry or the delay is not to be trusted, from the usual noise. Tuned on rigs 100 to 123, see
/// docs/LEARNING.md.
fn noise_if_distrusted(usual: FlowNoise) -> FlowNoise {
    FlowNoise { log_capacity_scale_sd: (5.0 * usual.log_capacity_scale_sd).max(0.1), extra_delay_sd_frames: 1.5, ..usual }
}

/// One explanation of what is seen.
#[derive(Debug, Clone)]
struct Explanation {
    filter: Filter,
    /// How likely it is; the weights of all add up to 1.
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
    /// Adds a frame. A lost frame, or a single zero after a frame with flow, repeats the newest outflow.
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
    explanations: [Explanation; EXPLANATIONS],
    camera: CameraSum,
    /// Whether flow has been seen.
    started: bool,
    /// Whether this pour has had a frame yet.
    followed: bool,
    history: CommandHistory,
    tilt: Tilt,
}

impl FusedEstimator {
    /// An estimator for a pour to come.
    pub fn new(flow: FlowTables, way_back: WayBack) -> Self {
        let noise = flow.model.noise;
        let filters = [
            Filter::new(noise, USUAL_DRIFT),
            Filter::new(noise_if_changed(noise), USUAL_DRIFT),
            Filter::new(noise_if_distrusted(noise), DISTRUSTED_DRIFT),
        ];
        let mut estimator = Self {
            flow,
            way_back,
            explanations: filters.map(|filter| Explanation { filter, weight: 0.0 }),
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
        for (explanation, prior) in self.explanations.iter_mut().zip(PRIOR) {
            explanation.filter.restart();
            explanation.weight = prior;
        }
        self.camera = CameraSum::default();
        self.started = false;
        self.followed = false;
    }

    /// Weighted mean of one of the states over the explanations.
    fn mean(&self, state: usize) -> f64 {
        self.explanations.iter().map(|e| e.weight * e.filter.state[state]).sum()
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
        self.explanations
            .iter()
            .map(|Explanation { filter, weight }| weight * (filter.covariance[POURED][POURED] + (filter.state[POURED] - mean).powi(2)))
            .sum::<f64>()
            .max(0.0)
            .sqrt()
    }

    /// What the filters believe about the liquid.
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
            for explanation in &mut self.explanations {
                explanation.filter.start(&self.flow, self.tilt, first_ml);
            }
        }
        for explanation in &mut self.explanations {
            explanation.filter.propagate(&self.flow, self.tilt);
        }
        if !self.explanations.iter().all(|e| e.weight.is_finite() && e.filter.is_finite()) {
            // This cannot happen with checked weights. If it does, the pour goes on as one that has not been seen yet.
            self.restart();
        }
    }

    /// Gives a measurement to all filters, and weight to those that foresaw it.
    fn update(&mut self, measured_ml: f64) {
        let log_likelihoods = self.explanations.each_mut().map(|e| e.filter.update(&self.flow, self.tilt, measured_ml));
        // A zero may be a dropout: it tells the filters what to believe, but not which of them to believe.
        let log_likelihoods = if measured_ml > 0.0 { log_likelihoods } else { [0.0; EXPLANATIONS] };
        let most = log_likelihoods.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        let mut total = 0.0;
        for (explanation, log_likelihood) in self.explanations.iter_mut().zip(log_likelihoods) {
            explanation.weight = (explanation.weight * (TEMPER * (log_likelihood - most)).exp()).max(WEIGHT_MIN);
            total += explanation.weight;
        }
        for explanation in &mut self.explanations {
            explanation.weight /= total;
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimator::flow::FlowModel;
    use crate::estimator::vessel::Vessel;
    use proptest::prelude::*;

    const BACK: WayBack = WayBack { rate_deg: 2.0, change_deg: 1.67 };

    /// A vessel that pours exactly as the model says: it takes commands, and gives the outflow of each frame.
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

    /// A pour whose tilt rises, holds, and returns. The camera's gain is off by the factor `gain`, and the picture comes `late` frames
    /// later than the model knows. Gives the true volume and the camera's sum, ml, and the filter.
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

    /// Protects the three explanations: each pour gives more weight to the one that fits it than the other pours do. In the first nothing
    /// has changed, in the second the camera's gain has, and in the third the picture comes late.
    #[test]
    fn a_pour_moves_weight_to_what_explains_it() {
        let of = |gain: f64, late: usize| {
            pour_into(FusedEstimator::new(FlowTables::new(&FlowModel::default()), BACK), gain, late).2.explanations.map(|e| e.weight)
        };
        let (usual, gain, late) = (of(1.0, 0), of(1.25, 0), of(1.0, 3));
        assert!(usual[0] > PRIOR[0] && usual[0] > gain[0] && usual[0] > late[0], "{usual:?}");
        assert!(gain[1] > 2.0 * usual[1] && gain[1] > late[1], "{usual:?} {gain:?} {late:?}");
        assert!(late[2] > 2.0 * usual[2] && late[2] > gain[2], "{usual:?} {gain:?} {late:?}");
        for weights in [usual, gain, late] {
            assert!((weights.iter().sum::<f64>() - 1.0).abs() < 1e-9);
        }
    }

    /// Protects the volume from a geometry that is wrong but trusted: the estimate stays near the camera's own sum.
    #[test]
    fn the_estimate_stays_near_the_cameras_sum() {
        let mut wrong = FlowModel { vessel: Vessel { radius_mm: 24.0, ..Vessel::default() }, ..FlowModel::default() };
        wrong.noise.log_capacity_scale_sd = 1e-3;
        let mut filter = FusedEstimator::new(FlowTables::new(&wrong), BACK);
        filter.explanations[1].filter.noise.log_camera_gain_sd = wrong.noise.log_camera_gain_sd;
        filter.explanations[2].filter.noise.log_capacity_scale_sd = wrong.noise.log_capacity_scale_sd;
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
            // A gain of two standard deviations leaves less than the camera's whole error, and the right gain less than 0.5 %.
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

    /// Protects the volume where frames are lost: the model bridges them.
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
