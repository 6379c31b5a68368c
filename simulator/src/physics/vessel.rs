//! Vessels as they are in a kitchen or a laboratory: not straight, with rough capacity curves, and with habits that a weir does not have.
//!
//! Pure, on any thread; the same seed draws the same rig. It does not allocate. It cannot fail.
//!
//! A vessel's capacity curve is how many ml it loses with each degree of tilt. Curves that were measured on real vessels are rough: one lost
//! 36, 13 and 22 ml a degree at 80, 85 and 90 degrees. So a drawn curve is that of a simple shape times a rough factor, and a steep one loses
//! 50 ml more within one degree. [`Habits`](super::habits::Habits) holds that, and what liquid and lip do; all are off in its default, which
//! is what the rigs of [`Rig::seeded`] have.

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};

use super::RATE_HZ;
use super::container::Shape;
use super::rig::Rig;

/// Kinds of rigs that are drawn from a seed beside the straight ones.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum VesselKind {
    /// A straight cylinder with a rough curve.
    Rough,
    /// A cone that is wider at the lip.
    ConeIn,
    /// A cone that is wider at the bottom.
    ConeOut,
    /// A bottle whose neck gurgles.
    Bottle,
    /// A square jug with a spout.
    Jug,
    /// A square carton whose opening lies inside of its edge.
    Carton,
    /// A vessel that loses 50 ml within one degree.
    Steep,
    /// A straight, smooth cylinder with water whose surface swings.
    Slosh,
    /// A straight, smooth cylinder with water on a robot that follows 1 to 6 frames late.
    Lag,
    /// Any of the above vessels with any liquid, a swinging surface and a late robot.
    Wild,
}

impl VesselKind {
    /// All kinds, in the order of the tables.
    pub const ALL: [Self; 10] =
        [Self::Rough, Self::ConeIn, Self::ConeOut, Self::Bottle, Self::Jug, Self::Carton, Self::Steep, Self::Slosh, Self::Lag, Self::Wild];

    /// Its name in the tables and on the command line.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rough => "rough",
            Self::ConeIn => "cone-in",
            Self::ConeOut => "cone-out",
            Self::Bottle => "bottle",
            Self::Jug => "jug",
            Self::Carton => "carton",
            Self::Steep => "steep",
            Self::Slosh => "slosh",
            Self::Lag => "lag",
            Self::Wild => "wild",
        }
    }

    /// The kind with this name.
    pub fn named(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }
}

impl Rig {
    /// A rig of this kind, drawn from `seed`: [`Rig::seeded`] with another vessel, liquid and robot. The full vessel holds 490 to 650 ml,
    /// so that 150 to 450 ml fit into it.
    pub fn drawn(kind: VesselKind, seed: u64) -> Self {
        let mut random = Pcg64Mcg::seed_from_u64(seed.wrapping_mul(0x1234_5677).wrapping_add(kind as u64 * 1009 + 5));
        let mut rig = Self::seeded(seed);
        match kind {
            VesselKind::Slosh => rig.habits.slosh_hz = random.random_range(1.7..=2.3),
            VesselKind::Lag => rig.make_late(&mut random),
            VesselKind::Wild => {
                let vessel = VesselKind::ALL[random.random_range(0..7)];
                rig.take_vessel(vessel, &mut random);
                rig.habits.slosh_hz = random.random_range(1.7..=2.3);
                rig.make_late(&mut random);
            }
            vessel => rig.take_vessel(vessel, &mut random),
        }
        rig
    }

    /// Gives the rig a vessel and a liquid.
    fn take_vessel(&mut self, kind: VesselKind, random: &mut Pcg64Mcg) {
        let r: f64 = random.random_range(34.0..=42.0);
        let height_mm: f64 = random.random_range(105.0..=125.0);
        let shape = match kind {
            VesselKind::ConeIn => Shape::Cone { bottom_mm: random.random_range(0.6..=0.85) * r, top_mm: r, height_mm },
            VesselKind::ConeOut => Shape::Cone { bottom_mm: random.random_range(1.1..=1.35) * r, top_mm: r, height_mm },
            VesselKind::Bottle => Shape::Bottle {
                body_mm: r,
                neck_mm: random.random_range(0.35..=0.55) * r,
                shoulder_mm: random.random_range(0.85..=1.0) * height_mm,
                neck_from_mm: 1.2 * height_mm,
                height_mm: 1.4 * height_mm,
            },
            VesselKind::Jug => Shape::Jug { half_side_mm: 0.9 * r, spout_mm: random.random_range(0.15..=0.35) * r, height_mm },
            // The lip lies inside of the edge, so that some liquid stays behind it even when the carton lies on its side.
            VesselKind::Carton => {
                Shape::Jug { half_side_mm: 0.9 * r, spout_mm: -random.random_range(0.05..=0.3) * r, height_mm: 1.3 * height_mm }
            }
            _ => Shape::Cylinder { radius_mm: r, height_mm },
        };
        let full_ml = random.random_range(490.0..=650.0f64);
        self.shape = shape.scaled((full_ml / shape.retained_ml(0.0)).cbrt());
        self.lip_width_mm = match self.shape {
            Shape::Bottle { neck_mm, .. } => random.random_range(0.8..=1.2) * neck_mm,
            _ => random.random_range(14.0..=26.0),
        };
        // Water to syrup, each power of it as often.
        self.fluidity = random.random_range(0.15f64.ln()..=1.2f64.ln()).exp();
        self.habits.roughness = random.random_range(0.2..=0.5);
        self.habits.roughness_seed = random.random();
        self.habits.cling_ml_s = random.random_range(0.0..=4.0);
        if kind == VesselKind::Bottle {
            self.habits.gurgle_hz = random.random_range(2.0..=4.0);
            self.habits.gurgle_share = random.random_range(0.2..=0.5);
        }
        if kind == VesselKind::Steep {
            self.habits.step_ml = 50.0;
            self.habits.step_deg = random.random_range(50.0..=80.0);
        }
    }

