//! When and why a pour or recording ends: every rule, in one small state that the core asks.
//!
//! It is pure and runs in the controller's loop; it does not allocate, panic or fail. An ending has three steps. A rule names a reason
//! while the container is tilted ([`Ending::due`]); the container then comes upright ([`is_commanded_upright`]); the last drops are counted
//! ([`Ending::settled`]). Reasons that do not come from a rule, such as an operator's abort or a robot that may not move, are given to
//! [`Ending::end_with`] or [`Ending::end_instead_of_done`]. The first reason other than `Done` stays, unless the arm is then held tilted, or the joint does not come
//! upright.
//!
//! | rule | reason |
//! |---|---|
//! | [`Ending::agent_is_done`]: the goal is reached, or the agent has tilted back or stood still after a flow | `Done` |
//! | the curve of a recording was run to its end | `Done` |
//! | the newest usable measurement is too old | `StaleFeature` |
//! | the largest number of frames is reached | `MaxFrames` |
//! | nothing flows at the largest tilt, where a stream was seen before | `ContainerEmpty` |
//! | the same, where none was ever seen: the container is empty, or the camera sees nothing | `NothingFlows` |
//! | nothing was ever seen to flow, beyond the tilt at which the given fill would | `NothingFlows` |
//! | a stream was seen before, and is not seen any more although the container is tilted further | `StreamLost` |
//! | the measured tilt does not follow the commanded one, on the way out or back ([`super::following`]) | `NotFollowed` |
//! | what the camera shows cannot be, by what was learned of vessel and flow | `ImpossibleFlow`, `NothingFlows` |
//! | [`controller_overran`]: the controller itself was stopped | `ControllerOverrun` |
//! | [`worker_was_restarted`]: measurements come from another process | `WorkerRestarted` |
//! | the camera's frames come at another rate (`frame_rate.rs`) | `FrameRate` |
//! | [`Ending::settled`]: the joint did not come upright | `NotUpright` |
//! | the same: the goal seemed reached, and then too much of it is missing, or was poured | `StreamLost`, `GoalExceeded` |
//! | the same: a stream without a pause goes on although the joint has long been upright | `ImpossibleFlow` |

use shared::agent::Decision;
use shared::control::{EndReason, is_beyond, is_short};
use shared::episode::CUT_OFF_MAX;
use shared::estimator::verdict::Impossible;
use shared::messages::Feature;

use super::settings::Settings;

/// After flow was seen, this much of a way back without flow ends the pour, degrees. Chosen by hand; no measurement is recorded.
const BROUGHT_BACK_DEG: f32 = 10.0;
/// After flow was seen, this long without progress ends the pour, s. The agent then stands still short of its goal, while the trickle is too
/// small to be seen, or flickers at the edge of what can be seen. Chosen by hand; no measurement is recorded.
const STALLED_S: f64 = 3.0;
/// Forward tilt that counts as progress, degrees. Chosen by hand; no measurement is recorded.
const PROGRESS_DEG: f32 = 1.0;
/// Poured volume that counts as progress, ml. Chosen by hand; no measurement is recorded.
const PROGRESS_ML: f32 = 0.5;
/// If less than this is still to come over the lip, ml, it counts as nothing: this is about one drop of water.
const NOTHING_ML: f64 = 0.05;
/// After this many frames in a row with a stream, the tilt of the stream is remembered. None of 10,800 simulated pours ended by mistake
/// with this and the three constants below; see docs/LEARNING.md.
const STREAM_FRAMES: u32 = 5;
/// Only after this poured volume can a stream be lost, ml: a bead that is taken for a stream gives less. See docs/LEARNING.md.
const STREAM_ML: f32 = 1.0;
/// Time without a stream after which it may be lost, s: longer than the pauses of a bottle that gurgles. Ten frames at 30 Hz; see
/// docs/LEARNING.md.
const STREAM_LOST_S: f64 = 1.0 / 3.0;
/// Tilt beyond that of the stream at which it counts as lost, degrees: what flows at one tilt flows more at a larger one. See
/// docs/LEARNING.md.
const STREAM_LOST_DEG: f32 = 10.0;
/// Within this of the largest alpha the container counts as tilted as far as it goes, degrees. Chosen by hand; no measurement is
/// recorded.
const LARGEST_TILT_SLACK_DEG: f32 = 0.5;
/// A commanded alpha nearer to 0 than this is upright, degrees. Chosen by hand: far below what a robot can resolve.
const COMMANDED_UPRIGHT_DEG: f32 = 0.01;
/// Time of measured frames without flow after which the last drops are counted, and of a stream without a pause that is no dripping, s. Chosen by
/// hand; no measurement is recorded.
const SETTLE_QUIET_S: f64 = 0.5;
/// The least way upright that counts as coming nearer, degrees. A joint that is slower than this in [`SETTLE_MAX_S`], 0.33 degrees/s, is held.
/// Chosen by hand; no measurement is recorded.
const COMING_DEG: f32 = 1.0;
/// The longest wait for the last drops, and for a joint that comes no nearer to upright, s. Chosen by hand; no measurement is recorded.
const SETTLE_MAX_S: f64 = 3.0;

