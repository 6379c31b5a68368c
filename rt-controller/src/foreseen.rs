//! What can be said of a pour before it starts: how far off it is expected to be, and by which tilt it must flow.
//!
//! Used by short commands, in ordinary threads; it allocates and does not fail. What cannot be known is `None`. The pour is foreseen with the
//! agent that will pour, on the vessel that the weights describe, so the deviation is the one that the agent itself will claim.

use shared::agent::{Agent, Observation};
use shared::control::is_short;
use shared::estimator::Calibration;
use shared::estimator::flow::{CommandHistory, FlowState, FlowTables};
use shared::estimator::fused::{Explanation, TIGHT, WIDE};
use shared::estimator::vessel::CapacityCurve;
use shared::limits::{Limiter, Limits};
use shared::weights::{Estimator, Weights};

use crate::core::Settings;
use crate::core::ending::Ending;

mod onset;

use onset::{LAST_DEG, Shape};

/// Tilts at which the flow may begin, degrees: from a nearly full vessel to one that is half empty.
const ONSETS_DEG: [f32; 3] = [35.0, 50.0, 65.0];
/// Frames without flow, on the way back, after which a foreseen pour is over.
const QUIET_FRAMES: u32 = 20;
/// Frames that a way back and its last drops take at most. Chosen by hand: half a minute at 30 Hz, many times what any takes.
const BACK_FRAMES: u32 = 900;
/// Below this area no camera shows a stream, px^2. Chosen by hand; no measurement is recorded.
const VISIBLE_PX2: f32 = 20.0;
/// How far beyond the tilt of a fill's first drop a straight vessel must flow, degrees: where capacity curves of real vessels were known least, they were off
/// by 10 % of the vessel, which is some 8 degrees.
const BEYOND_DEG: f64 = 10.0;
/// By how many standard deviations of what the weights leave open of its shape a vessel of any shape may flow later. Tuned on rigs 200 to 202 of each kind of
/// vessel with five curves: with one, no right pour was ended, and as much as a half more is left for others.
const LATER_SDS: f64 = 1.5;
/// How far beyond that it must flow, degrees: the first drops are too few to be seen. Tuned together with [`LATER_SDS`].
const LATER_DEG: f64 = 2.0;
/// An explanation that is less likely than this does not count for the tilt by which a fill must flow. Chosen by hand: as many right pours may be ended.
const UNLIKELY: f64 = 0.01;
/// A vessel whose size was learned may hold so many times more. Chosen by hand: curves alone tell a size badly, so a fill beyond this is refused, and
/// `[container] holds_ml` tells the size where it is known.
const OVERFULL: f64 = 1.25;

/// A pour that is expected to be off by more than this is warned of, ml: wanted by the users.
pub const WARNED_SD_ML: f32 = 5.0;
/// Weights from fewer weighed episodes know little of their own deviation. Pours with weights from one curve are off by about twice as much as those
/// with weights from five (docs/LEARNING.md, Figures).
const FEW_EPISODES: u32 = 5;

/// How many weighed episodes the weights were learned from, if they are too few for their deviation to be taken at its word.
pub fn few_episodes(weights: &Weights) -> Option<u32> {
    Some(weights.origin.episodes).filter(|n| (1..FEW_EPISODES).contains(n))
}

/// What is to be said before a pour with weights that do not know their pictures, which pour in any; `None` of others.
pub fn pictures_line(weights: &Weights) -> Option<&'static str> {
    weights.origin.pictures_unknown().then_some(
        "note: the weights do not say on which pictures they were trained, as they come from tables without framing: where these are others, another volume \
         is poured, and believed to be right",
    )
}

/// The likelier explanation of the weights; none with the plain sum.
fn explanation(weights: &Weights) -> Option<&Explanation> {
    match &weights.estimator {
        Estimator::Sum => None,
        Estimator::Fused { model, .. } => Some(model.likelier()),
    }
}

