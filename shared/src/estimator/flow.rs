//! The flow model: from commanded angles to outflow, with a handful of parameters that are fitted to weighed episodes.
//!
//! All of it is pure. [`FlowTables`] and [`FlowState`] are used in the controller's loop: they have a fixed size, and nothing here
//! allocates, panics or fails. The trainer fits [`FlowModel`] with the very same step. All volumes are in ml, angles in degrees, time in
//! frames.
//!
//! ```text
//! a    += clip((alpha(t - D - delta) - a) / (1 + tau), +-r)            the tilt that this frame shows; alpha is measured or commanded
//! e     = max(0, b W(a) - X)                                           liquid above the lip; flow starts where b W(a) = X
//! v     = min(e/2, exp(lk + lambda + k1 z + k2 z^2) (e / A(a))^p)      a weir under the head e/A, z = clip((a - 60)/30, -1.8, 1.5)
//! X    += v                                                            headspace: the capacity that is used up
//! F    += eta v;  drip = F/9;  F -= drip                               film
//! out   = (1 - eta) v + drip                                           leaves the lip
//! ```
//!
//! | symbol | name |
//! |---|---|
//! | a | [`FlowState::tilt_deg`] |
//! | D, delta | [`FlowModel::delay_frames`], [`FlowState::extra_delay_frames`] |
//! | tau | [`FlowModel::lag_frames`] |
//! | r | [`tilt_step_deg`] |
//! | W, A | [`CapacityCurve`] |
//! | X | [`FlowState::headspace_ml`] |
//! | e | [`LipFlow::excess_ml`] |
//! | v | [`LipFlow::flow_ml`] |
//! | lk, k1, k2 | [`FlowModel::log_weir_coefficient`], [`FlowModel::log_weir_slope`], [`FlowModel::log_weir_curvature`] |
//! | lambda | [`FlowState::log_flow_factor`] |
//! | p | [`FlowModel::head_exponent`] |
//! | b | [`FlowState::capacity_scale`] |
//! | F | [`FlowState::film_ml`] |
//! | eta | [`FlowModel::film_share`] |

use serde::{Deserialize, Serialize};

use super::vessel::{CapacityCurve, ENTRIES, TablePlace, Vessel, entry_deg};

/// The fastest turn of the tilt, degrees/s: no robot turns a full container faster. Chosen by hand; no measurement is recorded.
const TILT_RATE_DEG_S: f64 = 90.0;
/// Share of the film that drips in a frame. Chosen by hand; no measurement is recorded.
pub(super) const DRIP_SHARE: f64 = 1.0 / 9.0;
/// Number of commanded angles that are remembered, frames: more than the longest delay that can be modelled.
const HISTORY: usize = 16;
/// The longest delay that can be modelled, frames: a little less than the history holds.
pub const DELAY_MAX_FRAMES: f64 = (HISTORY - 3) as f64;
/// The longest way back that is foreseen, frames: 3 s at 30 frames a second. At the return rate of the shipped configurations, 60
/// degrees/s, the way back from 110 degrees takes less than 2 s; a much slower one is cut off.
const STOP_FRAMES: usize = 90;
/// Less outflow than this in a frame counts as none when the way back is foreseen, ml. Chosen by hand; no measurement is recorded.
const STOPPED_ML: f64 = 1e-4;

/// Parameters of the flow model, and of the filter built on it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FlowModel {
    /// The container.
    pub vessel: Vessel,
    /// Logarithm of the flow under a head of 1 mm at 60 degrees, in ml a frame.
    pub log_weir_coefficient: f64,
    /// Exponent of the head; 1.5 for a weir.
    pub head_exponent: f64,
    /// Change of the weir coefficient's logarithm for 30 degrees more tilt.
    pub log_weir_slope: f64,
    /// Change of the same logarithm with z^2, where z is the tilt beyond 60 degrees in units of 30 degrees.
    pub log_weir_curvature: f64,
    /// Lag of the tilt behind the delayed command, frames.
    pub lag_frames: f64,
    /// Delay from command to picture, frames, 0 to [`DELAY_MAX_FRAMES`].
    pub delay_frames: f64,
    /// How the picture follows the tilt that the robot measures, where the episodes had one.
    pub measured: Option<Lateness>,
    /// Share of the outflow that becomes film at the lip.
    pub film_share: f64,
    /// How far the model can be off, for the filter.
    pub noise: FlowNoise,
}

