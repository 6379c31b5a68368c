//! What reads bytes that others made: weight files, configurations, tables, episodes, journals, messages and HTTP. Each function takes any
//! bytes, and nothing but its own return is right: no panic, no large allocation, no waiting.
//!
//! The coverage-guided targets in fuzz/ call these functions, and so does an ordinary test with the inputs that were found before and with
//! mutations of whole files (tests/tests/parsers.rs). They run in the caller's thread and allocate; a file that cannot be written panics.

use std::io::{Read as _, Write as _};
use std::net::{IpAddr, Ipv4Addr, SocketAddr, TcpStream};
use std::path::PathBuf;
use std::sync::OnceLock;
use std::sync::atomic::AtomicBool;
use std::time::Duration;

use rt_controller::journal::{MAGIC, replay_from};
use rt_controller::stop::StopAnswer;
use shared::config::Config;
use shared::control::{Reply, Request};
use shared::episode::{Episode, EpisodeImages, read_table};
use shared::messages::{Doubt, Phase, RecorderState};
use shared::weights::{FORMAT_VERSION, Weights};

/// How long the page's server may take. Chosen by hand: it waits at most 5 s for the rest of a request (web/src/server.rs).
const HTTP_ANSWER: Duration = Duration::from_secs(20);
/// Longest answer that is read, bytes. Chosen by hand: above all that the server here says.
const ANSWER_MAX: u64 = 1 << 20;

/// A parser under test.
pub type Parser = fn(&[u8]);

/// All of them, by the names of their targets in fuzz/.
pub const ALL: [(&str, Parser); 7] = [
    ("weights", weights),
    ("configuration", configuration),
    ("csv", csv),
    ("mcap", mcap),
    ("journal", journal),
    ("control", control),
    ("http", http),
];

/// A file of this process in memory that holds `bytes`.
fn file(name: &str, bytes: &[u8]) -> PathBuf {
    let path = PathBuf::from(format!("/dev/shm/decant-parser-{}-{:?}-{name}", std::process::id(), std::thread::current().id()));
    std::fs::write(&path, bytes).unwrap_or_else(|e| panic!("{}: {e}", path.display()));
    path
}

/// A weight file. Weights that are taken give an agent, and the same bytes again.
pub fn weights(bytes: &[u8]) {
    whole_weights(bytes);
    whole_weights(&with_checksum(bytes));
}

fn whole_weights(bytes: &[u8]) {
    if let Ok(weights) = Weights::from_bytes(bytes, "w") {
        let again = weights.to_bytes().map(|b| Weights::from_bytes(&b, "w").map(|w| w.id()));
        assert!(matches!(again, Ok(Ok(id)) if id == weights.id()), "weights that are read can be written");
        let _ = shared::agent::Agent::new(&weights);
    }
}

/// The offset of a weight file's contents, which a checksum covers (shared/src/weights.rs).
const WEIGHTS_HEADER: usize = 24;

/// `bytes` as a weight file whose version, length and checksum are right, so that what is behind them is reached too.
fn with_checksum(bytes: &[u8]) -> Vec<u8> {
    let mut bytes = bytes.to_vec();
    if bytes.len() >= WEIGHTS_HEADER + 4 {
        bytes[8..12].copy_from_slice(&FORMAT_VERSION.to_le_bytes());
        let payload = (bytes.len() - WEIGHTS_HEADER) as u32;
        bytes[20..24].copy_from_slice(&payload.to_le_bytes());
        let end = bytes.len() - 4;
        let sum = crc::Crc::<u32>::new(&crc::CRC_32_ISO_HDLC).checksum(&bytes[WEIGHTS_HEADER..end]);
        bytes[end..].copy_from_slice(&sum.to_le_bytes());
    }
    bytes
}

/// A configuration. What is accepted gives settings for the core that can be.
pub fn configuration(bytes: &[u8]) {
    if let Ok(config) = Config::parse(&String::from_utf8_lossy(bytes), "c.toml") {
        assert!(rt_controller::core::Settings::new(&config).are_plausible(), "what a configuration accepts, the core takes");
    }
}

