//! What a resident process tells the service manager that started it: that it is ready, that its work goes on, and that it ends.
//!
//! systemd listens if it started the process as a service (`Type=notify`, `WatchdogSec=`); otherwise nothing is told. An ordinary thread
//! calls this; it allocates, and may wait for systemd. Nothing here fails: who cannot be told is not told.

use std::time::{Duration, Instant};

use sd_notify::NotifyState;

/// How many times within `WatchdogSec=` the process says that its work goes on. Chosen by hand: systemd's manual asks for two.
const TIMES: u32 = 4;

/// Tells the service manager about this process.
#[derive(Debug)]
pub struct Supervisor {
    /// Time from one sign of life to the next; `None` if nobody waits for them.
    every: Option<Duration>,
    told_at: Instant,
    /// What had been done at the last sign of life.
    done: u64,
}

impl Supervisor {
    /// Says that the process is ready.
    pub fn ready() -> Self {
        let _ = sd_notify::notify(&[NotifyState::Ready]);
        Self { every: sd_notify::watchdog_enabled().map(|limit| limit / TIMES), told_at: Instant::now(), done: 0 }
    }

    /// Says that the work goes on if `done`, a number that grows with the work, has grown since it was said before.
    pub fn progress(&mut self, done: u64) {
        if self.every.is_some_and(|every| self.told_at.elapsed() >= every) && done != self.done {
            let _ = sd_notify::notify(&[NotifyState::Watchdog]);
            (self.told_at, self.done) = (Instant::now(), done);
        }
    }
}

impl Drop for Supervisor {
    fn drop(&mut self) {
        let _ = sd_notify::notify(&[NotifyState::Stopping]);
    }
}
