//! What a pour must do about a fault: whether it must end, and with which reasons.
//!
//! Pure; does not allocate; cannot fail.

use shared::control::EndReason;
use simulator::ur::{Fault, SafetyMode};

use crate::weight_set::RATE_HZ;
use crate::what::{EyeFault, What};

/// The least share of the slider that is full speed: its steps are of 0.01, and docs/ROBOT.md promises an end below 100 %.
const FULL_SPEED: f64 = 0.995;
/// For how long measurements come late, s: `DRIFT_FRAMES` of eye.rs.
const LATE_S: f64 = 2.0;
/// The rate of the slowest robot's control cycles: that of a CB3.
const SLOWEST_HZ: f64 = 125.0;

/// How long a fault needs that must end any pour, s, besides what any needs; `None` if it need not.
pub fn must_end(what: &What) -> Option<f64> {
    match what {
        What::Robot(Fault::ProtectiveStop | Fault::SafeguardOpen | Fault::EmergencyStop) => Some(0.0),
        What::Robot(Fault::ProgramPause | Fault::ProgramStop | Fault::Freedrive) => Some(0.0),
        What::Robot(Fault::SafetyMode(mode)) if !mode.lets_move() => Some(0.0),
        What::Robot(Fault::Fin | Fault::Reset | Fault::Boot | Fault::Offline(_)) | What::LinkCut | What::Abort => Some(0.0),
        What::Robot(Fault::SpeedSlider(share)) if *share < FULL_SPEED => Some(0.0),
        What::Robot(Fault::TimeScaling(share)) if *share < 0.9 => Some(0.2),
        What::Robot(Fault::Freeze(s) | Fault::Stall(s) | Fault::SlowReader(s)) if *s > 0.3 => Some(0.0),
        What::LinkStall(ms) if *ms > 300 => Some(f64::from(*ms) / 1000.0),
        What::Suspended(ms) | What::Overrun(ms) if *ms > 200 => Some(f64::from(*ms) / 1000.0),
        What::ControllerKilled(ms) => Some(f64::from(*ms) / 1000.0),
        What::Eye(EyeFault::Killed(ms)) => Some(f64::from(*ms) / 1000.0),
        // So long that one of its measurements comes in spite of lost frames.
        What::Eye(EyeFault::Two(ms)) if *ms > 600 => Some(0.5),
        What::Eye(EyeFault::Hung(ms)) if *ms > 400 => Some(0.0),
        What::Eye(EyeFault::Loss(frames) | EyeFault::Freeze(frames)) if *frames > 10 => Some(0.0),
        // Counted from when its picture was taken, each measurement is then too old.
        What::Eye(EyeFault::Late(ms)) if *ms > 250 => Some(0.0),
        _ => None,
    }
}

/// The reasons that a fault may be reported with.
pub fn reasons(what: &What) -> &'static [EndReason] {
    use EndReason::*;
    match what {
        What::Abort => &[Aborted, NotUpright],
        What::Robot(fault) => match fault {
            Fault::ProtectiveStop => &[ProtectiveStop, NotUpright, ProgramStopped, NotFollowed],
            Fault::SafeguardOpen => &[SafetyStop, NotUpright, ProgramStopped, NotFollowed],
            Fault::EmergencyStop => &[EmergencyStop, ProgramStopped, RobotNotRunning],
            Fault::SafetyMode(_) => &[SafetyStop, EmergencyStop, ProgramStopped, RobotNotRunning],
            Fault::ProgramPause | Fault::ProgramStop | Fault::ProgramResume | Fault::Jog(..) => &[ProgramStopped, NotFollowed],
            Fault::SpeedSlider(_) | Fault::TimeScaling(_) => &[SpeedReduced, NotFollowed, NotUpright, ProgramStopped],
            Fault::HeldBack(_) | Fault::JointSpeedLimit(_) => &[NotFollowed, NotUpright, ProtectiveStop, ProgramStopped],
            Fault::Freedrive | Fault::HandMove(..) => &[InHand, NotFollowed, ProgramStopped],
            Fault::Boot => &[RobotNotRunning, ProgramStopped],
            // These only keep a program from being started, and nobody pours without one.
            Fault::InUse(_) | Fault::LateStart(_) | Fault::LocalControl => &[],
            _ => &[RobotLost, RobotStalled, ProgramStopped, NotFollowed, NotUpright],
        },
        What::LinkStall(_) | What::LinkSplit(_) | What::LinkCut => &[RobotLost, RobotStalled, ProgramStopped, NotFollowed, NotUpright],
        What::Eye(EyeFault::Killed(_) | EyeFault::Two(_)) => &[WorkerRestarted, StaleFeature],
        What::Eye(EyeFault::Loss(_) | EyeFault::Freeze(_) | EyeFault::Late(_) | EyeFault::Hung(_)) => &[StaleFeature],
        // A picture that nobody can measure is no measurement.
        What::Eye(EyeFault::Picture(_)) => &[StaleFeature, FrameRate],
        // Each of these is a measurement, and in time.
        What::Eye(EyeFault::Duplicate(_) | EyeFault::Reorder | EyeFault::GainDrift(_)) => &[],
        What::Eye(EyeFault::FalseZero(_) | EyeFault::Spike(_) | EyeFault::Stuck(_)) => &[],
        What::Overrun(_) | What::Suspended(_) => &[ControllerOverrun, StaleFeature, RobotLost, RobotStalled, ProgramStopped, NotFollowed],
        What::ControllerKilled(_) => &[RobotLost],
        _ => &[],
    }
}

