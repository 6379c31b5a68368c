//! A tilted vessel: what it retains, what flows over its lip, and the film that drains afterwards.
//!
//! Pure, on any thread. It allocates only in [`Container::new`]. It cannot fail: tilts and volumes are clamped to what makes sense.
//!
//! Coordinates: z along the vessel's axis from the bottom, x towards the lip. The lip is at (x_l, H). At tilt alpha the
//! liquid below the horizontal plane through the lip stays: z cos(alpha) - x sin(alpha) <= H cos(alpha) - x_l sin(alpha).
//! What is above it flows over the lip as over a weir: with the volume V, the retained volume V_ret and the free surface A_s, the head is
//! h = 1000 max(0, V - V_ret)/A_s mm, and the flow is fluidity (2/3) 0.6 width sqrt(2 * 9810)/1000 h^1.5 ml/s.

use serde::{Deserialize, Serialize};

use super::habits::{Habits, Slosh};

/// Share of the outflow that first stays at the lip as a film. Part of the evaluation's protocol; no measurement is recorded.
const FILM_SHARE: f64 = 0.12;
/// Time constant with which the film drains, s. Part of the evaluation's protocol; no measurement is recorded.
const FILM_S: f64 = 0.30;
/// Share of the outflow that becomes film when the whole stream clings to the wall. Chosen by hand; no measurement is recorded.
const CLINGING_SHARE: f64 = 0.6;
/// Share of its volume up to which a container is filled at most. Chosen by hand.
const FILL_SHARE_MAX: f64 = 0.92;
/// Step of the tables over the tilt, degrees: fine enough that linear interpolation does for what lies between.
const TABLE_STEP_DEG: f64 = 0.25;

/// Shape of a vessel's inside, all lengths in mm.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case", tag = "kind")]
pub enum Shape {
    /// Straight cylinder: a beaker.
    Cylinder {
        /// Inner radius.
        radius_mm: f64,
        /// Inner height.
        height_mm: f64,
    },
    /// Truncated cone: a glass or cup.
    Cone {
        /// Inner radius at the bottom.
        bottom_mm: f64,
        /// Inner radius at the lip.
        top_mm: f64,
        /// Inner height.
        height_mm: f64,
    },
    /// Round, with a body, a shoulder and a neck.
    Bottle {
        /// Inner radius of the body.
        body_mm: f64,
        /// Inner radius of the neck.
        neck_mm: f64,
        /// Height at which the shoulder begins.
        shoulder_mm: f64,
        /// Height at which the neck begins.
        neck_from_mm: f64,
        /// Inner height.
        height_mm: f64,
    },
    /// Square jug whose lip reaches beyond one side, or carton whose lip lies inside of it.
    Jug {
        /// Half of the inner side.
        half_side_mm: f64,
        /// How far the spout's lip reaches beyond the side; below 0, how far it lies inside.
        spout_mm: f64,
        /// Inner height.
        height_mm: f64,
    },
}

impl Shape {
    /// Inner height, mm.
    pub fn height_mm(&self) -> f64 {
        match *self {
            Self::Cylinder { height_mm, .. }
            | Self::Cone { height_mm, .. }
            | Self::Bottle { height_mm, .. }
            | Self::Jug { height_mm, .. } => height_mm,
        }
    }

    /// The same shape with all lengths multiplied by `factor`.
    pub fn scaled(self, factor: f64) -> Self {
        let f = factor;
        match self {
            Self::Cylinder { radius_mm, height_mm } => Self::Cylinder { radius_mm: radius_mm * f, height_mm: height_mm * f },
            Self::Cone { bottom_mm, top_mm, height_mm } => {
                Self::Cone { bottom_mm: bottom_mm * f, top_mm: top_mm * f, height_mm: height_mm * f }
            }
            Self::Bottle { body_mm, neck_mm, shoulder_mm, neck_from_mm, height_mm } => Self::Bottle {
                body_mm: body_mm * f,
                neck_mm: neck_mm * f,
                shoulder_mm: shoulder_mm * f,
                neck_from_mm: neck_from_mm * f,
                height_mm: height_mm * f,
            },
            Self::Jug { half_side_mm, spout_mm, height_mm } => {
                Self::Jug { half_side_mm: half_side_mm * f, spout_mm: spout_mm * f, height_mm: height_mm * f }
            }
        }
    }

