//! Who of several users of a machine may stop a cell, and what the others are told: `abort` in the runtime directory of somebody else.
//!
//! It takes root, to act as other users, and namespaces, in which nobody else's `/run/decant` is touched.

use std::os::unix::fs::chown;
use std::path::{Path, PathBuf};
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use serde_json::Value;
use tests::{CellUnderTest, Namespaces, steady_weights};

use super::{TILT_OUT, assert_aborted, public_copy, timed};

/// The cell's own user, whose group may abort.
const OWNER: u32 = 65_531;
/// A member of that group, beside a group of its own.
const MEMBER: u32 = 65_532;
/// A user who has nothing to do with the cell.
const STRANGER: u32 = 65_533;

/// The cell of [`OWNER`], and copies of its programs that every user can run.
struct Shared {
    cell: CellUnderTest,
    programs: Vec<(tempfile::TempDir, PathBuf)>,
}

impl Shared {
    fn program(&self, name: &str) -> &Path {
        &self.programs.iter().find(|(_, path)| path.ends_with(name)).expect("it was copied").1
    }

    /// The program `name` as `user`, in the cell's namespaces.
    fn command(&self, user: u32, name: &str) -> Command {
        let mut command = self.cell.inside.as_ref().expect("apart").command("setpriv");
        command.arg(format!("--reuid={user}")).arg(format!("--regid={user}"));
        match user {
            MEMBER => command.arg(format!("--groups={OWNER}")),
            _ => command.arg("--clear-groups"),
        };
        command.arg(self.program(name)).env_remove("XDG_RUNTIME_DIR").env_remove("DECANT_CONFIG").stdin(Stdio::null());
        command
    }

    /// What `words` of `rt-controller` does for `user`: its exit code and what it said.
    fn ask(&self, user: u32, words: &[&str]) -> (Option<i32>, String) {
        told(&timed(with(self.command(user, "rt-controller"), words)).0)
    }

    /// The controller's state, as the cell's own user sees it.
    fn status(&self) -> Option<Value> {
        let config = self.cell.config();
        let mut status = self.command(OWNER, "rt-controller");
        let output = status.args(["status", "--json", "--config"]).arg(config).output().expect("it runs");
        serde_json::from_slice(&output.stdout).ok()
    }

    fn wait(&self, what: &str, good: impl Fn(&Value) -> bool) {
        let begin = Instant::now();
        while !self.status().is_some_and(|s| good(&s)) {
            let logs = ["simulator", "feature-worker", "rt-controller"].map(|name| self.cell.log(name)).join("\n");
            assert!(begin.elapsed() < Duration::from_secs(30), "{what} did not happen: {logs}");
            std::thread::sleep(Duration::from_millis(50));
        }
    }
}

impl Drop for Shared {
    fn drop(&mut self) {
        // Who asks for a cell that is not its own gets a directory of its own.
        for user in [OWNER, MEMBER, STRANGER] {
            let _ = std::fs::remove_dir_all(format!("/dev/shm/decant-{user}"));
        }
    }
}

fn with(mut command: Command, words: &[&str]) -> Command {
    command.args(words);
    command
}

fn told(output: &Output) -> (Option<i32>, String) {
    (output.status.code(), String::from_utf8_lossy(&[&output.stdout[..], &output.stderr].concat()).into_owned())
}

/// Runs `script` in the namespaces, as root.
fn as_root(inside: &Namespaces, script: &str) {
    assert!(inside.command("sh").args(["-ec", script]).status().expect("it runs").success(), "{script}");
}

/// A cell that runs as [`OWNER`] in a runtime directory of mode 0750; `None`, with a printed line, where this cannot be tried.
fn shared_cell() -> Option<Shared> {
    if !rustix::process::geteuid().is_root() {
        println!("not run: it takes root to act as other users");
        return None;
    }
    let mut cell = CellUnderTest::prepare(|_| {});
    let inside = Namespaces::new(None)?;
    as_root(&inside, &format!("install -d -m 0750 -o {OWNER} -g {OWNER} /run/decant/{}", cell.name));
    cell.inside = Some(inside);
    let programs = ["simulator", "feature-worker", "rt-controller"].map(public_copy).into();
    steady_weights(TILT_OUT).write(&cell.weights()).expect("writable");
    for path in [cell.dir.path().to_path_buf(), cell.config(), cell.weights()] {
        chown(&path, Some(OWNER), Some(OWNER)).expect("root may");
    }
    as_root(cell.inside.as_ref().expect("just made"), &format!("chmod 0755 {}", cell.dir.path().display()));
    let mut shared = Shared { cell, programs };
    for name in ["simulator", "feature-worker", "rt-controller"] {
        let command = shared.command(OWNER, name);
        let log = std::fs::File::create(shared.cell.dir.path().join(format!("{name}.log"))).expect("writable");
        shared.cell.spawn_with(name, command, log.into());
    }
    shared.wait("readiness", |s| s["phase"] == "idle" && s["feature_sequence"].as_u64() > Some(0) && s["weights_taken"].as_u64() > Some(0));
    Some(shared)
}

