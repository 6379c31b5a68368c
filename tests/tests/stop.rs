//! An abort that depends on nothing: it works within a moment while everything else that the processes share is attacked.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

#[path = "stop/attacks.rs"]
mod attacks;
#[path = "stop/hanging.rs"]
mod hanging;
#[path = "stop/others.rs"]
mod others;

use std::os::linux::net::SocketAddrExt;
use std::os::unix::fs::PermissionsExt;
use std::os::unix::net::{SocketAddr, UnixStream};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::time::{Duration, Instant};

use rustix::process::Signal;
use tests::{CellUnderTest, Namespaces, program, steady_weights};

const TILT_OUT: usize = 13;

/// A cell with weights and everything running.
fn cell() -> CellUnderTest {
    let cell = CellUnderTest::start(|_| {});
    cell.take_weights(&steady_weights(TILT_OUT));
    cell
}

/// Runs a command and gives what it said, and how long it took.
fn timed(mut command: Command) -> (Output, Duration) {
    let begin = Instant::now();
    let output = command.stdin(Stdio::null()).output().expect("it starts");
    (output, begin.elapsed())
}

/// A cell as [`cell`] that no other test meets: an abort without a configuration stops every cell that it finds.
fn cell_apart() -> Option<CellUnderTest> {
    let mut cell = CellUnderTest::prepare(|_| {});
    cell.inside = Some(Namespaces::new(None)?);
    cell.spawn_all();
    cell.take_weights(&steady_weights(TILT_OUT));
    Some(cell)
}

/// `rt-controller abort` without any configuration, where `cell` is.
fn abort(cell: &CellUnderTest) -> Command {
    let mut command = cell.program("rt-controller");
    command.arg("abort").env_remove("DECANT_CONFIG");
    command
}

/// `rt-controller abort` for `cell`.
fn abort_of(cell: &CellUnderTest) -> Command {
    let mut command = abort(cell);
    command.arg("--config").arg(cell.config());
    command
}

/// Checks that the abort succeeded and that the pour ended by it.
fn assert_aborted(what: &str, (output, took): &(Output, Duration), pour: Child) {
    println!("{what}: abort returned, upright, after {took:?}");
    let said = String::from_utf8_lossy(&output.stderr);
    assert_eq!((output.status.code(), said.as_ref()), (Some(0), ""), "{what}");
    assert!(String::from_utf8_lossy(&output.stdout).contains("upright"), "{what}");
    let result = pour.wait_with_output().expect("it ran");
    let text = String::from_utf8_lossy(&result.stdout);
    // A command whose shared memory was taken away cannot know how its pour ended, and says so.
    assert!(text.contains("\"aborted\"") || result.status.code() == Some(3), "{what}: {text} {:?}", result.status);
}

/// How long the controller takes to hear an abort and to begin the way back, ms: the joint's phase is asked at the stop socket itself, so that
/// nothing else is measured.
fn heard_after(cell: &CellUnderTest) -> Duration {
    let socket = cell.runtime_dir().join("stop");
    let ask = |line: &[u8]| {
        use std::io::{Read, Write};
        let mut stream = UnixStream::connect(&socket).expect("it listens");
        stream.write_all(line).expect("it reads");
        let mut text = String::new();
        stream.read_to_string(&mut text).expect("it answers");
        serde_json::from_str::<serde_json::Value>(&text).expect("JSON")
    };
    let begin = Instant::now();
    assert_eq!(ask(b"abort\n")["refused"], "");
    while ask(b"state\n")["phase"] == "pouring" {
        assert!(begin.elapsed() < Duration::from_secs(5), "never");
        std::thread::sleep(Duration::from_millis(1));
    }
    begin.elapsed()
}

