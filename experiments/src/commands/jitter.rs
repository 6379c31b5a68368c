//! `experiments jitter`: latency and jitter of the real processes on this machine, beside cyclictest, at rest and under load.
//!
//! Ordinary process; allocates and blocks. It runs the simulated cell in rounds, and between them cyclictest with the same priority, core
//! and interval, and a bare loop that makes only the loop's system calls; all on the machine as it is, under stress-ng, and in a storm of it. It ends
//! with a verdict, a page and its numbers as JSON. With `--against` it is a gate: it fails if the machine or the code became worse. It fails
//! with one line when a program is missing; what was measured until then is lost. `scripts/jitter` installs what is needed.

use std::path::{Path, PathBuf};

use serde_json::{Value, json};
use shared::exit::{BAD_INPUT, FAILED, Failure, failure};
use trainer::report::page;

use crate::jitter::measured::Measured;
use crate::jitter::this_machine::ThisMachine;
use crate::jitter::{VERSION, against, rounds, soak};
use crate::own_cell::{OwnCell, OwnCellError};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:
  experiments jitter --weights out/demo/weights.bin
  experiments jitter --weights out/demo/weights.bin --hours 0.5      (a soak under load instead of the rounds)
  experiments jitter --weights out/demo/weights.bin --quick --against before.json      (a gate of less than a minute)

Leaves jitter.json and jitter.html in the output directory. Needs cyclictest (package rt-tests) and stress-ng.")]
pub struct Args {
    /// The simulated cell's configuration: cores, priorities and rate are measured as they stand there.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Weights to pour with.
    #[arg(long)]
    weights: PathBuf,
    /// Rounds; in each, cell, cyclictest and a bare loop run at rest, under load and in a storm.
    #[arg(long, default_value_t = 5)]
    rounds: usize,
    /// Length of each run, s.
    #[arg(long, default_value_t = 20)]
    seconds: u64,
    /// Instead of the rounds: one run under load of this many hours, with cyclictest beside it.
    #[arg(long)]
    hours: Option<f64>,
    /// Instead of the rounds: one run at rest, in less than a minute. Its verdict is coarser.
    #[arg(long, conflicts_with = "hours")]
    quick: bool,
    /// Compare with the jitter.json of an earlier run of the same machine; exit with code 1 if a ratio became worse.
    #[arg(long, conflicts_with = "hours")]
    against: Option<PathBuf>,
    /// Directory of the results.
    #[arg(long, default_value = "out/jitter")]
    out: PathBuf,
    /// Print jitter.json to standard output instead of the tables.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    // What it is compared with is read first, because it may be overwritten, and a bad file should not cost seventeen minutes.
    let earlier = args.against.as_deref().map(read_earlier).transpose()?;
    let mut cell = OwnCell::prepare("jitter", &args.config, (&args.out, &[]), 1)?;
    std::fs::copy(&args.weights, args.out.join("weights.bin")).map_err(file_error(&args.weights))?;
    cell.made("weights.bin");
    let machine = ThisMachine::look(&cell);
    let result = match args.hours {
        Some(hours) => soak::measure(&mut cell, hours)?,
        None if args.quick => rounds::measure_quickly(&mut cell)?,
        None => rounds::measure(&mut cell, args.rounds, args.seconds)?,
    };
    let all = json!({
        "version": VERSION, "machine_key": machine.key(), "quick": args.quick, "verdict": result.verdict, "machine": machine.json(),
        "result": result.numbers,
    });
    let text = serde_json::to_string_pretty(&all).unwrap_or_default();
    let numbers = args.out.join("jitter.json");
    std::fs::write(&numbers, text.clone() + "\n").map_err(file_error(&numbers))?;
    let first = format!("<p><strong>{}</strong></p>", page::escape(&result.verdict));
    let html = page::page("Decant: latency and jitter", &(first + &machine.html() + &result.html));
    let page = args.out.join("jitter.html");
    std::fs::write(&page, html).map_err(file_error(&page))?;
    if args.json {
        println!("{text}");
    } else {
        println!("{}\n\n{}{}", result.verdict, machine.text(), result.text);
        println!("page and numbers: {}, {}", page.display(), numbers.display());
    }
    match (earlier, &args.against) {
        (Some(earlier), Some(file)) => judge(&result, args.quick, &machine.key(), &earlier, file),
        _ => Ok(()),
    }
}

/// The error for a file that cannot be written or read.
fn file_error(path: &Path) -> impl FnOnce(std::io::Error) -> OwnCellError {
    let what = path.display().to_string();
    move |error| OwnCellError::File { what, error }
}

fn read_earlier(file: &Path) -> Result<Value, Failure> {
    let bad = |what: &dyn std::fmt::Display| failure(BAD_INPUT, format!("--against {}: {what}", file.display()));
    let text = std::fs::read_to_string(file).map_err(|e| bad(&e))?;
    serde_json::from_str(&text).map_err(|e| bad(&format!("not a jitter.json: {e}")))
}

/// Prints the comparison with an earlier run, and fails if a ratio became worse.
fn judge(result: &Measured, quick: bool, machine: &str, earlier: &Value, file: &Path) -> Result<(), Failure> {
    let compared = against::compare(&result.rounds, quick, machine, earlier)
        .map_err(|what| failure(BAD_INPUT, format!("--against {}: {what}", file.display())))?;
    eprintln!("against {}{}:", file.display(), if quick { ", coarsely" } else { "" });
    for c in &compared {
        eprintln!("{:<66} {:>6.2} -> {:>6.2} {}", c.what, c.before, c.now, if c.worse { "worse" } else { "" });
    }
    let worse: Vec<&str> = compared.iter().filter(|c| c.worse).map(|c| c.what.as_str()).collect();
    if worse.is_empty() { Ok(()) } else { Err(failure(FAILED, format!("worse than {}: {}", file.display(), worse.join("; ")))) }
}
