//! `trainer inspect`: prints everything in a weight file, so that others can rebuild the policy.
//!
//! An offline command on an ordinary thread; it allocates. A file that is no weight file of this version is refused with one line.

use std::path::PathBuf;

use shared::actions::ACTIONS;
use shared::episode;
use shared::estimator::Calibration;
use shared::estimator::flow::{FlowModel, WayBack};
use shared::estimator::vessel::Vessel;
use shared::exit::{self, Failure, OrExit as _};
use shared::mlp::{HIDDEN, INPUTS, PARAMETERS};
use shared::plural::counted;
use shared::weights::{Estimator, FORMAT_VERSION, Weights};

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
    let weights = Weights::read(&args.weights).or_exit(exit::BAD_INPUT)?;
    if args.json {
        let all = serde_json::json!({
            "format_version": FORMAT_VERSION, "shape": [INPUTS, HIDDEN, HIDDEN, ACTIONS], "parameters": PARAMETERS,
            "identity": weights.identity(), "data_sha256": episode::hex(&weights.origin.data_sha256), "weights": weights,
        });
        println!("{}", serde_json::to_string_pretty(&all).unwrap_or_default());
    } else {
        println!("{}: identity {}, format version {FORMAT_VERSION}", args.weights.display(), weights.identity());
        print(&weights);
    }
    Ok(())
}

/// Prints what is in the weights, for people.
fn print(weights: &Weights) {
    let Weights { network: _, actions_deg, selection, scale, calibration, estimator, rate_hz, origin, seed } = weights;
    println!("trained     method {:?}, {} actions, {}, seed {seed}", origin.method, origin.actions, counted(origin.episodes, "episode"));
    println!("data        sha256 {}", episode::hex(&origin.data_sha256));
    println!("pictures    {}", origin.framing);
    println!("network     {INPUTS}-{HIDDEN}-{HIDDEN}-{ACTIONS}, ReLU, {PARAMETERS} parameters, action by {selection:?}");
    println!(
        "inputs      asinh({} v) x {} for v_t, v_t-1, v_t-2 in ml a frame; asinh(d / {} ml) x {}",
        scale.v_per_ml, scale.gain, scale.d_ml, scale.gain
    );
    println!("actions     {actions_deg:?} degrees");
    let Calibration { volume_at_1_px2_ml, area_exponent, log_tilt_slope, hold_above_px2 } = calibration;
    println!(
        "calibration v = {volume_at_1_px2_ml:.6e} area^{area_exponent:.4} exp({log_tilt_slope:.4} (alpha - 60)/30) ml, a lone zero after more than {hold_above_px2} px^2 is held"
    );
    println!("frame rate  {rate_hz} Hz");
    match estimator {
        Estimator::Sum => println!("estimate    plain sum of the frames' volumes"),
        Estimator::Fused { model, back } => {
            println!("estimate    camera and container geometry, fused");
            let [[cc, cq], [_, qq]] = model.camera;
            println!("  straight  {:.0} % likely", 100.0 * model.tight_share);
            println!(
                "  doubts    {:.1} % of c, {:.3} of q, {:.2} between them; {:.1} % from pour to pour",
                100.0 * cc.sqrt(),
                qq.sqrt(),
                if cc * qq > 0.0 { cq / (cc * qq).sqrt() } else { 0.0 },
                100.0 * model.gain_sd
            );
            print_model(&model.likelier().model, *back);
        }
    }
    println!("all {PARAMETERS} parameters: --json");
}

/// Prints the flow model that a fused estimate uses.
fn print_model(model: &FlowModel, back: WayBack) {
    let Vessel { radius_mm, height_mm, taper, even_share: _, log_shape } = model.vessel;
    println!("  vessel    R {radius_mm:.1} mm, H {height_mm:.1} mm, bottom/top {taper:.2}, deviation (log) {log_shape:.3?}");
    println!(
        "  flow      ln k {:.3}, exponent {:.3}, k1 {:.3}, k2 {:.3}, film share {:.3}",
        model.log_weir_coefficient, model.head_exponent, model.log_weir_slope, model.log_weir_curvature, model.film_share
    );
    println!(
        "  motion    lag {:.2} frames, delay {:.2} frames, back at {:.2} degrees a frame",
        model.lag_frames, model.delay_frames, back.rate_deg
    );
    println!("  frames    {:?}", model.noise);
}
