//! One pour in closed loop on a simulated bench, at full speed.
//!
//! Pure, any thread; allocates once a pour; cannot fail. Networks are driven through the controller's own core,
//! [`rt_controller::core::Core`], as at run time. Baselines know no core; they are driven through [`Baseline`] and the same [`Limiter`].

use rt_controller::core::{Core, Input, Order, Robot, Settings};
use serde::Serialize;
use shared::agent::Agent;
use shared::control::EndReason;
use shared::estimator::{Calibration, Hold};
use shared::framing::Framing;
use shared::limits::{Limiter, Limits};
use shared::messages::{Feature, LAYOUT_VERSION};
use trainer::data::TrainingEpisode;

use super::simulators::BenchPour;
use simulator::physics::RATE_HZ;

/// A pour ends after this many frames: 30 s, as in `config/sim.toml`.
pub const MAX_FRAMES: u32 = 900;
/// Frames after upright in which the last drops fall and are counted: 1.5 s, five times the time in which the film drains.
const SETTLE_FRAMES: u32 = 45;
/// Period of a tick, ns: that of 30 Hz.
const PERIOD_NS: u64 = 33_333_333;

/// How one pour went.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PourResult {
    /// Volume in the container at the start, ml.
    pub init_ml: f64,
    /// The goal, ml.
    pub goal_ml: f64,
    /// What has really left, ml.
    pub true_ml: f64,
    /// What the controller believes to have poured, ml.
    pub believed_ml: f64,
    /// What the camera's plain sum makes of the same areas, ml, with the weights' own calibration; NaN for a baseline.
    pub summed_ml: f64,
    /// The standard deviation that it gives with it, ml.
    pub believed_sd_ml: f64,
    /// Time until the pour was over, s.
    pub seconds: f64,
    /// Frames until then.
    pub frames: u32,
    /// Why it ended; `None` where no core ended it.
    pub reason: Option<EndReason>,
    /// Whether the pour came to its end by itself.
    pub ended: bool,
    /// Whether it was ended because what the camera saw could not be. In an evaluation the camera is right, so this is a mistake.
    pub falsely_ended: bool,
}

impl PourResult {
    /// Error of the pour: above 0 too much has left, ml.
    pub fn error_ml(&self) -> f64 {
        self.true_ml - self.goal_ml
    }
    /// The part of the error that measurement made, ml.
    pub fn measurement_ml(&self) -> f64 {
        self.true_ml - self.believed_ml
    }
    /// What the plain sum would have made of measurement, ml.
    pub fn sum_ml(&self) -> f64 {
        self.true_ml - self.summed_ml
    }
    /// The part of the error that control made, ml.
    pub fn control_ml(&self) -> f64 {
        self.believed_ml - self.goal_ml
    }
    /// Whether what has really left is within the standard deviation of what the controller believes; `None` if it gives none.
    pub fn covered(&self) -> Option<bool> {
        (self.believed_sd_ml > 0.0).then(|| self.measurement_ml().abs() <= self.believed_sd_ml)
    }
    /// Whether nothing was poured.
    pub fn never_poured(&self) -> bool {
        self.true_ml < 1.0
    }
    /// Whether it never came to an end by itself.
    pub fn never_stopped(&self) -> bool {
        !self.ended
    }
}

/// A pour frame by frame; all columns have the same length.
#[derive(Debug, Clone, Default, Serialize)]
pub struct Trace {
    /// Time, s.
    pub t_s: Vec<f64>,
    /// Commanded alpha, degrees.
    pub alpha_deg: Vec<f64>,
    /// Measured alpha, degrees; NaN where the simulator has no joint.
    pub alpha_measured_deg: Vec<f64>,
    /// V_e, px^2.
    pub area_px2: Vec<f64>,
    /// What has really left, ml.
    pub true_ml: Vec<f64>,
}

