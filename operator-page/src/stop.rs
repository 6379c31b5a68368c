//! Stop: the way to end a motion that depends on nothing else of the page.
//!
//! It asks at the controller's stop socket, which needs no shared memory. If nobody answers there, it starts `rt-controller abort`, which
//! also ends a controller that hangs. Threads of their own run it; it allocates and waits a moment at most. A refusal is a line.

use std::path::PathBuf;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use rt_controller::stop_client::Target;
use shared::runtime_dir::Place;

use crate::programs::program;

/// Longest wait for `rt-controller abort`. Chosen by hand: it says at once when no controller runs, and goes on by itself after this.
const FALLBACK: Duration = Duration::from_secs(5);

/// Stops the motion of one cell.
pub struct Stopper {
    place: Place,
    config: PathBuf,
}

impl Stopper {
    /// For the cell of a configuration.
    pub fn new(place: Place, config: PathBuf) -> Self {
        Self { place, config }
    }

    /// Stops. Gives one line: what happens now, or why nothing can be stopped.
    pub fn stop(&self) -> Result<String, String> {
        match Target::from(self.place.clone()).ask("abort") {
            Some(answer) if answer.refused.is_empty() => Ok("stopping: the container comes upright".into()),
            Some(answer) => Err(answer.refused),
            None => self.fall_back(),
        }
    }

    fn fall_back(&self) -> Result<String, String> {
        let path = program("rt-controller");
        let mut command = Command::new(&path);
        command.arg("abort").arg("--config").arg(&self.config).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let mut child = command.spawn().map_err(|e| format!("{}: {e}; use the robot's own stop", path.display()))?;
        let until = Instant::now() + FALLBACK;
        while Instant::now() < until {
            match child.try_wait() {
                Ok(Some(status)) => {
                    // It says itself whether the container is upright, or the robot must be looked at.
                    let output = child.wait_with_output().map_err(|e| format!("rt-controller abort: {e}; look at the robot"))?;
                    let said = if status.success() { output.stdout } else { output.stderr };
                    let said = String::from_utf8_lossy(&said).trim().trim_start_matches("error: ").to_string();
                    return if status.success() { Ok(said) } else { Err(said) };
                }
                _ => std::thread::sleep(FALLBACK / 100),
            }
        }
        // It goes on by itself; somebody waits for its end.
        let _ = std::thread::Builder::new().name("abort".into()).spawn(move || child.wait());
        Ok("the controller does not answer; `rt-controller abort` ends it: look at the robot".into())
    }
}
