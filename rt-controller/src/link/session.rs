//! A connected robot in the controller's loop: reads what the robot sent, and writes one target a tick.
//!
//! [`connect`](super::connect()) makes it on an ordinary thread, which also drops it. `poll` and `send` never block, allocate or panic:
//! the one buffer holds the protocol's largest packet. Every error of the socket ends the session with a [`Lost`]; a session is never
//! repaired. Dropping a session asks the program to come upright and end. If the program cannot receive that, it does so by itself 100 ms
//! after the last target.

use std::io::ErrorKind;

use super::health::{self, RUNTIME_PLAYING};
use super::network::Transport;
use super::wire::{self, Inbox, OutputRecipe, Outputs};
use super::{Mode, RobotState, TiltJoint, program};

/// Largest number of reads in one [`Session::poll`], so that a robot that floods the link cannot hold the loop: 16 of 64 KiB are 10 s of
/// packets at 500 Hz.
const MOST_READS: usize = 16;
/// How long a silence of this controller counts as the reason why the program has given up, ns: one second, which is more than the program's
/// patience, its answer's way back, and any `controller.lost_robot_ms` of use.
const SILENCE_COUNTS_NS: u64 = 1_000_000_000;
/// Number of targets whose times of sending are remembered: two seconds at 30 Hz, half a second at 125 Hz. Of older ones it is enough to know
/// that they are older.
const SENT: usize = 64;

/// Why a session is over.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub enum Lost {
    /// The robot closed the connection.
    #[error("the robot closed the connection")]
    Closed,
    /// The connection was reset, or the system reports another error on it.
    #[error("the connection to the robot broke")]
    Broken,
    /// A target would have to wait: the robot no longer takes what is sent.
    #[error("the robot takes no more targets")]
    WouldBlock,
    /// What the robot sent is not RTDE, or not in the agreed recipe.
    #[error("the robot sent bytes that do not fit the agreed recipe")]
    Protocol,
}

/// A connected robot with the program running.
#[derive(Debug)]
pub struct Session {
    stream: Box<dyn Transport>,
    inbox: Inbox,
    tilt: TiltJoint,
    output_recipe: OutputRecipe,
    input_recipe: u8,
    version: [u32; 4],
    state: RobotState,
    texts: u64,
    /// When [`Session::poll`] was last called, ns.
    polled_at_ns: u64,
    /// When the newest target was sent, ns; 0 before the first.
    sent_at_ns: u64,
    /// When the last targets were sent, ns, each at its number modulo [`SENT`].
    sent_ns: [u64; SENT],
    /// The silence of this controller that uses up the larger part of the program's patience, ns.
    silence_ns: u64,
    /// When such a silence was last seen, ns; 0 if never.
    silent_at_ns: u64,
}

impl Session {
    /// Takes over a connection on which recipes are agreed and data flow; `state` is the newest state that was received.
    pub(super) fn new(
        mut stream: Box<dyn Transport>,
        inbox: Inbox,
        (tilt, rate_hz): (TiltJoint, f64),
        (output_recipe, input_recipe): (OutputRecipe, u8),
        version: [u32; 4],
        state: RobotState,
    ) -> std::io::Result<Self> {
        stream.set_wait(None)?;
        Ok(Self {
            stream,
            inbox,
            tilt,
            output_recipe,
            input_recipe,
            version,
            state,
            texts: 0,
            polled_at_ns: state.received_at_ns,
            sent_at_ns: 0,
            sent_ns: [0; SENT],
            // A period of it is the usual silence, which is nobody's fault.
            silence_ns: ((program::patience_s(rate_hz) + 1.0 / rate_hz) / 2.0 * 1e9) as u64,
            silent_at_ns: 0,
        })
    }

    /// PolyScope's version: major, minor, bugfix, build.
    pub fn version(&self) -> [u32; 4] {
        self.version
    }

    /// The newest state; it is only as new as the last [`Session::poll`].
    pub fn state(&self) -> &RobotState {
        &self.state
    }

    /// Number of text messages received since the hand-over.
    pub fn texts(&self) -> u64 {
        self.texts
    }

