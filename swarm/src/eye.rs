//! The eye: from the flow at the lip to the measurement that the worker would publish, with the errors that vision makes (the depth `area`), or
//! from a drawn picture with the errors that vision really makes ([`crate::camera`]). What goes wrong with the worker is the same at both.
//!
//! Pure, but for the one random sequence that it owns, and the camera; it allocates and cannot fail.

use std::collections::VecDeque;

use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use shared::messages::{Doubt, Feature, LAYOUT_VERSION};
use simulator::camera::Scene;

use crate::camera::Camera;
use crate::what::EyeFault;

/// Area for an outflow of 1 ml a frame, px^2: that of simulator b.
const AREA_AT_1_ML_PX2: f64 = 400.0;
/// Share of a stream's area that is still seen when the whole stream clings to the wall: that of simulator b.
const CLINGING_SEEN: f64 = 0.4;
/// Areas below this are no stream, px^2 (`image.area_min_px2` of config/sim.toml).
const AREA_MIN_PX2: f64 = 30.0;
/// Standard deviation of an area, as a share of it: `evaluate-camera --frames 9600 --seed 20261 --runs 16` gave a 95th percentile of 5.3 % in whole pours
/// with colour (22 November 2026).
const NOISE: f64 = 0.027;
/// Share of the frames with a stream that are doubtful: missed flow with colour in whole pours of the same run.
const DOUBTED: f64 = 0.0016;
/// Share of the frames with a stream that read 0 without a doubt: there it was 0 of 7,000 with colour, whose bound at 95 % is 0.0004.
const MISSED: f64 = 0.0004;
/// Standard deviation of the camera's gain from pour to pour, as a share of it: that of simulator b.
const GAIN_SD: f64 = 0.015;
/// From the middle of the exposure until the measurement is published, ns: `simulator.camera_delay_ms` and 2 ms of extraction.
const DELAY_NS: u64 = 27_000_000;
/// The largest further delay of a measurement in an ordinary frame, ns (docs/REALTIME.md gives less than a millisecond).
const JITTER_NS: u64 = 800_000;
/// Frames in which a gain drifts, and measurements come late: two seconds at 30 Hz.
const DRIFT_FRAMES: u32 = 60;

/// The camera and its worker.
pub struct Eye {
    /// The camera; without one the area follows from the flow.
    camera: Option<Camera>,
    random: Pcg64Mcg,
    sequence: u64,
    epoch_ns: u64,
    gain: f64,
    first_gain: f64,
    /// Exponent with which the area grows with the flow.
    area_exponent: f64,
    /// The share by which the gain still drifts in each frame, and for how many frames.
    drift: (f64, u32),
    lost: u32,
    frozen: u32,
    twice: u32,
    swapped: bool,
    held_back: Option<Feature>,
    late: (u64, u32),
    false_zero: u32,
    spike_px2: Option<f32>,
    /// For how many frames the area stands still, where, px^2, and what left in the frame that showed it, ml.
    stuck: (u32, f32, f64),
    gone_until_ns: u64,
    /// The worker that comes back then is a new process.
    is_killed: bool,
    two_until_ns: u64,
    newest: Feature,
    /// What left in a frame that shows the newest area, ml.
    shown_ml: f64,
    /// How much less than what left the newest frame shows without a doubt, ml.
    hidden_ml: f64,
    /// Whether the newest frame gave a measurement that may be used.
    measured: bool,
    /// Measurements on their way, with the time of their publication.
    pub published: VecDeque<Feature>,
}

impl Eye {
    /// An eye whose worker starts at `now_ns`. Without a camera the area grows with the flow by `area_exponent`.
    pub fn new(seed: u64, now_ns: u64, area_exponent: f64, camera: Option<Camera>) -> Self {
        let mut random = Pcg64Mcg::seed_from_u64(seed ^ 0xE7E);
        let normal: f64 = StandardNormal.sample(&mut random);
        let gain = if camera.is_some() { 1.0 } else { 1.0 + GAIN_SD * normal };
        Self {
            gain,
            first_gain: gain,
            camera,
            random,
            sequence: 0,
            epoch_ns: now_ns,
            area_exponent,
            drift: (0.0, 0),
            lost: 0,
            frozen: 0,
            twice: 0,
            swapped: false,
            held_back: None,
            late: (0, 0),
            false_zero: 0,
            spike_px2: None,
            stuck: (0, 0.0, 0.0),
            gone_until_ns: 0,
            is_killed: false,
            two_until_ns: 0,
            newest: Feature::default(),
            shown_ml: 0.0,
            hidden_ml: 0.0,
            measured: false,
            published: VecDeque::new(),
        }
    }

