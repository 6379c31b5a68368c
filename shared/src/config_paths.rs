//! What a path in a configuration means: a relative one starts at the directory of the configuration file, wherever one stands; and no two
//! keys may mean the same file.
//!
//! Ordinary threads use it while they read a configuration; it allocates and looks at the disk. Nothing here fails: what is not there yet
//! is compared by its name.

use std::os::unix::fs::MetadataExt;
use std::path::{Component, Path, PathBuf};

/// `path` as the configuration `file` means it, absolute.
pub fn beside(file: &Path, path: &Path) -> PathBuf {
    let file = std::path::absolute(file).unwrap_or_else(|_| file.into());
    tidy(&file.parent().unwrap_or(Path::new("/")).join(path))
}

/// `path` without `..` and without links, as far as its directory is there; what is not there yet is no link. Its last part stays, because it may be a
/// link that people exchange.
fn tidy(path: &Path) -> PathBuf {
    for there in path.ancestors().skip(1) {
        let (Ok(mut real), Ok(rest)) = (there.canonicalize(), path.strip_prefix(there)) else { continue };
        for part in rest.components() {
            match part {
                Component::Normal(name) => real.push(name),
                Component::ParentDir => drop(real.pop()),
                _ => {}
            }
        }
        // A way back may lead to what is there.
        let back = rest.components().any(|part| part == Component::ParentDir);
        return if back { tidy(&real) } else { real };
    }
    path.into()
}

/// The first of `paths` that means the same as one before it: the two keys.
pub fn clash<'a>(paths: &[(&'a str, PathBuf)]) -> Option<(&'a str, &'a str)> {
    paths.iter().enumerate().find_map(|(i, (key, path))| {
        let same = |other: &&(&str, PathBuf)| is_same(&other.1, path);
        paths[..i].iter().find(same).map(|(first, _)| (*first, *key))
    })
}

/// Whether `path` means something in `directory`.
pub fn is_in(directory: &Path, path: &Path) -> bool {
    full(path).starts_with(full(directory))
}

/// `path`, absolute and tidy.
fn full(path: &Path) -> PathBuf {
    tidy(&std::path::absolute(path).unwrap_or_else(|_| path.into()))
}

/// Whether two paths mean the same file or directory.
pub fn is_same(a: &Path, b: &Path) -> bool {
    let inode = |p: &Path| p.metadata().map(|m| (m.dev(), m.ino())).ok();
    let (a, b) = (full(a), full(b));
    a == b || (inode(&a).is_some() && inode(&a) == inode(&b))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Protects a cell's files: they are found from the configuration, and links and detours do not hide that two keys mean one file.
    #[test]
    fn paths_start_at_the_configuration_and_meet_only_themselves() {
        let dir = tempfile::tempdir().expect("a directory");
        let real = dir.path().canonicalize().expect("it is there");
        std::fs::create_dir(real.join("config")).expect("new");
        let file = real.join("config/cell.toml");
        assert_eq!(beside(&file, Path::new("../out/weights.bin")), real.join("out/weights.bin"));
        assert_eq!(beside(&file, Path::new("w.bin")), real.join("config/w.bin"));
        assert_eq!(beside(&file, Path::new("/w.bin")), Path::new("/w.bin"));

        std::fs::write(real.join("w.bin"), b"w").expect("new");
        std::os::unix::fs::symlink(real.join("w.bin"), real.join("config/link")).expect("a link");
        std::fs::hard_link(real.join("w.bin"), real.join("hard")).expect("a link");
        for other in ["w.bin", "config/../w.bin", "config/link", "hard"] {
            let paths = [("a", real.join("w.bin")), ("b", real.join("other")), ("c", real.join(other))];
            assert_eq!(clash(&paths), Some(("a", "c")), "{other}");
        }
        assert_eq!(clash(&[("a", real.join("w.bin")), ("b", real.join("v.bin"))]), None);
        assert_eq!(clash(&[("a", real.join("new/x")), ("b", real.join("config/../new/x"))]), Some(("a", "b")), "neither is there");
        // A directory that is made later must not make two paths one.
        assert_eq!(clash(&[("a", real.join("w.bin")), ("b", real.join("later/../config/link"))]), Some(("a", "b")));
        assert_eq!(beside(&file, Path::new("later/deeper/../../../w.bin")), real.join("w.bin"));
    }
}
