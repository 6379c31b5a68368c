//! Paths of a configuration at which something lies that cannot be used.

use std::os::unix::fs::PermissionsExt as _;
use std::time::Duration;

use tests::{CellUnderTest, Namespaces};

use super::{examine, line};

/// Protects who trusts a green line: a place for episodes that is a file or a link to nothing, and one for the journal at which something else lies, are red
/// before the recorder or the controller finds out, and a weight file that cannot be looked at is not said to be missing.
#[test]
fn what_cannot_be_used_is_not_green() {
    let cell = CellUnderTest::prepare(|_| {});
    let config: toml::Table = std::fs::read_to_string(cell.config()).expect("just made").parse().expect("TOML");
    let path = |name: &str| cell.dir.path().join(name).display().to_string();
    std::fs::write(path("file"), "mine").expect("ours");
    std::fs::create_dir(path("directory")).expect("ours");
    std::os::unix::fs::symlink("nowhere", path("link")).expect("ours");
    std::fs::create_dir(path("beside.before.bin")).expect("ours");
    std::fs::create_dir_all(path("foreign/.last-number")).expect("ours");
    let held = std::fs::File::create(path("held.bin")).expect("ours");
    held.try_lock().expect("ours");
    for (section, key, value, what, verdict, words) in [
        ("recording", "directory", "file", "episodes", "red", "is no directory"),
        ("recording", "directory", "file/below", "episodes", "red", "is no directory"),
        ("recording", "directory", "link/below", "episodes", "red", "is no directory"),
        ("recording", "directory", "directory/below", "episodes", "green", "0 episodes"),
        ("recording", "directory", "foreign", "episodes", "red", ".last-number: Is a directory"),
        ("controller", "journal", "directory", "journal", "red", "is not a regular file"),
        ("controller", "journal", "file", "journal", "red", "is no journal"),
        ("controller", "journal", "directory/new.bin", "journal", "green", "free"),
        ("controller", "journal", "beside.bin", "journal", "red", "beside.before.bin is not a regular file"),
        ("controller", "journal", "held.bin", "journal", "red", "is being written by another controller"),
        ("controller", "weights", "file/weights.bin", "weights", "red", "Not a directory"),
        ("controller", "weights", "directory/weights.bin", "weights", "yellow", "is not there"),
    ] {
        let mut changed = config.clone();
        changed[section].as_table_mut().expect("a table").insert(key.into(), path(value).into());
        std::fs::write(cell.config(), toml::to_string(&changed).expect("still TOML")).expect("ours");
        let (said, code) = examine(&cell);
        let (is, text) = line(&said, "files", what);
        assert!(is == verdict && text.contains(words), "{key} = {value}: {is}: {text}");
        assert_eq!(code, Some(if verdict == "red" { 2 } else { 3 }), "{key} = {value}: no robot is there either");
    }
}

/// Protects who trusts a green line: a place for runtime files that the controller refuses at its start is red before, with the words of that refusal, and
/// so is shared memory in which no file can be made. A look makes nothing.
#[test]
fn runtime_files_without_a_place_are_red() {
    let mut cell = CellUnderTest::prepare(|_| {});
    let config: toml::Table = std::fs::read_to_string(cell.config()).expect("just made").parse().expect("TOML");
    let Some(inside) = Namespaces::new(Some("64m")) else { return };
    let place = |name: &str| cell.dir.path().join(name);
    let make = |name: &str, mode: u32| {
        std::fs::create_dir(place(name)).expect("ours");
        std::fs::set_permissions(place(name), std::fs::Permissions::from_mode(mode)).expect("ours");
    };
    make("open", 0o777);
    make("good", 0o700);
    make("others", 0o700);
    std::os::unix::fs::chown(place("others"), Some(65534), None).expect("root may");
    make("fixed", 0o700);
    let mount = inside.command("mount").args(["-t", "tmpfs", "-o", "ro", "tmpfs"]).arg(place("fixed")).status().expect("it runs");
    assert!(mount.success());
    std::fs::write(place("file"), "mine").expect("ours");
    cell.inside = Some(inside);
    let places = [
        ("good", ""),
        ("new", ""),
        ("new/newer", "cannot be made: No such file"),
        ("open", "others may write there (mode 777)"),
        ("others", "belongs to user 65534"),
        ("fixed", "cannot be made: Read-only file system"),
        ("file", "is no directory"),
    ];
    for (name, words) in places {
        let mut changed = config.clone();
        let base = cell.dir.path().join(name).display().to_string();
        changed["cell"].as_table_mut().expect("a table").insert("runtime_dir".into(), base.into());
        std::fs::write(cell.config(), toml::to_string(&changed).expect("still TOML")).expect("ours");
        let (said, code) = examine(&cell);
        let (is, text) = line(&said, "files", "controller");
        assert!(is == if words.is_empty() { "green" } else { "red" } && text.contains(words), "{name}: {is}: {text}");
        assert_eq!(code, Some(if is == "red" { 2 } else { 3 }), "{name}: no robot is there either");
        if is == "red" {
            cell.spawn("rt-controller");
            assert!(cell.exit_code("rt-controller", Duration::from_secs(10)).is_some_and(|code| code > 0), "{name}");
            assert!(cell.log("rt-controller").contains(words), "{name}: {}", cell.log("rt-controller"));
        }
    }
    assert!(!cell.dir.path().join("new").exists(), "nothing is made");

    let inside = cell.inside.as_ref().expect("there");
    assert!(inside.command("mount").args(["-o", "remount,ro", "/dev/shm"]).status().expect("it runs").success());
    let (is, text) = line(&examine(&cell).0, "files", "/dev/shm");
    assert!(is == "red" && text.contains("remount,rw"), "{is}: {text}");
}

/// Protects who asks the doctor beside another user who makes files without end: what is there under cells' names is looked at once, up to a bound, and it is
/// said that there is more.
#[test]
fn files_without_end_are_told_and_not_read() {
    let mut cell = CellUnderTest::prepare(|_| {});
    let Some(inside) = Namespaces::new(Some("64m")) else { return };
    let script = "seq -f /dev/shm/decant-%08g.lock 10100 | xargs touch && chown -R 65534 /dev/shm";
    assert!(inside.command("sh").args(["-c", script]).status().expect("it runs").success());
    cell.inside = Some(inside);
    let (is, text) = line(&examine(&cell).0, "files", "cells' shared memory");
    let words = ["user 65534: 0 KiB left by dead processes", "and more files than were looked at"];
    assert!(is == "yellow" && words.iter().all(|w| text.contains(w)), "{is}: {text}");
}