    /// Something goes wrong at `now_ns`. It does not end what is longer, and of its kind.
    pub fn inject(&mut self, fault: EyeFault, now_ns: u64) {
        let until_ns = |ms: u32| now_ns + u64::from(ms) * 1_000_000;
        match fault {
            EyeFault::Loss(frames) => self.lost = self.lost.max(frames),
            EyeFault::Freeze(frames) => self.frozen = self.frozen.max(frames),
            EyeFault::Duplicate(frames) => self.twice = self.twice.max(frames),
            EyeFault::Reorder => self.swapped = true,
            EyeFault::Late(ms) => {
                let (late_ns, frames) = self.late;
                let still_ns = if frames > 0 { late_ns } else { 0 };
                self.late = (still_ns.max(u64::from(ms) * 1_000_000), DRIFT_FRAMES);
            }
            EyeFault::GainDrift(share) => self.drift = (share / f64::from(DRIFT_FRAMES), DRIFT_FRAMES),
            EyeFault::FalseZero(frames) => self.false_zero = self.false_zero.max(frames),
            EyeFault::Spike(area_px2) => self.spike_px2 = Some(area_px2),
            EyeFault::Stuck(frames) => self.stuck = (self.stuck.0.max(frames), self.newest.area_px2, self.shown_ml),
            EyeFault::Killed(ms) => {
                self.gone_until_ns = self.gone_until_ns.max(until_ns(ms));
                self.epoch_ns = self.gone_until_ns;
                self.is_killed = true;
                self.published.clear();
            }
            EyeFault::Hung(ms) => self.gone_until_ns = self.gone_until_ns.max(until_ns(ms)),
            EyeFault::Two(ms) => self.two_until_ns = self.two_until_ns.max(until_ns(ms)),
            // The camera has it from its beginning.
            EyeFault::Picture(_) => {}
        }
    }

    /// A frame was exposed at `now_ns`, in which `flow_ml` left the lip since the frame before, and this share of the stream clings to the
    /// wall; a camera saw `scene`. What is measured is added to [`Eye::published`].
    pub fn frame(&mut self, now_ns: u64, flow_ml: f64, clinging: f64, scene: &Scene) {
        // A new process has opened the camera anew, whose frames begin at 1 again.
        if now_ns >= self.gone_until_ns && std::mem::take(&mut self.is_killed) {
            self.sequence = 0;
        }
        self.sequence += 1;
        (self.hidden_ml, self.measured) = (0.0, false);
        // The same numbers are drawn in every frame, so that a fault does not shift the noise of later frames.
        let normal: f64 = StandardNormal.sample(&mut self.random);
        let (doubted, missed) = (self.random.random_bool(DOUBTED), self.random.random_bool(MISSED));
        let jitter_ns = self.random.random_range(0..JITTER_NS);
        if self.drift.1 > 0 {
            self.gain *= 1.0 + self.drift.0;
            self.drift.1 -= 1;
        }
        if now_ns < self.gone_until_ns || counted(&mut self.lost) {
            return;
        }
        let frozen = counted(&mut self.frozen);
        let Some((mut area_px2, confidence, mut doubt)) = (match &mut self.camera {
            // A camera that stands still shows its picture again, and the extraction must find that out.
            Some(camera) => {
                camera.look(scene, frozen).map(|(area_px2, confidence, doubt)| (area_px2 * self.gain as f32, confidence, doubt))
            }
            None => {
                let (area_px2, doubt) = self.modelled(flow_ml, clinging, normal, doubted, missed);
                Some((area_px2, 1.0, doubt))
            }
        }) else {
            return;
        };
        let shown_ml = self.misread((&mut area_px2, &mut doubt), frozen, flow_ml);
        self.measured = doubt.usable(area_px2);
        let mut delay_ns = DELAY_NS + jitter_ns;
        if counted(&mut self.late.1) {
            delay_ns += self.late.0;
        }
        let feature = Feature {
            version: LAYOUT_VERSION,
            doubt: doubt as u32,
            sequence: self.sequence,
            worker_epoch_ns: self.epoch_ns,
            captured_at_ns: now_ns,
            received_at_ns: now_ns + delay_ns - 2_000_000,
            published_at_ns: now_ns + delay_ns,
            area_px2,
            confidence,
            ..Feature::default()
        };
        (self.newest, self.shown_ml) = (feature, shown_ml);
        self.publish(feature);
        if counted(&mut self.twice) {
            self.publish(feature);
        }
        if now_ns < self.two_until_ns {
            self.publish(Feature { worker_epoch_ns: self.two_until_ns, area_px2: area_px2 * 0.9, ..feature });
        }
    }

