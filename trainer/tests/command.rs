//! Tests of the command line, with the real program and real files.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

mod common;

use std::path::Path;
use std::process::{Command, Output};

fn trainer(dir: &Path, args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_trainer")).current_dir(dir).args(args).output().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Writes the CSV pair of `n` episodes; weights pass through `weight`.
fn tables(dir: &Path, n: usize, weight: impl Fn(usize, f64) -> f64) {
    tables_timed(dir, n, weight, |_, t_s| t_s);
}

/// The same; times pass through `time`.
fn tables_timed(dir: &Path, n: usize, weight: impl Fn(usize, f64) -> f64, time: impl Fn(usize, f64) -> f64) {
    let mut features = String::from("episode,frame,t_s,alpha_deg,area_px2\n");
    let mut scale = String::from("episode,weight_g\n");
    for (k, e) in common::episodes(n, 1).iter().enumerate() {
        for i in 0..e.len() {
            features += &format!("{},{i},{:.4},{:.4},{:.2}\n", e.name, time(k, e.t_s[i]), e.alpha_deg[i], e.area_px2[i]);
        }
        scale += &format!("{},{}\n", e.name, weight(k, e.weight_g));
    }
    std::fs::write(dir.join("f.csv"), features).unwrap();
    std::fs::write(dir.join("s.csv"), scale).unwrap();
}

/// Protects the way of people with their own vision: tables in, a weight file and its origin out, inspected and reported.
#[test]
fn tables_become_weights() {
    let dir = tempfile::tempdir().unwrap();
    tables(dir.path(), 4, |_, w| w);
    let run = |args: &[&str]| {
        let out = trainer(dir.path(), args);
        assert!(out.status.success(), "{args:?}: {}{}", text(&out.stdout), text(&out.stderr));
        text(&out.stdout)
    };
    run(&["train", "f.csv", "--scale", "s.csv", "--out", "w.bin"]);
    let all: serde_json::Value = serde_json::from_str(&run(&["inspect", "w.bin", "--json"])).unwrap();
    let beside: serde_json::Value = serde_json::from_str(&std::fs::read_to_string(dir.path().join("w.bin.json")).unwrap()).unwrap();
    assert_eq!(all["identity"], beside["identity"]);
    assert_eq!(all["data_sha256"], beside["data_sha256"]);
    assert_eq!(all["weights"]["network"]["w2"].as_array().unwrap().len(), 32);
    assert!(run(&["inspect", "w.bin"]).contains("4-32-32-21"));
    run(&["report", "w.bin.json", "--out", "r.html"]);
    let page = std::fs::read_to_string(dir.path().join("r.html")).unwrap();
    assert!(page.contains("<svg") && !page.contains("http://www.") | page.contains("xmlns") && !page.contains("<script"));
    run(&["refine", "f.csv", "--scale", "s.csv", "--out", "w2.bin"]);
    let same = std::fs::read(dir.path().join("w.bin")).unwrap() == std::fs::read(dir.path().join("w2.bin")).unwrap();
    assert!(same, "the same data and seed give the same bytes, whichever command trains");
}

/// Protects learning from every pour: a weight that does not fit is not swallowed; nothing is written until it is answered.
#[test]
fn refine_asks_about_a_wrong_weight() {
    let dir = tempfile::tempdir().unwrap();
    tables(dir.path(), 6, |k, w| if k == 2 { 2.0 * w + 30.0 } else { w });
    let out = trainer(dir.path(), &["refine", "f.csv", "--scale", "s.csv", "--out", "w.bin"]);
    let said = text(&out.stderr);
    assert_eq!(out.status.code(), Some(2));
    assert!(said.contains("the other episodes say") && said.contains("--leave-out 3") && !dir.path().join("w.bin").exists(), "{said}");
    let out = trainer(dir.path(), &["refine", "f.csv", "--scale", "s.csv", "--leave-out", "3", "--out", "w.bin"]);
    assert!(out.status.success() && dir.path().join("w.bin").exists(), "{}", text(&out.stderr));
    let out = trainer(dir.path(), &["check", "f.csv", "--scale", "s.csv"]);
    assert_eq!(out.status.code(), Some(1));
    assert!(text(&out.stdout).contains("doubtful: 3: weight"), "{}", text(&out.stdout));
}

/// Protects the controller's estimate from a mixture: of two frame rates only the more frequent one is trained on, and what was left out is named.
#[test]
fn another_frame_rate_is_left_out() {
    let dir = tempfile::tempdir().unwrap();
    tables_timed(dir.path(), 5, |_, w| w, |k, t_s| if k == 0 { 1.2 * t_s } else { t_s });
    let out = trainer(dir.path(), &["train", "f.csv", "--scale", "s.csv", "--out", "w.bin"]);
    let words = "left out: 1: 25 frames a second, and the others have 30: train on one frame rate only";
    assert!(out.status.success() && text(&out.stderr).contains(words), "{}", text(&out.stderr));
    let said = text(&trainer(dir.path(), &["inspect", "w.bin", "--json"]).stdout);
    let all: serde_json::Value = serde_json::from_str(&said).unwrap();
    assert_eq!(all["weights"]["rate_hz"], 30.0, "{said}");
    assert_eq!(trainer(dir.path(), &["check", "f.csv", "--scale", "s.csv"]).status.code(), Some(1));
}

/// Protects whoever exported episodes before all were weighed: those without a weight are left out by name, and the others teach.
#[test]
fn an_unweighed_episode_of_a_table_is_left_out() {
    let dir = tempfile::tempdir().unwrap();
    tables(dir.path(), 5, |_, w| w);
    let scale = std::fs::read_to_string(dir.path().join("s.csv")).unwrap();
    let without_3: String = scale.lines().filter(|line| !line.starts_with("3,")).map(|line| format!("{line}\n")).collect();
    std::fs::write(dir.path().join("s.csv"), without_3).unwrap();
    let out = trainer(dir.path(), &["train", "f.csv", "--scale", "s.csv", "--out", "w.bin"]);
    assert!(out.status.success() && text(&out.stderr).contains("left out: 3: no weight"), "{}", text(&out.stderr));
    // A curve that poured nothing, and weights that may belong to another table's episodes.
    tables(dir.path(), 5, |k, w| if k == 1 { 0.0 } else { w });
    let out = trainer(dir.path(), &["train", "f.csv", "--scale", "s.csv", "--out", "w.bin"]);
    assert!(out.status.success() && text(&out.stderr).contains("left out: 2: weight 0 g: nothing was poured"), "{}", text(&out.stderr));
    std::fs::copy(dir.path().join("f.csv"), dir.path().join("g.csv")).unwrap();
    let out = trainer(dir.path(), &["train", "f.csv", "g.csv", "--scale", "s.csv", "--out", "x.bin"]);
    assert_eq!(out.status.code(), Some(2));
    assert!(text(&out.stderr).contains("--scale goes with one table of features"), "{}", text(&out.stderr));
}

/// Protects the way back from a delay that is cut off: pictures that are later than any modelled delay are not trained on in silence.
#[test]
fn a_delay_beyond_the_model_is_said() {
    let dir = tempfile::tempdir().unwrap();
    tables(dir.path(), 4, |_, w| w);
    let features = std::fs::read_to_string(dir.path().join("f.csv")).unwrap();
    let rows: Vec<Vec<&str>> = features.lines().map(|l| l.split(',').collect()).collect();
    let area = |k: usize| rows[k.saturating_sub(20)].get(4).filter(|_| k > 20 && rows[k - 20][0] == rows[k][0]).map_or("0", |a| a);
    let late: String = rows
        .iter()
        .enumerate()
        // The joint follows its commands half a frame late: without its measured angle, the delay may be the joint's.
        .map(|(k, r)| {
            let deg = |k: usize| rows[k.max(1)][3].parse::<f64>().unwrap();
            match k {
                0 => format!("{},{},{},{},{},alpha_measured_deg\n", r[0], r[1], r[2], r[3], r[4]),
                _ => format!("{},{},{},{},{},{:.4}\n", r[0], r[1], r[2], r[3], area(k), 0.5 * (deg(k) + deg(k - 1))),
            }
        })
        .collect();
    std::fs::write(dir.path().join("late.csv"), late).unwrap();
    for (table, says) in [("f.csv", false), ("late.csv", true)] {
        let out = trainer(dir.path(), &["train", table, "--scale", "s.csv", "--out", "w.bin"]);
        assert_eq!(
            text(&out.stderr).contains("doubtful: the pictures seem to be late by 13 frames or more"),
            says,
            "{table}: {}",
            text(&out.stderr)
        );
    }
}

/// Protects an afternoon of training: limits whose way back no weight file can hold at the episodes' frame rate are refused before the work, by the names
/// of the keys.
#[test]
fn limits_that_no_weight_file_can_hold_are_refused_before_the_training() {
    let dir = tempfile::tempdir().unwrap();
    // Ten frames a second: every third frame of thirty.
    tables(dir.path(), 4, |_, w| w);
    let features = std::fs::read_to_string(dir.path().join("f.csv")).unwrap();
    let mut slow = String::from("episode,frame,t_s,alpha_deg,area_px2\n");
    for row in features.lines().skip(1).map(|l| l.split(',').collect::<Vec<_>>()) {
        let frame: u64 = row[1].parse().unwrap();
        if frame.is_multiple_of(3) {
            slow += &format!("{},{},{},{},{}\n", row[0], frame / 3, row[2], row[3], row[4]);
        }
    }
    std::fs::write(dir.path().join("slow.csv"), slow).unwrap();
    let config = std::fs::read_to_string(Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
    let changed = config.replace("rate_deg_s = 60.0", "rate_deg_s = 150.0").replace("rate_deg_s = 90.0", "rate_deg_s = 150.0");
    assert_eq!(changed.matches("rate_deg_s = 150.0").count(), 2);
    std::fs::write(dir.path().join("c.toml"), changed).unwrap();
    let train = ["train", "slow.csv", "--scale", "s.csv", "--config", "c.toml", "--out", "w.bin"];
    let out = trainer(dir.path(), &[&train[..], &["--progress"]].concat());
    let said = text(&out.stderr);
    let words = "return_rate_deg_s 150 is 15.000 degrees a frame at 10 frames a second, but must be 0.1 to 10: change it or camera.fps";
    assert!(out.status.code() == Some(2) && said.contains(words) && !said.contains("\"stage\""), "{said}");
    let out = trainer(dir.path(), &[&train[..], &["--method", "paper", "--estimate", "sum"]].concat());
    assert!(!text(&out.stderr).contains("camera.fps"), "the plain sum knows no way back: {}", text(&out.stderr));
}

/// Protects people whose own vision counts in ms or us: they are told, and nothing panics.
#[test]
fn times_are_in_seconds() {
    for factor in [1e3, 1e6] {
        let dir = tempfile::tempdir().unwrap();
        tables_timed(dir.path(), 4, |_, w| w, |_, t_s| factor * t_s);
        let out = trainer(dir.path(), &["train", "f.csv", "--scale", "s.csv", "--out", "w.bin"]);
        let said = text(&out.stderr);
        assert!(out.status.code() == Some(2) && said.contains("frames a second: t_s must be in seconds"), "{factor}: {said}");
    }
}

/// Protects whoever has a small vessel or a small cup: the least vessel is said, and it is planned for; a cell whose largest goal is below 40 ml gets
/// pours, too.
#[test]
fn small_vessels_and_goals_are_planned_for() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("none")).unwrap();
    let said = text(&trainer(dir.path(), &["plan", "none", "--holds", "60"]).stderr);
    let least = said.split("take one that holds ").nth(1).and_then(|rest| rest.split(' ').next()).unwrap_or_else(|| panic!("{said}"));
    let out = trainer(dir.path(), &["plan", "none", "--holds", least]);
    assert!(out.status.success() && text(&out.stdout).contains("record a curve"), "{}", text(&out.stderr));
    tables(dir.path(), 3, |_, w| w);
    let out = trainer(dir.path(), &["plan", "f.csv", "--scale", "s.csv", "--holds", "520", "--goal-max", "30"]);
    assert!(text(&out.stdout).contains("and pour: rt-controller pour 30"), "{}{}", text(&out.stdout), text(&out.stderr));
}

