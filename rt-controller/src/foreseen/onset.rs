//! By which tilt a vessel with a known fill must flow, as far as the weights know its shape.
//!
//! Pure functions of short commands, in ordinary threads; they neither allocate nor fail. Flow begins where the capacity B that is left beyond a tilt is no more
//! than the fill. Where somebody knows what the vessel holds, the capacity A that the tilt has taken from upright counts as well: flow begins where A/B is what is
//! empty over what is filled. What the weights leave open of the shape moves both:
//!
//! ```text
//! ln(A/B) = ln sum_k a_k exp(s_k) - ln sum_k b_k exp(s_k)          a_k, b_k: capacity at the knot k, before the tilt and beyond it, ml
//! variance = g' P g;  g_k = a_k/A - b_k/B                         P: covariance of the log shape s
//! ```
//!
//! What all knots have in common, as the camera's gain is, cancels in it. What a vessel holds is a measurement of A + B: without it, the curves' unknown ends may
//! hold several times as much as the vessel does.

use shared::estimator::filter::UNKNOWNS;
use shared::estimator::fused::Explanation;
use shared::estimator::vessel::{CapacityCurve, KNOTS, Vessel, knot_deg};

/// The largest tilt of the flow model's tables, degrees.
pub(super) const LAST_DEG: u32 = 120;
/// How well it is known what a vessel holds up to its lip (log): chosen by hand for who fills it once and weighs it.
const HOLDS_SD: f64 = 0.05;
/// How often the shape is found that meets what the vessel holds: by the sixth time it changes no tilt by a degree on rigs 200 to 202 of each kind.
const ROUNDS: usize = 6;

/// Capacity by knot, ml.
type ByKnot = [f64; KNOTS];

/// The shape of a vessel, and how far it is in doubt.
pub(super) struct Shape {
    vessel: Vessel,
    capacity: CapacityCurve,
    /// Covariance of the log shape.
    covariance: [ByKnot; KNOTS],
}

/// The capacity of a vessel between two tilts, ml.
fn by_knot_ml(capacity: &CapacityCurve, from_deg: u32, to_deg: u32) -> ByKnot {
    let mut ml = [0.0; KNOTS];
    for deg in from_deg..to_deg {
        let lost_ml = capacity.lost_ml(f64::from(deg + 1)) - capacity.lost_ml(f64::from(deg));
        let at = (f64::from(deg) + 0.5 - knot_deg(0)) / (knot_deg(1) - knot_deg(0));
        let below = (at.max(0.0) as usize).min(KNOTS - 2);
        let share = (at - below as f64).clamp(0.0, 1.0);
        ml[below] += (1.0 - share) * lost_ml;
        ml[below + 1] += share * lost_ml;
    }
    ml
}

/// Each part as a share of the whole, and the whole, ml.
fn shares(ml: &ByKnot) -> (ByKnot, f64) {
    let whole_ml: f64 = ml.iter().sum::<f64>().max(f64::MIN_POSITIVE);
    (ml.map(|part| part / whole_ml), whole_ml)
}

/// The product of two rows.
fn dot(a: &ByKnot, b: &ByKnot) -> f64 {
    a.iter().zip(b).map(|(x, y)| x * y).sum()
}

impl Shape {
    /// The shape that an explanation has learned.
    pub fn learned(explanation: &Explanation) -> Self {
        let first = UNKNOWNS - KNOTS;
        let covariance = std::array::from_fn(|i| std::array::from_fn(|j| explanation.unknowns[first + i][first + j]));
        let vessel = explanation.model.vessel;
        Self { vessel, capacity: CapacityCurve::new(&vessel), covariance }
    }

    /// The same of a vessel that holds so much up to its lip, ml.
    pub fn that_holds(mut self, holds_ml: f64) -> Self {
        let (learned, prior) = (self.vessel.log_shape, self.covariance);
        for _ in 0..ROUNDS {
            let (share, whole_ml) = shares(&by_knot_ml(&self.capacity, 0, LAST_DEG));
            let gain: ByKnot = std::array::from_fn(|k| dot(&prior[k], &share));
            let variance = dot(&gain, &share) + HOLDS_SD * HOLDS_SD;
            let moved: ByKnot = std::array::from_fn(|k| self.vessel.log_shape[k] - learned[k]);
            let missing = (holds_ml / whole_ml).ln() + dot(&share, &moved);
            self.vessel.log_shape = std::array::from_fn(|k| learned[k] + gain[k] * missing / variance);
            self.covariance = std::array::from_fn(|i| std::array::from_fn(|j| prior[i][j] - gain[i] * gain[j] / variance));
            self.capacity = CapacityCurve::new(&self.vessel);
        }
        self
    }

    /// The tilt by which it flows with so much in it, ml, if it is empty for longer by `sds` standard deviations than was learned, degrees; `None` if it need not
    /// flow at all. `holds_ml` is what it holds, where that is known.
    pub fn flows_by_deg(&self, fill_ml: f64, holds_ml: Option<f64>, sds: f64) -> Option<u32> {
        let flows = |deg: &u32| {
            let (beyond, beyond_ml) = shares(&by_knot_ml(&self.capacity, *deg, LAST_DEG));
            let (before, before_ml) = shares(&by_knot_ml(&self.capacity, 0, *deg));
            let (log, slopes) = if let Some(holds_ml) = holds_ml {
                let log_wanted = ((holds_ml - fill_ml) / fill_ml).ln();
                ((before_ml / beyond_ml).ln() - log_wanted, std::array::from_fn(|k| before[k] - beyond[k]))
            } else {
                ((fill_ml / beyond_ml).ln(), beyond)
            };
            let projected: ByKnot = std::array::from_fn(|k| dot(&self.covariance[k], &slopes));
            log >= sds * dot(&projected, &slopes).max(0.0).sqrt()
        };
        (1..LAST_DEG).find(flows)
    }
}
