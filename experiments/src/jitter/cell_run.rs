//! One run of the cell: first at rest, then pouring. Ordinary thread; allocates and blocks.

use std::time::{Duration, Instant};

use rt_controller::client::{Client, ClientError};
use shared::os::now_ns;

use super::machine_log::MachineLog;
use super::processes::{Holding, processor_ns};
use super::storm::{ROBOT, Storm};
use super::tick_times::TickTimes;
use crate::own_cell::{OwnCell, OwnCellError};

/// Time that a pour takes at most, with filling: a pour begins only when so much is left. Chosen by hand; no measurement is recorded.
const A_POUR: Duration = Duration::from_secs(12);

/// Time before anything is measured: the loop has found its phase behind the camera (4 s, `rt_controller::pacing`), and what starting
/// costs is over.
const SETTLING: Duration = Duration::from_secs(6);

/// Pours until `until`, one pour after the other, each into an empty cup, and at least one. Returns their number.
///
/// # Errors
/// When an operator's command fails; a pour that ends early is none.
pub fn pour_until(cell: &OwnCell, until: Instant) -> Result<u32, OwnCellError> {
    let mut pours = 0;
    while Instant::now() + A_POUR < until || pours == 0 {
        cell.command("simulator", &["operator", "fill", "300"])?;
        // A pour that ends early, for instance after a pause of the machine, is a result: the ticks around it are what is looked for.
        match cell.command("rt-controller", &["pour", "--json", "60"]) {
            Ok(_) => {}
            Err(e @ OwnCellError::Step { .. }) => cell.note(&format!("a pour ended early: {e}")),
            Err(e) => return Err(e),
        }
        pours += 1;
    }
    sleep_until(cell, until)?;
    Ok(pours)
}

/// Sleeps until `until`.
///
/// # Errors
/// At once when Ctrl-C is pressed.
pub fn sleep_until(cell: &OwnCell, until: Instant) -> Result<(), OwnCellError> {
    while Instant::now() < until {
        cell.interrupted()?;
        std::thread::sleep(Duration::from_millis(50));
    }
    Ok(())
}

/// What was measured in one run of the cell.
pub struct CellRun {
    /// The ticks.
    pub ticks: TickTimes,
    /// Share of a core that the controller took at rest, per cent.
    pub idle_percent: f64,
    /// What the controller held at the end.
    pub controller: Holding,
    /// What the feature worker held at the end.
    pub worker: Holding,
    /// Number of allocations in the loop.
    pub allocations: u64,
    /// Number of page faults in the loop.
    pub page_faults: u64,
}

/// Runs the cell for `seconds`: a third of it at rest, then pouring; with `storm`, all the time while other programs do to it what they can.
///
/// # Errors
/// When the cell does not start, a command fails, or the journal cannot be read.
pub fn run_cell(cell: &mut OwnCell, seconds: u64, storm: bool) -> Result<CellRun, OwnCellError> {
    let whole = Duration::from_secs(seconds);
    Ok(run_cell_beside(cell, (whole / 3, whole), storm, |_| Ok(()))?.0)
}

/// Runs the cell for a time at rest and until a time pouring; meanwhile another thread does `beside`, once the pours begin.
///
/// # Errors
/// As [`run_cell`], and those of `beside`.
pub fn run_cell_beside<T: Send>(
    cell: &mut OwnCell,
    (rest, whole): (Duration, Duration),
    storm: bool,
    beside: impl FnOnce(&OwnCell) -> Result<T, OwnCellError> + Send,
) -> Result<(CellRun, T), OwnCellError> {
    cell.simulate(storm.then(|| (ROBOT.0, ROBOT.1.into())))?;
    let client = cell.start()?;
    let unreachable = |e: ClientError| OwnCellError::Other(e.to_string());
    let before = client.status().map_err(unreachable)?;
    drop(client);
    let storm = if storm { Some(Storm::start(cell)?) } else { None };
    sleep_until(cell, Instant::now() + SETTLING)?;
    let (from_ns, from) = (now_ns(), Instant::now());
    let pid = cell.pid("rt-controller");
    let log = MachineLog::start(pid);
    let spent_ns = processor_ns(pid);
    sleep_until(cell, from + rest)?;
    let idle_percent = 100.0 * (processor_ns(pid) - spent_ns) as f64 / from.elapsed().as_nanos() as f64;
    let running = &*cell;
    let beside = std::thread::scope(|scope| {
        let beside = scope.spawn(|| beside(running));
        pour_until(running, from + whole)?;
        beside.join().unwrap_or_else(|_| Err(OwnCellError::Other("the yardsticks beside the cell stopped".into())))
    })?;
    let to_ns = now_ns();
    let (controller, worker) = (Holding::of(pid), Holding::of(cell.pid("feature-worker")));
    drop(storm);
    let client = Client::connect(&cell.config.cell).map_err(unreachable)?;
    let after = client.status().map_err(unreachable)?;
    drop(client);
    cell.stop();
    let mut ticks = TickTimes::read(cell, from_ns, to_ns)?;
    let times_ns: Vec<u64> = ticks.worst.iter().map(|w| w.woke_at_ns).collect();
    for (worst, activity) in ticks.worst.iter_mut().zip(log.around(&times_ns)) {
        worst.activity = activity;
    }
    let run = CellRun {
        ticks,
        idle_percent,
        controller,
        worker,
        allocations: after.loop_allocations - before.loop_allocations,
        page_faults: after.loop_page_faults - before.loop_page_faults,
    };
    Ok((run, beside))
}
