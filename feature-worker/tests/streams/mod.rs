//! Videos with gaps in their times, with a rate that varies, and streams that have no times at all.

use std::path::Path;
use std::process::Command;

use feature_worker::source::Recording;
use opencv::core::Vector;
use opencv::imgcodecs;
use opencv::prelude::*;

use super::matroska::blocks;
use super::{FRAMES, Outcome, find, inspect, pour, refused, report, set_steps, text, times, video, write_config};

/// An MP4 at 25 Hz whose index leaves out two pictures behind the eleventh.
fn with_gap(path: &Path) -> Result<Vec<u8>, Box<dyn std::error::Error>> {
    video(path, ['m', 'p', '4', 'v'], 25.0)?;
    let bytes = std::fs::read(path)?;
    let at = find(&bytes, b"stts", 0);
    let step = u32::from_be_bytes(bytes[at + 16..at + 20].try_into()?);
    let mut gap = set_steps(&bytes, &[(10, step), (1, 3 * step), (FRAMES as u32 - 11, step)]);
    // The track's duration, also that of its edit list, ms.
    for at in [find(&gap, b"elst", 0) + 12, find(&gap, b"tkhd", 0) + 24] {
        gap[at..at + 4].copy_from_slice(&((FRAMES as u32 + 2) * 40).to_be_bytes());
    }
    Ok(gap)
}

/// A number of an MP4's index.
fn number(bytes: &[u8], at: usize) -> usize {
    u32::from_be_bytes(bytes[at..at + 4].try_into().expect("four bytes")) as usize
}

/// Where the pictures of an MP4 lie that has them one behind the other.
fn samples(bytes: &[u8]) -> Vec<std::ops::Range<usize>> {
    let (chunks, sizes) = (find(bytes, b"stco", 0), find(bytes, b"stsz", 0));
    assert_eq!(number(bytes, chunks + 8), 1, "one chunk");
    let mut at = number(bytes, chunks + 12);
    let lengths = (0..number(bytes, sizes + 12)).map(|i| number(bytes, sizes + 16 + 4 * i));
    lengths.map(|length| (at, at += length).0..at).collect()
}

/// Protects who films with a telephone or a recorder that drops a picture: where the file's own index says the long step, the file is taken and played, the gap is in
/// the numbers, and it is said.
#[test]
fn a_gap_of_the_index_is_numbered() -> Outcome {
    let directory = tempfile::tempdir()?;
    let path = directory.path().join("gap.mp4");
    let gap = with_gap(&path)?;
    std::fs::write(&path, gap)?;
    let words = "gap.mp4: 2 of 26 frames were never recorded";
    let (all, said) = report(&inspect(directory.path(), &[&path], &[])?)?;
    assert!(all["frames"] == FRAMES && said.contains(words) && said.lines().count() == 1, "{all} {said}");
    let all = times(directory.path())?;
    assert_eq!(all.iter().map(|(number, _)| *number).collect::<Vec<_>>(), (1..=26).filter(|n| ![12, 13].contains(n)).collect::<Vec<_>>());
    assert!(all.iter().all(|(number, t_s)| (t_s - (number - 1) as f64 * 0.04).abs() < 2e-3), "{all:?}");
    let (config, written) = write_config(directory.path(), "gap", |c| {
        (c.camera.source, c.camera.path, c.camera.fps) = (shared::config::CameraSource::Video, path.display().to_string(), 25.0);
    })?;
    let played = Command::new(env!("CARGO_BIN_EXE_feature-worker")).args(["run", "--config"]).arg(&config).output()?;
    shared::ipc::remove_files(&written.cell.name);
    assert!(played.status.success() && text(&played).contains(words), "{}", text(&played));
    Ok(())
}

/// Protects measurements from pictures that the index has and that cannot be decoded, or lie behind a file's end: they are refused also in a file whose index leaves others
/// out, and with --partial neither is hidden by the other.
#[test]
fn what_an_index_promises_is_looked_for() -> Outcome {
    let directory = tempfile::tempdir()?;
    let path = directory.path().join("gap.mp4");
    let gap = with_gap(&path)?;
    let places = samples(&gap);
    assert_eq!(places.len() as i32, FRAMES);
    let mut damaged = gap.clone();
    damaged[places[5].clone()].fill(0);
    std::fs::write(&path, &damaged)?;
    refused(&inspect(directory.path(), &[&path], &[])?, &["gap.mp4", "frame 6 (at 0.20 s) is missing", "--partial"]);
    let (part, said) = report(&inspect(directory.path(), &[&path], &["--partial"])?)?;
    let missing = FRAMES as u64 - part["frames"].as_u64().unwrap_or(0);
    assert!(missing > 0 && said.contains(&format!("{missing} of 26 frames are missing")), "{part} {said}");
    // The index before the pictures, as a file is that may be played while it is copied; the last two were not.
    let (data, index) = (find(&gap, b"mdat", 0) - 4, find(&gap, b"moov", 0) - 4);
    let mut moved = gap[index..].to_vec();
    let place = find(&moved, b"stco", 0) + 12;
    let begin = number(&moved, place) + moved.len();
    moved[place..place + 4].copy_from_slice(&(begin as u32).to_be_bytes());
    let front = [&gap[..data], &moved, &gap[data..index]].concat();
    std::fs::write(&path, &front)?;
    assert_eq!(report(&inspect(directory.path(), &[&path], &[])?)?.0["frames"], FRAMES);
    std::fs::write(&path, &front[..places[22].start + moved.len()])?;
    refused(&inspect(directory.path(), &[&path], &[])?, &["gap.mp4", "ends after frame 24 of 26 (0.96 s)", "truncated", "--partial"]);
    let (part, said) = report(&inspect(directory.path(), &[&path], &["--partial"])?)?;
    assert!(
        part["frames"] == FRAMES - 2 && said.contains("2 of 24 frames were never") && said.contains("ends after frame 24 of 26"),
        "{part} {said}"
    );
    Ok(())
}

