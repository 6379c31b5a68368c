//! The network of the paper's policy pi (section 3.3.2): a 4-32-32-21 multilayer perceptron that maps the three newest outflows
//! and the missing volume d to one logit for each action.
//!
//! It runs in the controller's loop: its size is fixed, and it does not allocate or panic. Nothing here can fail: inputs that are not
//! finite give the action "stay" through [`argmax`] and [`softmax`].

use serde::{Deserialize, Serialize};

use crate::actions::{ACTIONS, STAY};

/// Inputs of the network: v_t, v_t-1, v_t-2 and d (section 3.3.2).
pub const INPUTS: usize = 4;
/// Neurons in each of the two hidden layers. With 32 the network has 1909 parameters; the paper has 2000 (section 4).
pub const HIDDEN: usize = 32;
/// Number of parameters of [`Mlp`].
pub const PARAMETERS: usize = INPUTS * HIDDEN + HIDDEN + HIDDEN * HIDDEN + HIDDEN + HIDDEN * ACTIONS + ACTIONS;

/// The 4-32-32-21 multilayer perceptron with ReLU in both hidden layers; 1909 parameters, f32.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Mlp {
    /// Weights of layer 1, `[input][neuron]`.
    pub w1: [[f32; HIDDEN]; INPUTS],
    /// Biases of layer 1.
    pub b1: [f32; HIDDEN],
    /// Weights of layer 2, `[input][neuron]`.
    pub w2: [[f32; HIDDEN]; HIDDEN],
    /// Biases of layer 2.
    pub b2: [f32; HIDDEN],
    /// Weights of the output layer, `[input][action]`.
    pub w3: [[f32; ACTIONS]; HIDDEN],
    /// Biases of the output layer.
    pub b3: [f32; ACTIONS],
}

impl Mlp {
    /// A network whose parameters are all 0.
    pub const ZERO: Self = Self {
        w1: [[0.0; HIDDEN]; INPUTS],
        b1: [0.0; HIDDEN],
        w2: [[0.0; HIDDEN]; HIDDEN],
        b2: [0.0; HIDDEN],
        w3: [[0.0; ACTIONS]; HIDDEN],
        b3: [0.0; ACTIONS],
    };

    /// Logits of the 21 actions for scaled inputs ([`InputScale::apply`]). They cost about 1800 multiply-adds.
    ///
    /// On a processor with AVX2 and FMA the wide form runs, on others [`Mlp::forward_portable`]. The wide form rounds each multiply-add
    /// once, the other one twice. So the logits differ in their last bits, and the action only where two are equally good.
    pub fn forward(&self, x: &[f32; INPUTS]) -> [f32; ACTIONS] {
        #[cfg(target_arch = "x86_64")]
        if let Some(cpu) = pulp::x86::V3::try_new() {
            return cpu.vectorize(wide::Forward(cpu, self, x));
        }
        self.forward_portable(x)
    }

    /// [`Mlp::forward`] as every processor can run it.
    pub fn forward_portable(&self, x: &[f32; INPUTS]) -> [f32; ACTIONS] {
        let h1 = layer(&self.w1, &self.b1, x).map(|s| s.max(0.0));
        let h2 = layer(&self.w2, &self.b2, &h1).map(|s| s.max(0.0));
        layer(&self.w3, &self.b3, &h2)
    }

    /// All parameters in the order w1, b1, w2, b2, w3, b3.
    pub fn parameters(&self) -> impl Iterator<Item = &f32> {
        let Self { w1, b1, w2, b2, w3, b3 } = self;
        w1.as_flattened().iter().chain(b1).chain(w2.as_flattened()).chain(b2).chain(w3.as_flattened()).chain(b3)
    }

    /// The same parameters, to be written.
    pub fn parameters_mut(&mut self) -> impl Iterator<Item = &mut f32> {
        let Self { w1, b1, w2, b2, w3, b3 } = self;
        let front = w1.as_flattened_mut().iter_mut().chain(b1).chain(w2.as_flattened_mut()).chain(b2);
        front.chain(w3.as_flattened_mut()).chain(b3)
    }
}

/// One layer. It sums input by input, so that the compiler works on all neurons of the layer at once.
fn layer<const N: usize, const M: usize>(w: &[[f32; M]; N], b: &[f32; M], x: &[f32; N]) -> [f32; M] {
    let mut sum = *b;
    for (row, xi) in w.iter().zip(x) {
        for (s, wij) in sum.iter_mut().zip(row) {
            *s += xi * wij;
        }
    }
    sum
}

/// The forward pass on eight neurons at once. It is written out because the compiler does not turn the plain loop into fused
/// multiply-adds; compiled for AVX2, that loop takes half as long again.
#[cfg(target_arch = "x86_64")]
mod wide {
    use std::array::from_fn;

