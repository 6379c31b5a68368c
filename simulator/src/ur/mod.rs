//! A simulated UR5 controller that real clients accept: dashboard, client interfaces, RTDE, and the very programs they upload.
//!
//! | module | what it is | sockets, clock |
//! |---|---|---|
//! | [`variables`] | RTDE's variables, their types and versions | no |
//! | [`machine`] | power, safety, programs, registers, watchdogs: one step a control cycle | no |
//! | [`servo`] | what servoj does to the joints | no |
//! | [`kinematics`] | where the flange is | no |
//! | [`script`] | URScript, interpreted one cycle at a time | no |
//! | [`ur_rtde`] | the register protocol of the ur_rtde library's own program | no |
//! | [`rtde`], [`dashboard`], [`client_interface`] | bytes in, bytes out | no |
//! | [`fault`] | what can be made to go wrong | no |
//! | `server` | one thread around all of it | yes |
//!
//! One controller listens on the fixed ports 29999, 30001 to 30004 of its address, and on [`OPERATOR_PORT`], which no robot
//! has: a line there is a [`Fault`], the answer `ok` or `error: ...`. Several run at once on 127.0.0.1, 127.0.0.2, ...

pub mod client_interface;
pub mod dashboard;
pub mod fault;
pub mod kinematics;
pub mod machine;
pub mod rtde;
pub mod script;
mod server;
pub mod servo;
pub mod ur_rtde;
pub mod variables;

use std::io::{BufRead, BufReader, Write};
use std::net::{IpAddr, SocketAddr, TcpStream};
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;
use std::time::Duration;

pub use fault::Fault;
pub use machine::{LogKind, LogLine, RobotMode, RuntimeState, SafetyMode};
pub use variables::{Series, Version};

use server::{Request, Server, Shared, lock};

/// Where faults are injected from another process.
pub const OPERATOR_PORT: u16 = 29_995;

/// SCHED_FIFO priority of the controller's thread where permitted.
const PRIORITY: u8 = 65;

/// How to start a controller.
#[derive(Debug, Clone, PartialEq)]
pub struct Options {
    /// A loopback address that no other controller uses.
    pub address: IpAddr,
    /// Generation: cycle time and default version.
    pub series: Series,
    /// Another version than the generation's usual one.
    pub version: Option<Version>,
    /// Joint angles at the start, rad, base to wrist 3.
    pub start_q_rad: [f64; 6],
}

impl Options {
    /// A CB3 at `address` in the pose that ur_rtde's examples start from, wrist 3 at 0.
    pub fn new(address: IpAddr) -> Self {
        let right = std::f64::consts::FRAC_PI_2;
        Self { address, series: Series::Cb3, version: None, start_q_rad: [0.0, -right, right, -right, -right, 0.0] }
    }
}

/// The controller could not be started.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// A port is taken or the address is not this machine's.
    #[error("cannot listen on {at}: {source}; is another simulated controller running there?")]
    Listen {
        /// Address and port.
        at: SocketAddr,
        /// The system's reason.
        source: std::io::Error,
    },
    /// No thread.
    #[error("cannot start the controller's thread: {0}")]
    Thread(std::io::Error),
}

/// The six joints at the end of a control cycle, base to wrist 3.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Joints {
    /// Where the trajectory is, rad.
    pub target_q: [f64; 6],
    /// Its speed, rad/s.
    pub target_qd: [f64; 6],
    /// Where the joints are, rad.
    pub actual_q: [f64; 6],
    /// Their speed, rad/s.
    pub actual_qd: [f64; 6],
    /// Time of that cycle, CLOCK_MONOTONIC ns.
    pub at_ns: u64,
}

/// What the controller is doing.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct State {
    /// Power and brakes.
    pub robot_mode: RobotMode,
    /// What stops it.
    pub safety_mode: SafetyMode,
    /// The program's state.
    pub runtime_state: RuntimeState,
    /// Name of the running or last program; empty before the first.
    pub program: String,
    /// Connections on 30004.
    pub rtde_clients: usize,
}

/// One control cycle of a motion trace; angles in rad, speeds in rad/s.
#[derive(Debug, Clone, Copy, PartialEq)]
#[allow(missing_docs)]
pub struct TraceRow {
    /// Controller time, s.
    pub timestamp_s: f64,
    /// The watched input register: the client's target, as it arrived.
    pub register: f64,
    pub commanded_q: [f64; 6],
    /// Calls of servoj so far.
    pub servoj_calls: u64,
    /// servoj moves the joints; false while they are stopped, or moved by something else.
    pub servoing: bool,
    pub target_q: [f64; 6],
    pub target_qd: [f64; 6],
    pub actual_q: [f64; 6],
    pub actual_qd: [f64; 6],
}

