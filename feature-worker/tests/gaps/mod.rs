//! What the extraction says at its start, after pauses, and at other rates than 30 Hz. On drawn pictures.

use super::drawn::{blue, camera, dry, image_config, noisy, stream, water};
use super::{colour, measure};
use feature_worker::vision::{ExtractError, Extractor, Image, Measurement, PictureTime};
use opencv::core::{self, Mat};
use opencv::prelude::*;
use shared::config::LiquidMethod;
use shared::messages::{Doubt, PixelFormat};

fn clear() -> Result<Extractor, ExtractError> {
    Extractor::new(&camera(), &image_config(LiquidMethod::Clear))
}

/// Whether the picture is not called dry: something is measured, or there is a doubt.
fn is_told(measured: &Measurement) -> bool {
    measured.area_px2 > 0.0 || measured.doubt != Doubt::None
}

fn measure_at(extractor: &mut Extractor, picture: &Mat, sequence: u64, at_s: f64) -> Result<Measurement, ExtractError> {
    let image = Image { width_px: 640, height_px: 480, format: PixelFormat::Bgr8, pixels: picture.data_bytes()? };
    extractor.measure_at(image, PictureTime { sequence, captured_at_ns: (at_s * 1e9) as u64 })
}

/// Protects a worker that starts while clear water flows: before an even wall and before a pattern at rest or in motion, the stream is not ground
/// that was seen dry. A dry lip is told within half a second.
#[test]
fn clear_water_in_the_first_picture_is_no_dry_ground() -> Result<(), ExtractError> {
    for turn_deg in [None, Some(0.0f32), Some(0.6)] {
        for flows in [true, false] {
            let mut extractor = clear()?;
            for i in 0..20 {
                let share = if flows { 0.9 + 0.1 * (i as f32 * 1.7).sin() } else { 0.0 };
                let measured = measure(&mut extractor, &water(share, turn_deg.map(|turn| 11.0 + turn * i as f32), i)?)?;
                assert!(!flows || is_told(&measured), "{turn_deg:?} picture {i}: {measured:?}");
                let told = (measured.area_px2, measured.doubt) == (0.0, Doubt::None);
                assert!(
                    flows || told == (i >= if turn_deg == Some(0.0) { 15 } else { 8 }) || (3..15).contains(&i),
                    "{turn_deg:?} picture {i}: {measured:?}"
                );
            }
        }
    }
    Ok(())
}

/// Protects what follows a pause in which the wrist turned and clear water began to flow: the ground that was seen before is not compared with
/// other places, so the stream is never "nothing". The board turns to the side on which it does not end.
#[test]
fn clear_water_after_a_pause_is_told() -> Result<(), ExtractError> {
    for turned_deg in [6.0f32, 9.0, 14.0] {
        let mut extractor = clear()?;
        for i in 0..80 {
            let (share, pause_s, turn) = if i < 40 { (0.0, 0.0, 0.0) } else { (0.9 + 0.1 * (i as f32 * 1.7).sin(), 0.7, turned_deg) };
            let picture = water(share, Some(-11.0 - turn - 0.4 * i as f32), i)?;
            let measured = measure_at(&mut extractor, &picture, i as u64 + 1, f64::from(i) / 30.0 + pause_s)?;
            assert!(i < 40 || is_told(&measured), "{turned_deg} picture {i}: {measured:?}");
        }
    }
    Ok(())
}

/// Protects what follows a pause before a pattern: it is learned anew. A stream at rest that began meanwhile is not ground at once, and dry ground is
/// told soon, although it lies elsewhere in the picture.
#[test]
fn a_pattern_is_learned_anew_after_a_pause() -> Result<(), ExtractError> {
    for share in [0.9, 0.0] {
        let mut extractor = clear()?;
        for i in 0..54 {
            let (share, pause_s, turn) = if i < 40 { (0.0, 0.0, 0.4 * i as f32) } else { (share, 0.7, 30.0) };
            let turn = if share > 0.0 { turn } else { turn + 0.6 * (i - 40).max(0) as f32 };
            let picture = water(share, Some(-11.0 - turn), i)?;
            let measured = measure_at(&mut extractor, &picture, i as u64 + 1, f64::from(i) / 30.0 + pause_s)?;
            assert!(i < 40 || share == 0.0 || is_told(&measured), "picture {i}: {measured:?}");
            assert!(i < 50 || share > 0.0 || !is_told(&measured), "dry picture {i}: {measured:?}");
        }
    }
    Ok(())
}

