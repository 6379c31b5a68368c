//! The fixed-rate loop: absolute deadlines on CLOCK_MONOTONIC; a missed period is skipped and counted, never made up for.
//!
//! It runs in the real-time thread. Its ticks do not allocate, lock, log, or call anything that blocks but the sleep itself; `status` shows
//! how often they allocated. The one exception is [`LoopState::meet_feature_worker`], which runs between ticks and outside of
//! pours; a worker that comes in a pour, which then ends, is met by the tick.
//! Nothing in it fails: a lost robot is handed back and the core ends the pour, and a lost feature worker shows as stale features.

use std::sync::atomic::{AtomicU64, Ordering::Relaxed, Ordering::SeqCst};

use iceoryx2::port::update_connections::UpdateConnections;
use shared::level::Level;
use shared::messages::{Feature, Phase, Telemetry};
use shared::os;

use shared::control::EndReason;

use crate::core::{Core, Input, MAX_FEATURES, Order, Refusal, Robot, Settings};
use crate::exchange::{Event, Exchange, SessionEnd};
use crate::journal::{Tick, Times};
use crate::link::{Mode, Session, health};
use crate::pacing::Pacer;

/// Receives features from shared memory.
pub type Features = iceoryx2::port::subscriber::Subscriber<iceoryx2::service::ipc::Service, Feature, ()>;

/// What the loop's ticks stand on besides the robot's session: a clock and the measurements. It is a parameter, so that the same ticks run
/// on this machine, where [`Features`] is it, and in a simulated world. Nothing in it may block or fail.
pub trait Outside {
    /// The present time, CLOCK_MONOTONIC or what stands for it, ns.
    fn now_ns(&self) -> u64;
    /// The oldest measurement that has arrived and was not received yet.
    fn receive(&self) -> Option<Feature>;
    /// Opens what a feature worker that has come needs. It is called outside of pours, and may allocate.
    fn meet_feature_worker(&self);
}

impl Outside for Features {
    fn now_ns(&self) -> u64 {
        os::now_ns()
    }

    fn receive(&self) -> Option<Feature> {
        Self::receive(self).ok().flatten().map(|feature| *feature)
    }

    fn meet_feature_worker(&self) {
        // What fails here fails in `receive` too, and shows as stale features.
        let _ = self.update_connections();
    }
}

/// Where and how the loop is scheduled.
#[derive(Debug, Clone, Copy)]
pub struct Place {
    /// Number of the processor core.
    pub core: usize,
    /// SCHED_FIFO priority, 1 to 99; 0 means ordinary scheduling.
    pub priority: u8,
}

/// Runs until [`Order::Shutdown`] was obeyed and the container is upright.
///
/// `lost_ns` is how long the robot may be silent (`controller.lost_robot_ms`), ns. Before the loop starts, `say` gets a line for each
/// thing that the operating system did not permit.
pub fn run(settings: Settings, place: Place, lost_ns: u64, features: &Features, exchange: &Exchange, say: &dyn Fn(Level, &str)) {
    for line in os::become_realtime(place.core, place.priority) {
        say(Level::Warning, &line);
    }
    os::cannot_be_held_up();
    // Before the state, which counts allocations from then on: the first look at the clock finds out where the kernel keeps it, and allocates for that where
    // the kernel is older than Linux 6.4.
    let mut deadline_ns = os::now_ns() + settings.period_ns;
    let mut state = LoopState::new(settings, lost_ns, features, exchange);
    loop {
        os::sleep_until_ns(deadline_ns);
        let Some(next_ns) = state.wake_up(deadline_ns) else { break };
        deadline_ns = next_ns;
    }
    // The container is upright. The session's end only stops the robot's program at once, instead of after its patience.
    drop(state);
    exchange.ended.store(true, Relaxed);
}

/// Whether there is another tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Next {
    /// There is one.
    Tick,
    /// The shutdown was obeyed and the container is upright.
    Ended,
}

/// What the loop keeps from tick to tick.
pub struct LoopState<'a, O> {
    core: Box<Core>,
    fresh: heapless::Vec<Feature, MAX_FEATURES>,
    session: Option<Box<Session>>,
    /// Identity of the core's weights; 0 if it has none.
    weights_id: u64,
    outside: &'a O,
    exchange: &'a Exchange,
    pacer: Pacer,
    period_ns: u64,
    lost_ns: u64,
    shutdown: bool,
    /// Number of aborts obeyed.
    aborts: u64,
    /// When the newest tick was done, ns: the time that the next deadline is reckoned with, so that the journal has all that it follows from.
    done_ns: u64,
    /// Allocations and page faults of this thread outside of its ticks: before the first one, and when it met feature workers.
    elsewhere: (u64, u64),
}

