//! The fused estimate: the stream's area and the container's geometry, combined frame by frame.
//!
//! How far the tilt must go to keep the flow alive tells how much has left, whatever the camera's gain is. An extended Kalman
//! filter on the [flow model](super::flow) weighs the two (`filter.rs`). It runs in the controller's loop and is pure: its size is
//! fixed, it does not allocate, and it does not panic. It takes about 10 kflop a frame. An impossible measurement counts as a lost frame.
//!
//! The filters start with the first frame that shows flow. Before that, only the tilt is followed.
//!
//! There are two explanations of the episodes, each with its own fit and filter: a vessel of any shape ([`WIDE`]), and one with straight walls
//! ([`TIGHT`]), whose geometry says much more. The trainer weighs them by how well they explain the episodes. The estimate is their mean by
//! these weights, kept as near to the camera's own sum as the camera's doubt and the weight of the straight vessel say:
//!
//! ```text
//! poured = clamp(pi V_tight + (1 - pi) V_wide, S +- ((k_0 + (2.5 - k_0) pi) sigma_c S + 0.5))
//! ```

use serde::{Deserialize, Serialize};

use super::filter::{Filter, UnknownsCovariance};
use super::flow::{FlowModel, FlowState, FlowTables, WayBack};
use super::tilt::{Angles, ShownTilt};
use super::{Calibration, Hold};

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
/// A larger outflow in a frame, ml, than any container gives, so that it is no measurement. Chosen by hand; no measurement is recorded.
const MEASURED_MAX_ML: f64 = 50.0;

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
    /// sigma_c: standard deviation of the camera's own sum, as a share of it.
    pub camera_sd: f64,
    /// The same from one pour to the next: the gain that a pour draws.
    pub gain_sd: f64,
    /// k_0: how far the estimate of a vessel of any shape may be from the camera's own sum, standard deviations.
    pub wide_sds: f64,
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

/// The camera's own sum of the outflow.
#[derive(Debug, Clone, Copy, Default)]
struct CameraSum {
    hold: Hold,
    sum_ml: f64,
    squares_ml2: f64,
}

impl CameraSum {
    /// Adds a frame; the dropout hold bridges what is lost.
    fn add(&mut self, calibration: &Calibration, area_px2: Option<f32>, alpha_deg: f64) {
        let area = self.hold.step(area_px2, calibration.hold_above_px2);
        let ml = f64::from(calibration.volume_ml(area, alpha_deg as f32)).min(MEASURED_MAX_ML);
        self.sum_ml += ml;
        self.squares_ml2 += ml * ml;
    }
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
    camera_sd: f64,
    gain_sd: f64,
    wide_sds: f64,
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
            camera_sd: model.camera_sd,
            gain_sd: model.gain_sd,
            wide_sds: model.wide_sds,
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
        self.angles = Angles::new();
        self.started = false;
    }

    /// Weighted mean of something over the explanations.
    fn mean(&self, of: impl Fn(&Explaining) -> f64) -> f64 {
        let [wide, tight] = &self.explaining;
        // An explanation without weight must not spoil the mean, whatever it believes.
        let share = self.tight_share;
        if share <= 0.0 { of(wide) } else { (1.0 - share) * of(wide) + share * of(tight) }
    }

    /// Volume that has left the lip as far as the pictures show, ml.
    pub fn poured_ml(&self) -> f64 {
        let sum_ml = self.camera.sum_ml;
        let sds = self.wide_sds + (CAMERA_SDS - self.wide_sds) * self.tight_share;
        let most_ml = sds * self.camera_sd * sum_ml + CAMERA_ML;
        self.mean(|e| e.filter.poured_ml()).clamp(sum_ml - most_ml, sum_ml + most_ml).max(0.0)
    }

    /// Standard deviation of [`FusedEstimator::poured_ml`], ml.
    pub fn poured_sd_ml(&self) -> f64 {
        let sum_ml = self.camera.sum_ml;
        let noise = self.explaining[WIDE].flow.model.noise.log_frame_volume_sd;
        let camera_ml2 = (self.camera_sd.hypot(self.gain_sd) * sum_ml).powi(2) + noise * noise * self.camera.squares_ml2;
        let filter_ml2 = self.explaining[TIGHT].filter.poured_variance_ml2();
        let share = self.tight_share;
        let ml2 = if share > 0.0 { share * filter_ml2 + (1.0 - share) * camera_ml2 } else { camera_ml2 };
        ml2.max(0.0).sqrt()
    }

    /// The explanation that is the likelier one.
    fn likelier(&self) -> &Explaining {
        &self.explaining[if self.tight_share > 0.5 { TIGHT } else { WIDE }]
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
        let area_px2 = frame.area_px2.filter(|a| a.is_finite() && *a >= 0.0).filter(usable);
        self.camera.add(&self.calibration, area_px2, alpha_deg);
        let begins = !self.started && area_px2.is_some_and(|a| a > 0.0);
        for Explaining { flow, calibration, unknowns, shown, filter } in &mut self.explaining {
            shown.follow(&flow.model, &self.angles);
            let tilt = shown.tilt;
            let measured_ml = area_px2.map(|a| f64::from(calibration.volume_ml(a, alpha_deg as f32)));
            match measured_ml {
                Some(measured_ml) if begins => filter.start(flow, unknowns, tilt, measured_ml),
                _ if !self.started => continue,
                measured_ml => {
                    filter.tilt(flow, tilt);
                    measured_ml.map(|measured_ml| filter.update(flow, tilt, measured_ml));
                }
            }
            filter.release(flow, tilt);
        }
        self.started |= begins;
        if !self.explaining.iter().all(|e| e.filter.is_finite()) {
            // This cannot happen with checked weights. If it does, the pour goes on as one that has not been seen yet.
            for explaining in &mut self.explaining {
                explaining.filter = Filter::new();
            }
            self.started = false;
        }
    }
}

