//! `simulator demo`: the main job, end to end, with the real processes: record, train, swap the weights, pour, report.
//!
//! An ordinary process that does what an operator does: it starts the cell's processes, gives orders by their command lines,
//! fills the container, and reads the scale. It takes no decision of the controller. Ctrl-C, an error or the end: every process
//! that it started is stopped and the cell's shared memory is removed.

use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rt_controller::client::Client;
use serde_json::{Value, json};
use shared::config::Config;
use shared::exit;
use shared::ipc::Cell;
use shared::messages::{Phase, Telemetry};

use crate::pour_plot;

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
    after_help = "Example:\n  simulator demo --out out/demo --seed 3\n\nLeaves in the output directory: sim.toml, episodes/*.mcap, weights.bin, \
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

/// Why the demo stopped.
#[derive(Debug, thiserror::Error)]
enum DemoError {
    #[error("interrupted")]
    Interrupted,
    #[error("{0}")]
    Config(String),
    #[error("{what}: {error}")]
    File { what: String, error: std::io::Error },
    #[error("{what} failed ({code}); {hint}")]
    Step { what: String, code: String, hint: String },
    #[error("{what} did not happen within {seconds} s: {why}; see the logs in {logs}")]
    Late { what: String, seconds: u64, why: String, logs: String },
    #[error("{0}")]
    Other(String),
}

/// Runs the command; the exit codes are those of [`shared::exit`].
pub fn run(args: &Args) -> ExitCode {
    let stop = Arc::new(AtomicBool::new(false));
    for signal in [signal_hook::consts::SIGINT, signal_hook::consts::SIGTERM] {
        if let Err(e) = signal_hook::flag::register(signal, Arc::clone(&stop)) {
            return exit::fail(exit::FAILED, e);
        }
    }
    match Demo::prepare(args, stop).and_then(|mut demo| demo.perform()) {
        Ok(summary) => {
            let far: Vec<String> =
                (1..).zip(&summary.pours).filter(|(_, p)| p.error_ml.abs() > TOLERANCE_ML).map(|(i, _)| i.to_string()).collect();
            if args.json {
                println!("{}", summary.json());
            } else {
                summary.print();
            }
            if far.is_empty() {
                return ExitCode::SUCCESS;
            }
            exit::fail(exit::FAILED, format!("pour {} is further than {TOLERANCE_ML} ml from its goal", far.join(" and ")))
        }
        Err(DemoError::Interrupted) => exit::fail(exit::INTERRUPTED, "interrupted; every process that was started is stopped"),
        Err(e @ DemoError::Config(_)) => exit::fail(exit::BAD_INPUT, e),
        Err(e) => exit::fail(exit::FAILED, e),
    }
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
                p.outcome["late_ticks"],
                p.outcome["stale_features"]
            );
        }
        println!(
            "\npoured is the scale's reading in g (= ml of water); everything is in {} after {:.0} s",
            self.out.display(),
            self.seconds
        );
    }
}

/// The cell's processes; dropped: stopped in order and waited for.
struct Processes(Vec<(String, Child)>);

impl Processes {
    fn dead(&mut self) -> Option<String> {
        self.0.iter_mut().find_map(|(name, child)| match child.try_wait() {
            Ok(None) => None,
            Ok(Some(status)) => Some(format!("{name} ended ({status})")),
            Err(e) => Some(format!("{name}: {e}")),
        })
    }
}

impl Drop for Processes {
    fn drop(&mut self) {
        // The controller first: it brings the container upright while the robot is still there.
        for (_, child) in self.0.iter_mut().rev() {
            let pid = rustix::process::Pid::from_child(child);
            let _ = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
            let until = Instant::now() + Duration::from_secs(5);
            while matches!(child.try_wait(), Ok(None)) {
                if Instant::now() > until {
                    let _ = child.kill();
                }
                std::thread::sleep(Duration::from_millis(20));
            }
        }
    }
}

struct Demo<'a> {
    args: &'a Args,
    stop: Arc<AtomicBool>,
    config_file: PathBuf,
    config: Config,
    bin: PathBuf,
    started: Instant,
}

