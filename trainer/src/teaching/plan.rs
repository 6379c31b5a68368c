//! The curve or pour that takes most of the doubt about the pours to come.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail. Each candidate is foreseen in the fitted flow model,
//! and the one after whose weighing the camera's volumes of the pours to come are least in doubt, on average, is proposed.

use serde::Serialize;
use shared::gaussian_curve::Curve;
use shared::limits::Limits;

use super::doubt::{Doubt, gain_sd};
use super::foresight::Foresight;
use super::span::Span;

/// Number of curves that come before any pour: one leaves the exponent open, and a policy that pours needs some idea of both.
const CURVES_FIRST: usize = 2;
/// Fills that are considered, as shares of what the vessel holds. The last one leaves room for the way into the gripper.
const FILL_SHARES: [f64; 6] = [0.4, 0.5, 0.6, 0.7, 0.8, 0.9];
/// Goals that are considered, ml.
const GOALS_ML: [f64; 8] = [40.0, 60.0, 80.0, 100.0, 130.0, 160.0, 200.0, 250.0];
/// How far beyond the tilt of the first drop a curve may go, degrees.
const BEYOND_DEG: [f64; 4] = [8.0, 12.0, 16.0, 20.0];
/// Fills of a vessel that holds less than this are rounded to 5 ml and not to 10, ml. Chosen by hand: 10 ml are a tenth of it.
const SMALL_ML: f64 = 100.0;
/// The least vessel is looked for below this, ml. Chosen by hand: twice what it is with the default limits.
const HOLDS_LOOKED_FOR_ML: u32 = 200;
/// Widths of curves, 1/s^2.
const GAMMAS_PER_S2: [f64; 3] = [0.15, 0.25, 0.5];
/// Largest share of a fill that is poured: so that a vessel which was misjudged is not poured empty.
const POURED_SHARE_MAX: f64 = 0.6;
/// Least volume of a candidate, ml: below it, the scale's rounding hides what is to be learned.
const LEAST_ML: f64 = 25.0;
/// Goals of the pours to come, as shares of the largest.
const GOAL_SHARES: [f64; 4] = [0.1, 0.25, 0.5, 1.0];
/// Area at which c and q are taken as independent where nothing was seen, log px^2.
const LOG_AREA_UNSEEN: f64 = 7.5;
/// What a candidate has to be better by to be proposed instead of an earlier one, share. Curves come after pours.
const BETTER: f64 = 0.01;

/// What to do next.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
#[serde(tag = "kind", rename_all = "kebab-case")]
pub enum Proposal {
    /// Record a curve of eq. (1).
    Curve {
        /// What to fill in, ml.
        fill_ml: f64,
        /// Height, degrees.
        lambda_deg: f64,
        /// Width, 1/s^2.
        gamma_per_s2: f64,
    },
    /// Pour.
    Pour {
        /// What to fill in, ml.
        fill_ml: f64,
        /// V_G, ml.
        goal_ml: f64,
    },
}

/// A proposal, and what is to be expected of it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Candidate {
    /// What to do.
    pub next: Proposal,
    /// What should be on the scale afterwards, ml.
    pub weight_ml: f64,
    /// Mean standard deviation of the camera's volume over the pours to come, when this has been weighed, ml.
    pub sd_after_ml: f64,
}

/// What is proposed.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Plan {
    /// Mean standard deviation of the camera's volume over the pours to come, ml; of no use before anything was weighed.
    pub sd_now_ml: f64,
    /// The best candidate of each kind that is possible, the proposal first.
    pub candidates: Vec<Candidate>,
}

/// What is asked for.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wish {
    /// The largest goal of the pours to come, ml.
    pub goal_max_ml: f64,
    /// The largest tilt of a curve, degrees.
    pub alpha_max_deg: f64,
    /// The cell's limits, which a curve has to keep when it is commanded once every [`Self::period_ns`].
    pub limits: Limits,
    /// The period of the cell's loop, ns.
    pub period_ns: u64,
}

