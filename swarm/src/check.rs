//! The invariants: what must hold in every robot cycle, in every tick and at every end, whatever happens.
//!
//! Pure; allocates for what it finds; cannot fail. docs/SWARM.md lists the invariants by the names that are used here.

use std::collections::VecDeque;

use rt_controller::core::Settings;
use rt_controller::journal::Tick;
use rt_controller::link::ProgramState;
use serde::Serialize;
use shared::control::Outcome;
use shared::limits::Limits;
use shared::messages::{Phase, Telemetry};
use simulator::ur::{Fault, Machine, RobotMode, RuntimeState, SafetyMode};

use crate::commanded::{Commanded, SLACK, SLACK_DEG};
use crate::evidence::Evidence;
use crate::noticing::{forbids_runs, hinders, lasts, leaves_tilted, must_end, remedies, takes_robot, takes_s};
use crate::unshown::Unshown;
use crate::waits::Waits;
use crate::weight_set::RATE_HZ;
use crate::what::What;

/// A container nearer to 0 than this is upright, degrees (`robot.start_tolerance_deg` of config/sim.toml, and half a degree of lag).
const UPRIGHT_DEG: f64 = 2.5;
/// A container nearer to 0 than this can be taken, degrees (`robot.start_tolerance_deg` of config/sim.toml, and what its measurement scatters).
const START_DEG: f64 = 1.9;
/// The longest way upright of a program that runs, s: 110 degrees at 60 degrees/s, its patience of 100 ms, and 1 s as in docs/ROBOT.md.
const WAY_UPRIGHT_S: f64 = 110.0 / 60.0 + 0.1 + 1.0;
/// After this a fault that must end a pour has been noticed, s: `controller.stale_feature_ms` and `lost_robot_ms` of config/sim.toml, three
/// ticks, and the time that a fault of the loop itself takes is added.
pub const NOTICED_S: f64 = 0.5;
/// The output register in which the program says what it is doing (`robot.register_base` of config/sim.toml).
const STATE_REGISTER: usize = 24;
/// The output register in which the program says which target it took.
const ECHO_REGISTER: usize = STATE_REGISTER + 1;
/// The output register in which the program says which upload it is.
const RUN_REGISTER: usize = STATE_REGISTER + 2;
/// After this the controller has looked at the robot for which its operator asked, s: a beat of 0.1 s of its thread, and the dialogue that begins.
const LOOKS_S: f64 = 0.2;
/// How long a container may stand tilted after its program has ended by itself, s: one cycle would do, and the arm needs time to stop.
const LEFT_TILTED_S: f64 = 2.0;
/// For how long a robot still follows a target that was sent, s: the patience of its program, and what it is behind.
const FOLLOWED_S: f64 = 0.3;
/// The share of its speed below which a robot must end a pour, whatever else is seen: docs/ROBOT.md promises it below 0.95.
const SLOWED: f64 = 0.9;
/// For how long a joint may be behind its commands, s: 1.25 times the longest lag that is believed, and two ticks (docs/ROBOT.md).
const FOLLOWS_S: f64 = 0.45;
/// How far from its commands a joint still follows, degrees: the 2 of docs/ROBOT.md, and as many for how far it goes between two ticks.
const FOLLOWS_DEG: f64 = 4.0;
/// After this a controller that stands still is no longer heard, s: the patience of the program, and bytes on their way.
const SILENT_S: f64 = 0.2;
/// Most frames that are bridged at once: one second (`BRIDGED_S` of the controller's core).
const MOST_BRIDGED: u64 = RATE_HZ as u64;
/// Number of violations that are kept for a seed; the first is what counts.
const MOST: usize = 8;

/// Something that must not happen has happened.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Violation {
    /// Name of the invariant.
    pub invariant: &'static str,
    /// When, s since the start.
    pub at_s: f64,
    /// What was seen.
    pub what: String,
}

/// A fault that was injected.
#[derive(Debug, Clone)]
pub struct Injected {
    /// What.
    pub what: What,
    /// When, s.
    pub at_s: f64,
    /// Until when it may last, s: somebody sets it right, or it is over by itself.
    pub until_s: f64,
    /// What the controller was doing.
    pub phase: Phase,
}

