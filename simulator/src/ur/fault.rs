//! What can go wrong with a controller, by name: `fin`, `stall=2`, `in-use=input_int_register_24` and so on.
//!
//! Pure; allocates for names and messages. The command line, the operator port and tests use the same words; [`Fault`] reads
//! and writes them. A text that names no fault is an error which says what is wrong with it.

use std::fmt;
use std::str::FromStr;

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
    /// The emergency stop button is pressed.
    EmergencyStop,
    /// The emergency stop button is released.
    EmergencyRelease,
    /// Programs start this much later from now on.
    LateStart(f64),
    /// The program is stopped on the pendant.
    ProgramStop,
    /// The program is paused on the pendant.
    ProgramPause,
    /// The pendant's speed slider is moved to this share of full speed.
    SpeedSlider(f64),
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
in-use=INPUT          a fieldbus owns this input variable
not-found=VARIABLE    this variable does not exist
refuse-version-2      RTDE protocol version 2 is refused
text=MESSAGE          send an RTDE text message now
text-on-connect=MESSAGE  send an RTDE text message to whoever connects
protective-stop       stop the arm; unlock on the dashboard after 5 s
emergency-stop        press the emergency stop
emergency-release     release it; then 'power on' and 'brake release' on the dashboard
late-start=SECONDS    programs start this much later
program-stop          stop the program on the pendant
program-pause         pause the program on the pendant
speed-slider=SHARE    move the pendant's speed slider, 0.01 to 1
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
        let seconds = || {
            let value = given()?.parse::<f64>().ok().filter(|s| (0.0..=3600.0).contains(s));
            value.ok_or_else(|| fail("needs seconds, 0 to 3600"))
        };
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
            "in-use" => match given()? {
                variable if Input::parse(variable).is_some() => Ok(Fault::InUse(variable.to_owned())),
                _ => Err(fail("needs the name of an RTDE input variable")),
            },
            "not-found" => given().map(|v| Fault::NotFound(v.to_owned())),
            "refuse-version-2" => plain(Fault::RefuseVersion2),
            "text" => given().map(|v| Fault::Text(v.to_owned())),
            "text-on-connect" => given().map(|v| Fault::TextOnConnect(v.to_owned())),
            "protective-stop" => plain(Fault::ProtectiveStop),
            "emergency-stop" => plain(Fault::EmergencyStop),
            "emergency-release" => plain(Fault::EmergencyRelease),
            "late-start" => seconds().map(Fault::LateStart),
            "program-stop" => plain(Fault::ProgramStop),
            "program-pause" => plain(Fault::ProgramPause),
            "speed-slider" => {
                let share = given()?.parse::<f64>().ok().filter(|s| (0.01..=1.0).contains(s));
                share.map(Fault::SpeedSlider).ok_or_else(|| fail("needs a share, 0.01 to 1"))
            }
            "local-control" => plain(Fault::LocalControl),
            "remote-control" => plain(Fault::RemoteControl),
            "clear" => plain(Fault::Clear),
            _ => Err(fail("no such fault; 'simulator ur --help' lists them")),
        }
    }
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
            Fault::InUse(v) => write!(f, "in-use={v}"),
            Fault::NotFound(v) => write!(f, "not-found={v}"),
            Fault::RefuseVersion2 => f.write_str("refuse-version-2"),
            Fault::Text(m) => write!(f, "text={m}"),
            Fault::TextOnConnect(m) => write!(f, "text-on-connect={m}"),
            Fault::ProtectiveStop => f.write_str("protective-stop"),
            Fault::EmergencyStop => f.write_str("emergency-stop"),
            Fault::EmergencyRelease => f.write_str("emergency-release"),
            Fault::LateStart(s) => write!(f, "late-start={s}"),
            Fault::ProgramStop => f.write_str("program-stop"),
            Fault::ProgramPause => f.write_str("program-pause"),
            Fault::SpeedSlider(share) => write!(f, "speed-slider={share}"),
            Fault::LocalControl => f.write_str("local-control"),
            Fault::RemoteControl => f.write_str("remote-control"),
            Fault::Clear => f.write_str("clear"),
        }
    }
}
