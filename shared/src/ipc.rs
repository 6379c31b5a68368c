//! The iceoryx2 services of one cell, opened the same way by every process.
//!
//! A cell's files lie in its runtime directory ([`crate::runtime_dir`]) and, under a name that nobody can guess, in `/dev/shm`
//! ([`crate::shared_memory`]), so that cells beside each other never meet. The messages' version is part of each service's name, so that
//! programs of other versions never connect. All processes of a cell run under one user, because the shared memory is private to that user.
//!
//! Opening a service allocates and belongs in an ordinary thread. Receiving a message, or sending one in loaned memory, neither allocates
//! nor blocks. Every failure is an [`IpcError`] of one line.

use iceoryx2::node::NodeBuilder;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{publish_subscribe, request_response};

use crate::control::CONTROL_VERSION;
use crate::exit::{self, Failure, failure};
use crate::messages::{FrameHeader, LAYOUT_VERSION};
use crate::runtime_dir::{Place, RuntimeDirError};
use crate::shared_memory::{self, Membership, SharedMemoryError};

/// Why a cell's shared memory cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum IpcError {
    /// The cell's runtime directory cannot be used.
    #[error(transparent)]
    Directory(#[from] RuntimeDirError),
    /// There is no space, or files are in the way.
    #[error("cell '{cell}': {what}")]
    Memory {
        /// The cell's name.
        cell: String,
        /// What is wrong.
        what: SharedMemoryError,
    },
    /// The cell could not be joined.
    #[error("shared memory of cell '{cell}': {what}; do all processes run as the same user, and has /dev/shm space?")]
    Node {
        /// The cell's name.
        cell: String,
        /// iceoryx2's name of the error.
        what: String,
    },
    /// As many programs use a service as it has room for.
    #[error("service '{service}' of the cell has no room for another program: end one that uses it (`rt-controller abort` needs no room)")]
    Full {
        /// The service's name.
        service: String,
    },
    /// A service exists with other types or limits, or has too many users.
    #[error("service '{service}': {what}; is another version of Decant running, or the same process twice?")]
    Service {
        /// The service's name.
        service: String,
        /// iceoryx2's name of the error.
        what: String,
    },
}

impl From<IpcError> for Failure {
    /// The failure of a command that meets this error: all of them end with one exit code for one cause.
    fn from(e: IpcError) -> Self {
        let code = if matches!(e, IpcError::Directory(_)) { exit::BAD_INPUT } else { exit::UNREACHABLE };
        failure(code, e)
    }
}

/// Turns an error of iceoryx2 into an [`IpcError`].
pub trait InService<T> {
    /// The value, or an error that names `service`.
    fn in_service(self, service: &str) -> Result<T, IpcError>;
}

impl<T, E: std::fmt::Debug> InService<T> for Result<T, E> {
    fn in_service(self, service: &str) -> Result<T, IpcError> {
        self.map_err(|e| {
            let what = format!("{e:?}");
            // iceoryx2's names of this error begin alike for all kinds of ports and for nodes.
            let full = ["ExceedsMaxSupportedClients", "ExceedsMaxSupportedSubscribers", "ExceedsMaxNumberOfNodes"];
            if full.iter().any(|f| what.contains(f)) {
                return IpcError::Full { service: service.into() };
            }
            IpcError::Service { service: service.into(), what }
        })
    }
}

/// Largest number of readers of a topic. Chosen by hand; no measurement is recorded.
const SUBSCRIBERS_MAX: usize = 8;
/// Largest number of messages that wait for a reader: two seconds of telemetry at 30 Hz.
const BUFFER_MAX: usize = 64;
/// Largest number of readers of camera frames: worker, `view`, `calibrate`, and one more.
const FRAME_READERS_MAX: usize = 4;
/// Largest number of frames that wait for a reader. Chosen by hand: each takes the memory of a whole picture.
const FRAMES_MAX: usize = 4;
/// Largest number of clients that ask the controller at the same time. Chosen by hand; no measurement is recorded.
const CLIENTS_MAX: usize = 8;
/// Number of the recorder's newest reports that a late reader gets. Chosen by hand; no measurement is recorded.
const REPORTS_KEPT: usize = 8;

