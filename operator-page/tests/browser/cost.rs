//! What the page costs the loop and the worker: measured in turns, without it and with it open three times. It is printed, and not judged.

use std::io::{Read as _, Write as _};
use std::net::TcpStream;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rt_controller::journal;
use shared::os::now_ns;
use tests::CellUnderTest;

use super::Page;

/// Does what one open page does: it takes the stream of states, and a picture more than ten times a second. Gives the bytes that it got.
fn look(address: &str, stop: &AtomicBool) -> usize {
    let connect = |path: &str| {
        let mut stream = TcpStream::connect(address).expect("it listens");
        stream.set_read_timeout(Some(Duration::from_millis(500))).expect("a socket");
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {address}\r\n\r\n").expect("it reads");
        stream
    };
    let mut events = connect("/events");
    let mut pictures = connect("/picture.jpg");
    let (mut got, mut buffer) = (0, vec![0; 1 << 20]);
    while !stop.load(Ordering::Relaxed) {
        got += events.read(&mut buffer).unwrap_or(0);
        got += pictures.read(&mut buffer).unwrap_or(0);
        write!(pictures, "GET /picture.jpg HTTP/1.1\r\nHost: {address}\r\n\r\n").expect("it reads");
        std::thread::sleep(Duration::from_millis(70));
    }
    got
}

/// Protects the loop from people who look: three open pages get states and pictures while loop and worker work. How late both are without and with
/// them is printed (`--show-output`).
#[test]
fn three_open_pages_beside_the_loop() {
    let mut cell = CellUnderTest::start(|_| {});
    let mut rounds = Vec::new();
    for _ in 0..2 {
        for open in [false, true] {
            let page = open.then(|| Page::open(&cell));
            let stop = Arc::new(AtomicBool::new(false));
            let browsers: Vec<_> = (0..3)
                .filter_map(|_| {
                    let (address, stop) = (page.as_ref()?.address.clone(), Arc::clone(&stop));
                    Some(std::thread::spawn(move || look(&address, &stop)))
                })
                .collect();
            std::thread::sleep(Duration::from_secs(1));
            let from_ns = now_ns();
            std::thread::sleep(Duration::from_secs(3));
            rounds.push((open, from_ns..now_ns()));
            stop.store(true, Ordering::Relaxed);
            for browser in browsers {
                let got = browser.join().expect("it looks");
                assert!(got > 200_000, "{got} bytes of states and pictures");
            }
        }
    }
    assert_eq!(cell.stop("rt-controller"), Some(0));
    let (mut late, mut worked) = (Vec::new(), Vec::new());
    journal::replay(&cell.dir.path().join("journal.bin"), |tick, _| {
        late.push((tick.now_ns, tick.now_ns.saturating_sub(tick.times.deadline_ns)));
        worked.extend(tick.features.iter().map(|f| (f.received_at_ns, f.published_at_ns - f.received_at_ns)));
    })
    .expect("a journal");
    for (name, values) in [("lateness of the loop", late), ("the worker's time for a frame", worked)] {
        let mut medians = Vec::new();
        for (open, times) in &rounds {
            let mut of_round: Vec<f64> = values.iter().filter(|(at, _)| times.contains(at)).map(|(_, ns)| *ns as f64 / 1e3).collect();
            of_round.sort_by(f64::total_cmp);
            assert!(of_round.len() > 60, "{} values", of_round.len());
            let at = |share: f64| of_round[((of_round.len() - 1) as f64 * share) as usize];
            println!(
                "{name}, {}: p50 {:.0} us, p99 {:.0} us, n {}",
                if *open { "three pages" } else { "no page" },
                at(0.5),
                at(0.99),
                of_round.len()
            );
            medians.push((at(0.5), at(0.99)));
        }
        for pair in medians.chunks(2) {
            println!("{name}, open / closed: p50 {:.2}, p99 {:.2}", pair[1].0 / pair[0].0, pair[1].1 / pair[0].1);
        }
    }
}
