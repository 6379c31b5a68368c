//! `experiments demo`: the main job, end to end, with the real processes: record, train, swap the weights, pour, report.
//!
//! Ordinary process; allocates. It fails with one line when a step fails or a pour is too far from its goal.

use std::path::PathBuf;

use shared::exit::{self, Failure, failure};

use crate::demo::perform;
use crate::own_cell::OwnCell;

/// A pour further than this from its goal fails the demo, ml. Chosen by hand; no measurement is recorded.
const TOLERANCE_ML: f64 = 10.0;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  experiments demo --out out/demo --seed 3\n\nLeaves in the output directory: sim.toml, episodes/*.mcap, weights.bin, \
pours/*.svg, summary.json and the processes' logs."
)]
pub struct Args {
    /// The simulated cell's configuration; the demo gives its copy a name and an address of its own.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Directory of the results: a new or an empty one, or one that an earlier demo made, whose results are then replaced.
    #[arg(long, default_value = "out/demo")]
    out: PathBuf,
    /// Which container, camera and fluid the cell has, and the training's seed.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print summary.json to standard output instead of the table.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let mut cell = OwnCell::prepare("demo", &args.config, (&args.out, &["episodes", "summary.json", "pours"]), args.seed)?;
    let summary = perform(&mut cell, args.seed)?;
    if args.json {
        println!("{}", summary.json());
    } else {
        summary.print();
    }
    let far: Vec<String> = (1..).zip(&summary.pours).filter(|(_, p)| p.error_ml.abs() > TOLERANCE_ML).map(|(i, _)| i.to_string()).collect();
    if far.is_empty() {
        return Ok(());
    }
    Err(failure(exit::FAILED, format!("pour {} is further than {TOLERANCE_ML} ml from its goal", far.join(" and "))))
}
