//! The extraction on drawn pictures whose triangle is known.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

mod clear;
mod drawn;
mod gaps;
mod ground;

use drawn::{HEIGHT, WIDTH, blue, camera, disc, dry, image_config, lay_over, noisy, pour, stream, water};
use feature_worker::vision::{ExtractError, Extractor, Image, Measurement};
use opencv::core::{self, CV_8UC3, CV_16SC3, Mat, Point, Scalar, Size, Vector};
use opencv::{imgproc, prelude::*};
use shared::config::{ImageConfig, LiquidMethod};
use shared::messages::{Doubt, PixelFormat};

fn measure(extractor: &mut Extractor, picture: &Mat) -> Result<Measurement, ExtractError> {
    extractor.measure(Image { width_px: 640, height_px: 480, format: PixelFormat::Bgr8, pixels: picture.data_bytes()? })
}

fn colour() -> Result<Extractor, ExtractError> {
    Extractor::new(&camera(), &image_config(LiquidMethod::Colour))
}

/// Protects V_e itself: triangles of known size, small and large, steep and flat, are measured to 3 %, and their corners to 1.5 px.
#[test]
fn known_triangles_are_measured() -> Result<(), ExtractError> {
    for (i, (a, b)) in [(22.0f32, 20.0f32), (40.0, 60.0), (90.0, 45.0), (150.0, 140.0), (200.0, 70.0)].into_iter().enumerate() {
        let measured = measure(&mut colour()?, &blue(&[stream(a, b)], i as i32)?)?;
        let truth = 0.5 * a * b;
        assert!((measured.area_px2 / truth - 1.0).abs() < 0.03, "{a} x {b}: {measured:?} instead of {truth}");
        assert_eq!(measured.doubt, Doubt::None);
        assert!(measured.confidence > 0.6, "{measured:?}");
        let [x0, y0, x1, _, _, y2] = measured.triangle_px;
        assert!((x0 - 215.0).abs() < 0.01 && (y0 - 250.0).abs() < 0.01);
        assert!((x1 - 215.0 - a).abs() < 1.5 && (250.0 - y2 - b).abs() < 1.5, "{measured:?}");
    }
    Ok(())
}

/// Protects every kind of camera: a picture in YUYV gives the same V_e as in BGR, at even and odd corners of the region.
#[test]
fn yuyv_gives_the_same_area() -> Result<(), ExtractError> {
    let picture = blue(&[stream(90.0, 60.0)], 3)?;
    let mut yuv = Mat::default();
    imgproc::cvt_color_def(&picture, &mut yuv, imgproc::COLOR_BGR2YUV)?;
    // YUYV has a limited range: luma goes from 16 to 235 and chroma from 16 to 240, and two pixels share one chroma.
    let full = yuv.data_typed::<core::Vec3b>()?;
    let mut yuyv = Vec::new();
    let luma = |p: &core::Vec3b| (16.0 + f32::from(p[0]) * 219.0 / 255.0).round() as u8;
    // OpenCV's YUV has U = 0.492 (B - Y) and V = 0.877 (R - Y); a camera's chroma has 0.564 and 0.713 instead, in the limited
    // range.
    let chroma = |p: &core::Vec3b, k: usize, factor: f32| (128.0 + (f32::from(p[k]) - 128.0) * factor * 224.0 / 255.0).round() as u8;
    for pair in full.chunks_exact(2) {
        yuyv.extend([luma(&pair[0]), chroma(&pair[0], 1, 0.564 / 0.492), luma(&pair[1]), chroma(&pair[0], 2, 0.713 / 0.877)]);
    }
    for left in [190, 191] {
        let config = ImageConfig { region_px: [left, 16, 419, 270], ..image_config(LiquidMethod::Colour) };
        let mut extractor = Extractor::new(&camera(), &config)?;
        let one = measure(&mut extractor, &picture)?;
        let other = extractor.measure(Image { width_px: 640, height_px: 480, format: PixelFormat::Yuyv, pixels: &yuyv })?;
        assert_eq!(other.doubt, Doubt::None);
        assert!((one.area_px2 / other.area_px2 - 1.0).abs() < 0.02, "{left}: {one:?} and {other:?}");
    }
    Ok(())
}

