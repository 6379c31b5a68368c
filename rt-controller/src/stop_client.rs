//! The clients' side of the stop socket ([`crate::stop`]): finds the controllers that run, and asks them to stop the motion.
//!
//! It needs no shared memory. It runs in ordinary threads of other processes, allocates, and waits for an answer a moment at most. Who
//! answers is checked: the socket's server must be the user whose cell it is, or root. The cell belongs to the owner of its runtime directory, if
//! root or this user has chosen where that lies ([`claim::owner`]); a configuration is such a choice. So a group may stop the cell of the user
//! `decant`, and nobody else can answer for it. Each failure is one line that names the cell.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::os::linux::net::SocketAddrExt;
use std::os::unix::fs::MetadataExt;
use std::os::unix::net::{SocketAddr, UnixStream};
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::time::{Duration, Instant};

use rustix::net::SocketAddrUnix;
use shared::config::is_cell_name;
use shared::os::peer;
use shared::regular_file;
use shared::runtime_dir::{Place, bases, own_uid};

use crate::claim;
use crate::stop::{ROUND, ROUNDS, StopAnswer, abstract_name, listener, named_listener};

/// Longest wait for an answer. Chosen by hand: the controller's thread answers at once.
const ANSWER: Duration = Duration::from_secs(1);
/// Longest answer that is read, bytes. Chosen by hand: ten times the longest one.
const ANSWER_MAX: u64 = 4096;
/// The most cells that are asked, or told of, by their names alone, in turns of each user's. Chosen by hand: a machine has a few, and more would be
/// somebody's names.
const NAMES_MOST: usize = 64;
/// Which user numbers the administrator has lent to whom, as for containers: lines `LENT_TO:FIRST:COUNT` (subuid(5)).
const LENT: &str = "/etc/subuid";
/// Largest such file that is read, bytes. Chosen by hand: some ten thousand users.
const LENT_MAX: u64 = 1 << 20;

/// Where the controller of one cell may be reached.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Target {
    /// The cell's name.
    pub name: String,
    /// The user as whom its controller runs.
    pub uid: u32,
    /// The cell's runtime directories that are there and have an owner.
    directories: Vec<PathBuf>,
    /// Of a directory that is there and is not believed, why; empty if there is none.
    pub doubted: String,
    /// Only its socket's name shows that it runs: its runtime directory is not among the usual ones.
    pub only_a_name: bool,
}

impl From<Place> for Target {
    fn from(place: Place) -> Self {
        let named = place.base.is_some();
        let mut directories = vec![place.path()];
        if !named {
            directories.extend(bases().into_iter().map(|b| b.join(&place.name)));
            directories.dedup();
        }
        let (mut believed, mut doubted) = (Vec::new(), String::new());
        for directory in directories {
            match claim::owner(&directory, named) {
                Ok(Some(_)) if is_closed(&directory) => doubted = format!("{} is closed to this user", directory.display()),
                Ok(owner) => believed.extend(owner.map(|uid| (directory, uid))),
                Err(why) => doubted = why,
            }
        }
        let uid = believed.iter().find(|(d, _)| d.join("stop").exists()).map_or_else(own_uid, |(_, uid)| *uid);
        Self { name: place.name, uid, directories: believed.into_iter().map(|(d, _)| d).collect(), doubted, only_a_name: false }
    }
}

/// Whether this user may not look into `directory`, so that a controller may run there unseen.
fn is_closed(directory: &Path) -> bool {
    directory.join("stop").symlink_metadata().is_err_and(|e| e.kind() == ErrorKind::PermissionDenied)
}

/// What runs on this machine, as this user can see it.
pub struct Running {
    /// The cells whose controllers this user may stop: their own, those whose runtime directory lets them in, and for root all.
    pub targets: Vec<Target>,
    /// Where a controller may run that cannot be reached from here, and why, a line each.
    pub doubted: Vec<String>,
    /// The cells of other users whose controllers run, and whose runtime directories are not among the usual ones: each its user and its name.
    pub others: Vec<(u32, String)>,
}

