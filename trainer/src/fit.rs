//! Fits the [flow model](shared::estimator::flow) to weighed episodes: Levenberg-Marquardt on frames and weights.
//!
//! Pure functions of the offline trainer, which allocate and do not fail; the result is the same on any number of threads.
//!
//! Unknown are the model's parameters and the calibration (c, q and its change with the tilt) for all episodes, and for each
//! episode the angle at which flow starts, the flow factor lambda (viscosity), the camera's gain gamma and its delay above the
//! model's. The residuals are, frame by frame, `ln((c area^q + f)/(out e^gamma + f))/(rel q)`, once per episode
//! `(sum out - w_E)/0.6 g`, and the priors. The logarithm keeps c from gaining by being large. The division by q makes it the area
//! that is noisy, or else q would gain by being small. f is a small share of the strongest flow.
//!
//! There are two stages. The wide one finds everything, with frames that count for little; the narrow one holds on to the
//! calibration that the wide one found, and lets the frames decide on vessel and flow.
//!
//! | file | what it holds |
//! |---|---|
//! | `unknowns` | the unknowns in a row, and the model that they stand for |
//! | `prepared` | an episode made ready, and its residuals |
//! | `priors` | what is known before any episode |
//! | `servo` | how the joint follows its commands, where it was measured |
//! | `problem` | the least-squares problem of a stage, and its solution |
//! | `noise` | how sure the fit is |

use nalgebra::DMatrix;
use shared::estimator::Calibration;
use shared::estimator::flow::{DELAY_MAX_FRAMES, FlowModel, FlowNoise, FlowTables};

use crate::calibration;
use crate::data::TrainingEpisode;

mod noise;
mod prepared;
mod priors;
mod problem;
mod servo;
mod unknowns;

use noise::{CHANGE_NEEDS, FrameNoise};
use prepared::{PreparedEpisode, Stage};
use priors::HeldCalibration;
use problem::{Effort, Problem};
use servo::Servo;
use unknowns::{
    AREA_EXPONENT, CAMERA_GAIN, DELAY, EVEN_SHARE, EXTRA_DELAY, FILM_SHARE, HEAD_EXPONENT, LAG, LOG_C, LOG_RADIUS, LOG_SLENDERNESS,
    LOG_WEIR, ONSET, SHARED, TAPER, TILT_SLOPE, Unknowns, model_of,
};

pub use unknowns::moved;

