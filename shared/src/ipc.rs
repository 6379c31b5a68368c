//! The iceoryx2 services of one cell, opened the same way by every process.
//!
//! A cell's files carry its name as prefix (`/dev/shm/decant_NAME_*`, `/tmp/decant_NAME/`), so cells beside each other never
//! meet. The layouts' version is part of each service's name. Opening allocates; receiving and sending a loan do not.
//! All processes of a cell run under one user, because the shared memory is private to it.

use std::path::PathBuf;

use iceoryx2::node::NodeBuilder;
use iceoryx2::port::listener::Listener;
use iceoryx2::port::notifier::Notifier;
use iceoryx2::prelude::*;
use iceoryx2::service::port_factory::{publish_subscribe, request_response};

use crate::messages::{FrameHeader, LAYOUT_VERSION};

/// Why a cell's shared memory cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum IpcError {
    /// The cell's name is not usable in file names.
    #[error("cell name '{0}': use 1 to 32 letters, digits, '-' or '_'")]
    Name(String),
    /// The node could not be made (permissions, no space, another user's files).
    #[error("shared memory of cell '{cell}': {what}; check that all processes run as the same user and that /dev/shm and /tmp have space")]
    Node {
        /// The cell's name.
        cell: String,
        /// iceoryx2's words.
        what: String,
    },
    /// A service exists with other types or limits, or has too many users.
    #[error("service '{service}': {what}; is another version of Decant running, or the same process twice?")]
    Service {
        /// The service's name.
        service: String,
        /// iceoryx2's words.
        what: String,
    },
}

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

/// Removes every file of the cell `name`, also what a killed process left. For whoever started the cell, when all of its
/// processes have ended; a cell that still runs would be torn apart. What cannot be removed stays.
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
        let legal = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        if name.is_empty() || name.len() > 32 || !name.chars().all(legal) {
            return Err(IpcError::Name(name.into()));
        }
        set_log_level(LogLevel::Fatal);
        let fail = |what: String| IpcError::Node { cell: name.into(), what };
        let mut config = Config::default();
        config.global.prefix = FileName::new(format!("decant_{name}_").as_bytes()).map_err(|e| fail(format!("{e:?}")))?;
        let root = Path::new(directory(name).as_os_str().as_encoded_bytes()).map_err(|e| fail(format!("{e:?}")))?;
        config.global.set_root_path(&root);
        // Each program handles its own signals; iceoryx2 shall not end a wait for good because of one.
        let node = NodeBuilder::new()
            .config(&config)
            .signal_handling_mode(SignalHandlingMode::Disabled)
            .create::<Ipc>()
            .map_err(|e| fail(format!("{e:?}")))?;
        Ok(Self { node })
    }

    fn name(&self, service: &str) -> Result<(ServiceName, String), IpcError> {
        let full = format!("decant/{service}/{LAYOUT_VERSION}");
        let name = ServiceName::new(&full).map_err(|e| IpcError::Service { service: full.clone(), what: format!("{e:?}") })?;
        Ok((name, full))
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
            .max_subscribers(8)
            .subscriber_max_buffer_size(64)
            .history_size(history)
            .enable_safe_overflow(true)
            .open_or_create()
            .map_err(|e| IpcError::Service { service: full, what: format!("{e:?}") })
    }

    /// Camera frames, from one driver, or from the feature worker that reads the camera itself; a reader that is late loses the oldest.
    pub fn frames(&self) -> Result<FrameTopic, IpcError> {
        let (name, full) = self.name("frame")?;
        self.node
            .service_builder(&name)
            .publish_subscribe::<[u8]>()
            .user_header::<FrameHeader>()
            .max_publishers(1)
            .max_subscribers(4)
            .subscriber_max_buffer_size(4)
            .history_size(0)
            .enable_safe_overflow(true)
            .open_or_create()
            .map_err(|e| IpcError::Service { service: full, what: format!("{e:?}") })
    }

    fn frame_event(&self) -> Result<iceoryx2::service::port_factory::event::PortFactory<Ipc>, IpcError> {
        let (name, full) = self.name("frame-event")?;
        self.node.service_builder(&name).event().open_or_create().map_err(|e| IpcError::Service { service: full, what: format!("{e:?}") })
    }

    /// Wakes up when a frame was published.
    pub fn frame_listener(&self) -> Result<FrameListener, IpcError> {
        self.frame_event()?
            .listener_builder()
            .create()
            .map_err(|e| IpcError::Service { service: "frame-event".into(), what: format!("{e:?}") })
    }

    /// For who publishes frames: call `notify()` after each.
    pub fn frame_notifier(&self) -> Result<FrameNotifier, IpcError> {
        self.frame_event()?
            .notifier_builder()
            .create()
            .map_err(|e| IpcError::Service { service: "frame-event".into(), what: format!("{e:?}") })
    }

    /// V_e of each frame, from one feature worker.
    pub fn features(&self) -> Result<Topic<crate::messages::Feature>, IpcError> {
        self.topic("feature", 1, 0)
    }

    /// Every tick of the controller.
    pub fn telemetry(&self) -> Result<Topic<crate::messages::Telemetry>, IpcError> {
        self.topic("telemetry", 1, 0)
    }

    /// What became of each episode's file; late readers get the newest 8.
    pub fn recorder(&self) -> Result<Topic<crate::messages::RecorderReport>, IpcError> {
        self.topic("recorder", 1, 8)
    }

    /// Requests to the controller.
    pub fn control(&self) -> Result<ControlService, IpcError> {
        let (name, full) = self.name("control")?;
        self.node
            .service_builder(&name)
            .request_response::<[u8], [u8]>()
            .max_servers(1)
            .max_clients(8)
            // One question at a time: what is not used would be locked in the controller's memory (64 KiB an answer).
            .max_active_requests_per_client(1)
            .max_loaned_requests(1)
            .max_response_buffer_size(1)
            .max_borrowed_responses_per_pending_response(1)
            .open_or_create()
            .map_err(|e| IpcError::Service { service: full, what: format!("{e:?}") })
    }
}