/// Number of frames in a row with a stream from which on one was seen: a lone flash is none.
const SEEN_FRAMES: u32 = 2;
/// Time without any flow at a tilt at which the vessel must flow, s: longer than a joint follows its command late. Ten frames at 30 Hz, chosen by
/// hand.
const DRY_S: f64 = 1.0 / 3.0;

/// What one frame showed during a pour.
#[derive(Debug, Clone, Copy)]
pub struct SeenFrame {
    /// Number of frames lost just before it.
    pub lost: u32,
    /// V_e, px^2; `None` if it could not be measured.
    pub area_px2: Option<f32>,
    /// Whether that area is a lower bound, because the stream leaves the region.
    pub cut_off: bool,
    /// Whether the agent sees liquid leave the container.
    pub flowing: bool,
    /// Commanded alpha when the picture was taken, degrees.
    pub alpha_deg: f32,
    /// Commanded alpha now, degrees.
    pub alpha_now_deg: f32,
}

/// What the rules look at in each tick.
#[derive(Debug, Clone, Copy)]
pub struct Moment {
    /// Time since the pour or recording began, s.
    pub running_s: f64,
    /// Number of frames since then, the lost ones included.
    pub frames: u32,
    /// Age of the newest usable measurement, ns.
    pub measurement_age_ns: u64,
    /// Commanded alpha, degrees.
    pub alpha_deg: f32,
    /// Estimated volume poured, ml.
    pub poured_ml: f32,
    /// Whether the joint follows what is commanded.
    pub follows: bool,
}

/// How far a pour or recording is from its end.
#[derive(Debug, Clone, Copy)]
pub struct Ending {
    /// Tilt by which it must flow, degrees, if it is known how much is in the vessel.
    flows_by_deg: Option<f32>,
    /// Number of frames beyond that tilt, in a pour in which nothing was ever seen to flow.
    dry_frames: u32,
    /// Length of a recording's curve, s; `None` in a pour.
    curve_s: Option<f64>,
    reason: EndReason,
    /// Whether camera or robot were lost, or it still dripped, so that liquid may have left that nobody has seen or counted, for whatever reason the pour ends.
    unwatched: bool,
    /// Sum of the areas that were measured, and of those among them that are lower bounds, px^2.
    area_px2: f64,
    cut_off_px2: f64,
    agent_is_done: bool,
    /// The reason for which the pour is not done as it stands, if it is not.
    not_done: Option<EndReason>,
    /// What the camera sees cannot be.
    impossible: Option<Impossible>,
    seen_flow: bool,
    /// Whether a stream was seen in more than a lone frame.
    seen_stream: bool,
    brought_back_deg: f32,
    stalled_frames: u32,
    advanced_deg: f32,
    advanced_from_ml: f32,
    /// Number of measured frames in a row without flow.
    quiet_frames: u32,
    empty_frames: u32,
    /// Number of frames in a row with a stream.
    stream_frames: u32,
    /// Number of frames in a row without a stream.
    no_stream_frames: u32,
    /// Largest tilt at which a stream was seen, degrees.
    stream_deg: Option<f32>,
    /// The tilt at which the joint was last seen to have come nearer to upright, degrees, and when, s after it began to settle.
    nearest: (f32, f64),
}

