//! The paper's own training, section 3.3, equation by equation; as printed (`literal`), with the clip that Keras adds
//! (`literal-clipped`), repaired (`paper`), and its plain relative, behaviour cloning (`cloning`).
//!
//! Offline, pure, allocates; the same episodes, options and seed give the same weights on any number of threads.
//!
//! | | literal | paper |
//! |---|---|---|
//! | volumes | normalised contribution volumes, V_e summed as it is | the same of c area^q, with the dropout hold |
//! | action of state i | alpha(i) - alpha(i-1), the one *before* the image | alpha(i+1) - alpha(i), the one taken in that state |
//! | d of state i | d_i, from which v_i has yet to be taken | d_{i+1}, as eq. (2) gives it at run time, or the fused estimate does |
//! | goals, eq. (6) | kappa = 0.5, 0.6 .. 1.5 | kappa = 1: the volume that was poured is the goal that was met |
//! | weights, eq. (5), (7), (8) | normalised rewards of either sign | R of eq. (5), never negative |
//! | frames without flow and without motion | all | dropped: they teach to wait for ever |
//! | at run time | largest output | the expected angle, its remainder carried on |
//!
//! Why literal does not learn to pour: for R^ < 0 the gradient lambda R^ (p - I) does not vanish as p -> 0, because offline
//! data keeps presenting the action; logits run away and the policy becomes constant.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use shared::actions::ACTIONS;
use shared::actions::Selection;
use shared::estimate::flow::Flow;
use shared::estimate::fused::Fused;
use shared::estimate::{Calibration, Hold};
use shared::mlp::{InputScale, Mlp};
use shared::weights::{Estimator, Method, Origin, Weights};

use crate::data::{self, TrainingEpisode};
use crate::net::{Adam, Net, Sample};
use crate::train::{Estimate, MethodName, Options, Progress, Trained, actions_table, discretise};
use crate::{best, calibrate};

/// delta of eq. (5), 1/ml^2.
pub const DELTA: f64 = 0.01;
/// lambda of eq. (8).
pub const LAMBDA: f64 = 0.5;
/// Adam steps.
pub const STEPS: usize = 3000;
const BATCH: usize = 256;
/// The clip of Keras' categorical cross-entropy.
pub const KERAS_CLIP: f32 = 1e-7;

/// r(d) of eq. (5).
pub fn reward(d_ml: f64) -> f64 {
    (-DELTA * d_ml * d_ml).exp()
}

/// The normalised contribution volumes of an episode (section 3.3.1): volumes in proportion to `c area^q` that add up to w_E.
pub fn contributions(episode: &TrainingEpisode, calibration: &Calibration) -> Vec<f64> {
    let mut hold = Hold::default();
    let seen: Vec<f64> = episode
        .area_px2
        .iter()
        .zip(&episode.alpha_deg)
        .map(|(area, alpha)| {
            let held = hold.step(Some(*area as f32).filter(|a| !a.is_nan()), calibration.hold_above_px2);
            f64::from(calibration.volume_ml(held, *alpha as f32))
        })
        .collect();
    let sum: f64 = seen.iter().sum();
    seen.iter().map(|v| episode.weight_g * v / sum.max(1e-12)).collect()
}

/// The fused estimate's counterpart of the sum of the contribution volumes: what it takes for poured or on its way after each
/// frame of an episode, in proportion so that it ends at w_E.
fn fused_sums(episode: &TrainingEpisode, calibration: &Calibration, mut filter: Fused) -> Vec<f64> {
    let sums: Vec<f64> = episode
        .area_px2
        .iter()
        .zip(&episode.alpha_deg)
        .map(|(area, alpha)| {
            let y_ml = (!area.is_nan()).then(|| f64::from(calibration.volume_ml(*area as f32, *alpha as f32)));
            filter.step(y_ml, *alpha);
            filter.poured_ml() + filter.stop_volume_ml(*alpha)
        })
        .collect();
    let end = sums.last().copied().unwrap_or(0.0).max(1e-12);
    sums.iter().map(|s| episode.weight_g * s / end).collect()
}

/// One training sequence (steps 1 to 5 of the paper): its states and actions, and its reward.
struct Sequence {
    states: Vec<([f32; 4], u8)>,
    reward: f64,
}

/// The sequence of `episode` for goal kappa w_E. `poured` is what has been after each frame. `next`: state i is paired with the
/// action taken in it.
fn sequence(
    episode: &TrainingEpisode,
    volumes: &[f64],
    poured: &[f64],
    kappa: f64,
    next: bool,
    keep_still: bool,
    act: impl Fn(f64) -> u8,
    scale: &InputScale,
) -> Sequence {
    // Eq. (6), then d_{i+1} = d_i - v_i.
    let goal = kappa * episode.weight_g;
    let mut d = goal;
    let mut states = Vec::with_capacity(volumes.len());
    for (i, sum) in poured.iter().enumerate() {
        let before = d;
        d = goal - sum;
        let (from, to) = if next { (i, i + 1) } else { (i.max(1) - 1, i) };
        let Some(moved) = episode.alpha_deg.get(to).map(|a| a - episode.alpha_deg[from]) else { continue };
        let v = [i, i.wrapping_sub(1), i.wrapping_sub(2)].map(|k| volumes.get(k).copied().unwrap_or(0.0) as f32);
        if !keep_still && v[0] == 0.0 && moved.abs() < 0.025 {
            continue;
        }
        states.push((scale.apply(v, if next { d } else { before } as f32), act(moved)));
    }
    Sequence { states, reward: reward(d) }
}

