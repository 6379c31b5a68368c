//! What pours in an evaluation: trained methods and baselines. Plain data; cannot fail.

use serde::Serialize;
use trainer::training::{Estimate, MethodName};

/// What pours.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Pourer {
    /// Method best with the fused estimate.
    Best,
    /// Method best with the plain sum.
    BestSum,
    /// Eq. (8) repaired, with the fused estimate.
    Paper,
    /// Eq. (8) repaired, with the plain sum.
    PaperSum,
    /// Eq. (8) as printed.
    Literal,
    /// Eq. (8) as printed, with Keras' clip.
    LiteralClipped,
    /// Behaviour cloning.
    Cloning,
    /// A PD on the plain linear sum with first guesses: what a lab would write.
    PdHand,
    /// A PD on the fused estimate, tuned by the same search as the control law.
    PdTuned,
    /// The control law that the network was taught, without the network.
    Law,
    /// Two points: forward below an outflow, back above it.
    BangBang,
    /// Eq. (1) without the camera.
    OpenLoop,
    /// A controller that sees the true state: what control alone can reach.
    Oracle,
}

impl Pourer {
    /// The training that it needs; none for a baseline that is not trained.
    pub fn training(self) -> Option<(MethodName, Estimate)> {
        match self {
            Self::Best | Self::PdTuned | Self::Law => Some((MethodName::Best, Estimate::Fused)),
            Self::BestSum => Some((MethodName::Best, Estimate::Sum)),
            Self::Paper => Some((MethodName::Paper, Estimate::Fused)),
            Self::PaperSum => Some((MethodName::Paper, Estimate::Sum)),
            Self::Literal => Some((MethodName::Literal, Estimate::Sum)),
            Self::LiteralClipped => Some((MethodName::LiteralClipped, Estimate::Sum)),
            Self::Cloning => Some((MethodName::Cloning, Estimate::Sum)),
            Self::PdHand | Self::BangBang | Self::OpenLoop | Self::Oracle => None,
        }
    }

    /// Its name on the command line and in reports.
    pub fn name(self) -> String {
        serde_json::to_value(self).ok().and_then(|v| v.as_str().map(str::to_owned)).unwrap_or_default()
    }
}
