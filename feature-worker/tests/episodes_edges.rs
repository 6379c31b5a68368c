//! `feature-worker episodes` on directories that are not as they should be: beyond the ten thousandth episode, with links that lead nowhere, incomplete
//! episodes, copies into the directory that they come from, and two changes at once.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::{Duration, SystemTime, UNIX_EPOCH};

use serde_json::Value;
use shared::config::Config;
use shared::episode::{Episode, EpisodeEnd, EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow, set_weight};
use shared::messages::{Feature, LAYOUT_VERSION, Telemetry};

/// Writes the episode `number`, all at one time of the wall clock; its measurement is its own.
fn write(directory: &Path, number: u64, complete: bool) -> PathBuf {
    write_at(directory, number, complete, UNIX_EPOCH)
}

/// The same at a time of the wall clock.
fn write_at(directory: &Path, number: u64, complete: bool, wall_clock: SystemTime) -> PathBuf {
    let config = Config::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
    let kind = EpisodeKind::Pour { goal_ml: 50.0 };
    let start = EpisodeStart { episode: number, kind, started_at_ns: 1, wall_clock, config: &config, weights: "" };
    let mut writer = EpisodeWriter::create(directory, &start).unwrap();
    let feature = Feature { captured_at_ns: 2, sequence: 1, area_px2: number as f32, ..Default::default() };
    writer.frame(&FrameRow { feature: &feature, alpha_commanded_deg: 0.0, alpha_measured_deg: 0.0, image: None }).unwrap();
    writer.finish(&EpisodeEnd { complete, reason: "over", disordered_frames: 0 }).unwrap()
}

/// Protects who types a weight: one that is far from the pour's own estimate, as by a slipped decimal point, is taken and remarked, by `weigh` and by
/// `check`; one that is near is not.
#[test]
fn a_slipped_decimal_point_is_remarked() {
    let dir = tempfile::tempdir().unwrap();
    let config = Config::read(&Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml")).unwrap();
    let kind = EpisodeKind::Pour { goal_ml: 80.0 };
    let start = EpisodeStart { episode: 1, kind, started_at_ns: 1, wall_clock: UNIX_EPOCH, config: &config, weights: "" };
    let mut writer = EpisodeWriter::create(dir.path(), &start).unwrap();
    writer.telemetry(&Telemetry { version: LAYOUT_VERSION, tick: 1, at_ns: 2, poured_ml: 82.0, ..Default::default() }).unwrap();
    for sequence in 1..40 {
        let area_px2 = if (10..20).contains(&sequence) { 100.0 } else { 0.0 };
        let feature = Feature { version: LAYOUT_VERSION, captured_at_ns: 2 + sequence, sequence, area_px2, ..Default::default() };
        writer.frame(&FrameRow { feature: &feature, alpha_commanded_deg: 0.0, alpha_measured_deg: 0.0, image: None }).unwrap();
    }
    let file = writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 }).unwrap();
    let file = file.to_str().unwrap();
    for (weight, far) in [("820", true), ("8.2", true), ("90", false)] {
        let weighed = episodes(&["weigh", file, "--weight", weight]);
        assert_eq!(
            (code(&weighed), text(&weighed.stderr).contains("ml by the pour's own estimate")),
            (0, far),
            "{}",
            text(&weighed.stderr)
        );
        let checked = text(&episodes(&["check", file]).stdout);
        assert_eq!(checked.contains("82.0 ml by the pour's own estimate"), far, "{checked}");
    }
}

fn episodes(arguments: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_feature-worker")).arg("episodes").args(arguments).output().unwrap()
}

fn code(output: &Output) -> i32 {
    output.status.code().unwrap()
}

fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}

