//! Connections in memory, in virtual time: bytes are delayed, split, held back and cut, all drawn from one seed.
//!
//! They stand for TCP between the controller and the robot: bytes come whole and in order, or the connection breaks. They run in the one
//! thread of a virtual cell; the lock is never waited for. Reads and writes do not block. They allocate; a connection's end shows as on a
//! socket.

use std::collections::VecDeque;
use std::io::{Error, ErrorKind, Read, Result, Write};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use rand::{RngExt, SeedableRng};
use rand_pcg::Pcg64Mcg;
use rt_controller::link::network::Transport;

/// Bytes that one direction holds: about what the kernel keeps for a reader that does not read (`SO_SNDBUF` of the simulated controller).
const CAPACITY_BYTES: usize = 64 * 1024;

/// One direction of a connection.
#[derive(Debug, Default)]
struct Way {
    /// Bytes on their way, with the time of their arrival.
    chunks: VecDeque<(u64, Vec<u8>)>,
    /// How many bytes are on their way.
    bytes: usize,
    /// The sender has ended it.
    finished: bool,
}

/// The state of all connections.
#[derive(Debug)]
struct Wires {
    now_ns: u64,
    ways: Vec<[Way; 2]>,
    broken: Vec<bool>,
    /// Nothing arrives before this time.
    stalled_until_ns: u64,
    /// Chunks are split before this time.
    split_until_ns: u64,
    delay_ns: u64,
    jitter_ns: u64,
    random: Pcg64Mcg,
}

/// The network between controller and robot.
#[derive(Debug, Clone)]
pub struct Wiring(Arc<Mutex<Wires>>);

impl Wiring {
    /// A network whose bytes take `delay_ns` and up to `jitter_ns` more.
    pub fn new(seed: u64, delay_ns: u64, jitter_ns: u64) -> Self {
        let random = Pcg64Mcg::seed_from_u64(seed ^ 0x9127);
        let (ways, broken) = (Vec::new(), Vec::new());
        Self(Arc::new(Mutex::new(Wires { now_ns: 0, ways, broken, stalled_until_ns: 0, split_until_ns: 0, delay_ns, jitter_ns, random })))
    }

    fn wires(&self) -> MutexGuard<'_, Wires> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets the present time, ns.
    pub fn set_now(&self, now_ns: u64) {
        self.wires().now_ns = now_ns;
    }

    /// A new connection: the controller's end and the robot's.
    pub fn connect(&self) -> (End, End) {
        let mut wires = self.wires();
        wires.ways.push(Default::default());
        wires.broken.push(false);
        let wire = wires.ways.len() - 1;
        drop(wires);
        (End { wiring: self.clone(), wire, side: 0 }, End { wiring: self.clone(), wire, side: 1 })
    }

    /// Lets nothing arrive for this time; what is sent meanwhile arrives afterwards.
    pub fn stall(&self, time_ns: u64) {
        let mut wires = self.wires();
        wires.stalled_until_ns = wires.stalled_until_ns.max(wires.now_ns + time_ns);
    }

    /// Splits what is sent in the next time into pieces.
    pub fn split(&self, time_ns: u64) {
        let mut wires = self.wires();
        wires.split_until_ns = wires.split_until_ns.max(wires.now_ns + time_ns);
    }

    /// Breaks all connections, as a reset does.
    pub fn cut(&self) {
        self.wires().broken.iter_mut().for_each(|broken| *broken = true);
    }
}

/// One end of a connection.
#[derive(Debug)]
pub struct End {
    wiring: Wiring,
    wire: usize,
    /// 0 is the controller's, 1 the robot's.
    side: usize,
}

impl Read for End {
    fn read(&mut self, buffer: &mut [u8]) -> Result<usize> {
        let mut wires = self.wiring.wires();
        if wires.broken[self.wire] {
            return Err(ErrorKind::ConnectionReset.into());
        }
        let now_ns = wires.now_ns;
        let stalled = now_ns < wires.stalled_until_ns;
        let way = &mut wires.ways[self.wire][1 - self.side];
        let mut n = 0;
        while n < buffer.len() && !stalled {
            let Some((_, chunk)) = way.chunks.front_mut().filter(|(at_ns, _)| *at_ns <= now_ns) else { break };
            let part = chunk.len().min(buffer.len() - n);
            buffer[n..n + part].copy_from_slice(&chunk[..part]);
            n += part;
            if part == chunk.len() {
                way.chunks.pop_front();
            } else {
                chunk.drain(..part);
            }
        }
        way.bytes -= n;
        if n > 0 || (way.finished && way.chunks.is_empty() && !stalled) { Ok(n) } else { Err(ErrorKind::WouldBlock.into()) }
    }
}

impl Write for End {
    fn write(&mut self, bytes: &[u8]) -> Result<usize> {
        let mut wires = self.wiring.wires();
        if wires.broken[self.wire] {
            return Err(ErrorKind::ConnectionReset.into());
        }
        if wires.ways[self.wire][self.side].bytes + bytes.len() > CAPACITY_BYTES {
            return Err(ErrorKind::WouldBlock.into());
        }
        let most_ns = wires.jitter_ns.max(1);
        let jitter_ns = wires.random.random_range(0..most_ns);
        let mut at_ns = wires.now_ns + wires.delay_ns + jitter_ns;
        if let Some((last_ns, _)) = wires.ways[self.wire][self.side].chunks.back() {
            at_ns = at_ns.max(*last_ns);
        }
        let cut = if wires.now_ns < wires.split_until_ns && bytes.len() > 1 { wires.random.random_range(1..bytes.len()) } else { 0 };
        let later_ns = wires.random.random_range(1_000_000..20_000_000);
        let way = &mut wires.ways[self.wire][self.side];
        way.bytes += bytes.len();
        if cut > 0 {
            way.chunks.push_back((at_ns, bytes[..cut].to_vec()));
            at_ns += later_ns;
        }
        way.chunks.push_back((at_ns, bytes[cut..].to_vec()));
        Ok(bytes.len())
    }

    fn flush(&mut self) -> Result<()> {
        Ok(())
    }
}

impl Transport for End {
    fn set_wait(&mut self, _within: Option<Duration>) -> Result<()> {
        Ok(())
    }

    fn finish(&mut self) {
        self.wiring.wires().ways[self.wire][self.side].finished = true;
    }
}

impl Drop for End {
    fn drop(&mut self) {
        self.finish();
    }
}

/// The error of a connection that nobody takes.
pub fn refused() -> Error {
    ErrorKind::ConnectionRefused.into()
}
