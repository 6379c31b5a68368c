//! What a seed draws: the robot, the vessel and its liquid, the orders, and the faults with their times.
//!
//! Pure; allocates; cannot fail. The same seed gives the same plan. The probabilities of the faults are drawn first, with large
//! differences, so that some seeds draw one rare fault again and again.

use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use serde::Serialize;
use shared::config::Joint;
use simulator::ur::{Fault, Series};

/// The vessels, by the names of [`simulator::physics::rig::Rig::with_container`].
pub const VESSELS: [&str; 5] = ["cylinder", "cone-in", "cone-out", "bottle", "jug"];
/// How long a cell runs after its last order and fault, s: the longest way upright and the wait for the last drops, twice.
const REST_S: f64 = 12.0;

/// What the worker or its camera does wrong.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub enum EyeFault {
    /// This many frames are lost.
    Loss(u32),
    /// The camera repeats its picture for this many frames, and the worker says so.
    Freeze(u32),
    /// Each of this many measurements comes twice.
    Duplicate(u32),
    /// Two measurements come in the wrong order.
    Reorder,
    /// Measurements come later by so many ms, for two seconds.
    Late(u32),
    /// The gain drifts by this share within two seconds.
    GainDrift(f64),
    /// A stream reads 0 without a doubt for this many frames.
    FalseZero(u32),
    /// One frame reads this area, px^2.
    Spike(f32),
    /// The area stands still for this many frames.
    Stuck(u32),
    /// The worker is gone for so many ms and comes back as a new process.
    Killed(u32),
    /// The worker measures nothing for so many ms.
    Hung(u32),
    /// A second worker measures too, for so many ms.
    Two(u32),
}

/// One thing that happens.
#[derive(Debug, Clone, PartialEq)]
pub enum What {
    /// The operator orders a pour of so many ml.
    Pour(f32),
    /// The operator orders the curve of eq. (1): lambda in degrees, width in s.
    Record(f32, f32),
    /// The operator aborts.
    Abort,
    /// The operator asks for the robot.
    Resume,
    /// The vessel is filled again, ml.
    Refill(f64),
    /// Something happens at the robot.
    Robot(Fault),
    /// Nothing arrives at either side for so many ms.
    LinkStall(u32),
    /// What is sent arrives in pieces for so many ms.
    LinkSplit(u32),
    /// All connections are reset.
    LinkCut,
    /// Something happens to the eye.
    Eye(EyeFault),
    /// The loop's next tick is late by so many ms.
    Overrun(u32),
    /// The controller's process stands still for so many ms.
    Suspended(u32),
    /// The controller is killed, and started again after so many ms.
    ControllerKilled(u32),
    /// A good weight file comes: those for the vessel of this number.
    Weights(usize),
    /// A damaged weight file comes.
    BadWeights,
    /// The disk is full from now on.
    DiskFull,
}

impl What {
    /// Whether it is a part of the ordinary course, and not a fault.
    pub fn is_ordinary(&self) -> bool {
        matches!(self, Self::Pour(_) | Self::Record(..) | Self::Refill(_) | Self::Resume) || matches!(self, Self::Robot(f) if is_remedy(f))
    }

    /// The fault's name in tables.
    pub fn name(&self) -> String {
        let text = match self {
            Self::Robot(fault) => format!("robot {fault}"),
            Self::Eye(fault) => format!("eye {fault:?}"),
            what => format!("{what:?}"),
        };
        text.split(['(', '=']).next().unwrap_or_default().to_lowercase()
    }
}

/// Whether a person sets something right with it.
fn is_remedy(fault: &Fault) -> bool {
    matches!(
        fault,
        Fault::Clear
            | Fault::EmergencyRelease
            | Fault::BrakeRelease
            | Fault::UnlockProtectiveStop
            | Fault::FreedriveEnd
            | Fault::RemoteControl
    ) || matches!(fault, Fault::SpeedSlider(share) if *share >= 1.0)
}

/// One thing that happens, and when.
#[derive(Debug, Clone, PartialEq)]
pub struct Item {
    /// Time since the start, ms.
    pub at_ms: u64,
    /// What happens.
    pub what: What,
    /// Number of the fault to which it belongs, so that its remedy goes with it; ordinary items have none.
    pub fault: Option<usize>,
}

/// Everything that a seed draws.
#[derive(Debug, Clone, PartialEq)]
pub struct Plan {
    /// The seed.
    pub seed: u64,
    /// The robot's generation.
    pub series: Series,
    /// Index into [`VESSELS`].
    pub vessel: usize,
    /// The seed of the vessel's rig; the weights are trained on it.
    pub rig_seed: u64,
    /// Volume in the vessel, ml.
    pub fill_ml: f64,
    /// Delay of the network, ns, and how much more it is at most.
    pub delay_ns: (u64, u64),
    /// What happens, in order.
    pub items: Vec<Item>,
    /// Number of faults.
    pub faults: usize,
    /// When the cell stops, ms.
    pub until_ms: u64,
}

