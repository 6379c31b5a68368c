//! The cell without the controller: robot, network, vessel, eye, operator and what goes wrong, and the checks that look at all of it.
//!
//! Pure; one thread; allocates. What goes wrong is what is drawn.

use std::io::Write;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rt_controller::core::{Order, Settings};
use rt_controller::journal::Tick;
use shared::agent::Agent;
use shared::config::Config;
use shared::control::{EndReason, Outcome};
use shared::messages::{Phase, Telemetry};
use shared::weights::Weights;
use simulator::camera::Scene;
use simulator::physics::container::Container;
use simulator::physics::rig::Rig;
use simulator::ur::{Fault, InMemory, Machine};

use crate::bound::Moment;
use crate::camera::{Camera, Depth, picture_name};
use crate::check::Checks;
use crate::costs::{Costs, Poured};
use crate::eye::Eye;
use crate::faults::KINDS;
use crate::noticing::takes_s;
use crate::pipe::{self, End, Wiring};
use crate::plan::{Item, Plan};
use crate::records::Row;
use crate::standing::Standing;
use crate::undisturbed;
use crate::vessels;
use crate::weight_set::{Lesson, TrainedSet, episode};
use crate::what::{EyeFault, Weighed, What, curve};

/// The cell's configuration.
const CONFIG: &str = include_str!("../../config/sim.toml");
/// When virtual time begins, ns: a machine that has been up for a while.
pub const START_NS: u64 = 1_000_000_000;
/// Period of the camera, ns: 30 Hz, a little off the loop's own.
const FRAME_NS: u64 = 33_340_000;
/// An arm that lags by more than this may be called one that does not follow, s: the controller's window is 72 ms longer than the lag that it expects of
/// servo and program together, of which this is [`simulator::ur::servo::LAG_S`] (docs/ROBOT.md).
const SLOW_LAG_S: f64 = 0.08;
/// Longest step of the liquid, ns: that of the simulated cell.
const PHYSICS_NS: u64 = 4_000_000;
/// Largest ordinary lateness of a tick, ns (docs/REALTIME.md).
const LATENESS_NS: u64 = 150_000;
/// What a second client sends when it connects: the protocol's version 2, the outputs that it wants at 125 Hz, an input that it means to write,
/// and the request to start (RTDE guide). It never reads.
const SECOND_CLIENT: &[u8] =
    b"\x00\x05V\x00\x02\x00\x1dO\x40\x5f\x40\x00\x00\x00\x00\x00timestamp,actual_q\x00\x18Iinput_int_register_24\x00\x03S";
/// The port of RTDE.
const RTDE_PORT: u16 = 30004;

/// The cell's configuration, parsed.
///
/// # Errors
/// The configuration in the source does not parse.
pub fn config() -> Result<Config, String> {
    Config::parse(CONFIG, "config/sim.toml").map_err(|e| e.to_string())
}

/// The cell without the controller.
pub struct Site {
    plan: Plan,
    /// The present time, ns.
    pub now_ns: u64,
    robot: InMemory<End>,
    wiring: Wiring,
    /// The vessel.
    pub container: Container,
    rig: Rig,
    /// The eye.
    pub eye: Eye,
    /// The checks.
    pub checks: Checks,
    trained: TrainedSet,
    random: Pcg64Mcg,
    joint: usize,
    cycle_ns: u64,
    cycle_at_ns: u64,
    liquid_at_ns: u64,
    frame_at_ns: u64,
    frame_poured_ml: f64,
    run_poured_ml: f64,
    /// What the vessel could give when the newest run began, ml.
    givable_ml: f64,
    /// The newest run is a pour, and no recording.
    is_pour: bool,
    next_item: usize,
    episode: u64,
    offline_until_ns: u64,
    /// The controller's process stands still until then, ns.
    pub controller_frozen_until_ns: u64,
    /// How late the loop's next tick is, ns.
    pub lateness_ns: u64,
    /// When the controller starts again, if it was killed, ns.
    pub restart_at_ns: Option<u64>,
    /// An agent that the loop is to get.
    pub new_agent: Option<(u64, Box<Agent>)>,
    /// The weights of that agent.
    pub new_weights: Option<Weights>,
    /// Whether the disk is full.
    pub is_disk_full: bool,
    /// The numbers of the faults that have begun.
    begun: Vec<usize>,
    /// Which of them a pour has had.
    standing: Standing,
    /// What faults cost.
    pub costs: Costs,
    /// The connections of other clients of the robot, and until when they stay, ns.
    second_clients: Vec<(u64, End)>,
    /// How pours and recordings went.
    pub poured: Vec<Poured>,
    /// What happened, in words; `None` if nobody wants it.
    pub story: Option<Vec<String>>,
    /// One row for each tick; `None` if nobody wants them.
    pub rows: Option<Vec<Row>>,
}

