//! The network while it is trained: fully connected, ReLU, softmax, any layer sizes; Adam.
//!
//! Offline, pure, allocates. Deterministic on any number of threads: a batch is cut into fixed pieces whose gradients are
//! added in order.

use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use rayon::prelude::*;
use shared::actions::ACTIONS;
use shared::mlp::{HIDDEN, INPUTS, Mlp};

/// Samples of a piece.
const PIECE: usize = 64;

/// Layer sizes and parameters, in the order w1, b1, w2, b2, w3, b3, weights `[input][neuron]`.
#[derive(Debug, Clone, PartialEq)]
pub struct Net {
    sizes: [usize; 4],
    p: Vec<f32>,
}

/// What the network is to learn in one state: cross-entropy against `target`, a "distribution" whose values may be negative
/// (eq. 8): the gradient on the logits is `sum(target) p - target`.
#[derive(Debug, Clone, Copy)]
pub struct Sample {
    /// Scaled inputs.
    pub x: [f32; INPUTS],
    /// Index of the action.
    pub action: u8,
    /// Weight of the action.
    pub weight: f32,
}

/// Adam's state.
#[derive(Debug, Clone)]
pub struct Adam {
    m: Vec<f32>,
    v: Vec<f32>,
    t: i32,
}

impl Net {
    /// He-initialised; the output layer starts small, so that no action is preferred.
    pub fn new(sizes: [usize; 4], rng: &mut Pcg64Mcg) -> Self {
        let mut p = Vec::new();
        for l in 0..3 {
            let bound = (6.0 / sizes[l] as f32).sqrt() * if l == 2 { 0.1 } else { 1.0 };
            p.extend((0..sizes[l] * sizes[l + 1]).map(|_| rng.random_range(-bound..bound)));
            p.extend(std::iter::repeat_n(0.0, sizes[l + 1]));
        }
        Self { sizes, p }
    }

    /// The run-time shape, 4-32-32-21.
    pub fn standard(rng: &mut Pcg64Mcg) -> Self {
        Self::new([INPUTS, HIDDEN, HIDDEN, ACTIONS], rng)
    }

    /// Makes all actions but these impossible, by biases that no training can reach.
    pub fn keep_only(&mut self, actions: &[usize]) {
        let m = self.sizes[3];
        let from = self.p.len() - m;
        for k in (0..m).filter(|k| !actions.contains(k)) {
            self.p[from + k] = -1e4;
        }
    }

    /// Number of parameters.
    pub fn parameters(&self) -> usize {
        self.p.len()
    }

    /// The run-time network, if the shape is the run-time one.
    pub fn to_mlp(&self) -> Option<Mlp> {
        let mut mlp = Mlp::ZERO;
        if self.sizes != [INPUTS, HIDDEN, HIDDEN, ACTIONS] {
            return None;
        }
        for (to, from) in mlp.parameters_mut().zip(&self.p) {
            *to = *from;
        }
        Some(mlp)
    }

    /// Logits for one input.
    pub fn logits(&self, x: &[f32; INPUTS]) -> Vec<f32> {
        let mut buffer = Buffer::new(self.sizes);
        self.forward(x, &mut buffer);
        buffer.a[3].clone()
    }

    fn offsets(&self) -> [usize; 4] {
        let s = self.sizes;
        let one = s[0] * s[1] + s[1];
        let two = one + s[1] * s[2] + s[2];
        [0, one, two, two + s[2] * s[3] + s[3]]
    }