    use pulp::{cast, f32x8, x86::V3};

    use super::{ACTIONS, INPUTS, Mlp};

    /// How many f32 one register of AVX2 holds.
    const LANES: usize = 8;

    /// The function that [`V3::vectorize`] compiles for these processors. Everything that it calls must be inlined, or it is not compiled
    /// for them.
    pub struct Forward<'a>(pub V3, pub &'a Mlp, pub &'a [f32; INPUTS]);

    impl pulp::NullaryFnOnce for Forward<'_> {
        type Output = [f32; ACTIONS];

        #[inline(always)]
        fn call(self) -> Self::Output {
            let Self(cpu, net, x) = self;
            let relu = |sums: f32x8| cpu.max_f32x8(sums, cpu.splat_f32x8(0.0));
            let h1 = layer::<4, _, _>(cpu, &net.w1, &net.b1, x, relu);
            let h2 = layer::<4, _, _>(cpu, &net.w2, &net.b2, &h1, relu);
            layer::<3, _, _>(cpu, &net.w3, &net.b3, &h2, |sums| sums)
        }
    }

    /// One layer of M neurons in `BLOCKS` registers, which is M / 8, rounded up. If M is no multiple of eight, the last register overlaps
    /// the one before. N must be even.
    ///
    /// Even and odd inputs are summed apart, because a fused multiply-add waits four cycles for the one before it: the processor can begin
    /// two in each cycle, but one chain for each register would keep only half of them busy.
    #[inline(always)]
    fn layer<const BLOCKS: usize, const N: usize, const M: usize>(
        cpu: V3,
        w: &[[f32; M]; N],
        b: &[f32; M],
        x: &[f32; N],
        activation: impl Fn(f32x8) -> f32x8,
    ) -> [f32; M] {
        const { assert!(N.is_multiple_of(2) && M >= LANES && BLOCKS == M.div_ceil(LANES)) };
        let first = |block: usize| (block * LANES).min(M - LANES);
        // Read as one piece: lane by lane, the compiler sometimes made a register of the last layer from the one before it, with a third more instructions.
        let load =
            |row: &[f32; M], block: usize| -> f32x8 { cast(row[first(block)..].first_chunk::<LANES>().copied().unwrap_or_default()) };
        let mut even: [f32x8; BLOCKS] = from_fn(|block| load(b, block));
        let mut odd = [cpu.splat_f32x8(0.0); BLOCKS];
        for (rows, xs) in w.as_chunks::<2>().0.iter().zip(x.as_chunks::<2>().0) {
            let xs = xs.map(|xi| cpu.splat_f32x8(xi));
            for block in 0..BLOCKS {
                even[block] = cpu.mul_add_f32x8(xs[0], load(&rows[0], block), even[block]);
                odd[block] = cpu.mul_add_f32x8(xs[1], load(&rows[1], block), odd[block]);
            }
        }
        let sums: [f32x8; BLOCKS] = from_fn(|block| cpu.add_f32x8(even[block], odd[block]));
        let mut out = [0.0; M];
        for (block, sum) in sums.into_iter().enumerate() {
            let sum: [f32; LANES] = cast(activation(sum));
            out[first(block)..first(block) + LANES].copy_from_slice(&sum);
        }
        out
    }
}

/// How the four observations enter the network: `[asinh(5 v_t), asinh(5 v_t-1), asinh(5 v_t-2), asinh(d/4)] / 2`.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct InputScale {
    /// Factor of v before asinh, frames/ml; 5 by default. Chosen by hand; no measurement is recorded.
    pub v_per_ml: f32,
    /// Divisor of d before asinh, ml; 4 by default. Chosen by hand; no measurement is recorded.
    pub d_ml: f32,
    /// Factor after asinh; 0.5 by default. Chosen by hand; no measurement is recorded.
    pub gain: f32,
}

impl Default for InputScale {
    fn default() -> Self {
        Self { v_per_ml: 5.0, d_ml: 4.0, gain: 0.5 }
    }
}

impl InputScale {
    /// Scaled inputs from v_t, v_t-1, v_t-2 (ml a frame) and d (ml).
    pub fn apply(&self, v_ml: [f32; 3], d_ml: f32) -> [f32; INPUTS] {
        let v = v_ml.map(|v| asinh(v * self.v_per_ml) * self.gain);
        [v[0], v[1], v[2], asinh(d_ml / self.d_ml) * self.gain]
    }
}

/// asinh without the standard library's care for tiny arguments, which would cost more than the whole first layer.
fn asinh(x: f32) -> f32 {
    let a = x.abs();
    (a + (a * a + 1.0).sqrt()).ln().copysign(x)
}

