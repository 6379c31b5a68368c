//! RTDE on port 30004, protocol versions 1 and 2: one client's session, bytes in and bytes out.
//!
//! A packet is `u16 size, u8 type, payload`, big-endian; a request is answered with a packet of the same type. The bytes that
//! come in may be split and joined in any way. Pure. Runs on the controller's thread; its memory is bounded by one packet
//! (65,535 bytes) and 255 recipes. A packet that is smaller than its own header ends the session, as on a robot; other mistakes
//! are answered by a text message.

use super::machine::Machine;
use super::variables::{Input, Output, WireType};

/// The packet types (UR's RTDE guide).
mod packet_type {
    pub const REQUEST_PROTOCOL_VERSION: u8 = b'V';
    pub const GET_URCONTROL_VERSION: u8 = b'v';
    pub const TEXT_MESSAGE: u8 = b'M';
    pub const DATA_PACKAGE: u8 = b'U';
    pub const SETUP_OUTPUTS: u8 = b'O';
    pub const SETUP_INPUTS: u8 = b'I';
    pub const START: u8 = b'S';
    pub const PAUSE: u8 = b'P';
}

/// Length of a packet's header, which is its size and its type (UR's RTDE guide).
const HEADER_BYTES: usize = 3;
/// Longest name list of a recipe in bytes (UR's RTDE guide).
const MAX_NAMES_BYTES: usize = 2048;
/// Largest id of a recipe (UR's RTDE guide).
const MAX_RECIPES: usize = 255;
/// Type of a variable that does not exist, in the answer to a recipe (UR's RTDE guide).
const NOT_FOUND: &str = "NOT_FOUND";
/// Type of an input that somebody else owns, in the answer to a recipe (UR's RTDE guide).
const IN_USE: &str = "IN_USE";
/// Level of a text message: a warning (UR's RTDE guide).
const LEVEL_WARNING: u8 = 2;

/// Who may write which input: one client for each, until that client leaves.
#[derive(Debug)]
pub struct InputOwners {
    clients: [Option<u64>; Input::SLOTS],
    fieldbus: [bool; Input::SLOTS],
}

impl Default for InputOwners {
    fn default() -> Self {
        Self { clients: [None; Input::SLOTS], fieldbus: [false; Input::SLOTS] }
    }
}

impl InputOwners {
    /// Gives `input` to an enabled fieldbus.
    pub fn claim_for_fieldbus(&mut self, input: Input) {
        self.fieldbus[input.slot()] = true;
    }

    /// Takes everything back from the fieldbus.
    pub fn release_fieldbus(&mut self) {
        self.fieldbus = [false; Input::SLOTS];
    }

    /// Ends a client's ownership of all its inputs.
    pub fn release(&mut self, client: u64) {
        self.clients.iter_mut().filter(|c| **c == Some(client)).for_each(|c| *c = None);
    }

    fn taken(&self, input: Input, client: u64) -> bool {
        self.fieldbus[input.slot()] || self.clients[input.slot()].is_some_and(|owner| owner != client)
    }
}

/// What a session acts on.
#[derive(Debug)]
pub struct SessionContext<'a> {
    /// The controller.
    pub machine: &'a mut Machine,
    /// Which client owns which input.
    pub owners: &'a mut InputOwners,
    /// Names of variables that this controller pretends not to know.
    pub hidden: &'a [String],
    /// Whether the controller pretends to be too old for protocol version 2.
    pub refuse_version_2: bool,
}

/// A packet whose size is smaller than its header. The connection must be closed, because nothing after it can be read.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("RTDE packet of {0} bytes: less than its header")]
pub struct BrokenPacket(u16);

#[derive(Debug, Clone, PartialEq)]
struct OutputRecipe {
    id: u8,
    variables: Vec<Output>,
    /// A packet is due every so many control cycles.
    divider: u64,
}

/// One client's session.
#[derive(Debug)]
pub struct RtdeSession {
    client: u64,
    version: u16,
    /// The beginning of a packet that is not complete yet.
    received: Vec<u8>,
    outputs: Option<OutputRecipe>,
    /// Id of the last output recipe; 0 before the first.
    last_output_id: u8,
    /// The input recipes; the first has the id 1.
    inputs: Vec<Vec<Input>>,
    running: bool,
    /// Control cycle at which the next data packet is due.
    due: u64,
}

impl RtdeSession {
    /// A session before its first request. `client` is a number that no other session has.
    pub fn new(client: u64) -> Self {
        Self { client, version: 1, received: Vec::new(), outputs: None, last_output_id: 0, inputs: Vec::new(), running: false, due: 0 }
    }

