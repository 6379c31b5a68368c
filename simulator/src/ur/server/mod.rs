//! The sockets around the controller: one thread that steps the machine once a cycle and serves all clients in between.
//!
//! It sleeps in poll(2) until the next cycle or until a client's bytes arrive. After a late wake-up it catches up cycle by cycle
//! but sends outputs once, because a robot that is short of time skips outputs and never queues them. An ordinary thread;
//! allocates. A client's failure ends that client only; failing to listen ends the start.

mod backend;
mod client;
pub mod in_memory;

use std::net::{IpAddr, Shutdown, SocketAddr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender};
use std::time::Duration;

use rustix::event::{PollFd, PollFlags, poll};
use rustix::net::sockopt;
use shared::os::now_ns;

use super::fault::Fault;
use super::log::LogLine;
use super::machine::Machine;
use super::operator_port::OPERATOR_PORT;
use super::published::Published;
use super::rtde::InputOwners;
use backend::{Backend, StandingFaults};
use client::{Client, CycleOutput, DASHBOARD, PRIMARY, REALTIME, RTDE, SECONDARY};

/// All ports of a controller (UR's manuals, and the operator port of this project).
const PORTS: [u16; 6] = [DASHBOARD, PRIMARY, SECONDARY, REALTIME, RTDE, OPERATOR_PORT];
/// Most clients at once, on all ports together. Chosen by hand: UR names about three RTDE clients, and a test may want more.
const MAX_CLIENTS: usize = 32;
/// The kernel keeps about this many bytes at most for a client that does not read. Chosen by hand; no measurement is recorded.
const SEND_BUFFER_BYTES: usize = 64 * 1024;
/// A thread that wakes up later than this was suspended with its process, in ns. Chosen by hand; no measurement is recorded.
const SUSPENDED_NS: u64 = 1_000_000_000;

/// What the owner of the controller asks of the thread.
#[derive(Debug)]
pub enum ServerRequest {
    /// Inject a fault, and then say that it is done.
    Inject(Fault, SyncSender<()>),
    /// End the thread.
    Stop,
}

/// A port is taken, or the address is not one of this machine.
#[derive(Debug, thiserror::Error)]
#[error("cannot listen on {at}: {source}; is another simulated controller running there?")]
pub struct ListenError {
    /// Address and port.
    pub at: SocketAddr,
    /// The system's reason.
    pub source: std::io::Error,
}

/// The controller's thread: the machine, the listening sockets and the clients.
pub struct Server {
    address: IpAddr,
    backend: Backend,
    listeners: Vec<(u16, TcpListener)>,
    clients: Vec<Client<TcpStream>>,
    next_id: u64,
    published: Arc<Published>,
    requests: Receiver<ServerRequest>,
}

fn listen(address: IpAddr, port: u16) -> Result<(u16, TcpListener), ListenError> {
    let at = SocketAddr::new(address, port);
    let fail = |source| ListenError { at, source };
    let listener = TcpListener::bind(at).map_err(fail)?;
    listener.set_nonblocking(true).map_err(fail)?;
    Ok((port, listener))
}

impl Server {
    /// Listens on all ports of `address`.
    ///
    /// # Errors
    /// A port cannot be listened on.
    pub fn new(
        address: IpAddr,
        machine: Machine,
        published: Arc<Published>,
        requests: Receiver<ServerRequest>,
    ) -> Result<Self, ListenError> {
        let server = Self {
            address,
            backend: Backend { machine, owners: InputOwners::default(), faults: StandingFaults::default() },
            listeners: PORTS.into_iter().map(|port| listen(address, port)).collect::<Result<_, _>>()?,
            clients: Vec::new(),
            next_id: 1,
            published,
            requests,
        };
        server.publish(now_ns());
        Ok(server)
    }

    /// Serves until it is told to stop.
    pub fn run(mut self) {
        let period_ns = (self.backend.machine.robot.steptime_s() * 1e9).round() as u64;
        let mut next_ns = now_ns() + period_ns;
        loop {
            while let Ok(request) = self.requests.try_recv() {
                match request {
                    ServerRequest::Stop => return,
                    ServerRequest::Inject(fault, done) => {
                        self.inject(&fault);
                        self.drop_closed();
                        // Whoever asked may have given up waiting.
                        let _ = done.send(());
                    }
                }
            }
            let now = now_ns();
            if now >= next_ns {
                if now - next_ns > SUSPENDED_NS {
                    // The process was suspended, so that time did not pass for the controller.
                    next_ns = now;
                }
                while next_ns <= now {
                    self.backend.machine.step();
                    self.published.trace(&self.backend.machine);
                    next_ns += period_ns;
                }
                self.publish(next_ns - period_ns);
                self.send_cycle();
                self.reopen();
            }
            self.wait_and_serve(next_ns);
        }
    }

    fn publish(&self, at_ns: u64) {
        let rtde_clients = self.clients.iter().filter(|c| c.is_rtde()).count();
        self.published.publish(&self.backend.machine, rtde_clients, at_ns);
    }

    /// Sends what this cycle owes to all clients.
    fn send_cycle(&mut self) {
        let lines: Vec<LogLine> = self.backend.machine.take_log().collect();
        let mut output = CycleOutput::new(&self.backend, &lines);
        self.clients.iter_mut().for_each(|client| client.send_cycle(&mut output));
        self.published.log(lines);
        self.drop_closed();
    }

