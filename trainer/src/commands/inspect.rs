//! `trainer inspect`: everything in a weight file, so that others can rebuild the policy.
//!
//! Offline, ordinary thread, allocates.

use std::path::PathBuf;

use shared::actions::ACTIONS;
use shared::exit::{self, Failure, OrExit as _};
use shared::mlp::{HIDDEN, INPUTS, PARAMETERS};
use shared::weights::{Estimator, FORMAT_VERSION, Weights};

use crate::data;

/// Command-line arguments of `trainer inspect`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  trainer inspect out/weights.bin
  trainer inspect out/weights.bin --json > weights.json")]
pub struct Args {
    /// The weight file.
    weights: PathBuf,
    /// Print JSON, all 1909 parameters included.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let w = Weights::read(&args.weights).or_exit(exit::BAD_INPUT)?;
    let data = data::hex(&w.origin.data_sha256);
    if args.json {
        let all = serde_json::json!({
            "format_version": FORMAT_VERSION, "shape": [INPUTS, HIDDEN, HIDDEN, ACTIONS], "parameters": PARAMETERS,
            "identity": w.identity(), "data_sha256": data, "weights": w,
        });
        println!("{}", serde_json::to_string_pretty(&all).unwrap_or_default());
        return Ok(());
    }
    println!("{}: identity {}, format version {FORMAT_VERSION}", args.weights.display(), w.identity());
    println!("trained     method {:?}, {} actions, {} episodes, seed {}", w.origin.method, w.origin.actions, w.origin.episodes, w.seed);
    println!("data        sha256 {data}");
    println!("network     {INPUTS}-{HIDDEN}-{HIDDEN}-{ACTIONS}, ReLU, {PARAMETERS} parameters, action by {:?}", w.selection);
    println!(
        "inputs      asinh({} v) x {} for v_t, v_t-1, v_t-2 in ml a frame; asinh(d / {} ml) x {}",
        w.scale.v_per_ml, w.scale.gain, w.scale.d_ml, w.scale.gain
    );
    println!("actions     {:?} degrees", w.actions_deg);
    println!(
        "calibration v = {:.6e} area^{:.4} exp({:.4} (alpha - 60)/30) ml, a lone zero after more than {} px^2 is held",
        w.calibration.volume_at_1_px2_ml, w.calibration.area_exponent, w.calibration.log_tilt_slope, w.calibration.hold_above_px2
    );
    println!("frame rate  {} Hz", w.rate_hz);
    match &w.estimator {
        Estimator::Sum => println!("estimate    plain sum of the frames' volumes"),
        Estimator::Fused { model: m, back } => {
            println!("estimate    camera and container geometry, fused");
            println!(
                "  vessel    R {:.1} mm, H {:.1} mm, bottom/top {:.2}, deviation (log) {:.3?}",
                m.vessel.radius_mm, m.vessel.height_mm, m.vessel.taper, m.vessel.log_shape
            );
            println!(
                "  flow      ln k {:.3}, exponent {:.3}, k1 {:.3}, k2 {:.3}, film share {:.3}",
                m.log_weir_coefficient, m.head_exponent, m.log_weir_slope, m.log_weir_curvature, m.film_share
            );
            println!(
                "  motion    lag {:.2} frames, delay {:.2} frames, back at {:.2} degrees a frame",
                m.lag_frames, m.delay_frames, back.rate_deg
            );
            println!("  doubts    {:?}", m.noise);
        }
    }
    println!("all 1909 parameters: --json");
    Ok(())
}
