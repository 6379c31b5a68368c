//! What reads bytes that others made takes any bytes calmly: the inputs that fuzzing kept (fuzz/kept), and mutations of whole files. The
//! coverage-guided targets in fuzz/ call the same functions (tests/src/parsers.rs).
//!
//! `cargo test -p tests --test parsers longer -- --ignored --nocapture` mutates for PARSER_SECONDS (60) each and prints how many inputs
//! were tried; `... write_seeds -- --ignored` writes whole files into fuzz/corpus as the beginning of a fuzzing run.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]

#[path = "../../shared/examples/write_weights.rs"]
#[allow(dead_code)]
mod write_weights;

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant, UNIX_EPOCH};

use rt_controller::core::{Core, Input, Order, Robot, Settings};
use rt_controller::journal::{MAGIC, Tick, Times, Writer};
use shared::agent::Agent;
use shared::config::Config;
use shared::control::{Reply, Request};
use shared::episode::{EpisodeEnd, EpisodeKind, EpisodeStart, EpisodeWriter, FrameRow, set_weight};
use shared::gaussian_curve::Curve;
use shared::messages::{Feature, LAYOUT_VERSION, Phase, Telemetry};
use shared::weights::FORMAT_VERSION;
use tests::parsers::{ALL, Parser};

/// Address space that a parser may take beside what the process has, bytes: inputs are below 1 MB.
const MEMORY: u64 = 1 << 30;

fn root() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("..")
}

fn sim() -> Config {
    Config::read(&root().join("config/sim.toml")).unwrap()
}

/// A parser that allocates without bound ends the process instead of the machine.
fn bound_memory() {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let taken_kib = status.lines().find_map(|l| l.strip_prefix("VmSize:")).and_then(|l| l.trim().strip_suffix(" kB")).unwrap();
    let most = taken_kib.parse::<u64>().unwrap() * 1024 + MEMORY;
    let before = rustix::process::getrlimit(rustix::process::Resource::As);
    let limit = rustix::process::Rlimit { current: Some(most), maximum: before.maximum };
    rustix::process::setrlimit(rustix::process::Resource::As, limit).unwrap();
}

/// A journal of `ticks` ticks with one pour.
fn journal(ticks: u64) -> Vec<u8> {
    let settings = Settings::new(&sim());
    let weights = write_weights::constant_action(3);
    let mut bytes = Vec::new();
    let mut writer = Writer::begin(&mut bytes, &settings).unwrap();
    writer.weights(1, &weights).unwrap();
    let mut core = Core::new(settings);
    core.exchange(Box::new(Agent::new(&weights)));
    for k in 0..ticks {
        let now_ns = 1_000_000_000 + k * settings.period_ns;
        let feature = Feature {
            version: LAYOUT_VERSION,
            sequence: k,
            captured_at_ns: now_ns - 20_000_000,
            area_px2: 30.0 * k as f32,
            ..Feature::default()
        };
        let features = heapless::Vec::from_slice(&[feature]).unwrap();
        let robot = Robot::that_may_move(0.0, now_ns - 4_000_000);
        let order = (k == 2).then_some(Order::Pour { episode: 1, goal_ml: 50.0, flows_by_deg: None });
        let output = core.step(&Input { now_ns, features: &features, robot, order });
        let agent = (k == 0).then_some(1);
        let (target_deg, d_ml) = (output.target_deg, output.telemetry.d_ml);
        let tick = Tick { now_ns, features, robot, order, agent, target_deg, d_ml, times: Times::default() };
        writer.tick(Box::new(tick), &output.telemetry).unwrap();
    }
    writer.flush().unwrap();
    drop(writer);
    bytes
}