/// Looks for the cells that run.
pub fn running_cells() -> Running {
    let mut found: BTreeMap<(u32, String), Vec<PathBuf>> = BTreeMap::new();
    let mut doubted = Vec::new();
    for entry in bases().iter().filter_map(|b| std::fs::read_dir(b).ok()).flatten().flatten() {
        let runs = entry.path().join("stop").exists() && entry.file_name().to_str().is_some_and(is_cell_name);
        match claim::owner(&entry.path(), false) {
            Ok(Some(uid)) if runs => found.entry((uid, entry.file_name().to_string_lossy().into_owned())).or_default().push(entry.path()),
            Err(why) if runs || is_closed(&entry.path()) => doubted.push(why),
            _ => {}
        }
    }
    for line in std::fs::read_to_string("/proc/net/unix").unwrap_or_default().lines() {
        let Some((uid, name)) = line.split_once("@decant/").and_then(|(_, rest)| rest.split_once('/')) else { continue };
        // Any user may bind a name, and write into a terminal with it.
        if let (Ok(uid), true) = (uid.parse(), is_cell_name(name)) {
            found.entry((uid, name.into())).or_default();
        }
    }
    let all = found.into_iter().map(|((uid, name), directories)| {
        let only_a_name = directories.is_empty();
        Target { name, uid, directories, doubted: String::new(), only_a_name }
    });
    let (named, mut targets): (Vec<Target>, Vec<Target>) = all.partition(|target| target.only_a_name);
    let own = |target: &Target| [0, target.uid].contains(&own_uid());
    let (named, others): (Vec<Target>, Vec<Target>) = listening(named).into_iter().partition(own);
    let lent = regular_file::read_text(Path::new(LENT), LENT_MAX).unwrap_or_default();
    targets.extend(shared_out(named, &lent).into_iter().take(NAMES_MOST));
    let others = shared_out(others, &lent).into_iter().take(NAMES_MOST).map(|target| (target.uid, target.name)).collect();
    Running { targets, doubted, others }
}

/// The same in turns: each user's first, then each one's second, and so on. So a user who makes many names crowds out nobody else's cell. The numbers that
/// one user has been lent are one user's, because whoever has them can act as each of them: `lent` is the text of [`LENT`].
fn shared_out(named: Vec<Target>, lent: &str) -> Vec<Target> {
    let ranges: Vec<(&str, u32, u32)> = lent
        .lines()
        .filter_map(|line| {
            let mut parts = line.split(':').map(str::trim);
            let (to, first, count) = (parts.next()?, parts.next()?.parse().ok()?, parts.next()?.parse().ok()?);
            Some((to, first, count))
        })
        .collect();
    let lent_to =
        |uid: u32| ranges.iter().find(|(_, first, count)| uid.checked_sub(*first).is_some_and(|n| n < *count)).map(|(to, ..)| *to);
    let mut of_user: BTreeMap<Result<&str, u32>, usize> = BTreeMap::new();
    let in_turn = |target: Target| {
        let turn = of_user.entry(lent_to(target.uid).ok_or(target.uid)).or_default();
        *turn += 1;
        (*turn, target)
    };
    let mut named: Vec<(usize, Target)> = named.into_iter().map(in_turn).collect();
    named.sort_by_key(|(turn, _)| *turn);
    named.into_iter().map(|(_, target)| target).collect()
}

/// Those at whose names somebody listens who is the name's user or root. Nobody is waited for: a socket whose places are all taken would let nobody connect.
fn listening(mut named: Vec<Target>) -> Vec<Target> {
    let mut found = Vec::new();
    for _ in 0..ROUNDS {
        named.retain(|target| match named_listener(target.uid, &target.name) {
            Ok(uid) => {
                found.extend((uid == target.uid || uid == 0).then(|| target.clone()));
                false
            }
            Err(full) => full,
        });
        if named.is_empty() {
            break;
        }
        std::thread::sleep(ROUND);
    }
    found
}

/// The controllers that run as this user, or for root as anybody, where this process can reach their sockets' names, and that are none of those that `answered`:
/// process numbers. Unlike a name, no other user can make one of this user's.
pub fn unreached(answered: &[u32]) -> Vec<u32> {
    let net = |process: &str| std::fs::read_link(format!("/proc/{process}/ns/net")).ok();
    let here = net("self");
    let runs = |pid: u32| {
        let arguments = std::fs::read(format!("/proc/{pid}/cmdline")).unwrap_or_default();
        let own = std::fs::metadata(format!("/proc/{pid}")).is_ok_and(|m| own_uid() == 0 || m.uid() == own_uid());
        own && claim::started(pid).is_some() && arguments.split(|b| *b == 0).nth(1) == Some(b"run") && net(&pid.to_string()) == here
    };
    let processes = std::fs::read_dir("/proc").into_iter().flatten().flatten().filter_map(|e| e.file_name().to_str()?.parse().ok());
    processes.filter(|pid| !answered.contains(pid) && runs(*pid)).collect()
}