/// Protects the robot's operator: an abort is obeyed although all slots of the service `control` are taken, iceoryx2's files are deleted or
/// cut, and the whole runtime directory is gone.
#[test]
fn an_abort_needs_no_shared_memory_and_no_files() {
    let cell = cell();
    let pour = cell.pour_tilted();
    println!("abort heard and obeyed after {:?}", heard_after(&cell));
    assert!(String::from_utf8_lossy(&pour.wait_with_output().expect("it ran").stdout).contains("\"aborted\""));

    // Eight clients take all slots; the ninth is told the truth.
    let pour = cell.pour_tilted();
    let (mut clients, mut refused) = (Vec::new(), String::new());
    while refused.is_empty() && clients.len() < 20 {
        match rt_controller::client::Client::connect(&cell.name) {
            Ok(client) => clients.push(client),
            Err(e) => refused = e.to_string(),
        }
    }
    assert!(refused.contains("no room") && refused.contains("abort"), "{refused}");
    assert!(cell.status().is_none());
    assert_aborted("all slots taken", &timed(abort_of(&cell)), pour);
}

/// Protects the robot's operator from people who clean up: with iceoryx2's files, `/dev/shm` and at last the whole runtime directory
/// emptied while a pour is under way, an abort is obeyed.
#[test]
fn an_abort_needs_no_files() {
    for (what, remove) in [("iceoryx2's files", 0), ("/dev/shm", 1), ("the runtime directory", 2)] {
        let cell = cell();
        let pour = cell.pour_tilted();
        let directory = cell.runtime_dir();
        match remove {
            0 => {
                std::fs::remove_dir_all(directory.join("services")).expect("there");
                std::fs::remove_dir_all(directory.join("nodes")).expect("there");
            }
            1 => cell.shared_memory().iter().for_each(|f| std::fs::remove_file(f).expect("ours")),
            _ => std::fs::remove_dir_all(&directory).expect("ours"),
        }
        assert_aborted(what, &timed(abort_of(&cell)), pour);
    }
}

/// Protects people who do not know which configuration runs, or whose configuration is broken or gone: an abort finds the cell, by its
/// directory and without it.
#[test]
fn an_abort_finds_the_cells_that_run() {
    let Some(cell) = cell_apart() else { return };
    let pour = cell.pour_tilted();
    assert_aborted("without a configuration", &timed(abort(&cell)), pour);
    let pour = cell.pour_tilted();
    let directory = format!("/run/decant/{}", cell.name);
    let cleaned = cell.inside.as_ref().map(|i| i.command("rm").args(["-r", &directory]).status());
    assert!(cleaned.is_some_and(|c| c.is_ok_and(|c| c.success())));
    let mut with_broken = abort(&cell);
    with_broken.args(["--config", "/dev/null"]);
    let (output, _) = timed(with_broken);
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert_eq!(output.status.code(), Some(0), "{said}");
    assert!(said.contains("every cell that runs is stopped instead"), "{said}");
    assert!(String::from_utf8_lossy(&pour.wait_with_output().expect("it ran").stdout).contains("\"aborted\""));
    let nothing = CellUnderTest::prepare(|_| {});
    assert_eq!(timed(abort_of(&nothing)).0.status.code(), Some(3), "a cell that does not run");
}

/// Protects the robot's operator from somebody who cuts files in shared memory: no process dies of a signal, the controller says what happened
/// and comes upright, and the abort tells what it knows.
#[test]
fn cut_shared_memory_ends_upright_and_with_a_word() {
    let mut cell = cell();
    let pour = cell.pour_tilted();
    for file in cell.shared_memory() {
        std::fs::File::options().write(true).open(file).and_then(|f| f.set_len(0)).expect("ours");
    }
    let (output, took) = timed(abort_of(&cell));
    println!("abort after the cut: {took:?}, {:?}, {}", output.status, String::from_utf8_lossy(&output.stderr));
    assert!(output.status.code().is_some(), "the command was killed by a signal");
    let code = cell.exit_code("rt-controller", Duration::from_secs(10));
    assert_eq!(code, Some(1), "{}", cell.log("rt-controller"));
    assert!(cell.log("rt-controller").contains("shared memory vanished"), "{}", cell.log("rt-controller"));
    let said = pour.wait_with_output().expect("it ran");
    assert!(said.status.code().is_some(), "the pour's command was killed by a signal");
    // Where the joint is, the simulated robot tells: its program came upright by itself, if the controller could not do it.
    let status = cell.command("rt-controller", &["status"]);
    assert_eq!(status.status.code(), Some(3), "{}", String::from_utf8_lossy(&status.stderr));
}