/// A calibration v = c area that meets the weights this well (rms, g) is right: the scale cannot tell it from a perfect one. See
/// docs/LEARNING.md.
const LINEAR_G: f64 = 1.0;
/// Exponents that are tried against q = 1: between those of all cameras.
const LINEAR_RIVALS: [f64; 8] = [0.7, 0.8, 0.9, 0.95, 1.05, 1.1, 1.2, 1.3];
/// Exponents that are so unlike q = 1 that the weights have to speak against them.
const LINEAR_UNLIKE: [f64; 2] = [0.85, 1.15];
/// How much better another exponent may meet the weights, g^2: twice the variance of a reading (0.6 g), which is what one more unknown gains
/// by chance. In a demo whose camera had q = 1.2, q = 1 met five weights to 0.97 g and was taken as right, which made the pours 7 % too large;
/// q = 1.2 met them to 0.40 g, and is ahead by 3.9 g^2.
const LINEAR_BEHIND_G2: f64 = 0.72;
/// How much worse the unlike exponents have to meet the weights, g^2: nine times the variance of a reading, three standard deviations.
const LINEAR_AHEAD_G2: f64 = 3.24;
/// Noise of an episode's sum of areas over that of one frame, for some fifty frames of flow.
const SUM_NOISE: f64 = 0.15;
/// Least noise of a frame's area in an episode's sum, where frames show any. Chosen by hand; no measurement is recorded.
const SUM_NOISE_AREA_SD_MIN: f64 = 0.015;
/// Noise of a frame's area below which a model can turn out to be exact. Chosen by hand; no measurement is recorded.
const CLEAN_AREA_SD: f64 = 0.03;
/// How much a camera's gain is expected to change from pour to pour (log). From the prototype's rigs, whose gain changes by 1.5 %.
const GAIN_EXPECTED: f64 = 0.017;
/// The same for a camera whose areas add up exactly. Chosen by hand; no measurement is recorded.
const GAIN_LINEAR: f64 = 0.002;
/// How much the gain may change in the wide stage (log). From the prototype; no other measurement is recorded.
const GAIN_WIDE: f64 = 0.02;
/// How much the gain may change in the narrow stage (log). From the prototype; no other measurement is recorded.
const GAIN_NARROW: f64 = 0.03;
/// How much the gain may change where the frames show no noise (log): a camera that does not waver within a pour hardly does between
/// two. Chosen by hand; no measurement is recorded.
const GAIN_CLEAN: f64 = 0.004;
/// How far the delays of two episodes are apart as a rule, frames. Tuned on rigs 100 to 123, see docs/LEARNING.md.
const DELAY_KNOWN_FRAMES: f64 = 0.02;
/// How far the delays may be apart when a change is looked for, frames. Tuned on rigs 100 to 123, see docs/LEARNING.md.
const DELAY_FREE_FRAMES: f64 = 1.0;
/// How far the delays may be apart after a change was found, frames. Tuned on rigs 100 to 123, see docs/LEARNING.md.
const DELAY_CHANGED_FRAMES: f64 = 0.3;
/// Below this many episodes the filter's standard deviations are mostly those of the priors, and half of them pours best on rigs 100
/// to 123, see docs/LEARNING.md.
const PRIORS_BELOW: usize = 4;
/// Standard deviation of a pour's flow factor that the filter gets (log). Tuned on rigs 100 to 123, see docs/LEARNING.md.
const FILTER_FLOW_FACTOR_SD: f64 = 0.15;
/// Standard deviation of a pour's delay that the filter gets, frames. Tuned on rigs 100 to 123, see docs/LEARNING.md.
const EXTRA_DELAY_SD_FRAMES: f64 = 0.3;
/// Factor by which the filter doubts the camera's gain more than the episodes show. Tuned on rigs 100 to 123, see
/// docs/LEARNING.md.
const GAIN_DOUBT: f64 = 1.6;
/// Least standard deviation of the capacity's scale, from one pour to the next (log). From the prototype; no other measurement is
/// recorded.
const CAPACITY_SCALE_SD_MIN: f64 = 0.007;
/// Effort of each of the first solutions, which only have to tell beginnings apart. Chosen by hand, see docs/LEARNING.md for the time it
/// takes.
const FIRST_EFFORT: Effort = Effort { steps: 12, tolerance: 1e-3 };
/// Steps of the wide stage's solution. Chosen by hand, see docs/LEARNING.md for the time it takes.
const WIDE_STEPS: usize = 25;
/// Steps of the narrow stage's solution. Chosen by hand, see docs/LEARNING.md for the time it takes.
const NARROW_STEPS: usize = 30;
/// Gain of a step at which the wide and the narrow stage end. Chosen by hand; no measurement is recorded.
const TOLERANCE: f64 = 1e-4;
/// Exponent q of the camera and even share of the vessel from which the fit begins: a cup or something else. The first three serve
/// episodes with noise.
const BEGINNINGS: [(f64, f64); 6] = [(1.15, 0.0), (1.15, 0.7), (1.0, 0.7), (1.0, 0.0), (1.3, 0.0), (1.3, 0.7)];
/// Weir coefficients (log) from which the fit begins: a thin or a thick stream.
const BEGINNINGS_LOG_WEIR: [f64; 2] = [-3.2, -2.2];

/// What was found.
#[derive(Debug, Clone)]
pub struct Fit {
    /// The model, with the uncertainties that the filter needs.
    pub model: FlowModel,
    /// The calibration that was found together with it.
    pub calibration: Calibration,
    /// The angle at which flow started in each episode, degrees.
    pub onsets_deg: Vec<f64>,
    /// Covariance of the unknowns that all episodes share, as [`moved`] takes them.
    pub covariance: DMatrix<f64>,
    /// Covariance of log c and q of the calibration.
    pub calibration_covariance: [[f64; 2]; 2],
    /// Share of zeros within the flow.
    pub dropouts: f64,
}

/// What the episodes say about the camera before anything is fitted.
struct CameraFacts {
    noise: FrameNoise,
    /// Whether the frames have next to no noise.
    clean: bool,
    /// log c of the paper's own calibration, where it is right.
    linear: Option<f64>,
}

impl CameraFacts {
    fn new(episodes: &[TrainingEpisode], prepared: &[PreparedEpisode]) -> Self {
        let noise = FrameNoise::of(prepared);
        let clean = noise.area_sd < CLEAN_AREA_SD;
        Self { noise, clean, linear: linear(episodes).filter(|_| clean) }
    }

