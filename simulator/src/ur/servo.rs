//! The arm: what servoj, speedj, stopj and movej do to the six joints.
//!
//! Pure, one step a control cycle, on the controller's thread; does not allocate but for the reason of an error. servoj is
//! modelled as UR's script manual describes its parameters: the position is projected forward by the lookahead time along the
//! present velocity, and the gain acts like the P-term of a PID controller on what then remains. For each joint
//!
//! `target_qdd = gain * (q_commanded - (target_q + lookahead * target_qd))`
//!
//! so that a ramp is followed `lookahead` seconds late. Speed and acceleration are limited. The joints follow target_q through
//! a first-order lag, so that target_q, target_qd and actual_q are three different things, as on a robot. A demand that no arm
//! could follow is refused with the reason for a protective stop.

/// Largest joint speed in rad/s: the UR5's 180 deg/s (UR5 data sheet).
pub const MAX_SPEED_RAD_S: f64 = std::f64::consts::PI;
/// Largest joint acceleration in rad/s^2. UR publishes none; this is the most that ur_rtde lets a client ask for.
pub const MAX_ACCELERATION_RAD_S2: f64 = 40.0;
/// Range of every joint to both sides in rad: the UR5's 360 degrees (UR5 data sheet).
pub const RANGE_RAD: f64 = 2.0 * std::f64::consts::PI;
/// Largest difference of one joint between two servoj targets in a row, in rad. UR publishes no figure; this is chosen by hand,
/// as twice what a joint moves in 33 ms at full speed.
pub const MAX_STEP_RAD: f64 = 0.2;
/// Largest distance of a servoj target from target_q, in rad. UR publishes no figure; this is chosen by hand, above the 0.63
/// rad that the largest lookahead leaves at full speed.
pub const MAX_LAG_RAD: f64 = 0.8;
/// Deceleration when a program ends or is paused while the arm moves, in rad/s^2. Chosen by hand; no measurement is recorded.
pub const STOP_RAD_S2: f64 = 10.0;
/// Deceleration of a protective or emergency stop, in rad/s^2: as fast as the arm can be accelerated at all.
pub const FAST_STOP_RAD_S2: f64 = MAX_ACCELERATION_RAD_S2;
/// Usual time constant of the joints' lag behind target_q, in s. Chosen by hand; no measurement is recorded.
pub const LAG_S: f64 = 0.012;
/// Longest step in which the servoj equation is solved, in s. Chosen by hand, well below the shortest lookahead of 30 ms.
const SUBSTEP_S: f64 = 0.001;
/// Speed at which a person moves a joint by hand or with the pendant, in rad/s. Chosen by hand; no measurement is recorded.
const HAND_SPEED_RAD_S: f64 = 0.5;
/// Acceleration of the same, in rad/s^2. Chosen by hand; no measurement is recorded.
const HAND_ACCELERATION_RAD_S2: f64 = 2.0;
/// Most corrections of the share that keeps the speed limit. Chosen by hand: two are enough for a thousandth.
const SPEED_LIMIT_ROUNDS: usize = 4;
/// Names of the joints for messages, base to wrist 3 (as on UR's pendant).
const NAMES: [&str; 6] = ["base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3"];

/// What moves the arm at present.
#[derive(Debug, Clone, Copy, PartialEq)]
enum ArmMotion {
    Hold,
    Servoj { lookahead_s: f64, gain: f64 },
    Stop { deceleration_rad_s2: f64 },
    Speedj { goal_qd: [f64; 6], acceleration_rad_s2: f64 },
    Movej { goal: [f64; 6], acceleration_rad_s2: f64, speed_rad_s: f64, by_hand: bool },
}

