//! RTDE frames (protocol 2, big-endian): checked views of what the robot sends, and the few frames that we send.
//!
//! Pure; used by the connecting thread and by the loop. Allocates nothing but [`Inbox::new`]'s one buffer. No bytes make
//! anything here panic; what does not fit gives `None` or [`Malformed`]. Frame = u16 size of the whole frame, u8 type, payload.

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

/// Bytes before the payload.
const HEADER: usize = 3;
/// The largest frame that its u16 size can announce.
const LARGEST: usize = u16::MAX as usize;
/// Length of a frame with one target.
pub const TARGET_LEN: usize = HEADER + 1 + 4 + 4 + 8;

/// One whole frame.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Frame<'a> {
    /// Its type.
    pub kind: u8,
    /// What follows the header.
    pub payload: &'a [u8],
}

/// The byte stream is not RTDE: a frame announces a size smaller than its own header.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("a frame announces {0} bytes, less than its own header")]
pub struct Malformed(pub u16);

/// Puts frames together from whatever pieces the socket delivers.
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
    /// An empty inbox; its only allocation. One byte more than the largest frame, so that there is always space.
    pub fn new() -> Self {
        Self { buffer: vec![0; LARGEST + 1].into_boxed_slice(), start: 0, end: 0 }
    }

    /// Where the socket's next bytes go; never empty once [`Inbox::next_frame`] has given `None`.
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

    /// The next whole frame; `None` until more bytes come.
    pub fn next_frame(&mut self) -> Result<Option<Frame<'_>>, Malformed> {
        let waiting = &self.buffer[self.start..self.end];
        let &[high, low, kind, ..] = waiting else { return Ok(None) };
        let size = u16::from_be_bytes([high, low]);
        if usize::from(size) < HEADER {
            return Err(Malformed(size));
        }
        let Some(payload) = waiting.get(HEADER..usize::from(size)) else { return Ok(None) };
        self.start += usize::from(size);
        Ok(Some(Frame { kind, payload }))
    }
}

/// Writes a frame into `out` and gives its bytes; `None` if it does not fit into `out` or into a frame.
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

/// The DATA_PACKAGE with one target: number, mode code and joint angle in rad, in the order of [`input_names`].
pub fn encode_target(recipe: u8, sequence: i32, mode: i32, joint_rad: f64) -> [u8; TARGET_LEN] {
    let mut out = [0; TARGET_LEN];
    let parts: [&[u8]; 4] = [&[recipe], &sequence.to_be_bytes(), &mode.to_be_bytes(), &joint_rad.to_be_bytes()];
    // Cannot fail: TARGET_LEN is the sum of the parts (held by a test).
    let _ = encode(DATA, &parts, &mut out);
    out
}

/// Answer to V, S: accepted or not.
pub fn accepted(payload: &[u8]) -> Option<bool> {
    match payload {
        [code] => Some(*code != 0),
        _ => None,
    }
}

/// Answer to v: major, minor, bugfix, build.
pub fn controller_version(payload: &[u8]) -> Option<[u32; 4]> {
    let bytes: &[u8; 16] = payload.try_into().ok()?;
    let mut version = [0; 4];
    for (number, four) in version.iter_mut().zip(bytes.chunks_exact(4)) {
        *number = u32::from_be_bytes(four.try_into().ok()?);
    }
    Some(version)
}

/// Answer to O, I: recipe id and the comma-separated types.
pub fn recipe(payload: &[u8]) -> Option<(u8, &str)> {
    let (&id, types) = payload.split_first()?;
    Some((id, std::str::from_utf8(types).ok()?))
}

/// TEXT_MESSAGE of protocol 2: level (0 exception, 1 error, 2 warning, 3 info) and the message's bytes.
pub fn text(payload: &[u8]) -> Option<(u8, &[u8])> {
    let (&message_len, rest) = payload.split_first()?;
    let message = rest.get(..usize::from(message_len))?;
    let (&source_len, rest) = rest.get(usize::from(message_len)..)?.split_first()?;
    let level = *rest.get(usize::from(source_len))?;
    Some((level, message))
}

