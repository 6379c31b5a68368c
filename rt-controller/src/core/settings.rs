//! The part of the cell's configuration that decisions depend on.
//!
//! It is read once at the start, from a checked configuration, so nothing fails, and nothing is allocated. Then it is plain data that the loop copies. The journal
//! holds it, so that a replay decides under the same settings.

use serde::{Deserialize, Serialize};
use shared::config::Config;
use shared::limits::Limits;

use crate::link::program::{patience_s, usual_lag_s};

/// The settings of a controller.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// Period of a tick, ns.
    pub period_ns: u64,
    /// Time from one camera frame to the next by the configuration, ns; 0 if it is not known.
    pub frame_ns: u64,
    /// Limits on alpha.
    pub limits: Limits,
    /// Largest age of the newest usable measurement during a pour or recording, ns.
    pub stale_ns: u64,
    /// Largest number of frames of a pour.
    pub max_frames: u32,
    /// Number of frames without flow at the largest tilt after which the container counts as empty. A container that has poured
    /// is noticed earlier, by the rule of the lost stream.
    pub empty_frames: u32,
    /// Largest goal, ml.
    pub goal_max_ml: f32,
    /// Largest distance of the measured alpha from 0 that counts as upright, degrees.
    pub upright_deg: f32,
    /// After this long without a target the robot's program goes upright by itself, ns; the controller
    /// then does so too.
    pub patience_ns: u64,
    /// The lag of the joint behind what is commanded that the robot's program and servo need, ns.
    pub usual_lag_ns: u64,
}

/// Time from one frame to the next of most cameras, ns: that of 30 Hz.
const USUAL_FRAME_NS: u64 = 33_333_333;
/// The shortest time from one frame to the next, ns: a little less than that of the largest `camera.fps`, 240.
const SHORTEST_FRAME_NS: u64 = 4_000_000;

/// The longest time in the settings, ns: an hour, far more than any configuration may say.
const LONGEST_NS: u64 = 3600 * 1_000_000_000;

impl Settings {
    /// Whether these can be the settings of a controller. Those of a configuration always can; a file may have been damaged.
    pub fn are_plausible(&self) -> bool {
        let Limits { alpha_min_deg, alpha_max_deg, step_deg, rate_deg_s, acceleration_deg_s2, return_rate_deg_s } = self.limits;
        let times_ns = [self.frame_ns, self.stale_ns, self.patience_ns, self.usual_lag_ns];
        // The ranges are those of the configuration. What is not a number is in none of them.
        (1_000_000..=1_000_000_000).contains(&self.period_ns)
            && times_ns.iter().all(|ns| *ns <= LONGEST_NS)
            && (self.frame_ns == 0 || self.frame_ns >= SHORTEST_FRAME_NS)
            && (-20.0..=0.0).contains(&alpha_min_deg)
            && (10.0..=180.0).contains(&alpha_max_deg)
            && (0.1..=6.0).contains(&step_deg)
            && (1.0..=180.0).contains(&rate_deg_s)
            && (10.0..=2290.0).contains(&acceleration_deg_s2)
            && (1.0..=180.0).contains(&return_rate_deg_s)
            && (0.0..=1e9).contains(&self.goal_max_ml)
            && (0.0..=10.0).contains(&self.upright_deg)
    }

    /// Number of frames in so many seconds, at least one. Of a camera whose rate is not known it is that at 30 Hz.
    pub fn frames(&self, seconds: f64) -> u32 {
        let frame_ns = if self.frame_ns == 0 { USUAL_FRAME_NS } else { self.frame_ns };
        (seconds * 1e9 / frame_ns as f64).round().max(1.0) as u32
    }

    /// Takes the settings out of the cell's configuration.
    pub fn new(config: &Config) -> Self {
        let controller = &config.controller;
        Self {
            period_ns: (1e9 / controller.rate_hz) as u64,
            frame_ns: (1e9 / config.camera.fps) as u64,
            limits: config.limits,
            stale_ns: u64::from(controller.stale_feature_ms) * 1_000_000,
            max_frames: controller.max_frames,
            empty_frames: controller.empty_frames,
            goal_max_ml: controller.goal_max_ml,
            upright_deg: config.robot.start_tolerance_deg as f32,
            patience_ns: (patience_s(controller.rate_hz) * 1e9) as u64,
            usual_lag_ns: (usual_lag_s(controller.rate_hz, config.robot.lookahead_s, &config.limits) * 1e9) as u64,
        }
    }
}