impl<'a> Demo<'a> {
    /// Makes the output directory and the demo's own configuration.
    fn prepare(args: &'a Args, stop: Arc<AtomicBool>) -> Result<Self, DemoError> {
        let text =
            std::fs::read_to_string(&args.config).map_err(|error| DemoError::File { what: args.config.display().to_string(), error })?;
        Config::parse(&text, &args.config.display().to_string()).map_err(|e| DemoError::Config(e.to_string()))?;
        let mut table: toml::Table = text.parse().map_err(|e| DemoError::Config(format!("{}: {e}", args.config.display())))?;
        let out = &args.out;
        for old in ["episodes", "logs"] {
            let _ = std::fs::remove_dir_all(out.join(old));
        }
        for old in ["weights.bin", "summary.json", "sim.toml"] {
            let _ = std::fs::remove_file(out.join(old));
        }
        std::fs::create_dir_all(out.join("logs")).map_err(|error| DemoError::File { what: out.display().to_string(), error })?;
        let mut set = |section: &str, key: &str, value: toml::Value| {
            if let Some(toml::Value::Table(t)) = table.get_mut(section) {
                t.insert(key.into(), value);
            }
        };
        let text = |path: &Path| toml::Value::String(path.display().to_string());
        // A name and an address of its own, so that a cell that is already running is left alone.
        let number = std::process::id();
        set("cell", "name", toml::Value::String(format!("demo-{number}")));
        set(
            "robot",
            "address",
            toml::Value::String(format!("127.{}.{}.{}", 1 + number / 65_536 % 250, number / 256 % 256, 1 + number % 254)),
        );
        set("controller", "weights", text(&out.join("weights.bin")));
        set("controller", "journal", text(&out.join("journal.bin")));
        set("recording", "directory", text(&out.join("episodes")));
        set("simulator", "seed", toml::Value::Integer(args.seed as i64));
        let config_file = out.join("sim.toml");
        let text = toml::to_string_pretty(&table).map_err(|e| DemoError::Config(e.to_string()))?;
        std::fs::write(&config_file, &text).map_err(|error| DemoError::File { what: config_file.display().to_string(), error })?;
        let config = Config::parse(&text, &config_file.display().to_string()).map_err(|e| DemoError::Config(e.to_string()))?;
        let exe = std::env::current_exe().map_err(|error| DemoError::File { what: "own program".into(), error })?;
        let bin = exe.parent().unwrap_or(Path::new(".")).to_path_buf();
        Ok(Self { args, stop, config_file, config, bin, started: Instant::now() })
    }

    fn perform(&mut self) -> Result<Summary, DemoError> {
        let cleanup = Cleanup(self.config.cell.name.clone());
        let result = self.perform_with_processes();
        drop(cleanup);
        let summary = result?;
        let file = self.args.out.join("summary.json");
        std::fs::write(&file, summary.json() + "\n").map_err(|error| DemoError::File { what: file.display().to_string(), error })?;
        Ok(summary)
    }