    /// Distance of the lip from the vessel's axis, mm.
    pub fn lip_mm(&self) -> f64 {
        match *self {
            Self::Cylinder { radius_mm, .. } => radius_mm,
            Self::Cone { top_mm, .. } => top_mm,
            Self::Bottle { neck_mm, .. } => neck_mm,
            Self::Jug { half_side_mm, spout_mm, .. } => half_side_mm + spout_mm,
        }
    }

    /// Half of the extent in x at height z, mm.
    fn reach_mm(&self, z_mm: f64) -> f64 {
        match *self {
            Self::Cylinder { radius_mm, .. } => radius_mm,
            Self::Cone { bottom_mm, top_mm, height_mm } => bottom_mm + (top_mm - bottom_mm) * (z_mm / height_mm),
            Self::Bottle { body_mm, neck_mm, shoulder_mm, neck_from_mm, .. } => {
                let s = ((z_mm - shoulder_mm) / (neck_from_mm - shoulder_mm)).clamp(0.0, 1.0);
                body_mm + (neck_mm - body_mm) * (s * s * (3.0 - 2.0 * s))
            }
            Self::Jug { half_side_mm, .. } => half_side_mm,
        }
    }

    /// Full width across x at the place (x, z), mm; 0 outside of the vessel.
    fn width_mm(&self, x_mm: f64, z_mm: f64) -> f64 {
        if !(0.0..=self.height_mm()).contains(&z_mm) {
            return 0.0;
        }
        let reach = self.reach_mm(z_mm);
        match self {
            Self::Jug { .. } => 2.0 * reach * f64::from(x_mm.abs() <= reach),
            _ => 2.0 * (reach * reach - x_mm * x_mm).max(0.0).sqrt(),
        }
    }

    /// Area of the part of the section at height z that lies on the lip's side of x = c, mm^2.
    fn section_beyond_mm2(&self, c_mm: f64, z_mm: f64) -> f64 {
        let r = self.reach_mm(z_mm);
        let c = c_mm.clamp(-r, r);
        match self {
            Self::Jug { .. } => 2.0 * r * (r - c),
            _ => r * r * (c / r).acos() - c * (r * r - c * c).max(0.0).sqrt(),
        }
    }

    /// Volume that stays in the vessel at tilt `alpha_deg`, ml; at 0 that is the whole inside.
    pub fn retained_ml(&self, alpha_deg: f64) -> f64 {
        let (sin, cos) = alpha_deg.max(0.0).to_radians().sin_cos();
        let (height, lip) = (self.height_mm(), self.lip_mm());
        midpoints(0.0, height, 400, |z| {
            let c = if sin < 1e-9 { f64::NEG_INFINITY } else { lip - (height - z) * cos / sin };
            self.section_beyond_mm2(c, z)
        }) / 1000.0
    }

    /// Free surface when the vessel is filled up to the lip at tilt `alpha_deg`, mm^2, at least 300.
    pub fn surface_mm2(&self, alpha_deg: f64) -> f64 {
        let (sin, cos) = alpha_deg.max(0.0).to_radians().sin_cos();
        let (height, lip) = (self.height_mm(), self.lip_mm());
        // The integral runs along the axis that the liquid's surface crosses less steeply.
        let area = if cos > sin {
            let reach = [0.0, 0.25, 0.5, 0.75, 1.0].map(|f| self.reach_mm(f * height)).into_iter().fold(0.0, f64::max);
            midpoints(-reach, reach, 400, |x| self.width_mm(x, height - (lip - x) * sin / cos)) / cos
        } else {
            midpoints(0.0, height, 400, |z| self.width_mm(lip - (height - z) * cos / sin, z)) / sin
        };
        area.max(300.0)
    }
}