/// Protects the proposals from a figure that means nothing: goals that show no stream give no deviation of 0 ml, but are refused.
#[test]
fn goals_of_a_drop_are_not_planned_for() {
    let dir = tempfile::tempdir().unwrap();
    tables(dir.path(), 4, |_, w| w);
    let out = trainer(dir.path(), &["plan", "f.csv", "--scale", "s.csv", "--holds", "500", "--goal-max", "1"]);
    assert!(out.status.code() == Some(1) && text(&out.stderr).contains("give --goal-max "), "{}{}", text(&out.stdout), text(&out.stderr));
}

/// Protects whoever opens a page of somebody else's figures: they are text, and numbers that no plot can hold end nothing.
#[test]
fn figures_of_others_are_only_shown() {
    let dir = tempfile::tempdir().unwrap();
    let script = "<script>alert(1)</script>";
    let values = ["sim", "container", "change", "rigs", "first_rig", "seeds", "episodes", "weighed"];
    let evaluation: serde_json::Map<_, _> = values.iter().map(|key| ((*key).to_owned(), script.into())).collect();
    let mut evaluation = serde_json::Value::Object(evaluation);
    evaluation["kind"] = "evaluation".into();
    std::fs::write(dir.path().join("e.json"), evaluation.to_string()).unwrap();
    std::fs::write(dir.path().join("t.json"), r#"{"kind":"training","loss":[1e308,-1e308,1e-320]}"#).unwrap();
    let out = trainer(dir.path(), &["report", "e.json", "t.json", "--out", "r.html"]);
    assert!(out.status.success(), "{}", text(&out.stderr));
    let page = std::fs::read_to_string(dir.path().join("r.html")).unwrap();
    assert!(!page.contains("<script") && page.matches("&lt;script").count() >= values.len(), "{page}");
}

/// Protects the first hour with a vessel: without anything weighed a curve is proposed if the vessel's volume is known, after curves a pour, as
/// words and as JSON; and `check` names what fast curves alone do not span.
#[test]
fn what_to_weigh_next_is_said() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("none")).unwrap();
    let out = trainer(dir.path(), &["plan", "none"]);
    assert!(out.status.code() == Some(2) && text(&out.stderr).contains("--holds"), "{}", text(&out.stderr));
    let out = trainer(dir.path(), &["plan", "none", "--holds", "500", "--json"]);
    let first: serde_json::Value = serde_json::from_str(&text(&out.stdout)).unwrap();
    let next = &first["plan"]["candidates"][0]["next"];
    assert!(next["kind"] == "curve" && next["fill_ml"].as_f64().unwrap() <= 460.0, "{first}");

    tables(dir.path(), 3, |_, w| w);
    let plan = ["plan", "f.csv", "--scale", "s.csv", "--holds", "520", "--goal-max", "120"];
    let out = trainer(dir.path(), &plan);
    let said = text(&out.stdout);
    assert!(out.status.success() && said.contains("and pour: rt-controller pour") && said.contains("standard deviation"), "{said}");
    let out = trainer(dir.path(), &[&plan[..], &["--json"]].concat());
    let then: serde_json::Value = serde_json::from_str(&text(&out.stdout)).unwrap();
    let next = &then["plan"]["candidates"][0]["next"];
    assert!(next["kind"] == "pour" && (40.0..=120.0).contains(&next["goal_ml"].as_f64().unwrap()), "{then}");

    let out = trainer(dir.path(), &["check", "f.csv", "--scale", "s.csv", "--json"]);
    let found: serde_json::Value = serde_json::from_str(&text(&out.stdout)).unwrap();
    assert!(found["spanned"]["weights_g"][1].as_f64() > Some(20.0) && found["missing"].is_array(), "{found}");
}

