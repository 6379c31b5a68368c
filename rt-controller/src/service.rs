//! The controller's ordinary side: answers clients, publishes telemetry, passes ticks on to the journal, and drops what the loop no
//! longer needs.
//!
//! It runs in the process's main thread with ordinary scheduling. It allocates, but never waits for a disk, because [`crate::disk`] does
//! so. If it falls behind, the loop goes on and counts what it could not tell. Nothing here ends the process but a signal, or another
//! controller in the same cell.

use std::collections::{BTreeSet, VecDeque};
use std::sync::atomic::{AtomicU64, Ordering::Relaxed, Ordering::SeqCst};
use std::time::{Duration, Instant};

use crossbeam::channel::{Receiver, Sender};
use iceoryx2::active_request::ActiveRequest;
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::server::Server;
use iceoryx2::service::ipc::Service as Ipc;
use shared::control::{EndReason, Outcome, Reply, Request, Status};
use shared::ipc::{Cell, InService as _, IpcError};
use shared::level::Level;
use shared::messages::{Phase, Telemetry};
use shared::supervisor::Supervisor;

use crate::client::MESSAGE_MAX;
use crate::core::{Counters, Order, Refusal};
use crate::disk::{Queues, Told};
use crate::disk_note::DiskNote;
use crate::exchange::{Asked, Event, Exchange};
use crate::robot_thread::RobotNote;

/// Pause between two looks at the queues. Chosen by hand: far below a person's patience, and cheap.
const BEAT: Duration = Duration::from_millis(40);
/// How long a result can be asked for when the controller ends, at least. Chosen by hand: clients ask ten times a second; the controller's end waits for
/// other threads that long anyway ([`crate::stop`]).
const LAST_RESULT: Duration = Duration::from_millis(400);
/// Number of results that are kept for `status`. Chosen by hand; no measurement is recorded.
const OUTCOMES: usize = 32;

/// A client's request that waits for its answer.
type Client = ActiveRequest<Ipc, [u8], (), [u8], ()>;

/// The state of the controller's ordinary side.
pub struct Service<'a> {
    exchange: &'a Exchange,
    robot_note: &'a RobotNote,
    robot_connections: &'a AtomicU64,
    say: &'a dyn Fn(Level, &str),
    server: Server<Ipc, [u8], (), [u8], ()>,
    telemetry: Publisher<Ipc, Telemetry, ()>,
    /// What lies on disks, and what is wrong with it.
    disk_note: &'a DiskNote,
    /// The queue to the journal; `None` if no journal is kept.
    journal: Option<Sender<Told>>,
    /// Whether a tick did not fit into it since it was last empty.
    journal_lags: bool,
    latest: Option<(Telemetry, Counters)>,
    outcomes: VecDeque<Outcome>,
    /// The requests whose orders are in the queue, in the same order, each with its episode's number.
    waiting: VecDeque<(Client, u64)>,
    /// Number of aborts before the newest look that found no request.
    aborts: u64,
    /// Numbers that nobody has used, the smallest first; they belong to no file.
    numbers: Receiver<u64>,
    /// Numbers of orders that were refused: the next order takes them.
    spare: BTreeSet<u64>,
    /// When this thread began.
    started: Instant,
    /// When the newest result came.
    result_at: Option<Instant>,
}

