//! What a pour must do about a fault: whether it must end, and with which reasons.
//!
//! Pure; does not allocate; cannot fail.

use shared::control::EndReason;
use simulator::ur::Fault;

use crate::what::{EyeFault, What};

/// How long a fault needs that must end any pour, s, besides what any needs; `None` if it need not.
pub fn must_end(what: &What) -> Option<f64> {
    match what {
        What::Robot(Fault::ProtectiveStop | Fault::SafeguardOpen | Fault::EmergencyStop) => Some(0.0),
        What::Robot(Fault::ProgramPause | Fault::ProgramStop | Fault::Freedrive) => Some(0.0),
        What::Robot(Fault::SafetyMode(mode)) if !mode.lets_move() => Some(0.0),
        What::Robot(Fault::Fin | Fault::Reset | Fault::Boot | Fault::Offline(_)) | What::LinkCut | What::Abort => Some(0.0),
        What::Robot(Fault::SpeedSlider(share)) if *share < 0.9 => Some(0.0),
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
            _ => &[RobotLost, RobotStalled, ProgramStopped, NotFollowed, NotUpright],
        },
        What::LinkStall(_) | What::LinkSplit(_) | What::LinkCut => &[RobotLost, RobotStalled, ProgramStopped, NotFollowed, NotUpright],
        What::Eye(EyeFault::Killed(_) | EyeFault::Two(_)) => &[WorkerRestarted, StaleFeature, FrameRate],
        What::Eye(_) => &[StaleFeature, WorkerRestarted, FrameRate],
        What::Overrun(_) | What::Suspended(_) => &[ControllerOverrun, StaleFeature, RobotLost, RobotStalled, ProgramStopped, NotFollowed],
        What::ControllerKilled(_) => &[RobotLost],
        _ => &[],
    }
}

/// Whether the fault is one of the robot that lasts, until it is over or `Clear` ends it.
pub fn lasts(what: &What) -> bool {
    use Fault::*;
    matches!(what, What::Robot(Stall(_) | Freeze(_) | SlowReader(_) | TimeScaling(_) | SpeedSlider(_) | HeldBack(_) | JointSpeedLimit(_)))
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
