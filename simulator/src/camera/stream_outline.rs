//! The liquid's outline as it is seen from the side, found from the hydraulics of the outflow, and the truth about it.
//!
//! 1. The lip is a V-notch weir in the rim's plane, `Q = 8/15 Cd(alpha) sqrt(2 g) tan(theta/2) H^2.5 / sin(alpha)`, solved for the head
//!    `H` over the lip. `Cd` falls as the wall turns from a sharp crest into a long flat one.
//! 2. Inside the glass the free surface falls from `H` to the critical depth `0.8 H` near the lip.
//! 3. From there the liquid flies: a parabola with the speed that Bernoulli gives at that depth.
//!
//! Called by the renderer, on its thread. It allocates when the outline first grows, and for the truth of each frame. It cannot fail.

use std::ops::Range;

use super::view::{Scene, Truth, View, to_container};

/// Acceleration of gravity, mm/s^2: 9.81 m/s^2, the usual rounding of the standard's 9.80665.
pub const GRAVITY_MM_S2: f64 = 9810.0;
/// Below this flow a stream breaks up into drops, ml/s. Chosen by hand; no measurement is recorded.
pub const DRIP_FLOW_ML_S: f64 = 0.15;
/// Discharge coefficient of a sharp-crested V notch: textbooks on weirs give 0.58 to 0.62.
const CD_SHARP: f64 = 0.6;
/// Critical depth in a triangular channel as a share of the head: four fifths, from the minimum of the specific energy.
const CRITICAL_DEPTH: f64 = 0.8;
/// Distance upstream of the lip at which the flow becomes critical, in heads. Chosen by hand; no measurement is recorded.
const CRITICAL_BEFORE_LIP: f64 = 0.15;
/// Pieces of each face of the flying stream: fine enough that its outline looks round.
const STEPS: usize = 90;
/// Time of flight that is drawn, s: it reaches beyond the picture's lower edge.
const FLIGHT_S: f64 = 0.19;
/// Pieces of the surface inside the glass.
const STEPS_INSIDE: usize = 40;
/// How far into the glass the surface is drawn, mm: beyond the picture's edge.
const INSIDE_MM: f64 = 130.0;
/// Where the liquid's outline closes below the lip, mm: beyond the picture's edge.
const DEEP_MM: f64 = -150.0;

/// Waves that travel down the stream, and the shimmer of the water; both change from frame to frame.
#[derive(Debug, Clone, Copy, Default)]
pub struct Ripple {
    /// Phase of the waves, rad.
    pub phase_rad: f64,
    /// Height of the waves as a share of the head.
    pub amplitude: f64,
    /// Phase of the shimmer, rad.
    pub shimmer_rad: f64,
}

/// The outline of the liquid in the container's frame, mm.
pub struct Stream {
    outline: Vec<[f64; 2]>,
    /// Where the upper surface, from far outside to far inside, lies in the outline; empty without a stream.
    upper: Range<usize>,
}

impl Stream {
    /// No liquid yet.
    pub fn new() -> Self {
        Self { outline: Vec::with_capacity(512), upper: 0..0 }
    }

    /// The closed outline, mm; empty when no liquid can be seen.
    pub fn outline(&self) -> &[[f64; 2]] {
        &self.outline
    }

    /// Finds the outline of the liquid in `scene`.
    pub fn trace(&mut self, view: &View, scene: &Scene, ripple: Ripple) {
        self.outline.clear();
        self.upper = 0..0;
        if scene.flow_ml_s < DRIP_FLOW_ML_S {
            self.trace_at_rest(scene);
            return;
        }
        let jet = Jet::new(view, scene, ripple);
        self.outline.push([0.6, DEEP_MM]);
        self.outline.push([0.0, -0.4]);
        self.outline.extend((0..=STEPS).map(|i| jet.faces(i).0));
        let upper_from = self.outline.len();
        self.outline.extend((1..=STEPS).rev().map(|i| jet.faces(i).1));
        self.outline.extend((0..=STEPS_INSIDE).map(|i| jet.inside(i)));
        self.upper = upper_from..self.outline.len();
        let last = self.outline[self.upper.end - 1];
        self.outline.push([last[0], DEEP_MM.min(last[1])]);
    }

