//! `trainer report`: writes one self-contained HTML page of trainings and evaluations, with the plots inline as SVG.
//!
//! An offline command on an ordinary thread; it allocates. It reads the JSON files that `trainer train`, `trainer refine`, `experiments
//! evaluate` and `experiments reproduce` write; a file of another kind is refused by name.

use std::path::PathBuf;

use shared::exit::{self, Failure, OrExit as _};

use crate::report;

/// Command-line arguments of `trainer report`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  trainer report out/weights.bin.json --out out/training.html
  trainer report out/evaluation.json out/weights.bin.json --out out/report.html
  trainer report n1.json n5.json n10.json --out report.html     (error against number of episodes)")]
pub struct Args {
    /// JSON files written by `train`, `refine`, `evaluate --json` or `reproduce --json`.
    #[arg(required = true)]
    files: Vec<PathBuf>,
    /// Where the page is written.
    #[arg(long)]
    out: PathBuf,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let mut files = Vec::new();
    for file in &args.files {
        let name = file.display().to_string();
        let text = std::fs::read_to_string(file).map_err(|e| e.to_string());
        let value = text.and_then(|t| serde_json::from_str(&t).map_err(|e| e.to_string()));
        let value = value.map_err(|e| format!("{name}: {e}")).or_exit(exit::BAD_INPUT)?;
        files.push((name, value));
    }
    let html = report::build(&files).or_exit(exit::BAD_INPUT)?;
    std::fs::write(&args.out, html).map_err(|e| format!("{}: {e}", args.out.display())).or_exit(exit::FAILED)
}
