//! What calibration must see in a clip before it believes in what it found there, and why it refuses.
//!
//! Runs on the command's thread and allocates. A clip of something else (a bottle that a hand holds, a still life, a dry glass) has corners,
//! edges and colours too. Each check asks for what only a pour before a camera that is fixed to the container can show: edges that stay
//! while the background moves, dry background outside of the learned colours, and a stream whose edge fits the axes and that ends.

use opencv::core::Mat;
use shared::config::{CameraConfig, ImageConfig, LiquidMethod};
use shared::messages::Doubt;

use super::pour::{Pour, same};
use crate::vision::{AxesError, Corner, DryBackground, Extractor, InGlass, Steadiness};

// "By hand" below means that the value was chosen by hand between what 20 rendered pours gave and what clips of other things gave; see
// docs/VISION.md.

/// Fewer frames are no pour. By hand: a third of a second.
const FRAMES_LEAST: u64 = 10;
/// In at least this share of the poses the axes must be where they are in the mean. By hand.
const STAYS_LEAST: f32 = 0.6;
/// Edges of the background that stand still: at most this length, px of a picture 640 px wide, by hand: more than a gripper's outline...
const STILL_PX_MOST: f32 = 900.0;
/// ... unless they are less than this share of its edges. By hand.
const STILL_SHARE_MOST: f32 = 0.5;
/// Of any two poses no more than this share of the background's edges may lie on one another, beyond chance. By hand: pours gave up to 0.05, cameras at rest
/// before which an arm moved 0.44 and more; the edges of a gripper, which may be half of all, would give 0.4.
const PAIRS_MOST: f32 = 0.4;
/// Fewer poses show no background that moves. By hand.
const POSES_LEAST: usize = 4;
/// Largest share of the dry background inside the learned colours. By hand: the extraction's targets hold up to about this.
const BACKGROUND_MOST: f32 = 0.02;
/// At least this share of the pictures must be dry in the learned colours. By hand: the start or the end of a pour.
const DRY_LEAST: f32 = 0.05;
/// Least share of frames with a stream. By hand: half a second of a quarter of a minute.
const FLOWING_LEAST: f32 = 0.03;
/// Least share of the frames with liquid at the lip in which the triangle fits. By hand.
const FITS_LEAST: f32 = 0.5;
/// Where the liquid's colours fill less of the glass below the lip while something flows, what flows may be none. By hand: as at run time.
const GLASS_LEAST: f32 = 0.2;
/// Least mean length of a run of frames with a stream. By hand: a stream does not flicker; pours gave 26 frames and more, false streams
/// before clutter 4.
const RUN_LEAST: f32 = 8.0;

/// A share as percent.
fn percent(share: f32) -> String {
    if share > 0.0 && share < 0.01 { format!("{:.2} %", 100.0 * share) } else { format!("{:.0} %", 100.0 * share) }
}

/// Refuses what is no moving picture.
pub(super) fn moves(pour: &Pour) -> Result<(), String> {
    if pour.count < FRAMES_LEAST {
        return Err(format!("too few pictures ({}) to tell the container from what stands still; show one whole pour", pour.count));
    }
    if pour.pictures.windows(2).all(|w| same(&w[0], &w[1])) {
        return Err("all pictures are the same still picture; show one whole pour".into());
    }
    Ok(())
}

/// Refuses axes that do not stay while the background moves, and a background that stands still while something else moves. Returns a
/// remark where an axis is too faint to tell. Of axes that nobody gave, one at least has to be seen to stay.
pub(super) fn axes_stay(corner: &Corner, given: bool, poses: &[&Mat], mean: &Mat) -> Result<Option<String>, String> {
    let steady = Steadiness::judge(corner, poses, mean).map_err(|e| e.message)?;
    if !given && steady.top_edge.is_none() && steady.left_side.is_none() {
        return Err(AxesError::NoCorner.to_string());
    }
    let share = |stays: Option<f32>| stays.map_or("cannot be told".into(), percent);
    let line = format!("top edge {}, left side {}", share(steady.top_edge), share(steady.left_side));
    if [steady.top_edge, steady.left_side].iter().flatten().any(|stays| *stays < STAYS_LEAST) {
        return Err(format!(
            "the axes do not stay where they are (pictures in which they do: {line}): the camera must be fixed to the container; if it is, \
             correct them with --lip, --x-axis and --y-axis, or with --page"
        ));
    }
    // An even wall has no edges, and gives no poses.
    if poses.len() < POSES_LEAST && steady.edges_px > STILL_PX_MOST {
        return Err(
            "the background does not move: the camera must be fixed to the container, so that the background turns while it pours; \
                    tilt it with the robot"
                .into(),
        );
    }
    let still_share = steady.still_px / steady.edges_px.max(1.0);
    let stands_still = steady.still_px > STILL_PX_MOST && still_share > STILL_SHARE_MOST;
    let is_passed = steady.pairs * steady.edges_px > STILL_PX_MOST && steady.pairs > PAIRS_MOST;
    if stands_still || is_passed {
        return Err(format!(
            "the background stands still ({} of its edges): the camera must be fixed to the container, so that the background turns while it \
             pours; tilt it with the robot",
            percent(still_share.max(steady.pairs))
        ));
    }
    let faint = steady.top_edge.is_none() || steady.left_side.is_none();
    Ok(faint.then(|| format!("an axis is too faint to tell whether it stays ({line}); look at the picture")))
}

