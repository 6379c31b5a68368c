//! What decides: one pure step a tick, shared to the letter by the running controller, replay, tests and closed-loop evaluation.
//!
//! [`Core::step`] maps what is known at a tick ([`Input`]) to the angle to command and to what happened ([`Output`]). It has no
//! clock and no device, does not allocate or lock, and does not fail: whatever is in doubt ends with the container upright.
//!
//! ```text
//!            robot well          goal                 d <= 0, doubt, abort           upright          flow has ceased
//!  NoRobot ------------> Idle ---------> Pouring ---------------------> Returning ---------> Settling ---------------> Idle
//!     ^                   | curve                                           ^
//!     |                   +------------> Recording -------------------------+ curve at its end, doubt, abort
//!     +---- any phase, when the robot may not move
//! ```

use serde::{Deserialize, Serialize};
use shared::agent::{Agent, Decision, Observation};
use shared::alpha_track::AngleHistory;
use shared::control::{EndReason, Outcome};
use shared::gaussian_curve::Curve;
use shared::limits::{Clipped, Limiter, Limits};
use shared::messages::{Doubt, Feature, LAYOUT_VERSION, Phase, Telemetry};

use crate::link::program::patience_s;

/// Most features that one tick takes, the newest ones: the loop would have to be late by a quarter of a second for more.
pub const MAX_FEATURES: usize = 8;
/// Most lost frames that are bridged at once: what is longer is stale.
const MAX_BRIDGED: u64 = 30;
/// Frames without flow after which the last drops are counted.
const SETTLE_QUIET_FRAMES: u32 = 15;
/// Longest wait for the last drops, s.
const SETTLE_MAX_S: f64 = 3.0;
/// A feature older than this many periods counts its tick as stale.
const STALE_TICK_PERIODS: u64 = 3;

/// What flows flows the more the further it is tilted. Frames in a row with a stream from which on its tilt is remembered.
const STREAM_FRAMES: u32 = 5;
/// After this volume, ml (a bead is less),
const STREAM_ML: f32 = 1.0;
/// this many frames in a row without a stream (a bottle's gurgling is shorter),
const STREAM_LOST_FRAMES: u32 = 10;
/// at a tilt larger by this than the stream's largest, degrees: the container is empty, or the camera no longer sees its stream.
const STREAM_LOST_DEG: f32 = 10.0;

/// The part of the configuration that decisions depend on.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Settings {
    /// Period of a tick, ns.
    pub period_ns: u64,
    /// Limits on alpha.
    pub limits: Limits,
    /// A pour ends when the newest feature is older, ns.
    pub stale_ns: u64,
    /// A pour ends after this many frames.
    pub max_frames: u32,
    /// Frames without flow at the largest tilt after which the container is empty (one that has poured is found out before).
    pub empty_frames: u32,
    /// Largest goal, ml.
    pub goal_max_ml: f32,
    /// A measured alpha within this of upright counts as upright, degrees.
    pub upright_deg: f32,
    /// After this long without us the robot's program goes upright by itself, ns; then so do we.
    pub patience_ns: u64,
}

impl Settings {
    /// From the cell's configuration.
    pub fn new(config: &shared::config::Config) -> Self {
        let controller = &config.controller;
        Self {
            period_ns: (1e9 / controller.rate_hz) as u64,
            limits: config.limits,
            stale_ns: u64::from(controller.stale_feature_ms) * 1_000_000,
            max_frames: controller.max_frames,
            empty_frames: controller.empty_frames,
            goal_max_ml: controller.goal_max_ml,
            upright_deg: config.robot.start_tolerance_deg as f32,
            patience_ns: (patience_s(controller.rate_hz) * 1e9) as u64,
        }
    }
}

/// What an operator orders.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub enum Order {
    /// d <- V_G (eq. 4).
    Pour {
        /// Number of the pour.
        episode: u64,
        /// V_G, ml.
        goal_ml: f32,
    },
    /// Run the curve of eq. (1).
    Record {
        /// Number of the recording.
        episode: u64,
        /// The curve.
        curve: Curve,
    },
    /// Upright at once.
    Abort,
    /// Upright, and no more orders.
    Shutdown,
}