impl Ending {
    /// The ending of a pour that begins now.
    pub fn of_pour() -> Self {
        Self {
            flows_by_deg: None,
            dry_frames: 0,
            curve_s: None,
            reason: EndReason::Done,
            unwatched: false,
            area_px2: 0.0,
            cut_off_px2: 0.0,
            agent_is_done: false,
            not_done: None,
            impossible: None,
            seen_flow: false,
            seen_stream: false,
            brought_back_deg: 0.0,
            stalled_frames: 0,
            advanced_deg: 0.0,
            advanced_from_ml: 0.0,
            quiet_frames: 0,
            empty_frames: 0,
            stream_frames: 0,
            no_stream_frames: 0,
            stream_deg: None,
            nearest: (f32::INFINITY, 0.0),
        }
    }

    /// The ending of a pour from a vessel that must flow by a tilt, degrees.
    pub fn of_pour_that_flows_by(flows_by_deg: Option<f32>) -> Self {
        Self { flows_by_deg, ..Self::of_pour() }
    }

    /// The ending of a recording whose curve takes `curve_s` seconds.
    pub fn of_recording(curve_s: f64) -> Self {
        Self { curve_s: Some(curve_s), ..Self::of_pour() }
    }

    /// Why the pour or recording ends; [`EndReason::Done`] as long as no other reason was given.
    pub fn reason(&self) -> EndReason {
        self.reason
    }

    /// Gives the reason of the end; call it once, when the container begins to come upright.
    pub fn end_with(&mut self, reason: EndReason) {
        self.unwatched |= reason.leaves_unseen();
        self.reason = reason;
    }

    /// Gives a reason for which a pour is not done although its goal seemed reached: the robot may not move any more, or the camera no longer
    /// shows what leaves. A pour that was already ending for another reason keeps that one.
    pub fn end_instead_of_done(&mut self, reason: EndReason) {
        self.unwatched |= reason.leaves_unseen();
        if self.reason == EndReason::Done {
            self.reason = reason;
        }
    }

    /// Gives the reason of the end when the robot may not move any more, for `reason`. Out of an upright container only the last drops leave.
    pub fn without_robot(&mut self, reason: EndReason, is_upright: bool, settings: &Settings) -> EndReason {
        self.unwatched |= reason.leaves_unseen() && !is_upright;
        self.looks_away(settings);
        reason.after(self.reason, is_upright)
    }

    /// Takes that nobody looks at an upright container from now on: drops that may still fall are not counted.
    pub fn looks_away(&mut self, settings: &Settings) {
        self.unwatched |= self.curve_s.is_none() && !self.is_quiet(settings);
    }

    /// Whether nothing has flowed for so long that the last drops have fallen.
    fn is_quiet(&self, settings: &Settings) -> bool {
        self.quiet_frames >= settings.frames(SETTLE_QUIET_S)
    }

    /// Whether nobody could watch camera and container to the end, if it ends for `reason`. An abort does not bring back what a lost camera hid.
    pub fn leaves_unwatched(&self, reason: EndReason) -> bool {
        self.unwatched || reason.leaves_unseen()
    }

    /// Whether liquid may have left that nobody has seen or counted, if it ends for `reason`. What leaves the region does not come back: a pour of which so
    /// much was seen that a file of it would not be trained is a lower bound. And where a pour ends, at whatever moment, that never showed a stream,
    /// nobody knows that there was none.
    pub fn leaves_unseen(&self, reason: EndReason) -> bool {
        let cut_off = self.cut_off_px2 > CUT_OFF_MAX * self.area_px2;
        let any_time = matches!(reason, EndReason::MaxFrames | EndReason::Aborted | EndReason::Shutdown | EndReason::NotFollowed);
        let blind = any_time && self.curve_s.is_none() && !self.seen_stream;
        self.leaves_unwatched(reason) || cut_off || blind
    }

    /// Takes whether the joint follows on its way upright, and why the camera does not tell what leaves there, if so; and looks at what was seen
    /// meanwhile. The way of a slower robot is waited for, but more was then poured than was foreseen when it began, so such a pour is not done.
    pub fn returns(&mut self, follows: bool, blind: Option<EndReason>) {
        if let Some(reason) = blind.or((!follows).then_some(EndReason::NotFollowed)) {
            self.end_instead_of_done(reason);
        }
        // A stream that goes on at an upright container was none before either.
        if let Some(impossible) = self.impossible {
            self.end_instead_of_done(reason_of(impossible));
        }
    }

    /// Whether the agent has finished; once true, it stays true.
    pub fn agent_is_done(&self) -> bool {
        self.agent_is_done
    }