impl<'a, O: Outside> LoopState<'a, O> {
    /// Allocates all that the ticks use. Call it in the thread that runs them.
    pub fn new(settings: Settings, lost_ns: u64, outside: &'a O, exchange: &'a Exchange) -> Self {
        Self {
            core: Box::new(Core::new(settings)),
            fresh: heapless::Vec::new(),
            session: None,
            weights_id: 0,
            outside,
            exchange,
            pacer: Pacer::new(settings.period_ns),
            period_ns: settings.period_ns,
            lost_ns,
            shutdown: false,
            aborts: 0,
            done_ns: 0,
            elsewhere: spent(),
        }
    }

    /// All that is done after waking up for `deadline_ns`. Gives the next deadline, ns; `None` when the loop has ended.
    pub fn wake_up(&mut self, deadline_ns: u64) -> Option<u64> {
        self.meet_feature_worker();
        if self.tick(deadline_ns) == Next::Ended {
            return None;
        }
        let (next_ns, skipped) = self.pacer.next_deadline_ns(deadline_ns, self.done_ns);
        self.exchange.skipped_ticks.fetch_add(skipped, Relaxed);
        Some(next_ns)
    }

    /// One tick, just after waking up for `deadline_ns`.
    pub fn tick(&mut self, deadline_ns: u64) -> Next {
        let exchange = self.exchange;
        let woke_ns = self.outside.now_ns();
        let margin_ns = self.pacer.margin_ns();
        let lateness_ns = woke_ns.saturating_sub(deadline_ns);
        exchange.timing.lateness.record(lateness_ns);
        if lateness_ns > self.period_ns / 2 {
            exchange.late_ticks.fetch_add(1, Relaxed);
        }

        // The memory answers to these while the features are received and the robot's socket is drained.
        self.core.prefetch(0);
        self.receive_features();
        self.core.prefetch(1);
        let taken = self.take_agent();
        // A run that began with a session that is gone has to end first: its program has come upright, and must not follow the rest of it.
        if self.session.is_none() && self.core.phase() == Phase::NoRobot {
            self.session = exchange.sessions.pop();
        }
        self.core.prefetch(2);
        let (robot, mut end) = look_at_robot(self.session.as_deref_mut(), woke_ns, self.lost_ns);
        self.core.prefetch(3);
        let order = self.next_order();

        let output = self.core.step(&Input { now_ns: woke_ns, features: &self.fresh, robot, order });
        let decided_at_ns = self.outside.now_ns();
        let mut written_at_ns = 0;
        if let (Some(session), Some(target_deg)) = (self.session.as_mut(), output.target_deg) {
            end = session.send(Mode::Stream, target_deg).err().map(SessionEnd::Lost).or(end);
            written_at_ns = self.outside.now_ns();
        }
        self.measure_features(woke_ns, written_at_ns);
        self.give_session_back(end);

        let telemetry = Telemetry { weights_id: self.weights_id, ..output.telemetry };
        // Nobody waits for the answer to what stops the motion.
        if let Some((order, answer)) = order.zip(output.ordered).filter(|(order, _)| order.episode() != 0) {
            self.tell(Event::Ordered(order.episode(), answer));
        }
        if let Some(outcome) = output.ended {
            self.tell(Event::Ended(outcome));
        }
        let (allocations, faults) = spent();
        exchange.loop_allocations.store(allocations - self.elsewhere.0, Relaxed);
        exchange.loop_page_faults.store(faults - self.elsewhere.1, Relaxed);
        let done_ns = self.outside.now_ns();
        self.done_ns = done_ns;
        exchange.timing.execution.record(done_ns.saturating_sub(woke_ns));
        let tick = Tick {
            now_ns: woke_ns,
            features: self.fresh.clone(),
            robot,
            order,
            agent: taken,
            target_deg: output.target_deg,
            d_ml: telemetry.d_ml,
            times: Times { deadline_ns, decided_at_ns, written_at_ns, done_ns, margin_ns },
        };
        self.tell(Event::Tick(tick, telemetry, self.core.counters()));
        exchange.alpha_measured.store(telemetry.alpha_measured_deg.to_bits(), SeqCst);
        if telemetry.alpha_measured_deg.is_finite() {
            exchange.last_alpha.store(telemetry.alpha_measured_deg.to_bits(), SeqCst);
        }
        exchange.phase.store(telemetry.phase, SeqCst);
        // Only now does the phase say that it was obeyed.
        exchange.aborts_obeyed.store(self.aborts, SeqCst);
        let upright = matches!(self.core.phase(), Phase::Idle | Phase::NoRobot);
        if self.shutdown && upright { Next::Ended } else { Next::Tick }
    }