    /// Without noise the cost's valleys are narrow, so this many times as many beginnings are tried and as many steps are taken.
    fn longer(&self) -> usize {
        if self.clean { 3 } else { 1 }
    }

    /// A multiple of the frames' noise within bounds, so that frames count for less than they seem to.
    fn tempered_sd(&self, times: f64, most: f64) -> f64 {
        (times * self.noise.area_sd).clamp(0.02 * times, most)
    }

    /// How much the gain may change (log): `noisy`, or less where the frames have next to no noise.
    fn gain_sd(&self, noisy: f64) -> f64 {
        if self.clean { GAIN_CLEAN } else { noisy }
    }

    fn wide_stage(&self) -> Stage {
        let least_sd = if self.clean { 0.0 } else { SUM_NOISE_AREA_SD_MIN };
        Stage {
            area_sd: self.tempered_sd(3.0, 1.0),
            camera_gain_sd: self.gain_sd(GAIN_WIDE),
            extra_delay_sd_frames: DELAY_KNOWN_FRAMES,
            area_sum_sd: SUM_NOISE * self.noise.area_sd.max(least_sd),
        }
    }

    fn narrow_stage(&self, wide: Stage) -> Stage {
        Stage { area_sd: self.tempered_sd(1.5, 0.15), camera_gain_sd: self.gain_sd(GAIN_NARROW), ..wide }
    }
}

/// Fits model and calibration to `episodes`, all of which are usable.
pub fn fit(episodes: &[TrainingEpisode]) -> Fit {
    let mut prepared: Vec<PreparedEpisode> = episodes.iter().map(PreparedEpisode::new).collect();
    let area_min_px2 = prepared.iter().flat_map(|p| &p.area_px2).copied().filter(|a| *a > 0.0).fold(f64::INFINITY, f64::min);
    let area_min_px2 = if area_min_px2.is_finite() { area_min_px2 } else { 1.0 };
    let camera = CameraFacts::new(episodes, &prepared);
    let mut stage = camera.wide_stage();
    let held = camera.linear.map(|log_c| HeldCalibration { log_c, exponent: 1.0, tilt_slope: 0.0 });

    let servo = Servo::of(episodes);
    let problem = Problem { episodes: &prepared, area_min_px2, stage, held, servo };
    let mut found = best_beginning(&problem, episodes, &camera);
    if let Some(delays) = changed_delays(&problem, &found) {
        for ((episode, own), delay) in prepared.iter_mut().zip(&mut found.own).zip(delays) {
            episode.extra_delay_frames = delay;
            own[EXTRA_DELAY] = delay;
        }
        stage.extra_delay_sd_frames = DELAY_CHANGED_FRAMES;
    }
    let wide = Problem { episodes: &prepared, area_min_px2, stage, held, servo };
    wide.solve(&mut found, Effort { steps: WIDE_STEPS * camera.longer(), tolerance: TOLERANCE });
    let wide_covariance = inverse(&wide.linearise(&found).matrix);

    let [log_c, exponent, tilt_slope] = [LOG_C, AREA_EXPONENT, TILT_SLOPE].map(|k| found.shared[k]);
    let held = Some(HeldCalibration { log_c, exponent, tilt_slope });
    let narrow = Problem { stage: camera.narrow_stage(stage), held, ..wide };
    narrow.solve(&mut found, Effort { steps: NARROW_STEPS * camera.longer(), tolerance: TOLERANCE });
    let covariance = inverse(&narrow.linearise(&found).matrix);
    conclude(&found, &camera, (area_min_px2, median_area_px2(&prepared)), &wide_covariance, &covariance)
}

/// Where the fit begins: what is usual for a vessel in a gripper, and the calibration that meets the weights with exponent q.
fn beginning(problem: &Problem<'_>, episodes: &[TrainingEpisode], log_weir: f64, exponent: f64, even_share: f64) -> Unknowns {
    let Servo { delay_frames, lag_frames } = problem.servo.unwrap_or(Servo { delay_frames: 2.0, lag_frames: 2.0 });
    let mut shared = [0.0; SHARED];
    (shared[LOG_RADIUS], shared[LOG_SLENDERNESS], shared[TAPER], shared[EVEN_SHARE]) = (37f64.ln(), 3f64.ln(), 1.0, even_share);
    (shared[LOG_WEIR], shared[HEAD_EXPONENT], shared[LAG], shared[DELAY], shared[FILM_SHARE]) =
        (log_weir, 1.5, lag_frames, delay_frames, 0.05);
    shared[LOG_C] = f64::from(calibration::calibrate(episodes, Some(exponent)).volume_at_1_px2_ml).ln();
    shared[AREA_EXPONENT] = exponent;
    let flow = FlowTables::new(&model_of(&shared));
    Unknowns { shared, own: problem.episodes.iter().map(|p| [p.onset_guess_deg(&flow), 0.0, 0.0, 0.0]).collect() }
}