/// The kind of iceoryx2 service that works between processes.
type Ipc = iceoryx2::service::ipc::Service;
/// A cell's iceoryx2 node.
pub type CellNode = Node<Ipc>;
/// Publish/subscribe service of plain messages.
pub type Topic<T> = publish_subscribe::PortFactory<Ipc, T, ()>;
/// Camera frames: pixels with a [`FrameHeader`].
pub type FrameTopic = publish_subscribe::PortFactory<Ipc, [u8], FrameHeader>;
/// Requests and answers as postcard bytes, see [`crate::control`].
pub type ControlService = request_response::PortFactory<Ipc, [u8], (), [u8], ()>;
/// Wakes a reader of frames when a frame has come.
pub type FrameListener = Listener<Ipc>;
/// Tells the readers that a frame has come.
pub type FrameNotifier = Notifier<Ipc>;

/// Removes every file of the cell `place`, also those that a killed process left. Only whoever started the cell may call this, after all of
/// its processes have ended; a cell that still runs would be torn apart. What cannot be removed stays.
pub fn remove_files(place: impl Into<Place>) {
    let directory = place.into().path();
    shared_memory::remove_of(&directory);
    let _ = std::fs::remove_dir_all(directory);
}

/// Who publishes in a cell that runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Publishers {
    /// A camera driver, a simulated camera, or a worker with a camera of its own.
    pub frames: bool,
    /// A feature worker.
    pub features: bool,
}

/// Who publishes in the cell `place`; `None` if no process of it is seen to run. Such a cell is not joined, so that a look makes no files.
pub fn publishers(place: impl Into<Place>) -> Result<Option<Publishers>, IpcError> {
    let place = place.into();
    if !shared_memory::is_in_use(&place.check()?) {
        return Ok(None);
    }
    // Joining clears what dead programs left, so that one that was killed does not count.
    let cell = Cell::join(place)?;
    let frames = cell.frames()?.dynamic_config().number_of_publishers() > 0;
    let features = cell.features()?.dynamic_config().number_of_publishers() > 0;
    Ok(Some(Publishers { frames, features }))
}

/// One cell's services.
pub struct Cell {
    node: CellNode,
    name: String,
    // Declared last: the files go when the node has gone.
    membership: Membership,
}

impl Cell {
    /// Joins the shared memory of the cell `place`: the table `[cell]` of the configuration, or a name.
    pub fn join(place: impl Into<Place>) -> Result<Self, IpcError> {
        let place = place.into();
        let directory = place.directory()?;
        let name = place.name;
        let membership = Membership::join(&directory).map_err(|what| IpcError::Memory { cell: name.clone(), what })?;
        set_log_level(LogLevel::Fatal);
        let fail = |what: String| IpcError::Node { cell: name.clone(), what };
        // iceoryx2 would look for a configuration file in the working directory; this one is complete.
        let mut config = Config::default();
        config.global.prefix = FileName::new(membership.prefix().as_bytes()).map_err(|e| fail(format!("{e:?}")))?;
        let root = Path::new(directory.as_os_str().as_encoded_bytes()).map_err(|e| fail(format!("{e:?}")))?;
        config.global.set_root_path(&root);
        // Each program handles its own signals, so iceoryx2 must not end a wait for good because of one.
        let node = NodeBuilder::new()
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Ipc>()
            .map_err(|e| fail(format!("{e:?}")))?;
        membership.close_to_others();
        Ok(Self { node, name, membership })
    }

    /// Has the system set memory aside for what was made in `/dev/shm` since this process joined. Call it when the ports are made and before
    /// they are used, so that a full `/dev/shm` is an error and not the end of the process.
    pub fn reserve(&self) -> Result<(), IpcError> {
        self.membership.reserve().map_err(|what| IpcError::Memory { cell: self.name.clone(), what })
    }

