//! RTDE, protocol versions 1 and 2: one client's session as a pure state machine over bytes.
//!
//! Frames are `u16 size, u8 type, payload`, big-endian; requests are answered with a frame of the same type. Bytes in may be
//! split and joined in any way. Runs on the controller's thread; memory is bounded by one frame (65,535 bytes) and 255
//! recipes. A frame that cannot be right ends the session, as a robot ends it.

use super::machine::Machine;
use super::variables::{Input, Output};

const REQUEST_PROTOCOL_VERSION: u8 = b'V';
const GET_URCONTROL_VERSION: u8 = b'v';
const TEXT_MESSAGE: u8 = b'M';
const DATA_PACKAGE: u8 = b'U';
const SETUP_OUTPUTS: u8 = b'O';
const SETUP_INPUTS: u8 = b'I';
const START: u8 = b'S';
const PAUSE: u8 = b'P';

/// Longest name list of a recipe, bytes (RTDE guide).
const MAX_NAMES_BYTES: usize = 2048;

/// Who may write which input: one client each, until it leaves.
#[derive(Debug)]
pub struct Owners {
    clients: [Option<u64>; Input::SLOTS],
    fieldbus: [bool; Input::SLOTS],
}

impl Default for Owners {
    fn default() -> Self {
        Self { clients: [None; Input::SLOTS], fieldbus: [false; Input::SLOTS] }
    }
}

impl Owners {
    /// An enabled fieldbus takes `input` for itself.
    pub fn claim_for_fieldbus(&mut self, input: Input) {
        self.fieldbus[input.slot()] = true;
    }

    /// The fieldbus gives everything back.
    pub fn release_fieldbus(&mut self) {
        self.fieldbus = [false; Input::SLOTS];
    }

    /// Ends a client's ownership.
    pub fn release(&mut self, client: u64) {
        self.clients.iter_mut().filter(|c| **c == Some(client)).for_each(|c| *c = None);
    }

    fn taken(&self, input: Input, client: u64) -> bool {
        self.fieldbus[input.slot()] || self.clients[input.slot()].is_some_and(|owner| owner != client)
    }
}

/// What a session can reach.
#[derive(Debug)]
pub struct Context<'a> {
    /// The controller.
    pub machine: &'a mut Machine,
    /// All clients' claims.
    pub owners: &'a mut Owners,
    /// Variables that this controller pretends not to know.
    pub hidden: &'a [String],
    /// Pretends to be too old for protocol version 2.
    pub refuse_version_2: bool,
}

/// The client broke the protocol beyond repair: the connection is closed.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("RTDE frame of {0} bytes: less than its header")]
pub struct Broken(u16);

#[derive(Debug, Clone, PartialEq)]
struct OutputRecipe {
    id: u8,
    variables: Vec<Output>,
    divider: u64,
}

/// One client's session.
#[derive(Debug)]
pub struct Session {
    client: u64,
    version: u16,
    received: Vec<u8>,
    outputs: Option<OutputRecipe>,
    output_recipes: u8,
    inputs: Vec<Vec<Input>>,
    running: bool,
    due: u64,
}

impl Session {
    /// A session before its first request; `client` tells its claims from others'.
    pub fn new(client: u64) -> Self {
        Self { client, version: 1, received: Vec::new(), outputs: None, output_recipes: 0, inputs: Vec::new(), running: false, due: 0 }
    }

    /// Takes received bytes and appends the answers to `answers`.
    pub fn feed(&mut self, bytes: &[u8], context: &mut Context<'_>, answers: &mut Vec<u8>) -> Result<(), Broken> {
        self.received.extend(bytes);
        let mut at = 0;
        while let Some(&[high, low, kind]) = self.received.get(at..).and_then(|rest| rest.first_chunk::<3>()) {
            let size = u16::from_be_bytes([high, low]);
            if size < 3 {
                return Err(Broken(size));
            }
            let Some(payload) = self.received.get(at + 3..at + usize::from(size)) else { break };
            let payload = payload.to_vec();
            self.frame(kind, &payload, context, answers);
            at += usize::from(size);
        }
        self.received.drain(..at);
        Ok(())
    }

    fn frame(&mut self, kind: u8, payload: &[u8], context: &mut Context<'_>, answers: &mut Vec<u8>) {
        match kind {
            REQUEST_PROTOCOL_VERSION => {
                let wanted = payload.first_chunk().map_or(0, |b| u16::from_be_bytes(*b));
                let accepted = wanted == 1 || (wanted == 2 && !context.refuse_version_2);
                if accepted {
                    self.version = wanted;
                }
                put(answers, kind, &[u8::from(accepted)]);
            }
            GET_URCONTROL_VERSION => {
                let v = context.machine.version();
                let answer: Vec<u8> = [v.major, v.minor, v.bugfix, v.build].iter().flat_map(|n| n.to_be_bytes()).collect();
                put(answers, kind, &answer);
            }
            SETUP_OUTPUTS => self.setup_outputs(payload, context, answers),
            SETUP_INPUTS => self.setup_inputs(payload, context, answers),
            START => {
                self.running = self.outputs.is_some();
                self.due = context.machine.cycle() + 1;
                put(answers, kind, &[u8::from(self.running)]);
            }
            PAUSE => {
                self.running = false;
                put(answers, kind, &[1]);
            }
            DATA_PACKAGE => {
                if let Err(what) = self.data(payload, context) {
                    answers.extend(self.text(&what));
                }
            }
            // To the log; nothing to answer.
            TEXT_MESSAGE => {}
            other => answers.extend(self.text(&format!("unknown RTDE package type {other}"))),
        }
    }