/// How far off a pour is expected to be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Expected {
    /// By this standard deviation, ml, above 0: the largest over fills from which the goal can be reached within the frames of a pour.
    Within(f32),
    /// The weights carry no deviation, or nothing is to be poured.
    Unknown,
    /// The vessel, as the weights know it, does not give the goal by the largest tilt from any usual fill.
    TooMuch,
    /// From every fill that gives the goal the pour takes more frames than it may, way back not counted.
    TooLong,
    /// From some fill that gives the goal the network stops this far short of it, ml: too far for a pour that is done.
    Short(f32),
}

impl Expected {
    /// The expected standard deviation, ml, if it is known.
    pub fn sd_ml(self) -> Option<f32> {
        if let Self::Within(sd_ml) = self { Some(sd_ml) } else { None }
    }
}

/// How far off a pour of `goal_ml` is expected to be, with a controller of these settings.
pub fn expected(weights: &Weights, settings: &Settings, goal_ml: f32) -> Expected {
    // A pour of nothing never begins.
    let known = explanation(weights).filter(|_| goal_ml > 0.0);
    let Some(Explanation { model, calibration, .. }) = known else { return Expected::Unknown };
    let flow = FlowTables::new(model, weights.rate_hz.into());
    let largest_ml = flow.capacity.lost_ml(settings.limits.alpha_max_deg.into());
    let gives = |onset_deg: f32| largest_ml - flow.capacity.lost_ml(onset_deg.into()) >= f64::from(goal_ml);
    let mut onsets_deg = ONSETS_DEG.into_iter().filter(|onset_deg| gives(*onset_deg)).peekable();
    if onsets_deg.peek().is_none() {
        return Expected::TooMuch;
    }
    let ends = onsets_deg.filter_map(|onset_deg| foreseen_end(weights, (&flow, calibration), settings, goal_ml, onset_deg));
    let ends: Vec<(f32, f32)> = ends.collect();
    let largest = |of: fn(&(f32, f32)) -> f32| ends.iter().map(of).max_by(f32::total_cmp);
    let short_ml = largest(|(_, d_ml)| *d_ml).filter(|d_ml| is_short(*d_ml, goal_ml));
    match (short_ml, largest(|(sd_ml, _)| *sd_ml)) {
        (Some(d_ml), _) => Expected::Short(d_ml),
        (None, Some(sd_ml)) if sd_ml > 0.0 => Expected::Within(sd_ml),
        (None, Some(_)) => Expected::Unknown,
        (None, None) => Expected::TooLong,
    }
}

/// The standard deviation at the end of a pour whose flow begins at `onset_deg`, and what is then still to pour, ml; `None` if it does not end by itself
/// within its frames.
fn foreseen_end(
    weights: &Weights,
    (flow, calibration): (&FlowTables, &Calibration),
    settings: &Settings,
    goal_ml: f32,
    onset_deg: f32,
) -> Option<(f32, f32)> {
    let headspace_ml = flow.capacity.lost_ml(onset_deg.into());
    let mut agent = Agent::new(weights);
    agent.start(goal_ml);
    let mut ending = Ending::of_pour();
    // The loop limits a step in each tick, and here there is one for each frame.
    let ticks = 1e9 / (settings.period_ns as f32 * weights.rate_hz);
    let limits = Limits { step_deg: settings.limits.step_deg * ticks, ..settings.limits };
    let mut limiter = Limiter::new(limits, 1.0 / weights.rate_hz, 0.0);
    let mut state = FlowState { headspace_ml, ..FlowState::default() };
    let mut history = CommandHistory::standing_at(0.0);
    let mut quiet = 0;
    for frame in 0..settings.max_frames.saturating_add(BACK_FRAMES) {
        // The bound is on the pour. On its way back it goes on to its end.
        if frame >= settings.max_frames && !ending.agent_is_done() {
            return None;
        }
        let alpha_deg = limiter.alpha_deg();
        history.push(alpha_deg.into());
        let leaves_ml = state.step(flow, history.commands(), 0).leaves_ml;
        let area_px2 = calibration.area_px2(leaves_ml, alpha_deg) as f32;
        let area_px2 = if area_px2 < VISIBLE_PX2 { 0.0 } else { area_px2 };
        let decision = agent.step(Observation {
            area_px2: Some(area_px2),
            confidence: 1.0,
            alpha_deg,
            alpha_measured_deg: f32::NAN,
            alpha_now_deg: alpha_deg,
        });
        // One that stands still short of its goal, or has come back, is over too.
        if ending.decided(&decision, settings) {
            agent.tilt_back();
        }
        quiet = if ending.agent_is_done() && area_px2 <= 0.0 { quiet + 1 } else { 0 };
        if quiet >= QUIET_FRAMES {
            return Some((decision.poured_sd_ml, decision.d_ml));
        }
        if ending.agent_is_done() {
            limiter.step_upright();
        } else {
            limiter.step(alpha_deg + decision.dalpha_deg);
        }
    }
    None
}

