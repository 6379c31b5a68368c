//! One cell of the fault matrix: its own simulated robot, the controller as a process, and liquid by a formula.
//!
//! A cell reaches a moment of a pour, is struck by a fault, and is judged by the robot's own trace; see `main.rs`. It allocates, waits and
//! panics as tests do.

use std::fmt::Write as _;
use std::io::{BufRead, BufReader, Write};
use std::net::{IpAddr, Ipv4Addr, TcpStream};
use std::path::Path;
use std::process::{Child, Command, Stdio};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::thread::{self, JoinHandle};
use std::time::{Duration, Instant};

use rt_controller::client::Client;
use rt_controller::link::Lost;
use shared::actions::STAY;
use shared::config::Config;
use shared::control::{EndReason, Outcome, Reply, Request, RobotLink, Status};
use shared::estimator::Calibration;
use shared::ipc;
use shared::messages::{Feature, LAYOUT_VERSION, Phase};
use shared::mlp::Mlp;
use shared::os::now_ns;
use shared::weights::Weights;
use simulator::ur::{Controller, ControllerOptions, RuntimeState, Series};

use crate::motion::Motion;

/// Volume that 1 px^2 of a feature's area stands for, ml a frame.
const ML_PER_PX2: f64 = 0.002;
/// Longest time for detection, the program's patience, braking and settling, s; the way upright at the return rate comes on top.
const UPRIGHT_BOUND_S: f64 = 1.0;
/// Longest time of a stop that the robot makes by itself, s: program stop, protective stop, emergency stop.
const STOP_BOUND_S: f64 = 0.5;
/// Rate of the way upright in `config/sim.toml`, degrees/s.
const RETURN_RATE_DEG_S: f64 = 60.0;

/// When the fault comes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Moment {
    AtRest,
    TiltingOut,
    FullFlow,
    Returning,
}

/// What a fault leads to.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Expected {
    /// The pour goes on to its end.
    Nothing,
    /// The pour ends for this reason, and the program brings the container upright by itself.
    Upright(EndReason),
    /// The same as `Upright`, on a robot that moves at this share of its speed.
    Slowed(EndReason, f64),
    /// No controller is left to report anything; the program brings the container upright by itself.
    Orphaned,
    /// The pour ends for this reason, the robot stops where it is until its operator has acted, and is then not taken back unasked.
    Stopped(EndReason),
}

impl Expected {
    /// Whether the controller leaves the robot alone afterwards until it is asked for it.
    fn waits(self) -> bool {
        matches!(self, Self::Stopped(_))
    }
}

/// A simulated cell with its own robot, controller process and liquid.
pub struct Cell {
    name: String,
    address: IpAddr,
    pub series: Series,
    pub directory: tempfile::TempDir,
    pub robot: Arc<Controller>,
    pub process: Child,
    pub client: Option<Client>,
    stop: Arc<AtomicBool>,
    /// What has really left, ul.
    poured_ul: Arc<AtomicU64>,
    liquid: Option<JoinHandle<()>>,
    table: String,
}

impl Cell {
    /// A cell in its place of a table of addresses, which is another one for each process that runs these tests.
    pub fn new(name: &str, address: Ipv4Addr, series: Series) -> Self {
        let mut cell = Self::not_started(name, address, series);
        cell.process = start_controller(cell.directory.path());
        cell.ready();
        cell
    }

