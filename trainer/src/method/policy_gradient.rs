//! The paper's own training, section 3.3, equation by equation; as printed (`literal`), with the clip that Keras adds
//! (`literal-clipped`), repaired (`paper`), and its plain relative (`cloning`). Both of the latter are behaviour cloning.
//!
//! Pure functions of the offline trainer, which allocate and do not fail; the same episodes, options and seed give the same weights on any
//! number of threads.
//!
//! | | literal | paper |
//! |---|---|---|
//! | volumes | normalised contribution volumes of V_e as it is | the same of c area^q, with the dropout hold |
//! | action of state i | alpha(i) - alpha(i-1), the one *before* the image | alpha(i+1) - alpha(i), the one taken in that state |
//! | d of state i | d_i, from which v_i has yet to be taken | d_{i+1}, as eq. (2) gives it at run time, or what the fused estimate says |
//! | goals, eq. (6) | kappa = 0.5, 0.6 .. 1.5 | kappa = 1: the volume that was poured is the goal that was met |
//! | weights, eq. (5), (7), (8) | normalised rewards of either sign | R of eq. (5), which is 1, because d ends at 0 for kappa = 1 |
//! | frames without flow and without motion | all | dropped: they teach to wait for ever |
//! | at run time | largest output | the expected angle; its remainder is carried on |
//!
//! `paper` differs from `cloning` in the estimate of d and in what is done at run time; that its weights are half as large (lambda) changes next to
//! nothing under Adam. All methods feed the network with asinh of the volumes. Eq. (7) is divided by the root of the variance, where the paper prints
//! the variance.
//!
//! This is why `literal` does not learn to pour: for R^ < 0 the gradient lambda R^ (p - I) does not vanish as p goes to 0, because
//! the recorded episodes keep presenting the action. The logits run away, and the policy becomes constant.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use shared::actions::Selection;
use shared::estimator::flow::WayBack;
use shared::estimator::fused::{FusedEstimator, FusedFrame};
use shared::estimator::{Calibration, Hold};
use shared::mlp::{InputScale, Mlp};
use shared::weights::{Estimator, Method, Origin, Weights};

use crate::allowed_actions::Actions;
use crate::calibration;
use crate::data::{self, TrainingEpisode};
use crate::fit::{self, Fit};
use crate::network::{Adam, Example, Network, REPORT_EVERY};
use crate::training::{Estimate, MethodName, Options, Progress, Trained};

/// delta of eq. (5), 1/ml^2. The paper only asks for a small number; chosen by hand, no measurement is recorded.
pub const DELTA: f64 = 0.01;
/// lambda of eq. (8). The paper gives no value; chosen by hand, no measurement is recorded.
pub const LAMBDA: f64 = 0.5;
/// The bound of Keras' categorical cross-entropy, which clips probabilities to [1e-7, 1 - 1e-7].
pub const KERAS_CLIP: f32 = 1e-7;
/// Adam steps of a training. From the prototype's recipe; no other measurement is recorded.
const STEPS: usize = 3000;
/// Examples of an Adam step. From the prototype's recipe; no other measurement is recorded.
const BATCH: usize = 256;
/// Learning rate of the literal methods: Adam's own default.
const LITERAL_RATE: f32 = 1e-3;
/// Learning rate of the other methods at their first step; it falls to a tenth. From the prototype's recipe; no other measurement is
/// recorded.
const FIRST_RATE: f32 = 2e-3;
/// A frame whose angle changes by less than this stands still, degrees: half of the finest action.
const STILL_DEG: f64 = 0.025;

/// r(d) of eq. (5).
pub fn reward(d_ml: f64) -> f64 {
    (-DELTA * d_ml * d_ml).exp()
}

/// The normalised contribution volumes of an episode (section 3.3.1): volumes in proportion to those of the calibration, which add
/// up to w_E, ml.
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

/// The sum of the contribution volumes after each frame, ml.
fn plain_sums(volumes: &[f64]) -> Vec<f64> {
    volumes
        .iter()
        .scan(0.0, |sum, v| {
            *sum += v;
            Some(*sum)
        })
        .collect()
}

