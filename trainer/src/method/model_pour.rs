//! Pours in the fitted flow model: what a law is searched in, and what the network learns on.
//!
//! Pure functions of the offline trainer, for any thread; they allocate and do not fail. A pour is the same for the same seed. Each pour
//! has its own container, liquid, camera and calibration, drawn from what the fit leaves open.

use nalgebra::DMatrix;
use rand::{RngExt, SeedableRng};
use rand_distr::{Distribution, StandardNormal};
use rand_pcg::Pcg64Mcg;
use shared::actions::BACK_DEG_PER_FRAME;
use shared::estimator::flow::{CommandHistory, FlowModel, FlowState, FlowTables, WayBack};
use shared::estimator::{Calibration, Hold};
use shared::limits::{Limiter, Limits};

use crate::fit::{self, Fit};

/// Frames after which a pour counts as never ending: the controller's own default (`controller.max_frames`).
pub const MAX_FRAMES: usize = 900;

/// How much wider than the fit's doubt a pour is drawn (standard deviations), so that a law does not rely on the fit.
mod jitter {
    /// Of the weir coefficient, as a logarithm. From the prototype's recipe; no other measurement is recorded.
    pub const LOG_WEIR_COEFFICIENT: f64 = 0.12;
    /// Of the head's exponent. From the prototype's recipe; no other measurement is recorded.
    pub const HEAD_EXPONENT: f64 = 0.03;
    /// Of the lag, frames. From the prototype's recipe; no other measurement is recorded.
    pub const LAG_FRAMES: f64 = 0.3;
    /// Of the delay, frames. From the prototype's recipe; no other measurement is recorded.
    pub const DELAY_FRAMES: f64 = 0.3;
    /// Of the film's share. From the prototype's recipe; no other measurement is recorded.
    pub const FILM_SHARE: f64 = 0.02;
    /// Of the camera's gain in a pour. Chosen by hand; no measurement is recorded.
    pub const CAMERA_GAIN: f64 = 0.015;
}

/// How the surface of a liquid may swing when the container is accelerated. The fit knows nothing of it, because the episodes' curves are smooth: a law
/// that relies on a level surface lets a third of the vessel out at once where it swings. docs/LEARNING.md has what this gains.
mod swing {
    /// How often it swings, Hz. An independent particle simulation of 250 ml gave about 2; vessels that are half or twice as wide swing within this.
    pub const RATE_HZ: std::ops::Range<f64> = 1.4..2.8;
    /// How fast it swings for each degree/s by which the container's commanded rate changes: up to twice of what that simulation gave, 3 degrees after an
    /// approach at 60 to 90 degrees/s. The joint's lag makes it less. With 0.6 in place of 1, a tuning rig (slosh 205, 2+3) was off by 7.2 ml in place of 2.0.
    pub const COUPLING: std::ops::Range<f64> = 0.0..1.0;
    /// How fast it comes to rest, as a share of the critical damping. Chosen by hand; no measurement is recorded.
    pub const DAMPING: f64 = 0.08;
    /// Number of steps a second, so that the oscillation is followed at every frame rate, and at least as many within a frame. Chosen by hand.
    pub const STEPS: (f64, f64) = (240.0, 8.0);
}

/// The swing of a liquid's surface in a pour.
#[derive(Debug, Clone, Copy)]
struct Swing {
    omega_rad_s: f64,
    coupling: f64,
    deg: f64,
    deg_s: f64,
    /// The tilt in the frame before, degrees, and its rate, degrees/s.
    before: (f64, f64),
}

impl Swing {
    /// One frame of `period_s` in which the container came to `tilt_deg`. Returns the tilt as the surface has it, degrees.
    fn frame(&mut self, period_s: f64, tilt_deg: f64) -> f64 {
        let (before_deg, before_deg_s) = self.before;
        let rate_deg_s = (tilt_deg - before_deg) / period_s;
        self.before = (tilt_deg, rate_deg_s);
        let steps = (swing::STEPS.0 * period_s).ceil().max(swing::STEPS.1);
        let step_s = period_s / steps;
        let pushed_deg_s = self.coupling * (rate_deg_s - before_deg_s) / steps;
        for _ in 0..steps as usize {
            self.deg_s -= pushed_deg_s;
            self.deg_s -= (2.0 * swing::DAMPING * self.omega_rad_s * self.deg_s + self.omega_rad_s.powi(2) * self.deg) * step_s;
            self.deg += self.deg_s * step_s;
        }
        tilt_deg + self.deg
    }
}

