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
    /// When that state arrived, CLOCK_MONOTONIC ns; 0 before the first.
    pub at_ns: u64,
}
