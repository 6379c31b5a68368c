//! `rt-controller abort`: brings the container upright at once, and waits until it is. It is a short, ordinary process, and every failure
//! is one line.
//!
//! It asks at the controller's stop socket, which needs neither shared memory nor a configuration. If nobody answers there, it sends the
//! controller's process SIGTERM, which brings the container upright too and ends the controller, and SIGCONT, without which a process that was
//! stopped does not take it. One that does not end by them is killed: the robot's program then brings the container upright by itself.

use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use clap::builder::{OsStringValueParser, TypedValueParser as _};
use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal};
use shared::config::{Config, VARIABLE};
use shared::exit::{self, Failure, failure};
use shared::messages::Phase;
use shared::runtime_dir::{Place, own_uid};

use crate::claim;
use crate::stop_client::{Running, Target, running_cells, unreached};

/// How long the command waits for the container to be upright. Chosen by hand: the way back from the largest tilt takes about 2 s.
const UPRIGHT: Duration = Duration::from_secs(20);
/// Pause between two looks at the controller's state. Chosen by hand; no measurement is recorded.
const BEAT: Duration = Duration::from_millis(50);
/// How long a controller may take to end after SIGTERM before it is killed. Chosen by hand: the way back from the largest tilt takes about 2 s, and the
/// end of its threads 2 s at most. One that hangs may pour on meanwhile.
const ENDS: Duration = Duration::from_secs(5);
/// So many looks in a row may remain without an answer of a controller whose process is not seen. Chosen by hand.
const UNANSWERED: u32 = 3;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  rt-controller abort\n  rt-controller abort --config config/cell.toml\n\n\
Without a configuration it stops every controller that runs and that this user may stop: their own, and those whose runtime directory\n\
lets their group in; as root all. It does not need shared memory, and\n\
works while /dev/shm is full or files were deleted. If no controller answers, it sends the process SIGTERM; Ctrl-C in the controller's\n\
terminal and `kill` do the same. The container then comes upright, and the controller ends. One that does not end within 5 s is killed.\n\
Exit codes: 0 upright, 1 not upright or not known, 3 no controller, 5 the robot cannot be moved.")]
pub struct Args {
    /// The cell's configuration; without it, every cell that runs.
    // An empty name, as of a variable that is set to nothing, is a configuration that cannot be read, and no reason not to stop.
    #[arg(long, env = VARIABLE, value_parser = OsStringValueParser::new().map(PathBuf::from))]
    config: Option<PathBuf>,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let Running { targets, doubted, others } = targets(args.config.as_deref());
    for (uid, name) in others {
        eprintln!(
            "note: an rt-controller of user {uid}, cell '{name}', runs too and was not asked: if its runtime directory lets you in, give the cell's --config"
        );
    }
    let missed = |answered: &[u32]| -> Vec<String> {
        if args.config.as_deref().is_some_and(|file| Config::read(file).is_ok()) {
            return Vec::new();
        }
        unreached(answered)
            .into_iter()
            .map(|pid| format!("process {pid} is an rt-controller that was not reached: give its cell's --config"))
            .collect()
    };
    if targets.is_empty() {
        let doubted = [doubted, missed(&[])].concat();
        let none = || failure(exit::UNREACHABLE, "no rt-controller that this user may stop is running");
        return Err(if doubted.is_empty() { none() } else { not_known(&doubted.join("; ")) });
    }
    for why in &doubted {
        eprintln!("error: {}", not_known(why).what);
    }
    // Every cell is asked before one is waited for, and all at once: a socket that does not answer keeps no other cell waiting.
    let mut asked: Vec<(Target, Result<Asked, Failure>)> = std::thread::scope(|scope| {
        let ask_in_thread = |target: Target| {
            let own = target.clone();
            (target, std::thread::Builder::new().spawn_scoped(scope, move || ask(&own)))
        };
        let begun: Vec<_> = targets.into_iter().map(ask_in_thread).collect();
        let answer = |target: &Target, begun: std::io::Result<std::thread::ScopedJoinHandle<'_, _>>| match begun.map(|b| b.join()) {
            Ok(Ok(asked)) => asked,
            _ => ask(target),
        };
        begun
            .into_iter()
            .map(|(target, begun)| {
                let asked = answer(&target, begun);
                (target, asked)
            })
            .collect()
    });
    // Another user's name at which nobody answers keeps nobody from knowing that the others are upright.
    asked.retain(|(target, asked)| {
        let strange = target.only_a_name && target.uid != own_uid() && asked.as_ref().is_err_and(|e| e.code == exit::UNREACHABLE);
        if strange {
            eprintln!("note: nobody answers at the socket of cell '{}' of user {}", target.name, target.uid);
        }
        !strange
    });
    let answered: Vec<u32> = asked.iter().filter_map(|(_, asked)| asked.as_ref().ok().map(Asked::pid)).collect();
    let missed = missed(&answered);
    for why in &missed {
        eprintln!("error: {}", not_known(why).what);
    }
    let doubted = [doubted, missed].concat();
    let several = asked.len() + doubted.len() > 1;
    let mut result = if doubted.is_empty() { Ok(()) } else { Err(failure(exit::FAILED, "not every container is known to be upright")) };
    for (target, asked) in asked {
        let cell = if several { format!("cell '{}': ", target.name) } else { String::new() };
        match asked.and_then(|a| wait(&target, a)) {
            Ok(line) => println!("{cell}{line}"),
            Err(Failure { code, what }) if several => {
                eprintln!("error: {cell}{what}");
                result = Err(failure(code, "not every container is upright"));
            }
            Err(e) => return Err(e),
        }
    }
    result
}

