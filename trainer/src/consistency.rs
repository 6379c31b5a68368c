//! Finds weights that do not fit the others: a typo, or a cup that was not tared.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail. Each weight is compared with what the camera's
//! areas say when they are calibrated on all other episodes, by the least sum of deviations, which one or two wrong ones hardly move. The
//! worst one is taken out, and the rest are compared again, so that one wrong weight does not accuse the others. Where either of two may
//! be the wrong one, as the rest agree without the one or without the other, both are accused.
//!
//! Two or three weights leave the exponent of the area open, so each pair of them is compared at the exponent that suits it best. Of three, the
//! two that are least apart accuse the third. Two that contradict each other accuse both, as nobody knows which one is wrong.

use serde::Serialize;
use shared::estimator::flow::FlowTables;
use shared::plural::counted;

use crate::calibration::{self, EXPONENT_SD, EXPONENTS, READING_SD_G, WEIGHT_SPREAD};
use crate::data::{self, TrainingEpisode};
use crate::exchanged;
use crate::fit::{CHANGE_NEEDS, Changed, Fit};
use crate::tare;
use crate::teaching::foresight::LAST_DEG;

/// So many episodes calibrate each other, the exponent included. Chosen by hand; no measurement is recorded.
const NEEDS: usize = 4;
/// By how much two weights may be apart at the best of them (log), as a standard deviation. Chosen by hand: none of 80 right sets of simulated rigs was accused.
const PAIR_SPREAD: f64 = 0.08;
/// Standard deviations at which a weight is doubted. Chosen by hand; no measurement is recorded.
const DOUBTED_SDS: f64 = 4.0;
/// By how much more a right weight may be off what few others say (log), as a standard deviation times their number. Chosen by hand; no measurement is recorded.
const SPREAD_FEW: f64 = 0.1;
/// The standard deviation of a normal error for a mean deviation of 1.
const ABSOLUTE_SD: f64 = 1.2533;

/// The name of what is doubtful about all episodes together.
pub const DATA_SET: &str = "data set";

/// No liquid that is poured weighs more, g/ml. From tables: glycerine has 1.26, and syrup 1.4.
const DENSEST_G_ML: f64 = 1.5;
/// Weights of which none reaches this are none of grams, g: 300 g are 11 ounces or 0.3 kg. Chosen by hand: a curve or pour to learn from has 25 g and more.
const GRAMS_LEAST: f64 = 15.0;
/// Right weights tell between this and that share of the vessel's volume. It rests on tilts at which nothing was ever seen: 90 trainings of tuning rigs 200
/// to 202, all kinds of vessels, with 2, 2+3 and 5 weighings told 0.72 to 5.2 times the volume, and a decimal point makes ten.
const VOLUME_TOLD: [f64; 2] = [0.25, 6.0];

/// A weight that does not fit.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct DoubtfulWeight {
    /// The episode.
    pub name: String,
    /// What was entered, g.
    pub weight_g: f64,
    /// What the other episodes say, g.
    pub expected_g: f64,
    /// Standard deviation of that, g.
    pub sd_g: f64,
}

impl std::fmt::Display for DoubtfulWeight {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let Self { name, weight_g, expected_g, sd_g } = self;
        write!(
            f,
            "{name}: weight {weight_g:.0} g, but the other episodes say {expected_g:.0} +- {sd_g:.0} g: a typo, or a cup that was not tared?"
        )
    }
}

/// What is doubtful about all episodes together once they are fitted: their weights and a camera whose gain has changed. `fit` is made
/// of the same episodes.
pub fn doubts_of_set(episodes: &[TrainingEpisode], fit: &Fit, holds_ml: Option<f64>) -> Vec<(String, String)> {
    against_vessel(episodes, fit, holds_ml)
        .into_iter()
        .chain(changed_camera(episodes, fit))
        .chain(suspected_camera(episodes, fit))
        .collect()
}

