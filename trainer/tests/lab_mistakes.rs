//! Mistakes of a laboratory that leave every single episode sound, with the real program and real tables: each is named, and right data are not accused.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

mod common;

use std::path::Path;
use std::process::Command;

use trainer::data::TrainingEpisode;

/// Writes the CSV pair of the episodes.
fn tables(dir: &Path, episodes: &[TrainingEpisode]) {
    let measured = episodes.iter().flat_map(|e| &e.alpha_measured_deg).any(|deg| deg.is_finite());
    let mut features = format!("episode,frame,t_s,alpha_deg,area_px2{}\n", if measured { ",alpha_measured_deg" } else { "" });
    let mut scale = String::from("episode,weight_g\n");
    for e in episodes {
        for k in 0..e.len() {
            let more = if measured { format!(",{:.4}", e.alpha_measured_deg[k]) } else { String::new() };
            features += &format!("{},{k},{:.4},{:.4},{:.2}{more}\n", e.name, e.t_s[k], e.alpha_deg[k], e.area_px2[k]);
        }
        scale += &format!("{},{}\n", e.name, e.weight_g);
    }
    std::fs::write(dir.join("f.csv"), features).unwrap();
    std::fs::write(dir.join("s.csv"), scale).unwrap();
}

/// Runs a command of the trainer on the tables of these episodes: its exit code, what it said, and whether it wrote weights.
fn run(episodes: &[TrainingEpisode], command: &str) -> (Option<i32>, String, bool) {
    let dir = tempfile::tempdir().unwrap();
    tables(dir.path(), episodes);
    let out: &[&str] = if matches!(command, "train" | "refine") { &["--out", "w.bin"] } else { &[] };
    let run = Command::new(env!("CARGO_BIN_EXE_trainer"))
        .current_dir(dir.path())
        .args([command, "f.csv", "--scale", "s.csv"])
        .args(out)
        .output()
        .unwrap();
    let said = format!("{}{}", String::from_utf8_lossy(&run.stdout), String::from_utf8_lossy(&run.stderr));
    (run.status.code(), said, dir.path().join("w.bin").exists())
}

/// The commands that say what is wrong. All of them for the first seed: a training takes seconds, and says what `check` does.
fn commands(seed: u64) -> impl Iterator<Item = &'static str> {
    ["check", "plan", "train", "refine"].into_iter().take(if seed == 1 { 4 } else { 2 })
}

/// Protects the pours from the weight of the cup: as many grams in every weight do not contradict each other, and made pours of 100 ml small by 10 to 70 ml.
/// They are said by every command, and nothing is refined from them.
#[test]
fn a_cup_that_was_never_tared_is_named() {
    let words = "the weights fit the areas only if each is ";
    for (cup_g, seed) in [(0.0, 1), (0.0, 2), (0.0, 3), (30.0, 1), (30.0, 2), (150.0, 3), (-15.0, 1)] {
        let mut all = common::episodes(10, seed);
        all.iter_mut().for_each(|e| e.weight_g += cup_g);
        for command in commands(seed) {
            let (code, said, is_written) = run(&all, command);
            let side = if cup_g > 0.0 { "more" } else { "less" };
            let named = said.lines().filter(|l| l.contains(words) && l.contains(&format!(" g {side} than what flowed: was the cup tared")));
            // Single weights that do not fit the others may be asked about first.
            let asks = command == "refine" && said.contains("the other episodes say");
            assert_eq!(named.count() > 0 || asks, cup_g != 0.0, "{command}, a cup of {cup_g} g: {said}");
            let refuses = command == "refine" && cup_g != 0.0;
            assert_eq!(is_written, matches!(command, "train" | "refine") && !refuses, "{command}, a cup of {cup_g} g: {said}");
            assert!(!refuses || code == Some(2), "{said}");
        }
    }
}

/// Takes frames out of an episode as a program does that numbers what it got: those that come after have the numbers of the lost ones.
fn lose(e: &mut TrainingEpisode, is_lost: impl Fn(usize) -> bool) {
    for column in [&mut e.t_s, &mut e.alpha_deg, &mut e.alpha_measured_deg, &mut e.area_px2] {
        let mut k = 0;
        column.retain(|_| (k += 1, !is_lost(k - 1)).1);
    }
}

/// Protects the calibration from frames that were lost without a gap in their numbers: what flowed in them is on the scale alone, and a fifth of them made
/// pours small by a fifth. Times that jitter, or are rounded to ms, are no lost frames.
#[test]
fn frames_that_were_lost_and_not_numbered_are_named() {
    let (words, frames_of) = (": its stream lasts ", |said: &str| said.matches("left out: ").count());
    let mut all = common::episodes(5, 1);
    all.iter_mut().enumerate().for_each(|(k, e)| lose(e, |frame| frame % 5 == k));
    let (code, said, is_written) = run(&all, "train");
    assert!(code == Some(2) && !is_written && frames_of(&said) == 5 && said.matches(words).count() == 5, "{said}");
    // One of five.
    let mut all = common::episodes(5, 1);
    lose(&mut all[3], |frame| frame % 20 == 7);
    let (code, said, is_written) = run(&all, "train");
    assert!(code == Some(0) && is_written && frames_of(&said) == 1 && said.contains("left out: 4: its stream lasts "), "{said}");
    let mut all = common::episodes(5, 1);
    for e in &mut all {
        e.t_s.iter_mut().enumerate().for_each(|(k, t_s)| *t_s = ((*t_s + 0.003 * ((k * k) as f64).sin()) * 1000.0).round() / 1000.0);
    }
    let (code, said, _) = run(&all, "train");
    assert!(code == Some(0) && frames_of(&said) == 0, "{said}");
}

