//! Distils a control law into the 1909-parameter network: DAgger inside the fitted model.
//!
//! Pure functions of the offline trainer, which allocate and do not fail; the result is the same on any number of threads. In each round
//! the network pours (in the first, the law does), the law says at every frame what it would have done, and the network learns all that by
//! cross-entropy against the nearest of its actions.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use shared::actions::BACK_DEG_PER_FRAME;
use shared::mlp::{InputScale, Mlp, argmax};

use super::control_law::ControlLaw;
use super::model_pour::{MAX_FRAMES, PossiblePours};
use crate::allowed_actions::Actions;
use crate::network::{Adam, Example, Network, REPORT_EVERY};

/// The part of the learning rate that falls linearly from the first step to 0 at the end. Chosen by hand; no measurement is recorded.
const FIRST_RATE: f32 = 4e-3;
/// The part of the learning rate that stays the same, and is left at the end. Chosen by hand; no measurement is recorded.
const LAST_RATE: f32 = 1e-4;

/// Size of the distillation.
#[derive(Debug, Clone, Copy)]
pub struct Size {
    /// Rounds of DAgger.
    pub rounds: usize,
    /// Pours in a round.
    pub pours: usize,
    /// Adam steps in a round; twice as many in the last.
    pub steps: usize,
    /// Examples of a step.
    pub batch: usize,
}

impl Size {
    /// Adam steps of all rounds.
    pub const fn total_steps(&self) -> usize {
        self.steps * (self.rounds + 1)
    }
}

/// What is distilled, and into what.
pub struct Distillation<'a> {
    /// The pours that may be poured.
    pub pours: &'a PossiblePours,
    /// The teacher.
    pub law: &'a ControlLaw,
    /// The network's actions.
    pub actions: Actions,
    /// How observations become the network's inputs.
    pub scale: InputScale,
    /// How much is poured and learned.
    pub size: Size,
}

impl Distillation<'_> {
    /// One pour by the network if there is one, otherwise by the law; the law labels all its frames.
    fn collect(&self, network: Option<&Mlp>, seed: u64) -> Vec<Example> {
        let mut pour = self.pours.draw(seed);
        let mut examples = Vec::with_capacity(256);
        let mut d_ml = pour.goal_ml;
        let mut back = false;
        for _ in 0..MAX_FRAMES {
            let label = self.law.decide(pour.v_ml, d_ml);
            let x = self.scale.apply(pour.v_ml.map(|v| v as f32), d_ml as f32);
            // The frames of the way back teach what d <= 0 means; a few of them are enough.
            examples.push(Example { x, action: self.actions.discretise(label.unwrap_or(BACK_DEG_PER_FRAME.into())), weight: 1.0 });
            let asked = match network {
                Some(network) => Some(f64::from(self.actions.angles_deg[argmax(&network.forward(&x))])),
                None => label,
            };
            back |= asked.is_none() || (d_ml <= 0.0 && (self.pours.fused || network.is_some()));
            d_ml = pour.frame(asked.filter(|_| !back));
            if pour.over() && d_ml < 1.0 && label.is_none() {
                break;
            }
        }
        examples
    }

    /// The network that does as the law does, and its loss over the steps. `progress` is told the steps done and the loss.
    pub fn run(&self, seed: u64, mut progress: impl FnMut(usize, f64)) -> (Network, Vec<f32>) {
        let Size { rounds, pours, steps, batch: batch_size } = self.size;
        let mut rng = Pcg64Mcg::seed_from_u64(seed ^ 0xd157);
        let mut network = Network::standard(&mut rng);
        let mut adam = Adam::new(&network);
        let mut examples: Vec<Example> = Vec::new();
        let mut losses = Vec::new();
        let mut done = 0usize;
        for round in 0..rounds {
            let mlp = if round > 0 { network.to_mlp() } else { None };
            let base = seed.wrapping_mul(7_368_787).wrapping_add((round * pours) as u64);
            let new: Vec<Vec<Example>> =
                (0..pours as u64).into_par_iter().map(|k| self.collect(mlp.as_ref(), base.wrapping_add(k))).collect();
            examples.extend(new.into_iter().flatten());
            let steps = if round + 1 == rounds { 2 * steps } else { steps };
            let mut batch = Vec::with_capacity(batch_size);
            for _ in 0..steps {
                batch.clear();
                batch.extend((0..batch_size).map(|_| examples[rng.random_range(0..examples.len())]));
                let rate = FIRST_RATE * (1.0 - done as f32 / self.size.total_steps() as f32) + LAST_RATE;
                let loss = network.learn(&batch, None, rate, &mut adam);
                done += 1;
                if done.is_multiple_of(REPORT_EVERY) {
                    losses.push(loss);
                    progress(done, f64::from(loss));
                }
            }
        }
        (network, losses)
    }
}
