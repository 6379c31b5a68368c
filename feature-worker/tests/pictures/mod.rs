//! What the bytes of picture files say: damage, turns, several pictures in one file, and how bright white is.

use std::path::{Path, PathBuf};

use crc::{CRC_32_ISO_HDLC, Crc};
use feature_worker::source::Recording;
use opencv::core::{self, Mat, Vector};
use opencv::prelude::*;
use opencv::{imgcodecs, imgproc};

use super::{Outcome, UPRIGHT, corners, find, inspect, pour, refused, report, seen};

fn encoded(ending: &str, picture: &Mat) -> Result<Vec<u8>, opencv::Error> {
    let mut bytes = Vector::<u8>::new();
    imgcodecs::imencode_def(ending, picture, &mut bytes)?;
    Ok(bytes.to_vec())
}

fn written(directory: &Path, name: &str, bytes: &[u8]) -> Result<PathBuf, std::io::Error> {
    let path = directory.join(name);
    std::fs::write(&path, bytes).map(|()| path)
}

/// A PNG with one more chunk behind its header.
fn with_chunk(png: &[u8], kind: &[u8; 4], contents: &[u8]) -> Vec<u8> {
    let body = [&kind[..], contents].concat();
    let checksum = Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(&body).to_be_bytes();
    [&png[..33], &(contents.len() as u32).to_be_bytes(), &body, &checksum, &png[33..]].concat()
}

/// A WebP of 160 x 120 px with these chunks in the place of its own, or beside them.
fn webp(flags: u8, chunks: &[&[u8]]) -> Vec<u8> {
    let head = [&b"VP8X\x0a\0\0\0"[..], &[flags, 0, 0, 0, 159, 0, 0, 119, 0, 0]].concat();
    let chunks = chunks.concat();
    let size = (4 + head.len() + chunks.len()) as u32;
    [&b"RIFF"[..], &size.to_le_bytes(), b"WEBP", &head, &chunks].concat()
}

/// EXIF data that say one thing: how the picture is turned.
fn exif(orientation: u8) -> Vec<u8> {
    [&b"MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0"[..], &[orientation], b"\0\0\0\0\0\0"].concat()
}

/// A TIFF of one strip without compression, as it lies in memory.
fn tiff(picture: &Mat, orientation: u16) -> Result<Vec<u8>, opencv::Error> {
    let pixels = picture.data_bytes()?;
    let (channels, bits) = (picture.channels() as u16, 8 * picture.elem_size1() as u16);
    let (width, height) = (picture.cols() as u16, picture.rows() as u16);
    // The bits of three channels stand behind the directory.
    let (count, behind) = (10u16, 8 + 2 + 10 * 12 + 4u32);
    let strip = behind + 6;
    let mut bytes = [&b"II*\0\x08\0\0\0"[..], &count.to_le_bytes()].concat();
    let mut tag = |number: u16, kind: u16, values: u32, value: u32| {
        bytes.extend([&number.to_le_bytes()[..], &kind.to_le_bytes(), &values.to_le_bytes(), &value.to_le_bytes()].concat());
    };
    tag(256, 3, 1, width.into());
    tag(257, 3, 1, height.into());
    tag(258, 3, channels.into(), if channels == 3 { behind } else { bits.into() });
    tag(259, 3, 1, 1);
    tag(262, 3, 1, if channels == 3 { 2 } else { 1 });
    tag(273, 4, 1, strip);
    tag(274, 3, 1, orientation.into());
    tag(277, 3, 1, channels.into());
    tag(278, 3, 1, height.into());
    tag(279, 4, 1, pixels.len() as u32);
    bytes.extend([0; 4]);
    (0..3).for_each(|_| bytes.extend(bits.to_le_bytes()));
    bytes.extend(pixels);
    Ok(bytes)
}