/// The tilt at which a vessel with `fill_ml` in it begins to flow by a learned curve, as a share of what it holds; `None` if the vessel does not hold it, or it
/// reaches no lip.
fn learned_onset_deg(capacity: &CapacityCurve, fill_ml: f64, holds_ml: Option<f64>) -> Option<f64> {
    let whole_ml = capacity.lost_ml(LAST_DEG.into());
    if !(0.0..=holds_ml.unwrap_or(OVERFULL * whole_ml)).contains(&fill_ml) {
        return None;
    }
    let empty_ml = whole_ml * (1.0 - fill_ml / holds_ml.unwrap_or(whole_ml)).clamp(0.0, 1.0);
    (0..LAST_DEG).map(f64::from).find(|deg| capacity.lost_ml(*deg) >= empty_ml)
}

/// The tilt by which a vessel with `fill_ml` in it must flow, degrees; `None` if the weights describe no vessel, the fill reaches no lip, or the vessel
/// does not hold it. Each explanation that may be right counts, that of any shape as far as the weights know it (`onset.rs`); a tilt beyond the largest one
/// bounds nothing. `holds_ml` is what the vessel holds, where somebody knows it.
pub fn flows_by_deg(weights: &Weights, fill_ml: f64, holds_ml: Option<f64>) -> Option<f32> {
    let Estimator::Fused { model, .. } = &weights.estimator else { return None };
    learned_onset_deg(&CapacityCurve::new(&model.likelier().model.vessel), fill_ml, holds_ml)?;
    let straight_deg = || {
        let onset_deg = learned_onset_deg(&CapacityCurve::new(&model.explanations[TIGHT].model.vessel), fill_ml, holds_ml);
        onset_deg.unwrap_or(LAST_DEG.into()) + BEYOND_DEG
    };
    let any_deg = || {
        let shape = Shape::learned(&model.explanations[WIDE]);
        let shape = if let Some(holds_ml) = holds_ml { shape.that_holds(holds_ml) } else { shape };
        let deg = shape.flows_by_deg(fill_ml, holds_ml, LATER_SDS).unwrap_or(LAST_DEG);
        (f64::from(deg) + LATER_DEG).max(BEYOND_DEG)
    };
    let straight_deg = if model.tight_share > UNLIKELY { straight_deg() } else { 0.0 };
    let any_deg = if model.tight_share < 1.0 - UNLIKELY { any_deg() } else { 0.0 };
    Some(straight_deg.max(any_deg) as f32)
}

/// The tilt by which a pour must flow, degrees, from what is known of the fill: `fill_ml` where the operator told it, as [`flows_by_deg`] takes it;
/// otherwise the configured least fill, ml, which counts as a full vessel where it is more than that: so a pour that shows no flow still ends early.
pub fn must_flow_by_deg(weights: &Weights, fill_ml: Option<f64>, least_fill_ml: Option<f64>, holds_ml: Option<f64>) -> Option<f32> {
    if fill_ml.is_some() {
        return flows_by_deg(weights, fill_ml?, holds_ml);
    }
    let whole_ml = || Some(FlowTables::new(&explanation(weights)?.model, weights.rate_hz.into()).capacity.lost_ml(LAST_DEG.into()));
    flows_by_deg(weights, least_fill_ml?.min(holds_ml.or_else(whole_ml)?), holds_ml)
}

