//! Recordings of which something is missing, turned and unevenly timed ones, and the project's own episodes, in `feature-worker inspect` run
//! as a process. The files are made here, by OpenCV's writers; what those cannot write is put into their bytes.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines, clippy::type_complexity)]

mod drawn;
mod matroska;
mod pictures;
mod streams;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};

use drawn::{HEIGHT, Outcome, WIDTH, pour, write_config};
use feature_worker::source::Recording;
use opencv::core::{self, Mat, Rect, Scalar, Size, Vector};
use opencv::prelude::*;
use opencv::videoio::{CAP_FFMPEG, VideoWriter};
use opencv::{imgcodecs, imgproc};
use shared::episode::{EpisodeEnd, EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow};
use shared::messages::{Feature, LAYOUT_VERSION, Telemetry};

const FRAMES: i32 = 24;

fn inspect(directory: &Path, input: &[&Path], more: &[&str]) -> Result<Output, Box<dyn std::error::Error>> {
    let (config, _) = write_config(directory, "recordings", |_| {})?;
    let mut command = Command::new(env!("CARGO_BIN_EXE_feature-worker"));
    command.args(["inspect", "--json", "--every", "0", "--config"]).arg(config).arg("--out").arg(directory.join("out"));
    Ok(command.args(more).args(input).output()?)
}