/// The fused estimate's counterpart of [`plain_sums`]: what it takes for poured or on its way after each frame of an episode, in
/// proportion, so that it ends at w_E, ml.
fn fused_sums(episode: &TrainingEpisode, mut estimator: FusedEstimator) -> Vec<f64> {
    let sums: Vec<f64> = (0..episode.len())
        .map(|k| {
            let command_deg = episode.alpha_deg[k];
            let area_px2 = Some(episode.area_px2[k] as f32).filter(|a| !a.is_nan());
            estimator.step(FusedFrame { area_px2, confidence: 1.0, command_deg, measured_deg: episode.alpha_measured_deg[k] });
            estimator.poured_ml() + estimator.stop_volume_ml(command_deg)
        })
        .collect();
    let end = sums.last().copied().unwrap_or(0.0).max(1e-12);
    sums.iter().map(|s| episode.weight_g * s / end).collect()
}

/// How states are made of an episode's frames.
struct Recipe {
    /// Whether it is as the paper prints it; otherwise it is repaired.
    literal: bool,
    actions: Actions,
    scale: InputScale,
}

/// One training sequence (steps 1 to 5 of the paper): its states with their actions, and its reward.
struct Sequence {
    states: Vec<([f32; 4], u8)>,
    reward: f64,
}

impl Recipe {
    /// The sequence of an episode for the goal kappa w_E. `volumes` are the frames' contributions, and `poured` is what has been
    /// poured after each frame, ml.
    fn sequence(&self, episode: &TrainingEpisode, volumes: &[f64], poured: &[f64], kappa: f64) -> Sequence {
        // Eq. (6), then d_{i+1} = d_i - v_i.
        let goal = kappa * episode.weight_g;
        let mut d = goal;
        let mut states = Vec::with_capacity(volumes.len());
        for (i, sum) in poured.iter().enumerate() {
            let before = d;
            d = goal - sum;
            let (from, to) = if self.literal { (i.max(1) - 1, i) } else { (i, i + 1) };
            let Some(moved_deg) = episode.alpha_deg.get(to).map(|a| a - episode.alpha_deg[from]) else { continue };
            let v = [i, i.wrapping_sub(1), i.wrapping_sub(2)].map(|k| volumes.get(k).copied().unwrap_or(0.0) as f32);
            if !self.literal && v[0] == 0.0 && moved_deg.abs() < STILL_DEG {
                continue;
            }
            let d_of_state = if self.literal { before } else { d };
            states.push((self.scale.apply(v, d_of_state as f32), self.actions.discretise(moved_deg)));
        }
        Sequence { states, reward: reward(d) }
    }

    /// The sequences of all episodes: one for each goal.
    fn sequences(&self, episodes: &[TrainingEpisode], calibration: &Calibration, estimator: &Estimator) -> Vec<Sequence> {
        let kappas: Vec<f64> = if self.literal { (0..=10).map(|k| 0.5 + 0.1 * f64::from(k)).collect() } else { vec![1.0] };
        let mut sequences = Vec::new();
        for episode in episodes {
            let volumes = contributions(episode, calibration);
            let poured = match estimator {
                Estimator::Sum => plain_sums(&volumes),
                Estimator::Fused { model, back } => fused_sums(episode, FusedEstimator::new(model, calibration, *back, episode.rate_hz)),
            };
            sequences.extend(kappas.iter().map(|kappa| self.sequence(episode, &volumes, &poured, *kappa)));
        }
        sequences
    }
}

/// The sequences' states as examples, each weighted with its sequence's reward (eq. 7 and the lambda R^ of eq. 8).
fn examples(sequences: &[Sequence], method: MethodName) -> Vec<Example> {
    // Eq. (7): rewards minus their mean, over the root of their variance.
    let n = sequences.len() as f64;
    let mean = sequences.iter().map(|s| s.reward).sum::<f64>() / n;
    let sd = (sequences.iter().map(|s| (s.reward - mean).powi(2)).sum::<f64>() / n).sqrt().max(1e-9);
    let mut examples = Vec::new();
    for s in sequences {
        let weight = match method {
            MethodName::Literal | MethodName::LiteralClipped => LAMBDA * (s.reward - mean) / sd,
            MethodName::Cloning => 1.0,
            _ => LAMBDA * s.reward,
        };
        examples.extend(s.states.iter().map(|(x, action)| Example { x: *x, action: *action, weight: weight as f32 }));
    }
    examples
}

