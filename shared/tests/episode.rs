//! Episodes as real files: what is written is what is read, damage is found, weights are added, and tables hold the same measurement.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::path::{Path, PathBuf};
use std::time::{Duration, UNIX_EPOCH};

use proptest::prelude::*;
use shared::config::Config;
use shared::episode::{
    ChangeError, Episode, EpisodeEnd, EpisodeError, EpisodeImages, EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow, find_episodes,
    read_table, recover, set_note, set_weight, write_table,
};
use shared::gaussian_curve::Curve;
use shared::messages::{Doubt, Feature, LAYOUT_VERSION, Phase, Telemetry};

const START_NS: u64 = 5_000_000_000;
const FRAME_NS: u64 = 33_333_333;
const CURVE: Curve = Curve { lambda_deg: 61.3, gamma_per_s2: 0.37, beta_s: 4.1 };

fn config() -> Config {
    Config::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap()
}

fn start(config: &Config) -> EpisodeStart<'_> {
    EpisodeStart {
        episode: 3,
        kind: EpisodeKind::Recording(CURVE),
        started_at_ns: START_NS,
        wall_clock: UNIX_EPOCH + Duration::from_secs(1_795_311_559),
        config,
        weights: "0123456789abcdef",
    }
}

fn feature(sequence: u64, doubt: Doubt) -> Feature {
    Feature {
        version: LAYOUT_VERSION,
        doubt: doubt as u32,
        sequence,
        captured_at_ns: START_NS + sequence * FRAME_NS - 10 * FRAME_NS,
        area_px2: 0.1 + 7.3 * sequence as f32,
        ..Default::default()
    }
}

fn tick(number: u64) -> Telemetry {
    let alpha_deg = 0.5 * number as f32;
    Telemetry {
        version: LAYOUT_VERSION,
        phase: Phase::Recording as u32,
        tick: number,
        at_ns: START_NS + number * FRAME_NS,
        robot_at_ns: START_NS + number * FRAME_NS - 1_000_000,
        episode: 3,
        alpha_deg,
        alpha_measured_deg: alpha_deg - 0.25,
        dalpha_deg: f32::NAN,
        goal_ml: f32::NAN,
        ..Default::default()
    }
}

/// Writes an episode of 60 frames. Frames 17 and 18 are lost, 25 is too dark, 30 is blurred but usable, and the image of 40 was dropped.
fn write(directory: &Path, finish: bool) -> PathBuf {
    let config = config();
    let mut writer = EpisodeWriter::create(directory, &start(&config)).unwrap();
    for n in 8..68 {
        if n >= 10 {
            writer.telemetry(&tick(n - 10)).unwrap();
        }
        if n == 17 || n == 18 {
            continue;
        }
        let doubt = match n {
            25 => Doubt::TooDark,
            30 => Doubt::Blurred,
            _ => Doubt::None,
        };
        let f = feature(n, doubt);
        let alpha = 0.5 * (n as f32 - 10.0);
        let data = vec![n as u8; 300];
        let image = (n != 40).then_some(("jpeg", data.as_slice()));
        let row = FrameRow { feature: &f, alpha_commanded_deg: alpha, alpha_measured_deg: alpha - 0.25, image };
        writer.frame(&row).unwrap();
    }
    let path = writer.path().to_path_buf();
    if finish {
        writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 }).unwrap();
    }
    path
}