/// Goals that are drawn, ml. From the prototype's recipe; no other measurement is recorded.
const GOALS_ML: std::ops::Range<f64> = 8.0..220.0;
/// Largest share of what a container can give within [`LAST_TILT_DEG`] that is drawn as a goal. Chosen by hand; no measurement is
/// recorded.
const GOAL_SHARE_MAX: f64 = 0.85;
/// Tilt up to which a container is poured, degrees. Chosen by hand; no measurement is recorded.
const LAST_TILT_DEG: f64 = 95.0;
/// How far below the lowest onset of the episodes flow may start, degrees. From the prototype's recipe; no other measurement is
/// recorded.
const BELOW_ONSETS_DEG: f64 = 8.0;
/// How far above the highest onset flow may start, degrees. From the prototype's recipe; no other measurement is recorded.
const ABOVE_ONSETS_DEG: f64 = 5.0;
/// Largest distance of an unknown from the fit's value, so that a fit that knows little gives no absurd pours. Chosen by hand; no
/// measurement is recorded.
const MOVED_MAX: f64 = 0.6;
/// Largest error of a calibration in a pour (log), so that a fit that knows little gives no absurd pours. Chosen by hand; no measurement is
/// recorded.
const MISCALIBRATED_MAX: f64 = 0.7;
/// Largest share of frames in which the extraction loses the stream. Chosen by hand; no measurement is recorded.
const DROPOUTS_MAX: f64 = 0.2;

/// The pours that a fit holds possible, and how the controller moves in them.
#[derive(Debug, Clone)]
pub struct PossiblePours {
    /// What the fit holds most likely.
    nominal: FlowModel,
    /// Lower Cholesky factor of the covariance of the fit's unknowns.
    root: DMatrix<f64>,
    /// Angles at which flow may start, lowest and highest, degrees.
    onset_deg: (f64, f64),
    calibration: Calibration,
    /// Lower Cholesky factor of the covariance of the calibration's factor (log) and exponent: its elements (1,1), (2,1) and (2,2).
    calibration_root: [f64; 3],
    /// Share of frames in which the extraction loses the stream.
    dropouts: f64,
    limits: Limits,
    way_back: WayBack,
    rate_hz: f64,
    /// Whether a law sees the fused d, from which what is on its way is taken off, or that of the plain sum.
    pub fused: bool,
}

impl PossiblePours {
    /// The pours of a fit, with the controller's limits and its frames a second.
    pub fn new(fit: &Fit, limits: Limits, rate_hz: f64, fused: bool) -> Self {
        let n = fit.covariance.nrows();
        let mut covariance = fit.covariance.clone();
        for k in 0..n {
            covariance[(k, k)] += 1e-10;
        }
        let root = covariance.cholesky().map_or_else(|| DMatrix::zeros(n, n), |c| c.l());
        let [[cc, cq], [_, qq]] = fit.calibration_covariance;
        let c_sd = cc.max(1e-12).sqrt();
        let calibration_root = [c_sd, cq / c_sd, (qq - cq * cq / (c_sd * c_sd)).max(0.0).sqrt()];
        let low = fit.onsets_deg.iter().copied().fold(f64::INFINITY, f64::min).clamp(5.0, 85.0);
        let high = fit.onsets_deg.iter().copied().fold(f64::NEG_INFINITY, f64::max).clamp(5.0, 85.0);
        Self {
            nominal: fit.model,
            root,
            onset_deg: ((low - BELOW_ONSETS_DEG).max(3.0), (high + ABOVE_ONSETS_DEG).min(88.0)),
            calibration: fit.calibration,
            calibration_root,
            dropouts: fit.dropouts.min(DROPOUTS_MAX),
            limits,
            way_back: WayBack::new(&limits, rate_hz),
            rate_hz,
            fused,
        }
    }