/// The best of the first solutions, from several beginnings.
fn best_beginning(problem: &Problem<'_>, episodes: &[TrainingEpisode], camera: &CameraFacts) -> Unknowns {
    let begin = |log_weir: f64, (exponent, even_share): (f64, f64)| {
        let mut at = beginning(problem, episodes, log_weir, exponent, even_share);
        let cost = problem.solve(&mut at, FIRST_EFFORT);
        (cost, at)
    };
    let mut best = begin(BEGINNINGS_LOG_WEIR[0], BEGINNINGS[0]);
    for (k, beginning) in BEGINNINGS.into_iter().take(3 * camera.longer()).enumerate() {
        for log_weir in BEGINNINGS_LOG_WEIR.into_iter().skip(usize::from(k == 0)) {
            let other = begin(log_weir, beginning);
            if other.0 < best.0 {
                best = other;
            }
        }
    }
    best.1
}

/// Each episode's delay above the model's, if the delay has changed between the episodes.
fn changed_delays(problem: &Problem<'_>, found: &Unknowns) -> Option<Vec<f64>> {
    if found.own.len() < 2 * CHANGE_NEEDS {
        return None;
    }
    let mut free = found.clone();
    let stage = Stage { extra_delay_sd_frames: DELAY_FREE_FRAMES, ..problem.stage };
    Problem { stage, ..*problem }.solve(&mut free, FIRST_EFFORT);
    let delays = free.of_episodes(EXTRA_DELAY);
    (noise::newest_delay_frames(&delays) != 0.0).then_some(delays)
}

/// log c of the paper's own calibration, if it meets the weights as well as they can be read, no other exponent does so better, and those of
/// most cameras do so worse. A few weights whose streams are alike are met by every exponent, and then say nothing for this one.
fn linear(episodes: &[TrainingEpisode]) -> Option<f64> {
    let with = |exponent: f64| {
        let sums: Vec<(f64, f64)> = episodes.iter().map(|e| (e.weight_g, calibration::area_sum(e, exponent))).collect();
        let c = sums.iter().map(|(w, sum)| w * sum).sum::<f64>() / sums.iter().map(|(_, sum)| sum * sum).sum::<f64>();
        (c, sums.iter().map(|(w, sum)| (w - c * sum).powi(2)).sum::<f64>())
    };
    let (c, squares) = with(1.0);
    let best = LINEAR_RIVALS.map(|q| with(q).1).into_iter().fold(squares, f64::min);
    let usual = LINEAR_UNLIKE.map(|q| with(q).1).into_iter().fold(f64::INFINITY, f64::min);
    let met = squares < LINEAR_G * LINEAR_G * episodes.len() as f64;
    let told = squares - best < LINEAR_BEHIND_G2 && usual - squares > LINEAR_AHEAD_G2;
    (met && told && episodes.len() >= calibration::EXPONENT_NEEDS).then(|| c.ln())
}

