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
//! There are two explanations, each fitted in three stages in which the frames count ever more: a vessel of any shape, and one with straight
//! walls. The evidence for each decides how much it counts at run time. In the first stage the weights count for more
//! than the frames. The camera's own sum is calibrated from the weights alone.
//!
//! | file | what it holds |
//! |---|---|
//! | `tilts` | the tilt of each episode, measured or commanded |
//! | `unknowns` | the unknowns in a row, and the model that they stand for |
//! | `prepared` | an episode made ready, and its residuals |
//! | `priors` | what is known before any episode |
//! | `problem` | the least-squares problem of a stage, and its solution |
//! | `noise` | the noise of frames and pours, and what has changed between them |
//! | `fitted` | the solution of a stage |
//! | `doubts` | how far a pour may be off the fit |

use nalgebra::DMatrix;
use shared::estimator::Calibration;
use shared::estimator::flow::{DELAY_MAX_FRAMES, FlowModel, FlowNoise, Lateness, WayBack};
use shared::estimator::fused::{Explanation, FusedEstimator, FusedFrame, FusedModel, TIGHT, WIDE};
use shared::estimator::verdict::{AREA_MARGIN, Bounds};
use shared::estimator::whiteness::Whiteness;
use shared::limits::Limits;

use crate::calibration::{self, Doubted};
use crate::data::{self, TrainingEpisode};

mod doubts;
mod fitted;
mod noise;
mod prepared;
mod priors;
mod problem;
mod tilts;
mod unknowns;

use doubts::Doubt;
use fitted::Fitted;
use noise::FrameNoise;
use prepared::{PreparedEpisode, Stage};
use priors::{HeldCalibration, Priors, VesselPrior};
use problem::{Effort, Problem};
use tilts::Tilts;
use unknowns::{
    AREA_EXPONENT, CAMERA_GAIN, DELAY, EXTRA_DELAY, FILM_SHARE, HEAD_EXPONENT, LAG, LOG_C, LOG_RADIUS, LOG_SLENDERNESS, LOG_WEIR, ONSET,
    SHARED, TAPER, Unknowns,
};

pub use noise::{CHANGE_NEEDS, Changed};
pub use unknowns::moved;

/// A calibration v = c area that meets the weights this well (rms, g) is right: the scale cannot tell it from a perfect one. See
/// docs/LEARNING.md.
const LINEAR_G: f64 = 1.0;
/// Exponents that are tried against q = 1: between those of all cameras.
const LINEAR_RIVALS: [f64; 8] = [0.7, 0.8, 0.9, 0.95, 1.05, 1.1, 1.2, 1.3];
/// Exponents that are so unlike q = 1 that the weights have to speak against them.
const LINEAR_UNLIKE: [f64; 2] = [0.85, 1.15];
/// How much better another exponent may meet the weights, g^2: twice the variance of a reading (0.6 g), which is what one more unknown gains
/// by chance. In a demo whose camera had q = 1.25, q = 1 met five weights to 0.97 g and was taken as right, which made the pours 7 % too large;
/// q = 1.25 met them to 0.44 g, and is ahead by 3.7 g^2.
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
/// How much the gain may change in the fit (log). From the prototype; no other measurement is recorded.
const GAIN_SD: f64 = 0.02;
/// How much the gain may change where the calibration is exact (log). Quiet frames alone say nothing of it: of ten weights that a quiet camera missed by
/// 6 %, no more came out. Chosen by hand; no measurement is recorded.
const GAIN_EXACT: f64 = 0.004;
/// How far the gain may be from the model's when a change is looked for (log): a lens that was touched. Chosen by hand; no measurement is
/// recorded.
const GAIN_FREE: f64 = 0.15;
/// How far the delays of two episodes are apart as a rule, frames. Tuned on rigs 100 to 123, see docs/LEARNING.md.
const DELAY_KNOWN_FRAMES: f64 = 0.02;
/// How far the delays may be apart when a change is looked for, frames. Tuned on rigs 100 to 123, see docs/LEARNING.md.
const DELAY_FREE_FRAMES: f64 = 1.0;
/// How far the delays may be apart after a change was found, frames. Tuned on rigs 100 to 123, see docs/LEARNING.md.
const DELAY_CHANGED_FRAMES: f64 = 0.3;
/// Noise of a frame in each stage, over what the frames show: they are less independent than they seem. From the prototype; no other
/// measurement is recorded.
const TEMPERS: [f64; 3] = [4.0, 3.0, 1.5];
/// The least noise of a frame that is fitted with, before it is tempered. Chosen by hand; no measurement is recorded.
const AREA_SD_MIN: f64 = 0.02;
/// The weight of the straight vessel below which it counts as refuted. From the prototype; no other measurement is recorded.
const TIGHT_SHARE_MIN: f64 = 0.01;
/// Correlation of the innovations over all episodes up to which the straight vessel is fully trusted, and from which on it counts as refuted.
/// On rigs 100 to 107 and 200 to 207 it was -0.05 to 0.00 for straight vessels, and 0.2 to 0.8 for others.
const TRUSTED_CORRELATION: (f64, f64) = (0.10, 0.20);

