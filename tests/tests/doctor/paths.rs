//! Paths of a configuration at which something lies that cannot be used.

use tests::CellUnderTest;

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
    for (section, key, value, what, verdict, words) in [
        ("recording", "directory", "file", "episodes", "red", "is no directory"),
        ("recording", "directory", "file/below", "episodes", "red", "is no directory"),
        ("recording", "directory", "link/below", "episodes", "red", "is no directory"),
        ("recording", "directory", "directory/below", "episodes", "green", "0 episodes"),
        ("controller", "journal", "directory", "journal", "red", "is not a regular file"),
        ("controller", "journal", "file", "journal", "red", "is no journal"),
        ("controller", "journal", "directory/new.bin", "journal", "green", "free"),
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