/// The integral of `f` from `from` to `to` by the midpoint rule with `n` steps.
fn midpoints(from: f64, to: f64, n: usize, f: impl Fn(f64) -> f64) -> f64 {
    let step = (to - from) / n as f64;
    (0..n).map(|k| f(from + (k as f64 + 0.5) * step)).sum::<f64>() * step
}

/// What leaves the lip, for the camera that draws it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Lip {
    /// Flow that leaves the container, the draining film included, ml/s.
    pub flow_ml_s: f64,
    /// The part of the flow that comes from the film, ml/s.
    pub film_ml_s: f64,
    /// Head over the lip, mm.
    pub head_mm: f64,
    /// Mean speed of the liquid over the lip, mm/s.
    pub speed_mm_s: f64,
    /// Width of the sheet over the lip, mm.
    pub width_mm: f64,
}

/// A vessel with liquid in it.
#[derive(Debug, Clone)]
pub struct Container {
    shape: Shape,
    lip_width_mm: f64,
    fluidity: f64,
    table: std::sync::Arc<[(f64, f64)]>,
    volume_ml: f64,
    film_ml: f64,
    poured_ml: f64,
    lip: Lip,
    habits: Habits,
    slosh: Slosh,
    at_s: f64,
}

impl Container {
    /// An upright vessel with `volume_ml` in it, at most 92 % of full. `fluidity` is relative to water.
    pub fn new(shape: Shape, lip_width_mm: f64, fluidity: f64, volume_ml: f64) -> Self {
        let steps = (180.0 / TABLE_STEP_DEG) as usize;
        let entry = |k: usize| (shape.retained_ml(k as f64 * TABLE_STEP_DEG), shape.surface_mm2(k as f64 * TABLE_STEP_DEG));
        let table: std::sync::Arc<[(f64, f64)]> = (0..=steps).map(entry).collect();
        let mut container = Self {
            shape,
            lip_width_mm,
            fluidity,
            table,
            volume_ml: 0.0,
            film_ml: 0.0,
            poured_ml: 0.0,
            lip: Lip::default(),
            habits: Habits::default(),
            slosh: Slosh::default(),
            at_s: 0.0,
        };
        container.refill(volume_ml);
        container
    }

    /// The same container with these habits; a rough curve replaces its smooth one.
    #[must_use]
    pub fn with_habits(mut self, habits: Habits) -> Self {
        self.habits = habits;
        let mut retained: Vec<f64> = self.table.iter().map(|(retained, _)| *retained).collect();
        habits.roughen(&mut retained, TABLE_STEP_DEG);
        self.table = retained.into_iter().zip(self.table.iter()).map(|(retained, (_, surface))| (retained, *surface)).collect();
        self
    }

    /// Starts again with `volume_ml` in the container, at most 92 % of full, a dry lip and nothing poured.
    pub fn refill(&mut self, volume_ml: f64) {
        self.volume_ml = volume_ml.clamp(0.0, 0.92 * self.full_ml());
        self.film_ml = 0.0;
        self.poured_ml = 0.0;
        self.lip = Lip::default();
        self.slosh = Slosh::default();
        self.at_s = 0.0;
    }

    /// Changes the liquid: `fluidity` is relative to water.
    pub fn set_fluidity(&mut self, fluidity: f64) {
        self.fluidity = fluidity;
    }

    /// The shape of its inside.
    pub fn shape(&self) -> &Shape {
        &self.shape
    }

    /// The most that a person fills in, ml: a little below the lip, so that nothing spills on the way into the gripper.
    pub fn fill_max_ml(&self) -> f64 {
        FILL_SHARE_MAX * self.full_ml()
    }

