//! Whether what the camera sees can be, by what was learned of vessel and flow.
//!
//! It is pure and runs in the controller's loop: its size is fixed, and it does not allocate, panic or fail. A lone odd frame moves nothing; a
//! row of them is impossible, and then nothing that the camera says is to be believed.
//!
//! | rule | verdict |
//! |---|---|
//! | a stream is seen although the container is upright | [`Impossible::Flow`] |
//! | areas larger than three times the largest of the episodes, three frames in a row | [`Impossible::Flow`] |
//! | the same area to the bit, while the container is tilted by 3 degrees | [`Impossible::Flow`] |
//! | what was seen to leave is far less than what the tilt lets out, ten frames in a row, or far more | [`Impossible::Flow`] |
//! | nothing was ever seen to flow, 25 degrees beyond the tilt at which the emptiest episode flowed | [`Impossible::NoFlow`] |
//!
//! The balance of a pour, with the capacity w that the vessel loses a degree:
//!
//! ```text
//! e = e_0 + integral of w da - sum of v          liquid above the lip, by tilt and camera; below 0 none can flow
//! e_v                                            the same, by the stream that is seen
//! behind:  e - doubt > 2 e_v                     the stream stays behind the tilt
//! ahead:   e + doubt < 0                         the liquid is below the lip, and more than a film is seen
//! ```

use serde::{Deserialize, Serialize};

use super::filter::{Innovation, Tilt, UnknownsCovariance};
use super::flow::FlowTables;
use super::vessel::{KNOTS, TablePlace, knot_place};

/// A measurement that is further off than this many standard deviations is odd: where the filters no longer believe it fully.
const ODD_SDS: f64 = 4.0;
/// Number of frames in a row in which the stream is behind the tilt: longer than half a swing of a surface that sloshes at 2 Hz.
const BEHIND_FRAMES: u32 = 10;
/// How far the capacity may be off what was learned, standard deviations. Chosen by hand; docs/LEARNING.md has the false alarms.
const CAPACITY_SDS: f64 = 4.0;
/// Largest share of the capacity that this may explain away: some of it there must be. Chosen by hand; no measurement is recorded.
const CAPACITY_SHARE_MAX: f64 = 0.75;
/// The least doubt in the balance, ml: a vessel that loses 50 ml in a degree is half of that off. docs/LEARNING.md has the false alarms.
const BALANCE_ML: f64 = 40.0;
/// The same as a part of the vessel, degrees: liquid that swings is as far from level. docs/LEARNING.md has the false alarms.
const BALANCE_DEG: f64 = 3.0;
/// How far the camera's sum may be off in the balance, as a share. Chosen by hand: three times what five curves leave open.
const SUM_SHARE: f64 = 0.1;
/// How much may be seen to leave although the liquid is below the lip, ml: a film still drips. Chosen by hand: twice what a curve's film holds.
const FILM_ML: f64 = 8.0;
/// By how many times the stream may stay behind the liquid that stands above the lip. Chosen by hand; docs/LEARNING.md has the false alarms.
const BEHIND_FACTOR: f64 = 2.0;
/// Number of frames in a row with the same area to the bit, after which it is no measurement if the tilt has changed meanwhile. Chosen by hand:
/// a stream's area is never the same twice.
const SAME_FRAMES: u32 = 10;
/// How far the container must be tilted meanwhile, degrees. Chosen by hand; no measurement is recorded.
const SAME_DEG: f64 = 3.0;
/// Number of frames in a row that show a stream at an upright container, or too much of one. Chosen by hand: more than a reflection gives.
const TOO_MUCH_FRAMES: u32 = 3;
/// A container that is tilted less than this is upright, degrees. Chosen by hand: a full one spills there.
const UPRIGHT_DEG: f64 = 1.0;
/// Number of frames in a row without flow at a tilt at which it must flow. Chosen by hand; no measurement is recorded.
const NO_FLOW_FRAMES: u32 = 5;

/// What the camera sees cannot be.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
pub enum Impossible {
    /// A stream that the container cannot give at its tilt.
    Flow,
    /// No stream, where even the emptiest container of the episodes would give one.
    NoFlow,
}

/// What the episodes showed at most.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Bounds {
    /// A larger area is no measurement, px^2.
    pub most_px2: f64,
    /// Tilt by which flow must have been seen, degrees.
    pub dry_deg: f64,
}

/// The balance of one pour.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct Balance {
    /// Liquid above the lip, by tilt and camera, ml.
    excess_ml: f64,
    /// Capacity lost since flow was first seen, ml.
    lost_ml: f64,
    /// How the former changes with the log shape at each knot, ml.
    by_knot_ml: [f64; KNOTS],
    /// Outflow seen so far, and in the newest frame, ml.
    sum_ml: f64,
    newest_ml: f64,
    /// Number of frames in a row in which the stream was behind the tilt.
    behind_frames: u32,
    /// What was seen since it was ahead of it, ml.
    ahead_ml: f64,
}

impl Balance {
    /// Begins with the first outflow that is seen.
    fn begin(flow: &FlowTables, tilt: Tilt, seen_ml: f64) -> Self {
        Self { excess_ml: flow.excess_ml_for(tilt.tilt_deg, seen_ml), newest_ml: seen_ml, ..Self::default() }
    }

