//! The robot: its ports, versions, mode, registers, payload and speed.
//!
//! Called once by an ordinary thread; allocates; waits for up to two seconds for each answer. Nothing fails. Nothing is started or written
//! on the robot. Of a robot that a controller of this cell already has, ports and dashboard are looked at, and the
//! controller is asked.

use std::io::{ErrorKind, Read as _, Write as _};
use std::net::{IpAddr, SocketAddr, TcpStream};
use std::time::{Duration, Instant};

use rt_controller::claim::Running;
use rt_controller::client::Client;
use rt_controller::core::following;
use rt_controller::link::{self, LinkError, LinkOptions, RobotState, hands, health, payload};
use rt_controller::stop_client;
use shared::config::Config;
use shared::control::{EndReason, RobotLink};
use shared::machine::Finding;
use shared::runtime_dir::Place;

/// The dashboard's port (Universal Robots, dashboard server manual).
const DASHBOARD: u16 = 29999;
/// The ports that take a program, and the one that takes targets (Universal Robots, client interfaces and RTDE guide).
const PORTS: [u16; 4] = [30001, 30002, 30003, 30004];
/// How long a port may take to answer. Chosen by hand: a robot on the same network answers within milliseconds.
const ANSWER: Duration = Duration::from_secs(2);
/// Longest line of the dashboard, bytes. Chosen by hand: its answers are a few words.
const LINE_MAX: usize = 512;
/// What the robot's target speed is at least, as a fraction, where its slider stands at full speed: link/health.rs in rt-controller refuses less.
const FULL_SPEED: f64 = 0.995;

/// Looks at the robot.
pub fn look(config: &Config) -> Vec<Finding> {
    let named = &config.robot.address;
    let address = match named.resolve() {
        Ok(address) => address,
        Err(e) => {
            let advice = "check robot.address, the network and its name server, or give the address itself";
            return vec![Finding::red("robot", format!("{named}: its address cannot be looked up: {e}"), "nothing can be moved", advice)];
        }
    };
    let open = |port: u16| TcpStream::connect_timeout(&SocketAddr::new(address, port), ANSWER);
    let mut findings = Vec::new();
    let ports: Vec<(u16, Result<(), String>)> = PORTS.iter().map(|p| (*p, open(*p).map(|_| ()).map_err(|e| e.to_string()))).collect();
    if ports.iter().all(|(_, answer)| answer.is_err()) {
        let is = format!("{address}: {}", ports.iter().filter_map(|(_, a)| a.as_ref().err()).next_back().cloned().unwrap_or_default());
        let advice = "switch the robot on, check cable and robot.address, and enable its services (Settings > Security > Services)";
        return vec![Finding::red("robot", is, "nothing can be moved", advice)];
    }
    if named.literal().is_none() {
        findings.push(Finding::green("name", format!("{named} is {address}")));
    }
    findings.push(program_port(&ports[..3]));
    findings.push(match &ports[3].1 {
        Ok(()) => Finding::green("RTDE", "port 30004 is open"),
        Err(e) => {
            let advice = "enable Real-Time Data Exchange (Settings > Security > Services), and let no firewall close it";
            Finding::red("RTDE", format!("port 30004: {e}"), "no target can be sent", advice)
        }
    });
    findings.push(dashboard(address));
    if let Ok(Some(running)) = stop_client::running_at(&Place::from(&config.cell)) {
        findings.push(held(&running, &Place::from(&config.cell)));
        return findings;
    }
    match link::look(&LinkOptions::new(config, address)) {
        Ok(seen) => {
            let [major, minor, bugfix, build] = seen.version;
            findings.push(Finding::green("version", format!("PolyScope {major}.{minor}.{bugfix} (build {build})")));
            findings.push(refused("registers", "free", seen.registers, "the program and the targets need them"));
            findings.push(refused("state", "may move, upright, and no program runs", seen.ready, "the robot is not taken before that"));
            findings.push(speed(&seen.state));
            findings.push(match payload::warning(&seen.state, config.robot.payload_kg) {
                None => {
                    Finding::green("payload", seen.state.payload_kg.map_or("not told by this robot".into(), |kg| format!("{kg:.2} kg")))
                }
                Some(warning) => Finding::yellow("payload", warning, "it may stop protectively, or move more slowly", ""),
            });
        }
        Err(e) => findings.push(refused("RTDE", "", Err(e), "no target can be sent")),
    }
    findings
}