/// What may leave at most before a camera that never sees the stream is noticed, ml, where no tilt below the largest one is known by which it must flow
/// ([`must_flow_by_deg`]): a full vessel flows early, and an emptier one than any episode's has to flow before nothing is seen for sure, or the largest tilt
/// to be reached. `None` where such a tilt is known, and with the plain sum.
pub fn unseen_ml(weights: &Weights, limits: Limits, flows_by_deg: Option<f32>) -> Option<f64> {
    let Estimator::Fused { model, .. } = &weights.estimator else { return None };
    let capacity = FlowTables::new(&model.likelier().model, weights.rate_hz.into()).capacity;
    let noticed_deg = model.bounds.dry_deg.min(limits.alpha_max_deg.into());
    let is_known = flows_by_deg.is_some_and(|deg| deg < limits.alpha_max_deg);
    (!is_known).then(|| capacity.lost_ml(noticed_deg))
}

/// What to say before a pour that a least fill, which the configuration tells, cannot bound: it takes weights that know the vessel.
pub fn unbounded_line(weights: Option<&Weights>, least_fill_ml: Option<f64>) -> Option<&'static str> {
    least_fill_ml?;
    match weights {
        None => Some(
            "[container] least_fill_ml bounds nothing in this pour, because controller.weights is not the file that the controller has taken: \
             if the camera sees no stream at all, that is noticed late",
        ),
        Some(w) if explanation(w).is_none() => Some(
            "[container] least_fill_ml bounds nothing in this pour, because weights of the plain sum know no vessel: if the camera sees no \
             stream at all, that is noticed late",
        ),
        Some(_) => None,
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use shared::actions::{STAY, Selection, action_table};
    use shared::estimator::filter::UNKNOWNS;
    use shared::estimator::flow::{FlowModel, WayBack};
    use shared::estimator::fused::{EXPLANATIONS, FusedModel};
    use shared::estimator::verdict::Bounds;
    use shared::estimator::vessel::{KNOTS, knot_deg};
    use shared::framing::Framing;
    use shared::mlp::{InputScale, Mlp};
    use shared::weights::{Method, Origin};

    use super::*;

    fn settings() -> Settings {
        Settings::new(&shared::config::Config::parse(include_str!("../../config/sim.toml"), "sim.toml").unwrap())
    }

    /// Weights whose network tilts by 0.2 degrees a frame until the goal is reached, for the usual beaker.
    pub(crate) fn weights() -> Weights {
        let mut network = Mlp::ZERO;
        network.b3[STAY + 2] = 1.0;
        let calibration = Calibration { volume_at_1_px2_ml: 0.0012, area_exponent: 1.2, log_tilt_slope: 0.0, hold_above_px2: 60.0 };
        let mut unknowns = [[0.0; UNKNOWNS]; UNKNOWNS];
        for (k, row) in unknowns.iter_mut().enumerate() {
            row[k] = [0.15f64, 0.04, 0.3].get(k).copied().unwrap_or(0.02).powi(2);
        }
        let model = FusedModel {
            explanations: [Explanation { model: FlowModel::default(), calibration, unknowns }; EXPLANATIONS],
            tight_share: 0.9,
            camera: [[0.04, -0.006], [-0.006, 0.001]],
            gain_sd: 0.015,
            bounds: Bounds { most_px2: 50_000.0, dry_deg: 90.0 },
        };
        Weights {
            network,
            actions_deg: action_table(),
            selection: Selection::Argmax,
            scale: InputScale::default(),
            calibration,
            estimator: Estimator::Fused { model, back: WayBack::new(&Limits::default(), 30.0) },
            rate_hz: 30.0,
            origin: Origin { method: Method::Handmade, actions: 21, episodes: 0, data_sha256: [7; 32], framing: Framing::default() },
            seed: 1,
        }
    }

    /// Protects whoever orders a pour: the deviation of a large pour is foreseen as larger than that of a small one, one that the vessel cannot
    /// give, or that takes longer than it may, has none, and the plain sum has none.
    #[test]
    fn a_deviation_is_foreseen() {
        let settings = |max_frames, limits| Settings { max_frames, limits, ..settings() };
        let of = |goal_ml, max_frames| expected(&weights(), &settings(max_frames, Limits::default()), goal_ml);
        let (Expected::Within(small), Expected::Within(large)) = (of(30.0, 900), of(150.0, 900)) else { panic!("no deviation") };
        assert!(small > 0.05 && large > 1.5 * small && large < 30.0, "{small} {large}");
        assert_eq!((of(30.0, 150), of(2000.0, 900)), (Expected::TooLong, Expected::TooMuch));
        let sum = Weights { estimator: Estimator::Sum, ..weights() };
        assert_eq!(expected(&sum, &settings(900, Limits::default()), 30.0), Expected::Unknown);
        // A pour that takes longer than the default is foreseen to its end where it may.
        let slow = Limits { rate_deg_s: 1.5, ..Limits::default() };
        let of = |max_frames| expected(&weights(), &settings(max_frames, slow), 150.0);
        assert_eq!(of(900), Expected::TooLong);
        assert!(matches!(of(9000), Expected::Within(sd_ml) if sd_ml > small), "{:?}", of(9000));
    }

    /// Protects whoever asks for a pour of an agent that stops short of its goal: the controller ends such a pour when it stands still, so it does not take too
    /// long, and a small deviation would not say how far off it is. The way back is not counted among its frames.
    #[test]
    fn a_pour_that_stands_still_has_an_end() {
        // It tilts as long as more than 28 ml are missing, and stays then.
        let scale = InputScale::default();
        let mut network = Mlp::ZERO;
        (network.w1[3][0], network.w2[0][0], network.w3[0][STAY + 2]) = (1.0, 1.0, 1.0);
        network.b3[STAY] = scale.apply([0.0; 3], 28.0)[3];
        let lazy = Weights { network, scale, ..weights() };
        let of = |max_frames, limits| expected(&lazy, &Settings { max_frames, limits, ..settings() }, 30.0);
        assert!(
            matches!(of(900, Limits::default()), Expected::Short(ml) if (10.0..30.0).contains(&ml)),
            "{:?}",
            of(900, Limits::default())
        );
        let least = |limits| (100..900).find(|frames| of(*frames, limits) != Expected::TooLong);
        let slow_back = Limits { return_rate_deg_s: 5.0, ..Limits::default() };
        assert_eq!(least(slow_back), least(Limits::default()), "the way back is not counted");
    }

    /// Protects whoever pours without telling the fill: what may leave unseen is said, and it grows with the tilt that has to be waited for, up to the
    /// largest one. A tilt beyond that bounds nothing.
    #[test]
    fn what_may_leave_unseen_is_said() {
        let limits = Limits::default();
        let until = |dry_deg: f64, limits, flows_by_deg| {
            let mut weights = weights();
            if let Estimator::Fused { model, .. } = &mut weights.estimator {
                model.bounds.dry_deg = dry_deg;
            }
            unseen_ml(&weights, limits, flows_by_deg)
        };
        let [early, late, never] = [60.0, 90.0, 180.0].map(|dry_deg| until(dry_deg, limits, None).unwrap());
        assert!(early > 100.0 && early + 50.0 < late && late <= never, "{early} {late} {never}");
        assert_eq!(until(180.0, Limits { alpha_max_deg: 60.0, ..limits }, None), Some(early));
        let told = [limits.alpha_max_deg - 1.0, limits.alpha_max_deg + 1.0].map(|deg| until(90.0, limits, Some(deg)));
        assert_eq!(told, [None, Some(late)]);
        assert_eq!(unseen_ml(&Weights { estimator: Estimator::Sum, ..weights() }, limits, None), None);
    }

    /// Protects `pour --fill`: a fuller vessel flows earlier, and a fill that the vessel does not reach its lip with says nothing.
    #[test]
    fn a_fill_must_flow_by_a_tilt() {
        let by = |fill_ml| flows_by_deg(&weights(), fill_ml, Some(520.0));
        let (full, half) = (by(480.0).unwrap(), by(250.0).unwrap());
        assert!(full > 15.0 && full + 15.0 < half && half < 90.0, "{full} {half}");
        for wrong in [0.0, -1.0, 521.0, 1e30, f64::INFINITY, f64::NAN] {
            assert_eq!((by(wrong), flows_by_deg(&weights(), 20.0 * wrong, None)), (None, None), "{wrong}");
        }
        assert_eq!(flows_by_deg(&Weights { estimator: Estimator::Sum, ..weights() }, 250.0, None), None);
    }

    /// Protects right pours from what nobody has learned of their vessel: the parts that no episode reached make its bound as wide as they are in doubt, what it
    /// holds makes that less, and a well known one is bounded nearly as a straight one is. That one's bound does not change.
    #[test]
    fn what_is_not_known_of_a_vessel_widens_its_bound() {
        let by = |tight_share: f64, open_sd: f64, holds_ml| {
            let mut weights = weights();
            let Estimator::Fused { model, .. } = &mut weights.estimator else { panic!("no model") };
            model.tight_share = tight_share;
            for (knot, row) in model.explanations[WIDE].unknowns[UNKNOWNS - KNOTS..].iter_mut().enumerate() {
                let is_open = !(40.0..80.0).contains(&knot_deg(knot));
                row[UNKNOWNS - KNOTS + knot] = if is_open { open_sd * open_sd } else { 0.05 * 0.05 };
            }
            flows_by_deg(&weights, 300.0, holds_ml).unwrap()
        };
        let holds_ml = Some(520.0);
        let (straight, known, open, unheld) = (by(1.0, 1.4, holds_ml), by(0.0, 0.05, holds_ml), by(0.0, 1.4, holds_ml), by(0.0, 1.4, None));
        assert_eq!(straight, by(1.0, 0.0, holds_ml));
        assert!((known - straight).abs() < 10.0 && open > known + 3.0 && unheld > open + 2.0, "{straight} {known} {open} {unheld}");
        // Where both may be right, the later one counts.
        assert_eq!(by(0.5, 1.4, holds_ml), open.max(straight));
    }

    /// Protects the pour of a vessel that is as full as it can be: it may be tilted a little all the same, whatever its shape.
    #[test]
    fn a_brimful_vessel_may_be_tilted() {
        let mut weights = weights();
        if let Estimator::Fused { model, .. } = &mut weights.estimator {
            model.tight_share = 0.0;
        }
        assert_eq!(flows_by_deg(&weights, 520.0, Some(520.0)), Some(BEYOND_DEG as f32));
    }

    /// Protects who relies on the least fill that the configuration tells: where it bounds nothing, that is said before the pour.
    #[test]
    fn a_least_fill_that_bounds_nothing_is_said() {
        let (fused, sum) = (weights(), Weights { estimator: Estimator::Sum, ..weights() });
        let said = |weights, least_fill_ml| unbounded_line(weights, least_fill_ml).is_some();
        assert!(said(None, Some(150.0)) && said(Some(&sum), Some(150.0)));
        assert!(!said(Some(&fused), Some(150.0)) && !said(None, None) && !said(Some(&sum), None));
    }

    /// Protects a pour whose configured least fill is more than the vessel holds: it must flow as out of a full one. What the operator tells counts
    /// before that, and is not cut.
    #[test]
    fn a_least_fill_counts_as_a_full_vessel_at_most() {
        let by = |fill_ml, least_ml, holds_ml| must_flow_by_deg(&weights(), fill_ml, least_ml, holds_ml);
        let full = by(Some(520.0), None, Some(520.0));
        assert!(full.is_some());
        for holds_ml in [Some(520.0), None] {
            assert!(by(None, Some(5000.0), holds_ml).is_some(), "{holds_ml:?}");
        }
        assert_eq!(by(None, Some(5000.0), Some(520.0)), full);
        assert_eq!((by(Some(5000.0), Some(250.0), Some(520.0)), by(None, None, Some(520.0))), (None, None));
        assert_eq!(by(None, Some(250.0), Some(520.0)), flows_by_deg(&weights(), 250.0, Some(520.0)));
    }
}
