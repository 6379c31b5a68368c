//! The operator's page in a real browser, against the simulated cell: from the first fill to weights that were learned, Stop, and what may go
//! wrong on the way. Screenshots of each state are written to `out/operator-page/`.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

mod access;
mod cost;
mod path;
mod rules;
mod stop;
mod token;
mod trouble;
mod worker_pages;

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::Child;
use std::time::Duration;

use tests::CellUnderTest;
use tests::browser::Browser;

/// How long a test waits for what takes a moment.
const SOON: Duration = Duration::from_secs(15);
/// The action with which the steady weights tilt out.
const TILT_OUT: usize = 13;

/// The page's process, and where it is.
struct Page {
    process: Child,
    /// Host and port.
    address: String,
}

impl Page {
    fn open(cell: &CellUnderTest) -> Self {
        let mut process = cell.begin("operator-page", &["run", "--port", "0"]);
        let mut line = String::new();
        BufReader::new(process.stdout.take().expect("piped")).read_line(&mut line).expect("it says where");
        // What it says more is not wanted, and must not hold it up.
        let mut rest = process.stderr.take().expect("piped");
        std::thread::spawn(move || std::io::copy(&mut rest, &mut std::io::sink()));
        let address = line.trim().strip_prefix("http://").expect("an address").to_owned();
        Self { process, address }
    }

    fn url(&self) -> String {
        format!("http://{}/", self.address)
    }
}

impl Drop for Page {
    fn drop(&mut self) {
        let pid = rustix::process::Pid::from_child(&self.process);
        let _ = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
        let _ = self.process.wait();
    }
}

/// Where screenshots go.
fn picture(name: &str) -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).parent().expect("the workspace").join("out/operator-page").join(format!("{name}.png"))
}

/// Waits until the page says what the cell is doing in these words.
fn says(browser: &Browser, words: &str) {
    let script = format!("return document.getElementById('words').textContent.includes({words:?})");
    browser.wait(&format!("'{words}'"), SOON, &script);
}

/// Whether the page is greyed out.
const LOST: &str = "return document.body.classList.contains('lost') && !document.getElementById('lost').hidden";
/// Whether it is not, and shows new pictures.
const LIVE: &str = "return !document.body.classList.contains('lost') && Number(document.getElementById('camera').dataset.frames) > 3";
