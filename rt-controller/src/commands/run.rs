//! `rt-controller run`: the resident process.
//!
//! It takes the cell, so that no other controller runs in it, and starts the threads: "speaker" writes to the terminal, "stop" takes aborts
//! and passes signals on, "loop" is real-time, "robot" connects, "disk" writes the journal and reads weights; the main thread serves
//! clients and publishes telemetry. A signal brings the container upright and ends the process. A second signal ends it at once, and
//! the program on the robot then goes upright by itself. Starting allocates; each failure to start is one line, and a panic in any thread
//! ends the process.

use std::os::unix::fs::MetadataExt;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::SeqCst};

use shared::config::Config;
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::ipc::{Cell, InService as _, IpcError};
use shared::level::Level;
use shared::os;
use shared::runtime_dir::Place;
use shared::speaker::Speaker;

use crate::claim::Claim;
use crate::control_loop;
use crate::core::Settings;
use crate::disk::Disk;
use crate::disk_note::DiskNote;
use crate::exchange::Exchange;
use crate::link::network::System;
use crate::robot_thread::{self, RobotNote};
use crate::service::Service;
use crate::stop::{StopSockets, StopThread};

/// Stack of each thread beside the main one, bytes; all of it is locked in memory. Chosen by hand; no measurement is recorded.
const STACK: usize = 512 * 1024;
/// Space in `/dev/shm` that must be free before the controller makes its ports, bytes: they take 3.6 MB (measured).
const SHARED_MEMORY: u64 = 8 << 20;

/// The failure of a thread that could not be started.
fn no_thread(e: std::io::Error) -> Failure {
    failure(exit::FAILED, format!("a thread could not be started: {e}; does the system limit processes or locked memory?"))
}

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  rt-controller run --config config/sim.toml\n  rt-controller run --config config/cell.toml\n\n\
Ctrl-C or SIGTERM brings the container upright and stops the controller.\n\
Exit codes: 0 stopped, and the container was upright when a robot was last seen, or none was; 1 failed, or the container was last seen tilted;\n\
2 bad configuration or runtime directory; 3 shared memory cannot be used; 5 another controller of the cell is running.")]
pub struct Args {
    /// The cell's configuration.
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Print only warnings and errors.
    #[arg(long, short)]
    quiet: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    // Half a controller would be worse than none: without targets the robot's program comes upright by itself.
    std::panic::set_hook(Box::new(|panic| {
        os::tell(Level::Error, &format!("rt-controller: this is a defect, please report it: {}", exit::one_line(panic)));
        std::process::abort();
    }));
    let stop = Arc::new(AtomicBool::new(false));
    let lost = "rt-controller: shared memory vanished: /dev/shm is full, or a file there was cut. The container comes upright and the controller ends";
    os::explain_bus_errors(lost, exit::FAILED, Arc::clone(&stop));

    // This comes before the threads are made, so that everything that they need is in memory before the loop starts.
    let unlocked = os::lock_memory().err();
    let speaker = Speaker::start("rt-controller");
    let say = |level: Level, text: &str| {
        if !args.quiet || level != Level::Info {
            speaker.say(level, text);
        }
    };
    unlocked.iter().for_each(|line| say(Level::Warning, line));
    let _awake = os::stay_awake().map_err(|line| say(Level::Warning, &line));
    let result = start(&config, &args.config, &stop, &say, &speaker);
    if result.is_ok() {
        say(Level::Info, "stopped");
    }
    speaker.finish();
    result
}

/// Makes `stop` true at the first Ctrl-C or SIGTERM; the second one ends the process at once.
fn stop_at_signals(stop: &Arc<AtomicBool>) -> Result<(), Failure> {
    use signal_hook::flag::{register, register_conditional_shutdown};
    // Other reasons to stop must not make the first signal a second one.
    let armed = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        // It is armed by the first signal, so that only a second one ends the process at once.
        let second = register_conditional_shutdown(signal, exit::INTERRUPTED.into(), Arc::clone(&armed));
        let first = register(signal, Arc::clone(&armed)).and_then(|_| register(signal, Arc::clone(stop)));
        second.and(first).map_err(|e| format!("cannot handle signals: {e}")).or_exit(exit::FAILED)?;
    }
    Ok(())
}

/// Takes the cell, opens the way to stop a motion, and runs the threads until the loop has ended. Fails if the container is not upright then.
fn start(
    config: &Config,
    file: &Path,
    stop: &Arc<AtomicBool>,
    say: &(dyn Fn(Level, &str) + Sync),
    speaker: &Speaker,
) -> Result<(), Failure> {
    let directory = Place::from(&config.cell).directory().or_exit(exit::BAD_INPUT)?;
    let _claim = Claim::take(&directory, file, config).or_exit(exit::REFUSED)?;
    let owner = std::fs::metadata(file).ok().map(|m| m.uid());
    let sockets = StopSockets::open(&directory, &config.cell.name, say)?;
    // Until here a signal ends the process at once: nothing can move yet, and a disk that does not answer holds nobody up.
    stop_at_signals(stop)?;
    let shared = Shared::default();
    let tolerance_deg = config.robot.start_tolerance_deg as f32;
    let give_up = || {
        let held_up = shared.held_up();
        held_up.iter().for_each(|what| say(Level::Error, what));
        let code = match left_upright(&shared.exchange, tolerance_deg) {
            Err(e) => {
                say(Level::Error, &e.what);
                e.code
            }
            Ok(()) if held_up.is_some() => exit::FAILED,
            Ok(()) => {
                say(Level::Info, "stopped");
                0
            }
        };
        // Nothing is dropped here, and an abort is not to look for this controller any more. Their absence is no fault.
        for name in ["stop", "controller"] {
            let _ = std::fs::remove_file(directory.join(name));
        }
        speaker.finish();
        std::process::exit(code.into());
    };
    let stopping = StopThread {
        sockets,
        exchange: &shared.exchange,
        robot_note: &shared.note,
        tolerance_deg,
        stop,
        end: &shared.end,
        done: &shared.done,
        give_up: &give_up,
    };
    std::thread::scope(|scope| {
        thread("stop").spawn_scoped(scope, || stopping.run()).map_err(no_thread)?;
        let result = run_threads(config, owner, &shared, stop, say);
        shared.done.store(true, SeqCst);
        result.and_then(|()| left_upright(&shared.exchange, tolerance_deg))
    })
}