/// Protects the operator from a wrong file: one line, exit code 2, no panic.
#[test]
fn wrong_files_are_refused_in_one_line() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::write(dir.path().join("x.bin"), b"no weights").unwrap();
    std::fs::write(dir.path().join("x.json"), b"{}").unwrap();
    for args in [
        &["inspect", "x.bin"][..],
        &["inspect", "missing.bin"],
        &["report", "x.json", "--out", "r.html"],
        &["train", "missing", "--out", "w.bin"],
        &["check", "missing.csv", "--scale", "missing.csv"],
    ] {
        let out = trainer(dir.path(), args);
        let said = text(&out.stderr);
        assert_eq!(out.status.code(), Some(2), "{args:?}: {said}");
        assert!(said.starts_with("error: ") && said.trim_end().lines().count() == 1, "{args:?}: {said}");
    }
}

/// Protects what a person names by mistake, and the machine: a file of another kind and a device are never replaced, and what is no file holds no command.
/// A page whose place is taken is refused too. Nothing is left beside.
#[test]
fn a_slip_of_the_finger_costs_nothing() {
    let dir = tempfile::tempdir().unwrap();
    tables(dir.path(), 2, |_, w| w);
    for name in ["pipe", "pipe.csv", "pipe.json"] {
        assert!(Command::new("mkfifo").arg(dir.path().join(name)).status().unwrap().success());
    }
    std::os::unix::fs::symlink("/dev/null", dir.path().join("device")).unwrap();
    std::fs::File::create(dir.path().join("huge.csv")).and_then(|f| f.set_len(6 << 30)).unwrap();
    std::fs::write(dir.path().join("e.mcap"), "an episode").unwrap();
    std::fs::write(dir.path().join("new.bin.json"), "notes").unwrap();
    std::fs::write(dir.path().join("t.json"), r#"{"kind":"training"}"#).unwrap();
    let train = ["train", "f.csv", "--scale", "s.csv", "--out"];
    let before = std::fs::read_dir(dir.path()).unwrap().count();
    for (args, words) in [
        ([&train[..], &["e.mcap"]].concat(), "e.mcap: cannot be written: is a file of another kind"),
        ([&train[..], &["pipe"]].concat(), "is not a regular file"),
        ([&train[..], &["device"]].concat(), "is not a regular file"),
        ([&train[..], &["new.bin"]].concat(), "new.bin.json: is a file of another kind"),
        (vec!["check", "pipe.csv", "--scale", "s.csv"], "is not a regular file"),
        (vec!["check", "f.csv", "--scale", "pipe.csv"], "is not a regular file"),
        (vec!["check", "f.csv", "--scale", "huge.csv"], "bytes are too many"),
        (vec!["report", "pipe.json", "--out", "r.html"], "is not a regular file"),
        // A place where nothing can be written is known before the work, which here ends at files that are not there.
        (vec!["train", "none.csv", "--scale", "none.csv", "--out", "no/w.bin"], "no file can be made in no: No such file"),
        (vec!["refine", "none.csv", "--scale", "none.csv", "--out", "no/w.bin"], "no file can be made in no: No such file"),
        (vec!["report", "none.json", "--out", "no/r.html"], "no file can be made in no: No such file"),
        (vec!["plan", "f.csv", "--scale", "s.csv", "--goal-max", "inf"], "--goal-max 1 to 5000 ml"),
    ] {
        let out = trainer(dir.path(), &args);
        let said = text(&out.stderr);
        assert_eq!((out.status.code(), said.lines().count()), (Some(2), 1), "{args:?}: {said}");
        assert!(said.contains(words), "{args:?}: {said}");
    }
    assert_eq!(std::fs::read(dir.path().join("e.mcap")).unwrap(), b"an episode");
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), before);

    let full = std::fs::File::options().write(true).open("/dev/full").unwrap();
    let mut command = Command::new(env!("CARGO_BIN_EXE_trainer"));
    let out = command.current_dir(dir.path()).args(["check", "f.csv", "--scale", "s.csv"]).stdout(full).output().unwrap();
    let said = text(&out.stderr);
    assert_eq!((out.status.code(), said.lines().count()), (Some(1), 1), "{said}");
    assert!(said.starts_with("error: standard output cannot be written: No space left"), "{said}");
}

