//! The thread that connects the robot: it checks the robot, uploads the program, hands the session over to the loop, and takes back
//! sessions that are over.
//!
//! It runs in a thread of its own with ordinary scheduling, because connecting blocks for seconds; it allocates. Every failure to connect
//! is shown as a line and tried again a second later; nothing here ends the controller. A robot that a person has, or had, in hand is not
//! tried again, but left alone until the operator asks for it ([`Exchange::resume`]); what counts as that is in [`hands`].

use std::sync::atomic::{AtomicBool, AtomicU64, Ordering::Relaxed};
use std::sync::{Mutex, PoisonError};
use std::time::Duration;

use shared::config::Config;
use shared::control::{EndReason, RobotLink};
use shared::level::Level;

use crate::exchange::{Exchange, SessionEnd};
use crate::link::hands::{self, Before, Handover};
use crate::link::network::Network;
use crate::link::{self, LinkError, LinkOptions, Session, payload};

/// How often the thread looks whether the loop has given a session back. Chosen by hand; no measurement is recorded.
const BEAT: Duration = Duration::from_millis(100);
/// Pause before the next attempt to reach the robot. Chosen by hand; no measurement is recorded.
const RECONNECT: Duration = Duration::from_secs(1);
/// How long the operator's wish for the robot counts, while it cannot be reached for other reasons than a person. Chosen by hand; no
/// measurement is recorded.
const WISH: Duration = Duration::from_secs(10);

/// What the robot's thread has to say to operators.
#[derive(Debug, Default)]
pub struct RobotNote(Mutex<Note>);

/// A note's contents.
#[derive(Debug, Default, Clone)]
pub struct Note {
    /// Why the robot is not connected, one line; empty while it is.
    pub text: String,
    /// Who has the robot.
    pub link: RobotLink,
    /// What is doubtful about the robot's settings, one line; empty if nothing is.
    pub warning: String,
}

impl RobotNote {
    /// Sets the note, and says its lines if they are new ones.
    fn set(&self, text: String, link: RobotLink, say: &dyn Fn(Level, &str)) {
        let mut note = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        note.link = link;
        if note.text != text {
            if !text.is_empty() {
                say(Level::Warning, &text);
            }
            note.text = text;
        }
    }

    /// Sets the doubt about the robot's settings, and says it.
    fn warn(&self, warning: String, say: &dyn Fn(Level, &str)) {
        if !warning.is_empty() {
            say(Level::Warning, &warning);
        }
        self.0.lock().unwrap_or_else(PoisonError::into_inner).warning = warning;
    }

    /// The newest note.
    pub fn get(&self) -> Note {
        self.0.lock().unwrap_or_else(PoisonError::into_inner).clone()
    }

    /// Takes note that the operator asks for the robot, before the thread has seen it.
    pub fn asked(&self) {
        let mut note = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if note.link == RobotLink::WaitsForOperator {
            note.link = RobotLink::Connecting;
        }
    }
}

/// What the thread knows while it goes on.
struct Progress {
    /// What is known of the robot from before.
    before: Before,
    /// Whether the loop has a session.
    connected: bool,
    /// Whether the operator must ask first.
    waits: bool,
    /// Whether a program was there, running or paused, when the robot was last seen.
    program_there: bool,
    /// Until when the operator's wish counts, ns.
    wish_until_ns: Option<u64>,
    /// When the next attempt is due, ns.
    next_ns: u64,
}

/// Connects the robot over `network` whenever the loop has none and no person has it in hand, and hands it over, until `stop`. `note` and `connections` tell
/// `status` about it, `say` the terminal.
pub fn keep_robot_connected(
    network: &dyn Network,
    config: &Config,
    exchange: &Exchange,
    note: &RobotNote,
    connections: &AtomicU64,
    stop: &AtomicBool,
    say: &dyn Fn(Level, &str),
) {
    let mut progress = Progress {
        before: Before::default(),
        connected: false,
        waits: false,
        program_there: false,
        wish_until_ns: None,
        next_ns: network.now_ns(),
    };
    while !stop.load(Relaxed) {
        let now_ns = network.now_ns();
        // Who asks for a robot that the controller has, asks for nothing: if the session is over, that came before or after, and nobody knows.
        let asked = exchange.resume.swap(false, Relaxed) && !progress.connected;
        while let Some((session, end)) = exchange.old_sessions.pop() {
            progress.take_back(now_ns, &session, end, config, note, say);
        }
        if asked {
            progress.waits = false;
            progress.wish_until_ns = Some(now_ns + WISH.as_nanos() as u64);
            progress.before.ran = false;
            progress.next_ns = now_ns;
            // What an attempt said that ended just before must not stand for the one that was asked for.
            note.asked();
        }
        if !progress.connected && !progress.waits && now_ns >= progress.next_ns {
            progress.before.asked = progress.wish_until_ns.is_some_and(|until_ns| now_ns < until_ns);
            let named = network.resolve(&config.robot.address).map_err(|what| unknown_name(config, what));
            let connected = named.and_then(|address| link::connect_over(network, &LinkOptions::new(config, address), &mut progress.before));
            match connected {
                Ok(session) => {
                    note.warn(payload::warning(session.state(), config.robot.payload_kg).unwrap_or_default(), say);
                    progress.before.unpowered = false;
                    progress.wish_until_ns = None;
                    progress.connected = exchange.sessions.push(Box::new(session)).is_ok();
                    connections.fetch_add(1, Relaxed);
                    note.set(String::new(), RobotLink::Connected, say);
                    say(Level::Info, "robot connected, program running");
                }
                Err(e) => {
                    progress.failed(network.now_ns(), &e, config, note, say);
                    // The operator who asked during the attempt may have done so before what it saw, and is told what comes of the next one.
                    if exchange.resume.load(Relaxed) {
                        progress.before.looked = false;
                        note.asked();
                    }
                }
            }
        }
        network.sleep(BEAT);
    }
}

