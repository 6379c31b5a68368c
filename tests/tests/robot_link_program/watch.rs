//! Looks at every target that the program gives to servoj, in every test: all six joints, angle, rate and acceleration.
//!
//! A target is compared with the one before. After a pause it may instead go on from where the arm then stands, because the arm may have
//! been moved. Targets are counted by calls of servoj, so that a slowed robot, for which servoj takes longer, is judged in the same way.

use rt_controller::link::LinkOptions;
use simulator::ur::{Machine, RuntimeState};

pub struct Watch {
    joint: usize,
    start_rad: f64,
    direction: f64,
    rate_rad_s: f64,
    acceleration_rad_s2: f64,
    dt_s: f64,
    /// The range that alpha may be told, rad. It grows when the arm was moved out of it.
    range_rad: [f64; 2],
    /// How far rounding may move an angle, rad.
    rounding_rad: f64,
    /// The last target.
    told: [f64; 6],
    /// The speeds that the tilting joint may have had there, rad/s; none before the first target.
    speeds: Vec<f64>,
    calls: u64,
    /// True when the program did not play since the last target.
    interrupted: bool,
    arm_q: [f64; 6],
    arm_qd: [f64; 6],
}

impl Watch {
    pub fn new(options: &LinkOptions, machine: &Machine, single: bool) -> Self {
        let limits = &options.limits;
        let rad = |deg: f32| f64::from(deg).to_radians();
        Self {
            joint: options.tilt.joint.index(),
            start_rad: options.tilt.start_deg.to_radians(),
            direction: options.tilt.direction,
            rate_rad_s: rad(limits.rate_deg_s),
            acceleration_rad_s2: rad(limits.acceleration_deg_s2),
            dt_s: machine.robot.steptime_s(),
            range_rad: [rad(limits.alpha_min_deg), rad(limits.alpha_max_deg)],
            rounding_rad: if single { 5e-7 } else { 1e-9 },
            told: machine.robot.servo.target_q,
            speeds: Vec::new(),
            calls: machine.robot.servo.servoj_calls,
            interrupted: true,
            arm_q: machine.robot.servo.target_q,
            arm_qd: machine.robot.servo.target_qd,
        }
    }

    /// Looks at the arm before a control cycle.
    pub fn before(&mut self, machine: &Machine) {
        self.arm_q = machine.robot.servo.target_q;
        self.arm_qd = machine.robot.servo.target_qd;
        if machine.runtime_state() != RuntimeState::Playing {
            self.interrupted = true;
        }
    }

    /// Looks at what the program told servoj in the cycle.
    pub fn after(&mut self, machine: &Machine) {
        let servo = &machine.robot.servo;
        if servo.servoj_calls == self.calls {
            return;
        }
        assert_eq!(servo.servoj_calls, self.calls + 1, "two calls of servoj in a cycle");
        self.calls = servo.servoj_calls;
        let q = servo.commanded_q;
        // The target may go on from the one before, at each speed that that one may have had, or begin anew from where the arm is.
        let mut from: Vec<([f64; 6], f64)> = self.speeds.iter().map(|speed| (self.told, *speed)).collect();
        if self.may_begin_anew(&q) {
            // A servo that catches up may be faster than a command may be.
            from.push((self.arm_q, self.arm_qd[self.joint].clamp(-self.rate_rad_s, self.rate_rad_s)));
            let alpha = self.direction * (self.arm_q[self.joint] - self.start_rad);
            self.range_rad = [self.range_rad[0].min(alpha), self.range_rad[1].max(alpha)];
        }
        let followed: Vec<Result<f64, String>> = from.iter().map(|(before, speed)| self.follows(&q, before, *speed)).collect();
        self.speeds = followed.iter().flatten().copied().collect();
        assert!(!self.speeds.is_empty(), "{:.3} s: {followed:?}", machine.robot.timestamp_s());
        self.told = q;
        self.interrupted = false;
        let alpha = self.direction * (q[self.joint] - self.start_rad);
        // A stream that reverses out of full speed may cost a hundredth of a degree.
        let spare = 0.0003;
        assert!((self.range_rad[0] - spare..=self.range_rad[1] + spare).contains(&alpha), "{alpha} rad is outside {:?}", self.range_rad);
    }

    /// True when the program may leave its last target: when it did not play since, or when another joint was moved.
    fn may_begin_anew(&self, q: &[f64; 6]) -> bool {
        self.interrupted || self.speeds.is_empty() || (0..6).any(|i| i != self.joint && self.told[i] != q[i])
    }

    /// The speed of the tilting joint from `before`, where it was `rate` (rad/s), to `q`, or what is beyond the limits.
    fn follows(&self, q: &[f64; 6], before: &[f64; 6], rate: f64) -> Result<f64, String> {
        for i in (0..6).filter(|i| *i != self.joint) {
            if (q[i] - before[i]).abs() > self.rounding_rad {
                return Err(format!("joint {i} is told {} rad after {} rad", q[i], before[i]));
            }
        }
        let now = (q[self.joint] - before[self.joint]) / self.dt_s;
        let rounding = 2.0 * self.rounding_rad / self.dt_s;
        if now.abs() > self.rate_rad_s + rounding {
            return Err(format!("the tilting joint is told {now} rad/s"));
        }
        let change = (now - rate).abs();
        if change > self.acceleration_rad_s2 * self.dt_s + 2.0 * rounding {
            return Err(format!("the tilting joint is told to go from {rate} to {now} rad/s in a cycle"));
        }
        Ok(now)
    }
}
