//! The cell without the controller: robot, network, vessel, eye, operator and what goes wrong, and the checks that look at all of it.
//!
//! Pure; one thread; allocates. What goes wrong is what is drawn.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rt_controller::core::{Order, Settings};
use serde::Serialize;
use shared::agent::Agent;
use shared::config::Config;
use shared::control::{EndReason, Outcome};
use shared::gaussian_curve::Curve;
use shared::messages::Phase;
use shared::weights::Weights;
use simulator::physics::container::Container;
use simulator::physics::rig::Rig;
use simulator::ur::{Fault, InMemory, Machine, Series};

use crate::check::Checks;
use crate::eye::Eye;
use crate::pipe::{self, End, Wiring};
use crate::plan::{Plan, VESSELS, What};
use crate::records::Row;
use crate::weight_set::TrainedSet;

/// The cell's configuration.
const CONFIG: &str = include_str!("../../config/sim.toml");
/// When virtual time begins, ns: a machine that has been up for a while.
pub const START_NS: u64 = 1_000_000_000;
/// Period of the camera, ns: 30 Hz, a little off the loop's own.
const FRAME_NS: u64 = 33_340_000;
/// Longest step of the liquid, ns: that of the simulated cell.
const PHYSICS_NS: u64 = 4_000_000;
/// Largest ordinary lateness of a tick, ns (docs/REALTIME.md).
const LATENESS_NS: u64 = 150_000;
/// A container nearer to 0 than this is upright, degrees (`robot.start_tolerance_deg` of config/sim.toml).
const UPRIGHT_DEG: f64 = 2.0;

/// The cell's configuration, parsed.
///
/// # Errors
/// The configuration in the source does not parse.
pub fn config() -> Result<Config, String> {
    Config::parse(CONFIG, "config/sim.toml").map_err(|e| e.to_string())
}

/// What a fault during a pour or recording cost.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Cost {
    /// The fault's name.
    pub fault: String,
    /// What left from the fault until the container was upright, ml.
    pub excess_ml: f64,
    /// Time from the fault until the container was upright, s.
    pub upright_s: f64,
}

/// How a pour or recording went.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Poured {
    /// When it ended, s.
    pub at_s: f64,
    /// Why.
    pub reason: EndReason,
    /// The goal, ml.
    pub goal_ml: Option<f32>,
    /// What was believed, ml.
    pub believed_ml: f32,
    /// What left, ml.
    pub true_ml: f64,
    /// Number of faults while it went on or in the 6 s before.
    pub faults: usize,
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
    open_faults: Vec<(String, f64, f64)>,
    /// Whether the newest pour or recording came to its ordinary end, in spite of what happened in it.
    went_on: bool,
    /// What faults cost.
    pub costs: Vec<Cost>,
    /// How pours and recordings went.
    pub poured: Vec<Poured>,
    /// What happened, in words; `None` if nobody wants it.
    pub story: Option<Vec<String>>,
    /// One row for each tick; `None` if nobody wants them.
    pub rows: Option<Vec<Row>>,
}