/// Names and types of the outputs that we ask for, with registers from `base`; [`Outputs`] reads them.
pub fn output_names(base: u8) -> [(String, &'static str); 13] {
    let plain = |name: &str, kind| (name.to_owned(), kind);
    [
        plain("timestamp", "DOUBLE"),
        plain("actual_q", "VECTOR6D"),
        plain("target_q", "VECTOR6D"),
        plain("actual_qd", "VECTOR6D"),
        plain("robot_mode", "INT32"),
        plain("safety_mode", "INT32"),
        plain("safety_status_bits", "UINT32"),
        plain("runtime_state", "UINT32"),
        (format!("output_int_register_{base}"), "INT32"),
        (format!("output_int_register_{}", u32::from(base) + 1), "INT32"),
        (format!("output_int_register_{}", u32::from(base) + 2), "INT32"),
        (format!("output_double_register_{base}"), "DOUBLE"),
        plain("target_speed_fraction", "DOUBLE"),
    ]
}

/// Names and types of the inputs that we write, with registers from `base`; [`encode_target`] writes them.
pub fn input_names(base: u8) -> [(String, &'static str); 3] {
    [
        (format!("input_int_register_{base}"), "INT32"),
        (format!("input_int_register_{}", u32::from(base) + 1), "INT32"),
        (format!("input_double_register_{base}"), "DOUBLE"),
    ]
}

/// A DATA_PACKAGE in our output recipe, checked once for recipe and length.
#[derive(Debug, Clone, Copy)]
pub struct Outputs<'a>(&'a [u8; OUTPUTS_LEN]);

/// Bytes of the values of [`output_names`].
const OUTPUTS_LEN: usize = 8 + 3 * 48 + 4 * 4 + 3 * 4 + 2 * 8;

impl<'a> Outputs<'a> {
    /// A view of `payload` if it has our recipe id and length.
    pub fn new_checked(payload: &'a [u8], recipe: u8) -> Option<Self> {
        let (&id, values) = payload.split_first()?;
        (id == recipe).then_some(Self(values.try_into().ok()?))
    }

    fn four(&self, at: usize) -> [u8; 4] {
        let mut bytes = [0; 4];
        bytes.copy_from_slice(&self.0[at..at + 4]);
        bytes
    }

    fn real(&self, at: usize) -> f64 {
        let mut bytes = [0; 8];
        bytes.copy_from_slice(&self.0[at..at + 8]);
        f64::from_be_bytes(bytes)
    }

    /// The robot's clock, s.
    pub fn timestamp_s(&self) -> f64 {
        self.real(0)
    }

    /// Measured angle of joint 0 to 5, rad.
    pub fn actual_q(&self, joint: usize) -> f64 {
        self.real(8 + 8 * joint.min(5))
    }

    /// Writes what the frame says into `state`; the three times and their bookkeeping are the session's.
    pub fn fill(&self, tilt: &TiltJoint, state: &mut RobotState) {
        let joint = 8 * tilt.joint.index();
        state.timestamp_s = self.timestamp_s();
        state.alpha_deg = tilt.alpha_deg(self.actual_q(tilt.joint.index()));
        state.alpha_target_deg = tilt.alpha_deg(self.real(56 + joint));
        state.alpha_rate_deg_s = (tilt.direction * self.real(104 + joint).to_degrees()) as f32;
        state.robot_mode = i32::from_be_bytes(self.four(152));
        state.safety_mode = i32::from_be_bytes(self.four(156));
        state.safety_bits = u32::from_be_bytes(self.four(160));
        state.runtime_state = u32::from_be_bytes(self.four(164));
        state.program_state = ProgramState::from_code(i32::from_be_bytes(self.four(168)));
        state.sequence_echo = i32::from_be_bytes(self.four(172));
        state.program_run = i32::from_be_bytes(self.four(176));
        state.alpha_command_deg = tilt.alpha_deg(self.real(180));
        state.speed_fraction = self.real(188);
    }
}

/// Reads `frame` as everything that it could be, and forgets it: the one entry of the tests that feed arbitrary bytes.
#[doc(hidden)]
pub fn read_anything(frame: Frame<'_>, tilt: &TiltJoint) {
    let payload = frame.payload;
    let _ = (accepted(payload), controller_version(payload), recipe(payload), text(payload));
    if let Some(outputs) = payload.first().and_then(|id| Outputs::new_checked(payload, *id)) {
        outputs.fill(tilt, &mut RobotState::default());
    }
}