impl Default for FlowModel {
    /// A beaker of 38 x 115 mm filled with water.
    fn default() -> Self {
        Self {
            vessel: Vessel::default(),
            log_weir_coefficient: -3.0,
            head_exponent: 1.5,
            log_weir_slope: 0.1,
            log_weir_curvature: -0.05,
            lag_frames: 2.0,
            delay_frames: 2.3,
            measured: None,
            film_share: 0.1,
            noise: FlowNoise { log_frame_volume_sd: 0.08, least_visible_ml: 0.01 },
        }
    }
}

/// How late a picture shows a tilt.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Lateness {
    /// Lag, frames.
    pub lag_frames: f64,
    /// Delay, frames, 0 to [`DELAY_MAX_FRAMES`].
    pub delay_frames: f64,
}

/// How far a frame can be off the model.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FlowNoise {
    /// Standard deviation of the logarithm of the volume that one frame's area stands for.
    pub log_frame_volume_sd: f64,
    /// Smallest outflow that the camera shows, ml a frame.
    pub least_visible_ml: f64,
}

/// A [`FlowModel`] with its vessel in tables, ready to step.
#[derive(Debug, Clone, PartialEq)]
pub struct FlowTables {
    /// The parameters.
    pub model: FlowModel,
    /// The container.
    pub capacity: CapacityCurve,
    /// The largest change of the tilt in a frame, degrees, see [`tilt_step_deg`].
    pub tilt_step_deg: f64,
    /// Logarithm of the flow under an excess of 1 ml, ml a frame.
    log_coefficient: [f64; ENTRIES],
}

/// The flow over the lip in one frame, and its slopes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LipFlow {
    /// Liquid above the lip, ml; if negative, what is missing up to the lip.
    pub excess_ml: f64,
    /// Outflow, ml a frame.
    pub flow_ml: f64,
    /// Its change with the excess, 1/frame.
    pub flow_per_excess: f64,
    /// Its change with the logarithm of the flow factor, ml a frame.
    pub flow_per_log_factor_ml: f64,
    /// Capacity that the vessel loses for each further degree at this tilt, ml a degree.
    pub lost_ml_per_deg: f64,
}

impl FlowTables {
    /// Builds the tables of a model whose frames come at `rate_hz`.
    pub fn new(model: &FlowModel, rate_hz: f64) -> Self {
        let capacity = CapacityCurve::new(&model.vessel);
        let mut flow = Self { model: *model, capacity, tilt_step_deg: tilt_step_deg(rate_hz), log_coefficient: [0.0; ENTRIES] };
        for (k, (log_coefficient, surface_mm2)) in flow.log_coefficient.iter_mut().zip(&flow.capacity.surface_mm2).enumerate() {
            let z = ((entry_deg(k) - 60.0) / 30.0).clamp(-1.8, 1.5);
            // The head is in mm, the excess in ml.
            *log_coefficient = model.log_weir_coefficient + model.log_weir_slope * z + model.log_weir_curvature * z * z
                - model.head_exponent * (surface_mm2 / 1000.0).ln();
        }
        flow
    }

    /// Flow over the lip at a tilt, with the headspace that is there, and a pour's own flow factor (logarithm).
    #[inline]
    pub fn over_lip(&self, tilt_deg: f64, headspace_ml: f64, log_flow_factor: f64) -> LipFlow {
        let place = TablePlace::of(tilt_deg);
        self.with_excess(place, self.capacity.lost_ml_at(place) - headspace_ml, log_flow_factor)
    }

    /// Flow over the lip at a place of the tables, with this much liquid above the lip.
    #[inline]
    pub(super) fn with_excess(&self, place: TablePlace, excess_ml: f64, log_flow_factor: f64) -> LipFlow {
        let lost_ml_per_deg = self.capacity.lost_ml_per_deg_at(place);
        if excess_ml <= 0.0 {
            return LipFlow { excess_ml, lost_ml_per_deg, ..LipFlow::default() };
        }
        let log_coefficient = place.read(&self.log_coefficient) + log_flow_factor;
        let weir_ml = (log_coefficient + self.model.head_exponent * excess_ml.ln()).exp();
        // No more than half of what is above the lip leaves in a frame.
        let (flow_ml, flow_per_excess, flow_per_log_factor_ml) = if weir_ml < 0.5 * excess_ml {
            (weir_ml, self.model.head_exponent * weir_ml / excess_ml, weir_ml)
        } else {
            (0.5 * excess_ml, 0.5, 0.0)
        };
        LipFlow { excess_ml, flow_ml, flow_per_excess, flow_per_log_factor_ml, lost_ml_per_deg }
    }

    /// The excess above the lip that gives an outflow of `flow_ml` in a frame at a tilt, ml.
    pub fn excess_ml_for(&self, tilt_deg: f64, flow_ml: f64) -> f64 {
        let log_coefficient = TablePlace::of(tilt_deg).read(&self.log_coefficient);
        let weir_ml = ((flow_ml.max(1e-6).ln() - log_coefficient) / self.model.head_exponent).exp();
        weir_ml.max(2.0 * flow_ml)
    }

