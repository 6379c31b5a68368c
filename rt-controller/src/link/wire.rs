//! RTDE packets (protocol 2, big-endian): checked views of what the robot sends, and the few packets that are sent to it.
//!
//! All of it is pure; the connecting thread and the loop use it. Nothing allocates but [`Inbox::new`], once, and the lists of names, which
//! only the connecting thread asks for. No bytes make anything here panic: what does not fit gives `None` or [`Malformed`].
//!
//! A packet is a u16 with the size of the whole packet, a u8 with its type, and its payload. Where a value lies in a data packet follows
//! from the lists of variables. `OUTPUTS` and `INPUTS` are needed, and their places are computed and checked at compile time. `EXTRAS` are
//! asked for too, and a robot that does not know one of them is driven without it ([`OutputRecipe`]).

use super::{ProgramState, RobotState, TiltJoint};

/// REQUEST_PROTOCOL_VERSION, 'V'.
pub const PROTOCOL_VERSION: u8 = b'V';
/// GET_URCONTROL_VERSION, 'v'.
pub const CONTROLLER_VERSION: u8 = b'v';
/// TEXT_MESSAGE, 'M'.
pub const TEXT: u8 = b'M';
/// DATA_PACKAGE, 'U'.
pub const DATA: u8 = b'U';
/// CONTROL_PACKAGE_SETUP_OUTPUTS, 'O'.
pub const SETUP_OUTPUTS: u8 = b'O';
/// CONTROL_PACKAGE_SETUP_INPUTS, 'I'.
pub const SETUP_INPUTS: u8 = b'I';
/// CONTROL_PACKAGE_START, 'S'.
pub const START: u8 = b'S';

/// Number of bytes before the payload: the size and the type.
const HEADER: usize = 3;
/// The largest packet that its u16 size can announce, bytes.
const LARGEST: usize = u16::MAX as usize;
/// Number of bytes of a packet with one target: header, recipe id, and the values of `INPUTS`.
pub const TARGET_LEN: usize = HEADER + 1 + bytes_of(&INPUTS);

/// Number of bytes of a packet with the robot's state: header, recipe id, and the values of `OUTPUTS`.
pub const STATE_LEN: usize = HEADER + 1 + bytes_of(&OUTPUTS);

/// One whole packet.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Packet<'a> {
    /// Its type.
    pub kind: u8,
    /// What follows the header.
    pub payload: &'a [u8],
}

/// The byte stream is not RTDE: a packet announces a size smaller than its own header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a packet announces {0} bytes, less than its own header")]
pub struct Malformed(pub u16);

/// Puts packets together from whatever pieces the socket delivers.
#[derive(Debug)]
pub struct Inbox {
    buffer: Box<[u8]>,
    start: usize,
    end: usize,
}

impl Default for Inbox {
    fn default() -> Self {
        Self::new()
    }
}

impl Inbox {
    /// Makes an empty inbox, which is its only allocation. It holds one byte more than the largest packet, so that there is always space.
    pub fn new() -> Self {
        Self { buffer: vec![0; LARGEST + 1].into_boxed_slice(), start: 0, end: 0 }
    }

    /// Where the socket's next bytes go; never empty once [`Inbox::next_packet`] has given `None`.
    pub fn space(&mut self) -> &mut [u8] {
        self.buffer.copy_within(self.start..self.end, 0);
        self.end -= self.start;
        self.start = 0;
        &mut self.buffer[self.end..]
    }

    /// Counts the first `n` bytes of [`Inbox::space`] as received.
    pub fn filled(&mut self, n: usize) {
        self.end = (self.end + n).min(self.buffer.len());
    }

    /// The next whole packet; `None` until more bytes come.
    pub fn next_packet(&mut self) -> Result<Option<Packet<'_>>, Malformed> {
        let waiting = &self.buffer[self.start..self.end];
        let &[high, low, kind, ..] = waiting else { return Ok(None) };
        let size = u16::from_be_bytes([high, low]);
        if usize::from(size) < HEADER {
            return Err(Malformed(size));
        }
        let Some(payload) = waiting.get(HEADER..usize::from(size)) else { return Ok(None) };
        self.start += usize::from(size);
        Ok(Some(Packet { kind, payload }))
    }
}

