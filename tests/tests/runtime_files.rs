//! Where a cell's runtime files lie, who may touch them, that they go again, and what happens when there is no space for them.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::Path;
use std::process::{Command, Output};
use std::time::Duration;

use rustix::process::Signal;
use tests::{CellUnderTest, Namespaces, program, steady_weights};

const TILT_OUT: usize = 13;

/// Whether this test may act as root; says so if not.
fn is_root() -> bool {
    let root = rustix::process::geteuid().is_root();
    if !root {
        println!("not run: it takes root");
    }
    root
}

fn said(output: &Output) -> String {
    format!("{:?}: {}{}", output.status, String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

/// Protects a running cell from systemd-tmpfiles, and the machine from leftovers: nothing lies below `/tmp`, nobody else may enter or read,
/// whatever the umask is; after a normal end nothing is left in `/dev/shm`, and after a crash the next start clears it.
#[test]
fn files_lie_where_nobody_ages_them_and_go_again() {
    for umask in ["022", "077", "000"] {
        let mut cell = CellUnderTest::prepare(|_| {});
        for name in ["simulator", "feature-worker", "rt-controller"] {
            let mut command = Command::new("sh");
            command.args(["-c", &format!("umask {umask}; exec \"$0\" \"$@\"")]).arg(program(name));
            let log = std::fs::File::create(cell.dir.path().join(format!("{name}.log"))).expect("writable");
            cell.spawn_with(name, command, log.into());
        }
        cell.wait_idle();
        let directory = cell.runtime_dir();
        assert!(!directory.starts_with("/tmp"), "{}", directory.display());
        assert!(!Path::new(&format!("/tmp/decant_{}", cell.name)).exists());
        assert_eq!(directory.metadata().expect("made").mode() & 0o7777, 0o700, "umask {umask}");
        let shared = cell.shared_memory();
        assert!(shared.len() > 10, "{} files in shared memory", shared.len());
        for file in &shared {
            assert_eq!(file.metadata().expect("there").permissions().mode() & 0o077, 0, "umask {umask}: {}", file.display());
        }
        for name in ["rt-controller", "feature-worker", "simulator"] {
            assert_eq!(cell.stop(name), Some(0), "{}", cell.log(name));
        }
        let left = cell.shared_memory();
        assert!(left.is_empty(), "{left:?}");

        // A crash of everything leaves files, and any next start of this user clears them.
        for name in ["simulator", "feature-worker", "rt-controller"] {
            cell.spawn(name);
        }
        cell.wait_idle();
        let dead = cell.shared_memory();
        for name in ["simulator", "feature-worker", "rt-controller"] {
            cell.signal(name, Signal::KILL);
        }
        // Every start of this user clears them, also those of tests beside this one.
        assert!(!dead.is_empty());
        let other = CellUnderTest::prepare(|_| {});
        assert_eq!(other.command("rt-controller", &["status"]).status.code(), Some(3));
        assert!(!dead.iter().any(|f| f.exists()), "they are still there: {dead:?}");
    }
}

/// Protects a cell that runs from the clearing: while its processes live, starts of other cells take nothing from it, also when the directory
/// of its runtime files is in another place.
#[test]
fn a_start_clears_nothing_of_the_living() {
    let base = tempfile::Builder::new().prefix("d").tempdir_in("/tmp").expect("a directory");
    let cell = CellUnderTest::start(|config| {
        let dir = base.path().display().to_string();
        config["cell"].as_table_mut().expect("a table").insert("runtime_dir".into(), dir.into());
        config["cell"].as_table_mut().expect("a table").insert("name".into(), "own".into());
    });
    assert!(base.path().join("own/stop").exists());
    cell.take_weights(&steady_weights(TILT_OUT));
    let other = CellUnderTest::start(|_| {});
    cell.order(&["pour", "20", "--json"]);
    drop(other);
    cell.order(&["pour", "20", "--json"]);
}

/// Protects files of other programs in a directory that was named by mistake: what has the names of iceoryx2's files is not removed where no cell has
/// been, and what a cell left is.
#[test]
fn a_cell_removes_nothing_of_others_from_its_directory() {
    let base = tempfile::Builder::new().prefix("d").tempdir_in("/tmp").expect("a directory");
    let mut cell = CellUnderTest::prepare(|config| {
        let dir = base.path().display().to_string();
        config["cell"].as_table_mut().expect("a table").insert("runtime_dir".into(), dir.into());
    });
    let place = base.path().join(&cell.name);
    let theirs = [place.join("services/accounts.txt"), place.join("party.event")];
    std::fs::create_dir_all(place.join("services")).expect("writable");
    std::fs::set_permissions(&place, std::fs::Permissions::from_mode(0o700)).expect("ours");
    for file in &theirs {
        std::fs::write(file, b"theirs").expect("writable");
    }
    let output = cell.command("feature-worker", &["run"]);
    assert!(said(&output).contains("no cell left it"), "{}", said(&output));
    assert!(theirs.iter().all(|file| file.exists()), "they are gone");
    std::fs::remove_dir_all(&place).expect("ours");
    cell.spawn_all();
    for name in ["simulator", "feature-worker", "rt-controller"] {
        cell.signal(name, Signal::KILL);
    }
    cell.spawn_all();
}

/// Protects a cell from what another user prepared: a link, a directory of another user, and one that is open to others are refused by each
/// program, with one line and the same exit code.
#[test]
fn a_prepared_directory_is_refused() {
    let base = tempfile::Builder::new().prefix("d").tempdir_in("/tmp").expect("a directory");
    let cell = CellUnderTest::prepare(|config| {
        let dir = base.path().display().to_string();
        config["cell"].as_table_mut().expect("a table").insert("runtime_dir".into(), dir.into());
    });
    let place = base.path().join(&cell.name);
    let refused = |word: &str| {
        for (name, words) in [
            ("rt-controller", &["run"][..]),
            ("rt-controller", &["status"]),
            ("rt-controller", &["pour", "50"]),
            ("feature-worker", &["run"]),
        ] {
            let output = cell.command(name, words);
            let text = said(&output);
            assert_eq!(output.status.code(), Some(2), "{name}: {text}");
            assert!(text.contains("runtime directory") && text.contains(word), "{name}: {text}");
        }
    };
    std::os::unix::fs::symlink("/run", &place).expect("a link");
    refused("is a link");
    std::fs::remove_file(&place).expect("ours");
    std::fs::create_dir(&place).expect("new");
    std::fs::set_permissions(&place, std::fs::Permissions::from_mode(0o777)).expect("ours");
    refused("open to others");
    std::fs::set_permissions(&place, std::fs::Permissions::from_mode(0o700)).expect("ours");
    if is_root() {
        std::os::unix::fs::chown(&place, Some(65534), None).expect("root may");
        refused("belongs to user 65534");
    }
}

/// Protects scripts from three numbers for one thing: whichever program of a cell is started twice, the second ends with the same exit code.
#[test]
fn whoever_comes_second_ends_with_one_exit_code() {
    let cell = CellUnderTest::start(|_| {});
    for (name, word) in [
        ("rt-controller", "another rt-controller"),
        ("feature-worker", "another feature worker"),
        ("simulator", "is already being simulated"),
    ] {
        let mut second = Command::new("timeout");
        let second = second.args(["20"]).arg(program(name)).args(["run", "--config"]).arg(cell.config()).output().expect("coreutils");
        assert_eq!(second.status.code(), Some(5), "{name}: {}", said(&second));
        assert!(said(&second).contains(word), "{name}: {}", said(&second));
    }
    // Nothing is left of the first controller's files, and it still answers.
    std::fs::remove_dir_all(cell.runtime_dir()).expect("ours");
    let mut second = Command::new("timeout");
    let second =
        second.args(["20"]).arg(program("rt-controller")).args(["run", "--config"]).arg(cell.config()).output().expect("coreutils");
    assert_eq!(second.status.code(), Some(5), "{}", said(&second));
    assert!(said(&second).contains("its runtime directory was deleted"), "{}", said(&second));
}

/// Protects people from a second controller that is started by mistake, with the same configuration or with one that shares its files: it is
/// refused before it touches anything, and the journal of the first goes on. Another file in the journal's place is left alone.
#[test]
fn a_second_controller_touches_nothing() {
    let mut cell = CellUnderTest::start(|_| {});
    let journal = cell.dir.path().join("journal.bin");
    let inode = || journal.metadata().expect("there").ino();
    let first = inode();
    // A second one that is not refused would run for ever.
    let start = |config: std::path::PathBuf| {
        let mut command = Command::new("timeout");
        command.args(["20"]).arg(program("rt-controller")).args(["run", "--config"]).arg(config);
        command.output().expect("coreutils")
    };
    for _ in 0..2 {
        let second = start(cell.config());
        assert_eq!(second.status.code(), Some(5), "{}", said(&second));
        assert!(said(&second).contains("another rt-controller"), "{}", said(&second));
    }
    for key in [("controller", "weights", "weights.bin"), ("controller", "journal", "journal.bin"), ("recording", "directory", "episodes")]
    {
        let other = CellUnderTest::prepare(|config| {
            let path = cell.dir.path().join(key.2).display().to_string();
            config[key.0].as_table_mut().expect("a table").insert(key.1.into(), path.into());
        });
        let output = start(other.config());
        assert_eq!(output.status.code(), Some(5), "{}", said(&output));
        assert!(said(&output).contains(&format!("{}.{}", key.0, key.1)) && said(&output).contains(&cell.name), "{}", said(&output));
    }
    assert_eq!(inode(), first);
    assert!(!cell.dir.path().join("journal.before.bin").exists());
    assert_eq!(cell.stop("rt-controller"), Some(0));
    let replay = cell.dir.path().join("journal.bin");
    assert!(rt_controller::journal::replay(&replay, |_, _| {}).expect("a journal").ticks > 5);

    std::fs::write(&journal, b"a letter to my mother").expect("ours");
    let output = start(cell.config());
    assert_eq!(output.status.code(), Some(2), "{}", said(&output));
    assert!(said(&output).contains("is no journal"), "{}", said(&output));
    assert_eq!(std::fs::read(&journal).expect("there"), b"a letter to my mother");
}

/// Protects people with a small `/dev/shm`, as containers have: each program says in one line that there is no space, with an exit code,
/// instead of being killed.
#[test]
fn a_small_shared_memory_is_said() {
    if !is_root() {
        return;
    }
    for size in ["64k", "1m", "2m"] {
        let mut cell = CellUnderTest::prepare(|_| {});
        cell.inside = Namespaces::new(Some(size));
        if cell.inside.is_none() {
            return;
        }
        for (name, word) in [("rt-controller", "run"), ("feature-worker", "run"), ("simulator", "run"), ("rt-controller", "status")] {
            let output = cell.command(name, &[word]);
            let text = said(&output);
            if size != "64k" && word == "status" {
                assert_eq!(output.status.code(), Some(3), "{text}");
                assert!(text.contains("no answer"), "there is space for a command: {text}");
                continue;
            }
            assert!(output.status.code().is_some_and(|c| (1..=3).contains(&c)), "{size} {name} {word}: {text}");
            assert!(text.contains("/dev/shm has"), "{size} {name} {word}: {text}");
            assert_eq!(text.lines().count(), 1, "{text}");
        }
    }
}

/// Protects a pour from a `/dev/shm` that fills while the cell runs: nothing dies, the pour goes on, commands say what is wrong, and an abort
/// is obeyed.
#[test]
fn a_full_shared_memory_does_not_end_a_pour() {
    if !is_root() {
        return;
    }
    let mut cell = CellUnderTest::prepare(|_| {});
    cell.inside = Namespaces::new(Some("64m"));
    let Some(inside) = &cell.inside else { return };
    let mut filling = inside.command("sh");
    filling.args(["-c", "cat /dev/zero > /dev/shm/filler 2>/dev/null; df /dev/shm | tail -1"]);
    cell.spawn_all();
    cell.take_weights(&steady_weights(TILT_OUT));
    let pour = cell.pour_tilted();
    let filled = filling.output().expect("it runs");
    assert!(said(&filled).contains("100%"), "{}", said(&filled));
    std::thread::sleep(Duration::from_millis(700));
    let refused = cell.command("rt-controller", &["status"]);
    assert_eq!(refused.status.code(), Some(3), "{}", said(&refused));
    assert!(said(&refused).contains("/dev/shm has"), "{}", said(&refused));
    let abort = cell.command("rt-controller", &["abort"]);
    assert_eq!(abort.status.code(), Some(0), "{}{}", said(&abort), cell.log("rt-controller"));
    let output = pour.wait_with_output().expect("it ran");
    assert!(said(&output).contains("\"aborted\""), "{}\n{}{}", said(&output), cell.log("rt-controller"), cell.log("feature-worker"));
    for name in ["rt-controller", "feature-worker", "simulator"] {
        assert_eq!(cell.stop(name), Some(0), "{}", cell.log(name));
    }
}

/// Protects processes in containers: a worker and a command in PID namespaces of their own join the cell, and their start clears nothing.
#[test]
fn pid_namespaces_share_a_cell() {
    if !is_root() {
        return;
    }
    let mut cell = CellUnderTest::prepare(|_| {});
    cell.spawn("simulator");
    cell.spawn("rt-controller");
    let apart = |name: &str| {
        let mut command = Command::new("unshare");
        command.args(["--pid", "--fork", "--mount-proc", "--kill-child=TERM", "--"]).arg(program(name));
        command
    };
    if !apart("rt-controller").arg("--version").output().expect("util-linux").status.success() {
        println!("not run: no PID namespace is permitted here");
        return;
    }
    let log = std::fs::File::create(cell.dir.path().join("feature-worker.log")).expect("writable");
    cell.spawn_with("feature-worker", apart("feature-worker"), log.into());
    cell.wait_idle();
    cell.take_weights(&steady_weights(TILT_OUT));
    let pour = cell.pour_tilted();
    let status = apart("rt-controller").args(["status", "--config"]).arg(cell.config()).output().expect("it runs");
    assert_eq!(status.status.code(), Some(0), "{}", said(&status));
    let doctor = apart("decant").args(["doctor", "--config"]).arg(cell.config()).output().expect("it runs");
    let runs = format!("process {} runs", cell.pid("rt-controller"));
    for seen in [&*runs, "a feature worker runs", "publishes the frames"] {
        assert!(said(&doctor).contains(seen), "{seen}: {}", said(&doctor));
    }
    let abort = apart("rt-controller").args(["abort", "--config"]).arg(cell.config()).output().expect("it runs");
    assert_eq!(abort.status.code(), Some(0), "{}", said(&abort));
    cell.signal("rt-controller", rustix::process::Signal::STOP);
    let deaf = apart("rt-controller").args(["abort", "--config"]).arg(cell.config()).output().expect("it runs");
    cell.signal("rt-controller", rustix::process::Signal::CONT);
    assert_eq!(deaf.status.code(), Some(1), "{}", said(&deaf));
    assert!(said(&deaf).contains("does not answer, and its process is out of sight"), "{}", said(&deaf));
    assert!(said(&pour.wait_with_output().expect("it ran")).contains("\"aborted\""));
}

/// Protects a cell from what another user left in shared memory, and from memory limits: it starts all the same.
#[test]
fn leftovers_of_others_and_limits_do_not_matter() {
    if !is_root() {
        return;
    }
    let left = ["decant-0123abcd.lock", "decant-0123abcd_x.data"].map(|n| Path::new("/dev/shm").join(n));
    for file in &left {
        // A run that failed may have left it, and the kernel lets nobody write to another's file there.
        let _ = std::fs::remove_file(file);
        std::fs::write(file, b"left").expect("space");
        std::os::unix::fs::chown(file, Some(65534), Some(65534)).expect("root may");
    }
    let mut cell = CellUnderTest::prepare(|_| {});
    cell.spawn("simulator");
    cell.spawn("feature-worker");
    // A limit on locked memory, as users without rights have, and one on all memory that still suffices.
    let mut command = Command::new("sh");
    command.args(["-c", "ulimit -l 64; ulimit -v 1000000; exec \"$0\" \"$@\""]).arg(program("rt-controller"));
    let log = std::fs::File::create(cell.dir.path().join("rt-controller.log")).expect("writable");
    cell.spawn_with("rt-controller", command, log.into());
    cell.wait_idle();
    cell.take_weights(&steady_weights(TILT_OUT));
    assert_eq!(cell.order(&["pour", "20", "--json"])["outcome"]["reason"], "done");
    assert!(left.iter().all(|f| f.exists()), "what belongs to others is not removed");
    for file in &left {
        std::fs::remove_file(file).expect("root may");
    }
}

/// Protects two cells from sharing files by accident: relative paths start at the configuration, wherever one stands, and `DECANT_CONFIG` names
/// the configuration for every command.
#[test]
fn paths_belong_to_the_configuration() {
    let mut cell = CellUnderTest::prepare(|config| {
        for (section, key, path) in
            [("controller", "weights", "w.bin"), ("controller", "journal", "j.bin"), ("recording", "directory", "e")]
        {
            config[section].as_table_mut().expect("a table").insert(key.into(), path.into());
        }
    });
    let elsewhere = tempfile::tempdir().expect("a directory");
    let file = cell.config();
    let at = |name: &str, words: &[&str]| {
        let mut command = Command::new(program(name));
        command.args(words).current_dir(elsewhere.path()).env("DECANT_CONFIG", &file);
        command
    };
    cell.spawn("simulator");
    cell.spawn("feature-worker");
    let mut controller = at("rt-controller", &["run"]).stderr(std::process::Stdio::null()).spawn().expect("it starts");
    cell.wait_idle();
    let status = at("rt-controller", &["status", "--json"]).output().expect("it runs");
    let status: serde_json::Value = serde_json::from_slice(&status.stdout).expect("JSON");
    let weights = cell.dir.path().canonicalize().expect("there").join("w.bin");
    assert!(status["hindrance"].as_str().is_some_and(|h| h.contains(&weights.display().to_string())), "{status:#}");
    assert!(cell.dir.path().join("j.bin").exists());
    assert!(cell.dir.path().join("e").exists());
    assert_eq!(std::fs::read_dir(elsewhere.path()).expect("there").count(), 0, "nothing is written where one stands");
    rustix::process::kill_process(rustix::process::Pid::from_child(&controller), Signal::TERM).expect("ours");
    assert_eq!(controller.wait().expect("ours").code(), Some(0));
}

/// Protects the files of a cell that runs from a second one that names them by accident, in whatever words: through a link, a hard link or a detour, or as
/// the place to which its own journal moves; and wherever the runtime files of the two lie.
#[test]
fn two_cells_share_no_file() {
    let [base, other_base] = [(); 2].map(|()| tempfile::Builder::new().prefix("d").tempdir_in("/tmp").expect("a directory"));
    let prepare = |name: &'static str, base: &tempfile::TempDir| {
        CellUnderTest::prepare(|config| {
            let cell = config["cell"].as_table_mut().expect("a table");
            cell.insert("name".into(), name.into());
            cell.insert("runtime_dir".into(), base.path().display().to_string().into());
        })
    };
    let mut first = prepare("first", &base);
    steady_weights(TILT_OUT).write(&first.weights()).expect("writable");
    first.spawn("rt-controller");
    let until = std::time::Instant::now() + Duration::from_secs(20);
    while !base.path().join("first/controller").exists() {
        assert!(std::time::Instant::now() < until, "{}", first.log("rt-controller"));
        std::thread::sleep(Duration::from_millis(20));
    }
    let its = first.dir.path().canonicalize().expect("there");
    let (second, third) = (prepare("second", &base), prepare("third", &other_base));
    let own = second.dir.path();
    std::os::unix::fs::symlink(its.join("weights.bin"), own.join("link.bin")).expect("a link");
    std::fs::hard_link(its.join("weights.bin"), own.join("hard.bin")).expect("a link");
    std::os::unix::fs::symlink(&its, own.join("theirs")).expect("a link");
    let text = std::fs::read_to_string(second.config()).expect("there");
    for (key, mine, path) in [
        ("controller.weights", "weights.bin", own.join("link.bin")),
        ("controller.weights", "weights.bin", own.join("hard.bin")),
        ("controller.weights", "weights.bin", own.join("theirs/weights.bin")),
        ("controller.weights", "weights.bin", its.join("episodes/../weights.bin")),
        ("controller.weights", "weights.bin", its.join("journal.bin")),
        ("controller.journal", "journal.bin", its.join("journal.bin")),
        ("the journal before, controller.journal", "journal.bin", its.join("journal.dat")),
        ("recording.directory", "episodes", own.join("theirs/episodes")),
    ] {
        let other = text.replace(&own.join(mine).display().to_string(), &path.display().to_string());
        assert_ne!(other, text);
        std::fs::write(second.config(), other).expect("writable");
        let output = second.command("rt-controller", &["run"]);
        let said = said(&output);
        assert_eq!(output.status.code(), Some(5), "{}: {said}", path.display());
        assert!(said.contains(&format!("error: {key} = ")) && said.contains("cell 'first' uses it as"), "{}: {said}", path.display());
    }
    let text = std::fs::read_to_string(third.config()).expect("there");
    let other = text.replace(&third.weights().display().to_string(), &its.join("weights.bin").display().to_string());
    assert_ne!(other, text);
    std::fs::write(third.config(), other).expect("writable");
    let output = third.command("rt-controller", &["run"]);
    assert_eq!(output.status.code(), Some(5), "{}", said(&output));
    assert!(
        said(&output).contains("error: controller.weights = ") && said(&output).contains("cell 'first' uses it as"),
        "{}",
        said(&output)
    );
    assert_eq!(first.stop("rt-controller"), Some(0), "the first has not noticed anything");
}

/// Protects whoever names a wrong file, and the machine's memory: a pipe, a device, a directory and a huge file in place of a configuration are refused in
/// one line, at once.
#[test]
fn what_is_no_configuration_is_refused_at_once() {
    let dir = tempfile::tempdir().expect("a directory");
    let (pipe, huge) = (dir.path().join("a\npipe"), dir.path().join("huge"));
    assert!(Command::new("mkfifo").arg(&pipe).status().expect("coreutils").success());
    std::fs::File::create(&huge).and_then(|f| f.set_len(6 << 30)).expect("sparse");
    for file in [&pipe, &huge, dir.path(), Path::new("/dev/zero")] {
        for (name, words) in [
            ("rt-controller", &["run"][..]),
            ("rt-controller", &["status"]),
            ("feature-worker", &["run"]),
            ("operator-page", &["run"]),
            ("decant", &["metrics"]),
        ] {
            let mut command = Command::new("timeout");
            let output = command.arg("30").arg(program(name)).args(words).arg("--config").arg(file).output().expect("coreutils");
            let said = String::from_utf8_lossy(&output.stderr);
            assert_eq!((output.status.code(), said.lines().count()), (Some(2), 1), "{name} {}: {said}", file.display());
            assert!(said.contains("is not a regular file") || said.contains("bytes are too many"), "{name} {}: {said}", file.display());
        }
    }
}
