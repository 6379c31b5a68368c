//! What `trainer check` finds in recordings, with the real program and real files: each fault has its own line.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

mod common;

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use shared::config::Config;
use shared::episode::{EpisodeEnd, EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow, set_weight};
use shared::gaussian_curve::Curve;
use shared::messages::{Doubt, Feature, LAYOUT_VERSION, Telemetry};

const FRAME_NS: u64 = 33_333_333;

/// One camera frame of a recording.
#[derive(Clone, Copy)]
struct Row {
    number: u64,
    at_ns: u64,
    alpha_deg: f32,
    area_px2: f32,
    doubt: Doubt,
}

/// A recording on its way into a file.
struct Recording {
    rows: Vec<Row>,
    weight_g: Option<f64>,
    finished: bool,
    copies: usize,
    /// What is entered for the copies, if it is something else.
    copy_weight_g: Option<f64>,
    /// The goal of a pour; none of a recorded curve.
    goal_ml: Option<f32>,
    /// What the controller holds for poured in the end, ml.
    poured_ml: f32,
    began: SystemTime,
    /// Width and height of the pictures, px.
    size_px: [u32; 2],
    cell: &'static str,
}

/// Recordings as they should be.
fn recordings(n: usize) -> Vec<Recording> {
    let recording = |e: &trainer::data::TrainingEpisode| {
        let row = |k: usize| Row {
            number: k as u64 + 1,
            at_ns: (k as u64 + 1) * FRAME_NS,
            alpha_deg: e.alpha_deg[k] as f32,
            area_px2: e.area_px2[k] as f32,
            doubt: Doubt::None,
        };
        Recording {
            rows: (0..e.len()).map(row).collect(),
            weight_g: Some(e.weight_g),
            finished: true,
            copies: 1,
            copy_weight_g: None,
            goal_ml: None,
            poured_ml: 0.0,
            began: UNIX_EPOCH,
            size_px: [640, 480],
            cell: "lab",
        }
    };
    common::episodes(n, 1).iter().map(recording).collect()
}

fn write(directory: &Path, recording: &Recording) -> PathBuf {
    let mut config = Config::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
    [config.camera.width_px, config.camera.height_px] = recording.size_px;
    config.cell.name = recording.cell.into();
    let curve = EpisodeKind::Recording(Curve { lambda_deg: 60.0, gamma_per_s2: 0.3, beta_s: 5.0 });
    let kind = recording.goal_ml.map_or(curve, |goal_ml| EpisodeKind::Pour { goal_ml });
    let start = EpisodeStart { episode: 1, kind, started_at_ns: FRAME_NS, wall_clock: recording.began, config: &config, weights: "" };
    let mut writer = EpisodeWriter::create(directory, &start).unwrap();
    for (k, row) in recording.rows.iter().enumerate() {
        let tick = Telemetry {
            version: LAYOUT_VERSION,
            tick: k as u64 + 1,
            at_ns: row.at_ns,
            alpha_deg: row.alpha_deg,
            poured_ml: recording.poured_ml,
            ..Default::default()
        };
        writer.telemetry(&tick).unwrap();
        let feature = Feature {
            version: LAYOUT_VERSION,
            sequence: row.number,
            captured_at_ns: row.at_ns,
            area_px2: row.area_px2,
            doubt: row.doubt as u32,
            ..Default::default()
        };
        let sample = FrameRow { feature: &feature, alpha_commanded_deg: row.alpha_deg, alpha_measured_deg: f32::NAN, image: None };
        writer.frame(&sample).unwrap();
    }
    let path = writer.path().to_path_buf();
    if !recording.finished {
        writer.flush().unwrap();
        return path;
    }
    writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 }).unwrap();
    if let Some(weight_g) = recording.weight_g {
        // A damaged file takes no weight.
        let _ = set_weight(&path, weight_g);
    }
    path
}

/// Makes the camera see nothing for some frames, from the middle of the flow on.
fn blind(recording: &mut Recording, frames: usize) {
    let flows: Vec<usize> = (0..recording.rows.len()).filter(|k| recording.rows[*k].area_px2 > 0.0).collect();
    let from = flows[flows.len() / 2];
    recording.rows[from..from + frames].iter_mut().for_each(|row| row.doubt = Doubt::EdgeNotFound);
}