/// Who can know that a person stopped our program. A stop that finds no program of ours at work stops nothing, and leaves no sign.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Taken {
    /// The controller that had a session then, as long as it lives.
    pub(crate) controller: bool,
    /// The robot's registers, in which our program was still at work, until the robot boots.
    pub(crate) registers: bool,
    /// The program that was at work then was resumed, and has ended by itself, as the registers say now.
    pub(crate) ended: bool,
}

/// What the checks keep.
#[derive(Debug)]
pub struct Checks {
    pub(crate) settings: Settings,
    /// Violations so far.
    pub violations: Vec<Violation>,
    /// Faults so far, the ordinary course left out.
    pub faults: Vec<Injected>,
    /// What the program tells servoj.
    commanded: Commanded,
    /// The program's run, and whether it has begun to come upright for good.
    way_back: (i32, bool),
    /// The newest target, degrees, and the rate at which it came.
    target: Option<(f64, f64)>,
    /// When the targets that the robot may still follow were sent, s, and which, degrees; also when there is none any more.
    sent_targets: VecDeque<(f64, f64)>,
    pub(crate) phase: Phase,
    /// From when on a controller that stands still has not been heard, s.
    silent_from_s: f64,
    /// When the program that the robot has began, s.
    program_s: f64,
    /// The tilt in the newest control cycle, degrees, and since when the joint has not been where it was commanded, s.
    alpha_deg: f64,
    elsewhere_since_s: Option<f64>,
    /// Since when something has kept the arm from moving at nearly its full speed, s.
    hindered_since_s: Option<f64>,
    /// Since when the robot could have been on its way upright, s.
    free_since_s: Option<f64>,
    sequence: (u64, u64),
    used: u64,
    /// Number of frames lost between measurements that came, in the run under way.
    pub(crate) lost: u64,
    /// Since when the container has stood tilted without a program, s.
    tilted_since_s: Option<f64>,
    /// How many targets were sent in the newest session, and the number of the newest one that the robot took.
    sent: i32,
    echoed: i32,
    /// Whether the arm lags by so much that the controller may say that it does not follow.
    pub(crate) is_slow: bool,
    /// When the operator last ordered anything, and when that last asked for the robot, s.
    pub(crate) ordered_s: f64,
    pub(crate) asked_s: f64,
    /// Whether the controller could not know then that what a person had done came before.
    is_unclear: bool,
    /// Whether a person has moved the arm since the operator last asked for the robot.
    is_moved: bool,
    /// Who knows that a person stopped our program, and that nobody asked for the robot since.
    pub(crate) taken: Taken,
    /// When every fault of the robot that lasts was ended, s.
    cleared_s: Vec<f64>,
    /// How long the controller has been in what it must leave by itself.
    pub(crate) waits: Waits,
    /// What the camera did not show of the run under way.
    pub(crate) unshown: Unshown,
    /// What was to be seen when the run under way was ended.
    pub(crate) evidence: Evidence,
    pub(crate) run_since_s: f64,
    /// Number of pours and recordings that have ended in this life of the controller.
    pub outcomes: Vec<(f64, Outcome)>,
}

/// Whether a stop meets a program of ours. One that is paused is stopped already, and to stop it for good is what the controller asks for; and a
/// robot that stands behind an open safeguard cannot stop protectively.
fn stops_ours(what: &What, machine: &Machine) -> bool {
    // One that ends by itself in this very cycle has ended.
    let runs = !matches!(machine.runtime_state(), RuntimeState::Stopped | RuntimeState::Stopping);
    let is_ours = runs && machine.robot.outputs.int[STATE_REGISTER] != 0;
    is_ours
        && match what {
            What::Robot(Fault::ProgramStop | Fault::Freedrive) => machine.runtime_state() == RuntimeState::Playing,
            What::Robot(Fault::ProtectiveStop) => machine.safety_mode().lets_move(),
            What::Robot(Fault::SafetyMode(SafetyMode::Recovery)) => machine.safety_mode().lets_move(),
            _ => true,
        }
}

/// Whether the arm has power, and nobody has stopped it or has it in hand.
fn is_free(machine: &Machine) -> bool {
    machine.safety_mode().lets_move() && machine.robot_mode() == RobotMode::Running && !machine.freedrive()
}

/// Whether nothing keeps the arm from moving at its full speed.
fn may_move(machine: &Machine) -> bool {
    is_free(machine) && machine.speed_scaling() > 0.99
}