/// The fills that are considered, ml, rounded down: a fill must go in.
fn fills_ml(vessel: &Foresight) -> impl Iterator<Item = f64> {
    let holds_ml = vessel.holds_ml();
    let step_ml = if holds_ml < SMALL_ML { 5.0 } else { 10.0 };
    FILL_SHARES.into_iter().map(move |share| (share * holds_ml / step_ml).floor() * step_ml)
}

/// All curves that are possible, with what they show.
fn curves(vessel: &Foresight, wish: &Wish) -> Vec<(Proposal, Span)> {
    let mut all = Vec::new();
    for fill_ml in fills_ml(vessel) {
        for beyond_deg in BEYOND_DEG {
            let lambda_deg = (vessel.onset_deg(fill_ml) + beyond_deg).round();
            for gamma_per_s2 in GAMMAS_PER_S2 {
                let span = vessel.curve(fill_ml, lambda_deg, gamma_per_s2);
                let possible = (LEAST_ML..POURED_SHARE_MAX * fill_ml).contains(&span.volume_ml());
                let runs = Curve::from_upright(lambda_deg as f32, gamma_per_s2 as f32).fits(&wish.limits, wish.period_ns);
                if possible && runs && lambda_deg <= wish.alpha_max_deg {
                    all.push((Proposal::Curve { fill_ml, lambda_deg, gamma_per_s2 }, span));
                }
            }
        }
    }
    all
}

/// All pours that are possible, with what they show.
fn pours(vessel: &Foresight, wish: &Wish) -> Vec<(Proposal, Span)> {
    let mut all = Vec::new();
    for fill_ml in fills_ml(vessel) {
        let most_ml = wish.goal_max_ml.min(POURED_SHARE_MAX * fill_ml);
        // The largest goal itself, where all of the others are above it and the scale tells it.
        let largest = Some(most_ml.floor()).filter(|ml| (LEAST_ML..GOALS_ML[0]).contains(ml));
        for goal_ml in GOALS_ML.into_iter().filter(|goal| *goal <= most_ml).chain(largest) {
            if let Some(span) = vessel.pour(fill_ml, goal_ml) {
                all.push((Proposal::Pour { fill_ml, goal_ml }, span));
            }
        }
    }
    all
}

/// The streams of the pours to come: small and large goals from every fill. Goals of a few drops, which show no stream, say nothing.
fn pours_to_come(vessel: &Foresight, wish: &Wish) -> Vec<Span> {
    let goals = GOAL_SHARES.map(|share| share * wish.goal_max_ml);
    FILL_SHARES
        .iter()
        .map(|share| share * vessel.holds_ml())
        .flat_map(|fill_ml| goals.iter().filter_map(move |goal_ml| vessel.pour(fill_ml, goal_ml.min(POURED_SHARE_MAX * fill_ml))))
        .filter(|span| span.volume_ml() > 0.0)
        .collect()
}

/// The least largest goal, in whole ml, of which any pour to come shows a stream; `None` if no goal that is considered does.
pub fn least_goal_max_ml(vessel: &Foresight, wish: &Wish) -> Option<f64> {
    (1..=GOALS_ML[0] as u32)
        .map(f64::from)
        .find(|goal_max_ml| !pours_to_come(vessel, &Wish { goal_max_ml: *goal_max_ml, ..*wish }).is_empty())
}

/// The least vessel, in whole ml that it holds, from which on a plan can begin with every vessel; `None` if there is none below 200 ml.
pub fn least_holds_ml(wish: &Wish) -> Option<f64> {
    let begins = |holds_ml: &f64| !curves(&Foresight::unknown(*holds_ml, wish.alpha_max_deg), wish).is_empty();
    (1..HOLDS_LOOKED_FOR_ML).rev().map(f64::from).take_while(begins).last()
}

/// The mean standard deviation of the camera's volumes of some pours, ml.
fn mean_sd_ml(doubt: &Doubt, pours: &[Span]) -> f64 {
    pours.iter().map(|span| doubt.sd_ml(span)).sum::<f64>() / pours.len() as f64
}

/// The logarithm of the area at which most was weighed.
fn log_area(weighed: &[Span]) -> f64 {
    let mut areas: Vec<f64> = weighed.iter().filter_map(Span::median_area_px2).map(f64::ln).collect();
    areas.sort_by(f64::total_cmp);
    areas.get(areas.len() / 2).copied().unwrap_or(LOG_AREA_UNSEEN)
}

