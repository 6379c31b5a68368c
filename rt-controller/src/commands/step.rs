//! `rt-controller step`: runs the controller's core as a filter, so that any other simulator can drive it. It is an ordinary
//! process, and every failure is one line. A simulator in Rust can call the core itself: see `examples/drive_core.rs`.

use std::io::{BufRead, Write};
use std::path::PathBuf;

use shared::agent::Agent;
use shared::config::Config;
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::messages::{Doubt, Feature, LAYOUT_VERSION};
use shared::weights::Weights;

use crate::core::{Core, Input, Order, Robot, Settings};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Example:\n  printf '0\\n0\\n350\\nnan\\n410\\n' | rt-controller step --weights out/weights.bin --goal 75\n\n\
Each line of input is one frame's V_e in px^2 (nan: no measurement); each line of output is 'dalpha_deg alpha_deg d_ml', flushed at once:\n\
the change and the angle commanded after this frame (all limits of the configuration applied), and the volume still to pour.")]
pub struct Args {
    /// The weight file.
    #[arg(long)]
    weights: PathBuf,
    /// Goal volume V_G in ml.
    #[arg(long)]
    goal: f32,
    /// The cell's configuration.
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    let weights = Weights::read(&args.weights).or_exit(exit::BAD_INPUT)?;
    let settings = Settings::new(&config);
    let mut core = Core::new(settings);
    core.exchange(Box::new(Agent::new(&weights)));
    let (mut alpha_deg, mut now_ns, mut sequence) = (0.0, 0, 0);
    let mut frame = |area_px2: f32, order: Option<Order>| {
        now_ns += settings.period_ns;
        sequence += 1;
        let doubt = if area_px2.is_finite() { Doubt::None } else { Doubt::EdgeNotFound };
        let feature = Feature {
            version: LAYOUT_VERSION,
            doubt: doubt as u32,
            sequence,
            captured_at_ns: now_ns,
            received_at_ns: now_ns,
            published_at_ns: now_ns,
            area_px2,
            confidence: 1.0,
            ..Feature::default()
        };
        // The robot is taken to be where it was sent; a lag is for the other simulator to add.
        let robot = Robot::that_may_move(alpha_deg, now_ns);
        let output = core.step(&Input { now_ns, features: &[feature], robot, order });
        let before_deg = alpha_deg;
        alpha_deg = output.telemetry.alpha_deg;
        (output, alpha_deg - before_deg)
    };
    // Two frames come before the first line: in one the robot becomes ready, in the other the goal is set.
    frame(0.0, None);
    let (started, _) = frame(0.0, Some(Order::Pour { episode: 1, goal_ml: args.goal }));
    if let Some(Err(refusal)) = started.ordered {
        return Err(failure(exit::REFUSED, refusal));
    }
    let mut out = std::io::stdout().lock();
    for (number, line) in std::io::stdin().lock().lines().enumerate() {
        let area_px2 = match line.as_deref().map(str::trim).map(str::parse::<f32>) {
            Ok(Ok(area_px2)) => area_px2,
            _ => {
                let what = format!("line {}: not a number: give one V_e in px^2, or nan, on each line", number + 1);
                return Err(failure(exit::BAD_INPUT, what));
            }
        };
        let (output, dalpha_deg) = frame(area_px2, None);
        let t = output.telemetry;
        if writeln!(out, "{dalpha_deg:.4} {:.4} {:.4}", t.alpha_deg, t.d_ml).and_then(|()| out.flush()).is_err() {
            return Ok(()); // the reader has gone
        }
    }
    Ok(())
}
