//! `swarm`: pours in virtual time, under faults that a seed draws.
//!
//! Ordinary threads; allocates. Bad input is one line and exit code 2; a violation is one line for each and exit code 1.

use std::collections::BTreeMap;
use std::io::Write;
use std::path::PathBuf;
use std::process::ExitCode;
use std::sync::atomic::Ordering;

use clap::Parser;
use shared::config::Config;
use shared::exit;
use shared::plural::counted;
use simulator::ur::Series;
use swarm::camera::{Depth, picture_name};
use swarm::faults::KINDS;
use swarm::many::{Seeds, Spread, Summary, at_most, run_until, shrink};
use swarm::plan::{Choice, Only, Plan};
use swarm::plot::plot;
use swarm::run::{self, Shown};
use swarm::trained::train_for;
use swarm::vessels::VESSELS;
use trainer::report::json_out::JsonOut;

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
    /// Runs so many seeds, on all cores. Ctrl-C ends it with those under way, and prints what it has shown so far; the exit code is then 130.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=100_000_000))]
    seeds: Option<u64>,
    /// The first of them.
    #[arg(long, default_value_t = 1, requires = "seeds")]
    from: u64,
    /// Draws in each pour one fault of this kind, and no other, as in `--only link-cut`; a fault of the pictures is there from start to end, as in
    /// `--eye camera --only picture-banding`.
    #[arg(long, value_name = "FAULT")]
    only: Option<String>,
    /// Draws from the first so many vessels only, so that little is trained.
    #[arg(long, value_name = "N", default_value_t = VESSELS.len() as u8, value_parser = clap::value_parser!(u8).range(1..=VESSELS.len() as i64))]
    vessels: u8,
    /// Draws only robots of this generation.
    #[arg(long, value_enum)]
    robot: Option<Robot>,
    /// How deep the eye is: `area` makes areas of flows, `camera` draws frames and measures them as the worker does.
    #[arg(long, value_enum, default_value_t)]
    eye: Depth,
    /// Begins no more of them after so many minutes.
    #[arg(long, requires = "seeds", value_parser = clap::value_parser!(u64).range(1..=100_000))]
    minutes: Option<u64>,
    /// Prints what they showed as JSON in place of the text, or writes it to FILE beside it.
    #[arg(long, requires = "seeds", value_name = "FILE", num_args = 0..=1, default_missing_value = "-")]
    json: Option<PathBuf>,
    /// Keeps only the faults with these numbers, as in `--keep 0,2`; `--keep none` keeps none.
    #[arg(long, requires = "seed")]
    keep: Option<String>,
    /// Looks for faults of which none can be left out for the first invariant that is broken to break.
    #[arg(long, requires = "seed")]
    shrink: bool,
    /// Draws the run to this SVG file.
    #[arg(long, requires = "seed")]
    plot: Option<PathBuf>,
}

/// A generation of robots.
#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum Robot {
    /// 125 Hz.
    Cb3,
    /// 500 Hz.
    ESeries,
}

impl Robot {
    fn series(self) -> Series {
        match self {
            Self::Cb3 => Series::Cb3,
            Self::ESeries => Series::ESeries,
        }
    }
}

fn main() -> ExitCode {
    let args = match Args::try_parse() {
        Ok(args) => args,
        Err(e) if !e.use_stderr() => e.exit(),
        Err(e) => return bad_input(&one_line(&e.to_string())),
    };
    match swarm::site::config().and_then(|config| start(&args, &config)) {
        Ok(Shows::Nothing) => ExitCode::SUCCESS,
        Ok(Shows::Violation) => VIOLATED.into(),
        Ok(Shows::Interrupted) => exit::INTERRUPTED.into(),
        Err(line) => bad_input(&line),
    }
}

/// What clap says of a wrong command line, in one line and without its advice.
fn one_line(text: &str) -> String {
    let first = text.split("\n\n").next().unwrap_or(text).trim_start_matches("error: ");
    first.split_whitespace().collect::<Vec<_>>().join(" ")
}

fn bad_input(line: &str) -> ExitCode {
    eprintln!("error: {line}");
    BAD_INPUT.into()
}

/// What the seeds have shown.
enum Shows {
    /// No violation.
    Nothing,
    /// At least one.
    Violation,
    /// None so far, as a signal has ended it.
    Interrupted,
}

impl Shows {
    fn of(violated: bool, interrupted: bool) -> Self {
        match (violated, interrupted) {
            (true, _) => Self::Violation,
            (false, true) => Self::Interrupted,
            (false, false) => Self::Nothing,
        }
    }
}