impl Checks {
    /// Checks of a cell whose robot has control cycles of `cycle_s`.
    pub fn new(settings: Settings, cycle_s: f64) -> Self {
        Self {
            commanded: Commanded::new(settings.limits, cycle_s),
            way_back: (0, false),
            settings,
            violations: Vec::new(),
            faults: Vec::new(),
            target: None,
            sent_targets: VecDeque::new(),
            phase: Phase::NoRobot,
            silent_from_s: f64::INFINITY,
            program_s: f64::NEG_INFINITY,
            alpha_deg: 0.0,
            elsewhere_since_s: None,
            hindered_since_s: None,
            free_since_s: None,
            sequence: (0, 0),
            used: 0,
            lost: 0,
            tilted_since_s: None,
            sent: 0,
            echoed: 0,
            is_slow: false,
            ordered_s: f64::NEG_INFINITY,
            asked_s: f64::NEG_INFINITY,
            is_unclear: false,
            is_moved: false,
            taken: Taken::default(),
            cleared_s: Vec::new(),
            waits: Waits::default(),
            unshown: Unshown::default(),
            evidence: Evidence::default(),
            run_since_s: 0.0,
            outcomes: Vec::new(),
        }
    }

    /// Takes note of a violation.
    pub fn violated(&mut self, invariant: &'static str, at_s: f64, what: String) {
        if self.violations.len() < MOST && !self.violations.iter().any(|v| v.invariant == invariant) {
            self.violations.push(Violation { invariant, at_s, what });
        }
    }

    /// Takes note of something that happens to a cell whose controller lives or not, and whose robot is about to see it. Somebody sets it right
    /// at `remedied_s`.
    pub fn happens(&mut self, what: &What, machine: &Machine, lives: bool, (at_s, remedied_s): (f64, f64)) {
        match what {
            What::Pour(_) | What::Record(..) | What::Resume if lives => {
                self.is_unclear = self.taken.controller || self.taken.registers || self.is_moved;
                (self.taken, self.is_moved, self.ordered_s) = (Taken::default(), false, at_s);
            }
            // Whoever is killed pours nothing, and the robot's program has to bring the container upright by itself.
            What::ControllerKilled(_) => (self.taken.controller, self.phase) = (false, Phase::NoRobot),
            What::Robot(Fault::Boot) => self.taken.registers = false,
            What::Robot(Fault::Clear) => self.cleared_s.push(at_s),
            What::Robot(Fault::Jog(..) | Fault::HandMove(..)) => self.is_moved = true,
            // The robot's program soon hears nothing any more, and has to bring the container upright by itself.
            What::Suspended(_) => self.silent_from_s = self.silent_from_s.min(at_s + SILENT_S),
            what if takes_robot(what) && stops_ours(what, machine) => {
                let has_session = lives && self.phase != Phase::NoRobot;
                // Without a session, a stop before the controller has looked at the robot looks like one before the operator asked.
                let unseen = matches!(what, What::Robot(Fault::ProgramStop)) && !has_session && at_s < self.asked_s + LOOKS_S;
                self.taken.registers |= !unseen;
                self.taken.ended = false;
                self.taken.controller |= has_session;
            }
            _ => {}
        }
        if let What::Robot(remedy) = what {
            self.faults.iter_mut().filter(|f| remedies(remedy, &f.what)).for_each(|f| f.until_s = f.until_s.min(at_s));
        }
        if !what.is_ordinary() {
            let until_s = remedied_s.max(at_s + takes_s(what));
            let phase = self.phase(at_s);
            self.faults.push(Injected { what: what.clone(), at_s, until_s, phase });
        }
    }

    /// The operator has ordered something; `resumes` tells whether that was `resume`, which always asks for the robot. Anything else asks for it only if the
    /// controller had said that it `waits` for that. Unless it had, it cannot know whether what a person did came before.
    pub fn asked(&mut self, waits: bool, resumes: bool) {
        self.is_unclear &= !waits;
        if waits || resumes {
            self.asked_s = self.ordered_s;
        }
    }

    /// A program begins on the robot.
    pub fn program_started(&mut self, at_s: f64) {
        self.program_s = at_s;
        if self.taken.controller || (self.taken.registers && !self.taken.ended) {
            self.violated("taken-unasked", at_s, "a program was started after a person stopped the robot, and nobody asked".into());
        }
    }