/// Protects the estimate from a column that was copied: a joint that follows at once made the model late by what the robot is, and pours small by 6 ml.
/// A joint that really was measured is taken.
#[test]
fn a_measured_tilt_that_was_copied_is_named() {
    for (late_frames, is_joint) in [(0, false), (2, true)] {
        let mut all = common::episodes(5, 1);
        for e in &mut all {
            e.alpha_measured_deg = (0..e.len()).map(|k| e.alpha_deg[k.saturating_sub(late_frames)]).collect();
        }
        for command in ["train", "check"] {
            let (code, said, is_written) = run(&all, command);
            let named = said.matches(": the measured tilt is the commanded one, which no joint follows at once").count();
            assert_eq!((code == Some(0), named), (is_joint, if is_joint { 0 } else { 5 }), "{command}: {said}");
            assert_eq!(is_written, is_joint && command == "train", "{said}");
        }
    }
}

/// Protects the pours after a camera was moved from the gain that it had before: one or two newest episodes are too few for another gain to count, and that is
/// said. Where nothing was moved, nothing is.
#[test]
fn a_gain_that_only_the_newest_episodes_have_is_suspected() {
    for (n, newest, gain) in [(5, 0, 1.0), (8, 0, 1.0), (5, 1, 0.8), (8, 2, 0.85), (5, 2, 1.2)] {
        let mut all = common::episodes(n, 4);
        all.iter_mut().skip(n - newest).flat_map(|e| &mut e.area_px2).for_each(|area_px2| *area_px2 *= gain);
        let (_, said, _) = run(&all, "train");
        let line = said.lines().find(|l| l.contains("the camera's gain may have changed by "));
        let side = if gain > 1.0 { "by +" } else { "by -" };
        let named = line.is_some_and(|l| l.contains(side) && l.contains(&format!(" % with {}, but", n - newest + 1)));
        assert_eq!((line.is_some(), named), (newest > 0, newest > 0), "{n}, the newest {newest} times {gain}: {said}");
    }
}

/// Protects whoever chooses a cell from a data set that shrinks without a word: episodes that do not name theirs are counted and named, as nobody said that
/// they do not count. Those of the other cells are left out as it was asked.
#[test]
fn episodes_without_a_cell_are_named_where_a_cell_is_chosen() {
    let dir = tempfile::tempdir().unwrap();
    let all = common::episodes(7, 1);
    tables(dir.path(), &all);
    let cells = ["lab", "", "lab", "lab", "other", "", "lab"];
    let rows = all.iter().zip(cells).map(|(e, cell)| format!("{},{},{cell}\n", e.name, e.weight_g));
    std::fs::write(dir.path().join("s.csv"), format!("episode,weight_g,cell\n{}", rows.collect::<String>())).unwrap();
    let words = "left out: 2 episodes without the name of a cell, and --cell takes only those that name theirs: 2, 6";
    for more in [&["--cell", "lab"][..], &["--cell", "lab", "--cell", "other"]] {
        for command in [&["train", "--out", "w.bin"][..], &["refine", "--out", "w.bin"], &["check"], &["plan", "--holds", "500"]] {
            let args = [command, more, &["f.csv", "--scale", "s.csv"]].concat();
            let out = Command::new(env!("CARGO_BIN_EXE_trainer")).current_dir(dir.path()).args(&args).output().unwrap();
            let said = String::from_utf8_lossy(&out.stderr);
            assert!(out.status.success() && said.matches(words).count() == 1, "{args:?}: {said}");
        }
    }
}

/// Protects the calibration from two weights that were entered for each other, of which each alone is within what the others leave in doubt: pours were off
/// by up to 17 ml without a word. Each command names both, and nothing is refined from them. Right weights are not accused.
#[test]
fn weights_that_were_entered_for_each_other_are_named() {
    for (swapped, seed) in [(false, 1), (false, 2), (true, 1), (true, 2), (true, 3)] {
        let mut all = common::episodes(6, seed);
        // Two weights that are nearly the same are not to be told apart.
        let by_weight = |a: &usize, b: &usize| all[*a].weight_g.total_cmp(&all[*b].weight_g);
        let lightest = (0..all.len()).min_by(by_weight).unwrap();
        let heaviest = (0..all.len()).max_by(by_weight).unwrap();
        let names = swapped.then_some((lightest.min(heaviest), lightest.max(heaviest))).map(|(one, other)| {
            (all[one].weight_g, all[other].weight_g) = (all[other].weight_g, all[one].weight_g);
            (all[one].name.clone(), all[other].name.clone())
        });
        for command in commands(seed) {
            let (_, said, is_written) = run(&all, command);
            let is_named = names.as_ref().is_some_and(|(one, other)| {
                said.lines().any(|l| l.contains(&format!("{one}: weight ")) && l.contains(&format!(" g, and that of {other} is ")))
            });
            // Single weights that do not fit the others are asked about first.
            let asks = command == "refine" && said.contains("the other episodes say");
            assert_eq!(is_named || asks, swapped, "{command}, {names:?}: {said}");
            assert!(swapped || !said.contains("exchanged, these two"), "{command}: {said}");
            assert_eq!(is_written, command == "train" || command == "refine" && !swapped, "{command}, {names:?}: {said}");
        }
    }
}
