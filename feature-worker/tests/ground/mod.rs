//! What the extraction of a coloured liquid says of ground: half white, never known, seen through a thin stream, and in front of a stream. On drawn
//! pictures.

mod levels;

use super::drawn::{HEIGHT, WIDTH, blue, camera, dry, glass, image_config, lay_over, noisy, stream};
use super::{colour, measure};
use feature_worker::vision::{ExtractError, Extractor, Measurement};
use opencv::core::{self, CV_8UC3, Mat, Rect, Scalar};
use opencv::imgproc;
use opencv::prelude::*;
use shared::config::{ImageConfig, LiquidMethod};
use shared::messages::Doubt;

/// Whether the picture is not called dry: something is measured, or there is a doubt.
fn is_told(measured: &Measurement) -> bool {
    measured.area_px2 > 0.0 || measured.doubt != Doubt::None
}

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

/// Protects pours before a wall in the liquid's colours that ends beside the container: the sliver that is seen of it along the side is no stream's triangle,
/// and no dry ground either.
#[test]
fn a_sliver_along_the_container_is_no_stream() -> Result<(), ExtractError> {
    let mut extractor = colour()?;
    for i in 0..30 {
        let measured = measure(&mut extractor, &dry(0.0, i)?)?;
        assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::None), "picture {i}");
    }
    for i in 30..60 {
        let measured = measure(&mut extractor, &blue(&[stream(20.0, 200.0)], i)?)?;
        assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::EdgeNotFound), "picture {i}: {measured:?}");
    }
    Ok(())
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
        // What only the lip shows counts as ground after half a minute.
        for (i, picture) in clear.iter().cycle().take(990).enumerate() {
            let measured = measure(&mut extractor, picture)?;
            assert!(i < 945 || (measured.area_px2, measured.doubt) == (0.0, Doubt::None), "{white} picture {i}: {measured:?}");
        }
        // More than the half minute in which what is not seen would be forgotten.
        let pictures: Vec<Mat> =
            (0..12).map(|i| if white { half_white(i, None) } else { Ok(noisy(&body, i)?) }).collect::<Result<_, ExtractError>>()?;
        for i in 0..1100 {
            let measured = measure(&mut extractor, &pictures[i % 12])?;
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

/// The colour of the liquid that the tests are set up for, and one that it does not have.
const OWN: Scalar = Scalar::new(150.0, 62.0, 20.0, 0.0);
const OTHER: Scalar = Scalar::new(60.0, 180.0, 60.0, 0.0);

/// An extractor with the region that calibration writes, with room below the lip and beside the container.
fn with_room() -> Result<Extractor, ExtractError> {
    Extractor::new(&camera(), &ImageConfig { region_px: [171, 14, 440, 296], ..image_config(LiquidMethod::Colour) })
}

/// Protects pours of an eye that cannot tell a picture now and then, from the first one on: no more than ten pictures are called dry before the
/// ground is known, so a stream in other colours is never "nothing". Once every picture is told, the ground gets known.
#[test]
fn ground_that_never_gets_known_is_named() -> Result<(), ExtractError> {
    let everywhere = vec![[0.0, 0.0], [640.0, 0.0], [640.0, 480.0], [0.0, 480.0]];
    for every in [3, 8, 15] {
        let (mut extractor, mut dry_pictures) = (colour()?, 0);
        for i in 0..170 {
            let lost = i < 90 && i % every == 0;
            let picture = if lost {
                blue(std::slice::from_ref(&everywhere), i)?
            } else {
                let mut picture = dry(0.0, i)?;
                if (60..90).contains(&i) || i >= 150 {
                    lay_over(&mut picture, &[stream(40.0, 36.0)], OTHER)?;
                }
                picture
            };
            let measured = measure(&mut extractor, &picture)?;
            assert_eq!(measured.area_px2, 0.0, "{every} picture {i}");
            dry_pictures += u32::from(i < 90 && measured.doubt == Doubt::None);
            let is_stream = lost || (60..90).contains(&i) || i >= 150;
            assert!(!is_stream || measured.doubt != Doubt::None, "{every} picture {i}: {measured:?}");
            assert!(!(130..150).contains(&i) || measured.doubt == Doubt::None, "{every} picture {i}: {measured:?}");
        }
        assert!(dry_pictures <= 10, "{every}: {dry_pictures}");
    }
    Ok(())
}

/// Protects a worker that starts while a stream flows: when its colours change, it is not learned as ground and is never "nothing". When it ends, that
/// is told.
#[test]
fn a_stream_from_the_first_picture_on_is_no_ground() -> Result<(), ExtractError> {
    for ends in [false, true] {
        let mut extractor = colour()?;
        for i in 0..90 {
            let mut picture = dry(0.0, i)?;
            match i {
                0..20 => lay_over(&mut picture, &[stream(60.0, 50.0)], OWN)?,
                _ if ends => {}
                _ => lay_over(&mut picture, &[stream(60.0, 50.0)], OTHER)?,
            }
            let measured = measure(&mut extractor, &picture)?;
            match i {
                0..20 => assert!(measured.area_px2 > 1200.0, "picture {i}: {measured:?}"),
                _ if ends => assert!(i < 40 || (measured.area_px2, measured.doubt) == (0.0, Doubt::None), "picture {i}: {measured:?}"),
                _ => assert_ne!(measured.doubt, Doubt::None, "picture {i}"),
            }
        }
    }
    Ok(())
}

/// Protects a worker that starts while a stream in other colours flows, as of a camera whose colours are swapped: it is "colours changed" from the first
/// picture on, and once it ends, dry ground is told.
#[test]
fn a_stream_in_other_colours_from_the_first_picture_on_is_named() -> Result<(), ExtractError> {
    for (a, b, from) in [(24.0, 20.0, 0), (60.0, 50.0, 0), (150.0, 130.0, 0), (60.0, 50.0, 4)] {
        for mut extractor in [colour()?, with_room()?] {
            for i in 0..140 {
                let mut picture = dry(0.0, i)?;
                if (from..80).contains(&i) {
                    lay_over(&mut picture, &[stream(a, b)], OTHER)?;
                }
                let measured = measure(&mut extractor, &picture)?;
                match i {
                    _ if (from..80).contains(&i) => {
                        assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::ColoursChanged), "{a} picture {i}")
                    }
                    110.. => assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::None), "{a} picture {i}"),
                    _ => {}
                }
            }
        }
    }
    Ok(())
}

