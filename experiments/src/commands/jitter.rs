//! `experiments jitter`: latency and jitter of the real processes on this machine, beside cyclictest, at rest and under load.
//!
//! Ordinary process; allocates and blocks. It runs the simulated cell in rounds, and between them cyclictest with the same priority, core
//! and interval; both once on the machine as it is and once under stress-ng. It ends with a page and its numbers as JSON. It fails with one
//! line when a program is missing; what was measured until then is lost. `scripts/jitter` installs what is needed.

use std::path::{Path, PathBuf};

use serde_json::json;
use shared::exit::Failure;
use trainer::report::page;

use crate::jitter::this_machine::ThisMachine;
use crate::jitter::{rounds, soak};
use crate::own_cell::{OwnCell, OwnCellError};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  experiments jitter --weights out/demo/weights.bin
  experiments jitter --weights out/demo/weights.bin --hours 0.5      (a soak under load instead of the rounds)

Leaves jitter.json and jitter.html in the output directory. Needs cyclictest (package rt-tests) and stress-ng.")]
pub struct Args {
    /// The simulated cell's configuration: cores, priorities and rate are measured as they stand there.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Weights to pour with.
    #[arg(long)]
    weights: PathBuf,
    /// Rounds; in each, cell and cyclictest run at rest and under load.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Length of each run, s.
    #[arg(long, default_value_t = 20)]
    seconds: u64,
    /// Instead of the rounds: one run under load of this many hours, with cyclictest beside it.
    #[arg(long)]
    hours: Option<f64>,
    /// Directory of the results.
    #[arg(long, default_value = "out/jitter")]
    out: PathBuf,
    /// Print jitter.json to standard output instead of the tables.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    Ok(measure(args)?)
}

/// The error for a file that cannot be written or read.
fn file_error(path: &Path) -> impl FnOnce(std::io::Error) -> OwnCellError {
    let what = path.display().to_string();
    move |error| OwnCellError::File { what, error }
}

fn measure(args: &Args) -> Result<(), OwnCellError> {
    let mut cell = OwnCell::prepare("jitter", &args.config, &args.out, 1)?;
    std::fs::copy(&args.weights, args.out.join("weights.bin")).map_err(file_error(&args.weights))?;
    let machine = ThisMachine::look(&cell);
    let result = match args.hours {
        Some(hours) => soak::measure(&mut cell, hours)?,
        None => rounds::measure(&mut cell, args.rounds, args.seconds)?,
    };
    let all = json!({ "machine": machine.json(), "result": result.numbers });
    let text = serde_json::to_string_pretty(&all).unwrap_or_default();
    let numbers = args.out.join("jitter.json");
    std::fs::write(&numbers, text.clone() + "\n").map_err(file_error(&numbers))?;
    let html = page::page("Decant: latency and jitter", &(machine.html() + &result.html));
    let page = args.out.join("jitter.html");
    std::fs::write(&page, html).map_err(file_error(&page))?;
    if args.json {
        println!("{text}");
    } else {
        print!("{}{}", machine.text(), result.text);
        println!("\npage and numbers: {}, {}", page.display(), numbers.display());
    }
    Ok(())
}