/// The six joints; angles in rad, speeds in rad/s, accelerations in rad/s^2.
#[derive(Debug, Clone, PartialEq)]
pub struct Servo {
    /// The joint angles that the last servoj or movej asked for.
    pub commanded_q: [f64; 6],
    /// Number of calls of servoj so far.
    pub servoj_calls: u64,
    /// Where the trajectory is, which the joints follow.
    pub target_q: [f64; 6],
    /// The trajectory's speed.
    pub target_qd: [f64; 6],
    /// The trajectory's acceleration.
    pub target_qdd: [f64; 6],
    /// Where the joints are.
    pub actual_q: [f64; 6],
    /// The joints' speed.
    pub actual_qd: [f64; 6],
    /// Time constant of the joints' lag behind target_q, in s; above 0.
    pub lag_s: f64,
    motion: ArmMotion,
    /// Largest joint speed that the safety configuration allows, in rad/s.
    speed_limit_rad_s: f64,
    /// Largest joint speed that the arm reaches, whatever the controller knows of it, in rad/s.
    held_rad_s: f64,
    /// The share of its path's speed at which the speed limit lets the arm move at present, 0 to 1.
    limiting: f64,
    /// The speed along the path of an arm that nothing slows; target_qd is the speed of the arm as it is slowed.
    path_qd: [f64; 6],
    /// True when the last step went through a path that may be slowed.
    slowed: bool,
}

impl Servo {
    /// An arm at rest at `q` (rad).
    pub fn new(q: [f64; 6]) -> Self {
        let zero = [0.0; 6];
        Self {
            commanded_q: q,
            servoj_calls: 0,
            target_q: q,
            target_qd: zero,
            target_qdd: zero,
            actual_q: q,
            actual_qd: zero,
            lag_s: LAG_S,
            motion: ArmMotion::Hold,
            speed_limit_rad_s: MAX_SPEED_RAD_S,
            held_rad_s: MAX_SPEED_RAD_S,
            limiting: 1.0,
            path_qd: zero,
            slowed: false,
        }
    }

    /// Lets no joint move faster than `speed_rad_s` from now on, as the joint limits of the safety configuration do: the arm goes through
    /// its path more slowly.
    pub fn set_speed_limit(&mut self, speed_rad_s: f64) {
        self.speed_limit_rad_s = speed_rad_s;
    }

    /// Holds servoj back to `speed_rad_s` from now on, without a word: nothing tells, and servoj takes no longer.
    pub fn hold_back(&mut self, speed_rad_s: f64) {
        self.held_rad_s = speed_rad_s;
    }

    /// The share of its path's speed at which the speed limit lets the arm move at present, 0 to 1.
    pub fn limiting(&self) -> f64 {
        self.limiting
    }

    /// Follows `q` (rad) from now on.
    ///
    /// # Errors
    /// The reason for a protective stop.
    pub fn servoj(&mut self, q: [f64; 6], lookahead_s: f64, gain: f64) -> Result<(), String> {
        let before = if self.is_servoing() { self.commanded_q } else { self.target_q };
        for (i, name) in NAMES.iter().enumerate() {
            let (to, step, lag) = (q[i], (q[i] - before[i]).abs(), (q[i] - self.target_q[i]).abs());
            if to.is_nan() || to.abs() > RANGE_RAD {
                return Err(format!("servoj target of {name} is {to} rad, outside +-{RANGE_RAD:.4}"));
            }
            if step > MAX_STEP_RAD {
                return Err(format!(
                    "servoj target of {name} jumps by {step:.3} rad (from {:.3} to {to:.3}), more than {MAX_STEP_RAD}",
                    before[i]
                ));
            }
            if lag > MAX_LAG_RAD {
                return Err(format!("servoj target of {name} is {lag:.3} rad away from the arm, more than {MAX_LAG_RAD}"));
            }
        }
        self.commanded_q = q;
        self.servoj_calls += 1;
        self.motion = ArmMotion::Servoj { lookahead_s, gain };
        Ok(())
    }

    /// Slows all joints down to rest.
    pub fn stop(&mut self, deceleration_rad_s2: f64) {
        self.motion = ArmMotion::Stop { deceleration_rad_s2 };
    }

    /// Goes to `goal` (rad) with all joints in step.
    ///
    /// # Errors
    /// The reason for a protective stop.
    pub fn movej(&mut self, goal: [f64; 6], acceleration_rad_s2: f64, speed_rad_s: f64) -> Result<(), String> {
        self.go(goal, acceleration_rad_s2, speed_rad_s, false)
    }

