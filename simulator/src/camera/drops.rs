//! Drops: those that leave a lip with too little flow for a stream, those that splash up from the receiver, and the bead at a wet lip.
//!
//! Called by the renderer, on its thread. Allocates a few points for each drop; failures are OpenCV's.

use opencv::core::Rect;
use rand::RngExt;
use rand_pcg::Pcg64Mcg;

use super::cover::{Cover, join};
use super::stream_outline::{DRIP_FLOW_ML_S, GRAVITY_MM_S2};
use super::view::{Scene, View, to_container};

/// Volume of one drop, ml. Chosen by hand; it is the usual rule of 20 drops a millilitre.
const DROP_ML: f64 = 0.05;
/// Corners of a drop's outline: enough for a circle of a few pixels.
const CORNERS: i32 = 16;
/// A drop is forgotten at this distance from the lip, mm: beyond the picture at every scale that is drawn.
const REACH_MM: f64 = 120.0;

/// A drop in flight, in the container's frame.
#[derive(Debug, Clone, Copy)]
struct Drop {
    at_mm: [f64; 2],
    velocity_mm_s: [f64; 2],
    radius_mm: f64,
}

/// All drops in flight, and how wet the lip is.
pub struct Drops {
    flying: Vec<Drop>,
    /// 1 while a stream flows, then falling towards 0.
    wet: f64,
    /// Volume at the lip that has not yet fallen as a drop, ml.
    drip_ml: f64,
}

impl Drops {
    /// A dry lip.
    pub fn new() -> Self {
        Self { flying: Vec::with_capacity(64), wet: 0.0, drip_ml: 0.0 }
    }

    /// Lets `dt_s` pass: drops fall, are born at the lip and splash up from the receiver.
    pub fn step(&mut self, scene: &Scene, dt_s: f64, random: &mut Pcg64Mcg) {
        let alpha = scene.alpha_deg.to_radians();
        let gravity = to_container([0.0, -GRAVITY_MM_S2], alpha);
        for drop in &mut self.flying {
            for ((at, velocity), g) in drop.at_mm.iter_mut().zip(&mut drop.velocity_mm_s).zip(gravity) {
                *at += *velocity * dt_s + 0.5 * g * dt_s * dt_s;
                *velocity += g * dt_s;
            }
        }
        self.flying.retain(|d| d.at_mm.iter().all(|v| v.abs() < REACH_MM));
        let flowing = scene.flow_ml_s >= DRIP_FLOW_ML_S;
        self.wet = if flowing { 1.0 } else { self.wet * (-dt_s / 0.8).exp() };
        // Too little for a stream leaves as drops, and for a while so does the film on the lip.
        if !flowing {
            self.drip_ml += (scene.flow_ml_s.max(0.0) + 0.12 * self.wet * self.wet) * dt_s;
            if self.drip_ml > DROP_ML && self.flying.len() < 60 {
                self.drip_ml -= DROP_ML;
                let out = to_container([random.random_range(20.0..90.0), 0.0], alpha);
                let radius_mm = random.random_range(0.9..2.0);
                let start = to_container([0.6 + radius_mm, -radius_mm], alpha);
                self.flying.push(Drop { at_mm: start, velocity_mm_s: out, radius_mm });
            }
        }
        if scene.flow_ml_s > 3.0 && self.flying.len() < 55 && random.random::<f64>() < 0.05 {
            for _ in 0..random.random_range(1..4) {
                let below = to_container([random.random_range(-10.0..50.0), -55.0], alpha);
                let up = to_container([random.random_range(-250.0..150.0), random.random_range(900.0..1400.0)], alpha);
                self.flying.push(Drop { at_mm: below, velocity_mm_s: up, radius_mm: random.random_range(0.4..1.3) });
            }
        }
    }

    /// Adds the drops, stretched by their motion during the exposure, and the bead at the lip to `cover`. Returns the rectangle that
    /// holds them.
    pub fn fill(&self, view: &View, scene: &Scene, cover: &mut Cover) -> opencv::Result<Rect> {
        let mut all = Rect::default();
        for drop in &self.flying {
            let speed = drop.velocity_mm_s[0].hypot(drop.velocity_mm_s[1]);
            let along = drop.velocity_mm_s.map(|v| if speed > 1.0 { v / speed } else { 0.0 });
            let stretch = 0.5 * speed * view.shutter_s;
            let corner = |[cos, sin]: [f64; 2]| {
                let offset = [drop.radius_mm * cos, drop.radius_mm * sin];
                let ahead = (offset[0] * along[0] + offset[1] * along[1]).signum() * stretch;
                view.to_image([drop.at_mm[0] + offset[0] + ahead * along[0], drop.at_mm[1] + offset[1] + ahead * along[1]])
            };
            let shape: Vec<[f64; 2]> = around().map(corner).collect();
            all = join(all, cover.fill(&shape)?);
        }
        if scene.flow_ml_s < DRIP_FLOW_ML_S && self.wet > 0.05 {
            let radius = 1.3 * self.wet.sqrt();
            let centre = to_container([0.5 * radius, -0.6 * radius], scene.alpha_deg.to_radians());
            let corner = |[cos, sin]: [f64; 2]| view.to_image([centre[0] + radius * cos, centre[1] + radius * sin]);
            let shape: Vec<[f64; 2]> = around().map(corner).collect();
            all = join(all, cover.fill(&shape)?);
        }
        Ok(all)
    }
}

/// Cosine and sine of [`CORNERS`] directions all around.
fn around() -> impl Iterator<Item = [f64; 2]> {
    (0..CORNERS).map(|k| {
        let (sin, cos) = (f64::from(k) * std::f64::consts::TAU / f64::from(CORNERS)).sin_cos();
        [cos, sin]
    })
}
