//! What pours came to, and what faults in them cost: how much left after a fault could first be noticed, and how long the way upright took.
//!
//! Pure; allocates; cannot fail.

use serde::Serialize;
use shared::control::EndReason;
use shared::messages::Phase;

use crate::bound::{Moment, most_ml};
use crate::faults::Kind;

/// A container nearer to 0 than this is upright, degrees (`robot.start_tolerance_deg` of config/sim.toml).
const UPRIGHT_DEG: f64 = 2.0;

/// What a fault during a pour or recording cost.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Cost {
    /// The fault's kind.
    pub fault: &'static str,
    /// Whether it came in a pour, and not in a recording.
    pub in_pour: bool,
    /// What left from the moment in which it could first be noticed until the container was upright, ml.
    pub excess_ml: f64,
    /// The most that may leave then ([`crate::bound`]), ml; `None` where only the vessel's content bounds it.
    pub bound_ml: Option<f64>,
    /// What left from the fault itself until then, ml.
    pub since_ml: f64,
    /// Time from the fault until the container was upright, s.
    pub upright_s: f64,
}

/// How a pour or recording went.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Poured {
    /// When it ended, s.
    pub at_s: f64,
    /// Time from its start until the last drops were counted, s.
    pub seconds: f64,
    /// Why.
    pub reason: EndReason,
    /// The goal, ml.
    pub goal_ml: Option<f32>,
    /// What was believed, ml.
    pub believed_ml: f32,
    /// Its standard deviation as far as it is known, ml.
    pub sd_ml: f32,
    /// What left, ml.
    pub true_ml: f64,
    /// The kinds of the faults while it went on or in the 6 s before.
    pub faults: Vec<&'static str>,
}

/// A fault in a pour or recording whose container is not upright again.
#[derive(Debug, Clone, Copy)]
struct OpenFault {
    kind: Kind,
    at_s: f64,
    at_ml: f64,
    /// What had left when it could first be noticed, ml, and the most that may leave from then on, if it is a fault that bounds it.
    noticed: Option<(f64, Option<f64>)>,
    /// The container was on its way upright already.
    is_on_way: bool,
    /// It was a pour, and no recording.
    in_pour: bool,
}

impl OpenFault {
    fn excess_ml(&self, poured_ml: f64) -> f64 {
        poured_ml - self.noticed.map_or(poured_ml, |(noticed_ml, _)| noticed_ml)
    }

    fn bound_ml(&self) -> Option<f64> {
        self.noticed.and_then(|(_, bound_ml)| bound_ml)
    }

    /// Whether no more has left than may.
    fn is_within(&self, poured_ml: f64) -> bool {
        self.bound_ml().is_none_or(|bound_ml| self.excess_ml(poured_ml) <= bound_ml)
    }
}

/// What faults cost, in one cell.
#[derive(Debug, Default)]
pub struct Costs {
    open: Vec<OpenFault>,
    /// The newest run ended as one without a fault does, or by one that stood before it.
    went_on: bool,
    /// What is known.
    pub known: Vec<Cost>,
}

impl Costs {
    /// A fault begins in this phase, when so much had left. The newest run is a pour, or a recording.
    pub fn begins(&mut self, kind: Kind, phase: Phase, in_pour: bool, (at_s, at_ml): (f64, f64)) {
        let is_active = matches!(phase, Phase::Pouring | Phase::Recording);
        // A robot that is lost is still on its way, as long as the container has not come upright after a fault.
        let is_on_way = matches!(phase, Phase::Settling | Phase::Returning) || (!is_active && !self.open.is_empty());
        if is_on_way || is_active {
            // How an earlier run ended says nothing about this one.
            self.went_on = false;
            self.open.push(OpenFault { kind, at_s, at_ml, noticed: None, is_on_way, in_pour });
        }
    }

    /// A run has ended, as one without a fault does, or by a fault that stood before it; or not.
    pub fn ended(&mut self, ordinary: bool) {
        self.went_on = ordinary;
    }

    /// Takes note of what had left when a fault could first be noticed, and, when the container is upright again, of what it cost. Gives what
    /// is wrong if more has left than may.
    pub fn settle(&mut self, phase: Phase, now: &Moment<'_>) -> Option<String> {
        let (at_s, alpha_deg, poured_ml) = (now.at_s, now.alpha_deg, now.container.poured_ml());
        for open in &mut self.open {
            if open.noticed.is_none() && at_s >= open.at_s + f64::from(open.kind.noticed_ms) / 1000.0 {
                open.noticed = Some((poured_ml, open.kind.is_bounded.then(|| most_ml(now))));
            }
        }
        let active = matches!(phase, Phase::Pouring | Phase::Recording);
        if self.open.is_empty() || active || alpha_deg.abs() >= UPRIGHT_DEG {
            return None;
        }
        if std::mem::take(&mut self.went_on) {
            self.open.clear();
        }
        if matches!(phase, Phase::Settling | Phase::Returning) {
            return None;
        }
        // The pour went on after faults that need not end it. So one of them at least must explain what left after it.
        let wrong = (!self.open.is_empty() && !self.open.iter().any(|open| open.is_within(poured_ml))).then(|| {
            let tell = |open: &OpenFault| {
                let bound_ml = open.bound_ml().unwrap_or_default();
                format!("{:.1} ml after {}, where {bound_ml:.1} may", open.excess_ml(poured_ml), open.kind.name)
            };
            let left: Vec<_> = self.open.iter().map(tell).collect();
            format!("more left after a fault could be noticed than may: {}", left.join(", "))
        });
        for open in std::mem::take(&mut self.open).into_iter().filter(|open| !open.is_on_way) {
            let (excess_ml, bound_ml) = (open.excess_ml(poured_ml), open.bound_ml());
            let (since_ml, upright_s) = (poured_ml - open.at_ml, at_s - open.at_s);
            self.known.push(Cost { fault: open.kind.name, in_pour: open.in_pour, excess_ml, bound_ml, since_ml, upright_s });
        }
        wrong
    }
}
