//! Many seeds on all cores: what they showed, summed up.
//!
//! Uses rayon; the order of the results is that of the seeds, whatever the number of threads. Allocates; cannot fail.

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use indicatif::{ParallelProgressIterator, ProgressBar, ProgressStyle};
use rayon::prelude::*;
use rustix::time::{ClockId, clock_gettime};
use serde::Serialize;
use sha2::{Digest, Sha256};
use shared::config::Config;
use shared::control::EndReason;
use simulator::ur::Series;
use simulator::ur::servo::LAG_S;

use crate::camera;
use crate::costs::{Cost, Poured};
use crate::plan::{Choice, Plan};
use crate::run::{self, Shown};
use crate::trained::train_for;
use crate::undisturbed::is_undisturbed;
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
    /// Whether it came in pours, and not in recordings.
    pub in_pour: bool,
    /// What left from the moment in which it could first be noticed until the container was upright, ml.
    pub excess_ml: Spread,
    /// The most that may, ml; `None` if only the vessel bounds it.
    pub bound_ml: Option<Spread>,
    /// The largest share of its bound that left.
    pub largest_share: Option<f64>,
    /// What left from the fault itself until then, ml.
    pub since_ml: Spread,
    /// How long that took, s.
    pub upright_s: Spread,
}

/// How pours with at most one fault ended, and how near those that were done came, over many seeds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DoneRow {
    /// The one fault that happened, "none", or [`OTHER_LAG`].
    pub fault: String,
    /// How often they ended for each reason.
    pub reasons: BTreeMap<String, usize>,
    /// |left - goal| of those that were done, ml; `None` if none was.
    pub error_ml: Option<Spread>,
    /// |left - said| of those, ml.
    pub said_ml: Option<Spread>,
    /// The share of those whose truth lies within two of their own standard deviations of what they say; 0.95 is claimed.
    pub covered: Option<f64>,
}

/// How pours ended that nothing disturbed ([`crate::undisturbed`]), over many seeds.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct UndisturbedRow {
    /// The vessel.
    pub vessel: String,
    /// Number of pours.
    pub n: usize,
    /// How often they ended for each reason.
    pub reasons: BTreeMap<String, usize>,
    /// |left - goal| of those that were done, ml.
    pub error_ml: Option<Spread>,
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
    /// How many of them on a CB3, and how many on an e-Series.
    pub by_robot: [usize; 2],
    /// Virtual time, s.
    pub virtual_s: f64,
    /// Processor time that it took on all cores together, without the training, s.
    pub processor_s: f64,
    /// Processor time that went into drawing pictures and measuring them, without the training, s.
    pub camera_s: [f64; 2],
    /// The training that failed, so that the seeds after it were left out.
    pub lost: Option<String>,
    /// Number of violations by invariant, and the seeds of the first ones.
    pub violations: BTreeMap<String, (usize, Vec<u64>)>,
    /// How often pours and recordings ended for each reason.
    pub reasons: BTreeMap<String, usize>,
    /// How pours ended that nothing disturbed, by vessel.
    pub undisturbed: Vec<UndisturbedRow>,
    /// How pours ended where at most one fault happened.
    pub done: Vec<DoneRow>,
    /// What faults cost that ended a pour, where no other fault came with them.
    pub costs: Vec<CostRow>,
    /// SHA-256 of everything that was seen: the same seeds give the same.
    pub sha256: String,
}

/// What the table calls pours without a fault on a robot that lags by more than twice what was learned.
pub const OTHER_LAG: &str = "none, but more than twice the lag";
/// How many seeds are run between two looks at the time, and at what asks for an end.
const AT_ONCE: u64 = 256;
/// How often it is said how far it is, where there is no terminal. Chosen by hand: a line a minute.
const TELLS: Duration = Duration::from_secs(60);

/// The most that something happens on average, at 95 %, that happened `seen` times: the mean of the Poisson distribution that gives no more than
/// this in one case of 20. For none it is 3.0.
pub fn at_most(seen: usize) -> f64 {
    let no_more = |mean: f64| {
        let mut term = (-mean).exp();
        (1..=seen).fold(term, |sum, k| {
            term *= mean / k as f64;
            sum + term
        })
    };
    let (mut low, mut high) = (0.0, 10.0 + 2.0 * seen as f64 + 6.0 * (seen as f64).sqrt());
    for _ in 0..60 {
        let mean = 0.5 * (low + high);
        if no_more(mean) > 0.05 { low = mean } else { high = mean }
    }
    high
}

/// Which seeds are run.
#[derive(Debug, Clone, Copy)]
pub struct Seeds {
    /// The first.
    pub from: u64,
    /// How many.
    pub count: u64,
    /// From what they draw.
    pub choice: Choice,
}

