//! What the program on the robot tells servoj: whether each call keeps the limits, leaves the other joints alone, and tilts nothing again.
//!
//! Pure; allocates for what it finds only; cannot fail. Calls of servoj are compared, and not control cycles: on a slowed robot
//! a call takes several cycles. A call either goes on from the one before, or begins anew: from where the servo steers the joints, and as
//! fast as that moves the tilting one, but no faster than the limit. Where both are possible, both are kept for the next call.

use shared::limits::Limits;
use simulator::ur::Machine;

/// How much faster than its limit a command may be, as a share: rounding in f32, and the robot's own interpolation in f64.
pub const SLACK: f64 = 0.02;
/// How far a command may be beyond the range, degrees: rounding in f32.
pub const SLACK_DEG: f64 = 0.01;
/// How far a joint that is not ours may be commanded to move in a call, rad: rounding.
const STILL_RAD: f64 = 1e-6;
/// How far below the smallest tilt a command may be, degrees: what a joint that was moved by hand still counts as upright, and half a degree.
const BELOW_DEG: f64 = 2.5;
/// How far a container on its way upright may tilt again, degrees: what a joint overtakes while it brakes.
const AGAIN_DEG: f64 = 6.0;

/// A name from docs/SWARM.md and what was seen.
pub type Finding = (&'static str, String);

/// The one or two rates at which a call may have moved the tilting joint, degrees/s: seen from the call before it, and from the servo.
#[derive(Debug, Clone, Copy)]
struct Rates([f64; 2], usize);

impl Rates {
    fn one(rate: f64) -> Self {
        Self([rate, rate], 1)
    }

    fn two(first: f64, second: f64) -> Self {
        Self([first, second], 2)
    }

    fn known(&self) -> &[f64] {
        &self.0[..self.1]
    }
}

/// What is kept from call to call.
#[derive(Debug)]
pub struct Commanded {
    limits: Limits,
    /// Control period of the robot, s; a call of servoj is worth as much.
    cycle_s: f64,
    calls: u64,
    /// What servoj was told last, rad, and the rates that the tilting joint may have been told then, degrees/s.
    told: Option<([f64; 6], Rates)>,
    /// Where the servo steered all joints to after the cycle before, rad, and how fast the tilting one, degrees/s.
    servo: ([f64; 6], f64),
    /// How far beyond the range a command may be since the program began anew, degrees: it may have begun at a joint that a hand was moving.
    excused_deg: f64,
    /// The largest target of the newest pour, degrees.
    largest_deg: f64,
    /// Smallest commanded tilt since nothing is poured and the command has turned back, degrees; `None` before that.
    least_deg: Option<f64>,
}

impl Commanded {
    /// Nothing was told yet.
    pub fn new(limits: Limits, cycle_s: f64) -> Self {
        let servo = ([f64::NAN; 6], f64::NAN);
        Self { limits, cycle_s, calls: 0, told: None, servo, excused_deg: 0.0, largest_deg: 0.0, least_deg: None }
    }

    /// Takes a target that the controller sent; `active` says whether it pours or records.
    pub fn target(&mut self, target_deg: f64, active: bool, begins: bool) {
        if begins {
            self.largest_deg = target_deg;
        }
        if active {
            self.largest_deg = self.largest_deg.max(target_deg);
        }
    }

    /// Looks at the robot after a control cycle. `active` says whether the controller pours or records.
    pub fn cycle(&mut self, machine: &Machine, joint: usize, active: bool) -> Vec<Finding> {
        let servo = &machine.robot.servo;
        let findings = if servo.servoj_calls == self.calls { Vec::new() } else { self.call(&servo.commanded_q, joint, active) };
        self.calls = servo.servoj_calls;
        self.servo = (servo.target_q, servo.target_qd[joint].to_degrees());
        findings
    }

    /// A call of servoj with `q`, rad.
    fn call(&mut self, q: &[f64; 6], joint: usize, active: bool) -> Vec<Finding> {
        let mut findings = Vec::new();
        let Limits { rate_deg_s, acceleration_deg_s2, .. } = self.limits;
        let fastest = f64::from(rate_deg_s);
        let servo_q = self.servo.0;
        let servo_rates = Rates::one(self.servo.1.clamp(-fastest, fastest));
        let (told_q, told_rates) = self.told.take().unwrap_or((servo_q, servo_rates));
        for other in (0..6).filter(|j| *j != joint) {
            let moved = (q[other] - told_q[other]).abs().min((q[other] - servo_q[other]).abs());
            if moved > STILL_RAD {
                findings.push(("others-still", format!("joint {other} is commanded to move by {moved:.6} rad")));
            }
        }
        let alpha_deg = q[joint].to_degrees();
        // For each call that this may follow: the rate that it then has, and how much harder than allowed it accelerates.
        let most = f64::from(acceleration_deg_s2) * (1.0 + SLACK) + 1.0;
        let rate_from = |from_q: &[f64; 6]| (alpha_deg - from_q[joint].to_degrees()) / self.cycle_s;
        let (told_rate, anew_rate) = (rate_from(&told_q), rate_from(&servo_q));
        let acceleration = |rate: f64, before: &f64| (rate - before).abs() / self.cycle_s;
        let keeps = |rate: f64, rates: &Rates| {
            rate.abs() <= fastest * (1.0 + SLACK) + 0.1 && rates.known().iter().any(|before| acceleration(rate, before) <= most)
        };
        let (goes_on, may_be_anew) = (keeps(told_rate, &told_rates), keeps(anew_rate, &servo_rates));
        let ways = [(told_rate, &told_rates), (anew_rate, &servo_rates)];
        let steps = ways.iter().flat_map(|(rate, rates)| rates.known().iter().map(|before| (*rate, acceleration(*rate, before))));
        let mildest = steps.min_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or((told_rate, f64::INFINITY));
        if !goes_on && !may_be_anew {
            let (rate, acceleration) = mildest;
            let name = if acceleration > most { "robot-acceleration" } else { "robot-rate" };
            let (told_deg, servo_deg) = (told_q[joint].to_degrees(), servo_q[joint].to_degrees());
            let (told, servo) = (told_rates.known(), servo_rates.known());
            findings.push((
                name,
                format!(
                    "servoj is given {alpha_deg:.3} degrees, {rate:.1} degrees/s, {acceleration:.0} degrees/s^2, after {told_deg:.3} at \
{told:.1?}, where the servo is at {servo_deg:.3} and {servo:.1?}"
                ),
            ));
        }
        let begins_anew = !goes_on && may_be_anew;
        let rate = if begins_anew { anew_rate } else { told_rate };
        findings.extend(self.beyond(alpha_deg, (told_q[joint].to_degrees(), servo_q[joint].to_degrees()), rate, begins_anew));
        findings.extend(self.again(alpha_deg, told_rate > 0.0, active, begins_anew));
        let rates = match (goes_on, may_be_anew) {
            (true, true) => Rates::two(told_rate, anew_rate),
            (true, false) => Rates::one(told_rate),
            (false, true) => Rates::one(anew_rate),
            (false, false) => Rates::one(mildest.0),
        };
        self.told = Some((*q, rates));
        findings
    }

    /// Whether a command is beyond the range, where neither the one before it nor the servo was. A joint that somebody has moved there comes back; one that
    /// somebody is moving, when a program begins anew, has to be braked first.
    fn beyond(&mut self, alpha_deg: f64, (told_deg, servo_deg): (f64, f64), rate: f64, begins_anew: bool) -> Option<Finding> {
        let Limits { alpha_min_deg, alpha_max_deg, acceleration_deg_s2, .. } = self.limits;
        let range = f64::from(alpha_min_deg) - BELOW_DEG..=f64::from(alpha_max_deg) + SLACK_DEG;
        let middle_deg = 0.5 * (range.start() + range.end());
        let beyond_deg = |deg: f64| (deg - range.end()).max(range.start() - deg).max(0.0);
        // How far it goes if it is braked from now on.
        let braked_deg = beyond_deg(alpha_deg + rate * (self.cycle_s + rate.abs() / (2.0 * f64::from(acceleration_deg_s2))));
        self.excused_deg = if begins_anew {
            beyond_deg(alpha_deg).max(braked_deg)
        } else if (alpha_deg - middle_deg).abs() <= (told_deg - middle_deg).abs() {
            0.0
        } else {
            self.excused_deg.min(braked_deg + SLACK_DEG)
        };
        let may_be_deg = beyond_deg(told_deg).max(beyond_deg(servo_deg)).max(self.excused_deg);
        (beyond_deg(alpha_deg) > may_be_deg).then(|| ("robot-range", format!("servoj is given {alpha_deg:.3} degrees")))
    }

    /// Whether the container is tilted again while nothing is poured. A slowed robot is still on its way to the last targets when the pour
    /// ends, and may go there; once it has turned back, it may not turn again.
    fn again(&mut self, alpha_deg: f64, rising: bool, active: bool, begins_anew: bool) -> Option<Finding> {
        if active {
            self.least_deg = None;
            return None;
        }
        let Some(least_deg) = self.least_deg.filter(|_| !begins_anew) else {
            self.least_deg = (!rising || begins_anew).then_some(alpha_deg);
            let most_deg = self.largest_deg + AGAIN_DEG;
            let beyond = rising && !begins_anew && alpha_deg > most_deg;
            return beyond
                .then(|| ("no-resume", format!("tilted to {alpha_deg:.1} degrees after the pour, whose targets ended at {most_deg:.1}")));
        };
        self.least_deg = Some(least_deg.min(alpha_deg));
        // A joint that was moved below 0 rises on its way upright.
        let again = rising && alpha_deg > least_deg.max(0.0) + AGAIN_DEG;
        again.then(|| ("no-resume", format!("tilted from {least_deg:.1} to {alpha_deg:.1} degrees while nothing is poured")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CYCLE_S: f64 = 0.008;

    /// The findings of calls of servoj with these tilts, degrees; `servo` is where the servo then is, degrees, and how fast, degrees/s.
    fn findings(calls: &[f64], servo: (f64, f64), active: bool) -> Vec<&'static str> {
        let mut commanded = Commanded::new(Limits::default(), CYCLE_S);
        let at = |deg: f64| [0.1, 0.2, 0.3, 0.4, 0.5, f64::to_radians(deg)];
        let start = calls.first().copied().unwrap_or_default();
        commanded.told = Some((at(start), Rates::one(0.0)));
        commanded.servo = (at(servo.0), servo.1);
        calls.iter().flat_map(|deg| commanded.call(&at(*deg), 5, active)).map(|(name, _)| name).collect()
    }

    /// Protects the check: a ramp within the limits passes, and one that is too hard, too fast or out of range does not.
    #[test]
    fn limits_are_judged_call_by_call() {
        assert_eq!(findings(&[10.0, 10.09, 10.27, 10.54], (40.0, 0.0), true), Vec::<&str>::new());
        assert_eq!(findings(&[10.0, 10.2], (40.0, 0.0), true), ["robot-acceleration"]);
        let fast: Vec<f64> = (0..30).map(|k| 10.0 + 0.045 * f64::from(k * (k + 1))).collect();
        assert!(findings(&fast, (80.0, 0.0), true).contains(&"robot-rate"));
        assert!(findings(&[110.0, 110.05], (40.0, 0.0), true).contains(&"robot-range"));
        assert!(findings(&[-2.45, -2.55], (0.0, 0.0), true).contains(&"robot-range"));
    }

    /// Protects the check from false alarms where a program begins anew: a call may go on from the servo, at the servo's rate, and the next one
    /// from either reading of it. Nowhere else.
    #[test]
    fn a_program_may_begin_anew_at_the_servo_only() {
        assert_eq!(findings(&[60.0, 39.94, 39.82], (40.0, 0.0), true), Vec::<&str>::new());
        assert_eq!(findings(&[60.0, 40.7], (40.0, 90.0), true), Vec::<&str>::new());
        assert_eq!(findings(&[60.0, 41.0], (40.0, 0.0), true), ["robot-acceleration"]);
        assert_eq!(findings(&[56.0, 56.053, 55.933], (56.113, 0.0), true), Vec::<&str>::new(), "both readings of the second call count");
    }

    /// Protects people: nothing is tilted again once the command has turned back, but a slowed robot may come to the pour's last targets.
    #[test]
    fn a_pour_that_is_over_is_not_resumed() {
        let ramp = |from: f64, to: f64| {
            let n = ((to - from).abs() / 0.4) as usize;
            (0..=n).map(move |k| from + (to - from) * k as f64 / n.max(1) as f64).collect::<Vec<_>>()
        };
        let again = |largest_deg: f64, way: &[f64]| {
            let mut commanded = Commanded::new(Limits::default(), CYCLE_S);
            commanded.target(largest_deg, true, true);
            let at = |deg: f64| [0.0, 0.0, 0.0, 0.0, 0.0, f64::to_radians(deg)];
            commanded.told = Some((at(19.9), Rates::one(0.0)));
            commanded.servo = (at(90.0), 0.0);
            way.iter().flat_map(|deg| commanded.call(&at(*deg), 5, false)).any(|(name, _)| name == "no-resume")
        };
        assert!(!again(30.0, &ramp(20.0, 30.0)), "the last targets");
        assert!(again(30.0, &ramp(20.0, 40.0)), "beyond them");
        assert!(again(30.0, &[ramp(20.0, 25.0), ramp(25.0, 10.0), ramp(10.0, 18.0)].concat()), "again");
        assert!(!again(30.0, &[ramp(20.0, 25.0), ramp(25.0, 0.0)].concat()), "and upright");
    }

    /// Protects the check from false alarms where a person has moved the joint beyond its range: it comes back from there, and goes no farther.
    #[test]
    fn a_joint_that_was_moved_beyond_the_range_comes_back() {
        let back: Vec<f64> = (0..16).map(|k| -22.6 + 0.02 * f64::from(k * (k + 1))).collect();
        assert_eq!(findings(&back, (-22.6, 0.0), false), Vec::<&str>::new());
        let on: Vec<f64> = [-22.6, -22.62, -22.66].to_vec();
        assert!(findings(&on, (-22.6, 0.0), false).contains(&"robot-range"));
        // While a hand moves it on at 15 degrees/s (seed 5039681), a program begins where it is, and brakes it: no harder, and no farther.
        assert_eq!(findings(&[-0.5, -2.59, -2.69, -2.75, -2.77, -2.73], (-2.47, -15.0), false), Vec::<&str>::new());
        assert!(findings(&[-0.5, -2.59, -2.71, -2.83, -2.95, -3.07], (-2.47, -15.0), false).contains(&"robot-range"));
        // One that is braked at once, and then creeps on, is not braked any more.
        assert!(findings(&[-0.5, -2.59, -2.65, -2.66, -2.67, -2.68, -2.69, -2.7], (-2.47, -15.0), false).contains(&"robot-range"));
    }

    /// Protects the other joints: they stay as told, or where the servo is; every other angle is a motion.
    #[test]
    fn the_other_joints_stay_or_are_where_they_are() {
        let mut commanded = Commanded::new(Limits::default(), CYCLE_S);
        commanded.told = Some(([0.0; 6], Rates::one(0.0)));
        commanded.servo = ([0.3, 0.0, 0.0, 0.0, 0.0, 0.0], 0.0);
        assert!(commanded.call(&[0.3, 0.0, 0.0, 0.0, 0.0, 0.0], 5, false).is_empty());
        assert_eq!(commanded.call(&[0.301, 0.0, 0.0, 0.0, 0.0, 0.0], 5, false).first().map(|f| f.0), Some("others-still"));
    }
}
