//! The sockets around the controller: one thread that steps the machine once a cycle and serves all clients in between.
//!
//! It sleeps in poll(2) until the next cycle or a client's bytes. After a late wake-up it catches up cycle by cycle but sends
//! outputs once, as a robot that is short of time skips outputs and never queues them. Ordinary thread; allocates. A client's
//! failure ends that client; failing to listen ends the start.

use std::io::{ErrorKind, Read, Write};
use std::net::{IpAddr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::mpsc::{Receiver, SyncSender};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, poll};
use rustix::net::sockopt;
use shared::os::now_ns;

use super::client_interface::{self, Assembler};
use super::fault::Fault;
use super::machine::{LOG_LINES, LogLine, Machine};
use super::rtde::{Context, Owners, Session};
use super::variables::Input;
use super::{Joints, OPERATOR_PORT, StartError, State, Trace, TraceRow, dashboard};

const PORTS: [u16; 6] = [29999, 30001, 30002, 30003, 30004, OPERATOR_PORT];
const DASHBOARD: u16 = 29999;
const PRIMARY: u16 = 30001;
const SECONDARY: u16 = 30002;
const REALTIME: u16 = 30003;
const RTDE: u16 = 30004;
/// Most clients at once, of all ports together. UR names about three RTDE clients; a test may want more.
const MAX_CLIENTS: usize = 32;
/// The kernel keeps at most about this much for a client that does not read, bytes.
const SEND_BUFFER_BYTES: usize = 64 * 1024;
/// An RTDE client that takes nothing for this long is disconnected, s.
const NOT_READING_S: f64 = 1.0;
/// Most bytes of answers that wait for a client.
const MAX_WAITING_BYTES: usize = 256 * 1024;
/// Longest dashboard or operator line, bytes.
const MAX_LINE_BYTES: usize = 4096;
/// Frames that arrive together under [`Fault::Coalesce`].
const COALESCED: usize = 4;
/// Most rows of a trace: ten minutes of an e-Series.
const MAX_TRACE_ROWS: usize = 300_000;

/// What the thread and its handle share.
#[derive(Debug, Default)]
pub(super) struct Shared {
    pub joints: Mutex<Joints>,
    pub state: Mutex<Option<State>>,
    pub log: Mutex<Vec<LogLine>>,
    pub trace: Mutex<Option<Trace>>,
}

/// Nothing is left half-written under these locks, so a panicked holder is no reason to stop.
pub(super) fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// What a handle asks of the thread.
#[derive(Debug)]
pub(super) enum Request {
    Inject(Fault, SyncSender<()>),
    Stop,
}

enum Role {
    Rtde { session: Box<Session>, last: Vec<u8>, held: Vec<u8>, held_frames: usize },
    Script { port: u16, assembler: Assembler },
    Lines { port: u16, line: Vec<u8> },
}

struct Client {
    id: u64,
    stream: TcpStream,
    role: Role,
    /// Bytes that must still go out; a frame that was begun is finished.
    waiting: Vec<u8>,
    /// Cycle since which the client takes nothing.
    blocked_since: Option<u64>,
    cut: usize,
    open: bool,
}

/// Faults that last. Times are cycles; a fault is on while the machine's cycle is below it.
#[derive(Default)]
struct Standing {
    hidden: Vec<String>,
    refuse_version_2: bool,
    text_on_connect: Option<String>,
    offline_until: u64,
    stall_until: u64,
    freeze_until: u64,
    slow_reader_until: u64,
    skip_until: u64,
    split_until: u64,
    coalesce_until: u64,
}

pub(super) struct Server {
    address: IpAddr,
    machine: Machine,
    owners: Owners,
    listeners: Vec<(u16, TcpListener)>,
    clients: Vec<Client>,
    next_id: u64,
    standing: Standing,
    shared: Arc<Shared>,
    requests: Receiver<Request>,
}

fn listen(address: IpAddr, port: u16) -> Result<(u16, TcpListener), StartError> {
    let at = SocketAddr::new(address, port);
    let fail = |source| StartError::Listen { at, source };
    let listener = TcpListener::bind(at).map_err(fail)?;
    listener.set_nonblocking(true).map_err(fail)?;
    Ok((port, listener))
}

