//! The controller itself, without sockets: safety, power, programs and the arm, a control cycle at a time.
//!
//! A pure step: given the same inputs at the same cycles it does the same. Runs on the controller's thread; allocates for
//! programs and log lines only, within bounds. What a robot would show in a popup or in its log becomes a
//! [`LogLine`].

use super::log::LogLine;
use super::power::{Power, RobotMode};
use super::program::{Programs, RuntimeState};
use super::registers::Registers;
use super::robot::Robot;
use super::script::Effort;
use super::servo;
use super::variables::{Series, Version};

/// A protective stop can be unlocked after this time, in s (UR's dashboard server manual).
const UNLOCK_S: f64 = 5.0;
/// Time of each step of powering on and releasing the brakes, in s. Chosen by hand to keep tests short; a UR5 takes several
/// seconds.
const POWER_STEP_S: f64 = 0.5;

/// RTDE's safety_mode: what keeps the arm from moving.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SafetyMode {
    /// Nothing stops the arm.
    Normal = 1,
    /// The reduced limits of the safety configuration hold. That they slow the arm is a fault of its own, a limit of the joints' speed.
    Reduced = 2,
    /// A demand or a collision stopped the arm; somebody must unlock it.
    ProtectiveStop = 3,
    /// The robot was started outside its safety limits: a person may move the arm back, and no program runs.
    Recovery = 4,
    /// A safeguard is open: a door, a light curtain.
    SafeguardStop = 5,
    /// An emergency stop of the cell, and not of the robot, is pressed.
    SystemEmergencyStop = 6,
    /// The pendant's emergency stop button is pressed.
    RobotEmergencyStop = 7,
    /// A safety limit was violated; the arm has no power until the safety system is restarted.
    Violation = 8,
    /// The safety system itself has a fault; the arm has no power until it is restarted.
    Fault = 9,
}

impl SafetyMode {
    /// The mode's name in the dashboard's answers.
    pub fn name(self) -> &'static str {
        match self {
            SafetyMode::Normal => "NORMAL",
            SafetyMode::Reduced => "REDUCED",
            SafetyMode::ProtectiveStop => "PROTECTIVE_STOP",
            SafetyMode::Recovery => "RECOVERY",
            SafetyMode::SafeguardStop => "SAFEGUARD_STOP",
            SafetyMode::SystemEmergencyStop => "SYSTEM_EMERGENCY_STOP",
            SafetyMode::RobotEmergencyStop => "ROBOT_EMERGENCY_STOP",
            SafetyMode::Violation => "VIOLATION",
            SafetyMode::Fault => "FAULT",
        }
    }

    /// Whether programs may move the arm.
    pub fn lets_move(self) -> bool {
        matches!(self, SafetyMode::Normal | SafetyMode::Reduced)
    }

    /// Whether the arm gets no power.
    fn withholds_power(self) -> bool {
        use SafetyMode::*;
        matches!(self, SystemEmergencyStop | RobotEmergencyStop | Violation | Fault)
    }
}

/// A UR5 controller without its sockets.
#[derive(Debug)]
pub struct Machine {
    /// What programs and inputs act on.
    pub robot: Robot,
    pub(super) programs: Programs,
    power: Power,
    safety: SafetyMode,
    /// Whether a program ran when the safeguard opened: only that one goes on when it closes, and none that a person had paused.
    ran_behind_safeguard: bool,
    /// Cycle of the last protective stop.
    stopped_at: u64,
    series: Series,
    version: Version,
    /// True while somebody presses the teach button.
    freedrive: bool,
    /// Always true for a CB3. An e-Series in local control refuses programs and the dashboard's commands.
    remote_control: bool,
}

impl Machine {
    /// A controller that stands ready with its brakes released at `start_q_rad`.
    pub fn new(series: Series, version: Version, start_q_rad: [f64; 6]) -> Self {
        let robot = Robot::new(start_q_rad, 1.0 / series.rate_hz());
        let power = Power::running(robot.cycles(POWER_STEP_S));
        Self {
            robot,
            programs: Programs::default(),
            power,
            safety: SafetyMode::Normal,
            ran_behind_safeguard: false,
            stopped_at: 0,
            freedrive: false,
            series,
            version,
            remote_control: true,
        }
    }

    /// The controller's generation.
    pub fn series(&self) -> Series {
        self.series
    }

    /// The controller's version.
    pub fn version(&self) -> Version {
        self.version
    }

    /// State of power and brakes.
    pub fn robot_mode(&self) -> RobotMode {
        self.power.mode()
    }

    /// What keeps the arm from moving.
    pub fn safety_mode(&self) -> SafetyMode {
        self.safety
    }

    /// State of the program.
    pub fn runtime_state(&self) -> RuntimeState {
        self.programs.runtime_state()
    }

    /// Name of the running, paused or last program; empty before the first.
    pub fn program_name(&self) -> &str {
        self.programs.name()
    }

