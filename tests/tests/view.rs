//! `feature-worker view` beside the worker, in a running cell of real processes.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::Child;
use std::time::{Duration, Instant};

use rt_controller::journal;
use shared::os::now_ns;
use tests::CellUnderTest;

/// The view's process and the address that it printed.
struct View {
    process: Child,
    address: String,
}

impl View {
    fn open(cell: &CellUnderTest) -> Self {
        let mut process = cell.begin("feature-worker", &["view", "--port", "0"]);
        let mut line = String::new();
        BufReader::new(process.stdout.take().expect("piped")).read_line(&mut line).expect("it says where");
        let address = line.trim().strip_prefix("http://").expect("an address").to_owned();
        Self { process, address }
    }

    fn get(&self, path: &str) -> Vec<u8> {
        let mut stream = TcpStream::connect(&self.address).expect("it listens");
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {}\r\nConnection: close\r\n\r\n", self.address).expect("it reads");
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).expect("it answers");
        let body = answer.windows(4).position(|w| w == b"\r\n\r\n").expect("a header") + 4;
        answer.split_off(body)
    }

    /// Does what the view's page does: it asks for state and picture, 15 times a second. Gives the frames that were shown.
    fn look(&self, until: Instant) -> Vec<u64> {
        let mut seen = Vec::new();
        while Instant::now() < until {
            let state: serde_json::Value = serde_json::from_slice(&self.get("/state.json")).expect("JSON");
            let picture = self.get("/picture.jpg");
            if let Some(sequence) = state["sequence"].as_u64().filter(|s| *s > 0) {
                assert!(picture.starts_with(&[0xff, 0xd8]), "a JPEG of {} bytes", picture.len());
                seen.push(sequence);
            }
            std::thread::sleep(Duration::from_millis(66));
        }
        seen
    }
}

impl Drop for View {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

/// Protects a pour that people watch: the page shows the live picture while the worker works, and both see the same frames. What the view
/// costs the worker is printed (`--show-output`), measured in turns without and with it.
#[test]
fn the_view_shows_what_the_worker_measures() {
    let mut cell = CellUnderTest::start(|_| {});
    let mut rounds = Vec::new();
    let mut shown = Vec::new();
    for _ in 0..2 {
        for with_view in [false, true] {
            let view = with_view.then(|| View::open(&cell));
            std::thread::sleep(Duration::from_secs(1));
            let (from_ns, until) = (now_ns(), Instant::now() + Duration::from_secs(4));
            match &view {
                Some(view) => shown.extend(view.look(until)),
                None => std::thread::sleep(until - Instant::now()),
            }
            rounds.push((with_view, from_ns..now_ns()));
        }
    }
    assert_eq!(cell.stop("rt-controller"), Some(0));
    let mut features = Vec::new();
    journal::replay(&cell.dir.path().join("journal.bin"), |tick, _| features.extend(tick.features.iter().copied())).expect("a journal");
    let us = |from_ns: u64, to_ns: u64| (to_ns - from_ns) as f64 / 1e3;
    for (name, worked) in [("V_e after the frame was received", true), ("V_e after the exposure", false)] {
        let mut medians = Vec::new();
        for (with_view, times) in &rounds {
            let of_round = features.iter().filter(|f| times.contains(&f.received_at_ns));
            let mut took: Vec<f64> =
                of_round.map(|f| us(if worked { f.received_at_ns } else { f.captured_at_ns }, f.published_at_ns)).collect();
            took.sort_by(f64::total_cmp);
            assert!(!took.is_empty(), "the worker works");
            let at = |share: f64| took[((took.len() - 1) as f64 * share) as usize];
            println!(
                "{name}, view {}: p50 {:.0} us, p99 {:.0} us, n {}",
                if *with_view { "open" } else { "closed" },
                at(0.5),
                at(0.99),
                took.len()
            );
            medians.push((at(0.5), at(0.99)));
        }
        for pair in medians.chunks(2) {
            println!("{name}, open / closed: p50 {:.2}, p99 {:.2}", pair[1].0 / pair[0].0, pair[1].1 / pair[0].1);
        }
    }
    shown.dedup();
    let measured = |sequence: &u64| features.iter().any(|f| f.sequence == *sequence);
    assert!(shown.len() > 20 && shown.iter().filter(|s| measured(s)).count() * 10 >= shown.len() * 9, "{} frames shown", shown.len());
}