/// That the newest episodes alone have another gain, if they have: they are too few to tell a camera that was moved from a weight or a light of their own.
fn suspected_camera(episodes: &[TrainingEpisode], fit: &Fit) -> Option<(String, String)> {
    let Changed { episodes_before, before, after, error } = fit.suspected_gain?;
    let what = format!(
        "the camera's gain may have changed by {:+.1} % +- {:.1} % with {}, but fewer than {CHANGE_NEEDS} episodes do not tell: if camera, light or liquid were \
         changed there, pours are off by up to as much until {CHANGE_NEEDS} are weighed; if not, look at what it weighed",
        100.0 * ((after - before).exp() - 1.0),
        100.0 * error,
        episodes.get(episodes_before)?.name,
    );
    Some((DATA_SET.to_owned(), what))
}

/// That the camera's gain has changed along the episodes, if it has: the older ones then teach nothing of it, and a change that nobody knows of is that of
/// another camera, or of one that was moved while its framing stayed.
fn changed_camera(episodes: &[TrainingEpisode], fit: &Fit) -> Option<(String, String)> {
    let Changed { episodes_before, before, after, error } = fit.changed_gain?;
    let what = format!(
        "the camera's gain changed by {:+.1} % +- {:.1} % with {}, and only the newest gain counts: if camera, light or liquid were changed there, train \
         without the {} before it; if not, look at the camera and the weights",
        100.0 * ((after - before).exp() - 1.0),
        100.0 * error,
        episodes.get(episodes_before)?.name,
        counted(episodes_before, "episode")
    );
    Some((DATA_SET.to_owned(), what))
}

/// What all weights together say against grams, a tared cup, the order in which they were entered, and the vessel that holds `holds_ml` up to its lip, if somebody knows that: weights that are all
/// wrong by one factor, or by as many grams, do not contradict each other. Each line comes with the episode's name, or [`DATA_SET`].
pub fn against_vessel(episodes: &[TrainingEpisode], fit: &Fit, holds_ml: Option<f64>) -> Vec<(String, String)> {
    let mut doubts = Vec::new();
    let set = |what: String| (DATA_SET.to_owned(), what);
    let heaviest_g = episodes.iter().map(|e| e.weight_g).fold(0.0, f64::max);
    if heaviest_g < GRAMS_LEAST {
        doubts.push(set(format!("no weight is above {heaviest_g} g: are they in grams?")));
    }
    doubts.extend(tare::common_g(episodes).map(|tare_g| {
        let side = if tare_g > 0.0 { "more" } else { "less" };
        set(format!(
            "the weights fit the areas only if each is {:.0} g {side} than what flowed: was the cup tared, with nothing else on the scale, and is the camera \
             the same in all episodes?",
            tare_g.abs()
        ))
    }));
    doubts.extend(exchanged::pair(episodes).map(|(first, second)| {
        let (one, other) = (&episodes[first], &episodes[second]);
        let what = format!(
            "weight {:.0} g, and that of {} is {:.0} g: exchanged, these two fit the areas far better: was each entered for the other?",
            one.weight_g, other.name, other.weight_g
        );
        (one.name.clone(), what)
    }));
    let Some(holds_ml) = holds_ml else { return doubts };
    for e in episodes.iter().filter(|e| e.weight_g > DENSEST_G_ML * holds_ml) {
        let what = format!("weight {:.0} g, but the vessel holds {holds_ml:.0} ml: is the decimal point right?", e.weight_g);
        doubts.push((e.name.clone(), what));
    }
    let volume_ml = FlowTables::new(&fit.model, data::rate_hz(episodes)).capacity.lost_ml(LAST_DEG);
    if doubts.is_empty() && !(VOLUME_TOLD[0]..=VOLUME_TOLD[1]).contains(&(volume_ml / holds_ml)) {
        doubts.push(set(format!(
            "the weights are those of a vessel that holds {volume_ml:.0} ml, but it holds {holds_ml:.0} ml: are they in grams, and is the decimal point right?"
        )));
    }
    doubts
}

/// What an episode's weight and areas say about the weight of another one, g, with its standard deviation, at the exponent that suits the other one
/// best; and by how many standard deviations it is off all the same.
fn told_by(one: &TrainingEpisode, other: &TrainingEpisode) -> (f64, f64, f64) {
    let at = |exponent: u32| {
        let exponent = f64::from(exponent) / 100.0;
        let expected_g = one.weight_g * calibration::area_sum(other, exponent) / calibration::area_sum(one, exponent).max(1e-9);
        let sd_g = READING_SD_G.hypot(expected_g * PAIR_SPREAD.hypot(READING_SD_G / one.weight_g));
        (expected_g, sd_g, (other.weight_g - expected_g).abs() / sd_g)
    };
    let first = at(*EXPONENTS.start());
    EXPONENTS.step_by(10).map(at).fold(first, |best, next| if next.2 < best.2 { next } else { best })
}