/// Refuses colours that the dry background has too. Returns what is said of them.
pub(super) fn background_differs(dry: DryBackground) -> Result<String, String> {
    let inside = percent(dry.inside);
    if dry.dry_pictures < DRY_LEAST {
        return Err(format!(
            "the learned colours are at the lip in nearly all pictures ({} are without): the liquid looks like the background, or the glass is \
             never dry; show one whole pour, change the background, or colour the liquid",
            percent(dry.dry_pictures)
        ));
    }
    if dry.inside > BACKGROUND_MOST {
        return Err(format!(
            "{inside} of the dry background lies inside the learned colours or close to them (at most {}): change the background, colour the liquid, or use \
             --method clear for water",
            percent(BACKGROUND_MOST)
        ));
    }
    Ok(format!("{inside} of the dry background lies inside the learned colours or close to them"))
}

/// What was measured in all frames of a pour.
#[derive(Default)]
struct Flow {
    frames: u32,
    flowing: u32,
    dry: u32,
    /// Frames with liquid at the lip in which no edge fits.
    unfit: u32,
    /// Frames of which nothing is known for another reason.
    untold: u32,
    /// Unbroken runs of frames with a stream.
    runs: u32,
    /// Whether the last frame had a stream.
    flows: bool,
    /// The sum of the shares of the glass below the lip that had the liquid's colours in frames with a stream, and of how many frames it is.
    glass: (f32, u32),
}

/// Refuses a clip in which nothing flows over the lip between the axes, or nothing is ever dry. Returns what was seen, and a remark where the
/// glass does not hold what flows.
pub(super) fn something_flows(pour: &Pour, camera: &CameraConfig, image: &ImageConfig) -> Result<Vec<String>, String> {
    let extractor = Extractor::new(camera, image).map_err(|e| e.to_string())?;
    let mut glass = InGlass::of_pictures(camera, image).map_err(|e| e.message)?;
    let mut flow = Flow::default();
    pour.measure(camera, extractor, |measured, picture| {
        let flows = measured.area_px2 > 0.0;
        flow.frames += 1;
        flow.flowing += u32::from(flows);
        let unfit = matches!(measured.doubt, Doubt::EdgeNotFound | Doubt::LeavesRegion);
        flow.unfit += u32::from(!flows && unfit);
        // A frame that is a little too sharp or soft for the run time is dry all the same, and so is one of a grey card, which has lost its last colour in a
        // compressed clip.
        let dry = !flows && matches!(measured.doubt, Doubt::None | Doubt::Blurred | Doubt::ColoursChanged);
        flow.dry += u32::from(dry);
        flow.untold += u32::from(!flows && !unfit && !dry);
        flow.runs += u32::from(flows && !flow.flows);
        flow.flows = flows;
        if flows && image.method == LiquidMethod::Colour {
            flow.glass = glass.share(picture)?.map_or(flow.glass, |share| (flow.glass.0 + share, flow.glass.1 + 1));
        }
        Ok(())
    })?;
    let Flow { frames, flowing, dry, unfit, untold, runs, .. } = flow;
    let share = |part: u32, of: u32| part as f32 / of.max(1) as f32;
    let mut seen =
        format!("{flowing} of {frames} frames show a stream whose edge fits the axes, {dry} are dry, and in {unfit} no edge fits");
    if untold > 0 {
        seen += &format!("; {untold} cannot be told (too dark or bright, frozen, not whole, or in light that flickers)");
    }
    let advice = match image.method {
        LiquidMethod::Colour => "show one whole pour, check the axes, or use --method clear for water",
        LiquidMethod::Clear => "show one whole pour over this lip, before an even card, and check the axes",
    };
    let fault = if share(flowing, frames) < FLOWING_LEAST {
        "nothing flows over the lip"
    } else if share(flowing, flowing + unfit) < FITS_LEAST {
        "the liquid's edge does not fit the axes"
    } else if (flowing as f32) < RUN_LEAST * runs as f32 {
        "the stream comes and goes, as no stream does"
    } else if share(dry, frames) < DRY_LEAST {
        "the container is never dry"
    } else {
        let (shares, looked) = flow.glass;
        let filled = shares / looked.max(1) as f32;
        // A container of metal or clay shows nothing, so this cannot refuse.
        let strange = (looked > 0 && filled < GLASS_LEAST).then(|| {
            format!(
                "the liquid's colours fill {} of the glass below the lip while something flows; if the container is clear, what flows is not the \
                 liquid: look at the picture",
                percent(filled)
            )
        });
        return Ok([seen].into_iter().chain(strange).collect());
    };
    Err(format!("{fault}: {seen}; {advice}"))
}

#[cfg(test)]
mod tests {
    use opencv::core::{CV_8UC3, Scalar};

    use super::*;

    /// Protects from axes on things that show no edge there, as on plates: what was found and cannot be judged on either side was not found. Who gives axes
    /// by hand knows them, and is told that they cannot be judged.
    #[test]
    fn axes_that_cannot_be_judged_are_taken_from_people_alone() {
        let even = Mat::new_rows_cols_with_default(480, 640, CV_8UC3, Scalar::all(120.0)).expect("made");
        let corner = Corner { lip: [220.0, 240.0], rim: [560.0, 240.0], foot: [220.0, 440.0] };
        let poses = [&even; POSES_LEAST];
        assert!(axes_stay(&corner, true, &poses, &even).is_ok_and(|remark| remark.is_some_and(|r| r.contains("too faint"))));
        assert_eq!(axes_stay(&corner, false, &poses, &even), Err(AxesError::NoCorner.to_string()));
    }
}
