//! The fused estimate: the stream's area and the container's geometry, combined frame by frame.
//!
//! How far the tilt must go to keep the flow alive tells how much has left, whatever the camera's gain is. An extended Kalman
//! filter on the [flow model](super::flow) weighs the two (`filter.rs`). It runs in the controller's loop and is pure: its size is
//! fixed, it does not allocate, and it does not panic. It takes about 10 kflop a frame. An impossible measurement counts as a lost frame.
//!
//! The filters start with the first frame that shows flow. Before that, only the tilt is followed.
//!
//! There are two explanations of the episodes, each with its own fit and filter: a vessel of any shape ([`WIDE`]), and one with straight walls
//! ([`TIGHT`]), whose geometry says much more. The estimate is the camera's own sum S, corrected by the straight vessel as far as that is
//! trusted:
//!
//! ```text
//! poured = S + s clip(V_tight - S, +- (2.5 sd_S + 0.5));  s = pi t(r)
//! ```
//!
//! pi is the weight that the trainer gives to the straight vessel. r is the correlation of a frame's innovation with the one before it: where a
//! model is right, what is left over is noise, and r is 0; where it is wrong, r grows, and t falls from 1 to 0. The vessel of any shape says
//! what cannot be (`verdict.rs`), and how much still flows where the straight one is not trusted.

use serde::{Deserialize, Serialize};

use super::Calibration;
use super::camera_sum::{CameraSum, MEASURED_MAX_ML};
use super::filter::{Filter, UnknownsCovariance};
use super::flow::{FlowModel, FlowState, FlowTables, WayBack};
use super::tilt::{Angles, ShownTilt};
use super::verdict::{Bounds, Impossible, Watch};
use super::whiteness::Whiteness;

/// Index of the explanation by a vessel of any shape.
pub const WIDE: usize = 0;
/// Index of the explanation by a vessel with straight walls.
pub const TIGHT: usize = 1;
/// Number of explanations.
pub const EXPLANATIONS: usize = 2;

/// The estimate of a straight vessel stays within this many standard deviations of the camera's own sum. From the prototype, which tuned it on
/// simulated rigs; no other measurement is recorded.
const CAMERA_SDS: f64 = 2.5;
/// Any estimate may be this far from the camera's own sum, ml. From the prototype; no other measurement is recorded.
const CAMERA_ML: f64 = 0.5;
/// Share of the deviation that the filter finds by itself: the fit tempers the frames, so it doubts too much. On rigs 100 to 107 of simulator b,
/// 76 % of the pours from cylinders were within 0.8 of it.
const DEVIATION_SHARE: f64 = 0.72;

/// What an explanation knows before a pour.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Explanation {
    /// The fitted flow model.
    pub model: FlowModel,
    /// The calibration that was fitted with it.
    pub calibration: Calibration,
    /// How far a pour may be off both.
    pub unknowns: UnknownsCovariance,
}

/// The model of a fused estimate.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FusedModel {
    /// The explanations, [`WIDE`] and [`TIGHT`].
    pub explanations: [Explanation; EXPLANATIONS],
    /// pi: the weight of the straight vessel, 0 to 1.
    pub tight_share: f64,
    /// Covariance of log c and q of the calibration of the camera's own sum.
    pub camera: [[f64; 2]; 2],
    /// Standard deviation of the camera's gain from one pour to the next (log).
    pub gain_sd: f64,
    /// What the episodes showed at most.
    pub bounds: Bounds,
}

impl FusedModel {
    /// The explanation that is the likelier one.
    pub fn likelier(&self) -> &Explanation {
        &self.explanations[if self.tight_share > 0.5 { TIGHT } else { WIDE }]
    }
}

/// An explanation at work.
#[derive(Debug, Clone)]
struct Explaining {
    flow: FlowTables,
    calibration: Calibration,
    unknowns: UnknownsCovariance,
    shown: ShownTilt,
    filter: Filter,
}

/// One frame, as the fused estimate takes it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FusedFrame {
    /// V_e, px^2; `None` if the frame was lost.
    pub area_px2: Option<f32>,
    /// Commanded tilt when it was taken, degrees.
    pub command_deg: f64,
    /// Measured tilt when it was taken, degrees; NaN if it is not known.
    pub measured_deg: f64,
}