/// Protects the end of a pour: without a stream V_e is exactly 0, and neither drops nor a splash nor the bead at the lip are a stream.
#[test]
fn drops_and_splashes_are_no_stream() -> Result<(), ExtractError> {
    let inside = vec![[217.0, 479.0], [217.0, 300.0], [560.0, 270.0], [560.0, 479.0]];
    let cases = [
        vec![],
        vec![inside.clone()],
        vec![inside.clone(), disc(211.0, 255.0, 8.0)],
        vec![inside.clone(), disc(240.0, 225.0, 9.0), disc(300.0, 120.0, 14.0)],
        vec![inside.clone(), disc(228.0, 247.0, 11.0)],
        vec![inside, disc(260.0, 200.0, 16.0), disc(226.0, 180.0, 7.0), disc(330.0, 235.0, 9.0)],
    ];
    for (i, shapes) in cases.iter().enumerate() {
        let measured = measure(&mut colour()?, &blue(shapes, i as i32)?)?;
        assert_eq!((measured.area_px2, measured.triangle_px), (0.0, [0.0; 6]), "case {i}");
    }
    Ok(())
}

/// Protects the controller from trusting a picture that shows nothing: each reason for doubt is raised for its cause.
#[test]
fn each_cause_raises_its_doubt() -> Result<(), ExtractError> {
    let mut extractor = colour()?;
    let good = blue(&[stream(80.0, 60.0)], 1)?;
    assert_eq!(measure(&mut extractor, &good)?.doubt, Doubt::None);
    assert_eq!(measure(&mut extractor, &good)?.doubt, Doubt::Frozen);
    let mut changed = Mat::default();
    good.convert_to(&mut changed, -1, 0.04, 0.0)?;
    assert_eq!(measure(&mut extractor, &changed)?.doubt, Doubt::TooDark);
    good.convert_to(&mut changed, -1, 1.0, 240.0)?;
    assert_eq!(measure(&mut extractor, &changed)?.doubt, Doubt::BlownOut);
    imgproc::gaussian_blur_def(&good, &mut changed, Size::new(0, 0), 4.5)?;
    assert_eq!(measure(&mut extractor, &changed)?.doubt, Doubt::Blurred);
    let full = blue(&[vec![[0.0, 0.0], [640.0, 0.0], [640.0, 480.0], [0.0, 480.0]]], 2)?;
    assert_eq!(measure(&mut extractor, &full)?.doubt, Doubt::EdgeNotFound);
    let mut small = Extractor::new(&camera(), &ImageConfig { region_px: [195, 210, 120, 50], ..image_config(LiquidMethod::Colour) })?;
    assert_eq!(measure(&mut small, &blue(&[stream(90.0, 80.0)], 3)?)?.doubt, Doubt::LeavesRegion);
    let half = Image { width_px: 320, height_px: 240, format: PixelFormat::Bgr8, pixels: &[0; 320 * 240 * 3] };
    assert_eq!(extractor.measure(half)?.doubt, Doubt::WrongFormat);
    let short = Image { width_px: 640, height_px: 480, format: PixelFormat::Bgr8, pixels: &[0; 100] };
    assert_eq!(extractor.measure(short)?.doubt, Doubt::WrongFormat);
    Ok(())
}