impl Plan {
    /// The plan that `seed` draws.
    pub fn draw(seed: u64) -> Self {
        let mut random = Pcg64Mcg::seed_from_u64(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x5eed);
        let series = if random.random_bool(0.25) { Series::ESeries } else { Series::Cb3 };
        let vessel = random.random_range(0..VESSELS.len());
        let almost_empty = random.random_bool(0.05);
        let fill_ml = if almost_empty { random.random_range(5.0..60.0) } else { random.random_range(150.0..450.0) };
        let delay_ns = (random.random_range(20_000..500_000), random.random_range(0..1_500_000));
        let mut plan = Self { seed, series, vessel, rig_seed: 0, fill_ml, delay_ns, items: Vec::new(), faults: 0, until_ms: 0 };
        let mut at_ms = 2_500 + random.random_range(0..1_000u64);
        for _ in 0..random.random_range(1..=2) {
            let what = if random.random_bool(0.8) { What::Pour(goal_ml(&mut random)) } else { curve(&mut random) };
            plan.push(at_ms, what, None);
            let faults = if random.random_bool(0.1) { 0 } else { random.random_range(1..=4) };
            plan.draw_faults(&mut random, at_ms, faults);
            at_ms += random.random_range(14_000..22_000);
            plan.push(at_ms - 1_500, What::Refill(random.random_range(150.0..450.0)), None);
            plan.push(at_ms - 1_400, What::Resume, None);
        }
        plan.finish();
        plan
    }

    /// A cell without faults, in which a curve is recorded.
    pub fn recording(series: Series, vessel: usize, fill_ml: f64, lambda_deg: f32, width_s: f32) -> Self {
        let items = vec![Item { at_ms: 3_000, what: What::Record(lambda_deg, width_s), fault: None }];
        let seed = u64::from(lambda_deg.to_bits());
        let mut plan = Self { seed, series, vessel, rig_seed: 0, fill_ml, delay_ns: (100_000, 0), items, faults: 0, until_ms: 0 };
        plan.finish();
        plan
    }

    fn push(&mut self, at_ms: u64, what: What, fault: Option<usize>) {
        self.items.push(Item { at_ms, what, fault });
    }

    fn finish(&mut self) {
        self.items.sort_by_key(|item| item.at_ms);
        let last_ms = self.items.last().map_or(0, |item| item.at_ms);
        self.until_ms = last_ms + (REST_S * 1000.0) as u64;
    }

    /// Draws `faults` faults around the order at `from_ms`.
    fn draw_faults(&mut self, random: &mut Pcg64Mcg, from_ms: u64, faults: usize) {
        let mut weights = [0.0f64; KINDS];
        for weight in &mut weights {
            let normal: f64 = StandardNormal.sample(random);
            *weight = (1.5 * normal).exp();
        }
        for _ in 0..faults {
            let mut at = random.random_range(0.0..weights.iter().sum::<f64>());
            let kind = weights.iter().position(|w| {
                at -= w;
                at < 0.0
            });
            let at_ms = (from_ms + random.random_range(0..9_000)).saturating_sub(600);
            let number = self.faults;
            self.faults += 1;
            for (later_ms, what) in fault(kind.unwrap_or(0), random) {
                self.push(at_ms + later_ms, what, Some(number));
            }
        }
    }

    /// The same plan with only these faults.
    pub fn keep(&self, faults: &[usize]) -> Self {
        let mut plan = self.clone();
        plan.items.retain(|item| item.fault.is_none_or(|number| faults.contains(&number)));
        plan
    }
}

/// A goal, ml: mostly an ordinary one, sometimes at or beyond its bounds.
fn goal_ml(random: &mut Pcg64Mcg) -> f32 {
    if random.random_bool(0.08) {
        let odd = [0.0, -5.0, 1e-3, 0.5, 300.0, 300.1, 1e9, f32::NAN, f32::INFINITY];
        return odd[random.random_range(0..odd.len())];
    }
    random.random_range(15.0..200.0)
}

/// A curve: mostly a legal one.
fn curve(random: &mut Pcg64Mcg) -> What {
    let lambda_deg = if random.random_bool(0.1) { random.random_range(100.0..140.0) } else { random.random_range(40.0..95.0) };
    What::Record(lambda_deg, random.random_range(0.7..2.2))
}