    /// The same, without a controller yet.
    pub fn not_started(name: &str, address: Ipv4Addr, series: Series) -> Self {
        let pid = std::process::id();
        let [_, _, third, fourth] = address.octets();
        let address = Ipv4Addr::new(127, 64 + (pid % 128) as u8, third, fourth);
        let directory = tempfile::tempdir().unwrap();
        let sim = Path::new(env!("CARGO_MANIFEST_DIR")).join("../config/sim.toml");
        let mut config = Config::read(&sim).unwrap();
        config.cell.name = format!("fault-{name}-{third}-{pid}");
        let address = IpAddr::V4(address);
        config.robot.address = address.into();
        config.controller.weights = directory.path().join("weights.bin");
        config.controller.journal = None;
        config.recording.directory = directory.path().join("episodes");
        config.simulator = None;
        std::fs::write(directory.path().join("cell.toml"), toml::to_string(&config).unwrap()).unwrap();
        tilt_until_it_flows().write(&config.controller.weights).unwrap();
        let robot = Arc::new(Controller::start(ControllerOptions { series, ..ControllerOptions::new(address) }).unwrap());
        let stop = Arc::new(AtomicBool::new(false));
        let poured_ul = Arc::new(AtomicU64::new(0));
        let liquid = thread::spawn({
            let (name, robot, stop, poured_ul) = (config.cell.name.clone(), robot.clone(), stop.clone(), poured_ul.clone());
            move || publish_features(&name, &robot, &stop, &poured_ul)
        });
        // Something that has ended stands for the controller until it is started.
        let process = Command::new("true").spawn().unwrap();
        Self {
            name: config.cell.name.clone(),
            address,
            series,
            directory,
            robot,
            process,
            client: None,
            stop,
            poured_ul,
            liquid: Some(liquid),
            table: String::new(),
        }
    }

    /// What the controller has said.
    pub fn said(&self) -> String {
        std::fs::read_to_string(self.directory.path().join("log")).unwrap_or_default()
    }

    pub fn log(&self) -> String {
        let theirs = self.said();
        let robot: Vec<String> = self.robot.take_log().into_iter().map(|l| format!("{:.3} {}", l.timestamp_s, l.text)).collect();
        format!("--- rt-controller\n{theirs}--- robot\n{}", robot.join("\n"))
    }

    /// Waits for what must come, however busy the machine is.
    pub fn until<T>(&self, what: &str, mut found: impl FnMut(&Self) -> Option<T>) -> T {
        let deadline = Instant::now() + Duration::from_secs(60);
        loop {
            if let Some(found) = found(self) {
                return found;
            }
            if Instant::now() > deadline {
                let status = self.client.as_ref().map(Client::status);
                panic!("{}: never {what}; status {status:?}; joints {:?}\n{}", self.name, self.robot.joints(), self.log());
            }
            thread::sleep(Duration::from_millis(2));
        }
    }

    /// Waits until the controller would accept a pour.
    pub fn ready(&mut self) {
        if self.client.is_none() {
            self.client = Some(Client::connect(&self.name).unwrap());
        }
        self.until("ready", |c| {
            let status = c.client.as_ref()?.status().ok()?;
            (status.phase == Phase::Idle && status.hindrance.is_empty()).then_some(())
        });
    }

    pub fn pour(&self, goal_ml: f32) -> u64 {
        self.until("pouring", |c| match c.client.as_ref()?.ask(&Request::Pour { goal_ml, flows_by_deg: None }) {
            Ok(Reply::Started { episode }) => Some(episode),
            _ => None,
        })
    }

    pub fn outcome(&self, episode: u64) -> Outcome {
        self.until("an outcome", |c| c.client.as_ref()?.status().ok()?.outcomes.into_iter().find(|o| o.episode == episode))
    }

    /// Alpha, degrees, and its rate, degrees/s.
    pub fn alpha(&self) -> (f64, f64) {
        let joints = self.robot.joints();
        (joints.actual_q[5].to_degrees(), joints.actual_qd[5].to_degrees())
    }

    /// Starts a pour (not at rest) and waits for `moment`.
    pub fn reach(&self, moment: Moment) -> Option<u64> {
        let reached = |what: &str, there: fn(f64, f64) -> bool| {
            self.until(what, |c| {
                let (alpha, rate) = c.alpha();
                there(alpha, rate).then_some(())
            });
        };
        let goal_ml = match moment {
            Moment::AtRest => return None,
            Moment::TiltingOut | Moment::FullFlow => 80.0,
            Moment::Returning => 6.0,
        };
        let episode = self.pour(goal_ml);
        match moment {
            Moment::Returning => reached("returning", |alpha, rate| rate < -30.0 && (15.0..45.0).contains(&alpha)),
            Moment::FullFlow => reached("at full flow", |alpha, rate| flow_ml_s(alpha) > 5.0 && rate.abs() < 5.0),
            _ => reached("tilting out", |alpha, rate| rate > 20.0 && alpha > 20.0),
        }
        Some(episode)
    }

