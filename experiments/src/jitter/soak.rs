//! One long run under load, pouring all the time. cyclictest runs beside it one priority below: where it loses nothing, the loop must not
//! either.
//!
//! Ordinary thread; allocates and blocks; a thread of its own reads cyclictest's output.

use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use rt_controller::client::Client;
use serde_json::{Map, Value, json};
use shared::os::now_ns;
use trainer::report::page;
use trainer::report::plot::{PlotSeries, plot};

use super::cell_run::pour_until;
use super::measured::{Measured, facts_html};
use super::other_programs::{Running, cyclictest, latencies_us, load};
use super::processes::Holding;
use super::statistics::summary;
use super::tick_times::{Span, TickTimes};
use crate::own_cell::{OwnCell, OwnCellError};
use crate::plots::percentiles::percentile_curves;

/// Time between two readings of memory and files: enough of them in an hour to show a leak.
const READ_EVERY: Duration = Duration::from_secs(60);

/// The controller's own counters of what went wrong, which are followed over time.
const COUNTERS: [&str; 6] = ["late ticks", "skipped ticks", "stale features", "events lost", "loop allocations", "loop page faults"];

/// What both processes held at one moment, and [`COUNTERS`] then.
struct Reading {
    minutes: f64,
    controller: Holding,
    worker: Holding,
    counters: [u64; COUNTERS.len()],
}

impl Reading {
    fn take(cell: &OwnCell, from: Instant) -> Result<Self, OwnCellError> {
        let status = Client::connect(&cell.config.cell).and_then(|client| client.status());
        let s = status.map_err(|e| OwnCellError::Other(e.to_string()))?;
        Ok(Self {
            minutes: from.elapsed().as_secs_f64() / 60.0,
            controller: Holding::of(cell.pid("rt-controller")),
            worker: Holding::of(cell.pid("feature-worker")),
            counters: [s.late_ticks, s.skipped_ticks, s.stale_features, s.events_lost, s.loop_allocations, s.loop_page_faults],
        })
    }

    fn json(&self) -> Value {
        let counters: Map<String, Value> = COUNTERS.iter().zip(self.counters).map(|(name, n)| ((*name).to_owned(), n.into())).collect();
        json!({
            "minutes": self.minutes, "controller_mib": self.controller.resident_mib, "controller_files": self.controller.files,
            "worker_mib": self.worker.resident_mib, "worker_files": self.worker.files, "counters": counters,
        })
    }
}

/// cyclictest, and the thread that reads its latencies (us).
fn start_yardstick(cell: &OwnCell, seconds: u64) -> Result<(Running, JoinHandle<Vec<f64>>), OwnCellError> {
    let mut yardstick = cyclictest(cell, Duration::from_secs(seconds), 1)?;
    let output = yardstick.stdout.take();
    let reader = std::thread::spawn(move || {
        let mut bytes = Vec::new();
        if let Some(mut output) = output {
            let _ = std::io::Read::read_to_end(&mut output, &mut bytes);
        }
        latencies_us(&bytes)
    });
    Ok((Running(yardstick), reader))
}

