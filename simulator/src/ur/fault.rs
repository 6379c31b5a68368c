//! What can go wrong with a controller, by name: `fin`, `stall=2`, `in-use=input_int_register_24` and so on.
//!
//! Pure; allocates for names and messages. The command line, the operator port and tests use the same words; [`Fault`] reads
//! and writes them. A text that names no fault is an error which says what is wrong with it.

use std::fmt;
use std::str::FromStr;

use shared::config::Joint;

use super::machine::SafetyMode;
use super::variables::Input;

/// A fault, or the end of one. Times are in s.
#[derive(Debug, Clone, PartialEq)]
pub enum Fault {
    /// All RTDE connections are closed in order (FIN).
    Fin,
    /// All RTDE connections are aborted (RST).
    Reset,
    /// All sockets close and nothing answers for this long, as when a controller restarts or a cable is pulled.
    Offline(f64),
    /// RTDE connections stay open for this long, but nothing is sent or read: they are half open.
    Stall(f64),
    /// RTDE keeps sending the same packet for this long, so that its timestamp stands still.
    Freeze(f64),
    /// What RTDE clients send is not read for this long, and then all at once.
    SlowReader(f64),
    /// The RTDE outputs of this many cycles are skipped.
    SkipOutputs(u32),
    /// RTDE bytes arrive in pieces for this long.
    Split(f64),
    /// RTDE packets arrive four at a time for this long.
    Coalesce(f64),
    /// Every RTDE packet is sent twice for this long.
    Twice(f64),
    /// A fieldbus owns this input from now on.
    InUse(String),
    /// The variable of this name is unknown from now on.
    NotFound(String),
    /// Protocol version 2 is refused from now on.
    RefuseVersion2,
    /// Every RTDE client gets this text message now.
    Text(String),
    /// Every RTDE client that connects from now on gets this text message before anything else.
    TextOnConnect(String),
    /// The arm hit something.
    ProtectiveStop,
    /// A safeguard is opened.
    SafeguardOpen,
    /// It is closed again, with the automatic reset.
    SafeguardClosed,
    /// The emergency stop button is pressed.
    EmergencyStop,
    /// The emergency stop button is released.
    EmergencyRelease,
    /// The safety system goes into this mode, one that no other fault causes; or back to normal, and then an arm without power stays so.
    SafetyMode(SafetyMode),
    /// Programs start this much later from now on.
    LateStart(f64),
    /// The program is stopped on the pendant.
    ProgramStop,
    /// The program is paused on the pendant.
    ProgramPause,
    /// The pendant's speed slider is moved to this share of full speed.
    SpeedSlider(f64),
    /// The controller itself slows the arm to this share of what the slider leaves.
    TimeScaling(f64),
    /// The safety configuration lets no joint move faster than this, in degrees/s.
    JointSpeedLimit(f64),
    /// The arm is held back to this speed, in degrees/s, and nothing tells.
    HeldBack(f64),
    /// The teach button is pressed, so that the arm can be moved by hand. The program that runs is ended.
    Freedrive,
    /// The teach button is released.
    FreedriveEnd,
    /// Somebody moves this joint by hand by so many degrees, while the teach button is pressed.
    HandMove(Joint, f64),
    /// Somebody moves this joint with the pendant by so many degrees.
    Jog(Joint, f64),
    /// The robot was just booted and never started.
    Boot,
    /// Somebody switches the power on and releases the brakes at the pendant.
    BrakeRelease,
    /// The pendant resumes a paused program.
    ProgramResume,
    /// A protective stop is unlocked at the pendant.
    UnlockProtectiveStop,
    /// Connections to this port are refused from now on, as when its service is disabled in the settings.
    ClosePort(u16),
    /// The robot was told that its tool carries this mass, in kg.
    Payload(f64),
    /// The robot was told that the centre of gravity of what its tool carries is here, in m from the flange.
    PayloadCog([f64; 3]),
    /// The pendant of an e-Series is switched to local control.
    LocalControl,
    /// The pendant of an e-Series is switched to remote control.
    RemoteControl,
    /// Every fault that lasts ends. This does not heal the robot.
    Clear,
}