    /// A pour drawn from `seed`.
    pub fn draw(&self, seed: u64) -> ModelPour<'_> {
        let mut rng = Pcg64Mcg::seed_from_u64(seed);
        let mut normal = || -> f64 { StandardNormal.sample(&mut rng) };
        let z: Vec<f64> = (0..self.root.nrows()).map(|_| normal()).collect();
        let by: Vec<f64> =
            (0..self.root.nrows()).map(|r| (0..=r).map(|c| self.root[(r, c)] * z[c]).sum::<f64>().clamp(-MOVED_MAX, MOVED_MAX)).collect();
        let mut model = fit::moved(&self.nominal, &by);
        model.log_weir_coefficient += jitter::LOG_WEIR_COEFFICIENT * normal();
        model.head_exponent = (model.head_exponent + jitter::HEAD_EXPONENT * normal()).clamp(0.5, 3.5);
        model.lag_frames = (model.lag_frames + jitter::LAG_FRAMES * normal()).max(0.0);
        model.delay_frames = (model.delay_frames + jitter::DELAY_FRAMES * normal()).clamp(0.0, 12.0);
        model.film_share = (model.film_share + jitter::FILM_SHARE * normal()).clamp(0.0, 0.4);
        let camera_gain = 1.0 + jitter::CAMERA_GAIN * normal();
        let [l11, l21, l22] = self.calibration_root;
        let (z_c, z_q) = (normal(), normal());
        let miscalibrated = (l11 * z_c, l21 * z_c + l22 * z_q);
        let flow = FlowTables::new(&model, self.rate_hz);
        let swing = Swing {
            omega_rad_s: std::f64::consts::TAU * rng.random_range(swing::RATE_HZ),
            coupling: rng.random_range(swing::COUPLING),
            deg: 0.0,
            deg_s: 0.0,
            before: (0.0, 0.0),
        };
        let onset_deg = rng.random_range(self.onset_deg.0..self.onset_deg.1);
        let headspace_ml = flow.capacity.lost_ml(onset_deg);
        let most_ml = GOAL_SHARE_MAX * (flow.capacity.lost_ml(LAST_TILT_DEG) - headspace_ml);
        let goal_ml = rng.random_range(GOALS_ML).min(most_ml.max(GOALS_ML.start));
        ModelPour {
            pours: self,
            flow,
            camera_gain,
            miscalibrated,
            goal_ml,
            state: FlowState { headspace_ml, ..FlowState::default() },
            level_deg: 0.0,
            poured_ml: 0.0,
            believed_ml: 0.0,
            summed_ml: 0.0,
            commanded: CommandHistory::standing_at(0.0),
            swing,
            surface: CommandHistory::standing_at(0.0),
            limiter: Limiter::new(self.limits, (1.0 / self.rate_hz) as f32, 0.0),
            hold: Hold::default(),
            v_ml: [0.0; 3],
            rng,
        }
    }
}

/// A pour in the model.
#[derive(Debug, Clone)]
pub struct ModelPour<'a> {
    pours: &'a PossiblePours,
    flow: FlowTables,
    camera_gain: f64,
    /// How far the calibration is off: the logarithm of its factor, and its exponent.
    miscalibrated: (f64, f64),
    /// V_G, ml.
    pub goal_ml: f64,
    state: FlowState,
    /// The tilt that the newest picture shows of the container, degrees.
    level_deg: f64,
    poured_ml: f64,
    /// What a fused estimate takes `poured_ml` for.
    believed_ml: f64,
    /// What the plain sum takes it for.
    summed_ml: f64,
    commanded: CommandHistory,
    swing: Swing,
    /// The commanded tilt as the surface of the liquid has it.
    surface: CommandHistory,
    limiter: Limiter,
    hold: Hold,
    /// The last three measured outflows, newest first, ml a frame.
    pub v_ml: [f64; 3],
    rng: Pcg64Mcg,
}