/// How far beyond the highest onset of the episodes a container may be tilted without any flow, degrees. Chosen by hand; docs/LEARNING.md has
/// the false alarms.
const DRY_MARGIN_DEG: f64 = 25.0;

/// Effort of each of the first solutions, which only have to tell beginnings apart. Chosen by hand, see docs/LEARNING.md for the time it
/// takes.
const FIRST_EFFORT: Effort = Effort { steps: 8, tolerance: 1e-2 };
/// Steps of each stage's solution. Chosen by hand, see docs/LEARNING.md for the time it takes.
const STEPS: usize = 20;
/// Gain of a step at which a stage ends. Chosen by hand; no measurement is recorded.
const TOLERANCE: f64 = 3e-4;
/// Exponents q from which the fit begins; the first one serves episodes with noise.
const BEGINNINGS: [f64; 3] = [1.18, 1.0, 1.35];
/// Weir coefficients (log) from which the fit begins: a thin or a thick stream.
const BEGINNINGS_LOG_WEIR: [f64; 2] = [-3.2, -2.3];

/// What was found.
#[derive(Debug, Clone)]
pub struct Fit {
    /// The likelier explanation's model.
    pub model: FlowModel,
    /// Both explanations, with what the filters need.
    pub fused: FusedModel,
    /// The calibration of the camera's own sum.
    pub calibration: Calibration,
    /// The angle at which flow started in each episode, degrees.
    pub onsets_deg: Vec<f64>,
    /// Covariance of the unknowns that all episodes share, as [`moved`] takes them.
    pub covariance: DMatrix<f64>,
    /// Covariance of log c and q of the calibration.
    pub calibration_covariance: [[f64; 2]; 2],
    /// Share of zeros within the flow.
    pub dropouts: f64,
    /// How the camera's gain (log) has changed between the episodes, if it has: only the newest gain counts then.
    pub changed_gain: Option<Changed>,
    /// How it may have changed with the newest episodes, which are too few for it to count, if nothing else has changed it.
    pub suspected_gain: Option<Changed>,
}

/// What the episodes say about the camera before anything is fitted.
struct CameraFacts {
    noise: FrameNoise,
    /// Whether the frames have next to no noise.
    clean: bool,
    /// log c of the paper's own calibration, where it is right.
    linear: Option<f64>,
    /// Smallest area that the camera shows, px^2.
    area_min_px2: f64,
}

impl CameraFacts {
    fn new(episodes: &[TrainingEpisode], prepared: &[PreparedEpisode]) -> Self {
        let noise = FrameNoise::of(prepared);
        let clean = noise.area_sd < CLEAN_AREA_SD;
        let area_min_px2 = prepared.iter().flat_map(|p| &p.area_px2).copied().filter(|a| *a > 0.0).fold(f64::INFINITY, f64::min);
        let area_min_px2 = if area_min_px2.is_finite() { area_min_px2 } else { 1.0 };
        Self { noise, clean, linear: linear(episodes).filter(|_| clean), area_min_px2 }
    }

    /// Without noise the cost's valleys are narrow, so this many times as many beginnings are tried and as many steps are taken.
    fn longer(&self) -> usize {
        if self.clean { 3 } else { 1 }
    }

    /// The problem of a stage.
    fn problem<'a>(&self, episodes: &'a [PreparedEpisode], priors: &'a Priors, stage: Stage) -> Problem<'a> {
        let held = self.linear.map(|log_c| HeldCalibration { log_c, exponent: 1.0, tilt_slope: 0.0 });
        Problem { episodes, area_min_px2: self.area_min_px2, stage, held, priors }
    }

    /// The stage in which frames have `temper` times the noise that they show.
    fn stage(&self, temper: f64, extra_delay_sd_frames: f64) -> Stage {
        let least_sd = if self.clean { 0.0 } else { SUM_NOISE_AREA_SD_MIN };
        Stage {
            area_sd: (temper * self.noise.area_sd.max(AREA_SD_MIN)).min(0.3 * temper),
            camera_gain_sd: if self.linear.is_some() { GAIN_EXACT } else { GAIN_SD },
            extra_delay_sd_frames,
            area_sum_sd: SUM_NOISE * self.noise.area_sd.max(least_sd),
        }
    }
}

