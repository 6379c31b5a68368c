//! What the extraction says of a liquid that the camera shows in other levels than those that were learned, so that it looks like dark ground. On drawn
//! pictures.

use opencv::core::{CV_8UC3, Mat, Rect, Scalar};
use opencv::imgproc;
use opencv::prelude::*;

use super::super::drawn::{HEIGHT, WIDTH, camera, glass, image_config, lay_over, noisy, stream};
use super::super::measure;
use feature_worker::vision::{ExtractError, Extractor};
use shared::config::{ImageConfig, LiquidMethod};
use shared::messages::Doubt;

/// A liquid as dark as cola, and the joints between the boards.
const COLA: Scalar = Scalar::new(12.0, 20.0, 40.0, 0.0);
const JOINT: Scalar = Scalar::new(12.0, 23.0, 40.0, 0.0);

/// Between the left ends of the joints, px.
const JOINTS_EVERY: i32 = 60;

/// Where the first joint lies, px; the background moves by 1 px a picture.
fn first_joint(picture: i32) -> i32 {
    (10 + picture) % JOINTS_EVERY
}

/// Boards with dark joints, and liquid over the lip if it `flows`, in a `limited` range or in the full one.
fn boards(flows: bool, limited: bool, seed: i32) -> Result<Mat, ExtractError> {
    let mut picture = Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_8UC3, Scalar::new(70.0, 95.0, 120.0, 0.0))?;
    for x in (first_joint(seed)..WIDTH).step_by(JOINTS_EVERY as usize) {
        imgproc::rectangle(&mut picture, Rect::new(x, 0, 9, HEIGHT), JOINT, imgproc::FILLED, 8, 0)?;
    }
    if flows {
        lay_over(&mut picture, &[stream(60.0, 50.0)], COLA)?;
    }
    glass(&mut picture)?;
    let mut picture = noisy(&picture, seed)?;
    if limited {
        picture.data_bytes_mut()?.iter_mut().for_each(|level| *level = (16.0 + f32::from(*level) * 219.0 / 255.0) as u8);
    }
    Ok(picture)
}

/// Protects pours of a dark liquid through a camera that was calibrated in the full range and runs in a limited one: the liquid then looks like dark
/// joints of the ground, and is not "nothing". Boards and joints beside the lip are dry; a joint at the lip may be a stream. The liquid in its own colours is
/// measured.
#[test]
fn a_dark_liquid_in_a_limited_range_is_named() -> Result<(), ExtractError> {
    let image = ImageConfig { region_px: [171, 14, 440, 296], colour_hsv: [2, 120, 12, 10, 255, 90], ..image_config(LiquidMethod::Colour) };
    for limited in [false, true] {
        let mut extractor = Extractor::new(&camera(), &image)?;
        for i in 0..75 {
            let measured = measure(&mut extractor, &boards(i >= 45, limited, i)?)?;
            // The lip is at 215 px, and a joint 9 px wide.
            let at_lip = (215 - 9 - 12..=215 + 12).any(|x| x % JOINTS_EVERY == first_joint(i));
            match (i, limited) {
                (0..45, _) if at_lip => assert_eq!(measured.area_px2, 0.0, "picture {i}"),
                (0..45, _) => assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::None), "dry picture {i}, limited: {limited}"),
                (_, false) => assert!((1300.0..1700.0).contains(&measured.area_px2), "picture {i}: {measured:?}"),
                (_, true) => assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::ColoursChanged), "picture {i}: {measured:?}"),
            }
        }
    }
    Ok(())
}

/// Protects pours of a liquid that the camera shows black, as one does whose exposure becomes short: that something black was seen elsewhere makes no ground
/// of it, neither where it flows black from the start nor where it becomes so. The black thing itself is no doubt while it is not at the lip.
#[test]
fn a_stream_that_becomes_black_is_named() -> Result<(), ExtractError> {
    let image = ImageConfig { region_px: [171, 14, 440, 296], ..image_config(LiquidMethod::Colour) };
    for (thing, black_from) in [(true, 45), (true, 60), (false, 45), (false, 60)] {
        let mut extractor = Extractor::new(&camera(), &image)?;
        for i in 0..90 {
            let mut picture = Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_8UC3, Scalar::all(165.0))?;
            if thing {
                imgproc::rectangle(&mut picture, Rect::new(430, 40, 70, 50), Scalar::all(3.0), imgproc::FILLED, 8, 0)?;
            }
            if i >= 45 {
                let colour = if i >= black_from { Scalar::new(8.0, 4.0, 2.0, 0.0) } else { Scalar::new(150.0, 62.0, 20.0, 0.0) };
                lay_over(&mut picture, &[stream(60.0, 50.0)], colour)?;
            }
            glass(&mut picture)?;
            let measured = measure(&mut extractor, &noisy(&picture, i)?)?;
            let what = format!("thing: {thing}, black from {black_from}, picture {i}: {measured:?}");
            match i {
                0..45 => assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::None), "{what}"),
                _ if i < black_from => assert!((1300.0..1700.0).contains(&measured.area_px2), "{what}"),
                _ => assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::ColoursChanged), "{what}"),
            }
        }
    }
    Ok(())
}