    /// Takes received bytes and appends the answers to `answers`.
    ///
    /// # Errors
    /// A packet is smaller than its header.
    pub fn feed(&mut self, bytes: &[u8], context: &mut SessionContext<'_>, answers: &mut Vec<u8>) -> Result<(), BrokenPacket> {
        self.received.extend(bytes);
        let mut at = 0;
        while let Some(&[high, low, kind]) = self.received.get(at..).and_then(|rest| rest.first_chunk::<HEADER_BYTES>()) {
            let size = u16::from_be_bytes([high, low]);
            if usize::from(size) < HEADER_BYTES {
                return Err(BrokenPacket(size));
            }
            let Some(payload) = self.received.get(at + HEADER_BYTES..at + usize::from(size)) else { break };
            let payload = payload.to_vec();
            self.obey(kind, &payload, context, answers);
            at += usize::from(size);
        }
        self.received.drain(..at);
        Ok(())
    }

    /// Carries out one packet of the client.
    fn obey(&mut self, kind: u8, payload: &[u8], context: &mut SessionContext<'_>, answers: &mut Vec<u8>) {
        match kind {
            packet_type::REQUEST_PROTOCOL_VERSION => {
                let wanted = payload.first_chunk().map_or(0, |b| u16::from_be_bytes(*b));
                let accepted = wanted == 1 || (wanted == 2 && !context.refuse_version_2);
                if accepted {
                    self.version = wanted;
                }
                put_packet(answers, kind, &[u8::from(accepted)]);
            }
            packet_type::GET_URCONTROL_VERSION => {
                let v = context.machine.version();
                let answer: Vec<u8> = [v.major, v.minor, v.bugfix, v.build].iter().flat_map(|n| n.to_be_bytes()).collect();
                put_packet(answers, kind, &answer);
            }
            packet_type::SETUP_OUTPUTS => self.setup_outputs(payload, context, answers),
            packet_type::SETUP_INPUTS => self.setup_inputs(payload, context, answers),
            packet_type::START => {
                self.running = self.outputs.is_some();
                self.due = context.machine.cycle() + 1;
                put_packet(answers, kind, &[u8::from(self.running)]);
            }
            packet_type::PAUSE => {
                self.running = false;
                put_packet(answers, kind, &[1]);
            }
            packet_type::DATA_PACKAGE => {
                if let Err(what) = self.data(payload, context) {
                    answers.extend(self.text(&what));
                }
            }
            // A robot writes it to its log and does not answer.
            packet_type::TEXT_MESSAGE => {}
            other => answers.extend(self.text(&format!("unknown RTDE package type {other}"))),
        }
    }

    fn setup_outputs(&mut self, payload: &[u8], context: &mut SessionContext<'_>, answers: &mut Vec<u8>) {
        let max_hz = context.machine.series().rate_hz();
        let (frequency_hz, names) = match payload.split_first_chunk() {
            Some((frequency, names)) if self.version >= 2 => (f64::from_be_bytes(*frequency), names),
            _ if self.version >= 2 => (0.0, &[][..]),
            _ => (max_hz, payload),
        };
        let version = context.machine.version();
        let (variables, types) = read_recipe(names, context.hidden, |name| {
            let output = Output::parse(name, &version).ok_or(NOT_FOUND)?;
            Ok((output, output.wire_type()))
        });
        self.running = false;
        self.outputs = None;
        let mut id = 0;
        if let Some(variables) = variables.filter(|_| frequency_hz >= 1.0) {
            self.last_output_id = self.last_output_id.checked_add(1).unwrap_or(1);
            id = self.last_output_id;
            let divider = ((max_hz / frequency_hz).floor() as u64).max(1);
            self.outputs = Some(OutputRecipe { id, variables, divider });
        }
        let mut answer = if self.version >= 2 { vec![id] } else { Vec::new() };
        answer.extend(types.into_bytes());
        put_packet(answers, packet_type::SETUP_OUTPUTS, &answer);
    }

    fn setup_inputs(&mut self, payload: &[u8], context: &mut SessionContext<'_>, answers: &mut Vec<u8>) {
        let version = context.machine.version();
        let (variables, types) = read_recipe(payload, context.hidden, |name| {
            let input = Input::parse_for(name, &version).ok_or(NOT_FOUND)?;
            if context.owners.taken(input, self.client) { Err(IN_USE) } else { Ok((input, input.wire_type())) }
        });
        let mut id = 0;
        if let Some(variables) = variables.filter(|_| self.inputs.len() < MAX_RECIPES) {
            for input in &variables {
                context.owners.clients[input.slot()] = Some(self.client);
            }
            self.inputs.push(variables);
            id = self.inputs.len() as u8;
        }
        let mut answer = vec![id];
        answer.extend(types.into_bytes());
        put_packet(answers, packet_type::SETUP_INPUTS, &answer);
    }