/// Protects measurements from half a picture: a JPEG of which a part was overwritten is refused as the only picture, as the first one, and in a sequence. OpenCV shows
/// something in its place. A PNG whose checksums are wrong is refused, and no library talks beside it.
#[test]
fn a_damaged_picture_is_refused() -> Outcome {
    let directory = tempfile::tempdir()?;
    for i in 18..21 {
        written(directory.path(), &format!("f_{i}.jpg"), &encoded(".jpg", &pour(i)?)?)?;
    }
    let (first, pattern) = (directory.path().join("f_18.jpg"), directory.path().join("f_%d.jpg"));
    let whole = std::fs::read(&first)?;
    assert_eq!(report(&inspect(directory.path(), &[&pattern], &[])?)?.0["frames"], 3);
    for (byte, length) in [(0, 4096), (0, 300), (0xff, 40), (0x5a, 300)] {
        let mut damaged = whole.clone();
        let at = damaged.len() / 2;
        damaged[at..at + length].fill(byte);
        std::fs::write(&first, damaged)?;
        refused(&inspect(directory.path(), &[&first], &[])?, &["f_18.jpg", "is damaged"]);
        refused(&inspect(directory.path(), &[&pattern], &[])?, &["f_18.jpg", "is damaged", "--partial"]);
        assert_eq!(report(&inspect(directory.path(), &[&pattern], &["--partial"])?)?.0["frames"], 2);
    }
    let mut png = encoded(".png", &pour(18)?)?;
    let profile = with_chunk(&png, b"iCCP", b"none\0\0nothing that unpacks");
    let (_, said) = report(&inspect(directory.path(), &[&written(directory.path(), "p.png", &profile)?], &[])?)?;
    assert!(said.is_empty(), "{said}");
    let at = png.len() / 2;
    png[at..at + 64].fill(0);
    refused(&inspect(directory.path(), &[&written(directory.path(), "p.png", &png)?], &[])?, &["p.png", "is damaged"]);
    Ok(())
}

/// Protects who takes pictures with a telephone: they are upright whatever the file's format, in each of the eight ways, deep and grey ones too.
#[test]
fn a_picture_is_turned_as_its_file_says() -> Outcome {
    let directory = tempfile::tempdir()?;
    let upright = corners()?;
    let turned = |picture: &Mat, code| {
        let mut out = Mat::default();
        core::rotate(picture, &mut out, code).map(|()| out)
    };
    let flipped = |picture: &Mat, code| {
        let mut out = Mat::default();
        core::flip(picture, &mut out, code).map(|()| out)
    };
    let transposed = flipped(&turned(&upright, core::ROTATE_90_CLOCKWISE)?, 1)?;
    // What is stored, by the number that EXIF has for the way back.
    let stored = [
        upright.clone(),
        flipped(&upright, 1)?,
        turned(&upright, core::ROTATE_180)?,
        flipped(&upright, 0)?,
        transposed.clone(),
        turned(&upright, core::ROTATE_90_COUNTERCLOCKWISE)?,
        turned(&transposed, core::ROTATE_180)?,
        turned(&upright, core::ROTATE_90_CLOCKWISE)?,
    ];
    for (number, picture) in (1u8..).zip(&stored) {
        let (mut grey, mut deep, mut deep_grey) = (Mat::default(), Mat::default(), Mat::default());
        imgproc::cvt_color_def(picture, &mut grey, imgproc::COLOR_BGR2GRAY)?;
        picture.convert_to(&mut deep, core::CV_16UC3, 257.0, 0.0)?;
        grey.convert_to(&mut deep_grey, core::CV_16UC1, 257.0, 0.0)?;
        let jpeg = encoded(".jpg", picture)?;
        let app = [&b"Exif\0\0"[..], &exif(number)].concat();
        let length = (app.len() as u16 + 2).to_be_bytes();
        let lossy = encoded(".webp", picture)?;
        let chunk = [&b"EXIF"[..], &(exif(number).len() as u32).to_le_bytes(), &exif(number)].concat();
        let mut wide = webp(8, &[&lossy[12..], &chunk]);
        (wide[24], wide[27]) = (picture.cols() as u8 - 1, picture.rows() as u8 - 1);
        for (name, bytes) in [
            ("p.jpg", [&jpeg[..2], &[0xff, 0xe1], &length, &app, &jpeg[2..]].concat()),
            ("p.png", with_chunk(&encoded(".png", picture)?, b"eXIf", &exif(number))),
            ("p.webp", wide),
            ("p.tif", tiff(picture, number.into())?),
            ("grey.tif", tiff(&grey, number.into())?),
            ("deep.tif", tiff(&deep, number.into())?),
            ("deep_grey.tif", tiff(&deep_grey, number.into())?),
        ] {
            let path = written(directory.path(), name, &bytes)?;
            assert_eq!(seen(&path)?, ((160, 120), UPRIGHT), "{name}, orientation {number}");
        }
    }
    Ok(())
}

