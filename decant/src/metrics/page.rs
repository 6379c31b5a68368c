//! The text of `/metrics`, in OpenMetrics, from what was seen of the cell.
//!
//! Pure but for the library's buffer, in the thread that answers; it allocates, and only fails when text cannot be written, which is memory.
//! What is not known, such as a measured angle without a robot, is left out rather than shown as a number.

use std::collections::BTreeMap;

use prometheus_client::collector::Collector;
use prometheus_client::encoding::{DescriptorEncoder, EncodeMetric as _, NoLabelSet};
use prometheus_client::metrics::MetricType;
use prometheus_client::metrics::counter::ConstCounter;
use prometheus_client::metrics::gauge::ConstGauge;
use prometheus_client::registry::{Registry, Unit};
use shared::control::{Histogram, Status};
use shared::disk_space::Room;
use shared::messages::Phase;

/// The content type. Source: OpenMetrics 1.0, section Protocol Negotiation.
pub const KIND: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
/// Upper edges of the histograms of times, s. Chosen by hand: three each decade, from below what any machine shows to the longest that a pour bears.
const TIMES_S: [f64; 18] = [1e-6, 2e-6, 5e-6, 1e-5, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 0.1, 0.2, 0.5];
/// Upper edges of the errors of weighed pours, ml. Chosen by hand; the paper's errors are a few ml.
const ERRORS_ML: [f64; 8] = [0.5, 1.0, 2.0, 3.0, 5.0, 10.0, 20.0, 50.0];
/// The loop's histograms: their names in `status`, and here with what they measure.
const LOOP_TIMES: [(&str, &str, &str); 5] = [
    ("wake-up lateness", "decant_wakeup_lateness", "How late the loop woke up"),
    ("tick execution", "decant_tick_execution", "How long a tick took"),
    ("exposure to use of V_e", "decant_feature_age", "How old a measurement was when it was used, from the middle of its exposure"),
    ("publication to use of V_e", "decant_feature_wait", "How long a measurement waited for its tick"),
    ("wake-up to target written", "decant_target_written", "From the wake-up until the kernel had the target"),
];