    /// Writes the values of a data packet to the inputs of its recipe. The error is told to the client.
    fn data(&self, payload: &[u8], context: &mut SessionContext<'_>) -> Result<(), String> {
        let Some((&id, mut values)) = payload.split_first() else { return Err("data package without a recipe id".to_owned()) };
        let recipe = usize::from(id).checked_sub(1).and_then(|i| self.inputs.get(i));
        let recipe = recipe.ok_or_else(|| format!("data package for input recipe {id}, which does not exist"))?;
        let expected: usize = recipe.iter().map(|i| i.wire_type().bytes()).sum();
        if values.len() != expected {
            return Err(format!("data package of {} bytes for input recipe {id}, which has {expected}", values.len()));
        }
        for input in recipe {
            let (value, rest) = values.split_at(input.wire_type().bytes());
            context.machine.robot.write_input(*input, value);
            values = rest;
        }
        Ok(())
    }

    /// The data packet of this cycle, if one is due. A packet that was due in a skipped cycle comes late, and never twice.
    pub fn output(&mut self, machine: &Machine) -> Option<Vec<u8>> {
        let recipe = self.outputs.as_ref().filter(|_| self.running)?;
        let cycle = machine.cycle();
        if cycle < self.due {
            return None;
        }
        self.due += recipe.divider;
        if self.due <= cycle {
            self.due = cycle + recipe.divider;
        }
        let mut payload = Vec::new();
        if self.version >= 2 {
            payload.push(recipe.id);
        }
        recipe.variables.iter().for_each(|v| machine.read_output(*v, &mut payload));
        let mut packet = Vec::with_capacity(HEADER_BYTES + payload.len());
        put_packet(&mut packet, packet_type::DATA_PACKAGE, &payload);
        Some(packet)
    }

    /// A packet with a warning for this client, cut to 255 bytes.
    pub fn text(&self, message: &str) -> Vec<u8> {
        let message = &message.as_bytes()[..message.len().min(255)];
        let mut payload = Vec::new();
        if self.version >= 2 {
            payload.push(message.len() as u8);
            payload.extend(message);
            let source = b"RTDE";
            payload.push(source.len() as u8);
            payload.extend(source);
            payload.push(LEVEL_WARNING);
        } else {
            payload.push(LEVEL_WARNING);
            payload.extend(message);
        }
        let mut packet = Vec::new();
        put_packet(&mut packet, packet_type::TEXT_MESSAGE, &payload);
        packet
    }
}

/// Reads the names of a recipe. Gives its variables, or None when the recipe is invalid, and the comma list of their types for the
/// answer. `find` gives a variable and its type, or what the answer says instead of the type.
fn read_recipe<V>(names: &[u8], hidden: &[String], find: impl Fn(&str) -> Result<(V, WireType), &'static str>) -> (Option<Vec<V>>, String) {
    let mut variables = Vec::new();
    let mut types = Vec::new();
    let mut valid = names.len() <= MAX_NAMES_BYTES;
    for name in split_names(names) {
        let found = if hidden.contains(&name) { Err(NOT_FOUND) } else { find(&name) };
        match found {
            Ok((variable, wire_type)) => {
                types.push(wire_type.name());
                variables.push(variable);
            }
            Err(instead) => {
                types.push(instead);
                valid = false;
            }
        }
    }
    (Some(variables).filter(|v| valid && !v.is_empty()), types.join(","))
}

/// The names of a comma list. ur_rtde ends the list with a comma, UR's own clients do not.
fn split_names(list: &[u8]) -> Vec<String> {
    let list = String::from_utf8_lossy(&list[..list.len().min(MAX_NAMES_BYTES)]).into_owned();
    let list = list.strip_suffix(',').unwrap_or(&list);
    if list.is_empty() { Vec::new() } else { list.split(',').map(|n| n.trim().to_owned()).collect() }
}

/// Appends a packet of `packet_type` to `to`.
fn put_packet(to: &mut Vec<u8>, packet_type: u8, payload: &[u8]) {
    to.extend(((HEADER_BYTES + payload.len()) as u16).to_be_bytes());
    to.push(packet_type);
    to.extend(payload);
}