/// Why an order is refused.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Refusal {
    /// A pour or recording is under way.
    Busy,
    /// The robot may not move.
    Robot(EndReason),
    /// The container is not upright, at this measured alpha in degrees.
    NotUpright(f32),
    /// No fresh measurement.
    NoFeature,
    /// No valid weights are loaded.
    NoWeights,
    /// The goal is not a number above 0 and up to this, ml.
    Goal(f32),
    /// The curve leaves the limits.
    Curve,
    /// The controller is shutting down.
    Shutdown,
}

impl std::fmt::Display for Refusal {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Busy => write!(f, "a pour or recording is under way: wait for it, or `rt-controller abort`"),
            Self::Robot(reason) => write!(f, "the robot may not move: {}", reason.words()),
            Self::NotUpright(deg) => write!(f, "the container is tilted by {deg:.0} degrees: bring it upright at the robot's pendant"),
            Self::NoFeature => {
                write!(
                    f,
                    "no fresh, usable measurement: is `feature-worker run` running, does the camera deliver, what does the worker say?"
                )
            }
            Self::NoWeights => write!(f, "no valid weight file is loaded: train one, or see `rt-controller status`"),
            Self::Goal(max) => write!(f, "the goal must be above 0 and at most {max} ml (controller.goal_max_ml)"),
            Self::Curve => write!(f, "the curve leaves [limits]: choose a smaller lambda or gamma, and a beta of 0.5 to 60 s"),
            Self::Shutdown => write!(f, "the controller is shutting down"),
        }
    }
}

/// The robot as the core sees it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Robot {
    /// Why it may not move; `None`: it may.
    pub hindrance: Option<EndReason>,
    /// Measured alpha, degrees; NaN before the first state.
    pub alpha_deg: f32,
    /// When that arrived, ns.
    pub at_ns: u64,
}

/// Everything that a step depends on, besides the core's own state.
#[derive(Debug, Clone, Copy)]
pub struct Input<'a> {
    /// When the tick woke up, ns.
    pub now_ns: u64,
    /// Features that arrived since the last tick, oldest first.
    pub features: &'a [Feature],
    /// The robot's newest state.
    pub robot: Robot,
    /// An operator's order, if there is one.
    pub order: Option<Order>,
}

/// What a step decided, and what happened in it.
#[derive(Debug, Clone, Copy)]
pub struct Output {
    /// Alpha to command, degrees: within all limits. `None`: command nothing, the robot may not move.
    pub target_deg: Option<f32>,
    /// The answer to the order of this tick.
    pub ordered: Option<Result<(), Refusal>>,
    /// The pour or recording that ended in this tick.
    pub ended: Option<Outcome>,
    /// What an episode records of this tick; whoever brought the agent knows its [`Telemetry::weights_id`].
    pub telemetry: Telemetry,
}

/// Counters since the start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct Counters {
    /// Ticks done.
    pub ticks: u64,
    /// Features used.
    pub features: u64,
    /// Ticks during pours whose newest measurement was stale.
    pub stale_features: u64,
    /// Lost frames bridged.
    pub bridged_frames: u64,
    /// Features that came twice or out of order, or with another layout.
    pub ignored_features: u64,
    /// What the limits clipped.
    pub clipped: Clipped,
}

/// A pour or recording under way.
#[derive(Debug, Clone, Copy)]
struct Run {
    episode: u64,
    started_at_ns: u64,
    frames: u32,
    goal_ml: Option<f32>,
    curve: Option<Curve>,
    reason: EndReason,
    quiet_frames: u32,
    empty_frames: u32,
    /// Frames in a row with and without a stream, and the largest tilt at which one was there, degrees.
    stream_frames: u32,
    no_stream_frames: u32,
    stream_deg: Option<f32>,
    settling_since_ns: u64,
    worker_epoch_ns: u64,
    counters_before: Counters,
    late_ticks: u32,
}

/// The controller's state.
#[derive(Debug)]
pub struct Core {
    settings: Settings,
    agent: Option<Box<Agent>>,
    limiter: Limiter,
    /// Where the last action leads, degrees: a loop faster than the camera needs several ticks to get there.
    request_deg: f32,
    phase: Phase,
    run: Option<Run>,
    decision: Decision,
    newest: Option<Feature>,
    /// When the newest picture was taken in which V_e could be measured; a camera that only shows darkness is no camera.
    usable_at_ns: u64,
    shutdown: bool,
    last_tick_ns: u64,
    commanded: AngleHistory<COMMANDS>,
    counters: Counters,
}

