//! Where the full picture's profiles across the line of clear water meet its edge: against the remembered ground, or without it.
//!
//! Pure; called on the extraction thread. Nothing is allocated and nothing fails.

use super::rays::Colour;
use crate::vision::liquid::{PROFILE_SAMPLES, Profile, ProfileEdge, REACH};

// "Tuned" below means that the value was tuned on seeds 101 to 104 of `evaluate-camera`; see docs/VISION.md.

/// Water differs from the dry background by at least this much, in units of the small picture's noise. Tuned.
const WET_NOISES: f32 = 5.0;
/// Water differs from the dry background by at least this much, grey levels. Tuned.
const WET_LEAST: f32 = 6.0;
/// Weight of an edge point in front of ground that is as bright as the water's rim. Tuned.
const HIDDEN_TRUST: f32 = 0.3;
/// A step this high, as a share of the steepest step of a profile, is steep. Tuned.
const STEEP_SHARE: f32 = 0.6;
/// Least height of a profile's steepest step, grey levels a sample. Tuned.
const STEEP_LEAST: f32 = 4.0;

/// The least difference from the ground that is water, grey levels; `noise` is the small picture's.
pub(super) fn least_difference(noise: f32) -> f32 {
    (WET_NOISES * noise).max(WET_LEAST)
}

/// The edge on a profile in front of known ground: the outermost place that differs from the dry background, where half of the
/// difference is reached. `differs` is the difference from the background at each sample and `noise` the small picture's, grey levels; `rim` is the
/// colour of the stream's outline, if one was seen.
pub(super) fn on_known_ground(
    profile: &Profile,
    differs: &[[f32; 3]; PROFILE_SAMPLES],
    noise: f32,
    rim: Option<Colour>,
) -> Option<ProfileEdge> {
    let size = |d: &[f32; 3]| (d.iter().map(|v| v * v).sum::<f32>() / 3.0).sqrt();
    let least = least_difference(noise);
    let sizes = differs.each_ref().map(size);
    let j = (1..2 * REACH).rev().find(|&j| sizes[j] >= least && sizes[j - 1] >= least)?;
    let full = (j.saturating_sub(4)..=j).max_by(|a, b| sizes[*a].total_cmp(&sizes[*b]))?;
    let (full, height) = (differs[full], sizes[full]);
    let share = |d: &[f32; 3]| d.iter().zip(full).map(|(a, b)| a * b).sum::<f32>() / (3.0 * height * height);
    let i = (0..2 * REACH).rev().find(|&i| share(&differs[i]) >= 0.5)?;
    let (inner, outer) = (share(&differs[i]), share(&differs[i + 1]));
    // Ground as bright as the water's rim hides where it begins.
    let dry: [f32; 3] = std::array::from_fn(|c| profile.colours[i + 1][c] - differs[i + 1][c]);
    let hidden = rim.is_some_and(|rim| size(&std::array::from_fn(|c| dry[c] - rim[c])) < 2.0 * least);
    (outer < 0.5).then(|| ProfileEdge {
        sample: i as f32 + (inner - 0.5) / (inner - outer),
        contrast: height,
        trust: if hidden { HIDDEN_TRUST } else { 1.0 },
        width_samples: None,
    })
}

/// The edge on a profile in front of ground that is not known: the outermost of the steep steps of brightness.
pub(super) fn on_unknown_ground(profile: &Profile) -> Option<ProfileEdge> {
    let grey = |j: usize| profile.colours[j].iter().sum::<f32>() / 3.0;
    let step = |j: usize| (grey(j + 1) - grey(j)).abs();
    let steepest = (0..2 * REACH).map(step).fold(0.0, f32::max);
    let j = (1..2 * REACH - 1).rev().find(|&j| step(j) >= STEEP_SHARE * steepest && step(j) >= step(j - 1) && step(j) >= step(j + 1))?;
    if steepest < STEEP_LEAST {
        return None;
    }
    // The top of the parabola through the three steps.
    let (left, middle, right) = (step(j - 1), step(j), step(j + 1));
    let curvature = left - 2.0 * middle + right;
    let shift = if curvature < -1e-3 { (0.5 * (left - right) / curvature).clamp(-0.5, 0.5) } else { 0.0 };
    let contrast = (grey((j + 3).min(2 * REACH)) - grey(j.saturating_sub(2))).abs().max(steepest);
    Some(ProfileEdge { sample: j as f32 + 0.5 + shift, contrast, trust: 1.0, width_samples: None })
}
