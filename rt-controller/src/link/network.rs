//! What connecting the robot stands on: a clock, a pause, and connections.
//!
//! [`Network`] and [`Transport`] are parameters, so that the same code runs on sockets ([`System`]) and in a simulated world whose time is
//! not that of this machine. Connecting happens on an ordinary thread and may block and allocate; a [`Transport`] that was told not to wait
//! never blocks, and neither allocates nor panics. Failures are those of the system, as [`std::io::Error`].

use std::io::{Read, Result, Write};
use std::net::{IpAddr, Shutdown, SocketAddr, TcpStream};
use std::time::Duration;

use shared::os;
use shared::robot_address::RobotAddress;

/// A connection to the robot.
pub trait Transport: Read + Write + std::fmt::Debug + Send {
    /// Lets the next reads wait for this long at most; `None` lets neither reads nor writes wait.
    fn set_wait(&mut self, within: Option<Duration>) -> Result<()>;
    /// Ends the direction to the robot, in order, after what was written.
    fn finish(&mut self);
}

/// A clock, a pause and connections. Times are CLOCK_MONOTONIC or what stands for it, ns.
pub trait Network {
    /// The present time, ns.
    fn now_ns(&self) -> u64;
    /// Lets this time pass.
    fn sleep(&self, time: Duration);
    /// The address of the robot now. A name is looked up, which may take seconds. The error is one line.
    fn resolve(&self, robot: &RobotAddress) -> std::result::Result<IpAddr, String> {
        robot.resolve()
    }
    /// Connects, for `within` at most; writes on the connection block for no longer than that either.
    fn open(&self, at: SocketAddr, within: Duration) -> Result<Box<dyn Transport>>;
    /// Reads what has arrived, and waits for it for `within` at most.
    fn read(&self, from: &mut dyn Transport, buffer: &mut [u8], within: Duration) -> Result<usize>;
}

/// The network and the clock of this machine.
#[derive(Debug, Clone, Copy)]
pub struct System;

impl Network for System {
    fn now_ns(&self) -> u64 {
        os::now_ns()
    }

    fn sleep(&self, time: Duration) {
        std::thread::sleep(time);
    }

    fn open(&self, at: SocketAddr, within: Duration) -> Result<Box<dyn Transport>> {
        let stream = TcpStream::connect_timeout(&at, within)?;
        stream.set_nodelay(true)?;
        stream.set_write_timeout(Some(within))?;
        Ok(Box::new(stream))
    }

    fn read(&self, from: &mut dyn Transport, buffer: &mut [u8], within: Duration) -> Result<usize> {
        from.set_wait(Some(within))?;
        from.read(buffer)
    }
}

impl Transport for TcpStream {
    fn set_wait(&mut self, within: Option<Duration>) -> Result<()> {
        match within {
            None => self.set_nonblocking(true),
            // A timeout of zero would mean that there is none.
            Some(within) => {
                self.set_nonblocking(false)?;
                self.set_read_timeout(Some(within.max(Duration::from_millis(1))))
            }
        }
    }

    fn finish(&mut self) {
        let _ = self.shutdown(Shutdown::Write);
    }
}
