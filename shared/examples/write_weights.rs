//! Writes a weight file by hand and reads it back.
//!
//! You learn from it what the controller needs to pour ([`Weights`]): a network, the angles of its actions, the calibration from area to
//! volume, and how the poured volume is estimated; and that a file is checked when it is written and when it is read. The network made
//! here tilts by a constant angle in each frame until the goal is reached, whatever it sees.
//!
//! Run it with `cargo run --release -p shared --example write_weights -- FILE`; without FILE it writes `weights-by-hand.bin`. The running
//! controller takes such a file if it is named in `controller.weights`; `trainer inspect FILE` shows it.

use std::path::Path;

use shared::actions::{STAY, Selection, action_table};
use shared::estimator::Calibration;
use shared::framing::Framing;
use shared::mlp::{InputScale, Mlp};
use shared::weights::{Estimator, Method, Origin, Weights, WeightsError};

/// Weights whose network always chooses the action i, -10 to 10, of Fig. 5.
pub fn constant_action(i: i32) -> Weights {
    // All parameters are 0 but one bias of the output layer, so that this output is always the largest.
    let mut network = Mlp::ZERO;
    network.b3[(STAY as i32 + i.clamp(-10, 10)) as usize] = 1.0;
    Weights {
        network,
        actions_deg: action_table(),
        selection: Selection::Argmax,
        scale: InputScale::default(),
        // 1 px^2 is 0.002 ml a frame, at every tilt; single frames without a stream are believed.
        calibration: Calibration { volume_at_1_px2_ml: 0.002, area_exponent: 1.0, log_tilt_slope: 0.0, hold_above_px2: f32::INFINITY },
        estimator: Estimator::Sum,
        rate_hz: 30.0,
        origin: Origin { method: Method::Handmade, actions: 21, episodes: 0, data_sha256: [0; 32], framing: Framing::default() },
        seed: 0,
    }
}

/// Writes the weights to `file` and gives what is read back from it.
pub fn write_and_read(file: &Path, weights: &Weights) -> Result<Weights, WeightsError> {
    weights.write(file)?;
    Weights::read(file)
}

fn main() -> Result<(), WeightsError> {
    let file = std::env::args().nth(1).unwrap_or_else(|| "weights-by-hand.bin".into());
    let weights = write_and_read(Path::new(&file), &constant_action(3))?;
    println!("{file}: weights {}, {:.2} degrees a frame", weights.identity(), weights.actions_deg[STAY + 3]);
    Ok(())
}
