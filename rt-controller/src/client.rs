//! The clients' side of the controller's service `control`: one request, one answer; and the recorder's reports.
//!
//! It runs in ordinary threads of other processes, allocates, and blocks until there is an answer or a time limit has passed. Each failure
//! is one line that says what to do.

use std::path::PathBuf;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use iceoryx2::port::client::Client as Port;
use iceoryx2::service::ipc::Service as Ipc;
use iceoryx2::service::port_factory::PortFactory as _;
use indicatif::ProgressStyle;
use shared::control::{Outcome, Reply, Request, Status};
use shared::exit::{self, Failure, failure};
use shared::ipc::{Cell, InService as _, IpcError};
use shared::level::Level;
use shared::messages::{RecorderReport, RecorderState};
use shared::os;
use shared::runtime_dir::Place;

use crate::stop_client::Target;

/// Largest request or answer, bytes. Chosen by hand; no measurement is recorded.
pub const MESSAGE_MAX: usize = 64 * 1024;

/// Longest wait for the controller's answer. Chosen by hand: it answers within a tick and a pause of its service thread, below 0.1 s.
const ANSWER: Duration = Duration::from_secs(2);
/// Longest wait for a connection. Chosen by hand: it takes milliseconds, or two seconds while another process hangs in joining.
const CONNECTING: Duration = Duration::from_secs(5);
/// Longest wait for the recorder to close a file. Chosen by hand; no measurement is recorded.
const FILE_CLOSED: Duration = Duration::from_secs(10);
/// How many times in a row the controller may be asked and not know the episode that it started, before it counts as restarted. Chosen by
/// hand: it is asked for about a second.
const UNKNOWN_MAX: u32 = 10;

/// The arguments of all commands that ask the running controller.
#[derive(Debug, clap::Args)]
pub struct Common {
    /// The cell's configuration.
    #[arg(long, env = shared::config::VARIABLE, default_value = shared::config::DEFAULT_FILE)]
    pub config: PathBuf,
    /// Prints the result as JSON.
    #[arg(long)]
    pub json: bool,
}

/// Why the controller did not answer.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// Shared memory cannot be joined.
    #[error(transparent)]
    Ipc(#[from] IpcError),
    /// There is no controller, or it does not answer.
    #[error("no answer from rt-controller in cell '{cell}': is `rt-controller run` running with the same --config, as the same user?")]
    NoAnswer {
        /// The cell's name.
        cell: String,
    },
    /// The controller no longer knows an episode that it had started.
    #[error("rt-controller knows nothing of episode {0} any more: it was restarted; the robot's program brings the container upright")]
    Forgotten(u64),
    /// The answer cannot be read.
    #[error("rt-controller is another version of Decant: run the same build on both sides")]
    Version,
}

impl From<ClientError> for Failure {
    fn from(e: ClientError) -> Self {
        match e {
            ClientError::Ipc(e) => e.into(),
            e => failure(exit::UNREACHABLE, e),
        }
    }
}

/// A connection to the running controller.
pub struct Client {
    port: Port<Ipc, [u8], (), [u8], ()>,
    place: Place,
    cell: Cell,
}

impl Client {
    /// Connects to the controller of the cell `place`: the table `[cell]` of the configuration, or a name.
    pub fn connect(place: impl Into<Place>) -> Result<Self, ClientError> {
        let place = place.into();
        let cell = Cell::join(&place)?;
        let port = cell.control()?.client_builder().initial_max_slice_len(MESSAGE_MAX).create().in_service("control")?;
        cell.reserve()?;
        Ok(Self { port, place, cell })
    }

    /// Connects as a command does: it ends the process with a line if iceoryx2 does not come back, as it does not when somebody cut the cell's
    /// files in `/dev/shm` to nothing.
    pub fn connect_or_end(place: impl Into<Place>) -> Result<Self, ClientError> {
        let (done, watched) = std::sync::mpsc::channel::<()>();
        let watch = move || {
            if watched.recv_timeout(CONNECTING) == Err(std::sync::mpsc::RecvTimeoutError::Timeout) {
                os::tell(
                    Level::Error,
                    "error: the cell's files in /dev/shm do not answer: end all programs of the cell and start them again",
                );
                std::process::exit(exit::UNREACHABLE.into());
            }
        };
        // Without a thread it can only be hoped that the files are whole.
        let _watching = std::thread::Builder::new().name("watch".into()).spawn(watch);
        let client = Self::connect(place);
        drop(done);
        client
    }