    /// Control cycles since the start.
    pub fn cycle(&self) -> u64 {
        self.robot.cycle
    }

    /// False for an e-Series in local control.
    pub fn remote_control(&self) -> bool {
        self.remote_control
    }

    /// Switches an e-Series between local and remote control; a CB3 has no such mode.
    pub fn set_remote_control(&mut self, remote: bool) {
        self.remote_control = remote || self.series == Series::Cb3;
    }

    /// Lets the next programs start `late_s` later than usual.
    pub fn set_late_start(&mut self, late_s: f64) {
        self.programs.set_late_start(late_s);
    }

    /// Lets the programs that are uploaded from now on compute with floats of 32 bits instead of 64.
    pub fn set_single_precision(&mut self, single: bool) {
        self.programs.set_single_precision(single);
    }

    /// What the interpreted program did in the last control cycle; nothing when none is loaded.
    pub fn program_effort(&self) -> Effort {
        self.programs.effort()
    }

    /// Takes the log lines written since the last call.
    pub fn take_log(&mut self) -> impl Iterator<Item = LogLine> + '_ {
        self.robot.log.take()
    }

    /// Logs that a program has a mistake or was refused.
    pub fn program_error(&mut self, text: &str) {
        self.robot.program_error(text);
    }

    /// Lets one control cycle pass.
    pub fn step(&mut self) {
        self.robot.cycle += 1;
        self.power.step(self.robot.cycle);
        self.obey_teach_button();
        self.programs.step(&mut self.robot);
        if let Some(reason) = self.robot.protective_stop.take() {
            self.protective_stop(&reason);
        }
        self.robot.step_arm();
    }

    fn may_move(&self) -> bool {
        self.robot_mode() == RobotMode::Running && self.safety.lets_move()
    }

    /// Takes a program that arrived on port 30001, 30002 or 30003. What is wrong with it goes to the log.
    pub fn upload(&mut self, source: &str) {
        if !self.remote_control {
            return self.program_error("program ignored: the robot is in local control; switch it to remote control on the pendant");
        }
        if !self.may_move() {
            let (mode, safety) = (self.robot_mode().name(), self.safety.name());
            return self.program_error(&format!("program not started: robot mode {mode}, safety mode {safety}"));
        }
        self.programs.upload(source, &mut self.robot);
    }

    /// Stops the program, as the pendant's stop button does. False when there is none.
    pub fn stop_program(&mut self) -> bool {
        self.programs.stop(&mut self.robot)
    }

    /// Pauses the running program. False when none is running.
    pub fn pause(&mut self) -> bool {
        self.programs.pause(&mut self.robot)
    }

    /// Lets a paused program go on. False when none is paused, or when the robot may not move.
    pub fn resume(&mut self) -> bool {
        self.may_move() && self.programs.resume(&mut self.robot)
    }

    /// Stops the arm as fast as it can and pauses the program, for `reason`.
    pub fn protective_stop(&mut self, reason: &str) {
        if !self.may_move() {
            return;
        }
        self.robot.event(&format!("protective stop: {reason}"));
        self.safety = SafetyMode::ProtectiveStop;
        self.stopped_at = self.robot.cycle;
        self.robot.servo.stop(servo::FAST_STOP_RAD_S2);
        self.programs.pause_for_protective_stop();
    }

    /// Opens a safeguard: the arm stops, and the program stands still with it.
    pub fn open_safeguard(&mut self) {
        if self.may_move() {
            self.robot.event("safeguard opened");
            self.safety = SafetyMode::SafeguardStop;
            self.robot.servo.stop(servo::STOP_RAD_S2);
            self.ran_behind_safeguard = matches!(self.programs.runtime_state(), RuntimeState::Playing | RuntimeState::Resuming);
            self.programs.pause_for_protective_stop();
        }
    }

    /// Closes it again, with the automatic reset: a program that stood still goes on.
    pub fn close_safeguard(&mut self) {
        if self.safety == SafetyMode::SafeguardStop {
            self.safety = SafetyMode::Normal;
            self.robot.event("safeguard closed");
            if self.ran_behind_safeguard {
                self.programs.resume(&mut self.robot);
            }
        }
    }

    /// Unlocks a protective stop. A robot that was not stopped answers the same.
    ///
    /// # Errors
    /// The dashboard's answer when the stop is too recent.
    pub fn unlock_protective_stop(&mut self) -> Result<(), &'static str> {
        if self.safety != SafetyMode::ProtectiveStop {
            return Ok(());
        }
        if self.robot.cycle - self.stopped_at < self.robot.cycles(UNLOCK_S) {
            return Err(
                "Cannot unlock protective stop until 5s after occurrence. Always inspect cause of protective stop before unlocking",
            );
        }
        self.safety = SafetyMode::Normal;
        self.robot.event("protective stop unlocked");
        Ok(())
    }

    /// Presses the emergency stop button: the program ends, and the arm stops and loses its power.
    pub fn emergency_stop(&mut self) {
        if self.safety.withholds_power() {
            return;
        }
        self.robot.event("emergency stop pressed");
        self.safety = SafetyMode::RobotEmergencyStop;
        self.power_off();
    }

    /// Releases the emergency stop button. Somebody must still switch the power on and release the brakes.
    pub fn release_emergency_stop(&mut self) {
        if self.safety == SafetyMode::RobotEmergencyStop {
            self.safety = SafetyMode::Normal;
            self.robot.event("emergency stop released");
        }
    }

    /// Puts the safety system into a mode that no button of this robot causes: reduced, recovery, system emergency stop, violation or fault. What
    /// stops the arm ends the program, and all but recovery take the power. Normal ends any of these, as a person does who restarts the safety
    /// system, and leaves an arm without power so.
    pub fn set_safety_mode(&mut self, mode: SafetyMode) {
        use SafetyMode::*;
        let may = match mode {
            Normal => matches!(self.safety, Reduced | Recovery | SystemEmergencyStop | Violation | Fault),
            Reduced | Recovery => self.may_move(),
            SystemEmergencyStop | Violation | Fault => true,
            ProtectiveStop | SafeguardStop | RobotEmergencyStop => false,
        };
        if !may {
            return;
        }
        self.robot.event(&format!("safety mode {}", mode.name()));
        self.safety = mode;
        if mode == Recovery {
            self.programs.stop(&mut self.robot);
        } else if mode.withholds_power() {
            self.power_off();
        }
    }

    /// Switches the arm's power on. False when the emergency stop is pressed, or the safety system withholds it.
    pub fn power_on(&mut self) -> bool {
        let may = !self.safety.withholds_power();
        if may {
            self.power.switch_on(self.robot.cycle);
        }
        may
    }

    /// Ends the program, stops the arm and switches its power off.
    pub fn power_off(&mut self) {
        self.programs.end_without_power(&mut self.robot);
        self.robot.servo.stop(servo::FAST_STOP_RAD_S2);
        self.power.switch_off();
    }

    /// Switches the power on and releases the brakes, as somebody does at the pendant. False when the emergency stop is pressed, or the safety
    /// system withholds it.
    pub fn start_arm(&mut self) -> bool {
        let may = !self.safety.withholds_power();
        if may {
            self.power.start(self.robot.cycle);
        }
        may
    }

    /// Makes the controller look as after its boot: no power, empty registers, and no program was ever there.
    pub fn boot(&mut self) {
        self.power_off();
        self.programs.boot();
        self.robot.inputs = Registers::default();
        self.robot.outputs = Registers::default();
        self.robot.event("booted");
    }

    /// True while somebody presses the teach button.
    pub fn freedrive(&self) -> bool {
        self.freedrive
    }

    /// Presses or releases the teach button. Pressed, it ends the program that runs, and none starts or goes on; a paused one stays paused. Of
    /// what is reported of robots this is the harder case (Universal_Robots_ROS_Driver, issue 525; universal_robot, issue 54). Released, the arm
    /// stands.
    pub fn set_freedrive(&mut self, pressed: bool) {
        if self.freedrive && !pressed {
            self.robot.servo.stop(servo::STOP_RAD_S2);
        }
        self.freedrive = pressed;
        self.obey_teach_button();
    }

    /// Ends whatever runs or is about to, while the teach button is pressed; what is paused stays so.
    fn obey_teach_button(&mut self) {
        if self.freedrive && !matches!(self.runtime_state(), RuntimeState::Pausing | RuntimeState::Paused) {
            self.programs.stop(&mut self.robot);
        }
    }

    /// Lets a person move the joint of this number, 0 to 5, by `by_rad`: with the pendant, or by hand when `by_hand`. That needs a robot
    /// which may move and runs no program, and by hand the teach button; otherwise the log says why nothing moves.
    pub fn move_joint(&mut self, joint: usize, by_rad: f64, by_hand: bool) {
        let hindrance = if !self.may_move() && self.safety != SafetyMode::Recovery {
            "the robot may not move"
        } else if self.runtime_state() == RuntimeState::Playing {
            "a program runs"
        } else if by_hand && !self.freedrive {
            "the teach button is not pressed"
        } else {
            let mut goal = self.robot.servo.target_q;
            if let Some(angle) = goal.get_mut(joint) {
                *angle += by_rad;
            }
            let result = self.robot.servo.move_by_hand(goal);
            return result.unwrap_or_else(|what| self.robot.event(&what));
        };
        self.robot.event(&format!("no joint is moved: {hindrance}"));
    }

    /// Releases the brakes, switching the power on first where need be. False when the emergency stop is pressed, or the safety system withholds it.
    pub fn brake_release(&mut self) -> bool {
        let may = !self.safety.withholds_power();
        if may {
            self.power.release_brakes(self.robot.cycle);
        }
        may
    }
}
