//! A configuration's paths: they start at its file, and no two keys mean one file.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use shared::config::Config;

/// Protects weights, journal and the configuration from each other: today's run must not rename or overwrite another file of the cell.
#[test]
fn one_path_for_two_things_is_refused() {
    let dir = tempfile::tempdir().expect("a directory");
    std::fs::create_dir(dir.path().join("config")).expect("writable");
    let file = dir.path().join("config/cell.toml");
    let read = |journal: &str| {
        let text =
            include_str!("../../config/cell.toml").replace("journal = \"../out/lab/journal.bin\"", &format!("journal = \"{journal}\""));
        assert!(text.contains(journal));
        std::fs::write(&file, text).expect("writable");
        Config::read(&file).map_err(|e| e.to_string())
    };
    let config = read("journal.bin").expect("valid");
    let weights = config.controller.weights;
    assert!(weights.starts_with(dir.path().canonicalize().expect("there")), "{}", weights.display());
    let name = weights.file_name().expect("a name").to_string_lossy().into_owned();
    let by_detour = format!("../out/lab/{name}");
    for (journal, other) in
        [(by_detour.as_str(), "controller.weights"), ("cell.toml", "the configuration"), ("./cell.toml", "the configuration")]
    {
        let said = read(journal).expect_err("must be refused");
        assert!(said.contains("controller.journal") && said.contains(other), "{said}");
    }
    // Its weights, journal and episodes lie in out/lab: the runtime directory of a cell "lab" may be elsewhere, and not there.
    for (base, good) in [("run", true), ("../out", false)] {
        let name = "name = \"lab\"";
        let text = include_str!("../../config/cell.toml").replacen(name, &format!("{name}\nruntime_dir = \"{base}\""), 1);
        std::fs::write(&file, text).expect("writable");
        let said = Config::read(&file).err().map(|e| e.to_string());
        assert_eq!(said.as_ref().is_none_or(|e| !e.contains("outside of the cell's runtime directory")), good, "{said:?}");
        assert!(said.is_none() || !good, "{said:?}");
    }
}

/// Protects a cell in a directory with an odd name: blanks, line ends and percent signs are a path as any other, and what is no text is refused by name instead
/// of being read as another path.
#[test]
fn odd_names_are_paths_or_are_refused() {
    use std::os::unix::ffi::OsStrExt as _;
    let dir = tempfile::tempdir().expect("a directory");
    for (name, good) in [(&b"a b%02d\nc"[..], true), (b"a\xff", false)] {
        let place = dir.path().join(std::ffi::OsStr::from_bytes(name));
        std::fs::create_dir(&place).expect("writable");
        let file = place.join("cell.toml");
        std::fs::write(&file, include_str!("../../config/sim.toml")).expect("writable");
        match Config::read(&file) {
            Ok(config) => assert!(good && config.recording.directory.ends_with("out/episodes")),
            Err(e) => assert!(!good && e.to_string().contains("text in UTF-8"), "{e}"),
        }
    }
}
