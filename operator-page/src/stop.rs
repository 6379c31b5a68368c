//! Stop: the way to end a motion that depends on nothing else of the page.
//!
//! It asks at the controller's stop socket, which needs no shared memory. If nobody answers there, it starts `rt-controller abort`, which
//! also ends a controller that hangs; there is one at a time, and whoever stops meanwhile waits for the same. Threads of their own run it; it
//! allocates and waits at most `rt_controller`'s second and `FALLBACK`. A refusal is a line.

use std::path::PathBuf;
use std::process::{Command, Output, Stdio};
use std::sync::{Arc, Condvar, Mutex, PoisonError};
use std::time::{Duration, Instant};

use rt_controller::stop_client::Target;
use shared::runtime_dir::Place;

use crate::lock::locked;
use crate::programs::program;

/// Longest wait for `rt-controller abort`. Chosen by hand: it says at once when no controller runs, and goes on by itself after this.
const FALLBACK: Duration = Duration::from_secs(5);

/// Stops the motion of one cell.
pub struct Stopper {
    place: Place,
    config: PathBuf,
    program: PathBuf,
    /// The `rt-controller abort` under way.
    under_way: Arc<Mutex<Option<Arc<Abort>>>>,
}

/// One run of `rt-controller abort`.
struct Abort {
    until: Instant,
    /// What it said; none while it runs.
    said: Mutex<Option<Result<String, String>>>,
    over: Condvar,
}

impl Stopper {
    /// For the cell of a configuration.
    pub fn new(place: Place, config: PathBuf) -> Self {
        Self::with(place, config, program("rt-controller"))
    }

    /// Falls back on this `rt-controller`.
    fn with(place: Place, config: PathBuf, program: PathBuf) -> Self {
        Self { place, config, program, under_way: Arc::default() }
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
        let abort = self.abort()?;
        let wait = abort.until.saturating_duration_since(Instant::now());
        let said = abort.over.wait_timeout_while(locked(&abort.said), wait, |said| said.is_none());
        let said = said.unwrap_or_else(PoisonError::into_inner).0.clone();
        // Without an answer it goes on by itself.
        said.unwrap_or_else(|| Ok("the controller does not answer; `rt-controller abort` ends it: look at the robot".into()))
    }

    /// The `rt-controller abort` under way; if there is none, it is started.
    fn abort(&self) -> Result<Arc<Abort>, String> {
        let mut under_way = locked(&self.under_way);
        if let Some(abort) = under_way.as_ref() {
            return Ok(Arc::clone(abort));
        }
        let fail = |e: std::io::Error| format!("{}: {e}; use the robot's own stop", self.program.display());
        let mut command = Command::new(&self.program);
        command.arg("abort").arg("--config").arg(&self.config).stdin(Stdio::null()).stdout(Stdio::piped()).stderr(Stdio::piped());
        let child = command.spawn().map_err(fail)?;
        let abort = Arc::new(Abort { until: Instant::now() + FALLBACK, said: Mutex::default(), over: Condvar::new() });
        let (this, all) = (Arc::clone(&abort), Arc::clone(&self.under_way));
        let wait = move || {
            let said = child.wait_with_output().map_or_else(|e| Err(format!("rt-controller abort: {e}; look at the robot")), words);
            *locked(&all) = None;
            *locked(&this.said) = Some(said);
            this.over.notify_all();
        };
        // Without a thread the program goes on by itself, and nobody hears what it says.
        std::thread::Builder::new().name("abort".into()).spawn(wait).map_err(fail)?;
        *under_way = Some(Arc::clone(&abort));
        Ok(abort)
    }
}

/// What `rt-controller abort` says: whether the container is upright, or the robot must be looked at.
fn words(output: Output) -> Result<String, String> {
    let good = output.status.success();
    let said = if good { output.stdout } else { output.stderr };
    let said = String::from_utf8_lossy(&said).trim().trim_start_matches("error: ").to_string();
    if good { Ok(said) } else { Err(said) }
}

#[cfg(test)]
mod tests {
    use std::os::unix::fs::PermissionsExt as _;

    use super::*;

    /// Protects whoever presses Stop again and again beside a controller that hangs: one `rt-controller abort` is under way, all presses get its
    /// answer, and a press after it starts another one.
    #[test]
    fn one_abort_at_a_time() {
        let dir = tempfile::tempdir().unwrap();
        let (script, begun) = (dir.path().join("rt-controller"), dir.path().join("begun"));
        std::fs::write(&script, format!("#!/bin/sh\necho x >> {}\nsleep 1\necho upright\n", begun.display())).unwrap();
        std::fs::set_permissions(&script, std::fs::Permissions::from_mode(0o700)).unwrap();
        let place = Place { name: "nobody".into(), base: Some(dir.path().into()) };
        let stopper = Stopper::with(place, dir.path().join("cell.toml"), script);
        let count = || std::fs::read_to_string(&begun).unwrap().lines().count();
        std::thread::scope(|scope| {
            let presses: Vec<_> = (0..5).map(|_| scope.spawn(|| stopper.stop())).collect();
            for press in presses {
                assert_eq!(press.join().unwrap(), Ok("upright".into()));
            }
        });
        assert_eq!(count(), 1);
        assert_eq!((stopper.stop(), count()), (Ok("upright".into()), 2));
    }
}