impl<'a> Service<'a> {
    /// Opens the services; fails when another controller has them. `disk` leads to the disk's thread.
    pub fn open(
        cell: &Cell,
        exchange: &'a Exchange,
        (robot_note, robot_connections): (&'a RobotNote, &'a AtomicU64),
        (disk_note, disk): (&'a DiskNote, Queues),
        say: &'a dyn Fn(Level, &str),
    ) -> Result<Self, IpcError> {
        let server = cell
            .control()?
            .server_builder()
            .initial_max_slice_len(MESSAGE_MAX)
            .max_loaned_responses_per_request(1)
            .create()
            .in_service("control")?;
        let telemetry = cell.telemetry()?.publisher_builder().create().in_service("telemetry")?;
        Ok(Self {
            exchange,
            robot_note,
            robot_connections,
            say,
            server,
            telemetry,
            disk_note,
            started: Instant::now(),
            result_at: None,
            journal: disk.journal,
            journal_lags: false,
            latest: None,
            outcomes: VecDeque::new(),
            waiting: VecDeque::new(),
            aborts: 0,
            numbers: disk.numbers,
            spare: BTreeSet::new(),
        })
    }

    /// Works until the loop has ended.
    pub fn run(mut self) {
        let mut supervisor = Supervisor::ready();
        while !self.exchange.ended.load(Relaxed) {
            while self.exchange.old_agents.pop().is_some() {}
            self.take_events();
            self.answer();
            supervisor.progress(self.latest.as_ref().map_or(0, |(_, counters)| counters.ticks));
            std::thread::sleep(BEAT);
        }
        self.take_events();
        // Who watches the pour that the shutdown has ended asks once more, and is told how it ended.
        while self.result_at.is_some_and(|at| at.elapsed() < LAST_RESULT) {
            self.answer();
            std::thread::sleep(BEAT);
        }
    }

    /// Takes the loop's events.
    fn take_events(&mut self) {
        while let Some(event) = self.exchange.events.pop() {
            match event {
                Event::Tick(tick, telemetry, counters) => {
                    self.pass_on(Box::new((tick, telemetry)));
                    self.latest = Some((telemetry, counters));
                    // It does not matter whether anybody listens.
                    let _ = self.telemetry.send_copy(telemetry);
                }
                Event::Ordered(episode, answer) => {
                    let place = self.waiting.iter().position(|(_, its)| *its == episode);
                    // Those in front have lost their answers, because the loop could not tell them; their clients learn that they got none.
                    self.waiting.drain(..place.unwrap_or(0));
                    if let Some((asked, _)) = place.and_then(|_| self.waiting.pop_front()) {
                        let answer = match answer {
                            Ok(()) => Reply::Started { episode },
                            Err(refusal) => {
                                self.spare.insert(episode);
                                Reply::Refused { reason: self.words(refusal) }
                            }
                        };
                        reply(&asked, &answer);
                    }
                }
                Event::Ended(outcome) => {
                    let is_right = outcome.reason == EndReason::Done && !outcome.is_unsure();
                    let level = if is_right { Level::Info } else { Level::Warning };
                    let line = format!(
                        "episode {}: {}, {} after {:.1} s",
                        outcome.episode,
                        outcome
                            .goal_ml
                            .map_or("curve".into(), |g| format!("goal {g:.1} ml, {} ml poured (estimate)", outcome.poured_words())),
                        outcome.words(),
                        outcome.seconds
                    );
                    (self.say)(level, &line);
                    if self.outcomes.len() == OUTCOMES {
                        self.outcomes.pop_front();
                    }
                    self.outcomes.push_back(outcome);
                    self.result_at = Some(Instant::now());
                }
            }
        }
    }

    /// Passes a tick on to the journal, if one is kept. One that finds no room is counted, and said once until the disk has caught up.
    fn pass_on(&mut self, told: Told) {
        let Some(journal) = &self.journal else { return };
        self.journal_lags &= !journal.is_empty();
        if journal.try_send(told).is_ok() {
            return;
        }
        self.disk_note.set(|n| n.lost += 1);
        if !self.journal_lags {
            let what = "journal: the disk does not keep up; what is missing is counted in it, and the controller goes on";
            (self.say)(Level::Warning, what);
        }
        self.journal_lags = true;
    }

    /// Why the newest weight file is not used; empty if it is.
    fn refused(&self) -> String {
        self.disk_note.get().refused
    }

    /// The line that the operator gets for a refusal.
    fn words(&self, refusal: Refusal) -> String {
        match refusal {
            Refusal::Robot(_) if !self.robot_note.get().text.is_empty() => self.robot_note.get().text,
            Refusal::NoWeights => format!("{refusal} ({})", self.refused()),
            _ => refusal.to_string(),
        }
    }

    /// Answers clients, or passes their orders to the loop.
    fn answer(&mut self) {
        loop {
            // What is received after a look that found nothing was given after that look, and so after the aborts until then.
            let aborts = self.exchange.aborts.load(SeqCst);
            let asked = match self.server.receive() {
                Ok(Some(asked)) => asked,
                Ok(None) => {
                    self.aborts = aborts;
                    return;
                }
                Err(_) => return,
            };
            let request = postcard::from_bytes::<Request>(asked.payload());
            // Whoever has given up waiting must not find the robot moving later. An abort counts whoever waits.
            if !asked.is_connected() && !matches!(request, Ok(Request::Abort)) {
                continue;
            }
            let Ok(request) = request else {
                reply(
                    &asked,
                    &Reply::Refused { reason: "the request comes from another version of Decant: run the same build on both sides".into() },
                );
                continue;
            };
            let order = match request {
                Request::Status => {
                    reply(&asked, &Reply::Status(Box::new(self.status())));
                    continue;
                }
                Request::Resume => {
                    self.robot_note.asked();
                    self.exchange.resume.store(true, Relaxed);
                    reply(&asked, &Reply::Resuming);
                    continue;
                }
                Request::Abort => {
                    self.exchange.abort();
                    reply(&asked, &Reply::Aborting);
                    continue;
                }
                Request::Pour { goal_ml, flows_by_deg } => {
                    self.next_number().map(|episode| (Order::Pour { episode, goal_ml, flows_by_deg }, episode))
                }
                Request::Record(curve) => self.next_number().map(|episode| (Order::Record { episode, curve }, episode)),
            };
            let Some((order, episode)) = order else {
                let reason = "the disk has not given the next episode's number yet: try again, and see what `rt-controller run` says";
                reply(&asked, &Reply::Refused { reason: reason.into() });
                continue;
            };
            match self.exchange.orders.push(Asked { order, aborts: self.aborts }) {
                Ok(()) => self.waiting.push_back((asked, episode)),
                Err(_) => {
                    self.spare.insert(episode);
                    reply(&asked, &Reply::Refused { reason: "too many orders at once: try again".into() });
                }
            }
        }
    }

    /// A number that no episode has had, if the disk has given one.
    fn next_number(&mut self) -> Option<u64> {
        self.spare.pop_first().or_else(|| self.numbers.try_recv().ok())
    }

    fn status(&self) -> Status {
        let (t, c) = self.latest.unwrap_or_default();
        let x = self.exchange;
        let timing = &x.timing;
        let phase = Phase::from_code(t.phase);
        let note = self.robot_note.get();
        let disk = self.disk_note.get();
        let hindrance = match phase {
            Phase::NoRobot if !note.text.is_empty() => note.text,
            Phase::NoRobot if t.alpha_measured_deg.is_finite() => Refusal::NotUpright(t.alpha_measured_deg).to_string(),
            Phase::NoRobot => "waiting for the robot".into(),
            _ => match c.refuses {
                None | Some(Refusal::Busy) => String::new(),
                Some(Refusal::NoWeights) => format!("no weights: {}", self.refused()),
                Some(refusal) => refusal.to_string(),
            },
        };
        let may_record = phase == Phase::Idle && !c.refuses.is_some_and(|refusal| refusal.hinders_recording());
        Status {
            phase,
            hindrance,
            may_record,
            episode: t.episode,
            goal_ml: t.goal_ml,
            d_ml: t.d_ml,
            poured_ml: t.poured_ml,
            poured_sd_ml: t.poured_sd_ml,
            alpha_deg: t.alpha_deg,
            alpha_measured_deg: t.alpha_measured_deg,
            area_px2: t.area_px2,
            feature_sequence: t.feature_sequence,
            ticks: c.ticks,
            late_ticks: x.late_ticks.load(Relaxed),
            skipped_ticks: x.skipped_ticks.load(Relaxed),
            features: c.features,
            stale_features: c.stale_features,
            bridged_frames: c.bridged_frames,
            ignored_features: c.ignored_features,
            clipped: c.clipped,
            robot: note.link,
            robot_warning: note.warning,
            robot_connections: self.robot_connections.load(Relaxed),
            loop_allocations: x.loop_allocations.load(Relaxed),
            loop_page_faults: x.loop_page_faults.load(Relaxed),
            events_lost: x.events_lost.load(Relaxed),
            weights_refused: if t.weights_id == 0 { String::new() } else { self.refused() },
            weights: t.weights(),
            weights_taken: x.agents_taken.load(Relaxed),
            weights_age_s: disk.weights_written.and_then(|at| at.elapsed().ok()).map(|age| age.as_secs_f64()),
            journal: disk.journal_words(),
            space: disk.space,
            version: env!("CARGO_PKG_VERSION").into(),
            uptime_s: self.started.elapsed().as_secs_f64(),
            timing: vec![
                timing.lateness.snapshot("wake-up lateness"),
                timing.execution.snapshot("tick execution"),
                timing.feature_age.snapshot("exposure to use of V_e"),
                timing.feature_wait.snapshot("publication to use of V_e"),
                timing.wake_to_written.snapshot("wake-up to target written"),
            ],
            outcomes: self.outcomes.iter().copied().collect(),
        }
    }
}

/// Sends an answer; a client that has gone away is no error.
fn reply(asked: &Client, reply: &Reply) {
    let mut buffer = vec![0; MESSAGE_MAX];
    let Ok(bytes) = postcard::to_slice(reply, &mut buffer) else { return };
    if let Ok(loan) = asked.loan_slice_uninit(bytes.len()) {
        let _ = loan.write_from_slice(bytes).send();
    }
}

#[cfg(test)]
mod tests {
    use shared::runtime_dir::Place;

