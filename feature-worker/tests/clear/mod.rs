//! What the extraction of clear water says while the ground changes, and of streams that are larger than the region. On drawn pictures.

use super::drawn::{camera, image_config, lay_over, noisy, stream, water};
use super::measure;
use feature_worker::vision::{ExtractError, Extractor, Measurement};
use opencv::core::{self, CV_8UC3, Mat, Scalar, Size};
use opencv::imgproc;
use opencv::prelude::*;
use shared::config::{ImageConfig, LiquidMethod};
use shared::messages::Doubt;

fn clear() -> Result<Extractor, ExtractError> {
    Extractor::new(&camera(), &image_config(LiquidMethod::Clear))
}

/// Whether the picture is not called dry: something is measured, or there is a doubt.
fn is_told(measured: &Measurement) -> bool {
    measured.area_px2 > 0.0 || measured.doubt != Doubt::None
}

/// Clear water before an even wall, on the right part of which lies a shadow.
fn shadowed(share: f32, seed: i32) -> Result<Mat, ExtractError> {
    let mut picture = water(share, None, seed)?;
    lay_over(&mut picture, &[vec![[300.0, 0.0], [640.0, 0.0], [640.0, 245.0], [300.0, 245.0]]], Scalar::all(110.0))?;
    Ok(noisy(&picture, seed)?)
}

/// Protects pours while something is laid behind the container: the new ground is learned, but not the stream with it, so what flows is never
/// "nothing" within the three seconds after which no pour goes on.
#[test]
fn a_stream_is_not_learned_with_new_ground() -> Result<(), ExtractError> {
    let mut extractor = clear()?;
    for i in 0..110 {
        let share = ((i - 5) as f32 / 8.0).clamp(0.0, 1.0);
        let picture = if i < 24 { water(share, None, i)? } else { shadowed(share, i)? };
        let measured = measure(&mut extractor, &picture)?;
        assert!(share < 0.3 || is_told(&measured), "picture {i}: {measured:?}");
    }
    Ok(())
}

/// Protects pours of a stream that grows beyond the region, slowly or fast: it is no dry picture.
#[test]
fn a_stream_larger_than_the_region_is_told() -> Result<(), ExtractError> {
    for grows in [0.15f32, 0.4, 1.0] {
        let mut extractor = clear()?;
        for i in 0..90 {
            let share = ((i - 9) as f32 * grows).clamp(0.0, 4.0);
            let measured = measure(&mut extractor, &water(share, None, i)?)?;
            assert!(share < 0.3 || is_told(&measured), "{grows} picture {i}: {measured:?}");
        }
    }
    Ok(())
}

/// Protects a pour after a camera's exposure took a step: a stream that grew while pictures were blown out is measured in the first picture that is not,
/// and no false line that is nearer to what it was before.
#[test]
fn a_stream_that_grew_while_nothing_was_seen_is_measured() -> Result<(), ExtractError> {
    let mut extractor = clear()?;
    for i in 0..54 {
        let share = if i < 40 { ((i - 19) as f32 / 20.0).clamp(0.0, 0.35) } else { 1.0 };
        let mut picture = water(share, None, i)?;
        if (30..44).contains(&i) {
            let seen = picture.clone();
            seen.convert_to(&mut picture, -1, 1.0, 200.0)?;
        }
        let measured = measure(&mut extractor, &picture)?;
        if i >= 44 {
            assert!((measured.area_px2 / 3600.0 - 1.0).abs() < 0.15, "picture {i}: {measured:?}");
        } else if i >= 30 {
            assert_eq!(measured.doubt, Doubt::BlownOut, "picture {i}");
        }
    }
    Ok(())
}

/// Protects the first pictures of a stream before an even wall: what makes the ground at the lip darker, but shows no edge yet, is no dry picture.
#[test]
fn a_stream_that_begins_without_an_edge_is_told() -> Result<(), ExtractError> {
    for (legs, level) in [(16.0, 190.0), (24.0, 190.0), (40.0, 215.0)] {
        let mut extractor = clear()?;
        let mut shade = Mat::new_rows_cols_with_default(480, 640, CV_8UC3, Scalar::all(255.0))?;
        lay_over(&mut shade, &[stream(legs, 0.9 * legs)], Scalar::all(level))?;
        let mut soft = Mat::default();
        imgproc::gaussian_blur_def(&shade, &mut soft, Size::new(0, 0), 16.0)?;
        for i in 0..24 {
            let mut picture = water(0.0, None, i)?;
            if i >= 12 {
                core::multiply(&picture.clone(), &soft, &mut picture, 1.0 / 255.0, -1)?;
            }
            let measured = measure(&mut extractor, &picture)?;
            // The first ones tell whether the ground is dry.
            assert!(i < 3 || is_told(&measured) == (i >= 12), "{legs} picture {i}: {measured:?}");
        }
    }
    Ok(())
}