/// What was seen of a cell.
#[derive(Debug)]
pub struct Seen {
    /// Its name.
    pub cell: String,
    /// The controller's state; `None` if it does not answer.
    pub status: Option<Box<Status>>,
    /// Results since this program started, by reason.
    pub ended: BTreeMap<&'static str, u64>,
    /// By how much the weighed pours missed their goals, ml, the oldest first; `None` if the episodes cannot be read.
    pub errors_ml: Option<Vec<f64>>,
    /// What the disks still take, by what lies there.
    pub room: Vec<(&'static str, Room)>,
}

/// The page's text.
pub fn text(seen: Seen) -> Result<String, std::fmt::Error> {
    let cell = seen.cell.clone();
    let mut registry = Registry::with_labels([("cell".into(), cell.into())].into_iter());
    registry.register_collector(Box::new(seen));
    let mut text = String::new();
    prometheus_client::encoding::text::encode(&mut text, &registry)?;
    Ok(text)
}

impl Collector for Seen {
    fn encode(&self, encoder: DescriptorEncoder) -> std::fmt::Result {
        let mut page = Page(encoder);
        page.gauge("decant_up", "Whether the controller answers", None, f64::from(u8::from(self.status.is_some())))?;
        if let Some(status) = &self.status {
            state(&mut page, status)?;
            counters(&mut page, status)?;
            for (name, metric, help) in LOOP_TIMES {
                if let Some(histogram) = status.timing.iter().find(|h| h.name == name) {
                    times(&mut page, metric, help, histogram)?;
                }
            }
        }
        let ended: Vec<(&str, u64)> = self.ended.iter().map(|(reason, n)| (*reason, *n)).collect();
        page.counters("decant_ended", "Pours and recordings that ended since this program started", "reason", &ended)?;
        let free: Vec<(&str, f64)> = self.room.iter().map(|(name, room)| (*name, room.bytes as f64)).collect();
        page.gauges("decant_free", "Free space where this lies", Some(Unit::Bytes), "of", &free)?;
        let bounded = self.room.iter().filter(|(_, room)| room.files < u64::MAX);
        let files: Vec<(&str, f64)> = bounded.map(|(name, room)| (*name, room.files as f64)).collect();
        page.gauges("decant_free_files", "Files that may still be made where this lies, if their number is bounded", None, "of", &files)?;
        self.errors_ml.as_ref().map_or(Ok(()), |errors_ml| weighed(&mut page, errors_ml))
    }
}

/// What the controller is doing, and ages.
fn state(page: &mut Page, s: &Status) -> std::fmt::Result {
    let name = |phase: Phase| serde_json::to_value(phase).ok().and_then(|v| v.as_str().map(String::from)).unwrap_or_default();
    let phases: Vec<(String, f64)> =
        (0..=Phase::Settling as u32).map(Phase::from_code).map(|p| (name(p), f64::from(u8::from(p == s.phase)))).collect();
    let phases: Vec<(&str, f64)> = phases.iter().map(|(name, on)| (name.as_str(), *on)).collect();
    page.gauges("decant_phase", "1 for what the controller is doing", None, "phase", &phases)?;
    page.gauges("decant_version", "1 for the controller's version", None, "version", &[(s.version.as_str(), 1.0)])?;
    page.gauge("decant_uptime", "Time since the controller's start", Some(Unit::Seconds), s.uptime_s)?;
    page.gauge(
        "decant_weights_age",
        "Age of the weight file that was read last",
        Some(Unit::Seconds),
        s.weights_age_s.unwrap_or(f64::NAN),
    )?;
    page.gauge("decant_hindered", "Whether something keeps the cell from pouring", None, f64::from(u8::from(!s.hindrance.is_empty())))?;
    let degrees = Unit::Other("degrees".into());
    let angles = [("commanded", f64::from(s.alpha_deg)), ("measured", f64::from(s.alpha_measured_deg))];
    page.gauges("decant_alpha", "Tilt from upright", Some(degrees), "of", &angles)?;
    let volumes = [("goal", s.goal_ml), ("poured", s.poured_ml), ("deviation", s.poured_sd_ml)];
    let known = s.goal_ml.is_finite();
    let volumes: Vec<(&str, f64)> = volumes.iter().filter(|_| known).map(|(name, ml)| (*name, f64::from(*ml))).collect();
    page.gauges("decant_pour", "The pour under way", Some(Unit::Other("ml".into())), "of", &volumes)
}

/// Everything that only grows.
fn counters(page: &mut Page, s: &Status) -> std::fmt::Result {
    page.counter("decant_ticks", "Ticks done", s.ticks)?;
    page.counter("decant_late_ticks", "Ticks late by more than half a period", s.late_ticks)?;
    page.counter("decant_skipped_ticks", "Periods skipped", s.skipped_ticks)?;
    page.counter("decant_features", "Measurements used", s.features)?;
    page.counter("decant_stale_features", "Ticks of pours and recordings without a fresh measurement", s.stale_features)?;
    page.counter("decant_bridged_frames", "Lost frames that were bridged", s.bridged_frames)?;
    page.counter("decant_ignored_features", "Measurements that came twice, out of order, or from elsewhere", s.ignored_features)?;
    let c = s.clipped;
    let clipped = [("angle", c.angle), ("rate", c.rate), ("acceleration", c.acceleration), ("not-finite", c.not_finite)];
    page.counters("decant_clipped", "Requests that a limit changed", "limit", &clipped)?;
    page.counter("decant_robot_connections", "Times that the robot was connected", s.robot_connections)?;
    page.counter("decant_loop_allocations", "Heap allocations of the loop's ticks", s.loop_allocations)?;
    page.counter("decant_loop_page_faults", "Page faults of the loop's ticks", s.loop_page_faults)?;
    page.counter("decant_events_lost", "Events that the ordinary side was too slow for", s.events_lost)?;
    page.counter("decant_weights_taken", "Weight files taken", s.weights_taken)
}

/// One of the loop's histograms. Its bins are narrow, so each goes whole to the edge that holds its upper end.
fn times(page: &mut Page, name: &str, help: &str, histogram: &Histogram) -> std::fmt::Result {
    let values = histogram.bins.iter().map(|(upper_us, n)| (upper_us * 1e-6, *n));
    page.histogram(name, &format!("{help}; the sum is up to 6 % too large"), Unit::Seconds, &TIMES_S, values)
}

/// How far the weighed pours were from their goals.
fn weighed(page: &mut Page, errors_ml: &[f64]) -> std::fmt::Result {
    // Rounding must not lift a value over the edge that it lies on.
    let within = |edge_ml: f64| errors_ml.iter().filter(|ml| ml.abs() <= edge_ml * (1.0 + 1e-9)).count() as f64;
    let edges = ERRORS_ML.iter().map(|edge_ml| (format!("{edge_ml:?}"), within(*edge_ml)));
    let edges: Vec<(String, f64)> = edges.chain([("+Inf".into(), errors_ml.len() as f64)]).collect();
    let edges: Vec<(&str, f64)> = edges.iter().map(|(le, n)| (le.as_str(), *n)).collect();
    // Old episodes leave the newest ones, so these fall too, which a histogram must not.
    page.gauges(
        "decant_weighed_pours",
        "Weighed pours of the newest episodes that were at most le ml off their goals. Those that ended early are left \
         out",
        None,
        "le",
        &edges,
    )?;
    let newest = errors_ml.last().copied().unwrap_or(f64::NAN);
    page.gauge("decant_newest_weighed_error", "What the newest weighed pour had beyond its goal", Some(Unit::Other("ml".into())), newest)
}

/// Writes metrics. A value that is no number is left out.
struct Page<'a>(DescriptorEncoder<'a>);