/// Writes a packet into `out` and gives its bytes; `None` if it does not fit into `out` or into a packet.
pub fn encode<'a>(kind: u8, parts: &[&[u8]], out: &'a mut [u8]) -> Option<&'a [u8]> {
    let size = HEADER + parts.iter().map(|p| p.len()).sum::<usize>();
    let out = out.get_mut(..size)?;
    let [a, b] = u16::try_from(size).ok()?.to_be_bytes();
    let (header, mut rest) = out.split_at_mut(HEADER);
    header.copy_from_slice(&[a, b, kind]);
    for part in parts {
        let (here, after) = rest.split_at_mut(part.len());
        here.copy_from_slice(part);
        rest = after;
    }
    Some(out)
}

/// The DATA_PACKAGE with one target: number, mode code and joint angle in rad, in the order of `INPUTS`.
pub fn encode_target(recipe: u8, sequence: i32, mode: i32, joint_rad: f64) -> [u8; TARGET_LEN] {
    let mut out = [0; TARGET_LEN];
    let parts: [&[u8]; 4] = [&[recipe], &sequence.to_be_bytes(), &mode.to_be_bytes(), &joint_rad.to_be_bytes()];
    // It fits: TARGET_LEN is the sum of the parts.
    let _ = encode(DATA, &parts, &mut out);
    out
}

/// Reads the answer to V or S: whether the request was accepted.
pub fn accepted(payload: &[u8]) -> Option<bool> {
    match payload {
        [code] => Some(*code != 0),
        _ => None,
    }
}

/// Reads the answer to v: major, minor, bugfix, build.
pub fn controller_version(payload: &[u8]) -> Option<[u32; 4]> {
    let bytes: &[u8; 16] = payload.try_into().ok()?;
    let mut version = [0; 4];
    for (number, four) in version.iter_mut().zip(bytes.chunks_exact(4)) {
        *number = u32::from_be_bytes(four.try_into().ok()?);
    }
    Some(version)
}

/// Reads the answer to O or I: the recipe's id and the comma-separated types.
pub fn recipe(payload: &[u8]) -> Option<(u8, &str)> {
    let (&id, types) = payload.split_first()?;
    Some((id, std::str::from_utf8(types).ok()?))
}

/// Reads a TEXT_MESSAGE of protocol 2: level (0 exception, 1 error, 2 warning, 3 info) and the message's bytes.
pub fn text(payload: &[u8]) -> Option<(u8, &[u8])> {
    let (&message_len, rest) = payload.split_first()?;
    let message = rest.get(..usize::from(message_len))?;
    let (&source_len, rest) = rest.get(usize::from(message_len)..)?.split_first()?;
    let level = *rest.get(usize::from(source_len))?;
    Some((level, message))
}

/// A type of RTDE values.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Type {
    Double,
    Vector3d,
    Vector6d,
    Int32,
    Uint32,
}

impl Type {
    /// Bytes of one value.
    const fn bytes(self) -> usize {
        match self {
            Self::Double => 8,
            Self::Vector3d => 3 * 8,
            Self::Vector6d => 6 * 8,
            Self::Int32 | Self::Uint32 => 4,
        }
    }

    /// The type as the robot names it.
    const fn name(self) -> &'static str {
        match self {
            Self::Double => "DOUBLE",
            Self::Vector3d => "VECTOR3D",
            Self::Vector6d => "VECTOR6D",
            Self::Int32 => "INT32",
            Self::Uint32 => "UINT32",
        }
    }
}

/// A variable of a recipe.
#[derive(Debug, Clone, Copy)]
struct Variable {
    /// The variable's name; for a register, without the number.
    name: &'static str,
    /// The number of a register, counted from `robot.register_base`; `None` if this is not a register.
    register: Option<u8>,
    kind: Type,
}

impl Variable {
    const fn plain(name: &'static str, kind: Type) -> Self {
        Self { name, register: None, kind }
    }

