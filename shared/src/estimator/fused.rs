//! The fused estimate: the stream's area and the container's geometry, combined frame by frame.
//!
//! How far the tilt must go to keep the flow alive tells how much has left, whatever the camera's gain is. An extended Kalman
//! filter on the [flow model](super::flow) weighs the two (`filter.rs`). It runs in the controller's loop and is pure: its size is
//! fixed, it does not allocate, and it does not panic. It takes about 10 kflop a frame. An impossible measurement counts as a lost frame.
//!
//! The filters start with the second frame in a row that shows flow. Before that, only the tilt is followed.
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
pub use super::filter::{EXPLANATIONS, TIGHT, WIDE};
use super::filter::{Filter, Innovation, UnknownsCovariance};
use super::flow::{FlowModel, FlowState, FlowTables, WayBack};
use super::tilt::{Angles, ShownTilt};
use super::trust;
use super::verdict::{Bounds, Impossible, Leap, Watch};
use super::whiteness::Whiteness;

/// The estimate of a straight vessel stays within this many standard deviations of the camera's own sum. From the prototype, which tuned it on
/// simulated rigs; no other measurement is recorded.
const CAMERA_SDS: f64 = 2.5;
/// Any estimate may be this far from the camera's own sum, ml. From the prototype; no other measurement is recorded.
const CAMERA_ML: f64 = 0.5;
/// Share of the deviation that the filter finds by itself: the fit tempers the frames, so it doubts too much. On rigs 100 to 107 of simulator b,
/// 76 % of the pours from cylinders were within 0.8 of it.
const DEVIATION_SHARE: f64 = 0.72;

/// From this weight on, the trainer's, the balance of the straight vessel counts: it is the likelier one.
const STRAIGHT_SHARE: f64 = 0.5;

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

/// An explanation, ready to work.
#[derive(Debug, Clone)]
struct Explaining {
    flow: FlowTables,
    calibration: Calibration,
    unknowns: UnknownsCovariance,
}

/// An explanation of the pour under way.
#[derive(Debug, Clone, Default)]
struct Following {
    shown: ShownTilt,
    filter: Filter,
}

/// What is known of the pour under way.
#[derive(Debug, Clone, Default)]
struct Pour {
    following: [Following; EXPLANATIONS],
    watch: Watch,
    whiteness: Whiteness,
    camera: CameraSum,
    angles: Angles,
    /// Whether the newest picture showed flow.
    flowed: bool,
    /// Whether flow has been seen.
    started: bool,
}

/// One frame, as the fused estimate takes it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FusedFrame {
    /// V_e, px^2; `None` if the frame was lost.
    pub area_px2: Option<f32>,
    /// Confidence of the area, 0 to 1: the share of such areas that are within 20 % of the truth. NaN, where no camera says it, weighs in full.
    pub confidence: f32,
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
    pour: Pour,
}

impl FusedEstimator {
    /// An estimator for a pour to come at `rate_hz` frames a second; `calibration` is that of the camera's own sum.
    pub fn new(model: &FusedModel, calibration: &Calibration, way_back: WayBack, rate_hz: f64) -> Self {
        let explaining = model.explanations.each_ref().map(|e| Explaining {
            flow: FlowTables::new(&e.model, rate_hz),
            calibration: e.calibration,
            unknowns: e.unknowns,
        });
        Self {
            calibration: *calibration,
            way_back,
            explaining,
            tight_share: model.tight_share,
            camera_covariance: model.camera,
            gain_sd: model.gain_sd,
            bounds: model.bounds,
            pour: Pour::default(),
        }
    }

    /// Forgets the pour.
    pub fn restart(&mut self) {
        self.pour = Pour::default();
    }

    /// How much the straight vessel counts now, 0 to 1; not before its filter has begun, as it knows nothing then.
    fn share(&self) -> f64 {
        if self.pour.started && self.tight_share > 0.0 { self.tight_share * self.pour.whiteness.trust() } else { 0.0 }
    }

    /// How white the straight vessel's innovations are so far.
    pub fn whiteness(&self) -> Whiteness {
        self.pour.whiteness
    }

    /// Standard deviation of the camera's own sum, ml.
    fn camera_sd_ml(&self) -> f64 {
        let frame_sd = self.explaining[WIDE].flow.model.noise.log_frame_volume_sd;
        self.pour.camera.sd_ml(&self.camera_covariance, self.gain_sd, frame_sd)
    }

