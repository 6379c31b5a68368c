//! The dashboard server on port 29999: one command a line, one answer a line, in UR's words.
//!
//! Pure. Runs on the controller's thread; allocates the answers. A command that is unknown, or cannot be carried out now, gets
//! the answer that a robot gives.

use super::machine::Machine;
use super::program::RuntimeState;
use super::variables::Series;

/// The line that a client reads when it connects (as a robot sends it).
pub const GREETING: &str = "Connected: Universal Robots Dashboard Server";

/// The commands that an e-Series in local control refuses (UR's dashboard server manual); it still answers questions.
const REMOTE_ONLY: [&str; 7] = ["play", "stop", "pause", "power on", "power off", "brake release", "unlock protective stop"];

/// The answer to one command. None when the client wants to leave.
pub fn answer(line: &str, machine: &mut Machine) -> Option<String> {
    let line = line.trim();
    let lower = line.to_ascii_lowercase();
    if lower == "quit" || lower == "exit" {
        return None;
    }
    if REMOTE_ONLY.contains(&lower.as_str()) {
        return Some(carry_out(&lower, machine).unwrap_or_else(|| format!("Failed to execute: {line}")));
    }
    Some(question(&lower, line, machine))
}

/// Carries out one of the [`REMOTE_ONLY`] commands. None when that is not possible now.
fn carry_out(command: &str, machine: &mut Machine) -> Option<String> {
    if !machine.remote_control() {
        return None;
    }
    let said = match command {
        "play" => machine.resume().then_some("Starting program")?,
        "stop" => {
            machine.stop_program();
            // The answer is the same when there is no program: ur_rtde ends its program itself and still expects this answer.
            "Stopped"
        }
        "pause" => machine.pause().then_some("Pausing program")?,
        "power on" => machine.power_on().then_some("Powering on")?,
        "power off" => {
            machine.power_off();
            "Powering off"
        }
        "brake release" => machine.brake_release().then_some("Brake releasing")?,
        _ => match machine.unlock_protective_stop() {
            Ok(()) => "Protective stop releasing",
            Err(answer) => answer,
        },
    };
    Some(said.to_owned())
}

/// The answer to all other commands, which change nothing. `line` is the command `lower` as the client wrote it.
fn question(lower: &str, line: &str, machine: &Machine) -> String {
    let version = machine.version();
    let e_series = machine.series() == Series::ESeries;
    match lower {
        "running" => format!("Program running: {}", machine.runtime_state() == RuntimeState::Playing),
        "robotmode" => format!("Robotmode: {}", machine.robot_mode().name()),
        "safetymode" => format!("Safetymode: {}", machine.safety_mode().name()),
        "safetystatus" => format!("Safetystatus: {}", machine.safety_mode().name()),
        "programstate" => {
            let state = match machine.runtime_state() {
                RuntimeState::Stopping | RuntimeState::Stopped => "STOPPED",
                RuntimeState::Playing | RuntimeState::Resuming => "PLAYING",
                RuntimeState::Pausing | RuntimeState::Paused => "PAUSED",
            };
            let name = if machine.program_name().is_empty() { "<unnamed>" } else { machine.program_name() };
            format!("{state} {name}")
        }
        "polyscopeversion" => {
            format!("URSoftware {}.{}.{}.{} (Jan 01 2023)", version.major, version.minor, version.bugfix, version.build)
        }
        "get loaded program" => "No program loaded".to_owned(),
        "isprogramsaved" => "true <unnamed>".to_owned(),
        "close popup" => "closing popup".to_owned(),
        "close safety popup" => "closing safety popup".to_owned(),
        "restart safety" => "Restarting safety".to_owned(),
        "get serial number" if e_series => "20195500001".to_owned(),
        "get robot model" => "UR5".to_owned(),
        "is in remote control" if e_series => machine.remote_control().to_string(),
        "get operational mode" if e_series => "NONE".to_owned(),
        _ if lower.starts_with("popup") => "showing popup".to_owned(),
        _ if lower.starts_with("addtolog") => "Added log message".to_owned(),
        _ if lower.starts_with("load ") => format!("File not found: {}", line[5..].trim()),
        _ => format!("could not understand: '{line}'"),
    }
}
