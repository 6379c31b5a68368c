//! Calibration on drawn pours: the container's edges, the liquid's colour, the written section.

mod drawn;

use std::path::Path;
use std::process::{Command, Output};

use drawn::{Outcome, pour, write_config};
use feature_worker::vision::{Axes, ColourLearner, Extractor, Image, RoomBeside, find_corner, room_beside};
use opencv::core::{Mat, Rect, Vector};
use opencv::imgcodecs;
use opencv::prelude::*;
use shared::config::{Config, LiquidMethod};

fn frames(directory: &Path) -> Result<String, Box<dyn std::error::Error>> {
    for i in 0..40 {
        imgcodecs::imwrite(directory.join(format!("f_{i:03}.png")), &pour(i)?, &Vector::new())?;
    }
    Ok(directory.join("f_%03d.png").display().to_string())
}

fn calibrate(config: &Path, picture: &Path, more: &[&str]) -> std::io::Result<Output> {
    let mut command = Command::new(env!("CARGO_BIN_EXE_feature-worker"));
    command.arg("calibrate").args(more).arg("--config").arg(config).arg("--picture").arg(picture).output()
}

/// Protects the five minutes that calibration may take: from one pour the corner is found within 2 px and the axes within 1 degree, and the
/// liquid's colour as a range that measures the pour; the region has room beside the lip and below it. The section is written, and the rest of the file, comments too, stays as it was.
#[test]
fn one_pour_is_enough() -> Outcome {
    let directory = tempfile::tempdir()?;
    let pattern = frames(directory.path())?;
    let (path, _) = write_config(directory.path(), "calibrate", |c| {
        c.image.colour_hsv = [0, 0, 0, 10, 20, 20];
        c.image.x_axis_px = [100.0, 100.0, 200.0, 110.0];
    })?;
    let text = std::fs::read_to_string(&path)?.replace("[robot]", "# the robot in cell 7\n[robot]");
    std::fs::write(&path, &text)?;
    let before = Config::read(&path)?;
    let picture = directory.path().join("look.png");
    let output = calibrate(&path, &picture, &["--write", &pattern])?;
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.success(), "{said}");
    assert!(String::from_utf8_lossy(&output.stdout).starts_with("[image]"), "{said}");
    let after = Config::read(&path)?;
    let axes = Axes::new(&after.image);
    assert!((axes.lip_px[0] - 215.0).abs() < 2.0 && (axes.lip_px[1] - 250.0).abs() < 2.0, "{axes:?}");
    assert!(axes.x[1].abs() < 0.0175 && axes.y[0].abs() < 0.0175 && axes.x[0] > 0.0 && axes.y[1] < 0.0, "{axes:?}");
    assert_eq!(room_beside(&after.camera, &after.image), RoomBeside::Enough);
    assert!(imgcodecs::imread(&picture, imgcodecs::IMREAD_COLOR)?.cols() == 640);
    assert_eq!(Config { image: before.image.clone(), ..after.clone() }, before);
    assert!(std::fs::read_to_string(&path)?.contains("# the robot in cell 7"));
    let mut extractor = Extractor::new(&after.camera, &after.image)?;
    let frame = pour(20)?;
    let measured = extractor.measure(Image {
        width_px: 640,
        height_px: 480,
        format: shared::messages::PixelFormat::Bgr8,
        pixels: frame.data_bytes()?,
    })?;
    assert!((measured.area_px2 / 3600.0 - 1.0).abs() < 0.06, "{measured:?}");
    Ok(())
}

/// Protects people whose container is not found: coordinates are taken as they are given, and nothing is written without --write.
#[test]
fn coordinates_are_taken_and_nothing_is_written_unasked() -> Outcome {
    let directory = tempfile::tempdir()?;
    let pattern = frames(directory.path())?;
    let (path, _) = write_config(directory.path(), "given", |_| {})?;
    let before = std::fs::read(&path)?;
    let points = ["--lip", "214,251", "--x-axis", "590,252", "--y-axis", "216,460", &pattern];
    let output = calibrate(&path, &directory.path().join("look.png"), &points)?;
    let section = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(output.status.success() && section.contains("x_axis_px = [214.0, 251.0, 590.0, 252.0]"), "{section}");
    assert_eq!(std::fs::read(&path)?, before);
    let output = calibrate(&path, &directory.path().join("look.png"), &["--lip", "somewhere", &pattern])?;
    assert_eq!(output.status.code(), Some(2));
    Ok(())
}

/// Protects from a hand in a glove over a dry glass, which has edge and colour of a stream: what the glass below the lip does not hold is said. With
/// the liquid in it, nothing is.
#[test]
fn a_stream_that_the_glass_does_not_hold_is_said() -> Outcome {
    let directory = tempfile::tempdir()?;
    let (path, _) = write_config(directory.path(), "glove", |_| {})?;
    for holds in [true, false] {
        let pattern = frames(directory.path())?;
        for i in (0..40).filter(|_| !holds) {
            let (mut picture, dry) = (pour(i)?, drawn::dry(i as f32, i)?);
            let inside = Rect::new(218, 253, 400, 220);
            dry.roi(inside)?.copy_to(&mut picture.roi_mut(inside)?)?;
            imgcodecs::imwrite(directory.path().join(format!("f_{i:03}.png")), &picture, &Vector::new())?;
        }
        let output = calibrate(&path, &directory.path().join("look.png"), &[&pattern])?;
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert!(output.status.success(), "{said}");
        assert_eq!(said.contains("of the glass below the lip while something flows"), !holds, "{said}");
    }
    Ok(())
}

/// Protects a pour that was shown: a page's port that is taken, and a picture that cannot be written, are said before anything is looked at.
#[test]
fn nothing_is_lost_to_a_port_or_a_picture() -> Outcome {
    let directory = tempfile::tempdir()?;
    let pattern = frames(directory.path())?;
    let (path, _) = write_config(directory.path(), "kept", |_| {})?;
    let taken = std::net::TcpListener::bind(("127.0.0.1", 0))?;
    let port = taken.local_addr()?.port().to_string();
    let output = calibrate(&path, &directory.path().join("look.png"), &["--page", "--port", &port, &pattern])?;
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!((output.status.code(), output.stdout.len(), said.lines().count()), (Some(1), 0, 1), "{said}");
    assert!(said.contains("give another --port") && !directory.path().join("look.png").exists(), "{said}");
    let output = calibrate(&path, &directory.path().join("look.none"), &[&pattern])?;
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!((output.status.code(), output.stdout.len(), said.lines().count()), (Some(2), 0, 1), "{said}");
    Ok(())
}

/// Protects people from a calibration that means nothing: frames without edges and a pour without liquid are refused, and the error says
/// what to do instead.
#[test]
fn nothing_to_see_is_said() -> Outcome {
    let flat = Mat::new_rows_cols_with_default(480, 640, opencv::core::CV_8UC3, opencv::core::Scalar::all(128.0))?;
    let said = find_corner(&flat).expect_err("found a corner in nothing").to_string();
    assert!(said.contains("--lip") && said.contains("--page"), "{said}");
    let mut learner = ColourLearner::new(Axes::new(&drawn::image_config(LiquidMethod::Colour)));
    for i in 0..8 {
        learner.add(&drawn::dry(i as f32 * 4.0, i)?)?;
    }
    let said = learner.range().expect_err("found a colour in grey").to_string();
    assert!(said.contains("one whole pour") && said.contains("--method clear"), "{said}");
    Ok(())
}