/// Fits model and calibration to `episodes`, all of which are usable.
pub fn fit(episodes: &[TrainingEpisode]) -> Fit {
    let tilts = Tilts::of(episodes);
    let mut prepared: Vec<PreparedEpisode> =
        episodes.iter().zip(tilts.alpha_deg).map(|(e, alpha_deg)| PreparedEpisode::new(e, alpha_deg)).collect();
    let camera = CameraFacts::new(episodes, &prepared);
    let priors = |vessel| Priors { vessel, measured: tilts.robot.is_some(), clean: camera.clean, rate_hz: data::rate_hz(episodes) };
    let (wide, tight) = (priors(VesselPrior::wide()), priors(VesselPrior::tight()));
    let first = camera.stage(TEMPERS[0], DELAY_KNOWN_FRAMES);
    let mut starts = {
        let begin = |priors| best_beginning(&camera.problem(&prepared, priors, first), episodes, &camera);
        let (wide, tight) = rayon::join(|| begin(&wide), || begin(&tight));
        [wide, tight]
    };
    let changes = Changes::of(&camera.problem(&prepared, &wide, first), &starts[WIDE]);
    for (k, episode) in prepared.iter_mut().enumerate() {
        if let Some(delays) = &changes.delays {
            episode.extra_delay_frames = delays[k];
            starts.iter_mut().for_each(|start| start.own[k][EXTRA_DELAY] = delays[k]);
        }
        if let Some(gain) = &changes.gain {
            episode.log_camera_gain = gain.at(k);
            starts.iter_mut().for_each(|start| start.own[k][CAMERA_GAIN] = gain.at(k));
        }
    }
    let delay_sd_frames = if changes.delays.is_some() { DELAY_CHANGED_FRAMES } else { DELAY_KNOWN_FRAMES };
    let stages = TEMPERS.map(|temper| camera.stage(temper, delay_sd_frames));
    let solve = |priors: &Priors, start: &Unknowns| -> [Fitted; 3] {
        let mut at = start.clone();
        stages.map(|stage| {
            let problem = camera.problem(&prepared, priors, stage);
            let cost = problem.solve(&mut at, Effort { steps: STEPS * camera.longer(), tolerance: TOLERANCE });
            Fitted::of(&problem, &at, cost)
        })
    };
    let ([tempered, _, wide], [_, _, tight]) = rayon::join(|| solve(&wide, &starts[WIDE]), || solve(&tight, &starts[TIGHT]));
    let conclusion = Conclusion {
        recorded: episodes,
        episodes: &prepared,
        camera: &camera,
        robot: tilts.robot,
        changed_gain: changes.gain,
        suspected_gain: changes.suspected,
        tempered: &tempered,
        wide: &wide,
        tight: &tight,
    };
    conclusion.fit()
}

/// Where the fit begins: what is usual for a vessel in a gripper, and the calibration that meets the weights with exponent q.
fn beginning(problem: &Problem<'_>, episodes: &[TrainingEpisode], log_weir: f64, exponent: f64) -> Unknowns {
    let mut shared = [0.0; SHARED];
    (shared[LOG_RADIUS], shared[LOG_SLENDERNESS], shared[TAPER]) = (37f64.ln(), 3f64.ln(), 1.0);
    let (lag, delay) = if problem.priors.measured { (0.3, 1.0) } else { (2.0, 2.0) };
    let slower = problem.priors.slower();
    (shared[LAG], shared[DELAY]) = (lag * slower, delay * slower);
    (shared[LOG_WEIR], shared[HEAD_EXPONENT], shared[FILM_SHARE]) = (log_weir - slower.ln(), 1.5, 0.05);
    shared[LOG_C] = f64::from(calibration::calibrate(episodes, Some(exponent)).volume_at_1_px2_ml).ln();
    shared[AREA_EXPONENT] = exponent;
    let flow = problem.flow_of(&shared);
    Unknowns { shared, own: problem.episodes.iter().map(|p| [p.onset_guess_deg(&flow), 0.0, 0.0, 0.0]).collect() }
}

