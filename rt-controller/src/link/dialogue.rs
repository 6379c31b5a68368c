//! The RTDE connection while a session is set up: requests and their answers, with blocking reads.
//!
//! It runs on the connecting thread and allocates. Each step blocks for [`ANSWER`] at most. Each failure is a [`LinkError`].

use std::io::ErrorKind;
use std::net::{IpAddr, SocketAddr};
use std::time::Duration;

use super::error::{ANSWER, LinkError};
use super::network::{Network, Transport};
use super::wire::{self, Inbox, OutputRecipe, Outputs};
use super::{RobotState, TiltJoint};

/// The robot's port for RTDE (Universal Robots, RTDE guide).
const RTDE_PORT: u16 = 30004;
/// Longest request, bytes. Chosen by hand: the output recipe with its eighteen names has about 350.
const REQUEST_MAX: usize = 1024;

/// The RTDE connection while it is being set up.
pub(super) struct Dialogue<'a> {
    /// The clock, and what the connection goes over.
    network: &'a dyn Network,
    /// The robot's address and port.
    pub at: SocketAddr,
    /// The connection.
    pub stream: Box<dyn Transport>,
    /// What has arrived on it and was not read yet.
    pub inbox: Inbox,
    /// The robot's newest text message, ready to be put behind an error; empty before the first.
    pub said: String,
}

impl<'a> Dialogue<'a> {
    /// Connects to the robot's RTDE port.
    pub fn open(network: &'a dyn Network, address: IpAddr) -> Result<Self, LinkError> {
        let at = SocketAddr::new(address, RTDE_PORT);
        let refused = std::io::ErrorKind::ConnectionRefused.to_string();
        let stream = open(network, at).map_err(|e| match e {
            LinkError::Unreachable { what, .. } if what == refused => LinkError::RtdeRefused { at },
            e => e,
        })?;
        Ok(Self { network, at, stream, inbox: Inbox::new(), said: String::new() })
    }

    /// Sends a request and waits for its answer, which `read` decodes; `read` gives `None` for bytes that are no such answer.
    pub fn ask<T>(&mut self, kind: u8, payload: &[&[u8]], doing: &'static str, read: impl Fn(&[u8]) -> Option<T>) -> Result<T, LinkError> {
        let mut buffer = [0; REQUEST_MAX];
        let request = wire::encode(kind, payload, &mut buffer).unwrap_or_default();
        self.stream.write_all(request).map_err(|e| self.lost(doing, &e))?;
        let answer = self.wait(doing, ANSWER, |packet| (packet.kind == kind).then(|| read(packet.payload)))?;
        answer.ok_or_else(|| self.no_answer(doing))?.ok_or_else(|| self.unexpected(doing))
    }

