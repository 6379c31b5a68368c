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
/// The frame whose picture is dropped.
const DROPPED: u64 = 30;

/// Grey level of picture `n`. It is far from its neighbours' levels, because video codecs blur small changes away.
fn grey(n: u64) -> f64 {
    (n * 97 % 200 + 20) as f64
}

/// Time from frame to frame at 30 frames a second, ns.
const PERIOD_NS: u64 = 33_333_333;

/// A JPEG of one grey.
fn picture(width: i32, grey: f64) -> Vec<u8> {
    let picture = Mat::new_rows_cols_with_default(48, width, opencv::core::CV_8UC3, Scalar::all(grey)).unwrap();
    let mut bytes = Vector::<u8>::new();
    opencv::imgcodecs::imencode_def(".jpg", &picture, &mut bytes).unwrap();
    bytes.to_vec()
}

/// Writes an episode of 40 frames, each with an image of its own grey. Frames 20 and 21 are lost, and the picture of frame 30 is dropped.
fn write(directory: &Path, lambda_deg: f32) -> PathBuf {
    write_with(directory, lambda_deg, PERIOD_NS, |n| picture(64, grey(n)))
}

/// Writes an episode of 40 frames that are `period_ns` apart, with the images that `image` makes.
fn write_with(directory: &Path, lambda_deg: f32, period_ns: u64, image: impl Fn(u64) -> Vec<u8>) -> PathBuf {
    let config = Config::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
    let kind = EpisodeKind::Recording(Curve { lambda_deg, gamma_per_s2: 0.5, beta_s: 2.0 });
    let start = EpisodeStart { episode: 1, kind, started_at_ns: 1_000_000_000, wall_clock: UNIX_EPOCH, config: &config, weights: "" };
    let mut writer = EpisodeWriter::create(directory, &start).unwrap();
    for n in 0..FRAMES {
        let at_ns = 1_000_000_000 + n * period_ns;
        let tick =
            Telemetry { version: LAYOUT_VERSION, tick: n + 1, at_ns, robot_at_ns: at_ns, alpha_deg: lambda_deg, ..Default::default() };
        writer.telemetry(&tick).unwrap();
        if n == 20 || n == 21 {
            continue;
        }
        let area_px2 = if (11..FRAMES - 4).contains(&n) { 100.0 + n as f32 } else { 0.0 };
        let feature =
            Feature { version: LAYOUT_VERSION, sequence: n + 1, captured_at_ns: at_ns + 5_000_000, area_px2, ..Default::default() };
        let image = (n != DROPPED).then(|| image(n));
        let image = image.as_deref().map(|bytes| ("jpeg", bytes));
        let row = FrameRow { feature: &feature, alpha_commanded_deg: lambda_deg, alpha_measured_deg: lambda_deg, image };
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
    assert_eq!(std::fs::read_dir(to("images/episode-0002")).unwrap().count(), FRAMES as usize - 3);

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
            let shown = if n == 20 || n == 21 { 19 } else { n - u64::from(n == DROPPED) };
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
        let read: Vec<String> = reader.get_row_iter(None).unwrap().map(|row| row.unwrap().to_string()).collect();
        assert_eq!(read.len() as u64, rows);
        assert!(!read.iter().any(|row| row.contains("NaN")), "{:?}", read.iter().find(|row| row.contains("NaN")));
        if rows == 2 * FRAMES {
            assert!(read[20].contains("action: [50.0, 0E0], known: [false, "), "frame 20 is lost: {}", read[20]);
            assert!(read[19].contains("known: [true, true, true]"), "{}", read[19]);
            let dropped = &read[DROPPED as usize];
            assert!(dropped.contains("known: [false, true, true]"), "its picture is the one before: {dropped}");
        }
    }
    let stats: serde_json::Value = serde_json::from_slice(&std::fs::read(to("lerobot/meta/stats.json")).unwrap()).unwrap();
    for column in ["observation.state", "action", "known", "observation.images.camera", "timestamp", "index"] {
        for number in ["min", "max", "mean", "std", "count", "q01", "q10", "q50", "q90", "q99"] {
            assert!(stats[column][number].is_array(), "{column} {number}");
        }
    }
    assert_eq!(stats["action"]["q50"].as_array().unwrap()[0], 55.0, "half of the rows are at 50, half at 60");
}