/// The faults for `--help`, one a line, with the meaning of what follows the `=`.
pub const HELP: &str = "\
fin                   close the RTDE connections
reset                 abort the RTDE connections (RST)
offline=SECONDS       close everything and be unreachable
stall=SECONDS         RTDE stays open but is silent and deaf (half open)
freeze=SECONDS        RTDE repeats one packet: its timestamp stands still
slow-reader=SECONDS   RTDE inputs are read late, then all at once
skip-outputs=CYCLES   leave out RTDE outputs
split=SECONDS         RTDE packets arrive in pieces
coalesce=SECONDS      RTDE packets arrive four at a time
twice=SECONDS         every RTDE packet is sent twice
in-use=INPUT          a fieldbus owns this input variable
not-found=VARIABLE    this variable does not exist
refuse-version-2      RTDE protocol version 2 is refused
text=MESSAGE          send an RTDE text message now
text-on-connect=MESSAGE  send an RTDE text message to whoever connects
protective-stop       stop the arm; unlock on the dashboard after 5 s
safeguard-open        open a door or light curtain
safeguard-closed      close it again, with the automatic reset
emergency-stop        press the emergency stop
emergency-release     release it; then 'power on' and 'brake release' on the dashboard
safety-mode=MODE      reduced, recovery, system-emergency-stop, violation or fault; normal ends it
late-start=SECONDS    programs start this much later
program-stop          stop the program on the pendant
program-pause         pause the program on the pendant
program-resume        go on with the paused program on the pendant
unlock-protective-stop  unlock a protective stop on the pendant, 5 s after it
speed-slider=SHARE    move the pendant's speed slider, 0.01 to 1
time-scaling=SHARE    the controller slows the arm by itself, 0.01 to 1
joint-speed-limit=DEG_S  the safety configuration limits the joints' speed
held-back=DEG_S       the arm follows servoj no faster, and nothing tells
freedrive             press the teach button, which ends the program
freedrive-end         release it
hand-move=JOINT:DEG   move a joint by hand; needs freedrive and no program
jog=JOINT:DEG         move a joint with the pendant; needs no running program
boot                  no power, no program ever, 'paused' as after a boot
brake-release         power on and brakes released on the pendant
close-port=PORT       refuse connections to this port (a disabled service)
payload=KG            what the robot was told that its tool carries
payload-cog=X:Y:Z     its centre of gravity in m
local-control         e-Series: programs are ignored
remote-control        e-Series: programs are taken again
clear                 end every fault that lasts";

/// A text that names no fault: the text, and what is wrong with it.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("fault \"{0}\": {1}")]
pub struct UnknownFault(String, String);

impl FromStr for Fault {
    type Err = UnknownFault;

