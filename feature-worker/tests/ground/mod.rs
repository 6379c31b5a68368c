//! What the extraction of a coloured liquid says where half of the picture is white, on drawn pictures.

use super::drawn::{camera, dry, image_config, lay_over, noisy, stream};
use super::{colour, measure};
use feature_worker::vision::{ExtractError, Extractor};
use opencv::core::{Mat, Rect, Scalar};
use opencv::imgproc;
use shared::config::{ImageConfig, LiquidMethod};
use shared::messages::Doubt;

/// A picture of which the rays see more than half in white, and the region holds less than 60 % of it; with a stream of this colour.
fn half_white(seed: i32, liquid: Option<Scalar>) -> Result<Mat, ExtractError> {
    let mut picture = dry(0.0, seed)?;
    let wall = vec![[216.0, 14.0], [500.0, 14.0], [500.0, 232.0], [216.0, 232.0]];
    lay_over(&mut picture, &[wall], Scalar::all(255.0))?;
    if let Some(liquid) = liquid {
        lay_over(&mut picture, &[stream(40.0, 36.0)], liquid)?;
    }
    Ok(picture)
}

/// Protects pours before a ground that is half white from the start, always or now and then: a stream in other colours is never "nothing", and
/// one in the liquid's own is measured.
#[test]
fn half_white_from_the_start_is_no_dry_picture() -> Result<(), ExtractError> {
    let (own, other) = (Scalar::new(150.0, 62.0, 20.0, 0.0), Scalar::new(60.0, 180.0, 60.0, 0.0));
    let mut extractor = colour()?;
    for i in 0..60 {
        let measured = measure(&mut extractor, &half_white(i, (i >= 30).then_some(other))?)?;
        assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::BlownOut), "picture {i}");
    }
    let measured = measure(&mut extractor, &half_white(60, Some(own))?)?;
    assert!(measured.area_px2 > 600.0 && measured.area_px2 < 850.0, "{measured:?}");
    let mut extractor = colour()?;
    for i in 0..60 {
        if i % 8 == 0 {
            measure(&mut extractor, &half_white(i, None)?)?;
            continue;
        }
        let mut picture = dry(0.0, i)?;
        if i >= 40 {
            lay_over(&mut picture, &[stream(40.0, 36.0)], other)?;
        }
        let measured = measure(&mut extractor, &picture)?;
        assert_eq!(measured.area_px2, 0.0, "picture {i}");
        if i >= 40 {
            assert_ne!(measured.doubt, Doubt::None, "picture {i}");
        }
    }
    Ok(())
}

/// Protects the pictures after a time in which half of them was white, or something lay at the lip: the ground is not forgotten meanwhile, so
/// no doubt stays.
#[test]
fn the_ground_outlasts_what_hides_it() -> Result<(), ExtractError> {
    // As calibration writes it, with room below the lip and beside the container.
    let image = ImageConfig { region_px: [171, 14, 440, 296], ..image_config(LiquidMethod::Colour) };
    // Patches of many colours, so that none of them goes on beside the container.
    let mut patches = dry(0.0, 0)?;
    for k in 0..42i32 {
        let (x, y) = (150 + 45 * (k % 7), 20 + 39 * (k / 7));
        let level = |step: i32| f64::from(40 + (k * step + k / 7 * 50) % 150);
        let colour = Scalar::new(level(31) * 0.4, level(47), level(67), 0.0);
        imgproc::rectangle(&mut patches, Rect::new(x, y, 45, 39), colour, imgproc::FILLED, 8, 0)?;
    }
    let mut body = patches.clone();
    imgproc::rectangle(&mut body, Rect::new(216, 200, 44, 49), Scalar::new(200.0, 30.0, 200.0, 0.0), imgproc::FILLED, 8, 0)?;
    for white in [true, false] {
        let mut extractor = Extractor::new(&camera(), &image)?;
        let clear: Vec<Mat> = (0..45).map(|i| noisy(&patches, i)).collect::<Result<_, _>>()?;
        for (i, picture) in clear.iter().enumerate() {
            let measured = measure(&mut extractor, picture)?;
            assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::None), "{white} picture {i}");
        }
        // More than the half minute in which what is not seen would be forgotten.
        let pictures: Vec<Mat> =
            (0..6).map(|i| if white { half_white(i, None) } else { Ok(noisy(&body, i)?) }).collect::<Result<_, ExtractError>>()?;
        for i in 0..1100 {
            let measured = measure(&mut extractor, &pictures[i % 6])?;
            let wanted = if white { Doubt::None } else { Doubt::ColoursChanged };
            assert_eq!((measured.area_px2, measured.doubt), (0.0, wanted), "{white} picture {i} that hides the ground");
        }
        for (i, picture) in clear.iter().enumerate() {
            let measured = measure(&mut extractor, picture)?;
            if i >= 12 {
                assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::None), "{white} picture {i} after it");
            }
        }
    }
    Ok(())
}