    /// Checks that `bytes` more fit into `/dev/shm`.
    pub fn check_space(&self, bytes: u64) -> Result<(), IpcError> {
        shared_memory::check_space(bytes).map_err(|what| IpcError::Memory { cell: self.name.clone(), what })
    }

    /// The full name of a service, with the version of its messages.
    fn name(&self, service: &str, version: u32) -> Result<(ServiceName, String), IpcError> {
        let full = format!("decant/{service}/{version}");
        Ok((ServiceName::new(&full).in_service(&full)?, full))
    }

    fn topic<T: ZeroCopySend + std::fmt::Debug + 'static>(
        &self,
        service: &str,
        publishers: usize,
        history: usize,
    ) -> Result<Topic<T>, IpcError> {
        let (name, full) = self.name(service, LAYOUT_VERSION)?;
        self.node
            .service_builder(&name)
            .publish_subscribe::<T>()
            .max_publishers(publishers)
            .max_subscribers(SUBSCRIBERS_MAX)
            .subscriber_max_buffer_size(BUFFER_MAX)
            .history_size(history)
            .enable_safe_overflow(true)
            .open_or_create()
            .in_service(&full)
    }

    /// Camera frames, from one driver, or from the feature worker that reads the camera itself. A slow reader loses the oldest ones.
    pub fn frames(&self) -> Result<FrameTopic, IpcError> {
        let (name, full) = self.name("frame", LAYOUT_VERSION)?;
        self.node
            .service_builder(&name)
            .publish_subscribe::<[u8]>()
            .user_header::<FrameHeader>()
            .max_publishers(1)
            .max_subscribers(FRAME_READERS_MAX)
            .subscriber_max_buffer_size(FRAMES_MAX)
            .history_size(0)
            .enable_safe_overflow(true)
            .open_or_create()
            .in_service(&full)
    }

    fn frame_event(&self) -> Result<iceoryx2::service::port_factory::event::PortFactory<Ipc>, IpcError> {
        let (name, full) = self.name("frame-event", LAYOUT_VERSION)?;
        self.node.service_builder(&name).event().open_or_create().in_service(&full)
    }

    /// A listener that wakes its reader when a frame was published.
    pub fn frame_listener(&self) -> Result<FrameListener, IpcError> {
        self.frame_event()?.listener_builder().create().in_service("frame-event")
    }

    /// The other side of [`Cell::frame_listener`]: whoever publishes frames calls `notify()` after each.
    pub fn frame_notifier(&self) -> Result<FrameNotifier, IpcError> {
        self.frame_event()?.notifier_builder().create().in_service("frame-event")
    }

    /// V_e of each frame, from one feature worker.
    pub fn features(&self) -> Result<Topic<crate::messages::Feature>, IpcError> {
        self.topic("feature", 1, 0)
    }

    /// Every tick of the controller.
    pub fn telemetry(&self) -> Result<Topic<crate::messages::Telemetry>, IpcError> {
        self.topic("telemetry", 1, 0)
    }

    /// What became of each episode's file; late readers get the newest reports.
    pub fn recorder(&self) -> Result<Topic<crate::messages::RecorderReport>, IpcError> {
        self.topic("recorder", 1, REPORTS_KEPT)
    }

    /// Requests to the controller and its answers.
    pub fn control(&self) -> Result<ControlService, IpcError> {
        let (name, full) = self.name("control", CONTROL_VERSION)?;
        self.node
            .service_builder(&name)
            .request_response::<[u8], [u8]>()
            .max_servers(1)
            .max_clients(CLIENTS_MAX)
            // A client asks one question at a time, because each further answer would lock 64 KiB of the controller's memory.
            .max_active_requests_per_client(1)
            .max_loaned_requests(1)
            .max_response_buffer_size(1)
            .max_borrowed_responses_per_pending_response(1)
            .open_or_create()
            .in_service(&full)
    }
}