/// Protects people with one bad file among many: the others are exported, the bad one is named, and the exit code says it.
#[test]
fn a_file_that_cannot_be_read_does_not_stop_an_export() {
    let dir = tempfile::tempdir().unwrap();
    let recorded = dir.path().join("recorded");
    for lambda in [50.0, 60.0] {
        shared::episode::set_weight(&write(&recorded, lambda), 100.0).unwrap();
    }
    std::fs::write(recorded.join("episode-0000.mcap"), "no episode").unwrap();
    for format in ["csv", "images", "video", "lerobot"] {
        let to = dir.path().join(format);
        let output = episodes(&["export", recorded.to_str().unwrap(), "--as", format, "--to", to.to_str().unwrap(), "--json"]);
        assert_eq!(code(&output), 1, "{format}");
        let said: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        assert!(said["left_out"][0]["why"].as_str().unwrap().contains("episode-0000.mcap"), "{format}: {said}");
        let written = said["written"].as_array().unwrap();
        assert_eq!(written.len(), if format == "lerobot" { 1 } else { 2 }, "{format}");
        assert!(written.iter().all(|w| Path::new(w.as_str().unwrap()).exists()));
    }
    let none = episodes(&["export", recorded.join("episode-0000.mcap").to_str().unwrap(), "--as", "csv", "--to", "x"]);
    assert_eq!((code(&none), Path::new("x").exists()), (2, false), "nothing to export is a wrong input");
}

/// Protects data sets from episodes that do not fit, and exports from one picture among many: what has a picture that is none, pictures of two sizes or
/// another rate than the rest is named and left out, and the others are exported.
#[test]
fn an_episode_that_does_not_fit_does_not_stop_an_export() {
    let dir = tempfile::tempdir().unwrap();
    let recorded = dir.path().join("recorded");
    write_with(&recorded, 50.0, 2 * PERIOD_NS, |n| picture(64, grey(n)));
    write_with(&recorded, 51.0, PERIOD_NS, |n| if n == 10 { b"no picture".to_vec() } else { picture(64, grey(n)) });
    write_with(&recorded, 52.0, PERIOD_NS, |n| if n == 10 { Vec::new() } else { picture(64, grey(n)) });
    write_with(&recorded, 53.0, PERIOD_NS, |n| picture(if n < 10 { 64 } else { 80 }, grey(n)));
    for lambda in [54.0, 55.0] {
        write(&recorded, lambda);
    }
    let undecodable = ["0002.mcap: picture 11 cannot be decoded", "0003.mcap: picture 11 cannot be decoded"];
    let size = "0004.mcap: picture 11 is 80 x 48 px, but those before it are 64 x 48 px";
    let rate = "0001.mcap: it has 15.0 frames a second, and the data set 30.0";
    for (format, whys) in [("video", [&undecodable[..], &[size]].concat()), ("lerobot", [&[rate], &undecodable[..], &[size]].concat())] {
        let to = dir.path().join(format);
        let output = episodes(&["export", recorded.to_str().unwrap(), "--as", format, "--to", to.to_str().unwrap(), "--json"]);
        assert_eq!(code(&output), 1, "{format}: {}", String::from_utf8_lossy(&output.stderr));
        let said: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
        let left_out: Vec<&str> = said["left_out"].as_array().unwrap().iter().map(|l| l["why"].as_str().unwrap()).collect();
        assert!(left_out.len() == whys.len() && left_out.iter().zip(&whys).all(|(l, why)| l.contains(why)), "{format}: {said}");
        let written = said["written"].as_array().unwrap().len();
        assert_eq!(written, if format == "video" { 3 } else { 1 }, "{said}");
    }
    let info = std::fs::read(dir.path().join("lerobot/meta/info.json")).unwrap();
    let info: serde_json::Value = serde_json::from_slice(&info).unwrap();
    assert_eq!((info["total_episodes"].as_u64(), info["fps"].as_u64()), (Some(2), Some(30)));
}

/// Protects who learns from a data set: LeRobot's rate is a whole number, so one of episodes at 7.5 frames a second would play too fast, and is refused.
/// At 29.97 it is close enough.
#[test]
fn a_rate_that_is_no_whole_number_is_refused() {
    let dir = tempfile::tempdir().unwrap();
    for (name, period_ns, ended) in [("slow", 4 * PERIOD_NS, 2), ("usual", 33_366_700, 0)] {
        let recorded = dir.path().join(name);
        write_with(&recorded, 50.0, period_ns, |n| picture(64, grey(n)));
        let to = recorded.join("set");
        let output = episodes(&["export", recorded.to_str().unwrap(), "--as", "lerobot", "--to", to.to_str().unwrap()]);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(code(&output), ended, "{name}: {said}");
        assert_eq!(said.contains("the data set has 7.5 frames a second, which LeRobot would show as 8"), ended == 2, "{said}");
        assert_eq!(to.exists(), ended == 0, "what failed leaves nothing");
    }
}

