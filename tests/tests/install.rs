//! `scripts/install` and `scripts/check-package` on machines that are not as they wish, and what the package says to other programs: the scripts
//! themselves, with programs of ours in place of apt's and Rust's.
//!
//! It starts short processes, which change nothing outside of a directory of their own.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic)]

use std::os::unix::fs::PermissionsExt;
use std::path::Path;
use std::process::{Command, Output};

/// Makes a program `name` in `directory` of one line of shell.
fn program(directory: &Path, name: &str, line: &str) {
    let path = directory.join(name);
    std::fs::write(&path, format!("#!/bin/sh\n{line}\n")).unwrap();
    std::fs::set_permissions(&path, std::fs::Permissions::from_mode(0o755)).unwrap();
}

/// Runs a command with the programs of `directory` before those of the system, and none of this user's own.
fn run(directory: &Path, words: &[&str]) -> Output {
    let root = Path::new(env!("CARGO_MANIFEST_DIR")).parent().unwrap();
    let path = format!("{}:/usr/sbin:/usr/bin:/sbin:/bin", directory.display());
    Command::new(words[0]).args(&words[1..]).current_dir(root).env("PATH", path).env("HOME", directory).output().unwrap()
}

/// Protects a newcomer from pages of a compiler's errors: a Rust that is too old is said, or updated where rustup can, and a newer one is not called old.
#[test]
fn an_old_rust_is_said_or_updated() {
    let dir = tempfile::tempdir().unwrap();
    program(dir.path(), "dpkg-query", "echo install ok installed");
    // One of the system would else be asked for a real compiler.
    program(dir.path(), "rustup", "exit 0");
    for (version, ended) in [("1.63.0", 2), ("1.9.0", 2), ("1.95.0", 0), ("1.100.1", 0), ("2.0.0-nightly", 0)] {
        program(dir.path(), "cargo", &format!("echo 'cargo {version} (c0ffee 2026-01-01)'"));
        let output = run(dir.path(), &["scripts/install"]);
        let said = String::from_utf8_lossy(&output.stderr);
        assert_eq!(output.status.code(), Some(ended), "{version}: {said}");
        assert!(ended == 0 || said.contains(&format!("cargo {version}")) && said.lines().count() == 1, "{said}");
    }
    program(dir.path(), "cargo", "cat $HOME/version");
    program(dir.path(), "rustup", "echo cargo 1.96.0 > $HOME/version");
    std::fs::write(dir.path().join("version"), "cargo 1.63.0").unwrap();
    assert_eq!(run(dir.path(), &["scripts/install"]).status.code(), Some(0));
}

/// Protects `scripts/test` on Ubuntu, whose archive has no chromium-driver: it goes on without a browser, and says so. It takes root, for another
/// /etc/os-release.
#[test]
fn ubuntu_goes_on_without_a_browser() {
    let dir = tempfile::tempdir().unwrap();
    program(dir.path(), "dpkg-query", "[ \"$3\" != chromium-driver ] && echo install ok installed");
    program(dir.path(), "cargo", "echo cargo 1.95.0");
    program(dir.path(), "apt-get", "echo \"E: Unable to locate package chromium-driver\" >&2; exit 100");
    std::fs::write(dir.path().join("os"), "NAME=\"Ubuntu\"\nID=ubuntu\n").unwrap();
    let as_ubuntu = |words: &str| {
        let script = format!("mount --bind {}/os /etc/os-release && exec {words}", dir.path().display());
        run(dir.path(), &["unshare", "-m", "--propagation", "private", "sh", "-c", &script])
    };
    if !as_ubuntu("true").status.success() {
        println!("not run: it takes root");
        return;
    }
    let output = as_ubuntu("scripts/install chromium-driver");
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    // A machine that has a browser of another kind is told nothing.
    let told = String::from_utf8_lossy(&output.stdout).contains("not installed: chromium-driver");
    assert!(told || ["/usr/bin/chromedriver", "/usr/sbin/chromedriver"].iter().any(|p| Path::new(p).exists()));
}

