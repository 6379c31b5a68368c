//! A whole cell of real processes for tests: simulator, feature worker and controller. Each cell has its own shared memory, loopback
//! address and directory, and all of it is stopped and removed when the [`CellUnderTest`] is dropped.
//!
//! Only tests use it, in their own threads: it allocates and waits, and it panics when something does not start.
#![allow(clippy::unwrap_used, clippy::expect_used, clippy::panic, clippy::too_many_lines)]
#![forbid(unsafe_code)]

pub mod attack;
pub mod browser;
pub mod parsers;

use std::net::IpAddr;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};
use std::time::{Duration, Instant};

use rt_controller::link::{LinkOptions, TiltJoint};
use rustix::pty::{OpenptFlags, grantpt, openpt, ptsname, unlockpt};
use serde_json::Value;
use shared::actions::{Selection, action_table};
use shared::config::Joint;
use shared::estimator::Calibration;
use shared::framing::Framing;
use shared::limits::Limits;
use shared::mlp::{InputScale, Mlp};
use shared::weights::{Estimator, Method, Origin, Weights};

/// Counts the cells of this process, so that each gets a name and an address of its own.
static NEXT: AtomicU32 = AtomicU32::new(0);

/// How often an order is given that a stall of the machine ends, see [`CellUnderTest::order`]: stalls of a tenth of a second are rare, and three in
/// turn are a fault of ours.
const ORDERS: usize = 3;

/// Whether a stall of the machine may have ended the order that printed `output`; this prints it.
fn stalled(output: &Output) -> bool {
    let result: Value = serde_json::from_slice(&output.stdout).unwrap_or_default();
    let reason = &result["outcome"]["reason"];
    let stall = ["robot-lost", "controller-overrun", "stale-feature"].iter().any(|r| reason == r);
    if stall {
        println!("an order ended early ({reason}): did the machine stall?");
    }
    stall
}

