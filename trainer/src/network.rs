//! The network while it is trained: fully connected, ReLU, softmax, any layer sizes; trained with Adam.
//!
//! Pure functions of the offline trainer, which allocate and do not fail. The result is the same on any number of threads, because a batch
//! is cut into fixed pieces, whose gradients are added in order.

use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use shared::actions::ACTIONS;
use shared::mlp::{HIDDEN, INPUTS, Mlp};

/// Adam steps between two losses that a training reports.
pub const REPORT_EVERY: usize = 50;
/// Examples of a piece: a batch of 256 keeps four cores busy.
const PIECE: usize = 64;
/// Bias of an output that must never be taken: no logit that is learned comes near it.
const FORBIDDEN_BIAS: f32 = -1e4;
/// Adam's decay of the gradients' mean: the default of its paper (Kingma and Ba, 2015).
const MEAN_DECAY: f32 = 0.9;
/// Adam's decay of the squared gradients' mean: the default of its paper.
const SQUARE_DECAY: f32 = 0.999;
/// What Adam adds to the root that it divides by: the default of its paper.
const EPSILON: f32 = 1e-8;

/// A network: its layer sizes, and its parameters in the order w1, b1, w2, b2, w3, b3; weights are stored `[input][neuron]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Network {
    sizes: [usize; 4],
    parameters: Vec<f32>,
}

/// What the network is to learn in one state: the cross-entropy of one action, with a weight that may be negative (eq. 8).
#[derive(Debug, Clone, Copy)]
pub struct Example {
    /// Scaled inputs.
    pub x: [f32; INPUTS],
    /// Index of the action.
    pub action: u8,
    /// Weight of the action.
    pub weight: f32,
}

/// Adam's state: one mean and one mean square for each parameter.
#[derive(Debug, Clone)]
pub struct Adam {
    mean: Vec<f32>,
    square: Vec<f32>,
    steps: i32,
}

impl Network {
    /// A He-initialised network; its output layer starts small, so that no action is preferred.
    pub fn new(sizes: [usize; 4], rng: &mut Pcg64Mcg) -> Self {
        let mut parameters = Vec::new();
        for l in 0..3 {
            let bound = (6.0 / sizes[l] as f32).sqrt() * if l == 2 { 0.1 } else { 1.0 };
            parameters.extend((0..sizes[l] * sizes[l + 1]).map(|_| rng.random_range(-bound..bound)));
            parameters.extend(std::iter::repeat_n(0.0, sizes[l + 1]));
        }
        Self { sizes, parameters }
    }

    /// The run-time shape, 4-32-32-21.
    pub fn standard(rng: &mut Pcg64Mcg) -> Self {
        Self::new([INPUTS, HIDDEN, HIDDEN, ACTIONS], rng)
    }

    /// Makes outputs impossible, by biases that no training can reach.
    pub fn forbid(&mut self, outputs: impl Iterator<Item = usize>) {
        let biases = self.parameters.len() - self.sizes[3];
        for output in outputs {
            self.parameters[biases + output] = FORBIDDEN_BIAS;
        }
    }

    /// The run-time network, if the shape is the run-time one.
    pub fn to_mlp(&self) -> Option<Mlp> {
        let mut mlp = Mlp::ZERO;
        if self.sizes != [INPUTS, HIDDEN, HIDDEN, ACTIONS] {
            return None;
        }
        for (to, from) in mlp.parameters_mut().zip(&self.parameters) {
            *to = *from;
        }
        Some(mlp)
    }

    /// Logits for one input.
    pub fn logits(&self, x: &[f32; INPUTS]) -> Vec<f32> {
        let mut buffer = Buffer::new(self.sizes);
        self.forward(x, &mut buffer);
        let [.., logits] = buffer.values;
        logits
    }

    /// Where each layer's parameters begin, and where the last ones end.
    fn offsets(&self) -> [usize; 4] {
        let s = self.sizes;
        let one = s[0] * s[1] + s[1];
        let two = one + s[1] * s[2] + s[2];
        [0, one, two, two + s[2] * s[3] + s[3]]
    }

    /// Computes the values of all layers.
    fn forward(&self, x: &[f32; INPUTS], buffer: &mut Buffer) {
        let offsets = self.offsets();
        buffer.values[0].copy_from_slice(x);
        for l in 0..3 {
            let (n, m) = (self.sizes[l], self.sizes[l + 1]);
            let (w, b) = self.parameters[offsets[l]..offsets[l + 1]].split_at(n * m);
            let (before, after) = buffer.values.split_at_mut(l + 1);
            let out = &mut after[0];
            out.copy_from_slice(b);
            for (xi, row) in before[l].iter().zip(w.chunks_exact(m)) {
                if *xi != 0.0 {
                    for (o, wij) in out.iter_mut().zip(row) {
                        *o += xi * wij;
                    }
                }
            }
            if l < 2 {
                for o in out.iter_mut() {
                    *o = o.max(0.0);
                }
            }
        }
    }

