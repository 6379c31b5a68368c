//! Episode numbers and weight files that are not what they should be.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::collections::BTreeSet;
use std::os::unix::fs::PermissionsExt;
use std::path::PathBuf;
use std::time::Duration;

use tests::{CellUnderTest, steady_weights};

/// Records one short curve and gives its number and its file. It has both, however it ends: what a machine that stalls ends early, too.
fn record(cell: &CellUnderTest) -> (u64, PathBuf) {
    cell.fill();
    let output = cell.command("rt-controller", &["record", "--lambda", "30", "--gamma", "2", "--json"]);
    let said = String::from_utf8_lossy(&output.stderr);
    assert!(matches!(output.status.code(), Some(0 | 4)), "{said}");
    let result: serde_json::Value = serde_json::from_slice(&output.stdout).expect("JSON");
    let number = result["outcome"]["episode"].as_u64().expect("a number");
    (number, result["episode_file"].as_str().expect("recorded").into())
}

/// Protects weights on the scale from the wrong episode: over restarts of the controller, with files that were moved into a folder, renamed or
/// moved away, no number and no name comes twice. The wall clock has no part in it, so that one that repeats cannot harm.
#[test]
fn numbers_come_from_the_directory_and_never_repeat() {
    let mut cell = CellUnderTest::start(|_| {});
    let episodes = cell.dir.path().join("episodes");
    let (mut numbers, mut files) = (BTreeSet::new(), BTreeSet::new());
    let mut note = |(number, file): (u64, PathBuf)| {
        assert!(number < 1_000_000, "{number} is no wall clock's");
        assert!(numbers.insert(number), "{number} twice");
        assert!(files.insert(file.clone()), "{} twice", file.display());
        assert!(file.ends_with(format!("episode-{number:04}.mcap")), "{number}: {}", file.display());
        file
    };
    let first = note(record(&cell));
    std::fs::create_dir(episodes.join("monday")).expect("writable");
    std::fs::rename(first, episodes.join("monday/episode-0001.mcap")).expect("there");
    std::fs::write(episodes.join("monday/episode-0040 (copy).mcap"), b"").expect("writable");
    assert_eq!(cell.stop("rt-controller"), Some(0));
    std::fs::remove_file(episodes.join(".last-number")).expect("there");
    cell.spawn("rt-controller");
    cell.wait_idle();
    let second = note(record(&cell));
    assert!(second.ends_with("episode-0041.mcap"), "{}", second.display());
    std::fs::rename(second, cell.dir.path().join("away.mcap")).expect("there");
    assert_eq!(cell.stop("rt-controller"), Some(0));
    cell.spawn("rt-controller");
    cell.wait_idle();
    note(record(&cell));

    // Who tidies up while the controller runs: the first of these has a number that was ready before. A number that comes again is worse than a file's name:
    // who follows an episode finds the outcome of an older one with its number, and is told at once that it is done.
    std::fs::rename(&episodes, cell.dir.path().join("tidied")).expect("ours");
    for _ in 0..3 {
        note(record(&cell));
    }

    // A refused order uses no number up.
    let (before, _) = record(&cell);
    for _ in 0..3 {
        assert_eq!(cell.command("rt-controller", &["pour", "20"]).status.code(), Some(5), "no weights");
    }
    assert_eq!(record(&cell).0, before + 1);
}

/// Protects the controller's memory and its end from what lies where weights should: a huge file, a pipe, a file of another user or one that
/// everybody may write is refused with its reason, nothing waits for it, and SIGTERM ends the controller.
#[test]
fn what_is_no_weight_file_is_refused_at_once() {
    let mut cell = CellUnderTest::start(|_| {});
    let put = |make: &dyn Fn(&std::path::Path)| {
        let new = cell.weights().with_extension("new");
        let _ = std::fs::remove_file(&new);
        make(&new);
        std::fs::rename(&new, cell.weights()).expect("same directory");
    };
    let refused = |word: &str| {
        let shown = |s: &serde_json::Value| s["hindrance"].as_str().is_some_and(|h| h.contains(word));
        cell.wait(word, Duration::from_secs(5), shown);
    };
    put(&|new| std::fs::File::create(new).and_then(|f| f.set_len(3 << 30)).expect("sparse"));
    refused("bytes are too many");
    let kib = std::fs::read_to_string(format!("/proc/{}/status", cell.pid("rt-controller"))).expect("it runs");
    let rss = kib.lines().find_map(|l| l.strip_prefix("VmHWM:")?.split_whitespace().next()?.parse::<u64>().ok()).expect("a number");
    assert!(rss < 100_000, "{rss} KiB resident");
    put(&|new| assert!(std::process::Command::new("mkfifo").arg(new).status().expect("coreutils").success()));
    refused("not a regular file");
    let open_to_all = |new: &std::path::Path| {
        steady_weights(13).write(new).expect("writable");
        std::fs::set_permissions(new, std::fs::Permissions::from_mode(0o666)).expect("ours");
    };
    put(&open_to_all);
    refused("everybody may write");
    if rustix::process::geteuid().is_root() {
        put(&|new| {
            steady_weights(13).write(new).expect("writable");
            std::os::unix::fs::chown(new, Some(65534), None).expect("root may");
        });
        refused("belongs to user 65534");
    }
    put(&open_to_all);
    refused("everybody may write");
    // What the refusal asks for is enough: neither the file nor its time is another one.
    std::fs::set_permissions(cell.weights(), std::fs::Permissions::from_mode(0o644)).expect("ours");
    cell.wait("the weights", Duration::from_secs(5), |s| s["hindrance"] == "");
    put(&|new| assert!(std::process::Command::new("mkfifo").arg(new).status().expect("coreutils").success()));
    std::thread::sleep(Duration::from_millis(200));
    assert_eq!(cell.stop("rt-controller"), Some(0), "{}", cell.log("rt-controller"));
}