/// The controller of the cell `place`, if it runs. One whose process is out of sight, as from within a container, counts if it answers. Fails, with a line,
/// where its runtime directory is there and is not believed.
pub fn running_at(place: &Place) -> Result<Option<claim::Running>, String> {
    if let Some(seen) = claim::running_at(place)? {
        return Ok(Some(seen));
    }
    let target = Target::from(place.clone());
    let said = target.directories.first().filter(|d| **d == place.path()).and_then(|d| claim::said_in(d));
    Ok(said.filter(|_| target.ask("state").is_some()))
}

impl Target {
    /// Whether somebody who is the cell's user or root listens at one of its sockets, whether or not an answer comes. Nobody is waited for.
    pub fn is_heard(&self) -> bool {
        let files = self.directories.iter().filter_map(|d| SocketAddrUnix::new(d.join("stop")).ok());
        let name = SocketAddrUnix::new_abstract_name(abstract_name(self.uid, &self.name).as_bytes()).ok();
        // One whose places are all taken has a listener, and whose it is stays unknown.
        files.chain(name).any(|address| listener(&address).map_or_else(|full| full, |uid| [self.uid, 0].contains(&uid)))
    }

    /// Sends `line` to the controller and gives its answer; `None` if no controller answers at either socket.
    pub fn ask(&self, line: &'static str) -> Option<StopAnswer> {
        let name = abstract_name(self.uid, &self.name);
        let mut addresses: Vec<SocketAddr> =
            self.directories.iter().filter_map(|d| SocketAddr::from_pathname(d.join("stop")).ok()).collect();
        addresses.extend(SocketAddr::from_abstract_name(name).ok());
        ask_all(addresses, self.uid, line)
    }

    /// The process of the cell's controller, if it runs and its runtime directory still says so.
    pub fn process(&self) -> Option<claim::Running> {
        // They were believed when the target was made.
        self.directories.iter().find_map(|d| claim::running_in(d))
    }
}

/// Asks at all sockets at once, and gives the first answer that refuses nothing, or else a refusal: the abstract socket refuses a member of the
/// group whom the file obeys. A thread for each does it, because a server that was stopped takes no connection and gives no answer; so two sockets
/// of such a server take no longer than one.
fn ask_all(addresses: Vec<SocketAddr>, uid: u32, line: &'static str) -> Option<StopAnswer> {
    let until = Instant::now() + ANSWER;
    let (sender, receiver) = mpsc::channel();
    for address in addresses {
        let sender = sender.clone();
        // Without a thread this socket is not asked; the others are.
        let _ = std::thread::Builder::new().spawn(move || sender.send(ask_at(&address, uid, line)));
    }
    drop(sender);
    let mut refusal = None;
    // It ends when each socket has answered or has given no answer, or at the end of the wait.
    while let Ok(answer) = receiver.recv_timeout(until.saturating_duration_since(Instant::now())) {
        match answer {
            Some(answer) if answer.refused.is_empty() => return Some(answer),
            answer => refusal = refusal.or(answer),
        }
    }
    refusal
}