    /// Lets a person move the joints to `goal` (rad), by hand or with the pendant: the speed slider has no part in it.
    ///
    /// # Errors
    /// The reason why no joint can be there.
    pub fn move_by_hand(&mut self, goal: [f64; 6]) -> Result<(), String> {
        self.go(goal, HAND_ACCELERATION_RAD_S2, HAND_SPEED_RAD_S, true)
    }

    fn go(&mut self, goal: [f64; 6], acceleration_rad_s2: f64, speed_rad_s: f64, by_hand: bool) -> Result<(), String> {
        if let Some(i) = goal.iter().position(|q| q.is_nan() || q.abs() > RANGE_RAD) {
            return Err(format!("movej target of {} is {} rad, outside +-{RANGE_RAD:.4}", NAMES[i], goal[i]));
        }
        self.commanded_q = goal;
        self.motion = ArmMotion::Movej {
            goal,
            acceleration_rad_s2: acceleration_rad_s2.min(MAX_ACCELERATION_RAD_S2),
            speed_rad_s: speed_rad_s.min(MAX_SPEED_RAD_S),
            by_hand,
        };
        Ok(())
    }

    /// Goes to the joint speeds `goal_qd` (rad/s) and keeps them.
    ///
    /// # Errors
    /// The reason for a protective stop.
    pub fn speedj(&mut self, goal_qd: [f64; 6], acceleration_rad_s2: f64) -> Result<(), String> {
        if let Some(i) = goal_qd.iter().position(|v| v.is_nan() || v.abs() > 2.0 * MAX_SPEED_RAD_S) {
            return Err(format!("speedj of {} is {} rad/s, more than twice what it can do", NAMES[i], goal_qd[i]));
        }
        self.motion = ArmMotion::Speedj { goal_qd, acceleration_rad_s2: acceleration_rad_s2.min(MAX_ACCELERATION_RAD_S2) };
        Ok(())
    }

    /// True while servoj moves the arm.
    pub fn is_servoing(&self) -> bool {
        matches!(self.motion, ArmMotion::Servoj { .. })
    }

    /// True when the arm stands still and no movej is under way.
    pub fn is_still(&self) -> bool {
        !matches!(self.motion, ArmMotion::Movej { .. }) && self.target_qd.iter().all(|v| v.abs() < 1e-9)
    }

    /// Lets `dt_s` pass, in which the arm goes through `share` (0 to 1) of its path's time, and through less where the speed limit needs
    /// it. The path itself does not change, so the speed along it does. Only a stop brakes as fast as ever.
    pub fn step(&mut self, dt_s: f64, share: f64) {
        let before_qd = self.target_qd;
        let slowed = !matches!(self.motion, ArmMotion::Hold | ArmMotion::Stop { .. } | ArmMotion::Movej { by_hand: true, .. });
        if slowed != self.slowed {
            self.path_qd = if slowed && share > 0.0 { before_qd.map(|v| v / share) } else { before_qd };
            self.slowed = slowed;
        }
        let share = if slowed { share } else { 1.0 };
        self.limiting = if slowed && share > 0.0 { self.share_within_the_speed_limit(dt_s, share) } else { 1.0 };
        let share = share * self.limiting;
        if share > 0.0 {
            self.step_path(dt_s * share);
        }
        self.target_qd = self.path_qd.map(|v| v * share);
        let lag = 1.0 - (-dt_s / self.lag_s).exp();
        for (i, before) in before_qd.iter().enumerate() {
            self.target_qdd[i] = (self.target_qd[i] - before) / dt_s;
            let way = (self.target_q[i] - self.actual_q[i]) * lag;
            self.actual_q[i] += way;
            self.actual_qd[i] = way / dt_s;
        }
    }

    /// The part of `share` (0 to 1) at which no joint exceeds the speed limit.
    fn share_within_the_speed_limit(&self, dt_s: f64, share: f64) -> f64 {
        let mut part = 1.0;
        if self.speed_limit_rad_s >= MAX_SPEED_RAD_S {
            return part;
        }
        // A shorter step may end at another speed of the path, so the part is corrected until it fits.
        for _ in 0..SPEED_LIMIT_ROUNDS {
            let mut trial = self.clone();
            trial.step_path(dt_s * share * part);
            let speed = trial.path_qd.iter().fold(0.0f64, |m, v| m.max(v.abs())) * share * part;
            if speed <= self.speed_limit_rad_s {
                break;
            }
            part *= self.speed_limit_rad_s / speed;
        }
        part
    }