/// Protects who has a film in one picture file: of a TIFF, PNG, WebP or PNM of several pictures not only the first is taken, without a word. A smaller copy
/// beside the picture is none.
#[test]
fn a_file_of_several_pictures_is_refused() -> Outcome {
    let directory = tempfile::tempdir()?;
    let pages = directory.path().join("pages.tif");
    let pictures: Vector<Mat> = [pour(1)?, pour(2)?].into_iter().collect();
    imgcodecs::imwrite(pages.to_str().ok_or("path")?, &pictures, &Vector::new())?;
    refused(&inspect(directory.path(), &[&pages], &[])?, &["pages.tif", "holds 2 pictures", "frame_%04d.png"]);
    let mut bytes = std::fs::read(&pages)?;
    // NewSubfileType of the second directory: a page of several, which becomes a smaller copy.
    let purpose = find(&bytes, &[0xfe, 0, 4, 0, 1, 0, 0, 0, 2, 0, 0, 0], 1);
    bytes[purpose + 8] = 1;
    std::fs::write(&pages, &bytes)?;
    assert_eq!(report(&inspect(directory.path(), &[&pages], &[])?)?.0["frames"], 1);
    let png = encoded(".png", &pour(1)?)?;
    let moving = with_chunk(&png, b"acTL", &[0, 0, 0, 3, 0, 0, 0, 0]);
    let frame = b"ANMF\x10\0\0\0\0\0\0\0\0\0\x9f\0\0\x77\0\0\x28\0\0\0";
    let ppm = encoded(".ppm", &pour(1)?)?;
    for (name, bytes, words) in [
        ("moving.png", moving, "holds 3 pictures"),
        ("moving.webp", webp(2, &[frame, frame]), "holds 2 pictures"),
        ("two.ppm", [&ppm[..], &ppm].concat(), "holds 2 pictures"),
    ] {
        refused(&inspect(directory.path(), &[&written(directory.path(), name, &bytes)?], &[])?, &[name, words]);
    }
    Ok(())
}

/// Protects the light of pictures of industrial cameras: half of the largest value is half as bright as white, whatever that value is, in files of bytes and of text;
/// bits are black and white.
#[test]
fn pnm_is_as_bright_as_it_says() -> Outcome {
    let directory = tempfile::tempdir()?;
    let level = |name: &str, bytes: &[u8]| -> Result<u8, Box<dyn std::error::Error>> {
        let mut recording = Recording::open(&written(directory.path(), name, bytes)?, 30.0, false)?;
        let frame = recording.next_frame()?.ok_or("no frame")?;
        assert!(frame.pixels.iter().all(|pixel| pixel.abs_diff(frame.pixels[0]) <= 1), "{name}");
        Ok(frame.pixels[0])
    };
    for largest in [1u32, 100, 255, 256, 1023, 4095, 65535] {
        for (kind, channels) in [(2, 1), (3, 3), (5, 1), (6, 3)] {
            let half = largest.div_ceil(2);
            let expected = (f64::from(half) * 255.0 / f64::from(largest)).round() as u8;
            let values = 16 * 8 * channels;
            let mut bytes = format!("P{kind}\n# a comment\n16 8\n{largest}\n").into_bytes();
            match (kind < 5, largest < 256) {
                (true, _) => bytes.extend(format!("{half} ").repeat(values).bytes()),
                (false, true) => bytes.extend(vec![half as u8; values]),
                (false, false) => bytes.extend((half as u16).to_be_bytes().repeat(values)),
            }
            let found = level("p.pnm", &bytes)?;
            assert!(found.abs_diff(expected) <= 1, "P{kind} of {largest}: {found}, not {expected}");
        }
    }
    assert_eq!(
        (level("p.pbm", b"P4 16 8 \0\0\0\0\0\0\0\0\0\0\0\0\0\0\0\0")?, level("p.pbm", &[b"P1 2 2 ", &b"1 1 1 1"[..]].concat())?),
        (255, 0)
    );
    Ok(())
}