    const fn register(name: &'static str, number: u8, kind: Type) -> Self {
        Self { name, register: Some(number), kind }
    }

    fn full_name(&self, base: u8) -> String {
        match self.register {
            Some(number) => format!("{}_{}", self.name, u32::from(base) + u32::from(number)),
            None => self.name.to_owned(),
        }
    }
}

/// The outputs without which a robot is not driven, in the order of their values in a data packet.
const OUTPUTS: [Variable; 13] = [
    Variable::plain("timestamp", Type::Double),
    Variable::plain("actual_q", Type::Vector6d),
    Variable::plain("target_q", Type::Vector6d),
    Variable::plain("actual_qd", Type::Vector6d),
    Variable::plain("robot_mode", Type::Int32),
    Variable::plain("safety_mode", Type::Int32),
    Variable::plain("safety_status_bits", Type::Uint32),
    Variable::plain("runtime_state", Type::Uint32),
    Variable::register("output_int_register", 0, Type::Int32),
    Variable::register("output_int_register", 1, Type::Int32),
    Variable::register("output_int_register", 2, Type::Int32),
    Variable::register("output_double_register", 0, Type::Double),
    Variable::plain("target_speed_fraction", Type::Double),
];

/// The outputs that follow them where the robot knows them.
const EXTRAS: [Variable; 5] = [
    Variable::plain("robot_status_bits", Type::Uint32),
    Variable::plain("speed_scaling", Type::Double),
    Variable::plain("payload", Type::Double),
    Variable::plain("payload_cog", Type::Vector3d),
    Variable::plain("script_control_line", Type::Uint32),
];
/// Index of the robot's status bits among `EXTRAS`.
const STATUS_BITS: usize = 0;
/// Index of the share of its speed that the robot leaves by itself among `EXTRAS`.
const SPEED_SCALING: usize = 1;
/// Index of the mass at the tool among `EXTRAS`.
const PAYLOAD: usize = 2;
/// Index of that mass's centre of gravity among `EXTRAS`.
const PAYLOAD_COG: usize = 3;
/// Index of the line that a program stands at among `EXTRAS`.
const CONTROL_LINE: usize = 4;

/// Where the values of `OUTPUTS` begin in a data packet, bytes behind the recipe id.
mod at {
    use super::{OUTPUTS, Type, offset};

    /// The robot's clock.
    pub const TIMESTAMP: usize = offset(&OUTPUTS, 0, "timestamp", Type::Double);
    /// Measured joint angles.
    pub const ACTUAL_Q: usize = offset(&OUTPUTS, 1, "actual_q", Type::Vector6d);
    /// Joint angles that the servo steers to.
    pub const TARGET_Q: usize = offset(&OUTPUTS, 2, "target_q", Type::Vector6d);
    /// Measured joint rates.
    pub const ACTUAL_QD: usize = offset(&OUTPUTS, 3, "actual_qd", Type::Vector6d);
    /// The robot's mode.
    pub const ROBOT_MODE: usize = offset(&OUTPUTS, 4, "robot_mode", Type::Int32);
    /// The safety system's mode.
    pub const SAFETY_MODE: usize = offset(&OUTPUTS, 5, "safety_mode", Type::Int32);
    /// The safety system's bits.
    pub const SAFETY_BITS: usize = offset(&OUTPUTS, 6, "safety_status_bits", Type::Uint32);
    /// Whether a program runs.
    pub const RUNTIME_STATE: usize = offset(&OUTPUTS, 7, "runtime_state", Type::Uint32);
    /// What our program is doing.
    pub const PROGRAM_STATE: usize = offset(&OUTPUTS, 8, "output_int_register", Type::Int32);
    /// The newest target that our program has read.
    pub const SEQUENCE_ECHO: usize = offset(&OUTPUTS, 9, "output_int_register", Type::Int32);
    /// The run number of our program.
    pub const PROGRAM_RUN: usize = offset(&OUTPUTS, 10, "output_int_register", Type::Int32);
    /// The joint angle that our program commands.
    pub const COMMAND: usize = offset(&OUTPUTS, 11, "output_double_register", Type::Double);
    /// The pendant's speed slider.
    pub const SPEED_FRACTION: usize = offset(&OUTPUTS, 12, "target_speed_fraction", Type::Double);
}