/// The doubt that is left by streams that were weighed with `weights_g`.
fn doubt_after(weighed: &[Span], weights_g: &[f64]) -> Doubt {
    let log_area = log_area(weighed);
    let before = Doubt::before(log_area, gain_sd(log_area, weighed, weights_g));
    weighed.iter().fold(before, |doubt, span| doubt.weighed(span))
}

/// Proposes what to weigh next, after streams that were weighed with `weights_g`. The candidates are empty if the vessel allows none, or no pour to come
/// is foreseen.
pub fn plan(vessel: &Foresight, weighed: &[Span], weights_g: &[f64], wish: &Wish) -> Plan {
    let doubt = doubt_after(weighed, weights_g);
    let to_come = pours_to_come(vessel, wish);
    if to_come.is_empty() {
        return Plan { sd_now_ml: 0.0, candidates: Vec::new() };
    }
    let best = |candidates: Vec<(Proposal, Span)>| -> Option<Candidate> {
        candidates
            .into_iter()
            .map(|(next, span)| Candidate { next, weight_ml: span.volume_ml(), sd_after_ml: mean_sd_ml(&doubt.weighed(&span), &to_come) })
            .min_by(|a, b| a.sd_after_ml.total_cmp(&b.sd_after_ml))
    };
    let curve = best(curves(vessel, wish));
    let pour = if weighed.len() < CURVES_FIRST { None } else { best(pours(vessel, wish)) };
    let curve_is_better = match (&curve, &pour) {
        (Some(curve), Some(pour)) => curve.sd_after_ml < (1.0 - BETTER) * pour.sd_after_ml,
        _ => false,
    };
    let candidates = if curve_is_better { [curve, pour] } else { [pour, curve] };
    Plan { sd_now_ml: mean_sd_ml(&doubt, &to_come), candidates: candidates.into_iter().flatten().collect() }
}

#[cfg(test)]
mod tests {
    use super::*;

    const WISH: Wish = Wish { goal_max_ml: 250.0, alpha_max_deg: 105.0, limits: Limits::DEFAULT, period_ns: 33_333_333 };

    /// Weights that say just what the streams show, g.
    fn volumes(weighed: &[Span]) -> Vec<f64> {
        weighed.iter().map(Span::volume_ml).collect()
    }

    fn next(vessel: &Foresight, weighed: &[Span]) -> (Plan, Candidate) {
        let plan = plan(vessel, weighed, &volumes(weighed), &WISH);
        let first = plan.candidates[0];
        (plan, first)
    }

    fn span_of(vessel: &Foresight, candidate: &Candidate) -> Span {
        match candidate.next {
            Proposal::Curve { fill_ml, lambda_deg, gamma_per_s2 } => vessel.curve(fill_ml, lambda_deg, gamma_per_s2),
            Proposal::Pour { fill_ml, goal_ml } => vessel.pour(fill_ml, goal_ml).unwrap(),
        }
    }

