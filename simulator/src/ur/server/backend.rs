//! What stands behind the sockets: the machine, who owns which input, and the faults that last.
//!
//! Pure. Runs on the controller's thread; allocates for names of variables only, and cannot fail. Faults that act on connections
//! alone are carried out by the server itself.

use crate::ur::fault::Fault;
use crate::ur::machine::Machine;
use crate::ur::rtde::InputOwners;
use crate::ur::servo::MAX_SPEED_RAD_S;
use crate::ur::variables::Input;

/// The faults that last. A fault is on while the machine's cycle is below its number here.
#[derive(Default)]
pub struct StandingFaults {
    /// Names of variables that the controller pretends not to know.
    pub hidden: Vec<String>,
    pub refuse_version_2: bool,
    pub text_on_connect: Option<String>,
    pub offline_until: u64,
    pub stall_until: u64,
    pub freeze_until: u64,
    pub slow_reader_until: u64,
    pub skip_until: u64,
    pub split_until: u64,
    pub coalesce_until: u64,
    pub twice_until: u64,
    /// Ports that refuse connections.
    pub closed_ports: Vec<u16>,
}

/// What the clients reach through their sockets.
pub struct Backend {
    /// The controller without sockets.
    pub machine: Machine,
    /// Who owns which input.
    pub owners: InputOwners,
    /// The faults that last.
    pub faults: StandingFaults,
}

impl Backend {
    /// True while the machine's cycle is below `until`.
    pub fn is_before(&self, until: u64) -> bool {
        self.machine.cycle() < until
    }

    /// The cycle that comes `time_s` from now.
    fn cycle_in(&self, time_s: f64) -> u64 {
        self.machine.cycle() + self.machine.robot.cycles(time_s)
    }

    /// Takes a program that a client sent, or notes why its text cannot be one.
    pub fn upload(&mut self, program: Result<String, &'static str>) {
        match program {
            Ok(source) => self.machine.upload(&source),
            Err(what) => self.machine.program_error(what),
        }
    }

    /// Carries out the part of a fault that no socket takes part in.
    pub fn inject(&mut self, fault: &Fault) {
        match fault {
            Fault::Offline(s) => lengthen(self.cycle_in(*s), &mut self.faults.offline_until),
            Fault::Stall(s) => lengthen(self.cycle_in(*s), &mut self.faults.stall_until),
            Fault::Freeze(s) => lengthen(self.cycle_in(*s), &mut self.faults.freeze_until),
            Fault::SlowReader(s) => lengthen(self.cycle_in(*s), &mut self.faults.slow_reader_until),
            Fault::SkipOutputs(n) => lengthen(self.machine.cycle() + u64::from(*n) + 1, &mut self.faults.skip_until),
            Fault::Split(s) => lengthen(self.cycle_in(*s), &mut self.faults.split_until),
            Fault::Coalesce(s) => lengthen(self.cycle_in(*s), &mut self.faults.coalesce_until),
            Fault::Twice(s) => lengthen(self.cycle_in(*s), &mut self.faults.twice_until),
            Fault::InUse(name) => {
                if let Some(input) = Input::parse(name) {
                    self.owners.claim_for_fieldbus(input);
                }
            }
            Fault::NotFound(name) => self.faults.hidden.push(name.clone()),
            Fault::RefuseVersion2 => self.faults.refuse_version_2 = true,
            Fault::TextOnConnect(message) => self.faults.text_on_connect = Some(message.clone()),
            Fault::ProtectiveStop => self.machine.protective_stop("injected"),
            Fault::SafeguardOpen => self.machine.open_safeguard(),
            Fault::SafeguardClosed => self.machine.close_safeguard(),
            Fault::EmergencyStop => self.machine.emergency_stop(),
            Fault::EmergencyRelease => self.machine.release_emergency_stop(),
            Fault::SafetyMode(mode) => self.machine.set_safety_mode(*mode),
            Fault::LateStart(s) => self.machine.set_late_start(*s),
            Fault::ProgramStop => drop(self.machine.stop_program()),
            Fault::ProgramPause => drop(self.machine.pause()),
            Fault::SpeedSlider(share) => self.machine.robot.set_speed_slider(*share),
            Fault::ProgramResume => drop(self.machine.resume()),
            Fault::UnlockProtectiveStop => {
                if let Err(answer) = self.machine.unlock_protective_stop() {
                    self.machine.program_error(answer);
                }
            }
            Fault::TimeScaling(share) => self.machine.robot.set_own_scaling(*share),
            Fault::JointSpeedLimit(deg_s) => self.machine.robot.servo.set_speed_limit(deg_s.to_radians()),
            Fault::HeldBack(deg_s) => self.machine.robot.servo.hold_back(deg_s.to_radians()),
            Fault::Freedrive => self.machine.set_freedrive(true),
            Fault::FreedriveEnd => self.machine.set_freedrive(false),
            Fault::HandMove(joint, deg) => self.machine.move_joint(joint.index(), deg.to_radians(), true),
            Fault::Jog(joint, deg) => self.machine.move_joint(joint.index(), deg.to_radians(), false),
            Fault::Boot => self.machine.boot(),
            Fault::BrakeRelease => drop(self.machine.start_arm()),
            Fault::ClosePort(port) => {
                self.faults.closed_ports.retain(|closed| closed != port);
                self.faults.closed_ports.push(*port);
            }
            Fault::Payload(mass_kg) => self.machine.robot.set_payload(*mass_kg, self.machine.robot.payload.1),
            Fault::PayloadCog(cog_m) => self.machine.robot.set_payload(self.machine.robot.payload.0, *cog_m),
            Fault::LocalControl => self.machine.set_remote_control(false),
            Fault::RemoteControl => self.machine.set_remote_control(true),
            Fault::Clear => {
                self.faults = StandingFaults::default();
                self.owners.release_fieldbus();
                self.machine.set_late_start(0.0);
                self.machine.robot.set_own_scaling(1.0);
                self.machine.robot.servo.set_speed_limit(MAX_SPEED_RAD_S);
                self.machine.robot.servo.hold_back(MAX_SPEED_RAD_S);
            }
            Fault::Fin | Fault::Reset | Fault::Text(_) => {}
        }
    }
}

/// Lets a fault last until this cycle. One that stands already and lasts longer is not ended by it.
fn lengthen(cycle: u64, until: &mut u64) {
    *until = cycle.max(*until);
}