    /// Adds the gradient of one example to `gradient`. Returns the example's loss.
    fn backward(&self, example: &Example, clip: Option<f32>, buffer: &mut Buffer, gradient: &mut [f32]) -> f32 {
        self.forward(&example.x, buffer);
        let offsets = self.offsets();
        let loss = loss_and_slopes(example, clip, &buffer.values[3], &mut buffer.slopes[2]);
        for l in (0..3).rev() {
            let (n, m) = (self.sizes[l], self.sizes[l + 1]);
            let w = &self.parameters[offsets[l]..offsets[l] + n * m];
            let (of_weights, of_biases) = gradient[offsets[l]..offsets[l + 1]].split_at_mut(n * m);
            let (lower, upper) = buffer.slopes.split_at_mut(l);
            let slopes = &upper[0];
            for (to, d) in of_biases.iter_mut().zip(slopes) {
                *to += d;
            }
            for (i, xi) in buffer.values[l].iter().enumerate() {
                if *xi == 0.0 {
                    if l > 0 {
                        lower[l - 1][i] = 0.0;
                    }
                    continue;
                }
                for (to, d) in of_weights[i * m..(i + 1) * m].iter_mut().zip(slopes) {
                    *to += xi * d;
                }
                if l > 0 {
                    lower[l - 1][i] = w[i * m..(i + 1) * m].iter().zip(slopes).map(|(w, d)| w * d).sum();
                }
            }
        }
        loss
    }

    /// Takes one Adam step on a batch. Returns the mean loss. With `clip`, the cross-entropy clips probabilities to
    /// `[clip, 1 - clip]`.
    pub fn learn(&mut self, batch: &[Example], clip: Option<f32>, rate: f32, adam: &mut Adam) -> f32 {
        let parts: Vec<(Vec<f32>, f32)> = batch
            .par_chunks(PIECE)
            .map(|piece| {
                let mut buffer = Buffer::new(self.sizes);
                let mut gradient = vec![0.0; self.parameters.len()];
                let loss = piece.iter().map(|e| self.backward(e, clip, &mut buffer, &mut gradient)).sum();
                (gradient, loss)
            })
            .collect();
        adam.steps += 1;
        let (mean_share, square_share) = (1.0 - MEAN_DECAY.powi(adam.steps), 1.0 - SQUARE_DECAY.powi(adam.steps));
        let n = batch.len().max(1) as f32;
        for k in 0..self.parameters.len() {
            let g: f32 = parts.iter().map(|(g, _)| g[k]).sum::<f32>() / n;
            adam.mean[k] = MEAN_DECAY * adam.mean[k] + 0.1 * g;
            adam.square[k] = SQUARE_DECAY * adam.square[k] + 0.001 * g * g;
            self.parameters[k] -= rate * (adam.mean[k] / mean_share) / ((adam.square[k] / square_share).sqrt() + EPSILON);
        }
        parts.iter().map(|(_, loss)| loss).sum::<f32>() / n
    }
}

/// The loss of an example with these logits; writes its slopes in the logits into `slopes`.
fn loss_and_slopes(example: &Example, clip: Option<f32>, logits: &[f32], slopes: &mut [f32]) -> f32 {
    let action = usize::from(example.action);
    let top = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let mut sum = 0.0;
    for (d, l) in slopes.iter_mut().zip(logits) {
        *d = (l - top).exp();
        sum += *d;
    }
    for d in slopes.iter_mut() {
        *d /= sum;
    }
    // The slopes hold the probabilities p now.
    let loss = -example.weight * slopes[action].max(1e-30).ln();
    match clip {
        None => {
            // The gradient of eq. (8): weight (p - I).
            for d in slopes.iter_mut() {
                *d *= example.weight;
            }
            slopes[action] -= example.weight;
        }
        Some(clip) => {
            // Keras clips p inside the logarithm, and terms outside of the clip have no gradient.
            let label = |k: usize, p: f32| (1.0 - example.weight) * p + if k == action { example.weight } else { 0.0 };
            let inside = |p: f32| p > clip && p < 1.0 - clip;
            let total: f32 = slopes.iter().enumerate().filter(|(_, p)| inside(**p)).map(|(k, p)| label(k, *p)).sum();
            for (k, d) in slopes.iter_mut().enumerate() {
                let p = *d;
                *d = p * total - if inside(p) { label(k, p) } else { 0.0 };
            }
        }
    }
    loss
}

impl Adam {
    /// The state before the first step of training `network`.
    pub fn new(network: &Network) -> Self {
        let zeros = vec![0.0; network.parameters.len()];
        Self { mean: zeros.clone(), square: zeros, steps: 0 }
    }
}

/// Room for one pass through a network.
struct Buffer {
    /// Values of the inputs and of the three layers.
    values: [Vec<f32>; 4],
    /// Slopes of the loss in the three layers' values before their ReLU.
    slopes: [Vec<f32>; 3],
}

impl Buffer {
    fn new(s: [usize; 4]) -> Self {
        Self { values: s.map(|n| vec![0.0; n]), slopes: [vec![0.0; s[1]], vec![0.0; s[2]], vec![0.0; s[3]]] }
    }
}