impl Site {
    /// The cell of a plan, checked against the limits of `checked`. `wanted` keeps the story and the rows.
    pub fn new(plan: &Plan, trained: &TrainedSet, checked: &Config, wanted: bool) -> Self {
        let series = plan.series;
        let joint = checked.robot.joint.index();
        let right = std::f64::consts::FRAC_PI_2;
        let mut machine = Machine::new(series, series.default_version(), [0.0, -right, right, -right, -right, 0.0]);
        machine.robot.servo.lag_s = plan.lag_s;
        let (rig, mut container) = vessels::rig(plan.vessel);
        let cycle_ns = (1e9 / series.rate_hz()) as u64;
        let mut random = Pcg64Mcg::seed_from_u64(plan.seed ^ 0x517E);
        let frame_at_ns = START_NS + random.random_range(0..FRAME_NS);
        vessels::fill(&rig, &mut container, plan.fill_ml, &mut random);
        let mut checks = Checks::new(Settings::new(checked), cycle_ns as f64 / 1e9);
        checks.is_slow = plan.lag_s > SLOW_LAG_S;
        let camera = match plan.depth {
            Depth::Area => None,
            Depth::Camera => {
                let made = Camera::new(checked, plan.seed, plan.picture);
                // Without it the areas would be made of flows, and look like measured ones.
                made.map_err(|line| checks.violated("camera", 0.0, line)).ok()
            }
        };
        if let Some(fault) = plan.picture {
            checks.happens(&What::Eye(EyeFault::Picture(fault.kind)), &machine, true, (0.0, 0.0));
        }
        // What is learned from needs the rows.
        let learns = plan.items.iter().any(|item| matches!(item.what, What::Learn(_)));
        Self {
            now_ns: START_NS,
            robot: InMemory::new(machine),
            wiring: Wiring::new(plan.seed, plan.delay_ns.0, plan.delay_ns.1),
            container,
            eye: Eye::new(plan.seed, START_NS, rig.area_exponent, camera),
            checks,
            trained: trained.clone(),
            random,
            joint,
            cycle_ns,
            cycle_at_ns: START_NS + cycle_ns,
            liquid_at_ns: START_NS,
            frame_at_ns,
            frame_poured_ml: 0.0,
            run_poured_ml: 0.0,
            givable_ml: 0.0,
            is_pour: true,
            next_item: 0,
            episode: 0,
            offline_until_ns: 0,
            controller_frozen_until_ns: 0,
            lateness_ns: 0,
            restart_at_ns: None,
            new_agent: None,
            new_weights: None,
            is_disk_full: false,
            begun: Vec::new(),
            standing: Standing::default(),
            costs: Costs::default(),
            second_clients: Vec::new(),
            poured: Vec::new(),
            story: wanted.then(Vec::new),
            rows: (wanted || learns).then(Vec::new),
            rig,
            plan: plan.clone(),
        }
    }

    /// The present time, s since the start.
    pub fn now_s(&self) -> f64 {
        (self.now_ns - START_NS) as f64 / 1e9
    }

    /// Sets the present time.
    pub fn set_now(&mut self, now_ns: u64) {
        self.now_ns = self.now_ns.max(now_ns);
        self.wiring.set_now(self.now_ns);
    }

    /// Whether the plan is done, or the controller was killed.
    pub fn is_over(&self) -> bool {
        self.is_done() || self.restart_at_ns.is_some()
    }

    /// Whether the plan is done.
    pub fn is_done(&self) -> bool {
        self.now_ns >= START_NS + self.plan.until_ms * 1_000_000
    }

    /// Adds to the story.
    pub fn say(&mut self, text: impl FnOnce() -> String) {
        let at_s = self.now_s();
        if let Some(story) = &mut self.story {
            story.push(format!("{at_s:8.3} s  {}", text()));
        }
    }

    /// When the next thing happens, ns.
    pub fn next_ns(&self) -> u64 {
        let end_ns = START_NS + self.plan.until_ms * 1_000_000;
        self.cycle_at_ns.min(self.frame_at_ns).min(self.item_at_ns()).min(end_ns)
    }

    fn item_at_ns(&self) -> u64 {
        self.plan.items.get(self.next_item).map_or(u64::MAX, |item| START_NS + item.at_ms * 1_000_000)
    }

