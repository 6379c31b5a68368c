//! The fixed-rate loop: absolute deadlines on CLOCK_MONOTONIC; a missed period is skipped and counted, never bursted.
//!
//! Runs in the real-time thread. After its set-up it does not allocate, lock, log, or call anything that blocks but the sleep
//! itself; the count of its allocations is part of `status`. Nothing in it fails: a lost robot is handed back and the core
//! ends the pour, a lost feature worker shows as stale features.

use std::sync::atomic::Ordering::Relaxed;

use shared::messages::{Feature, Phase};
use shared::os;

use shared::control::EndReason;

use crate::core::{Core, Input, MAX_FEATURES, Order, Robot, Settings};
use crate::exchange::{Event, Exchange, SessionEnd};
use crate::journal::Tick;
use crate::link::{Mode, Session, health};

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
/// `lost_ns` is how long the robot may be silent (`controller.lost_robot_ms`). `say` gets what the operating system did not permit, before the loop starts.
pub fn run(settings: Settings, place: Place, lost_ns: u64, features: &Features, exchange: &Exchange, say: &dyn Fn(&str)) {
    let mut core = Box::new(Core::new(settings));
    let mut fresh: heapless::Vec<Feature, MAX_FEATURES> = heapless::Vec::new();
    let mut session: Option<Box<Session>> = None;
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
        let mut taken = None;
        if core.may_exchange()
            && !exchange.old_agents.is_full()
            && let Some((number, agent)) = exchange.agents.pop()
        {
            taken = Some(number);
            exchange.agents_taken.fetch_add(1, Relaxed);
            if let Some(old) = core.exchange(agent) {
                let _ = exchange.old_agents.push(old);
            }
        }
        if session.is_none() {
            session = exchange.sessions.pop();
        }
        let (robot, mut end) = look(session.as_deref_mut(), woke_ns, lost_ns);
        let order = exchange.orders.pop();
        shutdown |= order == Some(Order::Shutdown);

        let output = core.step(&Input { now_ns: woke_ns, features: &fresh, robot, order });
        if let (Some(session), Some(target_deg)) = (session.as_mut(), output.target_deg) {
            end = session.send(Mode::Stream, target_deg).err().map(SessionEnd::Lost).or(end);
            if let Some(newest) = fresh.last() {
                exchange.timing.wake_to_written.record(os::now_ns().saturating_sub(woke_ns));
                exchange.timing.feature_age.record(woke_ns.saturating_sub(newest.captured_at_ns));
                exchange.timing.feature_wait.record(woke_ns.saturating_sub(newest.published_at_ns));
            }
        }
        // A robot that may not move any more is never taken back as it is: it is handed over, and connected anew when it is well.
        if let Some(end) = end
            && !exchange.old_sessions.is_full()
            && let Some(dead) = session.take()
        {
            let _ = exchange.old_sessions.push((dead, end));
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
        let telemetry = output.telemetry;
        let tick = Tick {
            now_ns: woke_ns,
            features: fresh.clone(),
            robot,
            order,
            agent: taken,
            target_deg: output.target_deg,
            d_ml: telemetry.d_ml,
        };
        tell(Event::Tick(tick, telemetry, core.counters()));

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
    // Upright already: the session's end only stops the robot's program at once instead of after its patience.
    drop(session);
    exchange.ended.store(true, Relaxed);
}

/// The robot as the core sees it, and why its session is over, if it is.
fn look(session: Option<&mut Session>, now_ns: u64, lost_ns: u64) -> (Robot, Option<SessionEnd>) {
    let Some(session) = session else {
        return (Robot { hindrance: Some(EndReason::RobotLost), alpha_deg: f32::NAN, at_ns: 0 }, None);
    };
    let lost = session.poll(now_ns).err();
    let state = session.state();
    let unwell = health::check(state, now_ns, lost_ns).err();
    let hindrance = if lost.is_some() { Some(unwell.unwrap_or(EndReason::RobotLost)) } else { unwell };
    let end = lost.map(SessionEnd::Lost).or(unwell.map(SessionEnd::Unwell));
    (Robot { hindrance, alpha_deg: state.alpha_deg, at_ns: state.received_at_ns }, end)
}