/// Protects the first pictures before an untidy place: what lies at the lip without a stream's outline is ground, and no stream in other colours. The
/// liquid is measured before it.
#[test]
fn an_untidy_place_is_no_stream_in_other_colours() -> Result<(), ExtractError> {
    let rods =
        [[0.0, 0.0], [110.0, 0.0], [110.0, 12.0], [24.0, 14.0], [80.0, 86.0], [66.0, 96.0], [12.0, 26.0], [12.0, 100.0], [0.0, 100.0]];
    let rods: Vec<_> = rods.iter().map(|[u, v]| [215.0 + u, 250.0 - v]).collect();
    for mut extractor in [colour()?, with_room()?] {
        for i in 0..60 {
            let mut picture = dry(0.0, i)?;
            lay_over(&mut picture, std::slice::from_ref(&rods), OTHER)?;
            if i >= 40 {
                lay_over(&mut picture, &[stream(60.0, 50.0)], OWN)?;
            }
            let measured = measure(&mut extractor, &picture)?;
            let flows = measured.area_px2 > 1200.0;
            assert!(flows == (i >= 40) && measured.doubt == Doubt::None, "picture {i}: {measured:?}");
        }
    }
    Ok(())
}

/// Protects thin streams, through which the ground is seen: what is neither in the liquid's range nor ground, but a mixture of both, is the
/// liquid, although the liquid in the glass is seen in its own colours.
#[test]
fn a_thin_stream_is_not_new_ground() -> Result<(), ExtractError> {
    let inside = vec![[216.0, 252.0], [300.0, 252.0], [300.0, 479.0], [216.0, 479.0]];
    for share in [0.25, 0.35] {
        let mut extractor = with_room()?;
        for i in 0..60 {
            let mut picture = dry(0.0, i)?;
            if i >= 44 {
                let (mut poured, clear) = (picture.clone(), picture.clone());
                lay_over(&mut poured, &[stream(40.0, 36.0)], OWN)?;
                core::add_weighted(&poured, share, &clear, 1.0 - share, 0.0, &mut picture, -1)?;
                lay_over(&mut picture, std::slice::from_ref(&inside), OWN)?;
            }
            let measured = measure(&mut extractor, &picture)?;
            assert_eq!(is_told(&measured), i >= 44, "{share} picture {i}: {measured:?}");
        }
    }
    Ok(())
}