    fn setup_outputs(&mut self, payload: &[u8], context: &mut Context<'_>, answers: &mut Vec<u8>) {
        let max_hz = context.machine.series().rate_hz();
        let (frequency_hz, names) = match payload.split_first_chunk() {
            Some((frequency, names)) if self.version >= 2 => (f64::from_be_bytes(*frequency), names),
            _ if self.version >= 2 => (0.0, &[][..]),
            _ => (max_hz, payload),
        };
        let version = context.machine.version();
        let mut variables = Vec::new();
        let mut types = Vec::new();
        let mut valid = frequency_hz >= 1.0 && names.len() <= MAX_NAMES_BYTES;
        for name in split_names(names) {
            match Output::parse(&name, &version).filter(|_| !context.hidden.contains(&name)) {
                Some(output) => {
                    types.push(output.kind().name());
                    variables.push(output);
                }
                None => {
                    types.push("NOT_FOUND");
                    valid = false;
                }
            }
        }
        valid &= !variables.is_empty();
        self.running = false;
        self.outputs = None;
        let mut id = 0;
        if valid {
            self.output_recipes = self.output_recipes.checked_add(1).unwrap_or(1);
            id = self.output_recipes;
            let divider = ((max_hz / frequency_hz).floor() as u64).max(1);
            self.outputs = Some(OutputRecipe { id, variables, divider });
        }
        let mut answer = if self.version >= 2 { vec![id] } else { Vec::new() };
        answer.extend(types.join(",").into_bytes());
        put(answers, SETUP_OUTPUTS, &answer);
    }

    fn setup_inputs(&mut self, payload: &[u8], context: &mut Context<'_>, answers: &mut Vec<u8>) {
        let version = context.machine.version();
        let mut variables = Vec::new();
        let mut types = Vec::new();
        let mut valid = payload.len() <= MAX_NAMES_BYTES && self.inputs.len() < 255;
        for name in split_names(payload) {
            match Input::parse_for(&name, &version).filter(|_| !context.hidden.contains(&name)) {
                Some(input) if context.owners.taken(input, self.client) => {
                    types.push("IN_USE");
                    valid = false;
                }
                Some(input) => {
                    types.push(input.kind().name());
                    variables.push(input);
                }
                None => {
                    types.push("NOT_FOUND");
                    valid = false;
                }
            }
        }
        valid &= !variables.is_empty();
        let mut id = 0;
        if valid {
            for input in &variables {
                context.owners.clients[input.slot()] = Some(self.client);
            }
            self.inputs.push(variables);
            id = self.inputs.len() as u8;
        }
        let mut answer = vec![id];
        answer.extend(types.join(",").into_bytes());
        put(answers, SETUP_INPUTS, &answer);
    }

    fn data(&self, payload: &[u8], context: &mut Context<'_>) -> Result<(), String> {
        let Some((&id, mut values)) = payload.split_first() else { return Err("data package without a recipe id".to_owned()) };
        let recipe = usize::from(id).checked_sub(1).and_then(|i| self.inputs.get(i));
        let recipe = recipe.ok_or_else(|| format!("data package for input recipe {id}, which does not exist"))?;
        let expected: usize = recipe.iter().map(|i| i.kind().bytes()).sum();
        if values.len() != expected {
            return Err(format!("data package of {} bytes for input recipe {id}, which has {expected}", values.len()));
        }
        for input in recipe {
            let (value, rest) = values.split_at(input.kind().bytes());
            context.machine.write_input(*input, value);
            values = rest;
        }
        Ok(())
    }

    /// The data frame of this cycle, if one is due. One that was due in a skipped cycle is sent late, never twice.
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
        let mut frame = vec![0, 0, DATA_PACKAGE];
        if self.version >= 2 {
            frame.push(recipe.id);
        }
        recipe.variables.iter().for_each(|v| machine.read_output(*v, &mut frame));
        let size = (frame.len() as u16).to_be_bytes();
        frame[..2].copy_from_slice(&size);
        Some(frame)
    }

    /// A text message to this client, of level "warning".
    pub fn text(&self, message: &str) -> Vec<u8> {
        let message = &message.as_bytes()[..message.len().min(255)];
        let mut payload = Vec::new();
        if self.version >= 2 {
            payload.push(message.len() as u8);
            payload.extend(message);
            let source = b"RTDE";
            payload.push(source.len() as u8);
            payload.extend(source);
            payload.push(2);
        } else {
            payload.push(2);
            payload.extend(message);
        }
        let mut frame = Vec::new();
        put(&mut frame, TEXT_MESSAGE, &payload);
        frame
    }
}

/// Names of a comma list; ur_rtde ends it with a comma, UR's own clients do not.
fn split_names(list: &[u8]) -> Vec<String> {
    let list = String::from_utf8_lossy(&list[..list.len().min(MAX_NAMES_BYTES)]).into_owned();
    let list = list.strip_suffix(',').unwrap_or(&list);
    if list.is_empty() { Vec::new() } else { list.split(',').map(|n| n.trim().to_owned()).collect() }
}

fn put(to: &mut Vec<u8>, kind: u8, payload: &[u8]) {
    to.extend(((payload.len() + 3) as u16).to_be_bytes());
    to.push(kind);
    to.extend(payload);
}