/// Protects a robot on a shared machine, as docs/DEPLOYMENT.md promises: a member of the runtime directory's group stops it, and can do nothing else; a
/// user who is neither can do nothing, and is not told that nothing runs.
#[test]
fn a_group_may_stop_and_a_stranger_may_not() {
    let Some(shared) = shared_cell() else { return };
    let config = shared.cell.config().display().to_string();
    let tilted = || {
        let mut fill = shared.command(OWNER, "simulator");
        assert!(fill.args(["operator", "fill", "300", "--config", &config]).status().expect("it runs").success());
        shared.wait("readiness", |s| s["phase"] == "idle");
        let mut pour = shared.command(OWNER, "rt-controller");
        pour.args(["pour", "200", "--json", "--config", &config]).stdout(Stdio::piped()).stderr(Stdio::piped());
        let pour = pour.spawn().expect("it starts");
        shared.wait("tilt", |s| s["alpha_measured_deg"].as_f64() > Some(30.0));
        pour
    };
    let pour = tilted();
    let (code, said) = shared.ask(STRANGER, &["abort"]);
    assert!(code == Some(3) && said.contains("no rt-controller that this user may stop is running"), "{code:?} {said}");
    let (code, said) = shared.ask(STRANGER, &["abort", "--config", &config]);
    assert!(code == Some(1) && said.contains("is closed to this user; whether rt-controller runs there is not known"), "{code:?} {said}");
    for user in [STRANGER, MEMBER] {
        let (code, said) = shared.ask(user, &["status", "--config", &config]);
        assert_eq!(code, Some(3), "{said}");
    }
    // It may be over by now, where much else runs.
    let output = pour.wait_with_output().expect("it ran");
    let result: Value = serde_json::from_slice(&output.stdout).expect("JSON");
    assert_ne!(result["outcome"]["reason"], "aborted", "somebody has stopped it");

    let pour = tilted();
    let aborted = timed(with(shared.command(MEMBER, "rt-controller"), &["abort"]));
    assert_aborted("a member of the group", &aborted, pour);
    let (code, said) = shared.ask(MEMBER, &["pour", "50", "--config", &config]);
    assert!(code == Some(3), "{said}");
    assert_ne!(shared.status().expect("it answers")["phase"], "pouring", "who may stop it may not start it");
}

/// Protects who aborts in a hurry: a directory that may be another user's lure, at a place that the configuration names or among the usual ones, is named
/// with the reason, and is no "upright" and no "nothing runs"; a configuration of an empty name is none, and no reason not to look.
#[test]
fn a_directory_that_is_not_believed_is_named() {
    if !rustix::process::geteuid().is_root() {
        println!("not run: it takes root to act as other users");
        return;
    }
    let Some(inside) = Namespaces::new(None) else { return };
    let mut cell = CellUnderTest::prepare(|c| {
        c["cell"].as_table_mut().expect("a table").insert("runtime_dir".into(), "/run/decant/third".into());
    });
    let name = cell.name.clone();
    let shared = |cell| Shared { cell, programs: vec![public_copy("rt-controller")] };
    // A third person's directory, in which a cell of another user lies, and beside it one that all may have put there.
    as_root(
        &inside,
        &format!(
            "install -d -m 0755 -o {MEMBER} /run/decant/third; install -d -m 0755 -o {OWNER} /run/decant/third/{name}; touch /run/decant/third/{name}/stop"
        ),
    );
    as_root(&inside, &format!("chmod 0755 {}", cell.dir.path().display()));
    cell.inside = Some(inside);
    let shared = shared(cell);
    let config = shared.cell.config().display().to_string();
    let (code, said) = shared.ask(STRANGER, &["abort", "--config", &config]);
    let reason = format!(
        "/run/decant/third/{name} is not believed: it belongs to user {OWNER}, and lies in a directory or behind a link of user {MEMBER}"
    );
    assert!(code == Some(1) && said.contains(&reason), "{code:?} {said}");

    let inside = shared.cell.inside.as_ref().expect("apart");
    let (code, said) = shared.ask(STRANGER, &["abort"]);
    assert!(code == Some(3) && said.contains("no rt-controller that this user may stop is running"), "{code:?} {said}");
    as_root(inside, &format!("chmod 0777 /run/decant; install -d -m 0755 -o {MEMBER} /run/decant/lure; touch /run/decant/lure/stop"));
    let (code, said) = shared.ask(STRANGER, &["abort"]);
    let reason = format!("/run/decant/lure is not believed: it belongs to user {MEMBER}, and others may write where it lies (mode 777)");
    assert!(code == Some(1) && said.contains(&reason) && said.contains("is not known"), "{code:?} {said}");
    let (code, said) = told(&timed(with(shared.command(STRANGER, "rt-controller"), &["abort", "--config", ""])).0);
    assert!(code == Some(1) && said.contains("every cell that runs is stopped instead") && said.contains(&reason), "{code:?} {said}");
}