/// An episode of `frames` frames with its weight.
fn episode(frames: u64) -> Vec<u8> {
    let (dir, config) = (tempfile::tempdir().unwrap(), sim());
    let kind = EpisodeKind::Recording(Curve { lambda_deg: 60.0, gamma_per_s2: 0.3, beta_s: 4.0 });
    let wall_clock = UNIX_EPOCH + Duration::from_secs(1_795_311_559);
    let start = EpisodeStart { episode: 3, kind, started_at_ns: 1, wall_clock, config: &config, weights: "0123456789abcdef" };
    let mut writer = EpisodeWriter::create(dir.path(), &start).unwrap();
    for k in 1..=frames {
        let at_ns = k * 33_333_333;
        let feature = Feature { version: LAYOUT_VERSION, sequence: k, captured_at_ns: at_ns, area_px2: k as f32, ..Default::default() };
        let phase = Phase::Recording as u32;
        writer.telemetry(&Telemetry { version: LAYOUT_VERSION, phase, tick: k, at_ns, episode: 3, ..Default::default() }).unwrap();
        let image = Some(("jpeg", &[7u8; 20][..]));
        writer.frame(&FrameRow { feature: &feature, alpha_commanded_deg: k as f32, alpha_measured_deg: k as f32, image }).unwrap();
    }
    let path = writer.path().to_path_buf();
    writer.finish(&EpisodeEnd { complete: true, reason: "over", disordered_frames: 0 }).unwrap();
    set_weight(&path, 60.0).unwrap();
    std::fs::read(path).unwrap()
}

/// Whole inputs of the parser `name`.
fn seeds(name: &str) -> Vec<Vec<u8>> {
    let text = |t: &str| t.as_bytes().to_vec();
    let posted = |value: &Request| postcard::to_slice(value, &mut [0; 256]).unwrap().to_vec();
    match name {
        "weights" => vec![write_weights::constant_action(3).to_bytes().unwrap()],
        "configuration" => ["sim", "cell"].map(|c| std::fs::read(root().join(format!("config/{c}.toml"))).unwrap()).to_vec(),
        "csv" => vec![text(
            "episode,frame,t_s,alpha_deg,area_px2\na,1,0.0,0,0\na,2,0.033,1.5,nan\na,5,0.13,2,310.5\nb,1,0,0,1e3\n\n\
             episode,weight_g\na,61.5\nb,0.5\n",
        )],
        "mcap" => vec![episode(1), episode(20)],
        "journal" => vec![journal(12)],
        "control" => vec![
            posted(&Request::Status),
            posted(&Request::Pour { goal_ml: 75.0, flows_by_deg: Some(40.0) }),
            posted(&Request::Record(Curve { lambda_deg: 60.0, gamma_per_s2: 0.3, beta_s: 4.0 })),
            postcard::to_slice(&Reply::Refused { reason: "no".into() }, &mut [0; 256]).unwrap().to_vec(),
            text(r#"{"pid":1,"phase":"idle","alpha_deg":null,"upright":true,"hindrance":"","refused":""}"#),
        ],
        _ => vec![
            text("GET /x?x=%41%zz&token=1 HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"),
            text(
                "POST /p HTTP/1.1\r\nHost: 127.0.0.1\r\nOrigin: http://127.0.0.1\r\nContent-Type: application/json\r\nContent-Length: 7\r\n\r\n{\"a\":1}",
            ),
            text("POST /p HTTP/1.1\r\nHost: 127.0.0.1\r\nTransfer-Encoding: chunked\r\n\r\n5\r\nabcde\r\n0\r\n\r\n"),
        ],
    }
}

/// The inputs of the parser `name` that fuzzing kept.
fn kept(name: &str) -> Vec<Vec<u8>> {
    let Ok(files) = std::fs::read_dir(root().join("fuzz/kept").join(name)) else { return Vec::new() };
    let mut paths: Vec<PathBuf> = files.map(|f| f.unwrap().path()).collect();
    paths.sort();
    paths.iter().map(|p| std::fs::read(p).unwrap()).collect()
}

/// Numbers that look drawn, the same in each run (xorshift64, Marsaglia 2003).
struct Draw(u64);

impl Draw {
    fn below(&mut self, below: usize) -> usize {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 16) as usize % below.max(1)
    }
}