/// Pours for `hours`.
///
/// # Errors
/// When the cell, stress-ng or cyclictest cannot be run, or Ctrl-C is pressed; what was measured until then is lost.
pub fn measure(cell: &mut OwnCell, hours: f64) -> Result<Measured, OwnCellError> {
    let _load = load()?;
    let seconds = (hours * 3600.0) as u64;
    drop(cell.start()?);
    let (yardstick, reader) = start_yardstick(cell, seconds)?;
    let (from_ns, from) = (now_ns(), Instant::now());
    let mut readings = Vec::new();
    let end = from + Duration::from_secs(seconds);
    while Instant::now() < end {
        pour_until(cell, (Instant::now() + READ_EVERY).min(end))?;
        let reading = Reading::take(cell, from)?;
        let (c, w) = (reading.controller, reading.worker);
        cell.note(&format!(
            "{:.0} min: rt-controller {:.1} MiB, {} files; feature-worker {:.1} MiB, {} files",
            reading.minutes, c.resident_mib, c.files, w.resident_mib, w.files
        ));
        readings.push(reading);
    }
    let to_ns = now_ns();
    drop(yardstick);
    let latencies = reader.join().unwrap_or_default();
    cell.stop();
    let ticks = TickTimes::read(cell, from_ns, to_ns)?;
    let period_us = 1e6 / cell.config.controller.rate_hz;
    let lost_by_cyclictest = latencies.iter().filter(|l| **l > period_us).count();
    let facts = facts(from.elapsed(), &ticks, &latencies, lost_by_cyclictest);
    let numbers = json!({
        "seconds": seconds, "ticks": ticks.of(Span::Lateness).len(), "lost_ticks": ticks.lost, "late_ticks": ticks.late,
        "lost_by_cyclictest": lost_by_cyclictest, "lateness_us": summary(ticks.of(Span::Lateness)), "cyclictest_us": summary(&latencies),
        "samples": readings.iter().map(Reading::json).collect::<Vec<_>>(),
    });
    let verdict = format!(
        "Under load, {} of {} ticks were lost, and {lost_by_cyclictest} of cyclictest's.",
        ticks.lost,
        ticks.of(Span::Lateness).len()
    );
    Ok(Measured {
        verdict,
        rounds: Vec::new(),
        numbers,
        text: format!("\n{}\n", facts.join("\n")),
        html: html(&facts, &readings, &ticks, &latencies),
    })
}

fn facts(elapsed: Duration, ticks: &TickTimes, latencies: &[f64], lost_by_cyclictest: usize) -> Vec<String> {
    let (late, yard) = (summary(ticks.of(Span::Lateness)), summary(latencies));
    vec![
        format!(
            "{:.0} s under load, {} ticks, {} lost, {} later than half a period",
            elapsed.as_secs_f64(),
            ticks.of(Span::Lateness).len(),
            ticks.lost,
            ticks.late
        ),
        format!("cyclictest beside it: {} samples, {lost_by_cyclictest} later than a period", latencies.len()),
        format!("wake-up lateness in us: rt-controller p50 {:.1}, p99 {:.1}, p99.9 {:.1}, max {:.1}", late[1], late[2], late[3], late[4]),
        format!("                        cyclictest    p50 {:.1}, p99 {:.1}, p99.9 {:.1}, max {:.1}", yard[1], yard[2], yard[3], yard[4]),
    ]
}

fn html(facts: &[String], readings: &[Reading], ticks: &TickTimes, latencies: &[f64]) -> String {
    let line = |name: &str, pick: fn(&Reading) -> f64| PlotSeries::line(name, readings.iter().map(|r| (r.minutes, pick(r))).collect());
    let memory = [line("rt-controller", |r| r.controller.resident_mib), line("feature-worker", |r| r.worker.resident_mib)];
    let files = [line("rt-controller", |r| r.controller.files as f64), line("feature-worker", |r| r.worker.files as f64)];
    let counters: Vec<PlotSeries> = COUNTERS
        .iter()
        .enumerate()
        .map(|(k, name)| PlotSeries::line(name, readings.iter().map(|r| (r.minutes, r.counters[k] as f64)).collect()))
        .collect();
    let figures = [
        page::figure(&plot("minutes", "resident MiB", &memory, true), "Memory."),
        page::figure(&plot("minutes", "open files", &files, true), "Open files."),
        page::figure(&plot("minutes", "number", &counters, true), "What went wrong, since the controller started."),
        percentile_curves("Wake-up lateness.", &[("rt-controller", ticks.of(Span::Lateness)), ("cyclictest", latencies)]),
    ];
    format!("<h2>Soak</h2>{}<div class=plots>{}</div>", facts_html(facts), figures.concat())
}
