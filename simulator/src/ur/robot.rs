//! All that a running program and the clients' inputs can see and touch: the arm, the registers, outputs, watchdogs and the log.
//!
//! Pure. Runs on the controller's thread; allocates for log lines and watchdogs only. A demand that the arm cannot follow is
//! kept as the reason of a protective stop, which [`super::machine`] then makes.

use super::log::{Log, LogKind};
use super::registers::Registers;
use super::servo::Servo;
use super::variables::Input;
use super::watchdog::{WatchdogAction, Watchdogs};

/// Controller time at the start, in s. UR's client library waits for 40 s after a boot, so a robot that stands ready is older.
const START_S: f64 = 60.0;

/// Time in which the arm's speed changes from full to none when the slider or the controller slows it, in s. Chosen by hand; no
/// measurement is recorded.
const RAMP_S: f64 = 0.1;
/// What the pendant's installation says that the tool carries: mass in kg, and centre of gravity in m from the flange. It is about a holder with
/// a full glass; chosen by hand.
const PAYLOAD: (f64, [f64; 3]) = (0.9, [0.0, 0.0, 0.08]);

/// What the clients selected before they write outputs: a value counts only where its mask has a bit set.
#[derive(Debug, Default)]
struct Masks {
    speed_slider: u32,
    /// The fraction last written, which counts while the mask is set.
    speed_slider_fraction: f64,
    /// Masks of the standard, configurable and tool digital outputs.
    digital: [u8; 3],
    analog: u8,
}

/// All that a running program can see and touch.
#[derive(Debug)]
pub struct Robot {
    /// The arm.
    pub servo: Servo,
    /// The registers that clients write.
    pub inputs: Registers,
    /// The registers that the program writes.
    pub outputs: Registers,
    /// Digital outputs; the bits are those of actual_digital_output_bits.
    pub digital_out: u64,
    /// The standard analog outputs, 0 to 1.
    pub(super) analog_out: [f64; 2],
    pub(super) watchdogs: Watchdogs,
    pub(super) log: Log,
    /// Control cycles since the start.
    pub(super) cycle: u64,
    /// Set by a demand that the arm cannot follow; the machine turns it into a protective stop.
    pub(super) protective_stop: Option<String>,
    speed_slider: f64,
    /// The share that the controller's own reasons leave, 0 to 1.
    own_scaling: f64,
    /// The shares that the slider and the controller's own reasons leave at present; they follow the two above along a ramp.
    present: [f64; 2],
    /// Mass in kg and centre of gravity in m of what the tool carries, as the robot was told.
    pub(super) payload: (f64, [f64; 3]),
    masks: Masks,
    steptime_s: f64,
}

impl Robot {
    /// A robot that stands still at `start_q_rad` (base to wrist 3) and whose control cycle lasts `steptime_s`.
    pub fn new(start_q_rad: [f64; 6], steptime_s: f64) -> Self {
        Self {
            servo: Servo::new(start_q_rad),
            inputs: Registers::default(),
            outputs: Registers::default(),
            digital_out: 0,
            analog_out: [0.0; 2],
            watchdogs: Watchdogs::default(),
            log: Log::default(),
            cycle: 0,
            protective_stop: None,
            speed_slider: 1.0,
            own_scaling: 1.0,
            present: [1.0; 2],
            payload: PAYLOAD,
            masks: Masks::default(),
            steptime_s,
        }
    }

    /// Length of a control cycle in s.
    pub fn steptime_s(&self) -> f64 {
        self.steptime_s
    }

    /// Controller time in s.
    pub fn timestamp_s(&self) -> f64 {
        START_S + self.cycle as f64 * self.steptime_s
    }

    /// Number of control cycles that come closest to `time_s`.
    pub fn cycles(&self, time_s: f64) -> u64 {
        (time_s / self.steptime_s).round() as u64
    }

    /// Where the speed slider stands, 0 to 1: RTDE's target_speed_fraction.
    pub fn speed_slider(&self) -> f64 {
        self.speed_slider
    }

    /// Share of the speed that the controller's own reasons leave at present, 0 to 1: RTDE's speed_scaling. The slider is not in it.
    pub fn own_scaling(&self) -> f64 {
        self.present[1] * self.servo.limiting()
    }

    /// Share of full speed at which the arm goes through its path at present, 0 to 1.
    pub fn speed_share(&self) -> f64 {
        self.present[0] * self.own_scaling()
    }

    /// Slows the arm to `share` (0 to 1) of what the slider leaves, as a controller does by itself for many reasons.
    pub fn set_own_scaling(&mut self, share: f64) {
        self.own_scaling = share;
    }

    /// Tells the robot what its tool carries: the mass in kg and its centre of gravity in m, seen from the flange.
    pub fn set_payload(&mut self, mass_kg: f64, cog_m: [f64; 3]) {
        self.payload = (mass_kg, cog_m);
    }

