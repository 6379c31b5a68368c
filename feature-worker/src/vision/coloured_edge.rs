//! Where the edge of a coloured liquid lies on a profile across it.
//!
//! Pure; called on the extraction thread. Nothing is allocated and nothing fails.

use super::liquid::{PROFILE_SAMPLES, Profile, ProfileEdge, REACH};

/// Samples at either end of a profile that tell liquid and background. Chosen by hand; no measurement is recorded.
const FLANK: usize = 3;
/// Least difference of liquid and background at the ends of a profile: the root of the sum of the squares of the three parts, grey
/// levels. Tuned on seeds 1 and
/// 5001 to 5003 of `evaluate-camera`; see docs/VISION.md.
const DIFFERENCE_LEAST: f32 = 12.0;

/// The edge is where the profile, projected on the difference between its two ends, passes one half.
pub(super) fn edge_on(profile: &Profile) -> Option<ProfileEdge> {
    let mean = |range: &[[f32; 3]]| -> [f32; 3] { std::array::from_fn(|c| range.iter().map(|v| v[c]).sum::<f32>() / range.len() as f32) };
    let inside = mean(&profile.colours[..FLANK]);
    let outside = mean(&profile.colours[PROFILE_SAMPLES - FLANK..]);
    let difference: [f32; 3] = std::array::from_fn(|c| inside[c] - outside[c]);
    let square: f32 = difference.iter().map(|v| v * v).sum();
    if square < DIFFERENCE_LEAST * DIFFERENCE_LEAST {
        return None;
    }
    // 1 in the liquid, 0 in the background.
    let scale: [f32; 3] = difference.map(|v| v / square);
    let levels = profile.colours.map(|p| (0..3).map(|c| (p[c] - outside[c]) * scale[c]).sum::<f32>());
    // The falling crossing nearest to the profile's centre.
    let crossing = |height: f32| {
        levels
            .windows(2)
            .enumerate()
            .filter(|(_, w)| w[0] >= height && w[1] < height)
            .map(|(j, w)| j as f32 + (w[0] - height) / (w[0] - w[1]))
            .min_by(|p, q| (p - REACH as f32).abs().total_cmp(&(q - REACH as f32).abs()))
    };
    let sample = crossing(0.5)?;
    let width_samples = crossing(0.8).zip(crossing(0.2)).map(|(high, low)| (low - high).abs());
    Some(ProfileEdge { sample, contrast: square.sqrt(), trust: 1.0, width_samples })
}