    /// Takes everything that has arrived and gives the newest state. Call it once a tick, before [`super::health::check`].
    pub fn poll(&mut self, now_ns: u64) -> Result<&RobotState, Lost> {
        self.polled_at_ns = now_ns;
        if self.sent_at_ns != 0 && now_ns.saturating_sub(self.sent_at_ns) > self.silence_ns {
            self.silent_at_ns = now_ns;
        }
        self.state.was_silent = self.silent_at_ns != 0 && now_ns.saturating_sub(self.silent_at_ns) < SILENCE_COUNTS_NS;
        for _ in 0..MOST_READS {
            let space = self.inbox.space();
            let most = space.len();
            let n = match self.stream.read(space) {
                Ok(0) => return Err(Lost::Closed),
                Ok(n) => n,
                Err(e) if e.kind() == ErrorKind::WouldBlock => break,
                Err(e) if e.kind() == ErrorKind::Interrupted => continue,
                Err(_) => return Err(Lost::Broken),
            };
            self.inbox.filled(n);
            self.take_packets(now_ns)?;
            if n < most {
                break;
            }
        }
        Ok(&self.state)
    }

    /// Reads the whole packets that have arrived into the state.
    fn take_packets(&mut self, now_ns: u64) -> Result<(), Lost> {
        while let Some(packet) = self.inbox.next_packet().map_err(|_| Lost::Protocol)? {
            match packet.kind {
                wire::DATA => {
                    let outputs = Outputs::new_checked(packet.payload, self.output_recipe).ok_or(Lost::Protocol)?;
                    let before = self.state;
                    outputs.fill(&self.tilt, &mut self.state);
                    self.state.received_at_ns = now_ns;
                    if self.state.timestamp_s > before.timestamp_s {
                        self.state.advanced_at_ns = now_ns;
                    }
                    let (echo, sent) = (self.state.sequence_echo, self.state.sequence_sent);
                    if echo == sent || echo != before.sequence_echo || sent == 0 {
                        self.state.answered_at_ns = now_ns;
                    }
                    self.state.unread_since_ns = self.unread_since_ns();
                }
                wire::TEXT => self.texts += 1,
                // Answers that came late, and types of newer protocols, do not matter here.
                _ => {}
            }
        }
        Ok(())
    }

    /// When the oldest target was sent that the program has not read, ns; 0 if it has read all. A number that this session never sent is one
    /// of an old session.
    fn unread_since_ns(&self) -> u64 {
        let (echo, sent) = (self.state.sequence_echo, self.state.sequence_sent);
        if echo == sent || sent == 0 {
            return 0;
        }
        let read = if (1..sent).contains(&echo) { echo } else { 0 };
        let oldest = (read + 1).max(sent.saturating_sub(SENT as i32 - 1));
        self.sent_ns[oldest as usize % SENT]
    }

    /// Sends one target and gives its number. An alpha that is not finite is sent as [`Mode::Hold`].
    ///
    /// Either the whole packet goes to the kernel at once, or the session is over.
    pub fn send(&mut self, mode: Mode, alpha_deg: f32) -> Result<i32, Lost> {
        let (mode, alpha_deg) = if alpha_deg.is_finite() { (mode, alpha_deg) } else { (Mode::Hold, self.state.alpha_deg) };
        let sequence = self.state.sequence_sent.checked_add(1).unwrap_or(1);
        let packet = wire::encode_target(self.input_recipe, sequence, mode as i32, self.tilt.joint_rad(alpha_deg));
        loop {
            match self.stream.write(&packet) {
                Ok(n) if n == packet.len() => break,
                // A part of the packet went out; the rest could only follow later.
                Ok(_) => return Err(Lost::WouldBlock),
                Err(e) if e.kind() == ErrorKind::WouldBlock => return Err(Lost::WouldBlock),
                Err(e) if e.kind() == ErrorKind::Interrupted => {}
                Err(_) => return Err(Lost::Broken),
            }
        }
        self.state.sequence_sent = sequence;
        self.sent_at_ns = self.polled_at_ns;
        self.sent_ns[sequence as usize % SENT] = self.polled_at_ns;
        Ok(sequence)
    }
}

impl Drop for Session {
    fn drop(&mut self) {
        // If bytes were left unread, the kernel would reset the connection, and this last target would be lost with it.
        let _ = self.poll(self.polled_at_ns);
        let stopped = self.state.runtime_state != RUNTIME_PLAYING || health::stopped_for_safety(&self.state).is_some();
        let _ = self.send(if stopped { Mode::Abandon } else { Mode::Stop }, 0.0);
        self.stream.finish();
    }
}
