//! The flow model: from commanded angles to outflow, with a handful of parameters fitted to weighed episodes.
//!
//! Pure. [`Flow`] is in the controller's loop: fixed size, no allocation, no panic. The trainer fits [`FlowModel`] with the
//! very same steps. All volumes in ml, angles in degrees, time in frames.
//!
//! ```text
//! a    += clip((alpha(t - D) - a) / (1 + tau), +-3)                      the tilt that this frame shows
//! w(a)  = exp(s(a)) w_0(a; R, H, taper)                                  ml of capacity lost a degree, s linear between knots
//! W(a)  = integral of w from 0 to a
//! e     = max(0, W(a) - X)                                               liquid above the lip; W(a) = X where flow starts
//! A(a)  = max(exp(2/3 s(a)) A_0(a; R, H, taper), A_MIN)                  free surface at the brim
//! v     = min(e/2, exp(lk + lambda + k1 z + k2 z^2) (e / A)^p)           a weir under the head e/A, z = clip((a - 60)/30, -1.8, 1.5)
//! X    += e^beta v
//! F    += eta v;  drip = F/9;  F -= drip                                 film
//! out   = (1 - eta) v + drip                                             leaves the lip
//! ```
//!
//! w_0 is that of a round vessel with straight walls: the plane of the liquid turns about the lip, so
//! `w_0 = integral of (distance from the lip) dA` over the free surface, a degree. A share `flat` of it is replaced by the
//! same capacity spread evenly over all tilts, for vessels that are anything but straight: beyond the horizontal a beaker is
//! empty, a bottle is not. What the vessel really is, s says. A_0 is the free surface of the same straight vessel, mixed
//! likewise; where a vessel holds more than that, its surface is larger too, as an area is to a volume.

use serde::{Deserialize, Serialize};

/// Angles at which s is given, degrees; constant outside.
pub const KNOTS_DEG: [f64; KNOTS] = [20.0, 35.0, 45.0, 55.0, 65.0, 75.0, 85.0, 95.0, 108.0];
/// Number of knots.
pub const KNOTS: usize = 9;
/// Least w_0, ml a degree: beyond the horizontal a straight cup is empty, other vessels are not.
const W_MIN: f64 = 0.2;
/// Least free surface A, mm^2: a lip is some 15 mm wide, and the liquid reaches a little way back from it.
const A_MIN_MM2: f64 = 300.0;
/// Nodes of the integral over the free surface.
const NODES: usize = 64;
/// Largest change of the tilt in a frame, degrees: no robot turns a full container faster.
const TILT_STEP_DEG: f64 = 3.0;
/// Share of the film that drips in a frame.
pub const DRIP: f64 = 1.0 / 9.0;
/// Commanded angles that are remembered, frames.
pub const HISTORY: usize = 16;
/// Largest delay that can be modelled, frames.
pub const DELAY_MAX: f64 = (HISTORY - 3) as f64;
/// Longest predicted way back, frames.
const STOP_FRAMES: usize = 90;

/// Parameters of the flow model, and of the filter built on it.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FlowModel {
    /// Radius R of the straight-walled vessel at its lip, mm.
    pub radius_mm: f64,
    /// Its height H, mm.
    pub height_mm: f64,
    /// Radius at its bottom over R.
    pub taper: f64,
    /// Share of the capacity that is spread evenly over all tilts, 0 to 1.
    pub flat: f64,
    /// s at [`KNOTS_DEG`]: logarithm of the real vessel's w over w_0.
    pub s: [f64; KNOTS],
    /// Logarithm of the flow under a head of 1 mm, at 60 degrees, ml a frame.
    pub lk: f64,
    /// Exponent of the head; 1.5 for a weir.
    pub p: f64,
    /// Change of lk with the angle, linear.
    pub k1: f64,
    /// Change of lk with the angle, quadratic.
    pub k2: f64,
    /// Lag of the tilt, frames.
    pub tau: f64,
    /// Delay D from command to picture, frames.
    pub delay: f64,
    /// Share of the outflow that becomes film.
    pub eta: f64,
    /// Uncertainties.
    pub noise: FlowNoise,
}

