//! `rt-controller run`: the resident process.
//!
//! Main thread: clients, telemetry (ordinary). Thread "loop": real-time. Thread "robot": connects. Thread "disk": journal, weights. A
//! signal brings the container upright and ends the process; a second one ends it at once (the robot's program then goes upright by itself).

use std::io::Write;
use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Arc, Mutex};

use shared::config::Config;
use shared::exit::{self, Failure, OrExit as _};
use shared::ipc::{Cell, IpcError};

use crate::control_loop::{self, Place};
use crate::core::Settings;
use crate::disk::Disk;
use crate::exchange::Exchange;
use crate::service::{self, RobotNote, Service};

/// Stack of each thread beside the main one, bytes: all of it is locked in memory.
const STACK: usize = 512 * 1024;

fn no_thread(e: std::io::Error) -> IpcError {
    IpcError::Service { service: "thread".into(), what: format!("the system gives no thread: {e}") }
}

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = "Examples:\n  rt-controller run --config config/sim.toml\n  rt-controller run --config config/cell.toml\n\n\
Stops upright on Ctrl-C or SIGTERM.")]
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
        let _ = writeln!(std::io::stderr(), "rt-controller: a defect, please report it: {panic}");
        std::process::abort();
    }));
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        // Armed by the first signal, so that only a second one ends the process at once.
        let second = signal_hook::flag::register_conditional_shutdown(signal, exit::INTERRUPTED.into(), Arc::clone(&stop));
        let first = signal_hook::flag::register(signal, Arc::clone(&stop));
        second.and(first).map_err(|e| format!("cannot handle signals: {e}")).or_exit(exit::FAILED)?;
    }

    // First of all, so that what is made from here on is in memory before the loop starts.
    if let Err(line) = shared::os::lock_memory() {
        say(&line);
    }
    let _awake = shared::os::stay_awake().map_err(|line| say(&line));
    let exchange = Exchange::default();
    let (note, connections, refused) = (RobotNote::default(), AtomicU64::new(0), Mutex::default());
    let outcome = std::thread::scope(|scope| {
        let cell = Cell::join(&config.cell.name)?;
        let (disk, journal) = Disk::open(&config, &exchange, &refused, &say);
        let service = Service::open(&cell, &exchange, (&note, &connections), (&refused, journal), &say)?;
        let (ready_sender, ready) = std::sync::mpsc::channel();
        let loop_thread = std::thread::Builder::new().name("loop".into()).stack_size(STACK);
        let spawned = loop_thread.spawn_scoped(scope, {
            let (config, exchange, say) = (&config, &exchange, &say);
            move || real_time(config, exchange, say, &ready_sender)
        });
        spawned.map_err(no_thread)?;
        ready.recv().unwrap_or(Ok(()))?;
        let end = AtomicBool::new(false);
        std::thread::scope(|inner| {
            let robot_thread = std::thread::Builder::new().name("robot".into()).stack_size(STACK);
            let spawned =
                robot_thread.spawn_scoped(inner, || service::keep_robot_connected(&config, &exchange, &note, &connections, &end, &say));
            let disk_thread = std::thread::Builder::new().name("disk".into()).stack_size(STACK);
            let spawned = spawned.and(disk_thread.spawn_scoped(inner, || disk.run(&end)));
            say(&format!("running in cell '{}' at {} Hz", config.cell.name, config.controller.rate_hz));
            // Without these threads there is no robot and no policy: the loop ends at once.
            stop.fetch_or(spawned.is_err(), Relaxed);
            service.run(&stop);
            end.store(true, Relaxed);
            spawned.map(|_| ()).map_err(no_thread)
        })
    });
    outcome.or_exit(exit::FAILED)?;
    say("stopped");
    Ok(())
}

/// The real-time thread: its own node and subscriber, then the loop.
fn real_time(config: &Config, exchange: &Exchange, say: &dyn Fn(&str), ready: &std::sync::mpsc::Sender<Result<(), IpcError>>) {
    let opened = Cell::join(&config.cell.name).and_then(|cell| {
        let subscriber = cell.features()?.subscriber_builder().buffer_size(crate::core::MAX_FEATURES).create();
        let subscriber = subscriber.map_err(|e| IpcError::Service { service: "feature".into(), what: format!("{e:?}") })?;
        Ok((cell, subscriber))
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
