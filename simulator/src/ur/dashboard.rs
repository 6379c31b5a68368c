//! The dashboard server (29999): one command a line, one answer a line, in UR's words. Pure; on the controller's thread.

use super::machine::{Machine, RuntimeState};
use super::variables::Series;

/// What a client reads on connecting.
pub const GREETING: &str = "Connected: Universal Robots Dashboard Server";

/// The answer to one command; None: the client wants to leave.
pub fn answer(line: &str, machine: &mut Machine) -> Option<String> {
    let line = line.trim();
    let lower = line.to_ascii_lowercase();
    let failed = || format!("Failed to execute: {line}");
    let version = machine.version();
    let e_series = machine.series() == Series::ESeries;
    let said = match lower.as_str() {
        "quit" | "exit" => return None,
        // In local control an e-Series answers questions only.
        "play" | "stop" | "pause" | "power on" | "power off" | "brake release" | "unlock protective stop" if !machine.remote_control() => {
            failed()
        }
        "play" => if_done(machine.resume(), "Starting program", failed),
        // The same with no program: ur_rtde ends its program itself and still wants to hear this.
        "stop" => {
            machine.stop_program();
            "Stopped".to_owned()
        }
        "pause" => if_done(machine.pause(), "Pausing program", failed),
        "power on" => if_done(machine.power_on(), "Powering on", failed),
        "power off" => {
            machine.power_off();
            "Powering off".to_owned()
        }
        "brake release" => if_done(machine.brake_release(), "Brake releasing", failed),
        "unlock protective stop" => match machine.unlock_protective_stop() {
            Ok(()) => "Protective stop releasing".to_owned(),
            Err(answer) => answer.to_owned(),
        },
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
    };
    Some(said)
}

fn if_done(done: bool, said: &str, failed: impl Fn() -> String) -> String {
    if done { said.to_owned() } else { failed() }
}