/// Protects whoever checks the package on a machine whose file systems are closed to setuid programs: it is said at once, not by sudo minutes later. It
/// takes root, for such a file system.
#[test]
fn a_package_is_not_checked_where_sudo_cannot_work() {
    let dir = tempfile::tempdir().unwrap();
    program(dir.path(), "mmdebstrap", "exit 0");
    let closed = |words: &str| {
        let script = format!("mkdir -p out && mount -t tmpfs -o nosuid tmpfs out && exec {words}");
        run(dir.path(), &["unshare", "-m", "--propagation", "private", "sh", "-c", &script])
    };
    if !closed("true").status.success() {
        println!("not run: it takes root");
        return;
    }
    program(dir.path(), "dpkg-query", "exit 1");
    program(dir.path(), "apt-get", "exit 100");
    let output = closed("scripts/check-package");
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!((output.status.code(), said.lines().count()), (Some(2), 1), "{said}");
    assert!(said.contains("mounted nosuid, noexec or nodev"), "{said}");
}

/// The names of the package's units, such as `decant-page`.
fn units() -> Vec<String> {
    let packaging = std::fs::read_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/../packaging")).unwrap();
    let names = packaging.map(|e| e.unwrap().file_name().to_string_lossy().into_owned());
    let units: Vec<String> = names.filter_map(|n| Some(n.strip_suffix("@.service")?.to_owned())).collect();
    assert!(units.len() >= 4, "{units:?}");
    units
}

/// Protects a pour from the upgrade of a library: needrestart, which reads its files as Perl and takes the first pattern that a unit's name fits, restarts none
/// of the package's units, and still restarts others.
#[test]
fn needrestart_leaves_the_units_alone() {
    let file = concat!(env!("CARGO_MANIFEST_DIR"), "/../packaging/decant.needrestart");
    let script = "our %nrconf; local $/; open(my $f, '<', shift); eval <$f>; die $@ if $@;
        for my $unit (@ARGV) { my @of = grep { $unit =~ /$_/ } keys %{$nrconf{override_rc}}; print @of ? $nrconf{override_rc}{$of[0]} : 'restarted', qq(\\n) }";
    let names: Vec<String> = units().iter().map(|unit| format!("{unit}@lab.service")).collect();
    let Ok(output) = Command::new("perl").args(["-we", script, file, "ssh.service"]).args(&names).output() else {
        println!("not run: there is no perl");
        return;
    };
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    let expected: Vec<&str> = std::iter::once("restarted").chain(names.iter().map(|_| "0")).collect();
    assert_eq!(said.lines().collect::<Vec<_>>(), expected, "{}", String::from_utf8_lossy(&output.stderr));
}

/// Protects an administrator's own units from a purge: what `systemctl enable`, `edit` and `mask` made of the package's units goes, and nothing else. The
/// script itself runs, with a directory in place of the system's.
#[test]
fn a_purge_takes_the_packages_units_alone() {
    let dir = tempfile::tempdir().unwrap();
    let system = dir.path().join("etc/systemd/system");
    let own = ["decant-backup@.service", "decant-backup@lab.service", "decant-log.service", "decant-page.service"];
    let own = own.into_iter().flat_map(|n| [n.to_owned(), format!("multi-user.target.wants/{n}"), format!("{n}.d/override.conf")]);
    let own: Vec<String> = own.chain(["decant-log-.service.d/override.conf".into()]).collect();
    let packages = units().into_iter().flat_map(|unit| {
        let instance = format!("{unit}@lab.service");
        [
            instance.clone(),
            format!("multi-user.target.wants/{instance}"),
            format!("{instance}.d/override.conf"),
            format!("{unit}@.service.d/override.conf"),
        ]
    });
    let packages: Vec<String> = packages.collect();
    for name in own.iter().chain(&packages) {
        let path = system.join(name);
        std::fs::create_dir_all(path.parent().unwrap()).unwrap();
        std::fs::write(path, "").unwrap();
    }
    let mut script = std::fs::read_to_string(concat!(env!("CARGO_MANIFEST_DIR"), "/../packaging/postrm")).unwrap();
    for place in ["/etc/", "/var/lib/", "/run/", "/dev/shm"] {
        script = script.replace(place, &format!("{}{place}", dir.path().display()));
    }
    program(dir.path(), "getent", "exit 2");
    let output = run(dir.path(), &["sh", "-c", &script, "postrm", "purge"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let stays = |names: &[String]| names.iter().filter(|n| system.join(n).exists()).cloned().collect::<Vec<_>>();
    assert_eq!((stays(&own), stays(&packages)), (own.clone(), Vec::new()));
}