/// Protects whoever stops the controller and reads only how it ended: a robot that holds the container tilted is said with the tilt, and the exit code is not
/// that of a stop as it should be.
#[test]
fn a_controller_that_leaves_the_container_tilted_says_so() {
    let mut cell = cell();
    let pour = cell.pour_tilted();
    assert!(cell.command("simulator", &["operator", "fault", "protective-stop"]).status.success());
    assert_eq!(pour.wait_with_output().expect("it ran").status.code(), Some(4));
    assert_eq!(cell.stop("rt-controller"), Some(1), "{}", cell.log("rt-controller"));
    assert!(
        cell.log("rt-controller").contains("stopped; the container may not be upright: it was last seen tilted by "),
        "{}",
        cell.log("rt-controller")
    );
}

/// Protects who stops the machine, and systemd's word for it, from a robot that takes connections and answers nothing: the controller does not wait for
/// the attempt, and it was stopped as it should be.
#[test]
fn a_controller_that_is_connecting_stops_as_it_should() {
    let mut cell = CellUnderTest::prepare(|_| {});
    let silent = std::net::TcpListener::bind((cell.address, 30004)).expect("the address is the test's own");
    cell.spawn("rt-controller");
    let held = silent.accept().expect("it connects");
    let begin = Instant::now();
    assert_eq!(cell.stop("rt-controller"), Some(0), "{}", cell.log("rt-controller"));
    assert!(cell.log("rt-controller").trim_end().ends_with("stopped"), "{}", cell.log("rt-controller"));
    println!("ended after {:?}", begin.elapsed());
    drop(held);
}

/// Protects whoever waits for the controller's end: one whose main thread alone loses its shared memory ends upright, and not as if all were well.
#[test]
fn a_controller_whose_main_thread_is_struck_fails() {
    let mut cell = cell();
    // The kernel gives a process's signal to its main thread.
    cell.signal("rt-controller", Signal::BUS);
    assert_eq!(cell.exit_code("rt-controller", Duration::from_secs(10)), Some(1), "{}", cell.log("rt-controller"));
    assert!(cell.log("rt-controller").contains("a thread of the controller does not answer"), "{}", cell.log("rt-controller"));
}

/// Protects the robot's operator from a service thread that hangs, in a client or elsewhere: an abort is obeyed, and SIGTERM ends the controller
/// with what its journal has whole, and not as if all were well.
#[test]
fn an_abort_needs_no_service_thread() {
    let mut cell = cell();
    let pour = cell.pour_tilted();
    // The service thread is the main one; each of its pauses now takes two minutes.
    let main = cell.pid("rt-controller").to_string();
    let mut strace = Command::new("strace");
    strace.args(["-q", "-p", &main, "-e", "trace=clock_nanosleep", "-e", "inject=clock_nanosleep:delay_enter=120s", "-o", "/dev/null"]);
    let mut strace = strace.spawn().expect("strace is installed (scripts/install strace)");
    std::thread::sleep(Duration::from_millis(500));
    assert!(cell.status().is_none(), "the service thread hangs");
    let (output, took) = timed(abort_of(&cell));
    println!("abort without the service thread: upright after {took:?}");
    assert_eq!(output.status.code(), Some(0), "{}", String::from_utf8_lossy(&output.stderr));
    // An abort that is not obeyed ends the process by SIGTERM, and says so.
    let said = String::from_utf8_lossy(&output.stdout).into_owned();
    assert!(said.contains("upright") && !said.contains("SIGTERM"), "the abort itself was obeyed: {said}");
    cell.signal("rt-controller", Signal::TERM);
    let begin = Instant::now();
    while !cell.log("rt-controller").contains("stopped") {
        assert!(begin.elapsed() < Duration::from_secs(20), "{}", cell.log("rt-controller"));
        std::thread::sleep(Duration::from_millis(50));
    }
    // A thread that strace holds is let go before the kernel ends the process.
    strace.kill().and_then(|()| strace.wait()).expect("ours");
    assert_eq!(cell.exit_code("rt-controller", Duration::from_secs(10)), Some(1), "{}", cell.log("rt-controller"));
    assert_eq!(pour.wait_with_output().expect("it ran").status.code(), Some(3));
    rt_controller::journal::replay(&cell.dir.path().join("journal.bin"), |_, _| {}).expect("a journal");
}