    /// A new controller begins.
    pub fn controller_started(&mut self) {
        (self.target, self.phase, self.sequence, self.used) = (None, Phase::NoRobot, (0, 0), 0);
        (self.evidence, self.silent_from_s) = (Evidence::default(), f64::INFINITY);
    }

    /// The highest target that the robot may still follow, degrees, and the rate at which targets come, degrees/s; `None` if there is none. A joint
    /// that lags still goes up to a target that has been taken back, and follows the last one of a controller that sends no more.
    pub fn target(&self, at_s: f64) -> Option<(f64, f64)> {
        let followed = self.sent_targets.iter().filter(|(sent_s, _)| at_s - sent_s < FOLLOWED_S);
        let highest_deg = followed.map(|(_, deg)| *deg).chain(self.target.map(|(deg, _)| deg)).reduce(f64::max)?;
        Some((highest_deg, self.target.map_or(0.0, |(_, rate)| rate)))
    }

    /// The limits on alpha.
    pub fn limits(&self) -> Limits {
        self.settings.limits
    }

    fn is_active(&self) -> bool {
        matches!(self.phase, Phase::Pouring | Phase::Recording)
    }

    /// What the controller does at a time, s, as far as the robot can know: one that stands still for long does nothing.
    pub fn phase(&self, at_s: f64) -> Phase {
        if at_s >= self.silent_from_s { Phase::NoRobot } else { self.phase }
    }

    /// Looks at the robot after a control cycle. `joint` is the tilting one, and `alpha_deg` its measured tilt.
    pub fn cycle(&mut self, machine: &Machine, joint: usize, alpha_deg: f64, at_s: f64) {
        let active = matches!(self.phase(at_s), Phase::Pouring | Phase::Recording);
        self.alpha_deg = alpha_deg;
        let is_hindered = !is_free(machine) || machine.speed_scaling() < SLOWED;
        self.hindered_since_s = is_hindered.then_some(self.hindered_since_s.unwrap_or(at_s));
        for (invariant, what) in self.commanded.cycle(machine, joint, active) {
            self.violated(invariant, at_s, what);
        }
        self.targets_numbered(machine, at_s);
        self.stays_on_way_back(machine, at_s);
        self.upright(machine, alpha_deg, active, at_s);
        let asked = (!self.taken.controller && !self.taken.registers && !self.is_unclear).then_some(self.asked_s);
        let stands_until_s = self.faults.iter().filter(|f| hinders(&f.what)).map(|f| f.until_s).fold(0.0, f64::max);
        // A container that stands tilted, or a paused program, is for the operator to set right.
        let is_paused = matches!(machine.runtime_state(), RuntimeState::Pausing | RuntimeState::Paused);
        let may_be_taken = may_move(machine) && alpha_deg.abs() < START_DEG && !is_paused;
        if let Some(what) = self.waits.cycle(
            self.phase(at_s),
            (may_move(machine), may_be_taken, machine.runtime_state() == RuntimeState::Stopped),
            (asked, stands_until_s),
            at_s,
        ) {
            self.violated("ends", at_s, what);
        }
        self.left_tilted(machine, alpha_deg, at_s);
        let state = ProgramState::from_code(machine.robot.outputs.int[STATE_REGISTER]);
        self.taken.ended |=
            machine.runtime_state() == RuntimeState::Stopped && matches!(state, ProgramState::TimedOut | ProgramState::Stopped);
    }

    /// The targets of a session are numbered one by one, so none that the robot takes has a number above how many were sent. (Numbers that repeat
    /// are targets that the program does not see; what it then does is checked as always.) The last word of a session, that the program shall bring
    /// the container upright, is no target and has a number too.
    fn targets_numbered(&mut self, machine: &Machine, at_s: f64) {
        let echo = machine.robot.outputs.int[ECHO_REGISTER];
        if echo != self.echoed && echo > self.sent + 1 {
            self.violated("targets-numbered", at_s, format!("the robot has taken target {echo}, and {} were sent", self.sent));
        }
        self.echoed = echo;
    }