/// Protects training data: what is written is what is read, to the last bit, with lost frames in their places.
#[test]
fn an_episode_is_read_as_it_was_written() {
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), true);
    let episode = Episode::read(&path).unwrap();
    assert!(episode.complete);
    assert_eq!(episode.kind, EpisodeKind::Recording(CURVE));
    assert_eq!(episode.weight_g, None);
    assert_eq!(episode.info.started_at_utc, "2026-11-22T01:39:19Z");
    assert_eq!((episode.info.cell.as_str(), episode.info.weights.as_str()), ("sim", "0123456789abcdef"));
    assert_eq!((episode.info.ticks, episode.info.lost_ticks), (58, 0));
    assert_eq!((episode.info.images, episode.info.dropped_images, episode.info.lost_frames), (57, 1, 2));

    let sequences: Vec<u64> = episode.rows.iter().map(|f| f.sequence).collect();
    assert_eq!(sequences, (8..68).collect::<Vec<_>>(), "one frame for each that the camera exposed");
    for f in &episode.rows {
        let n = f.sequence;
        assert_eq!(f.lost, n == 17 || n == 18);
        assert!((f.captured_at_ns as i64 - feature(n, Doubt::None).captured_at_ns as i64).abs() <= 1);
        assert!((f.t_s - (n as f64 - 10.0) / 30.0).abs() < 1e-6);
        assert!((f.alpha_commanded_deg - 0.5 * (n as f32 - 10.0)).abs() < 1e-3, "{n}: {}", f.alpha_commanded_deg);
        if f.lost || n == 25 {
            assert!(f.area_px2.is_nan());
        } else {
            assert_eq!(f.area_px2, 0.1 + 7.3 * n as f32);
        }
    }
    assert_eq!(episode.rows[25 - 8].doubt, Doubt::TooDark);

    let images: Vec<_> = EpisodeImages::open(&path).unwrap().map(Result::unwrap).collect();
    assert_eq!((images.len(), images[0].sequence, images[0].format.as_str(), images[0].data[0]), (57, 8, "jpeg", 8));
    assert_eq!(images[0].captured_at_ns, episode.rows[0].captured_at_ns);
}

/// Protects people from training on half an episode: a file without its end can be read, but says that it is incomplete.
#[test]
fn a_file_that_was_never_finished_is_incomplete() {
    let dir = tempfile::tempdir().unwrap();
    let episode = Episode::read(&write(dir.path(), false)).unwrap();
    assert!(!episode.complete && !episode.rows.is_empty());
}

/// Protects people from training on areas that do not add up to the weight, because the camera stopped before the end, and on made-up angles, where ticks are lost.
#[test]
fn an_episode_without_its_last_frames_or_its_ticks_is_incomplete() {
    let dir = tempfile::tempdir().unwrap();
    let config = config();
    for (frames, lost, lacks) in [(30, 0..0, "the camera fell silent"), (60, 30..34, "ticks of the controller are"), (60, 30..31, "")] {
        let mut writer = EpisodeWriter::create(dir.path(), &start(&config)).unwrap();
        for n in (10..60).filter(|n| !lost.contains(n)) {
            writer.telemetry(&tick(n - 10)).unwrap();
            let f = feature(n, Doubt::None);
            let row = FrameRow { feature: &f, alpha_commanded_deg: 0.0, alpha_measured_deg: 0.0, image: None };
            (n < frames).then(|| writer.frame(&row).unwrap());
        }
        let path = writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 }).unwrap();
        let episode = Episode::read(&path).unwrap();
        assert_eq!((episode.complete, episode.lacks().is_some_and(|what| what.starts_with(lacks))), (lacks.is_empty(), !lacks.is_empty()));
    }
}

/// Protects w_E and all that was recorded: a weight is added and changed, everything else stays, and no other file is left.
#[test]
fn the_weight_is_added_afterwards_and_nothing_else_changes() {
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), true);
    let before = Episode::read(&path).unwrap();
    let images: Vec<_> = EpisodeImages::open(&path).unwrap().map(Result::unwrap).collect();
    assert_eq!(set_weight(&path, 101.5).unwrap(), None);
    assert_eq!(set_weight(&path, 98.0).unwrap(), Some(101.5));
    let after = Episode::read(&path).unwrap();
    assert_eq!(after.weight_g, Some(98.0));
    assert!(after.complete);
    assert_eq!((&after.info, after.content_sha256()), (&before.info, before.content_sha256()));
    assert_eq!(images, EpisodeImages::open(&path).unwrap().map(Result::unwrap).collect::<Vec<_>>());
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "no temporary file is left");
}

