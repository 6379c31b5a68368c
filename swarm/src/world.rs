//! The virtual cell: robot, vessel, eye, the controller's loop and what surrounds it, moved from event to event in virtual time.
//!
//! One thread. The controller's own code runs on it: the robot's thread ([`rt_controller::robot_thread`]) is the one that waits, and
//! while it sleeps or waits for bytes, [`World`] lets everything else happen. Allocates; what goes wrong is what is drawn.

use std::cell::{Cell, RefCell};
use std::collections::VecDeque;
use std::io::{ErrorKind, Result};
use std::net::SocketAddr;
use std::sync::atomic::{AtomicBool, Ordering::Relaxed};
use std::time::Duration;

use rt_controller::control_loop::{LoopState, Outside};
use rt_controller::core::MAX_FEATURES;
use rt_controller::core::Order;
use rt_controller::exchange::{Asked, Event, Exchange};
use rt_controller::link::network::{Network, Transport};
use rt_controller::robot_thread::RobotNote;
use shared::control::RobotLink;
use shared::messages::Feature;

use crate::pipe;
use crate::records::Journal;
use crate::site::Site;

/// Time that a call of the clock takes in the loop, ns: a tick then takes about as long as on the machines of docs/REALTIME.md.
const CLOCK_NS: u64 = 5_000;

/// What the loop's ticks stand on: their clock, and the measurements that have been published.
#[derive(Debug, Default)]
pub struct LoopSide {
    now_ns: Cell<u64>,
    arrived: RefCell<VecDeque<Feature>>,
}

impl Outside for LoopSide {
    fn now_ns(&self) -> u64 {
        let now_ns = self.now_ns.get();
        self.now_ns.set(now_ns + CLOCK_NS);
        now_ns
    }

    fn receive(&self) -> Option<Feature> {
        self.arrived.borrow_mut().pop_front()
    }

    fn meet_feature_worker(&self) {}
}

/// One life of the controller, from its start until it is killed or the cell ends.
pub struct Life<'a> {
    /// The loop.
    pub state: LoopState<'a, LoopSide>,
    /// What its ticks stand on.
    pub side: &'a LoopSide,
    /// What passes between the threads.
    pub exchange: &'a Exchange,
    /// What the robot's thread has to say.
    pub note: &'a RobotNote,
    /// When the loop wakes up next, ns.
    pub deadline_ns: Option<u64>,
    /// The journal.
    pub journal: Journal,
}

/// The world that a life of the controller stands on.
pub struct World<'a> {
    /// The cell without the controller.
    pub site: &'a RefCell<Site>,
    /// The controller, without the robot's thread.
    pub life: RefCell<Life<'a>>,
    /// Ends the life.
    pub stop: &'a AtomicBool,
}

impl World<'_> {
    /// Lets the next thing happen, if it is before `until_ns`; otherwise it is `until_ns`. False if nothing happened before it.
    fn step(&self, until_ns: u64) -> bool {
        let (mut site, mut life) = (self.site.borrow_mut(), self.life.borrow_mut());
        let wake_ns = life.deadline_ns.map_or(u64::MAX, |ns| ns.max(site.controller_frozen_until_ns) + site.lateness_ns);
        let next_ns = site.next_ns().min(wake_ns);
        if next_ns > until_ns {
            site.set_now(until_ns);
            return false;
        }
        site.set_now(next_ns);
        if wake_ns > next_ns {
            for order in site.step() {
                // As the service and its clients do: `resume` always asks for the robot, an order that moves if a person had it, and an abort never.
                let waits = life.note.get().link == RobotLink::WaitsForOperator;
                if order != Some(Order::Abort) {
                    site.checks.asked(waits, order.is_none());
                }
                if order.is_none() || (waits && order != Some(Order::Abort)) {
                    life.note.asked();
                    life.exchange.resume.store(true, Relaxed);
                }
                match order {
                    Some(Order::Abort) => life.exchange.abort(),
                    Some(order) => {
                        let aborts = life.exchange.aborts.load(Relaxed);
                        let _ = life.exchange.orders.push(Asked { order, aborts });
                    }
                    None => {}
                }
            }
            if let Some((identity, agent)) = site.new_agent.take() {
                if let Some(weights) = &site.new_weights {
                    life.journal.weights(identity, weights);
                }
                drop(life.exchange.agents.force_push((identity, agent)));
            }
            if site.is_disk_full {
                life.journal.end();
            }
        } else {
            wake_up(&mut life, &mut site, next_ns);
        }
        if site.is_over() {
            self.stop.store(true, Relaxed);
        }
        true
    }

    fn is_over(&self) -> bool {
        self.stop.load(Relaxed)
    }
}

