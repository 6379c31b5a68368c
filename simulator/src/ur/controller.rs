//! A simulated controller that runs in this process: starting it, watching it, and making things go wrong.
//!
//! The controller has a thread of its own; any thread may use a [`Controller`]. Allocates. Ports that are taken and a thread that
//! cannot be started are errors of the start.

use std::net::IpAddr;
use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;
use std::time::Duration;

use super::fault::Fault;
use super::log::LogLine;
use super::machine::Machine;
use super::published::{ControllerState, Joints, Published, TraceRow};
use super::server::{ListenError, Server, ServerRequest};
use super::variables::{Series, Version};

/// SCHED_FIFO priority of the controller's thread, where it is permitted. Chosen by hand, below the priorities of the processes that
/// are measured (80 and 70 in config/sim.toml).
const PRIORITY: u8 = 65;
/// How long a fault may take to be injected. Chosen by hand, far above a control cycle.
const INJECT_PATIENCE: Duration = Duration::from_secs(5);

/// How to start a controller.
#[derive(Debug, Clone, PartialEq)]
pub struct ControllerOptions {
    /// A loopback address that no other controller uses.
    pub address: IpAddr,
    /// The generation, which decides the cycle time and the usual version.
    pub series: Series,
    /// Another version than the generation's usual one.
    pub version: Option<Version>,
    /// Joint angles at the start in rad, base to wrist 3.
    pub start_q_rad: [f64; 6],
}

impl ControllerOptions {
    /// A CB3 at `address`, in the pose from which ur_rtde's examples start, with wrist 3 at 0.
    pub fn new(address: IpAddr) -> Self {
        let right = std::f64::consts::FRAC_PI_2;
        Self { address, series: Series::Cb3, version: None, start_q_rad: [0.0, -right, right, -right, -right, 0.0] }
    }
}

/// The controller could not be started.
#[derive(Debug, thiserror::Error)]
pub enum StartError {
    /// A port is taken, or the address is not one of this machine.
    #[error(transparent)]
    Listen(#[from] ListenError),
    /// The system does not give another thread.
    #[error("cannot start the controller's thread: {0}")]
    Thread(std::io::Error),
}

/// A running controller. Dropping it closes all sockets and ends its thread.
#[derive(Debug)]
pub struct Controller {
    published: Arc<Published>,
    requests: mpsc::Sender<ServerRequest>,
    thread: Option<JoinHandle<()>>,
}

impl Controller {
    /// Starts a controller that stands ready: its power is on, its brakes are released, and no program runs.
    ///
    /// # Errors
    /// A port cannot be listened on, or the thread cannot be started.
    pub fn start(options: ControllerOptions) -> Result<Self, StartError> {
        let version = options.version.unwrap_or_else(|| options.series.default_version());
        let machine = Machine::new(options.series, version, options.start_q_rad);
        let published = Arc::new(Published::default());
        let (requests, receiver) = mpsc::channel();
        let server = Server::new(options.address, machine, published.clone(), receiver)?;
        let builder = std::thread::Builder::new().name("ur-controller".to_owned());
        let thread = builder
            .spawn(move || {
                // A real controller has a computer of its own. Without the permission this one shares it like any other thread.
                let _ = shared::os::prioritise(PRIORITY);
                server.run();
            })
            .map_err(StartError::Thread)?;
        Ok(Self { published, requests, thread: Some(thread) })
    }

    /// The joints at the newest control cycle.
    pub fn joints(&self) -> Joints {
        self.published.joints()
    }

    /// What the controller is doing; None before its first cycle.
    pub fn state(&self) -> Option<ControllerState> {
        self.published.state()
    }

    /// Makes something go wrong. Returns when it has happened, at most a few control cycles later.
    pub fn inject(&self, fault: Fault) {
        let (done, wait) = mpsc::sync_channel(1);
        if self.requests.send(ServerRequest::Inject(fault, done)).is_ok() {
            // An error means that the controller has ended, which no fault can make worse.
            let _ = wait.recv_timeout(INJECT_PATIENCE);
        }
    }

    /// All lines that programs and the controller logged since the last call.
    pub fn take_log(&self) -> Vec<LogLine> {
        self.published.take_log()
    }

    /// Records every control cycle from now on, with input double register `double_register` (0 to 47) beside the joints. At
    /// most 300,000 rows are kept. A trace that is running is thrown away.
    pub fn start_trace(&self, double_register: usize) {
        self.published.start_trace(double_register);
    }

    /// Ends the trace and gives its rows; none if no trace was started.
    pub fn take_trace(&self) -> Vec<TraceRow> {
        self.published.take_trace()
    }
}

impl Drop for Controller {
    fn drop(&mut self) {
        // An error means that the thread has ended already.
        let _ = self.requests.send(ServerRequest::Stop);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
