//! The agent: one frame's V_e in, one relative angle out. The one observation pipeline of the project, used to the letter
//! by training, evaluation and run time.
//!
//! Pure and in the controller's loop: no clock, no allocation, no panic.

use crate::weights::Weights;

/// What is known of one camera frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Frame {
    /// V_e in px^2; `None`: the frame was lost or its measurement is doubtful.
    pub area_px2: Option<f32>,
    /// Commanded alpha when this frame was decided on, degrees from upright.
    pub alpha_deg: f32,
}

/// What the agent makes of one frame.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Decision {
    /// Index of the action, 0..21 for i = -10..10.
    pub action: u8,
    /// Relative angle of the action, degrees.
    pub dalpha_deg: f32,
    /// Outflow attributed to this frame, ml.
    pub v_ml: f32,
    /// d after this frame, ml; negative when too much was poured.
    pub d_ml: f32,
    /// Estimated volume poured since the goal was set, ml.
    pub poured_ml: f32,
}

/// Observation pipeline, estimator and policy of one pour.
#[derive(Debug, Clone)]
pub struct Agent {}

impl Agent {
    /// An agent that follows `weights`, with d = 0.
    pub fn new(_weights: &Weights) -> Self {
        todo!()
    }

    /// Starts a pour: d <- V_G (eq. 4), everything else forgotten.
    pub fn start(&mut self, _goal_ml: f32) {
        todo!()
    }

    /// One frame: d <- d - V_e (eq. 2), then the policy's action. Call it once for every frame, lost ones included.
    pub fn step(&mut self, _frame: Frame) -> Decision {
        todo!()
    }
}
