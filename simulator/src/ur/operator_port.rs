//! The port that no robot has: from another process, it makes something go wrong with a simulated controller.
//!
//! A line to the controller is a [`Fault`]; the answer is `ok` or `error: ...`. Blocks the calling thread for at most a few
//! seconds; allocates. A controller that cannot be reached, or refuses, is an error.

use std::io::{BufRead, BufReader, Write};
use std::net::{IpAddr, SocketAddr, TcpStream};
use std::time::Duration;

use super::fault::Fault;

/// The port on which a controller takes faults. Chosen by hand, next to the ports of UR.
pub const OPERATOR_PORT: u16 = 29_995;
/// The answer to a fault that was injected (this project's own word).
pub const OK: &str = "ok";
/// How long a controller may take to answer. Chosen by hand, far above a control cycle.
const PATIENCE: Duration = Duration::from_secs(2);

/// A fault could not be injected into a controller of another process.
#[derive(Debug, thiserror::Error)]
pub enum SendError {
    /// No controller answers.
    #[error("no simulated controller answers at {at}: {source}; is 'simulator run' or 'simulator ur' running?")]
    Unreachable {
        /// Address and port that were tried.
        at: SocketAddr,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The controller answers, but not with "ok".
    #[error("the simulated controller at {at} refused: {answer}")]
    Refused {
        /// Address and port of the controller.
        at: SocketAddr,
        /// The controller's answer.
        answer: String,
    },
}

/// Injects a fault into the controller at `address`, which may belong to another process.
///
/// # Errors
/// No controller answers there, or it refuses the fault.
pub fn send_fault(address: IpAddr, fault: &Fault) -> Result<(), SendError> {
    let at = SocketAddr::new(address, OPERATOR_PORT);
    let talk = || -> std::io::Result<String> {
        let mut stream = TcpStream::connect_timeout(&at, PATIENCE)?;
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.write_all(format!("{fault}\n").as_bytes())?;
        let mut answer = String::new();
        BufReader::new(stream).read_line(&mut answer)?;
        Ok(answer.trim().to_owned())
    };
    match talk() {
        Ok(answer) if answer == OK => Ok(()),
        Ok(answer) => Err(SendError::Refused { at, answer }),
        Err(source) => Err(SendError::Unreachable { at, source }),
    }
}
