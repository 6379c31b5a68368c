//! Whether the joint follows what is commanded, and how far a command may be ahead of it.
//!
//! It is pure and runs in the controller's loop; it does not allocate, panic or fail. A joint that follows is, at every moment, somewhere where
//! the command was within the time of its lag. The lag is the one that was learned from the episodes, where the weights carry one, and
//! otherwise what the robot's program and servo need by the configuration ([`Settings::usual_lag_ns`]). A joint that is elsewhere for
//! [`MOST_TICKS`] ticks does not follow: the robot is slower than it is commanded, or something holds or moves it. What was learned of the
//! flow then does not hold, so that no volume can be promised.
//!
//! ```text
//! window = 1.25 lag + 1 period, lag = learned, within usual ... 0.3 s
//! follows: least command in the window - 2 deg <= measured <= largest command in the window + 2 deg
//! reach  = window * largest rate + 2 deg: no command is farther from the measured tilt than this
//! ```

use shared::alpha_track::AngleHistory;

use super::robot::Robot;
use super::settings::Settings;

/// Number of commands that are remembered, to know which one was in force when a picture was taken, and whether the joint follows: a second
/// at 30 Hz, and as long as the longest window at 125 Hz.
pub const COMMANDS: usize = 64;
/// The longest lag that is believed, s. A robot that needs longer cannot stop a stream in time, whatever was learned. Chosen by hand: twice
/// the lag of the simulated robot.
const LAG_MAX_S: f64 = 0.3;
/// The lag's share that is added to it, because a servo that lags smoothly is still on its way after its mean lag. Chosen by hand: with it, a
/// first-order lag of 0.1 s stays within [`TOLERANCE_DEG`] at 90 degrees/s.
const LAG_MARGIN: f64 = 0.25;
/// Distance from the commands that still counts as following, degrees: also the largest distance that counts as upright in the shipped
/// configurations. Chosen by hand; no measurement is recorded.
pub const TOLERANCE_DEG: f32 = 2.0;
/// Number of ticks in a row that a joint may be elsewhere: one that is late by a single state of the robot is not slow. Chosen by hand; no
/// measurement is recorded.
pub const MOST_TICKS: u32 = 3;
/// Share of its speed below which the robot slows the motion by itself (RTDE's `speed_scaling`). Chosen by hand: above it the lag is the usual
/// one.
pub const FULL_SPEED: f32 = 0.95;
/// Number of ticks in a row with less than that share after which the robot counts as slow: a fifth of a second at 30 Hz. Chosen by hand; no
/// measurement is recorded.
const MOST_SLOW_TICKS: u32 = 6;

/// How long a joint may take to be where it was commanded, and how far it may be from it.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Following {
    window_ns: u64,
    reach_deg: f32,
    elsewhere_ticks: u32,
    slow_ticks: u32,
}

impl Following {
    /// The watch over a pour that begins now, with the lag that was learned, s.
    pub fn new(learned_lag_s: Option<f64>, settings: &Settings) -> Self {
        let usual_s = settings.usual_lag_ns as f64 / 1e9;
        let period_s = settings.period_ns as f64 / 1e9;
        // A usual lag that is longer than what is ever believed comes from the configuration and is the operator's word.
        let lag_s = learned_lag_s.filter(|s| s.is_finite()).unwrap_or(usual_s).min(LAG_MAX_S).max(usual_s);
        let window_s = lag_s * (1.0 + LAG_MARGIN) + period_s;
        let limits = &settings.limits;
        let rate_deg_s = limits.rate_deg_s.min(limits.step_deg / period_s as f32).max(limits.return_rate_deg_s);
        Self {
            window_ns: (window_s * 1e9) as u64,
            reach_deg: window_s as f32 * rate_deg_s + TOLERANCE_DEG,
            elsewhere_ticks: 0,
            slow_ticks: 0,
        }
    }

    /// Takes the robot's newest state and gives whether it follows what was `commanded`. Call it once a tick.
    pub fn follows(&mut self, robot: &Robot, commanded: &AngleHistory<COMMANDS>) -> bool {
        let (least, largest) = commanded.range_deg(robot.at_ns.saturating_sub(self.window_ns), robot.at_ns);
        // Written so that an angle that is not a number is elsewhere. A robot that never told a state, as a simulator's need not, is not judged by it.
        let there = robot.at_ns == 0 || (robot.alpha_deg >= least - TOLERANCE_DEG && robot.alpha_deg <= largest + TOLERANCE_DEG);
        self.elsewhere_ticks = if there { 0 } else { self.elsewhere_ticks.saturating_add(1) };
        self.slow_ticks = if is_slowed(robot) { self.slow_ticks.saturating_add(1) } else { 0 };
        self.elsewhere_ticks < MOST_TICKS && self.slow_ticks < MOST_SLOW_TICKS
    }

    /// The request, degrees, brought within reach of the measured alpha. A measured alpha that is not a number leaves it as it is.
    pub fn within_reach_deg(&self, request_deg: f32, measured_deg: f32) -> f32 {
        if measured_deg.is_nan() {
            return request_deg;
        }
        request_deg.min(measured_deg + self.reach_deg).max(measured_deg - self.reach_deg)
    }
}