/// Protects the controller from parts of a picture: what was not decoded, is of the picture before, or is shifted, is named, above a
/// stream and without one, and the whole pictures between are measured.
#[test]
fn a_picture_that_is_not_whole_is_named() -> Result<(), ExtractError> {
    type Break = fn(&mut [u8], [&[u8]; 2]);
    let breaks: [Break; 5] = [
        |rows, _| rows.fill(128),
        |rows, _| rows.chunks_exact_mut(3).for_each(|p| p.copy_from_slice(&[0, 135, 0])),
        |rows, [last, _]| rows.copy_from_slice(last),
        // What a driver's buffer still held.
        |rows, [_, older]| rows.copy_from_slice(older),
        |rows, _| rows.chunks_exact_mut(640 * 3).for_each(|row| row.rotate_right(24 * 3)),
    ];
    for (kind, broken) in breaks.iter().enumerate() {
        for method in [LiquidMethod::Colour, LiquidMethod::Clear] {
            let mut extractor = Extractor::new(&camera(), &image_config(method))?;
            let mut before = [Vec::new(), Vec::new()];
            for i in 0..44 {
                let share = ((i - 24) as f32 / 8.0).clamp(0.0, 1.0);
                let picture = if method == LiquidMethod::Colour { pour((i - 20).max(0))? } else { water(share, None, i)? };
                let mut pixels = picture.data_bytes()?.to_vec();
                let clean = pixels.clone();
                let is_broken = i > 22 && i % 3 == 0;
                if is_broken {
                    let from = 160 * 640 * 3;
                    broken(&mut pixels[from..], before.each_ref().map(|rows| &rows[from..]));
                }
                before = [clean, std::mem::take(&mut before[0])];
                let measured = extractor.measure(Image { width_px: 640, height_px: 480, format: PixelFormat::Bgr8, pixels: &pixels })?;
                assert_eq!(measured.doubt == Doubt::PictureIncomplete, is_broken, "{kind} {method:?} frame {i}: {measured:?}");
            }
        }
    }
    Ok(())
}

/// Protects the controller from a camera whose colours are not those of the calibration: a stream in swapped colours or in grey is not
/// "nothing".
#[test]
fn a_stream_in_other_colours_is_named() -> Result<(), ExtractError> {
    let swap: fn(&mut [u8]) = |p| p.swap(0, 2);
    let grey: fn(&mut [u8]) = |p| p.fill(p[1]);
    for (change, doubted_dry) in [(swap, false), (grey, true)] {
        let mut extractor = colour()?;
        for i in -12..24 {
            let mut pixels = pour(i)?.data_bytes()?.to_vec();
            pixels.chunks_exact_mut(3).for_each(change);
            let measured = extractor.measure(Image { width_px: 640, height_px: 480, format: PixelFormat::Bgr8, pixels: &pixels })?;
            let wanted = if i > 15 || doubted_dry { Doubt::ColoursChanged } else { Doubt::None };
            if i <= 7 || i > 15 {
                assert_eq!((measured.area_px2, measured.doubt), (0.0, wanted), "frame {i}");
            }
        }
    }
    Ok(())
}

/// Protects dry pictures from doubts: ground in new colours is ground where it goes on beside the container, and where the liquid in the glass
/// has its own colours; otherwise it may be the liquid. And one white square at the lip is no picture that is blown out.
#[test]
fn new_ground_is_no_liquid() -> Result<(), ExtractError> {
    let (green, white, blue) = (Scalar::new(60.0, 180.0, 60.0, 0.0), Scalar::all(255.0), Scalar::new(150.0, 62.0, 20.0, 0.0));
    let box_of = |x: f32, y: f32, right: f32, down: f32| vec![[x, y], [right, y], [right, down], [x, down]];
    let (far, at_lip) = (box_of(520.0, 60.0, 610.0, 200.0), box_of(180.0, 110.0, 400.0, 249.0));
    let (right, across) = (box_of(216.0, 170.0, 290.0, 249.0), box_of(150.0, 170.0, 290.0, 249.0 + 50.0));
    let inside = (box_of(216.0, 252.0, 300.0, 479.0), blue);
    for (shapes, wanted) in [
        (vec![(right.clone(), green)], Doubt::ColoursChanged),
        (vec![(across, green)], Doubt::None),
        (vec![(right, green), inside], Doubt::None),
        (vec![(at_lip, white)], Doubt::None),
    ] {
        // As calibration writes it, with room below the lip and beside the container.
        let image = ImageConfig { region_px: [171, 14, 440, 296], ..image_config(LiquidMethod::Colour) };
        let mut extractor = Extractor::new(&camera(), &image)?;
        for i in 0..48 {
            let mut picture = dry(0.0, i)?;
            lay_over(&mut picture, std::slice::from_ref(&far), white)?;
            for (shape, colour) in shapes.iter().filter(|_| i >= 44) {
                lay_over(&mut picture, std::slice::from_ref(shape), *colour)?;
            }
            let measured = measure(&mut extractor, &picture)?;
            let wanted = if i < 44 { Doubt::None } else { wanted };
            assert_eq!((measured.area_px2, measured.doubt), (0.0, wanted), "frame {i}");
        }
    }
    Ok(())
}