/// The inputs that are written, in the order of their values in a data packet; [`encode_target`] writes them.
const INPUTS: [Variable; 3] = [
    Variable::register("input_int_register", 0, Type::Int32),
    Variable::register("input_int_register", 1, Type::Int32),
    Variable::register("input_double_register", 0, Type::Double),
];

// These hold the byte table in ARCHITECTURE.md, and what `encode_target` writes.
const _: () = assert!(OUTPUTS_LEN == 196 && at::SPEED_FRACTION == 188);
const _: () = assert!(offset(&INPUTS, 1, "input_int_register", Type::Int32) == size_of::<i32>());
const _: () = assert!(offset(&INPUTS, 2, "input_double_register", Type::Double) == 2 * size_of::<i32>());
const _: () = assert!(TARGET_LEN == 20);

/// Bytes of the values of `variables`.
const fn bytes_of(variables: &[Variable]) -> usize {
    let (mut bytes, mut k) = (0, 0);
    while k < variables.len() {
        bytes += variables[k].kind.bytes();
        k += 1;
    }
    bytes
}

/// Bytes before the value of the variable `index`; does not compile if that one has another name or type.
const fn offset(variables: &[Variable], index: usize, name: &str, kind: Type) -> usize {
    let variable = variables[index];
    let (has, wanted) = (variable.name.as_bytes(), name.as_bytes());
    assert!(has.len() == wanted.len() && variable.kind as u8 == kind as u8);
    let mut k = 0;
    while k < has.len() {
        assert!(has[k] == wanted[k]);
        k += 1;
    }
    let (before, _) = variables.split_at(index);
    bytes_of(before)
}

/// Names and types of the outputs that are needed, with registers from `base`. Allocates.
pub fn output_names(base: u8) -> Vec<(String, &'static str)> {
    OUTPUTS.iter().map(|v| (v.full_name(base), v.kind.name())).collect()
}

/// Names and types of the outputs that are asked for too, where the robot knows them. Allocates.
pub fn extra_names() -> Vec<(String, &'static str)> {
    EXTRAS.iter().map(|v| (v.full_name(0), v.kind.name())).collect()
}

/// Names and types of the inputs that are written, with registers from `base`; [`encode_target`] writes their values. Allocates.
pub fn input_names(base: u8) -> [(String, &'static str); INPUTS.len()] {
    INPUTS.map(|v| (v.full_name(base), v.kind.name()))
}

/// The output recipe that was agreed on: its id, and where its values lie.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OutputRecipe {
    id: u8,
    /// Where each of `EXTRAS` begins, bytes behind the recipe id; `None` if the robot does not know it.
    extras: [Option<usize>; EXTRAS.len()],
    /// Bytes of all values.
    values_len: usize,
}

impl OutputRecipe {
    /// The recipe `id` of all needed outputs, followed by those of [`extra_names`] for which `known` is true.
    pub fn new(id: u8, known: [bool; EXTRAS.len()]) -> Self {
        let mut values_len = OUTPUTS_LEN;
        let mut extras = [None; EXTRAS.len()];
        for ((extra, variable), known) in extras.iter_mut().zip(EXTRAS).zip(known) {
            if known {
                *extra = Some(values_len);
                values_len += variable.kind.bytes();
            }
        }
        Self { id, extras, values_len }
    }
}

/// A data packet in the output recipe, checked once for recipe and length.
#[derive(Debug, Clone, Copy)]
pub struct Outputs<'a> {
    values: &'a [u8],
    recipe: OutputRecipe,
}

/// Bytes of the values of `OUTPUTS`.
const OUTPUTS_LEN: usize = bytes_of(&OUTPUTS);

impl<'a> Outputs<'a> {
    /// A view of `payload` if it has the id and the length of `recipe`.
    pub fn new_checked(payload: &'a [u8], recipe: OutputRecipe) -> Option<Self> {
        let (&id, values) = payload.split_first()?;
        (id == recipe.id && values.len() == recipe.values_len).then_some(Self { values, recipe })
    }