    /// What the straight vessel adds to the camera's own sum if it is trusted, ml.
    fn correction_ml(&self) -> f64 {
        let most_ml = CAMERA_SDS * self.camera_sd_ml() + CAMERA_ML;
        (self.pour.following[TIGHT].filter.poured_ml() - self.pour.camera.sum_ml).clamp(-most_ml, most_ml)
    }

    /// Volume that has left the lip as far as the pictures show, ml.
    pub fn poured_ml(&self) -> f64 {
        let share = self.share();
        // An explanation without weight must not spoil the sum, whatever it believes.
        let correction_ml = if share > 0.0 { share * self.correction_ml() } else { 0.0 };
        (self.pour.camera.sum_ml + correction_ml).max(0.0)
    }

    /// By how many standard deviations the straight vessel, where the trainer trusts it, looks larger or smaller in this pour than was learned: another vessel,
    /// or another gain of the camera.
    fn other_vessel_sds(&self) -> f64 {
        if self.tight_share > STRAIGHT_SHARE {
            self.pour.following[TIGHT].filter.other_vessel_sds(&self.explaining[TIGHT].unknowns)
        } else {
            0.0
        }
    }

    /// Standard deviation of [`FusedEstimator::poured_ml`], ml: that of the two estimates' mixture, whose difference counts too, and what the
    /// tilt has let out but was not seen, or the reverse, what may have left behind areas that are doubtful in themselves, and what was withheld and
    /// never confirmed. Where the straight vessel is held near the sum, the part of its correction that is refused counts as well: one of the two is wrong.
    /// Where the two estimates are further apart than their deviations explain, the straight vessel's deviation grows by that ratio (Birge's), and what
    /// it corrects of an outflow that left while the container lay counts as well. Where the vessel looks like another one by more than its deviation, so that
    /// nobody knows whether vessel or camera changed, the whole grows by that ratio, too.
    pub fn poured_sd_ml(&self) -> f64 {
        let (share, camera_ml) = (self.share(), self.camera_sd_ml());
        let estimate_ml2 = if share > 0.0 {
            let filter_ml2 = DEVIATION_SHARE * DEVIATION_SHARE * self.pour.following[TIGHT].filter.poured_variance_ml2();
            let (correction_ml, apart_ml) = (self.correction_ml(), self.pour.following[TIGHT].filter.poured_ml() - self.pour.camera.sum_ml);
            let filter_ml2 = filter_ml2 * (apart_ml.powi(2) / (camera_ml * camera_ml + filter_ml2)).max(1.0);
            let (refused_ml, lying_ml) = (apart_ml - correction_ml, self.pour.camera.lying_share() * correction_ml);
            let mixed_ml2 = share * (1.0 - share) * correction_ml.powi(2);
            share * (filter_ml2 + refused_ml.powi(2) + lying_ml.powi(2)) + (1.0 - share) * camera_ml * camera_ml + mixed_ml2
        } else {
            camera_ml * camera_ml
        };
        let estimate_ml2 = estimate_ml2 * self.other_vessel_sds().max(1.0).powi(2);
        let Pour { watch, .. } = &self.pour;
        let unseen_ml2 = watch.unexplained_ml().powi(2) + watch.unshown_ml().powi(2);
        let withheld_ml = watch.unconfirmed_ml() + watch.lone_ml(share > STRAIGHT_SHARE);
        (estimate_ml2.max(0.0) + unseen_ml2 + withheld_ml * withheld_ml).sqrt()
    }

    /// Whether what was seen cannot be.
    pub fn impossible(&self) -> Option<Impossible> {
        self.pour.watch.verdict()
    }

    /// The explanation that is the likelier one, and how it follows the pour.
    fn likelier(&self) -> (&Explaining, &Following) {
        let index = if self.share() > 0.5 { TIGHT } else { WIDE };
        (&self.explaining[index], &self.pour.following[index])
    }

    /// What the likelier explanation believes about the liquid, in the camera's ml.
    pub fn flow_state(&self) -> FlowState {
        let (Explaining { flow, .. }, Following { shown, filter }) = self.likelier();
        filter.flow_state(flow, shown.tilt)
    }

    /// Volume that still leaves if the way back starts now, ml; 0 before any flow. `now_deg` is the command in force.
    pub fn stop_volume_ml(&self, now_deg: f64) -> f64 {
        if !self.pour.started {
            return 0.0;
        }
        let (Explaining { flow, .. }, Following { filter, .. }) = self.likelier();
        filter.true_per_seen() * flow.stop_volume_ml(&self.flow_state(), &self.pour.angles.commanded, now_deg, self.way_back)
    }