/// The fused estimate of one pour.
#[derive(Debug, Clone)]
pub struct FusedEstimator {
    calibration: Calibration,
    way_back: WayBack,
    explaining: [Explaining; EXPLANATIONS],
    tight_share: f64,
    camera_covariance: [[f64; 2]; 2],
    gain_sd: f64,
    bounds: Bounds,
    watch: Watch,
    whiteness: Whiteness,
    camera: CameraSum,
    angles: Angles,
    /// Whether flow has been seen.
    started: bool,
}

impl FusedEstimator {
    /// An estimator for a pour to come; `calibration` is that of the camera's own sum.
    pub fn new(model: &FusedModel, calibration: &Calibration, way_back: WayBack) -> Self {
        let explaining = model.explanations.each_ref().map(|e| Explaining {
            flow: FlowTables::new(&e.model),
            calibration: e.calibration,
            unknowns: e.unknowns,
            shown: ShownTilt::new(),
            filter: Filter::new(),
        });
        Self {
            calibration: *calibration,
            way_back,
            explaining,
            tight_share: model.tight_share,
            camera_covariance: model.camera,
            gain_sd: model.gain_sd,
            bounds: model.bounds,
            watch: Watch::default(),
            whiteness: Whiteness::default(),
            camera: CameraSum::default(),
            angles: Angles::new(),
            started: false,
        }
    }

    /// Forgets the pour.
    pub fn restart(&mut self) {
        for explaining in &mut self.explaining {
            explaining.filter = Filter::new();
            explaining.shown = ShownTilt::new();
        }
        self.camera = CameraSum::default();
        self.watch = Watch::default();
        self.whiteness = Whiteness::default();
        self.angles = Angles::new();
        self.started = false;
    }

    /// How much the straight vessel counts now, 0 to 1.
    fn share(&self) -> f64 {
        if self.tight_share > 0.0 { self.tight_share * self.whiteness.trust() } else { 0.0 }
    }

    /// How white the straight vessel's innovations are so far.
    pub fn whiteness(&self) -> Whiteness {
        self.whiteness
    }

    /// Standard deviation of the camera's own sum, ml.
    fn camera_sd_ml(&self) -> f64 {
        let frame_sd = self.explaining[WIDE].flow.model.noise.log_frame_volume_sd;
        self.camera.sd_ml(&self.camera_covariance, self.gain_sd, frame_sd)
    }

    /// What the straight vessel adds to the camera's own sum if it is trusted, ml.
    fn correction_ml(&self) -> f64 {
        let most_ml = CAMERA_SDS * self.camera_sd_ml() + CAMERA_ML;
        (self.explaining[TIGHT].filter.poured_ml() - self.camera.sum_ml).clamp(-most_ml, most_ml)
    }

    /// Volume that has left the lip as far as the pictures show, ml.
    pub fn poured_ml(&self) -> f64 {
        let share = self.share();
        // An explanation without weight must not spoil the sum, whatever it believes.
        let correction_ml = if share > 0.0 { share * self.correction_ml() } else { 0.0 };
        (self.camera.sum_ml + correction_ml).max(0.0)
    }

    /// Standard deviation of [`FusedEstimator::poured_ml`], ml: that of the two estimates' mixture, whose difference counts too.
    pub fn poured_sd_ml(&self) -> f64 {
        let (share, camera_ml) = (self.share(), self.camera_sd_ml());
        if share <= 0.0 {
            return camera_ml;
        }
        let filter_ml2 = DEVIATION_SHARE * DEVIATION_SHARE * self.explaining[TIGHT].filter.poured_variance_ml2();
        let apart_ml2 = share * (1.0 - share) * self.correction_ml().powi(2);
        (share * filter_ml2 + (1.0 - share) * camera_ml * camera_ml + apart_ml2).max(0.0).sqrt()
    }

    /// Whether what was seen cannot be.
    pub fn impossible(&self) -> Option<Impossible> {
        self.watch.verdict()
    }

    /// The explanation that is the likelier one.
    fn likelier(&self) -> &Explaining {
        &self.explaining[if self.share() > 0.5 { TIGHT } else { WIDE }]
    }