impl Server {
    pub fn new(address: IpAddr, machine: Machine, shared: Arc<Shared>, requests: Receiver<Request>) -> Result<Self, StartError> {
        let server = Self {
            address,
            machine,
            owners: Owners::default(),
            listeners: PORTS.into_iter().map(|port| listen(address, port)).collect::<Result<_, _>>()?,
            clients: Vec::new(),
            next_id: 1,
            standing: Standing::default(),
            shared,
            requests,
        };
        server.publish(now_ns());
        Ok(server)
    }

    /// Serves until told to stop.
    pub fn run(mut self) {
        let period_ns = (self.machine.robot.steptime_s() * 1e9).round() as u64;
        let mut next_ns = now_ns() + period_ns;
        loop {
            while let Ok(request) = self.requests.try_recv() {
                match request {
                    Request::Stop => return,
                    Request::Inject(fault, done) => {
                        self.inject(&fault);
                        self.drop_closed();
                        // The one who asked may have given up waiting.
                        let _ = done.send(());
                    }
                }
            }
            let now = now_ns();
            if now >= next_ns {
                if now - next_ns > 1_000_000_000 {
                    // The process was suspended: that time did not pass for the controller.
                    next_ns = now;
                }
                while next_ns <= now {
                    self.machine.step();
                    self.trace();
                    next_ns += period_ns;
                }
                self.publish(next_ns - period_ns);
                self.send_cycle();
                self.reopen();
            }
            self.wait_and_serve(next_ns);
        }
    }

    fn cycles(&self, time_s: f64) -> u64 {
        self.machine.cycle() + (time_s / self.machine.robot.steptime_s()).round() as u64
    }

    fn on(&self, until: u64) -> bool {
        self.machine.cycle() < until
    }

    fn publish(&self, at_ns: u64) {
        let servo = &self.machine.robot.servo;
        *lock(&self.shared.joints) =
            Joints { target_q: servo.target_q, target_qd: servo.target_qd, actual_q: servo.actual_q, actual_qd: servo.actual_qd, at_ns };
        *lock(&self.shared.state) = Some(State {
            robot_mode: self.machine.robot_mode(),
            safety_mode: self.machine.safety_mode(),
            runtime_state: self.machine.runtime_state(),
            program: self.machine.program_name().to_owned(),
            rtde_clients: self.clients.iter().filter(|c| matches!(c.role, Role::Rtde { .. })).count(),
        });
    }

    fn trace(&self) {
        let mut trace = lock(&self.shared.trace);
        let Some(trace) = trace.as_mut().filter(|t| t.rows.len() < MAX_TRACE_ROWS) else { return };
        let servo = &self.machine.robot.servo;
        trace.rows.push(TraceRow {
            timestamp_s: self.machine.robot.timestamp_s(),
            register: self.machine.robot.inputs.double[trace.double_register],
            commanded_q: servo.commanded_q,
            servoj_calls: servo.servoj_calls,
            servoing: servo.is_servoing(),
            target_q: servo.target_q,
            target_qd: servo.target_qd,
            actual_q: servo.actual_q,
            actual_qd: servo.actual_qd,
        });
    }

    /// Sends what this cycle owes to everybody.
    fn send_cycle(&mut self) {
        let cycle = self.machine.cycle();
        let lines: Vec<LogLine> = self.machine.take_log().collect();
        let rate_hz = 1.0 / self.machine.robot.steptime_s();
        let slow_tick = cycle.is_multiple_of((rate_hz / 10.0).round() as u64);
        let standing = &self.standing;
        let stalled = cycle < standing.stall_until;
        let mut realtime = None;
        let mut state = None;
        let machine = &self.machine;
        for client in &mut self.clients {
            match &mut client.role {
                Role::Rtde { session, last, held, held_frames } => {
                    if stalled {
                        continue;
                    }
                    if cycle >= standing.coalesce_until && !held.is_empty() {
                        client.waiting.append(held);
                        *held_frames = 0;
                    }
                    let Some(mut frame) = session.output(machine).filter(|_| cycle >= standing.skip_until) else {
                        client.flush();
                        continue;
                    };
                    if cycle < standing.freeze_until && !last.is_empty() {
                        frame.clone_from(last);
                    }
                    last.clone_from(&frame);
                    if cycle < standing.coalesce_until {
                        held.append(&mut frame);
                        *held_frames += 1;
                        if *held_frames < COALESCED {
                            continue;
                        }
                        *held_frames = 0;
                        frame = std::mem::take(held);
                    }
                    client.send_or_drop(&frame, standing, cycle);
                    let most = (NOT_READING_S * rate_hz) as u64;
                    if client.blocked_since.is_some_and(|since| cycle - since > most) {
                        client.open = false;
                    }
                }
                Role::Script { port: REALTIME, .. } => {
                    let frame = realtime.get_or_insert_with(|| client_interface::realtime(machine));
                    client.send_or_drop(frame, standing, cycle);
                }
                Role::Script { port, .. } => {
                    if *port == PRIMARY {
                        for line in &lines {
                            client.waiting.extend(client_interface::log_line(machine, line).unwrap_or_default());
                        }
                    }
                    if slow_tick {
                        let frame = state.get_or_insert_with(|| client_interface::state(machine));
                        client.send_or_drop(frame, standing, cycle);
                    }
                    // A client that never reads is not sent more than the newest messages.
                    if client.waiting.len() > MAX_WAITING_BYTES {
                        client.open = false;
                    }
                }
                Role::Lines { .. } => client.flush(),
            }
        }
        {
            // Not every owner of a handle takes them.
            let mut log = lock(&self.shared.log);
            log.extend(lines);
            let over = log.len().saturating_sub(LOG_LINES);
            log.drain(..over);
        }
        self.drop_closed();
    }