/// Protects pours of a stream as smooth as glass, of water that takes little light: that nothing changes is no end. A worker that sees it for longer than
/// any pour lasts may call it ground.
#[test]
fn a_steady_stream_is_no_ground() -> Result<(), ExtractError> {
    let mut extractor = clear()?;
    // The same noise in each picture: nothing changes at all.
    let faint = |share: f32, seed: i32| -> Result<Mat, ExtractError> {
        let mut mixed = Mat::default();
        core::add_weighted(&water(share, None, seed)?, 0.4, &water(0.0, None, seed)?, 0.6, 0.0, &mut mixed, -1)?;
        Ok(mixed)
    };
    let steady = faint(1.0, 77)?;
    for i in 0..90 {
        let picture = if i < 14 { faint(((i - 5) as f32 / 8.0).clamp(0.0, 1.0), i)? } else { noisy(&steady, i % 2)? };
        let measured = measure(&mut extractor, &picture)?;
        assert!(i < 9 || is_told(&measured), "picture {i}: {measured:?}");
    }
    Ok(())
}

/// Protects the ends of pours from a bead that stays at the lip: it is no stream, and the end is told.
#[test]
fn a_bead_at_the_lip_does_not_hide_the_end() -> Result<(), ExtractError> {
    let mut extractor = clear()?;
    for i in 0..60 {
        let share = if i < 30 { ((i - 5) as f32 / 8.0).clamp(0.0, 1.0) } else { ((34 - i) as f32 / 8.0).max(0.14) };
        let measured = measure(&mut extractor, &water(share, None, i)?)?;
        assert!(!(9..32).contains(&i) || is_told(&measured), "picture {i}: {measured:?}");
        assert!(i < 48 || (measured.area_px2, measured.doubt) == (0.0, Doubt::None), "picture {i}: {measured:?}");
    }
    Ok(())
}

/// A rim of water that is darker by `by` levels and `width` px wide, of which the share `gaps` is missing, as what it takes of a picture.
fn faint_rim(by: f64, gaps: f32, width: f32) -> Result<Mat, ExtractError> {
    let mut rim = Mat::new_rows_cols_with_default(480, 640, CV_8UC3, Scalar::all(0.0))?;
    lay_over(&mut rim, &[stream(80.0, 72.0)], Scalar::all(by))?;
    lay_over(&mut rim, &[stream(80.0 - width, 72.0 - width)], Scalar::all(0.0))?;
    // Pieces of the rim, 24 px from one to the next.
    for k in 0..40 {
        let x = 24.0 * k as f32;
        let gap = vec![[x, 0.0], [x + 24.0 * gaps, 0.0], [x + 24.0 * gaps, 479.0], [x, 479.0]];
        lay_over(&mut rim, &[gap], Scalar::all(0.0))?;
    }
    Ok(rim)
}

/// Protects pours of water whose rim hardly differs from an even wall, or has gaps: what is too little for a stream is no zero for three seconds, after which no
/// pour goes on. When it ends, that is told.
#[test]
fn a_faint_rim_with_gaps_is_told() -> Result<(), ExtractError> {
    for (by, gaps, width) in [(10.0, 0.0, 6.0), (14.0, 0.5, 6.0), (14.0, 0.25, 3.0), (20.0, 0.25, 3.0), (20.0, 0.5, 6.0)] {
        let (mut extractor, rim) = (clear()?, faint_rim(by, gaps, width)?);
        for i in 0..125 {
            let (flows, mut picture) = ((20..105).contains(&i), water(0.0, None, i)?);
            if flows {
                core::subtract(&picture.clone(), &rim, &mut picture, &core::no_array(), -1)?;
            }
            let measured = measure(&mut extractor, &picture)?;
            assert!(!flows || is_told(&measured), "{by} {gaps} picture {i}: {measured:?}");
            let surely_dry = (3..20).contains(&i) || i >= 115;
            assert!(!surely_dry || !is_told(&measured), "{by} {gaps} picture {i}: {measured:?}");
        }
    }
    Ok(())
}

/// Protects the operator from a region in which no outline of clear water fits: every picture would be dry.
#[test]
fn a_region_without_room_for_an_outline_is_refused() {
    let image = ImageConfig { region_px: [205, 238, 40, 40], ..image_config(LiquidMethod::Clear) };
    let said = Extractor::new(&camera(), &image).err().expect("refused").to_string();
    assert!(said.contains("image.region_px") && said.contains("room"), "{said}");
}
