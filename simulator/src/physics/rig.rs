//! Simulator b: a seeded rig (container, liquid, servo, camera) and one pour on it, frame by frame.
//!
//! Pure, on any thread; the same seeds give the same pour. It allocates when a pour is set up, not in [`RigPour::frame`]. It cannot fail.

use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};

use super::RATE_HZ;
use super::container::{Container, Shape};
use super::habits::Habits;

/// Steps of the physics in a frame: 11 ms each, short against the servo's time constant and the film's.
const SUBSTEPS: usize = 3;
/// Areas below this read as 0, px^2: a real extraction sees no smaller stream either. Chosen by hand; no measurement is recorded.
const AREA_MIN_PX2: f64 = 8.0;
/// Largest delay of the camera that can be simulated, frames: twice the largest that is drawn, with some room.
const DELAY_MAX: usize = 8;

/// Largest pure delay of the robot that can be simulated, in steps of the physics: 8 frames.
const ROBOT_DELAY_MAX: usize = 8 * SUBSTEPS;
/// Share of a stream's area that is still seen when the whole stream clings to the wall. Chosen by hand; no measurement is recorded.
const CLINGING_SEEN: f64 = 0.4;

/// Area that the camera reports for an outflow of 1 ml a frame, px^2, the same as in the paper's simulation.
const AREA_AT_1_ML_PX2: f64 = 400.0;

/// A container, a liquid, a servo and a camera: what does not change from pour to pour.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Rig {
    /// Shape of the container's inside.
    pub shape: Shape,
    /// Width of the lip, mm.
    pub lip_width_mm: f64,
    /// Fluidity of the liquid relative to water.
    pub fluidity: f64,
    /// Time constant of the servo, s.
    pub servo_time_constant_s: f64,
    /// Largest rate of the servo, degrees/s.
    pub servo_rate_deg_s: f64,
    /// Camera delay, frames.
    pub delay_frames: usize,
    /// Exponent with which the area grows with the flow.
    pub area_exponent: f64,
    /// Standard deviation of a frame's area, as a share of it.
    pub frame_noise: f64,
    /// Share of frames whose area reads 0.
    pub dropouts: f64,
    /// Standard deviation of the camera's gain from pour to pour, as a share of it.
    pub gain_sd: f64,
    /// The camera's gain relative to the one at training; it is 1 unless robustness is examined.
    pub gain: f64,
    /// Standard deviation of the fluidity from pour to pour, as a share of it.
    pub fluidity_sd: f64,
    /// Pure delay of the robot before its servo, frames.
    #[serde(default)]
    pub robot_delay_frames: f64,
    /// What vessel and liquid do beyond a smooth shape and a weir.
    #[serde(default)]
    pub habits: Habits,
}

impl Rig {
    /// A rig with a straight cylinder, drawn from `seed`.
    pub fn seeded(seed: u64) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(seed.wrapping_mul(0x9e37_79b9).wrapping_add(17));
        let shape = Shape::Cylinder { radius_mm: rng.random_range(34.0..=42.0), height_mm: rng.random_range(105.0..=125.0) };
        Self {
            shape,
            servo_time_constant_s: rng.random_range(0.080..=0.100),
            servo_rate_deg_s: 90.0,
            delay_frames: rng.random_range(1..=3),
            area_exponent: rng.random_range(0.7..=1.0),
            fluidity: rng.random_range(0.7..=1.2),
            lip_width_mm: rng.random_range(14.0..=26.0),
            frame_noise: 0.08,
            dropouts: 0.03,
            gain_sd: 0.015,
            gain: 1.0,
            fluidity_sd: 0.08,
            robot_delay_frames: 0.0,
            habits: Habits::default(),
        }
    }

    /// The same rig with another container of about the same size: `cone-in` (its bottom 0.75 times as wide as its top), `cone-out`
    /// (1.2 times), `bottle` or `jug`; `cylinder` leaves it as it is. `None` for another name.
    pub fn with_container(mut self, name: &str) -> Option<Self> {
        let Shape::Cylinder { radius_mm, height_mm } = self.shape else { return None };
        self.shape = match name {
            "cylinder" => self.shape,
            "cone-in" => Shape::Cone { bottom_mm: 0.75 * radius_mm, top_mm: radius_mm, height_mm: 1.25 * height_mm },
            "cone-out" => Shape::Cone { bottom_mm: 1.2 * radius_mm, top_mm: radius_mm, height_mm },
            "bottle" => Shape::Bottle {
                body_mm: radius_mm,
                neck_mm: 0.45 * radius_mm,
                shoulder_mm: 0.95 * height_mm,
                neck_from_mm: 1.2 * height_mm,
                height_mm: 1.4 * height_mm,
            },
            "jug" => Shape::Jug { half_side_mm: 0.9 * radius_mm, spout_mm: 0.2 * radius_mm, height_mm },
            _ => return None,
        };
        Some(self)
    }

    /// The container, with `volume_ml` of the rig's liquid in it.
    pub fn container(&self, volume_ml: f64) -> Container {
        let mut container = Container::new(self.shape, self.lip_width_mm, self.fluidity, 0.0);
        if self.habits != Habits::default() {
            container = container.with_habits(self.habits);
        }
        container.refill(volume_ml);
        container
    }
}