    /// A program that has begun to come upright by itself or on command does not take targets again.
    fn stays_on_way_back(&mut self, machine: &Machine, at_s: f64) {
        let registers = &machine.robot.outputs.int;
        let (state, run) = (ProgramState::from_code(registers[STATE_REGISTER]), registers[RUN_REGISTER]);
        // A new program says that it is ready before it says which upload it is.
        if run != self.way_back.0 || state == ProgramState::Ready {
            self.way_back = (run, false);
        }
        if !state.takes_targets() {
            self.way_back.1 = true;
        } else if std::mem::take(&mut self.way_back.1) {
            self.violated("no-resume", at_s, format!("the program was on its way upright, and is {state:?} again"));
        }
    }

    /// A program that ends by itself leaves the container upright.
    fn left_tilted(&mut self, machine: &Machine, alpha_deg: f64, at_s: f64) {
        if machine.runtime_state() != RuntimeState::Stopped || alpha_deg.abs() <= UPRIGHT_DEG {
            self.tilted_since_s = None;
        } else if at_s - *self.tilted_since_s.get_or_insert(at_s) > LEFT_TILTED_S && !self.is_left_by_somebody(at_s) {
            self.violated("left-tilted", at_s, format!("the program ended and left the container at {alpha_deg:.1} degrees"));
        }
    }

    /// Whether a fault that stands, or has come since the program began, can have left the container tilted.
    fn is_left_by_somebody(&self, at_s: f64) -> bool {
        self.faults.iter().any(|f| leaves_tilted(&f.what) && (f.until_s >= at_s || f.at_s >= self.program_s))
    }

    /// Whether the container comes upright when nothing is poured and the program may bring it there.
    fn upright(&mut self, machine: &Machine, alpha_deg: f64, active: bool, at_s: f64) {
        let may = may_move(machine) && machine.runtime_state() == RuntimeState::Playing && machine.robot.servo.limiting() > 0.99;
        if !may || active {
            self.free_since_s = None;
        } else if alpha_deg.abs() > UPRIGHT_DEG {
            let since_s = *self.free_since_s.get_or_insert(at_s);
            if at_s - since_s > WAY_UPRIGHT_S && !self.slowed_lately(at_s) {
                self.violated("upright", at_s, format!("still tilted by {alpha_deg:.1} degrees {:.1} s after the end", at_s - since_s));
            }
        } else {
            self.free_since_s = None;
        }
    }

    /// Whether something slows the robot that it does not tell, or did so until lately.
    fn slowed_lately(&self, at_s: f64) -> bool {
        let slows = |what: &What| {
            matches!(what, What::Robot(Fault::HeldBack(_) | Fault::JointSpeedLimit(_) | Fault::TimeScaling(_) | Fault::SpeedSlider(_)))
        };
        self.faults.iter().any(|f| slows(&f.what) && at_s - f.at_s < 16.0)
    }

    /// Looks at a tick of the loop.
    pub fn tick(&mut self, tick: &Tick, telemetry: &Telemetry, features: u64, at_s: f64) {
        let limits = self.settings.limits;
        let before = self.phase;
        (self.phase, self.silent_from_s) = (Phase::from_code(telemetry.phase), f64::INFINITY);
        if self.is_active() && !matches!(before, Phase::Pouring | Phase::Recording) {
            (self.run_since_s, self.lost) = (at_s, 0);
            self.unshown.begins();
        }
        if tick.agent.is_some() && !matches!(before, Phase::Idle | Phase::NoRobot) {
            self.violated("swap-between-pours", at_s, format!("weights were taken while {before:?}"));
        }
        self.count_frames(tick, features, before, at_s);
        self.evidence.tick(tick, (before, self.phase), self.sequence.0, &self.settings);
        let Some(target_deg) = tick.target_deg.map(f64::from) else {
            self.target = None;
            return self.noticed(at_s);
        };
        // What an earlier session sent may still be on its way when the robot is lost.
        self.sent = if before == Phase::NoRobot { 1 } else { self.sent + 1 };
        let begins = self.is_active() && !matches!(before, Phase::Pouring | Phase::Recording);
        self.commanded.target(target_deg, self.is_active(), begins);
        let period_s = self.settings.period_ns as f64 / 1e9;
        if !(f64::from(limits.alpha_min_deg) - SLACK_DEG..=f64::from(limits.alpha_max_deg) + SLACK_DEG).contains(&target_deg) {
            self.violated("target-range", at_s, format!("a target of {target_deg} degrees"));
        }
        // The first target begins at rest, at the joint's measured tilt.
        let measured_deg = f64::from(tick.robot.alpha_deg.clamp(limits.alpha_min_deg, limits.alpha_max_deg));
        let (last_deg, last_rate) = self.target.unwrap_or((measured_deg, 0.0));
        let rate = (target_deg - last_deg) / period_s;
        let most = f64::from(limits.rate_deg_s.min(limits.step_deg / period_s as f32));
        if rate.abs() > most * (1.0 + SLACK) + 0.1 {
            self.violated("target-rate", at_s, format!("targets move at {rate:.2} degrees/s"));
        }
        let acceleration = (rate - last_rate) / period_s;
        if acceleration.abs() > f64::from(limits.acceleration_deg_s2) * (1.0 + SLACK) + 1.0 {
            self.violated("target-acceleration", at_s, format!("targets change by {acceleration:.0} degrees/s^2"));
        }
        self.target = Some((target_deg, rate));
        self.sent_targets.retain(|(sent_s, _)| at_s - sent_s < FOLLOWS_S);
        self.sent_targets.push_back((at_s, target_deg));
        self.noticed(at_s);
        self.followed(at_s);
    }