impl ModelPour<'_> {
    /// One frame after the relative angle that was asked for, in degrees (`None` means back). Returns the d that a law sees, ml.
    pub fn frame(&mut self, dalpha_deg: Option<f64>) -> f64 {
        let alpha_deg = f64::from(match dalpha_deg {
            Some(d) => self.limiter.step(self.limiter.alpha_deg() + d as f32),
            None if self.pours.fused => self.limiter.step_upright(),
            None => self.limiter.step(self.limiter.alpha_deg() + BACK_DEG_PER_FRAME),
        });
        self.commanded.push(alpha_deg);
        self.surface.push(self.swing.frame(1.0 / self.pours.rate_hz, alpha_deg));
        let leaves_ml = self.state.step(&self.flow, self.surface.commands(), 0).leaves_ml;
        self.level_deg = self.flow.next_tilt_deg(self.level_deg, self.flow.delayed_deg(self.commanded.commands(), 0, 0.0));
        self.poured_ml += leaves_ml;
        self.see(leaves_ml, alpha_deg);
        if self.pours.fused {
            let stop_ml = if self.poured_ml > 0.0 {
                // The controller knows the container's tilt, and nothing of the swing.
                let known = FlowState { tilt_deg: self.level_deg, ..self.state };
                self.flow.stop_volume_ml(&known, &self.commanded, alpha_deg, self.pours.way_back)
            } else {
                0.0
            };
            self.goal_ml - self.believed_ml - stop_ml
        } else {
            self.goal_ml - self.summed_ml
        }
    }

    /// What the camera makes of an outflow, through the area and the hold, as at run time.
    fn see(&mut self, leaves_ml: f64, alpha_deg: f64) {
        let noise: f64 = StandardNormal.sample(&mut self.rng);
        let dropped = self.rng.random_bool(self.pours.dropouts);
        let doubt = &self.pours.nominal.noise;
        let seen_ml = leaves_ml * self.camera_gain * (doubt.log_frame_volume_sd * noise).exp();
        let seen_ml = if dropped || seen_ml < doubt.least_visible_ml { 0.0 } else { seen_ml };
        let calibration = &self.pours.calibration;
        let exponent = f64::from(calibration.area_exponent);
        let at_1_px2_ml = f64::from(calibration.volume_ml(1.0, alpha_deg as f32));
        // The calibration is surest at the flows that the episodes showed; a law that pours at those meets its goal better.
        let log_area = (leaves_ml.max(1e-6) / at_1_px2_ml).ln() / exponent;
        self.believed_ml +=
            leaves_ml * (self.miscalibrated.0 + self.miscalibrated.1 * log_area).clamp(-MISCALIBRATED_MAX, MISCALIBRATED_MAX).exp();
        let area_px2 = calibration.area_px2(seen_ml, alpha_deg as f32) as f32;
        let held_px2 = self.hold.step(Some(area_px2), calibration.hold_above_px2);
        let v_ml = f64::from(calibration.volume_ml(held_px2, alpha_deg as f32));
        self.v_ml = [v_ml, self.v_ml[0], self.v_ml[1]];
        self.summed_ml += v_ml;
    }

    /// Whether nothing flows and the container is on its way back.
    pub fn over(&self) -> bool {
        self.state.headspace_ml >= self.flow.capacity.lost_ml(self.state.tilt_deg) && self.limiter.rate_deg_s() < 0.0
    }

    /// What will be on the scale minus what should be there, ml.
    pub fn error_ml(&self) -> f64 {
        self.poured_ml + self.state.film_ml - self.goal_ml
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the search from a swing that is none, runs the wrong way, or grows: in an approach at 75 degrees/s the surface is behind by some 3 degrees, as
    /// the particle simulation showed, swings beyond the tilt when the container stops, and comes to rest, at every frame rate; without coupling it stays level.
    #[test]
    fn a_surface_swings_and_comes_to_rest() {
        for rate_hz in [1.0, 5.0, 10.0, 30.0, 125.0, 240.0] {
            let swung = |coupling: f64, from_s: f64, to_s: f64| {
                let omega_rad_s = std::f64::consts::TAU * 2.0;
                let mut swing = Swing { omega_rad_s, coupling, deg: 0.0, deg_s: 0.0, before: (0.0, 0.0) };
                let tilts = (0..(30.0 * rate_hz) as usize).map(|k| k as f64 / rate_hz).map(|at_s| (at_s, 75.0 * at_s.min(1.25)));
                let swings = tilts.map(|(at_s, deg)| (at_s, swing.frame(1.0 / rate_hz, deg) - deg));
                let of_time = swings.filter(|(at_s, _)| (from_s..to_s).contains(at_s)).map(|(_, deg)| deg);
                of_time.fold((0.0f64, 0.0f64), |(low, high), deg| (low.min(deg), high.max(deg)))
            };
            let ((behind, _), (_, beyond)) = (swung(0.5, 0.0, 0.4), swung(0.5, 1.25, 1.75));
            if rate_hz >= 10.0 {
                assert!((-4.5..-1.9).contains(&behind) && (1.9..7.0).contains(&beyond), "{rate_hz} Hz: {behind} and {beyond} degrees");
            }
            let (low, high) = swung(0.5, 20.0, 30.0);
            assert!(high - low < 0.1, "{rate_hz} Hz: it goes on by {low} and {high} degrees");
            assert_eq!(swung(0.0, 0.0, 30.0), (0.0, 0.0));
        }
    }
}
