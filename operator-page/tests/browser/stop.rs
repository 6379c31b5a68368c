//! Stop, by the button and by the space bar, in the middle of a pour: how long it takes until the robot moves slower.

use std::io::{Read as _, Write as _};
use std::net::{IpAddr, TcpStream};
use std::sync::mpsc::{Receiver, channel};
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use shared::os::now_ns;
use tests::browser::Browser;
use tests::{CellUnderTest, steady_weights};

use super::{LIVE, Page, SOON, picture, says};

/// The action with which the steady weights tilt out: 0.2 degrees in a frame, so that a pour lasts long beside other tests.
const TILT_OUT: usize = 12;
/// Index of wrist 3 in the robot's vectors.
const TILT_JOINT: usize = 5;

/// One packet of RTDE (protocol 2).
fn packet(kind: u8, body: &[u8]) -> Vec<u8> {
    let size = u16::try_from(body.len() + 3).expect("short");
    [&size.to_be_bytes(), &[kind][..], body].concat()
}

/// Follows the tilting joint's speed in each of the robot's cycles: when it arrived, CLOCK_MONOTONIC ns, and the speed, rad/s.
fn speeds(address: IpAddr) -> Receiver<(u64, f64)> {
    let mut stream = TcpStream::connect((address, 30004)).expect("the robot listens");
    stream.write_all(&packet(86, &2u16.to_be_bytes())).expect("it reads");
    stream.write_all(&packet(79, &[&125f64.to_be_bytes()[..], b"actual_qd"].concat())).expect("it reads");
    stream.write_all(&packet(83, &[])).expect("it reads");
    let (sender, receiver) = channel();
    std::thread::spawn(move || {
        let mut head = [0; 3];
        while stream.read_exact(&mut head).is_ok() {
            let mut body = vec![0; usize::from(u16::from_be_bytes([head[0], head[1]])) - 3];
            if stream.read_exact(&mut body).is_err() {
                return;
            }
            let at = 1 + TILT_JOINT * 8;
            if head[2] == 85 && body.len() >= at + 8 {
                let speed = f64::from_be_bytes(body[at..at + 8].try_into().expect("8 bytes"));
                if sender.send((now_ns(), speed)).is_err() {
                    return;
                }
            }
        }
    });
    receiver
}

/// From a moment of the browser, ms since 1970, to the first of the robot's cycles in which the joint is slower than in any of the last 0.3 s
/// before, by a tenth at least.
fn delay(clicked_ms: f64, speeds: &Receiver<(u64, f64)>) -> Duration {
    let wall_ms = SystemTime::now().duration_since(UNIX_EPOCH).expect("after 1970").as_secs_f64() * 1e3;
    let clicked_ns = now_ns() as f64 - (wall_ms - clicked_ms) * 1e6;
    let seen: Vec<(u64, f64)> = speeds.try_iter().collect();
    let before = seen.iter().filter(|(at, _)| (clicked_ns - 0.3e9..clicked_ns).contains(&(*at as f64)));
    let slowest = before.map(|(_, speed)| *speed).fold(f64::INFINITY, f64::min);
    assert!(slowest.is_finite(), "the robot is watched");
    let limit = slowest - 0.1 * slowest.abs();
    let slower = seen.iter().find(|(at, speed)| *at as f64 > clicked_ns && *speed < limit).expect("the joint is slower in the end");
    Duration::from_nanos((slower.0 as f64 - clicked_ns) as u64)
}

/// Number of pictures that the page has drawn.
fn frames(browser: &Browser) -> f64 {
    browser.run("return Number(document.getElementById('camera').dataset.frames)").as_f64().expect("a number")
}

/// Protects whoever stands beside the robot: a click and the space bar stop a pour, also while 100 half-open connections and a request
/// without end are there. How long it takes from the click until the robot moves slower is printed (`--show-output`), and not judged.
#[test]
fn stop_stops_by_click_and_by_space_bar() {
    let Some(browser) = Browser::open(1280, 1000) else { return };
    let cell = CellUnderTest::start(|_| {});
    cell.take_weights(&steady_weights(TILT_OUT));
    let page = Page::open(&cell);
    browser.go(&page.url());
    browser.wait("the live picture", SOON, LIVE);
    browser.run("for (const kind of ['pointerdown', 'keydown']) addEventListener(kind, e => { window.pressedAt = performance.timeOrigin + e.timeStamp; }, true)");
    let speeds = speeds(cell.address);
    let (shown, since) = (frames(&browser), Instant::now());
    let rounds = std::env::var("DECANT_STOPS").ok().and_then(|n| n.parse().ok()).unwrap_or(4);
    let mut delays = Vec::new();
    let mut attack = Vec::new();
    for round in 0..rounds {
        cell.json("simulator", &["operator", "fill", "300", "--json"]);
        cell.wait_idle();
        says(&browser, "Ready to pour");
        browser.fill("#goal", "200");
        browser.click("#foresee");
        browser.wait("what is foreseen", SOON, "return !document.getElementById('confirm').hidden");
        browser.click("#go");
        says(&browser, "Pouring 200 ml");
        if round == 2 {
            attack = (0..100).map(|_| std::net::TcpStream::connect(&page.address).expect("it listens")).collect();
            for stream in &mut attack {
                let _ = stream.write_all(b"POST /api/pour HTTP/1.1\r\nHost: ");
            }
        }
        let tilted = "const p = points[points.length - 1]; return p[MEASURED] > 20 && p[MEASURED] < 70";
        browser.wait("the tilt", SOON, tilted);
        // The focus lies on the button that pours: the space bar must not press it.
        if round % 2 == 0 {
            browser.click("#stop");
        } else {
            browser.press(&[" "]);
        }
        browser.wait("the answer", SOON, "return document.getElementById('stop-said').textContent.startsWith('Stop: ')");
        if round == 0 {
            browser.screenshot(&picture("stopped"));
        }
        let said = browser.text("#stop-said");
        let ended = cell.wait("the end", Duration::from_secs(10), |s| s["phase"] == "idle");
        let outcomes = ended["outcomes"].as_array().expect("a list");
        assert_eq!(outcomes[outcomes.len() - 1]["reason"], "aborted", "round {round}");
        let pressed = browser.run("return window.pressedAt").as_f64().expect("a time");
        let took = delay(pressed, &speeds);
        println!(
            "round {round}, {}: {took:?} from the click to the robot's first slower cycle; {said}",
            if round % 2 == 0 { "button" } else { "space bar" }
        );
        delays.push(took);
    }
    drop(attack);
    println!("{:.1} pictures a second were shown", (frames(&browser) - shown) / since.elapsed().as_secs_f64());
    delays.sort();
    println!(
        "p50 {:?}, p95 {:?} of {} stops",
        delays[delays.len() / 2],
        delays[(delays.len() * 95 / 100).min(delays.len() - 1)],
        delays.len()
    );
    assert!(cell.json("simulator", &["operator", "scale", "--json"])["weight_g"].as_f64() < Some(200.0));
}
