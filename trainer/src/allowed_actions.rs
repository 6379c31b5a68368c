//! The actions that a training may use: all 21 of Fig. 5, or two.
//!
//! Pure functions, for any thread; nothing here allocates or fails.

use shared::actions::{ACTIONS, action_table, nearest_action};

/// Index of the backward one of the two actions among the network's outputs: the first.
const BACKWARD: usize = 0;
/// Index of the forward one of the two actions among the network's outputs: the last.
const FORWARD: usize = ACTIONS - 1;

/// The angle of each of the network's outputs, degrees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Actions {
    /// Whether there are only two, -1 and +1 degree.
    two: bool,
    /// Angle of each output, degrees, ascending.
    pub angles_deg: [f32; ACTIONS],
}

impl Actions {
    /// The 21 actions of Fig. 5, or with `count` = 2 only -1 degree (the first output) and +1 degree (the last).
    pub fn new(count: u8) -> Self {
        let two = count == 2;
        let mut angles_deg = action_table();
        if two {
            angles_deg = [0.0; ACTIONS];
            (angles_deg[BACKWARD], angles_deg[FORWARD]) = (-1.0, 1.0);
        }
        Self { two, angles_deg }
    }

    /// The action that stands for a relative angle in degrees: the nearest one or, of two actions, the one with its sign. Standing
    /// still counts as backward.
    pub fn discretise(&self, dalpha_deg: f64) -> u8 {
        match (self.two, dalpha_deg > 0.0) {
            (true, true) => FORWARD as u8,
            (true, false) => BACKWARD as u8,
            _ => nearest_action(&self.angles_deg, dalpha_deg as f32) as u8,
        }
    }

    /// The network's outputs that must never be taken.
    pub fn impossible(&self) -> impl Iterator<Item = usize> + use<> {
        let two = self.two;
        (0..ACTIONS).filter(move |k| two && ![BACKWARD, FORWARD].contains(k))
    }
}