/// Number of kinds of faults in [`fault`].
const KINDS: usize = 37;

/// A fault of the kind with this number: what happens, and how many ms after its begin.
fn fault(kind: usize, random: &mut Pcg64Mcg) -> Vec<(u64, What)> {
    let robot = |first: Fault, later_ms: u64, then: Fault| vec![(0, What::Robot(first)), (later_ms, What::Robot(then))];
    let later_ms = random.random_range(300..9_000);
    let s = random.random_range(0.02..1.0) * random.random_range(0.1..3.0f64);
    let frames = random.random_range(1..20);
    let eye = |what| vec![(0, What::Eye(what))];
    match kind {
        0 => robot(Fault::ProtectiveStop, 5_500 + later_ms, Fault::UnlockProtectiveStop),
        1 => robot(Fault::EmergencyStop, later_ms, Fault::EmergencyRelease)
            .into_iter()
            .chain([(later_ms + 300, What::Robot(Fault::BrakeRelease))])
            .collect(),
        2 => robot(Fault::ProgramPause, later_ms, Fault::ProgramResume),
        3 => vec![(0, What::Robot(Fault::ProgramStop))],
        4 => robot(Fault::SpeedSlider(random.random_range(0.01..0.99)), later_ms, Fault::SpeedSlider(1.0)),
        5 => robot(Fault::TimeScaling(random.random_range(0.05..0.9)), later_ms, Fault::Clear),
        6 => robot(Fault::HeldBack(random.random_range(1.0..60.0)), later_ms, Fault::Clear),
        7 => robot(Fault::JointSpeedLimit(random.random_range(5.0..60.0)), later_ms, Fault::Clear),
        8 => robot(Fault::Freedrive, later_ms, Fault::FreedriveEnd),
        9 => vec![
            (0, What::Robot(Fault::ProgramPause)),
            (800, What::Robot(Fault::Jog(Joint::Base, random.random_range(-25.0..25.0)))),
            (800 + later_ms, What::Robot(Fault::ProgramResume)),
        ],
        10 => vec![(0, What::Robot(Fault::Boot)), (later_ms, What::Robot(Fault::BrakeRelease))],
        11 => vec![(0, What::Robot(Fault::Fin))],
        12 => vec![(0, What::LinkCut)],
        13 => vec![(0, What::Robot(Fault::Offline(4.0 * s)))],
        14 => vec![(0, What::Robot(Fault::Stall(s)))],
        15 => vec![(0, What::Robot(Fault::Freeze(s)))],
        16 => vec![(0, What::Robot(Fault::SlowReader(s)))],
        17 => vec![(0, What::Robot(Fault::SkipOutputs(random.random_range(1..60))))],
        18 => vec![(0, What::Robot(Fault::Coalesce(s)))],
        19 => vec![(0, What::LinkStall(random.random_range(20..1_500)))],
        20 => vec![(0, What::LinkSplit(random.random_range(20..3_000)))],
        21 => eye(EyeFault::Loss(frames)),
        22 => eye(EyeFault::Freeze(frames)),
        23 => eye(EyeFault::Duplicate(frames)),
        24 => eye(EyeFault::Reorder),
        25 => eye(EyeFault::Late(random.random_range(10..300))),
        26 => eye(EyeFault::GainDrift(random.random_range(-0.3..0.3))),
        27 => eye(EyeFault::FalseZero(frames)),
        28 => eye(EyeFault::Spike(random.random_range(200.0..20_000.0))),
        29 => eye(EyeFault::Stuck(frames)),
        30 => eye(EyeFault::Killed(random.random_range(100..4_000))),
        31 => eye(EyeFault::Hung(random.random_range(50..3_000))),
        32 => eye(EyeFault::Two(random.random_range(100..3_000))),
        33 => vec![(0, What::Overrun(random.random_range(20..400)))],
        34 => vec![(
            0,
            if random.random_bool(0.5) {
                What::Suspended(random.random_range(50..5_000))
            } else {
                What::ControllerKilled(random.random_range(100..4_000))
            },
        )],
        35 => vec![(0, [What::Abort, What::Pour(60.0), What::Resume][random.random_range(0..3)].clone())],
        _ => vec![(
            0,
            [What::BadWeights, What::DiskFull, What::Weights(random.random_range(0..VESSELS.len()))][random.random_range(0..3)].clone(),
        )],
    }
}

impl Plan {
    /// The vessels whose weights the plan needs.
    pub fn vessels(&self) -> Vec<usize> {
        let others = self.items.iter().filter_map(|item| if let What::Weights(vessel) = item.what { Some(vessel) } else { None });
        std::iter::once(self.vessel).chain(others).collect()
    }
}
