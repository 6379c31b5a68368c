//! What vessels and liquids do beyond a smooth shape and a weir: rough capacity curves, gurgle, clinging streams, and a surface that swings.
//!
//! Pure, on any thread. It allocates when a curve is roughened, not in a step. It cannot fail.

use rand::SeedableRng;
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use serde::{Deserialize, Serialize};

/// Tilt over which a rough factor forgets itself, degrees: the measured curves change by a factor of three within 5 degrees.
const ROUGH_LENGTH_DEG: f64 = 3.0;
/// Standard deviation of a step's place, degrees: 95 % of the step lies within one degree.
const STEP_SD_DEG: f64 = 0.25;
/// Head at which a bottle's gurgle is fully there, mm. Chosen by hand; no measurement is recorded.
const GURGLE_HEAD_MM: f64 = 6.0;
/// Share of the surface's swing that a change of the tilt's rate excites. At a servo's time constant of 0.09 s, an approach at 60 to 90
/// degrees/s then swings the surface by about 3 degrees, which is what an independent particle simulation of 250 ml showed.
const SLOSH_COUPLING: f64 = 0.75;
/// Damping of the surface's swing, as a share of the critical one: the swing halves within about a period. Chosen by hand.
const SLOSH_DAMPING: f64 = 0.10;

/// What a vessel and its liquid do beyond a smooth shape and a weir. Everything is off by default.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize, Deserialize)]
pub struct Habits {
    /// Standard deviation of the logarithm of the rough factor on the ml lost with each degree; 0 for a smooth vessel.
    pub roughness: f64,
    /// Seed of the rough factor.
    pub roughness_seed: u64,
    /// Volume that is lost within one degree, ml; 0 for a vessel without a step.
    pub step_ml: f64,
    /// Tilt at which that happens, degrees.
    pub step_deg: f64,
    /// How often air gulps into the neck, Hz; 0 for a vessel that does not gurgle.
    pub gurgle_hz: f64,
    /// By which share the flow rises and falls with each gulp.
    pub gurgle_share: f64,
    /// Flow below which the stream clings to the wall, ml/s; 0 for one that never does.
    pub cling_ml_s: f64,
    /// How often the liquid's surface swings, Hz; 0 for one that does not.
    pub slosh_hz: f64,
}

impl Habits {
    /// Makes a table of retained volume over tilt rough, or steep at one place, and keeps the full volume. `table` holds the retained volume
    /// in ml for each `step_deg`, from upright on.
    pub fn roughen(&self, table: &mut [f64], step_deg: f64) {
        let Some(&full) = table.first() else { return };
        // The smallest and not the last: a vessel upside down has the same horizontal lip as an upright one.
        let rest = table.iter().copied().fold(full, f64::min);
        if self.roughness <= 0.0 && self.step_ml <= 0.0 {
            return;
        }
        let mut random = Pcg64Mcg::seed_from_u64(self.roughness_seed);
        let keep = (-step_deg / ROUGH_LENGTH_DEG).exp();
        let mut log_factor: f64 = StandardNormal.sample(&mut random);
        let mut lost: Vec<f64> = table
            .windows(2)
            .map(|pair| {
                let new: f64 = StandardNormal.sample(&mut random);
                log_factor = keep * log_factor + (1.0 - keep * keep).sqrt() * new;
                (pair[0] - pair[1]).max(0.0) * (self.roughness * log_factor).exp()
            })
            .collect();
        let wanted = full - rest - self.step_ml;
        let scale = wanted / lost.iter().sum::<f64>().max(1e-9);
        for (k, lost) in lost.iter_mut().enumerate() {
            let away = ((k as f64 + 0.5) * step_deg - self.step_deg) / STEP_SD_DEG;
            let density = (-0.5 * away * away).exp() / (STEP_SD_DEG * std::f64::consts::TAU.sqrt());
            *lost = *lost * scale + self.step_ml * density * step_deg;
        }
        let mut left = full;
        for (retained, lost) in table.iter_mut().skip(1).zip(lost) {
            left = (left - lost).max(0.0);
            *retained = left;
        }
    }

    /// By what the flow over the lip is multiplied `at_s` seconds after the beginning, with `head_mm` over the lip.
    pub fn gurgle(&self, at_s: f64, head_mm: f64) -> f64 {
        if self.gurgle_hz <= 0.0 {
            return 1.0;
        }
        1.0 + self.gurgle_share * (head_mm / GURGLE_HEAD_MM).min(1.0) * (std::f64::consts::TAU * self.gurgle_hz * at_s).sin()
    }

    /// Share of a stream of `flow_ml_s` that clings to the wall: 0 for a strong one, up to 1 for one that only creeps.
    pub fn clinging(&self, flow_ml_s: f64) -> f64 {
        if self.cling_ml_s <= 0.0 { 0.0 } else { (1.0 - flow_ml_s / self.cling_ml_s).clamp(0.0, 1.0) }
    }
}

/// How far the liquid's surface has swung from level, towards the lip above 0.
#[derive(Debug, Clone, Copy, Default)]
pub struct Slosh {
    swing_deg: f64,
    swing_deg_s: f64,
    before: Option<(f64, f64)>,
}

impl Slosh {
    /// Lets `dt_s` pass while the vessel comes to `tilt_deg`. Returns the tilt as the surface has it, degrees.
    pub fn step(&mut self, habits: &Habits, dt_s: f64, tilt_deg: f64) -> f64 {
        if habits.slosh_hz <= 0.0 {
            return tilt_deg;
        }
        let (before_deg, before_deg_s) = self.before.unwrap_or((tilt_deg, 0.0));
        let rate_deg_s = (tilt_deg - before_deg) / dt_s;
        self.before = Some((tilt_deg, rate_deg_s));
        let omega = std::f64::consts::TAU * habits.slosh_hz;
        self.swing_deg_s -= SLOSH_COUPLING * (rate_deg_s - before_deg_s);
        self.swing_deg_s -= (2.0 * SLOSH_DAMPING * omega * self.swing_deg_s + omega * omega * self.swing_deg) * dt_s;
        self.swing_deg += self.swing_deg_s * dt_s;
        tilt_deg + self.swing_deg
    }

    /// How far the surface has swung towards the lip, degrees.
    pub fn swing_deg(&self) -> f64 {
        self.swing_deg
    }
}
