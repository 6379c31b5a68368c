//! `simulator ur`: runs only the simulated UR5 controller, for trying a client or a robot program.
//!
//! The main thread takes faults from standard input and prints the controller's log; the controller has a thread of its own.
//! It allocates. The command ends with Ctrl-C or SIGTERM, or after `--seconds`; a controller that cannot be started is an error.

use std::io::{BufRead, Write};
use std::net::{IpAddr, Ipv4Addr};
use std::sync::atomic::Ordering;
use std::sync::mpsc;
use std::time::{Duration, Instant};

use shared::exit::{self, Failure, OrExit as _, failure};
use shared::os;

use crate::ur::{Controller, ControllerOptions, Fault, LogKind, LogLine, Series, fault};

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(after_help = help())]
pub struct Args {
    /// Loopback address to listen on; each controller needs its own.
    #[arg(long, default_value_t = IpAddr::V4(Ipv4Addr::LOCALHOST))]
    address: IpAddr,
    /// Controller generation: CB3 3.15 at 125 Hz or e-Series 5.11 at 500 Hz.
    #[arg(long, value_enum, default_value = "cb3")]
    series: SeriesArg,
    /// Joint angles at the start in degrees, from the base to wrist 3.
    #[arg(long, value_delimiter = ',', num_args = 1..=6, allow_negative_numbers = true, default_value = "0,-90,90,-90,-90,0")]
    joints_deg: Vec<f64>,
    /// Fault to inject at the start; this option may be given several times.
    #[arg(long)]
    fault: Vec<Fault>,
    /// End after this many seconds.
    #[arg(long, value_parser = parse_seconds)]
    seconds: Option<f64>,
    /// Print the controller's log as JSON, one object a line.
    #[arg(long)]
    json: bool,
}

#[derive(Debug, Clone, Copy, clap::ValueEnum)]
enum SeriesArg {
    Cb3,
    #[value(alias = "e")]
    ESeries,
}

fn help() -> String {
    format!(
        "Examples:\n  simulator ur\n  simulator ur --address 127.0.0.2 --series e-series\n  simulator ur --fault in-use=input_int_register_24\n\n\
         While it runs, each line on standard input is a fault:\n{}\n\n{}",
        fault::HELP,
        exit::HELP
    )
}

fn parse_seconds(text: &str) -> Result<f64, String> {
    text.parse().ok().filter(|s: &f64| s.is_finite() && *s >= 0.0).ok_or_else(|| "give a number of seconds, 0 or more".into())
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    let mut options = ControllerOptions::new(args.address);
    options.series = match args.series {
        SeriesArg::Cb3 => Series::Cb3,
        SeriesArg::ESeries => Series::ESeries,
    };
    if args.joints_deg.len() != options.start_q_rad.len() {
        return Err(failure(exit::BAD_INPUT, format!("--joints-deg: six angles are needed, not {}", args.joints_deg.len())));
    }
    for (to, from) in options.start_q_rad.iter_mut().zip(&args.joints_deg) {
        if !(-360.0..=360.0).contains(from) {
            return Err(failure(exit::BAD_INPUT, format!("--joints-deg: {from} is outside -360 to 360")));
        }
        *to = from.to_radians();
    }
    let stop = os::stop_at_signals().or_exit(exit::FAILED)?;
    let controller = Controller::start(options).or_exit(exit::FAILED)?;
    args.fault.iter().for_each(|f| controller.inject(f.clone()));
    if !args.json {
        println!("UR5 controller ({:?}) on {}: ports 29999, 30001 to 30004; lines on standard input are faults", args.series, args.address);
    }
    let (lines, typed) = mpsc::channel();
    // This thread blocks while it reads, and ends with the process.
    std::thread::spawn(move || std::io::stdin().lock().lines().map_while(Result::ok).try_for_each(|line| lines.send(line)));
    let start = Instant::now();
    while !stop.load(Ordering::Relaxed) {
        if args.seconds.is_some_and(|s| start.elapsed().as_secs_f64() >= s) {
            return Ok(());
        }
        for line in typed.try_iter().filter(|l| !l.trim().is_empty()) {
            match line.parse::<Fault>() {
                Ok(fault) => controller.inject(fault),
                Err(error) => eprintln!("error: {error}"),
            }
        }
        if controller.take_log().iter().try_for_each(|l| print(l, args.json)).is_err() {
            break; // Whoever read the log is gone.
        }
        std::thread::sleep(Duration::from_millis(50));
    }
    Err(failure(exit::INTERRUPTED, "interrupted"))
}

fn print(line: &LogLine, json: bool) -> std::io::Result<()> {
    let mut out = std::io::stdout();
    let kind = match line.kind {
        LogKind::Text => "textmsg",
        LogKind::ProgramError => "program error",
        LogKind::Event => "event",
    };
    if json {
        writeln!(out, "{}", serde_json::json!({ "timestamp_s": line.timestamp_s, "kind": kind, "text": line.text }))
    } else {
        writeln!(out, "{:10.3} {kind}: {}", line.timestamp_s, line.text)
    }
}
