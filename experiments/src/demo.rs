//! The demo: what an operator does from the first recording to a poured volume, in a cell of its own ([`crate::own_cell`]).
//!
//! Ordinary process; allocates and blocks; one thread of its own listens to the controller while a pour runs. A step that fails ends it.

use std::path::PathBuf;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rt_controller::client::Client;
use serde_json::{Value, json};
use shared::config::CellConfig;
use shared::ipc::Cell;
use shared::messages::Telemetry;

use crate::own_cell::{OwnCell, OwnCellError};
use crate::plots;

/// What the operator records: millilitres filled in, and the curve's height (degrees) and width (1/s^2). A fuller container spills earlier,
/// so it is tilted less. Chosen by hand for containers of about 400 ml.
const EPISODES: [(f64, f32, f32); 5] =
    [(430.0, 47.0, 0.25), (360.0, 60.0, 0.25), (300.0, 68.0, 0.20), (230.0, 77.0, 0.25), (160.0, 83.0, 0.25)];
/// What is poured: millilitres filled in, and the goal in ml. Chosen by hand, so that none of it was seen in training.
const POURS: [(f64, f32); 3] = [(200.0, 35.0), (280.0, 110.0), (450.0, 180.0)];

/// One pour and its line in the table.
pub struct DemoPour {
    filled_ml: f64,
    goal_ml: f32,
    poured_ml: f64,
    /// On the scale minus the goal, ml.
    pub error_ml: f64,
    /// What the controller says about it.
    outcome: Value,
    episode_file: Value,
    plot: PathBuf,
}

/// What the demo has done.
pub struct DemoSummary {
    /// The pours, in order.
    pub pours: Vec<DemoPour>,
    episodes: Vec<Value>,
    weights: String,
    seconds: f64,
    out: PathBuf,
}

impl DemoSummary {
    /// `summary.json`.
    pub fn json(&self) -> String {
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

    /// Prints the table of the pours.
    pub fn print(&self) {
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

/// Records, trains, pours, and writes `summary.json`.
///
/// # Errors
/// One line, when a step fails or is interrupted.
pub fn perform(cell: &mut OwnCell, seed: u64) -> Result<DemoSummary, OwnCellError> {
    cell.note("starting the simulated cell, the feature worker and the controller");
    let client = cell.start()?;
    let episodes = record(cell)?;
    let weights = train(cell, &client, seed)?;
    let mut pours = Vec::new();
    for (number, (fill_ml, goal_ml)) in (1..).zip(POURS) {
        cell.note(&format!("pour {number} of {}: {goal_ml} ml from {fill_ml} ml", POURS.len()));
        pours.push(pour(cell, number, fill_ml, goal_ml)?);
    }
    let seconds = cell.started.elapsed().as_secs_f64();
    let summary = DemoSummary { pours, episodes, weights, seconds, out: cell.out.clone() };
    let file = cell.out.join("summary.json");
    std::fs::write(&file, summary.json() + "\n").map_err(|error| OwnCellError::File { what: file.display().to_string(), error })?;
    Ok(summary)
}

/// Records and weighs the episodes; returns their entries for `summary.json`.
fn record(cell: &OwnCell) -> Result<Vec<Value>, OwnCellError> {
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
    Ok(episodes)
}

/// Trains, and waits until the running controller has taken the weights; returns their identity.
fn train(cell: &mut OwnCell, client: &Client, seed: u64) -> Result<String, OwnCellError> {
    cell.note("training from the episodes");
    let weights = cell.out.join("weights.bin");
    let before = client.status().map_err(|e| OwnCellError::Other(e.to_string()))?.weights_taken;
    let log = cell.out.join("logs/trainer.log");
    let output = Command::new(cell.bin.join("trainer"))
        .arg("train")
        .arg(&cell.config.recording.directory)
        .args(["--seed", &seed.to_string(), "--out"])
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
    Ok(taken)
}

/// Pours once into an empty cup, and draws the pour.
fn pour(cell: &OwnCell, number: usize, fill_ml: f64, goal_ml: f32) -> Result<DemoPour, OwnCellError> {
    cell.command("simulator", &["operator", "fill", &fill_ml.to_string()])?;
    let listener = Listener::start(&cell.config.cell)?;
    let result = cell.command("rt-controller", &["pour", "--json", &goal_ml.to_string()])?;
    let ticks = listener.finish();
    let poured_ml = cell.scale()?;
    let plot = cell.out.join(format!("pour-{number}-{goal_ml:.0}ml.svg"));
    plots::pour::draw(&plot, &ticks, goal_ml, poured_ml).map_err(|e| OwnCellError::Other(format!("{}: {e}", plot.display())))?;
    cell.note(&format!("  poured {poured_ml} g on the scale"));
    Ok(DemoPour {
        filled_ml: fill_ml,
        goal_ml,
        poured_ml,
        error_ml: poured_ml - f64::from(goal_ml),
        outcome: result["outcome"].clone(),
        episode_file: result["episode_file"].clone(),
        plot,
    })
}

/// Collects the controller's telemetry, in a thread of its own, while a pour runs.
struct Listener {
    stop: Arc<AtomicBool>,
    thread: std::thread::JoinHandle<Vec<Telemetry>>,
}

impl Listener {
    /// Begins to listen to the cell `cell`.
    fn start(cell: &CellConfig) -> Result<Self, OwnCellError> {
        let stop = Arc::new(AtomicBool::new(false));
        let (cell, stopped) = (cell.clone(), Arc::clone(&stop));
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

    /// Ends listening; returns the ticks of the pour.
    fn finish(self) -> Vec<Telemetry> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap_or_default()
    }
}
