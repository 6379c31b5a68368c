//! Videos with gaps in their times, with a rate that varies, and streams that have no times at all.

use feature_worker::source::Recording;
use opencv::core::Vector;
use opencv::imgcodecs;
use opencv::prelude::*;

use super::matroska::blocks;
use super::{FRAMES, Outcome, find, inspect, pour, refused, report, set_steps, times, video};

/// Protects the numbers of frames of an MP4: a picture that is longer than the others in a file of one rate is followed by a gap, which is refused with its number, and numbered
/// with --partial.
#[test]
fn a_gap_in_an_index_is_named() -> Outcome {
    let directory = tempfile::tempdir()?;
    let path = directory.path().join("gap.mp4");
    video(&path, ['m', 'p', '4', 'v'], 25.0)?;
    let bytes = std::fs::read(&path)?;
    let at = find(&bytes, b"stts", 0);
    let step = u32::from_be_bytes(bytes[at + 16..at + 20].try_into()?);
    let mut gap = set_steps(&bytes, &[(10, step), (1, 3 * step), (FRAMES as u32 - 11, step)]);
    // The track's duration, also that of its edit list, ms.
    for at in [find(&gap, b"elst", 0) + 12, find(&gap, b"tkhd", 0) + 24] {
        gap[at..at + 4].copy_from_slice(&((FRAMES as u32 + 2) * 40).to_be_bytes());
    }
    std::fs::write(&path, &gap)?;
    refused(&inspect(directory.path(), &[&path], &[])?, &["gap.mp4", "frame 12 (at 0.44 s) is missing", "--partial"]);
    let (part, said) = report(&inspect(directory.path(), &[&path], &["--partial"])?)?;
    assert!(part["frames"] == FRAMES && said.contains("2 of 26 frames are missing"), "{part} {said}");
    let all = times(directory.path())?;
    assert_eq!(all.iter().map(|(number, _)| *number).collect::<Vec<_>>(), (1..=26).filter(|n| ![12, 13].contains(n)).collect::<Vec<_>>());
    assert!(all.iter().all(|(number, t_s)| (t_s - (number - 1) as f64 * 0.04).abs() < 2e-3), "{all:?}");
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