    /// Every frame is counted once: those of a worker that come in order, each a single time.
    fn count_frames(&mut self, tick: &Tick, features: u64, before: Phase, at_s: f64) {
        let idle = |phase| matches!(phase, Phase::NoRobot | Phase::Idle);
        let counts = !idle(before) || !idle(self.phase);
        for feature in &tick.features {
            let (epoch, sequence) = self.sequence;
            if feature.captured_at_ns <= tick.now_ns && (feature.worker_epoch_ns != epoch || feature.sequence > sequence) {
                let after = if feature.worker_epoch_ns == epoch { feature.sequence - sequence - 1 } else { 0 };
                self.lost += if counts { after.min(MOST_BRIDGED) } else { 0 };
                self.sequence = (feature.worker_epoch_ns, feature.sequence);
                self.used += 1;
            }
        }
        if features != self.used {
            let used = self.used;
            self.violated("frames-once", at_s, format!("{features} frames were counted, and {used} came"));
            self.used = features;
        }
    }

    /// Whether every fault that must end a pour has ended it by now, also one that stood before it began.
    fn noticed(&mut self, at_s: f64) {
        if !self.is_active() {
            return;
        }
        let since_s = self.run_since_s;
        let missed = self.faults.iter().find(|f| {
            let began_in_it = f.at_s > since_s && matches!(f.phase, Phase::Pouring | Phase::Recording);
            let noticed_s = f.at_s.max(since_s) + NOTICED_S;
            let stands = f.at_s <= since_s && forbids_runs(&f.what) && f.until_s >= at_s;
            (began_in_it || stands)
                && must_end(&f.what).is_some_and(|s| at_s > noticed_s + s)
                && !(lasts(&f.what) && self.cleared_s.iter().any(|cleared_s| (f.at_s..noticed_s).contains(cleared_s)))
        });
        if let Some(fault) = missed {
            let what = format!("{:?} at {:.2} s has not ended the pour", fault.what, fault.at_s);
            self.violated("noticed", at_s, what);
        }
    }

    /// Whether the arm may move, and the joint is where it was commanded within the longest lag that is believed; a pour whose joint is elsewhere must have ended.
    fn followed(&mut self, at_s: f64) {
        let began_s = self.hindered_since_s.map(|since_s| since_s.max(self.run_since_s)).filter(|_| self.is_active());
        if let Some(began_s) = began_s.filter(|began_s| at_s - began_s > NOTICED_S + SILENT_S) {
            self.violated("noticed", at_s, format!("the arm may not move, or is slowed, since {began_s:.2} s of a pour"));
        }
        let degrees = || self.sent_targets.iter().map(|(_, deg)| *deg);
        let (least, largest) = (degrees().fold(f64::INFINITY, f64::min), degrees().fold(f64::NEG_INFINITY, f64::max));
        let is_there = (least - FOLLOWS_DEG..=largest + FOLLOWS_DEG).contains(&self.alpha_deg);
        if is_there || !self.is_active() {
            self.elsewhere_since_s = None;
        } else if at_s - *self.elsewhere_since_s.get_or_insert(at_s) > NOTICED_S {
            let alpha_deg = self.alpha_deg;
            self.violated("noticed", at_s, format!("the joint is at {alpha_deg:.1} degrees, and {least:.1} to {largest:.1} was commanded"));
        }
    }
}
