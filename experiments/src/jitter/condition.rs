//! What was measured under one condition, and how it is told: verdict, table, curves, worst ticks, numbers.
//!
//! Pure, any thread; allocates; cannot fail.

use serde_json::{Map, Value, json};
use trainer::report::page;

use super::cell_run::CellRun;
use super::measured::{Measured, facts_html};
use super::ratios::{RATIOS, Ratios};
use super::statistics::{median, summary};
use super::tick_times::{SPANS, Span, TickTimes, WorstTick};
use crate::plots::percentiles::percentile_curves;

/// The largest ratio of wake-up lateness to cyclictest's that counts as good, p50 and p99. Wanted by the users; see docs/REALTIME.md.
const LATENESS_GOOD: [f64; 2] = [1.1, 1.3];
/// The largest ratio of tick execution to the bare loop's that counts as good, p50 and p99. Wanted by the users; see docs/REALTIME.md.
const EXECUTION_GOOD: [f64; 2] = [1.25, 1.3];

/// What was measured under one condition: a run of the cell, of cyclictest (latencies, us) and of the bare loop (executions, us) for each
/// round, and the ratios of each round.
pub struct Condition {
    /// Its name: at rest, or under load.
    pub name: &'static str,
    /// Runs of the cell.
    pub cells: Vec<CellRun>,
    /// Latencies of cyclictest, us.
    pub cyclictest: Vec<Vec<f64>>,
    /// Executions of the bare loop, us.
    pub bare: Vec<Vec<f64>>,
    /// Ratios, round by round.
    pub rounds: Vec<Ratios>,
}

impl Condition {
    /// A condition under which nothing was measured yet.
    pub fn new(name: &'static str) -> Self {
        Self { name, cells: Vec::new(), cyclictest: Vec::new(), bare: Vec::new(), rounds: Vec::new() }
    }

    /// One sentence: whether the loop wakes up and works as well as this machine permits.
    pub fn verdict(&self) -> String {
        let [late50, late99, work50, work99] = [0, 1, 2, 3].map(|k| self.ratio(k));
        let ticks = self.ticks();
        let good = late50 <= LATENESS_GOOD[0]
            && late99 <= LATENESS_GOOD[1]
            && work50 <= EXECUTION_GOOD[0]
            && work99 <= EXECUTION_GOOD[1]
            && ticks.lost == 0;
        let judged = if good { "as well as this machine permits" } else { "less well than this machine permits" };
        format!(
            "{}, the loop runs {judged}: it wakes up {late50:.2} (p50) and {late99:.2} (p99) times as late as cyclictest, a tick takes \
             {work50:.2} and {work99:.2} times as long as its bare system calls, and {} of {} ticks were lost.",
            capital(self.name),
            ticks.lost,
            ticks.of(Span::Lateness).len(),
        )
    }

    /// One sentence: this condition's p99 over that of another, each over its yardstick.
    pub fn over(&self, other: &Self) -> String {
        let [late, work] = [1, 3].map(|k| self.ratio(k) / other.ratio(k));
        format!(
            "{}, p99 of the wake-up is {late:.2} times and p99 of a tick {work:.2} times what it is {}, each over its yardstick; {} ticks were \
             later than half a period.",
            capital(self.name),
            other.name,
            self.ticks().late
        )
    }

    /// The median of one ratio over the rounds.
    fn ratio(&self, k: usize) -> f64 {
        median(self.rounds.iter().map(|r| r.0[k]))
    }

    /// All ticks of all rounds.
    fn ticks(&self) -> TickTimes {
        let mut ticks = TickTimes::default();
        self.cells.iter().for_each(|run| ticks.add(&run.ticks));
        ticks
    }

    /// What is told of this condition.
    pub fn told(&self) -> Measured {
        let ticks = self.ticks();
        let (cyclictest, bare) = (self.cyclictest.concat(), self.bare.concat());
        let table = table(&ticks, &cyclictest, &bare);
        let facts = self.facts(&ticks);
        let mut text = format!("\n{}\n", self.name);
        for row in rows(&table) {
            text += &format!("{:<34} {:>7} {:>9} {:>9} {:>9} {:>9}\n", row[0], row[1], row[2], row[3], row[4], row[5]);
        }
        facts.iter().for_each(|fact| text += &format!("{fact}\n"));
        let html = format!(
            "<h2>{}</h2>{}{}<div class=plots>{}</div><p>The worst ticks, and what the machine did in the tenth of a second around each:</p>{}",
            capital(self.name),
            page::table(&rows(&table)),
            facts_html(&facts),
            figures(&ticks, &cyclictest, &bare),
            page::table(&worst_rows(&ticks.worst)),
        );
        Measured { verdict: self.verdict(), rounds: Vec::new(), numbers: self.numbers(&ticks, &table), text, html }
    }

    fn facts(&self, ticks: &TickTimes) -> Vec<String> {
        let mut facts: Vec<String> = (0..RATIOS.len())
            .step_by(2)
            .map(|k| {
                let name = RATIOS[k].trim_end_matches(", p50");
                let n = self.rounds.len();
                format!("{name}, median of {n} rounds: p50 {:.2}, p99 {:.2}", self.ratio(k), self.ratio(k + 1))
            })
            .collect();
        let allocations: u64 = self.cells.iter().map(|r| r.allocations).sum();
        let page_faults: u64 = self.cells.iter().map(|r| r.page_faults).sum();
        facts.push(format!(
            "ticks lost {}, later than half a period {}; loop: {allocations} allocations, {page_faults} page faults",
            ticks.lost, ticks.late
        ));
        let [none, one, more] = ticks.with_frames;
        facts.push(format!("ticks with one frame {one}, with none {none}, with more {more}"));
        if let Some(last) = self.cells.last() {
            let (controller, worker) = (last.controller, last.worker);
            facts.push(format!(
                "rt-controller without a pour: {:.2} % of a core; resident {:.1} MiB, locked {:.1} MiB",
                self.idle_percent(),
                controller.resident_mib,
                controller.locked_mib
            ));
            facts.push(format!("feature-worker: resident {:.1} MiB, locked {:.1} MiB", worker.resident_mib, worker.locked_mib));
        }
        facts
    }