    /// Checks one fault at one moment, and adds a row to the table.
    pub fn check(&mut self, fault: &str, moment: Moment, expected: Expected, strike: impl Fn(&mut Self), recover: impl Fn(&mut Self)) {
        let orphaned = expected == Expected::Orphaned;
        let connections = self.client.as_ref().unwrap().status().unwrap().robot_connections;
        let said_before = self.said().len();
        let episode = self.reach(moment);
        self.robot.start_trace(24);
        strike(self);
        let outcome = episode.filter(|_| !orphaned).map(|episode| self.outcome(episode));
        let upright = |c: &Self| {
            let (alpha, rate) = c.alpha();
            (alpha.abs() < 1.0 && rate.abs() < 1.0).then_some(())
        };
        let wanted = match expected {
            Expected::Nothing | Expected::Orphaned => EndReason::Done,
            Expected::Upright(reason) | Expected::Slowed(reason, _) | Expected::Stopped(reason) => reason,
        };
        match expected {
            Expected::Stopped(_) => self.until("stopped", |c| (c.alpha().1.abs() < 0.5).then_some(())),
            _ => self.until("upright", upright),
        }
        // Some more cycles pass, so that a motion that goes on would be seen.
        thread::sleep(Duration::from_millis(400));
        let trace = self.robot.take_trace();
        let motion = Motion::of(&trace, self.series);

        self.robot.start_trace(24);
        recover(self);
        if expected.waits() {
            self.is_left_alone(Duration::from_millis(2500));
            self.resume();
        }
        if expected != Expected::Nothing && !orphaned {
            self.until("connected anew", |c| {
                let status = c.client.as_ref()?.status().ok()?;
                (status.robot_connections != connections).then_some(())
            });
        }
        self.ready();
        let next = self.outcome(self.pour(8.0));
        let back = Motion::of(&self.robot.take_trace(), self.series);

        let reason = outcome.map_or("-", |o| o.reason.words());
        let poured = outcome.map_or(String::from("-"), |o| format!("{:.1}", o.poured_ml));
        let upright_s = motion.upright_s.map_or(String::from("after recovery"), |s| format!("{s:.2}"));
        let row = format!(
            "| {fault} | {:?} | {moment:?} | {reason} | {poured} | {:.1} | {:.1} | {:.2} | {upright_s} | {:.0} | {:.0} | {:.1} |",
            self.series,
            motion.start_deg,
            motion.peak_deg,
            motion.rest_s,
            motion.fastest_deg_s.max(back.fastest_deg_s),
            motion.hardest_deg_s2.max(back.hardest_deg_s2),
            next.poured_ml
        );
        writeln!(self.table, "{row}").unwrap();

        let context = || format!("{row}\n{}", self.log());
        if let Some(outcome) = outcome {
            assert_eq!(outcome.reason, wanted, "{}", context());
            assert!(outcome.poured_ml > 0.0 || moment == Moment::TiltingOut, "what was poured is reported\n{}", context());
        }
        if moment == Moment::AtRest && expected != Expected::Nothing && !orphaned {
            // Nothing was under way that could have a result, so the operator must have been told on the terminal.
            let said = self.said().split_off(said_before);
            let mut words = vec![wanted.words().to_owned()];
            // A controller that was stopped may first find that the robot has meanwhile given it up.
            if matches!(wanted, EndReason::RobotLost | EndReason::ControllerOverrun) {
                words.extend([Lost::Closed, Lost::Broken].map(|l| l.to_string()));
            }
            assert!(words.iter().any(|w| said.contains(w)), "{words:?}\n{}", context());
        }
        match expected {
            Expected::Nothing => {}
            Expected::Upright(_) | Expected::Slowed(..) | Expected::Orphaned => {
                let share = if let Expected::Slowed(_, share) = expected { share } else { 1.0 };
                let bound = (UPRIGHT_BOUND_S + motion.peak_deg / RETURN_RATE_DEG_S) / share;
                assert!(motion.upright_s.is_some_and(|s| s <= bound), "upright within {bound:.2} s\n{}", context());
            }
            Expected::Stopped(_) => assert!(motion.rest_s <= STOP_BOUND_S, "stopped within {STOP_BOUND_S} s\n{}", context()),
        }
        assert!(motion.fastest_deg_s <= 90.0 + 1e-3 && back.fastest_deg_s <= 90.0 + 1e-3, "{}", context());
        assert!(motion.hardest_deg_s2 <= 1500.0 * 1.001 && back.hardest_deg_s2 <= 1500.0 * 1.001, "{}", context());
        assert_eq!(next.reason, EndReason::Done, "the next pour\n{}", context());
    }