/// Protects the files of most cameras, whose pictures are decoded in another order than they are shown: they are whole, and have their own times.
#[test]
fn pictures_that_are_decoded_late_have_their_times() -> Outcome {
    let directory = tempfile::tempdir()?;
    for name in ["late.mkv", "late.mp4"] {
        let path = directory.path().join(name);
        video(&path, ['H', '2', '6', '4'], 30.0)?;
        let reordered = std::fs::read(&path)?.windows(4).any(|word| word == b"ctts");
        assert_eq!(reordered, name.ends_with("mp4"), "an MP4 says by how much each picture is shown later than it is decoded");
        let (all, said) = report(&inspect(directory.path(), &[&path], &[])?)?;
        assert!(all["frames"] == FRAMES && said.is_empty(), "{name}: {all} {said}");
        for (number, t_s) in times(directory.path())? {
            assert!((t_s - (number - 1) as f64 / 30.0).abs() < 1.1e-3, "{name}: frame {number} at {t_s}");
        }
    }
    Ok(())
}

/// Protects who films with a telephone, whose rate varies: such a file is taken with its own times, and a step of several usual ones is said and not refused.
#[test]
fn a_rate_that_varies_is_taken() -> Outcome {
    let directory = tempfile::tempdir()?;
    let path = directory.path().join("varies.mkv");
    video(&path, ['m', 'p', '4', 'v'], 30.0)?;
    let whole = std::fs::read(&path)?;
    for doubled in [false, true] {
        let mut bytes = whole.clone();
        let at_ms = |k: usize| 33 * k + 6 * (k * 7 % 11) / 10 + if doubled && k > 12 { 40 } else { 0 };
        for (k, (_, contents)) in blocks(&whole).into_iter().enumerate() {
            // Blocks are relative to their cluster.
            let place = contents.start + 1..contents.start + 3;
            let later = at_ms(k) as i64 - (k as f64 * 100.0 / 3.0).round() as i64;
            let time = i64::from(u16::from_be_bytes(whole[place.clone()].try_into()?)) + later;
            bytes[place].copy_from_slice(&(time as u16).to_be_bytes());
        }
        std::fs::write(&path, &bytes)?;
        let (all, said) = report(&inspect(directory.path(), &[&path], &[])?)?;
        assert_eq!(
            (all["frames"].as_i64(), said.contains("its rate varies, and 1 of 23 steps")),
            (Some(i64::from(FRAMES)), doubled),
            "{said}"
        );
        for (number, t_s) in times(directory.path())? {
            assert!((t_s - at_ms(number as usize - 1) as f64 / 1e3).abs() < 1e-3, "frame {number} at {t_s}");
        }
    }
    Ok(())
}

/// Protects clear water and playback from streams without a container: they have no times, or ones that FFmpeg makes up, so their pictures are at the camera's rate, which is
/// said in one line.
#[test]
fn a_stream_without_times_is_taken_at_the_cameras_rate() -> Outcome {
    let directory = tempfile::tempdir()?;
    let mut pictures = Vec::new();
    for i in 0..FRAMES {
        let mut bytes = Vector::<u8>::new();
        imgcodecs::imencode_def(".jpg", &pour(i)?, &mut bytes)?;
        pictures.push(bytes.to_vec());
    }
    let mjpeg = directory.path().join("s.mjpeg");
    std::fs::write(&mjpeg, pictures.concat())?;
    let h264 = directory.path().join("s.h264");
    video(&h264, ['H', '2', '6', '4'], 25.0)?;
    for path in [&mjpeg, &h264] {
        let mut recording = Recording::open(path, 20.0, false)?;
        assert_eq!(recording.own_rate_hz(), None, "{}", path.display());
        let mut count = 0;
        while let Some(frame) = recording.next_frame()? {
            count += 1;
            assert_eq!((frame.header.sequence, frame.header.captured_at_ns), (count, (count - 1) * 50_000_000), "{}", path.display());
        }
        assert_eq!(count as i32, FRAMES, "{}", path.display());
        let (all, said) = report(&inspect(directory.path(), &[path], &[])?)?;
        assert!(all["frames"] == FRAMES && said.lines().count() == 1 && said.contains("at camera.fps = 30; whether frames"), "{said}");
    }
    Ok(())
}