    fn drop_closed(&mut self) {
        let owners = &mut self.owners;
        self.clients.retain(|client| {
            if !client.open {
                owners.release(client.id);
            }
            client.open
        });
    }

    /// Listens again after [`Fault::Offline`].
    fn reopen(&mut self) {
        if self.listeners.len() == PORTS.len() || self.on(self.standing.offline_until) {
            return;
        }
        for port in PORTS {
            if !self.listeners.iter().any(|(p, _)| *p == port) {
                // A port that is still taken is tried again in the next cycle.
                self.listeners.extend(listen(self.address, port).ok());
            }
        }
    }

    fn wait_and_serve(&mut self, until_ns: u64) {
        let left_ns = until_ns.saturating_sub(now_ns());
        let timeout = rustix::event::Timespec { tv_sec: 0, tv_nsec: left_ns.min(999_999_999) as i64 };
        let deaf = self.on(self.standing.stall_until.max(self.standing.slow_reader_until));
        let (ready_listeners, ready_clients) = {
            let flags = |client: &Client| match client.role {
                Role::Rtde { .. } if deaf => PollFlags::empty(),
                _ => PollFlags::IN,
            };
            let mut fds: Vec<PollFd<'_>> = self.listeners.iter().map(|(_, l)| PollFd::new(l, PollFlags::IN)).collect();
            // A deaf controller does not look at its RTDE sockets at all: poll would report a hang-up again and again.
            let looked_at: Vec<usize> = (0..self.clients.len()).filter(|i| !flags(&self.clients[*i]).is_empty()).collect();
            fds.extend(looked_at.iter().map(|i| PollFd::new(&self.clients[*i].stream, PollFlags::IN)));
            match poll(&mut fds, Some(&timeout)) {
                Ok(n) if n > 0 => {}
                _ => return,
            }
            let ready: Vec<bool> = fds.iter().map(|fd| !fd.revents().is_empty()).collect();
            let (listeners, clients) = ready.split_at(self.listeners.len());
            let clients: Vec<usize> = looked_at.into_iter().zip(clients).filter(|(_, r)| **r).map(|(i, _)| i).collect();
            (listeners.to_vec(), clients)
        };
        for i in ready_clients {
            self.serve(i);
        }
        self.drop_closed();
        for (i, ready) in ready_listeners.into_iter().enumerate() {
            if ready {
                self.accept(i);
            }
        }
    }