/// Commands remembered, to know which one was in force when a picture was taken.
const COMMANDS: usize = 32;

impl Core {
    /// A controller without robot and weights.
    pub fn new(settings: Settings) -> Self {
        let period_s = settings.period_ns as f32 / 1e9;
        // Before the first tick the container is taken to be upright.
        let mut commanded = AngleHistory::new();
        commanded.push(0, 0.0);
        Self {
            settings,
            agent: None,
            limiter: Limiter::new(settings.limits, period_s, 0.0),
            request_deg: 0.0,
            phase: Phase::NoRobot,
            run: None,
            decision: Decision::NOTHING,
            newest: None,
            usable_at_ns: 0,
            shutdown: false,
            last_tick_ns: 0,
            commanded,
            counters: Counters::default(),
        }
    }

    /// What it is doing.
    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// Counters since the start.
    pub fn counters(&self) -> Counters {
        Counters { clipped: self.limiter.clipped(), ..self.counters }
    }

    /// Whether new weights may be taken now: not in the middle of a pour.
    pub fn may_exchange(&self) -> bool {
        self.run.is_none()
    }

    /// Takes `agent` for the next pours and gives the old one back, in constant time. Call only when
    /// [`Core::may_exchange`]; otherwise the new one comes back unused.
    pub fn exchange(&mut self, agent: Box<Agent>) -> Option<Box<Agent>> {
        if self.may_exchange() { self.agent.replace(agent) } else { Some(agent) }
    }

    /// One tick.
    pub fn step(&mut self, input: &Input) -> Output {
        self.counters.ticks += 1;
        let overslept = self.last_tick_ns != 0 && input.now_ns.saturating_sub(self.last_tick_ns) > self.settings.patience_ns;
        let late = self.last_tick_ns != 0 && input.now_ns.saturating_sub(self.last_tick_ns) > self.settings.period_ns * 3 / 2;
        self.last_tick_ns = input.now_ns;
        if let Some(run) = &mut self.run {
            run.late_ticks += u32::from(late);
        }

        let mut ended = self.look_at_robot(input);
        if overslept {
            self.give_up(EndReason::ControllerOverrun);
        }
        let ordered = input.order.map(|order| self.obey(order, input));
        let (asked, area) = self.take_features(input);
        if ended.is_none() {
            ended = self.advance(input);
        }
        let target_deg = self.command(input, asked);
        self.commanded.push(input.now_ns, self.limiter.alpha_deg());
        Output { target_deg, ordered, ended, telemetry: self.telemetry(input, asked, area) }
    }

    /// Enters or leaves [`Phase::NoRobot`].
    fn look_at_robot(&mut self, input: &Input) -> Option<Outcome> {
        match input.robot.hindrance {
            Some(reason) => {
                self.phase = Phase::NoRobot;
                let run = self.run.take()?;
                Some(self.outcome(&Run { reason: worse(run.reason, reason), ..run }, input.now_ns))
            }
            None if self.phase == Phase::NoRobot && input.robot.alpha_deg.abs() <= self.settings.upright_deg => {
                self.limiter.rest_at(input.robot.alpha_deg.clamp(self.settings.limits.alpha_min_deg, self.settings.limits.alpha_max_deg));
                self.phase = Phase::Idle;
                None
            }
            None => None,
        }
    }

    fn obey(&mut self, order: Order, input: &Input) -> Result<(), Refusal> {
        match order {
            Order::Shutdown => {
                self.shutdown = true;
                self.give_up(EndReason::Shutdown);
                Ok(())
            }
            Order::Abort => {
                if let Some(reason) = input.robot.hindrance {
                    return Err(Refusal::Robot(reason));
                }
                if self.phase == Phase::NoRobot {
                    return Err(Refusal::NotUpright(input.robot.alpha_deg));
                }
                self.give_up(EndReason::Aborted);
                Ok(())
            }
            Order::Pour { episode, goal_ml } => {
                self.ready(input)?;
                if !(goal_ml > 0.0 && goal_ml <= self.settings.goal_max_ml) {
                    return Err(Refusal::Goal(self.settings.goal_max_ml));
                }
                let agent = self.agent.as_mut().ok_or(Refusal::NoWeights)?;
                agent.start(goal_ml);
                self.decision = Decision { d_ml: goal_ml, ..Decision::NOTHING };
                self.begin(episode, Some(goal_ml), None, Phase::Pouring, input);
                Ok(())
            }
            Order::Record { episode, curve } => {
                self.ready(input)?;
                if !curve.fits(&self.settings.limits, self.settings.period_ns) {
                    return Err(Refusal::Curve);
                }
                self.decision = Decision::NOTHING;
                self.begin(episode, None, Some(curve), Phase::Recording, input);
                Ok(())
            }
        }
    }