    /// At rest the surface is level from the left wall to the right one, if it is over the left wall's foot at all.
    fn trace_at_rest(&mut self, scene: &Scene) {
        let alpha = scene.alpha_deg.to_radians();
        let level = scene.level_mm.min(0.0);
        if scene.alpha_deg < 85.0 {
            let right = 90.0;
            let left_w = level / alpha.cos();
            let right_w = (level - right * alpha.sin()) / alpha.cos();
            self.outline.extend([[0.6, DEEP_MM], [0.6, left_w - 0.6 * alpha.tan()], [right, right_w.max(DEEP_MM)], [right, DEEP_MM]]);
        }
    }

    /// The triangle of what [`Stream::trace`] has found.
    pub fn truth(&self, view: &View) -> Truth {
        if self.upper.is_empty() {
            return Truth::default();
        }
        let Some((normal, distance)) = edge(&self.outline[self.upper.clone()]).map(|e| fitted_line(&e)) else { return Truth::default() };
        let (on_x, on_y) = (distance / normal[0], distance / normal[1]);
        let s = view.px_per_mm;
        Truth { area_px2: 0.5 * on_x * on_y * s * s, triangle_px: [[0.0, 0.0], [on_x, 0.0], [0.0, on_y]].map(|p| view.to_image(p)) }
    }
}

/// The part of the upper surface between the axes: from the last crossing of the left side's line to the first one of the top edge's.
fn edge(surface: &[[f64; 2]]) -> Option<Vec<[f64; 2]>> {
    let cut = |a: [f64; 2], b: [f64; 2], k: usize| {
        let t = a[k] / (a[k] - b[k]);
        [a[0] + (b[0] - a[0]) * t, a[1] + (b[1] - a[1]) * t]
    };
    let rim = (0..surface.len() - 1).find(|&i| surface[i][1] > 0.0 && surface[i + 1][1] <= 0.0 && surface[i + 1][0] > 0.0)?;
    let side = (0..=rim).rev().find(|&i| surface[i][0] <= 0.0 && surface[i + 1][0] > 0.0)?;
    let mut edge = vec![cut(surface[side], surface[side + 1], 0)];
    edge.extend(&surface[side + 1..=rim]);
    edge.push(cut(surface[rim], surface[rim + 1], 1));
    Some(edge)
}

/// The least-squares line along a polyline: its normal, and its distance from the origin along it. Each piece counts by its length, as a
/// uniform rod.
fn fitted_line(edge: &[[f64; 2]]) -> ([f64; 2], f64) {
    let (mut total, mut sum, mut square) = (0.0, [0.0; 2], [0.0; 3]);
    for pair in edge.windows(2) {
        let ([a, b], [c, d]) = (pair[0], pair[1]);
        let length = (c - a).hypot(d - b);
        total += length;
        sum = [sum[0] + length * (a + c) / 2.0, sum[1] + length * (b + d) / 2.0];
        square[0] += length * (a * a + a * c + c * c) / 3.0;
        square[1] += length * (2.0 * a * b + a * d + c * b + 2.0 * c * d) / 6.0;
        square[2] += length * (b * b + b * d + d * d) / 3.0;
    }
    let mean = [sum[0] / total, sum[1] / total];
    let (xx, xy, yy) =
        (square[0] / total - mean[0] * mean[0], square[1] / total - mean[0] * mean[1], square[2] / total - mean[1] * mean[1]);
    let angle = 0.5 * (2.0 * xy).atan2(xx - yy);
    let normal = [-angle.sin(), angle.cos()];
    (normal, normal[0] * mean[0] + normal[1] * mean[1])
}

/// A stream over the lip, in the container's frame; lengths in mm.
struct Jet {
    flow_ml_s: f64,
    /// Alpha, kept within 15 to 90 degrees, in rad.
    steep_rad: f64,
    ripple: Ripple,
    head: f64,
    /// Critical depth.
    depth: f64,
    /// Horizontal part of the speed at the critical section, mm/s.
    speed: f64,
    gravity: [f64; 2],
    upper_start: [f64; 2],
    upper_velocity: [f64; 2],
    lower_velocity: [f64; 2],
}