/// Trains a network on random batches by eq. (8) with cross-entropy: the gradient on the logits is lambda R^ (p - I). Returns
/// the network and its losses.
fn learn(examples: &[Example], recipe: &Recipe, options: &Options, progress: &dyn Progress) -> (Network, Vec<f32>) {
    let mut rng = Pcg64Mcg::seed_from_u64(options.seed ^ 0xe98);
    let mut network = Network::standard(&mut rng);
    network.forbid(recipe.actions.impossible());
    let mut adam = Adam::new(&network);
    let clip = (options.method == MethodName::LiteralClipped).then_some(KERAS_CLIP);
    let mut losses = Vec::new();
    progress.stage("training on eq. (8)", STEPS as u64);
    let mut batch = Vec::with_capacity(BATCH);
    for step in 0..STEPS {
        batch.clear();
        batch.extend((0..BATCH).map(|_| examples[rng.random_range(0..examples.len())]));
        let rate = if recipe.literal { LITERAL_RATE } else { FIRST_RATE * 0.1f32.powf(step as f32 / STEPS as f32) };
        let loss = network.learn(&batch, clip, rate, &mut adam);
        if (step + 1).is_multiple_of(REPORT_EVERY) {
            losses.push(loss);
            progress.at(step as u64 + 1, &format!("loss {loss:.3}"));
        }
    }
    (network, losses)
}

/// How a method turns areas into volumes, how it adds them up, and the fit where it needs one.
fn volumes(episodes: &[TrainingEpisode], options: &Options, progress: &dyn Progress) -> (Calibration, Estimator, Option<Fit>) {
    match options.method {
        MethodName::Literal | MethodName::LiteralClipped => {
            let calibration = Calibration { hold_above_px2: f32::INFINITY, ..calibration::calibrate(episodes, Some(1.0)) };
            (calibration, Estimator::Sum, None)
        }
        MethodName::Paper if options.estimate == Estimate::Fused => {
            progress.stage("fitting the flow model", 1);
            let fit = fit::fit(episodes);
            let back = WayBack::new(&options.limits, data::rate_hz(episodes));
            (fit.calibration, Estimator::Fused { model: fit.fused, back }, Some(fit))
        }
        _ => (calibration::calibrate(episodes, None), Estimator::Sum, None),
    }
}

/// Trains on usable episodes.
pub fn train(episodes: &[TrainingEpisode], options: &Options, progress: &dyn Progress) -> Trained {
    let (calibration, estimator, fit) = volumes(episodes, options, progress);
    let recipe = Recipe {
        literal: matches!(options.method, MethodName::Literal | MethodName::LiteralClipped),
        actions: Actions::new(options.actions),
        scale: InputScale::default(),
    };
    let examples = examples(&recipe.sequences(episodes, &calibration, &estimator), options.method);
    let (network, loss) = learn(&examples, &recipe, options, progress);
    let weights = Weights {
        network: network.to_mlp().unwrap_or(Mlp::ZERO),
        actions_deg: recipe.actions.angles_deg,
        selection: if options.method == MethodName::Paper { Selection::Expected } else { Selection::Argmax },
        scale: recipe.scale,
        calibration,
        estimator,
        rate_hz: data::rate_hz(episodes) as f32,
        origin: Origin {
            method: match options.method {
                MethodName::Paper => Method::Paper,
                MethodName::Cloning => Method::Cloning,
                _ => Method::Literal,
            },
            actions: options.actions,
            episodes: episodes.len() as u32,
            data_sha256: data::hash(episodes),
            framing: data::framing(episodes),
        },
        seed: options.seed,
    };
    Trained { weights, fit, law: None, search_curve: Vec::new(), loss }
}