    /// Volume of the upright container when it is full to the lip, ml.
    pub fn full_ml(&self) -> f64 {
        self.table[0].0
    }

    /// Volume that is inside now, ml.
    pub fn volume_ml(&self) -> f64 {
        self.volume_ml
    }

    /// Volume that has left the lip and falls or has fallen into the receiver, ml.
    pub fn poured_ml(&self) -> f64 {
        self.poured_ml
    }

    /// Volume of the film that will still drip, ml.
    pub fn film_ml(&self) -> f64 {
        self.film_ml
    }

    /// What leaves the lip now.
    pub fn lip(&self) -> Lip {
        self.lip
    }

    /// Volume that stays in this container at a tilt, ml, its rough curve included.
    pub fn retained_ml(&self, tilt_deg: f64) -> f64 {
        self.geometry(tilt_deg).0
    }

    /// How far the liquid's surface swings.
    pub fn slosh(&self) -> &Slosh {
        &self.slosh
    }

    /// What it does beyond a smooth shape and a weir.
    pub fn habits(&self) -> &Habits {
        &self.habits
    }

    /// Retained volume in ml and free surface in mm^2 at a tilt.
    fn geometry(&self, tilt_deg: f64) -> (f64, f64) {
        let at = (tilt_deg.clamp(0.0, 180.0) / TABLE_STEP_DEG).min((self.table.len() - 1) as f64 - 1e-9);
        let k = at as usize;
        let f = at - k as f64;
        let ((v0, a0), (v1, a1)) = (self.table[k], self.table[k + 1]);
        (v0 + (v1 - v0) * f, a0 + (a1 - a0) * f)
    }

    /// The tilt at which the present volume reaches the lip, degrees, to the step of the table.
    pub fn spill_angle_deg(&self) -> f64 {
        let k = self.table.iter().position(|(retained, _)| *retained <= self.volume_ml).unwrap_or(self.table.len() - 1);
        k as f64 * TABLE_STEP_DEG
    }