    use super::*;
    use crate::journal::Tick;

    type Port = iceoryx2::port::client::Client<Ipc, [u8], (), [u8], ()>;
    type Pending = iceoryx2::pending_response::PendingResponse<Ipc, [u8], (), [u8], ()>;

    /// What is around a service that no loop answers.
    struct Around<'a> {
        exchange: &'a Exchange,
        /// Gives it numbers of episodes.
        give: Sender<u64>,
        /// Two clients.
        ports: [Port; 2],
        /// Where two ticks for the journal have room.
        told: Receiver<Told>,
        /// Number of lines that it has said.
        said: &'a Count,
    }

    type Count = std::cell::Cell<u32>;

    /// Runs `check` with a service and what is around it.
    fn with_service(name: &str, check: impl FnOnce(Service, Around)) {
        let base = tempfile::tempdir().unwrap();
        let place = Place { name: name.into(), base: Some(base.path().into()) };
        let cell = Cell::join(&place).unwrap();
        let (exchange, note, connections, disk_note) = (Exchange::default(), RobotNote::default(), AtomicU64::new(0), DiskNote::default());
        let (give, numbers) = crossbeam::channel::bounded(2);
        let said = Count::new(0);
        let say = |_: Level, _: &str| said.set(said.get() + 1);
        let (journal, told) = crossbeam::channel::bounded(2);
        let queues = Queues { journal: Some(journal), numbers };
        let service = Service::open(&cell, &exchange, (&note, &connections), (&disk_note, queues), &say).unwrap();
        let port = || cell.control().unwrap().client_builder().initial_max_slice_len(MESSAGE_MAX).create().unwrap();
        check(service, Around { exchange: &exchange, give, ports: [port(), port()], told, said: &said });
        shared::ipc::remove_files(place);
    }

