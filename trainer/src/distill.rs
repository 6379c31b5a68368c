//! Distils a law into the 1909-parameter network: DAgger inside the fitted model.
//!
//! Offline, pure, allocates; deterministic on any number of threads. In each round the network pours (the law does in the
//! first), the law says at every frame what it would have done, and the network learns all that by cross-entropy against
//! the nearest of its actions.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use shared::actions::{ACTIONS, BACK_DEG_PER_FRAME};
use shared::mlp::{InputScale, Mlp, argmax};

use crate::train::discretise;

use crate::law::{Law, MAX_FRAMES, Worlds};
use crate::net::{Adam, Net, Sample};

/// Size of the distillation.
#[derive(Debug, Clone, Copy)]
pub struct Size {
    /// Rounds of DAgger.
    pub rounds: usize,
    /// Pours in a round.
    pub pours: usize,
    /// Adam steps in a round; twice as many in the last.
    pub steps: usize,
    /// Samples of a step.
    pub batch: usize,
}

/// One pour, by `net` if there is one, else by the law; all frames labelled by the law.
fn collect(
    worlds: &Worlds,
    law: &Law,
    net: Option<&Mlp>,
    table: &[f32; ACTIONS],
    actions: u8,
    scale: &InputScale,
    seed: u64,
) -> Vec<Sample> {
    let mut pour = worlds.pour(seed);
    let mut samples = Vec::with_capacity(256);
    let mut d_ml = pour.goal_ml;
    let mut back = false;
    for _ in 0..MAX_FRAMES {
        let label = law.decide(pour.v_ml, d_ml);
        let v = pour.v_ml.map(|v| v as f32);
        let x = scale.apply(v, d_ml as f32);
        // The frames of the way back teach what d <= 0 means, a few of them are enough.
        samples.push(Sample { x, action: discretise(table, actions, label.unwrap_or(BACK_DEG_PER_FRAME.into())), weight: 1.0 });
        let mut asked = match net {
            Some(net) => Some(f64::from(table[argmax(&net.forward(&x))])),
            None => label,
        };
        if d_ml <= 0.0 && (worlds.fused || net.is_some()) {
            back = true;
        }
        if back {
            asked = None;
        }
        back |= asked.is_none();
        d_ml = pour.frame(asked);
        if pour.over() && d_ml < 1.0 && label.is_none() {
            break;
        }
    }
    samples
}

/// The network that does as `law` does, and its loss over the steps.
pub fn distil(
    worlds: &Worlds,
    law: &Law,
    table: &[f32; ACTIONS],
    actions: u8,
    scale: &InputScale,
    size: Size,
    seed: u64,
    mut progress: impl FnMut(usize, f64),
) -> (Net, Vec<f32>) {
    let mut rng = Pcg64Mcg::seed_from_u64(seed ^ 0xd157);
    let mut net = Net::standard(&mut rng);
    let mut adam = Adam::new(&net);
    let mut samples: Vec<Sample> = Vec::new();
    let mut curve = Vec::new();
    let total = size.steps * (size.rounds + 1);
    let mut done = 0usize;
    for round in 0..size.rounds {
        let mlp = if round > 0 { net.to_mlp() } else { None };
        let base = seed.wrapping_mul(7_368_787).wrapping_add((round * size.pours) as u64);
        let new: Vec<Vec<Sample>> = (0..size.pours as u64)
            .into_par_iter()
            .map(|k| collect(worlds, law, mlp.as_ref(), table, actions, scale, base.wrapping_add(k)))
            .collect();
        samples.extend(new.into_iter().flatten());
        let steps = if round + 1 == size.rounds { 2 * size.steps } else { size.steps };
        let mut batch = Vec::with_capacity(size.batch);
        for _ in 0..steps {
            batch.clear();
            batch.extend((0..size.batch).map(|_| samples[rng.random_range(0..samples.len())]));
            let rate = 4e-3 * (1.0 - done as f32 / total as f32) + 1e-4;
            let loss = net.learn(&batch, None, rate, &mut adam);
            done += 1;
            if done.is_multiple_of(50) {
                curve.push(loss);
                progress(done, f64::from(loss));
            }
        }
    }
    (net, curve)
}
