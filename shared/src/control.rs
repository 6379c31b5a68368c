//! Requests to the running controller and its answers: postcard bytes over iceoryx2 request-response.
//!
//! Used by command-line clients and by the controller's ordinary service thread, never by its loop. Allocates.

use serde::{Deserialize, Serialize};

use crate::gaussian_curve::Curve;
use crate::limits::Clipped;
use crate::messages::Phase;

/// What a client asks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Request {
    /// State, rates, counters, histograms and the newest result.
    Status,
    /// Pour `goal_ml`.
    Pour {
        /// Goal volume V_G, ml, > 0.
        goal_ml: f32,
    },
    /// Run the curve of eq. (1) once.
    Record(Curve),
    /// Bring the container upright at once.
    Abort,
}

/// What the controller answers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Reply {
    /// The pour or recording with this number has started.
    Started {
        /// Number of the pour or recording.
        episode: u64,
    },
    /// Upright is being restored.
    Aborting,
    /// Not done, and why.
    Refused {
        /// One line for the operator.
        reason: String,
    },
    /// Answer to [`Request::Status`].
    Status(Box<Status>),
}

/// How a pour or recording ended.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// Number of the pour or recording.
    pub episode: u64,
    /// Why it ended.
    pub reason: EndReason,
    /// Goal volume, ml; `None` for a recording.
    pub goal_ml: Option<f32>,
    /// Estimated volume poured, ml.
    pub poured_ml: f32,
    /// From the start to upright and settled, s.
    pub seconds: f32,
    /// Frames, the bridged ones included.
    pub frames: u32,
    /// Frames that were lost and bridged.
    pub bridged_frames: u32,
    /// Ticks in which no fresh feature was there.
    pub stale_features: u32,
    /// Ticks that woke up late by more than half a period, or were skipped.
    pub late_ticks: u32,
    /// What the limits clipped.
    pub clipped: Clipped,
}

/// Why a pour or recording ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EndReason {
    /// d reached 0, or the curve was run to its end.
    Done,
    /// `abort`.
    Aborted,
    /// The configured number of frames was reached.
    MaxFrames,
    /// Largest tilt, and nothing has flowed.
    ContainerEmpty,
    /// No feature, or none that is beyond doubt, for longer than `controller.stale_feature_ms`.
    StaleFeature,
    /// The feature worker was restarted.
    WorkerRestarted,
    /// The connection to the robot was lost or is half-open.
    RobotLost,
    /// The robot's timestamp stands still.
    RobotStalled,
    /// Protective stop.
    ProtectiveStop,
    /// Emergency stop.
    EmergencyStop,
    /// Another safety mode than normal or reduced.
    SafetyStop,
    /// The program on the robot was stopped.
    ProgramStopped,
    /// The robot is not powered and released.
    RobotNotRunning,
    /// The controller itself was stopped for longer than the robot's patience.
    ControllerOverrun,
    /// The controller is shutting down.
    Shutdown,
    /// The joint did not come upright although nothing hindered it.
    NotUpright,
    /// The pendant's speed slider is below 100 %.
    SpeedReduced,
    /// A stream was seen, and none any more although the container is tilted further.
    StreamLost,
}

impl EndReason {
    /// The reason in words.
    pub fn words(self) -> &'static str {
        match self {
            Self::Done => "done",
            Self::Aborted => "aborted by the operator",
            Self::MaxFrames => "the largest number of frames was reached",
            Self::ContainerEmpty => "the container is empty",
            Self::StaleFeature => "no fresh, usable measurement from the feature worker",
            Self::WorkerRestarted => "the feature worker was restarted",
            Self::RobotLost => "connection to the robot lost",
            Self::RobotStalled => "the robot's clock stands still",
            Self::ProtectiveStop => "protective stop",
            Self::EmergencyStop => "emergency stop",
            Self::SafetyStop => "safety stop",
            Self::ProgramStopped => "the program on the robot was stopped",
            Self::RobotNotRunning => "the robot is not powered and released",
            Self::ControllerOverrun => "the controller was stopped too long",
            Self::Shutdown => "the controller is shutting down",
            Self::NotUpright => "the container did not come upright: look at the robot",
            Self::SpeedReduced => "the speed slider is below 100 %",
            Self::StreamLost => "the container is empty, or its stream is no longer seen: tilted further than when it flowed",
        }
    }
}

/// The controller's state for people and scripts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// What it is doing.
    pub phase: Phase,
    /// Why it cannot pour now; empty if it can.
    pub hindrance: String,
    /// Number of the pour or recording under way; 0 = none.
    pub episode: u64,
    /// Goal volume of the pour under way, ml.
    pub goal_ml: f32,
    /// d, ml.
    pub d_ml: f32,
    /// Estimated volume poured, ml.
    pub poured_ml: f32,
    /// Commanded alpha, degrees.
    pub alpha_deg: f32,
    /// Measured alpha, degrees; NaN without a robot.
    pub alpha_measured_deg: f32,
    /// Newest V_e, px^2; NaN if the newest tick had none.
    pub area_px2: f32,
    /// Camera frame of the newest V_e; 0 before the first.
    pub feature_sequence: u64,
    /// Ticks done.
    pub ticks: u64,
    /// Ticks late by more than half a period.
    pub late_ticks: u64,
    /// Periods skipped.
    pub skipped_ticks: u64,
    /// Features used.
    pub features: u64,
    /// Ticks during pours without a fresh feature.
    pub stale_features: u64,
    /// Lost frames bridged.
    pub bridged_frames: u64,
    /// Features that came twice or out of order, or with another layout.
    pub ignored_features: u64,
    /// What the limits clipped.
    pub clipped: Clipped,
    /// Robot connections made.
    pub robot_connections: u64,
    /// Heap allocations made by the loop since it started.
    pub loop_allocations: u64,
    /// Page faults of the loop since it started.
    pub loop_page_faults: u64,
    /// Events that the loop could not tell, because the ordinary side fell behind.
    pub events_lost: u64,
    /// Identity of the weights in use (first 8 bytes of their hash, hexadecimal); empty without weights.
    pub weights: String,
    /// Weight files taken since the start.
    pub weights_taken: u64,
    /// Why the newest weight file was refused; empty if it was not.
    pub weights_refused: String,
    /// Wake-up lateness, tick execution and feature age.
    pub timing: Vec<Histogram>,
    /// Results of the newest pours and recordings, newest last.
    pub outcomes: Vec<Outcome>,
}

/// A histogram for people, in microseconds.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Histogram {
    /// What was measured.
    pub name: String,
    /// Number of values.
    pub n: u64,
    /// 50th percentile, us.
    pub p50_us: f64,
    /// 99th percentile, us.
    pub p99_us: f64,
    /// 99.9th percentile, us.
    pub p999_us: f64,
    /// Largest value, us.
    pub max_us: f64,
    /// Upper edges (us) and counts of the non-empty bins.
    pub bins: Vec<(f64, u64)>,
}
