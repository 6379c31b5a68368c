//! What is kept of a run: the journal in memory, and the rows that are plotted and trained on.
//!
//! Pure; allocates. A journal that cannot be written ends, as on a full disk.

use std::cell::RefCell;
use std::io::{Result, Write};
use std::rc::Rc;

use rt_controller::core::Settings;
use rt_controller::journal::{Tick, Writer, replay_from};
use serde::Serialize;
use shared::control::Outcome;
use shared::messages::Telemetry;
use shared::weights::Weights;
use simulator::physics::container::Container;

/// Bytes in memory that a journal writes to and somebody else reads.
#[derive(Debug, Clone, Default)]
struct Sink(Rc<RefCell<Vec<u8>>>);

impl Write for Sink {
    fn write(&mut self, bytes: &[u8]) -> Result<usize> {
        self.0.borrow_mut().extend(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<()> {
        Ok(())
    }
}

/// A life's journal.
pub struct Journal {
    writer: Option<Writer<Sink>>,
    sink: Sink,
    ended: bool,
}

impl Journal {
    /// An empty journal.
    pub fn new(settings: &Settings) -> Self {
        let sink = Sink::default();
        Self { writer: Writer::begin(sink.clone(), settings).ok(), sink, ended: false }
    }

    /// The disk is full.
    pub fn end(&mut self) {
        self.writer = None;
        self.ended = true;
    }

    /// Adds weights.
    pub fn weights(&mut self, identity: u64, weights: &Weights) {
        if self.writer.as_mut().is_some_and(|w| w.weights(identity, weights).is_err()) {
            self.end();
        }
    }

    /// Adds a tick.
    pub fn tick(&mut self, tick: Tick, telemetry: &Telemetry) {
        if self.writer.as_mut().is_some_and(|w| w.tick(Box::new(tick), telemetry).is_err()) {
            self.end();
        }
    }

    /// Replays it. Gives what differs from what happened, if anything does.
    pub fn difference(&self, outcomes: &[Outcome]) -> Option<String> {
        let bytes = self.sink.0.borrow();
        match replay_from(&bytes[..], "journal", |_, _| {}) {
            Err(e) => Some(e.to_string()),
            Ok(replay) if replay.different > 0 || replay.different_deadlines > 0 => {
                let (n, first) = (replay.different, replay.first_different);
                Some(format!("{n} ticks differ, the first is {first:?}; {} deadlines differ", replay.different_deadlines))
            }
            Ok(replay) if replay.lost > 0 => Some(format!("{} ticks are lost", replay.lost)),
            Ok(replay) if !self.ended && format!("{:?}", replay.ended) != format!("{outcomes:?}") => {
                Some(format!("it ended with {:?}, and the replay with {:?}", outcomes, replay.ended))
            }
            Ok(_) => None,
        }
    }
}

/// What one tick showed.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Row {
    /// Time, s.
    pub at_s: f64,
    /// Commanded alpha, degrees; NaN without a robot.
    pub alpha_deg: f64,
    /// Measured alpha, degrees.
    pub measured_deg: f64,
    /// V_e, px^2.
    pub area_px2: f64,
    /// When the newest picture was taken, s; NaN without one.
    pub captured_s: f64,
    /// Flow at the lip, ml/s.
    pub flow_ml_s: f64,
    /// What has left, ml.
    pub poured_ml: f64,
    /// d, ml.
    pub d_ml: f64,
}

impl Row {
    /// The row of a tick.
    pub fn new(at_s: f64, tick: &Tick, telemetry: &Telemetry, container: &Container) -> Self {
        Self {
            at_s,
            alpha_deg: tick.target_deg.map_or(f64::NAN, f64::from),
            measured_deg: f64::from(tick.robot.alpha_deg),
            area_px2: f64::from(telemetry.area_px2),
            captured_s: tick.features.last().map_or(f64::NAN, |f| f.captured_at_ns as f64 / 1e9),
            flow_ml_s: container.lip().flow_ml_s,
            poured_ml: container.poured_ml(),
            d_ml: f64::from(telemetry.d_ml),
        }
    }
}