    fn from_str(text: &str) -> Result<Self, UnknownFault> {
        let fail = |what: &str| UnknownFault(text.to_owned(), what.to_owned());
        let (name, value) = match text.split_once('=') {
            Some((name, value)) => (name.trim(), Some(value.trim())),
            None => (text.trim(), None),
        };
        let given = || value.filter(|v| !v.is_empty()).ok_or_else(|| fail("needs a value, as in NAME=VALUE"));
        let number = |low: f64, high: f64, what: &str| {
            let value = given()?.parse::<f64>().ok().filter(|s| (low..=high).contains(s));
            value.ok_or_else(|| fail(&format!("needs {what}, {low} to {high}")))
        };
        let seconds = || number(0.0, 3600.0, "seconds");
        let plain = |fault: Fault| if value.is_some() { Err(fail("takes no value")) } else { Ok(fault) };
        match name {
            "fin" => plain(Fault::Fin),
            "reset" => plain(Fault::Reset),
            "offline" => seconds().map(Fault::Offline),
            "stall" => seconds().map(Fault::Stall),
            "freeze" => seconds().map(Fault::Freeze),
            "slow-reader" => seconds().map(Fault::SlowReader),
            "skip-outputs" => given()?.parse().map(Fault::SkipOutputs).map_err(|_| fail("needs a number of cycles")),
            "split" => seconds().map(Fault::Split),
            "coalesce" => seconds().map(Fault::Coalesce),
            "twice" => seconds().map(Fault::Twice),
            "in-use" => match given()? {
                variable if Input::parse(variable).is_some() => Ok(Fault::InUse(variable.to_owned())),
                _ => Err(fail("needs the name of an RTDE input variable")),
            },
            "not-found" => given().map(|v| Fault::NotFound(v.to_owned())),
            "refuse-version-2" => plain(Fault::RefuseVersion2),
            "text" => given().map(|v| Fault::Text(v.to_owned())),
            "text-on-connect" => given().map(|v| Fault::TextOnConnect(v.to_owned())),
            "protective-stop" => plain(Fault::ProtectiveStop),
            "safeguard-open" => plain(Fault::SafeguardOpen),
            "safeguard-closed" => plain(Fault::SafeguardClosed),
            "emergency-stop" => plain(Fault::EmergencyStop),
            "emergency-release" => plain(Fault::EmergencyRelease),
            "safety-mode" => {
                let name = given()?;
                let mode = SAFETY_MODES.iter().find(|(n, _)| *n == name).map(|(_, mode)| Fault::SafetyMode(*mode));
                mode.ok_or_else(|| fail("needs normal, reduced, recovery, system-emergency-stop, violation or fault"))
            }
            "late-start" => seconds().map(Fault::LateStart),
            "program-stop" => plain(Fault::ProgramStop),
            "program-pause" => plain(Fault::ProgramPause),
            "speed-slider" => number(0.01, 1.0, "a share").map(Fault::SpeedSlider),
            "program-resume" => plain(Fault::ProgramResume),
            "unlock-protective-stop" => plain(Fault::UnlockProtectiveStop),
            "time-scaling" => number(0.01, 1.0, "a share").map(Fault::TimeScaling),
            "joint-speed-limit" => number(1.0, 180.0, "degrees a second").map(Fault::JointSpeedLimit),
            "held-back" => number(1.0, 180.0, "degrees a second").map(Fault::HeldBack),
            "freedrive" => plain(Fault::Freedrive),
            "freedrive-end" => plain(Fault::FreedriveEnd),
            "hand-move" => joint_and_degrees(given()?).map(|(joint, deg)| Fault::HandMove(joint, deg)).ok_or_else(|| fail(MOVE)),
            "jog" => joint_and_degrees(given()?).map(|(joint, deg)| Fault::Jog(joint, deg)).ok_or_else(|| fail(MOVE)),
            "boot" => plain(Fault::Boot),
            "brake-release" => plain(Fault::BrakeRelease),
            "close-port" => {
                let port = given()?.parse().ok().filter(|port| CLOSABLE_PORTS.contains(port));
                port.map(Fault::ClosePort).ok_or_else(|| fail("needs a port of a robot: 29999 or 30001 to 30004"))
            }
            "payload" => number(0.0, 100.0, "kg").map(Fault::Payload),
            "payload-cog" => {
                let numbers: Vec<f64> = given()?.split(':').filter_map(|m| m.parse().ok()).collect();
                numbers.try_into().map(Fault::PayloadCog).map_err(|_| fail("needs three numbers in m, as in 0:0:0.05"))
            }
            "local-control" => plain(Fault::LocalControl),
            "remote-control" => plain(Fault::RemoteControl),
            "clear" => plain(Fault::Clear),
            _ => Err(fail("no such fault; 'simulator ur --help' lists them")),
        }
    }
}

/// The joints by the names that the configuration gives them.
const JOINTS: [(&str, Joint); 6] = [
    ("base", Joint::Base),
    ("shoulder", Joint::Shoulder),
    ("elbow", Joint::Elbow),
    ("wrist_1", Joint::Wrist1),
    ("wrist_2", Joint::Wrist2),
    ("wrist_3", Joint::Wrist3),
];
/// The modes of the safety system that no other fault causes, and how they end, by the names of `safety-mode`.
const SAFETY_MODES: [(&str, SafetyMode); 6] = [
    ("normal", SafetyMode::Normal),
    ("reduced", SafetyMode::Reduced),
    ("recovery", SafetyMode::Recovery),
    ("system-emergency-stop", SafetyMode::SystemEmergencyStop),
    ("violation", SafetyMode::Violation),
    ("fault", SafetyMode::Fault),
];
/// The ports of a robot's services (UR's manuals).
const CLOSABLE_PORTS: [u16; 5] = [29_999, 30_001, 30_002, 30_003, 30_004];
/// What is wrong with a motion that cannot be read.
const MOVE: &str = "needs a joint (base, shoulder, elbow, wrist_1, wrist_2, wrist_3) and degrees, -360 to 360, as in base:10";