/// Lets the stream leave the region in the frames that `so` names by their area and the largest one.
fn leaves(recording: &mut Recording, so: fn(f32, f32) -> bool) {
    let largest_px2 = recording.rows.iter().map(|row| row.area_px2).fold(0.0, f32::max);
    recording
        .rows
        .iter_mut()
        .filter(|row| row.area_px2 > 0.0 && so(row.area_px2, largest_px2))
        .for_each(|row| row.doubt = Doubt::LeavesRegion);
}

fn check(recordings: &[Recording]) -> Output {
    let dir = tempfile::tempdir().unwrap();
    for recording in recordings {
        let path = write(dir.path(), recording);
        for copy in 1..recording.copies {
            let to = path.with_extension(format!("{copy}.mcap"));
            std::fs::copy(&path, &to).unwrap();
            recording.copy_weight_g.map_or(Ok(()), |weight_g| set_weight(&to, weight_g).map(drop)).unwrap();
        }
    }
    Command::new(env!("CARGO_BIN_EXE_trainer")).arg("check").arg(dir.path()).output().unwrap()
}

fn said(out: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&out.stdout), String::from_utf8_lossy(&out.stderr))
}

/// Protects the fit from a measurement that counts twice, and from one with two weights, wherever among the copies the one without a weight is.
#[test]
fn of_copies_one_teaches_and_of_two_weights_none() {
    let check = |weights_g: [Option<f64>; 3]| {
        let dir = tempfile::tempdir().unwrap();
        let mut all = recordings(6);
        all[5].weight_g = None;
        for recording in &all[..5] {
            write(dir.path(), recording);
        }
        let path = write(dir.path(), &all[5]);
        let copies = [1, 2].map(|copy| path.with_extension(format!("{copy}.mcap")));
        for copy in &copies {
            std::fs::copy(&path, copy).unwrap();
        }
        for (file, weight_g) in std::iter::once(&path).chain(&copies).zip(weights_g) {
            weight_g.map_or(Ok(()), |weight_g| set_weight(file, weight_g).map(drop)).unwrap();
        }
        let said = said(&Command::new(env!("CARGO_BIN_EXE_trainer")).arg("check").arg(dir.path()).output().unwrap());
        let refused = ["no weight:", ": leave one of them out", "with another weight"].map(|words| said.matches(words).count());
        (3 - refused.iter().sum::<usize>(), refused[2])
    };
    // The copies come before the file itself, by their names.
    let (one, other) = (Some(80.0), Some(90.0));
    for (weights_g, expected) in [
        ([one, one, one], (1, 0)),
        ([None, one, one], (1, 0)),
        ([one, None, one], (1, 0)),
        ([None, one, other], (0, 2)),
        ([one, one, other], (0, 3)),
        ([one, None, other], (0, 2)),
    ] {
        assert_eq!(check(weights_g), expected, "how many teach, and how many have another weight: {weights_g:?}");
    }
}

/// Protects a measurement from a copy of it that was cut: the whole one teaches, whichever comes first.
#[test]
fn a_cut_copy_takes_no_measurement_away() {
    let dir = tempfile::tempdir().unwrap();
    let paths: Vec<_> = recordings(6).iter().map(|recording| write(dir.path(), recording)).collect();
    let bytes = std::fs::read(&paths[5]).unwrap();
    std::fs::write(dir.path().join("a-copy.mcap"), &bytes[..bytes.len() - 20]).unwrap();
    let said = said(&Command::new(env!("CARGO_BIN_EXE_trainer")).arg("check").arg(dir.path()).output().unwrap());
    assert!(said.contains("a-copy.mcap: the recording is incomplete") && said.contains("6 usable"), "{said}");
}