    /// Draws the lateness of the loop's next tick.
    pub fn woke_up(&mut self) {
        self.lateness_ns = self.random.random_range(0..LATENESS_NS);
    }

    /// Lets what is due happen. Gives the orders that the operator gives; `None` asks for the robot only.
    pub fn step(&mut self) -> Vec<Option<Order>> {
        if self.now_ns >= self.item_at_ns() {
            let item = self.plan.items[self.next_item].clone();
            self.next_item += 1;
            let remedied_s = self.remedied_s(&item);
            if let Some(number) = item.fault {
                self.fault_begins(number, &item.what, remedied_s);
            }
            return self.happen(&item.what, remedied_s).into_iter().collect();
        }
        if self.now_ns >= self.cycle_at_ns {
            self.cycle();
        } else if self.now_ns >= self.frame_at_ns {
            self.frame_at_ns += FRAME_NS;
            let poured_ml = self.container.poured_ml();
            let clinging = self.container.habits().clinging(self.container.lip().flow_ml_s);
            let servo = &self.robot.machine().robot.servo;
            let tilt = (servo.actual_q[self.joint].to_degrees(), servo.actual_qd[self.joint].to_degrees());
            let scene = Scene::of(&self.container, self.now_s(), tilt.0, tilt.1);
            let left_ml = poured_ml - self.frame_poured_ml;
            self.eye.frame(self.now_ns, left_ml, clinging, &scene);
            self.frame_poured_ml = poured_ml;
            let (gain, hidden_ml) = self.eye.unshown();
            if self.eye.has_measured() {
                self.checks.unshown.frame(gain, left_ml, hidden_ml);
            } else {
                self.checks.unshown.frame_without_measurement(gain, left_ml);
            }
        }
        Vec::new()
    }

    /// When the last happens of what an item belongs to, s: somebody sets it right then.
    fn remedied_s(&self, item: &Item) -> f64 {
        let of_it = self.plan.items.iter().filter(|other| item.fault.is_some() && other.fault == item.fault);
        of_it.map(|other| other.at_ms).fold(item.at_ms, u64::max) as f64 / 1000.0
    }

    /// A control cycle of the robot.
    fn cycle(&mut self) {
        self.cycle_at_ns += self.cycle_ns;
        let now_ns = self.now_ns;
        self.second_clients.retain(|(until_ns, _)| now_ns < *until_ns);
        self.robot.serve();
        for line in self.robot.cycle() {
            if line.text.ends_with(" started") {
                let at_s = self.now_s();
                self.checks.program_started(at_s);
            }
            self.say(|| format!("robot: {}", line.text));
        }
        let alpha_deg = self.robot.machine().robot.servo.actual_q[self.joint].to_degrees();
        if self.now_ns >= self.liquid_at_ns + PHYSICS_NS {
            self.container.step((self.now_ns - self.liquid_at_ns) as f64 / 1e9, alpha_deg);
            self.liquid_at_ns = self.now_ns;
        }
        let at_s = self.now_s();
        self.checks.cycle(self.robot.machine(), self.joint, alpha_deg, at_s);
        let (target, lag_s) = (self.checks.target(at_s), self.plan.lag_s);
        let return_deg_s = f64::from(self.checks.limits().return_rate_deg_s);
        let now = Moment { container: &self.container, alpha_deg, target, lag_s, return_deg_s, at_s };
        if let Some(wrong) = self.costs.settle(self.checks.phase(at_s), &now) {
            self.checks.violated("bound", at_s, wrong);
        }
    }

    /// A connection to the robot's `port`; `None` if nobody is there who could refuse.
    pub fn open(&mut self, port: u16) -> Option<std::io::Result<End>> {
        if self.now_ns < self.offline_until_ns {
            return None;
        }
        if !self.robot.listens(port) {
            return Some(Err(pipe::refused()));
        }
        let (ours, theirs) = self.wiring.connect();
        self.robot.connect(port, theirs);
        Some(Ok(ours))
    }

    /// The loop has ticked.
    pub fn ticked(&mut self, tick: &Tick, telemetry: &Telemetry, features: u64) {
        let (at_s, before) = (self.now_s(), self.checks.phase);
        self.checks.tick(tick, telemetry, features, at_s);
        let runs = |phase| matches!(phase, Phase::Pouring | Phase::Recording);
        let phase = self.checks.phase;
        if runs(phase) && !runs(before) {
            self.run_poured_ml = self.container.poured_ml();
            let stays_ml = self.container.retained_ml(self.checks.limits().alpha_max_deg.into());
            self.givable_ml = (self.container.volume_ml() - stays_ml).max(0.0);
            self.is_pour = phase == Phase::Pouring;
        }
        let row = Row::new(at_s, tick, telemetry, &self.container);
        if let Some(rows) = &mut self.rows {
            rows.push(row);
        }
    }