/// What a controller of this cell says of its robot.
fn held(running: &Running, place: &Place) -> Finding {
    let is = format!("rt-controller (process {}) runs", running.pid);
    match Client::connect(place.clone()).and_then(|client| client.status()) {
        Ok(status) if status.robot == RobotLink::Connected && !status.hindrance.is_empty() => {
            let is = format!("{is}, has the robot, and would refuse a pour: {}", status.hindrance);
            let (means, advice) = ("nothing can be poured before that", "`decant status` says more");
            if status.may_record { Finding::yellow("state", is, means, advice) } else { Finding::red("state", is, means, advice) }
        }
        Ok(status) if status.robot == RobotLink::Connected && !status.robot_warning.is_empty() => {
            Finding::yellow("state", format!("{is}, and has the robot: {}", status.robot_warning), "see the robot's settings", "")
        }
        Ok(status) if status.robot == RobotLink::Connected => {
            Finding::green("state", format!("{is}, and its program is at work on the robot"))
        }
        Ok(status) => {
            let is = format!("{is}, and has no robot: {}", status.hindrance);
            let (means, advice) = ("nothing can be poured before that", "`decant status` says more");
            let connecting = status.robot == RobotLink::Connecting;
            if connecting { Finding::yellow("state", is, means, advice) } else { Finding::red("state", is, means, advice) }
        }
        Err(e) => Finding::yellow("state", format!("{is}: {e}"), "it is not known whether the robot may move", "`decant status`"),
    }
}

/// Whether one of three ports takes the program, and how each of them is.
fn program_port(ports: &[(u16, Result<(), String>)]) -> Finding {
    let each: Vec<String> =
        ports.iter().map(|(port, answer)| format!("{port} {}", answer.as_ref().map_or_else(String::as_str, |()| "open"))).collect();
    let advice = "enable the secondary client interface (Settings > Security > Services)";
    if ports.iter().all(|(_, answer)| answer.is_err()) {
        Finding::red("program's port", each.join(", "), "the program cannot be brought to the robot", advice)
    } else {
        Finding::green("program's port", each.join(", "))
    }
}

/// The next line that comes within [`ANSWER`]. Whatever else listens there may send bytes for ever, fast or slowly, and no line.
fn line(stream: &mut TcpStream) -> std::io::Result<String> {
    let until = Instant::now() + ANSWER;
    let mut line = Vec::new();
    while line.len() < LINE_MAX {
        let left = until.saturating_duration_since(Instant::now()).max(Duration::from_millis(1));
        stream.set_read_timeout(Some(left))?;
        let mut byte = [0];
        stream.read_exact(&mut byte)?;
        match byte {
            [b'\n'] => return Ok(String::from_utf8_lossy(&line).trim().into()),
            _ if Instant::now() > until => return Err(ErrorKind::TimedOut.into()),
            [byte] => line.push(byte),
        }
    }
    Err(std::io::Error::other("what answers there is no dashboard"))
}

/// What the dashboard says. It is not needed for a pour.
fn dashboard(address: IpAddr) -> Finding {
    let ask = || -> std::io::Result<Vec<String>> {
        let mut stream = TcpStream::connect_timeout(&SocketAddr::new(address, DASHBOARD), ANSWER)?;
        stream.set_write_timeout(Some(ANSWER))?;
        line(&mut stream)?;
        let mut answers = Vec::new();
        for question in ["robotmode", "safetystatus", "is in remote control"] {
            writeln!(stream, "{question}")?;
            answers.push(line(&mut stream)?);
        }
        Ok(answers)
    };
    match ask() {
        Ok(answers) => {
            let remote = answers.last().map_or("", String::as_str);
            // A CB3 knows no remote control, and says that it does not understand.
            let told = if remote.contains("could not understand") { "not known to this robot" } else { remote };
            let is = format!("{}, remote control: {told}", answers[..answers.len().saturating_sub(1)].join(", "));
            if let Some(reason) = hindrance(&answers) {
                Finding::red("dashboard", is, reason.words(), hands::remedy(reason))
            } else if remote.eq_ignore_ascii_case("false") {
                let advice = "switch the pendant to remote control (its upper right corner)";
                Finding::yellow("dashboard", is, "an e-Series robot in local control takes no program", advice)
            } else {
                Finding::green("dashboard", is)
            }
        }
        Err(e) => {
            let e = match e.kind() {
                ErrorKind::WouldBlock | ErrorKind::TimedOut => format!("no answer within {} s", ANSWER.as_secs()),
                _ => e.to_string(),
            };
            let advice = "on a robot with PolyScope: enable the dashboard server (Settings > Security > Services)";
            Finding::yellow("dashboard", format!("port {DASHBOARD}: {e}"), "whether it is in remote control is not known", advice)
        }
    }
}

/// Why the robot does not move, by the answers of its dashboard, if it does not. A CB3 knows no `safetystatus` before PolyScope 3.11, and says that it does
/// not understand.
fn hindrance(answers: &[String]) -> Option<EndReason> {
    let told = |what| answers.iter().find_map(|answer| answer.strip_prefix(what));
    match told("Safetystatus: ").unwrap_or("NORMAL") {
        "NORMAL" | "REDUCED" => told("Robotmode: ").filter(|mode| *mode != "RUNNING").map(|_| EndReason::RobotNotRunning),
        "PROTECTIVE_STOP" => Some(EndReason::ProtectiveStop),
        "SYSTEM_EMERGENCY_STOP" | "ROBOT_EMERGENCY_STOP" => Some(EndReason::EmergencyStop),
        _ => Some(EndReason::SafetyStop),
    }
}

