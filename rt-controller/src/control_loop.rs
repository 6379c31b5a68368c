//! The fixed-rate loop: absolute deadlines on CLOCK_MONOTONIC; a missed period is skipped and counted, never bursted.
//!
//! Runs in the real-time thread. After its set-up it does not allocate, lock, log, or call anything that blocks but the sleep
//! itself; the count of its allocations is part of `status`. Nothing in it fails: a lost robot is handed back and the core
//! ends the pour, a lost feature worker shows as stale features.

use std::sync::atomic::Ordering::Relaxed;

use shared::messages::{Feature, Phase};
use shared::os;

use crate::core::{Core, Input, MAX_FEATURES, Order, Robot, Settings};
use crate::exchange::{Event, Exchange};

/// Receives features from shared memory.
pub type Features = iceoryx2::port::subscriber::Subscriber<iceoryx2::service::ipc::Service, Feature, ()>;

/// Where the loop runs.
#[derive(Debug, Clone, Copy)]
pub struct Place {
    /// Core.
    pub core: usize,
    /// SCHED_FIFO priority, 0: ordinary scheduling.
    pub priority: u8,
}

/// Runs until [`Order::Shutdown`] was obeyed and the container is upright.
///
/// `say` gets what the operating system did not permit, before the loop starts.
pub fn run(settings: Settings, place: Place, features: &Features, exchange: &Exchange, say: &dyn Fn(&str)) {
    let mut core = Box::new(Core::new(settings));
    let mut fresh: heapless::Vec<Feature, MAX_FEATURES> = heapless::Vec::new();
    let mut session = None;
    let period_ns = settings.period_ns;
    for line in os::become_realtime(place.core, place.priority) {
        say(&line);
    }

    let mut shutdown = false;
    let (allocations_before, faults_before) = (os::allocations(), os::page_faults());
    let mut deadline_ns = os::now_ns() + period_ns;
    loop {
        os::sleep_until_ns(deadline_ns);
        let woke_ns = os::now_ns();
        let lateness_ns = woke_ns.saturating_sub(deadline_ns);
        exchange.timing.lateness.record(lateness_ns);
        if lateness_ns > period_ns / 2 {
            exchange.late_ticks.fetch_add(1, Relaxed);
        }

        fresh.clear();
        // Older ones than fit would be stale; `receive` gives the oldest first.
        while let Ok(Some(sample)) = features.receive() {
            if fresh.is_full() {
                fresh.remove(0);
            }
            let _ = fresh.push(*sample);
        }
        if core.may_exchange()
            && !exchange.old_agents.is_full()
            && let Some(agent) = exchange.agents.pop()
        {
            exchange.agents_taken.fetch_add(1, Relaxed);
            if let Some(old) = core.exchange(agent) {
                let _ = exchange.old_agents.push(old);
            }
        }
        if session.is_none() {
            session = exchange.sessions.pop();
        }
        let robot = session.as_mut().map_or(
            Robot { hindrance: Some(shared::control::EndReason::RobotLost), alpha_deg: f32::NAN, at_ns: 0 },
            |s| s.poll(woke_ns),
        );
        let order = exchange.orders.pop();
        shutdown |= order == Some(Order::Shutdown);

        let output = core.step(&Input { now_ns: woke_ns, features: &fresh, robot, order });
        let mut alive = true;
        if let (Some(session), Some(target_deg)) = (session.as_mut(), output.target_deg) {
            alive = session.send(target_deg, woke_ns);
            if let Some(newest) = fresh.last() {
                exchange.timing.wake_to_written.record(os::now_ns().saturating_sub(woke_ns));
                exchange.timing.feature_age.record(woke_ns.saturating_sub(newest.captured_at_ns));
                exchange.timing.feature_wait.record(woke_ns.saturating_sub(newest.published_at_ns));
            }
        }
        let lost = session.as_ref().is_some_and(|s| !alive || s.is_lost());
        if lost
            && !exchange.old_sessions.is_full()
            && let Some(dead) = session.take()
        {
            let _ = exchange.old_sessions.push(dead);
        }

        let tell = |event| {
            if exchange.events.push(event).is_err() {
                exchange.events_lost.fetch_add(1, Relaxed);
            }
        };
        if let Some(answer) = output.ordered {
            tell(Event::Ordered(answer));
        }
        if let Some(outcome) = output.ended {
            tell(Event::Ended(outcome));
        }
        tell(Event::Tick(output.telemetry, core.counters()));

        exchange.loop_allocations.store(os::allocations() - allocations_before, Relaxed);
        let faults = os::page_faults();
        exchange.loop_page_faults.store(faults.0 + faults.1 - faults_before.0 - faults_before.1, Relaxed);
        let done_ns = os::now_ns();
        exchange.timing.execution.record(done_ns.saturating_sub(woke_ns));
        if shutdown && matches!(core.phase(), Phase::Idle | Phase::NoRobot) {
            break;
        }
        deadline_ns += period_ns;
        while deadline_ns <= done_ns {
            deadline_ns += period_ns;
            exchange.skipped_ticks.fetch_add(1, Relaxed);
        }
    }
    drop(session);
    exchange.ended.store(true, Relaxed);
}