impl Trace {
    fn push(&mut self, alpha_deg: f64, area_px2: f32, pour: &BenchPour) {
        self.t_s.push((self.t_s.len() + 1) as f64 / RATE_HZ);
        self.alpha_deg.push(alpha_deg);
        self.alpha_measured_deg.push(pour.tilt_deg());
        self.area_px2.push(f64::from(area_px2));
        self.true_ml.push(pour.poured_ml());
    }

    /// The pour as a weighed episode.
    pub fn weighed(self, name: &str, weight_g: f64) -> TrainingEpisode {
        let Self { t_s, alpha_deg, alpha_measured_deg, area_px2, .. } = self;
        TrainingEpisode {
            name: name.into(),
            rate_hz: RATE_HZ,
            t_s,
            alpha_deg,
            alpha_measured_deg,
            area_px2,
            weight_g,
            framing: Framing::default(),
        }
    }
}

/// The settings that the core runs with: those of `config/sim.toml`, but without a limit on the goal.
fn settings(limits: Limits) -> Settings {
    Settings {
        period_ns: PERIOD_NS,
        frame_ns: PERIOD_NS,
        limits,
        stale_ns: 200_000_000,
        max_frames: MAX_FRAMES,
        empty_frames: 60,
        goal_max_ml: 1e6,
        upright_deg: 2.0,
        patience_ns: 100_000_000,
        usual_lag_ns: 156_000_000,
    }
}

/// What is asked of a pour.
#[derive(Debug, Clone, Copy)]
pub struct Asked {
    /// Volume in the container at the start, ml.
    pub init_ml: f64,
    /// The goal, ml.
    pub goal_ml: f64,
    /// Tilt by which it must flow, degrees, where somebody has told the fill.
    pub flows_by_deg: Option<f32>,
    /// The calibration of the camera's own sum, which is then taken beside the estimate.
    pub calibration: Option<Calibration>,
}

impl Asked {
    /// This goal, from a fill that nobody has told.
    pub fn new(init_ml: f64, goal_ml: f64) -> Self {
        Self { init_ml, goal_ml, flows_by_deg: None, calibration: None }
    }
}

/// Pours the goal with the controller's own core and `agent`. The frames are added to `trace` if there is one.
pub fn by_core(agent: &Agent, pour: &mut BenchPour, limits: Limits, asked: Asked, mut trace: Option<&mut Trace>) -> PourResult {
    let Asked { init_ml, goal_ml, flows_by_deg, calibration } = asked;
    let mut core = Core::new(settings(limits));
    core.exchange(Box::new(agent.clone()));
    let mut alpha_deg = 0.0f32;
    let mut area_px2 = 0.0f32;
    let mut frames = 0u32;
    let mut hold = Hold::default();
    let mut poured = PourResult {
        init_ml,
        goal_ml,
        true_ml: 0.0,
        believed_ml: 0.0,
        summed_ml: if calibration.is_some() { 0.0 } else { f64::NAN },
        believed_sd_ml: 0.0,
        seconds: f64::from(MAX_FRAMES) / RATE_HZ,
        frames: 0,
        reason: None,
        ended: false,
        falsely_ended: false,
    };
    // The core ends a pour by its own limits. This bound is for a core that fails to.
    while frames < 3 * MAX_FRAMES {
        frames += 1;
        let now_ns = u64::from(frames + 1) * PERIOD_NS;
        let feature = Feature {
            version: LAYOUT_VERSION,
            sequence: u64::from(frames),
            worker_epoch_ns: 1,
            captured_at_ns: now_ns - PERIOD_NS,
            received_at_ns: now_ns - 1,
            published_at_ns: now_ns - 1,
            area_px2,
            confidence: pour.confidence(),
            ..Feature::default()
        };
        // The joint was measured when the picture was taken. Where there is none, it is where it was commanded.
        let tilt_deg = if frames > 1 { pour.tilt_deg() as f32 } else { alpha_deg };
        let robot = Robot::that_may_move(if tilt_deg.is_nan() { alpha_deg } else { tilt_deg }, now_ns - PERIOD_NS);
        let order = (frames == 2).then_some(Order::Pour { episode: 1, goal_ml: goal_ml as f32, flows_by_deg });
        if let Some(calibration) = calibration.filter(|_| frames > 2) {
            let held_px2 = hold.step(Some(area_px2).filter(|a| !a.is_nan()), calibration.hold_above_px2);
            poured.summed_ml += f64::from(calibration.volume_ml(held_px2, alpha_deg));
        }
        let output = core.step(&Input { now_ns, features: &[feature], robot, order });
        alpha_deg = output.target_deg.unwrap_or(alpha_deg);
        area_px2 = pour.frame(f64::from(alpha_deg));
        if let Some(trace) = trace.as_deref_mut() {
            trace.push(f64::from(alpha_deg), area_px2, pour);
        }
        if let Some(outcome) = output.ended {
            poured.believed_ml = f64::from(outcome.poured_ml);
            poured.believed_sd_ml = f64::from(outcome.poured_sd_ml);
            poured.seconds = f64::from(outcome.seconds);
            poured.reason = Some(outcome.reason);
            poured.ended =
                matches!(outcome.reason, EndReason::Done | EndReason::ContainerEmpty | EndReason::StreamLost | EndReason::GoalExceeded);
            poured.falsely_ended = matches!(outcome.reason, EndReason::ImpossibleFlow | EndReason::NothingFlows);
            break;
        }
    }
    for _ in 0..SETTLE_FRAMES {
        let area = pour.frame(0.0);
        if let Some(trace) = trace.as_deref_mut() {
            trace.push(0.0, area, pour);
        }
    }
    poured.true_ml = pour.poured_ml();
    poured.frames = frames;
    poured
}

