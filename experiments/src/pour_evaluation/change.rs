//! What is different at the test from what the training saw. Plain data; cannot fail.

use crate::bench::eye_fault::EyeFault;
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
    /// Camera gain - 20 %.
    GainLower,
    /// Camera gain + 20 %.
    GainHigher,
    /// Nothing, and somebody has told how much is in the vessel.
    Fill,
    /// Nothing, and somebody has told that a fifth more is in the vessel than is.
    FillMore,
    /// Nothing, and somebody has told that a fifth less is in the vessel than is.
    FillLess,
    /// The camera never sees a stream.
    EyeBlind,
    /// The same, and somebody has told how much is in the vessel.
    EyeBlindFill,
    /// From the first stream on, the camera sees 90 px^2, the same to the bit.
    EyeStuck,
    /// From the first stream on, the camera sees a false one of 150 px^2 that wavers by 5 %.
    EyeWaverThin,
    /// The same with 300 px^2: about a wanted stream.
    EyeWaver,
    /// The same with 600 px^2.
    EyeWaverThick,
    /// The same with 300 px^2, as soon as the container is tilted.
    EyeWaverEarly,
    /// One frame shows 200 to 20,000 px^2.
    EyeSpike,
    /// The camera's gain falls by 30 % within 10 s.
    EyeDriftDown,
    /// The camera's gain rises by 30 % within 10 s.
    EyeDriftUp,
}

impl Change {
    /// The rig with this change.
    pub fn apply(self, mut rig: Rig) -> Rig {
        match self {
            Self::FlowLow => rig.fluidity *= 0.6,
            Self::FlowHigh => rig.fluidity *= 1.5,
            Self::Noise => rig.frame_noise *= 2.0,
            Self::Delay => rig.delay_frames *= 2,
            Self::Dropouts => rig.dropouts = 0.10,
            Self::GainLow => rig.gain *= 0.95,
            Self::GainHigh => rig.gain *= 1.05,
            Self::GainLower => rig.gain *= 0.8,
            Self::GainHigher => rig.gain *= 1.2,
            _ => {}
        }
        rig
    }

    /// How many times what is in the vessel the controller is told; `None` if nobody tells.
    pub fn told_fill(self) -> Option<f64> {
        match self {
            Self::Fill | Self::EyeBlindFill => Some(1.0),
            Self::FillMore => Some(1.2),
            Self::FillLess => Some(0.8),
            _ => None,
        }
    }

    /// The fault that the eye has with this change.
    pub fn eye(self) -> Option<EyeFault> {
        Some(match self {
            Self::EyeBlind | Self::EyeBlindFill => EyeFault::Blind,
            Self::EyeStuck => EyeFault::Stuck,
            Self::EyeWaverThin => EyeFault::Wavering(150.0),
            Self::EyeWaver => EyeFault::Wavering(300.0),
            Self::EyeWaverThick => EyeFault::Wavering(600.0),
            Self::EyeWaverEarly => EyeFault::WaveringEarly(300.0),
            Self::EyeSpike => EyeFault::Spike,
            Self::EyeDriftDown => EyeFault::DriftDown,
            Self::EyeDriftUp => EyeFault::DriftUp,
            _ => return None,
        })
    }
}