impl Page<'_> {
    fn gauge(&mut self, name: &str, help: &str, unit: Option<Unit>, value: f64) -> std::fmt::Result {
        if !value.is_finite() {
            return Ok(());
        }
        let metric = self.0.encode_descriptor(name, help, unit.as_ref(), MetricType::Gauge)?;
        ConstGauge::new(value).encode(metric)
    }

    fn gauges(&mut self, name: &str, help: &str, unit: Option<Unit>, label: &str, values: &[(&str, f64)]) -> std::fmt::Result {
        let mut metric = self.0.encode_descriptor(name, help, unit.as_ref(), MetricType::Gauge)?;
        for (which, value) in values.iter().filter(|(_, value)| value.is_finite()) {
            ConstGauge::new(*value).encode(metric.encode_family(&[(label, *which)])?)?;
        }
        Ok(())
    }

    fn counter(&mut self, name: &str, help: &str, value: u64) -> std::fmt::Result {
        let metric = self.0.encode_descriptor(name, help, None, MetricType::Counter)?;
        ConstCounter::new(value).encode(metric)
    }

    fn counters(&mut self, name: &str, help: &str, label: &str, values: &[(&str, u64)]) -> std::fmt::Result {
        let mut metric = self.0.encode_descriptor(name, help, None, MetricType::Counter)?;
        for (which, value) in values {
            ConstCounter::new(*value).encode(metric.encode_family(&[(label, *which)])?)?;
        }
        Ok(())
    }

    /// A histogram of `values`, each with how often it came.
    fn histogram(
        &mut self,
        name: &str,
        help: &str,
        unit: Unit,
        edges: &[f64],
        values: impl Iterator<Item = (f64, u64)>,
    ) -> std::fmt::Result {
        let mut buckets: Vec<(f64, u64)> = edges.iter().map(|edge| (*edge, 0)).chain([(f64::INFINITY, 0)]).collect();
        let (mut sum, mut count) = (0.0, 0);
        for (value, n) in values {
            sum += value * n as f64;
            count += n;
            // Rounding must not lift a value over the edge that it lies on.
            if let Some(bucket) = buckets.iter_mut().find(|(edge, _)| value <= edge * (1.0 + 1e-9)) {
                bucket.1 += n;
            }
        }
        let mut metric = self.0.encode_descriptor(name, help, Some(&unit), MetricType::Histogram)?;
        metric.encode_histogram::<NoLabelSet>(sum, count, &buckets, None)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects what is computed of the errors: old episodes leave the newest ones, so the counts of weighed pours fall too, and must be gauges. A pour on
    /// an edge is within it.
    #[test]
    fn what_may_fall_is_a_gauge() {
        let errors_ml = vec![50.2 - 50.0, 47.0 - 50.0, 120.0 - 50.0];
        let seen = Seen { cell: "lab".into(), status: None, ended: BTreeMap::new(), errors_ml: Some(errors_ml), room: Vec::new() };
        let text = text(seen).unwrap();
        assert!(text.contains("# TYPE decant_weighed_pours gauge\n") && !text.contains(" histogram\n"), "{text}");
        for (le, n) in [("0.5", "1.0"), ("2.0", "1.0"), ("3.0", "2.0"), ("50.0", "2.0"), ("+Inf", "3.0")] {
            let line = format!("decant_weighed_pours{{cell=\"lab\",le=\"{le}\"}} {n}\n");
            assert!(text.contains(&line), "{line}: {text}");
        }
    }
}