/// What decides in a pour instead of the agent.
pub trait Baseline {
    /// The angle that is asked for next, in degrees relative to the command in force; `None` when the pour is over. `pour` is the truth,
    /// which only the oracle may look at.
    fn decide(&mut self, area_px2: f32, alpha_deg: f32, pour: &BenchPour) -> Option<f32>;
    /// The volume that it believes to have been poured, ml.
    fn believed_ml(&self) -> f64;
}

/// Pours `goal_ml` with a baseline.
pub fn by_baseline(baseline: &mut dyn Baseline, pour: &mut BenchPour, limits: Limits, init_ml: f64, goal_ml: f64) -> PourResult {
    let mut limiter = Limiter::new(limits, (1.0 / RATE_HZ) as f32, 0.0);
    let mut back = false;
    let mut frames = 0;
    let mut upright_frames = 0;
    let mut upright_at = None;
    while upright_frames < SETTLE_FRAMES {
        let alpha = limiter.alpha_deg();
        let area = pour.frame(f64::from(alpha));
        let asked = baseline.decide(area, alpha, pour);
        frames += 1;
        back |= asked.is_none();
        let out_of_time = frames >= MAX_FRAMES;
        match asked {
            Some(dalpha) if !back && !out_of_time => limiter.step(alpha + dalpha),
            _ => limiter.step_upright(),
        };
        if (back || out_of_time) && limiter.alpha_deg() <= 0.0 {
            upright_at.get_or_insert(frames);
            upright_frames += 1;
        }
    }
    PourResult {
        init_ml,
        goal_ml,
        true_ml: pour.poured_ml(),
        believed_ml: baseline.believed_ml(),
        summed_ml: f64::NAN,
        believed_sd_ml: 0.0,
        seconds: f64::from(upright_at.unwrap_or(frames)) / RATE_HZ,
        frames,
        reason: None,
        ended: back,
        falsely_ended: false,
    }
}

/// The grid of pours that is evaluated: 45 pairs of the volume in the container and the goal, ml; the goal is at most 85 % of the volume.
pub fn grid() -> Vec<(f64, f64)> {
    let mut cells = Vec::new();
    for init in [150.0, 225.0, 300.0, 375.0, 450.0] {
        for k in 1..=10 {
            let goal = 20.0 * f64::from(k);
            if goal <= 0.85 * init {
                cells.push((init, goal));
            }
        }
    }
    cells
}
