//! Requests to the running controller and its answers, which travel as postcard bytes over iceoryx2 request-response; and the reasons for
//! which a pour ends.
//!
//! Command-line clients and the controller's ordinary service thread use it, and it allocates. The loop only uses [`Outcome`] and
//! [`EndReason`], which are plain data. Nothing here can fail.

use serde::{Deserialize, Serialize};

use crate::gaussian_curve::Curve;
use crate::limits::Clipped;
use crate::messages::Phase;

/// Version of the messages of this module: part of the service's name, so that programs of other versions never connect.
pub const CONTROL_VERSION: u32 = 6;

/// What a client asks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Request {
    /// Asks for the state, counters, histograms and newest results.
    Status,
    /// Asks for a pour.
    Pour {
        /// Goal volume V_G, ml, > 0.
        goal_ml: f32,
        /// Tilt by which it must flow, degrees, if it is known how much is in the vessel.
        flows_by_deg: Option<f32>,
    },
    /// Asks to run the curve of eq. (1) once.
    Record(Curve),
    /// Asks to bring the container upright at once.
    Abort,
    /// Asks to take the robot back after a person had it.
    Resume,
}

/// What the controller answers.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub enum Reply {
    /// The pour or recording with this number has started.
    Started {
        /// Number of the pour or recording.
        episode: u64,
    },
    /// The container is coming upright.
    Aborting,
    /// The request is refused.
    Refused {
        /// The reason, one line for the operator.
        reason: String,
    },
    /// Answer to [`Request::Status`].
    Status(Box<Status>),
    /// The robot is being taken back; [`Status::robot`] shows whether that works.
    Resuming,
}

/// Who has the robot.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum RobotLink {
    /// The controller tries to connect it.
    #[default]
    Connecting,
    /// The controller has it, and its program runs.
    Connected,
    /// A person has it, or had it. The controller leaves it alone until the operator asks: `rt-controller resume`, or the next pour or
    /// recording.
    WaitsForOperator,
}

/// How a pour or recording ended.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Outcome {
    /// Number of the pour or recording.
    pub episode: u64,
    /// Why it ended.
    pub reason: EndReason,
    /// Whether liquid may have left that nobody has seen or counted: on the way upright too, whatever the pour ended for.
    pub unseen: bool,
    /// Whether that is because camera, robot or stream were lost, or it still dripped, so that it is not known how it ended. Otherwise the stream left the
    /// region, or none was ever seen.
    pub unwatched: bool,
    /// Goal volume, ml; `None` for a recording.
    pub goal_ml: Option<f32>,
    /// Estimated volume poured, ml.
    pub poured_ml: f32,
    /// Its standard deviation, ml; 0 if it is not known.
    pub poured_sd_ml: f32,
    /// Time from the start until the container was upright and the last drops were counted, s.
    pub seconds: f32,
    /// Number of frames, the bridged ones included.
    pub frames: u32,
    /// Number of frames that were lost and bridged.
    pub bridged_frames: u32,
    /// Number of ticks without a fresh measurement.
    pub stale_features: u32,
    /// Number of gaps: ticks that came more than one and a half periods after the one before. [`Status::late_ticks`] counts late wake-ups.
    pub tick_gaps: u32,
    /// How often each limit changed a request.
    pub clipped: Clipped,
}

/// A volume with its standard deviation, where that is known (above 0), ml.
pub fn volume_words(volume_ml: f32, sd_ml: f32) -> String {
    if sd_ml > 0.0 { format!("{volume_ml:.1} +- {sd_ml:.1}") } else { format!("{volume_ml:.1}") }
}

impl Outcome {
    /// Whether it is done by an estimate whose deviation is larger than what a pour that is done may be off: nobody knows then that it is.
    pub fn is_unsure(&self) -> bool {
        self.reason == EndReason::Done && self.goal_ml.is_some_and(|goal_ml| self.poured_sd_ml > off_ml(goal_ml))
    }

    /// How it ended, in words.
    pub fn words(&self) -> &'static str {
        if self.is_unsure() { UNSURE } else { self.reason.words() }
    }

    /// The volume poured with its standard deviation, where that is known, ml.
    pub fn poured_words(&self) -> String {
        let volume = volume_words(self.poured_ml, self.poured_sd_ml);
        if self.unseen { format!("at least {volume}") } else { volume }
    }
}

/// How a pour ended whose goal was reached by an estimate that is no more sure of it than this ([`Outcome::is_unsure`]).
const UNSURE: &str = "done by an estimate that hardly knows how much was poured: weigh it; vessel, liquid or camera may be others than in the episodes, or these were too few";

/// A pour that ends off its goal by more than so many ml and this share of it, or off a small goal by half, is not done, however large its deviation; a
/// plain sum, which has none, is only looked at for being short. Among the fixed seeds of docs/SWARM.md one that was done was shorter.
const OFF_ML: (f32, f32) = (8.0, 0.08);

/// How far off `goal_ml` a pour that is done may be, ml.
fn off_ml(goal_ml: f32) -> f32 {
    OFF_ML.0.max(OFF_ML.1 * goal_ml).min(goal_ml / 2.0)
}

