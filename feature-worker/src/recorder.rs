//! Writes episodes (section 3.1 of the paper) in a thread of its own.
//!
//! The worker hands each frame over with [`Recorder::offer`], which never waits. The recorder's thread (`writing`) follows the
//! controller's telemetry, opens a file when an episode begins, compresses and writes its frames, and closes the file when the last
//! frame of the episode has come. It reports on the service `recorder`. A full or slow disk costs that episode's file or some of its
//! images and nothing else: the next episode tries again. None is begun when the disk has less free than `LEAST_FREE`, or takes no more files. Nothing is
//! ever deleted here; what is not recorded, and a directory over its budget, is said.

use std::sync::{Arc, mpsc};
use std::thread::JoinHandle;

use shared::config::Config;
use shared::disk_space::error_words;
use shared::ipc::IpcError;
use shared::level::Level;
use shared::messages::{Feature, FrameHeader};

mod encoder;
mod handover;
mod writing;

use handover::Handover;
use writing::RecorderThread;

/// Why the recorder cannot start.
#[derive(Debug, thiserror::Error)]
pub enum RecorderError {
    /// The directory cannot be made or used.
    #[error("recording.directory = {directory}: {what}; name a directory that can be written")]
    Directory {
        /// The directory.
        directory: String,
        /// The system's words.
        what: String,
    },
    /// Shared memory cannot be used.
    #[error(transparent)]
    Ipc(#[from] IpcError),
    /// No thread could be started.
    #[error("recorder: no thread could be started: {0}")]
    Thread(std::io::Error),
}

/// The recorder, as the worker's loop sees it. Dropping it closes the file under way.
pub struct Recorder {
    handover: Arc<Handover>,
    thread: Option<JoinHandle<()>>,
}

impl Recorder {
    /// Starts the recorder's thread. Call it before the calling thread takes a real-time priority or pins itself, because
    /// a thread inherits both. `say` gets a line for what is not recorded, and for what is over its budget.
    pub fn start(config: &Config, say: impl Fn(Level, &str) + Send + 'static) -> Result<Self, RecorderError> {
        let directory = &config.recording.directory;
        let fail = |e: std::io::Error| RecorderError::Directory { directory: directory.display().to_string(), what: error_words(&e) };
        std::fs::create_dir_all(directory).map_err(fail)?;
        let directory = directory.canonicalize().map_err(fail)?;

        let handover = Arc::new(Handover::new(config));
        let (started, answer) = mpsc::channel();
        let (its_config, its_handover) = (config.clone(), handover.clone());
        let thread = std::thread::Builder::new()
            .name("recorder".into())
            .spawn(move || match RecorderThread::new(its_config, directory, its_handover, Box::new(say)) {
                Ok(mut recorder) => {
                    let _ = started.send(Ok(()));
                    recorder.run();
                }
                Err(e) => {
                    let _ = started.send(Err(e));
                }
            })
            .map_err(RecorderError::Thread)?;
        let this = Self { handover, thread: Some(thread) };
        match answer.recv() {
            Ok(Ok(())) => Ok(this),
            Ok(Err(e)) => Err(e.into()),
            Err(_) => Err(RecorderError::Thread(std::io::Error::other("it ended at once"))),
        }
    }

    /// Hands a frame with its feature to the recorder. Never waits and never allocates. It costs one copy of the pixels, so call it
    /// after the feature is published.
    pub fn offer(&self, header: &FrameHeader, pixels: &[u8], feature: &Feature) {
        self.handover.offer(header, pixels, feature);
    }

    /// Images that found no free buffer since the start, whether or not an episode was running.
    pub fn dropped(&self) -> u64 {
        self.handover.dropped()
    }

    /// Closes the file under way and ends the thread; the same as dropping it.
    pub fn stop(self) {}
}

impl Drop for Recorder {
    fn drop(&mut self) {
        self.handover.stop();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}