    fn drop_closed(&mut self) {
        let owners = &mut self.backend.owners;
        self.clients.retain(|client| {
            if !client.open {
                owners.release(client.id);
            }
            client.open
        });
    }

    /// Listens again after [`Fault::Offline`], and after [`Fault::ClosePort`] when that was cleared.
    fn reopen(&mut self) {
        let closed = &self.backend.faults.closed_ports;
        if self.listeners.len() + closed.len() >= PORTS.len() || self.backend.is_before(self.backend.faults.offline_until) {
            return;
        }
        for port in PORTS {
            if !closed.contains(&port) && !self.listeners.iter().any(|(p, _)| *p == port) {
                // A port that is still taken is tried again in the next cycle.
                self.listeners.extend(listen(self.address, port).ok());
            }
        }
    }

    /// Sleeps until `until_ns` at most, and serves the clients that have sent something by then.
    fn wait_and_serve(&mut self, until_ns: u64) {
        let Some((ports, clients)) = self.wait(until_ns) else { return };
        for i in clients {
            let faults = self.clients[i].receive(&mut self.backend);
            faults.iter().for_each(|fault| self.inject(fault));
            if self.clients[i].open {
                self.clients[i].flush();
            }
        }
        self.drop_closed();
        ports.into_iter().for_each(|port| self.accept(port));
    }

    /// Sleeps until `until_ns` at most. Gives the ports to which a client connects and the places of the clients that sent
    /// something, if there are any.
    fn wait(&self, until_ns: u64) -> Option<(Vec<u16>, Vec<usize>)> {
        let left_ns = until_ns.saturating_sub(now_ns());
        let timeout = rustix::event::Timespec { tv_sec: 0, tv_nsec: left_ns.min(999_999_999) as i64 };
        let faults = &self.backend.faults;
        let deaf = self.backend.is_before(faults.stall_until.max(faults.slow_reader_until));
        // A deaf controller does not look at its RTDE sockets at all: poll would report a hang-up again and again.
        let looked_at: Vec<usize> = (0..self.clients.len()).filter(|i| !(deaf && self.clients[*i].is_rtde())).collect();
        let mut fds: Vec<PollFd<'_>> = self.listeners.iter().map(|(_, l)| PollFd::new(l, PollFlags::IN)).collect();
        fds.extend(looked_at.iter().map(|i| PollFd::new(&self.clients[*i].stream, PollFlags::IN)));
        match poll(&mut fds, Some(&timeout)) {
            Ok(n) if n > 0 => {}
            _ => return None,
        }
        let ready: Vec<bool> = fds.iter().map(|fd| !fd.revents().is_empty()).collect();
        let (listeners, clients) = ready.split_at(self.listeners.len());
        let ports = self.listeners.iter().zip(listeners).filter(|(_, ready)| **ready).map(|((port, _), _)| *port).collect();
        let clients = looked_at.into_iter().zip(clients).filter(|(_, ready)| **ready).map(|(i, _)| i).collect();
        Some((ports, clients))
    }

    fn accept(&mut self, port: u16) {
        // A fault may have closed the port in the meantime.
        let Some((_, listener)) = self.listeners.iter().find(|(p, _)| *p == port) else { return };
        let Ok((stream, _)) = listener.accept() else { return };
        let prepared = stream.set_nonblocking(true).is_ok()
            && stream.set_nodelay(true).is_ok()
            && sockopt::set_socket_send_buffer_size(&stream, SEND_BUFFER_BYTES).is_ok();
        if !prepared || self.clients.len() >= MAX_CLIENTS {
            return;
        }
        self.clients.push(Client::new(self.next_id, port, stream, &self.backend));
        self.next_id += 1;
    }

    /// Makes something go wrong. Clients that it ends are only marked: the caller drops them when it no longer holds anybody's
    /// place in the list.
    fn inject(&mut self, fault: &Fault) {
        self.backend.inject(fault);
        match fault {
            Fault::Fin => {
                for client in self.clients.iter_mut().filter(|c| c.is_rtde()) {
                    // The connection ends in order even when unread bytes wait, where closing alone would abort it.
                    let _ = client.stream.shutdown(Shutdown::Both);
                    client.open = false;
                }
            }
            Fault::Reset => {
                for client in self.clients.iter_mut().filter(|c| c.is_rtde()) {
                    // Closing with a linger time of zero aborts the connection.
                    let _ = sockopt::set_socket_linger(&client.stream, Some(Duration::ZERO));
                    client.open = false;
                }
            }
            Fault::Offline(_) => {
                self.listeners.retain(|(port, _)| *port == OPERATOR_PORT);
                self.clients.iter_mut().filter(|c| !c.is_operator()).for_each(|c| c.open = false);
            }
            Fault::ClosePort(port) => {
                self.listeners.retain(|(p, _)| p != port);
                self.clients.iter_mut().filter(|c| c.port == *port).for_each(|c| c.open = false);
            }
            Fault::Text(message) => self.clients.iter_mut().for_each(|c| c.send_text(message)),
            _ => {}
        }
    }
}