fn joint_and_degrees(text: &str) -> Option<(Joint, f64)> {
    let (name, degrees) = text.split_once(':')?;
    let (_, joint) = JOINTS.iter().find(|(n, _)| *n == name.trim())?;
    Some((*joint, degrees.trim().parse().ok().filter(|d| (-360.0..=360.0).contains(d))?))
}

fn joint_name(joint: Joint) -> &'static str {
    JOINTS.iter().find(|(_, j)| *j == joint).map_or("", |(name, _)| name)
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Fault::Fin => f.write_str("fin"),
            Fault::Reset => f.write_str("reset"),
            Fault::Offline(s) => write!(f, "offline={s}"),
            Fault::Stall(s) => write!(f, "stall={s}"),
            Fault::Freeze(s) => write!(f, "freeze={s}"),
            Fault::SlowReader(s) => write!(f, "slow-reader={s}"),
            Fault::SkipOutputs(n) => write!(f, "skip-outputs={n}"),
            Fault::Split(s) => write!(f, "split={s}"),
            Fault::Coalesce(s) => write!(f, "coalesce={s}"),
            Fault::Twice(s) => write!(f, "twice={s}"),
            Fault::InUse(v) => write!(f, "in-use={v}"),
            Fault::NotFound(v) => write!(f, "not-found={v}"),
            Fault::RefuseVersion2 => f.write_str("refuse-version-2"),
            Fault::Text(m) => write!(f, "text={m}"),
            Fault::TextOnConnect(m) => write!(f, "text-on-connect={m}"),
            Fault::ProtectiveStop => f.write_str("protective-stop"),
            Fault::SafeguardOpen => f.write_str("safeguard-open"),
            Fault::SafeguardClosed => f.write_str("safeguard-closed"),
            Fault::EmergencyStop => f.write_str("emergency-stop"),
            Fault::EmergencyRelease => f.write_str("emergency-release"),
            Fault::SafetyMode(mode) => {
                write!(f, "safety-mode={}", SAFETY_MODES.iter().find(|(_, m)| m == mode).map_or("", |(name, _)| name))
            }
            Fault::LateStart(s) => write!(f, "late-start={s}"),
            Fault::ProgramStop => f.write_str("program-stop"),
            Fault::ProgramPause => f.write_str("program-pause"),
            Fault::SpeedSlider(share) => write!(f, "speed-slider={share}"),
            Fault::ProgramResume => f.write_str("program-resume"),
            Fault::UnlockProtectiveStop => f.write_str("unlock-protective-stop"),
            Fault::TimeScaling(share) => write!(f, "time-scaling={share}"),
            Fault::JointSpeedLimit(limit) => write!(f, "joint-speed-limit={limit}"),
            Fault::HeldBack(speed) => write!(f, "held-back={speed}"),
            Fault::Freedrive => f.write_str("freedrive"),
            Fault::FreedriveEnd => f.write_str("freedrive-end"),
            Fault::HandMove(joint, deg) => write!(f, "hand-move={}:{deg}", joint_name(*joint)),
            Fault::Jog(joint, deg) => write!(f, "jog={}:{deg}", joint_name(*joint)),
            Fault::Boot => f.write_str("boot"),
            Fault::BrakeRelease => f.write_str("brake-release"),
            Fault::ClosePort(port) => write!(f, "close-port={port}"),
            Fault::Payload(mass) => write!(f, "payload={mass}"),
            Fault::PayloadCog([x, y, z]) => write!(f, "payload-cog={x}:{y}:{z}"),
            Fault::LocalControl => f.write_str("local-control"),
            Fault::RemoteControl => f.write_str("remote-control"),
            Fault::Clear => f.write_str("clear"),
        }
    }
}