/// Protects the trainer from bad recordings, and people from guessing: each fault of the last of six recordings is named, and no other
/// recording is blamed.
#[test]
fn each_fault_of_a_recording_is_named() {
    type Case = (&'static str, i32, fn(&mut Recording));
    let cases: [Case; 25] = [
        ("cannot be used: FILE: no weight", 1, |r| r.weight_g = None),
        ("cannot be used: FILE: weight 0 g: nothing was poured", 1, |r| r.weight_g = Some(0.0)),
        ("cannot be used: FILE: no stream was ever seen, but the scale shows", 1, |r| r.rows.iter_mut().for_each(|f| f.area_px2 = 0.0)),
        ("cannot be used: FILE: only 20 frames", 1, |r| r.rows.truncate(20)),
        ("cannot be used: FILE: the recording is incomplete", 1, |r| r.finished = false),
        ("cannot be used: FILE: the same measurement as", 1, |r| r.copies = 2),
        // Which of the two is right cannot be known, so neither teaches.
        ("with another weight: correct one of them, or leave it out", 1, |r| (r.copies, r.copy_weight_g) = (2, Some(200.0))),
        ("cannot be used: FILE: the camera did not see part of this pour; its areas do not add up to its weight", 1, |r| blind(r, 7)),
        // A dropout on either side of the gap is no evidence that nothing flowed.
        ("cannot be used: FILE: the camera did not see part of this pour", 1, |r| {
            blind(r, 7);
            let first = r.rows.iter().position(|f| f.doubt == Doubt::EdgeNotFound).unwrap();
            (r.rows[first - 1].area_px2, r.rows[first + 7].area_px2) = (0.0, 0.0);
        }),
        ("cannot be used: FILE: pictures of 960 x 720 px and not of 640 x 480", 1, |r| r.size_px = [960, 720]),
        ("error: FILE: damaged: frame 10: commanded alpha NaN", 2, |r| r.rows[9].alpha_deg = f32::NAN),
        ("error: FILE: damaged: frame 10: commanded alpha 0", 2, |r| r.rows[9].area_px2 = -1.0),
        ("error: FILE: damaged: frame 10 comes after frame 11", 2, |r| (r.rows[9].number, r.rows[10].number) = (11, 10)),
        ("doubtful: FILE: 10 % of the frames were lost", 1, |r| {
            let mut k = 0;
            r.rows.retain(|_| (k += 1, k % 10 != 5).1);
        }),
        ("doubtful: FILE: 10 % of the images are too dark or blown out", 1, |r| {
            for (k, row) in r.rows.iter_mut().enumerate() {
                row.doubt = if k % 10 == 5 { Doubt::BlownOut } else { row.doubt };
            }
        }),
        // A few frames, in which the most flows.
        ("cannot be used: FILE: 16 % of the stream's area were seen in pictures that it leaves", 1, |r| {
            leaves(r, |area_px2, largest_px2| area_px2 > 0.9 * largest_px2)
        }),
        ("doubtful: FILE: the angle never returns", 1, |r| {
            let stays = r.rows.iter().map(|f| f.alpha_deg).fold(0.0, f32::max);
            let top = r.rows.iter().position(|f| f.alpha_deg == stays).unwrap();
            r.rows[top..].iter_mut().for_each(|f| f.alpha_deg = stays);
        }),
        ("doubtful: FILE: starts at", 1, |r| r.rows[..20].iter_mut().for_each(|f| f.alpha_deg = 30.0)),
        // What people with their own vision mistake: radians, the other sign, no angles, and a stream that is seen before the container moves.
        ("doubtful: FILE: the angle never exceeds 1.", 1, |r| r.rows.iter_mut().for_each(|f| f.alpha_deg = f.alpha_deg.to_radians())),
        ("doubtful: FILE: the angle never exceeds", 1, |r| r.rows.iter_mut().for_each(|f| f.alpha_deg = -f.alpha_deg)),
        ("doubtful: FILE: the angle never exceeds 0.0", 1, |r| r.rows.iter_mut().for_each(|f| f.alpha_deg = 0.0)),
        ("doubtful: FILE: a stream is seen from", 1, |r| {
            r.rows[..5].iter_mut().enumerate().for_each(|(k, f)| f.area_px2 = 300.0 + k as f32)
        }),
        ("cannot be used: FILE: the stream was still running in the last frames", 1, |r| {
            let largest_px2 = r.rows.iter().map(|f| f.area_px2).fold(0.0, f32::max);
            r.rows.iter_mut().rev().take(3).for_each(|f| f.area_px2 = 0.1 * largest_px2);
        }),
        // A frame that was not measured does not say that it has ended.
        ("cannot be used: FILE: the stream was still running in the last frames", 1, |r| {
            let largest_px2 = r.rows.iter().map(|f| f.area_px2).fold(0.0, f32::max);
            r.rows.iter_mut().rev().take(4).for_each(|f| f.area_px2 = 0.1 * largest_px2);
            r.rows.iter_mut().rev().skip(1).take(1).for_each(|f| f.doubt = Doubt::EdgeNotFound);
        }),
        ("doubtful: FILE: still flowing in the last frames", 1, |r| r.rows.iter_mut().rev().take(3).for_each(|f| f.area_px2 = 4.0)),
    ];
    let mut wrong = Vec::new();
    for (expected, code, spoil) in cases {
        let mut all = recordings(6);
        spoil(&mut all[5]);
        let out = check(&all);
        let said = said(&out);
        let names_it = said.lines().any(|l| {
            let mut parts = expected.split("FILE");
            let (before, after) = (parts.next().unwrap_or(""), parts.next());
            match after {
                Some(after) => l.starts_with(before) && l.contains("episode-0006") && l.contains(after),
                None => l.contains("episode-0006") && l.contains(before),
            }
        });
        let others = (1..6).any(|k| said.contains(&format!("episode-000{k}.mcap:")));
        if !names_it || others || out.status.code() != Some(code) {
            wrong.push(format!("{expected} (exit {code}):\n{said}{:?}\n", out.status.code()));
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Protects people from training on too little: the set itself is judged, and a good set passes.
#[test]
fn the_size_of_the_set_is_judged() {
    let mut wrong = Vec::new();
    for (n, code, expected) in [
        (10, 0, None),
        (5, 0, Some("too few for method paper")),
        (3, 0, Some("below 4 the camera's exponent cannot be told")),
        (0, 1, Some("no episode can be trained on")),
    ] {
        let mut all = recordings(n.max(1));
        if n == 0 {
            all[0].weight_g = None;
        }
        let out = check(&all);
        let said = said(&out);
        let doubts = said.lines().any(|l| l.starts_with("doubtful: data set"));
        if out.status.code() != Some(code) || doubts != expected.is_some() || !said.contains(expected.unwrap_or_default()) {
            wrong.push(format!("{n} episodes, {expected:?}:\n{said}"));
        }
    }
    for (slower, hz) in [(2.0, "15 "), (0.975, "30.8 ")] {
        let mut all = recordings(6);
        all[5].rows.iter_mut().for_each(|row| row.at_ns = (row.at_ns as f64 * slower) as u64);
        let out = check(&all);
        let said = said(&out);
        let words = format!("episode-0006.mcap: {hz}frames a second, and the others");
        let named = said.lines().any(|l| l.starts_with("cannot be used: ") && l.contains(&words));
        if !named || !said.contains("5 usable") || out.status.code() != Some(1) {
            wrong.push(said);
        }
    }
    assert!(wrong.is_empty(), "{}", wrong.join("\n"));
}

/// Protects what was learned after somebody touched the camera: the newest recordings are those that began last, whichever folder is named first
/// and whatever the files are called.
#[test]
fn the_newest_recordings_are_those_that_began_last() {
    let dir = tempfile::tempdir().unwrap();
    // Four older ones in a folder that is named and sorted after that of the four newer ones.
    let mut all = recordings(8);
    for (k, recording) in all.iter_mut().enumerate() {
        recording.began = UNIX_EPOCH + Duration::from_secs(1000 * k as u64);
        let folder = dir.path().join(if k < 4 { "z" } else { "a" });
        std::fs::create_dir_all(&folder).unwrap();
        write(&folder, recording);
    }
    for folders in [["a", "z"], ["z", "a"]] {
        let train = ["train", folders[0], folders[1], "--out", "w.bin"];
        let out = Command::new(env!("CARGO_BIN_EXE_trainer")).current_dir(dir.path()).args(train).output().unwrap();
        assert!(out.status.success(), "{}", said(&out));
        let beside: serde_json::Value = serde_json::from_slice(&std::fs::read(dir.path().join("w.bin.json")).unwrap()).unwrap();
        let weights: Vec<f64> = beside["episodes"].as_array().unwrap().iter().map(|e| e["weight_g"].as_f64().unwrap()).collect();
        assert_eq!(weights, all.iter().map(|r| r.weight_g.unwrap()).collect::<Vec<_>>(), "{folders:?}");
    }
}

/// Protects the table of errors after a refinement: a pour that was copied counts once, and one that was left out does not count, nor does one that was
/// stopped long before its goal, which is named.
#[test]
fn each_pour_that_is_learned_from_counts_once() {
    let dir = tempfile::tempdir().unwrap();
    for (k, mut recording) in recordings(5).into_iter().enumerate() {
        recording.goal_ml = Some(50.0 + k as f32);
        recording.poured_ml = if k == 2 { 20.0 } else { 48.0 + k as f32 };
        let path = write(dir.path(), &recording);
        if k == 0 {
            std::fs::copy(&path, path.with_extension("1.mcap")).unwrap();
        }
    }
    let refine = ["refine", ".", "--leave-out", "./episode-0005.mcap", "--out", "w.bin"];
    let out = Command::new(env!("CARGO_BIN_EXE_trainer")).current_dir(dir.path()).args(refine).output().unwrap();
    let table = String::from_utf8_lossy(&out.stdout).into_owned();
    let goals: Vec<&str> =
        table.lines().skip_while(|l| !l.starts_with("pour ")).skip(1).filter_map(|l| l.split_whitespace().nth(1)).collect();
    assert_eq!(goals, ["50.0", "51.0", "53.0"], "{}", said(&out));
    assert!(said(&out).contains("episode-0003.mcap: ended early, at 20 of 52 ml, so its error does not count"), "{}", said(&out));
}

/// Protects the calibration from a pour of which the camera missed a part, and the person who weighed it: it is left out by name, and what is learned is
/// the same as without it, while no right weight is called a typo. A gap that the controller would bridge stays, and is trained on.
#[test]
fn a_pour_that_was_not_seen_whole_is_left_out() {
    let words = "the camera did not see part of this pour; its areas do not add up to its weight";
    let weights = |all: &[Recording], command: &str| {
        let dir = tempfile::tempdir().unwrap();
        for recording in all {
            write(dir.path(), recording);
        }
        let out =
            Command::new(env!("CARGO_BIN_EXE_trainer")).current_dir(dir.path()).args([command, ".", "--out", "w.bin"]).output().unwrap();
        assert!(out.status.success(), "{}", said(&out));
        (std::fs::read(dir.path().join("w.bin")).unwrap(), String::from_utf8_lossy(&out.stderr).into_owned())
    };
    let mut four = recordings(5);
    four.remove(2);
    let (without, _) = weights(&four, "train");
    // Before a frame with flow, too, what flowed is not known.
    let spoilt: [fn(&mut Recording); 3] = [
        |r| blind(r, 7),
        |r| {
            // A second without a picture, and then no stream: what was seen is half of what was weighed.
            blind(r, 30);
            let last = r.rows.iter().rposition(|row| row.doubt == Doubt::EdgeNotFound).unwrap();
            r.rows[last + 1..].iter_mut().for_each(|row| row.area_px2 = 0.0);
        },
        |r| {
            let first = r.rows.iter().position(|row| row.area_px2 > 0.0).unwrap();
            r.rows[first - 2..first + 5].iter_mut().for_each(|row| row.doubt = Doubt::EdgeNotFound);
        },
    ];
    for (spoil, command) in spoilt.into_iter().zip(["train", "refine", "train"]) {
        let mut all = recordings(5);
        spoil(&mut all[2]);
        let (learned, said) = weights(&all, command);
        let named = said.lines().any(|l| l.starts_with("left out: ") && l.contains("episode-0003.mcap") && l.contains(words));
        assert!(named && !said.contains("a typo") && learned == without, "{said}");
    }
    let mut all = recordings(5);
    blind(&mut all[2], 6);
    let (learned, said) = weights(&all, "train");
    assert!(!said.contains("left out") && learned != without, "{said}");
}

/// Protects whoever trains without a check before it: what is doubtful about a recording is said by `train` and `refine`, too.
#[test]
fn a_training_says_what_is_doubtful_about_a_recording() {
    let dir = tempfile::tempdir().unwrap();
    let mut all = recordings(5);
    all[1].rows.iter_mut().rev().take(3).for_each(|f| f.area_px2 = 4.0);
    for recording in &all {
        write(dir.path(), recording);
    }
    for command in ["train", "refine"] {
        let out =
            Command::new(env!("CARGO_BIN_EXE_trainer")).current_dir(dir.path()).args([command, ".", "--out", "w.bin"]).output().unwrap();
        let said = said(&out);
        let named = |l: &str| l.starts_with("doubtful: ") && l.contains("episode-0002.mcap: still flowing in the last frames");
        assert!(
            out.status.success() && said.lines().filter(|l| l.starts_with("doubtful: ")).count() == 1 && said.lines().any(named),
            "{said}"
        );
    }
}

/// Protects the calibration from a mixture of two cells whose pictures are alike: no command takes them for one, and each cell is named. Those of a chosen
/// cell are what they would be alone.
#[test]
fn episodes_of_several_cells_are_refused_unless_they_are_chosen() {
    let dir = tempfile::tempdir().unwrap();
    let run = |args: &[&str]| {
        let out = Command::new(env!("CARGO_BIN_EXE_trainer")).current_dir(dir.path()).args(args).output().unwrap();
        (out.status.code(), said(&out))
    };
    let weights = || std::fs::read(dir.path().join("w.bin")).unwrap();
    let mut all = recordings(7);
    let (lab, mut others) = (all.drain(..4).collect::<Vec<_>>(), all);
    lab.iter().for_each(|r| drop(write(dir.path(), r)));
    assert_eq!(run(&["train", ".", "--out", "w.bin"]).0, Some(0));
    let alone = weights();
    others.iter_mut().for_each(|r| r.cell = "other");
    others.iter().for_each(|r| drop(write(dir.path(), r)));
    std::fs::remove_file(dir.path().join("w.bin")).unwrap();
    for args in
        [&["train", ".", "--out", "w.bin"][..], &["refine", ".", "--out", "w.bin"], &["check", "."], &["plan", ".", "--holds", "500"]]
    {
        let (code, said) = run(args);
        let named = ["lab: 4 episodes, as ./episode-0001.mcap", "other: 3 episodes, as ./episode-0005.mcap", "--cell NAME"];
        assert!(code == Some(2) && named.iter().all(|words| said.contains(words)), "{args:?}: {said}");
    }
    assert!(!dir.path().join("w.bin").exists());
    assert_eq!(run(&["train", ".", "--cell", "lab", "--out", "w.bin"]).0, Some(0));
    assert!(weights() == alone);
    let (code, said) = run(&["check", ".", "--cell", "lab", "--cell", "other"]);
    assert!(code == Some(0) && said.contains("7 episodes, 7 usable"), "{said}");
    let (code, said) = run(&["train", ".", "--cell", "third", "--out", "w.bin"]);
    assert!(code == Some(2) && said.contains("no episode of these comes from cell third; the cells that they name: lab: 4"), "{said}");
}

/// Protects whoever moved the camera, or took another one, and left the framing as it was: each command that fits the episodes says from which one on the
/// gain is another, and by how much. Episodes of one camera get no such line.
#[test]
fn a_changed_gain_is_said() {
    for (gain, says) in [(1.0, false), (1.15, true)] {
        let dir = tempfile::tempdir().unwrap();
        // Every other curve was run later, so that the gain is not confounded with the volumes.
        let (before, mut after): (Vec<_>, Vec<_>) = recordings(10).into_iter().enumerate().partition(|(k, _)| k % 2 == 0);
        after.iter_mut().flat_map(|(_, r)| &mut r.rows).for_each(|row| row.area_px2 *= gain);
        before.iter().chain(&after).for_each(|(_, r)| drop(write(dir.path(), r)));
        for args in
            [&["train", ".", "--out", "w.bin"][..], &["refine", ".", "--out", "w.bin"], &["check", "."], &["plan", ".", "--holds", "500"]]
        {
            let out = Command::new(env!("CARGO_BIN_EXE_trainer")).current_dir(dir.path()).args(args).output().unwrap();
            let said = said(&out);
            let line = said.lines().find(|l| l.starts_with("doubtful: data set: the camera's gain changed by +"));
            let named = line.is_some_and(|l| l.contains(" with ./episode-0006.mcap, ") && l.contains("without the 5 episodes before it"));
            assert!(out.status.success() && line.is_some() == says && named == says, "{args:?}: {said}");
        }
    }
}

/// Protects recordings of which only drops were seen at the region's edge: many frames with next to no area cost nothing.
#[test]
fn drops_that_leave_the_region_cost_nothing() {
    let mut all = recordings(6);
    leaves(&mut all[5], |area_px2, largest_px2| area_px2 < 0.05 * largest_px2);
    let doubtful = all[5].rows.iter().filter(|row| row.doubt == Doubt::LeavesRegion).count();
    let flowing = all[5].rows.iter().filter(|row| row.area_px2 > 0.0).count();
    let out = check(&all);
    assert!(10 * doubtful > flowing && out.status.success(), "{doubtful}: {}", said(&out));
}