/// Protects the newest recording of a lab that has made ten thousand, on a machine whose clock stands still: as text it would be the oldest, the first
/// that is deleted, and the last that is listed.
#[test]
fn the_ten_thousandth_is_the_newest() {
    let dir = tempfile::tempdir().unwrap();
    let directory = dir.path().to_str().unwrap();
    let [before, newest] = [9999, 10_000].map(|number| write(dir.path(), number, true));
    let listed: Value = serde_json::from_slice(&episodes(&["list", directory, "--json"]).stdout).unwrap();
    let names: Vec<&str> = listed["episodes"].as_array().unwrap().iter().map(|e| e["file"].as_str().unwrap()).collect();
    assert_eq!(names, [before.to_str().unwrap(), newest.to_str().unwrap()]);
    assert_eq!(code(&episodes(&["prune", directory, "--budget-mb", "0", "--budget-episodes", "1", "--yes"])), 0);
    assert_eq!((before.exists(), newest.exists()), (false, true));
}

/// Protects the newest recordings of a machine whose clock went back: they have the largest numbers, so they are not the oldest, and the newest of all is
/// never pruned. Another directory's episodes are older or newer by the time.
#[test]
fn a_clock_that_went_back_makes_nothing_old() {
    let dir = tempfile::tempdir().unwrap();
    let [cell, other] = ["cell", "other"].map(|name| dir.path().join(name));
    let day = |n: u32| UNIX_EPOCH + Duration::from_secs(86_400) * n;
    let files = [
        write_at(&cell, 1, true, day(8)),
        write_at(&cell, 2, true, day(10)),
        write_at(&cell, 3, true, day(1)),
        write_at(&cell, 4, true, day(2)),
        write_at(&other, 5, true, day(9)),
        write_at(&other, 6, true, day(11)),
    ];
    let [cell, other] = [&cell, &other].map(|p| p.to_str().unwrap());
    for (budget, kept) in [("4", [false, true, true, true, false, true]), ("2", [false, false, false, true, false, true])] {
        let pruned = episodes(&["prune", cell, other, "--budget-mb", "0", "--budget-episodes", budget, "--yes"]);
        assert_eq!((code(&pruned), files.each_ref().map(|f| f.exists())), (0, kept), "{}", text(&pruned.stderr));
    }
}

/// Protects who tries again after an export of nothing: no directory that it made stays, and one that was there does.
#[test]
fn an_export_of_nothing_leaves_no_directory() {
    let dir = tempfile::tempdir().unwrap();
    let file = write(dir.path(), 1, true);
    let own = dir.path().join("own");
    std::fs::create_dir(&own).unwrap();
    for format in ["images", "video", "lerobot"] {
        for to in [&dir.path().join("new/deeper"), &own] {
            let output = episodes(&["export", file.to_str().unwrap(), "--as", format, "--to", to.to_str().unwrap()]);
            let said = text(&output.stderr);
            assert!(code(&output) == 2 && said.contains("no images"), "{format}: {said}");
            assert!(!dir.path().join("new").exists() && own.read_dir().unwrap().count() == 0, "{format}, {}", to.display());
        }
    }
}

/// Protects who prunes a folder away from any cell: what the command line says in full needs no configuration. One that is named must be there.
#[test]
fn a_folder_is_pruned_without_a_configuration() {
    let dir = tempfile::tempdir().unwrap();
    let recorded = dir.path().join("recorded");
    let files = [1, 2, 3].map(|number| write(&recorded, number, true));
    let prune = |more: &[&str]| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_feature-worker"));
        command.env_remove(shared::config::VARIABLE).current_dir(dir.path()).args(["episodes", "prune", "--yes"]).args(more);
        code(&command.output().unwrap())
    };
    assert_eq!(prune(&["recorded"]), 2, "nobody says how much may stay");
    assert_eq!(prune(&["--budget-episodes", "2"]), 2, "nobody says where");
    assert_eq!(prune(&["recorded", "--budget-episodes", "2", "--config", "lab.toml"]), 2, "it is not there");
    assert_eq!(files.each_ref().map(|file| file.exists()), [true; 3]);
    assert_eq!(prune(&["recorded", "--budget-episodes", "2"]), 0);
    assert_eq!(files.each_ref().map(|file| file.exists()), [false, true, true]);
    assert_eq!(prune(&["recorded", "--budget-mb", "1000"]), 0);
}

