//! Whether what the camera sees can be, by what was learned of vessel and flow.
//!
//! It is pure and runs in the controller's loop: its size is fixed, and it does not allocate, panic or fail. A lone odd frame moves nothing; a
//! row of them is impossible, and then nothing that the camera says is to be believed.
//!
//! | rule | verdict |
//! |---|---|
//! | a stream is seen although the container is upright | [`Impossible::Flow`] |
//! | areas larger than three times the largest of the episodes, three frames in a row | [`Impossible::Flow`] |
//! | the stream stays behind what the tilt makes it do, in most of some ten frames | [`Impossible::Flow`] |
//! | nothing was ever seen to flow, 25 degrees beyond the tilt at which the emptiest episode flowed | [`Impossible::NoFlow`] |

use serde::{Deserialize, Serialize};

use super::filter::Innovation;

/// A measurement that is further off than this many standard deviations is odd: where the filters no longer believe it fully.
const ODD_SDS: f64 = 4.0;
/// Share of the doubt that stays from frame to frame. Chosen by hand; docs/LEARNING.md has the false alarms.
const DOUBT_KEPT: f64 = 0.9;
/// Doubt at which the stream does not follow the tilt; seven odd frames in a row raise it so far. Chosen by hand; docs/LEARNING.md has the
/// false alarms.
const DOUBT_MAX: f64 = 5.0;
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

/// Watches one pour.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(super) struct Watch {
    doubt: f64,
    /// Whether the frame before was more than was foreseen.
    leapt: bool,
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
        if self.too_much_frames >= TOO_MUCH_FRAMES {
            self.verdict.get_or_insert(Impossible::Flow);
        } else if self.no_flow_frames >= NO_FLOW_FRAMES {
            self.verdict.get_or_insert(Impossible::NoFlow);
        }
        !too_much
    }

    /// Takes how well a frame was foreseen. Returns whether it is a lone leap upwards, which is not to be believed.
    pub fn foreseen(&mut self, innovation: Option<Innovation>) -> bool {
        let Some(Innovation { sds, .. }) = innovation else { return false };
        let odd = sds.abs() > ODD_SDS;
        let lone = odd && sds > 0.0 && !self.leapt;
        self.leapt = odd && sds > 0.0;
        // More than was foreseen is what a vessel does that loses much in a degree; it ends a pour early and pours nothing too much. A stream
        // that comes and goes, as from a bottle that gurgles, is not stuck.
        self.doubt = if odd && sds > 0.0 { 0.0 } else { DOUBT_KEPT * self.doubt + f64::from(odd) };
        if self.doubt > DOUBT_MAX {
            self.verdict.get_or_insert(Impossible::Flow);
        }
        lone
    }
}
