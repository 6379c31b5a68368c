//! The shape of a container: how much of its capacity is lost as it tilts, and how large its free surface is then.
//!
//! All of it is pure. [`CapacityCurve`] is read in the controller's loop: it has a fixed size, and reading it neither allocates nor panics.
//! The trainer fits the [`Vessel`]. Volumes are in ml, angles in degrees from upright.
//!
//! The liquid in a container that is filled to its lip turns about the lip as the container tilts. What then lies above the
//! lip is the capacity that is lost:
//!
//! ```text
//! w(a) = exp(s(a)) max((1 - f) w_0(a) + f w_even, W_MIN)        capacity lost a degree; s is linear between the knots
//! W(a) = integral of w from 0 to a                              capacity lost from upright to tilt a
//! A(a) = max((2 w)^(2/3), A_MIN)                                free surface at the lip, with w in mm^3 a radian
//! ```
//!
//! w_0 is that of a round vessel with straight walls: `w_0 = integral of (distance from the lip) dA` over the
//! free surface. w_even spreads the same capacity evenly over all tilts: beyond the horizontal a beaker is empty, but a bottle
//! is not. s says how the real vessel differs. Real vessels are rough, so s has a knot every 5 degrees. A square of side A^(1/2) whose edge is
//! the lip loses A^(3/2)/2 a radian; that gives the surface.
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
pub const KNOTS: usize = 26;
/// The first of these angles, degrees. From the prototype; no other measurement is recorded.
const FIRST_KNOT_DEG: f64 = 2.5;
/// The distance from one to the next, degrees: 10 were too few for real vessels in the prototype; no other measurement is recorded.
const KNOT_STEP_DEG: f64 = 5.0;

/// The tilt at which [`Vessel::log_shape`] has an entry, degrees.
pub fn knot_deg(knot: usize) -> f64 {
    FIRST_KNOT_DEG + KNOT_STEP_DEG * knot as f64
}

/// Where a tilt is between the knots: the knot below, and the share of the one above it, 0 to 1; beyond the ends s is constant.
#[inline]
pub(super) fn knot_place(tilt_deg: f64) -> (usize, f64) {
    // NaN becomes 0 by the cast; the clamp keeps the index inside.
    let at = ((tilt_deg - FIRST_KNOT_DEG) / KNOT_STEP_DEG).clamp(0.0, (KNOTS - 1) as f64);
    let knot = (at as usize).min(KNOTS - 2);
    (knot, at - knot as f64)
}

/// The least capacity that is lost, ml a degree. A straight cup is empty beyond the horizontal, but other vessels are not. Chosen by
/// hand; no measurement is recorded.
const LOST_MIN_ML_PER_DEG: f64 = 0.2;
/// The least free surface, mm^2. Chosen by hand: a lip is some 15 mm wide, and the liquid reaches a little way back from it.
const SURFACE_MIN_MM2: f64 = 300.0;
/// Number of slices in the integral over the free surface. Chosen by hand; no measurement is recorded.
const SLICES: usize = 64;
/// Resolution of the tables, degrees. Chosen by hand; no measurement is recorded.
const STEP_DEG: f64 = 1.0;
/// Number of entries of each table: they reach beyond 110 degrees, the largest tilt in the shipped configurations. A tilt beyond 120
/// degrees counts as 120.
pub(super) const ENTRIES: usize = 122;

/// The shape of a container.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Vessel {
    /// Radius at the lip of the straight-walled vessel, mm.
    pub radius_mm: f64,
    /// Its height, mm.
    pub height_mm: f64,
    /// Its radius at the bottom divided by its radius at the lip.
    pub taper: f64,
    /// Share of the capacity that is spread evenly over all tilts, 0 to 1.
    pub even_share: f64,
    /// Logarithm of the capacity that the real vessel loses a degree, divided by that of the straight one, at each
    /// [`knot_deg`].
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
        let (knot, share) = knot_place(tilt_deg);
        let log_shape = self.log_shape[knot] + share * (self.log_shape[knot + 1] - self.log_shape[knot]);
        // The straight vessel's volume spread over 90 degrees.
        let t = self.taper;
        let even = std::f64::consts::PI * self.radius_mm * self.radius_mm * self.height_mm * (1.0 + t + t * t) / 3.0 / 90.0 / 1000.0;
        let mixed = (1.0 - self.even_share) * self.straight(tilt_deg) + self.even_share * even;
        let lost_ml_per_deg = log_shape.exp() * mixed.max(LOST_MIN_ML_PER_DEG);
        let lost_mm3_per_rad = lost_ml_per_deg * 1000.0 * 180.0 / std::f64::consts::PI;
        (lost_ml_per_deg, (2.0 * lost_mm3_per_rad).powf(2.0 / 3.0).max(SURFACE_MIN_MM2))
    }

    /// Capacity that the straight-walled vessel loses, ml a degree, without its even share.
    ///
    /// At depth u below the lip, the liquid's plane is at x = R - u cot(a), and the vessel's section there is
    /// 2 sqrt(r^2 - x^2) wide.
    fn straight(&self, tilt_deg: f64) -> f64 {
        let (sin, cos) = tilt_deg.max(2.0).to_radians().sin_cos();
        let cot = cos / sin;
        let widest = self.radius_mm * self.taper.max(1.0);
        let depth = if cot > 1e-6 { self.height_mm.min((self.radius_mm + widest) / cot) } else { self.height_mm };
        let step = depth / SLICES as f64;
        let mut lever = 0.0;
        for k in 0..SLICES {
            let u = (k as f64 + 0.5) * step;
            let x = self.radius_mm - u * cot;
            let r = self.radius_mm * (1.0 + (self.taper - 1.0) * u / self.height_mm);
            lever += 2.0 * (r * r - x * x).max(0.0).sqrt() * u;
        }
        lever * step / (sin * sin) * std::f64::consts::PI / 180.0 / 1000.0
    }
}

/// A place between two entries of the tables.
#[derive(Debug, Clone, Copy)]
pub(super) struct TablePlace {
    /// The entry below.
    index: usize,
    /// How far the place is on the way from there to the entry above, 0 to 1.
    share: f64,
}

impl TablePlace {
    /// Where a tilt is in the tables. A tilt beyond an end counts as that end; one that is not a number gives a share that is not a number.
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

    /// The same as [`CapacityCurve::lost_ml`], at a place of the tables.
    #[inline]
    pub(super) fn lost_ml_at(&self, TablePlace { index, share }: TablePlace) -> f64 {
        let slope = &self.lost_ml_per_deg;
        self.lost_ml[index] + STEP_DEG * share * (slope[index] + 0.5 * share * (slope[index + 1] - slope[index]))
    }

    /// Capacity that is lost at a tilt, ml a degree.
    pub fn lost_ml_per_deg(&self, tilt_deg: f64) -> f64 {
        self.lost_ml_per_deg_at(TablePlace::of(tilt_deg))
    }

    /// Capacity that is lost at a place of the tables, ml a degree.
    #[inline]
    pub(super) fn lost_ml_per_deg_at(&self, place: TablePlace) -> f64 {
        place.read(&self.lost_ml_per_deg)
    }
}