/// One pour on a rig of simulator b.
#[derive(Debug, Clone)]
pub struct RigPour {
    container: Container,
    rig: Rig,
    gain: f64,
    tilt_deg: f64,
    flows_ml: [f64; DELAY_MAX + 1],
    frame: usize,
    commands_deg: [f64; ROBOT_DELAY_MAX + 1],
    step: usize,
    rng: Pcg64Mcg,
}

impl RigPour {
    /// A pour from the upright `container` (from [`Rig::container`]); `seed` draws its fluidity, gain and noise.
    pub fn new(rig: &Rig, mut container: Container, seed: u64) -> Self {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        container.set_fluidity(rig.fluidity * (1.0 + rig.fluidity_sd * normal()).max(0.3));
        let gain = rig.gain * (1.0 + rig.gain_sd * normal());
        Self {
            container,
            rig: rig.clone(),
            gain,
            tilt_deg: 0.0,
            flows_ml: [0.0; DELAY_MAX + 1],
            frame: 0,
            commands_deg: [0.0; ROBOT_DELAY_MAX + 1],
            step: 0,
            rng,
        }
    }

    /// Lets one frame pass with `alpha_deg` commanded. Returns the area that the camera reports at its end, px^2.
    pub fn frame(&mut self, alpha_deg: f64) -> f32 {
        let before_ml = self.container.poured_ml();
        self.advance(alpha_deg);
        let slots = self.flows_ml.len();
        self.flows_ml[self.frame % slots] = self.container.poured_ml() - before_ml;
        let delay = self.rig.delay_frames.min(DELAY_MAX);
        let seen_ml = if self.frame >= delay { self.flows_ml[(self.frame - delay) % slots] } else { 0.0 };
        self.frame += 1;
        // Both numbers are drawn in every frame, so that a change of the flow does not shift the noise of later frames.
        let noise: f64 = StandardNormal.sample(&mut self.rng);
        let dropped = self.rng.random_bool(self.rig.dropouts);
        let clinging = self.rig.habits.clinging(seen_ml * RATE_HZ);
        let seen_share = 1.0 - (1.0 - CLINGING_SEEN) * clinging;
        let area = AREA_AT_1_ML_PX2 * seen_share * seen_ml.powf(self.rig.area_exponent) * self.gain * (self.rig.frame_noise * noise).exp();
        if dropped || area < AREA_MIN_PX2 { 0.0 } else { area as f32 }
    }

    /// Lets one frame pass with `alpha_deg` commanded, without a look through the camera.
    pub fn advance(&mut self, alpha_deg: f64) {
        let dt_s = 1.0 / RATE_HZ / SUBSTEPS as f64;
        let delay = ((self.rig.robot_delay_frames * SUBSTEPS as f64).round() as usize).min(ROBOT_DELAY_MAX);
        let slots = self.commands_deg.len();
        for _ in 0..SUBSTEPS {
            self.commands_deg[self.step % slots] = alpha_deg;
            // Before the first command has arrived, the robot stands upright.
            let alpha_deg = if self.step >= delay { self.commands_deg[(self.step - delay) % slots] } else { 0.0 };
            self.step += 1;
            let rate =
                ((alpha_deg - self.tilt_deg) / self.rig.servo_time_constant_s).clamp(-self.rig.servo_rate_deg_s, self.rig.servo_rate_deg_s);
            self.tilt_deg += rate * dt_s;
            self.container.step(dt_s, self.tilt_deg);
        }
    }

    /// The container as it is now.
    pub fn container(&self) -> &Container {
        &self.container
    }

    /// The volume that has left the lip, ml.
    pub fn poured_ml(&self) -> f64 {
        self.container.poured_ml()
    }

    /// The container's actual tilt, degrees.
    pub fn tilt_deg(&self) -> f64 {
        self.tilt_deg
    }

    /// Volume in the container, ml.
    pub fn volume_ml(&self) -> f64 {
        self.container.volume_ml()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn areas(seed: u64, delay: usize) -> (Vec<f32>, f64) {
        let rig = Rig { delay_frames: delay, ..Rig::seeded(3) };
        let mut pour = RigPour::new(&rig, rig.container(300.0), seed);
        let areas = (0..200).map(|k| pour.frame(f64::from(k) * 0.4)).collect();
        (areas, pour.poured_ml())
    }

    /// Protects reproducibility: a seed fixes the rig and the pour, and another one changes them.
    #[test]
    fn seeds_fix_the_pour() {
        assert_eq!(areas(5, 2), areas(5, 2));
        assert_ne!(areas(5, 2).0, areas(6, 2).0);
        assert_eq!(Rig::seeded(4), Rig::seeded(4));
        assert_ne!(Rig::seeded(4), Rig::seeded(5));
    }

    /// Protects the delay's meaning: with two frames more of it, the same stream shows two frames later.
    #[test]
    fn the_camera_sees_late() {
        let first = |delay| areas(5, delay).0.iter().position(|a| *a > 0.0).unwrap();
        assert_eq!(first(3), first(1) + 2);
        assert_eq!(areas(5, 1).1, areas(5, 3).1);
    }
}
