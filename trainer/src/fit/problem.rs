//! The least-squares problem of a stage of the fit, and Levenberg-Marquardt on it.
//!
//! Pure functions of the offline trainer, which allocate and do not fail. The result is the same on any number of threads, because episodes
//! are worked on in parallel and summed in order.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;
use shared::estimator::flow::{FlowModel, FlowTables};
use shared::estimator::vessel::{KNOTS, knot_deg};

use super::prepared::{PreparedEpisode, Stage};
use super::priors::{HeldCalibration, Priors};
use super::unknowns::{AREA_EXPONENT, DELAY, FILM_SHARE, HEAD_EXPONENT, LAG, LOG_C, ONSET, OWN, SHARED, Unknowns, model_of};

/// Step of the difference quotients.
const NUDGE: f64 = 1e-4;
/// Step of the difference quotients in log c and q, which enter with high powers of the area.
const FINE_NUDGE: f64 = 1e-5;
/// Damping of the first step. Chosen by hand; no measurement is recorded.
const FIRST_DAMPING: f64 = 1e-2;
/// Least damping. Chosen by hand; no measurement is recorded.
const DAMPING_MIN: f64 = 1e-7;
/// Dampings that are tried for one step. Chosen by hand; no measurement is recorded.
const TRIES: usize = 8;
/// Largest step in an episode's own unknowns, degrees, frames or logarithm. Chosen by hand; no measurement is recorded.
const OWN_STEP_MAX: f64 = 8.0;

/// How long a solution may take, and when it is good enough.
#[derive(Debug, Clone, Copy)]
pub struct Effort {
    /// Steps at most.
    pub steps: usize,
    /// The solution ends when a step gains less than this share of the cost.
    pub tolerance: f64,
}

/// A stage of the fit.
pub struct Problem<'a> {
    /// The episodes.
    pub episodes: &'a [PreparedEpisode],
    /// Smallest area that the camera shows, px^2.
    pub area_min_px2: f64,
    /// How much the episodes may differ.
    pub stage: Stage,
    /// A calibration that is held on to.
    pub held: Option<HeldCalibration>,
    /// What is known before any episode.
    pub priors: &'a Priors,
}

/// The normal equations at a point: J'J and J'r. The shared unknowns come first, then those of each episode.
pub struct NormalEquations {
    /// J'J.
    pub matrix: DMatrix<f64>,
    vector: DVector<f64>,
}

/// J'J and J'r of some residuals, from their values and their difference quotients.
fn normal(jacobian: &DMatrix<f64>, residuals: Vec<f64>) -> (DMatrix<f64>, DVector<f64>) {
    (jacobian.tr_mul(jacobian), jacobian.tr_mul(&DVector::from_vec(residuals)))
}

/// Writes a column of difference quotients.
fn set_column(jacobian: &mut DMatrix<f64>, column: usize, moved: &[f64], base: &[f64], step: f64) {
    for (row, (m, b)) in moved.iter().zip(base).enumerate() {
        jacobian[(row, column)] = (m - b) / step;
    }
}

fn sum_of_squares(residuals: &[f64]) -> f64 {
    residuals.iter().map(|r| r * r).sum()
}

