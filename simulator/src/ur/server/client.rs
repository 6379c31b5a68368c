//! One client of the controller: what it sends is read and obeyed, and what a control cycle owes it is sent.
//!
//! Runs on the controller's thread, and its sockets never block it; allocates within bounds. A client that fails, floods or does
//! not read loses its connection, and nobody else notices.

use std::io::{ErrorKind, Read, Write};

use super::backend::Backend;
use crate::ur::client_interface::{self, ProgramAssembler};
use crate::ur::dashboard;
use crate::ur::fault::Fault;
use crate::ur::log::LogLine;
use crate::ur::machine::Machine;
use crate::ur::operator_port::{self, OPERATOR_PORT};
use crate::ur::rtde::{RtdeSession, SessionContext};

/// The dashboard server's port (UR's dashboard server manual).
pub const DASHBOARD: u16 = 29999;
/// The primary client interface's port (UR's client interface tables).
pub const PRIMARY: u16 = 30001;
/// The secondary client interface's port (UR's client interface tables).
pub const SECONDARY: u16 = 30002;
/// The real-time client interface's port (UR's client interface tables).
pub const REALTIME: u16 = 30003;
/// The RTDE interface's port (UR's RTDE guide).
pub const RTDE: u16 = 30004;

/// An RTDE client that takes nothing for this long is disconnected, in s. Chosen by hand; no measurement is recorded.
const NOT_READING_S: f64 = 1.0;
/// Most bytes of answers that wait for a client. Chosen by hand; no measurement is recorded.
const MAX_WAITING_BYTES: usize = 256 * 1024;
/// Longest line to the dashboard or the operator port, in bytes. Chosen by hand; no measurement is recorded.
const MAX_LINE_BYTES: usize = 4096;
/// Most bytes that are read at once. Chosen by hand; no measurement is recorded.
const READ_BYTES: usize = 16 * 1024;
/// Most reads in a row, so that a client which floods does not keep the controller from its cycle. Chosen by hand; no measurement
/// is recorded.
const MAX_READS: usize = 8;
/// Number of packets that arrive together under [`Fault::Coalesce`], as its help text says.
const COALESCED: usize = 4;
/// Lengths of the first piece of a packet under [`Fault::Split`], in bytes. Chosen by hand: they cut the header, and the payload
/// after the recipe id.
const CUTS: [usize; 5] = [1, 2, 3, 4, 11];

/// An RTDE session, and the packets that faults hold back or repeat.
struct RtdeRole {
    session: Box<RtdeSession>,
    /// The packet sent last, for [`Fault::Freeze`].
    last: Vec<u8>,
    /// Packets that are held back, for [`Fault::Coalesce`].
    held: Vec<u8>,
    held_packets: usize,
}

/// What a client talks, by the port that it came to.
enum Role {
    Rtde(RtdeRole),
    Script { port: u16, assembler: ProgramAssembler },
    Lines { port: u16, line: Vec<u8> },
}

/// What a control cycle owes to all clients. The packages are made once, when the first client needs them.
pub struct CycleOutput<'a> {
    backend: &'a Backend,
    lines: &'a [LogLine],
    realtime: Option<Vec<u8>>,
    state: Option<Vec<u8>>,
}

impl<'a> CycleOutput<'a> {
    /// The present cycle of `backend`, in which `lines` were logged.
    pub fn new(backend: &'a Backend, lines: &'a [LogLine]) -> Self {
        Self { backend, lines, realtime: None, state: None }
    }
}

/// A connected client, over a connection that does not block.
pub struct Client<S> {
    /// A number that no other client ever has.
    pub id: u64,
    /// The port that it came to.
    pub port: u16,
    /// The connection, which does not block.
    pub stream: S,
    /// False when the connection is to be dropped.
    pub open: bool,
    role: Role,
    /// Bytes that must still go out; a packet that was begun is finished.
    waiting: Vec<u8>,
    /// Cycle since which the client takes nothing.
    blocked_since: Option<u64>,
    /// Which of the [`CUTS`] was used last.
    cut: usize,
}