/// Model, calibration and their uncertainties from what was found: the newest gain and delay count where they have changed.
///
/// `areas_px2` are the smallest area that the camera shows, and the one at which the calibration's doubt is taken.
fn conclude(found: &Unknowns, camera: &CameraFacts, areas_px2: (f64, f64), wide: &DMatrix<f64>, narrow: &DMatrix<f64>) -> Fit {
    let (area_min_px2, judged_at_px2) = areas_px2;
    let gains = found.of_episodes(CAMERA_GAIN);
    let (log_c, exponent) = (found.shared[LOG_C] - noise::newest_gain(&gains), found.shared[AREA_EXPONENT]);
    let mut model = model_of(&found.shared);
    let newest_delay = noise::newest_delay_frames(&found.of_episodes(EXTRA_DELAY));
    model.delay_frames = (model.delay_frames + newest_delay).clamp(0.0, DELAY_MAX_FRAMES);
    // The standard deviation of log v = log c + q log area, as the wide stage knows it, where the episodes' areas are.
    let log_area = judged_at_px2.ln();
    let log_v_variance =
        wide[(LOG_C, LOG_C)] + 2.0 * log_area * wide[(LOG_C, AREA_EXPONENT)] + log_area * log_area * wide[(AREA_EXPONENT, AREA_EXPONENT)];
    let share = if found.own.len() < PRIORS_BELOW { 0.5 } else { 1.0 };
    let gain_expected = if camera.linear.is_some() { GAIN_LINEAR } else { GAIN_EXPECTED };
    let gain_sd = (noise::camera_gain_sd(&gains, gain_expected) * exponent / calibration::EXPONENT_EXPECTED)
        .hypot(0.5 * share * log_v_variance.max(0.0).sqrt());
    let vessel_sd = CAPACITY_SCALE_SD_MIN.hypot(noise::vessel_variance(found, narrow).sqrt());
    model.noise = FlowNoise {
        log_flow_factor_sd: FILTER_FLOW_FACTOR_SD,
        log_camera_gain_sd: (GAIN_DOUBT * gain_sd).min(0.5),
        log_capacity_scale_sd: share * noise::trusted_vessel_sd(vessel_sd),
        extra_delay_sd_frames: EXTRA_DELAY_SD_FRAMES,
        log_frame_volume_sd: (camera.noise.area_sd * exponent).clamp(0.02, 1.0),
        least_visible_ml: log_c.exp() * area_min_px2.powf(exponent),
    };
    Fit {
        model,
        calibration: Calibration {
            volume_at_1_px2_ml: log_c.exp() as f32,
            area_exponent: exponent as f32,
            log_tilt_slope: found.shared[TILT_SLOPE] as f32,
            hold_above_px2: calibration::HOLD_ABOVE_PX2,
        },
        onsets_deg: found.of_episodes(ONSET),
        covariance: narrow.view((0, 0), (SHARED, SHARED)).into_owned(),
        calibration_covariance: [LOG_C, AREA_EXPONENT].map(|i| [LOG_C, AREA_EXPONENT].map(|j| wide[(i, j)])),
        dropouts: camera.noise.dropouts,
    }
}

/// The median of all areas with a stream, px^2; 1 without any.
fn median_area_px2(prepared: &[PreparedEpisode]) -> f64 {
    let mut areas: Vec<f64> = prepared.iter().flat_map(|p| &p.area_px2).copied().filter(|a| *a > 0.0).collect();
    areas.sort_by(f64::total_cmp);
    areas.get(areas.len() / 2).copied().unwrap_or(1.0)
}

/// The inverse of a matrix J'J, or a wide diagonal matrix where it has none.
fn inverse(matrix: &DMatrix<f64>) -> DMatrix<f64> {
    let mut damped = matrix.clone();
    for k in 0..damped.nrows() {
        damped[(k, k)] += 1e-9;
    }
    damped.cholesky().map_or_else(|| DMatrix::identity(matrix.nrows(), matrix.ncols()) * 0.01, |c| c.inverse())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the paper's own calibration where it is right: areas in proportion to the weights give its c, others none.
    #[test]
    fn a_linear_camera_is_recognised() {
        let weighed = |weights: &[(f64, f64)]| -> Vec<TrainingEpisode> {
            let one = |(area, weight_g): &(f64, f64)| {
                let mut e = TrainingEpisode::empty("x", 30.0);
                (0..40).for_each(|k| e.push(f64::from(k) / 30.0, 50.0, f64::NAN, if k > 5 { *area } else { 0.0 }));
                e.weight_g = *weight_g;
                e
            };
            weights.iter().map(one).collect()
        };
        // 34 frames of flow at 400 px^2 a ml.
        let found = linear(&weighed(&[(400.0, 34.0), (800.0, 68.4), (1200.0, 101.7), (1600.0, 136.0)]));
        assert!((found.unwrap() - (1.0f64 / 400.0).ln()).abs() < 5e-3);
        assert_eq!(linear(&weighed(&[(400.0, 34.0), (800.0, 74.0), (1200.0, 101.7), (1600.0, 136.0)])), None);
        assert_eq!(linear(&weighed(&[(400.0, 34.0), (800.0, 68.0), (1200.0, 102.0)])), None, "too few");
        // What a camera with q = 1.2 shows of four streams that are alike: q = 1 meets all weights to 0.5 g.
        let alike = [3000.0, 3100.0, 3200.0, 3300.0].map(|area: f64| (area, (60.0 * (area / 3000.0).powf(1.2)).round()));
        assert_eq!(linear(&weighed(&alike)), None, "they cannot tell");
    }
}