/// Whether the fault is one of the robot that lasts, until it is over or `Clear` ends it.
pub fn lasts(what: &What) -> bool {
    use Fault::*;
    matches!(what, What::Robot(Stall(_) | Freeze(_) | SlowReader(_) | TimeScaling(_) | HeldBack(_) | JointSpeedLimit(_)))
}

/// How long it lasts by itself, s.
pub fn takes_s(what: &What) -> f64 {
    use Fault::{Coalesce, Freeze, Offline, SkipOutputs, SlowReader, Split, Stall};
    let frames_s = |frames: u32| f64::from(frames) / RATE_HZ;
    let ms_s = |ms: u32| f64::from(ms) / 1000.0;
    match what {
        What::Robot(Offline(s) | Stall(s) | Freeze(s) | SlowReader(s) | Coalesce(s) | Split(s)) => *s,
        What::Robot(SkipOutputs(cycles)) => f64::from(*cycles) / SLOWEST_HZ,
        What::LinkStall(ms) | What::LinkSplit(ms) | What::SecondClient(ms) => ms_s(*ms),
        What::Overrun(ms) | What::Suspended(ms) | What::ControllerKilled(ms) => ms_s(*ms),
        What::Eye(fault) => match fault {
            EyeFault::Loss(frames) | EyeFault::Freeze(frames) | EyeFault::Duplicate(frames) => frames_s(*frames),
            EyeFault::FalseZero(frames) | EyeFault::Stuck(frames) => frames_s(*frames),
            EyeFault::Killed(ms) | EyeFault::Hung(ms) | EyeFault::Two(ms) => ms_s(*ms),
            EyeFault::Late(_) => LATE_S,
            EyeFault::GainDrift(_) | EyeFault::Picture(_) => f64::INFINITY,
            EyeFault::Reorder | EyeFault::Spike(_) => 0.0,
        },
        _ => 0.0,
    }
}

/// Whether a person sets `what` right with `remedy`, whichever fault it was meant for.
pub fn remedies(remedy: &Fault, what: &What) -> bool {
    let What::Robot(fault) = what else { return false };
    match remedy {
        Fault::Clear => lasts(what),
        Fault::SpeedSlider(_) => matches!(fault, Fault::SpeedSlider(_)),
        Fault::UnlockProtectiveStop => *fault == Fault::ProtectiveStop,
        Fault::SafeguardClosed => *fault == Fault::SafeguardOpen,
        Fault::FreedriveEnd => *fault == Fault::Freedrive,
        Fault::EmergencyRelease => *fault == Fault::EmergencyStop,
        Fault::SafetyMode(SafetyMode::Normal) => matches!(fault, Fault::SafetyMode(_)),
        Fault::BrakeRelease => *fault == Fault::Boot,
        _ => false,
    }
}