/// Protects the estimate from a stream that is lost: where a stream was, and what is there now was never seen as ground, it is not seen and
/// not absent. Where ground is seen, a large stream is gone within 0.3 s and not at once, because its colours may be the ground's for a few
/// pictures.
#[test]
fn a_lost_stream_is_not_absent() -> Result<(), ExtractError> {
    for lost in [true, false] {
        let mut extractor = colour()?;
        for i in 0..40 {
            let mut picture = dry(0.0, i)?;
            if (14..18).contains(&i) || (lost && i >= 18) {
                let colour = if i < 18 { Scalar::new(150.0, 62.0, 20.0, 0.0) } else { Scalar::new(60.0, 180.0, 60.0, 0.0) };
                let shape: Vector<Point> = stream(70.0, 60.0).into_iter().map(|[x, y]| Point::new(x as i32, y as i32)).collect();
                imgproc::fill_poly(&mut picture, &shape, colour, imgproc::LINE_AA, 0, Point::default())?;
            }
            let measured = measure(&mut extractor, &picture)?;
            assert_eq!(measured.area_px2 > 0.0, (14..18).contains(&i), "frame {i}: {measured:?}");
            if i == 18 || lost && i > 18 {
                assert_ne!(measured.doubt, Doubt::None, "frame {i}: {measured:?}");
            } else if i >= 27 {
                assert_eq!(measured.doubt, Doubt::None, "frame {i}: {measured:?}");
            }
        }
    }
    Ok(())
}

/// Protects clear water under lamps that flicker, and with a white balance that hunts: gains of 20 % are divided out, and the stream is
/// measured as without them; with bands of 30 % it is measured so too, or the flicker is named.
#[test]
fn bands_and_colours_of_the_light_are_divided_out() -> Result<(), ExtractError> {
    for (bands, tint) in [(0.3f32, 0.0f32), (0.0, 0.2)] {
        let mut extractor = Extractor::new(&camera(), &image_config(LiquidMethod::Clear))?;
        for i in 0..26 {
            let share = ((i - 9) as f32 / 8.0).clamp(0.0, 1.0);
            let mut pixels = water(share, None, i)?.data_bytes()?.to_vec();
            for (y, row) in pixels.chunks_exact_mut(640 * 3).enumerate() {
                let band = 1.0 + bands * (y as f32 / 30.0 + i as f32 * 2.1).sin();
                let warm = 1.0 + tint * (i as f32 / 9.0).sin();
                for pixel in row.chunks_exact_mut(3) {
                    pixel[0] = (f32::from(pixel[0]) * band / warm).min(255.0) as u8;
                    pixel[1] = (f32::from(pixel[1]) * band).min(255.0) as u8;
                    pixel[2] = (f32::from(pixel[2]) * band * warm).min(255.0) as u8;
                }
            }
            let measured = extractor.measure(Image { width_px: 640, height_px: 480, format: PixelFormat::Bgr8, pixels: &pixels })?;
            let truth = 3600.0 * share * share;
            if share == 0.0 {
                assert_eq!(measured.area_px2, 0.0, "frame {i}");
            } else if bands > 0.0 && measured.area_px2 == 0.0 {
                // A new stream has to be confirmed five times, and bands from the first picture on look like a pattern for a while.
                assert!(measured.doubt == Doubt::LightFlickers || share < 0.3, "{bands} {tint} frame {i}: {measured:?}");
            } else if share > 0.5 {
                assert!((measured.area_px2 / truth - 1.0).abs() < 0.15, "{bands} {tint} frame {i}: {measured:?} instead of {truth}");
            }
        }
    }
    Ok(())
}