    fn accept(&mut self, listener: usize) {
        let (port, listener) = &self.listeners[listener];
        let Ok((stream, _)) = listener.accept() else { return };
        let prepared = stream.set_nonblocking(true).is_ok()
            && stream.set_nodelay(true).is_ok()
            && sockopt::set_socket_send_buffer_size(&stream, SEND_BUFFER_BYTES).is_ok();
        if !prepared || self.clients.len() >= MAX_CLIENTS {
            return;
        }
        let id = self.next_id;
        self.next_id += 1;
        let mut waiting = Vec::new();
        let role = match *port {
            RTDE => {
                let session = Box::new(Session::new(id));
                if let Some(message) = &self.standing.text_on_connect {
                    waiting.extend(session.text(message));
                }
                Role::Rtde { session, last: Vec::new(), held: Vec::new(), held_frames: 0 }
            }
            PRIMARY | SECONDARY | REALTIME => {
                if *port != REALTIME {
                    waiting.extend(client_interface::version(&self.machine));
                }
                Role::Script { port: *port, assembler: Assembler::default() }
            }
            port => {
                if port == DASHBOARD {
                    waiting.extend(format!("{}\n", dashboard::GREETING).into_bytes());
                }
                Role::Lines { port, line: Vec::new() }
            }
        };
        let mut client = Client { id, stream, role, waiting, blocked_since: None, cut: 0, open: true };
        client.flush();
        self.clients.push(client);
    }

    /// Reads what a client sent and answers it.
    fn serve(&mut self, i: usize) {
        let mut buffer = [0u8; 16 * 1024];
        // A client that floods must not keep the controller from its cycle.
        for _ in 0..8 {
            let read = match self.clients[i].stream.read(&mut buffer) {
                Ok(0) => {
                    self.end_of_input(i);
                    self.clients[i].open = false;
                    return;
                }
                Ok(n) => n,
                Err(e) if e.kind() == ErrorKind::WouldBlock => break,
                Err(e) if e.kind() == ErrorKind::Interrupted => continue,
                Err(_) => {
                    self.clients[i].open = false;
                    return;
                }
            };
            self.received(i, &buffer[..read]);
            if !self.clients[i].open {
                return;
            }
        }
        self.clients[i].flush();
    }

    fn received(&mut self, i: usize, bytes: &[u8]) {
        let client = &mut self.clients[i];
        match &mut client.role {
            Role::Rtde { session, .. } => {
                let mut context = Context {
                    machine: &mut self.machine,
                    owners: &mut self.owners,
                    hidden: &self.standing.hidden,
                    refuse_version_2: self.standing.refuse_version_2,
                };
                let fed = session.feed(bytes, &mut context, &mut client.waiting);
                if fed.is_err() || client.waiting.len() > MAX_WAITING_BYTES {
                    client.open = false;
                }
            }
            Role::Script { assembler, .. } => {
                for program in assembler.feed(bytes) {
                    upload(&mut self.machine, program);
                }
            }
            Role::Lines { port, line } => {
                let port = *port;
                line.extend(bytes);
                let mut complete = Vec::new();
                while let Some(end) = line.iter().position(|b| *b == b'\n') {
                    complete.push(line.drain(..=end).collect::<Vec<u8>>());
                }
                if line.len() > MAX_LINE_BYTES {
                    client.open = false;
                }
                for line in complete {
                    self.line(i, port, String::from_utf8_lossy(&line).trim());
                }
            }
        }
    }

    fn end_of_input(&mut self, i: usize) {
        if let Role::Script { assembler, .. } = &mut self.clients[i].role
            && let Some(program) = assembler.finish()
        {
            upload(&mut self.machine, program);
        }
    }

    fn line(&mut self, i: usize, port: u16, line: &str) {
        let answer = if port == DASHBOARD {
            dashboard::answer(line, &mut self.machine)
        } else {
            Some(match line.parse::<Fault>() {
                Ok(fault) => {
                    self.inject(&fault);
                    "ok".to_owned()
                }
                Err(error) => format!("error: {error}"),
            })
        };
        let client = &mut self.clients[i];
        match answer {
            Some(answer) => client.waiting.extend(format!("{answer}\n").into_bytes()),
            None => {
                client.waiting.extend(b"Disconnected\n");
                client.flush();
                client.open = false;
            }
        }
        if client.waiting.len() > MAX_WAITING_BYTES {
            client.open = false;
        }
    }

    fn rtde_clients(&mut self) -> impl Iterator<Item = &mut Client> {
        self.clients.iter_mut().filter(|c| matches!(c.role, Role::Rtde { .. }))
    }

