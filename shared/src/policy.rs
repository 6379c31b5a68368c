//! The policy pi: (v_t, v_t-1, v_t-2, d) -> one of 21 relative angles (section 3.3.2), a 4-32-32-21 network.
//!
//! Runs in the controller's loop: fixed size, no allocation, no panic. The action table is Fig. 5's:
//! `alpha_i = 5 sign(i) (i/10)^2` degrees, i = -10..10.

/// Inputs of the network: v_t, v_t-1, v_t-2, d.
pub const INPUTS: usize = 4;
/// Neurons in each of the two hidden layers.
pub const HIDDEN: usize = 32;
/// Actions, i = -10..=10.
pub const ACTIONS: usize = 21;

/// The 4-32-32-21 multilayer perceptron, ReLU in both hidden layers; 1909 parameters, f32.
#[derive(Debug, Clone, PartialEq)]
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