/// Trains on usable episodes.
pub fn train(episodes: &[TrainingEpisode], options: &Options, progress: &dyn Progress) -> Trained {
    let literal = matches!(options.method, MethodName::Literal | MethodName::LiteralClipped);
    let fused = options.method == MethodName::Paper && options.estimate == Estimate::Fused;
    let (calibration, estimator, fit) = if literal {
        (Calibration { hold_above_px2: f32::INFINITY, ..calibrate::fit(episodes, Some(1.0)) }, Estimator::Sum, None)
    } else if fused {
        progress.stage("fitting the flow model", 1);
        let (fit, estimator) = best::estimator(episodes, Estimate::Fused, &options.limits);
        (fit.calibration, estimator, Some(fit))
    } else {
        (calibrate::fit(episodes, None), Estimator::Sum, None)
    };
    let scale = InputScale::default();
    let table = actions_table(options.actions);
    let act = |moved: f64| discretise(&table, options.actions, moved);
    let kappas: Vec<f64> = if literal { (0..=10).map(|k| 0.5 + 0.1 * f64::from(k)).collect() } else { vec![1.0] };
    let mut sequences = Vec::new();
    for e in episodes {
        let volumes = contributions(e, &calibration);
        let poured = match &estimator {
            Estimator::Sum => volumes
                .iter()
                .scan(0.0, |sum, v| {
                    *sum += v;
                    Some(*sum)
                })
                .collect(),
            Estimator::Fused { model, back } => fused_sums(e, &calibration, Fused::new(Flow::new(model), *back)),
        };
        for kappa in &kappas {
            sequences.push(sequence(e, &volumes, &poured, *kappa, !literal, literal, act, &scale));
        }
    }
    // Eq. (7): rewards minus their mean, over their variance's root.
    let n = sequences.len() as f64;
    let mean = sequences.iter().map(|s| s.reward).sum::<f64>() / n;
    let sd = (sequences.iter().map(|s| (s.reward - mean).powi(2)).sum::<f64>() / n).sqrt().max(1e-9);
    let mut samples = Vec::new();
    for s in &sequences {
        let weight = match options.method {
            MethodName::Literal | MethodName::LiteralClipped => LAMBDA * (s.reward - mean) / sd,
            MethodName::Cloning => 1.0,
            _ => LAMBDA * s.reward,
        };
        samples.extend(s.states.iter().map(|(x, action)| Sample { x: *x, action: *action, weight: weight as f32 }));
    }

    // Random batches, eq. (8) with cross-entropy: the gradient on the logits is lambda R^ (p - I).
    let mut rng = Pcg64Mcg::seed_from_u64(options.seed ^ 0xe98);
    let mut net = Net::standard(&mut rng);
    if options.actions == 2 {
        net.keep_only(&[0, ACTIONS - 1]);
    }
    let mut adam = Adam::new(&net);
    let clip = (options.method == MethodName::LiteralClipped).then_some(KERAS_CLIP);
    let mut loss = Vec::new();
    progress.stage("training on eq. (8)", STEPS as u64);
    let mut batch = Vec::with_capacity(BATCH);
    for step in 0..STEPS {
        batch.clear();
        batch.extend((0..BATCH).map(|_| samples[rng.random_range(0..samples.len())]));
        let rate = if literal { 1e-3 } else { 2e-3 * 0.1f32.powf(step as f32 / STEPS as f32) };
        let l = net.learn(&batch, clip, rate, &mut adam);
        if (step + 1) % 50 == 0 {
            loss.push(l);
            progress.at(step as u64 + 1, &format!("loss {l:.3}"));
        }
    }
    let weights = Weights {
        network: net.to_mlp().unwrap_or(Mlp::ZERO),
        actions_deg: table,
        selection: if options.method == MethodName::Paper { Selection::Expected } else { Selection::Argmax },
        scale,
        calibration,
        estimator,
        rate_hz: episodes.first().map_or(30.0, |e| e.rate_hz) as f32,
        origin: Origin {
            method: match options.method {
                MethodName::Paper => Method::Paper,
                MethodName::Cloning => Method::Cloning,
                _ => Method::Literal,
            },
            actions: options.actions,
            episodes: episodes.len() as u32,
            data_sha256: data::hash(episodes),
        },
        seed: options.seed,
    };
    Trained { weights, fit, law: None, search_curve: Vec::new(), loss }
}