fn ask_at(address: &SocketAddr, uid: u32, line: &str) -> Option<StopAnswer> {
    let mut stream = UnixStream::connect_addr(address).ok()?;
    let [_, pid] = peer(&stream).filter(|[peer, _]| [uid, 0].contains(peer))?;
    stream.write_all(format!("{line}\n").as_bytes()).ok()?;
    let mut answer = String::new();
    BufReader::new((&stream).take(ANSWER_MAX)).read_line(&mut answer).ok()?;
    let answer: StopAnswer = serde_json::from_str(&answer).ok()?;
    // Its texts are shown on a terminal.
    let plain = |text: String| shared::level::plain(&text).to_string();
    Some(StopAnswer {
        pid: if pid > 0 { pid } else { answer.pid },
        hindrance: plain(answer.hindrance),
        refused: plain(answer.refused),
        ..answer
    })
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::{PermissionsExt, chown, symlink};

    use super::*;

    /// Protects who aborts from an answer of somebody else: a directory that another user may have made tells nothing of a cell, and one in root's
    /// directory tells whose cell it is, as that of the user `decant` in /run/decant. It takes root, to act for another user.
    #[test]
    fn a_strangers_directory_says_nothing() {
        if own_uid() != 0 {
            println!("not run: it takes root");
            return;
        }
        let dir = tempfile::tempdir().unwrap();
        let base = dir.path().join("base");
        let cell = base.join("lab");
        std::fs::create_dir_all(&cell).unwrap();
        std::fs::write(cell.join("stop"), "").unwrap();
        let found = |base: &std::path::Path| {
            let target = Target::from(Place { name: "lab".into(), base: Some(base.into()) });
            (target.uid, target.directories.len())
        };
        let mode = |mode| std::fs::set_permissions(&base, std::fs::Permissions::from_mode(mode)).unwrap();
        mode(0o755);
        chown(&cell, Some(65534), None).unwrap();
        assert_eq!(found(&base), (65534, 1), "root has put it there");
        mode(0o1777);
        assert_eq!(found(&base), (0, 0), "anybody may have put it there");
        mode(0o755);
        chown(&base, Some(65534), None).unwrap();
        assert_eq!(found(&base), (65534, 1), "the caller's configuration names the directory of the cell's own user");
        mode(0o1777);
        assert_eq!(found(&base), (0, 0), "there anybody may have put it");
        assert!(
            Target::from(Place { name: "lab".into(), base: Some(base.clone()) })
                .doubted
                .contains("others may write where it lies (mode 1777)")
        );
        mode(0o755);
        chown(&cell, Some(65533), None).unwrap();
        assert_eq!(found(&base), (0, 0), "another user has put a third one's there");
        chown(&cell, Some(0), None).unwrap();
        chown(&base, Some(0), None).unwrap();
        assert_eq!(found(&base), (0, 1), "our own");
        let link = dir.path().join("link");
        symlink(&base, &link).unwrap();
        assert_eq!(found(&link), (0, 1));
        std::os::unix::fs::lchown(&link, Some(65534), None).unwrap();
        assert_eq!(found(&link), (0, 0), "another user may lead it elsewhere");
    }

    /// Protects who aborts as root beside a user who was lent many numbers, as for containers, and makes a name with each: all of them are one user's turn.
    #[test]
    fn lent_numbers_are_one_users() {
        let named = |uid| Target { name: "a".into(), uid, directories: Vec::new(), doubted: String::new(), only_a_name: true };
        let crowd = (100_000..100_100).chain([3_000_000_000]);
        let uids = |lent| shared_out(crowd.clone().map(named).collect(), lent).iter().map(|t| t.uid).collect::<Vec<_>>();
        let lent = "anna:100000:65536\n# nonsense\n:\notto:165536:x\n";
        assert_eq!(uids(lent)[..3], [100_000, 3_000_000_000, 100_001]);
        assert_eq!(uids("")[100], 3_000_000_000, "each is a user of its own, as far as it is known");
        assert_eq!(uids(lent).len(), 101);
    }

    /// Protects who aborts after an upgrade: the answer of a controller of another version is understood, and what it does not say is not taken as rest.
    #[test]
    fn answers_of_other_versions_are_understood() {
        let older: StopAnswer = serde_json::from_str(r#"{"pid":7,"phase":"returning","alpha_deg":3.0}"#).unwrap();
        assert_eq!((older.pid, older.phase, older.upright, &*older.refused), (7, shared::messages::Phase::Returning, false, ""));
        let silent: StopAnswer = serde_json::from_str(r#"{"pid":7}"#).unwrap();
        assert_eq!(silent.phase, shared::messages::Phase::Pouring, "it may move");
        let newer: StopAnswer = serde_json::from_str(r#"{"pid":7,"phase":"stirring","upright":true,"speed":[1,2]}"#).unwrap();
        assert_eq!((newer.phase, newer.upright), (shared::messages::Phase::Pouring, true));
    }

    /// Protects a member of the cell's group, whom the controller obeys at the file alone: the refusal of the abstract socket comes first, and must not
    /// count.
    #[test]
    fn a_refusal_waits_for_the_other_socket() {
        let dir = tempfile::tempdir().unwrap();
        let serve = |name: &str, refused: &str, after: Duration| {
            let listener = std::os::unix::net::UnixListener::bind(dir.path().join(name)).unwrap();
            let answer = StopAnswer {
                pid: 1,
                phase: shared::messages::Phase::Idle,
                alpha_deg: None,
                upright: true,
                hindrance: String::new(),
                refused: refused.into(),
            };
            std::thread::spawn(move || {
                let (mut stream, _) = listener.accept().unwrap();
                std::thread::sleep(after);
                stream.write_all(format!("{}\n", serde_json::to_string(&answer).unwrap()).as_bytes()).unwrap();
            });
            SocketAddr::from_pathname(dir.path().join(name)).unwrap()
        };
        let late = Duration::from_millis(200);
        let both = vec![serve("refuses", "no", Duration::ZERO), serve("obeys", "", late)];
        assert_eq!(ask_all(both, own_uid(), "abort").unwrap().refused, "");
        let both = vec![serve("refuses-1", "no", Duration::ZERO), serve("refuses-2", "no", late)];
        assert_eq!(ask_all(both, own_uid(), "abort").unwrap().refused, "no");
    }
}
