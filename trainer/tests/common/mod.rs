//! Episodes made by the flow model itself, so that the trainer can be tested without any simulator.

use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use shared::estimate::flow::{DRIP, Flow, FlowModel, HISTORY};
use trainer::data::TrainingEpisode;

/// c and q of the camera.
pub const CAMERA: (f64, f64) = (0.0012, 1.2);

/// `n` curves of eq. (1) from different volumes, weighed to the gram, seen by [`CAMERA`] with a noise of 6 %.
pub fn episodes(n: usize, seed: u64) -> Vec<TrainingEpisode> {
    episodes_of(&FlowModel::default(), n, seed, |_| (CAMERA, 0.06))
}

/// The same, made by `model`, seen by the camera (c and q) and with the noise (sd of the logarithm) that `seen` gives for each episode.
pub fn episodes_of(model: &FlowModel, n: usize, seed: u64, seen: impl Fn(usize) -> ((f64, f64), f64)) -> Vec<TrainingEpisode> {
    let flow = Flow::new(model);
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    (0..n)
        .map(|k| {
            let onset = 30.0 + 45.0 * (k as f64 + 0.5) / n as f64;
            let top = onset + rng.random_range(8.0..22.0);
            let sigma_s = rng.random_range(0.8..2.0);
            let beta_s = sigma_s * (2.0 * (top / 0.05f64).ln()).sqrt();
            let frames = (60.0 * beta_s) as usize + 45;
            let mut e = TrainingEpisode::empty(&format!("{}", k + 1), 30.0);
            let (mut a, mut x, mut film, mut sum) = (0.0, flow.capacity_ml(onset), 0.0, 0.0);
            let mut history = [0.0; HISTORY];
            let ((c, q), noise) = seen(k);
            for i in 0..frames {
                let t_s = i as f64 / 30.0;
                let alpha = if t_s < 2.0 * beta_s { top * (-((t_s - beta_s) / sigma_s).powi(2) / 2.0).exp() } else { 0.0 };
                history.copy_within(1.., 0);
                history[HISTORY - 1] = alpha;
                a = flow.tilt(a, flow.delayed(&history, 0, 0.0));
                let v = flow.over(a, x, 0.0).v_ml;
                x += v;
                film += 0.1 * v;
                let drip = DRIP * film;
                film -= drip;
                let out = 0.9 * v + drip;
                sum += out;
                let z: f64 = StandardNormal.sample(&mut rng);
                let area = (out / c).powf(1.0 / q) * (noise * z).exp();
                e.push(t_s, alpha, f64::NAN, if area < 8.0 { 0.0 } else { area });
            }
            e.weight_g = (sum + film).round();
            e
        })
        .collect()
}
