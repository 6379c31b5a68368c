//! Whether what the camera sees can be, by what was learned of vessel and flow.
//!
//! It is pure and runs in the controller's loop: its size is fixed, and it does not allocate, panic or fail. A lone odd frame moves nothing; a
//! row of them is impossible, and then nothing that the camera says is to be believed. What was withheld as odd waits for the very next frame, which
//! confirms it or not. If it does not, it is forgotten, and the estimate doubts as much (`Watch::unconfirmed_ml`, `Watch::lone_ml`); of a lone leap of
//! a stream that goes on as before out of a straight vessel, as much as its balance misses. A large stream that is gone within a frame, or begins so large, or whose area
//! stays the same to the bit, moves nothing either, as nobody knows whether it was seen; what may have left meanwhile is in doubt
//! (`Watch::unshown_ml`).
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
//! doubt^2 = sd^2 + 12^2 + w^2 + (0.03 sum)^2     sd is that of the capacity that was taken away so far, in ml
//! behind:  e - 4 doubt > 2 e_v                   the stream stays behind the tilt (2.5 doubts for a straight vessel)
//! ahead:   e + 2 doubt < 0                       the liquid is below the lip, and more than a film is seen
//! ```
//!
//! There is a balance for the vessel of any shape, and one for the straight one where the episodes trust it: its capacity is known far better.
//! What a balance is off by, beyond some doubts of its own, the estimate has to doubt as well (`Watch::unexplained_ml`).

use serde::{Deserialize, Serialize};

use super::filter::{EXPLANATIONS, Innovation, TIGHT, Tilt, UnknownsCovariance};
use super::flow::FlowTables;
use super::vessel::{KNOTS, TablePlace, knot_place};

/// A measurement that is further off than this many standard deviations is odd: where the filters no longer believe it fully.
const ODD_SDS: f64 = 4.0;
/// Number of frames in a row in which the stream is behind the tilt: longer than half a swing of a surface that sloshes at 2 Hz.
const BEHIND_FRAMES: u32 = 10;
/// Largest share of the capacity that this may explain away: some of it there must be. Chosen by hand; no measurement is recorded.
const CAPACITY_SHARE_MAX: f64 = 0.75;
/// The least doubt of the balance, ml. With it, right pours of the tuning rigs were behind by at most 2.9 doubts of the vessel of any shape
/// (2,475 pours; a wild one with an error of 46 ml by 4.8), and by at most 1.2 of the straight one (765 pours).
const BALANCE_ML: f64 = 12.0;
/// The same as a part of the vessel, degrees. Tuned together with [`BALANCE_ML`].
const BALANCE_DEG: f64 = 1.0;
/// How far the camera's sum may be off in the balance, as a share: what five curves leave open.
const SUM_SHARE: f64 = 0.03;
/// From how many doubts on the stream is behind, for the vessel of any shape and for the straight one. Tuned together with [`BALANCE_ML`].
const BEHIND_DOUBTS: [f64; EXPLANATIONS] = [4.0, 2.5];
/// From how many doubts on the stream is ahead. No right pour of the tuning rigs was ahead at all, but for a wild one (1.2).
const AHEAD_DOUBTS: f64 = 2.0;
/// Up to this many doubts, what a balance is off by says nothing about the estimate: 98 % of the right pours of the tuning rigs were within.
const EXPLAINED_DOUBTS: f64 = 2.0;
/// The tilt may be this much below the largest one for the balance to count for the deviation, degrees: on the way back no stream is to fit it.
const AT_LARGEST_DEG: f64 = 1.0;
/// How much may be seen to leave although the liquid is below the lip, ml: a film still drips. Chosen by hand: twice what a curve's film holds.
const FILM_ML: f64 = 8.0;
/// By how many times the stream may stay behind the liquid that stands above the lip. Chosen by hand; docs/LEARNING.md has the false alarms.
const BEHIND_FACTOR: f64 = 2.0;
/// Number of frames in a row with the same area to the bit, after which it is no measurement if the tilt has changed meanwhile. Chosen by hand:
/// a stream's area is never the same twice.
const SAME_FRAMES: u32 = 10;
/// How far the container must be tilted meanwhile, degrees. Chosen by hand; no measurement is recorded.
const SAME_DEG: f64 = 3.0;
/// A stream of more than this in a frame, ml, does not end between two frames unless the container is brought back. Chosen by hand: a stream that
/// ebbs away takes several frames for that.
const ABRUPT_ML: f64 = 0.7;
/// The container is brought back if it is tilted less by this than when the stream was seen last, degrees. Chosen by hand: noise of the tilt is less.
const BROUGHT_BACK_DEG: f64 = 0.5;
/// For so many frames a stream that is gone may still run as before: at a tilt that stands it has ebbed away after half a second, which this is at 30
/// frames a second.
const GONE_FRAMES: u32 = 15;
/// A stream may rise so far within a frame at a tilt that stands, as excess above the lip, ml. Chosen by hand; no measurement is recorded.
const RISES_ML: f64 = 0.3;
/// A stream may be so many frames old when it is first seen to run in two of them. Chosen by hand: the first may be too small to be seen.
const ONSET_FRAMES: f64 = 3.0;
/// After so many frames without it a stream has ended, and another one begins. Chosen by hand: more than the extraction drops in a row.
const ENDED_FRAMES: u32 = 3;
/// From so many equal areas in a row on they are in doubt. Chosen by hand: two may be chance.
const REPEATED_FRAMES: u32 = 3;
/// Number of frames in a row with a stream, from which on it is one.
const FLOW_FRAMES: u32 = 2;
/// An outflow leaps if it is more than this many times that of the two frames before it, and some ml more. Tuned with [`LEAP_ML`].
const LEAP_FACTOR: f64 = 2.0;
/// How much more it has to be to be a leap, ml. In 585 right pours of the tuning rigs, from straight and steep vessels, the largest was 2.3 ml.
const LEAP_ML: f64 = 3.0;
/// The part of a leap that the next frame has to show for it to be real, unless that one leaps as well. Chosen by hand; no measurement is
/// recorded.
const LEAP_STAYS: f64 = 0.5;
/// After a lone leap, the stream is what it was before up to this factor and this many ml. Chosen by hand: frames of one stream differ by less.
const AS_BEFORE: (f64, f64) = (2.0, 0.3);
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

