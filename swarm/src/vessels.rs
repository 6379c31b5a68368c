//! The vessels and liquids that a seed draws from, and what they are filled with.
//!
//! Plain data, made once in a process and then shared by all threads; allocates when a vessel's tables are made. Cannot fail: a name that
//! is not known leaves a straight cylinder.

use std::collections::BTreeMap;
use std::sync::{Mutex, PoisonError};

use rand::Rng;
use rand_distr::{Distribution, StandardNormal};
use simulator::physics::container::Container;
use simulator::physics::rig::Rig;
use simulator::physics::vessel::VesselKind;

/// A vessel: its name, the kind of [`Rig::drawn`] (`None` for the straight, calm cylinder of [`Rig::seeded`]), the rig's seed, and how often
/// its surface swings, Hz.
#[derive(Debug, Clone, Copy)]
pub struct Vessel {
    /// Its name in tables.
    pub name: &'static str,
    kind: Option<VesselKind>,
    rig_seed: u64,
    slosh_hz: f64,
}

impl Vessel {
    /// Whether it is straight, and its surface does not swing.
    pub fn is_calm(&self) -> bool {
        self.kind.is_none() && self.slosh_hz == 0.0
    }
}

const fn vessel(name: &'static str, kind: VesselKind, rig_seed: u64, slosh_hz: f64) -> Vessel {
    Vessel { name, kind: Some(kind), rig_seed, slosh_hz }
}

/// The vessels. Their rigs are none of those that learning is tuned or reported on (CONTRIBUTING.md). All but the first swing, at 1.7 to 2.3
/// Hz as an independent particle simulation showed; liquids are between water and syrup, and streams cling below up to 4 ml/s.
pub const VESSELS: [Vessel; 11] = [
    Vessel { name: "calm cylinder", kind: None, rig_seed: 300, slosh_hz: 0.0 },
    vessel("swinging cylinder", VesselKind::Slosh, 301, 2.0),
    vessel("rough cylinder", VesselKind::Rough, 302, 1.8),
    vessel("cone-in", VesselKind::ConeIn, 303, 2.2),
    vessel("cone-out", VesselKind::ConeOut, 304, 1.9),
    vessel("bottle", VesselKind::Bottle, 305, 2.1),
    vessel("jug", VesselKind::Jug, 306, 2.0),
    vessel("carton", VesselKind::Carton, 307, 1.7),
    vessel("steep", VesselKind::Steep, 308, 2.3),
    vessel("wild", VesselKind::Wild, 309, 2.0),
    vessel("wild 2", VesselKind::Wild, 310, 1.9),
];

/// The vessels that were filled once in this process: their tables take some 10 ms to make.
static MADE: Mutex<BTreeMap<usize, (Rig, Container)>> = Mutex::new(BTreeMap::new());

/// The rig of the vessel with this number, and the empty vessel.
pub fn rig(number: usize) -> (Rig, Container) {
    let mut made = MADE.lock().unwrap_or_else(PoisonError::into_inner);
    let entry = made.entry(number).or_insert_with(|| {
        let vessel = VESSELS[number % VESSELS.len()];
        let mut rig = vessel.kind.map_or_else(|| Rig::seeded(vessel.rig_seed), |kind| Rig::drawn(kind, vessel.rig_seed));
        rig.habits.slosh_hz = vessel.slosh_hz;
        let container = rig.container(0.0);
        (rig, container)
    });
    entry.clone()
}

/// Fills `container`, which belongs to `rig`, with `volume_ml` of its liquid, whose fluidity differs a little from time to time.
pub fn fill(rig: &Rig, container: &mut Container, volume_ml: f64, random: &mut impl Rng) {
    let normal: f64 = StandardNormal.sample(random);
    container.set_fluidity(rig.fluidity * (1.0 + rig.fluidity_sd * normal).max(0.3));
    container.refill(volume_ml);
}

/// The tilt at which `fill_ml` starts to flow from a vessel, degrees.
pub fn spill_angle_deg(number: usize, fill_ml: f64) -> f64 {
    let (_, mut container) = rig(number);
    container.refill(fill_ml);
    container.spill_angle_deg()
}