/// Protects recordings: nonsense on the command line and a weight for half an episode are refused.
#[test]
fn a_wrong_weight_is_refused_and_the_file_is_as_it_was() {
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), true);
    let bytes = std::fs::read(&path).unwrap();
    for grams in [50_001.0, 1e30, f64::NAN, f64::INFINITY, -0.1] {
        assert!(matches!(set_weight(&path, grams), Err(ChangeError::Weight(..))));
    }
    assert_eq!(std::fs::read(&path).unwrap(), bytes);
    std::fs::write(&path, &bytes[..bytes.len() / 2]).unwrap();
    assert!(matches!(set_weight(&path, 10.0), Err(ChangeError::Incomplete { .. })));
    assert_eq!(std::fs::read(&path).unwrap(), bytes[..bytes.len() / 2], "what could still be read is still there");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "no temporary file is left");
}

/// Protects what people wrote: a note is kept beside everything else, replaced, and taken away; one that is too long is refused.
#[test]
fn a_note_is_added_afterwards_and_nothing_else_changes() {
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), true);
    set_weight(&path, 50.0).unwrap();
    let before = Episode::read(&path).unwrap();
    assert_eq!(set_note(&path, "the cup stood askew").unwrap(), "");
    assert_eq!(Episode::read(&path).unwrap().info.note, "the cup stood askew");
    assert!(matches!(set_note(&path, &"x".repeat(5000)), Err(ChangeError::Note(..))));
    assert_eq!(set_note(&path, "").unwrap(), "the cup stood askew");
    assert_eq!(format!("{:?}", Episode::read(&path).unwrap()), format!("{before:?}"));
}

/// Protects viewers: log times are Unix time and never go back, although frames are written after later ticks, and image and row have one time.
#[test]
fn log_times_are_unix_time_and_in_order() {
    let dir = tempfile::tempdir().unwrap();
    let bytes = std::fs::read(write(dir.path(), true)).unwrap();
    let (mut last, mut messages, mut annotations) = (0, 0, 0);
    for message in mcap::MessageStream::new(&bytes).unwrap() {
        let message = message.unwrap();
        assert!(message.log_time >= last, "{}: {} after {last}", message.channel.topic, message.log_time);
        last = message.log_time;
        messages += 1;
        annotations += u32::from(message.channel.topic == "/camera/annotations");
        let schema = message.channel.schema.as_ref().unwrap();
        assert_eq!((message.channel.message_encoding.as_str(), schema.encoding.as_str()), ("protobuf", "protobuf"));
        let since_start_ns = message.log_time as i64 - 1_795_311_559_000_000_000;
        assert!((-100_000_000..3_000_000_000).contains(&since_start_ns), "{since_start_ns}");
    }
    assert_eq!((messages, annotations), (58 * 4 - 1 + 58, 58));
}

/// Protects recordings of earlier versions: a file of format 1 (JSON, CLOCK_MONOTONIC log times) reads as when it was written, can be weighed
/// again, and is recovered when cut.
#[test]
fn a_file_of_format_1_is_still_read() {
    let old = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data/format-1.mcap");
    let episode = Episode::read(&old).unwrap();
    let hash: String = episode.content_sha256().iter().map(|b| format!("{b:02x}")).collect();
    assert_eq!(hash, "049c02f6499d0c8cd72bb5339fe163edd5c7c07e5999c4a66122340e0669c676", "as the program of that time said");
    assert_eq!((episode.weight_g, episode.complete, episode.kind), (Some(42.5), true, EpisodeKind::Recording(CURVE)));
    assert_eq!((episode.rows.len(), episode.info.lost_frames, episode.info.images, episode.info.ticks), (30, 2, 27, 30));
    let images: Vec<_> = EpisodeImages::open(&old).unwrap().map(Result::unwrap).collect();
    assert_eq!((images[0].captured_at_ns, images[0].sequence), (episode.rows[0].captured_at_ns, 100));
    let dir = tempfile::tempdir().unwrap();
    let copy = dir.path().join("copy.mcap");
    std::fs::copy(&old, &copy).unwrap();
    assert_eq!(set_weight(&copy, 40.0).unwrap(), Some(42.5));
    let bytes = std::fs::read(&old).unwrap();
    std::fs::write(&copy, &bytes[..bytes.len() - 700]).unwrap();
    let recovered = recover(&copy, &dir.path().join("new.mcap")).unwrap();
    assert_eq!(recovered.rows.len(), 30);
}

