//! The cell and cyclictest in turns, at rest and under load.
//!
//! Ordinary thread; allocates and blocks. Their order changes from round to round, so that warming up affects both alike.

use serde_json::{Map, Value, json};
use trainer::report::page;

use super::cell_run::{CellRun, run_cell};
use super::measured::{Measured, facts_html};
use super::other_programs::{cyclictest, latencies_us, load};
use super::statistics::{histograms, median, summary};
use super::tick_times::{SPANS, Span, TickTimes};
use crate::own_cell::{OwnCell, OwnCellError};

/// The conditions under which the machine is measured.
const CONDITIONS: [&str; 2] = ["at rest", "under load"];

/// What was measured under one condition: a run of the cell and of cyclictest (latencies in us) for each round.
#[derive(Default)]
struct Condition {
    cells: Vec<CellRun>,
    yardsticks: Vec<Vec<f64>>,
}

/// Measures in `rounds` rounds with runs of `seconds`.
///
/// # Errors
/// When the cell or cyclictest cannot be run, or Ctrl-C is pressed; what was measured until then is lost.
pub fn measure(cell: &mut OwnCell, rounds: usize, seconds: u64) -> Result<Measured, OwnCellError> {
    let mut conditions: [Condition; 2] = Default::default();
    for round in 0..rounds {
        for (condition, name) in conditions.iter_mut().zip(CONDITIONS) {
            let _load = if name == CONDITIONS[1] { Some(load()?) } else { None };
            for turn in 0..2 {
                if (turn + round) % 2 == 0 {
                    cell.note(&format!("round {} of {rounds}: the cell {name}", round + 1));
                    condition.cells.push(run_cell(cell, seconds)?);
                } else {
                    cell.note(&format!("round {} of {rounds}: cyclictest {name}", round + 1));
                    condition.yardsticks.push(run_cyclictest(cell, seconds)?);
                }
            }
        }
    }
    let (mut text, mut html, mut numbers) = (String::new(), String::new(), Map::new());
    for (condition, name) in conditions.iter().zip(CONDITIONS) {
        let told = Told::new(condition);
        text += &told.text(name);
        html += &told.html(name);
        numbers.insert(name.into(), told.numbers(condition));
    }
    Ok(Measured { numbers: Value::Object(numbers), text, html })
}

/// Latencies of one run of cyclictest, us.
fn run_cyclictest(cell: &OwnCell, seconds: u64) -> Result<Vec<f64>, OwnCellError> {
    let child = cyclictest(cell, seconds, 0)?;
    let output = child.wait_with_output().map_err(|error| OwnCellError::File { what: "cyclictest".into(), error })?;
    cell.interrupted()?;
    let latencies = latencies_us(&output.stdout);
    if latencies.is_empty() {
        return Err(OwnCellError::Other("cyclictest printed no sample: may it use SCHED_FIFO and lock memory?".into()));
    }
    Ok(latencies)
}

/// What is reported about one condition, over all rounds.
struct Told {
    ticks: TickTimes,
    /// Latencies of cyclictest, us.
    yardstick: Vec<f64>,
    /// Wake-up lateness of the loop relative to cyclictest's: p50 and p99, medians of the rounds.
    ratios: [f64; 2],
    idle_percent: f64,
    allocations: u64,
    page_faults: u64,
    facts: Vec<String>,
}

impl Told {
    fn new(condition: &Condition) -> Self {
        let (runs, yard) = (&condition.cells, &condition.yardsticks);
        let mut ticks = TickTimes::default();
        runs.iter().for_each(|run| ticks.add(&run.ticks));
        let ratio =
            |k: usize| median(runs.iter().map(|r| summary(r.ticks.of(Span::Lateness))[k])) / median(yard.iter().map(|y| summary(y)[k]));
        let ratios = [ratio(1), ratio(2)];
        let idle_percent = median(runs.iter().map(|r| r.idle_percent));
        let allocations: u64 = runs.iter().map(|r| r.allocations).sum();
        let page_faults: u64 = runs.iter().map(|r| r.page_faults).sum();
        let mut facts = vec![
            format!(
                "wake-up lateness, rt-controller / cyclictest, median of {} rounds: p50 {:.2}, p99 {:.2}",
                runs.len(),
                ratios[0],
                ratios[1]
            ),
            format!(
                "ticks lost {}, later than half a period {}; loop: {allocations} allocations, {page_faults} page faults",
                ticks.lost, ticks.late
            ),
        ];
        if let Some(last) = runs.last() {
            let (controller, worker) = (last.controller, last.worker);
            facts.push(format!(
                "rt-controller without a pour: {idle_percent:.2} % of a core; resident {:.1} MiB, locked {:.1} MiB",
                controller.resident_mib, controller.locked_mib
            ));
            facts.push(format!("feature-worker: resident {:.1} MiB, locked {:.1} MiB", worker.resident_mib, worker.locked_mib));
        }
        Self { ticks, yardstick: yard.concat(), ratios, idle_percent, allocations, page_faults, facts }
    }