    fn perform_with_processes(&mut self) -> Result<Summary, DemoError> {
        let mut processes = Processes(Vec::new());
        self.note("starting the simulated cell, the feature worker and the controller");
        for name in ["simulator", "feature-worker", "rt-controller"] {
            processes.0.push((name.into(), self.spawn(name)?));
        }
        let client = self.until("the cell", 20, &mut processes, |me| Client::connect(&me.config.cell.name).map_err(|e| e.to_string()))?;
        self.until("readiness of robot and camera", 30, &mut processes, |_| match client.status() {
            Ok(s) if s.phase == Phase::Idle && s.feature_sequence > 0 => Ok(()),
            Ok(s) if s.feature_sequence == 0 => Err("no camera frames".into()),
            Ok(s) => Err(s.hindrance.clone()),
            Err(e) => Err(e.to_string()),
        })?;

        let mut episodes = Vec::new();
        for (i, (fill_ml, lambda_deg, gamma)) in EPISODES.into_iter().enumerate() {
            self.note(&format!("episode {} of {}: {fill_ml} ml, lambda {lambda_deg} degrees, gamma {gamma}/s^2", i + 1, EPISODES.len()));
            self.command("simulator", &["operator", "fill", &fill_ml.to_string()])?;
            let recorded =
                self.command("rt-controller", &["record", "--json", "--lambda", &lambda_deg.to_string(), "--gamma", &gamma.to_string()])?;
            let weight_g = self.scale()?;
            let file = recorded["episode_file"].as_str().unwrap_or_default().to_string();
            self.command("feature-worker", &["episodes", "weigh", &file, "--weight", &weight_g.to_string()])?;
            self.note(&format!("  weighed {weight_g} g"));
            episodes.push(json!({ "file": file, "weight_g": weight_g, "v_init_ml": fill_ml }));
        }

        self.note("training from the episodes");
        let weights = self.args.out.join("weights.bin");
        let before = client.status().map_err(|e| DemoError::Other(e.to_string()))?.weights_taken;
        let log = self.args.out.join("logs/trainer.log");
        let output = Command::new(self.bin.join("trainer"))
            .arg("train")
            .arg(&self.config.recording.directory)
            .args(["--seed", &self.args.seed.to_string(), "--out"])
            .arg(&weights)
            .output()
            .map_err(|error| DemoError::File { what: "trainer".into(), error })?;
        let _ = std::fs::write(&log, [output.stdout.as_slice(), output.stderr.as_slice()].concat());
        self.succeeded("trainer train", output.status, &String::from_utf8_lossy(&output.stderr))?;
        let taken = self.until("the weight swap", 10, &mut processes, |_| match client.status() {
            Ok(s) if s.weights_taken > before => Ok(s.weights.clone()),
            Ok(s) => Err(s.weights_refused.clone()),
            Err(e) => Err(e.to_string()),
        })?;
        self.note(&format!("the running controller took weights {taken}"));

        let mut pours = Vec::new();
        for (i, (fill_ml, goal_ml)) in POURS.into_iter().enumerate() {
            self.note(&format!("pour {} of {}: {goal_ml} ml from {fill_ml} ml", i + 1, POURS.len()));
            self.command("simulator", &["operator", "fill", &fill_ml.to_string()])?;
            let listener = Listener::start(&self.config.cell.name)?;
            let result = self.command("rt-controller", &["pour", "--json", &goal_ml.to_string()])?;
            let ticks = listener.finish();
            let poured_ml = self.scale()?;
            let plot = self.args.out.join(format!("pour-{}-{goal_ml:.0}ml.svg", i + 1));
            pour_plot::draw(&plot, &ticks, goal_ml, poured_ml).map_err(|e| DemoError::Other(format!("{}: {e}", plot.display())))?;
            self.note(&format!("  poured {poured_ml} g on the scale"));
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
        Ok(Summary { pours, episodes, weights: taken, seconds: self.started.elapsed().as_secs_f64(), out: self.args.out.clone() })
    }

    fn note(&self, text: &str) {
        eprintln!("[{:5.1} s] {text}", self.started.elapsed().as_secs_f64());
    }

    fn spawn(&self, name: &str) -> Result<Child, DemoError> {
        let log = self.args.out.join(format!("logs/{name}.log"));
        let file = || std::fs::File::create(&log).map_err(|error| DemoError::File { what: log.display().to_string(), error });
        Command::new(self.bin.join(name))
            .args(["run", "--config"])
            .arg(&self.config_file)
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(file()?)
            .spawn()
            .map_err(|error| DemoError::File { what: name.into(), error })
    }

    /// Runs one command of an operator to its end and reads its JSON.
    fn command(&self, program: &str, words: &[&str]) -> Result<Value, DemoError> {
        let what = format!("{program} {}", words.join(" "));
        let mut child = Command::new(self.bin.join(program));
        child.args(words).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        if words.first() != Some(&"episodes") {
            child.arg("--config").arg(&self.config_file);
        }
        let output = child.output().map_err(|error| DemoError::File { what: what.clone(), error })?;
        self.succeeded(&what, output.status, &String::from_utf8_lossy(&output.stderr))?;
        Ok(serde_json::from_slice(&output.stdout).unwrap_or(Value::Null))
    }

    fn succeeded(&self, what: &str, status: std::process::ExitStatus, said: &str) -> Result<(), DemoError> {
        if self.stop.load(Ordering::Relaxed) {
            return Err(DemoError::Interrupted);
        }
        if status.success() {
            return Ok(());
        }
        let last = said.lines().last().unwrap_or_default();
        let hint = format!("{last}; see the logs in {}", self.args.out.join("logs").display());
        Err(DemoError::Step { what: what.into(), code: status.to_string(), hint })
    }

    fn scale(&self) -> Result<f64, DemoError> {
        let reading = self.command("simulator", &["operator", "scale", "--json"])?;
        reading["weight_g"].as_f64().ok_or_else(|| DemoError::Other(format!("the scale reads {reading}")))
    }

    /// Tries until it works, a process dies, Ctrl-C comes or time is up.
    fn until<T>(
        &self,
        what: &str,
        seconds: u64,
        processes: &mut Processes,
        attempt: impl Fn(&Self) -> Result<T, String>,
    ) -> Result<T, DemoError> {
        let until = Instant::now() + Duration::from_secs(seconds);
        loop {
            let why = match attempt(self) {
                Ok(value) => return Ok(value),
                Err(why) => why,
            };
            if self.stop.load(Ordering::Relaxed) {
                return Err(DemoError::Interrupted);
            }
            let logs = self.args.out.join("logs").display().to_string();
            if let Some(dead) = processes.dead() {
                return Err(DemoError::Other(format!("{dead} while waiting for {what}; see the logs in {logs}")));
            }
            if Instant::now() > until {
                return Err(DemoError::Late { what: what.into(), seconds, why, logs });
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }
}

/// Removes the cell's shared memory at the end, also what a killed process left.
struct Cleanup(String);

impl Drop for Cleanup {
    fn drop(&mut self) {
        shared::ipc::remove_files(&self.0);
    }
}

/// Collects the controller's telemetry in a thread while a pour runs.
struct Listener {
    stop: Arc<AtomicBool>,
    thread: std::thread::JoinHandle<Vec<Telemetry>>,
}

impl Listener {
    fn start(cell: &str) -> Result<Self, DemoError> {
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
            Ok(Err(e)) => Err(DemoError::Other(e)),
            Err(e) => Err(DemoError::Other(e.to_string())),
        }
    }

    fn finish(self) -> Vec<Telemetry> {
        self.stop.store(true, Ordering::Relaxed);
        self.thread.join().unwrap_or_default()
    }
}
