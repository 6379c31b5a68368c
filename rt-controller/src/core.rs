//! The controller's decisions: one pure step for each tick. The running controller, replay, tests and evaluations all use this same code.
//!
//! It runs in the loop's thread, and in that of whoever replays or evaluates. [`Core::step`] maps what is known at a tick ([`Input`]) to the angle to command and to what happened ([`Output`]). It has no clock and
//! no device, does not allocate or lock, and does not fail: whatever goes wrong ends the pour, and the container comes upright if the robot
//! may still move. When and why a pour ends is decided in [`ending`].
//!
//! ```text
//!            robot may move      goal                 a reason to end                upright          the last drops fell
//!  NoRobot ------------> Idle ---------> Pouring ---------------------> Returning ---------> Settling ---------------> Idle
//!     ^                   | curve                                           ^
//!     |                   +------------> Recording -------------------------+ a reason to end
//!     +---- any phase, when the robot may not move
//! ```

use shared::agent::{Agent, Decision, Observation};
use shared::alpha_track::AngleHistory;
use shared::control::{EndReason, Outcome};
use shared::framing::Framing;
use shared::gaussian_curve::Curve;
use shared::limits::Limiter;
use shared::messages::{Doubt, Feature, LAYOUT_VERSION, Phase, Telemetry};

use ending::{Ending, Moment, SeenFrame};
use following::{COMMANDS, Following};
use frame_rate::FrameRate;
use intake::Taken;
use order::Situation;
use run::Run;

pub mod ending;
pub mod following;
mod frame_rate;
mod intake;
mod order;
mod robot;
mod run;
mod settings;

pub use order::{Order, Refusal, goal_is_legal};
pub use robot::Robot;
pub use run::Counters;
pub use settings::Settings;

/// Largest number of features that one tick takes; it takes the newest. More than these come only if the loop is late by a quarter of a
/// second.
pub const MAX_FEATURES: usize = 8;
/// A measurement older than this many periods counts its tick as stale. Chosen by hand; no measurement is recorded.
const STALE_TICK_PERIODS: u64 = 3;

/// How long a measured alpha still counts when no newer one has come, ns: as long as in the episodes (`shared::alpha_track`).
const MEASURED_HOLD_NS: u64 = 100_000_000;

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
    /// Alpha to command, degrees, within all limits; `None` if nothing must be commanded, because the robot may not move.
    pub target_deg: Option<f32>,
    /// The answer to this tick's order.
    pub ordered: Option<Result<(), Refusal>>,
    /// The result of the pour or recording that ended in this tick.
    pub ended: Option<Outcome>,
    /// What an episode records of this tick, without [`Telemetry::weights_id`], which only the caller knows.
    pub telemetry: Telemetry,
}