    /// The rows of the table: a name, and its number, p50, p99, p99.9 and maximum in us.
    fn table(&self) -> Vec<(&'static str, [f64; 5])> {
        let spans = SPANS.iter().zip(&self.ticks.spans_us).map(|(name, values)| (*name, summary(values)));
        spans.chain([("cyclictest: wake-up lateness", summary(&self.yardstick))]).collect()
    }

    /// The same as words, with a heading.
    fn rows(&self) -> Vec<Vec<String>> {
        let mut rows = vec![["us", "n", "p50", "p99", "p99.9", "max"].map(String::from).to_vec()];
        for (name, s) in self.table() {
            let numbers = s[1..].iter().map(|x| format!("{x:.1}"));
            rows.push([name.to_owned(), format!("{:.0}", s[0])].into_iter().chain(numbers).collect());
        }
        rows
    }

    fn text(&self, name: &str) -> String {
        let mut text = format!("\n{name}\n");
        for row in self.rows() {
            text += &format!("{:<32} {:>7} {:>9} {:>9} {:>9} {:>9}\n", row[0], row[1], row[2], row[3], row[4], row[5]);
        }
        for fact in &self.facts {
            text += &format!("{fact}\n");
        }
        text
    }

    fn html(&self, name: &str) -> String {
        let t = &self.ticks;
        let [lateness, execution, pouring] = [Span::Lateness, Span::Execution, Span::PouringExecution].map(|span| t.of(span));
        let figures = [
            histograms(
                "us",
                "Wake-up lateness; the last step holds what is beyond.",
                &[("rt-controller", lateness), ("cyclictest", &self.yardstick)],
            ),
            histograms("us", "Tick execution.", &[("all ticks", execution), ("in pours", pouring)]),
            histograms("us", "From the worker's receipt of a frame to its V_e.", &[("extraction", t.of(Span::ReceivedToPublished))]),
            histograms(
                "us",
                "From the wake-up to the target's bytes on the socket.",
                &[("deciding", t.of(Span::WakeToDecided)), ("the kernel's send", t.of(Span::DecidedToWritten))],
            ),
            histograms(
                "us",
                "The way of a frame: exposure to its V_e's use.",
                &[
                    ("V_e waits for its tick", t.of(Span::PublishedToWake)),
                    ("exposure to bytes on the socket", t.of(Span::CaptureToWritten)),
                ],
            ),
        ];
        format!("<h2>{name}</h2>{}{}<div class=plots>{}</div>", page::table(&self.rows()), facts_html(&self.facts), figures.concat())
    }

    fn numbers(&self, condition: &Condition) -> Value {
        let row = |s: [f64; 5]| json!({ "n": s[0], "p50_us": s[1], "p99_us": s[2], "p999_us": s[3], "max_us": s[4] });
        let table: Map<String, Value> = self.table().into_iter().map(|(name, s)| (name.to_owned(), row(s))).collect();
        let round = |(run, yard): (&CellRun, &Vec<f64>)| json!({ "rt_controller": summary(run.ticks.of(Span::Lateness)), "cyclictest": summary(yard) });
        let rounds: Vec<Value> = condition.cells.iter().zip(&condition.yardsticks).map(round).collect();
        let mut numbers = json!({
            "table": table, "lateness_ratio_p50": self.ratios[0], "lateness_ratio_p99": self.ratios[1], "lost_ticks": self.ticks.lost,
            "late_ticks": self.ticks.late, "idle_percent": self.idle_percent, "loop_allocations": self.allocations,
            "loop_page_faults": self.page_faults, "rounds": rounds,
        });
        if let Some(last) = condition.cells.last() {
            numbers["controller_mib"] = last.controller.resident_mib.into();
            numbers["controller_locked_mib"] = last.controller.locked_mib.into();
            numbers["worker_mib"] = last.worker.resident_mib.into();
        }
        numbers
    }
}