    /// A pour or recording ended.
    pub fn ended(&mut self, outcome: &Outcome) {
        let at_s = self.now_s();
        self.say(|| format!("ended: {:?}, {:.1} ml believed", outcome.reason, outcome.poured_ml));
        let true_ml = self.container.poured_ml() - self.run_poured_ml;
        self.checks.ended(outcome, true_ml, at_s);
        self.costs.ended(outcome.reason, self.checks.stood_before(outcome.reason));
        let pictures = self.plan.picture.map(|fault| picture_name(fault.kind));
        let faults = pictures.into_iter().chain(self.standing.of_run(at_s - f64::from(outcome.seconds))).collect();
        let (reason, goal_ml, believed_ml) = (outcome.reason, outcome.goal_ml, outcome.poured_ml);
        let (seconds, sd_ml, givable_ml) = (f64::from(outcome.seconds), outcome.poured_sd_ml, self.givable_ml);
        let poured = Poured { at_s, seconds, reason, goal_ml, givable_ml, believed_ml, sd_ml, true_ml, faults };
        if let Some(wrong) = undisturbed::wrong(&self.plan, &poured) {
            self.checks.violated("undisturbed", at_s, wrong);
        }
        self.poured.push(poured);
    }

    /// Gives the loop an agent with the weights for the vessel of this number.
    pub fn give_weights(&mut self, vessel: usize) {
        let wrong = (vessel != self.plan.vessel).then_some("weights-of-another-vessel");
        self.standing.weights(wrong, self.now_s());
        if let Some(lesson) = self.trained.get((self.plan.series, self.plan.depth), vessel) {
            let lesson = lesson.clone();
            self.take_weights(lesson);
        }
    }

    fn take_weights(&mut self, lesson: Lesson) {
        self.new_agent = Some((lesson.weights.id(), Box::new(lesson.agent)));
        self.new_weights = Some(lesson.weights);
    }

    /// The operator weighs what the newest recording left, and trains on it and the episodes from before. A weight that the trainer doubts
    /// is not used, as `trainer train` says.
    fn learn(&mut self, weighed: Weighed) {
        let Some(before) = self.trained.get((self.plan.series, self.plan.depth), self.plan.vessel).map(|lesson| lesson.episodes.to_vec())
        else {
            return;
        };
        let Some(last) = self.poured.last().filter(|p| p.goal_ml.is_none() && p.reason == EndReason::Done) else { return };
        let weight_g = match weighed {
            Weighed::Right => last.true_ml,
            Weighed::Mistyped(factor) => factor * last.true_ml,
            Weighed::Untared(cup_g) => cup_g + last.true_ml,
        };
        let times = (last.at_s - last.seconds - 0.1, last.at_s);
        let new = episode("the new one", self.rows.as_deref().unwrap_or_default(), times, START_NS as f64 / 1e9, weight_g.round());
        let all: Vec<_> = before.into_iter().chain([new]).filter(|e| e.fault().is_none()).collect();
        let doubtful = trainer::consistency::doubtful(&all);
        self.say(|| format!("learning with {weight_g:.0} g; doubted: {doubtful:?}"));
        let kept = all.into_iter().filter(|e| !doubtful.iter().any(|d| d.name == e.name)).collect();
        let Some(lesson) = Lesson::learn(kept, &self.checks.limits()) else { return };
        // The controller takes what it can read, so a trainer whose weights it refuses leaves the operator without any.
        match lesson.weights.to_bytes().and_then(|bytes| Weights::from_bytes(&bytes, "weights.bin")) {
            Ok(_) => {
                let is_doubtful = weighed != Weighed::Right || !doubtful.is_empty();
                self.standing.weights(is_doubtful.then_some("doubtful-lesson"), self.now_s());
                self.take_weights(lesson);
            }
            Err(e) => {
                let at_s = self.now_s();
                self.checks.violated("trained-weights", at_s, format!("the trainer made weights that are refused: {e}"));
            }
        }
    }

    /// Gives a starting controller the weights that lie on its disk.
    pub fn controller_starts(&mut self) {
        self.restart_at_ns = None;
        self.give_weights(self.plan.vessel);
        self.checks.controller_started();
    }