/// The failure where a runtime directory is not believed, for the reasons `why`, so that nobody was asked there.
fn not_known(why: &str) -> Failure {
    let what =
        format!("{why}; whether rt-controller runs there is not known: look at the robot, and abort as the cell's own user or as root");
    failure(exit::FAILED, what)
}

/// The cells that are meant, and what cannot be reached. A configuration that cannot be read must not keep anybody from stopping a robot.
fn targets(config: Option<&Path>) -> Running {
    match config.map(Config::read) {
        Some(Ok(config)) => {
            let named = Target::from(Place::from(&config.cell));
            // Root stops a cell whoever runs it. A controller that hangs where the configuration says is that cell's, and is ended.
            let others = || running_cells().targets.into_iter().filter(|t| t.name == named.name).collect::<Vec<_>>();
            let of_others = if own_uid() == 0 && named.process().is_none() && named.ask("state").is_none() { others() } else { Vec::new() };
            let targets = if of_others.is_empty() { vec![named] } else { of_others };
            Running { targets, doubted: Vec::new(), others: Vec::new() }
        }
        Some(Err(e)) => {
            eprintln!("{e}; every cell that runs is stopped instead");
            running_cells()
        }
        None => running_cells(),
    }
}

/// How a controller was reached.
enum Asked {
    /// At its socket, which this process serves.
    Socket(u32),
    /// At its socket, where this process refused, for this reason.
    Refused(u32, String),
    /// By SIGTERM to this process, which the descriptor means.
    Process(claim::Running, OwnedFd),
}

impl Asked {
    /// The controller's process.
    fn pid(&self) -> u32 {
        match self {
            Self::Socket(pid) | Self::Refused(pid, _) => *pid,
            Self::Process(process, _) => process.pid,
        }
    }
}