/// Carries out the command.
fn start(args: &Args, config: &Config) -> Result<Shows, String> {
    let choice = Choice {
        only: args.only.as_deref().map(|name| Only::named(name, args.eye)).transpose()?,
        vessels: usize::from(args.vessels),
        series: args.robot.map(Robot::series),
        depth: args.eye,
    };
    match (args.seed, args.seeds) {
        (Some(seed), _) => one(args, &Plan::draw_with(seed, choice), config),
        (None, Some(count)) => many(args, Seeds { from: args.from, count, choice }, config),
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
    let number = |part: &str| part.trim().parse().ok().filter(|n| *n < plan.faults.len());
    let there = if plan.faults.is_empty() { "no faults".to_owned() } else { format!("the faults 0 to {}", plan.faults.len() - 1) };
    let wrong = || format!("--keep {text}: seed {} has {there}; give their numbers, as in 0,2, or none", plan.seed);
    text.split(',').map(|part| number(part).ok_or_else(wrong)).collect()
}

/// The options that say from what a seed draws.
fn drawn_from(args: &Args) -> String {
    let only = args.only.as_ref().map_or_else(String::new, |name| format!(" --only {name}"));
    let vessels = if usize::from(args.vessels) < VESSELS.len() { format!(" --vessels {}", args.vessels) } else { String::new() };
    let robot = args.robot.map_or("", |robot| match robot {
        Robot::Cb3 => " --robot cb3",
        Robot::ESeries => " --robot e-series",
    });
    let eye = if args.eye == Depth::Camera { " --eye camera" } else { "" };
    only + &vessels + robot + eye
}

/// One seed.
fn one(args: &Args, drawn: &Plan, config: &Config) -> Result<Shows, String> {
    let (mut plan, seed) = (drawn.clone(), drawn.seed);
    let only = drawn_from(args);
    let mut keep = only.clone();
    if let Some(text) = &args.keep {
        plan = plan.keep(&kept(text, &plan)?);
        keep = format!("{only} --keep {text}");
    }
    let trained = train_for([&plan], config, &|text| eprintln!("swarm: {text}"))?;
    if args.shrink {
        let all = run::run(&plan, &trained, config, false);
        let Some(first) = all.violations.first() else {
            print(&format!("seed {seed}: nothing is violated"));
            return Ok(Shows::Nothing);
        };
        let fewest = shrink(&plan, first.invariant, &trained, config);
        let text = fewest.iter().map(usize::to_string).collect::<Vec<_>>().join(",");
        keep = format!("{only} --keep {}", if text.is_empty() { "none" } else { &text });
        plan = plan.keep(&fewest);
    }
    let shown = run::run(&plan, &trained, config, true);
    let robot = if plan.series == Series::ESeries { "e-Series" } else { "CB3" };
    let (vessel, fill_ml, lag_ms) = (VESSELS[plan.vessel].name, plan.fill_ml, 1000.0 * plan.lag_s);
    print(&format!("{robot} that lags by {lag_ms:.0} ms, {vessel}, {fill_ml:.0} ml"));
    if let Some(fault) = plan.picture {
        print(&format!("whose camera has a fault: {}", picture_name(fault.kind)));
    }
    for item in &plan.items {
        let number = item.fault.map_or_else(String::new, |n| format!("fault {n} ({}): ", KINDS[plan.faults[n]].name));
        print(&format!("{:8.3} s  plan: {number}{:?}", item.at_ms as f64 / 1000.0, item.what));
    }
    shown.story.iter().for_each(|line| print(line));
    for poured in &shown.poured {
        let goal = poured.goal_ml.map_or_else(|| "a curve".into(), |goal_ml| format!("goal {goal_ml:.1} ml"));
        let (reason, believed_ml, sd_ml, true_ml) = (poured.reason.words(), poured.believed_ml, poured.sd_ml, poured.true_ml);
        print(&format!("{goal}: {reason}; believed {believed_ml:.1} +- {sd_ml:.1} ml, left {true_ml:.1} ml"));
    }
    for cost in &shown.costs {
        print(&format!(
            "{}: {:.1} ml left after it could be noticed, {:.1} after it, upright after {:.2} s",
            cost.fault, cost.excess_ml, cost.since_ml, cost.upright_s
        ));
    }
    if let Some(path) = &args.plot {
        plot(&plan, &shown, path)?;
    }
    complain(&shown, &keep);
    Ok(Shows::of(!shown.violations.is_empty(), false))
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
fn many(args: &Args, seeds: Seeds, config: &Config) -> Result<Shows, String> {
    // A file that cannot be written is known before an hour of work.
    let json = JsonOut::open(args.json.as_deref()).map_err(|e| e.what)?;
    let started = std::time::Instant::now();
    let until = args.minutes.map(|minutes| started + std::time::Duration::from_secs(60 * minutes));
    // What an hour has shown is not lost with Ctrl-C.
    let stop = shared::os::stop_at_signals().map_err(|e| format!("the signals that end a program cannot be watched: {e}"))?;
    let over = || {
        let is_late = until.is_some_and(|until| std::time::Instant::now() >= until);
        stop.load(Ordering::Relaxed).then_some("stopped").or(is_late.then_some("the time is over"))
    };
    let (shown, summary) = run_until(seeds, config, &over, true)?;
    if json.tables() {
        shown.iter().filter(|one| !one.violations.is_empty()).take(10).for_each(|one| {
            print(&format!("seed {}:", one.seed));
            complain(one, &drawn_from(args));
        });
        report(&summary, started.elapsed().as_secs_f64());
    }
    if json.wanted() {
        json.write(&serde_json::json!({ "summary": summary, "seeds": shown })).map_err(|e| e.what)?;
    }
    if let Some(line) = summary.lost {
        return Err(line);
    }
    Ok(Shows::of(!summary.violations.is_empty(), stop.load(Ordering::Relaxed)))
}

/// Median, 99th percentile and largest.
fn spread(of: &Spread) -> String {
    format!("{:.1}, {:.1}, {:.1}", of.p50, of.p99, of.largest)
}

/// How often pours ended for another reason than their goal.
fn otherwise(reasons: &BTreeMap<String, usize>) -> String {
    let others = reasons.iter().filter(|(reason, _)| *reason != "Done");
    others.map(|(reason, n)| format!("{n} {reason}")).collect::<Vec<_>>().join(", ")
}

/// Prints what many seeds showed.
fn report(summary: &Summary, wall_s: f64) {
    let last = (summary.from + summary.seeds).saturating_sub(1);
    let (pours, virtual_s, [cb3, e_series]) = (summary.pours, summary.virtual_s, summary.by_robot);
    let times = virtual_s / summary.processor_s.max(1e-9);
    print(&format!(
        "seeds {} to {last}: {pours} pours and recordings ({cb3} on a CB3, {e_series} on an e-Series), {virtual_s:.0} s in {wall_s:.1} s; \
{times:.0} times real time a core, training left out",
        summary.from
    ));
    let [drawn_s, measured_s] = summary.camera_s;
    if drawn_s > 0.0 {
        let share = |s: f64| 100.0 * s / summary.processor_s.max(1e-9);
        print(&format!("of the time, {:.0} % drew pictures and {:.0} % measured them", share(drawn_s), share(measured_s)));
    }
    let violating = summary.violations.values().map(|(n, _)| n).sum::<usize>();
    if pours > 0 {
        let seen = if violating == 0 { "no violation".to_owned() } else { counted(violating, "violation") };
        let rate = |n: usize| at_most(violating) / n as f64;
        print(&format!("{seen} in {pours}: at 95 % fewer than {:.1e} a pour, if pours are drawn as here", rate(pours)));
        if violating == 0 && cb3 > 0 && e_series > 0 {
            print(&format!("on a CB3 alone fewer than {:.1e}, on an e-Series alone fewer than {:.1e}", rate(cb3), rate(e_series)));
        }
    }
    print(&format!("ended: {:?}", summary.reasons));
    print("| vessel | n undisturbed | done | left - goal, ml: median, p99, largest | ended otherwise |");
    for row in &summary.undisturbed {
        let done = row.error_ml.as_ref().map_or(0, |error| error.n);
        let others = otherwise(&row.reasons);
        let error = row.error_ml.as_ref().map_or_else(|| "-".into(), spread);
        print(&format!("| {} | {} | {:.1} % | {error} | {others} |", row.vessel, row.n, 100.0 * done as f64 / row.n as f64));
    }
    print(
        "| fault | n done | left - goal, ml: median, p99, largest | left - said, ml: median, p99, largest | within 2 deviations | ended otherwise |",
    );
    for row in &summary.done {
        let n = row.error_ml.map_or(0, |error| error.n);
        let [error, said] = [row.error_ml, row.said_ml].map(|of| of.map_or_else(|| "-".into(), |of| spread(&of)));
        let covered = row.covered.map_or_else(|| "-".into(), |share| format!("{:.0} %", 100.0 * share));
        print(&format!("| {} | {n} | {error} | {said} | {covered} | {} |", row.fault, otherwise(&row.reasons)));
    }
    print(
        "| fault | in a | n ended | ml after it could be noticed: median, p99, largest | bound, ml | largest share of its bound | \
ml after it | s until upright |",
    );
    for row in &summary.costs {
        let bound = row.bound_ml.as_ref().map_or_else(|| "the vessel".into(), spread);
        let share = row.largest_share.map_or_else(|| "-".into(), |share| format!("{:.0} %", 100.0 * share));
        let (excess, since, upright) = (spread(&row.excess_ml), spread(&row.since_ml), spread(&row.upright_s));
        let run = if row.in_pour { "pour" } else { "recording" };
        print(&format!("| {} | {run} | {} | {excess} | {bound} | {share} | {since} | {upright} |", row.fault, row.excess_ml.n));
    }
    for (invariant, (n, seeds)) in &summary.violations {
        print(&format!("VIOLATED {invariant}: {n} seeds, such as {seeds:?}"));
    }
    print(&format!("sha256 of all that was seen: {}", summary.sha256));
}