impl Default for FlowModel {
    /// A beaker of 38 x 115 mm filled with water.
    fn default() -> Self {
        Self {
            radius_mm: 38.0,
            height_mm: 115.0,
            taper: 1.0,
            flat: 0.0,
            s: [0.0; KNOTS],
            lk: -3.0,
            p: 1.5,
            k1: 0.1,
            k2: -0.05,
            tau: 2.0,
            delay: 2.3,
            eta: 0.1,
            noise: FlowNoise { lambda: 0.15, gamma: 0.025, beta: 0.015, delta: 0.3, frame: 0.08, v_min_ml: 0.01 },
        }
    }
}

/// How far the model can be off in one pour and one frame (standard deviations).
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct FlowNoise {
    /// Flow coefficient lambda of a pour (viscosity), log.
    pub lambda: f64,
    /// Gain gamma of the camera in a pour, calibration error included, log.
    pub gamma: f64,
    /// Scale beta of the geometry, log.
    pub beta: f64,
    /// Delay of a pour, frames.
    pub delta: f64,
    /// One frame's area, relative, in ml.
    pub frame: f64,
    /// Smallest outflow that the camera shows, ml a frame.
    pub v_min_ml: f64,
}

/// Resolution of the tables, degrees.
const STEP_DEG: f64 = 1.0;
const ENTRIES: usize = 122;

/// [`FlowModel`] with its geometry in tables, ready to step.
#[derive(Debug, Clone, PartialEq)]
pub struct Flow {
    /// The parameters.
    pub model: FlowModel,
    w: [f64; ENTRIES],
    capacity: [f64; ENTRIES],
    log_k: [f64; ENTRIES],
}

/// Outflow over the lip in one frame and its slopes.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Over {
    /// Liquid above the lip e, ml (negative: missing to the lip).
    pub excess_ml: f64,
    /// v, ml a frame.
    pub v_ml: f64,
    /// dv/de, 1/frame.
    pub dv_de: f64,
    /// dv/dlambda, ml a frame.
    pub dv_dlambda: f64,
    /// w at this tilt, ml a degree.
    pub w: f64,
}

impl Flow {
    /// Builds the tables.
    pub fn new(model: &FlowModel) -> Self {
        let mut flow = Self { model: *model, w: [0.0; ENTRIES], capacity: [0.0; ENTRIES], log_k: [0.0; ENTRIES] };
        for k in 0..ENTRIES {
            let a = k as f64 * STEP_DEG;
            let (w, surface_mm2) = model.vessel(a);
            flow.w[k] = w;
            let z = ((a - 60.0) / 30.0).clamp(-1.8, 1.5);
            // e/A in mm, e in ml.
            flow.log_k[k] = model.lk + model.k1 * z + model.k2 * z * z - model.p * (surface_mm2 / 1000.0).ln();
            if k > 0 {
                flow.capacity[k] = flow.capacity[k - 1] + 0.5 * STEP_DEG * (flow.w[k - 1] + flow.w[k]);
            }
        }
        flow
    }

    fn at(a_deg: f64) -> (usize, f64) {
        // NaN becomes 0 by the cast; the clamp keeps the index inside.
        let at = (a_deg / STEP_DEG).clamp(0.0, (ENTRIES - 2) as f64);
        let k = (at as usize).min(ENTRIES - 2);
        (k, at - k as f64)
    }

    /// W(a), ml.
    pub fn capacity_ml(&self, a_deg: f64) -> f64 {
        let (k, f) = Self::at(a_deg);
        self.capacity[k] + STEP_DEG * f * (self.w[k] + 0.5 * f * (self.w[k + 1] - self.w[k]))
    }

    /// The angle with W(a) = x, degrees: where flow starts or stops when x has left.
    pub fn onset_deg(&self, x_ml: f64) -> f64 {
        let k = self.capacity.partition_point(|c| *c < x_ml).clamp(1, ENTRIES - 1);
        (k as f64 - 1.0 + ((x_ml - self.capacity[k - 1]) / (self.capacity[k] - self.capacity[k - 1]).max(1e-9)).clamp(0.0, 1.0)) * STEP_DEG
    }