    /// Protects the first hour: two curves come first, then pours from different fills; each is the one of its kind that leaves least doubt, and what
    /// follows the plan leaves less of it than the same number of pours that are all alike.
    #[test]
    fn what_is_proposed_teaches() {
        let vessel = Foresight::unknown(500.0, 105.0);
        let mut weighed = Vec::new();
        let (mut kinds, mut fills, mut sds) = (Vec::new(), Vec::new(), Vec::new());
        for _ in 0..5 {
            let (plan, first) = next(&vessel, &weighed);
            sds.push(plan.sd_now_ml);
            assert!(first.sd_after_ml < plan.sd_now_ml, "{plan:?}");
            let (doubt, to_come) = (doubt_after(&weighed, &volumes(&weighed)), pours_to_come(&vessel, &WISH));
            let possible = if weighed.len() < CURVES_FIRST { curves(&vessel, &WISH) } else { pours(&vessel, &WISH) };
            let least = possible.iter().map(|(_, span)| mean_sd_ml(&doubt.weighed(span), &to_come)).fold(f64::MAX, f64::min);
            assert!(first.sd_after_ml < least + 1e-9, "another one leaves {least} ml: {plan:?}");
            match first.next {
                Proposal::Curve { fill_ml, .. } => {
                    kinds.push('c');
                    fills.push(fill_ml);
                }
                Proposal::Pour { fill_ml, .. } => {
                    kinds.push('p');
                    fills.push(fill_ml);
                }
            }
            weighed.push(span_of(&vessel, &first));
        }
        assert_eq!(kinds[..2], ['c', 'c'], "{kinds:?}");
        assert!(kinds[2..].contains(&'p'), "{kinds:?}");
        let (low, high) = fills.iter().fold((f64::MAX, 0.0f64), |(l, h), f| (l.min(*f), h.max(*f)));
        assert!(high - low >= 100.0, "{fills:?}");
        let alike: Vec<Span> = (0..5).map(|_| vessel.curve(450.0, vessel.onset_deg(450.0) + 12.0, 0.25)).collect();
        let by_plan = mean_sd_ml(&doubt_after(&weighed, &volumes(&weighed)), &pours_to_come(&vessel, &WISH));
        let by_habit = mean_sd_ml(&doubt_after(&alike, &volumes(&alike)), &pours_to_come(&vessel, &WISH));
        assert!(by_plan < 0.8 * by_habit, "{by_plan} {by_habit} {sds:?}");
    }

    /// Protects the bench: whatever the vessel holds, what is proposed goes in, leaves something behind, and can be commanded.
    #[test]
    fn what_is_proposed_is_possible() {
        let least_ml = least_holds_ml(&WISH).unwrap();
        assert!((85.0..=95.0).contains(&least_ml), "a curve from a vessel of {least_ml} ml is weighed well enough");
        let vessels = [50.0, 60.0, 70.0, 80.0, 90.0, least_ml, 150.0, 300.0, 500.0, 1000.0, 2000.0].map(|holds_ml| (holds_ml, WISH));
        // Cells whose largest goal is below all goals that are considered.
        let small_goals =
            [(500.0, 25.0), (500.0, 30.0), (100.0, 39.0)].map(|(holds_ml, goal_max_ml)| (holds_ml, Wish { goal_max_ml, ..WISH }));
        for (holds_ml, wish) in vessels.into_iter().chain(small_goals) {
            let vessel = Foresight::unknown(holds_ml, 105.0);
            for (possible, _) in curves(&vessel, &wish).into_iter().chain(pours(&vessel, &wish)) {
                let (Proposal::Curve { fill_ml, .. } | Proposal::Pour { fill_ml, .. }) = possible;
                assert!(fill_ml <= 0.92 * holds_ml, "{holds_ml}: {possible:?}");
            }
            assert!(!pours(&vessel, &wish).is_empty(), "{holds_ml}: {wish:?}");
            // Smaller ones than the least get pours only, once somebody has weighed two curves of his own.
            let own = vessel.curve(0.9 * holds_ml, vessel.onset_deg(0.9 * holds_ml) + 12.0, 0.25);
            let mut weighed = if holds_ml < least_ml { vec![own; CURVES_FIRST] } else { Vec::new() };
            for _ in 0..4 {
                let found = plan(&vessel, &weighed, &volumes(&weighed), &wish);
                let first = *found.candidates.first().unwrap_or_else(|| panic!("{holds_ml}: {wish:?} after {}", weighed.len()));
                let (fill_ml, lambda_deg) = match first.next {
                    Proposal::Curve { fill_ml, lambda_deg, .. } => (fill_ml, lambda_deg),
                    Proposal::Pour { fill_ml, goal_ml } => {
                        assert!(goal_ml <= POURED_SHARE_MAX * fill_ml && goal_ml <= wish.goal_max_ml);
                        (fill_ml, 0.0)
                    }
                };
                assert!(fill_ml <= 0.92 * holds_ml && lambda_deg <= wish.alpha_max_deg, "{holds_ml}: {first:?}");
                assert!(first.weight_ml >= 0.8 * LEAST_ML && first.weight_ml <= 0.7 * fill_ml, "{holds_ml}: {first:?}");
                weighed.push(span_of(&vessel, &first));
            }
        }
    }
}
