//! The shape of a container: how much of its capacity is lost as it tilts, and how large its free surface is then.
//!
//! Pure. [`CapacityCurve`] is read in the controller's loop: it has a fixed size, and reading it neither allocates nor panics.
//! The trainer fits the [`Vessel`]. Volumes are in ml, angles in degrees from upright.
//!
//! The liquid in a container that is filled to its lip turns about the lip as the container tilts. What then lies above the
//! lip is the capacity that is lost:
//!
//! ```text
//! w(a) = exp(s(a)) max((1 - f) w_0(a) + f w_even, W_MIN)        capacity lost a degree; s is linear between the knots
//! W(a) = integral of w from 0 to a                              capacity lost from upright to tilt a
//! A(a) = max(exp(2/3 s(a)) ((1 - f) A_0(a) + f A_even), A_MIN)  free surface at the lip
//! ```
//!
//! w_0 and A_0 are those of a round vessel with straight walls, where `w_0 = integral of (distance from the lip) dA` over the
//! free surface. w_even spreads the same capacity evenly over all tilts: beyond the horizontal a beaker is empty, but a bottle
//! is not. How the real vessel differs, s says. Where it loses more than the straight vessel, its surface is larger
//! too, with the power 2/3 by which areas grow with volumes.
//!
//! | symbol | name |
//! |---|---|
//! | a | tilt |
//! | s | [`Vessel::log_shape`] |
//! | f | [`Vessel::even_share`] |
//! | w, W | `lost_ml_per_deg` and [`lost_ml`](CapacityCurve::lost_ml) of [`CapacityCurve`] |
//! | A | `surface_mm2` of [`CapacityCurve`] |

use serde::{Deserialize, Serialize};

/// Number of angles at which a vessel's shape is given.
pub const KNOTS: usize = 9;
/// Angles at which [`Vessel::log_shape`] is given, degrees; it is constant outside of them. Chosen by hand; no measurement is recorded.
pub const KNOTS_DEG: [f64; KNOTS] = [20.0, 35.0, 45.0, 55.0, 65.0, 75.0, 85.0, 95.0, 108.0];
/// The least capacity that is lost, ml a degree. A straight cup is empty beyond the horizontal, but other vessels are not. Chosen by
/// hand; no measurement is recorded.
const LOST_MIN_ML_PER_DEG: f64 = 0.2;
/// The least free surface, mm^2: a lip is some 15 mm wide, and the liquid reaches a little way back from it.
const SURFACE_MIN_MM2: f64 = 300.0;
/// Number of slices in the integral over the free surface. Chosen by hand; no measurement is recorded.
const SLICES: usize = 64;
/// Resolution of the tables, degrees. Chosen by hand; no measurement is recorded.
const STEP_DEG: f64 = 1.0;
/// Number of entries of each table: they reach beyond the largest tilt that a robot is told to take.
pub(super) const ENTRIES: usize = 122;

/// The shape of a container.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Vessel {
    /// Radius at the lip of the straight-walled vessel, mm.
    pub radius_mm: f64,
    /// Its height, mm.
    pub height_mm: f64,
    /// Its radius at the bottom over its radius at the lip.
    pub taper: f64,
    /// Share of the capacity that is spread evenly over all tilts, 0 to 1.
    pub even_share: f64,
    /// Logarithm of the capacity that the real vessel loses a degree over that of the straight one, at [`KNOTS_DEG`].
    pub log_shape: [f64; KNOTS],
}

impl Default for Vessel {
    /// A straight beaker, 38 mm in radius and 115 mm high.
    fn default() -> Self {
        Self { radius_mm: 38.0, height_mm: 115.0, taper: 1.0, even_share: 0.0, log_shape: [0.0; KNOTS] }
    }
}

impl Vessel {
    /// The capacity lost at a tilt, in ml a degree, and the free surface there, in mm^2.
    fn at(&self, tilt_deg: f64) -> (f64, f64) {
        let knot = KNOTS_DEG.partition_point(|knot| *knot <= tilt_deg);
        let log_shape = if knot == 0 {
            self.log_shape[0]
        } else if knot == KNOTS {
            self.log_shape[KNOTS - 1]
        } else {
            let share = (tilt_deg - KNOTS_DEG[knot - 1]) / (KNOTS_DEG[knot] - KNOTS_DEG[knot - 1]);
            self.log_shape[knot - 1] + share * (self.log_shape[knot] - self.log_shape[knot - 1])
        };
        // The volume of the straight vessel over its 90 degrees, and the surface that loses as much when it turns about the radius.
        let t = self.taper;
        let even = std::f64::consts::PI * self.radius_mm * self.radius_mm * self.height_mm * (1.0 + t + t * t) / 3.0 / 90.0 / 1000.0;
        let even_mm2 = even * 1000.0 / (self.radius_mm * 1f64.to_radians());
        let (lost, surface_mm2) = self.straight(tilt_deg);
        let mixed = |straight: f64, even: f64| (1.0 - self.even_share) * straight + self.even_share * even;
        let lost_ml_per_deg = log_shape.exp() * mixed(lost, even).max(LOST_MIN_ML_PER_DEG);
        let surface_mm2 = ((2.0 / 3.0 * log_shape).exp() * mixed(surface_mm2, even_mm2)).max(SURFACE_MIN_MM2);
        (lost_ml_per_deg, surface_mm2)
    }