/// The controller's state.
#[derive(Debug)]
pub struct Core {
    settings: Settings,
    agent: Option<Box<Agent>>,
    limiter: Limiter,
    /// The alpha to which the last action leads, degrees. A loop that is faster than the camera needs several ticks to get there.
    request_deg: f32,
    phase: Phase,
    run: Option<Run>,
    decision: Decision,
    newest: Option<Feature>,
    /// When the newest picture was taken in which V_e could be measured, ns. Pictures that show nothing, such as dark ones, do not count.
    usable_at_ns: u64,
    frame_rate: FrameRate,
    shutdown: bool,
    last_tick_ns: u64,
    /// Measured alpha in the last tick, degrees.
    last_alpha_deg: f32,
    commanded: AngleHistory<COMMANDS>,
    measured: AngleHistory<COMMANDS>,
    counters: Counters,
}

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
            frame_rate: FrameRate::new(settings.frame_ns),
            shutdown: false,
            last_tick_ns: 0,
            last_alpha_deg: f32::NAN,
            commanded,
            measured: AngleHistory::new(),
            counters: Counters::default(),
        }
    }

    /// Lets the joint rest at this command, degrees, if nothing is poured: where a connection found it is not known to a replay that begins later.
    pub fn rest_at(&mut self, alpha_deg: f32) {
        if self.phase == Phase::Idle {
            self.limiter.rest_at(alpha_deg);
        }
    }

    /// What the controller is doing.
    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// Counters since the start.
    pub fn counters(&self) -> Counters {
        Counters { clipped: self.limiter.clipped(), ..self.counters }
    }

    /// Whether a new agent may be taken now: not in the middle of a pour or recording.
    pub fn may_exchange(&self) -> bool {
        self.run.is_none()
    }

    /// Brings a part of what the next step reads into the processor's caches ([`Agent::prefetch`]). It changes no result.
    pub fn prefetch(&self, part: usize) {
        if let Some(agent) = &self.agent {
            agent.prefetch(part);
        }
    }

    /// Takes `agent` for the next pours and gives the old one back, in constant time. Call it only when [`Core::may_exchange`];
    /// otherwise the new one comes back unused.
    pub fn exchange(&mut self, agent: Box<Agent>) -> Option<Box<Agent>> {
        if self.may_exchange() { self.agent.replace(agent) } else { Some(agent) }
    }

    /// One tick: the robot first, then the order, the measurements, the end of the pour, and the angle to command.
    pub fn step(&mut self, input: &Input) -> Output {
        self.counters.ticks += 1;
        let overran = ending::controller_overran(input.now_ns, self.last_tick_ns, &self.settings);
        let gap = self.last_tick_ns != 0 && input.now_ns.saturating_sub(self.last_tick_ns) > self.settings.period_ns * 3 / 2;
        self.last_tick_ns = input.now_ns;
        if let Some(run) = &mut self.run {
            run.tick_gaps += u32::from(gap);
        }

        // Where the joint is after a sleep does not say where it was meanwhile.
        let was_upright = self.last_alpha_deg.abs() <= self.settings.upright_deg;
        self.last_alpha_deg = input.robot.alpha_deg;
        if input.robot.at_ns > 0 {
            self.measured.push(input.robot.at_ns, input.robot.alpha_deg);
        }
        let mut ended = self.look_at_robot(input);
        if overran {
            // What leaves an upright container while nobody looks are drops.
            let only_drops = self.phase == Phase::Settling && was_upright;
            if let Some(run) = self.run.as_mut().filter(|_| only_drops) {
                run.ending.looks_away(&self.settings);
            }
            self.give_up(EndReason::ControllerOverrun, !only_drops);
        }
        let ordered = input.order.map(|order| self.obey(order, input));
        let (asked, area) = self.take_features(input);
        if ended.is_none() {
            ended = self.advance(input);
        }
        let target_deg = self.command(input, asked);
        self.commanded.push(input.now_ns, self.limiter.alpha_deg());
        self.counters.refuses = self.may_pour(input).err();
        Output { target_deg, ordered, ended, telemetry: self.telemetry(input, asked, area) }
    }

    /// Enters or leaves [`Phase::NoRobot`].
    fn look_at_robot(&mut self, input: &Input) -> Option<Outcome> {
        match input.robot.hindrance {
            Some(reason) => {
                self.phase = Phase::NoRobot;
                let mut run = self.run.take()?;
                let is_upright = input.robot.alpha_deg.abs() <= self.settings.upright_deg;
                let reason = run.ending.without_robot(reason, is_upright, &self.settings);
                Some(self.outcome(&run, reason, input.now_ns))
            }
            None if self.phase == Phase::NoRobot && input.robot.alpha_deg.abs() <= self.settings.upright_deg => {
                self.limiter.rest_at(input.robot.alpha_deg.clamp(self.settings.limits.alpha_min_deg, self.settings.limits.alpha_max_deg));
                self.phase = Phase::Idle;
                None
            }
            None => None,
        }
    }

    fn wrong_rate_hz(&self) -> Option<(f32, f32)> {
        self.frame_rate.wrong_hz().map(|hz| (hz, self.frame_rate.configured_hz()))
    }

    /// The situation in which an order comes.
    fn situation(&self, input: &Input) -> Situation {
        let newest_ns = intake::newest_usable_ns(input.features, self.usable_at_ns, input.now_ns);
        Situation {
            phase: self.phase,
            robot: input.robot,
            shutdown: self.shutdown,
            measurement_age_ns: input.now_ns.saturating_sub(newest_ns),
            wrong_rate_hz: self.wrong_rate_hz(),
        }
    }

    /// Whether a pour may begin now, if its goal is legal.
    fn may_pour(&self, input: &Input) -> Result<(), Refusal> {
        self.situation(input).may_begin(&self.settings)?;
        let agent = self.agent.as_ref().ok_or(Refusal::NoWeights)?;
        let seen = self.newest_with(input).map_or_else(Framing::default, |feature| feature.framing);
        agent.framing().difference(&seen).map_or(Ok(()), |difference| Err(Refusal::Framing(difference)))
    }

    fn obey(&mut self, order: Order, input: &Input) -> Result<(), Refusal> {
        match order {
            Order::Shutdown => {
                self.shutdown = true;
                self.give_up(EndReason::Shutdown, false);
            }
            Order::Abort => {
                self.situation(input).may_abort()?;
                self.give_up(EndReason::Aborted, false);
            }
            Order::Pour { episode, goal_ml, flows_by_deg } => {
                self.may_pour(input)?;
                order::goal_is_legal(goal_ml, &self.settings)?;
                self.agent.as_mut().ok_or(Refusal::NoWeights)?.start(goal_ml);
                self.decision = Decision { d_ml: goal_ml, ..Decision::NOTHING };
                self.begin(episode, Some(goal_ml), None, Ending::of_pour_that_flows_by(flows_by_deg), input);
            }
            Order::Record { episode, curve } => {
                self.situation(input).may_begin(&self.settings)?;
                order::curve_is_legal(&curve, &self.settings)?;
                self.decision = Decision::NOTHING;
                self.begin(episode, None, Some(curve), Ending::of_recording(f64::from(curve.duration_s())), input);
            }
        }
        Ok(())
    }

    /// The newest measurement, those of this tick included.
    fn newest_with<'a>(&'a self, input: &'a Input) -> Option<&'a Feature> {
        input.features.iter().rfind(|f| !intake::is_foreign(f, input.now_ns)).or(self.newest.as_ref())
    }

    /// Begins a recording of `curve`, or else a pour of `goal_ml`; `ending` says when it is over.
    fn begin(&mut self, episode: u64, goal_ml: Option<f32>, curve: Option<Curve>, ending: Ending, input: &Input) {
        let worker_epoch_ns = self.newest_with(input).map_or(0, |f| f.worker_epoch_ns);
        self.run = Some(Run {
            episode,
            started_at_ns: input.now_ns,
            frames: 0,
            goal_ml,
            curve,
            ending,
            following: Following::new(self.agent.as_ref().and_then(|agent| agent.learned_lag_s()), &self.settings),
            settling_since_ns: 0,
            worker_epoch_ns,
            counters_before: self.counters(),
            tick_gaps: 0,
        });
        self.request_deg = self.limiter.alpha_deg();
        self.phase = if curve.is_some() { Phase::Recording } else { Phase::Pouring };
    }

    /// Ends what is under way, for `reason`, and brings the container upright. What is already ending keeps its reason; with `undoes`, only unless that is
    /// that it is done.
    fn give_up(&mut self, reason: EndReason, undoes: bool) {
        if let Some(run) = self.run.as_mut().filter(|_| undoes) {
            run.ending.end_instead_of_done(reason);
        }
        match self.phase {
            Phase::Pouring | Phase::Recording => {
                if let Some(run) = &mut self.run {
                    run.ending.end_with(reason);
                }
                self.phase = Phase::Returning;
            }
            Phase::Idle if reason != EndReason::Shutdown => self.phase = Phase::Returning,
            _ => {}
        }
    }

    /// Takes the new features in order and steps the agent once for each frame. Returns the sum of the actions taken, degrees, and the
    /// newest area, px^2; each is NaN if there is none.
    fn take_features(&mut self, input: &Input) -> (f32, f32) {
        let (mut asked, mut area) = (f32::NAN, f32::NAN);
        let bridged = self.settings.frames(intake::BRIDGED_S);
        for feature in input.features {
            let Some(taken) = Taken::new(self.newest, feature, input.now_ns, bridged) else {
                self.counters.ignored_features += 1;
                continue;
            };
            self.newest = Some(*feature);
            self.frame_rate.saw(feature);
            self.counters.features += 1;
            let measured = intake::usable_area_px2(feature);
            if measured.is_some() {
                self.usable_at_ns = feature.captured_at_ns;
            }
            let Some(run) = &mut self.run else { continue };
            if ending::worker_was_restarted(feature, run.worker_epoch_ns) {
                self.give_up(EndReason::WorkerRestarted, true);
                continue;
            }
            self.counters.bridged_frames += u64::from(taken.lost);
            area = measured.unwrap_or(f32::NAN);
            run.frames += taken.lost + 1;
            if let Some(dalpha_deg) = self.step_agent(&taken, measured, feature) {
                asked = if asked.is_nan() { 0.0 } else { asked } + dalpha_deg;
                self.request_deg = self.limiter.alpha_deg() + asked;
            }
        }
        (asked, area)
    }

    /// Steps the agent for the frames that were lost and for the one that was measured. Returns the angle to ask for, degrees, while the
    /// pour goes on. The liquid of the lost frames is estimated, but the moment to act on them has passed.
    fn step_agent(&mut self, taken: &Taken, area_px2: Option<f32>, feature: &Feature) -> Option<f32> {
        let Feature { captured_at_ns, confidence, .. } = *feature;
        let (agent, run) = (self.agent.as_mut()?, self.run.as_mut()?);
        run.goal_ml?;
        let alpha_now_deg = self.limiter.alpha_deg();
        let (measured, settings) = (&self.measured, &self.settings);
        let mut step = |area_px2, alpha_deg, at_ns| {
            let alpha_measured_deg = measured.at_within_deg(at_ns, MEASURED_HOLD_NS);
            let decision = agent.step(Observation { area_px2, confidence, alpha_deg, alpha_measured_deg, alpha_now_deg });
            if run.ending.decided(&decision, settings) {
                agent.tilt_back();
            }
            decision
        };
        for nth in 1..=taken.lost {
            step(None, self.commanded.at_deg(taken.lost_at_ns(nth)), taken.lost_at_ns(nth));
        }
        let alpha_deg = self.commanded.at_deg(captured_at_ns);
        self.decision = step(area_px2, alpha_deg, captured_at_ns);
        let cut_off = Doubt::from_code(feature.doubt) == Doubt::LeavesRegion;
        let frame = SeenFrame { lost: taken.lost, area_px2, cut_off, flowing: self.decision.flowing, alpha_deg, alpha_now_deg };
        run.ending.saw(&frame, &self.settings);
        (self.phase == Phase::Pouring && !run.ending.agent_is_done()).then_some(self.decision.dalpha_deg)
    }

    /// Moves on to the next phase when this one is over.
    fn advance(&mut self, input: &Input) -> Option<Outcome> {
        let run = self.run.as_mut()?;
        let seconds = |since_ns: u64| input.now_ns.saturating_sub(since_ns) as f64 / 1e9;
        let follows = run.following.follows(&input.robot, &self.commanded);
        let age_ns = input.now_ns.saturating_sub(self.usable_at_ns);
        let wrong_rate = self.frame_rate.wrong_hz().map(|_| EndReason::FrameRate);
        let blind =
            if age_ns > self.settings.stale_ns { Some(EndReason::StaleFeature) } else { wrong_rate }.filter(|_| run.goal_ml.is_some());
        match self.phase {
            Phase::Pouring | Phase::Recording => {
                self.counters.stale_features += u64::from(age_ns > STALE_TICK_PERIODS * self.settings.period_ns);
                let moment = Moment {
                    running_s: seconds(run.started_at_ns),
                    frames: run.frames,
                    measurement_age_ns: age_ns,
                    alpha_deg: self.limiter.alpha_deg(),
                    poured_ml: self.decision.poured_ml,
                    follows,
                };
                let due = run.ending.due(&moment, &self.settings);
                if let Some(reason) = wrong_rate.filter(|_| due.is_none_or(|due| due == EndReason::Done)).or(due) {
                    self.give_up(reason, false);
                }
                None
            }
            Phase::Returning => {
                run.ending.returns(follows, blind);
                if ending::is_commanded_upright(self.limiter.alpha_deg()) {
                    self.phase = Phase::Settling;
                    run.settling_since_ns = input.now_ns;
                    run.ending.begin_settling();
                }
                None
            }
            Phase::Settling => {
                // The last drops are waited for; what leaves before the joint itself is upright is more than that.
                let is_upright = input.robot.alpha_deg.abs() <= self.settings.upright_deg;
                run.ending.returns(follows, blind.filter(|_| !is_upright));
                let settling_s = seconds(run.settling_since_ns);
                let reason = run.ending.settled(input.robot.alpha_deg, settling_s, self.shutdown, &self.settings)?;
                let run = self.run.take()?;
                self.phase = Phase::Idle;
                Some(self.outcome(&run, reason, input.now_ns))
            }
            Phase::NoRobot | Phase::Idle => None,
        }
    }

    /// The angle to command, degrees: every one passes the limiter. `None` without a robot.
    fn command(&mut self, input: &Input, asked_deg: f32) -> Option<f32> {
        // No tilt is asked for that is out of the joint's reach.
        let within_reach = |run: &Run, request_deg| run.following.within_reach_deg(request_deg, input.robot.alpha_deg);
        match self.phase {
            Phase::NoRobot => None,
            Phase::Pouring => {
                self.request_deg = self.run.as_ref().map_or(self.request_deg, |run| within_reach(run, self.request_deg));
                // Without a new action, the rest of the last one is carried out.
                let request_deg = self.request_deg;
                Some(if asked_deg.is_nan() { self.limiter.step_towards(request_deg) } else { self.limiter.step(request_deg) })
            }
            Phase::Recording => {
                let run = self.run?;
                let t = input.now_ns.saturating_sub(run.started_at_ns) as f32 / 1e9;
                Some(self.limiter.step(within_reach(&run, run.curve.map_or(0.0, |c| c.alpha_deg(t)))))
            }
            // What was asked for and not followed is taken back as fast as the limits allow; from there on the way is the usual one.
            Phase::Returning if self.is_ahead_of(input.robot.alpha_deg) => Some(self.limiter.step(input.robot.alpha_deg)),
            // Nothing moves before somebody asks: a joint that was found within the tolerance of upright and within the range stays there.
            Phase::Idle if self.limiter.rate_deg_s() == 0.0 => Some(self.limiter.step(self.limiter.alpha_deg())),
            Phase::Idle | Phase::Returning | Phase::Settling => {
                let target = self.limiter.step_upright();
                if self.phase == Phase::Returning && self.run.is_none() && ending::is_commanded_upright(target) {
                    self.phase = Phase::Idle;
                }
                Some(target)
            }
        }
    }

    /// Whether a pour or recording ends because the joint did not follow, and the command is still beyond it.
    fn is_ahead_of(&self, measured_deg: f32) -> bool {
        let not_followed = self.run.is_some_and(|run| run.ending.reason() == EndReason::NotFollowed);
        not_followed && (0.0..self.limiter.alpha_deg()).contains(&measured_deg)
    }

    fn outcome(&self, run: &Run, reason: EndReason, now_ns: u64) -> Outcome {
        run.outcome(reason, now_ns, &self.decision, self.counters())
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
            poured_sd_ml: self.decision.poured_sd_ml,
        }
    }
}