/// Protects recordings from killed recorders: cut at any byte, a file is made whole as far as its chunks go, or is refused in one line; the old
/// one stays; what is recovered passes as complete only if nothing of it is missing.
#[test]
fn a_file_cut_anywhere_is_recovered() {
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), true);
    let original = Episode::read(&path).unwrap();
    let bytes = std::fs::read(&path).unwrap();
    let (cut, new) = (dir.path().join("cut.mcap"), dir.path().join("new.mcap"));
    let (mut recovered, mut complete, mut refused) = (0, 0, 0);
    let places = (0..bytes.len()).step_by(251).chain((bytes.len() - 300..bytes.len()).step_by(3));
    for place in places {
        std::fs::write(&cut, &bytes[..place]).unwrap();
        match recover(&cut, &new) {
            Ok(episode) => {
                recovered += 1;
                let whole = std::fs::read(&new).unwrap();
                assert!(mcap::Summary::read(&whole).unwrap().is_some(), "{place}: it has an index");
                assert!(mcap::MessageStream::new(&whole).unwrap().all(|m| m.is_ok()));
                let back = Episode::read(&new).unwrap();
                assert_eq!(format!("{:?}", back.rows), format!("{:?}", episode.rows));
                assert_eq!(
                    format!("{:?}", back.rows),
                    format!("{:?}", &original.rows[..back.rows.len()]),
                    "the first frames of the original"
                );
                assert!(!back.complete || back.rows.len() == original.rows.len(), "{place}");
                assert!(back.complete || back.info.ended.contains("recovered"), "{place}");
                let is_cut = matches!(set_weight(&cut, 40.0), Err(ChangeError::Cut { .. }));
                assert_eq!([Episode::read(&cut).unwrap().info.recoverable, is_cut], [back.complete; 2], "{place}");
                complete += usize::from(back.complete);
                assert!(matches!(recover(&new, &dir.path().join("again.mcap")), Err(ChangeError::Whole { .. })));
                std::fs::remove_file(&new).unwrap();
            }
            Err(e) => {
                refused += 1;
                assert!(!e.to_string().contains('\n') && !new.exists(), "{place}: {e}");
                assert!(place < 20_000, "{place}: {e}");
            }
        }
        assert_eq!(std::fs::read(&cut).unwrap().len(), place);
    }
    assert!(recovered > 150 && complete > 90 && refused > 10, "{recovered} {complete} {refused}");
    std::fs::write(&cut, &bytes[..bytes.len() - 9]).unwrap();
    std::fs::write(&new, "mine").unwrap();
    assert!(matches!(recover(&cut, &new), Err(ChangeError::Write { .. })));
    assert_eq!(std::fs::read(&new).unwrap(), b"mine", "nothing is overwritten");
    let mut names: Vec<_> = std::fs::read_dir(dir.path()).unwrap().map(|e| e.unwrap().file_name().into_string().unwrap()).collect();
    names.sort();
    assert_eq!(names, ["cut.mcap", "episode-0003.mcap", "new.mcap"], "no temporary file is left");
}

/// Protects the memory: a few kilobytes that claim to be gigabytes, by compression or by a length, are refused before they are unpacked.
#[test]
fn a_small_file_cannot_fill_the_memory() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("bomb.mcap");
    let options = mcap::WriteOptions::new().compression(Some(mcap::Compression::Zstd)).chunk_size(None).emit_message_indexes(false);
    let mut writer = options.create(std::io::BufWriter::new(std::fs::File::create(&file).unwrap())).unwrap();
    let channel = writer.add_channel(0, "/sample", "json", &Default::default()).unwrap();
    let row =
        r#"{"sequence":1,"captured_at_ns":1,"alpha_commanded_deg":0,"alpha_measured_deg":0,"area_px2":0,"doubt":"none","image":false}"#;
    for _ in 0..20 {
        for sequence in 0..30_000 {
            let header = mcap::records::MessageHeader { channel_id: channel, sequence, log_time: 1, publish_time: 1 };
            writer.write_to_known_channel(&header, row.as_bytes()).unwrap();
        }
        writer.flush().unwrap();
    }
    writer.finish().unwrap();
    drop(writer);
    let bytes = std::fs::metadata(&file).unwrap().len();
    let said = Episode::read(&file).unwrap_err().to_string();
    assert!(bytes < 1_500_000 && said.contains("times larger than the file"), "{bytes}: {said}");
}