    fn four(&self, at: usize) -> [u8; 4] {
        let mut bytes = [0; 4];
        bytes.copy_from_slice(&self.values[at..at + 4]);
        bytes
    }

    fn int(&self, at: usize) -> i32 {
        i32::from_be_bytes(self.four(at))
    }

    fn unsigned(&self, at: usize) -> u32 {
        u32::from_be_bytes(self.four(at))
    }

    fn real(&self, at: usize) -> f64 {
        let mut bytes = [0; 8];
        bytes.copy_from_slice(&self.values[at..at + 8]);
        f64::from_be_bytes(bytes)
    }

    /// The value of `joint`, 0 to 5, in a vector; a larger number counts as 5.
    fn of_joint(&self, vector: usize, joint: usize) -> f64 {
        self.real(vector + Type::Double.bytes() * joint.min(5))
    }

    /// All six values of a vector.
    fn of_joints(&self, vector: usize) -> [f64; 6] {
        std::array::from_fn(|joint| self.of_joint(vector, joint))
    }

    /// The robot's clock, s.
    pub fn timestamp_s(&self) -> f64 {
        self.real(at::TIMESTAMP)
    }

    /// Measured angle of joint 0 to 5, rad.
    pub fn actual_q(&self, joint: usize) -> f64 {
        self.of_joint(at::ACTUAL_Q, joint)
    }

    /// Writes what the packet says into `state`, but for the session's own bookkeeping: the number of the newest target and the times.
    pub fn fill(&self, tilt: &TiltJoint, state: &mut RobotState) {
        let joint = tilt.joint.index();
        state.timestamp_s = self.timestamp_s();
        state.alpha_deg = tilt.alpha_deg(self.actual_q(joint));
        state.alpha_target_deg = tilt.alpha_deg(self.of_joint(at::TARGET_Q, joint));
        state.alpha_rate_deg_s = (tilt.direction * self.of_joint(at::ACTUAL_QD, joint).to_degrees()) as f32;
        state.robot_mode = self.int(at::ROBOT_MODE);
        state.safety_mode = self.int(at::SAFETY_MODE);
        state.safety_bits = self.unsigned(at::SAFETY_BITS);
        state.runtime_state = self.unsigned(at::RUNTIME_STATE);
        state.program_state = ProgramState::from_code(self.int(at::PROGRAM_STATE));
        state.sequence_echo = self.int(at::SEQUENCE_ECHO);
        state.program_run = self.int(at::PROGRAM_RUN);
        state.alpha_command_deg = tilt.alpha_deg(self.real(at::COMMAND));
        state.speed_fraction = self.real(at::SPEED_FRACTION);
        state.joints_rad = self.of_joints(at::ACTUAL_Q);
        state.joint_rates_rad_s = self.of_joints(at::ACTUAL_QD);
        let extras = self.recipe.extras;
        state.status_bits = extras[STATUS_BITS].map(|at| self.unsigned(at));
        state.speed_scaling = extras[SPEED_SCALING].map(|at| self.real(at));
        state.payload_kg = extras[PAYLOAD].map(|at| self.real(at));
        state.payload_cog_m = extras[PAYLOAD_COG].map(|at| std::array::from_fn(|axis| self.real(at + Type::Double.bytes() * axis)));
        state.control_line = extras[CONTROL_LINE].map(|at| self.unsigned(at));
    }
}

/// Reads `packet` as everything that it could be, and forgets it: the one entry of the tests that feed arbitrary bytes.
#[doc(hidden)]
pub fn read_anything(packet: Packet<'_>, tilt: &TiltJoint) {
    let payload = packet.payload;
    let _ = (accepted(payload), controller_version(payload), recipe(payload), text(payload));
    let Some(&id) = payload.first() else { return };
    for known in [[true; EXTRAS.len()], [false; EXTRAS.len()]] {
        if let Some(outputs) = Outputs::new_checked(payload, OutputRecipe::new(id, known)) {
            outputs.fill(tilt, &mut RobotState::default());
        }
    }
}
