//! What one image tells, and how long it took to find out. This is plain data, for any thread; it cannot fail.

use shared::messages::Doubt;

/// What was measured in one image.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Measurement {
    /// V_e, px^2. It is exactly 0 without a stream, and where nothing could be measured.
    pub area_px2: f32,
    /// From 0 (none) to 1 (full): the share of such frames whose area is within 20 % of the truth.
    pub confidence: f32,
    /// Why the measurement is doubtful.
    pub doubt: Doubt,
    /// Corners x0 y0 x1 y1 x2 y2 in the image, px: the lip, on the x-axis, on the y-axis. All zeros without a stream.
    pub triangle_px: [f32; 6],
}

impl Measurement {
    /// Whether it may be used, see [`Doubt::usable`].
    pub fn is_usable(&self) -> bool {
        self.doubt.usable(self.area_px2)
    }

    /// A measurement without a stream.
    pub(crate) fn nothing(confidence: f32, doubt: Doubt) -> Self {
        Self { area_px2: 0.0, confidence, doubt, triangle_px: [0.0; 6] }
    }
}

/// Time spent in each stage of one measurement, ns.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct Stages {
    /// Cropping, converting, and resampling into rays or into a small picture.
    pub rays_ns: u64,
    /// Checks of light, saturation and repetition.
    pub checks_ns: u64,
    /// Telling liquid from background, and the stream's edge on each ray.
    pub segment_ns: u64,
    /// First line, profiles, final line, and the check of focus.
    pub line_ns: u64,
}