/// The two tables of other people's measurements, one after the other with an empty line between them.
pub fn csv(bytes: &[u8]) {
    let at = bytes.windows(2).position(|w| w == b"\n\n").map_or(bytes.len(), |k| k + 1);
    let (features, scale) = (file("f.csv", &bytes[..at]), file("s.csv", bytes.get(at + 1..).unwrap_or_default()));
    let _ = read_table(&features, &scale);
    let _ = (std::fs::remove_file(features), std::fs::remove_file(scale));
}

/// An episode, its rows and its pictures.
pub fn mcap(bytes: &[u8]) {
    let path = file("e.mcap", bytes);
    let _ = Episode::read(&path);
    if let Ok(images) = EpisodeImages::open(&path) {
        // Each picture is handed out; no more than a file has bytes for.
        assert!(images.take(bytes.len() + 1).filter_map(Result::ok).count() <= bytes.len());
    }
    let _ = std::fs::remove_file(path);
}

/// A journal, and what it would be if it were of today's version.
pub fn journal(bytes: &[u8]) {
    let _ = replay_from(bytes, "j", |_, _| {});
    if bytes.len() > MAGIC.len() && !bytes.starts_with(MAGIC) {
        let _ = replay_from(&[MAGIC, &bytes[MAGIC.len()..]].concat()[..], "j", |_, _| {});
    }
}

/// What processes tell each other: requests, replies, the stop socket's answer, and the codes in shared memory.
pub fn control(bytes: &[u8]) {
    let _ = postcard::from_bytes::<Request>(bytes);
    if let Ok(reply) = postcard::from_bytes::<Reply>(bytes) {
        let _ = serde_json::to_string(&reply);
    }
    if let Ok(answer) = serde_json::from_slice::<StopAnswer>(bytes) {
        let _ = serde_json::to_string(&answer);
    }
    for code in bytes.chunks_exact(4).map(|c| u32::from_le_bytes([c[0], c[1], c[2], c[3]])) {
        let words = Doubt::from_code(code).words();
        assert!(!words.is_empty() || Doubt::from_code(code) == Doubt::None);
        let _ = (Phase::from_code(code), RecorderState::from_code(code));
    }
}

/// Where one server for all inputs listens. It answers with the request's own words.
fn server() -> SocketAddr {
    static SERVER: OnceLock<SocketAddr> = OnceLock::new();
    *SERVER.get_or_init(|| {
        let open = web::Server::open(IpAddr::V4(Ipv4Addr::LOCALHOST), 0, web::Settings::default());
        let server = open.unwrap_or_else(|e| panic!("no server: {}", e.what));
        let address = server.address();
        let answer =
            |request: &web::Request| web::Answer::text(format!("{:?} {:?}", request.parameter("x"), request.json::<serde_json::Value>()));
        std::thread::spawn(move || server.serve(&AtomicBool::new(false), answer));
        address
    })
}

/// What a browser, or anybody, sends to a page: the server answers in its own protocol, or ends the connection, and soon.
pub fn http(bytes: &[u8]) {
    let mut stream = TcpStream::connect(server()).unwrap_or_else(|e| panic!("the server takes no connection any more: {e}"));
    let _ = stream.set_read_timeout(Some(HTTP_ANSWER));
    let _ = stream.write_all(bytes).and_then(|()| stream.shutdown(std::net::Shutdown::Write));
    let mut answer = Vec::new();
    let ended = stream.take(ANSWER_MAX).read_to_end(&mut answer);
    assert!(answer.is_empty() || answer.starts_with(b"HTTP/1."), "the server answers in its own protocol");
    let waits = ended.is_err_and(|e| matches!(e.kind(), std::io::ErrorKind::WouldBlock | std::io::ErrorKind::TimedOut));
    assert!(!waits, "the server leaves a connection open whose other side has ended");
}
