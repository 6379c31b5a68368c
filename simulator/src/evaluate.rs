//! Pours in closed loop over a held-out grid and reports the errors.
//!
//! Ordinary threads, both cores, full speed; allocates. The same arguments give the same numbers on any number of threads.

use std::process::ExitCode;

use rayon::prelude::*;
use shared::agent::Agent;
use trainer::train::{Estimate, MethodName, Options, Silent};

use crate::physics::episodes::Bench;
use crate::physics::rig::Rig;

pub mod pour;

use pour::{ByAgent, Poured, grid};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
pub struct Args {
    #[arg(long, default_value = "b")]
    sim: String,
    #[arg(long, default_value_t = 20)]
    rigs: u64,
    #[arg(long, default_value_t = 0)]
    first_rig: u64,
    #[arg(long, default_value_t = 1)]
    seeds: u64,
    #[arg(long, default_value_t = 5)]
    episodes: usize,
    #[arg(long, default_value_t = 4)]
    repeats: u64,
    #[arg(long, value_enum, default_value = "fused")]
    estimate: Estimate,
    #[arg(long, default_value = "cylinder")]
    container: String,
}

/// Runs the command; the exit codes are those of [`shared::exit`].
pub fn run(args: &Args) -> ExitCode {
    let jobs: Vec<(u64, u64)> = (args.first_rig..args.first_rig + args.rigs).flat_map(|r| (0..args.seeds).map(move |s| (r, s))).collect();
    let t0 = std::time::Instant::now();
    let all: Vec<(Vec<Poured>, f64)> = jobs
        .par_iter()
        .map(|&(rig_seed, data_seed)| {
            let bench = if args.sim == "a" { Bench::A } else { Bench::on(&Rig::seeded(rig_seed).with_container(&args.container).unwrap()) };
            let episodes = bench.record(args.episodes, data_seed * 1000 + rig_seed);
            let options = Options { method: MethodName::Best, estimate: args.estimate, seed: data_seed + 1, ..Options::default() };
            let begin = std::time::Instant::now();
            let trained = trainer::train::train(&episodes, &options, &Silent).unwrap();
            let secs = begin.elapsed().as_secs_f64();
            let agent = Agent::new(&trained.weights);
            let mut out = Vec::new();
            for repeat in 0..args.repeats {
                for (k, (init, goal)) in grid().into_iter().enumerate() {
                    let mut world = bench.pour(init, 77_000_000 + rig_seed * 100_000 + data_seed * 10_000 + repeat * 100 + k as u64);
                    let mut by = ByAgent::new(agent.clone(), goal);
                    out.push(pour::pour(&mut world, &mut by, options.limits, init, goal));
                }
            }
            (out, secs)
        })
        .collect();
    for ((rig, seed), (pours, secs)) in jobs.iter().zip(&all) {
        let n = pours.len() as f64;
        println!(
            "rig {rig} seed {seed}: mae {:.2} meas {:.2} ctl {:.2} bias {:.2} s {:.1} fail {} train {secs:.2}s",
            pours.iter().map(|p| p.error_ml().abs()).sum::<f64>() / n,
            pours.iter().map(|p| p.measurement_ml().abs()).sum::<f64>() / n,
            pours.iter().map(|p| p.control_ml().abs()).sum::<f64>() / n,
            pours.iter().map(|p| p.error_ml()).sum::<f64>() / n,
            pours.iter().map(|p| p.seconds).sum::<f64>() / n,
            pours.iter().filter(|p| p.failed()).count(),
        );
    }
    let pours: Vec<Poured> = all.into_iter().flat_map(|a| a.0).collect();
    let mut e: Vec<f64> = pours.iter().map(|p| p.error_ml().abs()).collect();
    e.sort_by(f64::total_cmp);
    let n = e.len() as f64;
    println!(
        "MAE {:.3} median {:.2} p95 {:.2} max {:.2} within5 {:.1}% meas {:.3} ctl {:.3} fail {} s/pour {:.2} frames {} wall {:.1}",
        e.iter().sum::<f64>() / n,
        e[e.len() / 2],
        e[(0.95 * n) as usize],
        e[e.len() - 1],
        100.0 * e.iter().filter(|x| **x <= 5.0).count() as f64 / n,
        pours.iter().map(|p| p.measurement_ml().abs()).sum::<f64>() / n,
        pours.iter().map(|p| p.control_ml().abs()).sum::<f64>() / n,
        pours.iter().filter(|p| p.failed()).count(),
        pours.iter().map(|p| p.seconds).sum::<f64>() / n,
        pours.iter().map(|p| u64::from(p.frames)).sum::<u64>(),
        t0.elapsed().as_secs_f64()
    );
    ExitCode::SUCCESS
}
