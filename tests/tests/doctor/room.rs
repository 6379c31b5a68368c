//! Episodes that are over their budget, and a disk that they fill.

use std::time::{Duration, Instant};

use tests::{CellUnderTest, Namespaces};

use super::{examine, line};

/// Records a short curve; gives what the command said.
fn record(cell: &CellUnderTest) -> String {
    cell.wait_idle();
    let output = cell.command("rt-controller", &["record", "--json", "--lambda", "5", "--gamma", "2"]);
    String::from_utf8_lossy(&[output.stdout, output.stderr].concat()).into_owned()
}

/// Waits until the worker has said `words`.
fn wait_for(cell: &CellUnderTest, words: &str) {
    let until = Instant::now() + Duration::from_secs(10);
    while !cell.log("feature-worker").contains(words) {
        assert!(Instant::now() < until, "{words}: {}", cell.log("feature-worker"));
        std::thread::sleep(Duration::from_millis(50));
    }
}

/// Protects the disk, and whoever believes that an episode was recorded: episodes over their budget are said by the recorder and by the doctor, and
/// none is deleted; a disk that is nearly full takes no more episodes, which the worker, the command and the doctor say.
#[test]
fn the_disk_is_not_filled_in_silence() {
    let mut cell = CellUnderTest::prepare(|c| {
        c["recording"].as_table_mut().expect("a table").insert("budget_episodes".into(), 1.into());
    });
    let Some(inside) = Namespaces::new(None) else { return };
    let episodes = cell.dir.path().join("episodes");
    std::fs::create_dir(&episodes).expect("ours");
    let mut mount = inside.command("mount");
    let mounted = mount.args(["-t", "tmpfs", "-o", "size=400m", "tmpfs"]).arg(&episodes).status().expect("it runs");
    assert!(mounted.success());
    let in_episodes = |inside: &Namespaces, script: &str| {
        let output = inside.command("sh").args(["-c", script]).current_dir("/").env("EPISODES", &episodes).output().expect("it runs");
        String::from_utf8_lossy(&output.stdout).trim().to_owned()
    };
    cell.inside = Some(inside);
    cell.spawn_all();
    let count = |cell: &CellUnderTest| in_episodes(cell.inside.as_ref().expect("there"), "ls $EPISODES/*.mcap | wc -l");

    let said = record(&cell);
    assert!(said.contains("episode-0001.mcap"), "{said}");
    assert_eq!(line(&examine(&cell).0, "files", "episodes' budget").0, "green");
    assert!(!cell.log("feature-worker").contains("the budget is"), "{}", cell.log("feature-worker"));
    let said = record(&cell);
    assert!(said.contains("episode-0002.mcap"), "{said}");
    wait_for(&cell, "2 episodes, ");
    let (verdict, words) = line(&examine(&cell).0, "files", "episodes' budget");
    assert!(
        verdict == "red" && words.contains("MB together; the budget is 1 episode") && words.contains("decant episodes prune"),
        "{words}"
    );
    assert_eq!(count(&cell), "2", "nothing is deleted by itself");

    in_episodes(cell.inside.as_ref().expect("there"), "head -c 360000000 /dev/zero > $EPISODES/other");
    let said = record(&cell);
    assert!(said.contains("nothing is recorded"), "{said}");
    wait_for(&cell, "nothing is recorded");
    let (verdict, words) = line(&examine(&cell).0, "files", "episodes");
    assert!(verdict == "red" && words.contains("nothing more is recorded"), "{words}");
    assert_eq!(count(&cell), "2");
}
