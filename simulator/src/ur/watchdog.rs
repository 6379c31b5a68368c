//! The watchdogs that a program sets with `rtde_set_watchdog`: each one lapses when its input variable gets no update in time.
//!
//! Pure. Runs on the controller's thread; allocates one entry for each watched input. It only finds that a watchdog lapsed;
//! what follows is up to [`super::program`].

use std::str::FromStr;

use super::variables::Input;

/// What happens to the program when a watchdog lapses.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum WatchdogAction {
    /// Nothing happens.
    Ignore,
    /// The program is paused.
    Pause,
    /// The program ends.
    Stop,
}

impl FromStr for WatchdogAction {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "ignore" => Ok(Self::Ignore),
            "pause" => Ok(Self::Pause),
            "stop" => Ok(Self::Stop),
            other => Err(format!("watchdog action \"{other}\" is none of ignore, pause, stop")),
        }
    }
}

/// One watchdog; times are control cycles.
#[derive(Debug, Clone, Copy)]
pub struct Watchdog {
    /// The input whose updates it waits for.
    pub input: Input,
    /// What happens when it lapses.
    pub action: WatchdogAction,
    /// It lapses when more cycles than this pass without an update. The number need not be whole.
    max_cycles: f64,
    /// Cycle from which it counts when no update came since.
    since: u64,
}

/// All watchdogs of the running program, and when each input was last written.
#[derive(Debug)]
pub struct Watchdogs {
    set: Vec<Watchdog>,
    updated_at: [u64; Input::SLOTS],
}

impl Default for Watchdogs {
    fn default() -> Self {
        Self { set: Vec::new(), updated_at: [0; Input::SLOTS] }
    }
}

impl Watchdogs {
    /// Watches `input` from the cycle `now` on. An existing watchdog of the same input is replaced.
    pub fn set(&mut self, input: Input, max_cycles: f64, action: WatchdogAction, now: u64) {
        self.set.retain(|w| w.input != input);
        self.set.push(Watchdog { input, action, max_cycles, since: now });
    }

    /// Notes that a client wrote `input` in the cycle `now`. The value need not have changed.
    pub fn updated(&mut self, input: Input, now: u64) {
        self.updated_at[input.slot()] = now;
    }

    /// Lets all watchdogs count from the cycle `now` on, because the program stood still before.
    pub fn restart(&mut self, now: u64) {
        self.set.iter_mut().for_each(|w| w.since = now);
    }

    /// Removes all watchdogs; a robot does so when a program ends.
    pub fn clear(&mut self) {
        self.set.clear();
    }

    /// The first watchdog that has lapsed at the cycle `now` and whose action is not [`WatchdogAction::Ignore`].
    pub fn lapsed(&self, now: u64) -> Option<Watchdog> {
        let lapsed = |w: &&Watchdog| (now - self.updated_at[w.input.slot()].max(w.since)) as f64 > w.max_cycles;
        self.set.iter().filter(|w| w.action != WatchdogAction::Ignore).find(lapsed).copied()
    }
}