/// An area this many times the episodes' largest is no stream. Chosen by hand: a controlled pour stays far below the largest flow of a curve.
pub const AREA_MARGIN: f64 = 3.0;

impl Bounds {
    /// The largest area of the episodes, px^2.
    pub(super) fn taught_px2(&self) -> f64 {
        self.most_px2 / AREA_MARGIN
    }
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
    /// The largest tilt so far, degrees.
    largest_deg: f64,
    /// By how much the tilt has let out more than was seen, in the newest frame at the largest tilt, ml.
    off_ml: f64,
    /// By how much the balance was off beyond its doubt in the newest frames at the largest tilt, ml: above 0 behind, below 0 ahead.
    unexplained_ml: [f64; BEHIND_FRAMES as usize],
}

impl Balance {
    /// Begins with the first outflow that is seen.
    fn begin(flow: &FlowTables, tilt: Tilt, seen_ml: f64) -> Self {
        Self { excess_ml: flow.excess_ml_for(tilt.tilt_deg, seen_ml), newest_ml: seen_ml, ..Self::default() }
    }

    /// Standard deviation of the capacity that was lost so far, ml.
    fn capacity_sd_ml(&self, unknowns: &UnknownsCovariance) -> f64 {
        let first = unknowns.len() - KNOTS;
        let product = |row: &[f64]| row.iter().zip(&self.by_knot_ml).map(|(p, g)| p * g).sum::<f64>();
        let variance_ml2: f64 = unknowns[first..].iter().zip(&self.by_knot_ml).map(|(row, g)| g * product(&row[first..])).sum();
        variance_ml2.max(0.0).sqrt()
    }

