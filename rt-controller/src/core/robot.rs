//! The robot as the core sees it: plain data that the loop makes from the robot's newest state, and that the journal keeps. Nothing here
//! allocates or fails.

use serde::{Deserialize, Serialize};
use shared::control::EndReason;

/// The robot in one tick.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Robot {
    /// Why the robot may not move; `None` if it may.
    pub hindrance: Option<EndReason>,
    /// Measured alpha, degrees; NaN before the first state.
    pub alpha_deg: f32,
    /// When that state arrived, CLOCK_MONOTONIC ns; 0 before the first, and where a simulator measures no alpha: the agent then goes by the command.
    pub at_ns: u64,
    /// The share of its speed that the robot leaves by itself, 0 to 1 (RTDE's `speed_scaling`); `None` if it does not say.
    pub speed_scaling: Option<f32>,
}

impl Robot {
    /// A robot that may move at its full speed, whose joint was at `alpha_deg` at `at_ns`: what simulators and tests need.
    pub fn that_may_move(alpha_deg: f32, at_ns: u64) -> Self {
        Self { hindrance: None, alpha_deg, at_ns, speed_scaling: None }
    }
}
