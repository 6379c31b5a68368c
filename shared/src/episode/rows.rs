//! One row of an episode, and the rows of frames that were lost between two others. It is pure, runs in
//! ordinary threads, and allocates nothing but error texts.

use crate::alpha_track::AlphaTrack;
use crate::messages::Doubt;

/// So many frames may be lost in any file: 10 s at 30 Hz.
const LOST_ALWAYS: u64 = 300;
/// So many more for each frame that is there. A file that wants more has a damaged number, and a few bytes of it would fill the memory. Chosen
/// by hand: an episode of which four fifths are lost teaches nothing.
const LOST_PER_FRAME: u64 = 4;

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
    /// Middle of the exposure, s since the episode's first tick; negative for the few frames from before that tick.
    pub t_s: f64,
    /// Commanded alpha at that time, degrees; finite.
    pub alpha_commanded_deg: f32,
    /// Measured alpha at that time, degrees; NaN if the robot did not report it.
    pub alpha_measured_deg: f32,
    /// V_e, px^2, at least 0; NaN if the frame was lost or its doubt makes it unusable ([`Doubt::usable`]).
    pub area_px2: f32,
    /// Why the area is doubtful.
    pub doubt: Doubt,
    /// Whether the frame was never measured, because the camera or the worker dropped it; in tables, whether its area is missing.
    pub lost: bool,
    /// Whether the frame's picture was recorded; a slow disk drops the picture of a frame that is measured. In tables there are none.
    pub image: bool,
}

/// Counts the frames of a file that are there, and those that are lost between them.
#[derive(Debug, Default)]
pub(super) struct LostFrames {
    there: u64,
    lost: u64,
}

impl LostFrames {
    /// The lost frames between the frame numbered `last` and the later one numbered `sequence`, which is the next one of the file: the number of
    /// each, and its share of the way from the one to the other, between 0 and 1. Fails if more are lost than can be true.
    pub(super) fn between(&mut self, last: u64, sequence: u64) -> Result<impl Iterator<Item = (u64, f64)>, String> {
        let steps = sequence - last;
        self.there += 1;
        self.lost = self.lost.saturating_add(steps - 1);
        if self.lost > LOST_ALWAYS + LOST_PER_FRAME * self.there {
            return Err(format!("frame jumps from {last} to {sequence}: {} frames are lost and {} are there", self.lost, self.there + 1));
        }
        Ok((1..steps).map(move |step| (last + step, step as f64 / steps as f64)))
    }
}

/// The angle after `share` (0 to 1) of the way from `from_deg` to `to_deg`, degrees.
pub(super) fn alpha_between_deg(from_deg: f32, to_deg: f32, share: f64) -> f32 {
    (f64::from(from_deg) + share * (f64::from(to_deg) - f64::from(from_deg))) as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects the memory from a short file with many gaps, each of which could be true alone; ten seconds without a camera are still read.
    #[test]
    fn gaps_have_a_sum() {
        let mut lost = LostFrames::default();
        assert_eq!(lost.between(7, 301).map(Iterator::count), Ok(293));
        let mut rows = 0;
        let refused = (1..10_000u64).find(|k| match lost.between(301 + (k - 1) * 200, 301 + k * 200) {
            Ok(between) => {
                rows += between.count();
                false
            }
            Err(_) => true,
        });
        assert_eq!((refused, rows), (Some(1), 0));
        let last = u64::MAX - 1;
        assert!(LostFrames::default().between(0, last).is_err(), "no overflow");
    }
}