/// Protects the newer recordings of a directory into which older ones were merged later: the number of a copy says nothing of its age.
#[test]
fn a_copy_is_as_old_as_its_original() {
    let dir = tempfile::tempdir().unwrap();
    let [may, june, all] = ["may", "june", "all"].map(|name| dir.path().join(name));
    let day = |n: u32| UNIX_EPOCH + Duration::from_secs(86_400) * n;
    for (directory, number, at) in [(&may, 1, 5), (&may, 2, 6), (&june, 5, 35), (&june, 6, 36)] {
        write_at(directory, number, true, day(at));
    }
    for from in [&june, &may] {
        assert_eq!(code(&episodes(&["merge", from.to_str().unwrap(), "--to", all.to_str().unwrap()])), 0);
    }
    let pruned = episodes(&["prune", all.to_str().unwrap(), "--budget-mb", "0", "--budget-episodes", "2", "--yes"]);
    let there = [1, 2, 3, 4].map(|number| all.join(format!("episode-000{number}.mcap")).exists());
    assert_eq!((code(&pruned), there), (0, [true, true, false, false]), "{}", text(&pruned.stderr));
}

/// Protects who counts episodes from a disk that is not mounted: a link that leads nowhere is an episode that cannot be read, and said.
#[test]
fn a_link_that_leads_nowhere_is_said() {
    let dir = tempfile::tempdir().unwrap();
    write(dir.path(), 1, true);
    std::os::unix::fs::symlink("/not/mounted/episode-0002.mcap", dir.path().join("episode-0002.mcap")).unwrap();
    let list = episodes(&["list", dir.path().to_str().unwrap()]);
    assert_eq!(code(&list), 1);
    assert!(text(&list.stdout).contains("episode-0002.mcap        UNREADABLE: "), "{}", text(&list.stdout));
}

/// Protects who learns from a table or a data set: an episode whose end is missing looks whole there, so it is left out by name; and where nothing is
/// left, each reason is said, and nothing is said to be exported.
#[test]
fn an_incomplete_episode_is_no_row_of_a_table() {
    let dir = tempfile::tempdir().unwrap();
    let recorded = dir.path().join("recorded");
    let [whole, cut] = [(1, true), (2, false)].map(|(number, complete)| write(&recorded, number, complete));
    set_weight(&whole, 104.0).unwrap();
    let to = |name: &str| dir.path().join(name).display().to_string();
    let export = |format: &str, to: &str| episodes(&["export", recorded.to_str().unwrap(), "--as", format, "--to", to]);
    let table = export("csv", &to("table"));
    assert_eq!(code(&table), 1);
    assert!(text(&table.stdout).contains(&format!("left out: {}: it is incomplete", cut.display())), "{}", text(&table.stdout));
    let read = shared::episode::read_table(&dir.path().join("table/features.csv"), &dir.path().join("table/scale.csv")).unwrap();
    assert_eq!(read.iter().map(|e| e.weight_g).collect::<Vec<_>>(), [Some(104.0)]);

    for format in ["images", "video", "lerobot"] {
        let none = export(format, &to(format));
        let said = text(&none.stderr);
        assert_eq!((code(&none), text(&none.stdout).as_str()), (2, ""), "{format}: {said}");
        assert!(said.contains("no episode can be exported; ") && said.contains("the episode has no images"), "{format}: {said}");
        assert!([whole.display(), cut.display()].iter().all(|name| said.contains(&name.to_string())), "{format}: {said}");
    }
}

/// Protects a data set from doubles: a merge into one of its own directories leaves what lies there as it is, and adds the others.
#[test]
fn a_merge_into_its_own_directory_doubles_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let [monday, tuesday] = ["monday", "tuesday"].map(|day| dir.path().join(day));
    write(&monday, 1, true);
    write(&tuesday, 2, true);
    let merged = episodes(&["merge", monday.to_str().unwrap(), tuesday.to_str().unwrap(), "--to", monday.to_str().unwrap()]);
    assert_eq!(code(&merged), 0, "{}", text(&merged.stderr));
    assert!(text(&merged.stdout).contains("it lies there already"), "{}", text(&merged.stdout));
    let there = shared::episode::find_episodes(std::slice::from_ref(&monday)).unwrap();
    let areas: Vec<f32> = there.iter().map(|file| Episode::read(file).unwrap().rows[0].area_px2).collect();
    assert_eq!(areas, [1.0, 2.0]);
}

