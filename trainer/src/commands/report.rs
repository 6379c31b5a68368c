//! `trainer report`: writes one self-contained HTML page of trainings and evaluations, with the plots inline as SVG.
//!
//! An offline command on an ordinary thread; it allocates. It reads the JSON files that `trainer train`, `trainer refine`, `experiments
//! evaluate` and `experiments reproduce` write; a file of another kind is refused by name.

use std::path::PathBuf;

use shared::exit::{self, Failure, OrExit as _};
use shared::{regular_file, whole_file};

use crate::report;

/// Largest JSON file that is read, bytes. Chosen by hand: a hundred times what a training of 100 episodes writes.
const JSON_MAX: u64 = 256 << 20;
/// How every page begins (HTML standard).
const HTML: &[u8] = b"<!doctype html";

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

/// What is said of a file that holds no JSON, such as the weight file itself.
fn wanted(name: &str) -> String {
    let beside = format!("{name}.json");
    let beside = if std::path::Path::new(&beside).exists() { format!("give {beside} instead") } else { "such as weights.bin.json".into() };
    format!(
        "{name}: holds no JSON; a page is made of what `trainer train` and `refine` write beside the weights, or `experiments evaluate --json` \
         and `reproduce --json` write: {beside}"
    )
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let unwritten = |e: std::io::Error| format!("{}: {e}", args.out.display());
    whole_file::check(&args.out, HTML).map_err(unwritten).or_exit(exit::BAD_INPUT)?;
    let mut files = Vec::new();
    for file in &args.files {
        let name = file.display().to_string();
        let bytes = regular_file::read(file, JSON_MAX).map_err(|e| format!("{name}: {e}")).or_exit(exit::BAD_INPUT)?;
        let value = serde_json::from_slice(&bytes).map_err(|_| wanted(&name)).or_exit(exit::BAD_INPUT)?;
        files.push((name, value));
    }
    let html = report::build(&files).or_exit(exit::BAD_INPUT)?;
    whole_file::replace(&args.out, html.as_bytes(), HTML).map_err(unwritten).or_exit(exit::FAILED)
}
