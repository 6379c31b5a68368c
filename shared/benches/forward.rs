//! Measures the time of the network's forward pass in the form that is chosen at run time. The yardstick beside it is the portable form, a
//! plain column-wise loop.
//!
//! `cargo bench -p shared` times batches of both forms in turns, and prints nanoseconds a call. With `--calls N [portable]` it makes N
//! calls and prints the sum of their results, for a profiler that counts instructions.

use std::hint::black_box;
use std::time::Instant;

use shared::actions::ACTIONS;
use shared::mlp::{INPUTS, Mlp};

/// Number of calls that are timed together, so that reading the clock does not matter. Chosen by hand; no measurement is recorded.
const BATCH: u32 = 200;
/// Number of batches of each form. Chosen by hand; no measurement is recorded.
const BATCHES: usize = 5000;

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

fn main() {
    let net = black_box(network());
    let words: Vec<String> = std::env::args().collect();
    if let Some(at) = words.iter().position(|w| w == "--calls") {
        let calls = words.get(at + 1).and_then(|n| n.parse().ok()).unwrap_or(1000);
        let form: Form = if words.iter().any(|w| w == "portable") { Mlp::forward_portable } else { Mlp::forward };
        println!("{}", batch(form, &net, calls));
        return;
    }

    let forms: [(&str, Form); 2] = [("chosen at run time", Mlp::forward), ("portable (yardstick)", Mlp::forward_portable)];
    let mut times_ns = [const { Vec::new() }; 2];
    for _ in 0..BATCHES {
        for ((_, form), times_ns) in forms.iter().zip(&mut times_ns) {
            let start = Instant::now();
            black_box(batch(*form, &net, BATCH));
            times_ns.push(start.elapsed().as_nanos() as f64 / f64::from(BATCH));
        }
    }
    let read = |path: &str| std::fs::read_to_string(path).unwrap_or_default();
    let cpu = read("/proc/cpuinfo").lines().find_map(|l| l.strip_prefix("model name").map(|m| m.trim_matches([' ', '\t', ':']).to_owned()));
    println!("MLP 4-32-32-21 forward pass, ns a call; {BATCHES} batches of {BATCH} calls, interleaved");
    println!("{}, load {}", cpu.unwrap_or_default(), read("/proc/loadavg").trim());
    println!("{:<24} {:>8} {:>8} {:>8} {:>8} {:>9}", "", "p50", "p99", "p99.9", "max", "to yardstick");
    for times_ns in &mut times_ns {
        times_ns.sort_by(f64::total_cmp);
    }
    let at = |times_ns: &[f64], share: f64| times_ns[((times_ns.len() - 1) as f64 * share) as usize];
    for ((name, _), times) in forms.iter().zip(&times_ns) {
        let ratio = at(times, 0.5) / at(&times_ns[1], 0.5);
        println!(
            "{name:<24} {:>8.1} {:>8.1} {:>8.1} {:>8.1} {ratio:>9.2}",
            at(times, 0.5),
            at(times, 0.99),
            at(times, 0.999),
            at(times, 1.0)
        );
    }
}
