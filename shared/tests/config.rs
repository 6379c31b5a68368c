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
}