/// Whether a pour that ends with `d_ml` of `goal_ml` still to pour is too short to be one that is done.
pub fn is_short(d_ml: f32, goal_ml: f32) -> bool {
    d_ml > off_ml(goal_ml)
}

/// Whether a pour that ends with `d_ml` of `goal_ml` still to pour has poured too much to be one that is done.
pub fn is_beyond(d_ml: f32, goal_ml: f32) -> bool {
    -d_ml > off_ml(goal_ml)
}

/// Why a pour or recording ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum EndReason {
    /// The agent has finished, usually because d reached 0; or the curve was run to its end.
    Done,
    /// The operator aborted it.
    Aborted,
    /// The configured number of frames was reached.
    MaxFrames,
    /// Nothing flows any more although the container is tilted as far as it may be.
    ContainerEmpty,
    /// There was no usable measurement for longer than `controller.stale_feature_ms`.
    StaleFeature,
    /// The feature worker was restarted.
    WorkerRestarted,
    /// The connection to the robot was lost or is half-open.
    RobotLost,
    /// The robot's clock stands still.
    RobotStalled,
    /// The robot made a protective stop.
    ProtectiveStop,
    /// The emergency stop was pressed.
    EmergencyStop,
    /// The robot's safety system is in another mode than normal or reduced.
    SafetyStop,
    /// The program on the robot was stopped.
    ProgramStopped,
    /// The robot is not switched on, or its brakes are not released.
    RobotNotRunning,
    /// The controller itself was stopped for longer than the robot's patience.
    ControllerOverrun,
    /// The controller is shutting down.
    Shutdown,
    /// The joint did not come upright, although nothing hindered it.
    NotUpright,
    /// The pendant's speed slider is below 100 %.
    SpeedReduced,
    /// A stream was seen before, and is not seen any more although the container is tilted further, or the agent gave up far short of its goal.
    StreamLost,
    /// The measured tilt does not follow the commanded one: the robot is slower than it is commanded, or something holds or moves it.
    NotFollowed,
    /// Somebody has the robot in hand: the teach button (freedrive) is pressed, which ends the program on the robot.
    InHand,
    /// The camera shows a stream that the container cannot give at its tilt.
    ImpossibleFlow,
    /// The camera never showed a stream, where the told fill or even the emptiest container of the episodes would give one, or at the largest tilt.
    NothingFlows,
    /// The camera's frames do not come at `camera.fps`.
    FrameRate,
    /// The goal seemed reached, and then more left than a pour that is done may have ([`is_beyond`]).
    GoalExceeded,
}

impl EndReason {
    /// All reasons.
    pub fn all() -> impl Iterator<Item = Self> {
        // Postcard numbers the kinds of an enumeration in their order, so that no second list of them can miss one.
        (0..=u8::MAX).map_while(|kind| postcard::from_bytes(&[kind]).ok())
    }

    /// The reason of a run that was ending for `before` when the robot was lost for this one. The first stays, but for done, and where the arm now stands
    /// although the container is not upright: liquid goes on leaving it.
    pub fn after(self, before: Self, is_upright: bool) -> Self {
        if before == Self::Done || (self.stops_the_arm() && !is_upright) { self } else { before }
    }

    /// Whether the arm stands where it is, so that it does not come upright.
    fn stops_the_arm(self) -> bool {
        let stopped = matches!(self, Self::ProtectiveStop | Self::EmergencyStop | Self::SafetyStop | Self::ProgramStopped);
        // The teach button ends the program too.
        stopped || matches!(self, Self::RobotNotRunning | Self::InHand)
    }

    /// Whether liquid may have left that nobody has seen or counted: without a camera, or without a robot whose way upright is known.
    pub fn leaves_unseen(self) -> bool {
        let camera = matches!(self, Self::StaleFeature | Self::WorkerRestarted | Self::FrameRate);
        let link = matches!(self, Self::RobotLost | Self::RobotStalled | Self::ControllerOverrun | Self::SpeedReduced);
        // These end a count that was going on, or say themselves that a stream may not have been seen.
        let unsure = matches!(self, Self::NotUpright | Self::StreamLost | Self::NothingFlows);
        camera || link || unsure || self.stops_the_arm()
    }

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
            Self::StreamLost => "the container is empty, or its stream is no longer seen: what was seen to flow did not reach the goal",
            Self::NotFollowed => "the robot does not follow: it is slower than it is commanded, or something holds or moves it",
            Self::InHand => "somebody has the robot in hand (the teach button is pressed)",
            Self::ImpossibleFlow => {
                "what the camera shows cannot be: the stream does not follow the tilt as in the episodes; the container is nearly empty, the camera sees something else, or vessel or liquid are others"
            }
            Self::FrameRate => "the camera's frames do not come at camera.fps, so the volume is not known",
            Self::GoalExceeded => {
                "far more was poured than the goal: the vessel gave more than was learned of it, or its stream was not seen for a while; look at the camera, and weigh"
            }
            Self::NothingFlows => {
                "nothing is seen to flow at a tilt at which the vessel should: look at the camera, fill the vessel, or say less of what is in it"
            }
        }
    }
}