/// Protects "offline means offline": nothing of the simulator is in the trainer.
#[test]
fn the_trainer_knows_no_simulator() {
    let out = Command::new(env!("CARGO"))
        .args(["tree", "-p", "trainer", "--edges", "normal,build", "--prefix", "none", "--offline"])
        .current_dir(env!("CARGO_MANIFEST_DIR"))
        .output()
        .unwrap();
    let tree = text(&out.stdout);
    assert!(out.status.success() && tree.contains("shared v"), "{}", text(&out.stderr));
    assert!(!tree.contains("simulator") && !tree.contains("rt-controller"), "{tree}");
}

/// Writes a cell's configuration in which `from` has become `to`.
fn cell(dir: &Path, from: &str, to: &str) {
    let text = include_str!("../../config/cell.toml");
    assert!(text.contains(from), "{from}");
    std::fs::write(dir.join("cell.toml"), text.replacen(from, to, 1)).unwrap();
}

/// Protects everybody from weights that are all wrong by one factor, which do not contradict each other: they are those of another vessel than the one
/// that is named, and weights in kilograms are none of grams. Right ones are not accused.
#[test]
fn weights_that_are_all_wrong_are_doubted() {
    let dir = tempfile::tempdir().unwrap();
    cell(dir.path(), "# holds_ml", "holds_ml");
    for (factor, says) in
        [(1.0, None), (8.0, Some("but it holds 520 ml")), (10.0, Some("decimal point")), (0.001, Some("are they in grams?"))]
    {
        tables(dir.path(), 4, |_, w| factor * w);
        // A training takes seconds, and writes whatever the factor is.
        let trains = matches!(says, None | Some("decimal point"));
        for command in ["check", "train", "refine", "plan"].into_iter().filter(|command| trains || *command != "train") {
            let mut args = vec![command, "f.csv", "--scale", "s.csv", "--config", "cell.toml"];
            args.extend(if matches!(command, "train" | "refine") { &["--out", "w.bin"][..] } else { &[] });
            let out = trainer(dir.path(), &args);
            let said = text(&out.stdout) + &text(&out.stderr);
            let accused = said.contains("grams?") || said.contains("decimal point");
            assert_eq!(accused, says.is_some(), "{command}, weights times {factor}: {said}");
            assert!(says.is_none_or(|words| said.contains(words)), "{command}, weights times {factor}: {said}");
            // What is refined goes to a controller unasked, so nothing is written until somebody accepts it.
            let is_written = || std::fs::remove_file(dir.path().join("w.bin")).is_ok();
            assert_eq!(is_written(), command == "train" || command == "refine" && says.is_none(), "{command}, weights times {factor}");
            if command == "check" {
                // The page asks what it finds here, and answers with `--accept`.
                let found: serde_json::Value =
                    serde_json::from_slice(&trainer(dir.path(), &[&args[..], &["--json"]].concat()).stdout).unwrap();
                let refused = found["refused"].as_array().unwrap();
                assert_eq!(!refused.is_empty(), says.is_some(), "weights times {factor}: {found}");
                assert!(refused.iter().all(|d| found["doubts"].as_array().unwrap().contains(d)), "weights times {factor}: {found}");
            }
            if let ("refine", Some(words)) = (command, says) {
                // Its last line, the only one that the page shows, says what is wrong, with all that is accused, and how to answer.
                let last = text(&out.stderr).lines().last().unwrap_or_default().to_owned();
                assert!(last.starts_with("error: no weights are written. ") && last.contains(words), "{last}");
                let of = |what: &str| last.matches(what).count();
                assert_eq!(of("--accept '"), of("but the vessel holds").max(1), "{last}");
            }
            if command == "refine" && said.contains("--accept 'data set'") {
                args.extend(["--accept", "data set"]);
                let out = trainer(dir.path(), &args);
                assert!(out.status.success() && is_written(), "{}", text(&out.stderr));
            }
        }
    }
    // What was learned of the vessel is no measure of what goes in, and that is said with right weights too.
    tables(dir.path(), 4, |_, w| w);
    for (holds, unknown) in [(&[][..], true), (&["--holds", "520"][..], false)] {
        let out = trainer(dir.path(), &[&["plan", "f.csv", "--scale", "s.csv"], holds].concat());
        assert_eq!(text(&out.stdout).contains("nobody says what the vessel holds"), unknown, "{}", text(&out.stdout));
    }
    // One weight above what the vessel holds is named, and nothing is planned from it.
    tables(dir.path(), 4, |k, w| if k == 2 { 1000.0 + w } else { w });
    let out = trainer(dir.path(), &["plan", "f.csv", "--scale", "s.csv", "--holds", "520"]);
    assert!(out.status.code() == Some(2) && text(&out.stderr).contains("but the vessel holds 520 ml"), "{}", text(&out.stderr));
}