/// Protects against a lamp's reflection at the lip: clear water before it is not told, with and without a stream, and a coloured stream that
/// is not seen is not "nothing".
#[test]
fn a_reflection_at_the_lip_is_named() -> Result<(), ExtractError> {
    for method in [LiquidMethod::Clear, LiquidMethod::Colour] {
        let mut extractor = Extractor::new(&camera(), &image_config(method))?;
        for i in 0..34 {
            let share = ((i - 24) as f32 / 8.0).clamp(0.0, 1.0);
            let picture = if method == LiquidMethod::Colour { pour(i - 20)? } else { water(share, None, i)? };
            let mut pixels = picture.data_bytes()?.to_vec();
            for (k, pixel) in pixels.chunks_exact_mut(3).enumerate() {
                let (right, down) = (((k % 640) as f32 - 215.0) / 18.0, ((k / 640) as f32 - 250.0) / 12.0);
                let light = (255.0 * (-0.5 * (right * right + down * down)).exp()) as u8;
                pixel.iter_mut().for_each(|level| *level = level.saturating_add(light));
            }
            let measured = extractor.measure(Image { width_px: 640, height_px: 480, format: PixelFormat::Bgr8, pixels: &pixels })?;
            if i >= 12 {
                let told = measured.area_px2 > 0.0 && method == LiquidMethod::Colour;
                assert!(told || measured.doubt == Doubt::BlownOut, "{method:?} frame {i}: {measured:?}");
            }
        }
    }
    Ok(())
}

/// Protects clear water before a pattern under lamps that flicker, where bands cannot be divided out once the background moves: the flicker
/// is named, and a stream is never "nothing". And the pattern itself is told, so that the worker can say that it is no ground for water.
#[test]
fn bands_before_a_pattern_are_named() -> Result<(), ExtractError> {
    let mut extractor = Extractor::new(&camera(), &image_config(LiquidMethod::Clear))?;
    let mut named = 0;
    for i in 0..40 {
        let share = ((i - 20) as f32 / 8.0).clamp(0.0, 1.0);
        let mut pixels = water(share, Some((i - 12).max(0) as f32), i)?.data_bytes()?.to_vec();
        for (y, row) in pixels.chunks_exact_mut(640 * 3).enumerate() {
            let band = 1.0 + 0.15 * (y as f32 / 30.0 + i as f32 * 2.1).sin();
            row.iter_mut().for_each(|level| *level = (f32::from(*level) * band).min(255.0) as u8);
        }
        let measured = extractor.measure(Image { width_px: 640, height_px: 480, format: PixelFormat::Bgr8, pixels: &pixels })?;
        named += u32::from(measured.doubt == Doubt::LightFlickers);
        assert!(share < 0.5 || measured.area_px2 > 0.0 || measured.doubt != Doubt::None, "frame {i}: {measured:?}");
    }
    assert!(named >= 15, "named in {named} frames");
    assert_eq!(extractor.ground_is_even(), Some(false));
    assert_eq!(colour()?.ground_is_even(), None);
    Ok(())
}