    fn idle_percent(&self) -> f64 {
        median(self.cells.iter().map(|r| r.idle_percent))
    }

    fn numbers(&self, ticks: &TickTimes, table: &[(&str, [f64; 5])]) -> Value {
        let row = |s: [f64; 5]| json!({ "n": s[0], "p50_us": s[1], "p99_us": s[2], "p999_us": s[3], "max_us": s[4] });
        let table: Map<String, Value> = table.iter().map(|(name, s)| ((*name).to_owned(), row(*s))).collect();
        let ratios: Map<String, Value> = RATIOS.iter().enumerate().map(|(k, name)| ((*name).to_owned(), self.ratio(k).into())).collect();
        let worst = |w: &WorstTick| {
            json!({
                "woke_at_ns": w.woke_at_ns, "lateness_us": w.lateness_us, "execution_us": w.execution_us, "frames": w.frames,
                "pouring": w.pouring, "machine": w.activity.map(|a| a.json()),
            })
        };
        let mut numbers = json!({
            "table": table, "ratios": ratios, "rounds": self.rounds.iter().map(Ratios::json).collect::<Vec<_>>(),
            "ticks_with_frames": ticks.with_frames, "lost_ticks": ticks.lost, "late_ticks": ticks.late, "idle_percent": self.idle_percent(),
            "loop_allocations": self.cells.iter().map(|r| r.allocations).sum::<u64>(),
            "loop_page_faults": self.cells.iter().map(|r| r.page_faults).sum::<u64>(),
            "worst_ticks": ticks.worst.iter().map(worst).collect::<Vec<_>>(),
        });
        if let Some(last) = self.cells.last() {
            numbers["controller_mib"] = last.controller.resident_mib.into();
            numbers["controller_locked_mib"] = last.controller.locked_mib.into();
            numbers["worker_mib"] = last.worker.resident_mib.into();
        }
        numbers
    }
}

/// A name as the beginning of a sentence.
fn capital(name: &str) -> String {
    let mut letters = name.chars();
    letters.next().map_or(String::new(), |first| first.to_uppercase().chain(letters).collect())
}

/// The rows of the table: a name, and its number, p50, p99, p99.9 and maximum in us.
fn table(ticks: &TickTimes, cyclictest: &[f64], bare: &[f64]) -> Vec<(&'static str, [f64; 5])> {
    let spans = SPANS.iter().zip(&ticks.spans_us).map(|(name, values)| (*name, summary(values)));
    spans.chain([("cyclictest: wake-up lateness", summary(cyclictest)), ("bare loop: tick execution", summary(bare))]).collect()
}

/// The table as words, with a heading.
fn rows(table: &[(&str, [f64; 5])]) -> Vec<Vec<String>> {
    let mut rows = vec![["us", "n", "p50", "p99", "p99.9", "max"].map(String::from).to_vec()];
    for (name, s) in table {
        let numbers = s[1..].iter().map(|x| format!("{x:.1}"));
        rows.push([(*name).to_owned(), format!("{:.0}", s[0])].into_iter().chain(numbers).collect());
    }
    rows
}

fn figures(ticks: &TickTimes, cyclictest: &[f64], bare: &[f64]) -> String {
    let of = |span: Span| ticks.of(span).as_slice();
    [
        percentile_curves("Wake-up lateness.", &[("rt-controller", of(Span::Lateness)), ("cyclictest", cyclictest)]),
        percentile_curves(
            "Tick execution.",
            &[("all ticks", of(Span::Execution)), ("in pours", of(Span::PouringExecution)), ("bare loop", bare)],
        ),
        percentile_curves(
            "From the wake-up to the target's bytes on the socket.",
            &[
                ("until decided", of(Span::WakeToDecided)),
                ("the kernel's send", of(Span::DecidedToWritten)),
                ("whole tick", of(Span::Execution)),
            ],
        ),
        percentile_curves(
            "The way of a frame through the PC, from the worker's receipt to the target's bytes on the socket.",
            &[
                ("extraction", of(Span::ReceivedToPublished)),
                ("V_e waits for its tick", of(Span::PublishedToWake)),
                ("all of it", of(Span::ReceivedToWritten)),
            ],
        ),
    ]
    .concat()
}

/// The worst ticks as a table of words, with a heading.
fn worst_rows(worst: &[WorstTick]) -> Vec<Vec<String>> {
    let heading = ["tick", "late us", "execution us", "frames", "interrupts/s", "context switches/s", "steal ms", "loop preempted"];
    let mut rows = vec![heading.map(String::from).to_vec()];
    for w in worst {
        let mut row = vec![
            if w.pouring { "in a pour" } else { "at rest" }.to_owned(),
            format!("{:.1}", w.lateness_us),
            format!("{:.1}", w.execution_us),
            w.frames.to_string(),
        ];
        row.extend(match w.activity {
            Some(a) => [
                format!("{:.0}", a.interrupts_per_s),
                format!("{:.0}", a.switches_per_s),
                format!("{:.0}", a.steal_ms),
                a.preempted.to_string(),
            ],
            None => ["", "", "", ""].map(String::from),
        });
        rows.push(row);
    }
    rows
}