/// The loop wakes up at `now_ns`.
fn wake_up(life: &mut Life<'_>, site: &mut Site, now_ns: u64) {
    let Some(deadline_ns) = life.deadline_ns else { return };
    life.side.now_ns.set(now_ns);
    {
        let mut arrived = life.side.arrived.borrow_mut();
        while site.eye.published.front().is_some_and(|f| f.published_at_ns <= now_ns) {
            arrived.extend(site.eye.published.pop_front());
        }
        // Shared memory keeps the newest.
        while arrived.len() > MAX_FEATURES {
            arrived.pop_front();
        }
    }
    site.woke_up();
    life.deadline_ns = life.state.wake_up(deadline_ns);
    while life.exchange.old_agents.pop().is_some() {}
    // The loop tells an end before the tick that it came in.
    let mut ended = None;
    while let Some(event) = life.exchange.events.pop() {
        match event {
            Event::Tick(tick, telemetry, counters) => {
                site.ticked(&tick, &telemetry, counters.features);
                life.journal.tick(tick, &telemetry);
            }
            Event::Ordered(_, answer) => site.say(|| format!("order: {answer:?}")),
            Event::Ended(outcome) => ended = Some(outcome),
        }
    }
    if let Some(outcome) = ended {
        site.ended(&outcome);
    }
}

impl Network for World<'_> {
    fn now_ns(&self) -> u64 {
        self.site.borrow().now_ns
    }

    fn sleep(&self, time: Duration) {
        let until_ns = self.now_ns() + time.as_nanos() as u64;
        while !self.is_over() && (self.step(until_ns) || self.site.borrow().controller_frozen_until_ns > self.now_ns()) {
            // A process that is suspended sleeps on.
            let frozen_ns = self.site.borrow().controller_frozen_until_ns;
            if self.now_ns() >= until_ns && frozen_ns > until_ns {
                while !self.is_over() && self.step(frozen_ns) {}
                return;
            }
        }
    }

    fn open(&self, at: SocketAddr, within: Duration) -> Result<Box<dyn Transport>> {
        if self.is_over() {
            return Err(pipe::refused());
        }
        let opened = self.site.borrow_mut().open(at.port());
        match opened {
            Some(Ok(end)) => Ok(Box::new(end)),
            Some(Err(e)) => Err(e),
            None => {
                // A robot that is not there does not even refuse.
                self.sleep(within);
                Err(ErrorKind::TimedOut.into())
            }
        }
    }

    fn read(&self, from: &mut dyn Transport, buffer: &mut [u8], within: Duration) -> Result<usize> {
        let until_ns = self.now_ns() + within.as_nanos() as u64;
        loop {
            if self.is_over() {
                return Err(ErrorKind::ConnectionAborted.into());
            }
            // A process that is suspended reads nothing, whatever comes, and looks when it goes on.
            let frozen_ns = self.site.borrow().controller_frozen_until_ns;
            if frozen_ns > self.now_ns() {
                self.step(frozen_ns);
                continue;
            }
            match from.read(buffer) {
                Err(e) if e.kind() == ErrorKind::WouldBlock => {}
                result => return result,
            }
            if self.now_ns() >= until_ns {
                return Err(ErrorKind::TimedOut.into());
            }
            self.step(until_ns);
        }
    }
}