/// Whether the robot says that it slows the motion by itself. A share that is not a number counts as slow.
pub fn is_slowed(robot: &Robot) -> bool {
    robot.speed_scaling.is_some_and(|share| share.is_nan() || share < FULL_SPEED)
}

#[cfg(test)]
mod tests {
    use super::*;
    use shared::config::Config;

    fn settings() -> Settings {
        Settings::new(&Config::parse(include_str!("../../../config/sim.toml"), "config/sim.toml").unwrap())
    }

    /// Runs a ramp to 80 degrees and back at 90 degrees/s, and a joint that lags by a dead time and a first-order lag, and is not faster than
    /// `most_deg_s`. Gives the first tick at which it does not follow, and how far the command was then ahead.
    fn first_miss(dead_s: f64, lag_s: f64, most_deg_s: f64, learned_s: Option<f64>) -> Option<(u64, f64)> {
        let settings = settings();
        let mut watch = Following::new(learned_s, &settings);
        let mut commanded = AngleHistory::new();
        commanded.push(1_000_000_000, 0.0);
        let command_deg = |t: f64| (90.0 * t).min(80.0).min((90.0 * (3.0 - t)).max(0.0)).max(0.0);
        let (mut alpha_deg, substeps) = (0.0f64, 33);
        for tick in 1..150u64 {
            let now_ns = 1_000_000_000 + tick * settings.period_ns;
            let t = (tick * settings.period_ns) as f64 / 1e9;
            for k in 0..substeps {
                let at = t - (settings.period_ns as f64 / 1e9) * (1.0 - f64::from(k) / f64::from(substeps));
                let rate = (command_deg(at - dead_s) - alpha_deg) / lag_s;
                alpha_deg += rate.clamp(-most_deg_s, most_deg_s) * 0.001;
            }
            let robot = Robot::that_may_move(alpha_deg as f32, now_ns);
            if !watch.follows(&robot, &commanded) {
                return Some((tick, command_deg(t) - alpha_deg));
            }
            commanded.push(now_ns, command_deg(t) as f32);
        }
        None
    }

    /// Protects the pours of a robot that follows: with the lag of the program and the servo, in several shares, nothing is ever missed, also
    /// when less was learned; a joint that lags more than that follows if this was learned.
    #[test]
    fn a_robot_that_lags_as_usual_follows() {
        for (dead_s, lag_s) in [(0.0, 0.15), (0.1, 0.05), (0.14, 0.012), (0.05, 0.1), (0.0, 0.08)] {
            for learned_s in [None, Some(0.0), Some(0.143), Some(f64::NAN)] {
                assert_eq!(first_miss(dead_s, lag_s, 180.0, learned_s), None, "{dead_s} {lag_s} {learned_s:?}");
            }
        }
        assert!(first_miss(0.2, 0.08, 180.0, Some(0.15)).is_some());
        assert_eq!(first_miss(0.2, 0.08, 180.0, Some(0.28)), None);
        assert!(first_miss(1.0, 0.1, 180.0, Some(2.0)).is_some(), "no lag of a second is believed");
    }

    /// Protects the cup: a joint slower than 90 degrees/s is found out before the command is 40 degrees ahead.
    #[test]
    fn a_slow_robot_does_not_follow() {
        for most_deg_s in [60.0, 45.0, 30.0, 20.0, 10.0, 0.0] {
            let (_, ahead_deg) = first_miss(0.08, 0.05, most_deg_s, Some(0.143)).unwrap();
            assert!(ahead_deg < 40.0, "{most_deg_s}: {ahead_deg}");
        }
    }

    /// Protects from wind-up, and the limiter from a joint whose place is not known.
    #[test]
    fn requests_stay_within_reach() {
        let watch = Following::new(None, &settings());
        assert_eq!(watch.within_reach_deg(100.0, 30.0), 30.0 + watch.reach_deg);
        assert_eq!(watch.within_reach_deg(-10.0, 60.0), 60.0 - watch.reach_deg);
        assert_eq!(watch.within_reach_deg(35.0, 30.0), 35.0);
        assert_eq!(watch.within_reach_deg(35.0, f32::NAN), 35.0);
        assert!(watch.within_reach_deg(f32::NAN, 30.0).is_finite(), "the joint's own reach");
        assert!((15.0..30.0).contains(&watch.reach_deg), "{}", watch.reach_deg);
    }

    /// Protects the dose: a robot that says that it slows itself does not follow, also where it moves so little that it cannot be seen.
    #[test]
    fn a_robot_that_says_it_is_slow_does_not_follow() {
        let mut watch = Following::new(None, &settings());
        let mut commanded = AngleHistory::new();
        commanded.push(1, 0.0);
        let slow = Robot { speed_scaling: Some(0.5), ..Robot::that_may_move(0.0, 5) };
        let ticks = (0..20).take_while(|_| watch.follows(&slow, &commanded)).count();
        assert_eq!(ticks, 5);
        assert!(watch.follows(&Robot { speed_scaling: Some(0.99), ..slow }, &commanded));
        assert!(is_slowed(&Robot { speed_scaling: Some(f32::NAN), ..slow }));
    }
}
