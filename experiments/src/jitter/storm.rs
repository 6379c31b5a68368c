//! Everything at once that other programs can do to a running cell: questions, refused orders, readers, and new weight files.
//!
//! Ordinary threads, which allocate and never pause longer than a millisecond, except the one that replaces the weight file. What fails in
//! them is left out: they are the weather, and not what is measured.

use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rt_controller::client::Client;
use shared::config::CellConfig;
use shared::control::Request;
use shared::ipc::Cell;
use shared::weights::Weights;

use crate::own_cell::{OwnCell, OwnCellError};

/// Number of clients that ask for the status without a pause. Chosen by hand; no measurement is recorded.
const ASKERS: usize = 3;
/// Number of readers of the telemetry: the recorder, a page in three browsers, and some more.
const READERS: usize = 10;
/// Time between two new weight files, ten a second.
const SWAP: Duration = Duration::from_millis(100);

/// The threads, until it is dropped.
pub struct Storm {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Storm {
    /// Lets it loose on a cell that runs.
    ///
    /// # Errors
    /// When the cell's weight file cannot be read.
    pub fn start(cell: &OwnCell) -> Result<Self, OwnCellError> {
        let file = cell.out.join("weights.bin");
        let bytes = std::fs::read(&file).map_err(|error| OwnCellError::File { what: file.display().to_string(), error })?;
        let weights = Weights::from_bytes(&bytes, "weights.bin").map_err(|e| OwnCellError::Other(e.to_string()))?;
        let stop = Arc::new(AtomicBool::new(false));
        let name = &cell.config.cell;
        let mut threads = Vec::new();
        for _ in 0..ASKERS {
            threads.push(repeat(&stop, name, |client| drop(client.status())));
        }
        // An order that is always refused reaches the service thread all the same.
        threads.push(repeat(&stop, name, |client| drop(client.ask(&Request::Pour { goal_ml: -1.0, flows_by_deg: None }))));
        for _ in 0..READERS {
            let (stop, name) = (Arc::clone(&stop), name.clone());
            threads.push(std::thread::spawn(move || read_telemetry(&stop, &name)));
        }
        let told = Arc::clone(&stop);
        threads.push(std::thread::spawn(move || replace_weights(&told, &file, weights)));
        Ok(Self { stop, threads })
    }
}

impl Drop for Storm {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        self.threads.drain(..).for_each(|thread| drop(thread.join()));
    }
}

/// A thread that asks the controller something again and again.
fn repeat(stop: &Arc<AtomicBool>, name: &CellConfig, ask: fn(&Client)) -> JoinHandle<()> {
    let (stop, name) = (Arc::clone(stop), name.clone());
    std::thread::spawn(move || {
        let Ok(client) = Client::connect(&name) else { return };
        while !stop.load(Ordering::Relaxed) {
            ask(&client);
        }
    })
}

/// Reads every tick's telemetry.
fn read_telemetry(stop: &AtomicBool, name: &CellConfig) {
    let Ok(cell) = Cell::join(name) else { return };
    let Ok(reader) = cell.telemetry().map_err(drop).and_then(|topic| topic.subscriber_builder().create().map_err(drop)) else { return };
    while !stop.load(Ordering::Relaxed) {
        while let Ok(Some(_)) = reader.receive() {}
        std::thread::sleep(Duration::from_millis(1));
    }
}

/// Replaces the weight file by one that pours alike and is another.
fn replace_weights(stop: &AtomicBool, file: &std::path::Path, mut weights: Weights) {
    let next = file.with_extension("next");
    while !stop.load(Ordering::Relaxed) {
        weights.seed ^= 1;
        let Ok(bytes) = weights.to_bytes() else { return };
        if std::fs::write(&next, bytes).is_ok() {
            let _ = std::fs::rename(&next, file);
        }
        std::thread::sleep(SWAP);
    }
}