/// Whether no run goes on while it stands, although it began before. What keeps the arm from moving is seen on the robot itself: one safety mode covers
/// another there.
pub fn forbids_runs(what: &What) -> bool {
    use Fault::{Freeze, Offline, SlowReader, SpeedSlider, Stall};
    let stands = match what {
        What::Robot(fault) => matches!(fault, SpeedSlider(_) | Stall(_) | Freeze(_) | SlowReader(_) | Offline(_)),
        what => matches!(what, What::Eye(_) | What::LinkStall(_)),
    };
    stands && must_end(what).is_some()
}

/// Whether a run may take longer to end, or a robot to be taken, because of it: whatever happens to robot, link and controller.
pub fn hinders(what: &What) -> bool {
    !matches!(what, What::Eye(_) | What::Abort | What::Weights(_) | What::BadWeights | What::DiskFull)
}

/// What a fault does to a way upright.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OnWay {
    /// Nothing: it is one of the camera, the operator or the disk, or keeps nothing from moving.
    Nothing,
    /// The robot's program may wait once for as long as its patience, before it goes on by itself.
    Delays,
    /// The arm stands, or is slower than it is commanded.
    Holds,
}

/// What a fault does to a way upright that has begun, or is about to.
pub fn on_way(what: &What) -> OnWay {
    match what {
        What::Robot(Fault::InUse(_) | Fault::LateStart(_) | Fault::LocalControl) => OnWay::Nothing,
        What::Robot(Fault::SpeedSlider(_) | Fault::TimeScaling(_)) => OnWay::Holds,
        What::Robot(_) if leaves_tilted(what) => OnWay::Holds,
        What::Robot(_) | What::LinkStall(_) | What::LinkSplit(_) | What::LinkCut => OnWay::Delays,
        What::Overrun(_) | What::Suspended(_) | What::ControllerKilled(_) => OnWay::Delays,
        _ => OnWay::Nothing,
    }
}

/// Whether a person takes the robot with it, or stops it, so that it must not be taken back unasked.
pub fn takes_robot(what: &What) -> bool {
    let What::Robot(fault) = what else { return false };
    match fault {
        Fault::SafetyMode(mode) => !mode.lets_move(),
        _ => matches!(fault, Fault::ProtectiveStop | Fault::EmergencyStop | Fault::ProgramStop | Fault::Freedrive),
    }
}

/// Whether the program may end tilted because of it, or the arm be kept from coming upright.
pub fn leaves_tilted(what: &What) -> bool {
    let What::Robot(fault) = what else { return false };
    takes_robot(what)
        || matches!(
            fault,
            Fault::ProgramPause
                | Fault::SafeguardOpen
                | Fault::HandMove(..)
                | Fault::Jog(..)
                | Fault::Boot
                | Fault::HeldBack(_)
                | Fault::JointSpeedLimit(_)
        )
}

/// Whether a pour may end so without any fault: by itself, or because of what vessel and stream show.
pub fn is_ordinary(reason: EndReason) -> bool {
    use EndReason::*;
    matches!(reason, Done | ContainerEmpty | StreamLost | MaxFrames | ImpossibleFlow | NothingFlows | GoalExceeded)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the check of reasons from excuses: a fault names only the ends that it can cause. What is a measurement in time ends nothing, lost frames are
    /// no other worker, and what keeps programs from being started ends none that runs.
    #[test]
    fn a_fault_names_only_what_it_can_cause() {
        use EyeFault::{Duplicate, FalseZero, GainDrift, Loss, Reorder, Spike, Stuck};
        for fault in [Duplicate(9), Reorder, Spike(900.0), GainDrift(0.3), Stuck(9), FalseZero(9)] {
            assert!(reasons(&What::Eye(fault)).is_empty(), "{fault:?}");
        }
        assert_eq!(reasons(&What::Eye(Loss(12))), [EndReason::StaleFeature]);
        for fault in [Fault::LocalControl, Fault::InUse("speed_slider_mask".into()), Fault::LateStart(1.0)] {
            assert!(reasons(&What::Robot(fault.clone())).is_empty(), "{fault:?}");
        }
    }
}
