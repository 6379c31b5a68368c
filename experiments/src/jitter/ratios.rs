//! The ratios by which a run is judged: the controller over a yardstick of the same run. Pure, any thread; allocates; cannot fail.

use serde_json::{Map, Value};

use super::statistics::summary;
use super::tick_times::{Span, TickTimes};

/// The names of the ratios, in the order of [`Ratios`]; p50 and p99 take turns.
pub const RATIOS: [&str; 6] = [
    "wake-up lateness over cyclictest, p50",
    "wake-up lateness over cyclictest, p99",
    "tick execution over the bare loop, p50",
    "tick execution over the bare loop, p99",
    "tick execution in pours over the bare loop, p50",
    "tick execution in pours over the bare loop, p99",
];

/// The ratios of one round; NaN where one side has no reading.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Ratios(pub [f64; RATIOS.len()]);

impl Ratios {
    /// The ratios of the cell's ticks to the latencies of cyclictest and the executions of the bare loop, us.
    pub fn new(ticks: &TickTimes, cyclictest: &[f64], bare: &[f64]) -> Self {
        let over = |span: Span, yardstick: &[f64]| {
            let (ours, theirs) = (summary(ticks.of(span)), summary(yardstick));
            [ours[1] / theirs[1], ours[2] / theirs[2]]
        };
        let parts = [over(Span::Lateness, cyclictest), over(Span::Execution, bare), over(Span::PouringExecution, bare)];
        let mut all = [f64::NAN; RATIOS.len()];
        all.iter_mut().zip(parts.concat()).for_each(|(to, from)| *to = from);
        Self(all)
    }

    /// For `jitter.json`, by name.
    pub fn json(&self) -> Value {
        Value::Object(RATIOS.iter().zip(self.0).map(|(name, r)| ((*name).to_owned(), r.into())).collect::<Map<_, _>>())
    }

    /// From `jitter.json`; NaN for what is not there.
    pub fn from_json(value: &Value) -> Self {
        Self(RATIOS.map(|name| value[name].as_f64().unwrap_or(f64::NAN)))
    }
}