/// Protects against a stream out of nothing: where the colour only fades, over half of the region, there is no edge and so no stream.
#[test]
fn a_fade_without_an_edge_is_no_stream() -> Result<(), ExtractError> {
    let mut picture = Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_8UC3, Scalar::all(185.0))?;
    for y in 0..HEIGHT {
        for (x, pixel) in picture.at_row_mut::<core::Vec3b>(y)?.iter_mut().enumerate() {
            let share = (1.0 - (x as f32 - 215.0).hypot(y as f32 - 250.0) / 270.0).max(0.0);
            *pixel = core::Vec3b::from([150.0, 62.0, 20.0].map(|blue: f32| (185.0 + (blue - 185.0) * share) as u8));
        }
    }
    let measured = measure(&mut colour()?, &noisy(&picture, 1)?)?;
    assert_eq!((measured.area_px2, measured.doubt), (0.0, Doubt::EdgeNotFound));
    Ok(())
}

/// Protects pours of dark liquids in dim light, whose colour is less than the noise of a pixel: every frame is measured.
#[test]
fn a_dark_liquid_in_noise_is_measured() -> Result<(), ExtractError> {
    let config = ImageConfig { colour_hsv: [175, 70, 5, 30, 255, 45], ..image_config(LiquidMethod::Colour) };
    let mut extractor = Extractor::new(&camera(), &config)?;
    for i in 0..10 {
        let mut picture = Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_8UC3, Scalar::all(50.0))?;
        let shape: Vector<Point> = stream(60.0, 40.0).into_iter().map(|[x, y]| Point::new(x as i32, y as i32)).collect();
        imgproc::fill_poly(&mut picture, &shape, Scalar::new(9.0, 13.0, 28.0, 0.0), imgproc::LINE_AA, 0, Point::default())?;
        let (mut noise, mut signed) = (Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_16SC3, Scalar::default())?, Mat::default());
        core::set_rng_seed(i)?;
        core::randn(&mut noise, &Scalar::default(), &Scalar::all(17.0))?;
        picture.convert_to(&mut signed, CV_16SC3, 1.0, 0.0)?;
        let mut sum = Mat::default();
        core::add(&signed, &noise, &mut sum, &core::no_array(), -1)?;
        sum.convert_to(&mut picture, CV_8UC3, 1.0, 0.0)?;
        let measured = measure(&mut extractor, &picture)?;
        assert!((measured.area_px2 / 1200.0 - 1.0).abs() < 0.1, "frame {i}: {measured:?}");
    }
    Ok(())
}

/// Protects the start of a pour: a camera that has lost its focus is noticed before anything flows, by the glass's own edges. A sharp
/// picture is not doubted, whatever stands behind the glass.
#[test]
fn lost_focus_is_noticed_without_a_stream() -> Result<(), ExtractError> {
    for method in [LiquidMethod::Colour, LiquidMethod::Clear] {
        let mut extractor = Extractor::new(&camera(), &image_config(method))?;
        for i in 0..12 {
            let sharp = dry(i as f32 * 0.5, i)?;
            let measured = measure(&mut extractor, &sharp)?;
            // The first ones tell whether the ground is dry.
            let begins = method == LiquidMethod::Clear && i < 6 && measured.doubt == Doubt::EdgeNotFound;
            assert!(measured.area_px2 == 0.0 && (begins || measured.doubt == Doubt::None), "{method:?} {i}: {measured:?}");
        }
        for i in 12..24 {
            let mut soft = Mat::default();
            imgproc::gaussian_blur_def(&dry(i as f32 * 0.5, i)?, &mut soft, Size::new(0, 0), 5.0)?;
            let measured = measure(&mut extractor, &drawn::noisy(&soft, i)?)?;
            // To clear water's memory of the background, a picture that turns soft all at once is first of all another picture.
            let noticed = measured.doubt == Doubt::Blurred || (method == LiquidMethod::Clear && measured.doubt == Doubt::EdgeNotFound);
            assert!(measured.area_px2 == 0.0 && noticed, "{method:?} {i}: {measured:?}");
        }
    }
    Ok(())
}

