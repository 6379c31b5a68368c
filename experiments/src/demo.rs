//! The demo: what an operator does from the first recording to a poured volume, in a cell of its own ([`crate::own_cell`]). What is weighed
//! is what `trainer plan` proposes, and what is poured at the end follows the vessel (`plan.rs`).
//!
//! Ordinary process; allocates and blocks; one thread of its own listens to the controller while a pour runs. A step that fails ends it.

use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::Duration;

use rt_controller::client::Client;
use serde_json::{Value, json};
use shared::config::CellConfig;
use shared::control::volume_words;
use shared::ipc::Cell;
use shared::messages::Telemetry;
use simulator::cell::SimulatorConfig;

use crate::own_cell::{OwnCell, OwnCellError};
use crate::plots;

pub mod plan;

use plan::{Plan, PlannedPour, Proposed, WEIGHINGS};

/// The folder of the pictures of the pours, in the folder of the results.
const PICTURES: &str = "pours";

/// One pour and its line in the table.
pub struct DemoPour {
    filled_ml: f64,
    goal_ml: f64,
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
    /// The pours that show what was learned, in order.
    pub pours: Vec<DemoPour>,
    /// The weighed pours before them, from which it was learned.
    weighed_pours: Vec<DemoPour>,
    episodes: Vec<Value>,
    weights: String,
    seconds: f64,
    out: PathBuf,
}

/// A number of a result; NaN if there is none.
fn number(value: &Value) -> f32 {
    value.as_f64().unwrap_or(f64::NAN) as f32
}

impl DemoSummary {
    /// `summary.json`.
    pub fn json(&self) -> String {
        let told = |pours: &[DemoPour]| -> Vec<Value> {
            let one = |p: &DemoPour| {
                json!({
                    "v_init_ml": p.filled_ml, "goal_ml": p.goal_ml, "poured_ml": p.poured_ml, "error_ml": p.error_ml,
                    "seconds": p.outcome["seconds"], "tick_gaps": p.outcome["tick_gaps"], "stale_features": p.outcome["stale_features"],
                    "bridged_frames": p.outcome["bridged_frames"], "estimate_ml": p.outcome["poured_ml"],
                    "estimate_sd_ml": p.outcome["poured_sd_ml"], "reason": p.outcome["reason"],
                    "episode_file": p.episode_file, "plot": p.plot,
                })
            };
            pours.iter().map(one).collect()
        };
        let all = json!({
            "pours": told(&self.pours), "weighed_pours": told(&self.weighed_pours), "episodes": self.episodes, "weights": self.weights,
            "seconds": self.seconds,
        });
        serde_json::to_string_pretty(&all).unwrap_or_default()
    }

