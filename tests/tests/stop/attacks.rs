//! How soon an abort is heard while what the processes share is attacked: a table, by `scripts/check-attacks`. That it is heard at all is held by
//! the tests beside this file in every run of the tests.

use std::any::Any;
use std::io::{Read as _, Write as _};
use std::os::linux::net::SocketAddrExt as _;
use std::os::unix::net::{SocketAddr, UnixStream};
use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use tests::{CellUnderTest, Namespaces, steady_weights};

use super::{Ended, SQUATTER};

/// How often each attack is measured.
const ROUNDS: usize = 3;
/// Size of the `/dev/shm` that is filled, in the words of mount(8).
const SMALL: &str = "64M";

/// What is done to a cell: before its start, and during a pour. What they give is kept until the abort is over.
struct Attack {
    what: &'static str,
    /// The size of a `/dev/shm` of its own.
    shm: Option<&'static str>,
    before: fn(&CellUnderTest) -> Option<Box<dyn Any>>,
    during: fn(&CellUnderTest) -> Option<Box<dyn Any>>,
}

fn nothing(_: &CellUnderTest) -> Option<Box<dyn Any>> {
    None
}

/// Answers of the controller at its stop socket, by the file or, where that is gone, the abstract name.
fn ask(cell: &CellUnderTest, line: &[u8]) -> Option<serde_json::Value> {
    let root = cell.inside.as_ref().map_or(PathBuf::new(), |_| PathBuf::from(format!("/proc/{}/root", cell.pid("rt-controller"))));
    let file = PathBuf::from(format!("{}{}", root.display(), cell.runtime_dir().join("stop").display()));
    let stream = UnixStream::connect(file).or_else(|_| {
        let uid = rustix::process::geteuid().as_raw();
        SocketAddr::from_abstract_name(format!("decant/{uid}/{}", cell.name)).and_then(|a| UnixStream::connect_addr(&a))
    });
    let mut stream = stream.ok()?;
    stream.write_all(line).ok()?;
    let mut text = String::new();
    stream.read_to_string(&mut text).ok()?;
    serde_json::from_str(&text).ok()
}

/// Runs `rt-controller abort`; the time until the controller no longer pours, and until the command came back.
fn abort(cell: &CellUnderTest) -> (Duration, Duration, bool) {
    let begin = Instant::now();
    let mut command = cell.program("rt-controller");
    command.args(["abort", "--config"]).arg(cell.config()).stdin(Stdio::null()).stdout(Stdio::null()).stderr(Stdio::null());
    let mut command = command.spawn().unwrap();
    let mut heard = None;
    let status = loop {
        let pours = ask(cell, b"state\n").map(|s| s["phase"] == "pouring");
        if heard.is_none() && pours != Some(true) {
            heard = Some(begin.elapsed());
        }
        if let Some(status) = command.try_wait().unwrap() {
            break status;
        }
        assert!(begin.elapsed() < Duration::from_secs(30), "it does not come back");
        std::thread::sleep(Duration::from_millis(2));
    };
    (heard.unwrap_or_else(|| begin.elapsed()), begin.elapsed(), status.success())
}