/// The controller's state for people and scripts.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Status {
    /// What the controller is doing.
    pub phase: Phase,
    /// Why it cannot pour now, one line; empty if it can, and while it moves.
    pub hindrance: String,
    /// Whether a recording can begin now.
    pub may_record: bool,
    /// Number of the pour or recording under way; 0 if there is none.
    pub episode: u64,
    /// Goal volume of the pour under way, ml.
    pub goal_ml: f32,
    /// d, ml.
    pub d_ml: f32,
    /// Estimated volume poured, ml.
    pub poured_ml: f32,
    /// Its standard deviation, ml; 0 if it is not known.
    pub poured_sd_ml: f32,
    /// Commanded alpha, degrees.
    pub alpha_deg: f32,
    /// Measured alpha, degrees; NaN without a robot.
    pub alpha_measured_deg: f32,
    /// V_e in the newest tick, px^2; NaN if that tick had none.
    pub area_px2: f32,
    /// Number of the camera frame of the newest V_e; 0 before the first.
    pub feature_sequence: u64,
    /// Number of ticks done.
    pub ticks: u64,
    /// Number of ticks late by more than half a period.
    pub late_ticks: u64,
    /// Number of periods skipped.
    pub skipped_ticks: u64,
    /// Number of features used.
    pub features: u64,
    /// Number of ticks during pours and recordings without a fresh measurement.
    pub stale_features: u64,
    /// Number of lost frames bridged.
    pub bridged_frames: u64,
    /// Number of features ignored because they came twice, out of order, or from another layout or clock.
    pub ignored_features: u64,
    /// How often each limit changed a request.
    pub clipped: Clipped,
    /// Who has the robot.
    pub robot: RobotLink,
    /// What is doubtful about the robot's settings, one line; empty if nothing is.
    pub robot_warning: String,
    /// Number of times the robot was connected.
    pub robot_connections: u64,
    /// Number of heap allocations of the loop since it started.
    pub loop_allocations: u64,
    /// Number of page faults of the loop since it started.
    pub loop_page_faults: u64,
    /// Number of events that were lost because the ordinary side fell behind the loop.
    pub events_lost: u64,
    /// Identity of the weights in use, 16 hexadecimal digits; empty without weights.
    pub weights: String,
    /// Number of weight files taken since the start.
    pub weights_taken: u64,
    /// Why the newest weight file was refused, one line; empty if it was not.
    pub weights_refused: String,
    /// Age of the weight file that was read last, s; `None` before one was read.
    pub weights_age_s: Option<f64>,
    /// The journal, one line: its file and size, or why nothing is written.
    pub journal: String,
    /// Free space where journal and episodes lie, one line.
    pub space: String,
    /// Version of the controller.
    pub version: String,
    /// Time since the controller's start, s.
    pub uptime_s: f64,
    /// Histograms of the loop's times.
    pub timing: Vec<Histogram>,
    /// Results of the newest pours and recordings, newest last.
    pub outcomes: Vec<Outcome>,
}

/// A histogram as people read it, in microseconds.
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

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    /// Protects whoever takes "done" at its word: where the deviation is larger than what a pour that is done may be off, that is said in its place. A pour
    /// that ended for another reason keeps that one, and a plain sum, which has no deviation, and a recording are just done.
    #[test]
    fn a_pour_that_hardly_knows_its_volume_is_not_just_done() {
        let unsure = |reason, goal_ml, poured_sd_ml| {
            let clipped = Clipped::default();
            let counts = (1, 900, 0, 0, 0);
            let (episode, frames, bridged_frames, stale_features, tick_gaps) = counts;
            let (unseen, unwatched, poured_ml, seconds) = (false, false, 100.0, 9.0);
            let outcome = Outcome {
                episode,
                reason,
                unseen,
                unwatched,
                goal_ml,
                poured_ml,
                poured_sd_ml,
                seconds,
                frames,
                bridged_frames,
                stale_features,
                tick_gaps,
                clipped,
            };
            assert_eq!(outcome.words() == reason.words(), !outcome.is_unsure());
            outcome.is_unsure()
        };
        let done = |goal_ml, sd_ml| unsure(EndReason::Done, Some(goal_ml), sd_ml);
        assert!(done(100.0, 40.0) && done(100.0, 8.1) && done(6.0, 3.1) && done(200.0, 17.0));
        assert!(!done(100.0, 7.9) && !done(6.0, 2.9) && !done(200.0, 15.0) && !done(100.0, 0.0));
        assert!(!unsure(EndReason::GoalExceeded, Some(100.0), 40.0) && !unsure(EndReason::Done, None, 0.0));
    }

    /// Protects who counts by reasons: all are there, each with words of its own.
    #[test]
    fn all_reasons_are_listed() {
        let all: Vec<EndReason> = EndReason::all().collect();
        assert_eq!((all.first(), all.last()), (Some(&EndReason::Done), Some(&EndReason::GoalExceeded)));
        assert_eq!(all.iter().map(|reason| reason.words()).collect::<BTreeSet<_>>().len(), EndReason::GoalExceeded as usize + 1);
    }
}