/// The best of the first solutions, from several beginnings.
fn best_beginning(problem: &Problem<'_>, episodes: &[TrainingEpisode], camera: &CameraFacts) -> Unknowns {
    let mut best: Option<(f64, Unknowns)> = None;
    for exponent in BEGINNINGS.into_iter().take(camera.longer()) {
        for log_weir in BEGINNINGS_LOG_WEIR {
            let mut at = beginning(problem, episodes, log_weir, exponent);
            let cost = problem.solve(&mut at, FIRST_EFFORT);
            if best.as_ref().is_none_or(|(least, _)| cost < *least) {
                best = Some((cost, at));
            }
        }
    }
    best.map_or_else(|| beginning(problem, episodes, BEGINNINGS_LOG_WEIR[0], BEGINNINGS[0]), |(_, at)| at)
}

/// What has changed between the episodes.
#[derive(Default)]
struct Changes {
    /// Each episode's delay above the model's, if the delay has changed.
    delays: Option<Vec<f64>>,
    /// The camera's gain (log), if it has changed.
    gain: Option<Changed>,
    /// The camera's gain (log), if the newest episodes alone have another one.
    suspected: Option<Changed>,
}

impl Changes {
    /// Lets the episodes differ freely, and looks for a change.
    fn of(problem: &Problem<'_>, found: &Unknowns) -> Self {
        if found.own.len() <= CHANGE_NEEDS {
            return Self::default();
        }
        let freed = |stage| {
            let mut free = found.clone();
            Problem { stage, ..*problem }.solve(&mut free, FIRST_EFFORT);
            free
        };
        let gains = freed(Stage { camera_gain_sd: GAIN_FREE, ..problem.stage }).of_episodes(CAMERA_GAIN);
        let suspected = noise::suspected_gain(&gains);
        if found.own.len() < 2 * CHANGE_NEEDS {
            return Self { suspected, ..Self::default() };
        }
        let delays = freed(Stage { extra_delay_sd_frames: DELAY_FREE_FRAMES, ..problem.stage }).of_episodes(EXTRA_DELAY);
        Self { delays: (noise::newest_delay_frames(&delays) != 0.0).then_some(delays), gain: noise::changed_gain(&gains), suspected }
    }
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

/// All that is known in the end.
struct Conclusion<'a> {
    recorded: &'a [TrainingEpisode],
    episodes: &'a [PreparedEpisode],
    camera: &'a CameraFacts,
    /// How the measured tilt follows the commanded one.
    robot: Option<Lateness>,
    /// The change of the camera's gain that was known before the last stages.
    changed_gain: Option<Changed>,
    /// What it may have changed by with the newest episodes.
    suspected_gain: Option<Changed>,
    /// The first stage of the vessel of any shape.
    tempered: &'a Fitted,
    wide: &'a Fitted,
    tight: &'a Fitted,
}