/// Protects recordings and everything that lies beside them: pruning says first, spares what is weighed, under way, the newest, or not an
/// episode of ours, and goes no further than the budget asks.
#[test]
fn pruning_deletes_no_more_than_it_must() {
    let dir = tempfile::tempdir().unwrap();
    let files: Vec<PathBuf> = (0..6).map(|n| write(dir.path(), 50.0 + n as f32)).collect();
    shared::episode::set_weight(&files[0], 70.0).unwrap();
    let foreign = dir.path().join("episode-0099.mcap");
    std::fs::write(&foreign, "mine").unwrap();
    std::os::unix::fs::symlink(&files[1], dir.path().join("link.mcap")).unwrap();
    let held = std::fs::File::open(&files[2]).unwrap();
    held.try_lock().unwrap();
    let prune = |more: &[&str]| {
        let output = episodes(&[&["prune", dir.path().to_str().unwrap(), "--budget-mb", "0", "--json"][..], more].concat());
        (code(&output), serde_json::from_slice::<serde_json::Value>(&output.stdout).unwrap())
    };
    let there = |files: &[PathBuf]| files.iter().map(|f| f.exists()).collect::<Vec<_>>();
    // The foreign file and the one that is being written count too.
    let (ended, said) = prune(&["--budget-episodes", "5"]);
    assert_eq!((ended, said["episodes"].as_array().unwrap().len(), said["deleted"].as_bool()), (0, 2, Some(false)));
    assert_eq!(there(&files), [true; 6], "without --yes nothing is deleted");
    let (ended, said) = prune(&["--budget-episodes", "5", "--yes"]);
    assert_eq!((ended, said["stay"]["episodes"].as_u64()), (0, Some(5)));
    assert_eq!(there(&files), [true, false, true, false, true, true], "the oldest that is neither weighed nor being written");
    assert_eq!(said["kept"].as_array().unwrap().len(), 3, "a foreign file, a link, one that is being written: {said}");
    let (ended, said) = prune(&["--budget-episodes", "3", "--yes"]);
    assert_eq!((ended, said["stay"]["within_budget"].as_bool()), (1, Some(false)), "the weighed one is spared");
    assert_eq!(there(&files), [true, false, true, false, false, true]);
    let (ended, _) = prune(&["--budget-episodes", "3", "--yes", "--weighed"]);
    assert_eq!((ended, there(&files)), (0, vec![false, false, true, false, false, true]));
    assert!(foreign.exists() && std::fs::symlink_metadata(dir.path().join("link.mcap")).is_ok());

    let delete = |file: &Path, more: &[&str]| code(&episodes(&[&["delete", file.to_str().unwrap()][..], more].concat()));
    assert_eq!((delete(&files[5], &[]), files[5].exists()), (0, true));
    assert_eq!((delete(&foreign, &["--yes"]), foreign.exists()), (2, true));
    let said = episodes(&["delete", foreign.to_str().unwrap(), "--yes", "--json"]);
    let said: serde_json::Value = serde_json::from_slice(&said.stdout).unwrap();
    assert_eq!(said["deleted"].as_bool(), Some(false), "what was kept was not deleted: {said}");
    assert_eq!((delete(&files[2], &["--yes"]), files[2].exists()), (2, true), "it is being written");
    drop(held);
    assert_eq!((delete(&files[2], &["--yes"]), files[2].exists()), (0, false));
}

