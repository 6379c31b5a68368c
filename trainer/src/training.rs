//! What a training is told, and what comes out of it.
//!
//! This is plain data, for any thread. It allocates and does not fail.

use shared::limits::Limits;
use shared::weights::Weights;

use crate::fit::Fit;
use crate::method::control_law::ControlLaw;

/// How d is estimated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Estimate {
    /// The paper's plain sum of the frames' volumes.
    Sum,
    /// Camera and container geometry, fused.
    Fused,
}

/// Training method.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, serde::Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum MethodName {
    /// The paper's section 3.3 as printed: eq. (5)-(8), rewards of either sign.
    Literal,
    /// The same, with the cross-entropy clipping probabilities to [1e-7, 1 - 1e-7], as Keras does silently.
    LiteralClipped,
    /// Eq. (8) repaired: positive weights only, kappa = 1, next-frame action, expected action at run time.
    Paper,
    /// Behaviour cloning, the largest output: eq. (8) with kappa = 1 and the same weight for every frame.
    Cloning,
    /// A flow model is fitted to the episodes, a policy is searched in it, and that is distilled into the network.
    Best,
}

/// What a training is told.
#[derive(Debug, Clone, serde::Serialize)]
pub struct Options {
    /// Method.
    pub method: MethodName,
    /// Number of actions, 2 or 21.
    pub actions: u8,
    /// How d is estimated.
    pub estimate: Estimate,
    /// Seed: the same seed and data give the same weights.
    pub seed: u64,
    /// The controller's limits.
    pub limits: Limits,
}

impl Default for Options {
    fn default() -> Self {
        Self { method: MethodName::Best, actions: 21, estimate: Estimate::Fused, seed: 1, limits: Limits::default() }
    }
}

/// Something that is told how far a training has come.
pub trait Progress: Sync {
    /// A new stage of `steps` steps begins.
    fn stage(&self, _name: &str, _steps: u64) {}
    /// Step `step` is done; `note` says how well it goes.
    fn at(&self, _step: u64, _note: &str) {}
}

/// Drops all that it is told.
pub struct Silent;
impl Progress for Silent {}

/// What came out of a training.
#[derive(Debug, Clone)]
pub struct Trained {
    /// The weights.
    pub weights: Weights,
    /// The fit, where a flow model was fitted.
    pub fit: Option<Fit>,
    /// The control law that was found (method best).
    pub law: Option<ControlLaw>,
    /// Mean cost of the elites after each iteration of the search (method best).
    pub search_curve: Vec<f64>,
    /// Loss of the network every [`crate::network::REPORT_EVERY`] steps of its training.
    pub loss: Vec<f32>,
}
