//! What the extractor asks of a liquid, whatever its kind.
//!
//! In each frame the extractor calls [`Liquid::take`] with the region; checks the light of [`Liquid::sampled`]; calls
//! [`Liquid::look`], which tells whether a stream is there and where its edge roughly lies; then the line's profiles ask
//! [`Liquid::edge_on`] for the exact place; and [`Liquid::confirm`] has the last word. A frame that the checks reject ends before
//! `look`, one without a stream before `edge_on`, one without a first line before `confirm`.
//!
//! All calls come from the extraction thread. After the second frame they allocate nothing. The only failures are OpenCV's.

use super::confidence::Basis;
use super::pace::Pace;
use opencv::boxed_ref::BoxedRef;
use opencv::core::Mat;
use shared::messages::{Doubt, PixelFormat};

/// Samples of a profile on either side of its centre. Chosen by hand; no measurement is recorded.
pub(crate) const REACH: usize = 7;
/// Samples of a profile.
pub(crate) const PROFILE_SAMPLES: usize = 2 * REACH + 1;

/// Samples of the picture along a short straight path across the stream's edge, from within the liquid outwards.
pub(crate) struct Profile {
    /// Blue, green and red at each sample, grey levels.
    pub(crate) colours: [[f32; 3]; PROFILE_SAMPLES],
    /// Place of the middle sample in the region, px.
    pub(crate) centre_px: [f32; 2],
    /// Unit vector from one sample to the next.
    pub(crate) outwards: [f32; 2],
    /// Distance from one sample to the next, px.
    pub(crate) spacing_px: f32,
}

impl Profile {
    /// The place of a sample in the region, px; fractions lie between samples.
    pub(crate) fn place_px(&self, sample: f32) -> [f32; 2] {
        let d = (sample - REACH as f32) * self.spacing_px;
        [self.centre_px[0] + d * self.outwards[0], self.centre_px[1] + d * self.outwards[1]]
    }
}

/// Where the stream's edge lies on a profile.
pub(crate) struct ProfileEdge {
    /// Place of the edge, samples from the profile's inner end.
    pub(crate) sample: f32,
    /// Height of the step at the edge, grey levels.
    pub(crate) contrast: f32,
    /// How much the place is trusted, 0 to 1.
    pub(crate) trust: f32,
    /// Distance in which the step passes from 80 % to 20 %, samples, where that can be told.
    pub(crate) width_samples: Option<f32>,
}

/// Whether a liquid sees a stream.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum Sighting {
    /// There is no stream.
    Dry {
        /// Confidence of that, 0 to 1.
        confidence: f32,
    },
    /// It is not known whether there is a stream, for this reason.
    Unsure(Doubt),
    /// There is a stream.
    Stream {
        /// Share of the edge that is seen, 0 to 1.
        seen_share: f32,
        /// Why its area may not be the whole of it.
        doubt: Doubt,
    },
}

/// The line through the edge points of the profiles.
#[derive(Debug, Clone, Copy)]
pub(crate) struct FineLine {
    /// Cuts with the x-axis and the y-axis, px from the lip.
    pub(crate) legs_px: [f32; 2],
    /// Median height of the step along it, grey levels.
    pub(crate) contrast: f32,
    /// Median distance in which the step passes from 80 % to 20 %, px.
    pub(crate) width_px: f32,
    /// From 0 (none) to 1 (full).
    pub(crate) confidence: f32,
}

/// What a liquid demands of its line.
#[derive(Debug, Clone, Copy)]
pub(crate) struct LineRules {
    /// There is no line when a smaller share of the profiles than this shows an edge.
    pub(crate) profiles_least: f32,
    /// There is no stream when the triangle under the first line is smaller than this, px^2.
    pub(crate) first_area_least_px2: f32,
    /// Whether the width of the stream's own edge tells that the picture is out of focus.
    pub(crate) edge_tells_focus: bool,
    /// What a picture in which it was not told what flows leaves on those that follow.
    pub(crate) unsure: Unsure,
}

/// What a picture in which it was not told what flows leaves on those that follow.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Unsure {
    /// Nothing.
    Passes,
    /// A doubt, once the ground was told dry since the start or the last pause; a pause ends it. So the first dry picture is not held up.
    LastsOnceDry,
    /// A doubt.
    Lasts,
}

/// A way to tell a liquid from what stands behind it.
pub(crate) trait Liquid: Send + Sync {
    /// Whether images of this format show what the liquid is told by.
    fn reads(&self, format: PixelFormat) -> bool;

    /// What the liquid demands of its line.
    fn rules(&self) -> LineRules;

    /// Takes the next picture: the region in BGR at full size.
    fn take(&mut self, region: &BoxedRef<Mat>) -> opencv::Result<()>;

    /// What was read of the picture that was taken, in BGR: the checks of light look at this.
    fn sampled(&self) -> &Mat;

    /// Looks for a stream in the picture that was taken. Replaces `edges_px` by points of the stream's outer edge in the region, px,
    /// from the x-axis to the y-axis; without a stream they are of no use.
    fn look(&mut self, edges_px: &mut Vec<[f32; 2]>) -> opencv::Result<Sighting>;

    /// Says which share of glass and air at the lip is white light that the ground is not, in the picture that was taken: a lamp's
    /// reflection.
    fn see_lip(&mut self, white_share: f32);

    /// Says whether half of what was read of the picture that was taken is saturated. Returns whether it can be looked at all the same.
    fn bears_white(&mut self, half_white: bool) -> bool;

    /// Says that the picture that was taken is not looked at, and why.
    fn lose_picture(&mut self, doubt: Doubt);

    /// Says how fast pictures follow each other from now on.
    fn set_pace(&mut self, pace: Pace);

    /// Says that a pause of unknown length lies before the next picture: what was seen before is no evidence of what is at the lip now.
    fn interrupt(&mut self) -> opencv::Result<()>;

    /// What a measurement in the picture that was looked at rests on.
    fn basis(&self) -> Basis;

    /// Whether the ground at the lip has no pattern, where the liquid needs that and it is known.
    fn ground_is_even(&self) -> Option<bool>;

    /// Mean levels of blue, green and red of what is not liquid in the picture that was looked at, if that is known.
    fn ground_bgr(&self) -> Option<[f32; 3]>;

    /// Which share of the triangle with these legs, px from the lip, was seen to be ground in the picture that was looked at, 0 to 1.
    fn dry_share(&self, legs_px: [f32; 2]) -> f32;

    /// Says the legs, px from the lip, of a stream that may still be where it was last seen, so that what is there is not taken for ground.
    fn hold_ground(&mut self, legs_px: Option<[f32; 2]>);

    /// Where on a profile the stream's edge lies.
    fn edge_on(&self, profile: &Profile) -> Option<ProfileEdge>;

    /// Takes note of the final line (`None` if too few profiles showed an edge) in a picture of this mean grey level. Returns the line if
    /// it is the stream's, and otherwise the doubt under which there is none.
    fn confirm(&mut self, line: Option<FineLine>, mean_level: f32) -> Result<FineLine, Doubt>;
}
