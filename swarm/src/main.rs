//! `swarm`: pours in virtual time, under faults that a seed draws.
//!
//! Ordinary threads; allocates. Bad input is one line and exit code 2; a violation is one line for each and exit code 1.

use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;

use clap::Parser;
use shared::config::Config;
use swarm::many::{Summary, run_many, shrink};
use swarm::plan::Plan;
use swarm::plot::plot;
use swarm::run::{self, Shown};
use swarm::trained::train_for;

/// Exit code of a violation.
const VIOLATED: u8 = 1;
/// Exit code of bad input, as that of the other programs.
const BAD_INPUT: u8 = 2;

/// Runs the whole cell in virtual time, from seeds, and checks what must always hold.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "Examples:\n  swarm --seed 7\n  swarm --seeds 3000 --from 1 --json out/swarm.json\n  \
swarm --seed 7 --shrink\n  swarm --seed 7 --keep 0,2 --plot out/seed-7.svg"
)]
struct Args {
    /// Runs this seed and prints what happens.
    #[arg(long, conflicts_with = "seeds", required_unless_present = "seeds")]
    seed: Option<u64>,
    /// Runs so many seeds, on all cores.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=100_000_000))]
    seeds: Option<u64>,
    /// The first of them.
    #[arg(long, default_value_t = 1, requires = "seeds")]
    from: u64,
    /// Writes what they showed to this file.
    #[arg(long, requires = "seeds")]
    json: Option<PathBuf>,
    /// Keeps only the faults with these numbers, as in `--keep 0,2`; `--keep none` keeps none.
    #[arg(long, requires = "seed")]
    keep: Option<String>,
    /// Looks for the fewest faults that still break the first invariant that is broken.
    #[arg(long, requires = "seed")]
    shrink: bool,
    /// Draws the run to this SVG file.
    #[arg(long, requires = "seed")]
    plot: Option<PathBuf>,
}

fn main() -> ExitCode {
    let args = Args::parse();
    match swarm::site::config().and_then(|config| start(&args, &config)) {
        Ok(true) => ExitCode::SUCCESS,
        Ok(false) => VIOLATED.into(),
        Err(line) => {
            eprintln!("swarm: {line}");
            BAD_INPUT.into()
        }
    }
}

/// Carries out the command. False if an invariant was violated.
fn start(args: &Args, config: &Config) -> Result<bool, String> {
    match (args.seed, args.seeds) {
        (Some(seed), _) => one(args, seed, config),
        (None, Some(seeds)) => many(args, seeds, config),
        (None, None) => Err("give --seed or --seeds".into()),
    }
}

/// Prints a line; a reader that has gone away does not matter.
fn print(line: &str) {
    let _ = writeln!(std::io::stdout(), "{line}");
}

/// The numbers in `--keep`.
fn kept(text: &str, plan: &Plan) -> Result<Vec<usize>, String> {
    if text == "none" {
        return Ok(Vec::new());
    }
    let number = |part: &str| part.trim().parse().ok().filter(|n| *n < plan.faults);
    let wrong =
        || format!("--keep {text}: seed {} has the faults 0 to {}; give their numbers, as in 0,2", plan.seed, plan.faults.max(1) - 1);
    text.split(',').map(|part| number(part).ok_or_else(wrong)).collect()
}

