//! `feature-worker episodes` as people and scripts call it: the program itself, on real files.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::UNIX_EPOCH;

use opencv::core::{Mat, Scalar, Vector, VectorToVec};
use opencv::prelude::*;
use shared::config::Config;
use shared::episode::{Episode, EpisodeEnd, EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow, read_table};
use shared::gaussian_curve::Curve;
use shared::messages::{Feature, LAYOUT_VERSION, Telemetry};

const FRAMES: u64 = 40;

/// Grey level of picture `n`. It is far from its neighbours' levels, because video codecs blur small changes away.
fn grey(n: u64) -> f64 {
    (n * 97 % 200 + 20) as f64
}

/// Writes an episode of 40 frames, each with an image of its own grey. Frames 20 and 21 are lost.
fn write(directory: &Path, lambda_deg: f32) -> PathBuf {
    let config = Config::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
    let kind = EpisodeKind::Recording(Curve { lambda_deg, gamma_per_s2: 0.5, beta_s: 2.0 });
    let start = EpisodeStart { episode: 1, kind, started_at_ns: 1_000_000_000, wall_clock: UNIX_EPOCH, config: &config, weights: "" };
    let mut writer = EpisodeWriter::create(directory, &start).unwrap();
    for n in 0..FRAMES {
        let at_ns = 1_000_000_000 + n * 33_333_333;
        let tick =
            Telemetry { version: LAYOUT_VERSION, tick: n + 1, at_ns, robot_at_ns: at_ns, alpha_deg: lambda_deg, ..Default::default() };
        writer.telemetry(&tick).unwrap();
        if n == 20 || n == 21 {
            continue;
        }
        let picture = Mat::new_rows_cols_with_default(48, 64, opencv::core::CV_8UC3, Scalar::all(grey(n))).unwrap();
        let mut bytes = Vector::<u8>::new();
        opencv::imgcodecs::imencode_def(".jpg", &picture, &mut bytes).unwrap();
        let area_px2 = if n > 10 { 100.0 + n as f32 } else { 0.0 };
        let feature =
            Feature { version: LAYOUT_VERSION, sequence: n + 1, captured_at_ns: at_ns + 5_000_000, area_px2, ..Default::default() };
        let image = bytes.to_vec();
        let row =
            FrameRow { feature: &feature, alpha_commanded_deg: lambda_deg, alpha_measured_deg: lambda_deg, image: Some(("jpeg", &image)) };
        writer.frame(&row).unwrap();
    }
    writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 }).unwrap()
}

fn episodes(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_feature-worker")).arg("episodes").args(arguments).output().unwrap()
}

fn code(output: &Output) -> i32 {
    output.status.code().unwrap()
}

/// Protects scripts: exit code and JSON tell what is wrong with episodes. A weight makes them usable; nonsense does not.
#[test]
fn check_and_weigh_tell_by_exit_code_and_json() {
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), 50.0);
    let (directory, file) = (dir.path().to_str().unwrap(), path.to_str().unwrap());
    let wrong = |output: &Output| {
        let report: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        report["episodes"].as_array().unwrap().iter().flat_map(|e| e["wrong"].as_array().unwrap().clone()).collect::<Vec<_>>()
    };
    let check = episodes(&["check", directory, "--json"]);
    assert_eq!(code(&check), 1);
    assert!(wrong(&check)[0].as_str().unwrap().contains("no weight"));

    assert_eq!(code(&episodes(&["weigh", file, "--weight", "-5"])), 2);
    assert_eq!(code(&episodes(&["weigh", file, "--weight", "nan"])), 2);
    let weigh = episodes(&["weigh", file, "--weight", "104"]);
    assert_eq!((code(&weigh), Episode::read(&path).unwrap().weight_g), (0, Some(104.0)));
    let again = String::from_utf8(episodes(&["weigh", file, "--weight", "105.5"]).stdout).unwrap();
    assert!(again.contains("was 104 g"), "{again}");
    let check = episodes(&["check", directory, "--json"]);
    assert_eq!((code(&check), wrong(&check).len()), (0, 0));

    std::fs::copy(&path, dir.path().join("copy.mcap")).unwrap();
    let check = episodes(&["check", directory, "--json"]);
    assert_eq!(code(&check), 1);
    assert!(wrong(&check)[0].as_str().unwrap().contains("the same measurement"));

    std::fs::write(dir.path().join("copy.mcap"), "no episode").unwrap();
    let list = episodes(&["list", directory]);
    assert_eq!(code(&list), 1, "a file that cannot be read is not passed over in silence");
    assert!(String::from_utf8(list.stdout).unwrap().contains("UNREADABLE"));
    assert_eq!(code(&episodes(&["show", file])), 0);
    assert_eq!(code(&episodes(&["show", &format!("{directory}/none.mcap")])), 2);
    assert_eq!(code(&episodes(&["list", "--config", &format!("{directory}/none.toml")])), 2);
}

