//! What a seed draws: the robot, the vessel and its liquid, the orders, and the faults with their times.
//!
//! Pure; allocates; cannot fail. The same seed gives the same plan. The probabilities of the faults are drawn first, with large
//! differences, so that some seeds draw one rare fault again and again.

use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use simulator::camera::faults::{CameraFault, FaultKind};
use simulator::ur::Series;
use simulator::ur::servo::LAG_S;

use crate::camera::{Depth, picture_name};
use crate::faults::{self, KINDS};
use crate::vessels::{VESSELS, spill_angle_deg};
use crate::what::{Weighed, What};

/// How long a cell runs after its last order and fault, and after the last curve, ms: the longest way upright and the wait for the last drops,
/// twice.
const REST_MS: u64 = 12_000;
/// How long after its curve a recording is learned from, ms: it is over by then, unless a fault holds it up.
const WEIGHED_MS: u64 = 7_000;
/// Share of the seeds in which a curve is recorded, learned from, and the weights swapped. Few, because a training takes longer than a pour.
const LESSONS: f64 = 0.003;

/// Share of the seeds whose robot lags by another time than the one that was learned with.
const OTHER_LAGS: f64 = 0.3;
/// From and to which time constant it then lags, s. With servoj's lookahead of 50 ms, and the program's own smoothing, a joint is then late by one
/// to six frames.
const LAGS_S: (f64, f64) = (0.002, 0.12);

/// Share of the seeds before a drawn camera whose pictures have a fault.
const FAULTY_PICTURES: f64 = 0.5;

/// Share of the faults that begin anywhere in the longest run; the others come while most runs go on.
const LATE_FAULTS: f64 = 0.25;
/// How long after its order the longest run ends, ms: some pours of 200 ml of syrup take 18 s.
const LONGEST_RUN_MS: u64 = 18_600;

/// Ordinary goals, ml.
pub const USUAL_GOALS_ML: std::ops::Range<f32> = 15.0..200.0;

/// The one kind of fault that is drawn.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Only {
    /// Once in each pour, one of this kind, as an index into [`KINDS`].
    Kind(usize),
    /// Every picture of a drawn camera has this one, as strong as usual.
    Picture(FaultKind),
}

impl Only {
    /// The fault with this name, before an eye of this depth.
    ///
    /// # Errors
    /// One line with the names that there are, or that pictures have to be drawn.
    pub fn named(name: &str, depth: Depth) -> Result<Self, String> {
        let picture = FaultKind::ALL.into_iter().find(|kind| picture_name(*kind) == name);
        match (picture, depth) {
            (Some(kind), Depth::Camera) => Ok(Self::Picture(kind)),
            (Some(_), Depth::Area) => Err(format!("--only {name} is a fault of pictures, and none are drawn: add --eye camera")),
            (None, _) => faults::named(name)
                .map(Self::Kind)
                .map_err(|line| format!("{line}; and with --eye camera {}", FaultKind::ALL.map(picture_name).join(", "))),
        }
    }
}

/// From what seeds draw.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Choice {
    /// The one fault, and no other; otherwise none to four of all kinds in each pour, and half of the drawn cameras have a fault of their pictures.
    pub only: Option<Only>,
    /// How many of the [`VESSELS`], from the first on. With few of them little is trained.
    pub vessels: usize,
    /// The robot's generation, if not that which a seed draws.
    pub series: Option<Series>,
    /// How deep the eye is.
    pub depth: Depth,
}

impl Default for Choice {
    fn default() -> Self {
        Self { only: None, vessels: VESSELS.len(), series: None, depth: Depth::Area }
    }
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
    /// Index into [`VESSELS`]; the weights are trained on it.
    pub vessel: usize,
    /// Volume in the vessel, ml.
    pub fill_ml: f64,
    /// Delay of the network, ns, and how much more it is at most.
    pub delay_ns: (u64, u64),
    /// Time constant of the joints' lag, s.
    pub lag_s: f64,
    /// How deep the eye is.
    pub depth: Depth,
    /// What is wrong with the camera's pictures, if one is drawn and something is wrong.
    pub picture: Option<CameraFault>,
    /// What happens, in order.
    pub items: Vec<Item>,
    /// The kind of each fault, as an index into [`KINDS`].
    pub faults: Vec<usize>,
    /// When the cell stops, ms.
    pub until_ms: u64,
}