    /// Lets `dt_s` (at most some 20 ms at a time) pass at `tilt_deg`. Returns the flow that leaves the lip, ml/s.
    pub fn step(&mut self, dt_s: f64, tilt_deg: f64) -> f64 {
        if !(dt_s > 0.0 && tilt_deg.is_finite()) {
            return self.lip.flow_ml_s;
        }
        let surface_tilt_deg = self.slosh.step(&self.habits, dt_s, tilt_deg);
        let (retained_ml, surface_mm2) = self.geometry(surface_tilt_deg);
        let excess_ml = (self.volume_ml - retained_ml).max(0.0);
        let head_mm = 1000.0 * excess_ml / surface_mm2;
        let weir_ml_s = self.fluidity * (2.0 / 3.0) * 0.6 * self.lip_width_mm * (2.0f64 * 9810.0).sqrt() / 1000.0 * head_mm.powf(1.5);
        let over_ml = (weir_ml_s * self.habits.gurgle(self.at_s, head_mm) * dt_s).min(excess_ml / 2.0);
        self.at_s += dt_s;
        self.volume_ml -= over_ml;
        let film_share = FILM_SHARE + (CLINGING_SHARE - FILM_SHARE) * self.habits.clinging(over_ml / dt_s);
        self.film_ml += film_share * over_ml;
        let drip_ml = self.film_ml * (dt_s / FILM_S).min(1.0);
        self.film_ml -= drip_ml;
        let out_ml = (1.0 - film_share) * over_ml + drip_ml;
        self.poured_ml += out_ml;
        let width_mm = if head_mm > 0.0 { self.lip_width_mm } else { 0.0 };
        self.lip = Lip {
            flow_ml_s: out_ml / dt_s,
            film_ml_s: drip_ml / dt_s,
            head_mm,
            speed_mm_s: if head_mm > 0.0 { over_ml / dt_s * 1000.0 / (width_mm * head_mm) } else { 0.0 },
            width_mm,
        };
        self.lip.flow_ml_s
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BEAKER: Shape = Shape::Cylinder { radius_mm: 38.0, height_mm: 115.0 };

    /// Protects the geometry: the general integral equals the cylinder's own integral over x, and the known limits hold.
    #[test]
    fn a_cylinder_retains_what_its_integral_says() {
        for alpha in [5.0f64, 30.0, 55.0, 70.0, 85.0] {
            let tan = alpha.to_radians().tan();
            let direct =
                midpoints(-38.0, 38.0, 4000, |x| 2.0 * (38.0f64 * 38.0 - x * x).sqrt() * (115.0 - (38.0 - x) * tan).max(0.0)) / 1000.0;
            assert!((BEAKER.retained_ml(alpha) - direct).abs() < 0.05, "{alpha}: {} {direct}", BEAKER.retained_ml(alpha));
        }
        let full = std::f64::consts::PI * 38.0 * 38.0 * 115.0 / 1000.0;
        assert!((BEAKER.retained_ml(0.0) - full).abs() < 0.01);
        assert!(BEAKER.retained_ml(90.0) < 1e-6 && BEAKER.retained_ml(110.0) < 1e-6);
        assert!((BEAKER.surface_mm2(0.0) - std::f64::consts::PI * 38.0 * 38.0).abs() < 1.0);
    }

    /// Protects every shape: more tilt never retains more, and the surface is the same on both sides of the change of axis.
    #[test]
    fn retention_falls_with_tilt_for_every_shape() {
        let shapes = [
            BEAKER,
            Shape::Cone { bottom_mm: 28.0, top_mm: 38.0, height_mm: 115.0 },
            Shape::Cone { bottom_mm: 42.0, top_mm: 35.0, height_mm: 115.0 },
            Shape::Bottle { body_mm: 38.0, neck_mm: 16.0, shoulder_mm: 90.0, neck_from_mm: 120.0, height_mm: 150.0 },
            Shape::Jug { half_side_mm: 36.0, spout_mm: 8.0, height_mm: 115.0 },
        ];
        for shape in shapes {
            let retained: Vec<f64> = (0..180).map(|a| shape.retained_ml(f64::from(a))).collect();
            assert!(retained.windows(2).all(|w| w[1] <= w[0] + 1e-9), "{shape:?}");
            let (below, above) = (shape.surface_mm2(44.99), shape.surface_mm2(45.01));
            assert!((below - above).abs() < 0.03 * above, "{shape:?}: {below} {above}");
        }
    }

    /// Protects the scale: no volume appears or vanishes, and the rest of the film drips out after the flow.
    #[test]
    fn volume_is_conserved() {
        let mut container = Container::new(BEAKER, 20.0, 1.0, 300.0);
        let spill = container.spill_angle_deg();
        assert!((BEAKER.retained_ml(spill) - 300.0).abs() < 5.0);
        for _ in 0..300 {
            container.step(1.0 / 90.0, spill + 10.0);
            assert!((container.volume_ml() + container.film_ml() + container.poured_ml() - 300.0).abs() < 1e-9);
        }
        assert!(container.poured_ml() > 20.0);
        for _ in 0..600 {
            container.step(1.0 / 90.0, 0.0);
        }
        assert!(container.film_ml() < 1e-6 && container.lip().flow_ml_s < 1e-6);
    }

    /// Protects the real-time cell: the flow hardly depends on how finely time is cut.
    #[test]
    fn the_step_size_hardly_matters() {
        let pour = |steps: usize| {
            let mut container = Container::new(BEAKER, 20.0, 1.0, 300.0);
            let spill = container.spill_angle_deg();
            for k in 0..steps {
                container.step(3.0 / steps as f64, spill - 5.0 + 20.0 * k as f64 / steps as f64);
            }
            container.poured_ml()
        };
        let (coarse, fine) = (pour(270), pour(2700));
        assert!((coarse - fine).abs() < 0.01 * fine, "{coarse} {fine}");
    }
}