    /// What the likelier explanation believes about the liquid, in the camera's ml.
    pub fn flow_state(&self) -> FlowState {
        let Explaining { flow, shown, filter, .. } = self.likelier();
        filter.flow_state(flow, shown.tilt)
    }

    /// Volume that still leaves if the way back starts now, ml; 0 before any flow. `now_deg` is the command in force.
    pub fn stop_volume_ml(&self, now_deg: f64) -> f64 {
        if !self.started {
            return 0.0;
        }
        let Explaining { flow, filter, .. } = self.likelier();
        filter.true_per_seen() * flow.stop_volume_ml(&self.flow_state(), &self.angles.commanded, now_deg, self.way_back)
    }

    /// Takes one frame.
    pub fn step(&mut self, frame: FusedFrame) {
        self.angles.push(frame.command_deg, frame.measured_deg);
        let alpha_deg = self.angles.commanded.newest_deg();
        let usable = |a: &f32| f64::from(self.calibration.volume_ml(*a, alpha_deg as f32)) <= MEASURED_MAX_ML;
        let [wide, _] = &mut self.explaining;
        wide.shown.follow(&wide.flow.model, &self.angles);
        let area_px2 = frame.area_px2.filter(|a| a.is_finite() && *a >= 0.0);
        let may_be = self.watch.may_be(&self.bounds, area_px2, wide.shown.tilt.tilt_deg);
        let area_px2 = area_px2.filter(|a| may_be && usable(a));
        let begins = !self.started && area_px2.is_some_and(|a| a > 0.0);
        let mut innovations = [None; EXPLANATIONS];
        for (k, Explaining { flow, calibration, unknowns, shown, filter }) in self.explaining.iter_mut().enumerate() {
            if k != WIDE {
                shown.follow(&flow.model, &self.angles);
            }
            let tilt = shown.tilt;
            let measured_ml = area_px2.map(|a| f64::from(calibration.volume_ml(a, alpha_deg as f32)));
            match measured_ml {
                Some(measured_ml) if begins => filter.start(flow, unknowns, tilt, measured_ml),
                _ if !self.started => continue,
                measured_ml => {
                    filter.tilt(flow, tilt);
                    innovations[k] = measured_ml.and_then(|measured_ml| filter.update(flow, tilt, measured_ml));
                }
            }
            filter.release(flow, tilt);
        }
        self.whiteness.add(innovations[TIGHT]);
        let leaps = self.watch.foreseen(innovations[WIDE]);
        self.camera.add(&self.calibration, area_px2.filter(|_| !leaps), alpha_deg);
        self.started |= begins;
        if self.started {
            let Explaining { flow, calibration, unknowns, shown, .. } = &self.explaining[WIDE];
            let seen_ml = area_px2.filter(|_| !leaps).map(|a| f64::from(calibration.volume_ml(a, alpha_deg as f32)));
            self.watch.balance(flow, unknowns, shown.tilt, seen_ml);
        }
        if !self.explaining.iter().all(|e| e.filter.is_finite()) {
            // This cannot happen with checked weights. If it does, the pour goes on as one that has not been seen yet.
            for explaining in &mut self.explaining {
                explaining.filter = Filter::new();
            }
            self.started = false;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimator::filter::UNKNOWNS;
    use crate::estimator::flow::{CommandHistory, Lateness};
    use crate::estimator::vessel::Vessel;
    use proptest::prelude::*;

    const BACK: WayBack = WayBack { rate_deg: 2.0, change_deg: 1.67 };
    const CAMERA: Calibration = Calibration { volume_at_1_px2_ml: 0.002, area_exponent: 1.0, log_tilt_slope: 0.0, hold_above_px2: 60.0 };

    /// A model of the default vessel, with this weight of the straight one.
    fn model(tight_share: f64) -> FusedModel {
        let mut unknowns = [[0.0; UNKNOWNS]; UNKNOWNS];
        for (k, row) in unknowns.iter_mut().enumerate() {
            row[k] = [0.15f64, 0.04, 0.3].get(k).copied().unwrap_or(0.01).powi(2);
            for (j, value) in row.iter_mut().enumerate() {
                if j != k && (k == 1 || j == 1) && (k > 2 || j > 2) {
                    *value = 0.04 * 0.04;
                }
            }
        }
        for (i, j) in (3..UNKNOWNS).flat_map(|i| (3..UNKNOWNS).map(move |j| (i, j))) {
            unknowns[i][j] = 0.04 * 0.04 + if i == j { 0.01 * 0.01 } else { 0.0 };
        }
        let explanation = Explanation { model: FlowModel::default(), calibration: CAMERA, unknowns };
        let bounds = Bounds { most_px2: 4000.0, dry_deg: 90.0 };
        FusedModel { explanations: [explanation; 2], tight_share, camera: [[0.04 * 0.04, 0.0], [0.0, 0.0]], gain_sd: 0.015, bounds }
    }

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

    fn frame(outflow_ml: f64, command_deg: f64) -> FusedFrame {
        let area = (outflow_ml / f64::from(CAMERA.volume_at_1_px2_ml)) as f32;
        FusedFrame { area_px2: Some(if area < 5.0 { 0.0 } else { area }), command_deg, measured_deg: f64::NAN }
    }

    /// A pour whose tilt rises, holds, and returns; the camera's gain is off by the factor `gain`. Gives the true volume and the camera's sum,
    /// ml, and the estimator.
    fn pour_into(mut fused: FusedEstimator, gain: f64) -> (f64, f64, FusedEstimator) {
        let mut vessel = ModelVessel::new(50.0);
        let (mut alpha, mut summed): (f64, f64) = (0.0, 0.0);
        for k in 0..400 {
            alpha = if k < 220 { (alpha + if vessel.poured_ml < 1.0 { 0.6 } else { 0.12 }).min(72.0) } else { (alpha - 2.0).max(0.0) };
            let y = gain * vessel.frame(alpha);
            summed += y;
            fused.step(frame(y, alpha));
        }
        (vessel.poured_ml, summed, fused)
    }

    fn new(model: &FusedModel) -> FusedEstimator {
        FusedEstimator::new(model, &CAMERA, BACK)
    }

    /// Protects the point of fusing: geometry corrects a camera whose gain is off, which the sum cannot.
    #[test]
    fn geometry_corrects_the_cameras_gain() {
        for gain in [0.95, 1.0, 1.05] {
            let (truth, summed, fused) = pour_into(new(&model(1.0)), gain);
            assert!(truth > 60.0 && fused.impossible().is_none(), "{truth}");
            let off = (fused.poured_ml() - truth).abs();
            assert!(off < 0.8 * (summed - truth).abs() + 0.005 * truth, "gain {gain}: {truth} {summed} {}", fused.poured_ml());
        }
    }

    /// Protects the volume from a geometry that is wrong but trusted: the estimate stays near the camera's own sum.
    #[test]
    fn the_estimate_stays_near_the_cameras_sum() {
        for tight_share in [0.0, 0.5, 1.0] {
            let mut wrong = model(tight_share);
            for e in &mut wrong.explanations {
                e.model.vessel = Vessel { radius_mm: 24.0, ..Vessel::default() };
                e.unknowns.iter_mut().skip(3).for_each(|row| row[3..].fill(0.0));
            }
            let (_, summed, fused) = pour_into(new(&wrong), 1.0);
            let most = tight_share * (CAMERA_SDS * fused.camera_sd_ml() + CAMERA_ML);
            assert!((fused.poured_ml() - summed).abs() < most + 0.3, "{} {summed} {most}", fused.poured_ml());
        }
    }

    /// Protects control: what the filter says still flows on the way back is what then flows.
    #[test]
    fn the_stop_volume_is_what_still_flows() {
        let mut vessel = ModelVessel::new(50.0);
        let mut fused = new(&model(1.0));
        let mut alpha = 0.0;
        for _ in 0..118 {
            alpha += 0.5;
            fused.step(frame(vessel.frame(alpha), alpha));
        }
        let (before, said) = (vessel.poured_ml, fused.stop_volume_ml(alpha));
        let mut rate: f64 = 0.5;
        for _ in 0..150 {
            rate = (rate - BACK.change_deg).max(-BACK.rate_deg);
            alpha = (alpha + rate).max(0.0);
            vessel.frame(alpha);
        }
        let flowed = vessel.poured_ml - before;
        assert!(flowed > 3.0 && (said - flowed).abs() < 0.05 * flowed + 0.1, "{said} {flowed}");
    }

    /// Protects the volume where the joint is slower than it was at training: what counts is where it is, not where it was commanded.
    #[test]
    fn the_measured_tilt_counts() {
        let mut known = model(1.0);
        for e in &mut known.explanations {
            e.model.measured = Some(Lateness { lag_frames: 0.0, delay_frames: 0.0 });
        }
        let still_ml = |measured: bool| {
            let (mut vessel, mut fused) = (ModelVessel::new(50.0), new(&known));
            for k in 0..150 {
                let alpha = f64::from(k) * 0.4;
                let y = vessel.frame((alpha - 5.0).max(0.0));
                let measured_deg = if measured { vessel.state.tilt_deg } else { f64::NAN };
                fused.step(FusedFrame { measured_deg, ..frame(y, alpha) });
            }
            (fused.flow_state().tilt_deg - vessel.state.tilt_deg).abs()
        };
        assert!(still_ml(true) < 0.7 && still_ml(false) > 3.0, "{} {}", still_ml(true), still_ml(false));
    }

    /// Protects the volume where frames are lost, or one shows a spike: the model bridges them.
    #[test]
    fn lost_frames_and_spikes_are_bridged() {
        let run = |odd: Option<f32>, from: usize, to: usize| {
            let (mut vessel, mut fused) = (ModelVessel::new(50.0), new(&model(0.5)));
            for k in 0..170 {
                let alpha = (0.6 * k as f64).min(60.0);
                let shown = frame(vessel.frame(alpha), alpha);
                fused.step(if (from..to).contains(&k) { FusedFrame { area_px2: odd, ..shown } } else { shown });
            }
            assert!(fused.impossible().is_none());
            (vessel.poured_ml, fused.poured_ml())
        };
        let (truth, all) = run(None, 0, 0);
        assert!((all - truth).abs() < 0.02 * truth + 0.3, "{truth} {all}");
        for (odd, to) in [(None, 116), (Some(1e5), 111), (Some(2500.0), 111), (Some(0.0), 111)] {
            let (_, some) = run(odd, 110, to);
            assert!((some - all).abs() < 0.5, "{odd:?}: {all} {some}");
        }
    }

    /// Protects the goal from a camera that shows something else than the stream: it is noticed before much is poured.
    #[test]
    fn what_cannot_be_is_noticed() {
        for stuck in [0.0f32, 90.0, 600.0, 1e5] {
            let (mut vessel, mut fused) = (ModelVessel::new(50.0), new(&model(0.5)));
            let mut alpha: f64 = 0.0;
            while fused.impossible().is_none() && alpha < 110.0 {
                alpha += 0.6;
                vessel.frame(alpha);
                fused.step(FusedFrame { area_px2: Some(stuck), ..frame(0.0, alpha) });
            }
            let expected = if stuck == 0.0 { Impossible::NoFlow } else { Impossible::Flow };
            assert_eq!(fused.impossible(), Some(expected), "{stuck}");
            assert!(stuck == 0.0 || vessel.poured_ml < 10.0, "{stuck}: {} ml", vessel.poured_ml);
        }
    }

    proptest! {
        /// Protects the loop: no measurement or angle, however wild, makes the filter panic or lose its numbers.
        #[test]
        fn any_input_leaves_finite_numbers(
            frames in prop::collection::vec((
                prop::option::of(prop_oneof![any::<f32>(), 0.0f32..1500.0]),
                prop_oneof![any::<f64>(), 0.0f64..110.0],
                prop_oneof![any::<f64>(), 0.0f64..110.0],
            ), 1..200),
            share in 0.0f64..=1.0,
        ) {
            let mut fused = new(&model(share));
            for (area_px2, command_deg, measured_deg) in frames {
                fused.step(FusedFrame { area_px2, command_deg, measured_deg });
                prop_assert!(fused.poured_ml().is_finite() && fused.poured_sd_ml().is_finite());
                prop_assert!(fused.stop_volume_ml(command_deg.clamp(-1e6, 1e6)).is_finite());
            }
        }
    }
}