/// Whether the robot is slowed.
fn speed(state: &RobotState) -> Finding {
    let slider = state.speed_fraction;
    let scaling = state.speed_scaling.map_or(String::new(), |s| format!(", speed scaling {:.0} %", s * 100.0));
    let is = format!("slider {:.0} %{scaling}", slider * 100.0);
    if slider < FULL_SPEED {
        return Finding::red("speed", is, "a pour ends before it starts", "set the speed slider on the pendant to 100 %");
    }
    // A robot that does not run moves at no speed at all; the line on its state says that.
    let runs = state.robot_mode == health::ROBOT_MODE_RUNNING;
    if runs && state.speed_scaling.is_some_and(|share| share.is_nan() || share < f64::from(following::FULL_SPEED)) {
        let advice = "look for speed limits of the safety configuration, reduced mode, or a wrong payload";
        return Finding::red("speed", is, "the robot slows itself, and every pour is refused", advice);
    }
    Finding::green("speed", is)
}

/// A finding of what the link refuses, in its own words.
fn refused(what: &str, good: &str, result: Result<(), LinkError>, means: &str) -> Finding {
    match result {
        Ok(()) => Finding::green(what, good),
        Err(e) => Finding::red(what, e.to_string(), means, ""),
    }
}

#[cfg(test)]
mod tests {
    use std::net::{Ipv4Addr, TcpListener};

    use shared::machine::Verdict;

    use super::*;

    /// Protects who opens a firewall: any one of the three ports is enough, and each is told as it is.
    #[test]
    fn each_port_is_told() {
        let ports = |answers: [Result<(), &str>; 3]| {
            let each = PORTS.iter().zip(answers).map(|(port, answer)| (*port, answer.map_err(String::from)));
            program_port(&each.collect::<Vec<_>>())
        };
        let one = ports([Err("refused"), Ok(()), Err("timed out")]);
        assert_eq!((one.verdict, one.is.as_str()), (Verdict::Green, "30001 refused, 30002 open, 30003 timed out"));
        assert_eq!(ports([Err("refused"); 3]).verdict, Verdict::Red);
    }

    /// Protects who asks why nothing moves while a controller has the robot, or none can: what the dashboard says is judged too, and answers that are none are
    /// not. The words are those of UR's manual.
    #[test]
    fn the_dashboard_is_believed() {
        for (mode, safety, reason) in [
            ("Robotmode: RUNNING", "Safetystatus: NORMAL", None),
            ("Robotmode: RUNNING", "Safetystatus: REDUCED", None),
            ("Robotmode: RUNNING", "could not understand: 'safetystatus'", None),
            ("Robotmode: POWER_OFF", "could not understand: 'safetystatus'", Some(EndReason::RobotNotRunning)),
            ("Robotmode: CONFIRM_SAFETY", "Safetystatus: NORMAL", Some(EndReason::RobotNotRunning)),
            ("Robotmode: RUNNING", "Safetystatus: PROTECTIVE_STOP", Some(EndReason::ProtectiveStop)),
            ("Robotmode: POWER_OFF", "Safetystatus: ROBOT_EMERGENCY_STOP", Some(EndReason::EmergencyStop)),
            ("Robotmode: RUNNING", "Safetystatus: AUTOMATIC_MODE_SAFEGUARD_STOP", Some(EndReason::SafetyStop)),
            ("Robotmode: IDLE", "Safetystatus: FAULT", Some(EndReason::SafetyStop)),
        ] {
            assert_eq!(hindrance(&[mode, safety, "true"].map(String::from)), reason, "{mode}, {safety}");
        }
    }

    /// Protects the doctor from what else may listen at a robot's address: what hangs up without an answer is no dashboard that is in order, and what sends
    /// bytes without end neither holds it nor fills its memory.
    #[test]
    fn what_is_no_dashboard_is_not_green() {
        for (own, flood) in [(Ipv4Addr::new(127, 91, 3, 1), false), (Ipv4Addr::new(127, 91, 3, 2), true)] {
            let listener = TcpListener::bind((own, DASHBOARD)).unwrap();
            let serve = std::thread::spawn(move || {
                let (mut stream, _) = listener.accept().unwrap();
                while flood && stream.write_all(&[b'x'; 4096]).is_ok() {}
            });
            let found = dashboard(own.into());
            assert_eq!(found.verdict, Verdict::Yellow, "{found:?}");
            assert!(!flood || found.is.contains("is no dashboard"), "{found:?}");
            serve.join().unwrap();
        }
    }
}