    /// Outflow over the lip at tilt `a_deg` when `x_ml` of W has been used up.
    #[inline]
    pub fn over(&self, a_deg: f64, x_ml: f64, lambda: f64) -> Over {
        let (k, f) = Self::at(a_deg);
        let w = self.w[k] + f * (self.w[k + 1] - self.w[k]);
        let excess_ml = self.capacity[k] + STEP_DEG * f * (self.w[k] + 0.5 * f * (self.w[k + 1] - self.w[k])) - x_ml;
        if excess_ml <= 0.0 {
            return Over { excess_ml, w, ..Over::default() };
        }
        let log_k = self.log_k[k] + f * (self.log_k[k + 1] - self.log_k[k]) + lambda;
        let free = (log_k + self.model.p * excess_ml.ln()).exp();
        if free < 0.5 * excess_ml {
            Over { excess_ml, v_ml: free, dv_de: self.model.p * free / excess_ml, dv_dlambda: free, w }
        } else {
            Over { excess_ml, v_ml: 0.5 * excess_ml, dv_de: 0.5, dv_dlambda: 0.0, w }
        }
    }

    /// The excess that gives outflow `v_ml` at tilt `a_deg`, ml.
    pub fn excess_for(&self, a_deg: f64, v_ml: f64, lambda: f64) -> f64 {
        let (k, f) = Self::at(a_deg);
        let log_k = self.log_k[k] + f * (self.log_k[k + 1] - self.log_k[k]) + lambda;
        let free = ((v_ml.max(1e-6).ln() - log_k) / self.model.p).exp();
        free.max(2.0 * v_ml)
    }

    /// The tilt after a frame whose delayed command is `u_deg`.
    #[inline]
    pub fn tilt(&self, a_deg: f64, u_deg: f64) -> f64 {
        a_deg + ((u_deg - a_deg) / (1.0 + self.model.tau)).clamp(-TILT_STEP_DEG, TILT_STEP_DEG)
    }

    /// The delayed command alpha(t + ahead - D - late), `commands` holding alpha(t - HISTORY + 1), ..., alpha(t), ... in
    /// order; `late` is what a pour's delay is above D, frames.
    #[inline]
    pub fn delayed(&self, commands: &[f64], ahead: usize, late: f64) -> f64 {
        let delay = (self.model.delay + late).clamp(0.0, DELAY_MAX);
        let whole = delay as usize;
        let part = delay - whole as f64;
        let at = (HISTORY - 1 + ahead).saturating_sub(whole).min(commands.len() - 1);
        commands[at] + part * (commands[at.saturating_sub(1)] - commands[at])
    }

    /// What still leaves the lip if the container is brought upright from now on, ml: what the commands already given let
    /// out, the way back, and the film.
    ///
    /// `history` are the commands up to the one that the newest picture was taken under, oldest first; `now_deg` is the
    /// command now in force, which may be one ahead of it.
    pub fn stop_volume_ml(&self, state: &FlowState, history: &[f64; HISTORY], now_deg: f64, back: Return) -> f64 {
        let mut commands = [0.0; HISTORY + STOP_FRAMES];
        commands[..HISTORY].copy_from_slice(history);
        let mut filled = HISTORY;
        if now_deg.is_finite() && now_deg != commands[HISTORY - 1] {
            commands[HISTORY] = now_deg;
            filled += 1;
        }
        let mut alpha = commands[filled - 1];
        let mut rate = alpha - commands[filled - 2];
        for command in &mut commands[filled..] {
            rate = (rate - back.change_deg).max(-back.rate_deg);
            alpha = (alpha + rate).max(0.0);
            *command = alpha;
        }
        let scale = state.beta.exp();
        let FlowState { mut a_deg, mut x_ml, film_ml, lambda, late, .. } = *state;
        let mut over_ml = 0.0;
        let upright_after = (self.model.delay + late).max(0.0) as usize + 4;
        for j in 1..STOP_FRAMES {
            let next = self.tilt(a_deg, self.delayed(&commands, j, late));
            let over = self.over(next, x_ml, lambda);
            over_ml += over.v_ml;
            x_ml += scale * over.v_ml;
            if over.v_ml < 1e-4 && j > upright_after && next <= a_deg {
                break;
            }
            a_deg = next;
        }
        // All of the film drips in the end.
        film_ml + over_ml
    }
}