    /// The order of this tick. What stops the motion comes before the queue, and refuses what waits there, and what was given before it and
    /// comes into the queue only later.
    fn next_order(&mut self) -> Option<Order> {
        let exchange = self.exchange;
        let aborts = exchange.aborts.load(SeqCst);
        let stops = if !self.shutdown && exchange.shutdown.load(SeqCst) {
            self.shutdown = true;
            Some(Order::Shutdown)
        } else {
            (aborts != self.aborts).then_some(Order::Abort)
        };
        self.aborts = aborts;
        // No more than fit into the queue, so that a client that asks and asks cannot hold the loop.
        for _ in 0..exchange.orders.capacity() {
            let Some(asked) = exchange.orders.pop() else { break };
            if stops.is_none() && asked.aborts == aborts {
                return Some(asked.order);
            }
            self.tell(Event::Ordered(asked.order.episode(), Err(Refusal::Stopped)));
        }
        stops
    }

    /// Takes the features that have arrived. If they are more than fit, it keeps the newest, because older ones would be stale.
    fn receive_features(&mut self) {
        self.fresh.clear();
        // `receive` gives the oldest first. The bound keeps a flood of features from holding the loop.
        for _ in 0..2 * MAX_FEATURES {
            let Some(feature) = self.outside.receive() else { break };
            if self.fresh.is_full() {
                self.fresh.remove(0);
            }
            let _ = self.fresh.push(feature);
        }
    }

    /// Takes a new agent, if one waits and no pour is under way; gives the identity of its weights.
    fn take_agent(&mut self) -> Option<u64> {
        let exchange = self.exchange;
        if !self.core.may_exchange() || exchange.old_agents.is_full() {
            return None;
        }
        let (weights_id, agent) = exchange.agents.pop()?;
        self.weights_id = weights_id;
        exchange.agents_taken.fetch_add(1, Relaxed);
        if let Some(old) = self.core.exchange(agent) {
            let _ = exchange.old_agents.push(old);
        }
        Some(weights_id)
    }

    /// Records how old the newest feature was when it was used, and tells the pacer. `written_at_ns` is 0 if no target was written.
    fn measure_features(&mut self, woke_ns: u64, written_at_ns: u64) {
        for feature in &self.fresh {
            self.pacer.used(woke_ns, feature.published_at_ns);
        }
        let Some(newest) = self.fresh.last() else { return };
        if written_at_ns != 0 {
            let timing = &self.exchange.timing;
            timing.wake_to_written.record(written_at_ns.saturating_sub(woke_ns));
            timing.feature_age.record(woke_ns.saturating_sub(newest.captured_at_ns));
            timing.feature_wait.record(woke_ns.saturating_sub(newest.published_at_ns));
        }
    }

    /// Gives the robot's session back, if it is over. A robot that may not move any more always ends its session: it is connected anew when
    /// it may move again.
    fn give_session_back(&mut self, end: Option<SessionEnd>) {
        let old_sessions = &self.exchange.old_sessions;
        if let Some(end) = end
            && !old_sessions.is_full()
            && let Some(session) = self.session.take()
        {
            let _ = old_sessions.push((session, end));
        }
    }

    /// Tells the ordinary thread about an event, or counts that it could not.
    fn tell(&self, event: Event) {
        if self.exchange.events.push(event).is_err() {
            self.exchange.events_lost.fetch_add(1, Relaxed);
        }
    }

    /// Opens the shared memory of a feature worker that has come, or come back. iceoryx2 allocates for it, so this is done before a tick,
    /// outside of pours, and counted apart. A worker that comes during a pour is met by the tick itself; that pour ends anyway.
    pub fn meet_feature_worker(&mut self) {
        if !self.core.may_exchange() {
            return;
        }
        let before = os::allocations();
        self.outside.meet_feature_worker();
        if os::allocations() != before {
            let (allocations, faults) = spent();
            let of_ticks = |counter: &AtomicU64| counter.load(Relaxed);
            self.elsewhere.0 = allocations - of_ticks(&self.exchange.loop_allocations);
            self.elsewhere.1 = faults - of_ticks(&self.exchange.loop_page_faults);
        }
    }
}

/// Allocations and page faults of this thread since it started.
fn spent() -> (u64, u64) {
    let (minor, major) = os::page_faults();
    (os::allocations(), minor + major)
}

/// The robot as the core sees it, and why its session is over, if it is.
fn look_at_robot(session: Option<&mut Session>, now_ns: u64, lost_ns: u64) -> (Robot, Option<SessionEnd>) {
    let Some(session) = session else {
        return (Robot { hindrance: Some(EndReason::RobotLost), ..Robot::that_may_move(f32::NAN, 0) }, None);
    };
    let lost = session.poll(now_ns).err();
    let state = session.state();
    let may_not_move = health::check(state, now_ns, lost_ns).err();
    let hindrance = if lost.is_some() { Some(may_not_move.unwrap_or(EndReason::RobotLost)) } else { may_not_move };
    let end = lost.map(SessionEnd::Lost).or(may_not_move.map(SessionEnd::MayNotMove));
    let speed_scaling = state.speed_scaling.map(|share| share as f32);
    (Robot { hindrance, alpha_deg: state.alpha_deg, at_ns: state.received_at_ns, speed_scaling }, end)
}