/// Protects the robot from a controller whose thread for aborts hangs: nobody answers at its sockets, no signal reaches the loop, and the loop pours on. It
/// is killed, after which the robot's program brings the container upright by itself.
#[test]
fn an_abort_kills_a_controller_that_takes_no_signal() {
    let mut cell = cell();
    let pour = cell.pour_tilted();
    let tasks = std::fs::read_dir(format!("/proc/{}/task", cell.pid("rt-controller"))).expect("it runs").flatten();
    let is_stop = |task: &std::fs::DirEntry| std::fs::read_to_string(task.path().join("comm")).is_ok_and(|name| name == "stop\n");
    let thread = tasks.into_iter().find(is_stop).expect("it has one").file_name();
    let mut strace = Command::new("strace");
    strace.args(["-q", "-e", "trace=poll,ppoll", "-e", "inject=poll,ppoll:delay_enter=120s", "-o", "/dev/null", "-p"]).arg(thread);
    let mut strace = strace.spawn().expect("strace is installed (scripts/install strace)");
    std::thread::sleep(Duration::from_millis(500));
    let (output, took) = timed(abort_of(&cell));
    println!("abort of a controller that takes no signal: {took:?}");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    strace.kill().and_then(|()| strace.wait()).expect("ours");
    assert!(output.status.code() == Some(1) && said.contains("nor end by SIGTERM, and was killed"), "{said}");
    assert_eq!(cell.exit_code("rt-controller", Duration::from_secs(10)), None, "a signal ended it");
    // Whether the pour had come to its goal by then is not what is tested.
    pour.wait_with_output().expect("it ran");
}

/// Protects the operator from silent and endless clients at the stop socket: they lose their places, and an abort is obeyed.
#[test]
fn clients_that_say_nothing_do_not_keep_an_abort_out() {
    let cell = cell();
    let pour = cell.pour_tilted();
    let stop = cell.runtime_dir().join("stop");
    let _silent: Vec<_> = (0..100).filter_map(|_| UnixStream::connect(&stop).ok()).collect();
    let name = SocketAddr::from_abstract_name(format!("decant/0/{}", cell.name)).expect("a name");
    let _more: Vec<_> = (0..100).filter_map(|_| UnixStream::connect_addr(&name).ok()).collect();
    assert_aborted("200 silent clients", &timed(abort_of(&cell)), pour);
}

/// Protects everybody's cells: orders beside a pour are refused and not begun after an abort, and Ctrl-C in a pour stops it.
#[test]
fn a_signal_in_the_pour_command_stops_the_pour() {
    let cell = cell();
    let pour = cell.pour_tilted();
    rustix::process::kill_process(rustix::process::Pid::from_child(&pour), Signal::TERM).expect("ours");
    let output = pour.wait_with_output().expect("it ran");
    assert_eq!(output.status.code(), Some(130), "{}", String::from_utf8_lossy(&output.stderr));
    assert!(String::from_utf8_lossy(&output.stderr).contains("aborted"));
    // Many orders at once: some are refused, and after the abort nothing moves.
    let asking: Vec<Child> = (0..6).map(|_| cell.begin("rt-controller", &["pour", "50"])).collect();
    cell.wait("the pour", Duration::from_secs(5), |s| s["phase"] == "pouring");
    assert_eq!(timed(abort_of(&cell)).0.status.code(), Some(0));
    for pour in asking {
        let output = pour.wait_with_output().expect("it ran");
        assert!([Some(4), Some(5)].contains(&output.status.code()), "{output:?}");
    }
    std::thread::sleep(Duration::from_millis(300));
    assert_ne!(cell.status().expect("it answers")["phase"], "pouring");
}