/// Runs seeds on all cores, with a progress bar if `progress`.
///
/// # Errors
/// As of [`train_for`].
pub fn run_many(seeds: Seeds, config: &Config, progress: bool) -> Result<(Vec<Shown>, Summary), String> {
    run_until(seeds, config, &|| None, progress)
}

/// The same, but begins no more of them once `over` says why.
///
/// # Errors
/// As of [`train_for`].
pub fn run_until(
    seeds: Seeds,
    config: &Config,
    over: &dyn Fn() -> Option<&'static str>,
    progress: bool,
) -> Result<(Vec<Shown>, Summary), String> {
    let last =
        seeds.from.checked_add(seeds.count).ok_or_else(|| format!("--from {} leaves fewer than {} seeds", seeds.from, seeds.count))?;
    let say = |text: &str| {
        if progress {
            eprintln!("swarm: {text}");
        }
    };
    let bar = if progress { ProgressBar::new(seeds.count) } else { ProgressBar::hidden() };
    if let Ok(style) = ProgressStyle::with_template("{pos}/{len} seeds  {wide_bar}  {eta}") {
        bar.set_style(style);
    }
    let mut shown: Vec<Shown> = Vec::new();
    let (mut spent_s, mut camera_s) = (0.0, [0.0; 2]);
    let (mut told, mut lost) = (Instant::now(), None);
    for from in (seeds.from..last).step_by(AT_ONCE as usize) {
        if let Some(why) = over() {
            say(&format!("{why}: {} of {} seeds were run", shown.len(), seeds.count));
            break;
        }
        // Without a terminal there is no bar.
        if bar.is_hidden() && told.elapsed() >= TELLS {
            say(&format!("{} of {} seeds", shown.len(), seeds.count));
            told = Instant::now();
        }
        let plans: Vec<Plan> = (from..last.min(from.saturating_add(AT_ONCE))).map(|seed| Plan::draw_with(seed, seeds.choice)).collect();
        let trained = match train_for(&plans, config, &say) {
            Err(line) if !shown.is_empty() => {
                lost = Some(line);
                break;
            }
            trained => trained?,
        };
        let (before_s, [drawn_s, measured_s]) = (processor_s(), camera::spent_s());
        let bar = bar.clone();
        let new: Vec<Shown> = plans.par_iter().progress_with(bar).map(|plan| run::run(plan, &trained, config, false)).collect();
        let camera_now_s = camera::spent_s();
        spent_s += processor_s() - before_s;
        camera_s = [camera_s[0] + camera_now_s[0] - drawn_s, camera_s[1] + camera_now_s[1] - measured_s];
        for (one, first) in new.iter().filter_map(|one| Some((one, one.violations.first()?))) {
            say(&format!("seed {} violates {}", one.seed, first.invariant));
        }
        shown.extend(new);
    }
    let summary = Summary { processor_s: spent_s, camera_s, lost, ..sum_up(seeds.from, &shown) };
    Ok((shown, summary))
}