/// The JSON that a command must have printed.
fn printed(words: &[&str], output: &Output) -> Value {
    assert!(output.status.success(), "{words:?}: {}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).expect("JSON")
}

/// Weights that tilt out by the same action in every frame: they pour, but not exactly.
pub fn steady_weights(action: usize) -> Weights {
    let mut network = Mlp::ZERO;
    network.b3[action] = 1.0;
    Weights {
        network,
        actions_deg: action_table(),
        selection: Selection::Argmax,
        scale: InputScale::default(),
        calibration: Calibration { volume_at_1_px2_ml: 0.0002, area_exponent: 1.0, log_tilt_slope: 0.0, hold_above_px2: f32::INFINITY },
        estimator: Estimator::Sum,
        rate_hz: 30.0,
        origin: Origin { method: Method::Handmade, actions: 21, episodes: 0, data_sha256: [action as u8; 32], framing: Framing::default() },
        seed: 1,
    }
}

/// How the robot at `address` is linked in tests: wrist 3 tilts, upright at 0, within the default limits.
pub fn link_options(address: IpAddr) -> LinkOptions {
    LinkOptions {
        address,
        tilt: TiltJoint { joint: Joint::Wrist3, start_deg: 0.0, direction: 1.0 },
        start_tolerance_deg: 2.0,
        register_base: 24,
        lookahead_s: 0.05,
        gain: 600.0,
        limits: Limits::default(),
        rate_hz: 30.0,
    }
}

/// Path of a program of the workspace, built beside the tests.
pub fn program(name: &str) -> PathBuf {
    let exe = std::env::current_exe().expect("tests have a path");
    let dir = exe.parent().and_then(Path::parent).expect("tests are in target/PROFILE/deps");
    let path = dir.join(name);
    assert!(path.exists(), "{} is missing: build with `cargo build --release --workspace`", path.display());
    path
}

/// A terminal of its own for a program under test: a person's side, and the program's.
pub fn terminal() -> (OwnedFd, std::fs::File) {
    let master = openpt(OpenptFlags::RDWR | OpenptFlags::NOCTTY).expect("a terminal");
    grantpt(&master).and_then(|()| unlockpt(&master)).expect("ours");
    let name = ptsname(&master, Vec::new()).expect("a name").into_string().expect("a path");
    (master, std::fs::File::options().read(true).write(true).open(name).expect("it opens"))
}

/// Namespaces of their own for a cell's processes, so that nobody else meets them: network, `/run/decant`, and on demand a `/dev/shm` of a
/// certain size.
pub struct Namespaces(Child);

impl Namespaces {
    /// Makes them; `shm_size` is the size of their `/dev/shm` in the words of mount(8). `None`, with a printed line, where that is not permitted.
    pub fn new(shm_size: Option<&str>) -> Option<Self> {
        let shm = shm_size.map_or(String::new(), |size| format!("mount -t tmpfs -o mode=1777,size={size} tmpfs /dev/shm && "));
        let script = format!(
            "mkdir -p /run/decant && mount -t tmpfs -o mode=0755 tmpfs /run/decant && {shm}ip link set lo up && echo ready && exec sleep 600"
        );
        let mut command = Command::new("unshare");
        command.args(["-m", "-n", "--propagation", "private", "sh", "-c", &script]).stdout(Stdio::piped()).stderr(Stdio::null());
        let mut this = Self(command.spawn().ok()?);
        let ready = this.0.stdout.as_mut().is_some_and(|out| std::io::Read::read_exact(out, &mut [0; 5]).is_ok());
        if !ready {
            println!("not run: no namespaces are permitted here (it takes root, and ip of iproute2)");
        }
        ready.then_some(this)
    }

    /// The command `name` in them.
    pub fn command(&self, name: impl AsRef<std::ffi::OsStr>) -> Command {
        let mut command = Command::new("nsenter");
        command.args(["-t", &self.0.id().to_string(), "-m", "-n", "--"]).arg(name);
        command
    }
}

impl Drop for Namespaces {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// A running cell.
pub struct CellUnderTest {
    /// The cell's directory: configuration, episodes, weights and logs; removed at the end.
    pub dir: tempfile::TempDir,
    /// The cell's name.
    pub name: String,
    /// The address of the cell's robot.
    pub address: std::net::IpAddr,
    /// Where its processes run, if not among all others.
    pub inside: Option<Namespaces>,
    processes: Vec<(String, Child)>,
}

impl CellUnderTest {
    /// Prepares a cell in which nothing runs yet. `adapt` may change the configuration, which is that of `config/sim.toml`.
    pub fn prepare(adapt: impl FnOnce(&mut toml::Table)) -> Self {
        // So many that none of a process comes again while its first one runs.
        let number = std::process::id() % 100_000 * 128 + NEXT.fetch_add(1, Ordering::Relaxed) % 128;
        let name = format!("test-{}-{number}", std::process::id());
        let address = std::net::IpAddr::from([127, 20 + (number / 62_500) as u8, (number / 250 % 250) as u8, 1 + (number % 250) as u8]);
        let dir = tempfile::tempdir().expect("a directory for the test");
        let text = include_str!("../../config/sim.toml");
        let mut config: toml::Table = text.parse().expect("config/sim.toml is valid");
        let mut set = |section: &str, key: &str, value: toml::Value| {
            config[section].as_table_mut().expect("a table").insert(key.into(), value);
        };
        let path = |p: &str| toml::Value::String(dir.path().join(p).display().to_string());
        set("cell", "name", toml::Value::String(name.clone()));
        set("robot", "address", toml::Value::String(address.to_string()));
        set("controller", "weights", path("weights.bin"));
        set("controller", "journal", path("journal.bin"));
        set("recording", "directory", path("episodes"));
        adapt(&mut config);
        std::fs::write(dir.path().join("cell.toml"), toml::to_string(&config).expect("still TOML")).expect("writable");
        Self { dir, name, address, inside: None, processes: Vec::new() }
    }

    /// Starts a cell with simulator, feature worker and controller, and waits until the robot is ready.
    pub fn start(adapt: impl FnOnce(&mut toml::Table)) -> Self {
        let mut cell = Self::prepare(adapt);
        cell.spawn_all();
        cell
    }

    /// Starts simulator, feature worker and controller, and waits until the robot is ready.
    pub fn spawn_all(&mut self) {
        for name in ["simulator", "feature-worker", "rt-controller"] {
            self.spawn(name);
        }
        self.wait_idle();
    }

    /// The program `name`, to be run where the cell is.
    pub fn program(&self, name: &str) -> Command {
        self.inside.as_ref().map_or_else(|| Command::new(program(name)), |i| i.command(program(name)))
    }

    /// The cell's configuration file.
    pub fn config(&self) -> PathBuf {
        self.dir.path().join("cell.toml")
    }

    /// The file that the controller watches for weights.
    pub fn weights(&self) -> PathBuf {
        self.dir.path().join("weights.bin")
    }

    /// Starts the program `name` with the command `run`.
    pub fn spawn(&mut self, name: &str) {
        let log =
            std::fs::OpenOptions::new().create(true).append(true).open(self.dir.path().join(format!("{name}.log"))).expect("writable");
        self.spawn_with(name, self.program(name), log.into());
    }

    /// Starts `command`, which is or becomes the program `name`, with the command `run`; it says what it says to `stderr`.
    pub fn spawn_with(&mut self, name: &str, mut command: Command, stderr: Stdio) {
        command.args(["run", "--config"]).arg(self.config()).stdin(Stdio::null()).stdout(Stdio::null()).stderr(stderr);
        self.processes.push((name.into(), command.spawn().expect("the program starts")));
    }

    /// The cell's runtime directory.
    pub fn runtime_dir(&self) -> PathBuf {
        shared::runtime_dir::Place::from(&self.name).path()
    }

    /// The cell's files in `/dev/shm`; none if no process has joined the cell.
    pub fn shared_memory(&self) -> Vec<PathBuf> {
        let Ok(token) = std::fs::read_to_string(self.runtime_dir().join("token")) else { return Vec::new() };
        let ours = |e: &std::fs::DirEntry| e.file_name().to_string_lossy().starts_with(&format!("decant-{token}_"));
        std::fs::read_dir("/dev/shm").expect("there").flatten().filter(ours).map(|e| e.path()).collect()
    }

    /// Starts a pour and waits until the container is tilted. The cell has weights that pour and a full container. What a stall of the machine
    /// ends before that is begun again, see [`Self::order`].
    pub fn pour_tilted(&self) -> Child {
        for _ in 0..ORDERS {
            self.fill();
            let mut pour = self.begin("rt-controller", &["pour", "200", "--json"]);
            let until = Instant::now() + Duration::from_secs(10);
            while matches!(pour.try_wait(), Ok(None)) {
                if self.status().is_some_and(|s| s["alpha_measured_deg"].as_f64() > Some(30.0)) {
                    return pour;
                }
                assert!(Instant::now() < until, "no tilt: {}", self.log("rt-controller"));
                std::thread::sleep(Duration::from_millis(50));
            }
            let output = pour.wait_with_output().expect("it ran");
            assert!(stalled(&output), "ended before the tilt: {}", String::from_utf8_lossy(&output.stderr));
        }
        panic!("{ORDERS} pours in turn ended before the tilt, see above");
    }

    /// Fills the container and waits until the robot is ready.
    pub fn fill(&self) {
        self.json("simulator", &["operator", "fill", "300", "--json"]);
        self.wait_idle();
    }

    /// Fills the container, gives an order that is to come to its end, and gives what it prints as JSON. A machine whose cores others use may
    /// hold a process up for longer than the cell bears (100 ms); it then ends the order, by name, and rightly so. Such an order is given again, at
    /// most twice, which is printed.
    pub fn order(&self, words: &[&str]) -> Value {
        for _ in 1..ORDERS {
            self.fill();
            let output = self.command("rt-controller", words);
            if !stalled(&output) {
                return printed(words, &output);
            }
        }
        self.fill();
        self.json("rt-controller", words)
    }

    /// What a process has printed so far.
    pub fn log(&self, name: &str) -> String {
        std::fs::read_to_string(self.dir.path().join(format!("{name}.log"))).unwrap_or_default()
    }

    /// Sends a signal to a process, and forgets it if that ends it at once (KILL).
    pub fn signal(&mut self, name: &str, signal: rustix::process::Signal) {
        let i = self.processes.iter().position(|(n, _)| n == name).expect("it runs");
        rustix::process::kill_process(rustix::process::Pid::from_child(&self.processes[i].1), signal).expect("it is ours");
        if signal == rustix::process::Signal::KILL {
            let (_, mut child) = self.processes.remove(i);
            child.wait().expect("it was ours");
        }
    }

    /// Process id of a running process.
    pub fn pid(&self, name: &str) -> u32 {
        self.processes.iter().find(|(n, _)| n == name).expect("it runs").1.id()
    }

    /// Asks a process to end and gives its exit code.
    pub fn stop(&mut self, name: &str) -> Option<i32> {
        self.signal(name, rustix::process::Signal::TERM);
        self.exit_code(name, Duration::from_secs(10))
    }

    /// Waits for a process to end by itself and gives its exit code.
    pub fn exit_code(&mut self, name: &str, within: Duration) -> Option<i32> {
        let i = self.processes.iter().position(|(n, _)| n == name).expect("it runs");
        let until = Instant::now() + within;
        while Instant::now() < until {
            if let Some(status) = self.processes[i].1.try_wait().expect("it is ours") {
                self.processes.remove(i);
                return status.code();
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        None
    }

    /// Runs a command of an operator to its end.
    pub fn command(&self, name: &str, words: &[&str]) -> Output {
        self.program(name).args(words).arg("--config").arg(self.config()).stdin(Stdio::null()).output().expect("it runs")
    }

    /// Starts a command of an operator in the background.
    pub fn begin(&self, name: &str, words: &[&str]) -> Child {
        let mut command = self.program(name);
        command.args(words).arg("--config").arg(self.config()).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        command.spawn().expect("it starts")
    }

    /// Runs a command that must succeed and print JSON.
    pub fn json(&self, name: &str, words: &[&str]) -> Value {
        printed(words, &self.command(name, words))
    }

    /// The controller's status, if it answers.
    pub fn status(&self) -> Option<Value> {
        let output = self.command("rt-controller", &["status", "--json"]);
        serde_json::from_slice(&output.stdout).ok().filter(|_| output.status.success())
    }

    /// Waits until `good` holds for the controller's status. If it does not, this panics with the newest status and what the processes
    /// printed.
    pub fn wait(&self, what: &str, within: Duration, good: impl Fn(&Value) -> bool) -> Value {
        let until = Instant::now() + within;
        let mut newest = None;
        while Instant::now() < until {
            newest = self.status();
            if let Some(status) = newest.as_ref().filter(|s| good(s)) {
                return status.clone();
            }
            std::thread::sleep(Duration::from_millis(50));
        }
        let logs: Vec<String> = ["simulator", "feature-worker", "rt-controller"].map(|n| format!("{n}:\n{}", self.log(n))).into();
        panic!("{what} did not happen; status {newest:#?}\n{}", logs.join("\n"));
    }

    /// Waits until the robot is ready, upright, and features arrive.
    pub fn wait_idle(&self) -> Value {
        self.wait("readiness", Duration::from_secs(30), |s| s["phase"] == "idle" && s["feature_sequence"].as_u64() > Some(0))
    }

    /// Writes weights where the controller watches, and waits until the loop has taken them.
    pub fn take_weights(&self, weights: &Weights) {
        let before = self.status().expect("a controller")["weights_taken"].as_u64();
        weights.write(&self.weights()).expect("writable");
        self.wait("the weight swap", Duration::from_secs(5), |s| s["weights_taken"].as_u64() > before);
    }
}

impl Drop for CellUnderTest {
    fn drop(&mut self) {
        // The controller ends first, while the robot is still there.
        while let Some((name, mut child)) = self.processes.pop() {
            let pid = rustix::process::Pid::from_child(&child);
            let _ = rustix::process::kill_process(pid, rustix::process::Signal::CONT);
            let _ = rustix::process::kill_process(pid, rustix::process::Signal::TERM);
            let until = Instant::now() + Duration::from_secs(10);
            while matches!(child.try_wait(), Ok(None)) {
                if Instant::now() > until {
                    eprintln!("{name} did not end on SIGTERM");
                    let _ = child.kill();
                }
                std::thread::sleep(Duration::from_millis(10));
            }
        }
        shared::ipc::remove_files(&self.name);
    }
}