    /// Prints the table of the pours.
    pub fn print(&self) {
        println!(
            "\n{:>9} {:>9} {:>9} {:>9} {:>16} {:>7} {:>10} {:>14}",
            "filled", "goal", "poured", "error", "believed", "time", "tick gaps", "stale features"
        );
        println!("{:>9} {:>9} {:>9} {:>9} {:>16} {:>7} {:>10} {:>14}", "ml", "ml", "ml", "ml", "ml", "s", "", "");
        for p in &self.pours {
            println!(
                "{:>9.0} {:>9.0} {:>9.0} {:>+9.1} {:>16} {:>7.1} {:>10} {:>14}",
                p.filled_ml,
                p.goal_ml,
                p.poured_ml,
                p.error_ml,
                volume_words(number(&p.outcome["poured_ml"]), number(&p.outcome["poured_sd_ml"])),
                p.outcome["seconds"].as_f64().unwrap_or(f64::NAN),
                p.outcome["tick_gaps"].to_string(),
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

/// Records, trains, pours and weighs, trains again after each, pours, and writes `summary.json`.
///
/// # Errors
/// One line, when a step fails or is interrupted.
pub fn perform(cell: &mut OwnCell, seed: u64) -> Result<DemoSummary, OwnCellError> {
    let plan = Plan::for_rig(&SimulatorConfig::new(&cell.config).map_err(OwnCellError::Config)?.rig());
    let pictures = cell.out.join(PICTURES);
    std::fs::create_dir_all(&pictures).map_err(|error| OwnCellError::File { what: pictures.display().to_string(), error })?;
    cell.note("starting the simulated cell, the feature worker and the controller");
    let client = cell.start()?;
    if let Some(address) = cell.open_page() {
        cell.note(&format!("watch it in a browser on this machine: {address}"));
    }
    let mut first_hour = FirstHour::default();
    for k in 0..WEIGHINGS {
        first_hour.weigh_next(cell, &plan, k)?;
        first_hour.weights = train(cell, &client, seed)?;
    }
    let FirstHour { episodes, weights, weighed_pours } = first_hour;
    let mut pours = Vec::new();
    for (k, planned) in plan.pours.iter().enumerate() {
        cell.note(&format!("pour {} of {}: {} ml from {} ml", k + 1, plan.pours.len(), planned.goal_ml, planned.fill_ml));
        pours.push(pour(cell, "pour", k + 1, *planned)?);
    }
    let seconds = cell.started.elapsed().as_secs_f64();
    let summary = DemoSummary { pours, weighed_pours, episodes, weights, seconds, out: cell.out.clone() };
    let file = cell.out.join("summary.json");
    std::fs::write(&file, summary.json() + "\n").map_err(|error| OwnCellError::File { what: file.display().to_string(), error })?;
    cell.made("summary.json");
    Ok(summary)
}

/// What is recorded and poured before anything is shown.
#[derive(Default)]
struct FirstHour {
    episodes: Vec<Value>,
    weighed_pours: Vec<DemoPour>,
    weights: String,
}

impl FirstHour {
    /// Asks what teaches most, does it, and weighs it; `nth` counts from 0.
    fn weigh_next(&mut self, cell: &mut OwnCell, plan: &Plan, nth: usize) -> Result<(), OwnCellError> {
        let number = format!("{} of {WEIGHINGS}", nth + 1);
        match proposal(cell, plan)? {
            Proposed::Curve { fill_ml, lambda_deg, gamma_per_s2: gamma } => {
                cell.note(&format!("weighing {number}, a curve: {fill_ml} ml, lambda {lambda_deg} degrees, gamma {gamma}/s^2"));
                cell.command("simulator", &["operator", "fill", &fill_ml.to_string()])?;
                let recorded = cell
                    .command("rt-controller", &["record", "--json", "--lambda", &lambda_deg.to_string(), "--gamma", &gamma.to_string()])?;
                let weight_g = cell.scale()?;
                self.episodes.push(weigh(cell, &recorded["episode_file"], weight_g, fill_ml)?);
                cell.note(&format!("  weighed {weight_g} g"));
            }
            Proposed::Pour(planned) => {
                cell.note(&format!("weighing {number}, a pour: {} ml from {} ml", planned.goal_ml, planned.fill_ml));
                let poured = pour(cell, "weighed", nth + 1, planned)?;
                self.episodes.push(weigh(cell, &poured.episode_file, poured.poured_ml, planned.fill_ml)?);
                self.weighed_pours.push(poured);
            }
        }
        Ok(())
    }
}

/// What `trainer plan` proposes to weigh next.
fn proposal(cell: &OwnCell, plan: &Plan) -> Result<Proposed, OwnCellError> {
    let directory = &cell.config.recording.directory;
    std::fs::create_dir_all(directory).map_err(|error| OwnCellError::File { what: directory.display().to_string(), error })?;
    let (holds, goal_max) = (plan.holds_ml.to_string(), plan.goal_max_ml.to_string());
    let words = ["plan", &directory.to_string_lossy(), "--holds", &holds, "--goal-max", &goal_max, "--json"].map(str::to_owned);
    let said = cell.command("trainer", &words.each_ref().map(String::as_str))?;
    let next = &said["plan"]["candidates"][0]["next"];
    serde_json::from_value(next.clone()).map_err(|e| OwnCellError::Other(format!("trainer plan: {next}: {e}")))
}

/// Enters an episode's weight; returns its entry for `summary.json`.
fn weigh(cell: &mut OwnCell, file: &Value, weight_g: f64, fill_ml: f64) -> Result<Value, OwnCellError> {
    let name = file.as_str().unwrap_or_default();
    cell.command("feature-worker", &["episodes", "weigh", name, "--weight", &weight_g.to_string()])?;
    made_episode(cell, file);
    Ok(json!({ "file": name, "weight_g": weight_g, "v_init_ml": fill_ml }))
}

/// Says that the demo has written the episode `file`.
fn made_episode(cell: &mut OwnCell, file: &Value) {
    if let Some(name) = file.as_str().and_then(|file| Path::new(file).file_name()) {
        cell.made(&format!("episodes/{}", name.to_string_lossy()));
    }
}

/// Trains, and waits until the running controller has taken the weights; returns their identity.
fn train(cell: &mut OwnCell, client: &Client, seed: u64) -> Result<String, OwnCellError> {
    cell.note("training from all weighed episodes");
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
    cell.made("weights.bin");
    cell.made("weights.bin.json");
    let taken = cell.until("the weight swap", 10, || match client.status() {
        Ok(s) if s.weights_taken > before => Ok(s.weights.clone()),
        Ok(s) => Err(s.weights_refused.clone()),
        Err(e) => Err(e.to_string()),
    })?;
    cell.note(&format!("the running controller took weights {taken}"));
    Ok(taken)
}

/// Pours once into an empty cup, and draws the pour.
fn pour(cell: &mut OwnCell, kind: &str, number: usize, planned: PlannedPour) -> Result<DemoPour, OwnCellError> {
    let PlannedPour { fill_ml, goal_ml } = planned;
    cell.command("simulator", &["operator", "fill", &fill_ml.to_string()])?;
    let listener = Listener::start(&cell.config.cell)?;
    let result = cell.command("rt-controller", &["pour", "--json", &goal_ml.to_string()])?;
    let ticks = listener.finish();
    let poured_ml = cell.scale()?;
    made_episode(cell, &result["episode_file"]);
    let name = format!("{PICTURES}/{kind}-{number}-{goal_ml:.0}ml.svg");
    let plot = cell.out.join(&name);
    plots::pour::draw(&plot, &ticks, goal_ml as f32, poured_ml).map_err(|e| OwnCellError::Other(format!("{}: {e}", plot.display())))?;
    cell.made(&name);
    cell.note(&format!("  poured {poured_ml} g on the scale"));
    Ok(DemoPour {
        filled_ml: fill_ml,
        goal_ml,
        poured_ml,
        error_ml: poured_ml - goal_ml,
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