    /// Sends the request for a pour.
    fn send(port: &Port) -> Pending {
        let mut buffer = vec![0; MESSAGE_MAX];
        let bytes = postcard::to_slice(&Request::Pour { goal_ml: 50.0, flows_by_deg: None }, &mut buffer).unwrap();
        port.loan_slice_uninit(bytes.len()).unwrap().write_from_slice(bytes).send().unwrap()
    }

    /// Protects people from a pour that begins after an abort has said that the container is upright: a request that still lay in iceoryx2's queue then is passed
    /// on as one from before the abort, which the loop refuses. The next one is not.
    #[test]
    fn a_request_from_before_an_abort_is_known_as_one() {
        with_service("stopped", |mut service, Around { exchange, give, ports: [port, _], .. }| {
            give.send(7).unwrap();
            let mut passed_on = |then: &dyn Fn()| {
                let _pending = send(&port);
                then();
                service.answer();
                let asked = exchange.orders.pop().unwrap();
                exchange.events.push(Event::Ordered(7, Err(Refusal::Stopped))).unwrap();
                service.take_events();
                (asked.order.episode(), asked.aborts)
            };
            assert_eq!(passed_on(&|| exchange.abort()), (7, 0));
            assert_eq!(exchange.aborts.load(SeqCst), 1);
            assert_eq!(passed_on(&|| ()), (7, 1), "a refused order's number is the next one's");
        });
    }

