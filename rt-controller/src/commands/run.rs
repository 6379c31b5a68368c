//! `rt-controller run`: the resident process.
//!
//! It starts the threads: "loop" is real-time, "robot" connects, "disk" writes the journal and reads weights; the main thread serves
//! clients and publishes telemetry. A signal brings the container upright and ends the process. A second signal ends it at once, and
//! the program on the robot then goes upright by itself. Starting allocates; each failure to start is one line, and a panic in any thread
//! ends the process.

use std::io::Write;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};

use shared::config::Config;
use shared::exit::{self, Failure, OrExit as _, failure};
use shared::ipc::{Cell, InService as _, IpcError};

use crate::control_loop::{self, Place};
use crate::core::Settings;
use crate::disk::Disk;
use crate::exchange::Exchange;
use crate::link::network::System;
use crate::robot_thread::{self, RobotNote};
use crate::service::Service;

/// Stack of each thread beside the main one, bytes; all of it is locked in memory. Chosen by hand; no measurement is recorded.
const STACK: usize = 512 * 1024;

/// The failure of a thread that could not be started.
fn no_thread(e: std::io::Error) -> Failure {
    failure(exit::FAILED, format!("a thread could not be started: {e}; does the system limit processes or locked memory?"))
}

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  rt-controller run --config config/sim.toml\n  rt-controller run --config config/cell.toml\n\n\
Ctrl-C or SIGTERM brings the container upright and stops the controller.")]
pub struct Args {
    /// The cell's configuration.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let config = Config::read(&args.config).or_exit(exit::BAD_INPUT)?;
    // A terminal that has gone away is no reason to stop.
    let say = |text: &str| _ = writeln!(std::io::stderr(), "rt-controller: {text}");
    // Half a controller would be worse than none: without targets the robot's program comes upright by itself.
    std::panic::set_hook(Box::new(|panic| {
        let _ = writeln!(std::io::stderr(), "rt-controller: this is a defect, please report it: {panic}");
        std::process::abort();
    }));
    let stop = stop_at_signals()?;

    // This comes before the threads are made, so that everything that they need is in memory before the loop starts.
    if let Err(line) = shared::os::lock_memory() {
        say(&line);
    }
    let _awake = shared::os::stay_awake().map_err(|line| say(&line));
    run_threads(&config, &stop, &say)?;
    say("stopped");
    Ok(())
}

/// Becomes true at the first Ctrl-C or SIGTERM; the second one ends the process at once.
fn stop_at_signals() -> Result<Arc<AtomicBool>, Failure> {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        // It is armed by the first signal, so that only a second one ends the process at once.
        let second = signal_hook::flag::register_conditional_shutdown(signal, exit::INTERRUPTED.into(), Arc::clone(&stop));
        let first = signal_hook::flag::register(signal, Arc::clone(&stop));
        second.and(first).map_err(|e| format!("cannot handle signals: {e}")).or_exit(exit::FAILED)?;
    }
    Ok(stop)
}

/// Starts the threads, serves clients in this one, and returns when the loop has ended, upright.
fn run_threads(config: &Config, stop: &AtomicBool, say: &(dyn Fn(&str) + Sync)) -> Result<(), Failure> {
    let exchange = Exchange::default();
    let (note, connections, refused) = (RobotNote::default(), AtomicU64::new(0), Mutex::default());
    std::thread::scope(|scope| {
        let cell = Cell::join(&config.cell.name).or_exit(exit::FAILED)?;
        let (disk, journal) = Disk::open(config, &exchange, &refused, say);
        let service = Service::open(&cell, &exchange, (&note, &connections), (&refused, journal), say).or_exit(exit::FAILED)?;
        let (ready_sender, ready) = std::sync::mpsc::channel();
        let exchange = &exchange;
        thread("loop").spawn_scoped(scope, move || real_time(config, exchange, say, &ready_sender)).map_err(no_thread)?;
        ready.recv().unwrap_or(Ok(())).or_exit(exit::FAILED)?;
        let end = AtomicBool::new(false);
        std::thread::scope(|inner| {
            let robot = || robot_thread::keep_robot_connected(&System, config, exchange, &note, &connections, &end, say);
            let spawned = thread("robot").spawn_scoped(inner, robot);
            let spawned = spawned.and(thread("disk").spawn_scoped(inner, || disk.run(&end)));
            say(&format!("running in cell '{}' at {} Hz", config.cell.name, config.controller.rate_hz));
            // Without these threads there is no robot and there are no weights: the loop ends at once.
            stop.fetch_or(spawned.is_err(), Relaxed);
            service.run(stop);
            end.store(true, Relaxed);
            spawned.map(|_| ()).map_err(no_thread)
        })
    })
}

/// The builder of a thread beside the main one.
fn thread(name: &str) -> std::thread::Builder {
    std::thread::Builder::new().name(name.into()).stack_size(STACK)
}

/// The real-time thread: opens its own node and subscriber, tells `ready` how that went, and runs the loop.
fn real_time(config: &Config, exchange: &Exchange, say: &dyn Fn(&str), ready: &std::sync::mpsc::Sender<Result<(), IpcError>>) {
    let opened = Cell::join(&config.cell.name).and_then(|cell| {
        let subscriber = cell.features()?.subscriber_builder().buffer_size(crate::core::MAX_FEATURES).create();
        Ok((cell, subscriber.in_service("feature")?))
    });
    match opened {
        Ok((_cell, subscriber)) => {
            let _ = ready.send(Ok(()));
            let place = Place { core: config.controller.core, priority: config.controller.priority };
            let lost_ns = u64::from(config.controller.lost_robot_ms) * 1_000_000;
            control_loop::run(Settings::new(config), place, lost_ns, &subscriber, exchange, say);
        }
        Err(e) => {
            let _ = ready.send(Err(e));
        }
    }
}