    /// Takes one frame. Returns whether its area is believed to be a measurement.
    pub fn step(&mut self, frame: FusedFrame) -> bool {
        let Pour { following, watch, whiteness, camera, angles, flowed, started } = &mut self.pour;
        angles.push(frame.command_deg, frame.measured_deg);
        let alpha_deg = angles.commanded.newest_deg();
        for (Explaining { flow, .. }, Following { shown, .. }) in self.explaining.iter().zip(following.iter_mut()) {
            shown.follow(flow, angles);
        }
        let area_px2 = frame.area_px2.filter(|a| a.is_finite() && *a >= 0.0);
        let may_be = watch.may_be(&self.bounds, area_px2, following[WIDE].shown.tilt.tilt_deg);
        let (taught_px2, volume_ml) = (self.bounds.taught_px2(), |a: f32| f64::from(self.calibration.volume_ml(a, alpha_deg as f32)));
        let area_px2 = area_px2.filter(|a| may_be && volume_ml(*a) <= MEASURED_MAX_ML);
        if area_px2.is_none() {
            watch.lost();
        }
        // A lone leap of the stream is none. One that stays is real, and what was withheld then counts.
        let area_px2 = match area_px2.map(|a| watch.leap(volume_ml(a))) {
            Some(Leap::Withheld) => None,
            Some(Leap::Confirmed { withheld_ml }) => {
                camera.add_late(&self.calibration, withheld_ml, alpha_deg, taught_px2);
                area_px2
            }
            Some(Leap::None) | None => area_px2,
        };
        if let Some(a) = area_px2 {
            watch.shows(&self.explaining[WIDE].flow, following[WIDE].shown.tilt, volume_ml(a));
        }
        let flows = area_px2.map(|a| a > 0.0);
        let log_sd = trust::extra_log_sd(frame.confidence);
        let begins = !*started && *flowed && flows == Some(true);
        *flowed = flows.unwrap_or(*flowed);
        let mut innovations: [Option<Innovation>; EXPLANATIONS] = [None; EXPLANATIONS];
        for (k, (Explaining { flow, calibration, unknowns }, Following { shown, filter })) in
            self.explaining.iter().zip(following.iter_mut()).enumerate()
        {
            let measured_ml = area_px2.map(|a| f64::from(calibration.volume_ml(a, alpha_deg as f32)));
            match measured_ml {
                Some(measured_ml) if begins => filter.start(flow, unknowns, shown.tilt, measured_ml, (camera.sum_ml, camera.unseen_ml2())),
                _ if !*started => continue,
                measured_ml => {
                    filter.tilt(flow, shown.tilt);
                    innovations[k] = measured_ml.and_then(|measured_ml| {
                        filter.update(flow, shown.tilt, measured_ml, log_sd * f64::from(calibration.area_exponent))
                    });
                }
            }
            filter.release(flow, shown.tilt);
        }
        whiteness.add(innovations[TIGHT]);
        let odd = watch.foreseen(innovations[WIDE], area_px2.map(volume_ml));
        if let Leap::Confirmed { withheld_ml } = odd {
            camera.add_late(&self.calibration, withheld_ml, alpha_deg, taught_px2);
        }
        let leaps = odd == Leap::Withheld;
        camera.add(&self.calibration, area_px2.filter(|_| !leaps), log_sd, alpha_deg, taught_px2);
        *started |= begins;
        if *started {
            for (k, (Explaining { flow, calibration, unknowns }, Following { shown, .. })) in
                self.explaining.iter().zip(following.iter()).enumerate()
            {
                if k == WIDE || self.tight_share > STRAIGHT_SHARE {
                    let seen_ml = area_px2.filter(|_| !leaps).map(|a| f64::from(calibration.volume_ml(a, alpha_deg as f32)));
                    watch.balance(k, flow, unknowns, shown.tilt, seen_ml);
                }
            }
        }
        if !following.iter().all(|f| f.filter.is_finite()) {
            // This cannot happen with checked weights. If it does, the pour goes on as one that has not been seen yet.
            for following in following {
                following.filter = Filter::new();
            }
            *started = false;
        }
        area_px2.is_some()
    }
}

#[cfg(test)]
mod tests;
