//! Experimental episodes as a person would record them on a bench: curves of eq. (1), and the weight that is read afterwards.
//!
//! Pure, any thread; allocates; cannot fail. The same seed gives the same episodes.

use rand::seq::SliceRandom;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use trainer::data::TrainingEpisode;

use simulator::physics::{ALPHA_MAX_DEG, RATE_HZ};

use super::simulators::Bench;

/// Frames recorded after the curve has come back, while the last drops fall: 1.5 s, five times the time in which the film drains.
const SETTLE_FRAMES: usize = 45;

impl Bench {
    /// Records `n` episodes. Volumes are stratified over 140 to 460 ml; a curve is 6 to 30 degrees higher than the spill angle and has a
    /// width (standard deviation) of 0.7 to 2.2 s, both uniformly drawn. A single episode is the middle one: 300 ml, 18 degrees, 1.3 s.
    pub fn record(&self, n: usize, seed: u64) -> Vec<TrainingEpisode> {
        let mut random = Pcg64Mcg::seed_from_u64(seed.wrapping_mul(0x5851_f42d).wrapping_add(99));
        let mut strata: Vec<usize> = (0..n).collect();
        strata.shuffle(&mut random);
        let mut episodes = Vec::with_capacity(n);
        for (k, stratum) in strata.into_iter().enumerate() {
            let (volume_ml, over_deg, sigma_s) = if n == 1 {
                (300.0, 18.0, 1.3)
            } else {
                let share = (stratum as f64 + random.random_range(0.0..1.0)) / n as f64;
                (140.0 + 320.0 * share, random.random_range(6.0..=30.0), random.random_range(0.7..=2.2))
            };
            let lambda_deg = (self.spill_angle_deg(volume_ml) + over_deg).min(ALPHA_MAX_DEG);
            let pour_seed = random.random();
            episodes.push(self.record_one(&format!("{}", k + 1), volume_ml, lambda_deg, sigma_s, pour_seed, &mut random));
        }
        episodes
    }

    /// Records one curve of eq. (1) with the height `lambda_deg` and the width `sigma_s` (gamma = 1/(2 sigma^2)), and weighs it.
    pub fn record_one(
        &self,
        name: &str,
        volume_ml: f64,
        lambda_deg: f64,
        sigma_s: f64,
        seed: u64,
        random: &mut Pcg64Mcg,
    ) -> TrainingEpisode {
        let gamma_per_s2 = 1.0 / (2.0 * sigma_s * sigma_s);
        // The curve begins at 0.05 degrees.
        let beta_s = ((lambda_deg / 0.05).ln() / gamma_per_s2).sqrt();
        let frames = (2.0 * beta_s * RATE_HZ).ceil() as usize;
        let mut pour = self.pour(volume_ml, seed);
        let mut episode = TrainingEpisode::empty(name, RATE_HZ);
        for k in 0..frames + SETTLE_FRAMES {
            let t_s = k as f64 / RATE_HZ;
            let alpha_deg = if k < frames { lambda_deg * (-gamma_per_s2 * (t_s - beta_s).powi(2)).exp() } else { 0.0 };
            let area_px2 = pour.frame(alpha_deg);
            episode.push(t_s, alpha_deg, pour.tilt_deg(), f64::from(area_px2));
        }
        let misread: f64 = StandardNormal.sample(random);
        episode.weight_g = (pour.poured_ml() + 0.5 * misread).round();
        episode
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use simulator::physics::rig::Rig;

    /// Protects the reference protocol: curves start and end upright, volumes are spread, and weights are possible.
    #[test]
    fn episodes_follow_equation_1() {
        let bench = Bench::on(&Rig::seeded(0));
        let episodes = bench.record(8, 1);
        // They are compared as text, because the measured angles are NaN here and differ from themselves.
        let text = |e: &[TrainingEpisode]| format!("{e:?}");
        assert_eq!(text(&episodes), text(&bench.record(8, 1)));
        assert_ne!(text(&episodes), text(&bench.record(8, 2)));
        for e in &episodes {
            let top = e.alpha_deg.iter().copied().fold(0.0, f64::max);
            assert!((e.alpha_deg[0] - 0.05).abs() < 1e-9 && e.alpha_deg.last() == Some(&0.0), "{}", e.name);
            assert!(top > 30.0 && top <= 110.0);
            assert!(e.weight_g > 0.0 && e.weight_g < 470.0 && e.area_px2.iter().any(|a| *a > 0.0));
        }
    }
}