/// Asks the controller of `target` to stop.
fn ask(target: &Target) -> Result<Asked, Failure> {
    // One that was stopped answers nobody, so nobody waits for it.
    let stopped = target.process().is_some_and(|process| claim::is_stopped(process.pid));
    if let Some(answer) = (!stopped).then(|| target.ask("abort")).flatten() {
        return Ok(if answer.refused.is_empty() { Asked::Socket(answer.pid) } else { Asked::Refused(answer.pid, answer.refused) });
    }
    let absent = || {
        if target.only_a_name && target.uid == own_uid() {
            // Where it keeps its process number is not known without the configuration, so a controller that hangs cannot be ended.
            return not_known(&format!(
                "the rt-controller of cell '{}' does not answer: give the cell's --config, which may end it",
                target.name
            ));
        }
        if !target.doubted.is_empty() {
            return not_known(&target.doubted);
        }
        // Of a name alone anybody could say so.
        if !target.only_a_name && target.is_heard() {
            let what = format!(
                "the rt-controller of cell '{}' does not answer, and its process is out of sight, as from within a container: look at the robot, and abort outside",
                target.name
            );
            return failure(exit::FAILED, what);
        }
        let what = format!(
            "no rt-controller of cell '{}' is running; a robot that one has left comes upright by its own program (docs/ROBOT.md)",
            target.name
        );
        failure(exit::UNREACHABLE, what)
    };
    let process = target.process().ok_or_else(absent)?;
    let pid = i32::try_from(process.pid).ok().and_then(Pid::from_raw).ok_or_else(absent)?;
    // The descriptor means this process even if it ends now and its number is given to another one.
    let held = pidfd_open(pid, PidfdFlags::empty()).map_err(|_| absent())?;
    if claim::started(process.pid) != Some(process.started) {
        return Err(absent());
    }
    let refused = |e| {
        let what = format!(
            "rt-controller, process {}, does not answer, and this user cannot end it: {e}: look at the robot, and abort as the cell's own user or as root",
            process.pid
        );
        failure(exit::FAILED, what)
    };
    pidfd_send_signal(&held, Signal::TERM).map_err(refused)?;
    // As systemd does: the signal to end waits for a process that was stopped until that goes on.
    let _ = pidfd_send_signal(&held, Signal::CONT);
    Ok(Asked::Process(process, held))
}

/// Waits until the container is upright. Gives the line that says so.
fn wait(target: &Target, mut asked: Asked) -> Result<String, Failure> {
    let mut begun = Instant::now();
    let until = begun + UPRIGHT;
    let mut unanswered = 0;
    let mut killed = false;
    while Instant::now() < until {
        match &asked {
            Asked::Refused(_, why) => return Err(failure(exit::REFUSED, why)),
            Asked::Socket(pid) => match target.ask("state") {
                Some(state) if state.upright => return Ok("upright".into()),
                Some(state) if state.phase == Phase::NoRobot => return Err(failure(exit::FAILED, state.hindrance)),
                Some(_) => unanswered = 0,
                // One that a signal has stopped since is ended, as one that was stopped before.
                None if target.process().is_some_and(|process| claim::is_stopped(process.pid)) => {
                    (asked, begun) = (ask(target)?, Instant::now());
                }
                // One that is busy, or whose other clients take its time, is not gone. Its process may be out of sight, though.
                None if unanswered < UNANSWERED || claim::started(*pid).is_some() => unanswered += 1,
                None => {
                    let what =
                        "rt-controller ended meanwhile: the robot's program brings the container upright by itself; look at the robot";
                    return Err(failure(exit::UNREACHABLE, what));
                }
            },
            Asked::Process(claim::Running { pid, started, .. }, held) => {
                if claim::started(*pid) != Some(*started) {
                    let what = match killed {
                        false => format!("rt-controller did not answer and was ended (SIGTERM to process {pid}): look at the robot"),
                        true => {
                            format!("rt-controller did not answer, nor end by SIGTERM, and was killed (process {pid}): look at the robot")
                        }
                    };
                    return Err(failure(exit::FAILED, what));
                }
                if !killed && begun.elapsed() > ENDS {
                    killed = pidfd_send_signal(held, Signal::KILL).is_ok();
                }
            }
        }
        std::thread::sleep(BEAT);
    }
    Err(failure(exit::FAILED, "not upright after 20 s: look at the robot"))
}