    /// Protects clients from each other's answers: if the loop could not tell the answer to an order, the next answer goes to its own order all the same, and
    /// one to an order that nobody knows goes to nobody.
    #[test]
    fn a_lost_answer_leaves_the_others_theirs() {
        with_service("answers", |mut service, Around { exchange, give, ports, .. }| {
            let pending = [7, 8].map(|episode| {
                give.send(episode).unwrap();
                let pending = send(&ports[episode as usize - 7]);
                service.answer();
                pending
            });
            let mut answers_to = |episode: u64| {
                exchange.events.push(Event::Ordered(episode, Ok(()))).unwrap();
                service.take_events();
                let answer = |p: &Pending| p.receive().unwrap().map(|r| postcard::from_bytes::<Reply>(r.payload()).unwrap());
                [answer(&pending[0]), answer(&pending[1])]
            };
            assert_eq!(answers_to(99), [None, None]);
            assert_eq!(answers_to(8), [None, Some(Reply::Started { episode: 8 })]);
        });
    }

    /// Protects the journal of a long run from a disk that is slow for a while: it loses the ticks that find no room, which it counts by their numbers, and
    /// not all that come later. It is said once.
    #[test]
    fn a_slow_disk_costs_ticks_and_not_the_journal() {
        with_service("slow", |mut service, Around { exchange, told, said, .. }| {
            let mut tell = |numbers: std::ops::RangeInclusive<u64>| {
                for number in numbers {
                    let telemetry = Telemetry { tick: number, ..Telemetry::default() };
                    let robot = crate::core::Robot::that_may_move(0.0, number);
                    let (features, times) = (heapless::Vec::new(), crate::journal::Times::default());
                    let tick = Tick { now_ns: number, features, robot, order: None, agent: None, target_deg: None, d_ml: 0.0, times };
                    exchange.events.push(Event::Tick(tick, telemetry, Counters::default())).unwrap();
                }
                service.take_events();
                told.try_recv().map(|told| told.1.tick).ok()
            };
            assert_eq!([tell(1..=3), tell(4..=6), tell(7..=7)], [Some(1), Some(2), Some(4)]);
            assert_eq!(said.get(), 1, "as long as the disk is behind");
            assert!(told.try_recv().is_ok());
            assert_eq!([tell(8..=8), tell(9..=11)], [Some(8), Some(9)]);
            assert_eq!(said.get(), 2, "the disk had caught up");
            assert_eq!(service.status().journal, "4 ticks missing");
        });
    }
}