    /// What has really left so far, ml.
    pub fn poured_ml(&self) -> f64 {
        self.poured_ul.load(Relaxed) as f64 / 1e3
    }

    /// Stops the controller as its operator does.
    pub fn stop_controller(&mut self) {
        self.client = None;
        self.signal(rustix::process::Signal::TERM);
        self.process.wait().unwrap();
    }

    /// Starts the controller again.
    pub fn start_controller(&mut self) {
        self.process = start_controller(self.directory.path());
        self.client = Some(Client::connect(&self.name).unwrap());
    }

    /// Sends a program to the robot, as anybody can. Who closes at once, with the robot's own messages unread, may take the program back with a reset.
    pub fn send_program(&self, text: &str) {
        let mut stream = TcpStream::connect((self.address, 30002)).unwrap();
        stream.write_all(text.as_bytes()).unwrap();
        stream.shutdown(std::net::Shutdown::Write).unwrap();
        stream.set_read_timeout(Some(Duration::from_millis(200))).unwrap();
        while std::io::Read::read(&mut stream, &mut [0; 4096]).is_ok_and(|n| n > 0) {}
    }

    /// The controller's state.
    pub fn status(&self) -> Status {
        *self.until("a status", |c| c.client.as_ref()?.status().ok())
    }

    /// The robot stands ready, but the controller does not take it in this time, and says that it waits.
    pub fn is_left_alone(&self, time: Duration) {
        self.until("waiting for the operator", |c| (c.status().robot == RobotLink::WaitsForOperator).then_some(()));
        let before = self.status().robot_connections;
        let until = Instant::now() + time;
        while Instant::now() < until {
            let status = self.status();
            let context = || format!("{status:?}\n{}", self.log());
            assert_eq!((status.robot, status.robot_connections), (RobotLink::WaitsForOperator, before), "taken unasked: {}", context());
            assert!(status.hindrance.contains("it is not taken back by itself: ") || status.hindrance.contains("; then "), "{}", context());
            assert!(status.hindrance.ends_with("`rt-controller resume`, or the next pour or recording"), "{}", context());
            thread::sleep(Duration::from_millis(50));
        }
    }

    /// The operator asks for the robot.
    pub fn resume(&self) {
        assert_eq!(self.client.as_ref().unwrap().ask(&Request::Resume).unwrap(), Reply::Resuming);
    }

    /// The operator asks for the robot and does not get it; gives the reason.
    pub fn resume_in_vain(&self) -> String {
        self.resume();
        self.until("refused", |c| Some(c.status()).filter(|s| s.robot == RobotLink::WaitsForOperator)).hindrance
    }

    /// Runs a command of `rt-controller` in this cell; gives its exit code and what it printed.
    pub fn command(&self, arguments: &[&str]) -> (i32, String) {
        let mut command = Command::new(tests::program("rt-controller"));
        let output = command.args(arguments).arg("--config").arg(self.directory.path().join("cell.toml")).output().unwrap();
        let text = [output.stdout, output.stderr].map(|bytes| String::from_utf8_lossy(&bytes).into_owned()).concat();
        (output.status.code().unwrap_or(-1), text)
    }

    pub fn signal(&self, signal: rustix::process::Signal) {
        let pid = rustix::process::Pid::from_child(&self.process);
        rustix::process::kill_process(pid, signal).unwrap();
    }

    pub fn dashboard(&self, line: &str) {
        let mut stream = TcpStream::connect((self.address, 29999)).unwrap();
        let mut answers = BufReader::new(stream.try_clone().unwrap()).lines();
        answers.next();
        stream.write_all(format!("{line}\n").as_bytes()).unwrap();
        answers.next();
    }