/// Protects pours from something in the ground's colours that hides the lip, or half of the stream: what flows beyond it is not "nothing".
#[test]
fn a_stream_behind_something_in_the_grounds_colours_is_named() -> Result<(), ExtractError> {
    let at_lip = vec![[214.0, 215.0], [250.0, 215.0], [250.0, 251.0], [214.0, 251.0]];
    let one_half = vec![[214.0, 251.0], [214.0, 16.0], [449.0, 16.0]];
    let other_half = vec![[214.0, 251.0], [449.0, 16.0], [600.0, 16.0], [600.0, 251.0]];
    for hidden in [at_lip, one_half, other_half] {
        let mut extractor = with_room()?;
        for i in 0..60 {
            let mut picture = dry(0.0, i)?;
            if i >= 44 {
                lay_over(&mut picture, &[stream(90.0, 80.0)], OWN)?;
                lay_over(&mut picture, std::slice::from_ref(&hidden), Scalar::all(185.0))?;
                picture = noisy(&picture, i)?;
            }
            let measured = measure(&mut extractor, &picture)?;
            assert_eq!(is_told(&measured), i >= 44, "{hidden:?} picture {i}: {measured:?}");
        }
    }
    Ok(())
}

/// Protects streams of two colours: what goes on from the liquid's edge in another colour, on less than half of the rays, is not learned as ground, so
/// a stream that takes this colour as a whole is never "nothing".
#[test]
fn a_stream_with_a_second_colour_does_not_teach_it_as_ground() -> Result<(), ExtractError> {
    let outer = vec![[215.0, 250.0], [215.0, 135.0], [270.4, 184.0]];
    let mut extractor = with_room()?;
    for i in 0..150 {
        let mut picture = dry(0.0, i)?;
        match i {
            0..20 => {}
            20..80 => {
                lay_over(&mut picture, std::slice::from_ref(&outer), OTHER)?;
                lay_over(&mut picture, &[stream(90.0, 80.0)], OWN)?;
            }
            _ => lay_over(&mut picture, &[stream(90.0, 80.0)], OTHER)?,
        }
        let measured = measure(&mut extractor, &picture)?;
        assert_eq!(is_told(&measured), i >= 20, "picture {i}: {measured:?}");
    }
    Ok(())
}

/// Protects small streams under a lamp's reflection before ground that is as white as it is: white light at the lip is no ground there, so they are
/// measured or named. Without a stream there is no doubt.
#[test]
fn a_stream_under_a_reflection_before_white_ground_is_told() -> Result<(), ExtractError> {
    let box_of = |x: f32, y: f32, right: f32, down: f32| vec![[x, y], [right, y], [right, down], [x, down]];
    let (far, at_lip) = (box_of(260.0, 155.0, 310.0, 205.0), box_of(190.0, 203.0, 262.0, 249.0));
    for (a, b) in [(24.0, 20.0), (30.0, 26.0), (40.0, 36.0)] {
        let mut extractor = with_room()?;
        for i in 0..60 {
            let mut picture = dry(0.0, i)?;
            lay_over(&mut picture, &[far.clone(), at_lip.clone()], Scalar::all(255.0))?;
            if i >= 44 {
                lay_over(&mut picture, &[stream(a, b)], OWN)?;
            }
            for (k, pixel) in picture.data_typed_mut::<core::Vec3b>()?.iter_mut().enumerate() {
                let (right, down) = (((k % 640) as f32 - 215.0) / 18.0, ((k / 640) as f32 - 250.0) / 12.0);
                let light = (255.0 * (-0.5 * (right * right + down * down)).exp()) as u8;
                (0..3).for_each(|c| pixel[c] = pixel[c].saturating_add(light));
            }
            let measured = measure(&mut extractor, &picture)?;
            assert_eq!(is_told(&measured), i >= 44, "{a} x {b} picture {i}: {measured:?}");
        }
    }
    Ok(())
}