    /// Takes a frame, whose outflow is `None` if it was lost. Returns whether the balance has not added up for too long; the stream is behind
    /// from this many doubts on.
    fn step(&mut self, flow: &FlowTables, unknowns: &UnknownsCovariance, tilt: Tilt, seen_ml: Option<f64>, behind_doubts: f64) -> bool {
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
        let capacity_sd_ml = self.capacity_sd_ml(unknowns);
        let other_ml2 = BALANCE_ML * BALANCE_ML + (BALANCE_DEG * lost_ml_per_deg).powi(2) + (SUM_SHARE * self.sum_ml).powi(2);
        let doubt_ml = (capacity_sd_ml * capacity_sd_ml + other_ml2).sqrt();
        // No doubt of the capacity explains all of it away.
        let most_sd_ml = capacity_sd_ml.min(CAPACITY_SHARE_MAX * self.lost_ml.max(0.0) / behind_doubts);
        let behind_ml = behind_doubts * (most_sd_ml * most_sd_ml + other_ml2).sqrt();
        let seen_excess_ml = flow.excess_ml_for(tilt.tilt_deg, self.newest_ml);
        let behind = self.excess_ml - behind_ml > BEHIND_FACTOR * seen_excess_ml;
        let ahead = self.excess_ml + AHEAD_DOUBTS * doubt_ml < 0.0;
        self.behind_frames = if behind { self.behind_frames + 1 } else { 0 };
        self.ahead_ml = if ahead { self.ahead_ml + self.newest_ml } else { 0.0 };
        self.largest_deg = self.largest_deg.max(tilt.tilt_deg);
        if tilt.tilt_deg >= self.largest_deg - AT_LARGEST_DEG {
            self.off_ml = self.excess_ml - seen_excess_ml;
            self.unexplained_ml.rotate_left(1);
            self.unexplained_ml[BEHIND_FRAMES as usize - 1] =
                self.off_ml.signum() * (self.off_ml.abs() - EXPLAINED_DOUBTS * doubt_ml).max(0.0);
        }
        self.behind_frames >= BEHIND_FRAMES || self.ahead_ml > FILM_ML
    }

    /// What was off for ten frames in a row beyond its doubt, to the same side, ml.
    fn unexplained_ml(&self) -> f64 {
        let (low, high) = self.unexplained_ml.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), off| (l.min(*off), h.max(*off)));
        low.max(0.0) + (-high).max(0.0)
    }
}

/// For how many frames a stream of `ml` in a frame must have run unseen before it was first seen, at most [`GONE_FRAMES`]: the tilt lets the liquid
/// rise above the lip by so much a frame. Half of the stream is then the least mean of what it gave.
fn frames_before(flow: &FlowTables, tilt: Tilt, ml: f64) -> f64 {
    let faster_deg = tilt.change_deg.max(tilt.change_before_deg).max(0.0);
    let rises_ml = flow.capacity.lost_ml_per_deg_at(TablePlace::of(tilt.tilt_deg)) * faster_deg + RISES_ML;
    (flow.excess_ml_for(tilt.tilt_deg, ml) / rises_ml - ONSET_FRAMES).clamp(0.0, f64::from(GONE_FRAMES))
}

/// Whether the outflow of a frame leaps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Leap {
    /// It does not.
    None,
    /// It does, and does not count before the next frame has confirmed it.
    Withheld,
    /// The leap of the frame before stays, so that its outflow counts too, ml.
    Confirmed {
        /// That outflow, ml.
        withheld_ml: f64,
    },
}