    /// Sends `request` and waits for the answer, up to two seconds.
    pub fn ask(&self, request: &Request) -> Result<Reply, ClientError> {
        let no_answer = || ClientError::NoAnswer { cell: self.place.name.clone() };
        let mut buffer = vec![0; MESSAGE_MAX];
        let bytes = postcard::to_slice(request, &mut buffer).map_err(|_| ClientError::Version)?;
        let loan = self.port.loan_slice_uninit(bytes.len()).map_err(|_| no_answer())?;
        let pending = loan.write_from_slice(bytes).send().map_err(|_| no_answer())?;
        let until = Instant::now() + ANSWER;
        while Instant::now() < until {
            if let Some(response) = pending.receive().map_err(|_| no_answer())? {
                return postcard::from_bytes(response.payload()).map_err(|_| ClientError::Version);
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        Err(no_answer())
    }

    /// Whether a feature worker was there to record when this client connected.
    pub fn has_recorder(&self) -> Result<bool, ClientError> {
        Ok(self.cell.recorder()?.dynamic_config().number_of_publishers() > 0)
    }

    /// The controller's state.
    pub fn status(&self) -> Result<Box<Status>, ClientError> {
        match self.ask(&Request::Status)? {
            Reply::Status(status) => Ok(status),
            _ => Err(ClientError::Version),
        }
    }
}

impl Client {
    /// Asks for an abort at the stop socket, which works where shared memory does not. Whether anybody answers there.
    pub fn abort_by_socket(&self) -> bool {
        Target::from(self.place.clone()).ask("abort").is_some()
    }

    /// Shows the progress of `episode` on standard error until it has ended, and tells how, and whether it was interrupted. Once `interrupted` is true, by
    /// Ctrl-C, it is aborted. A controller that does not answer once goes on, and is asked again.
    pub fn follow(&self, episode: u64, interrupted: &AtomicBool) -> Result<(Outcome, bool), ClientError> {
        let bar = indicatif::ProgressBar::new(1000);
        bar.set_style(ProgressStyle::with_template("{bar:30} {msg}").unwrap_or_else(|_| ProgressStyle::default_bar()));
        let (mut aborted, mut unknown, mut answered) = (false, 0, true);
        loop {
            if interrupted.load(Ordering::Relaxed) && !aborted {
                if !self.abort_by_socket() {
                    self.ask(&Request::Abort)?;
                }
                aborted = true;
            }
            let status = match self.status() {
                Err(ClientError::NoAnswer { .. }) if std::mem::replace(&mut answered, false) => continue,
                status => status?,
            };
            answered = true;
            if let Some(outcome) = status.outcomes.iter().find(|o| o.episode == episode) {
                bar.finish_and_clear();
                return Ok((*outcome, aborted));
            }
            // The answer that an episode has started may come a little before the first tick that shows it.
            unknown = if status.episode == episode { 0 } else { unknown + 1 };
            if unknown > UNKNOWN_MAX {
                return Err(ClientError::Forgotten(episode));
            }
            bar.set_position((1000.0 * (status.poured_ml / status.goal_ml).clamp(0.0, 1.0)) as u64);
            // A curve has no goal, and nobody counts what it pours.
            if status.goal_ml.is_finite() {
                bar.set_message(format!(
                    "alpha {:5.1} deg  poured {:5.1} ml  d {:5.1} ml",
                    status.alpha_deg, status.poured_ml, status.d_ml
                ));
            } else {
                bar.set_message(format!("alpha {:5.1} deg", status.alpha_deg));
            }
            std::thread::sleep(Duration::from_millis(100));
        }
    }
}

/// The episode's file: its path, or why there is none.
#[derive(Debug, Clone)]
pub struct Recorded {
    /// The path, or the recorder's reason.
    pub file: Result<String, String>,
}

/// Receives the recorder's reports about episodes.
pub struct RecorderReports {
    subscriber: iceoryx2::port::subscriber::Subscriber<Ipc, RecorderReport, ()>,
    _cell: Cell,
}

impl RecorderReports {
    /// Subscribes to the reports in the cell `place`.
    pub fn open(place: impl Into<Place>) -> Result<Self, IpcError> {
        let cell = Cell::join(place)?;
        let subscriber = cell.recorder()?.subscriber_builder().create().in_service("recorder")?;
        cell.reserve()?;
        Ok(Self { subscriber, _cell: cell })
    }

    /// Waits until the file of `episode` is closed, up to 10 s; `None` if no recorder reports anything about it.
    pub fn wait(&self, episode: u64) -> Option<Recorded> {
        let until = Instant::now() + FILE_CLOSED;
        while Instant::now() < until {
            while let Ok(Some(report)) = self.subscriber.receive() {
                if report.episode != episode {
                    continue;
                }
                match RecorderState::from_code(report.state) {
                    RecorderState::Writing => {}
                    RecorderState::Complete => return Some(Recorded { file: Ok(report.text().into()) }),
                    RecorderState::Failed => return Some(Recorded { file: Err(report.text().into()) }),
                }
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        None
    }
}