/// Protects the first pictures of a stream in other colours: its jet crosses what is seen beside the container before the stream is seen at the lip,
/// and is not learned as ground there.
#[test]
fn a_jet_beside_the_container_is_no_ground() -> Result<(), ExtractError> {
    let jet = vec![[176.0, 238.0], [210.0, 238.0], [210.0, 252.0], [176.0, 252.0]];
    let mut extractor = with_room()?;
    for i in 0..110 {
        let mut picture = dry(0.0, i)?;
        match i {
            0..44 => {}
            44..48 => lay_over(&mut picture, std::slice::from_ref(&jet), OTHER)?,
            _ => lay_over(&mut picture, &[stream(40.0, 36.0)], OTHER)?,
        }
        let measured = measure(&mut extractor, &picture)?;
        assert_eq!(measured.area_px2, 0.0, "picture {i}");
        assert!(i < 48 || measured.doubt != Doubt::None, "picture {i}: {measured:?}");
    }
    Ok(())
}

/// Protects thick streams in other colours: a jet that covers three quarters of what is seen beside the container is no ground that goes on there.
#[test]
fn a_thick_jet_is_no_ground_that_goes_on() -> Result<(), ExtractError> {
    let jet = vec![[150.0, 180.0], [216.0, 180.0], [216.0, 272.0], [150.0, 272.0]];
    let body = vec![[214.0, 170.0], [290.0, 170.0], [290.0, 249.0], [214.0, 249.0]];
    let mut extractor = with_room()?;
    for i in 0..70 {
        let mut picture = dry(0.0, i)?;
        if i >= 44 {
            lay_over(&mut picture, &[jet.clone(), body.clone()], OTHER)?;
        }
        let measured = measure(&mut extractor, &picture)?;
        let wanted = if i < 44 { Doubt::None } else { Doubt::ColoursChanged };
        assert_eq!((measured.area_px2, measured.doubt), (0.0, wanted), "picture {i}");
    }
    Ok(())
}

/// Protects streams of which only a root at the lip, too small for a stream, has the liquid's own colours: what goes on from it in others is no zero.
#[test]
fn a_root_in_own_colours_hides_no_stream() -> Result<(), ExtractError> {
    let mut extractor = colour()?;
    for i in 0..60 {
        let mut picture = dry(0.0, i)?;
        if i >= 44 {
            lay_over(&mut picture, &[stream(40.0, 36.0)], OTHER)?;
            lay_over(&mut picture, &[stream(8.0, 8.0)], Scalar::new(150.0, 62.0, 20.0, 0.0))?;
        }
        let measured = measure(&mut extractor, &picture)?;
        assert!(i < 44 || is_told(&measured), "picture {i}: {measured:?}");
    }
    Ok(())
}

/// Protects vessels with a drop at the lip from the first picture on: it does not keep the ground from getting known, so a stream in other colours is
/// never "nothing", nor learned as ground.
#[test]
fn a_drop_from_the_first_picture_on_hides_no_stream() -> Result<(), ExtractError> {
    let mut extractor = colour()?;
    for i in 0..110 {
        let mut picture = dry(0.0, i)?;
        if i >= 44 {
            lay_over(&mut picture, &[stream(40.0, 36.0)], OTHER)?;
        } else {
            lay_over(&mut picture, &[stream(7.0, 7.0)], OWN)?;
        }
        let measured = measure(&mut extractor, &picture)?;
        assert_eq!(is_told(&measured), i >= 44, "picture {i}: {measured:?}");
    }
    Ok(())
}

/// Protects the pictures after a stream of which all but a root has taken other colours: what it leaves is not dry from one picture to the next.
#[test]
fn a_root_does_not_stand_for_its_stream() -> Result<(), ExtractError> {
    let mut extractor = colour()?;
    for i in 0..100 {
        let mut picture = dry(0.0, i)?;
        if (40..50).contains(&i) {
            lay_over(&mut picture, &[stream(90.0, 80.0)], if i < 46 { OWN } else { OTHER })?;
            lay_over(&mut picture, &[stream(12.0, 10.0)], OWN)?;
        }
        let measured = measure(&mut extractor, &picture)?;
        match i {
            40..54 => assert!(is_told(&measured), "picture {i}: {measured:?}"),
            0..40 | 65.. => assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::None), "picture {i}"),
            _ => {}
        }
    }
    Ok(())
}