/// Processor time of this process, s.
fn processor_s() -> f64 {
    let time = clock_gettime(ClockId::ProcessCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 / 1e9
}

/// SHA-256 of what was seen, in hexadecimal digits.
pub fn digest(shown: &[Shown]) -> String {
    let mut hash = Sha256::new();
    shown.iter().for_each(|one| hash.update(format!("{one:?}")));
    hash.finalize().iter().map(|byte| format!("{byte:02x}")).collect()
}

fn sum_up(from: u64, shown: &[Shown]) -> Summary {
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
    let reasons = reasons(&poured().collect::<Vec<_>>());
    let mut done: BTreeMap<&str, Vec<&Poured>> = BTreeMap::new();
    for (one, p) in shown.iter().flat_map(|one| one.poured.iter().map(move |p| (one, p))) {
        if p.goal_ml.is_some() && p.faults.len() <= 1 {
            let none = if one.lag_s > 2.0 * LAG_S { OTHER_LAG } else { "none" };
            done.entry(p.faults.first().copied().unwrap_or(none)).or_default().push(p);
        }
    }
    let mut costs: BTreeMap<(&str, bool), Vec<&Cost>> = BTreeMap::new();
    for cost in shown.iter().filter(|one| one.costs.len() == 1).flat_map(|one| &one.costs) {
        costs.entry((cost.fault, cost.in_pour)).or_default().push(cost);
    }
    let on = |series: Series| shown.iter().filter(|one| one.series == series).map(|one| one.poured.len()).sum::<usize>();
    Summary {
        from,
        seeds: shown.len() as u64,
        pours: poured().count(),
        by_robot: [on(Series::Cb3), on(Series::ESeries)],
        virtual_s: shown.iter().map(|one| one.virtual_s).sum(),
        processor_s: 0.0,
        camera_s: [0.0; 2],
        lost: None,
        violations,
        reasons,
        undisturbed: undisturbed(shown),
        done: done.into_iter().map(done_row).collect(),
        costs: costs.into_iter().filter_map(|(key, costs)| cost_row(key, &costs)).collect(),
        sha256: digest(shown),
    }
}

/// How pours ended that nothing disturbed.
fn undisturbed(shown: &[Shown]) -> Vec<UndisturbedRow> {
    let mut by_vessel: BTreeMap<&str, Vec<&Poured>> = BTreeMap::new();
    for one in shown {
        by_vessel.entry(one.vessel).or_default().extend(one.poured.iter().filter(|p| is_undisturbed(one.lag_s, p)));
    }
    let row = |(vessel, poured): (&str, Vec<&Poured>)| {
        let error_ml = error_ml(poured.iter().filter(|p| p.reason == EndReason::Done));
        UndisturbedRow { vessel: vessel.to_owned(), n: poured.len(), reasons: reasons(&poured), error_ml }
    };
    by_vessel.into_iter().filter(|(_, poured)| !poured.is_empty()).map(row).collect()
}

/// How pours with one fault ended, or with none.
fn done_row((fault, poured): (&str, Vec<&Poured>)) -> DoneRow {
    let done = || poured.iter().filter(|p| p.reason == EndReason::Done);
    let off_ml = |p: &&Poured| (p.true_ml - f64::from(p.believed_ml)).abs();
    let covered = done().filter(|p| off_ml(p) <= 2.0 * f64::from(p.sd_ml)).count();
    let said_ml = Spread::of(done().map(off_ml).collect());
    let covered = said_ml.map(|said| covered as f64 / said.n as f64);
    DoneRow { fault: fault.to_owned(), reasons: reasons(&poured), error_ml: error_ml(done()), said_ml, covered }
}

/// How often pours ended for each reason.
fn reasons(poured: &[&Poured]) -> BTreeMap<String, usize> {
    let mut reasons = BTreeMap::new();
    poured.iter().for_each(|p| *reasons.entry(format!("{:?}", p.reason)).or_insert(0) += 1);
    reasons
}

/// |left - goal| of pours, ml.
fn error_ml<'a>(poured: impl Iterator<Item = &'a &'a Poured>) -> Option<Spread> {
    Spread::of(poured.filter_map(|p| Some((p.true_ml - f64::from(p.goal_ml?)).abs())).collect())
}

/// What a fault cost.
fn cost_row((fault, in_pour): (&str, bool), costs: &[&Cost]) -> Option<CostRow> {
    let of = |value: fn(&Cost) -> f64| Spread::of(costs.iter().map(|cost| value(cost)).collect());
    let bounded = || costs.iter().filter_map(|cost| Some((cost.excess_ml, cost.bound_ml?)));
    Some(CostRow {
        fault: fault.to_owned(),
        in_pour,
        excess_ml: of(|cost| cost.excess_ml)?,
        bound_ml: Spread::of(bounded().map(|(_, bound_ml)| bound_ml).collect()),
        largest_share: bounded().map(|(excess_ml, bound_ml)| excess_ml / bound_ml).reduce(f64::max),
        since_ml: of(|cost| cost.since_ml)?,
        upright_s: of(|cost| cost.upright_s)?,
    })
}

/// Faults of a plan with which `invariant` is still violated, and of which none can be left out: found by leaving out one after the other.
pub fn shrink(plan: &Plan, invariant: &str, trained: &TrainedSet, config: &Config) -> Vec<usize> {
    let breaks = |keep: &[usize]| run::run(&plan.keep(keep), trained, config, false).violations.iter().any(|v| v.invariant == invariant);
    let mut keep: Vec<usize> = (0..plan.faults.len()).collect();
    let mut k = 0;
    while k < keep.len() {
        let without: Vec<usize> = keep.iter().copied().enumerate().filter(|(i, _)| *i != k).map(|(_, fault)| fault).collect();
        if breaks(&without) { keep = without } else { k += 1 }
    }
    keep
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the claim: the bound of a number that was seen is that of the Poisson distribution's tables.
    #[test]
    fn the_bound_is_that_of_the_tables() {
        for (seen, most) in [(0, 2.996), (1, 4.744), (2, 6.296), (5, 10.513), (10, 16.962)] {
            assert!((at_most(seen) - most).abs() < 2e-3, "{seen}: {}", at_most(seen));
        }
    }
}