#[derive(Debug)]
struct Trace {
    double_register: usize,
    rows: Vec<TraceRow>,
}

/// Starts controllers.
#[derive(Debug)]
pub struct Controller;

impl Controller {
    /// Starts a controller that stands ready: power on, brakes off, no program.
    pub fn start(options: Options) -> Result<Handle, StartError> {
        let version = options.version.unwrap_or_else(|| options.series.default_version());
        let machine = machine::Machine::new(options.series, version, options.start_q_rad);
        let shared = Arc::new(Shared::default());
        let (requests, receiver) = mpsc::channel();
        let server = Server::new(options.address, machine, shared.clone(), receiver)?;
        let builder = std::thread::Builder::new().name("ur-controller".to_owned());
        let thread = builder
            .spawn(move || {
                // A real controller has a machine of its own; without the permission it shares this one as others do.
                let _ = shared::os::prioritise(PRIORITY);
                server.run();
            })
            .map_err(StartError::Thread)?;
        Ok(Handle { shared, requests, thread: Some(thread) })
    }
}

/// A running controller. Dropping it closes all sockets and ends the thread.
#[derive(Debug)]
pub struct Handle {
    shared: Arc<Shared>,
    requests: mpsc::Sender<Request>,
    thread: Option<JoinHandle<()>>,
}

impl Handle {
    /// The joints at the newest control cycle.
    pub fn joints(&self) -> Joints {
        *lock(&self.shared.joints)
    }

    /// What the controller is doing. None once its thread has ended.
    pub fn state(&self) -> Option<State> {
        lock(&self.shared.state).clone()
    }

    /// Makes something go wrong; returns when it has, at most a few control cycles later.
    pub fn inject(&self, fault: Fault) {
        let (done, wait) = mpsc::sync_channel(1);
        if self.requests.send(Request::Inject(fault, done)).is_ok() {
            // An error means that the controller has ended, which no fault can make worse.
            let _ = wait.recv_timeout(Duration::from_secs(5));
        }
    }

    /// All lines that programs and the controller wrote since the last call: textmsg, program errors, safety events.
    pub fn take_log(&self) -> Vec<LogLine> {
        std::mem::take(&mut *lock(&self.shared.log))
    }

    /// Records every control cycle from now on, with input double register `double_register` (0 to 47) beside the joints; at
    /// most 300,000 rows. A trace that is running is thrown away.
    pub fn start_trace(&self, double_register: usize) {
        *lock(&self.shared.trace) = Some(Trace { double_register: double_register.min(47), rows: Vec::new() });
    }

    /// Ends the trace and gives its rows; none if no trace was started.
    pub fn take_trace(&self) -> Vec<TraceRow> {
        lock(&self.shared.trace).take().map_or_else(Vec::new, |t| t.rows)
    }
}

impl Drop for Handle {
    fn drop(&mut self) {
        // An error means that the thread has ended already.
        let _ = self.requests.send(Request::Stop);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// A fault could not be injected into a controller of another process.
#[derive(Debug, thiserror::Error)]
pub enum SendError {
    /// Nobody answers.
    #[error("no simulated controller answers at {at}: {source}; is 'simulator run' or 'simulator ur' running?")]
    Unreachable {
        /// Address and port.
        at: SocketAddr,
        /// The system's reason.
        source: std::io::Error,
    },
    /// It answers, but not with "ok".
    #[error("the simulated controller at {at} refused: {answer}")]
    Refused {
        /// Address and port.
        at: SocketAddr,
        /// What it said.
        answer: String,
    },
}

/// Injects a fault into the controller at `address`, which may belong to another process.
pub fn send_fault(address: IpAddr, fault: &Fault) -> Result<(), SendError> {
    let at = SocketAddr::new(address, OPERATOR_PORT);
    let talk = || -> std::io::Result<String> {
        let mut stream = TcpStream::connect_timeout(&at, Duration::from_secs(2))?;
        stream.set_read_timeout(Some(Duration::from_secs(2)))?;
        stream.write_all(format!("{fault}\n").as_bytes())?;
        let mut answer = String::new();
        BufReader::new(stream).read_line(&mut answer)?;
        Ok(answer.trim().to_owned())
    };
    match talk() {
        Ok(answer) if answer == "ok" => Ok(()),
        Ok(answer) => Err(SendError::Refused { at, answer }),
        Err(source) => Err(SendError::Unreachable { at, source }),
    }
}