/// Weights of two or three episodes that contradict each other.
fn doubtful_of_few(episodes: &[TrainingEpisode]) -> Vec<DoubtfulWeight> {
    let apart_sds = |j: usize, k: usize| told_by(&episodes[j], &episodes[k]).2.min(told_by(&episodes[k], &episodes[j]).2);
    let pairs = (0..episodes.len()).flat_map(|k| (0..k).map(move |j| (j, k)));
    let Some((least_sds, (j, k))) = pairs.map(|(j, k)| (apart_sds(j, k), (j, k))).min_by(|a, b| a.0.total_cmp(&b.0)) else {
        return Vec::new();
    };
    let trusted: &[usize] = if least_sds < DOUBTED_SDS { &[j, k] } else { &[] };
    let accused = (0..episodes.len()).filter(|i| !trusted.contains(i)).filter_map(|i| {
        let others = (0..episodes.len()).filter(|o| *o != i && (trusted.is_empty() || trusted.contains(o)));
        let (expected_g, sd_g, sds) = others.map(|o| told_by(&episodes[o], &episodes[i])).max_by(|a, b| a.2.total_cmp(&b.2))?;
        let e = &episodes[i];
        (sds >= DOUBTED_SDS).then(|| DoubtfulWeight { name: e.name.clone(), weight_g: e.weight_g, expected_g, sd_g })
    });
    accused.collect()
}

/// Logarithm of an episode's sum of area^q, for each q of [`EXPONENTS`].
fn log_sums(episode: &TrainingEpisode) -> Vec<f64> {
    EXPONENTS.map(|exponent| calibration::area_sum(episode, f64::from(exponent) / 100.0).max(1e-9).ln()).collect()
}

/// The value below and above which half of the weight lies; the pairs are of value and weight.
fn weighted_median(mut of: Vec<(f64, f64)>) -> f64 {
    of.sort_by(|a, b| a.0.total_cmp(&b.0));
    let half = 0.5 * of.iter().map(|(_, weight)| weight).sum::<f64>();
    let mut below = 0.0;
    let reached = of.iter().find(|(_, weight)| {
        below += weight;
        below >= half
    });
    reached.map_or(0.0, |(value, _)| *value)
}

/// An episode as it is compared: the logarithms of its weight and of its sums, and its place in what was given.
struct Compared {
    log_weight: f64,
    log_sums: Vec<f64>,
    place: usize,
}

impl Compared {
    /// By how much its weight may be off, as read and as a rule (log), where log c is this and q has this place in [`EXPONENTS`].
    fn log_sd(&self, log_c: f64, at: usize) -> f64 {
        WEIGHT_SPREAD.hypot(READING_SD_G / (log_c + self.log_sums[at]).exp().max(READING_SD_G))
    }
}

/// The calibration of these episodes that leaves the least sum of deviations (log), so that a wrong weight among them hardly moves it: log c, the
/// place of q in [`EXPONENTS`], and the sum.
fn robust(others: &[&Compared]) -> (f64, usize, f64) {
    let at = |at: usize| {
        let off = |o: &Compared| o.log_weight - o.log_sums[at];
        let first = weighted_median(others.iter().map(|o| (off(o), 1.0)).collect());
        let log_c = weighted_median(others.iter().map(|o| (off(o), 1.0 / o.log_sd(first, at))).collect());
        let sum: f64 = others.iter().map(|o| (off(o) - log_c).abs() / o.log_sd(log_c, at)).sum();
        let exponent = f64::from(*EXPONENTS.start() + at as u32) / 100.0;
        (log_c, at, sum + 0.5 * ((exponent - calibration::EXPONENT_EXPECTED) / EXPONENT_SD).powi(2))
    };
    (1..EXPONENTS.count()).map(at).fold(at(0), |best, next| if next.2 < best.2 { next } else { best })
}

