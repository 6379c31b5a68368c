//! Measures the time of the network's forward pass in the form that is chosen at run time. The yardstick beside it is the portable form, a
//! plain column-wise loop.
//!
//! `cargo bench -p shared` prints two tables, in nanoseconds a call. The first is of batches of both forms in turns. The second is of single
//! calls whose weights are out of the caches, as after the loop's sleep: with the loop's prefetch, and without. With `--calls N [portable]`
//! it makes N calls and prints the sum of their results, for a profiler that counts instructions.

use std::hint::black_box;
use std::io::{Read as _, Write as _};
use std::os::unix::net::UnixStream;
use std::time::Instant;

use shared::actions::ACTIONS;
use shared::agent::PREFETCH_PARTS;
use shared::mlp::{INPUTS, Mlp};
use shared::os;

/// Number of calls that are timed together, so that reading the clock does not matter. Chosen by hand; no measurement is recorded.
const BATCH: u32 = 200;
/// Number of batches of each form. Chosen by hand; no measurement is recorded.
const BATCHES: usize = 5000;
/// Number of networks that are used in turn: 76 MB, more than twice what the last level of a large server's caches holds for one core
/// complex (32 MiB). A prime, so that every stride visits all.
const NETWORKS: usize = 9973;
/// Distance of two networks that are used one after the other. Chosen by hand; no measurement is recorded.
const STRIDE: usize = 4999;

fn network() -> Mlp {
    let mut net = Mlp::ZERO;
    for (k, p) in net.parameters_mut().enumerate() {
        *p = ((k as f32 * 0.37).sin() + 0.1) * 0.3;
    }
    net
}

type Form = fn(&Mlp, &[f32; INPUTS]) -> [f32; ACTIONS];

fn batch(form: Form, net: &Mlp, calls: u32) -> f32 {
    let mut sum = 0.0;
    for k in 0..calls {
        let x = black_box([0.1 * (k % 7) as f32, 0.2, 0.3, 1.0]);
        sum += black_box(form(net, &x))[(k % 21) as usize];
    }
    sum
}

/// Times of both forms in batches, ns a call.
fn warm(net: &Mlp, forms: &[Form; 2]) -> [Vec<f64>; 2] {
    let mut times_ns = [const { Vec::new() }; 2];
    for _ in 0..BATCHES {
        for (form, times_ns) in forms.iter().zip(&mut times_ns) {
            let start = Instant::now();
            black_box(batch(*form, net, BATCH));
            times_ns.push(start.elapsed().as_nanos() as f64 / f64::from(BATCH));
        }
    }
    times_ns
}

/// Times of single calls whose weights are out of the caches, ns: the chosen form with the loop's prefetch, without it, and the portable
/// form without it. The time of reading the clock is taken off. Each call uses a network that has not been used for long, and the drain
/// of a socket lies between prefetch and call, as in the loop.
fn weights_out_of_cache(forms: &[Form; 2]) -> [Vec<f64>; 3] {
    let networks = vec![network(); NETWORKS];
    let pair = UnixStream::pair().and_then(|(a, b)| b.set_nonblocking(true).map(|()| (a, b)));
    let (mut robot, mut socket) = pair.unwrap_or_else(|e| {
        eprintln!("a pair of sockets: {e}");
        std::process::exit(1)
    });
    let mut buffer = [0; 4096];
    let clock_ns = (0..1000).map(|_| Instant::now().elapsed().as_nanos()).min().unwrap_or(0) as f64;
    let mut times_ns = [const { Vec::new() }; 3];
    for k in 0..NETWORKS {
        // A stride that shares no factor with the number of networks visits each of them once, and no prefetcher of the processor follows.
        let net = black_box(&networks[k * STRIDE % NETWORKS]);
        let kind = k % 3;
        // One packet for each part, as the loop drains them from the robot's socket.
        for part in 0..PREFETCH_PARTS {
            if kind == 0 {
                os::prefetch(net, part, PREFETCH_PARTS);
            }
            let _ = robot.write(&buffer[..124]);
            let _ = socket.read(&mut buffer);
        }
        let x = black_box([0.1 * (k % 7) as f32, 0.2, 0.3, 1.0]);
        let start = Instant::now();
        black_box(forms[usize::from(kind == 2)](net, &x));
        times_ns[kind].push((start.elapsed().as_nanos() as f64 - clock_ns).max(0.0));
    }
    times_ns
}

fn main() {
    let net = black_box(network());
    let forms: [Form; 2] = [Mlp::forward, Mlp::forward_portable];
    let words: Vec<String> = std::env::args().collect();
    if let Some(at) = words.iter().position(|w| w == "--calls") {
        let calls = words.get(at + 1).and_then(|n| n.parse().ok()).unwrap_or(1000);
        println!("{}", batch(forms[usize::from(words.iter().any(|w| w == "portable"))], &net, calls));
        return;
    }
    let read = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
    let cpu = read("/proc/cpuinfo").lines().find_map(|l| l.strip_prefix("model name").map(|m| m.trim_matches([' ', '\t', ':']).to_owned()));
    println!("{}, load {}", cpu.unwrap_or_default(), read("/proc/loadavg").trim());
    println!("MLP 4-32-32-21 forward pass, ns a call; {BATCHES} batches of {BATCH} calls, interleaved");
    table(["chosen at run time", "portable (yardstick)"], &mut warm(&net, &forms));
    println!("the same with the weights out of the caches; {} single calls each, interleaved", NETWORKS / 3);
    table(["chosen, prefetched", "chosen, not prefetched", "portable (yardstick)"], &mut weights_out_of_cache(&forms));
}

/// Prints percentiles, and the ratio of each p50 to that of the last row, the yardstick.
fn table<const N: usize>(names: [&str; N], times_ns: &mut [Vec<f64>; N]) {
    times_ns.iter_mut().for_each(|times_ns| times_ns.sort_by(f64::total_cmp));
    let at = |times_ns: &[f64], share: f64| times_ns[((times_ns.len() - 1) as f64 * share) as usize];
    println!("{:<24} {:>8} {:>8} {:>8} {:>8} {:>9}", "", "p50", "p99", "p99.9", "max", "to yardstick");
    for (name, times) in names.iter().zip(times_ns.iter()) {
        let ratio = at(times, 0.5) / at(&times_ns[N - 1], 0.5);
        let [p50, p99, p999, max] = [0.5, 0.99, 0.999, 1.0].map(|share| at(times, share));
        println!("{name:<24} {p50:>8.1} {p99:>8.1} {p999:>8.1} {max:>8.1} {ratio:>9.2}");
    }
}