/// A cell that no other test meets, whose runtime files lie in the directory `base`; nothing of it runs yet.
fn cell_in(base: &Path) -> Option<CellUnderTest> {
    let inside = Namespaces::new(None)?;
    let mut cell = CellUnderTest::prepare(|c| {
        c["cell"].as_table_mut().expect("a table").insert("runtime_dir".into(), base.display().to_string().into());
    });
    cell.inside = Some(inside);
    Some(cell)
}

/// Protects who aborts without a configuration beside a cell whose runtime files lie in a directory of its own, and whose socket's name another user has
/// taken before it: a process that runs and was not reached is no "nothing runs".
#[test]
fn a_controller_whose_name_is_taken_is_told_of() {
    if !rustix::process::geteuid().is_root() {
        println!("not run: it takes root to act as another user");
        return;
    }
    let base = tempfile::tempdir().expect("a directory");
    let Some(mut cell) = cell_in(base.path()) else { return };
    let _kept = super::sockets(&cell, "silent", &[format!("decant/0/{}", cell.name)]);
    cell.spawn("rt-controller");
    cell.wait("the controller", Duration::from_secs(30), |_| true);
    let pid = cell.pid("rt-controller");
    let (output, _) = super::timed(super::abort(&cell));
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(output.status.code() == Some(1) && said.contains(&format!("process {pid} is an rt-controller that was not reached")), "{said}");
}

/// Protects who aborts as root without a configuration from a user who makes many names: the cell of another one, whose runtime files lie in a directory of
/// its own, is asked all the same, although that user's number is the larger one.
#[test]
fn many_names_of_one_user_hide_no_cell() {
    /// A user with a larger number than the one who makes the names.
    const LATER: u32 = 65_600;
    if !rustix::process::geteuid().is_root() {
        println!("not run: it takes root to act as other users");
        return;
    }
    let base = tempfile::tempdir().expect("a directory");
    let Some(cell) = cell_in(base.path()) else { return };
    for path in [base.path(), cell.dir.path(), &cell.config()] {
        chown(path, Some(LATER), Some(LATER)).expect("root may");
    }
    let names: Vec<String> = (0..70).map(|k| format!("decant/65534/a{k:03}")).collect();
    let _kept = super::sockets(&cell, "silent", &names);
    let mut shared = Shared { cell, programs: vec![public_copy("rt-controller")] };
    let command = shared.command(LATER, "rt-controller");
    let log = std::fs::File::create(shared.cell.dir.path().join("rt-controller.log")).expect("writable");
    shared.cell.spawn_with("rt-controller", command, log.into());
    let config = shared.cell.config().display().to_string();
    let begin = Instant::now();
    while shared.ask(LATER, &["status", "--config", &config]).0 != Some(0) {
        assert!(begin.elapsed() < Duration::from_secs(30), "{}", shared.cell.log("rt-controller"));
        std::thread::sleep(Duration::from_millis(50));
    }
    let said = shared.ask(0, &["abort"]).1;
    assert!(said.contains("nobody answers at the socket of cell 'a000'") && !said.contains("was not reached"), "{said}");
}

/// Protects who aborts without a configuration beside a cell whose runtime files lie in a directory of its own: only its socket's name shows that it runs.
/// Another user is told of it, and a controller that hangs is no "nothing runs".
#[test]
fn a_cell_in_a_named_directory_is_told_of() {
    if !rustix::process::geteuid().is_root() {
        println!("not run: it takes root to act as other users");
        return;
    }
    let base = tempfile::tempdir().expect("a directory");
    let Some(mut cell) = cell_in(base.path()) else { return };
    cell.spawn("rt-controller");
    cell.wait("the controller", Duration::from_secs(30), |_| true);
    let mut shared = Shared { cell, programs: vec![public_copy("rt-controller")] };
    let (code, said) = shared.ask(STRANGER, &["abort"]);
    let note = format!("an rt-controller of user 0, cell '{}', runs too and was not asked", shared.cell.name);
    assert!(code == Some(3) && said.contains(&note), "{code:?} {said}");
    shared.cell.signal("rt-controller", rustix::process::Signal::STOP);
    let (code, said) = shared.ask(0, &["abort"]);
    shared.cell.signal("rt-controller", rustix::process::Signal::CONT);
    let doubt = format!("the rt-controller of cell '{}' does not answer: give the cell's --config", shared.cell.name);
    assert!(code == Some(1) && said.contains(&doubt), "{code:?} {said}");
}