/// Protects pours whose whole ground changes its light just before they begin: the stream is not learned as ground with it.
#[test]
fn a_stream_that_begins_in_another_picture_is_told() -> Result<(), ExtractError> {
    for turn_deg in [None, Some(11.0f32)] {
        let mut extractor = clear()?;
        for i in 0..90 {
            let share = if i < 40 { 0.0 } else { ((i - 39) as f32 / 8.0).min(0.9 + 0.1 * (i as f32 * 1.7).sin()) };
            let mut picture = water(share, if i < 38 { turn_deg } else { turn_deg.map_or(Some(20.0), |_| None) }, i)?;
            if i >= 38 {
                picture = noisy(&picture, i)?;
            }
            let measured = measure(&mut extractor, &picture)?;
            assert!(share < 0.3 || is_told(&measured), "{turn_deg:?} picture {i}: {measured:?}");
        }
    }
    Ok(())
}

/// Protects the estimate from a stream that is lost, whatever the camera's rate is: dry ground has to be seen for as long as at 30 Hz before a large
/// stream is gone, no shorter and no longer.
#[test]
fn a_stream_is_gone_after_the_same_time_at_any_rate() -> Result<(), ExtractError> {
    let mut told_s = Vec::new();
    for rate_hz in [15.0, 30.0, 60.0] {
        let mut extractor = colour()?;
        let mut gone_s = None;
        for i in 0..(2.0 * rate_hz) as i32 {
            let at_s = f64::from(i) / rate_hz;
            let picture = if (1.0..1.2).contains(&at_s) {
                blue(&[stream(140.0, 120.0)], 0).and_then(|p| noisy(&p, i))?
            } else {
                noisy(&dry(0.0, 0)?, i)?
            };
            let measured = measure_at(&mut extractor, &picture, i as u64 + 1, at_s)?;
            if at_s >= 1.2 && !is_told(&measured) {
                gone_s = gone_s.or(Some(at_s - 1.2));
            }
        }
        told_s.push(gone_s.unwrap_or(f64::MAX));
    }
    let [slow, usual, fast] = told_s[..] else { return Ok(()) };
    assert!((slow - usual).abs() <= 1.0 / 15.0 + 1e-6 && (fast - usual).abs() <= 1.0 / 30.0 + 1e-6, "{told_s:?}");
    assert!(usual > 0.2 && usual < 0.35, "{told_s:?}");
    Ok(())
}

/// Protects the end of a stream from dry pictures that were seen before a pause: they do not add to those after it.
#[test]
fn dry_pictures_before_a_pause_do_not_vouch() -> Result<(), ExtractError> {
    let mut extractor = colour()?;
    for i in 0..40 {
        let picture = if (14..18).contains(&i) { blue(&[stream(140.0, 120.0)], 0)? } else { dry(0.0, 0)? };
        let at_s = f64::from(i) / 30.0 + if i >= 24 { 0.5 } else { 0.0 };
        let measured = measure_at(&mut extractor, &noisy(&picture, i)?, i as u64 + 1, at_s)?;
        assert!(!(18..31).contains(&i) || is_told(&measured), "picture {i}: {measured:?}");
        assert!(i < 34 || !is_told(&measured), "picture {i}: {measured:?}");
    }
    core::set_rng_seed(0)?;
    Ok(())
}

/// Protects the controller from a camera that has stopped while its driver goes on to hand out the buffers in turn: pictures that come again are frozen,
/// however many there are of them, and so is no dry ground. A new picture ends it, and one that comes again alone is no reason.
#[test]
fn buffers_that_come_round_are_frozen() -> Result<(), ExtractError> {
    for buffers in 1..=8 {
        let mut extractor = colour()?;
        let mut doubts = Vec::new();
        for i in 0..32 {
            let number = if i < 10 { i } else { 10 - buffers + (i - 10) % buffers };
            doubts.push(measure(&mut extractor, &blue(&[], number)?)?.doubt);
        }
        assert!(doubts[..10].iter().all(|doubt| *doubt != Doubt::Frozen), "{buffers}: {doubts:?}");
        assert!(doubts[12..].iter().all(|doubt| *doubt == Doubt::Frozen), "{buffers}: {doubts:?}");
        assert_ne!(measure(&mut extractor, &blue(&[], 100)?)?.doubt, Doubt::Frozen);
        assert_ne!(measure(&mut extractor, &blue(&[], 9)?)?.doubt, Doubt::Frozen);
    }
    Ok(())
}