/// What the other episodes say about the weight of `one`, g, with its standard deviation. Others that contradict each other raise it.
fn told_by_others(one: &Compared, others: &[&Compared]) -> (f64, f64) {
    let (log_c, at, sum) = robust(others);
    let last = one.log_sums.len() - 1;
    let (below, above) = (at.saturating_sub(1), (at + 1).min(last));
    let slope = |of: &Compared| (of.log_sums[above] - of.log_sums[below]) / (0.01 * (above - below).max(1) as f64);
    let mut precision = [[0.0, 0.0], [0.0, EXPONENT_SD.powi(-2)]];
    for o in others {
        let slopes = [1.0, slope(o)].map(|s| s / o.log_sd(log_c, at));
        for (row, a) in precision.iter_mut().zip(slopes) {
            row.iter_mut().zip(slopes).for_each(|(value, b)| *value += a * b);
        }
    }
    let n = others.len() as f64;
    let contradiction = (ABSOLUTE_SD * sum / n).max(1.0);
    let ([[cc, cq], [_, qq]], of_q) = (precision, slope(one));
    let log_variance = contradiction.powi(2) * (qq - 2.0 * cq * of_q + cc * of_q * of_q) / (cc * qq - cq * cq).max(1e-12);
    let spread = WEIGHT_SPREAD + SPREAD_FEW / (n + 1.0);
    let expected_g = (log_c + one.log_sums[at]).exp();
    (expected_g, READING_SD_G.hypot(expected_g * spread.hypot(log_variance.max(0.0).sqrt())))
}

/// By how many standard deviations each weight is off what the others say, with what they say, g, and its standard deviation.
fn apart(all: &[&Compared]) -> Vec<(f64, f64, f64)> {
    let told = |k: usize| {
        let (expected_g, sd_g) = told_by_others(all[k], &without(all, k));
        ((all[k].log_weight.exp() - expected_g).abs() / sd_g, expected_g, sd_g)
    };
    (0..all.len()).map(told).collect()
}

/// All but the one with this index.
fn without<'a>(all: &[&'a Compared], k: usize) -> Vec<&'a Compared> {
    all.iter().enumerate().filter(|(j, _)| *j != k).map(|(_, c)| *c).collect()
}

/// Weights that do not fit the others, worst first.
pub fn doubtful(episodes: &[TrainingEpisode]) -> Vec<DoubtfulWeight> {
    let compared = |(place, e): (usize, &TrainingEpisode)| Compared { log_weight: e.weight_g.ln(), log_sums: log_sums(e), place };
    let all: Vec<Compared> = if episodes.len() < NEEDS { Vec::new() } else { episodes.iter().enumerate().map(compared).collect() };
    let of = |left: &[&Compared]| -> Vec<TrainingEpisode> { left.iter().map(|c| episodes[c.place].clone()).collect() };
    let agree = |left: &[&Compared]| {
        if left.len() < NEEDS { doubtful_of_few(&of(left)).is_empty() } else { apart(left).iter().all(|(sds, ..)| *sds < DOUBTED_SDS) }
    };
    let mut left: Vec<&Compared> = all.iter().collect();
    let mut found = Vec::new();
    while left.len() >= NEEDS {
        let told = apart(&left);
        let Some(worst) = (0..left.len()).max_by(|a, b| told[*a].0.total_cmp(&told[*b].0)).filter(|k| told[*k].0 >= DOUBTED_SDS) else {
            return found;
        };
        let mut accused = vec![worst];
        if agree(&without(&left, worst)) {
            // Those that may be the wrong one in its place: they are off, too, and without them the rest agree.
            accused.extend((0..left.len()).filter(|k| *k != worst && told[*k].0 >= DOUBTED_SDS && agree(&without(&left, *k))));
        }
        found.extend(accused.iter().map(|k| {
            let (e, (_, expected_g, sd_g)) = (&episodes[left[*k].place], told[*k]);
            DoubtfulWeight { name: e.name.clone(), weight_g: e.weight_g, expected_g, sd_g }
        }));
        left = left.iter().enumerate().filter(|(k, _)| !accused.contains(k)).map(|(_, c)| *c).collect();
    }
    found.extend(doubtful_of_few(&if all.is_empty() { episodes.to_vec() } else { of(&left) }));
    found
}
