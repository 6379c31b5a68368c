//! What happens before the camera: short scenes of one pour, and whole pours one after the other as in a cell.
//!
//! Whole pours show what a short scene cannot: whether a stream is seen at a glass at rest, and whether the extraction stays right for
//! half a minute. Pure, any thread; allocates; cannot fail. The same generator gives the same scenes.

use rand::RngExt;
use rand_pcg::Pcg64Mcg;
use simulator::camera::Scene;
use simulator::physics::rig::Rig;

/// Frames of a short scene: less than a second, enough for a stream to begin, stand and end.
pub const SHORT_FRAMES: usize = 24;
/// Steps of the physics in a frame: 4 ms each, as in the simulated cell.
const STEPS: usize = 8;

/// [`SHORT_FRAMES`] scenes of a pour, or of a dry container that tilts, at 30 Hz.
pub fn short(random: &mut Pcg64Mcg, dry: bool) -> Vec<Scene> {
    let (start_deg, rate_deg_s) = (random.random_range(25.0..95.0f64), random.random_range(-25.0..35.0));
    let peak_ml_s = 10f64.powf(random.random_range(0.0..1.62));
    let level_mm = random.random_range(-30.0..-1.0);
    (0..SHORT_FRAMES)
        .map(|i| {
            let t = i as f64 / 30.0;
            // 4 dry frames, growth, 8 frames near the peak, decay, and drops.
            let share = match i {
                0..4 => 0.0,
                4..9 => (i as f64 - 3.0) / 5.0,
                9..17 => 1.0 + 0.1 * (t * 9.0).sin(),
                17..20 => (20.0 - i as f64) / 4.0,
                _ => 0.0,
            };
            Scene {
                at_s: t,
                alpha_deg: (start_deg + rate_deg_s * t).clamp(0.0, 108.0),
                rate_deg_s,
                flow_ml_s: if dry { 0.0 } else { peak_ml_s * share },
                level_mm,
            }
        })
        .collect()
}

/// Scenes of `pours` pours in a row at 30 Hz, each as an operator sees it: a filled glass stands upright, is tilted to its spill angle,
/// poured from, turned back, and rests. The liquid follows the container's physics.
pub fn whole_pours(random: &mut Pcg64Mcg, seed: u64, pours: usize) -> Vec<Scene> {
    let mut container = Rig::seeded(seed).container(300.0);
    let spill_deg = container.spill_angle_deg();
    let (mut scenes, mut alpha_deg) = (Vec::new(), 0.0f64);
    for _ in 0..pours {
        container.refill(300.0);
        let before_deg = spill_deg - 3.0;
        let top_deg = spill_deg + random.random_range(6.0..14.0);
        let [fast, slow, back] = [(13.5, 40.0), (5.0, 14.0), (2.0, 8.0)].map(|(from, to)| random.random_range(from..to));
        let hold_s = random.random_range(0.2..0.8);
        // How long, s, and the tilt's rate, degrees/s.
        let legs = [
            (1.5, 0.0),
            (before_deg / fast, fast),
            ((top_deg - before_deg) / slow, slow),
            (hold_s, 0.0),
            (1.0, -back),
            ((top_deg - back) / 60.0, -60.0),
            (2.5, 0.0),
        ];
        for (seconds, rate_deg_s) in legs {
            for _ in 0..(seconds * 30.0f64).round() as usize {
                for _ in 0..STEPS {
                    let dt_s = 1.0 / (30.0 * STEPS as f64);
                    alpha_deg = (alpha_deg + rate_deg_s * dt_s).max(0.0);
                    container.step(dt_s, alpha_deg);
                }
                scenes.push(Scene::of(&container, scenes.len() as f64 / 30.0, alpha_deg, rate_deg_s));
            }
        }
    }
    scenes
}