/// Where the liquid is, as far as one knows.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct FlowState {
    /// Tilt a that the newest picture shows, degrees.
    pub a_deg: f64,
    /// X: W used up, ml.
    pub x_ml: f64,
    /// Film at the lip F, ml.
    pub film_ml: f64,
    /// Flow coefficient of this pour, log.
    pub lambda: f64,
    /// Scale of the geometry, log.
    pub beta: f64,
    /// Delay of this pour above the model's D, frames.
    pub late: f64,
}

/// How the controller brings the container upright.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Return {
    /// Rate, degrees a frame.
    pub rate_deg: f64,
    /// Change of the rate in a frame, degrees a frame.
    pub change_deg: f64,
}

impl Return {
    /// The controller's limits, at `rate_hz` frames a second.
    pub fn new(limits: &crate::limits::Limits, rate_hz: f64) -> Self {
        Self {
            rate_deg: f64::from(limits.return_rate_deg_s) / rate_hz,
            change_deg: f64::from(limits.acceleration_deg_s2) / (rate_hz * rate_hz),
        }
    }
}

impl FlowModel {
    /// (w(a) in ml a degree, A(a) in mm^2).
    pub fn vessel(&self, a_deg: f64) -> (f64, f64) {
        let k = KNOTS_DEG.partition_point(|knot| *knot <= a_deg);
        let s = if k == 0 {
            self.s[0]
        } else if k == KNOTS {
            self.s[KNOTS - 1]
        } else {
            let f = (a_deg - KNOTS_DEG[k - 1]) / (KNOTS_DEG[k] - KNOTS_DEG[k - 1]);
            self.s[k - 1] + f * (self.s[k] - self.s[k - 1])
        };
        // The volume of the straight vessel over its 90 degrees; the surface that this is when it turns about R.
        let t = self.taper;
        let even = std::f64::consts::PI * self.radius_mm * self.radius_mm * self.height_mm * (1.0 + t + t * t) / 3.0 / 90.0 / 1000.0;
        let even_mm2 = even * 1000.0 / (self.radius_mm * 1f64.to_radians());
        let (w, surface_mm2) = self.straight(a_deg);
        let mixed = |straight: f64, even: f64| (1.0 - self.flat) * straight + self.flat * even;
        (s.exp() * mixed(w, even).max(W_MIN), ((2.0 / 3.0 * s).exp() * mixed(surface_mm2, even_mm2)).max(A_MIN_MM2))
    }

    /// (w_0 in ml a degree, free surface in mm^2) of the straight-walled vessel.
    ///
    /// At depth u below the lip the plane is at x = R - u cot(a); the section there is 2 sqrt(r^2 - x^2) wide.
    pub fn straight(&self, a_deg: f64) -> (f64, f64) {
        let (sin, cos) = a_deg.max(2.0).to_radians().sin_cos();
        let cot = cos / sin;
        let widest = self.radius_mm * self.taper.max(1.0);
        let depth = if cot > 1e-6 { self.height_mm.min((self.radius_mm + widest) / cot) } else { self.height_mm };
        let step = depth / NODES as f64;
        let (mut lever, mut area) = (0.0, 0.0);
        for k in 0..NODES {
            let u = (k as f64 + 0.5) * step;
            let x = self.radius_mm - u * cot;
            let r = self.radius_mm * (1.0 + (self.taper - 1.0) * u / self.height_mm);
            let width = 2.0 * (r * r - x * x).max(0.0).sqrt();
            lever += width * u;
            area += width;
        }
        (lever * step / (sin * sin) * std::f64::consts::PI / 180.0 / 1000.0, area * step / sin)
    }
}