    /// Clients that it ends are only marked: the caller drops them when it no longer holds anybody's place in the list.
    fn inject(&mut self, fault: &Fault) {
        match fault {
            Fault::Fin => {
                for client in self.rtde_clients() {
                    // In order even when unread bytes wait: closing alone would abort then.
                    let _ = client.stream.shutdown(Shutdown::Both);
                    client.open = false;
                }
            }
            Fault::Reset => {
                for client in self.rtde_clients() {
                    // Closing with a linger time of zero aborts the connection.
                    let _ = sockopt::set_socket_linger(&client.stream, Some(Duration::ZERO));
                    client.open = false;
                }
            }
            Fault::Offline(s) => {
                self.standing.offline_until = self.cycles(*s);
                self.listeners.retain(|(port, _)| *port == OPERATOR_PORT);
                self.clients.iter_mut().filter(|c| !c.is_operator()).for_each(|c| c.open = false);
            }
            Fault::Stall(s) => self.standing.stall_until = self.cycles(*s),
            Fault::Freeze(s) => self.standing.freeze_until = self.cycles(*s),
            Fault::SlowReader(s) => self.standing.slow_reader_until = self.cycles(*s),
            Fault::SkipOutputs(n) => self.standing.skip_until = self.machine.cycle() + u64::from(*n) + 1,
            Fault::Split(s) => self.standing.split_until = self.cycles(*s),
            Fault::Coalesce(s) => self.standing.coalesce_until = self.cycles(*s),
            Fault::InUse(name) => {
                if let Some(input) = Input::parse(name) {
                    self.owners.claim_for_fieldbus(input);
                }
            }
            Fault::NotFound(name) => self.standing.hidden.push(name.clone()),
            Fault::RefuseVersion2 => self.standing.refuse_version_2 = true,
            Fault::Text(message) => {
                for client in &mut self.clients {
                    if let Role::Rtde { session, .. } = &client.role {
                        client.waiting.extend(session.text(message));
                        client.flush();
                    }
                }
            }
            Fault::TextOnConnect(message) => self.standing.text_on_connect = Some(message.clone()),
            Fault::ProtectiveStop => self.machine.protective_stop("injected"),
            Fault::EmergencyStop => self.machine.emergency_stop(),
            Fault::EmergencyRelease => self.machine.release_emergency_stop(),
            Fault::LateStart(s) => self.machine.set_late_start(*s),
            Fault::ProgramStop => drop(self.machine.stop_program()),
            Fault::ProgramPause => drop(self.machine.pause()),
            Fault::SpeedSlider(share) => self.machine.robot.set_speed_slider(*share),
            Fault::LocalControl => self.machine.set_remote_control(false),
            Fault::RemoteControl => self.machine.set_remote_control(true),
            Fault::Clear => {
                self.standing = Standing::default();
                self.owners.release_fieldbus();
                self.machine.set_late_start(0.0);
            }
        }
    }
}

fn upload(machine: &mut Machine, program: Result<String, &'static str>) {
    match program {
        Ok(source) => machine.upload(&source),
        Err(what) => machine.program_error(what),
    }
}

impl Client {
    fn is_operator(&self) -> bool {
        matches!(self.role, Role::Lines { port: OPERATOR_PORT, .. })
    }

    /// Sends a frame whole, in part with the rest to follow, or not at all when the client is not taking bytes.
    fn send_or_drop(&mut self, frame: &[u8], standing: &Standing, cycle: u64) {
        self.flush();
        if !self.waiting.is_empty() {
            self.blocked_since.get_or_insert(cycle);
            return;
        }
        self.waiting.extend(frame);
        let mut piece = frame.len();
        if matches!(self.role, Role::Rtde { .. }) && cycle < standing.split_until {
            // One piece now, the rest with the next cycle; the cut wanders through header and payload.
            const CUTS: [usize; 5] = [1, 2, 3, 4, 11];
            self.cut = (self.cut + 1) % CUTS.len();
            piece = CUTS[self.cut].min(frame.len());
        }
        if self.write(piece) == 0 {
            self.waiting.clear();
            self.blocked_since.get_or_insert(cycle);
        }
    }

    /// Sends what waits.
    fn flush(&mut self) {
        self.write(self.waiting.len());
    }

    /// Sends up to `most` bytes of what waits; gives how many the kernel took.
    fn write(&mut self, most: usize) -> usize {
        let mut sent = 0;
        while sent < most {
            match self.stream.write(&self.waiting[sent..most]) {
                Ok(0) => break,
                Ok(n) => sent += n,
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(e) if e.kind() == ErrorKind::WouldBlock => break,
                Err(_) => {
                    self.open = false;
                    break;
                }
            }
        }
        self.waiting.drain(..sent);
        if sent > 0 {
            self.blocked_since = None;
        }
        sent
    }
}
