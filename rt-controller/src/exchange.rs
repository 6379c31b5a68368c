//! What passes between the loop and the ordinary threads: bounded lock-free queues and atomics, all made before the loop starts.
//!
//! The loop never blocks on them and never frees what it got: boxes that it no longer needs go back through a queue, and an ordinary
//! thread drops them. Nothing allocates after the start. When a queue is full, the loop counts the events that it could not pass on ([`Exchange::events_lost`]).

use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering::SeqCst};

use crossbeam::queue::ArrayQueue;
use shared::agent::Agent;
use shared::control::{EndReason, Outcome};
use shared::messages::Telemetry;

use crate::core::{Counters, Order, Refusal};
use crate::journal::Tick;
use crate::link::{Lost, Session};
use crate::timing::Histogram;

/// What the loop tells the ordinary thread.
#[derive(Debug, Clone)]
#[expect(clippy::large_enum_variant, reason = "a box would be an allocation in the loop")]
pub enum Event {
    /// A tick: what it saw and answered, its telemetry, and the counters.
    Tick(Tick, Telemetry, Counters),
    /// The answer to the order of the pour or recording with this number.
    Ordered(u64, Result<(), Refusal>),
    /// A pour or recording has ended.
    Ended(Outcome),
}

/// Why the loop gives a robot's session back.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SessionEnd {
    /// The connection was lost.
    Lost(Lost),
    /// The robot may not move any more.
    MayNotMove(EndReason),
}

impl std::fmt::Display for SessionEnd {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Lost(lost) => write!(f, "{lost}"),
            Self::MayNotMove(reason) => write!(f, "{}", reason.words()),
        }
    }
}

impl SessionEnd {
    /// The reason with which a pour ends.
    pub fn reason(&self) -> EndReason {
        match self {
            Self::Lost(_) => EndReason::RobotLost,
            Self::MayNotMove(reason) => *reason,
        }
    }
}

/// Histograms of the loop, all in nanoseconds.
#[derive(Debug, Default)]
pub struct Timing {
    /// From the deadline to the wake-up.
    pub lateness: Histogram,
    /// From the wake-up to the end of the tick.
    pub execution: Histogram,
    /// From a frame's exposure to the tick that uses its V_e.
    pub feature_age: Histogram,
    /// From a V_e's publication to the tick that uses it.
    pub feature_wait: Histogram,
    /// From the wake-up of a tick with a new V_e until the target's bytes are written.
    pub wake_to_written: Histogram,
}

/// An order, and how many aborts had been asked for when it was certainly not given yet. An abort that came later may have come after the order, which
/// is then refused: whoever has stopped a robot must not see it begin with what was given before.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Asked {
    /// The order.
    pub order: Order,
    /// Value of [`Exchange::aborts`] then.
    pub aborts: u64,
}

/// Everything that the threads share.
pub struct Exchange {
    /// To the loop: the number of times that the container was to be brought upright at once. That comes before every order in the queue.
    pub aborts: AtomicU64,
    /// From the loop: how many of those it has obeyed, and shown in its phase.
    pub aborts_obeyed: AtomicU64,
    /// To the loop: bring the container upright, and then end. It comes before everything else.
    pub shutdown: AtomicBool,
    /// From the loop: its phase after the newest tick.
    pub phase: AtomicU32,
    /// From the loop: the bits of the measured alpha of the newest tick, degrees; NaN without a robot.
    pub alpha_measured: AtomicU32,
    /// From the loop: the bits of the last alpha that a robot measured, degrees; NaN before the first.
    pub last_alpha: AtomicU32,
    /// To the loop: orders.
    pub orders: ArrayQueue<Asked>,
    /// From the loop: events.
    pub events: ArrayQueue<Event>,
    /// To the loop: an agent with the newest weights, and their identity.
    pub agents: ArrayQueue<(u64, Box<Agent>)>,
    /// From the loop: agents to drop.
    pub old_agents: ArrayQueue<Box<Agent>>,
    /// To the loop: the session with a connected robot.
    pub sessions: ArrayQueue<Box<Session>>,
    /// From the loop: sessions to drop, and why they are over.
    pub old_sessions: ArrayQueue<(Box<Session>, SessionEnd)>,
    /// Histograms of the loop.
    pub timing: Timing,
    /// Number of allocations and frees of the loop since it started.
    pub loop_allocations: AtomicU64,
    /// Number of page faults of the loop since it started.
    pub loop_page_faults: AtomicU64,
    /// Number of ticks that were late by more than half a period.
    pub late_ticks: AtomicU64,
    /// Number of periods skipped.
    pub skipped_ticks: AtomicU64,
    /// Number of agents taken.
    pub agents_taken: AtomicU64,
    /// Number of events that did not fit into the queue.
    pub events_lost: AtomicU64,
    /// Set when the loop begins; before, nothing can have moved.
    pub begun: AtomicBool,
    /// Set by the loop when it has ended, upright.
    pub ended: AtomicBool,
    /// To the robot's thread: set when the operator asks for the robot; the thread takes it back.
    pub resume: AtomicBool,
}

impl Exchange {
    /// Has the loop bring the container upright at once.
    pub fn abort(&self) {
        self.aborts.fetch_add(1, SeqCst);
    }
}

/// Number of orders that may wait for the loop, which takes one a tick. Chosen by hand; no measurement is recorded.
const ORDERS: usize = 8;
/// Number of events that may wait for the ordinary thread: half a minute of ticks at 30 Hz.
const EVENTS: usize = 1024;
/// Number of agents that may wait to be dropped, and of sessions. Chosen by hand; no measurement is recorded.
const OLD: usize = 4;

impl Default for Exchange {
    fn default() -> Self {
        Self {
            aborts: AtomicU64::new(0),
            aborts_obeyed: AtomicU64::new(0),
            shutdown: AtomicBool::new(false),
            phase: AtomicU32::new(0),
            alpha_measured: AtomicU32::new(f32::NAN.to_bits()),
            last_alpha: AtomicU32::new(f32::NAN.to_bits()),
            orders: ArrayQueue::new(ORDERS),
            events: ArrayQueue::new(EVENTS),
            agents: ArrayQueue::new(1),
            old_agents: ArrayQueue::new(OLD),
            sessions: ArrayQueue::new(1),
            old_sessions: ArrayQueue::new(OLD),
            timing: Timing::default(),
            loop_allocations: AtomicU64::new(0),
            loop_page_faults: AtomicU64::new(0),
            late_ticks: AtomicU64::new(0),
            skipped_ticks: AtomicU64::new(0),
            agents_taken: AtomicU64::new(0),
            events_lost: AtomicU64::new(0),
            begun: AtomicBool::new(false),
            ended: AtomicBool::new(false),
            resume: AtomicBool::new(false),
        }
    }
}
