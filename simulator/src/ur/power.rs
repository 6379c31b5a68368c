//! The arm's power and brakes: which of them are on, and the steps from one state to the next.
//!
//! Pure, one step a control cycle, on the controller's thread; no allocation. That an emergency stop forbids the power is known
//! by [`super::machine`].

/// RTDE's robot_mode: the state of power and brakes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RobotMode {
    /// The arm has no power.
    PowerOff = 3,
    /// The arm is about to have power.
    PowerOn = 4,
    /// The arm has power and its brakes are on.
    Idle = 5,
    /// The brakes are released and the arm is ready to move.
    Running = 7,
}

impl RobotMode {
    /// The mode's name in the dashboard's answers.
    pub fn name(self) -> &'static str {
        match self {
            RobotMode::PowerOff => "POWER_OFF",
            RobotMode::PowerOn => "POWER_ON",
            RobotMode::Idle => "IDLE",
            RobotMode::Running => "RUNNING",
        }
    }
}

/// Power and brakes; times are control cycles.
#[derive(Debug)]
pub struct Power {
    mode: RobotMode,
    /// The mode that comes next, and the cycle at which it does.
    next: Option<(u64, RobotMode)>,
    /// True when the brakes are released as soon as the arm has power.
    go_on: bool,
    /// How long each step takes.
    step_cycles: u64,
}

impl Power {
    /// An arm with its brakes released, whose later steps between modes take `step_cycles`.
    pub fn running(step_cycles: u64) -> Self {
        Self { mode: RobotMode::Running, next: None, go_on: false, step_cycles }
    }

    /// The present mode.
    pub fn mode(&self) -> RobotMode {
        self.mode
    }

    /// Finishes the step that is over at the cycle `now`.
    pub fn step(&mut self, now: u64) {
        if let Some((_, next)) = self.next.take_if(|(at, _)| *at <= now) {
            self.mode = next;
            if next == RobotMode::PowerOn {
                self.begin(now, RobotMode::Idle);
            }
            if next == RobotMode::Idle && self.go_on {
                self.begin(now, RobotMode::Running);
            }
        }
    }

    fn begin(&mut self, now: u64, next: RobotMode) {
        self.next = Some((now + self.step_cycles, next));
    }

    /// Begins to switch the power on, if it is off.
    pub fn switch_on(&mut self, now: u64) {
        if self.mode == RobotMode::PowerOff && self.next.is_none() {
            self.begin(now, RobotMode::PowerOn);
        }
    }

    /// Begins to release the brakes of an arm that has power, and otherwise to switch the power on.
    pub fn release_brakes(&mut self, now: u64) {
        self.switch_on(now);
        if self.mode == RobotMode::Idle && self.next.is_none() {
            self.begin(now, RobotMode::Running);
        }
    }

    /// Begins all steps up to released brakes, as the pendant's start button does.
    pub fn start(&mut self, now: u64) {
        self.release_brakes(now);
        self.go_on = true;
    }

    /// Switches the power off at once.
    pub fn switch_off(&mut self) {
        self.mode = RobotMode::PowerOff;
        self.next = None;
        self.go_on = false;
    }
}
