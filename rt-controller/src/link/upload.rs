//! The connection that carries the program to the robot, over the first of three ports that is open.
//!
//! It runs on the connecting thread, allocates, and blocks for two seconds at most for each port that does not answer. Each failure is a
//! [`LinkError`].

use std::net::{IpAddr, SocketAddr};

use super::dialogue::open;
use super::error::LinkError;
use super::network::{Network, Transport};

/// The ports that take programs, in the order in which they are tried: the secondary, the primary and the real-time client interface. The
/// last one has been deprecated for programs since PolyScope 3.5. All of them stream state, which is read and thrown away here.
pub const SCRIPT_PORTS: [u16; 3] = [30002, 30001, 30003];

/// The connection that carries the program; closed when dropped.
pub(super) struct Upload {
    stream: Box<dyn Transport>,
}

impl Upload {
    /// Connects and sends `program`. A script port that cannot be connected to is passed over; an error on one that can is final, because the
    /// program may then have been taken.
    pub fn send(network: &dyn Network, address: IpAddr, program: &str) -> Result<Self, LinkError> {
        let mut closed = Vec::new();
        for port in SCRIPT_PORTS {
            let at = SocketAddr::new(address, port);
            let mut stream = match open(network, at) {
                Ok(stream) => stream,
                Err(LinkError::Unreachable { what, .. }) => {
                    closed.push(format!("{port}: {what}"));
                    continue;
                }
                Err(e) => return Err(e),
            };
            let lost = |e: std::io::Error| LinkError::Lost { at, doing: "the program's upload", what: e.kind().to_string() };
            stream.write_all(program.as_bytes()).map_err(lost)?;
            stream.set_wait(None).map_err(lost)?;
            return Ok(Self { stream });
        }
        Err(LinkError::ScriptPortsClosed { address, closed: closed.join(", ") })
    }

    /// Reads what has arrived, because a robot may drop a program whose sender does not read (URScript manual). Errors do not matter: the
    /// program's sign of life is what counts, and until then the connection stays open.
    pub fn discard(&mut self) {
        let mut buffer = [0; 4096];
        while let Ok(1..) = self.stream.read(&mut buffer) {}
    }
}
