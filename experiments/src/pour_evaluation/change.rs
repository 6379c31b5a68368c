//! What is different at the test from what the training saw. Plain data; cannot fail.

use serde::Serialize;
use simulator::physics::rig::Rig;

/// Something that is different from what the training saw.
#[derive(Debug, Clone, Copy, PartialEq, Eq, clap::ValueEnum, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Change {
    /// Nothing.
    None,
    /// Viscosity: flow x 0.6.
    FlowLow,
    /// Viscosity: flow x 1.5.
    FlowHigh,
    /// Frame noise x 2.
    Noise,
    /// Camera delay x 2.
    Delay,
    /// 10 % of the frames read 0.
    Dropouts,
    /// Camera gain - 5 %.
    GainLow,
    /// Camera gain + 5 %.
    GainHigh,
}

impl Change {
    /// The rig with this change.
    pub fn apply(self, mut rig: Rig) -> Rig {
        match self {
            Self::None => {}
            Self::FlowLow => rig.fluidity *= 0.6,
            Self::FlowHigh => rig.fluidity *= 1.5,
            Self::Noise => rig.frame_noise *= 2.0,
            Self::Delay => rig.delay_frames *= 2,
            Self::Dropouts => rig.dropouts = 0.10,
            Self::GainLow => rig.gain *= 0.95,
            Self::GainHigh => rig.gain *= 1.05,
        }
        rig
    }
}