/// Protects episodes under way: a file is locked while it is written, and free afterwards. The lock alone decides: one whose recorder was killed just now
/// can be recovered at once.
#[test]
fn a_file_is_locked_while_it_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let config = config();
    let writer = EpisodeWriter::create(dir.path(), &start(&config)).unwrap();
    let path = writer.path().to_path_buf();
    assert!(std::fs::File::open(&path).unwrap().try_lock().is_err());
    let new = dir.path().join("new.mcap");
    let all_refuse = |path: &Path, words: &str| {
        for refused in [set_note(path, "x").map(|_| ()), set_weight(path, 80.0).map(|_| ()), recover(path, &new).map(|_| ())] {
            assert!(refused.as_ref().is_err_and(|e| e.to_string().contains(words)) && !new.exists(), "{refused:?}");
        }
    };
    all_refuse(&path, "it is being written");
    writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 }).unwrap();
    assert!(std::fs::File::open(&path).unwrap().try_lock().is_ok());
    let (cut, whole) = (dir.path().join("cut.mcap"), std::fs::read(&path).unwrap());
    std::fs::write(&cut, &whole[..whole.len() / 2]).unwrap();
    recover(&cut, &new).unwrap();
}

/// Protects training from the same measurement counted twice, be it under another name or with another weight.
#[test]
fn the_same_measurement_twice_is_found() {
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), true);
    let copy = dir.path().join("copy.mcap");
    std::fs::copy(&path, &copy).unwrap();
    set_weight(&copy, 77.0).unwrap();
    let files = find_episodes(&[dir.path().to_path_buf()]).unwrap();
    let mut episodes: Vec<Episode> = files.iter().map(|f| Episode::read(f).unwrap()).collect();
    assert_eq!(Episode::first_of_measurement(&episodes), [0, 0]);
    episodes[0].rows[30].area_px2 += 1.0;
    assert_eq!(Episode::first_of_measurement(&episodes), [0, 1]);
}

/// Protects everything that reads episodes: files of other kinds are refused in one line.
#[test]
fn other_files_are_refused_in_one_line() {
    let dir = tempfile::tempdir().unwrap();
    let file = dir.path().join("x.mcap");
    std::fs::write(&file, "no such thing").unwrap();
    assert!(matches!(Episode::read(&file), Err(EpisodeError::NotAnEpisode { .. })));
    std::fs::write(&file, "").unwrap();
    assert!(matches!(Episode::read(&file), Err(EpisodeError::NotAnEpisode { .. })));
    let mut foreign = mcap::Writer::new(std::io::Cursor::new(Vec::new())).unwrap();
    foreign.finish().unwrap();
    std::fs::write(&file, foreign.into_inner().into_inner()).unwrap();
    let message = Episode::read(&file).unwrap_err().to_string();
    assert!(message.contains("x.mcap") && message.contains("not an episode"), "{message}");
    assert!(matches!(Episode::read(&dir.path().join("none.mcap")), Err(EpisodeError::Read { .. })));
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 400, failure_persistence: None, ..Default::default() })]

    /// Protects the trainer from damaged disks: wherever a file is cut, it reads as incomplete or not at all, and what is
    /// read are the first frames of the original.
    #[test]
    fn a_cut_file_never_passes_as_whole(at in 0.0..1.0f64) {
        let dir = tempfile::tempdir().unwrap();
        let path = write(dir.path(), true);
        let original = Episode::read(&path).unwrap();
        let bytes = std::fs::read(&path).unwrap();
        std::fs::write(&path, &bytes[..(bytes.len() as f64 * at) as usize]).unwrap();
        if let Ok(episode) = Episode::read(&path) {
            prop_assert!(!episode.complete);
            for (a, b) in episode.rows.iter().zip(&original.rows) {
                prop_assert_eq!(a.sequence, b.sequence);
                prop_assert_eq!(a.captured_at_ns, b.captured_at_ns);
                prop_assert_eq!(a.area_px2.to_bits(), b.area_px2.to_bits());
            }
        }
        for image in EpisodeImages::open(&path).unwrap() { let _ = image; }
    }

    /// Protects the trainer from wrong numbers: a file with one flipped bit never reads as a complete episode.
    #[test]
    fn a_flipped_bit_never_passes_as_whole(at in 0.0..1.0f64, bit in 0..8u32) {
        let dir = tempfile::tempdir().unwrap();
        let path = write(dir.path(), true);
        let mut bytes = std::fs::read(&path).unwrap();
        let place = (bytes.len() as f64 * at) as usize;
        bytes[place] ^= 1 << bit;
        std::fs::write(&path, &bytes).unwrap();
        if let Ok(episode) = Episode::read(&path) {
            prop_assert!(!episode.complete, "byte {} of {}, bit {}", place, bytes.len(), bit);
        }
        for image in EpisodeImages::open(&path).unwrap() { let _ = image; }
        prop_assert!(set_weight(&path, 1.0).is_err());
    }
}

