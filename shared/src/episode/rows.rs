//! One line of an episode, and the lines of lost frames between two others. Pure; does not allocate, except for its error texts.

use crate::alpha_track::AlphaTrack;
use crate::messages::Doubt;

/// Most frames in a row that may be lost; a larger gap is a damaged number. Chosen by hand: more than five minutes at 30 Hz.
const GAP_LIMIT: u64 = 10_000;

/// The track of alpha from which an episode's angles are taken. The recorder and the reader use the same one, so that a lost frame gets
/// the angle that the recorder would have written.
pub type EpisodeTrack = AlphaTrack<256>;

/// One camera frame of an episode: a row of `L_E` with V_e in the image's place.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct EpisodeRow {
    /// The camera's frame number; consecutive within an episode.
    pub sequence: u64,
    /// Middle of the exposure, CLOCK_MONOTONIC ns; interpolated for a lost frame; 0 in tables.
    pub captured_at_ns: u64,
    /// Middle of the exposure, s since the episode's first tick; negative for the few frames from before.
    pub t_s: f64,
    /// Commanded alpha at that time, degrees; finite.
    pub alpha_commanded_deg: f32,
    /// Measured alpha at that time, degrees; NaN if the robot did not report it. In tables the same as commanded.
    pub alpha_measured_deg: f32,
    /// V_e, px^2, at least 0; NaN if the frame was lost or its doubt makes it unusable ([`Doubt::usable`]).
    pub area_px2: f32,
    /// Why the area is doubtful.
    pub doubt: Doubt,
    /// The frame was never measured, because the camera or the worker dropped it.
    pub lost: bool,
}

/// The lost frames between the frame numbered `last` and the later one numbered `sequence`: the number of each, and its share of the way
/// from the one to the other, between 0 and 1. Fails if the gap is too large to be true.
pub(super) fn lost_between(last: u64, sequence: u64) -> Result<impl Iterator<Item = (u64, f64)>, String> {
    let steps = sequence - last;
    if steps > GAP_LIMIT {
        return Err(format!("frame jumps from {last} to {sequence}"));
    }
    Ok((1..steps).map(move |step| (last + step, step as f64 / steps as f64)))
}

/// The angle at `share` of the way from `from_deg` to `to_deg`, degrees.
pub(super) fn alpha_between_deg(from_deg: f32, to_deg: f32, share: f64) -> f32 {
    (f64::from(from_deg) + share * (f64::from(to_deg) - f64::from(from_deg))) as f32
}
