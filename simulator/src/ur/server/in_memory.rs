//! A controller without sockets and without a clock: its clients are whatever reads and writes bytes, and its owner steps it.
//!
//! Pure; any thread. It allocates as the controller with sockets does, within the same bounds. What a client does cannot make it fail. The
//! connections must not block, as the sockets of the controller do not.

use std::io::{Read, Write};

use super::backend::{Backend, StandingFaults};
use super::client::{Client, CycleOutput, DASHBOARD, PRIMARY, REALTIME, RTDE, SECONDARY};
use crate::ur::fault::Fault;
use crate::ur::log::LogLine;
use crate::ur::machine::Machine;
use crate::ur::rtde::InputOwners;

/// The ports that a client can connect to; the operator of such a controller is its owner.
const PORTS: [u16; 5] = [DASHBOARD, PRIMARY, SECONDARY, REALTIME, RTDE];

/// A controller whose clients are connected by `S`.
pub struct InMemory<S> {
    backend: Backend,
    clients: Vec<Client<S>>,
    next_id: u64,
}

impl<S: Read + Write> InMemory<S> {
    /// A controller around `machine`, without clients.
    pub fn new(machine: Machine) -> Self {
        let backend = Backend { machine, owners: InputOwners::default(), faults: StandingFaults::default() };
        Self { backend, clients: Vec::new(), next_id: 1 }
    }

    /// The controller without its clients.
    pub fn machine(&self) -> &Machine {
        &self.backend.machine
    }

    /// Whether a client could connect to `port` now.
    pub fn listens(&self, port: u16) -> bool {
        let faults = &self.backend.faults;
        PORTS.contains(&port) && !faults.closed_ports.contains(&port) && !self.backend.is_before(faults.offline_until)
    }

    /// Whether the controller does not even accept connections or take bytes for RTDE at present.
    fn is_deaf(&self) -> bool {
        self.backend.is_before(self.backend.faults.stall_until.max(self.backend.faults.slow_reader_until))
    }

    /// Takes a client that connected to `port`; false if nobody listens there.
    pub fn connect(&mut self, port: u16, stream: S) -> bool {
        let listens = self.listens(port);
        if listens {
            self.clients.push(Client::new(self.next_id, port, stream, &self.backend));
            self.next_id += 1;
        }
        listens
    }

    /// Obeys what the clients have sent by now.
    pub fn serve(&mut self) {
        let deaf = self.is_deaf();
        for client in &mut self.clients {
            if deaf && client.is_rtde() {
                continue;
            }
            // Nobody reaches the operator port here, so no fault is asked for.
            client.receive(&mut self.backend);
            if client.open {
                client.flush();
            }
        }
        self.drop_closed();
    }

    /// Lets a control cycle pass and sends what it owes to all clients. Gives the lines that were logged in it.
    pub fn cycle(&mut self) -> Vec<LogLine> {
        self.backend.machine.step();
        let lines: Vec<LogLine> = self.backend.machine.take_log().collect();
        let mut output = CycleOutput::new(&self.backend, &lines);
        self.clients.iter_mut().for_each(|client| client.send_cycle(&mut output));
        self.drop_closed();
        lines
    }

    /// Makes something go wrong. A connection that it ends is dropped; whether that is an end in order is the connection's matter.
    pub fn inject(&mut self, fault: &Fault) {
        self.backend.inject(fault);
        match fault {
            Fault::Fin | Fault::Reset => self.clients.retain(|client| !client.is_rtde()),
            Fault::Offline(_) => self.clients.clear(),
            Fault::ClosePort(port) => self.clients.retain(|client| client.port != *port),
            Fault::Text(message) => self.clients.iter_mut().for_each(|client| client.send_text(message)),
            _ => {}
        }
        if self.clients.is_empty() || matches!(fault, Fault::Fin | Fault::Reset) {
            self.release_left();
        }
    }

    /// Gives back the inputs of clients that are gone.
    fn release_left(&mut self) {
        let left = (1..self.next_id).filter(|id| !self.clients.iter().any(|client| client.id == *id));
        left.for_each(|id| self.backend.owners.release(id));
    }

    fn drop_closed(&mut self) {
        if self.clients.iter().any(|client| !client.open) {
            self.clients.retain(|client| client.open);
            self.release_left();
        }
    }
}