fn tables(features: &str, scale: &str) -> Result<Vec<Episode>, String> {
    let dir = tempfile::tempdir().unwrap();
    let (f, s) = (dir.path().join("features.csv"), dir.path().join("scale.csv"));
    std::fs::write(&f, features).unwrap();
    std::fs::write(&s, scale).unwrap();
    read_table(&f, &s).map_err(|e| e.to_string().replace(&format!("{}/", dir.path().display()), ""))
}

const HEADING: &str = "episode,frame,t_s,alpha_deg,area_px2\n";

/// Protects people who measure V_e with software of their own: a table may have its columns in any order, further columns, and lost and
/// unmeasured frames.
#[test]
fn a_table_is_read() {
    let features = "area_px2, note, episode, frame, t_s, alpha_deg\n0,x,a,5,0.0,1\n10.5,x,a,8,0.3,4\nnan,x,b,0,0,0\n,x,b,1,0.1,0.5\n";
    let episodes = tables(features, "episode,weight_g\nb,12\na,99.5\n").unwrap();
    assert_eq!(episodes.iter().map(|e| (e.name.as_str(), e.weight_g)).collect::<Vec<_>>(), [("a", Some(99.5)), ("b", Some(12.0))]);
    let a = &episodes[0].rows;
    assert_eq!(a.iter().map(|f| (f.sequence, f.lost)).collect::<Vec<_>>(), [(5, false), (6, true), (7, true), (8, false)]);
    assert_eq!((a[1].alpha_commanded_deg, a[3].area_px2), (2.0, 10.5));
    assert!(episodes[1].rows.iter().all(|f| f.lost && f.area_px2.is_nan()));
    assert!(episodes.iter().all(|e| e.complete && e.kind == EpisodeKind::Table));
    let one_weighed = tables(features, "episode,weight_g\nb,12\n").unwrap();
    assert_eq!(one_weighed.iter().map(|e| e.weight_g).collect::<Vec<_>>(), [None, Some(12.0)]);
}

