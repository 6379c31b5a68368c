//! Episodes made by the flow model itself, so that the trainer can be tested without any simulator.

use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use shared::estimator::flow::{CommandHistory, FlowModel, FlowState, FlowTables};
use trainer::data::TrainingEpisode;

/// c and q of the camera.
pub const CAMERA: (f64, f64) = (0.0012, 1.2);

/// `n` curves of eq. (1) from different volumes, weighed to the gram, seen by [`CAMERA`] with a noise of 6 %.
pub fn episodes(n: usize, seed: u64) -> Vec<TrainingEpisode> {
    episodes_of(&FlowModel::default(), n, seed, |_| (CAMERA, 0.06))
}

/// The same, made by `model`, seen by the camera (c and q) and with the noise (sd of the logarithm) that `seen` gives for each episode.
pub fn episodes_of(model: &FlowModel, n: usize, seed: u64, seen: impl Fn(usize) -> ((f64, f64), f64)) -> Vec<TrainingEpisode> {
    let flow = FlowTables::new(model, 30.0);
    let mut rng = Pcg64Mcg::seed_from_u64(seed);
    (0..n)
        .map(|k| {
            let onset = 30.0 + 45.0 * (k as f64 + 0.5) / n as f64;
            let top = onset + rng.random_range(8.0..22.0);
            let sigma_s = rng.random_range(0.8..2.0);
            let beta_s = sigma_s * (2.0 * (top / 0.05f64).ln()).sqrt();
            let frames = (60.0 * beta_s) as usize + 45;
            let mut e = TrainingEpisode::empty(&format!("{}", k + 1), 30.0);
            let mut state = FlowState { headspace_ml: flow.capacity.lost_ml(onset), ..FlowState::default() };
            let mut sum = 0.0;
            let mut history = CommandHistory::standing_at(0.0);
            let ((c, q), noise) = seen(k);
            for i in 0..frames {
                let t_s = i as f64 / 30.0;
                let alpha = if t_s < 2.0 * beta_s { top * (-((t_s - beta_s) / sigma_s).powi(2) / 2.0).exp() } else { 0.0 };
                history.push(alpha);
                let out = state.step(&flow, history.commands(), 0).leaves_ml;
                sum += out;
                let z: f64 = StandardNormal.sample(&mut rng);
                let area = (out / c).powf(1.0 / q) * (noise * z).exp();
                e.push(t_s, alpha, f64::NAN, if area < 8.0 { 0.0 } else { area });
            }
            e.weight_g = (sum + state.film_ml).round();
            e
        })
        .collect()
}
