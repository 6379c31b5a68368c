//! `swarm`: pours in virtual time, under faults that a seed draws.
//!
//! Ordinary threads; allocates. Bad input is one line and exit code 2; a violation is exit code 1.

use std::process::ExitCode;

use swarm::plan::Plan;
use swarm::trained::TrainedSet;

fn main() -> ExitCode {
    let seed: u64 = std::env::args().nth(1).and_then(|s| s.parse().ok()).unwrap_or(1);
    let Ok(config) = swarm::site::config() else { return ExitCode::FAILURE };
    let plan = Plan::draw(seed);
    let trained = TrainedSet::for_plans([&plan], &config, &|t| eprintln!("{t}"));
    let t = std::time::Instant::now();
    let shown = swarm::run::run(&plan, &trained, &config, true);
    shown.story.iter().for_each(|l| println!("{l}"));
    println!("{:?} {:?} {:?}", shown.violations, shown.poured, shown.costs);
    println!("{} s in {:?}", shown.virtual_s, t.elapsed());
    ExitCode::SUCCESS
}