/// The action with the largest logit; "stay" if none is a number.
pub fn argmax(logits: &[f32; ACTIONS]) -> usize {
    let mut best = STAY;
    for (k, l) in logits.iter().enumerate() {
        if *l > logits[best] || (logits[best].is_nan() && !l.is_nan()) {
            best = k;
        }
    }
    best
}

/// Softmax of the logits; all weight on "stay" if they are not finite.
pub fn softmax(logits: &[f32; ACTIONS]) -> [f32; ACTIONS] {
    let top = logits.iter().fold(f32::NEG_INFINITY, |m, l| m.max(*l));
    let mut p = logits.map(|l| (l - top).exp());
    let sum: f32 = p.iter().sum();
    if !(sum.is_finite() && sum > 0.0) {
        p = [0.0; ACTIONS];
        p[STAY] = 1.0;
        return p;
    }
    p.map(|e| e / sum)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the paper's shape: two hidden layers and about 2000 parameters, here exactly 1909.
    #[test]
    fn the_network_has_1909_parameters() {
        assert_eq!(PARAMETERS, 1909);
        assert_eq!(Mlp::ZERO.parameters().count(), PARAMETERS);
    }

    /// Protects the forward pass: an independent, plain evaluation over the flat parameter list gives the same logits.
    #[test]
    fn forward_agrees_with_a_plain_evaluation() {
        let mut net = Mlp::ZERO;
        for (k, p) in net.parameters_mut().enumerate() {
            *p = ((k as f32 * 0.37).sin() + 0.1) * 0.4;
        }
        let x = [0.3, -0.2, 0.9, 1.4];
        let flat: Vec<f64> = net.parameters().map(|p| f64::from(*p)).collect();
        let dense = |w: &[f64], b: &[f64], x: &[f64]| -> Vec<f64> {
            (0..b.len()).map(|j| b[j] + x.iter().enumerate().map(|(i, xi)| xi * w[i * b.len() + j]).sum::<f64>()).collect()
        };
        let relu = |v: Vec<f64>| -> Vec<f64> { v.into_iter().map(|s| s.max(0.0)).collect() };
        let (w1, rest) = flat.split_at(128);
        let (b1, rest) = rest.split_at(32);
        let (w2, rest) = rest.split_at(1024);
        let (b2, rest) = rest.split_at(32);
        let (w3, b3) = rest.split_at(672);
        let h = relu(dense(w1, b1, &x.map(f64::from)));
        let h = relu(dense(w2, b2, &h));
        let want = dense(w3, b3, &h);
        for (a, b) in net.forward(&x).iter().zip(&want) {
            assert!((f64::from(*a) - b).abs() < 1e-4, "{a} {b}");
        }
    }

    /// Protects the action from the processor it is chosen on: for random networks and inputs, the form chosen at run time and
    /// the portable one agree except in their last bits, and choose the same action unless two logits are that close.
    #[test]
    fn both_forms_give_the_same_action() {
        use rand::{RngExt, SeedableRng};
        let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(7);
        let mut same = 0;
        for _ in 0..200 {
            let mut net = Mlp::ZERO;
            net.parameters_mut().for_each(|p| *p = random.random_range(-0.5..0.5));
            for _ in 0..100 {
                let x: [f32; INPUTS] = std::array::from_fn(|_| random.random_range(-3.0..3.0));
                let (chosen, portable) = (net.forward(&x), net.forward_portable(&x));
                for (a, b) in chosen.iter().zip(&portable) {
                    assert!((a - b).abs() < 1e-4, "{a} {b}");
                }
                let (i, j) = (argmax(&chosen), argmax(&portable));
                assert!(i == j || (portable[i] - portable[j]).abs() < 2e-5, "actions {i} and {j}");
                same += usize::from(i == j);
            }
        }
        assert!(same >= 19_990, "{same} of 20000");
    }

    /// Protects the robot from an undefined action: logits that are not numbers give "stay".
    #[test]
    fn non_finite_logits_mean_stay() {
        assert_eq!(argmax(&[f32::NAN; ACTIONS]), STAY);
        assert_eq!(softmax(&[f32::NAN; ACTIONS])[STAY], 1.0);
        let mut one = [f32::NAN; ACTIONS];
        one[3] = -7.0;
        assert_eq!(argmax(&one), 3);
    }

    /// Protects the input scaling against its formula.
    #[test]
    fn inputs_are_scaled_by_asinh() {
        let x = InputScale::default().apply([0.0, 0.2, 1.0], -40.0);
        let want = [0.0, 1f64.asinh() / 2.0, 5f64.asinh() / 2.0, (-10f64).asinh() / 2.0];
        for (a, b) in x.iter().zip(want) {
            assert!((f64::from(*a) - b).abs() < 1e-6);
        }
    }
}