impl Plan {
    /// The plan that `seed` draws.
    pub fn draw(seed: u64) -> Self {
        Self::draw_with(seed, Choice::default())
    }

    /// The plan that `seed` draws from a choice.
    pub fn draw_with(seed: u64, choice: Choice) -> Self {
        let mut random = Pcg64Mcg::seed_from_u64(seed.wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ 0x5eed);
        let drawn = if random.random_bool(0.25) { Series::ESeries } else { Series::Cb3 };
        let series = choice.series.unwrap_or(drawn);
        let vessel = random.random_range(0..choice.vessels.clamp(1, VESSELS.len()));
        let almost_empty = random.random_bool(0.05);
        let fill_ml = if almost_empty { random.random_range(5.0..60.0) } else { random.random_range(150.0..450.0) };
        let delay_ns = (random.random_range(20_000..500_000), random.random_range(0..1_500_000));
        let mut plan = Self {
            seed,
            series,
            vessel,
            fill_ml,
            delay_ns,
            lag_s: lag_s(seed),
            depth: choice.depth,
            picture: if choice.depth == Depth::Camera { picture(seed, choice.only) } else { None },
            items: Vec::new(),
            faults: Vec::new(),
            until_ms: 0,
        };
        let mut at_ms = 2_500 + random.random_range(0..1_000u64);
        let (orders, is_lesson) = (random.random_range(1..=2), random.random_bool(LESSONS));
        if is_lesson {
            at_ms = plan.draw_lesson(&mut random, at_ms);
        }
        for nth in 1..=orders {
            let what = if random.random_bool(0.8) { What::Pour(goal_ml(&mut random)) } else { curve(&mut random) };
            plan.push(at_ms, what, None);
            let faults = if random.random_bool(0.1) { 0 } else { random.random_range(1..=4) };
            match choice.only {
                Some(Only::Kind(kind)) => plan.add_fault(&mut random, at_ms, kind),
                Some(Only::Picture(_)) => (),
                None => plan.draw_faults(&mut random, at_ms, faults),
            }
            at_ms += random.random_range(14_000..22_000);
            if nth < orders {
                plan.push(at_ms - 1_500, What::Refill(random.random_range(150.0..450.0)), None);
                plan.push(at_ms - 1_400, What::Resume, None);
            }
        }
        for item in &mut plan.items {
            if let What::Weights(vessel) = &mut item.what {
                *vessel %= choice.vessels.max(1);
            }
        }
        plan.finish();
        plan
    }

    /// A curve is recorded, weighed, and learned from; then comes what else is drawn, with the new weights. Gives when that begins, ms.
    fn draw_lesson(&mut self, random: &mut Pcg64Mcg, at_ms: u64) -> u64 {
        let spill_deg = spill_angle_deg(self.vessel, self.fill_ml);
        let lambda_deg = (spill_deg + random.random_range(6.0..30.0)).min(105.0) as f32;
        let record = What::Record(lambda_deg, random.random_range(0.7..2.2));
        let weighed_ms = at_ms + record.takes_ms() + WEIGHED_MS;
        self.push(at_ms, record, None);
        let weighed = match random.random_range(0..4) {
            0 => Weighed::Untared(random.random_range(20.0..250.0)),
            1 => Weighed::Mistyped([0.1, 0.5, 1.3, 2.0, 10.0][random.random_range(0..5)]),
            _ => Weighed::Right,
        };
        self.push(weighed_ms, What::Learn(weighed), None);
        self.push(weighed_ms + 500, What::Refill(random.random_range(150.0..450.0)), None);
        weighed_ms + 2_000
    }

    /// A cell without faults, in which a curve is recorded.
    pub fn recording((series, depth): (Series, Depth), vessel: usize, fill_ml: f64, lambda_deg: f32, width_s: f32) -> Self {
        let items = vec![Item { at_ms: 3_000, what: What::Record(lambda_deg, width_s), fault: None }];
        let seed = u64::from(lambda_deg.to_bits());
        let (delay_ns, lag_s, picture, faults, until_ms) = ((100_000, 0), LAG_S, None, Vec::new(), 0);
        let mut plan = Self { seed, series, vessel, fill_ml, delay_ns, lag_s, depth, picture, items, faults, until_ms };
        plan.finish();
        plan
    }

