//! Section 4 of the paper: the paper's simulation, its network, its training and its pours.
//!
//! Pure, any thread; allocates; cannot fail. The same arguments give the same numbers. Two actions of +-1 degree, two hidden layers of 40
//! neurons (1922 parameters), one experimental episode (a triangle of +-1 degree a frame), random kappas, eq. (5) to (8) as printed.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use shared::mlp::InputScale;
use simulator::physics::paper::PaperPour;
use trainer::method::policy_gradient::{LAMBDA, reward};
use trainer::network::{Adam, Example, Network};

/// Adam steps between two looks at the network: often enough for a curve, and seldom enough to cost little.
const LOOK_EVERY: usize = 250;
/// Frames of a pour: 30 s, as everywhere.
const FRAMES: usize = 900;
/// Random kappas that are drawn from the one episode. Chosen by hand; the paper gives no number.
pub const KAPPAS: usize = 40;
/// Examples of a batch. Chosen by hand; the paper gives no number.
const BATCH: usize = 256;
/// Area of 1 ml a frame in the paper's simulation, px^2.
const AREA_AT_1_ML_PX2: f64 = 400.0;

/// One training.
pub struct Run {
    /// Mean absolute error in ml at each look, against the Adam step.
    pub curve: Vec<(f64, f64)>,
    /// The pours of the network at the end: goal and poured volume, ml.
    pub pours: Vec<(f64, f64)>,
}

impl Run {
    /// Mean absolute error at the end, ml.
    pub fn last_mae_ml(&self) -> f64 {
        self.curve.last().map_or(f64::NAN, |c| c.1)
    }
}

/// The triangle up to `top` degrees and back, 1 degree a frame, from 300 ml: angles (degrees) and volumes a frame (ml).
pub fn triangle(top: usize) -> (Vec<f64>, Vec<f64>) {
    let alphas: Vec<f64> = (0..=top).chain((0..top).rev()).map(|a| a as f64).collect();
    let mut pour = PaperPour::new(300.0);
    let volumes = alphas.iter().map(|a| f64::from(pour.frame(*a)) / AREA_AT_1_ML_PX2).collect();
    (alphas, volumes)
}

/// Pours `goal_ml` with `net`; returns what was poured, ml.
fn pour_with(net: &Network, scale: &InputScale, init_ml: f64, goal_ml: f64) -> f64 {
    let mut pour = PaperPour::new(init_ml);
    let (mut alpha, mut v) = (0.0f64, [0.0f32; 3]);
    let mut d = goal_ml;
    for _ in 0..FRAMES {
        let logits = net.logits(&scale.apply(v, d as f32));
        alpha = (alpha + if logits[1] > logits[0] { 1.0 } else { -1.0 }).clamp(0.0, 110.0);
        let now = pour.frame(alpha) / AREA_AT_1_ML_PX2 as f32;
        v = [now, v[0], v[1]];
        d -= f64::from(now);
    }
    pour.poured_ml()
}

/// The 24 pours that are judged, as volume in the container and goal, ml.
fn goals() -> impl Iterator<Item = (f64, f64)> {
    [200.0, 300.0, 400.0].into_iter().flat_map(|init| (1..=8).map(move |k| (init, 20.0 * f64::from(k))))
}

/// What the network is trained on: eq. (5) to (7) over [`KAPPAS`] random kappas of the one episode.
fn examples(alphas_deg: &[f64], volumes_ml: &[f64], scale: &InputScale, random: &mut Pcg64Mcg) -> Vec<Example> {
    let weight: f64 = volumes_ml.iter().sum();
    let mut sequences = Vec::new();
    for _ in 0..KAPPAS {
        // Eq. (6): the goal is kappa times the weight; from there d falls by each volume.
        let mut d = random.random_range(0.5..1.5) * weight;
        let mut states = Vec::new();
        for i in 1..volumes_ml.len() {
            let at = |k: usize| i.checked_sub(k).map_or(0.0, |j| volumes_ml[j]) as f32;
            // As printed, state i holds d_i, from which v_i has yet to be taken.
            states.push((scale.apply([at(0), at(1), at(2)], d as f32), u8::from(alphas_deg[i] > alphas_deg[i - 1])));
            d -= volumes_ml[i];
        }
        sequences.push((states, reward(d)));
    }
    // Eq. (7): rewards are normalised over the sequences.
    let n = sequences.len() as f64;
    let mean = sequences.iter().map(|s| s.1).sum::<f64>() / n;
    let sd = (sequences.iter().map(|s| (s.1 - mean).powi(2)).sum::<f64>() / n).sqrt().max(1e-9);
    sequences
        .iter()
        .flat_map(|(states, r)| {
            let weight = (LAMBDA * (r - mean) / sd) as f32;
            states.iter().map(move |(x, action)| Example { x: *x, action: *action, weight })
        })
        .collect()
}

/// Trains once on the triangle up to `top` degrees, with or without a clip of p, and judges the network.
pub fn run_once(top: usize, clip: Option<f32>, steps: usize, seed: u64) -> Run {
    let (alphas, volumes) = triangle(top);
    let scale = InputScale::default();
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let examples = examples(&alphas, &volumes, &scale, &mut random);
    let mut net = Network::new([4, 40, 40, 2], &mut random);
    let mut adam = Adam::new(&net);
    let look = |net: &Network| -> Vec<(f64, f64)> { goals().map(|(init, goal)| (goal, pour_with(net, &scale, init, goal))).collect() };
    let mae = |pours: &[(f64, f64)]| pours.iter().map(|(g, p)| (p - g).abs()).sum::<f64>() / pours.len() as f64;
    let mut pours = look(&net);
    let mut curve = vec![(0.0, mae(&pours))];
    for step in 1..=steps {
        let batch: Vec<Example> = (0..BATCH).map(|_| examples[random.random_range(0..examples.len())]).collect();
        net.learn(&batch, clip, 1e-3, &mut adam);
        if step % LOOK_EVERY == 0 {
            pours = look(&net);
            curve.push((step as f64, mae(&pours)));
        }
    }
    Run { curve, pours }
}