    pub fn jog_upright_if_tilted(&mut self) {
        if self.alpha().0.abs() > 1.0 {
            self.jog_upright();
        }
    }

    /// The operator brings the container upright with the pendant's arrows.
    fn jog_upright(&self) {
        let mut q = self.robot.joints().actual_q;
        q[5] = 0.0;
        self.send_program(&format!("def jog():\n  movej({q:?}, 2.0, 1.0)\nend\n"));
        self.until("jogged upright", |c| (c.alpha().0.abs() < 0.2 && c.alpha().1.abs() < 0.1).then_some(()));
        self.until("the jog's end", |c| (c.robot.state()?.runtime_state == RuntimeState::Stopped).then_some(()));
        // What the jog commanded is not the program's motion.
        self.robot.start_trace(24);
    }
}

impl Drop for Cell {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
        self.stop.store(true, Relaxed);
        if let Some(liquid) = self.liquid.take() {
            let _ = liquid.join();
        }
        ipc::remove_files(&self.name);
        println!("{HEAD}\n{}", self.table);
    }
}

/// Head of the table that each cell prints.
const HEAD: &str = "| fault | robot | moment | reason | poured ml | alpha at fault | largest alpha | at rest s | upright s | \
largest rate deg/s | largest acceleration deg/s^2 | next pour of 8 ml |\n|---|---|---|---|---|---|---|---|---|---|---|---|";

/// Starts the controller of the cell in `directory`. What it prints goes to a file there.
pub fn start_controller(directory: &Path) -> Child {
    let path = tests::program("rt-controller");
    let log = std::fs::OpenOptions::new().create(true).append(true).open(directory.join("log")).unwrap();
    let config = directory.join("cell.toml");
    Command::new(path).arg("run").arg("--config").arg(config).stdin(Stdio::null()).stdout(Stdio::null()).stderr(log).spawn().unwrap()
}

/// Weights made by hand: they tilt by 2.45 degrees a frame until liquid flows freely, and then stay.
fn tilt_until_it_flows() -> Weights {
    let mut network = Mlp::ZERO;
    network.w1[0][0] = 1.0;
    network.w2[0][0] = 1.0;
    network.w3[0][STAY] = 1.0;
    network.b3[STAY + 7] = 0.5;
    let calibration =
        Calibration { volume_at_1_px2_ml: ML_PER_PX2 as f32, area_exponent: 1.0, log_tilt_slope: 0.0, hold_above_px2: f32::INFINITY };
    Weights { network, calibration, ..tests::steady_weights(STAY + 7) }
}

/// Flow at a tilt, ml/s.
pub fn flow_ml_s(alpha_deg: f64) -> f64 {
    ((alpha_deg - 50.0) * 1.0).clamp(0.0, 25.0)
}

/// Stands for the camera, the feature worker and the liquid at once: it publishes V_e from the tilt of the joint.
fn publish_features(name: &str, robot: &Controller, stop: &AtomicBool, poured_ul: &AtomicU64) {
    let cell = ipc::Cell::join(name).unwrap();
    let publisher = cell.features().unwrap().publisher_builder().create().unwrap();
    let worker_epoch_ns = now_ns();
    let mut sequence = 0;
    let mut next = Instant::now();
    while !stop.load(Relaxed) {
        next += Duration::from_nanos(1_000_000_000 / 30);
        thread::sleep(next.saturating_duration_since(Instant::now()));
        sequence += 1;
        let alpha_deg = robot.joints().actual_q[5].to_degrees();
        poured_ul.fetch_add((flow_ml_s(alpha_deg) / 30.0 * 1e3).round() as u64, Relaxed);
        let now = now_ns();
        let feature = Feature {
            version: LAYOUT_VERSION,
            sequence,
            worker_epoch_ns,
            captured_at_ns: now,
            received_at_ns: now,
            published_at_ns: now,
            area_px2: (flow_ml_s(alpha_deg) / 30.0 / ML_PER_PX2) as f32,
            confidence: 1.0,
            ..Feature::default()
        };
        publisher.send_copy(feature).unwrap();
    }
}