/// One of `inputs` with some of its bytes changed, taken away, doubled, or replaced by a piece of another.
fn mutated((whole, inputs): (&[Vec<u8>], &[Vec<u8>]), draw: &mut Draw) -> Vec<u8> {
    // Half of them begin as whole files, which reach the deepest.
    let from = if draw.below(2) == 0 { whole } else { inputs };
    let mut bytes = from[draw.below(from.len())].clone();
    for _ in 0..=draw.below(4) {
        let at = draw.below(bytes.len());
        let end = (at + 1 + draw.below(9)).min(bytes.len());
        match draw.below(7) {
            0 if at < bytes.len() => bytes[at] ^= 1 << draw.below(8),
            1 if at < bytes.len() => bytes[at] = draw.below(256) as u8,
            2 => bytes[at..end].fill([0, 0xff, 0x7f, 0x80, b'9', b' '][draw.below(6)]),
            3 => bytes.truncate(at),
            4 => drop(bytes.drain(at..end)),
            5 => {
                let piece = bytes[at..end].to_vec();
                bytes.splice(at..at, piece.iter().copied().cycle().take(piece.len() * (1 + draw.below(8))));
            }
            _ => {
                let other = &inputs[draw.below(inputs.len())];
                let from = draw.below(other.len());
                let piece = other[from..(from + 1 + draw.below(64)).min(other.len())].to_vec();
                bytes.splice(at..end, piece);
            }
        }
    }
    bytes
}

/// Gives `parser` mutated inputs while `more` says so; how many there were. A panic in it is shown with its input.
fn mutate((name, parser): (&str, Parser), seed: u64, mut more: impl FnMut(u64) -> bool) -> u64 {
    let whole = seeds(name);
    let inputs: Vec<Vec<u8>> = whole.iter().cloned().chain(kept(name)).collect();
    let mut draw = Draw(seed);
    let mut tried = 0;
    while more(tried) {
        let bytes = mutated((&whole, &inputs), &mut draw);
        let outcome = std::panic::catch_unwind(|| parser(&bytes));
        assert!(outcome.is_ok(), "{name}, seed {seed}, input {tried}: {:?}", String::from_utf8_lossy(&bytes));
        tried += 1;
    }
    tried
}

/// Protects every program from what others send or leave on a disk: the inputs that fuzzing kept, and some hundred mutations of them and of whole
/// files, are answered or refused, in bounded memory. That whole files are accepted is what makes their mutations worth trying.
#[test]
fn any_bytes_are_taken_calmly() {
    bound_memory();
    let accepted = |what: &str, good: bool| assert!(good, "the whole {what} is accepted");
    accepted("journal", rt_controller::journal::replay_from(&journal(12)[..], "j", |_, _| {}).is_ok_and(|r| r.ticks == 12));
    accepted("configuration", Config::parse(&String::from_utf8(seeds("configuration")[0].clone()).unwrap(), "c").is_ok());
    for (name, parser) in ALL {
        let kept = kept(name);
        let begins = [("weights", &[&b"decant-w"[..], &FORMAT_VERSION.to_le_bytes()].concat()), ("journal", &MAGIC.to_vec())];
        let begins: &[u8] = begins.iter().find(|(of, _)| *of == name).map_or(&[], |(_, begins)| begins);
        let today = kept.iter().filter(|bytes| bytes.starts_with(begins)).count();
        assert!(today > kept.len() / 2, "fuzz/kept/{name} has inputs, most of today's version: fuzz it again");
        kept.iter().chain(&seeds(name)).for_each(|bytes| parser(bytes));
        let inputs = if name == "http" { 60 } else { 400 };
        assert_eq!(mutate((name, parser), 0x2545_f491_4f6c_dd1d, |n| n < inputs), inputs);
    }
}

/// A longer look, where no coverage-guided fuzzing can be had.
#[test]
#[ignore = "takes PARSER_SECONDS for each parser"]
fn longer() {
    bound_memory();
    let seconds = std::env::var("PARSER_SECONDS").map_or(60, |s| s.parse().unwrap());
    let seed = std::process::id().into();
    for (name, parser) in ALL {
        let until = Instant::now() + Duration::from_secs(seconds);
        println!("{name}: {} inputs, seed {seed}", mutate((name, parser), seed, |_| Instant::now() < until));
    }
}

/// Writes whole files as the beginning of a fuzzing run.
#[test]
#[ignore = "writes into fuzz/corpus"]
fn write_seeds() {
    for (name, _) in ALL {
        let directory = root().join("fuzz/corpus").join(name);
        std::fs::create_dir_all(&directory).unwrap();
        for (k, bytes) in seeds(name).iter().enumerate() {
            std::fs::write(directory.join(format!("seed-{k}")), bytes).unwrap();
        }
    }
}