impl Jet {
    fn new(view: &View, scene: &Scene, ripple: Ripple) -> Self {
        let alpha = scene.alpha_deg.to_radians();
        let steep_rad = scene.alpha_deg.clamp(15.0, 90.0).to_radians();
        let head = head_mm(view, scene.flow_ml_s, steep_rad);
        let depth = CRITICAL_DEPTH * head;
        // Slope of the surface at the critical section; the surfaces on both sides of it share it.
        let slope = 1.0 - CRITICAL_DEPTH;
        // Bernoulli at the free surface: speed^2 = 2 g (head - depth), of which this is the horizontal part.
        let speed = (2.0 * GRAVITY_MM_S2 * (head - depth) / (1.0 + slope * slope)).sqrt();
        Self {
            flow_ml_s: scene.flow_ml_s,
            steep_rad,
            ripple,
            head,
            depth,
            speed,
            gravity: to_container([0.0, -GRAVITY_MM_S2], alpha),
            upper_start: to_container([-CRITICAL_BEFORE_LIP * head, depth], steep_rad),
            upper_velocity: to_container([speed, -slope * speed], steep_rad),
            lower_velocity: to_container([speed, 0.0], steep_rad),
        }
    }

    /// Factor of the thickness `along` heads upstream.
    fn wave(&self, along: f64) -> f64 {
        1.0 + self.ripple.amplitude * (along * 2.1 - self.ripple.phase_rad).sin()
    }

    /// Where a particle is that left `start` with `velocity` the time `t` ago.
    fn fly(&self, start: [f64; 2], velocity: [f64; 2], t: f64) -> [f64; 2] {
        let gravity = self.gravity;
        [start[0] + velocity[0] * t + 0.5 * gravity[0] * t * t, start[1] + velocity[1] * t + 0.5 * gravity[1] * t * t]
    }

    /// The lower and the upper face at the same time of flight, the `i`-th of [`STEPS`]. A falling jet is pulled round, and is never
    /// thinner than a round one of its flow.
    fn faces(&self, i: usize) -> ([f64; 2], [f64; 2]) {
        let t = FLIGHT_S * (i as f64 / STEPS as f64).powi(2);
        let (low, high) = (self.fly([0.0, 0.0], self.lower_velocity, t), self.fly(self.upper_start, self.upper_velocity, t));
        let along = [self.lower_velocity[0] + self.gravity[0] * t, self.lower_velocity[1] + self.gravity[1] * t];
        let fast = along[0].hypot(along[1]);
        let out = [along[1] / fast, -along[0] / fast];
        let up = to_container([0.0, 1.0], self.steep_rad);
        let out = if up[0] * out[0] + up[1] * out[1] >= 0.0 { out } else { out.map(|v| -v) };
        let across = (high[0] - low[0]) * out[0] + (high[1] - low[1]) * out[1];
        let round = (4.0 * self.flow_ml_s * 1000.0 / (std::f64::consts::PI * fast)).sqrt();
        let thick = across.max(round) * self.wave(-t * self.speed / self.head);
        if t > 0.0 && across < round {
            let middle = [(low[0] + high[0]) / 2.0, (low[1] + high[1]) / 2.0];
            let half = thick / 2.0;
            ([middle[0] - half * out[0], middle[1] - half * out[1]], [middle[0] + half * out[0], middle[1] + half * out[1]])
        } else {
            let more = thick - across;
            (low, [high[0] + more * out[0], high[1] + more * out[1]])
        }
    }

    /// The `i`-th of the places on the surface inside the glass, which lie denser near the lip.
    fn inside(&self, i: usize) -> [f64; 2] {
        let (head, depth) = (self.head, self.depth);
        let x = -INSIDE_MM * (i as f64 / STEPS_INSIDE as f64).powi(2);
        let surface = head - (head - depth) * (x / head).exp();
        let x = x - CRITICAL_BEFORE_LIP * head;
        let z = surface * (1.0 + (self.wave(-x / head) - 1.0) * (x / (2.0 * head)).exp());
        let z = if i == 0 { depth * self.wave(0.0) } else { z };
        to_container([x, z], self.steep_rad)
    }
}

/// The head over the lip in mm that drives `flow_ml_s` (step 1 of this file's header), at a tilt of 15 to 90 degrees.
fn head_mm(view: &View, flow_ml_s: f64, steep_rad: f64) -> f64 {
    let sin = steep_rad.sin();
    let discharge = CD_SHARP * (1.0 - view.flat_wall_loss * sin * sin);
    let factor = 8.0 / 15.0 * discharge * (2.0 * GRAVITY_MM_S2).sqrt() * (view.spout_deg.to_radians() / 2.0).tan();
    (flow_ml_s * 1000.0 * sin / factor).powf(0.4)
}
