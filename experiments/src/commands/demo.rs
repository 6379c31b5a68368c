//! `experiments demo`: the main job, end to end, with the real processes: record, train, swap the weights, pour, report.
//!
//! An ordinary process that does what an operator does, in a cell of its own ([`crate::own_cell`]).

use std::path::PathBuf;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use serde_json::{Value, json};
use shared::exit::{self, Failure, failure};
use shared::ipc::Cell;
use shared::messages::Telemetry;

use crate::own_cell::{OwnCell, OwnCellError};
use crate::plots::pour as pour_plot;

/// What the operator records: millilitres filled in, and the curve's height (degrees) and width (1/s^2).
/// A fuller container spills earlier, so it is tilted less.
const EPISODES: [(f64, f32, f32); 5] =
    [(430.0, 47.0, 0.25), (360.0, 60.0, 0.25), (300.0, 68.0, 0.20), (230.0, 77.0, 0.25), (160.0, 83.0, 0.25)];
/// What is poured: millilitres filled in, and the goal. None of it was seen in training.
const POURS: [(f64, f32); 3] = [(200.0, 35.0), (280.0, 110.0), (450.0, 180.0)];
/// A pour further than this from its goal fails the demo, ml.
const TOLERANCE_ML: f64 = 10.0;

/// Command-line arguments.
#[derive(Debug, clap::Args)]
#[command(
    after_help = "Example:\n  experiments demo --out out/demo --seed 3\n\nLeaves in the output directory: sim.toml, episodes/*.mcap, weights.bin, \
pour-*.svg, summary.json and the processes' logs."
)]
pub struct Args {
    /// The simulated cell's configuration; the demo gives its copy a name and an address of its own.
    #[arg(long, default_value = shared::config::DEFAULT_FILE)]
    config: PathBuf,
    /// Directory of the results; what an earlier demo left there is replaced.
    #[arg(long, default_value = "out/demo")]
    out: PathBuf,
    /// Which container, camera and fluid the cell has, and the training's seed.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Print summary.json to standard output instead of the table.
    #[arg(long)]
    json: bool,
}

/// Runs the command.
pub fn run(args: &Args) -> Result<(), Failure> {
    for old in ["episodes", "summary.json"] {
        let old = args.out.join(old);
        let _ = if old.is_dir() { std::fs::remove_dir_all(old) } else { std::fs::remove_file(old) };
    }
    let mut cell = OwnCell::prepare("demo", &args.config, &args.out, args.seed)?;
    let summary = perform(args, &mut cell)?;
    if args.json {
        println!("{}", summary.json());
    } else {
        summary.print();
    }
    let far: Vec<String> = (1..).zip(&summary.pours).filter(|(_, p)| p.error_ml.abs() > TOLERANCE_ML).map(|(i, _)| i.to_string()).collect();
    if far.is_empty() {
        return Ok(());
    }
    Err(failure(exit::FAILED, format!("pour {} is further than {TOLERANCE_ML} ml from its goal", far.join(" and "))))
}

/// One pour's line in the table.
struct Pour {
    filled_ml: f64,
    goal_ml: f32,
    poured_ml: f64,
    error_ml: f64,
    outcome: Value,
    episode_file: Value,
    plot: PathBuf,
}

struct Summary {
    pours: Vec<Pour>,
    episodes: Vec<Value>,
    weights: String,
    seconds: f64,
    out: PathBuf,
}

impl Summary {
    fn json(&self) -> String {
        let pours: Vec<Value> = self
            .pours
            .iter()
            .map(|p| {
                json!({
                    "v_init_ml": p.filled_ml, "goal_ml": p.goal_ml, "poured_ml": p.poured_ml, "error_ml": p.error_ml,
                    "seconds": p.outcome["seconds"], "late_ticks": p.outcome["late_ticks"], "stale_features": p.outcome["stale_features"],
                    "bridged_frames": p.outcome["bridged_frames"], "estimate_ml": p.outcome["poured_ml"], "reason": p.outcome["reason"],
                    "episode_file": p.episode_file, "plot": p.plot,
                })
            })
            .collect();
        let all = json!({ "pours": pours, "episodes": self.episodes, "weights": self.weights, "seconds": self.seconds });
        serde_json::to_string_pretty(&all).unwrap_or_default()
    }

    fn print(&self) {
        println!(
            "\n{:>9} {:>9} {:>9} {:>9} {:>7} {:>10} {:>14}",
            "filled", "goal", "poured", "error", "time", "late ticks", "stale features"
        );
        println!("{:>9} {:>9} {:>9} {:>9} {:>7} {:>10} {:>14}", "ml", "ml", "ml", "ml", "s", "", "");
        for p in &self.pours {
            println!(
                "{:>9.0} {:>9.0} {:>9.0} {:>+9.1} {:>7.1} {:>10} {:>14}",
                p.filled_ml,
                p.goal_ml,
                p.poured_ml,
                p.error_ml,
                p.outcome["seconds"].as_f64().unwrap_or(f64::NAN),
                p.outcome["late_ticks"].to_string(),
                p.outcome["stale_features"].to_string()
            );
        }
        println!(
            "\npoured is the scale's reading in g (= ml of water); everything is in {} after {:.0} s",
            self.out.display(),
            self.seconds
        );
    }
}