/// One seed.
fn one(args: &Args, seed: u64, config: &Config) -> Result<bool, String> {
    let mut plan = Plan::draw(seed);
    let trained = train_for([&plan], config, &|text| eprintln!("swarm: {text}"));
    let mut keep = String::new();
    if let Some(text) = &args.keep {
        plan = plan.keep(&kept(text, &plan)?);
        keep = format!(" --keep {text}");
    }
    if args.shrink {
        let all = run::run(&plan, &trained, config, false);
        let Some(first) = all.violations.first() else {
            print(&format!("seed {seed}: nothing is violated"));
            return Ok(true);
        };
        let fewest = shrink(&plan, first.invariant, &trained, config);
        let text = fewest.iter().map(usize::to_string).collect::<Vec<_>>().join(",");
        keep = format!(" --keep {}", if text.is_empty() { "none" } else { &text });
        plan = plan.keep(&fewest);
    }
    let shown = run::run(&plan, &trained, config, true);
    for item in &plan.items {
        let number = item.fault.map_or_else(String::new, |n| format!("fault {n}: "));
        print(&format!("{:8.3} s  plan: {number}{:?}", item.at_ms as f64 / 1000.0, item.what));
    }
    shown.story.iter().for_each(|line| print(line));
    for poured in &shown.poured {
        let goal = poured.goal_ml.map_or_else(|| "a curve".into(), |goal_ml| format!("goal {goal_ml:.1} ml"));
        let (reason, believed_ml, true_ml) = (poured.reason.words(), poured.believed_ml, poured.true_ml);
        print(&format!("{goal}: {reason}; believed {believed_ml:.1} ml, left {true_ml:.1} ml"));
    }
    for cost in &shown.costs {
        print(&format!("after {}: {:.1} ml more, upright after {:.2} s", cost.fault, cost.excess_ml, cost.upright_s));
    }
    if let Some(path) = &args.plot {
        plot(&plan, &shown, path)?;
    }
    complain(&shown, &keep);
    Ok(shown.violations.is_empty())
}

/// Prints the violations of a seed, and how to see them again.
fn complain(shown: &Shown, keep: &str) {
    for violation in &shown.violations {
        let seed = shown.seed;
        print(&format!("VIOLATED {} at {:.3} s: {}", violation.invariant, violation.at_s, violation.what));
        print(&format!("  again, with a plot: swarm --seed {seed}{keep} --plot seed-{seed}.svg"));
    }
}

/// Many seeds.
fn many(args: &Args, seeds: u64, config: &Config) -> Result<bool, String> {
    // A file that cannot be written is known before an hour of work.
    let open = |path: &Path| std::fs::File::create(path).map_err(|e| format!("{}: cannot be written: {e}", path.display()));
    let file = args.json.as_deref().map(open).transpose()?;
    let started = std::time::Instant::now();
    let (shown, summary) = run_many(args.from, seeds, config, true);
    shown.iter().filter(|one| !one.violations.is_empty()).take(10).for_each(|one| {
        print(&format!("seed {}:", one.seed));
        complain(one, "");
    });
    report(&summary, started.elapsed().as_secs_f64());
    if let (Some(file), Some(path)) = (file, &args.json) {
        let value = serde_json::json!({ "summary": summary, "seeds": shown });
        let written = serde_json::to_writer(std::io::BufWriter::new(file), &value);
        written.map_err(|e| format!("{}: cannot be written: {e}; is the disk full?", path.display()))?;
    }
    Ok(summary.violations.is_empty())
}

/// Prints what many seeds showed.
fn report(summary: &Summary, wall_s: f64) {
    let last = summary.from + (summary.seeds - 1);
    let (pours, virtual_s) = (summary.pours, summary.virtual_s);
    print(&format!("seeds {} to {last}: {pours} pours and recordings, {virtual_s:.0} s in {wall_s:.1} s", summary.from));
    print(&format!("ended: {:?}", summary.reasons));
    if let (Some(error), Some(belief)) = (summary.done_error_ml, summary.done_belief_ml) {
        print(&format!(
            "done without a fault: |left - goal| {:.1} ml, p99 {:.1}, largest {:.1}; |left - believed| {:.1}, p99 {:.1}, largest {:.1}; n = {}",
            error.p50, error.p99, error.largest, belief.p50, belief.p99, belief.largest, error.n
        ));
    }
    print("fault | n | ml more: median, p99, largest | s until upright: median, p99, largest");
    for row in &summary.costs {
        let (ml, s) = (row.excess_ml, row.upright_s);
        print(&format!(
            "{} | {} | {:.1}, {:.1}, {:.1} | {:.2}, {:.2}, {:.2}",
            row.fault, ml.n, ml.p50, ml.p99, ml.largest, s.p50, s.p99, s.largest
        ));
    }
    for (invariant, (n, seeds)) in &summary.violations {
        print(&format!("VIOLATED {invariant}: {n} seeds, such as {seeds:?}"));
    }
    print(&format!("sha256 of all that was seen: {}", summary.sha256));
}