/// Protects streams of which the root alone has the liquid's colours, since the worker's start or after a dry picture: what goes on from it in other
/// colours is not learned as ground, so a stream in these alone is never "nothing".
#[test]
fn a_root_does_not_teach_what_goes_on_from_it() -> Result<(), ExtractError> {
    let outer = vec![[215.0, 250.0], [215.0, 135.0], [270.4, 184.0]];
    for dry_first in [true, false] {
        let mut extractor = with_room()?;
        for i in 0..110 {
            let mut picture = dry(0.0, i)?;
            match (i, dry_first) {
                (0..44, true) => {}
                (0..20, false) => lay_over(&mut picture, &[stream(90.0, 80.0)], OWN)?,
                (44..64, true) => {
                    lay_over(&mut picture, std::slice::from_ref(&outer), OTHER)?;
                    lay_over(&mut picture, &[stream(7.0, 7.0)], OWN)?;
                }
                (_, true) => lay_over(&mut picture, &[stream(90.0, 80.0)], OTHER)?,
                (_, false) => {
                    lay_over(&mut picture, &[stream(90.0, 80.0)], OTHER)?;
                    lay_over(&mut picture, &[stream(7.0, 7.0)], OWN)?;
                }
            }
            let measured = measure(&mut extractor, &picture)?;
            let flows = if dry_first { i >= 64 } else { i >= 20 };
            assert!(!flows || is_told(&measured), "{dry_first} picture {i}: {measured:?}");
        }
    }
    Ok(())
}

/// Protects from an area that is too small: a streak in the ground's colours along a stream, as a wall's reflection, cuts it in two, and the part at the lip
/// is not the stream.
#[test]
fn a_streak_along_a_stream_leaves_no_part_of_it() -> Result<(), ExtractError> {
    const WALL: f64 = 165.0;
    for (inner, outer) in [(0.3, 0.6), (0.45, 0.75), (0.5, 0.8), (0.7, 0.9), (1.0, 1.0)] {
        let mut extractor = with_room()?;
        for i in 0..60 {
            let mut picture = Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_8UC3, Scalar::all(WALL))?;
            if i >= 20 {
                lay_over(&mut picture, &[stream(90.0, 80.0)], OWN)?;
                lay_over(&mut picture, &[stream(90.0 * outer, 80.0 * outer)], Scalar::all(WALL))?;
                lay_over(&mut picture, &[stream(90.0 * inner, 80.0 * inner)], OWN)?;
            }
            glass(&mut picture)?;
            let measured = measure(&mut extractor, &noisy(&picture, i)?)?;
            let right = (measured.area_px2 - 3600.0).abs() < 360.0;
            match i {
                0..20 => assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::None), "{inner} to {outer}, picture {i}"),
                _ if inner == outer => assert!(right && measured.doubt == Doubt::None, "without, picture {i}: {measured:?}"),
                _ => assert!(right || measured.doubt != Doubt::None, "{inner} to {outer}, picture {i}: {measured:?}"),
            }
        }
    }
    Ok(())
}

/// Protects pours that a camera without colour sees: a liquid that has a hue is not "nothing" there, however pale it is. The colours are those that
/// calibration gives for pale juice.
#[test]
fn a_pale_liquid_in_grey_pictures_is_not_called_absent() -> Result<(), ExtractError> {
    let colour_hsv = [5, 15, 40, 25, 255, 255];
    let mut extractor = Extractor::new(&camera(), &ImageConfig { colour_hsv, ..image_config(LiquidMethod::Colour) })?;
    for i in 0..50 {
        let picture = if i < 20 { dry(0.0, i)? } else { blue(&[stream(4.0 * (i - 15) as f32, 60.0)], i)? };
        let (mut grey, mut shown) = (Mat::default(), Mat::default());
        imgproc::cvt_color_def(&picture, &mut grey, imgproc::COLOR_BGR2GRAY)?;
        imgproc::cvt_color_def(&grey, &mut shown, imgproc::COLOR_GRAY2BGR)?;
        let measured = measure(&mut extractor, &shown)?;
        assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::ColoursChanged), "picture {i}");
    }
    Ok(())
}