/// Protects the cells of a user from each other and from the wrong user: `abort` without a configuration finds what runs, also for root, and
/// another user is refused at the abstract socket and cannot reach the file.
#[test]
fn strangers_cannot_stop_or_pretend() {
    if !rustix::process::geteuid().is_root() {
        println!("not run: it takes root to act as another user");
        return;
    }
    let Some(cell) = cell_apart() else { return };
    let pour = cell.pour_tilted();
    let as_nobody = |words: &[&str]| {
        let mut command = cell.inside.as_ref().expect("apart").command("setpriv");
        command.args(["--reuid=65534", "--regid=65534", "--clear-groups"]).args(words).env_remove("XDG_RUNTIME_DIR");
        timed(command).0
    };
    let copy = public_copy("rt-controller");
    let stranger = as_nobody(&[copy.1.to_str().expect("a path"), "abort"]);
    assert_eq!(stranger.status.code(), Some(3), "{}", String::from_utf8_lossy(&stranger.stderr));
    // The command does not even ask another user's controller, so this one asks by itself. The controller may have answered and hung up before.
    let ask = "import os,socket,sys\nos.setgid(65534)\nos.setuid(65534)\ns=socket.socket(socket.AF_UNIX)\ns.connect('\\0'+sys.argv[1])\ntry: s.sendall(b'abort\\n')\nexcept OSError: pass\nprint(s.recv(4096).decode())";
    let mut asking = cell.inside.as_ref().expect("apart").command("python3");
    asking.args(["-c", ask, &format!("decant/0/{}", cell.name)]);
    let answer = timed(asking).0;
    let answer = String::from_utf8_lossy(&answer.stdout).into_owned();
    assert!(answer.contains("only the controller's own user and root"), "{answer}");
    let stop = cell.runtime_dir().join("stop");
    let reached = as_nobody(&["test", "-e", stop.to_str().expect("a path")]);
    assert_ne!(reached.status.code(), Some(0), "the directory is closed");
    assert_eq!(cell.status().expect("it answers")["phase"], "pouring", "the stranger's abort did nothing");
    assert_aborted("own user", &timed(abort(&cell)), pour);
}

/// A process that is ended with the round.
struct Ended(Child);

impl Drop for Ended {
    fn drop(&mut self) {
        let _ = self.0.kill().and_then(|()| self.0.wait());
    }
}

/// Another user's sockets in the names of cells: `SCRIPT KIND NAME...` binds each name and says so, then waits. Those of kind `full` have no free place, and
/// the others never answer.
const SOCKETS: &str = "import os,socket,sys,time
os.setgid(65534); os.setuid(65534)
kept=[]
for name in sys.argv[2:]:
    s=socket.socket(socket.AF_UNIX); s.bind('\\0'+name); s.listen(0); kept.append(s)
    for _ in range(3 if sys.argv[1]=='full' else 0):
        c=socket.socket(socket.AF_UNIX); c.setblocking(False); kept.append(c)
        try: c.connect('\\0'+name)
        except OSError: pass
print(1,flush=True)
time.sleep(300)";

/// Makes such sockets where `cell` is, until what is given is dropped.
fn sockets(cell: &CellUnderTest, kind: &str, names: &[String]) -> Ended {
    let mut command = cell.inside.as_ref().expect("apart").command("python3");
    let mut child = command.args(["-c", SOCKETS, kind]).args(names).stdout(Stdio::piped()).spawn().expect("it starts");
    std::io::Read::read_exact(child.stdout.as_mut().expect("piped"), &mut [0; 1]).expect("it has bound them");
    Ended(child)
}