    /// Agrees on the input recipe of `variables`, names and types, and gives its id.
    pub fn agree_inputs(&mut self, variables: &[(String, &'static str)]) -> Result<u8, LinkError> {
        let doing = "the request for the input recipe";
        let (id, types) = self.request_recipe(wire::SETUP_INPUTS, &[], variables, doing)?;
        self.check_recipe(id, variables, &types, doing)
    }

    /// Agrees on the output recipe at `rate_hz`, with registers from `base`: everything that is needed, and of what is asked for too as much
    /// as the robot knows.
    pub fn agree_outputs(&mut self, rate_hz: f64, base: u8) -> Result<OutputRecipe, LinkError> {
        let doing = "the request for the output recipe";
        let needed = wire::output_names(base);
        let extras = wire::extra_names();
        let mut known = extras.iter().map(|_| true).collect::<Vec<_>>();
        loop {
            let asked = extras.iter().zip(&known).filter(|(_, known)| **known).map(|(extra, _)| extra.clone());
            let variables: Vec<_> = needed.iter().cloned().chain(asked).collect();
            let (id, types) = self.request_recipe(wire::SETUP_OUTPUTS, &rate_hz.to_be_bytes(), &variables, doing)?;
            let mut unknown = false;
            for ((name, _), given) in variables.iter().zip(&types).skip(needed.len()) {
                if given == "NOT_FOUND"
                    && let Some(k) = extras.iter().position(|(extra, _)| extra == name)
                {
                    (known[k], unknown) = (false, true);
                }
            }
            // A variable that is needed and missing is an error at once. Of the others, the next request leaves out what is missing; there
            // are fewer of them each time.
            let (id, types) = if unknown { (1, &types[..needed.len()]) } else { (id, &types[..]) };
            let id = self.check_recipe(id, &variables[..types.len()], types, doing)?;
            if !unknown {
                return Ok(OutputRecipe::new(id, std::array::from_fn(|k| known.get(k) == Some(&true))));
            }
        }
    }

    /// Asks for a recipe of `variables`, and gives its id and as many types.
    fn request_recipe(
        &mut self,
        kind: u8,
        head: &[u8],
        variables: &[(String, &'static str)],
        doing: &'static str,
    ) -> Result<(u8, Vec<String>), LinkError> {
        let names: Vec<&str> = variables.iter().map(|(name, _)| name.as_str()).collect();
        let names = names.join(",");
        let (id, types) =
            self.ask(kind, &[head, names.as_bytes()], doing, |payload| wire::recipe(payload).map(|(id, types)| (id, types.to_owned())))?;
        // Some controllers end the list with a comma.
        let types: Vec<String> = types.strip_suffix(',').unwrap_or(&types).split(',').map(|t| t.trim().to_owned()).collect();
        if types.len() == variables.len() { Ok((id, types)) } else { Err(self.unexpected(doing)) }
    }

    /// Checks the answer to a request for a recipe, and gives its id.
    fn check_recipe(&self, id: u8, variables: &[(String, &'static str)], types: &[String], doing: &'static str) -> Result<u8, LinkError> {
        let address = self.at.ip();
        for ((variable, expected), given) in variables.iter().zip(types) {
            let variable = variable.clone();
            match given.as_str() {
                "NOT_FOUND" => return Err(LinkError::NotFound { address, variable }),
                "IN_USE" => return Err(LinkError::InUse { address, variable }),
                given if given != *expected => return Err(LinkError::WrongType { address, variable, given: given.into(), expected }),
                _ => {}
            }
        }
        // According to the RTDE guide, id 0 means that the recipe is not valid.
        if id == 0 { Err(self.unexpected(doing)) } else { Ok(id) }
    }

    /// Waits for the next DATA_PACKAGE and fills `state` from it; `None` if none came in time. `within` nothing, only what has arrived is read.
    pub fn next_state(
        &mut self,
        recipe: OutputRecipe,
        tilt: &TiltJoint,
        state: &mut RobotState,
        within: Duration,
    ) -> Result<Option<()>, LinkError> {
        let doing = "the transfer of its state";
        let filled = self.wait(doing, within, |packet| {
            (packet.kind == wire::DATA).then(|| Outputs::new_checked(packet.payload, recipe).map(|outputs| outputs.fill(tilt, state)))
        })?;
        match filled {
            None => Ok(None),
            Some(Some(())) => Ok(Some(())),
            Some(None) => Err(self.unexpected(doing)),
        }
    }

    /// Reads packets until `pick` takes one; `None` after `within`, or, where that is nothing, when no more have arrived. Text packets are remembered and others passed over, because data
    /// and text may come before an answer.
    fn wait<T>(
        &mut self,
        doing: &'static str,
        within: Duration,
        mut pick: impl FnMut(&wire::Packet<'_>) -> Option<T>,
    ) -> Result<Option<T>, LinkError> {
        let deadline_ns = self.network.now_ns() + within.as_nanos() as u64;
        loop {
            loop {
                match self.inbox.next_packet() {
                    Ok(None) => break,
                    Ok(Some(packet)) => {
                        if let Some(found) = pick(&packet) {
                            return Ok(Some(found));
                        }
                        if let (wire::TEXT, Some((_, message))) = (packet.kind, wire::text(packet.payload)) {
                            self.said = format!("; the robot said: {}", printable(message));
                        }
                    }
                    Err(_) => return Err(self.unexpected(doing)),
                }
            }
            let left = Duration::from_nanos(deadline_ns.saturating_sub(self.network.now_ns()));
            if left.is_zero() && !within.is_zero() {
                return Ok(None);
            }
            let read = match left.is_zero() {
                true => self.stream.set_wait(None).and_then(|()| self.stream.read(self.inbox.space())),
                false => self.network.read(&mut *self.stream, self.inbox.space(), left),
            };
            match read {
                Err(e) if left.is_zero() && e.kind() == ErrorKind::WouldBlock => return Ok(None),
                Ok(0) => return Err(self.lost(doing, &ErrorKind::ConnectionAborted.into())),
                Ok(n) => self.inbox.filled(n),
                Err(e) if matches!(e.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted) => {}
                Err(e) => return Err(self.lost(doing, &e)),
            }
        }
    }

    fn lost(&self, doing: &'static str, e: &std::io::Error) -> LinkError {
        LinkError::Lost { at: self.at, doing, what: e.kind().to_string() }
    }

    /// The error of an answer that did not come.
    pub fn no_answer(&self, doing: &'static str) -> LinkError {
        LinkError::NoAnswer { at: self.at, doing }
    }

    fn unexpected(&self, doing: &'static str) -> LinkError {
        LinkError::Unexpected { at: self.at, doing, said: self.said.clone() }
    }
}

/// Opens a connection that blocks for [`ANSWER`] at most and sends at once.
pub(super) fn open(network: &dyn Network, at: SocketAddr) -> Result<Box<dyn Transport>, LinkError> {
    network.open(at, ANSWER).map_err(|e| LinkError::Unreachable { at, what: e.kind().to_string() })
}

/// A robot's text message in one line.
fn printable(message: &[u8]) -> String {
    String::from_utf8_lossy(message).chars().map(|c| if c.is_control() { ' ' } else { c }).collect()
}