/// The failure of looking up the robot's name.
fn unknown_name(config: &Config, what: String) -> LinkError {
    LinkError::UnknownName { name: config.robot.address.to_string(), what }
}

impl Progress {
    /// Takes note of a session that is over. The session itself is dropped by the caller.
    fn take_back(&mut self, now_ns: u64, session: &Session, end: SessionEnd, config: &Config, note: &RobotNote, say: &dyn Fn(Level, &str)) {
        let last = *session.state();
        self.connected = false;
        self.before.unpowered |= hands::without_power(&last);
        self.before.last = Some(last);
        self.next_ns = now_ns + RECONNECT.as_nanos() as u64;
        // The program may go on, or bring the container upright, and nobody watches it.
        self.before.looked = false;
        self.program_there = hands::program_there(&self.before, &last);
        match hands::after_session(end.reason(), &last) {
            Some(why) => self.wait_for_operator(why, config, note, say),
            None => note.set(format!("robot: {end}"), RobotLink::Connecting, say),
        }
    }

    /// Takes note of an attempt that failed with `e`.
    fn failed(&mut self, now_ns: u64, e: &LinkError, config: &Config, note: &RobotNote, say: &dyn Fn(Level, &str)) {
        self.next_ns = now_ns + RECONNECT.as_nanos() as u64;
        let is_there = matches!(e, LinkError::ProgramRunning { .. } | LinkError::MayNotMove { program_there: true, .. });
        self.before.ran |= is_there;
        self.program_there = e.program_there().unwrap_or(self.program_there);
        // What a program that is there comes to is not seen yet; nor is what became of one that was there, where the robot could not be looked at since the
        // operator asked. Behind a hindrance it is not asked what became of one, so a wish before does not cover it.
        self.before.looked &= !is_there && (e.program_there().is_some() || !self.program_there);
        self.before.looked |= matches!(e, LinkError::MayNotMove { program_there: false, .. }) && !self.before.asked;
        self.before.unpowered = match e {
            LinkError::ProgramRunning { .. } | LinkError::MayNotMove { program_there: true, .. } => false,
            LinkError::MayNotMove { unpowered: true, .. } => true,
            _ => self.before.unpowered,
        };
        // A tilted container must be brought upright by somebody, who then has the robot in hand. A wish is not kept for ever.
        let wish_is_over = self.wish_until_ns.is_some_and(|until_ns| now_ns >= until_ns);
        // An arm that lost its power since the last session gets it from a person, who then has the robot; the first start of a cell is none of that.
        let unpowered = matches!(e, LinkError::MayNotMove { reason: EndReason::RobotNotRunning, .. }) && self.before.last.is_some();
        let why = e.handover().or(unpowered.then_some(Handover::Stopped(EndReason::RobotNotRunning)));
        if let Some(why) = why {
            self.wait_for_operator(why, config, note, say);
        } else if wish_is_over || matches!(e, LinkError::TooFar { .. }) {
            self.waits = true;
            self.wish_until_ns = None;
            note.set(format!("{e}; then {TAKE_BACK}"), RobotLink::WaitsForOperator, say);
        } else {
            note.set(e.to_string(), RobotLink::Connecting, say);
        }
    }

    /// Leaves the robot alone until the operator asks for it.
    fn wait_for_operator(&mut self, why: Handover, config: &Config, note: &RobotNote, say: &dyn Fn(Level, &str)) {
        self.waits = true;
        self.wish_until_ns = None;
        // What was seen now comes before whatever the operator asks for later. A program that is off its track is still on its way upright.
        self.before.looked = why != Handover::Stopped(EndReason::NotFollowed);
        let remedy = why.remedy();
        let line = format!("robot {}: {why}; it is not taken back by itself: {remedy}, then {TAKE_BACK}", config.robot.address);
        note.set(line, RobotLink::WaitsForOperator, say);
    }
}

/// How the operator takes the robot back.
const TAKE_BACK: &str = "`rt-controller resume`, or the next pour or recording";
