//! The connection that carries the program to the robot, over the first of three ports that is open.
//!
//! It runs on the connecting thread, allocates, and blocks for two seconds at most for each port that does not answer. Each failure is a
//! [`LinkError`].

use std::net::{IpAddr, SocketAddr};

use super::dialogue::open;
use super::error::{ANSWER, LinkError};
use super::network::{Network, Transport};

/// The ports that take programs, in the order in which they are tried: the secondary, the primary and the real-time client interface. The
/// last one has been deprecated for programs since PolyScope 3.5. All of them stream state, which is read and thrown away here.
pub const SCRIPT_PORTS: [u16; 3] = [30002, 30001, 30003];

/// The connection that carries the program; closed when dropped.
pub(super) struct Upload {
    stream: Box<dyn Transport>,
    at: SocketAddr,
}

impl Upload {
    /// Connects, and sends nothing yet. A script port that cannot be connected to is passed over. It may take seconds, so whoever sends looks at the
    /// robot afterwards.
    pub fn open(network: &dyn Network, address: IpAddr) -> Result<Self, LinkError> {
        let mut closed = Vec::new();
        for port in SCRIPT_PORTS {
            let at = SocketAddr::new(address, port);
            match open(network, at) {
                Ok(stream) => return Ok(Self { stream, at }),
                Err(LinkError::Unreachable { what, .. }) => closed.push(format!("{port}: {what}")),
                Err(e) => return Err(e),
            }
        }
        Err(LinkError::ScriptPortsClosed { address, closed: closed.join(", ") })
    }

    /// Sends `program`. An error is final, because the program may have been taken.
    pub fn send(&mut self, program: &str) -> Result<(), LinkError> {
        let at = self.at;
        let lost = |e: std::io::Error| LinkError::Lost { at, doing: "the program's upload", what: e.kind().to_string() };
        self.stream.set_wait(Some(ANSWER)).map_err(lost)?;
        self.stream.write_all(program.as_bytes()).map_err(lost)
    }

    /// Sends `program` over a new connection to the same port.
    pub fn send_again(&mut self, network: &dyn Network, program: &str) -> Result<(), LinkError> {
        self.stream = open(network, self.at)?;
        self.send(program)
    }

    /// Reads what has arrived, because a robot may drop a client, and its program, that does not read (URScript manual). Errors do not matter: the
    /// program's sign of life is what counts, and until then the connection stays open.
    pub fn discard(&mut self) {
        let mut buffer = [0; 4096];
        let _ = self.stream.set_wait(None);
        while let Ok(1..) = self.stream.read(&mut buffer) {}
    }
}