/// Protects recordings from a large file of somebody else among them: where what is kept breaks the budget by itself, no episode is deleted for it, and
/// it is said.
#[test]
fn a_foreign_file_costs_no_episode() {
    let dir = tempfile::tempdir().unwrap();
    let files: Vec<PathBuf> = (0..3).map(|n| write(dir.path(), 50.0 + n as f32)).collect();
    let foreign = std::fs::File::create(dir.path().join("mine.mcap")).unwrap();
    foreign.set_len(1_900_000).unwrap();
    let prune = |budget: &[&str]| {
        let output = episodes(&[&["prune", dir.path().to_str().unwrap(), "--yes"][..], budget].concat());
        (code(&output), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    for budget in [["--budget-mb", "1", "--budget-episodes", "0"], ["--budget-mb", "0", "--budget-episodes", "1"]] {
        let (ended, said) = prune(&budget);
        assert!(ended == 1 && said.contains("nothing is deleted"), "{said}");
        assert!(files.iter().all(|f| f.exists()), "{budget:?}");
    }
    let (ended, _) = prune(&["--budget-mb", "0", "--budget-episodes", "2"]);
    assert_eq!((ended, files.iter().filter(|f| f.exists()).count()), (0, 1), "this one can be kept");
}

/// Protects the newest episode, and one that is named twice: a directory counts once by however many ways it is named, and a wrong name is no empty
/// budget.
#[test]
fn a_directory_that_is_named_twice_counts_once() {
    let dir = tempfile::tempdir().unwrap();
    let recorded = dir.path().join("recorded");
    let file = write(&recorded, 50.0);
    let other = dir.path().join("other");
    std::os::unix::fs::symlink(&recorded, &other).unwrap();
    let ways = [recorded.clone(), recorded.join("../recorded"), other, file.clone()].map(|p| p.display().to_string());
    let [plain, dots, link, name] = ways.each_ref().map(String::as_str);
    let prune = |words: &[&str]| code(&episodes(&[&["prune", "--budget-mb", "0", "--budget-episodes", "1", "--yes"][..], words].concat()));
    assert_eq!((prune(&[plain, plain, dots, link, name]), file.exists()), (0, true));
    assert_eq!(prune(&[plain, "nowhere"]), 2);
    assert_eq!((code(&episodes(&["delete", name, name, "--yes"])), file.exists()), (0, false), "it is deleted, so nothing is wrong");
}

/// Protects weights and data sets: of two copies of a measurement the weighed one is taken, whichever comes first, and what is still being written is
/// left out by name and exit code.
#[test]
fn a_merge_keeps_the_weight_and_waits_for_the_end() {
    let dir = tempfile::tempdir().unwrap();
    let recorded = dir.path().join("recorded");
    let first = write(&recorded, 50.0);
    let [second, third] = ["episode-0007.mcap", "episode-0008.mcap"].map(|name| recorded.join(name));
    for (copy, weight_g) in [(&second, 104.0), (&third, 105.0)] {
        std::fs::copy(&first, copy).unwrap();
        shared::episode::set_weight(copy, weight_g).unwrap();
    }
    let copied = |command: &[&str], to: &str| {
        let to = dir.path().join(to);
        let output = episodes(&[&[command[0], recorded.to_str().unwrap(), "--to", to.to_str().unwrap()][..], &command[1..]].concat());
        let to = if command[0] == "split" { to.join("all") } else { to };
        let files = shared::episode::find_episodes(&[to]).unwrap();
        let weights: Vec<Option<f64>> = files.iter().map(|f| Episode::read(f).unwrap().weight_g).collect();
        (code(&output), weights, String::from_utf8(output.stdout).unwrap())
    };
    for (command, to) in [(&["merge"][..], "merged"), (&["split", "--share", "all=1"], "parts")] {
        let (ended, weights, said) = copied(command, to);
        assert_eq!((ended, weights), (0, vec![Some(104.0)]), "{said}");
        assert!(said.contains("whose weight is 104 g and not 105 g"), "{said}");
    }
    let held = std::fs::File::open(&first).unwrap();
    held.try_lock().unwrap();
    let bytes = std::fs::read(write(&dir.path().join("cut"), 60.0)).unwrap();
    std::fs::write(recorded.join("episode-0009.mcap"), &bytes[..bytes.len() * 2 / 3]).unwrap();
    let (ended, weights, said) = copied(&["merge"], "later");
    assert_eq!((ended, weights), (1, vec![Some(104.0)]), "{said}");
    assert!(said.contains("it is being written") && said.contains("it may be under way"), "{said}");
}

/// Protects judgements from the data that was trained on: the parts of a split share no measurement, the same seed gives the same parts, and
/// merging them gives all episodes back, each once, under new numbers.
#[test]
fn parts_share_nothing_and_merge_to_the_whole() {
    let dir = tempfile::tempdir().unwrap();
    let recorded = dir.path().join("recorded");
    let files: Vec<PathBuf> = (0..5).map(|n| write(&recorded, 50.0 + n as f32)).collect();
    std::fs::copy(&files[0], recorded.join("twice.mcap")).unwrap();
    assert_eq!(code(&episodes(&["note", files[4].to_str().unwrap(), "--text", "askew"])), 0);
    let split = |name: &str, shares: &[&str]| {
        let to = dir.path().join(name);
        let output = episodes(&[&["split", recorded.to_str().unwrap(), "--to", to.to_str().unwrap(), "--json"][..], shares].concat());
        (code(&output), String::from_utf8(output.stdout).unwrap().replace(name, ""), to)
    };
    let shares = ["--share", "train=0.6", "--share", "check=0.4"];
    let (ended, said, to) = split("first", &shares);
    assert_eq!(ended, 0, "{said}");
    let count = |part: &str| std::fs::read_dir(to.join(part)).unwrap().count();
    assert_eq!((count("train"), count("check")), (3, 2));
    assert!(said.contains("the same measurement"), "{said}");
    assert_eq!(split("other", &shares).1, said, "the same seed");
    assert_eq!(split("third", &["--share", "a=0.9", "--share", "b=0.9"]).0, 2);
    assert_eq!(split("third", &["--share", "../a=0.9"]).0, 2);
    let merged = dir.path().join("merged");
    let output =
        episodes(&["merge", to.join("train").to_str().unwrap(), to.join("check").to_str().unwrap(), "--to", merged.to_str().unwrap()]);
    assert_eq!(code(&output), 0);
    let read = |dir: &Path| {
        let files = shared::episode::find_episodes(&[dir.to_path_buf()]).unwrap();
        let mut all: Vec<([u8; 32], String)> =
            files.iter().map(|f| Episode::read(f).unwrap()).map(|e| (e.content_sha256(), e.info.note)).collect();
        all.sort();
        all.dedup();
        all
    };
    assert_eq!(read(&merged), read(&recorded));
    assert!(merged.join("episode-0005.mcap").exists() && !merged.join("episode-0006.mcap").exists());

    let bytes = std::fs::read(&files[1]).unwrap();
    let cut = dir.path().join("cut.mcap");
    std::fs::write(&cut, &bytes[..bytes.len() - 100]).unwrap();
    assert_eq!(code(&episodes(&["recover", cut.to_str().unwrap()])), 0);
    assert!(Episode::read(&dir.path().join("cut-recovered.mcap")).unwrap().complete, "only the index was missing");
    assert_eq!(code(&episodes(&["recover", files[1].to_str().unwrap()])), 2, "nothing to recover");
    assert_eq!(code(&episodes(&["recover", cut.to_str().unwrap()])), 1, "nothing is overwritten");
}

/// Protects a directory from half a split: names that are taken, by a file, a link to nothing or another episode of the same name, are all said in one
/// line before anything is written, a directory too.
#[test]
fn names_that_are_taken_are_all_said_before_anything_is_written() {
    let dir = tempfile::tempdir().unwrap();
    let [monday, tuesday, to] = ["monday", "tuesday", "parts"].map(|name| dir.path().join(name));
    let files: Vec<PathBuf> = (0..3).map(|n| write(&monday, 50.0 + n as f32)).collect();
    let name = |k: usize| files[k].file_name().unwrap();
    let split = |from: &[&Path]| {
        let from = from.iter().map(|p| p.to_str().unwrap());
        let words: Vec<&str> = ["split"].into_iter().chain(from).chain(["--to", to.to_str().unwrap(), "--share", "all=1"]).collect();
        let output = episodes(&words);
        (code(&output), String::from_utf8_lossy(&output.stderr).into_owned())
    };
    // The second day has an episode of the same name as the first day.
    let other = write(&tuesday, 70.0);
    std::fs::rename(&other, tuesday.join(name(1))).unwrap();
    let (ended, said) = split(&[&monday, &tuesday]);
    assert_eq!((ended, said.lines().count()), (1, 1), "{said}");
    assert!(said.contains(name(1).to_str().unwrap()) && !said.contains(name(0).to_str().unwrap()), "{said}");
    assert!(!to.exists(), "nothing was made");

    for format in ["images", "video"] {
        let from = [&monday, &tuesday, &to].map(|p| p.to_str().unwrap());
        let output = episodes(&["export", from[0], from[1], "--as", format, "--to", from[2]]);
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        assert_eq!((code(&output), said.lines().count(), to.exists()), (1, 1, false), "{said}");
        assert!(said.contains("come twice: episode-0002"), "{said}");
    }

    let all = to.join("all");
    std::fs::create_dir_all(&all).unwrap();
    std::fs::write(all.join(name(0)), b"a letter").unwrap();
    std::os::unix::fs::symlink("nowhere", all.join(name(2))).unwrap();
    let (ended, said) = split(&[&monday]);
    assert_eq!((ended, said.lines().count()), (1, 1), "{said}");
    assert!([0, 2].iter().all(|k| said.contains(name(*k).to_str().unwrap())) && !said.contains(name(1).to_str().unwrap()), "{said}");
    assert_eq!(std::fs::read_dir(&all).unwrap().count(), 2, "nothing was written");
    assert_eq!(std::fs::read(all.join(name(0))).unwrap(), b"a letter");

    // Numbers are given above all that are there, and what is in their memory by mistake does not use them up.
    std::fs::write(all.join(".last-number"), u64::MAX.to_string()).unwrap();
    let output = episodes(&["merge", monday.to_str().unwrap(), "--to", all.to_str().unwrap()]);
    assert_eq!(code(&output), 0, "{}", String::from_utf8_lossy(&output.stderr));
    assert_eq!(std::fs::read(all.join(name(0))).unwrap(), b"a letter");
    assert!(!all.join("episode-0000.mcap").exists(), "the number after the largest is none");
}

/// Protects whoever works on a disk that is full: it is called so by every command that writes, the episode is not said to be damaged, and nothing is left
/// that looks like a result. It takes root, for a small file system of its own.
#[test]
fn a_full_disk_is_called_so() {
    let dir = tempfile::tempdir().unwrap();
    let file = write(dir.path(), 50.0);
    let bytes = std::fs::read(&file).unwrap();
    let cut = dir.path().join("cut.mcap");
    std::fs::write(&cut, &bytes[..bytes.len() - 100]).unwrap();
    let small = dir.path().join("small");
    std::fs::create_dir(&small).unwrap();
    // The one file there is an episode, and the rest of the space is taken.
    let script = r#"mount -t tmpfs -o size=1m tmpfs "$0" && cp "$1" "$0/e.mcap" && dd if=/dev/zero of="$0/fill" bs=4k status=none 2>/dev/null
        shift; "$@"; code=$?; cmp "$0/e.mcap" "$FILE" >&2; ls -A "$0"; exit $code"#;
    let run = |words: &[&str]| {
        let mut command = Command::new("unshare");
        command.args(["-m", "--propagation", "private", "sh", "-c", script]).arg(&small).arg(&file).env("FILE", &file);
        command.arg(env!("CARGO_BIN_EXE_feature-worker")).args(words).output().unwrap()
    };
    if code(&run(&["--version"])) != 0 {
        println!("not run: it takes root");
        return;
    }
    let [cut, here] = [&cut, &small].map(|p| p.to_str().unwrap());
    let [own, table] = ["e.mcap", "new.mcap"].map(|name| small.join(name).display().to_string());
    let other = write(dir.path(), 60.0).display().to_string();
    let file = file.to_str().unwrap();
    for words in [
        &["episodes", "recover", cut, "--to", &table][..],
        &["episodes", "weigh", &own, "--weight", "80"],
        &["episodes", "note", &own, "--text", "askew"],
        &["episodes", "merge", &other, "--to", here],
        &["episodes", "split", file, "--to", here, "--share", "new=1"],
        &["episodes", "export", file, "--as", "csv", "--to", here],
        &["episodes", "export", file, "--as", "images", "--to", here],
        &["episodes", "export", file, "--as", "video", "--to", here],
    ] {
        let output = run(words);
        let (said, left) = (String::from_utf8_lossy(&output.stderr), String::from_utf8_lossy(&output.stdout));
        assert_eq!((code(&output), said.lines().count()), (1, 1), "{words:?}: {said}");
        assert!(said.contains("the disk is full"), "{words:?}: {said}");
        // A directory for a part, and the memory of numbers, may have been made before.
        let left: Vec<&str> = left.lines().filter(|name| ![".last-number", "new"].contains(name)).collect();
        assert_eq!(left, ["e.mcap", "fill"], "{words:?}");
    }
}