    /// Takes the agent's decision for one frame, lost or not, and returns [`Ending::agent_is_done`].
    pub fn decided(&mut self, decision: &Decision, settings: &Settings) -> bool {
        self.impossible = self.impossible.or(decision.impossible);
        self.not_done = not_done(decision);
        self.agent_is_done |= goal_is_reached(decision);
        self.seen_flow |= decision.flowing;
        self.agent_is_done |= self.is_brought_back(decision);
        self.agent_is_done |= self.stands_still(decision, settings);
        self.agent_is_done
    }

    /// Whether the container was brought back so far without any flow that the pour is over, although d is still above 0: the agent then
    /// stopped a little early.
    fn is_brought_back(&mut self, decision: &Decision) -> bool {
        let forward = decision.flowing || decision.dalpha_deg > 0.0;
        self.brought_back_deg = if forward { 0.0 } else { self.brought_back_deg - decision.dalpha_deg };
        self.seen_flow && self.brought_back_deg > BROUGHT_BACK_DEG
    }

    /// Whether the agent has made no progress for so long, neither in tilt nor in volume, that it would stand there for ever.
    fn stands_still(&mut self, decision: &Decision, settings: &Settings) -> bool {
        self.advanced_deg += decision.dalpha_deg;
        if self.advanced_deg >= PROGRESS_DEG || decision.poured_ml - self.advanced_from_ml >= PROGRESS_ML {
            (self.stalled_frames, self.advanced_deg, self.advanced_from_ml) = (0, 0.0, decision.poured_ml);
        } else {
            self.stalled_frames = self.stalled_frames.saturating_add(1);
        }
        self.seen_flow && self.stalled_frames >= settings.frames(STALLED_S)
    }

    /// Takes what a frame showed during a pour.
    pub fn saw(&mut self, frame: &SeenFrame, settings: &Settings) {
        let frames = frame.lost + 1;
        let area_px2 = frame.area_px2.map_or(0.0, f64::from);
        self.area_px2 += area_px2;
        self.cut_off_px2 += if frame.cut_off { area_px2 } else { 0.0 };
        // A frame that could not be measured does not say that nothing fell.
        self.quiet_frames = if frame.flowing { 0 } else { self.quiet_frames + u32::from(frame.area_px2.is_some()) };
        if frame.area_px2.is_some_and(|area_px2| area_px2 > 0.0) {
            (self.stream_frames, self.no_stream_frames) = (self.stream_frames + 1, 0);
            if self.stream_frames >= STREAM_FRAMES {
                self.stream_deg = Some(self.stream_deg.map_or(frame.alpha_deg, |deg| deg.max(frame.alpha_deg)));
            }
        } else {
            (self.stream_frames, self.no_stream_frames) = (0, self.no_stream_frames + frames);
        }
        self.seen_stream |= self.stream_frames >= SEEN_FRAMES;
        let dry = !self.seen_stream && self.flows_by_deg.is_some_and(|deg| frame.alpha_deg > deg);
        self.dry_frames = if dry && !frame.flowing { self.dry_frames + frames } else { 0 };
        let at_largest_tilt = frame.alpha_now_deg >= settings.limits.alpha_max_deg - LARGEST_TILT_SLACK_DEG;
        self.empty_frames = if at_largest_tilt && !frame.flowing { self.empty_frames + frames } else { 0 };
    }

    /// The reason to end now, if there is one. Ask it in every tick while the container is tilted.
    pub fn due(&self, moment: &Moment, settings: &Settings) -> Option<EndReason> {
        if !moment.follows {
            return Some(EndReason::NotFollowed);
        }
        if moment.measurement_age_ns > settings.stale_ns {
            return Some(EndReason::StaleFeature);
        }
        match self.curve_s {
            Some(curve_s) => (moment.running_s >= curve_s).then_some(EndReason::Done),
            // What cannot be is no reason to believe that the goal was reached.
            None if self.impossible.is_some() => self.impossible.map(reason_of),
            None if self.agent_is_done => Some(EndReason::Done),
            None if moment.frames >= settings.max_frames => Some(EndReason::MaxFrames),
            None if self.dry_frames >= settings.frames(DRY_S) => Some(EndReason::NothingFlows),
            // An empty container and a camera that sees nothing look alike.
            None if self.empty_frames >= settings.empty_frames && !self.seen_stream => Some(EndReason::NothingFlows),
            None if self.empty_frames >= settings.empty_frames => Some(EndReason::ContainerEmpty),
            None if self.stream_is_lost(moment, settings) => Some(EndReason::StreamLost),
            None => None,
        }
    }