/// Protects the check of focus by the glass's own top edge and left side. A blur of deviation s makes an edge 2.5 s wide: 3 px are sharp
/// and 10 px are not, whatever stands behind. A background that is out of focus behind a sharp glass is no reason for a doubt.
#[test]
fn focus_is_judged_by_the_glass() -> Result<(), ExtractError> {
    let soft = |picture: &Mat, deviation_px: f64| -> Result<Mat, opencv::Error> {
        let mut soft = Mat::default();
        imgproc::gaussian_blur_def(picture, &mut soft, Size::new(0, 0), deviation_px)?;
        Ok(soft)
    };
    let even = Mat::new_rows_cols_with_default(HEIGHT, WIDTH, CV_8UC3, Scalar::all(140.0))?;
    for behind in [drawn::board(0.0)?, drawn::board(17.0)?, even] {
        for (behind_px, all_px, doubt) in [(0.6, 1.2, Doubt::None), (0.6, 4.0, Doubt::Blurred), (7.0, 1.2, Doubt::None)] {
            let mut picture = soft(&behind, behind_px)?;
            drawn::glass(&mut picture)?;
            let measured = measure(&mut colour()?, &drawn::noisy(&soft(&picture, all_px)?, 1)?)?;
            assert_eq!((measured.area_px2, measured.doubt), (0.0, doubt), "background {behind_px} px, all {all_px} px");
        }
    }
    Ok(())
}

/// Protects clear water in front of an even wall and of a pattern at rest: V_e is exactly 0 in the dry frames before and after, every frame
/// is measured to 10 % while the stream's legs have more than 0.3 of their full length, and none is doubted but the frames in which a
/// stream that ended from one picture to the next may be lost, and smaller beginnings.
#[test]
fn clear_water_is_measured() -> Result<(), ExtractError> {
    for turn in [None, Some(11.0)] {
        let mut extractor = Extractor::new(&camera(), &image_config(LiquidMethod::Clear))?;
        // Until the ground is known to be dry.
        for i in 0..16 {
            measure(&mut extractor, &water(0.0, turn, 100 + i)?)?;
        }
        for i in 0..42 {
            let share = match i {
                6..14 => (i - 5) as f32 / 8.0,
                14..24 => 1.0,
                _ => 0.0,
            };
            let measured = measure(&mut extractor, &water(share, turn, i)?)?;
            let begins = share > 0.0 && share <= 0.3;
            let may_be_lost = (begins || (24..35).contains(&i)) && measured.doubt == Doubt::EdgeNotFound;
            assert!(measured.doubt == Doubt::None || may_be_lost, "{turn:?} frame {i}: {measured:?}");
            let truth = 3600.0 * share * share;
            if share == 0.0 {
                assert_eq!(measured.area_px2, 0.0, "{turn:?} frame {i}");
            } else if share > 0.3 {
                assert!((measured.area_px2 / truth - 1.0).abs() < 0.1, "{turn:?} frame {i}: {measured:?} instead of {truth}");
            }
        }
    }
    Ok(())
}

/// Protects pours in front of a pattern that turns with the wrist: V_e is exactly 0 in the dry frames before and after, and a stream is
/// measured to 30 % from its third frame on, as long as its legs have more than half of their full length.
#[test]
fn clear_water_before_a_turning_pattern_is_measured() -> Result<(), ExtractError> {
    for turn_deg in [-0.8f32, 0.5, 1.0] {
        let mut extractor = Extractor::new(&camera(), &image_config(LiquidMethod::Clear))?;
        for i in 0..36 {
            let share = match i {
                8..26 => ((i - 7) as f32 / 5.0).min((26 - i) as f32 / 5.0).min(1.0),
                _ => 0.0,
            };
            let measured = measure(&mut extractor, &water(share, Some(turn_deg * i as f32), i)?)?;
            let truth = 3600.0 * share * share;
            if i < 8 {
                // The first ones tell whether the ground is dry.
                let begins = i < 4 && measured.doubt == Doubt::EdgeNotFound;
                assert!(measured.area_px2 == 0.0 && (begins || measured.doubt == Doubt::None), "{turn_deg} frame {i}: {measured:?}");
            } else if share == 0.0 {
                assert_eq!(measured.area_px2, 0.0, "{turn_deg} frame {i}");
            } else if i >= 10 && share > 0.5 {
                assert!((measured.area_px2 / truth - 1.0).abs() < 0.3, "{turn_deg} frame {i}: {measured:?} instead of {truth}");
            }
        }
    }
    Ok(())
}

