//! The one place that every target passes: limits on angle, step, rate and acceleration of alpha.
//!
//! It is pure and runs in the controller's loop: it does not allocate, panic or fail. A request that is not finite counts as "stay".
//! Whatever is clipped is counted. This is not a safety function; safety is the task of the robot's own controller.

use serde::{Deserialize, Serialize};

/// Limits on alpha, the tilt from upright.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Limits {
    /// Smallest alpha, degrees; 0 or less.
    pub alpha_min_deg: f32,
    /// Largest alpha, degrees.
    pub alpha_max_deg: f32,
    /// Largest change between two ticks, degrees.
    pub step_deg: f32,
    /// Largest rate, degrees/s.
    pub rate_deg_s: f32,
    /// Largest acceleration, degrees/s^2.
    pub acceleration_deg_s2: f32,
    /// Rate of the way back to upright, degrees/s.
    pub return_rate_deg_s: f32,
}

impl Limits {
    /// The limits where no configuration says others.
    pub const DEFAULT: Self = Self {
        alpha_min_deg: 0.0,
        alpha_max_deg: 110.0,
        step_deg: 5.0,
        rate_deg_s: 90.0,
        acceleration_deg_s2: 1500.0,
        return_rate_deg_s: 60.0,
    };
}

impl Default for Limits {
    fn default() -> Self {
        Self::DEFAULT
    }
}

/// How often each limit changed a request.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, Serialize, Deserialize)]
pub struct Clipped {
    /// Number of requests outside the range of angles.
    pub angle: u64,
    /// Number of requests beyond the largest step or rate.
    pub rate: u64,
    /// Number of requests beyond the largest acceleration.
    pub acceleration: u64,
    /// Number of requests that were not finite.
    pub not_finite: u64,
}

/// Turns requested angles into angles that keep all limits.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Limiter {
    limits: Limits,
    period_s: f32,
    alpha_deg: f32,
    rate_deg_s: f32,
    clipped: Clipped,
}

impl Limiter {
    /// A limiter at rest at `alpha_deg`, called once every `period_s` seconds.
    pub fn new(limits: Limits, period_s: f32, alpha_deg: f32) -> Self {
        Self { limits, period_s, alpha_deg, rate_deg_s: 0.0, clipped: Clipped::default() }
    }

    /// The commanded alpha, degrees.
    pub fn alpha_deg(&self) -> f32 {
        self.alpha_deg
    }

    /// The commanded rate, degrees/s.
    pub fn rate_deg_s(&self) -> f32 {
        self.rate_deg_s
    }

    /// How often each limit changed a request since [`Limiter::new`].
    pub fn clipped(&self) -> Clipped {
        self.clipped
    }

    /// Starts again at rest at `alpha_deg`, keeping the counts.
    pub fn rest_at(&mut self, alpha_deg: f32) {
        self.alpha_deg = alpha_deg;
        self.rate_deg_s = 0.0;
    }

    /// Takes the angle that is requested, degrees, and gives the angle to command in this period, degrees.
    ///
    /// The rate never exceeds what can be braked to rest before the end of the angle range.
    pub fn step(&mut self, request_deg: f32) -> f32 {
        let Limits { alpha_min_deg, alpha_max_deg, step_deg, rate_deg_s, acceleration_deg_s2, .. } = self.limits;
        let dt = self.period_s;
        let request = if request_deg.is_finite() {
            request_deg
        } else {
            self.clipped.not_finite += 1;
            self.alpha_deg
        };
        let wanted = request.clamp(alpha_min_deg, alpha_max_deg);
        self.clipped.angle += u64::from(wanted != request);

        let top = rate_deg_s.min(step_deg / dt);
        let asked = (wanted - self.alpha_deg) / dt;
        let rate = asked.clamp(-top, top);
        self.clipped.rate += u64::from(rate != asked);

        // The fastest rate towards the wall from which whole periods of full braking still stop in time.
        let change = acceleration_deg_s2 * dt;
        let wall = if rate < 0.0 { self.alpha_deg - alpha_min_deg } else { alpha_max_deg - self.alpha_deg };
        let braking = braking_rate(wall.max(0.0), change, dt);
        let rate = rate.clamp(-braking, braking);
        let limited = rate.clamp(self.rate_deg_s - change, self.rate_deg_s + change);
        self.clipped.acceleration += u64::from(limited != rate);

        let next = (self.alpha_deg + limited * dt).clamp(alpha_min_deg, alpha_max_deg);
        self.rate_deg_s = (next - self.alpha_deg) / dt;
        self.alpha_deg = next;
        next
    }

