//! The thread that connects the robot: it checks the robot, uploads the program, hands the session over to the loop, and takes back
//! sessions that are over.
//!
//! Runs in a thread of its own with ordinary scheduling, because connecting blocks for seconds; allocates. Every failure to connect is
//! shown as a line and tried again a second later; nothing here ends the controller.

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};
use std::time::{Duration, Instant};

use shared::config::Config;

use crate::exchange::Exchange;
use crate::link::{self, LinkOptions};

/// Pause between two checks for sessions that the loop has given back. Chosen by hand; no measurement is recorded.
const BEAT: Duration = Duration::from_millis(100);
/// Pause before the next attempt to reach the robot. Chosen by hand; no measurement is recorded.
const RECONNECT: Duration = Duration::from_secs(1);

/// What the robot's thread has to say to operators; empty while the robot is connected.
#[derive(Debug, Default)]
pub struct RobotNote(Mutex<String>);

impl RobotNote {
    /// Sets the note, and prints it if it is new.
    fn set(&self, text: String, say: &dyn Fn(&str)) {
        let mut note = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if *note != text {
            if !text.is_empty() {
                say(&text);
            }
            *note = text;
        }
    }

    /// The newest note.
    pub fn get(&self) -> String {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }
}

/// Connects the robot whenever the loop has none, and hands it over, until `stop`. `note` and `connections` tell `status` about it,
/// `say` the terminal.
pub fn keep_robot_connected(
    config: &Config,
    exchange: &Exchange,
    note: &RobotNote,
    connections: &AtomicU64,
    stop: &AtomicBool,
    say: &dyn Fn(&str),
) {
    let options = LinkOptions::new(config);
    let mut connected = false;
    let mut next = Instant::now();
    while !stop.load(Relaxed) {
        while let Some((session, end)) = exchange.old_sessions.pop() {
            drop(session);
            note.set(format!("robot: {end}"), say);
            connected = false;
            next = Instant::now() + RECONNECT;
        }
        if !connected && Instant::now() >= next {
            match link::connect(&options) {
                Ok(session) => {
                    connected = exchange.sessions.push(Box::new(session)).is_ok();
                    connections.fetch_add(1, Relaxed);
                    note.set(String::new(), say);
                    say("robot connected, program running");
                }
                Err(e) => {
                    note.set(e.to_string(), say);
                    next = Instant::now() + RECONNECT;
                }
            }
        }
        std::thread::sleep(BEAT);
    }
}