    fn forward(&self, x: &[f32; INPUTS], buffer: &mut Buffer) {
        let offsets = self.offsets();
        buffer.a[0].copy_from_slice(x);
        for l in 0..3 {
            let (n, m) = (self.sizes[l], self.sizes[l + 1]);
            let (w, b) = self.p[offsets[l]..offsets[l + 1]].split_at(n * m);
            let (before, after) = buffer.a.split_at_mut(l + 1);
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

    /// Adds the gradient of one sample to `gradient`; the loss.
    fn backward(&self, sample: &Sample, clip: Option<f32>, buffer: &mut Buffer, gradient: &mut [f32]) -> f32 {
        self.forward(&sample.x, buffer);
        let offsets = self.offsets();
        let action = usize::from(sample.action);
        let logits = &buffer.a[3];
        let top = logits.iter().copied().fold(f32::NEG_INFINITY, f32::max);
        let delta = &mut buffer.delta[2];
        let mut sum = 0.0;
        for (d, l) in delta.iter_mut().zip(logits) {
            *d = (l - top).exp();
            sum += *d;
        }
        for d in delta.iter_mut() {
            *d /= sum;
        }
        let p_action = delta[action];
        let loss = -sample.weight * p_action.max(1e-30).ln();
        match clip {
            None => {
                // -dY/dlogits of eq. (8): sum(Y) p - Y = weight (p - I).
                for d in delta.iter_mut() {
                    *d *= sample.weight;
                }
                delta[action] -= sample.weight;
            }
            Some(clip) => {
                // Keras clips p to [clip, 1 - clip] inside the logarithm: terms outside have no gradient.
                let label = |k: usize, p: f32| (1.0 - sample.weight) * p + if k == action { sample.weight } else { 0.0 };
                let inside = |p: f32| p > clip && p < 1.0 - clip;
                let total: f32 = delta.iter().enumerate().filter(|(_, p)| inside(**p)).map(|(k, p)| label(k, *p)).sum();
                for (k, d) in delta.iter_mut().enumerate() {
                    let p = *d;
                    *d = p * total - if inside(p) { label(k, p) } else { 0.0 };
                }
            }
        }
        for l in (0..3).rev() {
            let (n, m) = (self.sizes[l], self.sizes[l + 1]);
            let w = &self.p[offsets[l]..offsets[l] + n * m];
            let (g, gb) = gradient[offsets[l]..offsets[l + 1]].split_at_mut(n * m);
            let (lower, upper) = buffer.delta.split_at_mut(l);
            let delta = &upper[0];
            for (to, d) in gb.iter_mut().zip(delta) {
                *to += d;
            }
            for (i, xi) in buffer.a[l].iter().enumerate() {
                if *xi == 0.0 {
                    if l > 0 {
                        lower[l - 1][i] = 0.0;
                    }
                    continue;
                }
                for (to, d) in g[i * m..(i + 1) * m].iter_mut().zip(delta) {
                    *to += xi * d;
                }
                if l > 0 {
                    lower[l - 1][i] = w[i * m..(i + 1) * m].iter().zip(delta).map(|(w, d)| w * d).sum();
                }
            }
        }
        loss
    }

    /// One Adam step on a batch; the mean loss. `clip`: the cross-entropy clips probabilities to `[clip, 1 - clip]`.
    pub fn learn(&mut self, batch: &[Sample], clip: Option<f32>, rate: f32, adam: &mut Adam) -> f32 {
        let parts: Vec<(Vec<f32>, f32)> = batch
            .par_chunks(PIECE)
            .map(|piece| {
                let mut buffer = Buffer::new(self.sizes);
                let mut gradient = vec![0.0; self.p.len()];
                let loss = piece.iter().map(|s| self.backward(s, clip, &mut buffer, &mut gradient)).sum();
                (gradient, loss)
            })
            .collect();
        adam.t += 1;
        let (c1, c2) = (1.0 - 0.9f32.powi(adam.t), 1.0 - 0.999f32.powi(adam.t));
        let n = batch.len().max(1) as f32;
        for k in 0..self.p.len() {
            let g: f32 = parts.iter().map(|(g, _)| g[k]).sum::<f32>() / n;
            adam.m[k] = 0.9 * adam.m[k] + 0.1 * g;
            adam.v[k] = 0.999 * adam.v[k] + 0.001 * g * g;
            self.p[k] -= rate * (adam.m[k] / c1) / ((adam.v[k] / c2).sqrt() + 1e-8);
        }
        parts.iter().map(|(_, loss)| loss).sum::<f32>() / n
    }
}

impl Adam {
    /// At rest, for a network.
    pub fn new(net: &Net) -> Self {
        Self { m: vec![0.0; net.p.len()], v: vec![0.0; net.p.len()], t: 0 }
    }
}

struct Buffer {
    a: [Vec<f32>; 4],
    delta: [Vec<f32>; 3],
}

impl Buffer {
    fn new(s: [usize; 4]) -> Self {
        Self { a: s.map(|n| vec![0.0; n]), delta: [vec![0.0; s[1]], vec![0.0; s[2]], vec![0.0; s[3]]] }
    }
}
