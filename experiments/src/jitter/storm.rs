//! Everything at once that other programs and an unkind robot can do to a running cell: questions, refused orders, readers, browsers on the
//! operator's page, new weight files, a slow disk under the episodes, and an e-Series that sends each state twice.
//!
//! Ordinary threads, which allocate and never pause longer than a millisecond, except the one that replaces the weight file. What fails in
//! them is left out: they are the weather, and not what is measured.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::process::Stdio;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

use rt_controller::client::Client;
use shared::config::CellConfig;
use shared::control::Request;
use shared::ipc::Cell;
use shared::weights::Weights;

use super::other_programs::{Running, slow_disk};
use crate::own_cell::{OwnCell, OwnCellError};

/// Number of clients that ask for the status without a pause. Chosen by hand; no measurement is recorded.
const ASKERS: usize = 3;
/// Number of readers of the telemetry: the recorder, a page in three browsers, and some more.
const READERS: usize = 10;
/// Time between two new weight files, ten a second.
const SWAP: Duration = Duration::from_millis(100);

/// Number of browsers that look at the operator's page.
const BROWSERS: usize = 3;
/// Pause of a browser between two pictures: 15 a second, as many as the page asks for at most. The state comes by itself.
const PICTURE: Duration = Duration::from_millis(66);
/// The key of `[simulator]`, and its value, that make the robot an e-Series.
pub const ROBOT: (&str, &str) = ("series", "e-series");
/// How many states a second the robot sends in a storm: an e-Series has 500, and each comes twice.
pub const STATES_HZ: u64 = 1000;
/// How long the robot sends each state twice: longer than any run, in the words of `simulator operator fault`.
const TWICE: &str = "twice=3600";

/// The threads and programs, until it is dropped.
pub struct Storm {
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
    // They end when they are dropped, after the threads.
    _programs: [Running; 2],
}

impl Storm {
    /// Lets it loose on a cell that runs, with [`ROBOT`] as its robot.
    ///
    /// # Errors
    /// When the cell's weight file cannot be read, or a program does not start.
    pub fn start(cell: &OwnCell) -> Result<Self, OwnCellError> {
        let file = cell.out.join("weights.bin");
        let bytes = std::fs::read(&file).map_err(|error| OwnCellError::File { what: file.display().to_string(), error })?;
        let weights = Weights::from_bytes(&bytes, "weights.bin").map_err(|e| OwnCellError::Other(e.to_string()))?;
        cell.command("simulator", &["operator", "fault", TWICE])?;
        let (page, address) = open_page(cell)?;
        let programs = [slow_disk(&cell.out)?, page];
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
        for _ in 0..BROWSERS {
            let (told, site) = (Arc::clone(&stop), address.clone());
            threads.push(std::thread::spawn(move || look_at_page(&told, &site)));
            let (told, site) = (Arc::clone(&stop), address.clone());
            threads.push(std::thread::spawn(move || listen_to_page(&told, &site)));
        }
        let told = Arc::clone(&stop);
        threads.push(std::thread::spawn(move || replace_weights(&told, &file, weights)));
        Ok(Self { stop, threads, _programs: programs })
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

/// Opens the operator's page; gives its program and its address, `127.0.0.1:PORT`.
fn open_page(cell: &OwnCell) -> Result<(Running, String), OwnCellError> {
    let failed = |error| OwnCellError::File { what: "operator-page".into(), error };
    let mut child =
        cell.program("operator-page", &["run", "--port", "0"]).stdout(Stdio::piped()).stderr(Stdio::null()).spawn().map_err(failed)?;
    let output = child.stdout.take();
    let page = Running(child);
    for line in output.into_iter().flat_map(|output| BufReader::new(output).lines()) {
        if let Some((_, rest)) = line.map_err(failed)?.split_once("http://") {
            return Ok((page, rest.chars().take_while(|c| c.is_ascii_digit() || ".:".contains(*c)).collect()));
        }
    }
    Err(OwnCellError::Other("operator-page ended without an address".into()))
}

/// Asks for pictures as the page in a browser does.
fn look_at_page(stop: &AtomicBool, address: &str) {
    let mut answer = Vec::new();
    while !stop.load(Ordering::Relaxed) {
        answer.clear();
        let _ = ask_page(address, "picture.jpg").and_then(|mut page| page.read_to_end(&mut answer));
        std::thread::sleep(PICTURE);
    }
}

/// Takes the page's states as they come, as a browser does.
fn listen_to_page(stop: &AtomicBool, address: &str) {
    let mut bytes = [0; 4096];
    while !stop.load(Ordering::Relaxed) {
        let Ok(mut page) = ask_page(address, "events") else {
            std::thread::sleep(PICTURE);
            continue;
        };
        while !stop.load(Ordering::Relaxed) && page.read(&mut bytes).is_ok_and(|n| n > 0) {}
    }
}

/// Asks the page for `path`; the answer can be read from what is given.
fn ask_page(address: &str, path: &str) -> std::io::Result<TcpStream> {
    let mut page = TcpStream::connect(address)?;
    page.set_read_timeout(Some(Duration::from_secs(1)))?;
    write!(page, "GET /{path} HTTP/1.1\r\nHost: {address}\r\nConnection: close\r\n\r\n")?;
    Ok(page)
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