const ATTACKS: [Attack; 10] = [
    Attack { what: "none", shm: None, before: nothing, during: nothing },
    Attack {
        what: "`*.global_mgmt` cut to nothing",
        shm: None,
        before: nothing,
        during: |cell| {
            let files = cell.shared_memory().into_iter().filter(|f| f.to_string_lossy().contains("global_mgmt"));
            let cut = files.map(|f| std::fs::File::options().write(true).open(f).and_then(|f| f.set_len(0)).unwrap());
            assert!(cut.count() > 0, "there is such a file");
            None
        },
    },
    Attack {
        what: "a link of another user in `/tmp`, and the socket's name and all places at it taken, before the start",
        shm: None,
        before: |cell| {
            let link = PathBuf::from(format!("/tmp/decant_{}", cell.name));
            std::os::unix::fs::symlink("/dev/null", &link).unwrap();
            std::os::unix::fs::lchown(&link, Some(65534), Some(65534)).unwrap();
            let mut squatter = Command::new("python3");
            squatter.args(["-c", SQUATTER, &format!("decant/0/{}", cell.name)]).stdout(Stdio::piped());
            let mut squatter = squatter.spawn().unwrap();
            squatter.stdout.as_mut().unwrap().read_exact(&mut [0; 1]).unwrap();
            Some(Box::new((Ended(squatter), Removed(link))))
        },
        during: nothing,
    },
    Attack {
        what: "all slots of `control` taken",
        shm: None,
        before: nothing,
        during: |cell| {
            let clients: Vec<_> = (0..20).map_while(|_| rt_controller::client::Client::connect(&cell.name).ok()).collect();
            assert!(clients.len() < 20 && cell.status().is_none(), "no slot is left");
            Some(Box::new(clients))
        },
    },
    Attack {
        what: "`/dev/shm` full",
        shm: Some(SMALL),
        before: nothing,
        during: |cell| {
            let mut fill = cell.inside.as_ref().unwrap().command("dd");
            let fill = fill.args(["if=/dev/zero", "of=/dev/shm/full", "bs=64k"]).stderr(Stdio::null()).status().unwrap();
            assert!(!fill.success(), "it ends when nothing is free");
            None
        },
    },
    Attack {
        what: "the service thread stopped",
        shm: None,
        before: nothing,
        during: |cell| {
            let main = cell.pid("rt-controller").to_string();
            let mut strace = Command::new("strace");
            strace.args([
                "-q",
                "-p",
                &main,
                "-e",
                "trace=clock_nanosleep",
                "-e",
                "inject=clock_nanosleep:delay_enter=120s",
                "-o",
                "/dev/null",
            ]);
            let strace = Ended(strace.spawn().unwrap());
            std::thread::sleep(Duration::from_millis(500));
            assert!(cell.status().is_none(), "it hangs");
            Some(Box::new(strace))
        },
    },
    Attack {
        what: "200 silent clients at its sockets",
        shm: None,
        before: nothing,
        during: |cell| {
            let stop = cell.runtime_dir().join("stop");
            let name = SocketAddr::from_abstract_name(format!("decant/0/{}", cell.name)).unwrap();
            let silent: Vec<_> = (0..100).filter_map(|_| UnixStream::connect(&stop).ok()).collect();
            let more: Vec<_> = (0..100).filter_map(|_| UnixStream::connect_addr(&name).ok()).collect();
            Some(Box::new((silent, more)))
        },
    },
    Attack {
        what: "all files in `/dev/shm` deleted",
        shm: None,
        before: nothing,
        during: |cell| {
            cell.shared_memory().iter().for_each(|f| std::fs::remove_file(f).unwrap());
            None
        },
    },
    Attack {
        what: "the runtime directory deleted",
        shm: None,
        before: nothing,
        during: |cell| {
            std::fs::remove_dir_all(cell.runtime_dir()).unwrap();
            None
        },
    },
    Attack {
        what: "all files in `/dev/shm` cut to nothing",
        shm: None,
        before: nothing,
        during: |cell| {
            cell.shared_memory().iter().for_each(|f| std::fs::File::options().write(true).open(f).and_then(|f| f.set_len(0)).unwrap());
            None
        },
    },
];

/// A file that is removed with the round.
struct Removed(PathBuf);

impl Drop for Removed {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.0);
    }
}

/// One round: how soon the abort was heard, and how soon the command came back; `None` where the attack is not permitted.
fn round(attack: &Attack) -> Option<(Duration, Duration, bool)> {
    let mut cell = CellUnderTest::prepare(|_| {});
    if attack.shm.is_some() {
        cell.inside = Some(Namespaces::new(attack.shm)?);
    }
    let before = (attack.before)(&cell);
    cell.spawn_all();
    cell.take_weights(&steady_weights(13));
    let pour = Ended(cell.pour_tilted());
    let during = (attack.during)(&cell);
    let took = abort(&cell);
    drop((during, before, pour));
    Some(took)
}

/// Prints how soon an abort is heard under each attack, and how often the command said that the container is upright.
#[test]
#[ignore = "a table for scripts/check-attacks; minutes"]
fn how_soon_an_abort_is_heard() {
    if !rustix::process::geteuid().is_root() {
        println!("not run: it takes root to attack as another user, and namespaces");
        return;
    }
    println!(
        "| attack | heard after, ms (median, longest of {ROUNDS}) | the command came back after, s | said upright |\n|---|---|---|---|"
    );
    for attack in &ATTACKS {
        let mut all: Vec<_> = (0..ROUNDS).filter_map(|_| round(attack)).collect();
        all.sort();
        let ms = |d: Duration| d.as_secs_f64() * 1e3;
        let upright = all.iter().filter(|(.., upright)| *upright).count();
        match (all.get(all.len() / 2), all.last()) {
            (Some(middle), Some(last)) => {
                let back = all.iter().map(|(_, back, _)| back.as_secs_f64()).fold(0.0, f64::max);
                println!("| {} | {:.0}, {:.0} | {back:.1} | {upright} of {} |", attack.what, ms(middle.0), ms(last.0), all.len());
            }
            _ => println!("| {} | not permitted here | | |", attack.what),
        }
    }
}