    fn ready(&self, input: &Input) -> Result<(), Refusal> {
        if self.shutdown {
            return Err(Refusal::Shutdown);
        }
        if let Some(reason) = input.robot.hindrance {
            return Err(Refusal::Robot(reason));
        }
        match self.phase {
            Phase::Idle => {}
            Phase::NoRobot => return Err(Refusal::NotUpright(input.robot.alpha_deg)),
            _ => return Err(Refusal::Busy),
        }
        let usable = input.features.iter().filter(|f| !foreign(f, input.now_ns) && measured(f).is_some());
        let newest_ns = usable.map(|f| f.captured_at_ns).fold(self.usable_at_ns, u64::max);
        if input.now_ns.saturating_sub(newest_ns) <= self.settings.stale_ns { Ok(()) } else { Err(Refusal::NoFeature) }
    }

    fn begin(&mut self, episode: u64, goal_ml: Option<f32>, curve: Option<Curve>, phase: Phase, input: &Input) {
        let newest = input.features.iter().rfind(|f| !foreign(f, input.now_ns)).or(self.newest.as_ref());
        self.run = Some(Run {
            episode,
            started_at_ns: input.now_ns,
            frames: 0,
            goal_ml,
            curve,
            reason: EndReason::Done,
            quiet_frames: 0,
            empty_frames: 0,
            stream_frames: 0,
            no_stream_frames: 0,
            stream_deg: None,
            settling_since_ns: 0,
            worker_epoch_ns: newest.map_or(0, |f| f.worker_epoch_ns),
            counters_before: self.counters(),
            late_ticks: 0,
        });
        self.request_deg = self.limiter.alpha_deg();
        self.phase = phase;
    }

    /// Ends what is under way, upright; the first reason stays.
    fn give_up(&mut self, reason: EndReason) {
        match self.phase {
            Phase::Pouring | Phase::Recording => {
                if let Some(run) = &mut self.run {
                    run.reason = reason;
                }
                self.phase = Phase::Returning;
            }
            Phase::Idle if reason != EndReason::Shutdown => self.phase = Phase::Returning,
            _ => {}
        }
    }