impl Problem<'_> {
    /// The flow model of the shared unknowns.
    pub fn model_of(&self, shared: &[f64; SHARED]) -> FlowModel {
        model_of(shared, self.priors.vessel.even_share)
    }

    /// The tables of that model.
    pub fn flow_of(&self, shared: &[f64; SHARED]) -> FlowTables {
        FlowTables::new(&self.model_of(shared), self.priors.rate_hz)
    }

    /// Whether a knot of the vessel's shape changes what the model says of an episode: it must be near the tilts at which something flowed.
    fn matters(&self, knot: usize, episode: usize, onset_deg: f64) -> bool {
        let (below, above) = (knot_deg(knot.saturating_sub(1)), knot_deg(knot + 1));
        let at_end = knot == 0 || knot + 1 == KNOTS;
        at_end || (above >= onset_deg && below <= self.episodes[episode].top_deg + 1.0)
    }

    fn episode_residuals(&self, k: usize, flow: &FlowTables, shared: &[f64; SHARED], own: &[f64; OWN]) -> Vec<f64> {
        self.episodes[k].residuals(flow, shared, own, &self.stage, self.area_min_px2)
    }

    /// Sum of all squared residuals; infinite where it is not a number.
    fn cost(&self, at: &Unknowns) -> f64 {
        let flow = self.flow_of(&at.shared);
        let parts: Vec<f64> = (0..self.episodes.len())
            .into_par_iter()
            .map(|k| sum_of_squares(&self.episode_residuals(k, &flow, &at.shared, &at.own[k])))
            .collect();
        let total = sum_of_squares(&self.priors.residuals(&at.shared, self.held)) + parts.iter().sum::<f64>();
        if total.is_finite() { total } else { f64::INFINITY }
    }

    /// The normal equations at a point, from difference quotients.
    pub fn linearise(&self, at: &Unknowns) -> NormalEquations {
        let step = |k: usize| if k == AREA_EXPONENT || k == LOG_C { FINE_NUDGE } else { NUDGE };
        let nudged: Vec<([f64; SHARED], FlowTables)> = (0..SHARED)
            .map(|k| {
                let mut shared = at.shared;
                shared[k] += step(k);
                (shared, self.flow_of(&shared))
            })
            .collect();
        let flow = self.flow_of(&at.shared);
        let blocks: Vec<(DMatrix<f64>, DVector<f64>)> = (0..self.episodes.len())
            .into_par_iter()
            .map(|e| {
                let base = self.episode_residuals(e, &flow, &at.shared, &at.own[e]);
                let mut jacobian = DMatrix::zeros(base.len(), SHARED + OWN);
                for (k, (shared, flow)) in nudged.iter().enumerate() {
                    if k < KNOTS && !self.matters(k, e, at.own[e][ONSET]) {
                        continue;
                    }
                    let moved = self.episode_residuals(e, flow, shared, &at.own[e]);
                    set_column(&mut jacobian, k, &moved, &base, step(k));
                }
                for k in 0..OWN {
                    let mut own = at.own[e];
                    own[k] += NUDGE;
                    let moved = self.episode_residuals(e, &flow, &at.shared, &own);
                    set_column(&mut jacobian, SHARED + k, &moved, &base, NUDGE);
                }
                normal(&jacobian, base)
            })
            .collect();
        let n = SHARED + OWN * self.episodes.len();
        let mut sum = NormalEquations { matrix: DMatrix::zeros(n, n), vector: DVector::zeros(n) };
        for (e, block) in blocks.iter().enumerate() {
            sum.add(block, |k| if k < SHARED { k } else { k + OWN * e });
        }
        sum.add(&self.linearised_priors(&at.shared), |k| k);
        sum
    }

    /// The priors' part of the normal equations.
    fn linearised_priors(&self, shared: &[f64; SHARED]) -> (DMatrix<f64>, DVector<f64>) {
        let base = self.priors.residuals(shared, self.held);
        let mut jacobian = DMatrix::zeros(base.len(), SHARED);
        for k in 0..SHARED {
            let mut nudged = *shared;
            nudged[k] += NUDGE;
            set_column(&mut jacobian, k, &self.priors.residuals(&nudged, self.held), &base, NUDGE);
        }
        normal(&jacobian, base)
    }

    /// The point after a step, put back inside the bounds of what makes sense.
    fn stepped(&self, at: &Unknowns, step: &DVector<f64>) -> Unknowns {
        let mut next = at.clone();
        for (k, value) in next.shared.iter_mut().enumerate() {
            *value -= step[k];
        }
        for (e, own) in next.own.iter_mut().enumerate() {
            for (k, value) in own.iter_mut().enumerate() {
                *value -= step[SHARED + OWN * e + k].clamp(-OWN_STEP_MAX, OWN_STEP_MAX);
            }
        }
        let model = self.model_of(&next.shared);
        next.shared[HEAD_EXPONENT] = model.head_exponent;
        next.shared[LAG] = model.lag_frames;
        next.shared[DELAY] = model.delay_frames;
        next.shared[FILM_SHARE] = model.film_share;
        next
    }

    /// Levenberg-Marquardt from `at`, which it moves. Returns the cost that it reached.
    pub fn solve(&self, at: &mut Unknowns, effort: Effort) -> f64 {
        let mut cost = self.cost(at);
        let mut damping = FIRST_DAMPING;
        for _ in 0..effort.steps {
            let equations = self.linearise(at);
            let before = cost;
            for _ in 0..TRIES {
                let Some(step) = equations.step(damping) else {
                    damping *= 10.0;
                    continue;
                };
                let next = self.stepped(at, &step);
                let new = self.cost(&next);
                if new < cost {
                    *at = next;
                    cost = new;
                    damping = (damping * 0.3).max(DAMPING_MIN);
                    break;
                }
                damping *= 5.0;
            }
            if before - cost < effort.tolerance * before.max(1.0) {
                break;
            }
        }
        cost
    }
}

impl NormalEquations {
    /// Adds a block, whose unknown k is the unknown `index(k)` here.
    fn add(&mut self, (matrix, vector): &(DMatrix<f64>, DVector<f64>), index: impl Fn(usize) -> usize) {
        for r in 0..vector.len() {
            self.vector[index(r)] += vector[r];
            for c in 0..vector.len() {
                self.matrix[(index(r), index(c))] += matrix[(r, c)];
            }
        }
    }

    /// The damped step; `None` where the damped matrix is not positive definite.
    fn step(&self, damping: f64) -> Option<DVector<f64>> {
        let mut damped = self.matrix.clone();
        for k in 0..damped.nrows() {
            damped[(k, k)] += damping * self.matrix[(k, k)].max(1e-9);
        }
        damped.cholesky().map(|cholesky| cholesky.solve(&self.vector))
    }
}
