//! The actions of the paper's policy pi: Fig. 5's table of 21 relative angles, and how the network's outputs choose one of them.
//!
//! Used in the controller's loop and by training: fixed size, no allocation, no panic, no failure.

use serde::{Deserialize, Serialize};

/// Number of actions, i = -10..=10.
pub const ACTIONS: usize = 21;
/// Index of the action "stay" (i = 0).
pub const STAY: usize = ACTIONS / 2;
/// The relative angle with which a container is tilted back, degrees a frame: Fig. 5's action i = -8.
pub const BACK_DEG_PER_FRAME: f32 = -3.2;

/// How the network's 21 outputs become an action.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Selection {
    /// The action with the largest output.
    Argmax,
    /// The action nearest to the expected angle under the softmax; the remainder is carried to the next frame.
    Expected,
    /// An action drawn from the softmax with a generator seeded by [`Weights::seed`](crate::weights::Weights::seed).
    Sampled,
}

/// Fig. 5's table: action index 0..21 (i = -10..10) to degrees, `5 sign(i) (i/10)^2`.
pub const fn action_table() -> [f32; ACTIONS] {
    let mut table = [0.0; ACTIONS];
    let mut k = 0;
    while k < ACTIONS {
        let i = k as f32 - STAY as f32;
        let square = 5.0 * i * i / 100.0;
        table[k] = if i < 0.0 { -square } else { square };
        k += 1;
    }
    table
}

/// Index of the action of `table` nearest to `dalpha_deg`. A tie goes to [`STAY`] if it is among the nearest, otherwise to the smaller
/// index; an angle that is not finite gives [`STAY`].
pub fn nearest_action(table: &[f32; ACTIONS], dalpha_deg: f32) -> usize {
    let mut best = STAY;
    for (k, a) in table.iter().enumerate() {
        if (a - dalpha_deg).abs() < (table[best] - dalpha_deg).abs() {
            best = k;
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects Fig. 5's discretisation: it is fine near 0, +-5 degrees at the ends, odd and ascending. Also
    /// protects its inverse.
    #[test]
    fn the_action_table_is_figure_5() {
        let table = action_table();
        assert_eq!((table[0], table[9], table[STAY], table[11], table[20]), (-5.0, -0.05, 0.0, 0.05, 5.0));
        assert!(table.windows(2).all(|w| w[0] < w[1]));
        for (k, a) in table.iter().enumerate() {
            assert_eq!(nearest_action(&table, *a), k);
        }
        assert_eq!(nearest_action(&table, 99.0), 20);
        assert_eq!(nearest_action(&table, f32::NAN), STAY);
    }

    /// Protects the way back: its angle is an action of Fig. 5, to the bit.
    #[test]
    fn the_way_back_is_an_action_of_the_table() {
        assert_eq!(action_table()[STAY - 8], BACK_DEG_PER_FRAME);
    }
}