    /// One period on the way to `target_deg`, braking in time to stop there. [`Limiter::step`] does not brake: it gives a fast action its
    /// whole angle, because the next action comes a period later.
    pub fn step_towards(&mut self, target_deg: f32) -> f32 {
        let distance = target_deg - self.alpha_deg;
        if !distance.is_finite() {
            return self.step(target_deg);
        }
        let far = braking_rate(distance.abs(), self.limits.acceleration_deg_s2 * self.period_s, self.period_s) * self.period_s;
        self.step(self.alpha_deg + distance.clamp(-far, far))
    }

    /// One period of the way back to upright, at the return rate, braking in time to stop there: beyond upright a range may go on.
    pub fn step_upright(&mut self) -> f32 {
        let goal = 0.0_f32.clamp(self.limits.alpha_min_deg, self.limits.alpha_max_deg);
        let distance = goal - self.alpha_deg;
        let braking = braking_rate(distance.abs(), self.limits.acceleration_deg_s2 * self.period_s, self.period_s);
        let far = self.limits.return_rate_deg_s.min(braking) * self.period_s;
        self.step(self.alpha_deg + distance.clamp(-far, far))
    }
}

/// The largest rate r, degrees/s, with which r, r - change, r - 2 change, and so on, each held for dt seconds, move alpha by at most
/// `distance` degrees.
fn braking_rate(distance: f32, change: f32, dt: f32) -> f32 {
    if change <= 0.0 {
        return 0.0;
    }
    // With n whole periods of braking after this one: r (n + 1) - change n (n + 1) / 2 = distance / dt, and r in (n, n + 1] change.
    let reach = distance / (dt * change);
    let n = ((((8.0 * reach + 1.0).sqrt() - 1.0) / 2.0).ceil() - 1.0).max(0.0);
    change * (reach / (n + 1.0) + n / 2.0)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const DT: f32 = 1.0 / 30.0;

    proptest! {
        /// Protects the robot: no request, however wild, leads beyond any limit.
        #[test]
        fn every_target_keeps_every_limit(requests in prop::collection::vec(prop_oneof![-1e4f32..1e4, Just(f32::NAN), Just(f32::INFINITY), -10f32..120.0], 1..200)) {
            let limits = Limits::default();
            let mut limiter = Limiter::new(limits, DT, 0.0);
            let (mut alpha, mut rate) = (0.0f32, 0.0f32);
            for request in requests {
                // Half of the requests go to the step that brakes: it must not panic either, whatever it is given.
                let next = if request.to_bits() % 2 == 0 { limiter.step(request) } else { limiter.step_towards(request) };
                prop_assert!(next >= limits.alpha_min_deg && next <= limits.alpha_max_deg);
                let new_rate = (next - alpha) / DT;
                prop_assert!(new_rate.abs() <= limits.rate_deg_s * 1.001, "rate {new_rate}");
                prop_assert!((new_rate - rate).abs() <= limits.acceleration_deg_s2 * DT * 1.01, "from {rate} to {new_rate} at {next}");
                (alpha, rate) = (next, new_rate);
            }
        }
    }

    /// Protects the pour's end: upright is reached exactly.
    #[test]
    fn the_way_back_ends_at_zero() {
        let mut limiter = Limiter::new(Limits::default(), DT, 80.0);
        for _ in 0..60 {
            limiter.step_upright();
        }
        assert_eq!(limiter.alpha_deg(), 0.0);
    }

    /// Protects the table behind the container: where the range goes on beyond upright, the way back ends at upright and does not swing through it.
    #[test]
    fn the_way_back_does_not_swing_through() {
        for (acceleration_deg_s2, return_rate_deg_s, period_s) in
            [(150.0, 60.0, DT), (450.0, 90.0, DT), (120.0, 90.0, DT / 2.0), (1500.0, 60.0, DT)]
        {
            let limits = Limits { alpha_min_deg: -20.0, acceleration_deg_s2, return_rate_deg_s, ..Limits::default() };
            let mut limiter = Limiter::new(limits, period_s, 80.0);
            let lowest_deg = (0..300).map(|_| limiter.step_upright()).fold(f32::INFINITY, f32::min);
            assert!(lowest_deg > -0.01 && limiter.alpha_deg().abs() < 0.01, "{lowest_deg} and {} degrees", limiter.alpha_deg());
        }
    }

    /// Protects the operator's view: what was clipped is counted by cause.
    #[test]
    fn clipping_is_counted() {
        let mut limiter = Limiter::new(Limits::default(), DT, 0.0);
        limiter.step(f32::NAN);
        limiter.step(500.0);
        let clipped = limiter.clipped();
        assert_eq!((clipped.not_finite, clipped.angle, clipped.rate, clipped.acceleration), (1, 1, 1, 1));
    }
}