/// Protects the worker from any picture: whatever the bytes are, nothing panics, an area is finite and not negative, a confidence lies
/// between 0 and 1, and there is an area exactly when there is a triangle.
#[test]
fn any_bytes_give_a_sane_measurement() -> Result<(), ExtractError> {
    for method in [LiquidMethod::Colour, LiquidMethod::Clear] {
        let mut extractor = Extractor::new(&camera(), &image_config(method))?;
        for seed in 0..60 {
            core::set_rng_seed(seed)?;
            let mut small = Mat::new_rows_cols_with_default(4 + seed * 4, 5 + seed * 5, CV_8UC3, Scalar::all(0.0))?;
            core::randu(&mut small, &Scalar::all(0.0), &Scalar::all(256.0))?;
            let mut picture = Mat::default();
            let kind = if seed % 2 == 0 { imgproc::INTER_NEAREST } else { imgproc::INTER_CUBIC };
            imgproc::resize(&small, &mut picture, Size::new(WIDTH, HEIGHT), 0.0, 0.0, kind)?;
            let m = measure(&mut extractor, &picture)?;
            assert!(m.area_px2.is_finite() && m.area_px2 >= 0.0 && (0.0..=1.0).contains(&m.confidence), "{seed}: {m:?}");
            assert!(m.triangle_px.iter().all(|v| v.is_finite()), "{seed}: {m:?}");
            assert_eq!(m.area_px2 > 0.0, m.triangle_px != [0.0; 6], "{seed}: {m:?}");
        }
    }
    Ok(())
}

/// Protects replays: the same frames give the same measurements to the bit, whatever another extractor has measured before.
#[test]
fn the_same_frames_give_the_same_measurements() -> Result<(), ExtractError> {
    let run = || -> Result<Vec<Measurement>, ExtractError> {
        let mut extractor = colour()?;
        (14..26).map(|i| measure(&mut extractor, &pour(i)?)).collect()
    };
    assert_eq!(run()?, run()?);
    Ok(())
}

/// Protects the operator from a configuration that cannot work: it is refused at once, with the key's name and a hint.
#[test]
fn bad_geometry_is_refused() -> Result<(), ExtractError> {
    let refusal = |image: ImageConfig| match Extractor::new(&camera(), &image) {
        Ok(_) => panic!("accepted"),
        Err(e) => e.to_string(),
    };
    let good = image_config(LiquidMethod::Colour);
    let said = refusal(ImageConfig { region_px: [300, 16, 300, 200], ..good.clone() });
    assert!(said.contains("image.region_px") && said.contains("215"), "{said}");
    // The lip is inside, but there is no room over the mouth.
    let said = refusal(ImageConfig { region_px: [191, 246, 420, 100], ..good.clone() });
    assert!(said.contains("image.region_px") && said.contains("no room"), "{said}");
    let grey = [100u8; 640 * 480];
    let answer = colour()?.measure(Image { width_px: 640, height_px: 480, format: PixelFormat::Mono8, pixels: &grey });
    let said = answer.expect_err("accepted").to_string();
    assert!(said.contains("image.method") && said.contains("clear"), "{said}");
    Ok(())
}