impl<S: Read + Write> Client<S> {
    /// Greets a client that connected to `port`.
    pub fn new(id: u64, port: u16, stream: S, backend: &Backend) -> Self {
        let mut waiting = Vec::new();
        let role = match port {
            RTDE => {
                let session = Box::new(RtdeSession::new(id));
                if let Some(message) = &backend.faults.text_on_connect {
                    waiting.extend(session.text(message));
                }
                Role::Rtde(RtdeRole { session, last: Vec::new(), held: Vec::new(), held_packets: 0 })
            }
            PRIMARY | SECONDARY | REALTIME => {
                if port != REALTIME {
                    waiting.extend(client_interface::version_package(&backend.machine));
                }
                Role::Script { port, assembler: ProgramAssembler::default() }
            }
            port => {
                if port == DASHBOARD {
                    waiting.extend(format!("{}\n", dashboard::GREETING).into_bytes());
                }
                Role::Lines { port, line: Vec::new() }
            }
        };
        let mut client = Self { id, port, stream, open: true, role, waiting, blocked_since: None, cut: 0 };
        client.flush();
        client
    }

    /// True for a client on the operator port.
    pub fn is_operator(&self) -> bool {
        matches!(self.role, Role::Lines { port: OPERATOR_PORT, .. })
    }

    /// True for a client on the RTDE port.
    pub fn is_rtde(&self) -> bool {
        matches!(self.role, Role::Rtde(_))
    }

    /// Sends a text message now, if this is an RTDE client.
    pub fn send_text(&mut self, message: &str) {
        if let Role::Rtde(rtde) = &self.role {
            self.waiting.extend(rtde.session.text(message));
            self.flush();
        }
    }

    /// Reads and obeys what the client sent. Answers wait until the next flush. Gives the faults that an operator asks for, which
    /// are to be injected before that.
    pub fn receive(&mut self, backend: &mut Backend) -> Vec<Fault> {
        let mut faults = Vec::new();
        let mut buffer = [0u8; READ_BYTES];
        for _ in 0..MAX_READS {
            match self.stream.read(&mut buffer) {
                Ok(0) => {
                    self.end_of_input(backend);
                    self.open = false;
                }
                Ok(n) => faults.extend(self.obey(&buffer[..n], backend)),
                Err(e) if e.kind() == ErrorKind::WouldBlock => break,
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(_) => self.open = false,
            }
            if !self.open {
                break;
            }
        }
        faults
    }

    fn obey(&mut self, bytes: &[u8], backend: &mut Backend) -> Vec<Fault> {
        match &mut self.role {
            Role::Rtde(rtde) => {
                let mut context = SessionContext {
                    machine: &mut backend.machine,
                    owners: &mut backend.owners,
                    hidden: &backend.faults.hidden,
                    refuse_version_2: backend.faults.refuse_version_2,
                };
                let fed = rtde.session.feed(bytes, &mut context, &mut self.waiting);
                if fed.is_err() || self.waiting.len() > MAX_WAITING_BYTES {
                    self.open = false;
                }
                Vec::new()
            }
            Role::Script { assembler, .. } => {
                assembler.feed(bytes).into_iter().for_each(|program| backend.upload(program));
                Vec::new()
            }
            Role::Lines { port, line } => {
                let port = *port;
                line.extend(bytes);
                let mut complete = Vec::new();
                while let Some(end) = line.iter().position(|b| *b == b'\n') {
                    complete.push(line.drain(..=end).collect::<Vec<u8>>());
                }
                if line.len() > MAX_LINE_BYTES {
                    self.open = false;
                }
                complete.iter().filter_map(|line| self.obey_line(port, String::from_utf8_lossy(line).trim(), backend)).collect()
            }
        }
    }

    /// Answers a line to the dashboard or the operator port. Gives the fault that the operator asks for.
    fn obey_line(&mut self, port: u16, line: &str, backend: &mut Backend) -> Option<Fault> {
        let mut fault = None;
        let answer = if port == DASHBOARD {
            dashboard::answer(line, &mut backend.machine)
        } else {
            Some(match line.parse::<Fault>() {
                Ok(asked) => {
                    fault = Some(asked);
                    operator_port::OK.to_owned()
                }
                Err(error) => format!("error: {error}"),
            })
        };
        match answer {
            Some(answer) => self.waiting.extend(format!("{answer}\n").into_bytes()),
            None => {
                self.waiting.extend(b"Disconnected\n");
                self.flush();
                self.open = false;
            }
        }
        if self.waiting.len() > MAX_WAITING_BYTES {
            self.open = false;
        }
        fault
    }