    /// The same two quantities of the straight-walled vessel, without its even share.
    ///
    /// At depth u below the lip, the liquid's plane is at x = R - u cot(a), and the vessel's section there is
    /// 2 sqrt(r^2 - x^2) wide.
    fn straight(&self, tilt_deg: f64) -> (f64, f64) {
        let (sin, cos) = tilt_deg.max(2.0).to_radians().sin_cos();
        let cot = cos / sin;
        let widest = self.radius_mm * self.taper.max(1.0);
        let depth = if cot > 1e-6 { self.height_mm.min((self.radius_mm + widest) / cot) } else { self.height_mm };
        let step = depth / SLICES as f64;
        let (mut lever, mut area) = (0.0, 0.0);
        for k in 0..SLICES {
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

/// A place between two entries of the tables.
#[derive(Debug, Clone, Copy)]
pub(super) struct TablePlace {
    /// The entry below.
    index: usize,
    /// How far the place is on the way to the entry above, 0 to 1.
    share: f64,
}

impl TablePlace {
    /// Where a tilt is in the tables. A tilt beyond an end is put there; one that is not a number gives a share
    /// that is not a number either.
    pub(super) fn of(tilt_deg: f64) -> Self {
        // NaN becomes 0 by the cast; the clamp keeps the index inside.
        let at = (tilt_deg / STEP_DEG).clamp(0.0, (ENTRIES - 2) as f64);
        let index = (at as usize).min(ENTRIES - 2);
        Self { index, share: at - index as f64 }
    }

    /// The value of a table, linear between its entries.
    #[inline]
    pub(super) fn read(self, table: &[f64; ENTRIES]) -> f64 {
        table[self.index] + self.share * (table[self.index + 1] - table[self.index])
    }
}

/// The tilt of a table's entry, degrees.
pub(super) fn entry_deg(index: usize) -> f64 {
    index as f64 * STEP_DEG
}

/// A [`Vessel`] as tables over the tilt.
#[derive(Debug, Clone, PartialEq)]
pub struct CapacityCurve {
    lost_ml_per_deg: [f64; ENTRIES],
    lost_ml: [f64; ENTRIES],
    /// Free surface at each entry, mm^2.
    pub(super) surface_mm2: [f64; ENTRIES],
}

impl CapacityCurve {
    /// Builds the tables of a vessel.
    pub fn new(vessel: &Vessel) -> Self {
        let mut curve = Self { lost_ml_per_deg: [0.0; ENTRIES], lost_ml: [0.0; ENTRIES], surface_mm2: [0.0; ENTRIES] };
        for k in 0..ENTRIES {
            (curve.lost_ml_per_deg[k], curve.surface_mm2[k]) = vessel.at(entry_deg(k));
            if k > 0 {
                curve.lost_ml[k] = curve.lost_ml[k - 1] + 0.5 * STEP_DEG * (curve.lost_ml_per_deg[k - 1] + curve.lost_ml_per_deg[k]);
            }
        }
        curve
    }

    /// Capacity that is lost from upright to a tilt, ml: what leaves a full vessel that is brought there slowly.
    pub fn lost_ml(&self, tilt_deg: f64) -> f64 {
        self.lost_ml_at(TablePlace::of(tilt_deg))
    }

    /// The same at a place of the tables.
    #[inline]
    pub(super) fn lost_ml_at(&self, TablePlace { index, share }: TablePlace) -> f64 {
        let slope = &self.lost_ml_per_deg;
        self.lost_ml[index] + STEP_DEG * share * (slope[index] + 0.5 * share * (slope[index + 1] - slope[index]))
    }

    /// Capacity that is lost at a place of the tables, ml a degree.
    #[inline]
    pub(super) fn lost_ml_per_deg_at(&self, place: TablePlace) -> f64 {
        place.read(&self.lost_ml_per_deg)
    }
}