    /// Lets `dt_s` of the path's own time pass.
    fn step_path(&mut self, dt_s: f64) {
        match self.motion {
            ArmMotion::Hold => self.path_qd = [0.0; 6],
            ArmMotion::Servoj { lookahead_s, gain } => self.step_servoj(lookahead_s, gain, dt_s),
            ArmMotion::Stop { deceleration_rad_s2 } => {
                self.slow_down(deceleration_rad_s2, dt_s);
                if self.path_qd == [0.0; 6] {
                    self.motion = ArmMotion::Hold;
                }
            }
            ArmMotion::Speedj { goal_qd, acceleration_rad_s2 } => {
                let most = acceleration_rad_s2 * dt_s;
                for (i, goal) in goal_qd.iter().enumerate() {
                    let goal = goal.clamp(-MAX_SPEED_RAD_S, MAX_SPEED_RAD_S);
                    self.path_qd[i] += (goal - self.path_qd[i]).clamp(-most, most);
                    self.target_q[i] = (self.target_q[i] + self.path_qd[i] * dt_s).clamp(-RANGE_RAD, RANGE_RAD);
                }
            }
            ArmMotion::Movej { goal, acceleration_rad_s2, speed_rad_s, .. } => {
                self.step_movej(goal, acceleration_rad_s2, speed_rad_s, dt_s);
            }
        }
    }

    /// Solves the servoj equation for one cycle.
    fn step_servoj(&mut self, lookahead_s: f64, gain: f64, dt_s: f64) {
        let substeps = (dt_s / SUBSTEP_S).ceil();
        let h = dt_s / substeps;
        for _ in 0..substeps as u32 {
            for i in 0..6 {
                // The equation is implicit in the speed, which makes it stable for every allowed gain and lookahead.
                let (q, v) = (self.target_q[i], self.path_qd[i]);
                let wanted = (v + h * gain * (self.commanded_q[i] - q)) / (1.0 + h * gain * (lookahead_s + h));
                let most = MAX_ACCELERATION_RAD_S2 * h;
                let speed = (v + (wanted - v).clamp(-most, most)).clamp(-self.held_rad_s, self.held_rad_s);
                self.path_qd[i] = speed;
                self.target_q[i] += h * speed;
            }
        }
    }

    /// Slows all joints down in proportion, so that the arm stays on its path.
    fn slow_down(&mut self, deceleration_rad_s2: f64, dt_s: f64) {
        let fastest = self.path_qd.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let left = (fastest - deceleration_rad_s2 * dt_s).max(0.0);
        let scale = if fastest > 0.0 { left / fastest } else { 0.0 };
        for i in 0..6 {
            let mean = self.path_qd[i] * (1.0 + scale) / 2.0;
            self.path_qd[i] *= scale;
            self.target_q[i] += mean * dt_s;
        }
    }

    /// One cycle of a trapezoidal motion along the straight line in joint space.
    fn step_movej(&mut self, goal: [f64; 6], acceleration: f64, speed: f64, dt_s: f64) {
        let way: [f64; 6] = std::array::from_fn(|i| goal[i] - self.target_q[i]);
        let longest = way.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        let now = self.path_qd.iter().fold(0.0f64, |m, v| m.max(v.abs()));
        // From the allowed speed the arm can still stop at the goal after one more cycle.
        let brake = acceleration * dt_s / 2.0;
        let allowed = (brake * brake + 2.0 * acceleration * longest).sqrt() - brake;
        let next = (now + acceleration * dt_s).min(speed).min(allowed.max(0.0));
        if longest <= next * dt_s || longest < 1e-9 {
            self.target_q = goal;
            self.path_qd = [0.0; 6];
            self.motion = ArmMotion::Hold;
            return;
        }
        for (i, way) in way.iter().enumerate() {
            self.path_qd[i] = way / longest * next;
            self.target_q[i] += self.path_qd[i] * dt_s;
        }
    }
}