    fn push(&mut self, at_ms: u64, what: What, fault: Option<usize>) {
        self.items.push(Item { at_ms, what, fault });
    }

    fn finish(&mut self) {
        self.items.sort_by_key(|item| item.at_ms);
        let last_ms = self.items.iter().map(|item| item.at_ms + item.what.takes_ms()).max();
        self.until_ms = last_ms.unwrap_or(0) + REST_MS;
    }

    /// Draws `faults` faults around the order at `from_ms`.
    fn draw_faults(&mut self, random: &mut Pcg64Mcg, from_ms: u64, faults: usize) {
        let mut weights = [0.0f64; KINDS.len()];
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
            self.add_fault(random, from_ms, kind.unwrap_or(0));
        }
    }

    /// Draws a fault of a kind around the order at `from_ms`.
    fn add_fault(&mut self, random: &mut Pcg64Mcg, from_ms: u64, kind: usize) {
        let within_ms = if random.random_bool(LATE_FAULTS) { LONGEST_RUN_MS } else { 9_000 };
        let at_ms = (from_ms + random.random_range(0..within_ms)).saturating_sub(600);
        let number = self.faults.len();
        self.faults.push(kind);
        for (later_ms, what) in faults::draw(kind, random) {
            self.push(at_ms + later_ms, what, Some(number));
        }
    }

    /// The same plan with only these faults.
    pub fn keep(&self, faults: &[usize]) -> Self {
        let mut plan = self.clone();
        plan.items.retain(|item| item.fault.is_none_or(|number| faults.contains(&number)));
        plan
    }
}

/// Time constant of a robot's lag, s: mostly the usual one.
fn lag_s(seed: u64) -> f64 {
    let mut random = Pcg64Mcg::seed_from_u64(seed ^ 0x1A6);
    if random.random_bool(OTHER_LAGS) { random.random_range(LAGS_S.0..LAGS_S.1) } else { LAG_S }
}

/// What is wrong with a camera's pictures: one of the faults that people report, as strong as usual, or nothing. The weights were learned with
/// pictures that have none.
fn picture(seed: u64, only: Option<Only>) -> Option<CameraFault> {
    let mut random = Pcg64Mcg::seed_from_u64(seed ^ 0xCA3E7A);
    let drawn = FaultKind::ALL[random.random_range(0..FaultKind::ALL.len())];
    let fault = |kind: FaultKind, seed| CameraFault { kind, strength: kind.usual_strength(), seed };
    let (seed, is_faulty) = (random.random(), random.random_bool(FAULTY_PICTURES));
    match only {
        Some(Only::Picture(kind)) => Some(fault(kind, seed)),
        Some(Only::Kind(_)) => None,
        None => is_faulty.then_some(fault(drawn, seed)),
    }
}

/// A goal, ml: mostly an ordinary one, sometimes at or beyond its bounds.
fn goal_ml(random: &mut Pcg64Mcg) -> f32 {
    if random.random_bool(0.08) {
        let odd = [0.0, -5.0, 1e-3, 0.5, 300.0, 300.1, 1e9, f32::NAN, f32::INFINITY];
        return odd[random.random_range(0..odd.len())];
    }
    random.random_range(USUAL_GOALS_ML)
}

/// A curve: mostly a legal one.
fn curve(random: &mut Pcg64Mcg) -> What {
    let lambda_deg = if random.random_bool(0.1) { random.random_range(100.0..140.0) } else { random.random_range(40.0..95.0) };
    What::Record(lambda_deg, random.random_range(0.7..2.2))
}

impl Plan {
    /// The vessels whose weights the plan needs.
    pub fn vessels(&self) -> Vec<usize> {
        let others = self.items.iter().filter_map(|item| if let What::Weights(vessel) = item.what { Some(vessel) } else { None });
        std::iter::once(self.vessel).chain(others).collect()
    }
}