impl Site {
    /// The cell of a plan. `wanted` keeps the story and the rows.
    pub fn new(plan: &Plan, trained: &TrainedSet, config: &Config, wanted: bool) -> Self {
        let series = plan.series;
        let joint = config.robot.joint.index();
        let right = std::f64::consts::FRAC_PI_2;
        let machine = Machine::new(series, series.default_version(), [0.0, -right, right, -right, -right, 0.0]);
        let rig = rig(plan);
        let cycle_ns = (1e9 / series.rate_hz()) as u64;
        let mut random = Pcg64Mcg::seed_from_u64(plan.seed ^ 0x517E);
        let frame_at_ns = START_NS + random.random_range(0..FRAME_NS);
        Self {
            now_ns: START_NS,
            robot: InMemory::new(machine),
            wiring: Wiring::new(plan.seed, plan.delay_ns.0, plan.delay_ns.1),
            container: rig.container(plan.fill_ml),
            eye: Eye::new(plan.seed, START_NS),
            checks: Checks::new(Settings::new(config), cycle_ns as f64 / 1e9),
            trained: trained.clone(),
            random,
            joint,
            cycle_ns,
            cycle_at_ns: START_NS + cycle_ns,
            liquid_at_ns: START_NS,
            frame_at_ns,
            frame_poured_ml: 0.0,
            run_poured_ml: 0.0,
            next_item: 0,
            episode: 0,
            offline_until_ns: 0,
            controller_frozen_until_ns: 0,
            lateness_ns: 0,
            restart_at_ns: None,
            new_agent: None,
            new_weights: None,
            is_disk_full: false,
            open_faults: Vec::new(),
            went_on: false,
            costs: Vec::new(),
            poured: Vec::new(),
            story: wanted.then(Vec::new),
            rows: wanted.then(Vec::new),
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

    /// Adds a row.
    pub fn row(&mut self, row: Row) {
        if let Some(rows) = &mut self.rows {
            rows.push(row);
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
            let what = self.plan.items[self.next_item].what.clone();
            self.next_item += 1;
            return self.happen(&what).into_iter().collect();
        }
        if self.now_ns >= self.cycle_at_ns {
            self.cycle();
        } else if self.now_ns >= self.frame_at_ns {
            self.frame_at_ns += FRAME_NS;
            let poured_ml = self.container.poured_ml();
            self.eye.frame(self.now_ns, poured_ml - self.frame_poured_ml);
            self.frame_poured_ml = poured_ml;
        }
        Vec::new()
    }

    /// A control cycle of the robot.
    fn cycle(&mut self) {
        self.cycle_at_ns += self.cycle_ns;
        self.robot.serve();
        for line in self.robot.cycle() {
            self.say(|| format!("robot: {}", line.text));
        }
        let alpha_deg = self.robot.machine().robot.servo.actual_q[self.joint].to_degrees();
        if self.now_ns >= self.liquid_at_ns + PHYSICS_NS {
            self.container.step((self.now_ns - self.liquid_at_ns) as f64 / 1e9, alpha_deg);
            self.liquid_at_ns = self.now_ns;
        }
        let at_s = self.now_s();
        self.checks.cycle(self.robot.machine(), self.joint, alpha_deg, at_s);
        let active = matches!(self.checks.phase, Phase::Pouring | Phase::Recording);
        if !active && alpha_deg.abs() < UPRIGHT_DEG && std::mem::take(&mut self.went_on) {
            self.open_faults.clear();
        }
        if !active && alpha_deg.abs() < UPRIGHT_DEG && self.checks.phase != Phase::Settling && !self.open_faults.is_empty() {
            let poured_ml = self.container.poured_ml();
            for (fault, from_s, from_ml) in self.open_faults.drain(..) {
                self.costs.push(Cost { fault, excess_ml: poured_ml - from_ml, upright_s: at_s - from_s });
            }
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

    /// A pour or recording ended.
    pub fn ended(&mut self, outcome: &Outcome) {
        let at_s = self.now_s();
        self.say(|| format!("ended: {:?}, {:.1} ml believed", outcome.reason, outcome.poured_ml));
        self.checks.ended(outcome, at_s);
        self.went_on = matches!(outcome.reason, EndReason::Done | EndReason::ContainerEmpty | EndReason::StreamLost | EndReason::MaxFrames);
        let true_ml = self.container.poured_ml() - self.run_poured_ml;
        self.run_poured_ml = self.container.poured_ml();
        let since_s = at_s - f64::from(outcome.seconds) - 6.0;
        let faults = self.checks.faults.iter().filter(|f| f.at_s >= since_s).count();
        let (reason, goal_ml, believed_ml) = (outcome.reason, outcome.goal_ml, outcome.poured_ml);
        self.poured.push(Poured { at_s, reason, goal_ml, believed_ml, true_ml, faults });
    }

    /// Gives the loop an agent with the weights for the vessel of this number.
    pub fn give_weights(&mut self, vessel: usize) {
        if let Some(weights) = self.trained.get(self.plan.series, vessel) {
            self.new_agent = Some((weights.id(), Box::new(Agent::new(weights))));
            self.new_weights = Some(weights.clone());
        }
    }

    /// Gives a starting controller the weights that lie on its disk.
    pub fn controller_starts(&mut self) {
        self.restart_at_ns = None;
        self.give_weights(self.plan.vessel);
        self.checks.controller_started();
    }

    /// Lets `what` happen. Gives the operator's order, if it is one.
    fn happen(&mut self, what: &What) -> Option<Option<Order>> {
        let (at_s, poured_ml, ms) = (self.now_s(), self.container.poured_ml(), 1_000_000);
        self.say(|| format!("{what:?}"));
        self.checks.happens(what, at_s, poured_ml);
        if !what.is_ordinary() && matches!(self.checks.phase, Phase::Pouring | Phase::Recording) {
            self.open_faults.push((what.name(), at_s, poured_ml));
        }
        match what {
            What::Pour(goal_ml) => {
                self.episode += 1;
                return Some(Some(Order::Pour { episode: self.episode, goal_ml: *goal_ml, flows_by_deg: None }));
            }
            What::Record(lambda_deg, width_s) => {
                self.episode += 1;
                let gamma_per_s2 = 1.0 / (2.0 * width_s * width_s);
                let beta_s = ((lambda_deg / 0.05).ln() / gamma_per_s2).sqrt();
                let curve = Curve { lambda_deg: *lambda_deg, gamma_per_s2, beta_s };
                return Some(Some(Order::Record { episode: self.episode, curve }));
            }
            What::Abort => return Some(Some(Order::Abort)),
            What::Resume => return Some(None),
            What::Refill(fill_ml) => {
                // Nobody fills a vessel that is tilted or poured from.
                if self.checks.phase == Phase::Idle {
                    self.container = self.rig.container(*fill_ml);
                    (self.frame_poured_ml, self.run_poured_ml) = (0.0, 0.0);
                }
            }
            What::Robot(fault) => {
                if let Fault::Offline(s) = fault {
                    self.offline_until_ns = self.now_ns + (s * 1e9) as u64;
                }
                self.robot.inject(fault);
            }
            What::LinkStall(time) => self.wiring.stall(u64::from(*time) * ms),
            What::LinkSplit(time) => self.wiring.split(u64::from(*time) * ms),
            What::LinkCut => self.wiring.cut(),
            What::Eye(fault) => self.eye.inject(*fault, self.now_ns),
            What::Overrun(time) => self.lateness_ns = u64::from(*time) * ms,
            What::Suspended(time) => self.controller_frozen_until_ns = self.now_ns + u64::from(*time) * ms,
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

    /// A damaged weight file must be refused.
    fn offer_bad_weights(&mut self) {
        let Some(mut bytes) = self.trained.get(self.plan.series, self.plan.vessel).and_then(|w| w.to_bytes().ok()) else { return };
        let at = self.random.random_range(0..bytes.len());
        bytes[at] ^= 1 << self.random.random_range(0..8u8);
        if Weights::from_bytes(&bytes, "weights.bin").is_ok() {
            let at_s = self.now_s();
            self.checks.violated("bad-weights", at_s, format!("a weight file with byte {at} changed was taken"));
        }
    }
}

/// The rig of a plan.
fn rig(plan: &Plan) -> Rig {
    let rig = Rig::seeded(plan.rig_seed);
    rig.clone().with_container(VESSELS[plan.vessel]).unwrap_or(rig)
}

/// The tilt at which `fill_ml` starts to flow from a vessel, degrees.
pub fn spill_angle_deg(series: Series, vessel: usize, fill_ml: f64) -> f64 {
    rig(&Plan::recording(series, vessel, fill_ml, 50.0, 1.0)).container(fill_ml).spill_angle_deg()
}
