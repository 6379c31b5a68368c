//! What an operator may order, when an order is acceptable, and why it is refused otherwise.
//!
//! It is pure and runs in the controller's loop, so it does not allocate. Only showing a [`Refusal`] as text, which the service thread
//! does, writes into the caller's buffer. Nothing fails: what is not acceptable is a refusal.

use serde::{Deserialize, Serialize};
use shared::control::EndReason;
use shared::framing::Difference;
use shared::gaussian_curve::Curve;
use shared::messages::Phase;

use super::following;
use super::robot::Robot;
use super::settings::Settings;

/// What an operator orders.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Order {
    /// Pour a goal volume: d <- V_G (eq. 4).
    Pour {
        /// Number of the pour.
        episode: u64,
        /// Goal volume V_G, ml.
        goal_ml: f32,
        /// Tilt by which it must flow, degrees, if it is known how much is in the vessel.
        flows_by_deg: Option<f32>,
    },
    /// Run the curve of eq. (1) once.
    Record {
        /// Number of the recording.
        episode: u64,
        /// The curve.
        curve: Curve,
    },
    /// Bring the container upright at once.
    Abort,
    /// Bring the container upright and take no more orders.
    Shutdown,
}

impl Order {
    /// Number of the pour or recording that is ordered; 0 if it is none.
    pub fn episode(&self) -> u64 {
        match self {
            Self::Pour { episode, .. } | Self::Record { episode, .. } => *episode,
            Self::Abort | Self::Shutdown => 0,
        }
    }
}

/// Why an order is refused.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Refusal {
    /// A pour or recording is under way.
    Busy,
    /// The robot may not move, for this reason.
    Robot(EndReason),
    /// The robot slows itself to this share of its speed.
    Slowed(f32),
    /// The container is not upright; this is the measured alpha, degrees.
    NotUpright(f32),
    /// There is no fresh, usable measurement.
    NoFeature,
    /// The camera gives this many frames a second, and the second number is the configured one.
    FrameRate(f32, f32),
    /// The weights were trained on other pictures.
    Framing(Difference),
    /// No valid weights are loaded.
    NoWeights,
    /// The goal is not a number from `LEAST_GOAL_ML` up to this, ml.
    Goal(f32),
    /// The curve leaves the limits.
    Curve,
    /// The controller is shutting down.
    Shutdown,
    /// The motion was stopped before the order's turn came.
    Stopped,
}

impl Refusal {
    /// Whether a recording would be refused for it as well: what only a pour needs does not hinder it.
    pub fn hinders_recording(&self) -> bool {
        !matches!(self, Self::NoWeights | Self::Framing(_) | Self::Goal(_))
    }
}

impl std::fmt::Display for Refusal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Busy => write!(f, "a pour or recording is under way: wait for it, or `rt-controller abort`"),
            Self::Robot(reason) => write!(f, "the robot may not move: {}", reason.words()),
            Self::Slowed(share) => write!(
                f,
                "the robot slows itself to {:.0} % of its speed (speed_scaling): look for speed limits of the safety configuration, reduced \
                 mode, or a wrong payload; a slow robot cannot stop a stream in time",
                share * 100.0
            ),
            Self::NotUpright(deg) => write!(f, "the container is tilted by {deg:.0} degrees: bring it upright at the robot's pendant"),
            Self::NoFeature => {
                write!(
                    f,
                    "there is no fresh, usable measurement: check that `feature-worker run` is running and what it says of the camera"
                )
            }
            Self::FrameRate(hz, configured_hz) => write!(
                f,
                "the camera gives {hz:.1} frames a second, and camera.fps is {configured_hz:.1}: every volume would be wrong; set the camera, or \
                 camera.fps and train anew (low light makes some cameras slower)"
            ),
            Self::Framing(difference) => write!(
                f,
                "the weights were trained on {difference}, as the cell has it: an area may be another volume there; record and train with this picture, or \
                 set [camera] and [image] as they were"
            ),
            Self::NoWeights => write!(f, "no valid weight file is loaded: train one, or see `rt-controller status`"),
            Self::Goal(max) => write!(f, "the goal must be {LEAST_GOAL_ML} to {max} ml (controller.goal_max_ml)"),
            Self::Curve => write!(f, "the curve leaves [limits]: choose a smaller lambda or gamma, and a beta of 0.5 to 60 s"),
            Self::Shutdown => write!(f, "the controller is shutting down"),
            Self::Stopped => write!(f, "an abort came before this order's turn: give it again"),
        }
    }
}

/// The situation in which an order comes.
#[derive(Debug, Clone, Copy)]
pub struct Situation {
    /// What the controller is doing.
    pub phase: Phase,
    /// The robot's newest state.
    pub robot: Robot,
    /// Whether the controller is shutting down.
    pub shutdown: bool,
    /// Age of the newest usable measurement, ns.
    pub measurement_age_ns: u64,
    /// The camera's rate and the configured one, frames/s, if they differ.
    pub wrong_rate_hz: Option<(f32, f32)>,
}

impl Situation {
    /// Whether a pour or recording may begin now: the robot may move, the container is upright, nothing is under way, and the newest usable
    /// measurement is fresh.
    pub fn may_begin(&self, settings: &Settings) -> Result<(), Refusal> {
        if self.shutdown {
            return Err(Refusal::Shutdown);
        }
        if let Some(reason) = self.robot.hindrance {
            return Err(Refusal::Robot(reason));
        }
        match self.phase {
            Phase::Idle => {}
            Phase::NoRobot => return Err(Refusal::NotUpright(self.robot.alpha_deg)),
            _ => return Err(Refusal::Busy),
        }
        if self.robot.alpha_deg.is_nan() || self.robot.alpha_deg.abs() > settings.upright_deg {
            return Err(Refusal::NotUpright(self.robot.alpha_deg));
        }
        if let Some(share) = self.robot.speed_scaling.filter(|_| following::is_slowed(&self.robot)) {
            return Err(Refusal::Slowed(share));
        }
        if self.measurement_age_ns > settings.stale_ns {
            return Err(Refusal::NoFeature);
        }
        self.wrong_rate_hz.map_or(Ok(()), |(hz, configured_hz)| Err(Refusal::FrameRate(hz, configured_hz)))
    }

    /// Whether an abort can be obeyed: the robot can be moved at all.
    pub fn may_abort(&self) -> Result<(), Refusal> {
        match (self.robot.hindrance, self.phase) {
            (Some(reason), _) => Err(Refusal::Robot(reason)),
            (None, Phase::NoRobot) => Err(Refusal::NotUpright(self.robot.alpha_deg)),
            (None, _) => Ok(()),
        }
    }
}

/// The least goal, ml: two drops. Chosen by hand: no stream and no scale of a kitchen tells less.
const LEAST_GOAL_ML: f32 = 0.1;

/// Whether `goal_ml` is a goal that may be poured.
pub fn goal_is_legal(goal_ml: f32, settings: &Settings) -> Result<(), Refusal> {
    if goal_ml >= LEAST_GOAL_ML && goal_ml <= settings.goal_max_ml { Ok(()) } else { Err(Refusal::Goal(settings.goal_max_ml)) }
}

/// Whether `curve` keeps the limits, so that it is run exactly as given.
pub fn curve_is_legal(curve: &Curve, settings: &Settings) -> Result<(), Refusal> {
    if curve.fits(&settings.limits, settings.period_ns) { Ok(()) } else { Err(Refusal::Curve) }
}