fn text(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

/// Asserts the exit code of bad input, and that all that is said is one line with all `words`: no decoder talks beside it.
fn refused(output: &Output, words: &[&str]) {
    let said = text(output);
    assert_eq!(output.status.code(), Some(2), "{said}");
    assert!(said.lines().count() == 1 && said.starts_with("error:"), "{said}");
    assert!(words.iter().all(|w| said.contains(w)), "{words:?} in {said}");
}

/// The report of a run that succeeded, and the lines on standard error.
fn report(output: &Output) -> Result<(serde_json::Value, String), Box<dyn std::error::Error>> {
    assert!(output.status.success(), "{}", text(output));
    Ok((serde_json::from_slice(&output.stdout)?, String::from_utf8_lossy(&output.stderr).into_owned()))
}

/// The columns `frame` and `t_s` of the table.
fn times(directory: &Path) -> Result<Vec<(u64, f64)>, Box<dyn std::error::Error>> {
    let mut rows = csv::Reader::from_path(directory.join("out/features.csv"))?;
    rows.records().map(|r| r.map_err(Into::into).and_then(|r| Ok((r[0].parse()?, r[1].parse()?)))).collect()
}

fn video(path: &Path, codec: [char; 4], fps: f64) -> Outcome {
    let [a, b, c, d] = codec;
    let name = path.to_str().ok_or("path")?;
    let mut writer =
        VideoWriter::new_with_backend(name, CAP_FFMPEG, VideoWriter::fourcc(a, b, c, d)?, fps, Size::new(WIDTH, HEIGHT), true)?;
    for i in 0..FRAMES {
        writer.write(&pour(i)?)?;
    }
    Ok(writer.release()?)
}

fn find(bytes: &[u8], word: &[u8], nth: usize) -> usize {
    bytes.windows(word.len()).enumerate().filter(|(_, w)| *w == word).nth(nth).expect("there").0
}

/// Protects who measures a recording that is not whole: a video that is cut, in each container, is refused with the frame after which it
/// ends, and no table is left. With --partial the frames that are there are measured, and what is missing is said.
#[test]
fn a_cut_video_says_after_which_frame() -> Outcome {
    let directory = tempfile::tempdir()?;
    for (name, codec, of) in
        [("a.avi", ['M', 'J', 'P', 'G'], " of 24"), ("b.mkv", ['m', 'p', '4', 'v'], ""), ("c.avi", ['X', 'V', 'I', 'D'], " of 24")]
    {
        let path = directory.path().join(name);
        video(&path, codec, 30.0)?;
        let whole = inspect(directory.path(), &[&path], &[])?;
        let (whole, said) = report(&whole)?;
        assert!(whole["frames"] == FRAMES && said.is_empty(), "{name}: {whole} {said}");
        let bytes = std::fs::read(&path)?;
        std::fs::write(&path, &bytes[..bytes.len() / 2])?;
        std::fs::remove_dir_all(directory.path().join("out"))?;
        refused(&inspect(directory.path(), &[&path], &[])?, &[name, "ends after frame", of, "truncated", "--partial"]);
        assert!(!directory.path().join("out/features.csv").exists(), "{name}");
        let (part, said) = report(&inspect(directory.path(), &[&path], &["--partial"])?)?;
        let frames = part["frames"].as_u64().unwrap_or(0);
        assert!((3..FRAMES as u64).contains(&frames) && said.contains(&format!("ends after frame {frames}")), "{part} {said}");
        assert_eq!(part["missing"].as_array().map(Vec::len), Some(1), "{part}");
    }
    let path = directory.path().join("d.mp4");
    video(&path, ['m', 'p', '4', 'v'], 30.0)?;
    let bytes = std::fs::read(&path)?;
    std::fs::write(&path, &bytes[..bytes.len() / 2])?;
    refused(&inspect(directory.path(), &[&path], &[])?, &["d.mp4", "truncated", "index"]);
    Ok(())
}

/// Protects the numbers of frames: a picture in the middle of a video that cannot be decoded, or that is gone, is an error that says where, or
/// with --partial is said. OpenCV ends there, or goes on with the next picture, and says nothing.
#[test]
fn a_picture_that_cannot_be_decoded_is_said() -> Outcome {
    let directory = tempfile::tempdir()?;
    let path = directory.path().join("hole.avi");
    video(&path, ['M', 'J', 'P', 'G'], 30.0)?;
    let whole = std::fs::read(&path)?;
    let mut damaged = whole.clone();
    let at = find(&whole, b"00dc", 9);
    let length = u32::from_le_bytes(whole[at + 4..at + 8].try_into()?) as usize;
    damaged[at + 8..at + 8 + length].fill(0);
    std::fs::write(&path, &damaged)?;
    refused(&inspect(directory.path(), &[&path], &[])?, &["hole.avi", "frame 9 (at 0.27 s) is missing, or cannot be decoded", "--partial"]);
    let (part, said) = report(&inspect(directory.path(), &[&path], &["--partial"])?)?;
    assert!(part["frames"] == FRAMES - 1 && said.contains("1 of 24 frames"), "{part} {said}");
    let numbers: Vec<u64> = times(directory.path())?.into_iter().map(|(number, _)| number).collect();
    assert_eq!(numbers, (1..=24).filter(|number| *number != 9).collect::<Vec<_>>(), "what follows is taken too");
    // The second half of these places is the index.
    let mut gone = whole.clone();
    for nth in [9, 10, 24 + 9, 24 + 10] {
        let at = find(&whole, b"00dc", nth);
        gone[at..at + 4].copy_from_slice(b"JUNK");
    }
    std::fs::write(&path, &gone)?;
    refused(&inspect(directory.path(), &[&path], &[])?, &["hole.avi", "frame 22 of 24", "--partial"]);
    assert_eq!(report(&inspect(directory.path(), &[&path], &["--partial"])?)?.0["frames"], FRAMES - 2);
    Ok(())
}

/// Protects the controller, which counts time in frames: a recording that is played at another rate than `camera.fps`, by more than 5 %, is refused
/// with the rate to write. One that is nearer is played.
#[test]
fn a_recording_at_another_rate_is_not_played() -> Outcome {
    let directory = tempfile::tempdir()?;
    for (rate, plays) in [(28.0, false), (29.0, true), (31.0, true), (32.0, false)] {
        let path = directory.path().join("played.avi");
        video(&path, ['M', 'J', 'P', 'G'], rate)?;
        let (config, written) = write_config(directory.path(), "rate", |c| {
            (c.camera.source, c.camera.path) = (shared::config::CameraSource::Video, path.display().to_string());
        })?;
        let output = Command::new(env!("CARGO_BIN_EXE_feature-worker")).args(["run", "--config"]).arg(&config).output()?;
        shared::ipc::remove_files(&written.cell.name);
        if plays {
            assert!(output.status.success(), "{rate}: {}", text(&output));
        } else {
            let said = text(&output);
            assert_eq!(output.status.code(), Some(2), "{rate}: {said}");
            assert!(said.contains(&format!("played.avi: it has {rate:.2} frames a second, but camera.fps = 30")), "{said}");
        }
    }
    Ok(())
}

/// Puts the other time steps into an MP4 file whose index is at its end: `steps` of (number of pictures, units).
fn set_steps(bytes: &[u8], steps: &[(u32, u32)]) -> Vec<u8> {
    let at = find(bytes, b"stts", 0) - 4;
    let old = u32::from_be_bytes(bytes[at..at + 4].try_into().unwrap()) as usize;
    let mut new = Vec::from((16 + 8 * steps.len() as u32).to_be_bytes());
    new.extend(b"stts\0\0\0\0");
    new.extend((steps.len() as u32).to_be_bytes());
    new.extend(steps.iter().flat_map(|(count, units)| [count.to_be_bytes(), units.to_be_bytes()].concat()));
    let mut after = [&bytes[..at], &new, &bytes[at + old..]].concat();
    for kind in [b"moov", b"trak", b"mdia", b"minf", b"stbl"] {
        let at = find(&after, kind, 0) - 4;
        let size = u32::from_be_bytes(after[at..at + 4].try_into().unwrap()) + new.len() as u32 - old as u32;
        after[at..at + 4].copy_from_slice(&size.to_be_bytes());
    }
    after
}

/// Protects times: they are the file's own, at 15 Hz and at a variable rate, and not those of the configured camera. Pictures without times
/// are the configured rate apart.
#[test]
fn times_are_the_files_own() -> Outcome {
    let directory = tempfile::tempdir()?;
    for (name, codec) in [("slow.avi", ['M', 'J', 'P', 'G']), ("slow.mp4", ['m', 'p', '4', 'v']), ("slow.mkv", ['m', 'p', '4', 'v'])] {
        let path = directory.path().join(name);
        video(&path, codec, 15.0)?;
        report(&inspect(directory.path(), &[&path], &[])?)?;
        for (number, t_s) in times(directory.path())? {
            assert!((t_s - (number - 1) as f64 / 15.0).abs() < 1e-3, "{name}: frame {number} at {t_s}");
        }
    }
    // Ten pictures at 15 Hz, then one each fifth of a second: the scale of OpenCV's writer is a multiple of the rate.
    let path = directory.path().join("slow.mp4");
    let bytes = std::fs::read(&path)?;
    let unit = find(&bytes, b"stts", 0);
    let step = u32::from_be_bytes(bytes[unit + 16..unit + 20].try_into()?);
    let mut uneven = set_steps(&bytes, &[(10, step), (FRAMES as u32 - 10, 3 * step)]);
    // The track's duration, also that of its edit list, ms: the writer's scale is that.
    let duration_ms = ((10.0 / 15.0 + (FRAMES - 10) as f64 / 5.0) * 1e3) as u32;
    for at in [find(&uneven, b"elst", 0) + 12, find(&uneven, b"tkhd", 0) + 24] {
        uneven[at..at + 4].copy_from_slice(&duration_ms.to_be_bytes());
    }
    std::fs::write(&path, &uneven)?;
    assert!(report(&inspect(directory.path(), &[&path], &[])?)?.1.is_empty());
    let all = times(directory.path())?;
    assert_eq!(all.len(), FRAMES as usize);
    for (number, t_s) in all {
        let expected = (number - 1).min(10) as f64 / 15.0 + number.saturating_sub(11) as f64 / 5.0;
        assert!((t_s - expected).abs() < 1e-3, "frame {number} at {t_s}, not {expected}");
    }
    Ok(())
}

/// A picture that is not like itself turned or mirrored: white, with a dark corner and a grey one.
fn corners() -> Result<Mat, opencv::Error> {
    let mut picture = Mat::new_rows_cols_with_default(120, 160, core::CV_8UC3, Scalar::all(230.0))?;
    imgproc::rectangle(&mut picture, Rect::new(0, 0, 60, 40), Scalar::all(20.0), imgproc::FILLED, 8, 0)?;
    imgproc::rectangle(&mut picture, Rect::new(100, 0, 60, 40), Scalar::all(120.0), imgproc::FILLED, 8, 0)?;
    Ok(picture)
}

/// The size of the first frame of a recording, and the levels in its corners, rounded: upper left, upper right, lower left, lower right.
fn seen(path: &Path) -> Result<((u32, u32), [u32; 4]), Box<dyn std::error::Error>> {
    let mut recording = Recording::open(path, 30.0, false)?;
    let frame = recording.next_frame()?.ok_or("no frame")?;
    let (width, height) = (frame.header.width_px, frame.header.height_px);
    let channels = frame.pixels.len() / (width * height) as usize;
    let level = |x: u32, y: u32| (u32::from(frame.pixels[(y * width + x) as usize * channels]) + 25) / 50;
    let corners = [level(9, 9), level(width - 9, 9), level(9, height - 9), level(width - 9, height - 9)];
    Ok(((width, height), corners))
}

/// The upright picture, and what its corners are after each of the eight ways to turn it, by the number that EXIF has for the way back.
const UPRIGHT: [u32; 4] = [0, 2, 5, 5];

/// Protects who films upright with a telephone: a video is turned as its metadata say, in each of the eight ways, and OpenCV's own turn, which
/// is the wrong way round in some versions, is not used. An odd angle is refused.
#[test]
fn a_video_is_turned_as_its_metadata_say() -> Outcome {
    let directory = tempfile::tempdir()?;
    let path = directory.path().join("turned.mp4");
    // What the file stores, and the matrix (a, b, c, d) that brings it upright: (x, y) goes to (a x + c y, b x + d y).
    let [turn, flip] = [
        |p: &Mat, code| {
            let mut out = Mat::default();
            core::rotate(p, &mut out, code).map(|()| out)
        },
        |p: &Mat, code| {
            let mut out = Mat::default();
            core::flip(p, &mut out, code).map(|()| out)
        },
    ];
    let upright = corners()?;
    let transposed = flip(&turn(&upright, core::ROTATE_90_CLOCKWISE)?, 1)?;
    let cases = [
        (upright.clone(), [1, 0, 0, 1]),
        (turn(&upright, core::ROTATE_90_COUNTERCLOCKWISE)?, [0, 1, -1, 0]),
        (turn(&upright, core::ROTATE_180)?, [-1, 0, 0, -1]),
        (turn(&upright, core::ROTATE_90_CLOCKWISE)?, [0, -1, 1, 0]),
        (flip(&upright, 1)?, [-1, 0, 0, 1]),
        (flip(&upright, 0)?, [1, 0, 0, -1]),
        (transposed.clone(), [0, 1, 1, 0]),
        (turn(&transposed, core::ROTATE_180)?, [0, -1, -1, 0]),
        (upright, [1, 1, -1, 1]),
    ];
    for (stored, matrix) in cases {
        let name = path.to_str().ok_or("path")?;
        let mut writer =
            VideoWriter::new_with_backend(name, CAP_FFMPEG, VideoWriter::fourcc('m', 'p', '4', 'v')?, 30.0, stored.size()?, true)?;
        for _ in 0..3 {
            writer.write(&stored)?;
        }
        writer.release()?;
        let mut bytes = std::fs::read(&path)?;
        let at = find(&bytes, b"tkhd", 0) + 4 + 40;
        for (place, value) in [0, 4, 12, 16].into_iter().zip(matrix) {
            bytes[at + place..at + place + 4].copy_from_slice(&(value * 65536i32).to_be_bytes());
        }
        std::fs::write(&path, &bytes)?;
        if matrix == [1, 1, -1, 1] {
            let said = Recording::open(&path, 30.0, false).err().ok_or("accepted")?.to_string();
            assert!(said.contains("turned.mp4") && said.contains("turn"), "{said}");
        } else {
            assert_eq!(seen(&path)?, ((160, 120), UPRIGHT), "{matrix:?}");
        }
    }
    Ok(())
}

/// Protects sequences: a picture is read alike alone and in a sequence: turned by its EXIF orientation, with 16 bits a channel, with alpha,
/// in grey.
#[test]
fn pictures_are_alike_alone_and_in_a_sequence() -> Outcome {
    let directory = tempfile::tempdir()?;
    let upright = corners()?;
    let mut stored = Mat::default();
    core::rotate(&upright, &mut stored, core::ROTATE_90_COUNTERCLOCKWISE)?;
    let mut jpeg = Vector::<u8>::new();
    imgcodecs::imencode_def(".jpg", &stored, &mut jpeg)?;
    let jpeg = jpeg.to_vec();
    let exif = [&[0xff, 0xe1, 0, 34][..], b"Exif\0\0MM\0*\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0\x06\0\0\0\0\0\0"].concat();
    std::fs::write(directory.path().join("e_1.jpg"), [&jpeg[..2], &exif, &jpeg[2..]].concat())?;
    let (mut deep, mut alpha, mut grey) = (Mat::default(), Mat::default(), Mat::default());
    upright.convert_to(&mut deep, core::CV_16UC3, 257.0, 0.0)?;
    imgproc::cvt_color_def(&upright, &mut alpha, imgproc::COLOR_BGR2BGRA)?;
    imgproc::cvt_color_def(&upright, &mut grey, imgproc::COLOR_BGR2GRAY)?;
    for (name, picture) in [("d_1.png", &deep), ("a_1.png", &alpha), ("g_1.png", &grey), ("t_1.tif", &deep)] {
        imgcodecs::imwrite_def(directory.path().join(name), picture)?;
    }
    for (file, pattern) in
        [("e_1.jpg", "e_%d.jpg"), ("d_1.png", "d_%d.png"), ("a_1.png", "a_%d.png"), ("g_1.png", "g_%d.png"), ("t_1.tif", "t_%d.tif")]
    {
        assert_eq!(seen(&directory.path().join(file))?, ((160, 120), UPRIGHT), "{file}");
        assert_eq!(seen(&directory.path().join(pattern))?, ((160, 120), UPRIGHT), "{pattern}");
    }
    Ok(())
}

fn sequence(directory: &Path, numbers: impl Iterator<Item = i32>) -> Result<PathBuf, Box<dyn std::error::Error>> {
    for i in numbers {
        imgcodecs::imwrite(directory.join(format!("f_{i:03}.jpg")), &pour(i)?, &Vector::new())?;
    }
    Ok(directory.join("f_%03d.jpg"))
}

/// Protects a sequence's frames: a gap in its numbers and a picture that is cut off are errors that name it. OpenCV ends a sequence at its first
/// gap, and shows the upper part of a JPEG that is cut off. With --partial they are gaps in the numbers and in time.
#[test]
fn a_gap_in_a_sequence_is_named() -> Outcome {
    let directory = tempfile::tempdir()?;
    let pattern = sequence(directory.path(), (7..20).filter(|i| ![9, 12, 13].contains(i)))?;
    refused(&inspect(directory.path(), &[&pattern], &[])?, &["f_%03d.jpg", "numbers 7 to 19", "3 missing: 9, 12 to 13", "--partial"]);
    let (part, said) = report(&inspect(directory.path(), &[&pattern], &["--partial"])?)?;
    assert!(part["frames"] == 10 && said.contains("3 pictures missing"), "{part} {said}");
    let all = times(directory.path())?;
    assert_eq!(all.iter().map(|(n, _)| *n).collect::<Vec<_>>(), [1, 2, 4, 5, 8, 9, 10, 11, 12, 13]);
    assert!((all[9].1 - 0.4).abs() < 1e-3, "{all:?}");

    let pattern = sequence(directory.path(), [9, 12, 13].into_iter())?;
    assert_eq!(report(&inspect(directory.path(), &[&pattern], &[])?)?.0["frames"], 13);
    let damaged = directory.path().join("f_011.jpg");
    let bytes = std::fs::read(&damaged)?;
    for part in [bytes.len() / 2, bytes.len() - 2, 100, 0] {
        std::fs::write(&damaged, &bytes[..part])?;
        refused(&inspect(directory.path(), &[&pattern], &[])?, &["f_011.jpg", "--partial"]);
        refused(&inspect(directory.path(), &[&damaged], &[])?, &["f_011.jpg"]);
    }
    let (part, said) = report(&inspect(directory.path(), &[&pattern], &["--partial"])?)?;
    assert!(part["frames"] == 12 && said.contains("1 cannot be read (11)"), "{part} {said}");
    Ok(())
}

/// Protects files with a `%` in their names, which are no patterns.
#[test]
fn a_percent_sign_makes_no_pattern() -> Outcome {
    let directory = tempfile::tempdir()?;
    for name in ["50% milk.avi", "100%d.avi"] {
        let path = directory.path().join(name);
        video(&path, ['M', 'J', 'P', 'G'], 30.0)?;
        assert_eq!(report(&inspect(directory.path(), &[&path], &[])?)?.0["frames"], FRAMES, "{name}");
    }
    refused(&inspect(directory.path(), &[&directory.path().join("20% off.avi")], &[])?, &["20% off.avi", "no such file"]);
    Ok(())
}

/// Protects who has episodes and no video: `inspect` takes the project's own MCAP, with the camera's numbers and times. One whose end is
/// missing is refused, or taken in part.
#[test]
fn an_episode_is_a_recording() -> Outcome {
    let directory = tempfile::tempdir()?;
    let (_, config) = write_config(directory.path(), "recordings", |_| {})?;
    let kind = EpisodeKind::Pour { goal_ml: 50.0 };
    let start =
        EpisodeStart { episode: 1, kind, started_at_ns: 1_000_000_000, wall_clock: std::time::UNIX_EPOCH, config: &config, weights: "" };
    let mut writer = EpisodeWriter::create(directory.path(), &start)?;
    for i in (0..FRAMES).filter(|i| *i != 5) {
        let at_ns = 1_000_000_000 + i as u64 * 40_000_000;
        writer.telemetry(&Telemetry { version: LAYOUT_VERSION, tick: i as u64 + 1, at_ns, robot_at_ns: at_ns, ..Default::default() })?;
        let mut bytes = Vector::<u8>::new();
        imgcodecs::imencode_def(".jpg", &pour(i)?, &mut bytes)?;
        let feature =
            Feature { version: LAYOUT_VERSION, sequence: i as u64 + 100, captured_at_ns: at_ns + 5_000_000, ..Default::default() };
        let image = bytes.to_vec();
        writer.frame(&FrameRow { feature: &feature, alpha_commanded_deg: 0.0, alpha_measured_deg: 0.0, image: Some(("jpeg", &image)) })?;
        if i == 20 {
            writer.flush()?;
            std::fs::copy(writer.path(), directory.path().join("cut.mcap"))?;
        }
    }
    let path = writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 })?;
    let (whole, said) = report(&inspect(directory.path(), &[&path], &[])?)?;
    assert!(whole["frames"] == FRAMES - 1 && whole["flowing"].as_u64() > Some(10) && said.is_empty(), "{whole} {said}");
    let all = times(directory.path())?;
    assert_eq!(all.iter().map(|(n, _)| *n).collect::<Vec<_>>(), (1..=24).filter(|n| *n != 6).collect::<Vec<_>>());
    assert!(all.iter().all(|(n, t)| (t - (n - 1) as f64 * 0.04).abs() < 1e-3), "{all:?}");
    let cut = directory.path().join("cut.mcap");
    refused(&inspect(directory.path(), &[&cut], &[])?, &["cut.mcap", "its end is missing", "--partial"]);
    assert!(report(&inspect(directory.path(), &[&cut], &["--partial"])?)?.1.contains("its end is missing"));
    Ok(())
}

/// Protects the memory from a small file that unpacks to much: a picture with more pixels than any camera has is refused, and one of as many is read.
#[test]
fn a_picture_of_too_many_pixels_is_refused() -> Outcome {
    let directory = tempfile::tempdir()?;
    let draw = |name: &str, side_px: i32| -> Result<PathBuf, Box<dyn std::error::Error>> {
        let path = directory.path().join(name);
        let picture = Mat::new_size_with_default(Size::new(side_px, side_px), core::CV_8UC3, Scalar::all(40.0))?;
        imgcodecs::imwrite(path.to_str().ok_or("path")?, &picture, &Vector::new())?;
        Ok(path)
    };
    let (largest, larger) = (draw("largest.png", 4096)?, draw("larger.png", 4097)?);
    assert!(!text(&inspect(directory.path(), &[&largest], &[])?).contains("read"), "as many as [camera] allows");
    refused(&inspect(directory.path(), &[&larger], &[])?, &["larger.png", "4097 x 4097 px are too many"]);
    Ok(())
}