    /// Whether the stream is lost. What flows at one tilt flows faster at a larger one, so a stream that is gone there has ended, or is no
    /// longer seen.
    fn stream_is_lost(&self, moment: &Moment, settings: &Settings) -> bool {
        moment.poured_ml >= STREAM_ML
            && self.no_stream_frames >= settings.frames(STREAM_LOST_S)
            && self.stream_deg.is_some_and(|deg| moment.alpha_deg > deg + STREAM_LOST_DEG)
    }

    /// Begins the wait for the last drops, when the container has been commanded upright.
    pub fn begin_settling(&mut self) {
        self.quiet_frames = 0;
    }

    /// The final reason, once the last drops are counted: the joint is upright and nothing has flowed for a while, or the wait took
    /// too long. `alpha_deg` is the measured one, because the joint must really be upright.
    pub fn settled(&mut self, alpha_deg: f32, settling_s: f64, shutdown: bool, settings: &Settings) -> Option<EndReason> {
        let upright = alpha_deg.abs() <= settings.upright_deg;
        let (is_pour, wait_frames) = (self.curve_s.is_none(), settings.frames(SETTLE_QUIET_S));
        let quiet = self.is_quiet(settings) && is_pour;
        if alpha_deg.abs() < self.nearest.0 - COMING_DEG {
            self.nearest = (alpha_deg.abs(), settling_s);
        }
        // A slow robot is waited for as long as it comes nearer.
        let over = settling_s >= SETTLE_MAX_S && (upright || settling_s - self.nearest.1 >= SETTLE_MAX_S);
        if !over && !(upright && (quiet || shutdown)) {
            return None;
        }
        // What drips on, or may do so unseen, is not counted any more.
        self.unwatched |= is_pour && !quiet;
        Some(match self.reason {
            _ if !upright => EndReason::NotUpright,
            // Out of an upright container nothing pours: the eye takes something else for a stream, and has done so before.
            EndReason::Done if is_pour && over && self.stream_frames >= wait_frames => EndReason::ImpossibleFlow,
            EndReason::Done if is_pour => self.not_done.unwrap_or(EndReason::Done),
            reason => reason,
        })
    }
}

/// Whether the goal is reached: d, less what is still on its way, is 0 or less, and nothing more comes over the lip.
fn goal_is_reached(decision: &Decision) -> bool {
    decision.tilting_back && decision.over_lip_ml < NOTHING_ML
}

/// The reason instead of done, if the goal is missed by so much. An estimate without a deviation foresees nothing that could surprise it.
fn not_done(decision: &Decision) -> Option<EndReason> {
    let (d_ml, goal_ml) = (decision.d_ml, decision.d_ml + decision.poured_ml);
    let has_exceeded = decision.poured_sd_ml > 0.0 && is_beyond(d_ml, goal_ml);
    is_short(d_ml, goal_ml).then_some(EndReason::StreamLost).or(has_exceeded.then_some(EndReason::GoalExceeded))
}

/// The reason for what cannot be.
fn reason_of(impossible: Impossible) -> EndReason {
    match impossible {
        Impossible::Flow => EndReason::ImpossibleFlow,
        Impossible::NoFlow => EndReason::NothingFlows,
    }
}

/// Whether the controller slept so long that the robot's program has gone upright by itself; `last_tick_ns` is 0 before the first tick.
pub fn controller_overran(now_ns: u64, last_tick_ns: u64, settings: &Settings) -> bool {
    last_tick_ns != 0 && now_ns.saturating_sub(last_tick_ns) > settings.patience_ns
}

/// Whether a measurement comes from another process than the one that measured when the pour or recording began.
pub fn worker_was_restarted(feature: &Feature, worker_epoch_ns: u64) -> bool {
    feature.worker_epoch_ns != worker_epoch_ns
}

/// Whether the commanded alpha is upright.
pub fn is_commanded_upright(alpha_deg: f32) -> bool {
    alpha_deg.abs() < COMMANDED_UPRIGHT_DEG
}

#[cfg(test)]
mod tests;