    /// Lets the robot follow 1 to 6 frames late: a part of it is a pure delay, the rest the servo's time constant.
    fn make_late(&mut self, random: &mut Pcg64Mcg) {
        let late_frames: f64 = random.random_range(1.0..=6.0);
        // A time constant below a frame's 33 ms would be shorter than the steps of the physics allow.
        let delay_frames = (random.random_range(0.3..=0.9) * late_frames).min(late_frames - 1.0).max(0.0);
        self.robot_delay_frames = delay_frames;
        self.servo_time_constant_s = (late_frames - delay_frames) / RATE_HZ;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::physics::habits::Habits;
    use crate::physics::rig::RigPour;

    /// Protects every drawn vessel: more tilt never retains more, 450 ml fit in, something can be poured, and the volume is conserved in a
    /// pour with all habits.
    #[test]
    fn drawn_vessels_are_possible() {
        for kind in VesselKind::ALL {
            for seed in 0..12 {
                let rig = Rig::drawn(kind, seed);
                assert_eq!(rig, Rig::drawn(kind, seed));
                assert_ne!(rig, Rig::drawn(kind, seed + 1));
                let container = rig.container(300.0);
                let retained: Vec<f64> = (0..180).map(|a| container.retained_ml(f64::from(a))).collect();
                assert!(retained.windows(2).all(|w| w[1] <= w[0] + 1e-6 && w[1] >= -1e-6), "{kind:?} {seed}");
                let straight = matches!(kind, VesselKind::Slosh | VesselKind::Lag);
                assert!(straight || 0.92 * container.full_ml() >= 449.9, "{kind:?} {seed}: {}", container.full_ml());
                assert!(300.0 - container.retained_ml(110.0) > 100.0, "{kind:?} {seed}: {}", container.retained_ml(110.0));
                let spill_deg = container.spill_angle_deg();
                let mut pour = RigPour::new(&rig, container, seed);
                for k in 0..400 {
                    pour.frame(if k < 150 { (spill_deg + 15.0).min(110.0) } else { 0.0 });
                    let c = pour.container();
                    assert!((c.volume_ml() + c.film_ml() + c.poured_ml() - 300.0).abs() < 1e-6, "{kind:?} {seed}");
                }
                assert!(pour.poured_ml() > 5.0, "{kind:?} {seed}: {}", pour.poured_ml());
            }
        }
    }

    /// Protects what the rows stand for: a rough curve changes by factors within 5 degrees, and a steep one loses 50 ml within one.
    #[test]
    fn curves_are_rough_and_steep() {
        let lost = |rig: &Rig, deg: f64| {
            let c = rig.container(0.0);
            c.retained_ml(deg - 0.5) - c.retained_ml(deg + 0.5)
        };
        let rough = Rig { habits: Habits { roughness: 0.5, roughness_seed: 3, ..Habits::default() }, ..Rig::seeded(3) };
        let ratios: Vec<f64> = (40..80).map(|a| lost(&rough, f64::from(a)) / lost(&Rig::seeded(3), f64::from(a))).collect();
        let (low, high) = ratios.iter().fold((f64::MAX, 0.0f64), |(l, h), r| (l.min(*r), h.max(*r)));
        assert!(high / low > 2.0, "{low} {high}");
        for seed in 0..10 {
            let steep = Rig::drawn(VesselKind::Steep, seed);
            assert!(lost(&steep, steep.habits.step_deg) > 45.0, "{seed}");
        }
    }

    /// Protects the swing: after an approach at 75 degrees/s the flow begins, stops altogether, and begins again; without the habit it does
    /// not stop.
    #[test]
    fn a_fast_approach_switches_the_flow() {
        let gaps = |slosh_hz: f64| {
            let rig = Rig { habits: Habits { slosh_hz, ..Habits::default() }, ..Rig::seeded(3) };
            let container = rig.container(250.0);
            let target_deg = container.spill_angle_deg() + 1.5;
            let mut pour = RigPour::new(&rig, container, 1);
            let (mut flowed, mut gap, mut again, mut swing_deg) = (false, 0, false, 0.0f64);
            for k in 0..90 {
                pour.advance((f64::from(k) * 2.5).min(target_deg));
                let head_mm = pour.container().lip().head_mm;
                swing_deg = swing_deg.max(pour.container().slosh().swing_deg());
                again |= gap > 2 && head_mm > 0.0;
                gap += i32::from(flowed && head_mm <= 0.0 && !again);
                flowed |= head_mm > 0.3;
            }
            (flowed, gap, again, swing_deg)
        };
        let (flowed, gap, again, swing_deg) = gaps(2.0);
        assert!(flowed && gap > 2 && gap < 12 && again, "{gap} {again}");
        assert!((1.5..4.5).contains(&swing_deg), "{swing_deg}");
        assert_eq!(gaps(0.0).1, 0);
    }

    /// Protects the robot's lateness: with a pure delay of three frames, the same tilt comes three frames later.
    #[test]
    fn a_late_robot_follows_late() {
        let tilts = |robot_delay_frames: f64| {
            let rig = Rig { robot_delay_frames, ..Rig::seeded(3) };
            let mut pour = RigPour::new(&rig, rig.container(100.0), 1);
            (0..40).map(|k| pour.frame(f64::from(k)) as f64 * 0.0 + pour.tilt_deg()).collect::<Vec<f64>>()
        };
        let (prompt, late) = (tilts(0.0), tilts(3.0));
        assert!((3..40).all(|k| (late[k] - prompt[k - 3]).abs() < 1e-9));
    }
}