/// Protects people who take episodes elsewhere: every frame is there, the lost ones in their places, and nothing is overwritten.
#[test]
fn exports_hold_every_frame_and_overwrite_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let recorded = dir.path().join("recorded");
    for lambda in [50.0, 60.0] {
        let path = write(&recorded, lambda);
        shared::episode::set_weight(&path, 100.0).unwrap();
    }
    let to = |name: &str| dir.path().join(name);
    let export =
        |format: &str| code(&episodes(&["export", recorded.to_str().unwrap(), "--as", format, "--to", to(format).to_str().unwrap()]));
    for format in ["csv", "images", "video", "lerobot"] {
        assert_eq!(export(format), 0, "{format}");
        assert_eq!(export(format), 1, "{format} again: nothing is overwritten");
    }
    let tables = read_table(&to("csv/features.csv"), &to("csv/scale.csv")).unwrap();
    assert_eq!((tables.len(), tables[1].rows.len(), tables[1].weight_g), (2, FRAMES as usize, Some(100.0)));
    assert_eq!(std::fs::read_dir(to("images/episode-0002")).unwrap().count(), FRAMES as usize - 2);

    let greys = |path: PathBuf| {
        let mut video = opencv::videoio::VideoCapture::from_file_def(&path).unwrap();
        let (mut greys, mut picture) = (Vec::new(), Mat::default());
        while video.read(&mut picture).unwrap() {
            greys.push(opencv::core::mean_def(&picture).unwrap()[0]);
        }
        greys
    };
    let lerobot = to("lerobot/videos/observation.images.camera/chunk-000");
    for path in [to("video/episode-0002.mp4"), lerobot.join("file-000.mp4"), lerobot.join("file-001.mp4")] {
        let greys = greys(path);
        assert_eq!(greys.len(), FRAMES as usize);
        for (n, shade) in (0..FRAMES).zip(&greys) {
            let shown = if n == 20 || n == 21 { 19 } else { n };
            assert!((shade - grey(shown)).abs() < 8.0, "picture {n}: {shade}");
        }
    }

    let info: serde_json::Value = serde_json::from_slice(&std::fs::read(to("lerobot/meta/info.json")).unwrap()).unwrap();
    assert_eq!((info["codebase_version"].as_str(), info["total_frames"].as_u64()), (Some("v3.0"), Some(2 * FRAMES)));
    for (file, rows) in [("data/chunk-000/file-000", 2 * FRAMES), ("meta/episodes/chunk-000/file-000", 2), ("meta/tasks", 1)] {
        let file = std::fs::File::open(to("lerobot").join(file).with_extension("parquet")).unwrap();
        let reader = parquet::file::serialized_reader::SerializedFileReader::new(file).unwrap();
        use parquet::file::reader::FileReader;
        assert_eq!(reader.metadata().file_metadata().num_rows() as u64, rows);
        assert_eq!(reader.get_row_iter(None).unwrap().filter(Result::is_ok).count() as u64, rows);
    }
}