/// Protects people whose tables are wrong: each fault is reported with file and line.
#[test]
fn faults_in_tables_are_named_with_file_and_line() {
    let good = "1,0,0.0,0,0\n1,1,0.033,0.5,3\n";
    let scale = "episode,weight_g\n1,10\n";
    let features = |rows: &str| format!("{HEADING}{rows}");
    let mut wrong = Vec::new();
    for (features, scale, expected) in [
        ("episode,frame,t_s,area_px2\n".to_string(), scale, "features.csv:1: column 'alpha_deg' is missing"),
        (format!("frame,{HEADING}"), scale, "features.csv:1: column 'frame' is there twice"),
        (features(""), scale, "features.csv: no rows"),
        (features("1,0,0.0,inf,0\n"), scale, "features.csv:2: t_s '0.0', alpha_deg 'inf'"),
        (features("1,0,nan,1,0\n"), scale, "features.csv:2: t_s 'nan'"),
        (features("1,0,0.0,1,inf\n"), scale, "features.csv:2: area_px2 'inf'"),
        (features("1,0,0.0,1,-3\n"), scale, "features.csv:2: area_px2 '-3'"),
        (features("1,0,0.0,1,many\n"), scale, "features.csv:2: area_px2 'many'"),
        (features("1,0.5,0.0,1,2\n"), scale, "features.csv:2: frame '0.5'"),
        (features("1,2,0.0,0,0\n1,1,0.1,0,0\n"), scale, "features.csv:3: frame 1 comes after frame 2"),
        (features("1,1,0.0,0,0\n1,1,0.1,0,0\n"), scale, "features.csv:3: frame 1 is there twice"),
        (features("1,1,0.1,0,0\n1,2,0.1,0,0\n"), scale, "features.csv:3: t_s 0.1 is not after"),
        (features("1,1,0.1,0,0\n1,999999999,0.2,0,0\n"), scale, "features.csv:3: frame jumps"),
        (features("1,0,0.0,0,0\n2,0,0,0,0\n1,1,0.1,0,0\n"), scale, "features.csv:4: episode 1 began in line 2 already"),
        (features("1,0,0.0,0\n"), scale, "features.csv:2: 4 fields where the heading has 5"),
        (features(good), "episode\n1\n", "scale.csv:1: column 'weight_g' is missing"),
        (features(good), "episode,weight_g\n1,nan\n", "scale.csv:2: weight_g 'nan'"),
        (features(good), "episode,weight_g\n1,-2\n", "scale.csv:2: weight_g '-2'"),
        (features(good), "episode,weight_g\n1,5\n1,6\n", "scale.csv:3: episode 1 has a weight in line 2 already"),
        (features(good), "episode,weight_g\n1,5\n7,6\n", "scale.csv:3: episode 7 is not in"),
        (features(good), "episode,weight_g\n1,\n", "scale.csv:2: weight_g ''"),
        (features(good), "episode,weight_g,framing\n1,5,640 480\n", "scale.csv:2: framing '640 480': width, height"),
        (HEADING.replace('\n', ",doubt\n1,0,0.0,0,0,gloomy\n"), scale, "features.csv:2: doubt 'gloomy': none, or"),
        (HEADING.replace('\n', ",alpha_measured_deg\n1,0,0.0,0,0,inf\n"), scale, "features.csv:2: alpha_measured_deg 'inf'"),
    ] {
        let said = tables(&features, scale).err().unwrap_or_else(|| "nothing".into());
        if !said.starts_with(expected) || said.contains('\n') {
            wrong.push(format!("{expected}: {said}"));
        }
    }
    assert!(wrong.is_empty(), "{wrong:#?}");
}

/// Protects people who take their episodes elsewhere and back: the tables hold the same measurement, and say of which cell and pictures it is, and what is
/// doubtful about it.
#[test]
fn a_table_written_from_an_episode_reads_as_the_same_measurement() {
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), true);
    set_weight(&path, 42.5).unwrap();
    let episode = Episode::read(&path).unwrap();
    let (features, scale) = (dir.path().join("features.csv"), dir.path().join("scale.csv"));
    write_table(std::slice::from_ref(&episode), &features, &scale).unwrap();
    let back = read_table(&features, &scale).unwrap();
    assert_eq!((back[0].content_sha256(), back[0].weight_g), (episode.content_sha256(), Some(42.5)));
    assert!(episode.info.framing.is_known() && !episode.info.cell.is_empty());
    assert_eq!((back[0].info.framing, &back[0].info.cell), (episode.info.framing, &episode.info.cell));
    let doubts = |e: &Episode| e.rows.iter().map(|row| (row.doubt, row.lost)).collect::<Vec<_>>();
    assert!(episode.rows.iter().any(|row| row.doubt != Doubt::None));
    assert_eq!(doubts(&back[0]), doubts(&episode));
    assert!(write_table(&[episode], &features, &scale).is_err(), "a table that is there is not overwritten");
}