    fn end_of_input(&mut self, backend: &mut Backend) {
        if let Role::Script { assembler, .. } = &mut self.role
            && let Some(program) = assembler.finish()
        {
            backend.upload(program);
        }
    }

    /// Sends what this cycle owes to the client.
    pub fn send_cycle(&mut self, output: &mut CycleOutput<'_>) {
        let backend = output.backend;
        match &self.role {
            Role::Rtde(_) => self.send_rtde(backend),
            Role::Script { port: REALTIME, .. } => {
                let package = output.realtime.get_or_insert_with(|| client_interface::realtime_package(&backend.machine));
                self.send_or_drop(package, backend);
            }
            Role::Script { port, .. } => {
                if *port == PRIMARY {
                    let packages = output.lines.iter().filter_map(|line| client_interface::log_package(&backend.machine, line));
                    packages.for_each(|package| self.waiting.extend(package));
                }
                if is_state_due(&backend.machine) {
                    let package = output.state.get_or_insert_with(|| client_interface::state_package(&backend.machine));
                    self.send_or_drop(package, backend);
                }
                // A client that never reads would otherwise collect messages for ever.
                if self.waiting.len() > MAX_WAITING_BYTES {
                    self.open = false;
                }
            }
            Role::Lines { .. } => self.flush(),
        }
    }

    /// Sends the data packet of this cycle, as the faults that are on change it.
    fn send_rtde(&mut self, backend: &Backend) {
        let Role::Rtde(rtde) = &mut self.role else { return };
        let faults = &backend.faults;
        if backend.is_before(faults.stall_until) {
            return;
        }
        let coalesce = backend.is_before(faults.coalesce_until);
        if !coalesce && !rtde.held.is_empty() {
            self.waiting.append(&mut rtde.held);
            rtde.held_packets = 0;
        }
        let Some(mut packet) = rtde.session.output(&backend.machine).filter(|_| !backend.is_before(faults.skip_until)) else {
            return self.flush();
        };
        if backend.is_before(faults.freeze_until) && !rtde.last.is_empty() {
            packet.clone_from(&rtde.last);
        }
        rtde.last.clone_from(&packet);
        if backend.is_before(faults.twice_until) {
            packet.extend_from_within(..);
        }
        if coalesce {
            rtde.held.append(&mut packet);
            rtde.held_packets += 1;
            if rtde.held_packets < COALESCED {
                return;
            }
            rtde.held_packets = 0;
            packet = std::mem::take(&mut rtde.held);
        }
        self.send_or_drop(&packet, backend);
        let max_cycles = (NOT_READING_S * rate_hz(&backend.machine)) as u64;
        if self.blocked_since.is_some_and(|since| backend.machine.cycle() - since > max_cycles) {
            self.open = false;
        }
    }

    /// Sends a packet whole, in part with the rest to follow, or not at all when the client is not taking bytes.
    fn send_or_drop(&mut self, packet: &[u8], backend: &Backend) {
        let cycle = backend.machine.cycle();
        self.flush();
        if !self.waiting.is_empty() {
            self.blocked_since.get_or_insert(cycle);
            return;
        }
        self.waiting.extend(packet);
        let mut piece = packet.len();
        if self.is_rtde() && backend.is_before(backend.faults.split_until) {
            // One piece goes now and the rest with the next cycle. The cut wanders through header and payload.
            self.cut = (self.cut + 1) % CUTS.len();
            piece = CUTS[self.cut].min(packet.len());
        }
        if self.write(piece) == 0 {
            self.waiting.clear();
            self.blocked_since.get_or_insert(cycle);
        }
    }

    /// Sends what waits.
    pub fn flush(&mut self) {
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

fn rate_hz(machine: &Machine) -> f64 {
    1.0 / machine.robot.steptime_s()
}

/// True in the cycles in which the primary and secondary interfaces send state, 10 times a second (UR's client interface tables).
fn is_state_due(machine: &Machine) -> bool {
    machine.cycle().is_multiple_of((rate_hz(machine) / 10.0).round() as u64)
}
