//! What can happen in a cell: what an operator does, and what goes wrong.
//!
//! Plain data; allocates for names only; cannot fail.

use serde::Serialize;
use shared::gaussian_curve::Curve;
use simulator::camera::faults::FaultKind;
use simulator::ur::{Fault, SafetyMode};

/// What the worker or its camera does wrong.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub enum EyeFault {
    /// This many frames are lost.
    Loss(u32),
    /// The camera repeats its picture for this many frames, and the worker says so.
    Freeze(u32),
    /// Each of this many measurements comes twice.
    Duplicate(u32),
    /// Two measurements come in the wrong order.
    Reorder,
    /// Measurements come later by so many ms, for two seconds.
    Late(u32),
    /// The gain drifts by this share within two seconds.
    GainDrift(f64),
    /// A stream reads 0 without a doubt for this many frames.
    FalseZero(u32),
    /// One frame reads this area, px^2.
    Spike(f32),
    /// The area stands still for this many frames.
    Stuck(u32),
    /// The worker is gone for so many ms and comes back as a new process.
    Killed(u32),
    /// The worker measures nothing for so many ms.
    Hung(u32),
    /// A second worker measures too, for so many ms.
    Two(u32),
    /// The camera's pictures have this fault, from the cell's start to its end (`--eye camera`).
    Picture(FaultKind),
}

/// What the operator enters as an episode's weight.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Weighed {
    /// What the scale shows, to the gram.
    Right,
    /// That, times this factor.
    Mistyped(f64),
    /// That, and so many grams of a cup that was not tared.
    Untared(f64),
}

/// One thing that happens.
#[derive(Debug, Clone, PartialEq)]
pub enum What {
    /// The operator orders a pour of so many ml.
    Pour(f32),
    /// The operator orders the curve of eq. (1): lambda in degrees, width in s.
    Record(f32, f32),
    /// The operator aborts.
    Abort,
    /// The operator asks for the robot.
    Resume,
    /// The vessel is filled again, ml.
    Refill(f64),
    /// Something happens at the robot.
    Robot(Fault),
    /// Nothing arrives at either side for so many ms.
    LinkStall(u32),
    /// What is sent arrives in pieces for so many ms.
    LinkSplit(u32),
    /// All connections are reset.
    LinkCut,
    /// Somebody else connects to the robot for so many ms, wants to write what the controller writes, and never reads.
    SecondClient(u32),
    /// The operator weighs what the newest recording left, and trains again with it.
    Learn(Weighed),
    /// Something happens to the eye.
    Eye(EyeFault),
    /// The loop's next tick is late by so many ms.
    Overrun(u32),
    /// The controller's process stands still for so many ms.
    Suspended(u32),
    /// The controller is killed, and started again after so many ms.
    ControllerKilled(u32),
    /// A good weight file comes: those for the vessel of this number.
    Weights(usize),
    /// A damaged weight file comes.
    BadWeights,
    /// The disk is full from now on.
    DiskFull,
}

impl What {
    /// How long it takes by itself, ms: a curve its own time, everything else none.
    pub fn takes_ms(&self) -> u64 {
        if let Self::Record(lambda_deg, width_s) = self { (1000.0 * curve(*lambda_deg, *width_s).duration_s()) as u64 } else { 0 }
    }

    /// Whether it is a part of the ordinary course, and not a fault.
    pub fn is_ordinary(&self) -> bool {
        matches!(self, Self::Pour(_) | Self::Record(..) | Self::Refill(_) | Self::Resume | Self::Learn(_))
            || matches!(self, Self::Robot(f) if is_remedy(f))
    }

    /// The fault's name in tables.
    pub fn name(&self) -> String {
        let text = match self {
            Self::Robot(fault) => format!("robot {fault}"),
            Self::Eye(fault) => format!("eye {fault:?}"),
            what => format!("{what:?}"),
        };
        text.split(['(', '=']).next().unwrap_or_default().to_lowercase()
    }
}

/// The curve with this largest angle, degrees, and width, s: the standard deviation of eq. (1)'s bell.
pub fn curve(lambda_deg: f32, width_s: f32) -> Curve {
    Curve::from_upright(lambda_deg, 1.0 / (2.0 * width_s * width_s))
}

/// Whether a person sets something right with it.
fn is_remedy(fault: &Fault) -> bool {
    matches!(
        fault,
        Fault::Clear
            | Fault::EmergencyRelease
            | Fault::BrakeRelease
            | Fault::UnlockProtectiveStop
            | Fault::FreedriveEnd
            | Fault::RemoteControl
            | Fault::SafeguardClosed
    ) || matches!(fault, Fault::SpeedSlider(share) if *share >= 1.0)
        || *fault == Fault::SafetyMode(SafetyMode::Normal)
}