/// Fails if the container was tilted when the loop saw a robot last. Where no robot ever was, nothing was tilted.
fn left_upright(exchange: &Exchange, tolerance_deg: f32) -> Result<(), Failure> {
    let alpha_deg = f32::from_bits(exchange.last_alpha.load(SeqCst));
    if alpha_deg.abs() > tolerance_deg {
        let what =
            format!("stopped; the container may not be upright: it was last seen tilted by {alpha_deg:.0} degrees; look at the robot");
        return Err(failure(exit::FAILED, what));
    }
    Ok(())
}

/// What the threads share besides the queues.
#[derive(Default)]
struct Shared {
    exchange: Exchange,
    note: RobotNote,
    connections: AtomicU64,
    disk_note: DiskNote,
    /// Whether the robot's and the disk's threads are to end.
    end: AtomicBool,
    /// Whether everything is written.
    disk_done: AtomicBool,
    /// Whether the clients have their last answers.
    service_done: AtomicBool,
    /// Whether all other threads have ended.
    done: AtomicBool,
}

impl Shared {
    /// What keeps the process from its end, although the loop has ended. Nothing that matters if it is only an attempt to connect the robot.
    fn held_up(&self) -> Option<&'static str> {
        match (self.disk_done.load(SeqCst), self.service_done.load(SeqCst)) {
            _ if !self.exchange.begun.load(SeqCst) => {
                Some("the start is held up, by the disk or by shared memory: stopped without it, before any motion")
            }
            (true, true) => None,
            (true, false) => Some("a thread of the controller does not answer: stopped without it, so what it was to say may be missing"),
            (false, _) => Some("the disk does not answer: stopped without it, so the end of the journal may be missing"),
        }
    }
}

/// Starts the threads, serves clients in this one, and returns when the loop has ended, upright.
fn run_threads(
    config: &Config,
    owner: Option<u32>,
    shared: &Shared,
    stop: &AtomicBool,
    say: &(dyn Fn(Level, &str) + Sync),
) -> Result<(), Failure> {
    let Shared { exchange, note, connections, disk_note, end, disk_done, service_done, .. } = shared;
    let cell = Cell::join(&config.cell)?;
    cell.check_space(SHARED_MEMORY)?;
    let (disk, queues) = Disk::open(config, owner, exchange, disk_note, say).or_exit(exit::BAD_INPUT)?;
    let service = Service::open(&cell, exchange, (note, connections), (disk_note, queues), say)?;
    cell.reserve()?;
    std::thread::scope(|scope| {
        let (ready_sender, ready) = std::sync::mpsc::channel();
        thread("loop").spawn_scoped(scope, move || real_time(config, exchange, say, &ready_sender)).map_err(no_thread)?;
        ready.recv().unwrap_or(Ok(()))?;
        std::thread::scope(|inner| {
            let robot = || robot_thread::keep_robot_connected(&System, config, exchange, note, connections, end, say);
            let spawned = thread("robot").spawn_scoped(inner, robot);
            let writing = || {
                disk.run(end);
                disk_done.store(true, SeqCst);
            };
            let spawned = spawned.and(thread("disk").spawn_scoped(inner, writing));
            say(Level::Info, &format!("running in cell '{}' at {} Hz", config.cell.name, config.controller.rate_hz));
            // Without these threads there is no robot and there are no weights: the loop ends at once.
            stop.fetch_or(spawned.is_err(), SeqCst);
            service.run();
            service_done.store(true, SeqCst);
            end.store(true, SeqCst);
            spawned.map(|_| ()).map_err(no_thread)
        })
    })
}

/// The builder of a thread beside the main one.
fn thread(name: &str) -> std::thread::Builder {
    std::thread::Builder::new().name(name.into()).stack_size(STACK)
}

/// The real-time thread: opens its own node and subscriber, tells `ready` how that went, and runs the loop.
fn real_time(config: &Config, exchange: &Exchange, say: &dyn Fn(Level, &str), ready: &std::sync::mpsc::Sender<Result<(), IpcError>>) {
    let opened = Cell::join(&config.cell).and_then(|cell| {
        let subscriber = cell.features()?.subscriber_builder().buffer_size(crate::core::MAX_FEATURES).create();
        let subscriber = subscriber.in_service("feature")?;
        cell.reserve()?;
        Ok((cell, subscriber))
    });
    match opened {
        Ok((_cell, subscriber)) => {
            exchange.begun.store(true, SeqCst);
            let _ = ready.send(Ok(()));
            let place = control_loop::Place { core: config.controller.core, priority: config.controller.priority };
            let lost_ns = u64::from(config.controller.lost_robot_ms) * 1_000_000;
            control_loop::run(Settings::new(config), place, lost_ns, &subscriber, exchange, say);
        }
        Err(e) => {
            let _ = ready.send(Err(e));
        }
    }
}