/// Protects who follows a plan: it proposes no curve that the cell's limits refuse, and no goal above the cell's.
#[test]
fn what_is_proposed_is_taken() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("none")).unwrap();
    cell(dir.path(), "rate_deg_s = 90.0 ", "rate_deg_s = 20.0 ");
    let plan = ["plan", "none", "--holds", "500", "--config", "cell.toml"];
    let out = trainer(dir.path(), &[&plan[..], &["--json"]].concat());
    let found: serde_json::Value = serde_json::from_str(&text(&out.stdout)).unwrap_or_else(|_| panic!("{}", text(&out.stderr)));
    for candidate in found["plan"]["candidates"].as_array().unwrap() {
        let [lambda_deg, gamma_per_s2] = ["lambda_deg", "gamma_per_s2"].map(|key| candidate["next"][key].as_f64().unwrap());
        assert!(lambda_deg * (2.0 * gamma_per_s2).sqrt() * (-0.5f64).exp() <= 20.0, "{candidate}");
    }
    let out = trainer(dir.path(), &[&plan[..], &["--goal-max", "400"]].concat());
    assert!(out.status.code() == Some(2) && text(&out.stderr).contains("is above controller.goal_max_ml, 300"), "{}", text(&out.stderr));
}

/// Protects the camera from an accusation that is the table's: an episode whose measured tilt is in radians is left out by name, and the others
/// teach.
#[test]
fn a_measured_tilt_that_follows_nothing_is_left_out() {
    let dir = tempfile::tempdir().unwrap();
    tables(dir.path(), 5, |_, w| w);
    let features = std::fs::read_to_string(dir.path().join("f.csv")).unwrap();
    let mut before = String::from("0");
    let measured: String = features
        .lines()
        .map(|l| match l.split(',').collect::<Vec<_>>()[..] {
            ["5", _, _, alpha_deg, _] => format!("{l},{}\n", alpha_deg.parse::<f64>().unwrap().to_radians()),
            [_, _, _, "alpha_deg", _] => format!("{l},alpha_measured_deg\n"),
            // The joint follows a frame late.
            [_, _, _, alpha_deg, _] => format!("{l},{}\n", std::mem::replace(&mut before, alpha_deg.to_owned())),
            _ => panic!("{l}"),
        })
        .collect();
    std::fs::write(dir.path().join("m.csv"), measured).unwrap();
    let words = "left out: 5: the measured tilt follows the commanded one at no delay";
    let out = trainer(dir.path(), &["train", "m.csv", "--scale", "s.csv", "--out", "w.bin"]);
    assert!(out.status.success() && text(&out.stderr).contains(words), "{}", text(&out.stderr));
    let out = trainer(dir.path(), &["check", "m.csv", "--scale", "s.csv"]);
    assert!(out.status.code() == Some(1) && text(&out.stdout).contains("5 episodes, 4 usable"), "{}", text(&out.stdout));
}