    /// Takes a frame, whose outflow is `None` if it was lost. Returns whether the balance has not added up for too long.
    fn step(&mut self, flow: &FlowTables, unknowns: &UnknownsCovariance, tilt: Tilt, seen_ml: Option<f64>) -> bool {
        let middle_deg = tilt.tilt_deg - 0.5 * tilt.change_deg;
        let lost_ml_per_deg = flow.capacity.lost_ml_per_deg_at(TablePlace::of(middle_deg));
        let lost_ml = lost_ml_per_deg * tilt.change_deg;
        let (knot, share) = knot_place(middle_deg);
        self.by_knot_ml[knot] += (1.0 - share) * lost_ml;
        self.by_knot_ml[knot + 1] += share * lost_ml;
        self.lost_ml += lost_ml;
        self.newest_ml = seen_ml.unwrap_or(self.newest_ml);
        self.sum_ml += self.newest_ml;
        self.excess_ml += lost_ml - self.newest_ml;
        let first = unknowns.len() - KNOTS;
        let product = |row: &[f64]| row.iter().zip(&self.by_knot_ml).map(|(p, g)| p * g).sum::<f64>();
        let variance_ml2: f64 = unknowns[first..].iter().zip(&self.by_knot_ml).map(|(row, g)| g * product(&row[first..])).sum();
        let capacity_ml = CAPACITY_SDS * variance_ml2.max(0.0).sqrt();
        let doubt_ml = BALANCE_ML.max(BALANCE_DEG * lost_ml_per_deg) + SUM_SHARE * self.sum_ml;
        let seen_excess_ml = flow.excess_ml_for(tilt.tilt_deg, self.newest_ml);
        let least_ml = self.excess_ml - capacity_ml.min(CAPACITY_SHARE_MAX * self.lost_ml.max(0.0)) - doubt_ml;
        let behind = least_ml > BEHIND_FACTOR * seen_excess_ml;
        let ahead = self.excess_ml + capacity_ml + doubt_ml < 0.0;
        self.behind_frames = if behind { self.behind_frames + 1 } else { 0 };
        self.ahead_ml = if ahead { self.ahead_ml + self.newest_ml } else { 0.0 };
        self.behind_frames >= BEHIND_FRAMES || self.ahead_ml > FILM_ML
    }
}

/// Watches one pour.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Watch {
    balance: Option<Balance>,
    /// Whether the frame before was more than was foreseen.
    leapt: bool,
    /// The newest area above 0, px^2, how often it came in a row, and the tilt at which it came first, degrees.
    same: (f32, u32, f64),
    too_much_frames: u32,
    no_flow_frames: u32,
    seen_flow: bool,
    verdict: Option<Impossible>,
}

impl Watch {
    /// What is impossible; once said, it stays.
    pub fn verdict(&self) -> Option<Impossible> {
        self.verdict
    }

    /// Takes a frame's area, px^2 (`None` if it was lost), and the tilt that it shows, degrees. Returns whether it can be a measurement.
    pub fn may_be(&mut self, bounds: &Bounds, area_px2: Option<f32>, tilt_deg: f64) -> bool {
        let Some(area_px2) = area_px2 else { return false };
        let too_large = f64::from(area_px2) > bounds.most_px2;
        let too_much = too_large || (area_px2 > 0.0 && !self.seen_flow && tilt_deg < UPRIGHT_DEG);
        self.too_much_frames = if too_much { self.too_much_frames + 1 } else { 0 };
        self.seen_flow |= area_px2 > 0.0 && !too_much;
        let dry = !self.seen_flow && tilt_deg > bounds.dry_deg;
        self.no_flow_frames = if dry { self.no_flow_frames + 1 } else { 0 };
        if self.too_much_frames >= TOO_MUCH_FRAMES || self.is_stuck(area_px2, tilt_deg) {
            self.verdict.get_or_insert(Impossible::Flow);
        } else if self.no_flow_frames >= NO_FLOW_FRAMES {
            self.verdict.get_or_insert(Impossible::NoFlow);
        }
        !too_much
    }

    /// Whether the area stays the same to the bit while the container is tilted.
    fn is_stuck(&mut self, area_px2: f32, tilt_deg: f64) -> bool {
        let (newest_px2, frames, from_deg) = self.same;
        self.same = if area_px2 > 0.0 && area_px2 == newest_px2 { (newest_px2, frames + 1, from_deg) } else { (area_px2, 1, tilt_deg) };
        let (_, frames, from_deg) = self.same;
        frames >= SAME_FRAMES && (tilt_deg - from_deg).abs() > SAME_DEG
    }

    /// Takes the outflow of a frame since flow was first seen, ml, by the explanation with this flow and these unknowns.
    pub fn balance(&mut self, flow: &FlowTables, unknowns: &UnknownsCovariance, tilt: Tilt, seen_ml: Option<f64>) {
        let balance = self.balance.get_or_insert_with(|| Balance::begin(flow, tilt, seen_ml.unwrap_or(0.0)));
        if balance.step(flow, unknowns, tilt, seen_ml) {
            self.verdict.get_or_insert(Impossible::Flow);
        }
    }

    /// Takes how well a frame was foreseen. Returns whether it is a lone leap upwards, which is not to be believed.
    pub fn foreseen(&mut self, innovation: Option<Innovation>) -> bool {
        let Some(Innovation { sds, .. }) = innovation else { return false };
        let leaps = sds > ODD_SDS;
        let lone = leaps && !self.leapt;
        self.leapt = leaps;
        lone
    }
}