/// Protects a collection from doubles: a merge that is done again copies nothing, and what lies there without the weight that its copy has by now is named
/// with it.
#[test]
fn a_merge_that_is_done_again_copies_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let [monday, all] = ["monday", "all"].map(|name| dir.path().join(name));
    let [first, _] = [1, 2].map(|number| write(&monday, number, true));
    let merge = || {
        let merged = episodes(&["merge", monday.to_str().unwrap(), "--to", all.to_str().unwrap()]);
        assert_eq!(code(&merged), 0, "{}", text(&merged.stderr));
        (shared::episode::find_episodes(std::slice::from_ref(&all)).unwrap().len(), text(&merged.stdout))
    };
    assert_eq!(merge().0, 2);
    set_weight(&first, 104.0).unwrap();
    let (there, said) = merge();
    assert_eq!(there, 2, "{said}");
    let other = all.join("episode-0001.mcap");
    assert!(said.contains(&format!("it lies there already, as {}, which is not weighed: here it is 104 g", other.display())), "{said}");
}

/// Protects a weight from a note that another program writes at the same moment, and the note from it: what was said to be written is there, and
/// nothing else.
#[test]
fn two_changes_at_once_lose_nothing() {
    let dir = tempfile::tempdir().unwrap();
    let path = write(dir.path(), 1, true);
    let file = path.to_str().unwrap();
    for round in 1..=20u32 {
        let note = format!("round {round}");
        let (weighed, noted) = std::thread::scope(|threads| {
            let weighs = threads.spawn(|| episodes(&["weigh", file, "--weight", &round.to_string()]));
            let notes = threads.spawn(|| episodes(&["note", file, "--text", &note]));
            (code(&weighs.join().unwrap()) == 0, code(&notes.join().unwrap()) == 0)
        });
        let episode = Episode::read(&path).unwrap();
        assert!(!weighed || episode.weight_g == Some(f64::from(round)), "round {round}: {:?}", episode.weight_g);
        assert!(!noted || episode.info.note == note, "round {round}: {}", episode.info.note);
    }
    assert_eq!(std::fs::read_dir(dir.path()).unwrap().count(), 1, "no temporary file is left");
}

/// Protects somebody's files from a data set: a directory with a part of one is left as it is.
#[test]
fn a_part_of_a_data_set_is_not_written_over() {
    let dir = tempfile::tempdir().unwrap();
    let recorded = write(dir.path(), 1, true);
    let mine = dir.path().join("set/videos/observation.images.camera/chunk-000/file-000.mp4");
    std::fs::create_dir_all(mine.parent().unwrap()).unwrap();
    std::fs::write(&mine, "mine").unwrap();
    let output = episodes(&["export", recorded.to_str().unwrap(), "--as", "lerobot", "--to", dir.path().join("set").to_str().unwrap()]);
    assert_eq!((code(&output), std::fs::read(&mine).unwrap()), (1, b"mine".to_vec()), "{}", text(&output.stderr));
}

/// Protects what is learned from tables, of which the newest ones count where something has changed: episodes are in the order of their age. A number tells it where
/// a clock went back, and the time that of a copy.
#[test]
fn tables_are_in_the_order_of_age() {
    let dir = tempfile::tempdir().unwrap();
    let recorded = dir.path().join("recorded");
    for (number, days) in [(3, 3), (4, 1), (5, 2)] {
        write_at(&recorded, number, true, UNIX_EPOCH + Duration::from_secs(days * 86_400));
    }
    std::fs::rename(recorded.join("episode-0005.mcap"), recorded.join("episode-0009.mcap")).unwrap();
    let to = dir.path().join("csv");
    assert_eq!(code(&episodes(&["export", recorded.to_str().unwrap(), "--as", "csv", "--to", to.to_str().unwrap()])), 0);
    let tables = shared::episode::read_table(&to.join("features.csv"), &to.join("scale.csv")).unwrap();
    assert_eq!(tables.iter().map(|e| e.rows[0].area_px2).collect::<Vec<_>>(), [5.0, 3.0, 4.0]);
}