    /// The tilt after a frame, from the tilt before it and the delayed command, degrees.
    #[inline]
    pub fn next_tilt_deg(&self, tilt_deg: f64, command_deg: f64) -> f64 {
        followed_deg(tilt_deg, command_deg, self.model.lag_frames, self.tilt_step_deg)
    }

    /// The command that a picture shows, `ahead` frames after the newest of the history, degrees, linear between two commands.
    ///
    /// `commands` begins with a whole [`CommandHistory`]; the commands to come follow it. `extra_delay_frames` is what a pour's
    /// delay is above the model's.
    #[inline]
    pub fn delayed_deg(&self, commands: &[f64], ahead: usize, extra_delay_frames: f64) -> f64 {
        delayed_deg(commands, ahead, self.model.delay_frames + extra_delay_frames)
    }

    /// What still leaves the lip if the container is brought upright from now on, ml: what the commands already given let out,
    /// what flows on the way back, and the film.
    ///
    /// `history` ends with the command under which the newest picture was taken. `now_deg` is the command now in force, which may
    /// be one ahead of it.
    pub fn stop_volume_ml(&self, state: &FlowState, history: &CommandHistory, now_deg: f64, way_back: WayBack) -> f64 {
        let commands = way_back.commands(history, now_deg);
        let mut liquid = *state;
        let mut over_lip_ml = 0.0;
        let upright_after = (self.model.delay_frames + state.extra_delay_frames).max(0.0) as usize + 4;
        for ahead in 1..STOP_FRAMES {
            let before_deg = liquid.tilt_deg;
            let frame = liquid.step(self, &commands, ahead);
            over_lip_ml += frame.over_lip_ml;
            if frame.over_lip_ml < STOPPED_ML && ahead > upright_after && liquid.tilt_deg <= before_deg {
                break;
            }
        }
        // All of the film drips in the end, so it need not be followed frame by frame.
        state.film_ml + over_lip_ml
    }
}

/// The largest change of the tilt in a frame, degrees, at `rate_hz` frames a second; a rate below 1 counts as 1.
pub fn tilt_step_deg(rate_hz: f64) -> f64 {
    TILT_RATE_DEG_S / rate_hz.max(1.0)
}

/// The tilt after a frame, from the tilt before it and the delayed angle that it follows with a lag, by no more than `step_deg`, degrees.
#[inline]
pub fn followed_deg(tilt_deg: f64, delayed_deg: f64, lag_frames: f64, step_deg: f64) -> f64 {
    tilt_deg + ((delayed_deg - tilt_deg) / (1.0 + lag_frames)).clamp(-step_deg, step_deg)
}

/// The angle that was in force `delay_frames` before the one `ahead` frames after the newest of the history, degrees.
#[inline]
pub fn delayed_deg(angles: &[f64], ahead: usize, delay_frames: f64) -> f64 {
    let delay = delay_frames.clamp(0.0, DELAY_MAX_FRAMES);
    let whole = delay as usize;
    let part = delay - whole as f64;
    let at = (HISTORY - 1 + ahead).saturating_sub(whole).min(angles.len() - 1);
    angles[at] + part * (angles[at.saturating_sub(1)] - angles[at])
}

/// Where the liquid is, as far as is known.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FlowState {
    /// Tilt that the newest picture shows, degrees.
    pub tilt_deg: f64,
    /// Capacity that is used up, ml: liquid flows once the tilt has lost more capacity than this.
    pub headspace_ml: f64,
    /// Film at the lip, ml.
    pub film_ml: f64,
    /// Logarithm of this pour's flow divided by the model's (viscosity).
    pub log_flow_factor: f64,
    /// The vessel's own capacity divided by the model's.
    pub capacity_scale: f64,
    /// Delay of this pour above the model's, frames.
    pub extra_delay_frames: f64,
}

impl Default for FlowState {
    /// A full and upright container, about which nothing is known beyond the model.
    fn default() -> Self {
        Self { tilt_deg: 0.0, headspace_ml: 0.0, film_ml: 0.0, log_flow_factor: 0.0, capacity_scale: 1.0, extra_delay_frames: 0.0 }
    }
}

/// What one frame of the flow model lets out.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FrameOutflow {
    /// What passes over the lip, ml.
    pub over_lip_ml: f64,
    /// What leaves the lip after the film took its share and dripped, ml: this is what the camera sees.
    pub leaves_ml: f64,
}

