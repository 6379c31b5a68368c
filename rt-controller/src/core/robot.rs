//! The robot as the core sees it: plain data, made by the loop from the robot's newest state, and kept in the journal.
//! It is copied in the loop without allocation, and nothing here fails.

use serde::{Deserialize, Serialize};
use shared::control::EndReason;

/// The robot in one tick.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Robot {
    /// Why it may not move; `None`: it may.
    pub hindrance: Option<EndReason>,
    /// Measured alpha, degrees; NaN before the first state.
    pub alpha_deg: f32,
    /// When that state arrived, CLOCK_MONOTONIC ns; 0 before the first.
    pub at_ns: u64,
}