    /// Lets the arm move for one control cycle.
    pub(super) fn step_arm(&mut self) {
        for (present, wanted) in self.present.iter_mut().zip([self.speed_slider, self.own_scaling]) {
            *present += (wanted - *present).clamp(-self.steptime_s / RAMP_S, self.steptime_s / RAMP_S);
        }
        self.servo.step(self.steptime_s, self.present[0] * self.present[1]);
    }

    /// Moves the speed slider to `share` of full speed, 0 to 1.
    pub fn set_speed_slider(&mut self, share: f64) {
        self.speed_slider = share;
    }

    /// Carries out `servoj` towards `q` (rad). A demand that cannot be followed becomes a protective stop.
    pub fn servoj(&mut self, q: [f64; 6], lookahead_s: f64, gain: f64) {
        let result = self.servo.servoj(q, lookahead_s, gain);
        self.stop_if_absurd(result);
    }

    /// Carries out `movej` to `q` (rad). A demand that cannot be followed becomes a protective stop.
    pub fn movej(&mut self, q: [f64; 6], acceleration_rad_s2: f64, speed_rad_s: f64) {
        let result = self.servo.movej(q, acceleration_rad_s2, speed_rad_s);
        self.stop_if_absurd(result);
    }

    /// Carries out `speedj` with the speeds `qd` (rad/s). A demand that cannot be followed becomes a protective stop.
    pub fn speedj(&mut self, qd: [f64; 6], acceleration_rad_s2: f64) {
        let result = self.servo.speedj(qd, acceleration_rad_s2);
        self.stop_if_absurd(result);
    }

    fn stop_if_absurd(&mut self, result: Result<(), String>) {
        if let Err(reason) = result {
            self.protective_stop.get_or_insert(reason);
        }
    }

    /// Carries out `rtde_set_watchdog`. A frequency of 0 lapses at once, as on a robot.
    pub fn set_watchdog(&mut self, input: Input, min_frequency_hz: f64, action: WatchdogAction) {
        let max_cycles = if min_frequency_hz > 0.0 { 1.0 / (min_frequency_hz * self.steptime_s) } else { 0.0 };
        self.watchdogs.set(input, max_cycles, action, self.cycle);
    }

    /// Logs a line that the program wrote with `textmsg`.
    pub fn textmsg(&mut self, text: &str) {
        self.note(LogKind::Text, text);
    }

    /// Logs that something happened to the program or to the robot's safety.
    pub(super) fn event(&mut self, text: &str) {
        self.note(LogKind::Event, text);
    }

    /// Logs that a program has a mistake or was refused.
    pub(super) fn program_error(&mut self, text: &str) {
        self.note(LogKind::ProgramError, text);
    }

    fn note(&mut self, kind: LogKind, text: &str) {
        self.log.note(self.timestamp_s(), kind, text);
    }

    /// Takes over an `input` that a client wrote; `value` has the bytes of the input's type, big-endian.
    pub fn write_input(&mut self, input: Input, value: &[u8]) {
        self.watchdogs.updated(input, self.cycle);
        let byte = value.first().copied().unwrap_or(0);
        let word = value.first_chunk().map_or(0, |b| u32::from_be_bytes(*b));
        let double = value.first_chunk().map_or(0.0, |b| f64::from_be_bytes(*b));
        let bits = |of: &mut u64, shift: u32, mask: u8| *of = *of & !(u64::from(mask) << shift) | (u64::from(byte & mask) << shift);
        match input {
            Input::IntRegister(n) => self.inputs.int[usize::from(n)] = word as i32,
            Input::DoubleRegister(n) => self.inputs.double[usize::from(n)] = double,
            Input::BitRegister(n) => self.inputs.set_bit(usize::from(n), byte != 0),
            Input::BitRegisters(first) => self.inputs.set_word(first, word),
            Input::SpeedSliderMask => self.masks.speed_slider = word,
            Input::SpeedSliderFraction => self.masks.speed_slider_fraction = double,
            Input::StandardDigitalOutputMask => self.masks.digital[0] = byte,
            Input::ConfigurableDigitalOutputMask => self.masks.digital[1] = byte,
            Input::ToolDigitalOutputMask => self.masks.digital[2] = byte,
            Input::StandardDigitalOutput => bits(&mut self.digital_out, 0, self.masks.digital[0]),
            Input::ConfigurableDigitalOutput => bits(&mut self.digital_out, 8, self.masks.digital[1]),
            Input::ToolDigitalOutput => bits(&mut self.digital_out, 16, self.masks.digital[2] & 3),
            Input::StandardAnalogOutputMask => self.masks.analog = byte,
            Input::StandardAnalogOutput(n) => {
                if self.masks.analog >> n & 1 == 1 && (0.0..=1.0).contains(&double) {
                    self.analog_out[usize::from(n)] = double;
                }
            }
            Input::StandardAnalogOutputType | Input::ExternalForceTorque => {}
        }
        if self.masks.speed_slider & 1 == 1 && (0.0..=1.0).contains(&self.masks.speed_slider_fraction) {
            self.speed_slider = self.masks.speed_slider_fraction;
        }
    }
}