    /// Takes the new features in order and steps the agent once a frame. Answers with the sum of the actions taken (NaN: none)
    /// and the newest area (NaN: none).
    fn take_features(&mut self, input: &Input) -> (f32, f32) {
        let (mut asked, mut area) = (f32::NAN, f32::NAN);
        for feature in input.features {
            let previous = self.newest;
            let same_worker = previous.is_some_and(|p| p.worker_epoch_ns == feature.worker_epoch_ns);
            if foreign(feature, input.now_ns) || (same_worker && previous.is_some_and(|p| feature.sequence <= p.sequence)) {
                self.counters.ignored_features += 1;
                continue;
            }
            self.newest = Some(*feature);
            self.counters.features += 1;
            let measured = measured(feature);
            if measured.is_some() {
                self.usable_at_ns = feature.captured_at_ns;
            }
            let Some(run) = &mut self.run else { continue };
            if feature.worker_epoch_ns != run.worker_epoch_ns {
                self.give_up(EndReason::WorkerRestarted);
                continue;
            }
            // Frames between this one and the last: their liquid is bridged, but the moment to act on them has passed.
            let lost = match previous {
                Some(p) if same_worker => (feature.sequence - p.sequence - 1).min(MAX_BRIDGED) as u32,
                _ => 0,
            };
            self.counters.bridged_frames += u64::from(lost);
            area = measured.unwrap_or(f32::NAN);
            run.frames += lost + 1;
            let (Some(agent), Some(_)) = (&mut self.agent, run.goal_ml) else { continue };
            let alpha_now_deg = self.limiter.alpha_deg();
            for nth in 1..=lost {
                let alpha_deg = self.commanded.at_deg(between_ns(previous, feature, nth, lost));
                self.decision = agent.step(Observation { area_px2: None, alpha_deg, alpha_now_deg });
            }
            let alpha_deg = self.commanded.at_deg(feature.captured_at_ns);
            self.decision = agent.step(Observation { area_px2: measured, alpha_deg, alpha_now_deg });
            let flowing = self.decision.flowing;
            run.quiet_frames = if flowing { 0 } else { run.quiet_frames + lost + 1 };
            if measured.is_some_and(|area_px2| area_px2 > 0.0) {
                (run.stream_frames, run.no_stream_frames) = (run.stream_frames + 1, 0);
                if run.stream_frames >= STREAM_FRAMES {
                    run.stream_deg = Some(run.stream_deg.map_or(alpha_deg, |deg| deg.max(alpha_deg)));
                }
            } else {
                (run.stream_frames, run.no_stream_frames) = (0, run.no_stream_frames + lost + 1);
            }
            let at_largest_tilt = alpha_now_deg >= self.settings.limits.alpha_max_deg - 0.5;
            run.empty_frames = if at_largest_tilt && !flowing { run.empty_frames + lost + 1 } else { 0 };
            if self.phase == Phase::Pouring && !self.decision.finished {
                asked = if asked.is_nan() { 0.0 } else { asked } + self.decision.dalpha_deg;
                self.request_deg = alpha_now_deg + asked;
            }
        }
        (asked, area)
    }

    /// Moves on to the next phase when this one is over.
    fn advance(&mut self, input: &Input) -> Option<Outcome> {
        let age_ns = input.now_ns.saturating_sub(self.usable_at_ns);
        let settings = self.settings;
        let run = self.run.as_mut()?;
        let seconds = |since_ns: u64| input.now_ns.saturating_sub(since_ns) as f64 / 1e9;
        if matches!(self.phase, Phase::Pouring | Phase::Recording) {
            self.counters.stale_features += u64::from(age_ns > STALE_TICK_PERIODS * settings.period_ns);
            if age_ns > settings.stale_ns {
                self.give_up(EndReason::StaleFeature);
                return None;
            }
        }
        match self.phase {
            Phase::Pouring if self.decision.finished => self.phase = Phase::Returning,
            Phase::Pouring if run.frames >= settings.max_frames => self.give_up(EndReason::MaxFrames),
            Phase::Pouring if run.empty_frames >= settings.empty_frames => self.give_up(EndReason::ContainerEmpty),
            Phase::Pouring
                if self.decision.poured_ml >= STREAM_ML
                    && run.no_stream_frames >= STREAM_LOST_FRAMES
                    && run.stream_deg.is_some_and(|deg| self.limiter.alpha_deg() > deg + STREAM_LOST_DEG) =>
            {
                self.give_up(EndReason::StreamLost);
            }
            Phase::Recording if run.curve.is_none_or(|c| seconds(run.started_at_ns) >= f64::from(c.duration_s())) => {
                self.phase = Phase::Returning;
            }
            Phase::Returning if self.limiter.alpha_deg().abs() < 0.01 => {
                self.phase = Phase::Settling;
                run.settling_since_ns = input.now_ns;
                run.quiet_frames = 0;
            }
            Phase::Settling => {
                // Upright is what the joint is, not what it was told.
                let upright = input.robot.alpha_deg.abs() <= settings.upright_deg;
                let quiet = run.quiet_frames >= SETTLE_QUIET_FRAMES && run.goal_ml.is_some();
                let over = seconds(run.settling_since_ns) >= SETTLE_MAX_S;
                if over || (upright && (quiet || self.shutdown)) {
                    let reason = if upright { run.reason } else { EndReason::NotUpright };
                    let run = Run { reason, ..*run };
                    self.run = None;
                    self.phase = Phase::Idle;
                    return Some(self.outcome(&run, input.now_ns));
                }
            }
            _ => {}
        }
        None
    }