/// Protects weights from claiming pictures that not all of their episodes have: those that do not say theirs are named, and the weights keep to the ones that
/// are known, as they would pour in any otherwise. Where none says them, nothing is claimed.
#[test]
fn an_episode_that_does_not_say_its_pictures_is_named() {
    let dir = tempfile::tempdir().unwrap();
    tables(dir.path(), 4, |_, w| w);
    let scale = std::fs::read_to_string(dir.path().join("s.csv")).unwrap();
    let framed = |k: usize| [",framing", ",640 480 320 100.5 0 90", ",640 480 320 100.5 0 90", ",", ",640 480 321 100.5 0 90"][k];
    let mixed: String = scale.lines().enumerate().map(|(k, line)| format!("{line}{}\n", framed(k))).collect();
    std::fs::write(dir.path().join("mixed.csv"), mixed).unwrap();
    let words = "doubtful: 3: it does not say its pictures, and is taken to be of those of the others";
    for (scale, named, pictures) in [("s.csv", false, "not known"), ("mixed.csv", true, "pictures of 640 x 480 px, the lip at (321, 10")] {
        for command in [&["train", "--out", "w.bin"][..], &["refine", "--out", "w.bin"], &["check"]] {
            let out = trainer(dir.path(), &[command, &["f.csv", "--scale", scale]].concat());
            let said = text(&out.stdout) + &text(&out.stderr);
            assert!(said.contains(words) == named && said.matches("does not say its pictures").count() == usize::from(named), "{said}");
        }
        let inspected = text(&trainer(dir.path(), &["inspect", "w.bin"]).stdout);
        assert!(inspected.contains(&format!("pictures    {pictures}")), "{inspected}");
    }
}
