//! A simulated cell of real processes with a name, an address and a directory of its own, for experiments with the real programs.
//!
//! Ordinary process; allocates and blocks. It does what an operator does, by the programs' command lines, and makes no decision for the
//! controller. When it is dropped, every process that it started is stopped and the cell's shared memory is removed.

use std::io::{BufRead as _, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use rt_controller::client::Client;
use serde_json::Value;
use shared::config::Config;
use shared::exit::{self, Failure, failure};
use shared::messages::Phase;
use shared::os;

use crate::own_folder::{self, FolderError, Made};

/// The cell's configuration, in its directory.
const CONFIG: &str = "sim.toml";
/// What controller and page keep beside the episodes: the number of the last one, and how they ended.
const BESIDE_EPISODES: [&str; 2] = ["episodes/.last-number", "episodes/operator-page-ends.json"];
/// The programs whose words are in `logs`.
const LOGGED: [&str; 4] = ["simulator", "feature-worker", "rt-controller", "trainer"];

/// Why the cell, or an operator's command in it, did not do what it was asked to.
#[derive(Debug, thiserror::Error)]
pub enum OwnCellError {
    /// Ctrl-C was pressed.
    #[error("interrupted; every process that was started is stopped")]
    Interrupted,
    /// The configuration is bad.
    #[error("{0}")]
    Config(String),
    /// A file or program cannot be used.
    #[error("{what}: {error}")]
    File {
        /// The file or program.
        what: String,
        /// What the system says.
        error: std::io::Error,
    },
    /// A command failed.
    #[error("{what} failed ({code}); {hint}")]
    Step {
        /// The command.
        what: String,
        /// Its exit code.
        code: String,
        /// Its last line, and where to look for more.
        hint: String,
    },
    /// Something took too long.
    #[error("{what} did not happen within {seconds} s: {why}; see the logs in {logs}")]
    Late {
        /// What was waited for.
        what: String,
        /// How long it was waited for, s.
        seconds: u64,
        /// Why the last attempt failed.
        why: String,
        /// Directory of the logs.
        logs: String,
    },
    /// Something else went wrong.
    #[error("{0}")]
    Other(String),
}

impl From<FolderError> for OwnCellError {
    fn from(error: FolderError) -> Self {
        match error {
            FolderError::NotOurs(_) => Self::Config(error.to_string()),
            FolderError::File { path, error } => Self::File { what: path.display().to_string(), error },
        }
    }
}

impl From<OwnCellError> for Failure {
    fn from(error: OwnCellError) -> Self {
        let code = match error {
            OwnCellError::Interrupted => exit::INTERRUPTED,
            OwnCellError::Config(_) => exit::BAD_INPUT,
            _ => exit::FAILED,
        };
        failure(code, error)
    }
}

/// A cell of its own.
pub struct OwnCell {
    /// Its configuration: the given one with a name, an address and files of its own.
    pub config: Config,
    /// Directory of all its files.
    pub out: PathBuf,
    /// Directory of the programs.
    pub bin: PathBuf,
    /// When it was prepared.
    pub started: Instant,
    /// What of the directory the next experiment deletes.
    made: Made,
    config_file: PathBuf,
    table: toml::Table,
    stop: Arc<AtomicBool>,
    processes: Vec<(&'static str, Child)>,
}

impl OwnCell {
    /// Makes the directory and the configuration; nothing runs yet. `results` of an earlier experiment there are removed, with its weights and
    /// logs, and what somebody else put among them is moved aside. `kind` becomes part of the cell's name. From here on Ctrl-C ends what waits.
    ///
    /// # Errors
    /// When the configuration is bad, the directory is not an experiment's ([`own_folder::claim`]), or a file cannot be written.
    pub fn prepare(kind: &str, config: &Path, (out, results): (&Path, &[&'static str]), seed: u64) -> Result<Self, OwnCellError> {
        let file = |what: &Path, error| OwnCellError::File { what: what.display().to_string(), error };
        let bad = |e: &dyn std::fmt::Display| OwnCellError::Config(e.to_string());
        let text = std::fs::read_to_string(config).map_err(|e| file(config, e))?;
        Config::parse(&text, &config.display().to_string()).map_err(|e| bad(&e))?;
        let mut table: toml::Table = text.parse().map_err(|e| bad(&format!("{}: {e}", config.display())))?;
        let results = [results, &["logs", CONFIG, "weights.bin", "weights.bin.json"]].concat();
        if let Some(aside) = own_folder::claim(out, &results)? {
            eprintln!("experiments: what no experiment made, or somebody changed, is in {} now", aside.display());
        }
        std::fs::create_dir_all(out.join("logs")).map_err(|e| file(out, e))?;
        let mut set = |section: &str, key: &str, value: toml::Value| {
            if let Some(toml::Value::Table(t)) = table.get_mut(section) {
                t.insert(key.into(), value);
            }
        };
        // Relative paths would start at the configuration, which lies in this directory.
        let path = |name: &str| toml::Value::String(name.into());
        // With a name and an address of its own it leaves a cell alone that is already running.
        let number = std::process::id();
        let address = format!("127.{}.{}.{}", 1 + number / 65_536 % 250, number / 256 % 256, 1 + number % 254);
        set("cell", "name", toml::Value::String(format!("{kind}-{number}")));
        set("robot", "address", toml::Value::String(address));
        set("controller", "weights", path("weights.bin"));
        set("controller", "journal", path("journal.bin"));
        set("recording", "directory", path("episodes"));
        set("simulator", "seed", toml::Value::Integer(seed as i64));
        let config_file = out.join(CONFIG);
        write_table(&config_file, &table)?;
        let config = Config::read(&config_file).map_err(|e| bad(&e))?;
        let stop = os::stop_at_signals().map_err(|e| OwnCellError::Other(e.to_string()))?;
        let exe = std::env::current_exe().map_err(|e| file(Path::new("own program"), e))?;
        let bin = exe.parent().unwrap_or(Path::new(".")).to_path_buf();
        let mut made = Made::default();
        made.add(out, Path::new(CONFIG));
        Ok(Self { config, out: out.into(), bin, started: Instant::now(), made, config_file, table, stop, processes: Vec::new() })
    }

    /// Gives the next start another key of `[simulator]`, or the configuration's own again.
    ///
    /// # Errors
    /// When the configuration cannot be written.
    pub fn simulate(&mut self, other: Option<(&str, toml::Value)>) -> Result<(), OwnCellError> {
        let mut table = self.table.clone();
        if let (Some((key, value)), Some(toml::Value::Table(simulator))) = (other, table.get_mut("simulator")) {
            simulator.insert(key.into(), value);
        }
        write_table(&self.config_file, &table)?;
        self.made(CONFIG);
        Ok(())
    }

    /// Starts simulator, feature worker and controller, and waits until they are ready to pour.
    ///
    /// # Errors
    /// When one of them cannot be started or ends, or they are not ready in time.
    pub fn start(&mut self) -> Result<Client, OwnCellError> {
        for name in ["simulator", "feature-worker", "rt-controller"] {
            let child = self.spawn(name)?;
            self.processes.push((name, child));
        }
        let place = self.config.cell.clone();
        let client = self.until("the cell", 20, || Client::connect(&place).map_err(|e| e.to_string()))?;
        self.until("readiness of robot and camera", 30, || match client.status() {
            Ok(s) if s.phase == Phase::Idle && s.feature_sequence > 0 => Ok(()),
            Ok(s) if s.feature_sequence == 0 => Err("no camera frames".into()),
            Ok(s) => Err(s.hindrance.clone()),
            Err(e) => Err(e.to_string()),
        })?;
        Ok(client)
    }

    /// Starts the operator's page of the cell, and gives its address; `None` if there is no page to be had, which ends nothing.
    pub fn open_page(&mut self) -> Option<String> {
        let mut command = self.program("operator-page", &["run", "--port", "0"]);
        let mut child = command.stdout(Stdio::piped()).stderr(Stdio::null()).spawn().ok()?;
        let mut address = String::new();
        let said = child.stdout.take().is_some_and(|out| BufReader::new(out).read_line(&mut address).is_ok());
        self.processes.push(("operator-page", child));
        (said && !address.is_empty()).then(|| address.trim().into())
    }

    /// Stops the processes in order, and waits for them.
    pub fn stop(&mut self) {
        // The controller first: it brings the container upright while the robot is still there.
        while let Some((_, mut child)) = self.processes.pop() {
            let pid = rustix::process::Pid::from_child(&child);
            let _ = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
            let until = Instant::now() + Duration::from_secs(5);
            while matches!(child.try_wait(), Ok(None)) {
                if Instant::now() > until {
                    let _ = child.kill();
                }
                std::thread::sleep(Duration::from_millis(20));
            }
        }
        // What its page let people in with: no other cell ever has this name.
        let _ = std::fs::remove_file(self.out.join(format!("operator-page-{}.token", self.config.cell.name)));
    }

    /// The process id of one of its processes, if it runs.
    pub fn pid(&self, name: &str) -> Option<u32> {
        self.processes.iter().find(|(n, _)| *n == name).map(|(_, child)| child.id())
    }

    /// Says that the experiment has just written the file `name` of its directory, or written it anew: the next experiment there deletes it, if nobody
    /// changes it until then. What a person puts there meanwhile is never said so, and is moved aside.
    pub fn made(&mut self, name: &str) {
        self.made.add(&self.out, Path::new(name));
    }

    /// Writes one line of progress to standard error.
    pub fn note(&self, text: &str) {
        eprintln!("[{:5.1} s] {text}", self.started.elapsed().as_secs_f64());
    }

    /// Looks for Ctrl-C.
    ///
    /// # Errors
    /// [`OwnCellError::Interrupted`] once it was pressed.
    pub fn interrupted(&self) -> Result<(), OwnCellError> {
        if self.stop.load(Ordering::Relaxed) { Err(OwnCellError::Interrupted) } else { Ok(()) }
    }

    /// A program with its words and this cell's configuration, with nothing to read. `episodes` take no configuration.
    pub fn program(&self, program: &str, words: &[&str]) -> Command {
        let mut command = Command::new(self.bin.join(program));
        command.args(words).stdin(Stdio::null());
        if words.first() != Some(&"episodes") {
            command.arg("--config").arg(&self.config_file);
        }
        command
    }

    /// Starts `name run`; its output goes to a log file.
    fn spawn(&self, name: &str) -> Result<Child, OwnCellError> {
        let log = self.out.join(format!("logs/{name}.log"));
        let log = std::fs::File::create(&log).map_err(|error| OwnCellError::File { what: log.display().to_string(), error })?;
        let mut command = self.program(name, &["run"]);
        command.stdout(Stdio::null()).stderr(log);
        let spawned = if name == "simulator" { off_core(self.config.controller.core, || command.spawn()) } else { command.spawn() };
        spawned.map_err(|error| OwnCellError::File { what: name.into(), error })
    }

    /// Runs one command of an operator to its end, and reads its JSON.
    ///
    /// # Errors
    /// When it cannot be started or does not succeed.
    pub fn command(&self, program: &str, words: &[&str]) -> Result<Value, OwnCellError> {
        let what = format!("{program} {}", words.join(" "));
        let mut child = self.program(program, words);
        let output = child
            .stdout(Stdio::piped())
            .stderr(Stdio::piped())
            .output()
            .map_err(|error| OwnCellError::File { what: what.clone(), error })?;
        self.succeeded(&what, output.status, &String::from_utf8_lossy(&output.stderr))?;
        Ok(serde_json::from_slice(&output.stdout).unwrap_or(Value::Null))
    }

    /// Checks that a command succeeded.
    ///
    /// # Errors
    /// When the command failed; the error holds the last line that it printed.
    pub fn succeeded(&self, what: &str, status: ExitStatus, said: &str) -> Result<(), OwnCellError> {
        self.interrupted()?;
        if status.success() {
            return Ok(());
        }
        let last = said.lines().last().unwrap_or_default();
        let hint = format!("{last}; see the logs in {}", self.out.join("logs").display());
        Err(OwnCellError::Step { what: what.into(), code: status.to_string(), hint })
    }

    /// What the kitchen scale shows, g.
    ///
    /// # Errors
    /// When the scale cannot be read.
    pub fn scale(&self) -> Result<f64, OwnCellError> {
        let reading = self.command("simulator", &["operator", "scale", "--json"])?;
        reading["weight_g"].as_f64().ok_or_else(|| OwnCellError::Other(format!("the scale reads {reading}")))
    }

    /// Repeats `attempt` until it succeeds.
    ///
    /// # Errors
    /// When a process ends, Ctrl-C is pressed, or time is up.
    pub fn until<T>(&mut self, what: &str, seconds: u64, attempt: impl Fn() -> Result<T, String>) -> Result<T, OwnCellError> {
        let until = Instant::now() + Duration::from_secs(seconds);
        loop {
            let why = match attempt() {
                Ok(value) => return Ok(value),
                Err(why) => why,
            };
            self.interrupted()?;
            let logs = self.out.join("logs").display().to_string();
            for (name, child) in &mut self.processes {
                if let Ok(Some(status)) = child.try_wait() {
                    return Err(OwnCellError::Other(format!("{name} ended ({status}) while waiting for {what}; see the logs in {logs}")));
                }
            }
            if Instant::now() > until {
                return Err(OwnCellError::Late { what: what.into(), seconds, why, logs });
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }
}

impl Drop for OwnCell {
    fn drop(&mut self) {
        self.stop();
        // This also removes what a killed process left.
        shared::ipc::remove_files(&self.config.cell);
        for program in LOGGED {
            self.made(&format!("logs/{program}.log"));
        }
        BESIDE_EPISODES.iter().for_each(|name| self.made(name));
        if let Err(e) = self.made.remember(&self.out) {
            eprintln!("experiments: {e}");
        }
    }
}

/// Writes a configuration.
fn write_table(file: &Path, table: &toml::Table) -> Result<(), OwnCellError> {
    let text = toml::to_string_pretty(table).map_err(|e| OwnCellError::Config(e.to_string()))?;
    std::fs::write(file, text).map_err(|error| OwnCellError::File { what: file.display().to_string(), error })
}

/// Does something in a thread that never runs on `core`, and that whatever it starts inherits this from: what stands for the robot is another
/// machine in truth, and may not share the loop's core. On a machine with one core, or that does not permit it, it runs anywhere.
pub fn off_core<T: Send>(core: usize, what: impl FnOnce() -> T + Send) -> T {
    std::thread::scope(|scope| {
        let others = || {
            if let Ok(mut cores) = rustix::thread::sched_getaffinity(None)
                && cores.count() > 1
            {
                cores.unset(core);
                let _ = rustix::thread::sched_setaffinity(None, &cores);
            }
            what()
        };
        match scope.spawn(others).join() {
            Ok(value) => value,
            Err(panic) => std::panic::resume_unwind(panic),
        }
    })
}