    /// The angle to command: every one passes the limiter.
    fn command(&mut self, input: &Input, asked_deg: f32) -> Option<f32> {
        match self.phase {
            Phase::NoRobot => None,
            // Without a new action, what is left of the last one.
            Phase::Pouring if asked_deg.is_nan() => Some(self.limiter.step_towards(self.request_deg)),
            Phase::Pouring => Some(self.limiter.step(self.request_deg)),
            Phase::Recording => {
                let run = self.run?;
                let t = input.now_ns.saturating_sub(run.started_at_ns) as f32 / 1e9;
                Some(self.limiter.step(run.curve.map_or(0.0, |c| c.alpha_deg(t))))
            }
            Phase::Idle | Phase::Returning | Phase::Settling => {
                let target = self.limiter.step_upright();
                if self.phase == Phase::Returning && self.run.is_none() && target.abs() < 0.01 {
                    self.phase = Phase::Idle;
                }
                Some(target)
            }
        }
    }

    fn outcome(&self, run: &Run, now_ns: u64) -> Outcome {
        let (now, before) = (self.counters(), run.counters_before);
        Outcome {
            episode: run.episode,
            reason: run.reason,
            goal_ml: run.goal_ml,
            poured_ml: if run.goal_ml.is_some() { self.decision.poured_ml } else { f32::NAN },
            seconds: now_ns.saturating_sub(run.started_at_ns) as f32 / 1e9,
            frames: run.frames,
            bridged_frames: (now.bridged_frames - before.bridged_frames) as u32,
            stale_features: (now.stale_features - before.stale_features) as u32,
            late_ticks: run.late_ticks,
            clipped: Clipped {
                angle: now.clipped.angle - before.clipped.angle,
                rate: now.clipped.rate - before.clipped.rate,
                acceleration: now.clipped.acceleration - before.clipped.acceleration,
                not_finite: now.clipped.not_finite - before.clipped.not_finite,
            },
        }
    }

    fn telemetry(&self, input: &Input, asked_deg: f32, area_px2: f32) -> Telemetry {
        let run = self.run.as_ref();
        let curve = run.and_then(|r| r.curve);
        Telemetry {
            version: LAYOUT_VERSION,
            phase: self.phase as u32,
            tick: self.counters.ticks,
            at_ns: input.now_ns,
            robot_at_ns: input.robot.at_ns,
            episode: run.map_or(0, |r| r.episode),
            feature_sequence: self.newest.map_or(0, |f| f.sequence),
            weights_id: 0,
            alpha_deg: self.limiter.alpha_deg(),
            alpha_measured_deg: input.robot.alpha_deg,
            dalpha_deg: asked_deg,
            area_px2,
            v_ml: self.decision.v_ml,
            d_ml: self.decision.d_ml,
            goal_ml: run.and_then(|r| r.goal_ml).unwrap_or(f32::NAN),
            poured_ml: self.decision.poured_ml,
            lambda_deg: curve.map_or(f32::NAN, |c| c.lambda_deg),
            gamma_per_s2: curve.map_or(f32::NAN, |c| c.gamma_per_s2),
            beta_s: curve.map_or(f32::NAN, |c| c.beta_s),
            reserved: 0.0,
        }
    }
}

/// Of another layout, or of another clock: the age of a picture from the future, on which so much rests, would mean nothing.
fn foreign(feature: &Feature, now_ns: u64) -> bool {
    feature.version != LAYOUT_VERSION || feature.captured_at_ns > now_ns
}

/// V_e, if it could be measured, px^2.
fn measured(feature: &Feature) -> Option<f32> {
    let fine = feature.area_px2.is_finite() && feature.area_px2 >= 0.0 && Doubt::from_code(feature.doubt).usable();
    fine.then_some(feature.area_px2)
}

/// When the `nth` of `lost` frames before `feature` was taken: they lie evenly after the previous one.
fn between_ns(previous: Option<Feature>, feature: &Feature, nth: u32, lost: u32) -> u64 {
    let from_ns = previous.map_or(feature.captured_at_ns, |p| p.captured_at_ns);
    from_ns.saturating_add(feature.captured_at_ns.saturating_sub(from_ns) / u64::from(lost + 1) * u64::from(nth))
}

/// A run that was already ending keeps its first reason, unless that was no fault.
fn worse(first: EndReason, second: EndReason) -> EndReason {
    if first == EndReason::Done { second } else { first }
}