    /// What the faults under way make of an area and its doubt. Gives what leaves in a frame that shows it, ml.
    fn misread(&mut self, (area_px2, doubt): (&mut f32, &mut Doubt), frozen: bool, flow_ml: f64) -> f64 {
        let (stuck, false_zero) = (counted(&mut self.stuck.0), counted(&mut self.false_zero));
        let mut shown_ml = flow_ml;
        if stuck {
            (*area_px2, shown_ml) = (self.stuck.1, self.stuck.2);
        }
        if false_zero {
            (*area_px2, *doubt, shown_ml) = (0.0, Doubt::None, 0.0);
        }
        self.hidden_ml = flow_ml - shown_ml;
        if let Some(spike_px2) = self.spike_px2.take() {
            *area_px2 = spike_px2;
            shown_ml = (f64::from(spike_px2) / AREA_AT_1_ML_PX2 / self.gain).powf(1.0 / self.area_exponent);
        }
        if frozen && self.camera.is_none() {
            (*area_px2, *doubt) = (self.newest.area_px2, Doubt::Frozen);
            (shown_ml, self.hidden_ml) = (self.shown_ml, 0.0);
        }
        shown_ml
    }

    /// The camera's gain as a share of that at the start, and how much less the newest frame shows than what left in it, ml. Nothing tells of either.
    pub fn unshown(&self) -> (f64, f64) {
        (self.gain / self.first_gain, self.hidden_ml)
    }

    /// Whether the newest frame gave a measurement that may be used.
    pub fn has_measured(&self) -> bool {
        self.measured
    }

    /// What vision makes of a flow: area and doubt.
    fn modelled(&self, flow_ml: f64, clinging: f64, normal: f64, doubted: bool, missed: bool) -> (f32, Doubt) {
        let seen_share = 1.0 - (1.0 - CLINGING_SEEN) * clinging;
        let area = AREA_AT_1_ML_PX2 * seen_share * flow_ml.max(0.0).powf(self.area_exponent) * self.gain * (NOISE * normal).exp();
        let seen = area >= AREA_MIN_PX2;
        match (seen && doubted, seen && !missed) {
            (true, _) => (0.0, Doubt::EdgeNotFound),
            (false, true) => (area as f32, Doubt::None),
            (false, false) => (0.0, Doubt::None),
        }
    }

    /// Puts a measurement on its way; what is published keeps its order, as in shared memory.
    fn publish(&mut self, feature: Feature) {
        if std::mem::take(&mut self.swapped) {
            self.held_back = Some(feature);
            return;
        }
        self.published.push_back(feature);
        self.published.extend(self.held_back.take());
    }
}

/// Counts down; true as long as it was above 0.
fn counted(left: &mut u32) -> bool {
    let is_on = *left > 0;
    *left = left.saturating_sub(1);
    is_on
}

#[cfg(test)]
mod tests {
    use super::*;
    use simulator::physics::rig::Rig;

    /// Frames of 1 ml each after `faults`, from the 10th on.
    fn seen(faults: &[EyeFault]) -> (Vec<Feature>, Vec<(f64, f64)>) {
        let mut eye = Eye::new(1, 0, 1.0, None);
        let container = Rig::seeded(1).container(300.0);
        let (mut features, mut unshown) = (Vec::new(), Vec::new());
        for k in 0..60u64 {
            if k == 10 {
                faults.iter().for_each(|fault| eye.inject(*fault, k * 33_340_000));
            }
            eye.frame(k * 33_340_000, 1.0, 0.0, &Scene::of(&container, 0.0, 0.0, 0.0));
            features.extend(eye.published.drain(..));
            unshown.push(eye.unshown());
        }
        (features, unshown)
    }

    /// Protects what the controller is tried with: the successor of a killed worker is another process, whose frames begin at 1 again, and one that only hung
    /// goes on with the camera's numbers.
    #[test]
    fn a_new_worker_begins_its_numbers_again() {
        let after = |fault| {
            let (features, _) = seen(&[fault]);
            (features[9].worker_epoch_ns, features[10].worker_epoch_ns, features[10].sequence)
        };
        let (before, then, sequence) = after(EyeFault::Killed(300));
        assert!(before != then && sequence == 1, "{before} {then} {sequence}");
        let (before, then, sequence) = after(EyeFault::Hung(300));
        assert!(before == then && sequence > 15, "{before} {then} {sequence}");
    }

    /// Protects the check of what is said from an eye that hides more than it says: the true gain, and frame by frame what was not shown.
    #[test]
    fn what_was_not_shown_is_counted() {
        let (_, unshown) = seen(&[EyeFault::GainDrift(-0.2), EyeFault::FalseZero(3)]);
        assert_eq!(unshown.iter().map(|(_, ml)| ml).sum::<f64>(), 3.0);
        let gain = unshown[59].0;
        assert!((0.83..0.87).contains(&gain), "50 of 60 frames of the drift: {gain}");
        let (_, unshown) = seen(&[EyeFault::Stuck(5)]);
        assert_eq!(unshown.iter().map(|(_, ml)| ml.abs()).sum::<f64>(), 0.0, "what stands still at what flows hides nothing");
    }
}