/// Protects the one who stops a robot from any other user of the machine, who may bind any name: an abort without a configuration asks every cell at once,
/// whoever does not answer elsewhere, shows no terminal what stands in a name, and takes a stranger's silence for no cell's.
#[test]
fn names_of_a_stranger_delay_no_abort() {
    if !rustix::process::geteuid().is_root() {
        println!("not run: it takes root to act as another user");
        return;
    }
    let Some(cell) = cell_apart() else { return };
    let pour = cell.pour_tilted();
    let full: Vec<String> = (0..40).map(|k| format!("decant/0/a{k:03}")).collect();
    let silent: Vec<String> = (0..10).map(|k| format!("decant/65534/a{k:03}")).chain(["decant/65534/\u{1b}[2J".into()]).collect();
    let _kept = (sockets(&cell, "full", &full), sockets(&cell, "silent", &silent));
    let aborted = timed(abort(&cell));
    let said = [&aborted.0.stdout[..], &aborted.0.stderr].concat();
    assert!(!said.contains(&0x1b), "{}", String::from_utf8_lossy(&said).escape_debug());
    assert_eq!(aborted.0.status.code(), Some(0), "{}", String::from_utf8_lossy(&said));
    assert!(String::from_utf8_lossy(&pour.wait_with_output().expect("it ran").stdout).contains("\"aborted\""));
}

/// A copy of a program where every user can run it.
fn public_copy(name: &str) -> (tempfile::TempDir, PathBuf) {
    let dir = tempfile::tempdir_in("/dev/shm").or_else(|_| tempfile::tempdir()).expect("a directory");
    std::fs::set_permissions(dir.path(), std::fs::Permissions::from_mode(0o755)).expect("ours");
    let copy = dir.path().join(name);
    std::fs::copy(program(name), &copy).expect("space");
    (dir, copy)
}

/// Takes a name as another user, and all places at it, so that whoever connects and waits would wait for ever.
const SQUATTER: &str = r"
import os, socket, sys, time
name = '\0' + sys.argv[1]
squatter = socket.socket(socket.AF_UNIX)
squatter.bind(name)
os.setgid(65534)
os.setuid(65534)
squatter.listen(1)
kept = []
try:
    while True:
        kept.append(socket.socket(socket.AF_UNIX))
        kept[-1].setblocking(False)
        kept[-1].connect(name)
except BlockingIOError:
    print(1, flush=True)
time.sleep(300)
";

/// Protects the start and the stop of a cell whose name another user has taken at the abstract socket: the controller waits for nobody there, says so, and
/// the file works.
#[test]
fn a_taken_name_leaves_the_file() {
    let mut cell = CellUnderTest::prepare(|_| {});
    let uid = rustix::process::geteuid();
    if !uid.is_root() {
        println!("not run: it takes root to act as another user");
        return;
    }
    let mut squatter =
        Command::new("python3").args(["-c", SQUATTER, &format!("decant/0/{}", cell.name)]).stdout(Stdio::piped()).spawn().expect("python3");
    std::io::Read::read_exact(squatter.stdout.as_mut().expect("piped"), &mut [0; 1]).expect("it listens");
    for name in ["simulator", "feature-worker", "rt-controller"] {
        cell.spawn(name);
    }
    cell.wait_idle();
    cell.take_weights(&steady_weights(TILT_OUT));
    assert!(cell.log("rt-controller").contains("another user has its name"), "{}", cell.log("rt-controller"));
    let pour = cell.pour_tilted();
    assert_aborted("a taken name", &timed(abort_of(&cell)), pour);
    squatter.kill().and_then(|()| squatter.wait()).expect("ours");
    assert!(Path::new("/proc/net/unix").exists());
}