    /// The fault of this number begins, or goes on.
    fn fault_begins(&mut self, number: usize, what: &What, remedied_s: f64) {
        let (at_s, at_ml) = (self.now_s(), self.container.poured_ml());
        if self.begun.contains(&number) {
            return;
        }
        self.begun.push(number);
        let (kind, until_s) = (KINDS[self.plan.faults[number]], remedied_s.max(at_s + takes_s(what)));
        // Weights count when they are taken.
        if !matches!(what, What::Weights(_)) {
            self.standing.begins(kind.name, until_s);
        }
        self.costs.begins((kind, what), self.checks.phase(at_s), self.is_pour, (at_s, at_ml, until_s));
    }

    /// Lets `what` happen. Gives the operator's order, if it is one.
    fn happen(&mut self, what: &What, remedied_s: f64) -> Option<Option<Order>> {
        let (at_s, ms) = (self.now_s(), 1_000_000);
        self.say(|| format!("{what:?}"));
        let lives = self.restart_at_ns.is_none();
        self.checks.happens(what, self.robot.machine(), lives, (at_s, remedied_s));
        match what {
            What::Pour(goal_ml) => {
                self.episode += 1;
                return Some(Some(Order::Pour { episode: self.episode, goal_ml: *goal_ml, flows_by_deg: None }));
            }
            What::Record(lambda_deg, width_s) => {
                self.episode += 1;
                return Some(Some(Order::Record { episode: self.episode, curve: curve(*lambda_deg, *width_s) }));
            }
            What::Abort => return Some(Some(Order::Abort)),
            What::Resume => return Some(None),
            What::Refill(fill_ml) => {
                // Nobody fills a vessel that is tilted or poured from.
                if self.checks.phase(at_s) == Phase::Idle {
                    vessels::fill(&self.rig, &mut self.container, *fill_ml, &mut self.random);
                    (self.frame_poured_ml, self.run_poured_ml) = (0.0, 0.0);
                }
            }
            What::Robot(fault) => {
                if *fault == Fault::Clear {
                    self.costs.cleared(at_s);
                }
                if let Fault::Offline(s) = fault {
                    // A shorter one does not end a longer one.
                    self.offline_until_ns = self.offline_until_ns.max(self.now_ns + (s * 1e9) as u64);
                }
                self.robot.inject(fault);
            }
            What::Learn(weighed) => self.learn(*weighed),
            What::LinkStall(time) => self.wiring.stall(u64::from(*time) * ms),
            What::LinkSplit(time) => self.wiring.split(u64::from(*time) * ms),
            What::LinkCut => self.wiring.cut(),
            What::SecondClient(time) => self.second_client(u64::from(*time) * ms),
            What::Eye(fault) => self.eye.inject(*fault, self.now_ns),
            What::Overrun(time) => self.lateness_ns = self.lateness_ns.max(u64::from(*time) * ms),
            What::Suspended(time) => {
                self.controller_frozen_until_ns = self.controller_frozen_until_ns.max(self.now_ns + u64::from(*time) * ms);
            }
            What::ControllerKilled(time) => {
                // The kernel closes what the process had open.
                self.wiring.cut();
                self.restart_at_ns = Some(self.now_ns + u64::from(*time) * ms);
            }
            What::Weights(vessel) => self.give_weights(*vessel),
            What::BadWeights => self.offer_bad_weights(),
            What::DiskFull => self.is_disk_full = true,
        }
        None
    }

    /// Somebody else connects to the robot for `time_ns`, asks for what the controller asks for, and never reads what comes.
    fn second_client(&mut self, time_ns: u64) {
        if let Some(Ok(mut end)) = self.open(RTDE_PORT) {
            // Bytes that do not go out are a client that says less.
            let _ = end.write_all(SECOND_CLIENT);
            self.second_clients.push((self.now_ns + time_ns, end));
        }
    }

    /// A damaged weight file must be refused.
    fn offer_bad_weights(&mut self) {
        let Some(mut bytes) =
            self.trained.get((self.plan.series, self.plan.depth), self.plan.vessel).and_then(|l| l.weights.to_bytes().ok())
        else {
            return;
        };
        let at = self.random.random_range(0..bytes.len());
        bytes[at] ^= 1 << self.random.random_range(0..8u8);
        if Weights::from_bytes(&bytes, "weights.bin").is_ok() {
            let at_s = self.now_s();
            self.checks.violated("bad-weights", at_s, format!("a weight file with byte {at} changed was taken"));
        }
    }
}