impl Conclusion<'_> {
    /// The model of an explanation, as it counts from now on: with the newest delay, and following commands too.
    fn model(&self, fitted: &Fitted) -> FlowModel {
        let mut model = fitted.model;
        let newest_delay = noise::newest_delay_frames(&fitted.found.of_episodes(EXTRA_DELAY));
        model.delay_frames = (model.delay_frames + newest_delay).clamp(0.0, DELAY_MAX_FRAMES);
        if let Some(robot) = self.robot {
            model.measured = Some(Lateness { lag_frames: model.lag_frames, delay_frames: model.delay_frames });
            model.lag_frames += robot.lag_frames;
            model.delay_frames = (model.delay_frames + robot.delay_frames).clamp(0.0, DELAY_MAX_FRAMES);
        }
        let calibration = fitted.calibration(&fitted.found.of_episodes(CAMERA_GAIN));
        let exponent = f64::from(calibration.area_exponent);
        model.noise = FlowNoise {
            log_frame_volume_sd: (self.camera.noise.area_sd * exponent).clamp(0.02, 1.0),
            least_visible_ml: f64::from(calibration.volume_at_1_px2_ml) * self.camera.area_min_px2.powf(exponent),
        };
        model
    }

    fn explanation(&self, fitted: &Fitted, doubt: Doubt) -> Explanation {
        let calibration = fitted.calibration(&fitted.found.of_episodes(CAMERA_GAIN));
        Explanation { model: self.model(fitted), calibration, unknowns: doubts::unknowns(fitted, doubt) }
    }

    /// What the episodes showed at most, with a margin.
    fn bounds(&self) -> Bounds {
        let most = |values: &mut dyn Iterator<Item = f64>| values.fold(1.0, f64::max);
        let largest_px2 = most(&mut self.episodes.iter().map(|e| e.smooth_max_px2));
        let onset_deg = most(&mut self.wide.found.of_episodes(ONSET).into_iter());
        Bounds { most_px2: AREA_MARGIN * largest_px2, dry_deg: (onset_deg + DRY_MARGIN_DEG).clamp(1.0, 180.0) }
    }

    fn fit(&self) -> Fit {
        let frames: usize = self.episodes.iter().map(PreparedEpisode::frames_with_flow).sum();
        let odds = (self.tight.log_evidence - self.wide.log_evidence).clamp(-50.0, 50.0);
        // Where neither has evidence the odds are no number, and the straight vessel has no weight.
        let tight_share = Some(1.0 / (1.0 + (-odds).exp())).filter(|share| *share >= TIGHT_SHARE_MIN).unwrap_or(0.0);
        let gains: Vec<f64> =
            self.tempered.found.own.iter().zip(self.episodes).map(|(own, e)| own[CAMERA_GAIN] - e.log_camera_gain).collect();
        let exact = self.camera.linear.is_some();
        let gain_expected = if exact { GAIN_EXACT } else { GAIN_EXPECTED };
        let Doubted { calibration, covariance, pour_sd } = self.camera();
        // Each place that takes the newest gain alone is a change.
        let changed_gain = self
            .changed_gain
            .or_else(|| [self.wide, self.tight].into_iter().find_map(|fitted| noise::changed_gain(&fitted.found.of_episodes(CAMERA_GAIN))));
        let suspected_gain = self.suspected_gain.filter(|_| changed_gain.is_none());
        // The pours to come may have the one gain or the other.
        let apart = suspected_gain.map_or(0.0, |suspected| (suspected.after - suspected.before).abs());
        let gain_sd = noise::camera_gain_sd(&gains, gain_expected).max(if exact { 0.0 } else { pour_sd }).max(apart);
        let straight_doubt = Doubt::tight((self.tight.cost / frames.max(1) as f64).max(1.0), self.episodes.len(), gain_sd);
        let mut fused = FusedModel {
            explanations: [self.explanation(self.wide, Doubt::wide()), self.explanation(self.tight, straight_doubt)],
            tight_share,
            camera: covariance,
            gain_sd,
            bounds: self.bounds(),
        };
        fused.tight_share *= self.trust(&fused, &calibration);
        let likelier = if fused.tight_share > 0.5 { self.tight } else { self.wide };
        Fit {
            model: fused.likelier().model,
            fused,
            calibration,
            onsets_deg: likelier.found.of_episodes(ONSET),
            covariance: likelier.covariance.view((0, 0), (SHARED, SHARED)).into_owned(),
            calibration_covariance: covariance,
            dropouts: self.camera.noise.dropouts,
            changed_gain,
            suspected_gain,
        }
    }

    /// The calibration of the camera's own sum, by the weights alone. After a change of the camera's gain, the newest one counts.
    fn camera(&self) -> Doubted {
        let exact = self.camera.linear.is_some();
        let gains: Vec<f64> = self.episodes.iter().map(|e| e.log_camera_gain).collect();
        if gains.iter().all(|g| *g == 0.0) {
            return calibration::with_doubt(self.recorded, exact);
        }
        let at_the_same_gain: Vec<TrainingEpisode> =
            self.recorded.iter().zip(&gains).map(|(e, g)| TrainingEpisode { weight_g: e.weight_g * g.exp(), ..e.clone() }).collect();
        let mut doubted = calibration::with_doubt(&at_the_same_gain, exact);
        doubted.calibration.volume_at_1_px2_ml *= (-gains.last().copied().unwrap_or(0.0)).exp() as f32;
        doubted
    }

    /// How far the straight vessel is to be trusted, by its filter's innovations over the episodes, 0 to 1: those of a right model are white.
    fn trust(&self, fused: &FusedModel, calibration: &Calibration) -> f64 {
        if fused.tight_share <= 0.0 {
            return 0.0;
        }
        let rate_hz = data::rate_hz(self.recorded);
        let mut estimator = FusedEstimator::new(fused, calibration, WayBack::new(&Limits::default(), rate_hz), rate_hz);
        let (mut products, mut squares) = (0.0, 0.0);
        for e in self.recorded {
            estimator.restart();
            for ((area_px2, command_deg), measured_deg) in e.area_px2.iter().zip(&e.alpha_deg).zip(&e.alpha_measured_deg) {
                let area_px2 = Some(*area_px2 as f32).filter(|a| !a.is_nan());
                estimator.step(FusedFrame { area_px2, confidence: 1.0, command_deg: *command_deg, measured_deg: *measured_deg });
            }
            let Whiteness { products: p, squares: s, .. } = estimator.whiteness();
            (products, squares) = (products + p, squares + s);
        }
        let (whole, none) = TRUSTED_CORRELATION;
        ((none - products / squares.max(1.0)) / (none - whole)).clamp(0.0, 1.0)
    }
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