/// Records, trains, pours; writes summary.json.
fn perform(args: &Args, cell: &mut OwnCell) -> Result<Summary, OwnCellError> {
    cell.note("starting the simulated cell, the feature worker and the controller");
    let client = cell.start()?;

    let mut episodes = Vec::new();
    for (i, (fill_ml, lambda_deg, gamma)) in EPISODES.into_iter().enumerate() {
        cell.note(&format!("episode {} of {}: {fill_ml} ml, lambda {lambda_deg} degrees, gamma {gamma}/s^2", i + 1, EPISODES.len()));
        cell.command("simulator", &["operator", "fill", &fill_ml.to_string()])?;
        let recorded =
            cell.command("rt-controller", &["record", "--json", "--lambda", &lambda_deg.to_string(), "--gamma", &gamma.to_string()])?;
        let weight_g = cell.scale()?;
        let file = recorded["episode_file"].as_str().unwrap_or_default().to_string();
        cell.command("feature-worker", &["episodes", "weigh", &file, "--weight", &weight_g.to_string()])?;
        cell.note(&format!("  weighed {weight_g} g"));
        episodes.push(json!({ "file": file, "weight_g": weight_g, "v_init_ml": fill_ml }));
    }

    cell.note("training from the episodes");
    let weights = args.out.join("weights.bin");
    let before = client.status().map_err(|e| OwnCellError::Other(e.to_string()))?.weights_taken;
    let log = args.out.join("logs/trainer.log");
    let output = Command::new(cell.bin.join("trainer"))
        .arg("train")
        .arg(&cell.config.recording.directory)
        .args(["--seed", &args.seed.to_string(), "--out"])
        .arg(&weights)
        .output()
        .map_err(|error| OwnCellError::File { what: "trainer".into(), error })?;
    let _ = std::fs::write(&log, [output.stdout.as_slice(), output.stderr.as_slice()].concat());
    cell.succeeded("trainer train", output.status, &String::from_utf8_lossy(&output.stderr))?;
    let taken = cell.until("the weight swap", 10, || match client.status() {
        Ok(s) if s.weights_taken > before => Ok(s.weights.clone()),
        Ok(s) => Err(s.weights_refused.clone()),
        Err(e) => Err(e.to_string()),
    })?;
    cell.note(&format!("the running controller took weights {taken}"));

    let mut pours = Vec::new();
    for (i, (fill_ml, goal_ml)) in POURS.into_iter().enumerate() {
        cell.note(&format!("pour {} of {}: {goal_ml} ml from {fill_ml} ml", i + 1, POURS.len()));
        cell.command("simulator", &["operator", "fill", &fill_ml.to_string()])?;
        let listener = Listener::start(&cell.config.cell.name)?;
        let result = cell.command("rt-controller", &["pour", "--json", &goal_ml.to_string()])?;
        let ticks = listener.finish();
        let poured_ml = cell.scale()?;
        let plot = args.out.join(format!("pour-{}-{goal_ml:.0}ml.svg", i + 1));
        pour_plot::draw(&plot, &ticks, goal_ml, poured_ml).map_err(|e| OwnCellError::Other(format!("{}: {e}", plot.display())))?;
        cell.note(&format!("  poured {poured_ml} g on the scale"));
        pours.push(Pour {
            filled_ml: fill_ml,
            goal_ml,
            poured_ml,
            error_ml: poured_ml - f64::from(goal_ml),
            outcome: result["outcome"].clone(),
            episode_file: result["episode_file"].clone(),
            plot,
        });
    }
    let summary = Summary { pours, episodes, weights: taken, seconds: cell.started.elapsed().as_secs_f64(), out: args.out.clone() };
    let file = args.out.join("summary.json");
    std::fs::write(&file, summary.json() + "\n").map_err(|error| OwnCellError::File { what: file.display().to_string(), error })?;
    Ok(summary)
}

/// Collects the controller's telemetry in a thread while a pour runs.
struct Listener {
    stop: Arc<AtomicBool>,
    thread: std::thread::JoinHandle<Vec<Telemetry>>,
}

impl Listener {
    fn start(cell: &str) -> Result<Self, OwnCellError> {
        let stop = Arc::new(AtomicBool::new(false));
        let (cell, stopped) = (cell.to_string(), Arc::clone(&stop));
        let (sender, ready) = std::sync::mpsc::channel();
        let thread = std::thread::spawn(move || {
            let mut ticks = Vec::new();
            let opened = Cell::join(&cell).and_then(|c| c.telemetry().map(|t| (c, t)));
            let (_cell, topic) = match opened {
                Ok(opened) => opened,
                Err(e) => {
                    let _ = sender.send(Err(e.to_string()));
                    return ticks;
                }
            };
            let Ok(subscriber) = topic.subscriber_builder().create() else {
                let _ = sender.send(Err("telemetry: too many readers".into()));
                return ticks;
            };
            let _ = sender.send(Ok(()));
            while !stopped.load(Ordering::Relaxed) {
                while let Ok(Some(tick)) = subscriber.receive() {
                    if tick.episode != 0 {
                        ticks.push(*tick);
                    }
                }
                std::thread::sleep(Duration::from_millis(50));
            }
            ticks
        });
        match ready.recv() {
            Ok(Ok(())) => Ok(Self { stop, thread }),
            Ok(Err(e)) => Err(OwnCellError::Other(e)),
            Err(e) => Err(OwnCellError::Other(e.to_string())),
        }
    }

    fn finish(self) -> Vec<Telemetry> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap_or_default()
    }
}