impl FlowState {
    /// One frame of the flow model: the tilt follows the command that [`FlowTables::delayed_deg`] names, liquid passes the lip,
    /// the film takes its share and drips.
    #[inline]
    pub fn step(&mut self, flow: &FlowTables, commands: &[f64], ahead: usize) -> FrameOutflow {
        self.tilt_deg = flow.next_tilt_deg(self.tilt_deg, flow.delayed_deg(commands, ahead, self.extra_delay_frames));
        let place = TablePlace::of(self.tilt_deg);
        let excess_ml = self.capacity_scale * flow.capacity.lost_ml_at(place) - self.headspace_ml;
        let over_lip_ml = flow.with_excess(place, excess_ml, self.log_flow_factor).flow_ml;
        FrameOutflow { over_lip_ml, leaves_ml: self.release(over_lip_ml, flow.model.film_share) }
    }

    /// The second half of [`FlowState::step`]: takes what passes the lip out of the vessel and through the film, and returns what leaves
    /// the lip, ml.
    #[inline]
    pub fn release(&mut self, over_lip_ml: f64, film_share: f64) -> f64 {
        self.headspace_ml += over_lip_ml;
        self.film_ml += film_share * over_lip_ml;
        let drip_ml = DRIP_SHARE * self.film_ml;
        self.film_ml -= drip_ml;
        (1.0 - film_share) * over_lip_ml + drip_ml
    }
}

/// The newest commanded angles, one a frame, oldest first, degrees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CommandHistory([f64; HISTORY]);

impl CommandHistory {
    /// The history of a container that has always stood at this angle.
    pub fn standing_at(command_deg: f64) -> Self {
        Self([command_deg; HISTORY])
    }

    /// Adds the command of a new frame; the oldest one is forgotten.
    #[inline]
    pub fn push(&mut self, command_deg: f64) {
        self.0.copy_within(1.., 0);
        self.0[HISTORY - 1] = command_deg;
    }

    /// The newest command, degrees.
    pub fn newest_deg(&self) -> f64 {
        self.0[HISTORY - 1]
    }

    /// All commands, as [`FlowState::step`] takes them.
    pub fn commands(&self) -> &[f64] {
        &self.0
    }
}

/// How the controller brings the container upright.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct WayBack {
    /// Rate, degrees a frame.
    pub rate_deg: f64,
    /// Change of the rate in a frame, degrees a frame.
    pub change_deg: f64,
}

impl WayBack {
    /// The controller's limits, at `rate_hz` frames a second. The way back is never faster than any other.
    pub fn new(limits: &crate::limits::Limits, rate_hz: f64) -> Self {
        Self {
            rate_deg: f64::from(limits.return_rate_deg_s.min(limits.rate_deg_s)) / rate_hz,
            change_deg: f64::from(limits.acceleration_deg_s2) / (rate_hz * rate_hz),
        }
    }

    /// The history, the command now in force if it differs from the newest of the history, and the commands of a way back that starts after
    /// it, degrees.
    fn commands(self, history: &CommandHistory, now_deg: f64) -> [f64; HISTORY + STOP_FRAMES] {
        let mut commands = [0.0; HISTORY + STOP_FRAMES];
        commands[..HISTORY].copy_from_slice(&history.0);
        let mut filled = HISTORY;
        if now_deg.is_finite() && now_deg != commands[HISTORY - 1] {
            commands[HISTORY] = now_deg;
            filled += 1;
        }
        let mut alpha_deg = commands[filled - 1];
        let mut rate_deg = alpha_deg - commands[filled - 2];
        for command in &mut commands[filled..] {
            rate_deg = (rate_deg - self.change_deg).max(-self.rate_deg);
            alpha_deg = (alpha_deg + rate_deg).max(0.0);
            *command = alpha_deg;
        }
        commands
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects cells at other frame rates than 30: how fast a tilt can follow is said in seconds. At 30 frames a second it is 3 degrees a frame.
    #[test]
    fn a_tilt_follows_as_fast_at_any_frame_rate() {
        let model = FlowModel { lag_frames: 0.0, delay_frames: 0.0, ..FlowModel::default() };
        for rate_hz in [10.0, 30.0, 60.0, 120.0] {
            let flow = FlowTables::new(&model, rate_hz);
            let after_deg = (0..rate_hz as usize / 2).fold(0.0, |tilt_deg, _| flow.next_tilt_deg(tilt_deg, 90.0));
            assert!((after_deg - 45.0).abs() < 1e-9, "{rate_hz} Hz: {after_deg} degrees after half a second");
        }
        assert_eq!(tilt_step_deg(30.0), 3.0);
        assert_eq!((tilt_step_deg(0.0), tilt_step_deg(f64::NAN)), (90.0, 90.0), "no rate leads the clamp astray");
    }
}