/// Watches one pour.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Watch {
    balances: [Option<Balance>; EXPLANATIONS],
    /// Whether the frame before was more than was foreseen.
    leapt: bool,
    /// The newest area above 0, px^2, how often it came in a row, and the tilt at which it came first, degrees.
    same: (f32, u32, f64),
    too_much_frames: u32,
    no_flow_frames: u32,
    /// Number of frames in a row that show a stream.
    flow_frames: u32,
    seen_flow: bool,
    /// Outflow in the newest two frames, and what of the newest one was withheld, ml.
    recent_ml: [f64; 2],
    withheld_ml: Option<f64>,
    /// What the two frames of a surge have let out so far, which the next frame has to show as well, and the stream before it, ml.
    surge_ml: Option<(f64, f64)>,
    /// Outflow of the newest frame if it was a lone leap over what was foreseen, and that of the frame before it, ml.
    odd_ml: Option<(f64, f64)>,
    /// What was withheld, and neither confirmed nor refuted by the frame after it, ml.
    unconfirmed_ml: f64,
    /// What was withheld, and after which the stream was what it was before, ml.
    lone_ml: f64,
    /// Outflow of the newest frame with a stream, ml (at its beginning the lesser of two), and its tilt, degrees.
    stream: (f64, f64),
    /// Number of frames in a row without a stream.
    gone_frames: u32,
    /// What of it the newest gap in the stream has added, ml.
    gap_ml: f64,
    /// What may have left in frames that showed no stream or always the same one, ml.
    unshown_ml: f64,
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
        let upright = area_px2 > 0.0 && !self.seen_flow && tilt_deg < UPRIGHT_DEG;
        self.too_much_frames = if too_large || upright { self.too_much_frames + 1 } else { 0 };
        // A lone flash is no stream.
        self.flow_frames = if area_px2 > 0.0 && !upright { self.flow_frames + 1 } else { 0 };
        self.seen_flow |= self.flow_frames >= FLOW_FRAMES;
        let dry = !self.seen_flow && tilt_deg > bounds.dry_deg;
        self.no_flow_frames = if dry { self.no_flow_frames + 1 } else { 0 };
        if self.too_much_frames >= TOO_MUCH_FRAMES || self.is_stuck(area_px2, tilt_deg) {
            self.verdict.get_or_insert(Impossible::Flow);
        } else if self.no_flow_frames >= NO_FLOW_FRAMES {
            self.verdict.get_or_insert(Impossible::NoFlow);
        }
        // A surge that the episodes did not show may be real, and then what it lets out counts: a lone frame of it does not (`leap`).
        !upright
    }

    /// Whether the area stays the same to the bit while the container is tilted.
    fn is_stuck(&mut self, area_px2: f32, tilt_deg: f64) -> bool {
        let (newest_px2, frames, from_deg) = self.same;
        self.same = if area_px2 > 0.0 && area_px2 == newest_px2 { (newest_px2, frames + 1, from_deg) } else { (area_px2, 1, tilt_deg) };
        let (_, frames, from_deg) = self.same;
        frames >= SAME_FRAMES && (tilt_deg - from_deg).abs() > SAME_DEG
    }

    /// Takes the outflow of a frame since flow was first seen, ml, by the explanation of this index, with its flow and unknowns.
    pub fn balance(&mut self, index: usize, flow: &FlowTables, unknowns: &UnknownsCovariance, tilt: Tilt, seen_ml: Option<f64>) {
        let balance = self.balances[index].get_or_insert_with(|| Balance::begin(flow, tilt, seen_ml.unwrap_or(0.0)));
        if balance.step(flow, unknowns, tilt, seen_ml, BEHIND_DOUBTS[index]) {
            self.verdict.get_or_insert(Impossible::Flow);
        }
    }

    /// By how much what was seen is off what the tilt has let out, beyond what that is in doubt, ml; at least 0. The estimate has to doubt as much.
    pub fn unexplained_ml(&self) -> f64 {
        self.balances.iter().flatten().map(Balance::unexplained_ml).fold(0.0, f64::max)
    }

    /// What was withheld and never confirmed nor refuted, the newest frame's included, ml; at least 0. The estimate has to doubt as much.
    pub fn unconfirmed_ml(&self) -> f64 {
        let pending = |of: Option<(f64, f64)>| of.map_or(0.0, |(ml, _)| ml);
        self.unconfirmed_ml + self.withheld_ml.unwrap_or(0.0) + pending(self.odd_ml) + pending(self.surge_ml)
    }

    /// What was withheld as a lone leap, after which the stream was what it was before, ml; at least 0. A steep vessel whose liquid swings lets 40 ml out
    /// in one frame and goes on as before, so there nobody knows. A straight one gives such a surge near 90 degrees only, when it is almost empty; there
    /// the leap may have been real as far as the tilt has let out more than was seen.
    pub fn lone_ml(&self, straight: bool) -> f64 {
        let unseen_ml = self.balances[TIGHT].as_ref().map_or(0.0, |balance| balance.off_ml.max(0.0));
        if straight { self.lone_ml.min(unseen_ml) } else { self.lone_ml }
    }

    /// What may have left unseen while a large stream was gone within a frame, always had the same area, or was not there yet, ml; at least 0. The
    /// estimate has to doubt as much.
    pub fn unshown_ml(&self) -> f64 {
        self.unshown_ml
    }

    /// Takes the outflow of a frame that may be a measurement, ml, and the tilt that it shows, by the vessel of any shape: what a camera shows that
    /// does not see the stream any more, or did not see how it began. Call it after [`Watch::may_be`] and [`Watch::leap`], and not for what is withheld.
    pub fn shows(&mut self, flow: &FlowTables, tilt: Tilt, measured_ml: f64) {
        let ((stream_ml, stream_deg), tilt_deg) = (self.stream, tilt.tilt_deg);
        if measured_ml > 0.0 {
            // A lone flash is no stream, and a lone zero none that ended.
            let [newest_ml, before_ml] = self.recent_ml;
            let goes_on = stream_ml > 0.0 && self.gone_frames < ENDED_FRAMES;
            let now_ml = if goes_on { measured_ml } else { newest_ml.min(before_ml) };
            if !goes_on && now_ml > ABRUPT_ML {
                // What a gap has counted already may be the same liquid.
                let ran_ml = 0.5 * now_ml * frames_before(flow, tilt, now_ml);
                self.unshown_ml += (ran_ml - self.gap_ml).max(0.0);
            }
            self.gap_ml = if goes_on || now_ml > ABRUPT_ML { 0.0 } else { self.gap_ml };
            (self.stream, self.gone_frames) = ((now_ml, tilt_deg), 0);
            let (_, repeated, _) = self.same;
            self.unshown_ml += if repeated >= REPEATED_FRAMES { measured_ml } else { 0.0 };
            return;
        }
        self.gone_frames = self.gone_frames.saturating_add(1);
        let may_run = stream_ml > ABRUPT_ML && tilt_deg > stream_deg - BROUGHT_BACK_DEG && self.gone_frames <= GONE_FRAMES;
        if may_run {
            // A lone zero is bridged by sum and filter.
            let more_ml = if self.gone_frames > 1 { stream_ml } else { 0.0 };
            self.gap_ml += more_ml;
            self.unshown_ml += more_ml;
        } else if self.gone_frames >= ENDED_FRAMES {
            self.stream = (0.0, tilt_deg);
        }
    }

    /// Takes what was withheld and is not confirmed by the frame after it, ml.
    fn not_confirmed(&mut self, withheld_ml: f64, before_ml: f64, after_ml: f64) {
        let (factor, more_ml) = AS_BEFORE;
        let as_before = after_ml <= factor * before_ml + more_ml && before_ml <= factor * after_ml + more_ml;
        *(if as_before { &mut self.lone_ml } else { &mut self.unconfirmed_ml }) += withheld_ml;
    }

    /// Takes a lost frame: what was withheld in the frame before it is forgotten, as a later one says nothing about it, and stays in doubt.
    pub fn lost(&mut self) {
        self.unconfirmed_ml = self.unconfirmed_ml();
        (self.withheld_ml, self.odd_ml, self.surge_ml) = (None, None, None);
    }

    /// Takes the outflow of a frame that may be a measurement, ml, and says whether it counts yet. Of a surge that ebbs, each frame leaps over what
    /// was before; so a leap after a leap confirms it. If it is over in the frame after that, it may have been two flashes, and
    /// stays in doubt.
    pub fn leap(&mut self, measured_ml: f64) -> Leap {
        let [newest_ml, before_ml] = self.recent_ml;
        if let Some((surge_ml, stream_ml)) = self.surge_ml.take() {
            let (factor, more_ml) = AS_BEFORE;
            self.unconfirmed_ml += if measured_ml <= factor * stream_ml + more_ml { surge_ml } else { 0.0 };
        }
        let leaps = measured_ml > LEAP_FACTOR * newest_ml.max(before_ml) + LEAP_ML;
        if let Some(withheld_ml) = self.withheld_ml.take() {
            if leaps || measured_ml >= LEAP_STAYS * withheld_ml {
                self.surge_ml = Some((withheld_ml + measured_ml, newest_ml));
                self.recent_ml = [measured_ml, withheld_ml];
                self.leapt = true;
                return Leap::Confirmed { withheld_ml };
            }
            self.not_confirmed(withheld_ml, newest_ml, measured_ml);
        }
        if leaps {
            self.withheld_ml = Some(measured_ml);
            return Leap::Withheld;
        }
        self.recent_ml = [measured_ml, newest_ml];
        Leap::None
    }

    /// Takes how well a frame was foreseen, and its outflow, ml. A lone leap upwards is not to be believed.
    pub fn foreseen(&mut self, innovation: Option<Innovation>, measured_ml: Option<f64>) -> Leap {
        let Some(measured_ml) = measured_ml else { return Leap::None };
        let leaps = innovation.is_some_and(|i| i.sds > ODD_SDS);
        let lone = leaps && !self.leapt;
        self.leapt = leaps;
        if let Some((withheld_ml, before_ml)) = self.odd_ml.take() {
            if leaps || measured_ml >= LEAP_STAYS * withheld_ml {
                return Leap::Confirmed { withheld_ml };
            }
            self.not_confirmed(withheld_ml, before_ml, measured_ml);
        }
        if lone {
            self.odd_ml = Some((measured_ml, self.recent_ml[1]));
            return Leap::Withheld;
        }
        Leap::None
    }
}
