//! Many seeds on all cores: what they showed, summed up.
//!
//! Uses rayon; the order of the results is that of the seeds, whatever the number of threads. Allocates; cannot fail.

use std::collections::BTreeMap;

use indicatif::{ParallelProgressIterator, ProgressBar, ProgressStyle};
use rayon::prelude::*;
use serde::Serialize;
use sha2::{Digest, Sha256};
use shared::config::Config;
use shared::control::EndReason;

use crate::plan::Plan;
use crate::run::{self, Shown};
use crate::trained::train_for;
use crate::weight_set::TrainedSet;

/// Median, 99th percentile and largest of some numbers.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Spread {
    /// How many.
    pub n: usize,
    /// The median.
    pub p50: f64,
    /// The 99th percentile.
    pub p99: f64,
    /// The largest.
    pub largest: f64,
}

impl Spread {
    /// The spread of `values`; `None` if there are none.
    fn of(mut values: Vec<f64>) -> Option<Self> {
        values.sort_by(f64::total_cmp);
        let at = |share: f64| values.get(((values.len() as f64 - 1.0) * share).round() as usize).copied();
        Some(Self { n: values.len(), p50: at(0.5)?, p99: at(0.99)?, largest: at(1.0)? })
    }
}

/// What a fault cost over many seeds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct CostRow {
    /// The fault.
    pub fault: String,
    /// What left from the fault until the container was upright, ml.
    pub excess_ml: Spread,
    /// How long that took, s.
    pub upright_s: Spread,
}

/// What many seeds showed.
#[derive(Debug, Clone, Serialize)]
pub struct Summary {
    /// The first seed.
    pub from: u64,
    /// Number of seeds.
    pub seeds: u64,
    /// Number of pours and recordings that ended.
    pub pours: usize,
    /// Virtual time, s.
    pub virtual_s: f64,
    /// Number of violations by invariant, and the seeds of the first ones.
    pub violations: BTreeMap<String, (usize, Vec<u64>)>,
    /// How often pours and recordings ended for each reason.
    pub reasons: BTreeMap<String, usize>,
    /// Largest and mean of |true - goal| of the pours that were done without a fault, ml.
    pub done_error_ml: Option<Spread>,
    /// |true - believed| of the same, ml.
    pub done_belief_ml: Option<Spread>,
    /// What faults cost, where no other fault came with them.
    pub costs: Vec<CostRow>,
    /// SHA-256 of everything that was seen: the same seeds give the same.
    pub sha256: String,
}

/// Runs `seeds` seeds from `from`, with a progress bar if `progress`.
pub fn run_many(from: u64, seeds: u64, config: &Config, progress: bool) -> (Vec<Shown>, Summary) {
    let plans: Vec<Plan> = (from..from.saturating_add(seeds)).map(Plan::draw).collect();
    let say = |text: &str| {
        if progress {
            eprintln!("swarm: {text}");
        }
    };
    let trained = train_for(&plans, config, &say);
    let bar = if progress { ProgressBar::new(seeds) } else { ProgressBar::hidden() };
    if let Ok(style) = ProgressStyle::with_template("{pos}/{len} seeds  {wide_bar}  {eta}") {
        bar.set_style(style);
    }
    let shown: Vec<Shown> = plans.par_iter().progress_with(bar).map(|plan| run::run(plan, &trained, config, false)).collect();
    let summary = sum_up(from, seeds, &shown);
    (shown, summary)
}

/// SHA-256 of what was seen, in hexadecimal digits.
pub fn digest(shown: &[Shown]) -> String {
    let mut hash = Sha256::new();
    shown.iter().for_each(|one| hash.update(format!("{one:?}")));
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

fn sum_up(from: u64, seeds: u64, shown: &[Shown]) -> Summary {
    let mut violations: BTreeMap<String, (usize, Vec<u64>)> = BTreeMap::new();
    for one in shown {
        for violation in &one.violations {
            let entry = violations.entry(violation.invariant.to_owned()).or_default();
            entry.0 += 1;
            if entry.1.len() < 12 {
                entry.1.push(one.seed);
            }
        }
    }
    let poured = || shown.iter().flat_map(|one| &one.poured);
    let mut reasons = BTreeMap::new();
    poured().for_each(|p| *reasons.entry(format!("{:?}", p.reason)).or_insert(0) += 1);
    let done = || poured().filter(|p| p.faults == 0 && p.reason == EndReason::Done && p.goal_ml.is_some());
    let mut costs: BTreeMap<&str, (Vec<f64>, Vec<f64>)> = BTreeMap::new();
    for cost in shown.iter().filter(|one| one.costs.len() == 1).flat_map(|one| &one.costs) {
        let entry = costs.entry(&cost.fault).or_default();
        entry.0.push(cost.excess_ml);
        entry.1.push(cost.upright_s);
    }
    let row = |(fault, (ml, s)): (&str, (Vec<f64>, Vec<f64>))| {
        Some(CostRow { fault: fault.to_owned(), excess_ml: Spread::of(ml)?, upright_s: Spread::of(s)? })
    };
    Summary {
        from,
        seeds,
        pours: poured().count(),
        virtual_s: shown.iter().map(|one| one.virtual_s).sum(),
        violations,
        reasons,
        done_error_ml: Spread::of(done().map(|p| (p.true_ml - f64::from(p.goal_ml.unwrap_or(0.0))).abs()).collect()),
        done_belief_ml: Spread::of(done().map(|p| (p.true_ml - f64::from(p.believed_ml)).abs()).collect()),
        costs: costs.into_iter().filter_map(row).collect(),
        sha256: digest(shown),
    }
}

/// The smallest set of faults of a plan with which `invariant` is still violated, found by leaving out one after the other.
pub fn shrink(plan: &Plan, invariant: &str, trained: &TrainedSet, config: &Config) -> Vec<usize> {
    let breaks = |keep: &[usize]| run::run(&plan.keep(keep), trained, config, false).violations.iter().any(|v| v.invariant == invariant);
    let mut keep: Vec<usize> = (0..plan.faults).collect();
    let mut k = 0;
    while k < keep.len() {
        let without: Vec<usize> = keep.iter().copied().enumerate().filter(|(i, _)| *i != k).map(|(_, fault)| fault).collect();
        if breaks(&without) { keep = without } else { k += 1 }
    }
    keep
}
