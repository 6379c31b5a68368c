//! The iceoryx2 services of one cell, opened the same way by every process.
//!
//! A cell's files carry its name (`/dev/shm/decant_NAME_*`, `/tmp/decant_NAME/`), so that cells beside each other never meet. The
//! layouts' version is part of each service's name, so that programs of other versions never connect. All processes of a cell run
//! under one user, because the shared memory is private to that user.
//!
//! Opening a service allocates and belongs in an ordinary thread; receiving, and sending a loan, neither allocate nor block. Every
//! failure is an [`IpcError`] of one line.

use std::path::PathBuf;

use iceoryx2::node::NodeBuilder;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{publish_subscribe, request_response};

use crate::config::{CELL_NAME_RULE, is_cell_name};
use crate::messages::{FrameHeader, LAYOUT_VERSION};

/// Why a cell's shared memory cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum IpcError {
    /// The cell's name cannot be used in file names.
    #[error("cell name '{0}': use {CELL_NAME_RULE}")]
    Name(String),
    /// The cell could not be joined: missing permissions, no space, or another user's files.
    #[error("shared memory of cell '{cell}': {what}; check that all processes run as the same user and that /dev/shm and /tmp have space")]
    Node {
        /// The cell's name.
        cell: String,
        /// iceoryx2's name of the error.
        what: String,
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

/// Turns an error of iceoryx2 into an [`IpcError`].
pub trait InService<T> {
    /// The value, or an error that names `service`.
    fn in_service(self, service: &str) -> Result<T, IpcError>;
}

impl<T, E: std::fmt::Debug> InService<T> for Result<T, E> {
    fn in_service(self, service: &str) -> Result<T, IpcError> {
        self.map_err(|e| IpcError::Service { service: service.into(), what: format!("{e:?}") })
    }
}

/// Most readers of a topic. Chosen by hand; no measurement is recorded.
const SUBSCRIBERS_MAX: usize = 8;
/// Most messages that wait for a reader: two seconds of telemetry at 30 Hz.
const BUFFER_MAX: usize = 64;
/// Most readers of camera frames: worker, `view` and `calibrate`, and one more.
const FRAME_READERS_MAX: usize = 4;
/// Most frames that wait for a reader; each takes the memory of a whole picture.
const FRAMES_MAX: usize = 4;
/// Most clients that ask the controller at the same time. Chosen by hand; no measurement is recorded.
const CLIENTS_MAX: usize = 8;
/// Newest reports that a late reader of the recorder gets. Chosen by hand; no measurement is recorded.
const REPORTS_KEPT: usize = 8;

/// iceoryx2's kind of service: between processes.
type Ipc = iceoryx2::service::ipc::Service;
/// A cell's iceoryx2 node.
pub type CellNode = Node<Ipc>;
/// Publish/subscribe service of plain messages.
pub type Topic<T> = publish_subscribe::PortFactory<Ipc, T, ()>;
/// Camera frames: pixels with a [`FrameHeader`].
pub type FrameTopic = publish_subscribe::PortFactory<Ipc, [u8], FrameHeader>;
/// Requests and answers as postcard bytes, see [`crate::control`].
pub type ControlService = request_response::PortFactory<Ipc, [u8], (), [u8], ()>;
/// Wakes a reader of frames when one is there.
pub type FrameListener = Listener<Ipc>;
/// Tells the readers that a frame is there.
pub type FrameNotifier = Notifier<Ipc>;

/// Directory of the cell `name` for what is not shared memory.
pub fn directory(name: &str) -> PathBuf {
    PathBuf::from(format!("/tmp/decant_{name}"))
}

/// Removes every file of the cell `name`, also those that a killed process left. Only the process that started the cell may call this,
/// after all of its processes have ended; a cell that still runs would be torn apart. What cannot be removed stays.
pub fn remove_files(name: &str) {
    let prefix = format!("decant_{name}_");
    for entry in std::fs::read_dir("/dev/shm").into_iter().flatten().flatten() {
        if entry.file_name().to_string_lossy().starts_with(&prefix) {
            let _ = std::fs::remove_file(entry.path());
        }
    }
    let _ = std::fs::remove_dir_all(directory(name));
}

/// One cell's services.
pub struct Cell {
    node: CellNode,
}

impl Cell {
    /// Joins the shared memory of the cell `name` (see `[cell] name` in the configuration).
    pub fn join(name: &str) -> Result<Self, IpcError> {
        if !is_cell_name(name) {
            return Err(IpcError::Name(name.into()));
        }
        set_log_level(LogLevel::Fatal);
        let fail = |what: String| IpcError::Node { cell: name.into(), what };
        let mut config = Config::default();
        config.global.prefix = FileName::new(format!("decant_{name}_").as_bytes()).map_err(|e| fail(format!("{e:?}")))?;
        let root = Path::new(directory(name).as_os_str().as_encoded_bytes()).map_err(|e| fail(format!("{e:?}")))?;
        config.global.set_root_path(&root);
        // Each program handles its own signals; so iceoryx2 must not end its waits for good because of one.
        let node = NodeBuilder::new()
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Ipc>()
            .map_err(|e| fail(format!("{e:?}")))?;
        Ok(Self { node })
    }

    /// The full name of a service, with the layouts' version.
    fn name(&self, service: &str) -> Result<(ServiceName, String), IpcError> {
        let full = format!("decant/{service}/{LAYOUT_VERSION}");
        Ok((ServiceName::new(&full).in_service(&full)?, full))
    }

    fn topic<T: ZeroCopySend + std::fmt::Debug + 'static>(
        &self,
        service: &str,
        publishers: usize,
        history: usize,
    ) -> Result<Topic<T>, IpcError> {
        let (name, full) = self.name(service)?;
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
        let (name, full) = self.name("frame")?;
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
        let (name, full) = self.name("frame-event")?;
        self.node.service_builder(&name).event().open_or_create().in_service(&full)
    }

    /// Wakes a reader when a frame was published.
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
        let (name, full) = self.name("control")?;
        self.node
            .service_builder(&name)
            .request_response::<[u8], [u8]>()
            .max_servers(1)
            .max_clients(CLIENTS_MAX)
            // One question at a time: each further answer would lock 64 KiB of the controller's memory.
            .max_active_requests_per_client(1)
            .max_loaned_requests(1)
            .max_response_buffer_size(1)
            .max_borrowed_responses_per_pending_response(1)
            .open_or_create()
            .in_service(&full)
    }
}
